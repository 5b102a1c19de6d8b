"""The photographs of a coded visit: turns of the codes, their limit, and the usual light."""

import asyncio
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.visits import JointCycle, ReceiverCycle, coded_cycle
from heliotrope.plant.visits.coded_cycle import Light
from heliotrope.plant.visits.target_light import Exposed, TargetLight

#: Photographs in a turn of the codes.
NEEDED = 8


def picture(brightness: float = 1.0) -> TargetLight:
    seen = np.ones((2, 2), dtype=np.bool_)
    return TargetLight(np.full((2, 2), brightness), 0.1, np.zeros(2), seen, 1.0, 0.0)


def photographed(
    monkeypatch: pytest.MonkeyPatch,
    kind: type[JointCycle] | type[ReceiverCycle],
    again: float,
    *,
    leaves: Callable[[int], bool] = lambda count: False,
    brightness: Callable[[int], float] = lambda count: 1.0,
) -> tuple[list[int], list[int]]:
    """Return the numbers of the aims that were given, and of the photographs that are left."""
    monkeypatch.setattr(coded_cycle.Standing, "of", lambda field: None)
    aims: list[int] = []
    left: list[int] = []

    async def main(clock: VirtualClock) -> None:
        async def look() -> None:
            await asyncio.sleep(0.25)

        async def leave() -> bool:
            return leaves(len(aims))

        async def exposed(face: Any, light: Light) -> Exposed:
            return Exposed.read(picture(brightness(len(aims))))

        async def move(points: Any) -> None:
            aims.append(points)

        visit: Any = SimpleNamespace(
            visits={"A": None}, names=("A",), lost={}, target=SimpleNamespace(name="left"),
            look=look, leave=leave, drop=lambda why: None, missing=lambda state: {}, astray=False,
        )  # fmt: skip
        layout: Any = SimpleNamespace(moves=np.zeros((NEEDED, 1, 2)), points=lambda number: number)
        plant = SimpleNamespace(
            now=clock.monotonic, field=None, movements=SimpleNamespace(end=lambda names: None)
        )
        settings: Any = SimpleNamespace(again=again, settle=1.0)
        cycle = kind(plant, None, None, settings)  # type: ignore[arg-type]
        monkeypatch.setattr(cycle, "_exposed", exposed)
        light = Light(usual=None if kind is JointCycle else 1.0, steady=0.05)
        with coded_cycle._Taken.of(layout) as taken:
            await cycle._photograph(visit, layout, light, taken, move, lambda stage: None)
            left.extend(number for number, _ in taken.pictures)

    run_virtual(main)
    return aims, left


def test_a_turn_of_the_codes_begins_anew_with_the_next_number(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    aims, left = photographed(monkeypatch, JointCycle, 2.5, leaves=lambda count: count == 3)
    assert left == aims[3:] == [3, 4, 5, 6, 7, 0, 1, 2]
    assert aims[:3] == [0, 1, 2]


def test_a_visit_that_heliostats_leave_again_and_again_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(RefusedError, match="joint visit to left: 10 photographs were taken, and"):
        photographed(monkeypatch, JointCycle, 1.3, leaves=lambda count: count % 2 == 1)


def test_a_photograph_in_other_light_is_taken_again(monkeypatch: pytest.MonkeyPatch) -> None:
    aims, left = photographed(
        monkeypatch, ReceiverCycle, 1.5, brightness=lambda count: 0.7 if count == 3 else 1.0
    )
    assert left == list(range(NEEDED))
    assert aims == [0, 1, 2, 2, 3, 4, 5, 6, 7]


def test_a_turn_begins_anew_in_light_that_has_changed_for_good(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A mirror of a small field has come: its light stays, and nothing else has changed."""
    aims, left = photographed(
        monkeypatch, ReceiverCycle, 2.0, brightness=lambda count: 1.0 if count < 4 else 1.17
    )
    assert aims[:5] == [0, 1, 2, 3, 3]
    assert left == aims[5:] == [3, 4, 5, 6, 7, 0, 1, 2]


def test_changing_light_ends_the_photographs_at_their_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    aims, left = photographed(
        monkeypatch, ReceiverCycle, 1.5, brightness=lambda count: 0.7 if count % 2 else 1.0
    )
    assert len(aims) == 12
    assert left == [0, 1, 2, 3, 4, 5]


def test_the_usual_light_follows_the_sun_and_no_cloud() -> None:
    async def scene() -> None:
        light = Light(usual=1.0, steady=0.05)
        assert await light.shown(Exposed.read(picture(1.04)))
        assert light.usual == pytest.approx(1.008)
        assert not await light.shown(Exposed.read(picture(1.08)))
        assert not await light.shown(Exposed.read(picture(float("nan"))))
        assert light.usual == pytest.approx(1.008)
        # A target may have any light; a photograph that is not read yet is not waited for.
        unread: asyncio.Future[TargetLight] = asyncio.get_running_loop().create_future()
        assert await Light().shown(Exposed(0.0, unread))

    asyncio.run(scene())
