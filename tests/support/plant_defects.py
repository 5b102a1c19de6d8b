"""Defects to plant in the plant's code while the simulation runs it: for `twin_defects`."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from heliotrope.calibration.learn.own_model import OwnModel
from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.calibration.sightings import join
from heliotrope.links.messages import Stage
from heliotrope.plant.controller import PlantController
from heliotrope.plant.emergency.order import EmergencyOrder
from heliotrope.plant.field import state as field_state
from heliotrope.plant.field.identity import Identities
from heliotrope.plant.operations.automatic import AutomaticControl
from heliotrope.plant.operations.losses import Losses
from heliotrope.plant.orders import authority
from heliotrope.plant.orders.audit import AuditError
from heliotrope.plant.orders.parameters import ParameterSync
from heliotrope.plant.orders.queue import PlantOrders
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.plant.visits.calibration_cycle import CalibrationCycle
from heliotrope.plant.visits.photographs import Centred, seen
from heliotrope.plant.visits.verification import Verification
from heliotrope.safety import JoinLimiter
from heliotrope.twin.invariants.plant_observer import PlantObserver

Plant = Callable[[pytest.MonkeyPatch], None]


def join_limiter_off(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(JoinLimiter, "admit", lambda self, wanted, now: (replace(self, at=now), wanted))


def record_doubled(patch: pytest.MonkeyPatch) -> None:
    accept = PlantOrders.accept

    def twice(self: Any, *given: Any, **more: Any) -> Ticket:
        accept(self, *given, **more)
        return accept(self, *given, **more)

    patch.setattr(PlantOrders, "accept", twice)


def record_missing(patch: pytest.MonkeyPatch) -> None:
    """On a full disk the command is carried out without a record."""
    accept = PlantOrders.accept

    def careless(self: Any, record: Any, *given: Any, **more: Any) -> Ticket:
        try:
            return accept(self, record, *given, **more)
        except AuditError:
            return accept(self, record, *given, **{**more, "late": True})

    patch.setattr(PlantOrders, "accept", careless)


def safe_not_recorded(patch: pytest.MonkeyPatch) -> None:
    """Records that may be written later are forgotten."""
    patch.setattr(PlantOrders, "pay", lambda self: setattr(self, "_owed", []))


def stale_as_live(patch: pytest.MonkeyPatch) -> None:
    def young(self: Any, now: float) -> Any:
        return np.where(np.isfinite(self.heard), 0.0, np.inf)

    patch.setattr(field_state.FieldState, "age", young)


def authority_of_anybody(patch: pytest.MonkeyPatch) -> None:
    """Everybody with a role counts as holder of the authority."""

    def trusting(self: Any, person: Any, token: int, command: str) -> None:
        if person.role < authority.Role.OPERATOR:
            raise authority.RefusedError(f"{command}: {person.name} is viewer")

    patch.setattr(authority.Authority, "check", trusting)


def broken_by_anybody(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(authority.Authority, "seize", lambda self, person, reason: self._give(person))


def resumes_by_itself(patch: pytest.MonkeyPatch) -> None:
    """Heliostats that are defocused, and not in an emergency, are sent back to the receiver."""
    take, check = PlantController._take_status, PlantObserver.check

    def resuming(self: Any, end: Any, status: Any, now: float) -> None:
        take(self, end, status, now)
        names = [n for n in end.members if self.field.of(n, now).state == "DEFOCUSED"]
        if names and not self.sentinel.on and not self.waiting:
            run = self._orders._prefix
            ticket = Ticket(f"{run}-by itself", "REFOCUS", names, self.clock, 60.0)
            self.commands._join(ticket, "REFOCUS", (), names, self.authority.token)

    def quiet(self: Any, number: int, *rest: Any) -> None:
        """Leave the missing record to a defect of its own."""
        if number != 11:
            check(self, number, *rest)

    patch.setattr(PlantController, "_take_status", resuming)
    patch.setattr(PlantObserver, "check", quiet)


def done_when_acknowledged(patch: pytest.MonkeyPatch) -> None:
    """A heliostat that acknowledges an emergency counts as done."""
    take_stage = EmergencyOrder.take_stage

    def hasty(self: Any, heliostats: Any, stage: Stage, now: float) -> None:
        take_stage(self, heliostats, stage, now)
        if stage is Stage.ACKNOWLEDGED:
            take_stage(self, heliostats, Stage.DONE, now)

    patch.setattr(EmergencyOrder, "take_stage", hasty)


def identity_unchecked(patch: pytest.MonkeyPatch) -> None:
    """Whatever board answers at an address counts as the heliostat's."""
    patch.setattr(Identities, "on_status", lambda self, cluster, status, now: None)
    patch.setattr(Identities, "blocked", lambda self, heliostat: None)


