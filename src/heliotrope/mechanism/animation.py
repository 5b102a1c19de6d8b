"""Geometry of a moving heliostat: Grigoriev's armature with its mirror, exported as GLB.

The armature is drawn as in figure 1 of Grigoriev et al. 2021: bones from the foundation over the
primary and the secondary axis to the vertex, the axes in purple and green, the mirror normal in
blue.
"""

import json
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, normalize, rotation, tangent_axes
from heliotrope.mechanism.chain import Mechanism

#: Colours of foundation, primary axis, secondary axis, mirror and normal, RGB from 0 to 1.
COLOURS: dict[str, tuple[float, float, float]] = {
    "foundation": (0.35, 0.35, 0.35),
    "primary": (0.50, 0.20, 0.60),
    "secondary": (0.15, 0.60, 0.25),
    "mirror": (0.60, 0.80, 0.95),
    "normal": (0.15, 0.30, 0.85),
}
#: Radius of a bone as a share of the mirror's half diagonal.
_THIN = 0.03
_SIDES = 8


@dataclass(frozen=True)
class Moving:
    """Points of one heliostat at T times, ENU, m.

    Attributes
    ----------
    bones
        Foot, primary head, secondary head and vertex, (T, 4, 3).
    axes
        Ends of the line drawn for the primary and the secondary axis, (T, 2, 2, 3).
    mirror
        Corners, counter-clockwise seen from the front, (T, 4, 3).
    normal
        Unit normals, (T, 3).
    """

    bones: FloatArray
    axes: FloatArray
    mirror: FloatArray
    normal: FloatArray


def moving(mechanism: Mechanism, angles: npt.ArrayLike, width: float, height: float) -> Moving:
    """Return the points of a heliostat at given joint angles.

    Parameters
    ----------
    mechanism
        One heliostat with two drives.
    angles
        Joint angles, rad, (T, 2).
    width, height
        Size of the mirror, m.

    Raises
    ------
    InputError
        If ``mechanism`` is not one mechanism with two drives, or the angles have another shape.
    """
    theta = _angles(mechanism, angles)
    arm = mechanism.armature
    first = rotation(arm.axis_1, theta[:, 0])
    normal, vertex = arm.pose(theta)
    foot = np.broadcast_to(mechanism.position, vertex.shape)
    head_1 = np.broadcast_to(arm.origin_1, vertex.shape)
    head_2 = arm.origin_1 + np.einsum("tij,j->ti", first, arm.origin_2 - arm.origin_1)
    length = 0.5 * float(np.hypot(width, height))
    along_2 = np.einsum("tij,j->ti", first, arm.axis_2)
    ends = np.array([-length, length])[:, None]
    axes = np.stack(
        [
            head_1[:, None] + ends * np.broadcast_to(arm.axis_1, vertex.shape)[:, None],
            head_2[:, None] + ends * along_2[:, None],
        ],
        axis=1,
    )
    second = rotation(arm.axis_2, theta[:, 1])
    turned = first @ second
    corners = np.einsum("tij,cj->tci", turned, _corners(mechanism, width, height))
    bones = np.stack([foot, head_1, head_2, vertex], axis=1)
    return Moving(bones, axes, vertex[:, None] + corners, normal)


def _angles(mechanism: Mechanism, angles: npt.ArrayLike) -> FloatArray:
    theta = np.asarray(angles, dtype=np.float64)
    if mechanism.shape or len(mechanism.driven) != 2:
        raise InputError(
            f"animation: {mechanism.kind} of shape {mechanism.shape}, driven joints: "
            f"{len(mechanism.driven)}; pass one heliostat with two drives"
        )
    if theta.ndim != 2 or theta.shape[1] != 2 or not len(theta) or not np.isfinite(theta).all():
        raise InputError(
            f"animation: angles have the shape {theta.shape}; pass finite angles, (T, 2)"
        )
    return theta


def _corners(mechanism: Mechanism, width: float, height: float) -> FloatArray:
    """Return the mirror corners relative to the vertex at zero angles, (4, 3).

    The secondary axis is parallel to an edge.
    """
    arm = mechanism.armature
    along = arm.axis_2 - (arm.axis_2 @ arm.normal) * arm.normal
    across = tangent_axes(arm.normal)[0] if np.linalg.norm(along) < 1e-6 else normalize(along)
    up = np.cross(arm.normal, across)
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * 0.5 * np.array([width, height])
    return np.asarray(signs[:, :1] * across + signs[:, 1:] * up)


