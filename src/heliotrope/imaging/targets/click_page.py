"""A page, served only to this computer, on which a user clicks points in a picture.

OpenCV is used without windows, so a browser shows the picture. There is one address on 127.0.0.1
that ends in a random word, with one self-contained page that accepts one reply.
"""

import json
import secrets
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from socketserver import ThreadingTCPServer
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.target import Target
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.targets.teaching import places_of, shown_pixels

#: Maximum size of a reply, bytes; a point takes a few hundred bytes.
_LONGEST = 1 << 20
Pixel = tuple[float, float]


@dataclass
class _State:
    """The points requested from the user, and the reply."""

    token: str
    nonce: str
    page: bytes
    picture: bytes
    size: tuple[int, int]
    names: frozenset[str]
    answer: dict[str, Pixel] | None = None
    over: threading.Event = field(default_factory=threading.Event)


class _Server(ThreadingTCPServer):
    # http.server.HTTPServer is avoided, because it asks the network for this computer's name.
    daemon_threads = True

    def __init__(self, state: _State) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.state = state
        self.port = int(self.socket.getsockname()[1])


class _Handler(BaseHTTPRequestHandler):
    timeout = 30.0

    @property
    def _state(self) -> _State:
        return cast("_Server", self.server).state

    @property
    def _port(self) -> int:
        return cast("_Server", self.server).port

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - the base's name
        """Log nothing, because the terminal is used by the command."""

    def _allowed(self) -> str | None:
        """Return the path after the random word; None if the request is not for this page."""
        # A foreign page may let its own name resolve to this computer, but its requests then state
        # that name.
        local = self.headers.get("Host") in (f"127.0.0.1:{self._port}", f"localhost:{self._port}")
        _, word, *rest = (self.path.split("/") + ["", ""])[:4]
        known = secrets.compare_digest(word.encode(), self._state.token.encode())
        if local and known:
            return rest[0]
        self._send(404, b"not here\n")
        return None

    def _send(self, status: int, body: bytes, kind: str = "text/plain; charset=utf-8") -> None:
        nonce = self._state.nonce
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header(
            "Content-Security-Policy",
            f"default-src 'none'; img-src 'self'; connect-src 'self'; script-src 'nonce-{nonce}'; "
            f"style-src 'nonce-{nonce}'; base-uri 'none'; form-action 'none'; "
            "frame-ancestors 'none'",
        )
        self.end_headers()
        self.wfile.write(body)

    def do_GET(self) -> None:
        path = self._allowed()
        if path == "":
            self._send(200, self._state.page, "text/html; charset=utf-8")
        elif path == "picture.png":
            self._send(200, self._state.picture, "image/png")
        elif path is not None:
            self._send(404, b"not here\n")

    def do_POST(self) -> None:
        path = self._allowed()
        if path is None:
            return
        if path == "cancel":
            self._send(200, b"cancelled\n")
            self._state.over.set()
            return
        if path != "points":
            self._send(404, b"not here\n")
            return
        try:
            answer = self._read()
        except InputError as error:
            self._send(400, f"{error}\n".encode())
            return
        self._state.answer = answer
        self._send(200, b"thank you\n")
        self._state.over.set()

    def _read(self) -> dict[str, Pixel]:
        length = self.headers.get("Content-Length", "")
        if not length.isascii() or not length.isdigit() or int(length) > _LONGEST:
            raise InputError(f"the reply's length {length!r} is not a number up to {_LONGEST}")
        try:
            document = json.loads(self.rfile.read(int(length)))
        except ValueError:
            raise InputError("the reply is not JSON") from None
        points = document.get("points") if isinstance(document, dict) else None
        if not isinstance(points, dict):
            raise InputError('the reply has no "points"')
        return {name: self._point(name, value) for name, value in points.items()}

    def _point(self, name: str, value: object) -> Pixel:
        if name not in self._state.names:
            raise InputError(f"point {name!r} was not requested")
        width, height = self._state.size
        if not (
            isinstance(value, list)
            and len(value) == 2
            and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
        ):
            raise InputError(f"point {name}: enter two numbers, pixels right and down")
        x, y = (float(v) for v in value)
        # This comparison also rejects NaN.
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            raise InputError(f"point {name}: {x}, {y} is not in the picture of {width} × {height}")
        return x, y


