"""Evidence sent away from a plant's computer: security events, alarms, hash-chain heads."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path

from heliotrope.errors import HeliotropeError, InputError
from heliotrope.plant.assembly import PlantAssembly
from heliotrope.plant.io.syslog import Receiver, Syslog
from heliotrope.plant.operations.security import SecurityEvent
from heliotrope.safety import alarms
from heliotrope.store import chain
from heliotrope.store.digests import Head
from heliotrope.store.keeper import Keeper

#: Default, shortest and longest time between exports of the heads, hours.
HOURS, _LEAST, _MOST = 1.0, 0.01, 168.0
#: Interval between checks of the sender, s.
_LOOKED = 2.0


@dataclass(frozen=True)
class Evidence:
    """Options for the evidence that leaves the plant's computer.

    Attributes
    ----------
    syslog, authority
        URL of the receiver of security events and alarms, and the PEM file of its authority.
    heads, hours
        Folder to which the chain heads are written, and the interval, hours.

    Raises
    ------
    InputError
        If a URL, a folder or a time cannot be used.
    """

    syslog: str | None = None
    authority: Path | None = None
    heads: Path | None = None
    hours: float = HOURS

    def __post_init__(self) -> None:
        if self.authority is not None and self.syslog is None:
            raise InputError("run: --syslog-authority works only with --syslog tls://host")
        _ = self.receiver
        if self.heads is not None and not self.heads.is_dir():
            raise InputError(f"run: --heads {self.heads}: the folder does not exist; create it")
        if not _LEAST <= self.hours <= _MOST:
            raise InputError(
                f"run: --heads-every must be between {_LEAST:g} and {_MOST:g} h, not "
                f"{self.hours:g} h"
            )

    @property
    def receiver(self) -> Receiver | None:
        """The syslog receiver, if there is one."""
        return None if self.syslog is None else Receiver.read(self.syslog, self.authority)


@contextlib.asynccontextmanager
async def leaving(live: PlantAssembly, keeper: Keeper, chosen: Evidence) -> AsyncIterator[None]:
    """Forward security events and alarms, and export chain heads, during a block."""
    receiver, sender = chosen.receiver, None
    async with asyncio.TaskGroup() as group:
        tasks = []
        if receiver is not None:
            sender = Syslog(receiver, lambda: live.clock.utc().timestamp())
            live.logbook.forward, live.operations.security.forward = sender.alarm, sender.note
            tasks.append(group.create_task(_watch(live, sender)))
        if sender is not None or chosen.heads is not None:
            tasks.append(group.create_task(_export(live, keeper, chosen)))
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            if tasks and (sender is not None or chosen.heads is not None):
                await export(live, keeper, chosen.heads)
            if sender is not None:
                await asyncio.to_thread(sender.close)


async def _watch(live: PlantAssembly, sender: Syslog) -> None:
    """Raise and clear the alarm about messages that do not reach the receiver."""
    kind, stands, lost = alarms.SYSLOG, False, 0
    while True:
        await asyncio.sleep(_LOOKED)
        problem, more = sender.problem, sender.lost - lost
        lost += more
        if more:
            problem = f"{more} messages were lost; {problem or f'{sender.receiver} is too slow'}"
        if problem and (more or not stands):
            live.logbook.take_alarm(kind.raised(problem=problem))
        elif stands and not problem:
            live.logbook.take_alarm(kind.ended(count=lost))
        stands = bool(problem)


async def _export(live: PlantAssembly, keeper: Keeper, chosen: Evidence) -> None:
    while True:
        await export(live, keeper, chosen.heads)
        await asyncio.sleep(3600.0 * chosen.hours)


async def export(live: PlantAssembly, keeper: Keeper, folder: Path | None) -> None:
    """Write the chain heads to a folder, if one is specified, and record them as events."""
    now, kind = live.clock.utc(), alarms.HEADS

    def write() -> tuple[Head, ...]:
        with keeper.database.reading() as connection:
            heads = chain.heads(connection)
        if folder is not None:
            chain.write_heads(folder, heads, now)
        return heads

    try:
        heads = await asyncio.to_thread(write)
    except HeliotropeError as error:
        live.logbook.take_alarm(kind.raised(problem=error))
        return
    if live.logbook.stands(kind):
        live.logbook.take_alarm(kind.ended())
    for head in heads:
        live.operations.security.note(SecurityEvent.CHAIN_HEAD, detail=str(head))
