"""Parameters of local controllers: on connection, they are compared and, if needed, written."""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray, angle_between, normalize, reflect
from heliotrope.lcu import states
from heliotrope.lcu.controller import HARMLESS, MACHINE, POSE
from heliotrope.links.messages import Answer, ClusterStatus, ProtocolError, Stage
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.board_items import (
    CALIBRATION_ITEMS,
    POSE_ITEMS,
    Tables,
    Wanted,
    checksums,
)
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.tracking import track
from heliotrope.plant import refusals
from heliotrope.plant.field.assigned import KINDS
from heliotrope.plant.field.clusters import Clusters
from heliotrope.plant.field.part import Part
from heliotrope.plant.field.state import FieldState
from heliotrope.plant.motion.proofs import PathProofs
from heliotrope.plant.orders.audit import AuditError
from heliotrope.plant.orders.queue import PlantOrders
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.safety import Alarm, alarms

#: States in which a heliostat is at rest, so that items that change its pose are accepted.
TAKES_POSE = POSE
#: Pause before another attempt, s.
AGAIN = 30.0


#: Sun directions for which the effect of new parameters is evaluated: azimuth and elevation, rad.
_SUNS = tuple(
    (math.radians(azimuth), math.radians(elevation))
    for azimuth in range(0, 360, 60)
    for elevation in (25, 50)
)


def change_of_beam(before: Tables, after: Tables, aims: npt.ArrayLike) -> float:
    """Return the largest angle by which new parameters rotate a beam off its aim, rad.

    The present parameters are assumed to describe the heliostat, while its local controller aims
    with the new parameters. The angle is the largest over sun directions all around; it is infinite
    if no pose can be reached with the new parameters, or if an aim can be reached only with the
    present parameters.

    Parameters
    ----------
    before, after
        Armature and drives under the present and the new parameters.
    aims
        Aim points, ENU, m, (K, 3).
    """
    suns = np.array(
        [(math.sin(a) * math.cos(e), math.cos(a) * math.cos(e), math.sin(e)) for a, e in _SUNS]
    )
    points = np.reshape(np.asarray(aims, dtype=np.float64), (-1, 3))
    light, goals = np.repeat(suns, len(points), axis=0), np.tile(points, (len(suns), 1))

    def many(table: FloatArray) -> FloatArray:
        return np.repeat(table[None], len(light), axis=0)

    solved = [
        track(Armature(many(a)), light, goals, drives=Drive(many(d))) for a, d in (before, after)
    ]
    reached, again = (found.reachable for found in solved)
    if not reached.any() or (reached & ~again).any():
        return math.inf
    angles = Drive(many(before[1])).angles(solved[1].best_counts)
    normal, vertex = Armature(many(before[0])).pose(angles)
    missed = angle_between(reflect(light, normal), normalize(goals - vertex))
    return float(missed[reached].max())


def stored_items(answer: Answer) -> dict[str, bytes]:
    """Return the items in a reply to ``stored``; no items if the cluster could not read them.

    Raises
    ------
    ProtocolError
        If names, sizes and block are inconsistent.
    """
    names, sizes = answer.data.get("names"), answer.data.get("sizes")
    if "error" in answer.data:
        return {}
    if not (isinstance(names, list) and isinstance(sizes, list)) or len(names) != len(sizes):
        raise ProtocolError(
            f"answer {answer.identity}: the names and sizes of the items are missing"
        )
    if not all(isinstance(size, int) for size in sizes) or sum(sizes) != len(answer.block):
        raise ProtocolError(
            f"answer {answer.identity}: the names, the sizes and the block do not match"
        )
    found, place = {}, 0
    for name, size in zip(names, sizes, strict=True):
        found[str(name)] = answer.block[place : place + size]
        place += size
    return found


