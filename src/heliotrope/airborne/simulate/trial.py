"""Run trials on simulated reflections to find a flight's accuracy and number of photographs.

One mirror is measured repeatedly, each time with different slope errors, positions and noise.
Because the truth is known, the true error can be compared with the stated error.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from heliotrope.airborne.evaluate.budget import Budget
from heliotrope.airborne.evaluate.orientation import Mean, measure, rotation_between, turned
from heliotrope.airborne.evaluate.reflections import Reflections, reflections
from heliotrope.airborne.mirror import MirrorShape, reflection_points, tiled
from heliotrope.airborne.slopes import smooth_slopes
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, direction, normalize

#: 90 % of a normal distribution lie within this many standard deviations.
_NINETY = 1.6448536269514722


@dataclass(frozen=True)
class TrialConditions:
    """Settings of a flight over one mirror, in m and rad; errors are standard deviations per axis.

    Attributes
    ----------
    distance
        Distance from mirror to drone.
    columns, rows
        Numbers of hover positions, which extend beyond the mirror's edge by twice the slope error.
    slope, length
        RMS of each component of the slope deviations, and their correlation length.
    rtk
        Error of each photograph's position.
    reflection
        Error of the detected position of a reflection on the mirror.
    hover
        Distance of the drone from its planned position, known to the drone.
    pointing
        Rotation of the mirror from the expected orientation.
    lamp
        Lamp offset from the camera, to the right.
    budget
        Errors common to all points.
    """

    distance: float = 150.0
    columns: int = 8
    rows: int = 6
    slope: float = 0.8e-3
    length: float = 0.3
    rtk: float = 0.008
    reflection: float = 0.015
    hover: float = 0.1
    pointing: float = 2e-3
    lamp: float = 0.12
    budget: Budget = field(default_factory=lambda: Budget(0.010, 0.030, 0.0, 0.0))

    def __post_init__(self) -> None:
        if not (self.distance > 0.0 and self.columns > 0 and self.rows > 0):
            raise InputError(
                f"trial: distance {self.distance} m, {self.columns} × {self.rows} positions; all "
                "must be above 0"
            )


@dataclass(frozen=True)
class TrialMirror:
    """One mirror with its truth, and the input of the evaluation.

    Attributes
    ----------
    shape
        The mirror with its true slopes.
    rotation, vertex
        True rotation, (3, 3), and vertex, (3,).
    expected_rotation, expected_vertex
        Expected.
    reflections
        Reflections as the evaluation of images would find them.
    """

    shape: MirrorShape
    rotation: FloatArray
    vertex: FloatArray
    expected_rotation: FloatArray
    expected_vertex: FloatArray
    reflections: Reflections


@dataclass(frozen=True)
class Trials:
    """Results of K trials, rotX and rotY, rad.

    Attributes
    ----------
    count
        Number of points without outliers, (K,).
    error
        Error of the mean alone, with the true position of the mirror known, (K, 2).
    total_error
        Error from all causes, (K, 2).
    sigma_plain, sigma_mean, systematic
        Standard deviations stated by the evaluation, (K, 2).
    """

    count: FloatArray
    error: FloatArray
    total_error: FloatArray
    sigma_plain: FloatArray
    sigma_mean: FloatArray
    systematic: FloatArray

    @property
    def coverage(self) -> float:
        """Fraction of the total errors within the 90 % interval of σ_tot."""
        total = np.hypot(self.sigma_mean, self.systematic)
        return float(np.mean(np.abs(self.total_error) < _NINETY * total))


def four_facets() -> MirrorShape:
    """Return four facets, 3.2 m by 2.5 m in total, canted and curved for 200 m."""
    return tiled(2, 2, 1.6, 1.25, gap=0.02, focal=200.0)


def trial_mirror(shape: MirrorShape, conditions: TrialConditions, seed: int) -> TrialMirror:
    """Return a mirror with the ideal shape ``shape`` and random slopes, measured once."""
    c, rng = conditions, np.random.default_rng(seed)
    real = shape
    if c.slope > 0.0:
        real = shape.with_slopes(smooth_slopes(shape, rng, c.slope, length=c.length))
    out = direction(rng.uniform(0.0, 2.0 * np.pi), np.radians(rng.uniform(35.0, 70.0)))
    right = normalize(np.cross((0.0, 0.0, 1.0), out))
    expected = np.stack([right, np.cross(out, right), out], axis=-1)
    true = turned(expected, c.pointing * rng.standard_normal(2))
    expected_vertex = np.array([0.0, 100.0, 3.0])
    shift = np.hypot(c.budget.position, c.budget.kinematics) * rng.standard_normal(3)
    vertex = expected_vertex + shift
    # The reflection moves over the mirror with the drone, but less if the mirror focuses.
    corners = shape.corners[..., :2].reshape(-1, 2)
    narrow = abs(1.0 - c.distance / (2.0 * float(shape.focal.mean())))
    # Positions extend beyond the edge, so that parts of the surface that lean outwards are not
    # missed.
    half = narrow * 0.5 * np.ptp(corners, axis=0) + 2.0 * c.slope * c.distance
    places = np.stack(np.meshgrid(_line(c.columns) * half[0], _line(c.rows) * half[1]), axis=-1)
    places = places.reshape(-1, 2) + c.hover * rng.standard_normal((c.columns * c.rows, 2))
    own = np.concatenate([places, np.full((len(places), 1), c.distance)], axis=-1)
    # This is roughly the mirror's true direction, which a first photograph would show.
    camera = expected_vertex + own @ true.T
    led = camera + c.lamp * right
    points = reflection_points(real, true, vertex, camera, led)
    off = c.rtk * rng.standard_normal(camera.shape) + c.budget.rtk * rng.standard_normal(3)
    lamp_off = c.budget.lamp * rng.standard_normal(3)
    xy = points.xy + c.reflection * rng.standard_normal(points.xy.shape)
    measured = reflections(
        points.position,
        0,
        points.facet,
        xy,
        (camera + off)[points.position],
        (led + off + lamp_off)[points.position],
        max(c.reflection, 1e-6),
    )
    return TrialMirror(real, true, vertex, expected, expected_vertex, measured)


def trials(
    conditions: TrialConditions,
    count: int,
    *,
    shape: MirrorShape | None = None,
    map_known: bool = False,
    mean: Mean = "area",
    seed: int = 0,
) -> Trials:
    """Return ``count`` trials of a mirror.

    Parameters
    ----------
    conditions
        Settings of the flight.
    shape
        Mirror as designed; four facets of 1.6 m by 1.25 m if None.
    map_known
        Whether the evaluation knows the slope map of the mirror.
    mean
        See `heliotrope.airborne.evaluate.orientation.measure`.
    seed
        Seed of the first trial; later trials use the following seeds.

    Raises
    ------
    InputError
        If no hover position shows a reflection.
    """
    ideal = shape or four_facets()
    bare = replace(conditions.budget, position=0.0, kinematics=0.0)
    rows = []
    for k in range(count):
        s = trial_mirror(ideal, conditions, seed + k)
        known = s.shape if map_known else ideal
        alone = measure(s.reflections, known, s.expected_rotation, s.vertex, budget=bare, mean=mean)
        measured = measure(
            s.reflections,
            known,
            s.expected_rotation,
            s.expected_vertex,
            budget=conditions.budget,
            mean=mean,
        )
        rows.append(
            (
                np.full(2, float(measured.count)),
                rotation_between(s.rotation, alone.rotation)[:2],
                rotation_between(s.rotation, measured.rotation)[:2],
                measured.sigma_plain,
                measured.sigma_mean,
                measured.systematic,
            )
        )
    columns = np.array(rows)
    return Trials(columns[:, 0, 0], *(columns[:, k] for k in range(1, 6)))


def _line(count: int) -> FloatArray:
    return np.asarray((2.0 * np.arange(count) + 1.0) / count - 1.0)
