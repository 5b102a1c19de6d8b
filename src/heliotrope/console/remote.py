"""The plant as seen by a console: calls over the local interface to the plant's process.

Errors are raised as the same classes as in the plant. EMERGENCY, DEFOCUS and STOW have their own
persistent connection.
"""

import asyncio
import time
from concurrent.futures import TimeoutError as NotYetError
from pathlib import Path
from typing import Any

from heliotrope.console.roster import Key
from heliotrope.errors import HeliotropeError
from heliotrope.local import EMERGENCY, INTERNAL, ORDINARY, CallError, LocalConnection
from heliotrope.plant.interface import CALLS, remade
from heliotrope.plant.operations.security import SecurityEvent
from heliotrope.plant.orders.authority import Person
from heliotrope.store.factors import Used
from heliotrope.store.people import Account, ApiToken, Expired, Session

#: Timeout for replies about accounts, s, because the store may have to write.
_STORE = 20.0


class RemotePlant:
    """The plant in its own process.

    Parameters
    ----------
    folder
        Folder of the sockets.
    key
        Key that authenticates the plant's console.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self._ordinary = LocalConnection(folder / ORDINARY, {"key": key})
        self._urgent = LocalConnection(folder / EMERGENCY, {"key": key}, 10.0)

    async def run(self) -> None:
        """Maintain both connections until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._ordinary.run())
            group.create_task(self._urgent.run())

    async def up(self) -> None:
        """Wait until both connections are established."""
        while not (self._ordinary.up and self._urgent.up):
            await asyncio.sleep(0.05)

    async def ask(self, call: str, who: Person | None = None, /, **arguments: Any) -> Any:
        """Make a call on behalf of a person; return its value.

        Raises
        ------
        HeliotropeError
            If the plant raises this error; `AwayError` if the plant does not reply.
        RuntimeError
            If the call failed in the plant because of a program error.
        """
        return (await self.fetch(call, who, **arguments))[0]

    async def fetch(
        self, call: str, who: Person | None = None, blob: bytes = b"", /, **arguments: Any
    ) -> tuple[Any, bytes]:
        """Make a call; return the value and the blob of its reply. See `ask`."""
        known = CALLS.get(call)
        line = self._urgent if known is not None and known.urgent else self._ordinary
        behalf = None if who is None else {"name": who.name, "role": who.role.title}
        try:
            return await line.ask(call, arguments, blob, on_behalf=behalf)
        except CallError as error:
            if error.kind == INTERNAL:
                raise RuntimeError(f"{call}: {error}") from None
            raise remade(error) from None

    async def valid(self, used: list[str]) -> dict[Key, Session | ApiToken]:
        """Return all valid sessions and tokens; see `People.valid`."""
        found = await self.ask("people.valid", now=time.time(), used=used)
        sessions = {("session", one["key"]): Session(**one) for one in found["sessions"]}
        return sessions | {("token", one["key"]): ApiToken(**one) for one in found["tokens"]}

    async def note(
        self, kind: SecurityEvent, who: str, address: str = "", detail: str = "", more: int = 0
    ) -> None:
        """Record a security event in the plant; see `SecurityLog.note`."""
        given = {"who": who, "address": address, "detail": detail, "more": more}
        await self.ask("note", None, kind=kind.name, **given)


class RemotePeople:
    """Accounts, sessions and tokens in the plant's store, as in `store.people.People`.

    The methods wait for the plant's process and must therefore be called in threads.

    Parameters
    ----------
    plant
        The plant.
    """

    def __init__(self, plant: RemotePlant) -> None:
        self._plant = plant
        self._loop: asyncio.AbstractEventLoop | None = None

    def begin(self) -> None:
        """Use the running event loop for the calls."""
        self._loop = asyncio.get_running_loop()

    def _ask(self, call: str, **arguments: Any) -> Any:
        assert self._loop is not None
        asked = self._plant.ask(f"people.{call}", **arguments)
        done = asyncio.run_coroutine_threadsafe(asked, self._loop)
        try:
            return done.result(_STORE)
        except NotYetError:
            done.cancel()
            raise HeliotropeError(
                f"the plant's store has not answered for {_STORE:g} s; check the disk or database"
            ) from None

    def account(self, name: str) -> Account | None:
        """Return an account; None if the name is unknown."""
        values = self._ask("account", name=name)
        return None if values is None else Account(**values)

    def accounts(self) -> tuple[Account, ...]:
        """Return all accounts, sorted by name."""
        return tuple(Account(**values) for values in self._ask("accounts"))

    def add(
        self, name: str, password_hash: str, role: str, now: float, *, due: bool = False
    ) -> Account:
        """Create an account; see `People.add`."""
        values = {"name": name, "password_hash": password_hash, "role": role, "now": now}
        return Account(**self._ask("add", **values, due=due))

    def change(
        self,
        name: str,
        now: float,
        *,
        password_hash: str | None = None,
        role: str | None = None,
        disabled: bool | None = None,
        due: bool = False,
    ) -> Account:
        """Change an account; see `People.change`."""
        return Account(
            **self._ask(
                "change",
                name=name,
                now=now,
                password_hash=password_hash,
                role=role,
                disabled=disabled,
                due=due,
            )
        )

    def enter(self, secret: str) -> str | None:
        """Use the one-time link; see `OneTimeLink.use`."""
        found = self._ask("enter", secret=secret)
        return None if found is None else str(found)

    def open_session(self, name: str, now: float, lifetime: float, note: str = "") -> str:
        """Return the secret of a new session; see `People.open_session`."""
        return str(self._ask("open_session", name=name, now=now, lifetime=lifetime, note=note))

    def close_session(self, secret: str) -> None:
        """End a session, if it exists."""
        self._ask("close_session", secret=secret)

    def close_sessions(self, name: str) -> None:
        """End all sessions of an account."""
        self._ask("close_sessions", name=name)

    def begin_factor(self, name: str, now: float) -> str:
        """Return the secret of a new second factor; see `Factors.begin`."""
        return str(self._ask("begin_factor", name=name, now=now))

    def confirm_factor(self, name: str, code: str, now: float) -> tuple[str, ...]:
        """Activate a second factor; see `Factors.confirm`."""
        return tuple(self._ask("confirm_factor", name=name, code=code, now=now))

    def check_factor(self, name: str, code: str, now: float) -> Used | None:
        """Use a code of a second factor; see `Factors.check`."""
        values = self._ask("check_factor", name=name, code=code, now=now)
        return None if values is None else Used(**values)

    def remove_factor(self, name: str) -> bool:
        """Remove an account's second factor; see `Factors.remove`."""
        return bool(self._ask("remove_factor", name=name))

    def add_token(
        self, name: str, label: str, role: str, now: float, lifetime: float | None = None
    ) -> tuple[ApiToken, str]:
        """Create a token for an account; see `People.add_token`."""
        made, secret = self._ask(
            "add_token", name=name, label=label, role=role, now=now, lifetime=lifetime
        )
        return ApiToken(**made), str(secret)

    def tokens(self, name: str = "") -> tuple[ApiToken, ...]:
        """Return the tokens of an account, or all tokens, oldest first."""
        return tuple(ApiToken(**values) for values in self._ask("tokens", name=name))

    def revoke_token(self, key: str) -> None:
        """Remove a token by its key, if it exists."""
        self._ask("revoke_token", key=key)

    def forget_expired(self, now: float) -> tuple[Expired, ...]:
        """Remove expired sessions and tokens; see `People.forget_expired`."""
        return tuple(Expired(**values) for values in self._ask("forget_expired", now=now))
