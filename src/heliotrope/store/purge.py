"""Removes everything that a plant stores, before its computer is decommissioned.

Files are overwritten once before they are removed. Overwriting alone is no guarantee, because flash
memory and copy-on-write file systems keep old blocks; therefore encrypt the disk, or destroy it.
"""

import os
import stat
from pathlib import Path

from heliotrope.store.database import FILE, MADE, Database
from heliotrope.store.factors import KEY_FILE
from heliotrope.store.records import StoreError

_BLOCK = 1 << 20


def purge(folder: Path) -> tuple[int, list[Path]]:
    """Overwrite and remove what plants created in a data folder, including keys and passwords.

    Parameters
    ----------
    folder
        Data folder; no plant may run in it.

    Returns
    -------
    The number of removed files, and the files left in the folder because no plant created them.

    Raises
    ------
    StoreError
        If there is no store, a plant writes to it, or a file cannot be removed.
    """
    with Database(folder) as database:
        if not database.revision():
            database.require()
        database.lock()
        made = [*folder.glob(f"{Path(FILE).stem}*"), *(folder / n for n in (*MADE, KEY_FILE))]
        try:
            count = sum(_remove(path) for path in made)
        except OSError as error:
            raise StoreError(f"{error.filename or folder}: {error.strerror}") from None
    return count, sorted(folder.iterdir())


def _remove(path: Path) -> int:
    """Overwrite and remove a file or folder without following links; return the number of files."""
    try:
        status = path.lstat()
    except FileNotFoundError:
        return 0
    if stat.S_ISDIR(status.st_mode):
        count = sum(_remove(inside) for inside in path.iterdir())
        path.rmdir()
        return count
    if stat.S_ISREG(status.st_mode) and status.st_nlink == 1:
        _overwrite(path, status.st_size)
    path.unlink()
    return 1


def _overwrite(path: Path, size: int) -> None:
    handle = os.open(path, os.O_WRONLY | os.O_NOFOLLOW)
    try:
        for place in range(0, size, _BLOCK):
            os.write(handle, bytes(min(_BLOCK, size - place)))
        os.fsync(handle)
    finally:
        os.close(handle)
