"""Operations of persons end with their results, and say what they wait for meanwhile."""

import asyncio
from collections.abc import Callable
from datetime import UTC, datetime

import pytest

from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Stage
from heliotrope.plant.operations import operations
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.operations.errands import Errands, Step
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.plant.orders.tickets import Ticket
from support.live import LivePlant, live

ENGINEER, OPERATOR = Person("Egon", Role.ENGINEER), Person("Olga", Role.OPERATOR)
#: Half a minute before the sun is too low.
EVENING = datetime(2026, 10, 21, 16, 6, 50, tzinfo=UTC)
BY_HAND = AutomaticSettings(wanted=True, calibrate=False, margin=0.0)
WORK = AutomaticSettings(wanted=True)


async def followed(ticket: Ticket, limit: float = 900.0) -> list[str]:
    """Return what a ticket says from one second to the next, until it has ended."""
    said = [ticket.text]
    for _ in range(int(limit)):
        if ticket.finished:
            return said
        await asyncio.sleep(1.0)
        if said[-1] != ticket.text:
            said.append(ticket.text)
    raise AssertionError(f"not finished within {limit} s: {said[-5:]}")


async def until(condition: Callable[[], bool], limit: float = 600.0) -> None:
    for _ in range(int(limit)):
        if condition():
            return
        await asyncio.sleep(1.0)
    raise AssertionError(f"not within {limit} s")


def test_a_calibration_ends_with_its_result_and_says_what_it_waits_for() -> None:
    async def work(plant: LivePlant) -> None:
        shown, name = plant.operations, plant.names[0]
        await until(lambda: shown.automatic.view().on)
        ticket = shown.calibrate(OPERATOR, name)
        assert not ticket.finished
        assert ticket.steps[name].startswith("it is waiting: "), ticket
        said = await followed(ticket)
        assert any(f"{name}: at " in text and "photograph" in text for text in said), said
        assert ticket.good, said
        assert "calibrated: beam error " in ticket.text
        assert plant.plant.beliefs.record(name) is not None

    live(work, WORK)


@pytest.mark.parametrize(
    ("act", "reason"),
    [
        (
            lambda shown, name: shown.stow(OPERATOR, (name,)),
            "an operator has taken it out of automatic control",
        ),
        (
            lambda shown, name: shown.hold(OPERATOR, (name,), "x"),
            "Olga took it out of service",
        ),
    ],
    ids=["stowed", "out of service"],
)
def test_a_calibration_that_cannot_be_made_any_more_is_refused(
    act: Callable[..., object], reason: str
) -> None:
    async def work(plant: LivePlant) -> None:
        shown, name = plant.operations, plant.names[-1]
        await until(lambda: shown.automatic.view().on)
        ticket = shown.calibrate(OPERATOR, name)
        act(shown, name)
        await followed(ticket, 120.0)
        assert ticket.stage(name) is Stage.REFUSED
        assert ticket.refusals[name].startswith(f"withdrawn: {reason}")
        assert shown.automatic.view().asked == ()

    live(work, WORK)


def test_out_of_service_is_done_when_it_is_parked_and_names_who_is_not() -> None:
    async def work(plant: LivePlant) -> None:
        shown, names = plant.operations, plant.names[:2]
        await until(lambda: shown.viewer.heliostat(names[1]).state == "TRACKING")
        ticket = shown.hold(OPERATOR, names, "washing")
        assert ticket.counted() == {"acknowledged": 2}
        assert ticket.steps[names[0]] == "on its way to stow: TRACKING"
        assert names[0] in ticket.text
        said = await followed(ticket)
        assert ticket.good
        assert any("on its way to stow: STOWING" in text for text in said), said
        assert "parked in stow and locked out" in ticket.text
        assert [shown.viewer.heliostat(name).state for name in names] == ["STOWED", "STOWED"]
        shown.unhold(OPERATOR, names)
        again = shown.hold(OPERATOR, names[:1], "washing")
        shown.unhold(OPERATOR, names[:1])
        await followed(again, 5.0)
        assert again.refusals == {names[0]: "it was returned to service"}

    live(work, BY_HAND)


def test_a_lock_on_a_target_parks_what_gets_its_aim_back_on_the_way_to_stow() -> None:
    """The visit that was on the target ends, and its members are aimed at the receiver again."""

    async def work(plant: LivePlant) -> None:
        shown, (first, second, third, _) = plant.operations, plant.names
        await until(lambda: all(shown.viewer.heliostat(n).state == "TRACKING" for n in plant.names))
        token = shown.take_authority(ENGINEER).token
        shown.aim_at(ENGINEER, token, (first, second), "left")
        await asyncio.sleep(6.0)
        shown.plant.authority.keep(ENGINEER, token)
        ticket = shown.hold(OPERATOR, (), "paint target", targets=("left",))
        assert ticket.heliostats == (first, second)
        await asyncio.sleep(3.0)
        shown.aim_at(ENGINEER, token, (first, second), "receiver")
        await asyncio.sleep(3.0)
        shown.release_authority(ENGINEER, token)
        assert not ticket.finished
        # Another lock that comes and goes is not theirs.
        shown.hold(OPERATOR, (third,), "washing")
        shown.unhold(OPERATOR, (third,))
        said = await followed(ticket, 200.0)
        assert ticket.good, said
        assert "parked in stow; it may be raised again because" in ticket.text
        # The lock stands, and they go back to work at the receiver.
        assert [lock.name for lock in shown.automatic.service.out] == ["left"]
        await until(lambda: shown.viewer.heliostat(first).state == "TRACKING")

    live(work, BY_HAND)


