"""Appendix A of HelioPoint: a dome flight over coded targets shows the accuracy of RTK."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from heliotrope.airborne.coded_targets import CELLS, square_target, target_sheet, white_cells
from heliotrope.airborne.evaluate.coded import SeenTargets, find_targets, read_targets
from heliotrope.airborne.evaluate.photogrammetry import (
    Photogrammetry,
    compared,
    locate,
    relative,
    usable,
)
from heliotrope.airborne.evaluate.rtk import RtkCheck, check_rtk_by_targets
from heliotrope.airborne.photo import LedCamera, Photo, read_camera, read_photos
from heliotrope.airborne.plan.dome import Dome, plan_dome
from heliotrope.airborne.simulate.ground_targets import DomeFlight, fly_dome, render_dome
from heliotrope.airborne.simulate.rendering import Conditions
from heliotrope.airborne.simulate.simulation import Errors, miscalibrated
from heliotrope.cli.drone.dome import dome as dome_command
from heliotrope.cli.drone.rtk import rtk as rtk_command
from heliotrope.errors import InputError
from heliotrope.field.formats import plant_file
from heliotrope.geometry import rotation
from support.drone_case import ORIGIN, field, plant

MM = 1e-3
RTK = (0.006, 0.006, 0.008)


def lens(width: int = 800, height: int = 600) -> LedCamera:
    f = 0.875 * width
    matrix = np.array([[f, 0, 0.5 * width], [0, f, 0.5 * height], [0, 0, 1.0]])
    return LedCamera((width, height), matrix, np.array([-0.08, 0.06, 3e-4, -2e-4, -0.01]))


def small_dome(photographs: int = 16) -> Dome:
    return plan_dome(
        [10.0, 20.0, 0.0],
        radius=10.0,
        elevations=np.radians([45.0, 60.0, 75.0]),
        photographs=photographs,
        targets=9,
        side=0.7,
    )


@dataclass(frozen=True)
class Case:
    folder: Path
    flown: DomeFlight
    photos: tuple[Photo, ...]
    seen: tuple[SeenTargets, ...]
    camera: LedCamera


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """Return a rendered dome flight whose camera file is 0.5 px off at the corner."""
    folder = tmp_path_factory.mktemp("dome")
    errors = Errors(rtk=RTK, rtk_offset=(0.05, -0.02, 0.03), lens=0.5, hover=0.1)
    flown = fly_dome(small_dome(), lens(), errors, seed=1)
    render_dome(flown, folder, ORIGIN, conditions=Conditions(speed=1.0), seed=1)
    photos, problems = read_photos(folder, ORIGIN)
    assert problems == ()
    camera = read_camera(folder / "camera.toml")
    return Case(folder, flown, photos, read_targets(photos, camera), camera)


def true_corners(case: Case, k: int) -> dict[int, np.ndarray]:
    taken, camera = case.flown.taken[k], case.flown.camera
    return {t.number: taken.pixels(camera, t.corners) for t in case.flown.targets}


def test_targets_are_told_apart_and_their_corners_found(case: Case) -> None:
    gaps, found = [], 0
    for k, seen in enumerate(case.seen):
        assert seen.problem == ""
        true = true_corners(case, k)
        found += len(seen.number)
        for number, corners in zip(seen.number.tolist(), seen.corners, strict=True):
            gaps.append(corners - true[number])
    assert found > 0.8 * 9 * len(case.seen)
    # In the order of the pattern: a turned target would be off by its side.
    assert np.abs(gaps).max() < 0.5
    assert np.sqrt(np.mean(np.square(gaps))) < 0.08


@pytest.fixture(scope="module")
def checked(case: Case) -> tuple[RtkCheck, Photogrammetry]:
    check, found, problems = check_rtk_by_targets(case.photos, case.seen, case.camera)
    assert problems == ()
    return check, found


def test_photogrammetry_is_right_to_less_than_a_millimetre(
    case: Case, checked: tuple[RtkCheck, Photogrammetry]
) -> None:
    check, found = checked
    true = np.array([p.position for p in case.flown.taken])
    error, _ = compared(true, found.position)
    assert (error.std(axis=0) < 1.0 * MM).all()
    assert (check.photogrammetry < 1.5 * MM).all()
    # Its own statement holds, within chance of 17 photographs.
    assert 0.2 < np.mean((error / found.position_sigma) ** 2) < 2.0
    assert found.deviation < 1.5


def test_rtk_scatters_as_it_does(case: Case, checked: tuple[RtkCheck, Photogrammetry]) -> None:
    check, _ = checked
    pairs = zip(case.flown.recorded, case.flown.taken, strict=True)
    true = np.std([r.position - t.position for r, t in pairs], axis=0, ddof=1)
    np.testing.assert_allclose(check.rtk, true, rtol=0.25)
    assert (check.rtk_range[0] < true).all()
    assert (check.rtk_range[1] > true).all()
    # Where the targets lie is not known, so a common offset is not either.
    assert np.isnan(check.mean).all()


def test_an_rtk_without_errors_is_seen_to_have_none(case: Case) -> None:
    exact = tuple(
        replace(p, position=t.position) for p, t in zip(case.photos, case.flown.taken, strict=True)
    )
    check, _, _ = check_rtk_by_targets(exact, case.seen, case.camera)
    assert (check.sigma < 1.5 * MM).all()
    assert (check.rtk < 1.0 * MM).all()


def test_the_lens_need_not_be_known_well(case: Case) -> None:
    wrong = miscalibrated(case.flown.camera, 12.0)
    matrix = wrong.matrix + np.array([[2.0, 0, 3.0], [0, 2.0, -2.0], [0, 0, 0]])
    found = locate(case.photos, case.seen, replace(wrong, matrix=matrix))
    true = np.array([p.position for p in case.flown.taken])
    assert (compared(true, found.position)[0].std(axis=0) < 1.0 * MM).all()
    # The targets fill the middle of the frame, and there the lens is found.
    local = np.array([[x, y, 1.0] for x in (-0.3, 0.0, 0.3) for y in (-0.2, 0.0, 0.2)])
    shown = [
        cv2.projectPoints(local[:, None], np.zeros(3), np.zeros(3), c.matrix, c.distortion)[0]
        for c in (case.flown.camera, found.camera)
    ]
    # The principal point and a turn of all photographs are hardly told apart.
    gap = shown[1] - shown[0]
    assert np.abs(gap - gap.mean(axis=0)).max() < 0.3


def test_false_targets_are_left_out(case: Case) -> None:
    picture = cv2.imread(str(case.photos[0].path))
    once = find_targets(picture)
    both = np.concatenate([picture, picture], axis=0)
    assert "coded targets are smaller" in find_targets(both).problem
    small = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    assert len(find_targets(small).number) < len(once.number)
    assert find_targets(np.full((60, 80, 3), 90, np.uint8)).problem == (
        "there is no coded target in it"
    )


def test_too_few_photographs_or_targets_are_refused(case: Case) -> None:
    with pytest.raises(InputError, match="7 photographs show coded targets; 8 are needed"):
        locate(case.photos[:7], case.seen[:7], case.camera)
    few = [
        SeenTargets(s.number[k], s.corners[k], s.sigma[k])
        for s in case.seen
        for k in [np.isin(s.number, [3, 4, 5])]
    ]
    with pytest.raises(InputError, match="3 coded targets are seen in two photographs or more"):
        locate(case.photos, few, case.camera)
    empty = SeenTargets(np.empty(0, np.intp), np.empty((0, 4, 2)), np.empty(0), "dark")
    good, wrong = usable([empty, *case.seen[1:]])
    assert good == list(range(1, len(case.seen)))
    assert wrong == {0: "dark"}
    with pytest.raises(InputError, match=r"the first of the others: DJI_0001.JPG: dark"):
        check_rtk_by_targets(case.photos, [empty] * len(case.seen), case.camera)


def test_a_similarity_is_taken_off() -> None:
    rng = np.random.default_rng(2)
    place = rng.normal(0.0, 5.0, (12, 3))
    turned = rotation([0.6, 0.0, 0.8], 0.3)
    gap, scale = compared(1.1 * place @ turned.T + [1.0, 2.0, 3.0], place)
    assert scale == pytest.approx(1.1)
    np.testing.assert_allclose(gap, 0.0, atol=1e-12)
    free = relative(place)
    np.testing.assert_allclose(free @ free, free, atol=1e-12)
    assert np.trace(free) == pytest.approx(36.0 - 7.0)
    small = np.cross([1e-3, -2e-3, 1e-3], place) + 1e-3 * place + [0.1, 0.0, 0.2]
    np.testing.assert_allclose(free @ small.reshape(-1), 0.0, atol=1e-12)


# -- plan ------------------------------------------------------------------------------


def test_a_dome_sees_its_targets_from_all_sides() -> None:
    dome = plan_dome([5.0, -3.0, 1.0])
    away = dome.position - dome.center
    np.testing.assert_allclose(np.linalg.norm(away, axis=-1), 15.0)
    ahead = dome.rotation[:, :, 2]
    np.testing.assert_allclose(ahead, -away / 15.0, atol=1e-12)
    azimuth = np.sort(np.arctan2(away[:, 0], away[:, 1]))
    assert np.diff(azimuth).max() < np.radians(30.0)
    assert len(np.unique(np.round(away[:, 2], 6))) == 4
    assert len(dome.targets) == 25
    sides = np.linalg.norm(dome.targets[3].corners - np.roll(dome.targets[3].corners, 1, 0), axis=1)
    np.testing.assert_allclose(sides, 0.4)
    for wrong in ({"radius": 1.0}, {"targets": 2}, {"photographs": 3}, {"spacing": 0.2}):
        with pytest.raises(InputError, match=f"dome: {next(iter(wrong))} "):
            plan_dome([0, 0, 0], **wrong)
    with pytest.raises(InputError, match="use two or more from 15 to 88"):
        plan_dome([0, 0, 0], elevations=[0.1, 0.5])


def test_a_printed_sheet_is_read_as_its_number() -> None:
    for number in (0, 17, 249):
        cells = white_cells(number)
        assert not cells[[0, -1]].any()
        assert not cells[:, [0, -1]].any()
        sheet = target_sheet(number, 300.0)
        assert sheet.count('fill="white"') == 1 + int(cells.sum())
        assert 'width="400.000mm"' in sheet
        picture = np.full((40 * (CELLS + 2),) * 2, 255, np.uint8)
        picture[40:-40, 40:-40] = np.kron(np.where(cells, 255, 0), np.ones((40, 40)))
        seen = find_targets(np.repeat(picture[..., None], 3, axis=2))
        assert seen.number.tolist() == [number]
        np.testing.assert_allclose(
            seen.corners[0], [[39.5, 39.5], [279.5, 39.5], [279.5, 279.5], [39.5, 279.5]], atol=0.1
        )
    with pytest.raises(InputError, match="target 250: numbers run from 0 to 249"):
        white_cells(250)
    one = square_target(1, [0, 0, 0], 0.6, [1, 0, 0], [0, -1, 0])
    np.testing.assert_allclose(one.at(CELLS, CELLS), one.corners[2])


# -- commands --------------------------------------------------------------------------

app = typer.Typer()
app.command("dome")(dome_command)
app.command("rtk")(rtk_command)


def run(*arguments: object):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_dome_command_writes_what_is_needed(tmp_path: Path) -> None:
    plant_file.write_plant(plant(field(1, 1)), tmp_path / "plant.toml")
    done = run(
        "dome", tmp_path / "plant.toml", "--into", tmp_path / "d", "--at", "0,-40,0",
        "--targets", 4, "--photographs", 12, "--simulate", "--size", "160x120",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    for name in ("dji/dome.kmz", "qgc/dome.plan", "litchi/dome.csv", "targets/target-003.svg"):
        assert (tmp_path / "d" / name).exists()
    assert len((tmp_path / "d/targets.csv").read_text().splitlines()) == 5
    items = json.loads((tmp_path / "d/qgc/dome.plan").read_text())["mission"]["items"]
    assert len(items) >= 16
    photos, problems = read_photos(tmp_path / "d/photographs", ORIGIN)
    # Each ring has four at least.
    assert (len(photos) >= 16, problems) == (True, ())
    wrong = run("dome", tmp_path / "plant.toml", "--elevations", "high")
    assert "use angles from 0 to 90 degrees, such as 35,50,65,80" in str(wrong.exception)


def test_rtk_command_by_targets(case: Case, tmp_path: Path) -> None:
    plant_file.write_plant(plant(field(1, 1)), tmp_path / "plant.toml")
    common = ("--field", tmp_path / "plant.toml", "--targets", "--out", tmp_path / "out")
    done = run("rtk", case.folder, *common)
    assert done.exit_code == 0, done.output
    assert f"{len(case.photos)} photographs, mm" in done.stdout
    assert "–" in done.stdout
    drawn = (tmp_path / "out/rtk.svg").read_text()
    for axis in ("x (east)", "y (north)", "z (up)"):
        assert f"{axis}: RTK" in drawn
    told = json.loads(run("rtk", case.folder, *common, "--json").stdout)
    assert told["common_offset_m"] == [None, None, None]
    assert max(told["photogrammetry_sigma_m"]) < 1.5 * MM
