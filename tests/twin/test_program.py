"""A simulated field as a program: its folder, its server, its clock, and its death."""

import asyncio
import contextlib
import math
import signal
import socket
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import numpy as np
import pytest

from heliotrope.cluster.serial_bus import SerialBus
from heliotrope.errors import FetchError, FormatError, InputError
from heliotrope.field.formats.plant_file import read_plant, write_plant
from heliotrope.field.layouts import malan_plant
from heliotrope.field.plant import Plant
from heliotrope.imaging.files import read_image
from heliotrope.imaging.frame import Frame
from heliotrope.lcu import states
from heliotrope.links.clock import SystemClock, VirtualClock, run_virtual
from heliotrope.plant.assembly import AssemblySettings, MachineTables, PlantAssembly
from heliotrope.plant.io.followed_clock import ClockReader, ClockState, FollowedLoop
from heliotrope.plant.io.links_file import read_links
from heliotrope.twin.live import PacedLoop, World, WorldOptions
from heliotrope.twin.live.live import true_mechanisms
from heliotrope.twin.program import read_folder, write_folder
from heliotrope.twin.program.boards import read_boards, write_boards
from heliotrope.twin.program.program import _ends
from heliotrope.twin.program.server import TwinServer
from heliotrope.twin.weather import WeatherStation
from heliotrope.twin.yesterday import measure_yesterday, with_records
from support.program import MAIN, Program

START = datetime(2026, 6, 21, 10, tzinfo=UTC)
SECRET = "secret"


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def at_noon(heliostats: int) -> Plant:
    """Return a plant where it is about noon now."""
    design, now = malan_plant(heliostats), datetime.now(UTC)
    hour = now.hour + now.minute / 60.0
    return replace(design, site=replace(design.site, longitude_deg=15.0 * (12.0 - hour)))


# -- the folder ----------------------------------------------------------------------------


def test_a_folder_is_read_as_it_was_written(tmp_path: Path) -> None:
    design, serves = malan_plant(40), ("127.0.0.1", 8090)
    made = write_folder(design, tmp_path / "f", ("127.0.0.1", 4840), serves, steps_every=1)
    assert read_folder(tmp_path / "f") == made
    known = read_plant(tmp_path / "f" / "plant.toml")
    assert [camera.source for camera in known.cameras] == [
        f"http://127.0.0.1:8090/{made.secret}/cameras/camera-{side}.png"
        for side in ("left", "right")
    ]
    assert read_links(tmp_path / "f" / "links.toml").document.sensors == {
        name: f"{name}.txt" for name in ("dni", "receiver_flux_nominal", "wind_gust", "wind_mean")
    }
    with pytest.raises(InputError, match="this file already exists; choose another folder"):
        write_folder(design, tmp_path / "f", ("127.0.0.1", 4840), serves, steps_every=1)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('C001 = "tcp"', 'C001 = "C001.toml"', "together with twin"),
        ("none = true", "photographs = true", "a witness cannot see the sun of a simulated field"),
    ],
)
def test_nothing_real_stands_beside_a_simulated_field(
    tmp_path: Path, before: str, after: str, message: str
) -> None:
    design = malan_plant(40)
    write_folder(design, tmp_path, ("127.0.0.1", 4840), ("127.0.0.1", 8090), steps_every=1)
    path = tmp_path / "links.toml"
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))
    (tmp_path / "C001.toml").write_text("")
    with pytest.raises(FormatError, match=message):
        read_links(path)


