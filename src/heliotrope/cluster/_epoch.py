"""The epoch of a cluster: a new epoch invalidates all earlier frames."""

from collections import Counter

from heliotrope.cluster._exchange import Exchange
from heliotrope.cluster._reports import Reports
from heliotrope.cluster.memory import Kept
from heliotrope.cluster.timekeeping import Time
from heliotrope.safety import alarms

#: A new epoch begins after this many consecutive unexplained "duplicate" answers to commands, of
#: all local controllers together or of one, but one by one only every so many seconds: it voids
#: the commands that are under way to all.
_OUT_OF_STEP, _REST = 3, 30


class Epoch:
    """Begins epochs, and judges by the answers of local controllers when one is needed.

    Parameters
    ----------
    kept
        Where the epoch outlasts a restart.
    exchange
        Sends under the epoch.
    reports
        Where alarms go.
    present
        The time at the start. Without a state file only the time makes the epoch higher than that
        of any earlier run.

    Attributes
    ----------
    kept
        As given.

    Raises
    ------
    OSError
        If the first epoch cannot be stored.
    """

    def __init__(self, kept: Kept, exchange: Exchange, reports: Reports, present: Time) -> None:
        self.kept, self._exchange, self._reports = kept, exchange, reports
        self._of_time = present.usable
        self._duplicates = 0
        self._of_one: Counter[int] = Counter()  # by the place of the local controller
        self._rest = 0
        self._storing = False
        self._next: int | None = None  # stored, and not in use yet
        exchange.begin_epoch(kept.start(int(present.gps_s) if self._of_time else 0))

    def taken(self, place: int) -> None:
        """Note that a local controller has taken a command: it is in step."""
        self._duplicates = 0
        self._of_one.pop(place, None)

    def duplicate(self, place: int) -> None:
        """Note that a local controller answered a new command with "duplicate".

        A single one is out of step after a frame that somebody else has sent under the cluster's
        address with a later number.
        """
        self._duplicates += 1
        self._of_one[place] += 1

    def second(self) -> None:
        """Begin an epoch if the local controllers are out of step, or one that is stored."""
        self._rest = max(0, self._rest - 1)
        single = max(self._of_one.values(), default=0) >= _OUT_OF_STEP and not self._rest
        if single:
            self._rest = _REST
        if single or self._duplicates >= _OUT_OF_STEP:
            self._begin(0)
        self._use()

    def time_known(self, present: Time) -> None:
        """Begin an epoch derived from the time, as soon as the time is known."""
        if not self._of_time:
            self._begin(int(present.gps_s))
        self._use()

    def _begin(self, at_least: int) -> None:
        """Have an epoch stored; until it is, the present one goes on."""
        if self._storing or self._next is not None:
            return
        self._storing, self._duplicates = True, 0
        self._of_one.clear()

        def stored(epoch: int, error: Exception | None) -> None:
            self._storing = False
            if error is not None:
                self._reports.alarm(alarms.STATE_UNWRITABLE.raised(problem=error))
                return
            self._next = epoch
            self._of_time = self._of_time or at_least > 0
            self._reports.clear(alarms.STATE_UNWRITABLE.ended())

        self.kept.begin(at_least, stored)

    def _use(self) -> None:
        """Begin the stored epoch: only before SESSION, which sends it to the local controllers."""
        if self._next is not None:
            self._exchange.begin_epoch(self._next)
            self._next = None
