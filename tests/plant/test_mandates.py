"""Visits and people: who takes command, orders a heliostat of a visit, or presses EMERGENCY.

Whatever a person does at whatever stage, nothing stays locked, moved or away without an owner, and
the plant's own acts are no losses.
"""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable

import numpy as np
import pytest

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.lcu import states
from heliotrope.plant.motion.proofs import BeamError
from heliotrope.plant.operations.automatic import AUTOMATIC
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.plant.visits import CycleResult, CycleSettings
from support.joint_scene import Scene, joint
from support.visit_scene import ENGINEER, left_to_work

VERA = Person("Vera", Role.ENGINEER)
CALIBRATED = CalibrationOutcome.CALIBRATED
#: Beginnings of the stages of a joint visit; the last is that in which parameters are written.
STAGES = ("the empty", "6 on the way", "photograph 4 ", "6 on the way back", "taking", "LOCKED")
#: The same for a test of each; two lie between others that are like them.
EACH = [
    pytest.param(one, marks=pytest.mark.slow) if one in ("6 on the way", "taking") else one
    for one in STAGES
]


async def reached(here: Scene, stage: str, visit: "asyncio.Task[object]") -> None:
    """Wait until a visit is at a stage."""
    field, plant = here.live.plant.field, here.live.plant
    for _ in range(12_000):
        if stage == "LOCKED" and field.among((states.LOCKED,), plant.now()).any():
            return
        if any(each.startswith(stage) for each in here.stages):
            return
        assert not visit.done(), visit
        await asyncio.sleep(0.05)
    raise AssertionError(f"{stage}: {here.stages}")


async def until(here: Scene, what: Callable[[], bool], limit: float = 600.0) -> None:
    end = here.live.clock.monotonic() + limit
    while not what():
        assert here.live.clock.monotonic() < end, here.states()
        await asyncio.sleep(0.5)


async def kept(here: Scene) -> None:
    """Check that visits hold nothing any more."""
    plant = here.live.plant
    await until(here, lambda: not plant.locks.names and not plant.movements.names, 10.0)
    assert not plant.authority.visited()
    assert "LOCKED" not in here.states().values()


def stays(here: Scene, person: Person, token: int) -> "asyncio.Task[None]":
    async def stay() -> None:
        with contextlib.suppress(RefusedError):
            while True:
                here.live.plant.authority.keep(person, token)
                await asyncio.sleep(1.0)

    return asyncio.create_task(stay())


def commanded(here: Scene, person: Person) -> int:
    """Let a person break the command authority, and keep it; return the token."""
    token = here.live.plant.seize_authority(person, "test").token
    here.staying = stays(here, person, token)  # type: ignore[attr-defined]
    return token


def played(scene: Callable[[Scene], Awaitable[None]], **given: object) -> None:
    async def whole(here: Scene) -> None:
        try:
            await scene(here)
        finally:
            if staying := getattr(here, "staying", None):
                staying.cancel()

    joint(whole, **given)  # type: ignore[arg-type]


def good(results: dict[str, CycleResult], *but: str) -> bool:
    return all(r.outcome is CALIBRATED for name, r in results.items() if name not in but)


@pytest.mark.parametrize("stage", EACH)
def test_who_takes_command_lets_a_joint_visit_end(stage: str) -> None:
    async def scene(here: Scene) -> None:
        plant, aims = here.live.plant, here.live.plant.aims.copy()
        sent = list[object]()
        plant.defocus = lambda *given: sent.append(given)  # type: ignore[method-assign]
        visit = asyncio.create_task(here.run())
        await reached(here, stage, visit)
        if STAGES.index(stage) % 2:
            plant.release_authority(ENGINEER, here.token)  # nobody takes it: the visit goes on
            await asyncio.sleep(20.0)
            plant.take_authority(VERA)
        else:
            commanded(here, VERA)
        results = await visit
        assert good(results), results
        assert not sent, "no beam was turned away"
        await until(here, lambda: set(here.states().values()) == {"TRACKING"})
        np.testing.assert_array_equal(plant.aims, aims)
        await kept(here)

    played(scene)


def test_a_new_visit_needs_the_command_authority() -> None:
    async def scene(here: Scene) -> None:
        commanded(here, VERA)
        with pytest.raises(RefusedError, match="Vera has it"):
            await here.run()

    played(scene, count=2)