def test_boards_store_what_the_plant_has_kept(tmp_path: Path) -> None:
    design = malan_plant(12)
    truth = true_mechanisms(design, WorldOptions(3))
    day = measure_yesterday(design, truth, START, count=5, seed=3)
    newest = list({record.heliostat: record for record in day.calibrations}.values())
    write_boards(tmp_path / "boards.npz", newest)
    stored = read_boards(tmp_path / "boards.npz", design)
    (group,), (expected,) = stored.groups.values(), with_records(design, newest).groups.values()
    table = group.calibrated.armature.table
    np.testing.assert_allclose(table, expected.calibrated.armature.table, atol=1e-12)
    (nominal,) = design.groups.values()
    moved = (np.abs(table - nominal.calibrated.armature.table) > 1e-6).any(axis=-1)
    assert {name for name, new in zip(design.names, moved, strict=True) if new} == {
        record.heliostat for record in newest
    }


# -- what it serves ------------------------------------------------------------------------


@pytest.fixture
def served() -> Iterator[tuple[str, dict[str, Any]]]:
    """The address of a server, and the state of its clock, which may be changed and goes on."""
    state = {
        "now": 1000.0, "utc": START.timestamp(), "speed": 0.0, "asked": 2.0,
        "waits": True, "begun": False,
    }  # fmt: skip
    frame = Frame(np.full((16, 24), 9, dtype=np.uint8), "eye", START)
    loop, port = asyncio.new_event_loop(), free_port()
    begun = time.monotonic()

    def clock() -> dict[str, Any]:
        passed = state["speed"] * (time.monotonic() - begun)
        return {**state, "now": state["now"] + passed, "utc": state["utc"] + passed}

    server = TwinServer(("127.0.0.1", port), SECRET, clock, loop, lambda _: frame, bytes, bytes)
    server.start()
    yield f"http://127.0.0.1:{port}/{SECRET}", state
    server.close()
    loop.close()


def test_a_photograph_has_the_time_of_its_exposure(
    served: tuple[str, dict[str, Any]], tmp_path: Path
) -> None:
    answer = httpx.get(f"{served[0]}/cameras/eye.png", trust_env=False)
    (tmp_path / "a.png").write_bytes(answer.content)
    frame = read_image(tmp_path / "a.png")
    assert frame.time == START
    assert frame.pixels.tolist() == [[9] * 24] * 16


@pytest.mark.parametrize("path", ["", "/..", "/cameras", "/cameras/eye", "/other"])
def test_other_paths_are_not_found(served: tuple[str, dict[str, Any]], path: str) -> None:
    assert httpx.get(f"{served[0]}{path}", trust_env=False).status_code == 404
    guessed = served[0].replace(SECRET, "guess")
    assert httpx.get(f"{guessed}/clock", trust_env=False).status_code == 404


def test_a_plant_follows_the_clock_of_its_field(served: tuple[str, dict[str, Any]]) -> None:
    address, state = served
    reader = ClockReader(address)
    with asyncio.Runner(loop_factory=lambda: FollowedLoop(reader)) as runner:
        loop = runner.get_loop()
        clock = reader.clock(loop)
        assert (clock.monotonic(), clock.utc()) == (1000.0, START), "it stands still"
        state.update(speed=50.0, begun=True)

        async def wait() -> float:
            while not reader.state.begun:
                await asyncio.to_thread(lambda: None)
            begun = loop.time()
            await asyncio.sleep(5.0)
            return loop.time() - begun

        assert runner.run(wait()) >= 5.0
        passed = clock.utc().timestamp() - START.timestamp()
        assert passed == pytest.approx(clock.monotonic() - 1000.0, abs=0.1)
    reader.close()


def test_a_plant_does_not_run_ahead_of_a_field_that_does_not_answer() -> None:
    state = ClockState(
        wall=10.0, now=1000.0, utc=0.0, speed=50.0, asked=50.0, waits=True, begun=True
    )
    assert state.at(10.002) == pytest.approx(1000.1)
    assert state.at(10.5) == state.at(60.0) == pytest.approx(1000.4)


def test_a_plant_goes_on_without_a_field_that_is_gone(served: tuple[str, dict[str, Any]]) -> None:
    address, state = served
    state.update(speed=50.0, begun=True)
    with contextlib.closing(ClockReader(address)) as reader:
        reader.fetch = _gone  # type: ignore[method-assign]
        until = time.monotonic() + 30.0
        while math.isfinite(reader.state.ahead) and time.monotonic() < until:
            time.sleep(0.01)
        last = reader.state
        assert last.at(last.wall + 2.0) == pytest.approx(last.now + 100.0)


