"""``heliotrope sun``: the position of the sun."""

from typing import Annotated, Literal

import typer

from heliotrope.cli._common import day_of, parse_duration, parse_time, print_json, print_table


def sun(
    latitude: Annotated[
        float, typer.Option(min=-90, max=90, help="Latitude, degrees, north positive.")
    ] = -33.93,
    longitude: Annotated[
        float, typer.Option(min=-180, max=180, help="Longitude, degrees, east positive.")
    ] = 18.87,
    height: Annotated[
        float, typer.Option(min=-500, max=9000, help="Height above the ellipsoid, m.")
    ] = 120.0,
    time: Annotated[str, typer.Option(help="ISO 8601 with a zone, or now.")] = "now",
    pressure: Annotated[
        float | None,
        typer.Option(
            min=300, max=1200, help="Air pressure at the site, hPa; default: from the height."
        ),
    ] = None,
    temperature: Annotated[
        float, typer.Option(min=-90, max=60, help="Air temperature, °C.")
    ] = 12.0,
    every: Annotated[
        str | None,
        typer.Option(help="Print the whole day of TIME at this interval, such as 30s or 10min."),
    ] = None,
    algorithm: Annotated[
        Literal["spa", "grena2008"],
        typer.Option(
            help="spa; grena2008: the algorithm that Malan used, a cross-check for 2003 to 2022."
        ),
    ] = "spa",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print the sun's position, and the times when it rises, culminates and sets."""
    import numpy as np

    from heliotrope import sun as solar

    moment = parse_time(time)
    pascal = None if pressure is None else 100.0 * pressure
    site = solar.Site(latitude, longitude, height, pascal, temperature)
    day = day_of(moment, site)
    events = solar.events(day, site)
    if every is not None:
        moments = solar.daylight(day, site, every=parse_duration(every, 1.0))
    else:
        import pandas as pd

        moments = pd.DatetimeIndex([moment]).tz_convert("UTC")
    position = solar.position(moments, site, algorithm=algorithm)
    rows = [
        {
            "time": t.isoformat(),
            "azimuth_deg": float(np.degrees(position.azimuth[i])),
            "elevation_deg": float(np.degrees(position.elevation[i])),
            "true_elevation_deg": float(np.degrees(position.true_elevation[i])),
            "vector": position.vector[i],
        }
        for i, t in enumerate(moments)
    ]
    times = {
        "sunrise": events.sunrise,
        "culmination": events.culmination,
        "sunset": events.sunset,
        "kind": events.kind,
    }
    if as_json:
        print_json({"positions": rows, **times} if every else {**rows[0], **times})
        return
    print_table(
        ["time", "azimuth", "elevation", "without refraction"],
        [
            [
                str(r["time"]),
                f"{r['azimuth_deg']:.4f}°",
                f"{r['elevation_deg']:.4f}°",
                f"{r['true_elevation_deg']:.4f}°",
            ]
            for r in rows
        ],
    )
    for name, event in (
        ("sunrise", events.sunrise),
        ("culmination", events.culmination),
        ("sunset", events.sunset),
    ):
        shown = event.strftime("%Y-%m-%d %H:%M:%S UTC") if event else f"none ({events.kind})"
        print(f"{name:12}{shown}")
