"""Planning of sightings: derivatives, optimality, the command."""

import csv
import json
import sys
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from heliotrope import sun
from heliotrope.calibration.fit.estimator import fit
from heliotrope.calibration.plan.planning import (
    CandidateSightings,
    SightingLimits,
    SightingPlan,
    candidate_sightings,
    plan_sightings,
    time_grid,
)
from heliotrope.calibration.sighting_table import write_sightings
from heliotrope.calibration.sightings import Sightings, camera_target
from heliotrope.calibration.uncertainty import error_form, precision, suns_of_year
from heliotrope.cli import main
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.formats.plant_file import write_plant
from heliotrope.field.plant import Plant
from heliotrope.geometry import MRAD, FloatArray, angle_between, bisector, reflect, tangent_axes
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import SLOTS
from heliotrope.mechanism.parameters import MODELS
from heliotrope.mechanism.tracking import track
from support.planning_case import AIM, DAY, FIELD, NAMES, PLANT, START, TARGETS


@pytest.fixture(scope="module")
def possible() -> CandidateSightings:
    """Three days of the whole field on two targets."""
    return candidate_sightings(
        FIELD, PLANT.site, TARGETS, time_grid(START, START + 3 * DAY, 3600.0), NAMES
    )


@pytest.fixture(scope="module")
def year() -> FloatArray:
    """Mean squared beam error over the year as a form of the parameters."""
    return error_form(FIELD, AIM, suns_of_year(PLANT.site, 2026), NAMES)


# --- candidates -----------------------------------------------------------------------


def test_candidates_keep_to_sun_stops_and_limits(possible: CandidateSightings) -> None:
    limits = SightingLimits()
    assert set(possible.heliostat) == set(range(18))
    assert set(possible.target) == {0, 1}
    above = sun.position(possible.time, PLANT.site)
    np.testing.assert_allclose(possible.sun, above.vector, rtol=0, atol=1e-12)
    assert (above.elevation >= limits.min_elevation).all()
    table = FIELD.drives.table[possible.heliostat]
    angles = FIELD[possible.heliostat].drives.angles(possible.counts)
    assert (angles >= table[..., SLOTS["min_angle"]] - 1e-9).all()
    assert (angles <= table[..., SLOTS["max_angle"]] + 1e-9).all()
    pose = FIELD[possible.heliostat].pose(possible.counts)
    ray = reflect(possible.sun, pose.normal)
    for k, target in enumerate(TARGETS):
        mine = possible.target == k
        hit = target.intersect(pose.vertex[mine], ray[mine])
        np.testing.assert_allclose(hit - target.center, 0.0, rtol=0, atol=1e-7)
        slant = angle_between(-ray[mine], np.broadcast_to(target.normal, ray[mine].shape))
        np.testing.assert_allclose(slant, possible.obliquity[mine], rtol=0, atol=1e-9)
    assert (possible.obliquity <= limits.max_obliquity).all()
    incidence = angle_between(possible.sun, pose.normal)
    np.testing.assert_allclose(incidence, possible.incidence, rtol=0, atol=1e-9)


def test_nothing_that_is_possible_is_left_out(possible: CandidateSightings) -> None:
    """Counted again, one heliostat and one time after the other."""
    times = time_grid(START, START + 3 * DAY, 3600.0)
    count = 0
    for moment, vector in zip(times, sun.vector(times, PLANT.site), strict=True):
        if sun.position(moment, PLANT.site).elevation < SightingLimits().min_elevation:
            continue
        for target in TARGETS:
            solved = track(FIELD, vector, target.center)
            ray = reflect(vector, solved.chosen(solved.normal))
            slant = angle_between(-ray, np.broadcast_to(target.normal, ray.shape))
            lit = angle_between(np.broadcast_to(vector, ray.shape), ray) / 2 <= np.radians(75.0)
            count += int((solved.reachable & lit & (slant <= np.radians(70))).sum())
    assert len(possible) == count


def test_limits_narrow_the_choice(possible: CandidateSightings) -> None:
    times = time_grid(START, START + 3 * DAY, 3600.0)
    narrow = SightingLimits(np.radians(30.0), np.radians(35.0), np.radians(40.0))
    found = candidate_sightings(FIELD, PLANT.site, TARGETS, times, NAMES, limits=narrow)
    assert 0 < len(found) < len(possible)
    assert found.incidence.max() <= narrow.max_incidence
    assert found.obliquity.max() <= narrow.max_obliquity


