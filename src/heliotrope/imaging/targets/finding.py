"""Find targets in a raw frame by their marks: where, how well, or why not.

A search for one face makes attempts. An attempt looks for every mark near given places, fits a
view, and judges it. Attempts follow each other, the quick ones first, until a view is good enough.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from heliotrope.field.camera import Camera, project
from heliotrope.field.marks import Mark
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Frame, Image
from heliotrope.imaging.targets import constellation, detection
from heliotrope.imaging.targets.refinement import Refined, locate, refine
from heliotrope.imaging.targets.view import (
    Face,
    FaceView,
    faces,
    fit_view,
    homography,
    unknown_lens,
)

Pictures = Mapping[str, FloatArray]

#: Standard deviation of a mark's place on its target, by survey and paint, m.
SURVEY = 0.005
#: Standard deviation of a tag's corners relative to each other, m.
PRINT = 0.001
#: Least correlation of a mark; least share of the variance that its drawing explains (without and
#: with a code that was read); greatest brightness over its surroundings.
LIKE, EXPLAINED, EXPLAINED_READ, CONTRAST = 0.45, 0.65, 0.3, 0.93
#: A mark this many standard deviations from the place given by the others is not used.
STRAY = 5.0
#: Greatest distortion of one mark against its drawing, of the size of all marks, and of the marks
#: against each other. Measured: 0.03 in photographs, 0.2 in clutter.
MISSHAPEN, WRONG_SIZE, ALIKE = 0.2, 0.12, 0.08
#: Greatest common stretch or skew of all marks. Measured: 0.01.
ASKEW = 0.04
#: Limits for each mark where there are no more marks than unknowns of a view.
ALIKE_EACH, EXPLAINED_EACH = 0.12, 0.75
#: Greatest residual of a view: share of the face's extent, plus pixels.
MISFIT, MISFIT_PIXELS = 0.005, 1.0
#: Greatest standard deviation of a target's centre, as a share of its extent.
VAGUE = 0.005
#: Greatest distance of a target's centre from the middle of the marks seen, in their standard
#: deviations; beyond, lens and perspective are guesses.
FAR = 4.0
#: Least share of the paint between marks that is lighter than the nearest mark.
LIGHTER = 0.8
#: Least ratio of the scales of a face, and greatest ratio of the scales of its near and far side.
FLATTEST, NEAREST = 0.2, 3.0
#: Fewest points of a view, with and without prior knowledge of their places; least share of the
#: points in the frame, likewise.
FEWEST, ALONE, SHARE, SHARE_ALONE = 3, 4, 0.5, 0.7
#: Share of the expected marks from which on no other way of looking is tried.
_ENOUGH = 0.7
#: Outlines are darker than these fractions of their surroundings.
_RATIOS = (0.72, 0.85)
#: Longer side of the reduced frame that is searched for outlines first, px.
_LONGER = 700
#: Of two faces in one place of the frame, one wins if this much more of it was seen.
_CLEARER = 0.2


@dataclass(frozen=True)
class FoundMark:
    """One mark of a target in a frame.

    Attributes
    ----------
    mark
        The mark.
    pixel
        Where it was seen, (2,), or where it should be if it was not seen.
    covariance
        px², (2, 2); NaN if it was not seen.
    used
        Whether the view was fitted to it.
    reason
        Why it was not used; empty if it was.
    contrast
        Its brightness over that of its surroundings; NaN for a tag.
    blur
        Blur of its upright and level edges, m, (2,); NaN for a tag.
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
        Why it was not found; empty if it was.
    marks
        Its marks that were searched for.
    view
        How its face lies in the frame; None if it was not found.
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
    """Return where each target is in a frame, or why it was not found.

    Parameters
    ----------
    frame
        The frame as the camera gives it.
    targets
        Targets with known marks. Targets in one plane are found together.
    camera
        Its lens is used; if its pose is known too, marks are searched for at their expected
        places first. A camera of another frame size is ignored.
    previous
        Views of earlier frames of the same camera, tried first.
    pictures
        Pictures of taught marks, by their code.

    Notes
    -----
    If the marks look the same after a quarter or half a turn of the target, they cannot tell a
    turned camera from an upright one. Without a pose or an earlier view, the more upright
    solution is taken.
    """
    look = FrameSearch(frame, camera, pictures or {})
    searches = []
    for face in faces(tuple(targets)):
        marks, plane = face_marks(face)
        searches.append(_Face(Search(look, face, marks, plane), _earlier(face, previous, look)))
    # A camera that sees one face upright is not turned for another.
    for turned in (False, True):
        for each in searches:
            each.look(turned)
        if any(each.best is not None and each.best.view is not None for each in searches):
            break
    _one_place_each(searches)
    found = {r.target.name: r for each in searches for r in each.results()}
    return [found[target.name] for target in targets]


