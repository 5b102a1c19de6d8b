"""Every table of the product in the fashions of spreadsheets: the same value, or one line."""

import csv
import errno
import io
import json
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.cli.test_bad_input import PAINT, TOML, TOWER

from heliotrope.airborne.photo import _read_table as read_photos
from heliotrope.airborne.standing import read_commands
from heliotrope.calibration.sighting_table import read_malan, read_sightings
from heliotrope.calibration.workflow import read_field_sightings
from heliotrope.errors import FormatError, InputError
from heliotrope.field.example import example_plant
from heliotrope.field.formats import open_plant, opencsp, solarpilot
from heliotrope.field.formats.measurements import _read_table as read_measured
from heliotrope.field.formats.plant_edit import values
from heliotrope.field.formats.plant_file import check_plant, read_plant, write_plant
from heliotrope.field.target import Target
from heliotrope.files.cells import check_names
from heliotrope.files.text import write_file
from heliotrope.geometry import geodetic_to_enu
from heliotrope.imaging.log import beside, read_log
from heliotrope.sun import Site

SITE = Site(37.5, -5.25, 120.0)
TARGET = Target(
    "t", np.array([[-1.0, 0, 2], [1, 0, 2], [1, 0, 0], [-1, 0, 0]]), np.array([0.0, 0, 1])
)
#: Names with a letter that each encoding writes in its own way.
NAMES = ("Süd1", "Süd2")


def _plant(path: Path) -> Any:
    (path.parent / "plant.toml").write_text(TOML.replace("field.csv", path.name), encoding="utf-8")
    plant = read_plant(path.parent / "plant.toml")
    return plant.names, plant.position.tolist()


def _edited(path: Path) -> Any:
    (path.parent / "plant.toml").write_text(TOML.replace("field.csv", path.name), encoding="utf-8")
    return values(path.parent / "plant.toml", NAMES[1])


def _layout(path: Path) -> Any:
    layout = solarpilot.read_layout(path)
    return layout.names, layout.location.tolist(), layout.unread


def _opencsp(path: Path) -> Any:
    table = opencsp.read_field(path)
    return table.names, table.location.tolist(), table.facet_width.tolist()


def _sightings(path: Path) -> Any:
    seen, kinds, left_out = read_sightings(path, NAMES)
    if left_out:
        raise FormatError(path, left_out[0].partition(": ")[2])
    return seen.heliostat.tolist(), seen.counts.tolist(), seen.time.tolist(), kinds


def _malan(path: Path) -> Any:
    seen, left_out = read_malan(path, NAMES[0], NAMES, TARGET)
    if left_out:
        raise FormatError(path, left_out[0].partition(": ")[2])
    return seen.counts.tolist(), seen.destination.tolist()


def _log(path: Path) -> Any:
    log = read_log(path)
    return [
        (e.heliostat, e.counts.tolist(), e.time, e.target)
        for e in (log.find(Path("17.png")), log.find(Path("18.png")))
        if e is not None and e.counts is not None
    ]


def _measured(path: Path) -> Any:
    frame, left_out = read_measured(path, "utis")
    if left_out:
        raise FormatError(path, left_out[0].partition(": ")[2])
    if frame.isna().any().any():
        raise FormatError(path, "write a point, not a comma")
    return frame.to_dict("list")


def _commands(path: Path) -> Any:
    rows, counts = read_commands(path, NAMES)
    return rows.tolist(), counts.tolist()


