"""What a visit holds when the plant's program ends: a new program gives it back, once."""

from collections.abc import Awaitable, Callable, Collection
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Command, Emergency
from heliotrope.plant.field.assigned import HELD, AssignedFile, Points
from heliotrope.plant.field.locks import CERTAIN
from heliotrope.plant.operations import Logbook, Operations
from heliotrope.plant.operations.automatic import AutomaticControl, AutomaticSettings
from heliotrope.plant.orders.audit import read
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.store.records import Kind, Lockout
from support.plant_bench import OPERATOR, Bench, running

ENGINEER = Person("Egon", Role.ENGINEER)
NAME = "P1A"
AIM, ON_TARGET = (0.1, 0.2, 16.5), (4.0, 0.0, 14.0)
AT_STOW = 1 << meanings.FLAGS.index("AT_STOW")
ROUGH = 1 << meanings.FLAGS.index("ROUGH")
STAGES = ("locked", "parameters", "read back", "unlocked")
Scene = Callable[[Bench], Awaitable[None]]


class Mirror:
    """What the local controller of `NAME` does: LOCK holds until UNLOCK, also through STOW."""

    def __init__(self, state: int, flags: int = 0) -> None:
        self.state, self.flags, self.rough = state, flags, False
        self.orders: list[str] = []

    def join(self, bench: Bench) -> None:
        self._cluster = cluster = bench.cluster_of(NAME)
        obey = cluster._obey

        async def obeyed(identity: str, name: str, heliostats: tuple[str, ...]) -> None:
            await obey(identity, name, heliostats)
            if NAME in (heliostats or cluster.names):
                self.take(name)
            self.show()

        cluster._obey = obeyed  # type: ignore[method-assign]
        self.show()

    def show(self) -> None:
        row = self._cluster.names.index(NAME)
        self._cluster.rows["state"][row] = self.state
        self._cluster.rows["flags"][row] = self.flags | (ROUGH if self.rough else 0)

    def take(self, name: str) -> None:
        self.orders.append(name)
        locked = self.state == states.LOCKED
        if name == "STOW":
            self.flags |= AT_STOW
            self.state = states.LOCKED if locked else states.STOWED
        elif name == "UNLOCK":
            self.state = states.STOWED if self.flags & AT_STOW else states.IDLE
        elif name == "LOCK":
            self.state = states.LOCKED
        elif name == "TRACK" and not locked:
            self.state = states.TRACKING
        elif name == "IDLE" and not locked:
            self.state = states.IDLE
        elif name == "ROUGH":
            self.rough = bool(self._cluster.commands(name)[-1].values[0])


def play(mirror: Mirror, store: AssignedFile, scene: Scene, *, later: float = 0.0) -> None:
    """Run a plant's program from its start until a scene is over; its visits are not ended."""

    async def main(clock: VirtualClock) -> None:
        begun = VirtualClock(clock.monotonic, clock.utc() + timedelta(seconds=later))
        folder = store.path.parent / f"run-{later}"
        folder.mkdir(exist_ok=True)
        bench = Bench(begun, folder, seed=1 + int(later > 0.0), assigned=store)
        mirror.join(bench)
        async with running(bench):
            await scene(bench)

    run_virtual(main)


async def locked_by_a_visit(bench: Bench, stage: str = "locked") -> list[object]:
    """Let a visit come to a stage of its push; return what keeps it from ending."""
    plant, token = bench.plant, await bench.commanded(ENGINEER)
    entered = plant.authority.mandate(ENGINEER, token, (NAME,), "left")
    mandate = entered.__enter__()
    steps = STAGES.index(stage)
    assert await plant.command(ENGINEER, mandate.token, "LOCK", (NAME,)).end(5.0)
    if steps >= 1:
        items = {"address": b"\x01\x00"}
        plant._orders.parameters(
            plant._orders.accept(("Egon", "engineer", "PARAMETERS"), (), (NAME,)),
            NAME,
            items,
            mandate.token,
        )
    if steps >= 2:
        await plant.stored(NAME)
    if steps >= 3:
        assert await plant.command(ENGINEER, mandate.token, "UNLOCK", (NAME,)).end(5.0)
    return [entered]


@pytest.fixture
def store(tmp_path: Path) -> AssignedFile:
    return AssignedFile(tmp_path / "assigned.json")


