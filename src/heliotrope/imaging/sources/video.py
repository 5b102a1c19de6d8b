"""Where frames come from: folders, videos, streams, devices, simulations; and where they are kept.

A source is a context manager and an iterable of frames::

    with open_source("rtsp://10.0.0.5/target", limit=8) as source:
        frame = average(source)
"""

import json
import math
import os
import re
import socket
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from itertools import count, islice
from pathlib import Path
from typing import Any, Self
from urllib.parse import urlsplit

import numpy as np

from heliotrope.errors import FetchError, FormatError, InputError, TimeError
from heliotrope.files.text import write_text
from heliotrope.imaging.files import IMAGE_SUFFIXES, find_images, read_image, write_image
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.motion import find_shift

VIDEO_SUFFIXES = (".avi", ".mp4", ".m4v", ".mkv", ".mov", ".mpg", ".mpeg", ".ts", ".webm", ".mjpeg")
_PORTS = {"rtsp": 554, "rtsps": 322, "http": 80, "https": 443}


@dataclass(kw_only=True)
class Source(ABC):
    """Frames one after the other, while it is open.

    Attributes
    ----------
    limit
        The number of frames after which it ends; None if it never does by itself.
    stop
        Ends it when it is set.
    name
        What errors and frames call it; by default what it is made from.
    """

    name: str = ""
    limit: int | None = None
    stop: threading.Event = field(default_factory=threading.Event, repr=False)

    def __enter__(self) -> Self:
        self._begin()
        return self

    def __exit__(self, *reason: object) -> None:
        self._end()

    def __iter__(self) -> Iterator[Frame]:
        if self.limit is not None and self.limit < 1:
            raise InputError(f"source {self.name}: limit {self.limit} frames must be 1 or more")
        return islice(self._frames(), self.limit)

    @abstractmethod
    def _frames(self) -> Iterator[Frame]:
        """Give frames until it is stopped."""

    def _begin(self) -> None:  # noqa: B027 - some sources have nothing to open
        """Open it, or raise."""

    def _end(self) -> None:  # noqa: B027
        """Close it."""


def open_source(
    text: str,
    *,
    folder: str | Path = ".",
    start: datetime | None = None,
    size: tuple[int, int] = (0, 0),
    watch: bool = False,
    limit: int | None = None,
    stop: threading.Event | None = None,
) -> Source:
    """Return the source that a text names, as a plant file does for a camera.

    Parameters
    ----------
    text
        Folder, image or video file; rtsp://…, http://… (MJPEG, or …/now.jpg); usb:0, /dev/video0.
    folder
        Relative paths start here: the plant file's folder.
    start, size, watch
        When a video begins; width and height asked of a device; whether a folder is watched.
    limit, stop
        When it ends, see :class:`Source`.

    Raises
    ------
    InputError
        The text names nothing that can be a source.
    """
    text, stop = text.strip(), stop or threading.Event()
    scheme, _, rest = text.partition(":")
    scheme, path = scheme.lower(), Path(folder) / text
    if not text:
        raise InputError("no source is given; name a folder, a video, rtsp://…, http://… or usb:0")
    if scheme in _PORTS and rest.startswith("//"):
        from heliotrope.imaging.snapshot import SnapshotSource, is_snapshot

        return (SnapshotSource if is_snapshot(text) else StreamSource)(text, limit=limit, stop=stop)
    if scheme == "usb" or re.fullmatch(r"/dev/video\d+", text):
        device = rest if scheme == "usb" else text
        return UsbSource(device, width=size[0], height=size[1], limit=limit, stop=stop)
    if rest.startswith("//"):
        known = "://, ".join(_PORTS)
        raise InputError(f"source {_hidden(text)}: frames come by {known}://, not by {scheme}://")
    if path.is_dir() or path.suffix.lower() in IMAGE_SUFFIXES:
        return FolderSource(path, watch=watch, limit=limit, stop=stop)
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return VideoSource(path, start=start, limit=limit, stop=stop)
    what = "is neither" if path.exists() else "there is no such file: give"
    kinds = ", ".join((*IMAGE_SUFFIXES, *VIDEO_SUFFIXES))
    raise InputError(f"source {path}: {what} a folder, an image or a video ({kinds})")


def _hidden(url: str) -> str:
    """Return an address without the user and the password in it."""
    return re.sub(r"(?<=://)[^/?#]*@", "", url)


# -- files -----------------------------------------------------------------------------


