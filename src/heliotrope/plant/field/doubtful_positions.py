"""Heliostats with doubtful step counts or parameters, and what confirms them.

A power failure during motion may leave the step counts of a local controller wrong by up to 1,000
steps, which it reports as COUNTS_DOUBTFUL until ZERO. Its beam may then be off its aim without any
other sign. Such a heliostat is named, and kept off the receiver until a photograph on a target or
an operator has confirmed its position. A confirmation is valid only until the next boot, because
another power failure may make the counts wrong again. Four other groups are kept off in the same
way: heliostats with new parameters that a calibration has not yet verified, heliostats whose
parameters a drone flight contradicts, heliostats whose drives stall, and all heliostats while no
witness confirms the sun.
"""

import contextlib
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

import numpy as np

from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray
from heliotrope.lcu import names as meanings
from heliotrope.links.messages import ClusterStatus
from heliotrope.plant import refusals
from heliotrope.plant.field.part import Part
from heliotrope.plant.field.state import FieldState, Mask
from heliotrope.safety import Alarm, alarms


class DoubtfulPositions(Part):
    """Doubts of local controllers about their step counts.

    Parameters
    ----------
    field
        State of the field.
    design
        Heliostats in doubt may aim at its targets, because a photograph there resolves the doubt.
    tell
        Called with each alarm.
    unwitnessed
        Function that returns the reason why no heliostat may join a receiver; None if heliostats
        may join. See `witnesses`.
    stalled
        Heliostats whose drives stall; see `drive_checks`.

    Attributes
    ----------
    standing
        Heliostats whose counts are in doubt, (N,).
    """

    def __init__(
        self,
        field: FieldState,
        design: Plant,
        tell: Callable[[Alarm], None],
        unwitnessed: Callable[[], str | None],
        stalled: Collection[str],
    ) -> None:
        self._unwitnessed, self._stalled = unwitnessed, stalled
        self._field, self._tell = field, tell
        self._receivers = np.array([surface.center for surface in design.receivers]).reshape(-1, 3)
        self._targets = np.array([surface.center for surface in design.targets]).reshape(-1, 3)
        self._reach = np.array(
            [np.hypot(surface.width, surface.height) for surface in design.targets]
        )
        #: Rows whose new parameters are being verified.
        self._unverified: set[int] = set()
        #: Rows that a flight observed far from the pose that their parameters predict.
        self._off_place: frozenset[int] = frozenset()
        #: Boot count of each local controller when its position was confirmed, -1 before.
        self._confirmed = np.full(len(field), -1, dtype=np.int64)
        self.standing: Mask = np.zeros(len(field), dtype=np.bool_)

    def on_status(self, cluster: str, status: ClusterStatus, now: float) -> None:
        """Evaluate the heliostats of a cluster from its status."""
        del status, now
        self._judge([self._field.index[name] for name in self._field.members[cluster]])

    def confirm(self, heliostat: str, boots: int | None = None) -> None:
        """Accept the step counts of a heliostat as correct until its next boot.

        Parameters
        ----------
        heliostat
            Name.
        boots
            Its boot count when its position was observed; None: the last one reported.
        """
        row = self._field.place(heliostat)
        self._confirmed[row] = int(self._field.rows["boots"][row]) if boots is None else boots
        self._judge([row])

    @contextlib.contextmanager
    def unverified(self, heliostat: str) -> Iterator[None]:
        """Keep a heliostat off the receiver while its new parameters are being verified."""
        row = self._field.place(heliostat)
        self._unverified.add(row)
        try:
            yield
        finally:
            self._unverified.discard(row)

    def verifying(self, heliostats: Iterable[str]) -> tuple[str, ...]:
        """Return the heliostats whose new parameters are being verified."""
        return tuple(name for name in heliostats if self._field.place(name) in self._unverified)

    def keep_off(self, heliostats: Iterable[str]) -> None:
        """Keep heliostats off the receiver that a flight observed far from their expected place.

        Heliostats named in an earlier call, but not in this one, may join the receiver again.
        """
        self._off_place = frozenset(self._field.place(name) for name in heliostats)

    def _judge(self, rows: list[int]) -> None:
        nodes = self._field.rows[rows]
        # Entirely unknown counts are a separate fault, which only ZERO ends.
        doubtful = nodes["flags"] & meanings.COUNTS_DOUBTFUL != 0
        doubtful &= nodes["flags"] & meanings.COUNTS_UNKNOWN == 0
        doubtful &= nodes["boots"] != self._confirmed[rows]
        changed = np.flatnonzero(doubtful != self.standing[rows])
        self.standing[rows] = doubtful
        for i in changed:
            name, kind = self._field.names[rows[i]], alarms.COUNTS_DOUBTFUL
            self._tell(kind.raised(name) if doubtful[i] else kind.ended(name))

    def reasons(self, names: Sequence[str], points: FloatArray) -> list[str | None]:
        """Return why each heliostat may not join the receiver at its point; None if it may.

        The points are (K, 3).
        """
        rows = [self._field.place(name) for name in names]
        unverified, off_place = (
            np.isin(rows, list(s)) for s in (self._unverified, self._off_place)
        )
        blocked = self._unwitnessed()
        stalled = np.array([name in self._stalled for name in names], dtype=np.bool_)
        doubted = self.standing[rows] | unverified | off_place | stalled | bool(blocked)
        if not doubted.any():
            return [None] * len(names)
        texts = np.full(len(names), blocked, dtype=np.object_)
        texts[self.standing[rows]] = refusals.COUNTS_DOUBTFUL.text
        texts[off_place] = refusals.SEEN_ASTRAY.text
        texts[stalled] = refusals.DRIVE_STALLED.text
        texts[unverified] = refusals.NOT_VERIFIED.text
        texts[self._on_target(points)] = None
        reasons: list[str | None] = texts.tolist()
        return reasons

    def _on_target(self, points: FloatArray) -> Mask:
        """Return a mask of the points (K, 3) at a target and closer to it than to a receiver."""
        apart, away = (
            np.linalg.norm(points[:, None] - centers, axis=-1)
            for centers in (self._targets, self._receivers)
        )
        near = apart.min(axis=1, initial=np.inf) < away.min(axis=1, initial=np.inf)
        return np.asarray(near & (apart <= self._reach).any(axis=1))
