"""The plant's local interface at run time: two sockets, each with its own thread.

The plant's event loop runs only the calls, one at a time per socket, and those of the ordinary
socket for a limited fraction of its time. Accepting connections, checking keys and tokens, reading,
writing and converting views are done in the threads, which use real time.
"""

import asyncio
import contextlib
import functools
import hashlib
import hmac
import logging
import math
import secrets
import threading
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from heliotrope.errors import HeliotropeError, InputError, UnknownNameError
from heliotrope.local import EMERGENCY, ORDINARY, Frame, LocalLimits, LocalServer, socket_folder
from heliotrope.local.sockets import make_folder, name_here
from heliotrope.plant import refusals
from heliotrope.plant.interface.admission import Admission
from heliotrope.plant.interface.calls import CALLS, Call, Later, WithBlob, asked
from heliotrope.plant.interface.desk import Desk
from heliotrope.plant.interface.encoding import plain
from heliotrope.plant.interface.errors import kind_of
from heliotrope.plant.interface.one_time_link import OneTimeLink
from heliotrope.plant.interface.orders import Beat
from heliotrope.plant.operations.operations import Operations
from heliotrope.plant.operations.security import SecurityEvent
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.store.factors import KEY_FILE, Factors
from heliotrope.store.people import People

T = TypeVar("T")
_LOG = logging.getLogger(__name__)
#: Fraction of the plant's event loop time that the calls of the two sockets may take.
_SHARE = {ORDINARY: 0.25, EMERGENCY: 0.5}
#: Role of the plant's user and of root at the two sockets, where they need no token.
_WITHOUT = {ORDINARY: Role.VIEWER, EMERGENCY: Role.OPERATOR}
#: Longest pause after a call, s.
_PAUSE = 1.0
#: Time allowed for the store to find a token, and time for which a token found earlier is trusted
#: if the store fails, s.
_STORE, _TRUSTED = 1.0, 3600.0
#: Refused callers are recorded at most this often, s.
_NOTED = 10.0
_MOST_KNOWN = 100
#: Both processes of a console have a place at each socket, and so have their replacements.
_LIMITS = LocalLimits(reserved=4)
#: Time allowed for the threads to end, s.
_END = 5.0


@dataclass(frozen=True)
class LocalCaller:
    """Who is at the other end of a connection.

    A console (None) names the person with each request.
    """

    person: Person | None

    @property
    def reserved(self) -> bool:
        """Whether this caller has a reserved place, as a console does."""
        return self.person is None


