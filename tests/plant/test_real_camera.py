"""Cameras of a real plant: their newest frames read, one that falls silent, one asked over HTTP."""

import asyncio
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from heliotrope.errors import FetchError, InputError
from heliotrope.field.coded_visits import ReceiverSettings
from heliotrope.field.plant import Plant
from heliotrope.field.stellenbosch import prototype
from heliotrope.field.target import Receiver
from heliotrope.geometry import normalize
from heliotrope.imaging.files import read_image, write_image
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.sources import (
    SimulatedSource,
    SnapshotSource,
    Source,
    is_snapshot,
    open_source,
)
from heliotrope.imaging.synthetic.scenes import Scene
from heliotrope.imaging.targets.view import posed_view
from heliotrope.links.clock import SystemClock
from heliotrope.plant.io.cameras import RealCameras, source_of
from heliotrope.plant.visits.target_light import light_on
from heliotrope.safety import Alarm
from heliotrope.twin.cameras import FieldSnapshot, RenderedCamera
from heliotrope.twin.drawing import Optics
from heliotrope.twin.true_mirrors import TrueMirror

SUN = normalize(np.array([0.2, -0.7, 0.7]), "sun")
OFF = 0.4


@pytest.fixture(scope="module")
def plant() -> Plant:
    """The prototype's, with half as many pixels each way: quicker to draw and to read."""
    found = prototype()
    (camera,) = found.cameras
    matrix = camera.matrix * [[0.5], [0.5], [1.0]]
    width, height = camera.size
    return replace(found, cameras=(replace(camera, size=(width // 2, height // 2), matrix=matrix),))


@pytest.fixture(scope="module")
def frame(plant: Plant) -> Frame:
    """A photograph of a beam, 0.4 m right of the middle."""
    target = plant.targets[0]
    vertex = np.asarray(target.center) + 38.0 * np.asarray(target.normal) * [1.0, 1.0, 0.0]
    point = np.asarray(target.center) + OFF * target.axes[0]
    normal = normalize(SUN + normalize(point - vertex, "beam"), "normal")
    mirror = TrueMirror("H", vertex, normal, 0.3, 0.3)
    sight = FieldSnapshot(SystemClock(), lambda: [mirror], lambda: SUN, latency=0.0)
    camera = RenderedCamera(
        sight, [Scene(plant.cameras[0], (target,))], optics=Optics(facets=(1, 1))
    )
    asyncio.run(camera.photograph(target, "H"))
    assert camera.last is not None
    return camera.last


class Scripted:
    """A source of the same picture, as of now, while it is told to give it."""

    def __init__(self, frame: Frame, *, late: float = 0.0) -> None:
        self.frame, self.late, self.alive = frame, late, True
        self.deviation = 0.01

    def __call__(self, camera: Any, folder: Path, stop: threading.Event) -> Source:
        def made(at: datetime) -> Frame:
            while not self.alive and not stop.is_set():
                time.sleep(0.02)
            time.sleep(0.05)
            when = at - timedelta(seconds=self.late)
            return replace(self.frame, time=when, time_deviation=self.deviation)

        return SimulatedSource(made, lambda: datetime.now(UTC), stop=stop)


def unheard(alarm: Alarm) -> None:
    """Nobody hears the alarm."""


def looked(cameras: RealCameras, name: str) -> Any:
    return asyncio.run(cameras.look(name))


def test_a_beam_is_seen_where_it_is(plant: Plant, frame: Frame, tmp_path: Path) -> None:
    target = plant.targets[0]
    cameras = RealCameras(
        plant, tmp_path, SystemClock(), memory=tmp_path / "m", sources=Scripted(frame)
    )
    cameras.start(unheard)
    try:
        before = SystemClock().monotonic()
        shot = looked(cameras, target.name)
        assert shot.reasons == ()
        assert shot.at >= before - 0.02
        right, up = target.plane_coordinates(shot.point)
        assert right == pytest.approx(OFF, abs=0.03)
        assert up == pytest.approx(0.0, abs=0.03)
        view = cameras.view(target.name)
        assert view.version == 1
        assert view.jpeg.startswith(b"\xff\xd8")
        assert view.reading[0].startswith("1 spot, +")
    finally:
        cameras.close()
    assert list((tmp_path / "m").glob("*.npz"))


def test_a_view_taken_at_work_counts_for_the_next_photograph(plant: Plant, frame: Frame) -> None:
    target, known = plant.targets[0], plant.cameras[0]
    cameras = RealCameras(plant, Path(), SystemClock(), sources=Scripted(frame))
    with pytest.raises(FetchError, match="camera camera: it has not delivered a frame yet"):
        cameras.frame(target.name)
    cameras.start(unheard)
    try:
        at = target.plane_coordinates(looked(cameras, target.name).point)
        assert np.array_equal(cameras.frame(target.name).pixels, frame.pixels)
        # The marks stand 0.1 m further left than they were believed: so does the beam.
        left = 0.1 * target.axes[0]
        marks = tuple(replace(m, point=m.point - left) for m in target.marks)
        cameras.take_view(known, replace(target, marks=marks), {})
        moved = target.plane_coordinates(looked(cameras, target.name).point)
        assert moved - at == pytest.approx([-0.1, 0.0], abs=0.02)
    finally:
        cameras.close()


def test_a_camera_that_falls_silent_is_told_and_left_alone(plant: Plant, frame: Frame) -> None:
    script, told = Scripted(frame), list[Alarm]()
    cameras = RealCameras(plant, Path(), SystemClock(), patience=0.3, sources=script)
    script.alive = False
    name = plant.targets[0].name
    cameras.start(told.append)
    try:
        with pytest.raises(FetchError, match=r"camera camera: no frame for 0\.3 s; check the"):
            looked(cameras, name)
        assert (told[0].condition, told[0].subject, told[0].active) == ("camera", name, True)
        assert not cameras.awake(name)
        script.alive = True
        until = time.monotonic() + 90.0
        while not cameras.awake(name):
            assert time.monotonic() < until
            time.sleep(0.02)
        assert [alarm.active for alarm in told] == [True, False]
    finally:
        cameras.close()


def test_no_camera_is_awake_for_a_target_that_none_looks_at(plant: Plant, frame: Frame) -> None:
    cameras = RealCameras(plant, Path(), SystemClock(), sources=Scripted(frame))
    name = plant.targets[0].name
    assert (cameras.sees(name), cameras.awake(name)) == (True, True)
    assert (cameras.sees("roof"), cameras.awake("roof")) == (False, False)


def test_a_frame_from_before_is_no_photograph(plant: Plant, frame: Frame) -> None:
    script = Scripted(frame, late=60.0)
    cameras = RealCameras(plant, Path(), SystemClock(), patience=0.3, sources=script)
    cameras.start(unheard)
    try:
        with pytest.raises(FetchError, match="its clock"):
            looked(cameras, plant.targets[0].name)
    finally:
        cameras.close()


class OnRequest(Source):
    """A camera that takes frames only on request, and whose clock is 0.2 s behind."""

    frame: Frame

    def _frames(self) -> Iterator[Frame]:
        while not self.stop.is_set():
            self.wanted.clear()
            yield replace(self.frame, time=datetime.now(UTC) - timedelta(seconds=0.2))
            self.wanted.wait(60.0)


def test_a_camera_whose_clock_is_behind_is_asked_again(plant: Plant, frame: Frame) -> None:
    """Its first frame seems to have been exposed before it was asked for."""

    def source(camera: Any, folder: Path, stop: threading.Event) -> Source:
        made = OnRequest(stop=stop)
        made.frame = replace(frame, time_deviation=0.01)
        return made

    cameras = RealCameras(plant, Path(), SystemClock(), patience=20.0, sources=source)
    cameras.start(unheard)
    try:
        for _ in range(2):
            assert looked(cameras, plant.targets[0].name).reasons == ()
    finally:
        cameras.close()


def test_a_time_that_is_too_unsure_is_a_reason(plant: Plant, frame: Frame) -> None:
    script = Scripted(frame, late=-3.0)
    script.deviation = 2.0
    cameras = RealCameras(plant, Path(), SystemClock(), sources=script)
    cameras.start(unheard)
    try:
        reasons = looked(cameras, plant.targets[0].name).reasons
    finally:
        cameras.close()
    assert any("known only to within 2 s" in reason for reason in reasons)


@pytest.mark.parametrize(
    ("source", "text"),
    [
        ("", "does not say where its frames come from; add source"),
        ("night.avi", "is a recording; specify a source of live frames"),
        ("nowhere", "no such file"),
        ("ftp://a/b", "not over ftp"),
    ],
)
def test_a_source_that_none_is(plant: Plant, tmp_path: Path, source: str, text: str) -> None:
    (tmp_path / "night.avi").write_bytes(b"RIFF")
    camera = replace(plant.cameras[0], source=source)
    with pytest.raises(InputError, match=text):
        source_of(camera, tmp_path, threading.Event())


# -- snapshots -----------------------------------------------------------------------------


class Answers(BaseHTTPRequestHandler):
    """A network camera."""

    image = b""

    def do_GET(self) -> None:
        good = self.path == "/now.png"
        self.send_response(200 if good else 404)
        self.end_headers()
        self.wfile.write(self.image if good else b"no")

    def log_message(self, *_: Any) -> None:
        """Say nothing."""


@pytest.fixture
def camera_server(tmp_path: Path) -> Iterator[str]:
    pixels = np.random.default_rng(1).integers(0, 255, (40, 60), dtype=np.uint8)
    write_image(pixels, tmp_path / "now.png")
    Answers.image = (tmp_path / "now.png").read_bytes()
    server = HTTPServer(("127.0.0.1", 0), Answers)
    thread = threading.Thread(target=server.serve_forever, args=(0.05,))
    thread.start()
    yield f"http://user:secret@127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


def test_snapshots_over_http(camera_server: str, tmp_path: Path) -> None:
    begun = datetime.now(UTC)
    with SnapshotSource(f"{camera_server}/now.png", limit=2, interval=0.01) as source:
        frames = list(source)
    assert len(frames) == 2
    assert (frames[0].pixels == read_image(tmp_path / "now.png").pixels).all()
    assert frames[0].time is not None
    assert begun <= frames[0].time <= datetime.now(UTC)
    assert 0.0 < frames[0].time_deviation < 5.0
    assert "secret" not in frames[0].name


def test_a_snapshot_that_none_is(camera_server: str) -> None:
    source = SnapshotSource(f"{camera_server}/other.png")
    with pytest.raises(FetchError, match="replied 404 with 2 bytes") as refused:
        next(iter(source))
    assert "secret" not in str(refused.value)
    source = SnapshotSource("http://user:secret@127.0.0.1:1/now.jpg", timeout=2.0)
    with pytest.raises(FetchError, match=r"no reply \(ConnectError\)") as refused:
        next(iter(source))
    assert "secret" not in str(refused.value)
    with pytest.raises(InputError, match="not the address of an image"):
        SnapshotSource("http://camera/video")


def test_what_is_a_snapshot() -> None:
    assert is_snapshot("http://10.0.0.5/axis/now.jpg?size=2")
    assert not is_snapshot("http://10.0.0.5/video")
    assert not is_snapshot("frames/now.jpg")
    assert isinstance(open_source("http://10.0.0.5/now.jpg"), SnapshotSource)


def test_the_light_on_a_target_is_seen_from_its_front(plant: Plant, frame: Frame) -> None:
    target, script = plant.targets[0], Scripted(frame)
    cameras = RealCameras(plant, Path(), SystemClock(), sources=script)
    cameras.start(unheard)
    try:
        before = SystemClock().monotonic()
        light = asyncio.run(light_on(cameras, target))
        assert light.at >= before - 0.02
        rows, columns = light.values.shape
        assert columns * light.step == pytest.approx(target.width, abs=0.1)
        # The brightest paint is where the beam is.
        shown = np.where(light.seen, light.values, 0.0)
        row, column = np.unravel_index(int(np.argmax(shown)), shown.shape)
        place = light.first + light.step * np.array([column, -row])
        assert place == pytest.approx([OFF, 0.0], abs=0.2)
        assert not light.seen[[0, rows - 1]].any(), "the rim shows what is behind the target"
        assert 0.0 < np.sqrt(np.trace(light.covariance_at(place))) < 0.05
        again = asyncio.run(light_on(cameras, target, light.view))
        assert again.view is light.view
        np.testing.assert_array_equal(again.values, light.values)
        assert "joint visit" in cameras.view(target.name).reading[0]
        script.deviation = 2.0
        with pytest.raises(FetchError, match="is known only to within 2 s"):
            asyncio.run(light_on(cameras, target))
    finally:
        cameras.close()


def test_the_camera_of_a_receiver_serves_it_and_no_target(plant: Plant, frame: Frame) -> None:
    target, (camera,) = plant.targets[0], plant.cameras
    # A receiver in the place of the target, seen by a camera that names no target.
    receiver = Receiver(
        "receiver", "planar", target.center, target.normal, target.width, target.height
    )
    lit = replace(camera, name="lit", targets=())
    settings = ReceiverSettings("lit", "receiver")
    whole = replace(plant, cameras=(lit, camera), receivers=(receiver,), receiver_visits=settings)
    cameras = RealCameras(whole, Path(), SystemClock(), sources=Scripted(frame))
    cameras.start(unheard)
    try:
        assert cameras.eye(target.name).name == camera.name
        assert cameras.eye("receiver").name == "lit"
        light = asyncio.run(light_on(cameras, receiver.face, posed_view(lit, receiver.face)))
        shown = np.where(light.seen, light.values, 0.0)
        row, column = np.unravel_index(int(np.argmax(shown)), shown.shape)
        place = light.first + light.step * np.array([column, -row])
        assert place == pytest.approx([OFF, 0.0], abs=0.2)
        deviation = np.sqrt(np.trace(light.covariance_at(place)))
        per_metre = np.sqrt(abs(np.linalg.det(light.view.scale(light.shift))))  # type: ignore[union-attr]
        assert deviation == pytest.approx(0.33 * np.sqrt(2.0) / per_metre, rel=0.3)
    finally:
        cameras.close()
    away = replace(lit, R_enu_camera=lit.R_enu_camera @ np.diag([-1.0, 1.0, -1.0]))  # type: ignore[operator]
    with pytest.raises(InputError, match="receiver is not in front of it"):
        posed_view(away, receiver.face)
