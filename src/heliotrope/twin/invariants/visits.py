"""The observer of visits: what photographs have taught the plant, beside the true mirrors.

It judges two things that the plant keeps: a calibration, by which the mirror's true beam must go
where it is aimed (12), and a sighting, which must show the mirror's own beam (16).
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from heliotrope.calibration.sightings import Sightings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, reflect
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import track
from heliotrope.plant.controller import PlantController
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.outfit import RECEIVER
from heliotrope.twin.invariants.beams import ASTRAY
from heliotrope.twin.invariants.invariants import InvariantError, Violation

#: A sighting this far from the beam's true place is not of that beam, m: the noise of centroids,
#: play of the gears and counts that are interpolated stay below it.
FOREIGN = 1.0


class VisitObserver:
    """Observes calibrations and sightings.

    Parameters
    ----------
    start
        Zero of the times that it reports, s.
    boards
        All heliostats.
    targets
        Calibration targets.
    followed
        Whether visits follow the beam that they photograph, so that the light of another one is
        never kept; without that, only a later photograph contradicts it.

    Attributes
    ----------
    checks
        Number of checks of each invariant.
    """

    def __init__(
        self, start: float, boards: Sequence[Board], targets: Sequence[Target], *, followed: bool
    ) -> None:
        self.checks: Counter[int] = Counter()
        self._start, self._followed = start, followed
        self._boards, self._targets = {b.outfit.name: b for b in boards}, tuple(targets)
        self._judged: dict[str, object] = {}
        self._kept: dict[str, int] = {}

    def _check(self, number: int, good: bool, now: float, subject: str, saw: str) -> None:
        self.checks[number] += 1
        if not good:
            raise InvariantError(Violation(number, now - self._start, subject, saw))

    def ended(self) -> None:
        """Note that the plant's program has ended; the next one knows what the store has kept."""
        self._judged.clear()
        self._kept.clear()

    def look(self, plant: PlantController | None, sun: FloatArray, now: float) -> None:
        """Judge what the plant has learnt since the last look; None: the plant does not run."""
        if plant is None:
            return
        for name, board in self._boards.items():
            record = plant.beliefs.record(name)
            if record is not None and self._judged.get(name) is not record:
                self._judged[name] = record
                self._believed(board, plant.beliefs.present(name)[0], sun, now)
            seen = plant.beliefs.seen(name)
            known = self._kept.get(name, 0)
            if seen is not None and len(seen.sightings) > known:
                self._kept[name] = len(seen.sightings)
                if self._followed:
                    self._own(
                        board, seen.sightings.take(np.arange(known, len(seen.sightings))), now
                    )

    def _believed(self, board: Board, believed: Mechanism, sun: FloatArray, now: float) -> None:
        """Check where the true beam goes if the mirror is aimed by what the plant believes."""
        truth, slip = board.outfit.mechanism, np.asarray(board.slip, dtype=np.float64)
        here = [axis.turned for axis in board.axes] - slip
        for point in (RECEIVER, *(target.center for target in self._targets)):
            found = track(believed, sun, np.asarray(point), current=here)
            counts = found.best_counts
            if not np.isfinite(counts).all():
                continue
            pose = truth.pose(counts + slip)
            miss = _passes(pose.vertex, reflect(sun, pose.normal), np.asarray(point))
            saw = f"by the calibration that the plant believes its beam is {miss:.1f} m astray"
            self._check(12, miss <= ASTRAY, now, board.outfit.name, saw)

    def _own(self, board: Board, sightings: Sightings, now: float) -> None:
        """Check that sightings show the beam of the mirror itself."""
        pose = board.outfit.mechanism.pose(sightings.counts + np.asarray(board.slip))
        rays = reflect(sightings.source, pose.normal)
        for vertex, ray, seen in zip(pose.vertex, rays, sightings.destination, strict=True):
            miss = _passes(vertex, ray, seen)
            saw = f"a sighting that the plant keeps is {miss:.1f} m from its true beam"
            self._check(16, miss <= FOREIGN, now, board.outfit.name, saw)


def _passes(vertex: FloatArray, ray: FloatArray, point: FloatArray) -> float:
    """Return the distance at which a ray (3,) passes a point (3,), m."""
    way = point - vertex
    return float(np.linalg.norm(way - ray * (way @ ray)))
