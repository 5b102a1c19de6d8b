"""An ordinary STOW of many goes out in portions; nothing that is urgent waits behind it."""

from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from heliotrope.errors import InputError
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Emergency
from heliotrope.plant.motion.proofs import BeamError
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.plant.settings import PlantSettings
from heliotrope.plant.visits.visit import Visit
from heliotrope.safety import Act
from support.plant_bench import OPERATOR, Bench, running

RATE = 4.0
Scene = Callable[[Bench], Awaitable[None]]


def play(folder: Path, scene: Scene, rate: float = RATE) -> Bench:
    made: list[Bench] = []

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, folder, settings=PlantSettings(stow_rate=rate))
        made.append(bench)
        for cluster in bench.clusters.values():
            cluster.set(states.TRACKING)
        async with running(bench):
            await scene(bench)

    run_virtual(main)
    return made[0]


def sent(bench: Bench, name: str) -> list[tuple[float, str]]:
    """Times at which heliostats were first sent DEFOCUS or STOW, in order."""
    first: dict[str, float] = {}
    for cluster in bench.clusters.values():
        for at, message in cluster.taken:
            if isinstance(message, Emergency) and message.name == name:
                for one in message.heliostats or cluster.names:
                    first[one] = min(at, first.get(one, at))
    return sorted((at, one) for one, at in first.items())


def test_they_go_one_after_the_other_in_their_order(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        ticket = bench.plant.stow("anybody")
        assert ticket.counted()["waiting"] == 18
        assert await ticket.end(20.0), ticket.text
        assert bench.count(states.STOWED) == 18
        begin = ticket.accepted_at
        for k, (at, _) in enumerate(sent(bench, "STOW")):
            # The first four at once, then four a second; a beat and the line come on top.
            assert (k - RATE) / RATE <= at - begin <= max(0.0, (k + 1 - RATE) / RATE) + 0.5
        assert [one for _, one in sent(bench, "STOW")][:4] == list(bench.plant.field.names[:4])

    play(tmp_path, scene)


def test_the_lowest_rate_is_one_a_second(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        ticket = bench.plant.stow("anybody", ("P1A", "P1B", "P1C"))
        assert await ticket.end(20.0), ticket.text
        (first, _), *_, (last, _) = sent(bench, "STOW")
        assert last - first >= 1.5

    play(tmp_path, scene, rate=1.0)


def test_at_once_where_the_setting_says_so_and_for_a_few(tmp_path: Path) -> None:
    async def all_at_once(bench: Bench) -> None:
        ticket = bench.plant.stow("anybody")
        await bench.wait(0.5)
        assert len(sent(bench, "STOW")) == 18
        assert await ticket.end(5.0)

    play(tmp_path, all_at_once, rate=0.0)

    async def few(bench: Bench) -> None:
        bench.plant.stow("anybody")
        last = bench.plant.field.names[-2:]
        ticket = bench.plant.stow("somebody", last)
        await bench.wait(0.5)
        assert {one for _, one in sent(bench, "STOW")} >= set(last)
        assert len(sent(bench, "STOW")) < 18
        assert await ticket.end(5.0)

    (tmp_path / "few").mkdir()
    play(tmp_path / "few", few)


@pytest.mark.parametrize("act", [Act.DEFOCUS, Act.STOW])
def test_an_emergency_waits_for_nobody(tmp_path: Path, act: Act) -> None:
    async def scene(bench: Bench) -> None:
        ticket = bench.plant.stow("anybody")
        await bench.wait(1.0)
        begun = bench.clock.monotonic()
        order = bench.plant.raise_emergency("anybody", act)
        await bench.wait(0.5)
        before = len(sent(bench, "STOW"))
        assert {one for at, one in sent(bench, act.name) if at >= begun} >= {
            one for one in bench.plant.field.names if ticket.refusals.get(one)
        }
        assert order.ticket.counted().keys() == {"done"}
        # What still waited has ended: no portion follows.
        await bench.wait(5.0)
        assert ticket.finished
        assert f"superseded by {act.name}" in ticket.text
        assert len(sent(bench, "STOW")) == before
        # While it holds, an ordinary STOW goes at once too.
        bench.plant.stow("somebody")
        await bench.wait(0.5)
        assert len(sent(bench, "STOW")) == 18

    play(tmp_path, scene)


def test_a_second_order_in_turn_takes_the_place_of_the_first(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        first = bench.plant.stow("anybody")
        await bench.wait(0.5)
        waits = [name for name in bench.plant.field.names if bench.plant.waits_to_stow(name)]
        assert waits
        second = bench.plant.stow("another")
        # At once, and not when their turn comes.
        assert {name: first.refusals.get(name) for name in waits} == dict.fromkeys(
            waits, "superseded by STOW"
        )
        assert await second.end(20.0), second.text
        assert bench.count(states.STOWED) == 18

    play(tmp_path, scene)


def test_what_waits_is_not_moved_but_locked(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        token = await bench.commanded()
        ticket = bench.plant.stow("anybody")
        free, last = bench.plant.field.names[-2:]
        with pytest.raises(BeamError, match=f"IDLE {free}: it is waiting its turn to go to stow"):
            bench.plant.command(OPERATOR, token, "IDLE", (free,))
        assert await bench.plant.command(OPERATOR, token, "LOCK", (last,)).end(5.0)
        await bench.wait(5.0)
        assert ticket.finished
        assert ticket.refusals == {last: "superseded by LOCK"}
        assert last not in [one for _, one in sent(bench, "STOW")]
        assert len(sent(bench, "STOW")) == 17

    play(tmp_path, scene)


def test_a_visit_ends_instead_of_taking_its_mirror_out_of_the_turn(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        engineer = Person("Egon", Role.ENGINEER)
        token = await bench.commanded(engineer)
        last = bench.plant.field.names[-1]
        plant, target = bench.plant, bench.plant.design.targets[0]
        with plant.authority.mandate(engineer, token, (last,), target.name) as mandate:
            visit = Visit(plant, mandate, last, target)
            ticket = plant.stow("anybody")
            with pytest.raises(
                RefusedError, match=f"{last}: it dropped out of the visit: anybody ordered"
            ):
                await visit.command("LOCK")
        assert await ticket.end(20.0), ticket.text
        assert bench.count(states.STOWED) == 18

    play(tmp_path, scene)


def test_repeating_the_order_delays_nobody(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        first = bench.plant.stow("anybody")
        for _ in range(8):
            await bench.wait(0.5)
            bench.plant.stow("anybody")
        await bench.wait(0.5)
        assert first.finished
        assert len(sent(bench, "STOW")) == 18
        assert bench.count(states.STOWED) == 18

    play(tmp_path, scene)


def test_only_what_was_sent_is_repeated_until_it_is_acknowledged(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        names = bench.plant.field.names
        bench.cluster_of(names[0]).deaf.add(names[0])
        ticket = bench.plant.stow("anybody")
        await bench.wait(2.5)
        first = bench.cluster_of(names[0])
        here = [m for m in first.of(Emergency) if names[0] in (m.heliostats or first.names)]
        assert len(here) >= 3
        assert len(sent(bench, "STOW")) <= 4 + 4 * 2.5 + 1
        assert ticket.unacknowledged()[0] == names[0]

    play(tmp_path, scene)


@pytest.mark.parametrize("rate", [0.5, -1.0, float("inf"), float("nan")])
def test_a_rate_that_makes_no_sense_is_refused(rate: float) -> None:
    with pytest.raises(InputError, match="the stow rate must be 1 heliostat a second"):
        PlantSettings(stow_rate=rate)