def face_marks(face: Face) -> tuple[list[Mark], FloatArray]:
    """Return each mark of a face once, and their places in its plane (M, 2), m."""
    kept: list[Mark] = []
    for target in face.targets:
        for mark in target.marks:
            # Adjacent targets share the marks of their common corners.
            if not any(_one(mark, m) for m in kept):
                kept.append(mark)
    return kept, face.plane(np.array([m.point for m in kept]).reshape(-1, 3))


def _one(a: Mark, b: Mark) -> bool:
    """Return whether marks of two targets are one mark on their common edge."""
    return a.kind == b.kind and float(np.linalg.norm(a.point - b.point)) < 0.05


# -- attempts --------------------------------------------------------------------------


class FrameSearch:
    """One frame, with intermediate results that all faces share."""

    def __init__(self, frame: Frame, camera: Camera | None, pictures: Pictures) -> None:
        self.grey = np.ascontiguousarray(frame.grey)
        self.size = frame.size
        self.pictures = pictures
        self.camera = camera if camera is not None and camera.size == frame.size else None
        self.lens = self.camera or unknown_lens(frame.size)
        self._light: dict[int, detection.Lightened] = {}
        self._outlines: dict[tuple[int, float], detection.DarkParts] = {}
        self._tags: dict[int, dict[tuple[int, int], list[FloatArray]]] = {}

    @cached_property
    def eight(self) -> Image:
        """The frame in 8 bits."""
        if self.grey.dtype == np.uint8:
            return self.grey
        # Sensors leave bits empty, and a beam outshines everything else: let the brightest
        # thousandth clip.
        top = max(float(np.percentile(self.grey[::4, ::4], 99.9)), 1.0)
        scaled = self.grey.astype(np.float32) * np.float32(255.0 / top)
        return np.asarray(np.minimum(scaled, 255.0), dtype=np.uint8)

    def outlines(self, reduction: int, ratio: float) -> detection.DarkParts:
        """Return the dark parts of the frame, computed once for all faces."""
        key = (reduction, ratio)
        if reduction not in self._light:
            self._light[reduction] = detection.lighten(self.grey, reduction)
        if key not in self._outlines:
            self._outlines[key] = detection.outlines(self._light[reduction], ratio)
        return self._outlines[key]

    def tags(self, marks: list[Mark]) -> dict[int, FloatArray]:
        """Return the corners (4, 2) of tags that are seen exactly once, by the mark's index."""
        found = {}
        for k, mark in enumerate(marks):
            if mark.kind != "tag":
                continue
            key = detection.tag_number(mark)
            if key[0] not in self._tags:
                self._tags[key[0]] = detection.find_tags(self.eight, [key[0]])
            seen = self._tags[key[0]].get(key, [])
            if len(seen) == 1:
                found[k] = seen[0]
        return found


@dataclass(frozen=True)
class Attempt:
    """The result of one attempt.

    Attributes
    ----------
    view
        None if no view can be trusted.
    seen
        Pixel and covariance of recognised marks, by index.
    used
        Marks that fit together.
    reasons
        Why other marks are not used.
    text
        Why there is no view.
    looks
        Measurements of each mark.
    known
        Whether the face's rough place was known before the search.
    vague
        Why the places of some targets remain unknown, by name.
    """

    view: FaceView | None
    seen: dict[int, tuple[FloatArray, FloatArray]]
    used: tuple[int, ...]
    reasons: dict[int, str]
    text: str
    looks: dict[int, Refined]
    known: bool
    vague: Mapping[str, str] = field(default_factory=dict)


@dataclass
class _Seen:
    """Marks found so far."""

    places: dict[int, tuple[FloatArray, FloatArray]]
    reasons: dict[int, str]
    looks: dict[int, Refined]
    #: Corners of tags, (4, 2).
    corners: dict[int, FloatArray]


