"""The observer of visits: the plant's stored calibrations and sightings against the truth.

It checks two things that the plant stores: a calibration, which must bring the heliostat's true
beam to its aim within the calibration's own covariance (12), and a sighting, which must show the
heliostat's own beam (16).
"""

from collections.abc import Callable, Collection, Sequence

import numpy as np

from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.calibration.sightings import Sightings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, reflect
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import track
from heliotrope.plant.controller import PlantController
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.outfit import RECEIVER
from heliotrope.twin.invariants.beams import ASTRAY
from heliotrope.twin.invariants.invariants import Judge

#: A sighting this far from the beam's true position does not show that beam, m: centroid noise,
#: gear backlash and interpolated counts cause smaller errors.
FOREIGN = 1.0
#: A calibration misses by at most this many of its own standard deviations, in the direction of the
#: miss: one photograph at the deepest point of a swing is two of them away (`visits.swings`). The
#: second number is the error that the covariance need not contain, rad of beam in each direction:
#: single steps, and step counts interpolated to the moment of a photograph.
DEVIATIONS, FLOOR = 3.0, 1e-4
#: A sighting has the time of a photograph to within this, s.
SAME_TIME = 1.0


class VisitObserver(Judge):
    """Checks calibrations and sightings.

    Parameters
    ----------
    start
        Origin of the times that it reports, s.
    boards
        All heliostats.
    targets
        Calibration targets.
    away
        Function that returns the difference, s, between a POSIX time, s, and the time of the
        nearest photograph.
    followed
        Whether visits follow the beam that they photograph, so that light from another beam is
        never stored; otherwise only a later photograph contradicts it.
    dark
        Heliostats whose errors far exceed the priors; their covariances, which are based on these
        priors, are not judged.

    """

    def __init__(
        self,
        start: float,
        boards: Sequence[Board],
        targets: Sequence[Target],
        away: Callable[[float], float],
        *,
        followed: bool,
        dark: Collection[str] = (),
    ) -> None:
        super().__init__(start)
        self._away, self._followed = away, followed
        self._dark = frozenset(dark)
        self._boards, self._targets = {b.outfit.name: b for b in boards}, tuple(targets)
        self._judged: set[tuple[str, int, float]] = set()
        self._kept: dict[str, int] = {}
        self._slipped: set[str] = set()  # earlier sightings say nothing about the present state

    def on_end(self, now: float) -> None:
        """Record that the plant program has ended; the next one knows the contents of the store."""
        del now
        self._kept.clear()

    def look(self, plant: PlantController | None, sun: FloatArray, now: float) -> None:
        """Check the calibrations since the last check; ``plant`` is None if it is not running."""
        if plant is None:
            return
        for name, board in self._boards.items():
            if any(board.slip):
                self._slipped.add(name)
            record = plant.beliefs.record(name)
            # Judged only once: when the store returns a calibration, its heliostat may have
            # slipped.
            if record is not None and (name, record.version, record.at) not in self._judged:
                self._judged.add((name, record.version, record.at))
                # An operator enters one true parameter of a heliostat; its other parameters may
                # be wrong.
                if len(record.sightings):
                    self._believed(board, record, plant.beliefs.nominal(name)[0], sun, now)
            kept = plant.beliefs.known(name)
            known = self._kept.get(name, 0)
            if kept is None or len(kept.sightings) < known:
                self._kept[name] = known = 0  # an operator's parameters are based on no sighting
            if kept is not None and len(kept.sightings) > known:
                self._kept[name] = len(kept.sightings)
                new = kept.sightings.take(np.arange(known, len(kept.sightings)))
                self._dated(name, new, now)
                if self._followed and name not in self._slipped:
                    self._own(board, new, now)

    def _believed(
        self,
        board: Board,
        record: HeliostatCalibration,
        nominal: Mechanism,
        sun: FloatArray,
        now: float,
    ) -> None:
        """Check where the true beam goes if the heliostat is aimed with the plant's calibration.

        A heliostat that has lost steps is omitted, because its photographs may be older than the
        loss.
        """
        if board.outfit.name in self._slipped:
            return
        truth, slip = board.outfit.mechanism, np.asarray(board.slip, dtype=np.float64)
        believed, name = record.mechanism(nominal), board.outfit.name
        present = [axis.turned for axis in board.axes] - slip
        for point in (RECEIVER, *(target.center for target in self._targets)):
            aim = np.asarray(point, dtype=np.float64)
            solution = track(believed, sun, aim, current=present)
            counts = solution.best_counts
            if not np.isfinite(counts).all():
                continue
            pose = truth.pose(counts + slip)
            ray = reflect(sun, pose.normal)
            miss = _passes(pose.vertex, ray, aim)
            sideways = across(aim - pose.vertex)
            slope = slope_of(record, nominal, counts, sun, aim) @ sideways.T
            spread = slope.T @ record.covariance @ slope + FLOOR**2 * np.eye(2)
            off = sideways @ ray
            deviations = float(np.sqrt(off @ np.linalg.solve(spread, off)))
            saw = f"by the calibration that the plant uses, its beam is {miss:.1f} m off target"
            self.check(12, miss <= ASTRAY, now, name, saw)
            if self._followed and name not in self._dark:
                saw = f"its calibration is wrong by {deviations:.1f} of its own standard deviations"
                self.check(12, deviations <= DEVIATIONS, now, name, saw)

    def _dated(self, name: str, sightings: Sightings, now: float) -> None:
        """Check that sightings have the times of photographs, which determine their sun vectors."""
        for at in sightings.time:
            away = self._away(float(at))
            saw = f"a sighting that the plant keeps is dated {away:.1f} s away from any photograph"
            self.check(16, away <= SAME_TIME, now, name, saw)

    def _own(self, board: Board, sightings: Sightings, now: float) -> None:
        """Check that sightings show the heliostat's own beam."""
        pose = board.outfit.mechanism.pose(sightings.counts + np.asarray(board.slip))
        rays = reflect(sightings.source, pose.normal)
        for vertex, ray, point in zip(pose.vertex, rays, sightings.destination, strict=True):
            miss = _passes(vertex, ray, point)
            saw = f"a sighting that the plant keeps is {miss:.1f} m from its true beam"
            self.check(16, miss <= FOREIGN, now, board.outfit.name, saw)