@dataclass
class FolderSource(Source):
    """The images of a folder in natural order, then, if watched, those that come.

    A watched file is read when it looked the same twice, one poll apart, and is whole; a file
    that changes later comes again, so a camera may always write the same one. A folder that
    goes away, as a network's does, is waited for.

    Attributes
    ----------
    path
        The folder, or one image.
    watch
        Whether it goes on with files that appear.
    poll, patience
        Between looks at the folder, and until a watched file that stays unreadable is broken, s.
    skip_broken
        Whether broken files are left out and noted in ``skipped``, or raised (FormatError);
        None: left out if it is watched.
    read
        Reads a file; by default :func:`heliotrope.imaging.files.read_image`.
    wait
        Waits for seconds; by default until ``stop`` is set.
    """

    path: str | Path
    watch: bool = False
    poll: float = 0.5
    patience: float = 10.0
    skip_broken: bool | None = None
    read: Callable[[Path], Frame] = read_image
    wait: Callable[[float], object] | None = None
    skipped: list[FormatError] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        self.name = self.name or str(self.path)
        if not 0.0 < self.poll < math.inf:
            raise InputError(f"source {self.name}: poll {self.poll} s must be above 0")

    def _begin(self) -> None:
        self._listed()

    def _listed(self) -> list[Path]:
        path = Path(self.path)
        if path.suffix.lower() in IMAGE_SUFFIXES and not path.is_dir():
            return [path]
        return find_images(path)

    def _broken(self, error: FormatError) -> None:
        if not (self.watch if self.skip_broken is None else self.skip_broken):
            raise error
        self.skipped.append(error)

    def _frames(self) -> Iterator[Frame]:
        done: dict[Path, tuple[int, ...]] = {}  # in which state each file was dealt with
        looks: dict[Path, tuple[tuple[int, ...], int]] = {}  # for how many looks it is the same
        needed, patience = (2, self.patience) if self.watch else (1, 0.0)
        while not self.stop.is_set():
            paths: dict[Path, None] = {}
            with suppress(*[InputError] if self.watch else []):  # a watched folder may be away
                paths = dict.fromkeys(self._listed())
            done = {path: state for path, state in done.items() if path in paths or not paths}
            for path in paths:
                state = _state(path)
                if self.stop.is_set() or (self.watch and state in ((), done.get(path))):
                    continue
                seen, times = looks.get(path, (state, 0))
                looks[path] = state, times + 1 if seen == state else 1
                if looks[path][1] < needed:
                    continue
                try:
                    frame = self.read(path)
                except FormatError as error:
                    if looks[path][1] * self.poll >= patience:
                        done[path] = looks.pop(path)[0]
                        self._broken(error)
                    continue
                if not self.watch or _state(path) == state:
                    done[path] = looks.pop(path)[0]
                    yield frame
            if not self.watch:
                return
            (self.wait or self.stop.wait)(self.poll)


def _state(path: Path) -> tuple[int, ...]:
    """Return what changes with a file; nothing if it is not there."""
    try:
        found = path.stat()
    except OSError:
        return ()
    return found.st_ino, found.st_size, found.st_mtime_ns


@dataclass
class VideoSource(Source):
    """The frames of a video file that OpenCV's FFmpeg can read.

    A frame's time is ``start`` and its position, rounded to the interval between frames.
    ``missing`` says afterwards how many frames fewer came than the container announced (an
    estimate in some): a file that broke off ends early and silently.

    Attributes
    ----------
    path
        The file.
    start, start_deviation
        When the first frame was taken, with its zone, or frames have no time; its deviation, s.
    """

    path: str | Path
    start: datetime | None = None
    start_deviation: float = math.nan
    missing: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self.name = self.name or str(self.path)
        if self.start is not None and self.start.tzinfo is None:
            raise TimeError(f"source {self.name}: its start {self.start} has no zone; add one")

    def _begin(self) -> None:
        self._open().release()

    def _open(self) -> Any:
        import cv2

        if not Path(self.path).is_file():
            raise FormatError(self.path, "there is no such file; give a video")
        capture = _capture(str(self.path), cv2.CAP_FFMPEG)
        if capture is None:
            raise FormatError(self.path, "no video that OpenCV can read; convert or copy it again")
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


# -- cameras ---------------------------------------------------------------------------


