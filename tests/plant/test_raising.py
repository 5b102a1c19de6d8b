"""Which heliostats automatic control counts as lost, and which it sends to stow to start again."""

import asyncio
from collections.abc import Awaitable, Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from heliotrope.geometry import direction
from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Stage
from heliotrope.plant.motion.proofs import BeamError
from heliotrope.plant.operations import Logbook
from heliotrope.plant.operations.automatic import AutomaticControl, AutomaticSettings
from heliotrope.plant.operations.explaining import explain
from heliotrope.plant.operations.losses import Losses
from heliotrope.plant.operations.raising import Raising
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.orders.guards import Asked
from heliotrope.plant.refusals import NOT_NOW, NoFreePath
from heliotrope.plant.settings import PlantSettings
from heliotrope.safety import Act
from support.plant_bench import ENGINEER, OPERATOR, Bench, running

#: The sun stands at 5°: below the limit of automatic control, above that of the safety table.
DUSK = datetime(2026, 6, 21, 15, 10, tzinfo=UTC)
NAME, OTHER = "P1A", "P2A"
READY = 1 << meanings.FLAGS.index("READY")


def play(
    folder: Path, scene: Callable[[Bench], Awaitable[None]], start: datetime | None = None
) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, folder)
        for cluster in bench.clusters.values():
            cluster.set(states.IDLE)
            cluster.rows["flags"] = READY
        async with running(bench):
            await bench.wait(2.0)
            await scene(bench)

    run_virtual(main, **({} if start is None else {"start": start}))


