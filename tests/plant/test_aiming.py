"""Aims under a flux limit in a plant at work: the true flux stays within the limit."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace

import numpy as np
import pytest

from heliotrope.aims.heating import Heating
from heliotrope.aims.rounds import Heat, Move, forget
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.aim_settings import AimSettings
from heliotrope.field.flux_limit import FluxLimit
from heliotrope.field.layouts import lay_out
from heliotrope.geometry import FloatArray, as_float
from heliotrope.lcu import states
from heliotrope.mechanism.chain import Mechanism
from heliotrope.optics.receiver_flux import FieldFlux
from heliotrope.optics.surfaces import surface_of
from heliotrope.plant.emergency import DNI_READING
from heliotrope.plant.operations import aiming
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.operations.views import Button
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.plant.settings import PlantSettings
from heliotrope.plant.workers import at_once
from heliotrope.twin.sensors import FluxSensor
from support.live import LiveOptions, LivePlant, play

COUNT = 6
LIMIT = 70e3
#: Of the receiver, W.
NOMINAL = 1e5


def exact(mechanism: Mechanism) -> Mechanism:
    """Return mirrors that stand as designed: beams hit their aims."""
    return mechanism


def played(
    work: Callable[[LivePlant], Awaitable[None]],
    limit: float = LIMIT,
    sensors: tuple[str, ...] = (),
    *,
    sideways: bool = False,
    **changes: object,
) -> None:
    """Run a small field in virtual time, with a flux limit."""
    # A plant computes aims in a process of its own, which knows no earlier plant.
    forget()
    design = lay_out("radial", COUNT)
    (name,) = design.groups
    half = COUNT // 2
    group = replace(design.groups[name], cluster=("C1",) * half + ("C2",) * half)
    settings: dict[str, object] = {"probability": 0.95, "moves": 60.0, "every": 15.0}
    aims = AimSettings("limit", FluxLimit(limit, 0.05), **(settings | changes))  # type: ignore[arg-type]
    work_settings = AutomaticSettings(wanted=True, calibrate=False)
    plant = PlantSettings(sensors=frozenset(sensors))
    options = LiveOptions(
        rendered=False, threads=0, work=work_settings, installed=exact, plant=plant
    )

    async def later(made: LivePlant) -> None:
        await asyncio.sleep(4.0)
        await work(made)

    (receiver,) = design.receivers
    receivers = (replace(receiver, nominal_power=NOMINAL),)
    if sideways:
        east = np.array([1.0, 0.0, 0.0])
        receivers = (replace(receivers[0], normal=east, corners=None),)
    design = replace(design, groups={name: group}, aims=aims, receivers=receivers)
    play(later, design, options)


def true_flux(made: LivePlant, only: int | None = None) -> FloatArray:
    """Return the flux of the true mirrors, W/m²: where the motors are, by the true mechanism.

    ``only``: the row of a heliostat; None: all.
    """
    scene = made.operations._flux.scene(made.plant.now())
    on = made.plant.field.among((states.TRACKING,), made.plant.now())
    if only is not None:
        on = on & (np.arange(len(on)) == only)
    normal, center = made.field.stand()
    mirrors = replace(
        scene.mirrors, normal=normal, center=center, pointing=0.0 * scene.mirrors.pointing
    )
    surface = surface_of(made.design.receivers[0])
    given = replace(scene, mirrors=mirrors, surfaces=(surface,), dni=1000.0, dark=~on)
    return FieldFlux(given).maps[0]


async def greatest(made: LivePlant, seconds: float, every: float = 3.0) -> float:
    """Return the greatest true flux in a time, W/m²."""
    most = 0.0
    for _ in range(int(seconds / every)):
        await asyncio.sleep(every)
        most = max(most, float(true_flux(made).max()))
    return most


def in_the_middle(made: LivePlant) -> float:
    """Return the greatest flux with all beams in the middle, W/m²."""
    scene, receiver = made.operations._flux.scene(made.plant.now()), made.design.receivers[0]
    mirrors = replace(scene.mirrors, pointing=0.0 * scene.mirrors.pointing)
    mirrors = mirrors.toward(scene.sun, receiver.center)
    surface = surface_of(receiver)
    given = replace(scene, mirrors=mirrors, surfaces=(surface,), dni=1000.0, dark=None)
    return float(FieldFlux(given).maps[0].max())


async def up(made: LivePlant) -> None:
    """Wait until all that have an aim track."""
    for _ in range(60):
        await asyncio.sleep(2.0)
        aims = made.operations.automatic.aims
        tracks = made.plant.field.among((states.TRACKING,), made.plant.now())
        if aims and tracks.sum() == len(aims):
            return
    raise AssertionError(made.operations.aims())


def test_the_true_flux_holds_the_limit_which_the_middle_passes() -> None:
    async def scene(made: LivePlant) -> None:
        await up(made)
        assert in_the_middle(made) > 1.3 * LIMIT
        assert await greatest(made, 40.0) <= LIMIT
        view = made.operations.aims()
        assert (view.strategy, view.source, view.problem) == ("limit", "optimiser", "")
        assert view.reserve >= -0.005
        assert view.peak <= 1.005 * view.limit
        assert view.aimed >= 4
        # Errors in cells at the limit cost power; those of beams elsewhere cost nothing.
        worth = made.plant.worth
        assert worth.mean() == pytest.approx(2.0)
        assert worth.min() >= 1.0
        assert worth.max() > 1.2 * worth.min()

    played(scene)


def test_a_heliostat_that_leaves_makes_room_and_a_person_s_beam_stays() -> None:
    async def scene(made: LivePlant) -> None:
        await up(made)
        plant, operations = made.plant, made.operations
        lost = made.names[0]
        person = Person("Operator", Role.OPERATOR)
        operations.stow(person, (lost,))
        assert await greatest(made, 40.0, 4.0) <= LIMIT
        aims = operations.automatic.aims
        assert lost not in aims
        assert len(aims) == COUNT - 1
        # A person's aim stays although the optimiser would choose another.
        operations.automatic.give_way()
        token = plant.take_authority(person).token
        name = sorted(aims)[0]
        point = plant.design.receivers[0].center + np.array([0.0, 0.0, 0.9])
        await operations.aim(person, token, {name: point}).end(30.0)
        plant.release_authority(person, token)
        assert await greatest(made, 45.0, 5.0) <= LIMIT
        np.testing.assert_allclose(plant.aims[plant.field.place(name)], point)

    played(scene)


class Kept:
    """A store that names the beams that people have aimed."""

    aimed: tuple[str, ...] = ()

    def aimed_by_people(self) -> tuple[str, ...]:
        return self.aimed

    def keep_aimed_by_people(self, heliostats: tuple[str, ...]) -> None:
        self.aimed = heliostats


def test_a_person_s_beam_stays_the_person_s_after_a_restart() -> None:
    async def scene(made: LivePlant) -> None:
        await up(made)
        plant, operations, kept = made.plant, made.operations, Kept()
        first, second = sorted(operations.automatic.aims)[:2]

        def program() -> aiming.Aiming:
            """Return the aiming of a program that has just begun."""
            given = operations.automatic, operations.flux_check, at_once
            new = aiming.Aiming(plant, operations.logbook, *given, kept)  # type: ignore[arg-type]
            new.recall()
            return new

        before = program()
        assert before._movers(plant.now())[plant.field.place(first)]
        before.by_person((first, second), aimed=True)
        before.by_person((second,), aimed=False)
        assert kept.aimed == (first,)
        after = program()
        assert not after._movers(plant.now())[plant.field.place(first)]
        assert after._movers(plant.now())[plant.field.place(second)]
        now = after._round(plant.now())
        np.testing.assert_allclose(
            now.fixed[plant.field.place(first)], plant.aims[plant.field.place(first)]
        )
        after.by_person((), aimed=False)
        assert kept.aimed == ()

    played(scene)


def test_a_limit_that_no_aims_hold_keeps_the_field_at_standby_with_an_alarm() -> None:
    async def scene(made: LivePlant) -> None:
        assert await greatest(made, 60.0, 10.0) == 0.0
        view = made.operations.aims()
        assert (view.aimed, view.resting) == (0, COUNT)
        (alarm,) = [a for a in made.operations.logbook.alarms() if a.condition == "aims"]
        assert alarm.active
        assert "does not allow even the beam with the lowest peak; row " in alarm.text
        assert "above its 0.095; raise the limit there to " in alarm.text
        assert "\n" not in alarm.text

    played(scene, 100.0)


def test_a_limit_that_no_aims_hold_later_leaves_the_last_good_aims(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def scene(made: LivePlant) -> None:
        await up(made)
        await asyncio.sleep(40.0)
        aims = made.operations._aiming._automatic.aims
        before = set(aims)
        assert before
        with monkeypatch.context() as patch:
            patch.setattr(aiming.Aiming, "_allowed", lambda self, limit, scene: FluxLimit(100.0))
            await asyncio.sleep(40.0)
        view = made.operations.aims()
        assert view.source == "last good aims"
        assert "does not allow even the beam" in view.problem
        assert set(aims) == before
        await asyncio.sleep(30.0)
        assert made.operations.aims().source == "optimiser"

    played(scene)


@pytest.mark.parametrize("blocked", [0, 1])
def test_beams_that_a_program_finds_leave_where_no_aims_ever_hold_the_limit(
    monkeypatch: pytest.MonkeyPatch, blocked: int
) -> None:
    """As after a restart with a wrong limit in the plant file; some may not go to standby."""

    async def scene(made: LivePlant) -> None:
        await up(made)
        part = made.operations._aiming
        kept = sorted(made.operations.automatic.aims)[:blocked]
        monkeypatch.setattr(
            made.plant.guards.identities, "blocked", lambda name: "a test" if name in kept else None
        )
        monkeypatch.setattr(aiming.Aiming, "_allowed", lambda self, limit, scene: FluxLimit(100.0))
        part._answer, part._source = None, ""
        await asyncio.sleep(60.0)
        assert made.operations.aims().source == ""
        assert texts(made, "flux_above_limit", active=True)
        assert true_flux(made).max() > 0.0
        await asyncio.sleep(150.0)
        assert made.operations.aims().source == "safe spread"
        assert true_flux(made).max() == 0.0

    played(scene, deadline=30.0)


def test_heliostats_that_reach_no_cell_are_named_and_stay_at_standby() -> None:
    async def scene(made: LivePlant) -> None:
        await asyncio.sleep(90.0)
        east = made.plant.beams.position[:, 0]
        behind = {name for name, x in zip(made.plant.field.names, east, strict=True) if x < -1.0}
        assert behind
        assert set(made.operations.aims().unlit) == behind
        on = made.plant.field.among((states.TRACKING,), made.plant.now())
        assert behind.isdisjoint(np.array(made.plant.field.names)[on])
        assert on.any()

    played(scene, sideways=True)


def test_while_an_operator_commands_the_flux_is_watched_and_nothing_moves() -> None:
    async def scene(made: LivePlant) -> None:
        await up(made)
        plant, operations = made.plant, made.operations
        person = Person("Olga", Role.OPERATOR)
        aims = tuple(sorted(operations.automatic.aims))
        operations.automatic.give_way()
        token = plant.take_authority(person).token
        middle = plant.design.receivers[0].center
        await operations.aim(person, token, dict.fromkeys(aims, middle)).end(30.0)
        for _ in range(4):
            await asyncio.sleep(5.0)
            plant.authority.keep(person, token)
        most, view = float(true_flux(made).max()), operations.aims()
        assert most > LIMIT
        assert view.idle == "Olga has the command authority"
        assert view.at <= 16.0
        assert view.peak == pytest.approx(most, rel=0.1)
        assert view.reserve == pytest.approx(1.0 - view.peak / view.limit)
        assert view.by_hand == aims
        why = operations.why(aims[0])
        assert why.text == (
            f"{aims[0]} is TRACKING on receiver: an operator has aimed it, so its beam stays there"
        )
        assert why.button is Button.AUTOMATIC
        (text,) = texts(made, "flux_above_limit", active=True)
        assert "the predicted flux is up to" in text
        np.testing.assert_allclose(
            plant.aims[[plant.field.place(name) for name in aims]], [middle] * len(aims)
        )
        operations.emergency(person)
        await asyncio.sleep(30.0)
        view = operations.aims()
        assert (view.peak, view.power) == (0.0, 0.0)
        assert view.idle == "an emergency is active"
        assert not texts(made, "flux_above_limit", active=True)

    played(scene)


def test_aims_are_chosen_as_soon_as_automatic_control_may_move_the_field() -> None:
    async def scene(made: LivePlant) -> None:
        await up(made)
        operations, olga = made.operations, Person("Olga", Role.OPERATOR)
        token = operations.take_authority(olga).token
        while not np.isnan(operations.aims().planned):  # until a round has found her in command
            operations.plant.authority.keep(olga, token)
            await asyncio.sleep(1.0)
        operations.release_authority(olga, token)
        await asyncio.sleep(8.0)
        assert operations.aims().planned > 0.0

    played(scene, every=60.0)


def test_a_late_failure_leaves_the_field_to_the_operator_who_has_just_taken_it() -> None:
    async def scene(made: LivePlant) -> None:
        await up(made)
        part, before = made.operations._aiming, made.plant.aims.copy()
        tracks = made.plant.field.among((states.TRACKING,), made.plant.now())
        made.operations.automatic.give_way()
        made.plant.take_authority(Person("Olga", Role.OPERATOR))
        part._answer, part._good_at = None, -np.inf
        await part._failed("a test")
        assert (made.plant.field.among((states.TRACKING,), made.plant.now()) == tracks).all()
        np.testing.assert_array_equal(made.plant.aims, before)
        assert made.operations.aims().problem == "a test"

    played(scene)


def test_a_beam_is_not_moved_in_a_visit_that_began_after_the_aims_were_chosen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def scene(made: LivePlant) -> None:
        await up(made)
        part, automatic = made.operations._aiming, made.operations.automatic
        first, second = sorted(automatic.aims)[:2]
        visiting = property(lambda self: frozenset({first}))
        for name, moves in ((first, False), (second, True)):
            row = made.plant.field.place(name)
            with monkeypatch.context() as patch:
                patch.setattr(type(automatic), "visiting", visiting)
                moved = automatic.aims[name] + (0.0, 0.0, 0.2)
                await part._go((Move(np.array([row]), moved[None]),))
            assert np.allclose(made.plant.aims[row], moved) == moves

    played(scene)


def test_an_aim_is_refused_in_one_line_that_says_what_to_do() -> None:
    async def scene(made: LivePlant) -> None:
        first, second = made.names[:2]
        points = made.operations._aiming.points
        made.operations.automatic.aims.clear()
        with pytest.raises(UnknownNameError, match="there is no heliostat 'X1'"):
            points(("X1",))
        with pytest.raises(InputError, match=rf"^aim {first}: no aim under the flux limit; give "):
            points((first,))
        with pytest.raises(InputError, match=rf"^aim {first} \(and 1 more\): no aim .* state the"):
            points((first, second))

    played(scene)


def test_beams_on_the_receiver_do_not_count_as_at_rest() -> None:
    async def scene(made: LivePlant) -> None:
        await up(made)
        aims = made.operations.automatic.aims
        on = len(aims)
        assert on > 1
        # As at the start of a program, which has not chosen the aims of the beams that it finds.
        aims.clear()
        view = made.operations.aims()
        assert view.aimed == on
        assert view.resting <= COUNT - on

    played(scene)


def test_with_a_map_limit_and_flux_are_those_of_one_cell() -> None:
    heat = Heat(np.array([[50.0, 10.0]]), np.zeros((1, 2)), np.array([[100.0, 11.0]]), 1.0)
    assert heat.fullest == (10.0, 11.0)
    assert heat.excess == pytest.approx(10.0 / 11.0 - 1.0)


def test_without_answers_the_last_good_aims_stay_and_then_the_safe_spread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def scene(made: LivePlant) -> None:
        await up(made)
        operations, plant = made.operations, made.plant
        before = {name: aim.copy() for name, aim in operations.automatic.aims.items()}

        def broken(*_: object) -> None:
            raise InputError("the plant's computing process has ended")

        monkeypatch.setattr(aiming, "next_round", broken)
        await asyncio.sleep(20.0)
        assert operations.aims().source == "last good aims"
        (alarm,) = [a for a in operations.logbook.alarms() if a.active and a.condition == "aims"]
        assert "has ended" in alarm.text
        await operations._aiming._failed("another cause")
        (alarm,) = [a for a in operations.logbook.alarms() if a.active and a.condition == "aims"]
        assert "another cause" in alarm.text
        assert alarm.count == 1
        for name, aim in before.items():
            np.testing.assert_array_equal(operations.automatic.aims[name], aim)
        assert await greatest(made, 170.0, 6.0) <= LIMIT
        assert operations.aims().source == "safe spread"
        here = plant.field.among((states.TRACKING,), plant.now())
        assert 0 < here.sum() < COUNT
        np.testing.assert_allclose(
            plant.aims[here], plant.design.receivers[0].center[None].repeat(here.sum(), 0)
        )
        monkeypatch.undo()
        await asyncio.sleep(20.0)
        assert operations.aims().source == "optimiser"
        assert not [a for a in operations.logbook.alarms() if a.active and a.condition == "aims"]

    played(scene, deadline=30.0)


class Sky:
    """Puts readings into the plant every few seconds."""

    def __init__(self, made: LivePlant) -> None:
        self.made, self.dni, self.flux = made, 950.0, 1.0

    @contextlib.asynccontextmanager
    async def shining(self) -> AsyncIterator[None]:
        async with asyncio.TaskGroup() as group:
            task = group.create_task(self._shine())
            yield
            task.cancel()

    async def _shine(self) -> None:
        while True:
            self.made.plant.put(DNI_READING, self.dni)
            await asyncio.sleep(3.0)

    def share(self) -> float:
        """Return what a flux sensor says that reads ``flux`` times the true flux."""
        area = float(surface_of(self.made.design.receivers[0]).cells.area.sum())
        mean = 1e-3 * self.dni * float(true_flux(self.made).mean())
        return self.flux * mean * area / NOMINAL


def test_the_receiver_is_heated_in_steps_at_the_start_and_after_a_cloud() -> None:
    ramp, every = 30e3, 15.0

    async def scene(made: LivePlant) -> None:
        sky = Sky(made)
        async with sky.shining():
            seen: list[float] = []

            async def watched(seconds: float) -> list[float]:
                """Return the greatest true flux in full sun, in each period of the ramp."""
                begun = len(seen)
                for _ in range(int(seconds / every)):
                    most = await greatest(made, every)
                    seen.append(0.95 * most)
                return seen[begun:]

            up = await watched(150.0)
            assert up[-1] > 1.5 * ramp
            # One step at the present flux, and one that has just been allowed.
            rises = np.diff([0.0, *up])
            assert rises.max() <= 1.3 * ramp, rises
            sky.dni = 20.0
            cloud = await watched(135.0)
            assert cloud[2] > 0.9 * up[-1], "a short cloud changes nothing"
            assert cloud[-1] <= 1.3 * ramp, "what the sun would bring at once"
            assert cloud[-1] > 0.0, "not the whole field leaves"
            sky.dni = 950.0
            back = await watched(120.0)
            assert np.diff([cloud[-1], *back]).max() <= 1.3 * ramp
            assert back[-1] > 0.9 * up[-1]

    played(scene, sensors=(DNI_READING,), ramp=ramp / every)


def test_after_an_emergency_the_field_returns_along_the_ramp() -> None:
    ramp, every = 30e3, 15.0

    async def scene(made: LivePlant) -> None:
        sky, person = Sky(made), Person("Olga", Role.OPERATOR)
        async with sky.shining():
            await asyncio.sleep(130.0)
            before = await greatest(made, every)
            assert before > 1.5 * ramp
            made.operations.emergency(person)
            await asyncio.sleep(150.0)
            made.operations.withdraw(person)
            await asyncio.sleep(5.0)
            made.operations.resume(person)
            back = [0.95 * await greatest(made, every) for _ in range(16)]
            assert np.diff([0.0, *back]).max() <= 1.3 * ramp, back
            assert back[-1] > 0.9 * before

    played(scene, sensors=(DNI_READING,), ramp=ramp / every)


def test_beams_leave_the_receiver_where_new_motions_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As after many failures: the sun may come back at any time."""
    ramp, every = 30e3, 15.0

    def refuse(heliostats: object) -> None:
        raise RefusedError("IDLE: not accepted now: new motions of the field are refused")

    async def scene(made: LivePlant) -> None:
        sky = Sky(made)
        async with sky.shining():
            await asyncio.sleep(130.0)
            assert await greatest(made, 3.0) > 1.5 * ramp
            monkeypatch.setattr(made.operations.automatic, "rest", refuse)
            sky.dni = 20.0
            await asyncio.sleep(135.0)
            assert float(true_flux(made).max()) <= 1.3 * ramp, "what the sun would bring at once"

    played(scene, sensors=(DNI_READING,), ramp=ramp / every)


