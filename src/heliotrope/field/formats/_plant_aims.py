"""How aims are chosen, in the plant file: read and written."""

from pathlib import Path
from typing import Any

from heliotrope.errors import InputError
from heliotrope.field.aim_settings import AimSettings
from heliotrope.field.flux_limit import FluxLimit, read_limit, write_limit
from heliotrope.field.formats._plant_models import AimsTable

#: Settings by key, and the factor from the key's unit.
_KEYS = {
    "probability": ("probability", 1.0),
    "drift_mrad": ("drift", 1e-3),
    "clock_s": ("clock", 1.0),
    "cluster_mrad": ("cluster", 1e-3),
    "dni_w_m2": ("dni", 1.0),
    "moves_per_minute": ("moves", 1.0),
    "every_s": ("every", 1.0),
    "deadline_s": ("deadline", 1.0),
}


def build_aims(table: AimsTable | None, folder: Path) -> AimSettings:
    """Return the settings of a table; a map is read from a file in a folder.

    Raises
    ------
    InputError
        If they cannot be, or the map is no table of numbers.
    """
    if table is None:
        return AimSettings()
    if table.limit_kw_m2 is not None and table.limit_map:
        raise InputError("aims: both limit_kw_m2 and limit_map are set; keep one")
    limit = None
    if table.limit_kw_m2 is not None:
        limit = FluxLimit(1e3 * table.limit_kw_m2, table.margin)
    elif table.limit_map:
        limit = read_limit(folder / table.limit_map, table.margin)
    keywords = {name: scale * getattr(table, key) for key, (name, scale) in _KEYS.items()}
    return AimSettings(table.strategy, limit, table.limit_map, together=table.together, **keywords)


def aims_document(settings: AimSettings, place: Path) -> dict[str, dict[str, Any]]:
    """Return the document's part with the table; a map is written beside the plant file."""
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
