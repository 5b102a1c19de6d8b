r"""Positions of mirror edges in brightness profiles, whatever lies beside the mirrors.

Beside a mirror there may be its shadow, or sunlit grass, or both within the blur of the lens. The
slope of a profile then does not indicate the position of the edge. For example, rendered mirrors
with a narrow shadow below them appeared 0.1 px too short, all on the same side, and the camera
position was wrong by 0.06 m at a distance of 150 m. The profile inside the edge is hardly affected.
Therefore

$$ p(x) = L - A\,Φ\!\left(\frac{x - x_0}{s}\right) $$

is fitted, where L is the light of the mirror, A the contrast with its surroundings, and x₀ the
edge. If most edges in a photograph lie in front of uniform ground, the whole profile is used;
otherwise only the part up to `_OUTSIDE` beyond the edge is used. A fit to that part has four times
the noise, but noise averages out over mirrors and photographs, whereas shadows do not. The blur s
is the same for all edges of one direction in a photograph, because a single profile could not
separate s from A.
"""

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray, as_float

Mask = npt.NDArray[np.bool_]

#: The part of a profile that is fitted, from the edge outwards, px.
_INSIDE, _OUTSIDE = -3.0, 1.0
#: Starting value of the blur of an edge, and its limits, px.
_BLUR, _SHARPEST, _SOFTEST = 0.9, 0.3, 3.0
_ROUNDS = 5
#: The surroundings of an edge are even if its mean profile deviates by no more than this many times
#: the noise. If at least so many edges were fitted and a larger fraction of them is uneven, no edge
#: is measured from outside.
_EVEN, _MANY, _ENOUGH = 1.5, 0.25, 20
#: A fit that moves an edge further than this, px, or lowers its contrast by this fraction, is not
#: the fit of an edge.
_FARTHEST, _WEAKEST = 0.6, 0.4


def cross_edges(
    colour: FloatArray, steps: FloatArray, reach: float, clear: Mask, groups: int, *, fitted: bool
) -> tuple[FloatArray, FloatArray, Mask]:
    """Return edge offsets, (M, 4, G), the least contrast, (M,), and a mask of valid offsets.

    Parameters
    ----------
    colour
        Light across each of the four edges of M mirrors in P profiles, (M, 4, P, S, 3).
    steps
        Positions along a profile, outwards from the expected edge, px, (S,).
    reach
        Largest distance of an edge from the expected edge, px.
    clear
        Which profiles lie on the mirror inside and on ground outside, (M, 4, P).
    groups
        Number G of groups in which profiles are averaged.
    fitted
        Whether edges are fitted; otherwise they are placed at the centre of the slope.
    """
    inner, outer = steps < -reach, steps > reach
    share = clear / np.maximum(clear.sum(axis=-1, keepdims=True), 1)
    levels = [
        np.einsum("mepc,mep->mec", colour[..., side, :].mean(axis=3), share)
        for side in (inner, outer)
    ]
    apart = levels[0] - levels[1]
    contrast = np.linalg.norm(apart, axis=-1)
    direction = apart / np.maximum(contrast, 1e-9)[..., None]
    profile = np.einsum("mepsc,mec->meps", colour, direction)
    grouped = profile.reshape(*profile.shape[:2], groups, -1, len(steps)).mean(axis=3)
    slope = -np.diff(grouped, axis=-1)
    at = 0.5 * (steps[1:] + steps[:-1])
    usable = np.abs(at) <= reach + 1.0
    smooth = slope[..., :-2] + 2.0 * slope[..., 1:-1] + slope[..., 2:]
    smooth = np.where(usable[1:-1], smooth, -np.inf)
    peak = at[1:-1][np.argmax(smooth, axis=-1)]
    near = np.abs(at - peak[..., None]) <= 2.6
    highest = np.max(np.where(near, slope, 0.0), axis=-1, keepdims=True)
    weight = np.where(near, np.clip(slope - 0.1 * highest, 0.0, None), 0.0)
    total = weight.sum(axis=-1)
    offset = np.sum(weight * at, axis=-1) / np.maximum(total, 1e-12)
    # A true edge has most of the contrast.
    jump = np.sum(np.where(near, slope, 0.0), axis=-1)
    known = (jump > 0.5 * contrast[..., None]) & (total > 0.0)
    known &= clear.reshape(*clear.shape[:2], groups, -1).all(axis=-1)
    hidden = ~clear.any(axis=-1)
    if fitted:
        offset = _fit_edges(grouped, steps, np.where(known, offset, np.nan), contrast)
    return offset, np.where(hidden, np.inf, contrast).min(axis=1) / np.sqrt(3.0), known


