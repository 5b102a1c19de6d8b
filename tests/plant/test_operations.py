"""A plant at work: what it shows, whom it obeys, and that its own work survives failures."""

import asyncio
import math
from collections.abc import Awaitable, Callable
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.layouts import lay_out
from heliotrope.field.target import Receiver, Target
from heliotrope.field.volumes import Sphere
from heliotrope.geometry import normalize
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.link import SendOutcome, Statistics
from heliotrope.links.messages import Ask, ClusterStatus, Lease, encode
from heliotrope.optics import air_loss, intercept_rectangle, predict_flux
from heliotrope.plant.authority import Person, RefusedError, Role
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.visits.photographs import Shot, seen, spiral
from heliotrope.plant.visits.settings import Centring
from heliotrope.safety import Alarm, Severity
from heliotrope.store.records import StoreError
from support.live import LiveOptions, LivePlant

MRAD = 1e-3
ENGINEER, OPERATOR, VIEWER = (
    Person("Egon", Role.ENGINEER),
    Person("Olga", Role.OPERATOR),
    Person("Vera", Role.VIEWER),
)
START = datetime(2026, 10, 21, 7, tzinfo=UTC)
RECEIVER = Receiver("R", "planar", np.array([0.0, 0.0, 60.0]), np.array([0.0, -1.0, 0.0]), 6.0, 5.0)
UP = np.array([0.0, 0.0, 1.0])


# -- flux --------------------------------------------------------------------------------------


def test_a_beam_along_the_axis_has_the_known_intercept_and_power() -> None:
    vertex, light = np.array([[0.0, -200.0, 60.0]]), normalize(np.array([0.0, 1.0, 1.0]))
    view = predict_flux(RECEIVER, vertex, RECEIVER.center[None], [5.0], [2e-3], sun=light)
    sigma = 200.0 * math.sqrt(2.325e-3**2 + (2 * 1e-3) ** 2 + (2 * 2e-3 / math.sqrt(2)) ** 2)
    assert view.intercept == pytest.approx(float(intercept_rectangle(6.0, 5.0, sigma)), abs=1e-5)
    # The ray goes north and the sun is 45° above it: the mirror sees it under 22.5°.
    cosine = math.cos(math.radians(22.5))
    all_light = 5.0 * 900.0 * 0.9 * cosine * (1.0 - float(air_loss(200.0)))
    assert view.power == pytest.approx(all_light * view.intercept, rel=1e-5)
    cell = (view.right[1] - view.right[0]) * (view.up[1] - view.up[0])
    assert view.power <= float(view.flux.sum() * cell) <= all_light * (1.0 + 1e-6)
    assert view.heliostats == 1


def test_an_oblique_beam_is_as_wide_as_rays_say() -> None:
    vertex, light = np.array([[90.0, -80.0, 2.0]]), normalize(np.array([0.2, -0.5, 0.8]))
    view = predict_flux(RECEIVER, vertex, RECEIVER.center[None], [5.0], [1e-3], sun=light)
    ray = normalize(RECEIVER.center - vertex[0])
    slant = float(np.linalg.norm(RECEIVER.center - vertex[0]))
    sigma = slant * math.sqrt(2.325e-3**2 + 4e-6 + 2e-6)
    rng = np.random.default_rng(1)
    across = rng.normal(0.0, sigma, (200_000, 3))
    across -= (across @ ray)[:, None] * ray
    # Where rays beside the middle one meet the plane y = 0.
    places = across - (across[:, 1] / ray[1])[:, None] * ray
    inside = (np.abs(places[:, 0]) < 3.0) & (np.abs(places[:, 2]) < 2.5)
    assert view.intercept == pytest.approx(float(inside.mean()), abs=0.01)
    right = float((view.flux.sum(axis=0) @ view.right**2) / view.flux.sum())
    assert right == pytest.approx(np.mean(places[np.abs(places[:, 0]) < 4.5, 0] ** 2), rel=0.05)


