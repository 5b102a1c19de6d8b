"""Assign candidates to marks, by their appearance and their arrangement."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.field.marks import Mark
from heliotrope.geometry import FloatArray
from heliotrope.imaging.targets.detection import Candidates, Drawing
from heliotrope.imaging.targets.view import homography

Places = npt.NDArray[np.intp]

#: Relative error of distances in a first guess, which is scaled from one candidate.
_LOOSE = 0.25
#: A candidate is the mark if it is this close to the mark's predicted position, in sizes of the
#: mark.
_TIGHT = 0.5
#: Maximum ratio of measured to predicted second moments, for one mark.
_SPREAD = 2.6
#: The same ratio for all marks together, and between the axes; measured values are 1.1 at most.
_SIZED, _ASKEW = 1.6, 1.4
#: A camera is upright if the face's upward direction is this close to the expected direction, rad.
_UPRIGHT = 0.3
#: Minimum correlation of a candidate at a mark's position.
_RESEMBLES = 0.55
#: Number of guesses that are scored, and number that are pursued.
_GUESSES, _FOLLOWED = 1200, 10


@dataclass(frozen=True)
class Constellation:
    """The arrangement of marks in their plane.

    Attributes
    ----------
    drawn
        The distinct drawings.
    which
        Drawing of each mark, (M,).
    plane
        Positions of the marks' points, m, (M, 2).
    middle
        Positions of the marks' centres of area, m, (M, 2).
    covariance
        Second moments of the marks, m², (M, 2, 2).
    turn
        Rotation matrices of the marks, (M, 2, 2).
    """

    drawn: tuple[Drawing, ...]
    which: Places
    plane: FloatArray
    middle: FloatArray
    covariance: FloatArray
    turn: FloatArray


@dataclass(frozen=True)
class Match:
    """An assignment of candidates to marks.

    Attributes
    ----------
    marks, candidates
        Indices of the assigned pairs, (K,) each.
    H_pixel_plane
        Homography from plane metres to pixels, (3, 3); affine if fewer than five match.
    score
        Score, compared in this order: number of marks, uprightness of the view, similarity of the
        shapes.
    """

    marks: Places
    candidates: Places
    H_pixel_plane: FloatArray
    score: tuple[int, float, float]


def constellation(
    marks: list[Mark], drawn: list[Drawing], which: Places, plane: FloatArray
) -> Constellation:
    """Return the arrangement of marks (M,), with their drawings, at positions (M, 2), m."""
    angle = np.array([mark.turn for mark in marks])
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], axis=-2)
    middle = np.array([drawn[w].middle for w in which])
    spread = np.array([drawn[w].covariance for w in which])
    return Constellation(
        tuple(drawn),
        which,
        plane,
        plane + (turn @ middle[..., None])[..., 0],
        turn @ spread @ np.swapaxes(turn, 1, 2),
        turn,
    )


def match(
    candidates: Candidates, marks: Constellation, up: FloatArray, upright: bool
) -> Match | None:
    """Return the assignment that explains the most marks; None if no three are consistent.

    Each candidate is assumed in turn to be each mark that it resembles, which predicts the
    positions of all marks. Candidates found at these positions yield an affine map, and then a
    homography.

    Parameters
    ----------
    candidates
        Candidates found in a frame.
    marks
        The marks.
    up
        Expected upward direction of the face in the frame, (2,).
    upright
        Whether to consider only guesses that agree with ``up``.
    """
    linear, mark, part = _guesses(candidates, marks, up, upright)
    if len(linear) == 0:
        return None
    apart = marks.middle[None] - marks.middle[mark][:, None]
    offset = (linear[:, None] @ apart[..., None])[..., 0]
    guess = candidates.middle[part][:, None] + offset
    size = np.sqrt(np.trace(candidates.covariance[part], axis1=1, axis2=2))
    slack = _LOOSE * np.linalg.norm(offset, axis=-1) + size[:, None]
    taken = _gather(candidates, marks, guess, linear, slack)
    count = (taken >= 0).sum(axis=1)
    least = min(3, len(marks.which))
    order = np.argsort(-count, kind="stable")
    best: Match | None = None
    tried: set[bytes] = set()
    for g in order:
        if count[g] < least or len(tried) >= _FOLLOWED:
            break
        key = taken[g].tobytes()
        if key in tried:
            continue
        tried.add(key)
        settled = _settle(candidates, marks, taken[g], up)
        if settled is not None and (best is None or settled.score > best.score):
            best = settled
    return best


def _guesses(
    candidates: Candidates, marks: Constellation, up: FloatArray, upright: bool
) -> tuple[FloatArray, Places, Places]:
    """Return linear maps from plane to pixels (G, 2, 2), with the mark and candidate of each."""
    pair, mark = np.nonzero(candidates.drawing[:, None] == marks.which[None])
    # A drawing is first rotated and then placed in the plane, so B = A · turn.
    linear = candidates.linear[pair] @ np.swapaxes(marks.turn[mark], 1, 2)
    if upright:
        kept = np.flatnonzero(_lean(linear, up) < _UPRIGHT)
    else:
        likeness = candidates.likeness[candidates.part[pair], candidates.drawing[pair]]
        kept = np.argsort(-likeness, kind="stable")[:_GUESSES]
    return linear[kept], mark[kept], candidates.part[pair[kept]]


def _lean(linear: FloatArray, up: FloatArray) -> FloatArray:
    """Return angles between maps' upward directions and the expected direction, rad, (G,)."""
    upward = linear[:, :, 1]
    along, across = upward @ up, upward[:, 0] * up[1] - upward[:, 1] * up[0]
    return np.asarray(np.abs(np.arctan2(across, along)))


