"""Frames from image files: a folder, read once or watched."""

import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from heliotrope.errors import FormatError, InputError
from heliotrope.imaging.files import IMAGE_SUFFIXES, find_images, read_image
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.sources.source import Source


@dataclass
class FolderSource(Source):
    """The images in a folder, in natural order, and later images if the folder is watched.

    A file in a watched folder is read once it is complete and has not changed between two polls. A
    file that changes later is read again, so a camera may always overwrite the same file. If the
    folder disappears, as a network folder may, the source waits for it to return.

    Attributes
    ----------
    path
        The folder, or one image.
    watch
        Whether to continue with files that appear later.
    poll, patience
        Interval between polls of the folder, and time after which an unreadable file in a watched
        folder counts as broken, s.
    skip_broken
        Whether to leave out broken files and list them in ``skipped`` instead of raising
        FormatError; None to leave them out only if the folder is watched.
    read
        Function that reads a file; by default `heliotrope.imaging.files.read_image`.
    wait
        Function that waits for a number of seconds; by default it waits until ``stop`` is set.
    """

    path: str | Path
    watch: bool = False
    poll: float = 0.5
    patience: float = 10.0
    skip_broken: bool | None = None
    read: Callable[[Path], Frame] = read_image
    wait: Callable[[float], object] | None = None
    skipped: list[FormatError] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        self.name = self.name or str(self.path)
        if not 0.0 < self.poll < math.inf:
            raise InputError(f"source {self.name}: poll must be above 0, not {self.poll} s")

    def _begin(self) -> None:
        self._listed()

    def _listed(self) -> list[Path]:
        path = Path(self.path)
        if path.suffix.lower() in IMAGE_SUFFIXES and not path.is_dir():
            return [path]
        return find_images(path)

    def _broken(self, error: FormatError) -> None:
        if not (self.watch if self.skip_broken is None else self.skip_broken):
            raise error
        self.skipped.append(error)

    def _frames(self) -> Iterator[Frame]:
        done: dict[Path, tuple[int, ...]] = {}  # state of each file when it was read or given up
        looks: dict[Path, tuple[tuple[int, ...], int]] = {}  # number of polls since the last change
        needed, patience = (2, self.patience) if self.watch else (1, 0.0)
        while not self.stop.is_set():
            paths: dict[Path, None] = {}
            with suppress(*[InputError] if self.watch else []):  # a watched folder may be missing
                paths = dict.fromkeys(self._listed())
            done = {path: state for path, state in done.items() if path in paths or not paths}
            for path in paths:
                state = _state(path)
                if self.stop.is_set() or (self.watch and state in ((), done.get(path))):
                    continue
                last, times = looks.get(path, (state, 0))
                looks[path] = state, times + 1 if last == state else 1
                if looks[path][1] < needed:
                    continue
                try:
                    frame = self.read(path)
                except FormatError as error:
                    if looks[path][1] * self.poll >= patience:
                        done[path] = looks.pop(path)[0]
                        self._broken(error)
                    continue
                if not self.watch or _state(path) == state:
                    done[path] = looks.pop(path)[0]
                    yield frame
            if not self.watch:
                return
            (self.wait or self.stop.wait)(self.poll)


def _state(path: Path) -> tuple[int, ...]:
    """Return the inode, size and modification time of a file; () if it does not exist."""
    try:
        status = path.stat()
    except OSError:
        return ()
    return status.st_ino, status.st_size, status.st_mtime_ns
