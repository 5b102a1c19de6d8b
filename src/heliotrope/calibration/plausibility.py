"""Physical plausibility of sightings, judged here for every source of sightings.

Tables, measurement folders, photograph logs, flights and the plant's own cameras all call `judge`.
It returns a reason for each sighting that is physically impossible; the caller leaves such a
sighting out and reports it. If most sightings of a heliostat are contradicted, the fault does not
lie in single sightings; the sightings are kept, and the fit judges the heliostat (`learn.misfits`).
If most sightings of a source are contradicted, they are kept and a note is returned.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt

from heliotrope import sun as solar
from heliotrope.calibration.fit.estimator import FAR
from heliotrope.calibration.sightings import Sightings, ray_directions
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target
from heliotrope.files.times import format_time
from heliotrope.geometry import MOST_TURNS, FloatArray, angle_between, azimuth_elevation
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import SLOTS
from heliotrope.sun import Site

#: Period of possible sightings, Unix seconds. No heliostat is older than this period, and later
#: times are typing errors.
EARLIEST, LATEST = 0.0, datetime(2100, 1, 1, tzinfo=UTC).timestamp()
YEAR = "the year is outside 1970 to 2099; correct the time"
#: A time may be this far ahead of the computer's clock, s, because that clock may be slow.
AHEAD = 366 * 86400.0
#: Lowest elevation of the sun's centre at which there is a beam, rad; it allows for the solar
#: radius and the horizon dip.
LOWEST = float(np.radians(-0.5))
#: Largest angle between a stated sun vector and the sun at the stated time, rad. The sun takes four
#: minutes to move by this angle.
MOVED = float(np.radians(1.0))
#: Largest angle of incidence, rad; beyond it the mirror is seen edge-on.
EDGE_ON = float(np.radians(89.0))
#: Angle beyond a stop, or behind a mirror, that uncalibrated drive zeros may explain, rad.
PLAY = float(np.radians(5.0))
#: A destination may lie this far off its surface, m, and beyond its border by this fraction of its
#: size.
OFF, BEYOND = 0.5, 0.5
#: A point closer to the mirror than this lies on the mirror itself, m.
NEAREST = 0.5
#: Sightings with the same counts and the same point are one reading if their sun vectors differ by
#: less than this, rad, which is a minute of sun motion. The centroids of two photographs always
#: differ in their last digit.
SAME = float(np.radians(0.25))
#: If a beam is at the same point in this many sightings or more, at different sun positions, it was
#: not measured.
REPEATED = 3

Rows = npt.NDArray[np.bool_]
#: One reason for all refused sightings, or one reason for each of them.
Texts = str | Sequence[str]


@dataclass(frozen=True)
class Judgement:
    """The implausible features of M sightings.

    Attributes
    ----------
    reasons
        Why a sighting is impossible, by its index.
    notes
        Notes on contradictions that affect most of the sightings; these sightings are kept.
    """

    reasons: Mapping[int, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def judge(
    sightings: Sightings,
    *,
    mechanism: Mechanism | None = None,
    site: Site | None = None,
    surfaces: Sequence[Target | Receiver] = (),
    kinds: Sequence[str] = (),
    now: float | None = None,
) -> Judgement:
    """Return the reasons why some of the sightings are impossible.

    A sighting gets the first reason that applies. Each optional argument enables further checks.

    Parameters
    ----------
    sightings
        M sightings.
    mechanism
        Mechanisms of the heliostats, (N,), used to check stops, light from behind a mirror and
        points on a mirror.
    site
        Site, used to check the sun position at the time of each sighting.
    surfaces
        Targets and receivers of the plant, used to check the destinations of kind "camera_target".
    kinds
        Kind of each sighting, (M,); an empty string if unknown.
    now
        Time by the computer's clock, Unix seconds, used to check for times in the future.
    """
    reasons: dict[int, str] = {}
    for rows, text in _impossible(sightings, now):
        _add(reasons, rows, text)
    notes = []
    if site is not None:
        rows, text, note = _contradicted(sightings, site, reasons)
        _add(reasons, rows, text)
        notes += [note] if note else []
    photographed = np.array(
        [kind == "camera_target" for kind in kinds or [""] * len(sightings)], np.bool_
    )
    _add(
        reasons,
        _repeated(sightings, photographed, reasons),
        "the beam position is identical to the last digit in all sightings of this heliostat, "
        "although sun and counts change, so it was not measured; if the beam was steered to a "
        "mark by hand, leave kind empty",
    )
    if surfaces and kinds:
        _add(
            reasons,
            *_off_target(sightings, photographed & ~sightings.destination_at_infinity, surfaces),
        )
    if mechanism is not None and len(sightings):
        for rows, text in _beyond_machine(sightings, mechanism, reasons):
            _add(reasons, rows, text)
    return Judgement(reasons, tuple(notes))


def judge_in(
    plant: Plant, sightings: Sightings, kinds: Sequence[str] = (), now: float | None = None
) -> Judgement:
    """Judge sightings with all of a plant's data; heliostat indices refer to the plant."""
    return judge(
        sightings,
        mechanism=plant.nominal if len(plant.groups) == 1 else None,
        site=plant.site,
        surfaces=(*plant.targets, *plant.receivers),
        kinds=kinds,
        now=now,
    )