#: Reader, the name of the file, its header, and two rows; the number 0.25 stands in each.
TABLES: dict[str, tuple[Callable[[Path], Any], str, list[list[str]]]] = {
    "plant": (
        _plant,
        "name,group,east_m,north_m,up_m",
        [["Süd1", "azel", "0.25", "-30", "0"], ["Süd2", "azel", "10.5", "-30.125", "1"]],
    ),
    "plant, cell by cell": (
        _edited,
        "name,group,east_m,north_m,up_m",
        [["Süd1", "azel", "0.25", "-30", "0"], ["Süd2", "azel", "10.5", "-30.125", "1"]],
    ),
    "layout": (
        _layout,
        "id,x,y,z",
        [["Süd1", "0.25", "79.67", "0"], ["Süd2", "21.28", "77.11", "-0.5"]],
    ),
    "opencsp": (
        _opencsp,
        ",".join(opencsp.COLUMNS),
        [
            ["Süd1", "0.25", "57.93", "3.89", "2", "1", "2", "4.02", "0.1778", "1.2", "1.1"],
            ["Süd2", "4.84", "57.93", "3.89", "2", "1", "2", "4.02", "0.1778", "1.2", "1.1"],
        ],
    ),
    "sightings": (
        _sightings,
        ("heliostat,time,count_1,count_2,source_east,source_north,source_up,source_at_infinity,"
        "destination_east,destination_north,destination_up,destination_at_infinity,sigma_rad"),
        [
            ["Süd1", "2026-06-21T12:00:00Z", "0.25", "2", "0", "-0.6", "0.8", "true", "0", "0",
             "13", "false", "0.001"],
            ["Süd2", "2026-06-21T12:00:00Z", "9", "2", "0", "-0.6", "0.8", "true", "0", "0",
             "13", "false", "0.001"],
        ],
    ),
    "malan": (
        _malan,
        ("timestamp,sun_azimuth_deg,sun_elevation_deg,horizontal_offset_m,vertical_offset_m,"
        "azimuth_counts,elevation_counts"),
        [
            ["2014-09-02T12:00:00Z", "10", "45", "0.25", "0", "1000", "2000"],
            ["2014-09-02T12:05:00Z", "11", "45", "0.5", "0", "1010", "2001"],
        ],
    ),
    "log": (
        _log,
        "file,heliostat,timestamp,target,axis_1_motor_position,axis_2_motor_position",
        [
            ["17.png", "Süd1", "2026-09-02T10:00:00Z", "Süden", "0.25", "746419"],
            ["18.png", "Süd2", "2026-09-02T10:01:00Z", "Süden", "-251960", "746420"],
        ],
    ),
    "measurements": (
        _measured,
        ("heliostat,id,timestamp,target,sun_azimuth_deg_south0_east,sun_elevation_deg_apparent,"
        "axis_1_motor_position,axis_2_motor_position,utis_lat,utis_lon,utis_alt"),
        [
            ["Süd1", "1", "2022-06-01T10:00:00Z", "t", "0.25", "50", "1", "2", "50.9", "6.3", "9"],
            ["Süd2", "2", "2022-06-01T10:00:00Z", "t", "21", "50", "1", "2", "50.9", "6.3", "9"],
        ],
    ),
    "commands": (
        _commands,
        "heliostat,count_1,count_2",
        [["Süd1", "0.25", "2"], ["Süd2", "3", "4.5"]],
    ),
    "photos": (
        read_photos,
        "name,east_m,north_m,up_m,yaw_deg,pitch_deg,roll_deg,sigma_m",
        [
            ["Süd.jpg", "0.25", "2", "30", "0", "-90", "0", "0.01"],
            ["b.jpg", "1", "2", "30", "0", "9", "0", "0.5"],
        ],
    ),
}  # fmt: skip


def _text(table: list[list[str]], separator: str = ",", quoting: Any = csv.QUOTE_MINIMAL) -> str:
    out = io.StringIO()
    csv.writer(out, delimiter=separator, quoting=quoting, lineterminator="\n").writerows(table)
    return out.getvalue()


#: Fashions of writing a table, which all mean the same.
FASHIONS: dict[str, Callable[[list[list[str]]], bytes]] = {
    "semicolons": lambda t: _text(t, ";").encode(),
    "tabs": lambda t: _text(t, "\t").encode(),
    "bars": lambda t: _text(t, "|").encode(),
    "sep line of Excel": lambda t: ("sep=;\n" + _text(t, ";")).encode(),
    "sep line with an odd separator": lambda t: ("sep=^\r\n" + _text(t, "^")).encode(),
    "mark and CRLF": lambda t: ("\ufeff" + _text(t).replace("\n", "\r\n")).encode(),
    "CR": lambda t: _text(t).replace("\n", "\r").encode(),
    "UTF-16": lambda t: _text(t, "\t").encode("utf-16"),
    "UTF-16 big-endian": lambda t: b"\xfe\xff" + _text(t).encode("utf-16-be"),
    "Latin-1": lambda t: _text(t, ";").encode("latin-1"),
    "decomposed letters": lambda t: _text(t).replace("ü", "u\u0308").encode(),
    "quotes": lambda t: _text(t, quoting=csv.QUOTE_ALL).encode(),
    "blanks around cells": lambda t: "\n".join("  ,  ".join(r) + "  " for r in t).encode(),
    "quotes behind blanks": lambda t: _text(t, quoting=csv.QUOTE_ALL).replace(",", ", ").encode(),
    "empty rows": lambda t: (
        "\n\n" + _text(t[:1]) + " \n,,\n" + _text(t[1:]) + "\n,,,,\n"
    ).encode(),
    "empty columns": lambda t: _text([[*row, "", ""] for row in t]).encode(),
    "empty columns of rows": lambda t: _text([t[0], *([*row, ""] for row in t[1:])]).encode(),
    "columns in another order": lambda t: _text([row[::-1] for row in t]).encode(),
}


