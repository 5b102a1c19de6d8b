"""Positions of the sun, beside pvlib's own front end for the same algorithm."""

from typing import Any

import numpy as np
import pandas as pd
import pvlib

from benchmarks._run import Result, Row, agree, timed
from heliotrope import sun

LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M = -33.93, 18.87, 120.0
PRESSURE_PA, TEMPERATURE_C, DELTA_T_S = 100_000.0, 20.0, 69.2


def run(quick: bool) -> Result:
    """Return the figures."""
    site = sun.Site(
        LATITUDE_DEG,
        LONGITUDE_DEG,
        HEIGHT_M,
        pressure=PRESSURE_PA,
        temperature_c=TEMPERATURE_C,
        delta_t=DELTA_T_S,
    )
    rows: list[Row] = []
    for size in (1, 1000) if quick else (1, 1000, 100_000, 1_000_000):
        seconds = 1.7e9 + np.arange(size) * 30.0
        index = pd.to_datetime(seconds, unit="s", utc=True)

        def ours(s: np.ndarray = seconds) -> sun.SunPosition:
            return sun.position(s, site)

        def theirs(i: pd.DatetimeIndex = index) -> Any:
            return pvlib.solarposition.get_solarposition(
                i,
                LATITUDE_DEG,
                LONGITUDE_DEG,
                altitude=HEIGHT_M,
                pressure=PRESSURE_PA,
                temperature=TEMPERATURE_C,
                delta_t=DELTA_T_S,
            )

        gap = np.degrees(ours().elevation) - theirs()["apparent_elevation"].to_numpy()
        apart = agree("elevation", float(np.radians(np.abs(gap).max())), 1e-7, "rad")
        times = timed({"Heliotrope": ours, "pvlib": theirs}, 3 if size > 100_000 else 9)
        rows += [
            {
                "times": size,
                "contender": name,
                "best_ms": 1e3 * time.best,
                "median_ms": 1e3 * time.median,
                "processor_ms": 1e3 * time.processor,
                "us_per_time": 1e6 * time.best / size,
                "ratio_to_first": time.best / times["Heliotrope"].best,
                "apart_rad": apart,
            }
            for name, time in times.items()
        ]
    last = rows[-1]
    return Result(
        rows,
        f"{size:,} times in {rows[-2]['best_ms']:,.0f} ms; pvlib's front end takes "
        f"{last['ratio_to_first']:.2f} × as long",
    )