class Search:
    """The search for one face in one frame."""

    def __init__(self, look: FrameSearch, face: Face, marks: list[Mark], plane: FloatArray) -> None:
        self.look, self.face, self.marks, self.plane = look, face, marks, plane
        self.tags = look.tags(marks)
        self.extent = float(np.ptp(face.span, axis=0).max())

    def attempt(
        self, pixels: FloatArray, scales: FloatArray, search: float, known: bool = False
    ) -> Attempt:
        """Search for every mark near ``pixels`` (M, 2) with ``scales`` (M, 2, 2).

        The first, rough search gives a view with its perspective and lens. The second uses
        the scales of that view, on which the places of corners depend.
        """
        rough = self._locate(pixels, scales, search)
        view, used = self._fit(rough, pixels if known else None)
        if view is None:
            return self._failed(rough, used, known)
        # Refining may find a mark or two that the rough search missed, but not more.
        if self._points_of(used) + 2 < self._needed(view, known) or self._impossible(view):
            return self._failed(rough, used, known)
        fine = self._refine(view, used)
        view, used = self._fit(fine, pixels if known else None)
        if view is None:
            return self._failed(fine, used, known)
        text, vague = self._problem(view, used, fine, known), self._vague(view, used)
        if not text and len(vague) == len(self.face.targets):
            text = next(iter(vague.values()))
        return Attempt(
            None if text else view,
            fine.places,
            tuple(used),
            fine.reasons,
            text,
            fine.looks,
            known,
            vague,
        )

    def _locate(self, pixels: FloatArray, scales: FloatArray, search: float) -> _Seen:
        seen = _Seen({}, {}, {}, {})
        for k, mark in enumerate(self.marks):
            if k in self.tags:
                seen.corners[k] = self.tags[k]
                seen.places[k] = _crossing(self.tags[k]), 0.3**2 * np.eye(2)
                continue
            picture = self._picture(mark)
            if mark.kind == "picture" and picture is None:
                seen.reasons[k] = f"its picture {mark.code} is missing"
                continue
            found = locate(self.look.grey, mark, pixels[k], scales[k], search, picture)
            if found is None:
                seen.reasons[k] = "outside the frame or too small"
            elif found[2] < LIKE:
                seen.reasons[k] = f"covered or absent: correlation {found[2]:.2f}"
            else:
                seen.places[k] = found[0], found[1] ** 2 * np.eye(2)
                if mark.kind == "tag":
                    seen.corners[k] = found[0] + _square(mark) @ scales[k].T
        return seen

    def _refine(self, view: FaceView, used: list[int]) -> _Seen:
        seen = _Seen({}, {}, {}, {})
        pixels, scales = view.to_pixels(self.plane), view.scale(self.plane)
        for k, mark in enumerate(self.marks):
            picture = self._picture(mark)
            if mark.kind == "picture" and picture is None:
                seen.reasons[k] = f"its picture {mark.code} is missing"
                continue
            search = 0.0 if k in used else 0.2
            around = self.face.span - self.plane[k]
            refined = refine(self.look.grey, mark, pixels[k], scales[k], search, picture, around)
            problem = _problem(refined, mark, k in self.tags)
            if refined is None or problem:
                seen.reasons[k] = problem
                continue
            seen.places[k] = refined.pixel, refined.covariance
            seen.looks[k] = refined
            if mark.kind == "tag":
                # The view holds perspective and lens; the rest is affine.
                box = _square(mark) @ (np.eye(2) + refined.shape).T
                seen.corners[k] = view.to_pixels(self.plane[k] + box) + refined.pixel - pixels[k]
        return seen

    def _picture(self, mark: Mark) -> FloatArray | None:
        return self.look.pictures.get(mark.code) if mark.kind == "picture" else None

    def tag_map(self) -> FloatArray:
        """Return the map from plane to pixels (3, 3) of all tags; affine for a single tag."""
        places = np.concatenate([self.plane[k] + _square(self.marks[k]) for k in self.tags])
        pixels = np.concatenate(list(self.tags.values()))
        if len(self.tags) > 1:
            return homography(places, pixels)
        # One tag is too small to tell perspective over the face.
        rows = np.column_stack([places, np.ones(len(places))])
        return np.vstack([np.linalg.lstsq(rows, pixels, rcond=None)[0].T, [0.0, 0.0, 1.0]])

    # -- fitting -----------------------------------------------------------------------

    def _fit(self, seen: _Seen, known: FloatArray | None) -> tuple[FaceView | None, list[int]]:
        """Fit a view to the marks seen, leaving out strays, the worst first."""
        used = list(seen.places)
        while True:
            points = self._points(used, seen, known)
            if points is None:
                return None, used
            camera = self.look.camera
            view = fit_view(self.face, *points, self.look.lens, camera is not None)
            if not np.isfinite(view.H_norm_plane).all():
                return None, used
            miss = view.to_pixels(self.plane[used]) - np.array([seen.places[k][0] for k in used])
            per_metre = np.abs(np.linalg.det(view.scale(self.plane[used])))
            image = np.array([0.5 * np.trace(seen.places[k][1]) for k in used])
            spread = np.sqrt(image + per_metre * SURVEY**2 + 0.3**2)
            apart = np.linalg.norm(miss, axis=-1)
            worst = int(np.argmax(apart / spread))
            if apart[worst] < STRAY * spread[worst] or len(used) <= 4:
                return view, used
            seen.reasons[used[worst]] = f"{apart[worst]:.1f} px from the place given by the others"
            del used[worst]

    def _points(
        self, used: list[int], seen: _Seen, known: FloatArray | None
    ) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Return points, pixels, covariance: four corners of a tag, four points for three marks."""
        plane, pixels, covariance = [], [], []
        per_metre = self._per_metre(used, seen)
        for k in used:
            mark, (pixel, spread) = self.marks[k], seen.places[k]
            common = spread + (per_metre * SURVEY) ** 2 * np.eye(2)
            if mark.kind == "tag":
                plane += list(self.plane[k] + _square(mark))
                pixels += list(seen.corners[k])
                # Its corners share the errors of survey and place.
                own = (per_metre * PRINT) ** 2 + 2.0 * np.trace(spread)
                covariance.append(np.kron(np.ones((4, 4)), common) + own * np.eye(8))
            else:
                plane.append(self.plane[k])
                pixels.append(pixel)
                covariance.append(common)
        if len(plane) < FEWEST:
            return None
        points, places = np.array(plane), np.array(pixels)
        if len(plane) == 3:
            fourth = self._fourth(used, points, places, known)
            if fourth is None:
                return None
            points = np.vstack([points, fourth[0]])
            places = np.vstack([places, fourth[1]])
            covariance.append(fourth[2] ** 2 * np.eye(2))
        elif np.linalg.matrix_rank(points - points.mean(axis=0), tol=0.1) < 2:
            return None
        return points, places, np.asarray(block_diag(*covariance), dtype=np.float64)

    def _fourth(
        self, used: list[int], points: FloatArray, places: FloatArray, known: FloatArray | None
    ) -> tuple[FloatArray, FloatArray, float] | None:
        """Return a fourth point for three, its pixel and its standard deviation, px.

        Three marks give an affine map. If the rough places of the marks are known, the map
        corrects them. Otherwise perspective is unknown, up to that of the lens (or of a lens
        of fifty degrees) at this slant.
        """
        if np.linalg.matrix_rank(points - points[0], tol=0.1) < 2:
            return None
        rows = np.column_stack([points, np.ones(3)])
        fourth = points[0] + points[2] - points[1]
        if known is not None:
            rest = [k for k in range(len(self.plane)) if k not in used]
            if not rest:
                return None
            far = max(
                rest, key=lambda k: float(np.linalg.norm(points - self.plane[k], axis=1).min())
            )
            shift = np.linalg.solve(rows, places - known[used])
            place = known[far] + np.append(self.plane[far], 1.0) @ shift
            return self.plane[far], place, 1.0 + 0.1 * float(np.linalg.norm(place - known[far]))
        affine = np.linalg.solve(rows, places)
        lengths = np.linalg.svd(affine[:2], compute_uv=False)
        slant = np.sqrt(max(1.0 - (lengths[1] / lengths[0]) ** 2, 0.02))
        extent = float(np.linalg.norm(np.ptp(places, axis=0)))
        spread = 0.5 * slant * extent**2 / float(self.look.lens.matrix[0, 0])
        return fourth, np.append(fourth, 1.0) @ affine, max(spread, 0.005 * extent)

    def _per_metre(self, used: list[int], seen: _Seen) -> float:
        if len(used) < 2:
            return 0.0
        plane = self.plane[used] - self.plane[used].mean(axis=0)
        pixels = np.array([seen.places[k][0] for k in used])
        pixels = pixels - pixels.mean(axis=0)
        return float(np.sqrt(np.sum(pixels**2) / max(np.sum(plane**2), 1e-12)))

    # -- judging -----------------------------------------------------------------------

    def _failed(self, seen: _Seen, used: list[int], known: bool) -> Attempt:
        text = self._too_few(used, FEWEST if known else min(ALONE, len(self.marks)))
        return Attempt(None, seen.places, tuple(used), seen.reasons, text, seen.looks, known)

    def _too_few(self, used: list[int], needed: int) -> str:
        total = len(self.marks)
        if not used:
            return f"none of its {total} marks was seen"
        names = ", ".join(self.marks[k].name for k in used)
        return f"only {len(used)} of its {total} marks were seen: {names}; {needed} are needed"

    def _problem(self, view: FaceView, used: list[int], seen: _Seen, known: bool) -> str:
        """Return why a view cannot be trusted; empty if it can."""
        needed = self._needed(view, known)
        if self._points_of(used) < needed:
            return self._too_few(used, needed)
        scale = view.scale(self.plane[used])
        per_metre = np.sqrt(np.abs(np.linalg.det(scale)))
        limit = MISFIT * self.extent * float(per_metre.mean()) + MISFIT_PIXELS
        if not view.residual <= limit:
            return (
                f"its marks do not fit together: {view.residual:.1f} px RMS, limit {limit:.1f} px"
            )
        if self._impossible(view):
            return "no camera can see a plane with its marks in these places"
        return self._misshapen(used, seen, known) or self._dark(view, used, seen)

    def _points_of(self, used: list[int]) -> int:
        return sum(4 if self.marks[k].kind == "tag" else 1 for k in used)

    def _needed(self, view: FaceView, known: bool) -> int:
        """Return the number of points that a view needs."""
        least = FEWEST if known or len(self.marks) <= ALONE else ALONE
        share = SHARE if known else SHARE_ALONE
        return max(least, int(np.ceil(share * len(self.expected(view)))))

    def expected(self, view: FaceView) -> list[int]:
        """Return the marks that the frame should show."""
        return self.within(view.to_pixels(self.plane))

    def within(self, pixels: FloatArray) -> list[int]:
        """Return the indices of places (N, 2) in the frame."""
        inside = (pixels >= 0.0) & (pixels <= np.array(self.look.size) - 1.0)
        return [int(k) for k in np.flatnonzero(inside.all(axis=-1))]

    def _impossible(self, view: FaceView) -> bool:
        corners = np.concatenate([self.face.plane(t.corners) for t in self.face.targets])
        depth = np.column_stack([corners, np.ones(len(corners))]) @ view.H_norm_plane[2]
        if (depth * depth[0] <= 0.0).any():
            return True
        lengths = np.linalg.svd(view.scale(corners), compute_uv=False)
        if (lengths[:, 1] < FLATTEST * lengths[:, 0]).any():
            return True
        return bool(np.abs(depth).max() > NEAREST * np.abs(depth).min())

    def _misshapen(self, used: list[int], seen: _Seen, known: bool) -> str:
        """Return why the marks' sizes and shapes are wrong; empty if they are not."""
        drawn = [k for k in used if k in seen.looks and self.marks[k].kind != "picture"]
        if not drawn:
            return ""
        shapes = np.array([seen.looks[k].shape for k in drawn])
        middle = np.median(shapes, axis=0)
        size = 0.5 * float(np.trace(middle))
        if abs(size) > WRONG_SIZE:
            return (
                f"its marks appear {1.0 + size:.2f} times as large as they should be: another "
                "target, or wrong sizes of the marks"
            )
        common = float(np.abs(middle - size * np.eye(2)).max())
        if len(drawn) >= FEWEST and common > ASKEW:
            return (
                f"its marks are all stretched or skewed by {common:.0%}: another target, or wrong "
                "places of the marks"
            )
        unlike = np.abs(shapes - size * np.eye(2)).max(axis=(1, 2))
        explained = min((seen.looks[k].explained for k in drawn if k not in self.tags), default=1.0)
        few = len(used) <= ALONE and not known
        if float(np.median(unlike)) > ALIKE or (few and float(unlike.max()) > ALIKE_EACH):
            return f"shapes that lie like its marks differ from them by up to {unlike.max():.0%}"
        if few and explained < EXPLAINED_EACH:
            return f"other shapes lie where its marks should: one is explained to {explained:.0%}"
        return ""

    def _dark(self, view: FaceView, used: list[int], seen: _Seen) -> str:
        """Return why the space between the marks is not paint, which is lighter; empty if it is."""
        flat = ("corner", "tee", "square", "disc")
        shown = [k for k in used if k in seen.looks and self.marks[k].kind in flat]
        if not shown:
            return ""
        print_, bare = self._levels(view, shown, seen)
        low, high = self.plane[used].min(axis=0), self.plane[used].max(axis=0)
        part = (np.arange(14) + 0.5) / 14
        places = low + np.stack(np.meshgrid(part, part), axis=-1).reshape(-1, 2) * (high - low)
        apart = np.linalg.norm(places[:, None] - self.plane[None], axis=-1)
        places = places[(apart > [1.2 * mark.size for mark in self.marks]).all(axis=1)]
        values = self._at(view.to_pixels(places))
        nearest = np.argmin(
            np.linalg.norm(places[:, None] - self.plane[shown][None], axis=-1), axis=1
        )
        level = print_[nearest] + 0.1 * (bare - print_)[nearest]
        valid = np.isfinite(values)
        if not valid.any():
            return ""
        lighter = float((values[valid] > level[valid]).mean())
        if lighter >= LIGHTER:
            return ""
        return f"only {lighter:.0%} of the area between its marks is lighter than the marks"

    def _levels(
        self, view: FaceView, shown: list[int], seen: _Seen
    ) -> tuple[FloatArray, FloatArray]:
        """Return the brightness of marks and of their surroundings, (K,) each."""
        inner = []
        for k in shown:
            mark = self.marks[k]
            # The middle of an arm of an L and of a T's bar; of a disc and a square the centre.
            across = {"corner": 0.5 * mark.size, "tee": 0.25 * mark.size}.get(mark.kind, 0.0)
            cos, sin = np.cos(mark.turn), np.sin(mark.turn)
            turn = np.array([[cos, -sin], [sin, cos]])
            inner.append(self.plane[k] + turn @ [across, -0.5 * mark.stroke])
        dark = self._at(view.to_pixels(np.array(inner)))
        contrast = np.array([seen.looks[k].contrast for k in shown])
        dark = np.where(np.isfinite(dark), dark, 0.0)
        return dark, dark / np.clip(contrast, 0.05, 1.0)

    def _at(self, pixels: FloatArray) -> FloatArray:
        """Return the frame's values at pixels (N, 2); NaN outside."""
        height, width = self.look.grey.shape
        column, row = np.round(np.nan_to_num(pixels, nan=-1.0)).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        values = self.look.grey[np.where(inside, row, 0), np.where(inside, column, 0)]
        return np.where(inside, values.astype(np.float64), np.nan)

    def _vague(self, view: FaceView, used: list[int]) -> dict[str, str]:
        """Return by name why the marks seen do not determine some targets."""
        parts = [
            self.plane[k] + (_square(self.marks[k]) if self.marks[k].kind == "tag" else 0.0)
            for k in used
        ]
        places = np.concatenate([np.reshape(part, (-1, 2)) for part in parts])
        middle = places.mean(axis=0)
        moments = np.cov((places - middle).T, bias=True) + 1e-6 * np.eye(2)
        found = {}
        for target in self.face.targets:
            center, limit = self.face.plane(target.center), VAGUE * max(target.width, target.height)
            off = center - middle
            deviation = float(np.sqrt(np.linalg.eigvalsh(view.covariance_at(center))[-1]))
            if not self._shown(view, target):
                found[target.name] = "it lies outside the frame"
            elif float(off @ np.linalg.solve(moments, off)) > FAR**2:
                names = ", ".join(self.marks[k].name for k in used)
                found[target.name] = f"all marks seen lie on one side of it: {names}"
            elif not deviation <= limit:
                found[target.name] = (
                    f"the marks seen determine its place only to {deviation:.3f} m; "
                    f"{limit:.3f} m is needed"
                )
        return found

    def _shown(self, view: FaceView, target: Target) -> bool:
        """Return whether the frame shows any part of a target."""
        part = np.stack(np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9)), -1).reshape(-1, 2)
        corners = self.face.plane(target.corners)
        low, high = corners.min(axis=0), corners.max(axis=0)
        return bool(self.within(view.to_pixels(low + part * (high - low))))


