"""Plans the commissioning of a field: from the errors of an installation to a goal, in days.

A target takes the visits one after the other. A first visit finds the beam, and may have to search
for it; a later visit may show several mirrors at once, told apart by coded movements. When a target
becomes free, it takes the visit that lowers the expected squared error of the field most for each
second. Gains are computed for all heliostats at the middle of an interval of half an hour, in which
each is visited once at most; the gains of different heliostats do not depend on each other.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.special import erf

from heliotrope import sun as solar
from heliotrope.calibration.plan import gain as _gain
from heliotrope.calibration.plan.fleets import Fleet
from heliotrope.calibration.plan.percentiles import error_percentiles
from heliotrope.calibration.plan.planning import SightingLimits
from heliotrope.calibration.plan.scaled_field import ScaledField, TargetView
from heliotrope.errors import InputError
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.optics.beam import SUN_RADIUS
from heliotrope.sun import Site

#: Most places at which a search looks for a beam.
LOOKS = 25
#: Percentiles of the curve.
SHARES = (0.5, 0.9)
#: A target that is used for more than this share of its time limits the plan.
_BUSY = 0.9

Mask = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]


def _default_limits() -> SightingLimits:
    return SightingLimits(min_elevation=float(np.radians(15.0)))


@dataclass(frozen=True)
class CommissionTerms:
    """What a visit costs and tells, and what the plan is for.

    Attributes
    ----------
    goal
        Beam error that 90 % of the mirrors shall not exceed, RMS over the year, rad.
    settle, shots, interval
        A visit of one mirror, s: until it stands still, and its photographs; 80 s together.
    look
        Further look for a beam that is not on the target, s.
    sigma
        Standard deviation of a photograph's beam in each direction, rad.
    together
        Mirrors of a joint visit, at most; 1: there are none.
    steps, step
        Photographs of a joint visit, and the time of each with the movement before it, s.
    sigma_together
        Standard deviation of the beam by all photographs of a joint visit, rad.
    likely
        Least chance that a beam is on the target at once, for a joint visit. One that is not there
        is searched for by further joint photographs, of all mirrors at once.
    first_alone
        A mirror that was never measured has its first visit alone.
    repeat
        Part of the beam error that is drawn anew at each visit and in operation, standard
        deviation in each direction, rad.
    worth
        Least share of a heliostat's expected squared error that a visit must take away.
    clear
        Share of the time without clouds.
    every
        Interval at which gains are computed, s.
    limits
        Limits of the sun and of angles.
    """

    goal: float = 6e-4
    settle: float = 20.0
    shots: int = 3
    interval: float = 20.0
    look: float = 20.0
    sigma: float = 5e-4
    together: int = 1
    steps: int = 16
    step: float = 3.0
    sigma_together: float = 4e-4
    likely: float = 0.9
    first_alone: bool = True
    repeat: float = 0.0
    worth: float = 0.05
    clear: float = 1.0
    every: float = 1800.0
    limits: SightingLimits = field(default_factory=_default_limits)

    def __post_init__(self) -> None:
        for name in ("sigma", "sigma_together", "step", "every"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InputError(f"commission: {name} {getattr(self, name)} must be above 0")
        for name in ("goal", "settle", "interval", "look", "repeat"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InputError(f"commission: {name} {getattr(self, name)} must be 0 or more")
        for name in ("likely", "clear"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise InputError(f"commission: {name} {getattr(self, name)}: give 0 to 1, not 0")
        if not 0.0 <= self.worth < 1.0:
            raise InputError(f"commission: worth {self.worth}: give a share from 0 to below 1")
        if min(self.shots, self.together, self.steps) < 1:
            raise InputError(
                f"commission: {self.shots} photographs of a mirror, {self.together} mirrors "
                f"together, {self.steps} photographs of a joint visit; give 1 or more of each"
            )

    @property
    def alone(self) -> float:
        """Time of a visit of one mirror without driving and searching, s."""
        return self.settle + self.shots * self.interval

    @property
    def joint(self) -> float:
        """Time of a joint visit without driving, s."""
        return self.settle + self.steps * self.step

    def accuracy(self, together: bool) -> float:
        """Standard deviation of a visit in each direction, rad."""
        seen = self.sigma_together if together else self.sigma / np.sqrt(self.shots)
        return float(np.hypot(seen, self.repeat))

    @property
    def floor(self) -> float:
        """RMS beam error that no number of visits lowers, rad."""
        return float(np.sqrt(2.0) * self.repeat)


@dataclass(frozen=True)
class Visit:
    """Mirrors on a target.

    Attributes
    ----------
    begin, end
        POSIX s; mirrors leave their aim at the beginning and are back at it at the end.
    target
        Number of the target.
    heliostats
        Their numbers through all fleets, (n,).
    joint
        Whether they are told apart by coded movements.
    first
        Whether they were never measured before.
    after
        Expected beam error over the year afterwards, rad RMS, (n,).
    """

    begin: float
    end: float
    target: int
    heliostats: Rows
    joint: bool
    first: bool
    after: FloatArray


@dataclass(frozen=True)
class CommissionPlan:
    """A plan and its prediction.

    Attributes
    ----------
    visits
        In order of their beginnings.
    time
        POSIX s of the curve, (K,): the beginning, and the end of each interval.
    percentiles, rms
        Predicted 50th and 90th percentile of the field's beam error, and its RMS, rad, (K, 2) and
        (K,).
    seconds
        Time of all targets by use: "photographs", "search", "travel" and "idle", s.
    days
        Beginning and end of each day's sun, POSIX s.
    terms
        The terms.
    unseen
        Heliostats that were never measured at the end.
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
        """When the 90th percentile is predicted at the goal, POSIX s; None if it is not."""
        good = np.flatnonzero(self.percentiles[:, 1] <= self.terms.goal)
        return float(self.time[good[0]]) if good.size else None

    @property
    def busy(self) -> float:
        """Share of the time of all targets that is used."""
        total = sum(self.seconds.values())
        return 1.0 - self.seconds["idle"] / total if total else 0.0

    @property
    def limit(self) -> str:
        """What keeps the plan from its goal, in one clause; "" if it is reached."""
        if self.reached is not None:
            return ""
        total = sum(self.seconds.values())
        share = {name: value / total for name, value in self.seconds.items()} if total else {}
        if self.terms.floor > self.terms.goal:
            return (
                f"what a visit does not repeat: {1e3 * self.terms.floor:.2f} mrad stay "
                "however often a mirror is measured"
            )
        if share.get("idle", 0.0) > 1.0 - _BUSY:
            return (
                f"the sun: targets stand idle for {100.0 * share['idle']:.0f} % of their time, "
                "because no visit at this hour is worth its time"
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
    held: npt.ArrayLike = False,
    terms: CommissionTerms | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> CommissionPlan:
    """Return the visits of a commissioning, up to the goal or the end of the span.

    Parameters
    ----------
    fleets
        The heliostats with what is known of them; see `fleets_of`.
    site, targets
        Place and air; targets with cameras.
    start, stop
        POSIX s.
    size
        Larger side of the mirrors, m, () or (N,).
    measured
        Heliostats that were measured before, as by a drone, () or (N,).
    held
        Heliostats that cannot be visited, () or (N,); they count in the field's errors.
    terms
        Default: `CommissionTerms()`.
    progress
        Called with (intervals done, all intervals).

    Raises
    ------
    InputError
        If there are no heliostats or targets, or the sun is not up in the span.

    Notes
    -----
    Clouds shorten every interval by the same share. Shading, blocking and glare are not considered:
    the running schedule avoids them, and a mirror that is hidden now comes an hour later.
    """
    if not fleets or not sum(len(f) for f in fleets) or not targets:
        raise InputError("commission: give heliostats and at least one target")
    given = terms or CommissionTerms()
    days, cells = _cells(site, start, stop, given)
    work = _Commissioning(fleets, targets, given, np.asarray(size, dtype=np.float64), measured)
    work.visited = work.counted & ~np.asarray(held, dtype=np.bool_)
    work.note(cells[0][0])
    for done, (begin, end) in enumerate(cells):
        if progress:
            progress(done, len(cells))
        work.fill(begin, end, solar.vector(0.5 * (begin + end), site))
        work.note(end)
        if work.curve[-1][1] <= given.goal:
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
        given,
        int(np.sum(~work.measured & work.counted)),
    )