@pytest.mark.parametrize("names", [NAMES, (*MODELS["khalsa8"], "sag", "pivot_offset")])
def test_jacobian_against_finite_differences(names: tuple[str, ...]) -> None:
    """Whitened normal minus bisector, the bisector moving with the vertex."""
    mechanism, sigma = FIELD[3:6], 4e-4
    found = candidate_sightings(
        mechanism, PLANT.site, TARGETS, time_grid(START, START + DAY, 7200.0), names, sigma=sigma
    )
    assert len(found) > 20
    whole = mechanism[found.heliostat]
    centers = np.array([t.center for t in TARGETS])[found.target]
    pose = whole.pose(found.counts)
    way = centers - pose.vertex
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    v = bisector(found.sun, way)
    axes = tangent_axes(v)
    size = np.linalg.norm(found.sun + way, axis=-1)[:, None, None]
    # The covariance of the bisector for a ray known to sigma in both directions.
    across = axes / size
    turn = np.eye(3) - way[:, :, None] * way[:, None, :]
    covariance = across @ turn @ np.swapaxes(across, 1, 2) * sigma**2

    def gap(moved: Mechanism) -> FloatArray:
        there = moved.pose(found.counts)
        beam = centers - there.vertex
        beam /= np.linalg.norm(beam, axis=-1, keepdims=True)
        return np.einsum("mak,mk->ma", axes, there.normal - bisector(found.sun, beam))

    # Whitening is known up to a rotation: compare JᵀJ, which is all that planning uses.
    slopes = [
        (gap(whole.with_parameters({n: 1e-6})) - gap(whole.with_parameters({n: -1e-6}))) / 2e-6
        for n in names
    ]
    slope = np.stack(slopes, axis=-1)
    wanted = np.swapaxes(slope, 1, 2) @ np.linalg.inv(covariance) @ slope
    information = np.swapaxes(found.jacobian, 1, 2) @ found.jacobian
    largest = np.abs(wanted).max()
    np.testing.assert_allclose(information, wanted, rtol=0, atol=1e-7 * largest)


def test_beam_variance_against_moved_mirrors(year: FloatArray) -> None:
    """The form gives the beam's error of a mirror that is not as it is believed to be."""
    rng = np.random.default_rng(1)
    suns = suns_of_year(PLANT.site, 2026)
    sizes = np.array([FIELD.parameter(n).prior for n in NAMES])
    for _ in range(3):
        x = rng.normal(0.0, 0.05 * sizes)
        moved = FIELD[7].with_parameters(dict(zip(NAMES, x, strict=True)))
        solved = track(FIELD[7], suns, AIM)
        pose = moved.pose(solved.best_counts)
        way = (AIM - pose.vertex) / np.linalg.norm(AIM - pose.vertex, axis=-1, keepdims=True)
        beam = angle_between(reflect(suns, pose.normal), way)
        predicted = np.sqrt(np.trace(year[7] @ np.multiply.outer(x, x)))
        assert predicted == pytest.approx(np.sqrt(np.mean(beam**2)), rel=0.01)


# --- plan -----------------------------------------------------------------------------


def _log_det(found: CandidateSightings, rows: Any, information: FloatArray) -> float:
    slope = found.jacobian[list(rows)].reshape(-1, information.shape[-1])
    scale = 1.0 / np.sqrt(np.diagonal(information))
    total = (information + slope.T @ slope) * scale[:, None] * scale
    return float(
        np.linalg.slogdet(total)[1] - np.linalg.slogdet(information * scale[:, None] * scale)[1]
    )


def _square(
    found: CandidateSightings, rows: Any, information: FloatArray, form: FloatArray
) -> float:
    slope = found.jacobian[list(rows)].reshape(-1, information.shape[-1])
    return float(np.trace(form @ np.linalg.inv(information + slope.T @ slope)))


def _planned(
    possible: CandidateSightings, year: FloatArray, i: int, count: int, **options: Any
) -> SightingPlan:
    return plan_sightings(possible.of(i), count, precision(FIELD, NAMES)[i], year[i], **options)


