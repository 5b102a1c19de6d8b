"""Shading and blocking by neighbours: what is hidden, and where the centroid goes."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.obstruction import Case, cases, compare, hidden

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, bisector, direction, normalize, reflect
from heliotrope.imaging.synthetic.scenes import example_target
from heliotrope.optics import (
    CentroidShift,
    Mirrors,
    Scene,
    Shading,
    centroid_shift,
    equal_facets,
)
from heliotrope.optics.mirror_surface import mirror_axes

TARGET = example_target()
MIRROR = np.array([0.0, 180.0, 2.0])
SUN = direction(np.radians(180.0), np.radians(50.0))
WIDTH, HEIGHT = 3.2, 2.4
MM = 1e-3


def axes(sun: FloatArray = SUN) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Columns right, up and normal of the mirror that sends the sun to the target's middle."""
    normal = bisector(sun, normalize(TARGET.center - MIRROR))
    return tuple(mirror_axes(normal).T)  # type: ignore[return-value]


def parallel(*places: FloatArray) -> Mirrors:
    """Mirrors of the same size and normal at places from this one."""
    center = np.array([MIRROR + place for place in places]).reshape(-1, 3)
    return Mirrors.of(center, axes()[2], (WIDTH, HEIGHT), TARGET.center)


def shift(neighbours: Mirrors, focal: float = np.inf, sun: FloatArray = SUN) -> CentroidShift:
    facets = equal_facets(WIDTH, HEIGHT, (2, 2), focal)
    normal = axes(sun)[2]
    return centroid_shift(TARGET, MIRROR, sun, normal, facets, neighbours, facet_focal=focal)


def landing(off: FloatArray) -> FloatArray:
    """Where a parallel ray lands that leaves the mirror beside its middle, m on the target."""
    ray = reflect(SUN, axes()[2])
    return TARGET.plane_coordinates(TARGET.intersect(MIRROR + off, ray)) - (
        TARGET.plane_coordinates(TARGET.intersect(MIRROR, ray))
    )


@pytest.mark.parametrize("way", ["sun", "ray"])
@pytest.mark.parametrize(("right", "up"), [(0.0, -0.5), (0.5, 0.0), (-0.75, 0.0)])
def test_a_flat_mirrors_beam_moves_with_the_middle_of_what_is_left(
    way: str, right: float, up: float
) -> None:
    x, y, normal = axes()
    light = SUN if way == "sun" else reflect(SUN, normal)
    # A parallel neighbour 6 m up the light covers the mirror but for |right| and |up| of it.
    found = shift(parallel(6.0 * light + right * WIDTH * x + up * HEIGHT * y))
    share = (1.0 - abs(right)) * (1.0 - abs(up))
    assert found.hidden == pytest.approx(share, abs=1e-9)
    # What is left is as wide as |right| or |up|, at the other side.
    away = -np.sign(right) * 0.5 * (1 - abs(right)) * (right != 0.0) * WIDTH * x
    away = away - np.sign(up) * 0.5 * (1 - abs(up)) * (up != 0.0) * HEIGHT * y
    np.testing.assert_allclose(found.shift, landing(away), rtol=0, atol=1 * MM)
    assert np.linalg.norm(found.shift) > 0.15


def test_a_mirror_behind_or_beside_hides_nothing() -> None:
    x, _, normal = axes()
    for place in (-6.0 * SUN, -6.0 * reflect(SUN, normal), 1.01 * WIDTH * x):
        found = shift(parallel(place))
        assert found.hidden == 0.0
        np.testing.assert_array_equal(found.shift, 0.0)
    assert shift(parallel()).hidden == 0.0


def test_only_neighbours_in_the_light_can_hide_a_part() -> None:
    x, _, _ = axes()
    around = parallel(0.0 * x, 6.0 * SUN + 0.5 * WIDTH * x, -6.0 * SUN, 1.01 * WIDTH * x)
    for focal in (np.inf, 180.0):
        mirrors = around.with_numbers(focal=focal)
        shading = Shading(Scene(SUN, 0.0, mirrors, ()))
        assert shading.hiding(0).tolist() == [1]
        assert shading.hiding(2).tolist() == [0, 1]
        np.testing.assert_array_equal(mirrors.take(shading.hiding(0)).center, around.center[[1]])


def test_a_focused_beam_moves_by_its_astigmatism() -> None:
    """At the incidence θ rays meet at f cos θ in its plane (Coddington): h/4 (cos θ − 1)."""
    half = np.linalg.norm(TARGET.center - MIRROR)
    for degrees in (12.0, 20.0, 40.0, 60.0):
        # In the vertical plane of the ray, so that the lower half of the mirror is hidden evenly.
        to_target = normalize(TARGET.center - MIRROR)
        across = np.array([1.0, 0.0, 0.0])
        turn = np.radians(2.0 * degrees)
        sun = np.cos(turn) * to_target + np.sin(turn) * np.cross(across, to_target)
        sun = (
            sun
            if sun[2] > 0.0
            else np.cos(turn) * to_target - np.sin(turn) * np.cross(across, to_target)
        )
        _, up, normal = axes(sun)
        ray = reflect(sun, normal)
        center = MIRROR + 6.0 * ray - 0.5 * HEIGHT * up
        below = Mirrors.of(center, normal, (9.0, HEIGHT), TARGET.center)
        found = shift(below, half, sun)
        assert found.hidden == pytest.approx(0.5, abs=0.01)
        cos = np.cos(np.radians(degrees))
        wanted = 0.25 * HEIGHT * (1.0 - cos)
        # On the target's plane the ray is oblique.
        moved = np.linalg.norm(np.cross(found.shift @ TARGET.axes, ray))
        assert moved == pytest.approx(wanted, rel=0.1, abs=4 * MM)


def test_a_beam_loses_what_is_hidden_and_moves_as_predicted() -> None:
    case = next(c for c in cases() if 0.2 < hidden(c) < 0.3)
    share, said, flux, read = compare(case)
    whole, left = case.beam(alone=True), case.beam(alone=False)
    assert left.power / whole.power == pytest.approx(1.0 - share, abs=0.02)
    assert np.linalg.norm(said) > 8 * MM
    np.testing.assert_allclose(flux, said, rtol=0, atol=2.5 * MM)
    # Two rendered photographs, read as a plant reads them.
    np.testing.assert_allclose(read, said, rtol=0, atol=4 * MM)


def test_a_hidden_mirror_has_no_beam() -> None:
    found = shift(parallel(0.01 * SUN))
    assert found.hidden == pytest.approx(1.0, abs=1e-12)
    assert np.isnan(found.shift).all()
    case = cases()[0]
    normal = bisector(case.sun, normalize(case.target.center - case.center))
    wall = Mirrors.of(case.center + 0.1 * normal, normal, (9.0, 9.0), case.target.center)
    walled: Case = replace(case, neighbours=wall)
    with pytest.raises(InputError, match="neighbours hide the whole mirror"):
        walled.beam(alone=False)