class PlantInterface:
    """The interface of one plant.

    Parameters
    ----------
    operations
        The running plant.
    people
        Accounts, sessions and tokens.
    data
        Folder of the plant, which contains the folder of the sockets.

    Attributes
    ----------
    folder
        Folder of the sockets.
    key
        Secret that authenticates a console; created at each start.
    admission
        Limits on ordinary orders.
    heard
        When each part of a console last sent a sign of life, monotonic time of the computer, s.
    addresses
        Addresses at which the parts of a console listen.
    """

    def __init__(self, operations: Operations, people: People, data: Path) -> None:
        self._desk, self._people = Desk(operations), people
        self._factors = people.factors(data / KEY_FILE)
        self.folder, self.key = socket_folder(data), secrets.token_hex(32)
        self.heard, self.addresses = dict[str, float](), dict[str, str]()
        self._known: dict[str, tuple[float, Person]] = {}
        self._noted = -math.inf
        self.admission, self._link = Admission(), OneTimeLink()
        #: Threads that wait for the store; if they hang, they block nothing else.
        self._threads = ThreadPoolExecutor(4, "plant people")
        self._plant: asyncio.AbstractEventLoop | None = None

    @contextlib.asynccontextmanager
    async def running(
        self, *beside: Callable[[], Coroutine[Any, Any, None]]
    ) -> AsyncIterator["PlantInterface"]:
        """Serve while a block runs; ``beside`` runs in the thread of the ordinary socket.

        The block itself runs in the plant's event loop.

        Raises
        ------
        InputError
            If the sockets cannot be created.
        """
        self._plant = asyncio.get_running_loop()
        make_folder(self.folder)
        threads = [
            _LoopThread(self._listener(EMERGENCY)),
            _LoopThread(self._listener(ORDINARY), beside),
        ]
        try:
            for thread in threads:
                thread.start()
            async with asyncio.TaskGroup() as group:
                keeping = group.create_task(self._desk.keep_authority())
                yield self
                keeping.cancel()
        finally:
            for thread in threads:
                await asyncio.to_thread(thread.close)
            self._threads.shutdown(wait=False, cancel_futures=True)

    @property
    def begun(self) -> bool:
        """Whether the plant is running: it controls a field that is ready."""
        return self._desk.operations.begun.is_set()

    def one_time_link(self, name: str, address: str) -> str:
        """Return a short-lived link that signs an account in once, without its password.

        Parameters
        ----------
        name
            The account.
        address
            Address of the console.

        Raises
        ------
        InputError
            If the plant is real.
        """
        if not self._desk.operations.simulated:
            raise InputError(
                "one-time link: not available for a real plant, whose users sign in with passwords"
            )
        return f"{address}enter?once={self._link.make(name)}"

    def in_plant(self, work: Callable[[], T]) -> "Future[T]":
        """Run work in the plant's event loop, from any thread."""
        assert self._plant is not None
        done: Future[T] = Future()

        def run() -> None:
            if done.set_running_or_notify_cancel():
                try:
                    done.set_result(work())
                except BaseException as error:  # noqa: BLE001 - it goes to the caller
                    done.set_exception(error)

        self._plant.call_soon_threadsafe(run)
        return done

    async def _wait_in_plant(self, work: Coroutine[Any, Any, T]) -> T:
        """Run awaitable work in the plant's event loop; this is awaited in another event loop."""
        assert self._plant is not None
        return await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(work, self._plant))

    # -- who is calling --------------------------------------------------------------------

    async def _caller(self, socket: str, hello: dict[str, Any], user: int) -> LocalCaller | None:
        """Return the caller who sent a first frame; None if the key or the token is not valid.

        The plant's own user and root need neither key nor token, because they could stop the plant
        or read its store anyway. They may order EMERGENCY, DEFOCUS and STOW, and see everything.
        """
        key, token = hello.get("key"), hello.get("token")
        if hello == {"user": True}:
            return LocalCaller(Person(name_here(user), _WITHOUT[socket]))
        if isinstance(key, str) and hmac.compare_digest(key.encode(), self.key.encode()):
            return LocalCaller(None)
        person = await self._person(token) if isinstance(token, str) else None
        if person is not None:
            return LocalCaller(person)
        if time.monotonic() - self._noted >= _NOTED:
            self._noted = time.monotonic()
            self._note(SecurityEvent.TOKEN_REFUSED, "", "by a caller on this machine")
        return None

    def _note(self, kind: SecurityEvent, who: str, detail: str) -> None:
        """Record a security event; the log limits the number of events."""
        note = self._desk.operations.security.note
        self.in_plant(lambda: note(kind, who, detail=detail))

    async def _person(self, token: str) -> Person | None:
        """Return the person of a token, as last known if the store does not respond."""
        name = hashlib.sha256(token.encode()).hexdigest()
        try:
            async with asyncio.timeout(_STORE):
                found = await asyncio.to_thread(self._people.token, token, time.time())
        except (TimeoutError, HeliotropeError):
            at, person = self._known.get(name, (-math.inf, None))
            return person if time.monotonic() - at < _TRUSTED else None
        self._known.pop(name, None)
        if found is None:
            return None
        person = Person(found.name, Role[found.role.upper()])
        if len(self._known) >= _MOST_KNOWN:
            self._known.clear()
        self._known[name] = time.monotonic(), person
        return person

    # -- the calls -------------------------------------------------------------------------

    def _listener(self, name: str) -> LocalServer[LocalCaller]:
        calls = {key: call for key, call in CALLS.items() if call.urgent == (name == EMERGENCY)}
        turns = _Turns(self, _SHARE[name])

        async def answer(caller: LocalCaller, frame: Frame) -> tuple[Any, bytes]:
            return await self._answer(calls, turns, caller, frame)

        def blob(caller: LocalCaller, head: dict[str, Any]) -> bool:
            with contextlib.suppress(InputError):
                call, person = calls.get(_called(head)[0]), caller.person
                if call is not None and call.pack is not None:
                    return person is None or person.role >= call.role
            return False

        return LocalServer(
            self.folder / name,
            functools.partial(self._caller, name),
            answer,
            kind_of,
            blob,
            _LIMITS,
        )

    async def _answer(
        self, calls: dict[str, Call], turns: "_Turns", caller: LocalCaller, frame: Frame
    ) -> tuple[Any, bytes]:
        """Return the value and blob of the reply to a request."""
        name, given = _called(frame.head)
        if caller.person is None and name == "heartbeat":
            beat = _checked(Beat, given)
            self.heard[beat.part], self.addresses[beat.part] = time.monotonic(), beat.address
            return None, b""
        people = _people_calls(self._people, self._factors, self._link)
        if caller.person is None and name in people:
            work = functools.partial(people[name], **given)
            loop = asyncio.get_running_loop()
            return plain(await loop.run_in_executor(self._threads, work)), b""
        call = calls.get(name)
        if call is None or (call.console and caller.person is not None):
            raise UnknownNameError("call", name[:64], sorted(calls))
        arguments = _checked(call.arguments, given)
        person = caller.person or _on_behalf(frame.head.get("for"))
        if person.role < call.role:
            if caller.person is not None:  # a console has recorded it, with the caller's address
                self._note(SecurityEvent.ORDER_REFUSED, person.name, f"{name} on this machine")
            raise refusals.ROLE_TOO_LOW.error(
                what=name, person=person.name, role=person.role.title, needed=call.role.title
            )
        if call.counted:
            self.admission.admit(name, person)
        value = await turns.do(call, self._desk, person, arguments, frame.blob)
        if isinstance(value, Later):
            value = await self._wait_in_plant(value.wait())
        if isinstance(value, WithBlob):
            return plain(value.value), value.blob
        return plain(value), b""


