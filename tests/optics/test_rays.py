"""The ray tracer: another tracer's flux on a real plant, and scenes that are done by hand."""

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from heliotrope.errors import InputError
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.field.mesh import cavity_wall
from heliotrope.field.mirror_surface import MirrorSurface
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver
from heliotrope.field.tower import Tower
from heliotrope.geometry import bisector, direction, normalize
from heliotrope.mechanism.kinds import azimuth_elevation
from heliotrope.optics import FieldFlux, MirrorOptics, SunShape
from heliotrope.optics.beam import beams as beams_to
from heliotrope.optics.beam import crossing
from heliotrope.optics.plant_scene import scene_of
from heliotrope.optics.rays import trace
from heliotrope.optics.scene import FacetTable, Mirrors, Scene
from heliotrope.optics.surfaces import Cavity, Cylinder, Mesh, Plate, surface_of
from heliotrope.sun import Site
from support import dunhuang

pytest.importorskip("embreex", reason="the extra `rays` is not installed")

MRAD = 1e-3
EAST, NORTH, UP = np.eye(3)
SUN = direction(np.radians(180.0), np.radians(50.0))
POINT = SunShape("gaussian", sigma=1e-6)
MIDDLE = np.array([0.0, 0.0, 60.0])
# As seen from the north, its front to it, the right is the west.
PLATE = Plate("plate", MIDDLE, -EAST, UP, 6.0, 6.0, (6, 6))


def scene(places: Any, surface: Any = PLATE, towers: tuple[Tower, ...] = (), **more: Any) -> Scene:
    places = np.atleast_2d(np.asarray(places, dtype=float))
    normal = bisector(SUN, normalize(MIDDLE - places))
    mirrors = Mirrors.of(places, normal, (3.0, 2.0), MIDDLE, **{"slope": 0.0} | more)
    return Scene(SUN, 1000.0, mirrors, (surface,), towers)


@pytest.mark.parametrize("name", ["high_slant", "mid_slant", "low_slant", "high_flat"])
def test_rays_agree_with_another_tracer_on_a_real_plant(name: str) -> None:
    reference, given = dunhuang.flux(name), dunhuang.scene(name)
    traced = trace(given, 4e5, sun="pillbox", seed=1)
    error = np.hypot(traced.power_error[0], 1e3 * reference["power_se_kW"])
    assert traced.power[0] == pytest.approx(1e3 * reference["power_kW"], abs=3.5 * error)
    theirs = 1e3 * np.array(reference["flux_kW_m2"])
    apart = np.sqrt(np.mean((traced.flux[0] - theirs) ** 2))
    noise = np.hypot(
        np.sqrt(np.mean(traced.error[0] ** 2)), reference["se_rms_rel_peak"] * theirs.max()
    )
    assert 0.85 * noise < apart < 1.1 * noise
    exact = dunhuang.efficiencies()["suns"][name.partition("_")[0]]
    assert np.abs(traced.cosine - exact["cosine"]).max() < 1e-5
    ours = np.where(traced.count > 0, traced.shading, 0.0) @ traced.count / traced.count.sum()
    shading = np.array(exact["shading"]) @ traced.count / traced.count.sum()
    # The sun's disk, which the exact shares leave out, makes edges soft and no share less.
    assert ours == pytest.approx(shading, abs=4.0 * np.sqrt(shading * (1 - shading) / 4e5) + 1e-4)


def test_a_mirror_alone_sends_all_its_light() -> None:
    given = scene([10.0, 80.0, 0.0], reflectivity=0.8, clean=0.5)
    traced = trace(given, 2e4, sun=POINT, air="none")
    cosine = given.incidence[0]
    assert traced.power[0] == pytest.approx(6.0 * cosine * 0.4 * 1000.0, rel=1e-6)
    assert traced.shading[0] == traced.blocking[0] == traced.intercept[0] == 1.0
    # Focused on the middle, it lights a little of it.
    assert traced.flux[0][[0, -1]].sum() == 0.0


