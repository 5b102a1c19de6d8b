"""Cameras of a real plant: the newest frame of each source, evaluated like every photograph.

A thread per camera keeps the newest frame of its source (`imaging.sources`): a watched folder, a
stream, a device, or the address of a single image. A photograph of a beam is the first frame
exposed after the request. If no frame arrives within some seconds an alarm is raised, and the
camera's targets are not used until a frame arrives.

The picture of the empty target is updated from every frame (`imaging.memory`), so that light that
changes over the day is not mistaken for a beam.
"""

import asyncio
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

from heliotrope.errors import FetchError, HeliotropeError, InputError, UnknownNameError
from heliotrope.field.camera import Camera
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.memory import Memory
from heliotrope.imaging.photograph import Photograph, PhotographSettings
from heliotrope.imaging.sources import FolderSource, Source, VideoSource, open_source
from heliotrope.imaging.targets.teaching import read_pictures
from heliotrope.imaging.targets.view import FaceView
from heliotrope.links.clock import Clock
from heliotrope.plant.io.camera_views import SEVERAL, Views, beam_of, light_of, picture_of, shot_of
from heliotrope.plant.operations.views import CameraView
from heliotrope.plant.visits.photographs import Shot
from heliotrope.plant.visits.target_light import Exposed, TargetLight
from heliotrope.plant.workers import Worker, at_once
from heliotrope.safety import Alarm, alarms

#: Longest wait for a photograph, and the time between checks for its frame, s.
PATIENCE, _LOOK = 15.0, 0.05
#: Time after which a failed source is opened again, s.
_AGAIN = 5.0
#: Largest standard deviation of a frame's time, s; in 1 s the sun turns a mirror normal by 36 µrad.
_UNSURE = 1.0
#: Longest assumed delay of a stream whose delay is not specified, s.
_LATE = 2.0
#: Number of photographs after which the models of empty targets are saved.
_OFTEN = 20


def source_of(camera: Camera, folder: Path, stop: threading.Event) -> Source:
    """Return the live source of a camera.

    Parameters
    ----------
    camera
        Camera with a ``source``; see docs/how-to/camera-sources.md.
    folder
        Folder of the plant file.
    stop
        Event that ends the source.

    Raises
    ------
    InputError
        If there is no source, if the source is a recording, or if its folder does not exist.
    """
    who = f"camera {camera.name}"
    if not camera.source:
        raise InputError(
            f"{who}: the plant file does not say where its frames come from; add source, such as "
            f"rtsp://…, http://…/now.jpg, usb:0, or a folder into which the camera writes"
        )
    found = open_source(camera.source, folder=folder, size=camera.size, watch=True, stop=stop)
    if isinstance(found, VideoSource):
        raise InputError(f"{who}: {camera.source} is a recording; specify a source of live frames")
    if isinstance(found, FolderSource) and not Path(found.path).exists():
        raise InputError(
            f"{who}: the folder {found.path} does not exist; create it, or correct source"
        )
    return found


