"""``heliotrope keys``: create and replace the keys of the links between plant and clusters."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from heliotrope.cli._common import print_json, print_table

if TYPE_CHECKING:
    from heliotrope.links.bus_key_file import BusKeyFile
    from heliotrope.links.keys import KeyFile

app = typer.Typer(
    help="Create and replace the keys for the links between plant and clusters.",
    no_args_is_help=True,
)

PlantFile = Annotated[Path, typer.Argument(help="Key file of the plant.")]
Clusters = Annotated[list[str], typer.Argument(help="Names of clusters.")]
FolderOption = Annotated[
    Path,
    typer.Option("--to", help="Folder for the files that carry the new keys to the clusters."),
]


bus_app = typer.Typer(
    help="Create and replace the key that signs the frames on a bus.", no_args_is_help=True
)
app.add_typer(bus_app, name="bus")

BusFile = Annotated[Path, typer.Argument(help="Key file, as named in the cluster file.")]


@app.callback()
def _root() -> None:
    """Create and replace the keys of the links between plant and clusters."""


def _open(path: Path) -> "KeyFile":
    from heliotrope.errors import InputError

    try:
        from heliotrope.links.keys import KeyFile
    except ImportError as error:
        raise InputError(
            f"keys: {error.name} is not installed; run pip install 'heliotrope[control]'"
        ) from None
    return KeyFile(path)


@app.command()
def new(file: PlantFile, clusters: Clusters, to: FolderOption) -> None:
    """Create one key per cluster, in the plant's key file and in a file for the cluster."""
    from heliotrope.links.keys import carried_files

    keys = _open(file)
    carried_files(to, clusters)  # refuses before anything is written
    _carry(to, keys.new(clusters))
    print(f"{file}: new keys for {', '.join(clusters)}")


@app.command()
def rotate(file: PlantFile, clusters: Clusters, to: FolderOption) -> None:
    """Create a second key for each cluster, while the plant and the clusters keep running."""
    from heliotrope.links.keys import carried_files

    keys = _open(file)
    carried_files(to, clusters)  # refuses before anything is written
    _carry(to, keys.rotate(clusters))
    print(f"{file}: new keys created, old keys still valid, for {', '.join(clusters)}")


@app.command()
def take(
    file: Annotated[Path, typer.Argument(help="Key file of the cluster.")],
    carried: Annotated[Path, typer.Argument(help="File created by keys new or keys rotate.")],
) -> None:
    """Import a key file into the cluster's key file, and keep the old key if there is one."""
    from heliotrope.errors import InputError
    from heliotrope.links.keys import fingerprint

    links = _open(carried).links
    if list(links) != ["plant"] or len(links["plant"]) != 1:
        raise InputError(f"{carried}: this file holds no cluster key; create one with keys rotate")
    (key,) = links["plant"]
    _open(file).take(key)
    print(f"{file}: key {fingerprint(key)} installed; delete {carried}")


@app.command()
def end(
    file: Annotated[Path, typer.Argument(help="Key file of the plant or of a cluster.")],
    names: Annotated[
        list[str] | None, typer.Argument(help="Names of clusters; default: all with an old key.")
    ] = None,
) -> None:
    """Remove the old keys, so that only the new keys are accepted."""
    ended = _open(file).end(names or [])
    print(f"{file}: old keys removed: {', '.join(ended)}")


@app.command(name="list")
def list_(
    file: Annotated[Path, typer.Argument(help="Key file of the plant or of a cluster.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """List the keys in a file by fingerprints that reveal nothing, newest first."""
    from heliotrope.errors import InputError
    from heliotrope.links.keys import fingerprint

    if not file.exists():
        raise InputError(f"{file}: no such file; create it with heliotrope keys new")
    links = _open(file).links
    shown = {name: [fingerprint(key) for key in keys] for name, keys in links.items()}
    if as_json:
        print_json(shown)
        return
    print_table(["name", "key", "old key"], [[n, k[0], *k[1:], ""][:3] for n, k in shown.items()])


@app.command()
def tls(
    folder: Annotated[Path, typer.Argument(help="Folder for the keys and certificates.")],
    name: Annotated[
        list[str],
        typer.Option(
            help="Host name or address at which users reach the console; may be repeated."
        ),
    ],
    days: Annotated[
        int, typer.Option(min=1, max=825, help="Validity of the certificate, days.")
    ] = 825,
    request: Annotated[
        bool,
        typer.Option(
            "--request",
            help="Instead create a certificate request, to be signed by another authority.",
        ),
    ] = False,
) -> None:
    """Create or renew the console's certificate under a private authority, created if missing."""
    from heliotrope.cli._common import parse_time
    from heliotrope.errors import InputError

    try:
        from heliotrope.links import certificates
    except ImportError as error:
        raise InputError(
            f"keys: {error.name} is not installed; run pip install 'heliotrope[control]'"
        ) from None
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; create it so that only its owner can read it")
    if request:
        made = certificates.request(folder, name)
        print(
            f"{made.certificate}: have it signed by your authority; the key {made.key} stays on "
            "this computer"
        )
        return
    made = certificates.certify(folder, name, parse_time("now"), days=days)
    print(f"{made.certificate}, {made.key}: pass them to heliotrope run as --certificate and --key")
    print(
        f"{made.authority}: install it in your users' browsers; keep the authority's key, "
        f"{certificates.AUTHORITY}.key, off this machine between renewals"
    )


def _bus(path: Path) -> "BusKeyFile":
    from heliotrope.errors import InputError

    try:
        from heliotrope.links.bus_key_file import BusKeyFile
    except ImportError as error:
        raise InputError(
            f"keys: {error.name} is not installed; run pip install 'heliotrope[control]'"
        ) from None
    return BusKeyFile(path)


@bus_app.command(name="new")
def bus_new(file: BusFile) -> None:
    """Create the bus key, which the cluster distributes to its local controllers."""
    keys = _bus(file)
    keys.new()
    _show(keys)


@bus_app.command(name="rotate")
def bus_rotate(file: BusFile) -> None:
    """Create a second key and keep the present key, while the cluster keeps running."""
    keys = _bus(file)
    keys.rotate()
    _show(keys)


@bus_app.command(name="end")
def bus_end(file: BusFile) -> None:
    """Remove the old key, once frames are signed with the new key."""
    keys = _bus(file)
    keys.end()
    _show(keys)


@bus_app.command(name="off")
def bus_off(file: BusFile) -> None:
    """Remove all keys; the cluster then removes them from local controllers that are at rest."""
    keys = _bus(file)
    keys.off()
    print(
        f"{file}: no key remains; each local controller deletes its key once its mirrors are at "
        "rest"
    )


@bus_app.command(name="list")
def bus_list(file: BusFile) -> None:
    """List the keys by fingerprints that reveal nothing, newest first."""
    from heliotrope.errors import InputError

    if not file.exists():
        raise InputError(f"{file}: no such file; create it with heliotrope keys bus new")
    _show(_bus(file))


def _show(file: "BusKeyFile") -> None:
    from heliotrope.links.keys import fingerprint

    keys = [fingerprint(key) for key in file.keys]
    newest = f"key {keys[0]}" if keys else "no key"
    print(f"{file.path}: {newest}" + (f", old key {keys[1]}" if len(keys) > 1 else ""))


def _carry(folder: Path, keys: dict[str, bytes]) -> None:
    from heliotrope.links.keys import carry

    for path in carry(folder, keys):
        print(f"{path}: carry it to its cluster, run heliotrope keys take there, then delete it")