def test_the_size_of_an_image_is_that_of_sun_slope_and_pointing() -> None:
    fine = replace(PLATE, width=4.0, height=4.0, shape=(80, 80))
    place = np.array([0.0, 160.0, 60.0])  # level with the target, square to it
    spread = [[4 * MRAD**2, 0.0], [0.0, 1 * MRAD**2]]
    given = scene(place, fine, slope=0.5 * MRAD, pointing=spread)
    small = Mirrors.of(
        place, given.mirrors.normal, (1e-3, 1e-3), MIDDLE, slope=0.5 * MRAD, pointing=spread
    )
    traced = trace(replace(given, mirrors=small), 2e5, sun="pillbox", air="none")
    light = traced.flux[0] / traced.flux[0].sum()
    at = (np.arange(80) + 0.5) * 0.05 - 2.0
    right = light.sum(axis=0) @ at**2 - (light.sum(axis=0) @ at) ** 2
    up = light.sum(axis=1) @ at**2 - (light.sum(axis=1) @ at) ** 2
    sun, cos2 = SunShape("pillbox").variance, given.incidence[0] ** 2
    # The plane of incidence is upright here: slope counts 4 σ² in it and 4 σ² cos² across.
    cell = 0.05**2 / 12
    across = 160.0**2 * (sun + MRAD**2 * cos2 + 4 * MRAD**2) + cell
    assert right == pytest.approx(across, rel=0.015)
    assert up == pytest.approx(160.0**2 * (sun + MRAD**2 + MRAD**2) + cell, rel=0.015)


def test_a_neighbour_shades_and_blocks_the_share_that_it_covers() -> None:
    place = np.array([0.0, 100.0, 0.0])
    alone = scene(place).mirrors
    # Half a width to the side on the way to the sun; then on the way to the target.
    for way, name in ((SUN, "shading"), (normalize(MIDDLE - place), "blocking")):
        aside = place + 8.0 * way + 1.5 * alone.right[0]
        pair = scene([place, aside])
        same = replace(pair.mirrors, normal=np.repeat(alone.normal, 2, axis=0),
                       right=np.repeat(alone.right, 2, axis=0), up=np.repeat(alone.up, 2, axis=0),
                       focal=np.full(2, np.inf))  # fmt: skip
        traced = trace(replace(pair, mirrors=same), 4e4, sun=POINT)
        assert getattr(traced, name)[0] == pytest.approx(0.5, abs=0.015)
        assert traced.lit[0] == getattr(traced, name)[0]


def test_a_tower_shades() -> None:
    place = np.array([0.0, 30.0, 0.0])
    tower = Tower(0.0, 10.0, 1.0, -5.0, 55.0)  # south of it, where the sun is
    traced = trace(scene(place, towers=(tower,)), 4e4, sun=POINT)
    mirror = scene(place).mirrors
    assert mirror.width[0] == 3.0  # level in the east-west direction
    assert traced.shading[0] == pytest.approx(1.0 / 3.0, abs=0.01)


