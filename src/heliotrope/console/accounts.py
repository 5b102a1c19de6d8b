"""The HTTP API, version 1: signing in and out, accounts and tokens."""

import asyncio
from dataclasses import asdict

from fastapi import APIRouter, HTTPException, Request, Response

from heliotrope.console import _secrets, models
from heliotrope.console.api import REFUSALS, AccountNamed, Named
from heliotrope.console.auth import (
    Anyone,
    AppConsole,
    Caller,
    Console,
    Engineer,
    refused,
    same_origin,
    signed_in,
)
from heliotrope.console.hashing import CrowdError, GoneError
from heliotrope.console.people import ROLES
from heliotrope.console.sign_in import confirm, drop_cookie, log_in, set_cookie
from heliotrope.plant.operations.security import SecurityEvent
from heliotrope.plant.orders.authority import Role
from heliotrope.store.people import Account

router = APIRouter(prefix="/api/v1", responses=REFUSALS)


def _who(console: Console, who: Caller) -> models.CallerState:
    return models.CallerState(
        name=who.person.name,
        role=who.person.role.name.lower(),
        by=who.by,
        expires=who.expires,
        csrf=who.csrf,
        owes=who.owes,
        factor=who.factor,
        no_password=who.no_password,
        idle_minutes=console.settings.idle_s / 60.0,
        session_hours=console.settings.session_s / 3600.0,
        sign_ins_per_hour=console.settings.sign_ins,
    )


@router.get("/session", response_model=models.CallerState, tags=["people"])
async def session(console: AppConsole, who: Anyone) -> models.CallerState:
    """Return the signed-in person, and the console's limits on sessions and sign-ins."""
    return _who(console, who)


@router.post(
    "/session",
    response_model=models.CallerState,
    tags=["people"],
    responses={
        428: {"model": models.Problem, "description": "The account has a second factor"},
        429: {"model": models.Problem, "description": "Too many failures"},
    },
)
async def sign_in(
    console: AppConsole, request: Request, response: Response, body: models.LogIn
) -> models.CallerState:
    """Sign in; the response sets the session's cookie."""
    if not same_origin(console, request):
        await console.note(SecurityEvent.ORIGIN_REFUSED, request)
        raise HTTPException(403, "this page comes from another site; sign in at the console itself")
    account, secret, expires = await log_in(console, body.name, body.password, body.code, request)
    set_cookie(console, response, secret)
    return _who(console, signed_in(console, account, secret, expires))


@router.delete("/session", status_code=204, tags=["people"])
async def sign_out(console: AppConsole, who: Anyone, request: Request, response: Response) -> None:
    """Sign out."""
    if who.by == "session":
        await console.ask(lambda: console.people.close_session(who.secret))
        console.roster.forget()
        drop_cookie(console, response)
        await console.note(SecurityEvent.SIGNED_OUT, request, who.person.name)


@router.put("/session/presence", status_code=204, tags=["people"])
async def confirm_presence(
    console: AppConsole, who: Anyone, request: Request, body: models.Confirmed
) -> None:
    """Confirm with your own password that you are present, after a page was left unattended.

    Until then, an order from a session that has not given any order for a while is refused with
    status 423.
    """
    await confirm(console, who, request, body.own_password)
    console.presence.seen(who.secret)


@router.put(
    "/session/password",
    status_code=204,
    tags=["people"],
    responses={429: {"model": models.Problem, "description": "Too many failures"}},
)
async def own_password(
    console: AppConsole, who: Anyone, request: Request, response: Response, body: models.OwnPassword
) -> None:
    """Change your own password, or set your first one; this ends your sessions and tokens."""
    if not await _without_password(console, who):
        await confirm(console, who, request, body.old)
    if body.new == body.old:
        raise HTTPException(422, "this is already your password; choose a different one")
    _secrets.check_password(body.new, who.person.name)
    await _set_password(console, who, request, who.person.name, body.new)
    drop_cookie(console, response)
    await console.note(SecurityEvent.PASSWORD_CHANGED, request, who.person.name)


@router.post("/accounts/{name:path}/password", response_model=models.GivenPassword, tags=["people"])
async def reset_password(
    console: AppConsole, who: Engineer, request: Request, name: AccountNamed, body: models.Confirmed
) -> models.GivenPassword:
    """Set a new password for a user; this ends all of the user's sessions and tokens.

    The password is shown once and must be changed at first use.
    """
    await confirm(console, who, request, body.own_password)
    if name == who.person.name:
        raise HTTPException(409, f"{name}: change your own password with PUT session/password")
    await _find(console, name, password=True)
    password = _secrets.new_password()
    await _set_password(console, who, request, name, password, due=True)
    await console.note(SecurityEvent.PASSWORD_RESET, request, who.person.name, name)
    return models.GivenPassword(name=name, password=password)


@router.get("/accounts", response_model=list[models.AccountState], tags=["people"])
async def accounts(console: AppConsole, who: Engineer) -> list[models.AccountState]:
    """Return the accounts."""
    del who
    return [_account(account) for account in await console.ask(console.people.accounts)]


@router.post("/accounts", response_model=models.AccountState, status_code=201, tags=["people"])
async def new_account(
    console: AppConsole, who: Engineer, request: Request, body: models.NewAccount
) -> models.AccountState:
    """Create an account; its password must be changed at first use."""
    await confirm(console, who, request, body.own_password)
    _secrets.check_password(body.password, body.name)
    kept = await _hashed(console, who, request, body.password)
    made = await console.ask(
        lambda: console.people.add(body.name, kept, body.role, console.now(), due=True)
    )
    what = f"{body.name}, {body.role}"
    await console.note(SecurityEvent.ACCOUNT_MADE, request, who.person.name, what)
    return _account(made)


