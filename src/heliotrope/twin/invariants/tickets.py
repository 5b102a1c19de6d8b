"""The observer of tickets: the outcome of each command must be reported in time.

A ticket states for each heliostat how far its command has progressed. While the plant program runs,
a heliostat must have acknowledged the command, or the ticket must have ended for it, within a time
limit of the observer's own, whatever has failed; commands that wait for their turn to join are
exempt. If the command has failed, the ticket must say why (invariant 16). Every ticket ends, and
DONE is true: the heliostat has been in the state that its command requests (L2).
"""

from collections.abc import Mapping

from heliotrope.lcu import states
from heliotrope.links.messages import Stage
from heliotrope.plant.orders.authority import Person
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.twin.invariants._account import HeliostatAccount
from heliotrope.twin.invariants.invariants import ASKED, L2, Judge

#: A command that no heliostat has acknowledged must end within this, s; its lifetime is 10 s.
ENDS_WITHIN = 20.0
#: Every ticket must end within this, except parameter tickets, which wait for a safe position, s.
OVER_WITHIN = 300.0
#: A heliostat may have left the state this long before the command was accepted, since reports may
#: be this old, s.
_REPORTED = 2.2
#: States that result from orders that anyone may give; a locked heliostat stays locked. A heliostat
#: in FAULT has obeyed STOW if it truly is at stow.
_SAFE = {
    "DEFOCUS": (states.DEFOCUSED, states.STOWING, states.STOWED, states.LOCKED, states.FAULT),
    "STOW": (states.STOWED, states.LOCKED),
}
#: Commands that may wait for their turn or for a safe position, and the stages of a command in
#: progress.
_WAIT = ("TRACK", "REFOCUS", "SEARCH", "PARAMETERS")
_UNDER_WAY = (None, Stage.ACCEPTED, Stage.SENT)
#: Minimum length of a reason, characters.
_REASON = 8


class TicketObserver(Judge):
    """Observes the tickets of operators.

    Parameters
    ----------
    start
        Zero of the times that it reports, s.
    accounts
        Accounts of the heliostats, by name.

    """

    def __init__(self, start: float, accounts: Mapping[str, HeliostatAccount]) -> None:
        super().__init__(start)
        self._accounts = accounts
        self._open: list[tuple[float, Ticket]] = []
        self._stood_at = start

    def on_accepted(
        self, person: Person, token: int, ticket: Ticket, what: str, now: float
    ) -> None:
        """Record the ticket of a command that the plant has accepted."""
        del person, token, what
        self._open.append((now, ticket))

    def on_safe(self, person: Person, ticket: Ticket, what: str, now: float) -> None:
        """Record the ticket of a DEFOCUS or STOW, which anyone may order."""
        del person, what
        self._open.append((now, ticket))

    def on_end(self, now: float) -> None:
        """Record that the plant program, and its tickets with it, has ended."""
        del now
        self._open.clear()

    def look(self, now: float, *, runs: bool) -> None:
        """Judge all tickets.

        ``runs`` means that the plant program is running and can write its records.
        """
        if not runs:
            self._stood_at = now
            return
        for at, ticket in self._open:
            passed = now - max(at, self._stood_at)
            over = ticket.finished or ticket.name == "PARAMETERS" or passed <= OVER_WITHIN
            self.check(L2, over, now, "plant", f"{ticket.text} after {passed:.0f} s")
            self._true(at, ticket, now)
            for name in ticket.heliostats:
                stage = ticket.stage(name)
                waits = ticket.name in _WAIT or stage not in _UNDER_WAY
                what = "waiting" if stage is None else stage.value
                saw = f"{ticket.name} of {name} is {what} {passed:.1f} s after it was accepted"
                self.check(16, waits or passed <= ENDS_WITHIN, now, "plant", saw)
                failed = stage in (Stage.FAILED, Stage.REFUSED)
                why = ticket.refusals.get(name, "")
                saw = f"{ticket.name} of {name} is {what}, and the reason is {why!r}"
                self.check(16, not failed or len(why) >= _REASON, now, "plant", saw)
        self._open = [(at, unfinished) for at, unfinished in self._open if not unfinished.finished]

    def _true(self, at: float, ticket: Ticket, now: float) -> None:
        """Check that a heliostat reported as DONE has been in the requested state."""
        asked = ASKED.get(ticket.name) or _SAFE.get(ticket.name)
        if asked is None:
            return
        for name in ticket.heliostats:
            if ticket.stage(name) is Stage.DONE and name not in ticket.refusals:
                account = self._accounts[name]
                reached = account.was_in(asked, at - _REPORTED)
                reached = reached or (ticket.name == "STOW" and account.stands_at_stow())
                saw = f"{ticket.name} of {name} is done, but it is {states.STATES[account.state]}"
                self.check(L2, reached, now, "plant", saw)
