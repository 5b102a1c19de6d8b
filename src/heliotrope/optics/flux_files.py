"""Writes the flux and the efficiencies of a plant to files, for people and other programs.

- `write_heliostats`: one line per heliostat, with SolarPILOT's column names.
- `write_map`: the flux on the receivers, one line per cell.
- `write_netcdf`: both in one NetCDF file (classic format), readable by xarray and other tools.
- `write_sam`: the optical efficiency over the sun positions, in SAM's format.
- `write_solartherm`: the same in SolarTherm's format.
"""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.files import write_text
from heliotrope.files.text import write_file
from heliotrope.geometry import FloatArray
from heliotrope.optics.plant_flux import EFFICIENCIES, FluxTable, PlantFlux

#: Columns of a heliostat table, as SolarPILOT exports them.
HELIOSTAT_COLUMNS = (
    "Heliostat ID", "Pos-x", "Pos-y", "Pos-z", "Aim-x", "Aim-y", "Aim-z", "Reflectivity",
    "Soiling", "Total eff", "Cosine eff", "Attenuation", "Blocking", "Shading",
    "Shading and blocking", "Intercept eff.", "Power, kW",
)  # fmt: skip


def write_heliostats(path: str | Path, found: PlantFlux, year: FluxTable | None = None) -> None:
    """Write a table (CSV) of heliostat efficiencies; empty cells are unknown values.

    Parameters
    ----------
    path
        File.
    found
        Efficiencies at one sun position.
    year
        Table of the same plant, for the column ``Annual efficiency``.

    Notes
    -----
    "Blocking" and "Shading" are computed separately; "Shading and blocking" is the efficiency for
    their exact union, which enters the total.
    """
    e = found.efficiencies
    columns: list[FloatArray] = [
        *found.position.T, *found.aim.T, found.reflectivity, found.clean, e.total, e.cosine, e.air,
        e.blocking, e.shading, e.lit, e.intercept, 1e-3 * found.heliostat_power,
    ]  # fmt: skip
    names: tuple[str, ...] = HELIOSTAT_COLUMNS
    digits = [3] * 6 + [5] * 9 + [4]
    if year is not None:
        columns.append(year.heliostat)
        names, digits = (*names, "Annual efficiency"), [*digits, 5]
    rows = zip(
        found.names, *(_texts(c, n) for c, n in zip(columns, digits, strict=True)), strict=True
    )
    write_text(path, _csv([names, *rows]))


def write_map(
    path: str | Path, found: PlantFlux, more: Mapping[str, npt.NDArray[Any]] | None = None
) -> None:
    """Write the cells of the receivers (CSV): centres (ENU), area, flux and its standard error.

    Parameters
    ----------
    path
        File.
    found
        Flux. Rows of cells are counted from the lowest, columns from the left or from the north.
    more
        Further columns by name, (rows, columns) each, if there is one receiver: truth values, or
        numbers in the unit of their name.
    """
    header = ["receiver", "row", "column", "east_m", "north_m", "up_m", "area_m2", "flux_kw_m2"]
    if found.errors:
        header.append("error_kw_m2")
    extra = [
        ["yes" if v else "no" for v in values.flat] if values.dtype == np.bool_
        else _texts(values.ravel(), 4)
        for values in (more or {}).values()
    ]  # fmt: skip
    rows: list[Any] = [[*header, *(more or {})]]
    for k, (surface, view) in enumerate(zip(found.surfaces, found.maps, strict=True)):
        cells = surface.cells
        columns: list[Any] = [
            *(place.flat for place in np.indices(view.flux.shape)),
            *(_texts(c, 4) for c in cells.center.T),
            _texts(cells.area, 6),
            _texts(1e-3 * view.flux.ravel(), 4),
        ]
        if found.errors:
            columns.append(_texts(1e-3 * found.errors[k].ravel(), 4))
        rows += [(surface.name, *row) for row in zip(*columns, *extra, strict=True)]
    write_text(path, _csv(rows))


def write_netcdf(path: str | Path, found: PlantFlux) -> None:
    """Write efficiencies (as fractions) and flux maps (W/m²) as NetCDF."""

    def write(stream: BinaryIO) -> None:
        # SciPy closes what it writes to.
        buffer = _Kept()
        _fill_netcdf(buffer, found)
        stream.write(buffer.content)

    write_file(path, write)


class _Kept(io.BytesIO):
    """A buffer whose content remains available after closing."""

    content: bytes = b""

    def close(self) -> None:
        """Keep the content on closing."""
        self.content = self.getvalue()
        super().close()