class _Turns:
    """Runs one call at a time in the plant's event loop, for a limited fraction of the time."""

    def __init__(self, interface: PlantInterface, share: float) -> None:
        self._interface, self._rest = interface, 1.0 / share - 1.0
        self._turn, self._free_at = asyncio.Lock(), -math.inf

    async def do(self, call: Call, desk: Desk, person: Person, given: Any, blob: bytes) -> Any:
        """Run a call; return its value."""
        async with self._turn:
            await asyncio.sleep(max(0.0, self._free_at - time.monotonic()))
            took = 0.0

            def timed() -> Any:
                nonlocal took
                begin = time.perf_counter()
                try:
                    return call.work(desk, person, given, blob)
                finally:
                    took = time.perf_counter() - begin

            try:
                return await asyncio.wrap_future(self._interface.in_plant(timed))
            finally:
                self._free_at = time.monotonic() + min(self._rest * took, _PAUSE)


class _LoopThread:
    """A thread with an ordinary event loop that serves one socket, reopened after a failure."""

    def __init__(
        self,
        server: LocalServer[LocalCaller],
        beside: Sequence[Callable[[], Coroutine[Any, Any, None]]] = (),
    ) -> None:
        self._server, self._beside = server, beside
        self._loop: asyncio.AbstractEventLoop | None = None
        self._over = threading.Event()
        self._main: asyncio.Task[None] | None = None
        self._thread = threading.Thread(target=self._run, name="plant interface", daemon=True)

    def start(self) -> None:
        """Listen, and begin to serve."""
        self._server.open()
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._over.set()
        if self._loop is not None and self._main is not None and not self._loop.is_closed():
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._main.cancel)
        if self._thread.ident is not None:
            self._thread.join(_END)
        self._server.close()

    def _run(self) -> None:
        while not self._over.is_set():
            try:
                asyncio.run(self._serve())
            except asyncio.CancelledError:
                continue
            except Exception:  # noqa: BLE001 - it is logged
                _LOG.exception("local interface")
                self._over.wait(1.0)
                with contextlib.suppress(HeliotropeError):
                    self._server.open()

    async def _serve(self) -> None:
        self._loop, self._main = asyncio.get_running_loop(), asyncio.current_task()
        if self._over.is_set():
            return
        async with asyncio.TaskGroup() as group:
            group.create_task(self._server.run())
            for work in self._beside:
                group.create_task(work())


def _called(head: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the name and arguments of a call, which may also be written as an API request.

    Raises
    ------
    InputError
        If the request has no name or no arguments.
    """
    name, given = head.get("call"), head.get("arguments")
    if not isinstance(name, str) or not isinstance(given, dict):
        raise InputError("local interface: a request must contain a call and its arguments")
    if " " not in name:
        return name, given
    name, named = asked(name)
    return name, {**given, **named}


def _people_calls(
    people: People, factors: Factors, link: OneTimeLink
) -> dict[str, Callable[..., Any]]:
    """Return the calls that only a console may make.

    They run in threads rather than in the event loop.
    """
    return {
        "people.account": people.account,
        "people.accounts": people.accounts,
        "people.add": people.add,
        "people.change": people.change,
        "people.enter": link.use,
        "people.open_session": people.open_session,
        "people.close_session": people.close_session,
        "people.close_sessions": people.close_sessions,
        "people.add_token": people.add_token,
        "people.tokens": people.tokens,
        "people.valid": people.valid,
        "people.revoke_token": people.revoke_token,
        "people.forget_expired": people.forget_expired,
        "people.begin_factor": factors.begin,
        "people.confirm_factor": factors.confirm,
        "people.check_factor": factors.check,
        "people.remove_factor": factors.remove,
    }


def _checked(model: Any, given: dict[str, Any]) -> Any:
    """Return validated arguments.

    Raises
    ------
    InputError
        If they are invalid.
    """
    try:
        return model.model_validate(given)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(map(str, first["loc"]))
        raise InputError(f"{place}: {first['msg']}") from None


def _on_behalf(given: Any) -> Person:
    """Return the person for whom a console acts; without a person, only viewing is allowed."""
    if given is None:
        return Person("console", Role.VIEWER)
    try:
        return Person(str(given["name"]), Role[str(given["role"]).upper()])
    except (KeyError, TypeError):
        raise InputError("local interface: for must contain a name and a role") from None