def _add(reasons: dict[int, str], rows: Rows, texts: Texts) -> None:
    """Assign a reason, common or one per sighting, to the sightings that have no reason yet."""
    places = np.flatnonzero(rows)
    row_texts = [texts] * len(places) if isinstance(texts, str) else texts
    for i, text in zip(places, row_texts, strict=True):
        reasons.setdefault(int(i), text)


def _impossible(sightings: Sightings, now: float | None) -> Iterator[tuple[Rows, Texts]]:
    """Yield the sightings that are impossible for any heliostat anywhere."""
    time = sightings.time
    out = (time < EARLIEST) | (time > LATEST)
    yield out, YEAR
    if now is not None:
        ahead = time > now + AHEAD
        clock = format_time(float(np.floor(now)))
        yield (
            ahead,
            f"the time is more than a year ahead of this computer's clock, {clock}; correct it",
        )
    low = sightings.source_at_infinity & (sightings.source[:, 2] < np.sin(LOWEST))
    angles = np.degrees(np.arcsin(np.clip(sightings.source[low, 2], -1.0, 1.0)))
    yield low, [f"the sun is below the horizon: its elevation is {angle:.1f}°" for angle in angles]
    yield copies(sightings), "a copy of another sighting"


def copies(sightings: Sightings) -> Rows:
    """Return a mask of the sightings that repeat an earlier one, (M,).

    Heliostat, counts, destination and source are the same to the last digit, except that the sun
    may have moved by less than `SAME`.
    """
    again = np.zeros(len(sightings), np.bool_)
    if not len(sightings):
        return again
    table = np.hstack([sightings.heliostat[:, None], sightings.counts, sightings.destination])
    _, group, count = np.unique(table, axis=0, return_inverse=True, return_counts=True)
    rows = np.flatnonzero(count[group] > 1)
    while len(rows):
        # The first remaining sighting of each group, and the sightings that repeat it.
        _, first, of_group = np.unique(group[rows], return_index=True, return_inverse=True)
        lead = rows[first[of_group]]
        gap = np.linalg.norm(sightings.source[rows] - sightings.source[lead], axis=1)
        near = gap <= np.where(sightings.source_at_infinity[rows], SAME, 0.0)
        again[rows[near & (rows != lead)]] = True
        rows = rows[~near]
    return again


def _repeated(sightings: Sightings, photographed: Rows, reasons: Mapping[int, str]) -> Rows:
    """Return the camera sightings of heliostats that moved while their beam stayed in one place."""
    rows = photographed & ~np.isin(np.arange(len(sightings)), list(reasons))
    mirror = sightings.heliostat[rows]
    if not len(mirror):
        return rows

    def different(values: FloatArray) -> npt.NDArray[np.int64]:
        table = np.unique(np.hstack([mirror[:, None], values[rows]]), axis=0)
        return np.bincount(table[:, 0].astype(np.intp))

    stuck = (different(sightings.destination) == 1) & (different(sightings.counts) > 1)
    stuck &= np.bincount(mirror) >= REPEATED
    rows[rows] = stuck[mirror]
    return rows


def _contradicted(
    sightings: Sightings, site: Site, reasons: Mapping[int, str]
) -> tuple[Rows, Texts, str]:
    """Return the sightings whose sun vector is wrong for their time, the reasons, and a note."""
    able = sightings.source_at_infinity & np.isfinite(sightings.time)
    able[list(reasons)] = False
    if not able.any():
        return able, "", ""
    expected, away = np.zeros((len(sightings), 3)), np.zeros(len(sightings))
    expected[able] = solar.vector(sightings.time[able], site)
    away[able] = angle_between(sightings.source[able], expected[able])
    rows = away > MOVED
    mistaken, known = (np.bincount(sightings.heliostat[mask]) for mask in (rows, able))
    mostly = np.zeros(len(known), np.bool_)
    mostly[: len(mistaken)] = 2 * mistaken > known[: len(mistaken)]
    whole = rows & mostly[sightings.heliostat] if rows.any() else rows
    note = ""
    if whole.any():
        middle = float(np.degrees(np.median(away[whole])))
        note = (
            f"the sun directions of {whole.sum()} of {able.sum()} sightings do not match their "
            f"times (median {middle:.1f}° off): check clock, time zone and the plant's [site]"
        )
        rows = rows & ~whole
    stated, computed = azimuth_elevation(sightings.source[rows]), azimuth_elevation(expected[rows])
    texts = [
        f"the recorded sun is at azimuth {a % 360.0:.1f}°, elevation {e:.1f}°, but the actual sun "
        f"was at {b % 360.0:.1f}°, {f:.1f}° at that time: correct the direction or the time"
        for a, e, b, f in zip(*np.degrees(stated), *np.degrees(computed), strict=True)
    ]
    return rows, texts, note


