"""Reading and writing plant files beside bare pandas on the same table."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks import tracking
from benchmarks._run import best
from heliotrope.field.formats.plant_file import read_plant, write_plant
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.sun import Site


def run(quick: bool) -> dict[str, Any]:
    """Return the figures."""
    rows = []
    for size in (100,) if quick else (100, 10_000, 100_000):
        names = tuple(f"H{i:06d}" for i in range(size))
        mechanism = tracking.field(size)
        heliostats = Heliostats(names, mechanism, np.full(size, 2.0), np.full(size, 1.5))
        plant = Plant("bench", Site(37.0, -2.0, 500.0), {"azel": heliostats})
        for table in ("csv", "parquet"):
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "plant.toml"

                def write(p: Any = plant, f: Any = path, t: Any = table) -> None:
                    write_plant(p, f, t)

                write()
                bare = pd.read_csv if table == "csv" else pd.read_parquet
                times = best(
                    {
                        "write": write,
                        "read": lambda f=path: read_plant(f),  # type: ignore[misc]
                        "pandas reads the table": lambda b=bare, f=path, t=table: b(  # type: ignore[misc]
                            f.with_suffix(f".{t}")
                        ),
                    },
                    2 if quick else 3,
                )
            floor = times["pandas reads the table"]["best_s"]
            rows += [
                {"heliostats": size, "table": table, "work": n, "ms": 1e3 * t["best_s"],
                 "ratio_to_pandas": t["best_s"] / floor}
                for n, t in times.items()
            ]  # fmt: skip
    return {"rows": rows}
