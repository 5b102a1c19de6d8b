"""Quantities over time: time series of the plant, and stored data of one heliostat."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.geometry import FloatArray
from heliotrope.plant.operations.history import UNITS
from heliotrope.store.records import Records, VisitEntry

#: Longest time span of a trend, s.
LONGEST = 400 * 86_400.0
#: Units of the quantities in the telemetry archive of each heliostat.
TELEMETRY = {"primary": "steps", "secondary": "steps", "age": "s", "fault": ""}
#: Quantities of a heliostat that each calibration visit records.
VISITS: dict[str, Callable[[VisitEntry], float]] = {
    "error_before": lambda visit: visit.error_before,
    "error_after": lambda visit: visit.error_after,
    "sigma_after": lambda visit: visit.sigma_after,
}
#: The names listed are those of figures stored within this time, s.
_LATELY = 86_400.0


@dataclass(frozen=True)
class Quantity:
    """A quantity that has a trend: its name, its unit, and whether it exists per heliostat."""

    name: str
    unit: str
    heliostat: bool


@dataclass(frozen=True)
class Trend:
    """A quantity over time.

    Attributes
    ----------
    quantity, unit, heliostat
        Name and unit of the quantity, and the heliostat ("": the quantity belongs to the plant).
    at
        Middle of each interval with values, POSIX s, (K,).
    low, mean, high
        Minimum, mean and maximum in each interval, (K,).
    """

    quantity: str
    unit: str
    heliostat: str
    at: FloatArray
    low: FloatArray
    mean: FloatArray
    high: FloatArray


def quantities(records: Records, now: float) -> tuple[Quantity, ...]:
    """Return the quantities that have trends."""
    rows = records.figures(now - _LATELY, now + 1.0)[-1:]
    plant = [Quantity(name, unit_of(name), False) for row in rows for name in sorted(row.values)]
    own = [Quantity(name, "rad", True) for name in VISITS]
    own += [Quantity(name, unit, True) for name, unit in TELEMETRY.items()]
    return (*plant, *own)


def unit_of(name: str) -> str:
    """Return the unit of a figure of the plant."""
    return UNITS.get(name.partition(".")[0], "")


def trend(
    records: Records,
    archive: Path | None,
    quantity: str,
    heliostat: str,
    since: float,
    until: float,
    points: int,
) -> Trend:
    """Return a quantity over a time span.

    Parameters
    ----------
    records, archive
        The store, and the folder of the telemetry; None: no telemetry is archived.
    quantity, heliostat
        Name of the quantity, and the heliostat ("": the quantity belongs to the plant).
    since, until
        POSIX s.
    points
        Maximum number of points.

    Raises
    ------
    InputError
        If the time span is invalid, or telemetry is requested where none is archived.
    UnknownNameError
        If there is no such quantity.
    """
    if not 0.0 < until - since <= LONGEST:
        raise InputError(
            f"trend: it covers {(until - since) / 3600.0:.1f} h; the start must be before the end, "
            f"and the trend can cover at most {LONGEST / 86_400.0:.0f} days"
        )
    if not heliostat:
        if quantity.partition(".")[0] not in UNITS:
            raise UnknownNameError("quantity of the plant", quantity, UNITS)
        rows = records.figures(since, until)
        at = np.array([row.at for row in rows])
        values = np.array([row.values.get(quantity, np.nan) for row in rows])
        unit = unit_of(quantity)
    elif quantity in VISITS:
        visits = records.visits(100_000, heliostat, since=since, until=until)[::-1]
        at = np.array([visit.finished for visit in visits])
        values, unit = np.array([VISITS[quantity](visit) for visit in visits]), "rad"
    elif quantity in TELEMETRY:
        at, values = _archived(archive, quantity, heliostat, since, until)
        unit = TELEMETRY[quantity]
    else:
        raise UnknownNameError("quantity of a heliostat", quantity, (*VISITS, *TELEMETRY))
    return Trend(quantity, unit, heliostat, *thinned(at, values, since, until, points))


def thinned(
    at: FloatArray, values: FloatArray, since: float, until: float, points: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return times, minima, means and maxima, (K,), for the equal intervals that contain values."""
    known = np.isfinite(values)
    at, values = at[known], values[known]
    if len(at) <= points:
        return at, values, values, values
    place = np.minimum(((at - since) / (until - since) * points).astype(np.intp), points - 1)
    first = np.flatnonzero(np.diff(place, prepend=-1))
    count = np.diff(np.append(first, len(at)))
    mean_at, mean = (np.add.reduceat(each, first) / count for each in (at, values))
    return mean_at, np.minimum.reduceat(values, first), mean, np.maximum.reduceat(values, first)


def _archived(
    archive: Path | None, quantity: str, heliostat: str, since: float, until: float
) -> tuple[FloatArray, FloatArray]:
    """Return times and values of a heliostat's telemetry, oldest first."""
    if archive is None:
        raise InputError(
            f"trend {quantity}: this plant does not archive telemetry; run it with --data"
        )
    from heliotrope.store.telemetry_query import query  # DuckDB takes long to import

    times: Sequence[datetime] = [
        datetime.fromtimestamp(one, UTC).replace(tzinfo=None) for one in (since, until)
    ]
    table = query(
        archive,
        f'SELECT epoch(time), CAST("{quantity}" AS DOUBLE) FROM telemetry '  # noqa: S608 - a key of TELEMETRY
        "WHERE heliostat = ? AND time >= ? AND time < ? AND state != 'STALE' ORDER BY time",
        [heliostat, *times],
    )
    at, values = (column.to_numpy() for column in table.columns)
    return at, values
