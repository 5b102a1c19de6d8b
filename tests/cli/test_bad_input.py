"""Bad input: every malformed file and argument gets one clear line and exit code 2."""

import json
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from heliotrope.cli import main
from heliotrope.field.example import example_plant
from heliotrope.field.formats.plant_file import write_plant

TOML = """\
format = "heliotrope-plant"
version = 1
heliostats = "field.csv"
[plant]
name = "test"
[site]
latitude_deg = -33.93
longitude_deg = 18.87
[[targets]]
name = "target"
center_m = [0, 0, 13]
width_m = 3
height_m = 3
facing_deg = 180
[groups.azel]
kind = "azimuth_elevation"
mirror_width_m = 1.8
mirror_height_m = 1.2
[groups.azel.drives.azimuth]
kind = "rotary"
steps_per_turn = 200
gear_ratio = 2400
min_angle_deg = -180
max_angle_deg = 180
[groups.azel.drives.elevation]
kind = "rotary"
steps_per_turn = 200
gear_ratio = 2400
"""
CSV = "name,group,east_m,north_m,up_m\nA1,azel,0,-30,0\nA2,azel,10,-30,0\n"

PAINT: dict[str, Any] = {
    "heliostat_position": [50.9136, 6.388, 88.7],
    "height": 2.56,
    "width": 3.22,
    "kinematics_properties": {
        "actuators": [
            {
                "type_axis": "linear",
                "min_increment": 0,
                "max_increment": 68745,
                "increment": 154166.6667,
                "initial_stroke_length": 0.0774,
                "offset": 0.335,
                "pivot_radius": 0.338,
                "clockwise_axis_movement": clockwise,
                "initial_angle": 0.04,
            }
            for clockwise in (0, 1)
        ]
    },
}
TOWER: dict[str, Any] = {
    "power_plant_properties": {"coordinates": [50.9134, 6.3878, 87.0]},
    "target": {
        "type": "planar",
        "normal_vector": [0, 1, 0],
        "coordinates": {
            "center": [50.91339, 6.38782, 130.0],
            "upper_left": [50.91339, 6.38788, 133.7],
            "upper_right": [50.91339, 6.38776, 133.7],
            "lower_left": [50.91339, 6.38788, 126.5],
            "lower_right": [50.91339, 6.38776, 126.5],
        },
    },
}
MEASURED = (
    "heliostat,id,timestamp,target,sun_azimuth_deg_south0_east,sun_elevation_deg_apparent,"
    "axis_1_motor_position,axis_2_motor_position,utis_lat,utis_lon,utis_alt\n"
    "AA39,1,2022-06-01T10:00:00Z,target,20,50,20000,30000,50.91339,6.38782,130\n"
)


def _run(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sys, "argv", ["heliotrope", *arguments])
    with pytest.raises(SystemExit) as leaving:
        main()
    code = leaving.value.code
    return code if isinstance(code, int) else 0 if code is None else 1


def _one_line(text: str) -> None:
    lines = [line for line in text.strip().splitlines() if line.strip()]
    assert len(lines) == 1, text
    assert "Traceback" not in text


# --- the plant file and its table -----------------------------------------------------

