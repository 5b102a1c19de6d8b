"""A campaign: which heliostat goes to which target when, for a whole field.

A target shows one beam at a time. Its time is cut into slots of equal length (settle,
expose, clear). Either a day is looked at as a whole, and every heliostat gets the hours
that tell most about it as far as there is room; or each slot is given to the heliostat
whose sighting then makes the field's expected squared beam error fall most. Mirrors
travel while others are seen; each comes from its aim and goes back to it.
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
from heliotrope.calibration.plan.planning import SightingLimits, aim_at, sighting_jacobian
from heliotrope.calibration.uncertainty import CHUNK
from heliotrope.errors import InputError
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, as_float, as_vectors
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import SLOTS
from heliotrope.mechanism.tracking import track
from heliotrope.sun import Site

#: For the derivatives of a day that is looked at as a whole, bytes.
MEMORY = 1e9


@dataclass(frozen=True)
class Timing:
    """What a beam does on a target, s.

    Attributes
    ----------
    settle
        From its arrival until it stands still.
    exposure
        Of the camera.
    clear
        Until it has left the target, and the next may arrive.
    """

    settle: float = 5.0
    exposure: float = 2.0
    clear: float = 5.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"{field.name} {value} s: give 0 s or more")
        if self.slot < 0.1:
            raise InputError(f"a slot of {self.slot:g} s: settle, exposure and clear are too short")

    @property
    def slot(self) -> float:
        """Time of a beam on the target, s."""
        return self.settle + self.exposure + self.clear


@dataclass(frozen=True)
class Fleet:
    """N heliostats of one kind that take part.

    Attributes
    ----------
    mechanism
        Best estimates, batch shape (N,).
    names
        P parameters of the model.
    information
        What is known before, (N, P, P), see
        :func:`~heliotrope.calibration.uncertainty.precision`.
    form
        What the beam's error is made of, (N, P, P), see
        :func:`~heliotrope.calibration.uncertainty.error_form`; 0 for a heliostat that
        does not count, which is then never measured.
    aim
        Where each stands between its measurements, ENU metres, (N, 3).
    sigma
        Standard deviation of the beam's direction as the camera finds it, rad.
    """

    mechanism: Mechanism
    names: tuple[str, ...]
    information: FloatArray
    form: FloatArray
    aim: FloatArray
    sigma: float = 5e-4

    def __post_init__(self) -> None:
        if len(self.mechanism.shape) != 1:
            raise InputError(f"mechanisms of shape {self.mechanism.shape}; give one axis (N,)")
        count, p = len(self.mechanism), len(self.names)
        for name in ("information", "form"):
            shape = getattr(self, name).shape
            if shape != (count, p, p):
                raise InputError(f"fleet: {name} of shape {shape}; it must be {(count, p, p)}")
        aim = np.broadcast_to(as_vectors(self.aim, "aim"), (count, 3))
        object.__setattr__(self, "aim", aim)

    def __len__(self) -> int:
        return len(self.mechanism)


@dataclass(frozen=True)
class CalibrationCampaign:
    """M sightings in order of time, and what they are expected to bring.

    Heliostats are numbered through all fleets. Times are unix seconds (UTC).

    Attributes
    ----------
    leave, arrive, time, done, back
        When the heliostat leaves its aim, is on the target, is exposed (the middle), is
        off the target, and is at its aim again, (M,).
    heliostat, target
        Rows, (M,).
    counts
        Of the drives at ``time``, (M, D).
    heliostat_error
        Expected RMS of this heliostat's beam error after it, rad, (M,).
    error
        Expected RMS of the field's after it, rad, (M,).
    before
        Expected RMS of the field's before all, rad.
    expected
        Of each heliostat after all, rad, (N,); 0 where it does not count.
    slots
        Slots there were on all targets together.
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