class ParameterSync(Part):
    """Compares the stored with the desired parameters, and writes parameters that differ.

    Parameters
    ----------
    field, wanted, orders, clusters
        Parts of the plant.
    tell
        Called with each alarm.
    proofs
        Checks that a beam is clear where parameters are written, and at stow.
    blocked
        Function that returns why nothing may be written to a heliostat; None if writing is allowed.
    token
        Function that returns the token under which differences are written, 0 if none may be
        written now.
    """

    def __init__(
        self,
        field: FieldState,
        wanted: Wanted,
        orders: PlantOrders,
        clusters: Clusters,
        tell: Callable[[Alarm], None],
        proofs: PathProofs,
        blocked: Callable[[str], str | None],
        token: Callable[[], int],
    ) -> None:
        self._field, self._wanted, self._orders = field, wanted, orders
        self._clusters, self._tell, self._proofs = clusters, tell, proofs
        self._blocked, self._token = blocked, token
        #: Heliostats to be compared, and when, monotonic s.
        self._due = dict.fromkeys(wanted.items, -math.inf)
        #: Heliostats not compared since their cluster connected or their board started.
        self._strange = set(self._due)
        self._tickets: dict[str, Ticket] = {}
        self._tried: dict[str, float] = {}

    def compare(self, heliostat: str) -> None:
        """Compare a heliostat as soon as possible."""
        if heliostat in self._wanted.items:
            self._due[heliostat] = -math.inf

    def on_connected(self, cluster: str, now: float) -> None:
        """Compare the heliostats of a cluster that has connected."""
        del now
        self.greet(self._field.members[cluster])

    def on_status(self, cluster: str, status: ClusterStatus, now: float) -> None:
        """Compare the heliostats whose boards have restarted."""
        del cluster, status, now
        self.greet(self._field.restarted)

    def on_stage(
        self, ticket: Ticket, heliostats: tuple[str, ...], stage: Stage, now: float
    ) -> None:
        """Compare heliostats that lacked parameters, once they have an assigned point."""
        del now
        if stage is Stage.DONE and ticket.name in KINDS:
            for name in self._wanted.missing.keys() & heliostats:
                self.compare(name)

    def greet(self, heliostats: Sequence[str]) -> None:
        """Compare heliostats before they may move, because their boards may have been replaced.

        Their cluster has connected, or their boards have restarted.
        """
        for name in heliostats:
            self.compare(name)
        self._strange.update(name for name in heliostats if name in self._wanted.items)

    def differing(self, heliostat: str) -> str | None:
        """Return how the parameters of a heliostat differ or may differ; None if they agree.

        They may differ if the heliostat has not been compared since its cluster connected or its
        board started.
        """
        ticket = self._tickets.get(heliostat)
        items = self._wanted.missing.get(heliostat, ())
        if items or (ticket is not None and not ticket.finished):
            listed = ", ".join(items) or "being written"
            return refusals.PARAMETERS_DIFFER.text.format(items=listed)
        return refusals.NOT_COMPARED.text if heliostat in self._strange else None

    def compared(self, heliostat: str) -> str:
        """Return the result of a heliostat's last comparison in words; nothing is sent."""
        if heliostat not in self._wanted.items:
            return "not compared, because this plant does not write parameters"
        return self.differing(heliostat) or "the same"

    def check(self, heliostat: str, items: Mapping[str, bytes]) -> None:
        """Check that the beam of a heliostat is safe if items are written now.

        Raises
        ------
        RefusedError
            If the items change its pose while it is not standing still or its beam is not clear, or
            if they set a stow position from which its beam would reach a receiver, a target or a
            volume.
        """
        if reason := self._proofs.resting(heliostat, items):
            raise refusals.STOW_UNPROVEN.error(heliostat=heliostat, reason=reason)
        state = int(self._field.rows["state"][self._field.place(heliostat)])
        moving = ", ".join(sorted(POSE_ITEMS.intersection(items)))
        reason = ""
        if moving and state not in TAKES_POSE:
            reason = f"it is {states.STATES[state]}, and {moving} would move its beam"
        elif moving and state != states.STOWED:
            reason = self._proofs.rewriting(heliostat, *self._proofs.tables(heliostat, items)[1])
        if reason:
            raise refusals.PARAMETERS_NOT_HERE.error(heliostat=heliostat, reason=reason)

    def push(
        self,
        ticket: Ticket,
        heliostat: str,
        items: Mapping[str, bytes],
        token: int,
        before: Callable[[], None] = lambda: None,
    ) -> None:
        """Send items of an accepted ticket once it is recorded; call ``before`` just before.

        The heliostat is compared when the ticket has ended.
        """

        def send(again: bool) -> None:
            if again:
                if reason := self._blocked(heliostat):
                    raise refusals.NOT_NOW.error(what=f"PARAMETERS {heliostat}", reason=reason)
                self.check(heliostat, items)
            before()
            self._orders.parameters(ticket, heliostat, items, token)

        self._tickets[heliostat] = ticket
        self._orders.when_recorded(ticket, send)

    async def stored(self, heliostat: str, timeout: float) -> dict[str, int]:
        """Return the checksums of the items that a local controller stores, by item.

        Raises
        ------
        RefusedError
            If no reply comes within ``timeout`` s, or nothing is stored.
        """
        home = self._clusters.home(heliostat).name
        answer = await self._clusters.answer(home, "stored", timeout, heliostat)
        if answer is None:
            late = f"no reply within {timeout:g} s; check that the heliostat is live"
            raise refusals.NO_ANSWER.error(heliostat=heliostat, problem=late)
        items = stored_items(answer)
        if not items:
            problem = answer.data.get("error", "nothing is stored")
            raise refusals.NO_ANSWER.error(heliostat=heliostat, problem=problem)
        sums = checksums(items)
        self._strange.discard(heliostat)
        self._wanted.compare(heliostat, sums)
        return sums

    def on_second(self, now: float) -> None:
        """Compare the heliostats that are due, and write items that differ where allowed."""
        for name, ticket in list(self._tickets.items()):
            if ticket.finished:
                del self._tickets[name]
                self.compare(name)
        live = self._field.live(now)
        for name, due in self._due.items():
            # A heliostat that is being written to is compared when its ticket has ended.
            if now >= due and live[self._field.index[name]] and name not in self._tickets:
                self._due[name] = now + AGAIN
                self._ask(name)
        if token := self._token():
            for name, missing in list(self._wanted.missing.items()):
                busy = name in self._tickets or name in self._due
                if live[self._field.index[name]] and not busy and not self._blocked(name):
                    self._push(name, missing, token, now)

    def _ask(self, name: str) -> None:
        def take(answer: Answer) -> None:
            items = stored_items(answer)
            if not items:
                return
            self._due.pop(name, None)
            self._strange.discard(name)
            differing = self._wanted.compare(name, checksums(items))
            if differing:
                self._tell(alarms.PARAMETERS_DIFFER.raised(name, items=", ".join(differing)))

        self._clusters.ask(self._clusters.home(name), "stored", take, name)

    def _push(self, name: str, missing: tuple[str, ...], token: int, now: float) -> None:
        state = int(self._field.rows["state"][self._field.index[name]])
        able = [item for item in missing if state in _takes(item)]
        if not able or now - self._tried.get(name, -math.inf) < AGAIN:
            return
        self._tried[name] = now
        items = {item: self._wanted.items[name][item] for item in able}
        if reason := self._proofs.resting(name, items):
            del items["stow"]
            listed = f"the stow position, which cannot be written: {reason}"
            self._tell(alarms.PARAMETERS_DIFFER.raised(name, items=listed))
        if not items:
            return
        try:
            self.check(name, items)
        except refusals.RefusedError:
            return  # it is written at stow
        try:
            ticket = self._orders.accept(
                ("plant", "plant", "PARAMETERS"), (), (name,), ", ".join(items)
            )
        except AuditError:
            return  # nothing is sent without its record; the safety table reports the disk
        self.push(ticket, name, items, token)


def _takes(item: str) -> tuple[int, ...]:
    """Return the states in which an item is written."""
    if item not in CALIBRATION_ITEMS:
        return MACHINE
    return TAKES_POSE if item in POSE_ITEMS else HARMLESS
