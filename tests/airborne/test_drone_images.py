"""From rendered photographs to orientations: nothing is known but files and field."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from heliotrope.airborne.evaluate import evaluation, reading, rtk
from heliotrope.airborne.evaluate.bundle import Priors
from heliotrope.airborne.evaluate.detection import decode, find_outlines, find_patches, find_spots
from heliotrope.airborne.evaluate.identification import identify, rotation_angle
from heliotrope.airborne.evaluate.orientation import measure_field, rotation_between
from heliotrope.airborne.evaluate.reading import PhotoReading, look, read_photo
from heliotrope.airborne.evaluate.reflections import Reflections
from heliotrope.airborne.mirror import ideal
from heliotrope.airborne.photo import (
    Photo,
    gimbal_of_rotation,
    read_camera,
    read_photos,
    rotation_of_gimbal,
)
from heliotrope.airborne.simulate import rendering
from heliotrope.airborne.simulate.simulation import Errors, Flight, exact_reflections
from heliotrope.airborne.standing import MirrorPoses, standing
from heliotrope.cli.drone.evaluate import evaluate as evaluate_command
from heliotrope.cli.drone.rtk import rtk as rtk_command
from heliotrope.cli.drone.simulate import simulate as simulate_command
from heliotrope.errors import FormatError, InputError
from heliotrope.field.formats import plant_file
from support.drone_case import ORIGIN, camera, field, flight, plant

OFFSET = (0.018, -0.018, 0.016)
MRAD = 1e-3


@dataclass(frozen=True)
class Case:
    folder: Path
    flown: Flight
    exact: Reflections
    photos: tuple[Photo, ...]
    stand: MirrorPoses
    seen: tuple[PhotoReading, ...]


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> Case:
    folder = tmp_path_factory.mktemp("flight")
    errors = Errors(survey=0.001, rtk_offset=OFFSET)
    flown = flight(errors, columns=4, rows=4, step=0.65, lens=camera(1000, 750))
    exact = rendering.render_flight(flown, folder, ORIGIN, seed=1)
    plant_file.write_plant(plant(flown.heliostats), folder / "plant.toml")
    photos, problems = read_photos(folder, ORIGIN)
    assert problems == ()
    stand = standing(flown.heliostats, flown.counts)
    seen = reading.read_many(photos, read_camera(folder / "camera.toml"), stand)
    return Case(folder, flown, exact, photos, stand, seen)


def true_spots(case: Case, k: int) -> dict[int, np.ndarray]:
    """Pixels of all true reflections in photograph k by heliostat."""
    found: dict[int, np.ndarray] = {}
    mine = case.exact.take(np.flatnonzero(case.exact.photo == k))
    taken = case.flown.taken[k]
    for row in np.unique(mine.heliostat).tolist():
        one = mine.of(row)
        point = case.flown.shapes[row].point_at(one.facet, one.xy)
        there = case.flown.truth.vertex[row] + point @ case.flown.truth.rotation[row].T
        found[row] = taken.pixels(case.flown.camera, there)
    return found


def test_every_photograph_is_identified(case: Case) -> None:
    assert [s.problem for s in case.seen] == [""] * 16
    for seen, taken in zip(case.seen, case.flown.taken, strict=True):
        # The gimbal was off by 9 mrad.
        assert np.arccos(0.5 * (np.trace(seen.rotation.T @ taken.rotation) - 1.0)) < 1.0 * MRAD
        assert seen.mirror.tolist() == list(range(20))


def test_corners_are_found_to_a_fraction_of_a_pixel(case: Case) -> None:
    lens, errors, whole = case.flown.camera, [], 0
    for seen, taken in zip(case.seen, case.flown.taken, strict=True):
        local = (case.flown.truth.corners - taken.position) @ taken.rotation
        true = local[..., :2] / local[..., 2:]
        good = np.isfinite(seen.corners).all(axis=(1, 2))
        whole += int(good.sum())
        errors.append((seen.corners - true[seen.mirror])[good] * lens.focal)
    assert whole > 0.97 * 16 * 20
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) < 0.2


def test_spots_belong_to_their_mirrors(case: Case) -> None:
    right = wrong = matched = there = 0
    gaps = []
    for k, seen in enumerate(case.seen):
        true = true_spots(case, k)
        local = np.concatenate([seen.spot, np.ones((len(seen.spot), 1))], axis=-1)
        taken = case.flown.taken[k]
        away = taken.position + 10.0 * local @ taken.rotation.T
        pixels = taken.pixels(case.flown.camera, away)
        for row, pixel in zip(seen.spot_mirror.tolist(), pixels, strict=True):
            off = np.linalg.norm(true.get(row, np.full((1, 2), 1e9)) - pixel, axis=-1).min()
            right, wrong = right + (off < 3.0), wrong + (off >= 3.0)
            gaps.append(off)
        there += len(true)
        matched += len(set(true) & set(seen.spot_mirror.tolist()))
    assert right / (right + wrong) > 0.995
    assert matched > 0.93 * there
    assert np.median(gaps) < 0.25


def test_orientations_are_those_of_the_truth(case: Case) -> None:
    flown = case.flown
    found = evaluation.evaluate(
        case.photos,
        case.seen,
        flown.camera,
        case.stand,
        lambda i: ideal(flown.heliostats, i),
        priors=Priors(position=0.001),
    )
    error = found.adjusted.state.offset - OFFSET
    assert (np.abs(error) < 4.0 * np.sqrt(np.diag(found.adjusted.offset_covariance))).all()
    for slopes, limit in ((False, 0.30), (True, 0.20)):
        measured = measure_field(
            found.reflections,
            case.stand.names,
            flown.shapes.__getitem__,
            case.stand.rotation,
            found.stand.vertex,
            slopes=slopes,
        )
        off = [
            rotation_between(o.rotation, flown.truth.rotation[o.heliostat])[:2]
            for o in measured.found
            if o.count >= 4
        ]
        assert len(off) > 15
        assert np.sqrt(np.mean(np.square(off))) < limit * MRAD


def test_what_was_read_is_not_read_again(case: Case, tmp_path, monkeypatch) -> None:
    photos, lens = case.photos[:2], case.flown.camera
    first = reading.read_many(photos, lens, case.stand, keep=tmp_path)
    (tmp_path / next(tmp_path.iterdir()).name).write_bytes(b"damaged")
    told: list[tuple[int, int]] = []
    calls = []

    def read(photo: Photo, *rest) -> PhotoReading:
        calls.append(photo.name)
        return read_photo(photo, *rest)

    monkeypatch.setattr(reading, "read_photo", read)
    again = reading.read_many(
        photos, lens, case.stand, keep=tmp_path, progress=lambda a, b: told.append((a, b))
    )
    assert len(calls) == 1
    assert told == [(1, 2), (2, 2)]
    for one, two in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.spot, two.spot)
        assert one.notes == two.notes
    # Another field: nothing that is kept fits.
    moved = replace(case.stand, vertex=case.stand.vertex + 1.0)
    calls.clear()
    reading.read_many(photos, lens, moved, keep=tmp_path)
    assert len(calls) == 2


def picture_of(case: Case, tmp_path: Path, picture: np.ndarray, name: str = "x.jpg") -> Photo:
    rendering.write_photo(tmp_path / name, picture, case.photos[0], ORIGIN)
    return replace(case.photos[0], name=name, path=tmp_path / name)


def test_pictures_that_show_no_field_say_so(case: Case, tmp_path) -> None:
    lens, stand = case.flown.camera, case.stand
    rng = np.random.default_rng(1)
    noise = rng.integers(60, 110, (750, 1000, 3)).astype(np.uint8)
    assert read_photo(picture_of(case, tmp_path, noise), lens, stand).problem.startswith("nothing")
    white = np.full((750, 1000, 3), 255, np.uint8)
    assert (
        "overexposed: 100 %" in read_photo(picture_of(case, tmp_path, white), lens, stand).problem
    )
    small = read_photo(picture_of(case, tmp_path, noise[:600]), lens, stand)
    assert "1000 × 600 px, but the camera file says 1000 × 750 px" in small.problem
    broken = tmp_path / "broken.jpg"
    broken.write_bytes(case.photos[0].path.read_bytes()[:40_000])
    cut = read_photo(replace(case.photos[0], path=broken), lens, stand)
    assert "the file ends after 40000 bytes" in cut.problem
    there = case.photos[0].position
    far = replace(stand, vertex=there + 9.0 * (stand.vertex - there))
    assert read_photo(case.photos[0], lens, far).problem.startswith("small: mirrors are")
    behind = replace(stand, vertex=stand.vertex - [0.0, 500.0, 0.0])
    assert read_photo(case.photos[0], lens, behind).problem.startswith("wrong_field")
    with pytest.raises(FormatError, match="cannot be read"):
        decode(tmp_path / "none.jpg")


def test_wrong_field_is_not_believed(case: Case) -> None:
    rng = np.random.default_rng(7)
    other = replace(case.stand, vertex=case.stand.vertex + rng.uniform(-4, 4, (20, 3)) * [1, 1, 0])
    assert read_photo(case.photos[0], case.flown.camera, other).problem


@pytest.mark.parametrize(
    ("degrees", "found"),
    # A turn by 8.6° brings each mirror of a ring before the next one.
    [((8.7, 0.0), True), ((-8.7, 0.0), True), ((0.0, -8.7), True), ((12.2, 0.0), False)],
)
def test_a_gimbal_far_off_is_found_or_refused(
    case: Case, degrees: tuple[float, float], found: bool
) -> None:
    true = case.flown.taken[5].rotation
    yaw, pitch, roll = gimbal_of_rotation(true)
    wrong = rotation_of_gimbal(yaw + np.radians(degrees[0]), pitch + np.radians(degrees[1]), roll)
    photo = replace(case.photos[5], rotation=wrong)
    seen = read_photo(photo, case.flown.camera, case.stand)
    if found:
        assert seen.problem == ""
        assert rotation_angle(seen.rotation, true) < 1.0 * MRAD
        assert seen.mirror.tolist() == list(range(20))
    else:
        assert "the gimbal may be more than 4° off; check the gimbal angles" in seen.problem
        assert "heliotrope drone match" in seen.why_unused()


def test_regular_field_without_edges_is_ambiguous() -> None:
    # Through a long lens from straight above, an endless grid fits wherever the camera looks.
    lens = camera(1000, 750)
    lens.matrix[:2, :2] *= 3.0
    photo = Photo("a", None, np.array([0.3, 0.2, 60.0]), rotation_of_gimbal(0.0, -np.pi / 2, 0.0))
    grid = np.stack(np.meshgrid(np.arange(-18, 19), np.arange(-18, 19)), -1).reshape(-1, 2) * 3.0
    n = len(grid)
    many = MirrorPoses(
        tuple(str(i) for i in range(n)),
        np.pad(grid, ((0, 0), (0, 1))),
        np.repeat(np.eye(3)[None], n, 0),
        np.repeat([[[-1.0, 1, 0], [1.0, 1, 0], [1.0, -1, 0], [-1.0, -1, 0]]], n, 0),
    )
    seen = photo.pixels(lens, many.vertex)
    inside = (seen > 0).all(axis=1) & (seen < np.array(lens.size) - 1).all(axis=1)
    assert identify(lens, photo, many, seen[inside]).reason.startswith("ambiguous")
    # If it is not quite regular there is but one place.
    off = np.random.default_rng(1).uniform(-0.5, 0.5, (n, 3)) * [1.0, 1.0, 0.0]
    uneven = replace(many, vertex=many.vertex + off)
    seen = photo.pixels(lens, uneven.vertex)
    assert identify(lens, photo, uneven, seen[inside]).reason == ""


def test_without_lamp_the_campaign_says_so(case: Case) -> None:
    dark = [
        replace(s, spot_mirror=s.spot_mirror[:0], spot=s.spot[:0], spot_sigma=s.spot_sigma[:0])
        for s in case.seen
    ]
    shape = [ideal(case.flown.heliostats, i) for i in range(20)].__getitem__
    with pytest.raises(InputError, match="no reflection on the mirrors in 16 photographs"):
        evaluation.evaluate(case.photos, dark, case.flown.camera, case.stand, shape)
    broken = [PhotoReading(s.name, "nothing: at all") for s in case.seen]
    with pytest.raises(InputError, match="none of 16 photographs can be used; the first: DJI_0001"):
        evaluation.evaluate(case.photos, broken, case.flown.camera, case.stand, shape)
    with pytest.raises(InputError, match="three are needed"):
        rtk.check_rtk(case.photos, broken, case.flown.camera, case.stand)


def test_one_bad_photograph_does_not_stop_the_others(case: Case) -> None:
    shape = [ideal(case.flown.heliostats, i) for i in range(20)].__getitem__
    mixed = (PhotoReading(case.seen[0].name, "nothing: here"), *case.seen[1:])
    found = evaluation.evaluate(case.photos, mixed, case.flown.camera, case.stand, shape)
    assert len(found.problems) == 1
    assert found.problems[0].startswith(
        "DJI_0001.JPG: nothing: here; or name mirrors in it by hand"
    )
    assert len(found.photos) == 15
    assert found.reflections.photo.max() == 14


def test_rtk_scatter_is_found(case: Case) -> None:
    check, problems = rtk.check_rtk(
        case.photos, case.seen, case.flown.camera, case.stand, Priors(position=0.001)
    )
    assert problems == ()
    told = np.array([p.position for p in case.flown.recorded])
    true = np.array([p.position for p in case.flown.taken])
    # σ of 16 photographs, plus what photogrammetry adds itself.
    expected = np.hypot((told - true).std(axis=0, ddof=1), check.photogrammetry)
    assert (check.sigma < 1.6 * expected).all()
    assert (check.sigma > 0.5 * (told - true).std(axis=0, ddof=1)).all()
    assert check.covariance.shape == (3, 3)
    # The case has an RTK of 8 mm a component.
    assert (check.rtk_range[0] < (told - true).std(axis=0, ddof=1)).all()
    assert (check.rtk_range[1] > (told - true).std(axis=0, ddof=1)).all()


def test_an_rtk_without_errors_is_told_from_photogrammetry(case: Case) -> None:
    """Of 0.1 mm and the noise of the photographs only the photographs' remains."""
    noise = np.random.default_rng(3).normal(0.0, 1e-4, (len(case.photos), 3))
    exact = [
        replace(photo, position=np.asarray(taken.position) + extra)
        for photo, taken, extra in zip(case.photos, case.flown.taken, noise, strict=True)
    ]
    check, _ = rtk.check_rtk(
        exact, case.seen, case.flown.camera, case.stand, Priors(position=0.001)
    )
    assert (check.sigma > 1e-3).all(), "what was printed before, as if it were RTK's"
    assert (check.rtk_range[0] <= 1e-4).all()
    assert (check.rtk < 0.5 * check.sigma).all()


