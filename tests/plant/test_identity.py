"""The board that answers at an address is the one of the heliostat, or nothing moves there."""

from collections.abc import Iterable
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest

from heliotrope.field.example import example_plant
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Command, Emergency, Parameters
from heliotrope.mechanism.board_items import Wanted, items_of
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.safety import alarms
from support.plant_bench import ENGINEER, OPERATOR, Bench, ScriptedCluster, running

DESIGN = example_plant()
PAIR = ("P5A", "P5B")
CRC = {name: crc32(items_of(DESIGN[name].calibrated)["armature"]) for name in DESIGN.names}


def wanted_of(*names: str) -> Wanted:
    """What some heliostats should store."""
    return Wanted({name: items_of(DESIGN[name].calibrated) for name in names})


def stores(bench: Bench, name: str, crc: int) -> None:
    """Let the board at a heliostat's address report a checksum of its armature."""
    cluster = bench.cluster_of(name)
    cluster.rows["armature_crc"][cluster.names.index(name)] = crc


def exchange(bench: Bench) -> ScriptedCluster:
    """Exchange the boards of the pair, which are in one cluster."""
    stores(bench, "P5A", CRC["P5B"])
    stores(bench, "P5B", CRC["P5A"])
    return bench.cluster_of("P5A")


def correct(bench: Bench) -> None:
    """Let every board report its own armature."""
    for name, crc in CRC.items():
        stores(bench, name, crc)


def named(bench: Bench) -> set[str]:
    """The heliostats whose alarm has not ended."""
    kind = alarms.IDENTITY.name
    last = {a.subject: a.active for a in bench.plant.alarms if a.condition == kind}
    return {name for name, active in last.items() if active}


def sent(cluster: ScriptedCluster, kind: type[Command | Emergency]) -> set[str]:
    """The heliostats of the pair that were sent messages of a kind."""
    return {name for message in cluster.of(kind) for name in message.heliostats} & set(PAIR)


@pytest.mark.parametrize("written", [(), (*PAIR, "P5C")], ids=["nothing_wanted", "wanted"])
def test_exchanged_addresses_are_named_and_neither_is_moved_or_written(
    written: Iterable[str], tmp_path: Path
) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path, wanted=wanted_of(*written))
        correct(bench)
        cluster, plant = exchange(bench), bench.plant
        for name in written:
            cluster.stored[name] = dict(plant.wanted.items[name])
        for name in set(PAIR).intersection(written):
            cluster.stored[name]["armature"] = bytes(144)
        async with running(bench):
            token = await bench.commanded(ENGINEER)
            await bench.wait(5.0)
            assert named(bench) == set(PAIR)
            text = next(a.text for a in plant.alarms if a.subject == "P5A")
            assert "P5A: the board at its address holds the parameters of P5B" in text
            assert not sent(cluster, Emergency), "both are at stow"
            for name in ("APPROACH", "TRACK", "IDLE", "UNLOCK", "CLEAR_FAULT"):
                with pytest.raises(RefusedError, match=f"{name} P5A.*at its address holds the"):
                    plant.command(ENGINEER, token, name, PAIR)
            with pytest.raises(RefusedError, match="ZERO P5A: the board at its address"):
                plant.commands.zero(ENGINEER, token, "P5A", (0, 0))
            with pytest.raises(RefusedError, match="PARAMETERS P5A: the board at its address"):
                plant.parameters(ENGINEER, token, "P5A", items_of(DESIGN["P5A"].calibrated))
            ticket = plant.command(ENGINEER, token, "APPROACH", (*PAIR, "P5C"))
            assert ticket.blocked.keys() == set(PAIR)
            for _ in range(40):
                plant.authority.keep(ENGINEER, token)
                await bench.wait(1.0)
            assert not sent(cluster, Command)
            assert not {m.heliostat for m in cluster.of(Parameters)} & set(PAIR)
            plant.command(ENGINEER, token, "LOCK", PAIR)
            await bench.wait(1.0)
            assert sent(cluster, Command) == set(PAIR)
            correct(bench)
            await bench.wait(2.0)
            assert named(bench) == set()
            assert plant.command(ENGINEER, token, "UNLOCK", PAIR)

    run_virtual(main)


