"""Target corners that a user clicks in a camera picture, which define the camera's view.

`heliotrope camera teach` does the same without a running plant (`imaging.targets.teaching`). Here
the running camera uses the new view for its next photograph, and a plant file in the data folder
stores it in the form that teaching writes, with dated copies of older versions. The plant's own
file is not changed, because in a simulation that file describes the true cameras; `plant_file`
changes it, and then its views are used.
"""

import asyncio
import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.camera import Camera, project
from heliotrope.field.formats.plant_edit import keep_version
from heliotrope.field.formats.plant_file import read_plant, write_plant
from heliotrope.field.marks import Mark
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Frame, Image
from heliotrope.imaging.targets.rectify import rectify
from heliotrope.imaging.targets.teaching import (
    Taught,
    known_points,
    places_of,
    read_pictures,
    shown_pixels,
    teach,
    with_camera,
    write_taught,
)
from heliotrope.imaging.targets.view import faces, fit_view
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.orders.authority import Person, Role

#: Maximum number of pictures held for users who mark them.
_HELD = 4
#: Largest RMS residual of the points, px; users click within a pixel or two.
_MOST_OFF = 6.0
#: JPEG quality (0 to 100) of pictures to click in and of the rectified picture.
_JPEG = 92

#: Attributes of a camera that define its view.
_VIEW = ("matrix", "distortion", "position", "R_enu_camera")

Pixel = tuple[float, float]


class MarkedCameras(Protocol):
    """Cameras whose view of a target can be replaced while they are in use."""

    def eye(self, target: str) -> Camera:
        """Return the camera of a target, as now known."""
        ...

    def frame(self, target: str) -> Frame:
        """Return the newest frame of a target's camera."""
        ...

    def take_view(self, camera: Camera, target: Target, pictures: Mapping[str, FloatArray]) -> None:
        """Set the camera, target marks and reference pictures for evaluating later photographs."""
        ...


@dataclass(frozen=True)
class PointToMark:
    """A point of a target: name, position from left and top (0 to 1), and expected pixel."""

    name: str
    place: Pixel
    expected: Pixel | None


@dataclass(frozen=True)
class PictureToMark:
    """A picture whose points are to be clicked.

    Attributes
    ----------
    target, camera
        Names.
    number
        Number of the picture, for `Marking.picture` and `Marking.mark`.
    size
        Width and height, px.
    aspect
        Width of the target over its height.
    points
        Points that can be marked.
    kept
        Where the marks will be stored, in words.
    """

    target: str
    camera: str
    number: int
    size: tuple[int, int]
    aspect: float
    points: tuple[PointToMark, ...]
    kept: str


@dataclass(frozen=True)
class MarkedPoint:
    """A marked point: pixel; standard deviation and residual, px; kind of mark; note."""

    name: str
    at: Pixel
    sigma: float
    off: float
    mark: str
    note: str


@dataclass(frozen=True)
class MarksView:
    """The result of marking.

    Attributes
    ----------
    target, camera
        Names.
    saved
        Whether the view is in use; otherwise it was only tried.
    points
        Points, in the order in which they were passed.
    residual
        RMS residual of the points, px.
    sigma
        Standard deviation of a position on the target measured with this view, m.
    text
        The result in words.
    rectified
        The target as seen from the front, rectified with this view: JPEG in base64.
    """

    target: str
    camera: str
    saved: bool
    points: tuple[MarkedPoint, ...]
    residual: float
    sigma: float
    text: str
    rectified: str


@dataclass(frozen=True)
class NewViews:
    """Views from a new plant file.

    Attributes
    ----------
    cameras, surfaces
        Cameras of the new views, and targets with new marks.
    targets
        Targets whose photographs are evaluated differently.
    pictures
        Reference pictures of the new marks.
    """

    cameras: tuple[Camera, ...]
    surfaces: tuple[Target, ...]
    targets: frozenset[str]
    pictures: Mapping[str, FloatArray]

    def read(self, folder: Path) -> Mapping[str, FloatArray]:
        """Return the reference pictures of the new marks, which are in a folder."""
        return read_pictures(folder, self.surfaces)


