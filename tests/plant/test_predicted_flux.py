"""The flux that a plant shows is that of its field as it stands, by the optical engine."""

import asyncio
from dataclasses import replace

import numpy as np
import pytest

import heliotrope as ht
from heliotrope.errors import InputError
from heliotrope.field.mirror_surface import MirrorSurface
from heliotrope.field.target import Receiver
from heliotrope.geometry import FloatArray, normalize
from heliotrope.lcu import states
from heliotrope.optics import (
    Cavity,
    Cylinder,
    FieldOptics,
    FluxView,
    Mesh,
    Mirrors,
    Plate,
    Scene,
    plant_flux,
    surface_of,
)
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.operations.predicted_flux import _from_outside, predicted
from heliotrope.plant.operations.views import PredictedView
from heliotrope.plant.refusals import RefusedError
from support.live import LivePlant, live

#: What a plant file may say of four mirrors: flatter and rougher than usual.
SURFACE = MirrorSurface(np.full(4, 80.0), np.full(4, 3e-3), np.full(4, 0.8))


@pytest.mark.parametrize("surface", [None, SURFACE])
def test_it_is_what_the_library_says_of_the_same_mirrors(surface: MirrorSurface | None) -> None:
    async def scene(made: LivePlant) -> None:
        operations, plant = made.operations, made.plant
        operations.automatic.switch(on=False)  # no visit takes one away
        dark = await operations.receiver_flux()
        assert dark.power == 0.0, "all stand in stow"
        assert np.isnan(dark.intercept)
        for _ in range(200):
            if (operations.viewer.frame().on == 1).all():
                break
            await asyncio.sleep(2.0)
        await asyncio.sleep(20.0)
        shown, sun = await operations.receiver_flux(), plant.sun_vector()
        assert shown.heliostats == len(made.names)
        light = FieldOptics(error=operations.automatic.installed)
        whole = ht.flux(made.design, sun=sun, aim=plant.aims, light=light)
        assert shown.power == pytest.approx(whole.power, rel=0.01)
        away = np.abs(shown.flux - whole.flux).max()
        assert away < 0.05 * whole.peak, "the sun has moved on by some seconds at most"
        assert np.isnan(shown.peak_sigma), "none of them was ever calibrated"
        assert 0.0 < shown.power_sigma < shown.power

    live(scene, AutomaticSettings(wanted=True), surface=surface)


def test_after_a_start_the_flux_is_unknown_until_the_heliostats_have_reported() -> None:
    async def scene(made: LivePlant) -> None:
        field, flux = made.plant.field, made.operations._flux
        assert (await made.operations.receiver_flux()).power == 0.0
        flux._begun = made.plant.now()
        field.heard[:2] = -np.inf
        field.rows["state"][2], field.counted_at[2] = states.TRACKING, -np.inf
        with pytest.raises(
            RefusedError, match="not yet known; 3 of 4 heliostats have not reported"
        ):
            await made.operations.receiver_flux()
        await asyncio.sleep(4.0)
        assert (await made.operations.receiver_flux()).power == 0.0
        field.heard[:2] = -np.inf
        flux._begun = made.plant.now() - 61.0
        assert (await made.operations.receiver_flux()).power == 0.0, "a lost cluster hides nothing"

    live(scene, AutomaticSettings())


@pytest.mark.parametrize("error", [InputError("the process has ended"), ValueError("a defect")])
def test_a_plant_goes_on_when_its_flux_cannot_be_computed(error: Exception) -> None:
    async def ended(*_: object) -> None:
        raise error

    async def scene(made: LivePlant) -> None:
        operations = made.operations
        operations._flux._worker = ended  # type: ignore[assignment]
        with pytest.raises(RefusedError, match=str(error)):
            await operations.receiver_flux()
        taken = await operations._figures()
        assert "available" in taken
        assert "power.receiver" not in taken

    live(scene, AutomaticSettings())


