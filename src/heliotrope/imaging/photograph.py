"""A photograph read: its targets, their spots in metres with covariance, and what is wrong."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np

from heliotrope.errors import InputError
from heliotrope.field.camera import Camera
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging import background as backgrounds
from heliotrope.imaging.background import Background, EmptyTarget
from heliotrope.imaging.finding import FoundTarget, Pictures, find_targets
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.quality import Expectation, Limits, Reason, judge
from heliotrope.imaging.rectify import Rectified, from_crop, rectify
from heliotrope.imaging.spot import Spot, find_spots
from heliotrope.imaging.view import Face, View

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController


@dataclass(frozen=True)
class PlacedSpot:
    """A spot and where it is.

    Attributes
    ----------
    spot
        Its shape, on its face.
    target
        On which its centroid lies; None beside all targets.
    plane
        Metres right of and above the target's centre (of the face's origin if there is no
        target), (2,).
    covariance
        Of ``plane``: spot, view and survey, m², (2, 2).
    point
        ENU metres, (3,).
    covariance_enu
        Of the point, m², (3, 3): nothing across the plane.
    pixel
        Where it is in the frame, (2,).
    """

    spot: Spot
    target: Target | None
    plane: FloatArray
    covariance: FloatArray
    point: FloatArray
    covariance_enu: FloatArray
    pixel: FloatArray

    @property
    def deviation(self) -> float:
        """Standard deviation along the worse axis, m."""
        return float(np.sqrt(max(float(np.linalg.eigvalsh(self.covariance)[-1]), 0.0)))


@dataclass(frozen=True)
class Reading:
    """One target of a photograph.

    Attributes
    ----------
    found
        The target in the frame.
    spots
        On it: the one that is meant first, then by power.
    reasons
        What speaks against the first; empty if it is good.
    """

    found: FoundTarget
    spots: tuple[PlacedSpot, ...] = ()
    reasons: tuple[Reason, ...] = ()

    @property
    def good(self) -> bool:
        """Whether the first spot may be believed."""
        return bool(self.spots) and not self.reasons


@dataclass(frozen=True)
class LookedAt:
    """A face and what was seen on it: for pictures, and to learn the empty target from.

    Attributes
    ----------
    picture
        The face on a grid of metres.
    background
        Without its beams.
    """

    picture: Rectified
    background: Background


@dataclass(frozen=True)
class Photograph:
    """What a photograph shows.

    Attributes
    ----------
    frame
        Itself.
    readings
        For each target that was looked for.
    beside
        Spots on a found face, but on none of its targets.
    faces
        Each face that was found.
    """

    frame: Frame
    readings: tuple[Reading, ...]
    beside: tuple[PlacedSpot, ...] = ()
    faces: tuple[LookedAt, ...] = ()

    def reading(self, target: str) -> Reading:
        """Return the reading of a target by name.

        Raises
        ------
        InputError
            If it was not looked for.
        """
        for reading in self.readings:
            if reading.found.target.name == target:
                return reading
        raise InputError(f"target {target}: it was not looked for in {self.frame.name}")

    @property
    def views(self) -> tuple[View, ...]:
        """How the faces lie in the frame: where to look in the next one."""
        return tuple(f.picture.view for f in self.faces if f.picture.view is not None)


@dataclass(frozen=True)
class Settings:
    """How photographs are read.

    Attributes
    ----------
    limits
        Of quality.
    background
        "frame", "model" (with ``empty``) or "difference" (with an empty frame); "auto"
        takes the best of what is there.
    empty
        Models of the empty face by the name of one of its targets.
    expectations
        By target.
    pictures
        Of taught marks, by their code.
    """

    limits: Limits = field(default_factory=Limits)
    background: Literal["auto", "frame", "model", "difference"] = "auto"
    empty: Mapping[str, EmptyTarget] = field(default_factory=dict)
    expectations: Mapping[str, Expectation] = field(default_factory=dict)
    pictures: Pictures = field(default_factory=dict)


def read_photograph(
    frame: Frame,
    targets: Sequence[Target],
    camera: Camera | None = None,
    *,
    settings: Settings | None = None,
    previous: Sequence[View] = (),
    without: Frame | None = None,
) -> Photograph:
    """Return where the beams of a photograph stand on its targets.

    Parameters
    ----------
    frame
        The photograph.
    targets
        That may be in it.
    camera
        What is known of it.
    settings
        How to read.
    previous
        Views of an earlier photograph of the same camera: it need not be searched then.
    without
        The same camera's frame without the beam.
    """
    with _one_thread().limit(limits=1, user_api="blas"):
        return _read(frame, targets, camera, settings or Settings(), previous, without)


@lru_cache(maxsize=1)
def _one_thread() -> "ThreadpoolController":
    """Matrices of a photograph are small: threads would wait longer than they work."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def _read(
    frame: Frame, targets: Sequence[Target], camera: Camera | None, chosen: Settings,
    previous: Sequence[View], without: Frame | None,
) -> Photograph:  # fmt: skip
    found = find_targets(frame, targets, camera, previous, chosen.pictures)
    readings = {f.target.name: Reading(f, (), (_missing(f),)) for f in found if not f.found}
    beside: list[PlacedSpot] = []
    faces: list[LookedAt] = []
    grey = np.ascontiguousarray(frame.grey)
    for view in _views(found):
        picture = rectify(frame, view, grey)
        empty = None
        if without is not None:
            empty = _empty_picture(without, view, camera, chosen)
        seen, on_face = _read_face(picture, chosen, empty)
        faces.append(seen)
        own = [f for f in found if f.view is view]
        for result in own:
            readings[result.target.name] = _reading(result, on_face, seen, chosen)
        beside += [s for s in on_face if s.target is None]
    ordered = tuple(readings[t.name] for t in targets)
    return Photograph(frame, ordered, tuple(beside), tuple(faces))


