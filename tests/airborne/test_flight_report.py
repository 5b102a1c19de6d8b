"""The report of a flight, and the table of reflections in files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from heliotrope.airborne.flight_report import (
    difference_rows,
    facet_rows,
    orientation_rows,
    write_flight_report,
)
from heliotrope.airborne.orientation import Orientations, measure
from heliotrope.airborne.reflections import (
    join,
    read_reflections,
    reflections,
    write_reflections,
)
from heliotrope.airborne.trial import Conditions, four_facets, scene
from heliotrope.errors import FormatError, InputError

SHAPE = four_facets()
NAMES = ("AA 1", "B<2>", "C")


def field() -> tuple[Orientations, np.ndarray]:
    found, places = [], []
    for k in range(2):
        s = scene(SHAPE, Conditions(columns=7, rows=6), 20 + k)
        own = replace(s.reflections, heliostat=s.reflections.heliostat + k)
        found.append(measure(own, SHAPE, s.told_rotation, s.told_vertex))
        places.append(s.told_vertex + [30.0 * k, 0.0, 0.0])
    places.append(np.array([15.0, 140.0, 3.0]))
    left_out = {"C": "no reflection in any photograph"}
    return Orientations(NAMES, tuple(found), left_out), np.array(places)


def test_the_page_and_its_tables(tmp_path: Path) -> None:
    found, places = field()
    done: list[tuple[int, int]] = []
    page = write_flight_report(
        found, lambda _: SHAPE, places, tmp_path / "report", notes=("photograph 7: a & b",),
        progress=lambda a, b: done.append((a, b)),
    )  # fmt: skip
    assert done == [(1, 2), (2, 2)]
    text = page.read_text(encoding="utf-8")
    assert text.count("<img") == 3
    assert "B&lt;2&gt;" in text
    assert "B<2>" not in text
    assert "photograph 7: a &amp; b" in text
    assert "<td>C</td><td>no reflection in any photograph</td>" in text
    for name, rows in (
        ("orientations", orientation_rows(found)), ("facets", facet_rows(found)),
        ("differences", difference_rows(found)),
    ):  # fmt: skip
        wanted = pd.DataFrame(rows)
        kept = pd.read_parquet(page.parent / f"{name}.parquet")
        pd.testing.assert_frame_equal(kept, wanted, check_dtype=False)
        assert len(pd.read_csv(page.parent / f"{name}.csv")) == len(wanted)
    assert len(facet_rows(found)) == 8
    row, o = orientation_rows(found)[1], found.found[1]
    assert row["heliostat"] == "B<2>"
    assert row["rot_x_mrad"] == pytest.approx(1e3 * o.correction[0])
    assert row["sigma_tot_y_mrad"] == pytest.approx(
        np.hypot(row["sigma_mean_y_mrad"], row["systematic_y_mrad"])
    )
    kept, left_out = read_reflections(page.parent / "reflections.parquet", NAMES)
    assert not left_out
    np.testing.assert_array_equal(kept.xy, join([o.reflections for o in found.found]).xy)
    assert not list(page.parent.glob(".*"))


def test_nothing_measured_is_still_a_report(tmp_path: Path) -> None:
    nothing = Orientations(("A",), (), {"A": "no reflection in any photograph"})
    page = write_flight_report(nothing, lambda _: SHAPE, np.zeros((1, 3)), tmp_path)
    assert "0 heliostats measured, 1 not." in page.read_text(encoding="utf-8")
    with pytest.raises(InputError, match="for 1 heliostats"):
        write_flight_report(nothing, lambda _: SHAPE, np.zeros((2, 3)), tmp_path)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_reflections_are_read_as_they_were_written(suffix: str, tmp_path: Path) -> None:
    s = scene(SHAPE, Conditions(columns=3, rows=3), 1)
    file = tmp_path / f"table{suffix}"
    write_reflections(file, s.reflections, ("H",))
    kept, left_out = read_reflections(file, ("G", "H"))
    assert not left_out
    assert (kept.heliostat == 1).all()
    for name in ("photo", "facet", "x", "y", "camera", "led", "sigma"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(s.reflections, name))


def test_bad_rows_are_named_and_left_out(tmp_path: Path) -> None:
    file = tmp_path / "table.csv"
    write_reflections(file, scene(SHAPE, Conditions(columns=3, rows=3), 1).reflections, ("H",))
    lines = file.read_text().splitlines()
    cells = [line.split(",") for line in lines[1:6]]
    cells[0][1] = "X"
    cells[1][2] = "1.5"
    cells[2][-1] = "0.0"
    cells[3][3] = "nan"
    file.write_text("\n".join([lines[0], *(",".join(c) for c in cells)]))
    kept, left_out = read_reflections(file, ("H",))
    assert len(kept) == 1
    assert [line.split(": ")[1] for line in left_out] == [
        "line 2, heliostat X, column heliostat", "line 3, heliostat H, column facet",
        "line 4, heliostat H, column sigma_m", "line 5, heliostat H, column x_m",
    ]  # fmt: skip
    file.write_text(lines[0].replace("led_up_m", "up"))
    with pytest.raises(FormatError, match="there is no column led_up_m"):
        read_reflections(file, ("H",))
    with pytest.raises(FormatError, match=r"reflections are \.csv or \.parquet"):
        read_reflections(tmp_path / "table.txt", ("H",))


def test_impossible_reflections_are_refused() -> None:
    def one(**changes: object) -> object:
        given = {"photo": 0, "heliostat": 0, "facet": 0, "xy": [[0.0, 0.0]], "camera": [0.0, 0, 9],
                 "led": [0.1, 0, 9], "sigma": 0.01}  # fmt: skip
        return reflections(**{**given, **changes})  # type: ignore[arg-type]

    assert one()
    for changes, text in (
        ({"facet": -1}, "facet -1 is below 0"),
        ({"sigma": 0.0}, "sigma 0.0 m must be above 0"),
        ({"xy": [[np.nan, 0.0]]}, "xy .* is not finite"),
        ({"camera": [np.inf, 0, 0]}, "camera .* is not finite"),
    ):
        with pytest.raises(InputError, match=text):
            one(**changes)
    table = reflections(0, 3, 0, [[0.0, 0.0]], [0.0, 0, 9], [0.1, 0, 9], 0.01)
    with pytest.raises(InputError, match="row 3 of 1 names"):
        write_reflections(Path("x.csv"), table, ("A",))
