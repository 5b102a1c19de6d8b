"""Parameters pass the same proofs as motions: where, how far, and never beside what is wanted."""

import struct
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from heliotrope.field.example import example_plant
from heliotrope.field.volumes import Sphere
from heliotrope.geometry import reflect
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Ask, Parameters
from heliotrope.mechanism.board_items import Wanted, items_of, packed, tables_with
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.tracking import track
from heliotrope.plant.motion.proofs import BeamError
from heliotrope.plant.orders.audit import read
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.store.records import Kind, Lockout
from support.plant_bench import ENGINEER, OPERATOR, Bench, running

NAME, OTHER = "P1A", "P2A"
Scene = Callable[[Bench, int], Awaitable[None]]


def play(folder: Path, scene: Scene, **options: Any) -> Bench:
    made: list[Bench] = []

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, folder, **options)
        made.append(bench)
        async with running(bench):
            await scene(bench, await bench.commanded(ENGINEER))

    run_virtual(main)
    return made[0]


def items(name: str, **error: float) -> dict[str, bytes]:
    """What a heliostat should store if it is off by ``error`` from nominal."""
    return items_of(example_plant()[name].calibrated.with_parameters(error))


@pytest.mark.parametrize("state", [states.IDLE, states.TRACKING, states.DEFOCUSED])
def test_no_pose_is_changed_while_the_beam_is_out(tmp_path: Path, state: int) -> None:
    async def scene(bench: Bench, token: int) -> None:
        bench.cluster_of(NAME).set(state, NAME)
        await bench.wait(2.0)
        with pytest.raises(RefusedError, match=f"P1A: it is {states.STATES[state]}, and armature"):
            bench.plant.parameters(ENGINEER, token, NAME, {"armature": items(OTHER)["armature"]})
        with pytest.raises(RefusedError, match="and biases would move its beam; stow it first"):
            bench.plant.parameters(ENGINEER, token, NAME, {"biases": bytes(8)})
        assert NAME not in bench.plant.wanted.items
        assert not bench.cluster_of(NAME).of(Parameters)

    play(tmp_path, scene)


def test_another_mirrors_parameters_are_refused_unless_confirmed(tmp_path: Path) -> None:
    async def scene(bench: Bench, token: int) -> None:
        plant = bench.plant
        before = plant.beams.armature.table[plant.field.place(NAME)].copy()
        foreign = items(OTHER)
        with pytest.raises(
            RefusedError,
            match=r"would move its beam by \d+\.\d mrad, the limit is 5\.0; check that",
        ):
            plant.parameters(ENGINEER, token, NAME, foreign, confirmed=" ")
        assert (plant.beams.armature.table[plant.field.place(NAME)] == before).all()
        assert not bench.cluster_of(NAME).of(Parameters)
        # A small change needs no confirmation.
        assert await plant.parameters(ENGINEER, token, NAME, items(NAME, azimuth_bias=1e-3)).end(
            5.0
        )
        # A large one has it in the audit, and the proofs use it from then on.
        reason = "boards of P1A and P2A exchanged"
        assert await plant.parameters(ENGINEER, token, NAME, foreign, confirmed=reason).end(5.0)
        after = plant.beams.armature.table[plant.field.place(NAME)]
        assert (after == np.frombuffer(foreign["armature"])).all()

    bench = play(tmp_path, scene)
    notes = [record.note for record in read(bench.audit.path)[0] if record.what == "PARAMETERS"]
    assert len(notes) == 2
    assert "confirmed" not in notes[0]
    assert notes[1].endswith("; confirmed: boards of P1A and P2A exchanged")


