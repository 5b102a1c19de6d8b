"""The console under load: 10,000 heliostats, 50 viewers and 5 operators, and one page in a browser.

The plant (twin, all clusters) is one process and the console another, as under ``heliotrope run``;
the viewers are a third, Chromium others. All share the machine: with two cores that is the hardest
part. First the page is alone with the plant: the time until it is ready, and the frames per second
that it draws while the map is panned and while its table of all heliostats is scrolled, and the
bytes a second that it receives. Then all viewers connect, and EMERGENCY is clicked in the
page: the time until the last local controller has heard DEFOCUS on its bus, and until the plant has
the acknowledgement of each.
"""

import asyncio
import contextlib
import multiprocessing
import shutil
import tempfile
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._run import BenchmarkError, Result, Row

CHROMIUM = shutil.which("chromium") or "/usr/bin/chromium"
ARGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
NAME, PASSWORD = "engineer", "a long enough password"
VIEWERS, OPERATORS = 50, 5
READY_S, FRAMES, EMERGENCY_S, MESSAGES = 3.0, 20.0, 1.0, 1.0
#: Bytes a second that a viewer may receive.
BYTES = 10_000.0
#: Pans the map a little in each frame for some milliseconds; returns the frames per second.
PAN = """span => new Promise(done => { const map = window.heliotropeMap; let frames = 0, begin = 0;
  const turn = now => { begin ||= now;
    if (now - begin >= span) return done(1e3 * frames / (now - begin));
    frames += 1; map.pan(frames % 120 < 60 ? 3 : -3, 1 - 2 * (frames % 2));
    requestAnimationFrame(turn); };
  requestAnimationFrame(turn); })"""
#: Scrolls the table a little in each frame for some milliseconds; returns the frames per second,
#: the median time in which it draws and lays out its rows, ms, and how many rows it holds.
SCROLL = """span => new Promise(done => { const grid = document.querySelector('.hx-grid');
  let frames = 0, begin = 0;
  const draw = (_, k) => { const at = performance.now(); grid.scrollTop = 97 * k;
    grid.dispatchEvent(new Event('scroll')); grid.getBoundingClientRect();
    return performance.now() - at; };
  const turn = now => { begin ||= now;
    if (now - begin >= span) return done([1e3 * frames / (now - begin),
      Array.from({ length: 21 }, draw).sort((a, b) => a - b)[10],
      grid.querySelectorAll('.hx-grid-body > *').length]);
    frames += 1; grid.scrollTop = 97 * frames % grid.scrollHeight; requestAnimationFrame(turn); };
  requestAnimationFrame(turn); })"""
#: Requests of the page's tabs besides the stream, and their intervals, s; one tab is open.
ASKED = {"receivers/receiver/flux": 10.0, "clusters": 3.0, "calibration": 3.0, "alarms": 4.0}


class Heard:
    """Times at which each heliostat heard DEFOCUS since the last `begin`."""

    def __init__(self, count: int) -> None:
        self._who, self.at = np.zeros(count, dtype=np.bool_), 0.0

    def begin(self) -> None:
        """Forget all times."""
        self._who[:], self.at = False, 0.0

    def took(self, name: str, rows: range) -> None:
        """Note which heliostats took a command."""
        if name == "DEFOCUS" and not self.at:
            self._who[rows.start : rows.stop] = True
            if self._who.all():
                self.at = time.time()


def serve(pipe: Connection, folder: str, heliostats: int) -> None:
    """Run a plant with its console and answer requests from the pipe; the body of a process."""
    from heliotrope.twin.live.loop import PacedLoop

    with asyncio.Runner(loop_factory=lambda: PacedLoop(1.0)) as runner:
        runner.run(_serve(pipe, Path(folder), heliostats))


