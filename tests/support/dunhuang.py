"""A real plant's 11,915 mirrors with reference flux, by an independent program."""

import json
from functools import cache
from typing import Any

import numpy as np

from heliotrope.geometry import bisector, normalize
from heliotrope.optics.scene import Mirrors, Scene
from heliotrope.optics.surfaces import Cylinder
from support.data import fields


@cache
def efficiencies() -> dict[str, Any]:
    """Positions, aims, suns, and the exact shares of each mirror at them."""
    file = fields() / "dunhuang" / "ref_eff_dunhuang.json"
    return json.loads(file.read_text(encoding="utf-8"))  # type: ignore[no-any-return]


def flux(name: str) -> dict[str, Any]:
    """What 10⁷ rays of another tracer say: "high_slant", "mid_slant", "low_slant", "high_flat"."""
    file = fields() / "dunhuang" / f"ref_flux_dunhuang_{name}.json"
    return json.loads(file.read_text(encoding="utf-8"))  # type: ignore[no-any-return]


def scene(name: str, cells: tuple[int, int] = (20, 56)) -> Scene:
    """Return the scene of one of these; columns begin in the north and go eastwards."""
    sun, figure = name.split("_")
    known = efficiencies()
    position, aim = np.array(known["positions"]), np.array(known["aims"])
    light = np.array(known["suns"][sun]["sun"])
    normal = bisector(light, normalize(aim - position))
    more = {"focal": np.inf} if figure == "flat" else {}
    size = (known["mirror_width_m"], known["mirror_height_m"])
    mirrors = Mirrors.of(position, normal, size, aim, slope=1.5e-3, reflectivity=1.0, **more)
    up, north = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    center = np.array([0.0, 0.0, 229.3])
    receiver = Cylinder("receiver", center, up, north, 7.565, 18.6, shape=cells)
    return Scene(light, 1000.0, mirrors, (receiver,))