def _written(folder: Path, table: str, change: Callable[[list[list[str]]], bytes]) -> Any:
    reader, header, rows = TABLES[table]
    path = folder / "table.csv"
    path.write_bytes(change([header.split(","), *(list(row) for row in rows)]))
    return reader(path)


@pytest.mark.parametrize("fashion", FASHIONS)
@pytest.mark.parametrize("table", TABLES)
def test_every_table_is_read_in_every_fashion(table: str, fashion: str, tmp_path: Path) -> None:
    plain = _written(tmp_path, table, lambda t: _text(t).encode())
    assert "Süd" in str(plain) or table in ("sightings", "malan", "commands", "plant, cell by cell")
    found = _written(tmp_path, table, FASHIONS[fashion])
    if isinstance(plain, dict):
        assert found == plain
    else:
        assert tuple(found) == tuple(plain)


@pytest.mark.parametrize(
    ("number", "says"),
    [
        ("0,25", "write a point, not a comma"),
        ("1.250,5", "omit the thousands separators"),
        ("1,250.5", "omit the thousands separators"),
        ("1 250.5", "omit the thousands separators"),
        ("\u22120.25", "write the minus sign as -"),
        ("٣", "is not a finite number"),
        ("1_0", "is not a finite number"),
        ("0x10", "is not a finite number"),
    ],
)
@pytest.mark.parametrize("table", [t for t in TABLES if t not in ("photos", "measurements")])
def test_numbers_of_another_country_are_named(
    table: str, number: str, says: str, tmp_path: Path
) -> None:
    for separator in ";\t":
        with pytest.raises(InputError) as error:
            _written(
                tmp_path,
                table,
                lambda t, s=separator: _text(t, s).replace("0.25", number).encode("utf-8"),
            )
        assert says in str(error.value)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("table", [t for t in TABLES if t != "photos"])
def test_a_decimal_comma_between_commas_is_never_read(table: str, tmp_path: Path) -> None:
    def change(t: list[list[str]]) -> bytes:
        # Empty optional columns behind would take the cells that move.
        t = [[*t[0], "remark"], *([*row, ""] for row in t[1:])]
        return _text(t).replace("0.25", "0,25").encode()

    with pytest.raises(InputError, match=r"\d+ cells under \d+ columns; correct the line|a point"):
        _written(tmp_path, table, change)


@pytest.mark.parametrize(
    ("other", "says"),
    [
        ("Süd1", "Süd1 is already the name of line 2; each name must be unique"),
        ("SÜD 1", "SÜD 1 is already the name of line 2 apart from case or blanks (Süd1)"),
        ("Su\u0308d1", "Süd1 is already the name of line 2; each name must be unique"),
    ],
)
@pytest.mark.parametrize("table", ["plant", "layout", "opencsp"])
def test_names_that_look_the_same_are_refused(
    table: str, other: str, says: str, tmp_path: Path
) -> None:
    with pytest.raises(FormatError, match="line 3, column ") as error:
        _written(tmp_path, table, lambda t: _text(t).replace("Süd2", other).encode())
    assert says in str(error.value)


