"""Sightings of every kind: covariances of their ends, tables, and one fit of all."""

import math
from dataclasses import fields, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from heliotrope.calibration import sighting_table
from heliotrope.calibration.fit.estimator import FitOutcome, fit
from heliotrope.calibration.fit.residuals import whitening
from heliotrope.calibration.sighting_table import read_malan, read_sightings, write_sightings
from heliotrope.calibration.sightings import (
    Sightings,
    bisector_covariance,
    camera_target,
    drone,
    field_camera,
    join,
    ray_directions,
    sightings,
    sun_sensor,
)
from heliotrope.errors import FormatError, InputError, UnknownNameError
from heliotrope.field.example import azimuth_elevation, example_plant
from heliotrope.files.times import format_time, parse_time
from heliotrope.geometry import MRAD, TAU, bisector, direction, normalize, reflect, tangent_axes
from heliotrope.mechanism.chain import Mechanism

NAMES = ("AA39", "B, 7", "Ç1")
TRUTH = {
    "tilt_north": 8e-3, "tilt_east": -5e-3, "azimuth_bias": 4e-3, "elevation_bias": -6e-3,
    "non_orthogonality": 2e-3, "canting": -3e-3,
}  # fmt: skip
WEAK = dict.fromkeys(TRUTH, 1.0)
#: Of the example plant: 200 steps a turn, 16 microsteps, a gear of 2400:1.
COUNT = TAU / (200 * 16 * 2400)


def _matrices(rng: np.random.Generator, rows: int, size: float) -> np.ndarray:
    roots = rng.normal(0.0, size, (rows, 3, 3)) * [1.0, 0.3, 3.0]
    return roots @ np.swapaxes(roots, -1, -2)


def _every_kind(truth: Mechanism, rows: int, seed: int = 0) -> tuple[Sightings, tuple[str, ...]]:
    """``rows`` sightings of each kind and heliostat, without noise."""
    rng = np.random.default_rng(seed)
    index = np.repeat(np.arange(len(truth)), rows)
    parts = []
    for kind in range(4):
        angles = rng.uniform((-0.9, 0.3), (0.9, 1.3), (len(index), 2))
        counts = angles / COUNT
        pose = truth[index].pose(counts)
        time = 1.78e9 + rng.uniform(0.0, 1e6, len(index))
        sun = normalize(pose.normal + rng.normal(0.0, 0.2, pose.normal.shape))
        spot = pose.vertex + 45.0 * reflect(sun, pose.normal)
        led = pose.vertex + 60.0 * sun
        if kind == 0:
            part = camera_target(index, counts, sun, spot, time=time, sigma=1e-4)
        elif kind == 1:
            part = drone(index, counts, led, spot, time=time, sigma=1e-4)
        elif kind == 2:
            part = sun_sensor(index, counts, pose.normal, time=time, normal_sigma=5e-5)
        else:
            part = field_camera(index, counts, sun, spot, time=time, sigma=1e-4)
        parts.append(part)
    return join(parts), tuple(np.repeat(list(sighting_table.KINDS), len(index)).tolist())


def _plant(rows: int) -> Mechanism:
    rng = np.random.default_rng(5)
    place = np.c_[rng.uniform(-40, 40, rows), rng.uniform(-60, -20, rows), np.zeros(rows)]
    return azimuth_elevation(place)


