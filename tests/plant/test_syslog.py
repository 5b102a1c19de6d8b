"""Security events and alarms sent on, to real receivers on loopback."""

import contextlib
import os
import re
import socket
import sqlite3
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.errors import InputError
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.io.syslog import Receiver, Syslog
from heliotrope.plant.operations import Logbook, SecurityEvent, SecurityNote
from heliotrope.safety import alarms
from heliotrope.store import chain
from heliotrope.store.records import StoreError
from support.papers import certificate

PATIENCE = 60.0
#: RFC 5424, section 6: header, one element of structured data, and a text in UTF-8.
LINE = re.compile(
    rb"<(?P<pri>\d{1,3})>1 (?P<at>\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{1,6}Z) "
    rb"(?P<host>[!-~]{1,255}) (?P<app>[!-~]{1,48}) (?P<pid>[!-~]{1,128}) (?P<id>[!-~]{1,32}) "
    rb'\[meta sequenceId="(?P<n>\d+)"\] '
    rb"\xef\xbb\xbf(?P<text>[^\x00-\x1f]*)",
    re.S,
)
AT = datetime(2026, 6, 21, 10, 0, 0, 250_000, tzinfo=UTC).timestamp()


class Heard(threading.Thread):
    """A receiver: whole messages, in order; ``pause`` keeps it from reading."""

    def __init__(self, scheme: str, tls: ssl.SSLContext | None = None, port: int = 0) -> None:
        super().__init__(daemon=True)
        kind = socket.SOCK_DGRAM if scheme == "udp" else socket.SOCK_STREAM
        self._line = socket.socket(socket.AF_INET, kind)
        self._line.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._line.bind(("127.0.0.1", port))
        self.port, self._tls, self._udp = self._line.getsockname()[1], tls, scheme == "udp"
        if not self._udp:
            self._line.listen()
        self.messages: list[bytes] = []
        self._connections: list[socket.socket] = []
        self.start()

    def run(self) -> None:
        try:
            if self._udp:
                while True:
                    self.messages.append(self._line.recv(65536))
            while True:
                self._read(self._line.accept()[0])
        except OSError:
            pass

    def _read(self, end: socket.socket) -> None:
        try:
            if self._tls is not None:
                end = self._tls.wrap_socket(end, server_side=True)
            self._connections.append(end)
            data = b""
            while part := end.recv(4096):
                data += part
                while found := re.match(rb"(\d+) ", data):
                    size = found.end() + int(found[1])
                    if len(data) < size:
                        break
                    self.messages.append(data[found.end() : size])
                    data = data[size:]
        except OSError:
            pass

    def stop(self) -> None:
        for end in (self._line, *self._connections):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
        self.join(0.0 if self._udp else PATIENCE)


@pytest.fixture
def receivers() -> Iterator[Callable[..., Heard]]:
    made: list[Heard] = []

    def start(*words: object) -> Heard:
        made.append(Heard(*words))  # type: ignore[arg-type]
        return made[-1]

    yield start
    for each in made:
        each.stop()


def until(holds: Callable[[], object]) -> None:
    end = time.monotonic() + PATIENCE
    while not holds():
        assert time.monotonic() < end, "it did not come to that"
        time.sleep(0.01)


def note(number: int = 0) -> SecurityNote:
    return SecurityNote(SecurityEvent.SIGN_IN_FAILED, AT, "änne", "10.0.0.9", f"try {number}")


@pytest.mark.parametrize("scheme", ["udp", "tcp", "tls"])
def test_a_receiver_gets_whole_messages(
    scheme: str, receivers: Callable[..., Heard], tmp_path: Path
) -> None:
    tls, authority = None, None
    if scheme == "tls":
        authority, key = certificate(tmp_path, 90.0)
        tls = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        tls.load_cert_chain(authority, key)
    heard = receivers(scheme, tls)
    receiver = Receiver.read(f"{scheme}://127.0.0.1:{heard.port}", authority)
    sender = Syslog(receiver, lambda: AT)
    sender.note(note())
    until(lambda: len(heard.messages) == 1)
    # Between messages it looks whether the connection still stands.
    time.sleep(0.5)
    sender.alarm(alarms.CAMERA.raised("T1", problem="no\nframe" + "ß" * 2000))
    sender.alarm(alarms.CAMERA.ended("T1"))
    sender.close(PATIENCE)
    until(lambda: len(heard.messages) == 3)
    assert (sender.problem, sender.lost) == ("", 0)
    assert len(heard._connections) == (scheme != "udp"), "one that stands is kept"
    first, second, third = (LINE.fullmatch(message) for message in heard.messages)
    assert first
    assert second
    assert third
    assert (first["pri"], second["pri"], third["pri"]) == (b"84", b"132", b"134")
    assert first["at"] == b"2026-06-21T10:00:00.250Z"
    assert (first["app"], first["id"], second["id"]) == (
        b"heliotrope",
        b"SIGN_IN_FAILED",
        b"camera",
    )
    assert first["text"].decode() == "failed to sign in: try 0 (from 10.0.0.9) by änne"
    assert second["text"].decode().startswith("camera T1: target T1: no frameßß")
    assert [int(one["n"]) for one in (first, second, third)] == [1, 2, 3]
    assert max(map(len, heard.messages)) <= 2048