async def _serve(pipe: Connection, folder: Path, heliostats: int) -> None:
    from heliotrope.console import _secrets
    from heliotrope.console.beside import ConsoleProcesses
    from heliotrope.console.settings import ConsoleSettings
    from heliotrope.field.layouts import malan_plant
    from heliotrope.links.clock import VirtualClock
    from heliotrope.plant.assembly import AssemblySettings, MachineTables, PlantAssembly
    from heliotrope.plant.interface import PlantInterface
    from heliotrope.plant.operations.automatic import AutomaticSettings
    from heliotrope.store.keeper import Keeper
    from heliotrope.twin.field.field_bus import FieldBus
    from heliotrope.twin.live import CYCLE, World

    loop = asyncio.get_running_loop()
    keeper, heard = Keeper(folder / "store.sqlite"), Heard(heliostats)
    now, people = time.time(), keeper.people
    password = _secrets.hash_password(PASSWORD)
    people.add(NAME, password, "engineer", now)
    tokens = []
    for i in range(VIEWERS + OPERATORS):  # a person has only so many tokens and streams
        name = f"{NAME}-{i // 10}"
        if i % 10 == 0:
            people.add(name, password, "operator", now)
        tokens.append(people.add_token(name, f"load {i}", "operator", now)[1])
    design = malan_plant(heliostats)
    world = World(design, VirtualClock(loop.time))
    settings = AssemblySettings(
        AutomaticSettings(wanted=True), cycle=CYCLE, machines=MachineTables.HELD
    )
    ports = world.ports(records=keeper, facts=lambda: {"speed": 1.0})
    live = PlantAssembly(design, ports, settings)
    for bus in world.buses.values():
        if isinstance(bus, FieldBus):
            bus._took = heard.took
    made: dict[float, float] = {}
    summary = live.operations.summary

    def noted() -> Any:
        found = summary()
        made[found.at.timestamp()] = time.time()
        return found

    live.operations.summary = noted  # type: ignore[method-assign]
    address: asyncio.Future[str] = loop.create_future()

    def tell(where: str) -> None:
        loop.call_soon_threadsafe(address.set_result, where)

    interface = PlantInterface(live.operations, people, folder)
    console = ConsoleProcesses(interface, ConsoleSettings(port=0), live.logbook.take_alarm, tell)
    longest, acknowledged = _Longest(), _acknowledged(live.plant)
    async with (
        live.running(),
        interface.running(console.run),
        asyncio.TaskGroup() as group,
    ):
        watching = group.create_task(longest.run())
        pipe.send((await address, tokens, world.names))
        while (question := await asyncio.to_thread(pipe.recv)) != "end":
            if question == "begin":
                heard.begin()
                longest.wait, answer = 0.0, time.process_time()
            elif question == "heard":
                answer = heard.at
            elif question == "busy":
                answer = (time.process_time(), longest.wait)
            elif question == "made":
                answer = dict(made)
            else:
                answer = acknowledged[-1] if acknowledged else 0.0
            pipe.send(answer)
        watching.cancel()
    keeper.close()


def _acknowledged(plant: Any) -> list[float]:
    """Return a list that receives the time when the last heliostat has acknowledged."""
    from heliotrope.links.messages import Stage
    from heliotrope.plant.emergency import EmergencyOrder

    when: list[float] = []
    take, told = EmergencyOrder.take_stage, set()

    def noted(order: Any, names: tuple[str, ...], stage: Stage, now: float) -> None:
        take(order, names, stage, now)
        if stage in (Stage.ACKNOWLEDGED, Stage.DONE):
            told.update(names)
        if not when and len(told) == len(plant.field):
            when.append(time.time())

    EmergencyOrder.take_stage = noted  # type: ignore[method-assign]
    return when


class _Longest:
    """Longest time that the event loop was blocked, s."""

    wait = 0.0

    async def run(self) -> None:
        while True:
            begin = time.perf_counter()
            await asyncio.sleep(0.01)
            self.wait = max(self.wait, time.perf_counter() - begin - 0.01)


def look(pipe: Connection, address: str, tokens: list[str], viewers: int) -> None:
    """Run many viewers and report to the pipe what they received; the body of a process."""
    asyncio.run(_look(pipe, address, tokens, viewers))


async def _look(pipe: Connection, address: str, tokens: list[str], viewers: int) -> None:
    came: list[list[tuple[float, float, int]]] = [[] for _ in tokens]
    answers: list[float] = []
    async with asyncio.TaskGroup() as group:
        works = [
            group.create_task(_view(address, token, mine))
            for token, mine in zip(tokens, came, strict=True)
        ]
        works += [
            group.create_task(_ask(address, token, answers, i, operator=i >= viewers))
            for i, token in enumerate(tokens)
        ]
        while (question := await asyncio.to_thread(pipe.recv)) != "end":
            if question == "begin":
                answers.clear()
                for mine in came:
                    mine.clear()
            pipe.send((came, answers))
        for work in works:
            work.cancel()


