"""Plan the commissioning of a field over days: from installation errors to the accuracy goal.

A target takes the calibration visits one after the other, as in a running plant: first come joint
visits of heliostats that were never measured, then joint visits that are due, then single visits
for heliostats whose beams a joint visit did not find. Within each kind, the heliostats whose visits
reduce the expected squared error of the field most per second come first. Gains are computed for
all heliostats at the middle of each half-hour interval, in which each heliostat is visited at most
once; the gains of different heliostats are independent. A plant that measures heliostats on its
receiver has one more place for visits. It is open to heliostats that are known well enough, which
stay at their aims.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from heliotrope import sun as solar
from heliotrope.calibration.plan import gain as _gain
from heliotrope.calibration.plan.fleets import Fleet
from heliotrope.calibration.plan.joint_terms import JointTerms
from heliotrope.calibration.plan.on_target import chance_by_try, chance_on_target
from heliotrope.calibration.plan.percentiles import error_percentiles
from heliotrope.calibration.plan.planning import SightingLimits
from heliotrope.calibration.plan.receiver_terms import ReceiverTerms
from heliotrope.calibration.plan.scaled_field import ScaledField, TargetView
from heliotrope.errors import InputError
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.sun import Site

#: Maximum number of positions at which a search looks for a beam.
LOOKS = 25
#: Percentiles of the beam error that the curve shows, as fractions.
SHARES = (0.5, 0.9)
#: A target that is in use for more than this fraction of the time limits the plan.
_BUSY = 0.9

Mask = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]


def _default_limits() -> SightingLimits:
    return SightingLimits(min_elevation=float(np.radians(15.0)))


@dataclass(frozen=True)
class CommissionTerms:
    """Cost and accuracy of a calibration visit, and the goal of the plan.

    Attributes
    ----------
    goal
        Beam error that 90 % of the heliostats must not exceed, RMS over the year, rad.
    settle, shots, interval
        Time in a single visit until the heliostat is steady, number of photographs, and time
        between them, s; 80 s in total by default.
    look
        Time for each further search photograph if the beam is not on the target, s.
    sigma
        Standard deviation of the beam position in a photograph, per direction, rad.
    joint
        Joint visits of several heliostats; None: no joint visits.
    receiver
        Receiver visits; None: no receiver visits.
    repeat
        Standard deviation per direction of the random part of the beam error, rad. This part is
        different at each visit and in operation.
    worth
        Minimum fraction of a heliostat's expected squared error that a visit must remove.
    clear
        Fraction of the time that is free of clouds.
    every
        Interval at which gains are computed, s.
    limits
        Limits on the sun position and on angles.
    """

    goal: float = 6e-4
    settle: float = 20.0
    shots: int = 3
    interval: float = 20.0
    look: float = 20.0
    sigma: float = 5e-4
    joint: JointTerms | None = None
    receiver: ReceiverTerms | None = None
    repeat: float = 0.0
    worth: float = 0.05
    clear: float = 1.0
    every: float = 1800.0
    limits: SightingLimits = field(default_factory=_default_limits)

    def __post_init__(self) -> None:
        for name in ("sigma", "every"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InputError(f"commission: {name} must be above 0, not {getattr(self, name)}")
        for name in ("goal", "settle", "interval", "look", "repeat"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InputError(f"commission: {name} must be 0 or more, not {getattr(self, name)}")
        if not 0.0 < self.clear <= 1.0:
            raise InputError(f"commission: clear must be above 0 and at most 1, not {self.clear}")
        if not 0.0 <= self.worth < 1.0:
            raise InputError(f"commission: worth must be 0 or more and below 1, not {self.worth}")
        if self.shots < 1:
            raise InputError(
                "commission: the number of photographs per heliostat must be 1 or more, not "
                f"{self.shots}"
            )

    @property
    def alone(self) -> float:
        """Time of a single visit without slewing and searching, s."""
        return self.settle + self.shots * self.interval

    def accuracy(self, together: bool, *, produces: bool = False) -> float:
        """Return the standard deviation per direction that a visit achieves, rad.

        Parameters
        ----------
        together, produces
            Whether the visit is coded, and whether it is a receiver visit.
        """
        terms = self.receiver if produces else self.joint if together else None
        noise = self.sigma / np.sqrt(self.shots) if terms is None else terms.sigma
        return float(np.hypot(noise, self.repeat))

    @property
    def floor(self) -> float:
        """RMS beam error that no number of visits can reduce, rad."""
        return float(np.sqrt(2.0) * self.repeat)


@dataclass(frozen=True)
class Visit:
    """A visit of heliostats to a target, or at their aims on the receiver.

    Attributes
    ----------
    begin, end
        POSIX s; heliostats leave their aims at the beginning and have returned at the end.
    target
        Index of the target; the receiver has the index after the last target.
    heliostats
        Heliostat indices over all fleets, (n,).
    joint
        Whether coded movements distinguish the heliostats.
    own
        Whether each heliostat has its own code, and a second stack verifies the new parameters.
    first
        Whether any of the heliostats was never measured before.
    missed
        Which beams are expected to miss the target in a joint first visit, (n,).
    after
        Expected beam error over the year afterwards, rad RMS, (n,).
    """

    begin: float
    end: float
    target: int
    heliostats: Rows
    joint: bool
    own: bool
    first: bool
    missed: Mask
    after: FloatArray


@dataclass(frozen=True)
class CommissionPlan:
    """A commissioning plan and its predicted result.

    Attributes
    ----------
    visits
        Visits in order of their start times.
    time
        POSIX s of the curve, (K,): the start, and the end of each interval.
    percentiles, rms
        Predicted 50th and 90th percentile of the field's beam error, and its RMS, rad, (K, 2) and
        (K,).
    seconds
        Total time of all targets for each use ("photographs", "search", "travel" and "idle"), s.
    days
        Start and end of each day's sunlight, POSIX s.
    terms
        Terms of the plan.
    unseen
        Heliostats that remain unmeasured at the end.
    """

    visits: tuple[Visit, ...]
    time: FloatArray
    percentiles: FloatArray
    rms: FloatArray
    seconds: dict[str, float]
    days: tuple[tuple[float, float], ...]
    terms: CommissionTerms
    unseen: int

    @property
    def reached(self) -> float | None:
        """Time at which the predicted 90th percentile reaches the goal, POSIX s; None if never."""
        good = np.flatnonzero(self.percentiles[:, 1] <= self.terms.goal)
        return float(self.time[good[0]]) if good.size else None

    @property
    def busy(self) -> float:
        """Fraction of the targets' time that is used."""
        total = sum(self.seconds.values())
        return 1.0 - self.seconds["idle"] / total if total else 0.0

    @property
    def limit(self) -> str:
        """What keeps the plan from its goal, in one clause; an empty string if it is reached."""
        if self.reached is not None:
            return ""
        total = sum(self.seconds.values())
        share = {name: value / total for name, value in self.seconds.items()} if total else {}
        if self.terms.floor > self.terms.goal:
            return (
                f"visit-to-visit error: {1e3 * self.terms.floor:.2f} mrad remain however often a "
                "mirror is measured"
            )
        if share.get("idle", 0.0) > 1.0 - _BUSY:
            return (
                f"the sun: targets stand idle for {100.0 * share['idle']:.0f} % of their time, "
                "because no visit at those hours is worth its time"
            )
        most = max(("photographs", "search", "travel"), key=lambda name: share.get(name, 0.0))
        words = {
            "photographs": "photographs",
            "search": "searches for beams",
            "travel": "slews",
        }[most]
        return (
            f"the targets: used for {100.0 * self.busy:.0f} % of their time, "
            f"{100.0 * share.get(most, 0.0):.0f} % for {words}"
        )


