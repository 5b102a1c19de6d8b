"""A plant on loopback with gauges in it, and what is measured of it during an attack.

`plant` starts `heliotrope run --heliostats 320` with gauges (`gauges.py`). `measure` makes one of
the attacks of `attacks.py` for some seconds, and gives the worst that was seen meanwhile: how far
the plant's loop fell behind, how old a lease became, how long an EMERGENCY by the page's two ports
and DEFOCUS by `heliotrope ctl` took to the last local controller, the memory of all processes and
the lines of the log.
"""

import contextlib
import math
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import httpx

from support.attacks import Attack, Place

GAUGES = Path(__file__).with_name("gauges.py")
HELIOSTATS = 320
#: Limits: lag of the loop, age of a lease and EMERGENCY, s; memory of all processes, MB; lines of
#: the log in one attack.
LAG, LEASE, EMERGENCY, MEMORY, LINES = 0.2, 3.0, 1.0, 2000.0, 200
#: Everybody's password, and tokens of the operator who stands by.
PASSWORD, TOKENS = "a password of one's own", 40
#: Length of an attack, pause between orders, and longest wait for one, s.
SECONDS, PAUSE, LONGEST = 8.0, 2.0, 20.0
#: Time for the plant to start, s: a busy machine compiles its kernels first.
_START = 600.0


@dataclass
class Target(Place):
    """The plant under attack, with its processes, its log and the file of the gauges.

    ``unmet`` are tokens of the operator Olga that no process has met.
    """

    unmet: list[str] = field(repr=False)
    process: "subprocess.Popen[bytes]" = field(repr=False)
    log: Path
    gauges: Path

    def memory(self) -> float:
        """Return the memory of all processes, MB; what they share counts once."""
        size = 0
        for pid in (self.process.pid, *_children(self.process.pid)):
            with contextlib.suppress(OSError):
                text = Path(f"/proc/{pid}/smaps_rollup").read_text("ascii")
                size += sum(int(kb) for kb in re.findall(r"^Pss:\s+(\d+) kB", text, re.MULTILINE))
        return size * 1024 / 1e6

    def stored(self) -> float:
        """Return the size of the plant's records, MB."""
        return sum(file.stat().st_size for file in self.data.glob("*sqlite*")) / 1e6

    def lines(self) -> int:
        """Return the number of lines that the plant has written."""
        return self.log.read_bytes().count(b"\n")

    def noted(self, since: float) -> list[list[float]]:
        """Return the lines of the gauges since a time, POSIX s."""
        text = self.gauges.read_text("ascii")
        rows = [[float(word) for word in line.split()] for line in text.split("\n")[:-1]]
        return [row for row in rows if row[0] >= since]

    def withdraw(self) -> bool:
        """Withdraw the emergency in the plant itself; return whether that is done soon."""
        asked, until = self.gauges.with_name(f"{self.gauges.name}.withdraw"), time.time() + LONGEST
        asked.touch()
        while asked.exists() and time.time() < until:
            time.sleep(0.02)
        return not asked.exists()

    def until_heard(self, since: float) -> float:
        """Return how long it took until each local controller had heard DEFOCUS, s."""
        while time.time() - since < LONGEST:
            for at, _, _, heard in self.noted(since):
                if heard >= since:
                    return at - since
            time.sleep(0.05)
        return math.inf


def _children(pid: int) -> list[int]:
    found = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):
            found += [int(one) for one in (task / "children").read_text("ascii").split()]
    return found


def _free() -> int:
    with socket.create_server(("127.0.0.1", 0)) as line:
        return int(line.getsockname()[1])


@contextlib.contextmanager
def plant(
    folder: Path, descriptors: int | None, *options: str, heliostats: int = HELIOSTATS
) -> Iterator[Target]:
    """Run a plant during a block, with further options of ``heliotrope run``."""
    port, urgent, log, gauges = _free(), _free(), folder / "log.txt", folder / "gauges.txt"

    def few() -> None:
        if descriptors is not None:
            resource.setrlimit(resource.RLIMIT_NOFILE, (descriptors, descriptors))

    program = [sys.executable, str(GAUGES), str(gauges), str(heliostats)]
    words = ["run", "--heliostats", str(heliostats), "--no-browser", "--port", str(port),
             "--emergency-port", str(urgent), "--data", str(folder / "data"), *options]  # fmt: skip
    with log.open("wb") as out:
        process = subprocess.Popen(  # fixed arguments
            [*program, *words],
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=few,  # noqa: PLW1509 - no thread runs yet
        )
    try:
        viewer, operator, *unmet = _tokens(port, _link(process, log))
        cluster = int(gauges.with_name(f"{gauges.name}.port").read_text("ascii"))
        data = folder / "data"
        yield Target(port, urgent, cluster, viewer, operator, data, unmet, process, log, gauges)
    finally:
        process.send_signal(signal.SIGINT)
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)  # do not wait for the stow
        try:
            process.wait(60.0)
        except subprocess.TimeoutExpired:
            process.kill()


def _link(process: "subprocess.Popen[bytes]", log: Path) -> str:
    """Return the one-time link, once the console answers."""
    until = time.monotonic() + _START
    while time.monotonic() < until and process.poll() is None:
        if found := re.search(r"console: (http\S+)\n", log.read_text("utf-8")):
            return found[1]
        time.sleep(0.2)
    raise RuntimeError(f"the plant has not started:\n{log.read_text('utf-8')[-2000:]}")


