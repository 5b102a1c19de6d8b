"""A beam on the receiver that nobody sent there is sent off, and no proof calls it off."""

from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from heliotrope.field.example import example_plant
from heliotrope.field.target import Receiver
from heliotrope.lcu import names, states
from heliotrope.lcu.config import Config
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Emergency
from heliotrope.mechanism.drives import Drive
from heliotrope.plant.controller import PlantController
from heliotrope.plant.emergency.sentinel import OFF_SHOWS
from heliotrope.plant.field.aims import BeamCheck
from heliotrope.plant.field.assigned import Points
from heliotrope.plant.field.state import FieldState
from heliotrope.plant.motion.paths import Paths
from heliotrope.plant.motion.stray_beams import StrayBeams
from heliotrope.safety import Act
from support.plant_bench import Bench, running

#: South of the tower, where P5A to P5C shine easily.
FURNACE = Receiver("furnace", "planar", (0.0, -12.0, 8.0), (0.0, -1.0, 0.0), 1.0, 1.0)  # type: ignore[arg-type]
DESIGN = replace(example_plant(), receivers=(FURNACE,))
ON, BESIDE = (0.0, -12.0, 8.0), (-8.0, 0.0, 8.0)
LIT = [
    state
    for state in range(len(states.STATES))
    if states.STATES[state] not in ("TRACKING", "SEARCHING")
]
AT_STOW = 1 << names.FLAGS.index("AT_STOW")
SUN = np.array([0.3, 0.4, 0.866]) / np.linalg.norm([0.3, 0.4, 0.866])
Point = tuple[float, float, float]


def play(folder: Path, scene: Callable[[Bench], Awaitable[None]]) -> Bench:
    """Run a scene in virtual time."""
    made: list[Bench] = []

    async def main(clock: VirtualClock) -> None:
        made.append(Bench(clock, folder, design=DESIGN))
        async with running(made[0]):
            await scene(made[0])

    run_virtual(main)
    return made[0]


def put(bench: Bench, name: str, state: int, at: Point, end: Point | None = None) -> None:
    """Let a heliostat report that its beam is at a point, and goes to another."""
    cluster, plant = bench.cluster_of(name), bench.plant
    cluster.set(state, name)
    row, rows = cluster.names.index(name), np.array([plant.field.place(name)])
    for what, point in (("", at), ("_goal", at if end is None else end)):
        found = plant.beams.poses(rows, np.array([point]), plant.sun_vector())
        steps = found.best_counts[0].round()
        for axis, value in zip(("primary", "secondary"), steps, strict=True):
            cluster.rows[axis + what][row] = value


def alarmed(plant: PlantController) -> set[str]:
    """The heliostats whose alarm has not ended."""
    last = {a.subject: a.active for a in plant.alarms if a.condition == "beam_unsent"}
    return {name for name, active in last.items() if active}


