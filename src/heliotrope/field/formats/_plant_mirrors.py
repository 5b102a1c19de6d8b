"""Reads and writes the mirror surfaces of a group in a plant file."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FormatError, InputError
from heliotrope.field.formats._plant_models import GroupTable, MirrorTable
from heliotrope.field.formats.deflectometry import measured_slopes
from heliotrope.field.formats.slopes import write_slopes
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.field.mirror_surface import Canting, FacetGrid, MirrorSurface
from heliotrope.files.times import parse_time
from heliotrope.geometry import FloatArray, as_float
from heliotrope.sun import Site, vector

#: Focal length from which a mirror counts as flat, m, because the heliostat table cannot contain
#: infinity.
FLAT = 1e9


class _Numbers(Protocol):
    """The part of a group's reader that this module needs."""

    path: Path
    group: GroupTable

    def fail(self, problem: str, where: str = "") -> FormatError: ...
    def number(self, key: str, value: float | None) -> FloatArray | None: ...
    def array(self, key: str, value: Any) -> FloatArray: ...
    def columns(self, start: str) -> tuple[str, ...]: ...


def read_facets(reader: _Numbers, size: tuple[FloatArray, FloatArray], site: Site) -> Facets | None:
    """Return the facets of a group; the facets of a grid are not yet canted.

    Parameters
    ----------
    reader
        Numbers of the group.
    size
        Width and height of its N mirrors, m, (N,).
    site
        Site of the plant, for canting at a specific time.

    Raises
    ------
    FormatError, InputError
        If a value cannot be used, or keys exclude each other.
    """
    table, whole = reader.group.mirror, reader.group.facets
    if table is not None:
        _check_keys(reader, table)
        if table.facets:
            columns, rows = table.facets
            grid = FacetGrid(columns, rows, table.gap_m, _canting(reader, table, site))
            center, half = grid.places(*size)
            return Facets.of(center, half, np.zeros_like(center), grid)
        if table.facet:
            places = [
                reader.array(f"mirror.facet.{k}.{key}", getattr(facet, key))
                for k, facet in enumerate(table.facet)
                for key in ("center_m", "size_m", "tilt_mrad")
            ]
            center, full, tilt = (np.stack(places[k::3], axis=1) for k in range(3))
            return Facets.of(center, 0.5 * full, 1e-3 * tilt)
    elif reader.columns("mirror."):
        raise reader.fail("the columns mirror.… need this table; add it", "mirror")
    if not whole:
        return None
    array = reader.array("facets", whole)
    if array.ndim != 4 or array.shape[2] != 3:
        raise reader.fail("each facet needs center, half width and half height", "facets")
    return Facets(array[:, :, 0], array[:, :, 1], array[:, :, 2])


def _check_keys(reader: _Numbers, table: MirrorTable) -> None:
    """Refuse keys that exclude each other, and table columns that are not valid keys."""
    kinds = {
        "mirror.facets": table.facets,
        "mirror.facet": table.facet,
        "facets": reader.group.facets,
    }
    specified = [name for name, value in kinds.items() if value]
    if len(specified) > 1:
        raise reader.fail(
            f"facets are specified as {' and '.join(specified)}; keep one of them", "mirror"
        )
    used = (table.canting, table.canting_focal_m, table.canting_time, table.canting_sun)
    canting = any(value is not None for value in used) or table.gap_m
    if not table.facets and (canting or reader.columns("mirror.canting_focal_m")):
        raise reader.fail(
            "canting and gap_m apply only to equal facets; add facets = [columns, rows], or "
            "specify the tilt_mrad of each facet",
            "mirror",
        )
    for key in ("slope_error", "focal"):
        both = [name for name in type(table).model_fields if key in name and "canting" not in name]
        named = [name for name in both if getattr(table, name) is not None]
        if len(named) > 1:
            raise reader.fail(f"{' and '.join(named)} are both set; keep one of them", "mirror")
    known = {"canting_focal_m", "focal_m", "slope_error_mrad", "slope_error_rad", "reflectivity"}
    for column in reader.columns("mirror."):
        key = column.removeprefix("mirror.")
        if key not in known and not key.startswith(("facet.", "facet_focal_m.", "facet_slope")):
            raise reader.fail(
                f"column {column} is not a mirror property; the table may contain "
                f"{', '.join(sorted(known))}, and facet.K.KEY.I",
                "mirror",
            )


def _canting(reader: _Numbers, table: MirrorTable, site: Site) -> Canting:
    focal = reader.number("mirror.canting_focal_m", table.canting_focal_m)
    sun = None
    if table.canting_time is not None:
        if table.canting_sun is not None:
            raise reader.fail(
                "canting_time and canting_sun are both set; keep one of them", "mirror"
            )
        sun = vector(parse_time(table.canting_time), site)
    elif table.canting_sun is not None:
        sun = np.array(table.canting_sun)
    kind = table.canting
    if kind is None:
        kind = "focal" if focal is not None else "slant" if sun is None else "off_axis"
    if focal is not None:
        focal = as_float(np.broadcast_to(focal, reader.array("", 0.0).shape))
    try:
        return Canting(kind, focal, sun)
    except InputError as error:
        raise reader.fail(str(error), "mirror") from None