def test_a_persons_orders_take_heliostats_out_one_by_one_and_the_others_go_on() -> None:
    async def scene(here: Scene) -> None:
        plant = here.live.plant
        orders = ("IDLE", "STOW", "DEFOCUS", "AIM", "TRACK", "JOG")
        gone = dict(zip(here.names, orders, strict=False))
        aims, aimed = plant.aims.copy(), here.live.design.targets[1].center
        visit = asyncio.create_task(here.run())
        await reached(here, "photograph 3 ", visit)
        token = commanded(here, VERA)
        await asyncio.sleep(3.0)
        for name, order in gone.items():
            if order == "AIM":
                plant.aim(VERA, token, {name: aimed})
                aims[plant.field.place(name)] = aimed
            else:
                plant.command(VERA, token, order, (name,), (0, 400) if order == "JOG" else ())
        results = await visit
        assert good(results, *gone), results
        for name, order in gone.items():
            assert f"dropped out of the visit: Vera ordered {order}" in results[name].text
            assert results[name].outcome is CalibrationOutcome.TAKEN_OUT
        stands = {"IDLE": "IDLE", "STOW": "STOWED", "DEFOCUS": "DEFOCUSED"}
        ends = {name: stands.get(gone.get(name, ""), "TRACKING") for name in here.names}
        await until(here, lambda: here.states() == ends, 200.0)
        await asyncio.sleep(10.0)
        assert here.states() == ends
        np.testing.assert_array_equal(plant.aims, aims)
        await kept(here)

    played(scene, count=9)


@pytest.mark.parametrize("stage", ["photograph 3 ", "LOCKED"])
@pytest.mark.parametrize("order", ["IDLE", "STOW", "DEFOCUS"])
def test_an_order_to_all_ends_the_visit_in_order(stage: str, order: str) -> None:
    async def scene(here: Scene) -> None:
        plant = here.live.plant
        aims = plant.aims.copy()
        visit = asyncio.create_task(here.run())
        await reached(here, stage, visit)
        token = commanded(here, VERA)
        if order == "IDLE":
            await asyncio.sleep(3.0)
        plant.command(VERA, token, order)
        texts = [""]
        try:
            texts = [result.text for result in (await visit).values()]
        except RefusedError as error:
            texts = [str(error)]
        assert any(f"dropped out of the visit: Vera ordered {order}" in text for text in texts), (
            texts
        )
        ends = {"IDLE": {"IDLE"}, "STOW": {"STOWED"}, "DEFOCUS": {"DEFOCUSED"}}[order]
        if stage == "LOCKED" and order == "DEFOCUS":  # locked mirrors are unlocked at stow
            ends |= {"STOWED"}
        elif stage == "LOCKED" and order == "IDLE":
            ends |= set(states.STATES) - {"LOCKED"}
        await until(here, lambda: set(here.states().values()) <= ends, 240.0)
        await asyncio.sleep(20.0)
        await kept(here)
        assert set(here.states().values()) <= ends
        np.testing.assert_array_equal(plant.aims, aims)

    played(scene)


@pytest.mark.parametrize("stage", EACH)
def test_an_emergency_leaves_nothing_locked_and_the_field_goes_up_again(stage: str) -> None:
    async def scene(here: Scene) -> None:
        plant, operations = here.live.plant, here.live.operations
        aims = plant.aims.copy()
        visit = asyncio.create_task(here.run())
        await reached(here, stage, visit)
        order = operations.emergency(VERA, "DEFOCUS", "smoke")
        with contextlib.suppress(RefusedError):
            await visit
        await asyncio.sleep(25.0)
        assert order.report(plant.now()).complete, order.report(plant.now()).text
        await asyncio.sleep(120.0)
        assert plant.sentinel.order is not None
        report = plant.sentinel.order.report(plant.now())
        assert report.complete, report.text
        assert not report.unknown
        assert set(here.states().values()) <= {"STOWED", "LOCKED"}
        assert here.live.assembly.left() == "", "all stand at stow, locked there or not"
        (call,) = operations.plant.sentinel.calls
        operations.withdraw(ENGINEER, call.who)
        await asyncio.sleep(6.0)
        for alarm in operations.logbook.alarms():
            with contextlib.suppress(RefusedError):
                operations.acknowledge(ENGINEER, alarm.condition, alarm.subject)
        await asyncio.sleep(60.0)
        await kept(here)
        np.testing.assert_array_equal(plant.aims, aims)
        assert set(here.states().values()) == {"STOWED"}
        with contextlib.suppress(RefusedError):
            plant.release_authority(ENGINEER, plant.authority.token)
        operations.give_back(ENGINEER)
        await until(here, lambda: set(here.states().values()) == {"TRACKING"})
        assert not operations.automatic.waits

    played(scene)


