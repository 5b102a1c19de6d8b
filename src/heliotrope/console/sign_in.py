"""Sign-in with a name and a password; checks are slowed to limit guessing."""

import asyncio
import math

from fastapi import HTTPException
from starlette.requests import HTTPConnection, Request
from starlette.responses import Response

from heliotrope.console import _secrets
from heliotrope.console.auth import Caller, Console
from heliotrope.console.by_proxy import Introduced, check_account
from heliotrope.console.hashing import CrowdError, GoneError
from heliotrope.console.headers import cookie_of, network_of
from heliotrope.console.settings import is_loopback
from heliotrope.errors import HeliotropeError
from heliotrope.plant.operations.security import SecurityEvent
from heliotrope.store.people import BY_PROXY, Account

_BY_LINK = "by the one-time link"
_WRONG_CODE = "the code is wrong or has already been used; wait for the next one"


async def log_in(
    console: Console, name: str, password: str, code: str, request: Request
) -> tuple[Account, str, float]:
    """Check a password and, if necessary, a second-factor code; then begin a session.

    Returns
    -------
    The account, and the session's secret and end, POSIX s.

    Raises
    ------
    HTTPException
        401 if name, password or code is wrong; 428 if a code is needed; 429 after too many
        failures, or while too many others sign in.
    """
    failure = SecurityEvent.SIGN_IN_FAILED
    account = await checked(console, name, password, request, failure, code)
    return account, *await _begin(console, account.name, request)


async def enter(console: Console, person: Introduced, connection: HTTPConnection) -> str:
    """Return the secret of a new session for a person whom a trusted proxy has signed in.

    Raises
    ------
    HTTPException
        403 if the person may not enter.
    HeliotropeError
        If the account cannot be created or changed.
    """
    name, role, people, now = person.name, person.role, console.people, console.now()
    account = await console.ask(lambda: people.account(name))
    check_account(person, account)
    if account is None:
        await console.ask(lambda: people.add(name, BY_PROXY, role, now))
        detail = f"{name}, {role}, as the proxy says"
        await console.note(SecurityEvent.ACCOUNT_MADE, connection, name, detail)
    elif account.role != role:
        await console.ask(lambda: people.change(name, now, role=role))
        detail = f"{name}, role {role}, as the proxy says"
        await console.note(SecurityEvent.ACCOUNT_CHANGED, connection, name, detail)
    return (await _begin(console, name, connection, "by the proxy"))[0]


async def enter_once(console: Console, secret: str, connection: HTTPConnection) -> str:
    """Return the secret of a new session of the person whom the one-time link signs in.

    Raises
    ------
    HTTPException
        403 for a caller on another computer, in which case the link remains valid; 410 if the link
        is no longer valid.
    """
    if not is_loopback(console.address(connection)):
        await console.note(
            SecurityEvent.SIGN_IN_FAILED, connection, "", f"{_BY_LINK}, from another machine"
        )
        raise HTTPException(403, "the one-time link signs in on the plant's machine only")
    name = await console.ask(lambda: console.people.enter(secret))
    if name is None:
        await console.note(SecurityEvent.SIGN_IN_FAILED, connection, "", f"{_BY_LINK}, not valid")
        raise HTTPException(410, "this one-time link is no longer valid")
    return (await _begin(console, name, connection, _BY_LINK))[0]


async def _begin(
    console: Console, name: str, connection: HTTPConnection, detail: str = ""
) -> tuple[str, float]:
    """Begin a session; return its secret and its end, POSIX s."""
    now, lifetime = console.now(), console.settings.session_s
    address = console.address(connection)
    secret = await console.ask(lambda: console.people.open_session(name, now, lifetime, address))
    await console.note(SecurityEvent.SIGNED_IN, connection, name, detail)
    return secret, now + lifetime


def set_cookie(console: Console, response: Response, secret: str) -> None:
    """Set the session cookie in a browser."""
    response.set_cookie(
        cookie_of(console.settings),
        secret,
        max_age=int(console.settings.session_s),
        path="/",
        httponly=True,
        samesite="strict",
        secure=console.settings.secure,
    )