class Marking:
    """Accepts the views that users mark.

    Parameters
    ----------
    cameras
        Cameras of the plant.
    plant, log
        The controller, and the logbook for events.
    file
        Plant file that stores the views. Beside it, ``before.toml`` is a copy of the plant's own
        file at that time. A view is valid until the plant's own file contains a different view.
        None: views are lost when the program ends.
    """

    def __init__(
        self,
        cameras: MarkedCameras,
        plant: PlantController,
        log: Logbook,
        file: Path | None = None,
    ) -> None:
        self._cameras, self._plant, self._log, self._file = cameras, plant, log, file
        #: The design in use, and the design of the plant's own file.
        self._design = self._own = plant.design
        self._held: dict[int, tuple[str, Frame]] = {}
        self._number = 0

    def resume(self) -> None:
        """Load the stored views, except views that no longer match the plant's own file.

        Raises
        ------
        FormatError
            If a stored file cannot be used.
        """
        file = self._file
        if file is None or not file.is_file():
            return
        kept, before = read_plant(file), read_plant(_before(file))
        for target in kept.targets:
            camera = self._camera_of(target.name)
            if camera is None or not self._fits(before, camera, target.name):
                text = "corners marked earlier are ignored because the plant file has changed since"
                self._log.event("calibration", target.name, text)
                continue
            # Pictures of other marks are next to the plant's own file, and the cameras already have
            # them.
            here = [m for m in target.marks if m.code and (file.parent / m.code).is_file()]
            pictures = read_pictures(file.parent, [replace(target, marks=tuple(here))])
            new = kept.camera(camera.name)
            self._cameras.take_view(new, target, pictures)
            self._design = _with(self._design, new, target)

    def _camera_of(self, target: str) -> Camera | None:
        """Return the camera of a target in the plant's own file."""
        try:
            name = self._cameras.eye(target).name
        except UnknownNameError:
            return None
        return next((c for c in self._own.cameras if c.name == name), None)

    # -- a new plant file ------------------------------------------------------------------

    def sees(self, target: str) -> bool:
        """Return whether a camera observes a target."""
        return self._camera_of(target) is not None

    def views(self, cameras: Sequence[Camera], surfaces: Sequence[Target]) -> NewViews:
        """Return the views of the changed cameras and targets of a new plant file."""
        changed = {camera.name for camera in cameras}
        marked = {surface.name for surface in surfaces}
        known = [t.name for t in self._own.targets if self.sees(t.name)]
        targets = frozenset(
            name for name in known if name in marked or self._cameras.eye(name).name in changed
        )
        return NewViews(tuple(cameras), tuple(surfaces), targets, {})

    def take_file(self, views: NewViews) -> None:
        """Use views from a new plant file, instead of views that users marked."""
        cameras = {camera.name: camera for camera in views.cameras}
        for surface in views.surfaces:
            self._own = _marked(self._own, surface)
            self._design = _marked(self._design, surface)
        for camera in views.cameras:
            self._own = with_camera(self._own, _seeing(self._own.camera(camera.name), camera))
        for target in sorted(views.targets):
            self._design = _marked(self._design, self._own.target(target))
            eye = self._cameras.eye(target)
            if eye.name in cameras:
                eye = _seeing(eye, cameras[eye.name])
                self._design = with_camera(self._design, eye)
            self._cameras.take_view(eye, self._design.target(target), views.pictures)

    def _fits(self, before: Plant, camera: Camera, target: str) -> bool:
        """Return whether the plant's own file still contains the view from before the marking."""
        old = next((c for c in before.cameras if c.name == camera.name), None)
        then = next((t for t in before.targets if t.name == target), None)
        now = self._own.target(target)
        return (
            old is not None
            and then is not None
            and camera.size == old.size
            and _near(now.corners, then.corners)
            and _alike(now.marks, then.marks)
            and all(_near(getattr(camera, part), getattr(old, part)) for part in _VIEW)
        )

    # -- looking ---------------------------------------------------------------------------

    def begin(self, person: Person, target: str) -> PictureToMark:
        """Hold the newest frame of a target's camera for marking.

        Raises
        ------
        RefusedError
            If the person is not an engineer.
        UnknownNameError
            If no camera looks at the target.
        FetchError, InputError
            If there is no frame.
        """
        person.must_be(Role.ENGINEER, "mark corners")
        surface = self._design.target(target)
        camera, frame = self._cameras.eye(target), self._cameras.frame(target)
        self._number += 1
        self._held[self._number] = (target, frame)
        while len(self._held) > _HELD:
            self._held.pop(next(iter(self._held)))
        places, aspect = places_of(surface)
        known = known_points(surface)
        points = tuple(
            PointToMark(name, place, _expected(camera, known[name], frame.size))
            for name, place in places.items()
        )
        return PictureToMark(
            target, camera.name, self._number, frame.size, aspect, points, self._keeps()
        )

    def _keeps(self) -> str:
        if self._file is None:
            return (
                "in use only until the plant's program ends, because it was started without --data"
            )
        return (
            "saved in the data folder, so a restart keeps them; a dated copy of the old view "
            "is "
            "kept too"
        )

    async def picture(self, number: int) -> bytes:
        """Return a held picture as JPEG, as bright as possible.

        Raises
        ------
        UnknownNameError
            If the picture is no longer held.
        """
        frame = self._of(number)[1]
        return await asyncio.to_thread(lambda: _jpeg(shown_pixels(frame)))

    def _of(self, number: int) -> tuple[str, Frame]:
        if number not in self._held:
            raise UnknownNameError("picture to mark", str(number), map(str, self._held))
        return self._held[number]

    # -- marking ---------------------------------------------------------------------------

    async def mark(
        self,
        person: Person,
        target: str,
        number: int,
        points: Mapping[str, Pixel],
        token: int | None = None,
    ) -> MarksView:
        """Try the points that a user clicked; with a token, adopt the resulting view.

        Parameters
        ----------
        person
            An engineer.
        target, number
            The target, and the number of the picture from `begin`.
        points
            Pixel of each point, by the name of the point.
        token
            Token of the command authority; None: nothing is changed.

        Raises
        ------
        InputError
            If the points are too few, outside the picture, or not arranged like the target, or if
            the plant file cannot be written.
        RefusedError
            If the request is not accepted.
        UnknownNameError
            If there is no such target, point or picture.
        """
        person.must_be(Role.ENGINEER, "mark corners")
        if token is not None:
            self._plant.authority.check(person, token, "MARKS")
        about, frame = self._of(number)
        if about != target:
            raise InputError(
                f"target {target}: picture {number} belongs to {about}; open the target again"
            )
        before = self._design
        taught = await asyncio.to_thread(self._taught, target, frame, points)
        view = await asyncio.to_thread(_view_of, taught, frame, self._keeps())
        if token is None:
            return view
        if before is not self._design:
            raise InputError(
                f"target {target}: someone else saved marks in the meantime; open the target again"
            )
        self._plant.authority.check(person, token, "MARKS")
        text = f"{len(points)} points, residuals {view.residual:.2f} px"
        self._plant.note(person, "MARKS", f"{target}, camera {taught.camera}: {text}")
        # Nothing else may be saved while the file is written.
        self._design = taught.plant
        try:
            await asyncio.to_thread(self._keep, taught, person.name)
        except BaseException:
            self._design = before
            raise
        surface = taught.plant.target(target)
        pictures = {name: pixels.astype(np.float64) for name, pixels in taught.pictures.items()}
        self._cameras.take_view(taught.plant.camera(taught.camera), surface, pictures)
        said = f"{target}: corners marked in a picture of camera {taught.camera}: {text}"
        self._log.event("command", person.name, said)
        return replace(view, saved=True)

    def _taught(self, target: str, frame: Frame, points: Mapping[str, Pixel]) -> Taught:
        known = self._cameras.eye(target)
        taught = teach(
            with_camera(self._design, known),
            target,
            frame,
            points,
            camera=known.name,
            prefix=f"plant-{target}",
        )
        off = _rms(taught.fit.residuals)
        if not off <= _MOST_OFF:
            raise InputError(
                f"target {target}: the points deviate by {off:.1f} px from the lens model of "
                f"camera {known.name}, the limit is {_MOST_OFF:g} px; look for a wrongly clicked "
                f"point, or calibrate the lens again (heliotrope camera teach --anew)"
            )
        return taught

    def _keep(self, taught: Taught, person: str) -> None:
        """Write the plant file with a new view, and keep a copy of the old file."""
        if self._file is None:
            return
        camera, target = taught.plant.camera(taught.camera), taught.plant.target(taught.target)
        new = taught.plant
        try:
            if self._file.is_file():
                new = _with(read_plant(self._file), camera, target)
                change = f"{target.name}: corners marked in the console by {person}"
                keep_version(self._file, change, now=self._plant.clock.utc())
            self._file.parent.mkdir(parents=True, exist_ok=True)
            write_plant(self._own, _before(self._file))
            write_taught(replace(taught, plant=new), self._file)
        except OSError as error:
            raise InputError(
                f"target {target.name}: {self._file} cannot be written "
                f"({error.strerror or error}), so nothing was changed; grant the plant's program "
                "write access, or use heliotrope camera teach and restart the program"
            ) from None