def _off_target(
    sightings: Sightings, photographed: Rows, surfaces: Sequence[Target | Receiver]
) -> tuple[Rows, Texts]:
    away = np.full((len(surfaces), len(sightings)), np.inf)
    on = np.zeros(len(sightings), np.bool_)
    for k, surface in enumerate(surfaces):
        gap = sightings.destination - surface.center
        away[k] = np.linalg.norm(gap, axis=1)
        if isinstance(surface, Receiver):
            on |= away[k] <= np.hypot(surface.width, surface.height)
            continue
        across = np.abs(gap @ surface.axes.T) - (0.5 + BEYOND) * np.array(
            [surface.width, surface.height]
        )
        on |= (across <= OFF).all(axis=1) & (np.abs(gap @ surface.normal) <= OFF)
    rows = photographed & ~on
    nearest = np.argmin(away[:, rows], axis=0)
    texts = [
        f"the beam position is on no target: it is {away[k, i]:.1f} m from the centre of "
        f"{surfaces[k].name}, the nearest target"
        for k, i in zip(nearest, np.flatnonzero(rows), strict=True)
    ]
    return rows, texts


def _beyond_machine(
    sightings: Sightings, mechanism: Mechanism, reasons: Mapping[int, str]
) -> Iterator[tuple[Rows, Texts]]:
    """Yield the sightings that their heliostat's mechanism cannot produce."""
    mirrors = mechanism[sightings.heliostat]
    pose = mirrors.pose(sightings.counts)
    near = np.zeros(len(sightings), np.bool_)
    for points, far in (
        (sightings.source, sightings.source_at_infinity),
        (sightings.destination, sightings.destination_at_infinity),
    ):
        near |= ~far & (np.linalg.norm(points - pose.vertex, axis=1) < NEAREST)
    yield near, f"the ray begins or ends within {NEAREST} m of the mirror"
    with np.errstate(invalid="ignore", divide="ignore"):
        source, destination = ray_directions(sightings, pose.vertex)
        total = source + destination
        size = np.linalg.norm(total, axis=1)
        edge = ~near & ~(size > 2.0 * np.cos(EDGE_ON))
        miss = angle_between(pose.normal, total / np.maximum(size, 1e-9)[:, None])
    yield edge, f"the beam passes the mirror edge-on, {np.degrees(EDGE_ON):.0f}° from its normal"
    # Sightings are judged by the nominal mechanism only if it suits most of the heliostat's
    # sightings.
    good = np.flatnonzero(~(near | edge) & ~np.isin(np.arange(len(sightings)), list(reasons)))
    holds = np.zeros(len(mechanism), np.bool_)
    for row in np.unique(sightings.heliostat[good]):
        mine = good[sightings.heliostat[good] == row]
        holds[row] = np.nan_to_num(np.median(miss[mine]), nan=np.inf) < FAR
    judged = holds[sightings.heliostat]
    for drive, joint in enumerate(mechanism.driven):
        value, low, high, most, unit = _reach(mirrors, sightings.counts, drive)
        rows = ~((value >= low) & (value <= high)) & (judged | ~(np.abs(value) <= most))
        yield (
            rows,
            [
                f"the counts {sightings.counts[i, drive]:.10g} of {mechanism.joints[joint]} are "
                f"beyond its end stops: {value[i]:.5g}{unit} is outside {low[i]:.5g} to "
                f"{high[i]:.5g}{unit}"
                for i in np.flatnonzero(rows)
            ],
        )
    behind = judged & (
        np.minimum((pose.normal * source).sum(axis=1), (pose.normal * destination).sum(axis=1))
        < -np.sin(PLAY)
    )
    yield behind, "the beam comes from the back of the mirror at these counts"


def _reach(
    mirrors: Mechanism, counts: FloatArray, drive: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, str]:
    """Return a drive's values, its two limits, the tolerance for its zero, and the unit.

    All have shape (M,), in counts if the drive has count limits, otherwise in degrees.
    """
    table = mirrors.drives.table[:, drive]
    low, high = (table[:, SLOTS[name]] for name in ("min_count", "max_count"))
    if np.isfinite(low).all() and np.isfinite(high).all():
        play = 0.02 * (high - low)
        most = 2.0 * np.maximum(np.abs(low), np.abs(high))
        return counts[:, drive], low - play, high + play, most, " counts"
    angle = mirrors.drives.angles(counts)[:, drive]
    low, high = (table[:, SLOTS[name]] for name in ("min_angle", "max_angle"))
    limits = np.clip(np.array([low - PLAY, high + PLAY]), -MOST_TURNS, MOST_TURNS)
    most = np.full(len(counts), np.degrees(MOST_TURNS))
    return np.degrees(angle), *np.degrees(limits), most, "°"
