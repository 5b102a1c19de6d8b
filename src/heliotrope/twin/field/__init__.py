"""A whole field of local controllers as arrays: `Field`, with a `FieldBus` for each cluster."""

from heliotrope.twin.field.field import Field
from heliotrope.twin.field.field_bus import FieldBus

__all__ = ["Field", "FieldBus"]
