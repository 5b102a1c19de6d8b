"""Fine steps for a visit: Malan's prototype, whose drivers rest, so that it steps roughly."""

import asyncio
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from heliotrope.field.example import roughly_installed
from heliotrope.field.plant import Plant
from heliotrope.field.stellenbosch import prototype
from heliotrope.lcu import names as meanings
from heliotrope.mechanism.drives import SLOTS
from heliotrope.mechanism.machine import Machine
from heliotrope.mechanism.machine import Stepping as Stepped
from heliotrope.plant.field.ledger import Ledger
from heliotrope.plant.field.state import FieldState
from heliotrope.plant.orders.stepping import Stepping
from heliotrope.twin.live.boards import BoardField
from support.live import LiveOptions, LivePlant, play
from support.visit_scene import ENGINEER

MRAD = 1e-3
ROUGH = 1 << meanings.FLAGS.index("ROUGH")
NAMES = ("A", "B", "C")
OPTIONS = LiveOptions(rendered=False, threads=0, boards=True, together=True)


class Field(FieldState):
    """Three heliostats, of which A and B step roughly, heard now and then."""

    def __init__(self) -> None:
        super().__init__({"c": NAMES})
        self.rows["flags"] = [ROUGH, ROUGH, 0]
        self.ledger = Ledger(self)

    def hear(self, now: float, **rough: bool) -> None:
        """Hear all at a time, and some step otherwise since."""
        for name, flag in rough.items():
            self.rows["flags"][self.index[name]] = ROUGH * flag
        self.heard[:] = now


def order(field: Field, modes: Stepping, names: tuple[str, ...], now: float) -> None:
    """Give heliostats the order that was due."""
    modes.tried(names, now)
    field.ledger.sent("ROUGH", names, now)


def test_rough_steps_are_left_for_a_visit_and_come_back_after_the_last_one() -> None:
    field = Field()
    modes = Stepping(field, field.ledger, ())
    with ExitStack() as first, ExitStack() as second:
        first.enter_context(modes.fine(NAMES))
        assert modes.due(0.0, 7) == {}, "nothing is known of them yet"
        assert modes.coarse(NAMES, 0.0) == NAMES
        field.hear(1.0)
        assert modes.due(1.0, 0) == {}, "nobody has the command authority"
        assert modes.due(1.0, 7) == {False: ("A", "B")}
        assert modes.coarse(NAMES, 1.0) == ("A", "B")
        order(field, modes, ("A", "B"), 1.0)
        field.hear(1.5, A=False)
        assert modes.coarse(NAMES, 1.5) == ("A", "B"), "it may be from before the order"
        field.hear(2.5)
        assert modes.coarse(NAMES, 2.5) == ("B",)
        assert modes.due(3.9, 7) == {}
        assert modes.due(4.0, 7) == {False: ("B",)}, "it did not obey"
        order(field, modes, ("B",), 4.0)
        field.hear(6.0, B=False)
        second.enter_context(modes.fine(("B",)))
        first.close()
        assert modes.due(6.0, 7) == {True: ("A",)}, "another visit needs B"
        order(field, modes, ("A",), 6.0)
        second.close()
        assert modes.due(7.5, 7) == {True: ("B",)}
        order(field, modes, ("B",), 7.5)
        field.hear(10.0, A=True, B=True)
        assert modes.due(10.0, 7) == {}
    # One that a person lets step finely later is left so.
    field.hear(20.0, A=False)
    assert modes.due(20.0, 7) == {}


def test_one_that_restarts_in_a_visit_takes_fine_steps_again() -> None:
    field = Field()
    modes = Stepping(field, field.ledger, ())
    with modes.fine(("C",)):
        field.hear(1.0)
        assert modes.due(1.0, 7) == {}
        field.hear(2.0, C=True)
        assert modes.due(2.0, 7) == {False: ("C",)}
        order(field, modes, ("C",), 2.0)
        field.hear(4.0, C=False)
        assert modes.due(4.0, 7) == {}
    assert modes.due(5.0, 7) == {True: ("C",)}


def test_what_a_person_orders_during_a_visit_holds_after_it() -> None:
    field = Field()
    modes = Stepping(field, field.ledger, ())
    with modes.fine(("A", "C")):
        field.hear(1.0)
        assert modes.due(1.0, 7) == {False: ("A",)}
        order(field, modes, ("A",), 1.0)
        modes.ordered(("A",), rough=False)
        modes.ordered(("C",), rough=True)
        field.hear(4.0, A=False)
    assert modes.due(4.0, 7) == {True: ("C",)}


def test_a_report_from_before_a_person_s_order_settles_nothing() -> None:
    """It showed fine steps, so the plant ordered no rough ones after the board had obeyed."""
    field = Field()
    modes = Stepping(field, field.ledger, ("C",))
    field.hear(1.0, C=True)
    with modes.fine(("C",)):
        order(field, modes, ("C",), 1.0)
        field.hear(3.0, C=False)
        assert modes.coarse(("C",), 3.0) == ()
        field.ledger.sent("ROUGH", ("C",), 3.0)
        assert modes.coarse(("C",), 3.1) == ("C",), "a person has just ordered other steps"
        field.hear(3.5)
        assert modes.due(3.5, 7) == {}
        field.hear(4.5, C=True)
        assert modes.due(4.5, 7) == {False: ("C",)}


