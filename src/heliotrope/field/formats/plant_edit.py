"""Edits a plant file by name: the values of one heliostat, target or receiver.

The edited file is checked as a whole before it replaces the old file, which is kept: each stored
version is a folder that contains a plant file and its table, unchanged. Comments, and the cells of
all other heliostats, are preserved.
"""

import getpass
import io
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from heliotrope.errors import FormatError, InputError, UnknownNameError
from heliotrope.field.formats._plant_surfaces import RENAMED, set_surface, surface_values
from heliotrope.field.formats._plant_table import read_columns
from heliotrope.field.formats.plant_file import check_plant, read_plant
from heliotrope.field.heliostats import Heliostats
from heliotrope.files import read_text, write_file, write_text
from heliotrope.files.documents import read_toml

#: Smaller units in which a value may be entered, by the unit of its column, and their size in this
#: unit.
_SMALLER = {"rad": {"mrad": 1e-3, "deg": np.pi / 180.0}, "m": {"mm": 1e-3}}
_TEXTS = ("cluster", "group")
_NOTE = "change.txt"
#: Number of prior standard deviations above which a parameter causes a warning.
_STRANGE = 5.0


@dataclass(frozen=True)
class Change:
    """A changed value: its name, its old and new texts, and its unit."""

    name: str
    old: str
    new: str
    unit: str


@dataclass(frozen=True)
class Edited:
    """A changed plant file.

    Attributes
    ----------
    changes
        The values that changed.
    warnings
        Warnings about the changed file that did not apply to the old file.
    version
        Stored version of the file before the change; empty if nothing was written.
    """

    changes: tuple[Change, ...]
    warnings: tuple[str, ...]
    version: str = ""


@dataclass(frozen=True)
class Version:
    """A stored version of a plant file: its name (time in UTC), and the change that replaced it."""

    name: str
    note: str


def values(path: str | Path, who: str) -> dict[str, str]:
    """Return the settable values of a heliostat, a target or a receiver, by name.

    Raises
    ------
    FormatError
        If the file cannot be used.
    UnknownNameError
        If nothing has this name.
    """
    return _Files(Path(path)).values(who)


def edit(
    path: str | Path,
    who: str,
    changes: Mapping[str, str],
    *,
    note: str = "",
    now: datetime | None = None,
    dry: bool = False,
) -> Edited:
    """Change values of one heliostat, target or receiver, and keep the old file.

    Parameters
    ----------
    path
        Plant file (TOML).
    who
        Name of the heliostat, target or receiver.
    changes
        Texts by the names of `values`; if a name ends in ``_rad`` or ``_m``, an angle may be
        entered in ``_mrad`` or ``_deg``, and a length in ``_mm``.
    note
        Reason, stored with the version.
    now
        The time; default: the system time.
    dry
        Whether to check the change without writing anything.

    Raises
    ------
    FormatError
        If the file, or the changed file, cannot be used.
    InputError
        If values are invalid, or nothing changes.
    """
    files = _Files(Path(path))
    before, surface = files.values(who), who not in files.plant.names
    warned = {finding.text for finding in check_plant(files.place)}
    warnings = files.set(who, changes)
    after = files.values(changes[RENAMED].strip() if surface and RENAMED in changes else who)
    shown = [
        Change(name, before.get(name, ""), after.get(name, ""), _unit(name))
        for name in dict.fromkeys((*before, *after))
        if before.get(name, "") != after.get(name, "")
    ]
    if not shown:
        raise InputError(f"{who}: the values are already in use; nothing was changed")
    with files.trial() as findings:
        new = tuple(text for text in findings if text not in warned)
    if dry:
        return Edited(tuple(shown), (*warnings, *new))
    said = "; ".join(f"{c.name} {c.old or 'none'} -> {c.new or 'none'}" for c in shown)
    version = _keep(files.place, files.table, f"{who}: {said}", note, now)
    files.write(files.place.parent)
    return Edited(tuple(shown), (*warnings, *new), version)


def keep_version(path: str | Path, change: str, *, now: datetime | None = None) -> str:
    """Store the present version of a plant file before another part of the program changes it.

    Returns the name of the version; ``change`` describes the change that replaces it.

    Raises
    ------
    FormatError
        If the file cannot be used.
    """
    files = _Files(Path(path))
    return _keep(files.place, files.table, change, "", now)


def versions(path: str | Path) -> list[Version]:
    """Return the stored versions of a plant file, oldest first."""
    stored = []
    folder = _versions(Path(path))
    for place in sorted(folder.iterdir()) if folder.is_dir() else ():
        if (place / Path(path).name).is_file():
            file = place / _NOTE
            text = read_text(file, "a note") if file.is_file() else ""
            stored.append(Version(place.name, text.strip()))
    return stored


