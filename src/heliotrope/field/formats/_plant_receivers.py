"""Reads and writes the receivers in a plant file."""

from pathlib import Path
from typing import Any

import numpy as np

from heliotrope.errors import InputError
from heliotrope.field.formats._plant_models import ReceiverTable
from heliotrope.field.formats.meshes import read_mesh, write_mesh
from heliotrope.field.mesh import TriangleMesh, cavity_wall
from heliotrope.field.target import Receiver


def build_receiver(table: ReceiverTable, folder: Path) -> Receiver:
    """Return the receiver of a table; a mesh is read from a file in a folder.

    Raises
    ------
    InputError
        If a value is missing or cannot be used, or the file is not a mesh.
    """
    mesh = _mesh(table, folder)
    width, height = table.width_m, table.height_m
    if table.kind == "mesh" and mesh is not None:
        reach = 2.0 * np.abs(mesh.vertices).max(axis=0)
        # A flat mesh may lie in the plane of an edge.
        width, height = width or max(float(reach[0]), 1e-3), height or max(float(reach[1]), 1e-3)
    if width is None or height is None:
        raise InputError(f"receiver {table.name}: kind {table.kind} needs width_m and height_m")
    cavity = table.kind == "cavity"
    return Receiver(
        table.name,
        table.kind,
        np.array(table.center_m),
        np.array(table.normal),
        width,
        height,
        None if table.corners_m is None else np.array(table.corners_m),
        0.0 if cavity else table.radius_m,
        0.0 if cavity else table.opening_angle_rad,
        1e6 * (table.nominal_power_mw or 0.0),
        mesh,
    )


def _mesh(table: ReceiverTable, folder: Path) -> TriangleMesh | None:
    where = f"receiver {table.name}"
    if table.inner_height_m is not None and (table.kind != "cavity" or table.mesh):
        raise InputError(
            f"{where}: inner_height_m applies only to a cavity's cylindrical wall; remove it"
        )
    if table.kind not in ("cavity", "mesh"):
        if table.mesh:
            raise InputError(f"{where}: kind {table.kind} takes no mesh; remove it")
        return None
    if table.mesh:
        if table.radius_m or table.opening_angle_rad:
            raise InputError(
                f"{where}: mesh cannot be combined with radius_m or opening_angle_rad; keep one of "
                "them"
            )
        return read_mesh(folder / table.mesh)
    if table.kind == "mesh" or not table.radius_m or table.height_m is None:
        wall = ", or radius_m and height_m" if table.kind == "cavity" else ""
        raise InputError(f"{where}: kind {table.kind} needs mesh, a file{wall}")
    opening = table.opening_angle_rad or np.pi
    return cavity_wall(table.radius_m, opening, table.inner_height_m or table.height_m)


def receiver_document(receiver: Receiver, number: int, place: Path) -> dict[str, Any]:
    """Return the table of a receiver; a mesh is written beside the plant file.

    Parameters
    ----------
    receiver, number
        The receiver, and its index among the plant's receivers.
    place
        The plant file.
    """
    r = receiver
    corners = {} if r.corners is None else {"corners_m": r.corners.tolist()}
    document = {
        "name": r.name,
        "kind": r.kind,
        "center_m": r.center.tolist(),
        "normal": r.normal.tolist(),
        "width_m": r.width,
        "height_m": r.height,
        **corners,
        "radius_m": r.radius,
        "opening_angle_rad": r.opening_angle,
        **({"nominal_power_mw": 1e-6 * r.nominal_power} if r.nominal_power else {}),
    }
    if r.mesh is not None:
        document["mesh"] = f"{place.stem}.receiver-{number + 1}.obj"
        write_mesh(place.with_name(document["mesh"]), r.mesh)
    return document