def test_the_share_of_rtk_is_found_and_its_interval_holds() -> None:
    rng = np.random.default_rng(4)
    held = 0
    for true in (0.0, 0.002, 0.008):
        for _ in range(40):
            sigma = rng.uniform(0.002, 0.006, (60, 3))
            gap = 0.01 + rng.normal(0.0, true, (60, 3)) + rng.normal(0.0, sigma)
            found, (low, high) = rtk.share_of_rtk(gap, sigma)
            assert (np.abs(found - true) < 0.0035).all()
            held += int(((low <= true) & (true <= high)).sum())
    assert held >= 0.92 * 360


# -- pieces ----------------------------------------------------------------------------


def rectangle(center: tuple[float, float], angle: float, size: tuple[float, float]) -> np.ndarray:
    w, h = 0.5 * np.array(size)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.array([(-w, -h), (w, -h), (w, h), (-w, h)]) @ turn.T + center


@pytest.mark.parametrize("angle", [0.0, 0.1, 0.6])
@pytest.mark.parametrize("place", [(60.0, 45.0), (60.37, 45.71)])
def test_outline_of_a_plain_rectangle(angle: float, place: tuple[float, float]) -> None:
    true = rectangle(place, angle, (50.0, 36.0))
    image = np.full((90, 120, 3), 0.1, np.float32)
    rendering._cover(image, true, np.full(3, 0.6), 1.0)
    picture = rendering._expose(
        rendering._blurred(image, rendering.Conditions()), rendering.Conditions(), 1
    )
    found = find_outlines(picture, (true + [1.3, -0.9])[None], 4.0)
    assert found.found.tolist() == [True]
    assert np.abs(found.corners[0] - true).max() < 0.08
    assert found.contrast[0] > 0.3


