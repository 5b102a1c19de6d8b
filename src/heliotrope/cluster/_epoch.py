"""The epoch of a cluster: a new epoch invalidates all earlier frames."""

from collections import Counter

from heliotrope.cluster._exchange import Exchange
from heliotrope.cluster._reports import Reports
from heliotrope.cluster.memory import Kept
from heliotrope.cluster.timekeeping import Time
from heliotrope.safety import alarms

#: A new epoch begins after this many consecutive unexplained "duplicate" replies to commands,
#: counted over all local controllers or for one alone. For one alone, it begins at most once in
#: this many seconds, because a new epoch voids all commands in transit.
_OUT_OF_STEP, _REST = 3, 30


class Epoch:
    """Begins epochs, and decides from the local controllers' replies when a new one is needed.

    Parameters
    ----------
    kept
        Storage in which the epoch survives a restart.
    exchange
        Sends frames under the epoch.
    reports
        Receives alarms.
    present
        The time at the start. Without a state file, only the time ensures that the epoch is higher
        than in any earlier run.

    Attributes
    ----------
    kept
        Storage of the epoch.

    Raises
    ------
    OSError
        If the first epoch cannot be stored.
    """

    def __init__(self, kept: Kept, exchange: Exchange, reports: Reports, present: Time) -> None:
        self.kept, self._exchange, self._reports = kept, exchange, reports
        self._of_time = present.usable
        self._duplicates = 0
        self._of_one: Counter[int] = Counter()  # by the index of the local controller
        self._rest = 0
        self._storing = False
        self._next: int | None = None  # stored, but not yet in use
        exchange.begin_epoch(kept.start(int(present.gps_s) if self._of_time else 0))

    def taken(self, place: int) -> None:
        """Record that a local controller has accepted a command, so its numbering is in step."""
        self._duplicates = 0
        self._of_one.pop(place, None)

    def duplicate(self, place: int) -> None:
        """Record that a local controller replied "duplicate" to a new command.

        A single local controller is out of step after another sender has used the cluster's address
        with a later number.
        """
        self._duplicates += 1
        self._of_one[place] += 1

    def second(self) -> None:
        """Begin a new epoch if local controllers are out of step, or begin using a stored one."""
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
        """Have a new epoch stored; until then, the present epoch continues."""
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
        """Put the stored epoch into use.

        This happens only before SESSION, which sends the epoch to the local controllers.
        """
        if self._next is not None:
            self._exchange.begin_epoch(self._next)
            self._next = None