@settings(max_examples=20, deadline=None)
@given(st.floats(-4.0, 4.0), st.floats(-4.0, 4.0), st.floats(0.0, 5e-3))
def test_the_map_is_mirrored_with_the_aim(right: float, up: float, error: float) -> None:
    light = normalize(np.array([0.0, -0.6, 0.8]))
    vertex = np.array([[0.0, -150.0, 60.0]])
    views = [
        predict_flux(
            RECEIVER, vertex, RECEIVER.center + [[side * right, 0.0, up]], [5.0], [error], sun=light
        )
        for side in (1.0, -1.0)
    ]
    assert np.allclose(views[0].flux, views[1].flux[:, ::-1], rtol=1e-3, atol=1e-2)
    assert 0.0 <= views[0].intercept <= 1.0


def test_light_that_is_none() -> None:
    light = normalize(np.array([0.0, -0.6, 0.8]))
    nothing = predict_flux(RECEIVER, np.empty((0, 3)), np.empty((0, 3)), [], [], sun=light)
    assert nothing.power == 0.0
    assert math.isnan(nothing.intercept)
    assert not nothing.flux.any()
    behind = predict_flux(
        RECEIVER, [[0.0, 100.0, 2.0]], RECEIVER.center[None], [5.0], [0.0], sun=light
    )
    assert behind.heliostats == 0
    night = predict_flux(
        RECEIVER, [[0.0, -100.0, 2.0]], RECEIVER.center[None], [5.0], [0.0], sun=-UP
    )
    assert night.power == 0.0
    with pytest.raises(InputError, match="2 vertices, 1 aims"):
        predict_flux(RECEIVER, np.zeros((2, 3)), np.zeros((1, 3)), [1.0], [0.0], sun=UP)
    with pytest.raises(InputError, match=r"the reflectivity 1\.5"):
        predict_flux(
            RECEIVER,
            [[0.0, -9.0, 2.0]],
            RECEIVER.center[None],
            [5.0],
            [0.0],
            sun=UP,
            reflectivity=1.5,
        )


# -- searching ---------------------------------------------------------------------------------


@given(st.integers(1, 60))
def test_a_spiral_visits_each_place_once_and_the_near_ones_first(count: int) -> None:
    places = [(0, 0), *spiral(count)]
    assert len(set(places)) == count + 1
    rings = [max(abs(x), abs(y)) for x, y in places]
    assert rings == sorted(rings)
    steps = np.abs(np.diff(places, axis=0)).sum(axis=1)
    assert (steps == 1).all()


def test_only_light_on_the_target_is_seen() -> None:
    corners = np.array([[-2.0, 0.0, 12.0], [2.0, 0.0, 12.0], [2.0, 0.0, 8.0], [-2.0, 0.0, 8.0]])
    target = Target("T", corners, np.array([0.0, 0.0, 10.0]))
    inside = seen(target, Shot(target.point(np.array([1.9, -1.9])), 0.0))
    assert inside is not None
    assert np.allclose(inside, [1.9, -1.9])
    # A simulated camera tells where the beam is although it is beside the target.
    assert seen(target, Shot(target.point(np.array([2.1, 0.0])), 0.0)) is None
    assert seen(target, Shot(np.full(3, np.nan), 0.0)) is None
    with pytest.raises(InputError, match="centring: pitch 0"):
        Centring(pitch=0.0)


# -- the book of what happened -------------------------------------------------------------------


class _Silent:
    """A link that takes everything."""

    name, connected, closed, silent_for, problem = "C1", True, False, 0.0, ""
    statistics = Statistics()

    async def run(self) -> None:
        """Nothing to do."""

    async def send(
        self, data: bytes, *, expires: float | None = None, hold: bool = False
    ) -> SendOutcome:
        del data, expires, hold
        return SendOutcome.SENT

    async def receive(self) -> bytes:
        return encode(ClusterStatus("C1", 0, 0.0, "gps", 0.0, 2.5, 0.3))

    async def close(self) -> None:
        """Nothing to do."""