def _problem(refined: Refined | None, mark: Mark, read: bool) -> str:
    """Return why what was found near a mark's place is not the mark; empty if it is.

    A tag whose code was ``read`` may be explained less well: its cells may be small.
    """
    if refined is None:
        return "outside the frame or too small"
    if refined.explained < (EXPLAINED_READ if read else EXPLAINED):
        return f"covered or absent: its drawing explains {100 * refined.explained:.0f} %"
    if mark.kind == "picture":
        return ""
    if refined.contrast > CONTRAST:
        return f"too faint: {100 * refined.contrast:.0f} % of the brightness around it"
    if np.abs(refined.shape).max() > MISSHAPEN:
        return "its size or shape is wrong"
    return ""


def _square(mark: Mark) -> FloatArray:
    """Corners of a tag from the upper left, metres from its centre, (4, 2)."""
    cos, sin = np.cos(mark.turn), np.sin(mark.turn)
    box = 0.5 * mark.size * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
    return np.asarray(box @ np.array([[cos, sin], [-sin, cos]]))


def _crossing(corners: FloatArray) -> FloatArray:
    """Return where the diagonals of four corners cross: a square's centre, also in perspective."""
    a, b = corners[2] - corners[0], corners[3] - corners[1]
    across = a[0] * b[1] - a[1] * b[0]
    if abs(across) < 1e-9:
        return np.asarray(corners.mean(axis=0))
    gap = corners[1] - corners[0]
    return np.asarray(corners[0] + (gap[0] * b[1] - gap[1] * b[0]) / across * a)


