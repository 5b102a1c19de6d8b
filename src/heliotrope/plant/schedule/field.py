"""How well all heliostats of a plant are known, group by group, in one order of rows."""

from collections.abc import Sequence
from copy import copy

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.sightings import Sightings
from heliotrope.errors import InputError
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.plant.schedule.knowledge import Knowledge, Look
from heliotrope.plant.schedule.settings import Settings
from heliotrope.plant.schedule.sight import neighbours


class FieldKnowledge:
    """Of N heliostats.

    Parameters
    ----------
    design
        The plant.
    settings
        Of the schedule.
    names
        Order of the rows.
    begin, year
        When the age of the never calibrated begins, unix s; whose suns count.

    Attributes
    ----------
    row
        By name.
    position, size
        Feet, and width and height of the mirrors, m, (N, 3) and (N, 2).
    near
        Nearest neighbours, (N, K).

    Raises
    ------
    InputError
        Names that are not those of the design.
    """

    def __init__(
        self, design: Plant, settings: Settings, names: Sequence[str], begin: float, year: int
    ) -> None:
        if sorted(names) != sorted(design.names):
            raise InputError(
                f"schedule: {len(names)} names for {len(design)} heliostats; give each name of "
                "the design once"
            )
        self.row = {name: i for i, name in enumerate(names)}
        self._settings, self._begin, count = settings, begin, len(names)
        aim = (design.receivers or design.targets)[0].center
        groups = list(design.groups.values())
        self._groups: list[Knowledge] = [
            Knowledge(
                group,
                aim,
                design.site,
                year,
                model=settings.model,
                priors=settings.priors,
                creep=settings.creep,
            )
            for group in groups
        ]
        # Of each group the rows of its heliostats, and back.
        self._rows = [np.array([self.row[n] for n in g.names], dtype=np.intp) for g in groups]
        self.group, self._place = np.empty((2, count), dtype=np.intp)
        self.position, self.size = np.empty((count, 3)), np.empty((count, 2))
        for g, (group, rows) in enumerate(zip(groups, self._rows, strict=True)):
            self.group[rows], self._place[rows] = g, np.arange(len(rows))
            self.position[rows] = group.position
            self.size[rows] = np.stack([group.width, group.height], axis=1)
        self.near = neighbours(self.position)

    def __len__(self) -> int:
        return len(self.row)

    def copy(self) -> "FieldKnowledge":
        """Return one that can be changed without changing this."""
        other = copy(self)
        other._groups = [known.copy() for known in self._groups]  # noqa: SLF001 - its own kind
        return other

    def squares(self, now: float) -> FloatArray:
        """Return the expected squared beam errors over the year at a time, rad², (N,)."""
        found = np.empty(len(self))
        for known, rows in zip(self._groups, self._rows, strict=True):
            found[rows] = known.expected(now)
        return found

    def ages(self, now: float) -> FloatArray:
        """Return the times since the last calibration, or since the beginning, s, (N,)."""
        since = np.empty(len(self))
        for known, rows in zip(self._groups, self._rows, strict=True):
            since[rows] = known.since
        return np.asarray(now - np.where(np.isnan(since), self._begin, since))

    def calibrated(self, row: int) -> bool:
        """Whether a heliostat was ever calibrated."""
        return not np.isnan(self._groups[self.group[row]].since[self._place[row]])

    def look(
        self,
        rows: npt.NDArray[np.intp],
        now: float,
        sun: FloatArray,
        target: Target,
        counts: FloatArray | None,
    ) -> Look:
        """Return what visits of heliostats of one group would be; see `Knowledge.look`."""
        settings, known = self._settings, self._groups[int(self.group[rows[0]])]
        return known.look(
            self._place[rows],
            now,
            sun,
            target,
            settings.limits,
            shots=settings.shots,
            sigma=settings.sigma,
            counts=counts,
        )

    def assume(self, row: int, slope: FloatArray, now: float) -> None:
        """Take it that a visit of that slope (2, P) has been made."""
        self._groups[self.group[row]].assume(int(self._place[row]), slope, now)

    def learn(self, row: int, seen: Sightings, now: float) -> None:
        """Take all the sightings that a heliostat's parameters now rest on (its row is 0)."""
        self._groups[self.group[row]].learn(int(self._place[row]), seen, now)

    def doubt(self, row: int, factor: float) -> None:
        """Take a heliostat's variances to be ``factor`` times as large."""
        self._groups[self.group[row]].doubt(int(self._place[row]), factor)
