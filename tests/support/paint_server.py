"""A small copy of PAINT's database on this machine, and the failures that tests inject."""

import hashlib
import json
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest

from heliotrope.errors import FetchError
from heliotrope.field.formats import fetch
from heliotrope.field.formats._download import JOURNAL
from heliotrope.field.formats.fetch import FetchSettings, fetch_heliostats

PLANT = "WRI1030197"
FAST = FetchSettings(workers=4, timeout=5.0, retries=3, backoff=0.002)

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


@contextmanager
def serve(client: httpx.Client) -> Iterator[Database]:
    """Serve a database with heliostat AA39 on this machine."""
    server = Server(("127.0.0.1", 0), type("Bound", (Handler,), {}))
    made = Database(f"http://127.0.0.1:{server.server_port}", client)
    server.RequestHandlerClass.database = made  # type: ignore[attr-defined]
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    made.add("AA39")
    try:
        yield made
    finally:
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


def refused(database: Database, tmp_path: Path, **options: Any) -> str:
    with pytest.raises(FetchError) as error:
        get(database, tmp_path, **options)
    assert "\n" not in str(error.value)
    return str(error.value)
