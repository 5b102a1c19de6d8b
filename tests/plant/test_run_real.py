"""``heliotrope run --clusters`` for real: clusters over TCP, a broker and a bus, and one missing.

The plant is a process, and so are two of its clusters. Their buses are pseudo-terminals with real
local controllers at them, in threads of the test. One cluster never comes.
"""

import asyncio
import contextlib
import io
import os
import queue
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from heliotrope.cli import main
from heliotrope.cluster.config_file import read_cluster
from heliotrope.cluster.program import LocalCluster
from heliotrope.console.client import Client
from heliotrope.errors import FormatError
from heliotrope.field.formats.plant_file import read_plant, write_plant
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver
from heliotrope.lcu.journal import CODES_OF, Journal
from heliotrope.links.clock import SystemClock
from heliotrope.links.common_settings import CommonSettings
from heliotrope.links.messages import Emergency, Lease
from heliotrope.links.tcp import tcp_link
from heliotrope.mechanism import kinds
from heliotrope.mechanism.board_items import items_of
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import rotary
from heliotrope.mechanism.machine import AxisLimits, Machine
from heliotrope.plant.assembly import AssemblySettings, MachineTables, PlantAssembly
from heliotrope.plant.io.links_file import LinksFile, read_links
from heliotrope.plant.io.sensors import FED, SensorFiles
from heliotrope.plant.orders.audit import JsonLines
from heliotrope.plant.ports import Ports
from heliotrope.plant.settings import PlantSettings, clusters_of
from heliotrope.sun import Site
from heliotrope.twin.live import near_pair
from support.broker import Mosquitto, mosquitto_for
from support.cluster_process import Line
from support.clusters import Board, key_of
from support.plant_bench import ScriptedCluster
from support.six_kinds import mixed

