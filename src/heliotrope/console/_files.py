"""The page's files served from memory: one turn of the plant's loop each, and no thread.

The page has some thirty files. Reading one from the disk takes a thread and several turns of the
loop, which the plant needs too; compressing it again for every viewer takes even more.
"""

import gzip
import hashlib
from pathlib import Path
from typing import Any

from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

STATIC = Path(__file__).with_name("static")
#: The page's only script from another package, which its own page of `camera teach` has too.
CLICKING = Path(__file__).parents[1] / "imaging" / "targets" / "clicking.js"
#: Number of files that are kept, and the largest of them, bytes.
_MOST, _LARGEST = 200, 4 << 20
#: Smaller answers are not compressed, bytes.
SMALL = 1024
_PACKED = ("text/", "application/javascript", "application/json", "image/svg")
#: A file with a version in its name never changes.
_FOREVER = "public, max-age=31536000, immutable"


def _tag() -> str:
    digest = hashlib.sha256()
    for file in (*sorted(STATIC.iterdir()), CLICKING):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


#: Version of static/, part of the addresses of the page's own files.
TAG = _tag()
#: Their addresses: for the page, which browsers cache, and for plain pages.
KEPT, PLAIN = f"/console/{TAG}", "/console/static"


class Files:
    """An ASGI middleware that keeps the files of the page in memory.

    Parameters
    ----------
    app
        Application that reads them.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._kept: dict[str, tuple[bytes, bytes | None, dict[str, str]]] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer from memory, or pass the request on and remember the answer."""
        path = scope.get("path", "")
        if scope["type"] != "http" or scope["method"] != "GET" or not _is_file(path):
            await self._app(scope, receive, send)
            return
        if path not in self._kept:
            made = await self._read(scope, receive)
            if made is None:
                await self._app(scope, receive, send)
                return
            self._kept[path] = made
        plain, packed, known = self._kept[path]
        headers = Headers(scope=scope)
        if headers.get("if-none-match") == known["ETag"]:
            await Response(status_code=304, headers=known)(scope, receive, send)
            return
        given = dict(known)
        if packed is not None and takes_gzip(headers):
            plain, given["Content-Encoding"] = packed, "gzip"
        await Response(plain, headers=given)(scope, receive, send)

    async def _read(
        self, scope: Scope, receive: Receive
    ) -> tuple[bytes, bytes | None, dict[str, str]] | None:
        """Return a whole file with its headers; None if it should not be kept."""
        if len(self._kept) >= _MOST:
            return None
        body, start = bytearray(), dict[str, Any]()

        async def take(message: Message) -> None:
            if message["type"] == "http.response.start":
                start.update(message)
            else:
                body.extend(message.get("body", b""))

        # A range, or a file that the browser already has, is not the whole file.
        wanted = [(b"host", Headers(scope=scope).get("host", "").encode("latin-1"))]
        await self._app({**scope, "headers": wanted}, receive, take)
        if start.get("status") != 200 or len(body) > _LARGEST:
            return None
        data, was = bytes(body), Headers(raw=start["headers"])
        kind = was.get("content-type", "application/octet-stream")
        known = {
            "Content-Type": kind,
            "Vary": "Accept-Encoding",
            "ETag": f'"{hashlib.sha256(data).hexdigest()[:24]}"',
            "Cache-Control": "no-cache" if path_is_plain(scope["path"]) else _FOREVER,
        }
        packed = kind.startswith(_PACKED) and len(data) > SMALL
        return data, gzip.compress(data, 6, mtime=0) if packed else None, known


def takes_gzip(headers: Headers) -> bool:
    """Whether the browser accepts compressed answers."""
    return "gzip" in headers.get("accept-encoding", "")


def path_is_plain(path: str) -> bool:
    """Whether a path has no version in it, so that its file may change with the program."""
    return path.startswith(f"{PLAIN}/")


def _is_file(path: str) -> bool:
    if path.startswith(("/console/static/", f"{KEPT}/")):
        return True
    parts = path.split("/", 4)
    return len(parts) == 5 and parts[1] == "_nicegui" and parts[3] in ("static", "components")
