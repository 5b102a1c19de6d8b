"""``heliotrope field``: make and check plant files."""

from pathlib import Path
from typing import Annotated

import typer

from heliotrope.cli._common import print_json, print_table

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


@app.command()
def safety(
    file: Annotated[Path, typer.Argument(help="Plant file (TOML).")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print the numbers of the safety table that a plant may set, with defaults and ranges.

    An asterisk marks those that the tables [safety.CONDITION] of its file change.
    """
    from heliotrope.field.formats import plant_file
    from heliotrope.safety import CONDITIONS, limited, settings_of

    given = plant_file.read_plant(file).safety
    found = [
        {
            "condition": row.name,
            "key": key,
            "value": one.shown(row),
            "default": one.shown(usual),
            "low": one.low,
            "high": one.high,
            "changed": getattr(row, one.number) != getattr(usual, one.number),
        }
        for row, usual in zip(limited(CONDITIONS, given), CONDITIONS, strict=True)
        for key, one in settings_of(usual).items()
        if one.main
    ]
    if as_json:
        print_json(found)
        return
    rows = [
        (
            f"{one['condition']}.{one['key']}{'*' if one['changed'] else ''}",
            f"{one['value']:g}",
            f"{one['default']:g}",
            f"{one['low']:g} to {one['high']:g}",
        )
        for one in found
    ]
    print_table(("number", "in force", "default", "range"), rows)


Plant = Annotated[Path, typer.Argument(help="Plant file (TOML).")]
Note = Annotated[str, typer.Option(help="Reason, kept with the stored version.")]
_RUNNING = (
    "a running plant reads its file at the start: stow the field, end the plant, "
    "`heliotrope run --check`, start it"
)


@app.command("set")
def change(
    file: Plant,
    who: Annotated[str, typer.Argument(help="A heliostat, a target or a receiver.")],
    values: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME=VALUE]…", help="New values; none: show them.", show_default=False
        ),
    ] = None,
    note: Note = "",
    dry: Annotated[bool, typer.Option("--dry-run", help="Check, but write nothing.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Show or change the position, orientation or parameters of one thing; keep the old file.

    Angles may be given in _mrad or _deg and lengths in _mm. Nothing is written if `field check`
    would refuse the result.
    """
    from heliotrope.errors import InputError
    from heliotrope.field.formats import plant_edit

    given = {}
    for text in values or ():
        name, sign, value = text.partition("=")
        if not sign or name in given:
            raise InputError(f"{text!r}: give each value once, as NAME=VALUE")
        given[name] = value
    if not given:
        found = plant_edit.values(file, who)
        if as_json:
            print_json({"name": who, "values": found})
        else:
            print_table((who, "value"), list(found.items()))
        return
    edited = plant_edit.edit(file, who, given, note=note, dry=dry)
    if as_json:
        print_json({**vars(edited), "name": who, "changes": [vars(c) for c in edited.changes]})
        return
    rows = [(c.name, c.old or "none", c.new or "none", c.unit) for c in edited.changes]
    print_table((who, "old", "new", "unit"), rows)
    for warning in edited.warnings:
        print(f"warning: {warning}")
    if dry:
        print("nothing was written")
    else:
        print(f"stored the file as it was: version {edited.version}\n{_RUNNING}")


@app.command()
def versions(
    file: Plant,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """List the stored versions of a plant file, each with the change that ended it."""
    from heliotrope.field.formats import plant_edit

    found = plant_edit.versions(file)
    if as_json:
        print_json([vars(one) for one in found])
        return
    for one in found:
        print(f"{one.name}  {one.note}")
    if not found:
        print(f"{file}: no stored versions")


@app.command()
def restore(
    file: Plant,
    version: Annotated[str, typer.Argument(help="A name of `heliotrope field versions`.")],
    note: Note = "",
) -> None:
    """Bring back a stored version of a plant file and its table; keep the present one."""
    from heliotrope.field.formats import plant_edit

    kept = plant_edit.restore(file, version, note=note)
    print(f"brought back {version}; stored the file as it was: version {kept}\n{_RUNNING}")