def test_narrow_shadows_do_not_shorten_the_mirrors() -> None:
    rng = np.random.default_rng(4)
    image = np.full((300, 420, 3), 0.15, np.float32)
    true = np.stack(
        [
            rectangle((40 + 85 * i + x, 40 + 70 * j + y), a, (50.0, 36.0))
            for i in range(5)
            for j in range(4)
            for x, y, a in [rng.uniform([-0.5, -0.5, 0.05], [0.5, 0.5, 0.4])]
        ]
    )
    for outline in true:
        rendering._cover(image, outline + [0.0, 1.5], np.full(3, 0.05), 1.0)
    for outline in true:
        rendering._cover(image, outline, np.full(3, 0.6), 1.0)
    conditions = rendering.Conditions()
    picture = rendering._expose(rendering._blurred(image, conditions), conditions, 1)
    found = find_outlines(picture, true + [1.3, -0.9], 4.0)
    assert found.found.all()
    # Without the fit the lower edges are 0.16 and 0.19 px too high.
    error = np.mean(found.corners - true, axis=0)
    assert np.abs(error[:2, 1]).max() < 0.03
    assert np.abs(error[2:, 1]).max() < 0.08


def test_no_edges_are_told() -> None:
    rng = np.random.default_rng(2)
    picture = rng.integers(80, 100, (90, 120, 3)).astype(np.uint8)
    found = find_outlines(picture, rectangle((60, 45), 0.2, (50, 36))[None], 4.0)
    assert found.contrast[0] < 0.02


