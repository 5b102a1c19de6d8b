"""Assess whether a spot can be trusted: named reasons against it, with measured values."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.imaging.spots.spot import Spot
from heliotrope.imaging.targets.finding import FoundTarget

#: Reasons and their meanings.
REASONS: dict[str, str] = {
    "target not found": "the target's marks were not seen in the frame",
    "no spot": "nothing on the target stands out from its background",
    "several spots": "power of the second spot over that of the first, or power over the expected",
    "lopsided": "third moments of the spot in units of its standard deviations",
    "cut at the edge": "brightness of the spot at the target's border over its peak, or shift of "
    "the centroid by the light beyond the border, m",
    "saturated": "share of the spot's light in clipped pixels",
    "flare": "brightness of the target's marks over that of its paint: stray light fills them",
    "cloud": "power of the spot over the expected, or its peak over the background",
    "moved": "blur of the marks in one direction over that in the other",
    "out of focus": "blur of the marks, m",
    "smeared": "length or width of the spot over the expected",
    "covered": "share of the spot that marks cover",
    "uncertain": "standard deviation of the centroid, m",
    "background": "share of the target that no spot lights, or that is brighter or darker than "
    "light on its paint explains",
}


@dataclass(frozen=True)
class Limits:
    """Limits of the checks.

    Attributes
    ----------
    second_spot
        Largest power of a second spot on the same target, relative to the first spot.
    edge
        Largest brightness at the target border relative to the peak. Within this limit, the shift
        caused by the light beyond the border can be corrected to about a third.
    cut
        Largest shift caused by the light beyond the border, m.
    clipped
        Largest fraction of the light in clipped pixels.
    mark_contrast
        Largest brightness of the marks relative to their surroundings.
    power
        Smallest power relative to the expected power.
    surprise
        Number of standard deviations by which a beam may exceed its expected power, length or
        width.
    skewness
        Largest skewness; two overlapping beams are more skewed than the beam of one heliostat (98 %
        of the measured beams at Jülich are below 0.28).
    contrast
        Smallest peak relative to the background, if nothing is expected.
    motion
        Largest ratio of the blur of the marks in one direction to that in the other.
    blur
        Largest blur of the marks, m.
    covered
        Largest fraction of a spot that is covered by marks.
    deviation
        Standard deviation of the centroid along its worse axis, m.
    free
        Smallest fraction of the face that is free of beams.
    unexplained
        Largest fraction of the face, outside its spots, that is brighter or darker than it should
        be because of shadows with several edges, stray light or obstacles.
    """

    second_spot: float = 0.15
    edge: float = 0.4
    cut: float = 0.15
    clipped: float = 0.35
    mark_contrast: float = 0.8
    power: float = 0.5
    surprise: float = 3.0
    skewness: float = 0.45
    contrast: float = 0.08
    motion: float = 2.5
    blur: float = 0.12
    covered: float = 0.15
    deviation: float = 0.1
    free: float = 0.06
    unexplained: float = 0.03


@dataclass(frozen=True)
class Expectation:
    """Prior knowledge of a beam.

    Attributes
    ----------
    power
        Power as in `Spot`, relative to the ambient light, m²; NaN if unknown.
    flux
        Flux as in `PlacedSpot`, full scales m²/s at gain 1; NaN if unknown. The flux depends on the
        sun alone and is preferred to ``power`` if the exposure and gain of a frame are known.
    length, width
        Standard deviations along the beam's major and minor axes, m; NaN if unknown.
    deviation
        Relative standard deviation of power, flux, length and width.
    place
        Expected position, metres to the right of and above the target centre, (2,); None if
        unknown. If there are several spots, the nearest is chosen.
    """

    power: float = float("nan")
    length: float = float("nan")
    place: FloatArray | None = None
    flux: float = float("nan")
    width: float = float("nan")
    deviation: float = 0.15

    def most(self, limits: Limits) -> float:
        """Return the largest tolerated ratio to the expected value."""
        return float(np.exp(limits.surprise * self.deviation))


@dataclass(frozen=True)
class Reason:
    """A reason against a spot.

    Attributes
    ----------
    name
        One of `REASONS`.
    value, limit
        Measured and tolerated value; NaN if there is nothing to measure.
    text
        The reason in words.
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
    flux: float = float("nan"),
    unexplained: float = 0.0,
) -> list[Reason]:
    """Return the reasons against the first of the spots on one target.

    Parameters
    ----------
    found
        The target in its frame; None for a crop.
    spots
        Spots on this target, the intended spot first.
    deviation
        Standard deviation of the first spot's centroid along its worse axis, including that of the
        target, m.
    free
        Fraction of the face that is free of beams.
    limits
        Tolerances.
    expectation
        Prior knowledge.
    flux
        Flux of the first spot, full scales m²/s at gain 1; NaN if unknown.
    unexplained
        Fraction of the face, outside its spots, that is brighter or darker than it should be.
    """
    reasons = [] if found is None else _of_frame(found, limits)
    if not spots:
        nothing = float("nan")
        return [
            Reason("no spot", nothing, nothing, "no spot stands out from the background"),
            *reasons,
        ]
    first = spots[0]
    second = max((s.power for s in spots[1:]), default=0.0) / max(first.power, 1e-12)
    checks = [
        (
            "several spots",
            second,
            limits.second_spot,
            "a second spot has {:.0%} of its power",
        ),
        (
            "cut at the edge",
            first.edge,
            limits.edge,
            "its brightness at the border is {:.0%} of its peak",
        ),
        ("cut at the edge", first.cut, limits.cut, "light beyond the border moves it by {:.2f} m"),
        ("saturated", first.clipped, limits.clipped, "{:.0%} of its light is clipped"),
        ("covered", first.covered, limits.covered, "marks cover {:.0%} of it"),
        ("uncertain", deviation, limits.deviation, "its centroid is uncertain by {:.3f} m"),
    ]
    for name, value, limit, text in checks:
        if not value <= limit and name not in {r.name for r in reasons}:
            reasons.append(Reason(name, float(value), limit, text.format(value)))
    if free < limits.free:
        text = f"only {free:.0%} of the target is free of light"
        reasons.append(Reason("background", free, limits.free, text))
    elif unexplained > limits.unexplained:
        text = f"{unexplained:.0%} of the target is brighter or darker than its light explains"
        reasons.append(Reason("background", unexplained, limits.unexplained, text))
    reasons += _of_power(first, flux, limits, expectation)
    if first.skewness > limits.skewness:
        text = f"its skewness is {first.skewness:.2f}: two beams, or one with a part missing"
        reasons.append(Reason("lopsided", first.skewness, limits.skewness, text))
    most = expectation.most(limits)
    sizes = {"long": expectation.length, "wide": expectation.width}
    for (word, size), axis in zip(sizes.items(), first.axes, strict=False):
        if axis / size > most:
            text = (
                f"it is {axis / size:.1f} times as {word} as expected: the beam moved, or there "
                "are two"
            )
            reasons.append(Reason("smeared", float(axis / size), most, text))
            break
    return reasons