@pytest.mark.parametrize("state", LIT, ids=[states.STATES[state] for state in LIT])
def test_a_beam_left_on_the_receiver_is_sent_off_in_every_state(state: int, tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        bench.cluster_of("P5A").deaf.add("P5A")
        put(bench, "P5A", state, ON)
        await bench.wait(12.0)
        assert alarmed(bench.plant) == {"P5A"}
        await bench.wait(20.0)
        assert alarmed(bench.plant) == {"P5A"}
        put(bench, "P5A", states.STOWED, BESIDE)
        await bench.wait(8.0)
        assert alarmed(bench.plant) == set()
        sent = len(bench.cluster_of("P5A").of(Emergency))
        await bench.wait(70.0)
        assert len(bench.cluster_of("P5A").of(Emergency)) == sent

    sent = play(tmp_path, scene).cluster_of("P5A").of(Emergency)
    assert {m.heliostats for m in sent} == {("P5A",)}
    # DEFOCUS turns nothing that has turned away already.
    turned = state in (states.DEFOCUSED, states.STOWING)
    assert sent[0].name == ("STOW" if turned else "DEFOCUS")
    assert sent[-1].name == "STOW"


def test_a_mirror_that_a_person_has_just_sent_off_has_the_time_to_show_it(tmp_path: Path) -> None:
    """The table orders it off once that time is over, and its beam is still there."""

    async def scene(bench: Bench) -> None:
        cluster = bench.cluster_of("P5A")
        cluster.deaf.add("P5A")
        put(bench, "P5A", states.LOCKED, ON)
        await bench.wait(2.0)
        first = bench.plant.defocus("Olga", ("P5A",)).identity

        def orders() -> set[str]:
            sent = cluster.of(Emergency)
            return {m.identity.rpartition(".")[0] for m in sent if "P5A" in m.heliostats}

        await bench.wait(OFF_SHOWS - 1.0)
        assert alarmed(bench.plant) == {"P5A"}
        assert orders() == {first}
        await bench.wait(2.0)
        assert len(orders()) == 2

    play(tmp_path, scene)


def test_each_mirror_that_stands_is_checked_in_turn(tmp_path: Path) -> None:
    names = ("P5A", "P5B", "P5C")

    async def scene(bench: Bench) -> None:
        for name in names:
            bench.cluster_of(name).deaf.add(name)
            put(bench, name, states.LOCKED, ON)
        await bench.wait(12.0)
        assert alarmed(bench.plant) == set(names)

    play(tmp_path, scene)


@pytest.mark.parametrize("way", [-1.0, 1.0], ids=["west", "east"])
def test_a_beam_that_was_sent_there_or_comes_off_is_left_in_peace(
    way: float, tmp_path: Path
) -> None:
    async def scene(bench: Bench) -> None:
        put(bench, "P5A", states.TRACKING, ON)
        put(bench, "P5B", states.SEARCHING, ON)
        # P4A crosses the receiver slowly, on its way to a place beside it.
        for tick in range(20):
            at, end = way * (0.04 * tick - 0.4), (way * 8.0, 0.0, 8.0)
            put(bench, "P4A", states.IDLE, (at, -12.0, 8.0), end)
            await bench.wait(1.0)
        assert not alarmed(bench.plant)
        # It stops there.
        await bench.wait(12.0)
        assert alarmed(bench.plant) == {"P4A"}

    play(tmp_path, scene)


@pytest.mark.parametrize("state", [states.STOWED, states.LOCKED, states.FAULT])
@pytest.mark.parametrize("act", [Act.DEFOCUS, Act.STOW])
def test_a_wrong_stow_position_proves_nothing(act: Act, state: int, tmp_path: Path) -> None:
    """A board that is at the stow position which it stores says so, wherever its beam is."""

    async def scene(bench: Bench) -> None:
        plant, cluster = bench.plant, bench.cluster_of("P5A")
        for name in plant.field.names:
            put(bench, name, states.STOWED, BESIDE)
        put(bench, "P5A", state, ON)
        cluster.rows["flags"][cluster.names.index("P5A")] = AT_STOW
        await bench.wait(2.0)
        order = plant.raise_emergency("Vera", act)
        for _ in range(20):
            cluster.set(state, "P5A")
            await bench.wait(0.5)
        report = order.report(plant.now())
        assert report.not_done == ("P5A",)
        assert not report.complete
        assert f"P5A: it reports {states.STATES[state]}, but by its step counts" in report.text
        # It is an alarm without an emergency as well.
        assert alarmed(plant) == {"P5A"}
        put(bench, "P5A", states.STOWED, BESIDE)
        await bench.wait(8.0)
        assert order.report(plant.now()).complete
        assert alarmed(plant) == set()

    play(tmp_path, scene)


def test_step_counts_from_before_an_order_prove_no_stow(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant, name = bench.plant, "P5A"
        put(bench, name, states.STOWED, BESIDE)
        cluster = bench.cluster_of(name)
        await bench.wait(3.0)
        cluster.untold.add(name)
        await bench.wait(2.5)
        order = plant.raise_emergency("Vera", Act.STOW)
        await bench.wait(10.0)
        assert name in order.report(plant.now()).not_done
        cluster.untold.clear()
        await bench.wait(3.0)
        assert order.is_done(name)

    play(tmp_path, scene)


def test_no_defocus_is_proven_while_the_beam_is_on_the_receiver(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant, cluster = bench.plant, bench.cluster_of("P5A")
        for name in plant.field.names:
            put(bench, name, states.DEFOCUSED, BESIDE)
        # The status before the order shows it beside; it turns onto the receiver.
        await bench.wait(2.0)
        order = plant.raise_emergency("Vera")
        put(bench, "P5A", states.DEFOCUSED, ON)
        await bench.wait(4.0)
        assert cluster.of(Emergency)
        assert order.report(plant.now()).not_done == ("P5A",)
        assert not order.unacknowledged(("P5A",))
        put(bench, "P5A", states.STOWING, BESIDE)
        await bench.wait(8.0)
        assert order.report(plant.now()).not_done == ()

    play(tmp_path, scene)


@pytest.mark.parametrize(("share", "act"), [(1.0, Act.STOW), (0.0, Act.DEFOCUS)])
def test_stow_is_ordered_where_defocus_ends_on_the_receiver(share: float, act: Act) -> None:
    check = BeamCheck(DESIGN, DESIGN.names)
    field = FieldState({"C1": DESIGN.names})
    row = np.array([field.index["P5A"]])
    found = check.poses(row, np.array([ON]), SUN)
    begin = found.best_angles[0] - share * np.array(Config().defocus)
    counts = Drive(check.drives.table[row[0]]).counts(begin).round()
    field.rows["primary"][row], field.rows["secondary"][row] = counts
    field.rows["state"][row] = states.LOCKED
    points = Points(field.names, None)
    check.machines.clear()
    stray = StrayBeams(Paths(check), field, points, lambda _: SUN)
    assert stray.order_out("P5A", again=False) is act
    assert stray.order_out("P5A", again=True) is Act.STOW
    # It has turned since it was locked: DEFOCUS turns it no further.
    field.turned[row] = True
    assert stray.order_out("P5A", again=False) is Act.STOW
    field.turned[row] = False
    # Held beside its aim on the receiver, it turns away from that.
    points.aims[row], points.standbys[row] = ON, BESIDE
    assert stray.order_out("P5A", again=False) is Act.DEFOCUS


def test_step_counts_from_before_an_order_prove_no_defocus(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant, name = bench.plant, "P5A"
        put(bench, name, states.IDLE, BESIDE)
        await bench.wait(3.0)
        cluster = bench.cluster_of(name)
        cluster.untold.add(name)
        await bench.wait(2.5)
        order = plant.raise_emergency("Vera", Act.DEFOCUS)
        await bench.wait(0.3)
        # DEFOCUS turns it onto the receiver, which nobody hears.
        put(bench, name, states.DEFOCUSED, ON)
        await bench.wait(20.0)
        assert not order.is_done(name)
        assert order.report(plant.now()).not_done == (name,)
        cluster.untold.clear()
        put(bench, name, states.DEFOCUSED, BESIDE)
        await bench.wait(5.0)
        assert order.is_done(name)

    play(tmp_path, scene)