def drop_cookie(console: Console, response: Response) -> None:
    """Remove the session cookie from a browser."""
    response.delete_cookie(
        cookie_of(console.settings),
        path="/",
        httponly=True,
        samesite="strict",
        secure=console.settings.secure,
    )


async def _known(console: Console, name: str) -> str:
    """Return a name if it is an account's name; other text typed there may be a password."""
    known = await console.ask(lambda: console.people.account(name))
    return name if known is not None else ""


async def checked(
    console: Console,
    name: str,
    password: str,
    request: Request,
    failure: SecurityEvent,
    code: str | None = None,
) -> Account:
    """Return the account for a name and password; a failed check is recorded as ``failure``.

    An account with a second factor also needs a code, unless ``code`` is None.

    Raises
    ------
    HTTPException
        401 if name, password or code is wrong; 428 if a code is needed; 429 after too many
        failures, or while too many others sign in.
    """
    attempts = console.attempts
    keys = (name, network_of(console.address(request)))
    if (wait := attempts.wait(*keys)) > 0.0:
        await console.note(SecurityEvent.LOCKED_OUT, request, await _known(console, name))
        raise _too_often("too many failed sign-ins", wait)
    # Counting only after the slow check would admit many attempts at once.
    attempts.begin(*keys)
    try:
        known = attempts.known(*keys)
        async with console.hashing.turn(keys, request.is_disconnected, known=known):
            account = await console.ask(lambda: console.people.account(name))
            usable = account is not None and not account.disabled and account.has_password
            kept = account.password_hash if account is not None and usable else None
            good = await asyncio.to_thread(_secrets.verify_password, kept, password)
    except (CrowdError, GoneError) as error:
        attempts.undo(*keys)
        raise _too_often(str(error), 1.0) from None
    except HeliotropeError:
        attempts.undo(*keys)  # the store did not answer, and nothing was guessed
        raise
    if not good or account is None:
        await console.note(failure, request, name if account is not None else "")
        raise HTTPException(401, "name or password is wrong")
    if code is not None and account.factor:
        if not code:
            attempts.undo(*keys)  # the password was correct, and no code was guessed
            raise HTTPException(428, "enter the code of your second factor too")
        await _use_code(console, name, code, request, failure)
    attempts.good(*keys)
    return account


def _too_often(why: str, wait: float) -> HTTPException:
    seconds = math.ceil(wait)
    text = f"{why}; try again in {seconds} s"
    return HTTPException(429, text, {"Retry-After": str(seconds)})


async def _use_code(
    console: Console, name: str, code: str, connection: HTTPConnection, failure: SecurityEvent
) -> None:
    """Use a code of a second factor; raise `HTTPException` if the code is wrong."""
    used = await console.ask(lambda: console.people.check_factor(name, code, console.now()))
    if used is None:
        await console.note(failure, connection, name, "wrong code of the second factor")
        raise HTTPException(401, _WRONG_CODE)
    if used.recovery:
        text = f"a recovery code was used, {used.left} are left"
        await console.note(SecurityEvent.FACTOR_CHANGED, connection, name, text)


async def confirm(
    console: Console, who: Caller, request: Request, password: str, code: str | None = None
) -> None:
    """Check that a person is present.

    This requires a session, and its owner's password (and code) again.

    Raises
    ------
    HTTPException
        403 for a token, a wrong password or a wrong code; 428 if a code is needed; 429 after too
        many failures.
    """
    if who.by != "session":
        raise HTTPException(403, "a token cannot change accounts or tokens; sign in to do so")
    if who.no_password:
        raise HTTPException(
            403,
            f"this needs your password again, but {who.person.name} has none yet; set one on "
            "the page /account",
        )
    if who.by_proxy:
        raise HTTPException(
            403,
            f"this needs your password again, but {who.person.name} has none here; ask an "
            "engineer whose account has one",
        )
    try:
        event = SecurityEvent.CONFIRMATION_FAILED
        await checked(console, who.person.name, password, request, event, code)
    except HTTPException as error:
        if error.status_code == 401:
            text = _WRONG_CODE if error.detail == _WRONG_CODE else "your current password is wrong"
            raise HTTPException(403, text) from None
        raise