def test_a_book_counts_alarms_until_they_are_over_and_acknowledged() -> None:
    clock = VirtualClock()
    book = Logbook(clock)
    book.take_alarm(Alarm("wind", "", Severity.ALARM, "too strong"))
    clock.advance(5.0)
    book.take_alarm(Alarm("wind", "", Severity.ALARM, "stronger still"))
    (row,) = book.alarms()
    assert (row.count, row.text, book.open_alarms) == (1, "stronger still", 1)
    book.acknowledge("Olga", "wind", "")
    assert book.open_alarms == 1, "it holds still"
    book.take_alarm(Alarm("wind", "", Severity.ALARM, "over", active=False))
    assert book.open_alarms == 0
    clock.advance(5.0)
    book.take_alarm(Alarm("wind", "", Severity.ALARM, "again"))
    (row,) = book.alarms()
    assert (row.count, row.acknowledged_by, book.open_alarms) == (2, "", 1)
    assert [event.text for event in book.events(9)] == [
        "wind: again",
        "wind: over (over)",
        "wind: too strong",
    ]
    assert len(book.events(1)) == 1


def test_a_book_keeps_packets_but_of_steady_ones_the_last() -> None:
    clock = VirtualClock()
    book = Logbook(clock)
    links = book.tapped({"C1": _Silent(), "C2": _Silent()})

    async def main() -> None:
        for _ in range(3):
            await links["C1"].send(encode(Lease(7)))
            await links["C1"].receive()
            clock.advance(1.0)
        await links["C2"].send(encode(Ask("a-1", "statistics")))

    asyncio.run(main())
    assert [(p.cluster, p.way, p.kind) for p in book.packets(9)] == [("C2", "to", "ask")]
    of_one = book.packets(9, "C1")
    assert sorted((p.way, p.kind) for p in of_one) == [("from", "status"), ("to", "lease")]
    assert '"token":7' in next(p.text for p in of_one if p.kind == "lease")


class _Full:
    """A store that cannot keep anything."""

    def __getattr__(self, name: str) -> Callable[..., None]:
        def refuse(*values: object, **named: object) -> None:
            raise StoreError(f"{name}: the disk is full")

        return refuse


def test_a_store_that_keeps_nothing_is_an_alarm_and_stops_nothing() -> None:
    book = Logbook(VirtualClock(), _Full())  # type: ignore[arg-type]
    book.event("plant", "", "something")
    book.take_alarm(Alarm("wind", "", Severity.ALARM, "too strong"))
    found = {row.condition: row.text for row in book.alarms()}
    assert "the disk is full" in found["records"]
    assert found["wind"] == "too strong"
    assert book.is_plain("records")
    assert not book.is_plain("wind")


# -- a plant at work -----------------------------------------------------------------------------


def live(
    work: Callable[[LivePlant], Awaitable[None]],
    settings: AutomaticSettings,
    keep_out: tuple[int, float] | None = None,
) -> None:
    """Run four heliostats on two clusters in virtual time.

    ``keep_out``: a volume stands in the way of one of them to the receiver, at a share of it.
    """
    design = lay_out("radial", 4)
    if keep_out is not None:
        row, share = keep_out
        middle = design.receivers[0].center
        place = design.position[row] + share * (middle - design.position[row])
        design = replace(design, keep_outs=(Sphere("mast", place, 0.2),))
    (group,) = design.groups.values()
    group = replace(group, cluster=("C1", "C1", "C2", "C2"))
    options = LiveOptions(rendered=False, threads=0, work=settings)

    async def main(clock: VirtualClock) -> None:
        made = LivePlant(replace(design, groups={"azel": group}), clock, options)
        async with made.running() as plant:
            await asyncio.sleep(4.0)
            await work(plant)
            await plant.end()

    run_virtual(main, start=START)


