"""The plant beside a console that is killed, hangs or lies, and under clients that mean it ill."""

import asyncio
import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import httpx
import numpy as np
import pytest
from pydantic import ValidationError

from heliotrope.cli._at_plant import URGENT
from heliotrope.errors import HeliotropeError, InputError, UnknownNameError
from heliotrope.field.example import example_plant
from heliotrope.lcu import states
from heliotrope.local import EMERGENCY, ORDINARY, CallError, LocalConnection, ask_once
from heliotrope.plant.interface import CALLS, frame_of, frame_parts, kind_of, plain, remade
from heliotrope.plant.interface.calls import Call, Later, asked
from heliotrope.plant.interface.console_process import CONSOLE, ConsoleProcess, Patience
from heliotrope.plant.interface.desk import SAME, Desk
from heliotrope.plant.interface.orders import AimOrder, EmergencyCall
from heliotrope.plant.interface.service import PlantInterface, _Turns
from heliotrope.plant.operations.operations import Operations
from heliotrope.plant.operations.views import CameraView
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.safety import Alarm
from heliotrope.twin.field.field_bus import FieldBus
from support.live_console import ROLES, LiveConsole

#: At the receiver or at the standby point, or on the way between them.
UP = (states.APPROACHING, states.IDLE, states.TRACKING)
OLGA = Person("Olga", Role.OPERATOR)
#: A client that opens connections, says nonsense, and never stops.
FLOOD = """
import socket, sys, time
end = time.monotonic() + float(sys.argv[2])
held = []
while time.monotonic() < end:
    try:
        raw = socket.socket(socket.AF_UNIX)
        raw.settimeout(0.5)
        raw.connect(sys.argv[1])
        raw.sendall(sys.argv[3].encode() * 100)
        held = [*held[-50:], raw]
    except OSError:
        time.sleep(0.001)
"""


class Watch:
    """What the plant must not show whatever its clients do; made and read in its loop."""

    def __init__(self, plant: LiveConsole) -> None:
        self._plant = plant
        self.up = self.least_lease = np.inf
        self._task = asyncio.get_running_loop().create_task(self._look())

    async def _look(self) -> None:
        here = self._plant.live.operations
        while True:
            rows = here.logbook.cluster_rows(here.plant)
            self.least_lease = min(self.least_lease, *(row.lease_left for row in rows))
            up = here.plant.field.among(UP, here.plant.now())
            self.up = min(self.up, int(up.sum()))
            await asyncio.sleep(0.1)

    def end(self) -> None:
        """Stop looking."""
        self._task.cancel()


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """Thirty-two heliostats out of stow, and a console in a process of its own."""
    patience = Patience(begin=240.0, silent=6.0, pause=0.2, longest=0.4)
    made = LiveConsole(tmp_path_factory.mktemp("plant"), 32, speed=8.0, child=patience)
    try:
        assert made.address
        _raised(made)
        yield made
    finally:
        made.close()


@pytest.fixture(scope="module")
def tokens(plant: LiveConsole) -> dict[str, str]:
    """An API token of each role."""
    people, now = plant.keeper.people, time.time()
    return {role: people.add_token(role, "tests", role, now)[1] for role in ROLES}


def _raised(plant: LiveConsole) -> None:
    """Wait until all heliostats are up."""
    here, who = plant.live.operations, Person("engineer", Role.ENGINEER)
    plant.call(lambda: here.switch_calibration(who, on=False))
    plant.call(lambda: here.resume(who))
    plant.call(lambda: here.give_back(who))
    plant.until(lambda: not here.automatic.view().running, 240.0)
    plant.until(lambda: here.plant.field.among(UP, here.plant.now()).all(), 240.0)


@pytest.fixture
def undisturbed(plant: LiveConsole) -> Iterator[Callable[[], None]]:
    """Every heliostat stays up, and no lease comes late."""
    _raised(plant)
    watch = plant.call(lambda: Watch(plant))

    def check() -> None:
        assert watch.up == 32
        assert watch.least_lease > 0.0

    yield check
    plant.call(watch.end)
    check()


def _answers(plant: LiveConsole, within: float = 300.0) -> None:
    """Wait until the console answers."""
    end = time.monotonic() + within
    while True:
        try:
            assert httpx.get(f"{plant.address}api/v1/health", trust_env=False).is_success
            return
        except httpx.HTTPError:
            assert time.monotonic() < end
            time.sleep(0.1)


