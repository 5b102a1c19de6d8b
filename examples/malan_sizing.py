"""Repeat the sizing of chapter 3 of Malan's thesis line by line: ``python malan_sizing.py``.

Every input is his: table 3.1, storage for seven hours, 5 MWe, heliostats of 5 m², a packing of one
half, an image that may drift by 1 mrad between two adjustments, packets of 13 bytes, sectors of 48
clusters of 32 heliostats. What is said beside his numbers is ours.
"""

import math

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

#: Table 3.1: full-load storage, h; nominal power, MWe; collector aperture, m².
PLANTS = {"Sierra SunTower": (0.0, 5.0, 27_670.0), "Gemasolar": (15.0, 19.9, 304_750.0)}
STORAGE_H, POWER_MW = 7.0, 5.0
HELIOSTAT_M2, PACKING = 5.0, 0.5
#: Mean angular speed of the sun as he rounds it, and the drift that he allows, mrad.
SUN_MRAD_S = 1e3 * 2.0 * math.pi / 86_400.0
DRIFT_MRAD = 1.0
PACKET_BYTES, BITS_A_BYTE = 13, 10
CLUSTER, SECTOR = 32, 48


def main() -> dict[str, float]:
    """Print the arithmetic and return its numbers."""
    ratios = {name: area / power for name, (_, power, area) in PLANTS.items()}
    lower, upper = ratios["Sierra SunTower"], ratios["Gemasolar"]
    hours = PLANTS["Gemasolar"][0]
    ratio = lower + STORAGE_H * (upper - lower) / hours
    rounded = round(ratio, -3)
    area = rounded * POWER_MW
    count = area / HELIOSTAT_M2
    interval = DRIFT_MRAD / SUN_MRAD_S
    bits = count * PACKET_BYTES * BITS_A_BYTE
    found = {
        "lower": lower,
        "upper": upper,
        "ratio": ratio,
        "area": area,
        "heliostats": count,
        "field": area / PACKING,
        "interval": interval,
        "whole_seconds": math.floor(interval),
        "bits": bits,
        "clusters": math.ceil(count / CLUSTER),
        "sector": CLUSTER * SECTOR,
        "sectors": math.ceil(count / (CLUSTER * SECTOR)),
    }
    steps = [
        ("Sierra SunTower, aperture over power", "table 3.1", lower, "m²/MWe"),
        ("Gemasolar, aperture over power", "table 3.1", upper, "m²/MWe"),
        ("with 7 h of storage", "(3.1): between them by the hour", ratio, "m²/MWe"),
        ("rounded", "3.2.1", rounded, "m²/MWe"),
        ("collector aperture", "times 5 MWe", area, "m²"),
        ("heliostats", "of 5 m²", count, ""),
        ("field", "packing 0.5", found["field"], "m²"),
        ("speed of the sun", "2π / day", SUN_MRAD_S, "mrad/s"),
        ("drift of 1 mrad takes", "1 mrad / speed", interval, "s"),
        ("control interval", "whole seconds below it", float(found["whole_seconds"]), "s"),
        ("one position of every heliostat", "13 bytes of 10 bits each", 1e-6 * bits, "Mbit"),
        ("clusters", "of 32 heliostats", float(found["clusters"]), ""),
        ("heliostats of a sector", "48 × 32", float(found["sector"]), ""),
        ("sectors", "ours", float(found["sectors"]), ""),
    ]
    table = Table("quantity", "how", "value", "unit", box=SIMPLE_HEAD)
    for name, how, number, unit in steps:
        table.add_row(name, how, f"{number:,.6g}", unit)
    console = Console(width=100)
    console.print(table)
    console.print(
        f"He sends the {1e-6 * bits:.1f} Mbit of all positions in a second (1.3 Mbps) and allows "
        "5 to 10 times as much for latency; spread over his control interval they are "
        f"{1e-6 * bits / found['whole_seconds']:.2f} Mbps. A mirror that stands still lets its "
        "image drift as fast as the sun moves, so 1 mrad is of the beam."
    )
    return found


if __name__ == "__main__":
    main()
