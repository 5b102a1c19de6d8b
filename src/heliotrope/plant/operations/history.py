"""Plant-wide time series: sampled every minute, kept in the store.

Shift reports and trends are built from them. The name of a series consists of its kind, a full
stop, and its subject: ``power.RECEIVER`` (W), ``state.TRACKING`` and ``state.stale`` (number of
heliostats), ``reading.dni`` (in the unit of the safety table).
"""

from collections.abc import Awaitable, Callable, Mapping

import numpy as np

from heliotrope.links.clock import sleep_until
from heliotrope.plant.controller import PlantController
from heliotrope.plant.field.state import OUT_OF_ORDER
from heliotrope.plant.operations.views import STALE_STATE, FieldFrame, Summary, SunView
from heliotrope.store.records import PlantFigures, Records, StoreError

#: Time between two records of figures, s.
EVERY = 60.0
#: Number of significant digits with which a figure is stored.
_DIGITS = 5
#: Unit of each kind of figure; readings have the units of the safety table.
UNITS = {
    "power": "W",
    "state": "",
    "available": "",
    "faulty": "",
    "unheard": "",
    "out_of_service": "",
    "calibrated": "",
    "error_median": "rad",
    "error_p90": "rad",
    "open_alarms": "",
    "sun_elevation": "rad",
    "reading": "",
}


def figures(
    frame: FieldFrame, summary: Summary, light: SunView, power: Mapping[str, float]
) -> dict[str, float]:
    """Return the figures of a plant at one moment.

    Parameters
    ----------
    frame, summary, light
        The field, the plant, and the sun.
    power
        Predicted power into each receiver, W.
    """
    stale = frame.state == STALE_STATE
    faulty = ~stale & np.isin(frame.state, OUT_OF_ORDER)
    known = frame.error[np.isfinite(frame.error)]
    found = {
        "available": float((~stale & ~faulty & ~frame.held).sum()),
        "faulty": float((faulty & ~frame.held).sum()),
        "unheard": float((stale & ~frame.held).sum()),
        "out_of_service": float(frame.held.sum()),
        "calibrated": float(len(known)),
        "error_median": float(np.median(known)) if len(known) else np.nan,
        "error_p90": float(np.percentile(known, 90)) if len(known) else np.nan,
        "open_alarms": float(summary.alarms),
        "sun_elevation": light.elevation,
    }
    found |= {f"power.{name}": value for name, value in power.items()}
    found |= {f"state.{name}": float(count) for name, count in summary.states.items()}
    found |= {f"reading.{name}": float(value) for name, value in summary.readings.items()}
    return {name: float(f"{value:.{_DIGITS}g}") for name, value in found.items()}


class History:
    """Records the figures of a plant every minute.

    Parameters
    ----------
    plant
        The controller.
    records
        The store; None: nothing is kept.
    now
        Returns the figures; see `figures`.
    """

    def __init__(
        self,
        plant: PlantController,
        records: Records | None,
        now: Callable[[], Awaitable[Mapping[str, float]]],
    ) -> None:
        self._plant, self._records, self._now = plant, records, now

    async def run(self) -> None:
        """Record figures until cancelled."""
        while self._records is not None:
            await self.take(self._records)
            await sleep_until(self._plant.clock, self._plant.now() + EVERY)

    async def take(self, records: Records) -> None:
        """Store one record; if that fails, the minute is missing and an alarm is raised."""
        try:
            records.record(PlantFigures(self._plant.clock.utc().timestamp(), await self._now()))
        except StoreError:
            return