# -- GLB -----------------------------------------------------------------------------------


def glb(
    mechanism: Mechanism, angles: npt.ArrayLike, seconds: npt.ArrayLike, width: float, height: float
) -> bytes:
    """Return a binary glTF 2.0 file of a heliostat that moves through joint angles.

    Foundation, primary bone, secondary bone and mirror are nodes, each the child of the previous
    node; the two axes are animated as rotations. Blender and every glTF viewer can show the file.
    In glTF the y axis points up, so the root node rotates ENU.

    Parameters
    ----------
    mechanism, angles, width, height
        As for `moving`.
    seconds
        Times of the angles in the animation, ascending, s, (T,).

    Raises
    ------
    InputError
        As for `moving`, or if the times are not ascending.
    """
    theta = _angles(mechanism, angles)
    times = np.asarray(seconds, dtype=np.float64)
    if times.shape != (len(theta),) or not (np.diff(times) > 0.0).all():
        raise InputError("animation: pass one time per pose, in ascending order")
    arm = mechanism.armature
    file = _Gltf()
    radius = _THIN * 0.5 * float(np.hypot(width, height))
    offset_1 = arm.origin_1 - mechanism.position
    offset_2, offset_v = arm.origin_2 - arm.origin_1, arm.vertex - arm.origin_2
    length = 0.5 * float(np.hypot(width, height))
    face = _corners(mechanism, width, height)
    mirror = file.node("mirror", offset_v, file.mesh("mirror", *_plate(face)))
    normal = file.node("normal", offset_v, file.mesh("normal", *_rod(length * arm.normal, radius)))
    parts = [
        file.node("mirror arm", None, file.mesh("secondary", *_rod(offset_v, radius))),
        file.node(
            "secondary axis", None, file.mesh("secondary", *_axle(arm.axis_2, length, radius))
        ),
    ]
    secondary = file.node("secondary", offset_2, children=[*parts, mirror, normal])
    parts = [
        file.node("primary arm", None, file.mesh("primary", *_rod(offset_2, radius))),
        file.node("primary axis", None, file.mesh("primary", *_axle(arm.axis_1, length, radius))),
    ]
    primary = file.node("primary", offset_1, children=[*parts, secondary])
    foot = file.node("foundation", None, file.mesh("foundation", *_rod(offset_1, 2.0 * radius)))
    file.root([foot, primary])
    file.animate(
        times,
        {primary: _turns(arm.axis_1, theta[:, 0]), secondary: _turns(arm.axis_2, theta[:, 1])},
    )
    return file.data()


def _turns(axis: FloatArray, angle: FloatArray) -> FloatArray:
    """Return quaternions (x, y, z, w) of rotations about an axis, (T, 4).

    Quaternions of neighbouring angles are close to each other.

    The sign of each is chosen to be near the previous one.
    """
    half = 0.5 * angle[:, None]
    return np.concatenate([np.sin(half) * axis, np.cos(half)], axis=1)


def _rod(along: FloatArray, radius: float) -> tuple[FloatArray, npt.NDArray[np.uint32]]:
    """Return the vertices and triangles of a rod that starts at the origin."""
    return _tube(np.zeros(3), along, radius)


def _axle(
    axis: FloatArray, length: float, radius: float
) -> tuple[FloatArray, npt.NDArray[np.uint32]]:
    return _tube(-length * axis, length * axis, 0.6 * radius)


def _tube(
    start: FloatArray, end: FloatArray, radius: float
) -> tuple[FloatArray, npt.NDArray[np.uint32]]:
    span = end - start
    if np.linalg.norm(span) < 1e-9:
        end, span = start + 1e-6 * np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1e-6])
    frame = tangent_axes(span / np.linalg.norm(span))
    turn = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    ring = radius * (np.cos(turn)[:, None] * frame[0] + np.sin(turn)[:, None] * frame[1])
    points = np.concatenate([start + ring, end + ring])
    faces = []
    for k in range(_SIDES):
        current, following = k, (k + 1) % _SIDES
        faces += [
            (current, following, current + _SIDES),
            (following, following + _SIDES, current + _SIDES),
        ]
    return points, np.array(faces, dtype=np.uint32)


