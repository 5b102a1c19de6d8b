"""The shift report: production, unavailable heliostats and operators' work in a period."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray
from heliotrope.plant.operations.history import EVERY
from heliotrope.store.records import (
    NOTE,
    AlarmEntry,
    JournalEntry,
    JournalQuery,
    Lockout,
    PlantFigures,
    Records,
    VisitEntry,
)

#: Longest time span of a report, and the default if no start is specified, s.
LONGEST, SHIFT = 31 * 86_400.0, 8 * 3600.0
#: Maximum number of rows in each list of a report, and of points of a curve.
MOST, POINTS = 500, 400
#: A record of figures is valid until the next one, at most for this time, s.
_STANDS = 1.5 * EVERY
#: Why heliostats are not available, by the name of the figure that counts them.
LACKS = {
    "faulty": "fault or no parameters",
    "unheard": "not heard",
    "out_of_service": "out of service",
}


@dataclass(frozen=True)
class Production:
    """Predicted production of a receiver: energy (J), peak power (W) and its time (POSIX s)."""

    receiver: str
    energy: float
    peak: float
    peak_at: float


@dataclass(frozen=True)
class FieldErrors:
    """Number of calibrated heliostats; median and 90th percentile of predicted errors, rad."""

    at: float
    calibrated: int
    median: float
    percentile_90: float


@dataclass(frozen=True)
class ShiftReport:
    """The report for a time span.

    Attributes
    ----------
    plant, since, until, made
        Name of the plant, the time span, and when this report was made, POSIX s.
    recorded
        Part of the time span for which figures are stored, s.
    production
        Predicted energy into each receiver.
    sunshine
        Direct sunlight, J/m²; NaN without a sensor.
    daylight
        Time for which the sun is above the horizon, s.
    availability
        Fraction of the heliostats that were available during daylight; NaN without daylight.
    lacks
        Unavailable time in daylight, summed over heliostats, s, by reason.
    errors
        Predicted errors of the field at the start and the end; () if none are stored.
    outcomes
        Number of visits by outcome.
    failed
        Visits without a new calibration, the latest first.
    alarms
        Alarms active within the time span, the latest first.
    locks
        Locks in force now.
    work, notes
        Orders and notes of operators, oldest first.
    power
        Curve of the total power into all receivers: POSIX s and W.
    """

    plant: str
    since: float
    until: float
    made: float
    recorded: float
    production: tuple[Production, ...]
    sunshine: float
    daylight: float
    availability: float
    lacks: Mapping[str, float]
    errors: tuple[FieldErrors, ...]
    outcomes: Mapping[str, int]
    failed: tuple[VisitEntry, ...]
    alarms: tuple[AlarmEntry, ...]
    locks: tuple[Lockout, ...]
    work: tuple[JournalEntry, ...]
    notes: tuple[JournalEntry, ...]
    power: tuple[tuple[float, float], ...]


def period(since: float, until: float, now: float) -> tuple[float, float]:
    """Return the time span of a report, POSIX s.

    An end of 0 means now, and a start of 0 means one shift before the end.

    Raises
    ------
    InputError
        If the time span ends before it begins, or is longer than a month.
    """
    until = min(until or now, now)
    since = since or until - SHIFT
    if not 0.0 < until - since <= LONGEST:
        raise InputError(
            f"report: it covers {(until - since) / 3600.0:.1f} h; the start must be before the end "
            f"and before now, and the report can cover at most {LONGEST / 86_400.0:.0f} days"
        )
    return since, until


def report(
    plant: str, records: Records, since: float, until: float, now: float, automatic: str
) -> ShiftReport:
    """Return the report for a time span; see `period`.

    Parameters
    ----------
    plant, records
        Name of the plant, and its store.
    since, until, now
        POSIX s.
    automatic
        Name of automatic control, whose orders are not listed as work of operators.
    """
    rows = records.figures(since, until)
    lasted = _lasted(rows, until)
    day = lasted * (_of(rows, "sun_elevation") > 0.0)
    visits = records.visits(100_000, since=since, until=until)
    entries = records.journal(JournalQuery(since, until, "event", text="command", limit=20_000))
    work = [e for e in entries if e.what == "command" and not e.text.startswith(f"{automatic}:")]
    power = _power(rows)
    return ShiftReport(
        plant,
        since,
        until,
        now,
        float(lasted.sum()),
        tuple(_production(rows, lasted, name) for name in _receivers(rows)),
        _integral(_of(rows, "reading.dni"), lasted),
        float(day.sum()),
        _availability(rows, day),
        {why: _integral(_of(rows, name), day) for name, why in LACKS.items()},
        _errors(rows),
        Counter(visit.outcome.name.lower() for visit in visits),
        tuple(visit for visit in visits if not visit.good)[:MOST],
        tuple(records.alarms(MOST, since=since, until=until)),
        records.holds(),
        tuple(work[:MOST][::-1]),
        tuple(records.journal(JournalQuery(since, until, NOTE, limit=MOST))[::-1]),
        tuple(zip((row.at for row in rows), power.tolist(), strict=True))[
            :: 1 + len(rows) // POINTS
        ],
    )


def _lasted(rows: Sequence[PlantFigures], until: float) -> FloatArray:
    """Return how long each record of figures is valid, s, (R,)."""
    times = [*(row.at for row in rows), until]
    return np.array([min(b - a, _STANDS) for a, b in pairwise(times)])


def _of(rows: Sequence[PlantFigures], name: str) -> FloatArray:
    """Return one figure from each record, (R,); NaN where the figure is unknown."""
    return np.array([row.values.get(name, np.nan) for row in rows])


def _integral(values: FloatArray, lasted: FloatArray) -> float:
    """Return the integral of a figure over the time in which it is known; NaN if it is unknown."""
    known = np.isfinite(values)
    return float((values[known] * lasted[known]).sum()) if known.any() else float("nan")


def _receivers(rows: Sequence[PlantFigures]) -> list[str]:
    names = (name for row in rows[-1:] for name in row.values if name.startswith("power."))
    return [name.partition(".")[2] for name in names]


def _power(rows: Sequence[PlantFigures]) -> FloatArray:
    parts = [_of(rows, f"power.{name}") for name in _receivers(rows)]
    return np.nansum(parts, axis=0) if parts else np.zeros(len(rows))


def _production(rows: Sequence[PlantFigures], lasted: FloatArray, receiver: str) -> Production:
    power = np.nan_to_num(_of(rows, f"power.{receiver}"))
    top = int(power.argmax())
    return Production(receiver, float((power * lasted).sum()), float(power[top]), rows[top].at)


def _availability(rows: Sequence[PlantFigures], day: FloatArray) -> float:
    """Return the fraction of heliostats that were available during daylight."""
    able = _of(rows, "available")
    count = able + sum(_of(rows, name) for name in LACKS)
    whole = _integral(count, day)
    return _integral(able, day) / whole if whole > 0.0 else float("nan")


def _errors(rows: Sequence[PlantFigures]) -> tuple[FieldErrors, ...]:
    return tuple(
        FieldErrors(
            row.at,
            int(row.values.get("calibrated", 0.0)),
            row.values.get("error_median", np.nan),
            row.values.get("error_p90", np.nan),
        )
        for row in (*rows[:1], *rows[-1:])
    )
