"""Step counts in doubt keep a heliostat off the receiver until its place is confirmed."""

from pathlib import Path

import numpy as np
import pytest

from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.authority import RefusedError
from heliotrope.safety import alarms
from support.plant_bench import OPERATOR, VIEWER, Bench, running

DOUBTFUL = 1 << meanings.FLAGS.index("COUNTS_DOUBTFUL")
UNKNOWN = 1 << meanings.FLAGS.index("COUNTS_UNKNOWN")


def reports(bench: Bench, name: str, flags: int, boots: int) -> None:
    """Let the board of a heliostat report flags and its number of boots."""
    cluster = bench.cluster_of(name)
    row = cluster.names.index(name)
    cluster.rows["flags"][row], cluster.rows["boots"][row] = flags, boots


def named(bench: Bench) -> set[str]:
    """The heliostats whose alarm has not ended."""
    kind = alarms.COUNTS_DOUBTFUL.name
    last = {a.subject: a.active for a in bench.plant.alarms if a.condition == kind}
    return {name for name, active in last.items() if active}


def test_a_doubtful_heliostat_joins_only_after_a_person_has_confirmed_it(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path)
        reports(bench, "P5A", DOUBTFUL, 3)
        reports(bench, "P5C", DOUBTFUL | UNKNOWN, 3)
        async with running(bench):
            plant, cluster = bench.plant, bench.cluster_of("P5A")
            token = await bench.commanded()
            plant.aim(OPERATOR, token, plant.default_aims())
            cluster.set(states.IDLE, "P5A", "P5B")
            await bench.wait(2.0)
            assert named(bench) == {"P5A"}, "unknown counts are a fault of their own"
            for name in ("TRACK", "REFOCUS"):
                with pytest.raises(RefusedError, match=f"{name} P5A.*step counts may be wrong"):
                    plant.command(OPERATOR, token, name, ("P5A",))
            ticket = plant.command(OPERATOR, token, "TRACK", ("P5A", "P5B"))
            assert ticket.blocked.keys() == {"P5A"}
            with pytest.raises(RefusedError):
                plant.acknowledge(VIEWER, "counts_doubtful", "P5A")
            plant.acknowledge(OPERATOR, "counts_doubtful", "P5A")
            await bench.wait(2.0)
            assert named(bench) == set()
            plant.command(OPERATOR, token, "TRACK", ("P5A",))
            await bench.wait(2.0)
            assert {n for m in cluster.commands("TRACK") for n in m.heliostats} == {"P5A", "P5B"}
            reports(bench, "P5A", DOUBTFUL, 4)
            cluster.set(states.IDLE, "P5A")
            await bench.wait(2.0)
            assert named(bench) == {"P5A"}, "it has lost its power again"
            reports(bench, "P5A", 0, 4)
            await bench.wait(2.0)
            assert named(bench) == set(), "ZERO ends the doubt"
            plant.command(OPERATOR, token, "TRACK", ("P5A",))

    run_virtual(main)


def test_a_doubtful_heliostat_may_go_to_a_target_and_not_on_to_the_receiver(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path)
        reports(bench, "P5A", DOUBTFUL, 3)
        async with running(bench):
            plant, cluster = bench.plant, bench.cluster_of("P5A")
            token = await bench.commanded()
            target = plant.design.targets[0].center
            cluster.set(states.IDLE, "P5A")
            plant.aim(OPERATOR, token, {"P5A": np.asarray(target)})
            await bench.wait(2.0)
            plant.command(OPERATOR, token, "TRACK", ("P5A",))
            await bench.wait(2.0)
            assert cluster.commands("TRACK")
            with pytest.raises(RefusedError, match=r"AIM P5A.*step counts may be wrong"):
                plant.aim(OPERATOR, token, plant.default_aims(("P5A",)))
            plant.doubts.confirm("P5A", boots=2)
            assert named(bench) == {"P5A"}, "it was seen before its last boot"
            plant.doubts.confirm("P5A", boots=3)
            plant.aim(OPERATOR, token, plant.default_aims(("P5A",)))

    run_virtual(main)


def test_one_that_loses_its_power_while_it_waits_to_join_is_not_sent(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path)
        async with running(bench):
            plant, cluster = bench.plant, bench.cluster_of("P5A")
            token = await bench.commanded()
            plant.aim(OPERATOR, token, plant.default_aims(("P5A",)))
            cluster.set(states.IDLE, "P5A")
            await bench.wait(2.0)
            plant.command(OPERATOR, token, "TRACK", ("P5A",))
            reports(bench, "P5A", DOUBTFUL, 1)
            row = plant.field.place("P5A")
            plant.field.rows["flags"][row], plant.field.rows["boots"][row] = DOUBTFUL, 1
            plant.doubts.look(cluster.name)
            await bench.wait(2.0)
            assert not cluster.commands("TRACK")

    run_virtual(main)
