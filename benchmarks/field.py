"""Reading and writing of plant files, beside bare pandas on the same table.

Pandas reads numbers and texts; Heliotrope also checks every value and builds mechanisms.
"""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from benchmarks import tracking
from benchmarks._run import BenchmarkError, Call, Result, Row, timed
from heliotrope.field.formats.plant_file import read_plant, write_plant
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.sun import Site

Table = Literal["csv", "parquet"]
READERS: dict[Table, Callable[[Path], Any]] = {"csv": pd.read_csv, "parquet": pd.read_parquet}


def _plant(size: int) -> Plant:
    names = tuple(f"H{i:06d}" for i in range(size))
    mirrors = Heliostats(names, tracking.field(size), np.full(size, 2.0), np.full(size, 1.5))
    return Plant("bench", Site(37.0, -2.0, 500.0), {"azel": mirrors})


def _contenders(plant: Plant, table: Table, folder: Path) -> dict[str, Call]:
    """Write the plant, check that it reads back, and return the functions to time."""
    path = folder / "plant.toml"
    write_plant(plant, path, table)
    read = partial(READERS[table], path.with_suffix(f".{table}"))
    frame = read()
    if len(frame) != len(plant) or not np.array_equal(read_plant(path).position, plant.position):
        raise BenchmarkError(f"{table}: the plant read differs from the one written")
    save = frame.to_csv if table == "csv" else frame.to_parquet
    return {
        "pandas writes": partial(save, folder / f"bare.{table}", index=False),
        "Heliotrope writes": partial(write_plant, plant, path, table),
        "pandas reads": read,
        "Heliotrope reads": partial(read_plant, path),
    }


def run(quick: bool) -> Result:
    """Return the figures."""
    rows: list[Row] = []
    found = []
    for size in (100,) if quick else (100, 10_000, 100_000):
        plant = _plant(size)
        for table in READERS:
            with tempfile.TemporaryDirectory() as folder:
                contenders = _contenders(plant, table, Path(folder))
                times = timed(contenders, 20 if size == 100 else 5)
            for name, time in times.items():
                peer = times[f"pandas {name.split()[1]}"]
                rows.append(
                    {
                        "heliostats": size,
                        "table": table,
                        "work": name,
                        "best_ms": 1e3 * time.best,
                        "median_ms": 1e3 * time.median,
                        "us_per_heliostat": 1e6 * time.best / size,
                        "ratio_to_pandas": time.best / peer.best,
                    }
                )
            found.append((table, times["Heliotrope reads"].best, times["Heliotrope writes"].best))
    texts = [
        f"{table} read in {read:.3g} s, written in {write:.3g} s"
        for table, read, write in found[-2:]
    ]
    return Result(rows, f"{size:,} heliostats: {'; '.join(texts)}")
