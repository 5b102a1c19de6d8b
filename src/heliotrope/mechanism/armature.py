"""The armature: all that tracking needs to know about a mechanism, in 18 numbers.

Whatever its fixed imperfections, a two-axis chain rotates a vertex and a normal about two lines in
space. Grigoriev et al. 2021 call this reduced form the armature. A local controller stores only the
armature and needs no error model.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.frames import ENU, Framed, Labelled, Variable, batched
from heliotrope.geometry import FloatArray, as_vectors, normalize, rotation
from heliotrope.mechanism.kernels import slots as slot
from heliotrope.values import Card, Value, card_of_arrays


@dataclass(frozen=True, eq=False, repr=False)
class Armature(Value, Framed):
    """Two axes with a point on each, the mirror vertex and the mirror normal, at zero joint angles.

    Attributes
    ----------
    table
        Shape (..., 18): primary axis, point on the primary axis, secondary axis, point on the
        secondary axis, vertex, normal; ENU, metres. A secondary axis of zero length means a
        single-axis tracker.
    """

    table: FloatArray

    def _card(self) -> Card:
        return card_of_arrays(self)

    def _labelled(self) -> Labelled:
        units = {"origin_1": "m", "origin_2": "m", "vertex": "m"}
        names = ("axis_1", "origin_1", "axis_2", "origin_2", "vertex", "normal")
        own = {n: Variable(("axis",), getattr(self, n), units.get(n, "")) for n in names}
        return batched(self.shape, own, {"axis": ENU})

    @classmethod
    def of(
        cls,
        axis_1: npt.ArrayLike,
        origin_1: npt.ArrayLike,
        axis_2: npt.ArrayLike,
        origin_2: npt.ArrayLike,
        vertex: npt.ArrayLike,
        normal: npt.ArrayLike,
    ) -> "Armature":
        """Build an armature from its six vectors (..., 3), ENU, m; directions may have any length.

        Raises
        ------
        InputError
            If an axis or the normal is zero, or the axes are parallel.
        """
        a1, a2 = normalize(axis_1, "axis_1"), normalize(axis_2, "axis_2")
        check_axes(a1, a2)
        parts = np.broadcast_arrays(
            a1,
            as_vectors(origin_1, "origin_1"),
            a2,
            as_vectors(origin_2, "origin_2"),
            as_vectors(vertex, "vertex"),
            normalize(normal, "normal"),
        )
        return cls(np.concatenate(parts, axis=-1))

    @property
    def shape(self) -> tuple[int, ...]:
        """The batch shape."""
        return self.table.shape[:-1]

    @property
    def axis_1(self) -> FloatArray:
        """Primary axis, (..., 3)."""
        return self.table[..., slot.AXIS_1 : slot.AXIS_1 + 3]

    @property
    def origin_1(self) -> FloatArray:
        """A point on the primary axis, (..., 3)."""
        return self.table[..., slot.ORIGIN_1 : slot.ORIGIN_1 + 3]

    @property
    def axis_2(self) -> FloatArray:
        """Secondary axis at zero primary angle, (..., 3)."""
        return self.table[..., slot.AXIS_2 : slot.AXIS_2 + 3]

    @property
    def origin_2(self) -> FloatArray:
        """A point on the secondary axis at zero primary angle, (..., 3)."""
        return self.table[..., slot.ORIGIN_2 : slot.ORIGIN_2 + 3]

    @property
    def vertex(self) -> FloatArray:
        """Vertex at zero angles, (..., 3)."""
        return self.table[..., slot.VERTEX : slot.VERTEX + 3]

    @property
    def normal(self) -> FloatArray:
        """Normal at zero angles, (..., 3)."""
        return self.table[..., slot.NORMAL : slot.NORMAL + 3]

    def pose(self, angles: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the normal and the vertex, each (..., 3), at joint angles (..., 2) in radians."""
        theta = np.asarray(angles, dtype=np.float64)
        first = rotation(self.axis_1, theta[..., 0])
        second = rotation(self.axis_2, theta[..., 1])

        def turned(matrix: FloatArray, vector: FloatArray) -> FloatArray:
            return np.asarray(np.einsum("...ij,...j->...i", matrix, vector))

        normal = turned(first, turned(second, self.normal))
        arm = self.origin_2 - self.origin_1 + turned(second, self.vertex - self.origin_2)
        return normal, self.origin_1 + turned(first, arm)


#: Smallest angle between the axes, rad; parallel axes give only one degree of freedom.
PARALLEL_LIMIT = 1e-3


def check_axes(axis_1: FloatArray, axis_2: FloatArray) -> None:
    """Reject parallel axes.

    Raises
    ------
    InputError
        If the angle between the axes is below 1 mrad.
    """
    sine = np.linalg.norm(np.cross(axis_1, axis_2), axis=-1)
    if (sine < PARALLEL_LIMIT).any():
        raise InputError(
            f"the two axes enclose {1e3 * float(sine.min()):.3g} mrad, so they are parallel; "
            f"they must enclose at least {1e3 * PARALLEL_LIMIT:g} mrad"
        )
