"""Measure the light on a receiver in a camera frame, as a fraction of the nominal flux.

If the pixels are proportional to light, the mean over the receiver's pixels increases in proportion
to the flux. Daylight is added to the mean. The surroundings, a ring around the receiver outline
that no beam should hit, show the daylight relative to that in the reference. With the black level
b, the mean m over the receiver, and the mean s_i over each side of the ring (index 0 for the
reference),

    a = min_i (s_i - b) / (s_i0 - b)
    share = ((m - b) - a (m_0 - b)) / rise

where rise is the increase of the receiver mean at nominal flux. The side of the ring with the
smallest ratio is used, so that a beam beside the receiver, or a cloud behind it, is not mistaken
for daylight on the receiver.

If frames do not state their exposure, a value of a below 1 may mean that the exposure has become
shorter; in that case the fraction is divided by a.

The receiver is reported as dark only if nothing could hide light. Anything that may hide light (a
lens cap, a moved camera, clipped pixels) makes the fraction a lower bound, and the reason is
reported.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float
from heliotrope.imaging.frame import Frame, Image

Mask = npt.NDArray[np.bool_]

#: Outline of the measured face, and inner and outer edges of the surroundings, as the receiver's
#: outline scaled about its middle by these factors.
FACE, INNER, OUTER = 0.97, 1.15, 1.7
#: Minimum number of pixels of the face, and of a usable side of the surroundings; minimum number of
#: usable sides.
LEAST_FACE, LEAST_SIDE, LEAST_SIDES = 100, 40, 2
#: Largest fraction of clipped pixels in the face, and in a usable side.
CLIPPED_FACE, CLIPPED_SIDE = 0.0005, 0.01
#: The surroundings show the daylight on the receiver only if their daylight, relative to that in
#: the reference, is within these limits.
DIMMEST, BRIGHTEST = 0.1, 4.0
#: Below this fraction the receiver is darker than it would be in daylight alone.
DARKER = -0.05
#: Minimum similarity between the surroundings and those in the reference (1 if identical), and
#: largest movement of the picture, as a fraction of the outline's diagonal.
LIKENESS, MOVED = 0.4, 0.02
#: Largest relative change of exposure times gain, if frames state them.
EXPOSED = 0.01
#: Longer side of the reduced picture in which the surroundings are recognised, and the largest
#: movement that is searched for, px of that picture.
_LONGEST, _REACH = 320, 6
#: Fraction of the surroundings, with the steepest gradients, used to recognise them; and standard
#: deviation of the Gaussian that smooths them beforehand, px of that picture.
_STEEP, _SMOOTH = 0.08, 1.5
#: Largest difference between the rise of a photograph with beams and the common rise, as a fraction
#: of its own rise.
_LINEAR = 0.1
#: Minimum and maximum daylight of a photograph with beams, relative to that of the photograph
#: without.
_ALIKE = (0.7, 1.4)


@dataclass(frozen=True)
class ReceiverSight:
    """Where a camera sees a receiver.

    Attributes
    ----------
    camera, receiver
        Names of the camera and the receiver.
    size
        Size of a frame, px.
    outline
        Corners of the receiver in the frame, in order around it, px, (N, 2).
    gamma
        Exponent of the camera's response; 1 is linear.

    Raises
    ------
    InputError
        If the outline leaves the frame, is too small, or leaves no room for the surroundings.
    """

    camera: str
    receiver: str
    size: tuple[int, int]
    outline: FloatArray
    gamma: float = 1.0

    def __post_init__(self) -> None:
        who = f"camera {self.camera}: receiver {self.receiver}"
        outline = as_float(self.outline)
        if outline.ndim != 2 or outline.shape[1:] != (2,) or len(outline) < 3:
            raise InputError(f"{who}: an outline of {outline.shape}; specify 3 corners or more, px")
        object.__setattr__(self, "outline", outline)
        top = np.array(self.size) - 0.5
        if not ((outline >= -0.5) & (outline <= top)).all():
            raise InputError(
                f"{who}: its outline leaves the frame of {self.size[0]} × {self.size[1]} px; turn "
                "the camera, or use a wider lens"
            )
        pixels = int(self.face.sum())
        if pixels < LEAST_FACE:
            raise InputError(
                f"{who}: it has {pixels} px in the frame, below the minimum of {LEAST_FACE}; use "
                "a longer lens"
            )
        visible = sum(int(side.sum()) >= LEAST_SIDE for side in self.sides)
        if visible < LEAST_SIDES:
            raise InputError(
                f"{who}: {visible} of its four sides have a margin in the frame, below the "
                f"minimum of {LEAST_SIDES}; use a wider lens"
            )

    @cached_property
    def box(self) -> tuple[slice, slice]:
        """Rows and columns of the frame that show the receiver and its surroundings."""
        far = self._grown(OUTER)
        low = np.maximum(np.floor(far.min(axis=0)).astype(int), 0)
        high = np.minimum(np.ceil(far.max(axis=0)).astype(int) + 1, self.size)
        return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))

    @cached_property
    def face(self) -> Mask:
        """Pixels of the box on the receiver."""
        return self._within(FACE)

    @cached_property
    def ring(self) -> Mask:
        """Pixels of the box on the surroundings."""
        return np.asarray(self._within(OUTER) & ~self._within(INNER))

    @cached_property
    def sides(self) -> tuple[Mask, ...]:
        """Pixels of the box right of, below, left of and above the receiver."""
        rows, columns = self.box
        middle, extent = self._middle, np.ptp(self.outline, axis=0)
        x = (np.arange(columns.start, columns.stop) - middle[0]) / extent[0]
        y = ((np.arange(rows.start, rows.stop) - middle[1]) / extent[1])[:, None]
        flat, steep = np.abs(x) >= np.abs(y), np.abs(x) < np.abs(y)
        parts = (flat & (x > 0.0), steep & (y > 0.0), flat & (x <= 0.0), steep & (y <= 0.0))
        return tuple(np.asarray(self.ring & part) for part in parts)

    @property
    def _middle(self) -> FloatArray:
        return np.asarray(0.5 * (self.outline.min(axis=0) + self.outline.max(axis=0)))

    def _grown(self, factor: float) -> FloatArray:
        return np.asarray(self._middle + factor * (self.outline - self._middle))

    def _within(self, factor: float) -> Mask:
        import cv2

        rows, columns = self.box
        corners = self._grown(factor) - [columns.start, rows.start]
        drawn = np.zeros((rows.stop - rows.start, columns.stop - columns.start), np.uint8)
        cv2.fillPoly(drawn, [np.round(corners).astype(np.int32)], 1)
        return drawn > 0


@dataclass(frozen=True)
class ReceiverReference:
    """A camera's view of a receiver at known flux.

    Levels are linear, as fractions of full scale.

    Attributes
    ----------
    sight
        Where the camera sees the receiver.
    bits
        Bits per value in the camera's frames, 8 or 16.
    black
        Level with the lens capped.
    face
        Level of the receiver in daylight without beams, above black.
    sides
        Levels of the four sides of the surroundings in daylight without beams, above black, (4,);
        NaN for a side that is not in the frame.
    rise
        Rise of the receiver's level at nominal flux.
    surroundings
        Receiver and surroundings in daylight without beams, reduced in size (`reduced`), uint16.
    exposure
        Exposure times gain of the frames, s; NaN if the frames do not record it.
    """

    sight: ReceiverSight
    bits: int
    black: float
    face: float
    sides: FloatArray
    rise: float
    surroundings: Image
    exposure: float = math.nan

    def __post_init__(self) -> None:
        who = f"camera {self.sight.camera}: receiver {self.sight.receiver}"
        sides = as_float(self.sides)
        object.__setattr__(self, "sides", sides)
        numbers = np.array([self.black, self.face, self.rise])
        if not (np.isfinite(numbers).all() and 0.0 <= self.black < 1.0 and self.rise > 0.0):
            raise InputError(
                f"{who}: a reference with levels {self.black:g} and {self.face:g} and a rise of "
                f"{self.rise:g} is invalid; take the reference again"
            )
        if sides.shape != (4,) or int((sides > 0.0).sum()) < LEAST_SIDES:
            raise InputError(
                f"{who}: a reference of {sides} shows too few sides; take the reference again"
            )
        shape = reduced(np.zeros(self.sight.face.shape, np.float32)).shape
        if self.surroundings.shape != shape:
            raise InputError(
                f"{who}: the picture of its surroundings has {self.surroundings.shape} px, not "
                f"{shape}; take the reference again"
            )

    @property
    def daylight(self) -> float:
        """The reference's daylight on the receiver, as a fraction of the nominal flux."""
        return self.face / self.rise


