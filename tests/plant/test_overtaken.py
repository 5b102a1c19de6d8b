"""No command from before DEFOCUS or STOW follows it, and no weaker order ends a STOW."""

import asyncio
from pathlib import Path

import pytest

from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Emergency, Stage
from heliotrope.plant.settings import PlantSettings
from support.plant_bench import OPERATOR, Bench, running

NEAR = (0.1, 0.2, 16.5)


def confirmed_late(bench: Bench, cluster: str, seconds: float) -> None:
    """Let a broker confirm each message to a cluster after some seconds; the next one waits."""
    carrier = bench.links[cluster]._carrier
    real = carrier.write

    async def write(envelope: bytes, lifetime: float | None) -> None:
        await real(envelope, lifetime)
        await asyncio.sleep(seconds)

    carrier.write = write


@pytest.mark.parametrize("order", ["emergency", "DEFOCUS", "STOW"])
def test_what_waited_for_the_line_does_not_follow_a_safe_order(tmp_path: Path, order: str) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path)
        cluster = next(iter(bench.clusters.values()))
        cluster.set(states.IDLE)
        async with running(bench):
            plant, token = bench.plant, await bench.commanded()
            confirmed_late(bench, cluster.name, 0.3)
            for name in cluster.names:
                plant.aim(OPERATOR, token, {name: NEAR})
            ticket = plant.command(OPERATOR, token, "IDLE", cluster.names)
            await bench.wait(0.2)
            if order == "emergency":
                plant.raise_emergency("anybody")
            else:
                give = plant.defocus if order == "DEFOCUS" else plant.stow
                give("anybody", cluster.names[:2])
            await bench.wait(5.0)
            left = () if order == "emergency" else cluster.names[2:]
            assert [m.heliostats for m in cluster.commands("IDLE")] == ([left] if left else [])
            assert "came first" in ticket.text
            assert len(cluster.commands("AIM")) == 3

    run_virtual(main)


def test_a_lost_stow_is_repeated_although_the_silence_of_its_cluster_defocuses(
    tmp_path: Path,
) -> None:
    async def main(clock: VirtualClock) -> None:
        async with running(Bench(clock, tmp_path)) as bench:
            cluster = next(iter(bench.clusters.values()))
            cluster.set(states.TRACKING)
            await bench.wait(2.0)
            bench.lines[cluster.name].cut()
            await bench.wait(1.0)
            ticket = bench.plant.stow("Vera", cluster.names)
            await bench.wait(5.0)
            bench.lines[cluster.name].heal()
            await bench.until(lambda: "STOW" in [m.name for m in cluster.of(Emergency)], 10.0)
            assert await ticket.end(10.0), ticket.text

    run_virtual(main)


@pytest.mark.parametrize("why", ["aim", "parameters"])
def test_who_waits_to_join_is_examined_when_its_turn_comes(tmp_path: Path, why: str) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path, settings=PlantSettings(join_rate=0.5, join_burst=1))
        for cluster in bench.clusters.values():
            cluster.set(states.IDLE)
        async with running(bench):
            plant, token, last = bench.plant, await bench.commanded(), bench.plant.field.names[-1]
            assert await plant.aim(OPERATOR, token, plant.default_aims()).end(10.0)
            home = bench.cluster_of(last)
            if why == "aim":
                home.stubborn.add(last)
                again = plant.aim(OPERATOR, token, {last: NEAR})
                ticket = plant.command(OPERATOR, token, "TRACK")
                assert not await again.end(5.0)
                home.stubborn.clear()
            else:
                ticket = plant.command(OPERATOR, token, "TRACK")
                plant.want(last, plant.beliefs.present(last)[0])
            for _ in range(90):
                await bench.wait(0.5)
                plant.authority.keep(OPERATOR, token)
            assert not [m for m in home.commands("TRACK") if last in (m.heliostats or home.names)]
            assert ticket.stage(last) is Stage.REFUSED

    run_virtual(main)


def test_nobody_joins_while_new_motions_are_refused(tmp_path: Path) -> None:
    sensor = "receiver_camera_silence"

    async def main(clock: VirtualClock) -> None:
        settings = PlantSettings(join_rate=1.0, join_burst=1, sensors=frozenset({sensor}))
        bench = Bench(clock, tmp_path, settings=settings)
        for cluster in bench.clusters.values():
            cluster.set(states.IDLE)
        async with running(bench):
            plant = bench.plant
            plant.put(sensor, 0.0)
            token = plant.take_authority(OPERATOR).token

            async def work(seconds: int, silence: float) -> None:
                for _ in range(seconds):
                    await bench.wait(1.0)
                    plant.authority.keep(OPERATOR, token)
                    plant.put(sensor, silence)

            await work(15, 0.0)
            assert await plant.aim(OPERATOR, token, plant.default_aims()).end(10.0)
            ticket = plant.command(OPERATOR, token, "TRACK")
            await work(3, 0.0)
            await work(2, 20.0)
            before = bench.count(states.TRACKING)
            assert 0 < before < 10
            await work(10, 20.0)
            assert bench.count(states.TRACKING) == before
            await work(40, 0.0)
            assert ticket.good, ticket.text

    run_virtual(main)


def test_who_comes_back_in_an_emergency_is_no_longer_done_and_is_sent_off_again(
    tmp_path: Path,
) -> None:
    async def main(clock: VirtualClock) -> None:
        async with running(Bench(clock, tmp_path)) as bench:
            plant, name = bench.plant, bench.plant.field.names[0]
            cluster = bench.cluster_of(name)
            cluster.set(states.TRACKING)
            await bench.wait(2.0)
            order = plant.raise_emergency("Vera")
            await bench.until(lambda: order.is_done(name), 10.0)
            cluster.stubborn.add(name)
            await bench.wait(2.0)
            sent = len(cluster.of(Emergency))
            cluster.set(states.TRACKING, name)
            await bench.until(lambda: not order.is_done(name), 3.0)
            assert name in order.report(plant.now()).not_done
            again = cluster.of(Emergency)[sent:]
            assert {(m.name, m.heliostats) for m in again} == {("DEFOCUS", (name,))}

    run_virtual(main)
