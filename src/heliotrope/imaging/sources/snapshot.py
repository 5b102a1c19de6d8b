"""A network camera that replies to each HTTP request with one photograph."""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from heliotrope.errors import FetchError, InputError
from heliotrope.imaging.files import IMAGE_SUFFIXES, read_image
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.sources.source import Source, hide_password

if TYPE_CHECKING:
    import httpx

#: Maximum size of a reply, bytes; larger replies are not photographs.
_LARGEST = 64 * 2**20


def is_snapshot(text: str) -> bool:
    """Return whether a camera's source is the address of one image: ``http://…/now.jpg``."""
    parts = urlsplit(text.strip())
    return parts.scheme.lower() in ("http", "https") and parts.path.lower().endswith(IMAGE_SUFFIXES)


@dataclass
class SnapshotSource(Source):
    """Photographs that a camera takes on request.

    A frame's time is the time stored in the file, if any. Otherwise it is the midpoint between
    request and response, with half of that interval as its standard deviation. A user name and
    password in the address are sent as credentials and never displayed.

    Attributes
    ----------
    url
        Address of the image.
    interval
        Interval between requests while no caller is waiting for a frame, s.
    timeout
        Timeout of a request, s.

    Raises
    ------
    InputError
        If the address is not that of an image.
    """

    url: str
    interval: float = 5.0
    timeout: float = 10.0

    def __post_init__(self) -> None:
        self.name = self.name or hide_password(self.url)
        if not is_snapshot(self.url):
            raise InputError(
                f"source {self.name}: not the address of an image; use http://host/… ending in "
                f"{', '.join(IMAGE_SUFFIXES)}"
            )

    def _frames(self) -> Iterator[Frame]:
        """Yield photographs until the source is stopped.

        Raises
        ------
        FetchError
            If the camera does not reply, or does not reply with an image.
        FormatError
            If the image is broken.
        """
        import httpx

        with (
            httpx.Client(timeout=self.timeout, trust_env=False) as client,
            tempfile.TemporaryDirectory(prefix="heliotrope-") as folder,
        ):
            file = Path(folder) / f"snapshot{Path(urlsplit(self.url).path).suffix.lower()}"
            while not self.stop.is_set():
                self.wanted.clear()
                yield self._ask(client, file)
                self.wanted.wait(self.interval)

    def _ask(self, client: "httpx.Client", file: Path) -> Frame:
        import httpx

        begun = datetime.now(UTC)
        try:
            answer = client.get(self.url)
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            why = type(error).__name__
            raise FetchError(f"source {self.name}: no reply ({why}); check the address") from None
        span = datetime.now(UTC) - begun
        if answer.status_code != 200 or not 0 < len(answer.content) <= _LARGEST:
            raise FetchError(
                f"source {self.name}: replied {answer.status_code} with {len(answer.content)} "
                "bytes; check address, user and password"
            )
        file.write_bytes(answer.content)
        frame = read_image(file)
        if frame.time is None:
            half = span / 2
            frame = replace(frame, time=begun + half, time_deviation=half.total_seconds())
        return replace(frame, name=self.name)
