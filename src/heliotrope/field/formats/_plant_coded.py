"""Reads and writes the settings of joint and receiver visits in the plant file."""

from dataclasses import MISSING, fields
from typing import Any

from heliotrope.errors import InputError
from heliotrope.field.coded_visits import CodedSettings, JointSettings, ReceiverSettings
from heliotrope.field.formats._plant_models import (
    JointVisitsTable,
    ReceiverVisitsTable,
    StrictTable,
)


def build_joint(table: JointVisitsTable | None) -> JointSettings | None:
    """Return the settings of a table; None if it allows no joint visits.

    Raises
    ------
    InputError
        If its numbers are invalid.
    """
    made = JointSettings(**_values(table, JointSettings))
    return made if table is None or table.allowed else None


def build_receiver_visits(table: ReceiverVisitsTable | None) -> ReceiverSettings | None:
    """Return the settings of a table; None if there is no table. See `build_joint`."""
    return None if table is None else ReceiverSettings(**_values(table, ReceiverSettings))


def coded_document(
    joint: JointSettings | None, receiver: ReceiverSettings | None
) -> dict[str, dict[str, Any]]:
    """Return the part of the document with these tables.

    Only values that differ from their defaults are written.
    """
    tables = {}
    if joint is None:
        tables["joint_visits"] = {"allowed": False}
    elif table := _table(joint):
        tables["joint_visits"] = table
    if receiver is not None:
        tables["receiver_visits"] = _table(receiver)
    return tables


def _values(table: StrictTable | None, made: type[CodedSettings]) -> dict[str, Any]:
    """Return the settings of a table, by name, in the program's own units."""
    given = {} if table is None else table.model_dump(exclude_none=True, exclude={"allowed"})
    values: dict[str, Any] = {}
    for name, setting in made.settings().items():
        key, written = setting.key(name), f"{name}_rad"
        if key in given and written in given:
            raise InputError(f"{made.kind}: {name} is set twice, the second time as {written}")
        if key in given:
            value = given.pop(key)
            values[name] = value * setting.scale if setting.unit else value
    return values | {key.removesuffix("_rad"): value for key, value in given.items()}


def _table(settings: CodedSettings) -> dict[str, Any]:
    """Return the table of the settings that have no default or differ from their default.

    Angles are written in radians, to preserve their last digit.
    """
    keys = {name: setting.key(name) for name, setting in settings.settings().items()}
    return {
        keys.get(f.name, f.name).replace("_mrad", "_rad"): value
        for f in fields(settings)
        if (value := getattr(settings, f.name)) != f.default or f.default is MISSING
    }
