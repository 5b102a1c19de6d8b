"""Site limits: the limits of the safety table that a plant may set for itself.

A plant file sets limits by condition, with the unit in each key; a cluster file may do so for the
rows that the cluster evaluates. An example is ``[safety.wind_gust_stow] trips_m_s = 18``. `limited`
checks them and returns the table with these limits. A limit is rejected if it would weaken an
invariant, such as how soon a fault is detected or how soon a beam is off the receiver. Limits of
rows that depend on leases or on operator orders are also rejected (`Condition.site` is None).
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Any

from heliotrope.errors import InputError
from heliotrope.safety.condition import Act, Condition

#: Limits, keyed by condition and then by key, as in a file.
Limits = Mapping[str, Mapping[str, float]]
#: For each unit of a reading: the suffixes of the keys of `trips` and `releases`, and the size of
#: their units in that unit.
_UNITS: dict[str, dict[str, float]] = {
    "s": {"_s": 1.0},
    "m/s": {"_m_s": 1.0},
    "rad": {"_deg": math.pi / 180.0, "_mrad": 1e-3},
    "share": {"_percent": 0.01},
    "count": {"": 1.0},
    "°C": {"_c": 1.0},
    "yes/no": {},
}
#: Safest value of a reading whose low values are unsafe.
_SAFEST = {"share": 1.0, "rad": math.pi / 4.0, "°C": 40.0}
#: Angles below this value, in rad, are shown in mrad.
_SMALL = 0.05
#: Smallest and largest value of a time key, s. A ``then_stow`` longer than that of the row is also
#: rejected.
_TIMES = {
    "delay": (0.0, 60.0),
    "clear_for": (2.0, 86400.0),
    "stale_after": (1.0, 60.0),
    "then_stow": (0.0, 120.0),
}
#: Longest permitted time from a fault until a row with this action trips, s. This leaves 20 s of
#: the 30 s of a DEFOCUS for the motion, and 270 s of the 300 s of a STOW.
NOTICED = {Act.DEFOCUS: 10.0, Act.STOW: 30.0}


@dataclass(frozen=True)
class Setting:
    """A limit of a row that a plant may set.

    Attributes
    ----------
    key, number
        Key in a file, with its unit, and the corresponding field of `Condition`.
    size
        Size of the unit used in the file, in the unit of the field.
    low, high
        Permitted range, in the unit used in the file.
    main
        Whether this is the main key of the limit; False for a key with a second unit.
    """

    key: str
    number: str
    size: float
    low: float
    high: float
    main: bool = True

    def shown(self, row: Condition) -> float:
        """Return the row's limit in the unit used in the file."""
        return float(f"{getattr(row, self.number) / self.size:.9g}")


def settings_of(row: Condition) -> dict[str, Setting]:
    """Return the limits of a row that a plant may set, by key; empty if none may be set."""
    if row.site is None:
        return {}
    settings: list[Setting] = []
    for end, size in _UNITS[row.unit].items():
        # Small angles are easiest to read in mrad, elevations in degrees.
        main = row.unit != "rad" or (row.site[1] < _SMALL) == (end == "_mrad")
        low, high = (float(f"{value / size:.4g}") for value in row.site)
        # The release limit is on the safe side of the trip limit.
        free = (0.0, high) if row.above else (low, float(f"{_SAFEST[row.unit] / size:.4g}"))
        settings += [
            Setting(f"trips{end}", "trips", size, low, high, main),
            Setting(f"releases{end}", "releases", size, *free, main),
        ]
    for number, (low, high) in _TIMES.items():
        idle = row.ages if number == "stale_after" else row.act is not Act.DEFOCUS
        if number in ("stale_after", "then_stow") and idle:
            continue
        most = min(high, row.then_stow) if number == "then_stow" else high
        settings.append(Setting(f"{number}_s", number, 1.0, low, most))
    return {setting.key: setting for setting in settings}


def limited(table: Iterable[Condition], limits: Limits) -> tuple[Condition, ...]:
    """Return the table with the limits of a site.

    Raises
    ------
    InputError
        If a row or key is unknown, a limit is out of its range or may not be set by a file, or rows
        contradict themselves or each other; the message begins with the row and the key.
    """
    rows = {row.name: row for row in table}
    for name, row_limits in limits.items():
        rows[name] = _changed(_known(rows, name), row_limits)
    for row in rows.values():
        if row.name in limits:
            _ordered(row, rows.values())
    return tuple(rows.values())