def ask(
    picture: npt.NDArray[np.uint8],
    places: Mapping[str, Pixel],
    known: Mapping[str, Pixel],
    title: str,
    announce: Callable[[str], None],
    fewest: int = 4,
    aspect: float = 1.0,
) -> dict[str, Pixel]:
    """Return the pixels that the user clicked, by point name.

    Parameters
    ----------
    picture
        Grey (H, W) or blue-green-red (H, W, 3), uint8.
    places
        Points to ask for, in this order, with their positions on the target from the left and from
        the top, 0 to 1.
    known
        Points already known; the page shows them.
    title
        Title of the page.
    announce
        Called with the page's address once it can be opened; this function waits for the reply.
    fewest
        Minimum number of points in a reply, including those already known.
    aspect
        Width of the target divided by its height, for the sketch of the target on the page.

    Raises
    ------
    InputError
        If the user cancels.
    """
    import cv2

    done, encoded = cv2.imencode(".png", picture)
    if not done:
        raise InputError(f"{title}: the picture {picture.shape} cannot be shown")
    token, nonce = secrets.token_urlsafe(16), secrets.token_urlsafe(16)
    size = picture.shape[1], picture.shape[0]
    page = _page(nonce, title, places, known, size, fewest, aspect)
    state = _State(token, nonce, page, encoded.tobytes(), size, frozenset(places))
    with _Server(state) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
        thread.start()
        try:
            announce(f"http://127.0.0.1:{server.port}/{token}/")
            # Wait in short intervals, so that Ctrl-C works.
            while not state.over.wait(0.2):
                pass
        finally:
            server.shutdown()
            thread.join()
    if state.answer is None:
        raise InputError(f"{title}: cancelled in the browser; nothing was written")
    return state.answer


def click_points(
    target: Target,
    frame: Frame,
    known: Mapping[str, Pixel],
    title: str,
    announce: Callable[[str], None],
) -> dict[str, Pixel]:
    """Ask the user in a browser for the points of a target that were not specified.

    ``announce`` is called with the page's address, which is reachable only from this computer.

    Raises
    ------
    InputError
        If the user cancels.
    """
    places, aspect = places_of(target)
    asked = {name: place for name, place in places.items() if name not in known}
    return ask(
        shown_pixels(frame), asked, known, f"{title}: target {target.name}", announce, aspect=aspect
    )


def _page(
    nonce: str,
    title: str,
    places: Mapping[str, Pixel],
    known: Mapping[str, Pixel],
    size: Sequence[int],
    fewest: int,
    aspect: float,
) -> bytes:
    data = {
        "title": title,
        "size": list(size),
        "points": [{"name": name, "place": list(place)} for name, place in places.items()],
        "given": [{"name": name, "at": list(at)} for name, at in known.items()],
        "fewest": fewest,
        "aspect": aspect,
    }
    # Only "<" could end a script element.
    text = json.dumps(data, ensure_ascii=False).replace("<", "\\u003c")
    code = Path(__file__).with_name("clicking.js").read_text("utf-8").replace("export ", "")
    page = _HTML.replace("@NONCE@", nonce).replace("@CLICKING@", code)
    return page.replace("@DATA@", text).encode()


