"""A mechanism as data: a chain of joints from the ground to the mirror, two of them driven."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import EllipsisType
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, UnknownNameError, kind_of
from heliotrope.frames import ENU, Framed, Labelled, Variable, batch_rows, batched
from heliotrope.geometry import TAU, FloatArray, as_angles, as_numbers, rotation
from heliotrope.jit import as_input
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.kernels import slots as slot
from heliotrope.mechanism.kernels.chain import armature_block, jacobian_block, pose_block
from heliotrope.mechanism.parameters import Parameter
from heliotrope.parallel import run_blocks
from heliotrope.values import Card, Value, card_of_arrays, dots, span

#: Largest deviation of a length, m (a larger number is probably in millimetres), and of a ratio.
_FARTHEST, _LARGEST = 1000.0, 1e6
#: Valid index of a mechanism.
Index = (
    int
    | slice
    | EllipsisType
    | None
    | tuple[int | slice | EllipsisType, ...]
    | npt.NDArray[np.intp]
)


@dataclass(frozen=True, eq=False, repr=False)
class Pose(Value, Framed):
    """Mirror normals and vertices.

    Attributes
    ----------
    normal
        Unit normals in ENU, shape (..., 3).
    vertex
        Vertices in ENU metres, shape (..., 3).
    """

    normal: FloatArray
    vertex: FloatArray

    def _card(self) -> Card:
        return card_of_arrays(self)

    def _labelled(self) -> Labelled:
        own = {
            "normal": Variable(("axis",), self.normal),
            "vertex": Variable(("axis",), self.vertex, "m"),
        }
        return batched(self.normal.shape[:-1], own, {"axis": ENU})


@dataclass(frozen=True, eq=False, repr=False)
class Jacobian(Value, Framed):
    """A pose with its derivatives with respect to P parameters and the counts of D drives.

    Attributes
    ----------
    pose
        Normal and vertex.
    names
        Names of the P parameters, in order.
    normal, vertex
        Derivatives with respect to the parameters, shape (..., P, 3), per rad, m or 1.
    normal_counts, vertex_counts
        Derivatives with respect to the counts, shape (..., D, 3).
    """

    pose: Pose
    names: tuple[str, ...]
    normal: FloatArray
    vertex: FloatArray
    normal_counts: FloatArray
    vertex_counts: FloatArray

    def _card(self) -> Card:
        return card_of_arrays(self)

    def _labelled(self) -> Labelled:
        by = [parameter_table.unit_of(name) for name in self.names]

        def derived(values: FloatArray, axis: str, unit: str | tuple[str, ...]) -> Variable:
            return Variable(("axis", axis), np.swapaxes(values, -1, -2), unit)

        normal = tuple(f"1/{unit}" if unit else "" for unit in by)
        vertex = tuple({"": "m", "m": ""}.get(unit, f"m/{unit}") for unit in by)
        own = {
            "normal": Variable(("axis",), self.pose.normal),
            "vertex": Variable(("axis",), self.pose.vertex, "m"),
            "normal_by": derived(self.normal, "parameter", normal),
            "vertex_by": derived(self.vertex, "parameter", vertex),
            "normal_by_count": derived(self.normal_counts, "drive", ""),
            "vertex_by_count": derived(self.vertex_counts, "drive", "m"),
        }
        drives = np.arange(1, self.normal_counts.shape[-2] + 1)
        labels: dict[str, npt.ArrayLike] = {"axis": ENU, "parameter": self.names, "drive": drives}
        return batched(self.pose.normal.shape[:-1], own, labels)


@runtime_checkable
class Calibrated(Protocol):
    """Parameter deviations from a nominal mechanism, as found in a fit, a record or a file."""

    @property
    def parameters(self) -> Mapping[str, npt.ArrayLike]:
        """Deviations by parameter name, in rad, m or 1, each of shape () or (N,)."""

    @property
    def heliostats(self) -> tuple[str, ...]:
        """Names of the heliostats, (N,); () if unknown."""


def check_calibration(calibration: object) -> None:
    """Raise an error if a value does not contain parameter deviations.

    Raises
    ------
    InputError
        If the value is neither a fit nor a record.
    """
    if not isinstance(calibration, Calibrated):
        raise InputError(
            f"calibration: {kind_of(calibration)}; pass the result of fit or a "
            "HeliostatCalibration, or pass values by name to with_parameters"
        )


@dataclass(frozen=True, eq=False, repr=False)
class Mechanism(Value, Framed):
    """One mechanism, or an array of mechanisms of one kind; batch shape (...).

    Build one with a function of `heliotrope.mechanism.kinds`.

    Attributes
    ----------
    kind
        Name of the builder, for example "azimuth_elevation".
    joints
        Names of the J joints from ground to mirror.
    driven
        Indices of the D driven joints (two, or one for a single-axis tracker).
    position
        Foot of the chain in ENU metres, (..., 3).
    orientation
        Rotation from the first frame of the chain to ENU, (..., 3, 3).
    axes, origins
        Unit axis and origin (m) of each joint in the frame of its parent, (..., J, 3).
    angles
        Fixed part of each joint angle, rad, (..., J).
    drives
        Drives, batch shape (..., D).
    vertex, normal
        Mirror vertex (m) and unit normal in the mirror frame, (..., 3).
    deviations
        Accumulated deviations of the parameters, by name, as set by `with_parameters` and
        `with_calibration`, rad, m or 1, each (...).
    own
        Table entries of fixed joints that the parameter table does not list; see
        `kinds.with_joint`.
    """

    kind: str
    joints: tuple[str, ...]
    driven: tuple[int, ...]
    position: FloatArray
    orientation: FloatArray
    axes: FloatArray
    origins: FloatArray
    angles: FloatArray
    drives: Drive
    vertex: FloatArray
    normal: FloatArray
    deviations: Mapping[str, FloatArray] = field(default_factory=dict)
    own: tuple[Parameter, ...] = ()

    def _card(self) -> Card:
        joints = [self.joints[k] for k in self.driven]
        drives = [self.drives[d] for d in range(len(joints))]
        parts = ", ".join(f"{j} ({d.kinds})" for j, d in zip(joints, drives, strict=True))
        rows = [
            (name, f"{span(self.position[..., k])} m")
            for k, name in enumerate(("east", "north", "up"))
        ]
        rows += [(j, d.describe()) for j, d in zip(joints, drives, strict=True)]
        size = "one" if not self.shape else " × ".join(map(str, self.shape))
        return Card(
            f"{size} {self.kind}: {parts}",
            ("part", "value"),
            rows,
            dots(self.position[..., 0], self.position[..., 1], "map") if self.shape else "",
        )

    def _labelled(self) -> Labelled:
        labels = batch_rows(self.shape)
        rows = tuple(labels)

        def of(array: FloatArray, *axes: str, unit: str = "") -> Variable:
            return Variable((*rows, *axes), array if self.shape else array[None], unit)

        drives = self.drives if self.shape else Drive(self.drives.table[None])
        variables = {
            "position": of(self.position, "axis", unit="m"),
            "vertex": of(self.vertex, "mirror_axis", unit="m"),
            "normal": of(self.normal, "mirror_axis"),
            "orientation": of(self.orientation, "axis", "own_axis"),
            "joint_axis": of(self.axes, "joint", "own_axis"),
            "origin": of(self.origins, "joint", "own_axis", unit="m"),
            "angle": of(self.angles, "joint", unit="rad"),
        }
        for name, variable in drives.variables((*rows, "drive")).items():
            variables[f"drive_{name}"] = variable
        for name, values in self.deviations.items():
            variables[f"deviation_{name}"] = of(
                np.asarray(values), unit=self.parameter(name).unit.strip("1")
            )
        labels |= {
            "axis": ENU,
            "own_axis": ("x", "y", "z"),
            "mirror_axis": ("x", "y", "z"),
            "joint": self.joints,
            "drive": [self.joints[k] for k in self.driven],
        }
        large = frozenset({"orientation", "joint_axis", "origin", "angle"})
        return Labelled(rows, labels, variables, large, {"kind": self.kind})

    @property
    def shape(self) -> tuple[int, ...]:
        """The batch shape."""
        return self.position.shape[:-1]

    def __len__(self) -> int:
        if not self.shape:
            raise TypeError("a single mechanism has no length")
        return self.shape[0]

    def __getitem__(self, index: Index) -> "Mechanism":
        """Return the mechanisms at ``index`` of the batch axes; an index None adds an axis."""
        if not self.shape and index is not None:
            raise InputError("a single mechanism cannot be indexed")
        return replace(
            self,
            position=self.position[index],
            orientation=self.orientation[index],
            axes=self.axes[index],
            origins=self.origins[index],
            angles=self.angles[index],
            drives=Drive(self.drives.table[index]),
            vertex=self.vertex[index],
            normal=self.normal[index],
            deviations={name: np.asarray(v[index]) for name, v in self.deviations.items()},
        )

    @cached_property
    def parameters(self) -> dict[str, Parameter]:
        """The parameter table of this kind of mechanism, by name."""
        kinds = self.drives.table[..., slot.KIND].reshape(-1, len(self.driven))
        linear = tuple(bool((kinds[:, d] == slot.LINEAR).all()) for d in range(kinds.shape[1]))
        table = parameter_table.table(self.joints, self.driven, linear)
        for row in self.own:
            code = (slot.MOVES_JOINT, self.joints.index(row.name), 0)
            table[row.name] = replace(row, code=code)
        return table

    def parameter(self, name: str) -> Parameter:
        """Return the table entry of the parameter ``name``.

        Raises
        ------
        UnknownNameError
            If this kind of mechanism has no such parameter.
        """
        try:
            return self.parameters[name]
        except KeyError:
            raise UnknownNameError(
                f"parameter of a {self.kind} mechanism", name, self.parameters
            ) from None

    def codes(self, names: tuple[str, ...]) -> npt.NDArray[np.int64]:
        """Return the kernel code of each parameter, shape (P, 3)."""
        rows = [self.parameter(name).code for name in names]
        return np.array(rows, dtype=np.int64).reshape(-1, 3)

    def with_parameters(self, values: Mapping[str, npt.ArrayLike]) -> "Mechanism":
        """Return the mechanism with its parameters moved by ``values``.

        Parameters
        ----------
        values
            Deviation from this mechanism by parameter name, in rad, m or 1; shape (...) or anything
            that broadcasts to it.

        Raises
        ------
        UnknownNameError
            If a name is not in the table.
        InputError
            If a value is not a number, is not an angle in radians, or does not fit the shape.
        """
        position, origins = self.position.copy(), self.origins.copy()
        angles, vertex = self.angles.copy(), self.vertex.copy()
        table = self.drives.table.copy()
        carried = dict(self.deviations)
        for name, value in values.items():
            delta = self._deviation(name, value)
            what, index, sub = self.parameter(name).code
            if what == slot.MOVES_JOINT:
                angles[..., index] += delta
            elif what == slot.MOVES_DRIVE:
                table[..., index, sub] += delta
            elif what == slot.MOVES_POSITION:
                position[..., sub] += delta
            elif what == slot.MOVES_ORIGIN:
                origins[..., index, sub] += delta
            elif what == slot.MOVES_VERTEX:
                vertex[..., sub] += delta
            else:
                vertex += delta[..., None] * self.normal
            carried[name] = carried.get(name, 0.0) + delta
        return replace(
            self,
            position=position,
            origins=origins,
            angles=angles,
            vertex=vertex,
            drives=Drive(table),
            deviations=carried,
        )

    def with_calibration(self, calibration: Calibrated) -> "Mechanism":
        """Return the mechanism moved by a calibration, for example by the result of `fit`.

        A calibration of one heliostat applies to every mechanism in the array; a calibration of N
        heliostats applies to N mechanisms, one by one. A heliostat or a heliostat group of a plant
        selects its entries by name.

        Raises
        ------
        InputError
            If the value is not a calibration, or contains a different number of heliostats.
        UnknownNameError
            If this kind of mechanism lacks one of its parameters.
        """
        check_calibration(calibration)
        moved = {}
        for name, values in calibration.parameters.items():
            value = np.asarray(values)
            if value.size != 1 and value.shape != self.shape:
                raise InputError(
                    f"calibration of {value.size} heliostats: the mechanisms have shape "
                    f"{self.shape}; select one heliostat (fitted[name]), or apply it by name "
                    "(plant[name].with_calibration)"
                )
            moved[name] = value.reshape(()) if value.size == 1 else value
        return self.with_parameters(moved)

    def most(self, name: str) -> float:
        """Return a parameter's largest allowed deviation in either direction, in rad, m or 1."""
        row = self.parameter(name)
        if row.unit != "rad":
            return _FARTHEST if row.unit == "m" else _LARGEST
        # No pedestal leans by a right angle, but the zero of a drive may be off by a full turn.
        return 0.5 * np.pi if row.code[0] == slot.MOVES_JOINT else TAU

    def _deviation(self, name: str, value: npt.ArrayLike) -> FloatArray:
        """Return the checked deviation of one parameter."""
        row, label = self.parameter(name), f"parameter {name}"
        if row.unit == "rad":
            delta = as_angles(value, label, self.most(name))
        else:
            most, metres = self.most(name), row.unit == "m"
            unit = ("m", "give metres") if metres else ()
            delta = as_numbers(value, label, -most, most, *unit)
        try:
            return np.broadcast_to(delta, self.shape)
        except ValueError:
            raise InputError(
                f"{label}: shape {delta.shape} does not fit mechanisms of shape {self.shape}; pass "
                "one number, or one per mechanism"
            ) from None

    def pose(self, counts: npt.ArrayLike) -> Pose:
        """Return normals and vertices at the given drive counts.

        Parameters
        ----------
        counts
            Drive counts, shape (..., D); their batch axes broadcast against the mechanism's batch
            axes.
        """
        flat, rows, shape = self._flatten(counts)
        normal, vertex = np.empty((len(rows), 3)), np.empty((len(rows), 3))
        arrays = self.kernel_arrays
        run_blocks(lambda a, b: pose_block(*arrays, flat, rows, normal, vertex, a, b), len(rows))
        return Pose(normal.reshape(*shape, 3), vertex.reshape(*shape, 3))

    def jacobian(self, counts: npt.ArrayLike, names: tuple[str, ...]) -> Jacobian:
        """Return the pose and its derivatives with respect to parameters and counts.

        Parameters
        ----------
        counts
            Drive counts, shape (..., D); their batch axes broadcast against the mechanism's batch
            axes.
        names
            Names of P parameters of the table.

        Notes
        -----
        This is the screw formula: rotating a joint by a small angle changes the normal at the rate
        w × n and the vertex at the rate w × (m − o). The formula is exact wherever the chain itself
        is differentiable, that is, in every pose except that of a fully extended jack.
        """
        flat, rows, shape = self._flatten(counts)
        codes = self.codes(names)
        m, p, d = len(rows), len(names), len(self.driven)
        n, v = np.empty((m, 3)), np.empty((m, 3))
        dn, dv = np.empty((m, p, 3)), np.empty((m, p, 3))
        dn_counts, dv_counts = np.empty((m, d, 3)), np.empty((m, d, 3))
        arrays = self.kernel_arrays
        run_blocks(
            lambda a, b: jacobian_block(
                *arrays, flat, rows, codes, n, v, dn, dv, dn_counts, dv_counts, a, b
            ),
            m,
        )
        return Jacobian(
            Pose(n.reshape(*shape, 3), v.reshape(*shape, 3)),
            names,
            dn.reshape(*shape, p, 3),
            dv.reshape(*shape, p, 3),
            dn_counts.reshape(*shape, d, 3),
            dv_counts.reshape(*shape, d, 3),
        )

    @cached_property
    def armature(self) -> Armature:
        """The reduction to two axes, two points, vertex and normal (Grigoriev's armature)."""
        position, orientation, axes, origins, angles, _, driven, vertex, normal = self.kernel_arrays
        table = np.zeros((len(position), slot.ARMATURE_SIZE))
        run_blocks(
            lambda a, b: armature_block(
                position, orientation, axes, origins, angles, driven, vertex, normal, table, a, b
            ),
            len(table),
        )
        return Armature(table.reshape(*self.shape, slot.ARMATURE_SIZE))

    @cached_property
    def attachment(self) -> FloatArray:
        """Transform from the heliostat frame to ENU for points fixed to the mirror, (..., 4, 4).

        The transform maps a point that is specified in the heliostat frame at zero joint angles of
        the mechanism as designed. The transform combines ``position`` and ``orientation``
        (Grigoriev et al. 2021, (5)) with the displacement caused by all deviations between the foot
        and the last driven joint, because that joint carries the point.
        """
        designed = self.with_parameters({name: -v for name, v in self.deviations.items()})
        frame = _transformation(designed.orientation, designed.position)
        if not self.deviations:
            return frame
        return np.asarray(_carrier(self) @ np.linalg.inv(_carrier(designed)) @ frame)

    @cached_property
    def kernel_arrays(self) -> tuple[np.ndarray, ...]:
        """The arrays that the compiled kernels read, with a single batch axis (N, …)."""
        joints, drives = len(self.joints), len(self.driven)

        def flat(array: FloatArray, *tail: int) -> FloatArray:
            return as_input(array).reshape(-1, *tail)

        return (
            flat(self.position, 3),
            flat(self.orientation, 3, 3),
            flat(self.axes, joints, 3),
            flat(self.origins, joints, 3),
            flat(self.angles, joints),
            flat(self.drives.table, drives, slot.DRIVE_SLOTS),
            np.array(self.driven, dtype=np.int64),
            flat(self.vertex, 3),
            flat(self.normal, 3),
        )

    def _flatten(
        self, counts: npt.ArrayLike
    ) -> tuple[FloatArray, npt.NDArray[np.intp], tuple[int, ...]]:
        """Return counts (M, D), the mechanism index of each row, (M,), and the batch shape."""
        array, drives = as_numbers(counts, "counts"), len(self.driven)
        if array.ndim == 0 or array.shape[-1] != drives:
            raise InputError(
                f"counts: shape {array.shape}; the last axis must hold the {drives} drives"
            )
        if not np.isfinite(array).all():
            raise InputError("counts: a value is not finite; pass the motor positions")
        try:
            shape = np.broadcast_shapes(self.shape, array.shape[:-1])
        except ValueError:
            raise InputError(
                f"counts: shape {array.shape[:-1]} does not fit mechanisms of shape {self.shape}"
            ) from None
        index = np.arange(int(np.prod(self.shape, dtype=np.int64))).reshape(self.shape)
        rows = as_input(np.broadcast_to(index, shape)).reshape(-1)
        flat = as_input(np.broadcast_to(array, (*shape, drives)))
        return flat.reshape(-1, drives), rows, shape