@pytest.mark.parametrize("criterion", ["d", "v"])
def test_never_worse_than_random(
    possible: CandidateSightings, year: FloatArray, criterion: Any
) -> None:
    rng = np.random.default_rng(0)
    for i in (0, 8, 15):
        own, information = possible.of(i), precision(FIELD, NAMES)[i]
        found = _planned(possible, year, i, 6, criterion=criterion)
        times = np.unique(own.time)
        for _ in range(200):
            drawn = rng.choice(times, 6, replace=False)
            rows = [int(rng.choice(np.flatnonzero(own.time == t))) for t in drawn]
            if criterion == "d":
                assert found.log_det >= _log_det(own, rows, information) - 1e-9
            else:
                assert found.error[-1] ** 2 <= _square(own, rows, information, year[i]) * 1.001


def test_monotone_and_consistent(possible: CandidateSightings, year: FloatArray) -> None:
    information = precision(FIELD, NAMES)[4]
    before = 0.0
    for count in (1, 2, 4, 8):
        found = _planned(possible, year, 4, count)
        assert len(found) == count
        assert (found.gain > 0.0).all()
        assert found.log_det > before
        before = found.log_det
        assert (np.diff(np.append(found.before, found.error)) < 0.0).all()
        assert (np.diff(np.append(found.before, found.best_first)) < 0.0).all()
        assert found.best_first[-1] == pytest.approx(found.error[-1], rel=1e-9)
        assert sorted(found.rank) == list(range(1, count + 1))
        assert (np.diff(found.chosen.time) > 0.0).all()
        # Against the definitions, computed at once.
        rows = range(count)
        assert found.log_det == pytest.approx(_log_det(found.chosen, rows, information), rel=1e-9)
        square = _square(found.chosen, rows, information, year[4])
        assert found.error[-1] == pytest.approx(np.sqrt(square), rel=1e-8)
        assert np.sqrt(np.trace(year[4] @ found.covariance)) == pytest.approx(
            np.sqrt(square), rel=1e-8
        )


@pytest.mark.parametrize("criterion", ["d", "v"])
def test_against_exhaustive_search(
    possible: CandidateSightings, year: FloatArray, criterion: Any
) -> None:
    """Efficiency: the P-th root of the ratio of determinants; the ratio of squared errors."""
    worst = 1.0
    for i in (0, 5, 11, 17):
        own, information = possible.of(i), precision(FIELD, NAMES)[i]
        own = own.take(np.flatnonzero((own.target == 0) & (own.time < START + DAY)))
        assert 8 <= len(own) <= 12
        every = list(combinations(range(len(own)), 4))
        found = plan_sightings(own, 4, information, year[i], criterion=criterion)
        if criterion == "d":
            best = max(_log_det(own, rows, information) for rows in every)
            worst = min(worst, np.exp((found.log_det - best) / len(NAMES)))
            assert found.log_det <= best + 1e-9
        else:
            least = min(_square(own, rows, information, year[i]) for rows in every)
            worst = min(worst, least / found.error[-1] ** 2)
    print("EFF", criterion, worst)
    assert 0.95 <= worst <= 1.0 + 1e-9


def test_exchange_improves(possible: CandidateSightings, year: FloatArray) -> None:
    gained = 0.0
    for i in range(18):
        plain = _planned(possible, year, i, 5, exchange=False)
        better = _planned(possible, year, i, 5)
        assert better.log_det >= plain.log_det - 1e-9
        gained = max(gained, better.log_det - plain.log_det)
    assert gained > 0.0


def test_v_serves_the_beam_and_d_the_parameters(
    possible: CandidateSightings, year: FloatArray
) -> None:
    errors, gains = [], []
    for i in range(18):
        both = [_planned(possible, year, i, 4, criterion=c) for c in ("d", "v")]
        errors.append([p.error[-1] for p in both])
        gains.append([p.log_det for p in both])
    mean, total = np.mean(errors, axis=0), np.mean(gains, axis=0)
    assert mean[1] < mean[0]
    assert total[1] < total[0]


def test_the_gap_is_kept(possible: CandidateSightings, year: FloatArray) -> None:
    found = _planned(possible, year, 2, 5, gap=4 * 3600.0)
    assert (np.diff(found.chosen.time) > 4 * 3600.0).all()


