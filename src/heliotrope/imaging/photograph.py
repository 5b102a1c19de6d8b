"""Evaluate a photograph: its targets, their spots in metres with covariance, and defects."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from heliotrope.errors import InputError
from heliotrope.field.camera import Camera
from heliotrope.field.target import Target
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.spots import background as backgrounds
from heliotrope.imaging.spots.background import Background, EmptyTarget, Method
from heliotrope.imaging.spots.centroid import Centroid, with_centroid
from heliotrope.imaging.spots.placed import PlacedSpot, place
from heliotrope.imaging.spots.quality import Expectation, Limits, Reason, judge
from heliotrope.imaging.spots.spot import find_spots
from heliotrope.imaging.targets.attempt import Pictures
from heliotrope.imaging.targets.finding import FoundTarget, find_targets
from heliotrope.imaging.targets.rectify import LEAST_RIM, Rectified, from_crop, rectify, rim_of
from heliotrope.imaging.targets.view import FaceView

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController


@dataclass(frozen=True)
class TargetReading:
    """One target of a photograph.

    Attributes
    ----------
    found
        The target in the frame.
    spots
        Spots on the target: the intended spot first, then by power.
    reasons
        Reasons why the first spot is not valid; empty if it is valid.
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
    """A face and its background, used for pictures and for learning the empty target.

    Attributes
    ----------
    picture
        The face on a grid of metres.
    background
        The face without beams.
    unexplained
        Fraction of the face's paint beside the spots that is brighter or darker than the
        background.
    """

    picture: Rectified
    background: Background
    unexplained: float = 0.0