@dataclass(frozen=True)
class ReceiverLight:
    """The flux on a receiver in one frame.

    Attributes
    ----------
    share
        Fraction of the nominal flux, 0 or more; a lower bound if there is a ``doubt``; NaN if the
        frame cannot be measured at all.
    doubt
        Why the flux may be higher; an empty string if there is no doubt.
    cells
        Fraction of the nominal mean flux in each requested cell, (...); NaN outside the frame; None
        if no cells were requested.
    """

    share: float
    doubt: str = ""
    cells: FloatArray | None = None


def receiver_light(
    frame: Frame, reference: ReceiverReference, places: FloatArray | None = None
) -> ReceiverLight:
    """Measure the flux on a receiver in a frame; see the module docstring.

    Parameters
    ----------
    frame
        Frame from the reference's camera, with the exposure of the reference.
    reference
        See `take_reference`.
    places
        Centres of cells whose flux is also requested, px, (rows, columns, 2). Daylight is assumed
        uniform over the receiver.
    """
    sight = reference.sight
    if frame.size != sight.size or _bits(frame) != reference.bits:
        kind = f"{frame.size[0]} × {frame.size[1]} px of {_bits(frame)} bit"
        first = f"{sight.size[0]} × {sight.size[1]} px of {reference.bits} bit"
        return ReceiverLight(math.nan, f"its frames have {kind}, but the reference has {first}")
    levels = _Levels.of(frame, sight)
    brightness = np.asarray((levels.sides - reference.black) / reference.sides)
    counting = np.isfinite(brightness) & (levels.clipped_sides <= CLIPPED_SIDE)
    daylight = float(brightness[counting].min()) if counting.any() else 0.0
    rise = levels.face - reference.black - max(daylight, 0.0) * reference.face
    share = rise / reference.rise
    doubt = _doubt(frame, levels, reference, daylight, int(counting.sum()), share)
    # A darker picture may have had a shorter exposure.
    stated = math.isfinite(frame.exposure * frame.gain * reference.exposure)
    dimmed = 1.0 if stated else min(max(daylight, DIMMEST), 1.0)
    cells = None
    if places is not None:
        dark = reference.black + max(daylight, 0.0) * reference.face
        cells = (_at(frame, sight, places) - dark) / (reference.rise * dimmed)
    return ReceiverLight(max(share / dimmed, 0.0), doubt, cells)


