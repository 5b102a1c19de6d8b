"""``heliotrope flux``: the flux that each heliostat sends to the receiver, and its losses."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from heliotrope.cli._calibration import progress
from heliotrope.cli._common import (
    open_field,
    parse_point,
    parse_sun,
    parse_time,
    print_json,
    print_table,
    sunlit,
)
from heliotrope.cli._light import (
    Air,
    CantingOption,
    CellOption,
    Clean,
    Dni,
    Error,
    FacetOption,
    Field,
    Focus,
    Reflectivity,
    Shape,
    SiteOption,
    Slope,
    Sun,
    Time,
    Towers,
    canting_of,
    light_of,
    noon,
)
from heliotrope.errors import InputError

if TYPE_CHECKING:
    from heliotrope.field.plant import Plant
    from heliotrope.optics import FieldOptics, FluxTable, PlantFlux

#: Number of sun positions of a table that are displayed.
SHOWN = 12
#: Names of the efficiencies, in the order of the light path.
_WORDS = {
    "cosine": "cosine",
    "shading": "  not shaded",
    "blocking": "  not blocked",
    "lit": "neither shaded nor blocked",
    "mirror": "reflectivity and soiling",
    "air": "air",
    "intercept": "intercept",
    "total": "total",
}


def flux(
    field: Field,
    time: Time = None,
    sun: Sun = None,
    every: Annotated[
        str | None,
        typer.Option(help="Write a table of the whole day with this step, such as 30min."),
    ] = None,
    year: Annotated[
        bool, typer.Option("--year", help="Write a table over the sun positions of a year.")
    ] = False,
    receiver: Annotated[
        list[str] | None, typer.Option(help="Receiver; may be repeated. Default: all.")
    ] = None,
    aim: Annotated[
        str | None,
        typer.Option(
            help="Aim point east,north,up, m. Default: each heliostat's own aim, or the receiver."
        ),
    ] = None,
    site: SiteOption = None,
    dni: Dni = 900.0,
    shape: Shape = "limb",
    air: Air = "clear",
    slope_mrad: Slope = None,
    error_mrad: Error = 1.0,
    reflectivity: Reflectivity = None,
    clean: Clean = 1.0,
    focus: Focus = "plant",
    facets: FacetOption = None,
    canting: CantingOption = "slant",
    cells: CellOption = None,
    tower: Towers = None,
    rays: Annotated[
        float, typer.Option(min=0, max=1e9, help="Number of rays to trace as an independent check.")
    ] = 0.0,
    seed: Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Seed of the rays.")] = 0,
    by: Annotated[
        Literal["cosine", "shading", "blocking", "lit", "mirror", "air", "intercept", "total"],
        typer.Option(help="Efficiency that the picture shows by colour."),
    ] = "total",
    csv: Annotated[
        Path | None,
        typer.Option("--csv", help="File for the heliostat table, or for the table over time."),
    ] = None,
    cells_csv: Annotated[
        Path | None, typer.Option("--map", help="File for the flux map, CSV.")
    ] = None,
    netcdf: Annotated[
        Path | None, typer.Option(help="File for heliostats and flux map, NetCDF.")
    ] = None,
    sam: Annotated[Path | None, typer.Option(help="File for SAM; only with --year.")] = None,
    solartherm: Annotated[
        Path | None, typer.Option(help="File for SolarTherm (.motab); only with --year.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="File for the picture, .png, .svg or .pdf.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Show the flux on the receivers and the efficiencies of the field and its heliostats."""
    light = light_of(
        dni, shape, air, slope_mrad, error_mrad, reflectivity, clean, focus, facets, cells, tower
    )
    files = {
        "csv": csv, "map": cells_csv, "netcdf": netcdf, "sam": sam, "solartherm": solartherm,
        "picture": picture,
    }  # fmt: skip
    order = _Order(
        light,
        tuple(receiver or ()),
        None if aim is None else parse_point(aim, "aim"),
        {name: path for name, path in files.items() if path is not None},
        as_json,
    )
    order.check(field, table=every is not None or year, year=year)
    plant = open_field(field, site)
    order = replace(order, light=replace(light, canting=canting_of(canting, light.facets, plant)))
    if year:
        _year(plant, order, any_of={"--time": time, "--sun": sun, "--every": every}, rays=rays)
    elif every is not None:
        _day(plant, order, time, every, any_of={"--sun": sun}, rays=rays)
    else:
        _moment(plant, order, time, sun, (rays, seed), by)