@pytest.mark.parametrize("light", [0.004, 0.4, 8.0])
def test_spots_are_centred(light: float) -> None:
    true = rectangle((60, 45), 0.1, (60, 44))
    places = np.array([[45.3, 40.6], [71.9, 52.2]])
    image = np.full((90, 120, 3), 0.1, np.float32)
    rendering._cover(image, true, np.full(3, 0.3), 1.0)
    y, x = np.mgrid[:90, :120]
    for a, b in places:
        bell = np.exp(-0.5 * ((x - a) ** 2 + (y - b) ** 2) / 0.5) / np.pi
        image += (4.0 * light * bell)[..., None].astype(np.float32)
    conditions = rendering.Conditions(electrons=1e6)
    picture = rendering._expose(rendering._blurred(image, conditions), conditions, 1)
    spots, reasons = find_spots(picture, true[None])
    assert reasons == ("",)
    if light < 0.1:
        assert len(spots) == 0
        return
    order = np.argsort(spots.pixel[:, 0])
    assert np.abs(spots.pixel[order] - places).max() < (0.03 if light < 1.0 else 0.15)
    assert (spots.clipped > 3).all() == (light > 1.0)


def test_gaps_between_facets_are_no_lamp() -> None:
    image = np.full((120, 160, 3), 0.1, np.float32)
    for x in (50.0, 110.8):
        for y in (37.0, 83.8):
            rendering._cover(image, rectangle((x, y), 0.0, (60, 46)), np.full(3, 0.5), 1.0)
    conditions = rendering.Conditions()
    picture = rendering._expose(rendering._blurred(image, conditions), conditions, 3)
    whole = rectangle((80.4, 60.4), 0.0, (120.8, 92.8))
    spots, reasons = find_spots(picture, whole[None])
    assert (len(spots), reasons) == (0, ("",))


