"""Emergencies of the plant: order, proof, repetition, causes, hysteresis, release."""

import math
import re
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import NODE, Acknowledge, Emergency
from heliotrope.mechanism.drives import Drive, rotary
from heliotrope.plant.emergency import UNPROVEN, EmergencyOrder, carried_out
from heliotrope.plant.operations.given_readings import GivenReadings
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.orders.audit import read
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.plant.settings import PlantSettings
from heliotrope.safety import FLUX_READING, Act, FluxProof, conditions, limited
from heliotrope.twin.wind import Wind
from support.plant_bench import ENGINEER, LEADS, OPERATOR, VIEWER, Bench, running

Play = Callable[[Bench], Awaitable[None]]
WINDY = PlantSettings(sensors=frozenset({"wind_gust", "receiver_flux", FLUX_READING}))
MEASURED = PlantSettings(sensors=frozenset({FLUX_READING}))


def play(folder: Path, scene: Play, seed: int = 0, **options: Any) -> Bench:
    """Run a scene in virtual time, the field tracking at its begin."""
    made: list[Bench] = []

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, folder, **options)
        made.append(bench)
        for cluster in bench.clusters.values():
            cluster.set(states.TRACKING)
        async with running(bench):
            await scene(bench)

    run_virtual(main, seed)
    return made[0]


def orders(bench: Bench, cluster: str = "pod-1") -> list[tuple[str, tuple[str, ...]]]:
    """Emergencies that a cluster was sent."""
    return [(m.name, m.heliostats) for m in bench.clusters[cluster].of(Emergency)]


async def feed(bench: Bench, seconds: float, **readings: float) -> None:
    """Give sensors' readings once a second."""
    for _ in range(round(seconds)):
        for name, value in readings.items():
            bench.plant.put(name, value)
        await bench.wait(1.0)