@dataclass(frozen=True)
class _Order:
    """The requested computation, apart from the sun positions."""

    light: "FieldOptics"
    receiver: tuple[str, ...]
    aim: tuple[float, float, float] | None
    files: dict[str, Path]
    as_json: bool

    def check(self, field: Path, *, table: bool, year: bool) -> None:
        """Refuse files that cannot be written, or for which this table contains no data."""
        from heliotrope.calibration.plan.report import check_picture
        from heliotrope.cli.plan import check_outputs

        if "picture" in self.files:
            check_picture(self.files["picture"])
        check_outputs(tuple(self.files.values()), field, None)
        barred = ("map", "netcdf", "picture") if table else ()
        barred = barred if year else (*barred, "sam", "solartherm")
        for name in barred:
            if name in self.files:
                needs = "--year" if name in ("sam", "solartherm") else "one time"
                raise InputError(
                    f"--{name}: this file is written only for {needs}; leave out --{name}"
                )

    @property
    def options(self) -> dict[str, Any]:
        """Return the arguments of `field_flux`, `flux_day` and `flux_year`."""
        return {"receiver": self.receiver, "aim": self.aim, "light": self.light}

    def print_files(self) -> None:
        """Report which files were written."""
        for name, path in self.files.items():
            print(f"{name}: {path}")


def _refuse(what: str, any_of: dict[str, str | None], rays: float) -> None:
    for name, value in any_of.items():
        if value is not None:
            raise InputError(f"{name} cannot be used with {what}; leave it out")
    if rays:
        raise InputError(f"--rays: {what} cannot be ray-traced; specify one time")


def _moment(
    plant: "Plant",
    order: _Order,
    time: str | None,
    sun: str | None,
    rays: tuple[float, int],
    by: str,
) -> None:
    from heliotrope.optics import field_flux, flux_files
    from heliotrope.plot import flux_figure

    if time is not None and sun is not None:
        raise InputError("use --time or --sun, not both")
    when = None if sun is not None else noon(plant) if time is None else parse_time(time)
    options = {**order.options, "sun": None if sun is None else parse_sun(sun)}
    with progress("casting beams", order.as_json) as step:
        step(0, 1)
        result = field_flux(plant, when, **options)
    second = None
    if rays[0]:
        with progress("tracing rays", order.as_json) as step:
            second = field_flux(plant, when, rays=rays[0], seed=rays[1], progress=step, **options)
    if "csv" in order.files:
        flux_files.write_heliostats(order.files["csv"], result)
    if "map" in order.files:
        flux_files.write_map(order.files["map"], result)
    if "netcdf" in order.files:
        flux_files.write_netcdf(order.files["netcdf"], result)
    if "picture" in order.files:
        from heliotrope.calibration.plan.report import write_picture

        write_picture(order.files["picture"], flux_figure(result, by))
    if order.as_json:
        print_json(
            _document(result, when) | ({} if second is None else {"rays": _second(result, second)})
        )
        return
    _print_moment(result, second)
    order.print_files()


def _document(result: "PlantFlux", when: Any) -> dict[str, Any]:
    import numpy as np

    from heliotrope.geometry import azimuth_elevation
    from heliotrope.optics import EFFICIENCIES

    azimuth, elevation = np.degrees(azimuth_elevation(result.sun))
    shares = {name: getattr(result.efficiencies, name) for name in EFFICIENCIES}
    power = result.heliostat_power
    return {
        "plant": result.plant,
        "time": when,
        "sun_azimuth_deg": float(azimuth),
        "sun_elevation_deg": float(elevation),
        "dni_w_m2": result.dni,
        "mirror_area_m2": float(result.area.sum()),
        "power_w": result.power,
        "peak_w_m2": result.peak,
        "efficiencies": result.summary,
        "receivers": [
            {
                "name": view.receiver,
                "power_w": view.power,
                "intercept": view.intercept,
                "peak_w_m2": float(view.flux.max()),
                "flux_w_m2": view.flux,
            }
            for view in result.maps
        ],
        "heliostats": [
            {"name": name, "power_w": power[i]} | {key: shares[key][i] for key in EFFICIENCIES}
            for i, name in enumerate(result.names)
        ],
    }


def _second(result: "PlantFlux", second: "PlantFlux") -> dict[str, Any]:
    """Return the ray-tracing result together with the engine's result."""
    import numpy as np

    apart = [a.flux - b.flux for a, b in zip(result.maps, second.maps, strict=True)]
    squares = np.concatenate([flux.ravel() ** 2 for flux in apart])
    noise = np.concatenate([error.ravel() ** 2 for error in second.errors])
    peak = max(second.peak, 1e-300)
    return {
        "count": second.rays,
        "efficiencies": second.summary,
        "power_w": second.power,
        "power_error_w": second.power_error,
        "peak_w_m2": second.peak,
        "cells_apart_of_peak": float(np.sqrt(squares.mean())) / peak,
        "cells_noise_of_peak": float(np.sqrt(noise.mean())) / peak,
    }


