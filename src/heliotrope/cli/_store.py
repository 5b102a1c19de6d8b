"""``heliotrope store``: inspect, back up, restore, export and migrate the store of a plant."""

from pathlib import Path
from typing import Annotated, Any

import typer

from heliotrope.cli._common import parse_time, print_json, print_table
from heliotrope.cli._noted import note_use, this_person

app = typer.Typer(
    help="Inspect, back up, restore and export a plant's store.", no_args_is_help=True
)

#: Suffix of an audit file, as the library's `JsonLines` writes it.
_LINES = ".jsonl"
Place = Annotated[
    str, typer.Argument(help="Data folder of a plant, or postgresql://user@host/name.")
]
TelemetryOption = Annotated[
    Path | None, typer.Option(help="Telemetry folder; default: the one in the data folder.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]


@app.callback()
def _root() -> None:
    """Inspect, back up, restore and export the store of a plant."""


@app.command()
def info(place: Place, as_json: JsonOption = False) -> None:
    """Print the contents of a store."""
    from heliotrope.files.times import format_time
    from heliotrope.store.backup import summary
    from heliotrope.store.database import Database

    with Database(place) as database:
        figures = summary(database)
    for name in ("first_sighting", "last_sighting"):
        figures[name] = format_time(figures[name]) if figures.get(name) is not None else ""
    if as_json:
        print_json(figures)
        return
    rows = figures.pop("rows")
    for name, value in figures.items():
        print(f"{name.replace('_', ' ')}: {value}")
    if rows:
        print_table(["table", "rows"], [[name, str(count)] for name, count in rows.items()])
    else:
        print("its tables have a different revision; run `heliotrope store migrate`")


@app.command()
def backup(
    place: Place,
    to: Annotated[Path, typer.Option("--to", help="Folder to create.")],
    telemetry: TelemetryOption = None,
    without_telemetry: Annotated[
        bool, typer.Option("--without-telemetry", help="Leave out the telemetry.")
    ] = False,
    sign: Annotated[
        Path | None, typer.Option(help="Private key created by `store key`, to sign the backup.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Create a backup, while the plant may keep running."""
    from heliotrope.store import backup as backups
    from heliotrope.store.database import Database
    from heliotrope.store.signing import SigningKey

    key = None if sign is None else SigningKey(sign)
    with Database(place) as database:
        archive = None if without_telemetry else telemetry or _telemetry(database)
        made = backups.backup(database, to, parse_time("now"), archive, key=key)
    note_use(place, "BACKED_UP", str(to))
    _tell(made, "made", as_json)


@app.command()
def restore(
    backup: Annotated[Path, typer.Argument(help="Folder of a backup.")],
    place: Place,
    telemetry: TelemetryOption = None,
    key: Annotated[
        Path | None,
        typer.Option(help="Public key (FILE.pub) that must match the signature of the backup."),
    ] = None,
    unsigned: Annotated[
        bool,
        typer.Option("--unsigned", help="Restore the backup without checking its signature."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Check a backup and restore it to an empty destination."""
    from heliotrope.errors import InputError
    from heliotrope.store import backup as backups
    from heliotrope.store.database import Database
    from heliotrope.store.signing import PublicKey

    if (key is None) != unsigned:
        raise InputError(
            "store restore: use --key FILE.pub, or --unsigned to restore an unsigned backup"
        )
    signed_by = None if key is None else PublicKey(key)
    file = Database(place).file
    archive = telemetry or (file.with_name(backups.TELEMETRY) if file is not None else None)
    who, now = this_person(), parse_time("now")
    done = backups.restore(backup, place, now, archive, signed_by=signed_by, who=who)
    _tell(done, "restored", as_json)


@app.command()
def key(
    file: Annotated[Path, typer.Argument(help="File to create; the public key is FILE.pub.")],
) -> None:
    """Create the key pair for backups: a private key for signing, and a public key for checking."""
    from heliotrope.store.signing import make_key

    print(
        f"{file}: private key; {make_key(file)}: the public key, for everyone who restores backups"
    )


@app.command()
def export(
    place: Place,
    to: Annotated[Path, typer.Option("--to", help="Folder to create.")],
    heliostat: Annotated[
        list[str] | None, typer.Option(help="Only these heliostats; may be repeated.")
    ] = None,
) -> None:
    """Write every calibration step as CSV, one folder per heliostat."""
    from heliotrope.store import export as exports
    from heliotrope.store.database import Database
    from heliotrope.values import amount

    with Database(place) as database:
        written = exports.export(database, to, heliostat)
    note_use(place, "EXPORTED", f"{amount(len(written), 'heliostat')} to {to}")
    print(f"{to}: {amount(len(written), 'heliostat')}")


@app.command()
def migrate(place: Place) -> None:
    """Migrate a store's tables to the current version, while the plant is stopped."""
    from heliotrope.store import backup as backups
    from heliotrope.store.database import HEAD

    before, copy = backups.migrate(place)
    if before == HEAD:
        print(f"{place}: up to date (revision {HEAD})")
        return
    kept = "" if copy is None else f"; the previous version is kept in {copy}"
    print(f"{place}: migrated from revision {before} to {HEAD}{kept}")


@app.command()
def purge(
    folder: Annotated[Path, typer.Argument(help="Data folder of a stopped plant.")],
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation.")] = False,
) -> None:
    """Overwrite and remove all data of a plant before its computer is decommissioned."""
    from heliotrope.store.purge import purge as remove

    if not yes:
        typer.confirm(f"{folder}: permanently remove all records, accounts and keys?", abort=True)
    count, left = remove(folder)
    print(f"{folder}: {count} files overwritten and removed")
    if left:
        print(f"left in place, not created by a plant: {', '.join(path.name for path in left)}")


@app.command()
def head(place: Place) -> None:
    """Print the heads of the hash chains, to be noted on another computer."""
    if place.endswith(_LINES):
        from heliotrope.plant.orders import audit

        print(audit.verify(place))
        return
    from heliotrope.store import chain
    from heliotrope.store.database import Database

    with Database(place) as database:
        database.require()
        with database.reading() as connection:
            print(" ".join(map(str, chain.heads(connection))))


@app.command()
def verify(
    place: Place,
    head: Annotated[
        list[str] | None,
        typer.Option(
            help="Hash-chain heads to compare with: a file of exported heads, a syslog file, or "
            "the output of an earlier `store head`; may be repeated."
        ),
    ] = None,
) -> None:
    """Check that no events, audit records, accounts or tokens were added, altered or removed."""
    from heliotrope.store import chain
    from heliotrope.store.database import Database
    from heliotrope.store.digests import Head

    files = [Path(text) for text in head or () if Path(text).is_file()]
    typed = [text for text in head or () if not Path(text).is_file()]
    known = [Head.read(word) for text in typed for word in text.split()]
    exported = [entry for file in files for entry in chain.read_heads(file)]
    if place.endswith(_LINES):
        from heliotrope.plant.orders import audit

        last = audit.verify(place, [*known, *exported])
        print(f"{place}: all records verified; {last}")
        return
    with Database(place) as database:
        database.require()
        with database.reading() as connection:
            result = chain.verify(connection, [*known, *exported])
    if head:
        all_of = len(result.fitting) + len(result.old)
        old = ", heads of events older than that could not be checked" if result.old else ""
        print(
            f"{len(result.fitting)} of {all_of} heads match; {chain.kept_since(result.since)}{old}"
        )
    print(f"{place}: all records verified; {' '.join(map(str, result.heads))}")


@app.command()
def query(
    place: Annotated[Path, typer.Argument(help="Data folder of a plant, or its telemetry.")],
    sql: Annotated[str, typer.Argument(help="A single SELECT statement on the telemetry.")],
    as_json: JsonOption = False,
) -> None:
    """Query the telemetry archive in SQL (DuckDB)."""
    from heliotrope.store import telemetry_query
    from heliotrope.store.backup import TELEMETRY

    inside = place / TELEMETRY
    answer = telemetry_query.query(inside if inside.is_dir() else place, sql)
    if inside.is_dir():
        note_use(str(place), "QUERIED", sql)
    rows = answer.to_pylist()
    if as_json:
        print_json(rows)
        return
    print_table(answer.column_names, [[str(v) for v in row.values()] for row in rows])


def _telemetry(database: Any) -> Path | None:
    """Return the folder of the telemetry beside a store, if there is one."""
    from heliotrope.store.backup import TELEMETRY

    if database.file is None:
        return None
    folder: Path = database.file.with_name(TELEMETRY)
    return folder if folder.is_dir() else None


def _tell(result: Any, done: str, as_json: bool) -> None:
    if as_json:
        print_json({**vars(result), "folder": str(result.folder)})
    else:
        print(
            f"backup {result.folder} of {result.made} {done}: {result.size / 1e6:.1f} MB, revision "
            f"{result.revision}"
        )