def _capture(place: str, backend: int, options: list[int] | None = None) -> Any:
    """Return an open capture, or None; OpenCV and FFmpeg write nothing to stderr."""
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
    """The newest frame of a camera that goes on by itself.

    A thread reads all frames and keeps the last: whoever works slowly gets fewer, never older
    ones (``dropped`` counts). A camera that breaks off is opened again after pauses that double
    (``reconnects`` counts); FetchError (a stream) or InputError (a device) if that fails too
    often, or at the first time.

    Attributes
    ----------
    latency, latency_deviation
        From the middle of the exposure until the frame is here, and its standard deviation, s:
        a frame's time is its arrival minus ``latency``. Streams take 0.1 s to 2 s; measure it.
    retries, pause, longest_pause
        Failures in a row before it gives up; first and longest pause before a retry, s.
    clock
        The present, with its zone.
    exposure, gain
        Of its frames; unknown if NaN.
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
        """Return an open capture; raise FetchError or InputError if there is none."""

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
        """Read until it is over, in a thread; leave the reason if it gives up."""
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
        except Exception as error:  # noqa: BLE001 - whoever takes the frames gets it
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
            raise InputError(f"source {self.name}: it is not open; use it in a with block")
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
    """A camera in the network, over RTSP or HTTP (MJPEG).

    Attributes
    ----------
    url
        With user:password@ where the camera needs it; they are never shown.
    timeout
        For opening and for one frame, s.
    """

    url: str = field(repr=False)
    timeout: float = 10.0
    _place: tuple[str, int] = field(default=("", 0), init=False, repr=False)

    def __post_init__(self) -> None:
        self.name = self.name or _hidden(self.url)
        with suppress(ValueError, KeyError):
            parts = urlsplit(self.url)
            self._place = (parts.hostname or "", parts.port or _PORTS[parts.scheme.lower()])
        if not self._place[0]:
            raise InputError(f"source {self.name}: give rtsp://host/… or http://host/…")

    def _open(self) -> Any:
        import cv2

        span = int(1000.0 * self.timeout)
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, span, cv2.CAP_PROP_READ_TIMEOUT_MSEC, span]
        capture = _capture(self.url, cv2.CAP_FFMPEG, limits)
        if capture is not None:
            return capture
        text = "it answers, but with no video; check the path, the user and the password"
        try:  # OpenCV does not say why
            socket.create_connection(self._place, min(self.timeout, 5.0)).close()
        except OSError as error:
            why = error.strerror or str(error)
            text = f"no connection to port {self._place[1]} ({why}); check the address"
        raise FetchError(f"source {self.name}: {text}")


@dataclass
class UsbSource(CameraSource):
    """A camera at this machine, by Video4Linux.

    ``exposure`` goes in steps of 100 µs, ``gain`` in the camera's own; NaN leaves them automatic.
    What the camera does not take is an error.

    Attributes
    ----------
    device
        Its number, or /dev/videoN.
    width, height
        Asked of the camera, pixels; its own if 0.
    """

    device: int | str
    width: int = 0
    height: int = 0

    def __post_init__(self) -> None:
        text = str(self.device).strip()
        if not re.fullmatch(r"\d{1,3}|/dev/video\d{1,3}", text):
            raise InputError(f"source usb:{text}: give the number of a device, or /dev/video0")
        self.device = text if text.startswith("/") else f"/dev/video{text}"
        self.name = self.name or f"usb:{self.device}"

    def _open(self) -> Any:
        import cv2

        if not Path(str(self.device)).exists():
            there = ", ".join(sorted(map(str, Path("/dev").glob("video*")))) or "none"
            raise InputError(f"source {self.name}: there is no such device; there: {there}")
        capture = _capture(str(self.device), cv2.CAP_V4L2)
        if capture is None:
            text = "cannot be opened; another program may use it, or you may not (group video)"
            raise InputError(f"source {self.name}: {text}")
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        # Video4Linux counts exposures in 100 µs; entry 1 of its menu is "manual".
        wanted = [
            (cv2.CAP_PROP_FRAME_WIDTH, "width", self.width or math.nan, " px"),
            (cv2.CAP_PROP_FRAME_HEIGHT, "height", self.height or math.nan, " px"),
            (cv2.CAP_PROP_AUTO_EXPOSURE, "mode", math.nan if math.isnan(self.exposure) else 1, ""),
            (cv2.CAP_PROP_EXPOSURE, "exposure", np.rint(1e4 * self.exposure), " × 100 µs"),
            (cv2.CAP_PROP_GAIN, "gain", self.gain, ""),
        ]
        for key, what, value, unit in wanted:
            if math.isnan(value) or (capture.set(key, value) and capture.get(key) == value):
                continue
            got = capture.get(key)
            capture.release()
            raise InputError(
                f"source {self.name}: {what} {value:g}{unit} is not taken, the camera says "
                f"{got:g}; see v4l2-ctl --list-formats-ext and --list-ctrls"
            )
        return capture


@dataclass
class SimulatedSource(Source):
    """Frames that ``function`` makes of the present of ``clock``, which they get as their time."""

    function: Callable[[datetime], Frame]
    clock: Callable[[], datetime]

    def _frames(self) -> Iterator[Frame]:
        while not self.stop.is_set():
            time = self.clock()
            frame = self.function(time)
            yield frame if frame.time is not None else replace(frame, time=time, time_deviation=0.0)


# -- what is done with frames ----------------------------------------------------------


def average(frames: Iterable[Frame], max_shift: float = 1.0) -> Frame:
    """Return the mean of frames: less noise by the root of their number.

    Parameters
    ----------
    frames
        Of one camera, size and depth.
    max_shift
        Greatest shift against the first frame, pixels, where :func:`find_shift` can measure it.

    Returns
    -------
    Frame
        uint16; of 8-bit frames 257 times the mean: full scale stays full scale. Its time is the
        mean, its deviation the RMS of theirs: the errors of one clock do not average out.

    Raises
    ------
    InputError
        If there is no frame, they differ in size or depth, or the camera moved.
    """
    first: Frame | None = None
    total: Any = 0.0
    used: list[Frame] = []
    for frame in frames:
        first = first or frame
        if (frame.pixels.shape, frame.pixels.dtype) != (first.pixels.shape, first.pixels.dtype):
            raise InputError(
                f"{frame.name}: {frame.pixels.shape} of {frame.pixels.dtype} and {first.name}: "
                f"{first.pixels.shape} of {first.pixels.dtype} have no mean; give frames alike"
            )
        shift = find_shift(first, frame) if used and min(frame.size) >= 16 else None
        if shift is not None and math.hypot(*shift) > max_shift:
            raise InputError(
                f"{frame.name}: the camera moved by {math.hypot(*shift):.2f} px since the first "
                f"frame, the limit is {max_shift:g} px; hold it still or average fewer frames"
            )
        total = total + frame.count * frame.pixels.astype(np.float64)
        used.append(replace(frame, pixels=frame.pixels[:1, :1]))
    if first is None:
        raise InputError("no frame to average; the source gave none")
    counts = [frame.count for frame in used]
    passed = [(f.time - first.time).total_seconds() for f in used if f.time and first.time]
    time = None
    if first.time is not None and len(passed) == len(used):
        time = first.time + timedelta(seconds=float(np.average(passed, weights=counts)))
    scale = (257.0 if first.pixels.dtype == np.uint8 else 1.0) / sum(counts)
    deviation = math.sqrt(sum(frame.time_deviation**2 for frame in used) / len(used))
    return Frame(
        np.rint(total * scale).astype(np.uint16),
        f"mean of {sum(counts)} from {first.name}",
        time,
        deviation if time else math.nan,
        first.exposure if len({frame.exposure for frame in used}) == 1 else math.nan,
        first.gain if len({frame.gain for frame in used}) == 1 else math.nan,
        sum(counts),
    )


def keep(frame: Frame, result: Mapping[str, Any], folder: str | Path) -> Path:
    """Keep a frame with what was found in it: a PNG, and a JSON of the same name; return the PNG.

    Parameters
    ----------
    frame
        Named in the archive by its time in UTC and its source.
    result
        What is JSON, arrays, times, paths; what is no finite number becomes null.
    folder
        Is made if it does not exist; nothing in it is overwritten, a second frame of a name gets
        a number. The JSON comes last, so where it is the PNG is whole.

    Raises
    ------
    InputError
        If it cannot be written, or the result holds what JSON cannot.
    """
    source = re.sub(r"[^A-Za-z0-9]+", "-", re.sub(r"\.\w+$", "", Path(frame.name).name)).strip("-")
    when = frame.time.astimezone(UTC).strftime("%Y%m%dT%H%M%S.%fZ") if frame.time else "undated"
    about = {
        "source": frame.name, "time": frame.time, "time_deviation_s": frame.time_deviation,
        "exposure_s": frame.exposure, "gain": frame.gain, "count": frame.count,
        "size_px": frame.size,
    }  # fmt: skip
    text = json.dumps({"frame": about, "result": result}, default=_plain)
    record = json.loads(text, parse_constant=lambda _: None)
    stem = f"{when}_{source[:60] or 'frame'}"
    draft = Path(folder) / f".{os.getpid()}-{threading.get_ident()}-{stem}.png"
    try:
        draft.parent.mkdir(parents=True, exist_ok=True)
        write_image(frame, draft)
        for number in count(1):
            image = draft.with_name(f"{stem}.png" if number == 1 else f"{stem}-{number}.png")
            notes = image.with_suffix(".json")
            with suppress(FileExistsError):
                if not notes.exists():
                    image.hardlink_to(draft)  # fails if it is there, where a rename would not
                    break
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror}); give a folder") from None
    finally:
        with suppress(OSError):
            draft.unlink()
    write_text(notes, json.dumps(record, ensure_ascii=False, indent=1) + "\n")
    return image


def _plain(value: Any) -> Any:
    """Return what JSON can hold in place of what it cannot."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, datetime | Path):
        return value.isoformat() if isinstance(value, datetime) else str(value)
    raise InputError(
        f"a result of type {type(value).__name__} cannot be kept; give numbers or text"
    )
