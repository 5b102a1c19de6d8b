"""Whole files, read with one-line refusals and written whole or not at all."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from heliotrope.errors import FormatError, InputError

#: Largest file that is read, bytes: a layout of 400,000 heliostats is 60 MB.
SIZE_LIMIT = 64 * 2**20


def check_file(path: str | Path, what: str, *, binary: bool = False) -> Path:
    """Return the path if it is a readable file of a plausible size.

    Parameters
    ----------
    path
        The file.
    what
        Kind of file expected, as an error names it ("a HelioK file").
    binary
        Accept files that do not begin like text.

    Raises
    ------
    FormatError
        If it does not exist, is a folder, cannot be read, is empty, is larger than
        64 MiB or does not begin like text.
    """
    file = Path(path)
    try:
        size = file.stat().st_size
        with file.open("rb") as stream:
            start = stream.read(4096)
    except FileNotFoundError:
        raise FormatError(file, f"there is no such file; give the path of {what}") from None
    except IsADirectoryError:
        raise FormatError(file, f"this is a folder; give the path of {what}") from None
    except OSError as error:
        raise FormatError(file, f"cannot be read ({error.strerror}); it should be {what}") from None
    if not start:
        raise FormatError(file, f"the file is empty; it should be {what}")
    if size > SIZE_LIMIT:
        raise FormatError(
            file,
            f"{size / 2**20:.0f} MiB exceed the limit of {SIZE_LIMIT / 2**20:.0f} MiB; "
            f"this is not {what}",
        )
    if not binary and b"\0" in start and not start.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise FormatError(file, f"the file is binary; it should be {what}")
    return file


def read_text(path: str | Path, what: str) -> str:
    """Return the text of a UTF-8 file (with or without a byte-order mark).

    Raises
    ------
    FormatError
        As `check_file`, or if it is not UTF-8.
    """
    file = check_file(path, what)
    try:
        return file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise FormatError(
            file, f"not UTF-8 text ({error.reason}); save it as UTF-8", f"byte {error.start}"
        ) from None


def write_file(path: str | Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file so that it is there whole or not at all.

    Parameters
    ----------
    path
        The file; an existing one is replaced in one step.
    write
        Called with the stream; writes the content to it.

    Raises
    ------
    InputError
        If the folder does not exist or is not writable.
    """
    file = Path(path)
    beside = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    try:
        with beside.open("wb") as stream:
            write(stream)
            stream.flush()
            os.fsync(stream.fileno())
        beside.replace(file)
    except OSError as error:
        raise InputError(
            f"{file}: cannot be written ({error.strerror}); give a folder that exists and may be "
            "written to"
        ) from None
    finally:
        beside.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file as UTF-8 so that it is there whole or not at all."""
    write_file(path, lambda stream: stream.write(text.encode()))
