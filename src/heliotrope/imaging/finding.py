"""Targets in a raw frame, by their marks: where, how well, or why not."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from heliotrope.field.camera import Camera
from heliotrope.field.marks import Mark
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging import constellation, detection
from heliotrope.imaging.frame import Frame, Image
from heliotrope.imaging.projection import project
from heliotrope.imaging.refinement import Refined, refine
from heliotrope.imaging.view import Face, View, faces, fit_view, unknown_lens

#: Survey and paint: standard deviation of a mark's place on its target, m.
SURVEY = 0.005
#: A mark must explain this much of what is around it, and be darker than its surroundings.
_EXPLAINED, _CONTRAST = 0.5, 0.93
#: A mark farther from where the others put it than this many deviations is not used.
_STRAY = 5.0
#: Fewest marks, by which the view is determined, and fewest of those that should be there.
_FEWEST, _SHARE = 3, 0.5
#: A camera may hang at an angle: turns of the face that are tried, rad.
_ROLLS = (0.0, 0.35, -0.35, 0.7, -0.7, 0.5 * np.pi, -0.5 * np.pi, np.pi)


@dataclass(frozen=True)
class FoundMark:
    """One mark of a target in a frame.

    Attributes
    ----------
    mark
        Which.
    pixel
        Where it was seen, (2,); where it should be, if it was not.
    covariance
        pixels², (2, 2); NaN if it was not seen.
    used
        Whether the view stands on it.
    reason
        Why not; empty if it is used.
    contrast
        Its brightness over that of its surroundings; NaN of a tag.
    blur
        Of its upright and level edges, m, (2,); NaN of a tag.
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
        Which.
    found
        Whether it was found.
    reason
        Why not; empty if it was found.
    marks
        Those of its own marks that were looked for.
    view
        How its face lies in the frame; None if it was not found.
    """

    target: Target
    found: bool
    reason: str
    marks: tuple[FoundMark, ...] = ()
    view: View | None = None


Pictures = Mapping[str, FloatArray]


def find_targets(
    frame: Frame,
    targets: Sequence[Target],
    camera: Camera | None = None,
    previous: Sequence[View] = (),
    pictures: Pictures | None = None,
) -> list[FoundTarget]:
    """Return for each target where it is in a frame, or why it was not found.

    Parameters
    ----------
    frame
        As the camera gives it.
    targets
        Of which marks are known. Those in one plane are found together.
    camera
        If its lens is known it is used; if its pose is known too, marks are first looked
        for where they should be.
    previous
        Views of earlier frames of the same camera: looked at first.
    pictures
        Of taught marks, by their code.
    """
    look = _Look(frame, camera, pictures or {})
    found: dict[str, FoundTarget] = {}
    planes = faces(tuple(targets))
    # A camera that shows one face upright is not turned for another.
    for rolls in (_ROLLS[:1], _ROLLS[1:]):
        for face in planes:
            old = next((v for v in previous if _same(v.face, face)), None)
            for result in _find_face(look, face, old, rolls):
                found[result.target.name] = result
        if any(f.found for f in found.values()):
            break
    return [found[target.name] for target in targets]


def _same(a: Face, b: Face) -> bool:
    return {t.name for t in a.targets} == {t.name for t in b.targets}


def face_marks(face: Face) -> tuple[list[Mark], FloatArray]:
    """Return the marks of a face, each once, and their places in its plane (M, 2), m."""
    kept: list[Mark] = []
    for target in face.targets:
        for mark in target.marks:
            # Two targets that meet share the marks of their common corners.
            if not any(
                mark.kind == m.kind and np.linalg.norm(mark.point - m.point) < 0.05 for m in kept
            ):
                kept.append(mark)
    return kept, face.plane(np.array([m.point for m in kept]).reshape(-1, 3))


def _find_face(
    look: "_Look", face: Face, previous: View | None, rolls: Sequence[float]
) -> list[FoundTarget]:
    marks, plane = face_marks(face)
    if len(marks) < _FEWEST and not any(m.kind == "tag" for m in marks):
        text = f"{len(marks)} marks are known of it; name 3 or more (heliotrope camera teach)"
        return [FoundTarget(t, False, text) for t in face.targets]
    search = _Search(look, face, marks, plane)
    best: _Attempt | None = None
    for attempt in _attempts(search, previous, rolls):
        if best is None or len(attempt.used) > len(best.used):
            best = attempt
        if best.view is not None and len(best.used) >= min(len(marks), max(4, len(marks) - 2)):
            break
    return _results(face, search, best)


class _Look:
    """One frame, and what was worked out of it."""

    def __init__(self, frame: Frame, camera: Camera | None, pictures: Pictures) -> None:
        self.grey = np.ascontiguousarray(frame.grey)
        self.eight = _eight_bit(self.grey)
        self.pictures = pictures
        self.camera = camera if camera is not None and camera.size == frame.size else None
        self.lens = self.camera or unknown_lens(frame.size)
        self._outlines: dict[tuple[int, float], detection.Outlines] = {}

    def outlines(self, reduction: int, ratio: float) -> detection.Outlines:
        key = (reduction, ratio)
        if key not in self._outlines:
            self._outlines[key] = detection.outlines(self.eight, reduction, ratio)
        return self._outlines[key]


@dataclass(frozen=True)
class _Attempt:
    """What came of looking in one way."""

    view: View | None
    seen: dict[int, tuple[FloatArray, FloatArray]]
    used: tuple[int, ...]
    reasons: dict[int, str]
    text: str


class _Search:
    """One face in one frame."""

    def __init__(self, look: _Look, face: Face, marks: list[Mark], plane: FloatArray) -> None:
        self.look, self.face, self.marks, self.plane = look, face, marks, plane
        self.tags = detection.find_tags(look.eight, marks)
        self.looks: dict[int, Refined] = {}

    def from_map(self, pixels: FloatArray, scales: FloatArray, search: float) -> _Attempt:
        """Refine every mark about ``pixels`` (M, 2), then fit, without those that stray."""
        seen: dict[int, tuple[FloatArray, FloatArray]] = {}
        reasons: dict[int, str] = {}
        for k, mark in enumerate(self.marks):
            if mark.kind == "tag":
                if mark.name in self.tags:
                    corners = self.tags[mark.name]
                    seen[k] = corners.mean(axis=0), 0.2**2 * np.eye(2)
                else:
                    reasons[k] = "not seen"
                continue
            picture = self.look.pictures.get(mark.code) if mark.kind == "picture" else None
            refined = refine(self.look.grey, mark, pixels[k], scales[k], search, picture)
            problem = _problem(refined, mark)
            if refined is None or problem:
                reasons[k] = problem
            else:
                seen[k] = refined.pixel, refined.covariance
                self.looks[k] = refined
        return self.fit(seen, reasons)

    def fit(
        self, seen: dict[int, tuple[FloatArray, FloatArray]], reasons: dict[int, str]
    ) -> _Attempt:
        """Fit a view to what was seen; what strays is left out, the worst first."""
        used = list(seen)
        while True:
            points = self._points(used, seen)
            if points is None:
                text = f"only {len(used)} of its {len(self.marks)} marks were seen"
                return _Attempt(None, seen, tuple(used), reasons, text)
            plane, pixels, covariance = points
            view = fit_view(
                self.face, plane, pixels, covariance, self.look.lens, self.look.camera is not None
            )
            miss = view.to_pixels(self.plane[used]) - np.array([seen[k][0] for k in used])
            spread = np.array([self._deviation(k, seen, view) for k in used])
            stray = np.linalg.norm(miss, axis=-1) / spread
            worst = int(np.argmax(stray))
            if stray[worst] < _STRAY or len(used) <= 4:
                break
            reasons[used[worst]] = (
                f"{np.linalg.norm(miss[worst]):.1f} px from where the others put it"
            )
            del used[worst]
        limit = 0.02 * float(np.ptp(self.face.span, axis=0).max())
        per_metre = float(np.sqrt(abs(np.linalg.det(view.scale(self.plane[used[0]])))))
        if view.residual > limit * per_metre:
            text = f"its marks do not fit together: {view.residual:.0f} px RMS"
            return _Attempt(None, seen, tuple(used), reasons, text)
        return _Attempt(view, seen, tuple(used), reasons, "")

    def _deviation(
        self, k: int, seen: dict[int, tuple[FloatArray, FloatArray]], view: View
    ) -> float:
        per_metre = np.abs(np.linalg.det(view.scale(self.plane[k])))
        return float(np.sqrt(0.5 * np.trace(seen[k][1]) + per_metre * SURVEY**2 + 0.3**2))

    def _points(
        self, used: list[int], seen: dict[int, tuple[FloatArray, FloatArray]]
    ) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Points, pixels, covariances; a tag gives four corners, three marks a parallelogram."""
        plane, pixels, covariance = [], [], []
        per_metre = self._per_metre(used, seen)
        for k in used:
            mark = self.marks[k]
            survey = (per_metre * SURVEY) ** 2 * np.eye(2)
            if mark.kind == "tag":
                half = 0.5 * mark.size
                cos, sin = np.cos(mark.turn), np.sin(mark.turn)
                turn = np.array([[cos, sin], [-sin, cos]])
                box = half * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) @ turn
                plane += list(self.plane[k] + box)
                pixels += list(self.tags[mark.name])
                covariance += [seen[k][1] + survey] * 4
            else:
                plane.append(self.plane[k])
                pixels.append(seen[k][0])
                covariance.append(seen[k][1] + survey)
        if len(plane) < _FEWEST:
            return None
        if len(plane) == 3:
            # Without perspective the fourth corner completes the parallelogram; how far
            # perspective may move it is what two per cent of the face's size allow.
            plane.append(plane[0] + plane[2] - plane[1])
            pixels.append(pixels[0] + pixels[2] - pixels[1])
            extent = 0.02 * float(np.ptp(pixels, axis=0).max())
            covariance.append(extent**2 * np.eye(2))
        return np.array(plane), np.array(pixels), np.array(covariance)

    def _per_metre(self, used: list[int], seen: dict[int, tuple[FloatArray, FloatArray]]) -> float:
        if len(used) < 2:
            return 0.0
        plane = self.plane[used] - self.plane[used].mean(axis=0)
        pixels = np.array([seen[k][0] for k in used])
        pixels = pixels - pixels.mean(axis=0)
        return float(np.sqrt(np.sum(pixels**2) / max(np.sum(plane**2), 1e-12)))


