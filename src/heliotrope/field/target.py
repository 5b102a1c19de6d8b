"""Targets and receivers: the surfaces that beams are sent to."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.marks import Mark
from heliotrope.field.mesh import TriangleMesh
from heliotrope.geometry import FloatArray, as_vectors, normalize
from heliotrope.values import Card, Value, amount

#: A target's aim point lies no further in front of or behind its corners, m.
_DEPTH = 0.5
#: The inner surface of a cavity may touch the plane of its aperture, m.
_BEFORE = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class Target(Value):
    """A flat calibration target.

    Attributes
    ----------
    name
        Name, unique in the plant.
    corners
        Upper left, upper right, lower right, lower left as seen from the front (the side that the
        beams come from), ENU metres, (4, 3).
    center
        Aim point of the heliostats, ENU metres, (3,).
    markers
        Additional known points by name, ENU metres.
    marks
        Marks painted on the target, by which cameras locate the target.
    """

    name: str
    corners: FloatArray
    center: FloatArray
    markers: Mapping[str, FloatArray] = field(default_factory=dict)
    marks: tuple[Mark, ...] = ()

    def __post_init__(self) -> None:
        corners = as_vectors(self.corners, f"target {self.name}: corners")
        center = as_vectors(self.center, f"target {self.name}: center")
        if corners.shape != (4, 3) or center.shape != (3,):
            raise InputError(
                f"target {self.name}: corners and center must have the shapes (4, 3) and (3,), not "
                f"{corners.shape} and {center.shape}"
            )
        object.__setattr__(self, "corners", corners)
        object.__setattr__(self, "center", center)
        names = [mark.name for mark in self.marks]
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"target {self.name}: mark {name}: the name occurs twice")
        if np.linalg.norm(np.cross(self._across, self._up)) < 1e-6:
            raise InputError(
                f"target {self.name}: its corners span no area; specify the four corners of a "
                "rectangle"
            )
        away = center - corners.mean(axis=0)
        across, up = np.abs(self.axes @ away)
        depth = abs(float(away @ self.normal))
        if across > 0.5 * self.width or up > 0.5 * self.height or depth > _DEPTH:
            raise InputError(
                f"target {self.name}: its center lies {np.linalg.norm(away):.2f} m from the middle "
                "of its corners, outside them; it is the aim point on the target: correct one"
            )

    def _card(self) -> Card:
        east, north, up = self.center
        line = f"{self.name}, {self.width:.4g} × {self.height:.4g} m, centre {east:.4g} m east, "
        line += f"{north:.4g} m north, {up:.4g} m up; {amount(len(self.marks), 'mark')}"
        rows = [
            (name, *(f"{x:.3f}" for x in corner))
            for name, corner in zip(
                ("upper left", "upper right", "lower right", "lower left"),
                self.corners,
                strict=True,
            )
        ]
        return Card(line, ("corner", "east, m", "north, m", "up, m"), rows)

    @property
    def _across(self) -> FloatArray:
        """Vector from the left edge to the right edge, m, (3,)."""
        c = self.corners
        return np.asarray(0.5 * (c[1] + c[2] - c[0] - c[3]))

    @property
    def _up(self) -> FloatArray:
        c = self.corners
        return np.asarray(0.5 * (c[0] + c[1] - c[2] - c[3]))

    @property
    def width(self) -> float:
        """Mean width of the target, m."""
        return float(np.linalg.norm(self._across))

    @property
    def height(self) -> float:
        """Mean height of the target, m."""
        return float(np.linalg.norm(self._up))

    @cached_property
    def normal(self) -> FloatArray:
        """Unit normal on the front side, (3,)."""
        return normalize(np.cross(self._across, self._up))

    @property
    def upside_down(self) -> bool:
        """Whether the edge named upper is lower than the other edge."""
        return bool(self._up[2] < 0.0)

    @cached_property
    def axes(self) -> FloatArray:
        """Unit axes in the plane: to the right as seen from the front, and up, (2, 3)."""
        right = normalize(self._across)
        return np.stack([right, np.cross(self.normal, right)])

    def plane_coordinates(self, points: npt.ArrayLike) -> FloatArray:
        """Convert ENU points (..., 3) to offsets right of and above the centre, m, (..., 2)."""
        return (as_vectors(points, "points") - self.center) @ self.axes.T

    def point(self, plane: npt.ArrayLike) -> FloatArray:
        """Convert offsets right of and above the centre, m, (..., 2), to ENU points (..., 3)."""
        return self.center + np.asarray(plane, dtype=np.float64) @ self.axes

    def holds(self, points: npt.ArrayLike, off: float = _DEPTH) -> npt.NDArray[np.bool_]:
        """Return a mask of the ENU points (..., 3) that are on the target; NaN counts as off it.

        A point is on the target if it is within the border and at most ``off`` m in front of or
        behind the surface.
        """
        array = np.asarray(points, dtype=np.float64)
        away = array - self.center
        place = away @ self.axes.T
        corners = self.plane_coordinates(self.corners)
        inside = (place >= corners.min(axis=0)) & (place <= corners.max(axis=0))
        return np.asarray(inside.all(axis=-1) & (np.abs(away @ self.normal) <= off))

    def intersect(self, origin: npt.ArrayLike, direction: npt.ArrayLike) -> FloatArray:
        """Return where rays (..., 3) meet the target plane, ENU; NaN where they miss it."""
        o, d = np.asarray(origin, dtype=np.float64), np.asarray(direction, dtype=np.float64)
        towards = np.asarray(d @ self.normal)
        gap = np.asarray((self.center - o) @ self.normal)
        # The beam must come from the front, that is, against the normal.
        length = np.where(towards < 0.0, gap / np.where(towards == 0.0, 1.0, towards), np.nan)
        length = np.where(length > 0.0, length, np.nan)
        return o + length[..., None] * d


@dataclass(frozen=True, eq=False, repr=False)
class Receiver(Value):
    """A receiver: the surface that the field heats.

    Attributes
    ----------
    name
        Name, unique in the plant.
    kind
        "planar", "convex_cylinder", "external_cylinder", "cavity" or "mesh".
    center
        ENU metres, (3,).
    normal
        Unit normal of the aperture, pointing outwards, (3,).
    width, height
        Size of the aperture, m; diameter and height of an external cylinder; largest extent of a
        mesh.
    corners
        Corners of the aperture in the order of `Target`, (4, 3), if known.
    radius, opening_angle
        Radius of curvature, m, and opening angle, rad; 0 if flat.
    nominal_power
        Power on the receiver to which its flux readings refer, W; 0: unknown.
    mesh
        Surface of a mesh, or inner surface of a cavity, in the axes `frame` about the centre, m.
    """

    name: str
    kind: str
    center: FloatArray
    normal: FloatArray
    width: float
    height: float
    corners: FloatArray | None = None
    radius: float = 0.0
    opening_angle: float = 0.0
    nominal_power: float = 0.0
    mesh: TriangleMesh | None = None

    def _card(self) -> Card:
        east, north, up = self.center
        line = f"{self.name}, {self.kind}, {self.width:.4g} × {self.height:.4g} m, centre "
        return Card(f"{line}{east:.4g} m east, {north:.4g} m north, {up:.4g} m up")

    def __post_init__(self) -> None:
        kinds = ("planar", "convex_cylinder", "external_cylinder", "cavity", "mesh")
        if self.kind not in kinds:
            raise InputError(
                f"receiver {self.name}: unknown kind {self.kind!r}; known: {', '.join(kinds)}"
            )
        for name in ("width", "height"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(
                    f"receiver {self.name}: {name} must be above 0 and finite, not {value} m"
                )
        for name in ("radius", "opening_angle", "nominal_power"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise InputError(
                    f"receiver {self.name}: {name} must be 0 or more and finite, not {value}"
                )
        center = as_vectors(self.center, f"receiver {self.name}: center")
        object.__setattr__(self, "center", center)
        normal = normalize(self.normal, f"receiver {self.name}: normal")
        object.__setattr__(self, "normal", normal)
        self._check_mesh()

    def _check_mesh(self) -> None:
        if (self.kind in ("cavity", "mesh")) != (self.mesh is not None):
            wanted = "takes no mesh" if self.mesh is not None else "needs a mesh"
            raise InputError(f"receiver {self.name}: kind {self.kind} {wanted}")
        if self.kind != "cavity" or self.mesh is None:
            return
        front = float(self.mesh.vertices[:, 2].max())
        if front > _BEFORE:
            raise InputError(
                f"receiver {self.name}: its inner surface reaches {front:.3f} m in front of the "
                "aperture; the third coordinate of its vertices must be 0 or less"
            )
        if (np.sum(self.mesh.center * self.mesh.normal, axis=-1) >= 0.0).all():
            raise InputError(
                f"receiver {self.name}: no triangle of its inner surface faces the aperture; "
                "reverse the order of their vertices"
            )

    @property
    def frame(self) -> FloatArray:
        """Axes right, up (both as seen from the front) and outwards, as rows in ENU, (3, 3)."""
        return np.concatenate([self.aperture.axes, self.aperture.normal[None]])

    def point(self, right: float, up: float) -> FloatArray:
        """Return the point, ENU m, (3,), at a position on the unrolled surface.

        Parameters
        ----------
        right, up
            Lengths along the surface from its middle as seen from outside, m. The middle of a full
            cylinder is in the direction of its normal or, without a normal, north.

        Raises
        ------
        InputError
            If the position is not on the surface.
        """
        turns = {"convex_cylinder": self.opening_angle, "external_cylinder": 2.0 * np.pi}
        turn, radius = turns.get(self.kind, 0.0), self.radius or 0.5 * self.width
        half = 0.5 * (radius * turn if turn else self.width)
        for word, value, most in (("right", right, half), ("up", up, 0.5 * self.height)):
            if not abs(value) <= most + 1e-9:
                raise InputError(
                    f"receiver {self.name}: a point {value:g} m {word} of its centre is outside "
                    f"its surface; use at most {most:.4g} m"
                )
        if not turn:
            return self.aperture.point((right, up))
        full = self.kind == "external_cylinder"
        upright = np.array([0.0, 0.0, 1.0])
        if full:
            flat = np.array([*self.normal[:2], 0.0])
            front = normalize(flat) if np.linalg.norm(flat) > 1e-6 else np.array([0.0, 1.0, 0.0])
            axis, middle = upright, self.center
        else:
            front, axis = self.normal, normalize(upright - self.normal[2] * self.normal)
            middle = self.center - radius * front
        angle, side = right / radius, np.cross(axis, front)
        out = np.cos(angle) * front + np.sin(angle) * side
        return as_vectors(middle + radius * out + up * axis, "point")

    @cached_property
    def face(self) -> Target:
        """The aperture of a planar receiver, as a surface that a camera can see.

        Raises
        ------
        InputError
            If the receiver is of a different kind.
        """
        if self.kind != "planar":
            raise InputError(
                f"receiver {self.name} has no face: its kind is {self.kind.replace('_', ' ')}, and "
                "only planar receivers have one"
            )
        return self.aperture

    @cached_property
    def aperture(self) -> Target:
        """The flat rectangle with the receiver's width and height about its centre."""
        corners = self.corners
        if corners is None:
            # An aperture that faces straight up or down has no natural upper edge.
            level = np.cross([0.0, 0.0, 1.0], self.normal)
            steep = np.linalg.norm(level) < 1e-9
            right = np.array([1.0, 0.0, 0.0]) if steep else normalize(level)
            across, up = 0.5 * self.width * right, 0.5 * self.height * np.cross(self.normal, right)
            corners = self.center + np.stack([up - across, up + across, across - up, -up - across])
        return Target(self.name, corners, self.center)


def point_of(
    aim: str | Target | Receiver | npt.ArrayLike, targets: Sequence[Target] = ()
) -> FloatArray:
    """Return an aim point, ENU metres, (3,) or (N, 3).

    Parameters
    ----------
    aim
        Name of one of the targets, a target or receiver (its centre), or points.
    targets
        Targets that may be named.

    Raises
    ------
    UnknownNameError
        If there is no such target.
    """
    if isinstance(aim, Target | Receiver):
        return aim.center
    if isinstance(aim, str):
        for target in targets:
            if target.name == aim:
                return target.center
        raise UnknownNameError("target", aim, [target.name for target in targets])
    return as_vectors(aim, "aim")
