"""Positions of the sun beside pvlib's own front end, which computes the same."""

from typing import Any

import numpy as np
import pandas as pd
import pvlib

from benchmarks._run import best
from heliotrope import sun


def run(quick: bool) -> dict[str, Any]:
    """Return the figures."""
    site = sun.Site(-33.93, 18.87, 120.0, pressure=100_000.0)
    rows = []
    for size in (1, 1000) if quick else (1, 1000, 100_000, 1_000_000):
        seconds = 1.7e9 + np.arange(size) * 30.0
        index = pd.to_datetime(seconds, unit="s", utc=True)

        def ours(s: Any = seconds) -> Any:
            return sun.position(s, site)

        def theirs(i: Any = index) -> Any:
            return pvlib.solarposition.get_solarposition(
                i, -33.93, 18.87, altitude=120.0, pressure=100_000.0, temperature=12.0
            )

        times = best({"heliotrope": ours, "pvlib": theirs}, 3 if quick or size > 1e5 else 7)
        for name, time in times.items():
            rows.append(
                {
                    "times": size,
                    "contender": name,
                    "ms": 1e3 * time["best_s"],
                    "ratio_to_heliotrope": time["best_s"] / times["heliotrope"]["best_s"],
                }
            )
    return {"rows": rows}
