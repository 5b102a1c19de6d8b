"""The page's files, which are read and compressed once and then served from memory."""

import gzip
import hashlib
from collections.abc import Mapping
from pathlib import Path

from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

STATIC = Path(__file__).with_name("static")
#: The page's only script from another package; the page of `camera teach` also uses it.
_CLICKING = Path(__file__).parents[1] / "imaging" / "targets" / "clicking.js"
#: Responses smaller than this are not compressed, bytes.
SMALL = 1024
_KINDS = {
    ".css": "text/css",
    ".js": "text/javascript",
    ".json": "application/json",
    ".svg": "image/svg+xml",
}
#: Address and file of each page except the sign-in page.
PAGES = {
    "/": "console",
    "/emergency": "emergency",
    "/account": "account",
    "/report": "report",
    "/trends": "trends",
    "/wall": "wall",
}
#: Placeholder in the HTML for the folder of the files.
_FOLDER = "/console/static/"

#: Files by their address within the folder: `live.js`, `languages/de.json`.
_READ = {
    file.relative_to(STATIC).as_posix(): file.read_bytes()
    for file in sorted(STATIC.rglob("*"))
    if file.is_file()
} | {_CLICKING.name: _CLICKING.read_bytes()}
_TAG = hashlib.sha256(b"".join(_READ.values())).hexdigest()[:12]
#: Folder of the page's files. Its name contains the version, so that a browser can keep the files
#: permanently.
KEPT = f"/console/{_TAG}"


class Files:
    """An ASGI middleware that serves the files of the page.

    Parameters
    ----------
    app
        Application that serves all other requests.

    Attributes
    ----------
    paths
        Addresses of the files.
    """

    paths = frozenset(f"{KEPT}/{name}" for name in _READ if Path(name).suffix in _KINDS)

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._answers = {path: _answer(path.removeprefix(f"{KEPT}/")) for path in self.paths}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Respond from memory, or pass the request on to the application."""
        if scope["type"] != "http" or scope["path"] not in self._answers:
            await self._app(scope, receive, send)
            return
        plain, packed, known = self._answers[scope["path"]]
        headers = Headers(scope=scope)
        if headers.get("if-none-match") == known["ETag"]:
            answer = Response(status_code=304, headers=known)
        elif takes_gzip(headers):
            answer = Response(packed, headers={**known, "Content-Encoding": "gzip"})
        else:
            answer = Response(plain, headers=known)
        await answer(scope, receive, send)


def _answer(name: str) -> tuple[bytes, bytes, Mapping[str, str]]:
    """Return a file, both plain and compressed, with its headers."""
    data = _READ[name]
    known = {
        "Content-Type": f"{_KINDS[Path(name).suffix]}; charset=utf-8",
        "Vary": "Accept-Encoding",
        "ETag": f'"{hashlib.sha256(data).hexdigest()[:24]}"',
        "Cache-Control": "public, max-age=31536000, immutable",
    }
    return data, gzip.compress(data, 6, mtime=0), known


def page(name: str) -> str:
    """Return the HTML of a page with the addresses of its files."""
    return _READ[f"{name}.html"].decode().replace(_FOLDER, f"{KEPT}/")


def takes_gzip(headers: Headers) -> bool:
    """Return whether the browser accepts compressed responses."""
    return "gzip" in headers.get("accept-encoding", "")
