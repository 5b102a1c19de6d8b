"""Converts marks and cameras between plant-file tables and objects."""

from typing import Any

import numpy as np

from heliotrope.field.camera import Camera
from heliotrope.field.formats._plant_models import CameraTable, MarkTable
from heliotrope.field.marks import Mark


def build_mark(table: MarkTable) -> Mark:
    """Return the mark of a table."""
    stroke = table.stroke_m
    if stroke is None:
        stroke = 0.2 * table.size_m if table.kind in ("corner", "tee") else 0.0
    return Mark(
        table.name,
        table.kind,
        np.array(table.at_m),
        table.size_m,
        stroke,
        float(np.radians(table.turn_deg)),
        table.code,
    )


def mark_document(mark: Mark) -> dict[str, Any]:
    """Return the table of a mark."""
    return {
        "name": mark.name,
        "kind": mark.kind,
        "at_m": mark.point.tolist(),
        "size_m": mark.size,
        **({"stroke_m": mark.stroke} if mark.stroke else {}),
        "turn_deg": float(np.degrees(mark.turn)),
        **({"code": mark.code} if mark.code else {}),
    }


def build_camera(table: CameraTable) -> Camera:
    """Return the camera of a table."""
    (fx, fy), (cx, cy) = table.focal_px, table.center_px
    return Camera(
        name=table.name,
        size=(table.size_px[0], table.size_px[1]),
        matrix=np.array([[fx, table.skew_px, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        distortion=np.array(table.distortion),
        position=None if table.position_m is None else np.array(table.position_m),
        # The file holds the rows of the inverse: right, down, forward in ENU.
        R_enu_camera=None if table.rotation is None else np.array(table.rotation).T,
        targets=tuple(table.targets),
        source=table.source,
        deviation=table.deviation_px,
    )


def camera_document(camera: Camera) -> dict[str, Any]:
    """Return the table of a camera."""
    document: dict[str, Any] = {
        "name": camera.name,
        "size_px": list(camera.size),
        "focal_px": [float(camera.matrix[0, 0]), float(camera.matrix[1, 1])],
        "center_px": camera.matrix[:2, 2].tolist(),
        "skew_px": float(camera.matrix[0, 1]),
        "distortion": camera.distortion.tolist(),
        "targets": list(camera.targets),
        "source": camera.source,
        "deviation_px": camera.deviation,
    }
    if camera.position is not None and camera.R_enu_camera is not None:
        document["position_m"] = camera.position.tolist()
        document["rotation"] = camera.R_enu_camera.T.tolist()
    return document