def _console_alarm(plant: LiveConsole, *, active: bool) -> str:
    """Wait for the alarm about the console, or for its end; return its text."""

    def found() -> list[str]:
        rows = plant.live.operations.logbook.alarms()
        return [r.text for r in rows if r.condition == "console" and r.active == active]

    return str(plant.until(found, 240.0)[0])


@pytest.mark.parametrize(
    ("how", "text"), [(signal.SIGKILL, "signal 9"), (signal.SIGSTOP, "has not responded")]
)
def test_a_console_that_dies_or_hangs_is_started_again_and_the_plant_goes_on(
    plant: LiveConsole, undisturbed: Callable[[], None], how: signal.Signals, text: str
) -> None:
    _answers(plant)
    before, starts = plant.process.pid, plant.process.starts
    os.kill(before, how)
    assert text in _console_alarm(plant, active=True)
    _answers(plant)
    _console_alarm(plant, active=False)
    assert plant.process.starts > starts
    assert plant.process.pid not in (0, before)
    undisturbed()


def _flood(path: Path, seconds: float, word: str = "HLP1") -> "subprocess.Popen[bytes]":
    return subprocess.Popen([sys.executable, "-c", FLOOD, str(path), str(seconds), word])


@pytest.mark.parametrize("name", [ORDINARY, EMERGENCY])
def test_a_local_client_that_floods_a_socket_disturbs_nothing(
    plant: LiveConsole, undisturbed: Callable[[], None], tokens: dict[str, str], name: str
) -> None:
    floods = [_flood(plant.interface.folder / name, 6.0) for _ in range(2)]
    try:
        time.sleep(1.0)
        _answers(plant)
        hello = {"token": tokens["viewer"]}
        found = ask_once(plant.interface.folder / ORDINARY, hello, "summary", {})
        assert found["heliostats"] == 32
    finally:
        for one in floods:
            one.wait(120.0)
    undisturbed()


def test_a_console_that_floods_waits_for_itself(
    plant: LiveConsole, undisturbed: Callable[[], None]
) -> None:
    """A thousand requests at once: the plant takes them in turn, for a share of its time."""

    async def main() -> None:
        folder, key = plant.interface.folder, plant.interface.key
        line = LocalConnection(folder / ORDINARY, {"key": key}, 60.0)
        async with asyncio.TaskGroup() as group:
            running = group.create_task(line.run())
            while not line.up:
                await asyncio.sleep(0.01)
            asked = [group.create_task(line.ask("field", {})) for _ in range(1000)]
            await asyncio.gather(*asked)
            running.cancel()

    asyncio.run(main())
    undisturbed()


