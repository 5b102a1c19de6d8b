"""The fetcher against a real server on this machine, with every failure injected."""

import gzip
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest

from heliotrope.errors import FetchError, InputError, UnknownNameError
from heliotrope.field.formats import fetch, paint
from heliotrope.field.formats._download import JOURNAL
from heliotrope.field.formats.fetch import FetchState, Settings, fetch_heliostats, fetch_tower

PLANT = "WRI1030197"
FAST = Settings(workers=4, timeout=5.0, retries=3, backoff=0.002)

#: Makes of an answer what really goes out: (status, headers, body, bytes to send).
Fault = Callable[["Answer"], "Answer"]


@dataclass(frozen=True)
class Answer:
    """What a server sends."""

    status: int = 200
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes = b""
    send: int | None = None  # fewer bytes than promised
    pause: float = 0.0  # s before the body, and between its pieces


@dataclass
class Database:
    """A small database like PAINT's, its faults, and what was asked of it."""

    url: str
    client: httpx.Client
    files: dict[str, bytes] = field(default_factory=dict)
    faults: dict[str, list[Fault]] = field(default_factory=dict)
    asked: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    ranges: bool = True
    etags: bool = True
    dates: bool = True
    busy: int = 0
    busiest: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def base(self) -> str:
        return f"{self.url}/{PLANT}"

    def put(self, path: str, content: Any) -> None:
        whole = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.files[f"/{PLANT}/{path}"] = whole

    def fail(self, path: str, *faults: Fault) -> None:
        self.faults[f"/{PLANT}/{path}"] = list(faults)

    def requests(self, part: str) -> list[dict[str, str]]:
        return [headers for path, headers in self.asked if part in path]

    def add(self, name: str, *, measurements: int = 2, root: str = "") -> None:
        """Add a heliostat; links begin with ``root`` (default: this server)."""
        base = root or self.base

        def links(relation: str, *hrefs: str) -> list[dict[str, str]]:
            return [{"rel": "root", "href": f"{base}/{PLANT}-catalog-stac.json"}] + [
                {"rel": relation, "href": href} for href in hrefs
            ]

        properties = f"{name}/Properties/{name}-heliostat-properties"
        calibration = f"{name}/Calibration/{name}-calibration-collection-stac.json"
        self.put(
            f"{name}/{name}-heliostat-catalog-stac.json",
            {
                "links": links(
                    "child", f"{base}/{calibration}", f"{base}/{properties}-collection-stac.json"
                )
            },
        )
        self.put(
            f"{properties}-collection-stac.json",
            {"links": links("item", f"{base}/{name}/Properties/{name}-item-stac.json")},
        )
        asset = {"href": f"{base}/{properties}.json"}
        self.put(
            f"{name}/Properties/{name}-item-stac.json", {"assets": {"heliostat-properties": asset}}
        )
        self.put(f"{properties}.json", {"heliostat": name})
        numbers = range(100, 100 + measurements)
        self.put(
            calibration,
            {
                "links": links(
                    "item", *(f"{base}/{name}/Calibration/{n}-stac.json" for n in numbers)
                )
            },
        )
        for n in numbers:
            assets = {
                "calibration_properties": f"{n}-calibration-properties.json",
                "raw_image": f"{n}_raw.png",
                "flux_image": f"{n}_flux.png",
            }
            self.put(
                f"{name}/Calibration/{n}-stac.json",
                {
                    "assets": {
                        k: {"href": f"{base}/{name}/Calibration/{v}"} for k, v in assets.items()
                    }
                },
            )
            self.put(f"{name}/Calibration/{n}-calibration-properties.json", {"motor": [n, 2 * n]})
            self.put(f"{name}/Calibration/{n}_raw.png", bytes([n]) * 5000)
            self.put(f"{name}/Calibration/{n}_flux.png", bytes([n]) * 300)
        known = sorted({path.split("/")[2] for path in self.files if "-heliostat-catalog" in path})
        self.put(
            f"{PLANT}-catalog-stac.json",
            {
                "links": links(
                    "child", *(f"{base}/{k}/{k}-heliostat-catalog-stac.json" for k in known)
                )
            },
        )

    def edit(self, path: str, change: Callable[[Any], None]) -> None:
        content = json.loads(self.files[f"/{PLANT}/{path}"])
        change(content)
        self.put(path, content)

    def answer(self, path: str, headers: dict[str, str]) -> Answer:
        body = self.files.get(path)
        if body is None:
            return Answer(404, body=b"nothing here")
        etag = f'"{hashlib.sha1(body).hexdigest()}"'
        date = f"Mon, 06 Jan 2025 00:00:{len(body) % 60:02d} GMT"
        said = ({"ETag": etag} if self.etags else {}) | (
            {"Last-Modified": date} if self.dates else {}
        )
        marks = [etag] * self.etags + [date] * self.dates
        if headers.get("if-none-match") == etag or headers.get("if-modified-since") == date:
            return Answer(304, said)
        span = re.fullmatch(r"bytes=(\d+)-", headers.get("range", ""))
        if span and self.ranges and headers.get("if-range", marks[0]) in marks:
            start = int(span[1])
            if start >= len(body):
                return Answer(416, said)
            place = f"bytes {start}-{len(body) - 1}/{len(body)}"
            return Answer(206, said | {"Content-Range": place}, body[start:])
        return Answer(200, said, body)


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    database: Database

    def do_GET(self) -> None:
        database = self.database
        headers = {name.lower(): value for name, value in self.headers.items()}
        with database.lock:
            database.asked.append((self.path, headers))
            database.busy += 1
            database.busiest = max(database.busiest, database.busy)
            faults = database.faults.get(self.path, [])
            fault = faults.pop(0) if faults else None
        try:
            answer = database.answer(self.path, headers)
            self.reply(fault(answer) if fault else answer)
        finally:
            with database.lock:
                database.busy -= 1

    def reply(self, answer: Answer) -> None:
        if answer.pause:
            time.sleep(answer.pause)
        self.send_response(answer.status)
        for name, value in answer.headers.items():
            self.send_header(name, value)
        if answer.status != 304:
            self.send_header("Content-Length", str(len(answer.body)))
        self.end_headers()
        sent = answer.body if answer.send is None else answer.body[: answer.send]
        step = 65536 if answer.pause else max(len(sent), 1)
        for k in range(0, len(sent), step):
            self.wfile.write(sent[k : k + step])
            self.wfile.flush()
            time.sleep(answer.pause)
        if answer.send is not None:
            self.close_connection = True

    def log_message(self, *_: object) -> None:
        """Say nothing."""


class Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, *_: object) -> None:
        """A client that went away is what some tests are about."""


@pytest.fixture(scope="module")
def client() -> Iterator[httpx.Client]:
    """One client for most tests: to make one takes longer than what it is used for."""
    with httpx.Client(timeout=5.0) as made:
        yield made


@pytest.fixture
def database(client: httpx.Client) -> Iterator[Database]:
    server = Server(("127.0.0.1", 0), type("Bound", (Handler,), {}))
    made = Database(f"http://127.0.0.1:{server.server_port}", client)
    server.RequestHandlerClass.database = made  # type: ignore[attr-defined]
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    made.add("AA39")
    yield made
    server.shutdown()
    thread.join()
    server.server_close()


def status(code: int, **headers: str) -> Fault:
    return lambda _: Answer(code, headers, b"<html>an error page</html>")


def cut(after: int) -> Fault:
    return lambda a: Answer(a.status, a.headers, a.body, send=after)


def body(content: bytes) -> Fault:
    return lambda a: Answer(a.status, {}, content)


def slow(pause: float) -> Fault:
    return lambda a: Answer(a.status, a.headers, a.body, pause=pause)


def get(database: Database, into: Path, **options: Any) -> fetch.Fetched:
    options = {"base_url": database.base, "settings": FAST, "client": database.client} | options
    return fetch_heliostats("AA39", into, **options)


BIG = "AA39/Properties/AA39-heliostat-properties.json"


