"""Reads and writes slope maps of mirrors.

A map comes from deflectometry (QDec-H and similar systems): for each facet a grid of slope
deviations from the ideal surface, (F, H, W, 2), along the facet's own right and upward edges. A
positive ∂z/∂u tilts the normal to the left.
"""

from pathlib import Path

import numpy as np

from heliotrope.errors import FormatError
from heliotrope.files.archives import read_arrays
from heliotrope.files.cells import read_rows
from heliotrope.files.limits import check_file
from heliotrope.files.text import write_file, write_text
from heliotrope.geometry import FloatArray, as_float

_COLUMNS = ("facet", "row", "column", "slope_u_mrad", "slope_v_mrad")
#: Largest plausible deviation; a larger value is probably in another unit, rad.
LARGEST = 0.1
# Largest fraction of a facet's map that may be missing and is filled from the nearest cell.
_MOST_HOLES = 0.5


def read_slopes(path: str | Path, facets: int) -> FloatArray:
    """Return a slope map (F, H, W, 2), rad; holes are filled from the nearest cell.

    Parameters
    ----------
    path
        ``.npz`` with one array ``slope`` in rad, or ``.csv`` with the columns facet, row, column
        (all from 0; row 0 at the lower edge), slope_u_mrad and slope_v_mrad.
    facets
        Number of facets of the mirror.

    Raises
    ------
    FormatError
        If the file cannot be read, has a different number of facets, has values above 100 mrad, or
        lacks more than half of a facet.
    """
    file = check_file(path, "a slope map (.npz or .csv)", binary=True)
    suffix = file.suffix.casefold()
    if suffix == ".npz":
        slope = _read_npz(file)
    elif suffix == ".csv":
        slope = _read_csv(file)
    else:
        raise FormatError(file, f"the name ends in {file.suffix!r}; slope maps are .npz or .csv")
    return checked_slopes(file, slope, facets)


def checked_slopes(file: Path, slope: FloatArray, facets: int) -> FloatArray:
    """Return a slope map whose holes are filled; the errors are those of `read_slopes`."""
    if slope.ndim != 4 or slope.shape[3] != 2 or not slope.size:
        raise FormatError(file, f"slopes must have the shape (F, H, W, 2), not {slope.shape}")
    if len(slope) != facets:
        raise FormatError(file, f"the map has {len(slope)} facets, but the mirror has {facets}")
    largest = float(np.nanmax(np.abs(slope), initial=0.0))
    if largest > LARGEST:
        raise FormatError(
            file,
            f"a slope deviation of {1e3 * largest:.0f} mrad is above "
            f"{1e3 * LARGEST:.0f} mrad; check the unit",
        )
    for k in range(facets):
        missing = float(np.mean(~np.isfinite(slope[k]).all(axis=-1)))
        if missing > _MOST_HOLES:
            raise FormatError(
                file,
                f"facet {k}: {100 * missing:.0f} % of its map is missing, more than "
                f"{100 * _MOST_HOLES:.0f} %; measure it again or leave the map out",
            )
    return _filled(slope)


def write_slopes(path: str | Path, slope: FloatArray) -> None:
    """Write a slope map in the form that `read_slopes` reads, completely or not at all."""
    file = Path(path)
    suffix = file.suffix.casefold()
    if suffix == ".npz":
        write_file(file, lambda stream: np.savez_compressed(stream, slope=slope))
        return
    if suffix != ".csv":
        raise FormatError(file, f"the name ends in {file.suffix!r}; slope maps are .npz or .csv")
    index = np.indices(slope.shape[:3]).reshape(3, -1).T
    lines = [
        f"{f},{i},{j},{u!r},{v!r}"
        for (f, i, j), (u, v) in zip(
            index.tolist(), (1e3 * slope).reshape(-1, 2).tolist(), strict=True
        )
    ]
    write_text(file, "\n".join([",".join(_COLUMNS), *lines]) + "\n")


def _read_npz(file: Path) -> FloatArray:
    slope = read_arrays(file, "a slope map: an .npz file written by NumPy", ["slope"])["slope"]
    if slope.dtype.kind not in "fiu":
        raise FormatError(file, f"slopes must be numbers, not {slope.dtype}")
    return as_float(slope)


def _read_csv(file: Path) -> FloatArray:
    rows = read_rows(file, "a slope map in CSV")
    rows.need(_COLUMNS)
    index = np.stack([rows.numbers(n, "a whole number from 0") for n in _COLUMNS[:3]], axis=-1)
    values = np.stack([rows.numbers(n, "mrad") for n in _COLUMNS[3:]], axis=-1)
    invalid = ~((index >= 0) & (index == np.floor(index)) & (index < 10_000)).all(axis=-1)
    if invalid.any():
        i = int(np.flatnonzero(invalid)[0])
        raise FormatError(
            file,
            f"facet, row, column {index[i].tolist()} are not whole numbers from 0 to 9999",
            rows.places[i],
        )
    if not len(index):
        raise FormatError(file, "the table has no rows; it needs one row for each cell of the map")
    whole = index.astype(np.intp)
    shape = np.asarray(whole.max(axis=0)) + 1
    if int(np.prod(shape)) > 10 * len(whole):
        raise FormatError(
            file,
            f"{len(whole)} rows for {' × '.join(map(str, shape))} cells; the table must "
            "contain the whole map",
        )
    slope = np.full((*shape, 2), np.nan)
    slope[whole[:, 0], whole[:, 1], whole[:, 2]] = 1e-3 * values
    return slope


def _filled(slope: FloatArray) -> FloatArray:
    from scipy.ndimage import distance_transform_edt

    whole = slope.copy()
    for k, facet in enumerate(slope):
        holes = ~np.isfinite(facet).all(axis=-1)
        if holes.any():
            near = distance_transform_edt(holes, return_distances=False, return_indices=True)
            whole[k] = facet[near[0], near[1]]
    return whole
