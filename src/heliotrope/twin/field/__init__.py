"""A whole field of local controllers as arrays: a `Field`, and a `FieldBus` for each cluster."""

from heliotrope.twin.field.field import Field
from heliotrope.twin.field.field_bus import FieldBus

__all__ = ["Field", "FieldBus"]