def _gather(
    candidates: Candidates,
    marks: Constellation,
    guess: FloatArray,
    linear: FloatArray,
    slack: FloatArray,
) -> Places:
    """Return the nearest fitting candidate of each guess and mark, (G, M); −1 if none fits."""
    apart = np.linalg.norm(candidates.middle[None, None] - guess[:, :, None], axis=-1)
    alike = candidates.likeness.T[marks.which] > _RESEMBLES
    g, m, p = np.nonzero((apart < slack[..., None]) & alike[None])
    A = linear[g] if linear.ndim == 3 else linear[g, m]
    expected = A @ marks.covariance[m] @ np.swapaxes(A, 1, 2)
    ratio = np.linalg.solve(expected, candidates.covariance[p])
    trace = 0.5 * np.trace(ratio, axis1=1, axis2=2)
    area = np.sqrt(np.maximum(np.linalg.det(ratio), 1e-12))
    fits = (trace < _SPREAD) & (area > 1.0 / _SPREAD) & (area < _SPREAD)
    g, m, p = g[fits], m[fits], p[fits]
    taken = np.full(guess.shape[:2], -1)
    # The nearest candidate is written last, so that a candidate for two marks belongs to the nearer
    # mark.
    order = np.argsort(-apart[g, m, p], kind="stable")
    taken[g[order], m[order]] = p[order]
    owner = np.full((len(guess), len(candidates.middle)), -1)
    owner[g[order], p[order]] = m[order]
    rows = np.arange(len(guess))[:, None]
    own = owner[rows, np.maximum(taken, 0)] == np.arange(guess.shape[1])
    return np.where(own, taken, -1)


def _settle(
    candidates: Candidates, marks: Constellation, taken: Places, up: FloatArray
) -> Match | None:
    """Alternate between fitting and gathering candidates until nothing changes."""
    H = np.eye(3)
    for _ in range(5):
        held = np.flatnonzero(taken >= 0)
        middle = marks.middle[held]
        if len(held) < 3 or np.linalg.matrix_rank(middle - middle[0], tol=0.1) < 2:
            return None
        H = _affine(middle, candidates.middle[taken[held]])
        if len(held) >= 5:
            H = homography(middle, candidates.middle[taken[held]])
        if not _front(H, marks.plane):
            return None
        guess = mapped(H, marks.middle)
        linear = scales(H, marks.middle)
        size = np.sqrt(
            12.0 * np.trace(linear @ marks.covariance @ np.swapaxes(linear, 1, 2), axis1=1, axis2=2)
        )
        # An affine map does not account for perspective.
        loose = 0.04 * float(np.ptp(guess, axis=0).max()) if len(held) < 5 else 0.0
        again = _gather(
            candidates, marks, guess[None], linear[None], (_TIGHT * size + loose)[None]
        )[0]
        if (again == taken).all():
            break
        taken = again
    held = np.flatnonzero(taken >= 0)
    if len(held) < 3 or not _in_shape(candidates, marks, H, held, taken[held]):
        return None
    lean = float(_lean(scales(H, marks.plane.mean(axis=0)[None]), up)[0])
    likeness = float(candidates.likeness[taken[held], marks.which[held]].sum())
    return Match(held, taken[held], H, (len(held), -round(lean, 1), likeness))


def _in_shape(
    candidates: Candidates, marks: Constellation, H: FloatArray, held: Places, taken: Places
) -> bool:
    """Return whether the sizes of the marks agree with the distances between the marks.

    For a different target with other distances they disagree, because no map fits both sizes and
    distances.
    """
    back = np.linalg.inv(scales(H, marks.middle[held]))
    observed = (back @ candidates.covariance[taken] @ np.swapaxes(back, 1, 2)).sum(axis=0)
    root = np.linalg.inv(np.linalg.cholesky(marks.covariance[held].sum(axis=0)))
    least, most = np.linalg.eigvalsh(root @ observed @ root.T)
    return bool(most < _ASKEW * least and 1.0 / _SIZED < np.sqrt(least * most) < _SIZED)


def _affine(plane: FloatArray, pixels: FloatArray) -> FloatArray:
    rows = np.column_stack([plane, np.ones(len(plane))])
    solved = np.linalg.lstsq(rows, pixels, rcond=None)[0]
    return np.vstack([solved.T, [0.0, 0.0, 1.0]])


def mapped(H: FloatArray, plane: FloatArray) -> FloatArray:
    """Return positions (M, 2) mapped by a homography (3, 3)."""
    places = np.column_stack([plane, np.ones(len(plane))]) @ H.T
    return np.asarray(places[:, :2] / places[:, 2:])


def scales(H: FloatArray, plane: FloatArray) -> FloatArray:
    """Return d(pixel)/d(plane), (M, 2, 2), of a homography at positions (M, 2)."""
    middle = mapped(H, plane)
    return np.stack([(mapped(H, plane + 0.01 * e) - middle) / 0.01 for e in np.eye(2)], axis=-1)


def _front(H: FloatArray, plane: FloatArray) -> bool:
    """Return whether a face is seen from its front, so that right turns remain right turns."""
    corners = np.column_stack([plane, np.ones(len(plane))]) @ H.T
    if (corners[:, 2] * corners[0, 2] <= 0.0).any():
        return False
    return bool(np.linalg.det(H) * corners[0, 2] < 0.0)