@pytest.mark.parametrize("place", ["heliostat", "tower"])
def test_a_calibration_waits_for_the_start_and_names_the_lock(place: str) -> None:
    async def work(plant: LivePlant) -> None:
        shown, name = plant.operations, plant.names[0]
        await until(lambda: shown.automatic.view().on)
        shown.release_authority(ENGINEER, shown.take_authority(ENGINEER).token)
        ticket = shown.calibrate(OPERATOR, name)
        assert ticket.steps[name] == "it is waiting: it is starting"
        heliostats = (name,) if place == "heliostat" else ()
        shown.hold(OPERATOR, heliostats, "washing", tower=place == "tower")
        reason = "out of service" if place == "heliostat" else "the tower is locked"
        text = rf"^calibration of {name}: {reason}: washing \(Olga, since .* UTC\)"
        with pytest.raises(RefusedError, match=text):
            shown.calibrate(OPERATOR, name)

    live(work, WORK)


def test_one_that_does_not_come_to_stow_is_named_with_an_alarm_and_the_ticket_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(operations, "_PARKED", 330.0)

    async def work(plant: LivePlant) -> None:
        shown, name = plant.operations, plant.names[0]
        await until(lambda: shown.viewer.heliostat(name).state == "TRACKING")
        plant.links["C1"].plugged = False
        await asyncio.sleep(5.0)
        ticket = shown.hold(OPERATOR, (name,), "washing")
        await asyncio.sleep(60.0)
        assert ticket.steps[name].startswith("on its way to stow: not heard for ")
        (retry,) = (one for one in shown.automatic.retries() if one.subject == name)
        assert retry.work == "stow of a heliostat out of service"
        await followed(ticket)
        assert ticket.refusals[name].startswith(
            "not finished within 330 s: on its way to stow: not h"
        )
        found = [a for a in shown.logbook.alarms() if a.condition == "not_parked" and a.active]
        assert [alarm.subject for alarm in found] == [name]
        plant.links["C1"].plugged = True
        await until(lambda: shown.viewer.heliostat(name).state == "STOWED")
        await asyncio.sleep(20.0)
        assert not [a for a in shown.logbook.alarms() if a.condition == "not_parked" and a.active]

    live(work, BY_HAND)


def test_automatic_is_done_where_it_follows_and_says_why_where_it_does_not() -> None:
    async def work(plant: LivePlant) -> None:
        shown = plant.operations
        first, second, third, fourth = plant.names
        await until(lambda: shown.viewer.heliostat(first).state == "TRACKING")
        shown.hold(OPERATOR, (second,), "washing")
        token = shown.take_authority(ENGINEER).token
        await asyncio.sleep(3.0)
        shown.command(ENGINEER, token, "LOCK", (third,))
        shown.stow(OPERATOR, (fourth,))
        held = shown.give_back(OPERATOR, (first,))
        assert held.finished
        assert held.refusals[first].endswith("is idle: Egon has the command authority")
        await asyncio.sleep(5.0)
        shown.release_authority(ENGINEER, token)
        ticket = shown.give_back(OPERATOR)
        assert ticket.refusals[second].startswith("out of service: washing (Olga, ")
        assert ticket.steps[fourth] == "it is starting"
        await followed(ticket)
        assert ticket.stage(first) is Stage.DONE
        assert ticket.stage(fourth) is Stage.DONE
        assert shown.viewer.heliostat(fourth).state in ("APPROACHING", "IDLE", "TRACKING")
        assert ticket.refusals[third] == "it is LOCKED: unlock it"

    live(work, BY_HAND)


def test_automatic_at_dusk_and_in_an_emergency_says_that_nothing_follows() -> None:
    async def work(plant: LivePlant) -> None:
        shown = plant.operations
        await until(lambda: shown.automatic.view().on)
        asked = shown.calibrate(OPERATOR, plant.names[0])
        await until(lambda: shown.automatic.view().reason == "the sun is too low")
        await followed(asked, 30.0)
        assert asked.refusals == {
            plant.names[0]: "withdrawn: the sun is too low; repeat the request tomorrow"
        }
        ticket = shown.give_back(OPERATOR)
        assert ticket.finished
        assert ticket.refusals[plant.names[0]].endswith("is idle: the sun is too low")
        shown.emergency(OPERATOR, "STOW", "smoke")
        ticket = shown.give_back(OPERATOR)
        assert "is idle: an emergency is active" in ticket.text

    live(work, WORK, start=EVENING)


def test_an_operation_ends_at_its_limit_and_with_the_program() -> None:
    async def main(clock: VirtualClock) -> None:
        errands, dropped = Errands(clock), list[tuple[object, str]]()
        slow = errands.begin(
            "CALIBRATE",
            ("A", "B"),
            lambda names: {n: Step("it waits", Stage.DONE if n == "B" else None) for n in names},
            10.0,
            lambda names, why: dropped.append((names, why)),
        )
        other = errands.begin(
            "AUTOMATIC", ("C",), lambda names: {n: Step("x") for n in names}, 60.0
        )
        assert slow.counted() == {"waiting": 1, "done": 1}
        await asyncio.sleep(10.0)
        errands.look()
        assert slow.refusals == {"A": "not finished within 10 s: it waits"}
        assert dropped == [(("A",), "not started within 10 s")]
        errands.end("the plant's program has ended")
        assert other.refusals == {"C": "the plant's program has ended"}

    run_virtual(main)
