"""Find targets in a raw frame by their marks, and report where, how well, or why not.

The search for one face makes attempts (`attempt.py`) one after the other, the quick ones first,
until a view is good enough.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from heliotrope.field.camera import Camera, project
from heliotrope.field.marks import Mark
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.targets import constellation, detection
from heliotrope.imaging.targets.attempt import (
    FEWEST,
    Attempt,
    FrameSearch,
    Pictures,
    Search,
    face_marks,
    one_mark,
)
from heliotrope.imaging.targets.view import Face, FaceView, faces

#: If at least this fraction of the expected marks is found, no other search method is tried.
_ENOUGH = 0.7
#: Outlines are darker than these fractions of their surroundings.
_RATIOS = (0.72, 0.85)
#: Longer side of the reduced frame that is searched for outlines first, px.
_LONGER = 700
#: Of two faces in the same place in the frame, one is preferred if this much more of it was seen.
_CLEARER = 0.2
#: How a frame may be rotated or mirrored relative to its camera, as maps of pixels about the
#: frame's middle.
_TURNS = {
    "turned by 180°": ((-1, 0), (0, -1)),
    "mirrored left to right": ((-1, 0), (0, 1)),
    "mirrored top to bottom": ((1, 0), (0, -1)),
    "turned by 90° clockwise": ((0, -1), (1, 0)),
    "turned by 90° counterclockwise": ((0, 1), (-1, 0)),
    "mirrored about its falling diagonal": ((0, 1), (1, 0)),
    "mirrored about its rising diagonal": ((0, -1), (-1, 0)),
}
#: Such a map fits if marks are this close, px, or within this many standard deviations of the pose,
#: and this many times closer than without the map.
_TURN_PIXELS, _TURN_SIGMAS, _TURN_CLEARER = 2.0, 3.0, 3.0


@dataclass(frozen=True)
class FoundMark:
    """One mark of a target in a frame.

    Attributes
    ----------
    mark
        The mark.
    pixel
        Position where the mark was seen or, if it was not seen, where it should be, (2,).
    covariance
        Covariance of the position, px², (2, 2); NaN if the mark was not seen.
    used
        Whether the mark was used to fit the view.
    reason
        Why the mark was not used; an empty string if it was used.
    contrast
        Brightness of the mark relative to its surroundings; NaN for a tag.
    blur
        Blur of the mark's vertical and horizontal edges, m, (2,); NaN for a tag.
    """

    mark: Mark
    pixel: FloatArray
    covariance: FloatArray
    used: bool
    reason: str = ""
    contrast: float = float("nan")
    blur: FloatArray = field(default_factory=lambda: np.full(2, np.nan))


@dataclass(frozen=True)
class FoundTarget:
    """A target in a frame.

    Attributes
    ----------
    target
        The target.
    found
        Whether it was found.
    reason
        Why the target was not found; an empty string if it was found.
    marks
        Marks of the target that were searched for.
    view
        How the target's face lies in the frame; None if the target was not found.
    """

    target: Target
    found: bool
    reason: str
    marks: tuple[FoundMark, ...] = ()
    view: FaceView | None = None


def find_targets(
    frame: Frame,
    targets: Sequence[Target],
    camera: Camera | None = None,
    previous: Sequence[FaceView] = (),
    pictures: Pictures | None = None,
) -> list[FoundTarget]:
    """Return where each target is in a frame, or why the target was not found.

    Parameters
    ----------
    frame
        The frame as delivered by the camera.
    targets
        Targets with known marks. Targets in one plane are found together.
    camera
        Camera whose lens is used. If its pose is known too, marks are first searched for at their
        expected positions, and a target that agrees with the pose only in a rotated or mirrored
        frame is rejected. The lens of a camera with a different frame size is ignored.
    previous
        Views from earlier frames by the same camera, which are tried first.
    pictures
        Reference pictures of user-defined marks, keyed by the code of the mark.

    Notes
    -----
    If the marks look the same after rotating the target by 90° or 180°, they cannot distinguish a
    rotated camera from an upright one. Without a pose or an earlier view, the solution closer to
    upright is taken.
    """
    look = FrameSearch(frame, camera, pictures or {})
    searches = []
    for face in faces(tuple(targets)):
        marks, plane = face_marks(face)
        searches.append(_Face(Search(look, face, marks, plane), _earlier(face, previous, look)))
    # A camera that sees one face upright cannot be rotated for another face.
    for turned in (False, True):
        for search in searches:
            search.look(turned)
        if any(search.best is not None and search.best.view is not None for search in searches):
            break
    _one_place_each(searches)
    if camera is not None and camera.position is not None:
        for search in searches:
            search.compare(camera)
    results = {r.target.name: r for search in searches for r in search.results()}
    return [results[target.name] for target in targets]


def _earlier(face: Face, previous: Sequence[FaceView], look: FrameSearch) -> FaceView | None:
    for view in previous:
        if _same(view.face, face) and view.lens.size == look.size:
            return view
    return None


def _same(a: Face, b: Face) -> bool:
    return {t.name for t in a.targets} == {t.name for t in b.targets}


class _Face:
    """The search for one face."""

    def __init__(self, search: Search, previous: FaceView | None) -> None:
        self.search, self.previous = search, previous
        self.best: Attempt | None = None
        #: Number of shapes that look like one of the face's marks.
        self.shapes = 0
        self.text = ""

    def look(self, turned: bool) -> None:
        """Make one attempt after another until the face is found."""
        if not self._known_enough():
            return
        for attempt in self._turned() if turned else self._upright():
            if self.best is None or _rank(attempt) > _rank(self.best):
                self.best = attempt
            if self.best.view is not None:
                expected = len(self.search.expected(self.best.view))
                if self.best.known or len(self.best.used) >= _ENOUGH * expected:
                    break

    def _known_enough(self) -> bool:
        marks = self.search.marks
        tags = sum(mark.kind == "tag" for mark in marks)
        if len(marks) + 3 * tags >= FEWEST:
            return True
        self.text = (
            f"it has {len(marks)} known marks; three or more are needed (heliotrope camera teach)"
        )
        return False

    def _upright(self) -> Iterator[Attempt]:
        """Yield the quick attempts one by one."""
        search, camera = self.search, self.search.look.camera
        if self.previous is not None:
            pixels, scales = (
                self.previous.to_pixels(search.plane),
                self.previous.scale(search.plane),
            )
            yield search.attempt(pixels, scales, 0.5, known=True)
        if camera is not None and camera.position is not None:
            expected = self._projected(camera)
            if expected is not None:
                yield search.attempt(*expected, 0.5, known=True)
        yield from self._tags()
        base = self._base()
        for ratio in _RATIOS:
            yield from self._outlined(base, ratio, upright=True)

    def _turned(self) -> Iterator[Attempt]:
        """Yield the thorough attempts."""
        base = self._base()
        for reduction in dict.fromkeys((base, max(1, base // 2), 2 * base, 4 * base)):
            for ratio in _RATIOS:
                yield from self._outlined(reduction, ratio, upright=False)
        yield from self._pictured()

    def _base(self) -> int:
        return max(1, round(max(self.search.look.size) / _LONGER))

    def _projected(self, camera: Camera) -> tuple[FloatArray, FloatArray] | None:
        """Return the marks' pixels and scales from the camera pose; None if not visible."""
        face, plane = self.search.face, self.search.plane
        towards = np.asarray(camera.position) - face.origin
        if float(towards @ np.cross(*face.axes)) <= 0.0:
            return None
        pixels = project(camera, face.point(plane))
        steps = [project(camera, face.point(plane + 0.01 * e)) - pixels for e in np.eye(2)]
        scales = np.stack(steps, axis=-1) / 0.01
        return (pixels, scales) if np.isfinite(scales).all() else None

    def _up(self) -> FloatArray:
        """Return the expected upward direction of the face in the frame, (2,)."""
        camera = self.search.look.camera
        scale = np.diag([1.0, -1.0])[None]
        if self.previous is not None:
            scale = self.previous.scale(self.search.plane)
        elif camera is not None and camera.position is not None:
            expected = self._projected(camera)
            scale = scale if expected is None else expected[1]
        up = scale.mean(axis=0)[:, 1]
        return np.asarray(up / max(float(np.linalg.norm(up)), 1e-12))

    def _tags(self) -> Iterator[Attempt]:
        """Yield an attempt based on tags that were recognised by their code."""
        search = self.search
        if not search.tags:
            return
        yield self._mapped(search.tag_map(), 0.4)

    def _mapped(self, H: FloatArray, reach: float) -> Attempt:
        search = self.search
        pixels, scales = (
            constellation.mapped(H, search.plane),
            constellation.scales(H, search.plane),
        )
        attempt = search.attempt(pixels, scales, reach)
        if attempt.view is None:
            return attempt
        settled = self._settled(attempt, attempt.view)
        text = "" if settled.view is None else self._elsewhere(settled, settled.view)
        return replace(settled, view=None, text=text) if text else settled

    def _elsewhere(self, attempt: Attempt, view: FaceView) -> str:
        """Return the reason why the view may show a different target; empty if it cannot."""
        search = self.search
        marks, plane, targets = search.marks, search.plane, search.face.targets
        near = 0.05 * search.extent
        centers = search.face.plane(np.array([t.center for t in targets]))
        unseen = len(search.expected(view)) - len(attempt.used)
        for a in range(len(targets)):
            for b in range(len(targets)):
                shift = centers[b] - centers[a]
                apart = np.linalg.norm(plane[:, None] + shift - plane[None], axis=-1)
                other = np.argmin(apart, axis=1)
                if a == b or not all(
                    apart[k, other[k]] < near and _alike(marks[k], marks[other[k]], 0.0)
                    for k in attempt.used
                ):
                    continue
                # Marks missing from their positions are evidence against the other target.
                missing = len(search.within(view.to_pixels(plane - shift))) - len(attempt.used)
                if missing <= unseen + 1:
                    names = f"{targets[a].name} or {targets[b].name}"
                    return f"this may be {names}; specify which targets the camera sees"
        return ""

    def _settled(self, attempt: Attempt, view: FaceView) -> Attempt:
        """Return the attempt with the most marks; of similar rotations, the most upright one."""
        search, up = self.search, self._up()
        middle = search.plane.mean(axis=0)
        scale = view.scale(middle)

        def lean(turn: FloatArray) -> float:
            upward = scale @ turn[:, 1]
            return -float(upward @ up) / float(np.linalg.norm(upward))

        best, least = attempt, lean(np.eye(2))
        whole = len(attempt.used) == len(search.expected(view))
        for turn, share in symmetries(search.marks, search.plane):
            # If all marks look as they should, a rotation in which marks look different is
            # excluded.
            more_upright = lean(turn) < least - 0.01
            if whole if share < 1.0 else not more_upright:
                continue
            places = middle + (search.plane - middle) @ turn.T
            other = search.attempt(view.to_pixels(places), view.scale(places) @ turn, 0.3)
            more = len(other.used) - len(best.used)
            if other.view is not None and (more > 0 or (more == 0 and more_upright)):
                best, least = other, lean(turn)
        return best

    def _outlined(self, reduction: int, ratio: float, upright: bool) -> Iterator[Attempt]:
        """Yield an attempt based on dark shapes that look like marks and are arranged like them."""
        search = self.search
        kept = [k for k, m in enumerate(search.marks) if m.kind not in ("tag", "picture")]
        if len(kept) < FEWEST:
            return
        drawn, which = detection.drawings([search.marks[k] for k in kept])
        candidates = detection.candidates(search.look.outlines(reduction, ratio), drawn)
        yield from self._matched(candidates, kept, drawn, which, upright)

    def _pictured(self) -> Iterator[Attempt]:
        """Yield an attempt based on reference pictures anywhere in an upright frame."""
        search = self.search
        kept = [k for k, m in enumerate(search.marks) if m.kind == "picture"]
        if len(kept) < FEWEST:
            return
        marks = [search.marks[k] for k in kept]
        candidates = detection.find_pictures(search.look.eight, marks, search.look.pictures)
        yield from self._matched(
            candidates, kept, detection.picture_drawings(marks), np.arange(len(kept)), True
        )

    def _matched(
        self,
        candidates: detection.Candidates,
        kept: list[int],
        drawn: list[detection.Drawing],
        which: constellation.Places,
        upright: bool,
    ) -> Iterator[Attempt]:
        search = self.search
        self.shapes = max(self.shapes, len(candidates.middle))
        marks = constellation.constellation(
            [search.marks[k] for k in kept], drawn, which, search.plane[kept]
        )
        matched = constellation.match(candidates, marks, self._up(), upright)
        if matched is not None:
            yield self._mapped(matched.H_pixel_plane, 0.4)

    def compare(self, camera: Camera) -> None:
        """Reject a view that agrees with the camera pose only in a rotated or mirrored frame."""
        if self.best is None or self.best.view is None:
            return
        search = self.search
        pixels = self.best.view.to_pixels(search.plane)
        turn = turn_of(
            pixels, project(camera, search.face.point(search.plane)), camera, search.look
        )
        if turn:
            text = (
                f"the frame is {turn} against the pose of camera {camera.name}; correct this in "
                "the camera or in the program that stores its frames (if the camera itself was "
                "rotated: delete its position_m and rotation from the plant file and calibrate "
                "it again)"
            )
            self.best = replace(self.best, view=None, text=text)

    def results(self) -> list[FoundTarget]:
        """Return the result for each target of the face."""
        search, best = self.search, self.best
        targets = search.face.targets
        if best is None:
            total = len(search.marks)
            text = self.text or (
                f"none of its {total} marks was seen: outside the frame, or covered"
                if self.shapes == 0
                else (
                    f"its {total} marks were not found in the right arrangement; {self.shapes} "
                    "shapes in the frame look like one of them"
                )
            )
            return [FoundTarget(t, False, text) for t in targets]
        results = []
        for target in targets:
            text = best.text or best.vague.get(target.name, "")
            view = None if text else best.view
            own = tuple(
                _found_mark(search, best, k)
                for k, mark in enumerate(search.marks)
                if any(one_mark(mark, m) for m in target.marks)
            )
            results.append(FoundTarget(target, view is not None, text, own, view))
        return results


