"""State of a cluster that outlasts a restart: its epoch, and the editions it has used.

Both only rise. The file is written beside the old one and renamed, so that a power cut leaves
the old file or the new one. Editions are reserved in blocks: the edition on disk is never below
one that was used.
"""

import json
import os
from pathlib import Path

from heliotrope.errors import FormatError

_BLOCK = 64
_LARGEST = 0xFFFFFFFF


class Kept:
    """Epoch and edition of a cluster.

    Parameters
    ----------
    path
        The file; None: nothing is stored, for simulation.
    epoch, edition
        Last values used, if there is no file.

    Attributes
    ----------
    epoch
        Of this run.

    Raises
    ------
    FormatError
        If the file has other content.
    """

    def __init__(self, path: Path | None, epoch: int = 0, edition: int = 0) -> None:
        self._path = path
        self.epoch, self._edition = epoch, edition
        if path is not None and path.exists():
            self.epoch, self._edition = _read(path)
        self._reserved = self._edition

    def start(self, at_least: int) -> int:
        """Return the epoch of a new run, above all earlier ones and not below ``at_least``.

        Raises
        ------
        OSError
            If it cannot be stored.
        """
        epoch = max(self.epoch + 1, at_least) & _LARGEST
        self._write(epoch, self._reserved)
        self.epoch = epoch
        return epoch

    def next_edition(self, above: int = 0) -> int:
        """Return an edition that was never used, above another one.

        Raises
        ------
        OSError
            If it cannot be stored; it is then not used either.
        """
        edition = max(self._edition, above) + 1
        if edition > self._reserved:
            self._write(self.epoch, edition + _BLOCK)
            self._reserved = edition + _BLOCK
        self._edition = edition
        return edition

    def _write(self, epoch: int, reserved: int) -> None:
        if self._path is None:
            return
        beside = self._path.with_name(self._path.name + ".new")
        with beside.open("w", encoding="utf-8") as file:
            json.dump({"epoch": epoch, "edition": reserved}, file)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(self._path)


def _read(path: Path) -> tuple[int, int]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        epoch, edition = document["epoch"], document["edition"]
    except (ValueError, KeyError, TypeError):
        epoch = edition = None
    for value in (epoch, edition):
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= _LARGEST:
            raise FormatError(
                path,
                "holds no epoch and edition (0 to 4294967295); restore or remove it while "
                "the time is known: the epoch then comes from the time",
            )
    return int(epoch), int(edition)