@dataclass(frozen=True)
class Photograph:
    """The result of evaluating a photograph.

    Attributes
    ----------
    frame
        The photograph.
    readings
        One reading per target that was searched for.
    beside
        Spots on a face that was found, but on none of its targets.
    faces
        The faces that were found.
    """

    frame: Frame
    readings: tuple[TargetReading, ...]
    beside: tuple[PlacedSpot, ...] = ()
    faces: tuple[LookedAt, ...] = ()

    def reading(self, target: str) -> TargetReading:
        """Return the reading of a target, given by name.

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
        """How the faces lie in the frame, which is where the search in the next frame starts."""
        return tuple(f.picture.view for f in self.faces if f.picture.view is not None)


@dataclass(frozen=True)
class PhotographSettings:
    """How photographs are evaluated.

    Attributes
    ----------
    limits
        Tolerances for the spot quality.
    background
        "frame", "model" (with ``empty``) or "difference" (with an empty frame); "auto" uses the
        best available method.
    empty
        Models of empty faces, under any names; the model of a face is selected by its targets.
    expectations
        Expected beams, keyed by target.
    pictures
        Reference pictures of user-defined marks, keyed by the code of the mark.
    gamma
        Exponent of the camera response: a pixel is light to the power 1/gamma. 1 is linear, 2.2 is
        close to sRGB. The response is inverted before anything is measured.
    centroid
        User-defined function that returns the position and covariance of the first spot on each
        target and replaces the built-in one; see `heliotrope.imaging.spots.BeamPicture`. If
        photographs are evaluated in several processes, it must be defined in a module that these
        processes can import.
    """

    limits: Limits = field(default_factory=Limits)
    background: Method = "auto"
    empty: Mapping[str, EmptyTarget] = field(default_factory=dict)
    expectations: Mapping[str, Expectation] = field(default_factory=dict)
    pictures: Pictures = field(default_factory=dict)
    gamma: float = 1.0
    centroid: Centroid | None = None


def read_photograph(
    frame: Frame,
    targets: Sequence[Target],
    camera: Camera | None = None,
    *,
    settings: PhotographSettings | None = None,
    previous: Sequence[FaceView] = (),
    without: Frame | None = None,
) -> Photograph:
    """Find the targets in a photograph and the beams on them.

    Parameters
    ----------
    frame
        The photograph.
    targets
        Targets that may be in view.
    camera
        The camera, as far as it is known.
    settings
        Evaluation settings.
    previous
        Views from an earlier photograph by the same camera, which save the search.
    without
        A frame from the same camera without the beam.
    """
    with _one_thread().limit(limits=1, user_api="blas"):
        return _read(frame, targets, camera, settings or PhotographSettings(), previous, without)


@lru_cache(maxsize=1)
def _one_thread() -> "ThreadpoolController":
    """Return the BLAS thread controller; the matrices here are too small for threads."""
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
    original, frame = frame, frame.linear(chosen.gamma)
    results = find_targets(frame, targets, camera, previous, chosen.pictures)
    readings = {f.target.name: TargetReading(f, (), (_missing(f),)) for f in results if not f.found}
    beside: list[PlacedSpot] = []
    faces: list[LookedAt] = []
    grey = np.ascontiguousarray(frame.grey)
    dark = None if without is None else without.linear(chosen.gamma)
    for view, own in _by_view(results):
        picture = rectify(frame, view, grey, rim=rim_of(own))
        empty = None if dark is None else _empty_picture(dark, view, camera, chosen, rim_of(own))
        face, on_face = _read_face(picture, chosen, empty, frame.exposure * frame.gain)
        faces.append(face)
        for result in own:
            readings[result.target.name] = _reading(result, on_face, face, chosen)
        beside += [s for s in on_face if s.target is None]
    ordered = tuple(readings[t.name] for t in targets)
    return Photograph(original, ordered, tuple(beside), tuple(faces))


def read_crop(
    frame: Frame, target: Target, settings: PhotographSettings | None = None
) -> Photograph:
    """Find the beam in a picture that shows exactly one target.

    Parameters
    ----------
    frame
        Picture whose corners are those of the target, of any size.
    target
        The target that the picture shows.
    settings
        Evaluation settings.
    """
    chosen = settings or PhotographSettings()
    picture = from_crop(frame.linear(chosen.gamma), target, rim=LEAST_RIM)
    with _one_thread().limit(limits=1, user_api="blas"):
        face, spots = _read_face(picture, chosen, None, frame.exposure * frame.gain)
    result = FoundTarget(target, True, "")
    return Photograph(
        frame,
        (_reading(result, spots, face, chosen),),
        tuple(s for s in spots if s.target is None),
        (face,),
    )


def _missing(result: FoundTarget) -> Reason:
    return Reason("target not found", float("nan"), float("nan"), result.reason)


def _by_view(results: Sequence[FoundTarget]) -> list[tuple[FaceView, list[FoundTarget]]]:
    """Return each view of a face with its targets."""
    views = {id(f.view): f.view for f in results if f.view is not None}
    return [(view, [f for f in results if f.view is view]) for view in views.values()]


def _empty_picture(
    without: Frame, view: FaceView, camera: Camera | None, chosen: PhotographSettings, rim: int
) -> Rectified:
    """Return the face in the frame without the beam, located anew if the camera moved."""
    again = find_targets(without, list(view.face.targets), camera, [view], chosen.pictures)
    known = next((f.view for f in again if f.view is not None), None)
    if known is None:
        raise InputError(
            f"{without.name or 'the frame without the beam'}: {again[0].reason}; use an empty "
            "frame from the same camera"
        )
    return rectify(without, known, rim=rim)


def _read_face(
    picture: Rectified, chosen: PhotographSettings, empty: Rectified | None, gathered: float
) -> tuple[LookedAt, list[PlacedSpot]]:
    """Evaluate one face; ``gathered`` is exposure times gain, s."""
    background = backgrounds.of_face(picture, chosen.background, chosen.empty.values(), empty)
    spots = [place(picture, spot, gathered) for spot in find_spots(picture, background)]
    odd = backgrounds.unexplained(picture, background, [s.spot.region for s in spots])
    return LookedAt(picture, background, odd), spots


def _reading(
    result: FoundTarget, on_face: Sequence[PlacedSpot], face: LookedAt, chosen: PhotographSettings
) -> TargetReading:
    name = result.target.name
    expected = chosen.expectations.get(name, Expectation())
    own = [s for s in on_face if s.target is not None and s.target.name == name]
    place = expected.place
    if place is not None and own:
        own.sort(key=lambda s: float(np.linalg.norm(s.plane - place)))
        others = sorted(own[1:], key=lambda s: -s.spot.power)
        own = [own[0], *others]
    if own and chosen.centroid is not None:
        own[0] = with_centroid(
            own[0], result.target, face.picture, face.background, chosen.centroid
        )
    reasons = judge(
        None if result.view is None else result,
        [s.spot for s in own],
        own[0].deviation if own else float("nan"),
        face.background.seen,
        chosen.limits,
        expected,
        own[0].flux if own else float("nan"),
        face.unexplained,
    )
    return TargetReading(result, tuple(own), tuple(reasons))