def _rank(attempt: Attempt) -> tuple[bool, int]:
    return attempt.view is not None, len(attempt.used)


def turn_of(observed: FloatArray, expected: FloatArray, camera: Camera, look: FrameSearch) -> str:
    """Return how the frame is turned, as the observed marks show; empty if it is not turned.

    Marks are compared as sets, because in a turned frame a mark may look like a different mark.

    Parameters
    ----------
    observed, expected
        Pixels of marks as observed in the frame, and as expected from the camera pose, (M, 2).
    camera, look
        The camera, and the search in the frame.
    """
    if not np.isfinite(expected).all():
        return ""
    near = max(_TURN_PIXELS, _TURN_SIGMAS * camera.deviation)
    middle, frame = 0.5 * (np.array(camera.size) - 1.0), 0.5 * (np.array(look.size) - 1.0)

    def apart(turn: npt.ArrayLike) -> float:
        if tuple(np.abs(np.array(turn) @ camera.size)) != look.size:
            return np.inf
        places = frame + (expected - middle) @ np.array(turn).T
        gaps = np.linalg.norm(observed[:, None] - places[None], axis=-1)
        return float(np.sqrt(np.mean(gaps.min(axis=1) ** 2)))

    unturned = apart(np.eye(2, dtype=int))
    best = min(_TURNS, key=lambda name: apart(_TURNS[name]))
    least = apart(_TURNS[best])
    fits = least < near < unturned and _TURN_CLEARER * least < unturned
    return best if fits else ""


