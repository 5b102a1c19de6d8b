"""Read whole files with one-line errors, and write files completely or not at all."""

import errno
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from heliotrope.errors import FormatError, InputError
from heliotrope.files.limits import SIZE_LIMIT, check_count, check_file

#: Patterns of a UTF-8 character with several bytes, and of bytes that occur in no text.
_UTF_8 = re.compile(rb"[\xc2-\xdf][\x80-\xbf]|[\xe0-\xef][\x80-\xbf]{2}|[\xf0-\xf4][\x80-\xbf]{3}")
_CONTROLS = re.compile(rb"[\x00-\x08\x0e-\x1f\x7f]")
_FULL = (errno.ENOSPC, errno.EDQUOT)


def read_text(
    path: str | Path, what: str, limit: int = SIZE_LIMIT, *, spreadsheet: bool = False
) -> str:
    """Return the text of a UTF-8 file (with or without a byte-order mark).

    Parameters
    ----------
    path, what, limit
        As for `check_file`.
    spreadsheet
        Whether to also read what spreadsheets export: UTF-16 with a byte-order mark, and
        Windows-1252.

    Raises
    ------
    FormatError
        As for `check_file`, or if the text is in none of these encodings.
    """
    file = check_file(path, what, limit=limit)
    content = read_bytes(file, limit)
    try:
        text = _decoded(content, spreadsheet)
    except UnicodeDecodeError as error:
        name = error.encoding.upper().replace("UTF-8-SIG", "UTF-8")
        raise FormatError(
            file, f"not {name} text ({error.reason}); save it as UTF-8", f"byte {error.start}"
        ) from None
    # "\r\n" and "\r" become "\n", as in a text file that Python opens.
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def _decoded(content: bytes, spreadsheet: bool) -> str:
    if spreadsheet and content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        # A file that is UTF-8 except for a few bytes is damaged.
        if not spreadsheet or _UTF_8.search(content) or _CONTROLS.search(content):
            raise
    return content.decode("cp1252")


def read_bytes(path: str | Path, limit: int = SIZE_LIMIT) -> bytes:
    """Return the content of a file of at most ``limit`` bytes, even if it grows meanwhile.

    Raises
    ------
    FormatError
        If the file exceeds the limit.
    OSError
        If the file cannot be read.
    """
    with Path(path).open("rb") as stream:
        content = stream.read(limit + 1)
    check_count(path, len(content), limit, "bytes", "this is not a file of this kind")
    return content


def write_file(path: str | Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file completely or not at all.

    Parameters
    ----------
    path
        The file; an existing file is replaced atomically.
    write
        Function that is called with the stream and writes the content.

    Raises
    ------
    InputError
        If the folder does not exist or is not writable, or the name is that of a device or a pipe.
    """
    file = Path(path)
    if file.exists() and not (file.is_file() or file.is_dir()):
        # Replacing a device would remove it for every program, and as root even /dev/null.
        raise InputError(f"{file}: this is a device or a pipe, not a file; specify a file")
    beside = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    try:
        with beside.open("wb") as stream:
            write(stream)
            stream.flush()
            os.fsync(stream.fileno())
        beside.replace(file)
    except OSError as error:
        advice = "choose a folder that exists and is writable"
        if error.errno in _FULL:
            advice = "free some space, or choose a folder on another disk"
        raise InputError(f"{file}: cannot be written ({error.strerror}); {advice}") from None
    finally:
        beside.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file as UTF-8, completely or not at all."""
    write_file(path, lambda stream: stream.write(text.encode()))
