"""The HTTP API, version 1: the second factor of an account."""

from fastapi import APIRouter, HTTPException, Request

from heliotrope.console import models
from heliotrope.console.api import REFUSALS, AccountNamed
from heliotrope.console.auth import Anyone, AppConsole, Engineer
from heliotrope.console.sign_in import confirm
from heliotrope.plant.operations.security import SecurityEvent

router = APIRouter(prefix="/api/v1", responses=REFUSALS)


@router.post("/session/factor", response_model=models.NewFactor, tags=["people"])
async def begin_factor(
    console: AppConsole, who: Anyone, request: Request, body: models.Confirmed
) -> models.NewFactor:
    """Create the secret of your second factor, shown once.

    `PUT session/factor` activates it.
    """
    import pyotp
    import segno

    await confirm(console, who, request, body.own_password)
    name = who.person.name
    secret = await console.ask(lambda: console.people.begin_factor(name, console.now()))
    uri = pyotp.TOTP(secret).provisioning_uri(name=name, issuer_name="Heliotrope")
    return models.NewFactor(secret=secret, uri=uri, qr=segno.make(uri).svg_data_uri(scale=5))


@router.put("/session/factor", response_model=models.RecoveryCodes, tags=["people"])
async def confirm_factor(
    console: AppConsole, who: Anyone, request: Request, body: models.FactorCode
) -> models.RecoveryCodes:
    """Activate your second factor with its first code; the recovery codes are shown once."""
    if who.by != "session":
        raise HTTPException(403, "a token cannot change a second factor; sign in to do so")
    name = who.person.name
    codes = await console.ask(lambda: console.people.confirm_factor(name, body.code, console.now()))
    console.roster.forget()
    await console.note(SecurityEvent.FACTOR_CHANGED, request, name, "set up")
    return models.RecoveryCodes(codes=list(codes))


@router.delete("/session/factor", status_code=204, tags=["people"])
async def remove_own_factor(
    console: AppConsole, who: Anyone, request: Request, body: models.ConfirmedTwice
) -> None:
    """Remove your own second factor."""
    await confirm(console, who, request, body.own_password, body.own_code)
    name = who.person.name
    if not await console.ask(lambda: console.people.remove_factor(name)):
        raise HTTPException(404, f"{name} has no second factor")
    console.roster.forget()
    await console.note(SecurityEvent.FACTOR_CHANGED, request, name, "removed")


@router.delete("/accounts/{name:path}/factor", status_code=204, tags=["people"])
async def remove_factor(
    console: AppConsole,
    who: Engineer,
    request: Request,
    name: AccountNamed,
    body: models.ConfirmedTwice,
) -> None:
    """Remove another user's second factor, which ends their sessions.

    This needs a code of your own second factor.
    """
    if not who.factor:
        raise HTTPException(409, f"{who.person.name}: set up your own second factor first")
    if name == who.person.name:
        raise HTTPException(409, f"{name}: remove your own with DELETE session/factor")
    await confirm(console, who, request, body.own_password, body.own_code)
    if await console.ask(lambda: console.people.account(name)) is None:
        raise HTTPException(404, f"there is no account {name}")
    if not await console.ask(lambda: console.people.remove_factor(name)):
        raise HTTPException(404, f"{name} has no second factor")
    await console.ask(lambda: console.people.close_sessions(name))
    console.roster.forget()
    await console.note(SecurityEvent.FACTOR_CHANGED, request, who.person.name, f"removed: {name}")
