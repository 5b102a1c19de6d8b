"""Heliostats of one kind, stored as arrays."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.mirror_surface import FacetGrid, MirrorSurface
from heliotrope.files.cells import check_names
from heliotrope.frames import ENU, Framed, Labelled, Variable
from heliotrope.geometry import FloatArray, as_float, normalize
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.chain import Calibrated, Mechanism, check_calibration
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.machine import Machine
from heliotrope.mechanism.parameters import unit_of
from heliotrope.values import Card, Value, amount, card_of_arrays, dots, span


@dataclass(frozen=True, eq=False, repr=False)
class Facets(Value):
    """F facets of each of N heliostats, in the mirror frame (x right, y up, z outwards).

    Attributes
    ----------
    center
        Centres of the facets relative to the mirror vertex, m, (N, F, 3).
    half_width, half_height
        Vectors from the centre of a facet to the midpoints of its right edge and its upper edge, m,
        (N, F, 3); their cross product is along the facet normal.
    grid
        The grid from which the facets were made, with its canting; None: each facet is specified
        individually.
    """

    center: FloatArray
    half_width: FloatArray
    half_height: FloatArray
    grid: FacetGrid | None = None

    def __post_init__(self) -> None:
        shapes = {a.shape for a in (self.center, self.half_width, self.half_height)}
        if len(shapes) != 1 or self.center.ndim != 3 or self.center.shape[-1] != 3:
            raise InputError(f"facets: shapes {sorted(shapes)} must all be (N, F, 3)")

    def _card(self) -> Card:
        return card_of_arrays(self)

    @classmethod
    def of(
        cls,
        center: FloatArray,
        half: FloatArray,
        tilt: FloatArray,
        grid: FacetGrid | None = None,
    ) -> Self:
        """Return facets whose centres lie in the plane of the mirror.

        Parameters
        ----------
        center, half
            Centres and half sizes, right and up, m, (N, F, 2).
        tilt
            Canting: x and y components of the facets' normals, whose z is near 1, rad, (N, F, 2).
        grid
            As for the attribute.
        """
        level = np.zeros_like(center[..., :1])
        normal = normalize(np.concatenate([tilt, level + 1.0], axis=-1), "facets: normal")
        right = normalize(np.cross([0.0, 1.0, 0.0], normal), "facets: right")
        up = np.cross(normal, right)
        middle = np.concatenate([center, level], axis=-1)
        return cls(middle, half[..., :1] * right, half[..., 1:] * up, grid)

    @cached_property
    def axes(self) -> FloatArray:
        """Unit axes right, up and outwards of each facet, as rows, (N, F, 3, 3)."""
        right = normalize(self.half_width, "facets: half width")
        out = normalize(np.cross(self.half_width, self.half_height), "facets: normal")
        return np.stack([right, np.cross(out, right), out], axis=-2)

    @cached_property
    def half_size(self) -> FloatArray:
        """Half the width and half the height of each facet, m, (N, F, 2)."""
        up = np.sum(self.half_height * self.axes[..., 1, :], axis=-1)
        return np.stack([np.linalg.norm(self.half_width, axis=-1), up], axis=-1)

    @property
    def tilt(self) -> FloatArray:
        """Canting: x and y components of each facet's normal, scaled to z = 1, (N, F, 2)."""
        out = self.axes[..., 2, :]
        return as_float(out[..., :2] / out[..., 2:])

    def take(self, index: npt.NDArray[np.intp]) -> "Facets":
        """Return the facets of some of the mirrors."""
        grid = self.grid
        if grid is not None:
            grid = replace(grid, canting=grid.canting.take(index))
        return Facets(self.center[index], self.half_width[index], self.half_height[index], grid)