def version_folder(path: str | Path, version: str) -> Path:
    """Return the folder of a stored version, whose name `versions` has returned."""
    return _versions(Path(path)) / version


def restore(path: str | Path, version: str, *, note: str = "", now: datetime | None = None) -> str:
    """Restore a stored version; return the name under which the replaced file was stored.

    Raises
    ------
    FormatError
        If the stored file cannot be used.
    UnknownNameError
        If there is no such version.
    """
    place = Path(path)
    known = [stored.name for stored in versions(place)]
    if version not in known:
        raise UnknownNameError("stored version", version, known)
    old = _Files(_versions(place) / version / place.name)
    # The present file may be unreadable.
    kept = _keep(place, old.table, f"version {version} was restored", note, now)
    _copy(old.place.parent, place.parent, old.table)
    _copy(old.place.parent, place.parent, place.name)
    return kept


def _copy(source: Path, home: Path, part: PurePath | str) -> None:
    content = (source / part).read_bytes()
    (home / part).parent.mkdir(parents=True, exist_ok=True)
    write_file(home / part, lambda stream: stream.write(content))


class _Files:
    """The text of a plant file and the cells of its table, to be changed and written."""

    def __init__(self, place: Path) -> None:
        import pandas as pd
        import tomlkit

        self.plant = read_plant(place)
        self.place = place
        self.text = read_text(place, "a plant file")
        self.document: Any = tomlkit.parse(self.text)
        self.table = PurePath(str(read_toml(place, "a plant file")["heliostats"]))
        if self.table.is_absolute() or ".." in self.table.parts:
            raise FormatError(
                place,
                f"{self.table} is in another folder; keep it beside the plant file",
                "heliostats",
            )
        self.cells: Any = pd.DataFrame(read_columns(place.parent / self.table).columns)

    # -- values ----------------------------------------------------------------------------

    def values(self, who: str) -> dict[str, str]:
        if who in self.plant.names:
            row = self.cells.loc[self._row(who)]
            texts = {str(name): str(row[name]) for name in self.cells.columns if name != "name"}
            return {name: text for name, text in texts.items() if text not in ("", "nan")}
        return surface_values(self._surface(who))

    def _row(self, who: str) -> int:
        return int(np.flatnonzero(self.cells["name"].astype(str) == who)[0])

    def _surface(self, who: str) -> Any:
        tables = [*self.document.get("targets", ()), *self.document.get("receivers", ())]
        for table in tables:
            if table["name"] == who:
                return table
        names = [*(str(table["name"]) for table in tables), *self.plant.names]
        raise UnknownNameError("heliostat, target or receiver", who, names)

    # -- changes ---------------------------------------------------------------------------

    def set(self, who: str, changes: Mapping[str, str]) -> tuple[str, ...]:
        """Set values; return warnings."""
        if who not in self.plant.names:
            said = set_surface(self._surface(who), changes)
            if RENAMED in changes:
                self._rename(who, changes[RENAMED].strip())
            return said
        warnings = []
        for name, text in changes.items():
            column, factor = self._column(who, name)
            if column in _TEXTS:
                self.cells.loc[self._row(who), column] = text.strip()
                continue
            try:
                value = float(text) * factor
            except ValueError:
                raise InputError(f"{who}: {name}={text}: enter a number") from None
            self._fill(who, column)
            cell = value if self.table.suffix == ".parquet" else repr(float(value))
            self.cells.loc[self._row(who), column] = cell
            warnings += self._warnings(who, column, value)
        return tuple(warnings)

    def _column(self, who: str, name: str) -> tuple[str, float]:
        """Return the column that a name refers to, and the conversion factor of its unit."""
        group, _ = self.plant.find(who)
        known = dict.fromkeys((*map(str, self.cells.columns), *_TEXTS, *_parameters(group)))
        known.pop("name")
        for stem, factor in _readings(name):
            for column in (stem, f"parameters.{stem}"):
                if column in known:
                    return column, factor
        raise UnknownNameError(f"value of heliostat {who}", name, known)

    def _fill(self, who: str, column: str) -> None:
        """In a new column, set the nominal value for all other heliostats of the group."""
        group, _ = self.plant.find(who)
        if column not in self.cells.columns:
            self.cells[column] = np.nan if self.table.suffix == ".parquet" else ""
        mine = self.cells["name"].astype(str).isin(group.names)
        empty = self.cells[column].isin(["", "nan"]) | self.cells[column].isna()
        if column.startswith("parameters.") and (empty & mine).any():
            zero = 0.0 if self.table.suffix == ".parquet" else "0.0"
            self.cells.loc[empty & mine, column] = zero

    def _warnings(self, who: str, column: str, value: float) -> list[str]:
        group, _ = self.plant.find(who)
        prior = {name: sigma for name, (sigma, _) in _parameters(group).items()}.get(column)
        if not prior or abs(value) <= _STRANGE * prior:
            return []
        times = f"{value:g} is {abs(value) / prior:.0f} times the usual installation error"
        return [f"{who}: {column} {times} (σ {prior:g}); check the unit"]

    def _rename(self, old: str, new: str) -> None:
        for camera in self.document.get("cameras", ()):
            names = camera.get("targets", [])
            for place, name in enumerate(names):
                if name == old:
                    names[place] = new
        for entry in self.document.get("timetable", ()):
            if entry.get("target") == old:
                entry["target"] = new

    # -- files -----------------------------------------------------------------------------

    @contextmanager
    def trial(self) -> Iterator[list[str]]:
        """Check the changed file as a whole; yield its warnings."""
        with tempfile.TemporaryDirectory(dir=self.place.parent, prefix=".plant-") as folder:
            self.write(Path(folder))
            for name in named_files(self.document, self.place.parent):
                link = Path(folder) / name
                link.parent.mkdir(parents=True, exist_ok=True)
                if not link.exists():
                    link.symlink_to((self.place.parent / name).resolve())
            findings = check_plant(Path(folder) / self.place.name)
        texts = [entry.text.replace(f"{folder}/", f"{self.place.parent}/") for entry in findings]
        for finding, text in zip(findings, texts, strict=True):
            if finding.severity == "error":
                raise InputError(f"{text} (nothing was changed)")
        yield texts

    def write(self, home: Path) -> None:
        """Write the table and then the TOML, so that a reader never sees an incomplete file."""
        import tomlkit

        table = home / self.table
        table.parent.mkdir(parents=True, exist_ok=True)
        if table.suffix == ".parquet":
            write_file(table, lambda stream: self.cells.to_parquet(stream, index=False))
        else:
            text = io.StringIO()
            self.cells.to_csv(text, index=False, lineterminator="\n")
            write_text(table, text.getvalue())
        write_text(home / self.place.name, tomlkit.dumps(self.document))