def test_whose_beam_has_no_way_is_named_and_the_others_join() -> None:
    async def work(plant: LivePlant) -> None:
        shown, name = plant.operations, plant.names[3]
        await asyncio.sleep(600.0)
        field = plant.plant.field
        found = {each: field.of(each, plant.plant.now()).state for each in plant.names}
        assert found.pop(name) == "IDLE"
        assert set(found.values()) == {"TRACKING"}
        (alarm,) = [a for a in shown.alarms() if a.condition == "beam_blocked"]
        assert alarm.subject == name
        assert "the beam enters mast" in alarm.text
        # Whoever takes it elsewhere has seen to it; it comes back, and is named again.
        shown.stow(VIEWER, (name,))
        await asyncio.sleep(60.0)
        assert not [a for a in shown.alarms() if a.condition == "beam_blocked" and a.active]
        shown.give_back(OPERATOR, (name,))
        await asyncio.sleep(900.0)
        assert field.of(name, plant.plant.now()).state == "IDLE"
        assert [a for a in shown.alarms() if a.condition == "beam_blocked" and a.active]
        # What was in the way is gone: within five minutes it joins, and the alarm is over.
        plant.plant.beams.volumes = ()
        await asyncio.sleep(330.0)
        assert field.of(name, plant.plant.now()).state == "TRACKING"
        assert not [a for a in shown.alarms() if a.condition == "beam_blocked" and a.active]

    live(work, AutomaticSettings(wanted=True, calibrate=False, margin=0.0), keep_out=(3, 0.3))


def test_what_a_plant_shows() -> None:
    async def work(plant: LivePlant) -> None:
        shown = plant.operations
        frame = shown.frame()
        assert shown.frame() is frame
        assert (frame.state == 1).all()
        assert frame.truth_error is not None
        assert frame.error.dtype == np.float32
        assert np.isnan(frame.error).all()
        with pytest.raises(ValueError, match="read-only"):
            frame.state[0] = 3
        await asyncio.sleep(1.5)
        assert shown.frame().number == frame.number + 1
        assert shown.aim_names == ("", "receiver", "left", "right", "elsewhere")
        assert shown.clusters == ("C1", "C2")
        assert shown.sizes.shape == (4, 2)
        summary = shown.summary()
        assert summary.states == {"STOWED": 4}
        assert summary.clusters_alive == 2
        rows = shown.cluster_rows()
        assert [row.alive and row.connected and row.live == 2 for row in rows] == [True, True]
        one = shown.heliostat(shown.names[1])
        assert (one.state, one.cluster, one.on, len(one.drives)) == ("STOWED", "C1", "", 2)
        assert one.parameters["tilt_north"].sigma == pytest.approx(10 * MRAD)
        assert one.truth_error == pytest.approx(float(plant.errors()[1]), rel=0.05)
        light = shown.sun()
        assert light.elevation == pytest.approx(math.asin(light.direction[2]), abs=1e-6)
        assert shown.receiver_flux().power == 0.0
        assert shown.camera("left").version == 0
        for wrong in (shown.heliostat, shown.camera, shown.receiver_flux):
            with pytest.raises(UnknownNameError):
                wrong("nobody")
        # A cluster that falls silent is shown as that, and its heliostats as stale.
        plant.links["C2"].plugged = False
        await asyncio.sleep(6.0)
        assert list(shown.frame().state) == [1, 1, 255, 255]
        assert [row.alive for row in shown.cluster_rows()] == [True, False]
        assert shown.heliostat(shown.names[3]).state == ""
        assert shown.summary().states == {"STOWED": 2, "stale": 2}

    live(work, AutomaticSettings(calibrate=False))


