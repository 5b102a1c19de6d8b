"""A calibration from false photographs leaves no mirror beside the receiver."""

from pathlib import Path

import numpy as np
import pytest

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.field.target import Target
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.mechanism.board_items import checksums
from heliotrope.plant.motion.proofs import PathProofs
from heliotrope.plant.visits import CalibrationCycle, CycleResult, CycleSettings
from heliotrope.plant.visits.photographs import Shot
from heliotrope.plant.visits.settings import Centring
from support.whole_plant import ENGINEER, WholePlant

NAME = "H1"
#: A light that is not the heliostat's beam, 3 m from the middle of the target.
FALSE = np.array([2.1, 0.0, 42.1])

#: A target on which a beam can be moved by more than the tolerance of its place.
WIDE = Target(
    "white",
    np.array([(4.0, 0.0, 44.0), (-4.0, 0.0, 44.0), (-4.0, 0.0, 36.0), (4.0, 0.0, 36.0)]),
    np.array([0.0, 0.0, 40.0]),
)


class Liar:
    """A camera whose first photographs show the same false light, the later ones the beam."""

    def __init__(self, whole: WholePlant, lies: int) -> None:
        self._whole, self._lies = whole, lies

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        shot = await self._whole.photograph(target, heliostat)
        self._lies -= 1
        return Shot(FALSE, shot.at, 1e-4) if self._lies >= 0 else shot


@pytest.mark.parametrize("lies", [3, 100])
def test_the_same_false_light_on_a_first_visit_changes_nothing(tmp_path: Path, lies: int) -> None:
    results: list[CycleResult] = []

    async def main(clock: VirtualClock) -> None:
        whole = WholePlant(clock, tmp_path, clusters=1)
        async with whole.alive():
            plant, token = whole.plant, whole.token
            assert await plant.aim(ENGINEER, token, plant.default_aims()).end(20.0)
            assert await plant.command(ENGINEER, token, "APPROACH").end(400.0)
            assert await plant.command(ENGINEER, token, "TRACK").end(30.0)
            await whole.wait(20.0)
            before = whole.miss(NAME)
            stored = await plant.stored(NAME)
            cycle = CalibrationCycle(plant, Liar(whole, lies), CycleSettings(interval=5.0))
            results.append(await cycle.run(ENGINEER, token, NAME, "white"))
            await whole.wait(20.0)
            assert whole.states()[NAME] == "TRACKING"
            assert whole.miss(NAME) < before + 0.1
            assert plant.beliefs.record(NAME) is None
            assert plant.beliefs.known(NAME) is None
            again = await plant.stored(NAME)
            assert {**again, "edition": 0} == {**stored, "edition": 0}
            wanted = plant.wanted.items[NAME]
            assert {item: stored[item] for item in wanted} == checksums(wanted)
            assert NAME not in plant.wanted.missing

    run_virtual(main, 1)
    (result,) = results
    assert result.outcome is CalibrationOutcome.NOT_VERIFIED, result.text
    assert "the old parameters are in use again" in result.text
    assert result.record is None


def test_new_parameters_go_back_where_no_way_to_their_photograph_is_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def blocked(self: PathProofs, *_: object) -> dict[str, str]:
        return dict.fromkeys([NAME] if self._earlier else [], "the beam enters walkway")

    monkeypatch.setattr(PathProofs, "_by_earlier", blocked)
    results: list[CycleResult] = []

    async def main(clock: VirtualClock) -> None:
        whole = WholePlant(clock, tmp_path, clusters=1)
        async with whole.alive():
            plant, token = whole.plant, whole.token
            assert await plant.command(ENGINEER, token, "APPROACH", (NAME,)).end(400.0)
            stored = await plant.stored(NAME)
            cycle = CalibrationCycle(plant, Liar(whole, 0), CycleSettings(interval=5.0))
            results.append(await cycle.run(ENGINEER, token, NAME, "white"))
            again = await plant.stored(NAME)
            assert {**again, "edition": 0} == {**stored, "edition": 0}
            assert again["edition"] > stored["edition"]  # others were written in between
            assert NAME not in plant.wanted.missing
            assert whole.states()[NAME] == "IDLE"

    run_virtual(main, 1)
    (result,) = results
    assert result.outcome is CalibrationOutcome.NOT_VERIFIED, result.text
    assert (
        "path to the verification photograph is not free: the beam enters walkway; the old"
        in result.text
    )