def test_a_call_leaves_the_plant_its_share_of_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a call, three times as long, but never more than a second."""
    clock, waited = SimpleNamespace(now=100.0), list[float]()

    async def sleep(seconds: float) -> None:
        waited.append(seconds)
        clock.now += seconds

    def work(desk: object, who: object, took: float, blob: bytes) -> None:
        clock.now += took

    def in_plant(timed: Callable[[], Any]) -> "Future[Any]":
        done: Future[Any] = Future()
        done.set_result(timed())
        return done

    module, now = "heliotrope.plant.interface.service", lambda: clock.now
    patched = SimpleNamespace(Lock=asyncio.Lock, wrap_future=asyncio.wrap_future, sleep=sleep)
    monkeypatch.setattr(f"{module}.asyncio", patched)
    monkeypatch.setattr(f"{module}.time", SimpleNamespace(monotonic=now, perf_counter=now))
    turns = _Turns(cast("PlantInterface", SimpleNamespace(in_plant=in_plant)), 0.25)
    call, desk = cast("Call", SimpleNamespace(work=work)), cast("Desk", None)

    async def main() -> None:
        for took in (0.01, 0.2, 5.0, 0.0):
            await turns.do(call, desk, OLGA, took, b"")

    asyncio.run(main())
    assert waited == pytest.approx([0.0, 0.03, 0.6, 1.0])


def test_a_wrong_key_is_refused_and_noted(plant: LiveConsole) -> None:
    for name in (ORDINARY, EMERGENCY):
        for hello in ({"key": "0" * 64}, {"key": ""}, {"token": "x"}, {}, {"key": None}):
            with pytest.raises(CallError, match="not valid"):
                ask_once(plant.interface.folder / name, hello, "summary", {})
    plant.until(lambda: [e for e in plant.live.operations.logbook.events() if e.kind == "security"])


@pytest.mark.parametrize(
    ("role", "call", "given", "text"),
    [
        ("engineer", "people.account", {"name": "engineer"}, "no call"),
        ("engineer", "live", {}, "no call"),
        ("engineer", "note", {"kind": "people", "who": "", "text": ""}, "no call"),
        ("engineer", "heartbeat", {"part": "console", "address": ""}, "no call"),
        ("engineer", "order_emergency", {}, "no call"),
        ("engineer", "__class__", {}, "no call"),
        ("viewer", "resume", {}, "needs operator"),
        ("viewer", "heliostat", {"name": "nobody"}, "nobody"),
        ("viewer", "heliostat", {"name": ["P0001A"]}, "name: "),
        ("viewer", "summary", {"more": 1}, "more: "),
        ("operator", "command", {"command": "TRACK"}, "take command first"),
    ],
)
def test_calls_that_are_refused(
    plant: LiveConsole,
    tokens: dict[str, str],
    role: str,
    call: str,
    given: dict[str, Any],
    text: str,
) -> None:
    with pytest.raises(CallError, match=text):
        ask_once(plant.interface.folder / ORDINARY, {"token": tokens[role]}, call, given)


def test_what_a_token_may_see_and_order(plant: LiveConsole, tokens: dict[str, str]) -> None:
    folder, operator = plant.interface.folder, {"token": tokens["operator"]}
    for call in ("summary", "field", "alarms", "calibration", "authority", "emergency", "commands"):
        assert ask_once(folder / ORDINARY, operator, call, {}) is not None
    viewer = {"token": tokens["viewer"]}
    with pytest.raises(CallError, match="needs operator"):
        ask_once(folder / EMERGENCY, viewer, "stow", {"heliostats": [plant.live.names[0]]})
    name = plant.live.names[0]
    plant.until(
        lambda: [
            e for e in plant.live.operations.logbook.events() if "stow on this machine" in e.text
        ]
    )
    ticket = ask_once(folder / EMERGENCY, operator, "defocus", {"heliostats": [name]})
    assert (ticket["command"], ticket["heliostats"]) == ("DEFOCUS", 1)
    with pytest.raises(CallError, match="no call"):
        ask_once(folder / EMERGENCY, operator, "summary", {})


def test_the_processes_of_a_console_have_an_end_of_their_memory(plant: LiveConsole) -> None:
    """Whatever others make them keep, it never takes the plant's."""
    _answers(plant)
    for process, most in ((plant.process, 2 << 30), (plant.way, 512 << 20)):
        limits = Path(f"/proc/{process.pid}/limits").read_text("ascii")
        assert re.search(rf"^Max data size +{most} +{most} ", limits, re.MULTILINE), limits


def test_a_standing_connection_loses_what_its_account_loses(plant: LiveConsole) -> None:
    """A token that is revoked, of a disabled account or of a lower role commands no more."""
    people, now = plant.keeper.people, time.time
    lines: dict[str, LocalConnection] = {}
    for name in ("revoked", "disabled", "lowered"):
        people.add(name, "none", "operator", now())
        made, secret = people.add_token(name, "tests", "operator", now())
        hello = {"token": secret}
        lines[name] = LocalConnection(plant.interface.folder / ORDINARY, hello)
        if name == "revoked":
            revoked = made.key

    async def take() -> dict[str, str]:
        found = {}
        for name, line in lines.items():
            try:
                await line.ask("take_authority", {})
                await line.ask("release_authority", {})
                found[name] = "taken"
            except HeliotropeError as error:
                found[name] = str(error)
        return found

    async def work() -> None:
        async with asyncio.TaskGroup() as group:
            running = [group.create_task(line.run()) for line in lines.values()]
            while not all(line.up for line in lines.values()):
                await asyncio.sleep(0.02)
            assert set((await take()).values()) == {"taken"}
            people.revoke_token(revoked)
            people.change("disabled", now(), disabled=True)
            people.change("lowered", now(), role="viewer")
            await asyncio.sleep(5.5)
            found = await take()
            assert "lowered is viewer" in found["lowered"], found
            assert not lines["revoked"].up, found
            assert not lines["disabled"].up, found
            assert "taken" not in found.values()
            for one in running:
                one.cancel()

    asyncio.run(work())