def test_what_is_known_already_counts(possible: CandidateSightings, year: FloatArray) -> None:
    first = _planned(possible, year, 9, 5)
    c = first.chosen
    centers = np.array([t.center for t in TARGETS])[c.target]
    made = camera_target(np.full(5, 9), c.counts, c.sun, centers, time=c.time)
    information = precision(FIELD, NAMES, made)
    np.testing.assert_allclose(
        np.linalg.inv(information[9]), first.covariance, rtol=1e-6, atol=1e-14
    )
    np.testing.assert_array_equal(information[8], precision(FIELD, NAMES)[8])
    second = plan_sightings(possible.of(9), 5, information[9], year[9])
    assert second.before == pytest.approx(first.error[-1], rel=1e-8)
    assert second.log_det < first.log_det


def test_the_expected_error_comes_true(possible: CandidateSightings, year: FloatArray) -> None:
    """Mirrors drawn from the prior, measured as planned, fitted, and tracked for a year."""
    i, draws = 12, 150
    found = _planned(possible, year, i, 8)
    rng = np.random.default_rng(5)
    sizes = np.array([FIELD.parameter(n).prior for n in NAMES])
    nominal = FIELD[np.full(draws, i)]
    x = rng.normal(0.0, 1.0, (draws, len(NAMES))) * sizes
    truth = nominal.with_parameters({n: x[:, p] for p, n in enumerate(NAMES)})
    c = found.chosen
    pose = truth.pose(c.counts[:, None])
    ray = reflect(c.sun[:, None], pose.normal)
    noise = rng.normal(0.0, 5e-4, (*ray.shape[:2], 2))
    ray = ray + np.einsum("...a,...ak->...k", noise, tangent_axes(ray))
    centers = np.array([t.center for t in TARGETS])[c.target]
    spot = pose.vertex + ray * np.linalg.norm(centers[:, None] - pose.vertex, axis=-1)[..., None]
    heliostat = np.broadcast_to(np.arange(draws), (len(c), draws)).ravel()
    seen = camera_target(
        heliostat,
        np.repeat(c.counts, draws, axis=0),
        np.repeat(c.sun, draws, axis=0),
        spot.reshape(-1, 3),
    )
    learnt = fit(nominal, seen, NAMES, loss="square", adapt_scale=False)
    moved = nominal.with_parameters(learnt.parameters)
    suns = suns_of_year(PLANT.site, 2026)
    solved = track(moved, suns[:, None], AIM)
    there = truth.pose(solved.best_counts)
    way = AIM - there.vertex
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    rms = float(np.sqrt(np.mean(angle_between(reflect(suns[:, None], there.normal), way) ** 2)))
    print("TRUE", rms, found.error[-1])
    assert rms == pytest.approx(found.error[-1], rel=0.15)
    assert found.error[-1] < 0.8 * MRAD < 20 * MRAD < found.before


def test_refusals(possible: CandidateSightings, year: FloatArray) -> None:
    information = precision(FIELD, NAMES)[0]
    own = possible.of(0)
    with pytest.raises(InputError, match="count must be 1 sighting or more"):
        plan_sightings(own, 0, information, year[0])
    with pytest.raises(InputError, match="no candidate"):
        plan_sightings(own.take([]), 3, information, year[0])
    with pytest.raises(InputError, match="criterion 'a'"):
        plan_sightings(own, 3, information, year[0], criterion="a")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="there is no target"):
        candidate_sightings(FIELD, PLANT.site, (), [START], NAMES)
    with pytest.raises(InputError, match="one batch axis"):
        candidate_sightings(FIELD[0], PLANT.site, TARGETS, [START], NAMES)
    with pytest.raises(InputError, match="one batch axis"):
        precision(FIELD[0], NAMES)
    with pytest.raises(InputError, match="must be above 0"):
        precision(FIELD, NAMES, priors={"tilt_east": 0.0})
    with pytest.raises(UnknownNameError, match="tilt_up"):
        precision(FIELD, ("tilt_up",))
    made = camera_target([30], [[0.0, 0.0]], [0.0, 0.0, 1.0], [0.0, 0.0, 13.0])
    with pytest.raises(InputError, match="heliostat index 30, but there are 18"):
        precision(FIELD, NAMES, made)
    with pytest.raises(InputError, match="end must be after"):
        time_grid(START, START, 60.0)
    with pytest.raises(InputError, match="exceed 200,000"):
        time_grid(START, START + 30 * DAY, 1.0)
    with pytest.raises(InputError, match="max_incidence"):
        SightingLimits(max_incidence=2.0)
    with pytest.raises(InputError, match="never reaches 80°"):
        suns_of_year(sun.Site(60.0, 0.0, 0.0), 2026, min_elevation=np.radians(80.0))
    with pytest.raises(InputError, match="use at least one day"):
        suns_of_year(PLANT.site, 2026, days=0)


