"""Attack a plant of one's own on loopback, and measure what the plant notices.

    python scripts/attack.py            all attacks
    python scripts/attack.py NAME …     some of them

It starts `heliotrope run --heliostats 320` and makes a viewer's token. During each attack it
measures the longest time that the plant's own loop takes to answer, and those of `/health` and of
an EMERGENCY by the signed-in viewer. The exit code is 1 if a limit is passed. An attack is a
function of `ATTACKS`: add others there.
"""

import argparse
import contextlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx

from heliotrope.errors import HeliotropeError
from heliotrope.local import ORDINARY, ask_once, socket_folder

ROOT = Path(__file__).parents[1]
#: Limits: emergency and lag of the plant, s; memory of all processes, MB; lines of the log in one
#: attack.
EMERGENCY, LAG, MEMORY, LINES = 1.0, 0.2, 2000.0, 200
#: Length of an attack, s; connections and requests that it makes.
SECONDS, CONNECTIONS = 8.0, 1100
#: Nested JSON of some 16 MB.
_NESTED = b"[" * 900 + b"]" * 900
FLOOD = b'{"name":[' + b",".join([_NESTED] * (16_000_000 // len(_NESTED))) + b"]}"


@dataclass
class Target:
    """The plant under attack: ports, a viewer's token, and its processes."""

    port: int
    urgent: int
    token: str
    data: Path
    process: "subprocess.Popen[bytes]"
    log: Path

    @property
    def url(self) -> str:
        """Address of the console."""
        return f"http://127.0.0.1:{self.port}/"

    def memory(self) -> float:
        """Return the resident memory of all processes, MB."""
        pages = 0
        for pid in (self.process.pid, *_children(self.process.pid)):
            with contextlib.suppress(OSError):
                pages += int(Path(f"/proc/{pid}/statm").read_text("ascii").split()[1])
        return pages * resource.getpagesize() / 1e6

    def lines(self) -> int:
        """Return the number of lines that the plant has written."""
        return self.log.read_bytes().count(b"\n")


def _children(pid: int) -> list[int]:
    found = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):
            found += [int(one) for one in (task / "children").read_text("ascii").split()]
    return found


def send(target: Target, head: str, body: bytes) -> None:
    """Send a request of a stranger as it is, and read the beginning of the answer."""
    text = (
        f"{head} HTTP/1.1\r\nHost: 127.0.0.1:{target.port}\r\nContent-Length: {len(body)}\r\n\r\n"
    )
    with (
        contextlib.suppress(OSError),
        socket.create_connection(("127.0.0.1", target.port), timeout=30.0) as line,
    ):
        line.sendall(text.encode())
        line.sendall(body)
        line.recv(1000)


def nothing(target: Target, over: threading.Event) -> None:
    """No attack: what the measurement itself takes."""
    del target
    over.wait()


def nested(target: Target, over: threading.Event) -> None:
    """16 MB of nested JSON to the sign-in."""
    while not over.is_set():
        send(target, "POST /api/v1/session", FLOOD)


def unauthorised(target: Target, over: threading.Event) -> None:
    """16 MB of nested JSON to a route that needs a role."""
    while not over.is_set():
        send(target, "POST /api/v1/aim", FLOOD)


def _held(target: Target, over: threading.Event, text: bytes) -> None:
    """Hold connections at both ports; a closed one is opened again."""
    with contextlib.ExitStack() as stack:
        for number in range(CONNECTIONS):
            port = target.port if number % 4 else target.urgent
            with contextlib.suppress(OSError):
                line = socket.create_connection(("127.0.0.1", port), timeout=2.0)
                stack.enter_context(line).sendall(text)
            if over.is_set():
                return
        over.wait()


def idle(target: Target, over: threading.Event) -> None:
    """1,100 connections that send nothing."""
    _held(target, over, b"")


def half_open(target: Target, over: threading.Event) -> None:
    """1,100 connections with half a request."""
    _held(target, over, b"POST /api/v1/emergency HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow:")


def unknown_paths(target: Target, over: threading.Event) -> None:
    """90 unknown paths a second."""
    with httpx.Client(base_url=target.url, trust_env=False, timeout=30.0) as client:
        number = 0
        while not over.wait(1.0 / 90.0):
            number += 1
            with contextlib.suppress(httpx.HTTPError):
                client.get(f"nothing/{number}")


def wrong_passwords(target: Target, over: threading.Event) -> None:
    """Wrong passwords for the engineer, as fast as they are answered."""
    guess = {"name": "engineer", "password": "not the password"}
    with httpx.Client(base_url=target.url, trust_env=False, timeout=30.0) as client:
        while not over.is_set():
            with contextlib.suppress(httpx.HTTPError):
                client.post("api/v1/session", json=guess)


def foreign_sockets(target: Target, over: threading.Event) -> None:
    """Sockets of the page's framework from another site."""
    head = (
        "GET /_nicegui_ws/socket.io/?EIO=4&transport=websocket HTTP/1.1\r\n"
        f"Host: 127.0.0.1:{target.port}\r\nOrigin: http://evil.example\r\nConnection: Upgrade\r\n"
        "Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    ).encode()
    while not over.wait(0.01):
        with (
            contextlib.suppress(OSError),
            socket.create_connection(("127.0.0.1", target.port), timeout=5.0) as line,
        ):
            line.sendall(head)
            if b" 101 " in line.recv(200):
                sys.exit("attack: a socket from another site was accepted")


#: The attacks by name.
ATTACKS: dict[str, Callable[[Target, threading.Event], None]] = {
    "nothing": nothing,
    "nested": nested,
    "unauthorised": unauthorised,
    "idle": idle,
    "half-open": half_open,
    "unknown-paths": unknown_paths,
    "wrong-passwords": wrong_passwords,
    "foreign-sockets": foreign_sockets,
}


def _free() -> int:
    with socket.create_server(("127.0.0.1", 0)) as line:
        return int(line.getsockname()[1])


@contextlib.contextmanager
def plant(folder: Path, descriptors: int | None) -> Iterator[Target]:
    """Run a plant of 320 heliostats during a block."""
    port, urgent, log = _free(), _free(), folder / "log.txt"

    def few() -> None:
        if descriptors is not None:
            resource.setrlimit(resource.RLIMIT_NOFILE, (descriptors, descriptors))

    with log.open("wb") as out:
        process = subprocess.Popen(  # noqa: S603  # fixed arguments
            [str(Path(sys.executable).with_name("heliotrope")), "run", "--heliostats", "320",
             "--no-browser",
             "--port", str(port), "--emergency-port", str(urgent), "--data", str(folder / "data")],
            stdout=out, stderr=subprocess.STDOUT, start_new_session=True,
            preexec_fn=few,  # noqa: PLW1509 - no thread runs yet
        )  # fmt: skip
    try:
        password = _password(process, log, folder / "data" / "first-password")
        yield Target(port, urgent, _token(port, password), folder / "data", process, log)
    finally:
        process.send_signal(signal.SIGINT)
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)  # do not wait for the stow
        try:
            process.wait(60.0)
        except subprocess.TimeoutExpired:
            process.kill()


def _password(process: "subprocess.Popen[bytes]", log: Path, kept: Path) -> str:
    """Return the first account's password from its file, once the console answers."""
    until = time.monotonic() + 180.0
    while time.monotonic() < until and process.poll() is None:
        if "console: http" in log.read_text("utf-8") and kept.exists():
            return kept.read_text("utf-8").split()[-1]
        time.sleep(0.2)
    sys.exit(f"attack: the plant has not started:\n{log.read_text('utf-8')[-2000:]}")


def _token(port: int, password: str) -> str:
    """Return a token of the role viewer."""
    with httpx.Client(
        base_url=f"http://127.0.0.1:{port}/api/v1/", trust_env=False, timeout=30.0
    ) as client:
        own = f"{password}-own"
        for word in (password, own):
            given = client.post("session", json={"name": "engineer", "password": word})
            client.headers["X-CSRF-Token"] = given.raise_for_status().json()["csrf"]
            if word == password:
                change = client.put("session/password", json={"old": word, "new": own})
                change.raise_for_status()
        made = client.post(
            "tokens",
            json={"label": "attack", "role": "viewer", "days": 1, "own_password": own},
        )
        return str(made.raise_for_status().json()["secret"])


@dataclass
class Measured:
    """What was seen during an attack: longest times, s, memory, MB, and lines of the log."""

    lag: float = 0.0
    health: float = 0.0
    emergency: float = 0.0
    memory: float = 0.0
    lines: int = 0

    def passed(self) -> bool:
        """Whether all limits were kept."""
        within = self.lag <= LAG and self.emergency <= EMERGENCY
        return within and self.memory <= MEMORY and self.lines <= LINES


def timed(act: Callable[[], object]) -> float:
    """Return how long something took, s; infinite if it failed."""
    begun = time.monotonic()
    try:
        act()
    except (httpx.HTTPError, HeliotropeError, OSError):
        return float("inf")
    return time.monotonic() - begun


def order(target: Target) -> None:
    """Order an emergency by both ways, as the page does; return when the first has answered."""
    done, word = threading.Event(), f"{time.time()}"
    headers = {"Authorization": f"Bearer {target.token}"}

    def one(port: int) -> None:
        with contextlib.suppress(httpx.HTTPError):
            url = f"http://127.0.0.1:{port}/api/v1/emergency"
            body = {"reason": "attack", "call": word}
            answer = httpx.post(url, json=body, headers=headers, timeout=20.0, trust_env=False)
            if answer.status_code == 200:
                done.set()

    for port in (target.port, target.urgent):
        threading.Thread(target=one, args=(port,), daemon=True).start()
    if not done.wait(20.0):
        raise OSError("no answer")


class Probe:
    """Asks the plant itself ten times a second, past its console; a context manager.

    The plant's loop makes each answer, so the longest time bounds how far the loop fell behind.
    """

    def __init__(self, target: Target) -> None:
        self._path = socket_folder(target.data) / ORDINARY
        self._hello = {"token": target.token}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.longest = 0.0

    def __enter__(self) -> "Probe":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join(30.0)

    def _run(self) -> None:
        while not self._over.wait(0.1):
            self.longest = max(self.longest, timed(self._ask))

    def _ask(self) -> None:
        ask_once(self._path, self._hello, "emergency", {}, timeout=20.0)


def health(target: Target) -> None:
    """Ask the console whether it answers."""
    httpx.get(f"{target.url}api/v1/health", timeout=20.0, trust_env=False)


def measure(target: Target, attack: Callable[[Target, threading.Event], None]) -> Measured:
    """Attack for some seconds; return the worst that was seen."""
    over, worst, before = threading.Event(), Measured(), target.lines()
    works = [threading.Thread(target=attack, args=(target, over), daemon=True) for _ in range(2)]
    with Probe(target) as probe:
        for work in works:
            work.start()
        until = time.monotonic() + SECONDS
        while time.monotonic() < until:
            time.sleep(0.5)
            worst.health = max(worst.health, timed(lambda: health(target)))
            worst.emergency = max(worst.emergency, timed(lambda: order(target)))
            worst.memory = max(worst.memory, target.memory())
        over.set()
    for work in works:
        work.join(30.0)
    worst.lag = probe.longest
    worst.lines = target.lines() - before
    return worst


def main() -> int:
    """Attack; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("attacks", nargs="*", metavar="NAME", help=", ".join(ATTACKS))
    parser.add_argument("--descriptors", type=int, help="hard limit of the plant's descriptors")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    given = parser.parse_args()
    names = given.attacks or list(ATTACKS)
    # Ended from outside, it ends its plant too.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    if unknown := set(names) - set(ATTACKS):
        parser.error(f"no attack {', '.join(sorted(unknown))}; there are {', '.join(ATTACKS)}")
    os.environ.setdefault("PYTHONPATH", str(ROOT / "src"))
    found = {}
    print(f"limits: lag {LAG:g} s, EMERGENCY {EMERGENCY:g} s, memory {MEMORY:g} MB, {LINES} lines")
    print(f"{'attack':18}{'lag s':>8}{'health s':>10}{'EMERGENCY s':>13}{'MB':>8}{'lines':>8}")
    with tempfile.TemporaryDirectory() as folder, plant(Path(folder), given.descriptors) as target:
        time.sleep(5.0)
        for name in names:
            one = found[name] = measure(target, ATTACKS[name])
            print(
                f"{name:18}{one.lag:8.2f}{one.health:10.2f}{one.emergency:13.2f}"
                f"{one.memory:8.0f}{one.lines:8}{'' if one.passed() else '  PASSED A LIMIT'}",
                flush=True,
            )
            if target.process.poll() is not None:
                sys.exit(f"attack: {name} has ended the plant")
    if given.json is not None:
        given.json.write_text(json.dumps({k: vars(v) for k, v in found.items()}), "utf-8")
    return 0 if all(one.passed() for one in found.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
