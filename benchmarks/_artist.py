"""ARTIST's kinematic reconstruction on the sightings that Heliotrope learns from, where it runs.

ARTIST (github.com/ARTIST-Association/ARTIST, ``artist-csp`` on the package index) needs PyTorch and
an environment of its own; `_artist_worker` runs there. It fits four tilts of a heliostat by
the angle between normals (its ``alignment``), and the errors of the held-out sightings are computed
here from its tilts, with its chain. benchmarks/README.md explains the setup.
"""

import csv
import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._run import why_missing
from heliotrope.calibration.sightings import Sightings, ray_directions
from heliotrope.geometry import angle_between, reflect

#: Environment: ARTIST's interpreter, and the epochs (default: `EPOCHS`).
PYTHON, TURNS = "HELIOTROPE_ARTIST_PYTHON", "HELIOTROPE_ARTIST_EPOCHS"
EPOCHS, RATE = 1000, 1e-3
#: Centre of the concentrator in the mirror's frame, m, as in Jülich's properties.
CENTRE = np.array([0.0, 0.175, 0.0])
WORKER = Path(__file__).with_name("_artist_worker.py")


def why_skipped() -> str | None:
    """Return why ARTIST is missing from the contenders, None if it is among them."""
    return why_missing(PYTHON, ("artist", "torch"))


def reconstruct(data: Path, jobs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the tilts and seconds of each job; see `_artist_worker`."""
    with tempfile.TemporaryDirectory() as folder:
        given, out = Path(folder) / "jobs.json", Path(folder) / "out.json"
        given.write_text(json.dumps(jobs), encoding="utf-8")
        command = [os.environ[PYTHON], str(WORKER), str(data), str(given), str(out)]
        subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
        found: list[dict[str, Any]] = json.loads(out.read_text(encoding="utf-8"))
    return found


def job(data: Path, name: str, heliostat: str, ids: list[str], seen: Sightings) -> dict[str, Any]:
    """Return the job of one heliostat with the training sightings ``seen`` named ``ids``."""
    with (data / "measurements.csv").open(encoding="utf-8") as file:
        rows = {(r["heliostat"], r["id"]): r for r in csv.DictReader(file)}
    mine = [rows[heliostat, number] for number in ids]
    return {
        "job": name,
        "heliostat": heliostat,
        "epochs": int(os.environ.get(TURNS, EPOCHS)),
        "rate": RATE,
        "sightings": [
            {
                "motors": seen.counts[k].tolist(),
                "sun": seen.source[k].tolist(),
                "spot": [float(row[f"utis_{axis}"]) for axis in ("lat", "lon", "alt")],
                "target": row["target"],
            }
            for k, row in enumerate(mine)
        ],
    }


def _turn(axis: int, angle: np.ndarray) -> np.ndarray:
    """Right-handed turns about an axis of the frame by angles (M,), (M, 3, 3)."""
    angle = np.atleast_1d(angle)
    out = np.zeros((len(angle), 3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out[:, axis, axis] = 1.0
    out[:, i, i] = out[:, j, j] = np.cos(angle)
    out[:, i, j], out[:, j, i] = -np.sin(angle), np.sin(angle)
    return out


def beam_errors(mechanism: Any, seen: Sightings, tilts: list[float]) -> np.ndarray:
    """Return the beam errors (M,) of sightings of one heliostat under ARTIST's tilts, rad.

    ARTIST's turns about north are left-handed; the nominal drives (1,) give the joint angles.
    """
    north_1, up_1, east_2, north_2 = tilts
    angles = mechanism[seen.heliostat].drives.angles(seen.counts)
    base = _turn(1, np.array(-north_1)) @ _turn(2, np.array(up_1)) @ _turn(0, angles[:, 0])
    turned = base @ _turn(0, np.array(east_2)) @ _turn(1, np.array(-north_2))
    turned = turned @ _turn(2, angles[:, 1])
    normal = turned @ np.array([0.0, -1.0, 0.0])
    vertex = mechanism.position[seen.heliostat] + turned @ CENTRE
    source, way = ray_directions(seen, vertex)
    return np.asarray(angle_between(reflect(source, normal), way))
