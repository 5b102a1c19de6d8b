"""Read a photograph: its targets, their spots in metres with covariance, reasons against them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np

from heliotrope.errors import InputError
from heliotrope.field.camera import Camera
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.spots import background as backgrounds
from heliotrope.imaging.spots.background import Background, EmptyTarget
from heliotrope.imaging.spots.quality import Expectation, Limits, Reason, judge
from heliotrope.imaging.spots.spot import Spot, find_spots
from heliotrope.imaging.targets.finding import FoundTarget, Pictures, find_targets
from heliotrope.imaging.targets.rectify import ACROSS, Rectified, from_crop, rectify
from heliotrope.imaging.targets.view import Face, FaceView

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

#: Rim of a target whose pixels show part of what lies beyond: least width, multiple of the
#: softness of the marks' edges, and greatest width, px.
_LEAST_RIM, _SOFT_RIM, _MOST_RIM = 2, 1.5, 8


@dataclass(frozen=True)
class PlacedSpot:
    """A spot and its place.

    Attributes
    ----------
    spot
        Its shape, on its face.
    target
        The target under its centroid; None beside all targets.
    plane
        Metres right of and above the target's centre (of the face's origin if there is no
        target), (2,).
    covariance
        Covariance of ``plane``: spot, view and survey, m², (2, 2).
    point
        ENU metres, (3,).
    covariance_enu
        Covariance of the point, m², (3, 3); 0 across the plane.
    pixel
        Pixel of the frame, (2,).
    flux
        Its light over the frame's exposure and gain, full scales m² per second at gain 1,
        which makes frames of one camera comparable; NaN if exposure or gain is unknown.
    """

    spot: Spot
    target: Target | None
    plane: FloatArray
    covariance: FloatArray
    point: FloatArray
    covariance_enu: FloatArray
    pixel: FloatArray
    flux: float = float("nan")

    @property
    def deviation(self) -> float:
        """Standard deviation along the worse axis, m."""
        return float(np.sqrt(max(float(np.linalg.eigvalsh(self.covariance)[-1]), 0.0)))


@dataclass(frozen=True)
class TargetReading:
    """One target of a photograph.

    Attributes
    ----------
    found
        The target in the frame.
    spots
        Spots on the target: the intended one first, then by power.
    reasons
        Against the first spot; empty if it is good.
    """

    found: FoundTarget
    spots: tuple[PlacedSpot, ...] = ()
    reasons: tuple[Reason, ...] = ()

    @property
    def good(self) -> bool:
        """Whether the first spot can be trusted."""
        return bool(self.spots) and not self.reasons


@dataclass(frozen=True)
class LookedAt:
    """A face and its background: for pictures, and for learning the empty target.

    Attributes
    ----------
    picture
        The face on a grid of metres.
    background
        The face without beams.
    unexplained
        Share of its paint beside the spots that is brighter or darker than the background.
    """

    picture: Rectified
    background: Background
    unexplained: float = 0.0


@dataclass(frozen=True)
class Photograph:
    """The result of reading a photograph.

    Attributes
    ----------
    frame
        The photograph.
    readings
        One for each target that was searched for.
    beside
        Spots on a found face, but on none of its targets.
    faces
        Each face that was found.
    """

    frame: Frame
    readings: tuple[TargetReading, ...]
    beside: tuple[PlacedSpot, ...] = ()
    faces: tuple[LookedAt, ...] = ()

    def reading(self, target: str) -> TargetReading:
        """Return the reading of a target by name.

        Raises
        ------
        InputError
            If the target was not searched for.
        """
        for reading in self.readings:
            if reading.found.target.name == target:
                return reading
        raise InputError(f"target {target} was not searched for in {self.frame.name}")

    @property
    def views(self) -> tuple[FaceView, ...]:
        """How the faces lie in the frame; the next frame is searched there first."""
        return tuple(f.picture.view for f in self.faces if f.picture.view is not None)


@dataclass(frozen=True)
class PhotographSettings:
    """How photographs are read.

    Attributes
    ----------
    limits
        Tolerances of the spot's quality.
    background
        "frame", "model" (with ``empty``) or "difference" (with an empty frame); "auto"
        takes the best that is available.
    empty
        Models of empty faces under any names; a face's targets select its model.
    expectations
        Expected beams by target.
    pictures
        Pictures of taught marks, by their code.
    gamma
        Exponent of the camera's response: a pixel is light to the power 1/gamma. 1 is linear, 2.2
        is close to sRGB. It is undone before anything is measured.
    """

    limits: Limits = field(default_factory=Limits)
    background: Literal["auto", "frame", "model", "difference"] = "auto"
    empty: Mapping[str, EmptyTarget] = field(default_factory=dict)
    expectations: Mapping[str, Expectation] = field(default_factory=dict)
    pictures: Pictures = field(default_factory=dict)
    gamma: float = 1.0


def read_photograph(
    frame: Frame,
    targets: Sequence[Target],
    camera: Camera | None = None,
    *,
    settings: PhotographSettings | None = None,
    previous: Sequence[FaceView] = (),
    without: Frame | None = None,
) -> Photograph:
    """Find the targets of a photograph and the beams on them.

    Parameters
    ----------
    frame
        The photograph.
    targets
        Targets that may be in it.
    camera
        The camera, as far as it is known.
    settings
        How to read.
    previous
        Views of an earlier photograph of the same camera, which save the search.
    without
        A frame of the same camera without the beam.
    """
    with _one_thread().limit(limits=1, user_api="blas"):
        return _read(frame, targets, camera, settings or PhotographSettings(), previous, without)


@lru_cache(maxsize=1)
def _one_thread() -> "ThreadpoolController":
    """Return the controller of BLAS threads; matrices here are too small for threads to pay."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def _read(
    frame: Frame,
    targets: Sequence[Target],
    camera: Camera | None,
    chosen: PhotographSettings,
    previous: Sequence[FaceView],
    without: Frame | None,
) -> Photograph:
    given, frame = frame, linear(frame, chosen.gamma)
    found = find_targets(frame, targets, camera, previous, chosen.pictures)
    readings = {f.target.name: TargetReading(f, (), (_missing(f),)) for f in found if not f.found}
    beside: list[PlacedSpot] = []
    faces: list[LookedAt] = []
    grey = np.ascontiguousarray(frame.grey)
    for view in _views(found):
        own = [f for f in found if f.view is view]
        rim = _rim(own)
        picture = _trimmed(rectify(frame, view, grey), rim)
        empty = None
        if without is not None:
            known = linear(without, chosen.gamma)
            empty = _trimmed(_empty_picture(known, view, camera, chosen), rim)
        seen, on_face = _read_face(picture, chosen, empty, frame.exposure * frame.gain)
        faces.append(seen)
        for result in own:
            readings[result.target.name] = _reading(result, on_face, seen, chosen)
        beside += [s for s in on_face if s.target is None]
    ordered = tuple(readings[t.name] for t in targets)
    return Photograph(given, ordered, tuple(beside), tuple(faces))


