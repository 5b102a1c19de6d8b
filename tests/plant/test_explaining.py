"""One heliostat explained: why it tracks or does not, what is next, and what a person can do."""

import asyncio

import pytest

from heliotrope.errors import UnknownNameError
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.operations.views import Button
from heliotrope.plant.orders.authority import Person, Role
from support.live import LivePlant, live

ENGINEER, OPERATOR = Person("Egon", Role.ENGINEER), Person("Olga", Role.OPERATOR)


async def _cut(plant: LivePlant, cluster: str) -> None:
    """Take a cluster's link away for 20 s."""
    plant.links[cluster].plugged = False
    await asyncio.sleep(20.0)
    plant.links[cluster].plugged = True


async def _tracking(plant: LivePlant, *names: str) -> None:
    """Wait until heliostats track, and a moment more."""
    for _ in range(200):
        if all(plant.operations.viewer.heliostat(name).state == "TRACKING" for name in names):
            break
        await asyncio.sleep(1.0)
    await asyncio.sleep(5.0)


def test_each_reason_in_the_life_of_a_heliostat_has_its_sentence_and_button() -> None:
    async def work(plant: LivePlant) -> None:
        shown, (name, other, *_) = plant.operations, plant.operations.names
        shown.give_back(OPERATOR, (name,))
        first = shown.why(other)
        assert not first.tracks
        assert first.text == f"{other} is STOWED: it is not under automatic control"
        assert (first.button, first.order) == (Button.AUTOMATIC, None)
        await asyncio.sleep(20.0)
        going = f"{name} is APPROACHING: it is under automatic control, on its way to standby"
        assert shown.why(name).text == going
        await _tracking(plant, name)
        up = shown.why(name)
        assert up.tracks
        assert (up.text, up.button) == (f"{name} is TRACKING on receiver", Button.NONE)
        assert up.order is not None
        assert (up.order.who, up.order.what) == ("automatic control", "TRACK")
        assert up.order.text == "done"

        token = shown.take_authority(OPERATOR).token
        shown.command(OPERATOR, token, "LOCK", (name,))
        await asyncio.sleep(5.0)
        locked = shown.why(name)
        assert locked.text.startswith(f"{name} is LOCKED: "), locked.text
        assert locked.button is Button.UNLOCK
        assert locked.order is not None
        assert (locked.order.who, locked.order.what) == ("Olga", "LOCK")
        shown.command(OPERATOR, token, "UNLOCK", (name,))
        await asyncio.sleep(5.0)
        taken = shown.why(name)
        assert taken.button is Button.AUTOMATIC, "a person who locks it took it"

        shown.give_back(OPERATOR, (name,))
        held = shown.why(name)
        assert "is idle: Olga has the command authority" in held.text, held.text
        shown.hold(OPERATOR, (name,), "washing")
        out = shown.why(name)
        assert "it is out of service: washing (Olga" in out.text
        assert out.button is Button.RETURN_LOCK
        shown.unhold(OPERATOR, (name,))

        shown.emergency(OPERATOR, reason="smoke")
        await asyncio.sleep(2.0)
        emergency = shown.why(name)
        assert "an emergency is active (Olga: smoke)" in emergency.text, emergency.text
        assert emergency.button is Button.WITHDRAW
        assert emergency.remedy == "When the cause is gone, withdraw the order, then press Resume."
        shown.withdraw(OPERATOR)
        withdrawn = shown.why(name)
        assert withdrawn.button is Button.RESUME, "somebody has to acknowledge"
        assert withdrawn.remedy == "When the cause is gone, press Resume."
        await asyncio.sleep(3.0)
        shown.acknowledge(OPERATOR, "operator_emergency")
        await asyncio.sleep(3.0)
        over = shown.why(name)
        assert "an emergency has taken it out of automatic control" in over.text, over.text
        assert over.button is Button.RESUME

        plant.links["C1"].plugged = False
        await asyncio.sleep(15.0)
        silent = shown.why(name)
        assert silent.text.startswith(f"{name} is not heard for "), silent.text
        assert "its cluster C1 receives no reply from it" in silent.text
        with pytest.raises(UnknownNameError):
            shown.why("nobody")

    live(work, AutomaticSettings(calibrate=False))


def test_a_field_that_waits_for_a_person_says_so() -> None:
    async def work(plant: LivePlant) -> None:
        shown, name = plant.operations, plant.operations.names[-1]
        await _tracking(plant, *plant.names)
        await _cut(plant, "C2")
        await asyncio.sleep(30.0)
        why = shown.why(name)
        assert "left the receiver without an order" in why.text
        assert why.button is Button.RESUME
        shown.resume(OPERATOR)
        await asyncio.sleep(10.0)
        assert shown.why(name).button is Button.NONE

    live(work, AutomaticSettings(wanted=True, calibrate=False, margin=0.0), count=8)


def test_work_that_is_tried_again_is_shown_with_its_end() -> None:
    async def work(plant: LivePlant) -> None:
        shown, name = plant.operations, plant.operations.names[-1]
        await _tracking(plant, *plant.names)
        await _cut(plant, "C2")
        await asyncio.sleep(10.0)
        why = shown.why(name)
        assert "1 of 5 attempts have failed (left the receiver without an order)" in why.follows, (
            why
        )
        assert why.button is Button.NONE

    live(work, AutomaticSettings(wanted=True, calibrate=False, margin=0.0))
