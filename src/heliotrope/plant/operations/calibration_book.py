"""Calibration records for display: predicted and measured errors of every heliostat over time."""

from collections import deque
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.record import CalibrationOutcome, HeliostatCalibration
from heliotrope.calibration.uncertainty import expected_error, precision
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.views import CalibrationEntry, QualityPoint, SightingView
from heliotrope.plant.visits.expected_errors import expected_covariances, expected_errors

#: Maximum number of points of the quality history, and of results, that are kept.
_POINTS, RESULTS = 4000, 2000
#: Number of points of the quality history that are derived from earlier results.
_RECALLED = 60
#: Number of heliostats whose priors determine the error of an uncalibrated heliostat.
_SAMPLE = 100
#: Outcomes without a calibration that are not failures.
_NO_FAILURE = (CalibrationOutcome.UNCHANGED, CalibrationOutcome.TAKEN_OUT)


class CalibrationBook:
    """Records of the calibration of N heliostats, from the calibrations that the plant believes.

    Parameters
    ----------
    plant
        The controller; the book follows its `beliefs`.
    model
        Parameters that are fitted: a name of the table, or names.

    Attributes
    ----------
    error
        Predicted standard deviation of the mirror normal (two-dimensional) at the aim, rad, (N,).
        It grows with the time since the calibration.
    spread
        Covariance of the beam behind ``error``, to the right of and above the aim as seen from the
        mirror, rad², (N, 2, 2); NaN before the first calibration.
    measured, calibrated_at, sightings
        See `FieldFrame`.
    results, quality
        The last results, and the last points of the field's quality over time, oldest first.
    failed
        Number of visits without a new calibration.
    """

    def __init__(self, plant: PlantController, model: str | tuple[str, ...]) -> None:
        count = len(plant.field)
        self._plant, self._model = plant, model
        self.error = np.full(count, np.nan)
        self.spread = np.full((count, 2, 2), np.nan)
        self.measured = np.full(count, np.nan)
        self.calibrated_at = np.full(count, np.nan)
        self.sightings = np.zeros(count, dtype=np.int32)
        self.results: deque[CalibrationEntry] = deque(maxlen=RESULTS)
        self.quality: deque[QualityPoint] = deque(maxlen=_POINTS)
        self.failed = 0
        # Errors are predicted for all existing beliefs at once; one by one takes 20 times as long.
        self._believe(*plant.beliefs)
        plant.beliefs.subscribe(self._believe, held=False)

    @property
    def calibrated(self) -> int:
        """Number of heliostats with a calibration."""
        return len(self._plant.beliefs)

    def model_of(self, name: str) -> tuple[str, ...]:
        """Return the names of the parameters that are fitted for a heliostat's kind."""
        if not isinstance(self._model, str):
            return self._model
        group, _ = self._plant.design.find(name)
        return parameter_table.model(self._model, group.mechanism.parameters)

    def _believe(self, *records: HeliostatCalibration) -> None:
        for record in records:
            row = self._plant.field.place(record.heliostat)
            self.calibrated_at[row] = record.at
            self.sightings[row] = self._plant.beliefs.count(record.heliostat)
        self._predict(records)

    def conclude(self, entry: CalibrationEntry) -> None:
        """Accept the result of a visit."""
        row = self._plant.field.place(entry.heliostat)
        self.sightings[row] = entry.sightings
        if np.isfinite(entry.measured):
            # The error of the normal is half that of the beam.
            self.measured[row] = 0.5 * entry.measured
        self.failed += not (entry.good or entry.outcome in _NO_FAILURE)
        self.results.append(entry)

    def recall(self, entries: Sequence[CalibrationEntry]) -> None:
        """Accept the results of earlier programs, oldest first, and their quality over time.

        The quality is left out if the results do not cover every calibrated heliostat.
        """
        self.results.extend(entries)
        predicted: dict[str, float] = {}
        points: list[QualityPoint] = []
        every, nan = max(1, len(entries) // _RECALLED), float("nan")
        for k, entry in enumerate(entries):
            if np.isfinite(entry.predicted):
                predicted[entry.heliostat] = entry.predicted
            if predicted and (k + 1) % every == 0:
                shares = _shares(np.array([*predicted.values()]))
                points.append(QualityPoint(entry.at, len(predicted), *shares, nan, nan))
        if len(predicted) >= self.calibrated:
            self.quality.extend(points)

    def refresh(self) -> None:
        """Predict the errors of all calibrated heliostats for the present sun and aims."""
        self._predict(list(self._plant.beliefs))

    def _predict(self, records: Sequence[HeliostatCalibration]) -> None:
        if self._dark or not records:
            return
        rows = np.array([self._plant.field.place(r.heliostat) for r in records], dtype=np.intp)
        names = [record.heliostat for record in records]
        self.spread[rows] = expected_covariances(self._plant, names, self._aims(rows))
        # The error of the normal is half that of the beam.
        self.error[rows] = 0.5 * np.sqrt(np.trace(self.spread[rows], axis1=-2, axis2=-1))

    def error_on(self, target: Target, rows: npt.NDArray[np.intp]) -> FloatArray:
        """Return the expected errors of n beams on a target now, rad RMS (2-D), (n,).

        The error is NaN for heliostats without a calibration, and for all while the sun is down.
        """
        if self._dark:
            return np.full(len(rows), np.nan)
        names = [self._plant.field.names[row] for row in rows]
        return expected_errors(self._plant, names, np.broadcast_to(target.center, (len(rows), 3)))

    @property
    def _dark(self) -> bool:
        return not self._plant.sun_vector()[2] > 0.0

    def _aims(self, rows: npt.NDArray[np.intp]) -> FloatArray:
        names = [self._plant.field.names[row] for row in rows]
        given = self._plant.default_aims(names)
        return np.array([given[name] for name in names], dtype=np.float64).reshape(-1, 3)

    def installed(self) -> float:
        """Return the tracking error that the priors predict for an uncalibrated heliostat, rad."""
        field = self._plant.field
        rows = np.unique(np.linspace(0, len(field) - 1, _SAMPLE).astype(np.intp))
        light = self._plant.sun_vector()
        light = light if light[2] > 0.0 else np.array([0.0, 0.0, 1.0])
        spread = []
        for row, aim in zip(rows, self._aims(rows), strict=True):
            nominal, model = (
                self._plant.beliefs.nominal(field.names[row]),
                self.model_of(field.names[row]),
            )
            prior = np.linalg.inv(precision(nominal, model))[0]
            found = expected_error(nominal, model, prior, light, aim)
            spread.append(0.5 * float(found.rms[0]))
        good = np.array(spread)[np.isfinite(spread)]
        return float(np.sqrt(np.mean(good**2))) if len(good) else 0.0

    # -- views -----------------------------------------------------------------------------

    def history(self, name: str) -> tuple[SightingView, ...]:
        """Return the sightings of a heliostat since the start, oldest first."""
        seen = self._plant.beliefs.known(name)
        if seen is None:
            return ()
        columns = zip(seen.sightings.time, seen.targets, seen.missed, strict=True)
        return tuple(
            SightingView(float(at), target, float(missed))
            for at, target, missed in columns
            if np.isfinite(missed)
        )

    def results_of(self, name: str) -> tuple[CalibrationEntry, ...]:
        """Return the results of a heliostat's visits, oldest first."""
        return tuple(entry for entry in self.results if entry.heliostat == name)

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
    """Return the median and the 90th percentile of the finite values."""
    good = values[np.isfinite(values)]
    if not len(good):
        return float("nan"), float("nan")
    return float(np.median(good)), float(np.quantile(good, 0.9))