def test_an_order_is_proven_or_the_nodes_are_named(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        bench.cluster_of("P3B").deaf.add("P3B")
        order = plant.raise_emergency("a visitor", reason="smoke")
        await bench.wait(0.5)
        assert bench.count(states.DEFOCUSED) == 17
        early = order.report(plant.now())
        assert early.unacknowledged == ("P3B",)
        assert early.flux is FluxProof.AWAITED
        plant.put(FLUX_READING, 0.04)
        assert order.report(plant.now()).flux is FluxProof.BELOW
        await bench.wait(1.0)
        # The status after the order shows where the beams went.
        assert order.report(plant.now()).not_done == ("P3B",)
        assert order.report(plant.now()).late == ("P3B",)
        assert "1 not acknowledged: P3B" in order.report(plant.now()).text
        bench.cluster_of("P3B").deaf.clear()
        await bench.wait(2.5)
        plant.put(FLUX_READING, 0.04)
        assert order.report(plant.now()).complete
        assert order.report(plant.now()).text.startswith(
            "every heliostat has acknowledged and reports that it is done"
        )
        # What nobody lifts goes on to stow.
        await bench.wait(35.0)
        assert bench.count(states.STOWED) == 18
        assert plant.sentinel.order is not order
        assert plant.sentinel.order is not None
        assert plant.sentinel.order.act is Act.STOW
        assert plant.sentinel.order.report(plant.now()).not_done == ()

    bench = play(tmp_path, scene, settings=MEASURED)
    assert orders(bench) == [("DEFOCUS", ()), ("STOW", ())]
    # It was repeated to the one that was silent, and to no other.
    repeated = orders(bench, "pod-3")
    assert repeated[0] == ("DEFOCUS", ())
    assert set(repeated[1:-1]) == {("DEFOCUS", ("P3B",))}
    records, _ = read(bench.audit.path)
    assert (records[0].who, records[0].what, records[0].note) == ("a visitor", "DEFOCUS", "smoke")


def test_the_order_ends_for_one_that_is_seen_at_stow_although_it_did_not_answer(
    tmp_path: Path,
) -> None:
    async def scene(bench: Bench) -> None:
        plant, cluster = bench.plant, bench.cluster_of("P3B")
        cluster.deaf.add("P3B")
        order = plant.raise_emergency("Olga", Act.STOW)
        await bench.wait(2.0)
        assert order.ticket.waiting(plant.field.names) == ("P3B",)
        cluster.set(states.STOWED, "P3B")
        await bench.wait(2.0)
        assert order.ticket.text == "STOW: 18 done"

    play(tmp_path, scene)


def test_where_nobody_measures_the_flux_the_proof_rests_on_the_mirrors(tmp_path: Path) -> None:
    """No row about a value that nobody measures trips or latches."""

    async def scene(bench: Bench) -> None:
        plant = bench.plant
        assert "flux_after_emergency" in plant.sentinel.table.unwatched
        order = plant.raise_emergency("Olga", Act.STOW)
        early = order.report(plant.now())
        assert (early.flux, early.complete) == (FluxProof.NOT_MEASURED, False)
        await bench.wait(45.0)
        report = order.report(plant.now())
        assert report.complete
        assert report.text == (
            "every heliostat has acknowledged and reports that it is done; the flux on the "
            "receiver is not measured, so this is not proven, because a stalled drive reports the "
            "same; 18 by reports alone: "
            "P1A, P1B, P1C, P2A, P2B, P2C, P3A, P3B, …"
        )
        assert plant.sentinel.order is order
        told = {alarm.condition for alarm in plant.alarms}
        assert told == {"operator_emergency", "authority_lost"}
        with pytest.raises(UnknownNameError, match="sensor"):
            plant.put(FLUX_READING, 0.0)
        plant.withdraw_emergency(OPERATOR)
        await bench.wait(4.0)
        plant.acknowledge(OPERATOR, "operator_emergency")
        token = await bench.commanded()
        assert not plant.sentinel.on
        assert plant.command(OPERATOR, token, "APPROACH", ("P2B",))

    play(tmp_path, scene)


@pytest.mark.parametrize("share", [0.3, None], ids=["light", "a silent sensor"])
def test_a_sensor_of_the_flux_counts_also_when_it_is_silent(
    tmp_path: Path, share: float | None
) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        assert "flux_after_emergency" not in plant.sentinel.table.unwatched
        order = plant.raise_emergency("Olga", Act.STOW)
        await feed(bench, 33, **({} if share is None else {FLUX_READING: share}))
        assert order.report(plant.now()).flux is FluxProof.NOT_BELOW
        (alarm,) = [a for a in plant.alarms if a.condition == "flux_after_emergency"]
        assert ("30 %" if share else "100 %") in alarm.text
        assert not [a for a in plant.alarms if a.condition == "unknown_reading"]

    play(tmp_path, scene, settings=MEASURED)


def test_a_heliostat_that_an_emergency_left_unproven_tracks_after_an_engineers_word(
    tmp_path: Path,
) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        bench.cluster_of("P1C").deaf.add("P1C")
        token = await bench.commanded()
        plant.raise_emergency("Olga")
        for _ in range(9):
            await bench.wait(5.0)
            plant.authority.keep(OPERATOR, token)
        plant.withdraw_emergency(OPERATOR)
        await bench.wait(3.0)
        plant.authority.keep(OPERATOR, token)
        plant.acknowledge(OPERATOR, "operator_emergency")
        await bench.wait(4.0)
        assert not plant.sentinel.on
        plant.acknowledge(OPERATOR, "nodes_unacknowledged")
        await bench.wait(2.0)
        left = [a.subject for a in plant.alarms if a.condition == UNPROVEN]
        assert left == ["P1C"]
        for command in ("TRACK", "IDLE"):
            with pytest.raises(RefusedError, match="nothing shows that it has carried out the or"):
                plant.command(OPERATOR, token, command, ("P1C",))
        with pytest.raises(RefusedError, match="engineer must acknowledge, not operator"):
            plant.acknowledge(OPERATOR, UNPROVEN, "P1C")
        plant.acknowledge(ENGINEER, UNPROVEN, "P1C")
        await bench.wait(2.0)
        assert [a.active for a in plant.alarms if a.condition == UNPROVEN] == [True, False]

    play(tmp_path, scene)


def test_what_is_proven_after_its_emergency_needs_nobodys_word(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        bench.cluster_of("P1C").deaf.add("P1C")
        await bench.commanded()
        plant.raise_emergency("Olga", Act.STOW)
        await bench.wait(5.0)
        plant.withdraw_emergency(OPERATOR)
        await bench.wait(3.0)
        plant.acknowledge(OPERATOR, "operator_emergency")
        await bench.wait(2.0)
        assert not plant.sentinel.on
        left = [(a.subject, a.active) for a in plant.alarms if a.condition == UNPROVEN]
        assert left == [("P1C", True)]
        bench.cluster_of("P1C").deaf.clear()
        await bench.wait(60.0)
        left = [(a.subject, a.active) for a in plant.alarms if a.condition == UNPROVEN]
        assert left == [("P1C", True), ("P1C", False)]

    play(tmp_path, scene)


def test_an_order_that_is_withdrawn_at_once_waits_to_be_acknowledged_too(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        plant.raise_emergency("Olga", reason="smoke")
        plant.withdraw_emergency(OPERATOR)
        (waits,) = plant.sentinel.causes().values()
        assert waits.startswith(
            "all orders are withdrawn; the emergency ends when an operator acknowledges"
        )
        await bench.wait(5.0)
        assert plant.sentinel.on
        plant.acknowledge(OPERATOR, "operator_emergency")
        await bench.wait(1.0)
        assert not plant.sentinel.on

    play(tmp_path, scene)


def test_it_holds_until_withdrawn_and_acknowledged_and_then_nothing_moves(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        # A dead node must not keep an emergency going for ever.
        bench.cluster_of("P1C").deaf.add("P1C")
        token = await bench.commanded()
        plant.raise_emergency("Olga")
        await bench.wait(3.0)
        with pytest.raises(
            RefusedError, match=r"APPROACH: not accepted now: an emergency is active"
        ):
            plant.command(OPERATOR, token, "APPROACH")
        assert plant.command(OPERATOR, token, "LOCK", ("P2A",))
        with pytest.raises(RefusedError, match="the cause is not gone"):
            plant.acknowledge(OPERATOR, "operator_emergency")
        with pytest.raises(RefusedError, match="Vera is viewer"):
            plant.withdraw_emergency(VIEWER)
        with pytest.raises(RefusedError, match="no active emergency order; it was ordered"):
            plant.withdraw_emergency(Person("Otto", Role.OPERATOR))
        plant.withdraw_emergency(OPERATOR)
        with pytest.raises(RefusedError, match="Vera is viewer"):
            plant.acknowledge(VIEWER, "operator_emergency")
        await bench.wait(3.0)
        plant.authority.keep(OPERATOR, token)
        plant.acknowledge(OPERATOR, "operator_emergency")
        await bench.wait(1.0)
        assert not plant.sentinel.on
        # The node that did not answer is a finding of its own, to be acknowledged.
        await bench.wait(3.0)
        plant.acknowledge(OPERATOR, "nodes_unacknowledged")
        await bench.wait(5.0)
        plant.authority.keep(OPERATOR, token)
        assert bench.count(states.DEFOCUSED) == 16
        assert plant.command(OPERATOR, token, "APPROACH", ("P2B",))
        with pytest.raises(RefusedError, match="it is not tripped"):
            plant.acknowledge(OPERATOR, "operator_emergency")

    bench = play(tmp_path, scene)
    records, _ = read(bench.audit.path)
    assert [r.what for r in records if r.who == "Olga"] == [
        "AUTHORITY",
        "DEFOCUS",
        "LOCK",
        "WITHDRAW",
        "ACKNOWLEDGE",
        "ACKNOWLEDGE",
        "APPROACH",
    ]
    assert not any(r.what == "STOW" for r in records)


def test_a_flood_of_orders_leaves_one_record(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        order = plant.raise_emergency("Vera", reason="smoke")
        for _ in range(500):
            assert plant.raise_emergency("Vera", reason="smoke") is order
        await bench.wait(2.0)
        told = plant.withdraw_emergency(ENGINEER, "Vera")
        assert told == "the order was repeated 500 times; Vera's next order is accepted in 30 s"
        with pytest.raises(RefusedError, match="EMERGENCY: the order of Vera"):
            plant.raise_emergency("Vera", reason="smoke")
        assert plant.raise_emergency(OPERATOR.name, Act.STOW).act is Act.STOW
        await bench.wait(2.0)

    bench = play(tmp_path, scene)
    records, _ = read(bench.audit.path)
    mine = [(record.who, record.what) for record in records if record.who != "safety table"]
    assert mine == [("Vera", "DEFOCUS"), (ENGINEER.name, "WITHDRAW"), (OPERATOR.name, "STOW")]


def test_a_refusal_names_the_orders_that_stand_and_then_what_is_left_to_do(
    tmp_path: Path,
) -> None:
    async def scene(bench: Bench) -> None:
        plant, otto = bench.plant, Person("Otto", Role.OPERATOR)
        token = await bench.commanded()
        plant.raise_emergency("Otto", reason="smoke at the tower")
        plant.raise_emergency("Olga", reason="a person at the receiver")
        await bench.wait(2.0)

        def refused() -> str:
            plant.authority.keep(OPERATOR, token)
            with pytest.raises(RefusedError) as caught:
                plant.command(OPERATOR, token, "TRACK", ("P2A",))
            return str(caught.value)

        both = "Otto: smoke at the tower; Olga: a person at the receiver"
        text = "TRACK: not accepted now: an emergency is active (DEFOCUS; {})"
        assert refused() == text.format(both)
        plant.withdraw_emergency(otto)
        one = "Olga: a person at the receiver"
        assert refused() == text.format(one)
        assert dict(plant.sentinel.causes()) == {"Olga": "a person at the receiver"}
        # So it is when the table has made it a STOW.
        for _ in range(8):
            plant.authority.keep(OPERATOR, token)
            await bench.wait(4.0)
        assert refused() == text.format(one).replace("DEFOCUS", "STOW")
        assert plant.sentinel.order is not None
        assert (plant.sentinel.order.who, plant.sentinel.order.reason) == ("safety table", one)
        plant.withdraw_emergency(OPERATOR)
        left = (
            "all orders are withdrawn; the emergency ends when an operator acknowledges "
            "operator_emergency, which is possible 2 s after the last withdrawal"
        )
        assert refused().endswith(f"(STOW; safety table: {left})")
        with pytest.raises(RefusedError) as again:
            plant.withdraw_emergency(OPERATOR)
        assert str(again.value) == f"withdraw: Olga has no active emergency order; {left}"
        await bench.wait(3.0)
        plant.acknowledge(OPERATOR, "operator_emergency")
        await bench.wait(1.0)
        assert not plant.sentinel.on
        assert plant.sentinel.causes() == {}
        with pytest.raises(
            RefusedError, match="Olga has no active emergency order; no emergency is active"
        ):
            plant.withdraw_emergency(OPERATOR)

    play(tmp_path, scene)


def test_wind_defocuses_and_stows_with_hysteresis(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        await feed(bench, 3, wind_gust=8.0, receiver_flux=0.7)
        assert bench.count(states.TRACKING) == 18
        await feed(bench, 2, wind_gust=16.0, receiver_flux=0.7)
        assert bench.count(states.TRACKING) == 18
        await feed(bench, 3, wind_gust=16.0, receiver_flux=0.0)
        assert bench.count(states.DEFOCUSED) == 18
        plant.put(FLUX_READING, 0.0)
        # Between its limits it stays as it is, however long.
        await feed(bench, 30, wind_gust=13.0, receiver_flux=0.0)
        assert plant.sentinel.on
        await feed(bench, 1, wind_gust=21.0, receiver_flux=0.0)
        assert bench.count(states.STOWED) == 18
        await feed(bench, 50, wind_gust=5.0, receiver_flux=0.0)
        assert plant.sentinel.on
        await feed(bench, 15, wind_gust=5.0, receiver_flux=0.0)
        assert not plant.sentinel.on
        assert bench.count(states.STOWED) == 18
        # The flux was not measured after the orders: somebody has to look why.
        with pytest.raises(RefusedError, match="engineer must acknowledge, not operator"):
            plant.acknowledge(OPERATOR, "flux_after_emergency")
        plant.acknowledge(ENGINEER, "flux_after_emergency")
        told = [(a.condition, a.active) for a in plant.alarms if a.condition.startswith("wind")]
        assert told[:2] == [("wind_gust_defocus", True), ("wind_gust_stow", True)]
        assert set(told[2:]) == {("wind_gust_defocus", False), ("wind_gust_stow", False)}

    # Ten minutes of calm are long in a test: here one does.
    rows = ("wind_gust_defocus", "wind_gust_stow")
    table = limited(conditions(), {row: {"clear_for_s": 60.0} for row in rows})
    bench = play(tmp_path, scene, settings=WINDY, table=table)
    assert orders(bench) == [("DEFOCUS", ()), ("STOW", ())]


def test_a_gust_of_a_simulated_wind_defocuses_the_field(tmp_path: Path) -> None:
    """What an anemometer in the twin's wind tells each second is fed to the plant."""
    wind = Wind(speed=9.0, gust=8.0, seed=4)
    gusts = [wind.readings((0.0, 0.0, 10.0), float(t))["wind_gust"] for t in range(3600)]
    strong = [all(g > 15.0 for g in gusts[t : t + 5]) for t in range(3595)]
    first = strong.index(True)
    calm = max(t for t in range(first) if gusts[t] <= 15.0)

    async def scene(bench: Bench) -> None:
        for t in range(first - 30, calm + 3):
            await feed(bench, 1, receiver_flux=0.7, **wind.readings((0.0, 0.0, 10.0), float(t)))
            assert bench.count(states.TRACKING) == 18, t
        for t in range(calm + 3, calm + 8):
            await feed(bench, 1, receiver_flux=0.7, **wind.readings((0.0, 0.0, 10.0), float(t)))
        assert bench.count(states.TRACKING) == 0
        assert bench.plant.sentinel.order is not None
        assert "wind gust of" in bench.plant.sentinel.order.reason

    sensors = frozenset({"wind_gust", "wind_mean", "receiver_flux"})
    play(tmp_path, scene, settings=PlantSettings(sensors=sensors))


def test_a_sensor_that_falls_silent_counts_as_the_worst(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        await feed(bench, 5, wind_gust=3.0, receiver_flux=0.5)
        assert bench.count(states.TRACKING) == 18
        await bench.wait(6.0)
        assert bench.count(states.STOWED) == 18
        assert "no reading of wind gust (3 s)" in bench.plant.sentinel.order.reason  # type: ignore[union-attr]
        assert "wind_mean_stow" in bench.plant.sentinel.table.unwatched
        with pytest.raises(UnknownNameError, match="no sensor of the plant 'wind_mean'"):
            bench.plant.put("wind_mean", 1.0)

    play(tmp_path, scene, settings=WINDY)


def test_readings_of_sensors_are_shown_until_they_are_old(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        table = bench.plant.sentinel.table
        shown = table.shown(bench.plant.now())
        assert list(shown) == ["dni", FLUX_READING, "wind_gust"]
        assert all(map(math.isnan, shown.values()))
        bench.plant.put("dni", 640.0)
        await feed(bench, 50, wind_gust=3.0)
        shown = table.shown(bench.plant.now())
        assert (shown["dni"], shown["wind_gust"]) == (640.0, 3.0)
        await feed(bench, 12, wind_gust=4.0)
        shown = table.shown(bench.plant.now())
        assert math.isnan(shown["dni"])
        assert shown["wind_gust"] == 4.0
        assert bench.plant.sentinel.order is None

    sensors = frozenset({"wind_gust", "dni", FLUX_READING})
    play(tmp_path, scene, settings=PlantSettings(sensors=sensors))


def test_a_silent_cluster_is_defocused_alone_and_told_again_when_it_is_back(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        bench.clusters["pod-4"].mute = True
        took = await bench.until(lambda: bench.count(states.DEFOCUSED) == 3, 10.0)
        assert took <= 4.5
        assert not plant.sentinel.on
        token = await bench.commanded()
        with pytest.raises(RefusedError, match="no status from the cluster"):
            plant.command(OPERATOR, token, "TRACK", ("P4A",))
        assert plant.command(OPERATOR, token, "TRACK", ("P5A",))
        await bench.wait(32.0)
        assert bench.count(states.STOWED) == 3
        bench.clusters["pod-4"].mute = False
        await bench.wait(8.0)
        token = await bench.commanded()
        assert plant.command(OPERATOR, token, "APPROACH", ("P4A",))

    bench = play(tmp_path, scene)
    assert orders(bench, "pod-4") == [("DEFOCUS", ()), ("STOW", ())]
    assert orders(bench, "pod-3") == []


def test_who_comes_back_during_an_emergency_is_told(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        line = bench.lines["pod-2"]
        line.cut()
        await bench.wait(2.5)
        bench.plant.raise_emergency("Olga", Act.STOW)
        await bench.wait(2.0)
        assert bench.count(states.STOWED) == 15
        line.heal()
        await bench.until(lambda: bench.count(states.STOWED) == 18, 5.0)
        with pytest.raises(InputError, match="HOLD cannot be ordered"):
            bench.plant.raise_emergency("Olga", Act.HOLD)
        # Whoever calls it again is on record too.
        assert bench.plant.raise_emergency("Vera").act is Act.STOW
        await bench.wait(1.0)

    bench = play(tmp_path, scene)
    records, _ = read(bench.audit.path)
    assert [(r.who, r.role, r.what) for r in records] == [
        ("Olga", "anybody", "STOW"),
        ("Vera", "anybody", "DEFOCUS"),
    ]


def test_defocus_of_some_is_repeated_until_it_is_acknowledged(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        bench.lines["pod-2"].cut(second_to_first=False)
        bench.cluster_of("P3A").deaf.add("P3A")
        ticket = bench.plant.defocus("Olga", ("P1A", "P2A", "P3A"))
        await bench.wait(1.2)
        assert bench.count(states.DEFOCUSED) == 1
        bench.lines["pod-2"].heal()
        assert not await ticket.end(20.0)
        assert ticket.refusals == {"P3A": "no reply before the command expired"}
        assert bench.count(states.DEFOCUSED) == 2

        # What came after it ends the repetition.
        bench.cluster_of("P4A").deaf.add("P4A")
        ticket = bench.plant.defocus("Olga", ("P4A", "P4B"))
        await bench.wait(1.5)
        bench.plant.stow("Olga", ("P4A",))
        assert ticket.refusals == {"P4A": "superseded by STOW"}
        await bench.wait(3.5)

    bench = play(tmp_path, scene)
    names = [name for name, _ in orders(bench, "pod-4")]
    assert names == ["DEFOCUS"] * 2 + ["STOW"] * 4
    assert orders(bench, "pod-1") == [("DEFOCUS", ("P1A",))]
    assert 10 <= len(orders(bench, "pod-3")) <= 14


def test_when_the_plant_ends_so_do_its_leases(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        await bench.plant.close()
        await bench.wait(1.0)
        counts = [len(c.taken) for c in bench.clusters.values()]
        await bench.wait(5.0)
        assert [len(c.taken) for c in bench.clusters.values()] == counts

    play(tmp_path, scene)


def test_a_row_of_a_cluster_is_acknowledged_there(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        bench.plant.acknowledge(ENGINEER, "clock_jump", "pod-1")
        with pytest.raises(RefusedError, match="no such condition"):
            bench.plant.acknowledge(ENGINEER, "clock_jump", "pod-9")
        await bench.wait(1.0)

    bench = play(tmp_path, scene)
    (sent,) = bench.clusters["pod-1"].of(Acknowledge)
    assert (sent.condition, sent.who, sent.role) == ("clock_jump", "Egon", "supervisor")
    assert not bench.clusters["pod-2"].of(Acknowledge)


def test_done_is_judged_by_state_and_by_axes() -> None:
    one = rotary(200, 2400, microsteps=4)
    drives = Drive(np.broadcast_to(one.table, (1, 2, 19)))
    step = 2.0 * np.pi / (200 * 2400 * 4)
    stowed = 1 << meanings.FLAGS.index("AT_STOW")

    def judged(act: Act, state: int, left: float, *, settled: bool = True, flags: int = 0) -> bool:
        rows = np.zeros(1, NODE)
        rows["state"], rows["primary_goal"], rows["flags"] = state, round(left / step), flags
        return bool(carried_out(act, rows, drives, np.array([settled]))[0])

    for state in (states.TRACKING, states.IDLE, states.APPROACHING, states.SEARCHING):
        assert not judged(Act.DEFOCUS, state, 0.0)
    for state in (states.DEFOCUSED, states.FAULT, states.LOCKED):
        assert judged(Act.DEFOCUS, state, 4e-3)
        assert not judged(Act.DEFOCUS, state, 6e-3)
        assert not judged(Act.DEFOCUS, state, -6e-3)
    assert judged(Act.DEFOCUS, states.STOWING, 1.0)
    assert not judged(Act.DEFOCUS, states.STOWING, 1.0, settled=False)
    assert not judged(Act.STOW, states.STOWING, 0.0)
    assert judged(Act.STOW, states.LOCKED, 0.0, flags=stowed)
    # Unlocked at stow it has not obeyed, and may go on to track.
    for act in (Act.STOW, Act.DEFOCUS):
        assert not judged(act, states.IDLE, 0.0, flags=stowed)
    assert judged(Act.STOW, states.STOWED, 0.0)


@pytest.mark.parametrize("act", [Act.DEFOCUS, Act.STOW])
def test_drives_that_are_switched_off_away_from_stow_are_never_done(
    act: Act, tmp_path: Path
) -> None:
    async def scene(bench: Bench) -> None:
        cluster = bench.cluster_of("P3B")
        row, flags = cluster.names.index("P3B"), cluster.rows["flags"]
        # The cluster reports all it is asked for as done.
        flags[row] = off = 1 << meanings.FLAGS.index("LOCAL_SWITCH")
        cluster.set(states.LOCKED, "P3B")
        await bench.wait(2.0)
        order = bench.plant.raise_emergency("a visitor", act)
        for _ in range(20):
            cluster.set(states.LOCKED, "P3B")
            await bench.wait(0.5)
        report = order.report(bench.plant.now())
        assert report.not_done == ("P3B",)
        assert not report.complete
        assert "P3B: its drives were switched off at the heliostat" in report.text
        flags[row] = off | 1 << meanings.FLAGS.index("AT_STOW")
        await bench.wait(2.0)
        report = order.report(bench.plant.now())
        assert report.not_done == ()
        assert "switched off" not in report.text

    play(tmp_path, scene)


@pytest.mark.parametrize("act", [Act.DEFOCUS, Act.STOW])
@pytest.mark.parametrize("seen", [True, False])
def test_unknown_step_counts_are_never_done(act: Act, seen: bool, tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant, cluster = bench.plant, bench.cluster_of("P3B")
        row = cluster.names.index("P3B")
        if seen:
            plant.aims[plant.field.place("P3B")] = (1.0, 0.0, 15.0)
            cluster.set(states.TRACKING, "P3B")
            await bench.wait(2.0)
        # A reset has made its counts unreadable; the cluster reports all it is asked for as done.
        cluster.rows["flags"][row] = 1 << meanings.FLAGS.index("COUNTS_UNKNOWN")
        cluster.set(states.FAULT, "P3B")
        await bench.wait(2.0)
        if not seen:
            plant.field.posed_at[plant.field.place("P3B")] = -np.inf
        order = plant.raise_emergency("a visitor", act)
        await bench.wait(10.0)
        report = order.report(plant.now())
        assert report.not_done == ("P3B",)
        assert not report.complete
        text = (
            r"P3B: its step counts are unknown, so its beam is not proven to be off the "
            r"receiver; "
        )
        last = r"1\d s ago it was TRACKING with its beam at \(1.0, 0.0, 15.0\) m"
        assert re.search(
            text + (last if seen else "the position of its beam is unknown"), report.text
        )
        cluster.rows["flags"][row] = 0
        cluster.set(LEADS[act.name], "P3B")
        await bench.wait(2.0)
        report = order.report(plant.now())
        assert report.not_done == ()
        assert "unknown" not in report.text

    play(tmp_path, scene)


def test_a_safe_order_repeated_at_once_joins_the_one_under_way(tmp_path: Path) -> None:
    """A program that stows as fast as it is answered does not fill the buses."""

    async def scene(bench: Bench) -> None:
        plant = bench.plant
        token = await bench.commanded(OPERATOR)
        first = plant.stow("Olga", ("P3B",))
        assert all(plant.stow("Olga", ("P3B",)) is first for _ in range(100))
        # Another person, another order, other heliostats, and anything ordered in between count.
        for other in (
            plant.stow("Oskar", ("P3B",)),
            plant.defocus("Olga", ("P3B",)),
            plant.stow("Olga", ("P3A", "P3B")),
        ):
            assert other is not first
        last = plant.stow("Olga", ("P3B",))
        assert last is not first
        plant.command(OPERATOR, token, "LOCK", ("P1A",))
        again = plant.stow("Olga", ("P3B",))
        assert again is not last
        await bench.wait(0.3)
        assert plant.stow("Olga", ("P3B",)) is not again
        await bench.wait(0.3)

    bench = play(tmp_path, scene)
    sent = [heliostats for name, heliostats in orders(bench, "pod-3") if name == "STOW"]
    assert len(sent) == 6


def test_a_given_reading_counts_from_when_it_was_made_and_goes_stale_as_any_other(
    tmp_path: Path,
) -> None:
    """A calm wind that is not renewed ends in the worst case, 5 s after it was measured."""

    async def scene(bench: Bench) -> None:
        plant = bench.plant
        given = GivenReadings(plant, Logbook(plant.clock))

        def give(value: float, age: float = 0.0) -> None:
            at = plant.clock.utc().timestamp() - age
            given.take(ENGINEER, "wind_gust", value, at)

        for _ in range(20):
            give(3.0, 0.5)
            await bench.wait(1.0)
        assert "wind_gust_stow" not in {alarm.condition for alarm in plant.alarms}
        for age, said in (
            (1.5, r"is 0\.0 s older than the last reading; send"),
            (2.5, r"is 1\.0 s older"),
        ):
            with pytest.raises(InputError, match=said):
                give(3.0, age)
        with pytest.raises(InputError, match=r"is 6\.0 s old, the limit is 5 s"):
            give(3.0, 6.0)
        with pytest.raises(InputError, match=r"is 2\.0 s ahead of the plant's clock"):
            give(3.0, -2.0)
        with pytest.raises(InputError, match="finite"):
            give(math.nan)
        with pytest.raises(UnknownNameError, match='there is no "api" reading'):
            given.take(ENGINEER, "receiver_flux", 0.0, 0.0)
        # The last one was made 1.5 s ago.
        await bench.wait(3.0)
        assert "wind_gust_stow" not in {alarm.condition for alarm in plant.alarms}
        await bench.wait(1.0)
        assert "wind_gust_stow" in {alarm.condition for alarm in plant.alarms}
        # A program whose clock was an hour ahead, as the plant's was, goes on once both are right.
        newest, taken = given._last["wind_gust"]
        given._last["wind_gust"] = newest + 3600.0, taken
        with pytest.raises(InputError, match="older than the last reading; send"):
            give(3.0)
        await bench.wait(1.0)
        give(3.0)

    play(tmp_path, scene, settings=PlantSettings(given=frozenset({"wind_gust"})))


def test_an_order_that_is_given_again_is_not_acknowledged_away(tmp_path: Path) -> None:
    """Withdrawn by one person and ordered again by another before its row is acknowledged."""

    async def scene(bench: Bench) -> None:
        plant = bench.plant
        for pause in (0.0, 2.0):
            plant.raise_emergency("Olga")
            await bench.wait(2.0)
            plant.withdraw_emergency(OPERATOR)
            await bench.wait(3.0)
            plant.raise_emergency("Vera", reason="a person on the tower")
            await bench.wait(pause)
            with pytest.raises(RefusedError, match="the cause is not gone"):
                plant.acknowledge(OPERATOR, "operator_emergency")
            await bench.wait(5.0)
            assert plant.sentinel.on
            with pytest.raises(RefusedError, match="the cause is not gone"):
                plant.acknowledge(OPERATOR, "operator_emergency")
            plant.withdraw_emergency(ENGINEER, "Vera")
            await bench.wait(3.0)
            plant.acknowledge(OPERATOR, "operator_emergency")
            await bench.wait(2.0)
            assert not plant.sentinel.on

    play(tmp_path, scene)


@pytest.mark.parametrize("lost", ["a cluster", "a heliostat"])
def test_who_comes_back_after_the_ticket_has_ended_is_ordered_again(
    lost: str, tmp_path: Path
) -> None:
    async def scene(bench: Bench) -> None:
        plant, cluster = bench.plant, bench.clusters["pod-2"]
        names = cluster.names if lost == "a cluster" else cluster.names[:1]
        cluster.deaf.update(names)
        if lost == "a cluster":
            bench.lines["pod-2"].cut()
        order = plant.raise_emergency("Olga", Act.STOW)
        await bench.until(lambda: order.ticket.finished, 120.0)
        assert set(order.unacknowledged(plant.field.names)) == set(names)
        assert bench.count(states.STOWED) == 18 - len(names)
        cluster.set(states.TRACKING, *names)
        cluster.deaf.clear()
        bench.lines["pod-2"].heal()
        await bench.until(lambda: bench.count(states.STOWED) == 18, 15.0)
        await bench.wait(3.0)
        assert order.unacknowledged(plant.field.names) == ()

    play(tmp_path, scene)


@pytest.mark.parametrize("act", [Act.DEFOCUS, Act.STOW])
@pytest.mark.parametrize("state", [states.STOWING, states.STOWED, states.DEFOCUSED])
def test_only_a_row_and_counts_from_after_the_order_prove_it(act: Act, state: int) -> None:
    clock = VirtualClock()
    one = Drive(np.broadcast_to(rotary(200, 2400, microsteps=4).table, (1, 2, 19)))
    rows = np.zeros(1, NODE)
    rows["state"] = state

    def proven(heard: float, counted: float, **wrong: bool) -> bool:
        ticket = Ticket("t", act.name, ("A",), clock, 60.0)
        order = EmergencyOrder(act, "Olga", "", 100.0, ticket, flux_measured=False)
        masks = [np.array([wrong.get(name, False)]) for name in ("strange", "lit")]
        times = np.array([heard]), np.array([counted])
        order.take_rows(("A",), rows, *times, one, 110.0, *masks)
        return order.is_done("A")

    can = state == states.STOWED or act is Act.DEFOCUS
    assert proven(106.0, 106.0) is can
    for heard, counted in ((99.0, 99.0), (106.0, 99.0), (99.0, 106.0)):
        assert not proven(heard, counted)
    # One on its way to stow has had the time to leave.
    assert proven(101.0, 101.0) is (can and state != states.STOWING)
    assert not proven(106.0, 106.0, lit=True)
    assert not proven(106.0, 106.0, strange=True)


def test_no_motion_begins_in_the_cold(tmp_path: Path) -> None:
    """Where ice may block the drives; what runs goes on, and DEFOCUS and STOW pass."""

    async def scene(bench: Bench) -> None:
        plant = bench.plant
        token = await bench.commanded()

        async def air(celsius: float, seconds: int) -> None:
            for _ in range(seconds):
                plant.put("temperature", celsius)
                plant.authority.keep(OPERATOR, token)
                await bench.wait(1.0)

        await air(12.0, 3)
        assert plant.command(OPERATOR, token, "APPROACH", ("P2A",))
        await air(0.5, 3)
        said = r"the air is at 0.5 °C: ice may block the drives, .* \(limit 1 °C\)"
        with pytest.raises(RefusedError, match=said):
            plant.command(OPERATOR, token, "APPROACH", ("P2B",))
        assert bench.count(states.TRACKING) == 17
        assert plant.stow("anybody", ("P2B",))
        # Between its limits it holds, and it ends half an hour after the air is warm.
        await air(3.0, 3)
        with pytest.raises(RefusedError, match="not yet back at 4 °C"):
            plant.command(OPERATOR, token, "APPROACH", ("P2B",))
        await air(5.0, 62)
        assert plant.command(OPERATOR, token, "APPROACH", ("P2B",))
        # A silent thermometer counts as frost.
        for _ in range(63):
            plant.authority.keep(OPERATOR, token)
            await bench.wait(1.0)
        with pytest.raises(RefusedError, match="no reading of air temperature"):
            plant.command(OPERATOR, token, "APPROACH", ("P2C",))

    settings = PlantSettings(sensors=frozenset({"temperature"}))
    table = limited(conditions(), {"cold": {"clear_for_s": 60.0}})
    play(tmp_path, scene, settings=settings, table=table)
