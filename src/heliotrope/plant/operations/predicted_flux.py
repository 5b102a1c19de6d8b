"""Predicts the flux that the field brings to its receivers.

Every mirror is in the pose that its reported step counts yield under its present calibration, so
heliostats that are turned away or at stow shade and block in those poses.
`heliotrope.optics.receiver_flux` computes the flux, and its uncertainty from the covariance of each
calibration. Both are computed outside the plant's event loop
(`plant.workers`) on request.
"""

import asyncio
from dataclasses import replace

import numpy as np

from heliotrope.field.target import Receiver
from heliotrope.geometry import FloatArray, as_float
from heliotrope.lcu import states
from heliotrope.optics import (
    FieldFlux,
    FieldOptics,
    FluxView,
    Mirrors,
    Scene,
    flux_views,
    surface_of,
)
from heliotrope.optics.beam import SUN_SIGMA
from heliotrope.optics.plant_scene import shaped
from heliotrope.optics.shading import IntArray
from heliotrope.plant.controller import PlantController
from heliotrope.plant.emergency import DNI_READING
from heliotrope.plant.operations.calibration_book import CalibrationBook
from heliotrope.plant.operations.viewing import Viewer
from heliotrope.plant.operations.views import PredictedView
from heliotrope.plant.refusals import RefusedError
from heliotrope.plant.workers import Worker

#: Time for which a prediction is shown, and longest wait for the next prediction, s.
EVERY, PATIENCE = 5.0, 5.0
#: For this time after the start, s, the flux counts as unknown while more than this share of the
#: heliostats have not reported where they are.
FIRST, FEW = 60.0, 0.02
#: Largest fraction of the power that may come from beams with large errors. Above it, no
#: uncertainty is computed for the cells.
WIDE = 0.02
_LIGHT = FieldOptics()


class PredictedFlux:
    """The flux on all receivers of a plant.

    Parameters
    ----------
    plant, viewer, book
        The controller, the views of its field, and its calibrations.
    installed
        Expected error of a heliostat that was never calibrated, rad.
    worker
        Runs the computation.
    """

    def __init__(
        self,
        plant: PlantController,
        viewer: Viewer,
        book: CalibrationBook,
        installed: float,
        worker: Worker,
    ) -> None:
        self._plant, self._viewer, self._book, self._worker = plant, viewer, book, worker
        self._installed = installed
        design = plant.design
        place = {name: row for row, name in enumerate(design.names)}
        self._rows = np.array([place[name] for name in plant.field.names], dtype=np.intp)
        self._surfaces = tuple(surface_of(receiver) for receiver in design.receivers)
        self._views: dict[str, PredictedView] = {}
        self._made_at, self._begun = -np.inf, plant.now()
        self._computing: asyncio.Task[None] | None = None

    async def everywhere(self) -> dict[str, PredictedView]:
        """Return the flux on each receiver, by name.

        If the computation takes longer than `PATIENCE`, the last known flux is returned.

        Raises
        ------
        RefusedError
            If many heliostats have not reported their positions yet since the start, nothing has
            been computed yet, or the computation failed.
        """
        if missing := self._unreported():
            raise RefusedError(
                f"flux: not yet known; {missing:,} of {len(self._plant.field):,} heliostats "
                "have not reported their positions since the plant started; ask again in a few "
                "seconds"
            )
        running = self._computing
        if running is None and self._plant.now() - self._made_at >= EVERY:
            running = self._computing = asyncio.create_task(self._compute())
        if running is not None:
            await asyncio.wait((running,), timeout=PATIENCE)
            if running.done():
                self._computing = None
                if (error := running.exception()) is not None:
                    raise RefusedError(f"flux: not predicted now ({error})") from error
        if not self._views and self._surfaces:
            raise RefusedError(
                "flux: the first prediction since the plant started is still being computed "
                "(about a minute after an installation, otherwise seconds); ask again shortly"
            )
        return self._views

    def _unreported(self) -> int:
        """Return the number of heliostats that have not reported since the start; 0 if few.

        A heliostat that tracks must also have reported its step counts.
        """
        field, now = self._plant.field, self._plant.now()
        if now - self._begun > FIRST:
            return 0
        uncounted = field.among(states.ON_AIM, now) & ~np.isfinite(field.counted_at)
        missing = int((uncounted | ~np.isfinite(field.heard)).sum())
        return missing if missing > FEW * len(field) else 0

    async def aclose(self) -> None:
        """Cancel a running computation."""
        if self._computing is not None:
            self._computing.cancel()
            await asyncio.gather(self._computing, return_exceptions=True)

    async def _compute(self) -> None:
        now, receivers = self._plant.now(), self._plant.design.receivers
        if not receivers:
            return
        on = self._viewer.frame().on
        views = await self._worker(predicted, self.scene(now), _LIGHT)
        for k, (receiver, view) in enumerate(zip(receivers, views, strict=True), 1):
            shown = replace(view, heliostats=int((on == k).sum()))
            self._views[receiver.name] = _from_outside(shown, receiver)
        self._made_at = now

    def scene(self, now: float) -> Scene:
        """Return the field as it stands.

        Heliostats aimed at a receiver bring light; all other heliostats only shade and block.

        The measured irradiance is used if there is a sensor.
        """
        plant, frame, beams = self._plant, self._viewer.frame(), self._plant.beams
        normal, center = beams.armature.pose(beams.drives.angles(plant.field.posed))
        middle = self._surfaces[0].center
        aims = np.where(np.isfinite(plant.aims).all(axis=-1, keepdims=True), plant.aims, middle)
        # The variance is divided between two axes of the normal, and the beam rotates by twice the
        # angle.
        unknown = 2.0 * self._installed**2 * np.eye(2)
        known = np.isfinite(self._book.spread).all(axis=(1, 2), keepdims=True)
        spread = np.where(known, self._book.spread, unknown)
        size = self._viewer.sizes
        mirrors = Mirrors.of(
            center, normal, (size[:, 0], size[:, 1]), aims, pointing=spread,
        )  # fmt: skip
        mirrors = shaped(mirrors, plant.design, self._rows)
        dark = ~(plant.field.sure(now) & (frame.on >= 1) & (frame.on <= len(self._surfaces)))
        measured = plant.sentinel.table.shown(now).get(DNI_READING, np.nan)
        dni = float(measured) if np.isfinite(measured) else _LIGHT.dni
        towers = plant.design.towers
        return Scene(plant.sun_vector(), max(dni, 0.0), mirrors, self._surfaces, towers, dark)


