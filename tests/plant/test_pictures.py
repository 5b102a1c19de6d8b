"""Kept photographs: found by heliostat and time, thinned by age, bounded; and visits asked for."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.layouts import lay_out
from heliotrope.files.disk import DiskBusyError
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.operations.pictures import KeptCamera, Pictures, PictureSettings
from heliotrope.plant.operations.views import CalibrationEntry, CameraView, PictureRow
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.plant.visits.photographs import Shot
from support.live import LiveOptions, LivePlant

DAY, NOW = 86_400.0, 1_700_000_000.0
NAN = float("nan")
VIEWER, OPERATOR = Person("vera", Role.VIEWER), Person("olga", Role.OPERATOR)


def entry(heliostat: str, at: float) -> CalibrationEntry:
    good = CalibrationOutcome.CALIBRATED
    return CalibrationEntry(
        at, heliostat, "left", good, 1.0, 0.1, 1.0, 0.1, NAN, NAN, 4, 4, "calibrated: well", 1
    )


def visit(pictures: Pictures, heliostat: str, at: float, sizes: tuple[int, ...] = (100,)) -> None:
    """A visit with photographs a second apart, of which the first cannot be used."""
    pictures.begin(heliostat)
    for k, size in enumerate(sizes):
        view = CameraView("left", k + 1, at + k, bytes([k]) * size, (f"reading {k}",))
        reasons = ("clipped",) if k == 0 and len(sizes) > 1 else ()
        pictures.take(heliostat, view, Shot(np.zeros(3), at + k, 0.0, reasons))
    pictures.conclude(entry(heliostat, at + len(sizes)))


def listed(pictures: Pictures, heliostat: str, limit: int = 100) -> list[PictureRow]:
    found: list[list[PictureRow] | Exception] = []
    pictures.find(heliostat, limit, found.append)
    assert not isinstance(found[0], Exception)
    return found[0]


def jpeg(pictures: Pictures, identity: int) -> bytes | Exception:
    found: list[bytes | Exception] = []
    pictures.read(identity, found.append)
    return found[0]


def test_each_is_found_with_the_result_of_its_visit(tmp_path: Path) -> None:
    visit(Pictures(tmp_path / "new"), "A", NOW, (100, 200, 300))
    again = Pictures(tmp_path / "new")  # the plant was started again
    rows = listed(again, "A")
    assert [row.at for row in rows] == [NOW + 2, NOW + 1, NOW]
    assert [row.used for row in rows] == [True, True, False]
    assert {(row.outcome, row.text, row.target) for row in rows} == {
        ("calibrated", "calibrated: well", "left")
    }
    assert rows[0].reading == ("reading 2",)
    assert jpeg(again, rows[0].identity) == b"\2" * 300
    assert listed(again, "A", 1) == rows[:1]
    assert listed(again, "B") == []
    assert isinstance(jpeg(again, 4711), UnknownNameError)


def test_a_visit_without_a_result_leaves_nothing_to_the_next(tmp_path: Path) -> None:
    pictures = Pictures(tmp_path)
    pictures.begin("A")
    pictures.take("A", CameraView("left", 1, NOW, b"lost"), Shot(np.zeros(3), NOW))
    visit(pictures, "A", NOW + 60.0)
    assert [row.at for row in listed(pictures, "A")] == [NOW + 60.0]


def test_they_are_thinned_by_age(tmp_path: Path) -> None:
    pictures = Pictures(tmp_path, PictureSettings(whole=10.0, last=100.0))
    midnight = NOW // DAY * DAY
    for days in range(120):
        for hour in (1, 2):
            visit(pictures, "A", midnight + days * DAY + 3600.0 * hour, (10, 10))
    last = midnight + 119 * DAY + 7200.0
    ages = [(last - row.at) / DAY for row in listed(pictures, "A", 2000)]
    assert max(ages) < 100.5
    old = [age for age in ages if age > 10.5]
    assert len({int(age) for age in old}) == len(old) > 80  # one a day, and it could be used
    assert all(row.used for row in listed(pictures, "A", 2000) if row.at < last - 11 * DAY)
    assert len([age for age in ages if age < 9.0]) > 30
    assert len(list(tmp_path.glob("*.jpg"))) == len(ages)


@pytest.mark.parametrize("most", [900.0, 1000.0])
def test_the_folder_is_bounded_and_the_oldest_go_first(tmp_path: Path, most: float) -> None:
    pictures = Pictures(tmp_path, PictureSettings(most=most))
    for k in range(12):
        visit(pictures, "AB"[k % 2], NOW + 60.0 * k, (150,))
    kept = sorted(row.at for name in "AB" for row in listed(pictures, name))
    assert kept == [NOW + 60.0 * k for k in range(6, 12)]
    assert sum(path.stat().st_size for path in tmp_path.glob("*.jpg")) == 900


def test_settings_that_contradict_each_other_are_refused() -> None:
    for wrong in ({"whole": 10.0, "last": 5.0}, {"most": 0.0}, {"whole": 0.0}):
        with pytest.raises(InputError, match="the days must be above 0"):
            PictureSettings(**wrong)


class Full:
    """A disk for which too much waits."""

    def do(self, work: object, then: object) -> None:
        raise DiskBusyError("1000 records are waiting to be written; check the disk")

    def close(self) -> None:
        pass


def test_those_of_a_joint_visit_are_kept_once_with_the_result_of_each(tmp_path: Path) -> None:
    pictures = Pictures(tmp_path)
    pictures.begin_coded("left")
    pictures.take_coded(CameraView("left", 1, NOW - 500.0, b"broken off"))
    pictures.begin_coded("left")
    for k in range(40):
        pictures.take_coded(CameraView("left", k + 2, NOW + k, bytes([k]) * 100, ("several",)))
    stuck = replace(
        entry("B", NOW + 60.0),
        outcome=CalibrationOutcome.NOT_PROVEN,
        new=0,
        text="unchanged: stuck",
    )
    pictures.conclude_coded("left", [entry("A", NOW + 60.0), stuck])
    again = Pictures(tmp_path)  # the plant was started again
    one, other = listed(again, "A"), listed(again, "B")
    # Of a long stack the last ones.
    assert [row.at for row in one] == [NOW + k for k in range(39, 7, -1)]
    assert [row.identity for row in one] == [row.identity for row in other]
    assert len(list(tmp_path.glob("*.jpg"))) == len(one)
    assert {(r.heliostat, r.used, r.outcome, r.text) for r in one} == {
        ("A", True, "calibrated", "calibrated: well")
    }
    assert {(r.heliostat, r.used, r.outcome, r.text) for r in other} == {
        ("B", False, "not_proven", "unchanged: stuck")
    }
    assert jpeg(again, one[0].identity) == bytes([39]) * 100
    assert listed(again, "") == []
    assert listed(again, "C") == []
    # A visit of its own stands among them, in the order of time.
    visit(again, "A", NOW + 20.5)
    assert [row.at for row in listed(again, "A", 20)][19:] == [NOW + 20.5]
    # A visit without photographs keeps nothing.
    again.conclude_coded("right", [entry("A", NOW + 90.0)])
    assert len(listed(again, "A")) == 33


def test_a_joint_visit_is_thinned_by_age_for_all_its_heliostats(tmp_path: Path) -> None:
    pictures = Pictures(tmp_path, PictureSettings(whole=1.0, last=10.0))
    for k in range(4):
        pictures.take_coded(CameraView("left", k + 1, NOW + k, b"x"))
    pictures.conclude_coded("left", [entry("A", NOW + 9.0), entry("B", NOW + 9.0)])
    visit(pictures, "C", NOW + 3.0 * DAY)
    assert [len(listed(pictures, name)) for name in "AB"] == [1, 1]
    visit(pictures, "C", NOW + 20.0 * DAY)
    assert [listed(pictures, name) for name in "AB"] == [[], []]


def test_a_disk_that_fails_costs_pictures_only(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    broken = Pictures(tmp_path / "file")
    visit(broken, "A", NOW)
    assert "pictures: " in broken.problem
    full = Pictures(tmp_path / "x", disk=Full())
    visit(full, "A", NOW)
    assert "1000 records are waiting" in full.problem
    found: list[object] = []
    full.find("A", 1, found.append)
    assert isinstance(found[0], DiskBusyError)


def test_only_new_photographs_are_kept(tmp_path: Path) -> None:
    class Camera:
        version = 0

        def view(self, target: str) -> CameraView:
            return CameraView(target, self.version, NOW + self.version, b"x")

        async def photograph(self, target: object, heliostat: str) -> Shot:
            self.version += heliostat == "A"  # of others it makes no picture
            return Shot(np.zeros(3), 0.0)

    pictures, camera = Pictures(tmp_path), Camera()
    kept, target = KeptCamera(camera, pictures), lay_out("radial", 3).targets[0]
    for name in ("A", "B", "A"):
        asyncio.run(kept.photograph(target, name))
    for name in ("A", "B"):
        pictures.conclude(entry(name, NOW))
    assert len(listed(pictures, "A")) == 2
    assert listed(pictures, "B") == []


# --- in a plant ---------------------------------------------------------------------------


def live(work: Callable[[LivePlant, Pictures], Awaitable[None]], folder: Path) -> None:
    pictures = Pictures(folder)

    async def main(clock: VirtualClock) -> None:
        plant = LivePlant(lay_out("radial", 4), clock, LiveOptions(threads=0), pictures=pictures)
        async with plant.running():
            await work(plant, pictures)
            await plant.end()

    run_virtual(main, start=datetime(2026, 10, 21, 9, tzinfo=UTC))


def test_a_heliostat_is_calibrated_when_it_is_asked_for(tmp_path: Path) -> None:
    async def work(plant: LivePlant, pictures: Pictures) -> None:
        operations, last = plant.operations, plant.names[-1]
        with pytest.raises(RefusedError, match="vera is viewer"):
            operations.calibrate(VIEWER, last)
        for wrong in ((("nobody", ""), "nobody"), ((last, "wall"), "wall")):
            with pytest.raises(UnknownNameError, match=wrong[1]):
                operations.calibrate(OPERATOR, *wrong[0])
        for name in plant.names[:-1]:  # so that the schedule would not choose it
            operations.automatic.want([name], wanted=name == plant.names[0])
        while not operations.automatic.view().on:
            await asyncio.sleep(1.0)
        operations.calibrate(OPERATOR, last, plant.design.targets[0].name)
        assert operations.automatic.view().asked == (last,)
        while not operations.automatic.view().results:
            await asyncio.sleep(1.0)
        while last not in {found.heliostat for found in operations.automatic.view().results}:
            await asyncio.sleep(1.0)
        (result, *_) = [r for r in operations.automatic.view().results if r.heliostat == last]
        assert operations.automatic.view().asked == ()
        # Its photographs are found from the sightings that they gave.
        rows = listed(pictures, last)
        times = [sighting.at for sighting in operations.viewer.heliostat(last).history]
        assert times
        for at in times:
            (one,) = [row for row in rows if abs(row.at - at) < 0.5]
            assert one.used
            assert one.outcome == result.outcome.name.lower()
            found = jpeg(pictures, one.identity)
            assert isinstance(found, bytes)
            assert found[:2] == b"\xff\xd8"
        # A person who takes it over takes the wish back.
        operations.calibrate(OPERATOR, last)
        operations.stow(OPERATOR, [last])
        assert operations.automatic.view().asked == ()
        with pytest.raises(RefusedError, match="it is not under automatic control"):
            operations.calibrate(OPERATOR, last)
        operations.take_authority(OPERATOR)
        with pytest.raises(RefusedError, match="olga has the command authority"):
            operations.calibrate(OPERATOR, plant.names[0])

    live(work, tmp_path)


def test_a_beam_is_searched_when_it_is_asked_for(tmp_path: Path) -> None:
    """The search ends once the camera has seen the beam move with its aim; nothing is learnt."""

    async def work(plant: LivePlant, pictures: Pictures) -> None:
        operations, last = plant.operations, plant.names[-1]
        for name in plant.names[:-1]:
            operations.automatic.want([name], wanted=name == plant.names[0])
        while not operations.automatic.view().on:
            await asyncio.sleep(1.0)
        operations.calibrate(OPERATOR, last, plant.design.targets[0].name, search=True)
        found: list[CalibrationEntry] = []
        while not found:
            await asyncio.sleep(1.0)
            found = [r for r in operations.automatic.view().results if r.heliostat == last]
        text = found[0].text
        assert text.startswith("searched: the beam misses its aim by "), text
        # As far as the true mirror of the twin stands off.
        said = float(text.split(", ")[1].split()[0])
        assert said == pytest.approx(2e3 * found[0].truth_before, rel=0.2, abs=1.0)
        rows = [row for row in listed(pictures, last) if row.text == text]
        assert len(rows) >= 2
        assert operations.viewer.heliostat(last).history == ()
        assert plant.plant.beliefs.record(last) is None

    live(work, tmp_path)


def test_a_photograph_is_taken_when_it_is_asked_for(tmp_path: Path) -> None:
    async def work(plant: LivePlant, pictures: Pictures) -> None:
        operations, target = plant.operations, plant.design.targets[0].name
        operations.switch_calibration(OPERATOR, False)
        before = operations.camera(target).version
        with pytest.raises(RefusedError, match="vera is viewer"):
            await operations.photograph(VIEWER, target)
        view = await operations.photograph(OPERATOR, target)
        assert view.version > before
        (row,) = listed(pictures, "")
        assert (row.target, row.text, row.at) == (target, "requested by olga", view.at)
        assert jpeg(pictures, row.identity) == view.jpeg

    live(work, tmp_path)
