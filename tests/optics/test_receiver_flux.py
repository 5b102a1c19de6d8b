"""The flux engine: against 10⁷ rays of another program, and closed forms."""

import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.field.tower import Tower
from heliotrope.geometry import bisector, direction, normalize
from heliotrope.optics.receiver_flux import FieldFlux
from heliotrope.optics.scene import FacetTable, Mirrors, Scene
from heliotrope.optics.surfaces import Cavity, Cylinder, Mesh, Plate, Surface
from support import dunhuang

MRAD = 1e-3
AIM = np.array([0.0, 0.0, 100.0])
SUN = normalize(np.array([0.3, -0.5, 0.8]))
EAST, UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("name", "cells", "power"),
    [
        # RMS of the difference over the peak, less the rays' own; power relative.
        ("high_slant", 0.0015, 0.0005),
        ("mid_slant", 0.0015, 0.0008),
        ("low_slant", 0.0015, 0.0012),
        ("high_flat", 0.0020, 0.0015),
    ],
)
def test_cells_and_power_of_a_real_plant_are_those_of_rays(
    name: str, cells: float, power: float
) -> None:
    rays = dunhuang.flux(name)
    found = FieldFlux(dunhuang.scene(name), sun="pillbox")
    reference = 1e3 * np.array(rays["flux_kW_m2"])
    rms = np.sqrt(np.mean((found.maps[0] - reference) ** 2)) / reference.max()
    noise = rays["se_rms_rel_peak"]
    assert rms < (0.008 if name == "high_flat" else 0.005)
    assert np.sqrt(max(rms**2 - noise**2, 0.0)) < cells
    assert found.powers[0] == pytest.approx(1e3 * rays["power_kW"], rel=power)


def test_the_field_s_efficiency_is_that_of_the_reference() -> None:
    for sun in ("high", "low"):
        exact = dunhuang.efficiencies()["suns"][sun]["mean"]
        e = FieldFlux(dunhuang.scene(f"{sun}_flat"), sun="pillbox").efficiencies
        product = np.mean(e.cosine * e.lit * e.air)
        assert product == pytest.approx(exact["cos_both_att"], abs=2e-5)


def plate(width: float = 14.0, height: float = 12.0, cells: tuple[int, int] = (60, 70)) -> Plate:
    return Plate("plate", AIM, EAST, UP, width, height, cells)


def mirrors(**more: object) -> Mirrors:
    place = np.array([[0.0, -300.0, 0.0], [120.0, -200.0, 0.0]])
    return Mirrors.of(
        place, bisector(SUN, normalize(AIM - place)), (8.0, 6.0), AIM, **more  # type: ignore[arg-type]
    )  # fmt: skip


def test_all_light_falls_on_a_large_plate() -> None:
    found = FieldFlux(Scene(SUN, 1000.0, mirrors(), (plate(),)), air="none")
    e = found.efficiencies
    assert e.intercept == pytest.approx([1.0, 1.0], abs=1e-4)
    assert e.total == pytest.approx(0.9 * e.cosine, rel=1e-4)
    assert found.leaving == pytest.approx(1000.0 * 0.9 * 48.0 * e.cosine, rel=1e-4)
    power = found.maps[0].sum() * 14.0 * 12.0 / (60 * 70)
    assert power == pytest.approx(found.powers[0], rel=1e-9)


def spread(found: FieldFlux, surface: Plate) -> np.ndarray:
    """Covariance right and up of the flux on a plate, m²."""
    weight = found.maps[0].ravel() / found.maps[0].sum()
    off = (surface.cells.center - AIM) @ np.stack([surface.right, surface.up], axis=-1)
    off = off - weight @ off
    return np.asarray((weight[:, None] * off).T @ off)


def test_slope_counts_four_times_in_the_plane_of_incidence_and_less_across() -> None:
    """The image of one small mirror: sun, slope and belief, at 45° of incidence."""
    place = np.array([[0.0, -200.0, 100.0]])
    sun = np.array([1.0, 0.0, 0.0])
    normal = normalize(np.array([[1.0, 1.0, 0.0]]))
    belief = np.diag([1.0, 4.0]) * MRAD**2
    surface = plate(cells=(120, 140))
    found = {}
    for name, slope, pointing in (("slope", 2.0, 0.0 * belief), ("belief", 0.0, belief)):
        given = Mirrors.of(place, normal, (0.1, 0.1), AIM, slope=slope * MRAD, pointing=pointing)
        scene = Scene(sun, 1000.0, given, (surface,))
        found[name] = spread(FieldFlux(scene, sun="gaussian:0.001", air="none"), surface)
    metre = (200.0 * MRAD) ** 2
    assert found["slope"][0, 0] == pytest.approx(metre * (1.0 + 4.0 * 4.0), rel=5e-3)
    assert found["slope"][1, 1] == pytest.approx(metre * (1.0 + 4.0 * 4.0 * 0.5), rel=5e-3)
    assert found["belief"][0, 0] == pytest.approx(metre * 2.0, rel=2e-2)
    assert found["belief"][1, 1] == pytest.approx(metre * 5.0, rel=1e-2)