def _transformation(turned: FloatArray, at: FloatArray) -> FloatArray:
    """Return rotations (..., 3, 3) and points (..., 3) combined into matrices (..., 4, 4)."""
    frame = np.zeros((*at.shape[:-1], 4, 4))
    frame[..., :3, :3], frame[..., :3, 3], frame[..., 3, 3] = turned, at, 1.0
    return frame


def _carrier(mechanism: Mechanism) -> FloatArray:
    """Return the transform to ENU from the frame beyond the last driven joint, (..., 4, 4).

    It holds at zero joint angles.
    """
    turned, at = mechanism.orientation, mechanism.position
    for j in range(max(mechanism.driven) + 1):
        at = at + np.einsum("...ij,...j->...i", turned, mechanism.origins[..., j, :])
        turned = turned @ rotation(mechanism.axes[..., j, :], mechanism.angles[..., j])
    return _transformation(turned, at)


def join_mechanisms(parts: Sequence[Mechanism]) -> Mechanism:
    """Join mechanisms of one kind, each of batch shape (n,), into an array of shape (N,).

    Raises
    ------
    InputError
        If there are no mechanisms, or they are of different kinds.
    """
    kinds = sorted({part.kind for part in parts})
    if len({(part.kind, part.joints, part.driven) for part in parts}) != 1:
        raise InputError(
            f"mechanisms of {', '.join(kinds) or 'no kind'} cannot be joined; join mechanisms of "
            "one kind, such as a group of the plant (plant.groups)"
        )

    carried = dict.fromkeys(name for part in parts for name in part.deviations)
    return replace(
        parts[0],
        position=np.concatenate([part.position for part in parts]),
        orientation=np.concatenate([part.orientation for part in parts]),
        axes=np.concatenate([part.axes for part in parts]),
        origins=np.concatenate([part.origins for part in parts]),
        angles=np.concatenate([part.angles for part in parts]),
        vertex=np.concatenate([part.vertex for part in parts]),
        normal=np.concatenate([part.normal for part in parts]),
        drives=Drive(np.concatenate([part.drives.table for part in parts])),
        deviations={
            name: np.concatenate([p.deviations.get(name, np.zeros(p.shape)) for p in parts])
            for name in carried
        },
    )
