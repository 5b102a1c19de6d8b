"""The plant file as engineers edit it while the plant runs.

A new text is checked as `heliotrope field check` checks a file, and replaces the file completely;
the old file is kept as a version. Nothing moves by it. If the text differs from the text in use
only in the views of cameras and in marks on targets, which nothing but the evaluation of later
photographs uses, the plant uses it at once; otherwise the whole text takes effect when the plant
restarts. A mixture is never in use.
"""

import asyncio
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.formats import plant_edit
from heliotrope.field.formats.plant_text import (
    Difference,
    TextFinding,
    TriedText,
    plant_text,
    store_text,
    text_version,
    try_text,
)
from heliotrope.files import read_text
from heliotrope.files.limits import TOML_SIZE
from heliotrope.plant import refusals
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.marking import Marking, NewViews
from heliotrope.plant.operations.second_approval import WaitingChanges, authority_of
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.plant.workers import Worker
from heliotrope.store.records import Records

#: Keys of a camera that concern only the evaluation of its photographs.
_VIEW_KEYS = frozenset(
    ("position_m", "rotation", "focal_px", "center_px", "skew_px", "distortion", "deviation_px")
)
#: Number of stored versions that a view lists, the latest first.
_LISTED = 50


@dataclass(frozen=True)
class StoredVersion:
    """A stored version of the plant file: its name (time in UTC), and what replaced it."""

    name: str
    note: str


@dataclass(frozen=True)
class WaitingFile:
    """A text of the plant file that waits for the approval of a second engineer.

    The fields are its number, the author, the reason, the times of the request and of its end
    (POSIX s), and the difference from the present file.
    """

    number: int
    author: str
    reason: str
    at: float
    until: float
    difference: tuple[str, ...]


@dataclass(frozen=True)
class PlantFileView:
    """The plant file.

    Attributes
    ----------
    file
        Its name.
    text, version
        Its present text, and a short name of this text.
    writable
        Whether the plant's program may replace it.
    differs
        Tables that differ from the text in use, which take effect when the plant restarts.
    problem
        Why the present file cannot be used; empty if it can.
    approval
        Whether a new text needs the approval of a second engineer.
    waiting
        Text that waits for this approval.
    versions
        Stored versions, the latest first.
    """

    file: str
    text: str
    version: str
    writable: bool
    differs: tuple[Difference, ...]
    problem: str
    approval: bool
    waiting: WaitingFile | None
    versions: tuple[StoredVersion, ...]


@dataclass(frozen=True)
class PlantFileCheck:
    """The result of checking a text.

    Attributes
    ----------
    good
        Whether it can be stored.
    findings
        Errors and warnings, with their lines.
    difference
        Lines of a unified difference from the present file.
    differs
        Tables that differ from the text in use.
    at_once
        Whether the plant would use it at once; otherwise it takes effect when the plant restarts.
    """

    good: bool
    findings: tuple[TextFinding, ...]
    difference: tuple[str, ...]
    differs: tuple[Difference, ...]
    at_once: bool


@dataclass(frozen=True)
class PlantFileStored:
    """A stored text: what follows, in words, and the version that it replaced.

    The version is empty if nothing is written until a second engineer has approved the text.
    """

    text: str
    version: str


@dataclass(frozen=True)
class _Waiting:
    """What is kept of a waiting text; ``based_on`` is the version that it replaces."""

    number: int
    author: str
    reason: str
    at: float
    until: float
    based_on: str
    new_text: str

    @property
    def subject(self) -> str:
        """What the change concerns."""
        return "plant file"

    @property
    def text(self) -> str:
        """The change in words."""
        return f"PLANT FILE ({self.reason})"