def differing_moves(patch: pytest.MonkeyPatch) -> None:
    """Boards that store other parameters than the wanted ones are moved, and are not corrected."""
    patch.setattr(ParameterSync, "differing", lambda self, heliostat: None)
    patch.setattr(ParameterSync, "_push", lambda self, *given: None)


def unverified(patch: pytest.MonkeyPatch) -> None:
    """New parameters are taken without the photograph that confirms them."""

    async def confirmed(*_: Any) -> None:
        return None

    patch.setattr(Verification, "problem", confirmed)


def any_light(patch: pytest.MonkeyPatch) -> None:
    """Light on the target counts as the heliostat's beam, whether it moves with the aim or not."""

    def own(self: Any, target: Any, shot: Any, *_: Any) -> str | None:
        dark = seen(target, shot) is None and not shot.reasons
        return "no light on the target" if dark else None

    patch.setattr(Centred, "_astray", own)


def surer_than_it_is(patch: pytest.MonkeyPatch) -> None:
    """A calibration states a tenth of its true deviations."""
    before = HeliostatCalibration.__post_init__

    def sure(self: Any) -> None:
        object.__setattr__(self, "covariance", 0.01 * np.asarray(self.covariance))
        before(self)

    patch.setattr(HeliostatCalibration, "__post_init__", sure)


def counted_often(patch: pytest.MonkeyPatch) -> None:
    """Every sighting is counted ten times in the fit."""
    fitting = OwnModel.fitting

    def repeated(self: Any, nominal: Any, sightings: Any, *more: Any) -> Any:
        return fitting(self, nominal, join([sightings] * 10), *more)

    patch.setattr(OwnModel, "fitting", repeated)


def sun_of_later(patch: pytest.MonkeyPatch) -> None:
    """A sighting is given the sun of half a minute after its photograph."""
    sighting = CalibrationCycle._sighting

    def late(self: Any, shot: Any, counts: Any) -> Any:
        return sighting(self, replace(shot, at=shot.at + 30.0), counts)

    patch.setattr(CalibrationCycle, "_sighting", late)


def evening_skipped(patch: pytest.MonkeyPatch) -> None:
    """Automatic control does not look at the height of the sun."""
    patch.setattr(AutomaticControl, "_night", lambda self: None)


def goes_on_after_a_loss(patch: pytest.MonkeyPatch) -> None:
    """Automatic control does not wait for a person, however many heliostats were lost."""
    patch.setattr(Losses, "_wait", lambda self, text: None)


#: Invariants that may find it, name, defect, faults to draw from, pause between them, and the seed
#: that found it.
ROWS: tuple[tuple[tuple[int, ...], str, Plant, tuple[str, ...], float, int], ...] = (
    ((10,), "joining is not bounded", join_limiter_off, ("line_drop",), 60.0, 1),
    ((11,), "audit record doubled", record_doubled, ("line_drop",), 60.0, 0),
    ((11,), "audit record missing on a full disk", record_missing, ("audit_full",), 10.0, 0),
    ((11,), "orders to everybody are not recorded", safe_not_recorded, ("line_drop",), 60.0, 0),
    ((11,), "stale row shown as live", stale_as_live, ("power_cut", "cluster_crash"), 10.0, 1),
    ((4,), "command accepted without authority", authority_of_anybody, ("line_drop",), 60.0, 1),
    ((15,), "done when it is acknowledged", done_when_acknowledged, ("line_drop",), 60.0, 0),
    ((4,), "authority broken by anybody", broken_by_anybody, ("line_drop",), 60.0, 2),
)
