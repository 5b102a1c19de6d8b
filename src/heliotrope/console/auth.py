"""Authentication: sessions by cookie, tokens by header, roles, and protection against forgery.

A browser has a session: scripts cannot read its cookie (HttpOnly), other sites cannot send it
(SameSite=Strict), and every change also needs the session's own token in a header, which a page
from another origin cannot read. Programs have a token (``Authorization: Bearer``).
"""

import asyncio
import contextlib
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Annotated, TypeVar, cast

from fastapi import Depends, HTTPException
from starlette.requests import HTTPConnection

from heliotrope.console import _words
from heliotrope.console._attempts import SignInFailures
from heliotrope.console.by_proxy import ByProxy, Introduced
from heliotrope.console.connections import FOUND
from heliotrope.console.hashing import Hashing
from heliotrope.console.headers import address_of, host_known, parts_of, secret_of
from heliotrope.console.live import Stream
from heliotrope.console.people import ROLES, person_of
from heliotrope.console.presence import Presence
from heliotrope.console.remote import RemotePeople, RemotePlant
from heliotrope.console.roster import Roster
from heliotrope.console.settings import ConsoleSettings
from heliotrope.errors import HeliotropeError
from heliotrope.plant.operations.security import EventCounter, SecurityEvent, plain
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.store.people import Account, ApiToken, Session

T = TypeVar("T")
#: The shared response that never changes.
FIXED = "field"
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
_API = "/api/v1"
#: Requests open to a person with an outstanding action: stop the field, see who they are, sign out.
#: `commands` lets STOW and DEFOCUS pass.
_ALWAYS = frozenset(
    {("POST", f"{_API}/{path}") for path in ("emergency", "stow", "defocus", "commands")}
    | {(method, f"{_API}/session") for method in ("GET", "HEAD", "DELETE")}
)
#: Actions that may be outstanding: what the person must do, and the requests that settle it.
DUES: dict[str, tuple[str, frozenset[tuple[str, str]]]] = {
    "password": ("change your password first", frozenset({("PUT", f"{_API}/session/password")})),
    "factor": (
        "set up your second factor first",
        frozenset({("POST", f"{_API}/session/factor"), ("PUT", f"{_API}/session/factor")}),
    ),
}
#: Requests that a page sends by itself, or that release the authority; they neither show nor
#: require that a person is present.
_BY_ITSELF = frozenset({("PUT", f"{_API}/authority"), ("DELETE", f"{_API}/authority")})
#: The request that confirms a person's presence after an absence.
_THERE = ("PUT", f"{_API}/session/presence")


@dataclass
class Console:
    """The state that the routes share."""

    plant: RemotePlant
    people: RemotePeople
    settings: ConsoleSettings
    stream: Stream
    attempts: SignInFailures
    roster: Roster[Session | ApiToken]
    presence: Presence
    #: Queue for password checks.
    hashing: Hashing = field(default_factory=Hashing)

    #: How a trusted proxy identifies users; None if it does not.
    by_proxy: ByProxy | None = None

    #: Number of heliostats; 0 before it is known, see `heliostats`.
    size: int = 0

    #: Threads that wait for the store, which is in the plant's process.
    threads: ThreadPoolExecutor = field(
        default_factory=lambda: ThreadPoolExecutor(4, "console store")
    )

    #: Counts the security events that are not sent to the plant individually.
    counter: EventCounter = field(default_factory=EventCounter)

    #: Responses that all viewers request, with their time; created at most twice a second.
    shared: dict[str, tuple[float, bytes, bytes | None]] = field(default_factory=dict)

    async def forget_expired(self) -> None:
        """Remove expired sessions and tokens from the store, and record that they have ended.

        Sessions end according to the computer's time. Security events that were only counted are
        also recorded.
        """
        while True:
            for kind, name, more in self.counter.sums(time.monotonic()):
                try:
                    await self.plant.note(kind, name, more=more)
                except HeliotropeError:
                    self.counter.count(kind, name, time.monotonic(), more)
            with contextlib.suppress(HeliotropeError):  # other parts report a full store
                for expired in await self.ask(lambda: self.people.forget_expired(self.now())):
                    ended = (
                        SecurityEvent.TOKEN_ENDED if expired.token else SecurityEvent.SESSION_ENDED
                    )
                    await self.plant.note(ended, expired.name, detail=expired.label)
            await asyncio.sleep(60.0)

    async def note(
        self, kind: SecurityEvent, connection: HTTPConnection, who: str = "", detail: str = ""
    ) -> None:
        """Record a security event that a request has caused.

        A flood of events must not cost the plant one call per event. Events are therefore counted
        here as in the plant, and `forget_expired` sends the totals.
        """
        if self.counter.admits(kind, who, time.monotonic()):
            address = self.address(connection)
            nearest = connection.client.host if connection.client else ""
            # An address stated by a proxy is no more certain than the proxy itself.
            origin = address if address == nearest else f"{address} via {nearest}"
            await self.plant.note(kind, who, origin, plain(detail))

    def address(self, connection: HTTPConnection) -> str:
        """Return the address from which a request comes; see `address_of`.

        If the proxy has a secret, the address stated by a request without that secret is not
        believed, because other programs on the proxy's computer also send requests.
        """
        if self.by_proxy is not None and not self.by_proxy.sends(connection.headers):
            return connection.client.host if connection.client else ""
        return address_of(self.settings, connection)

    async def heliostats(self) -> int:
        """Return the number of heliostats in the plant."""
        if not self.size:
            self.size = int(await self.plant.ask("size"))
        return self.size

    def forget(self) -> None:
        """Drop the shared responses that a change may have made stale."""
        fixed = self.shared.get(FIXED)
        self.shared.clear()
        if fixed is not None:
            self.shared[FIXED] = fixed

    async def ask(self, work: Callable[[], T]) -> T:
        """Return the result of work in the store.

        The work runs in a thread because the store's disk may be slow. These threads have no other
        work, so a thread that hangs does not block anything else.
        """
        return await asyncio.get_running_loop().run_in_executor(self.threads, work)

    @property
    def emergency_port(self) -> int:
        """Port of the path for EMERGENCY alone; 0 if there is none."""
        return self.settings.emergency_port or 0

    def now(self) -> float:
        """Return the computer's time, POSIX s.

        Sessions end by this time, whatever the plant's time is.
        """
        return time.time()


