"""Frames decoded by OpenCV: video files, network streams and USB cameras."""

import math
import os
import re
import socket
import threading
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from heliotrope.errors import FetchError, FormatError, InputError, TimeError
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.sources.source import Source, hide_password

VIDEO_SUFFIXES = (".avi", ".mp4", ".m4v", ".mkv", ".mov", ".mpg", ".mpeg", ".ts", ".webm", ".mjpeg")
#: Schemes of network addresses and their ports.
PORTS = {"rtsp": 554, "rtsps": 322, "http": 80, "https": 443}


@dataclass
class VideoSource(Source):
    """The frames of a video file that OpenCV's FFmpeg can decode.

    A frame's time is ``start`` plus its position, rounded to the frame interval. A truncated file
    ends early without an error; afterwards ``missing`` is the number of frames by which the file
    falls short of the number in the container header (an estimate in some formats).

    Attributes
    ----------
    path
        The file.
    start, start_deviation
        Time of the first frame with its time zone, and the standard deviation of that time, s.
        Without a start time, frames have no time.
    """

    path: str | Path
    start: datetime | None = None
    start_deviation: float = math.nan
    missing: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self.name = self.name or str(self.path)
        if self.start is not None and self.start.tzinfo is None:
            raise TimeError(f"source {self.name}: its start {self.start} has no time zone; add one")

    def _begin(self) -> None:
        self._open().release()

    def _open(self) -> Any:
        import cv2

        if not Path(self.path).is_file():
            raise FormatError(self.path, "no such file; specify a video")
        capture = _capture(str(self.path), cv2.CAP_FFMPEG)
        if capture is None:
            raise FormatError(
                self.path, "OpenCV cannot read this video; convert it or copy it again"
            )
        return capture

    def _frames(self) -> Iterator[Frame]:
        import cv2

        capture = self._open()
        try:
            announced, rate = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
            interval = 1.0 / rate if rate > 0.0 else math.nan
            deviation = math.hypot(self.start_deviation, interval / math.sqrt(12.0))
            for number in count():
                if self.stop.is_set():
                    return
                good, pixels = capture.read()
                if not good:
                    self.missing = max(0, int(announced) - number)
                    return
                name, time = f"{self.name}#{number}", None
                if self.start is not None:
                    place = timedelta(milliseconds=capture.get(cv2.CAP_PROP_POS_MSEC))
                    time = self.start + place
                yield Frame(pixels, name, time, deviation if time else math.nan)
        finally:
            capture.release()


def _capture(place: str, backend: int, options: list[int] | None = None) -> Any:
    """Return an open capture, without output to stderr; None if it cannot be opened."""
    import cv2

    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        capture = cv2.VideoCapture(place, backend, options or [])
    finally:
        cv2.utils.logging.setLogLevel(level)
    return capture if capture.isOpened() else None


@dataclass
class CameraSource(Source):
    """The newest frame from a free-running camera.

    A thread reads all frames and keeps only the newest, so a slow caller receives fewer frames but
    never outdated ones (``dropped`` counts the skipped frames). If the connection to the camera is
    lost, it is reopened after pauses that double each time (``reconnects`` counts the attempts). If
    that fails too often, or if the first connection fails, reading raises FetchError for a stream
    or InputError for a device.

    Attributes
    ----------
    latency, latency_deviation
        Delay from the middle of the exposure to the arrival of the frame, and its standard
        deviation, s. A frame's time is its arrival minus ``latency``. Streams have delays of 0.1 s
        to 2 s, which should be measured.
    retries, pause, longest_pause
        Number of consecutive failures after which reading stops with an error, and first and
        longest pause before a retry, s.
    clock
        Function that returns the current time with its time zone.
    exposure, gain
        Exposure and gain to copy into the frames; NaN if unknown.
    """

    latency: float = field(default=0.0, kw_only=True)
    latency_deviation: float = field(default=math.nan, kw_only=True)
    retries: int = field(default=10, kw_only=True)
    pause: float = field(default=0.5, kw_only=True)
    longest_pause: float = field(default=30.0, kw_only=True)
    clock: Callable[[], datetime] = field(default=lambda: datetime.now(UTC), kw_only=True)
    exposure: float = field(default=math.nan, kw_only=True)
    gain: float = field(default=math.nan, kw_only=True)
    dropped: int = field(default=0, init=False)
    reconnects: int = field(default=0, init=False)
    _closing: threading.Event = field(default_factory=threading.Event, init=False, repr=False)
    _news: threading.Condition = field(default_factory=threading.Condition, init=False, repr=False)
    _newest: Frame | None = field(default=None, init=False, repr=False)
    _error: Exception | None = field(default=None, init=False, repr=False)
    _thread: threading.Thread | None = field(default=None, init=False, repr=False)

    @abstractmethod
    def _open(self) -> Any:
        """Return an open capture; raise FetchError or InputError if it cannot be opened."""

    def _begin(self) -> None:
        capture = self._open()
        self._closing.clear()
        self._newest = self._error = None
        self._thread = threading.Thread(target=self._read, args=(capture,), name=self.name)
        self._thread.daemon = True
        self._thread.start()

    def _end(self) -> None:
        self._closing.set()
        if self._thread is not None:
            self._thread.join()
        self._thread = None

    def _over(self) -> bool:
        return self._closing.is_set() or self.stop.is_set()

    def _read(self, capture: Any) -> None:
        """Read frames in a thread until the source is closed; store the error if reading fails."""
        failures = 0
        try:
            while not self._over():
                good = capture is not None and capture.grab()
                arrived = self.clock()
                good, pixels = capture.retrieve() if good else (False, None)
                if good:
                    self._take(pixels, arrived)
                    failures = 0
                    continue
                if capture is not None:
                    capture.release()
                failures += 1
                self._closing.wait(min(self.pause * 2.0 ** (failures - 1), self.longest_pause))
                capture = None
                if failures > self.retries:
                    raise FetchError(f"source {self.name}: no frame in {failures} attempts")
                with suppress(*[FetchError, InputError] if failures < self.retries else []):
                    capture = None if self._over() else self._open()
                    self.reconnects += capture is not None
        except Exception as error:  # noqa: BLE001 - raised where frames are taken
            self._error = error
        finally:
            if capture is not None:
                capture.release()

    def _take(self, pixels: Any, arrived: datetime) -> None:
        time = arrived - timedelta(seconds=self.latency)
        frame = Frame(pixels, self.name, time, self.latency_deviation, self.exposure, self.gain)
        with self._news:
            self.dropped += self._newest is not None
            self._newest = frame
            self._news.notify_all()

    def _frames(self) -> Iterator[Frame]:
        if self._thread is None:
            raise InputError(f"source {self.name}: the source is not open; use it in a with block")
        while not self._over():
            with self._news:
                self._news.wait_for(lambda: self._newest or self._error, 0.1)
                frame, self._newest = self._newest, None
            if frame is not None:
                yield frame
            elif self._error is not None:
                raise self._error