async def _view(address: str, token: str, came: list[tuple[float, float, int]]) -> None:
    """Follow the stream and only count: in a plant, a browser runs on a machine of its own."""
    import json

    from websockets.asyncio.client import connect

    url = f"ws{address.removeprefix('http')}api/v1/live"
    headers = {"Authorization": f"Bearer {token}"}
    async with connect(url, additional_headers=headers, proxy=None, max_size=None) as socket:
        async for data in socket:
            assert isinstance(data, bytes)
            at, length = time.time(), int.from_bytes(data[4:8], "little")
            came.append((json.loads(data[8 : 8 + length])["utc"], at, len(data)))


async def _ask(
    address: str, token: str, answers: list[float], number: int, *, operator: bool
) -> None:
    """Make the requests of a page; an operator also sends heliostats to stow."""
    import httpx

    rng = np.random.default_rng(number)
    path, every = list(ASKED.items())[number % len(ASKED)]
    due = time.monotonic() + every * rng.random()
    headers = {"Authorization": f"Bearer {token}"}
    async with httpx.AsyncClient(
        base_url=f"{address}api/v1/",
        headers=headers,
        trust_env=False,
        timeout=60.0,
        verify=False,
    ) as client:
        names = (await client.get("field")).json()["names"] if operator else []
        at = time.monotonic() + 5.0 * rng.random()
        while True:
            await asyncio.sleep(0.2)
            if time.monotonic() >= due:
                due, begin = time.monotonic() + every, time.perf_counter()
                (await client.get(path)).raise_for_status()
                answers.append(time.perf_counter() - begin)
            if operator and time.monotonic() >= at:
                at = time.monotonic() + 5.0
                few = rng.choice(names, 3, replace=False).tolist()
                (await client.post("stow", json={"heliostats": few})).raise_for_status()


@contextlib.contextmanager
def _process(work: Any, *given: Any) -> Iterator[Connection]:
    context = multiprocessing.get_context("spawn")
    mine, other = context.Pipe()
    process = context.Process(target=work, args=(other, *given))
    process.start()
    other.close()
    try:
        yield mine
        mine.send("end")
        process.join(30.0)
    finally:
        if process.is_alive():
            process.kill()


def _told(pipe: Connection, question: str) -> Any:
    pipe.send(question)
    if not pipe.poll(120.0):
        raise BenchmarkError(f"no answer to {question!r} within two minutes")
    return pipe.recv()


def _page(playwright: Any, address: str, span: float) -> tuple[Any, Row]:
    """Open the page; return it, and its figures while no one else is connected."""
    browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGS)
    page = browser.new_page(viewport={"width": 1600, "height": 900})
    page.set_default_timeout(60_000)
    page.goto(f"{address}login")
    page.fill("[name=name]", NAME)
    page.fill("[name=password]", PASSWORD)
    page.click("button")
    marks = "() => performance.getEntriesByName('heliotrope-ready')[0]?.startTime ?? 0"
    ready = []
    for again in range(4 if span > 2.0 else 2):
        if again:
            page.goto(address)
        page.wait_for_selector(".hx-legend b")
        while not page.evaluate(marks):
            page.wait_for_timeout(50)
        ready.append(page.evaluate(marks) / 1e3)
    frames = page.evaluate(PAN, 1e3 * span)
    page.click("[data-tab=heliostats]")
    page.wait_for_selector(".hx-grid-body > *")
    scrolled, row_ms, rows = page.evaluate(SCROLL, 1e3 * span)
    page.click("[data-tab=plant]")
    stream, answers = _received(page, 2.0 * span)
    row: Row = {
        "page_first_ready_s": ready[0],
        "page_ready_s": float(np.median(ready[1:])),
        "frames_panning": frames,
        "frames_scrolling_table": scrolled,
        "table_draw_ms": row_ms,
        "table_rows_drawn": rows,
        "stream_bytes_a_second": stream,
        "answer_bytes_a_second": answers,
    }
    return page, row