def _before(file: Path) -> Path:
    return file.with_name("before.toml")


def _near(a: FloatArray | None, b: FloatArray | None) -> bool:
    """Return whether two arrays are equal to the precision of a file."""
    if a is None or b is None:
        return a is b
    return a.shape == b.shape and bool(np.allclose(a, b, rtol=1e-9, atol=1e-6))


def _alike(one: Sequence[Mark], other: Sequence[Mark]) -> bool:
    """Return whether two lists of marks are equal to the precision of a file."""
    return [(m.name, m.kind, m.code) for m in one] == [
        (m.name, m.kind, m.code) for m in other
    ] and all(
        _near(np.array([*a.point, a.size, a.stroke, a.turn]),
              np.array([*b.point, b.size, b.stroke, b.turn]))
        for a, b in zip(one, other, strict=True)
    )  # fmt: skip


def _with(plant: Plant, camera: Camera, target: Target) -> Plant:
    """Return a plant with one camera replaced, and with new marks on a target."""
    return with_camera(_marked(plant, target), camera)


def _marked(plant: Plant, target: Target) -> Plant:
    """Return a plant with new marks on a target."""
    here = replace(plant.target(target.name), marks=target.marks)
    return replace(plant, targets=tuple(here if t.name == here.name else t for t in plant.targets))


