"""Deflectometry files in PAINT's form, made from known surfaces."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from heliotrope.airborne.mirror import MirrorShape


def write_deflectometry(
    path: Path,
    shape: MirrorShape,
    *,
    points: int = 4000,
    change: Callable[[h5py.File], None] = lambda _: None,
) -> Path:
    """Write points and normals of a surface as PAINT does: float32, one group a facet."""
    rng = np.random.default_rng(4)
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as root:
        for k in range(len(shape)):
            uv = rng.uniform(-1.0, 1.0, (points, 2)) * shape.half_size[k]
            at = shape.on_facet(np.full(points, k), uv)
            normal = shape.normal_at(np.full(points, k), at[:, :2])
            group = root.create_group(f"facet{k + 1}")
            group["surface_points"] = at.astype(np.float32)
            group["surface_normals"] = normal.astype(np.float32)
        change(root)
    return path