REPLACED: list[tuple[str, str, str, str, str]] = [
    # name, which file, what, by what, what the line says
    ("not TOML", "toml", "[site]", "[site", "not valid TOML"),
    ("another format", "toml", '"heliotrope-plant"', '"gltf"', "format is 'gltf'"),
    ("a newer version", "toml", "version = 1", "version = 9", "9: input should be 1"),
    ("no site", "toml", "[site]\nlatitude_deg = -33.93\nlongitude_deg = 18.87\n", "",
     "'site' is missing"),
    ("latitude out of range", "toml", "-33.93", "-133.93", "site.latitude_deg: -133.93"),
    ("latitude in words", "toml", "-33.93", '"south"', "'south': input should be a valid number"),
    ("latitude NaN", "toml", "-33.93", "nan", "site.latitude_deg"),
    ("a typo in a key", "toml", "mirror_width_m", "miror_width_m", "did you mean 'mirror_width_m'"),
    ("unknown kind", "toml", '"azimuth_elevation"', '"azimuth-elevation"',
     "did you mean azimuth_elevation"),
    ("geometry of another kind", "toml", "mirror_width_m = 1.8",
     "mirror_width_m = 1.8\nspacing_m = 1", "spacing_m does not belong to kind azimuth_elevation"),
    ("stops reversed", "toml", "max_angle_deg = 180", "max_angle_deg = -190",
     "is above the upper stop"),
    ("gear ratio 0", "toml", "gear_ratio = 2400", "gear_ratio = 0", "gear_ratio: 0: input"),
    ("gear ratio missing", "toml", "gear_ratio = 2400\n", "", "'gear_ratio' is missing"),
    ("one drive only", "toml", "[groups.azel.drives.elevation]", "[groups.azel.drives.roll]",
     "'roll' is not a driven joint"),
    ("unknown drive", "toml", 'kind = "rotary"', 'kind = "hydraulic"', "hydraulic"),
    ("an angle twice", "toml", "min_angle_deg = -180", "min_angle_deg = -180\nmin_angle_rad = -3",
     "min_angle is specified in deg and rad"),
    ("target without size", "toml", "width_m = 3\n", "", "specify corners_m, or center_m"),
    ("target of no area", "toml", "center_m = [0, 0, 13]",
     "corners_m = [[0,0,0],[1,0,0],[2,0,0],[3,0,0]]\ncenter_m = [0, 0, 13]", "span no area"),
    ("target with 2 numbers", "toml", "center_m = [0, 0, 13]", "center_m = [0, 13]",
     "targets.0.center_m"),
    ("mirror of width 0", "toml", "mirror_width_m = 1.8", "mirror_width_m = 0",
     "mirror_width_m: 0: input should be greater than 0"),
    ("no mirror size", "toml", "mirror_width_m = 1.8\n", "", "mirror_width_m and mirror_height_m"),
    ("table not there", "toml", "field.csv", "fields.csv", "no such file"),
    ("parallel axes", "toml", 'kind = "azimuth_elevation"',
     'kind = "two_axis"\naxis_1 = [0,0,1]\naxis_2 = [0,0,2]\nnormal = [0,1,0]', "is not a driven"),
    ("empty table", "csv", CSV, "", "the file is empty"),
    ("header only", "csv", "A1,azel,0,-30,0\nA2,azel,10,-30,0\n", "", "but no heliostats"),
    ("missing column", "csv", "north_m", "nord_m", "there is no column north_m; add it"),
    ("NaN", "csv", "A2,azel,10", "A2,azel,nan", "heliostat A2: 'nan' is not a finite number"),
    ("no number", "csv", "A2,azel,10", "A2,azel,ten", "heliostat A2: 'ten' is not a finite number"),
    ("empty cell", "csv", "A2,azel,10", "A2,azel,", "heliostat A2: the cell is empty; enter m"),
    ("millimetres", "csv", "A2,azel,10,-30", "A2,azel,10000,-30000000", "check the unit"),
    ("duplicate name", "csv", "A2,azel", "A1,azel", "A1 is already the name of line 2; each name"),
    ("no name", "csv", "A2,azel", ",azel", "the heliostat has no name"),
    ("unknown group", "csv", "A2,azel", "A2,azle", "group 'azle' is not in plant.toml"),
    ("too many cells", "csv", "A2,azel,10,-30,0", "A2,azel,10,-30,0,7,8", "7 cells under 5"),
    ("unknown parameter", "csv", CSV,
     "name,group,east_m,north_m,up_m,parameters.tilt_nord_rad\nA1,azel,0,-30,0,0.001\n",
     "tilt_nord_rad"),
    ("infinite position", "csv", "A2,azel,10", "A2,azel,inf", "'inf' is not a finite number"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("which", "old", "new", "says"), [row[1:] for row in REPLACED], ids=[r[0] for r in REPLACED]
)
def test_plant_file(which, old, new, says, tmp_path, capsys, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    texts = {"toml": TOML, "csv": CSV}
    assert old in texts[which]
    texts[which] = texts[which].replace(old, new)
    (tmp_path / "plant.toml").write_text(texts["toml"], encoding="utf-8")
    (tmp_path / "field.csv").write_text(texts["csv"], encoding="utf-8")
    plant = str(tmp_path / "plant.toml")
    code = _run(["track", plant, "--heliostat", "A1", "--time", "2026-09-02T10:00Z"], monkeypatch)
    captured = capsys.readouterr()
    assert code == 2
    _one_line(captured.err)
    assert says in captured.err
    assert captured.out == ""
    # The check finds it too, and says it on the screen.
    assert _run(["field", "check", plant], monkeypatch) == 2
    flat = re.sub(r"\s+", " ", capsys.readouterr().out)
    assert "error" in flat


def test_the_unspoilt_plant_is_accepted(tmp_path, capsys, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "plant.toml").write_text(TOML, encoding="utf-8")
    (tmp_path / "field.csv").write_text(CSV, encoding="utf-8")
    plant = str(tmp_path / "plant.toml")
    assert _run(["field", "check", plant], monkeypatch) == 0
    assert "2 heliostats" in capsys.readouterr().out


TWO_AXIS = (
    TOML.replace("drives.azimuth", "drives.primary")
    .replace("drives.elevation", "drives.secondary")
    .replace(
        '"azimuth_elevation"',
        '"two_axis"\naxis_1 = [0, 0, 1]\naxis_2 = [1, 0, 0]\nnormal = [0, 1, 0]',
    )
)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("axis_2 = [1, 0, 0]", "axis_2 = [0, 0, 3]", "so they are parallel"),
        ("axis_2 = [1, 0, 0]", "axis_2 = [0, 0, 0]", "axis_2: a vector of length 0"),
        ("axis_2 = [1, 0, 0]\n", "", "axis_2 is missing; kind two_axis needs it"),
        (
            "axis_2 = [1, 0, 0]\nnormal = [0, 1, 0]",
            "",
            "axis_2, normal are missing; kind two_axis needs them",
        ),
        ("normal = [0, 1, 0]", "normal = [2, 0, 0]", "parallel to the secondary axis"),
        ("normal = [0, 1, 0]", "normal = [0, nan, 0]", "normal.1: nan"),
    ],
)
def test_axes(old, new, says, tmp_path, capsys, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    assert old in TWO_AXIS
    (tmp_path / "plant.toml").write_text(TWO_AXIS.replace(old, new), encoding="utf-8")
    (tmp_path / "field.csv").write_text(CSV, encoding="utf-8")
    plant = str(tmp_path / "plant.toml")
    assert _run(["track", plant, "--heliostat", "A1"], monkeypatch) == 2
    captured = capsys.readouterr()
    _one_line(captured.err)
    assert says in captured.err


# --- files that are none --------------------------------------------------------------


def _directory(path: Path) -> None:
    path.mkdir()


def _dangling(path: Path) -> None:
    path.symlink_to(path.with_name("nowhere"))


def _garbage(path: Path) -> None:
    # 200 MB that take no room on the disk.
    with path.open("wb") as stream:
        stream.write(bytes(range(256)) * 16)
        stream.truncate(200 * 2**20)


FILES: list[tuple[str, Callable[[Path], object], str]] = [
    ("missing", lambda _path: None, "no such file"),
    ("empty", lambda path: path.touch(), "the file is empty"),
    ("dangling link", _dangling, "no such file"),
    ("binary", lambda path: path.write_bytes(b"\x7fELF\0\0\1\2" * 50), "binary"),
    ("200 MB of garbage", _garbage, "MiB"),
    ("Latin-1", lambda path: path.write_bytes("Jülich".encode("latin-1")), "not UTF-8"),
]


@pytest.mark.parametrize("suffix", [".toml", ".xml"])
@pytest.mark.parametrize(("make", "says"), [r[1:] for r in FILES], ids=[r[0] for r in FILES])
def test_files_that_are_none(make, says, suffix, tmp_path, capsys, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / f"plant{suffix}"
    make(path)
    if suffix == ".xml" and says == "not UTF-8":
        says = "plant.xml"
    assert _run(["track", str(path), "--heliostat", "A1"], monkeypatch) == 2
    captured = capsys.readouterr()
    _one_line(captured.err)
    assert says in captured.err
    assert captured.out == ""


def test_a_file_that_cannot_be_read(tmp_path, capsys, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    """The memory of a process refuses to be read from its start, even by root."""
    (tmp_path / "plant.toml").symlink_to("/proc/self/mem")
    assert _run(["field", "check", str(tmp_path / "plant.toml")], monkeypatch) == 2
    assert "cannot be read (Input/output error)" in capsys.readouterr().out


# --- PAINT ----------------------------------------------------------------------------


def _set(document: dict[str, Any], place: list[Any], value: Any) -> dict[str, Any]:
    copy = json.loads(json.dumps(document))
    node = copy
    for key in place[:-1]:
        node = node[key]
    if value is None:
        del node[place[-1]]
    else:
        node[place[-1]] = value
    return copy


JACK = ["kinematics_properties", "actuators", 0]
SPOILT: list[tuple[str, str, list[Any], Any, str]] = [
    ("no position", "heliostat", ["heliostat_position"], None, "'heliostat_position' is missing"),
    ("two coordinates", "heliostat", ["heliostat_position"], [50.9, 6.4], "found 2 values"),
    ("latitude 150", "heliostat", ["heliostat_position", 0], 150.0, "150.0 is outside -90 to 90"),
    ("width in mm", "heliostat", ["width"], 3220.0, "3220.0 is outside 0.001 to 100"),
    ("width a text", "heliostat", ["width"], "3.22", "expected a number, found '3.22'"),
    ("one actuator", "heliostat", ["kinematics_properties", "actuators"], [1],
     "1 actuators; a heliostat has 2"),
    ("no triangle", "heliostat", [*JACK, "initial_stroke_length"], 0.9, "do not form a triangle"),
    ("increment 0", "heliostat", [*JACK, "increment"], 0, "must not be 0"),
    ("stops reversed", "heliostat", [*JACK, "min_increment"], 99999, "above the upper stop"),
    ("NaN", "heliostat", [*JACK, "offset"], math.nan, "nan is outside"),
    ("another actuator", "heliostat", [*JACK, "type_axis"], "hydraulic", "'hydraulic'"),
    ("no reference", "tower", ["power_plant_properties"], None, "is missing"),
    ("no corner", "tower", ["target", "coordinates", "upper_left"], None, "corner 'upper_left'"),
    ("no centre", "tower", ["target", "coordinates", "center"], None, "'center' is missing"),
]  # fmt: skip


def _paint_folder(tmp_path: Path, heliostat: str, tower: str, measured: str) -> Path:
    (tmp_path / "properties").mkdir()
    (tmp_path / "properties" / "AA39.json").write_text(heliostat, encoding="utf-8")
    (tmp_path / "tower-measurements.json").write_text(tower, encoding="utf-8")
    (tmp_path / "measurements.csv").write_text(measured, encoding="utf-8")
    return tmp_path


@pytest.mark.parametrize(
    ("which", "place", "value", "says"), [r[1:] for r in SPOILT], ids=[r[0] for r in SPOILT]
)
def test_paint(which, place, value, says, tmp_path, capsys, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    documents = {"heliostat": PAINT, "tower": TOWER}
    documents[which] = _set(documents[which], place, value)
    texts = [json.dumps(documents[key]) for key in ("heliostat", "tower")]
    folder = _paint_folder(tmp_path, *texts, MEASURED)
    assert _run(["calibrate", str(folder), "--report", str(tmp_path / "out")], monkeypatch) == 2
    captured = capsys.readouterr()
    _one_line(captured.err)
    assert says in captured.err
    assert not (tmp_path / "out").exists()


TEXTS = [
    ("truncated JSON", "heliostat", json.dumps(PAINT)[:300], "not valid JSON"),
    ("a list", "heliostat", "[1, 2]", "expected an object"),
    ("empty JSON", "tower", "", "the file is empty"),
    ("missing column", "measured", MEASURED.replace("utis_lat", "lat"), "no column utis_lat"),
    ("empty measurements", "measured", "", "the file is empty"),
    ("all rows bad", "measured", MEASURED.replace("20000", "x"), "no measurement can be used"),
]


@pytest.mark.parametrize(
    ("which", "text", "says"), [r[1:] for r in TEXTS], ids=[r[0] for r in TEXTS]
)
def test_paint_texts(which, text, says, tmp_path, capsys, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    texts = {"heliostat": json.dumps(PAINT), "tower": json.dumps(TOWER), "measured": MEASURED}
    texts[which] = text
    folder = _paint_folder(tmp_path, texts["heliostat"], texts["tower"], texts["measured"])
    assert _run(["calibrate", str(folder), "--report", str(tmp_path / "out")], monkeypatch) == 2
    captured = capsys.readouterr()
    _one_line(captured.err)
    assert says in captured.err


# --- arguments ------------------------------------------------------------------------

TRACK = ["track", "PLANT", "--heliostat", "P1A"]
ARGUMENTS: list[tuple[list[str], str]] = [
    (["track", "PLANT", "--heliostat", "P1D"], "there is no heliostat 'P1D'; did you mean"),
    ([*TRACK, "--aim", "1,2"], "write three numbers in metres"),
    ([*TRACK, "--aim", "a,b,c"], "write three numbers in metres"),
    ([*TRACK, "--aim", "nan,0,0"], "write three numbers in metres"),
    ([*TRACK, "--target", "tarqet"], "did you mean target"),
    ([*TRACK, "--aim", "0,0,9", "--target", "target"], "not both"),
    ([*TRACK, "--time", "2026-09-02T10:00"], "has no time zone"),
    ([*TRACK, "--time", "yesterday"], "is not ISO 8601"),
    ([*TRACK, "--sun", "0,0,0"], "write the sun vector as east,north,up"),
    ([*TRACK, "--every", "soon"], "write it as 30s, 5min or 1h"),
    ([*TRACK, "--every", "0s"], "from 1 s to 1000 h"),
    (["sun", "--latitude", "91"], "91"),
    (["sun", "--longitude", "-200"], "-200"),
    (
        ["sun", "--pressure", "5"],
        "--pressure must be a number from 300 to 1,200, not '5' (Air pressure at the site, hPa",
    ),
    (
        ["sun", "--pressure", "101325"],
        "--pressure must be a number from 300 to 1,200, not '101325' (Air pressure",
    ),
    (["sun", "--time", "2026-13-01T00:00Z"], "is not ISO 8601"),
    (["calibrate", "NOWHERE"], "no such file"),
    (["parameters", "psi_t=much"], "write NAME=VALUE with a number"),
    (["parameters", "psi=1"], "psi_t"),
    (["evaluate", "NOWHERE"], "no such file"),
    (["evaluate", "PAINT", "--fraction", "0"], "--fraction must be a number from 0.01 to 0.999"),
    (["evaluate", "PAINT", "--model", "tilt_north,lean"], "lean"),
    (["evaluate", "PAINT", "--prior", "tilt_north"], "write NAME=SIGMA"),
    (["evaluate", "PAINT", "--prior", "tilt_north=-1"], "above 0"),
    (["calibrate", "PAINT", "--prior", "lean=0.01"], "lean"),
    (["evaluate", "PAINT", "--scheduler", "nowhere:1"], "no reply"),
    (["evaluate", "PAINT", "--sightings", "NOWHERE"], "sightings are .csv or"),
    (["calibrate", "EMPTY"], "is missing in this folder"),
    (["calibrate", "PAINT", "--model", "malan9"], "there is no model 'malan9'"),
    (["calibrate", "PAINT", "--model", "malan9"], "malan9"),
    (
        ["calibrate", "PAINT", "--fraction", "1.5"],
        "--fraction must be a number from 0.01 to 1, ",
    ),
    (["fetch", "almeria", "AA39", "--into", "EMPTY"], "there is no data set 'almeria'"),
    (["fetch", "juelich", "../AA39", "--into", "EMPTY"], "use a name of letters and digits"),
]


@pytest.mark.parametrize(("arguments", "says"), ARGUMENTS, ids=[" ".join(a[0]) for a in ARGUMENTS])
def test_arguments(arguments, says, tmp_path, capsys, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "empty").mkdir()
    (tmp_path / "paint").mkdir()
    write_plant(example_plant(), tmp_path / "plant.toml")
    _paint_folder(tmp_path / "paint", json.dumps(PAINT), json.dumps(TOWER), MEASURED)
    places = {
        "PLANT": str(tmp_path / "plant.toml"),
        "NOWHERE": str(tmp_path / "nowhere"),
        "EMPTY": str(tmp_path / "empty"),
        "PAINT": str(tmp_path / "paint"),
    }
    monkeypatch.chdir(tmp_path)
    assert _run([places.get(a, a) for a in arguments], monkeypatch) == 2
    captured = capsys.readouterr()
    _one_line(captured.err)
    assert says in captured.err


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (("flux",), "specify --site LATITUDE,LONGITUDE,HEIGHT"),
        (("aim", "--limit=100"), "specify --site LATITUDE,LONGITUDE,HEIGHT"),
        (("standby",), "use a file that contains its site, such as a plant file (TOML)"),
        (("glare",), "use a file that contains its site, such as a plant file (TOML)"),
    ],
    ids=lambda given: given[0] if isinstance(given, tuple) else "",
)
def test_a_layout_without_a_site_gets_advice_that_the_command_knows(  # type: ignore[no-untyped-def]
    command, says, tmp_path, capsys, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bare.csv").write_text("x,y,z\n10,50,0\n-10,50,0\n", encoding="utf-8")
    assert _run([command[0], "bare.csv", *command[1:]], monkeypatch) == 2
    line = capsys.readouterr().err
    _one_line(line)
    begin = "heliotrope: bare.csv: a table of positions contains no site, so the sun cannot be "
    assert line == f"{begin}computed; {says}\n"


def test_the_table_is_long_enough() -> None:
    count = len(REPLACED) + 2 * len(FILES) + len(SPOILT) + len(TEXTS) + len(ARGUMENTS)
    assert count >= 60
