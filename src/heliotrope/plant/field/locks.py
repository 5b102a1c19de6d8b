"""Visit locks: heliostats that a visit has locked to write their parameters.

A visit unlocks its heliostats itself. If it cannot, because an emergency is active, an operator's
order has taken the heliostat out of the visit or the visit was cancelled, the plant unlocks them as
soon as it may (`giving_back`). A local controller stays LOCKED during DEFOCUS and STOW, and UNLOCK
would stop its motion; a heliostat that was ordered off is therefore unlocked only at stow.

A lock is stored on disk before it is applied (`assigned.HELD`). A program that finds such a lock
does not know what was ordered after the previous program ended, so it sends the heliostat to stow
and unlocks it there. After a longer time an operator may have locked it, through a program whose
store was lost; in that case only an operator unlocks it.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime

from heliotrope.lcu import messages, states
from heliotrope.lcu import names as meanings
from heliotrope.plant.field.assigned import Held, Places
from heliotrope.plant.field.ledger import LOCKING, STOWING, Ledger
from heliotrope.plant.field.state import FieldState

#: Pause before an order is repeated, s; it doubles each time, up to the longest.
_AGAIN, _LONGEST = 3.0, 300.0
#: Age of a lock at program start above which only an operator removes it, s.
CERTAIN = 3600.0
#: Placeholder for an order that only an operator may issue.
_WAIT = "wait"


@dataclass
class _Lock:
    """A lock: its mandate, the next attempt, and whether it was released.

    ``at`` is when the lock was applied, POSIX s; ``recalled`` says that an earlier program applied
    it.
    """

    token: int
    due: float
    at: float
    pause: float = _AGAIN
    released: bool = False
    recalled: bool = False
    uncertain: bool = False


class Locks:
    """The heliostats that visits have locked, by name.

    Parameters
    ----------
    field, ledger
        State of the field, and the orders sent.
    utc
        Function that returns the time, POSIX s.
    """

    def __init__(self, field: FieldState, ledger: Ledger, utc: Callable[[], float]) -> None:
        self._field, self._ledger, self._utc = field, ledger, utc
        self._locked: dict[str, _Lock] = {}

    @property
    def names(self) -> frozenset[str]:
        """The heliostats that a visit has locked, or that are waiting to be unlocked."""
        return frozenset(self._locked)

    def take(self, heliostats: Iterable[str], token: int, now: float) -> None:
        """Record that heliostats are locked under the mandate of a visit."""
        at = self._utc()
        self._locked.update({name: _Lock(token, now, at) for name in heliostats})

    def recall(self, held: Places, now: float) -> None:
        """Continue with the locks that an earlier program left; see `record`."""
        self._ledger.sent("LOCK", tuple(held), now)  # at the latest
        for name, (at, *_) in held.items():
            sure = 0.0 <= self._utc() - at <= CERTAIN
            lock = _Lock(0, now, at, recalled=True, uncertain=not sure)
            self._locked[name] = lock

    def record(self, heliostats: Iterable[str], *, visit: bool) -> Held:
        """Return the record to store before a visit or an operator locks heliostats."""
        place = (self._utc(), 0.0, 0.0) if visit else None
        return {"LOCKED": dict.fromkeys(heliostats, place)}

    def reason(self, heliostat: str, visit: str, held: str = "") -> str:
        """Return in words why a heliostat is LOCKED, since when, and until when.

        ``visit`` names the visit that holds the heliostat, if any. ``held`` is the reason why its
        cluster may begin no motion now, if there is one.
        """
        lock = self._locked.get(heliostat)
        if lock is None:
            return "locked by an order; it stays locked until someone sends UNLOCK"
        since = f"since {datetime.fromtimestamp(lock.at, UTC):%H:%M:%S} UTC"
        if lock.uncertain:
            return (
                f"a calibration visit locked it before the plant's program started ({since}), so "
                f"long ago that someone may have locked it since; ask, then send UNLOCK"
            )
        if visit:
            return (
                f"{visit} locked it {since}; it stays locked until its parameters are written "
                f"and read back"
            )
        holder = (
            "a calibration visit that was cut off when the plant's program ended"
            if lock.recalled
            else "a visit"
        )
        place = "at stow, " if self._off(heliostat, lock) else ""
        return (
            f"{holder} has left it locked ({since}); the plant unlocks it {place}as soon as "
            "motions are accepted and someone has the command authority"
            f"{held and f'; now they are not: {held}'}"
        )

    def forget(self, heliostats: Iterable[str]) -> None:
        """Forget heliostats that an operator locks, because the operator will unlock them."""
        for name in heliostats:
            self._locked.pop(name, None)

    def due(
        self, now: float, released: Callable[[int, Iterable[str]], frozenset[str]]
    ) -> dict[str, list[str]]:
        """Return the heliostats that must be sent an order now, by name of the order.

        Parameters
        ----------
        now
            Monotonic s.
        released
            Function that returns the heliostats that no visit holds any longer, because the visit
            has ended or an operator has ordered something else.
        """
        orders: dict[str, list[str]] = {}
        fresh = self._ledger.reported(LOCKING) & self._field.live(now)
        for name, lock in list(self._locked.items()):
            if not fresh[self._field.index[name]] or not released(lock.token, (name,)):
                continue
            what = self._next(name, lock)
            if not what:
                del self._locked[name]
            elif now >= lock.due and what != _WAIT:
                lock.due = now + lock.pause
                orders.setdefault(what, []).append(name)
        return orders

    def _next(self, name: str, lock: _Lock) -> str | None:
        """Return the next order for a heliostat; None once its lock is removed.

        If the owner of the lock is unknown, no order is due until an operator acts.
        """
        node = self._field.rows[self._field.index[name]]
        if node["state"] != states.LOCKED:
            # The heliostat stays where it was unlocked until it is sent to its standby point.
            return "IDLE" if lock.released and node["state"] == states.IDLE else None
        if lock.uncertain:
            return _WAIT
        return (
            "STOW" if self._off(name, lock) and not node["flags"] & meanings.AT_STOW else "UNLOCK"
        )

    def sent(self, what: str, heliostats: Iterable[str]) -> None:
        """Note an order that was sent; it is repeated if the heliostat does not obey."""
        for name in heliostats:
            lock = self._locked[name]
            if what == "UNLOCK":
                lock.released, lock.pause = True, min(2.0 * lock.pause, _LONGEST)
            if what == "IDLE":
                del self._locked[name]

    def under_way(self, heliostats: Iterable[str]) -> frozenset[str]:
        """Return the heliostats that have been sent to stow since they were locked.

        They need no further order.
        """
        stowing = self._ledger.later(STOWING, LOCKING)
        return frozenset(name for name in heliostats if stowing[self._field.index[name]])

    def _off(self, name: str, lock: _Lock) -> bool:
        """Return whether a heliostat may have been ordered off since it was locked."""
        later = self._ledger.later(messages.SAFE, LOCKING)
        return lock.recalled or bool(later[self._field.index[name]])