def test_tls_to_a_stranger_is_refused(receivers: Callable[..., Heard], tmp_path: Path) -> None:
    pem, key = certificate(tmp_path, 90.0)
    other, _ = certificate(tmp_path, 91.0)
    tls = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    tls.load_cert_chain(pem, key)
    heard = receivers("tls", tls)
    sender = Syslog(Receiver.read(f"tls://127.0.0.1:{heard.port}", other), lambda: AT)
    sender.note(note())
    until(lambda: "certificate" in sender.problem.lower())
    sender.close()
    assert heard.messages == []


def test_what_finds_no_place_is_counted_and_told(receivers: Callable[..., Heard]) -> None:
    free = Heard("tcp")
    free.stop()
    sender = Syslog(Receiver.read(f"tcp://127.0.0.1:{free.port}"), lambda: AT, most=10)
    sender.note(note())
    until(lambda: sender.problem)
    assert f"tcp://127.0.0.1:{free.port} (Connection refused)" in sender.problem
    for number in range(1, 25):
        sender.note(note(number))
    assert sender.lost == 14
    heard = receivers("tcp", None, free.port)
    until(lambda: len(heard.messages) == 12 and not sender.problem)
    found = [LINE.fullmatch(message) for message in heard.messages]
    assert all(found)
    texts = [one["text"].decode() for one in found if one]
    assert (
        sum("14 messages were lost because more than 10 were waiting" in text for text in texts)
        == 1
    )
    tries = [int(number) for text in texts for number in re.findall(r"try (\d+)", text)]
    assert tries == list(range(11))
    sender.close(PATIENCE)


def test_a_receiver_that_comes_back_gets_the_next_message(receivers: Callable[..., Heard]) -> None:
    first = receivers("tcp")
    sender = Syslog(Receiver.read(f"tcp://127.0.0.1:{first.port}"), lambda: AT)
    sender.note(note(1))
    until(lambda: first.messages)
    first.stop()
    until(lambda: sender.problem)
    second = receivers("tcp", None, first.port)
    sender.note(note(2))
    until(lambda: second.messages)
    assert b"try 2" in second.messages[0]
    sender.close(PATIENCE)


@pytest.mark.parametrize(
    "url", ["http://host", "host:514", "tls://", "tcp://host:99999", "udp://host/x", "tls://h:0"]
)
def test_other_urls_are_refused(url: str) -> None:
    with pytest.raises(InputError, match="specify udp://host, tcp://host or tls://host"):
        Receiver.read(url)


def test_ports_are_the_registered_ones() -> None:
    assert str(Receiver.read("tls://guard")) == "tls://guard:6514"
    assert str(Receiver.read("udp://[::1]")) == "udp://[::1]:514"


def test_the_logbook_sends_alarms_on_when_they_begin_and_end() -> None:
    async def main(clock: VirtualClock) -> list[tuple[str, bool]]:
        book, sent = Logbook(clock), []
        book.forward = lambda alarm: sent.append((alarm.subject, alarm.active))
        for _ in range(3):
            book.take_alarm(alarms.CAMERA.raised("T1", problem="dark"))
        book.take_alarm(alarms.CAMERA.ended("T1"))
        return sent

    assert run_virtual(main) == [("T1", True), ("T1", False)]


def test_evidence_of_a_plant_at_work_shows_an_event_that_was_altered(
    receivers: Callable[..., Heard], tmp_path: Path
) -> None:
    """`run` sends heads by syslog and writes them to a folder; the store is checked with both."""
    heard, folder, data = receivers("tcp"), tmp_path / "heads", tmp_path / "data"
    folder.mkdir()
    words = ["run", "--heliostats", "4", "--idle", "--no-console", "--minutes", "0.05",
             "--data", str(data), "--heads", str(folder),
             "--syslog", f"tcp://127.0.0.1:{heard.port}"]  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", "from heliotrope.cli import main; main()", *words],
        env={**os.environ, "HELIOTROPE_THREADS": "1"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=600.0,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    written = chain.read_heads(folder / chain.HEADS)
    newest = max(head.number for head in written)
    assert newest > 0
    until(lambda: sum(b" CHAIN_HEAD " in message for message in heard.messages) >= 4)
    log = tmp_path / "log"
    log.write_bytes(b"\n".join(heard.messages))
    assert chain.read_heads(log) == written
    command = [
        "store",
        "verify",
        str(data),
        "--head",
        str(folder / chain.HEADS),
        "--head",
        str(log),
    ]
    good = CliRunner().invoke(app, command)
    assert good.exit_code == 0, good.exception
    assert re.search(r"^[1-9]\d* of \d+ heads match; ", good.output)
    alter = "UPDATE event SET text = 'quiet' WHERE number = ?"
    with contextlib.closing(sqlite3.connect(data / "store.sqlite")) as store, store:
        assert store.execute(alter, (newest,)).rowcount == 1
    bad = CliRunner().invoke(app, command)
    assert isinstance(bad.exception, StoreError)
    assert f"event {newest} " in str(bad.exception)