def test_persons_come_before_the_automat() -> None:
    async def work(plant: LivePlant) -> None:
        shown, names = plant.operations, plant.operations.names
        assert shown.summary().holder == "automatic control"
        with pytest.raises(RefusedError, match="Vera is viewer"):
            shown.take_authority(VIEWER)
        for refused in (
            lambda: shown.hold(VIEWER, names[:1], "why"),
            lambda: shown.switch_calibration(VIEWER, False),
            lambda: shown.give_back(VIEWER),
            lambda: shown.acknowledge(VIEWER, "records"),
        ):
            with pytest.raises(RefusedError, match="it needs operator"):
                refused()
        with pytest.raises(RefusedError, match="a reason is needed"):
            shown.hold(OPERATOR, names[:1], " ")
        shown.hold(OPERATOR, names[:1], "painted")
        assert list(shown.frame().held) == [True, False, False, False]
        shown.unhold(OPERATOR, names[:1])
        assert shown.holds() == ()
        # An operator takes over although the automat is an engineer, and gives back.
        grant = shown.take_authority(OPERATOR)
        assert shown.summary().holder == "Olga"
        assert shown.calibration().reason == "it is switched off"
        shown.command(OPERATOR, grant.token, "APPROACH", names[:1])
        for _ in range(9):
            await asyncio.sleep(5.0)
            shown.keep_authority(OPERATOR, grant.token)
        assert shown.heliostat(names[0]).state == "IDLE"
        shown.stow(OPERATOR, names[:2])
        shown.release_authority(OPERATOR, grant.token)
        with pytest.raises(RefusedError):
            shown.keep_authority(OPERATOR, grant.token)
        # What she stowed stays stowed, the others are raised.
        await asyncio.sleep(75.0)
        states = [shown.heliostat(name).state for name in names]
        assert states == ["STOWED", "STOWED", "TRACKING", "TRACKING"]
        assert shown.frame().on[2] == 1
        assert shown.receiver_flux("receiver").heliostats == 2
        shown.give_back(OPERATOR, names[1:2])
        await asyncio.sleep(60.0)
        assert shown.heliostat(names[1]).state in ("IDLE", "TRACKING")
        # After an emergency nothing moves by itself.
        shown.emergency(VIEWER, "STOW", "a fire")
        await asyncio.sleep(60.0)
        view = shown.emergency_view()
        assert (view.on, view.act, view.done) == (True, "STOW", 4)
        assert shown.summary().emergency
        shown.withdraw(OPERATOR)
        await asyncio.sleep(20.0)
        assert shown.summary().states == {"STOWED": 4}
        with pytest.raises(UnknownNameError, match="act of an emergency"):
            shown.emergency(VIEWER, "DANCE")
        assert any("EMERGENCY STOW: a fire" in event.text for event in shown.events())

    live(work, AutomaticSettings(wanted=True, calibrate=False))


def test_the_work_survives_a_camera_that_fails() -> None:
    async def work(plant: LivePlant) -> None:
        eye, real = plant.cameras, type(plant.cameras).photograph
        failures = 0

        async def broken(target: Target, heliostat: str) -> Shot:
            nonlocal failures
            failures += 1
            if failures <= 2:
                raise OSError("the cable is loose")
            return await real(eye, target, heliostat)

        eye.photograph = broken  # type: ignore[method-assign]
        await asyncio.sleep(160.0)
        events = [event.text for event in plant.operations.events(1000)]
        assert any("OSError: the cable is loose" in text for text in events)
        # It has worked again since.
        assert not any(row.active for row in plant.operations.alarms())
        view = plant.operations.calibration()
        assert view.done >= 1
        one = plant.operations.heliostat(view.results[-1].heliostat)
        assert one.history
        assert one.results
        assert one.error < 6 * MRAD
        assert one.parameters["tilt_north"].sigma < 10 * MRAD

    live(work, AutomaticSettings(wanted=True))


def test_work_settings_that_are_none() -> None:
    with pytest.raises(InputError, match="heliostats a second, a beat of"):
        AutomaticSettings(rate=0.0)
