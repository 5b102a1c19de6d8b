"""That no beam enters a keep-out volume: proven of commands before they go out, and looked at."""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.lcu.diagnosis import NUDGE
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.tracking import Status
from heliotrope.plant.aims import BeamCheck
from heliotrope.plant.authority import RefusedError
from heliotrope.plant.field_state import FieldState
from heliotrope.safety import Reading

Rows = npt.NDArray[np.intp]

#: Where beams go is looked at so often, s; who does not move, each so many times.
LOOK_PERIOD, TURNS = 1.0, 3
#: Steps between where a mirror stands and where it goes, from which on it moves.
_MOVES = 200
#: States in which a beam is out by command; what leads to safety is never held up.
_BEAM_OUT = (states.IDLE, states.TRACKING, states.SEARCHING)
#: States from which IDLE moves a mirror to its standby point straight away.
_TO_STANDBY = (states.TRACKING, states.SEARCHING, states.DEFOCUSED, states.IDLE)


class BeamError(RefusedError):
    """A command that would bring beams where none may be.

    Attributes
    ----------
    refusals
        Why, by the names of the heliostats.
    """

    def __init__(self, command: str, refusals: dict[str, str]) -> None:
        self.refusals = refusals
        first, text = next(iter(refusals.items()))
        more = f" (and {len(refusals) - 1} more)" if len(refusals) > 1 else ""
        super().__init__(f"{command} {first}{more}: {text}")


class Ways:
    """Says whose beams may not do what a command would make them do.

    What joins the receiver is looked at when its turn has come (see `Joiner`); the way from stow
    is the local controller's own.

    Parameters
    ----------
    beams, field
        Of the plant.
    aims, standbys
        As assigned, ENU, m, (N, 3); NaN where none was.
    sun
        Gives the unit vector to the sun now, (3,).
    """

    def __init__(
        self,
        beams: BeamCheck,
        field: FieldState,
        aims: FloatArray,
        standbys: FloatArray,
        sun: Callable[[], FloatArray],
    ) -> None:
        self._beams, self._field = beams, field
        self._aims, self._standbys, self._sun = aims, standbys, sun

    def check_points(
        self, name: str, rows: Rows, wanted: FloatArray, tracking: npt.NDArray[np.bool_]
    ) -> None:
        """Prove that heliostats (K,) may be given points (K, 3) by AIM or STANDBY.

        Raises
        ------
        BeamError
            If one of the beams may not go there.
        """
        start = np.where(tracking[:, None], self._aims[rows], self._standbys[rows])
        stopped, light = name == "AIM", self._sun()
        wrong = self._beams.problems(rows, wanted, light, start=start, stopped=stopped)
        if not stopped:
            wrong |= self._beams.glare(rows, wanted, self._standbys, light)
        if wrong:
            raise BeamError(name, wrong)

    def clear(
        self, name: str, values: Sequence[float], whom: tuple[str, ...], now: float
    ) -> tuple[tuple[str, ...], dict[str, str]]:
        """Return who may be sent a command that moves mirrors, and why the others may not.

        Raises
        ------
        BeamError
            If nobody may.
        """
        if not self._beams.volumes or name not in ("JOG", "GOTO", "DIAGNOSE", "IDLE"):
            return whom, {}
        rows = np.array([self._field.place(n) for n in whom], dtype=np.intp)
        # Of whom nothing is known here, the local controller decides.
        rows = rows[np.isfinite(self._field.counted_at[rows])]
        light = self._sun()
        wrong: dict[str, str] = {}
        if name == "IDLE":
            rows = rows[self._field.among(_TO_STANDBY, now)[rows]]
            known = np.isfinite(self._standbys[rows]).all(axis=-1)
            wrong = {
                self._field.names[row]: "its standby point is not known here; give it one "
                "(STANDBY) first, or stow it"
                for row in rows[~known]
            }
            rows, path = self._to_standby(rows[known], light)
        else:
            path = self._by_counts(name, values, rows)
        wrong |= self._beams.moving(rows, path, light)
        if wrong and len(wrong) == len(whom):
            raise BeamError(name, wrong)
        return tuple(n for n in whom if n not in wrong), wrong

    def _to_standby(self, rows: Rows, light: FloatArray) -> tuple[Rows, FloatArray]:
        counts = self._field.counts(rows)
        found = self._beams.poses(rows, self._standbys[rows], light, counts)
        path = np.stack([self._angles(rows, counts), found.chosen(found.angles)], axis=-2)
        good = found.chosen(found.status) == Status.OK
        return rows[good], path[good]

    def _by_counts(self, name: str, values: Sequence[float], rows: Rows) -> FloatArray:
        """Return the angles that a command goes through, from where the axes stand, (K, W, 2)."""
        begin = self._angles(rows, self._field.counts(rows))
        if name == "DIAGNOSE":
            nudges = NUDGE * np.array([(1, 0), (-1, 0), (0, 0), (0, 1), (0, -1)])
            return np.stack([begin, *(begin + nudge for nudge in nudges)], axis=-2)
        ends = np.broadcast_to(np.asarray(values, dtype=np.float64), (len(rows), 2))
        if name == "JOG":
            axis, steps = int(values[0]), values[1]
            ends = self._field.goals(rows)
            if axis < 2:  # another is refused by the local controller
                ends[:, axis] += steps
        return np.stack([begin, self._angles(rows, ends)], axis=-2)

    def _angles(self, rows: Rows, counts: FloatArray) -> FloatArray:
        angles: FloatArray = Drive(self._beams.drives.table[rows]).angles(counts)
        return angles


class Lookout:
    """Looks once a second where beams are and go, and says whose would enter a volume.

    Commands are proven before they go out; this sees what comes of them: counts that are not where
    they were thought, parameters that changed, a local controller that does something else. Who
    moves is looked at each second, the others in turn.

    Parameters
    ----------
    beams, field, sun
        As of `Ways`.
    """

    def __init__(self, beams: BeamCheck, field: FieldState, sun: Callable[[], FloatArray]) -> None:
        self._beams, self._field, self._sun = beams, field, sun
        self._names: frozenset[str] = frozenset()
        self._turn = 0
        self._at = -np.inf

    def readings(self, now: float) -> dict[tuple[str, str], Reading]:
        """Return 1 for each heliostat whose beam is in a volume or goes there, 0 for the rest."""
        if not self._beams.volumes:
            return {}
        if now - self._at >= LOOK_PERIOD:
            self._at = now
            self._look(now)
        found = {("keep_out_predicted", name): Reading(1.0, now) for name in self._names}
        found["keep_out_predicted", ""] = Reading(0.0, now)
        return found

    def _look(self, now: float) -> None:
        field = self._field
        out = np.flatnonzero(field.among(_BEAM_OUT, now) & np.isfinite(field.counted_at))
        self._turn = (self._turn + 1) % TURNS
        begin, end = field.counts(out), field.goals(out)
        moves = (np.abs(end - begin) > _MOVES).any(axis=-1)
        chosen = moves | (out % TURNS == self._turn)
        rows = out[chosen]
        drives = Drive(self._beams.drives.table[rows])
        path = np.stack([drives.angles(begin[chosen]), drives.angles(end[chosen])], axis=-2)
        wrong = self._beams.moving(rows, path, self._sun())
        looked = {field.names[row] for row in rows}
        still = {field.names[row] for row in out} - looked
        self._names = frozenset(wrong) | (self._names & still)
