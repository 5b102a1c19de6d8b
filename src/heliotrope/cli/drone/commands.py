"""``heliotrope drone``: plan, evaluate, check and simulate flights of a drone with a lamp."""

import typer

from heliotrope.cli.drone.dome import dome
from heliotrope.cli.drone.evaluate import evaluate
from heliotrope.cli.drone.match import match
from heliotrope.cli.drone.plan import plan
from heliotrope.cli.drone.rtk import rtk
from heliotrope.cli.drone.simulate import simulate

app = typer.Typer(
    help="Measure a field with a drone that carries a lamp and a camera.", no_args_is_help=True
)


@app.callback()
def _root() -> None:
    """Measure a field with a drone that carries a lamp and a camera."""


for command in (plan, evaluate, match, dome, rtk, simulate):
    app.command()(command)