def _awkward(drives: int = 2) -> tuple[Sightings, tuple[str, ...]]:
    """Values of all sizes, times on both sides of the epoch, and covariances."""
    rng = np.random.default_rng(7)
    rows = 80
    far = np.repeat([[True, False], [False, False], [True, True], [True, False]], rows // 4, axis=0)
    time = rng.choice([1.0, -1.0], rows) * 10.0 ** rng.uniform(-12, 10, rows)
    time[:4] = np.nan, 0.0, -0.3, 5e-324
    points = rng.normal(0.0, 1.0, (2, rows, 3)) * 10.0 ** rng.uniform(-9, 4, (2, rows, 1))
    counts = rng.normal(0.0, 1.0, (rows, drives)) * 10.0 ** rng.uniform(-20, 15, (rows, drives))
    counts[0] = -0.0
    spread = [_matrices(rng, rows, 10.0**e) for e in (-3.0, -2.0)]
    spread[0][5:50] = 0.0
    seen = sightings(
        rng.integers(0, 3, rows),
        counts,
        points[0],
        points[1],
        time=time,
        source_at_infinity=far[:, 0],
        destination_at_infinity=far[:, 1],
        sigma=10.0 ** rng.uniform(-6, -1, rows),
        source_covariance=spread[0],
        destination_covariance=spread[1],
    )
    return seen, tuple(np.repeat(list(sighting_table.KINDS), rows // 4).tolist())


def _same(a: Sightings, b: Sightings) -> None:
    for f in fields(Sightings):
        x, y = np.asarray(getattr(a, f.name)), np.asarray(getattr(b, f.name))
        assert x.dtype == y.dtype
        assert x.shape == y.shape
        assert x.tobytes() == y.tobytes(), f.name


# --- covariances ----------------------------------------------------------------------


def test_covariances_broadcast() -> None:
    def covariance(given: object) -> np.ndarray:
        seen = sightings(0, np.zeros((3, 2)), [0, 0, 1.0], [0, 9, 9.0], source_covariance=given)
        assert not seen.destination_covariance.any()
        return seen.source_covariance

    assert not covariance(0.0).any()
    assert (covariance(4.0) == 4.0 * np.eye(3)).all()
    assert (covariance([1.0, 2.0, 3.0])[:, 1, 1] == [1.0, 2.0, 3.0]).all()
    one = np.diag([1.0, 0.0, 2.0])
    assert (covariance(one) == one).all()
    many = _matrices(np.random.default_rng(0), 3, 1.0)
    np.testing.assert_allclose(covariance(many), many, rtol=1e-15)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ([0.0, -1.0], r"sighting 1: source_covariance .* positive semidefinite"),
        ([np.diag([1.0, 1, 1]), np.diag([1.0, -1e-3, 1])], r"sighting 1: source_covariance"),
        ([[0, 1.0, 0], [0, 0, 0], [0, 0, 0]], r"sighting 0: source_covariance .* not symmetric"),
        ([0.0, np.nan], r"sighting 1: source_covariance"),
        ([0.0, np.inf], r"sighting 1: source_covariance"),
        ([0.0, 1e308], r"sighting 1: source_covariance"),
        ([1.0, 2.0, 3.0], r"source_covariance of shape \(3,\); pass one variance, 2 variances"),
    ],
)
def test_covariance_guards(given: object, text: str) -> None:
    with pytest.raises(InputError, match=text) as caught:
        sightings(0, np.zeros((2, 2)), [0, 0, 1.0], [0, 9, 9.0], source_covariance=given)
    assert "\n" not in str(caught.value)


def test_parts_keep_their_covariances() -> None:
    seen, _ = _awkward()
    part = seen.take([7, 3])
    assert (part.source_covariance == seen.source_covariance[[7, 3]]).all()
    rows = np.flatnonzero(seen.heliostat == 2)
    assert (seen.of(2).destination_covariance == seen.destination_covariance[rows]).all()
    _same(join([seen.take(np.arange(9)), seen.take(np.arange(9, len(seen)))]), seen)
    with pytest.raises(InputError, match=r"with \[1, 2\] drives"):
        join([seen, _awkward(1)[0]])
    with pytest.raises(InputError, match="the list is empty"):
        join([])


def test_without_covariances_nothing_changes() -> None:
    """The whitening is, to the last bit, the one of sigma alone."""
    plant = _plant(3)
    seen, _ = _every_kind(plant, 5)
    vertex = plant[seen.heliostat].pose(seen.counts).vertex
    source, way = ray_directions(seen, vertex)
    total = source + way
    size = np.linalg.norm(total, axis=-1, keepdims=True)
    axes = tangent_axes(total / size)
    spread = np.eye(3) - way[:, :, None] * way[:, None, :]
    across = axes / size[:, :, None]
    covariance = across @ spread @ np.swapaxes(across, -1, -2) * seen.sigma[:, None, None] ** 2
    axes_used, whiten = whitening(seen, plant[seen.heliostat].pose(seen.counts).vertex)
    assert (axes_used == axes).all()
    assert (whiten == np.linalg.inv(np.linalg.cholesky(covariance))).all()


def test_whitening_is_that_of_finite_differences() -> None:
    """Each end moved by itself, in every direction, for every kind of sighting."""
    plant = _plant(4)
    plain, _ = _every_kind(plant, 6)
    rng = np.random.default_rng(1)
    spread = {
        "source": _matrices(rng, len(plain), 0.01),
        "destination": _matrices(rng, len(plain), 0.02),
    }
    seen = sightings(
        plain.heliostat,
        plain.counts,
        plain.source,
        plain.destination,
        sigma=1e-6,
        source_at_infinity=plain.source_at_infinity,
        destination_at_infinity=plain.destination_at_infinity,
        source_covariance=spread["source"],
        destination_covariance=spread["destination"],
    )
    vertex = plant[seen.heliostat].pose(seen.counts).vertex
    ways = dict(zip(("source", "destination"), ray_directions(seen, vertex), strict=True))
    axes = tangent_axes(bisector(ways["source"], ways["destination"]))
    expected = np.zeros((len(seen), 2, 2))
    for end, matrices in spread.items():
        far = getattr(seen, f"{end}_at_infinity")
        step = np.where(far, 1e-6, 1e-4)
        columns = []
        for shift in np.eye(3):
            moved = []
            for sign in (1.0, -1.0):
                point = getattr(seen, end) + sign * step[:, None] * shift
                other = {**ways, end: normalize(np.where(far[:, None], point, point - vertex))}
                moved.append(bisector(other["source"], other["destination"]))
            columns.append((moved[0] - moved[1]) / (2.0 * step[:, None]))
        jacobian = axes @ np.stack(columns, axis=-1)
        expected += jacobian @ matrices @ np.swapaxes(jacobian, -1, -2)
    found = bisector_covariance(seen, vertex, axes)
    largest = np.abs(expected).max(axis=(-1, -2), keepdims=True)
    assert (np.abs(found - expected) / largest).max() < 1e-5
    _, whiten = whitening(seen, plant[seen.heliostat].pose(seen.counts).vertex)
    unit = whiten @ found @ np.swapaxes(whiten, -1, -2)
    np.testing.assert_allclose(unit, np.broadcast_to(np.eye(2), unit.shape), atol=1e-6)


def test_a_sensors_normal_has_its_own_uncertainty() -> None:
    """Source and destination are one measurement: the normal's covariance comes out whole."""
    plant = _plant(1)
    sun = direction(3.0, 0.8)
    matrix = np.diag([1e-8, 4e-8, 9e-8])
    seen = sun_sensor(0, [[0.0, 0.0]], sun, normal_sigma=1e-6, normal_covariance=matrix)
    axes = tangent_axes(sun)[None]
    vertex = plant[[0]].pose(seen.counts).vertex
    wanted = axes[0] @ matrix @ axes[0].T + 1e-12 * np.eye(2)
    np.testing.assert_allclose(bisector_covariance(seen, vertex, axes)[0], wanted, rtol=1e-9)


# --- one fit --------------------------------------------------------------------------


def test_all_kinds_in_one_fit_recover_the_truth(tmp_path: Path) -> None:
    """Out of one table; each kind alone has too few sightings for six parameters."""
    nominal = _plant(5)
    seen, kinds = _every_kind(nominal.with_parameters(TRUTH), 3)
    names = [f"H{i}" for i in range(5)]
    write_sightings(tmp_path / "all.parquet", seen, names, kinds)
    read, found_kinds, left_out = read_sightings(tmp_path / "all.parquet", names)
    assert found_kinds == kinds
    assert not left_out
    found = fit(nominal, read, "guo6", priors=WEAK, adapt_scale=False, loss="square")
    assert (found.outcome == FitOutcome.CONVERGED).all()
    for name, value in TRUTH.items():
        np.testing.assert_allclose(found.parameters[name], value, rtol=0, atol=0.01 * MRAD)


def test_anisotropic_noise_gives_the_stated_uncertainty() -> None:
    """A drone that knows its height badly; over many mirrors errors in σ have variance 1."""
    count, rows = 300, 8
    nominal = _plant(count)
    rng = np.random.default_rng(2)
    truth = {name: rng.normal(0.0, 5e-3, count) for name in TRUTH}
    exact, _ = _every_kind(nominal.with_parameters(truth), rows)
    seen = exact.take(~exact.source_at_infinity)
    matrix = np.diag([0.005, 0.005, 0.08]) ** 2
    noise = rng.multivariate_normal(np.zeros(3), matrix, (2, len(seen)))
    turned = rng.normal(0.0, 1e-4, seen.destination.shape)
    way = seen.destination + noise[1] + 45.0 * turned
    common = {"sigma": 1e-4, "led_covariance": matrix, "camera_covariance": matrix}
    told = drone(seen.heliostat, seen.counts, seen.source + noise[0], way, **common)
    untold = drone(seen.heliostat, seen.counts, told.source, told.destination, sigma=1e-3)
    errors = []
    for given in (told, untold):
        found = fit(
            nominal,
            given,
            "guo6",
            priors=dict.fromkeys(TRUTH, 5e-3),
            adapt_scale=False,
            loss="square",
        )
        gaps = found.values - np.stack([truth[n] for n in found.names], axis=-1)
        errors.append(np.sqrt(np.mean(gaps**2, axis=0)))
        if given is told:
            spread = np.mean((gaps / found.sigma) ** 2, axis=0)
            np.testing.assert_allclose(spread, 1.0, atol=5.0 * math.sqrt(2.0 / count))
    assert (errors[0] < 1.02 * errors[1]).all()
    assert errors[0].min() < 0.7 * errors[1].max()


# --- tables ---------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".CSV"])
@pytest.mark.parametrize("drives", [1, 2, 3])
def test_round_trip_to_the_last_bit(suffix: str, drives: int, tmp_path: Path) -> None:
    seen, kinds = _awkward(drives)
    path = tmp_path / f"sightings{suffix}"
    write_sightings(path, seen, NAMES, kinds)
    read, found, left_out = read_sightings(path, NAMES)
    assert left_out == []
    assert found == kinds
    _same(read, replace(seen, names=NAMES))
    # Without kinds and covariances, and from the file that stands there already.
    plain = sightings(0, np.array([[1.5, 2.0]]), [0, 0, 2.0], [1, 2, 3.0])
    write_sightings(path, plain, NAMES)
    read, found, _ = read_sightings(path, NAMES)
    assert found == ("",)
    _same(read, replace(plain, names=NAMES))
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_an_empty_table_is_no_sightings(suffix: str, tmp_path: Path) -> None:
    seen, _ = _awkward()
    none = seen.take(np.arange(0))
    write_sightings(tmp_path / f"none{suffix}", none, NAMES)
    read, kinds, left_out = read_sightings(tmp_path / f"none{suffix}", NAMES)
    assert (len(read), kinds, left_out) == (0, (), [])
    assert read.counts.shape == (0, 2)


def test_times_to_the_last_bit() -> None:
    rng = np.random.default_rng(3)
    times = np.concatenate(
        [
            rng.uniform(-6e10, 2.5e11, 300),
            rng.uniform(-10, 10, 300),
            10.0 ** rng.uniform(-30, 0, 99),
        ]
    )
    for t in times.tolist():
        assert parse_time(format_time(t)) == t
    assert format_time(1782043200.25) == "2026-06-21T12:00:00.25Z"
    assert format_time(-0.25) == "1969-12-31T23:59:59.75Z"
    assert parse_time("2026-06-21 14:00:00,5+02:00") == 1782043200.5
    assert parse_time("2026-06-21T12:00Z") == 1782043200.0
    for bad in (math.inf, 1e20):
        with pytest.raises(InputError, match="outside the years 1 to 9999"):
            format_time(bad)


HEADER = (
    "heliostat,time,kind,count_1,count_2,source_east,source_north,source_up,source_at_infinity,"
    "destination_east,destination_north,destination_up,destination_at_infinity,sigma_mrad,"
    + ",".join(f"destination_cov_{p}" for p in ("ee", "en", "eu", "nn", "nu", "uu"))
)
GOOD = (
    "AA39,2026-06-21T12:00:00Z,camera_target,1,2,0,-0.6,0.8,true,0,0,40,false,0.5,"
    "1e-4,0,0,1e-4,0,4e-4"
)
BAD: list[tuple[str, int, str, str]] = [
    # what, column, value, what the line says
    ("stranger", 0, "AA40", "heliostat AA40, column heliostat: there is no heliostat 'AA40'; did"),
    ("broken name", 0, '"AA\n39"', "heliostat AA 39, column heliostat: there is no heliostat"),
    ("nobody", 0, "", "line 3, column heliostat: the cell is empty; name a heliostat"),
    ("naive", 1, "2026-06-21T12:00:00", "column time: 2026-06-21T12:00:00 has no time zone; app"),
    ("no time", 1, "noon", "column time: 'noon' is not an ISO 8601 time; write it like"),
    ("no day", 1, "2026-02-30T12:00Z", "column time: '2026-02-30T12:00Z' is not a valid time (day"),
    ("unknown kind", 2, "camera", "column kind: there is no kind of sighting 'camera'; did you"),
    ("no count", 3, "", "column count_1: the cell is empty; enter drive counts"),
    ("words", 4, "two", "column count_2: 'two' is not a finite number; enter drive counts"),
    ("underscore", 4, "1_000", "column count_2: '1_000' is not a finite number"),
    ("decimal comma", 5, '"0,5"', "column source_east: '0,5' is not a finite number; write a"),
    ("NaN", 6, "nan", "column source_north: 'nan' is not a finite number"),
    ("infinite", 10, "inf", "column destination_north: 'inf' is not a finite number"),
    ("neither", 8, "far", "column source_at_infinity: 'far' is neither true nor false"),
    ("another kind's end", 8, "false", "column source_at_infinity: false, but for kind camera_t"),
    ("another kind's end", 12, "1", "column destination_at_infinity: true, but for kind camera_"),
    ("far away", 9, "400000", "column destination_east: 400000 m is more than 50 km from the"),
    ("sigma 0", 13, "0", "column sigma_mrad: 0 mrad is outside 0.001 to 200 mrad"),
    ("sigma below", 13, "-1", "column sigma_mrad: -1 mrad is outside 0.001 to 200 mrad"),
    ("wide sigma", 13, "500", "column sigma_mrad: 500 mrad is outside 0.001 to 200 mrad"),
    ("tiny sigma", 13, "1e-300", "column sigma_mrad: 1e-300 mrad is outside 0.001 to 200 mrad"),
    ("sigma in rad", 13, "0.0003", "column sigma_mrad: 0.0003 mrad is outside 0.001 to 200 mrad"),
    ("no sigma", 13, "", "column sigma_mrad: the cell is empty; enter the ray's standard"),
    ("half a covariance", 15, "", "column destination_cov_en: the cell is empty; enter m² of a"),
    ("no variance", 14, "-1e-4", "column destination_cov_ee to destination_cov_uu: [-0.0001, "),
    ("not definite", 15, "2e-4", "is not a covariance (not positive semidefinite); correct it"),
    ("covariance NaN", 16, "nan", "column destination_cov_eu: 'nan' is not a finite number"),
]  # fmt: skip


def _with(column: int, value: str) -> str:
    cells = GOOD.split(",")
    cells[column] = value
    return ",".join(cells)


@pytest.mark.parametrize(("column", "value", "says"), [b[1:] for b in BAD], ids=[b[0] for b in BAD])
def test_a_bad_row_is_named_and_left_out(
    column: int, value: str, says: str, tmp_path: Path
) -> None:
    path = tmp_path / "s.csv"
    path.write_text("\n".join([HEADER, GOOD, _with(column, value), GOOD, ""]), encoding="utf-8")
    seen, kinds, left_out = read_sightings(path, NAMES)
    assert len(seen) == 2
    assert kinds == ("camera_target", "camera_target")
    (line,) = left_out
    assert line.startswith("s.csv: line 3, ")
    assert says in line
    assert "\n" not in line


def test_all_bad_rows_together(tmp_path: Path) -> None:
    rows = [_with(column, value) for _, column, value, _ in BAD]
    zero = GOOD.replace("0,-0.6,0.8", "0,0,0")
    path = tmp_path / "s.csv"
    lines = [HEADER, *rows, "", zero, "AA39,1", GOOD + ",7", GOOD + ",,", ",,,,", GOOD]
    path.write_text("\n".join(lines), encoding="utf-8")
    seen, _, left_out = read_sightings(path, NAMES)
    assert len(seen) == 1
    assert len(left_out) == len(BAD) + 4
    # One of the bad cells runs over two lines.
    after = len(BAD) + 4
    nowhere = "column source_east: 0, 0, 0 is not a direction; enter the direction from the mirror"
    # A further cell, though it is empty, may have moved the others: a decimal comma does that.
    assert left_out[-4:] == [
        f"s.csv: line {after}, heliostat AA39, {nowhere}",
        f"s.csv: line {after + 1}, heliostat AA39, 2 cells under 20 columns; correct the line",
        f"s.csv: line {after + 2}, heliostat AA39, 21 cells under 20 columns; correct the line",
        f"s.csv: line {after + 3}, heliostat AA39, 22 cells under 20 columns; correct the line",
    ]
    # The one thing all good rows say.
    assert (seen.sigma == 5e-4).all()
    assert (seen.time == datetime(2026, 6, 21, 12, tzinfo=UTC).timestamp()).all()
    np.testing.assert_allclose(seen.destination_covariance[0], np.diag([1e-4, 1e-4, 4e-4]))


@pytest.mark.parametrize("separator", [";", "\t", ","])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_separators_and_marks(separator: str, mark: str, tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    text = f"{mark}{HEADER}\r\n{GOOD}\r\n\r\n".replace(",", separator)
    path.write_bytes(text.encode())
    seen, kinds, left_out = read_sightings(path, NAMES)
    assert (len(seen), kinds, left_out) == (1, ("camera_target",), [])


def test_parquet_rows_are_named_too(tmp_path: Path) -> None:
    path = tmp_path / "s.parquet"
    good = dict(zip(HEADER.split(","), GOOD.split(","), strict=True))
    columns = {name: [cell] * 5 for name, cell in good.items()}
    columns["time"] = [
        datetime(2026, 6, 21, 12), datetime(2026, 6, 21, 12), None, None, None  # noqa: DTZ001
    ]  # fmt: skip
    numbers = [1.0, float("nan"), None, 4.0, 5.0]
    table = pa.table({**columns, "count_1": pa.array(numbers), "count_2": [1, 2, 3, 4, 5]})
    pq.write_table(table, path)
    seen, _, left_out = read_sightings(path, NAMES)
    assert np.isnan(seen.time).all()
    assert (seen.counts[:, 0] == [4.0, 5.0]).all()
    assert [line.partition(";")[0] for line in left_out] == [
        "s.parquet: row 1, heliostat AA39, column time: 2026-06-21T12:00:00 has no time zone",
        "s.parquet: row 2, heliostat AA39, column time: 2026-06-21T12:00:00 has no time zone",
        "s.parquet: row 3, heliostat AA39, column count_1: the cell is empty",
    ]
    zoned = table.set_column(
        1, "time", pa.array([1.5e6] * 5).cast("int64").cast(pa.timestamp("us", "UTC"))
    )
    pq.write_table(zoned, path)
    assert (read_sightings(path, NAMES)[0].time == 1.5).all()


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("heliostat,", "mirror,", "line 1: there is no column heliostat; add it. There are mirror"),
        ("count_1", "count_3", "there is no column count_1"),
        ("source_up", "source_top", "there is no column source_up"),
        ("sigma_mrad", "sigma_mm", "there is no column sigma_rad"),
        ("destination_cov_nu", "cov_nu", "there is no column destination_cov_nu"),
        ("count_2", "count_b", "column count_b is not known; did you mean count_2?"),
        ("kind", "sigma_rad", "sigma is specified both in rad and in mrad; keep one column"),
        ("time", "kind", "column kind occurs twice; name each column once"),
        ("kind", "", "column 3 has no name"),
        ("heliostat", '"a\nb"', "there is no column heliostat; add it. There are a b, time,"),
        ("AA39", '"AA39', "not a CSV table (unexpected end of data)"),
    ],
)
def test_an_unusable_table_is_refused(old: str, new: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    path.write_text(f"{HEADER}\n{GOOD}\n".replace(old, new, 1), encoding="utf-8")
    with pytest.raises(FormatError) as caught:
        read_sightings(path, NAMES)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("s.csv", None, "no such file; specify the path of a table of sightings"),
        ("s.csv", b"", "the file is empty"),
        ("s.csv", b"\n\n \n", "the file has no rows"),
        ("s.csv", b"\x7fELF\0\0", "the file is binary"),
        ("s.csv", "Jülich, 北".encode()[:-1], "not UTF-8"),
        (
            "s.csv",
            "Jülich,".encode("latin-1"),
            "there is no column heliostat; add it. There are Jülich",
        ),
        ("s.txt", b"x", "the name ends in '.txt'; sightings are .csv or .parquet"),
        ("s.parquet", None, "no such file"),
        ("s.parquet", b"", "the file is empty"),
        ("s.parquet", b"PAR1" + bytes(200), "not a Parquet table"),
    ],
)
def test_an_unreadable_file_is_refused(
    name: str, content: bytes | None, says: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(FormatError) as caught:
        read_sightings(path, NAMES)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_parquet_of_broken_texts_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.parquet"
    pq.write_table(pa.table({"heliostat": pa.array([b"\xff"]).view(pa.string())}), path)
    with pytest.raises(FormatError, match=r"not a Parquet table \('utf-8' codec"):
        read_sightings(path, NAMES)


def test_what_cannot_be_written_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen, kinds = _awkward()
    path = tmp_path / "s.csv"
    path.write_text("before")
    with pytest.raises(InputError, match="row 2, but there are only 2 names; pass the names"):
        write_sightings(path, seen, NAMES[:2])
    with pytest.raises(InputError, match="A: the name occurs twice"):
        write_sightings(path, seen, ("A", "B", "A"))
    with pytest.raises(InputError, match="1 kinds for 80 sightings"):
        write_sightings(path, seen, NAMES, ["drone"])
    with pytest.raises(UnknownNameError, match="kind of sighting 'balloon'"):
        write_sightings(path, seen, NAMES, ["balloon", *kinds[1:]])
    with pytest.raises(FormatError, match=r"ends in '\.tsv'"):
        write_sightings(path.with_suffix(".tsv"), seen, NAMES)
    with pytest.raises(InputError, match="cannot be written"):
        write_sightings(tmp_path / "nowhere" / "s.csv", seen, NAMES)
    monkeypatch.setattr(sighting_table, "SIZE_LIMIT", 2**12)
    with pytest.raises(InputError, match=r"exceed the 0 MiB that can be read; write \.parq"):
        write_sightings(path, seen, NAMES)
    assert path.read_text() == "before"
    assert [p.name for p in tmp_path.iterdir()] == ["s.csv"]


# --- Malan ----------------------------------------------------------------------------

MALAN = (
    "timestamp;sun_azimuth_deg;sun_elevation_deg;horizontal_offset_m;vertical_offset_m;"
    "azimuth_counts;elevation_counts"
)


@pytest.mark.parametrize("separator", [";", ",", "\t"])
def test_malan(separator: str, tmp_path: Path) -> None:
    plant = example_plant()
    (target,) = plant.targets
    path = tmp_path / "p6a.csv"
    text = f"\ufeff{MALAN}\n2026-06-21T12:00:00+02:00;30;45;0.25;-0.5;1000;2000\n"
    path.write_text(text.replace(";", separator), encoding="utf-8")
    seen, left_out = read_malan(path, "P6A", plant.names, target, aim=(0.5, 0.0), sigma=1e-3)
    assert not left_out
    assert seen.heliostat.tolist() == [plant.names.index("P6A")]
    assert seen.counts.tolist() == [[1000.0, 2000.0]]
    assert seen.time[0] == parse_time("2026-06-21T10:00Z")
    np.testing.assert_allclose(seen.source[0], direction(np.radians(30), np.radians(45)))
    # The target faces south, so right as seen from the heliostats is east.
    np.testing.assert_allclose(seen.destination[0], [0.75, 0.0, 12.5], atol=1e-12)
    assert seen.source_at_infinity.all()
    assert not seen.destination_at_infinity.any()
    assert seen.sigma[0] == 1e-3


MALAN_GOOD = "2026-06-21T12:00:00Z;30;45;0.25;-0.5;1000;2000"


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("00Z", "00", "column timestamp: 2026-06-21T12:00:00 has no time zone; append Z"),
        ("2026-06-21T12:00:00Z", "", "column timestamp: the cell is empty; enter a time in ISO"),
        (";30;", ";400;", "column sun_azimuth_deg: 400° is outside −180° to 360°; use degrees"),
        (";45;", ";95;", "column sun_elevation_deg: 95° is outside −5° to 90°"),
        (
            "0.25",
            "0,25",
            "column horizontal_offset_m: '0,25' is not a finite number; write a point",
        ),
        ("-0.5", "-500", "column vertical_offset_m: -500 m is more than 50 m; check the unit"),
        ("1000", "", "column azimuth_counts: the cell is empty; enter drive counts"),
        ("2000", "nan", "column elevation_counts: 'nan' is not a finite number"),
        (";2000", "", "6 cells under 7 columns"),
    ],
)
def test_malans_bad_rows_are_named(old: str, new: str, says: str, tmp_path: Path) -> None:
    (target,) = example_plant().targets
    path = tmp_path / "m.csv"
    path.write_text(f"{MALAN}\n{MALAN_GOOD}\n{MALAN_GOOD.replace(old, new)}\n", encoding="utf-8")
    seen, left_out = read_malan(path, "A", ("A",), target)
    assert len(seen) == 1
    (line,) = left_out
    assert line.startswith("m.csv: line 3, heliostat A, ")
    assert says in line


def test_malans_guards(tmp_path: Path) -> None:
    (target,) = example_plant().targets
    path = tmp_path / "m.csv"
    path.write_text(f"{MALAN.replace('timestamp', 'time')}\n{MALAN_GOOD}\n", encoding="utf-8")
    with pytest.raises(FormatError, match=r"there is no column timestamp; add it\. There are time"):
        read_malan(path, "A", ("A",), target)
    with pytest.raises(UnknownNameError, match="there is no heliostat 'P6D'; did you mean"):
        read_malan(path, "P6D", example_plant().names, target)
