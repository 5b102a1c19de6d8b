"""The HTTP API, version 1: commands.

Every command is given as the caller, with the role that the store has for them now, through the one
command authority; an accepted command has its record in the audit before it is sent. EMERGENCY is
open to everybody who is signed in; everything else needs an operator.
"""

import asyncio
import math
import time

from fastapi import APIRouter, HTTPException
from fastapi.responses import JSONResponse

from heliotrope.console import models
from heliotrope.console.api import REFUSALS, Named, answer
from heliotrope.console.auth import Anyone, Caller, Console, Here, Operator, token_of
from heliotrope.console.tickets import state_of
from heliotrope.errors import InputError
from heliotrope.plant.authority import OPERATOR_COMMANDS, Role
from heliotrope.plant.operations.zero import zero
from heliotrope.plant.orders import RECORDING
from heliotrope.plant.tickets import Ticket

router = APIRouter(prefix="/api/v1", responses=REFUSALS)


def authority_of(console: Console, who: Caller) -> models.AuthorityState:
    """Return the holder of the command authority."""
    authority = console.operations.plant.authority
    grant = authority.grant
    if grant is None:
        return models.AuthorityState(holder="", role="", mine=False, lifetime=authority.lifetime)
    return models.AuthorityState(
        holder=grant.holder.name,
        role=grant.holder.role.name.lower(),
        mine=grant.holder == who.person,
        lifetime=authority.lifetime,
    )


async def _told(console: Console) -> None:
    """Wait until a new token is known: clusters get it with a lease, their nodes a second later.

    Until then the field would refuse commands.
    """
    await asyncio.sleep(1.5 * console.operations.plant.settings.period + 1.0)


async def _recorded(console: Console, ticket: Ticket) -> models.TicketState:
    """Return a command's progress once it is recorded, or once that has failed.

    The next command of the same client then finds the points that this one has assigned.
    """
    console.tickets.put(ticket)
    await ticket.written(RECORDING + 1.0)
    return state_of(ticket)


@router.post("/emergency", response_model=models.EmergencyView, tags=["safety"])
async def call_emergency(
    console: Here, who: Anyone, order: models.EmergencyCall | None = None
) -> JSONResponse:
    """Order DEFOCUS (or STOW) of the whole field, with proof; open to everybody signed in."""
    call = order or models.EmergencyCall()
    console.operations.emergency(who.person, call.act, call.reason)
    return answer(console.operations.emergency_view())


@router.delete("/emergency", response_model=models.EmergencyView, tags=["safety"])
async def withdraw_emergency(console: Here, who: Operator) -> JSONResponse:
    """Withdraw the emergency order; nothing moves because of it."""
    console.operations.withdraw(who.person)
    return answer(console.operations.emergency_view())


@router.post("/alarms/acknowledge", status_code=204, tags=["alarms"])
async def acknowledge(console: Here, who: Operator, which: models.Acknowledged) -> None:
    """Acknowledge an alarm."""
    console.operations.acknowledge(who.person, which.condition, which.subject)


@router.get("/authority", response_model=models.AuthorityState, tags=["authority"])
async def authority(console: Here, who: Anyone) -> models.AuthorityState:
    """Return the holder of the command authority."""
    return authority_of(console, who)


@router.post("/authority", response_model=models.AuthorityState, tags=["authority"])
async def take(console: Here, who: Operator) -> models.AuthorityState:
    """Take the command authority, or renew it; automatic control gives way."""
    here = console.operations
    grant = here.plant.authority.grant
    if grant is not None and grant.holder == who.person:
        here.keep_authority(who.person, grant.token)
    else:
        here.take_authority(who.person)
        await _told(console)
    console.present[who.person.name] = time.monotonic()
    return authority_of(console, who)


@router.post("/authority/seize", response_model=models.AuthorityState, tags=["authority"])
async def seize(console: Here, who: Operator, why: models.GivenReason) -> models.AuthorityState:
    """Break another person's command authority and take it."""
    console.operations.seize_authority(who.person, why.reason)
    await _told(console)
    console.present[who.person.name] = time.monotonic()
    return authority_of(console, who)


@router.put("/authority", response_model=models.AuthorityState, tags=["authority"])
async def keep(console: Here, who: Operator) -> models.AuthorityState:
    """Renew the command authority: every few seconds, while somebody is present."""
    console.operations.keep_authority(who.person, token_of(console, who.person))
    console.present[who.person.name] = time.monotonic()
    return authority_of(console, who)


@router.delete("/authority", response_model=models.AuthorityState, tags=["authority"])
async def release(console: Here, who: Operator) -> models.AuthorityState:
    """Release the command authority; automatic control continues."""
    console.present.pop(who.person.name, None)
    console.operations.release_authority(who.person, token_of(console, who.person))
    return authority_of(console, who)