def _tokens(port: int, link: str) -> list[str]:
    """Set the first password and make accounts.

    Returns
    -------
    A token of Vera, a viewer, one of Mallory, an operator, and some of Olga, an operator.
    """
    from heliotrope.console.client import Client
    from support.one_time_link import set_password

    set_password(link, PASSWORD)
    secrets: list[str] = []
    with Client(url=f"http://127.0.0.1:{port}/") as client:
        client.sign_in("engineer", PASSWORD)
        for name, role, count in (
            ("Vera", "viewer", 1),
            ("Mallory", "operator", 1),
            ("Olga", "operator", TOKENS),
        ):
            account = {"name": name, "role": role, "password": "given " + PASSWORD}
            client.ask("POST", "accounts", {**account, "own_password": PASSWORD})
            with Client(url=f"http://127.0.0.1:{port}/") as own:
                own.sign_in(name, account["password"])
                own.change_password(account["password"], PASSWORD)
            with Client(url=f"http://127.0.0.1:{port}/") as own:
                own.sign_in(name, PASSWORD)
                given = {"label": "attack", "days": 1, "own_password": PASSWORD, "role": role}
                made = [own.ask("POST", "tokens", given) for _ in range(count)]
            secrets += [str(one["secret"]) for one in made]
    return secrets


@dataclass
class Measured:
    """What was seen during an attack: longest times, s, memory, MB, and lines of the log.

    ``page`` and ``ctl`` are those of `by_page` and `by_ctl`.
    """

    lag: float = 0.0
    lease: float = 0.0
    page: float = 0.0
    ctl: float = 0.0
    health: float = 0.0
    memory: float = 0.0
    lines: int = 0

    def over(self) -> list[str]:
        """Return the limits that were exceeded."""
        limits = {"lag": LAG, "lease": LEASE, "page": EMERGENCY, "ctl": EMERGENCY,
                  "memory": MEMORY, "lines": LINES}  # fmt: skip
        return [name for name, limit in limits.items() if getattr(self, name) > limit]


def by_page(target: Target) -> float:
    """Order an emergency by both ways, as the page does.

    Returns
    -------
    The time until it has an answer and the last local controller has heard it, s.
    """
    if not target.withdraw():  # one that stands is not sent again
        print("  the emergency before could not be withdrawn")
        return math.inf
    since, done, word = time.time(), threading.Event(), f"{time.time()}"
    headers = {"Authorization": f"Bearer {target.operator}"}

    def one(port: int) -> None:
        with contextlib.suppress(httpx.HTTPError):
            url = f"http://127.0.0.1:{port}/api/v1/emergency"
            body = {"reason": "attack", "call": word}
            answer = httpx.post(url, json=body, headers=headers, timeout=LONGEST, trust_env=False)
            if answer.status_code == 200:
                done.set()

    for port in (target.port, target.urgent):
        threading.Thread(target=one, args=(port,), daemon=True).start()
    if not done.wait(LONGEST):
        return math.inf
    return max(time.time() - since, target.until_heard(since))


def by_ctl(target: Target) -> float:
    """Defocus the field by `heliotrope ctl`, without the console.

    Returns
    -------
    The time until the last local controller has heard it, s, the start of the program included.
    """
    since = time.time()
    program = str(Path(sys.executable).with_name("heliotrope"))
    words = [program, "ctl", "--data", str(target.data), "defocus", "--all"]
    environment = {**os.environ, "HELIOTROPE_TOKEN": target.operator}
    with subprocess.Popen(  # fixed arguments
        words, stdout=subprocess.DEVNULL, env=environment
    ) as process:
        took = target.until_heard(since)
        process.kill()
    return took


def health(target: Target) -> float:
    """Return how long the console takes to say that it is there, s."""
    begun = time.monotonic()
    try:
        httpx.get(f"{target.url}api/v1/health", timeout=LONGEST, trust_env=False)
    except httpx.HTTPError:
        return math.inf
    return time.monotonic() - begun


def measure(target: Target, attack: Attack) -> Measured:
    """Attack for some seconds; return the worst that was seen."""
    over, worst, before, since = threading.Event(), Measured(), target.lines(), time.time()
    works = [threading.Thread(target=attack, args=(target, over), daemon=True) for _ in range(2)]
    for work in works:
        work.start()
    ways: list[tuple[str, Callable[[Target], float]]] = [("page", by_page), ("ctl", by_ctl)]
    for name, way in ways * int(SECONDS / (2.0 * PAUSE)):
        time.sleep(0.75 * PAUSE)
        setattr(worst, name, max(getattr(worst, name), way(target)))
        worst.health = max(worst.health, health(target))
        worst.memory = max(worst.memory, target.memory())
    over.set()
    for work in works:
        work.join(30.0)
    for _, lag, lease, _ in target.noted(since):
        worst.lag, worst.lease = max(worst.lag, lag), max(worst.lease, lease)
    worst.lines = target.lines() - before
    return worst


def row(name: str, found: Measured) -> str:
    """Return a row of the table of docs/explanation/security.md."""
    over = f"**failed**: {', '.join(found.over())}" if found.over() else "passed"
    return (
        f"| *{name}* | {found.lag:.2f} | {found.lease:.2f} | {found.page:.2f} | {found.ctl:.2f} | "
        f"{found.memory:.0f} | {over} |"
    )
