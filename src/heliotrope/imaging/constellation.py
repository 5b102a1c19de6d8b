"""Which candidates are which marks: by what they look like and how they lie together."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray
from heliotrope.imaging.detection import Candidates, Drawing
from heliotrope.imaging.view import homography

#: A first guess is scaled from one candidate alone: so much of a distance it may be wrong.
_LOOSE = 0.25
#: Of the size of a mark: a candidate nearer than this to its place is the mark.
_TIGHT = 0.6


@dataclass(frozen=True)
class Match:
    """An assignment of candidates to marks.

    Attributes
    ----------
    marks, candidates
        Which mark is which candidate, (K,) each.
    H_pixel_plane
        From plane metres to pixels, (3, 3); affine if only three match.
    score
        Sum of the likenesses.
    """

    marks: npt.NDArray[np.intp]
    candidates: npt.NDArray[np.intp]
    H_pixel_plane: FloatArray
    score: float


def match(
    seen: Candidates, drawn: list[Drawing], which: npt.NDArray[np.intp], plane: FloatArray,
    roll: float = 0.0,
) -> Match | None:  # fmt: skip
    """Return the assignment that explains most marks, or None if no three agree.

    Every candidate gives, by its place and its size, a first guess of where all marks
    are; those found there give an affine map, then a homography.

    Parameters
    ----------
    seen
        Candidates of a frame.
    drawn
        The drawings.
    which
        For each mark its drawing, (M,).
    plane
        Places of the marks, m, (M, 2).
    roll
        The face is turned by this in the frame, counterclockwise, rad.
    """
    cos, sin = np.cos(roll), np.sin(roll)
    rolled = plane @ np.array([[cos, sin], [-sin, cos]])
    best: Match | None = None
    tried: set[tuple[int, ...]] = set()
    for i in range(len(seen.drawing)):
        for m in np.flatnonzero(which == seen.drawing[i]):
            scale = seen.extent[i] / drawn[seen.drawing[i]].size * [1.0, -1.0]
            guess = seen.point[i] + (rolled - rolled[m]) * scale
            apart = np.linalg.norm((rolled - rolled[m]) * scale, axis=-1)
            slack = _LOOSE * apart + 0.5 * float(seen.extent[i].max())
            taken = _gather(seen, which, guess, slack)
            if (taken >= 0).sum() < min(3, len(plane)):
                continue
            found = _settle(seen, drawn, which, plane, taken, roll)
            if found is None:
                continue
            key = tuple(found.candidates)
            if key in tried:
                continue
            tried.add(key)
            if best is None or found.score > best.score:
                best = found
    return best


def _gather(
    seen: Candidates, which: npt.NDArray[np.intp], guess: FloatArray, slack: FloatArray
) -> npt.NDArray[np.intp]:
    """For each mark the nearest candidate of its drawing within reach, or -1."""
    apart = np.linalg.norm(seen.point[None] - guess[:, None], axis=-1)
    apart = np.where(seen.drawing[None] == which[:, None], apart, np.inf)
    nearest = np.argmin(apart, axis=1)
    near = apart[np.arange(len(guess)), nearest] < slack
    taken = np.where(near, nearest, -1)
    # One candidate cannot be two marks: it is the nearer one.
    for c in np.unique(taken[taken >= 0]):
        rivals = np.flatnonzero(taken == c)
        if len(rivals) > 1:
            keep = rivals[np.argmin(apart[rivals, c])]
            taken[rivals[rivals != keep]] = -1
    return taken


def _settle(
    seen: Candidates,
    drawn: list[Drawing],
    which: npt.NDArray[np.intp],
    plane: FloatArray,
    taken: npt.NDArray[np.intp],
    roll: float,
) -> Match | None:
    """Fit, gather again, and fit, until nothing changes."""
    H = np.eye(3)
    for _ in range(4):
        held = np.flatnonzero(taken >= 0)
        if len(held) < 3 or np.linalg.matrix_rank(plane[held] - plane[held[0]], tol=0.1) < 2:
            return None
        H = _affine(plane[held], seen.point[taken[held]])
        if len(held) >= 5:
            H = homography(plane[held], seen.point[taken[held]])
        if not _upright(H, plane):
            return None
        guess = mapped(H, plane)
        extent = np.array([drawn[w].size for w in which]) * _stretch(H, plane, roll)
        # Four points make a homography exactly, and an affine map bends by perspective.
        loose = 0.04 * float(np.ptp(guess, axis=0).max()) if len(held) < 5 else 0.0
        again = _gather(seen, which, guess, _TIGHT * extent.max(axis=-1) + loose)
        alike = np.abs(np.log(seen.extent[again] / np.maximum(extent, 1e-9))).max(axis=-1) < 0.6
        again = np.where(alike, again, -1)
        if (again == taken).all():
            break
        taken = again
    held = np.flatnonzero(taken >= 0)
    if len(held) < 3:
        return None
    return Match(held, taken[held], H, float(seen.likeness[taken[held]].sum()))


def _affine(plane: FloatArray, pixels: FloatArray) -> FloatArray:
    rows = np.column_stack([plane, np.ones(len(plane))])
    solved = np.linalg.lstsq(rows, pixels, rcond=None)[0]
    return np.vstack([solved.T, [0.0, 0.0, 1.0]])


def mapped(H: FloatArray, plane: FloatArray) -> FloatArray:
    """Return places (M, 2) of a homography (3, 3)."""
    places = np.column_stack([plane, np.ones(len(plane))]) @ H.T
    return np.asarray(places[:, :2] / places[:, 2:])


def scales(H: FloatArray, plane: FloatArray) -> FloatArray:
    """Return d(pixel)/d(plane) of a homography at places (M, 2), (M, 2, 2)."""
    middle = mapped(H, plane)
    return np.stack([(mapped(H, plane + 0.01 * e) - middle) / 0.01 for e in np.eye(2)], axis=-1)


def _stretch(H: FloatArray, plane: FloatArray, roll: float) -> FloatArray:
    """Pixels per metre along the frame's rows and columns at places in the plane, (M, 2)."""
    cos, sin = np.cos(roll), np.sin(roll)
    turned = scales(H, plane) @ np.array([[cos, sin], [-sin, cos]])
    return np.asarray(np.linalg.norm(turned, axis=-2))


def _upright(H: FloatArray, plane: FloatArray) -> bool:
    """Whether the face is seen from its front: a right turn in it is one in the frame."""
    corners = np.column_stack([plane, np.ones(len(plane))]) @ H.T
    if (corners[:, 2] * corners[0, 2] <= 0.0).any():
        return False
    return bool(np.linalg.det(H) * corners[0, 2] < 0.0)