@router.patch("/accounts/{name:path}", response_model=models.AccountState, tags=["people"])
async def change_account(
    console: AppConsole,
    who: Engineer,
    request: Request,
    name: AccountNamed,
    body: models.AccountChange,
) -> models.AccountState:
    """Change the role or password of another user's account, or disable the account."""
    await confirm(console, who, request, body.own_password)
    if name == who.person.name and body.password is not None:
        raise HTTPException(409, f"{name}: change your own password with PUT session/password")
    if name == who.person.name and (body.disabled or body.role not in (None, "engineer")):
        raise HTTPException(409, f"{name}: you cannot change your own role; ask another engineer")
    await _find(console, name, password=body.password is not None)
    kept = None
    if body.password is not None:
        _secrets.check_password(body.password, name)
        kept = await _hashed(console, who, request, body.password)
    made = await console.ask(
        lambda: console.people.change(
            name,
            console.now(),
            role=body.role,
            password_hash=kept,
            disabled=body.disabled,
            due=True,
        )
    )
    console.roster.forget()
    detail = _changes(name, body)
    await console.note(SecurityEvent.ACCOUNT_CHANGED, request, who.person.name, detail)
    return _account(made)


@router.get("/tokens", response_model=list[models.TokenState], tags=["people"])
async def tokens(console: AppConsole, who: Anyone) -> list[models.TokenState]:
    """Return your own tokens, or all tokens if you are an engineer."""
    listed = await console.ask(lambda: console.people.tokens(_whose(who)))
    return [models.TokenState(**asdict(token)) for token in listed]


@router.post("/tokens", response_model=models.TokenState, status_code=201, tags=["people"])
async def new_token(
    console: AppConsole, who: Anyone, request: Request, body: models.NewToken
) -> models.TokenState:
    """Create a token for a program; its secret is shown only in this response."""
    await confirm(console, who, request, body.own_password)
    if ROLES[body.role] > who.person.role:
        await refused(console, request, who)
        raise HTTPException(403, f"token: role {body.role} is higher than your own")
    lifetime = 86_400.0 * body.days
    made, secret = await console.ask(
        lambda: console.people.add_token(
            who.person.name, body.label, body.role, console.now(), lifetime
        )
    )
    what = f"{body.label}, {body.role}, {body.days:g} days"
    await console.note(SecurityEvent.TOKEN_MADE, request, who.person.name, what)
    return models.TokenState(**asdict(made), secret=secret)


@router.delete("/tokens/{key}", status_code=204, tags=["people"])
async def revoke(
    console: AppConsole, who: Anyone, request: Request, key: Named, body: models.Confirmed
) -> None:
    """Revoke your own token, or any token if you are an engineer."""
    await confirm(console, who, request, body.own_password)
    listed = await console.ask(lambda: console.people.tokens(_whose(who)))
    token = next((token for token in listed if token.key == key), None)
    if token is None:
        raise HTTPException(404, f"there is no token {key}")
    await console.ask(lambda: console.people.revoke_token(key))
    console.roster.forget()
    what = f"{token.label} of {token.name}"
    await console.note(SecurityEvent.TOKEN_REVOKED, request, who.person.name, what)


async def _find(console: Console, name: str, *, password: bool) -> None:
    """Check that an account exists and, if its password is to be changed, may have a password."""
    account = await console.ask(lambda: console.people.account(name))
    if account is None:
        raise HTTPException(404, f"there is no account {name}")
    if password and account.by_proxy:
        raise HTTPException(409, f"{name} signs in through the proxy and has no password here")


async def _without_password(console: Console, who: Caller) -> bool:
    """Return whether a session's account still has no password, according to the store."""
    found = await console.ask(lambda: console.people.account(who.person.name))
    return who.by == "session" and found is not None and found.no_password


async def _hashed(console: Console, who: Caller, request: Request, password: str) -> str:
    """Return the hash of a new password that a signed-in user has entered."""
    pair = (who.person.name, console.address(request))
    try:
        async with console.hashing.turn(pair, request.is_disconnected, known=True):
            return await asyncio.to_thread(_secrets.hash_password, password)
    except (CrowdError, GoneError) as error:
        raise HTTPException(429, f"{error}; try again in 1 s", {"Retry-After": "1"}) from None


async def _set_password(
    console: Console, who: Caller, request: Request, name: str, password: str, *, due: bool = False
) -> None:
    kept = await _hashed(console, who, request, password)
    await console.ask(
        lambda: console.people.change(name, console.now(), password_hash=kept, due=due)
    )
    console.roster.forget()


def _changes(name: str, change: models.AccountChange) -> str:
    """Return the changes to an account in one line."""
    parts = [name]
    if change.role is not None:
        parts.append(f"role {change.role}")
    if change.disabled is not None:
        parts.append("disabled" if change.disabled else "enabled")
    if change.password is not None:
        parts.append("new password")
    return ", ".join(parts)


def _whose(who: Caller) -> str:
    """Return the name of the user whose tokens a caller may see; "" for all users."""
    return "" if who.person.role >= Role.ENGINEER else who.person.name


def _account(account: Account) -> models.AccountState:
    return models.AccountState(
        name=account.name,
        role=account.role,
        disabled=account.disabled,
        created=account.created,
        factor=account.factor,
    )