@pytest.mark.parametrize("stage", EACH)
def test_a_cancelled_visit_leaves_nothing(stage: str) -> None:
    async def scene(here: Scene) -> None:
        plant, aims = here.live.plant, here.live.plant.aims.copy()
        visit = asyncio.create_task(here.run())
        await reached(here, stage, visit)
        visit.cancel()
        with pytest.raises(asyncio.CancelledError):
            await visit
        await asyncio.sleep(30.0)
        await kept(here)
        np.testing.assert_array_equal(plant.aims, aims)
        # One that is not yet at standby, and may no longer be waited for, is taken off the target.
        ends = {"DEFOCUSED"} if stage == "6 on the way back" else {"IDLE", "TRACKING"}
        assert set(here.states().values()) <= ends
        assert here.lit() == []

    played(scene)


def test_rough_stepping_waits_for_those_in_a_visit() -> None:
    async def scene(here: Scene) -> None:
        plant, (free, *visited) = here.live.plant, here.names
        visit = asyncio.create_task(here.run(*visited))
        await reached(here, "photograph 3 ", visit)
        token = commanded(here, VERA)
        await asyncio.sleep(3.0)
        ticket = plant.command(VERA, token, "ROUGH", (), (1,))
        said = "it is on a calibration visit to left; repeat the command when the visit has ended"
        assert ticket.refusals == dict.fromkeys(visited, said)
        with pytest.raises(BeamError, match="on a calibration visit to left"):
            plant.command(VERA, token, "LOCK_AIM", (visited[0],), (1,))
        results = await visit
        assert "visit" not in ticket.refusals.get(free, "")
        assert good(results), results
        assert set(here.states().values()) == {"TRACKING"}
        again = plant.command(VERA, token, "ROUGH", (), (0,))
        assert not again.refusals, "each may have it now"

    played(scene)


@pytest.mark.parametrize("word", ["on the way", "photograph 2 ", "learning"])
def test_automatic_control_goes_on_after_a_person_and_its_visits_are_no_losses(word: str) -> None:
    async def scene(here: Scene) -> None:
        plant, operations = here.live.plant, here.live.operations
        left_to_work(here)
        await until(here, lambda: any(_stages(here, word)))
        token = operations.take_authority(VERA).token
        here.staying = stays(here, VERA, token)  # type: ignore[attr-defined]
        assert operations.automatic.view().running
        await until(here, lambda: not operations.automatic.view().running, 400.0)
        assert not operations.automatic.waits
        assert set(here.states().values()) <= {"TRACKING", "IDLE"}
        await kept(here)
        await asyncio.sleep(30.0)
        assert not operations.automatic.view().running, "a person has command: nothing new begins"
        results = operations.automatic.view().results
        assert any(result.outcome is CALIBRATED for result in results), results
        here.staying.cancel()  # type: ignore[attr-defined]
        operations.release_authority(VERA, token)
        await until(here, lambda: bool(operations.automatic.view().on))
        await until(here, lambda: set(here.states().values()) == {"TRACKING"})
        assert plant.authority.grant is not None
        assert plant.authority.grant.holder == AUTOMATIC
        operations.automatic.switch(on=False)

    played(scene)


def test_who_was_taken_out_of_a_joint_visit_is_shown_in_it_no_longer() -> None:
    """Simulated day 51064: it was shown in the visit while a person commanded it."""

    async def scene(here: Scene) -> None:
        plant, view = here.live.plant, here.live.operations.automatic.view
        left_to_work(here)
        await until(here, lambda: any(_stages(here, "photograph 2 ")))
        (before,) = view().running
        gone, token = before.heliostats[0], commanded(here, VERA)
        plant.command(VERA, token, "STOW", (gone,))
        (after,) = view().running
        assert after.since == before.since
        assert after.heliostats == before.heliostats[1:]
        here.live.operations.automatic.switch(on=False)

    played(scene)


def _stages(here: Scene, word: str) -> list[str]:
    running = here.live.operations.automatic.view().running
    return [one.stage for one in running if word in one.stage]


def test_a_true_loss_during_a_visit_is_a_loss() -> None:
    async def scene(here: Scene) -> None:
        operations = here.live.operations
        left_to_work(here)
        await until(here, lambda: any(_stages(here, "photograph 2 ")))
        # The boards lose their sun, and turn away by themselves.
        here.live.field.order("DEFOCUS")
        await until(here, lambda: bool(operations.automatic.waits), 30.0)
        assert "without an order" in operations.automatic.waits
        operations.automatic.switch(on=False)

    played(scene)


