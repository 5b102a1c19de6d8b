"""The moving armature, and the binary glTF of it."""

import json
import struct
from typing import Any

import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.mechanism.animation import glb, moving
from heliotrope.mechanism.chain import Mechanism
from support.machines import every_kind, imperfect

ANGLES = np.array([[0.0, 0.0], [0.4, -0.3], [-2.0, 1.1]])
TWO = [name for name, machine in every_kind().items() if len(machine.driven) == 2]


def counts_at(mechanism: Mechanism) -> np.ndarray:
    return np.stack([mechanism.drives.counts(angles) for angles in ANGLES])


@pytest.mark.parametrize("name", [name for name in TWO if name != "two_jacks"])
def test_the_mirror_stands_where_the_mechanism_puts_it(name: str) -> None:
    mechanism = imperfect(every_kind()[name])
    scene = moving(mechanism, ANGLES, 3.0, 2.0)
    pose = mechanism.pose(counts_at(mechanism))
    np.testing.assert_allclose(scene.bones[:, 3], pose.vertex, atol=1e-9)
    np.testing.assert_allclose(scene.normal, pose.normal, atol=1e-12)
    np.testing.assert_allclose(scene.mirror.mean(axis=1), pose.vertex, atol=1e-9)
    across, up = scene.mirror[:, 1] - scene.mirror[:, 0], scene.mirror[:, 3] - scene.mirror[:, 0]
    np.testing.assert_allclose(np.linalg.norm(across, axis=1), 3.0)
    np.testing.assert_allclose(np.linalg.norm(up, axis=1), 2.0)
    np.testing.assert_allclose(np.cross(across, up) / 6.0, pose.normal, atol=1e-12)


def read(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return document and buffer of a GLB, as the glTF 2.0 specification lays it out."""
    magic, version, total = struct.unpack_from("<4sII", data)
    assert (magic, version, total) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    rest, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0"
    return document, data[28 + size : 28 + size + rest]


def values(document: dict[str, Any], buffer: bytes, number: int) -> np.ndarray:
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    kind = {5125: np.uint32, 5126: np.float32}[accessor["componentType"]]
    raw = buffer[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    return np.frombuffer(raw, kind).reshape(accessor["count"], -1)


def turned(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    xyz, w = quaternion[:3], quaternion[3]
    return np.asarray(vector + 2.0 * np.cross(xyz, np.cross(xyz, vector) + w * vector))


@pytest.mark.parametrize("name", [name for name in TWO if name != "two_jacks"])
def test_the_nodes_of_the_glb_move_the_mirror_as_the_mechanism_does(name: str) -> None:
    mechanism = imperfect(every_kind()[name])
    document, buffer = read(glb(mechanism, ANGLES, [0.0, 1.0, 2.5], 3.0, 2.0))
    nodes = {node["name"]: node for node in document["nodes"]}
    (animation,) = document["animations"]
    turns = {}
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        assert values(document, buffer, sampler["input"]).ravel() == pytest.approx([0.0, 1.0, 2.5])
        moved = document["nodes"][channel["target"]["node"]]["name"]
        turns[moved] = values(document, buffer, sampler["output"]).astype(np.float64)
    assert set(turns) == {"primary", "secondary"}
    corners = values(
        document, buffer,
        document["meshes"][nodes["mirror"]["mesh"]]["primitives"][0]["attributes"]["POSITION"],
    )  # fmt: skip
    scene = moving(mechanism, ANGLES, 3.0, 2.0)
    for k in range(len(ANGLES)):
        place = corners + nodes["mirror"]["translation"]
        for part in ("secondary", "primary"):
            place = np.array([turned(turns[part][k], point) for point in place])
            place = place + nodes[part]["translation"]
        np.testing.assert_allclose(place + mechanism.position, scene.mirror[k], atol=1e-5)
    # The root turns up to glTF's y: z goes to y, north to -z.
    root = np.array(nodes["heliostat"]["rotation"])
    np.testing.assert_allclose(turned(root, np.array([0.0, 0.0, 1.0])), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(turned(root, np.array([0.0, 1.0, 0.0])), [0, 0, -1], atol=1e-12)


def test_what_cannot_be_animated() -> None:
    machine = every_kind()["tilt_roll"]
    with pytest.raises(InputError, match="pass one heliostat with two drives"):
        moving(every_kind()["single_axis"], ANGLES, 1.0, 1.0)
    with pytest.raises(InputError, match=r"angles have the shape \(2,\); pass finite angles"):
        moving(machine, [0.0, 1.0], 1.0, 1.0)
    with pytest.raises(InputError, match="one time per pose, in ascending order"):
        glb(machine, ANGLES, [0.0, 2.0, 1.0], 1.0, 1.0)