def _received(page: Any, span: float) -> tuple[float, float]:
    """Return the bytes a second of the page's stream, and of the answers to its requests."""
    session = page.context.new_cdp_session(page)
    session.send("Network.enable")
    stream: list[int] = []
    answers: list[float] = []
    session.on(  # a binary message is given as base64
        "Network.webSocketFrameReceived",
        lambda event: stream.append(3 * len(event["response"]["payloadData"]) // 4),
    )
    session.on("Network.loadingFinished", lambda event: answers.append(event["encodedDataLength"]))
    page.wait_for_timeout(1e3 * span)
    session.detach()
    return sum(stream) / span, sum(answers) / span


def _load(plant: Connection, people: Connection, page: Any, span: float) -> Row:
    """Connect all viewers, click EMERGENCY, and return the figures."""
    cpu, begun = _told(plant, "begin"), time.time()
    _told(people, "begin")
    page.wait_for_timeout(1e3 * span)
    came, answers = _told(people, "came")
    over = time.time() - begun
    busy, held = _told(plant, "busy")
    made = _told(plant, "made")
    delays = [at - made[utc] for mine in came for utc, at, _ in mine if utc in made]
    rates = [len(mine) / over for mine in came]
    sizes = [size for mine in came for _, _, size in mine]
    _told(plant, "begin")
    clicked = time.time()
    page.click("#emergency", no_wait_after=True)
    heard = acknowledged = 0.0
    while time.time() < clicked + 60.0 and not (heard and acknowledged):
        time.sleep(0.2)
        heard = heard or _told(plant, "heard")
        acknowledged = _told(plant, "acknowledged")
    if not (heard and acknowledged):
        raise BenchmarkError("an emergency was not heard and acknowledged by all in a minute")
    return {
        "messages_a_second_least": min(rates),
        "messages_a_second": float(np.mean(rates)),
        "delay_s": float(np.median(delays)),
        "delay_99_s": float(np.quantile(delays, 0.99)),
        "message_kib": float(np.mean(sizes)) / 1024.0,
        "answer_s": float(np.median(answers)),
        "answer_99_s": float(np.quantile(answers, 0.99)),
        "plant_cores": (busy - cpu) / over,
        "loop_held_s": held,
        "emergency_heard_s": heard - clicked,
        "emergency_acknowledged_s": acknowledged - clicked,
    }


def _measure(heliostats: int, people: int, span: float) -> Row:
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as folder, _process(serve, folder, heliostats) as plant:
        if not plant.poll(180.0):
            raise BenchmarkError("the plant was not there within three minutes")
        address, tokens, _ = plant.recv()
        if people == VIEWERS:
            # The plant is at work: heliostats leave stow, cameras take photographs.
            time.sleep(30.0)
        with sync_playwright() as playwright:
            page, row = _page(playwright, address, span / 4.0)
            some = tokens[:people] + tokens[VIEWERS:]
            with _process(look, address, some, people) as lookers:
                time.sleep(span / 6.0)  # until everybody has come
                row |= _load(plant, lookers, page, span)
            page.context.browser.close()
    return {"heliostats": heliostats, "viewers": people, "operators": OPERATORS, **row}


def run(quick: bool) -> Result:
    """Return the figures."""
    if not Path(CHROMIUM).exists():
        raise BenchmarkError(f"{CHROMIUM} is not there; install chromium")
    row = _measure(64, 5, 3.0) if quick else _measure(10_000, VIEWERS, 30.0)
    shares = {
        "page_ready": float(row["page_first_ready_s"] or 0.0) / READY_S,
        "frames": FRAMES / float(row["frames_panning"] or 1e-9),
        "messages": MESSAGES / float(row["messages_a_second_least"] or 1e-9),
        "emergency_heard": float(row["emergency_heard_s"] or 0.0) / EMERGENCY_S,
        "bytes": (
            float(row["stream_bytes_a_second"] or 0.0) + float(row["answer_bytes_a_second"] or 0.0)
        )
        / BYTES,
    }
    row |= {f"of_limit_{name}": share for name, share in shares.items()}
    return Result(
        [row],
        f"{row['heliostats']:,} heliostats, {row['viewers']} viewers: page ready in "
        f"{row['page_first_ready_s']:.1f} s, {row['frames_panning']:.0f} frames/s, "
        f"{row['messages_a_second_least']:.2f} messages/s, all have heard EMERGENCY after "
        f"{row['emergency_heard_s']:.2f} s",
        {
            "limit_ready_s": READY_S,
            "limit_frames": FRAMES,
            "limit_messages": MESSAGES,
            "limit_emergency_s": EMERGENCY_S,
            "limit_bytes_a_second": BYTES,
        },
        None if quick else all(share <= 1.05 for share in shares.values()),
    )