@pytest.mark.parametrize("stage", ["photographing", "LOCKED"])
def test_who_takes_command_lets_a_single_visit_end(stage: str) -> None:
    async def scene(here: Scene) -> None:
        plant, name = here.live.plant, here.names[0]
        aims = plant.aims.copy()
        whole = here.cycle.cycle
        visit = asyncio.create_task(whole.run(ENGINEER, here.token, name, "left", here.tell))
        if stage == "LOCKED":
            await reached(here, stage, visit)
        else:
            field, row = plant.field, plant.field.place(name)
            left = here.live.design.targets[0].center
            await until(here, lambda: np.linalg.norm(plant.aims[row] - left) < 1e-9)
            await until(here, lambda: field.rows["state"][row] == states.TRACKING)
        commanded(here, VERA)
        result = await visit
        assert result.outcome is CALIBRATED, result
        await until(here, lambda: set(here.states().values()) == {"TRACKING"})
        np.testing.assert_array_equal(plant.aims, aims)
        await kept(here)

    played(scene, count=2)


def test_a_locked_mirror_of_a_single_visit_that_is_stowed_ends_in_stow() -> None:
    async def scene(here: Scene) -> None:
        plant, (name, other) = here.live.plant, here.names
        whole = here.cycle.cycle
        visit = asyncio.create_task(whole.run(ENGINEER, here.token, name, "left", here.tell))
        await reached(here, "LOCKED", visit)
        ticket = plant.stow("Vera", (name,))
        with contextlib.suppress(RefusedError):
            await visit
        assert await ticket.end(200.0), ticket.text
        await until(here, lambda: here.states()[name] == "STOWED", 60.0)
        assert here.states()[other] == "TRACKING"
        await kept(here)

    played(scene, count=2)


def test_a_command_that_crosses_a_change_of_the_token_is_sent_again() -> None:
    async def scene(here: Scene) -> None:
        plant, name = here.live.plant, here.names[0]
        with plant.authority.mandate(ENGINEER, here.token, (name,), "left") as mandate:
            # The clusters hear of the new token a second later, and refuse what comes before.
            commanded(here, VERA)
            ticket = plant.command(ENGINEER, mandate.token, "IDLE", (name,))
            assert await ticket.end(60.0), ticket.text
            assert here.states()[name] == "IDLE"
            ticket = plant.command(ENGINEER, mandate.token, "TRACK", (name,))
            plant.seize_authority(ENGINEER, "back")
            assert await ticket.end(60.0), ticket.text
        token = plant.authority.token
        # A person's own command is not repeated: it was given before the change.
        ticket = plant.command(ENGINEER, token, "IDLE", (name,))
        plant.seize_authority(VERA, "again")
        await ticket.end(60.0)
        assert "authority" in ticket.refusals.get(name, "authority")

    played(scene, count=2)


def test_no_person_sends_a_beam_to_an_aim_with_parameters_that_are_not_verified() -> None:
    """Simulated run 7200006: TRACK came between the writing and the photograph."""

    async def scene(here: Scene) -> None:
        plant, name = here.live.plant, here.names[0]
        visit = asyncio.create_task(here.run())
        await reached(here, "verification: photograph 2", visit)
        token = commanded(here, VERA)
        await asyncio.sleep(3.0)
        target = here.live.design.targets[1].center
        with pytest.raises(BeamError, match="has yet to verify its new parameters"):
            plant.command(VERA, token, "TRACK", (name,))
        with pytest.raises(BeamError, match="has yet to verify its new parameters"):
            plant.aim(VERA, token, {name: target})
        plant.command(VERA, token, "JOG", (name,), (0, 400))
        await visit
        # Its local controller refuses the JOG and tracks on: the visit takes the beam off.
        await until(here, lambda: here.states()[name] in ("DEFOCUSED", "IDLE"), 60.0)
        plant.stow("Vera", (name,))
        await until(here, lambda: here.states()[name] == "STOWED")
        await kept(here)

    played(scene, installed=1.0, cycle=CycleSettings())


def test_a_loss_of_many_ends_the_visits_of_automatic_control() -> None:
    """Simulated run 7200013: a visit that had just begun sent a beam to its target after it."""

    async def scene(here: Scene) -> None:
        operations = here.live.operations
        left_to_work(here)
        await until(here, lambda: any(_stages(here, "photograph 2 ")))
        operations.automatic._losses._wait("many were lost")
        await until(here, lambda: not operations.automatic.view().running, 30.0)
        await asyncio.sleep(5.0)
        assert "TRACKING" not in {here.states()[name] for name in here.names}
        results = operations.automatic.view().results
        assert all("waits for Resume" in result.text for result in results), results
        operations.automatic.switch(on=False)

    played(scene)