MAIN = "from heliotrope.cli import main; main()"
PREFIX = "heliotrope/test"
#: By which way each cluster of two heliostats is reached.
WAYS = {"K1": "tcp", "K2": "mqtt", "K3": "K3.toml", "K4": "tcp"}
KEYS = {name: bytes([40 + i]) * 32 for i, name in enumerate(WAYS)}
#: Coarse gears, so that a mirror turns by 90° in two seconds.
TURN = 16_000
STOW = (TURN // 4, 3_916)
MACHINE = Machine(
    (AxisLimits(-800, 16_240, 8000, 16_000, 2), AxisLimits(-160, 4_160, 8000, 16_000, 2)),
    STOW,
    (0.1, 0.05),
    (12.0, 0.0, 40.0),
)
#: The machine may be busy, s.
PATIENCE = 180.0


def noon() -> Site:
    """Return a place where the sun stands high now, whenever this is run."""
    now = datetime.now(UTC)
    hours = now.hour + now.minute / 60.0
    return Site(-20.0 if 3 < now.month < 10 else 20.0, (12.0 - hours) * 15.0, 0.0, name="noon")


def mechanisms(count: int) -> Mechanism:
    bearing = np.radians(np.linspace(-25.0, 25.0, count))
    place = 80.0 * np.stack([np.sin(bearing), np.cos(bearing), 0.0 * bearing], axis=-1)
    gear = {"steps_per_turn": 200, "gear_ratio": TURN / 800, "microsteps": 4}
    return kinds.azimuth_elevation(
        place, pivot_height=2.0, pivot_offset=0.2, drives=(rotary(**gear), rotary(**gear))
    )


def design() -> Plant:
    count = 2 * len(WAYS)
    homes = tuple(name for name in WAYS for _ in range(2))
    mirrors = Heliostats(
        tuple(f"H{i + 1}" for i in range(count)),
        mechanisms(count),
        np.full(count, 3.0),
        np.full(count, 2.0),
        cluster=homes,
        machines=(MACHINE,) * count,
    )
    receiver = Receiver(
        "receiver", "planar", np.array([0.0, 0.0, 50.0]), np.array([0.0, 1.0, 0.0]), 4.0, 4.0
    )
    return Plant("four ways", noon(), {"all": mirrors}, receivers=(receiver,))


def boards(cluster: int) -> list[Board]:
    """Local controllers of a cluster, in stow."""
    found = []
    for address in (1, 2):
        mechanism = mechanisms(2 * len(WAYS))[2 * cluster + address - 1]
        board = Board(address, configured=False)
        items = {**items_of(mechanism, MACHINE), "address": struct.pack("<H", address)}
        board.timer.made = list(STOW)
        journal = Journal(board.flash)
        journal.load()
        journal.store(items)
        journal.zero(*STOW)
        found.append(board)
    return found


def private(path: Path, text: str) -> None:
    path.touch(0o600)
    path.write_text(text)


def cluster_file(folder: Path, name: str, url: str) -> None:
    site, first = noon(), 2 * list(WAYS).index(name)
    members = "".join(f'[[heliostats]]\nname = "H{first + k}"\naddress = {k}\n' for k in (1, 2))
    (folder / f"{name}.toml").write_text(
        f'format = "heliotrope-cluster"\nversion = 1\nname = "{name}"\n'
        f'keys = "{name}.keys"\ntime = {{error_s = 0.5}}\n'
        f"site = {{latitude_deg = {site.latitude_deg}, longitude_deg = {site.longitude_deg}}}\n"
        f'bus = {{url = "{folder}/{name}.bus", answer_s = 0.5}}\nplant = {{url = "{url}"}}\n'
        f"{members}"
    )
    keys = "".join(f'H{first + k} = "{key_of(k).hex()}"\n' for k in (1, 2))
    private(folder / f"{name}.keys", f'plant = "{KEYS[name].hex()}"\n[heliostats]\n{keys}')


def first_password(plant: "Process") -> str:
    """Return the password of the first account, from the file that a plant names."""
    return Path(plant.says(r"password in (\S+)")[1]).read_text("utf-8").strip()


def links_file(folder: Path, port: int, broker: int) -> Path:
    (folder / "links.toml").write_text(
        'format = "heliotrope-links"\nversion = 1\nkeys = "links.keys"\n'
        f'[tcp]\nlisten = "127.0.0.1:{port}"\n'
        f'[mqtt]\nurl = "mqtt://127.0.0.1:{broker}/{PREFIX}"\n[clusters]\n'
        + "".join(f'{name} = "{way}"\n' for name, way in WAYS.items())
    )
    remote = [name for name, way in WAYS.items() if way in ("tcp", "mqtt")]
    keys = "".join(f'{name} = "{KEYS[name].hex()}"\n' for name in remote)
    private(folder / "links.keys", f"[clusters]\n{keys}")
    return folder / "links.toml"


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


class Process:
    """A program whose lines are read as they come."""

    def __init__(self, *words: str, main: str = MAIN) -> None:
        self.text = ""
        self._lines: queue.Queue[str] = queue.Queue()
        self._popen = subprocess.Popen(
            [sys.executable, "-c", main, *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self._popen.stdout is not None
        for line in self._popen.stdout:
            self._lines.put(line)

    def says(self, pattern: str) -> re.Match[str]:
        """Wait until a line matches."""
        until = time.monotonic() + PATIENCE
        while True:
            try:
                line = self._lines.get(timeout=max(0.01, until - time.monotonic()))
            except queue.Empty:
                raise AssertionError(f"no {pattern!r} in\n{self.text}") from None
            self.text += line
            if found := re.search(pattern, line):
                return found

    def end(self, number: int = signal.SIGTERM) -> tuple[int, str]:
        """Send a signal; return exit code and all that was printed."""
        if self._popen.poll() is None:
            self._popen.send_signal(number)
        try:
            self._popen.wait(PATIENCE)
        finally:
            self._popen.kill()
            self._popen.wait()
            self._reader.join()
            if self._popen.stdout is not None:
                self._popen.stdout.close()
        while not self._lines.empty():
            self.text += self._lines.get()
        return self._popen.returncode, self.text


@pytest.fixture
def mosquitto(tmp_path: Path) -> Iterator[Mosquitto]:
    yield from mosquitto_for(tmp_path)


@pytest.fixture
def lines(tmp_path: Path) -> Iterator[dict[str, Line]]:
    """Buses of the clusters that are there."""
    made = {
        name: Line(tmp_path / f"{name}.bus", boards(k)) for k, name in enumerate(("K1", "K2", "K3"))
    }
    yield made
    for line in made.values():
        line.end()


def until(holds: Callable[[], Any], told: Callable[[], Any]) -> Any:
    end = time.monotonic() + PATIENCE
    while not (found := holds()):
        assert time.monotonic() < end, f"it did not come to that: {told()}"
        time.sleep(0.1)
    return found


def states(lines: dict[str, Line]) -> dict[str, str]:
    """Of the local controllers, in truth."""
    return {
        f"H{2 * k + i + 1}": board.state
        for k, line in enumerate(lines.values())
        for i, board in enumerate(line.boards)
    }


def test_a_real_plant_over_tcp_mqtt_and_its_own_bus(
    mosquitto: Mosquitto, lines: dict[str, Line], tmp_path: Path
) -> None:
    port = free_port()
    write_plant(design(), tmp_path / "plant.toml")
    cluster_file(tmp_path, "K1", f"tcp://127.0.0.1:{port}")
    cluster_file(tmp_path, "K2", f"mqtt://127.0.0.1:{mosquitto.port}/{PREFIX}")
    cluster_file(tmp_path, "K3", "tcp://127.0.0.1:1")
    links = links_file(tmp_path, port, mosquitto.port)
    with contextlib.ExitStack() as stack:
        plant = Process(
            "run",
            str(tmp_path / "plant.toml"),
            "--clusters",
            str(links),
            "--port",
            "0",
            "--data",
            str(tmp_path / "data"),
            "--no-browser",
            "--every",
            "1",
        )
        stack.callback(plant.end)
        for name in ("K1", "K2"):
            stack.callback(Process("cluster", str(tmp_path / f"{name}.toml")).end)
        address = plant.says(r"console: (\S+)")[1]
        password = first_password(plant)
        with Client(url=address) as client:
            client.sign_in("engineer", password)
            client.change_password(password, "a password of one's own")
            client.sign_in("engineer", "a password of one's own")
            _tracked_and_stowed(client, lines)
        plant.says(r"4 of \d tracking")
        code, text = plant.end(signal.SIGINT)
    assert code == 0, text
    # Ctrl-C stows whom it can, and names the others.
    assert set(states(lines).values()) == {"STOWED"}
    assert re.search(
        r"\nstowing \d heliostats \(\d tracking.*\), about \d+ s; press Ctrl-C again to stop "
        r"immediately\n",
        text,
    )
    assert "not in stow: H7 silent, H8 silent" in text
    assert "1 of 4 clusters silent: K4 (" in text
    assert text.endswith("ended\n")


def _tracked_and_stowed(client: Client, lines: dict[str, Line]) -> None:
    def alive() -> list[str]:
        return [row["name"] for row in client.get("clusters") if row["alive"]]

    def told() -> Any:
        events = [(event["who"], event["text"]) for event in client.get("events")]
        return states(lines), client.get("clusters"), events

    def calm() -> bool:
        """What was silent at the start has cleared, but for the cluster that is missing."""
        wrong = {alarm["subject"] for alarm in client.get("alarms") if alarm["active"]}
        return not wrong & {"K1", "K2", "K3"}

    until(lambda: alive() == ["K1", "K2", "K3"] and calm(), told)
    # Nothing moves before a person says so.
    assert set(states(lines).values()) == {"STOWED"}
    names = [f"H{i}" for i in range(1, 7)]
    client.ask("POST", "automatic", {"heliostats": names})
    until(lambda: set(states(lines).values()) == {"TRACKING"}, told)
    client.ask("POST", "stow", {"heliostats": names[:2]})
    until(lambda: {states(lines)[name] for name in names[:2]} <= {"STOWING", "STOWED"}, told)
    assert {states(lines)[name] for name in names[2:]} == {"TRACKING"}
    missing = [a for a in client.get("alarms") if a["subject"] == "K4" and a["active"]]
    assert missing


#: The program with a disk on which each transaction, a mere read too, and each sync takes some
#: seconds while a file is there.
SLOW = """
import os, time
from sqlalchemy import event
from sqlalchemy.engine import Engine
from heliotrope.cli import main

sync, path = os.fsync, {path!r}
def wait(*_):
    if os.path.exists(path):
        time.sleep({seconds})
def slow(file):
    wait()
    sync(file)
event.listen(Engine, "commit", wait)
os.fsync = slow
main()
"""
#: Time of one transaction on that disk, s.
SLOWNESS = 3.0


def test_a_slow_disk_holds_up_no_lease_and_no_emergency(tmp_path: Path) -> None:
    port, slow = free_port(), tmp_path / "slow"
    write_plant(design(), tmp_path / "plant.toml")
    (tmp_path / "links.toml").write_text(
        'format = "heliotrope-links"\nversion = 1\nkeys = "links.keys"\n'
        f'[tcp]\nlisten = "127.0.0.1:{port}"\n[clusters]\n'
        + "".join(f'{name} = "tcp"\n' for name in WAYS)
    )
    keys = "".join(f'{name} = "{KEYS[name].hex()}"\n' for name in WAYS)
    private(tmp_path / "links.keys", f"[clusters]\n{keys}")
    words = "run", "plant.toml", "--clusters", "links.toml", "--port", "0", "--data", "data"
    places = {"plant.toml", "links.toml", "data"}
    program = SLOW.format(path=str(slow), seconds=SLOWNESS)
    with contextlib.ExitStack() as stack:
        plant = Process(
            *(str(tmp_path / word) if word in places else word for word in words),
            *("--no-browser", "--idle", "--every", "1"),
            main=program,
        )
        stack.callback(plant.end)
        address = plant.says(r"console: (\S+)")[1]
        password = first_password(plant)
        near = Near(port)
        stack.callback(near.end)
        with Client(url=address, timeout=60.0) as client:
            client.sign_in("engineer", password)
            client.change_password(password, "a password of one's own")
            client.sign_in("engineer", "a password of one's own")
            until(lambda: client.get("clusters")[0]["alive"], lambda: client.get("clusters"))
            slow.touch()
            begun = time.monotonic()
            # The store is asked for the accounts, and for the session.
            client.get("accounts")
            client.get("accounts")
            client.ask("POST", "defocus", {"heliostats": ["H1"]})
            asked = time.monotonic()
            client.ask("POST", "emergency", {})
            until(lambda: near.times(Emergency)[-1:] > [asked], lambda: near.times(Emergency))
            took = near.times(Emergency)[-1] - asked
            time.sleep(3.0 * SLOWNESS)
            ended = time.monotonic()
            slow.unlink()
        leases = [at for at in near.times(Lease) if begun - 2.0 < at < ended]
        lease = PlantSettings().lease
        assert max(np.diff([*leases, ended])) < lease
        assert took < lease
        code, text = plant.end(signal.SIGINT)
    assert code == 0, text


class Near:
    """The cluster K1 in a thread of the test: it obeys, and notes when messages come."""

    def __init__(self, port: int) -> None:
        clock = SystemClock()
        self._link = tcp_link("127.0.0.1", port, "K1", KEYS["K1"], clock)
        members = clusters_of(design())["K1"]
        self._cluster = ScriptedCluster("K1", members, self._link, clock)
        self._ended = False
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()))
        self._thread.start()

    async def _run(self) -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(self._cluster.run())
            while not self._ended:
                await asyncio.sleep(0.1)
            await self._link.close()

    def times(self, kind: type[Any]) -> list[float]:
        """Return when messages of a kind came, monotonic s."""
        return [at for at, message in self._cluster.taken if isinstance(message, kind)]

    def end(self) -> None:
        self._ended = True
        self._thread.join()


# -- the links file ------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Files of a plant, none of whose clusters is there."""
    write_plant(design(), tmp_path / "plant.toml")
    links_file(tmp_path, 4840, 1883)
    cluster_file(tmp_path, "K3", "tcp://127.0.0.1:1")
    return tmp_path


def read(folder: Path, homes: dict[str, tuple[str, ...]] | None = None) -> LinksFile:
    """Read the links file, and build what it says of a plant."""
    found, clock = read_links(folder / "links.toml"), SystemClock()
    members = homes or clusters_of(design())
    for name, file in found.build(members, clock).local.items():
        LocalCluster(file, name, members[name], clock)
    return found


def test_each_cluster_gets_its_way(folder: Path) -> None:
    found = read_links(folder / "links.toml")
    assert "links.toml" in repr(found)
    assert not re.search(r"keys=\{|password='", repr(found)), "a log that shows it shows a secret"
    made = found.build(clusters_of(design()), SystemClock())
    assert set(made.links) == {"K1", "K2", "K4"}
    assert made.server is not None
    assert set(made.server.links) == {"K1", "K4"}
    assert made.local == {"K3": folder / "K3.toml"}
    local = LocalCluster(made.local["K3"], "K3", ("H5", "H6"), SystemClock())
    assert local.cluster.config.name == "K3"


@pytest.mark.parametrize(
    ("file", "old", "new", "text"),
    [
        ("links.toml", 'format = "heliotrope-links"', "", "format is missing; a links file begins"),
        ("links.toml", 'K3 = "K3.toml"\n', "", "a cluster K3 of 2 heliostats, but no line"),
        ("links.toml", "[clusters]", '[clusters]\nK9 = "mqtt"', "the plant has no cluster K9"),
        (
            "links.toml",
            'K2 = "mqtt"',
            'K2 = "mqqt"',
            'K2: \'mqqt\': not a connection, and no such file; specify "tcp", "mqtt", or the',
        ),
        (
            "links.toml",
            "K3.toml",
            "K5.toml",
            'not a connection, and no such file; specify "tcp", "mqtt", or the cluster file',
        ),
        ("links.toml", '[tcp]\nlisten = "127.0.0.1:4840"\n', "", "add a table \\[tcp\\]"),
        ("links.toml", "127.0.0.1:4840", "4840", "'4840': specify address:port"),
        ("links.toml", "[mqtt]", "[mqtt]\nusernme = 'a'", "not known; did you mean 'username'"),
        ("links.toml", f"mqtt://127.0.0.1:1883/{PREFIX}", "tcp://a:1", "mqtt.url: specify mqtt://"),
        ("links.toml", '"127.0.0.1:4840"', '"127.0.0.1:4840"\nkey = "a"', "needs both certif"),
        ("links.toml", "links.keys", "other.keys", "other.keys: no such file"),
        ("links.toml", "127.0.0.1:4840", "0.0.0.0:4840", "tcp.listen: 0.0.0.0 is not this mach"),
        ("links.toml", "mqtt://127.0.0.1:1883", "mqtt://10.0.0.9", "mqtt.url: 10.0.0.9 is not"),
        ("links.keys", "K2 =", "# K2 =", "clusters.K2: a cluster and its plant authenticate"),
        ("links.keys", "K1 =", "K8 =", "clusters.K8: the plant has no such cluster; remove"),
        ("links.keys", "[clusters]", "[cluster]", "'cluster' is not known; use plant, passw"),
        ("links.keys", "28282828", "2", "links.keys: K1: a key of 57 characters"),
        ("K3.toml", 'name = "K3"', 'name = "K5"', "it is for cluster K5, not for K3"),
    ],
)
def test_what_a_links_file_may_not_say(
    folder: Path, file: str, old: str, new: str, text: str
) -> None:
    path = folder / file
    content = path.read_text()
    assert old in content
    path.write_text(content.replace(old, new, 1))
    with pytest.raises(FormatError, match=text) as refused:
        read(folder)
    assert "\n" not in str(refused.value)


def test_a_bus_with_other_heliostats_is_refused(folder: Path) -> None:
    homes = {**clusters_of(design()), "K3": ("H5", "H9")}
    with pytest.raises(FormatError, match="H6 is listed as a heliostat of K3 only in this file"):
        read(folder, homes)


def test_keys_that_others_may_read_are_refused(folder: Path) -> None:
    (folder / "links.keys").chmod(0o644)
    with pytest.raises(FormatError, match="others may read it"):
        read(folder)


# -- the command ---------------------------------------------------------------------------


def call(*words: object) -> tuple[int, str, str]:
    """Run the command here; return exit code, output, errors."""
    out, err = io.StringIO(), io.StringIO()
    before = sys.argv
    sys.argv = ["heliotrope", "run", *map(str, words)]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main()
    except SystemExit as leaving:
        code = leaving.code
    else:
        code = 0
    finally:
        sys.argv = before
    return int(code or 0), out.getvalue(), err.getvalue()


def test_files_are_checked_without_a_plant(folder: Path) -> None:
    done = call(folder / "plant.toml", "--clusters", folder / "links.toml", "--check")
    assert done == (0, "four ways: 8 heliostats on 4 clusters, 0 of 0 targets with a camera\n", "")


def test_a_plant_of_four_kinds_is_built_by_the_check(folder: Path) -> None:
    """What `--check` builds is what a run builds, with the parameters that are to be stored."""
    kinds = ["azimuth_elevation", "tilt_roll", "target_aligned", "polar"]
    made, homes = mixed(kinds, 2, "K"), clusters_of(design())
    groups = {
        name: replace(group, names=homes[group.cluster[0]]) for name, group in made.groups.items()
    }
    write_plant(replace(made, groups=groups, targets=(), cameras=()), folder / "mixed.toml")
    words = ("--clusters", folder / "links.toml", "--check", "--configure")
    code, out, err = call(folder / "mixed.toml", *words)
    assert (code, err) == (0, "")
    assert "8 heliostats on 4 clusters" in out


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--clusters", "links.toml"), "--clusters needs a plant file"),
        (
            ("plant.toml", "--clusters", "links.toml"),
            "a real plant must keep its records; use --data",
        ),
        (("plant.toml", "--clusters", "no.toml"), "no.toml: no such file"),
        (
            ("plant.toml", "--clusters", "links.toml", "--speed", 2),
            "run: --speed: only available in simul",
        ),
        (
            ("plant.toml", "--clusters", "links.toml", "--start", "2012-09-02"),
            "run: --start: only available in simulation, because real clusters track the actual",
        ),
        (
            ("--start", "1979-12-31"),
            "--start 1979-12-31: the time must be in the years 1981 to 2099",
        ),
        (("--start", "2012-09-02T10:00"), "has no time zone; append Z for UTC, or an offset"),
        (("--check",), "need a real plant; use --clusters"),
        (("--configure",), "need a real plant; use --clusters"),
        (("--prototype", "--heliostats", 5), "--prototype already selects a plant; leave out"),
        (("plant.toml", "--heliostats", 5), "--heliostats applies only to the default plant"),
        (("--speed", 0), "--speed must be a number from 0.001 to 1,000"),
        (("--minutes", 0), "--minutes must be a number from 0.001 to"),
        (("--every", "nan"), "--every must be a number from 0.1 to 86,400"),
        (("--host", "0.0.0.0"), "without TLS passwords can be read in transit"),
        (("--port", 70_000), "--port must be a whole number from 0 to 65,535"),
        (("--certificate", "a.pem"), "TLS needs both files, --certificate and --key"),
        (("--certificate", "a.pem", "--key", "b.pem"), "a.pem and key b.pem cannot be used"),
        (("--database", "mysql://x/y"), "--database must be postgresql://user@host/name"),
        (
            ("--heliostats", 32, "--no-console", "--database", "postgresql://x@127.0.0.1:1/y"),
            "Connection refused",
        ),
    ],
)
def test_what_cannot_be_run_is_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[object, ...], text: str
) -> None:
    monkeypatch.chdir(folder)
    code, out, err = call(*words)
    assert code == 2
    assert text in err
    assert err.count("\n") == 1
    # What begins before the refusal says so: the plant, and the field that simulates it.
    begun = r"([^\n]*: \d+ heliostats\n(starting the simulated field[^\n]*\n)?)?"
    assert re.fullmatch(begun, out), out