@pytest.mark.parametrize("stage", STAGES)
def test_a_new_program_opens_the_lock_of_a_visit(store: AssignedFile, stage: str) -> None:
    mirror, kept = Mirror(states.IDLE), list[object]()

    async def before(bench: Bench) -> None:
        kept.append(await locked_by_a_visit(bench, stage))
        assert NAME in store.read()["LOCKED"], "it is on the disk before the order is sent"

    async def after(bench: Bench) -> None:
        plant = bench.plant
        await bench.wait(10.0)
        assert mirror.orders == [], "nothing moves by itself at the start"
        if mirror.state == states.LOCKED:
            text = (
                "a calibration visit that was cut off when the plant's program ended has left "
                "it locked (since "
            )
            assert plant.locked_for(NAME).startswith(text)
        token = await bench.commanded()
        for _ in range(30):
            await bench.wait(1.0)
            plant.authority.keep(OPERATOR, token)
        assert not plant.locks.names
        assert store.read()["LOCKED"] == {}

    play(mirror, store, before)
    was, mirror.orders = mirror.state, []
    play(mirror, store, after, later=20.0)
    if was == states.LOCKED:
        assert (mirror.orders, mirror.state) == (["STOW", "UNLOCK"], states.STOWED)
    else:
        assert mirror.orders == []


@pytest.mark.parametrize("when", ["after the visit", "in the visit"])
def test_a_persons_lock_stays(store: AssignedFile, when: str) -> None:
    mirror, kept = Mirror(states.IDLE), list[object]()

    async def before(bench: Bench) -> None:
        if when == "in the visit":
            kept.append(await locked_by_a_visit(bench))
            token = bench.plant.authority.token
        else:
            token = await bench.commanded(ENGINEER)
        assert await bench.plant.command(ENGINEER, token, "LOCK", (NAME,)).end(5.0)
        assert not store.path.exists() or NAME not in store.read()["LOCKED"]

    async def after(bench: Bench) -> None:
        token = await bench.commanded()
        for _ in range(30):
            await bench.wait(1.0)
            bench.plant.authority.keep(OPERATOR, token)
        text = "locked by an order; it stays locked until someone sends UNLOCK"
        assert bench.plant.locked_for(NAME) == text

    play(mirror, store, before)
    mirror.orders = []
    play(mirror, store, after, later=20.0)
    assert (mirror.orders, mirror.state) == ([], states.LOCKED)


@pytest.mark.parametrize("later", [-60.0, CERTAIN + 60.0])
def test_a_lock_from_an_old_store_is_left_to_a_person(store: AssignedFile, later: float) -> None:
    """Somebody may have locked it since the store was copied."""
    mirror, kept = Mirror(states.IDLE), list[object]()

    async def before(bench: Bench) -> None:
        kept.append(await locked_by_a_visit(bench))

    async def after(bench: Bench) -> None:
        token = await bench.commanded()
        for _ in range(30):
            await bench.wait(1.0)
            bench.plant.authority.keep(OPERATOR, token)
        assert mirror.orders == []
        assert "ask, then send UNLOCK" in bench.plant.locked_for(NAME)
        assert await bench.plant.command(OPERATOR, token, "UNLOCK", (NAME,)).end(5.0)
        for _ in range(10):
            await bench.wait(1.0)
            bench.plant.authority.keep(OPERATOR, token)
        assert store.read()["LOCKED"] == {}

    play(mirror, store, before)
    mirror.orders = []
    play(mirror, store, after, later=later)
    assert mirror.orders == ["UNLOCK"]


@pytest.mark.parametrize("flags", [0, AT_STOW])
def test_one_that_is_out_of_service_is_opened_at_stow(store: AssignedFile, flags: int) -> None:
    mirror, kept = Mirror(states.IDLE, flags), list[object]()

    async def before(bench: Bench) -> None:
        kept.append(await locked_by_a_visit(bench))

    async def after(bench: Bench) -> None:
        bench.plant.lockouts.put([Lockout(Kind.HELIOSTAT, NAME, "Vera", "a new motor", 0.0)])
        token = await bench.commanded()
        for _ in range(20):
            await bench.wait(1.0)
            bench.plant.authority.keep(OPERATOR, token)

    play(mirror, store, before)
    mirror.orders = []
    play(mirror, store, after, later=20.0)
    orders = ["UNLOCK"] if flags else ["STOW", "UNLOCK"]
    assert (mirror.orders, mirror.state) == (orders, states.STOWED)


