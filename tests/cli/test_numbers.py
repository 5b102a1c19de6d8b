"""Every number of the command line ends in a right value, or in one line and exit code 2."""

import contextlib
import importlib
import io
import random
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer
from PIL import Image
from tests.cli.test_bad_input import TOML

from heliotrope.calibration.sighting_table import write_sightings
from heliotrope.calibration.sightings import camera_target
from heliotrope.cli import app, main
from heliotrope.field.formats.plant_file import read_plant
from heliotrope.geometry import reflect
from heliotrope.mechanism import track
from heliotrope.sun import vector

#: Longest time of one case, s.
LONGEST = 120
FIELD = "name,group,east_m,north_m,up_m\nA1,azel,0,-30,0\nA2,azel,6,-36,0\n"
RECEIVER = """
[[receivers]]
name = "receiver"
kind = "planar"
center_m = [0, 0, 13]
normal = [0, -1, 0]
width_m = 3
height_m = 3
"""
NOON = "2026-06-21T12:00:00Z"
#: Texts for numbers, by what people and programs write.
TEXTS = (
    "nan", "-nan", "inf", "-inf", "Infinity", "0", "-0.0", "-1", "-1e-3", "1e308", "-1e308",
    "1e309", "1e-308", "5e-324", "123456789012345678901234567890", "-99999999999999999999", "",
    " ", "abc", "1m", "5 deg", "0,5", "1.000,5", "1_0", "0x10", "1e", "٣", "½", "--", "1;2", "None",
    "1", "2", "0.5", "3.0", "100",
)  # fmt: skip
#: Options that take several numbers or a duration in one text, with the words of a good one.
WRITTEN = {
    "--every": "1h", "--step": "1h", "--settle": "5s", "--exposure": "2s", "--interval": "2s",
    "--look": "3s", "--photo": "2.5s", "--endurance": "25min", "--change": "5min",
    "--by-slot": "", "--clear": "0.5",
    "--aim": "0,0,13", "--sun": "0,-0.6,0.8", "--site": "37,-5,100", "--at": "0,0,0",
    "--home": "0,0,0", "--led": "0,0,0", "--elevations": "35,50", "--rtk-mm": "6,6,8",
    "--tower": "0,0,1,10", "--focus": "80", "--cells": "4x8", "--facets": "3x2",
    "--canting": "90",
    "--offset-mm": "0,0,0", "--size": "640x480", "--prior": "tilt_north=0.005",
}  # fmt: skip
#: Least words of each command that has numbers; ctl and store fail for want of a plant, later.
WORDS: dict[str, tuple[str, ...]] = {
    "sun": ("--time", NOON),
    "track": ("plant.toml", "--heliostat", "A1", "--time", NOON),
    "view": ("plant.toml", "v.html", "--heliostat", "A1", "--time", NOON, "--every", "4h"),
    "flux": ("flux.toml", "--sun", "0,0.6,0.8", "--cells", "4x8"),
    "aim": ("flux.toml", "--limit", "1e4", "--sun", "0,0.6,0.8", "--cells", "4x8"),
    "standby": ("plant.toml",),
    "glare": ("plant.toml",),
    "surface": ("plant.toml", ".", "--heliostat", "A1"),
    "image": ("a.png", "--plant", "plant.toml", "--no-pictures", "--processes", "1"),
    "calibrate": ("plant.toml", "--sightings", "s.csv", "--model", "tilt_north,tilt_east"),
    "evaluate": ("plant.toml", "--sightings", "s.csv", "--model", "tilt_north,tilt_east"),
    "plan": ("plant.toml", "--heliostat", "A1", "--from", NOON, "--days", "0.5", "--every", "3h"),
    "commission": ("plant.toml", "--from", NOON, "--days", "0.5", "--every", "3h"),
    "run": ("plant.toml",),
    "twin": ("plant.toml", "--folder", "twin"),
    "cluster": ("no.toml",),
    "simulate": ("--hours", "0.001"),
    "demo": ("--into", "demo"),
    "field layout": ("radial", "--out", "l.toml", "--heliostats", "40"),
    "camera calibrate": ("plant.toml", "none", "--camera", "c"),
    "camera teach": ("plant.toml", "none.png", "--target", "target"),
    "camera receiver": ("plant.toml", "--camera", "c"),
    "drone plan": ("plant.toml", "--into", "flight", "--points", "2"),
    "drone evaluate": ("none", "--field", "plant.toml"),
    "drone match": ("none", "--field", "plant.toml"),
    "drone dome": ("plant.toml", "--into", "dome", "--targets", "4", "--photographs", "8"),
    "drone rtk": ("none", "--field", "plant.toml"),
    "drone simulate": (
        "plant.toml", "sim", "--size", "64x48", "--columns", "1", "--rows", "1",
        "--heliostats", "1", "--distance", "20",
    ),
    "ctl token": ("a",),
    "keys tls": ("none", "--name", "a.example.org"),
    "ctl command": ("GOTO", "A1"),
    "ctl aim": ("0,0,10", "A1"),
    "ctl standby": ("none.csv",),
    "ctl versions": ("A1", "1"),
    "ctl trend": (),
    "ctl journal": (),
    "ctl events": (),
    "ctl approvals": (),
    "ctl calibrate": ("A1",),
    "ctl parameters": ("A1",),
    "ctl plant-file": (),
    "ctl photographs": ("A1",),
    "ctl reading": ("wind",),
    "ctl out-of-service": ("--reason", "x", "A1"),
    "ctl automatic": ("A1",),
    "ctl stow": ("A1",),
    "ctl defocus": ("A1",),
    "ctl timetable": ("a", "A1"),
}  # fmt: skip
#: Commands whose right values compute for seconds: left to the slow test.
SLOW = {
    "demo", "simulate", "commission", "calibrate", "evaluate", "plan", "view", "image",
    "drone plan", "drone simulate", "drone dome",
}  # fmt: skip


