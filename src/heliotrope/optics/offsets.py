"""Image offsets: where an imperfect heliostat sends its beam, by Malan's error model.

A controller knows the *nominal* mechanism and moves the drives to the counts at which that
mechanism would send the sun to the aim. The *actual* mechanism, with its imperfections, moves to
the same counts, and its beam misses the aim by the offsets that this module returns. Nothing here
depends on the kind of mechanism or of imperfection, because both are data of the chain.

Source: Malan, §4.2 (nine steps), for azimuth-elevation heliostats; `docs/explanation/malan.md`
interprets his steps as operations on the chain.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.target import Target
from heliotrope.frames import ENU, Framed, Labelled, Variable, batched
from heliotrope.geometry import FloatArray, as_float, as_vectors, reflect, tangent_axes
from heliotrope.mechanism.chain import Mechanism, Pose
from heliotrope.mechanism.tracking import TrackingStatus, track
from heliotrope.values import Card, Value, dots, span


@dataclass(frozen=True, eq=False, repr=False)
class ImageOffsets(Value, Framed):
    """Where beams cross the plane through the aim perpendicular to the line of sight.

    Values are NaN where the nominal mechanism cannot send the sunlight to the aim, or the beam
    never reaches the plane.

    Attributes
    ----------
    right, up
        Distances from the aim, as seen from the heliostat, m, (...).
    slant
        Distance from the nominal vertex to the aim, m, (...).
    normal, beam
        Unit normal of the actual mirror and direction of its beam, ENU, (..., 3).
    """

    right: FloatArray
    up: FloatArray
    slant: FloatArray
    normal: FloatArray
    beam: FloatArray

    def _card(self) -> Card:
        rows = [("right", span(self.right, 1.0, "m")), ("up", span(self.up, 1.0, "m"))]
        rows.append(("slant range", span(self.slant, 1.0, "m")))
        size = " × ".join(map(str, self.right.shape)) or "one"
        line = f"{size}, beam error {1e3 * float(self.rms()):.3g} mrad RMS"
        return Card(line, ("offset", "range"), rows, dots(self.right, self.up, "offsets"))

    def _labelled(self) -> Labelled:
        own = {name: Variable((), getattr(self, name), "m") for name in ("right", "up", "slant")}
        own |= {name: Variable(("axis",), getattr(self, name)) for name in ("normal", "beam")}
        return batched(np.shape(self.right), own, {"axis": ENU})

    @property
    def distance(self) -> FloatArray:
        """Distance of the beam from the aim, m, (...)."""
        return as_float(np.hypot(self.right, self.up))

    @property
    def beam_error(self) -> FloatArray:
        """Beam error to the right and upwards, rad, (..., 2).

        This is the offset divided by the slant range, as in Malan's thesis; for a heliostat at its
        nominal position it is the tangent of the angle.
        """
        return np.stack([self.right / self.slant, self.up / self.slant], axis=-1)

    def rms(self, axis: int | tuple[int, ...] | None = None) -> FloatArray:
        """Return the two-dimensional RMS of the beam error, rad.

        Parameters
        ----------
        axis
            Batch axes to average over, such as the time axis; default: all axes. NaN values are
            left out; the RMS of no values is NaN.
        """
        square = (self.distance / self.slant) ** 2
        known = np.isfinite(square)
        total = np.sum(square, axis=axis, where=known)
        count = np.sum(known, axis=axis)
        mean = np.divide(total, count, out=np.full(np.shape(total), np.nan), where=count > 0)
        return as_float(np.sqrt(mean))


def image_offsets(
    nominal: Mechanism, actual: Mechanism, sun: npt.ArrayLike, aim: npt.ArrayLike
) -> ImageOffsets:
    """Return where the beams of actual heliostats fall when driven as nominal heliostats.

    All batch shapes broadcast: the sun vectors of a day with one heliostat, sun vectors (times, 1)
    with mechanisms (heliostats,), or one nominal mechanism with many actual mechanisms.

    Parameters
    ----------
    nominal
        The mechanism that the controller assumes.
    actual
        The actual mechanism, of the same kind: ``nominal.with_parameters(...)``.
    sun
        Unit vectors to the sun, ENU, (..., 3).
    aim
        ENU metres, (..., 3).

    Raises
    ------
    InputError
        If the mechanisms are of different kinds, an input is not finite, a sun vector is not a unit
        vector, or shapes do not fit.

    Notes
    -----
    If two poses reach the aim, the controller takes the pose within the stops of the nominal
    drives. An azimuth-elevation mechanism without stops may go over the top, where the sign of an
    elevation bias is reversed.

    Malan, §4.2 with (4.26) resolved: +right and +up are as seen from the
    heliostat, looking at the aim. Accuracy: 1e-13 m at 40 m against an independent
    implementation of his model.
    """
    towards, pose, beam = _stand(nominal, actual, sun, as_vectors(aim, "aim"))
    slant = np.linalg.norm(towards, axis=-1)
    sight = towards / slant[..., None]
    gap = as_vectors(aim, "aim") - pose.vertex
    closing = np.sum(beam * sight, axis=-1)
    ahead = np.sum(gap * sight, axis=-1)
    meets = (closing > 0.0) & (ahead > 0.0)
    length = np.divide(ahead, closing, out=np.full(meets.shape, np.nan), where=meets)
    axes = tangent_axes(sight)
    miss = length[..., None] * beam - gap
    return ImageOffsets(
        right=np.sum(miss * axes[..., 0, :], axis=-1),
        up=np.sum(miss * axes[..., 1, :], axis=-1),
        slant=np.broadcast_to(slant, meets.shape),
        normal=np.broadcast_to(pose.normal, beam.shape),
        beam=beam,
    )


def target_offsets(
    nominal: Mechanism,
    actual: Mechanism,
    sun: npt.ArrayLike,
    target: Target,
    aim: npt.ArrayLike | None = None,
) -> FloatArray:
    """Return where these beams fall on a real target, as a camera sees them.

    Parameters
    ----------
    nominal, actual, sun
        As for `image_offsets`, which also lists the errors.
    target
        The target on whose plane the beams fall.
    aim
        Aims, ENU, m, (..., 3); default: the target centre.

    Returns
    -------
    Metres to the right of and above the target centre as seen from the front, (..., 2). NaN where
    `image_offsets` returns NaN, and where the beam arrives from behind.
    """
    point = target.center if aim is None else as_vectors(aim, "aim")
    _, pose, beam = _stand(nominal, actual, sun, point)
    hits = target.intersect(pose.vertex, beam)
    known = np.isfinite(hits)
    plane = target.plane_coordinates(np.where(known, hits, target.center))
    return np.where(known.all(axis=-1, keepdims=True), plane, np.nan)


def _stand(
    nominal: Mechanism, actual: Mechanism, sun: npt.ArrayLike, aim: FloatArray
) -> tuple[FloatArray, Pose, FloatArray]:
    """Return the vector from nominal vertex to aim, the actual pose, and the beam.

    The beam is NaN if the aim is out of reach.
    """
    if (nominal.kind, nominal.joints) != (actual.kind, actual.joints):
        raise InputError(
            f"actual: a {actual.kind} mechanism, but the nominal one is {nominal.kind}; "
            "make it with nominal.with_parameters"
        )
    tracked = track(nominal, sun, aim)
    counts = tracked.best_counts
    try:
        np.broadcast_shapes(counts.shape[:-1], actual.shape)
    except ValueError:
        raise InputError(
            f"actual: mechanisms of shape {actual.shape} do not fit nominal ones, suns and "
            f"aims of shape {counts.shape[:-1]}"
        ) from None
    pose = actual.pose(counts)
    beam = reflect(as_vectors(sun, "sun"), pose.normal)
    reached = tracked.chosen(tracked.status) == TrackingStatus.OK
    return aim - tracked.chosen(tracked.vertex), pose, np.where(reached[..., None], beam, np.nan)