# -- the search for a face -------------------------------------------------------------


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
        #: Number of shapes that look like one of its marks.
        self.shapes = 0
        self.text = ""

    def look(self, turned: bool) -> None:
        """Try one way of looking after another until the face is found."""
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
        """Return pixels and scales of the marks by the camera's pose; None if not visible."""
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
        """Yield an attempt from the tags recognised by their code."""
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
        """Return why what was seen may be another target of the face; empty if it cannot."""
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
                # Marks missing from their places speak against the other target.
                missing = len(search.within(view.to_pixels(plane - shift))) - len(attempt.used)
                if missing <= unseen + 1:
                    names = f"{targets[a].name} or {targets[b].name}"
                    return f"this may be {names}; name the targets that the camera sees"
        return ""

    def _settled(self, attempt: Attempt, view: FaceView) -> Attempt:
        """Return the attempt, among turns with like marks, that shows most or is more upright."""
        search, up = self.search, self._up()
        middle = search.plane.mean(axis=0)
        scale = view.scale(middle)

        def lean(turn: FloatArray) -> float:
            seen = scale @ turn[:, 1]
            return -float(seen @ up) / float(np.linalg.norm(seen))

        best, least = attempt, lean(np.eye(2))
        whole = len(attempt.used) == len(search.expected(view))
        for turn, share in symmetries(search.marks, search.plane):
            # If all marks look as they should, a turn with unlike marks is out of the question.
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
        """Yield an attempt from dark shapes that look and lie like the marks."""
        search = self.search
        kept = [k for k, m in enumerate(search.marks) if m.kind not in ("tag", "picture")]
        if len(kept) < FEWEST:
            return
        drawn, which = detection.drawings([search.marks[k] for k in kept])
        seen = detection.candidates(search.look.outlines(reduction, ratio), drawn)
        yield from self._matched(seen, kept, drawn, which, upright)

    def _pictured(self) -> Iterator[Attempt]:
        """Yield an attempt from taught pictures anywhere in an upright frame."""
        search = self.search
        kept = [k for k, m in enumerate(search.marks) if m.kind == "picture"]
        if len(kept) < FEWEST:
            return
        marks = [search.marks[k] for k in kept]
        seen = detection.find_pictures(search.look.eight, marks, search.look.pictures)
        yield from self._matched(
            seen, kept, detection.picture_drawings(marks), np.arange(len(kept)), True
        )

    def _matched(
        self,
        seen: detection.Candidates,
        kept: list[int],
        drawn: list[detection.Drawing],
        which: constellation.Places,
        upright: bool,
    ) -> Iterator[Attempt]:
        search = self.search
        self.shapes = max(self.shapes, len(seen.middle))
        marks = constellation.constellation(
            [search.marks[k] for k in kept], drawn, which, search.plane[kept]
        )
        found = constellation.match(seen, marks, self._up(), upright)
        if found is not None:
            yield self._mapped(found.H_pixel_plane, 0.4)

    def results(self) -> list[FoundTarget]:
        """Return the result for each target of the face."""
        search, best = self.search, self.best
        targets = search.face.targets
        if best is None:
            total = len(search.marks)
            text = self.text or (
                f"none of its {total} marks was seen: outside the frame, or covered"
                if self.shapes == 0
                else f"its {total} marks were not found together; {self.shapes} shapes in the "
                "frame look like one of them"
            )
            return [FoundTarget(t, False, text) for t in targets]
        results = []
        for target in targets:
            text = best.text or best.vague.get(target.name, "")
            view = None if text else best.view
            own = tuple(
                _found_mark(search, best, k)
                for k, mark in enumerate(search.marks)
                if any(_one(mark, m) for m in target.marks)
            )
            results.append(FoundTarget(target, view is not None, text, own, view))
        return results


