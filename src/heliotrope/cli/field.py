"""``heliotrope field``: make and check plant files."""

from pathlib import Path
from typing import Annotated

import typer

from heliotrope.cli._common import print_json

app = typer.Typer(help="Make and check plant files.", no_args_is_help=True)


@app.callback()
def _root() -> None:
    """Make and check plant files."""


@app.command()
def check(
    file: Annotated[Path, typer.Argument(help="Plant file (TOML).")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print everything that is wrong or strange in a plant file; exit code 2 if it cannot run."""
    from heliotrope.field.formats import plant_file

    findings = plant_file.check_plant(file)
    wrong = any(finding.severity == "error" for finding in findings)
    if as_json:
        print_json({"file": str(file), "ok": not wrong, "findings": [vars(f) for f in findings]})
    else:
        for finding in findings:
            print(f"{finding.severity}: {finding.text}")
        if not wrong:
            plant = plant_file.read_plant(file)
            print(
                f"{file}: {len(plant)} heliostats, {len(plant.targets)} targets: "
                f"{'it can run; see the warnings above' if findings else 'no problems found'}"
            )
    if wrong:
        raise typer.Exit(2)