def _seeing(camera: Camera, new: Camera) -> Camera:
    """Return a camera with the view of another one."""
    return replace(camera, **{part: getattr(new, part) for part in (*_VIEW, "deviation")})


def _expected(camera: Camera, point: FloatArray, size: tuple[int, int]) -> Pixel | None:
    """Return the expected pixel of a point.

    Returns None if the point is out of view or the camera is not located.
    """
    if camera.position is None:
        return None
    x, y = (float(v) for v in project(camera, point))
    inside = -0.5 <= x <= size[0] - 0.5 and -0.5 <= y <= size[1] - 0.5
    return (x, y) if inside else None


def _rms(residuals: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=-1))))


def _jpeg(pixels: Image) -> bytes:
    import cv2

    _, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG])
    return data.tobytes()


def _view_of(taught: Taught, frame: Frame, kept: str) -> MarksView:
    fit, target = taught.fit, taught.plant.target(taught.target)
    points = tuple(
        MarkedPoint(
            p.name,
            (float(p.pixel[0]), float(p.pixel[1])),
            float(np.sqrt(0.5 * np.trace(p.covariance))),
            float(np.hypot(*off)),
            "" if p.mark is None else p.mark.kind,
            p.note,
        )
        for p, off in zip(taught.points, fit.residuals, strict=True)
    )
    residual = _rms(fit.residuals)
    said = (
        f"residuals {residual:.2f} px, positions known within {1e3 * fit.plane_sigma:.1f} mm; "
        f"{kept}"
    )
    return MarksView(
        target.name,
        taught.camera,
        False,
        points,
        residual,
        fit.plane_sigma,
        "; ".join((said, *fit.notes)),
        base64.b64encode(_jpeg(_rectified(taught, frame, target))).decode(),
    )


def _rectified(taught: Taught, frame: Frame, target: Target) -> Image:
    """Return the target as seen from the front, rectified with the new view, uint8 (H, W)."""
    face, known = faces((target,))[0], known_points(target)
    plane = face.plane(np.array([known[p.name] for p in taught.points]))
    pixels = np.array([p.pixel for p in taught.points])
    covariance = np.array([p.covariance for p in taught.points])
    view = fit_view(face, plane, pixels, covariance, taught.fit.camera, lens_known=True)
    values = np.clip(rectify(frame, view).values, 0.0, None)
    top = max(float(np.percentile(values, 99.9)), 1e-9)
    return np.asarray(np.round(255.0 * np.clip(values / top, 0.0, 1.0)), dtype=np.uint8)
