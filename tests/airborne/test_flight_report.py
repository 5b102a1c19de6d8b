"""The report of a flight, and the table of reflections in files."""

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from heliotrope.airborne.evaluate import pictures as flight_pictures
from heliotrope.airborne.evaluate import report as flight_report
from heliotrope.airborne.evaluate.budget import Budget
from heliotrope.airborne.evaluate.drawing import Panel, round_below
from heliotrope.airborne.evaluate.drawing import numbered as ticks_of
from heliotrope.airborne.evaluate.orientation import Orientations, measure
from heliotrope.airborne.evaluate.reflections import (
    join,
    read_reflections,
    reflections,
    write_reflections,
)
from heliotrope.airborne.evaluate.report import write_campaign_report, write_flight_report
from heliotrope.airborne.evaluate.tables import (
    MeasuredFlight,
    difference_rows,
    facet_rows,
    flight_row,
    orientation_rows,
    systematic_parts,
)
from heliotrope.airborne.simulate.trial import TrialConditions, four_facets, trial_mirror
from heliotrope.errors import FormatError, InputError

SHAPE = four_facets()
NAMES = ("AA 1", "B<2>", "C")
BUDGET = Budget(0.010, 0.030, 0.005, 0.002)


@pytest.fixture(scope="module")
def field() -> tuple[Orientations, np.ndarray]:
    found, places = [], []
    for k in range(2):
        s = trial_mirror(SHAPE, TrialConditions(columns=7, rows=6), 20 + k)
        own = replace(s.reflections, heliostat=s.reflections.heliostat + k)
        # Two spots that were taken for another's.
        own = replace(own, x=own.x + np.where(np.arange(len(own)) < 2 * k, 0.7, 0.0))
        found.append(measure(own, SHAPE, s.expected_rotation, s.expected_vertex, budget=BUDGET))
        places.append(s.expected_vertex + [30.0 * k, 0.0, 0.0])
    places.append(np.array([15.0, 140.0, 3.0]))
    left_out = {"C": "no reflection in any photograph"}
    return Orientations(NAMES, tuple(found), left_out), np.array(places)


def test_the_page_and_its_tables(field: tuple[Orientations, np.ndarray], tmp_path: Path) -> None:
    found, places = field
    done: list[tuple[int, int]] = []
    page = write_flight_report(
        found,
        lambda _: SHAPE,
        places,
        tmp_path / "report",
        notes=("photograph 7: a & b",),
        progress=lambda a, b: done.append((a, b)),
        budget=BUDGET,
    )
    assert done == [(1, 2), (2, 2)]
    text = page.read_text(encoding="utf-8")
    assert text.count("<img") == 1
    assert text.count('<section id="') == text.count("aria-label=") == 2
    assert '<a href="#AA 1">' in text
    assert "B&lt;2&gt;" in text
    assert "B<2>" not in text
    assert "photograph 7: a &amp; b" in text
    assert "<td>C</td><td>no reflection in any photograph</td>" in text
    for name, rows in (
        ("orientations", orientation_rows(found, BUDGET)),
        ("facets", facet_rows(found)),
        ("differences", difference_rows(found)),
        ("flights", [flight_row(found)]),
    ):
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


def test_pictures_show_each_point_where_it_stands(
    field: tuple[Orientations, np.ndarray],
) -> None:
    o = field[0].found[1]
    assert o.outlier.any()
    root = ET.fromstring(flight_pictures.heliostat_drawing("B<2>", o, SHAPE))
    space = "{http://www.w3.org/2000/svg}"
    mirror = root.findall(f"{space}svg")[0]
    dots, crosses = (
        [e for e in mirror.findall(space + kind) if e.find(f"{space}title") is not None]
        for kind in ("circle", "path")
    )
    assert len(dots) == o.count
    assert len(crosses) == int(o.outlier.sum())
    # Px to metres and back: the same scale across and up, no point elsewhere.
    drawn = np.array([[float(e.attrib["cx"]), -float(e.attrib["cy"])] for e in dots])
    true = o.reflections.xy[~o.outlier]
    scale = np.ptp(drawn, axis=0) / np.ptp(true, axis=0)
    assert scale[0] == pytest.approx(scale[1], rel=0.01)
    off = drawn - drawn.mean(axis=0) - scale * (true - true.mean(axis=0))
    assert np.abs(off).max() < 0.2
    # Facets, and bars that hold every point that was not rejected.
    assert len(mirror.findall(f"{space}polygon")) == len(SHAPE)
    for panel in root.findall(f"{space}svg")[1:3]:
        heights = np.array([float(e.attrib["height"]) for e in panel.findall(f"{space}rect")])
        counts = heights / heights.sum() * o.count
        np.testing.assert_allclose(counts, np.round(counts), atol=0.1)


