"""Average and archive the frames from a source."""

import json
import math
import os
import re
import threading
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from heliotrope.errors import InputError
from heliotrope.files.text import write_text
from heliotrope.imaging.files import write_image
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.motion import find_shift


def average(frames: Iterable[Frame], max_shift: float = 1.0) -> Frame:
    """Return the mean of N frames, in which the noise is smaller by the factor √N.

    Parameters
    ----------
    frames
        Frames of the same camera, size and depth.
    max_shift
        Largest shift relative to the first frame, px, where `motion.find_shift` can measure it.

    Returns
    -------
    Frame
        uint16; for 8-bit frames 257 times the mean, so that full scale stays full scale. Its time
        is the mean of the frame times, with the RMS of their standard deviations, because the
        errors of one clock do not average out.

    Raises
    ------
    InputError
        If there are no frames, they differ in size or depth, or the camera moved.
    """
    first: Frame | None = None
    total: Any = 0.0
    used: list[Frame] = []
    for frame in frames:
        first = first or frame
        if (frame.pixels.shape, frame.pixels.dtype) != (first.pixels.shape, first.pixels.dtype):
            raise InputError(
                f"{frame.name} has {frame.pixels.shape} pixels of {frame.pixels.dtype}, but "
                f"{first.name} has {first.pixels.shape} of {first.pixels.dtype}; use frames of the "
                "same size and depth"
            )
        shift = find_shift(first, frame) if used and min(frame.size) >= 16 else None
        if shift is not None and math.hypot(*shift) > max_shift:
            raise InputError(
                f"{frame.name}: the camera moved by {math.hypot(*shift):.2f} px since the first "
                f"frame; the limit is {max_shift:g} px: keep the camera still or average fewer "
                "frames"
            )
        total = total + frame.count * frame.pixels.astype(np.float64)
        used.append(replace(frame, pixels=frame.pixels[:1, :1]))
    if first is None:
        raise InputError("no frame to average; the source delivered none")
    counts = [frame.count for frame in used]
    passed = [(f.time - first.time).total_seconds() for f in used if f.time and first.time]
    time = None
    if first.time is not None and len(passed) == len(used):
        time = first.time + timedelta(seconds=float(np.average(passed, weights=counts)))
    scale = (257.0 if first.pixels.dtype == np.uint8 else 1.0) / sum(counts)
    deviation = math.sqrt(sum(frame.time_deviation**2 for frame in used) / len(used))
    return Frame(
        np.rint(total * scale).astype(np.uint16),
        f"mean of {sum(counts)} from {first.name}",
        time,
        deviation if time else math.nan,
        first.exposure if len({frame.exposure for frame in used}) == 1 else math.nan,
        first.gain if len({frame.gain for frame in used}) == 1 else math.nan,
        sum(counts),
    )


def keep(frame: Frame, result: Mapping[str, Any], folder: str | Path) -> Path:
    """Archive a frame as a PNG, and its result as a JSON file of the same name.

    Parameters
    ----------
    frame
        The frame; its time in UTC and its source determine the file names.
    result
        Numbers, texts, arrays, times and paths; numbers that are not finite become null.
    folder
        Folder, created if needed. Nothing in it is overwritten; a second frame with the same name
        receives a number. The JSON file is written last, so if it is present the PNG is complete.

    Returns
    -------
    Path of the PNG.

    Raises
    ------
    InputError
        If the files cannot be written, or the result contains values that JSON cannot represent.
    """
    source = re.sub(r"[^A-Za-z0-9]+", "-", re.sub(r"\.\w+$", "", Path(frame.name).name)).strip("-")
    when = frame.time.astimezone(UTC).strftime("%Y%m%dT%H%M%S.%fZ") if frame.time else "undated"
    about = {
        "source": frame.name, "time": frame.time, "time_deviation_s": frame.time_deviation,
        "exposure_s": frame.exposure, "gain": frame.gain, "count": frame.count,
        "size_px": frame.size,
    }  # fmt: skip
    text = json.dumps({"frame": about, "result": result}, default=_plain)
    record = json.loads(text, parse_constant=lambda _: None)
    stem = f"{when}_{source[:60] or 'frame'}"
    draft = Path(folder) / f".{os.getpid()}-{threading.get_ident()}-{stem}.png"
    try:
        draft.parent.mkdir(parents=True, exist_ok=True)
        write_image(frame, draft)
        for number in count(1):
            image = draft.with_name(f"{stem}.png" if number == 1 else f"{stem}-{number}.png")
            notes = image.with_suffix(".json")
            with suppress(FileExistsError):
                if not notes.exists():
                    image.hardlink_to(draft)  # fails if the file exists, unlike a rename
                    break
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be written ({error.strerror}); specify a writable folder"
        ) from None
    finally:
        with suppress(OSError):
            draft.unlink()
    write_text(notes, json.dumps(record, ensure_ascii=False, indent=1) + "\n")
    return image


def _plain(value: Any) -> Any:
    """Return a JSON value for an array, a time or a path."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, datetime | Path):
        return value.isoformat() if isinstance(value, datetime) else str(value)
    raise InputError(
        f"a result of type {type(value).__name__} cannot be stored; use numbers or text"
    )