def _of_power(spot: Spot, flux: float, limits: Limits, expectation: Expectation) -> list[Reason]:
    """Assess the power of a spot: too little suggests a cloud, too much a second beam."""
    share = flux / expectation.flux
    if not np.isfinite(share):
        share = spot.power / expectation.power
    if not np.isfinite(share):
        if spot.contrast >= limits.contrast:
            return []
        text = f"its peak is {spot.contrast:.0%} of the background: a cloud, or no sun"
        return [Reason("cloud", spot.contrast, limits.contrast, text)]
    most = expectation.most(limits)
    if share > most:
        text = f"it has {share:.1f} times the expected power: more than one beam"
        return [Reason("several spots", float(share), most, text)]
    if not share >= limits.power:
        text = f"it has {share:.0%} of the expected power: a cloud"
        return [Reason("cloud", float(share), limits.power, text)]
    return []


def _of_frame(target: FoundTarget, limits: Limits) -> list[Reason]:
    """Assess stray light, focus and shake of the frame from its marks."""
    used = [m for m in target.marks if m.used and np.isfinite(m.contrast)]
    if not used:
        return []
    reasons = []
    contrast = float(np.median([m.contrast for m in used]))
    if contrast > limits.mark_contrast:
        text = f"the marks have {contrast:.0%} of the brightness around them: stray light"
        reasons.append(Reason("flare", contrast, limits.mark_contrast, text))
    blur = np.median([m.blur for m in used], axis=0)
    if float(blur.min()) > limits.blur:
        text = f"the marks' edges are blurred over {float(blur.min()):.2f} m"
        reasons.append(Reason("out of focus", float(blur.min()), limits.blur, text))
    motion = float(blur.max() / max(blur.min(), 1e-9))
    # Blur smaller than a mark's stroke cannot be seen and does not move the centroid.
    if motion > limits.motion and float(blur.max()) > 0.4 * limits.blur:
        text = (
            f"the marks are blurred {motion:.1f} times as much in one direction: the camera moved"
        )
        reasons.append(Reason("moved", motion, limits.motion, text))
    return reasons