def test_clipped_mirror_gives_no_spot() -> None:
    picture = np.full((90, 120, 3), 255, np.uint8)
    spots, reasons = find_spots(picture, rectangle((60, 45), 0.1, (60, 44))[None])
    assert len(spots) == 0
    assert reasons == ("overexposed: the mirror is clipped",)


def test_patches_are_counted() -> None:
    image = np.full((300, 400, 3), 0.1, np.float32)
    true = [(60.5, 70.2), (200.1, 80.7), (300.4, 200.9)]
    for place in true:
        rendering._cover(image, rectangle(place, 0.2, (40, 30)), np.full(3, 0.5), 1.0)
    plain = rendering.Conditions()
    picture = rendering._expose(rendering._blurred(image, plain), plain, 2)
    brighter = find_patches(picture, 1200.0)[0]
    order = np.argsort(brighter.center[:, 0])
    np.testing.assert_allclose(brighter.center[order], true, atol=1.0)
    np.testing.assert_allclose(brighter.area, 1200.0, rtol=0.25)


def test_a_few_mirrors_in_a_wide_frame() -> None:
    # They fill 0.3 % of it.
    few = field(2, 3)
    flown = flight(Errors(), 1, 1, heliostats=few, lens=camera(1600, 1200))
    flown.camera.matrix[:2, :2] *= 0.5
    stand = standing(few, flown.counts)
    scene = rendering.FlightScene(flown.truth, flown.shapes)
    picture = rendering.render(scene, flown.camera, flown.taken[0], exact_reflections(flown), 1)
    seen = look(picture, flown.recorded[0], flown.camera, stand)
    assert seen.problem == ""
    assert seen.mirror.tolist() == list(range(6))