def box(plate: Plate, depth: float) -> Mesh:
    """The inside of a box behind a plate, without its front."""
    a, b = 0.5 * plate.width * plate.right, 0.5 * plate.height * plate.up
    near = [plate.center + x * a + y * b for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    far = [corner - depth * plate.normal for corner in near]
    faces = [(4, 5, 6), (4, 6, 7)]  # the back, seen from the front
    for i in range(4):
        j = (i + 1) % 4
        faces += [(i, j, 4 + j), (i, 4 + j, 4 + i)]
    return Mesh("box", np.array(near + far), np.array(faces))


def test_plates_meshes_and_cavities_take_the_same_light() -> None:
    places = [[x, 90.0, 0.0] for x in (-30.0, 0.0, 30.0)]
    two = Mesh("mesh", PLATE.corners, np.array([(0, 1, 2), (0, 2, 3)]))
    more = {"slope": 2.0 * MRAD, "focal": 150.0}
    plate, mesh, cavity = (
        trace(scene(places, surface, **more), 5e4, seed=2)
        for surface in (PLATE, two, Cavity(PLATE, box(PLATE, 4.0)))
    )
    assert 0.5 < plate.intercept.min() < 0.99 or plate.power[0] > 0.0
    assert mesh.power[0] == pytest.approx(plate.power[0], rel=1e-4)
    assert cavity.power[0] == pytest.approx(plate.power[0], rel=1e-4)
    # Its light comes from below: the back and the upper side get it, the floor next to nothing.
    assert cavity.flux[0].max() == cavity.flux[0][[0, 1, 6, 7]].max()


def test_a_cylinder_gets_light_on_the_side_of_the_mirrors() -> None:
    pipe = Cylinder("pipe", MIDDLE, UP, NORTH, 3.0, 8.0, shape=(4, 8))
    traced = trace(scene([0.0, 90.0, 0.0], pipe, slope=2.0 * MRAD), 3e4)
    columns = traced.flux[0].sum(axis=0)
    assert columns[[0, 7]].sum() > 0.9 * columns.sum()  # on both sides of north
    assert columns[2:6].sum() == 0.0


def test_facets_that_lie_on_the_mirror_s_curve_make_its_image() -> None:
    whole = scene([0.0, 120.0, 0.0])
    slant = whole.mirrors.slant[0]
    x, y = (a.ravel() for a in np.meshgrid([-1.0, 0.0, 1.0], [-0.5, 0.5]))
    center = np.stack([x, y], axis=-1)[None]
    facets = FacetTable(
        center, -center / (2.0 * slant), np.full((1, 6, 2), 0.5), np.full((1, 6), slant)
    )
    parted = replace(whole, mirrors=whole.mirrors.with_facets(facets))
    one, six = (trace(each, 1e5, seed=3, sun="pillbox") for each in (whole, parted))
    assert six.power[0] == pytest.approx(one.power[0], rel=1e-3)
    noise = np.hypot(one.error[0], six.error[0])
    assert (np.abs(one.flux[0] - six.flux[0]) < 4.5 * noise + 1e-9).all()


def test_dark_mirrors_send_no_rays() -> None:
    given = replace(scene([[0.0, 90.0, 0.0], [9.0, 90.0, 0.0]]), dark=np.array([True, False]))
    traced = trace(given, 1e4)
    assert traced.count.tolist() == [0.0, 1e4]
    assert np.isnan(traced.lit[0])


def test_the_number_of_rays_and_the_extra_are_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    given = scene([0.0, 90.0, 0.0])
    for rays in (10, 1e10, float("nan")):
        with pytest.raises(InputError, match="must be between 1,000 and 1,000,000,000"):
            trace(given, rays)
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)
    with pytest.raises(InputError, match=r"embreex is not installed; run pip install 'helio"):
        trace(given, 1e4)


def test_a_map_of_slopes_gives_the_image_of_its_rays() -> None:
    """Facets with slope maps, curvatures and errors of their own, against rays."""
    site = Site(37.0, -2.0, 0.0)
    place = np.array([[0.0, 120.0, 0.0], [25.0, 110.0, 0.0]])
    rough = np.random.default_rng(5).normal(size=(2, 24, 24, 2))
    smooth = gaussian_filter(rough, (0.0, 3.0, 3.0, 0.0))
    maps = 1.5 * MRAD * smooth / smooth.std()
    center = np.array([[[-0.8, 0.0], [0.8, 0.0]]] * 2)
    half = np.array([[[0.75, 1.0]] * 2] * 2)
    surface = MirrorSurface(
        focal=np.array([[130.0, np.inf], [120.0, 140.0]]),
        slope=np.array([[0.5, 1.5], [1.0, 1.0]]) * MRAD,
        maps=(maps, None),
    )
    facets = Facets.of(center, half, -center / 260.0)
    group = Heliostats(
        ("A", "B"), azimuth_elevation(place), np.full(2, 3.2), np.full(2, 2.0), facets=facets,
        surface=surface,
    )  # fmt: skip
    fine = replace(PLATE, width=4.0, height=4.0, shape=(20, 20))
    given = scene_of(Plant("p", site, {"g": group}), SUN, MIDDLE, receivers=(fine,))
    traced, found = trace(given, 1e6, air="none", seed=2), FieldFlux(given, air="none")
    away = np.sqrt(np.mean((found.maps[0] - traced.flux[0]) ** 2)) / traced.flux[0].max()
    assert away < 0.005
    assert found.powers[0] == pytest.approx(traced.power[0], rel=3e-3)
    # Without the map and the errors of single facets the image is another one.
    plain = replace(group, surface=None)
    other = scene_of(Plant("p", site, {"g": plain}), SUN, MIDDLE, receivers=(fine,))
    apart = np.sqrt(np.mean((FieldFlux(other, air="none").maps[0] - traced.flux[0]) ** 2))
    assert apart / traced.flux[0].max() > 0.05


