"""What cannot have happened is left out and named; a mirror that does not fit is named."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from heliotrope import sun as solar
from heliotrope.calibration import plausibility, workflow
from heliotrope.calibration.clock import check_clock
from heliotrope.calibration.fit import FitOutcome, fit
from heliotrope.calibration.learn import learning
from heliotrope.calibration.learn.assessment import unexplained_mirrors
from heliotrope.calibration.learn.misfits import find_misfits
from heliotrope.calibration.report.content import CalibrationReport
from heliotrope.calibration.report.results import at_moment, read_json, write_json
from heliotrope.calibration.sighting_table import write_sightings
from heliotrope.calibration.sightings import Sightings, camera_target, join
from heliotrope.field.example import example_plant
from heliotrope.field.formats import paint
from heliotrope.field.plant import Plant
from heliotrope.geometry import MRAD, FloatArray, reflect
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import track
from support.data import juelich

PLANT = example_plant()
GROUP = PLANT.groups["azel"]
NAMES = GROUP.names
NOMINAL = GROUP.mechanism
NOON = datetime(2025, 3, 12, 10, 30, tzinfo=UTC).timestamp()
SIZES = {
    "tilt_north": 4e-3, "tilt_east": 4e-3, "azimuth_bias": 4e-3, "elevation_bias": 4e-3,
    "canting": 1e-3, "non_orthogonality": 1e-3,
}  # fmt: skip
KIND = "camera_target"


def machines(seed: int = 1, shared: float = 0.0) -> Mechanism:
    """Return the true mechanisms; ``shared`` is a part of the zero of elevation that all have."""
    rng = np.random.default_rng(seed)
    values = {name: rng.normal(0.0, size, len(NAMES)) for name, size in SIZES.items()}
    values["elevation_bias"] = values["elevation_bias"] + shared
    return NOMINAL.with_parameters(values)


def seen_of(
    rows: list[int],
    *,
    count: int = 20,
    seed: int = 2,
    shared: float = 0.0,
    fast: float = 0.0,
    noise: float = 0.15e-3,
    wide: float = 0.0,
) -> Sightings:
    """Return sightings over a day; the clock is ``fast`` by s, and the suns are its suns.

    Aims lie within ``wide`` m of the middle of the target.
    """
    rng, truth, target = np.random.default_rng(seed), machines(shared=shared), PLANT.targets[0]
    times = NOON + np.linspace(-3.5, 3.5, count) * 3600.0
    parts = []
    for row in rows:
        light = solar.vector(times, PLANT.site)
        aims = target.point(wide * rng.uniform(-1.0, 1.0, (count, 2)) if wide else (0.0, 0.0))
        counts = np.round(track(NOMINAL[row], light, aims).best_counts)
        pose = truth[np.full(count, row)].pose(counts)
        spots = target.intersect(pose.vertex, reflect(light, pose.normal))
        spots = spots + rng.normal(0.0, noise * 30.0, (count, 2)) @ target.axes
        recorded = solar.vector(times + fast, PLANT.site)
        part = camera_target(row, counts, recorded, spots, time=times + fast, sigma=0.3e-3)
        parts.append(part)
    return replace(join(parts), names=NAMES)


def judge(seen: Sightings, now: float | None = None) -> plausibility.Judgement:
    return plausibility.judge(
        seen,
        mechanism=NOMINAL,
        site=PLANT.site,
        surfaces=(*PLANT.targets, *PLANT.receivers),
        kinds=[KIND] * len(seen),
        now=now,
    )


def changed(seen: Sightings, row: int, **values: object) -> Sightings:
    """Return sightings with one row changed."""
    columns = {name: getattr(seen, name).copy() for name in values}
    for name, value in values.items():
        columns[name][row] = value
    return replace(seen, **columns)


def test_what_happened_is_plausible() -> None:
    assert judge(seen_of([3, 15]), now=NOON) == plausibility.Judgement()


def _below(seen: Sightings) -> FloatArray:
    return np.asarray(seen.source[4] * [1.0, 1.0, -1.0])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda s: {"time": -2.3e9}, "the year is outside 1970 to 2099"),
        (lambda s: {"time": 1.0e10}, "the year is outside 1970 to 2099"),
        (lambda s: {"time": NOON + 5e8}, "more than a year ahead of this computer's clock, 2025-"),
        (lambda s: {"source": _below(s)}, "the sun is below the horizon: its elevation is -"),
        (lambda s: {"time": s.time[4] + 7200.0}, "but the actual sun was at"),
        (lambda s: {"counts": [s.counts[4, 0], 3e7]}, "of elevation are beyond its end stops: "),
        (lambda s: {"counts": [-9e6, s.counts[4, 1]]}, "of azimuth are beyond its end stops: "),
        (lambda s: {"counts": s.counts[4] + [3.8e6, 0]}, "the beam comes from the back"),
        (lambda s: {"destination": s.destination[4] + [0, 0, -9.0]}, "on no target: it is 8."),
        (lambda s: {"destination": s.destination[4] + [0, -2.0, 0]}, "on no target: it is 2."),
        (
            lambda s: {"destination": NOMINAL[3].pose(s.counts[4]).vertex - 20.0 * s.source[4]},
            "on no target",
        ),
    ],
)
def test_a_row_that_cannot_have_happened_is_named(change: object, reason: str) -> None:
    seen = seen_of([3])
    found = judge(changed(seen, 4, **change(seen)), now=NOON)  # type: ignore[operator]
    assert set(found.reasons) == {4}
    assert reason in found.reasons[4]
    assert "\n" not in found.reasons[4]


def test_a_beam_straight_through_the_mirror_is_edge_on() -> None:
    seen = seen_of([3])
    behind = NOMINAL[3].pose(seen.counts[4]).vertex - 20.0 * seen.source[4]
    found = plausibility.judge(changed(seen, 4, destination=behind), mechanism=NOMINAL)
    assert found.reasons[4].startswith("the beam passes the mirror edge-on")
    inside = NOMINAL[3].pose(seen.counts[4]).vertex
    found = plausibility.judge(changed(seen, 4, destination=inside), mechanism=NOMINAL)
    assert found.reasons[4] == "the ray begins or ends within 0.5 m of the mirror"


def test_copies_count_once() -> None:
    seen = seen_of([3], count=6)
    unknown = replace(seen, time=np.full(6, np.nan))
    for each in (seen, unknown):
        found = plausibility.judge(join([each, each]))
        assert found.reasons == dict.fromkeys(range(6, 12), "a copy of another sighting")


def test_near_copies_count_once() -> None:
    seen = seen_of([3, 15], count=6)
    late = replace(seen, time=seen.time + 0.4, sigma=1.01 * seen.sigma)
    moved = replace(late, source=solar.vector(late.time, PLANT.site))
    found = plausibility.judge(join([seen, moved, seen]))
    assert found.reasons == dict.fromkeys(range(12, 36), "a copy of another sighting")
    # Another photograph at the same counts is no copy: its centroid differs.
    other = replace(moved, destination=moved.destination + [1e-6, 0.0, 0.0])
    assert not plausibility.judge(join([seen, other])).reasons
    # Nor is a lamp that stands elsewhere.
    near = replace(seen, source=seen.source * 50.0, source_at_infinity=np.zeros(12, np.bool_))
    apart = replace(near, source=near.source + [1e-3, 0.0, 0.0])
    assert not plausibility.judge(join([near, apart])).reasons


def test_a_beam_that_never_moved_was_not_measured() -> None:
    stuck = seen_of([3])
    stuck = replace(stuck, destination=np.tile(PLANT.targets[0].center + [0.1, 0.0, 0.0], (20, 1)))
    found = judge(join([seen_of([15]), stuck]))
    assert sorted(found.reasons) == list(range(20, 40))
    assert found.reasons[20].startswith("the beam position is identical to the last digit in")
    assert not judge(stuck.take([0, 9])).reasons
    # A camera in the field stands still: its sightings have another kind.
    assert not plausibility.judge(stuck, kinds=["field_camera"] * 20).reasons


def test_suns_of_other_times_are_a_note_where_most_rows_have_them() -> None:
    seen = seen_of([3])
    found = judge(replace(seen, time=seen.time + 3600.0))
    assert not found.reasons
    assert found.notes[0].startswith(
        "the sun directions of 20 of 20 sightings do not match their times"
    )


def _reversed(axis: int) -> object:
    sign = np.where(np.arange(2) == axis, -1.0, 1.0)
    return lambda s: replace(s, counts=s.counts * sign)


MISTAKES = {
    "the motor of azimuth seems reversed": _reversed(0),
    "the motor of elevation seems reversed": _reversed(1),
    "both seem reversed": lambda s: replace(s, counts=-s.counts),
    "its axes seem swapped: the counts of azimuth": lambda s: replace(s, counts=s.counts[:, ::-1]),
    "the azimuth of the sun seems to have the wrong sign": lambda s: replace(
        s, source=s.source * [-1.0, 1.0, 1.0]
    ),
    "the azimuth of the sun seems to be counted from south": lambda s: replace(
        s, source=s.source * [-1.0, -1.0, 1.0]
    ),
}


@pytest.mark.parametrize("count", [3, 20])
@pytest.mark.parametrize("reason", MISTAKES)
def test_the_mistake_of_one_mirror_is_named_and_the_others_are_learnt(
    reason: str, count: int
) -> None:
    wrong = MISTAKES[reason](seen_of([2], count=count))  # type: ignore[operator]
    seen = join([seen_of([0, 7]), wrong])
    learned = learning.learn(GROUP, seen, "guo6", rounds=2)
    (line,) = unexplained_mirrors(NAMES, learned)
    assert line.startswith(f"{NAMES[2]}: ")
    assert reason in line
    outcome = learned.static.outcome
    assert [FitOutcome(int(outcome[i])).name for i in (0, 2, 7)] == [
        "CONVERGED",
        "MISFIT",
        "CONVERGED",
    ]
    truth = machines()
    for row in (0, 7):
        wanted = truth[row].deviations["tilt_north"]
        found = learned.static.values[row, learned.model.index("tilt_north")]
        assert found == pytest.approx(float(wanted), abs=1.5 * MRAD)


def test_rows_of_another_mirror_are_named() -> None:
    wrong = replace(seen_of([15]), heliostat=np.full(20, 1, np.intp))
    (misfit,) = find_misfits(NOMINAL, join([seen_of([0, 7]), wrong]))
    assert misfit.row == 1
    assert misfit.reason.startswith(f"its rows seem to be those of {NAMES[15]}; ")


def test_a_mirror_that_did_not_move_is_not_converged() -> None:
    still = seen_of([2])
    still = replace(still, counts=np.tile(still.counts[:1], (20, 1)))
    seen = join([seen_of([0]), still])
    learned = learning.learn(GROUP, seen, "guo6", rounds=2)
    assert FitOutcome(int(learned.static.outcome[2])) is FitOutcome.UNMOVED
    assert "the mirror did not move: 20 sightings" in unexplained_mirrors(NAMES, learned)[0]
    assert not at_moment(NAMES, learned).learnt[2]
    half = seen_of([2])
    half.counts[:, 0] = half.counts[0, 0]
    (misfit,) = find_misfits(NOMINAL, half)
    assert misfit.reason == "the counts of azimuth did not change; check the motor and the log"


@pytest.mark.parametrize(
    ("factors", "text"),
    [
        ([0.9, 0.9], "the counts of azimuth and elevation seem scaled: they are about 0.90 times"),
        ([2.0, 2.0], "the counts of azimuth and elevation seem scaled: they are about 2.0"),
        ([1.0, 1.25], "the counts of elevation seem scaled: they are about 1.2"),
    ],
)
@pytest.mark.parametrize("every", [False, True])
def test_scaled_counts_are_named(factors: list[float], text: str, every: bool) -> None:
    seen = seen_of([2, 9, 15], noise=0.3e-3)
    mine = (seen.heliostat == 2) | every
    seen = replace(seen, counts=np.where(mine[:, None], seen.counts * factors, seen.counts))
    learned = learning.learn(PLANT, seen, "guo6", rounds=2)
    wrong = [2, 9, 15] if every else [2]
    assert [misfit.row for misfit in learned.misfits] == wrong
    assert all(misfit.reason.startswith(text) for misfit in learned.misfits)
    assert list(np.flatnonzero(at_moment(NAMES, learned).learnt)) == [
        row for row in (2, 9, 15) if row not in wrong
    ]


@pytest.mark.parametrize(
    ("text", "sign"),
    [
        ("mirrored left to right", [-1.0, 1.0]),
        ("mirrored top to bottom", [1.0, -1.0]),
        ("turned by half a turn", [-1.0, -1.0]),
    ],
)
def test_mirrored_photographs_are_named_once(text: str, sign: list[float]) -> None:
    target, seen = PLANT.targets[0], seen_of([0, 2, 9, 15], wide=0.7)
    places = target.plane_coordinates(seen.destination)
    wrong = replace(seen, destination=target.point(places * sign))
    learned = learning.learn(PLANT, wrong, "guo6", rounds=2)
    (line,) = unexplained_mirrors(NAMES, learned)
    names = ", ".join(NAMES[row] for row in (0, 2, 9, 15))
    assert line.startswith(f"{names}: the photographs of the targets seem {text}: read that way")
    assert not at_moment(NAMES, learned).learnt.any()
    assert learning.learn(PLANT, seen, "guo6", rounds=2).misfits == ()


def test_one_reversed_motor_does_not_accuse_the_camera() -> None:
    wrong = _reversed(0)(seen_of([2]))  # type: ignore[operator]
    for others in ([], [0], [0, 7]):
        seen = join([seen_of(others), wrong]) if others else wrong
        (misfit,) = find_misfits(NOMINAL, seen, targets=PLANT.targets)
        assert misfit.row == 2
        assert misfit.reason.startswith("the motor of azimuth seems reversed")


def test_sightings_that_contradict_each_other_are_not_learnt() -> None:
    rng, target = np.random.default_rng(5), PLANT.targets[0]
    wrong, good = seen_of([2]), seen_of([15])
    places = target.plane_coordinates(wrong.destination)
    places = places + rng.normal(0.0, 0.12, places.shape)
    wrong = replace(wrong, destination=target.point(places))
    learned = learning.learn(PLANT, join([good, wrong]), "guo6", rounds=2)
    (line,) = unexplained_mirrors(NAMES, learned)
    assert line.startswith(f"{NAMES[2]}: half of its ")
    assert "times their sigma, from where its other sightings predict them: no parameters" in line
    assert list(np.flatnonzero(at_moment(NAMES, learned).learnt)) == [15]
    # Far beyond a sigma that is stated too small, but small: learnt, and said.
    tight = replace(good, sigma=np.full(len(good), 1e-5))
    learned = learning.learn(PLANT, tight, "guo6", rounds=2)
    (line,) = unexplained_mirrors(NAMES, learned)
    assert "specify the true sigma, or check model and counts" in line
    assert list(np.flatnonzero(at_moment(NAMES, learned).learnt)) == [15]


def test_every_mirror_may_be_a_misfit() -> None:
    wrong = _reversed(0)(seen_of([2]))  # type: ignore[operator]
    learned = learning.learn(GROUP, wrong, "guo6", rounds=2)
    assert not at_moment(NAMES, learned).learnt.any()
    assert learned.misfits[0].row == 2


def test_a_fit_gives_no_parameters_that_no_mechanism_can_have() -> None:
    wrong = _reversed(1)(seen_of([2], count=6))  # type: ignore[operator]
    wide = {"tilt_north": 5.0, "tilt_east": 5.0}
    found = fit(GROUP, wrong, ("tilt_north", "tilt_east"), priors=wide)[NAMES[2]]
    assert FitOutcome(int(found.outcome)) is FitOutcome.MISFIT
    assert (found.values == 0.0).all()
    np.testing.assert_allclose(found.sigma, 5.0)


def test_one_mirror_says_nothing_about_the_population() -> None:
    one = learning.learn(GROUP, seen_of([15], shared=12e-3), "guo6")
    assert (one.hyper.mean == 0.0).all()
    many = learning.learn(GROUP, seen_of([0, 3, 9, 12, 15], shared=12e-3), "guo6")
    assert many.hyper.mean[many.names.index("elevation_bias")] > 5e-3


@pytest.mark.parametrize("fast", [3600.0, -3600.0, 1800.0])
def test_a_clock_in_another_zone_is_found(fast: float) -> None:
    found = check_clock(NOMINAL, seen_of([15], fast=fast), tuple(SIZES), PLANT.site)
    assert found is not None
    assert found.found
    assert found.error == pytest.approx(fast, abs=4.0 * found.sigma)
    assert found.sigma < 60.0
    side = "fast" if fast > 0.0 else "slow"
    assert f"({side})" in str(found)
    assert "the clock may be wrong by" in str(found)


def test_a_minute_shows_where_several_mirrors_agree() -> None:
    rows = [0, 4, 8, 12, 15, 17]
    found = check_clock(NOMINAL, seen_of(rows, fast=60.0), tuple(SIZES), PLANT.site)
    assert found is not None
    assert found.found
    assert found.error == pytest.approx(60.0, abs=4.0 * found.sigma)
    right = check_clock(NOMINAL, seen_of(rows), tuple(SIZES), PLANT.site)
    assert right is not None
    assert not right.found
    assert abs(right.error) < 4.0 * right.sigma
    assert "no error found" in str(right)
    assert check_clock(NOMINAL, seen_of(rows, count=5), tuple(SIZES), PLANT.site) is None


def report(plant: Plant, table: Path, seen: Sightings) -> CalibrationReport:
    write_sightings(table, seen, NAMES, [KIND] * len(seen))
    field = workflow.read_field_sightings(plant, table, table)
    return workflow.calibrate(field, "guo6", fraction=1.0)


def test_a_wrong_clock_changes_no_parameter(tmp_path: Path) -> None:
    found = report(PLANT, tmp_path / "s.csv", seen_of([15], fast=3600.0))
    assert found.rows[0].outcome is FitOutcome.CLOCK
    assert found.remarks[0].startswith("the clock may be wrong by 3")
    assert found.calibrated is PLANT
    tilt = found.results.names.index("tilt_north")
    assert found.results.values[15, tilt] == 0.0
    assert found.results.sigma[15, tilt] == pytest.approx(NOMINAL.parameter("tilt_north").prior)
    assert found.guo is None


def test_unmeasured_mirrors_keep_their_parameters(tmp_path: Path) -> None:
    earlier = {"tilt_north": np.where(np.arange(len(NAMES)) == 5, 2e-3, 0.0)}
    plant = PLANT.with_groups({"azel": GROUP.with_parameters(earlier)})
    found = report(plant, tmp_path / "s.csv", seen_of([15]))
    new = found.calibrated.groups["azel"]
    others = np.arange(len(NAMES)) != 15
    assert new.parameters["tilt_north"][5] == 2e-3
    assert (new.parameters["tilt_east"][others] == 0.0).all()
    assert new.parameters["tilt_east"][15] != 0.0
    assert "17 heliostats not learnt: parameters unchanged" in found.remarks
    path = tmp_path / "c.json"
    write_json(path, NAMES, found.learned, found.results, ("",) * 20)
    assert read_json(path).heliostats == (NAMES[15],)


def test_a_part_that_many_share_is_given_to_mirrors_without_parameters(tmp_path: Path) -> None:
    earlier = {"tilt_north": np.where(np.arange(len(NAMES)) == 5, 2e-3, 0.0)}
    plant = PLANT.with_groups({"azel": GROUP.with_parameters(earlier)})
    seen = seen_of([0, 1, 2, 3, 4, 9, 12, 15], shared=12e-3)
    found = report(plant, tmp_path / "s.csv", seen)
    new = found.calibrated.groups["azel"].parameters["elevation_bias"]
    assert new[5] == 0.0
    assert new[6] == pytest.approx(12e-3, abs=4e-3)
    shared = [line for line in found.remarks if "shared by the 8 measured heliostats: " in line]
    assert shared[0].startswith("9 heliostats without sightings of their own: ")
    assert "elevation_bias +" in shared[0]


ROW_FAULTS = ("year", "night", "count", "sky", "copy", "through", "huge", "none")
MIRROR_FAULTS = (*MISTAKES, "still", "few", "none")


def faulty(seen: Sightings, rng: np.random.Generator, faults: list[str], kind: str) -> Sightings:
    if kind in MISTAKES:
        seen = MISTAKES[kind](seen)  # type: ignore[operator]
    elif kind == "still":
        seen = replace(seen, counts=np.tile(seen.counts[:1], (len(seen), 1)))
    elif kind == "few":
        seen = seen.take(np.arange(int(rng.integers(1, 4))))
    for fault in faults:
        row = int(rng.integers(len(seen)))
        if fault == "year":
            seen = changed(seen, row, time=float(rng.choice([-3e9, 9e9, 2.4e11, np.nan])))
        elif fault == "night":
            seen = changed(seen, row, source=seen.source[row] * [1, 1, -1])
        elif fault == "count":
            seen = changed(seen, row, counts=rng.choice([-1, 1], 2) * 10.0 ** rng.uniform(6, 9, 2))
        elif fault == "huge":
            seen = changed(seen, row, counts=rng.choice([-1, 1], 2) * 10.0 ** rng.uniform(9, 300))
        elif fault == "sky":
            seen = changed(seen, row, destination=rng.normal(0.0, 1e4, 3))
        elif fault == "through":
            vertex = NOMINAL[seen.heliostat[row]].pose(seen.counts[row]).vertex
            seen = changed(seen, row, destination=vertex - rng.uniform(0, 30) * seen.source[row])
        elif fault == "copy":
            seen = join([seen, seen.take([row])])
    return seen


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    faults=st.lists(st.sampled_from(ROW_FAULTS), max_size=6),
    kinds=st.lists(st.sampled_from(MIRROR_FAULTS), min_size=1, max_size=3),
)
def test_no_row_and_no_mirror_ends_the_calibration_of_the_others(
    tmp_path_factory: pytest.TempPathFactory, seed: int, faults: list[str], kinds: list[str]
) -> None:
    rng = np.random.default_rng(seed)
    parts = [faulty(seen_of([3 * k]), rng, faults, kind) for k, kind in enumerate(kinds)]
    good = seen_of([16])
    table = tmp_path_factory.mktemp("s") / "s.csv"
    seen = join([*parts, good])
    write_sightings(table, seen, NAMES, [KIND] * len(seen))
    field = workflow.read_field_sightings(PLANT, table, table, now=NOON)
    assert all(line.count("\n") == 0 for line in field.left_out)
    assert len(field.sightings) + len(field.left_out) == len(seen)
    assert (field.sightings.heliostat == 16).sum() == 20
    learned = learning.learn(NOMINAL, field.sightings, "guo6", rounds=2)
    assert FitOutcome(int(learned.static.outcome[16])) is FitOutcome.CONVERGED
    tilt = learned.static.values[16, learned.model.index("tilt_north")]
    assert tilt == pytest.approx(float(machines()[16].deviations["tilt_north"]), abs=1.5 * MRAD)
    for k, kind in enumerate(kinds):
        if kind in MISTAKES:
            outcome = FitOutcome(int(learned.static.outcome[3 * k]))
            assert outcome is FitOutcome.MISFIT, (kind, outcome)


def test_a_folder_with_a_bad_year_and_a_copy_is_read(tmp_path: Path) -> None:
    for part in (juelich() / "properties").iterdir():
        (tmp_path / "properties").mkdir(exist_ok=True)
        (tmp_path / "properties" / part.name).symlink_to(part)
    (tmp_path / "tower-measurements.json").symlink_to(juelich() / "tower-measurements.json")
    lines = (juelich() / "measurements.csv").read_text(encoding="utf-8").splitlines()
    mine = [line for line in lines if line.startswith("BG15,") and ",,," not in line][:12]
    for k, year in ((2, "9999"), (4, "2219")):
        name, number, time, *rest = mine[k].split(",")
        mine[k] = ",".join([name, number, year + time[4:], *rest])
    table = "\n".join([lines[0], *mine, mine[7]])
    (tmp_path / "measurements.csv").write_text(f"{table}\n", encoding="utf-8")
    field = workflow.read_field_sightings(paint.read_plant(tmp_path), tmp_path)
    assert len(field.sightings) == 10
    assert [line.split(": ", 1)[1].split(":")[0] for line in field.left_out] == [
        "the year is out of range; correct the time",
        "the year is outside 1970 to 2099; correct the time",
        "a copy of another sighting",
    ]