# --- the command ----------------------------------------------------------------------


@pytest.fixture
def plant_file(tmp_path: Path) -> Path:
    """The example plant as a file."""
    write_plant(PLANT, tmp_path / "plant.toml")
    return tmp_path / "plant.toml"


@pytest.fixture
def run(capsys: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run a command; returns exit code, what it prints, and its complaint."""

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["heliotrope", "plan", *map(str, arguments)])
        with pytest.raises(SystemExit) as leaving:
            main()
        captured = capsys.readouterr()
        code = leaving.value.code
        return (code if isinstance(code, int) else 0), captured.out, captured.err

    return call


WEEK = ("--from", "2026-09-02T00:00Z", "--days", "7")


def test_command(run: Any, plant_file: Path, tmp_path: Path) -> None:
    table, picture = tmp_path / "plan.csv", tmp_path / "plan.png"
    arguments = (plant_file, "--heliostat", "P6A", *WEEK, "--count", "6")
    code, out, err = run(*arguments, "--csv", table, "--picture", picture, "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert found["parameters"] == list(NAMES)
    own = found["heliostats"]["P6A"]
    assert len(own["measurements"]) == 6
    errors = [m["expected_beam_rms_mrad"] for m in own["measurements"]]
    assert own["before_expected_beam_rms_mrad"] > errors[0] > errors[-1]
    assert errors == sorted(errors, reverse=True)
    for m in own["measurements"]:
        where = sun.position(m["time"], PLANT.site)
        assert m["sun_azimuth_deg"] == pytest.approx(np.degrees(where.azimuth), abs=1e-6)
        assert m["sun_elevation_deg"] == pytest.approx(np.degrees(where.elevation), abs=1e-6)
    with table.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [r["time"] for r in rows] == [m["time"] for m in own["measurements"]]
    assert picture.read_bytes().startswith(b"\x89PNG")
    code, out, _ = run(*arguments)
    assert code == 0
    assert out.count("2026-09-0") == 6
    assert f"{errors[-1]:.2f} mrad after" in out
    assert {p.name for p in tmp_path.iterdir()} == {
        "plant.toml",
        "plan.csv",
        "plan.png",
        *(p.name for p in tmp_path.glob("*plant*.csv")),
        *(p.name for p in tmp_path.glob("heliostats*")),
    }


def test_command_for_several_keeps_them_apart(run: Any, plant_file: Path, tmp_path: Path) -> None:
    code, out, _ = run(
        plant_file,
        *WEEK,
        "--count",
        "4",
        "--criterion",
        "v",
        "--json",
        "--picture",
        tmp_path / "all.svg",
    )
    assert code == 0
    found = json.loads(out)["heliostats"]
    assert list(found) == list(PLANT.names)
    times = sorted(
        sun.vector(m["time"], PLANT.site)[0] for h in found.values() for m in h["measurements"]
    )
    assert len(set(times)) == len(times) == 72
    assert "svg" in (tmp_path / "all.svg").read_text(encoding="utf-8")[:400]


def test_command_knows_what_was_measured(run: Any, plant_file: Path, tmp_path: Path) -> None:
    _, out, _ = run(plant_file, "--heliostat", "P2B", *WEEK, "--count", "5", "--json")
    first = json.loads(out)["heliostats"]["P2B"]
    ms = first["measurements"]
    made: Sightings = camera_target(
        np.full(5, PLANT.names.index("P2B")),
        [[m["count_1"], m["count_2"]] for m in ms],
        np.array([sun.vector(m["time"], PLANT.site) for m in ms]),
        PLANT.targets[0].center,
    )
    write_sightings(tmp_path / "made.csv", made, PLANT.names)
    code, out, err = run(
        plant_file,
        "--heliostat",
        "P2A",
        "--heliostat",
        "P2B",
        *WEEK,
        "--count",
        "2",
        "--json",
        "--sightings",
        tmp_path / "made.csv",
    )
    assert (code, err) == (0, "")
    second = json.loads(out)["heliostats"]
    before = second["P2B"]["before_expected_beam_rms_mrad"]
    assert before == pytest.approx(ms[-1]["expected_beam_rms_mrad"], rel=1e-6)
    assert second["P2A"]["before_expected_beam_rms_mrad"] > 20.0


def test_command_campaign(run: Any, plant_file: Path, tmp_path: Path) -> None:
    table, picture = tmp_path / "c.csv", tmp_path / "c.pdf"
    arguments = (
        plant_file,
        "--campaign",
        "--from",
        "2026-09-02T00:00Z",
        "--days",
        "1",
        "--settle",
        "60s",
        "--clear",
        "30s",
    )
    code, out, err = run(*arguments, "--csv", table, "--picture", picture, "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    rows = found["measurements"]
    assert found["before_expected_beam_rms_mrad"] > 20.0
    assert found["after_expected_beam_rms_mrad"] < 2.0
    spans = sorted((r["arrive"], r["done"]) for r in rows)
    assert all(a[1] <= b[0] for a, b in pairwise(spans))
    with table.open(encoding="utf-8", newline="") as stream:
        assert len(list(csv.DictReader(stream))) == len(rows)
    assert picture.read_bytes().startswith(b"%PDF")
    _, out, _ = run(*arguments)
    assert f"{len(rows):,} measurements in" in out
    assert "more; --csv FILE writes them all" in out


REFUSED: list[tuple[list[str], str]] = [
    (["--from", "2026-09-02"], "has no time zone"),
    (["--heliostat", "P9Z"], "there is no heliostat 'P9Z'"),
    (["--days", "0"], "--days must be a number from 0.01 to 3,660"),
    (["--days", "99999"], "--days must be a number from 0.01 to 3,660"),
    (["--days", "1", "--to", "2027-01-01T00:00Z"], "not both"),
    (["--to", "2020-01-01T00:00Z"], "is not after --from"),
    (["--every", "1s"], "exceed 200,000"),
    (["--every", "often"], "write it as 30s"),
    (["--target", "x"], "there is no target 'x'"),
    (["--model", "jacks"], "tilt_up"),
    (["--model", "foo"], "there is no model 'foo'"),
    (["--count", "0"], "--count must be a whole number from 1 to"),
    (["--campaign", "--count", "0"], "--count must be a whole number from 1 to"),
    (["--campaign", "--worth", "2"], "--worth must be a number from 0 to 1"),
    (["--picture", "a.bmp"], "use one of .png"),
    (["--csv", "nowhere/x.csv"], "the folder nowhere does not exist"),
    (["--sightings", "no.csv"], "no such file"),
    (["--sigma-mrad", "nan"], "--sigma-mrad must be a number from 0.001"),
    (["--from", "2026-09-02T20:00Z", "--to", "2026-09-02T22:00Z"], "no measurement is possible"),
    (
        ["--campaign", "--from", "2026-09-02T20:00Z", "--to", "2026-09-02T22:00Z"],
        "never reaches 10°",
    ),
    (["--from", "9999-12-30T00:00Z"], "beyond the year 9999"),
]


@pytest.mark.parametrize(("arguments", "says"), REFUSED, ids=[" ".join(r[0]) for r in REFUSED])
def test_command_refuses_in_one_line(
    arguments: list[str], says: str, run: Any, plant_file: Path
) -> None:
    code, out, err = run(
        plant_file, *(["--days", "7"] if "--every" in arguments else []), *arguments
    )
    assert code == 2
    assert out == ""
    assert says in err
    assert len(err.strip().splitlines()) == 1


def test_a_plant_without_targets(run: Any, tmp_path: Path) -> None:
    bare = Plant(PLANT.name, PLANT.site, PLANT.groups, (), PLANT.receivers)
    write_plant(bare, tmp_path / "plant.toml")
    code, _, err = run(tmp_path / "plant.toml")
    assert code == 2
    assert "this plant has no target" in err


def test_no_input_is_overwritten(run: Any, plant_file: Path, tmp_path: Path) -> None:
    table = next(tmp_path.glob("*.csv"))
    before = table.read_bytes()
    code, _, err = run(plant_file, "--heliostat", "P6A", *WEEK, "--csv", table)
    assert code == 2
    assert "this file is an input" in err
    assert table.read_bytes() == before
