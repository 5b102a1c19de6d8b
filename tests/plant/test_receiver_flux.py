"""The flux on the receiver by its camera: readings, what gives none, and a running plant."""

import asyncio
import threading
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, HTTPServer
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from heliotrope.console.client import Client
from heliotrope.errors import FetchError, FormatError, InputError
from heliotrope.field.coded_visits import ReceiverSettings
from heliotrope.field.example import example_plant
from heliotrope.field.formats.plant_file import write_plant
from heliotrope.field.plant import Plant
from heliotrope.imaging.files import write_image
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.receiver_file import write_reference
from heliotrope.imaging.receiver_light import ReceiverReference
from heliotrope.plant.io.links_file import read_links
from heliotrope.plant.io.receiver_flux import ReceiverFlux, check_reference
from heliotrope.plant.io.sensors import AllSensors, Readings, SensorFiles
from heliotrope.safety import FLUX_READING
from plant.test_run_real import Process, call, first_password, free_port, private, until
from support.receiver_scene import CAMERA, RECEIVER, capped, frame, mirrors, reference, true_share


@pytest.fixture(scope="module")
def known() -> ReceiverReference:
    return reference()


class Hands:
    """A clock that the test sets; both its times run together."""

    def __init__(self) -> None:
        self.at, self.start = 1000.0, datetime(2026, 6, 21, 10, tzinfo=UTC)

    def monotonic(self) -> float:
        return self.at

    def utc(self) -> datetime:
        return self.start + timedelta(seconds=self.at)


class Desk:
    """A sensor whose camera shows what the test says, and is read once a second."""

    def __init__(self, known: ReceiverReference) -> None:
        self.clock = Hands()
        self.shown: Frame | None = None
        self.flux = ReceiverFlux(CAMERA, self._newest, self.clock, known)  # type: ignore[arg-type]

    def _newest(self) -> Frame:
        if self.shown is None:
            raise FetchError("camera eye: it has not delivered a frame yet")
        return self.shown

    def news(self, shown: Frame | None, *, old: float = 0.2, unsure: float = 0.05) -> Readings:
        """Return what is read a second later of a frame exposed ``old`` s before."""
        self.clock.at += 1.0
        if shown is not None:
            when = self.clock.utc() - timedelta(seconds=old)
            self.shown = replace(shown, time=when, time_deviation=unsure)
        return asyncio.run(self.flux.news())


def problem(news: Readings) -> str:
    assert news.values == {}
    return news.problems[FLUX_READING]


def test_a_reading_counts_from_when_its_frame_was_exposed(known: ReceiverReference) -> None:
    desk = Desk(known)
    news = desk.news(frame(4, seed=1), old=0.7, unsure=0.1)
    assert news.values[FLUX_READING] == pytest.approx(true_share(mirrors(4)), abs=0.01)
    assert news.made[FLUX_READING] == pytest.approx(desk.clock.at - 0.8)
    assert news.problems == {FLUX_READING: ""} or news.problems == {}
    # An arrival without a stated delay may be two seconds late.
    news = desk.news(frame(0, seed=2), old=0.0, unsure=float("nan"))
    assert news.made[FLUX_READING] == pytest.approx(desk.clock.at - 2.0)
    # Asked again at once, it has nothing new.
    assert asyncio.run(desk.flux.news()) == Readings()


def test_a_camera_that_has_died_gives_no_reading(known: ReceiverReference) -> None:
    desk = Desk(known)
    assert "has not delivered a frame yet" in problem(desk.news(None))
    assert desk.news(frame(0)).values
    told = [desk.news(None) for _ in range(9)]
    assert [news.values for news in told] == [{}] * 9
    (text,) = [text for news in told for text in news.problems.values()]
    assert "newest frame is 5 s old, the limit is 5 s" in text
    again = desk.news(frame(0, seed=1))
    assert (again.problems, list(again.values)) == ({FLUX_READING: ""}, [FLUX_READING])


