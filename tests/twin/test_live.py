"""A plant that lives in the twin: its loop, links, buses, cameras, and that it learns."""

import asyncio
import hashlib
import re
import struct
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.field.layouts import lay_out, malan_plant
from heliotrope.field.stellenbosch import prototype
from heliotrope.field.target import Target
from heliotrope.geometry import bisector, normalize, reflect
from heliotrope.imaging.synthetic.scenes import Scene
from heliotrope.lcu import journal, messages, states, wire
from heliotrope.lcu.sender import Sender
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.link import LinkClosedError, SendOutcome
from heliotrope.mechanism.board_items import items_of
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.plant.orders.kept_audit import KeptAudit
from heliotrope.plant.settings import PlantSettings
from heliotrope.plant.visits.photographs import Shot
from heliotrope.safety import FluxProof
from heliotrope.store.audit import entries
from heliotrope.store.keeper import Keeper
from heliotrope.twin.cameras import ExactCamera, FieldSnapshot, RenderedCamera
from heliotrope.twin.field import Field, FieldBus
from heliotrope.twin.live import CYCLE, PacedLoop, WorldOptions, near_pair
from heliotrope.twin.live.live import machines_of
from heliotrope.twin.live.loop import LATE
from heliotrope.twin.sensors import light_share
from heliotrope.twin.true_mirrors import TrueMirror, mirrors_near
from support.live import LiveOptions, LivePlant, play

MRAD = 1e-3
START = datetime(2026, 10, 21, 7, tzinfo=UTC)
NIGHT = datetime(2026, 10, 21, 23, tzinfo=UTC)
EXACT = LiveOptions(rendered=False, threads=0)


class Wall:
    """Wall time by hand."""

    def __init__(self) -> None:
        self.now = 50.0

    def __call__(self) -> float:
        return self.now


def test_a_paced_loop_goes_at_its_speed_and_waits_for_the_late() -> None:
    wall = Wall()
    with asyncio.Runner(loop_factory=lambda: PacedLoop(4.0, 100.0, wall)) as runner:
        loop = runner.get_loop()
        assert isinstance(loop, PacedLoop)
        seen: list[float] = []

        async def main() -> None:
            for _ in range(3):
                # The wall goes on by 0.5 s while it waits: two seconds of the loop.
                asyncio.get_running_loop().call_soon(lambda: setattr(wall, "now", wall.now + 0.5))
                await asyncio.sleep(2.0)
                seen.append(loop.time())
            assert loop.lag == 0.0
            wall.now += 10.0
            await asyncio.sleep(1.0)

        runner.run(main())
        assert np.allclose(np.diff([100.0, *seen]), 2.0, atol=0.05)
        # Forty seconds have passed where one was asked for: no timer is jumped over.
        assert loop.time() == pytest.approx(seen[-1] + 1.0, abs=0.3)
        assert loop.lag == pytest.approx(39.0 - LATE, abs=0.3)
    for bad in (0.0, -1.0, 2000.0):
        with pytest.raises(InputError, match="simulated seconds per second"):
            PacedLoop(bad)


def test_a_near_link_carries_what_is_fresh() -> None:
    async def main(clock: VirtualClock) -> None:
        plant, cluster = near_pair(clock, ("plant", "C1"))
        assert plant.connected
        assert plant.name == "C1"
        assert cluster.name == "plant"
        now = clock.monotonic()
        assert await plant.send(b"late", expires=now) is SendOutcome.EXPIRED
        assert await plant.send(b"stale", expires=now + 1.0) is SendOutcome.SENT
        await asyncio.sleep(2.0)
        assert await plant.send(b"fresh", expires=clock.monotonic() + 1.0) is SendOutcome.SENT
        assert await cluster.receive() == b"fresh"
        assert cluster.statistics.late == 1
        cluster.plugged = False
        assert await plant.send(b"lost") is SendOutcome.DISCONNECTED
        assert plant.problem == "the line is cut"
        cluster.plugged = True
        assert plant.connected
        assert plant.statistics.opened == 2
        await plant.close()
        with pytest.raises(LinkClosedError):
            await plant.send(b"")
        with pytest.raises(LinkClosedError):
            await plant.receive()

    run_virtual(main)