def test_damaged_text_is_refused_and_not_guessed(tmp_path: Path) -> None:
    for damaged in (b"id,x,y,z\nS\xc3\xbcd,1,2,3\n\xfc,1,2,3\n", b"id,x,y,z\n\xfc\x01,1,2,3\n"):
        (tmp_path / "a.csv").write_bytes(damaged)
        with pytest.raises(FormatError, match="not UTF-8 text"):
            solarpilot.read_layout(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_bytes(b"\xff\xfei\0d\0,")
    with pytest.raises(FormatError, match=r"text \(truncated data"):
        solarpilot.read_layout(tmp_path / "a.csv")


def test_field_check_lists_all_wrong_cells_of_a_table(tmp_path: Path) -> None:
    (tmp_path / "plant.toml").write_text(TOML, encoding="utf-8")
    table = "name;group;east_m;north_m;up_m\nA1;azel;0,5;30;0\n;azel;1;30;0\na1;azel;1;60000;0\n"
    (tmp_path / "field.csv").write_text(table, encoding="utf-8")
    found = [
        finding.text.partition("field.csv: ")[2] for finding in check_plant(tmp_path / "plant.toml")
    ]
    assert len(found) == 3
    assert found[0].startswith("line 2, column east_m: heliostat A1: '0,5' is not a finite number")
    assert found[1] == "line 3, column name: the heliostat has no name; enter one"
    assert found[2].startswith(
        "line 4, column name: heliostat a1: a1 is already the name of line 2"
    )


# -- layouts ---------------------------------------------------------------------------


def _open(folder: Path, text: str) -> Any:
    (folder / "layout.csv").write_text(text, encoding="utf-8")
    return open_plant(folder / "layout.csv", site=SITE)


@pytest.mark.parametrize(
    "header",
    ["id,x,y,z", "Name,X [m],Y [m],Z [m]", "HELIOSTAT,East,North,Up", "hid,Loc. X,Loc. Y,Loc. Z",
     "label,x_m,y_m,z_m", "id,x-position,y-position,z-position", '\ufeffID,"x (m)",y,z'],
)  # fmt: skip
def test_ids_of_a_header_are_names(header: str, tmp_path: Path) -> None:
    plant = _open(tmp_path, f"{header}\n0,7.25,79.5,0\n07,21,77,0.5\nB,35,70,1\n")
    assert plant.names == ("0", "07", "B")
    np.testing.assert_allclose(plant.position, [[7.25, 79.5, 0], [21, 77, 0.5], [35, 70, 1]])


def test_columns_are_found_by_name_and_others_are_said(tmp_path: Path) -> None:
    plant = _open(tmp_path, "z,remark,Y,id,No,X\n0.5,south,79.5,a,1,7.25\n")
    assert plant.names == ("a",)
    np.testing.assert_allclose(plant.position, [[7.25, 79.5, 0.5]])
    assert plant.notes["columns not read"] == "remark, No"


def test_degrees_of_a_header_become_metres(tmp_path: Path) -> None:
    rows = [(37.5009, -5.2511, 121.0), (37.4992, -5.25, 119.5)]
    text = "id,Longitude [deg],latitude,Altitude (m)\n"
    text += "".join(f"{k},{lon!r},{lat!r},{h!r}\n" for k, (lat, lon, h) in enumerate(rows))
    plant = _open(tmp_path, text)
    expected = np.array([geodetic_to_enu(*row, SITE.origin) for row in rows])
    np.testing.assert_allclose(plant.position, expected, atol=1e-9)
    # A degree of latitude is 111 km: 0.0009° north and 0.0011° west.
    np.testing.assert_allclose(plant.position[0], [-97.2, 99.9, 1.0], atol=0.1)
    with pytest.raises(FormatError, match="line 1: positions are in degrees; specify the site"):
        solarpilot.read_layout(tmp_path / "layout.csv")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            "id,x,y\n1,2,3\n",
            "line 1: the header (id, x, y) names no position columns; use id,x,y,z",
        ),
        ("Vorlage,Länge,Höhe,z\n0,1,2,3\n", "the header (Vorlage, Länge, Höhe, z) names no"),
        ("id,lat,lon\n1,37.5,-5.25\n", "the header (id, lat, lon) names no position columns"),
        ("id,x [mm],y,z\n1,2000,3,0\n", "column x [mm] is in mm; use m"),
        ("id,x,y,z\n,[ft],[ft],[ft]\n1,2,3,0\n", "column x is in ft; use m"),
        ("id,x_km,y_km,z\n1,2,3,0\n", "column x_km is in km; use m"),
        ("id,lat_rad,lon,alt\n1,0.65,-5.25,100\n", "column lat_rad is in rad; use deg"),
        ("id,x,east,y,z\n1,2,3,4,0\n", "two columns hold x; keep one"),
        ("id,x,y,z,z\n1,2,3,4,0\n", "two columns hold z; keep one"),
        ("id,x,y,z\nunits,east,north,up\n1,2,3,4\n", "no number below the header"),
        ("id,x,y,z\n1,2,3\n", "line 2: heliostat 1: 3 cells under 4 columns"),
        ("Template,x,y,z\n0,2,3,0,5,6\n", "6 cells under 4 columns; correct the line"),
        ("id,x,y,z\n1,316000,5643000,0\n", "column x: heliostat 1: 316000 is outside -50000 to"),
        ("id,x,y,z\n1,0,0,1001\n", "column z: heliostat 1: 1001 is outside -1000 to 1000 m"),
        ("id,lat,lon,alt\n1,91,-5.25,100\n", "column lat: heliostat 1: 91 is outside -90 to 90"),
        ("id,lat,lon,alt\n1,-5.25,37.5,100\n", "puts it outside -50000 to 50000 m from the site"),
        ("id,lat,lon,alt\n1,37.5,-5.25,2500\n", "column alt: heliostat 1: 2500 puts it outside"),
        (
            "1,7.25,79.5,0\n2,21,77,0\n3,35,70,0\n",
            "column 1 has a different number in each row, like ids",
        ),
        ("name,group,east_m,north_m,up_m\nA1,azel,1,2,0\n", "this is the table of a plant file"),
        ("id|x|y|z\n", "there are no heliostats"),
        ('{"id": [0, 1]}', "this is JSON, not a table of heliostats"),
        ("<HelioK/>", "this is a HelioK scene, not a table of heliostats"),
        ('# c\nformat = "heliotrope-plant"\n', "this is a plant file, not a table of heliostats"),
        ("template;x;y;z\n0;10,25;120,5;0\n", "'10,25' is not a finite number; write a point"),
        ("0;10,25;120,5;0\n", "'10,25' is not a finite number; write a point"),
    ],
)
def test_a_layout_that_cannot_be_understood_is_refused(
    text: str, says: str, tmp_path: Path
) -> None:
    with pytest.raises(FormatError) as error:
        _open(tmp_path, text)
    assert says in str(error.value)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(str(tmp_path))


