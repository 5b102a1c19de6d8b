"""The plant's own view of time, site and pointing, compared with the reports.

A cluster with a wrong clock or site sends its local controllers a wrong sun vector, and each
heliostat then tracks without any fault indication, but misses its aim or standby point. The plant
therefore compares the time and the site in each status with its own. From the step counts of each
heliostat, the sun vector and the parameters that it knows, it also computes where the beam goes,
and compares this direction with that of the point to which the beam was sent.

A beam is directed to a point in three states: TRACKING, SEARCHING (within the radius that the plant
ordered), and IDLE, unless the heliostat stands still in IDLE. It stands still after UNLOCK and
CLEAR_FAULT, where an operator moved it, and until it has reached standby along the path from stow.
In every other state it is defocused, moving, locked, or at stow by the counts that it stores
itself, and there is no point to compare.
"""

from collections.abc import Callable, Sequence
from zlib import crc32

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, normalize
from heliotrope.lcu import messages, states
from heliotrope.lcu import names as meanings
from heliotrope.links.messages import ClusterStatus
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.board_items import packed
from heliotrope.mechanism.drives import Drive
from heliotrope.plant.field.aims import BeamCheck
from heliotrope.plant.field.assigned import Points, differ, put_before
from heliotrope.plant.field.ledger import TO_REST, Ledger
from heliotrope.plant.field.part import Part
from heliotrope.plant.field.state import FieldState, Mask
from heliotrope.safety import Reading
from heliotrope.sun import Site, fast_vector

#: Pause between two checks of the pointing, s.
CHECK_PERIOD = 2.0
#: Errors above this limit are passed to the safety table, rad.
NOTED = 1e-3
#: Maximum number of heliostats named; with more, the alarm concerns the whole field.
MOST_NAMED = 150
#: The step counts of a heliostat are used only when they are this much newer than the moment at
#: which its beam was first seen to be sent to its point, s.
_SETTLE = 1.0
#: An axis that approaches its goal by this much between two checks is still moving, rad.
_CLOSING = 1e-4
#: The motion of the sun is computed over this time, s.
_SPAN = 10.0
#: Longest time from sending a command of `messages.STANDS` to its arrival at the heliostat, s.
_UNDER_WAY = 15.0
#: States from which a ready heliostat comes to IDLE by tracking its standby point.
_COMES = (states.APPROACHING, states.TRACKING, states.SEARCHING, states.DEFOCUSED)

Rows = npt.NDArray[np.intp]


class _Points:
    """Assigned points of one kind, and where the beams were found.

    Parameters
    ----------
    points
        Assigned points, ENU, m, (N, 3); NaN if there is none. Other parts assign them.
    before
        The earlier points that may still have been in force when the plant's program started.

    Attributes
    ----------
    before
        The points before the assigned ones, latest first, (`assigned.BEFORE`, N, 3). All are NaN
        once the beam was found at the assigned point. They are kept because a local controller may
        refuse an assigned point, and then the beam stays at an earlier one.
    """

    def __init__(self, points: FloatArray, before: FloatArray) -> None:
        self.points, self._last = points, points.copy()
        self.before = before.copy()

    def check(self) -> Mask:
        """Return a mask of the points that have changed since the last check, (N,)."""
        new, last = self.points, self._last
        changed = differ(new, last)
        put_before(self.before, np.flatnonzero(changed), last[changed])
        last[changed] = new[changed]
        return changed

    def beside(self, rows: Rows, beam: FloatArray, vertex: FloatArray) -> FloatArray:
        """Return the angle between each beam and its nearest point, rad, (K,).

        The beams are vectors, (K, 3). The nearest point is the assigned point or an earlier one.
        """
        error = _angle(beam, self.points[rows] - vertex)
        self.before[:, rows[error < NOTED]] = np.nan
        for points in self.before[:, rows]:
            some = np.isfinite(points).all(axis=-1)
            error[some] = np.minimum(error[some], _angle(beam[some], (points - vertex)[some]))
        return error