class Feed:
    """The newest frame of one source, kept by a thread.

    Parameters
    ----------
    source
        Source of frames; its ``stop`` ends the thread.

    Attributes
    ----------
    newest
        The last frame; None before the first frame.
    problem
        Why no frame arrives; empty if nothing is wrong.
    """

    def __init__(self, source: Source) -> None:
        self.newest: Frame | None = None
        self.problem = ""
        self._source = source
        self._thread = threading.Thread(target=self._run, name=source.name, daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def close(self) -> None:
        """End the thread; a thread that hangs in a driver is abandoned."""
        self._source.stop.set()
        self._source.wanted.set()
        if self._thread.is_alive():
            self._thread.join(2.0)

    def ask(self) -> None:
        """Request a frame now, if the source takes frames at intervals."""
        self._source.wanted.set()

    def _run(self) -> None:
        stop = self._source.stop
        while not stop.is_set():
            try:
                with self._source as source:
                    for frame in source:
                        self.newest, self.problem = frame, ""
            except HeliotropeError as error:
                self.problem = str(error)
            except Exception as error:  # noqa: BLE001 - of a driver; the plant goes on without it
                self.problem = f"{type(error).__name__}: {error}"
            stop.wait(_AGAIN)


@dataclass(frozen=True)
class _Eye:
    """A camera with its feed and its targets."""

    camera: Camera
    targets: tuple[Target, ...]
    feed: Feed


class RealCameras:
    """All cameras of a plant: the port `plant.ports.Cameras`.

    Parameters
    ----------
    design
        The plant; the first camera that names a target serves it. A camera for receiver visits
        serves the receiver, and the targets that it names.
    folder
        Folder of the plant file.
    clock
        Clock of the plant.
    watched
        Cameras of receivers that are monitored apart from receiver visits, by receiver name.
    memory
        Folder for models of empty targets; None: the models are learnt again at each start.
    patience
        Longest wait for a frame, s.
    sources
        Function that creates the source of a camera.
    worker
        Evaluates photographs.

    Attributes
    ----------
    silent
        Targets whose camera delivered no frame at the last request.

    Raises
    ------
    InputError
        If a camera has no live source.
    """

    def __init__(
        self,
        design: Plant,
        folder: Path,
        clock: Clock,
        *,
        watched: Mapping[str, str] | None = None,
        memory: Path | None = None,
        patience: float = PATIENCE,
        sources: Callable[[Camera, Path, threading.Event], Source] = source_of,
        worker: Worker = at_once,
    ) -> None:
        self._clock, self._patience = clock, patience
        self._on_alarm: Callable[[Alarm], None] = lambda _: None
        self._stop = threading.Event()
        # Each photograph is evaluated with what earlier photographs revealed about the empty
        # targets.
        self._worker, self._reading = worker, asyncio.Lock()
        self._memory = Memory() if memory is None else Memory.load(memory)
        self._folder, self._views, self._taken = memory, Views(), 0
        self.silent: set[str] = set()
        self._eyes: dict[str, _Eye] = {}
        visits = design.receiver_visits
        seen = {} if visits is None else {visits.receiver: visits.camera}
        seen = {**(watched or {}), **seen}
        lit = set(seen.values())
        watching = [each for each in design.cameras if each.name not in lit or each.targets]
        for camera, targets in _watching(watching, design.targets):
            eye = _Eye(camera, targets, Feed(sources(camera, folder, self._stop)))
            self._eyes |= {target.name: eye for target in targets}
        for receiver, name in seen.items():
            camera = design.camera(name)
            known = [eye for eye in self._eyes.values() if eye.camera is camera]
            own = known or [_Eye(camera, (), Feed(sources(camera, folder, self._stop)))]
            self._eyes[receiver] = own[0]
        self._settings = PhotographSettings(pictures=read_pictures(folder, design.targets))

    def start(self, on_alarm: Callable[[Alarm], None]) -> None:
        """Begin to take frames; ``on_alarm`` is called when a camera falls silent or recovers."""
        self._on_alarm = on_alarm
        for feed in {id(eye.feed): eye.feed for eye in self._eyes.values()}.values():
            feed.start()

    def close(self) -> None:
        """End all threads, and save the models of empty targets.

        Raises
        ------
        InputError
            If the models cannot be written.
        """
        self._stop.set()
        for eye in self._eyes.values():
            eye.feed.close()
        if self._folder is not None:
            self._memory.save(self._folder)

    def view(self, target: str) -> CameraView:
        """Return the last photograph of a target, for display."""
        return self._views.view(target)

    def eye(self, target: str) -> Camera:
        """Return the camera of a target as it is now known; see `plant.ports.Cameras`."""
        return self._eye(target).camera

    def frame(self, target: str) -> Frame:
        """Return the newest frame that shows a target; see `plant.ports.Cameras`."""
        eye = self._eye(target)
        if eye.feed.newest is None:
            why = eye.feed.problem or "check the camera and its network"
            raise FetchError(f"camera {eye.camera.name}: it has not delivered a frame yet; {why}")
        return eye.feed.newest

    def take_view(self, camera: Camera, target: Target, pictures: Mapping[str, FloatArray]) -> None:
        """Set the camera and target marks for later photographs; see `plant.ports.Cameras`."""
        old = self._eye(target.name)
        targets = tuple(target if t.name == target.name else t for t in old.targets)
        new = _Eye(camera, targets, old.feed)
        self._eyes = {name: new if eye is old else eye for name, eye in self._eyes.items()}
        known = {**self._settings.pictures, **pictures}
        self._settings = replace(self._settings, pictures=known)

    def _eye(self, target: str) -> _Eye:
        if target not in self._eyes:
            raise UnknownNameError("target with a camera", target, list(self._eyes))
        return self._eyes[target]

    def sees(self, target: str) -> bool:
        """Return whether a camera observes a target."""
        return target in self._eyes

    def awake(self, target: str) -> bool:
        """Return whether a target has a camera that is not silent, or has recovered."""
        eye = self._eyes.get(target)
        if eye is None:
            return False
        if target in self.silent:
            frame, limit = eye.feed.newest, timedelta(seconds=self._patience)
            known = None if frame is None else frame.time
            if known is not None and self._clock.utc() - known < limit:
                self._tell(target)
        return target not in self.silent

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """Return the beam seen on a target; the camera cannot tell which heliostat sent it.

        Raises
        ------
        FetchError
            If no frame arrives.
        UnknownNameError
            If no camera observes the target.
        """
        del heliostat
        return await self.look(target.name)

    async def look(self, target: str) -> Shot:
        """Photograph a target; see `photograph`."""
        eye = self._eye(target)
        frame = await self._frame(eye, target)
        seen, jpeg = await self._read(eye, frame)
        assert frame.time is not None
        self._views.keep(target, frame.time.timestamp(), seen, jpeg)
        age = (self._clock.utc() - frame.time).total_seconds()
        shot = shot_of(seen, target, self._clock.monotonic() - age)
        if frame.time_deviation > _UNSURE:
            known = f"{frame.time_deviation:.2g} s, the limit is {_UNSURE:g} s"
            text = (
                f"time: known only to within {known}; set the camera to write its time with a "
                "time zone"
            )
            shot = replace(shot, reasons=(*shot.reasons, text))
        return shot

    async def expose(self, target: Target, view: FaceView | None = None) -> Exposed:
        """Photograph a target; see `plant.visits.target_light.LightCamera`.

        Raises
        ------
        FetchError
            If no frame arrives, or its time is not known well enough.
        """
        eye = self._eye(target.name)
        frame = await self._frame(eye, target.name)
        if frame.time_deviation > _UNSURE:
            known = f"{frame.time_deviation:.2g} s, the limit is {_UNSURE:g} s"
            raise FetchError(
                f"camera {eye.camera.name}: the time of its frames is known only to within "
                f"{known}; set the camera to write its time with a time zone"
            )
        assert frame.time is not None
        taken = frame.time.timestamp()
        at = self._clock.monotonic() - (self._clock.utc().timestamp() - taken)
        settings = self._settings

        async def read() -> TargetLight:
            jpeg = await self._worker(picture_of, Photograph(frame, ()))
            self._views.show(target.name, taken, jpeg, SEVERAL)
            return await self._worker(
                light_of, frame, target, eye.targets, eye.camera, settings, view, at
            )

        return Exposed(at, asyncio.create_task(read()))

    async def _frame(self, eye: _Eye, target: str) -> Frame:
        """Wait for a frame that was exposed after this call."""
        asked, until = self._clock.utc(), self._clock.monotonic() + self._patience
        last = eye.feed.newest
        eye.feed.ask()
        while self._clock.monotonic() < until:
            frame = eye.feed.newest
            if frame is not None and dated(frame, eye.camera) >= asked:
                if target in self.silent:
                    self._tell(target)
                return frame
            if frame is not last:
                # The frame was already on its way, or the camera's clock is slightly behind.
                last = frame
                eye.feed.ask()
            await asyncio.sleep(_LOOK)
        why = eye.feed.problem or "check the camera, its network and its clock"
        text = f"camera {eye.camera.name}: no frame for {self._patience:g} s; {why}"
        self._tell(target, text)
        raise FetchError(text)

    def _tell(self, target: str, problem: str = "") -> None:
        """Raise the alarm about a target's camera, or end it."""
        (self.silent.add if problem else self.silent.discard)(target)
        kind = alarms.CAMERA
        self._on_alarm(kind.raised(target, problem=problem) if problem else kind.ended(target))

    async def _read(self, eye: _Eye, frame: Frame) -> tuple[Photograph, bytes]:
        async with self._reading:
            seen, jpeg, self._memory = await self._worker(
                _learning, frame, eye.targets, eye.camera, self._settings, self._memory
            )
            self._taken += 1
            if self._folder is not None and self._taken % _OFTEN == 0:
                await asyncio.to_thread(self._memory.save, self._folder)
        return seen, jpeg


def _learning(
    frame: Frame,
    targets: Sequence[Target],
    camera: Camera,
    settings: PhotographSettings,
    memory: Memory,
) -> tuple[Photograph, bytes, Memory]:
    """Return the evaluation of a frame, its picture, and the updated models of empty targets."""
    seen, jpeg = beam_of(frame, targets, camera, replace(settings, empty=memory.models))
    memory.learn(seen.faces)
    return replace(seen, faces=()), jpeg, memory


def _watching(
    cameras: Sequence[Camera], targets: Sequence[Target]
) -> list[tuple[Camera, tuple[Target, ...]]]:
    """Return the cameras in use with their targets; each target has one camera."""
    left = {target.name: target for target in targets}
    found = []
    for camera in cameras:
        names = camera.targets or tuple(left)
        mine = tuple(left.pop(name) for name in names if name in left)
        if mine:
            found.append((camera, mine))
    return found


def dated(frame: Frame, camera: Camera) -> datetime:
    """Return the earliest time at which a frame may have been exposed."""
    if frame.time is None:
        raise InputError(
            f"camera {camera.name}: {frame.name} has no time with a time zone; set the camera to "
            f"write one in the file name (2026-06-21T10-00-00Z) or in EXIF"
        )
    unsure = _LATE if math.isnan(frame.time_deviation) else frame.time_deviation
    return frame.time - timedelta(seconds=unsure)
