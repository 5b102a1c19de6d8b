r"""Compares the flux measured on the receiver with the predicted flux.

A camera measures a map, a calorimeter or flux sensor a single number; both are fractions of the
receiver's nominal power. With the measured flux $M_c$ and the predicted $F_c$ in the cells that
were measured,

$$D^2 = \sum_c (M_c - F_c)^2 / \sum_c σ_c^2$$

$$σ_c^2 = s_c^2 + (a^2 + e^2) F_c^2 + (b F_\text{peak})^2 + (f F_\text{nominal})^2$$

where s_c is the standard deviation due to the calibration errors. D² has an expected value of 1 if
the standard deviations are right, for any number of cells and any correlation of their errors. This
measure is our own. `SCALE` (a) covers irradiance, reflectivity and soiling; `SHAPE` (b, for maps)
covers the mirrors' figure; `READ` and `FLOOR` (e, f) cover the measurement (from rendered frames,
see *how to use cameras*).

Where the measured flux is above the flux limit, the prediction was too low, and `beyond` says by
how much, for `Aiming`. Only a plausible measurement counts: above `TRUST` times the prediction,
either the sensor is wrong or unidentified beams are on the receiver.
"""

import math
from dataclasses import dataclass

import numpy as np

from heliotrope.field.flux_limit import FluxLimit
from heliotrope.field.target import Receiver
from heliotrope.geometry import FloatArray, as_float
from heliotrope.optics import Cylinder, surface_of
from heliotrope.plant.controller import PlantController
from heliotrope.plant.emergency import DNI_READING
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.predicted_flux import PredictedFlux, columns_from_outside
from heliotrope.plant.operations.views import PredictedView
from heliotrope.safety import FLUX_READING, alarms
from heliotrope.safety.proof import FLUX_AGE

#: Standard deviation of the whole predicted flux, as a fraction, and of a cell, as a fraction of
#: the peak.
SCALE, SHAPE = 0.10, 0.05
#: Standard deviation of a measurement: of its value, and of the nominal flux.
READ, FLOOR = 0.02, 0.005
#: Distance, in standard deviations, above which the alarm is raised, and below which it is cleared.
RAISE, CLEAR = 4.0, 3.0
#: Time for which the distance must be above or below, s, long enough for moving heliostats to
#: report.
HOLD = 120.0
#: Interval between comparisons, s.
EVERY = 10.0
#: Greatest ratio of a measured flux to the predicted one that is believed.
TRUST = 1.5


@dataclass(frozen=True, eq=False)
class Beyond:
    """A measured flux above the flux limit.

    Attributes
    ----------
    factor
        Ratio of the measured to the predicted flux in the cells where the measured flux is above
        the limit, and 1 elsewhere; in the order of the limit's cells, (rows, columns). If only the
        mean was measured, the ratio is the same in all cells.
    excess
        Greatest ratio of the measured flux to the limit, less 1.
    """

    factor: FloatArray
    excess: float


def distance(view: PredictedView, measured: FloatArray, mean: float, area: float) -> float:
    """Return how far a measured flux is from the predicted flux, in standard deviations.

    Parameters
    ----------
    view
        The prediction.
    measured
        W/m²: mean over the receiver, (), or in the cells of the prediction, NaN where it was not
        measured, (H, W).
    mean
        Mean flux on the receiver at nominal power, W/m².
    area
        Area of the receiver, m².

    Returns
    -------
    D of the module docstring; NaN if no cell was measured, or the prediction's uncertainty is
    unknown.
    """
    if measured.ndim and not np.isfinite(view.sigma).any():
        # While the positions of many beams are unknown, cells have no uncertainty, but the mean
        # flux has.
        measured = as_float(np.mean(measured))
    if measured.ndim:
        flux, own, shape = view.flux, view.sigma, SHAPE * view.peak
    else:
        flux, own, shape = as_float(view.power / area), as_float(view.power_sigma / area), 0.0
    visible = np.isfinite(measured)
    if not visible.any():
        return math.nan
    square = own**2 + (SCALE**2 + READ**2) * flux**2 + shape**2
    square = square + (FLOOR * mean) ** 2
    away = np.where(visible, measured - flux, 0.0)
    return float(np.sqrt(np.sum(away**2) / np.sum(square[visible])))


