"""Convert array records to tables (pandas) and to labelled arrays (xarray).

A class declares once which axes its arrays have (`Labelled`). The data frame and the dataset are
built from this declaration. Units are stored in ``attrs``: for each variable of a dataset
(``units``), and for a frame in ``frame.attrs["units"]`` by column. Times are UTC.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

#: Labels of a vector's components.
ENU = ("east", "north", "up")
#: Labels of the two directions across a beam, as seen from the mirror.
ACROSS = ("right", "up")


@dataclass(frozen=True)
class Variable:
    """An array with its axis names, and its unit ("" for none) or units along the last axis."""

    axes: tuple[str, ...]
    values: npt.ArrayLike
    unit: str | tuple[str, ...] = ""

    @property
    def units(self) -> str:
        """Return the unit, or the units along the last axis in order."""
        return self.unit if isinstance(self.unit, str) else ", ".join(u or "1" for u in self.unit)


@dataclass(frozen=True)
class Labelled:
    """Arrays with labelled axes.

    Attributes
    ----------
    rows
        The axes that become the rows of a frame; the other axes become columns.
    labels
        Labels along each axis.
    variables
        Variables, keyed by name.
    large
        Variables that only the dataset has, because a frame would need too many columns for them.
    notes
        Attributes of the whole frame or dataset.
    on_request
        Variables that only a full frame has, because few readers need them.
    """

    rows: tuple[str, ...]
    labels: Mapping[str, npt.ArrayLike]
    variables: Mapping[str, Variable]
    large: frozenset[str] = frozenset()
    notes: Mapping[str, str] = field(default_factory=dict)
    on_request: frozenset[str] = frozenset()


class Framed:
    """Base class of records that convert to a data frame or a dataset."""

    @abstractmethod
    def _labelled(self) -> Labelled:
        """Return the arrays with their axes."""

    def to_frame(self, *, full: bool = False) -> "pd.DataFrame":
        """Return a pandas frame with one row for each label; ``attrs["units"]`` has the units.

        Parameters
        ----------
        full
            Whether to include the columns ``prior_…`` and ``centre_…`` of a fit. For other records
            it makes no difference.
        """
        import pandas as pd

        given = self._labelled()
        left_out = given.large if full else given.large | given.on_request
        size = [len(np.asarray(given.labels[axis])) for axis in given.rows]
        columns: dict[str, Any] = {}
        units: dict[str, str] = {}
        for name, one in given.variables.items():
            if name in left_out:
                continue
            values, extra = np.asarray(one.values), [a for a in one.axes if a not in given.rows]
            order = [one.axes.index(a) for a in (*given.rows, *extra) if a in one.axes]
            values = values.transpose(order)
            place = tuple(slice(None) if a in one.axes else None for a in given.rows)
            values = values[place]
            shape = (*size, *values.shape[len(size) :])
            flat = np.broadcast_to(values, shape).reshape(int(np.prod(size)), -1)
            labels = product(*([str(x) for x in np.asarray(given.labels[a])] for a in extra))
            for k, names in enumerate(labels):
                column = "_".join((name, *names))
                columns[column] = np.array(flat[:, k])
                units[column] = (
                    one.unit if isinstance(one.unit, str) else one.unit[k % len(one.unit)]
                )
        parts = [_index(given.labels[axis]) for axis in given.rows]
        index: Any = parts[0] if len(parts) == 1 else pd.MultiIndex.from_product(parts)
        index.names = list(given.rows)
        frame = pd.DataFrame(columns, index=index)
        frame.attrs["units"] = units
        for key, note in given.notes.items():
            frame.attrs[key] = note
        return frame

    def to_xarray(self) -> "xr.Dataset":
        """Return an xarray dataset; this needs the optional extra ``notebook``."""
        try:
            import xarray
        except ImportError:
            raise InputError(
                "to_xarray needs the package xarray; install heliotrope[notebook]"
            ) from None
        given = self._labelled()
        return xarray.Dataset(
            {
                name: (one.axes, np.asarray(one.values), {"units": one.units} if one.units else {})
                for name, one in given.variables.items()
            },
            coords={axis: _plain(labels) for axis, labels in given.labels.items()},
            attrs=dict(given.notes),
        )


def batch_rows(shape: tuple[int, ...]) -> dict[str, npt.ArrayLike]:
    """Return names and labels of batch axes; a single object (no axes) is one row."""
    if not shape:
        return {"row": np.arange(1)}
    return {f"axis_{k}": np.arange(n) for k, n in enumerate(shape)}


def batched(
    shape: tuple[int, ...],
    own: Mapping[str, Variable],
    labels: Mapping[str, npt.ArrayLike],
    large: frozenset[str] = frozenset(),
) -> Labelled:
    """Return the arrays of a batch with one row for each object.

    Parameters
    ----------
    shape
        The batch shape; the batch axes of the arrays are broadcast to it.
    own
        Arrays by name, with the axes that follow the batch axes.
    labels
        Labels along these axes.
    large
        As in `Labelled`.
    """
    rows = batch_rows(shape)
    full = shape or (1,)

    def of(one: Variable) -> Variable:
        values = np.asarray(one.values)
        behind = values.shape[values.ndim - len(one.axes) :]
        return Variable((*rows, *one.axes), np.broadcast_to(values, (*full, *behind)), one.unit)

    variables = {name: of(one) for name, one in own.items()}
    return Labelled(tuple(rows), {**rows, **labels}, variables, large)


#: Largest distance from 1970 that the nanosecond times of a frame can represent, s.
LATEST = 9.2e9


def times(seconds: npt.ArrayLike) -> npt.NDArray[np.datetime64]:
    """Return Unix seconds as UTC times; NaN becomes NaT."""
    given = np.asarray(seconds, dtype=np.float64)
    known = np.isfinite(given)
    micro = np.round(np.where(known, given, 0.0) * 1e6).astype(np.int64).astype("datetime64[us]")
    return np.where(known, micro.astype("datetime64[ns]"), np.datetime64("NaT", "ns"))


def _plain(labels: npt.ArrayLike) -> np.ndarray:
    values = np.asarray(labels)
    return values.astype(str) if values.dtype == object else values


def _index(labels: npt.ArrayLike) -> Any:
    import pandas as pd

    values = _plain(labels)
    if values.dtype.kind == "M":
        return pd.DatetimeIndex(values).tz_localize("UTC")
    return pd.Index(values)
