"""``heliotrope aim``: aims that keep the receiver's flux below a limit despite mirror errors."""

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from heliotrope.cli._calibration import progress
from heliotrope.cli._common import (
    open_field,
    parse_numbers,
    parse_sun,
    parse_time,
    print_json,
    print_table,
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
from heliotrope.errors import InputError, shown

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from heliotrope.aims import AimPlan, FluxLimit
    from heliotrope.aims.strategies import Strategy
    from heliotrope.geometry import FloatArray

#: Maximum number of heliostats and cells that are listed, and of ranges of rows or columns.
NAMED, RANGES = 5, 3


def aim(
    field: Field,
    limit: Annotated[
        str,
        typer.Option(
            help="Allowable flux: one value in kW/m², or a CSV file with a value in W/m² per cell."
        ),
    ],
    panels: Annotated[
        Path | None,
        typer.Option(
            help="Receiver panels with the state of their fluid (CSV); --limit must then be a CSV "
            "table of allowable flux."
        ),
    ] = None,
    margin: Annotated[
        float, typer.Option(min=0, max=0.5, help="Fraction of the limit reserved for model error.")
    ] = 0.01,
    probability: Annotated[
        float,
        typer.Option(min=0.5, max=0.9999, help="Probability that the limit holds in all cells."),
    ] = 0.99,
    strategy: Annotated[
        Literal["optimal", "middle", "spread", "image-size", "gradient", "all"],
        typer.Option(
            help="Aiming strategy; only optimal respects the limit, the others are for comparison."
        ),
    ] = "optimal",
    keep_all: Annotated[
        bool, typer.Option("--keep-all", help="Fail rather than defocus a heliostat.")
    ] = False,
    wanted: Annotated[
        str,
        typer.Option(
            help="Desired flux: uniform, or a CSV file with a value per cell. Default: any."
        ),
    ] = "",
    give_percent: Annotated[
        float,
        typer.Option(
            min=0, max=50, help="Largest power loss accepted for reaching the desired flux, %."
        ),
    ] = 1.0,
    ramp: Annotated[
        float | None,
        typer.Option(
            min=0.001, max=64000, help="Start-up: maximum rate of flux increase, kW/m² per minute."
        ),
    ] = None,
    without: Annotated[
        list[str] | None, typer.Option(help="Lost heliostat or cluster; may be repeated.")
    ] = None,
    drift_mrad: Annotated[
        float,
        typer.Option(
            min=0,
            max=50,
            help="Standard deviation of an error common to all mirror normals, mrad per axis.",
        ),
    ] = 0.0,
    cluster_mrad: Annotated[
        float,
        typer.Option(
            min=0,
            max=50,
            help="Standard deviation of an error common to all mirror normals of a cluster, mrad "
            "per axis.",
        ),
    ] = 0.0,
    clock_s: Annotated[
        float,
        typer.Option(min=0, max=600, help="Standard deviation of the field clock's error, s."),
    ] = 0.0,
    time: Time = None,
    sun: Sun = None,
    receiver: Annotated[str, typer.Option(help="Receiver; default: the first.")] = "",
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
    csv: Annotated[Path | None, typer.Option("--csv", help="File for the aims.")] = None,
    cells_csv: Annotated[
        Path | None,
        typer.Option("--map", help="File for each cell's flux and limit (CSV)."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Picture to write (.png, .svg or .pdf).")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Choose aims with the highest power that keep the flux below a limit with a probability."""
    from heliotrope.aims import STRATEGIES, SharedErrors, plan_aims

    light = light_of(
        dni, shape, air, slope_mrad, error_mrad, reflectivity, clean, focus, facets, cells, tower
    )
    files = {"csv": csv, "map": cells_csv, "picture": picture}
    _check(field, files)
    allowed = _limit(limit, margin, panels)
    if time is not None and sun is not None:
        raise InputError("use --time or --sun, not both")
    plant = open_field(field, site)
    light = replace(light, canting=canting_of(canting, light.facets, plant))
    when = None if sun is not None else noon(plant) if time is None else parse_time(time)
    options: dict[str, Any] = {
        "sun": None if sun is None else parse_sun(sun), "light": light, "limit": allowed,
        "probability": probability, "keep": keep_all,
        "wanted": _wanted(wanted), "give": 1e-2 * give_percent,
        "without": tuple(without or ()),
        "shared": SharedErrors(1e-3 * drift_mrad, clock_s, 1e-3 * cluster_mrad),
    }  # fmt: skip
    names: tuple[Strategy, ...] = STRATEGIES if strategy == "all" else (strategy,)
    with progress("choosing aims", as_json) as step:
        plans = {
            name: plan_aims(plant, when, receiver, strategy=name, progress=step, **options)
            for name in names
        }
    chosen = plans[names[-1]]
    if allowed.unit_hint:
        print(f"heliotrope: {limit}: {allowed.unit_hint}", file=sys.stderr)
    joins = None if ramp is None else chosen.ramp_up(1e3 / 60.0 * ramp)
    _write(files, plans, chosen, joins)
    if as_json:
        print_json(_document(plans, chosen) | ({} if joins is None else {"joins_s": joins}))
        return
    _print(plans, chosen)
    if options["wanted"] is not None:
        far = chosen.deviation(options["wanted"])
        print(f"the flux differs from the desired flux by {100 * far:.1f} % of its mean (RMS)")
    if joins is not None:
        _print_ramp(chosen, joins)
    for name, path in files.items():
        if path is not None:
            print(f"{name}: {path}")


def _check(field: Path, files: Mapping[str, Path | None]) -> None:
    from heliotrope.calibration.plan.report import check_picture
    from heliotrope.cli.plan import check_outputs

    picture = files["picture"]
    if picture is not None:
        check_picture(picture)
    check_outputs(tuple(path for path in files.values() if path is not None), field, None)


def _write(
    files: Mapping[str, Path | None],
    plans: "Mapping[Any, AimPlan]",
    chosen: "AimPlan",
    joins: "FloatArray | None",
) -> None:
    from heliotrope.aims import write_aim_map, write_aims
    from heliotrope.calibration.plan.report import write_picture

    csv, cells, picture = files["csv"], files["map"], files["picture"]
    if csv is not None:
        write_aims(csv, chosen, joins)
    if cells is not None:
        write_aim_map(cells, chosen)
    if picture is not None:
        from heliotrope.plot import aim_figure

        write_picture(picture, aim_figure(*plans.values()))


def _limit(text: str, margin: float, panels: Path | None) -> "FluxLimit":
    from heliotrope.aims import FluxLimit, read_limit, read_table_limit

    if panels is not None:
        return read_table_limit(text, panels, margin)
    if Path(text).suffix.lower() == ".csv":
        return read_limit(text, margin)
    refusal = f"--limit {shown(text)}: use 0.001 to 64000 kW/m², or a .csv file in W/m²"
    return FluxLimit(1e3 * parse_numbers(text, refusal, least=1e-3, most=6.4e4)[0], margin)


def _wanted(text: str) -> "FluxLimit | None":
    from heliotrope.aims import FluxLimit, read_limit

    if Path(text).suffix.lower() == ".csv":
        return read_limit(text)
    if text not in ("", "uniform"):
        raise InputError(f"--wanted must be uniform, or a .csv file in W/m², not {shown(text)}")
    return FluxLimit(1.0) if text else None


def _print_ramp(chosen: "AimPlan", joins: "FloatArray") -> None:
    """Print the course of the start-up, with one line per quarter of the power."""
    import numpy as np

    order = np.argsort(joins)
    order = order[np.isfinite(joins[order])]
    power = np.cumsum(chosen.light.heliostat_power[order])
    print(f"start-up: the last of {len(order):,} heliostats joins after {joins[order[-1]]:.0f} s")
    for share in (0.25, 0.5, 0.75):
        k = int(np.searchsorted(power, share * power[-1]))
        print(f"  {100 * share:.0f} % of the power after {joins[order[k]]:.0f} s")


def _document(plans: "Mapping[Any, AimPlan]", chosen: "AimPlan") -> dict[str, Any]:
    from heliotrope.aims import compare_aims

    power = chosen.light.heliostat_power
    return {
        "plant": chosen.light.plant,
        "receiver": chosen.light.maps[0].receiver,
        "strategies": compare_aims(plans),
        "flux_w_m2": chosen.light.flux,
        "quantile_w_m2": chosen.quantile,
        "limit_w_m2": chosen.limit,
        "binding": chosen.binding,
        "price_m2": chosen.price,
        "heliostats": [
            {
                "name": name,
                "state": state,
                "aim_m": chosen.aim[k],
                "power_w": power[k],
                "calibration_gain_w": chosen.gain[k],
            }
            for k, (name, state) in enumerate(zip(chosen.names, chosen.states, strict=True))
        ],
    }


def _print(plans: "Mapping[Any, AimPlan]", chosen: "AimPlan") -> None:
    import numpy as np

    from heliotrope.aims import compare_aims

    header = [
        "strategy",
        "MW",
        "lost",
        "peak, kW/m²",
        "over the limit",
        "defocused",
        "possible gain",
    ]
    rows = []
    for row in compare_aims(plans):
        share = row["lost_w"] / max(row["power_w"] + row["lost_w"], 1e-300)
        over = f"{100 * row['excess']:+.2f} %"
        gap = f"+{100 * row['gap']:.2f} %" if np.isfinite(row["gap"]) else ""
        peak = f"{1e-3 * row['peak_w_m2']:.5g}"
        rows.append(
            [row["strategy"], f"{1e-6 * row['power_w']:.5g}", f"{100 * share:.2f} %", peak, over,
             str(row["defocused"]), gap]
        )  # fmt: skip
    print_table(
        header, rows, title=f"{chosen.light.plant}: aims on {chosen.light.maps[0].receiver}"
    )
    for mask, one, many in (
        (chosen.lost_mirrors, "is lost", "are lost"),
        (chosen.elsewhere, "belongs to another receiver", "belong to other receivers"),
        (chosen.unlit, "reaches no receiver cell", "reach no receiver cell"),
    ):
        count = int(mask.sum())
        first = chosen.names[int(mask.argmax())]
        if count == 1:
            print(f"1 heliostat {one}: {first}")
        elif count:
            print(f"{count:,} heliostats {many}; the first is {first}")
    _print_binding(chosen)
    best = np.argsort(-chosen.gain)[:NAMED]
    words = [
        f"{chosen.names[k]} {1e-3 * chosen.gain[k]:.3g} kW" for k in best if chosen.gain[k] > 0
    ]
    if words:
        print(f"calibration would gain the most power at {', '.join(words)}")


def _print_binding(chosen: "AimPlan") -> None:
    """Print where the limit binds, and the cells in which a higher limit would gain most."""
    import numpy as np

    binding, over = chosen.binding, chosen.quantile / chosen.limit - 1.0
    count = int(binding.sum())
    line = f"{count:,} of {binding.size:,} cells {'at' if chosen.excess <= 0 else 'at or above'} "
    line += "the limit"
    if not count:
        closest = _cell(chosen, over.argmax())
        print(f"{line}; the closest is {-100 * chosen.excess:.1f} % below it: {closest}")
        return
    rows, columns = (np.unique(indices) for indices in np.nonzero(binding))
    print(f"{line}, in {_ranges('row', rows)} (0 is the lowest) and {_ranges('column', columns)}")
    gain = np.where(binding, 1e-5 * chosen.limit * chosen.price, 0.0)
    priced = np.count_nonzero(gain)
    order = np.argsort(-(gain if priced else over), axis=None)
    for k in order[: min(NAMED, priced or count)]:
        text = f"a 1 % higher limit there adds about {gain.flat[k]:.2g} kW"
        if not priced:
            side = "above" if over.flat[k] > 0.0 else "below"
            text = f"{100 * abs(over.flat[k]):.1f} % {side} the limit"
        print(f"  {_cell(chosen, k)}: {text}")


def _cell(chosen: "AimPlan", k: "np.intp") -> str:
    """Return the row, column and place of a cell as text."""
    import numpy as np

    row, column = np.unravel_index(k, chosen.limit.shape)
    # Adding 0 removes the sign from numbers that round to −0.
    east, north, up = chosen.cells[row, column].round(2) + 0.0
    return f"row {row}, column {column} ({east:.2f}, {north:.2f}, {up:.2f} m)"


def _ranges(noun: str, numbers: "npt.NDArray[np.intp]") -> str:
    """Return the ranges of rising numbers as text, or the whole range if there are many."""
    import numpy as np

    parts = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    parts = parts if len(parts) <= RANGES else [numbers]
    text = ", ".join(f"{p[0]}" if p[0] == p[-1] else f"{p[0]} to {p[-1]}" for p in parts)
    return f"{noun}{'' if text.isdigit() else 's'} {text}"
