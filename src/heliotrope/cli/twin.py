"""``heliotrope twin``: a simulated field as a separate program."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from heliotrope.cli._common import open_plant
from heliotrope.cli._plants import design_of, one_plant, start_of

if TYPE_CHECKING:
    import asyncio

    from heliotrope.twin.program import TwinProgram

#: Line on standard output once the folder is written and the server responds.
READY = "ready"


def twin(
    field: Annotated[
        Path | None,
        typer.Argument(help="Plant file or folder; default: 10,000 heliostats, 313 clusters."),
    ] = None,
    folder: Annotated[
        Path, typer.Option(help="Folder to create for plant file, links file, keys and sensors.")
    ] = Path("twin"),
    heliostats: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=1_000_000,
            help="Number of heliostats in the default plant, instead of 10,000.",
        ),
    ] = None,
    prototype: Annotated[
        bool, typer.Option("--prototype", help="Malan's prototype: 18 heliostats.")
    ] = False,
    seed: Annotated[
        int, typer.Option(min=0, max=2**63 - 1, help="Seed of the true installation errors.")
    ] = 0,
    start: Annotated[
        str,
        typer.Option(
            help="Simulated time at the start: a day (its morning at the site), ISO 8601 "
            'with a zone, "morning" (of today), or "now", which follows the clock of '
            "this computer."
        ),
    ] = "now",
    speed: Annotated[
        float, typer.Option(min=0.001, max=1000, help="Simulated seconds per second.")
    ] = 1.0,
    boards: Annotated[
        bool,
        typer.Option(
            "--boards",
            help=(
                "Simulate each heliostat with a board that runs the real firmware; for small "
                "plants."
            ),
        ),
    ] = False,
    pty: Annotated[
        bool,
        typer.Option("--pty", help="Attach the boards of each cluster to a pseudo-terminal."),
    ] = False,
    up: Annotated[
        bool, typer.Option("--up", help="Start with the heliostats tracking, as on a working day.")
    ] = False,
    plant: Annotated[
        str, typer.Option(help="Host and port on which the plant listens for clusters.")
    ] = "127.0.0.1:4840",
    serve: Annotated[
        str, typer.Option(help="Host and port for photographs; port 0: any free port.")
    ] = "127.0.0.1:0",
    child: Annotated[bool, typer.Option(hidden=True)] = False,
) -> None:
    """Simulate a field that a plant reaches like a real one: over TCP, HTTP and sensor files.

    The command writes the files that the plant needs into a folder, and runs until Ctrl-C. Start
    the plant with heliotrope run FOLDER/plant.toml --clusters FOLDER/links.toml. If the folder
    already exists, the field that ran before runs again.
    """
    from heliotrope.errors import InputError
    from heliotrope.twin.live.live import steps_every
    from heliotrope.twin.program import (
        LINKS,
        PLANT,
        TwinOptions,
        TwinProgram,
        read_folder,
        write_folder,
    )

    one_plant("twin", field, heliostats, prototype=prototype)
    if start == "now" and (speed != 1.0 or up):
        raise InputError(
            "twin: --speed and --up need --start: without it the twin follows this computer's clock"
        )
    if pty and not (boards or prototype):
        raise InputError("twin: --pty needs --boards, because only boards have a serial bus")
    if field is None and (folder / LINKS).exists():
        if start != "now":
            raise InputError(
                f"twin: {folder}: this twin has run before; restart it with --start now"
            )
        design, files = open_plant(folder / PLANT), read_folder(folder)
        begins = None
    else:
        design = design_of(field, heliostats, prototype=prototype)
        begins = None if start == "now" else start_of("twin", start, design)
        files = write_folder(
            design,
            folder,
            _address(plant, "--plant"),
            _free(_address(serve, "--serve")),
            steps_every=steps_every(len(design)),
        )
    options = TwinOptions(begins, speed, seed, boards or prototype, pty, up, waits=child)
    program = TwinProgram(design, files, options)
    if child:
        print(READY, flush=True)
    else:
        print(f"{design.name}: {len(design):,} simulated heliostats in {folder}")
        print(f"now run: heliotrope run {folder / PLANT} --clusters {folder / LINKS}", flush=True)
    _run(program, child=child)


def _run(program: "TwinProgram", *, child: bool) -> None:
    """Run until Ctrl-C or SIGTERM or, as a child process, until the parent closes its input."""
    import asyncio
    import signal
    import sys
    import threading

    from heliotrope.twin import warm

    warm.moving()

    async def main() -> None:
        loop, ending = asyncio.get_running_loop(), asyncio.Event()
        if child:
            # Ctrl-C in the terminal is meant for the plant.
            signal.signal(signal.SIGINT, signal.SIG_IGN)

            def wait() -> None:
                sys.stdin.read()
                _end(loop, ending)

            threading.Thread(target=wait, daemon=True).start()
        else:
            loop.add_signal_handler(signal.SIGINT, ending.set)
        loop.add_signal_handler(signal.SIGTERM, ending.set)
        await program.run(ending)

    with asyncio.Runner(loop_factory=program.loop) as runner:
        runner.run(main())


def _end(loop: "asyncio.AbstractEventLoop", ending: "asyncio.Event") -> None:
    import contextlib

    with contextlib.suppress(RuntimeError):  # the loop has ended
        loop.call_soon_threadsafe(ending.set)


def _address(text: str, option: str) -> tuple[str, int]:
    from urllib.parse import urlsplit

    from heliotrope.errors import InputError

    try:
        parts = urlsplit(f"//{text}")
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if not host or port is None:
        raise InputError(f"twin: {option} {text}: write host:port, such as 127.0.0.1:4840")
    return host, port


def _free(address: tuple[str, int]) -> tuple[str, int]:
    """Return an address with a free port in place of port 0."""
    import socket

    from heliotrope.errors import InputError

    host, port = address
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.create_server((host, port), family=family) as server:
            return host, server.getsockname()[1]
    except OSError as error:
        why = error.strerror or str(error)
        raise InputError(f"twin: --serve {host}:{port} cannot be opened ({why})") from None
