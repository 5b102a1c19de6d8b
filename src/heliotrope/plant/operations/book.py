"""What is known of every heliostat's calibration: predicted and measured errors, histories."""

from collections import deque
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.sightings import Sightings
from heliotrope.calibration.uncertainty import expected_error, precision
from heliotrope.geometry import FloatArray
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.views import CalibrationEntry, QualityPoint, SightingView

#: Points of the quality over time, and results, that are held.
_POINTS, _RESULTS = 4000, 2000
#: Heliostats that the error of the uncalibrated is judged by.
_SAMPLE = 100


class CalibrationBook:
    """Calibration of N heliostats.

    Parameters
    ----------
    plant
        Whose.
    model
        Parameters that are fitted: a name of the table, or names.

    Attributes
    ----------
    error
        Predicted standard deviation of the normal (two-dimensional) at the aim, rad, (N,).
    measured, calibrated_at, sightings
        See `FieldFrame`.
    model
        Names of the parameters.
    results, quality
        The last ones, oldest first.
    failed
        Measurements without success.
    """

    def __init__(self, plant: PlantController, model: str | tuple[str, ...]) -> None:
        count = len(plant.field)
        self._plant = plant
        group, _ = plant.design.find(plant.field.names[0])
        known = group.mechanism.parameters
        self.model = parameter_table.model(model, known) if isinstance(model, str) else model
        self.error = np.full(count, np.nan)
        self.measured = np.full(count, np.nan)
        self.calibrated_at = np.full(count, np.nan)
        self.sightings = np.zeros(count, dtype=np.int32)
        self.results: deque[CalibrationEntry] = deque(maxlen=_RESULTS)
        self.quality: deque[QualityPoint] = deque(maxlen=_POINTS)
        self.failed = 0
        self._covariance: dict[str, FloatArray] = {}
        self._values: dict[str, dict[str, float]] = {}
        self._history: dict[str, tuple[SightingView, ...]] = {}

    @property
    def calibrated(self) -> int:
        """How many heliostats have parameters from sightings."""
        return len(self._values)

    def knows(self, name: str) -> bool:
        """Whether a heliostat has parameters from sightings."""
        return name in self._values

    def note(self, name: str, target: str, seen: Sightings, old: Mechanism) -> None:
        """Take the sightings of a visit, which come after those that are known.

        Parameters
        ----------
        name, target
            Whose, where.
        seen
            All that are known (heliostat row 0), in the order of time.
        old
            The mechanism that was believed while they were taken, (1,).
        """
        row = self._plant.field.place(name)
        before = self._history.get(name, ())
        beams = beam_errors(old, seen).beam[len(before) :]
        times = seen.time[len(before) :]
        self._history[name] = before + tuple(
            SightingView(float(at), target, float(beam))
            for at, beam in zip(times, beams, strict=True)
        )
        self.sightings[row] = len(seen)
        if len(beams):
            # The normal is off by half of what the beam is.
            self.measured[row] = 0.5 * float(np.sqrt(np.mean(beams**2)))

    def learn(
        self,
        name: str,
        values: Mapping[str, float],
        mechanism: Mechanism,
        seen: Sightings,
        at: float,
    ) -> None:
        """Take new parameters of a heliostat, from all its sightings; ``mechanism`` is (1,)."""
        row = self._plant.field.place(name)
        known = precision(mechanism, self.model, seen)
        self._covariance[name] = np.linalg.inv(known)[0]
        self._values[name] = dict(values)
        self.calibrated_at[row] = at
        self.refresh((name,))

    def refresh(self, names: tuple[str, ...] | None = None) -> None:
        """Predict errors anew, for the sun and the aims of now: of some, or of all that can be."""
        chosen = tuple(self._values) if names is None else names
        light = self._plant.sun_vector()
        if not chosen or not light[2] > 0.0:
            return
        parts: dict[int, list[str]] = {}
        for name in chosen:
            parts.setdefault(id(self._plant.design.find(name)[0]), []).append(name)
        for members in parts.values():
            group = self._plant.design.find(members[0])[0]
            places = np.array([group.index(name) for name in members], dtype=np.intp)
            values = {
                p: np.array([self._values[name].get(p, 0.0) for name in members])
                for p in self._values[members[0]]
            }
            rows = np.array([self._plant.field.place(name) for name in members], dtype=np.intp)
            covariance = np.stack([self._covariance[name] for name in members])
            mechanism = group.mechanism[places].with_parameters(values)
            found = expected_error(mechanism, self.model, covariance, light, self._aims(rows))
            self.error[rows] = 0.5 * found.rms

    def _aims(self, rows: npt.NDArray[np.intp]) -> FloatArray:
        names = [self._plant.field.names[row] for row in rows]
        given = self._plant.default_aims(names)
        return np.stack([given[name] for name in names])

    def installed(self) -> float:
        """Return the tracking error that the priors allow a heliostat before, rad."""
        field = self._plant.field
        rows = np.unique(np.linspace(0, len(field) - 1, _SAMPLE).astype(np.intp))
        light = self._plant.sun_vector()
        light = light if light[2] > 0.0 else np.array([0.0, 0.0, 1.0])
        spread = []
        for row, aim in zip(rows, self._aims(rows), strict=True):
            group, place = self._plant.design.find(field.names[row])
            nominal = group.mechanism[np.array([place])]
            prior = np.linalg.inv(precision(nominal, self.model))[0]
            found = expected_error(nominal, self.model, prior, light, aim)
            spread.append(0.5 * float(found.rms[0]))
        good = np.array(spread)[np.isfinite(spread)]
        return float(np.sqrt(np.mean(good**2))) if len(good) else 0.0

    # -- looking ---------------------------------------------------------------------------

    def history(self, name: str) -> tuple[SightingView, ...]:
        """Return the sightings of a heliostat, oldest first."""
        return self._history.get(name, ())

    def results_of(self, name: str) -> tuple[CalibrationEntry, ...]:
        """Return what its calibrations said, oldest first."""
        return tuple(entry for entry in self.results if entry.heliostat == name)

    def parameters(self, name: str) -> tuple[dict[str, float], dict[str, float]]:
        """Return values and standard deviations by name; nothing before the first calibration."""
        if name not in self._values:
            return {}, {}
        sigma = np.sqrt(np.diagonal(self._covariance[name]))
        return dict(self._values[name]), dict(zip(self.model, sigma.tolist(), strict=True))

    def point(self, at: float, truth: FloatArray | None) -> None:
        """Add a point to the quality over time."""
        rows = np.isfinite(self.calibrated_at)
        if not rows.any():
            return
        nan = float("nan")
        known, true = self.error[rows], None if truth is None else truth[rows]
        median, ninety = _shares(known)
        of_truth = (nan, nan) if true is None else _shares(true)
        self.quality.append(QualityPoint(at, int(rows.sum()), median, ninety, *of_truth))


def _shares(values: FloatArray) -> tuple[float, float]:
    good = values[np.isfinite(values)]
    if not len(good):
        return float("nan"), float("nan")
    return float(np.median(good)), float(np.quantile(good, 0.9))
