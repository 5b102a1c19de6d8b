"""From a photograph to a sighting, compared with decoding, Malan's thresholds, OpenCV's moments.

The photographs are a rendered colour frame of 1600 × 1200 pixels as a PNG and, if available
(HELIOTROPE_DATA), a real one of Jülich. All contenders get the decoded frame; Malan's thresholds
and the moments also get the place of the target, which Heliotrope finds itself.
"""

import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks._centroids import malan_centroid, marker_threshold, moments_centroid
from benchmarks._run import BenchmarkError, Call, Result, Row, Times, timed
from heliotrope.field.formats.paint import read_tower
from heliotrope.field.target import Target
from heliotrope.imaging.files import read_image, write_image
from heliotrope.imaging.photograph import read_photograph
from heliotrope.imaging.synthetic.rendering import (
    Scene,
    Sensor,
    example_camera,
    example_target,
    exposed,
)
from heliotrope.imaging.synthetic.rendering import render as render_scene
from heliotrope.imaging.targets.rectify import rectify
from heliotrope.imaging.targets.view import FaceView
from heliotrope.optics.mirror_image import gaussian_beam

#: Greatest time from a photograph to a sighting, as a multiple of its decoding.
BUDGET = 1.5
#: The design's photograph.
SIZE = (1600, 1200)
REAL = Path("images", "target-camera", "213508-raw.png")
TRUTH = (0.5, 0.3)


def _rendered(folder: Path, size: tuple[int, int]) -> tuple[Path, tuple[Target, ...]]:
    target = example_target()
    beam = gaussian_beam(TRUTH, 0.7, 0.5, 0.4)
    scene = Scene(
        example_camera(target, size=size),
        (target,),
        (("target", beam, 700.0),),
        sensor=Sensor(colour=True),
    )
    path = folder / "rendered.png"
    write_image(render_scene(exposed(scene), 1).frame, path)
    return path, (target,)


def _photographs(folder: Path, quick: bool) -> dict[str, tuple[Path, tuple[Target, ...]]]:
    size = (800, 600) if quick else SIZE
    found = {f"rendered {size[0]} × {size[1]}": _rendered(folder, size)}
    data = os.environ.get("HELIOTROPE_DATA")
    if data and (Path(data) / REAL).exists() and not quick:
        tower = read_tower(Path(data) / "tower-measurements.json")
        found["Jülich 1512 × 2688"] = Path(data) / REAL, tower.targets
    return found


def _to_sighting(path: Path, targets: tuple[Target, ...]) -> tuple[float, float]:
    """Decode, find and measure; return the place, for the check."""
    readings = read_photograph(read_image(path), targets).readings
    spot = next(r.spots[0] for r in readings if r.spots)
    return float(spot.plane[0]), float(spot.plane[1])


def _contenders(path: Path, targets: tuple[Target, ...]) -> dict[str, Call]:
    frame = read_image(path)
    photograph = read_photograph(frame, targets)
    view = photograph.faces[0].picture.view
    if view is None or not any(r.good for r in photograph.readings):
        raise BenchmarkError(f"{path}: its spot is not found, so there is nothing to time")

    def malan(known: FaceView) -> object:
        picture = rectify(frame, known)
        # His markers come first: they give the crop, which is known here.
        markers = picture.values < marker_threshold(picture.values)
        return markers, malan_centroid(picture)

    return {
        "decoding (PNG)": partial(read_image, path),
        "Heliotrope": partial(read_photograph, frame, targets),
        "Heliotrope, view known": partial(
            read_photograph, frame, targets, previous=photograph.views
        ),
        "Malan's thresholds": partial(malan, view),
        "OpenCV moments": lambda: moments_centroid(rectify(frame, view)),
    }


def _rate(path: Path, targets: tuple[Target, ...], processes: int, count: int) -> float:
    """Return photographs per second with this many processes, their start not counted."""
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        warm = [pool.submit(_to_sighting, path, targets) for _ in range(4 * processes)]
        places = [future.result() for future in warm]
        start = time.perf_counter()
        futures = [pool.submit(_to_sighting, path, targets) for _ in range(count)]
        places += [future.result() for future in futures]
        taken = time.perf_counter() - start
    if len(set(places)) != 1:
        raise BenchmarkError(f"{path}: processes do not agree on the place: {set(places)}")
    return count / taken


def _rows(name: str, times: dict[str, Times], rates: dict[int, float]) -> list[Row]:
    decoding = times["decoding (PNG)"].best
    rows: list[Row] = [
        {
            "photograph": name,
            "work": work,
            "best_ms": 1e3 * time.best,
            "median_ms": 1e3 * time.median,
            "ratio_to_decoding": time.best / decoding,
            "per_second": None,
        }
        for work, time in times.items()
    ]
    for processes, rate in rates.items():
        rows.append(
            {
                "photograph": name,
                "work": f"file to sighting, {processes} process{'es' if processes > 1 else ''}",
                "best_ms": 1e3 / rate,
                "median_ms": 1e3 / rate,
                "ratio_to_decoding": 1.0 / (rate * decoding),
                "per_second": rate,
            }
        )
    return rows


def run(quick: bool) -> Result:
    """Return the figures."""
    rows: list[Row] = []
    texts, ratios = [], []
    cores = len(os.sched_getaffinity(0))
    with tempfile.TemporaryDirectory() as folder:
        for name, (path, targets) in _photographs(Path(folder), quick).items():
            times = timed(_contenders(path, targets), 3 if quick else 20)
            counts = (1,) if quick else (1, cores)
            rates = {n: _rate(path, targets, n, 4 if quick else 30 * n) for n in counts}
            rows += _rows(name, times, rates)
            ratio = times["Heliotrope"].best / times["decoding (PNG)"].best
            ratios.append(ratio)
            texts.append(f"{name}: {ratio:.2f} × its decoding, {max(rates.values()):.1f} a second")
    places = np.array([r["best_ms"] for r in rows], dtype=np.float64)
    if not np.isfinite(places).all():
        raise BenchmarkError("a time is not a number")
    return Result(rows, "; ".join(texts), within_budget=None if quick else max(ratios) <= BUDGET)