def test_a_restart_in_full_sun_takes_no_beam_from_a_warm_receiver() -> None:
    ramp, every = 30e3, 15.0

    async def scene(made: LivePlant) -> None:
        sky = Sky(made)
        async with sky.shining():
            await asyncio.sleep(130.0)
            before = await greatest(made, every)
            assert before > 1.5 * ramp
            # What the program has kept in memory only.
            made.operations._aiming._heating = Heating(ramp / every, every)
            after = [await greatest(made, every) for _ in range(4)]
            assert min(after) > 0.9 * before, after

    played(scene, sensors=(DNI_READING,), ramp=ramp / every)


def test_beams_that_a_program_finds_have_their_share_while_they_are_in_visits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A visit returns its beam to its aim on the receiver, whatever other beams aim there then."""

    async def scene(made: LivePlant) -> None:
        await up(made)
        automatic, aiming = made.operations.automatic, made.operations._aiming
        row = int(np.flatnonzero(aiming._on(made.plant.now()))[0])
        aim, name = made.plant.aims[row].copy(), made.plant.field.names[row]
        # What the program has kept in memory only.
        automatic.aims.clear()
        await asyncio.sleep(20.0)
        monkeypatch.setattr(automatic, "_visiting", lambda: frozenset({name}))
        away = np.arange(len(made.plant.field)) != row
        monkeypatch.setattr(aiming, "_on", lambda now: away)
        np.testing.assert_allclose(aiming._round(made.plant.now()).fixed[row], aim)

    played(scene)


def test_before_the_night_the_field_leaves_along_the_ramp(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ramp, every, ahead = 30e3, 15.0, 75.0

    async def scene(made: LivePlant) -> None:
        sky = Sky(made)
        async with sky.shining():
            await asyncio.sleep(130.0)
            end = made.plant.now() + ahead
            monkeypatch.setattr(
                aiming.Aiming, "_before_night", lambda self: end - self._plant.now()
            )
            steady, rate = await greatest(made, 3.0), ramp / every
            assert steady > 1.5 * ramp
            seen: list[tuple[float, float]] = []
            while made.plant.now() < end + every:
                await asyncio.sleep(1.0)
                seen.append((end - made.plant.now(), float(true_flux(made).max())))
            for remaining, flux in seen:
                # Each round brings the flux under the line of that moment, until the next one.
                assert flux <= rate * (max(remaining, 0.0) + every) + 1e3, seen
                if remaining > steady / rate + 3.0:
                    assert flux > 0.85 * steady, "no beam leaves before it must"
            assert any(0.2 * steady < flux < 0.7 * steady for _, flux in seen), "in steps"
            assert seen[-1][1] == 0.0

    played(scene, sensors=(DNI_READING,), ramp=ramp / every)


@pytest.mark.parametrize(
    ("lowest", "seconds", "before"),
    [(0.2, 60.0, np.inf), (0.3, 60.0, 40.0), (0.4, 60.0, np.inf), (0.3, 1e12, 40.0)],
)
def test_the_ramp_ends_two_rounds_before_the_sun_is_too_low(
    monkeypatch: pytest.MonkeyPatch, lowest: float, seconds: float, before: float
) -> None:
    # The sine of the sun's elevation falls from 0.35 by 0.05 in 70 s.
    monkeypatch.setattr(
        aiming, "vector", lambda utc, _: np.outer(0.35 - 0.05 * utc / 70.0, (0.0, 0.0, 1.0))
    )
    settings = AimSettings("limit", FluxLimit(LIMIT), ramp=LIMIT / seconds, every=15.0)
    start = SimpleNamespace(utc=lambda: datetime.fromtimestamp(0.0, UTC))
    part = SimpleNamespace(
        _settings=settings,
        _automatic=SimpleNamespace(lowest=np.arcsin(lowest)),
        _plant=SimpleNamespace(clock=start, design=SimpleNamespace(site=None)),
    )
    found = aiming.Aiming._before_night(part)  # type: ignore[arg-type]
    assert found == pytest.approx(before, abs=aiming.STEP)


def test_a_measured_flux_relieves_the_spot_and_a_lying_sensor_does_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def scene(made: LivePlant) -> None:
        sky = Sky(made)
        monkeypatch.setattr(FluxSensor, "share", lambda _: sky.share())
        async with sky.shining():
            await up(made)
            await asyncio.sleep(40.0)
            before = await greatest(made, 15.0)
            sky.flux = 4.0
            assert await greatest(made, 45.0) > 0.97 * before, "no beam can have brought that"
            assert not texts(made, "flux_above_limit")
            sky.flux = 1.4
            await asyncio.sleep(60.0)
            assert texts(made, "flux_above_limit"), "raised, and over since beams left"
            after = await greatest(made, 30.0)
            assert 0.5 * before < after < 0.9 * before
            sky.flux = 1.0
            await asyncio.sleep(60.0)
            assert not texts(made, "flux_above_limit", active=True)
            assert await greatest(made, 15.0) < 0.9 * before, "wary for a while"

    played(scene, sensors=(DNI_READING,))


def test_a_hot_spot_sends_off_the_heliostat_that_heats_it_and_not_the_field() -> None:
    async def scene(made: LivePlant) -> None:
        plant, sky = made.plant, Sky(made)
        surface = surface_of(made.design.receivers[0])
        mean = NOMINAL / float(surface.cells.area.sum())

        def tracking() -> set[int]:
            return set(np.flatnonzero(plant.field.among((states.TRACKING,), plant.now())).tolist())

        async with sky.shining():
            await up(made)
            await asyncio.sleep(40.0)
            field, flux = tracking(), true_flux(made)
            middle = surface.cells.center.reshape(*flux.shape, 3)
            hot = np.linalg.norm(
                middle - middle[np.unravel_index(flux.argmax(), flux.shape)], axis=-1
            )
            heat = {row: float(true_flux(made, row)[hot < 0.3].max()) for row in field}
            off, told = list[set[int]](), set[str]()
            for _ in range(15):
                # The camera sees more in the spot than is predicted, and elsewhere the same.
                seen = np.where(hot < 0.3, 1.4, 1.0) * 1e-3 * sky.dni * true_flux(made)
                made.operations.flux_check.see(as_float(seen / mean))
                await asyncio.sleep(3.0)
                off.append(field - tracking())
                told.update(texts(made, "flux_above_limit", active=True))
        assert told
        assert all("the measured flux is up to" in text for text in told)
        most = max(heat.values())
        # Two beams may heat the spot alike; one of them is enough.
        heating = {row for row, each in heat.items() if each > 0.9 * most}
        assert len(heating) <= 2
        assert sum(each < 0.1 * most for each in heat.values()) >= 4, "others heat other places"
        assert next(rows for rows in off if rows) <= heating
        assert max(map(len, off)) == 1, "the field goes on"

    played(scene, sensors=(DNI_READING,))


def test_a_sensor_that_no_beams_explain_changes_no_aims_and_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def scene(made: LivePlant) -> None:
        sky = Sky(made)
        monkeypatch.setattr(FluxSensor, "share", lambda _: sky.share())
        async with sky.shining():
            await up(made)
            await asyncio.sleep(40.0)
            before, sky.flux = made.plant.aims.copy(), 4.0
            await asyncio.sleep(150.0)
            (text,) = texts(made, "flux_disagrees", active=True)
            assert "are measured and" in text
            assert "The field continues unchanged." in text
            assert "\n" not in text
            assert not texts(made, "flux_above_limit")
            np.testing.assert_array_equal(made.plant.aims, before)
            assert made.operations.aims().source == "optimiser"

    played(scene, sensors=(DNI_READING,))


def texts(made: LivePlant, condition: str, *, active: bool = False) -> list[str]:
    """Return the texts of the alarms of a condition."""
    alarms = made.operations.logbook.alarms()
    return [a.text for a in alarms if a.condition == condition and a.active >= active]