def symmetries(marks: Sequence[Mark], plane: FloatArray) -> list[tuple[FloatArray, float]]:
    """Return quarter turns (2, 2) about the centre that map marks onto positions of marks.

    Each rotation is returned with the fraction of marks that then also look the same, which is at
    least half.

    Parameters
    ----------
    marks
        Marks of a face, M.
    plane
        Positions of the marks, m, (M, 2).
    """
    shares = []
    for quarter, (cos, sin) in enumerate(((0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)), start=1):
        turn = np.array([[cos, -sin], [sin, cos]])
        turns = [mark.turn + 0.5 * np.pi * quarter for mark in marks]
        share = _share_alike(marks, plane, turn, turns)
        if share >= 0.5:
            shares.append((turn, share))
    return shares


def without_orientation(targets: Sequence[Target]) -> tuple[str, ...]:
    """Return the names of targets whose marks look the same in a turned or mirrored frame."""
    names: list[str] = []
    for face in faces(tuple(targets)):
        marks, plane = face_marks(face)
        alike = marks and (
            any(share == 1.0 for _, share in symmetries(marks, plane))
            or any(_is_mirrored_alike(marks, plane, axis) for axis in (0, 1))
        )
        names += [target.name for target in face.targets] if alike else []
    return tuple(names)