def _cells(
    site: Site, start: float, stop: float, terms: CommissionTerms
) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Days of sun, and their intervals, each (begin, end)."""
    if not (np.isfinite([start, stop]).all() and 0.0 < stop - start <= 366.0 * 86400.0):
        raise InputError(f"commission: {start} to {stop} s; give a span of up to a year")
    edges = np.append(np.arange(start, stop, 60.0), stop)
    up = solar.position(edges, site).elevation >= terms.limits.min_elevation
    if not (up[:-1] & up[1:]).any():
        raise InputError(
            f"commission: the sun never reaches {np.degrees(terms.limits.min_elevation):g}° in the "
            "span; choose other days or lower the least elevation"
        )
    runs = np.split(np.arange(len(edges)), np.flatnonzero(np.diff(up.astype(np.int8))) + 1)
    days = [(float(edges[r[0]]), float(edges[r[-1]])) for r in runs if up[r[0]] and len(r) > 1]
    cells = []
    for begin, end in days:
        parts = np.linspace(begin, end, max(1, round((end - begin) / terms.every)) + 1)
        cells += list(zip(parts[:-1].tolist(), parts[1:].tolist(), strict=True))
    return days, cells


@dataclass
class _Choices:
    """Visits that a target can take during an interval, the best first.

    ``alone`` and ``joint`` are heliostats in the order of their value; a pointer passes those
    that have been taken.
    """

    view: TargetView
    gain: FloatArray
    looks: FloatArray
    alone: Rows
    joint: Rows
    value: FloatArray
    at: int = 0

    def next_alone(self, free: Mask) -> int:
        """Best heliostat for a visit alone; -1 if there is none."""
        while self.at < len(self.alone) and not free[self.alone[self.at]]:
            self.at += 1
        return int(self.alone[self.at]) if self.at < len(self.alone) else -1

    def next_joint(self, free: Mask, most: int) -> Rows:
        """Best heliostats for a joint visit."""
        reach = 4 * most
        while True:
            found = self.joint[:reach][free[self.joint[:reach]]]
            if len(found) >= most or reach >= len(self.joint):
                return found[:most]
            # Most at the front have been taken.
            self.joint = self.joint[free[self.joint]]
            reach *= 4


class _Commissioning:
    """The state of a plan in the making."""

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

    def note(self, now: float) -> None:
        """Add a point to the curve."""
        form, known, common = self.field.form, self.field.covariance, self.terms.floor**2
        middle, high = error_percentiles(form, known, SHARES, common)
        rms = np.sqrt(self.field.squares().sum() / self.field.counted + common)
        self.times.append(now)
        self.curve.append((float(middle), float(high), float(rms)))

    def fill(self, begin: float, end: float, sun: FloatArray) -> None:
        """Give the time of all targets in an interval to visits."""
        choices = [self._choices(sun, target) for target in self.targets]
        clock = np.full(len(choices), begin)
        stop = begin + self.terms.clear * (end - begin)
        free: Mask = np.array(self.visited)
        opened: Mask = np.ones(len(choices), dtype=np.bool_)
        while opened.any():
            j = int(np.argmin(np.where(opened, clock, np.inf)))
            now = float(clock[j])
            rows, joint = self._best(choices[j], free)
            span = self._span(choices[j], rows, joint) if rows.size else {}
            until = now + sum(span.values())
            if not rows.size or until > stop:
                opened[j] = False
                self.seconds["idle"] += max(0.0, stop - now)
                continue
            free[rows] = False
            for name, value in span.items():
                self.seconds[name] += value
            self._visit(choices[j].view, now, until, j, rows, joint)
            clock[j] = until

    def _choices(self, sun: FloatArray, target: Target) -> _Choices:
        terms, known, form = self.terms, self.field.covariance, self.field.form
        view = self.field.view(sun, target)
        spread = np.einsum("nip,npq,niq->n", view.slope, known, view.slope) * self.sigma**2
        seen = chance_on_target(target, self.position, self.size, spread)
        square = self.field.squares()

        def gains(joint: bool) -> FloatArray:
            slope = view.slope * (self.sigma / terms.accuracy(joint))[:, None, None]
            found = _gain.variance_gain(known, slope, form)
            good = view.able & self.counted & (found > terms.worth * square)
            return np.where(good, found, 0.0)

        gain, travel = gains(joint=False), np.where(view.able, view.seconds, 0.0)
        looks = np.minimum(1.0 / np.maximum(seen, 1e-9), LOOKS)
        value = gain / (terms.alone + terms.look * (looks - 1.0) + 2.0 * travel)
        alone = np.argsort(-value, kind="stable")[: int(np.sum(value > 0.0))]
        joint, both = np.empty(0, dtype=np.intp), np.zeros_like(gain)
        if terms.together > 1:
            able = (seen >= terms.likely) & (self.measured | (not terms.first_alone))
            both = np.where(able, gains(joint=True), 0.0)
            joint = np.argsort(-both / looks, kind="stable")[: int(np.sum(both > 0.0))]
        return _Choices(view, both, looks, alone, joint, value)

    def _best(self, choices: _Choices, free: Mask) -> tuple[Rows, bool]:
        """Return the heliostats of the next visit, and whether it is a joint one."""
        one = choices.next_alone(free)
        many = choices.next_joint(free, self.terms.together)
        if many.size:
            span = sum(self._span(choices, many, joint=True).values())
            if one < 0 or choices.gain[many].sum() / span >= choices.value[one]:
                return many, True
        return np.array([one] if one >= 0 else [], dtype=np.intp), False

    def _span(self, choices: _Choices, rows: Rows, joint: bool) -> dict[str, float]:
        """Return the time of a visit by use, s; joint mirrors drive and search at once."""
        more = float(choices.looks[rows].max()) - 1.0
        return {
            "photographs": self.terms.joint if joint else self.terms.alone,
            "search": more * (self.terms.joint if joint else self.terms.look),
            "travel": 2.0 * float(choices.view.seconds[rows].max()),
        }

    def _visit(
        self, view: TargetView, begin: float, end: float, j: int, rows: Rows, joint: bool
    ) -> None:
        scale = (self.sigma[rows] / self.terms.accuracy(joint))[:, None, None]
        known = _gain.updated(self.field.covariance[rows], view.slope[rows] * scale)
        self.field.covariance[rows] = known
        square = np.einsum("npq,nqp->n", self.field.form[rows], known)
        after = np.sqrt(np.maximum(square, 0.0) + self.terms.floor**2)
        first = bool(not self.measured[rows].any())
        self.measured[rows] = True
        self.visits.append(Visit(begin, end, j, rows, joint, first, after))


def chance_on_target(
    target: Target, position: FloatArray, size: FloatArray, spread: FloatArray
) -> FloatArray:
    """Return the chance that a beam is wholly on a target at the first look, (N,).

    Parameters
    ----------
    target
        The target; the beam is sent to its centre.
    position, size
        Feet of the heliostats (N, 3) and the larger sides of their mirrors (N,), m.
    spread
        Expected squared beam error of both directions together, rad², (N,).
    """
    way = target.center - position
    distance = np.linalg.norm(way, axis=1)
    facing = np.abs(way @ target.normal) / distance
    # The beam's own radius: half a mirror, and the sun's disc.
    radius = 0.5 * size + SUN_RADIUS * distance
    half = 0.5 * np.array([target.width, target.height])
    room = np.maximum(half - radius[:, None], 0.1 * half)
    sigma = np.sqrt(0.5 * np.maximum(spread, 1e-18)) * distance
    across = sigma / np.maximum(facing, 0.1)
    root = np.sqrt(2.0)
    return np.asarray(erf(room[:, 0] / (root * across)) * erf(room[:, 1] / (root * sigma)))


def mirrors_of(visits: Iterable[Visit]) -> int:
    """Return the number of sightings of some visits."""
    return sum(len(visit.heliostats) for visit in visits)
