"""The plant against scripted clusters: state, authority, stages, joining, leases, audit."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import pytest

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.example import example_plant
from heliotrope.field.volumes import Sphere
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.in_process import Faults
from heliotrope.links.messages import (
    NODE,
    Answer,
    Ask,
    ClusterStatus,
    Command,
    Emergency,
    Lease,
    Parameters,
    Progress,
    Stage,
    encode,
)
from heliotrope.mechanism.board_items import Wanted, items_of
from heliotrope.mechanism.machine import AxisLimits, Machine
from heliotrope.mechanism.tracking import track
from heliotrope.plant.field.cluster_alarms import ClusterAlarms
from heliotrope.plant.orders.audit import AuditError, read
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.settings import PlantSettings
from heliotrope.safety import Alarm, Severity, alarms
from support.plant_bench import ENGINEER, OPERATOR, VIEWER, Bench, running

Play = Callable[[Bench], Awaitable[None]]


def play(folder: Path, scene: Play, seed: int = 0, **options: Any) -> Bench:
    """Run a scene in virtual time."""
    made: list[Bench] = []

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, folder, **options)
        made.append(bench)
        async with running(bench):
            await scene(bench)

    run_virtual(main, seed)
    return made[0]


def test_nothing_moves_by_itself_and_everything_is_known(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        await bench.wait(20.0)
        plant, now = bench.plant, bench.clock.monotonic()
        assert plant.field.counted(now) == {"STOWED": 18}
        assert plant.field.age(now).max() <= 1.5
        one = plant.field.of("P6A", now)
        assert (one.state, one.cluster, one.live, one.text) == (
            "STOWED",
            "pod-6",
            True,
            "P6A: STOWED",
        )

    bench = play(tmp_path, scene)
    for cluster in bench.clusters.values():
        assert {type(message) for _, message in cluster.taken} == {Lease}
        assert {lease.token for lease in cluster.of(Lease)} == {0}
        assert len(cluster.of(Lease)) >= 20
    assert read(bench.audit.path) == ([], 0)


def test_what_is_old_is_masked_and_not_shown_as_live(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        bench.lines["pod-1"].cut()
        bench.cluster_of("P2B").age_ms[1] = 5000
        bench.cluster_of("P2C").age_ms[2] = -1
        await bench.wait(4.0)
        now = bench.clock.monotonic()
        masked = np.ma.getmaskarray(plant.field.values("state", now))
        stale = [name for name, m in zip(plant.field.names, masked, strict=True) if m]
        assert stale == ["P1A", "P1B", "P1C", "P2B", "P2C"]
        assert plant.field.counted(now) == {"STOWED": 13, "stale": 5}
        shown = plant.field.of("P1A", now)
        assert (shown.live, shown.state, shown.counts) == (False, "", (0, 0))
        assert "not heard for" in shown.text
        # P2C was heard before it was lost; its row is the old one.
        assert plant.field.age(now)[plant.field.place("P2C")] > 3.0
        with pytest.raises(UnknownNameError, match="value of a heliostat 'stat'"):
            plant.field.values("stat", now)

    play(tmp_path, scene)


def test_a_command_comes_through_all_stages(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        token = await bench.commanded()
        bench.cluster_of("P1A").stubborn.add("P1A")
        bench.cluster_of("P2A").deaf.add("P2A")
        ticket = bench.plant.command(OPERATOR, token, "APPROACH", ("P1A", "P1B", "P2A", "P3A"))
        assert ticket.counted() == {"waiting": 4}
        assert ticket.stage("P1A") is None
        assert not await ticket.reached(Stage.ACKNOWLEDGED, timeout=2.0)
        assert ticket.stage("P1A") is Stage.REFUSED
        assert ticket.stage("P1B") is Stage.DONE
        assert ticket.stage("P2A") is Stage.SENT
        begin = bench.clock.monotonic()
        assert not await ticket.end()
        assert 9.0 < bench.clock.monotonic() - begin < 14.0
        assert ticket.counted() == {"done": 2, "refused": 1, "failed": 1}
        assert ticket.refusals == {
            "P1A": "not in this state",
            "P2A": "no reply before the command expired",
        }
        assert "P1A: not in this state" in ticket.text
        assert not ticket.good

    bench = play(tmp_path, scene)
    sent = bench.cluster_of("P1A").commands("APPROACH")
    assert [message.heliostats for message in sent] == [("P1A", "P1B")]
    records, torn = read(bench.audit.path)
    mine = [record for record in records if record.what == "APPROACH"]
    assert torn == 0
    assert [(r.who, r.role, r.heliostats) for r in mine] == [
        ("Olga", "operator", ("P1A", "P1B", "P2A", "P3A"))
    ]
    assert mine[0].result.startswith("APPROACH: 2 done, 1 refused, 1 failed (P1A: not in")


def test_only_the_one_authority_commands(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        with pytest.raises(RefusedError, match="nobody has it, so Olga must take command first"):
            plant.command(OPERATOR, 1, "APPROACH")
        with pytest.raises(RefusedError, match="Vera is viewer, but the command needs operator"):
            plant.take_authority(VIEWER)
        token = await bench.commanded()
        with pytest.raises(RefusedError, match="Olga has it and renewed it 0 s ago"):
            plant.take_authority(ENGINEER)
        with pytest.raises(
            RefusedError, match="Olga has it, so the order of Olga was not sent; take"
        ):
            plant.command(OPERATOR, token + 1, "APPROACH")
        with pytest.raises(
            RefusedError, match="JOG: Olga is operator, but the command needs engineer"
        ):
            plant.command(OPERATOR, token, "JOG", ("P1A",), (0, 10))
        with pytest.raises(RefusedError, match="a reason is needed"):
            plant.seize_authority(ENGINEER, " ")
        new = plant.seize_authority(ENGINEER, "wind is coming").token
        assert new not in (0, token)
        with pytest.raises(RefusedError, match="Egon has it"):
            plant.command(OPERATOR, token, "APPROACH")
        with pytest.raises(RefusedError, match="Olga as operator cannot break it"):
            plant.seize_authority(OPERATOR, "mine")
        await bench.wait(2.0)
        assert {c.token for c in bench.clusters.values()} == {new}
        plant.authority.keep(ENGINEER, new)
        await bench.wait(16.0)
        assert plant.authority.grant is None
        assert {c.token for c in bench.clusters.values()} == {0}
        with pytest.raises(RefusedError, match="nobody has it"):
            plant.command(ENGINEER, new, "APPROACH")

    bench = play(tmp_path, scene)
    assert not any(cluster.commands("APPROACH") for cluster in bench.clusters.values())
    records, _ = read(bench.audit.path)
    assert [(r.who, r.what, r.note, r.result) for r in records] == [
        ("Olga", "AUTHORITY", "taken", "done"),
        ("Egon", "AUTHORITY", "broken, from Olga: wind is coming", "done"),
    ]


def test_defocus_and_stow_are_taken_from_anybody(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        for cluster in bench.clusters.values():
            cluster.set(states.TRACKING)
        assert await bench.plant.defocus("a passer-by", ("P1A", "P2A")).end(2.0)
        assert bench.count(states.DEFOCUSED) == 2
        assert await bench.plant.stow("a passer-by").end(2.0)
        assert bench.count(states.STOWED) == 18
        # What is suggested instead is a command.
        with pytest.raises(UnknownNameError, match=r"'AIM'; did you mean LOCK_AIM\?$"):
            bench.plant.command(OPERATOR, 0, "AIM", ("P1A",))
        with pytest.raises(UnknownNameError, match="no heliostat 'P9'"):
            bench.plant.stow("a passer-by", ("P9",))

    bench = play(tmp_path, scene)
    records, _ = read(bench.audit.path)
    assert [(r.who, r.what, r.heliostats) for r in records] == [
        ("a passer-by", "DEFOCUS", ("P1A", "P2A")),
        ("a passer-by", "STOW", ()),
    ]
    assert [r.result for r in records] == ["DEFOCUS: 2 done", "STOW: 18 done"]


@pytest.mark.parametrize(
    ("name", "values", "said"),
    [
        ("DANCE", (), "no command"),
        ("AIM", (1.0, 2.0, 3.0), "given by aim and standby"),
        ("SET_STOW", (1, 2), "no command"),
        ("JOG", (0,), "JOG: got 1 numbers, but the command takes 2"),
        ("JOG", (0, 0.5), "cannot be sent"),
        ("JOG", (0, 2**31), "cannot be sent"),
        ("SEARCH", (float("nan"), 1.0), "specify finite numbers"),
        ("SEARCH", (1e-3, float("inf")), "specify finite numbers"),
        ("SEARCH", (1e300, 1.0), "cannot be sent"),
    ],
)
def test_what_the_wire_cannot_carry_is_refused(
    tmp_path: Path, name: str, values: tuple[float, ...], said: str
) -> None:
    async def scene(bench: Bench) -> None:
        token = bench.plant.take_authority(ENGINEER).token
        with pytest.raises(InputError, match=said):
            bench.plant.command(ENGINEER, token, name, (), values)

    play(tmp_path, scene)


def test_mirrors_join_one_after_the_other(tmp_path: Path) -> None:
    settings = PlantSettings(join_rate=2.0, join_burst=3)

    async def scene(bench: Bench) -> None:
        for cluster in bench.clusters.values():
            cluster.set(states.IDLE)
        token = await bench.commanded()
        ticket = bench.plant.command(OPERATOR, token, "TRACK")
        assert bench.plant.waiting == 18
        await bench.until(lambda: ticket.finished, 12.0)
        assert ticket.good
        assert bench.count(states.TRACKING) == 18

    bench = play(tmp_path, scene, settings=settings)
    joined = sorted(
        at
        for cluster in bench.clusters.values()
        for at, m in cluster.taken
        if isinstance(m, Command) and m.name == "TRACK"
        for _ in m.heliostats or cluster.names
    )
    assert len(joined) == 18
    for i, begin in enumerate(joined):
        for j in range(i, len(joined)):
            assert j - i + 1 <= 3 + 2.0 * (joined[j] - begin) + 1e-6


def test_who_waits_to_join_is_dropped_when_things_change(tmp_path: Path) -> None:
    settings = PlantSettings(join_rate=1.0, join_burst=1)

    async def scene(bench: Bench) -> None:
        plant = bench.plant
        for cluster in bench.clusters.values():
            cluster.set(states.IDLE)
        token = await bench.commanded()
        first = plant.command(OPERATOR, token, "TRACK", ("P1A", "P1B", "P1C", "P2A"))
        assert not await first.reached(Stage.DONE, timeout=1.0)
        plant.defocus("Olga", ("P1C",))
        assert first.refusals == {"P1C": "DEFOCUS by Olga"}
        plant.command(OPERATOR, token, "IDLE", ("P1B",))
        assert first.stage("P1B") in (Stage.DONE, Stage.REFUSED)
        plant.release_authority(OPERATOR, token)
        await bench.wait(1.0)
        assert first.finished
        assert "changed while it was waiting" in first.refusals["P2A"]
        assert plant.waiting == 0

    bench = play(tmp_path, scene, settings=settings)
    assert bench.count(states.TRACKING) <= 2


def test_a_later_command_takes_the_place_of_one_that_waits(tmp_path: Path) -> None:
    settings = PlantSettings(join_rate=0.0)

    async def scene(bench: Bench) -> None:
        plant = bench.plant
        cluster = bench.cluster_of("P1A")
        cluster.set(states.TRACKING, "P1A")
        cluster.set(states.IDLE, "P1B")
        token = await bench.commanded()
        track = plant.command(OPERATOR, token, "TRACK", ("P1B",))
        first = plant.aim(OPERATOR, token, {"P1A": (0.0, 0.0, 16.0), "P1B": (0.0, 0.0, 16.0)})
        # The one at standby takes its aim at once, the one that tracks has to wait.
        assert await first.reached(Stage.DONE, timeout=2.0) is False
        assert (first.stage("P1A"), first.stage("P1B")) == (None, Stage.DONE)
        second = plant.aim(OPERATOR, token, {"P1A": (0.0, 0.0, 17.0)})
        assert first.refusals == {"P1A": "superseded by another AIM"}
        plant.command(OPERATOR, token, "LOCK_AIM", ("P1A", "P1B"), (1,))
        assert not track.finished
        assert plant.waiting == 2
        assert await plant.command(OPERATOR, token, "LOCK", ("P1A", "P1B")).end(2.0)
        assert track.refusals == {"P1B": "superseded by LOCK"}
        assert second.refusals == {"P1A": "superseded by LOCK"}
        assert plant.waiting == 0
        for bad, said in ((np.nan, "nan is not a finite number"), (2e5, "the limit is 100000 m")):
            with pytest.raises(InputError, match=said):
                plant.aim(OPERATOR, token, {"P1A": (bad, 0.0, 0.0)})

    bench = play(tmp_path, scene, settings=settings)
    assert not bench.cluster_of("P1A").commands("TRACK")


def test_aims_are_spread_and_beams_are_checked(tmp_path: Path) -> None:
    walkway = Sphere("walkway", (0.0, -12.0, 8.0), 1.0)

    async def scene(bench: Bench) -> None:
        plant = bench.plant
        token = await bench.commanded()
        points = ((-0.3, 0.0, 16.5), (0.3, 0.0, 16.5))
        aims = plant.default_aims(points=points)
        taken = [tuple(p) for p in aims.values()]
        assert {taken.count(p) for p in points} == {9}
        clear = {n: p for n, p in aims.items() if not n.startswith(("P2", "P5"))}
        ticket = plant.aim(OPERATOR, token, clear)
        assert await ticket.end(5.0)
        assert np.array_equal(plant.aims[plant.field.place("P1A")], aims["P1A"])
        # The middle row shines through the walkway.
        with pytest.raises(RefusedError, match=r"AIM P\w\w.*: the beam enters walkway \d+ m"):
            plant.aim(OPERATOR, token, aims)
        assert np.isnan(plant.aims[plant.field.place("P2A")]).all()
        with pytest.raises(RefusedError, match=r"STANDBY P2A: the beam enters walkway"):
            plant.standby(OPERATOR, token, {"P2A": (0.0, -12.0, 8.0)})
        with pytest.raises(InputError, match="no points"):
            plant.aim(OPERATOR, token, {})
        # From the standby point on one side to the aim on the other it would sweep across.
        plant.standby(OPERATOR, token, {"P5A": (-8.0, 0.0, 8.0)})
        with pytest.raises(RefusedError, match=r"walkway .* on its way there"):
            plant.aim(OPERATOR, token, {"P5A": (8.0, 0.0, 16.5)})
        assert len(plant.default_aims(("P1A",))["P1A"]) == 3

    bench = play(tmp_path, scene, volumes=(walkway,))
    sent = {m.values for c in bench.clusters.values() for m in c.commands("AIM")}
    assert sent == {(-0.3, 0.0, 16.5), (0.3, 0.0, 16.5)}


def test_of_those_that_join_each_is_proven_by_its_own_way(tmp_path: Path) -> None:
    """One has no aim, another shines through the walkway, the third past it."""
    walkway = Sphere("walkway", (0.0, -12.0, 8.0), 1.0)

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path, volumes=[walkway])
        async with running(bench):
            plant, names = bench.plant, ("P1A", "P5A", "P5B")
            bench.cluster_of("P5A").set(states.IDLE)
            for name, aim in (("P5A", (0.0, 0.0, 16.5)), ("P5B", (20.0, 0.0, 16.5))):
                plant.aims[plant.field.place(name)] = aim
            await bench.wait(2.0)
            wrong = plant._proofs.joining("TRACK", (), names, plant.now())
            alone = plant._proofs.joining("TRACK", (), names[1:], plant.now())
            assert "does not know its aim" in wrong.pop("P1A")
            assert wrong == alone

    run_virtual(main)


def test_whose_beam_would_sweep_through_a_volume_does_not_join(tmp_path: Path) -> None:
    walkway = Sphere("walkway", (0.0, -12.0, 8.0), 1.0)
    design = example_plant()
    group, row = design.find("P5A")

    async def scene(bench: Bench) -> None:
        plant = bench.plant
        cluster = bench.cluster_of("P5A")
        cluster.set(states.IDLE)
        token = await bench.commanded()
        assert await plant.aim(OPERATOR, token, {"P5A": (8.0, 0.0, 16.5)}).end(2.0)
        # From where it stands, its beam east or west of the walkway, to the aim in the east.
        for east, clear in ((-8.0, False), (9.0, True)):
            found = track(group.mechanism[row], plant.sun_vector(), (east, 0.0, 8.0))
            for axis, end in enumerate(("primary", "secondary")):
                cluster.rows[end][0] = round(float(found.best_counts[axis]))
            await bench.wait(2.0)
            ticket = plant.command(OPERATOR, token, "TRACK", ("P5A",))
            assert await ticket.end(10.0) is clear
            if not clear:
                assert "enters walkway" in ticket.refusals["P5A"]
                assert "on its way there" in ticket.refusals["P5A"]
        other = plant.command(OPERATOR, token, "TRACK", ("P5B",))
        assert not await other.end(5.0)
        assert other.refusals == {
            "P5B": "TRACK: the plant does not know its aim; set one (AIM) first"
        }

    bench = play(tmp_path, scene, volumes=(walkway,))
    assert len(bench.cluster_of("P5A").commands("TRACK")) == 1


def test_what_is_stored_is_compared_and_pushed(tmp_path: Path) -> None:
    axis = AxisLimits(-100_000, 1_950_000, 8000, 16_000, 40)
    machine = Machine((axis, axis), (480_000, 470_000), (0.1, 0.1), (12.0, 0.0, 10.0))

    async def scene(bench: Bench) -> None:
        plant = bench.plant
        cluster = bench.cluster_of("P1A")
        assert plant.wanted.missing["P1A"] == tuple(sorted(plant.wanted.items["P1A"]))
        # Nothing is written without an authority, and the machine's items not at stow.
        await bench.wait(40.0)
        assert not cluster.of(Parameters)
        token = await bench.commanded(ENGINEER)
        await bench.wait(2.0)
        assert set(cluster.stored["P1A"]) == {"armature", "biases", "location", "defocus"}
        cluster.set(states.LOCKED, "P1A")
        for _ in range(45):
            plant.authority.keep(ENGINEER, token)
            await bench.wait(1.0)
        assert plant.wanted.missing == {}
        assert cluster.stored["P1A"] == plant.wanted.items["P1A"]
        assert await plant.stored("P1A") == {
            name: crc32(data) for name, data in cluster.stored["P1A"].items()
        }
        # Somebody exchanges the board: at the next connection that is noticed.
        cluster.stored["P1A"]["armature"] = bytes(144)
        bench.lines["pod-1"].drop()
        await bench.until(lambda: "P1A" in plant.wanted.missing, 60.0)
        assert plant.wanted.missing["P1A"] == ("armature",)
        assert any(a.condition == "parameters_differ" for a in plant.alarms)
        with pytest.raises(InputError, match="item 'address' of 2 bytes cannot be pushed"):
            plant.parameters(ENGINEER, token, "P1A", {"address": b"12"})

    mechanism = example_plant()["P1A"].calibrated
    wanted = Wanted({"P1A": items_of(mechanism, machine)})
    bench = play(tmp_path, scene, wanted=wanted)
    assert {ask.what for ask in bench.cluster_of("P1A").of(Ask)} == {"stored"}
    assert not bench.cluster_of("P2A").of(Ask)


def test_a_status_whose_names_were_lost_is_understood_all_the_same(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        await bench.wait(8.0)
        assert bench.plant.field.counted(bench.clock.monotonic()) == {"STOWED": 18}
        assert "status arrived before its list of names" in bench.plant.counters.problems[0]

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path)
        for cluster in bench.clusters.values():
            cluster.greets = False
        async with running(bench):
            await scene(bench)

    run_virtual(main)


@pytest.mark.parametrize("seed", range(3))
def test_every_accepted_command_has_one_record_over_bad_lines(tmp_path: Path, seed: int) -> None:
    faults = Faults(loss=0.1, duplication=0.1, reordering=0.1, delay=(0.0, 0.4))
    tickets = []

    async def scene(bench: Bench) -> None:
        plant = bench.plant
        token = await bench.commanded()
        for i in range(12):
            names = plant.field.names[i : i + 4]
            tickets.append(plant.command(OPERATOR, token, "APPROACH", names))
            await bench.wait(0.5)
        tickets.append(plant.stow("Olga"))
        await bench.until(lambda: all(ticket.finished for ticket in tickets), 60.0)
        await bench.wait(2.0)

    settings = PlantSettings(patience=20.0)
    bench = play(tmp_path, scene, seed, faults=faults, settings=settings)
    records, torn = read(bench.audit.path)
    mine = {r.identity: r for r in records if r.what in ("APPROACH", "STOW")}
    assert torn == 0
    assert {t.identity: t.text for t in tickets} == {i: r.result for i, r in mine.items()}
    assert all(ticket.finished for ticket in tickets)


def test_what_cannot_be_recorded_is_not_accepted_but_defocus_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        token = await bench.commanded()

        def full(*_: object) -> None:
            raise AuditError("audit: No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr(bench.audit, "_append", full)
            patch.setattr(bench.audit, "confirm", full)
            with pytest.raises(RefusedError, match=r"cannot be recorded: .*No space"):
                plant.command(OPERATOR, token, "APPROACH")
            assert await plant.stow("Olga").end(2.0)
            for _ in range(8):
                await bench.wait(1.0)
                plant.authority.keep(OPERATOR, token)
            with pytest.raises(RefusedError, match="not confirmed a write"):
                plant.command(OPERATOR, token, "APPROACH")
        assert not any(r.what == "STOW" for r in read(bench.audit.path)[0])
        await bench.wait(3.0)

    bench = play(tmp_path, scene)
    records, _ = read(bench.audit.path)
    assert [(r.what, r.result) for r in records if r.what != "AUTHORITY"] == [
        ("STOW", "STOW: 18 done")
    ]


def test_nothing_that_a_cluster_says_ends_the_plant(tmp_path: Path) -> None:
    rows = np.zeros(3, NODE).tobytes()
    said = [
        ClusterStatus("pod-1", 3, 0.0, "gps", 0.0, 3.0, 0.1, block=rows[:-1]),
        ClusterStatus("pod-1", 2, 0.0, "gps", 0.0, 3.0, 0.1, block=rows[: NODE.itemsize]),
        ClusterStatus(
            "pod-1", 3, 0.0, "gps", 0.0, 3.0, 0.1, names=("P1A", "P1A", "P6C"), block=rows
        ),
        Progress("nothing-known", Stage.DONE, ("P1A",)), Lease(7), Command("c", "TRACK"),
        Answer("statistics-1", {"error": "no"}), Answer("stored-9", {"names": 1}),
        Answer("stored-1", {"names": ["a"], "sizes": [3]}), Alarm("x", "", Severity.ALARM, "text"),
    ]  # fmt: skip

    async def scene(bench: Bench) -> None:
        chance = np.random.default_rng(1)
        cluster = bench.clusters["pod-1"]
        expires = bench.clock.monotonic() + 30.0
        for message in said:
            await cluster.send(message)
        for size in range(60):
            await cluster.link.send(chance.bytes(size), expires=expires)
            whole = encode(said[size % len(said)])
            cut = int(chance.integers(len(whole)))
            await cluster.link.send(whole[:cut] + chance.bytes(2) + whole[cut:], expires=expires)
        cluster.first = True
        await bench.wait(5.0)
        plant = bench.plant
        assert plant.counters.refused > 60
        assert plant.field.counted(plant.now()) == {"STOWED": 18}
        assert {a.subject for a in plant.alarms if a.condition == "x"} == {"pod-1"}
        token = await bench.commanded()
        assert await plant.command(OPERATOR, token, "APPROACH").end(5.0)

    play(tmp_path, scene)


def test_an_alarm_of_a_cluster_ends_with_its_list_though_its_end_was_lost() -> None:
    told = ClusterAlarms(lambda alarm: None)
    bus = Alarm("bus_failed", "", Severity.ALARM, "text")
    node = Alarm("node_fault", "P1A", Severity.ALARM, "text")
    event = alarms.PLANT_UNINTELLIGIBLE.raised(problem="a test")
    status = ClusterStatus("pod-1", 0, 0.0, "gps", 0.0, 3.0, 0.1)

    assert told.take("pod-1", bus) == [replace(bus, subject="pod-1")]
    assert told.take("pod-1", node) == [node]
    assert told.take("pod-2", bus) == [replace(bus, subject="pod-2")]
    assert told.take("pod-1", bus) == []  # it is repeated
    for _ in range(2):
        assert told.take("pod-1", event) == [replace(event, subject="pod-1")]
    worse = replace(node, severity=Severity.EMERGENCY)
    assert told.take("pod-1", worse) == [worse]

    assert told.compare("pod-1", status) == []  # it lists nothing
    lists = replace(status, alarms=("bus_failed ",), alarms_listed=True)
    (over,) = told.compare("pod-1", lists)
    assert over == replace(worse, text="node_fault: over", active=False)
    assert told.compare("pod-1", lists) == []
    assert told.take("pod-1", node) == [node]  # it is back
    ends = [replace(each, active=False) for each in (node, replace(bus, subject="pod-1"))]
    assert [told.take("pod-1", each) for each in ends] == [[each] for each in ends]
    assert told.compare("pod-1", replace(lists, alarms=())) == []
    assert [each.subject for each in told.compare("pod-2", replace(lists, alarms=()))] == ["pod-2"]


def test_a_plant_tells_the_end_of_an_alarm_that_its_cluster_no_longer_lists(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        cluster = bench.clusters["pod-1"]
        for _ in range(3):
            await cluster.send(Alarm("bus_failed", "", Severity.ALARM, "text"))
        lists = ClusterStatus("pod-1", 0, 0.0, "gps", 0.0, 3.0, 0.1, alarms_listed=True)
        await cluster.send(replace(lists, alarms=("bus_failed pod-1",)))
        await bench.wait(1.0)
        told = [a for a in bench.plant.alarms if a.condition == "bus_failed"]
        assert [(a.subject, a.active) for a in told] == [("pod-1", True)]
        await cluster.send(lists)
        await bench.wait(1.0)
        told = [a for a in bench.plant.alarms if a.condition == "bus_failed"]
        assert [(a.subject, a.active) for a in told] == [("pod-1", True), ("pod-1", False)]

    play(tmp_path, scene)


def test_a_command_ends_that_its_cluster_no_longer_lists(tmp_path: Path) -> None:
    """Simulated runs 10030, 10008: a cluster restarted, or its report of the end was lost."""

    async def scene(bench: Bench) -> None:
        token = await bench.commanded()
        cluster = bench.clusters["pod-1"]
        cluster.deaf.update(("P1A", "P1B"))
        ticket = bench.plant.command(OPERATOR, token, "APPROACH", ("P1A", "P1B", "P2A"))
        await bench.wait(1.0)
        (sent,) = cluster.commands("APPROACH")
        await cluster.send(Progress(sent.identity, Stage.ACKNOWLEDGED, ("P1A",)))
        status = ClusterStatus("pod-1", 0, 0.0, "gps", 0.0, 3.0, 0.1)
        lists = replace(status, commands_listed=True)
        for each in (status, replace(lists, commands=(sent.identity,))):
            await cluster.send(each)
            await bench.wait(1.0)
            assert ticket.counted() == {"sent": 1, "acknowledged": 1, "done": 1}
        await cluster.send(lists)
        await bench.wait(1.0)
        assert ticket.counted() == {"sent": 1, "done": 1, "failed": 1}
        assert ticket.refusals == {
            "P1A": "acknowledged, but the report of its end was lost, or the cluster restarted"
        }

    play(tmp_path, scene)


def test_a_command_goes_on_whose_first_message_was_lost(tmp_path: Path) -> None:
    """The cluster lists the message that it got, not the one that was repeated."""

    async def scene(bench: Bench) -> None:
        await bench.commanded()
        cluster = bench.clusters["pod-1"]
        cluster.deaf.update(cluster.names)
        ticket = bench.plant.stow("engineer", ("P1A",))
        await bench.wait(1.5)
        first, again = (sent.identity for sent in cluster.of(Emergency) if sent.name == "STOW")
        assert first != again
        await cluster.send(Progress(again, Stage.ACKNOWLEDGED, ("P1A",)))
        status = ClusterStatus("pod-1", 0, 0.0, "gps", 0.0, 3.0, 0.1, commands_listed=True)
        await cluster.send(replace(status, commands=(again,)))
        await bench.wait(1.0)
        assert ticket.counted() == {"acknowledged": 1}
        await cluster.send(status)
        await bench.wait(1.0)
        assert ticket.counted() == {"failed": 1}

    play(tmp_path, scene)


def test_a_plant_that_does_not_hold_together_is_refused(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        with pytest.raises(InputError, match="sensor wind: no row"):
            Bench(clock, tmp_path, settings=PlantSettings(sensors=frozenset({"wind"})))
        await asyncio.sleep(0)

    run_virtual(main)
    with pytest.raises(InputError, match=r"a lease of 1.5 s renewed every 1.0 s"):
        PlantSettings(lease=1.5)
    with pytest.raises(InputError, match=r"a cycle of 2.0 s"):
        PlantSettings(beat=2.0)
