"""Settings of joint and of receiver visits in a plant's TOML file, read and written.

A key is the name of a setting and its unit, so a new setting needs a field in the settings and a
row in their table, and nothing here.
"""

from dataclasses import MISSING, fields
from typing import Any

from heliotrope.errors import InputError
from heliotrope.field.coded_visits import CodedSettings, JointSettings, ReceiverSettings
from heliotrope.field.formats._plant_models import (
    CodedVisitsTable,
    JointVisitsTable,
    ReceiverVisitsTable,
)

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
    made = JointSettings(**_values(table, JointSettings.kind))
    return made if table is None or table.allowed else None


def build_receiver(table: ReceiverVisitsTable | None) -> ReceiverSettings | None:
    """Return the settings of a table, see `build_joint`; None without one."""
    return None if table is None else ReceiverSettings(**_values(table, ReceiverSettings.kind))


def coded_document(
    joint: JointSettings | None, receiver: ReceiverSettings | None
) -> dict[str, dict[str, Any]]:
    """Return the document's part with the tables: what differs from the default."""
    tables = {}
    if joint is None:
        tables["joint_visits"] = {"allowed": False}
    elif table := _table(joint, JointVisitsTable):
        tables["joint_visits"] = table
    if receiver is not None:
        tables["receiver_visits"] = _table(receiver, ReceiverVisitsTable)
    return tables


def _values(table: CodedVisitsTable | None, kind: str) -> dict[str, Any]:
    """Return the settings that a table gives, by name, in the program's own units."""
    values: dict[str, Any] = {}
    given = {} if table is None else table.model_dump(exclude_none=True, exclude={"allowed"})
    for key, value in given.items():
        unit = next((unit for unit in _UNITS if key.endswith(unit)), "")
        name = key.removesuffix(unit)
        if name in values:
            raise InputError(f"{kind}: {name} is given twice, the second time as {key}")
        values[name] = value * _UNITS[unit] if unit else value
    return values


def _table(settings: CodedSettings, model: type[CodedVisitsTable]) -> dict[str, Any]:
    """Return the table of settings: those without a default, and those that differ from it."""
    keys = model.model_fields
    return {
        next(f.name + unit for unit in _WRITTEN if f.name + unit in keys): value
        for f in fields(settings)
        if (value := getattr(settings, f.name)) != f.default or f.default is MISSING
    }