def test_an_opencsp_table_is_recognised_in_any_case(tmp_path: Path) -> None:
    header = ";".join(opencsp.COLUMNS).lower().replace(" ", "")
    plant = _open(tmp_path, header + "\nA1;-4.84;57.93;3.89;2;1;2;4.02;0.1778;1.2;1.1\n")
    assert plant.names == ("A1",)
    assert plant.groups["heliostats"].facets is not None


# -- logs ------------------------------------------------------------------------------


def test_two_rows_for_a_photograph_are_refused_with_both_lines(tmp_path: Path) -> None:
    def change(t: list[list[str]]) -> bytes:
        return _text([*t, ["17.png", *t[2][1:]]]).encode()

    with pytest.raises(FormatError, match=r"line 4, column file: 17\.png also appears in line 2"):
        _written(tmp_path, "log", change)


@pytest.mark.parametrize(("name", "same"), [("17", True), ("17.jpg", False), ("19", False)])
def test_a_file_and_an_id_of_one_photograph_are_refused(
    name: str, same: bool, tmp_path: Path
) -> None:
    def change(t: list[list[str]]) -> bytes:
        return _text([*t, [name, *t[2][1:]]]).encode()

    if not same:
        _written(tmp_path, "log", change)
        return
    says = r"17\.png and 17 of line 4 refer to the same photograph; keep the correct row"
    with pytest.raises(FormatError, match=says):
        _written(tmp_path, "log", change)


def test_a_log_names_columns_times_and_rows_without_a_photograph(tmp_path: Path) -> None:
    for old, new, says in (
        ("axis_1", "achse_1", "there is no column axis_1_motor_position; add it"),
        ("file", "photo", "there is no column file; add it"),
        ("10:00:00Z", "10:00:00", "column timestamp: 2026-09-02T10:00:00 has no time zone"),
        ("2026-09-02T10:00:00Z", "02.09.2026 10:00", "is not an ISO 8601 time"),
        ("17.png", "", "line 2, column file: neither file nor id is filled in; enter one"),
    ):
        with pytest.raises(FormatError) as error:
            _written(tmp_path, "log", lambda t, o=old, n=new: _text(t).replace(o, n, 1).encode())
        assert says in str(error.value)


# -- anything --------------------------------------------------------------------------

