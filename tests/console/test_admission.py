"""Ordinary orders are bounded for each person and in all; safe ones never are."""

import contextlib
from collections.abc import Callable, Iterator

import httpx
import pytest

from heliotrope.plant.interface.admission import Admission, BusyError
from heliotrope.plant.interface.calls import CALLS
from heliotrope.plant.orders.authority import Person, Role
from support.live_console import LiveConsole

Ask = Callable[..., httpx.Response]
ADA, GRACE = Person("ada", Role.OPERATOR), Person("grace", Role.OPERATOR)


def admitted(admission: Admission, person: Person, call: str = "aim", times: int = 100) -> int:
    """Return how many of the next calls are admitted."""
    count = 0
    for _ in range(times):
        with contextlib.suppress(BusyError):
            admission.admit(call, person)
            count += 1
    return count


def test_each_person_has_a_share() -> None:
    now = [0.0]
    admission = Admission(lambda: now[0], own=(2.0, 5.0), everybody=(4.0, 8.0))
    assert admitted(admission, ADA) == 5
    assert admitted(admission, GRACE) == 3  # all have had eight
    with pytest.raises(BusyError, match=r"aim: too many orders from ada.*try again in 1 s"):
        admission.admit("aim", ADA)
    with pytest.raises(BusyError, match="from all users"):
        admission.admit("aim", Person("hedy", Role.ENGINEER))
    now[0] = 1.0
    assert admitted(admission, ADA) == 2
    assert admitted(admission, GRACE) == 2


def test_what_is_counted() -> None:
    """Every order but the safe ones, and those that keep or give back the authority."""
    free = {"keep_authority", "release_authority", "order_emergency", "stow", "defocus"}
    orders = {name for name, call in CALLS.items() if call.role >= Role.OPERATOR} - free
    assert {name for name, call in CALLS.items() if call.counted} == orders
    assert {"command", "aim", "calibrate", "take_authority", "hold"} <= orders
    none = Admission(lambda: 0.0, own=(1.0, 0.0), everybody=(1.0, 0.0))
    assert admitted(none, ADA, "aim", 3) == 0


@pytest.fixture
def busy(console: LiveConsole) -> Iterator[None]:
    """A plant that admits two orders, and then none."""
    before = console.interface.admission
    console.interface.admission = Admission(lambda: 0.0, own=(1.0, 2.0))
    yield
    console.interface.admission = before
    console.calm()


def test_a_flood_of_orders_is_refused_and_safe_ones_are_not(
    console: LiveConsole, busy: None, ask: Ask
) -> None:
    del busy
    order = {"condition": "nothing", "subject": ""}
    seen = [ask("operator", "POST", "alarms/acknowledge", order) for _ in range(4)]
    assert [one.status_code == 429 for one in seen] == [False, False, True, True]
    assert seen[-1].headers["retry-after"] == "1"
    detail = seen[-1].json()["detail"]
    assert "too many orders from operator" in detail
    assert "\n" not in detail
    # Somebody else goes on, and a safe order of the same person too.
    other = ask("engineer", "POST", "alarms/acknowledge", order)
    assert other.status_code != 429
    for path in ("stow", "defocus", "emergency"):
        body = {"reason": "x"} if path == "emergency" else {"heliostats": [console.live.names[0]]}
        for _ in range(4):
            assert ask("operator", "POST", path, body).status_code == 200, path
