"""Sources of frames: folders, videos, a real stream on this machine, simulations; the archive."""

import http.server
import json
import math
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from heliotrope.errors import FetchError, FormatError, InputError, TimeError
from heliotrope.imaging.files import read_image, write_image
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.sources import (
    CameraSource,
    FolderSource,
    SimulatedSource,
    Source,
    StreamSource,
    UsbSource,
    VideoSource,
    average,
    keep,
    open_source,
)

START = datetime(2023, 5, 13, 12, 0, tzinfo=UTC)


def _pixels(level: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.full((48, 64), level, dtype=np.uint8)


def _level(frame: Frame) -> int:
    return round(float(frame.pixels.mean()))


# -- folders ---------------------------------------------------------------------------


def test_a_folder_gives_its_images_in_order(tmp_path: Path) -> None:
    for number in (10, 9, 1):
        write_image(_pixels(number), tmp_path / f"{number}.png")
    (tmp_path / "notes.txt").write_text("no image")
    with FolderSource(tmp_path) as source:
        assert [_level(frame) for frame in source] == [1, 9, 10]
        assert [_level(frame) for frame in source] == [1, 9, 10]
    assert [_level(frame) for frame in FolderSource(tmp_path, limit=2)] == [1, 9]
    assert [_level(frame) for frame in FolderSource(tmp_path / "9.png")] == [9]


def test_a_broken_file_is_raised_or_left_out(tmp_path: Path) -> None:
    for number in (1, 3):
        write_image(_pixels(number), tmp_path / f"{number}.png")
    (tmp_path / "2.png").write_bytes((tmp_path / "1.png").read_bytes()[:-8])
    with pytest.raises(FormatError, match="truncated"):
        list(FolderSource(tmp_path))
    source = FolderSource(tmp_path, skip_broken=True)
    assert [_level(frame) for frame in source] == [1, 3]
    assert [error.path for error in source.skipped] == [str(tmp_path / "2.png")]


def test_a_stop_ends_a_folder(tmp_path: Path) -> None:
    for number in range(3):
        write_image(_pixels(number), tmp_path / f"{number}.png")
    source = FolderSource(tmp_path)
    seen = []
    for frame in source:
        seen.append(_level(frame))
        source.stop.set()
    assert seen == [0]


class _Script:
    """Stands for time: what happens in the folder while the source waits, step by step."""

    def __init__(self, *steps: Callable[[], object]) -> None:
        self.steps = list(steps)
        self.waited: list[float] = []
        self.stop = threading.Event()

    def __call__(self, seconds: float) -> None:
        self.waited.append(seconds)
        if not self.steps:
            self.stop.set()
            return
        self.steps.pop(0)()


def _nothing() -> None:
    pass


def test_a_watched_folder_waits_until_files_are_whole(tmp_path: Path) -> None:
    write_image(_pixels(7), tmp_path / "source.tmp.png")
    whole = (tmp_path / "source.tmp.png").read_bytes()
    (tmp_path / "source.tmp.png").unlink()
    write_image(_pixels(1), tmp_path / "1.png")
    growing = tmp_path / "2.png"

    def arrive() -> None:
        (tmp_path / "part").write_bytes(whole)
        (tmp_path / "part").rename(tmp_path / "3.png")

    script = _Script(
        lambda: growing.write_bytes(whole[:40]),
        lambda: growing.write_bytes(whole[:-9]),
        _nothing,  # looks the same twice, but is not whole
        lambda: growing.write_bytes(whole),
        _nothing,
        arrive,
        _nothing,
        _nothing,
    )
    source = FolderSource(tmp_path, watch=True, poll=0.25, stop=script.stop, wait=script)
    seen = [(Path(frame.name).name, _level(frame), len(script.waited)) for frame in source]
    assert [name for name, _, _ in seen] == ["1.png", "2.png", "3.png"]
    assert [level for _, level, _ in seen] == [1, 7, 7]
    # Each after two looks at what did not change any more.
    assert [looks for _, _, looks in seen] == [1, 5, 7]
    assert set(script.waited) == {0.25}
    assert source.skipped == []


def test_a_file_that_is_written_again_comes_again(tmp_path: Path) -> None:
    latest = tmp_path / "latest.png"
    write_image(_pixels(1), latest)
    script = _Script(_nothing, lambda: write_image(_pixels(2), latest), _nothing, _nothing)
    source = FolderSource(tmp_path, watch=True, stop=script.stop, wait=script)
    assert [_level(frame) for frame in source] == [1, 2]


def test_a_watched_folder_may_go_away_and_come_back(tmp_path: Path) -> None:
    folder, away = tmp_path / "share", tmp_path / "away"
    folder.mkdir()
    write_image(_pixels(1), folder / "1.png")

    def back() -> None:
        away.rename(folder)
        write_image(_pixels(2), folder / "2.png")

    script = _Script(_nothing, lambda: folder.rename(away), _nothing, back, _nothing, _nothing)
    with FolderSource(folder, watch=True, stop=script.stop, wait=script) as source:
        assert [_level(frame) for frame in source] == [1, 2]


def test_what_stays_broken_is_given_up_after_a_while(tmp_path: Path) -> None:
    (tmp_path / "1.png").write_bytes(b"\x89PNG\r\n\x1a\n and no more")
    for skip in (None, False):
        script = _Script(*[_nothing] * 12)
        source = FolderSource(
            tmp_path,
            watch=True,
            poll=1.0,
            patience=8.0,
            stop=script.stop,
            wait=script,
            skip_broken=skip,
        )
        if skip is None:
            assert list(source) == []
            assert len(source.skipped) == 1
        else:
            with pytest.raises(FormatError, match="damaged"):
                list(source)
            assert len(script.waited) == 7


# -- videos ----------------------------------------------------------------------------


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "a.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
    assert writer.isOpened(), "this OpenCV cannot write AVI"
    for number in range(7):
        writer.write(np.full((48, 64, 3), 30 * number, dtype=np.uint8))
    writer.release()
    return path


def test_a_video_gives_frames_with_times(video: Path) -> None:
    zone = timezone(timedelta(hours=2))
    with VideoSource(video, start=START.astimezone(zone), start_deviation=0.2) as source:
        frames = list(source)
    assert [_level(frame) for frame in frames] == pytest.approx([30 * n for n in range(7)], abs=3)
    passed = [(frame.time - START).total_seconds() for frame in frames if frame.time]
    assert passed == pytest.approx([0.1 * n for n in range(7)], abs=1e-6)
    assert frames[3].time_deviation == pytest.approx(math.hypot(0.2, 0.1 / math.sqrt(12)))
    assert frames[3].name == f"{video}#3"
    assert source.missing == 0
    assert len(list(VideoSource(video, limit=2))) == 2
    assert [frame.time for frame in VideoSource(video, limit=1)] == [None]


def test_a_video_that_broke_off_says_how_much_is_missing(video: Path) -> None:
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
    for number in range(7):
        noise = np.random.default_rng(number).integers(0, 255, (48, 64, 3), dtype=np.uint8)
        writer.write(noise)
    writer.release()
    whole = video.read_bytes()
    video.write_bytes(whole[: len(whole) // 2])
    source = VideoSource(video)
    found = len(list(source))
    assert 2 <= found <= 4
    assert source.missing == 7 - found
    video.write_bytes(whole[: len(whole) // 10])
    with pytest.raises(FormatError, match="OpenCV cannot read this video"):
        list(VideoSource(video))


def test_bad_videos_get_one_line(tmp_path: Path) -> None:
    bad = tmp_path / "bad.avi"
    bad.write_bytes(b"RIFF nonsense")
    for path, text in (
        (bad, "OpenCV cannot read this video"),
        (tmp_path / "none.avi", "no such file"),
        (tmp_path, "no such file"),
    ):
        with pytest.raises(FormatError, match=text), VideoSource(path):
            pass
    with pytest.raises(TimeError, match="has no time zone"):
        VideoSource(bad, start=datetime(2023, 5, 13))  # noqa: DTZ001


# -- streams ---------------------------------------------------------------------------


class _Camera:
    """An MJPEG camera over HTTP; every frame is lighter than the last."""

    def __init__(self) -> None:
        self.pause = 0.01
        self.sent = 0
        self.opened = 0
        self.paths: list[str] = []
        self.broken = threading.Event()

    def serve(self, handler: http.server.BaseHTTPRequestHandler) -> None:
        self.opened += 1
        self.paths.append(handler.path)
        if handler.path != "/video":
            handler.send_error(404)
            return
        handler.send_response(200)
        handler.send_header("Content-Type", "multipart/x-mixed-replace; boundary=next")
        handler.end_headers()
        while not self.broken.is_set():
            data = cv2.imencode(".jpg", _pixels(min(self.sent, 255)))[1].tobytes()
            head = f"--next\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
            handler.wfile.write(head.encode() + data + b"\r\n")
            self.sent += 1
            time.sleep(self.pause)


@contextmanager
def _server(camera: _Camera, port: int = 0) -> Iterator[int]:
    class Handler(http.server.BaseHTTPRequestHandler):
        def log_message(self, *args: object) -> None:
            pass

        def do_GET(self) -> None:
            with suppress(OSError):  # the reader has gone
                camera.serve(self)

    class Server(http.server.ThreadingHTTPServer):
        daemon_threads = True
        allow_reuse_address = True

    server = Server(("127.0.0.1", port), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server.server_port
    finally:
        camera.broken.set()
        server.shutdown()
        server.server_close()
        thread.join()


QUICK: dict[str, Any] = {"timeout": 5.0, "pause": 0.02, "longest_pause": 0.1}


def test_a_stream_gives_its_newest_frame_with_its_time() -> None:
    camera = _Camera()
    with _server(camera) as port:
        source = StreamSource(
            f"http://user:secret@127.0.0.1:{port}/video",
            latency=0.25,
            latency_deviation=0.05,
            limit=3,
            clock=lambda: START,
            **QUICK,
        )
        with source:
            frames = []
            for frame in source:
                frames.append(frame)
                # Whoever works slowly finds what came last and not what came next.
                sent = camera.sent
                while camera.sent < sent + 15:
                    time.sleep(0.005)
    assert len(frames) == 3
    levels = [_level(frame) for frame in frames]
    assert levels[1] - levels[0] > 5
    assert levels[2] - levels[1] > 5
    assert source.dropped > 10
    assert frames[0].time == START - timedelta(seconds=0.25)
    assert frames[0].time_deviation == 0.05
    assert "secret" not in frames[0].name + source.name + repr(source)
    assert frames[0].size == (64, 48)


def test_a_stream_that_dies_and_comes_back_goes_on() -> None:
    first, second = _Camera(), _Camera()
    second.sent = 200
    with _server(first) as port:
        source = StreamSource(f"http://127.0.0.1:{port}/video", retries=200, **QUICK)
        source.__enter__()
        frames = iter(source)
        assert _level(next(frames)) < 150
    try:
        # Refused for a while, at the same address another one then.
        time.sleep(0.1)
        with _server(second, port):
            level = 0
            while level < 195:
                level = _level(next(frames))
            assert second.opened >= 1
            assert source.reconnects >= 1
            source.stop.set()
            assert next(frames, None) is None
    finally:
        source.__exit__()


def test_a_stream_that_does_not_come_back_is_given_up() -> None:
    camera = _Camera()
    with _server(camera) as port:
        source = StreamSource(f"http://127.0.0.1:{port}/video", retries=2, **QUICK)
        source.__enter__()
        frames = iter(source)
        next(frames)
    with pytest.raises(FetchError, match=rf"no connection to port {port} \(Connection refused\)"):
        list(frames)
    source.__exit__()


def test_streams_that_cannot_be_opened() -> None:
    camera = _Camera()
    with _server(camera) as port:
        lost = StreamSource(f"http://u:secret@127.0.0.1:{port}/other", **QUICK)
        with (
            pytest.raises(FetchError, match=r"other: it responds, but not with video") as error,
            lost,
        ):
            pass
    assert "secret" not in str(error.value)
    for scheme in ("rtsp", "http"):
        closed = StreamSource(f"{scheme}://127.0.0.1:{port}/video", **QUICK)
        with pytest.raises(FetchError, match=r"\(Connection refused\); check the address"), closed:
            pass
    with pytest.raises(InputError, match="the source is not open; use it in a with block"):
        next(iter(closed))
    for url in ("ftp://a/b", "http://", "http://h:99999999/", "nonsense"):
        with pytest.raises(InputError, match=r"use rtsp://host/… or http://host/…"):
            StreamSource(url)


def test_opencv_and_ffmpeg_write_nothing_to_stderr(tmp_path: Path) -> None:
    """In a process of its own: FFmpeg's level is fixed by what uses it first."""
    (tmp_path / "bad.avi").write_bytes(b"RIFF nonsense")
    code = """
import sys
from heliotrope.errors import HeliotropeError
from heliotrope.imaging.sources import StreamSource, UsbSource, VideoSource
device = UsbSource(96)
device.device = sys.argv[1]
for source in (
    StreamSource("http://127.0.0.1:1/x"), StreamSource("rtsp://127.0.0.1:1/x"),
    VideoSource(sys.argv[1]), device,
):
    try:
        source.__enter__()
    except HeliotropeError as error:
        print(error)
"""
    ran = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "bad.avi")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert ran.stderr == ""
    assert len(ran.stdout.splitlines()) == 4


class _Fake(CameraSource):
    """A camera of captures that are given, without a network."""

    def __init__(self, *captures: Any, **more: Any) -> None:
        super().__init__(name="fake", pause=0.001, longest_pause=0.002, **more)
        self.captures = list(captures)

    def _open(self) -> Any:
        if not self.captures:
            raise FetchError("source fake: gone")
        return self.captures.pop(0)


class _Capture:
    """Gives frames of some levels, then nothing."""

    def __init__(self, *levels: int, refuses: bool = False) -> None:
        self.levels = list(levels)
        self.released = False
        self.settings: dict[int, float] = {}
        self.refuses = refuses

    def grab(self) -> bool:
        time.sleep(0.02)
        return bool(self.levels)

    def retrieve(self) -> tuple[bool, Any]:
        return True, _pixels(self.levels.pop(0))

    def set(self, key: int, value: float) -> bool:
        self.settings[key] = 640.0 if self.refuses else value
        return True

    def get(self, key: int) -> float:
        return self.settings.get(key, 0.0)

    def release(self) -> None:
        self.released = True


def test_a_camera_that_opens_but_sends_nothing_is_given_up() -> None:
    captures = [_Capture(5), *(_Capture() for _ in range(10))]
    with _Fake(*captures, retries=3) as source:
        frames = iter(source)
        assert _level(next(frames)) == 5
        with pytest.raises(FetchError, match="source fake: no frame in 4 attempts"):
            list(frames)
    assert all(capture.released for capture in captures[:4])
    assert source.reconnects == 3


def test_what_goes_wrong_in_the_thread_is_told() -> None:
    def broken() -> datetime:
        raise ZeroDivisionError("clock")

    with (
        _Fake(_Capture(5), clock=broken) as source,
        pytest.raises(ZeroDivisionError, match="clock"),
    ):
        list(source)


# -- devices ---------------------------------------------------------------------------
# There is no camera at the machines that test this: the device is a file and its capture is
# played. What a real driver does with the settings is not tested.


def test_a_device_that_is_absent_is_a_clear_error() -> None:
    with (
        pytest.raises(InputError, match=r"usb:/dev/video97: no such device; available: "),
        UsbSource(97),
    ):
        pass
    with pytest.raises(InputError, match="source usb:front: use a device number"):
        UsbSource("front")


def test_a_device_that_is_no_camera(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    source = UsbSource(96)
    source.device = str(tmp_path / "video96")
    (tmp_path / "video96").touch()
    with pytest.raises(InputError, match="cannot be opened: another program"), source:
        pass
    assert capfd.readouterr().err == ""


def test_a_device_gets_its_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "video96").touch()

    def played(capture: _Capture, **more: Any) -> UsbSource:
        monkeypatch.setattr("heliotrope.imaging.sources.video._capture", lambda *_: capture)
        source = UsbSource("/dev/video96", clock=lambda: START, **more)
        source.device = str(tmp_path / "video96")
        return source

    capture = _Capture(9)
    with played(capture, width=1600, height=1200, exposure=0.0025, gain=3.0, limit=1) as source:
        (frame,) = source
    assert (frame.exposure, frame.gain, frame.time) == (0.0025, 3.0, START)
    assert capture.settings[cv2.CAP_PROP_FRAME_WIDTH] == 1600
    assert capture.settings[cv2.CAP_PROP_FRAME_HEIGHT] == 1200
    assert capture.settings[cv2.CAP_PROP_EXPOSURE] == 25
    assert capture.settings[cv2.CAP_PROP_AUTO_EXPOSURE] == 1
    assert capture.settings[cv2.CAP_PROP_GAIN] == 3.0
    assert capture.released
    plain = _Capture(9)
    with played(plain, limit=1) as source:
        list(source)
    assert set(plain.settings) == {cv2.CAP_PROP_BUFFERSIZE}
    other = _Capture(refuses=True)
    with (
        pytest.raises(InputError, match="does not accept width 1600 px but reports 640; see v4l2"),
        played(other, width=1600),
    ):
        pass
    assert other.released


# -- simulations -----------------------------------------------------------------------


def test_a_simulation_is_asked_for_the_present() -> None:
    times = iter(START + timedelta(seconds=n) for n in range(10))

    def look(when: datetime) -> Frame:
        return Frame(_pixels(when.second))

    with SimulatedSource(look, lambda: next(times), name="twin", limit=3) as source:
        frames = list(source)
    assert source.name == "twin"
    assert [_level(frame) for frame in frames] == [0, 1, 2]
    assert [frame.time for frame in frames] == [START + timedelta(seconds=n) for n in range(3)]
    assert {frame.time_deviation for frame in frames} == {0.0}
    late = START - timedelta(seconds=1)
    source = SimulatedSource(lambda _: Frame(_pixels(1), time=late), lambda: START, limit=1)
    assert next(iter(source)).time == late


# -- by text ---------------------------------------------------------------------------


def test_a_source_is_chosen_by_its_text(video: Path) -> None:
    folder = video.parent
    write_image(_pixels(1), folder / "one.png")
    stop = threading.Event()

    def made(text: str, **more: Any) -> Source:
        return open_source(text, folder=folder, limit=4, stop=stop, **more)

    assert isinstance(made(".", watch=True), FolderSource)
    assert [_level(frame) for frame in made("one.png")] == [1]
    assert next(iter(made("a.avi", start=START))).time == START
    assert isinstance(made("rtsp://10.0.0.5/target"), StreamSource)
    assert isinstance(made(" HTTP://10.0.0.5:8080/video "), StreamSource)
    device = made("usb:2", size=(640, 480))
    assert isinstance(device, UsbSource)
    assert (device.device, device.width, device.height) == ("/dev/video2", 640, 480)
    assert isinstance(made("/dev/video0"), UsbSource)
    assert made("usb:/dev/video1").name == "usb:/dev/video1"
    for source in (made("."), made("a.avi"), made("usb:0"), made("rtsp://h/x")):
        assert (source.limit, source.stop) == (4, stop)


def test_texts_that_are_no_source(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").touch()
    for text, wanted in {
        "": "no source specified; name a folder",
        "ftp://me:secret@host/a": r"source ftp://host/a: frames come over rtsp://, rtsps://, http://",
        "none": "no such file: specify a folder, an image or a video",
        "a.xyz": "is neither a folder, an image or a video",
        "usb:front": "use a device number",
    }.items():
        with pytest.raises(InputError, match=wanted):
            open_source(text, folder=tmp_path)
    with pytest.raises(InputError, match="limit must be 1 frame or more, not 0"):
        iter(open_source(str(tmp_path), limit=0))
    with pytest.raises(InputError, match="poll must be above 0, not 0 s"):
        FolderSource(tmp_path, poll=0)
    with pytest.raises(InputError, match="cannot be read"), FolderSource(tmp_path / "none"):
        pass


# -- averages --------------------------------------------------------------------------


def _texture(shift: int = 0) -> np.ndarray[Any, np.dtype[np.float64]]:
    rough = np.random.default_rng(3).normal(0.0, 1.0, (200, 260))
    smooth = cv2.GaussianBlur(rough, (0, 0), 2.5)
    return 100.0 + 20.0 * smooth[:180, 20 - shift : 260 - shift] / smooth.std()


def _noisy(rng: np.random.Generator, shift: int = 0) -> Frame:
    image = _texture(shift) + rng.normal(0.0, 4.0, (180, 240))
    return Frame(np.clip(np.rint(image), 0, 255).astype(np.uint8), "burst", START, 0.1, 0.01, 2.0)


def test_an_average_has_less_noise_and_loses_nothing() -> None:
    rng = np.random.default_rng(4)
    frames = [replace(_noisy(rng), time=START + timedelta(seconds=n)) for n in range(16)]
    mean = average(frames)
    assert mean.pixels.dtype == np.uint16
    exact = np.mean([frame.pixels for frame in frames], axis=0)
    assert np.abs(mean.pixels / 257.0 - exact).max() <= 0.5 / 257.0 + 1e-9
    assert (mean.pixels / 257.0 - _texture()).std() == pytest.approx(4.0 / 4.0, rel=0.1)
    assert (mean.count, mean.exposure, mean.gain) == (16, 0.01, 2.0)
    assert mean.time == START + timedelta(seconds=7.5)
    assert mean.time_deviation == pytest.approx(0.1)
    assert mean.full_scale / 257.0 == frames[0].full_scale
    # An average of averages weighs each by what is in it.
    both = average([mean, replace(average(frames[:4]), pixels=mean.pixels)])
    assert both.count == 20
    assert both.time == START + timedelta(seconds=(16 * 7.5 + 4 * 1.5) / 20)
    assert np.array_equal(both.pixels, mean.pixels)


def test_what_is_not_common_to_all_is_unknown() -> None:
    frame = Frame(_pixels(1), "a", START, 0.1, 0.01, 2.0)
    mean = average([frame, replace(frame, time=None, exposure=0.02, gain=math.nan)])
    assert mean.time is None
    assert all(math.isnan(v) for v in (mean.time_deviation, mean.exposure, mean.gain))


def test_frames_that_have_no_average() -> None:
    rng = np.random.default_rng(5)
    still, moved = _noisy(rng), _noisy(rng, shift=2)
    with pytest.raises(InputError, match=r"the camera moved by (1\.9|2\.0)\d px since the first"):
        average([still, _noisy(rng), moved])
    assert average([still, moved], max_shift=3.0).count == 2
    with pytest.raises(InputError, match="no frame to average"):
        average([])
    for other in (_pixels(1), still.pixels.astype(np.uint16), np.dstack([still.pixels] * 3)):
        with pytest.raises(InputError, match="use frames of the same size and depth"):
            average([still, Frame(other, "other")])


# -- the archive -----------------------------------------------------------------------


def test_a_frame_is_kept_with_its_result(tmp_path: Path) -> None:
    zone = timezone(timedelta(hours=2))
    when = datetime(2023, 5, 13, 17, 53, 57, 250_000, tzinfo=zone)
    frame = Frame(_pixels(5), "rtsp://10.0.0.5/target one", when, 0.05, math.nan, 2.0)
    result = {
        "place_m": np.array([1.5, math.nan]), "seen": np.True_, "when": when, "n": np.int64(3),
        "file": Path("a/b"), "deep": {"list": (1, math.inf, None, "µ")},
    }  # fmt: skip
    image = keep(frame, result, tmp_path / "new" / "archive")
    assert image.name == "20230513T155357.250000Z_target-one.png"
    found = read_image(image)
    assert np.array_equal(found.pixels, frame.pixels)
    assert (found.time, found.time_deviation, found.gain) == (when, 0.05, 2.0)
    record = json.loads(image.with_suffix(".json").read_text("utf-8"))
    assert record["result"] == {
        "place_m": [1.5, None],
        "seen": True,
        "when": "2023-05-13T17:53:57.250000+02:00",
        "n": 3,
        "file": "a/b",
        "deep": {"list": [1, None, None, "µ"]},
    }
    assert record["frame"] == {
        "source": "rtsp://10.0.0.5/target one",
        "time": "2023-05-13T17:53:57.250000+02:00",
        "time_deviation_s": 0.05,
        "exposure_s": None,
        "gain": 2.0,
        "count": 1,
        "size_px": [64, 48],
    }


def test_nothing_kept_is_ever_overwritten(tmp_path: Path) -> None:
    frames = [Frame(_pixels(n), "/a/cam.png") for n in range(3)]
    (tmp_path / "undated_cam-2.json").write_text("of somebody else")
    kept = [keep(frame, {"n": n}, tmp_path) for n, frame in enumerate(frames)]
    assert [path.name for path in kept] == [
        "undated_cam.png",
        "undated_cam-3.png",
        "undated_cam-4.png",
    ]
    for n, path in enumerate(kept):
        assert _level(read_image(path)) == n
        assert json.loads(path.with_suffix(".json").read_text())["result"] == {"n": n}
    assert (tmp_path / "undated_cam-2.json").read_text() == "of somebody else"
    assert len(list(tmp_path.iterdir())) == 7


def test_many_may_keep_at_once(tmp_path: Path) -> None:
    threads = [
        threading.Thread(target=keep, args=(Frame(_pixels(n), "cam"), {"n": n}, tmp_path))
        for n in range(12)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    images = sorted(tmp_path.glob("*.png"))
    assert sorted(_level(read_image(path)) for path in images) == list(range(12))
    for path in images:
        record = json.loads(path.with_suffix(".json").read_text())
        assert record["result"]["n"] == _level(read_image(path))
    assert len(list(tmp_path.iterdir())) == 24


def test_what_cannot_be_kept(tmp_path: Path) -> None:
    frame = Frame(_pixels(1), "cam")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"):
        keep(frame, {}, tmp_path / "file")
    with pytest.raises(InputError, match="a result of type set cannot be stored"):
        keep(frame, {"a": {1}}, tmp_path / "new")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