@pytest.mark.parametrize("front", [(0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (-0.6, -0.8, 0.0)])
@pytest.mark.parametrize("kind", ["external_cylinder", "convex_cylinder"])
def test_columns_run_to_the_right_as_seen_from_outside(
    kind: str, front: tuple[float, float, float]
) -> None:
    """`Receiver.point` finds a bright cell at the place that the map gives it."""
    turn, middle = 2.0 * np.pi if kind == "external_cylinder" else 2.0, np.array([0.0, 0.0, 60.0])
    receiver = Receiver("r", kind, middle, normalize(front), 8.0, 5.0, None, 4.0, turn)
    surface = surface_of(receiver, (3, 40))
    assert isinstance(surface, Cylinder)
    flux = np.zeros((3, 40))
    flux[1, 7] = 1.0
    view: FluxView = plant_flux._view(surface, flux, 1.0, 1.0, 1)
    made = PredictedView(**vars(view), sigma=0.1 * flux, power_sigma=0.0, peak=1.0, peak_sigma=0.1)
    shown = _from_outside(made, receiver)
    np.testing.assert_array_equal(shown.sigma, 0.1 * shown.flux)
    row, column = np.argwhere(shown.flux)[0]
    point = receiver.point(shown.right[column], shown.up[row])
    np.testing.assert_allclose(point, surface.cells.center.reshape(3, 40, 3)[1, 7], atol=1e-6)
    assert (np.diff(shown.right) > 0.0).all()


def _field(count: int, off: float) -> Scene:
    """Mirrors in a row, half of whose beams lie at the edge of a small plate."""
    place = np.stack(
        [np.linspace(-20.0, 20.0, count), np.full(count, 60.0), np.zeros(count)], axis=-1
    )
    middle, west, up = np.array([0.0, 0.0, 30.0]), -np.eye(3)[0], np.eye(3)[2]
    plate = Plate("plate", middle, west, up, 3.0, 3.0, (12, 12))
    aim = plate.center + np.outer(np.arange(count) % 2, [1.5, 0.0, 0.0])
    sun = normalize(np.array([0.1, 0.5, 0.8]))
    normal = normalize(sun + normalize(aim - place))
    spread = off**2 * np.array([[1.0, 0.3], [0.3, 0.5]])
    pointing = np.broadcast_to(spread, (count, 2, 2))
    mirrors = Mirrors.of(place, normal, (2.0, 2.0), aim, slope=1.5e-3, pointing=pointing)
    return Scene(sun, 900.0, mirrors, (plate,))


def _drawn(scene: Scene, light: FieldOptics) -> tuple[FloatArray, FloatArray]:
    """Return the maps (400, rows, columns) and powers (400,) of fields with drawn errors."""
    exact = np.zeros((12, 2, 2))
    rng, maps, powers = np.random.default_rng(1), [], []
    m = scene.mirrors
    slant = np.linalg.norm(m.aim - m.center, axis=-1, keepdims=True)
    ray = (m.aim - m.center) / slant
    right = normalize(np.stack([ray[:, 1], -ray[:, 0], 0.0 * ray[:, 0]], axis=-1))
    up = np.cross(right, ray)
    root = np.linalg.cholesky(m.pointing[0])
    for _ in range(400):
        e = rng.standard_normal((12, 2)) @ root.T
        moved = m.toward(scene.sun, m.aim + slant * (e[:, :1] * right + e[:, 1:] * up))
        engine = light.engine(scene.with_mirrors(replace(moved, pointing=exact)))
        maps.append(engine.maps[0])
        powers.append(float(engine.power.sum()))
    return np.array(maps), np.array(powers)


def test_its_uncertainty_is_that_of_fields_with_errors() -> None:
    """Standard deviations of cells, power and peak, against 400 fields with drawn errors."""
    scene, light = _field(12, 0.7e-3), FieldOptics()
    (shown,) = predicted(scene, light)
    maps, powers = _drawn(scene, light)
    true = np.std(maps, axis=0)
    bright = shown.flux > 0.3 * shown.peak
    np.testing.assert_allclose(shown.sigma[bright], true[bright], rtol=0.25)
    assert shown.power_sigma == pytest.approx(np.std(powers), rel=0.15)
    assert shown.flux.max() == shown.peak
    assert shown.peak_sigma == shown.sigma[np.unravel_index(shown.flux.argmax(), (12, 12))]
    (sure,) = predicted(_field(12, 0.0), light)
    assert sure.sigma.max() < 1e-6 * sure.peak
    assert sure.power_sigma < 1e-6 * sure.power


def _in_triangles(plate: Plate, depth: float) -> Mesh:
    """The cells of a plate, each as two triangles, moved back by a depth."""
    rows, columns = plate.shape
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, columns + 1), np.linspace(-0.5, 0.5, rows + 1))
    flat = x[..., None] * plate.width * plate.right + y[..., None] * plate.height * plate.up
    one = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    over = one + columns + 1
    faces = [np.stack([one, one + 1, over + 1], -1), np.stack([one, over + 1, over], -1)]
    middle = plate.center - depth * plate.normal
    return Mesh(plate.name, middle + flat.reshape(-1, 3), np.concatenate(faces))


