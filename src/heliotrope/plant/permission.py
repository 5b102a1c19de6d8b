"""Permission: which heliostats may be given a command now, by whom, and why others may not."""

from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType

from heliotrope.files.disk import Work
from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.plant import refusals
from heliotrope.plant.audit import AuditError
from heliotrope.plant.authority import Authority, Person
from heliotrope.plant.beam_watch import BeamError
from heliotrope.plant.doubts import Doubts
from heliotrope.plant.emergency import UNPROVEN, Sentinel
from heliotrope.plant.field_state import FieldState
from heliotrope.plant.given import Given
from heliotrope.plant.identity import Identities
from heliotrope.plant.lockouts import Lockouts
from heliotrope.plant.ordered import JOINING, MOTIONS
from heliotrope.plant.orders import PlantOrders
from heliotrope.plant.parameters import ParameterSync
from heliotrope.plant.rivals import Rivals
from heliotrope.plant.tickets import Ticket

#: Commands that move nothing; they take no heliostat out of a visit.
SETTINGS = frozenset({"LOCK_AIM", "ROUGH"})
#: Commands that send beams to their aims.
_TO_AIMS = JOINING | {"AIM"}
#: Commands that bring beams to standby.
_TO_STANDBY = ("APPROACH", "IDLE")
#: States in which beams are off.
_AWAY = (states.STOWED, states.DEFOCUSED)
#: Commands after which a heliostat that turns away or goes to stow stands still.
_STILL = ("UNLOCK", "CLEAR_FAULT")
#: Row of the safety table for beams that are not where they were sent, and those by which beams
#: are sent off from where they may not be.
ASTRAY = "pointing_disagrees"
_SENT_OFF = ("keep_out_predicted", "beam_unsent")


