"""The stations of a flight plan (``plan.json``): heliostats, pose, photograph positions."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from heliotrope.errors import UnknownNameError
from heliotrope.files.json import JsonNode, read_json
from heliotrope.geometry import FloatArray, as_float


@dataclass(frozen=True)
class PlannedStation:
    """One hover pattern over one cluster in one pose.

    Attributes
    ----------
    name
        Cluster and calibration point, such as ``C1-3``, which is the name of the photograph folder.
    heliostats
        Indices of the heliostats in the list of names, (N,), without those that cannot face the
        drone.
    counts
        Drive counts of the heliostats, (N, D).
    pattern
        Positions of the photographs, in order, ENU metres, (P, 3).
    middle
        Middle of the cluster, ENU metres, (3,).
    """

    name: str
    heliostats: npt.NDArray[np.intp]
    counts: FloatArray
    pattern: FloatArray
    middle: FloatArray


def read_stations(path: str | Path, names: Sequence[str]) -> tuple[PlannedStation, ...]:
    """Return the stations of a plan, in the order of the file.

    Parameters
    ----------
    path
        ``plan.json`` written by ``heliotrope drone plan``.
    names
        Names of the heliostats to measure.

    Raises
    ------
    FormatError
        If the file is not a flight plan.
    UnknownNameError
        If the plan contains a heliostat that is not in ``names``.
    """
    root = read_json(path, "a flight plan (plan.json)")
    version = root["format"].text()
    if version != "heliotrope flight plan 1":
        raise root["format"].fail(f"{version!r} is unknown; use 'heliotrope flight plan 1'")
    index = {name: i for i, name in enumerate(names)}
    clusters: dict[str, tuple[npt.NDArray[np.intp], FloatArray]] = {}
    for node in root["clusters"].elements():
        rows = []
        for heliostat in node["heliostats"].elements():
            if heliostat.text() not in index:
                raise UnknownNameError(
                    f"heliostat ({path}) in this group:", heliostat.text(), names
                )
            rows.append(index[heliostat.text()])
        center = as_float(node["center_m"].vector())
        clusters[node["name"].text()] = np.array(rows, dtype=np.intp), center
    patterns = _patterns(root)
    return tuple(
        _station(node, clusters, patterns.get(k, np.empty((0, 3))))
        for k, node in enumerate(root["stations"].elements())
    )


def _patterns(root: JsonNode) -> dict[int, FloatArray]:
    """Return the photograph positions of each station, which several sorties may share."""
    parts: dict[int, list[tuple[float, FloatArray]]] = {}
    for sortie in root["sorties"].elements():
        for visit in sortie["visits"].elements():
            places = as_float([p.vector() for p in visit["photographs_m"].elements()])
            station = int(visit["station"].number(0))
            parts.setdefault(station, []).append((visit["first"].number(0), places.reshape(-1, 3)))
    return {
        station: np.concatenate([p for _, p in sorted(some, key=lambda s: s[0])])
        for station, some in parts.items()
    }


def _station(
    node: JsonNode,
    clusters: dict[str, tuple[npt.NDArray[np.intp], FloatArray]],
    pattern: FloatArray,
) -> PlannedStation:
    cluster = node["cluster"].text()
    if cluster not in clusters:
        raise node["cluster"].fail(f"{cluster!r} is not a cluster of the plan")
    rows, middle = clusters[cluster]
    counts = as_float([[v.number() for v in row.elements()] for row in node["counts"].elements()])
    if len(counts) != len(rows):
        raise node["counts"].fail(f"{len(counts)} rows for {len(rows)} heliostats")
    able = np.ones(len(rows), dtype=np.bool_)
    able[[int(n.number(0, len(rows) - 1)) for n in node["unreachable"].elements()]] = False
    name = f"{cluster}-{int(node['point'].number(1))}"
    return PlannedStation(name, rows[able], counts[able], pattern, middle)
