"""Mirror poses: vertex, rotation and outline of each mirror at its drive positions.

Concentrator coordinates have their origin at the vertex, x to the right as seen from the front, y
up along the mirror, and z along the normal.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.formats.frames import orientation
from heliotrope.field.heliostats import Heliostats
from heliotrope.files.cells import read_rows
from heliotrope.files.text import write_text
from heliotrope.geometry import FloatArray, as_float

_COUNTS = ("count_1", "count_2")


@dataclass(frozen=True)
class MirrorPoses:
    """Poses of N mirrors, true or expected.

    Attributes
    ----------
    names
        Names of the heliostats.
    vertex
        ENU metres, (N, 3).
    rotation
        Rotation from concentrator coordinates to ENU, (N, 3, 3).
    outline
        Corners in concentrator coordinates, m: upper left, upper right, lower right, lower left
        as seen from the front, (N, 4, 3).
    """

    names: tuple[str, ...]
    vertex: FloatArray
    rotation: FloatArray
    outline: FloatArray

    def __len__(self) -> int:
        return len(self.names)

    @property
    def corners(self) -> FloatArray:
        """Corners in ENU metres, (N, 4, 3)."""
        turned = np.einsum("nij,nkj->nki", self.rotation, self.outline)
        return as_float(self.vertex[:, None, :] + turned)

    def take(self, rows: npt.ArrayLike) -> "MirrorPoses":
        """Return the mirrors at indices ``rows``, in that order."""
        index = np.asarray(rows, dtype=np.intp).reshape(-1)
        return MirrorPoses(
            tuple(self.names[i] for i in index),
            self.vertex[index],
            self.rotation[index],
            self.outline[index],
        )


def standing(heliostats: Heliostats, counts: npt.ArrayLike) -> MirrorPoses:
    """Return the poses of calibrated heliostats at drive counts (N, D)."""
    turned, vertex = orientation(heliostats.calibrated, counts)
    return MirrorPoses(heliostats.names, vertex, turned, outline(heliostats))


def join_standing(parts: Sequence[MirrorPoses]) -> MirrorPoses:
    """Join several groups of mirrors, in order.

    Raises
    ------
    InputError
        If there are no groups.
    """
    if not parts:
        raise InputError("no heliostat is commanded; list the heliostats that the photographs show")
    return MirrorPoses(
        tuple(name for p in parts for name in p.names),
        np.concatenate([p.vertex for p in parts]),
        np.concatenate([p.rotation for p in parts]),
        np.concatenate([p.outline for p in parts]),
    )


def outline(heliostats: Heliostats) -> FloatArray:
    """Return the corners of mirrors in concentrator coordinates, (N, 4, 3).

    The corners are the outermost corners of the facets, with their heights, or those of a flat
    rectangle.
    """
    signs = np.array([(-1.0, 1.0), (1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)])
    facets = heliostats.facets
    if facets is None:
        half = 0.5 * np.stack([heliostats.width, heliostats.height], axis=-1)
        flat = half[:, None, :] * signs
        return np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=-1)
    every = facets.center[:, :, None, :] + (
        signs[:, :1] * facets.half_width[:, :, None, :]
        + signs[:, 1:] * facets.half_height[:, :, None, :]
    )
    every = every.reshape(len(every), -1, 3)
    index = np.argmax(every[:, :, :2] @ signs.T, axis=1)
    return np.take_along_axis(every, index[:, :, None], axis=1)


# -- commands --------------------------------------------------------------------------


def read_commands(
    path: str | Path, names: Sequence[str], cluster: str = "", point: str = ""
) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Return heliostat indices and drive counts (M, D) from a table of commands.

    Parameters
    ----------
    path
        CSV with the columns ``heliostat``, ``count_1``, ``count_2`` (one or two drives); the table
        of a flight plan also has ``cluster``, ``point`` and ``reachable``.
    names
        Names of the plant's heliostats.
    cluster, point
        Cluster and calibration point whose rows are selected; "" for all.

    Raises
    ------
    FormatError
        If a column is missing, a value is not a number, or a heliostat is listed twice.
    UnknownNameError
        If a heliostat is not in the plant, which indicates the wrong field.
    """
    rows = read_rows(Path(path), "a table of commands", ("heliostat", *_COUNTS))
    rows.need(["heliostat", "count_1"])
    clusters, points, reachable = (rows.texts(c) for c in ("cluster", "point", "reachable"))
    rows = rows.take(
        i
        for i in range(len(rows))
        if cluster in ("", clusters[i]) and point in ("", points[i]) and reachable[i] != "false"
    )
    if not len(rows):
        of = f" of cluster {cluster!r}, point {point!r}" if cluster or point else ""
        raise InputError(
            f"{path}: no heliostat{of} in it; list the heliostats that the photographs show"
        )
    rows.heliostat = rows.texts("heliostat")
    index = {name: i for i, name in enumerate(names)}
    commands: dict[int, int] = {}
    for i, name in enumerate(rows.heliostat):
        if name not in index:
            place = f"heliostat ({path}, {rows.places[i]}) in this field:"
            raise UnknownNameError(place, name, names)
        if commands.setdefault(index[name], i) != i:
            twice = "it is listed twice, but photographs show one pose; specify the cluster and the"
            rows.refuse(i, "heliostat", f"{twice} point of the photographs")
    counts = [rows.numbers(name, "drive counts") for name in _COUNTS if name in rows.columns]
    rows.refuse_bad()
    return np.fromiter(commands, dtype=np.intp), np.stack(counts, axis=-1)


def write_commands(path: str | Path, names: Sequence[str], counts: npt.ArrayLike) -> None:
    """Write the drive counts (N, D) of heliostats to a file that `read_commands` can read."""
    table = as_float(counts)
    header = ["heliostat", *(f"count_{k + 1}" for k in range(table.shape[1]))]
    lines = [",".join(header)]
    lines += [
        ",".join([name, *(repr(float(v)) for v in row)])
        for name, row in zip(names, table, strict=True)
    ]
    write_text(path, "\n".join(lines) + "\n")