@dataclass(frozen=True)
class Caller:
    """An authenticated caller.

    Attributes
    ----------
    person
        The person, with the role that applies now.
    by
        "session" or "token".
    secret
        Secret of the session or token.
    expires
        End of the session or token, POSIX s; None if it never ends.
    owes
        Action that the person must take first, see `DUES`; empty if there is none.
    factor
        Whether the account has a second factor.
    by_proxy
        Whether a trusted proxy has signed that person in.
    no_password
        Whether the account has no password yet.
    """

    person: Person
    by: str
    secret: str = field(repr=False)
    expires: float | None
    owes: str = ""
    factor: bool = False
    by_proxy: bool = False
    no_password: bool = False
    #: Whether this order requires the password again, see `presence`.
    away: bool = False

    @property
    def csrf(self) -> str:
        """The token that must be sent with every change; "" for an API token."""
        return _words.csrf_of(self.secret) if self.by == "session" else ""


async def app_console(connection: HTTPConnection) -> Console:
    """Return the console of an application, from the event loop, since a thread would cost more."""
    return console_of(connection)


def console_of(connection: HTTPConnection) -> Console:
    """Return the console of an application."""
    return cast("Console", connection.app.state.console)


AppConsole = Annotated[Console, Depends(app_console)]


async def find_caller(console: Console, connection: HTTPConnection) -> Caller | None:
    """Return the caller; None if the caller is unknown or no longer valid.

    EMERGENCY accepts a recently known caller, because an emergency must not wait for a store that
    is slow or unavailable.

    Raises
    ------
    HeliotropeError
        If the store does not respond.
    """
    presented = secret_of(console.settings, connection)
    if presented is None:
        return None
    emergency = _is_emergency(connection)
    find = console.roster.find_for_emergency if emergency else console.roster.find
    record = await find(*presented)
    if record is None or (record.expires is not None and record.expires <= console.now()):
        return None
    if isinstance(record, Session):
        who = signed_in(console, record, presented[1], record.expires)
    else:
        who = Caller(person_of(record.name, record.role), *presented, record.expires)
    return who if emergency or _as_introduced(console, connection, who) else None


def introduced(console: Console, connection: HTTPConnection) -> Introduced | None:
    """Return the person whom a trusted proxy identifies; None without a proxy or a person."""
    address = connection.client.host if connection.client else ""
    if console.by_proxy is None or address not in console.settings.proxies:
        return None
    return console.by_proxy.introduced(connection.headers)


def _as_introduced(console: Console, connection: HTTPConnection, who: Caller) -> bool:
    """Return whether a session belongs to the person, and role, that the proxy now identifies."""
    if who.by != "session":
        return True
    person = introduced(console, connection)
    if person is None:
        return not who.by_proxy
    return who.by_proxy and (person.name, person.role) == (who.person.name, who.person.role.title)


