"""One attempt to locate a face in a frame: marks, the resulting view, and reasons for doubt."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from heliotrope.field.camera import Camera
from heliotrope.field.marks import Mark
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Frame, Image
from heliotrope.imaging.targets import detection
from heliotrope.imaging.targets.refinement import Refined, locate, refine
from heliotrope.imaging.targets.view import Face, FaceView, fit_view, homography, unknown_lens

Pictures = Mapping[str, FloatArray]

#: Standard deviation of a mark's position on its target, due to survey and paint, m.
SURVEY = 0.005
#: Standard deviation of a tag's corners relative to each other, m.
PRINT = 0.001
#: Minimum correlation of a mark; minimum fraction of the variance that its drawing explains
#: (without and with a code that was read); maximum brightness relative to its surroundings.
LIKE, EXPLAINED, EXPLAINED_READ, CONTRAST = 0.45, 0.65, 0.3, 0.93
#: A mark is not used if it is this many standard deviations from where the other marks predict it.
STRAY = 5.0
#: Maximum distortion of one mark relative to its drawing, of the size of all marks, and of the
#: marks relative to each other. Measured values are 0.03 in photographs and 0.2 in clutter.
MISSHAPEN, WRONG_SIZE, ALIKE = 0.2, 0.12, 0.08
#: Maximum common stretch or skew of all marks; the measured value is 0.01.
ASKEW = 0.04
#: Limits for each mark if there are no more marks than unknowns of a view.
ALIKE_EACH, EXPLAINED_EACH = 0.12, 0.75
#: Maximum residual of a view: a fraction of the face's extent, plus pixels.
MISFIT, MISFIT_PIXELS = 0.005, 1.0
#: Maximum standard deviation of a target's centre, as a fraction of the target's extent.
VAGUE = 0.005
#: Maximum distance of a target's centre from the middle of the observed marks, in their standard
#: deviations. Beyond this, lens and perspective are guesses.
FAR = 4.0
#: Minimum fraction of the paint between marks that is lighter than the nearest mark.
LIGHTER = 0.8
#: Minimum ratio of the two scales of a face, and maximum ratio of the scales on its near and far
#: sides.
FLATTEST, NEAREST = 0.2, 3.0
#: Minimum number of points of a view, and minimum fraction of the points in the frame, each with
#: and without prior knowledge of the positions.
FEWEST, ALONE, SHARE, SHARE_ALONE = 3, 4, 0.5, 0.7


def face_marks(face: Face) -> tuple[list[Mark], FloatArray]:
    """Return each mark of a face once, and the marks' positions in its plane, m, (M, 2)."""
    kept: list[Mark] = []
    for target in face.targets:
        for mark in target.marks:
            # Adjacent targets share the marks of their common corners.
            if not any(one_mark(mark, m) for m in kept):
                kept.append(mark)
    return kept, face.plane(np.array([m.point for m in kept]).reshape(-1, 3))


def one_mark(a: Mark, b: Mark) -> bool:
    """Return whether two targets share a mark on their common edge."""
    return a.kind == b.kind and float(np.linalg.norm(a.point - b.point)) < 0.05


class FrameSearch:
    """One frame, with intermediate results shared by all faces."""

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
        # Sensors leave bits unused, and a beam outshines everything else, so the brightest
        # thousandth is clipped.
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
        """Return the corners (4, 2) of tags that appear exactly once, keyed by mark index."""
        corners = {}
        for k, mark in enumerate(marks):
            if mark.kind != "tag":
                continue
            key = detection.tag_number(mark)
            if key[0] not in self._tags:
                self._tags[key[0]] = detection.find_tags(self.eight, [key[0]])
            places = self._tags[key[0]].get(key, [])
            if len(places) == 1:
                corners[k] = places[0]
        return corners


@dataclass(frozen=True)
class Attempt:
    """The result of one attempt.

    Attributes
    ----------
    view
        The view; None if no view is reliable.
    observed
        Pixels and covariances of recognised marks, by index.
    used
        Marks that are mutually consistent.
    reasons
        Why the other marks are not used.
    text
        Why there is no view.
    looks
        Measurements of each mark.
    known
        Whether the approximate position of the face was known before the search.
    vague
        Why the positions of some targets remain unknown, by target name.
    """

    view: FaceView | None
    observed: dict[int, tuple[FloatArray, FloatArray]]
    used: tuple[int, ...]
    reasons: dict[int, str]
    text: str
    looks: dict[int, Refined]
    known: bool
    vague: Mapping[str, str] = field(default_factory=dict)


