"""The benchmarks run and say on what; how long they take is nobody's business here."""

import ast
import contextlib
import functools
import importlib.util
import io
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from heliotrope.geometry import normalize, reflect

ROOT = Path(__file__).parents[1]
TIMES = {"best_ms", "median_ms"}
COLUMNS = {
    "tracking": {
        "mechanism", "heliostats", "contender", "branches", "threads", "iterations",
        "best_ns_per_heliostat", "median_ns_per_heliostat", "processor_ns_per_heliostat",
        "ratio_to_first", "growth_exponent", "peak_bytes_per_heliostat", "apart_rad",
    },
    "calibration": {"heliostats", "ms_per_heliostat", "scipy_ratio", "differs_sigma"},
    "airborne": {"work", "ratio_to_decoding", "per_second"} | TIMES,
    "imaging": {"photograph", "work", "ratio_to_decoding", "per_second"} | TIMES,
    "sun": {"times", "contender", "processor_ms", "ratio_to_first", "apart_rad"} | TIMES,
    "field": {"heliostats", "table", "work", "ratio_to_pandas"} | TIMES,
    "startup": {"command", "best_s", "median_s", "ratio_to_first"},
    "frames": {
        "format", "way", "trials", "refused", "survived", "unhurt", "false", "one_false_in",
    },
    "signing": {
        "frame", "plain_bytes", "signed_bytes", "more_ms_at_19200_baud", "more_ms_at_115200_baud",
    },
    "clusters": {
        "clusters", "heliostats", "frames_per_cluster_second", "heard", "cores_for_all",
        "processor_ms_per_cluster_second",
    },
    "plant": {"work", "cpu_s", "budget_s"},
    "control": {
        "heliostats", "clusters", "cores", "memory_mib", "longest_second_s", "flux_before",
        "order_s", "order_processing_s", "order_acknowledged_cpu_s", "dark_after_order_s",
        "dark_after_plant_loss_s", "dark_after_clock_jump_s", "stow_after_cluster_loss_s",
    },
    "console": {
        "heliostats", "viewers", "page_first_ready_s", "frames_panning", "messages_a_second_least",
        "emergency_heard_s", "emergency_acknowledged_s",
    },
    "day": {
        "work", "heliostats", "calibrated", "visits", "median_mrad", "predicted_mrad", "within_90",
        "cpu_s_per_h", "memory_mib",
    },
    "splits": {
        "split", "contender", "heliostats", "tested", "median_of_medians_mrad",
        "mean_of_medians_mrad", "processor_s_per_heliostat", "error_ratio", "time_ratio",
    },
    "prototype": {
        "seed", "start_utc", "heliostats", "calibrated", "calibrated_15_after_s",
        "true_median_mrad", "longest_pause_s", "not_calibrated",
    },
    "commission": {
        "case", "visits", "sightings", "never_measured", "later_mirrors_an_hour_and_target",
        "goal_after_h_of_sun", "predicted_50_90_mrad", "believed_50_90_mrad", "true_50_90_mrad",
        "true_over_predicted_90",
    },
    "coded": {
        "surface", "mirrors", "photographs", "proven", "rms_mrad", "worst_mrad", "within_90",
        "power_lost_share", "separation_cpu_s", "mirrors_an_hour",
    },
    "floor": {
        "split", "measured_mrad", "measured_within_90", "learner_on_drawn_mrad",
        "learner_on_drawn_within_90", "oracle_mrad", "oracle_low_mrad", "oracle_high_mrad",
        "visit_mrad", "photograph_mrad", "constants_mrad",
    },
    "production": {
        "field", "mirrors", "photographs", "seen", "rms_mrad", "worst_mrad", "within_90",
        "power_lost_share", "production_m2", "stack_s", "visit_s", "cpu_s", "changed",
    },
    "obstruction": {
        "distance_m", "hidden", "predicted_right_mrad", "predicted_up_mrad", "read_right_mrad",
        "read_up_mrad", "left_mrad", "left_of_flux_mrad",
    },
    "drifting": {
        "learns", "heliostats", "days", "visits", "median_mrad", "p90_mrad", "within_90",
    },
    "learning": {
        "sightings_before", "stream_us", "batch_ms", "ratio", "difference_sigma", "hypotheses",
        "state_kB",
    },
    "heliopoint": {
        "mirrors", "surface", "points", "sigma_plain_mrad", "sigma_mean_mrad", "error_mrad",
        "systematic_mrad", "sigma_total_mrad", "total_error_mrad", "within_90", "shapiro_p",
    },
    "spots": {
        "background", "condition", "frames", "clean", "accepted", "east_mm", "up_mm", "rms_mm",
        "worst_mm", "in_68", "in_95", "wrong_accepts", "wrong_rejects", "faults", "faults_named",
    },
    "first_run": {"figure", "value", "limit", "kept"},
    "flux": {
        "field", "mirrors", "figure", "sun_deg", "cold_ms", "limit_ms", "moved_ms",
        "moved_limit_ms", "cold_processor_ms", "grown_mb",
    },
    "flux_rays": {
        "field", "elevation_deg", "power_mw", "power_percent", "power_noise_percent",
        "efficiency_percent", "cells_percent", "cells_noise_percent", "seconds", "rays_seconds",
    },
    "aiming": {
        "field", "mirrors", "limit_of_peak", "cold_s", "cold_processor_s", "gap_percent",
        "excess_percent", "warm_s", "warm_processor_s", "warm_gap_percent", "power_mw",
        "image_size_mw", "image_size_peak_of_limit",
    },
    "clouds": {
        "case", "heliostats", "simulated_min", "flux_over_limit_percent", "back_percent",
        "kept_percent", "aimed_most", "cpu_s",
    },
    "bus": {"line", "question", "bytes", "wire_ms", "median_ms", "p99_ms", "cycle_of_32_s"},
}  # fmt: skip
#: A browser with fifty viewers, plants, days and many pictures take their time.
SLOW = {
    "clouds", "coded", "commission", "console", "control", "day", "drifting", "first_run", "flux",
    "imaging", "obstruction", "production", "prototype", "spots",
}  # fmt: skip
RESULT = {
    "name", "headline", "within_budget", "quick", "seconds", "others_cores", "machine", "rows",
}  # fmt: skip
MACHINE = {
    "cpu", "cores", "memory_gib", "system", "python", "versions", "commit", "date", "load_average",
}  # fmt: skip