def _fill_netcdf(stream: BinaryIO, found: PlantFlux) -> None:
    from scipy.io import netcdf_file

    # Its attributes are those of the file.
    file: Any = netcdf_file(stream, "w", version=2)
    file.title = f"{found.plant}: optical efficiencies and flux"
    file.sun_east_north_up, file.dni_w_m2, file.rays = found.sun, found.dni, found.rays
    names = np.array([list(name.ljust(max(map(len, found.names)))) for name in found.names], "S1")
    file.createDimension("heliostat", len(found.names))
    file.createDimension("axis", 3)
    file.createDimension("letter", names.shape[1])
    _put(file, "heliostat_name", names, ("heliostat", "letter"), "", "c")
    _put(file, "position", found.position, ("heliostat", "axis"), "m")
    _put(file, "aim", found.aim, ("heliostat", "axis"), "m")
    _put(file, "power", found.heliostat_power, ("heliostat",), "W")
    for name in EFFICIENCIES:
        _put(file, name, getattr(found.efficiencies, name), ("heliostat",), "1")
    for k, view in enumerate(found.maps):
        axes = (f"up_{k}", f"right_{k}")
        for axis, centers in zip(axes, (view.up, view.right), strict=True):
            file.createDimension(axis, len(centers))
            _put(file, axis, centers, (axis,), "m")
        _put(file, f"flux_{k}", view.flux, axes, "W m-2", receiver=view.receiver)
        if found.errors:
            _put(file, f"flux_error_{k}", found.errors[k].reshape(view.flux.shape), axes, "W m-2")
    file.close()


def _put(
    file: Any,
    name: str,
    values: Any,
    axes: tuple[str, ...],
    unit: str,
    kind: str = "d",
    receiver: str = "",
) -> None:
    variable = file.createVariable(name, kind, axes)
    variable[:] = values
    if unit:
        variable.units = unit
    if receiver:
        variable.receiver = receiver


def write_sam(path: str | Path, table: FluxTable) -> None:
    """Write efficiencies over sun positions in SAM's format for power towers (CSV).

    Each line contains the sun's azimuth (clockwise from north) and zenith angle in degrees, and the
    optical efficiency of the field, without a header: the matrix ``eta_map`` of SSC's
    ``csp_solver_pt_sf_perf_interp``.
    """
    azimuth, zenith = np.degrees(table.azimuth), 90.0 - np.degrees(table.elevation)
    columns = (_texts(azimuth, 4), _texts(zenith, 4), _texts(table.shares["total"], 6))
    write_text(path, _csv(list(zip(*columns, strict=True))))


def write_solartherm(path: str | Path, table: FluxTable) -> None:
    """Write a table over a year in SolarTherm's format (.motab).

    The table ``optics`` has declinations along its rows and hour angles along its columns, in
    degrees, as in SolarTherm's ``Solar_angles.dec_hra``; the efficiency is 0 where the sun is below
    2°.

    Raises
    ------
    InputError
        If the table covers individual times instead of a year.
    """
    if not np.isfinite(table.declination).all():
        raise InputError(f"{path}: SolarTherm needs a table over a year; use flux_year")
    hours = np.unique(np.round(np.degrees(table.hour), 9))
    step = float(np.diff(hours).min()) if len(hours) > 1 else 15.0
    across = np.round(step * np.arange(-round(180.0 / step), round(180.0 / step) + 1), 9)
    down = np.unique(np.round(np.degrees(table.declination), 9))
    values = np.zeros((len(down), len(across)))
    row = np.searchsorted(down, np.round(np.degrees(table.declination), 9))
    column = np.abs(across - np.degrees(table.hour)[:, None]).argmin(axis=1)
    values[row, column] = table.shares["total"]
    lines = [
        "#1",
        f"#Comments: optical efficiency of {table.plant} by Heliotrope",
        f"double optics({len(down) + 1}, {len(across) + 1})",
        " ".join(["0", *(f"{x:g}" for x in across)]),
        *(
            " ".join([f"{d:.6g}", *(f"{v:.6f}" for v in line)])
            for d, line in zip(down, values, strict=True)
        ),
    ]
    write_text(path, "\n".join(lines) + "\n")


def _texts(values: FloatArray, digits: int) -> list[str]:
    # Adding 0 removes the sign from numbers that round to −0.
    rounded = np.round(values, digits) + 0.0
    return ["" if np.isnan(v) else f"{v:.{digits}f}" for v in rounded.tolist()]


def _csv(rows: Any) -> str:
    import csv

    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