def test_nothing_moves_beside_what_is_wanted(tmp_path: Path) -> None:
    wanted = Wanted({name: items(name) for name in (NAME, OTHER)})

    async def scene(bench: Bench, token: int) -> None:
        plant, cluster = bench.plant, bench.cluster_of(NAME)
        assert NAME in plant.wanted.missing
        said = r"its stored parameters differ from the intended ones \(drive_primary"
        for command in ("TRACK", "APPROACH", "IDLE", "REFOCUS"):
            with pytest.raises(BeamError, match=f"{command} P1A: {said}"):
                plant.command(ENGINEER, token, command, (NAME,))
        # Of several, the others go; what leads to safety is never refused.
        some = plant.command(ENGINEER, token, "IDLE", (NAME, "P1B"))
        assert set(some.blocked) == {NAME}
        await bench.wait(1.0)
        assert cluster.commands("IDLE")[-1].heliostats == ("P1B",)
        for safe in (plant.stow, plant.defocus):
            assert await safe("anybody", (NAME,)).end(5.0)
        # It stands on its aim with a difference: no other aim either.
        cluster.set(states.TRACKING, NAME)
        await bench.wait(2.0)
        with pytest.raises(BeamError, match="AIM P1A: its stored"):
            plant.aim(ENGINEER, token, {NAME: (0.0, 0.0, 13.0)})
        # Locked, the wanted ones are written, and it may move again.
        cluster.set(states.LOCKED, NAME)
        for _ in range(40):
            plant.authority.keep(ENGINEER, token)
            await bench.wait(1.0)
        assert NAME not in plant.wanted.missing
        assert await plant.command(ENGINEER, token, "IDLE", (NAME,)).end(5.0)
        # From the moment that other ones are wanted, nothing moves until they are stored.
        plant.want(NAME, example_plant()[NAME].calibrated.with_parameters({"azimuth_bias": 1e-3}))
        with pytest.raises(BeamError, match="TRACK P1A: its stored"):
            plant.command(ENGINEER, token, "TRACK", (NAME,))

    play(tmp_path, scene, wanted=wanted)


def test_nothing_is_written_to_a_heliostat_out_of_service(tmp_path: Path) -> None:
    """A corrected stow position would move the mirror at the next STOW, with somebody at it."""

    async def scene(bench: Bench, token: int) -> None:
        plant, cluster = bench.plant, bench.cluster_of(NAME)
        cluster.stored[NAME] = dict(plant.wanted.items[NAME]) | {"stow": bytes(8)}
        cluster.set(states.LOCKED, NAME)
        plant.lockouts.put([Lockout(Kind.HELIOSTAT, NAME, OPERATOR.name, "washing", 0.0)])
        cluster.taken.clear()
        plant.wanted.set(NAME, {"stow": struct.pack("<ii", 5, 6)})
        plant.want(NAME, bench.design[NAME].calibrated)
        for _ in range(80):
            plant.authority.keep(ENGINEER, token)
            await bench.wait(1.0)
        assert plant.wanted.missing[NAME]
        assert not cluster.of(Parameters)
        plant.lockouts.remove(Kind.HELIOSTAT, NAME, OPERATOR.name)
        await bench.wait(35.0)
        assert {message.heliostat for message in cluster.of(Parameters)} == {NAME}

    play(tmp_path, scene, wanted=Wanted({NAME: items(NAME)}))


def test_one_that_does_not_answer_is_asked_again_now_and_then(tmp_path: Path) -> None:
    wanted = Wanted({NAME: items(NAME)})

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path, wanted=wanted)
        cluster = bench.cluster_of(NAME)
        cluster.deaf.add(NAME)
        async with running(bench):
            await bench.wait(95.0)
        asked = [ask for ask in cluster.of(Ask) if (ask.what, ask.heliostat) == ("stored", NAME)]
        assert 3 <= len(asked) <= 5  # each 30 s, not at each look

    run_virtual(main)


def test_a_locked_mirror_takes_only_parameters_with_a_clear_way_to_standby(tmp_path: Path) -> None:
    rest = np.array([0.0, 0.0, 20.0])
    new = {"azimuth_bias": 0.1}

    async def scene(bench: Bench, token: int) -> None:
        plant, cluster = bench.plant, bench.cluster_of(NAME)
        mirror, sun = bench.design[NAME].calibrated, plant.sun_vector()
        assert await plant.standby(ENGINEER, token, {NAME: rest}).end(5.0)
        found = track(mirror, sun, rest)
        counts, row = np.round(found.best_counts), cluster.names.index(NAME)
        for end, count in zip(("primary", "secondary"), counts, strict=True):
            cluster.rows[end][row] = cluster.rows[f"{end}_goal"][row] = count
        cluster.set(states.LOCKED, NAME)
        await bench.wait(3.0)
        # Under the new parameters, the beam of the same counts stands elsewhere.
        pose = mirror.with_parameters(new).pose(counts)
        there = pose.vertex + 20.0 * reflect(sun, pose.normal)
        plant.beams.volumes = (Sphere("walkway", there, 0.5),)
        with pytest.raises(
            RefusedError, match=r"P1A: the beam enters walkway 18 m .* stow it first"
        ):
            plant.parameters(ENGINEER, token, NAME, items(NAME, **new), confirmed="a test")
        plant.beams.volumes = ()
        ticket = plant.parameters(ENGINEER, token, NAME, items(NAME, **new), confirmed="a test")
        assert await ticket.end(5.0)

    play(tmp_path, scene)