def test_an_address_that_is_taken_is_one_line(folder: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        (folder / "links.toml").write_text(
            (folder / "links.toml").read_text().replace("127.0.0.1:4840", f"127.0.0.1:{port}")
        )
        links = ("--clusters", folder / "links.toml", "--data", folder / "data", "--no-console")
        code, _, err = call(folder / "plant.toml", *links, "--minutes", 1)
    assert (code, err.count("\n")) == (2, 1)
    assert "another plant is running there" in err


def test_a_port_of_the_console_that_is_taken_is_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        code, _, err = call("--heliostats", 32, "--port", taken.getsockname()[1])
    assert (code, err.count("\n")) == (2, 1)
    assert "choose another with --port" in err


def test_options_stand_under_headings() -> None:
    _, text, _ = call("--help")
    headings = re.findall(r"^(\w[\w ]*):$", text, re.MULTILINE)
    assert headings == [
        "Arguments",
        "Simulation",
        "A real plant",
        "Work",
        "Console",
        "Records",
        "Options",
    ]


# -- the plant -----------------------------------------------------------------------------


def test_what_is_wanted_and_who_is_left(folder: Path) -> None:
    """Of a plant none of whose clusters is there."""

    async def main() -> tuple[bool, str]:
        clock = SystemClock()
        # The cluster of the local bus does not run.
        links = read_links(folder / "links.toml").build(clusters_of(design()), clock)
        audit = JsonLines(folder / "audit.jsonl", clock.utc())
        ports = Ports(
            {**links.links, "K3": near_pair(clock, ("plant", "K3"))[0]},
            clock,
            audit,
            sensors=links.sensors,
        )
        settings = AssemblySettings(machines=MachineTables.WRITTEN)
        plant = PlantAssembly(design(), ports, settings)
        wanted = plant.plant.wanted.items
        assert set(wanted) == set(design().names)
        assert wanted["H3"] == items_of(mechanisms(8)[2], MACHINE)
        assert {"wind_gust_stow", "receiver_flow_low"} <= set(plant.plant.sentinel.table.unwatched)
        stowed = await plant.stowed(0.5)
        audit.close()
        return stowed, plant.left()

    stowed, left = asyncio.run(main())
    assert not stowed
    assert left.startswith("not in stow: H1 silent, H2 silent,")
    assert left.endswith("and 3 more")


def two_groups(folder: Path) -> Plant:
    """A plant file whose second half of heliostats has another machine, read again."""
    whole = design()
    (mirrors,) = whole.groups.values()
    other = Machine(
        (AxisLimits(-700, 16_000, 4000, 9000, 7), AxisLimits(-100, 4_000, 5000, 8000, 3)),
        (3000, 3900),
        (0.25, 0.0),
        azimuth_axis=1,
        way=((20.0, 0.0, 1.0), (12.0, 0.0, 5.0)),
    )
    groups = {
        "first": mirrors.take(range(4)),
        "second": replace(mirrors.take(range(4, 8)), machines=(other,) * 4),
    }
    write_plant(replace(whole, groups=groups), folder / "two.toml")
    return read_plant(folder / "two.toml")


def test_exactly_the_machine_table_of_the_plant_file_is_written(tmp_path: Path) -> None:
    plant = two_groups(tmp_path)

    async def main() -> PlantAssembly:
        clock = SystemClock()
        links = {name: near_pair(clock, ("plant", name))[0] for name in WAYS}
        ports = Ports(links, clock, JsonLines(tmp_path / "audit.jsonl", clock.utc()))
        return PlantAssembly(plant, ports, AssemblySettings(machines=MachineTables.WRITTEN))

    made = asyncio.run(main())
    items = made.plant.wanted.items
    first = {name: struct.unpack(CODES_OF[name], data) for name, data in items["H1"].items()}
    second = {name: struct.unpack(CODES_OF[name], data) for name, data in items["H8"].items()}
    assert first["limits_primary"] == (-800, 16_240, 8000, 16_000, 2)
    assert first["limits_secondary"] == (-160, 4_160, 8000, 16_000, 2)
    assert first["stow"] == STOW
    assert first["defocus"] == pytest.approx((0.1, 0.05))
    assert first["standby"] == (12.0, 0.0, 40.0)
    assert first["way"] == (0, 0, *(0.0,) * 12)
    assert second["limits_primary"] == (-700, 16_000, 4000, 9000, 7)
    assert second["limits_secondary"] == (-100, 4_000, 5000, 8000, 3)
    assert second["stow"] == (3000, 3900)
    assert second["defocus"] == pytest.approx((0.25, 0.0))
    assert second["way"] == (1, 2, 20.0, 0.0, 1.0, 12.0, 0.0, 5.0, *(0.0,) * 6)
    # No standby point: local controllers keep theirs, and the plant knows none.
    assert "standby" not in second
    assert np.isfinite(made.plant.standbys[:4]).all()
    assert np.isnan(made.plant.standbys[4:]).all()


def test_a_group_without_a_machine_is_told_and_not_configured(folder: Path) -> None:
    whole = design()
    bare = {name: replace(group, machines=()) for name, group in whole.groups.items()}
    write_plant(replace(whole, groups=bare), folder / "plant.toml")
    words = (folder / "plant.toml", "--clusters", folder / "links.toml", "--check")
    code, out, _ = call(*words)
    assert code == 0
    assert out.endswith(
        "--configure needs a machine table; add it to the plant file for group all\n"
    )
    code, _, err = call(*words, "--configure")
    assert (code, err.count("\n")) == (2, 1)
    assert "group all: the plant file has no table [groups.all.machine]; add it" in err


# -- sensors -------------------------------------------------------------------------------


def test_a_sensor_is_read_when_its_file_is_written_anew(tmp_path: Path) -> None:
    file = tmp_path / "wind_gust"
    sensors = SensorFiles({"wind_gust": file})
    assert "cannot be read" in sensors.read().problems["wind_gust"]
    assert not sensors.read().problems

    def write(text: str, second: int) -> dict[str, float]:
        file.write_text(text)
        os.utime(file, (second, second))
        return sensors.read().values

    opened = len(list(Path("/proc/self/fd").iterdir()))
    # What lay there at the start may be of long ago.
    assert write("12.5\n", 1) == {}
    assert sensors.read().values == {}
    assert write("13", 2) == {"wind_gust": 13.0}
    assert write("nan", 3) == {}
    assert write("calm", 4) == {}
    assert write("9.0", 5) == {"wind_gust": 9.0}
    assert len(list(Path("/proc/self/fd").iterdir())) == opened, "a plant reads for years"
    assert sensors.names <= FED


def test_a_reading_that_programs_give_has_no_file(folder: Path) -> None:
    path = folder / "links.toml"
    table = "[sensors]\nwind_gust = 'api'\nwind_mean = 'wind_mean'\n[clusters]"
    path.write_text(path.read_text().replace("[clusters]", table))
    made = read_links(path).build(clusters_of(design()), SystemClock())
    assert (made.given, made.sensors.names) == ({"wind_gust"}, {"wind_mean"})


def test_the_links_file_holds_what_every_cluster_polls(folder: Path) -> None:
    path = folder / "links.toml"
    assert read_links(path).build(clusters_of(design()), SystemClock()).common == CommonSettings()
    table = "[polling]\nsteps_every_s = 2\nsilence_s = 20.0\n[clusters]"
    path.write_text(path.read_text().replace("[clusters]", table))
    made = read_links(path).build(clusters_of(design()), SystemClock())
    assert made.common == CommonSettings(2, 20.0)


@pytest.mark.parametrize(
    ("setting", "value", "good"),
    [
        ("steps_every_s", 1, True),
        ("steps_every_s", 60, True),
        ("steps_every_s", 0, False),
        ("steps_every_s", 61, False),
        ("silence_s", 2.0, True),
        ("silence_s", 3600.0, True),
        ("silence_s", 1.9, False),
        ("silence_s", 3601.0, False),
    ],
)
def test_the_links_file_takes_what_a_cluster_file_takes(
    folder: Path, setting: str, value: float, good: bool
) -> None:
    links, cluster = folder / "links.toml", folder / "K3.toml"
    table = f"[polling]\n{setting} = {value}\n"
    links.write_text(links.read_text().replace("[clusters]", f"{table}[clusters]"))
    cluster.write_text(f"{cluster.read_text()}{table}")
    refused = pytest.raises(FormatError, match=setting)
    for read_one, path in ((read_links, links), (read_cluster, cluster)):
        with contextlib.nullcontext() if good else refused:
            read_one(path)


def test_a_sensor_that_no_row_needs_is_refused(folder: Path) -> None:
    links = folder / "links.toml"
    links.write_text(links.read_text().replace("[clusters]", "[sensors]\nrain = 'x'\n[clusters]"))
    with pytest.raises(
        FormatError, match=r"sensors.rain: there is no such reading; use .*wind_gust"
    ):
        read_links(links)
