"""Copies of whole worlds for tests."""

import copy
from typing import Any, TypeVar
from unittest.mock import patch

import numpy as np

T = TypeVar("T")


def _same_kind(array: Any, memo: dict[int, Any]) -> Any:
    made = np.array(array, order="K", copy=True)
    made.flags.writeable = array.flags.writeable
    memo[id(array)] = made
    return made


def copied(world: T) -> T:
    """Return a deep copy in which read-only arrays stay so: kernels are compiled for each kind."""
    with patch.dict(copy._deepcopy_dispatch, {np.ndarray: _same_kind}):  # type: ignore[attr-defined]
        return copy.deepcopy(world)
