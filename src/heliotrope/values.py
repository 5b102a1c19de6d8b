"""What records of arrays have in common: they are compared by their content."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np


class Value:
    """Base of frozen dataclasses that hold arrays (``eq=False``): ``==`` compares their content.

    Arrays are equal if shape and numbers are; NaN equals NaN. Values have no hash.
    """

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return _same_fields(self, other)

    __hash__ = None  # type: ignore[assignment]


def _same_fields(a: Any, b: Any) -> bool:
    return all(_alike(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))


def _alike(a: Any, b: Any) -> bool:
    if a is b:
        return True
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        one, two = np.asarray(a), np.asarray(b)
        return np.array_equal(one, two, equal_nan=one.dtype.kind == two.dtype.kind == "f")
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(_alike(a[key], b[key]) for key in a)
    if isinstance(a, tuple | list) and isinstance(b, tuple | list):
        return len(a) == len(b) and all(map(_alike, a, b))
    if is_dataclass(a) and type(a) is type(b):
        return _same_fields(a, b)
    return bool(a == b)
