"""Repeat the sizing arithmetic of chapter 3 of Malan's thesis: ``python malan_sizing.py``.

From the thesis: 5 MWe, about 10,000 heliostats of 5 m². Inputs marked "ours" are not in its text;
with them the arithmetic gives its numbers.
"""

import math

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

#: name: (value, unit, source)
INPUTS = {
    "electric power": (5.0e6, "W", "Malan"),
    "mirror of a heliostat": (5.0, "m²", "Malan"),
    "solar multiple": (2.0, "1", "ours"),
    "design irradiance": (900.0, "W/m²", "ours"),
    "power cycle": (0.40, "1", "ours"),
    "receiver": (0.88, "1", "ours"),
    "field (cosine, reflectivity, blocking, intercept)": (0.62, "1", "ours"),
    "allowed tracking error from holding still": (0.05e-3, "rad", "ours"),
}


def main() -> dict[str, float]:
    """Print the arithmetic and return its numbers, SI."""
    power, mirror, multiple, irradiance, cycle, receiver, optics, allowed = (
        value for value, _, _ in INPUTS.values()
    )
    thermal = power * multiple / cycle
    area = thermal / (receiver * optics * irradiance)
    count = math.ceil(area / mirror)
    # The sun moves by a turn in a sidereal day at most; the normal by half of that, and an
    # azimuth axis faster by 1 / sin ζ near its keyhole.
    sun_rate = 2.0 * math.pi / 86164.0
    normal_rate = 0.5 * sun_rate
    interval = 2.0 * allowed / normal_rate
    steps = [
        ("thermal power of the receiver", "P · SM / η_cycle", thermal / 1e6, "MW"),
        ("collector area", "P_th / (η_receiver η_field DNI)", area, "m²"),
        ("number of heliostats", "area / mirror", float(count), ""),
        ("speed of the sun", "2π / sidereal day", 1e6 * sun_rate, "µrad/s"),
        ("speed of the normal, at most half of it", "ω / 2", 1e6 * normal_rate, "µrad/s"),
        ("control interval", "2 · allowed error / speed", interval, "s"),
        ("azimuth axis 5° from its keyhole", "(ω / 2) / sin 5°",
         1e6 * normal_rate / math.sin(math.radians(5.0)), "µrad/s"),
    ]  # fmt: skip
    table = Table("quantity", "formula", "value", "unit", box=SIMPLE_HEAD)
    for name, (value, unit, whose) in INPUTS.items():
        table.add_row(name, f"input ({whose})", f"{value:,.6g}", unit)
    for name, formula, number, unit in steps:
        table.add_row(name, formula, f"{number:,.4g}", unit)
    Console(width=100).print(table)
    return {
        "thermal_power": thermal,
        "collector_area": area,
        "heliostats": float(count),
        "sun_rate": sun_rate,
        "normal_rate": normal_rate,
        "control_interval": interval,
    }


if __name__ == "__main__":
    main()
