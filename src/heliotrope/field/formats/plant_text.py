"""The text of a plant file as somebody edits it: checked as a whole, compared, and stored.

`try_text` checks a text in the place of a plant file, without writing anything beside that file.
`store_text` replaces the file and keeps the old one, as `plant_edit` does.
"""

import difflib
import hashlib
import re
import tempfile
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path, PurePath
from typing import Any, Literal

from heliotrope.errors import FormatError
from heliotrope.field.camera import Camera
from heliotrope.field.formats.plant_edit import keep_files, named_files
from heliotrope.field.formats.plant_file import examine_plant
from heliotrope.field.target import Target
from heliotrope.files import read_text, write_text
from heliotrope.files.documents import read_toml
from heliotrope.files.limits import TOML_SIZE

#: Files that a new text may name beside the plant file: tables, meshes, maps and pictures. Keys and
#: configurations may lie there too, and an error message would quote them.
_BESIDE = frozenset(
    (".csv", ".parquet", ".obj", ".stl", ".npy", ".npz", ".h5", ".hdf5")
    + (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
)
#: Tables of objects with names, and tables of tables.
_NAMED = ("targets", "receivers", "cameras", "keep_out", "timetable")
_KEYED = ("groups", "safety", "eyes_m")
#: Longest comparison, lines of a text and of the result.
_MOST_LINES, _MOST_SHOWN = 5000, 400
_HEADER = re.compile(r"""\s*(\[\[?)\s*((?:[\w-]+|"[^"]*"|'[^']*'|\s*\.\s*)+)\s*\]""")
_KEY = re.compile(r"""\s*((?:[\w-]+|"[^"]*"|'[^']*'|\s*\.\s*)+?)\s*=""")
_PART = re.compile(r"""[\w-]+|"[^"]*"|'[^']*'""")
_AT_LINE = re.compile(r"\(at line (\d+)")


@dataclass(frozen=True)
class TextFinding:
    """An error or a warning about a text, and its line (0: none is known)."""

    severity: Literal["error", "warning"]
    text: str
    line: int = 0


@dataclass(frozen=True)
class Difference:
    """A table in which two plant files differ.

    Attributes
    ----------
    table
        Name of the table, such as ``cameras``.
    name
        Name of the object in the table; empty if its objects have no names.
    how
        "changed", "new" or "removed".
    keys
        Keys that differ, if the object is changed.
    """

    table: str
    name: str
    how: Literal["changed", "new", "removed"]
    keys: tuple[str, ...] = ()


@dataclass(frozen=True)
class TriedText:
    """The result of `try_text`.

    Attributes
    ----------
    findings
        Errors and warnings.
    difference
        Lines of a unified difference from the present file to the text.
    differs
        Tables that differ from the text in use.
    cameras, targets
        Cameras and targets of the plant that the text describes; () if there are errors.
    """

    findings: tuple[TextFinding, ...]
    difference: tuple[str, ...]
    differs: tuple[Difference, ...]
    cameras: tuple[Camera, ...] = ()
    targets: tuple[Target, ...] = ()

    @property
    def error(self) -> TextFinding | None:
        """The first error."""
        return next((finding for finding in self.findings if finding.severity == "error"), None)


def plant_text(path: str | Path) -> str:
    """Return the text of a plant file, with line feeds only.

    Raises
    ------
    FormatError
        If the file cannot be read.
    """
    return _unix(read_text(path, "a plant file", TOML_SIZE))


def text_version(text: str) -> str:
    """Return a short name of a text, which differs for different texts."""
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def try_text(path: str | Path, text: str, used: str) -> TriedText:
    """Check a text in the place of a plant file, as `heliotrope field check` would check the file.

    Parameters
    ----------
    path
        The plant file; nothing is written there or beside it.
    text
        The text to be checked.
    used
        The text in use, with which its tables are compared.
    """
    place, text = Path(path), _unix(text)
    present = plant_text(place) if place.is_file() else ""
    difference = _difference(present, text)
    with tempfile.TemporaryDirectory(prefix="heliotrope-plant-") as folder:
        trial = Path(folder) / place.name
        write_text(trial, text)
        try:
            document = read_toml(trial, "a plant file")
        except FormatError as error:
            line = _AT_LINE.search(error.problem)
            result = TextFinding("error", error.problem, int(line[1]) if line else 0)
            return TriedText((result,), difference, ())
        allowed = set(_strings(_document(present))) | set(_strings(_document(used)))
        outside = tuple(_outside(document, allowed, text))
        if outside:
            return TriedText(outside, difference, ())
        _link(document, place.parent, Path(folder), allowed)
        findings, plant = examine_plant(trial)
        said = tuple(
            TextFinding(
                item.severity,
                item.text.replace(f"{trial}: ", "").replace(f"{folder}/", ""),
                line_of(text, item.where),
            )
            for item in findings
        )
    cameras, targets = ((), ()) if plant is None else (plant.cameras, plant.targets)
    return TriedText(said, difference, differing(_document(used), document), cameras, targets)


def store_text(path: str | Path, text: str, change: str, *, now: datetime) -> str:
    """Replace a plant file by a text that `try_text` has accepted; keep the old file.

    Returns the name of the stored version; ``change`` is its note. The old file is stored before
    the new one is written under another name and renamed, so that there is a whole file at any
    time.

    Raises
    ------
    OSError, InputError
        If a file cannot be written; the plant file is then as it was.
    """
    place, text = Path(path), _unix(text)
    kept = keep_files(place, PurePath(str(tomllib.loads(text)["heliostats"])), change, now)
    write_text(place, text)
    return kept


def _unix(text: str) -> str:
    return text.replace("\r\n", "\n")


def _document(text: str) -> dict[str, Any]:
    """Return the content of a text; a text that is not TOML has none."""
    try:
        return tomllib.loads(text)
    except ValueError:
        return {}


# -- files beside the plant file -----------------------------------------------------------------


def _strings(value: Any) -> Iterator[str]:
    """Yield all texts in a document but the sources of cameras, which are addresses."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            if key != "source":
                yield from _strings(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _strings(inner)
    elif isinstance(value, str):
        yield value


def _outside(document: Mapping[str, Any], allowed: set[str], text: str) -> Iterator[TextFinding]:
    """Yield an error for each new name of a file that is not beside the plant file."""
    for name in _strings(document):
        part = PurePath(name)
        away = part.is_absolute() or ".." in part.parts
        if away and (name not in allowed or name == document.get("heliostats")):
            line = next((n for n, row in enumerate(text.split("\n"), 1) if name in row), 0)
            said = f"{name[:100]} is in another folder; keep the file beside the plant file"
            yield TextFinding("error", said, line)


def _link(document: Any, home: Path, trial: Path, allowed: set[str]) -> None:
    """Link the files that a document names into the folder of the trial."""
    for name in named_files(document, home):
        if name.suffix.lower() not in _BESIDE and str(name) not in allowed:
            continue
        link = trial / name
        link.parent.mkdir(parents=True, exist_ok=True)
        if not link.exists():
            link.symlink_to((home / name).resolve())


# -- differences ---------------------------------------------------------------------------------


def _difference(old: str, new: str) -> tuple[str, ...]:
    before, after = old.splitlines(), new.splitlines()
    if max(len(before), len(after)) > _MOST_LINES:
        return (f"the file has more than {_MOST_LINES:,} lines, which are not compared",)
    lines = list(difflib.unified_diff(before, after, n=1, lineterm=""))[2:]
    more = [f"… and {len(lines) - _MOST_SHOWN:,} more lines"] if len(lines) > _MOST_SHOWN else []
    return (*lines[:_MOST_SHOWN], *more)


def differing(old: Mapping[str, Any], new: Mapping[str, Any]) -> tuple[Difference, ...]:
    """Return the tables in which two documents of plant files differ."""
    result: list[Difference] = []
    for table in dict.fromkeys((*old, *new)):
        before, after = old.get(table), new.get(table)
        if before != after:
            parts = _parts(table, before), _parts(table, after)
            inner = [] if None in parts else list(_compared(table, *map(dict, parts)))  # type: ignore[arg-type]
            result += inner or [_one(table, "", before, after)]
    return tuple(result)


def _parts(table: str, value: Any) -> dict[str, Any] | None:
    """Return the objects of a table by name; None if it has no names, or a name twice."""
    if value is None and table in (*_NAMED, *_KEYED):
        return {}
    if table in _KEYED and isinstance(value, dict):
        return value
    if table not in _NAMED or not isinstance(value, list):
        return None
    named = {str(item.get("name")): item for item in value if isinstance(item, dict)}
    return named if len(named) == len(value) else None


def _compared(
    table: str, before: Mapping[str, Any], after: Mapping[str, Any]
) -> Iterator[Difference]:
    for name in dict.fromkeys((*before, *after)):
        if before.get(name) != after.get(name):
            yield _one(table, name, before.get(name), after.get(name))


def _one(table: str, name: str, before: Any, after: Any) -> Difference:
    if before is None:
        return Difference(table, name, "new")
    if after is None:
        return Difference(table, name, "removed")
    keys: tuple[str, ...] = ()
    if isinstance(before, dict) and isinstance(after, dict):
        keys = tuple(k for k in dict.fromkeys((*before, *after)) if before.get(k) != after.get(k))
    return Difference(table, name, "changed", keys)


# -- lines ---------------------------------------------------------------------------------------


def line_of(text: str, where: str) -> int:
    """Return the line of a place such as ``targets[0].width_m`` in a TOML text; 0: unknown.

    If a key has no line of its own, it is the line of the innermost table that contains it.
    """
    desired = re.findall(r"[^.\[\]]+", where)
    best, line = 0, 0
    table: list[str] = []
    counts: dict[tuple[str, ...], int] = {}
    for number, row in enumerate(text.split("\n"), 1):
        if header := _HEADER.match(row):
            result = table = _numbered(_keys(header[2]), header[1] == "[[", counts)
        elif key := _KEY.match(row):
            result = [*table, *_keys(key[1])]
        else:
            continue
        if len(result) > best and desired[: len(result)] == result:
            best, line = len(result), number
    return line


def _keys(dotted: str) -> list[str]:
    return [part.strip("\"'") for part in _PART.findall(dotted)]


def _numbered(parts: list[str], many: bool, counts: dict[tuple[str, ...], int]) -> list[str]:
    """Return the path of a table, with the numbers of the tables in arrays."""
    result: list[str] = []
    for k, part in enumerate(parts):
        result.append(part)
        key = tuple(result)
        if many and k == len(parts) - 1:
            counts[key] = counts.get(key, -1) + 1
        if key in counts:
            result.append(str(counts[key]))
    return result