def test_a_mirror_that_a_visit_locks_is_not_lost(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        wanted = np.ones(len(plant.field), dtype=np.bool_)
        losses = Losses(plant, Logbook(bench.clock), 0, None, lambda: None)
        assert not losses.look(wanted).any()
        for state in (states.LOCKED, states.IDLE, states.LOCKED):
            bench.cluster_of(NAME).set(state, NAME)
            await bench.wait(2.0)
            assert not losses.look(wanted).any()
            assert not losses.reason
        bench.cluster_of(NAME).set(states.DEFOCUSED, NAME)
        await bench.wait(2.0)
        lost = losses.look(wanted)
        assert np.flatnonzero(lost).tolist() == [plant.field.place(NAME)]
        assert losses.reason

    play(tmp_path, scene)


def test_a_mirror_that_was_idle_at_stow_is_not_lost(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        wanted = np.ones(len(bench.plant.field), dtype=np.bool_)
        losses = Losses(bench.plant, Logbook(bench.clock), 0, None, lambda: None)
        cluster = bench.cluster_of(NAME)
        cluster.rows["flags"][cluster.names.index(NAME)] |= meanings.AT_STOW
        await bench.wait(2.0)
        for state in (states.IDLE, states.LOCKED, states.STOWED):
            cluster.set(state, NAME)
            await bench.wait(2.0)
            assert not losses.look(wanted).any()
        assert not losses.reason

    play(tmp_path, scene)


def test_only_what_cannot_go_on_is_sent_to_stow(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant, none = bench.plant, np.zeros(len(bench.plant.field), dtype=np.bool_)
        raising = Raising(
            plant, Logbook(bench.clock), ENGINEER, most=2, patience=60.0, clearance=0.0, wanted=True
        )

        async def stuck(visiting: tuple[str, ...] = ()) -> list[str]:
            raising.stuck(visiting, none)
            await bench.wait(11.0)
            return [plant.field.names[row] for row in raising.stuck(visiting, none)]

        assert await stuck() == []
        row = bench.cluster_of(NAME).names.index(NAME)
        flags = int(bench.cluster_of(NAME).rows["flags"][row])
        bench.cluster_of(NAME).rows["flags"][row] = 0
        await bench.wait(2.0)
        assert await stuck((NAME,)) == []  # its visit sees to it
        assert await stuck() == [NAME]
        plant.wanted.missing[OTHER] = ("armature",)
        assert sorted(await stuck()) == sorted([NAME, OTHER])
        raising.want([NAME], wanted=False)
        assert await stuck() == [OTHER]
        # One whose path back to standby is blocked goes to stow if it is defocused.
        raising.want([NAME], wanted=True)
        bench.cluster_of(NAME).rows["flags"][row] = flags
        raising._block({NAME: NoFreePath("it enters a house")}, states.DEFOCUSED)
        assert await stuck() == [OTHER]
        bench.cluster_of(NAME).set(states.DEFOCUSED, NAME)
        await bench.wait(2.0)
        assert sorted(await stuck()) == sorted([NAME, OTHER])
        for name in (NAME, OTHER):
            bench.cluster_of(name).set(states.STOWED, name)
        await bench.wait(2.0)
        assert await stuck() == []

    play(tmp_path, scene)


def test_a_cluster_that_may_not_move_keeps_no_other_at_stow(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        bad, good = bench.cluster_of(NAME), bench.cluster_of(OTHER)
        for cluster in bench.clusters.values():
            cluster.set(states.STOWED)
        token = await bench.commanded(ENGINEER)
        bad.late = 86_400.0
        for _ in range(15):
            plant.authority.keep(ENGINEER, token)
            await bench.wait(1.0)
        assert plant.guards.reasons(Asked("APPROACH", plant.field.names), NOT_NOW).keys() == set(
            bad.names
        )
        log = Logbook(bench.clock)
        raising = Raising(plant, log, ENGINEER, most=99, patience=60.0, clearance=0.0, wanted=True)
        await raising.step(token, frozenset, np.zeros(len(plant.field), dtype=np.bool_))
        (waits,) = raising.waits((NAME, OTHER)).items()
        assert waits[0] == NAME
        assert waits[1].startswith("cluster_time_differs")
        await bench.wait(2.0)
        assert [message.heliostats or good.names for message in good.commands("APPROACH")] == [
            good.names
        ]
        assert not any(row.condition == "beam_blocked" for row in log.alarms())
        # A person's order to both goes to those that may move, and names the others.
        plant.authority.keep(ENGINEER, token)
        ticket = plant.command(ENGINEER, token, "APPROACH", (NAME, OTHER))
        assert ticket.refusals[NAME].startswith("cluster_time_differs")
        with pytest.raises(RefusedError, match="APPROACH: not accepted now: cluster_time_differs"):
            plant.command(ENGINEER, token, "APPROACH", (NAME,))

    play(tmp_path, scene)


@pytest.mark.parametrize("asked", [1, 1000])
def test_what_an_emergency_left_unproven_is_raised_at_once_when_it_is_proven(
    asked: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("heliotrope.plant.operations.raising.ASKED", asked)

    async def scene(bench: Bench) -> None:
        plant, cluster = bench.plant, bench.cluster_of(NAME)
        log = Logbook(bench.clock)
        raising = Raising(plant, log, ENGINEER, most=1, patience=60.0, clearance=0.0, wanted=False)
        raising.want((NAME, "P1B"), wanted=True)
        none = np.zeros(len(plant.field), dtype=np.bool_)
        cluster.untold.add(NAME)  # no step counts from after the order prove it
        await bench.wait(2.0)
        plant.raise_emergency("Olga", Act.STOW)
        await bench.wait(5.0)
        plant.withdraw_emergency(ENGINEER, "Olga")
        await bench.wait(3.0)
        plant.acknowledge(ENGINEER, "operator_emergency")
        await bench.wait(2.0)
        token = await bench.commanded(ENGINEER)

        async def step() -> list[tuple[str, ...]]:
            before = len(cluster.commands("APPROACH"))
            plant.authority.keep(ENGINEER, token)
            await raising.step(token, frozenset, none)
            await bench.wait(2.0)
            return [each.heliostats for each in cluster.commands("APPROACH")[before:]]

        waits = raising.waits((NAME, "P1B"))
        assert waits.keys() == {NAME}, waits
        assert waits[NAME].startswith("unproven_after_emergency P1A: ")
        # It keeps no other waiting, and it is no matter of its path.
        assert asked > 1 or await step() == []
        assert await step() == [("P1B",)]
        assert await step() == []
        assert raising.why_not(NAME) is None
        cluster.untold.clear()
        for _ in range(20):
            plant.authority.keep(ENGINEER, token)
            await bench.wait(1.0)
            if not raising.waits((NAME,)):
                break
        assert await step() == [(NAME,)]
        assert not any(row.condition == "beam_blocked" for row in log.alarms())

    play(tmp_path, scene)


def test_a_refusal_that_is_no_matter_of_the_path_raises_no_alarm_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is refused when its command is given, or its turn comes, is tried again soon."""

    async def scene(bench: Bench) -> None:
        plant, cluster = bench.plant, bench.cluster_of(NAME)
        log = Logbook(bench.clock)
        raising = Raising(plant, log, ENGINEER, most=9, patience=60.0, clearance=0.0, wanted=False)
        raising.want((NAME,), wanted=True)
        cluster.set(states.STOWED, NAME)
        await bench.wait(2.0)
        token = await bench.commanded(ENGINEER)
        reasons = ("a reason that was not there before", NoFreePath("enters mast"))
        for reason, named in zip(reasons, (False, True), strict=True):
            with monkeypatch.context() as patch:
                patch.setattr(plant._proofs, "clear", refusing({NAME: reason}))
                await raising.step(token, frozenset, np.zeros(len(plant.field), dtype=np.bool_))
            assert bool(raising.why_not(NAME)) is named
            assert any(row.condition == "beam_blocked" for row in log.alarms()) is named
            await bench.wait(6.0)
            plant.authority.keep(ENGINEER, token)

    def refusing(wrong: dict[str, str]) -> Callable[..., None]:
        def clear(name: str, *_: object) -> None:
            raise BeamError(name, wrong)

        return clear

    play(tmp_path, scene)


def test_what_cannot_go_on_is_stowed_and_raised_again(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        cluster = bench.cluster_of(NAME)
        row, log = cluster.names.index(NAME), Logbook(bench.clock)
        settings = AutomaticSettings(wanted=True, calibrate=False)
        control = AutomaticControl(bench.plant, log, settings=settings)
        running = asyncio.create_task(control.run())
        await bench.wait(20.0)
        assert bench.count(states.IDLE) == len(bench.plant.field.names)
        cluster.rows["flags"][row] = 0
        await bench.until(lambda: cluster.rows["state"][row] == states.STOWED)
        cluster.rows["flags"][row] = READY
        await bench.until(lambda: bench.count(states.IDLE) == len(bench.plant.field.names))
        assert [m.heliostats for m in cluster.commands("APPROACH")] == [(NAME,)]
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    play(tmp_path, scene)


def test_who_has_turned_away_without_the_way_is_not_ordered_to_standby(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant, none = bench.plant, np.zeros(len(bench.plant.field), dtype=np.bool_)
        raising = Raising(
            plant, Logbook(bench.clock), ENGINEER, most=9, patience=60.0, clearance=0.0, wanted=True
        )
        token = await bench.commanded(ENGINEER)
        for name in (NAME, OTHER):
            bench.cluster_of(name).set(states.DEFOCUSED, name)
        cluster = bench.cluster_of(NAME)
        cluster.rows["flags"][cluster.names.index(NAME)] = 0
        await bench.wait(2.0)
        await raising.step(token, frozenset, none)
        await bench.wait(2.0)
        sent = {
            n for c in bench.clusters.values() for m in c.commands("IDLE") for n in m.heliostats
        }
        assert sent == {OTHER}

    play(tmp_path, scene)


def test_who_is_stowed_while_its_aim_is_on_its_way_is_not_sent_to_the_receiver(
    tmp_path: Path,
) -> None:
    async def scene(bench: Bench) -> None:
        plant, none = bench.plant, np.zeros(len(bench.plant.field), dtype=np.bool_)
        raising = Raising(
            plant, Logbook(bench.clock), ENGINEER, most=2, patience=60.0, clearance=0.0, wanted=True
        )
        raising.want([n for n in plant.field.names if n not in (NAME, OTHER)], wanted=False)
        token = await bench.commanded(ENGINEER)
        bench.cluster_of(NAME).deaf.add(NAME)  # its aim is not answered: the turn waits for it
        step = asyncio.create_task(raising.step(token, frozenset, none))
        await bench.wait(1.0)
        plant.stow("a person", [OTHER])
        raising.want([OTHER], wanted=False)
        await step
        await bench.wait(5.0)
        sent = [
            n for c in bench.clusters.values() for m in c.commands("TRACK") for n in m.heliostats
        ]
        assert OTHER not in sent

    play(tmp_path, scene)


def test_a_mirror_at_standby_names_the_witness_that_it_waits_for(tmp_path: Path) -> None:
    """It was shown as waiting for its turn, which no order could bring."""

    async def main(clock: VirtualClock) -> None:
        settings = PlantSettings(witnesses=frozenset({"sun sensor"}))
        async with running(Bench(clock, tmp_path, settings=settings)) as bench:
            for cluster in bench.clusters.values():
                cluster.set(states.IDLE)
                cluster.rows["flags"] = READY
            other = bench.cluster_of(OTHER)
            other.rows["flags"][other.names.index(OTHER)] = 0
            plant, work = bench.plant, AutomaticSettings(wanted=True, calibrate=False, margin=0.0)
            control = AutomaticControl(plant, Logbook(clock), settings=work)
            tasks = asyncio.create_task(control.run())
            await bench.wait(6.0)
            why = (
                "it is waiting: no independent witness confirms this plant's sun position: none of"
            )
            steps = control.following(plant.now(), (NAME, OTHER))
            assert steps[NAME].text.startswith(f"it is under automatic control, at standby; {why}")
            assert steps[NAME].stage is Stage.DONE
            again = "it is waiting its turn to be raised again, because it can only track after"
            assert steps[OTHER].text == f"{again} an approach from stow"
            assert bench.count(states.TRACKING) == 0
            plant.witnesses.take("sun sensor", plant.sun_vector(), 0.0)
            await bench.until(lambda: bench.count(states.TRACKING) > 0)
            assert "waits" not in control.following(plant.now(), (NAME,))[NAME].text
            tasks.cancel()
            await asyncio.gather(tasks, return_exceptions=True)

    run_virtual(main)


def test_an_uncalibrated_mirror_at_standby_says_what_it_waits_for(tmp_path: Path) -> None:
    """It was shown as "IDLE: it is under automatic control: IDLE", which explains nothing."""

    async def scene(bench: Bench) -> None:
        plant, log = bench.plant, Logbook(bench.clock)
        # With this margin no uncalibrated beam counts as clear of the targets.
        control = AutomaticControl(
            plant, log, settings=AutomaticSettings(wanted=True, calibrate=False, margin=1e6)
        )
        running = asyncio.create_task(control.run())
        await bench.wait(6.0)
        step = control.following(plant.now(), (NAME,))[NAME]
        assert step.stage is Stage.DONE
        assert step.text == (
            "it is under automatic control, at standby; it is waiting: it is not calibrated, and "
            "its beam could hit a target on the way to the receiver, so a visit to a target comes "
            "first"
        )
        why = explain(plant, control, log, NAME, "")
        assert why.text == f"{NAME} is IDLE: {step.text}"
        off = "It stays at standby while calibration is off: there is no camera."
        assert (why.follows, why.remedy) == (off, "")
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    play(tmp_path, scene)


def test_what_is_found_up_at_dusk_is_stowed_unless_a_person_commands(tmp_path: Path) -> None:
    """The evening's stow may miss one that was not heard, or that was given back afterwards."""

    async def scene(bench: Bench) -> None:
        for cluster in bench.clusters.values():
            cluster.set(states.STOWED)
        logbook = Logbook(bench.clock)
        control = AutomaticControl(
            bench.plant,
            logbook,
            settings=AutomaticSettings(wanted=True),
        )
        running = asyncio.create_task(control.run())
        await bench.wait(10.0)  # the evening's stow finds nobody up
        late = bench.cluster_of(NAME)
        late.set(states.DEFOCUSED, NAME)
        await bench.until(lambda: bench.count(states.DEFOCUSED) == 0, 40.0)
        told = [each.text for each in logbook.events(100)]
        assert "the sun is low, so 1 heliostats go to stow" in told
        control.give_way()
        token = await bench.commanded()
        late.set(states.DEFOCUSED, NAME)
        for _ in range(60):
            bench.plant.authority.keep(OPERATOR, token)
            await bench.wait(1.0)
        assert bench.count(states.DEFOCUSED) == 1
        bench.plant.release_authority(OPERATOR, token)
        await bench.until(lambda: bench.count(states.DEFOCUSED) == 0, 40.0)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    play(tmp_path, scene, start=DUSK)


def test_the_field_is_raised_again_once_the_sun_is_a_degree_above_where_it_was_stowed(
    tmp_path: Path,
) -> None:
    async def scene(bench: Bench) -> None:
        logbook, count = Logbook(bench.clock), len(bench.plant.field.names)
        settings = AutomaticSettings(wanted=True, calibrate=False)
        control = AutomaticControl(bench.plant, logbook, settings=settings)
        running = asyncio.create_task(control.run())
        for elevation, stowed in ((7.9, count), (8.9, count), (9.1, 0)):
            sun = direction(np.radians(180.0), np.radians(elevation))
            bench.plant.sun_vector = partial(np.copy, sun)  # type: ignore[method-assign]
            await bench.wait(15.0)
            await bench.until(lambda stowed=stowed: bench.count(states.STOWED) == stowed)
            told = [each.text for each in logbook.events(1000)]
            assert told.count(f"the sun is low, so {count} heliostats go to stow") == 1
            assert told.count("the sun is high enough") == (elevation > 9.0)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    play(tmp_path, scene)


def test_a_mirror_that_is_locked_at_dusk_is_stowed_soon_after(tmp_path: Path) -> None:
    """A visit locks it for its parameters just when the evening looks who is up."""

    async def scene(bench: Bench) -> None:
        for cluster in bench.clusters.values():
            cluster.set(states.STOWED)
        late = bench.cluster_of(NAME)
        late.set(states.LOCKED, NAME)
        control = AutomaticControl(
            bench.plant,
            Logbook(bench.clock),
            settings=AutomaticSettings(wanted=True),
        )
        running = asyncio.create_task(control.run())
        await bench.wait(3.0)
        late.set(states.IDLE, NAME)
        await bench.until(lambda: bench.count(states.IDLE) == 0, 15.0)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    play(tmp_path, scene, start=DUSK)
