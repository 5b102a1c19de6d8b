"""The board that answers at an address is the one of the heliostat, or nothing moves there."""

from pathlib import Path
from zlib import crc32

import pytest

from heliotrope.field.example import prototype
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Command, Emergency, Parameters
from heliotrope.mechanism.board_items import Wanted, items_of
from heliotrope.plant.authority import RefusedError
from heliotrope.safety import alarms
from support.plant_bench import OPERATOR, Bench, running

DESIGN = prototype()
PAIR = ("P5A", "P5B")


def wanted_of(*names: str) -> Wanted:
    """What some heliostats should store."""
    return Wanted({name: items_of(DESIGN.heliostat(name)) for name in names})


def stores(bench: Bench, name: str, crc: int) -> None:
    """Let the board at a heliostat's address report a checksum of its armature."""
    cluster = bench.cluster_of(name)
    cluster.rows["armature_crc"][cluster.names.index(name)] = crc


def named(bench: Bench) -> set[str]:
    """The heliostats whose alarm has not ended."""
    kind = alarms.IDENTITY.name
    last = {a.subject: a.active for a in bench.plant.alarms if a.condition == kind}
    return {name for name, active in last.items() if active}


def test_exchanged_addresses_are_named_and_neither_is_moved_or_written(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        wanted = wanted_of(*PAIR, "P5C")
        crc = {name: crc32(items["armature"]) for name, items in wanted.items.items()}
        bench = Bench(clock, tmp_path, wanted=wanted)
        stores(bench, "P5A", crc["P5B"])
        stores(bench, "P5B", crc["P5A"])
        stores(bench, "P5C", crc["P5C"])
        async with running(bench):
            plant, cluster = bench.plant, bench.cluster_of("P5A")
            token = await bench.commanded()
            await bench.wait(5.0)
            assert named(bench) == set(PAIR)
            text = next(a.text for a in plant.alarms if a.subject == "P5A")
            assert "P5A: its address answers with the parameters of P5B" in text
            for name in ("APPROACH", "TRACK", "IDLE"):
                cluster.set(states.STOWED if name == "APPROACH" else states.IDLE, *PAIR)
                await bench.wait(1.5)
                with pytest.raises(RefusedError, match=f"{name} P5A.*answers with the parameters"):
                    plant.command(OPERATOR, token, name, PAIR)
            ticket = plant.command(OPERATOR, token, "APPROACH", (*PAIR, "P5C"))
            assert ticket.blocked.keys() == set(PAIR)
            with pytest.raises(RefusedError, match="PARAMETERS P5A: its address answers"):
                plant.parameters(OPERATOR, token, "P5A", wanted.items["P5A"])
            await bench.wait(2.0)
            assert {m.heliostats for m in cluster.of(Command)} == {("P5C",)}
            assert not {m.heliostat for m in cluster.of(Parameters)} & set(PAIR)
            assert await plant.defocus("Vera", PAIR).end(10.0)
            assert cluster.of(Emergency)
            for name in PAIR:
                stores(bench, name, crc[name])
            await bench.wait(3.0)
            assert named(bench) == set()
            cluster.set(states.STOWED, *PAIR)
            await bench.wait(1.5)
            plant.authority.keep(OPERATOR, token)
            assert plant.command(OPERATOR, token, "APPROACH", PAIR)

    run_virtual(main)


def test_an_armature_that_is_nobodys_is_no_exchange(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path, wanted=wanted_of("P5A"))
        stores(bench, "P5A", 12345)
        stores(bench, "P5B", 54321)
        async with running(bench):
            await bench.wait(15.0)
            assert named(bench) == set()
            # The plant learns that it is another's.
            bench.plant.want("P5B", DESIGN.heliostat("P5B"))
            stores(bench, "P5A", crc32(items_of(DESIGN.heliostat("P5B"))["armature"]))
            await bench.wait(5.0)
            assert named(bench) == {"P5A"}

    run_virtual(main)