@dataclass
class StreamSource(CameraSource):
    """A network camera over RTSP or HTTP (MJPEG).

    Attributes
    ----------
    url
        Address, with user:password@ if the camera requires it; the credentials are never displayed.
    timeout
        Timeouts for opening and for one frame, s.
    """

    url: str = field(repr=False)
    timeout: float = 10.0
    _place: tuple[str, int] = field(default=("", 0), init=False, repr=False)

    def __post_init__(self) -> None:
        self.name = self.name or hide_password(self.url)
        with suppress(ValueError, KeyError):
            parts = urlsplit(self.url)
            self._place = (parts.hostname or "", parts.port or PORTS[parts.scheme.lower()])
        if not self._place[0]:
            raise InputError(f"source {self.name}: use rtsp://host/… or http://host/…")

    def _open(self) -> Any:
        import cv2

        span = int(1000.0 * self.timeout)
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, span, cv2.CAP_PROP_READ_TIMEOUT_MSEC, span]
        capture = _capture(self.url, cv2.CAP_FFMPEG, limits)
        if capture is not None:
            return capture
        text = "it responds, but not with video; check the path, the user and the password"
        try:  # OpenCV does not state a reason
            socket.create_connection(self._place, min(self.timeout, 5.0)).close()
        except OSError as error:
            why = error.strerror or str(error)
            text = f"no connection to port {self._place[1]} ({why}); check the address"
        raise FetchError(f"source {self.name}: {text}")


@dataclass
class UsbSource(CameraSource):
    """A camera attached to this computer, via Video4Linux.

    ``exposure`` is set in steps of 100 µs and ``gain`` in the camera's own steps; NaN leaves a
    setting automatic. If the camera does not accept a value, InputError is raised.

    Attributes
    ----------
    device
        Device number, or /dev/videoN.
    width, height
        Requested frame size, px; 0 for the camera's default.
    """

    device: int | str
    width: int = 0
    height: int = 0

    def __post_init__(self) -> None:
        text = str(self.device).strip()
        if not re.fullmatch(r"\d{1,3}|/dev/video\d{1,3}", text):
            raise InputError(
                f"source usb:{text}: use a device number or a path such as /dev/video0"
            )
        self.device = text if text.startswith("/") else f"/dev/video{text}"
        self.name = self.name or f"usb:{self.device}"

    def _open(self) -> Any:
        import cv2

        if not Path(str(self.device)).exists():
            present = ", ".join(sorted(map(str, Path("/dev").glob("video*")))) or "none"
            raise InputError(f"source {self.name}: no such device; available: {present}")
        capture = _capture(str(self.device), cv2.CAP_V4L2)
        if capture is None:
            text = (
                "cannot be opened: another program is using it, or you lack permission (group "
                "video)"
            )
            raise InputError(f"source {self.name}: {text}")
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        # Video4Linux counts exposures in units of 100 µs; entry 1 of its exposure menu is "manual".
        settings = [
            (cv2.CAP_PROP_FRAME_WIDTH, "width", self.width or math.nan, " px"),
            (cv2.CAP_PROP_FRAME_HEIGHT, "height", self.height or math.nan, " px"),
            (cv2.CAP_PROP_AUTO_EXPOSURE, "mode", math.nan if math.isnan(self.exposure) else 1, ""),
            (cv2.CAP_PROP_EXPOSURE, "exposure", np.rint(1e4 * self.exposure), " × 100 µs"),
            (cv2.CAP_PROP_GAIN, "gain", self.gain, ""),
        ]
        for key, what, value, unit in settings:
            if math.isnan(value) or (capture.set(key, value) and capture.get(key) == value):
                continue
            got = capture.get(key)
            capture.release()
            raise InputError(
                f"source {self.name}: the camera does not accept {what} {value:g}{unit} "
                f"but reports {got:g}; see v4l2-ctl --list-formats-ext and --list-ctrls"
            )
        return capture