@settings(max_examples=40)
@given(st.floats(-1e3, 1e3), st.floats(1e-3, 1e5), st.integers(3, 8))
def test_ticks_are_round_few_and_inside(low: float, span: float, most: int) -> None:
    panel = Panel(0.0, 0.0, 100.0, 50.0, (low, low + span), (0.0, 1.0))
    ticks = ticks_of(low, low + span, most)
    values = np.array([value for value, _ in ticks])
    assert len(values) <= most + 1
    assert ((values >= low - 1e-6 * span) & (values <= low + 1.000001 * span)).all()
    if len(values) > 1:
        step = values[1] - values[0]
        assert np.ptp(values) > 0.3 * span
        np.testing.assert_allclose(np.diff(values), step, rtol=1e-6, atol=1e-11)
        assert round_below(1.00001 * step) == pytest.approx(step, rel=1e-4)
    for value, text in ticks:
        assert float(text.replace("−", "-")) == pytest.approx(value, abs=1e-6 * span)
    assert panel.place(low, 1.0) == pytest.approx([0.0, 0.0])
    assert panel.place(low + span, 0.0) == pytest.approx([100.0, 50.0])


def test_an_arrow_leads_to_the_right_and_up() -> None:
    panel = Panel(0.0, 0.0, 100.0, 50.0, (0.0, 1.0), (0.0, 1.0)).equal()
    assert panel.y == (0.0, 1.0)
    assert panel.x == pytest.approx((-0.5, 1.5))
    panel.arrows([0.5, 0.5], [0.5, 0.5], [[12.0, 5.0], [0.1, 0.1]], "red")
    # The second is too short to be seen.
    assert len(panel.parts) == 1
    assert panel.parts[0].tag == "path"
    assert str(panel.parts[0].attributes["d"]).startswith("M50.0 25.0l12.0 -5.0l")
    assert round_below(0.999) == 0.5


def test_the_systematic_part_is_told_by_its_causes(
    field: tuple[Orientations, np.ndarray],
) -> None:
    o = field[0].found[0]
    parts = systematic_parts(o, BUDGET)
    assert set(parts) == {"position", "kinematics", "rtk", "lamp"}
    total = np.sqrt(sum(part**2 for part in parts.values()))
    np.testing.assert_allclose(total, o.systematic, rtol=1e-9)
    # 10 mm across 150 m.
    np.testing.assert_allclose(parts["position"], BUDGET.position / o.distance, rtol=0.02)
    # A place that is as uncertain as position, kinematics and RTK together.
    place = (BUDGET.position**2 + BUDGET.kinematics**2 + BUDGET.rtk**2) * np.eye(3)
    alone = systematic_parts(o, BUDGET, place)
    assert set(alone) == {"place", "lamp"}
    np.testing.assert_allclose(np.hypot(*alone.values()), o.systematic, rtol=1e-9)
    assert "systematic_kinematics_x_mrad" in orientation_rows(field[0], BUDGET)[0]
    assert "systematic_kinematics_x_mrad" not in orientation_rows(field[0])[0]


