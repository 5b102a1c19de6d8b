"""The flux that the field is expected to bring to its receivers.

Every mirror stands where its reported step counts place it under its present calibration, so those
that turn away or rest in stow shade and block as they stand. The light is that of
`heliotrope.optics.receiver_flux`, computed beside the plant's loop (`plant.workers`) when somebody
asks for it.
"""

import asyncio
from dataclasses import replace

import numpy as np

from heliotrope.field.target import Receiver
from heliotrope.optics import FieldOptics, FluxView, scene_flux
from heliotrope.optics.scene import Mirrors, Scene, facets_of
from heliotrope.optics.surfaces import surface_of
from heliotrope.plant.controller import PlantController
from heliotrope.plant.emergency import DNI_READING
from heliotrope.plant.operations.viewing import Viewer
from heliotrope.plant.workers import Worker

#: Time for which a prediction is shown, s.
EVERY = 5.0
_LIGHT = FieldOptics()


class PredictedFlux:
    """The flux on all receivers of a plant.

    Parameters
    ----------
    plant, viewer
        The controller, and the views of its field.
    installed
        Expected error of a heliostat that was never calibrated, rad.
    worker
        Place for the computation.
    """

    def __init__(
        self, plant: PlantController, viewer: Viewer, installed: float, worker: Worker
    ) -> None:
        self._plant, self._viewer, self._worker = plant, viewer, worker
        self._installed = installed
        design = plant.design
        place = {name: row for row, name in enumerate(design.names)}
        self._rows = np.array([place[name] for name in plant.field.names], dtype=np.intp)
        self._surfaces = tuple(surface_of(receiver) for receiver in design.receivers)
        self._views: dict[str, FluxView] = {}
        self._made_at = -np.inf
        self._computing = asyncio.Lock()

    async def everywhere(self) -> dict[str, FluxView]:
        """Return the flux on each receiver, by name, at most `EVERY` old."""
        # Whoever asks while it is computed waits for that.
        async with self._computing:
            now, receivers = self._plant.now(), self._plant.design.receivers
            if receivers and now - self._made_at >= EVERY:
                on = self._viewer.frame().on
                views = await self._worker(scene_flux, self.scene(now), _LIGHT)
                for k, (receiver, view) in enumerate(zip(receivers, views, strict=True), 1):
                    shown = replace(view, heliostats=int((on == k).sum()))
                    self._views[receiver.name] = _from_outside(shown, receiver)
                self._made_at = now
        return self._views

    def scene(self, now: float) -> Scene:
        """Return the field as it stands: the mirrors on a receiver shine, the others cast shadows.

        The irradiance is measured where there is a sensor.
        """
        plant, frame, beams = self._plant, self._viewer.frame(), self._plant.beams
        normal, center = beams.armature.pose(beams.drives.angles(plant.field.posed))
        middle = self._surfaces[0].center
        aims = np.where(np.isfinite(plant.aims).all(axis=-1, keepdims=True), plant.aims, middle)
        error = np.where(np.isfinite(frame.error), frame.error, self._installed)
        # Two axes of the normal share its variance, and the beam turns by twice the angle.
        spread = 2.0 * error[:, None, None].astype(np.float64) ** 2 * np.eye(2)
        size = self._viewer.sizes
        mirrors = Mirrors.of(
            center, normal, (size[:, 0], size[:, 1]), aims, slope=_LIGHT.slope,
            reflectivity=_LIGHT.reflectivity, pointing=spread,
        )  # fmt: skip
        table = facets_of(plant.design, mirrors.slant[np.argsort(self._rows)])
        if table is not None:
            mirrors = mirrors.with_facets(table[0], self._rows)
        dark = ~(plant.field.sure(now) & (frame.on >= 1) & (frame.on <= len(self._surfaces)))
        measured = plant.sentinel.table.shown(now).get(DNI_READING, np.nan)
        dni = float(measured) if np.isfinite(measured) else _LIGHT.dni
        return Scene(plant.sun_vector(), max(dni, 0.0), mirrors, self._surfaces, dark=dark)


def _from_outside(view: FluxView, receiver: Receiver) -> FluxView:
    """Return a map whose columns run to the right as seen from outside: `Receiver.point`.

    The engine's run clockwise, a full cylinder's from the north.
    """
    if receiver.kind == "planar":
        return view
    radius, right = receiver.radius or 0.5 * receiver.width, -view.right
    if receiver.kind == "external_cylinder":
        east, north = receiver.normal[:2]
        front = float(np.arctan2(east, north)) if np.hypot(east, north) > 1e-6 else 0.0
        turns = (right / radius + front + np.pi) / (2.0 * np.pi)
        right = radius * (2.0 * np.pi * (turns - np.floor(turns)) - np.pi)
    order = np.argsort(right)
    return replace(view, right=right[order], flux=view.flux[:, order])
