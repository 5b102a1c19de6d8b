"""Meshes of receivers in files: Wavefront OBJ (read and written) and binary STL (read)."""

from pathlib import Path

import numpy as np

from heliotrope.errors import FormatError, InputError
from heliotrope.field.mesh import TriangleMesh
from heliotrope.files.limits import check_file
from heliotrope.files.text import read_text, write_text

_WHAT = "a mesh (.obj, or binary .stl)"
#: Size of the header of an STL file, and of a triangle, bytes.
_HEADER, _TRIANGLE = 84, 50


def read_mesh(path: str | Path) -> TriangleMesh:
    """Return the mesh in a file, in metres.

    Parameters
    ----------
    path
        ``.obj``: lines ``v x y z`` and ``f i j k …``; polygons must be flat and convex, and are
        divided into triangles; all other lines are ignored. ``.stl``: binary.

    Raises
    ------
    FormatError
        If the file cannot be read, or is not a mesh.
    """
    file = check_file(path, _WHAT, binary=True)
    suffix = file.suffix.casefold()
    if suffix not in (".obj", ".stl"):
        raise FormatError(file, f"the name ends in {file.suffix!r}; meshes are .obj or .stl")
    try:
        return _read_obj(file) if suffix == ".obj" else _read_stl(file)
    except InputError as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(file, str(error)) from None


def write_mesh(path: str | Path, mesh: TriangleMesh) -> None:
    """Write a mesh as OBJ, in metres, so that `read_mesh` returns exactly the same mesh."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces.tolist()]
    write_text(path, "\n".join(lines) + "\n")


def _read_obj(file: Path) -> TriangleMesh:
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    for number, line in enumerate(read_text(file, _WHAT).splitlines(), start=1):
        kind, *parts = line.split() or [""]
        try:
            if kind == "v":
                x, y, z = (float(part) for part in parts[:3])
                vertices.append([x, y, z])
            elif kind == "f":
                # A corner is vertex, vertex/texture or vertex/texture/normal; −1 is the last
                # vertex.
                corners = [int(part.split("/")[0]) for part in parts]
                rows = [c - 1 if c > 0 else len(vertices) + c for c in corners]
                if len(rows) < 3:
                    raise ValueError
                faces += [(rows[0], rows[k], rows[k + 1]) for k in range(1, len(rows) - 1)]
        except ValueError:
            expected = "three coordinates in m" if kind == "v" else "three vertex numbers or more"
            raise FormatError(
                file, f"{line.strip()[:40]!r}: expected {expected}", f"line {number}"
            ) from None
    if not faces:
        raise FormatError(file, "the mesh has no faces; it needs lines v x y z and f i j k")
    return TriangleMesh(np.array(vertices).reshape(-1, 3), np.array(faces))


def _read_stl(file: Path) -> TriangleMesh:
    data = file.read_bytes()
    count = int.from_bytes(data[_HEADER - 4 : _HEADER], "little")
    if len(data) != _HEADER + _TRIANGLE * count or not count:
        raise FormatError(
            file,
            f"{len(data):,} bytes for {count:,} triangles are not a complete binary STL; save the "
            "mesh as binary STL or as OBJ",
        )
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    corners = np.frombuffer(data, kind, offset=_HEADER)["corners"].reshape(-1, 3)
    vertices, index = np.unique(corners, axis=0, return_inverse=True)
    return TriangleMesh(vertices.astype(np.float64), index.reshape(-1, 3))