def _rank(attempt: Attempt) -> tuple[bool, int]:
    return attempt.view is not None, len(attempt.used)


def symmetries(marks: Sequence[Mark], plane: FloatArray) -> list[tuple[FloatArray, float]]:
    """Return quarter turns (2, 2) about their middle that map marks onto places of marks.

    Each comes with the share of marks, half or more, that then also look the same.

    Parameters
    ----------
    marks
        Marks of a face, M.
    plane
        Their places, m, (M, 2).
    """
    found = []
    middle = plane.mean(axis=0)
    extent = float(np.ptp(plane, axis=0).max())
    for quarter, (cos, sin) in enumerate(((0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)), start=1):
        turn = np.array([[cos, -sin], [sin, cos]])
        places = middle + (plane - middle) @ turn.T
        apart = np.linalg.norm(places[:, None] - plane[None], axis=-1)
        other = np.argmin(apart, axis=1)
        near = apart[np.arange(len(marks)), other] < 0.05 * extent
        same = [
            bool(near[k]) and _alike(mark, marks[j], 0.5 * np.pi * quarter)
            for k, (mark, j) in enumerate(zip(marks, other, strict=True))
        ]
        share = float(np.mean(same))
        if share >= 0.5:
            found.append((turn, share))
    return found


def _alike(a: Mark, b: Mark, turned: float) -> bool:
    """Return whether a mark turned by an angle (rad) looks like another."""
    if a.kind in ("tag", "picture") or (a.kind, a.size, a.stroke) != (b.kind, b.size, b.stroke):
        return False
    if a.kind == "disc":
        return True
    period = 0.5 * np.pi if a.kind == "square" else 2.0 * np.pi
    rest = (a.turn + turned - b.turn) / period
    return bool(abs(rest - np.round(rest)) * period < 0.1)


