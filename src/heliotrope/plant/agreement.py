"""The plant's own view of time, site and pointing, compared with what is reported.

A cluster with a wrong clock or site sends its local controllers a wrong sun, and each of them then
tracks, in good order, beside its aim. So the plant compares the time and the site in each status
with its own; and from the step counts of each heliostat that tracks, the sun and the parameters
that it knows, it computes where the beam goes, and compares that with the aim.
"""

from collections.abc import Callable, Sequence
from zlib import crc32

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, normalize
from heliotrope.lcu import states
from heliotrope.links.messages import ClusterStatus
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.board_items import packed
from heliotrope.mechanism.drives import Drive
from heliotrope.plant.aims import BeamCheck
from heliotrope.plant.assigned import Points
from heliotrope.plant.field_state import FieldState
from heliotrope.safety import Reading
from heliotrope.sun import Site, fast_vector

#: Pause between two looks at the pointing, s.
LOOK_PERIOD = 2.0
#: Errors from here on (rad) are handed to the safety table.
NOTED = 1e-3
#: Most heliostats that are named; with more, the field is the subject.
MOST_NAMED = 150
#: Step counts count from this time after a heliostat was first seen to track, s.
_SETTLE = 1.0
#: An axis that comes nearer to its goal by this between two looks is on its way, rad.
_CLOSING = 1e-4
#: The motion of the sun is taken over this time, s.
_SPAN = 10.0

Rows = npt.NDArray[np.intp]


