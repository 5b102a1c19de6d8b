"""``heliotrope fetch``: download published measurements."""

from pathlib import Path
from typing import Annotated

import typer

from heliotrope.cli._common import print_json
from heliotrope.errors import UnknownNameError


def fetch(
    source: Annotated[str, typer.Argument(help="Data set: juelich (PAINT).")],
    heliostats: Annotated[list[str], typer.Argument(help="Heliostat names, for example AA39.")],
    into: Annotated[Path, typer.Option(help="Folder for the files.")],
    base_url: Annotated[
        str | None, typer.Option(help="Address of a mirror server for the data catalogue.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Download properties and measurements of heliostats; existing files are kept."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from heliotrope.field.formats import fetch as fetching

    if source != "juelich":
        raise UnknownNameError("data set", source, ["juelich"])
    address = fetching.DEFAULT_BASE_URL if base_url is None else base_url
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f} of {task.total:.0f}"),
        TimeRemainingColumn(),
    )
    fetched: list[fetching.Fetched] = []
    with Progress(*columns, disable=as_json) as bar:
        task = bar.add_task("looking", total=1)

        def show(state: fetching.FetchState) -> None:
            bar.update(
                task, description=state.stage, completed=state.done, total=max(state.total, 1)
            )

        fetched.append(fetching.fetch_heliostats(heliostats, into, base_url=address, progress=show))
        fetched.append(fetching.fetch_tower(into, base_url=address, progress=show))
    files = [str(file) for part in fetched for file in part.files]
    new = sum(len(part.new) for part in fetched)
    missing = [text for part in fetched for text in part.missing]
    if as_json:
        print_json({"files": files, "new": new, "missing": missing})
        return
    for text in missing:
        print(f"missing: {text}")
    print(f"{len(files)} files in {into}, {new} of them new")