class Still:
    """A camera that sees one light that stands near the middle of the target, and no beam."""

    def __init__(self, whole: WholePlant) -> None:
        self._whole = whole

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        shot = await self._whole.photograph(target, heliostat)
        return Shot(np.asarray(target.point(np.array([0.5, 0.3]))), shot.at, 1e-4)


def test_light_that_no_photograph_shows_to_move_is_not_kept(tmp_path: Path) -> None:
    """Where the light was found, each photograph agrees with it, whatever light it is."""
    results: list[CycleResult] = []

    async def main(clock: VirtualClock) -> None:
        whole = WholePlant(clock, tmp_path, clusters=1, target=WIDE)
        async with whole.alive():
            plant, token = whole.plant, whole.token
            assert await plant.command(ENGINEER, token, "APPROACH").end(400.0)
            settings = CycleSettings(interval=5.0)
            cycle = CalibrationCycle(plant, Still(whole), settings, Centring(looks=1))
            results.append(await cycle.run(ENGINEER, token, NAME, "white"))
            assert plant.beliefs.known(NAME) is None

    run_virtual(main, 1)
    (result,) = results
    assert result.outcome is CalibrationOutcome.NO_PHOTOGRAPH, result.text
    assert "the light did not move with the aim" in result.rejected[-1]


def test_a_centred_visit_ends_with_the_photographs_that_are_asked_for(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> list[str]:
        whole = WholePlant(clock, tmp_path, clusters=1, target=WIDE)
        async with whole.alive():
            plant, token, stages = whole.plant, whole.token, list[str]()
            assert await plant.command(ENGINEER, token, "APPROACH").end(400.0)
            cycle = CalibrationCycle(plant, whole, CycleSettings(interval=5.0), Centring())
            result = await cycle.run(ENGINEER, token, NAME, "white", stages.append)
            assert result.new >= 3, result.text
        return [stage for stage in stages if stage.startswith("photograph")]

    assert run_virtual(main, 1) == ["photograph 1", "photograph 2", "photograph 3"]


class Passing:
    """A camera that sees a light which follows the aim once, and then is gone."""

    def __init__(self, whole: WholePlant, stage: list[str]) -> None:
        self._whole, self._stage, self.looks = whole, stage, list[float]()

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        shot, plant = await self._whole.photograph(target, heliostat), self._whole.plant
        aim = plant.aims[plant.field.place(heliostat)]
        if self._stage[-1] == "first look":
            self.looks.append(float(np.linalg.norm(aim - target.center)))
        if self._stage[-1] in ("first look", "photograph 1", "photograph 2"):
            return Shot(aim + np.array([0.2, 0.0, 0.2]), shot.at, 1e-4)
        return Shot(np.full(3, np.nan), shot.at, 1e-4, ("no beam on the target",))


def test_light_that_followed_its_aim_once_and_is_gone_is_not_kept(tmp_path: Path) -> None:
    results: list[CycleResult] = []

    async def main(clock: VirtualClock) -> None:
        whole = WholePlant(clock, tmp_path, clusters=1, target=WIDE)
        async with whole.alive():
            plant, token = whole.plant, whole.token
            assert await plant.command(ENGINEER, token, "APPROACH").end(400.0)
            stage = [""]
            camera = Passing(whole, stage)
            cycle = CalibrationCycle(plant, camera, CycleSettings(interval=5.0), Centring(looks=2))
            results.append(await cycle.run(ENGINEER, token, NAME, "white", stage.append))
            assert plant.beliefs.known(NAME) is None
            # Each look begins in the middle, wherever the photographs before it ended.
            assert np.allclose(camera.looks, 0.0, atol=0.05)
            assert len(camera.looks) == 2

    run_virtual(main, 1)
    (result,) = results
    assert result.outcome is CalibrationOutcome.NO_PHOTOGRAPH, result.text
    assert "did not move with the aim often enough" in result.rejected[-1]