def read_crop(
    frame: Frame, target: Target, settings: PhotographSettings | None = None
) -> Photograph:
    """Find the beam in a picture that shows exactly one target.

    Parameters
    ----------
    frame
        Its corners are those of the target; its size is free.
    target
        The target that it shows.
    settings
        How to read.
    """
    chosen = settings or PhotographSettings()
    picture = _trimmed(from_crop(linear(frame, chosen.gamma), target), _LEAST_RIM)
    with _one_thread().limit(limits=1, user_api="blas"):
        seen, spots = _read_face(picture, chosen, None, frame.exposure * frame.gain)
    found = FoundTarget(target, True, "")
    return Photograph(
        frame,
        (_reading(found, spots, seen, chosen),),
        tuple(s for s in spots if s.target is None),
        (seen,),
    )


def linear(frame: Frame, gamma: float) -> Frame:
    """Return a 16-bit frame whose pixels are proportional to light; the frame itself if gamma is 1.

    Parameters
    ----------
    frame
        The frame as the camera gives it.
    gamma
        The frame's pixels are light to the power 1/gamma.

    Raises
    ------
    InputError
        If gamma is not from 0.2 to 5.
    """
    if gamma == 1.0:
        return frame
    if not 0.2 <= gamma <= 5.0:
        raise InputError(f"gamma {gamma} must be from 0.2 to 5; 1 is linear, 2.2 is usual")
    top = int(frame.full_scale)
    table = np.round(65535.0 * (np.arange(top + 1) / top) ** gamma).astype(np.uint16)
    return replace(frame, pixels=table[frame.pixels])


def _rim(found: Sequence[FoundTarget]) -> int:
    """Return the width of the rim that shows what lies beyond a target, grid pixels."""
    soft = [m.blur.max() for f in found for m in f.marks if m.used and np.isfinite(m.blur).all()]
    if not soft:
        return _LEAST_RIM
    side = min(min(f.target.width, f.target.height) for f in found)
    return int(np.clip(np.ceil(_SOFT_RIM * np.median(soft) / side * ACROSS), _LEAST_RIM, _MOST_RIM))


