"""Assigned aims and standby points of heliostats, preserved across restarts of the plant.

A plant that does not know where its beams are cannot check where they may go. Points are therefore
stored on disk before the commands that assign them are sent. They count as assigned when they are
sent; a point whose command is still queued, and may be dropped from the queue, is not yet assigned.

`Assigned` is the protocol of the store. `AssignedFile` is one small file, written under a temporary
name and renamed, so that either the old or the new file always exists.

A local controller may refuse a point, or never receive it. The previous points are therefore kept
until the new point is acknowledged, so that a restarted program knows where a beam may still be.

What visits hold (`HELD`), such as locks, is stored with the points, also before a visit takes it; a
restarted program releases it (`giving_back`).
"""

import json
import math
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Protocol

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FormatError, HeliotropeError, InputError
from heliotrope.files.disk import Work
from heliotrope.geometry import FloatArray, as_vectors
from heliotrope.lcu import messages
from heliotrope.lcu.config import FAR

#: Points of one kind (AIM, STANDBY) by name of the heliostat, ENU, m.
Places = dict[str, tuple[float, ...]]
KINDS = tuple(sorted(messages.POINTS))
#: Number of points before the assigned one that a local controller may still be using.
BEFORE = 4
#: Kinds under which these earlier points are stored, latest first.
EARLIER = {kind: tuple(f"{kind}-{i}" for i in range(1, BEFORE + 1)) for kind in KINDS}
#: What visits hold, by kind: when they locked a heliostat (POSIX s, then zeros), the aim to which
#: its beam returns (ENU, m), and that it must return to rough steps when no visit needs it (zeros).
HELD = ("LOCKED", "LENT", "ROUGH")
#: A record of something that no visit holds is removed after this time, s. Until then, the command
#: that takes it may be on its way.
_TAKEN_WITHIN = 5.0
VERSION = 1

Rows = npt.NDArray[np.intp]
#: Points by kind and heliostat; None: the point no longer exists.
Held = Mapping[str, Mapping[str, tuple[float, ...] | None]]
NOTHING: Held = MappingProxyType({})


class AssignedError(HeliotropeError):
    """Points could not be stored."""


class Assigned(Protocol):
    """A store of assigned points."""

    def read(self) -> dict[str, Places]:
        """Return the stored points, by kind; an empty mapping if there are none."""
        ...

    def keep(self, points: Mapping[str, Places]) -> None:
        """Replace the stored points; the new points are on disk when this returns."""
        ...


