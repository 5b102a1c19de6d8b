"""The field of a plant at work as one table, made at most once a second."""

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from heliotrope.field.target import Receiver, Target
from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.views import STALE_STATE, FieldFrame

if TYPE_CHECKING:
    from heliotrope.plant.operations.work import Automat

#: A frame is good for so long, s of the plant's clock.
_EVERY = 1.0
#: In these states a beam is at its aim.
_ON_AIM = (states.TRACKING, states.SEARCHING)
#: An aim this many half diagonals from the middle of a surface is still at it.
_NEAR = 1.0


class FrameMaker:
    """Makes frames of a field.

    Parameters
    ----------
    plant
        Whose.
    work
        What is known of each heliostat's calibration.

    Attributes
    ----------
    positions, sizes
        ENU, m, (N, 3); width and height, m, (N, 2).
    aim_names
        What beams can be on: "" for nothing, receivers, targets, "elsewhere".
    """

    def __init__(self, plant: PlantController, work: "Automat") -> None:
        self._plant, self._work = plant, work
        design, names = plant.design, plant.field.names
        place = {name: i for i, name in enumerate(design.names)}
        rows = np.array([place[name] for name in names], dtype=np.intp)
        groups = design.groups.values()
        self.positions: FloatArray = _fixed(np.asarray(design.position)[rows])
        sizes = [np.concatenate([getattr(g, what) for g in groups]) for what in ("width", "height")]
        self.sizes: FloatArray = _fixed(np.stack(sizes, axis=-1)[rows])
        surfaces: tuple[Receiver | Target, ...] = (*design.receivers, *design.targets)
        self.aim_names = ("", *(surface.name for surface in surfaces), "elsewhere")
        self._centers = [surface.center for surface in surfaces]
        self._reach = [_NEAR * 0.5 * np.hypot(s.width, s.height) for s in surfaces]
        self._frame: FieldFrame | None = None
        self._made_at = -np.inf
        self._number = 0

    def frame(self) -> FieldFrame:
        """Return the present frame."""
        now = self._plant.now()
        if self._frame is None or now - self._made_at >= _EVERY:
            self._frame, self._made_at = self._make(now), now
        return self._frame

    def _make(self, now: float) -> FieldFrame:
        plant, book = self._plant, self._work.book
        field = plant.field
        live, rows = field.live(now), field.rows
        self._number += 1
        truth = self._work.truth_errors()
        counts = np.stack([rows["primary"], rows["secondary"]], axis=-1)
        return FieldFrame(
            self._number,
            plant.clock.utc().timestamp(),
            _fixed(np.where(live, rows["state"], STALE_STATE).astype(np.uint8)),
            _fixed(np.where(live, rows["fault"], 0).astype(np.uint8)),
            _fixed(np.where(live, rows["flags"], 0).astype(np.uint32)),
            _fixed(field.age(now).astype(np.float32)),
            _fixed(counts.astype(np.int32)),
            _fixed(book.error.astype(np.float32)),
            _fixed(book.measured.astype(np.float32)),
            _fixed(book.calibrated_at.copy()),
            _fixed(book.sightings.copy()),
            _fixed(field.cluster.astype(np.int16)),
            _fixed(self._on(now)),
            _fixed(self._work.held_rows()),
            None if truth is None else _fixed(truth.astype(np.float32)),
        )

    def _on(self, now: float) -> npt.NDArray[np.uint8]:
        """Return what each beam is on, as a place in `aim_names`, (N,)."""
        aims, found = self._plant.aims, np.zeros(len(self._plant.field), dtype=np.uint8)
        on = self._plant.field.among(_ON_AIM, now) & np.isfinite(aims).all(axis=-1)
        found[on] = len(self.aim_names) - 1
        for k, (center, reach) in enumerate(zip(self._centers, self._reach, strict=True), 1):
            found[on & (np.linalg.norm(aims - center, axis=-1) <= reach)] = k
        return found

    def on_name(self, row: int) -> str:
        """Return what one heliostat's beam is on."""
        return str(self.aim_names[int(self.frame().on[row])])

    def beams(self, name: str) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return vertices, aims, areas and errors of the beams on a receiver."""
        frame = self.frame()
        rows = np.flatnonzero(frame.on == self.aim_names.index(name))
        error = np.where(np.isfinite(frame.error), frame.error, self._work.installed)[rows]
        vertices = self._plant.beams.armature.origin_1[rows]
        area = np.prod(self.sizes[rows], axis=-1)
        return vertices, self._plant.aims[rows], area, error.astype(np.float64)


def _fixed(array: Any) -> Any:
    """Return an array that nobody can change."""
    made = np.asarray(array)
    made.setflags(write=False)
    return made
