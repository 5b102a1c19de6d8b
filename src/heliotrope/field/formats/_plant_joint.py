"""Settings of joint and of receiver visits in a plant's TOML file, read and written.

A key is the name of a setting and its unit, so a new setting needs a field in the settings and a
row in their table, and nothing here.
"""

from dataclasses import MISSING, fields
from typing import Any

from heliotrope.errors import InputError
from heliotrope.field.formats._plant_models import (
    JointVisitsTable,
    ReceiverVisitsTable,
    StrictTable,
)
from heliotrope.field.joint_visits import JointSettings
from heliotrope.field.receiver_visits import ReceiverSettings

#: Units at the end of a key, and what makes them the program's own.
_UNITS = {"_mrad": 1e-3, "_rad": 1.0, "_s": 1.0, "_suns": 1.0}
#: Units that the program writes: the last digit survives in them.
_WRITTEN = ("", "_rad", "_s", "_suns")


def build_joint(table: JointVisitsTable | None) -> JointSettings | None:
    """Return the settings of a table; None if it allows no joint visits.

    Raises
    ------
    InputError
        If its numbers cannot be.
    """
    made = JointSettings(**_values(table, "joint visits"))
    return made if table is None or table.allowed else None


def joint_document(settings: JointSettings | None) -> dict[str, Any]:
    """Return the document's part with the table: what differs from the default."""
    if settings is None:
        return {"joint_visits": {"allowed": False}}
    table = _table(settings, JointVisitsTable)
    return {"joint_visits": table} if table else {}


def build_receiver_visits(table: ReceiverVisitsTable | None) -> ReceiverSettings | None:
    """Return the settings of a table; None without one.

    Raises
    ------
    InputError
        If its numbers cannot be.
    """
    return None if table is None else ReceiverSettings(**_values(table, "receiver visits"))


def receiver_visits_document(settings: ReceiverSettings | None) -> dict[str, Any]:
    """Return the document's part with the table: what differs from the default."""
    return {} if settings is None else {"receiver_visits": _table(settings, ReceiverVisitsTable)}


def _values(table: StrictTable | None, who: str) -> dict[str, Any]:
    """Return the settings that a table gives, by name, in the program's own units."""
    values: dict[str, Any] = {}
    settings = {} if table is None else table.model_dump(exclude_none=True, exclude={"allowed"})
    for key, value in settings.items():
        unit = next((unit for unit in _UNITS if key.endswith(unit)), "")
        name = key.removesuffix(unit)
        if name in values:
            raise InputError(f"{who}: {name} is given twice, the second time as {key}")
        values[name] = value * _UNITS[unit] if unit else value
    return values


def _table(settings: JointSettings | ReceiverSettings, model: type[StrictTable]) -> dict[str, Any]:
    """Return the table of settings: those without a default, and those that differ from it."""
    keys = model.model_fields
    return {
        next(f.name + unit for unit in _WRITTEN if f.name + unit in keys): value
        for f in fields(settings)
        if (value := getattr(settings, f.name)) != f.default or f.default is MISSING
    }