_cell = st.one_of(
    st.sampled_from(
        ["", "NULL", "nan", "inf", "-1e308", "0,5", "1.5", "007", "true", "x", "é", "A1", "[m]"]
    ),
    st.floats(allow_nan=True).map(repr),
    st.text(max_size=8),
)
_name = st.sampled_from(
    [*opencsp.COLUMNS, "id", "x", "y", "z", "lat", "lon", "alt", "Template", "Enabled", "In layout",
     "Cant vect.", "heliostat", "file", "name", "group", "east_m", "north_m", "up_m", "", "x [mm]",
     "count_1", "count_2"]
)  # fmt: skip
_grid = st.tuples(
    st.lists(st.one_of(_name, _cell), max_size=14),
    st.lists(st.lists(_cell, max_size=14), max_size=4),
    st.sampled_from([",", ";", "\t", "|", " "]),
    st.sampled_from(["utf-8", "utf-16", "utf-8-sig", "cp1252"]),
)


def _one_line_or_value(path: Path) -> None:
    for reader in (*(one[0] for one in TABLES.values()), lambda p: open_plant(p, site=SITE)):
        said = ""
        try:
            reader(path)
        except InputError as error:
            said = str(error)
        assert "\n" not in said
        assert len(said) < 700


fuzz = settings(
    max_examples=120,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@fuzz
@given(st.binary(max_size=200))
def test_bytes_end_in_a_value_or_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "table.csv").write_bytes(content)
    _one_line_or_value(tmp_path / "table.csv")


@fuzz
@given(_grid)
def test_grids_end_in_a_value_or_one_line(tmp_path: Path, grid: Any) -> None:
    header, rows, separator, encoding = grid
    text = _text([header, *rows], separator)
    (tmp_path / "table.csv").write_bytes(text.encode(encoding, "replace"))
    _one_line_or_value(tmp_path / "table.csv")


@fuzz
@given(st.data())
def test_spoilt_tables_end_in_a_value_or_one_line(tmp_path: Path, data: st.DataObject) -> None:
    table = data.draw(st.sampled_from(list(TABLES)))
    _, header, rows = TABLES[table]
    grid = [header.split(","), *(list(row) for row in rows)]
    for _ in range(data.draw(st.integers(1, 3))):
        row = data.draw(st.sampled_from(grid))
        k = data.draw(st.integers(0, len(row) - 1))
        row[k : k + data.draw(st.integers(0, 1))] = data.draw(st.lists(_cell, max_size=2)) or [""]
    change = data.draw(st.sampled_from(list(FASHIONS.values())))
    content = change(grid) if data.draw(st.booleans()) else _text(grid).encode("utf-8", "replace")
    (tmp_path / "table.csv").write_bytes(content)
    _one_line_or_value(tmp_path / "table.csv")


# -- names, folders and disks ----------------------------------------------------------


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (("A1", "A1"), "heliostat A1: the name occurs twice; each name must be unique"),
        (("A1", "B", "a 1"), "heliostat a 1: there is also A1; names must differ by more"),
        (("\u00e9", "e\u0301"), "names must differ by more than case and blanks"),
        (("A", " "), "heliostat: a name is empty; each heliostat needs a name"),
        (("A", ""), "heliostat: a name is empty"),
    ],
)
def test_names_differ_at_a_glance(names: tuple[str, ...], says: str) -> None:
    check_names("heliostat", ["X", "X1", "x2", "Ä", "A-1"])
    check_names("heliostat", [])
    with pytest.raises(InputError) as error:
        check_names("heliostat", names)
    assert says in str(error.value)


def test_a_plant_refuses_alike_names_over_groups_and_surfaces() -> None:
    plant = example_plant()
    group = next(iter(plant.groups.values()))
    other = replace(group, names=tuple(name.lower() for name in group.names))
    with pytest.raises(InputError, match="heliostat p1a: there is also P1A"):
        replace(plant, groups={"a": group, "b": other})
    twin = replace(plant.targets[0], name=plant.targets[0].name.upper())
    with pytest.raises(InputError, match=r"target or receiver .* names must differ by more"):
        replace(plant, targets=(plant.targets[0], twin), cameras=())
    with pytest.raises(InputError, match="target or receiver: a name is empty"):
        replace(plant, targets=(replace(twin, name=""),), cameras=())