def _is_mirrored_alike(marks: Sequence[Mark], plane: FloatArray, axis: int) -> bool:
    """Return whether marks look the same with left and right (0) or top and bottom (1) swapped.

    A drawing has an axis of its own, which points down to the right for a corner and down for a T.
    """
    mirror = np.diag([-1.0, 1.0] if axis == 0 else [1.0, -1.0])
    about = np.pi if axis == 0 else 0.0
    own = {"corner": -0.25 * np.pi, "tee": -0.5 * np.pi}
    turns = [about - 2.0 * own.get(mark.kind, 0.0) - mark.turn for mark in marks]
    return _share_alike(marks, plane, mirror, turns) == 1.0


def _share_alike(
    marks: Sequence[Mark], plane: FloatArray, moved: FloatArray, turns: Sequence[float]
) -> float:
    """Return the fraction of marks that look like another mark after a map about the centre.

    Parameters
    ----------
    marks, plane
        As for `symmetries`.
    moved
        The map, (2, 2).
    turns
        Rotation of each mark after the map, rad.
    """
    middle = plane.mean(axis=0)
    extent = float(np.ptp(plane, axis=0).max())
    places = middle + (plane - middle) @ moved.T
    apart = np.linalg.norm(places[:, None] - plane[None], axis=-1)
    other = np.argmin(apart, axis=1)
    near = apart[np.arange(len(marks)), other] < 0.05 * extent
    same = [
        bool(near[k]) and _alike(mark, marks[j], turns[k])
        for k, (mark, j) in enumerate(zip(marks, other, strict=True))
    ]
    return float(np.mean(same))


