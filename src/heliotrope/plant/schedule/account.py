"""Visits that were made, beside what was expected of them."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from heliotrope.calibration.sightings import Sightings
from heliotrope.plant.visits.calibration_cycle import CycleResult

#: A beam that was so many times as far off as expected says that its heliostat has changed.
SURPRISE = 3.0


@dataclass(frozen=True)
class Assignment:
    """A heliostat to be photographed on a target.

    Attributes
    ----------
    heliostat, target
        Names.
    at, until
        Beginning and expected end, unix s.
    before, after
        Expected beam error over the year before and after it, rad RMS (2-D).
    predicted
        Expected beam error at the photograph, the noise of the camera included, rad RMS (2-D).
    seen
        Chance that the beam is wholly on the target at the first look.
    overdue
        Whether it is due for its age and not for its gain.
    reason
        In words.
    """

    heliostat: str
    target: str
    at: float
    until: float
    before: float
    after: float
    predicted: float
    seen: float
    overdue: bool
    reason: str

    @property
    def gain(self) -> float:
        """Expected fall of the beam error over the year, rad."""
        return self.before - self.after


@dataclass(frozen=True)
class Visited:
    """What became of an assignment.

    Attributes
    ----------
    heliostat, target
        Names.
    ended
        unix s.
    calibrated
        Whether the heliostat's parameters rest on its sightings now.
    sightings
        All that are known of it (heliostat row 0), None if there are none.
    measured
        Beam error of the photographs of this visit as the parameters before it had them, rad RMS
        (2-D); NaN if none could be used.
    text
        In words.
    """

    heliostat: str
    target: str
    ended: float
    calibrated: bool
    sightings: Sightings | None = None
    measured: float = float("nan")
    text: str = ""

    @classmethod
    def of(
        cls, result: CycleResult, target: str, ended: float, measured: float | None = None
    ) -> "Visited":
        """Return what a calibration cycle says of its visit.

        Parameters
        ----------
        result
            Of the cycle.
        target
            Its name.
        ended
            unix s.
        measured
            See `Visited`; default what the result says, over all sightings: right at a first
            visit, and too small for a mirror that has changed.
        """
        good = result.text.startswith("calibrated")
        error = result.before if measured is None else measured
        return cls(result.heliostat, target, ended, good, result.sightings, error, result.text)


@dataclass(frozen=True)
class Finished:
    """An assignment and what became of it."""

    planned: Assignment
    visited: Visited

    @property
    def surprise(self) -> bool:
        """Whether the heliostat was far more off than expected."""
        return bool(self.visited.measured > SURPRISE * self.planned.predicted)


@dataclass(frozen=True)
class Comparison:
    """Finished visits beside the prediction.

    Attributes
    ----------
    visits, calibrated
        How many were made, and how many brought parameters.
    measured, predicted
        Root mean square of the beam errors found at the photographs and of those that were
        expected, over visits with both, rad (2-D); NaN if there are none.
    longer
        Mean time of a visit over the expected one; NaN without visits.
    surprises
        Heliostats that were found more than `SURPRISE` times as far off as expected.
    """

    visits: int
    calibrated: int
    measured: float
    predicted: float
    longer: float
    surprises: tuple[str, ...]

    @property
    def ratio(self) -> float:
        """Measured over predicted error: near 1 if the prediction can be believed."""
        return self.measured / self.predicted

    @property
    def text(self) -> str:
        """One line."""
        if not self.visits:
            return "no visits"
        head = f"{self.visits} visits, {self.calibrated} calibrated"
        if not np.isfinite(self.ratio):
            return f"{head}; no error could be compared"
        return (
            f"{head}; beam error found {1e3 * self.measured:.2f} mrad, expected "
            f"{1e3 * self.predicted:.2f} mrad, ratio {self.ratio:.2f}; "
            f"{len(self.surprises)} surprises"
        )


def compare(finished: Iterable[Finished]) -> Comparison:
    """Return what finished visits were beside what was expected of them."""
    made = list(finished)
    both = [f for f in made if np.isfinite(f.visited.measured)]
    nan = float("nan")

    def rms(values: list[float]) -> float:
        return float(np.sqrt(np.mean(np.square(values)))) if values else nan

    spans = [
        (f.visited.ended - f.planned.at) / (f.planned.until - f.planned.at)
        for f in made
        if f.planned.until > f.planned.at
    ]
    return Comparison(
        visits=len(made),
        calibrated=sum(f.visited.calibrated for f in made),
        measured=rms([f.visited.measured for f in both]),
        predicted=rms([f.planned.predicted for f in both]),
        longer=float(np.mean(spans)) if spans else nan,
        surprises=tuple(f.planned.heliostat for f in both if f.surprise),
    )
