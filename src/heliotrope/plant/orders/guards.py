"""Guards: one table of the reasons why heliostats may not be sent a command.

Each entry names the refusal, the commands that it blocks, and the check that returns the reason for
each heliostat. The table is evaluated when a command is accepted, when its record is written, and
when its turn comes. If there are several reasons, the first in the table is reported. Whether the
beams may go to their points is checked afterwards; see `PathProofs`.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.lcu import messages, states
from heliotrope.plant import refusals
from heliotrope.plant.emergency import UNPROVEN, Sentinel
from heliotrope.plant.field.doubtful_positions import DoubtfulPositions
from heliotrope.plant.field.identity import Identities
from heliotrope.plant.field.lockouts import Lockouts
from heliotrope.plant.field.second_plant import SecondPlant
from heliotrope.plant.field.state import FieldState
from heliotrope.plant.field.witnesses import Witnesses
from heliotrope.plant.motion.proofs import BeamError
from heliotrope.plant.orders.authority import Authority
from heliotrope.plant.orders.parameters import ParameterSync
from heliotrope.plant.orders.queue import PlantOrders
from heliotrope.plant.orders.stowing import WAITS
from heliotrope.plant.orders.unacknowledged import Unacknowledged
from heliotrope.plant.refusals import BEAM_REFUSED, NOT_NOW, OUT_OF_SERVICE, Refusal, RefusedError


@dataclass(frozen=True)
class Asked:
    """A command that is to be issued.

    Attributes
    ----------
    name, heliostats
        The command, and K heliostats.
    points
        Points to which it sends their beams, ENU, m, (K, 3); None: to their aims, or to no surface.
    token
        Token of the authority holder or of a mandate; None: the plant itself issues the command.
    """

    name: str
    heliostats: tuple[str, ...]
    points: FloatArray | None = None
    token: int | None = None


@dataclass(frozen=True)
class Guards:
    """The parts of the plant whose state blocks commands, and the evaluation of the table."""

    field: FieldState
    authority: Authority
    orders: PlantOrders
    sentinel: Sentinel
    second_plant: SecondPlant
    witnesses: Witnesses
    identities: Identities
    sync: ParameterSync
    doubtful: DoubtfulPositions
    lockouts: Lockouts
    given: Unacknowledged
    aims: FloatArray

    def reasons(self, asked: Asked, *kinds: Refusal) -> dict[str, str]:
        """Return the heliostats that guards block, and the reasons.

        ``kinds`` restricts the guards to some refusals.
        """
        found: dict[str, str] = {}
        for guard in GUARDS:
            if guard.refusal in (kinds or (guard.refusal,)) and asked.name in guard.commands:
                reasons = guard.check(self, asked)
                for name, reason in zip(asked.heliostats, reasons, strict=False):
                    if reason:
                        found.setdefault(name, reason)
        return {name: found[name] for name in asked.heliostats if name in found}

    def passed(self, asked: Asked, *kinds: Refusal) -> tuple[tuple[str, ...], dict[str, str]]:
        """Return the heliostats that the guards pass, and the blocked heliostats with the reasons.

        Raises
        ------
        RefusedError
            If all are blocked; `BeamError` unless all are blocked by the first of ``kinds``.
        """
        wrong = self.reasons(asked, *kinds)
        if wrong and len(wrong) == len(asked.heliostats):
            raise self._error(asked, kinds[0], wrong)
        return tuple(name for name in asked.heliostats if name not in wrong), wrong

    def refuse_now(self, name: str, heliostats: Sequence[str]) -> None:
        """Refuse a command if no new motion may begin now.

        Raises
        ------
        BeamError
            If motion may begin in some of their clusters.
        RefusedError
            If motion may begin in none of their clusters.
        """
        asked = Asked(name, tuple(dict.fromkeys(heliostats)))
        if held := self.reasons(asked, NOT_NOW):
            raise self._error(asked, NOT_NOW, held)

    def _error(self, asked: Asked, kind: Refusal, wrong: dict[str, str]) -> RefusedError:
        if kind is BEAM_REFUSED or len(self.reasons(asked, kind)) < len(asked.heliostats):
            return BeamError(asked.name, wrong)
        first, reason = next(iter(wrong.items()))
        more = f" and {len(wrong) - 1} more" if len(wrong) > 1 else ""
        return kind.error(what=asked.name, heliostat=first, more=more, reason=reason)

    def destined(self, asked: Asked) -> FloatArray | None:
        """Return the points (K, 3) to which a command sends beams; None if it sends none."""
        if asked.points is not None or asked.name not in TO_AIMS:
            return asked.points
        rows = np.array([self.field.place(name) for name in asked.heliostats], dtype=np.intp)
        return np.asarray(self.aims[rows])


#: Returns the reason for each heliostat of a command (K), None if there is none; () for all.
Check = Callable[[Guards, Asked], Iterable[str | None]]


@dataclass(frozen=True)
class Guard:
    """A row of the table.

    Attributes
    ----------
    refusal
        Refusal of the whole command, if it blocks all heliostats.
    commands
        Commands that it blocks.
    check
        Returns the reason for each heliostat.
    """

    refusal: Refusal
    commands: frozenset[str]
    check: Check


def _each(reason: Callable[[Guards, str], str | None]) -> Check:
    return lambda plant, asked: (reason(plant, name) for name in asked.heliostats)


def _cluster(reason: Callable[[Guards, str], str | None]) -> Check:
    """Evaluate a reason once per cluster."""

    def check(plant: Guards, asked: Asked) -> Iterable[str | None]:
        field = plant.field
        rows = [field.cluster[field.place(name)] for name in asked.heliostats]
        reasons = {row: reason(plant, field.clusters[row]) for row in set(rows)}
        return (reasons[row] for row in rows) if any(reasons.values()) else ()

    return check


def _alarm(condition: str = "", among: tuple[int, ...] = tuple(range(len(states.STATES)))) -> Check:
    """Block heliostats, in some states, that the safety table keeps away.

    ``condition`` selects one row of the table; "" means any row.
    """

    def check(plant: Guards, asked: Asked) -> Iterable[str | None]:
        found = plant.sentinel.table.blocked(condition)
        state, place = plant.field.rows["state"], plant.field.place
        found = {name: text for name, text in found.items() if state[place(name)] in among}
        return map(found.get, asked.heliostats) if found else ()

    return check


def _unacknowledged(plant: Guards, asked: Asked) -> Iterable[str | None]:
    """Block heliostats that have not acknowledged their aims, unless they get new aims first."""
    return (
        plant.given.untaken("AIM", name) if asked.points is None else None
        for name in asked.heliostats
    )


def _doubted(plant: Guards, asked: Asked) -> Iterable[str | None]:
    """Keep doubtful heliostats off receivers; a photograph on a target resolves the doubt."""
    points = plant.destined(asked)
    assert points is not None
    return plant.doubtful.reasons(asked.heliostats, points)


def _visited(plant: Guards, asked: Asked) -> Iterable[str | None]:
    """Block commands that would disturb a measurement, unless the visit or the plant sends them."""
    visited = {} if asked.token is None else plant.authority.visited()
    for visit in map(visited.get, asked.heliostats):
        other = visit is not None and visit.token != asked.token
        yield refusals.IN_VISIT.text.format(where=visit.where) if visit and other else None


#: Commands that need the command authority; DEFOCUS and STOW need none, and nothing blocks them.
_ORDERS = messages.ORDERS | {"PARAMETERS"}
#: Commands that send beams to their aims.
TO_AIMS = messages.JOINING | {"AIM"}

#: All guards; the first that blocks a heliostat supplies the reason.
GUARDS: tuple[Guard, ...] = (
    # ZERO and PARAMETERS are not harmless, because they may change where the next STOW ends.
    Guard(
        OUT_OF_SERVICE,
        _ORDERS - messages.HARMLESS,
        lambda plant, asked: plant.lockouts.reasons(asked.heliostats, plant.destined(asked)),
    ),
    # The plant itself issues STOW after a visit, but not while an emergency is active.
    Guard(
        NOT_NOW,
        (_ORDERS | messages.SAFE) - messages.STOPS,
        _cluster(lambda plant, name: plant.sentinel.refusal((name,))),
    ),
    # The sun is needed for tracking and for standby, but not for work on the heliostats.
    Guard(
        NOT_NOW,
        messages.JOINING | messages.TO_STANDBY,
        _cluster(lambda plant, _: plant.sentinel.night),
    ),
    # The path from stow is clear for the computed sun; under another sun it may cross volumes.
    Guard(
        NOT_NOW, frozenset({"APPROACH"}), _cluster(lambda plant, _: plant.witnesses.contradiction)
    ),
    Guard(
        NOT_NOW,
        _ORDERS | messages.SAFE,
        _cluster(lambda plant, name: plant.second_plant.refusal((name,))),
    ),
    Guard(BEAM_REFUSED, messages.JOINING, _unacknowledged),
    Guard(BEAM_REFUSED, TO_AIMS, _doubted),
    Guard(BEAM_REFUSED, messages.JOINING, _alarm()),
    Guard(
        BEAM_REFUSED,
        messages.TO_STANDBY,
        _each(lambda plant, name: plant.given.unknown("STANDBY", name)),
    ),
    Guard(BEAM_REFUSED, messages.TO_STANDBY, _alarm(UNPROVEN)),
    # Stray beams that have been moved off would stray again.
    Guard(BEAM_REFUSED, messages.TO_STANDBY, _alarm("pointing_disagrees", states.AWAY)),
    # A heliostat that is being ordered off is not stopped.
    Guard(BEAM_REFUSED, messages.RELEASES, _alarm("beam_unsent")),
    Guard(BEAM_REFUSED, messages.RELEASES, _alarm("keep_out_predicted")),
    Guard(BEAM_REFUSED, messages.SETTINGS, _visited),
    Guard(
        BEAM_REFUSED,
        _ORDERS - messages.STOPS,
        _each(lambda plant, name: plant.identities.blocked(name)),
    ),
    Guard(
        BEAM_REFUSED,
        messages.MOTIONS,
        _each(lambda plant, name: WAITS if plant.orders.to_stow(name) else None),
    ),
    Guard(
        BEAM_REFUSED,
        messages.MOTIONS | messages.POINTS,
        _each(lambda plant, name: plant.sync.differing(name)),
    ),
)