def commands(found: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Yield every command with its path."""
    for name, one in getattr(found, "commands", {}).items():
        yield from commands(one, (*path, name))
    if not hasattr(found, "commands"):
        yield " ".join(path), found


def numeric(param: Any) -> bool:
    """Return whether a parameter is a number, or a list of numbers."""
    return any(kind in str(param.type_descriptor.annotation) for kind in ("float", "int'", "[int"))


PARAMS = [(path, p) for path, c in commands(typer.main.get_command(app)) for p in c.params]
NUMBERS = [(path, p) for path, p in PARAMS if numeric(p)]
ASKED = [(path, p) for path, p in PARAMS if numeric(p) or (p.opts[0] in WRITTEN and not p.is_flag)]


@pytest.mark.parametrize(("path", "param"), NUMBERS, ids=[f"{c} {p.opts[0]}" for c, p in NUMBERS])
def test_every_number_of_the_command_line_has_limits(path: str, param: Any) -> None:
    assert np.isfinite([param.min, param.max]).all()
    assert param.min < param.max
    assert param.default is None or param.min <= param.default <= param.max
    assert path in WORDS


def value(rng: random.Random, param: Any) -> str:
    """Return a text for a number: one of `TEXTS`, a limit, or a good text with one changed part."""
    written = WRITTEN.get(param.opts[0])
    if numeric(param) or not written:
        ends = [] if param.min is None else [param.min, param.max]
        limits = [f"{end}" for end in ends] + [f"{2 * end + 1}" for end in ends]
        return rng.choice([*TEXTS, *limits])
    if rng.random() < 0.3:
        return rng.choice(TEXTS)
    if written[-1] in "shn":
        return rng.choice(TEXTS) + rng.choice(["s", "min", "h", "ms", " d"])
    parts = written.replace("=", ",=").replace("x", ",x").split(",")
    place = rng.randrange(len(parts))
    mark = parts[place][0] if parts[place][0] in "=x" else ""
    parts[place] = mark + rng.choice(TEXTS)
    return ",".join(parts).replace(",=", "=").replace(",x", "x")


def words(rng: random.Random, path: str, param: Any) -> list[str]:
    """Return a command line in which one number, sometimes two, has a text of `value`."""
    line = [*path.split(), *WORDS[path]]
    chosen = [param]
    if rng.random() < 0.3:
        chosen.append(rng.choice([p for other, p in ASKED if other == path]))
    for one in chosen:
        text = value(rng, one)
        line += [text] if one.param_type_name == "argument" else [f"{one.opts[0]}={text}"]
    if rng.random() < 0.3 and any(p.opts[0] == "--json" for other, p in PARAMS if other == path):
        line.append("--json")
    return line


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a plant of two mirrors, eight sightings and a grey picture."""
    folder = tmp_path_factory.mktemp("numbers")
    toml = TOML.replace("-33.93", "37.0").replace("18.87", "-5.0")
    (folder / "plant.toml").write_text(toml, encoding="utf-8")
    (folder / "flux.toml").write_text(toml + RECEIVER, encoding="utf-8")
    (folder / "field.csv").write_text(FIELD, encoding="utf-8")
    Image.fromarray(np.full((48, 64), 90, np.uint8)).save(folder / "a.png")
    plant = read_plant(folder / "plant.toml")
    time = np.datetime64("2026-06-21T08:00", "s").astype(float) + 3600.0 * np.arange(8.0)
    sun, machine = vector(time, plant.site), plant["A1"].calibrated
    counts = track(machine, sun, plant.targets[0].center).best_counts
    pose = machine.pose(counts)
    spots = plant.targets[0].intersect(pose.vertex, reflect(sun, pose.normal))
    seen = camera_target(0, counts, sun, spots, time=time, sigma=1e-3)
    write_sightings(folder / "s.csv", seen, ("A1", "A2"), ["camera_target"] * 8)
    return folder


class TookTooLongError(Exception):
    """A case ran beyond its time."""


def _stop(*_: object) -> None:
    raise TookTooLongError


def outcome(line: list[str], place: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Run a command line; return its fault, "" if it ends as it should."""
    monkeypatch.chdir(place)
    monkeypatch.setattr(sys, "argv", ["heliotrope", *line])
    monkeypatch.setattr("getpass.getpass", lambda *_, **__: "the password of a person")
    out, err = io.StringIO(), io.StringIO()
    signal.signal(signal.SIGALRM, _stop)
    signal.alarm(LONGEST)
    code: object = None
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main()
    except SystemExit as leaving:
        code = leaving.code
    except BaseException as error:  # noqa: BLE001 - any other end is what is looked for
        return f"{type(error).__name__}: {error}"
    finally:
        signal.alarm(0)
    if code in (0, 1):
        bad = [word for word in ("nan", "inf") if f" {word} " in f" {out.getvalue()} "]
        return f"exit {code}, and prints {bad}" if bad else ""
    lines = err.getvalue().splitlines()
    return "" if code == 2 and len(lines) == 1 else f"exit {code}, {len(lines)} lines: {lines[:3]}"


def cases(seed: int, count: int, asked: list[tuple[str, Any]]) -> Iterator[list[str]]:
    """Yield command lines, each number in turn."""
    rng = random.Random(seed)
    for k in range(count):
        yield words(rng, *asked[k % len(asked)])


@contextlib.contextmanager
def not_begun(options: Sequence[str], seed: int, measured: int) -> Iterator[Any]:
    """Yield a simulated field of the plant, without its process."""
    del options, seed, measured
    yield SimpleNamespace(folder=Path.cwd(), begin=None)


def _faults(lines: Iterator[list[str]], place: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    # A plant that may run would do so until Ctrl-C.
    run = importlib.import_module("heliotrope.cli.run.plant")
    monkeypatch.setattr(run, "run_plant", lambda *_: None)
    # A thousand million rays take an hour.
    light = importlib.import_module("heliotrope.optics.plant_flux")
    trace = light.trace
    monkeypatch.setattr(light, "trace", lambda s, n, **more: trace(s, min(n, 1e3), **more))
    process = importlib.import_module("heliotrope.cli.run.twin_process")
    monkeypatch.setattr(process, "twin_process", not_begun)
    field = importlib.import_module("heliotrope.cli.twin")
    monkeypatch.setattr(field, "_run", lambda *_, **__: None)
    ends = ((line, outcome(line, place, monkeypatch)) for line in lines)
    return [f"{' '.join(line)}: {fault}" for line, fault in ends if fault]


def test_a_number_ends_in_a_value_or_in_one_line(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    quick = [(path, param) for path, param in ASKED if path not in SLOW]
    assert _faults(cases(1, len(quick), quick), place, monkeypatch) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_every_number_ends_in_a_value_or_in_one_line(
    seed: int, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert _faults(cases(seed, 250, ASKED), place, monkeypatch) == []


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (
            ("sun", "--height", "0,5"),
            "a number from -500 to 9,000 with a decimal point, without a comma, not '0,5' (He",
        ),
        (
            ("sun", "--height", "5 m"),
            "--height must be a number from -500 to 9,000, not '5 m' (Height",
        ),
        (
            ("field", "layout", "radial", "--heliostats", "1.5"),
            "must be a whole number from 1 to 1,",
        ),
        (("ctl", "reading", "wind", "inf"), "value must be a number from -1,000,000,000 to"),
        (("sun", "--every", "123456789012345678901234567890h"), "from 1 s to 1000 h"),
        (("sun", "--every", "0.1s"), "from 1 s to 1000 h"),
        (("parameters", "psi_t=1e300"), "write NAME=VALUE with a number"),
        (("sun", "--lat", "5"), "No such option: --lat"),
        (("moon",), "No such command 'moon'; see heliotrope -h"),
        (("track",), "Missing argument 'field'; see heliotrope track -h"),
    ],
)
def test_the_line_names_option_value_and_limits(
    line: tuple[str, ...], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["heliotrope", *line])
    monkeypatch.setattr("getpass.getpass", lambda *_, **__: "the password of a person")
    with pytest.raises(SystemExit) as leaving:
        main()
    captured = capsys.readouterr()
    assert (leaving.value.code, captured.out, captured.err.count("\n")) == (2, "", 1)
    assert says in captured.err