def test_the_folders_of_artist_open_as_they_are(tmp_path: Path) -> None:
    (tmp_path / "tower-measurements.json").write_text(json.dumps(TOWER), encoding="utf-8")
    latitude, *rest = PAINT["heliostat_position"]
    for k, name in enumerate(("AA31", "AA39")):
        (tmp_path / name).mkdir()
        file = tmp_path / name / "heliostat-properties.json"
        place = {"heliostat_position": [latitude + 1e-4 * k, *rest]}
        file.write_text(json.dumps(PAINT | place), encoding="utf-8")
    seen = {
        "motor_position": {"axis_1_motor_position": 20000, "axis_2_motor_position": 30000},
        "target_name": "target",
        "sun_elevation": 50.0,
        "sun_azimuth": 20.0,
        "focal_spot": {"UTIS": [50.91339, 6.38782, 130.0]},
    }
    file = tmp_path / "AA39" / "123-calibration-properties.json"
    file.write_text(json.dumps(seen), encoding="utf-8")
    plant = open_plant(tmp_path)
    assert plant.names == ("AA31", "AA39")
    found = read_field_sightings(plant, str(tmp_path))
    assert [plant.names[i] for i in found.sightings.heliostat] == ["AA39"]
    entry = beside(tmp_path / "AA39" / "123-flux.png")
    assert entry is not None
    assert entry.heliostat == "AA39"


def test_a_full_disk_is_called_full(tmp_path: Path) -> None:
    def write(_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(
        InputError, match=r"No space left on device\); free some space, or choose a"
    ):
        write_file(tmp_path / "a.csv", write)
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="choose a folder that exists"):
        write_file(tmp_path / "none" / "a.csv", lambda stream: stream.write(b""))


def test_a_device_or_a_pipe_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(pipe := tmp_path / "pipe")
    with pytest.raises(InputError, match="this is a device or a pipe, not a file; specify a file"):
        write_file(pipe, lambda stream: stream.write(b"a"))
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]


def test_messages_do_not_begin_with_an_empty_name() -> None:
    with pytest.raises(InputError, match=r"^site: latitude_deg = 95 ° is not a number from -90"):
        Site(95, 0, 0)
    with pytest.raises(InputError, match=r"^site 'A': latitude_deg = 95"):
        Site(95, 0, 0, name="A")


def test_a_site_of_another_type_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"site is a tuple, \(36.1, -5.2, 10.0\); pass Site\(lat"):
        open_plant(tmp_path / "layout.csv", site=(36.1, -5.2, 10.0))  # type: ignore[arg-type]


def test_a_layout_with_two_heliostats_at_one_place_is_refused_with_its_file(tmp_path: Path) -> None:
    layout = tmp_path / "layout.csv"
    layout.write_text("id,x,y,z\nA,10,20,0\nB,10,20,0\n")
    with pytest.raises(
        FormatError, match=r"layout\.csv: heliostats A and B have the same position"
    ):
        open_plant(layout, site=SITE)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("id,x,y,z,units\nA,10,20,0,ft\n", "unit columns are not read; use metres"),
        ("1,10,20,0\n2,30,20,0\n", "column 1 has a different number in each row, like ids"),
        ("id,x_mm,y_mm,z_mm\nA,10,20,0\n", "column x_mm is in mm; use m"),
        ("id,x/m,y/km,z/m\nA,10,20,0\n", "column y/km is in km; use m"),
        ("id,x,y,z\nA,10m,20m,0m\n", "'10m' is not a plain number: write metres without"),
    ],
)
def test_units_and_ids_of_a_layout_are_not_guessed(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "layout.csv").write_text(text)
    with pytest.raises(FormatError, match=re.escape(says)):
        open_plant(tmp_path / "layout.csv", site=SITE)


def test_a_layout_with_metres_and_degrees_says_which_it_reads(tmp_path: Path) -> None:
    layout = tmp_path / "both.csv"
    layout.write_text("id,x,y,z,lat,lon,alt\nA,10,20,0,50,6,80\nB,30,20,0,50,6,80\n")
    plant = open_plant(layout, site=SITE)
    assert plant.notes["columns not read"] == "lat, lon, alt"


def test_an_argument_that_a_format_has_no_use_for_is_refused(tmp_path: Path) -> None:
    plant = tmp_path / "plant.toml"
    write_plant(example_plant(), plant)
    with pytest.raises(FormatError, match="site is specified, but files of this format"):
        open_plant(plant, site=SITE)
    layout = tmp_path / "layout.csv"
    layout.write_text("id,x,y,z\nA,10,20,0\n")
    with pytest.raises(FormatError, match="centroids is specified"):
        open_plant(layout, site=SITE, centroids=layout)
