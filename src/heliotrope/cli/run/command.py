"""``heliotrope run``: a simulated or real plant in operation, with its console."""

import contextlib
from enum import StrEnum
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from heliotrope.cli._common import open_plant
from heliotrope.cli._plants import design_of, one_plant, start_of
from heliotrope.cli.run.twin_process import twin_process
from heliotrope.errors import InputError

_TWIN, _REAL, _WORK = "Simulation", "A real plant", "Work"
_CONSOLE, _KEPT = "Console", "Records"


class Begin(StrEnum):
    """The initial state of a simulated field."""

    SECOND_DAY = "second-day"
    NEW = "new"
    STOW = "stow"


#: Maximum number of heliostats measured yesterday; at most 15 % of the field.
_MEASURED = 1500


class GroupedCommand(TyperCommand):
    """A command whose help shows its options under headings."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, then the options under their headings."""
        for heading, params in groupby(self.get_params(ctx), _heading):
            rows = [row for row in (param.get_help_record(ctx) for param in params) if row]
            if rows:
                with formatter.section(heading):
                    formatter.write_dl(rows)


def _heading(param: Any) -> str:
    if param.param_type_name == "argument":
        return "Arguments"
    return getattr(param, "rich_help_panel", None) or "Options"


def run(
    field: Annotated[
        Path | None,
        typer.Argument(help="Plant file or folder; default: 10,000 heliostats, 313 clusters."),
    ] = None,
    heliostats: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=1_000_000,
            help="Number of heliostats in the default plant, instead of 10,000.",
            rich_help_panel=_TWIN,
        ),
    ] = None,
    prototype: Annotated[
        bool,
        typer.Option(
            "--prototype",
            help="Run Malan's prototype: 18 heliostats on simulated boards.",
            rich_help_panel=_TWIN,
        ),
    ] = False,
    speed: Annotated[
        float,
        typer.Option(
            min=0.001, max=1000, help="Simulated seconds per second.", rich_help_panel=_TWIN
        ),
    ] = 1.0,
    start: Annotated[
        str,
        typer.Option(
            help="Simulated start: a day (its morning at the site), ISO 8601 with a time "
            'zone, "now", or "morning" (of today).',
            rich_help_panel=_TWIN,
        ),
    ] = "morning",
    seed: Annotated[
        int,
        typer.Option(
            min=0,
            max=2**63 - 1,
            help="Seed of the true installation errors.",
            rich_help_panel=_TWIN,
        ),
    ] = 0,
    begin: Annotated[
        Begin,
        typer.Option(
            "--from",
            help="second-day: the field tracks, and part of it was measured the day before; new: "
            "no heliostat has been measured; stow: as second-day, but starting in the "
            "morning with the field at stow.",
            rich_help_panel=_TWIN,
        ),
    ] = Begin.SECOND_DAY,
    clusters: Annotated[
        Path | None,
        typer.Option(
            help="Links file: how each cluster is reached; the plant is then real.",
            rich_help_panel=_REAL,
        ),
    ] = None,
    configure: Annotated[
        bool,
        typer.Option(
            "--configure",
            help="Write calibration and machine table to local controllers whose stored "
            "values differ.",
            rich_help_panel=_REAL,
        ),
    ] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Check the files, then exit.", rich_help_panel=_REAL)
    ] = False,
    idle: Annotated[
        bool | None,
        typer.Option(
            "--idle/--automatic",
            help="Wait for an operator, or start automatic control immediately; default: --idle "
            "for a real plant, --automatic in simulation.",
            rich_help_panel=_WORK,
        ),
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            max=1e6,
            help="Time after which to stop; default: run until Ctrl-C.",
            rich_help_panel=_WORK,
        ),
    ] = None,
    every: Annotated[
        float,
        typer.Option(
            min=0.1, max=86_400, help="Interval between status lines, s.", rich_help_panel=_WORK
        ),
    ] = 10.0,
    stow_rate: Annotated[
        float,
        typer.Option(
            min=0,
            max=1e6,
            help="Rate at which an ordinary STOW of many heliostats sends them to stow, "
            "heliostats per second; 0: all at once. In an emergency all are always sent at "
            "once.",
            rich_help_panel=_WORK,
        ),
    ] = 200.0,
    host: Annotated[
        str,
        typer.Option(
            help="Address to listen on; TLS is required unless it is local to this computer.",
            rich_help_panel=_CONSOLE,
        ),
    ] = "127.0.0.1",
    port: Annotated[
        int,
        typer.Option(min=0, max=65_535, help="Port; 0: any free port.", rich_help_panel=_CONSOLE),
    ] = 8080,
    name: Annotated[
        list[str] | None,
        typer.Option(
            help="Host name by which browsers reach this computer; may be repeated.",
            rich_help_panel=_CONSOLE,
        ),
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option(help="PEM file of the TLS certificate.", rich_help_panel=_CONSOLE)
    ] = None,
    key: Annotated[
        Path | None,
        typer.Option(help="PEM file of the certificate's private key.", rich_help_panel=_CONSOLE),
    ] = None,
    plain: Annotated[
        bool,
        typer.Option(
            "--plain",
            help="Allow operation without TLS, behind a proxy that provides it.",
            rich_help_panel=_CONSOLE,
        ),
    ] = False,
    proxy: Annotated[
        list[str] | None,
        typer.Option(
            help="IP address of a trusted proxy, which identifies the callers; may be repeated.",
            rich_help_panel=_CONSOLE,
        ),
    ] = None,
    people_by_proxy: Annotated[
        Path | None,
        typer.Option(
            help="File that defines how --proxy names users whom it has signed in.",
            rich_help_panel=_CONSOLE,
        ),
    ] = None,
    second_factor: Annotated[
        str,
        typer.Option(
            help="Lowest role for which a second factor is required: viewer, operator or engineer.",
            rich_help_panel=_CONSOLE,
        ),
    ] = "",
    idle_lock: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=600.0,
            help="Minutes without an order after which a page asks for the password again; "
            "0: never.",
            rich_help_panel=_CONSOLE,
        ),
    ] = 30.0,
    session: Annotated[
        float,
        typer.Option(
            min=0.25, max=168.0, help="Length of a session, hours.", rich_help_panel=_CONSOLE
        ),
    ] = 10.0,
    sign_ins: Annotated[
        int,
        typer.Option(
            min=3,
            max=100,
            help="Failed sign-ins allowed per hour for one name from one address; further "
            "attempts must wait.",
            rich_help_panel=_CONSOLE,
        ),
    ] = 12,
    notice: Annotated[
        Path | None,
        typer.Option(
            help="File with a notice that is shown before sign-in.",
            rich_help_panel=_CONSOLE,
        ),
    ] = None,
    emergency_port: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=65_535,
            help="Separate port for EMERGENCY; default: the one after --port.",
            rich_help_panel=_CONSOLE,
        ),
    ] = None,
    no_console: Annotated[
        bool,
        typer.Option(
            "--no-console",
            help="Run without the console; only print status lines.",
            rich_help_panel=_CONSOLE,
        ),
    ] = False,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Do not open a browser.", rich_help_panel=_CONSOLE)
    ] = False,
    data: Annotated[
        Path | None,
        typer.Option(
            help="Folder for all records; default: nothing is kept after the run.",
            rich_help_panel=_KEPT,
        ),
    ] = None,
    database: Annotated[
        str | None,
        typer.Option(
            help="postgresql://user@host/name for the records; telemetry stays in --data.",
            rich_help_panel=_KEPT,
        ),
    ] = None,
    syslog: Annotated[
        str | None,
        typer.Option(
            help="Forward security events and alarms to: tls://host, tcp://host or udp://host.",
            rich_help_panel=_KEPT,
        ),
    ] = None,
    syslog_authority: Annotated[
        Path | None,
        typer.Option(
            help="PEM file of the certificate authority for that host; default: the system's.",
            rich_help_panel=_KEPT,
        ),
    ] = None,
    heads: Annotated[
        Path | None,
        typer.Option(
            help="Folder, preferably on another computer, for the heads of the records' "
            "hash chains.",
            rich_help_panel=_KEPT,
        ),
    ] = None,
    heads_every: Annotated[
        float,
        typer.Option(
            min=0.001,
            max=8760,
            help="Interval at which heads are written to that folder and to syslog, hours.",
            rich_help_panel=_KEPT,
        ),
    ] = 1.0,
    photographs_days: Annotated[
        float,
        typer.Option(
            min=1,
            max=36_500,
            help="Days for which calibration photographs are kept: all of them for 30 "
            "days, then one per day and heliostat.",
            rich_help_panel=_KEPT,
        ),
    ] = 400.0,
    photographs_gb: Annotated[
        float,
        typer.Option(
            min=0.001,
            max=1e6,
            help="Maximum size of all kept photographs, GB.",
            rich_help_panel=_KEPT,
        ),
    ] = 4.0,
) -> None:
    """Run a plant that tracks, photographs, learns and corrects; by default in simulation.

    The field leaves stow some heliostats at a time, the camera of each target calibrates one
    heliostat after another, and every calibration is pushed to its local controller. The console
    shows all this. Ctrl-C ends the plant. With --clusters the heliostats are real, and Ctrl-C stows
    them first.
    """
    one_plant("run", field, heliostats, prototype=prototype)
    with contextlib.ExitStack() as stack:
        twin = None
        if clusters is None:
            import sqlalchemy  # noqa: F401 - where it is absent, no field begins in vain

            if configure or check:
                raise InputError("run: --configure and --check need a real plant; use --clusters")
            design = design_of(field, heliostats, prototype=prototype)
            begins = start_of("run", start, design)
            up = begin is not Begin.STOW and not prototype
            options = _options(field, heliostats, prototype=prototype)
            options += ["--speed", str(speed), "--start", begins.isoformat(), *["--up"] * up]
            measured = 0 if begin is Begin.NEW or prototype else _measured(len(design))
            # The field starts while the plant program is being loaded.
            twin = stack.enter_context(twin_process(options, seed, measured))
        from heliotrope.cli.run._evidence import Evidence
        from heliotrope.cli.run._shared import Shown
        from heliotrope.cli.run.plant import PlantChoice, run_plant
        from heliotrope.plant.operations.pictures import PictureSettings
        from heliotrope.plant.settings import PlantSettings
        from heliotrope.twin.program import LINKS, PLANT

        shown = Shown(
            host=host,
            port=port,
            names=tuple(name or ()),
            certificate=certificate,
            key=key,
            plain=plain,
            proxies=tuple(proxy or ()),
            people_by_proxy=people_by_proxy,
            second_factor=second_factor,
            emergency_port=emergency_port,
            idle_s=60.0 * idle_lock,
            session_s=3600.0 * session,
            sign_ins=sign_ins,
            notice=notice,
            console=not no_console,
            browser=not no_browser,
            data=data,
            database=database,
            minutes=minutes,
            every=every,
            plant=PlantSettings(stow_rate=stow_rate),
            evidence=Evidence(syslog, syslog_authority, heads, heads_every),
            photographs=PictureSettings(*_kept(photographs_days, photographs_gb)),
        )
        if twin is not None:
            twin.wait()
            choice = PlantChoice(twin.folder, twin.folder / LINKS, bool(idle), aimed=up, file=field)
            run_plant(open_plant(twin.folder / PLANT), choice, shown, twin.begin)
            return
        assert clusters is not None
        if field is None:
            raise InputError("run: --clusters needs a plant file; put it before the options")
        _only_real(speed=speed != 1.0, start=start != "morning", seed=bool(seed))
        folder = field if field.is_dir() else field.parent
        choice = PlantChoice(folder, clusters, idle is not False, configure, check, file=field)
        run_plant(open_plant(field), choice, shown)


def _kept(days: float, gigabytes: float) -> tuple[float, float, float]:
    """Return for how many days all photographs are kept, then one a day, and their bytes."""
    return min(30.0, days), days, 1e9 * gigabytes


def _measured(heliostats: int) -> int:
    """Return how many heliostats were measured yesterday."""
    return min(_MEASURED, heliostats * 3 // 20)


def _options(field: Path | None, heliostats: int | None, *, prototype: bool) -> list[str]:
    """Return the options of ``heliotrope twin`` for a plant."""
    if field is not None:
        return [str(field)]
    if prototype:
        return ["--prototype"]
    return [] if heliostats is None else ["--heliostats", str(heliostats)]


def _only_real(**simulated: bool) -> None:
    """Refuse options of a simulation for a real plant, and name them."""
    options = ", ".join(f"--{name}" for name, used in simulated.items() if used)
    if options:
        raise InputError(
            f"run: {options}: only available in simulation, because real clusters track the "
            "actual sun by their own clocks; leave out the option, or leave out --clusters to "
            "simulate this plant"
        )