def _gone(path: str) -> bytes:
    raise FetchError(f"{path}: gone")


def test_a_field_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("heliotrope.plant.io.followed_clock._STARTING", 0.0)
    with pytest.raises(FetchError, match="simulated field: no reply"):
        ClockReader(f"http://127.0.0.1:{free_port()}/{SECRET}")


@pytest.mark.parametrize(
    ("connected", "lasts", "lease", "ends"),
    [
        (True, 1.4, 2.8, 1.0),  # the connection ends first
        (True, 1.4, 1.5, 0.1),  # the lease does
        (True, 1.4, -5.0, 1.0),  # no plant leads it yet
        (True, 0.3, 2.8, -0.1),
        (False, 0.0, 1.5, math.inf),  # nothing comes from a plant that has ended
    ],
)
def test_a_field_waits_for_a_plant_that_is_late(
    connected: bool, lasts: float, lease: float, ends: float
) -> None:
    link = SimpleNamespace(connected=connected, lasts=lasts)
    found = _ends(SimpleNamespace(lease_left=lease), link)  # type: ignore[arg-type]
    assert found == pytest.approx(ends)


# -- the field -----------------------------------------------------------------------------


def test_a_field_that_is_put_up_tracks_as_one_that_was_raised() -> None:
    async def main(clock: VirtualClock) -> None:
        world = World(malan_plant(12), clock, WorldOptions(rendered=False))
        world.put_up()
        assert (world.field.state == states.TRACKING).all()
        # The mirrors are as far off as they are installed, about 10 mrad.
        assert 1e-3 < np.median(world.errors()) < 3e-2
        world.field.advance(1000)
        assert (world.field.state == states.TRACKING).all()

    run_virtual(main, start=START)


def test_a_plant_knows_the_aims_of_a_field_that_is_up() -> None:
    async def main(clock: VirtualClock) -> None:
        design = malan_plant(12)
        ports = World(design, clock, WorldOptions(rendered=False)).ports()
        made = PlantAssembly(design, ports, AssemblySettings(machines=MachineTables.HELD))
        assert np.isnan(made.plant.aims).all()
        made.plant.aims[3] = (1.0, 2.0, 3.0)
        made.aim_as_designed()
        assert np.isfinite(made.plant.aims).all()
        assert made.plant.aims[3].tolist() == [1.0, 2.0, 3.0], "an assigned aim stays"

    run_virtual(main, start=START)


def test_a_loop_stands_still_and_goes_on_at_another_speed() -> None:
    with asyncio.Runner(loop_factory=lambda: PacedLoop(20.0)) as runner:
        loop = runner.get_loop()
        assert isinstance(loop, PacedLoop)

        async def main() -> None:
            loop.speed = 0.0
            begun = loop.time()
            await asyncio.to_thread(lambda: None)
            assert loop.time() == begun
            loop.speed = 40.0
            await asyncio.sleep(1.0)
            assert loop.time() >= begun + 1.0
            loop.until = begun + 3.0
            held = asyncio.ensure_future(asyncio.sleep(5.0))
            while loop.time() < loop.until:
                await asyncio.to_thread(time.sleep, 0.01)
            await asyncio.to_thread(time.sleep, 0.3)  # 12 s at its speed
            assert loop.time() == begun + 3.0
            assert not held.done()
            loop.until = math.inf
            await held
            assert loop.time() < begun + 8.0, "it goes on from there"

        runner.run(main())