def numbers(table: Iterable[Condition]) -> dict[str, float]:
    """Return all limits that plants may set, by condition and key ("wind_gust_stow.trips_m_s")."""
    return {
        f"{row.name}.{setting.key}": setting.shown(row)
        for row in table
        for setting in settings_of(row).values()
        if setting.main
    }


def differences(before: Mapping[str, float], after: Mapping[str, float]) -> list[str]:
    """Return the differences between two results of `numbers`, one line each, old before new."""
    return [
        f"{key}: {before[key]:g} → {value:g}"
        for key, value in after.items()
        if key in before and before[key] != value
    ]


def schema(table: Iterable[Condition]) -> dict[str, Any]:
    """Return the JSON schema of the limits of a site."""
    tables = {}
    for row in table:
        keys = {key: _schema_of(row, setting) for key, setting in settings_of(row).items()}
        if keys:
            tables[row.name] = {
                "type": "object",
                "description": f"{row.what}: {row.consequence}",
                "additionalProperties": False,
                "properties": keys,
            }
    return {"type": "object", "additionalProperties": False, "properties": tables}


def _schema_of(row: Condition, setting: Setting) -> dict[str, Any]:
    known = {"default": setting.shown(row), "minimum": setting.low, "maximum": setting.high}
    return {"type": "number", **{k: value for k, value in known.items() if math.isfinite(value)}}


def _known(rows: Mapping[str, Condition], name: str) -> Condition:
    row = rows.get(name)
    if row is None:
        raise InputError(f"{name}: no such condition is in this table{_near(name, rows)}")
    if row.site is None:
        raise InputError(
            f"{name}: its limits cannot be set in a plant file, because leases or users' orders "
            f"depend on them; remove it"
        )
    return row


def _near(name: str, known: Iterable[str]) -> str:
    close = get_close_matches(name, list(known), n=1)
    return f"; did you mean {close[0]}?" if close else ""


def _changed(row: Condition, row_limits: Mapping[str, float]) -> Condition:
    """Return a row with its limits replaced by those of a file."""
    settings, changes = settings_of(row), dict[str, float]()
    for key, value in row_limits.items():
        setting = settings.get(key)
        if setting is None:
            known = f"; it takes {', '.join(settings)}"
            raise InputError(f"{row.name}.{key} is not known{_near(key, settings) or known}")
        if not setting.low <= value <= setting.high or math.isinf(value):
            raise InputError(
                f"{row.name}.{key} must be between {setting.low:g} and {setting.high:g}, not "
                f"{value:g}"
            )
        if setting.number in changes:
            raise InputError(f"{row.name}.{key}: {setting.number} is specified twice")
        changes[setting.number] = value * setting.size
    trips, releases = changes.get("trips", row.trips), changes.get("releases", row.releases)
    if not (releases < trips if row.above else releases > trips):
        side = "below" if row.above else "above"
        raise InputError(
            f"{row.name}: the release at {row.shown(releases)} must be {side} the trip at "
            f"{row.shown(trips)}; set trips and releases together"
        )
    try:
        # dataclasses.replace takes fields of several types; these are all floats.
        changed = replace(row, **changes)  # type: ignore[arg-type]
    except InputError as error:
        raise InputError(str(error).removeprefix("condition ")) from None
    latest = NOTICED.get(row.act, row.budget)
    if changed.detection > latest:
        raise InputError(
            f"{row.name}: the condition would be noticed after {changed.detection:g} s, and "
            f"{row.act.name} needs {latest:g} s at most; shorten delay_s or stale_after_s"
        )
    return changed


def _ordered(row: Condition, rows: Iterable[Condition]) -> None:
    """Reject a weaker action that would trip after a stronger action for the same reading."""
    for other in rows:
        if other.reading != row.reading or other.act == row.act:
            continue
        weak, strong = (row, other) if row.act < other.act else (other, row)
        late = weak.trips > strong.trips if row.above else weak.trips < strong.trips
        if late:
            raise InputError(
                f"{row.name}: {weak.act.name} at {weak.shown(weak.trips)} would come after "
                f"{strong.act.name} at {strong.shown(strong.trips)} ({weak.name}, {strong.name}); "
                "set both"
            )
