"""Airspace: ways around keep-outs, within fences and heights."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from heliotrope.airborne.plan.airspace import Airspace, KeepOut, path_length, tower
from heliotrope.airborne.plan.flight_files import read_airspace
from heliotrope.errors import FormatError, InputError
from heliotrope.field.example import example_plant
from heliotrope.geometry import FloatArray, as_float

TOWER = KeepOut("tower", as_float([[0.0, 0.0]]), 15.0, top=150.0)


def _way(airspace: Airspace, a: FloatArray, b: FloatArray) -> FloatArray:
    """Places every half metre or so of a way."""
    found = airspace.route(a, b)
    assert found is not None
    points = np.vstack([a, found, b])
    parts = [
        p + np.linspace(0.0, 1.0, 2 + int(2.0 * np.linalg.norm(q - p)))[:, None] * (q - p)
        for p, q in pairwise(points)
    ]
    return np.concatenate(parts)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.0, 6.28), st.floats(0.0, 6.28), st.floats(22.0, 200.0), st.floats(16.0, 119.0))
def test_no_way_comes_near_the_tower(first: float, second: float, far: float, up: float) -> None:
    air = Airspace((TOWER,))
    a = np.array([25.0 * np.sin(first), 25.0 * np.cos(first), up])
    b = np.array([far * np.sin(second), far * np.cos(second), 60.0])
    places = _way(air, a, b)
    assert np.linalg.norm(places[:, :2], axis=-1).min() >= 20.0 - 1e-6
    assert places[:, 2].min() >= 15.0 - 1e-9
    assert places[:, 2].max() <= 120.0 + 1e-9


def test_straight_where_it_is_free_and_short_where_it_is_not() -> None:
    air = Airspace((TOWER,))
    a, b = np.array([100.0, 40.0, 50.0]), np.array([-100.0, 40.0, 50.0])
    free = air.route(a, b)
    assert free is not None
    assert not len(free)
    a[1] = b[1] = 0.0
    around = air.route(a, b)
    assert around is not None
    # Two tangents and an arc about 20 m.
    reach = np.sqrt(100.0**2 - 20.0**2)
    shortest = 2.0 * reach + 20.0 * (np.pi - 2.0 * np.arccos(20.0 / 100.0))
    length = path_length(np.vstack([a, around, b]))
    assert shortest < length < 1.02 * shortest


def test_over_what_is_low() -> None:
    wall = KeepOut(
        "wall", as_float([[-1.0, -400.0], [1.0, -400.0], [1.0, 400.0], [-1.0, 400.0]]), top=60.0
    )
    air = Airspace((wall,))
    a, b = np.array([-30.0, 0.0, 30.0]), np.array([30.0, 0.0, 30.0])
    places = _way(air, a, b)
    near = np.abs(places[:, 0]) < 6.0
    assert places[near, 2].min() >= 65.0 - 1e-6
    assert path_length(places) < 140.0


def test_take_off_is_upright() -> None:
    air = Airspace((TOWER,))
    places = _way(air, np.array([50.0, 0.0, 0.0]), np.array([-50.0, 0.0, 40.0]))
    low = places[:, 2] < 15.0 - 1e-9
    assert low.any()
    np.testing.assert_allclose(places[low, :2], [[50.0, 0.0]] * int(low.sum()), atol=1e-9)


def test_a_bent_fence_is_kept() -> None:
    fence = as_float(
        [[0, 0], [200, 0], [200, 200], [120, 200], [120, 80], [80, 80], [80, 200], [0, 200]]
    )
    air = Airspace(fence=fence)
    places = _way(air, np.array([40.0, 180.0, 40.0]), np.array([160.0, 180.0, 40.0]))
    assert shapely.contains_xy(shapely.Polygon(fence), places[:, :2]).all()
    assert places[:, 1].min() < 80.0
    assert air.route(np.array([40.0, 180.0, 40.0]), np.array([300.0, 180.0, 40.0])) is None


def test_points_in_the_air() -> None:
    hill = np.array([[0.0, 0.0, 50.0], [100.0, 0.0, 0.0]])
    air = Airspace((KeepOut("mast", as_float([[60.0, 60.0]]), 2.0),), ground=hill)
    points = [
        [0.0, 0.0, 60.0],
        [0.0, 0.0, 70.0],
        [100.0, 0.0, 60.0],
        [60.0, 66.0, 60.0],
        [60.0, 68.0, 60.0],
        [100.0, 0.0, 130.0],
        [0.0, 0.0, 169.0],
    ]
    assert air.free(points).tolist() == [False, True, True, False, True, False, True]


def test_keep_out_between_heights() -> None:
    bridge = KeepOut("bridge", as_float([[-50, -5], [50, -5], [50, 5], [-50, 5]]), 0.0, 40.0, 50.0)
    a = as_float([[0, -30, 30], [0, -30, 45], [0, -30, 30], [0, -30, 60], [0.0, -30.0, 20.0]])
    b = as_float([[0, 30, 30], [0, 30, 45], [0, 30, 60], [0, 30, 60], [0.0, 30.0, 62.0]])
    # Under it, through it, up through it, over it; and a climb that passes it.
    assert bridge.free(a, b).tolist() == [True, False, False, True, False]


def test_tower_of_a_plant() -> None:
    plant = example_plant()
    found = tower(plant)
    assert {k.name for k in found} == {"receiver", "target"}
    assert max(k.top for k in found) == pytest.approx(16.5 + 0.75 + 10.0)


def test_file(tmp_path: Path) -> None:
    path = tmp_path / "air.json"
    path.write_text(
        '{"max_height_m": 90, "home": [1, 2, 3], "fence": [[0,0],[9,0],[9,9]], "keep_out": '
        '[{"name": "mast", "centre": [5, 5], "radius_m": 2, "top_m": 30}, '
        '{"name": "house", "polygon": [[0,0],[1,0],[1,1]]}]}'
    )
    air, home = read_airspace(path, Airspace((TOWER,), margin=7.0))
    assert [k.name for k in air.keep_outs] == ["tower", "mast", "house"]
    assert (air.min_height, air.max_height, air.margin) == (15.0, 90.0, 7.0)
    assert air.keep_outs[1].top == 30.0
    assert home is not None
    np.testing.assert_allclose(home, [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"roof": 3}', "roof: unknown key; known keys are fence"),
        ('{"fence": [[0, 0], [1]]}', r"fence\[1\]: expected \[east, north\], found 1"),
        ('{"keep_out": [{"name": "x", "centre": [0, 0], "radius_m": 0}]}', "0.* is outside"),
        ('{"keep_out": [{"name": "x", "polygon": [[0, 0], [1, 1]]}]}', "specify three or more"),
        ('{"min_height_m": 200}', "heights 200 m to 120 m"),
        ("[", "not valid JSON"),
    ],
)
def test_file_refusals(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "air.json"
    path.write_text(text)
    with pytest.raises((FormatError, InputError), match=message):
        read_airspace(path, Airspace())


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: KeepOut("k", as_float([[0.0, 0.0]])), "1 corners; specify three or more"),
        (lambda: KeepOut("k", as_float([[0.0, np.nan]]), 1.0), "specify finite"),
        (
            lambda: KeepOut("k", as_float([[0.0, 0.0]]), 1.0, 5.0, 5.0),
            r"top \(5.0 m\) must be above",
        ),
        (lambda: Airspace(margin=-1.0), "margin must be 0 or more, not -1.0 m"),
        (lambda: Airspace(fence=as_float([[0.0, 0.0]])), "fence of shape"),
        (lambda: Airspace(fence=as_float([[0, 0], [9, 9], [9, 0], [0, 9]])), "edges cross"),
        (lambda: KeepOut("k", as_float([[0, 0], [1, 1], [2, 2]])), "enclose no area"),
    ],
)
def test_refusals(make: object, text: str) -> None:
    assert callable(make)
    with pytest.raises(InputError, match=text):
        make()