def test_a_cluster_reads_its_boards_on_a_pseudo_terminal() -> None:
    async def main() -> None:
        options = WorldOptions(rendered=False, boards=True, pty=True)
        world = World(malan_plant(3), SystemClock(), options)
        (bus,) = world.buses.values()
        assert isinstance(bus, SerialBus)
        async with world.running(), asyncio.timeout(60.0):
            while bus.statistics.answered < 20:
                await asyncio.sleep(0.1)
            assert (bus.problem, bus.statistics.spoilt) == ("", 0)

    asyncio.run(main())


# -- real processes ------------------------------------------------------------------------


def test_a_plant_outlives_its_field_and_leads_it_again(tmp_path: Path) -> None:
    write_plant(at_noon(6), tmp_path / "plant.toml")
    folder = tmp_path / "desk"
    # A new field begins at stow, as boards do whose supply was cut there.
    words = ["twin", "--folder", str(folder), "--plant", f"127.0.0.1:{free_port()}"]
    field = Program(MAIN, *words, str(tmp_path / "plant.toml"))
    plant = None
    try:
        field.says("now run")
        plant = Program(
            MAIN, "run", str(folder / "plant.toml"), "--clusters", str(folder / "links.toml"),
            "--no-console", "--data", str(tmp_path / "data"), "--every", "1", "--automatic",
        )  # fmt: skip
        plant.says("[1-6] of 6 tracking")
        shown = {name: float((folder / f"{name}.txt").read_text()) for name in WeatherStation.names}
        assert 300.0 < shown["dni"] < 1100.0
        assert shown["wind_mean"] == pytest.approx(3.0, abs=2.0)
        field.process.send_signal(signal.SIGKILL)
        plant.says("1 of 1 clusters silent.*alarm")
        field.close()
        field = Program(MAIN, *words)
        plant.says(r"UTC: (?!.*silent).*6 in stow")
        plant.process.send_signal(signal.SIGINT)
        assert plant.ends() == 0
        assert plant.text.endswith("ended\n")
    finally:
        field.close()
        if plant is not None:
            plant.close()


def test_a_plant_leads_boards_on_pseudo_terminals(tmp_path: Path) -> None:
    write_plant(at_noon(3), tmp_path / "plant.toml")
    folder = tmp_path / "desk"
    field = Program(
        MAIN, "twin", str(tmp_path / "plant.toml"), "--folder", str(folder), "--boards", "--pty",
        "--plant", f"127.0.0.1:{free_port()}",
    )  # fmt: skip
    plant = None
    try:
        field.says("now run")
        plant = Program(
            MAIN, "run", str(folder / "plant.toml"), "--clusters", str(folder / "links.toml"),
            "--no-console", "--data", str(tmp_path / "data"), "--every", "1", "--automatic",
        )  # fmt: skip
        plant.says("3 moving to their aims")
    finally:
        field.close()
        if plant is not None:
            plant.close()


def test_a_pseudo_terminal_needs_boards(tmp_path: Path) -> None:
    field = Program(MAIN, "twin", "--folder", str(tmp_path / "desk"), "--pty")
    try:
        assert field.ends() == 2
        assert "--pty needs --boards, because only boards have a serial bus" in field.text
        assert not (tmp_path / "desk").exists()
    finally:
        field.close()


def test_its_sensors_read_before_its_plant_begins(tmp_path: Path) -> None:
    folder = tmp_path / "desk"
    field = Program(
        MAIN, "twin", "--heliostats", "6", "--folder", str(folder), "--start", "2026-06-21",
        "--plant", f"127.0.0.1:{free_port()}",
    )  # fmt: skip
    try:
        field.says("now run")
        document = read_links(folder / "links.toml").document
        with contextlib.closing(ClockReader(document.twin)) as reader:
            until = time.monotonic() + 60.0
            while not reader.state.waits and time.monotonic() < until:
                time.sleep(0.05)
            assert reader.state.speed == 0.0, "its time waits for the plant"
        assert len(document.sensors) == 4
        for name, file in document.sensors.items():
            assert np.isfinite(float((folder / file).read_text())), name
    finally:
        field.close()
