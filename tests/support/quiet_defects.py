"""Defects by which a field does less, or later, and nothing is unsafe: for `twin_defects`."""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from heliotrope.cluster import _goals
from heliotrope.cluster._broadcast import Broadcast
from heliotrope.cluster._exchange import Exchange
from heliotrope.lcu import messages, motion, states
from heliotrope.lcu.controller import Controller
from heliotrope.lcu.lease import SunLease
from heliotrope.lcu.search import Spiral
from heliotrope.links.connection import CarriedLink
from heliotrope.links.messages import Stage
from heliotrope.plant import refusals
from heliotrope.plant.emergency.order import EmergencyOrder
from heliotrope.plant.field.clusters import ClusterEnd
from heliotrope.plant.field.identity import Identities
from heliotrope.plant.orders import authority
from heliotrope.plant.orders.authority import Authority
from heliotrope.plant.orders.parameters import ParameterSync

Plant = Callable[[pytest.MonkeyPatch], None]


def _accepted_and_forgotten(name: str) -> Plant:
    """A local controller acknowledges a command, and does not carry it out."""

    def plant(patch: pytest.MonkeyPatch) -> None:
        command = Controller._command

        def forgetful(self: Any, what: str, *rest: Any) -> int:
            return messages.DONE if what == name else command(self, what, *rest)

        patch.setattr(Controller, "_command", forgetful)

    return plant


def _seldom_sun(patch: pytest.MonkeyPatch) -> None:
    """A cluster sends SUN every fifth second: no lease of 6 s ends."""
    second, broadcast, count = Broadcast.second, Exchange.broadcast, [0]

    async def counted(self: Any, present: Any) -> None:
        count[0] += 1
        await second(self, present)

    async def seldom(self: Any, name: str, *values: Any) -> Any:
        if name == "SUN" and count[0] % 5:
            return None
        return await broadcast(self, name, *values)

    patch.setattr(Broadcast, "second", counted)
    patch.setattr(Exchange, "broadcast", seldom)


def _lease_too_short(patch: pytest.MonkeyPatch) -> None:
    """Now and then a mirror that is served takes its lease for over."""
    look = SunLease.look

    def hasty(self: Any, now: int, elapsed: int) -> bool:
        if self._second % 50 == 0:
            self.end()
        return bool(look(self, now, elapsed))

    patch.setattr(SunLease, "look", hasty)


def _never_told(patch: pytest.MonkeyPatch) -> None:
    """A cluster sees that a command is done, and tells nobody."""
    add = _goals.Reports.add

    def silent(self: Any, identity: str, stage: Stage, *rest: Any) -> None:
        if stage is not Stage.DONE:
            add(self, identity, stage, *rest)

    patch.setattr(_goals.Reports, "add", silent)


def _never_proven(patch: pytest.MonkeyPatch) -> None:
    """No emergency is ever proven."""
    patch.setattr(EmergencyOrder, "is_done", lambda self, name: False)


def _lock_follows(patch: pytest.MonkeyPatch) -> None:
    """A mirror that is locked at standby goes on following the sun."""
    line = "IDLE LOCK LOCKED hold"
    assert line in states.TABLE
    patch.setattr(states, "TABLE", states.TABLE.replace(line, "IDLE LOCK LOCKED"))


def _search_stands(patch: pytest.MonkeyPatch) -> None:
    """A search takes its time, and the beam stays on the aim."""
    advance = Spiral.advance

    def standing(self: Any) -> bool:
        goes_on = advance(self)
        self.offset[:] = [0.0, 0.0]
        return bool(goes_on)

    patch.setattr(Spiral, "advance", standing)


def _beside(patch: pytest.MonkeyPatch) -> None:
    """A mirror keeps its beam 0.9 m beside its aim, or beside its standby point."""
    follow = motion.Motion._follow

    def beside(self: Any, aim: tuple[float, float, float]) -> bool:
        if self.kind in (motion.TRACK, motion.STANDBY):
            aim = aim[0] + 0.9, aim[1], aim[2]
        return bool(follow(self, aim))

    patch.setattr(motion.Motion, "_follow", beside)