def test_mirrors_near_a_target_are_those_whose_rays_meet_it() -> None:
    rng = np.random.default_rng(3)
    design = lay_out("radial", 60)
    target = design.targets[0]
    light = normalize(np.array([0.3, 0.5, 0.8]))
    vertex = design.position + [0.0, 0.0, 2.0]
    aims = target.center + rng.normal(0.0, 6.0, (60, 3))
    facing = bisector(light, normalize(aims - vertex))
    sizes = np.ones((60, 2))
    middle = np.asarray(target.corners).mean(axis=0)
    reach = 5.0 / (0.5 * float(np.hypot(target.width, target.height)))
    found = mirrors_near(target, light, (facing, vertex), design.names, sizes, reach)
    expected = set()
    for name, v, n in zip(design.names, vertex, facing, strict=True):
        ray = reflect(light, n)
        point = target.intersect(v, ray)
        if np.isfinite(point).all() and (point - v) @ ray > 0 and n @ light > 0.05:
            expected |= {name} if np.linalg.norm(point - middle) <= 5.0 else set()
    assert 5 < len(expected) < 55
    assert {mirror.heliostat for mirror in found} == expected


def _field(count: int = 3) -> Field:
    design = lay_out("radial", count)
    (group,) = design.groups.values()
    return Field(group.mechanism, machines_of(design))


def _ask(field: Field, name: str, *values: object, key: bytes = b"", to: int = 2) -> wire.Frame:
    sender = Sender(wire.CLUSTER_ADDRESS, 1, lambda d: hashlib.sha256(d).digest())
    bus = FieldBus(field, range(3))
    data = asyncio.run(bus.transact(sender.frame(to, name, *values, key=key), 0.1))
    (frame,) = wire.Reader().feed(data)
    return frame


def test_a_live_bus_tells_and_takes_what_is_stored() -> None:
    field = _field()
    wanted = items_of(field.mechanism[1].with_parameters({"tilt_north": 8 * MRAD}))
    number = [row[0] for row in journal.ITEMS]
    place = number.index("armature") + 1
    before = _ask(field, "QUERY_STORED", place).values()
    assert before is not None
    assert before[1] == items_of(field.mechanism[1])["armature"]
    numbers = struct.unpack("<18d", wanted["armature"])
    answer = _ask(field, "SET_ARMATURE", 9, 9, 1, *numbers, key=b"k" * 32).values()
    assert answer is not None
    assert answer[2] == messages.DONE
    after = _ask(field, "QUERY_STORED", place).values()
    assert after is not None
    assert after[1] == wanted["armature"]
    status = _ask(field, "QUERY_STATUS").values()
    assert status is not None
    assert status[7] == field.journals.checksums[1]
    # Nothing is stored in a mirror that tracks; the neighbours have not changed.
    field.state[1] = states.TRACKING
    refused = _ask(field, "SET_ARMATURE", 9, 9, 2, *numbers, key=b"k" * 32).values()
    assert refused is not None
    assert refused[2] == messages.REFUSED_STATE
    first, third = (_ask(field, "QUERY_STORED", place, to=address).values() for address in (1, 3))
    assert first is not None
    assert third is not None
    for row, told in ((0, first), (2, third)):
        assert told[1] == items_of(field.mechanism[row])["armature"]


