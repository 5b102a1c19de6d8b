"""Reading of a drone's photographs: mirrors and lamp found per second, relative to decoding.

A rendered flight over 72 mirrors with four facets, 12 megapixels as JPEG. Timed is the work of
`heliotrope drone evaluate` on one photograph: from the decoded picture, and from the file with one
process and with one for each core. The design sets no budget; the reference is the
decoding in the same run. Memory is that of this process, including the rendering.
"""

import os
import resource
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks._run import BenchmarkError, Call, Result, Row, timed
from heliotrope.airborne.evaluate.detection import decode
from heliotrope.airborne.evaluate.reading import PhotoReading, look, read_photo
from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.airborne.simulate.rendering import render_flight
from heliotrope.airborne.simulate.simulation import Errors, Flight, fly, hover_grid, look_counts
from heliotrope.airborne.standing import MirrorPoses, standing
from heliotrope.field.example import azimuth_elevation
from heliotrope.field.heliostats import Facets, Heliostats

RINGS, EACH = 9, 8
HOVER = np.array([0.0, 20.0, 75.0])
ORIGIN = (37.09, -2.36, 500.0)
SIZE, QUICK_SIZE = (4000, 3000), (1400, 1050)


def _heliostats() -> Heliostats:
    positions = []
    for ring in range(RINGS):
        angles = (np.arange(EACH) - 0.5 * (EACH - 1) + 0.5 * (ring % 2)) * 0.075
        radius = 60.0 + 6.0 * ring
        positions.append(np.c_[radius * np.sin(angles), radius * np.cos(angles), np.zeros(EACH)])
    places = np.concatenate(positions)
    n = len(places)
    center, half_width, half_height = (np.zeros((n, 4, 3)) for _ in range(3))
    center[..., 0] = np.array([-0.25, 0.25, -0.25, 0.25]) * 2.5
    center[..., 1] = np.array([-0.25, -0.25, 0.25, 0.25]) * 2.0
    half_width[..., 0], half_height[..., 1] = 0.615, 0.49
    return Heliostats(
        tuple(f"H{k}" for k in range(n)),
        azimuth_elevation(places),
        np.full(n, 2.5),
        np.full(n, 2.0),
        Facets(center, half_width, half_height),
    )


def _flight(size: tuple[int, int]) -> Flight:
    mirrors = _heliostats()
    middle = mirrors.position.mean(axis=0) + [0.0, 0.0, 1.2]
    width, height = size
    f = 0.75 * width
    matrix = np.array([[f, 0.0, 0.5 * (width - 1)], [0.0, f, 0.5 * (height - 1)], [0, 0, 1.0]])
    camera = LedCamera(size, matrix, np.array([-0.08, 0.06, 3e-4, -2e-4, -0.01]))
    hover = hover_grid(HOVER, middle, 2, 1, 0.5)
    return fly(mirrors, camera, look_counts(mirrors, HOVER), hover, middle, errors=Errors(), seed=1)


def _photos(flight: Flight, folder: Path) -> list[Photo]:
    render_flight(flight, folder, ORIGIN, seed=1)
    return [
        Photo(p.name, p.time, p.position, p.rotation, p.sigma_position, folder / p.name)
        for p in flight.recorded
    ]


def _count(seen: PhotoReading) -> tuple[int, int]:
    return len(seen.mirror), len(seen.spot)


def _work(photo: Photo, camera: LedCamera, stand: MirrorPoses) -> tuple[int, int]:
    return _count(read_photo(photo, camera, stand))


def _rate(processes: int, count: int, photo: Photo, camera: LedCamera, stand: MirrorPoses) -> float:
    """Return photographs per second with this many processes, their start not counted."""
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        warm = [pool.submit(_work, photo, camera, stand) for _ in range(2 * processes)]
        found = {future.result() for future in warm}
        start = time.perf_counter()
        futures = [pool.submit(_work, photo, camera, stand) for _ in range(count)]
        found |= {future.result() for future in futures}
        taken = time.perf_counter() - start
    if len(found) != 1:
        raise BenchmarkError(f"{photo.name}: processes disagree on what it shows: {found}")
    return count / taken


def run(quick: bool) -> Result:
    """Return the figures."""
    size = QUICK_SIZE if quick else SIZE
    flight = _flight(size)
    with tempfile.TemporaryDirectory() as folder:
        photo = _photos(flight, Path(folder))[0]
        stand = standing(flight.heliostats, flight.counts)
        picture = decode(photo.path or "")
        mirrors, spots = _count(look(picture, photo, flight.camera, stand))
        if mirrors < 0.9 * len(flight.heliostats) or not spots:
            raise BenchmarkError(f"only {mirrors} mirrors and {spots} reflections were found")
        calls: dict[str, Call] = {
            "decoding (JPEG)": partial(decode, photo.path or ""),
            "mirrors and reflections": partial(look, picture, photo, flight.camera, stand),
        }
        times = timed(calls, 3 if quick else 15)
        cores = len(os.sched_getaffinity(0))
        rates = {
            n: _rate(n, 10 * n, photo, flight.camera, stand) for n in (() if quick else (1, cores))
        }
    decoding = times["decoding (JPEG)"].best
    total = times["decoding (JPEG)"].best + times["mirrors and reflections"].best
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    rows: list[Row] = [
        {
            "work": work,
            "best_ms": 1e3 * one.best,
            "median_ms": 1e3 * one.median,
            "ratio_to_decoding": one.best / decoding,
            "per_second": None,
        }
        for work, one in times.items()
    ]
    rows += [
        {
            "work": f"file to reflections, {n} process{'es' if n > 1 else ''}",
            "best_ms": 1e3 / rate,
            "median_ms": 1e3 / rate,
            "ratio_to_decoding": 1.0 / (rate * decoding),
            "per_second": rate,
        }
        for n, rate in rates.items()
    ]
    ratio = times["mirrors and reflections"].best / decoding
    best = max(rates.values(), default=1.0 / total)
    return Result(
        rows,
        f"{size[0]} × {size[1]}, {mirrors} mirrors, {spots} reflections: {ratio:.1f} × its "
        f"decoding, {best:.1f} a second; at most {memory:.0f} MiB with rendering",
    )
