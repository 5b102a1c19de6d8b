"""A campaign: flights over the same heliostats in other poses, evaluated together.

The survey errors of the heliostats and RTK's common offset are the same in all flights. From
one place the images hardly tell them apart (`bundle`), so flights that
share heliostats go through one adjustment, in groups that fit into memory.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.bundle import Priors
from heliotrope.airborne.evaluate.evaluation import Evaluation, evaluate
from heliotrope.airborne.evaluate.reading import Seen
from heliotrope.airborne.mirror import MirrorShape
from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.airborne.standing import Standing, join_standing
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float

#: Corners of one adjustment: it takes 20 s and 0.4 GB for each hundred thousand.
MOST_CORNERS = 200_000


@dataclass(frozen=True)
class Pose:
    """One flight: photographs of mirrors that stand still.

    Attributes
    ----------
    name
        Of the flight.
    photos, seen
        As told, and what each shows.
    camera
        With its lamp.
    stand
        The N mirrors as they are believed to stand.
    heliostat
        Numbers of the heliostats, the same in all flights, (N,).
    shape
        Gives the surface of a mirror's row.
    """

    name: str
    photos: tuple[Photo, ...]
    seen: tuple[Seen, ...]
    camera: LedCamera
    stand: Standing
    heliostat: npt.NDArray[np.intp]
    shape: Callable[[int], MirrorShape]

    @property
    def corners(self) -> int:
        """How many corners its photographs show."""
        return sum(int(np.isfinite(s.corners).all(axis=-1).sum()) for s in self.seen)

    @property
    def dark(self) -> bool:
        """Whether its photographs show the lamp, but no edge of a mirror: it stands alone then."""
        return not self.corners and any(not s.problem and len(s.spot) for s in self.seen)


@dataclass(frozen=True)
class Campaign:
    """What the flights of a campaign give.

    Attributes
    ----------
    flights
        In the order given; None for one that gave nothing.
    problems
        Of each flight: a line for each photograph that was not used, or why it gave nothing.
    offset, offset_covariance
        RTK's common offset, told less true, m, (3,), and its covariance, m², (3, 3): the mean of
        all groups by their accuracy.
    groups
        How many adjustments there were.
    """

    flights: tuple[Evaluation | None, ...]
    problems: tuple[tuple[str, ...], ...]
    offset: FloatArray
    offset_covariance: FloatArray
    groups: int


def evaluate_campaign(poses: Sequence[Pose], priors: Priors | None = None) -> Campaign:
    """Return the reflections of all flights; one that gives nothing does not stop the others.

    Parameters
    ----------
    poses
        The flights.
    priors
        Of the bundle adjustments.

    Raises
    ------
    InputError
        If no flight gives a reflection.
    """
    found: list[Evaluation | None] = [None] * len(poses)
    problems = [tuple(_unused(pose)) for pose in poses]
    # Of a single flight it is the evaluation that says what is wrong.
    usable = [k for k, pose in enumerate(poses) if pose.corners or pose.dark or len(poses) == 1]
    done = []
    for group in _groups(poses, usable):
        try:
            joint = _together([poses[k] for k in group], priors)
        except InputError as error:
            if len(poses) == 1:
                raise
            for k in group:
                problems[k] = (*problems[k], str(error))
            continue
        done.append(joint)
        for k, part in zip(group, _parts([poses[k] for k in group], joint), strict=True):
            if len(part.reflections):
                found[k] = part
            else:
                problems[k] = (*problems[k], "no reflection on any mirror in its photographs")
    if all(one is None for one in found):
        told = next(
            (f"{p.name}: {line[-1]}" for p, line in zip(poses, problems, strict=True) if line),
            "there is none",
        )
        raise InputError(f"no flight of {len(poses)} gives a reflection; the first: {told}")
    offset, covariance = _common(done, (priors or Priors()).offset)
    return Campaign(tuple(found), tuple(problems), offset, covariance, len(done))


def _unused(pose: Pose) -> list[str]:
    lines = [f"{s.name}: {s.problem}" for s in pose.seen if s.problem]
    lines += [
        f"{s.name}: outline: no mirror's edges could be measured"
        for s in pose.seen
        if not s.problem and not np.isfinite(s.corners).any() and not pose.dark
    ]
    if not (pose.corners or pose.dark):
        lines.append(f"none of its {len(pose.photos)} photographs can be used")
    return lines


def _groups(poses: Sequence[Pose], usable: Sequence[int]) -> list[list[int]]:
    """Return flights that share heliostats and camera, in groups of :data:`MOST_CORNERS`."""
    groups = [[k] for k in usable if poses[k].dark]
    left = [k for k in usable if not poses[k].dark]
    while left:
        group, heliostats = [left.pop(0)], set[int]()
        camera = poses[group[0]].camera
        heliostats |= set(poses[group[0]].heliostat.tolist())
        grown = True
        while grown:
            near = [
                k
                for k in left
                if heliostats & set(poses[k].heliostat.tolist()) and _alike(camera, poses[k].camera)
            ]
            grown = bool(near)
            for k in near:
                left.remove(k)
                heliostats |= set(poses[k].heliostat.tolist())
            group += near
        group.sort()
        parts = -(-sum(poses[k].corners for k in group) // MOST_CORNERS)
        # Dealt out in turn: each part looks from several sides.
        groups += [group[i::parts] for i in range(min(parts, len(group)))]
    return groups


def _alike(one: LedCamera, other: LedCamera) -> bool:
    return one.size == other.size and all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("matrix", "distortion", "led_offset")
    )


def _together(poses: Sequence[Pose], priors: Priors | None) -> Evaluation:
    """Evaluate several flights as one, with a mirror for each heliostat and pose."""
    if len(poses) == 1:
        one = poses[0]
        return evaluate(one.photos, one.seen, one.camera, one.stand, one.shape, priors=priors)
    first = np.cumsum([0] + [len(p.stand) for p in poses])
    numbers = np.concatenate([p.heliostat for p in poses])
    _, owner = np.unique(numbers, return_inverse=True)
    seen = [
        replace(s, mirror=s.mirror + start, spot_mirror=s.spot_mirror + start)
        for p, start in zip(poses, first[:-1].tolist(), strict=True)
        for s in p.seen
    ]

    def shape(row: int) -> MirrorShape:
        k = int(np.searchsorted(first, row, side="right")) - 1
        return poses[k].shape(row - int(first[k]))

    photos = [photo for p in poses for photo in p.photos]
    stand = join_standing([p.stand for p in poses])
    return evaluate(photos, seen, poses[0].camera, stand, shape, priors=priors, owner=owner)


def _parts(poses: Sequence[Pose], joint: Evaluation) -> list[Evaluation]:
    """Return the flights of a joint evaluation, each with its own rows and photographs."""
    if len(poses) == 1:
        return [joint]
    parts, row, photo = [], 0, 0
    for pose in poses:
        rows = np.arange(row, row + len(pose.stand))
        used = sum(1 for s in pose.seen if not s.problem and np.isfinite(s.corners).any())
        here = slice(photo, photo + used)
        at = joint.reflections.photo
        mine = joint.reflections.take(np.flatnonzero((at >= photo) & (at < photo + used)))
        parts.append(
            replace(
                joint,
                photos=joint.photos[here],
                told=joint.told[here],
                seen=tuple(
                    replace(s, mirror=s.mirror - row, spot_mirror=s.spot_mirror - row)
                    for s in joint.seen[here]
                ),
                stand=joint.stand.take(rows),
                place_covariance=joint.place_covariance[rows],
                reflections=replace(mine, photo=mine.photo - photo, heliostat=mine.heliostat - row),
                problems=tuple(_unused(pose)),
            )
        )
        row, photo = row + len(rows), photo + used
    return parts


def _common(done: Sequence[Evaluation], prior: float) -> tuple[FloatArray, FloatArray]:
    """Return the mean of the groups' offsets by their accuracy, the prior counted once."""
    own = np.eye(3) / prior**2
    weight, drawn = own, np.zeros(3)
    for one in done:
        share = np.linalg.inv(one.adjusted.offset_covariance)
        drawn = drawn + share @ one.adjusted.state.offset
        weight = weight + share - own
    covariance = np.linalg.inv(weight)
    return as_float(covariance @ drawn), as_float(covariance)
