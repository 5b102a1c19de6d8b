"""Losses: heliostats that left the receiver or their standby point without an order of the plant.

Whether a heliostat was ordered off, by an operator, a visit, the safety table or automatic control,
follows from the orders that the plant has sent (`plant.field.ledger`). A heliostat that lost its
cluster, its sun vector or its supply turns away by itself. Automatic control may raise a few such
heliostats again. After the loss of a large number it waits for an operator, because the cause is
unknown.
"""

import math
from collections.abc import Callable
from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt

from heliotrope.errors import HeliotropeError
from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.safety import Severity, alarms
from heliotrope.store.records import Records

#: Losses within this time count together; until it is over, no lost heliostat is raised again, s.
SPAN = 30.0

Mask = npt.NDArray[np.bool_]
_NONE: Mask = np.zeros(1, dtype=np.bool_)


class Losses:
    """Losses of wanted heliostats, and the wait for an operator after a large loss.

    Parameters
    ----------
    plant, log
        The controller, and the logbook for the alarm.
    most
        Number of heliostats that may be lost within `SPAN` without waiting for an operator.
    records
        Store of alarms. With a store, a wait survives a restart, and an emergency that was active
        when the last program ended starts a wait; None: no store.
    stop
        Called when a wait begins.

    Attributes
    ----------
    reason
        Why automatic control waits for an operator; empty if it does not wait.
    """

    def __init__(
        self,
        plant: PlantController,
        log: Logbook,
        most: int,
        records: Records | None,
        stop: Callable[[], None],
    ) -> None:
        self._plant, self._log, self._most, self._stop = plant, log, most, stop
        count = len(plant.field)
        self._up: Mask = np.zeros(count, dtype=np.bool_)
        self._seen: Mask = np.zeros(count, dtype=np.bool_)
        #: When heliostats last reported there, monotonic s.
        self._up_at = np.full(count, -math.inf)
        self._lost_at = np.full(count, -math.inf)
        self._live_at = np.full(count, plant.now())
        self.reason = ""
        for alarm in _standing(records):
            self._wait(alarm)

    def look(self, wanted: Mask, at_stow: Mask = _NONE) -> Mask:
        """Return a mask of the wanted heliostats that were lost since the last check, (N,).

        A heliostat that is IDLE at its stow position does not count as lost when it is stowed.
        Heliostats under diagnosis ``at_stow``, (N,), which move about that position, do not count
        either.
        """
        field, now = self._plant.field, self._plant.now()
        there = field.among((states.IDLE,), now) & (field.rows["flags"] & meanings.AT_STOW != 0)
        live, up = field.live(now), field.among(states.BEAM_OUT, now) & ~there & ~at_stow
        # Only an order locks a heliostat: an operator's, or one from a visit that writes
        # parameters.
        held = field.among((states.LOCKED,), now)
        lost: Mask = live & ~up & ~held & self._up
        lost |= ~self._seen & field.among(states.LEAVING, now)
        lost &= wanted & ~self._plant.ledger.off(self._up_at, now)
        # A heliostat that is silent or locked keeps its last observed state.
        self._up = np.where(live & ~held, up, self._up)
        self._up_at[live & up] = field.heard[live & up]
        self._seen |= live
        self._lost_at[lost] = now
        if lost.any():
            # A heliostat that was silent may have been lost at any time since its last report.
            # Heliostats since left to the operators count too.
            since = float(self._live_at[lost].min())
            together = int((self._lost_at > since - SPAN).sum())
            if together > self._most:
                self._wait_for(
                    f"{together} heliostats left the receiver without an order, first detected"
                )
        self._live_at[live] = now
        return lost

    def settling(self) -> Mask:
        """Return a mask of the heliostats lost recently that must not be raised yet, (N,)."""
        return np.asarray(self._plant.now() - self._lost_at < SPAN)

    def resume(self) -> None:
        """End the wait, because an operator has checked the field."""
        self._lost_at[:] = -math.inf
        if self.reason:
            self.reason = ""
            self._log.take_alarm(alarms.RESUME_NEEDED.ended())

    def _wait_for(self, what: str) -> None:
        since = datetime.fromtimestamp(self._plant.clock.utc().timestamp(), UTC)
        self._wait(alarms.RESUME_NEEDED.line(what=what, since=f"{since:%H:%M:%S}"))

    def _wait(self, text: str) -> None:
        if not self.reason:
            self._stop()
            self.reason = text
            kind = alarms.RESUME_NEEDED
            self._log.take_alarm(alarms.Alarm(kind.name, "", kind.severity, text))


def _standing(records: Records | None) -> list[str]:
    """Return the text of the wait that was active when the last program ended."""
    if records is None:
        return []
    try:
        known = records.alarms(standing=True)
    except HeliotropeError:
        return []  # the logbook names a store that fails
    standing = [alarm for alarm in known if alarm.cleared is None]
    name = alarms.RESUME_NEEDED.name
    waits = [alarm.text for alarm in standing if alarm.condition == name]
    ended = [a for a in standing if a.severity is Severity.EMERGENCY and not a.subject]
    texts = [
        alarms.RESUME_NEEDED.line(
            what=f"{alarm.condition} was active when the plant's program last ended; it was raised",
            since=f"{datetime.fromtimestamp(alarm.raised, UTC):%H:%M:%S}",
        )
        for alarm in ended
    ]
    return [*waits, *texts][:1]