def _alike(a: Mark, b: Mark, turn: float) -> bool:
    """Return whether a mark, rotated by ``turn`` rad, looks like another mark."""
    if a.kind in ("tag", "picture") or (a.kind, a.size, a.stroke) != (b.kind, b.size, b.stroke):
        return False
    if a.kind == "disc":
        return True
    period = 0.5 * np.pi if a.kind == "square" else 2.0 * np.pi
    rest = (turn - b.turn) / period
    return bool(abs(rest - np.round(rest)) * period < 0.1)


def _one_place_each(searches: Sequence[_Face]) -> None:
    """Reject at least one of two faces that are in the same place in the frame."""
    for k, first in enumerate(searches):
        for second in searches[k + 1 :]:
            a, b = first.best, second.best
            if a is None or b is None or a.view is None or b.view is None:
                continue
            if not (_covers(a.view, b.view) or _covers(b.view, a.view)):
                continue
            clear = _share(first, a) - _share(second, b)
            if a.known != b.known:
                clear = 1.0 if a.known else -1.0
            names = [face.search.face.targets[0].name for face in (first, second)]
            lost = [f"the frame shows {name} there" for name in reversed(names)]
            if abs(clear) < _CLEARER:
                lost = [
                    f"the frame may show {name} there; specify which targets the camera sees"
                    for name in reversed(names)
                ]
            if clear < _CLEARER:
                first.best = replace(a, view=None, text=lost[0])
            if clear > -_CLEARER:
                second.best = replace(b, view=None, text=lost[1])


def _share(face: _Face, attempt: Attempt) -> float:
    return len(attempt.used) / len(face.search.marks)


def _covers(a: FaceView, b: FaceView) -> bool:
    """Return whether the middle of face b appears on face a."""
    place = a.to_plane(b.to_pixels(b.face.span.mean(axis=0)))
    low, high = a.face.span
    return bool(((place > low) & (place < high)).all())


def _found_mark(search: Search, best: Attempt, k: int) -> FoundMark:
    if k in best.observed:
        pixel, covariance = best.observed[k]
    else:
        pixel = np.full(2, np.nan) if best.view is None else best.view.to_pixels(search.plane[k])
        covariance = np.full((2, 2), np.nan)
    used = best.view is not None and k in best.used
    look = best.looks.get(k)
    mark = FoundMark(search.marks[k], pixel, covariance, used, best.reasons.get(k, ""))
    if look is None or search.marks[k].kind == "tag":
        return mark
    return replace(mark, contrast=look.contrast, blur=look.blur)
