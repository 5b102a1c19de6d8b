"""Read ZIP archives (.npz, .kmz), whose members are checked before they are expanded."""

import io
import math
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FormatError
from heliotrope.files.limits import EXPANDED, MEMBERS, MIB, check_count, check_file

# The record at the end of an archive: 22 bytes and a comment of up to 65,535 bytes.
_TAIL, _END, _END_64 = 22 + 65_535, b"PK\5\6", b"PK\6\7"
#: Longest table of contents, bytes.
_CONTENTS = 512 * MEMBERS
#: Exceptions that `zipfile` raises for a damaged archive; the last two are for unknown versions and
#: encryption.
_DAMAGED = (zipfile.BadZipFile, OSError, ValueError, EOFError, NotImplementedError, RuntimeError)


def read_members(
    path: str | Path, what: str, names: Iterable[str] = (), most: int = EXPANDED
) -> dict[str, bytes]:
    """Return the content of an archive's members.

    Parameters
    ----------
    path
        The archive.
    what
        Expected kind of file, as named in errors.
    names
        Members that the archive must contain; if none are named, all members are read.
    most
        Maximum total size of all members when expanded, bytes.

    Raises
    ------
    FormatError
        As for `check_file`; or if the file is not an archive of the expected kind, lacks a member,
        or exceeds the limits on members or expanded size.
    """
    file = check_file(path, what, binary=True)
    _check_contents(file, what)
    try:
        with zipfile.ZipFile(file) as archive:
            entries = {entry.filename: entry for entry in archive.infolist()}
            check_count(file, len(entries), MEMBERS, "members", f"it should be {what}")
            required = list(names) or list(entries)
            missing = [name for name in required if name not in entries]
            if missing:
                kind = "array" if missing[0].endswith(".npy") else "member"
                short = [name.removesuffix(".npy") for name in (missing[0], *entries)]
                present = ", ".join(short[1:9]) or "nothing"
                raise FormatError(file, f"no {kind} {short[0]!r} in it, only {present:.200}")
            size = sum(entries[name].file_size for name in required)
            if size > most:
                raise FormatError(
                    file,
                    f"{file.stat().st_size / MIB:.3g} MiB expand to {size / MIB:,.0f} MiB, above "
                    f"the limit of {most / MIB:.0f} MiB; expected {what}",
                )
            return {name: _expanded(archive, entries[name]) for name in required}
    except FormatError:
        raise
    except _DAMAGED as error:
        raise FormatError(file, f"not a readable archive ({error}); expected {what}") from None


def _expanded(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    """Return a member, expanded to no more than the size that its entry states."""
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        # The decompressors of these methods cannot limit how much they return at once.
        raise zipfile.BadZipFile(f"{entry.filename}: its compression is neither none nor deflate")
    with archive.open(entry) as stream:
        # `ZipFile.read` would expand everything before it truncates.
        return stream.read(entry.file_size + 1)


def _check_contents(file: Path, what: str) -> None:
    """Reject a table of contents that would itself take much memory."""
    with file.open("rb") as stream:
        stream.seek(-min(_TAIL, file.stat().st_size), io.SEEK_END)
        tail = stream.read()
    place = tail.rfind(_END)
    if place < 0 or len(tail) < place + 22:
        raise FormatError(file, f"not a readable archive; expected {what}")
    size = int.from_bytes(tail[place + 12 : place + 16], "little")
    if size > _CONTENTS or _END_64 in tail[max(0, place - 20) : place]:
        raise FormatError(
            file,
            f"its table of contents exceeds the limit of {_CONTENTS // 1024} KiB; expected {what}",
        )


def read_arrays(
    path: str | Path, what: str, names: Iterable[str] = ()
) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of a file that NumPy wrote (.npz).

    Parameters
    ----------
    path
        The file.
    what
        Expected kind of file, as named in errors.
    names
        Arrays that the file must contain; if none are named, all arrays are read.

    Raises
    ------
    FormatError
        As for `read_members`, or if a member is not an array of numbers or texts.
    """
    members = read_members(path, what, [f"{name}.npy" for name in names])
    arrays = {}
    for member, content in members.items():
        try:
            arrays[member.removesuffix(".npy")] = _array(content)
        except (ValueError, SyntaxError, TypeError, EOFError) as error:
            raise FormatError(
                path, f"not an array written by NumPy ({str(error)[:80]}); expected {what}", member
            ) from None
    return arrays


def _array(content: bytes) -> npt.NDArray[Any]:
    stream = io.BytesIO(content)
    header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(np.lib.format.read_magic(stream))
    if header is None:
        raise ValueError("its version is neither 1.0 nor 2.0")
    shape, _, kind = header(stream)
    size = math.prod(shape) * kind.itemsize
    if kind.hasobject or size != len(content) - stream.tell():
        raise ValueError(f"{len(content) - stream.tell()} bytes for shape {shape} of {kind}")
    stream.seek(0)
    return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))