def test_what_is_stored_is_what_the_mirror_then_does() -> None:
    design = lay_out("radial", 12)
    (group,) = design.groups.values()
    truth = group.mechanism.with_parameters(
        {"tilt_north": np.full(12, 9 * MRAD), "azimuth_bias": np.full(12, -4 * MRAD)}
    )
    field = Field(truth, machines_of(design), believed=group.mechanism)
    light = normalize(np.array([0.2, 0.6, 0.7]))
    aims = np.broadcast_to(design.receivers[0].center, (12, 3))
    assert np.median(field.errors(light, aims)) > 3 * MRAD
    for row in range(6):
        field.store(row, items_of(truth[row]))
    errors = field.errors(light, aims)
    # What is left is half a step of each axis, 8 µrad.
    assert errors[:6].max() < 0.02 * MRAD
    assert errors[6:].min() > 1 * MRAD


@pytest.mark.parametrize(
    ("at", "longitude"),
    [
        (datetime(2012, 9, 2, 10, tzinfo=UTC), 18.9),
        # A leap second comes ten seconds later, at noon of a site in the Pacific.
        (datetime(2012, 6, 30, 23, 59, 50, tzinfo=UTC), 180.0),
        (datetime(2099, 6, 21, 10, tzinfo=UTC), 18.9),
    ],
    ids=["malans-day", "leap-second", "2099"],
)
def test_a_simulated_plant_tracks_at_any_time(at: datetime, longitude: float) -> None:
    design = malan_plant(3)
    design = replace(design, site=replace(design.site, longitude_deg=longitude))
    work = AutomaticSettings(wanted=True, calibrate=False)

    async def main(clock: VirtualClock) -> None:
        async with LivePlant(design, clock, replace(EXACT, work=work)).running() as plant:
            await asyncio.sleep(60.0)
            assert plant.operations.summary().states == {"TRACKING": 3}
            assert not plant.operations.logbook.alarms()
            await plant.end()

    run_virtual(main, start=at)


#: Photographs of a visit: one to find the beam, those of the fit, and one that confirms the new
#: parameters.
PHOTOGRAPHS = 1 + CYCLE.shots + 1
#: A visit in the twin, s: a photograph every 5 s, and twice the way to the target and back, because
#: the new parameters are written between the last photograph of the fit and the confirming one.
VISIT = 5.0 * PHOTOGRAPHS + 2 * 12.0
#: Key of the bus where it is signed.
BUS_KEY = b"the bus's key..."
#: Time in which the field goes from stow to standby, s.
RAISED = 35.0


@pytest.mark.parametrize("key", [b"", BUS_KEY], ids=["open-bus", "signed-bus"])
def test_a_small_plant_raises_itself_learns_and_is_stowed(key: bytes) -> None:
    """With a key of the bus the gates of the firmware judge every order and every new parameter."""

    async def work(plant: LivePlant) -> None:
        before = plant.errors()
        # Two targets serve three heliostats: on each, three visits one after another.
        await asyncio.sleep(RAISED + 3 * VISIT)
        # Further visits would go on without end; one that has begun is finished first.
        plant.operations.switch_calibration(Person("operator", Role.OPERATOR), on=False)
        await asyncio.sleep(VISIT)
        view = plant.operations.automatic.view()
        assert not view.running
        seen = {(entry.heliostat, entry.target) for entry in view.results if entry.good}
        assert seen == {(name, target) for name in plant.names for target in ("left", "right")}
        assert plant.operations.summary().states == {"TRACKING": 3}
        assert before.max() > 5 * MRAD
        assert plant.errors().max() < 0.2 * before.max()
        assert view.quality[-1].calibrated == 3
        assert await plant.stowed()
        assert plant.operations.summary().states == {"STOWED": 3}
        kept = [plant.field.journals.items(row).get("bus_keys", b"")[:16] for row in range(3)]
        assert kept == [key] * 3
        # Mirrors that rose before they had the key are named until they stand again.
        assert not [
            r for r in plant.operations.logbook.alarms() if "bus" in r.condition and r.active
        ]

    play(work, lay_out("radial", 3), replace(EXACT, bus_key=key))


