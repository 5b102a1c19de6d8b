"""Reads mirror surfaces that PAINT publishes (HDF5), and converts them to slopes.

A file contains the groups ``facet1``, ``facet2``, … of one heliostat, in the order in which the
heliostat's properties file lists its facets. Each group has the datasets ``surface_points``, m, and
``surface_normals``, (K, 3), in the axes in which the properties file defines the facets. Where the
canting differs from that of the properties file, the difference becomes part of the slopes.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FormatError
from heliotrope.field.formats.slopes import checked_slopes, read_slopes
from heliotrope.field.heliostats import Facets
from heliotrope.files.limits import EXPANDED, MIB, check_file
from heliotrope.geometry import FloatArray, as_float

if TYPE_CHECKING:
    import h5py

#: Suffix of the files.
SUFFIX = ".h5"
# Maximum number of cells along an edge of a facet, and points per cell, because a mean of few
# points is noisy.
_CELLS, _POINTS = 64, 4
# Minimum fraction of the points that must lie on their facet; the rest may be at its rim.
_ON_FACET = 0.5
_WHAT = "a deflectometry file in PAINT's format (.h5)"


def find_deflectometry(folder: Path, name: str) -> Path | None:
    """Return the deflectometry file of a heliostat; None if there is none.

    The file is ``NAME.h5``. Otherwise it is the newest ``NAME-filled-TIME-deflectometry.h5``, or
    else the newest ``NAME-TIME-…``, in the folder or in ``NAME/Deflectometry``, where PAINT's
    client stores it.
    """
    own = folder / f"{name}{SUFFIX}"
    if own.exists():
        return own
    for place in (folder, folder / name / "Deflectometry"):
        files = sorted(place.glob("*-deflectometry.h5")) if place.is_dir() else []
        files = [file for file in files if file.name.startswith(f"{name}-")]
        filled = [file for file in files if file.name.startswith(f"{name}-filled-")]
        if files:
            return (filled or files)[-1]
    return None


def measured_slopes(
    folder: Path, name: str, facets: Facets, focal: npt.ArrayLike = np.inf
) -> FloatArray | None:
    """Return the slope map of a heliostat from a folder, (F, H, W, 2), rad; None if it has none.

    Parameters
    ----------
    folder
        Folder with files NAME.npz or NAME.csv (`heliotrope.field.formats.slopes.read_slopes`), or
        as for `find_deflectometry`.
    name
        The heliostat.
    facets, focal
        Facets and focal lengths of this heliostat; see `read_deflectometry`.

    Raises
    ------
    FormatError
        As for `heliotrope.field.formats.slopes.read_slopes` and `read_deflectometry`.
    """
    for suffix in (".npz", ".csv"):
        own = folder / f"{name}{suffix}"
        if own.exists():
            return read_slopes(own, facets.center.shape[1])
    measured = find_deflectometry(folder, name)
    return None if measured is None else read_deflectometry(measured, facets, focal)


def read_deflectometry(
    path: str | Path, facets: Facets, focal: npt.ArrayLike = np.inf
) -> FloatArray:
    """Return the slope deviations of a measured surface from its design, (F, H, W, 2), rad.

    The normals in each cell of a grid are averaged, and holes are filled from the nearest cell.

    Parameters
    ----------
    path
        The file.
    facets
        Facets of this heliostat, as designed.
    focal
        Focal lengths of the facets, m, () or (F,); infinity: flat.

    Raises
    ------
    FormatError
        If the file cannot be read, has a different number of facets, has points outside its facets
        or normals that point backwards, or as for `heliotrope.field.formats.slopes.read_slopes`.
    """
    import h5py

    file = check_file(path, _WHAT, binary=True)
    count = facets.center.shape[1]
    curve = 0.5 / np.broadcast_to(as_float(focal), (count,))
    try:
        with h5py.File(file, "r") as root:
            names = [name for name in root if str(name).startswith("facet")]
            if len(names) != count:
                raise FormatError(
                    file, f"the map has {len(names)} facets, but the mirror has {count}"
                )
            clouds = [_cloud(file, root, f"facet{k + 1}") for k in range(count)]
    except (OSError, RuntimeError, KeyError) as error:
        raise FormatError(
            file, f"not a readable HDF5 file ({str(error)[:80]}); expected {_WHAT}"
        ) from None
    fewest = min(len(points) for points, _ in clouds)
    cells = int(np.clip(np.sqrt(fewest / _POINTS), 1, _CELLS))
    maps = [_gridded(file, (facets, curve), k, *cloud, cells) for k, cloud in enumerate(clouds)]
    return checked_slopes(file, np.stack(maps), count)


def _cloud(file: Path, root: "h5py.File", facet: str) -> tuple[FloatArray, FloatArray]:
    """Return the points and the normals of a facet, each (K, 3), without NaN."""
    import h5py

    both = []
    for name in ("surface_points", "surface_normals"):
        # A link to another file, or external data, would read files that the user did not name.
        linked = root.get(f"{facet}/{name}", getlink=True)
        data = root[f"{facet}/{name}"] if isinstance(linked, h5py.HardLink) else None
        if not isinstance(data, h5py.Dataset) or data.external or data.is_virtual:
            raise FormatError(file, f"{facet} has no dataset {name}")
        if data.dtype.kind not in "fiu" or data.ndim != 2 or data.shape[1] != 3:
            raise FormatError(
                file, f"{facet}/{name}: {data.dtype} of shape {data.shape}; expected numbers (K, 3)"
            )
        if 8 * data.size > EXPANDED:
            raise FormatError(
                file,
                f"{facet}/{name}: {data.shape[0]:,} points expand to more than the limit of "
                f"{EXPANDED / MIB:.0f} MiB",
            )
        both.append(as_float(data[()]))
    points, normals = both
    if len(points) != len(normals) or not len(points):
        raise FormatError(
            file,
            (
                f"{facet}: {len(points)} points and {len(normals)} normals; there must be one "
                "normal per point"
            ),
        )
    good = np.isfinite(points).all(axis=-1) & np.isfinite(normals).all(axis=-1)
    return points[good], normals[good]


def _gridded(
    file: Path,
    mirror: tuple[Facets, FloatArray],
    k: int,
    points: FloatArray,
    normals: FloatArray,
    cells: int,
) -> FloatArray:
    """Return the mean deviation in each cell of facet ``k``, (cells, cells, 2).

    Empty cells are NaN.
    """
    facets, curve = mirror
    axes, half = facets.axes[0, k], facets.half_size[0, k]
    own = normals @ axes.T
    uv = ((points - facets.center[0, k]) @ axes.T)[:, :2]
    inside = (np.abs(uv) <= half).all(axis=-1)
    if not len(points) or inside.mean() < _ON_FACET:
        raise FormatError(
            file,
            f"facet{k + 1}: {int(inside.sum())} of {len(points)} points lie on facet {k} of the "
            "plant file; use the file of this heliostat, in the axes of its properties",
        )
    if (own[inside, 2] <= 0.0).any():
        raise FormatError(
            file, f"facet{k + 1}: a normal points backwards; it must point to the front"
        )
    uv, own = uv[inside], own[inside]
    deviation = -own[:, :2] / own[:, 2:] - uv * curve[k]
    at = np.minimum(((uv / half + 1.0) * 0.5 * cells).astype(np.intp), cells - 1)
    cell = at[:, 1] * cells + at[:, 0]
    count = np.bincount(cell, minlength=cells**2)
    with np.errstate(invalid="ignore"):
        mean = [
            np.bincount(cell, weights=deviation[:, i], minlength=cells**2) / count for i in (0, 1)
        ]
    return np.stack(mean, axis=-1).reshape(cells, cells, 2)