def test_a_standby_point_that_was_given_is_the_wanted_one(tmp_path: Path) -> None:
    """Its local controller stores it; the one of the plant file is not written over it."""
    rest = (0.0, 0.0, 20.0)
    first = {**items(NAME), "standby": packed("standby", (0.0, 0.0, 12.0))}

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path, wanted=Wanted({NAME: first}))
        plant, cluster = bench.plant, bench.cluster_of(NAME)
        cluster.stored[NAME] = dict(first)
        async with running(bench):
            token = await bench.commanded(ENGINEER)
            assert await plant.standby(ENGINEER, token, {NAME: rest}).end(5.0)
            cluster.stored[NAME]["standby"] = packed("standby", rest)
            await plant.stored(NAME)
            assert plant.wanted.missing == {}
            await bench.wait(2.0)
            assert not cluster.of(Parameters)

    run_virtual(main)


def test_stored_items_give_the_pose_that_they_were_made_of() -> None:
    error = {"azimuth_bias": 3e-3, "elevation_bias": -2e-3, "tilt_east": 4e-3, "sag": 1e-3}
    before = example_plant()[NAME].calibrated
    after = before.with_parameters(error)
    armature, drives = tables_with(items_of(after), before.armature.table, before.drives.table)
    assert (armature == after.armature.table).all()
    counts = np.array([12_345.0, -2_345.0])
    made = type(before.drives)(drives).angles(counts)
    assert made == pytest.approx(after.drives.angles(counts), abs=1e-6)


def test_nothing_moves_before_its_parameters_have_been_compared(tmp_path: Path) -> None:
    """Not where the answer is lost either; where nothing is wanted, nothing is asked."""

    async def scene(bench: Bench, token: int) -> None:
        plant, cluster = bench.plant, bench.cluster_of(NAME)
        text = "P1A: its stored parameters have not been compared with the intended ones"
        with pytest.raises(RefusedError, match=text):
            plant.command(ENGINEER, token, "APPROACH", (NAME,))
        assert plant.command(ENGINEER, token, "APPROACH", (NAME, OTHER)).blocked.keys() == {NAME}
        assert plant.command(ENGINEER, token, "LOCK", (NAME,))
        cluster.deaf.clear()
        for _ in range(35):
            await bench.wait(1.0)
            plant.authority.keep(ENGINEER, token)
        assert not plant.command(ENGINEER, token, "APPROACH", (NAME, OTHER)).blocked
        # A cluster that connects again may have other boards.
        plant._greet(plant._clusters.ends[cluster.name])
        with pytest.raises(RefusedError, match=text):
            plant.command(ENGINEER, token, "IDLE", (NAME,))

    made: list[Bench] = []

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path, wanted=Wanted({NAME: items(NAME)}))
        made.append(bench)
        cluster = bench.cluster_of(NAME)
        cluster.stored[NAME] = items(NAME)
        cluster.deaf.add(NAME)
        async with running(bench):
            await scene(bench, await bench.commanded(ENGINEER))

    run_virtual(main)
    assert made[0].cluster_of(OTHER).commands("APPROACH")