def test_a_new_program_sends_a_beam_back_to_its_aim(store: AssignedFile) -> None:
    mirror, kept = Mirror(states.IDLE), list[object]()

    async def before(bench: Bench) -> None:
        plant, token = bench.plant, await bench.commanded(ENGINEER)
        assert await plant.aim(ENGINEER, token, {NAME: AIM}).end(5.0)
        entered = plant.authority.mandate(ENGINEER, token, (NAME,), "left")
        mandate = entered.__enter__()
        kept.append(entered)
        for point in (ON_TARGET, (4.1, 0.0, 14.0)):
            assert await plant.aim(ENGINEER, mandate.token, {NAME: point}).end(5.0)
        assert store.read()["LENT"] == {NAME: AIM}

    async def after(bench: Bench) -> None:
        plant, row = bench.plant, bench.plant.field.place(NAME)
        await bench.wait(3.0)
        assert plant.aims[row].tolist() == [4.1, 0.0, 14.0]
        token = await bench.commanded()
        for _ in range(12):
            await bench.wait(1.0)
            plant.authority.keep(OPERATOR, token)
        np.testing.assert_array_equal(plant.aims[row], AIM)
        assert (store.read()["LENT"], store.read()["AIM"]) == ({}, {NAME: AIM})

    play(mirror, store, before)
    play(mirror, store, after, later=20.0)
    assert mirror.orders[-1] == "AIM"


def test_a_new_program_ends_a_small_movement(store: AssignedFile) -> None:
    """Its beam stands on the receiver, a little beside its aim."""
    mirror, kept, base = Mirror(states.IDLE), list[object](), (0.0, 0.0, 16.5)

    async def before(bench: Bench) -> None:
        plant, token = bench.plant, await bench.commanded(ENGINEER)
        assert await plant.aim(ENGINEER, token, {NAME: base}).end(5.0)
        assert await plant.command(ENGINEER, token, "TRACK", (NAME,)).end(5.0)
        await bench.wait(2.0)
        entered = plant.authority.mandate(ENGINEER, token, (NAME,), "receiver")
        mandate = entered.__enter__()
        kept.append(entered)
        for east in (0.01, -0.01):
            assert await plant.commands.move(
                ENGINEER, mandate.token, {NAME: (east, 0.0, 16.5)}
            ).end(5.0)
        assert (store.read()["LENT"], store.read()["AIM"]) == ({NAME: base}, {NAME: base})

    async def after(bench: Bench) -> None:
        token = await bench.commanded()
        for _ in range(12):
            await bench.wait(1.0)
            bench.plant.authority.keep(OPERATOR, token)
        (back,) = bench.cluster_of(NAME).commands("AIM")
        assert (back.heliostats, back.values) == ((NAME,), base)
        assert (store.read()["LENT"], store.read()["AIM"]) == ({}, {NAME: base})

    play(mirror, store, before)
    mirror.orders = []
    play(mirror, store, after, later=20.0)
    assert mirror.orders == ["AIM"]


def test_a_new_program_lets_a_mirror_step_roughly_again(store: AssignedFile) -> None:
    """By the plant file its drivers do not rest, so only the record of the visit says so."""
    mirror, kept = Mirror(states.IDLE), list[object]()
    mirror.rough = True

    async def before(bench: Bench) -> None:
        plant, token = bench.plant, await bench.commanded(ENGINEER)
        visit = plant.stepping.fine((NAME,))
        visit.__enter__()
        kept.append(visit)
        await bench.wait(4.0)
        plant.authority.keep(ENGINEER, token)
        assert [m.values for m in bench.cluster_of(NAME).commands("ROUGH")] == [(0.0,)]
        assert not mirror.rough
        assert store.read()["ROUGH"] == {NAME: (0.0, 0.0, 0.0)}

    async def after(bench: Bench) -> None:
        token = await bench.commanded()
        for _ in range(12):
            await bench.wait(1.0)
            bench.plant.authority.keep(OPERATOR, token)
        assert {m.values for m in bench.cluster_of(NAME).commands("ROUGH")} == {(1.0,)}
        assert mirror.rough
        assert store.read()["ROUGH"] == {}

    play(mirror, store, before)
    play(mirror, store, after, later=20.0)