class Agreement(Part):
    """Comparison of the reports of clusters and heliostats with the plant's own knowledge.

    Parameters
    ----------
    field, ledger, points
        State of the field; orders sent; assigned aims.
    check
        Beam check, with the heliostats as known at start-up.
    site
        Site of the plant.
    utc
        Function that returns the plant's time, POSIX s.
    differing
        Function that returns why a heliostat does not store the desired parameters; None if it
        stores them.
    """

    def __init__(
        self,
        field: FieldState,
        ledger: Ledger,
        points: Points,
        check: BeamCheck,
        site: Site,
        utc: Callable[[], float],
        differing: Callable[[str], str | None],
    ) -> None:
        self._field, self._ledger, self._site, self._utc = field, ledger, site, utc
        self._differing = differing
        self._aims = _Points(points.aims, points.earlier["AIM"])
        self._standbys = _Points(points.standbys, points.earlier["STANDBY"])
        self._armature, self._drives = check.armature.table.copy(), check.drives.table.copy()
        #: New parameters that the local controllers do not store yet: checksum, armature, drives.
        self._pending: dict[int, tuple[int, FloatArray, FloatArray]] = {}
        self._time_off = dict.fromkeys(field.clusters, 0.0)
        self._sun_off = dict.fromkeys(field.clusters, 0.0)
        count = len(field)
        #: States at the last check, and which beams are sent to aims and to standby points.
        self._states = np.full(count, -1, dtype=np.int64)
        self._on_aim, self._at_rest = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        #: Since when they have been sent to the present points, monotonic s.
        self._since = np.full(count, np.inf)
        #: Radius of the last search, rad.
        self._radius = np.full(count, np.nan)
        self._lag = np.full(count, np.inf)
        #: Whether the axes are at rest away from their goals, and the time of the counts used,
        #: monotonic s.
        self._stands, self._counted = np.zeros(count, dtype=bool), np.full(count, -np.inf)
        self._named_errors: dict[str, float] = {}
        self._at = -np.inf

    def believe(self, row: int, armature: FloatArray, drives: FloatArray) -> None:
        """Accept new parameters, which apply once the local controller reports their checksum."""
        self._pending[row] = crc32(packed("armature", tuple(armature))), armature, drives

    def on_sent(
        self,
        name: str,
        values: Sequence[float],
        heliostats: Sequence[str],
        now: float,
        again: bool,
    ) -> None:
        """Record how far a sent command may move beams from their points."""
        del now, again
        if name == "SEARCH":
            rows = np.array([self._field.index[name] for name in heliostats], dtype=np.intp)
            # A heliostat that is already searching continues its spiral if it refuses the new one.
            searches = self._field.rows["state"][rows] == states.SEARCHING
            self._radius[rows] = np.fmax(values[1], np.where(searches, self._radius[rows], np.nan))

    def on_status(self, cluster: str, status: ClusterStatus, now: float) -> None:
        """Accept the time and the site that a cluster reports."""
        del now
        utc_s = self._utc()
        if status.time_quality != "none":
            self._time_off[cluster] = abs(status.utc_s - utc_s)
        if status.site:
            self._sun_off[cluster] = _sun_off(status.site, self._site, utc_s)

    def readings(self, now: float) -> dict[tuple[str, str], Reading]:
        """Return the differences found for clusters and for heliostats.

        Clusters and heliostats that are not listed agree.

        A cluster that has fallen silent keeps its last difference, because a separate row covers
        silence.
        """
        if now - self._at >= CHECK_PERIOD:
            self._check(now)
            self._at = now
        differences = {
            ("pointing_error", name): Reading(x, now) for name, x in self._named_errors.items()
        }
        differences["pointing_error", ""] = Reading(0.0, now)
        differences["pointing_errors", ""] = Reading(float(len(self._named_errors)), now)
        for name in self._field.clusters:
            differences["cluster_time_off", name] = Reading(self._time_off[name], now)
            differences["cluster_sun_off", name] = Reading(self._sun_off[name], now)
        return differences

    def _check(self, now: float) -> None:
        field = self._field
        for row, (crc, armature, drives) in list(self._pending.items()):
            stored = int(field.rows["armature_crc"][row]) == crc
            if stored and not self._differing(field.names[row]):
                self._armature[row], self._drives[row] = armature, drives
                del self._pending[row]
        begins = self._sort(now)
        self._aims.before[:, field.live(now) & ~self._on_aim] = np.nan
        aims, standbys = self._aims.check(), self._standbys.check()
        begins |= np.where(self._on_aim, aims, standbys)
        self._since[begins] = now
        self._lag[begins], self._stands[begins] = np.inf, False
        kinds = ((self._on_aim, self._aims), (self._at_rest, self._standbys))
        error = np.zeros(len(field))
        for mine, sent in kinds:
            # Counts from before a new point say nothing about the new point.
            newer = field.counted_at >= self._since + _SETTLE
            known = np.isfinite(sent.points).all(axis=-1) & newer
            rows = np.flatnonzero(mine & known & field.sure(now))
            error[rows] = self._errors(rows, sent, now)
        searches = self._on_aim & (self._states == states.SEARCHING)
        error[searches] -= self._radius[searches]
        bad = np.flatnonzero(error >= NOTED)
        worst = bad[np.argsort(-error[bad], kind="stable")][:MOST_NAMED]
        self._named_errors = {field.names[row]: float(error[row]) for row in worst}

    def _sort(self, now: float) -> Mask:
        """Find which beams are sent to which points; return the heliostats whose point changed."""
        field = self._field
        live, state = field.live(now), field.rows["state"].astype(np.int64)
        ready = live & (state == states.IDLE) & (field.rows["flags"] & meanings.READY != 0)
        # IDLE returns a heliostat that is IDLE already but not at its standby point.
        came = self._ledger.obeyed_since(TO_REST, self._at, after=messages.STANDS)
        stilled = self._ledger.sent_since(messages.STANDS, now - _UNDER_WAY)
        came |= np.isin(self._states, _COMES) & ~stilled
        stays = self._at_rest & ~self._ledger.sent_since(messages.STANDS, self._at)
        at_rest = np.where(live, ready & (stays | came), stays)
        on_aim = live & np.isin(state, states.ON_AIM)
        on_aim &= (state == states.TRACKING) | np.isfinite(self._radius)
        begins = (on_aim & ~self._on_aim) | (at_rest & ~stays)
        self._on_aim, self._at_rest = on_aim, at_rest
        self._states[live] = state[live]
        return np.asarray(begins | ~(on_aim | at_rest))

    def _errors(self, rows: Rows, sent: _Points, now: float) -> FloatArray:
        """Return the angle between each beam and its point, rad, (K,).

        The angle is computed from the step goals and the step counts.
        """
        field = self._field
        sun = self._sun_at(now - field.counted_at[rows])
        drives = Drive(self._drives[rows])
        ends = np.asarray(drives.angles(field.goals(rows)))
        present = np.asarray(drives.angles(field.counts(rows)))
        error = self._beside(rows, sent, ends, sun)
        lag = np.abs(ends - present).max(axis=-1)
        # Axes that come no closer to their goals are at rest. In large fields, counts may be older
        # than the last check; unchanged counts give no new information.
        newer = field.counted_at[rows] > self._counted[rows]
        still = (lag > NOTED) & (lag > self._lag[rows] - _CLOSING)
        stands = np.where(newer, still, self._stands[rows])
        self._lag[rows], self._stands[rows] = lag, stands
        self._counted[rows] = field.counted_at[rows]
        if stands.any():
            beside = self._beside(rows[stands], sent, present[stands], sun[stands])
            error[stands] = np.maximum(error[stands], beside)
        return error

    def _sun_at(self, ages: FloatArray) -> FloatArray:
        """Return the sun vectors at times in the past, (K, 3), for ages (K,) in s."""
        utc_s = self._utc()
        sun = fast_vector(utc_s, self._site)
        rate = (sun - fast_vector(utc_s - _SPAN, self._site)) / _SPAN
        return normalize(sun - rate * ages[:, None], "sun")

    def _beside(self, rows: Rows, sent: _Points, angles: FloatArray, sun: FloatArray) -> FloatArray:
        """Return the angle between each beam and its point, rad, (K,).

        The axes are at angles (K, 2).
        """
        normal, vertex = Armature(self._armature[rows]).pose(angles)
        beam = 2.0 * np.sum(sun * normal, axis=-1, keepdims=True) * normal - sun
        return sent.beside(rows, beam, vertex)


def _angle(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the angles between vectors (K, 3), rad."""
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.arctan2(cross, np.sum(a * b, axis=-1)))


def _sun_off(values: Sequence[float], site: Site, utc_s: float) -> float:
    """Return the angle between the sun vectors at a reported site and at the plant's site, rad."""
    if tuple(values) == site.numbers:
        return 0.0
    try:
        latitude, longitude, height, pressure, temperature = values
        other = Site(latitude, longitude, height, None if pressure < 0.0 else pressure, temperature)
        suns = np.stack([fast_vector(utc_s, place) for place in (other, site)])
    except (InputError, ValueError):
        return np.pi
    return float(_angle(suns[:1], suns[1:])[0])
