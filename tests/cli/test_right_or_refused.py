"""Track, sun and readers: what is true, or one line that says why not."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from tests.cli.test_bad_input import CSV, TOML

from heliotrope.cli import main

#: Mirrors 30 m south (A1, A2) and north (B1) of a target that faces south, and one in its plane.
FIELD = "name,group,east_m,north_m,up_m\nA1,azel,0,-30,0\nB1,azel,0,30,0\nC1,azel,0,0,11\n"
SPAIN = TOML.replace("-33.93", "37.0").replace("18.87", "-5.0")


@pytest.fixture
def run(capsys: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run a command; return its exit code, and both outputs."""

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["heliotrope", *map(str, arguments)])
        with pytest.raises(SystemExit) as leaving:
            main()
        captured = capsys.readouterr()
        code = leaving.value.code
        return (code if isinstance(code, int) else 0), captured.out, captured.err

    return call


def _plant(folder: Path, toml: str = SPAIN, table: str = FIELD) -> Path:
    (folder / "plant.toml").write_text(toml, encoding="utf-8")
    (folder / "field.csv").write_text(table, encoding="utf-8")
    return folder / "plant.toml"


NOON = ("--time", "2026-06-21T12:00:00Z")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (
            ("A1", "--time", "2026-06-21T23:00:00Z"),
            "the sun is 26.56° below the horizon at 2026",
        ),
        (("A1", "--time", "2026-06-21T23:00:00Z", "--law", "guo"), "below the horizon"),
        (("A1", "--time", "2026-06-21T23:00:00Z", "--trace"), "below the horizon"),
        (("A1", "--sun", "0,-0.6,-0.8"), "the sun is 53.13° below the horizon; choose"),
        (("A1", "--sun", "0,-1,0"), "the sun is 0.00° below the horizon"),
        (("B1", *NOON), "is 30.00 m behind target, so its beam would hit the back"),
        (("B1", *NOON, "--aim", "0.5,0,13.5"), "behind target, so its beam would hit the"),
        (("B1", *NOON, "--every", "1h"), "behind target, so its beam would hit the back"),
        (("B1", *NOON, "--law", "guo"), "behind target, so its beam would hit the back"),
        (("B1", *NOON, "--aim", "0,-1,13.3"), "target is between it and the aim point; choose"),
        (("A1", *NOON, "--aim", "0,1,13.4"), "target is between it and the aim point; choose"),
        (("A1", *NOON, "--aim", "0,-30,0.0"), "no mirror can reflect the beam there"),
        (("A1", "--time", "2026-06-21", "--every", "1h"), "has no time zone"),
    ],
)
def test_track_refuses_what_no_beam_can_do(
    words: tuple[str, ...], says: str, tmp_path: Path, run: Any
) -> None:
    plant = _plant(tmp_path, SPAIN.replace("pivot_height_m = 1.2", "pivot_height_m = 0"))
    for more in ((), ("--json",)):
        code, out, err = run("track", plant, "--heliostat", *words, *more)
        assert (code, out) == (2, ""), out
        assert says in err
        assert err.count("\n") == 1


def test_track_takes_what_is_true(tmp_path: Path, run: Any) -> None:
    plant = _plant(tmp_path)
    code, out, _ = run("track", plant, "--heliostat", "A1", *NOON)
    assert code == 0
    assert "the beam reaches its aim" in out
    assert "* recommended pose; shading and blocking by other mirrors are not considered" in out
    # In front of the target's back, and over it.
    for aim in ("0,0.5,13", "0,-5,20"):
        code, out, _ = run("track", plant, "--heliostat", "B1", *NOON, "--aim", aim)
        assert code == 0


def test_track_says_that_the_nearest_pose_does_not_serve(tmp_path: Path, run: Any) -> None:
    # The mirror has to look north or, over the top, south; its stops let it look east.
    stops = SPAIN.replace("angle_deg = -180", "angle_deg = 80")
    stops = stops.replace("max_angle_deg = 180", "max_angle_deg = 95")
    words = ("track", _plant(tmp_path, stops), "--heliostat", "A1", *NOON)
    code, out, _ = run(*words)
    assert code == 1
    assert "* the nearest pose: the beam does not reach its aim" in out
    assert "recommended pose" not in out
    code, out, _ = run(*words, "--json")
    found = json.loads(out)
    assert code == 1
    assert not found["branches"][found["best"]]["reachable"]


