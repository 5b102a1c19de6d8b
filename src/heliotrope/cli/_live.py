"""Photographs as they come: a watched folder, a video, a stream, a camera."""

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from heliotrope.imaging.campaign import Job, Outcome
    from heliotrope.imaging.frame import Frame
    from heliotrope.imaging.memory import Memory
    from heliotrope.imaging.sources import Source


#: Models of empty targets are saved after so many frames.
_OFTEN = 20


def follow(
    source: "Source",
    job: "Job",
    *,
    burst: int = 1,
    archive: Path | None = None,
    memory: Path | None = None,
    as_json: bool = False,
) -> int:
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
    memory
        Folder of models of the empty targets: they are used, learn from every frame, and are
        kept for the next time.
    as_json
        One JSON document a line.
    """
    from heliotrope.cli.image import print_spots
    from heliotrope.errors import HeliotropeError
    from heliotrope.imaging.campaign import look
    from heliotrope.imaging.memory import Memory
    from heliotrope.imaging.sources import keep

    count = 0
    known = Memory() if memory is None else Memory.load(memory)
    with source, _kept(known, memory):
        views: tuple[object, ...] = ()
        for frame in _averaged(source, burst):
            count += 1
            place = Path(frame.name or f"frame-{count}")
            if memory is not None:
                job = replace(job, settings=replace(job.settings, empty=known.models))
            try:
                # The camera hardly moves from one frame to the next.
                outcome = look(frame, place, job, previous=views)  # type: ignore[arg-type]
            except HeliotropeError as error:
                print(f"heliotrope: {error}", file=sys.stderr)
                continue
            views = outcome.views or views
            if memory is not None:
                known.learn(outcome.faces)
                if count % _OFTEN == 0:
                    known.save(memory)
            kept = keep(frame, dict(outcome.document), archive) if archive is not None else None
            _print(outcome, kept, as_json, print_spots)
    for problem in getattr(source, "skipped", ()):
        print(f"heliotrope: {problem}", file=sys.stderr)
    return count


@contextmanager
def _kept(known: "Memory", folder: Path | None) -> "Iterator[None]":
    """Save what was learnt at the end, also after Ctrl-C."""
    try:
        yield
    finally:
        if folder is not None:
            known.save(folder)


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