class FluxCheck:
    """Compares the flux on a plant's receiver with the prediction; alarms if they differ.

    The comparison is made if the plant has one receiver, its nominal power is known, and the
    irradiance is measured.

    Parameters
    ----------
    plant, flux, log
        The controller, the prediction, and the logbook for the alarm.

    Attributes
    ----------
    flux
        The prediction.
    """

    def __init__(self, plant: PlantController, flux: PredictedFlux, log: Logbook) -> None:
        self._plant, self.flux, self._log = plant, flux, log
        self._receiver: Receiver | None = None
        if len(plant.design.receivers) == 1 and plant.design.receivers[0].nominal_power > 0.0:
            self._receiver = plant.design.receivers[0]
            self._area = float(surface_of(self._receiver).cells.area.sum())
            self._mean = self._receiver.nominal_power / self._area
        #: The camera's last map, as fractions, and when it arrived; a plant without a camera has
        #: none.
        self._seen: tuple[FloatArray | None, float] | None = None
        self._apart_since = self._agrees_since = math.inf

    def see(self, fractions: FloatArray | None) -> None:
        """Accept a new measurement: fractions of the nominal mean flux, (H, W) or ().

        None means that the camera did not see all the light on the receiver, so there is nothing to
        compare.
        """
        self._seen = fractions, self._plant.now()

    def measured(self, name: str) -> FloatArray | None:
        """Return the measured flux on a receiver, W/m², (H, W) or (); None if there is none."""
        if self._receiver is None or self._receiver.name != name:
            return None
        now = self._plant.now()
        if self._seen is not None:
            fractions, at = self._seen
            return None if fractions is None or now - at > FLUX_AGE else self._mean * fractions
        share = self._plant.sentinel.table.shown(now).get(FLUX_READING, math.nan)
        return as_float(self._mean * share) if math.isfinite(share) else None

    def beyond(self, limit: FluxLimit, predicted: FloatArray) -> Beyond | None:
        """Return by how much the measured flux exceeds a limit without margin.

        Returns None if the flux is not above the limit.

        If only the mean is measured, the predicted map is scaled to it.

        Parameters
        ----------
        limit
            Limit of the receiver.
        predicted
            Flux of the beams at their aims in the present irradiance, W/m², in the order of the
            limit's cells, (rows, columns).
        """
        receiver = self._receiver
        if receiver is None or (measured := self.measured(receiver.name)) is None:
            return None
        surface = surface_of(receiver)
        if measured.ndim:
            mapped = np.empty(predicted.shape)
            order = np.arange(predicted.shape[1])
            if isinstance(surface, Cylinder):
                middles = 0.5 * (surface.edges[1:] + surface.edges[:-1])
                order = columns_from_outside(receiver, as_float(middles * surface.radius))[1]
            mapped[:, order] = measured
        else:
            mapped = measured / max(float(predicted.mean()), 1e-9) * predicted
        allowed = limit.on(*predicted.shape) / (1.0 - limit.margin)
        ratio = mapped / np.maximum(predicted, 1e-9)
        hot = (mapped > allowed) & (ratio > 1.0) & (ratio <= TRUST)
        if not hot.any():
            return None
        # A mean does not say which cells are too hot.
        factor = (
            np.where(hot, ratio, 1.0) if measured.ndim else np.full(hot.shape, ratio[hot].max())
        )
        return Beyond(as_float(factor), float((mapped / allowed)[hot].max()) - 1.0)

    async def look(self) -> None:
        """Compare the measured with the predicted flux, and raise or end the alarm.

        Raises
        ------
        HeliotropeError
            If the prediction cannot be computed.
        """
        receiver = self._receiver
        if receiver is None or (measured := self.measured(receiver.name)) is None:
            return
        now = self._plant.now()
        if not math.isfinite(self._plant.sentinel.table.shown(now).get(DNI_READING, math.nan)):
            return
        view = (await self.flux.everywhere())[receiver.name]
        far, stands = distance(view, measured, self._mean, self._area), self._stands
        self._apart_since = min(self._apart_since, now) if far > RAISE else math.inf
        self._agrees_since = min(self._agrees_since, now) if far < CLEAR else math.inf
        if not stands and now - self._apart_since >= HOLD:
            self._log.take_alarm(
                alarms.FLUX_DISAGREES.raised(
                    receiver=receiver.name,
                    measured=1e-3 * self._area * float(np.nanmean(measured)),
                    predicted=1e-3 * view.power,
                    far=far,
                )
            )
        elif stands and now - self._agrees_since >= HOLD:
            self._log.take_alarm(alarms.FLUX_DISAGREES.ended(receiver=receiver.name))

    @property
    def _stands(self) -> bool:
        return self._log.stands(alarms.FLUX_DISAGREES)
