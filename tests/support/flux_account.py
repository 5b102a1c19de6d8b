"""Invariants of a plant under a flux limit: the true flux, and where aims come from."""

from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np

from heliotrope.aims.rounds import Answer
from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.plant.workers import at_once

#: Aims closer together than this are the same, m.
SAME = 0.05


class FluxAccount:
    """Judges a run; `work` is the plant's worker, whose answers it reads.

    Attributes
    ----------
    broken
        What was seen that may not be.
    """

    def __init__(self, limit: float) -> None:
        self.limit, self.broken = limit, list[str]()
        self._given: dict[str, list[FloatArray]] = defaultdict(list)
        self._names: tuple[str, ...] = ()

    async def work(self, work: Callable[..., Any], *given: Any) -> Any:
        """Compute, and note the aims that the optimiser or its fallback gives."""
        answer = await at_once(work, *given)
        if isinstance(answer, Answer):
            for move in answer.moves:
                for row, aim in zip(move.rows, move.aims, strict=True):
                    self._given[self._names[row]].append(aim)
            for row in np.flatnonzero(np.isfinite(answer.safe).all(axis=1)):
                self._given[self._names[row]].append(answer.safe[row])
        return answer

    def person(self, heliostat: str, aim: FloatArray) -> None:
        """Note an aim that a person has given."""
        self._given[heliostat].append(aim)

    def look(self, plant: Any, flux: FloatArray) -> None:
        """Judge the plant now, with its true flux, W/m²."""
        self._names = plant.field.names
        if flux.max() > self.limit:
            self.broken.append(f"flux: {1e-3 * flux.max():.1f} kW/m² above the limit")
        tracks = plant.field.among((states.TRACKING,), plant.now())
        for row in np.flatnonzero(tracks):
            name, aim = self._names[row], plant.aims[row]
            if not any(np.linalg.norm(aim - other) < SAME for other in self._given[name]):
                self.broken.append(f"aim: {name} tracks at {aim.round(2)}, which nobody has given")
