"""Tracks a heliostat, or a plant, through one day."""

from dataclasses import dataclass
from datetime import date, timedelta
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from heliotrope import sun as solar
from heliotrope.errors import InputError
from heliotrope.field.heliostat import Heliostat
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target, point_of
from heliotrope.frames import ENU, Framed, Labelled, Variable
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.path import TrackedPath, track_path
from heliotrope.mechanism.tracking import Steered
from heliotrope.sun import Site
from heliotrope.values import Card, Value, amount

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False, repr=False)
class TrackedDay(Value, Framed):
    """The poses of a day.

    Attributes
    ----------
    names
        Names of the heliostats, (N,); () if unknown.
    time
        T times, UTC.
    sun
        Unit vectors to the apparent sun, ENU, (T, 3).
    aim
        Aims, ENU, m, (3,) or (N, 3).
    path
        The poses, (T,) for one heliostat or (T, N) for a plant.
    """

    names: tuple[str, ...]
    time: "pd.DatetimeIndex"
    sun: FloatArray
    aim: FloatArray
    path: TrackedPath

    def _card(self) -> Card:
        who = self.names[0] if len(self.names) == 1 else amount(len(self.names), "heliostat")
        inner = self.path._card()  # noqa: SLF001 - the same record without names
        line = f"{who}, {self.time[0]:%Y-%m-%d %H:%M} to {self.time[-1]:%H:%M} UTC: {inner.line}"
        return Card(line, inner.header, inner.rows)

    def _labelled(self) -> Labelled:
        path, many = self.path, self.path.status.ndim > 1
        row = ("time", "heliostat") if many else ("time",)
        axes = path.angles.shape[-1]
        labels: dict[str, npt.ArrayLike] = {
            "time": self.time.tz_localize(None).to_numpy(),
            "joint": np.arange(1, axes + 1),
            "axis": ENU,
        }
        if many:
            labels["heliostat"] = self.names or np.arange(path.status.shape[1])
        return Labelled(
            row,
            labels,
            {**path.variables(row), "sun": Variable(("time", "axis"), self.sun)},
            notes={} if many else {"heliostat": "".join(self.names)},
        )

    def __len__(self) -> int:
        return len(self.time)


def track_day(
    heliostat: Steered,
    day: date | str,
    aim: str | Target | Receiver | npt.ArrayLike | None = None,
    *,
    site: Site | None = None,
    every: timedelta = timedelta(minutes=10),
    min_elevation: float = 0.0,
    over_the_top: bool = False,
) -> TrackedDay:
    """Return the poses that track the sun through a day, as one path (see `track_path`).

    Parameters
    ----------
    heliostat
        ``plant[name]``, a plant, or mechanisms, batch shape () or (N,).
    day
        Date of local mean solar time.
    aim
        Name of a target of the plant, a target or receiver, or points (m), (3,) or (N, 3). By
        default the heliostat's own aim, or the first target of the plant.
    site
        Site, if only mechanisms are passed.
    every, min_elevation
        Time step, and lowest apparent elevation of the sun, rad; see `heliotrope.sun.daylight`.
    over_the_top
        Whether a heliostat may go over the top wherever this avoids slews or saves motion.

    Raises
    ------
    InputError
        If there is no site or no aim, or the sun does not rise that day.
    UnknownNameError
        If the target does not exist.
    """
    known = isinstance(heliostat, Heliostat | Plant)
    place = site or (heliostat.site if isinstance(heliostat, Heliostat | Plant) else None)
    if place is None:
        raise InputError(
            "track_day: mechanisms alone have no location; pass plant[name], or "
            "site=Site(latitude, longitude, height)"
        )
    times = solar.daylight(day, place, every=every, min_elevation=min_elevation)
    if not len(times):
        raise InputError(f"{place.label}: the sun does not rise on {day}; choose another day")
    light = solar.vector(times, place)
    goal = _aim(heliostat, aim)
    path = track_path(heliostat, light, goal, over_the_top=over_the_top)
    names: tuple[str, ...] = ()
    if known:
        names = (heliostat.name,) if isinstance(heliostat, Heliostat) else heliostat.names  # type: ignore[attr-defined]
    return TrackedDay(names, times, light, goal, path)


def _aim(heliostat: Steered, aim: str | Target | Receiver | npt.ArrayLike | None) -> FloatArray:
    targets = heliostat.targets if isinstance(heliostat, Heliostat | Plant) else ()
    if aim is not None:
        return point_of(aim, targets)
    if not targets and not isinstance(heliostat, Heliostat):
        raise InputError("aim: the plant has no target; pass a point (east, north, up) in m")
    first = targets[0].center if targets else None
    own = _own_aims(heliostat)
    if first is None and not all(point is not None for point in own):
        raise InputError("aim: the plant has no target; pass a point (east, north, up) in m")
    if all(point is None for point in own):
        return np.asarray(first)
    aims = np.array([first if point is None else point for point in own])
    return aims[0] if isinstance(heliostat, Heliostat) else aims


def _own_aims(heliostat: Steered) -> list[FloatArray | None]:
    if isinstance(heliostat, Heliostat):
        return [heliostat.aim]
    if isinstance(heliostat, Plant):
        return [g.own_aim(row) for g in heliostat.groups.values() for row in range(len(g))]
    return [None]