@pytest.mark.parametrize("depth", [0.0, 1.5])
def test_a_mesh_and_a_cavity_have_an_uncertainty_too(depth: float) -> None:
    """Behind an aperture, the power is what enters and the cells are those of the wall."""
    scene, light = _field(12, 0.7e-3), FieldOptics()
    (plate,) = scene.surfaces
    assert isinstance(plate, Plate)
    wall = _in_triangles(replace(plate, width=5.0, height=5.0) if depth else plate, depth)
    scene = replace(scene, surfaces=(Cavity(plate, wall) if depth else wall,))
    (shown,) = predicted(scene, light)
    maps, powers = _drawn(scene, light)
    bright = shown.flux > 0.3 * shown.peak
    true = np.std(maps, axis=0).reshape(shown.flux.shape)
    np.testing.assert_allclose(shown.sigma[bright], true[bright], rtol=0.3)
    assert shown.power_sigma == pytest.approx(np.std(powers), rel=0.15)
    assert shown.peak_sigma == shown.sigma[0, shown.flux.argmax()]
    if not depth:
        (flat,) = predicted(_field(12, 0.7e-3), light)
        both = shown.sigma.reshape(2, 12, 12)
        np.testing.assert_allclose(both.mean(axis=0), flat.sigma, atol=0.05 * flat.sigma.max())


def test_a_second_receiver_has_its_own_uncertainty() -> None:
    scene = _field(12, 0.7e-3)
    (alone,) = predicted(scene, FieldOptics())
    (plate,) = scene.surfaces
    assert isinstance(plate, Plate)
    other = replace(plate, name="other", center=np.array([0.0, 500.0, 30.0]))
    first, second = predicted(replace(scene, surfaces=(other, plate)), FieldOptics())
    assert (first.power, first.power_sigma, first.peak_sigma) == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(second.sigma, alone.sigma)
    assert second.power_sigma == pytest.approx(alone.power_sigma)


def test_the_beams_of_a_singular_covariance_are_uncertain_in_one_direction() -> None:
    scene = _field(12, 0.7e-3)
    along = 1e-7 * np.array([[1.0, 1.0 + 1e-15], [1.0 + 1e-15, 1.0]])
    mirrors = replace(scene.mirrors, pointing=np.broadcast_to(along, (12, 2, 2)))
    (shown,) = predicted(scene.with_mirrors(mirrors), FieldOptics())
    assert np.isfinite(shown.sigma).all()
    assert shown.power_sigma > 0.0


def test_beams_of_wide_errors_bring_their_power_or_not() -> None:
    """As heliostats that were never calibrated do; what they do to a cell is not known."""
    scene, light = _field(12, 40e-3), FieldOptics()
    (shown,) = predicted(scene, light)
    _, powers = _drawn(scene, light)
    assert shown.power_sigma == pytest.approx(np.std(powers), rel=0.2)
    assert np.isnan(shown.sigma).all()
    assert np.isnan(shown.peak_sigma)