def test_drivers_that_rest_are_not_left_on_by_an_earlier_run() -> None:
    field = Field()
    modes = Stepping(field, field.ledger, ("B", "C"))
    assert modes.due(0.0, 7) == {}
    field.hear(1.0)
    assert modes.due(1.0, 7) == {True: ("C",)}
    order(field, modes, ("C",), 1.0)
    field.hear(3.0, C=True)
    assert modes.due(3.0, 7) == {}
    # From now on it is a person's matter.
    field.hear(9.0, B=False, C=False)
    assert modes.due(9.0, 7) == {}


def rough(plant: LivePlant) -> list[bool]:
    """Return whether each board steps roughly, in truth."""
    assert isinstance(plant.field, BoardField)
    nodes = [board.node for board in plant.field.boards]
    return [node is not None and bool(node.controller.motion.rough) for node in nodes]


async def until(plant: LivePlant, true: Callable[[], bool], limit: float) -> None:
    """Wait until something is true."""
    end = plant.clock.monotonic() + limit
    while not true():
        assert plant.clock.monotonic() < end, plant.operations.logbook.events(20)
        await asyncio.sleep(0.5)


def photographing(plant: LivePlant) -> bool:
    """Return whether a visit takes its photographs."""
    running = plant.operations.automatic.view().running
    return any(entry.stage.startswith("photograph") for entry in running)


def calibrated(plant: LivePlant) -> set[str]:
    """Return the heliostats with a new calibration."""
    return {entry.heliostat for entry in plant.operations.automatic.view().results if entry.good}


def precise(plant: LivePlant) -> int:
    """Return how many mirrors are within 0.6 mrad of where they must be, in truth."""
    return int((plant.errors() < 0.6 * MRAD).sum())


def test_the_prototype_is_calibrated_jointly_though_its_full_steps_are_coarse() -> None:
    """A full step of its worm is 1.05 mrad, and a verification moves by 0.5 mrad of the beam.

    The 18 beams miss by 30 mrad in the mean, 1.2 m on a target of 2 m, so that some lie half
    beside it: here two do, which must not spoil the proof of the others.
    """

    async def work(plant: LivePlant) -> None:
        await until(plant, lambda: photographing(plant), 120.0)
        assert not any(rough(plant)[:12]), "visits take fine steps"
        await until(plant, lambda: len(calibrated(plant)) >= 14, 150.0)
        await until(plant, lambda: precise(plant) >= 10, 60.0)
        assert any(rough(plant)), "they step roughly again where no visit needs them"

    play(work, prototype(), replace(OPTIONS, seed=3))


def few(coarse: int = 0) -> Plant:
    """Return the first structure of the prototype, some with drives of four times the step."""
    design = prototype()
    group = design.groups["azel"].take(np.arange(6))
    factor = np.where(np.arange(6) < coarse, 4, 1)
    drives = group.mechanism.drives
    rate = drives.table[..., SLOTS["rate"]] * factor[:, None]
    speed = drives.table[..., SLOTS["speed"]] / factor[:, None]
    mechanism = replace(group.mechanism, drives=drives.replace(rate=rate, speed=speed))
    machines = tuple(
        geared(machine, int(each)) for machine, each in zip(group.machines, factor, strict=True)
    )
    return replace(design, groups={"azel": replace(group, mechanism=mechanism, machines=machines)})


def geared(machine: Machine, factor: int) -> Machine:
    """Return a machine table for steps that are larger by a factor."""
    axes = [
        replace(
            axis,
            low=-(-axis.low // factor),
            high=axis.high // factor,
            rate=axis.rate // factor,
            acceleration=axis.acceleration // factor,
        )
        for axis in machine.axes
    ]
    stepping = Stepped((8 // factor, 8 // factor), rests=True)
    return replace(machine, axes=(axes[0], axes[1]), stepping=stepping)


def test_mirrors_of_unlike_resolution_are_calibrated_in_one_visit() -> None:
    """Half of them have 0.52 mrad to a step, 1 mrad of the beam; a verification moves by 0.5."""

    async def work(plant: LivePlant) -> None:
        await until(plant, lambda: len(calibrated(plant)) == 6, 240.0)
        good = [entry.at for entry in plant.operations.automatic.view().results if entry.good]
        assert np.ptp(good) < 10.0, "one visit calibrates all"
        await until(plant, lambda: precise(plant) >= 4, 60.0)

    play(work, few(coarse=3), replace(OPTIONS, installed=partial(roughly_installed, scale=0.5)))


@pytest.mark.parametrize("out", ["emergency", "another's command", "halt"])
def test_drivers_rest_again_however_a_visit_ends(out: str) -> None:
    """The plant gives rough steps back, under whoever has the command authority."""

    async def work(live: LivePlant) -> None:
        plant = live.plant
        await until(live, lambda: photographing(live), 120.0)
        assert not any(rough(live))
        if out == "halt":
            await live.operations.automatic.halt()
        elif out == "emergency":
            plant.raise_emergency("Egon")
            await asyncio.sleep(20.0)
            assert not any(rough(live)), "rough steps move a mirror: not in an emergency"
            plant.withdraw_emergency(ENGINEER, "Egon")
            await asyncio.sleep(4.0)
            plant.acknowledge(ENGINEER, "operator_emergency")
        token = plant.seize_authority(ENGINEER, "a test").token
        if out == "another's command":
            plant.command(ENGINEER, token, "IDLE", plant.field.names)
        await until(live, lambda: all(rough(live)), 15.0)

    play(work, few(), OPTIONS)