def test_a_board_that_has_started_anew_is_compared_before_its_mirror_moves(tmp_path: Path) -> None:
    """A spare board with other parameters was led through its approach, and tracked."""

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path, wanted=Wanted({NAME: items(NAME)}))
        plant, cluster = bench.plant, bench.cluster_of(NAME)
        cluster.stored[NAME] = items(NAME)
        row = cluster.names.index(NAME)
        async with running(bench):
            token = await bench.commanded(ENGINEER)
            await bench.wait(3.0)
            assert plant.command(ENGINEER, token, "APPROACH", (NAME,))
            for column in ("boots", "armature_crc"):
                cluster.deaf.add(NAME)
                cluster.rows[column][row] += 1
                await bench.wait(2.0)
                with pytest.raises(RefusedError, match="have not been compared with the intended"):
                    plant.command(ENGINEER, token, "IDLE", (NAME,))
                cluster.deaf.clear()
                plant.authority.keep(ENGINEER, token)
                plant._sync.compare(NAME)
                await bench.wait(3.0)
                assert not plant._sync.differing(NAME)

    run_virtual(main)


def stows(bench: Bench) -> tuple[tuple[int, int], tuple[int, int]]:
    """A stow position from which the beam of `NAME` lights the receiver now, and a good one."""
    rows, beams = np.array([bench.plant.field.place(NAME)]), bench.plant.beams
    aim = bench.design.receivers[0].center[None]
    found = beams.poses(rows, aim, bench.plant.sun_vector()).best_counts[0].round()
    for elevation in np.radians((90.0, 0.0, -30.0)):
        good = np.round(Drive(beams.drives.table[rows[0]]).counts(np.array([0.0, elevation])))
        if not beams.standing(rows, good[None]):
            return (int(found[0]), int(found[1])), (int(good[0]), int(good[1]))
    raise AssertionError("no stow position of the example plant is clear")


def test_no_stow_position_is_given_from_which_the_beam_lights_something(tmp_path: Path) -> None:
    async def scene(bench: Bench, token: int) -> None:
        bad, good = stows(bench)
        bench.cluster_of(NAME).set(states.LOCKED, NAME)
        await bench.wait(2.0)
        said = "P1A: at stow its beam would reach the receiver at some time of"
        with pytest.raises(RefusedError, match=said):
            bench.plant.parameters(ENGINEER, token, NAME, {"stow": packed("stow", bad)})
        assert NAME not in bench.plant.wanted.items
        assert not bench.cluster_of(NAME).of(Parameters)
        items = {"stow": packed("stow", good)}
        assert await bench.plant.parameters(ENGINEER, token, NAME, items).end(5.0)

    play(tmp_path, scene)


def test_the_plant_writes_no_stow_position_that_is_not_proven(tmp_path: Path) -> None:
    wanted = Wanted()

    async def scene(bench: Bench, token: int) -> None:
        bad, good = stows(bench)
        cluster = bench.cluster_of(NAME)
        cluster.set(states.LOCKED, NAME)
        for stow in (bad, good):
            told = len(bench.plant.alarms)
            wanted.set(NAME, {"stow": packed("stow", stow), "defocus": packed("defocus", (0.1, 0))})
            bench.plant._sync.compare(NAME)
            for _ in range(40):
                await bench.wait(1.0)
                bench.plant.authority.keep(ENGINEER, token)
            texts = [alarm.text for alarm in list(bench.plant.alarms)[told:]]
            held_back = any(
                "the stow position, which cannot be written: at stow its beam" in t for t in texts
            )
            assert held_back is (stow is bad)
            assert ("stow" in cluster.stored[NAME]) is (stow is good)
            assert cluster.stored[NAME]["defocus"] == packed("defocus", (0.1, 0))

    play(tmp_path, scene, wanted=wanted)


def test_items_are_compared_byte_by_byte(tmp_path: Path) -> None:
    """Stored bytes of the right names and lengths are not the wanted ones for that."""
    good = items(NAME)
    wanted = Wanted({NAME: dict(good)})

    async def scene(bench: Bench, token: int) -> None:
        plant, cluster = bench.plant, bench.cluster_of(NAME)
        for item, data in good.items():
            for place in (0, len(data) // 2, len(data) - 1):
                changed = bytearray(data)
                changed[place] ^= 1
                cluster.stored[NAME] = {**good, item: bytes(changed)}
                await plant.stored(NAME)
                assert plant.wanted.missing.get(NAME) == (item,)
        with pytest.raises(BeamError, match="its stored parameters differ"):
            plant.command(ENGINEER, token, "TRACK", (NAME,))
        cluster.stored[NAME] = dict(good)
        await plant.stored(NAME)
        assert NAME not in plant.wanted.missing

    play(tmp_path, scene, wanted=wanted)
