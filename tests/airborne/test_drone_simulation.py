"""The simulated flight obeys the law and is reproducible."""

import numpy as np
import pytest

from heliotrope.airborne.mirror import measured_normal
from heliotrope.airborne.simulate.simulation import (
    Errors,
    exact_reflections,
    look_counts,
    reflections_of,
)
from heliotrope.airborne.standing import outline, read_commands, standing, write_commands
from heliotrope.errors import FormatError, InputError, UnknownNameError
from heliotrope.geometry import angle_between, normalize
from support.drone_case import HOVER, field, flight

EXACT = Errors(rtk=(1e-9,) * 3, gimbal=0.0, survey=0.0, slope=0.0, reflection=0.0, mechanism={})


def test_mirrors_look_at_the_point() -> None:
    mirrors = field()
    stand = standing(mirrors, look_counts(mirrors, HOVER))
    normals = stand.rotation[:, :, 2]
    assert angle_between(normals, normalize(HOVER - stand.vertex)).max() < 1e-6
    # x level and to the right as seen from the front, y up.
    assert np.abs(stand.rotation[:, 2, 0]).max() < 1e-9
    assert (stand.rotation[:, 2, 1] > 0.0).all()


def test_reflections_obey_the_law_on_the_real_surface() -> None:
    flown = flight(Errors())
    seen = exact_reflections(flown)
    assert len(seen) > 50
    for row in np.unique(seen.heliostat)[:6]:
        mine = seen.of(int(row))
        R, shape = flown.truth.rotation[row], flown.shapes[row]
        point = flown.truth.vertex[row] + shape.point_at(mine.facet, mine.xy) @ R.T
        normals = shape.normal_at(mine.facet, mine.xy) @ R.T
        assert angle_between(measured_normal(point, mine.camera, mine.led), normals).max() < 1e-9


def test_same_seed_same_flight() -> None:
    first, again, other = (reflections_of(flight(seed=s), seed=1) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.xy, again.xy)
    assert len(other) != len(first) or not np.array_equal(other.xy, first.xy)


def test_errors_come_out_as_large_as_given() -> None:
    offset = np.array([0.03, -0.02, 0.01])
    flown = flight(
        Errors(rtk=(0.01, 0.01, 0.02), rtk_offset=tuple(offset), slope=0.0),
        columns=20,
        rows=20,
        step=0.1,
    )
    off = np.array([p.position for p in flown.recorded]) - [p.position for p in flown.taken]
    np.testing.assert_allclose(off.mean(axis=0), offset, atol=0.004)
    np.testing.assert_allclose(off.std(axis=0), [0.01, 0.01, 0.02], rtol=0.15)
    corrected = reflections_of(flown, corrected=True)
    true = np.array([p.position for p in flown.taken])[corrected.photo]
    assert np.abs((corrected.camera - true).mean(axis=0)).max() < 0.003


def test_exact_flight_tells_the_truth() -> None:
    flown = flight(EXACT)
    stand = standing(flown.heliostats, flown.counts)
    np.testing.assert_allclose(stand.rotation, flown.truth.rotation, atol=1e-12)
    found = reflections_of(flown, EXACT)
    np.testing.assert_allclose(found.camera, exact_reflections(flown).camera, atol=1e-7)


def test_outline_is_that_of_the_outer_facets() -> None:
    edge = outline(field())[0]
    np.testing.assert_allclose(
        edge, [[-1.24, 0.99, 0], [1.24, 0.99, 0], [1.24, -0.99, 0], [-1.24, -0.99, 0]], atol=1e-9
    )


def test_point_that_cannot_be_looked_at() -> None:
    with pytest.raises(InputError, match="cannot turn to"):
        look_counts(field(), [0.0, 40.0, -500.0])


def test_commands_come_back(tmp_path) -> None:
    path, names = tmp_path / "commands.csv", ("A", "B", "C")
    write_commands(path, names[:2], [[1.25, -2.0], [3.0, 4.0]])
    rows, counts = read_commands(path, names)
    assert rows.tolist() == [0, 1]
    np.testing.assert_array_equal(counts, [[1.25, -2.0], [3.0, 4.0]])
    with pytest.raises(UnknownNameError, match="there is no heliostat"):
        read_commands(path, ("X", "Y"))


def test_commands_of_a_plan(tmp_path) -> None:
    path = tmp_path / "commands.csv"
    path.write_text(
        "cluster,point,heliostat,count_1,count_2,reachable\n"
        "c1,1,A,1,2,true\nc1,2,A,3,4,true\nc1,2,B,5,6,false\nc2,1,C,7,8,true\n"
    )
    rows, counts = read_commands(path, ("A", "B", "C"), "c1", "2")
    assert (rows.tolist(), counts.tolist()) == ([0], [[3.0, 4.0]])
    with pytest.raises(FormatError, match="is listed twice"):
        read_commands(path, ("A", "B", "C"))
    with pytest.raises(InputError, match="no heliostat of cluster 'c9'"):
        read_commands(path, ("A", "B", "C"), "c9")
    path.write_text("heliostat,count_1,count_2\nA,1,much\n")
    with pytest.raises(FormatError, match="heliostat A: 'much' is not a finite number"):
        read_commands(path, ("A",))
