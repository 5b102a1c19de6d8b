"""Open the frame source specified by a line of text."""

import re
import threading
from datetime import datetime
from pathlib import Path

from heliotrope.errors import InputError
from heliotrope.imaging.files import IMAGE_SUFFIXES
from heliotrope.imaging.sources.folder import FolderSource
from heliotrope.imaging.sources.snapshot import SnapshotSource, is_snapshot
from heliotrope.imaging.sources.source import Source, hide_password
from heliotrope.imaging.sources.video import (
    PORTS,
    VIDEO_SUFFIXES,
    StreamSource,
    UsbSource,
    VideoSource,
)


def open_source(
    text: str,
    *,
    folder: str | Path = ".",
    start: datetime | None = None,
    size: tuple[int, int] = (0, 0),
    watch: bool = False,
    limit: int | None = None,
    stop: threading.Event | None = None,
) -> Source:
    """Return the source specified by a text, as in the plant file's camera entries.

    Parameters
    ----------
    text
        A folder, image or video file; rtsp://…; http://… (MJPEG, or …/now.jpg); usb:0; or
        /dev/video0.
    folder
        Folder to which relative paths refer, usually that of the plant file.
    start, size, watch
        Time of a video's first frame; frame size requested from a device; whether to watch a
        folder.
    limit, stop
        See `Source`.

    Raises
    ------
    InputError
        If the text does not specify a source.
    """
    text, stop = text.strip(), stop or threading.Event()
    scheme, _, rest = text.partition(":")
    scheme, path = scheme.lower(), Path(folder) / text
    if not text:
        raise InputError("no source specified; name a folder, a video, rtsp://…, http://… or usb:0")
    if scheme in PORTS and rest.startswith("//"):
        return (SnapshotSource if is_snapshot(text) else StreamSource)(text, limit=limit, stop=stop)
    if scheme == "usb" or re.fullmatch(r"/dev/video\d+", text):
        device = rest if scheme == "usb" else text
        return UsbSource(device, width=size[0], height=size[1], limit=limit, stop=stop)
    if rest.startswith("//"):
        known = "://, ".join(PORTS)
        raise InputError(
            f"source {hide_password(text)}: frames come over {known}://, not over {scheme}://"
        )
    if path.is_dir() or path.suffix.lower() in IMAGE_SUFFIXES:
        return FolderSource(path, watch=watch, limit=limit, stop=stop)
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return VideoSource(path, start=start, limit=limit, stop=stop)
    what = "is neither" if path.exists() else "no such file: specify"
    kinds = ", ".join((*IMAGE_SUFFIXES, *VIDEO_SUFFIXES))
    raise InputError(f"source {path}: {what} a folder, an image or a video ({kinds})")
