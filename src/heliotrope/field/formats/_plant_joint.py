"""Settings of joint visits in a plant's TOML file, read and written.

A key is the name of a setting and its unit, so a new setting needs a field in `JointSettings` and a
row in `JointVisitsTable`, and nothing here.
"""

from dataclasses import fields
from typing import Any

from heliotrope.errors import InputError
from heliotrope.field.formats._plant_models import JointVisitsTable
from heliotrope.field.joint_visits import JointSettings

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
    values: dict[str, Any] = {}
    given = {} if table is None else table.model_dump(exclude_none=True, exclude={"allowed"})
    for key, value in given.items():
        unit = next((unit for unit in _UNITS if key.endswith(unit)), "")
        name = key.removesuffix(unit)
        if name in values:
            raise InputError(f"joint visits: {name} is given twice, the second time as {key}")
        values[name] = value * _UNITS[unit] if unit else value
    made = JointSettings(**values)
    return made if table is None or table.allowed else None


def joint_document(settings: JointSettings | None) -> dict[str, Any]:
    """Return the document's part with the table: what differs from the default."""
    if settings is None:
        return {"joint_visits": {"allowed": False}}
    usual, keys = JointSettings(), JointVisitsTable.model_fields
    values = {f.name: getattr(settings, f.name) for f in fields(settings)}
    table = {
        next(name + unit for unit in _WRITTEN if name + unit in keys): value
        for name, value in values.items()
        if value != getattr(usual, name)
    }
    return {"joint_visits": table} if table else {}