def _at(frame: Frame, sight: ReceiverSight, places: FloatArray) -> FloatArray:
    """Return mean levels in cells around centres, (rows, columns, 2); NaN outside the frame."""
    import cv2

    grey = _linear(frame, sight)
    corner = np.array([sight.box[1].start, sight.box[0].start])
    x, y = np.ascontiguousarray(np.moveaxis(places - corner, -1, 0), dtype=np.float32)
    wide = max(1, round(float(np.nanmedian(np.linalg.norm(np.diff(places, axis=1), axis=-1)))))
    high = max(1, round(float(np.nanmedian(np.linalg.norm(np.diff(places, axis=0), axis=-1)))))
    mean = cv2.blur(grey, (wide, high))
    return as_float(cv2.remap(mean, x, y, cv2.INTER_LINEAR, borderValue=math.nan))


def _doubt(
    frame: Frame,
    levels: "_Levels",
    reference: ReceiverReference,
    daylight: float,
    counting: int,
    share: float,
) -> str:
    """Return the reason why the light may exceed the measurement; an empty string if none."""
    exposure = frame.exposure * frame.gain
    if abs(exposure / reference.exposure - 1.0) > EXPOSED:
        return (
            f"exposure times gain is {exposure:.3g} s, that of the reference "
            f"{reference.exposure:.3g} s; fix exposure and gain"
        )
    if not counting:
        return "the surroundings of the receiver are overexposed; shorten the exposure"
    if daylight < DIMMEST:
        return (
            f"the surroundings of the receiver show {max(daylight, 0.0):.0%} of the reference's "
            f"daylight, below the minimum of {DIMMEST:.0%}: night, or something covers the lens"
        )
    if daylight > BRIGHTEST:
        return (
            f"the surroundings of the receiver are {daylight:.1f} times as bright as in the "
            f"reference; the limit is {BRIGHTEST:g}"
        )
    if levels.clipped_face > CLIPPED_FACE:
        return f"{levels.clipped_face:.1%} of the receiver is overexposed; shorten the exposure"
    if text := _view_change(reference.sight, reference.surroundings, levels.picture):
        return text
    if share < DARKER:
        return (
            "the receiver is darker than in daylight without beams; something is in front of it, "
            "or it has changed"
        )
    return ""


