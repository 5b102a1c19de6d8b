"""Limits for files from any origin, and checks that do not need a parser.

Every reader checks size, count, depth and expansion before it uses memory for a file. Within these
limits no reader takes more than 1.5 GB or a minute. If a file exceeds a limit, a one-line error
states the file, the value, the limit and what to do.
"""

import os
import re
import stat
from collections.abc import Iterable
from pathlib import Path

from heliotrope.errors import FormatError
from heliotrope.files.kinds import foreign, instead

MIB = 2**20
#: Largest file that is read, bytes; a layout of 400,000 heliostats has 60 MB.
SIZE_LIMIT = 64 * MIB
#: Largest TOML file, bytes; its parser takes 200 bytes of memory for each byte.
TOML_SIZE = 2 * MIB
#: Maximum nesting depth of an XML, JSON or TOML document.
DEPTH = 64
#: Maximum number of parts in a dotted TOML key; the parser's time and memory grow with the square
#: of this number.
DOTTED_PARTS = 16
#: Maximum number of elements and attributes in an XML document.
XML_PARTS = 3_000_000
#: Longest XML tag with its attributes, bytes.
XML_TAG = MIB
#: Maximum number of values in a JSON document, counted by commas and brackets.
JSON_VALUES = 2_000_000
#: Maximum numbers of rows, columns and cells in a CSV table.
ROWS, COLUMNS, CELLS = 1_000_000, 1_000, 10_000_000
#: Maximum size of a Parquet file, maximum size once expanded, bytes, and maximum number of cells.
PARQUET_SIZE, PARQUET_EXPANDED, PARQUET_CELLS = 256 * MIB, 512 * MIB, 50_000_000
#: Largest expanded size of an archive's members (.npz, .kmz), bytes, and maximum number of members.
EXPANDED, MEMBERS = 256 * MIB, 256
#: Maximum number of pixels in an image from a target camera, and from a drone.
PIXELS, PHOTOGRAPH_PIXELS = 64_000_000, 160_000_000
#: Maximum number of entries in an image folder.
ENTRIES = 1_000_000


_JSON_TOKEN = re.compile(r'"[^"\\]*+(?:\\.[^"\\]*+)*+"|(?P<bracket>[\[\]{}])', re.DOTALL)
_PART = r'(?:"[^"\\\n]*+(?:\\.[^"\\\n]*+)*+"|' + r"'[^'\n]*+'|[\w+-]++)"
# Brackets and dots inside strings and comments are text.
_TOML_TOKEN = re.compile(
    r'"""[^"\\]*+(?:(?:\\.|"(?!""))[^"\\]*+)*+"{3,5}'
    r"|\'\'\'[^']*+(?:'(?!'')[^']*+)*+'{3,5}"
    rf"|(?P<key>{_PART}(?:[ \t]*+\.[ \t]*+{_PART})*+)"
    r"|\#[^\n]*+|(?P<bracket>[\[\]{}])",
    re.DOTALL,
)


def check_file(
    path: str | Path, what: str, *, binary: bool = False, limit: int = SIZE_LIMIT
) -> Path:
    """Return the path if it is a readable file of a plausible size.

    Parameters
    ----------
    path
        The file.
    what
        Expected kind of file, as named in errors ("a HelioK file").
    binary
        Whether to accept files that do not begin like text.
    limit
        Maximum size, bytes.

    Raises
    ------
    FormatError
        If the file does not exist, is a folder, a device or a pipe, cannot be read, is empty,
        belongs to another program, exceeds the size limit or does not begin like text.
    """
    file = Path(path)
    try:
        # Opening a pipe without a writer would block for ever.
        handle = os.open(file, os.O_RDONLY | os.O_NONBLOCK)
        with os.fdopen(handle, "rb") as stream:
            state = os.fstat(handle)
            if stat.S_ISDIR(state.st_mode):
                raise IsADirectoryError
            if not stat.S_ISREG(state.st_mode):
                raise FormatError(file, f"this is a device or a pipe; specify a file: {what}")
            start = stream.read(4096)
    except FileNotFoundError:
        raise FormatError(file, f"no such file; specify the path of {what}") from None
    except IsADirectoryError:
        raise FormatError(file, f"this is a folder; specify the path of {what}") from None
    except OSError as error:
        raise FormatError(file, f"cannot be read ({error.strerror}); expected {what}") from None
    if not start:
        raise FormatError(file, f"the file is empty; expected {what}")
    if text := foreign(file, start):
        raise FormatError(file, text)
    if state.st_size > limit:
        raise FormatError(
            file,
            f"{_mib(state.st_size)} MiB exceed the limit of {_mib(limit)} MiB; this is not {what}",
        )
    if not binary and b"\0" in start and not start.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise FormatError(file, instead(start, what) or f"the file is binary; expected {what}")
    return file


def _mib(size: int) -> str:
    return f"{size / MIB:.3g}" if size < 10 * MIB else f"{size / MIB:.0f}"


def check_count(
    path: str | Path, count: int, limit: int, name: str, advice: str, where: str = ""
) -> None:
    """Raise FormatError if a file has more items of some kind than the limit.

    Parameters
    ----------
    path
        The file.
    count, limit
        Number of items in the file, and maximum number accepted.
    name
        Name of what is counted, in the plural.
    advice
        What to do, for the message.
    where
        Place in the file, for the message.
    """
    if count > limit:
        raise FormatError(path, f"{count:,} {name} exceed the limit of {limit:,}; {advice}", where)


def check_json(path: str | Path, text: str) -> None:
    """Check the number and the depth of the values of a JSON document before it is parsed.

    Raises
    ------
    FormatError
        If the document has more values or levels than the limits.
    """
    brackets = text.count("[") + text.count("{")
    check_count(path, text.count(",") + brackets, JSON_VALUES, "values", "divide the file")
    if brackets > DEPTH:
        _check_depth(path, text, _JSON_TOKEN.finditer(text))


def check_toml(path: str | Path, text: str) -> None:
    """Check the depth and the dotted keys of a TOML document before it is parsed.

    Raises
    ------
    FormatError
        If the document has more levels, or a key has more parts, than the limits.
    """
    if text.count("[") + text.count("{") > DEPTH:
        _check_depth(path, text, _TOML_TOKEN.finditer(text))
    if text.count(".") >= DOTTED_PARTS:
        for token in _TOML_TOKEN.finditer(text):
            if token.lastgroup == "key" and token.group().count(".") >= DOTTED_PARTS:
                parts = len(re.findall(_PART, token.group()))
                advice = "use tables of their own"
                where = _line(text, token.start())
                check_count(path, parts, DOTTED_PARTS, "parts of a dotted key", advice, where)


def _check_depth(path: str | Path, text: str, tokens: Iterable["re.Match[str]"]) -> None:
    depth = 0
    for token in tokens:
        if token.lastgroup == "bracket":
            depth += 1 if token.group() in "[{" else -1
            if depth > DEPTH:
                where = _line(text, token.start())
                raise FormatError(
                    path,
                    (f"nested too deeply: more than {DEPTH} levels; flatten the structure"),
                    where,
                )


def _line(text: str, place: int) -> str:
    return f"line {text.count(chr(10), 0, place) + 1}"


def check_entries(folder: Path, entries: Iterable[Path]) -> Iterable[Path]:
    """Yield the entries of a folder; raise FormatError if there are more than the limit."""
    for number, entry in enumerate(entries, 1):
        check_count(folder, number, ENTRIES, "files", "divide the folder")
        yield entry
