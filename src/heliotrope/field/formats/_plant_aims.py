"""Reads and writes the plant file's settings for choosing aims."""

from pathlib import Path
from typing import Any

from heliotrope.errors import InputError
from heliotrope.field.aim_settings import AimSettings
from heliotrope.field.flux_limit import FluxLimit, read_limit, write_limit
from heliotrope.field.flux_table import read_table_limit
from heliotrope.field.formats._plant_models import AimsTable

#: Name of the setting for each key, and the factor from the key's unit.
_KEYS = {
    "probability": ("probability", 1.0),
    "drift_mrad": ("drift", 1e-3),
    "clock_s": ("clock", 1.0),
    "cluster_mrad": ("cluster", 1e-3),
    "dni_w_m2": ("dni", 1.0),
    "ramp_kw_m2_min": ("ramp", 1e3 / 60.0),
    "moves_per_minute": ("moves", 1.0),
    "every_s": ("every", 1.0),
    "deadline_s": ("deadline", 1.0),
}


def build_aims(table: AimsTable | None, folder: Path) -> AimSettings:
    """Return the settings in a table; limit maps and limit tables are read from files in a folder.

    Raises
    ------
    InputError
        If the settings are invalid, or a file does not have the expected contents.
    """
    if table is None:
        return AimSettings()
    limits = {
        "limit_kw_m2": table.limit_kw_m2 is not None,
        "limit_map": bool(table.limit_map),
        "limit_table": bool(table.limit_table),
    }
    if sum(limits.values()) > 1:
        both = " and ".join(key for key, present in limits.items() if present)
        raise InputError(f"aims: {both} cannot be used together; keep one of them")
    if bool(table.limit_table) != bool(table.limit_panels):
        raise InputError(
            "aims: limit_table and limit_panels must be used together; set both or neither"
        )
    limit = None
    if table.limit_kw_m2 is not None:
        limit = FluxLimit(1e3 * table.limit_kw_m2, table.margin)
    elif table.limit_map:
        limit = read_limit(folder / table.limit_map, table.margin)
    elif table.limit_table:
        files = folder / table.limit_table, folder / table.limit_panels
        limit = read_table_limit(*files, table.margin)
    keywords = {name: scale * getattr(table, key) for key, (name, scale) in _KEYS.items()}
    name = table.limit_map or table.limit_table
    return AimSettings(table.strategy, limit, name, together=table.together, **keywords)


def aims_document(settings: AimSettings, place: Path) -> dict[str, dict[str, Any]]:
    """Return the document's part with the table; a map is written beside the plant file.

    A limit that was read from a table of temperatures and velocities is written as its map.
    """
    if settings.limit is None:
        return {}
    table: dict[str, Any] = {"strategy": settings.strategy}
    if settings.map:
        table["limit_map"] = f"{place.stem}.limit.csv"
        write_limit(place.with_name(table["limit_map"]), settings.limit)
    else:
        table["limit_kw_m2"] = 1e-3 * float(settings.limit.flux)
    table["margin"], table["together"] = settings.limit.margin, settings.together
    table |= {key: getattr(settings, name) / scale for key, (name, scale) in _KEYS.items()}
    return {"aims": table}
