"""Signing in: a name and a password, checked no faster than guessing may go."""

import asyncio
import math

from fastapi import HTTPException
from starlette.requests import HTTPConnection

from heliotrope.console import _secrets
from heliotrope.console.auth import Console, address_of
from heliotrope.console.edge import network_of
from heliotrope.plant.operations.security import SecurityEvent
from heliotrope.store.people import Account


async def log_in(
    console: Console, name: str, password: str, connection: HTTPConnection
) -> tuple[Account, str, float]:
    """Check a password; return account, and secret of a new session and its end, POSIX s.

    Raises
    ------
    HTTPException
        401 if name or password is wrong; 429 after too many failures.
    """
    account = await checked(console, name, password, connection, SecurityEvent.SIGN_IN_FAILED)
    now, lifetime = console.now(), console.settings.session_s
    secret = await console.ask(
        lambda: console.people.open_session(
            account.name, now, lifetime, address_of(console, connection)
        )
    )
    await console.note(SecurityEvent.SIGNED_IN, connection, name)
    return account, secret, now + lifetime


async def _known(console: Console, name: str) -> str:
    """Return a name if it is an account's: what else people type there may be a password."""
    known = await console.ask(lambda: console.people.account(name))
    return name if known is not None else ""


async def checked(
    console: Console, name: str, password: str, connection: HTTPConnection, failure: SecurityEvent
) -> Account:
    """Return the account for a name and password; a wrong one is recorded as ``failure``.

    Raises
    ------
    HTTPException
        401 if name or password is wrong; 429 after too many failures.
    """
    keys = (name, network_of(address_of(console, connection)))
    if (wait := console.attempts.wait(*keys)) > 0.0:
        seconds = math.ceil(wait)
        await console.note(SecurityEvent.LOCKED_OUT, connection, await _known(console, name))
        raise HTTPException(
            429,
            f"too many failed sign-ins; try again in {seconds} s",
            {"Retry-After": str(seconds)},
        )
    console.attempts.begin(*keys)
    account = await console.ask(lambda: console.people.account(name))
    kept = account.password_hash if account is not None and not account.disabled else None
    async with console.hashing:
        good = await asyncio.to_thread(_secrets.verify_password, kept, password)
    if not good or account is None:
        await console.note(failure, connection, name if account is not None else "")
        raise HTTPException(401, "name or password is wrong")
    console.attempts.good(*keys)
    return account