def plan_commission(
    fleets: Sequence[Fleet],
    site: Site,
    targets: Sequence[Target],
    start: float,
    stop: float,
    *,
    size: npt.ArrayLike = 3.0,
    measured: npt.ArrayLike = False,
    missed: npt.ArrayLike = 0,
    held: npt.ArrayLike = False,
    terms: CommissionTerms | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> CommissionPlan:
    """Return the visits of a commissioning, until the goal or the end of the time span is reached.

    Parameters
    ----------
    fleets
        The heliostats with the information available on each; see `fleets_of`.
    site, targets
        Location and atmosphere; targets with cameras.
    start, stop
        POSIX s.
    size
        Longer side of the mirrors, m, () or (N,).
    measured
        Whether each heliostat was measured before, for example by a drone, () or (N,).
    missed
        Number of joint first visits that each heliostat's beam has missed so far, () or (N,).
    held
        Whether each heliostat cannot be visited, () or (N,). Such heliostats still count in the
        field's errors.
    terms
        Default: `CommissionTerms()`.
    progress
        Called with the numbers of intervals (done, total).

    Raises
    ------
    InputError
        If there are no heliostats or targets, or the sun is not up in the time span.

    Notes
    -----
    Clouds shorten every interval by the same fraction. Shading, blocking and glare are ignored,
    because the running schedule avoids them and visits an obstructed heliostat an hour later.
    """
    if not fleets or not sum(len(f) for f in fleets) or not targets:
        raise InputError("commission: specify heliostats and at least one target")
    chosen = terms or CommissionTerms()
    days, cells = _cells(site, start, stop, chosen)
    work = _Commissioning(fleets, targets, chosen, np.asarray(size, dtype=np.float64), measured)
    work.missed += np.asarray(missed, dtype=np.int64)
    work.visited = work.counted & ~np.asarray(held, dtype=np.bool_)
    work.note(cells[0][0])
    for done, (begin, end) in enumerate(cells):
        if progress:
            progress(done, len(cells))
        work.fill(begin, end, solar.vector(0.5 * (begin + end), site))
        work.note(end)
        if work.curve[-1][1] <= chosen.goal:
            break
    if progress:
        progress(len(cells), len(cells))
    table = np.array(work.curve)
    return CommissionPlan(
        tuple(sorted(work.visits, key=lambda visit: (visit.begin, visit.target))),
        np.array(work.times),
        table[:, :2],
        table[:, 2],
        work.seconds,
        tuple(days),
        chosen,
        int(np.sum(~work.measured & work.counted)),
    )


def _cells(
    site: Site, start: float, stop: float, terms: CommissionTerms
) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Return the days of sunlight, and their intervals, each as (begin, end)."""
    if not (np.isfinite([start, stop]).all() and 0.0 < stop - start <= 366.0 * 86400.0):
        raise InputError(f"commission: the period must be at most a year, not {start} to {stop} s")
    edges = np.append(np.arange(start, stop, 60.0), stop)
    up = solar.position(edges, site).elevation >= terms.limits.min_elevation
    if not (up[:-1] & up[1:]).any():
        raise InputError(
            f"commission: the sun never reaches {np.degrees(terms.limits.min_elevation):g}° in "
            "this period; choose other days or lower the minimum elevation"
        )
    runs = np.split(np.arange(len(edges)), np.flatnonzero(np.diff(up.astype(np.int8))) + 1)
    days = [(float(edges[r[0]]), float(edges[r[-1]])) for r in runs if up[r[0]] and len(r) > 1]
    cells = []
    for begin, end in days:
        parts = np.linspace(begin, end, max(1, round((end - begin) / terms.every)) + 1)
        cells += list(zip(parts[:-1].tolist(), parts[1:].tolist(), strict=True))
    return days, cells


@dataclass
class _Queue:
    """Heliostats in order of decreasing value; heliostats already taken are skipped."""

    rows: Rows

    def first(self, free: Mask, most: int) -> Rows:
        """Return the best free heliostats, at most ``most``."""
        reach = max(4 * most, 256)
        while True:
            free_rows = self.rows[:reach][free[self.rows[:reach]]]
            if len(free_rows) >= most or reach >= len(self.rows):
                return free_rows[:most]
            # Most heliostats at the front of the queue have already been taken.
            self.rows = self.rows[free[self.rows]]
            reach *= 4


@dataclass
class _Choices:
    """Heliostats from which the visits to a target during an interval are chosen.

    ``alone`` are candidates for a single visit, and ``lost`` are those of them that were never
    measured. ``new`` are candidates for a joint first visit, and ``known`` for a later joint visit.
    """

    view: TargetView
    slant: FloatArray
    spread: FloatArray
    share_seen: FloatArray
    looks: FloatArray
    alone: _Queue
    lost: _Queue
    new: _Queue
    known: _Queue


class _Commissioning:
    """The state of a plan under construction."""

    def __init__(
        self,
        fleets: Sequence[Fleet],
        targets: Sequence[Target],
        terms: CommissionTerms,
        size: FloatArray,
        measured: npt.ArrayLike,
    ) -> None:
        self.field, self.targets, self.terms = ScaledField(fleets, terms.limits), targets, terms
        count = len(self.field)
        self.size = np.broadcast_to(size, (count,))
        self.measured = np.array(np.broadcast_to(np.asarray(measured, dtype=np.bool_), (count,)))
        self.sigma = np.concatenate([np.full(len(f), f.sigma) for f in fleets])
        self.position = np.concatenate([f.mechanism.position for f in fleets])
        self.counted = self.field.form.any(axis=(1, 2))
        self.visited = self.counted
        self.visits: list[Visit] = []
        self.times: list[float] = []
        self.curve: list[tuple[float, ...]] = []
        self.seconds = dict.fromkeys(("photographs", "search", "travel", "idle"), 0.0)
        #: Number of joint first visits that each beam has missed, and the fraction of a miss
        #: carried over.
        self.missed, self._owed = np.zeros(count, dtype=np.int64), 0.0
        self._last_joint: Mask = np.zeros(len(targets) + 1, dtype=np.bool_)
        places = len(targets) + (terms.receiver is not None)
        #: End of the last interval, and the time that each place did not use in that interval, s.
        self._until, self._unused = -np.inf, np.zeros(places)
        #: When each heliostat's last visit ended, and when its last receiver visit ended.
        self._home, self._shone = np.full((2, count), -np.inf)
        self._shines: Mask = np.zeros(count, dtype=np.bool_)
        if terms.receiver is not None:
            aim = np.concatenate([f.aim for f in fleets])
            self._shines = self.counted & terms.receiver.shining(self.position, aim)

    def note(self, now: float) -> None:
        """Add a point to the curve at time ``now``."""
        form, known, common = self.field.form, self.field.covariance, self.terms.floor**2
        middle, high = error_percentiles(form, known, SHARES, common)
        rms = np.sqrt(self.field.squares().sum() / self.field.counted + common)
        self.times.append(now)
        self.curve.append((float(middle), float(high), float(rms)))

    def fill(self, begin: float, end: float, sun: FloatArray) -> None:
        """Fill the time of all targets, and of the receiver, in an interval with visits."""
        # Time left over from the previous interval, too short for a visit, is used now.
        unused = self._unused if begin == self._until else np.zeros_like(self._unused)
        carried = begin - unused
        choices = [self._choices(sun, target) for target in self.targets]
        if (terms := self.terms.receiver) is not None:
            choices.append(self._in_production(sun, terms, float(carried[-1])))
        clock, stop = carried.copy(), begin + self.terms.clear * (end - begin)
        free: Mask = np.array(self.visited)
        opened: Mask = np.ones(len(choices), dtype=np.bool_)
        while opened.any():
            j = int(np.argmin(np.where(opened, clock, np.inf)))
            now = float(clock[j])
            # Some heliostats are still returning from another place during the time left over.
            home = free if now >= begin else free & (self._home <= now)
            rows, joint = self._best(j, choices[j], home)
            span = self._span(j, choices[j], rows, joint) if rows.size else {}
            until = now + sum(span.values())
            if not rows.size or until > stop:
                opened[j] = False
                # If no heliostat is left to visit, no time is carried over.
                self._unused[j] = max(0.0, stop - now) if rows.size else 0.0
                self._use(j, {"idle": max(0.0, stop - now) - (begin - carried[j])})
                continue
            free[rows] = False
            self._use(j, span)
            self._last_joint[j] = joint
            self._visit(choices[j], now, until, j, rows, joint)
            clock[j] = until
        self._until = end

    def _use(self, j: int, span: dict[str, float]) -> None:
        """Account for the time of a target; the receiver's time is excluded."""
        if j < len(self.targets):
            for name, value in span.items():
                self.seconds[name] += value

    def _choices(self, sun: FloatArray, target: Target) -> _Choices:
        terms = self.terms
        view, spread = self._seen_on(target, sun)
        chance = chance_on_target(target, self.position, self.size, spread)
        at_once = chance
        if terms.joint is not None:
            chances = chance_by_try(target, self.position, spread, terms.joint.tries)
            row = np.arange(len(self.missed))
            at_once = chances[np.minimum(self.missed, terms.joint.tries - 1), row]
        travel = np.where(view.able, view.seconds, 0.0)
        looks = np.minimum(1.0 / np.maximum(chance, 1e-9), LOOKS)
        span = terms.alone + terms.look * (looks - 1.0) + 2.0 * travel
        value = self._gains(view, terms.accuracy(together=False)) / span
        nobody = np.zeros_like(value)
        new = late = nobody
        if terms.joint is not None:
            both = self._gains(view, terms.accuracy(together=True))
            vague = spread > terms.joint.known**2
            to_first = (~self.measured | vague) & (self.missed < terms.joint.tries)
            new = both * at_once * to_first if terms.joint.first else nobody
            late = np.where(self.measured & ~vague, both, 0.0)
        slant = np.linalg.norm(target.center - self.position, axis=1)
        lost = np.where(self.measured, 0.0, value)
        queues = (_Queue(_descending(priority)) for priority in (value, lost, new, late))
        return _Choices(view, slant, spread, at_once, looks, *queues)

    def _seen_on(self, target: Target, sun: FloatArray) -> tuple[TargetView, FloatArray]:
        """Return the view of a target, and the expected squared errors of beams on it, rad²."""
        view, known = self.field.view(sun, target), self.field.covariance
        spread = np.einsum("nip,npq,niq->n", view.slope, known, view.slope) * self.sigma**2
        return view, spread

    def _gains(self, view: TargetView, accuracy: float) -> FloatArray:
        """Return the decrease of each expected squared error, rad²; 0 if not worth a visit."""
        slope = view.slope * (self.sigma / accuracy)[:, None, None]
        falls = _gain.variance_gain(self.field.covariance, slope, self.field.form)
        worthy = view.able & self.counted & (falls > self.terms.worth * self.field.squares())
        return np.where(worthy, falls, 0.0)

    def _in_production(self, sun: FloatArray, terms: ReceiverTerms, now: float) -> _Choices:
        """Return the receiver visits, open to heliostats that are known well enough."""
        view, spread = self._seen_on(terms.face, sun)
        ready = self._shines & self.measured & (spread <= terms.known**2)
        ready &= now - self._shone >= terms.settings.every
        gains = self._gains(view, self.terms.accuracy(together=True, produces=True))
        slant = np.linalg.norm(terms.face.center - self.position, axis=1)
        certain, nobody = np.ones(len(slant)), np.zeros(0, dtype=np.intp)
        known = _descending(np.where(ready, gains, 0.0))
        queues = (_Queue(rows) for rows in (nobody, nobody, nobody, known))
        return _Choices(view, slant, spread, certain, certain, *queues)

    @property
    def _shining(self) -> int:
        """Return the number of heliostats that shine on the receiver."""
        return int((self._shines & self.visited & self.measured).sum())

    def _best(self, j: int, choices: _Choices, free: Mask) -> tuple[Rows, bool]:
        """Return the heliostats of the next visit to a place, and whether the visit is joint."""
        if j == len(self.targets) and (shining := self.terms.receiver) is not None:
            many = choices.known.first(free, shining.at_once(self._shining))
            return (many if len(many) >= shining.settings.least else many[:0]), True
        alone, terms = choices.alone.first(free, 1), self.terms.joint
        if terms is None:
            return alone, False
        if terms.first and len(many := choices.new.first(free, terms.first)) >= terms.least:
            share = -(-int(free[choices.new.rows].sum()) // len(self.targets))
            many = many[: max(terms.least, share)]
            slant, spread = choices.slant[many], choices.spread[many]
            light = terms.fitting(self.targets[j], self.size[many], slant, spread)
            if light >= terms.least:
                return many[:light], True
        # Heliostats whose first visit must be a single visit get every second visit.
        if self._last_joint[j] and (lost := choices.lost.first(free, 1)).size:
            return lost, False
        many = choices.known.first(free, terms.most)
        return (many, True) if len(many) >= terms.least else (alone, False)

    def _span(self, j: int, choices: _Choices, rows: Rows, joint: bool) -> dict[str, float]:
        """Return the time of a visit for each use, s.

        In a joint visit the heliostats slew simultaneously and there is no search. In a receiver
        visit they do not slew either.
        """
        if j == len(self.targets) and (shining := self.terms.receiver) is not None:
            return {"photographs": shining.span(len(rows), self._shining)}
        travel = 2.0 * float(choices.view.seconds[rows].max())
        if not joint or self.terms.joint is None:
            search = self.terms.look * (float(choices.looks[rows].max()) - 1.0)
            return {"photographs": self.terms.alone, "search": search, "travel": travel}
        own = self._own(choices, rows)
        took = self.terms.joint.span(len(rows), own=own)
        return {"photographs": took, "travel": travel * (2.0 if own else 1.0)}

    def _own(self, choices: _Choices, rows: Rows) -> bool:
        """Return whether each heliostat in a joint visit has its own code."""
        joint = self.terms.joint
        vague = joint is not None and (choices.spread[rows] > joint.known**2).any()
        return bool(vague or not self.measured[rows].all())

    def _visit(
        self, choices: _Choices, begin: float, end: float, j: int, rows: Rows, joint: bool
    ) -> None:
        first = bool((~self.measured[rows]).any())
        missed, stacks = np.zeros(len(rows), dtype=np.bool_), 1.0
        produces = j == len(self.targets)
        own = joint and not produces and self._own(choices, rows)
        if own:
            # The stack that verifies new parameters is also a sighting.
            missed, stacks = self._misses(choices.share_seen[rows]), 2.0
        scale = np.sqrt(stacks) * self.sigma[rows] / self.terms.accuracy(joint, produces=produces)
        scale = np.where(missed, 0.0, scale)[:, None, None]
        known = _gain.updated(self.field.covariance[rows], choices.view.slope[rows] * scale)
        self.field.covariance[rows] = known
        square = np.einsum("npq,nqp->n", self.field.form[rows], known)
        after = np.sqrt(np.maximum(square, 0.0) + self.terms.floor**2)
        self.missed[rows] += missed
        self.measured[rows] |= ~missed
        self._home[rows] = end
        if produces:
            self._shone[rows] = end
        self.visits.append(Visit(begin, end, j, rows, joint, own, first, missed, after))

    def _misses(self, chance: FloatArray) -> Mask:
        """Return a mask of the beams that miss, (n,).

        As many miss as are expected to, spread evenly.
        """
        due = self._owed + np.cumsum(1.0 - chance)
        self._owed = float(due[-1]) % 1.0
        return np.asarray(np.diff(np.floor(due), prepend=0.0) > 0.0)


def _descending(value: FloatArray) -> Rows:
    """Return the indices of positive values, largest first."""
    return np.asarray(np.argsort(-value, kind="stable")[: int(np.sum(value > 0.0))])


def mirrors_of(visits: Iterable[Visit]) -> int:
    """Return the total number of sightings in some visits."""
    return sum(len(visit.heliostats) for visit in visits)
