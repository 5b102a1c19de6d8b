"""Flights over the same heliostats in different poses, evaluated together.

The survey errors of the heliostats and the common RTK offset are the same in all flights. Images
from a single position can hardly separate survey errors from the offset
(`heliotrope.airborne.evaluate.bundle`), so flights that share heliostats are adjusted together, in
groups that fit into memory.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from heliotrope.airborne.evaluate.bundle import Priors
from heliotrope.airborne.evaluate.evaluation import FlightEvaluation, evaluate
from heliotrope.airborne.evaluate.folder import FlightData
from heliotrope.airborne.mirror import MirrorShape
from heliotrope.airborne.photo import LedCamera
from heliotrope.airborne.standing import join_standing
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float

#: Maximum number of corners in one adjustment, which takes 20 s and 0.4 GB per 100,000 corners.
MOST_CORNERS = 200_000


@dataclass(frozen=True)
class Campaign:
    """Result of the flights in a campaign.

    Attributes
    ----------
    flights
        Results in the order of the flights passed; None for a flight without a result.
    problems
        For each flight, a message for each photograph that was not used, or the reason why the
        flight has no result.
    offset, offset_covariance
        Common RTK offset, recorded minus true, m, (3,), and its covariance, m², (3, 3); a mean over
        all groups, weighted by their accuracy.
    groups
        Number of adjustments.
    """

    flights: tuple[FlightEvaluation | None, ...]
    problems: tuple[tuple[str, ...], ...]
    offset: FloatArray
    offset_covariance: FloatArray
    groups: int

    @property
    def offset_sigma(self) -> FloatArray:
        """Standard deviation of the offset, m, (3,)."""
        return as_float(np.sqrt(np.diag(self.offset_covariance)))

    def offset_text(self) -> str:
        """Return the offset as text."""
        parts = [
            f"{axis} {1e3 * o:+.1f} ± {1e3 * s:.1f}"
            for axis, o, s in zip("ENU", self.offset, self.offset_sigma, strict=True)
        ]
        return f"common RTK offset, recorded minus true: {', '.join(parts)} mm"

    def warnings(self, prior: float) -> list[str]:
        """Return a warning if the offset far exceeds its prior standard deviation, m."""
        size = float(np.abs(self.offset).max())
        if size <= 3.0 * prior:
            return []
        line = (
            f"the common RTK offset is {1e3 * size:.0f} mm, but its specified standard deviation "
            f"is {1e3 * prior:.0f} mm; check the position of the base station, or specify a "
            "larger standard deviation (--rtk-mm)"
        )
        return [line]


def evaluate_campaign(flights: Sequence[FlightData], priors: Priors | None = None) -> Campaign:
    """Return the reflections of all flights; a flight without a result does not stop the rest.

    Parameters
    ----------
    flights
        Flights whose photographs have been read.
    priors
        Prior standard deviations of the bundle adjustments.

    Raises
    ------
    InputError
        If no flight yields a reflection.
    """
    evaluations: list[FlightEvaluation | None] = [None] * len(flights)
    problems = [tuple(flight.unused()) for flight in flights]
    # The error of a single flight is raised unchanged.
    usable = [k for k, f in enumerate(flights) if f.corners or f.dark or len(flights) == 1]
    done = []
    for group in flight_groups(flights, usable):
        try:
            joint = _together([flights[k] for k in group], priors)
        except InputError as error:
            if len(flights) == 1:
                raise
            for k in group:
                problems[k] = (*problems[k], str(error))
            continue
        done.append(joint)
        for k, part in zip(group, _parts([flights[k] for k in group], joint), strict=True):
            if len(part.reflections):
                evaluations[k] = part
            else:
                problems[k] = (*problems[k], "no reflection on any mirror in its photographs")
    if all(evaluation is None for evaluation in evaluations):
        if not flights:
            raise InputError("there is no flight to evaluate")
        first = f"{flights[0].name}: {_cause(problems[0])}".removeprefix(": ")
        raise InputError(f"none of {len(flights)} flights shows a reflection; the first: {first}")
    offset, covariance = common_offset(done, (priors or Priors()).offset)
    return Campaign(tuple(evaluations), tuple(problems), offset, covariance, len(done))


def _cause(lines: Sequence[str]) -> str:
    """Return the most frequent reason for which a flight failed, with an example."""
    reasons = [line for line in lines if line.strip(" :")]
    if not reasons:
        return "its photographs show no reflection of the lamp"
    # The message about a photograph has the form "name: kind: reason".
    kinds = Counter(line.partition(": ")[2].partition(":")[0] or line for line in reasons)
    kind, count = kinds.most_common(1)[0]
    line = next(text for text in reasons if kind in text)
    return line if count == 1 else f"{line} (and {count - 1} more for the same reason)"


def flight_groups(flights: Sequence[FlightData], usable: Sequence[int]) -> list[list[int]]:
    """Return groups of flights that share heliostats and camera, within `MOST_CORNERS`."""
    groups = [[k] for k in usable if flights[k].dark]
    remaining = [k for k in usable if not flights[k].dark]
    while remaining:
        group = [remaining.pop(0)]
        camera, heliostats = flights[group[0]].camera, set(flights[group[0]].heliostat.tolist())
        grown = True
        while grown:
            near = [
                k
                for k in remaining
                if heliostats & set(flights[k].heliostat.tolist())
                and _alike(camera, flights[k].camera)
            ]
            grown = bool(near)
            for k in near:
                remaining.remove(k)
                heliostats |= set(flights[k].heliostat.tolist())
            group += near
        group.sort()
        parts = -(-sum(flights[k].corners for k in group) // MOST_CORNERS)
        # Distribute the flights in turn, so that each group has views from several sides.
        groups += [group[i::parts] for i in range(min(parts, len(group)))]
    return groups


def _alike(camera: LedCamera, other: LedCamera) -> bool:
    return camera.size == other.size and all(
        np.array_equal(getattr(camera, name), getattr(other, name))
        for name in ("matrix", "distortion", "led_offset")
    )


def _together(flights: Sequence[FlightData], priors: Priors | None) -> FlightEvaluation:
    """Evaluate several flights as one, with a mirror for each heliostat and pose."""
    if len(flights) == 1:
        flight = flights[0]
        return evaluate(
            flight.photos, flight.seen, flight.camera, flight.stand, flight.shape, priors=priors
        )
    first = np.cumsum([0] + [len(f.stand) for f in flights])
    numbers = np.concatenate([f.heliostat for f in flights])
    _, owner = np.unique(numbers, return_inverse=True)
    readings = [
        replace(s, mirror=s.mirror + start, spot_mirror=s.spot_mirror + start)
        for f, start in zip(flights, first[:-1].tolist(), strict=True)
        for s in f.seen
    ]

    def shape(row: int) -> MirrorShape:
        k = int(np.searchsorted(first, row, side="right")) - 1
        return flights[k].shape(row - int(first[k]))

    photos = [photo for f in flights for photo in f.photos]
    stand = join_standing([f.stand for f in flights])
    return evaluate(photos, readings, flights[0].camera, stand, shape, priors=priors, owner=owner)


def _parts(flights: Sequence[FlightData], joint: FlightEvaluation) -> list[FlightEvaluation]:
    """Split a joint evaluation into its flights, each with its own mirrors and photographs."""
    if len(flights) == 1:
        return [joint]
    parts, row, photo = [], 0, 0
    for flight in flights:
        rows = np.arange(row, row + len(flight.stand))
        used = sum(s.has_corners for s in flight.seen)
        part = slice(photo, photo + used)
        at = joint.reflections.photo
        mine = joint.reflections.take(np.flatnonzero((at >= photo) & (at < photo + used)))
        parts.append(
            replace(
                joint,
                photos=joint.photos[part],
                recorded=joint.recorded[part],
                seen=tuple(
                    replace(s, mirror=s.mirror - row, spot_mirror=s.spot_mirror - row)
                    for s in joint.seen[part]
                ),
                stand=joint.stand.take(rows),
                place_covariance=joint.place_covariance[rows],
                reflections=replace(mine, photo=mine.photo - photo, heliostat=mine.heliostat - row),
                problems=tuple(flight.unused()),
            )
        )
        row, photo = row + len(rows), photo + used
    return parts


def common_offset(done: Sequence[FlightEvaluation], prior: float) -> tuple[FloatArray, FloatArray]:
    """Return the mean offset of all groups, weighted by accuracy, m, and its covariance, m².

    The prior, with standard deviation ``prior``, is counted only once.
    """
    own = np.eye(3) / prior**2
    weight, drawn = own, np.zeros(3)
    for evaluation in done:
        share = np.linalg.inv(evaluation.adjusted.offset_covariance)
        drawn = drawn + share @ evaluation.adjusted.state.offset
        weight = weight + share - own
    covariance = np.linalg.inv(weight)
    return as_float(covariance @ drawn), as_float(covariance)