def signed_in(console: Console, account: Account | Session, secret: str, expires: float) -> Caller:
    """Return the caller of a session."""
    person, least = person_of(account.name, account.role), console.settings.second_factor
    has_one = account.factor or account.by_proxy  # for users of a proxy, this is up to the proxy
    needs_factor = bool(least) and person.role >= ROLES[least] and not has_one
    owes = "password" if account.password_due else "factor" if needs_factor else ""
    return Caller(
        person,
        "session",
        secret,
        expires,
        owes,
        account.factor,
        account.by_proxy,
        account.no_password,
    )


def _is_emergency(connection: HTTPConnection) -> bool:
    scope = connection.scope
    return scope.get("method") == "POST" and str(scope.get("path")).endswith("/emergency")


def same_origin(console: Console, connection: HTTPConnection) -> bool:
    """Return whether a request comes from a page of this console, or from no page at all."""
    origin = connection.headers.get("origin")
    if origin is None:
        return True
    page = parts_of(origin)
    return page.netloc == connection.headers.get("host") and host_known(
        console.settings, page.netloc
    )


async def caller(connection: HTTPConnection, console: AppConsole) -> Caller:
    """Return the caller.

    Raises
    ------
    HTTPException
        401 if the caller is unknown; 403 if a page of another origin may have sent the request, or
        if the caller must take another action first.
    """
    if FOUND in connection.scope:
        who = cast("Caller | None", connection.scope[FOUND])
    else:
        who = await find_caller(console, connection)
    if who is None:
        if "authorization" in connection.headers:
            await console.note(SecurityEvent.TOKEN_REFUSED, connection)
        raise HTTPException(401, "sign in, or send a valid token", {"WWW-Authenticate": "Bearer"})
    changes = connection.scope.get("method", "GET") not in SAFE_METHODS
    if changes:
        # A caller that makes a change must see its effect.
        console.forget()
    if who.by == "session" and changes:
        word = connection.headers.get("x-csrf-token", "")
        if not same_origin(console, connection) or not _words.same(word, who.csrf):
            await console.note(SecurityEvent.ORIGIN_REFUSED, connection, who.person.name)
            raise HTTPException(403, "the header X-CSRF-Token is missing or not this session's")
        who = _attended(console, connection, who)
    if (connection.scope.get("method", "GET"), connection.scope["path"]) not in _ALWAYS:
        settle(who, connection)
    return who


def _attended(console: Console, connection: HTTPConnection, who: Caller) -> Caller:
    """Return the caller of a session, present or away.

    A caller who is present counts as seen.
    """
    request = (connection.scope.get("method", "GET"), connection.scope["path"])
    # Users without a password here cannot enter it again; the proxy authenticates them at its own
    # intervals.
    if request in _BY_ITSELF or who.by_proxy or who.no_password:
        return who
    if console.presence.away(who.secret):
        return replace(who, away=request != _THERE)
    console.presence.seen(who.secret)
    return who


def settle(who: Caller, connection: HTTPConnection) -> None:
    """Admit a caller who is present with nothing outstanding, or whose request settles it.

    Raises
    ------
    HTTPException
        423 if a person must first confirm their presence; 403 if another action is outstanding.
    """
    if who.away:
        raise HTTPException(
            423,
            "no order was sent from here for a while, so enter your password again; EMERGENCY, "
            "DEFOCUS and STOW are still accepted",
        )
    if who.owes:
        text, requests = DUES[who.owes]
        if (connection.scope.get("method", "GET"), connection.scope["path"]) not in requests:
            raise HTTPException(
                403,
                f"{text}: on the page /account, or by `heliotrope ctl {who.owes}`; EMERGENCY, "
                "DEFOCUS and STOW are still accepted",
            )


Anyone = Annotated[Caller, Depends(caller)]


async def refused(console: Console, connection: HTTPConnection, who: Caller) -> None:
    """Record that a caller's role is too low for a request."""
    path = f"{connection.scope.get('method', '')} {connection.scope['path']}"
    await console.note(
        SecurityEvent.ORDER_REFUSED, connection, who.person.name, f"{path} by {who.by}"
    )


@dataclass(frozen=True)
class AtLeast:
    """A dependency that admits only a minimum role.

    The guard evaluates it before the body is read.
    """

    role: Role

    async def __call__(self, who: Anyone) -> Caller:
        """Return the caller.

        Raises
        ------
        HTTPException
            403 if the role is too low.
        """
        return self.admitted(who)

    def admitted(self, who: Caller) -> Caller:
        """Return a caller whose role is high enough; see `__call__`."""
        if who.person.role < self.role:
            name, mine = who.person.name, who.person.role.name.lower()
            raise HTTPException(
                403, f"{name} has the role {mine}; this needs {self.role.name.lower()}"
            )
        return who


Operator = Annotated[Caller, Depends(AtLeast(Role.OPERATOR))]
Engineer = Annotated[Caller, Depends(AtLeast(Role.ENGINEER))]