def _never_back(patch: pytest.MonkeyPatch) -> None:
    """The plant's end of a line does not speak again after the connection was lost."""
    converse = CarriedLink._converse

    async def once(self: Any, keys: Any) -> None:
        if self.statistics.opened and self.name != "plant":
            await asyncio.Event().wait()
        await converse(self, keys)

    patch.setattr(CarriedLink, "_converse", once)


def _seldom_leases(patch: pytest.MonkeyPatch) -> None:
    """The plant renews its lease every fourth second: it lasts for five."""
    keep = ClusterEnd.keep

    async def seldom(self: Any, lease: Any, period: float, greet: Any) -> None:
        await keep(self, lease, 4.0 * period, greet)

    patch.setattr(ClusterEnd, "keep", seldom)


def _wrong_holder(patch: pytest.MonkeyPatch) -> None:
    """Who lacks the command authority is told that nobody has it."""
    checked = Authority._checked

    def vague(self: Any, person: Any, token: int) -> Any:
        try:
            return checked(self, person, token)
        except refusals.RefusedError:
            raise refusals.NO_AUTHORITY.error(person=person.name) from None

    patch.setattr(Authority, "_checked", vague)


def _role_too_high(patch: pytest.MonkeyPatch) -> None:
    """TRACK is left to engineers."""
    patch.setattr(authority, "OPERATOR_COMMANDS", authority.OPERATOR_COMMANDS - {"TRACK"})


def _unheard(patch: pytest.MonkeyPatch) -> None:
    """The statuses of a cluster that has come back are not judged."""
    judge = Identities.on_status

    def first_only(self: Any, cluster: str, *status: Any) -> None:
        before = self._judged.get(cluster)
        judge(self, cluster, *status)
        if before is not None:
            self._judged[cluster] = before

    patch.setattr(Identities, "on_status", first_only)


def _uncompared(patch: pytest.MonkeyPatch) -> None:
    """The parameters of a cluster that has connected are awaited, and not asked for."""

    def waiting(self: Any, heliostats: Any) -> None:
        self._strange.update(name for name in heliostats if name in self._wanted.items)

    patch.setattr(ParameterSync, "greet", waiting)


#: Defects where a state has the right name and the mirror does something else: name, defect, and
#: whether the normal tests leave it to the slow ones.
TOUR_ROWS: tuple[tuple[str, Plant, bool], ...] = (
    ("JOG acknowledged and forgotten", _accepted_and_forgotten("JOG"), True),
    ("DIAGNOSE acknowledged and forgotten", _accepted_and_forgotten("DIAGNOSE"), True),
    ("a locked mirror follows the sun", _lock_follows, True),
    ("a search stands still", _search_stands, False),
)
#: Name, defect, worlds, whether the normal tests leave it to the slow ones, and the seed.
ROWS: tuple[tuple[str, Plant, tuple[str, ...], bool, int], ...] = (
    ("TRACK acknowledged and forgotten", _accepted_and_forgotten("TRACK"), ("calm",), False, 0),
    ("IDLE acknowledged and forgotten", _accepted_and_forgotten("IDLE"), ("calm",), True, 0),
    ("SUN every fifth second", _seldom_sun, ("calm",), True, 0),
    ("a lease that ends by itself", _lease_too_short, ("calm",), False, 0),
    ("nobody is told that a command is done", _never_told, ("calm",), True, 0),
    ("no emergency is ever proven", _never_proven, (), True, 0),
    ("leases every fourth second", _seldom_leases, ("calm",), False, 0),
    ("a beam 0.9 m beside its point", _beside, ("swarm",), True, 0),
    ("a refusal names the wrong holder", _wrong_holder, (), False, 1),
    ("TRACK is left to engineers", _role_too_high, (), True, 1),
)
#: The same, without a seed, for what comes back after a line was dropped.
REJOIN_ROWS: tuple[tuple[str, Plant, tuple[str, ...], bool], ...] = (
    ("a lost cluster never rejoins", _never_back, ("calm",), False),
    ("a cluster that came back stays unheard", _unheard, ("calm",), True),
    ("parameters are never compared again", _uncompared, ("calm", "calibrations"), True),
)
