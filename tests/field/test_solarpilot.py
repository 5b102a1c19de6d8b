"""SolarPILOT layouts: columns by position, separators, flags, NULL, both ways."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st

from heliotrope.errors import FormatError
from heliotrope.field.formats import solarpilot
from heliotrope.field.formats.solarpilot import Layout, Template
from heliotrope.geometry import azimuth_elevation
from heliotrope.sun import Site

EXPORT = Path(__file__).parents[1] / "files" / "solarpilot-export.csv"
SITE = Site(37.0, -5.0, 20.0, name="field")
TEMPLATES = {0: Template(12.2, 12.0, 6.5, 0.2), 1: Template(6.0, 5.0, 3.0)}

#: Two lines of the example in SolarPILOT's help; its receiver is a cylinder about the
#: origin, so a heliostat aims at the side that it stands on.
PUBLISHED = """\
0,732.296892,-735.801107,0.000000,NULL,NULL,NULL,NULL,NULL,5.466982,-5.493142,180.000000
0,-1320.513177,-15.868845,0.000000,NULL,NULL,NULL,NULL,NULL,-7.749440,-0.093126,180.000000
"""


def layout_of(tmp_path: Path, text: str) -> Layout:
    path = tmp_path / "layout.csv"
    path.write_text(text, encoding="utf-8")
    return solarpilot.read_layout(path)


def assert_same(a: Layout, b: Layout) -> None:
    for name in Layout.__match_args__:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


# -- reading ---------------------------------------------------------------------------


def test_flags_stand_as_they_are_read_not_as_the_header_says() -> None:
    layout = solarpilot.read_layout(EXPORT)
    np.testing.assert_array_equal(layout.template, [0, 0, 1, 1])
    # The header says "In layout, Enabled"; SolarPILOT writes and reads enabled first.
    np.testing.assert_array_equal(layout.enabled, [True, False, True, True])
    np.testing.assert_array_equal(layout.in_layout, [True, True, False, True])
    np.testing.assert_array_equal(layout.location[3], [77.125, -64.5, 0.25])
    np.testing.assert_array_equal(layout.focus[1], [125.0, 126.5])
    np.testing.assert_array_equal(layout.cant[1], [-0.01, 0.02, 0.99975])
    np.testing.assert_array_equal(np.isnan(layout.aim).all(axis=1), [False, False, True, False])
    assert np.isnan(layout.focus[[0, 2, 3]]).all()
    assert np.isnan(layout.cant[[0, 2, 3]]).all()


def test_the_published_example(tmp_path: Path) -> None:
    layout = layout_of(tmp_path, PUBLISHED)
    assert layout.enabled.all()
    assert layout.in_layout.all()
    standing, _ = azimuth_elevation(layout.location)
    aimed, _ = azimuth_elevation(layout.aim * [1, 1, 0])
    np.testing.assert_allclose(aimed, standing, atol=1e-6)
    np.testing.assert_array_equal(layout.aim[:, 2], 180.0)


@pytest.mark.parametrize("separator", [",", ";", "\t", " ", ", ", "; ", "   "])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_separators(tmp_path: Path, separator: str, end: str) -> None:
    text = PUBLISHED.replace(",", separator).replace("\n", end)
    assert_same(layout_of(tmp_path, text), layout_of(tmp_path, PUBLISHED))


@pytest.mark.parametrize("end", [";", ";\n", ";\r\n"])
def test_semicolons_may_end_records(tmp_path: Path, end: str) -> None:
    text = PUBLISHED.replace("\n", end)
    assert_same(layout_of(tmp_path, text), layout_of(tmp_path, PUBLISHED))


@pytest.mark.parametrize(
    ("row", "enabled"),
    [("3,10,20,0.5", True), ("3,0,1,10,20,0.5", False), ("3,F,t,10,20,.5", False)],
)
def test_short_rows(tmp_path: Path, row: str, enabled: bool) -> None:
    layout = layout_of(tmp_path, row)
    np.testing.assert_array_equal(layout.template, [3])
    np.testing.assert_array_equal(layout.enabled, [enabled])
    np.testing.assert_array_equal(layout.in_layout, [True])
    np.testing.assert_array_equal(layout.location, [[10, 20, 0.5]])
    assert np.isnan(layout.aim).all()


def test_blank_lines_a_mark_and_small_letters_are_fine(tmp_path: Path) -> None:
    header = "Template,x,y,z,X focus,Y focus,Cant i,Cant j,Cant k,Aim x,Aim y,Aim z"
    text = f"\ufeff{header}\n\n" + PUBLISHED.lower() + "\n,,,\n"
    assert_same(layout_of(tmp_path, text), layout_of(tmp_path, PUBLISHED))


# -- writing ---------------------------------------------------------------------------

finite = st.floats(-1e6, 1e6, allow_subnormal=False)


# -- plants ----------------------------------------------------------------------------


def test_a_layout_becomes_a_plant() -> None:
    plant = solarpilot.to_plant(solarpilot.read_layout(EXPORT), SITE, TEMPLATES)
    assert plant.names == ("H1", "H4")
    assert plant.notes == {"left out": "H2, H3"}
    big, small = plant.groups["template-0"], plant.groups["template-1"]
    assert big.mechanism.kind == "azimuth_elevation"
    assert (big.width[0], big.height[0], small.width[0]) == (12.2, 12.0, 6.0)
    np.testing.assert_array_equal(small.aim, [[4.6, -3.8, 95.0]])
    # The location is the pivot's; the foot stands below it, the mirror in front of it.
    np.testing.assert_allclose(big.position, [[10.25, 120.5, -6.5]], atol=1e-12)
    facing_up = big.mechanism.pose([[0.0, np.pi / 2]]).vertex
    np.testing.assert_allclose(facing_up, [[10.25, 120.5, 0.2]], atol=1e-12)


def test_x_is_east_and_y_is_north() -> None:
    plant = solarpilot.to_plant(solarpilot.read_layout(EXPORT), SITE, TEMPLATES)
    azimuth, _ = azimuth_elevation(plant.position * [1, 1, 0])
    # H1 stands north of the tower, H4 in the south-east.
    np.testing.assert_allclose(np.degrees(azimuth), [4.86, 129.9], atol=0.1)


# -- refusals --------------------------------------------------------------------------

ROW = "0,1,1,10,20,0,NULL,NULL,NULL,NULL,NULL,1,2,90\n"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("0,1,2\n", "line 1: 3 columns; a layout has 14"),
        ("0,1,2,3,4\n", "5 columns; a layout has 14"),
        (ROW * 2 + "0,1,1,10,20,0\n", "line 3: 6 cells under 14 columns"),
        (ROW.replace("10", "ten"), "line 1, column 4 (Loc. X): 'ten' is not a finite number"),
        (ROW.replace("10", "nan"), "'nan' is not a finite number; enter m from"),
        (ROW.replace("10", "inf"), "'inf' is not a finite number"),
        (ROW.replace("10", "1_0"), "'1_0' is not a finite number"),
        (
            ROW.replace(",", ";").replace("10", "10,5"),
            "'10,5' is not a finite number; write a point, not a comma",
        ),
        (ROW.replace("10", "NULL"), "column 4 (Loc. X): 'NULL' is not a finite number"),
        (ROW.replace("10", ""), "column 4 (Loc. X): the cell is empty; enter m"),
        (
            ROW.replace("2,90", "2,NULL"),
            "column 14 (Aim pt. Z): NULL mixed with numbers; all 3 columns",
        ),
        (
            ROW.replace("0,NULL", "0,50"),
            "column 8 (Y focus): NULL mixed with numbers; all 2 columns of focus",
        ),
        ("x" + ROW, "column 1 (Template): 'x0' is not a template's number"),
        ("-1" + ROW[1:], "'-1' is not a template's number"),
        ("1.5" + ROW[1:], "'1.5' is not a template's number"),
        (
            ROW.replace("0,1,1", "0,2,1"),
            "column 2 (Enabled): '2' is neither true nor false; write 0 or 1",
        ),
        (
            "0,732.3,-735.8,0,NULL,NULL\n",
            "'732.3' is neither true nor false; write 0 or 1; with 6 columns a row begins",
        ),
        ("Template,Loc. X,Loc. Y,Loc. Z\n", "there are no heliostats"),
        (" \n,,,\n\n", "the file has no rows; expected a table of heliostats"),
        ("Σ" * 40, "names no position columns; use id,x,y,z (m east, north, up), id,latitude"),
        ("NULL\n", "line 1: 1 columns; a layout has 14"),
        ("", "the file is empty; expected a table of heliostats (SolarPILOT or OpenCSP)"),
    ],
)
def test_a_wrong_file_gets_one_line(tmp_path: Path, text: str, problem: str) -> None:
    with pytest.raises(FormatError) as error:
        layout_of(tmp_path, text)
    assert problem in str(error.value)
    assert str(error.value).startswith(str(tmp_path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"\x00\x01\x02" * 100, "the file is binary"),
        (b"0,1,2,3\n\xff\xfe\xfa\x01", "not UTF-8 text .*byte 8|byte 8.*not UTF-8"),
    ],
)
def test_binary_files_are_refused(tmp_path: Path, content: bytes, problem: Any) -> None:
    path = tmp_path / "layout.csv"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=problem):
        solarpilot.read_layout(path)


def test_200_mb_are_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "layout.csv"
    with path.open("wb") as stream:
        stream.write(ROW.encode())
        stream.truncate(200 * 2**20)
    with pytest.raises(FormatError, match="200 MiB exceed the limit of 64 MiB"):
        solarpilot.read_layout(path)