class AssignedFile:
    """Points in one file.

    Parameters
    ----------
    path
        The file, created at the first assignment.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def read(self) -> dict[str, Places]:
        """Return the stored points.

        Raises
        ------
        FormatError
            If the file does not contain points.
        """
        try:
            document = json.loads(self.path.read_bytes())
        except FileNotFoundError:
            return {}
        except ValueError:
            raise FormatError(
                self.path,
                "the file contains no assigned points; delete it, then assign the aims again",
            ) from None
        if not isinstance(document, dict) or document.get("version") != VERSION:
            raise FormatError(
                self.path,
                f"the file is not an assigned-points file of version {VERSION}; delete it",
            )
        others = (*(kind for kinds in EARLIER.values() for kind in kinds), *HELD)
        found = (*KINDS, *(kind for kind in others if kind in document))
        return {kind: self._places(kind, document.get(kind)) for kind in found}

    def _places(self, kind: str, rows: object) -> Places:
        if not isinstance(rows, dict):
            raise FormatError(
                self.path,
                f"{kind}: the points are not listed by heliostat name; delete the file, "
                f"then assign the aims again",
            )
        for name, point in rows.items():
            good = isinstance(point, list) and len(point) == 3
            if not good or not all(isinstance(x, float) and math.isfinite(x) for x in point):
                raise FormatError(
                    self.path, f"{kind} of {name}: {point!r} is not a point in ENU coordinates (m)"
                )
        return {name: tuple(point) for name, point in rows.items()}

    def keep(self, points: Mapping[str, Places]) -> None:
        """Replace the stored points.

        Raises
        ------
        AssignedError
            If they could not be written and synced; the earlier points remain stored.
        """
        data = json.dumps({"version": VERSION, **points}, allow_nan=False).encode()
        beside = self.path.with_name(self.path.name + ".new")
        try:
            with beside.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            beside.replace(self.path)
            folder = os.open(self.path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
        except OSError as error:
            raise AssignedError(
                f"assigned points {self.path}: {error.strerror}; check the disk"
            ) from None


class Points:
    """Assigned points of N heliostats, and their store.

    Parameters
    ----------
    names
        Names of the heliostats.
    store
        Store of the points; None: the points are lost when the plant's program ends.

    Attributes
    ----------
    aims, standbys
        Assigned points, ENU, m, (N, 3); NaN if there is none.
    earlier
        By kind, the earlier points that a local controller may still have, latest first, (`BEFORE`,
        N, 3); NaN once the assigned point was acknowledged.
    held
        What visits held when the last program ended, by kind (`HELD`) and heliostat.
    """

    def __init__(self, names: Sequence[str], store: Assigned | None) -> None:
        self.aims, self.standbys = (np.full((len(names), 3), np.nan) for _ in KINDS)
        self.earlier = {kind: np.full((BEFORE, len(names), 3), np.nan) for kind in KINDS}
        self._names, self._store = names, store
        self._arrays = {"AIM": self.aims, "STANDBY": self.standbys}
        every = self._arrays | {
            name: self.earlier[kind][i] for kind in KINDS for i, name in enumerate(EARLIER[kind])
        }
        #: The points in the store; only disk work changes them.
        self._stored: dict[str, Places] = {kind: {} for kind in (*every, *HELD)}
        #: Since when a record of `HELD` has been without effect, monotonic s.
        self._idle: dict[tuple[str, str], float] = {}
        #: Points acknowledged since the store was last updated, by kind, each with its mark.
        self._taken: dict[str, dict[str, tuple[tuple[float, ...], object]]]
        self._taken = {kind: {} for kind in KINDS}
        #: The last write of the assigned point, by kind, because the same point may be assigned
        #: twice.
        self._marks: dict[str, dict[str, object]] = {kind: {} for kind in KINDS}
        index = {name: row for row, name in enumerate(names)}
        for kind, places in ({} if store is None else store.read()).items():
            for name, point in places.items():
                if name in index:
                    self._stored[kind][name] = point
                    if kind in every:
                        every[kind][index[name]] = point
        self.held = {kind: dict(self._stored[kind]) for kind in HELD}

    def assign(self, kind: str, rows: npt.NDArray[np.intp], points: FloatArray) -> None:
        """Assign points (K, 3) to heliostats (K,). The points must also be stored (`storing`)."""
        known = self._arrays[kind]
        changed = np.asarray(rows)[differ(known[rows], points)]
        put_before(self.earlier[kind], changed, known[changed])
        known[rows] = points

    def taken(self, kind: str, rows: npt.NDArray[np.intp]) -> None:
        """Record that local controllers have acknowledged their assigned points; see `settling`."""
        self.earlier[kind][:, rows] = np.nan
        marks = self._marks[kind]
        for row, place in zip(rows, self._arrays[kind][rows].tolist(), strict=True):
            name = self._names[row]
            self._taken[kind][name] = tuple(place), marks.get(name)

    def unknown(self, kind: str, rows: slice = slice(None)) -> npt.NDArray[np.bool_]:
        """Return a mask of the local controllers whose point is unknown, for all (N,) or some (K,).

        Such a controller has not acknowledged its assigned point, and no earlier point is known,
        because the assigned point was the first or the store is a restored backup.
        """
        return np.asarray((self.earlier[kind][0, rows] == self._arrays[kind][rows]).all(axis=-1))

    def possible(self, kind: str, rows: npt.NDArray[np.intp]) -> list[tuple[Rows, FloatArray]]:
        """Return the points to which local controllers (K,) may send their beams.

        The first entry holds the assigned points; the next entries hold the earlier points, for the
        heliostats that may still have them.
        """
        choices = []
        for points in (self._arrays[kind], *self.earlier[kind]):
            known = rows[np.isfinite(points[rows]).all(axis=-1)]
            if known.size:
                choices.append((known, points[known]))
        return choices

    def storing(
        self, kind: str, rows: npt.NDArray[np.intp], points: FloatArray, held: Held = NOTHING
    ) -> tuple[Work, Callable[..., None]]:
        """Return disk work that stores points (K, 3) of heliostats (K,), and its reversal.

        ``held`` is stored in the same write; see `holding`. Both pieces of work raise
        `AssignedError` if storing fails. The reversal does not touch points that have since been
        replaced. It may be repeated, and accepts the heliostats to revert, by default all of them.
        """
        new = {self._names[i]: tuple(p) for i, p in zip(rows, points.tolist(), strict=True)}
        present = self._arrays[kind][rows]
        known = np.isfinite(present).all(axis=-1)
        # If no point is stored: the point in the local controllers, or the new, unacknowledged
        # point.
        first = np.where(known[:, None], present, points).tolist()
        before = {self._names[i]: tuple(p) for i, p in zip(rows, first, strict=True)}
        kinds, mark = (kind, *EARLIER[kind]), object()
        old: dict[str, list[tuple[float, ...] | None]] = {}

        def keep(
            chains: Mapping[str, Sequence[tuple[float, ...] | None]], more: Held = NOTHING
        ) -> None:
            changes = {k: {n: c[i] for n, c in chains.items()} for i, k in enumerate(kinds)}
            self._keep({**more, **changes})

        def store() -> None:
            old.update({n: [self._stored[k].get(n) for k in kinds] for n in new})
            keep({n: _followed(old[n], point, before[n]) for n, point in new.items()}, held)
            self._marks[kind].update(dict.fromkeys(new, mark))

        def take_back(some: Collection[str] = tuple(new)) -> None:
            marks = self._marks[kind]
            keep({n: old[n] for n in some if marks.get(n) is mark})

        return store, take_back

    def settling(self) -> Work | None:
        """Return disk work that deletes the predecessors of acknowledged points.

        Returns None if there are none.

        The work raises `AssignedError` if the change cannot be stored, and may be repeated.
        """
        if not any(self._taken.values()):
            return None
        taken, self._taken = self._taken, {kind: {} for kind in KINDS}

        def settle() -> None:
            changes: dict[str, dict[str, tuple[float, ...] | None]] = {}
            for kind, places in taken.items():
                known, marks = self._stored[kind], self._marks[kind]
                names = [
                    n
                    for n, (point, mark) in places.items()
                    if known.get(n) == point and marks.get(n) is mark
                ]
                for earlier in EARLIER[kind]:
                    changes[earlier] = {n: None for n in names if n in self._stored[earlier]}
            if any(changes.values()):
                self._keep(changes)

        return settle

    def holding(self, held: Held) -> tuple[Work, Work]:
        """Return disk work that stores what visits hold, and disk work that reverts it.

        A value of None means that no visit holds anything there any longer. Only differences are
        written. Both pieces of work raise `AssignedError` if storing fails.
        """
        old: dict[str, dict[str, tuple[float, ...] | None]] = {}

        def store() -> None:
            for kind, values in held.items():
                known = self._stored[kind]
                old[kind] = {n: known.get(n) for n, v in values.items() if known.get(n) != v}
            if any(old.values()):
                self._keep({k: {n: held[k][n] for n in names} for k, names in old.items()})

        def take_back() -> None:
            if any(old.values()):
                self._keep(old)

        return store, take_back

    def released(self, held: Mapping[str, Collection[str]], now: float) -> Work | None:
        """Return disk work that deletes records of what visits no longer hold.

        Returns None if there are none.

        ``held`` contains, by kind, the heliostats of which visits hold something; ``now`` is
        monotonic, s.
        """
        free = {(k, n) for k, names in held.items() for n in self._stored[k].keys() - set(names)}
        self._idle = {key: self._idle.get(key, now) for key in free}
        due = [key for key, since in self._idle.items() if now - since >= _TAKEN_WITHIN]
        if not due:
            return None
        for key in due:
            del self._idle[key]
        return self.holding({k: {n: None for kind, n in due if kind == k} for k in held})[0]

    def _keep(self, changes: Held) -> None:
        """Store points by kind and heliostat."""
        places = {k: dict(known) for k, known in self._stored.items()}
        for kind, points in changes.items():
            changed = {**places[kind], **points}
            places[kind] = {name: point for name, point in changed.items() if point is not None}
        if self._store is not None:
            self._store.keep(places)
        self._stored = places


def differ(a: FloatArray, b: FloatArray) -> npt.NDArray[np.bool_]:
    """Return a mask of where two sets of points (K, 3) differ, (K,); NaN equals NaN."""
    return np.asarray(~np.all((a == b) | (np.isnan(a) & np.isnan(b)), axis=-1))


def put_before(earlier: FloatArray, rows: npt.NDArray[np.intp], points: FloatArray) -> None:
    """Put points (K, 3) of heliostats (K,) before all earlier ones (`BEFORE`, N, 3).

    The oldest point is kept, because it is the acknowledged one; if there is no room, the next
    oldest is dropped.
    """
    oldest = earlier[-1, rows]
    full = np.isfinite(oldest).all(axis=-1, keepdims=True)
    earlier[-1, rows] = np.where(full, oldest, earlier[-2, rows])
    earlier[1:-1, rows] = earlier[:-2, rows]
    earlier[0, rows] = points


def _followed(
    chain: Sequence[tuple[float, ...] | None], point: tuple[float, ...], before: tuple[float, ...]
) -> Sequence[tuple[float, ...] | None]:
    """Return the points of one heliostat, with a newly assigned point first."""
    last, *earlier = chain
    if last == point:
        return chain
    last = before if last is None else last
    if earlier[0] == last:  # this only reports that the point was not acknowledged yet
        earlier = [*earlier[1:], None]
    oldest = earlier[-2] if earlier[-1] is None else earlier[-1]
    return [point, last, *earlier[:-2], oldest]


def rest_on(standbys: FloatArray, point: tuple[float, float, float] | None) -> None:
    """Set a standby point, ENU, m, for all heliostats that have none; their boards store it."""
    if point is not None:
        standbys[~np.isfinite(standbys).all(axis=-1)] = point


def points_of(kind: str, points: Mapping[str, npt.ArrayLike]) -> FloatArray:
    """Return points that are keyed by name as an array, ENU, m, (K, 3), in the same order.

    Raises
    ------
    InputError
        If there are no points, or a point is not finite or beyond the range of the wire.
    """
    if not points:
        raise InputError(f"{kind}: no points; specify one for each heliostat")
    vectors = [as_vectors(point, f"{name}: point") for name, point in points.items()]
    stacked = as_vectors(np.stack(vectors), "points")
    if np.abs(stacked).max() > FAR:
        raise InputError(
            f"{kind}: a point is {np.abs(stacked).max():g} m away, the limit is {FAR:g} m"
        )
    return stacked


def grouped(names: Sequence[str], points: FloatArray) -> dict[tuple[float, ...], list[str]]:
    """Group heliostats by their points (K, 3); heliostats with the same point share one command."""
    groups: dict[tuple[float, ...], list[str]] = {}
    for name, point in zip(names, points, strict=True):
        groups.setdefault(tuple(float(x) for x in point), []).append(name)
    return groups