def test_a_heliostat_that_its_cluster_does_not_list_is_named_and_not_moved(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path)
        correct(bench)
        plant, cluster = bench.plant, bench.cluster_of("P5A")
        place = cluster.names.index("P5B")
        whole = cluster.names, cluster.rows, cluster.age_ms
        async with running(bench):
            token = await bench.commanded(ENGINEER)
            await bench.wait(3.0)
            kind = alarms.UNLISTED.name
            assert not [a for a in plant.alarms if a.condition == kind]
            # The cluster is restarted with an older file.
            cluster.deaf.add("P5B")
            cluster.names = tuple(name for name in cluster.names if name != "P5B")
            cluster.rows = np.delete(cluster.rows, place)
            cluster.age_ms = np.delete(cluster.age_ms, place)
            cluster.first = True
            await bench.wait(2.0)
            (alarm,) = [a for a in plant.alarms if a.condition == kind]
            assert (alarm.subject, alarm.active) == ("P5B", True)
            assert f"cluster {cluster.name} does not list it" in alarm.text
            with pytest.raises(RefusedError, match=r"APPROACH P5B.*does not list it"):
                plant.command(ENGINEER, token, "APPROACH", ("P5B",))
            cluster.names, cluster.rows, cluster.age_ms = whole
            cluster.deaf.clear()
            cluster.first = True
            await bench.wait(2.0)
            last = [a for a in plant.alarms if a.condition == kind][-1]
            assert (last.subject, last.active) == ("P5B", False)
            assert plant.command(ENGINEER, token, "APPROACH", ("P5B",))

    run_virtual(main)


def test_both_of_an_exchanged_pair_are_stowed_until_that_is_seen(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path)
        correct(bench)
        async with running(bench):
            plant, cluster = bench.plant, bench.cluster_of("P5A")
            token = await bench.commanded()
            state, row = cluster.rows["state"], cluster.names.index("P5A")

            def orders_to(name: str) -> list[str]:
                return [m.name for m in cluster.of(Emergency) if name in m.heliostats]

            plant.aim(OPERATOR, token, plant.default_aims())
            cluster.set(states.DEFOCUSED, "P5B")
            cluster.set(states.TRACKING, "P5A")
            await bench.wait(2.0)
            assert not sent(cluster, Emergency)
            cluster.deaf |= set(PAIR)
            # One that waits for its turn to join must not be sent any more.
            waits = plant.command(OPERATOR, token, "REFOCUS", (*DESIGN.names,))
            exchange(bench)
            await bench.until(lambda: bool(sent(cluster, Emergency)), 3.0)
            await bench.wait(30.0)
            assert len(orders_to("P5A")) >= 3, "it is repeated while it is not seen"
            assert set(orders_to("P5A")) == {"STOW"}
            assert set(orders_to("P5B")) == {"STOW"}, "its defocus may be about the other mirror"
            assert "P5B" not in {n for m in cluster.commands("REFOCUS") for n in m.heliostats}
            assert waits.finished
            cluster.deaf.clear()
            cluster.first = True
            assert state[row] == states.TRACKING
            await bench.until(lambda: bool(state[row] == states.STOWED), 70.0)
            await bench.wait(15.0)
            count = len(orders_to("P5A"))
            await bench.wait(80.0)
            assert len(orders_to("P5A")) == count, "nothing is repeated once it is seen"
            assert named(bench) == set(PAIR)

    run_virtual(main)


def test_an_emergency_is_never_proven_for_boards_of_other_mirrors(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path)
        correct(bench)
        cluster = exchange(bench)
        async with running(bench):
            plant = bench.plant
            await bench.wait(2.0)
            assert named(bench) == set(PAIR)
            cluster.set(states.DEFOCUSED)
            for other in bench.clusters.values():
                other.set(states.DEFOCUSED)
            order = plant.raise_emergency("Vera")
            await bench.wait(5.0)
            report = order.report(plant.now())
            assert set(report.not_done) == set(PAIR)
            assert "so its reports cannot prove that its beam is off" in report.unknown[0]
            # A spare board with another mirror's journal says STOWED wherever its mirror stands.
            rows = [cluster.names.index(name) for name in PAIR]
            await bench.until(lambda: set(cluster.rows["state"][rows]) == {states.STOWED}, 60.0)
            await bench.wait(5.0)
            assert set(order.report(plant.now()).not_done) == set(PAIR)

    run_virtual(main)