def test_a_fault_of_the_program_is_told_and_leaves_other_sensors_alone(
    known: ReceiverReference, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = Desk(known)

    def broken(*_: object) -> None:
        raise RuntimeError("OpenCV(5.0) error")

    monkeypatch.setattr("heliotrope.plant.io.receiver_flux.receiver_light", broken)
    assert problem(desk.news(frame(0))) == "camera eye: RuntimeError: OpenCV(5.0) error"
    monkeypatch.undo()
    assert desk.news(frame(0)).values


def test_a_frozen_picture_gives_no_reading(known: ReceiverReference) -> None:
    """The stream goes on, with new times, and shows the same pixels."""
    desk, still = Desk(known), frame(0, seed=3)
    assert desk.news(still).values
    assert "are identical in every pixel, so the camera has frozen" in problem(desk.news(still))
    for _ in range(3):
        assert desk.news(still) == Readings(), "told once"
    assert desk.news(frame(0, seed=4)).values


@pytest.mark.parametrize(
    ("shown", "text"),
    [
        (lambda: capped(1), "covers the lens"),
        (lambda: replace(frame(), pixels=np.roll(frame().pixels, 25, axis=1)), "camera was moved"),
        (lambda: Frame(np.zeros((9, 9), np.uint16)), "but the reference has"),
    ],
)
def test_darkness_that_the_camera_cannot_prove_is_no_reading(
    known: ReceiverReference, shown: Any, text: str
) -> None:
    desk = Desk(known)
    assert text in problem(desk.news(shown()))
    assert desk.news(frame(0)).problems == {FLUX_READING: ""}


def test_light_needs_no_proof(known: ReceiverReference) -> None:
    """An overexposed receiver is lit at least as much as it reads."""
    desk, bright = Desk(known), frame(20, seed=5)
    bright.pixels[bright.pixels > 20_000] = 65535
    news = desk.news(bright)
    assert news.values[FLUX_READING] > 0.5
    spot = frame(0, seed=6)
    spot.pixels[115:120, 155:160] = 65535
    assert "overexposed" in problem(desk.news(spot))


@pytest.mark.parametrize(
    ("old", "text"),
    [(7.0, "newest frame is 7 s old"), (-2.0, "2.0 s ahead of the plant's clock")],
)
def test_a_frame_of_another_time_is_no_reading(
    known: ReceiverReference, old: float, text: str
) -> None:
    assert text in problem(Desk(known).news(frame(0), old=old, unsure=0.0))


def test_a_frame_without_a_time_is_no_reading(known: ReceiverReference) -> None:
    desk = Desk(known)
    desk.shown = frame(0)
    assert "has no time with a time zone" in problem(desk.news(None))


def test_several_sensors_are_one(known: ReceiverReference, tmp_path: Path) -> None:
    desk = Desk(known)
    both = AllSensors([SensorFiles({"wind_gust": tmp_path / "gust"}), desk.flux])
    assert both.names == {"wind_gust", FLUX_READING}
    desk.shown = replace(frame(0), time=desk.clock.utc(), time_deviation=0.0)
    news = asyncio.run(both.news())
    assert set(news.values) == set(news.made) == {FLUX_READING}
    assert "cannot be read" in news.problems["wind_gust"]


# -- files ---------------------------------------------------------------------------------


def seen_plant(source: str = "") -> Plant:
    """A plant without targets, whose camera sees its receiver."""
    plain = example_plant()
    camera = replace(CAMERA, source=source)
    return replace(plain, targets=(), receivers=(RECEIVER,), cameras=(camera,))


def test_a_reference_fits_its_plant(known: ReceiverReference) -> None:
    plant = seen_plant()
    check_reference(plant, known)
    other = replace(RECEIVER, name="other")
    for wrong, text in (
        (replace(plant, receivers=()), "the plant's receivers: none"),
        (
            replace(plant, receivers=(RECEIVER, other)),
            "receivers: receiver, other; .* exactly one receiver",
        ),
        (replace(plant, cameras=()), "the plant's cameras: none; add it"),
        (
            replace(plant, cameras=(replace(CAMERA, size=(640, 480)),)),
            "320 × 240 px, but the plant file says 640 × 480",
        ),
        (
            replace(
                plant,
                cameras=(CAMERA, replace(CAMERA, name="b")),
                receiver_visits=ReceiverSettings("b", "receiver"),
            ),
            "receiver visits use camera b",
        ),
    ):
        with pytest.raises(InputError, match=text):
            check_reference(wrong, known)


def links(folder: Path, port: int, sensors: str) -> Path:
    names = {n for group in seen_plant().groups.values() for n in group.cluster}
    path = folder / "links.toml"
    path.write_text(
        'format = "heliotrope-links"\nversion = 1\nkeys = "links.keys"\n'
        f'{sensors}\n[tcp]\nlisten = "127.0.0.1:{port}"\n[clusters]\n'
        + "".join(f'{name} = "tcp"\n' for name in sorted(names))
    )
    keys = "".join(f'{name} = "{bytes([k + 1] * 32).hex()}"\n' for k, name in enumerate(names))
    private(folder / "links.keys", f"[clusters]\n{keys}")
    return path


CHOSEN = 'receiver_light = "receiver.toml"\nsensors.receiver_flux_nominal = "camera"'


@pytest.mark.parametrize(
    ("sensors", "text"),
    [
        ('sensors.receiver_flux_nominal = "camera"', "receiver_light, the reference of that cam"),
        ('receiver_light = "receiver.toml"', 'receiver_flux_nominal = "camera" and receiver_light'),
        ('sensors.wind_gust = "camera"', "a camera supplies receiver_flux_nominal only"),
    ],
)
def test_a_links_file_that_does_not_say_which_camera(
    tmp_path: Path, sensors: str, text: str
) -> None:
    with pytest.raises(FormatError, match=text):
        read_links(links(tmp_path, 4840, sensors))


def test_the_check_reads_reference_and_camera(known: ReceiverReference, tmp_path: Path) -> None:
    write_plant(seen_plant("http://127.0.0.1:1/now.png"), tmp_path / "plant.toml")
    words = tmp_path / "plant.toml", "--clusters", links(tmp_path, 4840, CHOSEN), "--check"
    code, _, err = call(*words)
    assert code == 2
    assert "receiver.toml" in err
    write_reference(known, tmp_path / "receiver.toml")
    code, out, err = call(*words)
    assert (code, err) == (0, ""), out
    write_plant(seen_plant(), tmp_path / "plant.toml")
    code, _, err = call(*words)
    assert code == 2
    assert "camera eye: the plant file does not say where its frames come from;" in err
    write_plant(replace(seen_plant(), cameras=()), tmp_path / "plant.toml")
    code, _, err = call(*words)
    assert code == 2
    assert "the plant's cameras: none; add it to the plant file" in err


# -- a running plant -----------------------------------------------------------------------


class Eye:
    """A network camera that answers each request with the next of some photographs."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._count = folder, 0
        self.show([frame(4, seed=k) for k in range(4)])
        eye = self

        class Answers(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.end_headers()
                self.wfile.write(next(eye.images))

            def log_message(self, *_: Any) -> None:
                """Say nothing."""

        self.server = HTTPServer(("127.0.0.1", 0), Answers)
        self._thread = threading.Thread(target=self.server.serve_forever, args=(0.05,))
        self._thread.start()

    def show(self, frames: list[Frame]) -> None:
        """Answer with these from now on."""
        found = []
        for one in frames:
            self._count += 1
            path = self._folder / f"{self._count}.png"
            write_image(one.pixels, path)
            found.append(path.read_bytes())
        self.images = cycle(found)

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server.server_port}/now.png"

    def end(self) -> None:
        self.server.shutdown()
        self._thread.join()
        self.server.server_close()


@pytest.fixture
def eye(tmp_path: Path) -> Iterator[Eye]:
    found = Eye(tmp_path)
    yield found
    found.end()


def test_a_running_plant_proves_an_emergency_by_its_camera(
    known: ReceiverReference, eye: Eye, tmp_path: Path
) -> None:
    """``heliotrope run`` with a camera over HTTP; no cluster is there, so only the light counts."""
    # Files do not say the exposure: it is that of the camera.
    write_reference(replace(known, exposure=float("nan")), tmp_path / "receiver.toml")
    write_plant(seen_plant(eye.address), tmp_path / "plant.toml")
    path = links(tmp_path, free_port(), CHOSEN)
    plant = Process(
        *("run", str(tmp_path / "plant.toml"), "--clusters", str(path), "--port", "0"),
        *("--data", str(tmp_path / "data"), "--no-browser", "--idle"),
    )
    try:
        assert "flux_after_emergency" not in plant.says(r"no readings for: (.*)")[1]
        address = plant.says(r"console: (\S+)")[1]
        password = first_password(plant)
        with Client(url=address) as client:
            client.sign_in("engineer", password)
            client.change_password(password, "a password of one's own")
            client.sign_in("engineer", "a password of one's own")
            _proven_while_it_is_seen(client, eye)
    finally:
        plant.end()


def _proven_while_it_is_seen(client: Client, eye: Eye) -> None:
    def proof() -> str:
        return str(client.get("emergency")["text"])

    def told() -> list[str]:
        found = [a for a in client.get("alarms") if a["condition"] == "sensor"]
        return [a["text"] for a in found if a["active"]]

    client.ask("POST", "emergency", {"act": "DEFOCUS", "reason": "a test"})
    until(lambda: "flux not proven" in proof(), proof)
    eye.show([frame(0, seed=10 + k) for k in range(4)])
    until(lambda: "flux not proven" not in proof(), proof)
    until(lambda: not told(), told)
    eye.show([capped(20 + k) for k in range(4)])
    until(lambda: "flux not proven" in proof(), proof)
    until(lambda: any("covers the lens" in text for text in told()), told)
    eye.show([frame(0, seed=30 + k) for k in range(4)])
    until(lambda: "flux not proven" not in proof(), proof)
    eye.show([frame(0, seed=40)])
    until(lambda: "flux not proven" in proof(), proof)
    until(lambda: any("camera has frozen" in text for text in told()), told)