def test_several_flights_in_one_report(
    field: tuple[Orientations, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, places = field
    monkeypatch.setattr(flight_report, "MOST_SECTIONS", 3)
    monkeypatch.setattr(flight_report, "MOST_MAPS", 1)
    known = np.tile(1e-4 * np.eye(3), (len(NAMES), 1, 1))
    flights = [
        MeasuredFlight(name, found, lambda _: SHAPE, places, BUDGET, known) for name in ("1/2", "3")
    ]
    page = write_campaign_report(flights, tmp_path)
    text = page.read_text(encoding="utf-8")
    assert "4 heliostats measured, 2 not." in text
    assert "Pictures of 3 of them" in text
    assert "<th>σ of place</th><th>σ of lamp</th>" in text
    assert text.count("<section id=") == text.count('<a href="#') == 3
    assert text.count("<img") == 1
    table = pd.read_csv(tmp_path / "orientations.csv", dtype={"flight": str})
    assert list(table["flight"]) == ["1/2", "1/2", "3", "3"]
    assert sorted(p.name for p in tmp_path.glob("reflections*")) == [
        "reflections-1-2.parquet",
        "reflections-3.parquet",
    ]
    with pytest.raises(InputError, match=r"pass one or more flights with different names"):
        write_campaign_report([flights[0], flights[0]], tmp_path)


def test_nothing_measured_is_still_a_report(tmp_path: Path) -> None:
    nothing = Orientations(("A",), (), {"A": "no reflection in any photograph"})
    page = write_flight_report(nothing, lambda _: SHAPE, np.zeros((1, 3)), tmp_path)
    assert "0 heliostats measured, 1 not." in page.read_text(encoding="utf-8")
    with pytest.raises(InputError, match="for 1 heliostats"):
        write_flight_report(nothing, lambda _: SHAPE, np.zeros((2, 3)), tmp_path)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_reflections_are_read_as_they_were_written(suffix: str, tmp_path: Path) -> None:
    s = trial_mirror(SHAPE, TrialConditions(columns=3, rows=3), 1)
    file = tmp_path / f"table{suffix}"
    write_reflections(file, s.reflections, ("H",))
    kept, left_out = read_reflections(file, ("G", "H"))
    assert not left_out
    assert (kept.heliostat == 1).all()
    for name in ("photo", "facet", "x", "y", "camera", "led", "sigma"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(s.reflections, name))


def test_bad_rows_are_named_and_left_out(tmp_path: Path) -> None:
    file = tmp_path / "table.csv"
    write_reflections(
        file, trial_mirror(SHAPE, TrialConditions(columns=3, rows=3), 1).reflections, ("H",)
    )
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
        "line 2, heliostat X, column heliostat",
        "line 3, heliostat H, column facet",
        "line 4, heliostat H, column sigma_m",
        "line 5, heliostat H, column x_m",
    ]
    file.write_text(lines[0].replace("led_up_m", "up"))
    with pytest.raises(FormatError, match="there is no column led_up_m"):
        read_reflections(file, ("H",))
    with pytest.raises(FormatError, match=r"reflections are \.csv or \.parquet"):
        read_reflections(tmp_path / "table.txt", ("H",))


def test_impossible_reflections_are_refused() -> None:
    def one(**changes: object) -> object:
        given = {
            "photo": 0,
            "heliostat": 0,
            "facet": 0,
            "xy": [[0.0, 0.0]],
            "camera": [0.0, 0, 9],
            "led": [0.1, 0, 9],
            "sigma": 0.01,
        }
        return reflections(**{**given, **changes})  # type: ignore[arg-type]

    assert one()
    for changes, text in (
        ({"facet": -1}, "facet -1 is below 0"),
        ({"sigma": 0.0}, "sigma must be above 0, not 0.0 m"),
        ({"xy": [[np.nan, 0.0]]}, "xy .* is not finite"),
        ({"camera": [np.inf, 0, 0]}, "camera .* is not finite"),
    ):
        with pytest.raises(InputError, match=text):
            one(**changes)
    table = reflections(0, 3, 0, [[0.0, 0.0]], [0.0, 0, 9], [0.1, 0, 9], 0.01)
    with pytest.raises(
        InputError,
        match=("row 3, but there are only 1 names; pass the names of all heliostats"),
    ):
        write_reflections(Path("x.csv"), table, ("A",))