def test_the_power_of_a_cavity_is_what_passes_its_aperture() -> None:
    """Whether or not the wall behind it catches it, as the engine counts it."""
    receiver = Receiver(
        "cavity", "cavity", MIDDLE, NORTH, 4.0, 4.0, mesh=cavity_wall(3.0, 2.5, 3.0)
    )
    given = scene([[0.0, 120.0, 0.0], [9.0, 120.0, 0.0]], surface_of(receiver))
    traced, found = trace(given, 2e5, air="none"), FieldFlux(given, air="none")
    assert traced.power[0] == pytest.approx(found.powers[0], rel=4e-3)
    area = given.surfaces[0].cells.area
    caught = traced.flux[0] @ area
    assert 0.2 * traced.power[0] < caught < 0.8 * traced.power[0]
    assert found.maps[0] @ area == pytest.approx(caught, rel=0.02)


@pytest.mark.parametrize("flat", [False, True])
def test_the_image_of_a_close_mirror_changes_over_the_depth_of_a_cavity(flat: bool) -> None:
    """Behind its focus a beam grows, and that of a partly blocked mirror moves aside."""
    receiver = Receiver(
        "cavity", "cavity", MIDDLE, NORTH, 4.0, 4.0, mesh=cavity_wall(3.5, 2.6, 5.0, (16, 32))
    )
    places = np.array([[0.0, 40.0, 50.0], [-3.4, 41.0, 50.0], [0.4, 41.5, 49.0], [4.0, 43.0, 50.0]])
    focal = np.inf if flat else np.linalg.norm(places - MIDDLE, axis=-1)
    given = scene(places, surface_of(receiver), slope=1.5 * MRAD, focal=focal)
    traced, found = trace(given, 1e6, air="none", seed=4), FieldFlux(given, air="none")
    assert traced.lit.min() < 0.2
    peak = traced.flux[0].max()
    apart = np.mean((found.maps[0] - traced.flux[0]) ** 2) - np.mean(traced.error[0] ** 2)
    assert np.sqrt(max(apart, 0.0)) < (0.004 if flat else 0.002) * peak
    area = given.surfaces[0].cells.area
    assert found.maps[0] @ area == pytest.approx(traced.flux[0] @ area, rel=0.008)


@pytest.mark.parametrize(("slope", "sun_shape"), [(0.0, "pillbox"), (1.0 * MRAD, "limb")])
def test_beams_crossing_in_the_air_are_estimated_from_above(slope: float, sun_shape: str) -> None:
    """A plate in the air, where sixty mirrors cross that are focused beside it.

    The rays bring 63 % of the estimate where it is strongest: they fall obliquely on the mirrors,
    which then focus less well, and obliquely on the plate.
    """
    random = np.random.default_rng(3)
    places = random.uniform((-40.0, 60.0, 0.0), (40.0, 120.0, 2.0), (60, 3))
    aside = MIDDLE + (12.0, 0.0, 0.0)
    small = replace(PLATE, center=aside, width=1.0, height=1.0, shape=(5, 5))
    normal = bisector(SUN, normalize(aside - places))
    mirrors = Mirrors.of(places, normal, (3.0, 2.0), MIDDLE, slope=slope)
    traced = trace(Scene(SUN, 1000.0, mirrors, (small,), ()), 2e6, sun=sun_shape, air="none")
    focus = np.linalg.norm(MIDDLE - places, axis=-1)
    given = beams_to(places, aside, MirrorOptics.of(3.0, 2.0, focus=focus))
    across = np.linspace(-0.4, 0.4, 5)
    points = aside + (across[:, None, None] * UP - across[:, None] * EAST)
    estimate = crossing(given, points.reshape(-1, 3), dni=1000.0).irradiance.reshape(5, 5)
    ratio = traced.flux[0] / estimate
    assert (ratio < 1.0 + 4.0 * traced.error[0] / estimate).all()
    assert 0.55 < traced.flux[0].max() / estimate.max() < 0.75