@dataclass
class _Observed:
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

        The first, rough search yields a view with its perspective and lens. The second search uses
        the scales of that view, on which the positions of corners depend.
        """
        rough = self._locate(pixels, scales, search)
        view, used = self._fit(rough, pixels if known else None)
        if view is None:
            return self._failed(rough, used, known)
        # The second search may find a mark or two that the rough search missed, but not more.
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

    def _locate(self, pixels: FloatArray, scales: FloatArray, search: float) -> _Observed:
        observed = _Observed({}, {}, {}, {})
        for k, mark in enumerate(self.marks):
            if k in self.tags:
                observed.corners[k] = self.tags[k]
                observed.places[k] = _crossing(self.tags[k]), 0.3**2 * np.eye(2)
                continue
            picture = self._picture(mark)
            if mark.kind == "picture" and picture is None:
                observed.reasons[k] = f"its picture {mark.code} is missing"
                continue
            located = locate(self.look.grey, mark, pixels[k], scales[k], search, picture)
            if located is None:
                observed.reasons[k] = "outside the frame or too small"
            elif located[2] < LIKE:
                observed.reasons[k] = f"covered or absent: correlation {located[2]:.2f}"
            else:
                observed.places[k] = located[0], located[1] ** 2 * np.eye(2)
                if mark.kind == "tag":
                    observed.corners[k] = located[0] + _square(mark) @ scales[k].T
        return observed

    def _refine(self, view: FaceView, used: list[int]) -> _Observed:
        observed = _Observed({}, {}, {}, {})
        pixels, scales = view.to_pixels(self.plane), view.scale(self.plane)
        for k, mark in enumerate(self.marks):
            picture = self._picture(mark)
            if mark.kind == "picture" and picture is None:
                observed.reasons[k] = f"its picture {mark.code} is missing"
                continue
            search = 0.0 if k in used else 0.2
            around = self.face.span - self.plane[k]
            refined = refine(self.look.grey, mark, pixels[k], scales[k], search, picture, around)
            problem = _problem(refined, mark, k in self.tags)
            if refined is None or problem:
                observed.reasons[k] = problem
                continue
            observed.places[k] = refined.pixel, refined.covariance
            observed.looks[k] = refined
            if mark.kind == "tag":
                # The view accounts for perspective and lens; what remains is affine.
                box = _square(mark) @ (np.eye(2) + refined.shape).T
                observed.corners[k] = (
                    view.to_pixels(self.plane[k] + box) + refined.pixel - pixels[k]
                )
        return observed

    def _picture(self, mark: Mark) -> FloatArray | None:
        return self.look.pictures.get(mark.code) if mark.kind == "picture" else None

    def tag_map(self) -> FloatArray:
        """Return the map from plane to pixels, (3, 3), from all tags; affine for a single tag."""
        places = np.concatenate([self.plane[k] + _square(self.marks[k]) for k in self.tags])
        pixels = np.concatenate(list(self.tags.values()))
        if len(self.tags) > 1:
            return homography(places, pixels)
        # A single tag is too small to determine the perspective over the face.
        rows = np.column_stack([places, np.ones(len(places))])
        return np.vstack([np.linalg.lstsq(rows, pixels, rcond=None)[0].T, [0.0, 0.0, 1.0]])

    # -- fitting -----------------------------------------------------------------------

    def _fit(
        self, observed: _Observed, known: FloatArray | None
    ) -> tuple[FaceView | None, list[int]]:
        """Fit a view to the observed marks, removing outliers one at a time, the worst first."""
        used = list(observed.places)
        while True:
            points = self._points(used, observed, known)
            if points is None:
                return None, used
            camera = self.look.camera
            view = fit_view(self.face, *points, self.look.lens, camera is not None)
            if not np.isfinite(view.H_norm_plane).all():
                return None, used
            miss = view.to_pixels(self.plane[used]) - np.array(
                [observed.places[k][0] for k in used]
            )
            per_metre = np.abs(np.linalg.det(view.scale(self.plane[used])))
            image = np.array([0.5 * np.trace(observed.places[k][1]) for k in used])
            spread = np.sqrt(image + per_metre * SURVEY**2 + 0.3**2)
            apart = np.linalg.norm(miss, axis=-1)
            worst = int(np.argmax(apart / spread))
            if apart[worst] < STRAY * spread[worst] or len(used) <= 4:
                return view, used
            observed.reasons[used[worst]] = (
                f"{apart[worst]:.1f} px from the position given by the other marks"
            )
            del used[worst]

    def _points(
        self, used: list[int], observed: _Observed, known: FloatArray | None
    ) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Return the points, pixels and covariance of four points, from a tag or three marks."""
        plane, pixels, covariance = [], [], []
        per_metre = self._per_metre(used, observed)
        for k in used:
            mark, (pixel, spread) = self.marks[k], observed.places[k]
            common = spread + (per_metre * SURVEY) ** 2 * np.eye(2)
            if mark.kind == "tag":
                plane += list(self.plane[k] + _square(mark))
                pixels += list(observed.corners[k])
                # The corners of a tag share the tag's survey and position errors.
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
        """Return a fourth point in addition to three marks, its pixel, and its sigma, px.

        Three marks determine an affine map. If the rough positions of the marks are known, the map
        corrects them. Otherwise the perspective is unknown, up to that of the lens (or of a lens
        with a field of view of fifty degrees) at this slant.
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

    def _per_metre(self, used: list[int], observed: _Observed) -> float:
        if len(used) < 2:
            return 0.0
        plane = self.plane[used] - self.plane[used].mean(axis=0)
        pixels = np.array([observed.places[k][0] for k in used])
        pixels = pixels - pixels.mean(axis=0)
        return float(np.sqrt(np.sum(pixels**2) / max(np.sum(plane**2), 1e-12)))

    # -- judging -----------------------------------------------------------------------

    def _failed(self, observed: _Observed, used: list[int], known: bool) -> Attempt:
        text = self._too_few(used, FEWEST if known else min(ALONE, len(self.marks)))
        return Attempt(
            None, observed.places, tuple(used), observed.reasons, text, observed.looks, known
        )

    def _too_few(self, used: list[int], needed: int) -> str:
        total = len(self.marks)
        if not used:
            return f"none of its {total} marks was seen"
        names = ", ".join(self.marks[k].name for k in used)
        return f"only {len(used)} of its {total} marks were seen: {names}; {needed} are needed"

    def _problem(self, view: FaceView, used: list[int], observed: _Observed, known: bool) -> str:
        """Return the reason why a view is not reliable; an empty string if it is."""
        needed = self._needed(view, known)
        if self._points_of(used) < needed:
            return self._too_few(used, needed)
        scale = view.scale(self.plane[used])
        per_metre = np.sqrt(np.abs(np.linalg.det(scale)))
        limit = MISFIT * self.extent * float(per_metre.mean()) + MISFIT_PIXELS
        if not view.residual <= limit:
            return f"its marks are inconsistent: {view.residual:.1f} px RMS, limit {limit:.1f} px"
        if self._impossible(view):
            return "no camera position explains these mark positions"
        return self._misshapen(used, observed, known) or self._dark(view, used, observed)

    def _points_of(self, used: list[int]) -> int:
        return sum(4 if self.marks[k].kind == "tag" else 1 for k in used)

    def _needed(self, view: FaceView, known: bool) -> int:
        """Return the number of points that a view needs."""
        least = FEWEST if known or len(self.marks) <= ALONE else ALONE
        share = SHARE if known else SHARE_ALONE
        return max(least, int(np.ceil(share * len(self.expected(view)))))

    def expected(self, view: FaceView) -> list[int]:
        """Return the marks that should be visible in the frame."""
        return self.within(view.to_pixels(self.plane))

    def within(self, pixels: FloatArray) -> list[int]:
        """Return the indices of those positions (N, 2) that are in the frame."""
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

    def _misshapen(self, used: list[int], observed: _Observed, known: bool) -> str:
        """Return what is wrong with the sizes and shapes of the marks; "" if nothing is wrong."""
        drawn = [k for k in used if k in observed.looks and self.marks[k].kind != "picture"]
        if not drawn:
            return ""
        shapes = np.array([observed.looks[k].shape for k in drawn])
        middle = np.median(shapes, axis=0)
        size = 0.5 * float(np.trace(middle))
        if abs(size) > WRONG_SIZE:
            return (
                f"its marks appear {1.0 + size:.2f} times as large as they should be: a different "
                "target, or wrong mark sizes"
            )
        common = float(np.abs(middle - size * np.eye(2)).max())
        if len(drawn) >= FEWEST and common > ASKEW:
            return (
                f"its marks are all stretched or skewed by {common:.0%}: a different target, or "
                "wrong mark positions"
            )
        unlike = np.abs(shapes - size * np.eye(2)).max(axis=(1, 2))
        explained = min(
            (observed.looks[k].explained for k in drawn if k not in self.tags), default=1.0
        )
        few = len(used) <= ALONE and not known
        if float(np.median(unlike)) > ALIKE or (few and float(unlike.max()) > ALIKE_EACH):
            return f"shapes arranged like its marks differ from them by up to {unlike.max():.0%}"
        if few and explained < EXPLAINED_EACH:
            return (
                "there are other shapes where its marks should be: one is explained only to "
                f"{explained:.0%}"
            )
        return ""

    def _dark(self, view: FaceView, used: list[int], observed: _Observed) -> str:
        """Return why the area between marks is too dark to be paint; "" if it is not too dark."""
        flat = ("corner", "tee", "square", "disc")
        shown = [k for k in used if k in observed.looks and self.marks[k].kind in flat]
        if not shown:
            return ""
        print_, bare = self._levels(view, shown, observed)
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
        self, view: FaceView, shown: list[int], observed: _Observed
    ) -> tuple[FloatArray, FloatArray]:
        """Return the brightness of the marks and of their surroundings, (K,) each."""
        inner = []
        for k in shown:
            mark = self.marks[k]
            # Sample the middle of an arm of an L and of the bar of a T, and the centre of a disc or
            # a square.
            across = {"corner": 0.5 * mark.size, "tee": 0.25 * mark.size}.get(mark.kind, 0.0)
            cos, sin = np.cos(mark.turn), np.sin(mark.turn)
            turn = np.array([[cos, -sin], [sin, cos]])
            inner.append(self.plane[k] + turn @ [across, -0.5 * mark.stroke])
        dark = self._at(view.to_pixels(np.array(inner)))
        contrast = np.array([observed.looks[k].contrast for k in shown])
        dark = np.where(np.isfinite(dark), dark, 0.0)
        return dark, dark / np.clip(contrast, 0.05, 1.0)

    def _at(self, pixels: FloatArray) -> FloatArray:
        """Return the frame's values at pixels (N, 2); NaN outside the frame."""
        height, width = self.look.grey.shape
        column, row = np.round(np.nan_to_num(pixels, nan=-1.0)).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        values = self.look.grey[np.where(inside, row, 0), np.where(inside, column, 0)]
        return np.where(inside, values.astype(np.float64), np.nan)

    def _vague(self, view: FaceView, used: list[int]) -> dict[str, str]:
        """Return the targets that the visible marks do not determine, with the reasons."""
        parts = [
            self.plane[k] + (_square(self.marks[k]) if self.marks[k].kind == "tag" else 0.0)
            for k in used
        ]
        places = np.concatenate([np.reshape(part, (-1, 2)) for part in parts])
        middle = places.mean(axis=0)
        moments = np.cov((places - middle).T, bias=True) + 1e-6 * np.eye(2)
        reasons = {}
        for target in self.face.targets:
            center, limit = self.face.plane(target.center), VAGUE * max(target.width, target.height)
            off = center - middle
            deviation = float(np.sqrt(np.linalg.eigvalsh(view.covariance_at(center))[-1]))
            if not self._shown(view, target):
                reasons[target.name] = "it lies outside the frame"
            elif float(off @ np.linalg.solve(moments, off)) > FAR**2:
                names = ", ".join(self.marks[k].name for k in used)
                reasons[target.name] = f"all marks seen lie on one side of it: {names}"
            elif not deviation <= limit:
                reasons[target.name] = (
                    f"the visible marks determine its position only to {deviation:.3f} m; "
                    f"{limit:.3f} m is needed"
                )
        return reasons

    def _shown(self, view: FaceView, target: Target) -> bool:
        """Return whether the frame shows any part of a target."""
        part = np.stack(np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9)), -1).reshape(-1, 2)
        corners = self.face.plane(target.corners)
        low, high = corners.min(axis=0), corners.max(axis=0)
        return bool(self.within(view.to_pixels(low + part * (high - low))))


def _problem(refined: Refined | None, mark: Mark, read: bool) -> str:
    """Return the reason why a match is not the mark; an empty string if it is the mark.

    A tag whose code was ``read`` is allowed to fit less well, because its cells may be small.
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
    """Return the corners of a tag from the upper left, metres from its centre, (4, 2)."""
    cos, sin = np.cos(mark.turn), np.sin(mark.turn)
    box = 0.5 * mark.size * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
    return np.asarray(box @ np.array([[cos, sin], [-sin, cos]]))


def _crossing(corners: FloatArray) -> FloatArray:
    """Return where the diagonals of four corners cross, the centre of a square in perspective."""
    a, b = corners[2] - corners[0], corners[3] - corners[1]
    across = a[0] * b[1] - a[1] * b[0]
    if abs(across) < 1e-9:
        return np.asarray(corners.mean(axis=0))
    gap = corners[1] - corners[0]
    return np.asarray(corners[0] + (gap[0] * b[1] - gap[1] * b[0]) / across * a)
