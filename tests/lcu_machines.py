"""What the tests of the local controller share: single precision, drives and armatures."""

import importlib
import importlib.util
import math
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np

import heliotrope.lcu
from heliotrope.lcu import drives
from heliotrope.mechanism import _slots as slot
from heliotrope.mechanism.drives import Drive


def single(name: str) -> ModuleType:
    """A copy of a module of the local controller whose ``math`` gives 32-bit floats.

    Fed with ``numpy.float32`` it rounds every operation to single precision, as a board
    without doubles does.
    """
    package = "lcu_single"
    if package not in sys.modules:
        init = Path(heliotrope.lcu.__file__)
        spec = importlib.util.spec_from_file_location(
            package, init, submodule_search_locations=[str(init.parent)]
        )
        assert spec is not None
        sys.modules[package] = importlib.util.module_from_spec(spec)
    module = importlib.import_module(f"{package}.{name}")

    def rounding(function):  # type: ignore[no-untyped-def]
        return lambda *values: np.float32(function(*map(float, values)))

    rounded = {name: rounding(getattr(math, name)) for name in ("sqrt", "sin", "cos", "atan2")}
    shim = SimpleNamespace(
        pi=np.float32(math.pi), inf=np.float32(math.inf), floor=math.floor, ceil=math.ceil,
        isfinite=math.isfinite, **rounded,
    )  # fmt: skip
    for other in ("vectors", name):
        sys.modules[f"{package}.{other}"].math = shim  # type: ignore[attr-defined]
    return module


def f32(values: object) -> tuple[np.float32, ...]:
    return tuple(np.float32(value) for value in np.asarray(values, dtype=float))


ORDER = (
    slot.ZERO, slot.RATE, slot.STROKE, slot.OFFSET, slot.RADIUS, slot.SCALE, slot.WORM_COS,
    slot.WORM_SIN, slot.WORM_RATIO, slot.SAG,
)  # fmt: skip


def numbers_of(known: Drive) -> tuple[int, tuple[float, ...], float]:
    """Kind, ten numbers and bias of a drive of the mechanism."""
    table = known.table
    kind = drives.ROTARY
    if table[slot.KIND] == slot.LINEAR:
        kind = drives.JACK_RISING if table[slot.SENSE] > 0 else drives.JACK_FALLING
    numbers = tuple(float(table[i]) for i in ORDER)
    phase = float(table[slot.SAG_PHASE])
    return (kind, *drives.reduced(kind, numbers, float(table[slot.BIAS]), phase))
