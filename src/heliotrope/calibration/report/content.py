"""Content of a calibration report: the results for every heliostat, computed once."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from heliotrope.calibration.clock import ClockCheck
from heliotrope.calibration.evaluation import BeamErrors, ErrorSummary, beam_errors, summarise
from heliotrope.calibration.fit.estimator import FitOutcome
from heliotrope.calibration.learn.assessment import Assessment, unexplained_mirrors
from heliotrope.calibration.learn.learned import Learned, left_out_errors
from heliotrope.calibration.report.results import FieldParameters, at_moment
from heliotrope.calibration.uncertainty import BlindSpot, unobservable
from heliotrope.errors import InputError
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.guo_names import in_his_names, of_mechanism
from heliotrope.mechanism.parameters import MODELS


@dataclass(frozen=True)
class HeliostatRow:
    """Beam errors of one heliostat, rad: before and after calibration, and held out."""

    index: int
    name: str
    before: ErrorSummary
    after: ErrorSummary
    held: ErrorSummary
    outliers: int
    outcome: FitOutcome


@dataclass(frozen=True)
class CalibrationReport:
    """A calibration with everything that its report shows.

    Attributes
    ----------
    names
        Names of the N heliostats.
    learned
        The field, learnt from all sightings.
    plant, group
        The plant, and the name of the group of these heliostats.
    assessment
        Results of a second learning run with part of the sightings held out; None if there was no
        second run.
    ids
        Name of each sighting, for the list of outliers.
    left_out
        One line for each measurement that could not be used.
    note
        How the held-out part was chosen.
    comparison
        Lines that compare the models.
    clock
        The common clock error, if it could be tested.
    notes
        Notes on contradictions that affect most of the sightings.
    """

    names: tuple[str, ...]
    learned: Learned
    plant: Plant
    group: str
    assessment: Assessment | None = None
    ids: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    note: str = ""
    comparison: tuple[str, ...] = ()
    clock: ClockCheck | None = None
    notes: tuple[str, ...] = ()

    @cached_property
    def _applied(self) -> tuple[Plant, tuple[str, ...]]:
        return self.results.applied_to(self.plant)

    @property
    def calibrated(self) -> Plant:
        """The plant with the learnt parameters; see `FieldParameters.applied_to`."""
        return self._applied[0]

    @cached_property
    def remarks(self) -> tuple[str, ...]:
        """Notes on the clock, contradictions, and heliostats that do not fit or were not learnt.

        Notes that call the result into question come first.
        """
        kept = self._applied[1]
        if self.clock is not None and self.clock.found:
            # The errors caused by a wrong clock are not faults of single heliostats.
            return (str(self.clock), *self.notes, *kept)
        clock = () if self.clock is None else (str(self.clock),)
        return (*self.notes, *unexplained_mirrors(self.names, self.learned), *kept, *clock)

    @cached_property
    def results(self) -> FieldParameters:
        """The parameters at the time of the last sighting."""
        return at_moment(self.names, self.learned)

    @cached_property
    def before(self) -> BeamErrors:
        """Errors with the nominal mechanisms."""
        return beam_errors(self.learned.mechanism, self.learned.sightings)

    @cached_property
    def after(self) -> FloatArray:
        """Error of each beam predicted from the other sightings, rad right and up, (M, 2)."""
        return left_out_errors(self.learned)

    @cached_property
    def distance(self) -> FloatArray:
        """Distance from mirror to destination, m; 1 if the destination is at infinity, (M,)."""
        s = self.learned.sightings
        path = s.destination - self.learned.mechanism[s.heliostat].pose(s.counts).vertex
        return np.where(s.destination_at_infinity, 1.0, np.linalg.norm(path, axis=-1))

    @property
    def targets(self) -> FloatArray:
        """Centres of the targets, (K, 3)."""
        return np.array([t.center for t in self.plant.targets]).reshape(-1, 3)

    @property
    def aim(self) -> FloatArray:
        """Aim point for the year map: the first target, or the mean destination."""
        if len(self.targets):
            return np.asarray(self.targets[0])
        s = self.learned.sightings
        return np.asarray(np.mean(s.destination[~s.destination_at_infinity], axis=0))

    @cached_property
    def rows(self) -> tuple[HeliostatRow, ...]:
        """Results for the heliostats that have sightings."""
        held = {h.name: h.beam for h in self.assessment.heliostats} if self.assessment else {}
        size = np.linalg.norm(self.after, axis=-1)
        nothing = summarise(np.empty(0))
        rows = []
        for i, name in enumerate(self.names):
            mine = self.learned.sightings.heliostat == i
            if mine.any():
                row = HeliostatRow(
                    i,
                    name,
                    summarise(self.before.beam[mine]),
                    summarise(size[mine]),
                    held.get(name, nothing),
                    int(self.learned.outlier[mine].sum()),
                    FitOutcome(int(self.learned.static.outcome[i])),
                )
                rows.append(row)
        return tuple(rows)

    def blind_spots(self, i: int) -> tuple[BlindSpot, ...]:
        """Return the parameter combinations that heliostat ``i``'s sightings leave undetermined."""
        r, count = self.results, len(self.learned.model)
        line = self.aim - self.learned.mechanism.position[i]
        covariance = r.covariance[i][:count, :count]
        return unobservable(r.names[:count], covariance, self.learned.hyper.spread[:count], line)

    @cached_property
    def guo(self) -> dict[str, dict[str, float]] | None:
        """Guo's six parameters per heliostat with sightings, degrees; None for other models.

        The six parameters describe the complete mechanism, in the ranges of `regularise`.
        Parameters that only drift (`canting_secondary`) are not included.
        """
        r = self.results
        if not set(r.model) <= set(MODELS["guo6"]) or not r.learnt.any():
            return None
        moved = self.learned.mechanism.with_parameters(
            {name: r.values[:, r.names.index(name)] for name in r.model}
        )
        try:
            parameters = in_his_names(of_mechanism(moved, zeros=True)[0])
        except InputError:
            return None
        return {
            row.name: {
                f"{n}_deg": float(parameters[n][row.index]) for n in parameters if n != "H_z"
            }
            for row in self.rows
            if r.learnt[row.index]
        }

    def document(self) -> dict[str, Any]:
        """Return the results as a JSON object."""
        results = self.results
        tested = {h.name: h for h in self.assessment.heliostats} if self.assessment else {}
        heliostats = {
            row.name: {
                "n": row.before.count,
                "outliers": row.outliers,
                "before_median_beam_mrad": 1e3 * row.before.median,
                "after_median_beam_mrad": 1e3 * row.after.median,
                "after_rms_beam_mrad": 1e3 * row.after.rms,
                "n_held_out": row.held.count,
                "held_out_median_beam_mrad": 1e3 * row.held.median,
                "held_out_rms_beam_mrad": 1e3 * row.held.rms,
                "held_out_p95_beam_mrad": 1e3 * row.held.p95,
                "held_out_coverage_90": tested[row.name].coverage if row.name in tested else None,
                "outcome": row.outcome.name.lower(),
                "parameters": dict(
                    zip(results.names, results.values[row.index].tolist(), strict=True)
                ),
                "sigma": dict(zip(results.names, results.sigma[row.index].tolist(), strict=True)),
            }
            for row in self.rows
        }
        document: dict[str, Any] = {
            "model": list(self.learned.model),
            "heliostats": heliostats,
            "clock": None if self.clock is None else self.clock.document(),
            "remarks": list(self.remarks),
        }
        if self.assessment is not None:
            document["held_out_median_of_medians_mrad"] = 1e3 * self.assessment.median_of_medians
            document["held_out_coverage_90"] = self.assessment.coverage
        if self.guo is not None:
            document["guo"] = self.guo
        return document