def _trimmed(picture: Rectified, rim: int) -> Rectified:
    """Return a face without the rim of its surface."""
    import cv2

    inner = cv2.erode(
        picture.surface.astype(np.uint8),
        np.ones((2 * rim + 1, 2 * rim + 1), np.uint8),
        borderType=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    return replace(picture, surface=inner > 0)


def _missing(found: FoundTarget) -> Reason:
    return Reason("target not found", float("nan"), float("nan"), found.reason)


def _views(found: Sequence[FoundTarget]) -> list[FaceView]:
    views: list[FaceView] = []
    for result in found:
        if result.view is not None and not any(result.view is v for v in views):
            views.append(result.view)
    return views


def _empty_picture(
    without: Frame, view: FaceView, camera: Camera | None, chosen: PhotographSettings
) -> Rectified:
    """Return the face in the frame without the beam, searched again: the camera may move."""
    again = find_targets(without, list(view.face.targets), camera, [view], chosen.pictures)
    known = next((f.view for f in again if f.view is not None), None)
    if known is None:
        raise InputError(
            f"{without.name or 'the frame without the beam'}: {again[0].reason}; give an empty "
            "frame of the same camera"
        )
    return rectify(without, known)


def _read_face(
    picture: Rectified, chosen: PhotographSettings, empty: Rectified | None, gathered: float
) -> tuple[LookedAt, list[PlacedSpot]]:
    """Read one face; ``gathered`` is exposure times gain, s."""
    background = _background(picture, chosen, empty)
    spots = [
        replace(_placed(picture, spot), flux=spot.light / gathered if gathered > 0.0 else np.nan)
        for spot in find_spots(picture, background)
    ]
    odd = backgrounds.unexplained(picture, background, [s.spot.region for s in spots])
    return LookedAt(picture, background, odd), spots


def _background(
    picture: Rectified, chosen: PhotographSettings, empty: Rectified | None
) -> Background:
    way = chosen.background
    names = [t.name for t in picture.face.targets]
    model = next((m for m in chosen.empty.values() if m.fits(picture)), None)
    if way == "auto":
        ready = model is not None and model.ready
        way = "difference" if empty is not None else "model" if ready else "frame"
    if way == "difference":
        if empty is None:
            raise InputError("background by difference needs a frame without the beam; give one")
        return backgrounds.from_difference(picture, empty)
    if way == "model":
        if model is None:
            raise InputError(
                f"background by model: target {names[0]} has no model; learn one from empty "
                "frames, or use the frame alone"
            )
        return backgrounds.from_model(picture, model)
    return backgrounds.from_frame(picture)


def _placed(picture: Rectified, spot: Spot) -> PlacedSpot:
    """Place a spot on its target, and add the covariance of the view."""
    face, view = picture.face, picture.view
    point = face.point(spot.centroid)
    covariance, pixel = spot.covariance, picture.pixels(spot.centroid)
    if view is not None:
        covariance = covariance + view.covariance_at(spot.centroid)
        pixel = view.to_pixels(spot.centroid)
    target = _target_at(face, point)
    if target is None:
        axes, plane = face.axes, spot.centroid
    else:
        # The targets of a face lie a few millimetres off its plane, and turned by as little.
        axes, plane = target.axes, target.plane_coordinates(point)
        point = target.point(plane)
    return PlacedSpot(
        spot,
        target,
        np.asarray(plane),
        covariance,
        np.asarray(point),
        np.asarray(axes.T @ covariance @ axes),
        np.asarray(pixel),
    )


def _target_at(face: Face, point: FloatArray) -> Target | None:
    for target in face.targets:
        low = target.plane_coordinates(target.corners).min(axis=0)
        high = target.plane_coordinates(target.corners).max(axis=0)
        at = target.plane_coordinates(point)
        if (at >= low).all() and (at <= high).all():
            return target
    return None


def _reading(
    found: FoundTarget, on_face: Sequence[PlacedSpot], seen: LookedAt, chosen: PhotographSettings
) -> TargetReading:
    name = found.target.name
    expected = chosen.expectations.get(name, Expectation())
    own = [s for s in on_face if s.target is not None and s.target.name == name]
    place = expected.place
    if place is not None and own:
        own.sort(key=lambda s: float(np.linalg.norm(s.plane - place)))
        others = sorted(own[1:], key=lambda s: -s.spot.power)
        own = [own[0], *others]
    reasons = judge(
        None if found.view is None else found,
        [s.spot for s in own],
        own[0].deviation if own else float("nan"),
        seen.background.seen,
        chosen.limits,
        expected,
        own[0].flux if own else float("nan"),
        seen.unexplained,
    )
    return TargetReading(found, tuple(own), tuple(reasons))