def test_a_blob_of_a_viewer_is_passed_over_and_the_role_is_named(
    plant: LiveConsole, tokens: dict[str, str]
) -> None:
    path, viewer = plant.interface.folder / ORDINARY, {"token": tokens["viewer"]}
    with pytest.raises(CallError, match="needs operator"):
        ask_once(path, viewer, "aim", {"heliostats": []}, bytes(8 << 20))
    assert ask_once(path, viewer, "size", {}, bytes(8 << 20)) == 32


class Heard:
    """Whether the last local controller has heard DEFOCUS."""

    def __init__(self, count: int) -> None:
        self._who = np.zeros(count, dtype=np.bool_)

    def took(self, name: str, rows: range) -> None:
        """Note which heliostats took a command."""
        if name == "DEFOCUS":
            self._who[rows.start : rows.stop] = True

    @property
    def all(self) -> bool:
        """Whether all have."""
        return bool(self._who.all())


def test_an_emergency_passes_a_stopped_console_and_a_full_socket(
    plant: LiveConsole, tokens: dict[str, str]
) -> None:
    _raised(plant)
    _answers(plant)
    heard = Heard(32)
    for bus in plant.live.world.buses.values():
        assert isinstance(bus, FieldBus)
        bus._took = heard.took
    folder, hello = plant.interface.folder, {"token": tokens["viewer"]}
    os.kill(plant.process.pid, signal.SIGSTOP)
    flood = _flood(folder / ORDINARY, 300.0)
    try:
        time.sleep(1.0)
        view = ask_once(folder / EMERGENCY, hello, "order_emergency", {"reason": "smoke"})
        assert (view["on"], view["act"], view["who"]) == (True, "DEFOCUS", "viewer")
        plant.until(lambda: heard.all)
        assert flood.poll() is None, "the flood ended before the emergency was heard"
    finally:
        flood.kill()
        flood.wait(120.0)
        plant.calm()


def _by_the_way(plant: LiveConsole, token: str) -> httpx.Response:
    """Order an emergency by the page's second way, whatever time its process takes to begin."""
    return httpx.post(
        f"http://127.0.0.1:{plant.emergency_port}/api/v1/emergency",
        json={"reason": "smoke"},
        headers={"Authorization": f"Bearer {token}"},
        timeout=240.0,
        trust_env=False,
    )


def test_an_emergency_by_the_page_passes_a_stopped_console(
    plant: LiveConsole, tokens: dict[str, str]
) -> None:
    """The second way has a process of its own, which the end of the console does not touch."""
    assert _by_the_way(plant, tokens["viewer"]).status_code == 200
    plant.calm()
    _answers(plant)
    way, console = plant.way.pid, plant.process.pid
    os.kill(console, signal.SIGSTOP)
    try:
        answer = _by_the_way(plant, tokens["viewer"])
    finally:
        with contextlib.suppress(ProcessLookupError):  # it may have been killed meanwhile
            os.kill(console, signal.SIGCONT)
    assert (answer.status_code, answer.json()["on"]) == (200, True), answer.text
    assert plant.way.pid == way
    plant.calm()


def test_the_second_way_is_started_again_at_its_port(
    plant: LiveConsole, tokens: dict[str, str]
) -> None:
    """An order that comes before it has begun waits for it."""
    plant.until(lambda: plant.interface.heard.get("emergency"), 240.0)
    before = plant.way.pid
    os.kill(before, signal.SIGKILL)
    plant.until(lambda: plant.way.pid != before, 240.0)
    assert _by_the_way(plant, tokens["viewer"]).status_code == 200
    assert plant.way.pid not in (0, before)
    plant.calm()


