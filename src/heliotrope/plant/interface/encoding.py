"""Encodes views as JSON values, and a frame of the field as the bytes of its arrays."""

import dataclasses
import math
from collections.abc import Mapping
from datetime import datetime
from enum import Enum
from typing import Any

import numpy as np

from heliotrope.plant.operations.views import FieldFrame


def plain(value: Any) -> Any:
    """Return the JSON values of views: lists, dictionaries, numbers, text; NaN as None."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Enum):
        return value.name.lower()
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, datetime):
        return value.isoformat()
    return str(value)


def frame_parts(frame: FieldFrame) -> tuple[dict[str, Any], bytes]:
    """Return a frame as JSON values and the bytes of its arrays, one after the other."""
    head, blob = dict[str, Any](), bytearray()
    for field in dataclasses.fields(frame):
        value = getattr(frame, field.name)
        if isinstance(value, np.ndarray):
            head[field.name] = [value.dtype.str, list(value.shape)]
            blob += value.tobytes()
        else:
            head[field.name] = value
    return head, bytes(blob)


def frame_of(head: Mapping[str, Any], blob: bytes) -> FieldFrame:
    """Return the frame that `frame_parts` has encoded."""
    values, at = dict[str, Any](), 0
    for field in dataclasses.fields(FieldFrame):
        value = head[field.name]
        if isinstance(value, list):
            kind, shape = np.dtype(value[0]), tuple(value[1])
            count = math.prod(shape)
            value = np.frombuffer(blob, kind, count, at).reshape(shape)
            at += count * kind.itemsize
        values[field.name] = value
    return FieldFrame(**values)