def _attempts(search: _Search, previous: View | None, rolls: Sequence[float]) -> Iterator[_Attempt]:
    """Ways to look, the quick ones first; made as they are asked for."""
    if previous is not None:
        yield search.from_map(previous.to_pixels(search.plane), previous.scale(search.plane), 0.5)
    camera = search.look.camera
    if camera is not None and camera.position is not None:
        pixels = project(camera, search.face.point(search.plane))
        steps = [
            project(camera, search.face.point(search.plane + 0.01 * e)) - pixels for e in np.eye(2)
        ]
        if np.isfinite(pixels).all():
            yield search.from_map(pixels, np.stack(steps, axis=-1) / 0.01, 0.5)
    yield from _detections(search, rolls)


def _detections(search: _Search, rolls: Sequence[float]) -> Iterator[_Attempt]:
    """Look everywhere: for tags by their code, for the others by their outlines."""
    outlined = [k for k, m in enumerate(search.marks) if m.kind not in ("tag", "picture")]
    if search.tags:
        nowhere = np.full((len(search.plane), 2), np.nan)
        yield search.from_map(nowhere, np.tile(np.eye(2), (len(search.plane), 1, 1)), 0.0)
    if not outlined:
        return
    base = max(1, round(max(search.look.grey.shape) / 700))
    for roll in rolls:
        drawn, which = detection.drawings([search.marks[k] for k in outlined], roll)
        for reduction in dict.fromkeys(
            (base, max(1, base // 2), 2 * base)[: 1 if rolls == _ROLLS[:1] else 3]
        ):
            for ratio in (0.72, 0.85):
                seen = detection.candidates(search.look.outlines(reduction, ratio), drawn)
                found = constellation.match(
                    seen, drawn, np.array(which), search.plane[outlined], roll
                )
                if found is not None:
                    pixels = constellation.mapped(found.H_pixel_plane, search.plane)
                    scales = constellation.scales(found.H_pixel_plane, search.plane)
                    yield search.from_map(pixels, scales, 0.4)


def _problem(refined: Refined | None, mark: Mark) -> str:
    """Why what was found about a mark's place is not the mark; empty if it is."""
    if refined is None:
        return "beyond the frame or too small"
    if refined.explained < _EXPLAINED:
        return f"covered or not there: its drawing explains {100 * refined.explained:.0f} %"
    if mark.kind != "picture" and refined.contrast > _CONTRAST:
        return f"too faint: {100 * refined.contrast:.0f} % of its surroundings"
    return ""


def _eight_bit(grey: Image) -> Image:
    if grey.dtype == np.uint8:
        return np.asarray(grey, dtype=np.uint8)
    # 12 bits in 16 are common: what is there is stretched to what can be.
    top = max(int(grey.max()), 1)
    return np.asarray(grey.astype(np.float32) * (255.0 / top), dtype=np.uint8)


def _results(face: Face, search: _Search, best: _Attempt | None) -> list[FoundTarget]:
    total = len(search.marks)
    if best is None:
        text = f"none of its {total} marks was seen: not in the frame, or covered"
        return [FoundTarget(t, False, text) for t in face.targets]
    fewest = max(_FEWEST, int(np.ceil(_SHARE * total)))
    view, text = best.view, best.text
    if any(search.marks[k].kind == "tag" for k in best.used):
        fewest = 1
    if view is not None and len(best.used) < fewest:
        view, text = (
            None,
            f"only {len(best.used)} of its {total} marks were seen; {fewest} are needed",
        )
    results = []
    for target in face.targets:
        own = tuple(
            _found_mark(search, best, k) for k, mark in enumerate(search.marks)
            if any(np.linalg.norm(mark.point - m.point) < 0.05 for m in target.marks)
        )  # fmt: skip
        results.append(FoundTarget(target, view is not None, text, own, view))
    return results


def _found_mark(search: _Search, best: _Attempt, k: int) -> FoundMark:
    if k in best.seen:
        pixel, covariance = best.seen[k]
    else:
        pixel = np.full(2, np.nan) if best.view is None else best.view.to_pixels(search.plane[k])
        covariance = np.full((2, 2), np.nan)
    used = best.view is not None and k in best.used
    look = search.looks.get(k) if k in best.seen else None
    found = FoundMark(search.marks[k], pixel, covariance, used, best.reasons.get(k, ""))
    return found if look is None else replace(found, contrast=look.contrast, blur=look.blur)
