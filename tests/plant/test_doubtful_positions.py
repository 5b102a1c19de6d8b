"""Step counts in doubt keep a heliostat off the receiver until its place is confirmed."""

import math
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import ClusterStatus
from heliotrope.plant.attempts import Attempts
from heliotrope.plant.field.state import Mask
from heliotrope.plant.operations.calibrating import Calibrating, Visits
from heliotrope.plant.operations.views import CalibrationEntry
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.schedule.scheduler import VISITS
from heliotrope.safety import alarms
from support.plant_bench import ENGINEER, OPERATOR, VIEWER, Bench, running

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
            plant.doubtful.confirm("P5A", boots=2)
            assert named(bench) == {"P5A"}, "it was seen before its last boot"
            plant.doubtful.confirm("P5A", boots=3)
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
            status = ClusterStatus(cluster.name, 0, 0.0, "gps", 0.0, 3.0, 0.1)
            plant.doubtful.on_status(cluster.name, status, plant.now())
            await bench.wait(2.0)
            assert not cluster.commands("TRACK")

    run_virtual(main)


@dataclass
class Chosen:
    """A heliostat that is due."""

    heliostat: str


class Chooser:
    """A schedule that has all heliostats but some due, in the order of the field."""

    def __init__(self, bench: Bench, *rest: str) -> None:
        self.names, self.rest = bench.plant.field.names, rest
        self.entries: list[CalibrationEntry] = []
        self.attempts, self.reason = Attempts(VISITS), ""

    def next(self, target: str, ready: Mask) -> Chosen | None:
        del target
        due = [n for n, able in zip(self.names, ready, strict=True) if able and n not in self.rest]
        return Chosen(due[0]) if due else None

    def done(self, entry: CalibrationEntry) -> None:
        self.entries.append(entry)


class Refusing:
    """A visit that is refused at once."""

    async def run(self, person: object, token: int, heliostat: str, *rest: object) -> None:
        del person, token, rest
        raise RefusedError(f"{heliostat}: not now")


@pytest.mark.parametrize(
    ("doubted", "first"),
    [((), "P1A"), (("P5A",), "P5A"), (("P3B", "P5A"), "P3B"), (("P2A",), "P1A")],
    ids=["nobody", "one", "two", "one_that_is_not_due"],
)
def test_heliostats_in_doubt_are_visited_before_others(
    tmp_path: Path, doubted: tuple[str, ...], first: str
) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path)
        for name in doubted:
            reports(bench, name, DOUBTFUL, 1)
        async with running(bench):
            plant = bench.plant
            assert plant.field.names[0] == "P1A"
            chooser = Chooser(bench, "P2A")
            book = SimpleNamespace(error=np.zeros(len(plant.field)), conclude=lambda entry: None)
            silent = SimpleNamespace(
                event=lambda *_, **__: None, keep=lambda *_: None, take_alarm=lambda alarm: None
            )
            unknown = SimpleNamespace(now=lambda: np.full(len(plant.field), math.nan))
            calibrating = Calibrating(
                plant,
                silent,
                Visits(Refusing(), chooser),  # type: ignore[arg-type]
                book,
                silent,
                unknown,  # type: ignore[arg-type]
                lambda: (),
            )
            ready, token = np.ones(len(plant.field), dtype=np.bool_), await bench.commanded()
            assert await calibrating.visit("target", ready, ENGINEER, token) == (first,)
            assert [entry.heliostat for entry in chooser.entries] == [first]
            # Not if it is on its way elsewhere, or held.
            for name in doubted:
                ready[plant.field.place(name)] = False
            (last,) = await calibrating.visit("target", ready, ENGINEER, token)
            assert last not in doubted

    run_virtual(main)


def test_a_plant_that_restarts_asks_again_for_what_was_confirmed(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        for start in ("first", "second"):
            (tmp_path / start).mkdir()
            bench = Bench(clock, tmp_path / start)
            reports(bench, "P5A", DOUBTFUL, 3)
            async with running(bench):
                token = await bench.commanded()
                assert named(bench) == {"P5A"}
                plant = bench.plant
                plant.aim(OPERATOR, token, plant.default_aims(("P5A",)))
                bench.cluster_of("P5A").set(states.IDLE, "P5A")
                await bench.wait(2.0)
                with pytest.raises(RefusedError, match=r"TRACK P5A.*step counts may be wrong"):
                    plant.command(OPERATOR, token, "TRACK", ("P5A",))
                plant.acknowledge(OPERATOR, "counts_doubtful", "P5A")
                plant.command(OPERATOR, token, "TRACK", ("P5A",))

    run_virtual(main)
