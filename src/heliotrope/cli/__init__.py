"""The command line, ``heliotrope COMMAND``: each command is a thin shell over the library.

Heavy libraries are imported inside the commands, so that help appears at once.
"""

import sys
from typing import Annotated

import typer
from typer.exceptions import TyperException

from heliotrope import __version__
from heliotrope.cli._ctl import app as ctl_app
from heliotrope.cli._extras import missing
from heliotrope.cli._field_layout import layout
from heliotrope.cli._keys import app as keys_app
from heliotrope.cli._store import app as store_app
from heliotrope.cli._usage import refusal
from heliotrope.cli.aim import aim
from heliotrope.cli.calibrate import calibrate
from heliotrope.cli.camera import app as camera_app
from heliotrope.cli.cluster import cluster
from heliotrope.cli.commission import commission
from heliotrope.cli.demo import demo
from heliotrope.cli.drone.commands import app as drone_app
from heliotrope.cli.evaluate import evaluate
from heliotrope.cli.fetch import fetch
from heliotrope.cli.field import app as field_app
from heliotrope.cli.flux import flux
from heliotrope.cli.image import image
from heliotrope.cli.parameters import parameters
from heliotrope.cli.plan import plan
from heliotrope.cli.run.command import GroupedCommand, run
from heliotrope.cli.simulate import simulate
from heliotrope.cli.standby import glare, standby
from heliotrope.cli.sun import sun
from heliotrope.cli.surface import surface
from heliotrope.cli.track import track
from heliotrope.cli.twin import twin
from heliotrope.cli.view import view
from heliotrope.errors import HeliotropeError

app = typer.Typer(
    help="Run the heliostat field of a solar power tower.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"heliotrope {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    """Run the heliostat field of a solar power tower."""


field_app.command()(layout)

app.command()(sun)
app.command()(track)
app.command()(view)
app.command()(parameters)
app.add_typer(field_app, name="field")
app.add_typer(camera_app, name="camera")
app.command()(flux)
app.command()(aim)
app.command()(standby)
app.command()(glare)
app.command()(image)
app.command()(surface)
app.command()(calibrate)
app.command()(plan)
app.command()(commission)
app.command()(evaluate)
app.add_typer(drone_app, name="drone")
app.command(cls=GroupedCommand)(run)
app.add_typer(ctl_app, name="ctl")
app.add_typer(store_app, name="store")
app.command()(cluster)
app.add_typer(keys_app, name="keys")
app.command()(simulate)
app.command()(fetch)
app.command()(twin)
app.command()(demo)


def main() -> None:
    """Run the command line; invalid input ends with one line on standard error and exit code 2."""
    try:
        sys.exit(app(prog_name="heliotrope", standalone_mode=False) or 0)
    except TyperException as error:
        line = refusal(error)
        print(error.message if line is None else f"heliotrope: {line}", file=sys.stderr)
        sys.exit(2)
    except typer.Abort:
        print("heliotrope: stopped because a prompt was not answered", file=sys.stderr)
        sys.exit(1)
    except HeliotropeError as error:
        print(f"heliotrope: {error}", file=sys.stderr)
        sys.exit(2)
    except ModuleNotFoundError as error:
        words = [word for word in sys.argv[1:] if not word.startswith("-")]
        absent = missing(error, words[0] if words else "")
        if absent is None:
            raise
        print(f"heliotrope: {absent}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("heliotrope: interrupted", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        # The program that reads our output, such as `head`, has closed it.
        sys.stderr.close()
        sys.exit(141)
    except OSError as error:
        print(f"heliotrope: {error.filename or ''}: {error.strerror or error}", file=sys.stderr)
        sys.exit(2)
