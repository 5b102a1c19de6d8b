"""OpenCSP's tables: columns by name, the pivot's place, facets, both ways."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st

from heliotrope.errors import FormatError
from heliotrope.field.formats import opencsp
from heliotrope.field.formats.frames import mirror_frame
from heliotrope.field.formats.opencsp import Centroids, FieldTable
from heliotrope.field.plant import Plant
from heliotrope.geometry import rotation
from heliotrope.sun import Site

FILES = Path(__file__).parents[1] / "files"
FIELD, CENTROIDS = FILES / "opencsp-field.csv", FILES / "opencsp-centroids.csv"
SITE = Site(34.96, -106.51, 1700.0, name="test field")


def plant() -> Plant:
    return opencsp.to_plant(opencsp.read_field(FIELD), SITE, opencsp.read_centroids(CENTROIDS))


def edited(tmp_path: Path, source: Path, old: str, new: str) -> Path:
    text = source.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / source.name
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return path


# -- reading ---------------------------------------------------------------------------


def test_columns_are_read_by_name() -> None:
    table = opencsp.read_field(FIELD)
    assert table.names == ("A1", "A2", "B1")
    assert len(table) == 3
    np.testing.assert_array_equal(table.location[0], [-4.84, 57.93, 3.89])
    np.testing.assert_array_equal(table.facets, [6, 6, 6])
    np.testing.assert_array_equal(table.rows, [2, 2, 2])
    np.testing.assert_array_equal(table.columns, [3, 3, 3])
    np.testing.assert_array_equal(table.pivot_height, 4.02)
    np.testing.assert_array_equal(table.pivot_offset, [0.1778, 0.1778, 0.2])
    np.testing.assert_array_equal(table.facet_height, 1.1)
    assert table.extra == {"Remark": ("washed, twice", "", "new")}


def test_the_order_of_columns_is_free(tmp_path: Path) -> None:
    text = FIELD.read_text(encoding="utf-8").replace('"washed, twice"', "")
    rows = [line.split(",") for line in text.splitlines()]
    path = tmp_path / "other.csv"
    path.write_text("\ufeff" + "\n\n".join(",".join(reversed(r)) for r in rows), encoding="utf-8")
    table = opencsp.read_field(path)
    np.testing.assert_array_equal(table.location, opencsp.read_field(FIELD).location)


def test_centroids_are_read() -> None:
    table = opencsp.read_centroids(CENTROIDS)
    assert table.ids == tuple("123456")
    np.testing.assert_array_equal(table.center[2], [1.25, 0.6, -0.01])


# -- geometry --------------------------------------------------------------------------

#: OpenCSP's test data for heliostat 5W1 of the NSTTF: azimuth and elevation of the mirror,
#: centroids of two facets in the mirror, and where they are in the field.
AZIMUTH, ELEVATION = 3.091673780116996, 0.9140378446583401
PUBLISHED = {
    (-2.7941016, 2.5655016, -0.0115824): (-7.72694089, 59.71850473, 5.58801461),
    (0.0, 0.0, 0.0): (-4.83458324, 57.82157893, 4.03081325),
    (2.7941016, -2.5655016, -0.0115824): (-1.94293132, 55.93877885, 2.45526593),
}


def test_published_places_of_facets_are_met() -> None:
    one = np.ones(1, dtype=np.int64)
    table = FieldTable(
        ("5W1",),
        np.array([[-4.84, 57.93, 3.89]]),
        3 * one,
        one,
        3 * one,
        np.array([4.02]),
        np.array([0.1778]),
        np.array([1.2192]),
        np.array([1.2192]),
    )
    centroids = Centroids(("1", "13", "25"), np.array(list(PUBLISHED)))
    group = opencsp.to_plant(table, SITE, centroids).groups["heliostats"]
    pose = group.mechanism.pose([[AZIMUTH, ELEVATION]])
    turned = rotation((0, 0, -1), AZIMUTH) @ rotation((1, 0, 0), ELEVATION)
    assert group.facets is not None
    places = pose.vertex + group.facets.center[0] @ (turned @ mirror_frame((0, 1, 0))).T
    np.testing.assert_allclose(places, list(PUBLISHED.values()), atol=2e-8)
    np.testing.assert_allclose(pose.normal, [[0.03046545, -0.6097923, 0.79197551]], atol=1e-8)


def test_a_field_becomes_a_plant() -> None:
    group = plant().groups["heliostats"]
    assert group.mechanism.kind == "azimuth_elevation"
    np.testing.assert_allclose(group.position[:, 2], [-0.13, 0.0, -0.05], atol=1e-12)
    # Extent of the centroids and a facet more.
    np.testing.assert_allclose(group.width, 3.7)
    np.testing.assert_allclose(group.height, 2.3)
    assert group.facets is not None
    np.testing.assert_allclose(group.facets.half_width[2, 5], [0.6, 0, 0])
    np.testing.assert_allclose(group.facets.half_height[2, 5], [0, 0.55, 0])


def test_without_centroids_facets_stand_edge_to_edge() -> None:
    group = opencsp.to_plant(opencsp.read_field(FIELD), SITE).groups["heliostats"]
    assert group.facets is not None
    np.testing.assert_allclose(
        group.facets.center[0],
        [[x, y, 0] for y in (0.55, -0.55) for x in (-1.2, 0, 1.2)],
        atol=1e-12,
    )
    np.testing.assert_allclose(group.width, 3.6)
    np.testing.assert_allclose(group.height, 2.2)


def test_heliostats_of_different_grids_form_groups(tmp_path: Path) -> None:
    path = edited(tmp_path, FIELD, "3.97,6,2,3", "3.97,4,2,2")
    made = opencsp.to_plant(opencsp.read_field(path), SITE)
    assert {name: g.names for name, g in made.groups.items()} == {
        "heliostats-2x2": ("B1",),
        "heliostats-2x3": ("A1", "A2"),
    }


# -- both ways -------------------------------------------------------------------------

number = st.floats(-1e5, 1e5, allow_subnormal=False)
size = st.floats(1e-3, 100)
cell = st.text(st.characters(codec="utf-8", exclude_categories=("C", "Z")), max_size=8)


# -- refusals --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("Pivot Offset,", "", "line 1: there is no column Pivot Offset; add it"),
        ("Remark", "Name", "line 1: column Name occurs twice"),
        ("A2,4.89", "A2,4.89,1", "line 3: heliostat A2: 13 cells under 12 columns"),
        ("A2,4.89,", "A2,", "line 3: heliostat A2: 11 cells under 12 columns"),
        ("4.89", "x", "line 3, column X: heliostat A2: 'x' is not a finite number; enter m"),
        ("4.89", "nan", "line 3, column X: heliostat A2: 'nan' is not a finite number"),
        ("4.89", "1_0", "'1_0' is not a finite number"),
        ("4.89", "", "heliostat A2: the cell is empty; enter m"),
        ("4.89", '"4,89"', "'4,89' is not a finite number; write a point, not a comma"),
        ("4.89", "-50001", "column X: heliostat A2: -50001 is outside -50000 to 50000 m"),
        ("4.02,6,2", "-1001,6,2", "column Z: heliostat A2: -1001 is outside -1000 to 1000 m"),
        ("4.02,0.1778", "4020,0.1778", "column Pivot Height: heliostat A1: 4020 is outside -1 to"),
        ("6,2,3,4.02", "6,2,2,4.02", "heliostat A1: 6 facets are not 2 rows × 2 columns"),
        ("6,2,3,4.02", "6.5,2,3,4.02", "column Num. Facets: heliostat A1: 6.5 is not a whole"),
        ("6,2,3,4.02", "0,2,3,4.02", "heliostat A1: 0 is not a whole number from 1"),
        ("1.2,1.1,new", "0,1.1,new", "line 4, column Facet Width: heliostat B1: 0 is outside 0.05"),
        ("1.2,1.1,new", "1.2,-1,new", "column Facet Height: heliostat B1: -1 is outside 0.05"),
        ("A2", "A1", "line 3, column Name: heliostat A1: A1 is already the name of line 2"),
        ("A2", "a 1", "a 1 is already the name of line 2 apart from case or blanks (A1)"),
        ("A2", "", "line 3, column Name: the heliostat has no name; enter one"),
        ('"washed, twice"', '"washed, twice', "not a CSV table (unexpected end of data)"),
    ],
)
def test_a_wrong_field_gets_one_line(tmp_path: Path, old: str, new: str, problem: str) -> None:
    path = edited(tmp_path, FIELD, old, new)
    with pytest.raises(FormatError) as error:
        opencsp.read_field(path)
    assert problem in str(error.value)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "the file is empty; expected an OpenCSP table of facet centroids"),
        (b"Facet id,X,Y,Z\n", "there are no rows below the header"),
        (b"Facet id,X,Y\n1,2,3\n", "there is no column Z; add it"),
        (b"\n\n", "the file has no rows; expected an OpenCSP table of facet centroids"),
        (b"Facet id,X,Y,Z\n1,0,0,0\n1,1,0,0\n", "1 is already the name of line 2"),
        (b"Facet id,X,Y,Z\n1,1200,0,0\n", "1200 is outside -50 to 50 m from the mirror's vertex"),
        (b"\x89PNG\0\0\0", "this is a photograph, not an OpenCSP table of facet centroids; `helio"),
        (b"Facet id,X,Y,Z\n1,0,0,\xe9\n", "'é' is not a finite number"),
        (b"Facet id,X,Y,Z\n\xc3\xa9,0,0,\xe9\n", "not UTF-8 text"),
    ],
)
def test_wrong_centroids_get_one_line(tmp_path: Path, content: bytes, problem: str) -> None:
    path = tmp_path / "centroids.csv"
    path.write_bytes(content)
    with pytest.raises(FormatError) as error:
        opencsp.read_centroids(path)
    assert problem in str(error.value)