def _check_photographs(
    sight: ReceiverSight, capped: Frame, dark: Frame, with_beams: Sequence[tuple[Frame, float]]
) -> None:
    """Raise InputError if a size is wrong, a fraction is impossible, or no photograph has beams."""
    who = f"camera {sight.camera}"
    for frame in (capped, dark, *(frame for frame, _ in with_beams)):
        if frame.size != sight.size:
            raise InputError(
                f"{who}: {frame.name} has {frame.size[0]} × {frame.size[1]} px, but the camera has "
                f"{sight.size[0]} × {sight.size[1]} px"
            )
    for frame, share in with_beams:
        if not 0.0 < share <= 2.0:
            raise InputError(
                f"{who}: the share of {frame.name} must be above 0 and at most 2 (1 is nominal), "
                f"not {share:g}"
            )
    if not with_beams:
        raise InputError(
            f"{who}: no photograph with beams; pass one with its fraction of the nominal flux"
        )


def take_reference(
    sight: ReceiverSight,
    capped: Frame,
    dark: Frame,
    lit: Sequence[tuple[Frame, float]],
    bits: int | None = None,
) -> ReceiverReference:
    """Return a reference from photographs with one exposure.

    Parameters
    ----------
    sight
        Where the camera sees the receiver.
    capped
        Frame with the lens capped.
    dark
        Frame in daylight, with no beam on the receiver.
    lit
        Photographs with beams, taken soon after ``dark``, each with its fraction of the nominal
        flux; the receiver must not be overexposed.
    bits
        Bits per value in the camera's frames, needed if the frames passed are averages; None for
        the bits of ``dark``.

    Raises
    ------
    InputError
        If photographs contradict each other, or one of them cannot be used.
    """
    who = f"camera {sight.camera}"
    _check_photographs(sight, capped, dark, lit)
    black, plain = _Levels.of(capped, sight), _Levels.of(dark, sight)
    level = max(black.face, float(np.nanmax(black.sides)))
    sides = np.asarray(plain.sides - level)
    good = (plain.clipped_sides <= CLIPPED_SIDE) & (sides > level * 0.1) & (sides > 0.0005)
    if good.sum() < LEAST_SIDES:
        raise InputError(
            f"{who}: {dark.name} shows {int(good.sum())} sides of the receiver's surroundings "
            "brighter than a capped lens and not overexposed, below the minimum of "
            f"{LEAST_SIDES}; change the exposure, or include more of the receiver's surroundings "
            "in the picture"
        )
    usual = np.where(good, sides, math.nan)
    rises, shares = [], []
    for frame, share in lit:
        levels = _Levels.of(frame, sight)
        if levels.clipped_face > CLIPPED_FACE:
            raise InputError(
                f"{who}: {frame.name}: {levels.clipped_face:.1%} of the receiver is overexposed; "
                "use fewer beams, or a shorter exposure for all photographs"
            )
        daylight = float(np.nanmin((levels.sides - level) / usual))
        if not _ALIKE[0] <= daylight <= _ALIKE[1]:
            raise InputError(
                f"{who}: the surroundings in {frame.name} are {daylight:.2f} times as bright as in "
                f"{dark.name}; take all photographs with one fixed exposure, within a minute"
            )
        if text := _view_change(sight, plain.picture, levels.picture):
            raise InputError(f"{who}: {frame.name}: {text}")
        rises.append(levels.face - level - daylight * (plain.face - level))
        shares.append(share)
    slope = float(np.dot(rises, shares) / np.dot(shares, shares))
    for (frame, share), rise in zip(lit, rises, strict=True):
        if not (slope > 0.0 and abs(rise / (slope * share) - 1.0) <= _LINEAR):
            raise InputError(
                f"{who}: {frame.name} rises by {rise:.4f} of full scale at a fraction of "
                f"{share:g}, the other photographs predict {slope * share:.4f}; check the "
                "fractions and the linearity of the response (gamma)"
            )
    exposures = {frame.exposure * frame.gain for frame in (capped, dark, *(f for f, _ in lit))}
    stated = [value for value in exposures if math.isfinite(value)]
    if stated and max(stated) > (1.0 + EXPOSED) * min(stated):
        raise InputError(
            f"{who}: exposures times gain from {min(stated):.3g} to {max(stated):.3g} s; take all "
            "photographs with one fixed exposure"
        )
    return ReceiverReference(
        sight,
        bits or _bits(dark),
        level,
        plain.face - level,
        usual,
        slope,
        plain.picture,
        stated[0] if stated else math.nan,
    )