class Agreement:
    """Comparison of what clusters and heliostats report with what the plant knows itself.

    Parameters
    ----------
    field, points
        State of the field; assigned aims.
    check
        Mirrors as the plant knows them at its start.
    site
        Site of the plant.
    utc
        Returns the plant's time, POSIX s.
    """

    def __init__(
        self,
        field: FieldState,
        points: Points,
        check: BeamCheck,
        site: Site,
        utc: Callable[[], float],
    ) -> None:
        self._field, self._points, self._site, self._utc = field, points, site, utc
        self._armature, self._drives = check.armature.table.copy(), check.drives.table.copy()
        #: New parameters that the local controllers do not store yet: checksum, armature, drives.
        self._pending: dict[int, tuple[int, FloatArray, FloatArray]] = {}
        self._time_off = dict.fromkeys(field.clusters, 0.0)
        self._sun_off = dict.fromkeys(field.clusters, 0.0)
        count = len(field)
        self._since = np.full(count, np.inf)
        #: Aims at the last look, and when each was seen to change.
        self._aims, self._aimed_at = points.aims.copy(), np.full(count, -np.inf)
        self._lag = np.full(count, np.inf)
        #: Whether the axes stand beside their goals, by counts that came at a time, monotonic s.
        self._stands, self._counted = np.zeros(count, dtype=bool), np.full(count, -np.inf)
        #: Aims at which the beams were found: an assigned aim may wait for its turn.
        self._found = np.full((count, 3), np.nan)
        self._wrong: dict[str, float] = {}
        self._at = -np.inf

    def believe(self, row: int, armature: FloatArray, drives: FloatArray) -> None:
        """Take new parameters, which hold once the local controller reports their checksum."""
        self._pending[row] = crc32(packed("armature", tuple(armature))), armature, drives

    def take(self, cluster: str, status: ClusterStatus) -> None:
        """Take a cluster's status that has just arrived."""
        utc_s = self._utc()
        if status.time_quality != "none":
            self._time_off[cluster] = abs(status.utc_s - utc_s)
        if status.site:
            self._sun_off[cluster] = _sun_off(status.site, self._site, utc_s)

    def readings(self, now: float) -> dict[tuple[str, str], Reading]:
        """Return the differences of clusters and of heliostats; what is not named agrees.

        A cluster that has fallen silent keeps its last difference: its silence has its own row.
        """
        if now - self._at >= LOOK_PERIOD:
            self._at = now
            self._look(now)
        found = {("pointing_error", name): Reading(x, now) for name, x in self._wrong.items()}
        found["pointing_error", ""] = Reading(0.0, now)
        found["pointing_errors", ""] = Reading(float(len(self._wrong)), now)
        for name in self._field.clusters:
            found["cluster_time_off", name] = Reading(self._time_off[name], now)
            found["cluster_sun_off", name] = Reading(self._sun_off[name], now)
        return found

    def _look(self, now: float) -> None:
        field, aims = self._field, self._points.aims
        for row, (crc, armature, drives) in list(self._pending.items()):
            if int(field.rows["armature_crc"][row]) == crc:
                self._armature[row], self._drives[row] = armature, drives
                del self._pending[row]
        tracking = field.among((states.TRACKING,), now)
        self._since = np.where(tracking, np.minimum(self._since, now), np.inf)
        self._found[~tracking] = np.nan
        changed = ~np.all((aims == self._aims) | (np.isnan(aims) & np.isnan(self._aims)), axis=-1)
        begins = ~tracking | changed
        self._lag[begins], self._stands[begins] = np.inf, False
        # A new aim may wait for its turn: until then the beam is on the one before, found or not.
        unfound = changed & np.isnan(self._found).any(axis=-1)
        self._found[unfound] = self._aims[unfound]
        self._aimed_at[changed], self._aims[changed] = now, aims[changed]
        # Counts from before a new aim say nothing about it.
        begun = np.maximum(self._since, self._aimed_at) + _SETTLE
        known = np.isfinite(aims).all(axis=-1) & (field.counted_at >= begun)
        rows = np.flatnonzero(tracking & known)
        error = self._errors(rows, now)
        bad = np.flatnonzero(error >= NOTED)
        worst = bad[np.argsort(-error[bad], kind="stable")][:MOST_NAMED]
        self._wrong = {field.names[rows[i]]: float(error[i]) for i in worst}

    def _errors(self, rows: Rows, now: float) -> FloatArray:
        """Return the angle between each beam (K,) and its aim, rad, by goals and counts."""
        field = self._field
        sun = self._sun_at(now - field.counted_at[rows])
        drives = Drive(self._drives[rows])
        ends = np.asarray(drives.angles(field.goals(rows)))
        here = np.asarray(drives.angles(field.counts(rows)))
        error = self._beside(rows, ends, sun)
        lag = np.abs(ends - here).max(axis=-1)
        # Axes that come no nearer to their goals stand where they are.
        # In large fields counts are older than a look: the same counts say nothing new.
        newer = field.counted_at[rows] > self._counted[rows]
        still = (lag > NOTED) & (lag > self._lag[rows] - _CLOSING)
        stands = np.where(newer, still, self._stands[rows])
        self._lag[rows], self._stands[rows] = lag, stands
        self._counted[rows] = field.counted_at[rows]
        if stands.any():
            beside = self._beside(rows[stands], here[stands], sun[stands])
            error[stands] = np.maximum(error[stands], beside)
        return error

    def _sun_at(self, ages: FloatArray) -> FloatArray:
        """Return the vectors to the sun some time ago, (K, 3); ages (K,) in s."""
        utc_s = self._utc()
        sun = fast_vector(utc_s, self._site)
        rate = (sun - fast_vector(utc_s - _SPAN, self._site)) / _SPAN
        return normalize(sun - rate * ages[:, None], "sun")

    def _beside(self, rows: Rows, angles: FloatArray, sun: FloatArray) -> FloatArray:
        """Return the angle between beams (K,) and the nearer of their two aims, rad."""
        normal, vertex = Armature(self._armature[rows]).pose(angles)
        beam = 2.0 * np.sum(sun * normal, axis=-1, keepdims=True) * normal - sun
        aims = self._points.aims[rows]
        error = _angle(beam, aims - vertex)
        before = self._found[rows]
        older = np.isfinite(before).all(axis=-1)
        error[older] = np.minimum(error, _angle(beam, before - vertex))[older]
        at_aim = _angle(beam, aims - vertex) < NOTED
        self._found[rows[at_aim]] = aims[at_aim]
        return error


def _angle(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the angles between vectors (K, 3), rad."""
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.arctan2(cross, np.sum(a * b, axis=-1)))


def _sun_off(values: Sequence[float], site: Site, utc_s: float) -> float:
    """Return the angle between the suns of a reported site and of the plant's, rad."""
    if tuple(values) == site.numbers:
        return 0.0
    try:
        latitude, longitude, height, pressure, temperature = values
        other = Site(latitude, longitude, height, None if pressure < 0.0 else pressure, temperature)
        suns = np.stack([fast_vector(utc_s, each) for each in (other, site)])
    except (InputError, ValueError):
        return np.pi
    return float(_angle(suns[:1], suns[1:])[0])
