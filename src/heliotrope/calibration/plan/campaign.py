"""Plan a campaign: which heliostat is measured on which target at what time.

A target takes one beam at a time. Its time is divided into slots of equal length (settle, expose,
clear). There are two ways to plan. Either each day is planned as a whole, so that every heliostat
is measured in its most informative hours as far as capacity allows. Or each slot is assigned to the
heliostat whose sighting at that time reduces the field's expected squared beam error most.
Heliostats slew while other heliostats are measured; each comes from its aim point and returns to
it.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from heapq import heapify, heappop, heappush
from itertools import groupby
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope import sun as solar
from heliotrope.calibration.plan import _allocation
from heliotrope.calibration.plan import gain as _gain
from heliotrope.calibration.plan.fleets import Fleet
from heliotrope.calibration.plan.planning import SightingLimits
from heliotrope.calibration.plan.scaled_field import ScaledField, TargetView
from heliotrope.errors import InputError
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, as_float
from heliotrope.sun import Site

#: Maximum memory for the derivatives of a day that is planned as a whole, bytes.
MEMORY = 1e9


@dataclass(frozen=True)
class Timing:
    """Durations for one beam on a target, s.

    Attributes
    ----------
    settle
        Time from the arrival of the beam until it is steady.
    exposure
        Exposure of the camera.
    clear
        Time from the exposure until the beam has left the target and the next beam may arrive.
    """

    settle: float = 5.0
    exposure: float = 2.0
    clear: float = 5.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"{field.name} must be 0 or more, not {value} s")
        if self.slot < 0.1:
            raise InputError(f"a slot of {self.slot:g} s: settle, exposure and clear are too short")

    @property
    def slot(self) -> float:
        """Time for which one beam occupies the target, s."""
        return self.settle + self.exposure + self.clear


@dataclass(frozen=True)
class CalibrationCampaign:
    """M planned sightings in order of time, with the expected beam errors.

    Heliostats are numbered consecutively over all fleets. Times are Unix seconds (UTC).

    Attributes
    ----------
    leave, arrive, time, done, back
        Times at which the beam leaves its aim, arrives on the target, is exposed (middle of the
        exposure), has left the target, and is back at its aim, (M,).
    heliostat, target
        Indices, (M,).
    counts
        Drive counts at ``time``, (M, D).
    heliostat_error, error
        Expected RMS beam error after each sighting, of its heliostat and of the field, rad, (M,).
    before
        Expected RMS beam error of the field before the campaign, rad.
    expected
        Expected RMS beam error of each heliostat after the campaign, rad, (N,); 0 for heliostats
        that do not count.
    slots
        Number of slots on all targets together.
    """

    leave: FloatArray
    arrive: FloatArray
    time: FloatArray
    done: FloatArray
    back: FloatArray
    heliostat: npt.NDArray[np.intp]
    target: npt.NDArray[np.intp]
    counts: FloatArray
    heliostat_error: FloatArray
    error: FloatArray
    before: float
    expected: FloatArray
    slots: int

    def __len__(self) -> int:
        return len(self.time)

    @property
    def after(self) -> float:
        """Expected RMS beam error of the field after the campaign, rad."""
        return float(self.error[-1]) if len(self) else self.before


def plan_campaign(
    fleets: Sequence[Fleet],
    site: Site,
    targets: Sequence[Target],
    start: float,
    stop: float,
    *,
    timing: Timing | None = None,
    limits: SightingLimits | None = None,
    every: float = 1800.0,
    ahead: bool = True,
    worth: float = 0.05,
    count: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> CalibrationCampaign:
    """Return the measurements to make in a field from ``start`` to ``stop``.

    Parameters
    ----------
    fleets
        The heliostats, one fleet per kind.
    site
        Location and atmosphere.
    targets
        Targets with cameras.
    start, stop
        Unix seconds (UTC).
    timing, limits
        Default: `Timing()` and `SightingLimits()`.
    every
        Interval at which the gains of the whole field are computed, s; the gains of the chosen
        sightings are computed for their actual times.
    ahead
        Whether to plan each day as a whole, so that the error is smallest at the end of the day.
        Otherwise the day is planned slot by slot, so that the error falls fastest.
    worth
        Minimum fraction by which a measurement must reduce the heliostat's own expected squared
        error; a slot in which no measurement does so stays empty.
    count
        Maximum number of measurements; default: no limit.
    progress
        Called after each interval with the numbers of slots, (done, total).

    Returns
    -------
    The schedule, in which no two beams share a target, no heliostat is in two places at once, each
    heliostat leaves its aim in time, and stops and limits are respected. The return slew is assumed
    to take as long as the outward slew.

    Raises
    ------
    InputError
        If there are no heliostats or targets, or the sun is not up in the time span.
    """
    if not fleets or not sum(len(f) for f in fleets) or not targets:
        raise InputError("campaign: specify heliostats and at least one target")
    if count is not None and count < 1:
        raise InputError(f"count must be 1 measurement or more, not {count}")
    if not 0.0 <= worth < 1.0:
        raise InputError(f"worth must be 0 or more and below 1, not {worth:g}")
    if not (np.isfinite([start, stop, every]).all() and every > 0.0):
        raise InputError(
            f"campaign: {start} to {stop} s every {every} s; all must be finite numbers"
        )
    drives = {len(f.mechanism.driven) for f in fleets}
    if len(drives) != 1:
        raise InputError(
            "campaign: mechanisms with different numbers of drives; plan each group separately"
        )
    schedule = _Schedule(
        tuple(fleets),
        site,
        tuple(targets),
        timing or Timing(),
        limits or SightingLimits(),
        ahead,
        worth,
        count,
    )
    cells, slots = _cells(schedule, start, stop, every)
    done = 0
    for begin, day in groupby(cells, key=lambda cell: cell[0]):
        for arrivals in schedule.day(begin, [cell[1] for cell in day]):
            done += len(arrivals)
            if progress:
                progress(done, slots)
        if schedule.full:
            break
    if progress:
        progress(slots, slots)
    return schedule.result(slots * len(targets), drives.pop())


def _cells(
    schedule: "_Schedule", start: float, stop: float, every: float
) -> tuple[list[tuple[float, FloatArray]], int]:
    """Return pairs (begin of daylight, arrivals of some slots), and the number of slots."""
    slot = schedule.timing.slot
    number = int(np.floor((stop - start) / slot + 1e-9))
    if not 1 <= number <= 2_000_000:
        raise InputError(
            f"campaign: {stop - start:.0f} s contain {number} slots of {slot:g} s; choose a period "
            "of 1 to 2,000,000 slots"
        )
    edges = start + slot * np.arange(number + 1)
    high = solar.position(edges, schedule.site).elevation >= schedule.limits.min_elevation
    up = high[:-1] & high[1:]
    if not up.any():
        raise InputError(
            f"campaign: the sun never reaches {np.degrees(schedule.limits.min_elevation):g}° in "
            "this period; choose other times or lower the minimum elevation"
        )
    size = max(1, round(every / slot))
    opens = np.flatnonzero(up & ~np.concatenate([[False], up[:-1]]))
    closes = np.flatnonzero(up & ~np.concatenate([up[1:], [False]])) + 1
    cells = [
        (float(edges[a]), as_float(edges[first : min(first + size, b)]))
        for a, b in zip(opens, closes, strict=True)
        for first in range(a, b, size)
    ]
    return cells, int(up.sum())


class _Schedule:
    """State of a campaign."""

    def __init__(
        self,
        fleets: tuple[Fleet, ...],
        site: Site,
        targets: tuple[Target, ...],
        timing: Timing,
        limits: SightingLimits,
        ahead: bool,
        worth: float,
        count: int | None,
    ) -> None:
        self.site, self.targets = site, targets
        self.timing, self.limits = timing, limits
        self.ahead, self.worth, self.limit = ahead, worth, count
        self.field = ScaledField(fleets, limits)
        self.covariance, self.form = self.field.covariance, self.field.form
        self.square = self.field.squares()
        self.counted, total = self.field.counted, len(self.field)
        self.before = float(np.sqrt(self.square.sum() / self.counted))
        self.version = np.zeros(total, dtype=np.int64)
        self.free = np.full(total, -np.inf)
        self.rows: list[tuple[Any, ...]] = []

    @property
    def full(self) -> bool:
        """Whether the maximum number of measurements has been reached."""
        return self.limit is not None and len(self.rows) >= self.limit

    def day(self, begin: float, cells: list[FloatArray]) -> Iterator[FloatArray]:
        """Plan the intervals of a day that starts at ``begin``; yield each when it is planned."""
        size = self.covariance[:, :2].nbytes * len(self.targets)
        look = max(1, int(MEMORY // size)) if self.ahead else 1
        for first in range(0, len(cells), look):
            some = cells[first : first + look]
            suns = [solar.vector(c + self._shift, self.site) for c in some]
            views = [[self.field.view(s[len(s) // 2], t) for t in self.targets] for s in suns]
            options = [
                self._option(v, len(c)) for c, row in zip(some, views, strict=True) for v in row
            ]
            choices: list[list[int] | None] = [None] * len(options)
            if self.ahead:
                remaining = None if self.limit is None else self.limit - len(self.rows)
                known, form = self.covariance, self.form
                first_choice = _allocation.allocate(known, form, options, self.worth, remaining)
                choices[:] = _allocation.exchanged(known, form, options, first_choice)
            for n, arrivals in enumerate(some):
                places = range(n * len(self.targets), (n + 1) * len(self.targets))
                queues = [
                    _Queue(self, views[n][o - places[0]], options[o], choices[o]) for o in places
                ]
                self._cell(begin, arrivals, suns[n], queues)
                yield arrivals

    @property
    def _shift(self) -> float:
        """Return the time from the arrival of a beam to the middle of the exposure, s."""
        return self.timing.settle + 0.5 * self.timing.exposure

    def _option(self, view: TargetView, room: int) -> _allocation.Option:
        rows = np.flatnonzero(view.able)
        # A heliostat returns to its aim before its next visit.
        again = self.timing.slot + 2.0 * view.seconds[rows]
        most = np.floor((room * self.timing.slot + 2.0 * view.seconds[rows]) / again)
        return _allocation.Option(rows, view.slope[rows], room, most.astype(np.intp))

    def _cell(
        self, begin: float, arrivals: FloatArray, suns: FloatArray, queues: "list[_Queue]"
    ) -> None:
        for arrive, sun in zip(arrivals, suns, strict=True):
            for j, queue in enumerate(queues):
                if self.full:
                    return
                self._fill(j, queue, begin, float(arrive), sun)

    def _fill(self, j: int, queue: "_Queue", begin: float, arrive: float, sun: FloatArray) -> None:
        """Assign one slot of target ``j`` to the first queued heliostat that can be in place."""
        waiting: list[tuple[float, int, int]] = []
        while queue.heap:
            entry = heappop(queue.heap)
            i = entry[2]
            if not queue.settled and entry[1] != self.version[i]:
                queue.push(i)
                continue
            ready = max(self.free[i], begin)
            if arrive - queue.view.seconds[i] < ready:
                waiting.append(entry)
                continue
            own = self.field.single(i, sun, self.targets[j])
            # The queue was computed for the middle of the interval, but the target may be out of
            # reach in this slot.
            if not own.able[0]:
                continue
            if arrive - own.seconds[0] < ready:
                waiting.append(entry)
                continue
            self._take(i, j, arrive, own)
            queue.push(i)
            break
        for entry in waiting:
            heappush(queue.heap, entry)

    def _take(self, i: int, j: int, arrive: float, own: TargetView) -> None:
        travel, done = float(own.seconds[0]), arrive + self.timing.slot
        self.covariance[i] = _gain.updated(self.covariance[i], own.slope[0])
        self.square[i] = max(0.0, float(np.sum(self.form[i] * self.covariance[i])))
        self.version[i] += 1
        self.free[i] = done + travel
        time = arrive + self._shift
        self.rows.append(
            (
                arrive - travel,
                arrive,
                time,
                done,
                done + travel,
                i,
                j,
                own.counts[0],
                float(np.sqrt(self.square[i])),
                float(np.sqrt(self.square.sum() / self.counted)),
            )
        )

    def result(self, slots: int, drives: int) -> CalibrationCampaign:
        """Return the schedule as arrays."""
        columns = list(zip(*self.rows, strict=True)) or [()] * 10

        def numbers(k: int) -> FloatArray:
            return np.array(columns[k], dtype=np.float64)

        return CalibrationCampaign(
            leave=numbers(0),
            arrive=numbers(1),
            time=numbers(2),
            done=numbers(3),
            back=numbers(4),
            heliostat=np.array(columns[5], dtype=np.intp),
            target=np.array(columns[6], dtype=np.intp),
            counts=numbers(7).reshape(-1, drives),
            heliostat_error=numbers(8),
            error=numbers(9),
            before=self.before,
            expected=np.asarray(np.sqrt(self.square)),
            slots=slots,
        )


class _Queue:
    """Heliostats for one target during an interval, the greatest gain first.

    Either the order ``wanted`` is fixed, or the queue holds all heliostats within reach with their
    gain at the middle of the interval. If a heliostat has been measured since its entry was made,
    the version of the entry shows that it is outdated. Its gain is recomputed when it reaches the
    top.
    """

    def __init__(
        self,
        schedule: _Schedule,
        view: TargetView,
        option: _allocation.Option,
        choice: list[int] | None,
    ) -> None:
        self.schedule, self.view, self.settled = schedule, view, choice is not None
        self.heap: list[tuple[float, int, int]]
        if choice is not None:
            self.heap = [(float(n), 0, i) for n, i in enumerate(choice)]
            return
        falls = _allocation.gains(schedule.covariance, schedule.form, option)
        self.heap = [
            (-float(g), int(schedule.version[i]), int(i))
            for g, i in zip(falls, option.rows, strict=True)
            if g > schedule.worth * schedule.square[i]
        ]
        heapify(self.heap)

    def push(self, i: int) -> None:
        """Enter heliostat ``i`` with its current gain."""
        schedule = self.schedule
        if self.settled:
            return
        gain = float(
            _gain.variance_gain(schedule.covariance[i], self.view.slope[i], schedule.form[i])
        )
        if gain > schedule.worth * schedule.square[i]:
            heappush(self.heap, (-gain, int(schedule.version[i]), i))
