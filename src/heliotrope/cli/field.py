"""``heliotrope field``: create and check plant files."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from heliotrope.cli._common import print_json, print_table

if TYPE_CHECKING:
    from heliotrope.geometry import FloatArray

#: Sun positions of `noon_suns`: azimuth from noon, and elevation, degrees.
_SUNS = ((0.0, 65.0), (0.0, 40.0), (90.0, 30.0), (-70.0, 20.0))
#: Distance from the receiver up to which light is sought, m, and the light whose extent is printed,
#: suns.
_AROUND, _BRIGHT = 200.0, 10.0

app = typer.Typer(help="Create and check plant files.", no_args_is_help=True)


@app.callback()
def _root() -> None:
    """Create and check plant files."""


@app.command()
def check(
    file: Annotated[Path, typer.Argument(help="Plant file (TOML).")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print all errors and warnings in a plant file; exit code 2 if the plant cannot run."""
    from heliotrope.field.formats import plant_file
    from heliotrope.plant.field.aims import BeamCheck
    from heliotrope.values import amount

    findings = plant_file.check_plant(file)
    invalid = any(finding.severity == "error" for finding in findings)
    if not invalid:
        design = plant_file.read_plant(file)
        unsafe = BeamCheck(design, design.names).at_stow()
        if unsafe:
            name, text = next(iter(unsafe.items()))
            text = (
                f"{amount(len(unsafe), 'heliostat')} cannot be stowed at the pose in the file: "
                f"{name}: {text}"
            )
            findings.append(plant_file.Finding("warning", text))
    if as_json:
        print_json({"file": str(file), "ok": not invalid, "findings": [vars(f) for f in findings]})
    else:
        for finding in findings:
            print(f"{finding.severity}: {finding.text}")
        if not invalid:
            plant = plant_file.read_plant(file)
            print(
                f"{file}: {amount(len(plant), 'heliostat')}, "
                f"{amount(len(plant.targets), 'target')}: "
                f"{'it can run; see the warnings above' if findings else 'no problems found'}"
            )
    if invalid:
        raise typer.Exit(2)