def _fit_edges(
    profile: FloatArray, steps: FloatArray, start: FloatArray, contrast: FloatArray
) -> FloatArray:
    """Return where the edges cross the profiles, px along ``steps``, (M, 4, G).

    Parameters
    ----------
    profile
        Light across each of the four edges of M mirrors in G groups, outwards, (M, 4, G, S).
    steps
        Positions along a profile, px, (S,).
    start
        First estimate, (M, 4, G), which is kept where the fit fails.
    contrast
        Inner minus outer light of each edge, (M, 4).
    """
    flat = profile.reshape(-1, len(steps))
    first = start.reshape(-1)
    usable = np.isfinite(first)
    first = np.where(usable, first, 0.0)
    jump = np.broadcast_to(contrast[..., None], start.shape).reshape(-1)
    pair = np.broadcast_to((np.arange(4) % 2)[:, None], start.shape).reshape(-1)
    blur = np.full(len(flat), _BLUR)
    alone, gap = _fit(flat, steps, first, blur, -_INSIDE, free=True)
    good = usable & _plausible(alone, first, jump)
    for side in (0, 1):
        these = good & (pair == side)
        if these.any():
            # Shadows beside an edge increase its residuals, so the blur is estimated from the other
            # edges.
            rest = np.sqrt(np.mean(gap**2, axis=1))
            even = these & (rest <= np.median(rest[these]))
            blur[pair == side] = np.median(alone[even, 3])
    whole, gap = _fit(flat, steps, first, blur, -_INSIDE, free=False)
    near, _ = _fit(flat, steps, first, blur, _OUTSIDE, free=False)
    measured = usable.reshape(start.shape)
    uneven = _uneven(gap.reshape(profile.shape), measured)[measured.any(axis=-1)]
    # Treat all edges of a photograph alike: if some mirrors appeared larger than others, the
    # photograph would rotate.
    fits = near if uneven.size >= _ENOUGH and uneven.mean() > _MANY else whole
    kept = usable & _plausible(fits, first, jump)
    return as_float(np.where(kept, fits[:, 2], first)).reshape(start.shape)


def _uneven(gap: FloatArray, usable: Mask) -> Mask:
    """Return a mask of the edges (M, 4) whose residuals (M, 4, G, S) exceed noise in all groups."""
    count = np.maximum(usable.sum(axis=-1), 1)
    kept = np.where(usable[..., None], gap, 0.0)
    mean = kept.sum(axis=2) / count[..., None]
    total = np.sum(kept**2, axis=(2, 3)) / count
    alike = np.sum(mean**2, axis=-1)
    noise = np.maximum(total - alike, 0.0) / np.maximum(count - 1, 1)
    return np.asarray(alike > _EVEN**2 * noise)


def _plausible(fits: FloatArray, first: FloatArray, jump: FloatArray) -> Mask:
    """Return a mask (K,) of the fits (K, 4) that place the edge near the first estimate."""
    with np.errstate(invalid="ignore"):
        near = np.abs(fits[:, 2] - first) < _FARTHEST
        strong = fits[:, 1] > _WEAKEST * jump
        sharp = (fits[:, 3] > _SHARPEST) & (fits[:, 3] < _SOFTEST)
    return np.asarray(np.isfinite(fits).all(axis=1) & near & strong & sharp)


def _fit(
    profile: FloatArray,
    steps: FloatArray,
    start: FloatArray,
    blur: FloatArray,
    outside: float,
    *,
    free: bool,
) -> tuple[FloatArray, FloatArray]:
    """Fit L, A, x₀ and s to profiles (K, S); return the values, (K, 4), and the residuals over A.

    The fit is a Gauss-Newton iteration; s is fitted only where ``free`` is true.
    """
    from scipy.special import ndtr

    away = steps - start[:, None]
    weight = ((away > _INSIDE) & (away < outside)).astype(np.float64)
    inner = np.sum(np.where(away < _INSIDE + 1.0, weight, 0.0) * profile, axis=1)
    level = inner / np.maximum(np.sum(np.where(away < _INSIDE + 1.0, weight, 0.0), axis=1), 1e-9)
    count = 4 if free else 3
    numbers = np.stack([level, np.zeros_like(level), start, blur], axis=1)
    for turn in range(_ROUNDS):
        u = (steps - numbers[:, 2:3]) / numbers[:, 3:]
        share, bell = ndtr(u), np.exp(-0.5 * u**2) / np.sqrt(2.0 * np.pi)
        if turn == 0:
            # The model is linear in the contrast, which starts at its best value for the first
            # position.
            top = np.sum(weight * share * (level[:, None] - profile), axis=1)
            numbers[:, 1] = top / np.maximum(np.sum(weight * share**2, axis=1), 1e-12)
        light, height = numbers[:, :1], numbers[:, 1:2]
        gap = profile - (light - height * share)
        slope = np.stack(
            [
                np.ones_like(u), -share, height * bell / numbers[:, 3:],
                height * bell * u / numbers[:, 3:],
            ][:count], axis=-1,
        )  # fmt: skip
        heavy = slope * weight[..., None]
        normal = np.einsum("ksi,ksj->kij", heavy, slope)
        normal += 1e-9 * np.eye(count)
        step = np.linalg.solve(normal, np.einsum("ksi,ks->ki", heavy, gap)[..., None])[..., 0]
        step[:, 2:] = np.clip(step[:, 2:], -0.5, 0.5)
        numbers[:, :count] += step
        numbers[:, 3] = np.clip(numbers[:, 3], _SHARPEST, _SOFTEST)
    return numbers, as_float(weight * gap / np.maximum(np.abs(numbers[:, 1:2]), 1e-12))
