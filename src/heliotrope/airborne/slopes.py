"""Slope maps of mirrors: measured maps in files, random maps for simulation.

A map comes from deflectometry (QDec-H and similar systems): for each facet a grid of slope
deviations from the ideal surface, (F, H, W, 2), with the signs of
`heliotrope.airborne.mirror.MirrorShape`.
"""

from pathlib import Path

import numpy as np

from heliotrope.airborne.mirror import MirrorShape
from heliotrope.errors import FormatError, InputError
from heliotrope.files.archives import read_arrays
from heliotrope.files.cells import read_rows
from heliotrope.files.limits import check_file
from heliotrope.files.text import write_file, write_text
from heliotrope.geometry import FloatArray, as_float

_COLUMNS = ("facet", "row", "column", "slope_u_mrad", "slope_v_mrad")
#: A larger deviation is probably in another unit, rad.
LARGEST = 0.1
# Largest share of a facet's map that may be missing; it is filled from the nearest cell.
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
    """Fill the holes of a slope map; raises the errors of `read_slopes`."""
    if slope.ndim != 4 or slope.shape[3] != 2 or not slope.size:
        raise FormatError(file, f"slopes of shape {slope.shape}; they must be (F, H, W, 2)")
    if len(slope) != facets:
        raise FormatError(file, f"a map of {len(slope)} facets, but the mirror has {facets}")
    largest = float(np.nanmax(np.abs(slope), initial=0.0))
    if largest > LARGEST:
        raise FormatError(
            file,
            f"a slope deviation of {1e3 * largest:.0f} mrad is above "
            f"{1e3 * LARGEST:.0f} mrad; is it in another unit?",
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


def smooth_slopes(
    shape: MirrorShape,
    generator: np.random.Generator,
    rms: float,
    *,
    length: float = 0.3,
    cells: int = 24,
) -> FloatArray:
    """Return random slope deviations of a mirror, (F, cells, cells, 2), rad.

    Each facet's surface is smooth and random, so that both slopes belong to one surface. The mean
    over each facet is 0, which preserves its canting and the mirror's orientation; the root mean
    square over the mirror is ``rms`` for each of the two components.

    Parameters
    ----------
    shape
        Shape of the mirror.
    generator
        Source of the randomness.
    rms
        RMS of ∂z/∂u and of ∂z/∂v over the mirror, rad.
    length
        Correlation length of the slopes, m: that of a Gaussian filter of the heights.
    cells
        Number of cells along each edge of a facet.

    Raises
    ------
    InputError
        If rms is negative, or length or cells is not above 0.
    """
    if not (rms >= 0.0 and length > 0.0 and cells > 1):
        raise InputError(
            f"smooth_slopes: rms {rms} rad, length {length} m and {cells} cells; use an rms of 0 "
            "or more, a length above 0 and at least two cells"
        )
    from scipy.ndimage import gaussian_filter

    slope = np.zeros((len(shape), cells, cells, 2))
    for k, (half_width, half_height) in enumerate(shape.half_size):
        step = np.array([2.0 * half_height, 2.0 * half_width]) / cells
        # A border as wide as the filter makes the edges as rough as the interior.
        border = [int(np.ceil(3.0 * length / s)) for s in step]
        size = [cells + 2 * b for b in border]
        high = gaussian_filter(generator.standard_normal(size), length / step, mode="wrap")
        by_v, by_u = (as_float(g) for g in np.gradient(high, step[0], step[1]))
        inner = tuple(slice(b, b + cells) for b in border)
        slope[k] = np.stack([by_u[inner], by_v[inner]], axis=-1)
    slope -= slope.mean(axis=(1, 2), keepdims=True)
    spread = as_float(np.sqrt(np.mean(slope**2, axis=(0, 1, 2))))
    return as_float(slope * (rms / np.maximum(spread, 1e-300)))


def _read_npz(file: Path) -> FloatArray:
    slope = read_arrays(file, "a slope map: an .npz file written by NumPy", ["slope"])["slope"]
    if slope.dtype.kind not in "fiu":
        raise FormatError(file, f"slopes are {slope.dtype}; they must be numbers")
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
        raise FormatError(file, "no rows; write one row per cell of the map")
    whole = index.astype(np.intp)
    shape = np.asarray(whole.max(axis=0)) + 1
    if int(np.prod(shape)) > 10 * len(whole):
        raise FormatError(
            file,
            f"{len(whole)} rows for {' × '.join(map(str, shape))} cells; include the whole map",
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
