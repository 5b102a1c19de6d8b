"""``heliotrope run``: a plant that lives in the twin, with its console, at work until Ctrl-C."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from heliotrope.cli._common import open_plant, parse_time

if TYPE_CHECKING:
    from datetime import datetime

    from heliotrope.field.plant import Plant


def run(
    field: Annotated[
        Path | None,
        typer.Argument(help="Plant file or folder; default: 10,000 heliostats, 313 clusters."),
    ] = None,
    heliostats: Annotated[
        int | None, typer.Option(help="Of the default plant, instead of 10,000.")
    ] = None,
    prototype: Annotated[
        bool, typer.Option("--prototype", help="18 heliostats on simulated boards.")
    ] = False,
    speed: Annotated[float, typer.Option(help="Simulated seconds in a second.")] = 1.0,
    start: Annotated[
        str, typer.Option(help='Simulated start: ISO 8601, "now", or "morning" at the site.')
    ] = "morning",
    seed: Annotated[int, typer.Option(help="Of how the mirrors really stand.")] = 0,
    exact: Annotated[
        bool, typer.Option("--exact", help="Centroids with noise instead of photographs.")
    ] = False,
    gain: Annotated[
        bool,
        typer.Option("--gain", help="Measure by expected gain over the year, not pair by pair."),
    ] = False,
    idle: Annotated[
        bool, typer.Option("--idle", help="Move nothing until a person says so.")
    ] = False,
    port: Annotated[int, typer.Option(help="Of the console, on this machine; 0: a free one.")] = (
        8080
    ),
    no_console: Annotated[bool, typer.Option("--no-console", help="Only print lines.")] = False,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Open no browser.")] = False,
    minutes: Annotated[
        float | None, typer.Option(help="End after this time; default: at Ctrl-C.")
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder in which all is kept; default: nothing outlasts the run."),
    ] = None,
    every: Annotated[float, typer.Option(help="Seconds between lines that are printed.")] = 10.0,
) -> None:
    """Run a plant in simulation: it tracks, photographs, learns and corrects by itself.

    The field leaves stow some heliostats at a time, every target's camera calibrates one
    heliostat after the other, and what was learnt is pushed to its controller. The console shows
    it all. Ctrl-C stows the field and ends.
    """
    from heliotrope.cli._run_plant import Choice, run_plant
    from heliotrope.errors import InputError

    if prototype and (field is not None or heliostats is not None):
        raise InputError("run: --prototype is a plant of its own; give no field and no number")
    if field is not None and heliostats is not None:
        raise InputError("run: --heliostats is for the default plant; leave it out with a field")
    for name, value in (("minutes", minutes), ("every", every)):
        if value is not None and not 0.0 < value < 1e6:
            raise InputError(f"run: --{name} {value:g}; give above 0")
    if not 0.0 < speed <= 1000.0:
        raise InputError(f"run: --speed {speed:g}; give above 0 to 1000")
    design = _design(field, heliostats, prototype=prototype)
    run_plant(
        design,
        Choice(
            speed=speed,
            start=_start(start, design),
            seed=seed,
            exact=exact,
            idle=idle,
            gain=gain,
            boards=prototype,
            port=port,
            console=not no_console,
            browser=not no_browser,
            minutes=minutes,
            data=data,
            every=every,
        ),
    )


def _design(field: Path | None, heliostats: int | None, *, prototype: bool) -> "Plant":
    if field is not None:
        return open_plant(field)
    if prototype:
        from heliotrope.twin.live import prototype_plant

        return prototype_plant()
    from heliotrope.field.layouts import malan_plant

    return malan_plant(10_000 if heliostats is None else heliostats)


def _start(text: str, design: "Plant") -> "datetime":
    """Return the simulated start; "morning": three hours before noon at the site, today."""
    from datetime import UTC, datetime, timedelta

    if text != "morning":
        return parse_time(text).astimezone(UTC)
    noon = datetime.now(UTC).replace(hour=12, minute=0, second=0, microsecond=0)
    return noon - timedelta(hours=design.site.longitude_deg / 15.0 + 3.0)
