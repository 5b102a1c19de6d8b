"""Whole files, read with one-line refusals and written whole or not at all."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from heliotrope.errors import FormatError, InputError
from heliotrope.files.limits import SIZE_LIMIT, check_count, check_file


def read_text(path: str | Path, what: str, limit: int = SIZE_LIMIT) -> str:
    """Return the text of a UTF-8 file (with or without a byte-order mark).

    Raises
    ------
    FormatError
        As `check_file`, or if it is not UTF-8.
    """
    file = check_file(path, what, limit=limit)
    try:
        # "\r\n" and "\r" become "\n", as in a text file that Python opens.
        text = read_bytes(file, limit).decode("utf-8-sig")
        return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text
    except UnicodeDecodeError as error:
        raise FormatError(
            file, f"not UTF-8 text ({error.reason}); save it as UTF-8", f"byte {error.start}"
        ) from None


def read_bytes(path: str | Path, limit: int = SIZE_LIMIT) -> bytes:
    """Return the content of a file that has no more than ``limit`` bytes, now and in the end.

    Raises
    ------
    FormatError
        If it has more.
    OSError
        If it cannot be read.
    """
    with Path(path).open("rb") as stream:
        content = stream.read(limit + 1)
    check_count(path, len(content), limit, "bytes", "it is no file of this kind")
    return content


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