def on_paraboloid(given: Mirrors, row: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return points of a mirror's true surface, (..., 3)."""
    z = (x * x + y * y) / (4.0 * given.focal[row])
    parts = zip((x, y, z), (given.right[row], given.up[row], given.normal[row]), strict=True)
    return given.center[row] + sum(value[..., None] * axis for value, axis in parts)


def test_a_curved_mirror_in_shadow_receives_what_passes_its_plane() -> None:
    """The edge that is still lit leans from the sun or to it; the sagitta makes up for it."""
    sun, focal = direction(np.radians(270.0), np.radians(12.0)), 80.0
    place = np.array([[0.0, 120.0, 0.0], [-7.0, 121.5, 0.0]])
    normal = bisector(np.broadcast_to(sun, (2, 3)), normalize(AIM - place))
    given = Mirrors.of(place, normal, (6.0, 6.0), AIM, focal=focal, reflectivity=1.0)
    surface = Plate("plate", AIM, -EAST, UP, 40.0, 40.0)
    found = FieldFlux(Scene(sun, 1000.0, given, (surface,)), air="none")
    assert found.lit.blocking[0] == 1.0
    assert found.lit.shading[0] < 0.6

    line = (np.arange(1000) + 0.5) / 1000 * 6.0 - 3.0
    x, y = np.meshgrid(line, line)
    lean = (x * (given.right[0] @ sun) + y * (given.up[0] @ sun)) / (2.0 * focal)
    # Where the rays to these points meet the neighbour's paraboloid.
    away, depth = on_paraboloid(given, 0, x, y) - given.center[1], np.zeros_like(x)
    for _ in range(20):
        along = (depth - away @ given.normal[1]) / (given.normal[1] @ sun)
        meets = away + along[..., None] * sun
        across, upward = meets @ given.right[1], meets @ given.up[1]
        depth = (across**2 + upward**2) / (4.0 * focal)
    shaded = (along > 0.0) & (np.maximum(np.abs(across), np.abs(upward)) < 3.0)
    truth = 36.0 * 1000.0 * float(np.mean((given.normal[0] @ sun - lean) * ~shaded))
    assert found.leaving[0] == pytest.approx(truth, rel=1e-3)


def test_a_focused_mirror_s_image_is_astigmatic() -> None:
    """ξ (cos θ − t/S) in the plane of incidence and η (1 − cos θ · t/S) across it."""
    place = np.array([[0.0, -200.0, 100.0]])
    cosine = np.cos(np.radians(50.0))
    turn = np.radians(100.0)
    sun = np.array([np.sin(turn), np.cos(turn), 0.0])
    normal = bisector(sun, np.array([[0.0, 1.0, 0.0]]))
    surface = plate(cells=(120, 140))
    given = Mirrors.of(place, normal, (6.0, 6.0), AIM, slope=0.5 * MRAD)
    small = Mirrors.of(place, normal, (0.01, 0.01), AIM, slope=0.5 * MRAD)
    wide, narrow = (
        spread(FieldFlux(Scene(sun, 1000.0, m, (surface,)), air="none"), surface)
        for m in (given, small)
    )
    expected = [36.0 / 12.0 * (cosine - 1.0) ** 2, 36.0 / 12.0 * (1.0 - cosine) ** 2]
    assert np.diag(wide - narrow) == pytest.approx(expected, rel=0.02)


def triangles(surface: Plate, count: int) -> Mesh:
    x, y = np.meshgrid(
        np.linspace(-0.5, 0.5, count + 1) * surface.width,
        np.linspace(-0.5, 0.5, count + 1) * surface.height,
    )
    places = surface.center + x.reshape(-1, 1) * surface.right + y.reshape(-1, 1) * surface.up
    row, column = (a.ravel() for a in np.mgrid[:count, :count])
    a = row * (count + 1) + column
    faces = np.concatenate(
        [np.stack([a, a + 1, a + count + 2], -1), np.stack([a, a + count + 2, a + count + 1], -1)]
    )
    return Mesh("mesh", places, faces)


def test_a_mesh_takes_what_a_plate_takes() -> None:
    surface = plate(6.0, 5.0)
    one = FieldFlux(Scene(SUN, 1000.0, mirrors(), (surface,)))
    other = FieldFlux(Scene(SUN, 1000.0, mirrors(), (triangles(surface, 40),)))
    assert other.efficiencies.intercept == pytest.approx(one.efficiencies.intercept, abs=2e-3)
    assert other.maps[0].max() == pytest.approx(one.maps[0].max(), rel=5e-3)


def test_a_mesh_hides_its_own_back() -> None:
    front, back = triangles(plate(6.0, 5.0), 8), triangles(plate(6.0, 5.0), 8)
    behind = Mesh("both", np.concatenate([front.vertices, back.vertices + [0.0, 3.0, 0.0]]),
                  np.concatenate([front.faces, back.faces + len(front.vertices)]))  # fmt: skip
    cells = FieldFlux(Scene(SUN, 1000.0, mirrors(), (behind,))).maps[0]
    # Light that rises, and comes from the east, passes below the front one and beside it.
    lit, place = cells[len(front.faces) :] > 0.0, behind.cells.center[len(front.faces) :]
    hidden = (place[:, 2] > 99.5) & (place[:, 0] < 1.0)
    assert not lit[hidden].any()
    assert lit[~hidden].any()
    assert (cells[: len(front.faces)] > 0.0).all()


def test_light_enters_a_cavity_by_its_aperture() -> None:
    inner = triangles(plate(20.0, 20.0), 40)
    inner = Mesh("inner", inner.vertices + [0.0, 4.0, 0.0], inner.faces)
    cavity = Cavity(plate(3.0, 3.0), inner)
    one = FieldFlux(Scene(SUN, 1000.0, mirrors(), (plate(3.0, 3.0),)))
    found = FieldFlux(Scene(SUN, 1000.0, mirrors(), (cavity,)))
    assert found.powers == pytest.approx(one.powers)
    assert found.maps[0] @ inner.cells.area == pytest.approx(one.powers[0], rel=0.01)


def test_a_cylinder_of_great_radius_is_a_plate() -> None:
    flat = plate(6.0, 5.0, (30, 36))
    turn = 6.0 / 1e4
    north = np.array([0.0, -1.0, 0.0])
    round_ = Cylinder(
        "round", AIM + [0.0, 1e4, 0.0], UP, north, 1e4, 5.0, (-0.5 * turn, 0.5 * turn), (30, 36)
    )
    one, other = (
        FieldFlux(Scene(SUN, 1000.0, mirrors(), (surface,))).maps[0] for surface in (flat, round_)
    )
    # The azimuth grows to the left as seen from the field.
    assert other[:, ::-1] == pytest.approx(one, rel=2e-3, abs=1e-3 * one.max())


def test_facets_on_the_mirror_s_curve_make_its_image() -> None:
    given = mirrors()
    x, y = np.meshgrid((np.arange(8) + 0.5) - 4.0, (np.arange(6) + 0.5) - 3.0)
    center = np.repeat(np.stack([x.ravel(), y.ravel()], axis=-1)[None], 2, axis=0)
    focal = given.slant[:, None]
    tilt, half = -center / (2.0 * focal[..., None]), np.full((2, 48, 2), 0.5)
    table = FacetTable(center, tilt, half, np.repeat(focal, 48, 1))
    surface = plate(6.0, 5.0)
    one, other = (
        FieldFlux(Scene(SUN, 1000.0, m, (surface,))).maps[0]
        for m in (given, given.with_facets(table))
    )
    assert other == pytest.approx(one, abs=1e-2 * one.max())


def test_moving_some_mirrors_gives_what_a_new_scene_gives() -> None:
    rng = np.random.default_rng(5)
    place = np.column_stack([rng.uniform(-60, 60, (200, 2)), np.zeros(200)]) - [0.0, 200.0, 0.0]

    def scene(aim: np.ndarray) -> Scene:
        normal = bisector(SUN, normalize(aim - place))
        given = Mirrors.of(place, normal, (4.0, 4.0), aim, focal=200.0)
        return Scene(SUN, 1000.0, given, (plate(10.0, 10.0, (20, 20)),))

    aim = np.tile(AIM, (200, 1))
    found = FieldFlux(scene(aim))
    rows = np.array([3, 50, 120])
    aim[rows] += [3.0, 0.0, 2.0]
    found.move(rows, scene(aim).mirrors)
    anew = FieldFlux(scene(aim))
    assert found.maps[0] == pytest.approx(anew.maps[0], abs=1e-9 * anew.maps[0].max())
    assert np.array_equal(found.power, anew.power)
    assert np.array_equal(found.efficiencies.air, anew.efficiencies.air)


def test_the_number_of_threads_changes_no_digit(monkeypatch: pytest.MonkeyPatch) -> None:
    maps = []
    for threads in ("1", "2"):
        monkeypatch.setenv("HELIOTROPE_THREADS", threads)
        maps.append(FieldFlux(Scene(SUN, 1000.0, mirrors(), (plate(),))).maps[0])
    assert np.array_equal(maps[0], maps[1])


def test_dark_mirrors_and_mirrors_behind_the_sun_send_nothing() -> None:
    given = mirrors()
    dark = Scene(SUN, 1000.0, given, (plate(),), dark=np.array([True, False]))
    found = FieldFlux(dark)
    assert found.power[0] == 0.0
    assert found.power[1] > 0.0
    assert np.isnan(found.efficiencies.intercept[0])


def test_bad_scenes_are_refused_in_one_line() -> None:
    away = Plate("back", AIM, -EAST, UP, 6.0, 5.0)
    with pytest.raises(InputError, match="receiver back: no mirror sends light to it"):
        FieldFlux(Scene(SUN, 1000.0, mirrors(), (away,))).check_met()
    with pytest.raises(InputError, match=r"DNI must be 0 or more and finite, not -1\.0 W/m²"):
        Scene(SUN, -1.0, mirrors(), (plate(),))
    with pytest.raises(InputError, match="mirror 0 is inside a tower"):
        Scene(SUN, 1.0, mirrors(), (plate(),), (Tower(0.0, -300.0, 5.0, -1.0, 9.0),))
    with pytest.raises(InputError, match=r"slope must be between 0 and 0\.1, not 0\.2 rad"):
        mirrors(slope=0.2)
    table = FacetTable(np.array([[[5.0, 0.0]]]), np.zeros((1, 1, 2)), np.ones((1, 1, 2)),
                       np.full((1, 1), np.inf))  # fmt: skip
    with pytest.raises(InputError, match=r"mirror 0: a facet reaches 6\.000 m from the centre"):
        mirrors().with_facets(table)
    with pytest.raises(InputError, match="face 0 has no area"):
        Mesh("mesh", np.zeros((3, 3)), np.array([[0, 1, 2]]))


@pytest.mark.parametrize(
    ("cells", "round_", "off"),
    [
        ((3, 3), False, 3e-4),
        ((8, 5), False, 3e-4),
        ((24, 24), False, 3e-4),
        ((96, 96), False, 3e-4),
        ((24, 24), True, 6e-3),
        ((48, 96), True, 1e-3),
    ],
)
def test_power_does_not_depend_on_the_cells(
    cells: tuple[int, int], round_: bool, off: float
) -> None:
    """A beam in the middle is caught whole, also where it is narrower than a cell."""
    middle, up = np.array([0.3, 0.2, 30.0]), np.eye(3)[2]
    surface: Surface = Plate("p", middle, np.array([-1.0, 0.0, 0.0]), up, 14.0, 13.0, cells)
    if round_:
        surface = Cylinder(
            "c", middle, up, np.array([0.0, 1.0, 0.0]), 9.0, 13.0, (-1.5, 1.5), cells
        )
    place = np.stack([np.linspace(-20.0, 20.0, 40), np.linspace(50.0, 70.0, 40), np.zeros(40)], -1)
    sun = normalize(np.array([0.3, 0.4, 0.8]))
    aim = middle + np.array([0.0, 9.0, 0.0]) * round_ + np.linspace(-0.6, 0.6, 40)[:, None] * up
    normal = normalize(sun + normalize(aim - place))
    mirrors = Mirrors.of(place, normal, (1.0, 1.0), aim, slope=1e-3)
    engine = FieldFlux(Scene(sun, 900.0, mirrors, (surface,)))
    shares = engine.efficiencies.intercept
    np.testing.assert_allclose(shares, 1.0, atol=off)
    # The tails of the sun's sum of Gaussians, of which one weight is negative.
    assert float(engine.maps[0].min()) > -5e-4 * engine.maps[0].max()