def campaign(
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
    """Return the measurements of a field from ``start`` to ``stop``.

    Parameters
    ----------
    fleets
        The heliostats, kind by kind.
    site
        Place and air.
    targets
        With a camera on each.
    start, stop
        Unix seconds (UTC).
    timing, limits
        By default :class:`Timing` and :class:`~heliotrope.calibration.plan.planning.Limits`.
    every
        Gains are found anew for the whole field at this interval, s; what is chosen is
        computed for its own time.
    ahead
        Look at each day as a whole, so that the error is smallest at its end; otherwise
        each slot by itself, so that the error falls fastest.
    worth
        A measurement must lower the heliostat's own expected squared error by this share;
        a slot in which none does stays empty.
    count
        At most so many measurements.
    progress
        Called with (slots done, all slots) after each interval.

    Returns
    -------
    No two beams are on one target at a time, no heliostat is in two places, each leaves
    its aim in time, and each is within its stops and the limits. It is taken to need as
    long for the way back as for the way out.

    Raises
    ------
    InputError
        If there is nothing to plan with, or the sun is not up in the span.
    """
    if not fleets or not sum(len(f) for f in fleets) or not targets:
        raise InputError("campaign: give heliostats and at least one target")
    if count is not None and count < 1:
        raise InputError(f"count {count}: give 1 or more measurements")
    if not 0.0 <= worth < 1.0:
        raise InputError(f"worth {worth:g}: give a share from 0 to below 1")
    if not (np.isfinite([start, stop, every]).all() and every > 0.0):
        raise InputError(f"campaign: {start} to {stop} s every {every} s; give finite numbers")
    drives = {len(f.mechanism.driven) for f in fleets}
    if len(drives) != 1:
        raise InputError("campaign: mechanisms with different numbers of drives; plan each alone")
    work = _Work(
        tuple(fleets),
        site,
        tuple(targets),
        timing or Timing(),
        limits or SightingLimits(),
        ahead,
        worth,
        count,
    )
    cells, slots = _cells(work, start, stop, every)
    done = 0
    for begin, day in groupby(cells, key=lambda cell: cell[0]):
        for arrivals in work.day(begin, [cell[1] for cell in day]):
            done += len(arrivals)
            if progress:
                progress(done, slots)
        if work.full:
            break
    if progress:
        progress(slots, slots)
    return work.result(slots * len(targets), drives.pop())


def _cells(
    work: "_Work", start: float, stop: float, every: float
) -> tuple[list[tuple[float, FloatArray]], int]:
    """(When the window opened, arrivals of some slots) while the sun is up; number of slots."""
    slot = work.timing.slot
    number = int(np.floor((stop - start) / slot + 1e-9))
    if not 1 <= number <= 2_000_000:
        raise InputError(
            f"campaign: {stop - start:.0f} s hold {number} slots of {slot:g} s; give 1 to 2,000,000"
        )
    edges = start + slot * np.arange(number + 1)
    high = solar.position(edges, work.site).elevation >= work.limits.min_elevation
    up = high[:-1] & high[1:]
    if not up.any():
        raise InputError(
            f"campaign: the sun is never {np.degrees(work.limits.min_elevation):g}° high in the "
            "span; choose other times or lower the least elevation"
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


@dataclass(frozen=True)
class _View:
    """One target at one instant, for some heliostats: J (n, 2, P) is scaled and padded."""

    able: npt.NDArray[np.bool_]
    slope: FloatArray
    seconds: FloatArray
    counts: FloatArray


class _Work:
    """The state of a campaign: covariances in scaled parameters, padded to the largest P."""

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
        self.fleets, self.site, self.targets = fleets, site, targets
        self.timing, self.limits = timing, limits
        self.ahead, self.worth, self.limit = ahead, worth, count
        sizes = [len(f) for f in fleets]
        self.offsets = np.concatenate([[0], np.cumsum(sizes)])
        total, most = int(self.offsets[-1]), max(len(f.names) for f in fleets)
        self.covariance = np.broadcast_to(np.eye(most), (total, most, most)).copy()
        self.form = np.zeros((total, most, most))
        self.scale = np.ones((total, most))
        for k, fleet in enumerate(fleets):
            part, p = slice(self.offsets[k], self.offsets[k + 1]), len(fleet.names)
            scale = 1.0 / np.sqrt(np.diagonal(fleet.information, axis1=1, axis2=2))
            both = scale[:, :, None] * scale[:, None]
            self.covariance[part, :p, :p] = np.linalg.inv(fleet.information * both)
            self.form[part, :p, :p] = fleet.form * both
            self.scale[part, :p] = scale
        self.square = np.einsum("npq,nqp->n", self.form, self.covariance)
        self.counted = int(self.form.any(axis=(1, 2)).sum())
        if not self.counted:
            raise InputError("campaign: no heliostat can serve its aim, so none would gain")
        self.before = float(np.sqrt(self.square.sum() / self.counted))
        self.armatures = [f.mechanism.armature.table for f in fleets]
        self.version = np.zeros(total, dtype=np.int64)
        self.free = np.full(total, -np.inf)
        self.rows: list[tuple[Any, ...]] = []

    def view(self, k: int, rows: slice, sun: FloatArray, target: Target) -> _View:
        """What ``rows`` of fleet ``k`` would show on a target under the sun."""
        fleet = self.fleets[k]
        some, armature = fleet.mechanism[rows], Armature(self.armatures[k][rows])
        home = track(armature, sun, fleet.aim[rows], drives=some.drives)
        stand = home.chosen(home.counts)
        stand = np.where(np.isfinite(stand), stand, 0.0)
        aimed = aim_at(some, sun, target, self.limits, current=stand)
        speed = some.drives.table[..., SLOTS["speed"]]
        able, p = aimed.able, len(fleet.names)
        seconds = np.full(len(able), np.inf)
        seconds[able] = (np.abs(aimed.counts - stand) / speed)[able].max(axis=-1)
        slope = np.zeros((len(able), 2, self.form.shape[-1]))
        slope[able, :, :p] = sighting_jacobian(
            some[np.flatnonzero(able)],
            aimed.counts[able],
            np.broadcast_to(sun, (int(able.sum()), 3)),
            target,
            fleet.names,
            fleet.sigma,
        )
        part = slice(self.offsets[k] + rows.start, self.offsets[k] + rows.stop)
        return _View(able, slope * self.scale[part, None], seconds, aimed.counts)

    def field_view(self, sun: FloatArray, target: Target) -> _View:
        """All heliostats, fleet after fleet."""
        parts = [
            self.view(k, slice(a, min(a + CHUNK, len(fleet))), sun, target)
            for k, fleet in enumerate(self.fleets)
            for a in range(0, len(fleet), CHUNK)
        ]
        return _View(
            *(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(_View))
        )

    @property
    def full(self) -> bool:
        """Whether all measurements that were asked for are there."""
        return self.limit is not None and len(self.rows) >= self.limit

    def day(self, begin: float, cells: list[FloatArray]) -> Iterator[FloatArray]:
        """Fill the intervals of a window that opened at ``begin``; yields each when it is done."""
        size = self.covariance[:, :2].nbytes * len(self.targets)
        look = max(1, int(MEMORY // size)) if self.ahead else 1
        for first in range(0, len(cells), look):
            some = cells[first : first + look]
            suns = [solar.vector(c + self._shift, self.site) for c in some]
            views = [[self.field_view(s[len(s) // 2], t) for t in self.targets] for s in suns]
            options = [
                self._option(v, len(c)) for c, row in zip(some, views, strict=True) for v in row
            ]
            wanted: list[list[int] | None] = [None] * len(options)
            if self.ahead:
                left = None if self.limit is None else self.limit - len(self.rows)
                known, form = self.covariance, self.form
                first_choice = _allocation.allocate(known, form, options, self.worth, left)
                wanted[:] = _allocation.exchanged(known, form, options, first_choice)
            for n, arrivals in enumerate(some):
                places = range(n * len(self.targets), (n + 1) * len(self.targets))
                queues = [
                    _Queue(self, views[n][o - places[0]], options[o], wanted[o]) for o in places
                ]
                self._cell(begin, arrivals, suns[n], queues)
                yield arrivals

    @property
    def _shift(self) -> float:
        """From a beam's arrival to the middle of the exposure, s."""
        return self.timing.settle + 0.5 * self.timing.exposure

    def _option(self, view: _View, room: int) -> _allocation.Option:
        rows = np.flatnonzero(view.able)
        # A heliostat is back at its aim before it comes again.
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
        """Give one slot of target ``j`` to the first of its queue that can be there."""
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
            k = int(np.searchsorted(self.offsets, i, side="right")) - 1
            row = i - int(self.offsets[k])
            own = self.view(k, slice(row, row + 1), sun, self.targets[j])
            # What the middle of the interval allowed, the slot itself may not.
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

    def _take(self, i: int, j: int, arrive: float, own: _View) -> None:
        way, done = float(own.seconds[0]), arrive + self.timing.slot
        self.covariance[i] = _gain.updated(self.covariance[i], own.slope[0])
        self.square[i] = max(0.0, float(np.sum(self.form[i] * self.covariance[i])))
        self.version[i] += 1
        self.free[i] = done + way
        time = arrive + self._shift
        self.rows.append(
            (
                arrive - way,
                arrive,
                time,
                done,
                done + way,
                i,
                j,
                own.counts[0],
                float(np.sqrt(self.square[i])),
                float(np.sqrt(self.square.sum() / self.counted)),
            )
        )

    def result(self, slots: int, drives: int) -> CalibrationCampaign:
        """The schedule as arrays."""
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

    Either ``wanted`` are settled, in that order; or all that can be there are in it with
    the gain of the middle of the interval, and an entry whose heliostat has been measured
    since is found stale by its version when it comes up, and only then renewed.
    """

    def __init__(
        self, work: _Work, view: _View, option: _allocation.Option, wanted: list[int] | None
    ) -> None:
        self.work, self.view, self.settled = work, view, wanted is not None
        self.heap: list[tuple[float, int, int]]
        if wanted is not None:
            self.heap = [(float(n), 0, i) for n, i in enumerate(wanted)]
            return
        found = _allocation.gains(work.covariance, work.form, option)
        self.heap = [
            (-float(g), int(work.version[i]), int(i))
            for g, i in zip(found, option.rows, strict=True)
            if g > work.worth * work.square[i]
        ]
        heapify(self.heap)

    def push(self, i: int) -> None:
        """Enter heliostat ``i`` with the gain that it has now."""
        work = self.work
        if self.settled:
            return
        gain = float(_gain.variance_gain(work.covariance[i], self.view.slope[i], work.form[i]))
        if gain > work.worth * work.square[i]:
            heappush(self.heap, (-gain, int(work.version[i]), i))