def _print_moment(result: "PlantFlux", second: "PlantFlux | None") -> None:
    import numpy as np

    from heliotrope.geometry import azimuth_elevation

    azimuth, elevation = np.degrees(azimuth_elevation(result.sun))
    shares = np.stack([getattr(result.efficiencies, name) for name in _WORDS])
    header = ["efficiency", "field", "lowest heliostat", "highest"]
    rows = []
    for (name, words), share in zip(_WORDS.items(), shares, strict=True):
        known = share[np.isfinite(share)]
        ends = (f"{100 * x:.2f} %" for x in ((known.min(), known.max()) if known.size else ()))
        row = [words, _percent(result.summary[name]), *ends]
        rows.append(row + [""] * (4 - len(row)))
        if second is not None:
            rows[-1].append(_percent(second.summary[name]))
    if second is not None:
        header.append("by rays")
    title = f"{result.plant}: sun azimuth {azimuth:.2f}°, elevation {elevation:.2f}°, "
    title += f"{result.dni:g} W/m² on {result.area.sum():,.0f} m²"
    print_table(header, rows, title=title)
    for view in result.maps:
        # The sun's Gaussians leave a billionth of a beam beside its surface.
        power = view.power if view.power > 1e-6 * result.power else 0.0
        line = f"{view.receiver}: {1e-6 * power:.5g} MW, peak {1e-3 * view.flux.max():.5g} kW/m²"
        if np.isfinite(view.intercept):
            line += f", {100 * max(view.intercept, 0.0):.2f} % of the reflected light"
        print(line)
    dark = int(np.isnan(result.efficiencies.cosine).sum())
    if dark:
        print(f"{dark} of {len(result.names)} heliostats cannot reach their aim point")
    if second is not None:
        said = _second(result, second)
        print(
            f"by {second.rays:,} rays: {1e-6 * said['power_w']:.5g} ± "
            f"{1e-6 * said['power_error_w']:.2g} MW, peak {1e-3 * second.peak:.5g} kW/m²; cells "
            f"differ by {100 * said['cells_apart_of_peak']:.2f} % of the peak (RMS), "
            f"the ray noise is {100 * said['cells_noise_of_peak']:.2f} %"
        )


def _percent(share: float) -> str:
    """Return a share as text; "" without sunlight, where it is NaN."""
    return f"{100 * share:.2f} %" if math.isfinite(share) else ""


def _day(
    plant: "Plant",
    order: _Order,
    time: str | None,
    every: str,
    *,
    any_of: dict[str, str | None],
    rays: float,
) -> None:
    from heliotrope.optics import flux_day

    _refuse("a day", any_of, rays)
    when = parse_time("now" if time is None else time)
    times = sunlit(when, plant.site, every, least=60.0)
    with progress("casting beams", order.as_json) as step:
        table = flux_day(plant, times, progress=step, **order.options)
    _print_table(table, order)


def _year(plant: "Plant", order: _Order, *, any_of: dict[str, str | None], rays: float) -> None:
    from heliotrope.optics import flux_files, flux_year

    _refuse("a year", any_of, rays)
    with progress("casting beams", order.as_json) as step:
        table = flux_year(plant, progress=step, **order.options)
    if "sam" in order.files:
        flux_files.write_sam(order.files["sam"], table)
    if "solartherm" in order.files:
        flux_files.write_solartherm(order.files["solartherm"], table)
    _print_table(table, order)


def _print_table(table: "FluxTable", order: _Order) -> None:
    import numpy as np

    from heliotrope.calibration.plan.report import write_table
    from heliotrope.files.times import format_time
    from heliotrope.optics import EFFICIENCIES

    degrees = np.degrees([table.azimuth, table.elevation, table.declination, table.hour])
    by_time = bool(np.isfinite(table.time).all())
    records = []
    for k in range(len(table.sun)):
        azimuth, elevation, declination, hour = degrees[:, k].tolist()
        place: dict[str, Any] = (
            {"time": format_time(table.time[k])}
            if by_time
            else {"declination_deg": round(declination, 4), "hour_angle_deg": round(hour, 4)}
        )
        place |= {"azimuth_deg": round(azimuth, 4), "elevation_deg": round(elevation, 4)}
        place |= {name: round(float(table.shares[name][k]), 6) for name in EFFICIENCIES}
        place |= {
            "dni_w_m2": round(float(table.dni[k]), 2),
            "power_w": round(float(table.power[k]), 1),
        }
        records.append(place | {"peak_w_m2": round(float(table.peak[k]), 1)})
    if "csv" in order.files:
        write_table(order.files["csv"], records)
    if order.as_json:
        mean = dict(zip(table.names, table.heliostat.tolist(), strict=True))
        print_json(
            {
                "plant": table.plant,
                "mean_efficiency": table.mean,
                "suns": records,
                "heliostats": mean,
            }
        )
        return
    first = ("time",) if by_time else ("declination_deg", "hour_angle_deg")
    heads = [*(name.replace("_deg", ", °").replace("_", " ") for name in first)]
    heads += ["elevation, °", "cosine", "lit", "intercept", "total", "MW", "peak, kW/m²"]
    rows = [
        [
            *(str(record[name]) for name in first),
            f"{record['elevation_deg']:.1f}",
            *(f"{100 * record[name]:.2f} %" for name in ("cosine", "lit", "intercept", "total")),
            f"{1e-6 * record['power_w']:.4g}",
            f"{1e-3 * record['peak_w_m2']:.4g}",
        ]
        for record in records[:SHOWN]
    ]
    print_table(
        heads, rows, title=f"{table.plant}: mean optical efficiency {100 * table.mean:.2f} %"
    )
    if len(records) > SHOWN:
        print(f"and {len(records) - SHOWN:,} more; --csv FILE writes them all")
    order.print_files()