def named_files(table: Any, home: Path) -> Iterator[PurePath]:
    """Yield the files and folders that a plant file refers to, such as maps and meshes."""
    if isinstance(table, Mapping):
        table = list(table.values())
    if isinstance(table, list):
        for value in table:
            yield from named_files(value, home)
    elif isinstance(table, str) and table.strip("./") and len(table) < 256:
        name = PurePath(str(table))
        if not name.is_absolute() and ".." not in name.parts and (home / name).exists():
            yield name


def _parameters(group: Heliostats) -> dict[str, tuple[float, str]]:
    """Return, for each parameter column of a group, the prior's standard deviation and the unit."""
    known = [group.mechanism.parameter(name) for name in group.mechanism.parameters]
    return {
        f"parameters.{parameter.name}" + ("" if parameter.unit == "1" else f"_{parameter.unit}"): (
            parameter.prior,
            parameter.unit,
        )
        for parameter in known
    }


def _readings(name: str) -> Iterator[tuple[str, float]]:
    """Yield a name unchanged, and then with its smaller unit replaced by the file's unit."""
    yield name, 1.0
    for unit, smaller in _SMALLER.items():
        for short, size in smaller.items():
            if name.endswith(f"_{short}"):
                yield name.removesuffix(short) + unit, size


def _unit(name: str) -> str:
    stem = name.partition(".")[0] if name.startswith(("corners_m", "markers_m")) else name
    unit = stem.rpartition("_")[2]
    return unit if unit in ("m", "deg", "mrad", "rad") else ""


def _versions(path: Path) -> Path:
    return path.with_name(f"{path.stem}.versions")


def keep_files(place: Path, table: PurePath, change: str, now: datetime) -> str:
    """Store a plant file and its table as they are on disk, even if they cannot be used.

    Returns the name of the version; ``change`` describes the change that replaces it.

    Raises
    ------
    OSError
        If a file cannot be written.
    """
    return _keep(place, table, change, "", now)


def _keep(place: Path, table: PurePath, change: str, note: str, now: datetime | None) -> str:
    """Store the files as they are on disk; return the name of the stored version."""
    at = (now or datetime.now(UTC)).astimezone(UTC)
    stem, home = at.strftime("%Y-%m-%dT%H%M%SZ"), _versions(place)
    taken = [version.name for version in home.iterdir()] if home.is_dir() else []
    name = next(n for n in (stem, *(f"{stem}-{k}" for k in range(2, 1000))) if n not in taken)
    for part in (table, place.name):
        if (place.parent / part).is_file():
            _copy(place.parent, home / name, part)
    said = f"until {at:%Y-%m-%d %H:%M:%S} UTC, {_person()}: {change}"
    write_text(home / name / _NOTE, f"{said}{f' ({note})' if note else ''}\n")
    return name


def _person() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "unknown"