def big(database: Database, size: int = 200_000) -> bytes:
    """Make the properties large, so that they come in pieces; return them."""
    content = json.dumps({"padding": [k * k for k in range(size // 8)]}).encode()
    database.put(BIG, content)
    return content


def stored(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name != JOURNAL
    }


# -- what comes ------------------------------------------------------------------------


def test_properties_and_measurements_come(database: Database, tmp_path: Path) -> None:
    fetched = get(database, tmp_path / "new" / "folder")
    wanted = [
        "AA39/Properties/AA39-heliostat-properties.json",
        "AA39/Calibration/100-calibration-properties.json",
        "AA39/Calibration/101-calibration-properties.json",
    ]
    assert [str(f.relative_to(tmp_path / "new" / "folder")) for f in fetched.files] == wanted
    assert fetched.new == fetched.files
    assert fetched.missing == ()
    assert stored(tmp_path / "new" / "folder") == {
        name: database.files[f"/{PLANT}/{name}"] for name in wanted
    }
    assert fetched.received == sum(map(len, stored(tmp_path / "new" / "folder").values()))


def test_what_came_is_found_by_the_reader(database: Database, tmp_path: Path) -> None:
    get(database, tmp_path)
    assert paint.find_properties(tmp_path) == [tmp_path / BIG]


def test_older_names_are_known_too(database: Database, tmp_path: Path) -> None:
    old = {
        path.replace("heliostat-properties", "heliostat_properties"): content.replace(
            b"heliostat-properties", b"heliostat_properties"
        )
        for path, content in database.files.items()
    }
    database.files = old
    fetched = get(database, tmp_path, kinds=("properties",))
    assert [path.name for path in fetched.new] == ["AA39-heliostat_properties.json"]


def test_an_image_is_known_by_its_type_too(database: Database, tmp_path: Path) -> None:
    database.edit(
        "AA39/Calibration/100-stac.json",
        lambda item: item["assets"].__setitem__(
            "new_image", {"href": "n.png", "type": "image/png"}
        ),
    )
    assert not [path for path in get(database, tmp_path).files if path.suffix == ".png"]


def test_images_come_when_they_are_asked_for(database: Database, tmp_path: Path) -> None:
    get(database, tmp_path, kinds=("calibration",), images=("flux_image",))
    names = Counter(Path(name).suffix for name in stored(tmp_path))
    assert names == {".json": 2, ".png": 2}
    assert (tmp_path / "AA39/Calibration/100_flux.png").read_bytes() == bytes([100]) * 300


def test_several_heliostats_come_once_each(database: Database, tmp_path: Path) -> None:
    database.add("AB40", measurements=1)
    fetched = fetch_heliostats(
        ["AA39", "AB40", "AA39"], tmp_path, base_url=database.base + "/", settings=FAST
    )
    assert Counter(path.relative_to(tmp_path).parts[0] for path in fetched.files) == {
        "AA39": 3, "AB40": 2,
    }  # fmt: skip


def test_the_tower_comes(database: Database, tmp_path: Path) -> None:
    name = f"{PLANT}-tower-measurements"
    database.put(f"{name}-item-stac.json", {"assets": {"tower": {"href": f"{name}.json"}}})
    database.put(f"{name}.json", {"towers": 2})
    fetched = fetch_tower(tmp_path, base_url=database.base, settings=FAST)
    assert stored(tmp_path) == {f"{name}.json": b'{"towers": 2}'}
    assert fetched.files == (tmp_path / f"{name}.json",)


def test_what_the_database_lacks_is_said(database: Database, tmp_path: Path) -> None:
    fetched = get(database, tmp_path, kinds=("properties", "deflectometry"))
    assert fetched.missing == ("heliostat AA39: the database has no deflectometry of it",)
    assert len(fetched.files) == 1


def test_a_copy_of_the_database_is_used_whatever_its_links_say(
    database: Database, tmp_path: Path
) -> None:
    database.add("AC41", root=fetch.DEFAULT_BASE_URL)
    fetched = fetch_heliostats("AC41", tmp_path, base_url=database.base, settings=FAST)
    assert len(fetched.new) == 3


def test_relative_links_and_redirects_are_followed(database: Database, tmp_path: Path) -> None:
    database.edit(
        "AA39/AA39-heliostat-catalog-stac.json",
        lambda c: c["links"].__setitem__(
            2, {"rel": "child", "href": "./old/AA39-heliostat-properties-collection-stac.json"}
        ),
    )
    place = "AA39/Properties/AA39-heliostat-properties-collection-stac.json"
    old = "AA39/old/AA39-heliostat-properties-collection-stac.json"
    database.put(old, {})
    database.fail(old, status(302, Location=f"{database.base}/{place}"))
    # Relative to where the document really is, not to where it was asked for.
    database.edit(place, lambda c: c["links"][1].__setitem__("href", "AA39-item-stac.json"))
    assert len(get(database, tmp_path, kinds=("properties",)).new) == 1


def test_own_client_stays_open(database: Database, tmp_path: Path) -> None:
    other = f"AA39/Properties/{PLANT}.json"
    database.put(other, {"moved": "here"})
    database.fail(BIG, status(301, Location=f"{database.base}/{other}"))
    with httpx.Client(headers={"User-Agent": "mine"}) as client:
        get(database, tmp_path, client=client)
        assert not client.is_closed
    assert (tmp_path / BIG).read_bytes() == b'{"moved": "here"}'
    assert {headers["user-agent"] for _, headers in database.asked} == {"mine"}


def test_files_come_side_by_side_but_not_too_many(database: Database, tmp_path: Path) -> None:
    database.add("AA39", measurements=24)
    for path in database.files:
        database.faults[path] = [slow(0.02)]
    get(database, tmp_path, settings=Settings(workers=3, timeout=5.0))
    assert database.busiest == 3


# -- a second run ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("etags", "dates"), [(True, True), (True, False), (False, True), (False, False)]
)
def test_what_is_there_is_not_fetched_again(
    database: Database, tmp_path: Path, etags: bool, dates: bool
) -> None:
    database.etags, database.dates = etags, dates
    first = get(database, tmp_path)
    again = get(database, tmp_path)
    assert len(first.new) == 3
    assert again.files == first.files
    assert again.new == ()
    assert again.received == 0


@pytest.mark.parametrize("etags", [True, False])
def test_what_has_changed_comes_again(database: Database, tmp_path: Path, etags: bool) -> None:
    database.etags = etags
    get(database, tmp_path)
    database.put(BIG, {"heliostat": "moved since"})
    again = get(database, tmp_path)
    assert [path.name for path in again.new] == ["AA39-heliostat-properties.json"]
    assert json.loads((tmp_path / BIG).read_bytes()) == {"heliostat": "moved since"}


def test_a_file_that_was_damaged_comes_again(database: Database, tmp_path: Path) -> None:
    get(database, tmp_path)
    (tmp_path / BIG).write_bytes(b"{")
    assert [path.name for path in get(database, tmp_path).new] == ["AA39-heliostat-properties.json"]
    assert (tmp_path / BIG).read_bytes() == database.files[f"/{PLANT}/{BIG}"]


def test_files_copied_from_elsewhere_are_taken_over(database: Database, tmp_path: Path) -> None:
    get(database, tmp_path)
    (tmp_path / JOURNAL).unlink()
    assert get(database, tmp_path).new == ()
    assert get(database, tmp_path).new == ()
    assert "if-none-match" in database.requests(BIG)[-1]


def test_a_broken_line_of_the_journal_costs_one_question(
    database: Database, tmp_path: Path
) -> None:
    get(database, tmp_path)
    journal = (tmp_path / JOURNAL).read_bytes()
    (tmp_path / JOURNAL).write_bytes(b'7\n"x"\n[1]\n' + journal[:-20])
    assert get(database, tmp_path).new == ()
    assert get(database, tmp_path).received == 0


# -- broken lines ----------------------------------------------------------------------


@pytest.mark.parametrize("code", [500, 502, 503, 429, 408])
def test_a_server_that_stumbles_is_asked_again(
    database: Database, tmp_path: Path, code: int
) -> None:
    for path in ("AA39/AA39-heliostat-catalog-stac.json", BIG):
        database.fail(path, status(code), status(code, **{"Retry-After": "0"}))
    assert len(get(database, tmp_path).new) == 3
    assert len(database.requests(BIG)) == 3


def test_a_broken_line_goes_on_where_it_stopped(database: Database, tmp_path: Path) -> None:
    content = big(database)
    database.fail(BIG, cut(150_000))
    fetched = get(database, tmp_path)
    assert (tmp_path / BIG).read_bytes() == content
    first, second = database.requests(BIG)
    assert "range" not in first
    assert second["range"] == "bytes=150000-"
    assert second["if-range"].startswith('"')
    assert fetched.received == len(content) + sum(
        len(database.files[f"/{PLANT}/AA39/Calibration/{n}-calibration-properties.json"])
        for n in (100, 101)
    )


def test_a_line_that_breaks_often_but_moves_on_is_not_given_up(
    database: Database, tmp_path: Path
) -> None:
    content = big(database)
    database.fail(BIG, *[cut(20_000)] * 9)
    get(database, tmp_path, settings=Settings(retries=1, backoff=0.0))
    assert (tmp_path / BIG).read_bytes() == content
    assert len(database.requests(BIG)) == 10


def test_giving_up_keeps_what_is_there_for_the_next_run(database: Database, tmp_path: Path) -> None:
    content = big(database)
    database.fail(BIG, cut(90_000), *[status(503)] * 4)
    with pytest.raises(FetchError) as error:
        get(database, tmp_path)
    text = str(error.value)
    assert re.match(
        r"heliostat AA39: http://127\.0\.0\.1:\d+/WRI1030197/AA39/Properties/AA39-heliostat-properties"
        r"\.json: the server answers 503 Service Unavailable; gave up after 4 attempts, run it "
        r"again later, what is there is kept$", text,
    )  # fmt: skip
    assert not (tmp_path / BIG).exists()
    assert (tmp_path / (BIG + ".part")).stat().st_size == 90_000
    database.asked.clear()
    get(database, tmp_path)
    assert database.requests(BIG)[0]["range"] == "bytes=90000-"
    assert (tmp_path / BIG).read_bytes() == content
    assert not list(tmp_path.rglob("*.part"))


def test_a_part_of_an_older_file_is_not_continued(database: Database, tmp_path: Path) -> None:
    big(database)
    database.fail(BIG, cut(90_000), *[status(500)] * 4)
    with pytest.raises(FetchError):
        get(database, tmp_path)
    newer = big(database, 260_000)
    get(database, tmp_path)
    assert (tmp_path / BIG).read_bytes() == newer


@pytest.mark.parametrize(
    ("ranges", "etags", "dates", "resumes"),
    [
        (False, True, True, False),
        (True, False, True, True),
        # Nothing says that the rest belongs to the same file.
        (True, False, False, False),
    ],
)
def test_servers_that_promise_less(
    database: Database, tmp_path: Path, ranges: bool, etags: bool, dates: bool, resumes: bool
) -> None:
    content = big(database)
    database.ranges, database.etags, database.dates = ranges, etags, dates
    database.fail(BIG, cut(90_000))
    fetched = get(database, tmp_path)
    assert (tmp_path / BIG).read_bytes() == content
    assert (fetched.received < len(content) + 90_000) == resumes


def test_a_weak_etag_is_not_trusted_with_a_range(database: Database, tmp_path: Path) -> None:
    content = big(database)
    weak = {"ETag": 'W/"a"', "Last-Modified": f"Mon, 06 Jan 2025 00:00:{len(content) % 60:02d} GMT"}
    database.fail(BIG, lambda a: Answer(a.status, weak, a.body, send=70_000))
    get(database, tmp_path)
    assert database.requests(BIG)[1]["if-range"] == weak["Last-Modified"]
    assert (tmp_path / BIG).read_bytes() == content


def test_a_part_that_is_too_long_is_thrown_away(database: Database, tmp_path: Path) -> None:
    content = big(database)
    database.fail(BIG, cut(90_000), *[status(500)] * 4)
    with pytest.raises(FetchError):
        get(database, tmp_path)
    with (tmp_path / (BIG + ".part")).open("ab") as stream:
        stream.write(b"x" * len(content))
    get(database, tmp_path)
    assert (tmp_path / BIG).read_bytes() == content


@pytest.mark.parametrize("etags", [True, False])
def test_an_old_file_is_not_taken_for_the_new_one_that_broke_off(
    database: Database, tmp_path: Path, etags: bool
) -> None:
    database.etags = etags
    big(database)
    get(database, tmp_path)
    newer = database.files[f"/{PLANT}/{BIG}"].replace(b"padding", b"PADDING")
    database.put(BIG, newer)
    # A date of its own, because the size, from which the test's server makes it, is the same.
    dated = {"ETag": '"n"'} if etags else {"Last-Modified": "Tue, 07 Jan 2025 00:00:00 GMT"}
    database.fail(BIG, lambda a: Answer(200, dated, newer, send=70_000), *[status(500)] * 4)
    with pytest.raises(FetchError):
        get(database, tmp_path)
    get(database, tmp_path)
    assert (tmp_path / BIG).read_bytes() == newer


@pytest.mark.parametrize("span", ["bytes 7-9/10", "", "nonsense"])
def test_a_rest_that_is_another_one_is_not_appended(
    database: Database, tmp_path: Path, span: str
) -> None:
    content = big(database)
    wrong = Answer(206, {"Content-Range": span}, b"something else")
    database.fail(BIG, cut(90_000), lambda _: wrong)
    get(database, tmp_path)
    assert (tmp_path / BIG).read_bytes() == content


def test_a_rest_that_nobody_asked_for_is_refused(database: Database, tmp_path: Path) -> None:
    database.fail(BIG, lambda _: Answer(206, {"Content-Range": "bytes 0-1/9"}, b"{}"))
    assert "the server answers 206 Partial Content" in refused(database, tmp_path)


def test_a_process_that_was_killed_goes_on(database: Database, tmp_path: Path) -> None:
    content = big(database, 3_000_000)
    database.fail(BIG, slow(0.05))
    script = (
        "from heliotrope.field.formats.fetch import fetch_heliostats;"
        f"fetch_heliostats('AA39', {str(tmp_path)!r}, base_url={database.base!r})"
    )
    process = subprocess.Popen([sys.executable, "-c", script])
    part = tmp_path / (BIG + ".part")
    deadline = time.monotonic() + 30
    while not (part.is_file() and part.stat().st_size > 200_000):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (tmp_path / BIG).exists()
    kept = part.stat().st_size
    fetched = get(database, tmp_path)
    assert (tmp_path / BIG).read_bytes() == content
    assert database.requests(BIG)[-1]["range"] == f"bytes={kept}-"
    assert fetched.received < len(content) - 200_000 + 1000


def test_an_interrupted_run_goes_on(database: Database, tmp_path: Path) -> None:
    content = big(database, 1_000_000)

    def interrupt(state: FetchState) -> None:
        if state.received > 300_000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        get(database, tmp_path, progress=interrupt)
    assert not (tmp_path / BIG).exists()
    get(database, tmp_path)
    assert "range" in database.requests(BIG)[-1]
    assert (tmp_path / BIG).read_bytes() == content


def test_a_file_is_never_there_half_written(database: Database, tmp_path: Path) -> None:
    content = big(database, 1_000_000)
    seen: set[int] = set()

    def look(_: FetchState) -> None:
        if (tmp_path / BIG).exists():
            seen.add((tmp_path / BIG).stat().st_size)

    get(database, tmp_path, progress=look)
    assert seen <= {len(content)}
    assert seen


# -- progress --------------------------------------------------------------------------


def test_progress_is_told(database: Database, tmp_path: Path) -> None:
    states: list[FetchState] = []
    fetched = get(database, tmp_path, progress=states.append)
    assert [state.stage for state in states] == sorted(
        (state.stage for state in states), reverse=True
    )
    assert all(state.done <= state.total for state in states)
    received = [state.received for state in states]
    assert received == sorted(received)
    last = states[-1]
    assert (last.stage, last.done, last.total) == ("fetching", 3, 3)
    assert last.received == fetched.received
    assert {state.name for state in states if state.stage == "fetching"} - {""} == {
        path.name for path in fetched.files
    }
    assert "AA39-heliostat-catalog-stac.json" in {state.name for state in states}


# -- refusals --------------------------------------------------------------------------


def refused(database: Database, tmp_path: Path, **options: Any) -> str:
    with pytest.raises(FetchError) as error:
        get(database, tmp_path, **options)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_an_unknown_heliostat_is_named_with_its_neighbours(
    database: Database, tmp_path: Path
) -> None:
    with pytest.raises(
        FetchError, match=r"heliostat AA93: .* has none of this name; did you mean AA39\?"
    ):
        fetch_heliostats("AA93", tmp_path, base_url=database.base, settings=FAST)
    del database.files[f"/{PLANT}/{PLANT}-catalog-stac.json"]
    with pytest.raises(FetchError, match="has none of this name; look at its catalogue"):
        fetch_heliostats("AA93", tmp_path, base_url=database.base, settings=FAST)


def test_nothing_like_it_gets_no_suggestion(database: Database, tmp_path: Path) -> None:
    with pytest.raises(FetchError, match=r"heliostat zzz: .*; look at its catalogue"):
        fetch_heliostats("zzz", tmp_path, base_url=database.base, settings=FAST)


@pytest.mark.parametrize(
    "gone",
    [
        BIG,
        "AA39/Calibration/101-stac.json",
        "AA39/Calibration/AA39-calibration-collection-stac.json",
    ],
)
def test_a_missing_file_names_the_heliostat(database: Database, tmp_path: Path, gone: str) -> None:
    del database.files[f"/{PLANT}/{gone}"]
    text = refused(database, tmp_path)
    assert text.startswith("heliostat AA39: http://")
    assert gone in text
    assert "there is no such file (the server answers 404 Not Found)" in text


def test_forbidden_is_not_tried_again(database: Database, tmp_path: Path) -> None:
    database.fail(BIG, status(403))
    assert "the server answers 403 Forbidden" in refused(database, tmp_path)
    assert len(database.requests(BIG)) == 1


CATALOGUE = "AA39/AA39-heliostat-catalog-stac.json"
ITEM = "AA39/Properties/AA39-item-stac.json"


@pytest.mark.parametrize(
    ("path", "content", "problem"),
    [
        (CATALOGUE, b"<html>busy</html>", "what came is not JSON; it begins '<html>busy</html>'"),
        (CATALOGUE, b"", "what came is not JSON; it begins ''"),
        (CATALOGUE, b'{"links": [', "what came is not JSON"),
        (CATALOGUE, b"\xff\xfe\x00", "what came is not JSON"),
        (CATALOGUE, b"[1, 2]", "no STAC document, but a list or value"),
        (CATALOGUE, b"{}", "no STAC catalogue, it has no list of links"),
        (CATALOGUE, b'{"links": [3]}', "no STAC catalogue, it has no list of links"),
        (CATALOGUE, b'{"links": [{"rel": "child"}]}', "no STAC catalogue, a link has no address"),
        (ITEM, b'{"links": []}', "no STAC item, it names no files with addresses"),
        (ITEM, b'{"assets": {"a": {"href": 7}}}', "no STAC item, it names no files"),
        (BIG, b"<html>moved</html>", "what came is not JSON; it begins '<html>moved</html>'"),
    ],
)
def test_garbage_is_refused(
    database: Database, tmp_path: Path, path: str, content: bytes, problem: str
) -> None:
    database.put(path, content)
    assert problem in refused(database, tmp_path)
    assert not (tmp_path / BIG).exists()
    assert not (tmp_path / (BIG + ".part")).exists()


def test_an_endless_catalogue_is_refused(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("heliotrope.field.formats._download.DOCUMENT_LIMIT", 2**20)
    database.put(CATALOGUE, b"[" * (2**20 + 1))
    assert "more than 1 MiB; this is no catalogue" in refused(database, tmp_path)


@pytest.mark.parametrize(
    "name",
    [
        "..%2F..%2F..%2Fevil.json",
        "..",
        ".bashrc",
        "a%00b.json",
        "a%5Cb.json",
        "",
        "x" * 300,
        "trick.part",
        "%2Fetc%2Fpasswd",
    ],
)
def test_names_that_lead_elsewhere_are_refused(
    database: Database, tmp_path: Path, name: str
) -> None:
    href = f"{database.base}/AA39/Properties/{name}"
    database.put(ITEM, {"assets": {"a": {"href": href}}})
    inside = tmp_path / "inside"
    assert "is not a plain one; refused" in refused(database, inside)
    assert list(tmp_path.iterdir()) == [inside]


@pytest.mark.parametrize("href", ["file:///etc/passwd", "ftp://127.0.0.1/x.json", "data:,x.json"])
def test_other_kinds_of_addresses_are_refused(
    database: Database, tmp_path: Path, href: str
) -> None:
    database.put(ITEM, {"assets": {"a": {"href": href}}})
    assert "the address is neither http nor https; refused" in refused(database, tmp_path)


def test_two_files_in_one_place_are_refused(database: Database, tmp_path: Path) -> None:
    hrefs = [f"{database.base}/{BIG}", f"{database.base}/elsewhere/{Path(BIG).name}"]
    database.put(ITEM, {"assets": {str(k): {"href": h} for k, h in enumerate(hrefs)}})
    assert "would be stored where" in refused(database, tmp_path)


def checked(database: Database, **said: Any) -> None:
    href = f"{database.base}/{BIG}"
    database.put(
        ITEM, {"assets": {"a": {"href": href, **{f"file:{k}": v for k, v in said.items()}}}}
    )


def test_size_and_checksum_of_the_catalogue_are_checked(database: Database, tmp_path: Path) -> None:
    content = big(database)
    right = "1220" + hashlib.sha256(content).hexdigest()
    checked(database, size=len(content) + 1)
    text = refused(database, tmp_path)
    assert f"{len(content)} bytes came, but the catalogue says {len(content) + 1}" in text
    checked(database, checksum="1220" + "0" * 64)
    assert "its checksum is not the one in the catalogue" in refused(database, tmp_path)
    assert not list(tmp_path.rglob("AA39-heliostat-properties*"))
    checked(database, checksum=right, size=len(content))
    get(database, tmp_path)
    database.asked.clear()
    assert get(database, tmp_path).new == ()
    assert database.requests(BIG) == []
    (tmp_path / BIG).write_bytes(b"x" * len(content))
    assert len(get(database, tmp_path).new) == 1
    assert (tmp_path / BIG).read_bytes() == content


def test_other_checksums_are_left_alone(database: Database, tmp_path: Path) -> None:
    checked(database, checksum="1114" + "0" * 40)
    assert len(get(database, tmp_path, kinds=("properties",)).new) == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_a_full_disk_is_said(database: Database, tmp_path: Path) -> None:
    part = tmp_path / (BIG + ".part")
    part.parent.mkdir(parents=True)
    part.symlink_to("/dev/full")
    text = refused(database, tmp_path)
    assert f"{tmp_path / BIG}: the disk is full; make room and run it again" in text
    assert not (tmp_path / BIG).exists()


def test_places_that_cannot_be_written_to(database: Database, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    assert "cannot be used (File exists)" in refused(database, tmp_path / "file")
    (tmp_path / "AA39").write_text("x")
    assert "cannot be made (" in refused(database, tmp_path)
    (tmp_path / "AA39").unlink()
    (tmp_path / (BIG + ".part")).mkdir(parents=True)
    assert "cannot be written (Is a directory)" in refused(database, tmp_path)


def test_no_network_is_said(tmp_path: Path) -> None:
    server = Server(("127.0.0.1", 0), Handler)
    port = server.server_port
    server.server_close()
    with pytest.raises(FetchError) as error:
        fetch_heliostats("AA39", tmp_path, base_url=f"http://127.0.0.1:{port}/x", settings=FAST)
    assert "no connection; check the network and the address" in str(error.value)
    assert "gave up after 4 attempts" in str(error.value)


def test_a_silent_server_is_said(database: Database, tmp_path: Path) -> None:
    database.fail(CATALOGUE, *[slow(0.5)] * 2)
    text = refused(
        database, tmp_path, settings=Settings(timeout=0.1, retries=1, backoff=0.0), client=None
    )
    assert "the server does not answer in time" in text


def test_compressed_answers(database: Database, tmp_path: Path) -> None:
    packed = {"Content-Encoding": "gzip"}
    for path in (CATALOGUE, BIG):
        whole = gzip.compress(database.files[f"/{PLANT}/{path}"])
        database.fail(path, lambda _, whole=whole: Answer(200, packed, whole))  # type: ignore[misc]
    get(database, tmp_path)
    assert (tmp_path / BIG).read_bytes() == database.files[f"/{PLANT}/{BIG}"]
    database.fail(CATALOGUE, *[lambda _: Answer(200, packed, b"no gzip")] * 9)
    assert "what came cannot be unpacked" in refused(database, tmp_path)


def test_endless_redirects_are_said(database: Database, tmp_path: Path) -> None:
    database.fail(CATALOGUE, *[status(302, Location=f"{database.base}/{CATALOGUE}")] * 40)
    assert "Exceeded maximum allowed redirects" in refused(database, tmp_path)


def test_a_bad_address_is_said(tmp_path: Path) -> None:
    with pytest.raises(FetchError, match="neither http nor https"):
        fetch_heliostats("AA39", tmp_path, base_url="paint-database.org", settings=FAST)
    with pytest.raises(FetchError, match=r"http://\[x/AA39.*: "):
        fetch_heliostats("AA39", tmp_path, base_url="http://[x", settings=FAST)


@pytest.mark.parametrize("name", ["", "../AA39", "AA 39", "AA39/x", "x" * 65])
def test_names_of_heliostats_are_checked(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="give a name of letters and digits, as AA39"):
        fetch_heliostats(name, tmp_path)


def test_kinds_and_images_are_checked(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="there is no kind 'calibrations'; did you mean cal"):
        fetch_heliostats("AA39", tmp_path, kinds=("calibrations",))
    with pytest.raises(UnknownNameError, match="there is no image 'raw'"):
        fetch_heliostats("AA39", tmp_path, images=("raw",))


@pytest.mark.parametrize(
    ("wrong", "problem"),
    [
        ({"workers": 0}, "workers 0: give 1 to 32"),
        ({"workers": 33}, "workers 33"),
        ({"timeout": 0.0}, "timeout 0.0 s must be above 0"),
        ({"timeout": float("nan")}, "timeout nan s"),
        ({"retries": -1}, "retries -1"),
        ({"backoff": -0.1}, "backoff -0.1 s"),
    ],
)
def test_settings_are_checked(wrong: dict[str, Any], problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        Settings(**wrong)


def test_importing_is_light() -> None:
    """Neither reading files nor fetching loads a heavy library before it is needed."""
    heavy = {"httpx", "lxml", "pandas", "pvlib", "matplotlib", "pydantic"}
    script = (
        "import sys, heliotrope.field.formats.fetch\n"
        "from heliotrope.field.formats import heliok, opencsp, solarpilot\n"
        f"print(sorted({heavy!r} & sys.modules.keys()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, env=os.environ
    )
    assert done.stdout.strip() == "[]"
