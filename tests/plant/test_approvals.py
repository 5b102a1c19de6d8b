"""Changes of parameters that wait for a second engineer: who decides, and how they end."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.approval import ApprovalSettings
from heliotrope.field.example import example_plant
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Parameters
from heliotrope.mechanism.board_items import Wanted, items_of
from heliotrope.plant.operations.approvals import Approvals
from heliotrope.plant.operations.errands import Errands
from heliotrope.plant.operations.typed_parameters import TypedParameters
from heliotrope.plant.orders.audit import read
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.plant.orders.tickets import Ticket
from support.plant_bench import ENGINEER, OPERATOR, VIEWER, Bench, running

NAME = "P1A"
ASKED = {"tilt_east": 0.004}
WHY = "levelled on 3 March"
SECOND = Person("Edda", Role.ENGINEER)
ON = ApprovalSettings(parameters=True, within=60.0)


class Kept:
    """A store of versions and of the waiting changes, and a logbook."""

    def __init__(self) -> None:
        self.versions: list[HeliostatCalibration] = []
        self.document = ""
        self.told: list[tuple[str, str]] = []

    async def read(self, query: Callable[["Kept"], Any]) -> Any:
        return query(self)

    def calibration_history(self, heliostat: str) -> list[HeliostatCalibration]:
        return [one for one in self.versions if one.heliostat == heliostat]

    def waiting_changes(self, kind: str) -> str:
        assert kind == "parameters"
        return self.document

    def keep_waiting_changes(self, kind: str, document: str) -> None:
        self.document = document

    def event(self, kind: str, who: str, text: str) -> None:
        assert kind == "command"
        self.told.append((who, text))


@dataclass
class Desk:
    """A plant with approvals; `again` is its program after a restart."""

    bench: Bench
    token: int
    kept: Kept

    def __post_init__(self) -> None:
        self.again()

    def again(self) -> None:
        self.errands = Errands(self.bench.plant.clock)
        self.typed = TypedParameters(self.bench.plant, self.kept, self.kept)
        self.approvals = Approvals(self.bench.plant, self.kept, self.typed, self.errands, self.kept)
        self.approvals.recall()

    async def ask(self, **given: object) -> tuple[int, Ticket]:
        """Ask for the change as the first engineer; return its number and ticket."""
        order = {"heliostat": NAME, "values": ASKED, "version": 0, "reason": WHY, **given}
        ticket = await self.approvals.ask(ENGINEER, **order)
        return self.approvals.waiting[-1].number, ticket

    def look(self) -> None:
        """Do what the plant does each second."""
        self.approvals.step()
        self.errands.look()

    @property
    def writes(self) -> int:
        return len(self.bench.cluster_of(NAME).of(Parameters))


Scene = Callable[[Desk], Awaitable[None]]


@pytest.fixture(autouse=True)
def _no_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    import asyncio

    async def at_once(work: Callable[..., object], *given: object) -> object:
        return work(*given)

    monkeypatch.setattr(asyncio, "to_thread", at_once)  # virtual time has no threads


def play(
    folder: Path,
    scene: Scene,
    settings: ApprovalSettings = ON,
    state: int = states.STOWED,
    holder: Person = ENGINEER,
) -> tuple[Bench, Kept]:
    made: list[Bench] = []
    kept = Kept()

    async def main(clock: VirtualClock) -> None:
        items = items_of(example_plant()[NAME].calibrated)
        design = replace(example_plant(), approval=settings)
        bench = Bench(clock, folder, design=design, wanted=Wanted({NAME: items}))
        made.append(bench)
        bench.cluster_of(NAME).stored[NAME].update(items)
        async with running(bench):
            token = await bench.commanded(holder)
            bench.plant.beliefs.subscribe(kept.versions.append)
            bench.cluster_of(NAME).set(state, NAME)
            await bench.wait(3.0)
            await scene(Desk(bench, token, kept))

    run_virtual(main)
    return made[0], kept


@pytest.mark.parametrize("holder", [ENGINEER, SECOND])
def test_two_engineers_change_a_parameter(tmp_path: Path, holder: Person) -> None:
    async def scene(desk: Desk) -> None:
        number, ticket = await desk.ask()
        (change,) = desk.approvals.waiting
        (tilt,) = change.parameters
        assert (tilt.name, tilt.unit, tilt.now, tilt.asked) == ("tilt_east", "rad", 0.0, 0.004)
        assert (change.author, change.reason, change.version) == (ENGINEER.name, WHY, 0)
        assert 0.0 < change.beam_rms <= change.beam_most
        desk.look()
        await desk.bench.wait(5.0)
        assert desk.writes == 0
        assert f"change {number} waits until" in ticket.text
        written = await desk.approvals.approve(SECOND, number)
        desk.look()
        assert f"approved by {SECOND.name}; being written" in ticket.text
        assert await written.end(20.0), written.text
        desk.look()
        assert ticket.good
        assert desk.approvals.waiting == ()
        record = desk.bench.plant.beliefs.record(NAME)
        assert record is not None
        assert (record.version, record.person, record.parameters) == (1, ENGINEER.name, ASKED)
        both = f"requested by {ENGINEER.name}, approved by {SECOND.name}"
        assert record.note == f"{WHY}; {both}"
        wanted = items_of(example_plant()[NAME].calibrated.with_parameters(ASKED))
        assert desk.bench.cluster_of(NAME).stored[NAME] == wanted

    bench, kept = play(tmp_path, scene, holder=holder)
    assert kept.document == ""
    asked, written, approved = kept.told
    assert asked[0] == ENGINEER.name
    assert asked[1].endswith(f"tilt_east 0.004 ({WHY})")
    assert written[0] == holder.name
    assert approved[0] == SECOND.name
    assert f"of {ENGINEER.name} approved" in approved[1]
    notes = [(one.who, one.what, one.note) for one in read(bench.audit.path)[0]]
    assert [(who, what) for who, what, _ in notes if what in ("APPROVAL", "PARAMETERS")] == [
        (ENGINEER.name, "APPROVAL"),
        (holder.name, "PARAMETERS"),
        (SECOND.name, "APPROVAL"),
    ]
    assert any(
        what == "PARAMETERS" and f"approved by {SECOND.name}" in note for _, what, note in notes
    )


def test_a_roll_back_waits_too(tmp_path: Path) -> None:
    async def scene(desk: Desk) -> None:
        for value in (0.004, 0.001):
            number, _ = await desk.ask(values={"tilt_east": value})
            assert await (await desk.approvals.approve(SECOND, number)).end(20.0)
            desk.bench.plant.authority.keep(ENGINEER, desk.token)
        number, _ = await desk.ask(values={}, version=1)
        (change,) = desk.approvals.waiting
        assert (change.version, change.based_on) == (1, 2)
        assert [(one.now, one.asked) for one in change.parameters] == [(0.001, 0.004)]
        record = desk.bench.plant.beliefs.record(NAME)
        assert record is not None
        assert record.version == 2
        assert await (await desk.approvals.approve(SECOND, number)).end(20.0)
        record = desk.bench.plant.beliefs.record(NAME)
        assert record is not None
        assert (record.version, record.parameters) == (3, ASKED)
        assert record.note.startswith("back to version 1: ")
        with pytest.raises(UnknownNameError, match="version of P1A '9'"):
            await desk.ask(values={}, version=9)

    play(tmp_path, scene)


def test_who_may_ask_and_decide(tmp_path: Path) -> None:
    async def scene(desk: Desk) -> None:
        for person in (OPERATOR, VIEWER):
            with pytest.raises(RefusedError, match="the command needs engineer"):
                await desk.approvals.ask(person, NAME, ASKED, 0, WHY)
        number, ticket = await desk.ask()
        with pytest.raises(RefusedError, match="Egon requested it, so another engineer must"):
            await desk.approvals.approve(ENGINEER, number)
        with pytest.raises(RefusedError, match="another engineer must decide"):
            desk.approvals.refuse(ENGINEER, number, "no")
        for person in (OPERATOR, VIEWER):
            with pytest.raises(RefusedError, match="the command needs engineer"):
                await desk.approvals.approve(person, number)
            with pytest.raises(RefusedError, match="the command needs engineer"):
                desk.approvals.refuse(person, number, "no")
        with pytest.raises(RefusedError, match="Egon requested it, so Edda can only refuse it"):
            desk.approvals.withdraw(SECOND, number)
        with pytest.raises(RefusedError, match="a reason is needed"):
            desk.approvals.refuse(SECOND, number, " ")
        with pytest.raises(UnknownNameError, match="waiting change '7'"):
            await desk.approvals.approve(SECOND, 7)
        with pytest.raises(RefusedError, match=f"change {number} of Egon is waiting"):
            await desk.ask(values={"tilt_east": 0.001})
        assert [one.number for one in desk.approvals.waiting] == [number]
        assert (desk.writes, ticket.finished) == (0, False)

    play(tmp_path, scene)


def test_what_is_not_credible_never_waits(tmp_path: Path) -> None:
    async def scene(desk: Desk) -> None:
        for given, text in (
            ({"values": {"tilt_east": 1.5}}, "more than 6 standard deviations"),
            ({"values": {"tilt_east": 0.0}}, "has these parameters, so"),
            ({"reason": " "}, "a reason"),
        ):
            with pytest.raises(InputError, match=text):
                await desk.ask(**given)
        assert desk.approvals.waiting == ()

    _, kept = play(tmp_path, scene)
    assert kept.told == []


def test_its_author_withdraws_and_another_refuses(tmp_path: Path) -> None:
    async def scene(desk: Desk) -> None:
        first, withdrawn = await desk.ask()
        desk.approvals.withdraw(ENGINEER, first)
        second, refused = await desk.ask()
        assert second > first
        desk.approvals.refuse(SECOND, second, "the level was off")
        desk.look()
        assert "withdrawn by Egon" in withdrawn.text
        assert "refused by Edda: the level was off" in refused.text
        assert [t.finished for t in (withdrawn, refused)] == [True, True]
        assert [t.good for t in (withdrawn, refused)] == [False, False]
        with pytest.raises(UnknownNameError):
            await desk.approvals.approve(SECOND, second)
        assert desk.writes == 0

    _, kept = play(tmp_path, scene)
    assert kept.document == ""
    ends = [(who, text) for who, text in kept.told if "has ended" in text]
    assert [who for who, _ in ends] == [ENGINEER.name, SECOND.name]
    assert all(f"of {ENGINEER.name} has ended" in text for _, text in ends)


def test_the_wait_ends_by_itself(tmp_path: Path) -> None:
    async def scene(desk: Desk) -> None:
        number, ticket = await desk.ask()
        await desk.bench.wait(ON.within - 5.0)
        desk.look()
        assert not ticket.finished
        await desk.bench.wait(10.0)
        with pytest.raises(RefusedError, match=r"nobody approved it by .* UTC, so it is no longer"):
            await desk.approvals.approve(SECOND, number)
        desk.look()
        assert (ticket.finished, ticket.good) == (True, False)
        assert (desk.approvals.waiting, desk.writes) == ((), 0)
        await desk.ask()
        await desk.bench.wait(ON.within + 5.0)
        desk.look()
        assert desk.approvals.waiting == ()

    _, kept = play(tmp_path, scene)
    ends = [text for who, text in kept.told if not who]
    assert len(ends) == 2
    assert all("of Egon has ended, nobody approved it by" in text for text in ends)


def test_new_parameters_overtake_it(tmp_path: Path) -> None:
    async def scene(desk: Desk) -> None:
        number, _ = await desk.ask()
        record = HeliostatCalibration(
            NAME, 1.0, ("tilt_north",), np.array([1e-3]), np.eye(1) * 1e-8, np.ones(1), version=7
        )
        desk.bench.plant.beliefs.take(record)
        with pytest.raises(
            RefusedError, match=r"has received version 7 since .*, so it is no longer"
        ):
            await desk.approvals.approve(SECOND, number)
        assert (desk.approvals.waiting, desk.writes) == ((), 0)

    play(tmp_path, scene)


def test_what_cannot_be_written_now_waits_on(tmp_path: Path) -> None:
    async def scene(desk: Desk) -> None:
        number, _ = await desk.ask()
        with pytest.raises(RefusedError, match="stow it first"):
            await desk.approvals.approve(SECOND, number)
        desk.bench.cluster_of(NAME).set(states.STOWED, NAME)
        await desk.bench.wait(3.0)
        desk.bench.plant.release_authority(ENGINEER, desk.token)
        with pytest.raises(RefusedError, match="nobody has it, so Edda must take command first"):
            await desk.approvals.approve(SECOND, number)
        desk.bench.plant.take_authority(OPERATOR)
        with pytest.raises(RefusedError, match="Olga has it"):
            await desk.approvals.approve(SECOND, number)
        assert [one.number for one in desk.approvals.waiting] == [number]

    play(tmp_path, scene, state=states.TRACKING)


def test_it_outlasts_a_restart(tmp_path: Path) -> None:
    async def scene(desk: Desk) -> None:
        number, _ = await desk.ask()
        before = desk.approvals.waiting
        desk.again()
        assert desk.approvals.waiting == before
        with pytest.raises(RefusedError, match="another engineer must decide"):
            await desk.approvals.approve(ENGINEER, number)
        assert await (await desk.approvals.approve(SECOND, number)).end(20.0)
        desk.again()
        assert desk.approvals.waiting == ()
        desk.kept.document = "[{}]"
        desk.again()
        assert "cannot be read" in desk.kept.told[-1][1]

    play(tmp_path, scene)


def test_a_plant_file_that_asks_for_it_no_more_ends_it(tmp_path: Path) -> None:
    async def ask(desk: Desk) -> None:
        await desk.ask()

    _, kept = play(tmp_path, ask)
    document = kept.document
    assert document

    async def scene(desk: Desk) -> None:
        assert not desk.approvals.needed
        desk.kept.document = document
        desk.again()
        assert (desk.approvals.waiting, desk.kept.document) == ((), "")
        assert "no longer requires a second approval" in desk.kept.told[-1][1]
        ticket = desk.typed.change(ENGINEER, desk.token, NAME, ASKED, WHY)
        assert await ticket.end(20.0)

    (tmp_path / "other").mkdir()
    play(tmp_path / "other", scene, settings=ApprovalSettings())
