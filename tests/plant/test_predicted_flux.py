"""The flux that a plant shows is that of its field as it stands, by the optical engine."""

import asyncio

import numpy as np
import pytest

import heliotrope as ht
from heliotrope.errors import InputError
from heliotrope.field.target import Receiver
from heliotrope.geometry import normalize
from heliotrope.optics import FieldOptics, plant_flux
from heliotrope.optics.surfaces import Cylinder, surface_of
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.operations.predicted_flux import _from_outside
from support.live import LivePlant, live


def test_it_is_what_the_library_says_of_the_same_mirrors() -> None:
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

    live(scene, AutomaticSettings(wanted=True))


def test_a_plant_goes_on_when_the_process_that_computes_it_has_ended() -> None:
    async def ended(*_: object) -> None:
        raise InputError("the process that computes beside the plant has ended")

    async def scene(made: LivePlant) -> None:
        operations = made.operations
        operations._flux._worker = ended  # type: ignore[assignment]
        with pytest.raises(InputError):
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
    shown = _from_outside(plant_flux._view(surface, flux, 1.0, 1.0, 1), receiver)
    row, column = np.argwhere(shown.flux)[0]
    point = receiver.point(shown.right[column], shown.up[row])
    np.testing.assert_allclose(point, surface.cells.center.reshape(3, 40, 3)[1, 7], atol=1e-6)
    assert (np.diff(shown.right) > 0.0).all()