def read_surface(
    reader: _Numbers, names: tuple[str, ...], facets: Facets, *, whole: bool
) -> MirrorSurface | None:
    """Return the curvature, errors and measured slopes of a group; None if nothing is known.

    Parameters
    ----------
    reader
        Numbers of the group.
    names
        Names of its heliostats.
    facets
        Facets of the heliostats; the whole mirror counts as one facet if it has none.
    whole
        Whether the mirror has no facets.

    Raises
    ------
    FormatError
        If a value cannot be used, or a slope map does not fit.
    """
    table = reader.group.mirror
    if table is None:
        return None
    focal = _of_facets(reader, table, "focal_m", table.facet_focal_m, whole=whole)
    slope = _of_facets(reader, table, "slope_error_mrad", None, whole=whole)
    if slope is not None:
        slope = as_float(1e-3 * slope)
    elif table.facet_slope_error_rad is not None:
        slope = reader.array("mirror.facet_slope_error_rad", table.facet_slope_error_rad)
    else:
        slope = _full(reader, reader.number("mirror.slope_error_rad", table.slope_error_rad))
    if focal is not None:
        focal = as_float(np.where(focal >= FLAT, np.inf, focal))
    reflectivity = _full(reader, reader.number("mirror.reflectivity", table.reflectivity))
    maps = _maps(reader, names, facets, focal) if table.slope_maps else ()
    if focal is slope is reflectivity is None and not maps:
        return None
    return MirrorSurface(focal, slope, reflectivity, maps)


def _full(reader: _Numbers, value: FloatArray | None) -> FloatArray | None:
    """Return one number for each heliostat, (N,)."""
    if value is None:
        return None
    return as_float(np.array(np.broadcast_to(value, reader.array("", 0.0).shape)))


def _of_facets(
    reader: _Numbers, table: MirrorTable, key: str, values: list[float] | None, *, whole: bool
) -> FloatArray | None:
    """Return one value per mirror, (N,), or one per facet, (N, F), if facets differ."""
    if values is not None:
        return reader.array(f"mirror.facet_{key}", values)
    mirror = _full(reader, reader.number(f"mirror.{key}", getattr(table, key)))
    own = [
        reader.number(f"mirror.facet.{k}.{key}", getattr(facet, key))
        for k, facet in enumerate(table.facet)
    ]
    if whole or all(value is None for value in own):
        return mirror
    if mirror is None and any(value is None for value in own):
        k = next(k for k, value in enumerate(own) if value is None)
        raise reader.fail(
            f"{key} is missing, but other facets have it; add it here, or for the mirror",
            f"mirror.facet[{k}]",
        )
    shape = reader.array("", 0.0).shape
    return np.stack(
        [np.broadcast_to(mirror if v is None else v, shape) for v in own],  # type: ignore[arg-type]
        axis=-1,
    )


def _maps(
    reader: _Numbers, names: tuple[str, ...], facets: Facets, focal: FloatArray | None
) -> tuple[FloatArray | None, ...]:
    assert reader.group.mirror is not None
    folder = reader.path.parent / reader.group.mirror.slope_maps
    if not folder.is_dir():
        raise reader.fail(
            f"{folder}: no such folder; specify a folder with NAME.npz, NAME.csv or NAME.h5 for "
            "the heliostats",
            "mirror.slope_maps",
        )
    maps = []
    for i, name in enumerate(names):
        # Deflectometry measures the total slope, from which the known curvature is subtracted.
        curve = np.inf if focal is None else focal[i]
        maps.append(measured_slopes(folder, name, facets.take(np.array([i])), curve))
    if all(slopes is None for slopes in maps):
        raise reader.fail(
            f"{folder} contains no slope map for any heliostat of the group; name the files after "
            f"heliostats, such as {names[0]}.npz",
            "mirror.slope_maps",
        )
    return tuple(maps)


def mirror_document(
    name: str, heliostats: Heliostats, first: Callable[[str, npt.NDArray[Any]], Any], place: Path
) -> Mapping[str, Any]:
    """Return the tables of the mirrors of a group; slope maps are written beside the plant file.

    Parameters
    ----------
    name, heliostats
        The group.
    first
        Function that puts numbers that differ between heliostats into columns, and returns the
        first.
    place
        The plant file.
    """
    f, surface, mirror = heliostats.facets, heliostats.surface, dict[str, Any]()
    document: dict[str, Any] = {}
    if f is not None and f.grid is not None:
        mirror |= {"facets": [f.grid.columns, f.grid.rows], "gap_m": f.grid.gap}
        mirror["canting"] = f.grid.canting.kind
        if f.grid.canting.focal is not None:
            lengths = np.minimum(f.grid.canting.focal, FLAT)
            mirror["canting_focal_m"] = first("mirror.canting_focal_m", lengths)
        if f.grid.canting.sun is not None:
            mirror["canting_sun"] = f.grid.canting.sun.tolist()
    elif f is not None:
        parts = np.stack([f.center, f.half_width, f.half_height], axis=2)
        document["facets"] = first("facets", parts)
    if surface is not None:
        focal = None if surface.focal is None else np.minimum(surface.focal, FLAT)
        for key, value in (("focal_m", focal), ("slope_error_rad", surface.slope)):
            if value is not None:
                full = f"facet_{key}" if value.ndim > 1 else key
                mirror[full] = first(f"mirror.{full}", value)
        if surface.reflectivity is not None:
            mirror["reflectivity"] = first("mirror.reflectivity", surface.reflectivity)
        if any(slopes is not None for slopes in surface.maps):
            mirror["slope_maps"] = folder = f"{place.stem}.{name}.slopes"
            (place.parent / folder).mkdir(exist_ok=True)
            for heliostat, slopes in zip(heliostats.names, surface.maps, strict=True):
                if slopes is not None:
                    write_slopes(place.parent / folder / f"{heliostat}.npz", slopes)
    return {**document, **({"mirror": mirror} if mirror else {})}
