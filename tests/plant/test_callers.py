"""Emergency orders of persons: repeated ones merge, and who repeats a withdrawn one pauses."""

import pytest

from heliotrope.plant.emergency.callers import (
    LONGEST_PAUSE,
    MOST_REASONS,
    MOST_WITHDRAWN,
    PAUSE,
    REMEMBERED,
    REPEATED,
    Callers,
)
from heliotrope.plant.refusals import RefusedError
from heliotrope.safety import Act


class Scene:
    """Orders of persons at a time that moves when it is set."""

    def __init__(self) -> None:
        self.callers, self.now = Callers(), 1000.0

    def order(self, who: str = "Vera", act: Act = Act.DEFOCUS, reason: str = "smoke") -> bool:
        return self.callers.take(who, act, reason, 5e8 + self.now, self.now)

    def flood(self, who: str = "Vera", seconds: float = 2.0) -> int:
        """Order a hundred times a second; return how many are refused."""
        refused = 0
        for _ in range(int(100 * seconds)):
            self.now += 0.01
            try:
                self.order(who)
            except RefusedError:
                refused += 1
        return refused

    def withdraw(self, who: str = "Vera", by: str = "Egon") -> str:
        return self.callers.withdraw(who, by, self.now)


def test_equal_orders_merge_and_stronger_or_new_ones_count() -> None:
    scene = Scene()
    assert scene.order()
    assert not scene.order()
    assert scene.order(reason="a fire; at the tower")
    assert not scene.order(reason="a fire; at the tower")
    assert scene.order(act=Act.STOW)
    assert not scene.order()
    assert scene.order("Olga")
    calls = [(call.who, call.act, call.reason) for call in scene.callers.calls]
    assert calls == [("Vera", "STOW", "smoke; a fire; at the tower"), ("Olga", "DEFOCUS", "smoke")]
    assert scene.withdraw(by="Vera") == "the order was repeated 3 times"


def test_reasons_that_are_ever_new_fill_nothing() -> None:
    scene = Scene()
    taken = [scene.order(reason=f"reason {k}") for k in range(1000)]
    assert sum(taken) == MOST_REASONS
    assert len(scene.callers.calls[0].reason) < 80


def test_a_program_that_repeats_a_withdrawn_order_pauses_and_nobody_else_does() -> None:
    scene = Scene()
    scene.flood()
    assert "Vera's next order is accepted in 30 s" in scene.withdraw()
    assert scene.flood() == 200
    with pytest.raises(
        RefusedError, match=r"the order of Vera was withdrawn .* is accepted in 2[89] s"
    ):
        scene.order()
    assert scene.order("Olga")
    scene.now += PAUSE
    assert scene.order()  # the pause has an end
    assert scene.flood() == 0
    assert f"is accepted in {2 * PAUSE:.0f} s" in scene.withdraw()
    for _ in range(9):
        scene.now += LONGEST_PAUSE
        assert scene.order()
        scene.flood()
        told = scene.withdraw()
    assert f"is accepted in {LONGEST_PAUSE:.0f} s" in told
    scene.now += REMEMBERED
    assert scene.order()
    assert scene.withdraw() == ""


def test_a_person_may_order_again_at_once() -> None:
    """Also after somebody else has withdrawn it: they may know of something new."""
    scene = Scene()
    for _ in range(20):  # a person who withdraws their own order again and again
        assert scene.order()
        assert scene.withdraw(by="Vera") == ""
        scene.now += 3.0
    for _ in range(MOST_WITHDRAWN - 1):
        assert scene.order()
        assert scene.withdraw() == ""
    assert scene.order()
    assert "next order is accepted in 30 s" in scene.withdraw()
    with pytest.raises(RefusedError):
        scene.order()


def test_a_person_who_presses_often_and_withdraws_it_pauses_too() -> None:
    scene = Scene()
    for _ in range(REPEATED):
        scene.order()
    assert "next order is accepted" in scene.withdraw(by="Vera")


def test_nothing_is_kept_of_those_who_are_long_gone() -> None:
    scene = Scene()
    for k in range(100):
        scene.order(f"person {k}")
        scene.withdraw(f"person {k}")
    scene.now += REMEMBERED + 1.0
    scene.order()
    scene.withdraw()
    assert len(scene.callers._histories) == 1
