"""Photographs as they come: a watched folder, a video, a stream, a camera."""

import json
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from heliotrope.imaging.campaign import Job, Outcome
    from heliotrope.imaging.frame import Frame
    from heliotrope.imaging.sources import Source


def follow(
    source: "Source", job: "Job", *, burst: int = 1, archive: Path | None = None,
    as_json: bool = False,
) -> int:  # fmt: skip
    """Read every frame of a source and print what it shows; return how many were read.

    Parameters
    ----------
    source
        Frames.
    job
        How to read them.
    burst
        So many frames are averaged into one.
    archive
        Folder in which frames are kept with their results.
    as_json
        One JSON document a line.
    """
    from heliotrope.cli.image import print_spots
    from heliotrope.errors import HeliotropeError
    from heliotrope.imaging.campaign import look
    from heliotrope.imaging.sources import keep

    count = 0
    with source:
        views: tuple[object, ...] = ()
        for frame in _averaged(source, burst):
            count += 1
            place = Path(frame.name or f"frame-{count}")
            try:
                # The camera hardly moves from one frame to the next.
                outcome = look(frame, place, job, previous=views)  # type: ignore[arg-type]
            except HeliotropeError as error:
                print(f"heliotrope: {error}", file=sys.stderr)
                continue
            views = outcome.views or views
            kept = keep(frame, dict(outcome.document), archive) if archive is not None else None
            _print(outcome, kept, as_json, print_spots)
    for problem in getattr(source, "skipped", ()):
        print(f"heliotrope: {problem}", file=sys.stderr)
    return count


def _averaged(source: "Source", burst: int) -> "Iterator[Frame]":
    from heliotrope.imaging.sources import average

    frames = iter(source)
    while together := list(islice(frames, burst)):
        yield together[0] if burst == 1 else average(together)


def _print(outcome: "Outcome", kept: Path | None, as_json: bool, show: object) -> None:
    from heliotrope.cli._common import plain

    if as_json:
        document = {**outcome.document, "kept": None if kept is None else str(kept)}
        print(json.dumps(plain(document), ensure_ascii=False), flush=True)
        return
    show([outcome])  # type: ignore[operator]
    if kept is not None:
        print(f"  kept: {kept}")
    sys.stdout.flush()