@pytest.mark.parametrize("latitude", ["69.65", "-78.0"])
def test_polar_night_is_one_line(latitude: str, tmp_path: Path, run: Any) -> None:
    plant = _plant(tmp_path, TOML.replace("-33.93", latitude))
    time = "2026-12-21T12:00:00Z" if float(latitude) > 0 else "2026-06-21T12:00:00Z"
    day = time.partition("T")[0]
    for words in (("track", plant), ("view", plant, tmp_path / "a.html")):
        code, out, err = run(*words, "--heliostat", "A1", "--time", time, "--every", "1h")
        assert (code, out) == (2, "")
        assert (
            f"the sun is below the horizon at every step of 1h on {day}; choose another day" in err
        )
        assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("time", "longitude", "day"),
    [
        # Six in the evening in California is tomorrow in UTC; so is a morning in New Zealand.
        ("2026-06-22T01:00:00Z", "-117", "2026-06-21"),
        ("2026-06-21T20:00:00Z", "175", "2026-06-22"),
        ("2026-06-21T20:00:00+00:00", "175", "2026-06-22"),
        ("2026-06-21T12:00:00Z", "-117", "2026-06-21"),
        # The zone of a time says which day is meant.
        ("2026-06-21T23:30:00-07:00", "-117", "2026-06-21"),
        ("2026-06-22T00:30:00+02:00", "-5", "2026-06-22"),
    ],
)
def test_the_day_is_that_of_the_site(
    time: str, longitude: str, day: str, tmp_path: Path, run: Any
) -> None:
    place = ("--latitude", "34.9", "--longitude", longitude)
    found = json.loads(run("sun", *place, "--time", time, "--every", "2h", "--json")[1])
    plant = _plant(tmp_path, SPAIN.replace("-5.0", longitude))
    words = ("track", plant, "--heliostat", "A1", "--time", time, "--every", "2h", "--json")
    for rows in (found["positions"], json.loads(run(*words)[1])["day"]):
        middle = rows[len(rows) // 2]["time"]
        hours = float(longitude) / 15.0 + int(middle[11:13])
        assert hours // 24 + int(middle[8:10]) == int(day[8:10])


def test_a_leap_second_is_a_time(run: Any) -> None:
    place = ("sun", "--latitude", "50", "--longitude", "8", "--json", "--time")
    found = json.loads(run(*place, "2016-12-31T23:59:60Z")[1])
    assert found["time"] == "2017-01-01T00:00:00+00:00"
    later = json.loads(run(*place, "2017-01-01T00:59:60.5+01:00")[1])
    assert later["time"] == "2017-01-01T00:00:00.500000+00:00"
    for wrong in ("2016-12-31T12:00:60Z", "2016-12-30T23:59:60Z", "2016-12-31T23:59:61Z"):
        code, _, err = run(*place, wrong)
        assert code == 2
        assert "is not ISO 8601" in err


#: Name, first bytes, and what the line says.
FILES = [
    ("a.csv", b"version https://git-lfs.github.com/spec/v1\noid sha256:1\n", "git lfs pull"),
    ("a.toml", b"version https://git-lfs.github.com/spec/v1\noid sha256:1\n", "git lfs pull"),
    ("a.xml", b"version https://git-lfs.github.com/spec/v1\noid sha256:1\n", "git lfs pull"),
    ("a.stinput", b"# SOLTRACE VERSION 3.1.0 INPUT FILE\nSUN\tPTSRC\t0\n", "a SolTrace project"),
    ("a.txt", b"# SOLTRACE VERSION 2012.7.6 INPUT FILE\n", "a SolTrace project"),
    ("a.stinput", b"anything", "a SolTrace project; save its positions as a table id,x,y,z"),
    ("a.tnhpp", b"#Inventor V2.1 ascii\n\n\nTSceneKit {\n", "a scene of Tonatiuh"),
    ("a.tnh", b"\n#Inventor", "a scene of Tonatiuh; save its positions as a table id,x,y,z"),
    ("a.toml", b"#Inventor V2.1 ascii\n", "a scene of Tonatiuh"),
    ("a.xlsx", b"PK\x03\x04\x14\0\x06\0[Content_Types].xml", "a workbook; save the sheet as CSV"),
    ("a.csv", b"PK\x03\x04\x14\0\x06\0\x08\0[Content_Types].xml", "a workbook; save the sheet"),
    ("a.csv", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1\0\0", "a workbook; save the sheet as CSV"),
    ("a.csv", b"<!DOCTYPE html><html>", "a web page; download the file itself"),
    ("a.toml", b"\n<HTML><body>", "a web page; download the file itself"),
    ("a.csv", b"%PDF-1.7\n", "a PDF"),
    ("a.toml", b"name,group,east_m,north_m,up_m\nA1,azel,0,1,2\n", "a table, not a plant file"),
    ("a.toml", b"id;x;y;z\n1;2;3;4\n", "`heliotrope track TABLE.csv` reads a layout"),
    ("a.dat", b"0 10.5 20 3\n", "not valid TOML"),
    ("a.toml", b'<?xml version="1.0"?>\n<!-- a -->\n<HelioK a="1">', "a HelioK scene, not a"),
    ("a.toml", b"<svg/>", "XML, not a plant file; `heliotrope track FILE.xml` reads HelioK"),
    ("a.json", b'{"heliostat_position": [1, 2, 3]}', "JSON, not a plant file; PAINT's files are"),
    ("a.parquet", b"PAR1\0\0\0", "a Parquet table, not a plant file"),
    ("a.h5", b"\x89HDF\r\n\x1a\n\0", "an HDF5 file, not a plant file"),
    ("a.jpg", b"\xff\xd8\xff\xe0\0\x10JFIF\0", "a photograph, not a plant file; `heliotrope image"),
    ("a.xml", b'format = "heliotrope-plant"\n', "a plant file, not a HelioK file; `heliotrope fie"),
    ("a.csv", b'format = "heliotrope-plant"\nversion = 1\n', "a plant file, not a table of"),
    ("a.csv", b'<?xml version="1.0"?><HelioK/>', "a HelioK scene, not a table of heliostats"),
    ("a.csv", b'[{"id": 1}]', "JSON, not a table of heliostats"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "says"), FILES)
def test_a_file_of_another_kind_is_named(
    name: str, content: bytes, says: str, tmp_path: Path, run: Any
) -> None:
    (tmp_path / name).write_bytes(content)
    words = ("--heliostat", "A1", "--site", "37,-5,100")
    code, out, err = run("track", tmp_path / name, *words)
    assert (code, out) == (2, "")
    assert says in err
    assert err.count("\n") == 1
    code, out, _ = run("field", "check", tmp_path / name)
    assert code == 2
    if not name.endswith((".csv", ".xml")):
        assert says in out


def test_a_plant_table_given_to_the_check_is_named(tmp_path: Path, run: Any) -> None:
    _plant(tmp_path, TOML, CSV)
    code, out, _ = run("field", "check", tmp_path / "field.csv")
    assert code == 2
    assert "this is a table, not a plant file; `heliotrope track TABLE.csv` reads a layout" in out


COPIES = {
    "plant.toml": "name,group,east_m,north_m,up_m\nA1,azel,0,-30,0\nA2,azel,0.001,-30.0,0\n",
    "solarpilot.csv": "id,x,y,z\nA1,0,-30,0\nA3,5,-30,0\nA2,0,-30.001,0\n",
}


@pytest.mark.parametrize("name", COPIES)
def test_two_heliostats_at_one_place_are_refused(name: str, tmp_path: Path, run: Any) -> None:
    plant = _plant(tmp_path, table=COPIES["plant.toml"])
    file = plant if name == "plant.toml" else tmp_path / name
    if file != plant:
        file.write_text(COPIES[name], encoding="utf-8")
    words = ("--heliostat", "A1", "--aim", "0,0,13", "--site", "37,-5,100", *NOON)
    code, out, err = run("track", file, *(words if file != plant else words[:2]))
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "heliostats A1 and A2 have the same position: 0.00 m east, -30.00 m north" in err
    # One above the other is another place.
    apart = COPIES[name].replace("30.0,0", "30.0,4").replace("30.001,0", "30.001,4")
    (tmp_path / "field.csv" if file == plant else file).write_text(apart, encoding="utf-8")
    assert run("track", file, *(words if file != plant else (*words[:4], *NOON)))[0] == 0