class PlantFile:
    """Checks and stores new texts of the plant file.

    Parameters
    ----------
    file
        The plant file; None: the plant was started without a file of its own.
    plant, log
        The controller, and the logbook for events.
    marking
        Where views of cameras are replaced; None: there is no camera.
    visited
        Function that returns the heliostat of the visit on each target in use.
    worker
        Where texts are checked.
    records
        Store of a waiting text; None: it is lost when the program ends.
    """

    def __init__(
        self,
        file: Path | None,
        plant: PlantController,
        log: Logbook,
        marking: Marking | None,
        visited: Callable[[], Mapping[str, str]],
        worker: Worker,
        records: Records | None,
    ) -> None:
        self._file, self._plant, self._log, self._marking = file, plant, log, marking
        self._visited, self._worker = visited, worker
        self._used = "" if file is None else plant_text(file)
        self._changes = WaitingChanges(
            "plant file", plant, log, records, lambda document: _Waiting(**document)
        )
        self._turn = asyncio.Lock()

    def recall(self) -> None:
        """Continue with the text that was waiting when the plant's program ended."""
        if self._file is not None:
            self._changes.recall()

    def step(self) -> None:
        """End a waiting text that is past its deadline."""
        self._changes.step()

    # -- looking ---------------------------------------------------------------------------

    async def view(self, person: Person) -> PlantFileView:
        """Return the plant file, its versions, and how it differs from the text in use.

        Raises
        ------
        RefusedError
            If the person is not an engineer: the file may contain passwords of cameras.
        InputError
            If the plant has no file, or it cannot be read.
        """
        person.must_be(Role.ENGINEER, "plant file")
        file, waits = self._own(), next(iter(self._changes.all), None)
        text, kept = await asyncio.to_thread(lambda: (plant_text(file), plant_edit.versions(file)))
        problem, differs = "", tuple[Difference, ...]()
        if text != self._used:
            tried = await self._worker(try_text, file, text, self._used)
            problem = "" if tried.error is None else _line(tried.error)
            differs = tried.differs
        waiting = None
        if waits is not None:
            tried = await self._worker(try_text, file, waits.new_text, self._used)
            waiting = WaitingFile(
                waits.number, waits.author, waits.reason, waits.at, waits.until, tried.difference
            )
        return PlantFileView(
            file.name,
            text,
            text_version(text),
            await asyncio.to_thread(_writable, file),
            differs,
            problem,
            self._changes.needed,
            waiting,
            tuple(StoredVersion(item.name, item.note) for item in reversed(kept[-_LISTED:])),
        )

    async def stored(self, person: Person, version: str) -> str:
        """Return the text of a stored version.

        Raises
        ------
        RefusedError
            If the person is not an engineer.
        UnknownNameError
            If there is no such version.
        """
        person.must_be(Role.ENGINEER, "plant file")
        file = self._own()
        kept = await asyncio.to_thread(plant_edit.versions, file)
        names = [item.name for item in reversed(kept)]
        if version not in names:
            raise UnknownNameError("stored version", version, names)
        place = plant_edit.version_folder(file, version) / file.name
        return await asyncio.to_thread(read_text, place, "a plant file", TOML_SIZE)

    async def check(self, person: Person, text: str) -> PlantFileCheck:
        """Check a text; nothing is written.

        Raises
        ------
        RefusedError
            If the person is not an engineer.
        """
        person.must_be(Role.ENGINEER, "plant file")
        tried = await self._worker(try_text, self._own(), text, self._used)
        return PlantFileCheck(
            tried.error is None,
            tried.findings,
            tried.difference,
            tried.differs,
            tried.error is None and self._at_once(tried),
        )

    # -- storing ---------------------------------------------------------------------------

    async def store(self, person: Person, text: str, based_on: str, reason: str) -> PlantFileStored:
        """Store a text as the plant file, or let it wait for a second engineer.

        Parameters
        ----------
        person
            An engineer; needs the command authority if the text is to be used at once.
        text, based_on
            The new text, and the version of the text that it replaces.
        reason
            Reason for the audit and the stored version.

        Raises
        ------
        RefusedError
            If the person is not an engineer, gives no reason, or lacks the command authority.
        InputError
            If the text has an error, the file has changed in the meantime, a visit uses a target
            that would be seen differently, or the file cannot be written. Nothing is changed.
        """
        person.must_be(Role.ENGINEER, "plant file")
        if not reason.strip():
            raise refusals.REASON_MISSING.error(what="plant file")
        self.step()
        async with self._turn:
            if not self._changes.needed:
                return await self._write(person, "", text, based_on, reason.strip())
            await self._tried(text, based_on)
            number, now, until = self._changes.request()
            change = _Waiting(number, person.name, reason.strip(), now, until, based_on, text)
            self._changes.add(person, change)
            return PlantFileStored(
                f"change {number} of the plant file waits for another engineer's approval", ""
            )

    async def approve(self, person: Person, number: int) -> PlantFileStored:
        """Approve another engineer's text and store it.

        Raises
        ------
        RefusedError, InputError
            See `store`; a text that cannot be stored now continues to wait.
        UnknownNameError
            If no such text is waiting.
        """
        async with self._turn:
            waits = self._changes.others(person, number)
            done = await self._write(
                person, waits.author, waits.new_text, waits.based_on, waits.reason
            )
            self._changes.approved(person, waits)
            return done

    def refuse(self, person: Person, number: int, reason: str) -> None:
        """Refuse another engineer's text; see `WaitingChanges.refuse`."""
        self._changes.refuse(person, number, reason)

    def withdraw(self, person: Person, number: int) -> None:
        """Withdraw a person's own text; see `WaitingChanges.withdraw`."""
        self._changes.withdraw(person, number)

    # -- parts -----------------------------------------------------------------------------

    def _own(self) -> Path:
        if self._file is None:
            raise InputError(
                "plant file: this plant was started without a plant file of its own; start it with "
                "heliotrope run PLANT.toml"
            )
        return self._file

    async def _tried(self, text: str, based_on: str) -> TriedText:
        """Return the result of checking a text that can be stored now."""
        file = self._own()
        present = text_version(await asyncio.to_thread(plant_text, file))
        if present != based_on:
            raise InputError(
                f"plant file: {file.name} has changed since you opened it (version {present}, "
                f"yours replaces {based_on}), so nothing was stored; open it again and repeat your "
                "change"
            )
        tried = await self._worker(try_text, file, text, self._used)
        if tried.error is not None:
            raise InputError(f"plant file: {_line(tried.error)} (nothing was stored)")
        if not tried.difference:
            raise InputError("plant file: the text is the same as the current file")
        return tried

    async def _write(
        self, person: Person, author: str, text: str, based_on: str, reason: str
    ) -> PlantFileStored:
        """Store a text that a person stores or approves, and use it at once if possible."""
        file, tried = self._own(), await self._tried(text, based_on)
        views = None
        if tried.differs and self._at_once(tried):
            views = await self._views(person, author, tried)
        by = f"{author}, approved by {person.name}" if author else person.name
        tables = ", ".join(f"{d.table} {d.name}".strip() for d in tried.differs) or "no table"
        at = "takes effect immediately" if views else "takes effect when the plant restarts"
        if not tried.differs:
            at = "the plant already uses these values"
        self._plant.note(person, "PLANT FILE", f"{by}: {tables}; {at} ({reason})")
        change = f"stored from the console by {by}: {tables} ({reason})"
        # The caller may leave meanwhile; what has been written is used and recorded all the same.
        writing = asyncio.ensure_future(
            asyncio.to_thread(store_text, file, text, change, now=self._plant.clock.utc())
        )
        rest: asyncio.CancelledError | None = None
        try:
            try:
                version = await asyncio.shield(writing)
            except asyncio.CancelledError as error:
                rest, version = error, await writing
        except (OSError, InputError) as error:
            raise InputError(
                f"plant file: {file} cannot be written ({getattr(error, 'strerror', '') or error}),"
                " so nothing was changed; grant the plant's program write access to the file and "
                "its folder, or store the text on the plant's computer"
            ) from None
        if views is not None and self._marking is not None:
            self._marking.take_file(views)
        if views is not None or not tried.differs:
            self._used = text.replace("\r\n", "\n")
        said = f"plant file stored, {at}: {tables}"
        self._log.event("command", person.name, f"{said} ({reason}{f'; by {by}' * bool(author)})")
        if rest is not None:
            raise rest
        return PlantFileStored(said, version)

    def _at_once(self, tried: TriedText) -> bool:
        """Whether all differences concern only the evaluation of later photographs."""
        return all(self._only_seen(item, tried) for item in tried.differs)

    def _only_seen(self, one: Difference, tried: TriedText) -> bool:
        if self._marking is None or one.how != "changed":
            return False
        if one.table == "cameras":
            placed = any(c.name == one.name and c.position is not None for c in tried.cameras)
            return placed and set(one.keys) <= _VIEW_KEYS
        return one.table == "targets" and one.keys == ("marks",) and self._marking.sees(one.name)

    async def _views(self, person: Person, author: str, tried: TriedText) -> NewViews:
        """Return the new views, if they may be used now."""
        authority_of(self._plant, person.name, author)
        assert self._marking is not None
        changed = {table: {d.name for d in tried.differs if d.table == table}
                   for table in ("cameras", "targets")}  # fmt: skip
        cameras = tuple(c for c in tried.cameras if c.name in changed["cameras"])
        targets = tuple(t for t in tried.targets if t.name in changed["targets"])
        views = self._marking.views(cameras, targets)
        for target, heliostat in self._visited().items():
            if target in views.targets:
                raise InputError(
                    f"plant file: heliostat {heliostat} is on target {target}, whose photographs "
                    "this text would evaluate differently, so nothing was stored; store it when "
                    "the visit has ended, or switch calibration off first"
                )
        pictures = await asyncio.to_thread(views.read, self._own().parent)
        return replace(views, pictures=pictures)


def _line(finding: TextFinding) -> str:
    return f"line {finding.line}: {finding.text}" if finding.line else finding.text


def _writable(file: Path) -> bool:
    """Return whether a file can be replaced and its versions be stored beside it."""
    return os.access(file.parent, os.W_OK)
