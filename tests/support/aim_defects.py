"""Defects of aims under a flux limit: for `twin_defects`."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from heliotrope.aims import rounds
from heliotrope.field.flux_limit import FluxLimit
from heliotrope.geometry import as_float
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.aiming import Aiming
from heliotrope.plant.operations.automatic import AUTOMATIC
from heliotrope.twin.invariants.invariants import FLUX, ORIGIN
from heliotrope.twin.world.faults import Fault

Plant = Callable[[pytest.MonkeyPatch], None]


def limit_ignored(patch: pytest.MonkeyPatch) -> None:
    """The optimiser is given twice the limit."""
    allowed = Aiming._allowed

    def twice(self: Any, limit: FluxLimit, scene: Any) -> FluxLimit:
        found = allowed(self, limit, scene)
        return FluxLimit(2.0 * as_float(found.flux), found.margin)

    patch.setattr(Aiming, "_allowed", twice)


def way_unchecked(patch: pytest.MonkeyPatch) -> None:
    """Beams move to their new aims although the flux is above the limit meanwhile."""
    begin = rounds._Walk.__init__

    def unlimited(self: Any, path: Any, flux: Any, cap: Any, now: Any) -> None:
        begin(self, path, flux, np.full_like(cap, np.inf), now)

    patch.setattr(rounds._Walk, "__init__", unlimited)


def aims_shifted(patch: pytest.MonkeyPatch) -> None:
    """Automatic control sends beams 0.3 m below the aims that were chosen."""
    aim = PlantController.aim

    def lower(self: Any, person: Any, token: int, points: Any) -> Any:
        if person == AUTOMATIC:
            points = {name: point - [0.0, 0.0, 0.3] for name, point in points.items()}
        return aim(self, person, token, points)

    patch.setattr(PlantController, "aim", lower)


def ramp_forgotten(patch: pytest.MonkeyPatch) -> None:
    """Heliostats stay on the receiver under a cloud, so that its end heats all cells at once."""
    patch.setattr(Aiming, "_ramp", lambda self, now, scene: None)


#: Invariant, name, defect, faults and first seed; each is planted in the world "limit".
ROWS: tuple[tuple[int, str, Plant, tuple[Fault, ...], int], ...] = (
    (FLUX, "the optimiser is given twice the limit", limit_ignored, (), 3),
    (FLUX, "beams pass one another above the limit", way_unchecked, (), 10),
    (FLUX, "the ramp is forgotten", ramp_forgotten, (), 10),
    (ORIGIN, "beams are sent beside the aims that were chosen", aims_shifted, (), 0),
)  # fmt: skip