def _run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "benchmarks", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )


def _module(monkeypatch: pytest.MonkeyPatch, name: str) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT))
    return importlib.import_module(f"benchmarks.{name}")


@functools.cache
def _quick(name: str) -> Any:
    """Run in this process: another would import everything again."""
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(said):
        patch.syspath_prepend(str(ROOT))
        patch.chdir(ROOT)
        patch.setattr(sys, "argv", ["benchmarks", name, "--json", "--quick"])
        assert importlib.import_module("benchmarks.__main__").main() == 0
    return json.loads(said.getvalue(), parse_constant=_no_number)


def _no_number(text: str) -> float:
    raise AssertionError(f"{text} is no JSON")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in COLUMNS]
)
def test_quick_run_gives_json(name: str) -> None:
    result = _quick(name)
    assert set(result) >= RESULT
    assert result["name"] == name
    assert result["quick"] is True
    assert set(result["machine"]) == MACHINE
    assert {"heliotrope", "numpy", "numba", "scipy"} <= set(result["machine"]["versions"])
    assert result["rows"]
    for row in result["rows"]:
        assert set(row) >= COLUMNS[name]


def _taken(path: Path) -> Iterator[tuple[str, str]]:
    """Yield module and name of all that a file takes from the product and the benchmarks."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            origin = node.module or ""
            if origin.partition(".")[0] in ("heliotrope", "benchmarks"):
                yield from ((origin, alias.name) for alias in node.names)


@pytest.mark.parametrize("path", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda p: p.stem)
def test_what_a_benchmark_takes_exists(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    for origin, name in _taken(path):
        module = importlib.import_module(origin)
        assert hasattr(module, name) or importlib.util.find_spec(f"{origin}.{name}"), name


def test_the_chain_of_artist_is_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without tilts, with its third, the zero of the elevation, and its fourth, left-handed."""
    from tests.support.machines import jacks

    from heliotrope.calibration.evaluation import beam_errors
    from heliotrope.calibration.sightings import sightings
    from heliotrope.mechanism import kinds

    artist = _module(monkeypatch, "_artist")
    nominal = kinds.two_jacks(
        np.array([[20.0, 90.0, 1.8]]), drives=jacks(), concentrator_translation=artist.CENTRE
    )
    counts = np.random.default_rng(0).uniform(20_000, 60_000, (20, 2))
    seen = sightings(np.zeros(20, np.intp), counts, [0.1, -0.8, 0.6], [0.0, -3.0, 40.0])
    found = artist.beam_errors(nominal, seen, [0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(found, beam_errors(nominal, seen).beam, atol=1e-9)
    for name, place, sign in (("elevation_initial_angle", 2, 1.0), ("non_orthogonality", 3, -1.0)):
        tilts = [0.0, 0.0, 0.0, 0.0]
        tilts[place] = sign * 4e-3
        moved = beam_errors(nominal.with_parameters({name: 4e-3}), seen).beam
        found = artist.beam_errors(nominal, seen, tilts)
        np.testing.assert_allclose(found, moved, atol=1e-9)


def test_ratios_are_over_heliotrope_in_the_same_split(monkeypatch: pytest.MonkeyPatch) -> None:
    splits = _module(monkeypatch, "splits")
    table = [
        {
            "split": split,
            "contender": contender,
            "median_of_medians_mrad": mrad,
            "processor_s_per_heliostat": seconds,
        }
        for split, contender, mrad, seconds in (
            ("azimuth", "Heliotrope", 0.5, 0.2),
            ("azimuth", "ARTIST", 3.0, 5.0),
            ("solstice", "Heliotrope", 1.0, 0.4),
            ("solstice", "ARTIST", 4.0, 6.0),
        )
    ]
    ratios = [(row["error_ratio"], row["time_ratio"]) for row in splits.with_ratios(table)]
    np.testing.assert_allclose(ratios, [(1.0, 1.0), (6.0, 25.0), (1.0, 1.0), (4.0, 15.0)])


def test_the_oracle_predicts_as_well_as_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against the blocks of the inverse; in turn, each from those before it alone."""
    floor = _module(monkeypatch, "floor")
    rng = np.random.default_rng(3)
    root = rng.normal(size=(10, 10))
    k = root @ root.T + np.eye(10)
    tested = np.array([False, True, False, True, False])
    both = np.repeat(tested, 2)
    expected = np.linalg.inv(np.linalg.inv(k)[np.ix_(both, both)])
    np.testing.assert_allclose(floor._predicted(k, ~tested, tested), expected, atol=1e-9)
    time = np.array([3.0, 1.0, 5.0, 4.0, 2.0])
    turns = floor._in_turn(k, time, tested)
    for place, i in enumerate(np.flatnonzero(tested)):
        alone = np.arange(5) == i
        expected = floor._predicted(k, time < time[i], alone)
        np.testing.assert_allclose(turns[place], expected, atol=1e-9)
    drawn = floor._drawn(k, rng).reshape(floor.DRAWS, 10)
    np.testing.assert_allclose(np.cov(drawn.T), k, atol=0.35 * np.diag(k).max())


def test_drawn_measurements_show_the_values_that_were_drawn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from tests.support.machines import jacks

    from heliotrope.calibration.fit.residuals import linearise
    from heliotrope.calibration.learn import learn
    from heliotrope.calibration.learn.learned import moved_by
    from heliotrope.calibration.sightings import sightings
    from heliotrope.mechanism import kinds

    floor = _module(monkeypatch, "floor")
    artist = _module(monkeypatch, "_artist")
    nominal = kinds.two_jacks(
        np.array([[20.0, 90.0, 1.8]]), drives=jacks(), concentrator_translation=artist.CENTRE
    )
    rng = np.random.default_rng(5)
    counts = rng.uniform(30_000, 45_000, (14, 2))
    pose = nominal[np.zeros(14, np.intp)].pose(counts)
    sun = np.array([0.1, -0.8, 0.6])
    way = reflect(sun, pose.normal)
    ends = pose.vertex + 100.0 * normalize(way + rng.normal(0.0, 5e-4, (14, 3)))
    times = 86_400.0 * np.arange(14.0)
    seen = sightings(np.zeros(14, np.intp), counts, sun, ends, time=times, sigma=5e-4)
    found = learn(nominal, seen, ("tilt_north", "tilt_up", "canting"))
    mirrors = floor._mirrors(found)
    again = floor._measured_again(found, mirrors, rng)
    at, _ = found.parameters_at(seen.heliostat, seen.time)
    moved = moved_by(nominal, seen.heliostat, found.names, at)
    rows = mirrors[0].rows
    before, after = (linearise(moved, s, found.names).residual[rows] for s in (seen, again))
    # The value is what the parameters have to explain: it grows by as much as the residual shrinks.
    rest = mirrors[0].data.value + (before - after) - mirrors[0].constant
    wander = np.linalg.cholesky(mirrors[0].wander)
    z = np.linalg.solve(wander, rest.ravel())
    assert 0.3 < np.mean(z**2) < 2.5


def test_tracking_covers_what_is_claimed() -> None:
    rows = _quick("tracking")["rows"]
    seen = {(r["contender"], r["branches"], r["threads"]) for r in rows}
    ours = {("Heliotrope", b, t) for b in (1, 2) for t in (1, 2)}
    assert seen == ours | {("NumPy", 1, 1), ("SciPy Rotation", 1, 1)}
    assert {r["mechanism"] for r in rows} == {"azimuth-elevation", "arbitrary axes"}
    for row in rows:
        assert row["apart_rad"] <= 1e-9
        assert (row["growth_exponent"] is None) == (row["heliostats"] == 1)


def test_bus_takes_no_less_than_the_wire() -> None:
    rows = _quick("bus")["rows"]
    assert {row["line"] for row in rows} == {"unpaced", "115,200 baud"}
    for row in rows:
        paced = row["line"] != "unpaced"
        assert row["wire_ms"] == pytest.approx(row["bytes"] * 1e4 / 115_200 if paced else 0.0)
        assert row["median_ms"] > row["wire_ms"]


def test_every_heliostat_of_every_cluster_is_polled() -> None:
    for row in _quick("clusters")["rows"]:
        assert row["heard"] == row["heliostats"] == 32 * row["clusters"]
        # Two questions to each, and three broadcasts.
        assert row["frames_per_cluster_second"] == pytest.approx(67.0, rel=0.1)


def test_a_plant_runs_and_is_defocused() -> None:
    # That all heliostats were live, and all are done, the benchmark itself makes sure of.
    result = _quick("plant")
    assert result["heliostats"] == 32 * result["clusters"] == 640
    assert [row["work"] for row in result["rows"]] == [
        "a second of operation",
        "of it: the checks",
        "the same, two keep-out volumes",
        "of it: the checks",
        "beams that nobody sent, 640 at rest",
        "order to all links",
        "all answers to it",
    ]
    assert all(row["cpu_s"] > 0.0 for row in result["rows"])


STAT = (
    "71 (a (b) c) S 70 71 71 0 -1 4194560 9 0 0 0 250 50 0 0 20 0 1 0 4242 860516352 3 0 0 0 0 0 0"
)


def test_a_process_is_read_by_its_files(monkeypatch: pytest.MonkeyPatch) -> None:
    first_run = _module(monkeypatch, "first_run")
    found = first_run.process_of(STAT, b"python\0-c\0main()\0twin\0", 100.0)
    assert found == first_run.Process(70, ("python", "-c", "main()", "twin"), 4242, 3.0)
    mine = first_run.processes()[os.getpid()]
    assert mine.parent == os.getppid()
    assert mine.work == pytest.approx(sum(os.times()[:2]), abs=0.5)


def test_each_process_of_a_plant_has_a_part(monkeypatch: pytest.MonkeyPatch) -> None:
    first_run = _module(monkeypatch, "first_run")
    worker = ("python", "-c", "from multiprocessing.spawn import spawn_main")
    known = {
        number: first_run.Process(parent, command, 0, 0.0)
        for number, parent, command in (
            (1, 0, ("init",)),
            (10, 1, ("python", "heliotrope", "run")),
            (11, 10, ("python", "-c", "main()", "twin", "--child")),
            (12, 11, worker),
            (13, 10, worker),
            (14, 10, ("python", "-m", "heliotrope.console.urgent_process")),
            (15, 14, worker),
            (16, 1, worker),
        )
    }
    assert first_run.roles(10, known) == {
        10: "plant", 11: "twin", 12: "drawing", 13: "computing", 14: "console", 15: "console",
    }  # fmt: skip
    assert first_run.roles(99, known) == {}


def test_the_stream_shows_new_calibrations_and_lateness(monkeypatch: pytest.MonkeyPatch) -> None:
    first_run = _module(monkeypatch, "first_run")
    from heliotrope.console.stream import ROW, LiveMessage

    def shows(utc: float, *calibrated: tuple[int, int]) -> LiveMessage:
        rows = np.zeros(len(calibrated), ROW)
        for row, (place, at) in zip(rows, calibrated, strict=True):
            row["row"], row["calibrated"] = place, at
        return LiveMessage({"utc": utc}, rows)

    seen = first_run.Followed(4)
    seen.take(shows(1000.5, (0, 0), (1, 500), (2, 0), (3, 600)), 50.0, 1000.75)
    assert seen.calibrated == [], "those of yesterday are not new"
    seen.take(shows(1001.5, (2, 1001)), 51.0, 1001.75)
    assert (seen.calibrated, seen.behind) == ([1.0], 0.25)
    seen.take(shows(1002.5, (1, 1002), (2, 1001)), 52.0, 1003.0)
    assert (seen.calibrated, seen.behind) == ([1.0, 2.0], 0.5)
    seen.take(shows(1008.5, (1, 1008)), 58.0, 1008.5)
    assert seen.behind == 5.0, "nothing was shown meanwhile"
    assert (seen.after(1.5 / 60.0), seen.after(5.0)) == (1, 3)


def test_a_figure_that_was_not_seen_misses_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    limited = _module(monkeypatch, "first_run").limited
    assert limited("a", 2.0, most=3.0) == {
        "figure": "a",
        "value": 2.0,
        "limit": "≤ 3",
        "kept": True,
    }
    assert limited("a", 2.0, least=3.0)["kept"] is False
    assert limited("a", None, most=3.0) == {
        "figure": "a", "value": None, "limit": "≤ 3", "kept": False,
    }  # fmt: skip
    assert limited("a", float("nan"))["value"] is limited("a", 1.0)["kept"] is None


def test_options_belong_to_the_benchmark_that_has_them() -> None:
    done = _run("startup", "--quick", "--minutes", "3")
    assert (done.returncode, done.stdout) == (2, "")
    assert "unrecognized arguments: --minutes 3" in done.stderr


def test_no_damaged_frame_is_taken_for_true_and_packets_are() -> None:
    result = _quick("frames")
    rows = {(row["format"], row["way"]): row for row in result["rows"]}
    ours = [row for (kind, _), row in rows.items() if kind == "version 2"]
    assert len(ours) == 5
    assert sum(row["trials"] for row in ours) == 20_000
    assert sum(row["false"] for row in ours) == 0
    assert min(row["refused"] for row in ours) > 3000
    # The same eyes see what Malan's checksum lets through, so they are not blind.
    assert rows["12-byte packet", "flip"]["false"] > 30
    noise = result["noise_bytes"]
    assert result["packets_found_in_noise_at_every_byte"] == pytest.approx(noise / 256, rel=0.2)


def test_table_names_machine_and_headline() -> None:
    done = _run("startup", "--quick")
    assert done.returncode == 0, done.stderr
    assert "heliotrope --help" in done.stdout
    assert "headline: " in done.stdout
    assert "cores" in done.stdout.splitlines()[0]


def test_names_and_unknown_name() -> None:
    assert set(_run().stdout.split()) == set(COLUMNS)
    done = _run("flying")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "there is no 'flying'; known: all, tracking" in done.stderr


@pytest.mark.parametrize("as_json", [True, False])
def test_all_keeps_and_sums_up(
    as_json: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    main, shared = _module(monkeypatch, "__main__"), _module(monkeypatch, "_run")

    def stand_in(name: str) -> Any:
        result = shared.Result([{"work": "nothing", "best_s": 1.5}], f"what {name} found")
        return type("Benchmark", (), {"run": staticmethod(lambda _: result)})

    monkeypatch.setattr(main.importlib, "import_module", stand_in)
    monkeypatch.setattr(shared, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(sys, "argv", ["benchmarks", "all", *(["--json"] if as_json else [])])
    assert main.main() == 0
    out = capsys.readouterr().out
    kept = {p.name: json.loads(p.read_text()) for p in (tmp_path / "results").iterdir()}
    assert set(kept) == {f"{name}.json" for name in COLUMNS}
    if as_json:
        assert json.loads(out) == {Path(name).stem: result for name, result in kept.items()}
    else:
        summary = out[out.rindex("summary") :]
        assert all(f"what benchmarks.{name} found" in summary for name in COLUMNS)


def test_a_failed_benchmark_says_why_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    main = _module(monkeypatch, "__main__")
    startup = _module(monkeypatch, "startup")
    monkeypatch.setattr(startup.sys, "executable", str(tmp_path / "python"))
    monkeypatch.setattr(sys, "argv", ["benchmarks", "startup"])
    assert main.main() == 1
    assert capsys.readouterr().err == (
        "benchmarks: startup: no command 'heliotrope' beside this Python; run `make setup`\n"
    )


def test_contenders_must_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    shared = _module(monkeypatch, "_run")
    assert shared.agree("angles", 1e-10, 1e-9, "rad") == 1e-10
    with pytest.raises(shared.BenchmarkError, match=r"angles: .* differ by 2e-09 rad, limit 1e-09"):
        shared.agree("angles", 2e-9, 1e-9, "rad")
    with pytest.raises(shared.BenchmarkError, match="differ by nan"):
        shared.agree("angles", float("nan"), 1e-9, "rad")


def test_plant_file_must_come_back(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    field, shared = _module(monkeypatch, "field"), _module(monkeypatch, "_run")
    plant, other = field._plant(3), field._plant(4)
    monkeypatch.setattr(field, "read_plant", lambda _: other)
    with pytest.raises(shared.BenchmarkError, match="csv: the plant read differs"):
        field._contenders(plant, "csv", tmp_path)


def test_arrays_must_converge(monkeypatch: pytest.MonkeyPatch) -> None:
    arrays, shared = _module(monkeypatch, "_array_tracking"), _module(monkeypatch, "_run")
    tracking = _module(monkeypatch, "tracking")
    table = tracking.field(5).armature.table
    angles, steps = arrays.track_arrays(table, tracking.SUN, tracking.AIM, arrays.by_formula, 1e-9)
    assert np.isfinite(angles).all()
    monkeypatch.setattr(arrays, "LIMIT", steps - 1)
    with pytest.raises(shared.BenchmarkError, match=r"1e-09 m is not reached in \d iterations"):
        arrays.track_arrays(table, tracking.SUN, tracking.AIM, arrays.by_formula, 1e-9)


@pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0, 2.0])
def test_growth_is_the_exponent_of_time(exponent: float, monkeypatch: pytest.MonkeyPatch) -> None:
    tracking = _module(monkeypatch, "tracking")
    small, large = (
        {"heliostats": n, "best_ns_per_heliostat": 7.0 * n**exponent / n} for n in (1000, 100_000)
    )
    tracking._add_growth([small], [large])
    assert large["growth_exponent"] == pytest.approx(exponent, abs=1e-12)


def test_field_stands_where_it_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    place = _module(monkeypatch, "tracking").field(2000).position
    distance = np.hypot(place[:, 0], place[:, 1])
    assert distance.min() >= 100.0
    assert distance.max() <= 900.0
    assert (place[:, 1] >= 0.0).all()


@pytest.mark.parametrize("name", ["_artist", "_solarpilot"])
def test_a_peer_that_is_not_here_is_named(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    peer = _module(monkeypatch, name)
    monkeypatch.delenv(peer.PYTHON, raising=False)
    assert peer.why_skipped() == f"not set: {peer.PYTHON}"
    for python in ("/nowhere/python", sys.executable):
        monkeypatch.setenv(peer.PYTHON, python)
        assert peer.why_skipped().startswith(f"{python} cannot import ")


@pytest.mark.skipif(
    not os.environ.get("HELIOTROPE_PYSAM_PYTHON"),
    reason="HELIOTROPE_PYSAM_PYTHON names no interpreter with NREL-PySAM",
)
def test_solarpilot_computes_the_same_field(monkeypatch: pytest.MonkeyPatch) -> None:
    flux = _module(monkeypatch, "flux")
    found = flux.solarpilot(*flux.spiral(200))
    assert found["solarpilot_s"] > 0.0
    # Its images and its union of shading and blocking are others; the geometry is the same.
    assert abs(found["solarpilot_efficiency_apart_percent"]) < 1.5


def test_peak_memory_is_seen_and_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    shared = _module(monkeypatch, "_run")
    assert 8e6 <= shared.peak_bytes(lambda: np.zeros(1_000_000)) < 9e6


def test_timing_takes_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    times = _module(monkeypatch, "_run").timed(
        {"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, 2
    )
    assert calls == ["a", "b"] * 3
    assert all(0.0 <= t.best <= t.median for t in times.values())
