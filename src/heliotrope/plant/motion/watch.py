"""Monitors beams: in a keep-out volume or heading for one, or stray on a receiver."""

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.plant.motion.defocusing import order_out
from heliotrope.plant.motion.proofs import PathProofs
from heliotrope.plant.motion.stray_beams import TURNS, StrayBeams
from heliotrope.safety import Act, Reading

Rows = npt.NDArray[np.intp]

#: Interval between two checks of the beams, s.
CHECK_PERIOD = 1.0
#: An approach rotates an axis by more than this only when leaving stow; used if stow is unknown,
#: rad.
_FROM_STOW = 0.15


class BeamWatch:
    """Monitors the beams of all heliostats.

    Monitoring detects what a check in advance cannot: wrong counts, changed parameters, a local
    controller that disobeys, and the motion of the sun, which moves the beam of a heliostat at
    rest. Every heliostat is checked, whatever its state, if its step counts have ever been known;
    if they are unknown or the heliostat is silent, its last reported pose is assumed. Moving
    heliostats are checked each second, all other heliostats in turn.

    Parameters
    ----------
    proofs
        Proofs of commands; their paths, field, points and sun are used here too.

    Attributes
    ----------
    proofs
        As given.
    stray
        Monitor of beams on a receiver that were not sent there.
    """

    def __init__(self, proofs: PathProofs) -> None:
        self.proofs, self._check = proofs, proofs.paths.check
        self._paths, self._field = proofs.paths, proofs.field
        self.stray = StrayBeams(proofs.paths, proofs.field, proofs.points, proofs.sun)
        self._entering: frozenset[str] = frozenset()
        self._turn = 0
        self._at = -np.inf

    @property
    def watched(self) -> frozenset[str]:
        """Names of the readings: one each for keep-out volumes and receivers, if there are any."""
        surfaces = {"keep_out_predicted": self._check.volumes, "beam_unsent": self._check.solids}
        return frozenset(name for name, places in surfaces.items() if places)

    def readings(self, now: float) -> dict[tuple[str, str], Reading]:
        """Return 1 for each heliostat whose beam is where it may not be, and 0 for the rest.

        Such a beam is in a volume, heading for a volume, or stray on a receiver. The beams are
        checked once a second; between two checks, the last result counts.
        """
        if now - self._at >= CHECK_PERIOD:
            self._at = now
            if self._check.volumes:
                self._check_volumes(now)
            if self.stray.watches:
                self.stray.check(now)
        named = {"keep_out_predicted": self._entering, "beam_unsent": self.stray.shining}
        values = {(what, ""): Reading(0.0, now) for what in self.watched}
        return values | {
            (what, name): Reading(1.0, now) for what in self.watched for name in named[what]
        }

    def order_out(self, name: str, *, again: bool) -> Act:
        """Return the order, DEFOCUS or STOW, that takes a beam out of a volume or off a receiver.

        Parameters
        ----------
        name
            Name of the heliostat.
        again
            Whether the heliostat has been ordered off before, but its beam is still there.
        """
        row = self._field.place(name)
        if name not in self._entering:
            stray = name in self.stray.shining
            return self.stray.order_out(name, again=again) if stray else Act.DEFOCUS
        state = int(self._field.rows["state"][row])
        if state == states.STOWING or (again and self._stands(row)) or self.turned(name):
            return Act.STOW
        points, counts = self.proofs.points, self._field.posed[row]
        aim, standby = points.aims[row], points.standbys[row]
        return order_out(self._paths, row, counts, self.proofs.sun(0.0), state, aim, standby)

    def turned(self, name: str) -> bool:
        """Return whether a beam rests where it may not be, and DEFOCUS would not move it."""
        if name not in self._entering and name not in self.stray.shining:
            return False
        row = self._field.place(name)
        off = self._field.rows["state"][row] == states.DEFOCUSED or self._field.turned[row]
        return bool(off and self._stands(row))

    def _stands(self, row: int) -> bool:
        return not self.proofs.moving(np.array([row])).any()

    def _check_volumes(self, now: float) -> None:
        field, check = self._field, self._check
        self._turn = (self._turn + 1) % TURNS
        every = np.flatnonzero(np.isfinite(field.posed_at))
        state, begin = field.rows["state"][every], field.posed[every]
        goes = field.sure(now)[every] & np.not_equal(state, states.STOWING)
        end = np.where(goes[:, None], field.goals(every), begin)
        moves = goes & self.proofs.moving(every)
        chosen = moves | (every % TURNS == self._turn)
        rows, moves, state = every[chosen], moves[chosen], state[chosen]
        begin, end = begin[chosen], end[chosen]
        light = self.proofs.sun(0.0)
        # A commanded motion is checked along its whole path. Of every other motion only the present
        # pose and the end are checked, because a path to safety is never held up.
        follows = moves & np.isin(state, states.BEAM_OUT)
        turns = follows & self._leaves_stow(rows, state, begin, end)
        both, ends = follows & ~turns, moves & ~follows
        stand = np.concatenate([rows[~follows], rows[ends]])
        at = self._paths.angles(stand, np.concatenate([begin[~follows], end[ends]]))
        inside = check.moving(stand, np.repeat(at[:, None], 2, axis=1), light)
        path = self._paths.turns(rows[turns], begin[turns], end[turns])
        inside |= check.moving(rows[turns], path, light)
        path = self._paths.motion(rows[both], begin[both], end[both], ramps=False)
        inside |= check.moving(rows[both], path, light)
        checked = {field.names[row] for row in rows}
        self._entering = frozenset(inside) | (self._entering - checked)

    def _leaves_stow(
        self, rows: Rows, state: npt.NDArray[np.integer], begin: FloatArray, end: FloatArray
    ) -> npt.NDArray[np.bool_]:
        """Return a mask of approaches (K,) that leave stow: one axis has not moved yet."""
        every, other = np.arange(len(rows)), 1 - self._paths.azimuth[rows]
        stow = self._paths.stow[rows][every, other]
        turn = self._paths.angles(rows, end) - self._paths.angles(rows, begin)
        far = np.abs(turn).max(axis=-1) > _FROM_STOW
        far = np.where(np.isfinite(stow), begin[every, other] == stow, far)
        return np.asarray(np.equal(state, states.APPROACHING) & far)