def across(direction: FloatArray) -> FloatArray:
    """Return unit vectors, (2, 3), to the right of and above a direction, (3,)."""
    right = np.cross(direction, (0.0, 0.0, 1.0))
    above = np.cross(right, direction)
    return np.stack([right / np.linalg.norm(right), above / np.linalg.norm(above)])


def slope_of(
    record: HeliostatCalibration,
    nominal: Mechanism,
    counts: FloatArray,
    sun: FloatArray,
    aim: FloatArray,
) -> FloatArray:
    """Return the motion of the beam at an aim per unit of each calibration parameter, (P, 3).

    The motion is expressed as an angle at the mirror. It includes the effect of a displaced mirror.
    """
    slopes = []
    offset = aim - record.mechanism(nominal).pose(counts).vertex
    for name, value, sigma in zip(record.names, record.values, record.sigma, strict=True):
        step = max(1e-3 * float(sigma), 1e-9)
        before, after = (
            nominal.with_parameters({**record.parameters, name: float(value) + change}).pose(counts)
            for change in (-step, step)
        )
        turned = reflect(sun, after.normal) - reflect(sun, before.normal)
        moved = (after.vertex - before.vertex) / np.linalg.norm(offset)
        slopes.append((turned + moved) / (2.0 * step))
    return np.array(slopes)


def _passes(vertex: FloatArray, ray: FloatArray, point: FloatArray) -> float:
    """Return the distance of a ray from a point, m."""
    offset = point - vertex
    return float(np.linalg.norm(offset - ray * (offset @ ray)))