_HTML = r"""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>Heliotrope: points of a target</title>
<link rel="icon" href="data:,">
<style nonce="@NONCE@">
  * { box-sizing: border-box; }
  html, body { height: 100%; margin: 0; }
  body { display: flex; font: 14px/1.45 system-ui, sans-serif; color: #1c2127;
    background: #f4f5f6; }
  #picture { flex: 1; min-width: 0; height: 100%; background: #3a4048; cursor: crosshair; }
  aside { width: 300px; height: 100%; padding: 14px; display: flex; flex-direction: column;
    gap: 8px; border-left: 1px solid #c9ced4;
    overflow: hidden auto; }
  h1 { font-size: 15px; margin: 0; overflow-wrap: anywhere; }
  #ask { flex: none; min-height: 42px; font-weight: 600; overflow-wrap: anywhere; }
  #ask span { display: block; font-weight: 400; color: #59616b; }
  #sketch { flex: none; width: 100%; height: 90px; }
  #glass { flex: none; width: 100%; height: 170px; border: 1px solid #9aa2ab;
    background: #3a4048; }
  ol { flex: 1 0 96px; overflow: auto; margin: 0; padding: 0; list-style: none;
    border: 1px solid #c9ced4; background: #fff; }
  li { display: flex; justify-content: space-between; gap: 8px; padding: 3px 8px; cursor: pointer;
    overflow-wrap: anywhere; }
  li.now { background: #dbe9f8; }
  li.given { color: #59616b; cursor: default; }
  li span { color: #59616b; font-variant-numeric: tabular-nums; white-space: nowrap; }
  .keys { display: grid; grid-template-columns: 1fr 1fr; gap: 6px; }
  button { font: inherit; padding: 6px; border: 1px solid #9aa2ab; border-radius: 4px;
    background: #fff; cursor: pointer; }
  button:disabled { color: #9aa2ab; cursor: default; }
  #done:enabled { background: #1f5fa8; border-color: #1f5fa8; color: #fff; }
  #said { min-height: 20px; color: #a02020; overflow-wrap: anywhere; }
  small { color: #59616b; }
</style>
<canvas id="picture"></canvas>
<aside>
  <h1></h1>
  <canvas id="sketch"></canvas>
  <div id="ask"></div>
  <canvas id="glass"></canvas>
  <ol></ol>
  <div class="keys">
    <button id="undo">Undo</button><button id="skip">Skip</button>
    <button id="cancel">Cancel</button><button id="done">Done</button>
  </div>
  <div id="said" role="status"></div>
  <small>Wheel: zoom. Drag: move. Space: put the point in the centre. Arrows: nudge the last point
  by a quarter of a pixel, with Shift by 4, with Ctrl by 40. S: skip, Backspace: undo,
  Enter: done.</small>
</aside>
<script id="data" type="application/json" nonce="@NONCE@">@DATA@</script>
<script nonce="@NONCE@">
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const image = new Image();
document.querySelector("h1").textContent = data.title;
@CLICKING@
const parts = { picture: byId("picture"), glass: byId("glass"), sketch: byId("sketch"),
  ask: byId("ask"), list: document.querySelector("ol") };
const told = () => {
  const missing = data.fewest - found.size - data.given.length, may = free();
  byId("undo").disabled = !may.undo;
  byId("skip").disabled = !may.skip;
  byId("done").disabled = missing > 0;
  byId("done").title = missing > 0 ? `${missing} more needed` : "";
};
const { found, view, toPixel, undo, skip, start, close, free } = clicking(parts, data, image, told);
const send = async (place, body) => {
  byId("said").textContent = "";
  try {
    const reply = await fetch(place, { method: "POST", body });
    const text = (await reply.text()).trim();
    if (!reply.ok) { byId("said").textContent = text; return; }
    close();
    document.querySelector("aside").textContent =
      place === "cancel" ? "Cancelled; nothing was written. This page can be closed."
        : "Thank you. The command continues; this page can be closed.";
  } catch (error) {
    byId("said").textContent = "The command is no longer running; start it again.";
  }
};
const done = () => {
  if (!byId("done").disabled) send("points", JSON.stringify({ points: Object.fromEntries(found) }));
};
byId("undo").addEventListener("click", undo);
byId("skip").addEventListener("click", skip);
byId("cancel").addEventListener("click", () => send("cancel", ""));
byId("done").addEventListener("click", done);

window.addEventListener("keydown", (e) => {
  if (e.key === "Enter" && e.target.tagName !== "BUTTON") { e.preventDefault(); done(); }
});
image.addEventListener("load", start);
image.src = "picture.png";
</script>
</html>
"""