def test_an_emergency_does_not_wait_for_the_store(
    plant: LiveConsole, tokens: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A token that was good lately is good while the store hangs; an unknown one is not."""
    path, hello = plant.interface.folder / EMERGENCY, {"token": tokens["viewer"]}
    given = {"reason": "smoke"}
    hang = monkeypatch.setattr
    ask_once(path, hello, "order_emergency", given)
    plant.calm()
    hang(plant.keeper.people, "token", lambda *_: time.sleep(3.0))
    try:
        assert ask_once(path, hello, "order_emergency", given)["on"]
        with pytest.raises((CallError, HeliotropeError)):
            ask_once(path, {"token": "never seen"}, "order_emergency", given)
    finally:
        monkeypatch.undo()
        plant.calm()


# -- values on their way -------------------------------------------------------------------------


def test_a_frame_of_the_field_there_and_back(plant: LiveConsole) -> None:
    frame = plant.call(plant.live.operations.viewer.frame)
    head, blob = frame_parts(frame)
    again = frame_of(plain(head), blob)
    assert again.number == frame.number
    for name in ("state", "age", "counts", "calibrated_at", "held", "truth_error"):
        np.testing.assert_array_equal(getattr(again, name), getattr(frame, name))


def test_the_tower_is_shown_between_its_receivers_or_in_the_middle_of_the_site() -> None:
    (receiver,) = example_plant().receivers
    beside = replace(receiver, name="other", center=receiver.center + [4.0, 0.0, -6.0])
    field = SimpleNamespace(cluster=(0,), clusters=("C1",))
    plant = SimpleNamespace(field=field, beams=SimpleNamespace(volumes=()))
    viewer = SimpleNamespace(positions=np.zeros((1, 3)), sizes=np.ones((1, 2)), aim_names=())
    here = SimpleNamespace(
        plant=plant, viewer=viewer, logbook=None, names=("A",), receivers=(), targets=()
    )
    middle = (receiver.center + [2.0, 0.0, -3.0]).tolist()
    for receivers, tower in (((receiver, beside), middle), ((), [0.0, 0.0, 0.0])):
        plant.design = replace(example_plant(), receivers=receivers)
        assert Desk(cast("Operations", here)).field().tower == pytest.approx(tower)


@pytest.mark.parametrize(
    "error", [RefusedError("r"), UnknownNameError("thing", "x", ["y"]), HeliotropeError("h")]
)
def test_an_error_comes_back_as_the_same_class(error: HeliotropeError) -> None:
    kind, text = kind_of(error)
    again = remade(CallError(kind, text))
    assert type(again) is type(error)
    assert str(again) == str(error)


def test_an_aim_names_at_most_200_000_heliostats() -> None:
    points = {f"P{k:06d}A": [0.0, 0.0, 60.0] for k in range(200_001)}
    for given in ({"heliostats": list(points)}, {"points": points}):
        with pytest.raises(ValidationError, match="at most 200000 items"):
            AimOrder(**given)
    points.popitem()
    assert len(AimOrder(points=points).points) == 200_000


def test_every_urgent_call_takes_beams_away() -> None:
    urgent = {name: call.request for name, call in CALLS.items() if call.urgent}
    assert urgent.keys() == {"order_emergency", "stow", "defocus"}
    assert set(urgent.values()) == URGENT


def test_a_request_of_the_api_is_the_call_of_its_row() -> None:
    assert asked("GET heliostats/A%2F1/parameters") == ("parameters", {"name": "A/1"})
    assert asked("GET heliostats/A1") == ("heliostat", {"name": "A1"})
    assert asked("GET photographs?heliostat=A1&limit=5") == (
        "kept_photographs", {"heliostat": "A1", "limit": "5"}
    )  # fmt: skip
    for name, call in CALLS.items():
        if call.request:
            assert asked(call.request)[0] == name
    for request in ("GET accounts", "PUT stow", "GET heliostats/A/B/parameters", "GET heliostats/"):
        with pytest.raises(InputError, match="known only to the console; omit --data"):
            asked(request)


def test_a_console_that_cannot_begin_is_tried_again_after_pauses_that_double(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pauses, told = list[float](), list[Alarm]()

    here = threading.get_ident()

    async def sleep(seconds: float) -> None:
        if threading.get_ident() != here:  # a plant that lives as long as all tests
            await asyncio.sleep(seconds)
            return
        pauses.append(seconds)
        if len(pauses) == 8:
            raise asyncio.CancelledError

    def listen() -> tuple[socket.socket, dict[str, Any]]:
        raise InputError("address 192.0.2.1 is not available")

    monkeypatch.setattr(
        "heliotrope.plant.interface.console_process.asyncio",
        SimpleNamespace(sleep=sleep, to_thread=asyncio.to_thread),
    )
    interface = cast("PlantInterface", SimpleNamespace(in_plant=lambda work: work()))
    process = ConsoleProcess(interface, CONSOLE, listen, told.append, lambda _: None, Patience())
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(process.run())
    assert pauses == [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0]
    assert len(told) == 8
    assert all(one.active and "192.0.2.1 is not available" in one.text for one in told)


def test_only_a_console_may_take_its_picture_of_the_plant_or_note_sign_ins() -> None:
    assert {name for name, call in CALLS.items() if call.console} == {"live", "note"}


def _done(operations: dict[str, Any], name: str, given: dict[str, Any], blob: bytes = b"") -> Any:
    """Return what a call of an operator who has the command does with these operations."""
    grant = SimpleNamespace(holder=OLGA, token=7)
    plant = SimpleNamespace(authority=SimpleNamespace(grant=grant))
    here = SimpleNamespace(plant=plant, logbook=None, **operations)
    call = CALLS[name]
    return call.work(Desk(cast("Operations", here)), OLGA, call.arguments(**given), blob)


def test_an_emergency_is_withdrawn_in_the_name_of_who_asks() -> None:
    by = list[tuple[Person, str]]()
    viewer = SimpleNamespace(emergency=lambda: not by)
    here = {"withdraw": lambda *given: by.append(given), "viewer": viewer}
    assert _done(here, "withdraw_emergency", {}) is False
    assert _done(here, "withdraw_emergency", {"owner": "Otto"}) is False
    assert by == [(OLGA, ""), (OLGA, "Otto")]


def test_a_photograph_that_is_known_is_not_sent_again() -> None:
    here = {"camera": lambda name: CameraView(name, 3, 0.0, b"jpeg")}
    for known, sent in ((-1, b"jpeg"), (2, b"jpeg"), (3, b"")):
        found = _done(here, "photograph", {"name": "left", "known": known})
        assert (found.value, found.blob) == ({"version": 3}, sent)


def test_an_aim_is_a_place_or_points_and_never_both() -> None:
    aimed = list[Any]()
    here = {
        "aim_at": lambda who, token, heliostats, where, place: aimed.append(
            (token, heliostats, where)
        ),
        "aim": lambda who, token, points: aimed.append((token, points["A"].tolist())),
    }
    point = np.array([1.0, 2.0, 3.0])
    place = {"heliostats": ["A"], "where": "left"}
    assert isinstance(_done(here, "aim", place), Later)
    assert isinstance(_done(here, "aim", {"points": ["A"]}, point.tobytes()), Later)
    assert aimed == [(7, ["A"], "left"), (7, [1.0, 2.0, 3.0])]
    for given, blob in ((place | {"points": ["A"]}, point.tobytes()), ({"heliostats": ["A"]}, b"")):
        with pytest.raises(InputError, match="specify either where"):
            _done(here, "aim", given, blob)


@pytest.mark.parametrize(
    "point", [[1.0, 2.0], [1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 100_001.0], [1.0, 2.0, "3"], []]
)
def test_a_point_that_is_none_is_refused_by_its_name(point: list[Any]) -> None:
    good = {"A": [1.0, 2.0, -100_000.0]}
    assert AimOrder(points=good).points == good
    with pytest.raises(ValidationError, match="B: specify east, north and up in m"):
        AimOrder(points=good | {"B": point})


def test_a_word_orders_one_emergency_however_often_it_is_sent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Another word, another person, no word and the same word much later order another."""
    clock, given = SimpleNamespace(now=0.0), list[tuple[str, str]]()
    monkeypatch.setattr(
        "heliotrope.plant.interface.desk.time", SimpleNamespace(monotonic=lambda: clock.now)
    )
    operations = SimpleNamespace(
        plant=None,
        logbook=None,
        emergency=lambda who, act, reason: given.append((who.name, reason)),
        viewer=SimpleNamespace(emergency=lambda: len(given)),
    )
    desk = Desk(cast("Operations", operations))
    vera, olga = Person("Vera", Role.VIEWER), Person("Olga", Role.OPERATOR)

    def sent(who: Person, word: str) -> Any:
        return desk.order_emergency(who, EmergencyCall(reason="smoke", call=word))

    assert [sent(vera, "one") for _ in range(3)] == [1, 1, 1]
    assert [sent(vera, "two"), sent(olga, "one"), sent(vera, "one")] == [2, 3, 3]
    assert [sent(vera, ""), sent(vera, "")] == [4, 5]
    clock.now = SAME - 1.0
    assert sent(vera, "one") == 5
    clock.now = SAME + 1.0
    assert sent(vera, "one") == 6
    assert given[-1] == ("Vera", "smoke")
