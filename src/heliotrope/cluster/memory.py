"""Cluster state that survives a restart: its epoch, and the editions that it has used.

Both numbers only increase. A new file is written beside the old one and renamed, so that a power
failure leaves either the old file or the new one. Editions are reserved in blocks, before they are
needed, so that the edition on disk is never below one that was used.

Only two things wait for the disk, because they must not be used before they are stored: a new
epoch, and an edition beyond those reserved.
"""

import json
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

from heliotrope.errors import FormatError
from heliotrope.files.disk import AtOnce, Disk

_BLOCK = 64
#: A new block of edition numbers is reserved when fewer than this many are left.
_AHEAD = 16
_LARGEST = 0xFFFFFFFF


class Kept:
    """Epoch and edition of a cluster.

    Parameters
    ----------
    path
        Path of the file; if None, nothing is stored, as in simulation.
    epoch, edition
        Last used values, if there is no file.
    disk
        Disk that writes the file once the cluster runs; if None, the file is written at once.

    Attributes
    ----------
    epoch
        Epoch of this run.

    Raises
    ------
    FormatError
        If the file does not contain this state.
    """

    def __init__(
        self, path: Path | None, epoch: int = 0, edition: int = 0, disk: Disk | None = None
    ) -> None:
        self._path, self._disk = path, disk or AtOnce()
        self.epoch, self._edition = epoch, edition
        if path is not None and path.exists():
            self.epoch, self._edition = _read(path)
        self._reserved = self._edition
        #: The values last handed to the disk; no later write may go below them.
        self._handed = (self.epoch, self._reserved)
        self._reserving = False
        self._problem: Exception | None = None

    def start(self, at_least: int) -> int:
        """Return the epoch of a new run, above all earlier epochs and at least ``at_least``.

        The method waits for the disk, and reserves editions in the same write operation.

        Raises
        ------
        OSError
            If the epoch cannot be stored.
        """
        epoch = self._above(at_least)
        self._write(epoch, self._edition + _BLOCK)
        self.epoch, self._reserved = epoch, self._edition + _BLOCK
        return epoch

    def begin(self, at_least: int, then: Callable[[int, Exception | None], None]) -> None:
        """Store an epoch as in `start`.

        When this is done, ``then`` is called with the epoch and None, or with an error.
        """
        epoch = self._above(at_least)

        def stored(error: Exception | None) -> None:
            if error is None:
                self.epoch = epoch
            then(epoch, error)

        self._disk.do(partial(self._write, epoch, 0), stored)

    def next_edition(self, above: int = 0) -> int | None:
        """Return an unused edition above a given edition; None while it is being stored.

        Raises
        ------
        OSError
            If the edition could not be stored; it is then not used, and storing is retried.
        """
        edition = max(self._edition, above) + 1
        if edition + _AHEAD > self._reserved and not self._reserving:
            self._reserve(edition + _BLOCK)
        if edition > self._reserved:
            problem, self._problem = self._problem, None
            if problem is not None:
                raise problem
            return None
        self._edition = edition
        return edition

    def close(self) -> None:
        """Close the disk, which may still finish a write."""
        self._disk.close()

    def _above(self, at_least: int) -> int:
        return max(self.epoch + 1, at_least) & _LARGEST

    def _reserve(self, reserved: int) -> None:
        def stored(error: Exception | None) -> None:
            self._reserving, self._problem = False, error
            if error is None:
                self._reserved = max(self._reserved, reserved)

        self._reserving = True
        self._disk.do(partial(self._write, 0, reserved), stored)

    def _write(self, epoch: int, reserved: int) -> None:
        """Write both numbers, neither below its last written value.

        Only one write runs at a time.
        """
        epoch, reserved = max(epoch, self._handed[0]), max(reserved, self._handed[1])
        if self._path is not None:
            beside = self._path.with_name(self._path.name + ".new")
            beside.unlink(missing_ok=True)
            made = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(made, "w", encoding="utf-8") as file:
                json.dump({"epoch": epoch, "edition": reserved}, file)
                file.flush()
                os.fsync(file.fileno())
            beside.replace(self._path)
        self._handed = (epoch, reserved)


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
                "contains no epoch and edition (0 to 4294967295); restore or delete it while the "
                "time is known, because the epoch is then derived from the time",
            )
    return int(epoch), int(edition)
