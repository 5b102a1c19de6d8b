"""Beam errors and normal errors for given parameters, and splits of sightings for testing."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.fit.residuals import frame
from heliotrope.calibration.named import Field, members
from heliotrope.calibration.paint_splits import KINDS, paint_split
from heliotrope.calibration.sightings import Sightings, ray_directions
from heliotrope.errors import InputError
from heliotrope.frames import ACROSS, Framed, Labelled, Variable
from heliotrope.geometry import FloatArray, angle_between, as_numbers, bisector, reflect
from heliotrope.values import Card, Value, span

Split = Literal[
    "random",
    "chronological",
    "neighbour",
    "sequential",
    "azimuth",
    "solstice",
    "balanced",
    "high-variance",
]
#: Fraction of a heliostat's sightings in one held-out neighbourhood, which has at least three.
NEIGHBOURHOOD = 0.1


@dataclass(frozen=True, eq=False, repr=False)
class BeamErrors(Value, Framed):
    """Errors of M sightings under a mechanism.

    Attributes
    ----------
    beam
        Angle between the reflected ray and the direction to the destination, rad, (M,).
    normal
        Angle between the mirror normal and the bisector, rad, (M,).
    offset
        Beam error to the right of and above the destination as seen from the mirror,
        rad, (M, 2).
    plane
        Offset of the reflected ray to the right of and above the destination in the plane
        across the beam, m, (M, 2); NaN for destinations at infinity.
    """

    beam: FloatArray
    normal: FloatArray
    offset: FloatArray
    plane: FloatArray

    def _labelled(self) -> Labelled:
        row = ("sighting",)
        return Labelled(
            row,
            {"sighting": np.arange(len(self.beam)), "across": ACROSS},
            {
                "beam": Variable(row, self.beam, "rad"),
                "normal": Variable(row, self.normal, "rad"),
                "offset": Variable((*row, "across"), self.offset, "rad"),
                "plane": Variable((*row, "across"), self.plane, "m"),
            },
        )

    def _card(self) -> Card:
        summary = summarise(self.beam)
        line = f"{summary.count} sightings, beam {1e3 * summary.median:.3g} mrad median, "
        line += f"{1e3 * summary.rms:.3g} RMS, {1e3 * summary.p95:.3g} for 95 %"
        rows = [
            ("beam", span(self.beam, 1e3, "mrad")),
            ("normal", span(self.normal, 1e3, "mrad")),
            ("to the right", span(self.offset[:, 0], 1e3, "mrad")),
            ("upwards", span(self.offset[:, 1], 1e3, "mrad")),
        ]
        return Card(line, ("error", "range"), rows)


def beam_errors(mechanism: Field, sightings: Sightings) -> BeamErrors:
    """Return the errors of sightings.

    Parameters
    ----------
    mechanism
        Mechanisms, batch shape (N,) or (); or a heliostat, a group or a plant, taken as calibrated.
    sightings
        M sightings of these heliostats.
    """
    field = members(mechanism, "calibrated")
    sightings = field.rows_of(sightings)
    pose = field.mechanism[sightings.heliostat].pose(sightings.counts)
    source, destination = ray_directions(sightings, pose.vertex)
    ray = reflect(source, pose.normal)
    distance = np.where(
        sightings.destination_at_infinity,
        np.nan,
        np.linalg.norm(sightings.destination - pose.vertex, axis=-1),
    )
    forward = np.sum(ray * destination, axis=-1)
    across = np.einsum("mck,mk->mc", frame(destination), ray)
    plane = across * (distance / np.where(forward > 0, forward, np.nan))[:, None]
    beam = angle_between(ray, destination)
    # Scaled to the length of the angle, because sines decrease again beyond a right angle.
    size = np.maximum(np.linalg.norm(across, axis=-1), 1e-300)
    return BeamErrors(
        beam=beam,
        normal=angle_between(pose.normal, bisector(source, destination)),
        offset=across * (beam / size)[:, None],
        plane=plane,
    )


def split(
    sightings: Sightings, kind: Split = "random", fraction: float = 0.7, seed: int = 0
) -> npt.NDArray[np.bool_]:
    """Return the mask (M,) of the training sightings, ``fraction`` of each heliostat's sightings.

    Parameters
    ----------
    sightings
        Sightings of any number of heliostats.
    kind
        "random"; "chronological" and "sequential" (train on the earliest sightings; "sequential"
        also learns from each held-out sighting once it has been predicted); or "neighbour" (hold
        out whole neighbourhoods of source directions). A random split is optimistic, because it
        leaves sightings from ten minutes earlier in the training part. The other splits are
        PAINT's; see `heliotrope.calibration.paint_splits`, which sets their sizes.
    fraction
        Training fraction, between 0 and 1.
    seed
        Seed of the random split.

    Raises
    ------
    InputError
        If the fraction is out of range or the kind is unknown.
    """
    check_fraction(fraction)
    if kind not in get_args(Split):
        raise InputError(f"unknown split {kind!r}; use one of {', '.join(get_args(Split))}")
    if kind in KINDS:
        return paint_split(sightings, kind, seed)[0]
    chosen = np.zeros(len(sightings), dtype=np.bool_)
    for heliostat in np.unique(sightings.heliostat):
        rows = np.flatnonzero(sightings.heliostat == heliostat)
        if kind == "random":
            rows = np.random.default_rng((seed, int(heliostat))).permutation(rows)
        elif kind == "neighbour":
            rows = _by_neighbourhood(sightings, rows, fraction, seed)
        else:
            rows = rows[np.argsort(sightings.time[rows], kind="stable")]
        chosen[rows[: round(fraction * len(rows))]] = True
    return chosen


def partition(
    sightings: Sightings, kind: Split = "random", fraction: float = 0.7, seed: int = 0
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Return two masks (M,), of the training and of the test sightings, chosen as in `split`.

    PAINT's splits also set aside validation sightings, which are in neither mask.
    """
    if kind in KINDS:
        return paint_split(sightings, kind, seed)
    training = split(sightings, kind, fraction, seed)
    return training, ~training