def test_one_heliostat_in_detail_says_why_it_is_locked(tmp_path: Path) -> None:
    mirror = Mirror(states.IDLE)

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path)
        mirror.join(bench)
        async with running(bench):
            plant, work = bench.plant, AutomaticSettings(calibrate=False)
            shown = Operations(
                plant, log := Logbook(clock), AutomaticControl(plant, log, settings=work)
            )
            await bench.wait(2.0)
            assert shown.viewer.heliostat(NAME).locked == ""
            assert shown.automatic.view().choice == "", "it calibrates nothing"
            kept = await locked_by_a_visit(bench)
            await bench.wait(2.0)
            text = shown.viewer.heliostat(NAME).locked
            assert text.startswith("the visit to left of Egon locked it since ")
            assert text.endswith(
                " UTC; it stays locked until its parameters are written and read back"
            )
            assert kept
            bench.cluster_of(NAME).mute = True
            await bench.wait(30.0)
            assert shown.viewer.heliostat(NAME).locked == "", "its state is not known"

    run_virtual(main)


def test_only_changes_of_what_is_held_are_written() -> None:
    class Counting:
        count = 0

        def read(self) -> dict[str, dict[str, tuple[float, ...]]]:
            return {}

        def keep(self, points: object) -> None:
            del points
            self.count += 1

    store = Counting()
    points, lent = Points(("A", "B"), store), {"LENT": {"A": AIM}}
    for _ in range(3):
        points.holding(lent)[0]()
    points.holding({"LOCKED": {"A": None}})[0]()
    assert store.count == 1
    nothing = dict.fromkeys(HELD, frozenset[str]())
    held = {**nothing, "LENT": frozenset({"A"})}
    assert all(points.released(held, float(at)) is None for at in range(20))
    assert points.released(nothing, 20.0) is None, "the order may be on its way"
    work = points.released(nothing, 25.0)
    assert work is not None
    work()
    assert store.count == 2
    assert points.released(nothing, 40.0) is None


def test_an_order_that_is_not_sent_leaves_what_was_held(store: AssignedFile) -> None:
    points = Points(("A",), store)
    points.holding({"LOCKED": {"A": (5.0, 0.0, 0.0)}})[0]()
    keep, take_back = points.holding({"LOCKED": {"A": None}})
    keep()
    assert store.read()["LOCKED"] == {}
    take_back()
    assert Points(("A",), store).held["LOCKED"] == {"A": (5.0, 0.0, 0.0)}


@pytest.mark.parametrize("what", ["UNLOCK", "STOW", "ROUGH"])
def test_a_cluster_that_may_begin_no_motion_keeps_nothing_from_the_others(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An order to mirrors of two clusters was refused as a whole."""
    reason = "its clock is wrong"

    async def main(clock: VirtualClock) -> None:
        async with running(Bench(clock, tmp_path)) as bench:
            plant, token = bench.plant, await bench.commanded(ENGINEER)
            homes = list(bench.clusters.values())[:2]
            names = tuple(home.names[0] for home in homes)
            held = {homes[1].name}

            def refusal(clusters: Collection[str]) -> str | None:
                return reason if held.intersection(clusters) else None

            def given() -> set[str]:
                each = [(home, m) for home in homes for m in home.of((Command, Emergency))]
                return {n for h, m in each if m.name == what for n in m.heliostats or h.names}

            monkeypatch.setattr(plant.sentinel, "refusal", refusal)
            if what == "ROUGH":
                for home in homes:
                    home.rows["flags"][0] = ROUGH
            else:
                plant.locks.take(names, 0, plant.now())
                plant.ledger.sent("LOCK", names, plant.now())
                for home in homes:
                    home.set(states.LOCKED, home.names[0])
                if what == "STOW":
                    plant.ledger.sent("DEFOCUS", names, plant.now() + 0.5)
            await bench.wait(2.0)
            with plant.stepping.fine(names if what == "ROUGH" else ()):
                await bench.wait(6.0)
                assert given() == {names[0]}
                if what != "ROUGH":
                    text = f"command authority; now they are not: {reason}"
                    assert plant.locked_for(names[1]).endswith(text)
                plant.authority.keep(ENGINEER, token)
                held.clear()
                await bench.wait(8.0)
                assert given() == set(names)

    run_virtual(main)
    results = [r.result for r in read(tmp_path / "audit.jsonl")[0] if r.what == what]
    if what != "STOW":
        assert f"1 done, 1 refused (P2A: {reason})" in results[0]
        named = [result for result in results if reason in result]
        assert all("1 done" in result for result in named), "no order is for that one alone"