@app.command()
def safety(
    file: Annotated[Path, typer.Argument(help="Plant file (TOML).")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print the safety-table limits that a plant may set, with their defaults and ranges.

    An asterisk marks limits changed by the tables [safety.CONDITION] of the plant file.
    """
    from heliotrope.field.formats import plant_file
    from heliotrope.safety import CONDITIONS, limited, settings_of

    limits = plant_file.read_plant(file).safety
    numbers = [
        {
            "condition": row.name,
            "key": key,
            "value": setting.shown(row),
            "default": setting.shown(usual),
            "low": setting.low,
            "high": setting.high,
            "changed": getattr(row, setting.number) != getattr(usual, setting.number),
        }
        for row, usual in zip(limited(CONDITIONS, limits), CONDITIONS, strict=True)
        for key, setting in settings_of(usual).items()
        if setting.main
    ]
    if as_json:
        print_json(numbers)
        return
    rows = [
        (
            f"{setting['condition']}.{setting['key']}{'*' if setting['changed'] else ''}",
            f"{setting['value']:g}",
            f"{setting['default']:g}",
            f"{setting['low']:g} to {setting['high']:g}",
        )
        for setting in numbers
    ]
    print_table(("setting", "in force", "default", "range"), rows)


@app.command()
def defocus(
    file: Annotated[Path, typer.Argument(help="Plant file (TOML).")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print the intensity of the light beside the receiver after a field-wide DEFOCUS.

    The intensity at the most intense point is in suns, once with all heliostats turned by the same
    angles, and once with the spread of the plant file. Also printed is the distance from the
    receiver centre within which there are more than 10 suns.
    """
    import numpy as np

    from heliotrope.errors import InputError
    from heliotrope.field.formats import plant_file
    from heliotrope.optics.standing import hottest, reach_of
    from heliotrope.plant.field.aims import BeamCheck, default_aims
    from heliotrope.plant.motion.defocusing import defocused_field

    design = plant_file.read_plant(file)
    if not design.receivers or not len(design):
        raise InputError(
            f"{file}: no receiver or no heliostats, so there is nothing to defocus from"
        )
    check = BeamCheck(design, design.names)
    defaults = default_aims(design, design.names, check.armature.origin_1, None)
    aims, center = np.stack(list(defaults.values())), design.receivers[0].center
    documents = []
    for sun in noon_suns(design.site.latitude_deg):
        azimuth, elevation = np.degrees([np.arctan2(sun[0], sun[1]), np.arcsin(sun[2])]).tolist()
        row: dict[str, float] = {"azimuth_deg": azimuth % 360.0, "elevation_deg": elevation}
        for name, alike in (("same", True), ("spread", False)):
            angles = defocused_field(check, aims, sun, alike=alike)
            beams = check.together(angles, sun)
            hot = hottest(beams, center, _AROUND)
            away = float(np.linalg.norm(hot.point - center))
            row |= {f"{name}_suns": hot.suns, f"{name}_m": away, f"{name}_bound_suns": hot.bound}
            row[f"{name}_reach_m"] = reach_of(beams, center, _AROUND, _BRIGHT)
        documents.append(row)
    if as_json:
        print_json(documents)
        return
    heads = ("sun", "same angles", "as in the file", "10 suns exceeded")
    rows = [
        (
            f"az {row['azimuth_deg']:.0f}°, el {row['elevation_deg']:.0f}°",
            f"{row['same_suns']:.0f} suns, {row['same_m']:.0f} m away",
            f"{row['spread_suns']:.0f} suns, {row['spread_m']:.0f} m away",
            f"within {row['spread_reach_m']:.0f} m",
        )
        for row in documents
    ]
    print_table(heads, rows)


def noon_suns(latitude_deg: float) -> "FloatArray":
    """Return the sun positions at which the light of resting beams is examined, (4, 3)."""
    import numpy as np

    from heliotrope.geometry import direction

    # The sun is highest towards the equator.
    noon = 0.0 if latitude_deg < 0.0 else 180.0
    return np.stack([direction(np.radians(noon + a), np.radians(e)) for a, e in _SUNS])


Plant = Annotated[Path, typer.Argument(help="Plant file (TOML).")]
Note = Annotated[str, typer.Option(help="Reason, stored with the version.")]
_RUNNING = (
    "a running plant reads its file only at start-up: stow the field, stop the plant, run "
    "`heliotrope run --check`, then start it"
)


@app.command("set")
def change(
    file: Plant,
    who: Annotated[str, typer.Argument(help="A heliostat, a target or a receiver.")],
    values: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME=VALUE]…",
            help="New values; default: show the current values.",
            show_default=False,
        ),
    ] = None,
    note: Note = "",
    dry: Annotated[bool, typer.Option("--dry-run", help="Check, but write nothing.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Show or change the position, orientation or parameters of one object; keep the old file.

    Angles may be in _mrad or _deg and lengths in _mm. Nothing is written if `field check` would
    reject the result.
    """
    from heliotrope.errors import InputError
    from heliotrope.field.formats import plant_edit

    changes = {}
    for text in values or ():
        name, sign, value = text.partition("=")
        if not sign or name in changes:
            raise InputError(f"{text!r}: specify each value once, as NAME=VALUE")
        changes[name] = value
    if not changes:
        parameters = plant_edit.values(file, who)
        if as_json:
            print_json({"name": who, "values": parameters})
        else:
            print_table((who, "value"), list(parameters.items()))
        return
    edited = plant_edit.edit(file, who, changes, note=note, dry=dry)
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
        print(f"stored the previous file as version {edited.version}\n{_RUNNING}")


@app.command()
def versions(
    file: Plant,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """List the stored versions of a plant file, each with the change that replaced it."""
    from heliotrope.field.formats import plant_edit

    stored = plant_edit.versions(file)
    if as_json:
        print_json([vars(version) for version in stored])
        return
    for version in stored:
        print(f"{version.name}  {version.note}")
    if not stored:
        print(f"{file}: no stored versions")


@app.command()
def restore(
    file: Plant,
    version: Annotated[str, typer.Argument(help="A name from `heliotrope field versions`.")],
    note: Note = "",
) -> None:
    """Restore a stored version of a plant file and its table; the present version is kept."""
    from heliotrope.field.formats import plant_edit

    kept = plant_edit.restore(file, version, note=note)
    print(f"restored {version}; stored the previous file as version {kept}\n{_RUNNING}")