def check_fraction(fraction: float) -> None:
    """Raise an error if a training fraction leaves nothing to learn from or to test on.

    Raises
    ------
    InputError
        If the fraction is not between 0 and 1.
    """
    if not 0.0 < as_numbers(fraction, "fraction") < 1.0:
        raise InputError(f"fraction must be between 0 and 1, not {fraction}")


def _by_neighbourhood(
    sightings: Sightings, rows: npt.NDArray[np.intp], fraction: float, seed: int
) -> npt.NDArray[np.intp]:
    """Order one heliostat's sightings so that whole neighbourhoods of sun positions come last."""
    rng = np.random.default_rng((seed, int(sightings.heliostat[rows[0]])))
    sky = sightings.source[rows]
    many = max(3, round(NEIGHBOURHOOD * len(rows)))
    free = np.ones(len(rows), dtype=np.bool_)
    required = len(rows) - round(fraction * len(rows))
    while (~free).sum() < required:
        centre = rng.choice(np.flatnonzero(free))
        apart = np.where(free, np.linalg.norm(sky - sky[centre], axis=1), np.inf)
        remaining = min(many, required - int((~free).sum()))
        free[np.argsort(apart, kind="stable")[:remaining]] = False
    return np.concatenate([rows[free], rows[~free]])


@dataclass(frozen=True)
class ErrorSummary:
    """Beam errors of one heliostat, rad."""

    count: int
    median: float
    rms: float
    p95: float


def summarise(beam: FloatArray) -> ErrorSummary:
    """Return the median, RMS and 95th percentile of beam errors (M,); NaN if M is 0."""
    if not len(beam):
        return ErrorSummary(0, np.nan, np.nan, np.nan)
    return ErrorSummary(
        len(beam),
        float(np.median(beam)),
        float(np.sqrt(np.mean(beam**2))),
        float(np.percentile(beam, 95)),
    )