def test_a_board_with_an_armature_that_nobody_knows_proves_nothing(tmp_path: Path) -> None:
    """A spare board of another plant says STOWED wherever its mirror stands."""

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path, wanted=wanted_of("P5A"))
        correct(bench)
        stores(bench, "P5A", 12345)
        stores(bench, "P5C", 54321)  # of this one the plant wants nothing
        async with running(bench):
            plant = bench.plant
            await bench.wait(2.0)
            for cluster in bench.clusters.values():
                cluster.set(states.DEFOCUSED)
            order = plant.raise_emergency("Vera")
            await bench.wait(5.0)
            report = order.report(plant.now())
            assert set(report.not_done) == {"P5A"}
            assert (
                "P5A: its local controller stores parameters that are unknown to this"
                in report.unknown[0]
            )

    run_virtual(main)


def test_an_armature_that_is_nobodys_is_no_exchange(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path)
        correct(bench)
        stores(bench, "P5A", 12345)
        stores(bench, "P5B", 54321)
        async with running(bench):
            plant = bench.plant
            token = await bench.commanded()
            assert named(bench) == set()
            assert plant.command(OPERATOR, token, "APPROACH", PAIR)
            # The plant learns that what P5A stores is P5C's, calibrated by another way.
            leans = DESIGN["P5C"].calibrated.with_parameters({"tilt_north": 1e-3})
            stores(bench, "P5A", crc32(items_of(leans)["armature"]))
            await bench.wait(2.0)
            assert named(bench) == set()
            plant.want("P5C", leans)
            assert named(bench) == {"P5A"}
            # Where two may store it, it shows neither of them to be the other.
            plant.want("P5A", leans)
            assert named(bench) == set()

    run_virtual(main)


def test_the_other_of_a_pair_is_named_unless_it_answers_itself(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path)
        correct(bench)
        stores(bench, "P5A", CRC["P5B"])
        async with running(bench):
            assert named(bench) == {"P5A"}
            stores(bench, "P5B", 54321)
            await bench.wait(2.0)
            assert named(bench) == set(PAIR)
            assert bench.plant._identities.mismatched["P5B"] == (
                "its parameters are stored at the address of P5A"
            )

    run_virtual(main)


def test_nothing_moves_before_the_boards_of_a_connection_are_known(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path, wanted=wanted_of("P5A"))
        correct(bench)
        plant, cluster = bench.plant, bench.cluster_of("P5A")
        cluster.mute = True
        async with running(bench):
            token = await bench.commanded(ENGINEER)
            with pytest.raises(RefusedError, match="APPROACH: not accepted now: cluster_silent"):
                plant.command(ENGINEER, token, "APPROACH", PAIR)
            assert all(plant._identities.blocked(name) for name in PAIR)
            cluster.mute = False
            for _ in range(15):
                plant.authority.keep(ENGINEER, token)
                await bench.wait(1.0)
            plant.command(ENGINEER, token, "APPROACH", PAIR)
            await bench.wait(1.0)
            # Its boards are exchanged while it is away, and its rows are still young.
            bench.lines[cluster.name].drop()
            cluster.mute = True
            await bench.until(lambda: cluster.link.connected, 5.0)
            await bench.wait(0.1)
            items = items_of(DESIGN["P5A"].calibrated)
            for motion in ("IDLE", "UNLOCK"):
                with pytest.raises(RefusedError, match=f"{motion} P5A.*has sent nothing since"):
                    plant.command(ENGINEER, token, motion, PAIR)
            with pytest.raises(RefusedError, match="PARAMETERS P5A: it has sent nothing since"):
                plant.parameters(ENGINEER, token, "P5A", items)
            assert plant.defocus("Vera", PAIR)
            exchange(bench)
            cluster.mute = False
            await bench.until(lambda: named(bench) == set(PAIR), 3.0)

    run_virtual(main)


def test_no_two_armatures_are_equal() -> None:
    assert len(set(CRC.values())) == len(CRC)