@dataclass(frozen=True, eq=False, repr=False)
class Heliostats(Value, Framed):
    """N heliostats of one kind.

    Attributes
    ----------
    names
        Unique.
    mechanism
        Nominal mechanisms, batch shape (N,), in ENU metres about the reference point of the plant.
    width, height
        Size of the mirror, m, (N,).
    facets
        Facets of the mirrors, if known.
    parameters
        Calibrated deviations from the nominal mechanism, by parameter name, in rad, m or 1,
        each (N,).
    aim
        Aim points in operation, ENU metres, (N, 3); NaN if not specified.
    cluster
        Name of each heliostat's cluster; empty if it has none.
    machines
        Motor limits and rest positions of each heliostat, or () if the plant file does not specify
        them.
    surface
        Curvature, errors and measured slopes of the mirrors, if known.
    """

    names: tuple[str, ...]
    mechanism: Mechanism
    width: FloatArray
    height: FloatArray
    facets: Facets | None = None
    parameters: Mapping[str, FloatArray] = field(default_factory=dict)
    aim: FloatArray | None = None
    cluster: tuple[str, ...] = ()
    machines: tuple[Machine, ...] = ()
    surface: MirrorSurface | None = None

    def __post_init__(self) -> None:
        count = len(self.names)
        if self.mechanism.shape != (count,):
            raise InputError(
                f"heliostats: {count} names but mechanisms of shape {self.mechanism.shape}"
            )
        check_names("heliostat", self.names)
        for what in ("width", "height"):
            values = np.broadcast_to(as_float(getattr(self, what)), (count,))
            invalid = ~(np.isfinite(values) & (values > 0))
            if invalid.any():
                i = int(np.flatnonzero(invalid)[0])
                raise InputError(
                    f"heliostat {self.names[i]}: {what} must be above 0, not {values[i]} m"
                )
            object.__setattr__(self, what, values)
        clean = {}
        for name, parameter in self.parameters.items():
            self.mechanism.parameter(name)
            values = np.array(np.broadcast_to(as_float(parameter), (count,)))
            if not np.isfinite(values).all():
                i = int(np.flatnonzero(~np.isfinite(values))[0])
                raise InputError(
                    f"heliostat {self.names[i]}: parameter {name} must be a number, not {values[i]}"
                )
            clean[name] = values
        object.__setattr__(self, "parameters", clean)
        if self.cluster and len(self.cluster) != count:
            raise InputError(
                f"heliostats: got {len(self.cluster)} cluster names for {count} heliostats; "
                "specify one per heliostat"
            )
        if self.machines and len(self.machines) != count:
            raise InputError(
                f"heliostats: got {len(self.machines)} machines for {count} heliostats; specify "
                "one per heliostat"
            )
        if self.aim is not None and self.aim.shape != (count, 3):
            raise InputError(
                f"heliostats: aim has the shape {self.aim.shape}; expected ({count}, 3)"
            )
        if self.facets is not None and len(self.facets.center) != count:
            raise InputError(
                f"heliostats: got {len(self.facets.center)} rows of facets for {count} heliostats; "
                "specify one per heliostat"
            )
        if self.surface is not None:
            facets = 1 if self.facets is None else self.facets.center.shape[1]
            self.surface.check(self.names, facets)

    def check_facets(self) -> None:
        """Check that every facet lies on its mirror.

        Raises
        ------
        InputError
            If a facet does not lie on its mirror; the message names the heliostat and the facet.
        """
        if self.facets is None:
            return
        reach = np.abs(self.facets.center[..., :2]) + self.facets.half_size
        half = 0.5 * np.stack([self.width, self.height], axis=-1)
        outside = (reach > half[:, None] * 1.001 + 1e-3).any(axis=-1)
        if outside.any():
            i, k = np.argwhere(outside)[0].tolist()
            right, up = reach[i, k]
            raise InputError(
                f"heliostat {self.names[i]}: facet {k} reaches {right:.3f} m to a side and "
                f"{up:.3f} m up or down from the middle, but the mirror is {self.width[i]:.3f} × "
                f"{self.height[i]:.3f} m; correct one of them"
            )

    def _card(self) -> Card:
        count = len(self.parameters)
        state = amount(count, "calibrated parameter") if count else "nominal"
        line = f"{amount(len(self), self.mechanism.kind + ' heliostat')}, {self.mirror}, {state}"
        places = self.position
        rows = [
            (name, *(f"{x:.2f}" for x in places[i]), f"{self.width[i]:.3g} × {self.height[i]:.3g}")
            for i, name in enumerate(self.names)
        ]
        header = ("heliostat", "east, m", "north, m", "up, m", "mirror, m")
        return Card(line, header, rows, dots(places[:, 0], places[:, 1], "map"))

    def _labelled(self) -> Labelled:
        return self.labelled()

    def labelled(self) -> Labelled:
        """Return the arrays with their axes; a single heliostat's data frame uses them too."""
        row = ("heliostat",)
        variables = {
            "position": Variable((*row, "axis"), self.position, "m"),
            "width": Variable(row, self.width, "m"),
            "height": Variable(row, self.height, "m"),
        }
        if self.aim is not None:
            variables["aim"] = Variable((*row, "axis"), self.aim, "m")
        if self.cluster:
            variables["cluster"] = Variable(row, np.array(self.cluster, dtype=str))
        for name, values in self.parameters.items():
            # One of them is called position_north, like a column of the position.
            variables[f"deviation_{name}"] = Variable(row, values, unit_of(name))
        labels = {"heliostat": self.names, "axis": ENU}
        return Labelled(row, labels, variables, notes={"kind": self.mechanism.kind})

    @property
    def mirror(self) -> str:
        """Sizes of the mirrors in words, such as "1.83 × 1.22 m"."""
        return f"{span(self.width)} × {span(self.height)} m"

    def __len__(self) -> int:
        return len(self.names)

    @property
    def position(self) -> FloatArray:
        """Nominal positions, ENU metres, (N, 3)."""
        return self.mechanism.position

    @cached_property
    def calibrated(self) -> Mechanism:
        """The mechanisms with the calibrated deviations applied."""
        return self.mechanism.with_parameters(self.parameters)

    @property
    def deviations(self) -> Mapping[str, FloatArray]:
        """Deviations of the calibrated mechanisms, by name, rad, m or 1, each (N,)."""
        return self.calibrated.deviations

    @property
    def armature(self) -> Armature:
        """Armatures of the calibrated mechanisms, (N,)."""
        return self.calibrated.armature

    @property
    def drives(self) -> Drive:
        """Drives of the calibrated mechanisms, (N, D)."""
        return self.calibrated.drives

    @property
    def attachment(self) -> FloatArray:
        """Attachments of the calibrated mechanisms, (N, 4, 4); see `Mechanism.attachment`."""
        return self.calibrated.attachment

    def own_aim(self, row: int) -> FloatArray | None:
        """Return the aim point of the heliostat at an index, ENU metres, (3,); None if not set."""
        if self.aim is None or not np.isfinite(self.aim[row]).all():
            return None
        return np.asarray(self.aim[row])

    @cached_property
    def _index(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.names)}

    def index(self, name: str) -> int:
        """Return the index of heliostat ``name``.

        Raises
        ------
        UnknownNameError
            If there is no heliostat of that name.
        """
        try:
            return self._index[name]
        except KeyError:
            raise UnknownNameError("heliostat", name, self.names) from None

    def take(self, rows: npt.ArrayLike) -> "Heliostats":
        """Return the heliostats at indices ``rows`` (or a mask), in that order."""
        index = np.asarray(rows)
        if index.dtype == bool:
            index = np.flatnonzero(index)
        index = index.reshape(-1).astype(np.intp)
        outside = (index < -len(self)) | (index >= len(self))
        if outside.any():
            raise InputError(
                f"rows: there is no row {index[outside][0]}; rows run from 0 to {len(self) - 1}"
            )
        return replace(
            self,
            names=tuple(self.names[i] for i in index),
            mechanism=self.mechanism[index],
            width=self.width[index],
            height=self.height[index],
            facets=None if self.facets is None else self.facets.take(index),
            surface=None if self.surface is None else self.surface.take(index),
            parameters={name: values[index] for name, values in self.parameters.items()},
            aim=None if self.aim is None else self.aim[index],
            cluster=tuple(self.cluster[i] for i in index) if self.cluster else (),
            machines=tuple(self.machines[i] for i in index) if self.machines else (),
        )

    def with_parameters(self, parameters: Mapping[str, npt.ArrayLike]) -> "Heliostats":
        """Return the heliostats with the calibrated deviations replaced by ``parameters``."""
        return replace(self, parameters={n: as_float(v) for n, v in parameters.items()})

    def with_calibration(self, calibration: Calibrated) -> "Heliostats":
        """Return the heliostats with their own deviations replaced by those of a calibration.

        Heliostats that the calibration does not include keep their deviations. A calibration
        without names must contain a single entry for all heliostats, or one entry per heliostat.

        Raises
        ------
        InputError
            If the argument is not a calibration, or has neither names nor the right number of
            entries.
        UnknownNameError
            If the calibration includes none of these heliostats, or they lack one of its
            parameters.
        """
        return self.with_rows(calibration, rows_in(calibration, self.names))

    def with_rows(self, calibration: Calibrated, rows: npt.NDArray[np.intp]) -> "Heliostats":
        """Return the heliostats with given entries of a calibration, (N,).

        An entry of −1 keeps a heliostat's own deviations.
        """
        fitted, merged = calibration.parameters, {}
        for name in dict.fromkeys((*self.parameters, *fitted)):
            own = self.parameters.get(name, np.zeros(len(self)))
            new = np.broadcast_to(as_float(fitted.get(name, 0.0)), _size(calibration))
            merged[name] = np.where(rows >= 0, new[rows], own)
        return self.with_parameters(merged)


def rows_in(calibration: Calibrated, names: tuple[str, ...]) -> npt.NDArray[np.intp]:
    """Return the index of each of N heliostats in a calibration; −1 if a heliostat is absent.

    Raises
    ------
    InputError
        If the argument is not a calibration, or has neither names nor as many rows as there are
        heliostats.
    UnknownNameError
        If the calibration names none of the heliostats.
    """
    check_calibration(calibration)
    count, size = len(names), _size(calibration)
    if calibration.heliostats:
        place = {name: i for i, name in enumerate(calibration.heliostats)}
        rows = np.array([place.get(name, -1) for name in names], dtype=np.intp)
        if (rows < 0).all():
            raise UnknownNameError("heliostat (of a calibration)", calibration.heliostats[0], names)
        return rows
    if size not in (1, count):
        raise InputError(
            f"the calibration has {size} heliostats without names, but there are {count}; fit the "
            "plant, its group or plant[name], which have names"
        )
    return np.arange(count) if size > 1 else np.zeros(count, dtype=np.intp)


def _size(calibration: Calibrated) -> int:
    sizes = [np.size(values) for values in calibration.parameters.values()]
    return len(calibration.heliostats) or max(sizes, default=1)
