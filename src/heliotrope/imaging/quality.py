"""Whether a spot may be believed: named reasons against it, each with its measured value."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.imaging.finding import FoundTarget
from heliotrope.imaging.spot import Spot

#: Reasons, each with what it means.
REASONS: dict[str, str] = {
    "target not found": "the target's marks were not seen in the frame",
    "no spot": "nothing on the target stands out of its background",
    "several spots": "the second spot's power over the first one's",
    "cut at the edge": "brightness of the spot at the target's border over its peak",
    "saturated": "part of the spot's light in clipped pixels",
    "flare": "brightness of the target's marks over that of its paint: stray light fills them",
    "cloud": "power of the spot over what is expected, or its peak over the background",
    "moved": "blur of the marks in one direction over that in the other",
    "out of focus": "blur of the marks, m",
    "smeared": "length of the spot over what is expected",
    "covered": "part of the spot that marks cover",
    "uncertain": "standard deviation of the centroid, m",
    "background": "part of the target that no spot lights",
}


@dataclass(frozen=True)
class Limits:
    """How much of each is borne.

    Attributes
    ----------
    second_spot
        Power of another spot on the same target, of the first one's.
    edge
        Brightness at the target's border, of the peak.
    clipped
        Part of the light in clipped pixels.
    mark_contrast
        Brightness of the marks, of their surroundings.
    power
        Of the expected power.
    contrast
        Peak over background, if nothing is expected.
    motion
        Blur of the marks in one direction over that in the other.
    blur
        Of the marks, m.
    length
        Of the expected length.
    covered
        Part of a spot under marks.
    deviation
        Standard deviation of the centroid along its worse axis, m.
    free
        Part of the face that must be free of light.
    """

    second_spot: float = 0.15
    edge: float = 0.12
    clipped: float = 0.35
    mark_contrast: float = 0.8
    power: float = 0.5
    contrast: float = 0.08
    motion: float = 2.5
    blur: float = 0.12
    length: float = 1.5
    covered: float = 0.15
    deviation: float = 0.1
    free: float = 0.15


@dataclass(frozen=True)
class Expectation:
    """What is known of a beam beforehand.

    Attributes
    ----------
    power
        As :class:`heliotrope.imaging.spot.Spot` has it, m²; NaN if unknown.
    length
        Standard deviation along its major axis, m; NaN if unknown.
    place
        Where it should be, metres right of and above the target's centre, (2,): of several
        spots the nearest one is taken. None if unknown.
    """

    power: float = float("nan")
    length: float = float("nan")
    place: FloatArray | None = None


@dataclass(frozen=True)
class Reason:
    """One thing that speaks against a spot.

    Attributes
    ----------
    name
        One of :data:`REASONS`.
    value, limit
        Measured, and what is borne; NaN where there is nothing to measure.
    text
        In words.
    """

    name: str
    value: float
    limit: float
    text: str


def judge(
    found: FoundTarget | None,
    spots: Sequence[Spot],
    deviation: float,
    free: float,
    limits: Limits,
    expectation: Expectation,
) -> list[Reason]:
    """Return what speaks against the first of the spots on one target.

    Parameters
    ----------
    found
        The target in its frame; None for a crop.
    spots
        On this target, the one that is meant first.
    deviation
        Standard deviation of its centroid along its worse axis, target included, m.
    free
        Part of the face that no beam lights.
    limits
        What is borne.
    expectation
        What is known beforehand.
    """
    reasons = [] if found is None else _of_frame(found, limits)
    if not spots:
        nothing = float("nan")
        return [
            Reason("no spot", nothing, nothing, "no spot stands out of the background"),
            *reasons,
        ]
    first, nan = spots[0], float("nan")
    second = max((s.power for s in spots[1:]), default=0.0) / max(first.power, 1e-12)
    checks = [
        ("several spots", second, limits.second_spot, "another spot on it has {:.0%} of its power"),
        ("cut at the edge", first.edge, limits.edge, "at the border it has {:.0%} of its peak"),
        ("saturated", first.clipped, limits.clipped, "{:.0%} of its light is clipped"),
        ("covered", first.covered, limits.covered, "marks cover {:.0%} of it"),
        ("uncertain", deviation, limits.deviation, "its centroid is certain to {:.3f} m only"),
    ]
    for name, value, limit, text in checks:
        if not value <= limit:
            reasons.append(Reason(name, float(value), limit, text.format(value)))
    if free < limits.free:
        text = f"only {free:.0%} of the target are free of light"
        reasons.append(Reason("background", free, limits.free, text))
    if np.isfinite(expectation.power):
        share = first.power / expectation.power
        if not share >= limits.power:
            text = f"it has {share:.0%} of the expected power: a cloud"
            reasons.append(Reason("cloud", float(share), limits.power, text))
    elif not first.contrast >= limits.contrast:
        text = f"its peak is {first.contrast:.0%} of the background: a cloud, or no sun"
        reasons.append(Reason("cloud", first.contrast, limits.contrast, text))
    length = first.axes[0] / expectation.length if np.isfinite(expectation.length) else nan
    if length > limits.length:
        text = f"it is {length:.1f} times as long as expected: it moved during exposure"
        reasons.append(Reason("smeared", float(length), limits.length, text))
    return reasons


def _of_frame(found: FoundTarget, limits: Limits) -> list[Reason]:
    """What the marks say of the frame: stray light, focus, shake."""
    used = [m for m in found.marks if m.used and np.isfinite(m.contrast)]
    if not used:
        return []
    reasons = []
    contrast = float(np.median([m.contrast for m in used]))
    if contrast > limits.mark_contrast:
        text = f"the marks have {contrast:.0%} of the brightness around them: stray light"
        reasons.append(Reason("flare", contrast, limits.mark_contrast, text))
    blur = np.median([m.blur for m in used], axis=0)
    if float(blur.min()) > limits.blur:
        text = f"the marks' edges are {float(blur.min()):.2f} m soft"
        reasons.append(Reason("out of focus", float(blur.min()), limits.blur, text))
    motion = float(blur.max() / max(blur.min(), 1e-9))
    # Less than a mark's stroke is told by no eye, and moves no centroid.
    if motion > limits.motion and float(blur.max()) > 0.4 * limits.blur:
        text = f"the marks are {motion:.1f} times as soft in one direction: the camera moved"
        reasons.append(Reason("moved", motion, limits.motion, text))
    return reasons