def test_step_counts_that_come_seldom_are_not_taken_for_new(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # As in a large plant, whose clusters ask for counts every five seconds only.
    monkeypatch.setattr("heliotrope.twin.live.live._SMALL", 0)
    monkeypatch.setattr("heliotrope.cluster._orders.FOLLOWED", 0.0)

    async def work(plant: LivePlant) -> None:
        await asyncio.sleep(240.0)
        results = plant.operations.automatic.view().results
        assert len(results) >= 3
        assert all(entry.text.startswith("calibrated") for entry in results), results
        assert max(entry.after for entry in results) < 0.5 * MRAD

    play(work, malan_plant(4), EXACT)


class Strangers:
    """A camera on whose first photographs another's beam stands somewhere."""

    def __init__(self, camera: ExactCamera, count: int) -> None:
        self._photograph, self.left = camera.photograph, count

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        shot = await self._photograph(target, heliostat)
        if self.left == 0:
            return shot
        self.left -= 1
        place = np.array([3.0 - 2.0 * self.left, 2.0])
        return Shot(np.asarray(target.center + place @ target.axes), shot.at, 1e-5)


@pytest.mark.parametrize("count", [1, 2])
def test_anothers_beam_is_not_taken_for_its_own(count: int) -> None:
    async def work(plant: LivePlant) -> None:
        assert isinstance(plant.cameras, ExactCamera)
        camera = Strangers(plant.cameras, count)
        plant.cameras.photograph = camera.photograph  # type: ignore[method-assign]
        await asyncio.sleep(150.0)
        assert camera.left == 0
        first = plant.operations.automatic.view().results[-1]
        assert first.text.startswith("calibrated"), first
        assert "another heliostat's beam" in first.text
        assert first.after < 0.5 * MRAD

    play(work, malan_plant(1), EXACT)


@pytest.mark.slow
def test_heliostats_of_the_default_plant_fall_below_half_a_milliradian() -> None:
    # Twelve of the ten thousand, near and far ones alike: the schedule prefers first visits, and
    # only second ones go to the other target.
    design = malan_plant()
    (group,) = design.groups.values()
    some = group.take(np.linspace(0, len(group) - 1, 12).astype(np.intp))
    some = replace(some, cluster=tuple(f"C{1 + i // 6}" for i in range(12)))

    async def work(plant: LivePlant) -> None:
        before = plant.errors()
        assert 10 * MRAD < np.sqrt(np.mean(before**2)) < 20 * MRAD
        await asyncio.sleep(600.0)
        results = plant.operations.automatic.view().results
        seen = {(entry.heliostat, entry.target) for entry in results if entry.good}
        both = {name for name, _ in seen if {(name, "left"), (name, "right")} <= seen}
        assert len(both) >= 8
        rows = [plant.plant.field.place(name) for name in both]
        assert np.median(plant.errors()[rows]) < 0.5 * MRAD

    play(work, replace(design, groups={"azel": some}), EXACT)


def test_boards_learn_as_a_vectorised_field_does() -> None:
    design = prototype()
    (group,) = design.groups.values()
    few = replace(design, groups={"azel": group.take([0, 1, 2])})

    async def work(plant: LivePlant) -> None:
        await asyncio.sleep(110.0)
        view = plant.operations.automatic.view()
        assert view.done >= 1, plant.operations.logbook.events(20)
        assert view.results[-1].text.startswith("calibrated: ")
        assert await plant.stowed()

    play(work, few, replace(EXACT, boards=True))


def test_what_was_learnt_outlasts_the_program(tmp_path: Path) -> None:
    design = lay_out("radial", 3)
    errors: list[float] = []

    async def main(clock: VirtualClock) -> None:
        keeper = Keeper(tmp_path, inline=True)
        first = LivePlant(design, clock, EXACT, records=keeper)
        async with first.running():
            await asyncio.sleep(100.0)
            known = {entry.heliostat for entry in first.operations.automatic.view().results}
            first.operations.hold(Person("Olga", Role.OPERATOR), ["R001-002"], "painted")
            errors.append(float(np.nanmax(first.operations.viewer.frame().error)))
            await first.end()
        assert known
        # The next program, and boards that know nothing.
        idle = replace(EXACT, work=AutomaticSettings(calibrate=True))
        second = LivePlant(design, clock, idle, records=keeper)
        assert [hold.name for hold in second.operations.automatic.service.out] == ["R001-002"]
        assert second.operations.automatic.view().done == len(known)
        rows = [second.plant.field.place(name) for name in known]
        async with second.running():
            before = second.errors()[rows]
            await asyncio.sleep(40.0)
            # The plant has pushed what it remembers.
            assert second.errors()[rows].max() < 0.5 * before.max()
            await second.end()
        assert len(keeper.visits(100)) >= len(known)
        keeper.close()

    run_virtual(main, start=START)
    assert 0.0 < errors[0] < 6 * MRAD


def test_the_limits_of_the_site_hold_and_their_change_is_recorded(tmp_path: Path) -> None:
    """Four runs: with the defaults, with limits, with the same, and with the defaults again."""
    limits = {
        "wind_gust_defocus": {"trips_m_s": 10.0, "releases_m_s": 8.0},
        "wind_gust_stow": {"trips_m_s": 12.0, "releases_m_s": 9.0},
        "bus_errors": {"trips_percent": 30.0},
    }
    there = {
        "wind_gust_defocus.trips_m_s: 15 → 10",
        "wind_gust_defocus.releases_m_s: 12 → 8",
        "wind_gust_stow.trips_m_s: 20 → 12",
        "wind_gust_stow.releases_m_s: 15 → 9",
        "bus_errors.trips_percent: 20 → 30",
    }
    back = {re.sub(r"(\S+) → (\S+)", r"\2 → \1", line) for line in there}
    feeding = replace(EXACT, plant=PlantSettings(sensors=frozenset({"wind_gust"})))

    async def main(clock: VirtualClock) -> None:
        keeper = Keeper(tmp_path, inline=True)
        for safety, changes in (({}, set()), (limits, there), (limits, set()), ({}, back)):
            keeper.keep_emergency("")  # each run is a plant of its own
            design = replace(lay_out("radial", 3), safety=safety)
            audit = KeptAudit(keeper, clock, START)
            plant = LivePlant(design, clock, feeding, records=keeper, audit=audit)
            events = plant.operations.logbook.events(50)
            assert {event.text for event in events if event.kind == "safety"} == changes
            async with plant.running():
                await asyncio.sleep(5.0)
                plant.plant.put("wind_gust", 13.0)
                await asyncio.sleep(1.0)
                active = [
                    alarm.condition for alarm in plant.operations.logbook.alarms() if alarm.active
                ]
                assert ("wind_gust_stow" in active) == bool(safety)
                await plant.end()
        with keeper.database.reading() as connection:
            noted = [one for one in entries(connection, 1000) if one.what == "LIMITS"]
        assert {(one.who, one.note) for one in noted} == {("plant file", n) for n in there | back}
        keeper.close()

    run_virtual(main, start=START)


def test_a_live_camera_shows_what_it_saw() -> None:
    design = lay_out("radial", 6)
    target, camera = design.targets[0], design.cameras[0]
    light = normalize(np.array([0.2, 0.6, 0.7]))
    vertex = design.position[0] + [0.0, 0.0, 2.0]
    point = target.point(np.array([0.5, -0.3]))
    mirror = TrueMirror("A", vertex, bisector(light, normalize(point - vertex)), 2.5, 2.0)
    there: list[TrueMirror] = []

    async def main(clock: VirtualClock) -> None:
        sight = FieldSnapshot(clock, lambda: tuple(there), lambda: light)
        eye = RenderedCamera(sight, [Scene(camera, (target,))])
        assert eye.view(target.name).version == 0
        await eye.look(target.name)
        there.append(mirror)
        shot = await eye.photograph(target, "A")
        assert shot.reasons == ()
        assert np.linalg.norm(shot.point - point) < 0.05
        view = eye.view(target.name)
        assert view.version == 2
        assert view.jpeg[:2] == b"\xff\xd8"
        assert view.centroid == pytest.approx((0.5, -0.3), abs=0.05)
        with pytest.raises(InputError, match="a beam is on it"):
            await eye.look(target.name)
        eye.close()

    run_virtual(main)


def test_what_a_live_plant_refuses() -> None:
    design = lay_out("radial", 6)
    (group,) = design.groups.values()

    async def main(clock: VirtualClock) -> None:
        mixed = replace(group, cluster=("A", "B", "A", "B", "A", "B"))
        with pytest.raises(InputError, match="cluster A are not consecutive"):
            LivePlant(replace(design, groups={"a": mixed}), clock, EXACT)
        with pytest.raises(InputError, match="no camera with a known position"):
            LivePlant(replace(design, cameras=()), clock, LiveOptions(threads=0))
        with pytest.raises(InputError, match=r"no table \[groups.a.machine\]; add it"):
            LivePlant(replace(design, groups={"a": replace(group, machines=())}), clock, EXACT)
        slow = replace(group.machines[0], stow=(0, 0))
        homeless = replace(group, machines=(replace(slow, standby=None),) * 6)
        with pytest.raises(InputError, match="R001-001 has no standby point; set standby_m"):
            LivePlant(replace(design, groups={"a": homeless}), clock, EXACT)
        with pytest.raises(InputError, match=r"centroid variance must be 0 or more, not -1\.0 m²"):
            WorldOptions(centroid=-1.0)

    run_virtual(main)


@pytest.mark.parametrize(
    ("boards", "key"),
    [(False, b""), (True, b""), (True, BUS_KEY)],
    ids=["field", "boards", "boards-signed"],
)
def test_an_emergency_of_the_twin_is_proven_with_its_flux(boards: bool, key: bytes) -> None:
    """No false alarm of flux; a mirror that stays on the receiver is a true one."""
    two = lay_out("radial", 2)
    quiet = AutomaticSettings(wanted=True, calibrate=False)
    idle = replace(EXACT, boards=boards, bus_key=key, work=quiet)

    async def work(live: LivePlant) -> None:
        plant, sensor = live.plant, live.world.flux
        assert sensor is not None
        assert "flux_after_emergency" not in plant.sentinel.table.unwatched
        await asyncio.sleep(100.0)
        assert plant.field.among((states.TRACKING,), plant.now()).all(), plant.field.counted()
        assert sensor.share() > 0.9
        order = plant.raise_emergency("Olga")
        await asyncio.sleep(29.0)
        assert sensor.share() == 0.0
        report = order.report(plant.now())
        assert report.flux is FluxProof.BELOW
        assert report.complete
        assert "reports that it is done; measured: the flux is below its limit" in report.text
        await asyncio.sleep(10.0)
        assert not [row for row in live.operations.logbook.alarms() if "flux" in row.condition]

    play(work, two, idle)


def test_the_flux_sensor_sees_a_mirror_that_stays() -> None:
    field = LivePlant(lay_out("radial", 4), VirtualClock(start=START), EXACT).world
    assert field.flux is not None
    receiver = field.design.receivers[0].center
    normal, vertex = field.field.stand()
    light = field.sun()
    onto = bisector(light, normalize(receiver - vertex))
    for count in range(5):
        normal[:count] = onto[:count]
        assert light_share(normal, vertex, light, receiver, 1.0) == pytest.approx(
            count / 4, abs=0.1
        )
    night = LivePlant(lay_out("radial", 4), VirtualClock(start=NIGHT), EXACT).world
    assert night.flux is not None
    assert night.flux.share() == 0.0