def predicted(scene: Scene, light: FieldOptics) -> list[PredictedView]:
    """Return the expected flux on the surfaces of a scene, with its uncertainty.

    The mirrors' ``pointing`` is the covariance of their errors, which are taken to be independent.
    Cells have no uncertainty (NaN) where much of the light comes from heliostats whose errors are
    larger than their images, such as uncalibrated heliostats.
    """
    engine = light.engine(scene)
    views = flux_views(engine)
    return [_uncertain(view, engine.on(k)) for k, view in enumerate(views)]


def _uncertain(view: FluxView, engine: FieldFlux) -> PredictedView:
    flux, mirrors = view.flux, engine.scene.mirrors
    sigma, count, pointing = np.full(flux.shape, np.nan), len(mirrors), mirrors.pointing
    # A beam whose error is larger than its image remains just as sharp: its power is either on the
    # surface or off it, and the derivatives of a blurred image do not describe any cell.
    image = SUN_SIGMA**2 + 4.0 * mirrors.slope**2
    wide = 0.5 * np.trace(pointing, axis1=1, axis2=2) > image
    if engine.power[wide].sum() <= WIDE * engine.power.sum():
        alone, together = np.zeros((count, 0, 2)), np.zeros(count, dtype=np.int64)
        no_weight = np.zeros(engine.maps[0].shape)
        variance, _, _ = engine.spread(pointing, alone, together, no_weight)
        sigma = np.sqrt(variance).reshape(flux.shape)
    slope = engine.power_slope()
    known = np.einsum("hi,hij,hj->h", slope, pointing, slope)
    either = engine.power * (engine.leaving - engine.power)
    power_sigma = float(np.sqrt(np.where(wide, either, known).sum()))
    hottest = np.unravel_index(flux.argmax(), flux.shape)
    return PredictedView(
        **vars(view),
        sigma=sigma,
        power_sigma=power_sigma,
        peak=float(flux[hottest]),
        peak_sigma=float(sigma[hottest]),
    )


def _from_outside(view: PredictedView, receiver: Receiver) -> PredictedView:
    """Return a map whose columns run to the right as seen from outside; see `Receiver.point`."""
    right, order = columns_from_outside(receiver, view.right)
    shown = {name: getattr(view, name)[:, order] for name in ("flux", "sigma")}
    return replace(view, right=right, **shown)


def columns_from_outside(receiver: Receiver, right: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the positions of a map's columns as seen from outside, m, and their order, each (W,).

    The engine's columns, ``right``, run clockwise; on a full cylinder they start in the north.
    """
    if receiver.kind not in ("external_cylinder", "convex_cylinder"):
        return right, np.arange(len(right))
    radius, right = receiver.radius or 0.5 * receiver.width, -right
    if receiver.kind == "external_cylinder":
        east, north = receiver.normal[:2]
        front = float(np.arctan2(east, north)) if np.hypot(east, north) > 1e-6 else 0.0
        turns = (right / radius + front + np.pi) / (2.0 * np.pi)
        right = radius * (2.0 * np.pi * (turns - np.floor(turns)) - np.pi)
    order = np.argsort(right)
    return as_float(right[order]), order