class Permission:
    """Decides who may command what now; where beams may go is `BeamWatch`'s matter.

    Parameters
    ----------
    field, authority, orders
        The plant's.
    sentinel, rivals
        Whether new motion may begin now.
    identities, sync, doubts
        Whether a heliostat is what it seems to be.
    lockouts
        Locks of persons.
    given
        Points that were given, and whether they were taken.
    """

    def __init__(
        self,
        field: FieldState,
        authority: Authority,
        orders: PlantOrders,
        sentinel: Sentinel,
        rivals: Rivals,
        identities: Identities,
        sync: ParameterSync,
        doubts: Doubts,
        lockouts: Lockouts,
        given: Given,
    ) -> None:
        self._field, self._authority, self._orders = field, authority, orders
        self._sentinel, self._rivals = sentinel, rivals
        self._identities, self._sync, self._doubts = identities, sync, doubts
        self._lockouts, self._given = lockouts, given

    def able(
        self, name: str, names: tuple[str, ...], token: int = 0
    ) -> tuple[tuple[str, ...], dict[str, str]]:
        """Return the heliostats that may be given a command, and why the others may not.

        Everything but LOCK needs a board that is the heliostat's; a motion, the wanted parameters;
        joining, its last aim, and that no alarm bars the heliostat. One whose beam went astray does
        not come back to standby either, before its alarm is acknowledged: its beam would go astray
        again. Nor is one stopped that is just being sent off. A setting that would disturb a
        measurement waits for the end of the visit, unless it is given under the visit's ``token``.

        Raises
        ------
        RefusedError
            If none may; the reason of the whole plant or of a cluster comes before their own.
        """
        held = self.held(name, names)
        wrong = self.barred(name, names, token) | held
        if wrong and len(wrong) == len(names):
            if len(held) < len(names):
                raise BeamError(name, wrong)
            self.refuse_now(name, names)
        return tuple(n for n in names if n not in wrong), wrong

    def barred(
        self,
        name: str,
        names: tuple[str, ...],
        token: int = 0,
        new_aims: FloatArray | None = None,
    ) -> dict[str, str]:
        """Return the heliostats that may not be given a command, and their own reasons; see `able`.

        ``new_aims`` (K, 3) are points that they get before they join them; None: their last aims
        count, and whether they were taken.
        """
        wrong = {} if name == "LOCK" else self._identities.barred(names)
        if name in SETTINGS:
            wrong = wrong | self._visited(token, names)
        if name in MOTIONS:
            wrong = self._sync.differing(names) | self._orders.to_stow(names) | wrong
        if name in JOINING:
            wrong |= self._sentinel.barred(names) | self._doubts.barred(names, new_aims)
            wrong |= self._untaken(names) if new_aims is None else {}
        elif name in _TO_STANDBY:
            wrong |= self._sentinel.barred(self._off(names), ASTRAY)
            wrong |= self._sentinel.barred(names, UNPROVEN)
            wrong |= {
                each: refusals.STANDBY_NOT_TAKEN.text.format(reason=why)
                for each, why in self._given.unknown("STANDBY", names).items()
            }
        elif name in _STILL:
            for row in _SENT_OFF:
                wrong |= self._sentinel.barred(names, row)
        return wrong

    def _visited(self, token: int, names: tuple[str, ...]) -> dict[str, str]:
        """Return the heliostats that are in other visits, and the reasons."""
        visited = self._authority.visited()
        return {
            name: refusals.IN_VISIT.text.format(where=visited[name].where)
            for name in names
            if name in visited and visited[name].token != token
        }

    def kept_back(self, name: str, names: tuple[str, ...]) -> dict[str, str]:
        """Return which heliostats whose turn to join has come may not be sent, and why."""
        wrong = self._sync.differing(names) | self._identities.barred(names)
        wrong |= self._doubts.barred(names)
        if name in JOINING:
            wrong |= self._sentinel.barred(names) | self._untaken(names)
        return wrong

    def _untaken(self, names: Sequence[str]) -> dict[str, str]:
        """Return which heliostats have not taken their last aim, and why."""
        return {
            name: refusals.AIM_NOT_TAKEN.text.format(reason=reason)
            for name, reason in self._given.untaken("AIM", names).items()
        }

    def _off(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return which heliostats are at stow or have turned away."""
        state, index = self._field.rows["state"], self._field.index
        return tuple(name for name in names if state[index[name]] in _AWAY)

    def strange(self, names: Sequence[str]) -> dict[str, str]:
        """Return which heliostats' boards are not known to be theirs, and why."""
        return self._identities.barred(names)

    def unready(self, name: str, names: Sequence[str], points: FloatArray) -> dict[str, str]:
        """Return which heliostats may not move to new points (K, 3) now, and why."""
        wrong = self._sync.differing(names) | self._identities.barred(names)
        return wrong | self._doubts.barred(names, points) if name == "AIM" else wrong

    def still_locked_out(
        self, name: str, heliostats: Collection[str], points: FloatArray | None = None
    ) -> dict[str, str]:
        """Return the heliostats that persons' locks keep from a command; see `Lockouts.blocked`."""
        return self._lockouts.blocked(name, heliostats, points)

    def locked_out(
        self, name: str, heliostats: Collection[str], points: FloatArray | None = None
    ) -> dict[str, str]:
        """Return the heliostats that persons' locks keep from a command; refuse if all are."""
        out = self.still_locked_out(name, heliostats, points)
        if out and len(out) == len(heliostats):
            first, more = next(iter(out)), f" and {len(out) - 1} more" if len(out) > 1 else ""
            raise refusals.OUT_OF_SERVICE.error(
                what=name, heliostat=first, more=more, reason=out[first]
            )
        return out

    def accept(
        self,
        person: Person,
        token: int,
        name: str,
        values: tuple[float, ...],
        heliostats: Sequence[str],
        note: str = "",
        store: tuple[Work, Work] | None = None,
        blocked: Mapping[str, str] = MappingProxyType({}),
    ) -> Ticket:
        """Return the ticket of a command that may be given, with its record on the way.

        It ends at once for those that are ``blocked``. A person's command takes the others out of
        the visits that they are in. Where a visit verifies new parameters, no person sends the beam
        to an aim: only the visit sees whether it gets there.

        Raises
        ------
        RefusedError
            If it may not.
        """
        for each in heliostats:
            self._field.place(each)
        self._authority.check(person, token, name)
        self.refuse_now(name, [each for each in heliostats if each not in blocked])
        mandate = self._authority.mandate_of(token)
        if mandate is not None:
            wrong = mandate.refused(heliostats)
        else:
            wrong = self._doubts.verifying(heliostats) if name in _TO_AIMS else {}
            if name in JOINING and len(wrong) < len(heliostats):
                blocked, wrong = {**blocked, **wrong}, {}
        if wrong:
            raise BeamError(name, wrong)
        try:
            ticket = self._orders.accept(
                (person.name, person.role.title, name), values, heliostats, note, store=store
            )
        except AuditError as error:
            raise refusals.NOT_RECORDED.error(what=name, problem=error) from None
        ticket.block(blocked)
        if mandate is None and name not in SETTINGS:
            self._authority.prevail(ticket.waiting(heliostats), f"{person.name} ordered {name}")
        return ticket

    def refuse_now(self, name: str, heliostats: Sequence[str]) -> None:
        """Refuse a command where no new motion may begin now.

        Raises
        ------
        BeamError
            If it may begin in some of their clusters.
        RefusedError
            If it may begin in none.
        """
        held = self.held(name, heliostats)
        if held and len(held) < len(set(heliostats)):
            raise BeamError(name, held)
        for reason in held.values():
            raise refusals.NOT_NOW.error(what=name, reason=reason)

    def held(self, name: str, heliostats: Collection[str]) -> dict[str, str]:
        """Return the heliostats in whose clusters no new motion may begin now, and the reasons."""
        field = self._field
        cluster = {n: field.clusters[field.cluster[field.place(n)]] for n in heliostats}
        reasons = {each: self._refusal(name, each) for each in set(cluster.values())}
        if not any(reasons.values()):
            return {}
        return {n: reasons[each] for n, each in cluster.items() if reasons[each]}

    def _refusal(self, name: str, cluster: str) -> str:
        """Return why no new motion may begin in a cluster, "" if it may; all take LOCK."""
        reason = "" if name == "LOCK" else self._sentinel.refusal((cluster,))
        # The sun is needed to follow it, and to stand at standby; work at the mirrors is not.
        if name in JOINING or name in _TO_STANDBY:
            reason = reason or self._sentinel.night
        return reason or self._rivals.refusal((cluster,))