def test_same_seed_same_picture() -> None:
    flown = flight(Errors(), columns=1, rows=1, lens=camera(400, 300))
    scene = rendering.FlightScene(flown.truth, flown.shapes, conditions=rendering.night())
    lamp = exact_reflections(flown)
    first, again, other = (
        rendering.render(scene, flown.camera, flown.taken[0], lamp, s) for s in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.3
    with pytest.raises(InputError, match=r"seed must be .* not -1"):
        rendering.render(scene, flown.camera, flown.taken[0], lamp, -1)
    with pytest.raises(InputError, match=r"sky must be .* not -1"):
        rendering.Conditions(sky=-1.0)


def test_night_and_motion_are_read_too(case: Case, tmp_path) -> None:
    flown = case.flown
    lamp = case.exact.take(np.flatnonzero(case.exact.photo == 0))
    moving = rendering.Conditions(motion=(2.0, 1.0))
    for conditions, fewest in ((rendering.night(), 14), (moving, 18)):
        scene = rendering.FlightScene(flown.truth, flown.shapes, conditions=conditions)
        picture = rendering.render(scene, flown.camera, flown.taken[0], lamp, 5)
        seen = read_photo(picture_of(case, tmp_path, picture), flown.camera, case.stand)
        assert seen.problem == ""
        assert len(seen.mirror) == 20
        assert np.isfinite(seen.corners).all(axis=(1, 2)).sum() >= fewest
        true = true_spots(case, 0)
        assert len(set(true) & set(seen.spot_mirror.tolist())) > 0.85 * len(true)


def test_motion_blurs_along_its_way() -> None:
    image = np.zeros((41, 41, 3), np.float32)
    image[20, 20] = 1.0
    conditions = rendering.Conditions(blur=0.0, motion=(6.0, 0.0))
    blurred = rendering._blurred(image, conditions)[..., 0]
    x = np.arange(41)
    assert blurred.sum() == pytest.approx(1.0, abs=1e-5)
    assert (blurred.sum(axis=0) @ x) == pytest.approx(20.0, abs=1e-4)
    # A line of length L has a variance of L²/12.
    assert (blurred.sum(axis=0) @ (x - 20.0) ** 2) == pytest.approx(3.0, abs=0.25)
    assert (blurred.sum(axis=1) @ (x - 20.0) ** 2) < 0.01


# -- commands --------------------------------------------------------------------------

app = typer.Typer()
app.command("evaluate")(evaluate_command)
app.command("rtk")(rtk_command)
app.command("simulate")(simulate_command)


def run(*arguments: object):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_evaluate_command(case: Case, tmp_path) -> None:
    common = ("--field", case.folder / "plant.toml", "--out", tmp_path, "--processes", 1)
    done = run("evaluate", case.folder, *common, "--survey-mm", 1, "--no-report", "--json")
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert len(told["photographs"]) == 16
    assert told["not_used"] == []
    assert len(told["orientations"]) >= 18
    for name in ("orientations.csv", "reflections.csv", "sightings.csv"):
        assert (tmp_path / name).exists()
    lines = (tmp_path / "orientations.csv").read_text().splitlines()
    assert lines[0].startswith("heliostat,points,outliers,")
    assert len(lines) == 1 + len(told["orientations"])
    again = run("evaluate", case.folder, *common, "--slopes", tmp_path)
    assert isinstance(again.exception, InputError)
    assert "there is no slope map in it" in str(again.exception)
    checked = run("rtk", case.folder, *common, "--survey-mm", 1)
    assert checked.exit_code == 0, checked.output
    assert "16 photographs, mm" in checked.stdout
    assert "Covariance of one difference" in checked.stdout


def test_simulate_command(tmp_path) -> None:
    plant_file.write_plant(plant(field(2, 3)), tmp_path / "plant.toml")
    done = run(
        "simulate",
        tmp_path / "plant.toml",
        tmp_path / "out",
        "--columns",
        2,
        "--rows",
        1,
        "--size",
        "400x300",
        "--distance",
        40,
        "--heliostats",
        5,
    )
    assert done.exit_code == 0, done.output
    assert "2 photographs of 5 heliostats" in done.stdout
    photos, problems = read_photos(tmp_path / "out", ORIGIN)
    assert (len(photos), problems) == (2, ())
    assert cv2.imread(str(photos[0].path)).shape == (300, 400, 3)
    assert len((tmp_path / "out/truth/orientations.csv").read_text().splitlines()) == 6
    assert len(list((tmp_path / "out/truth/slopes").glob("*.npz"))) == 5
    bad = run("simulate", tmp_path / "plant.toml", tmp_path / "out", "--size", "large")
    assert "write WIDTHxHEIGHT in pixels" in str(bad.exception)
