"""Frame sources: folders, videos, streams, devices, simulations; and archiving of frames.

A source is a context manager that yields frames::

    with open_source("rtsp://10.0.0.5/target", limit=8) as source:
        frame = average(source)

Begin with `open_source`, which accepts the source text of a camera in the plant file. `average`
reduces noise, and `keep` archives a frame with its result.
"""

from heliotrope.imaging.sources.folder import FolderSource
from heliotrope.imaging.sources.keeping import average, keep
from heliotrope.imaging.sources.opening import open_source
from heliotrope.imaging.sources.snapshot import SnapshotSource, is_snapshot
from heliotrope.imaging.sources.source import SimulatedSource, Source
from heliotrope.imaging.sources.video import (
    VIDEO_SUFFIXES,
    CameraSource,
    StreamSource,
    UsbSource,
    VideoSource,
)

__all__ = [
    "VIDEO_SUFFIXES",
    "CameraSource",
    "FolderSource",
    "SimulatedSource",
    "SnapshotSource",
    "Source",
    "StreamSource",
    "UsbSource",
    "VideoSource",
    "average",
    "is_snapshot",
    "keep",
    "open_source",
]