def read_crop(frame: Frame, target: Target, settings: Settings | None = None) -> Photograph:
    """Return where the beam stands in a picture of exactly one target.

    Parameters
    ----------
    frame
        Its corners are the target's; its size is free.
    target
        What it shows.
    settings
        How to read.
    """
    chosen = settings or Settings()
    picture = from_crop(frame, target)
    with _one_thread().limit(limits=1, user_api="blas"):
        seen, spots = _read_face(picture, chosen, None)
    found = FoundTarget(target, True, "")
    return Photograph(
        frame, (_reading(found, spots, seen, chosen),),
        tuple(s for s in spots if s.target is None), (seen,),
    )  # fmt: skip


def _missing(found: FoundTarget) -> Reason:
    return Reason("target not found", float("nan"), float("nan"), found.reason)


def _views(found: Sequence[FoundTarget]) -> list[View]:
    views: list[View] = []
    for result in found:
        if result.view is not None and not any(result.view is v for v in views):
            views.append(result.view)
    return views


def _empty_picture(
    without: Frame, view: View, camera: Camera | None, chosen: Settings
) -> Rectified:
    """The face in the frame without the beam, found there anew: the camera may have moved."""
    again = find_targets(without, list(view.face.targets), camera, [view], chosen.pictures)
    known = next((f.view for f in again if f.view is not None), None)
    if known is None:
        raise InputError(
            f"{without.name or 'the frame without the beam'}: {again[0].reason}; give an empty "
            "frame of the same camera"
        )
    return rectify(without, known)


def _read_face(
    picture: Rectified, chosen: Settings, empty: Rectified | None
) -> tuple[LookedAt, list[PlacedSpot]]:
    background = _background(picture, chosen, empty)
    spots = [_placed(picture, spot) for spot in find_spots(picture, background)]
    return LookedAt(picture, background), spots


def _background(picture: Rectified, chosen: Settings, empty: Rectified | None) -> Background:
    way = chosen.background
    names = [t.name for t in picture.face.targets]
    model = next((chosen.empty[n] for n in names if n in chosen.empty), None)
    if way == "auto":
        way = "difference" if empty is not None else "model" if model is not None else "frame"
    if way == "difference":
        if empty is None:
            raise InputError("background by difference: give a frame without the beam as well")
        return backgrounds.from_difference(picture, empty)
    if way == "model":
        if model is None:
            raise InputError(
                f"background by model: none is known of target {names[0]}; learn one from empty "
                "frames, or use the frame alone"
            )
        return backgrounds.from_model(picture, model)
    return backgrounds.from_frame(picture)


def _placed(picture: Rectified, spot: Spot) -> PlacedSpot:
    """Put a spot on the target that it is on, with the covariance of the view added."""
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
        spot, target, np.asarray(plane), covariance, np.asarray(point),
        np.asarray(axes.T @ covariance @ axes), np.asarray(pixel),
    )  # fmt: skip


def _target_at(face: Face, point: FloatArray) -> Target | None:
    for target in face.targets:
        low = target.plane_coordinates(target.corners).min(axis=0)
        high = target.plane_coordinates(target.corners).max(axis=0)
        at = target.plane_coordinates(point)
        if (at >= low).all() and (at <= high).all():
            return target
    return None


def _reading(
    found: FoundTarget, on_face: Sequence[PlacedSpot], seen: LookedAt, chosen: Settings
) -> Reading:
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
    )
    return Reading(found, tuple(own), tuple(reasons))