def _one_place_each(found: Sequence[_Face]) -> None:
    """Reject at least one of two faces that were found in one place of the frame."""
    for k, first in enumerate(found):
        for second in found[k + 1 :]:
            a, b = first.best, second.best
            if a is None or b is None or a.view is None or b.view is None:
                continue
            if not (_covers(a.view, b.view) or _covers(b.view, a.view)):
                continue
            clear = _share(first, a) - _share(second, b)
            if a.known != b.known:
                clear = 1.0 if a.known else -1.0
            names = [each.search.face.targets[0].name for each in (first, second)]
            lost = [f"the frame shows {name} there" for name in reversed(names)]
            if abs(clear) < _CLEARER:
                lost = [
                    f"the frame may show {name} there; name the targets that the camera sees"
                    for name in reversed(names)
                ]
            if clear < _CLEARER:
                first.best = replace(a, view=None, text=lost[0])
            if clear > -_CLEARER:
                second.best = replace(b, view=None, text=lost[1])


def _share(each: _Face, attempt: Attempt) -> float:
    return len(attempt.used) / len(each.search.marks)


def _covers(a: FaceView, b: FaceView) -> bool:
    """Return whether the middle of face b is seen on face a."""
    place = a.to_plane(b.to_pixels(b.face.span.mean(axis=0)))
    low, high = a.face.span
    return bool(((place > low) & (place < high)).all())


def _found_mark(search: Search, best: Attempt, k: int) -> FoundMark:
    if k in best.seen:
        pixel, covariance = best.seen[k]
    else:
        pixel = np.full(2, np.nan) if best.view is None else best.view.to_pixels(search.plane[k])
        covariance = np.full((2, 2), np.nan)
    used = best.view is not None and k in best.used
    look = best.looks.get(k)
    found = FoundMark(search.marks[k], pixel, covariance, used, best.reasons.get(k, ""))
    if look is None or search.marks[k].kind == "tag":
        return found
    return replace(found, contrast=look.contrast, blur=look.blur)