def _plate(corners: FloatArray) -> tuple[FloatArray, npt.NDArray[np.uint32]]:
    faces = [(0, 1, 2), (0, 2, 3), (0, 2, 1), (0, 3, 2)]
    return corners, np.array(faces, dtype=np.uint32)


class _Gltf:
    """The parts of a glTF document with a single buffer."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        materials = [
            {
                "name": name,
                "doubleSided": True,
                "pbrMetallicRoughness": {"baseColorFactor": [*rgb, 1.0], "metallicFactor": 0.1},
            }
            for name, rgb in COLOURS.items()
        ]
        self._document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "Heliotrope"},
            "nodes": [],
            "meshes": [],
            "materials": materials,
            "accessors": [],
            "bufferViews": [],
        }

    def _add(self, kind: str, value: dict[str, Any]) -> int:
        self._document[kind].append(value)
        return len(self._document[kind]) - 1

    def _accessor(self, values: np.ndarray, kind: str, limits: bool = False) -> int:
        raw = values.tobytes()
        view = self._add(
            "bufferViews", {"buffer": 0, "byteOffset": len(self._bytes), "byteLength": len(raw)}
        )
        self._bytes += raw + b"\0" * (-len(raw) % 4)
        component = 5125 if values.dtype == np.uint32 else 5126
        made: dict[str, Any] = {
            "bufferView": view,
            "componentType": component,
            "count": values.size if kind == "SCALAR" else len(values),
            "type": kind,
        }
        if limits:
            flat = values.reshape(made["count"], -1)
            made |= {"min": flat.min(axis=0).tolist(), "max": flat.max(axis=0).tolist()}
        return self._add("accessors", made)

    def mesh(self, material: str, points: FloatArray, faces: npt.NDArray[np.uint32]) -> int:
        """Add a mesh and return its index."""
        place = self._accessor(points.astype(np.float32), "VEC3", limits=True)
        corners = self._accessor(faces.ravel(), "SCALAR")
        part = {
            "attributes": {"POSITION": place},
            "indices": corners,
            "material": list(COLOURS).index(material),
        }
        return self._add("meshes", {"name": material, "primitives": [part]})

    def node(
        self,
        name: str,
        offset: FloatArray | None,
        mesh: int | None = None,
        children: list[int] | None = None,
    ) -> int:
        """Add a node and return its index."""
        made: dict[str, Any] = {"name": name}
        if offset is not None:
            made["translation"] = [float(v) for v in offset]
        if mesh is not None:
            made["mesh"] = mesh
        if children:
            made["children"] = children
        return self._add("nodes", made)

    def root(self, children: list[int]) -> None:
        """Add the scene and its root node, which rotates ENU into glTF's y-up frame."""
        half = np.sqrt(0.5)
        number = self.node("heliostat", None, children=children)
        self._document["nodes"][number]["rotation"] = [-half, 0.0, 0.0, half]
        self._document |= {"scene": 0, "scenes": [{"nodes": [number]}]}

    def animate(self, times: FloatArray, turns: dict[int, FloatArray]) -> None:
        """Add an animation of nodes by rotations (T, 4)."""
        clock = self._accessor(times.astype(np.float32), "SCALAR", limits=True)
        samplers: list[dict[str, Any]] = []
        channels: list[dict[str, Any]] = []
        for node, values in turns.items():
            output = self._accessor(values.astype(np.float32), "VEC4")
            channels.append(
                {"sampler": len(samplers), "target": {"node": node, "path": "rotation"}}
            )
            samplers.append({"input": clock, "output": output, "interpolation": "LINEAR"})
        self._document["animations"] = [{"name": "day", "samplers": samplers, "channels": channels}]

    def data(self) -> bytes:
        """Return the bytes of the file."""
        self._document["buffers"] = [{"byteLength": len(self._bytes)}]
        text = json.dumps(self._document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + len(self._bytes)
        head = struct.pack("<4sII", b"glTF", 2, total)
        first = struct.pack("<I4s", len(text), b"JSON") + text
        return head + first + struct.pack("<I4s", len(self._bytes), b"BIN\0") + bytes(self._bytes)