@dataclass(frozen=True)
class _Levels:
    """Mean levels in a frame, linear, as fractions of full scale."""

    face: float
    sides: FloatArray
    clipped_face: float
    clipped_sides: FloatArray
    picture: Image

    @classmethod
    def of(cls, frame: Frame, sight: ReceiverSight) -> "_Levels":
        rows, columns = sight.box
        grey = _linear(frame, sight)
        clipped = frame.clipped[rows, columns] > 0
        good = [side.sum() >= LEAST_SIDE for side in sight.sides]
        nan = math.nan
        pairs = [*zip(sight.sides, good, strict=True)]
        return cls(
            float(grey[sight.face].mean()),
            np.array(
                [float(grey[side].mean()) if sufficient else nan for side, sufficient in pairs]
            ),
            float(clipped[sight.face].mean()),
            np.array(
                [float(clipped[side].mean()) if sufficient else 1.0 for side, sufficient in pairs]
            ),
            np.asarray(np.round(65535.0 * np.clip(reduced(grey), 0.0, 1.0)), dtype=np.uint16),
        )


def _linear(frame: Frame, sight: ReceiverSight) -> Image:
    """Return the levels of the box, linear, as fractions of full scale."""
    linear = Frame(frame.pixels[sight.box], frame.name).linear(sight.gamma)
    return np.asarray(linear.grey, dtype=np.float32) / np.float32(linear.full_scale)


def _bits(frame: Frame) -> int:
    return 8 * frame.pixels.dtype.itemsize


# -- the surroundings ------------------------------------------------------------------


def reduced(values: Image) -> Image:
    """Return the means of pixel blocks, so that the longer side has at most 320 pixels."""
    import cv2

    factor = _factor(values.shape)
    if factor == 1:
        return values
    h, w = values.shape[0] // factor, values.shape[1] // factor
    whole = values[: h * factor, : w * factor]
    return cv2.resize(whole, (w, h), interpolation=cv2.INTER_AREA)


def _factor(shape: tuple[int, ...]) -> int:
    return max(1, math.ceil(max(shape) / _LONGEST))


def _view_change(sight: ReceiverSight, usual: Image, now: Image) -> str:
    """Return why the surroundings differ from the reference; an empty string if they agree.

    Gradient directions are compared, weighted by the gradients of the reference, so that neither
    the brightness nor a veil over the picture matters.
    """
    # Gradients at the inner edge of the ring belong to the receiver, and gradients at the edge of
    # the box are artefacts.
    ring = reduced(sight.ring.astype(np.float32)) > 0.999
    inside = np.zeros_like(ring)
    inside[_REACH + 2 : -_REACH - 2, _REACH + 2 : -_REACH - 2] = True
    mine, theirs = _slopes(usual), _slopes(now)
    steep = np.where(ring & inside, np.linalg.norm(mine, axis=0), 0.0)
    # Only the steepest gradients are used, because elsewhere noise has gradients too.
    row, column = np.nonzero(steep > np.quantile(steep[ring & inside], 1.0 - _STEEP))
    mine = mine[:, row, column]
    theirs = theirs / (np.linalg.norm(theirs, axis=0) + 1e-9)
    whole = float(np.linalg.norm(mine, axis=0).sum())
    if not whole > 0.0:
        return "nothing around the receiver shows where the camera points"
    shifts = [(y, x) for y in range(-_REACH, _REACH + 1) for x in range(-_REACH, _REACH + 1)]
    like = [float((mine * theirs[:, row + y, column + x]).sum()) / whole for y, x in shifts]
    best = int(np.argmax(like))
    if like[best] < LIKENESS:
        return (
            "the surroundings of the receiver do not match the reference; the camera was moved, "
            "or something is in front of it"
        )
    pixel = _factor(sight.face.shape)
    away = math.hypot(*shifts[best]) * pixel
    limit = max(MOVED * math.hypot(*np.ptp(sight.outline, axis=0)), float(pixel))
    if away > limit:
        return f"the picture has moved by {away:.0f} px, the limit is {limit:.1f} px"
    return ""


def _slopes(values: Image) -> FloatArray:
    """Return the gradients of a picture to the right and down, (2, H, W)."""
    import cv2

    smooth = cv2.GaussianBlur(values.astype(np.float32), (0, 0), _SMOOTH)
    return np.stack([cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)])