@router.post("/stow", response_model=models.TicketState, tags=["commands"])
async def stow(console: Here, who: Operator, order: models.SomeHeliostats) -> models.TicketState:
    """Send heliostats to stow; needs no authority."""
    return console.tickets.put(console.operations.stow(who.person, order.heliostats))


@router.post("/defocus", response_model=models.TicketState, tags=["commands"])
async def defocus(console: Here, who: Operator, order: models.SomeHeliostats) -> models.TicketState:
    """Take beams off the receiver; needs no authority."""
    return console.tickets.put(console.operations.defocus(who.person, order.heliostats))


@router.post("/commands", response_model=models.TicketState, tags=["commands"])
async def command(console: Here, who: Operator, order: models.CommandOrder) -> models.TicketState:
    """Give a command of the wire: APPROACH, TRACK, IDLE, LOCK, SEARCH, JOG, ZERO, ..."""
    here, name = console.operations, order.command
    if name in ("STOW", "DEFOCUS"):
        act = here.stow if name == "STOW" else here.defocus
        return console.tickets.put(act(who.person, order.heliostats))
    if name not in OPERATOR_COMMANDS and who.person.role < Role.ENGINEER:
        raise HTTPException(403, f"{name}: {who.person.name} is operator; this needs engineer")
    token = token_of(console, who.person)
    if name == "ZERO":
        ticket = zero(here.plant, who.person, token, order.heliostats, order.values)
        here.logbook.event("command", who.person.name, f"ZERO {order.heliostats[0]}")
    else:
        ticket = here.command(who.person, token, name, order.heliostats, order.values)
    return await _recorded(console, ticket)


@router.get("/commands", response_model=list[models.TicketState], tags=["commands"])
async def commands(console: Here, who: Anyone) -> list[models.TicketState]:
    """Return the last commands given through the console, newest first."""
    del who
    return console.tickets.last()


@router.get("/commands/{identity}", response_model=models.TicketState, tags=["commands"])
async def one_command(console: Here, who: Anyone, identity: Named) -> models.TicketState:
    """Return the progress of a command."""
    del who
    return console.tickets.get(identity)


@router.post("/aim", response_model=models.TicketState, tags=["commands"])
async def aim(console: Here, who: Operator, order: models.AimOrder) -> models.TicketState:
    """Aim heliostats at a receiver or a target by name, or at points."""
    if bool(order.where) == bool(order.points):
        raise InputError("aim: give either where (a receiver or target) or points")
    token, here = token_of(console, who.person), console.operations
    if order.where:
        ticket = here.aim_at(who.person, token, order.heliostats, order.where)
    else:
        ticket = here.aim(who.person, token, dict(order.points))
    return await _recorded(console, ticket)


@router.post("/standby", response_model=models.TicketState, tags=["commands"])
async def standby(console: Here, who: Operator, order: models.StandbyOrder) -> models.TicketState:
    """Set standby points."""
    token = token_of(console, who.person)
    ticket = console.operations.standby(who.person, token, dict(order.points))
    return await _recorded(console, ticket)


@router.post("/automatic", status_code=204, tags=["commands"])
async def automatic(console: Here, who: Operator, order: models.SomeHeliostats) -> None:
    """Give heliostats to automatic control, which raises and calibrates them."""
    console.operations.give_back(who.person, order.heliostats)


@router.post("/automatic/resume", status_code=204, tags=["commands"])
async def resume(console: Here, who: Operator) -> None:
    """Let automatic control go on after a loss of many heliostats."""
    console.operations.resume(who.person)


@router.put("/calibration", response_model=models.CalibrationView, tags=["calibration"])
async def switch(console: Here, who: Operator, to: models.Switch) -> JSONResponse:
    """Switch automatic calibration on or off."""
    console.operations.switch_calibration(who.person, to.on)
    return answer(console.operations.calibration())


@router.post("/holds", response_model=models.many(models.Lockout), tags=["commands"])
async def hold(console: Here, who: Operator, order: models.HoldOrder) -> JSONResponse:
    """Take heliostats out of service: they go to stow, and nobody moves them."""
    hours = math.nan if order.hours is None else order.hours
    console.operations.hold(who.person, order.heliostats, order.reason, hours)
    return answer(console.operations.holds())


@router.post("/holds/release", response_model=models.many(models.Lockout), tags=["commands"])
async def unhold(console: Here, who: Operator, order: models.GivenBack) -> JSONResponse:
    """Give heliostats back to service by their names; nothing moves."""
    console.operations.unhold(who.person, order.heliostats)
    return answer(console.operations.holds())
