"""How well a field was learnt: errors of the held-out sightings."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.evaluation import ErrorSummary, summarise
from heliotrope.calibration.learn.learning import Learned, Prediction, predict
from heliotrope.calibration.sightings import ray_directions
from heliotrope.errors import InputError
from heliotrope.mechanism.axis_accuracy import AxisAccuracy, axis_accuracy
from heliotrope.mechanism.tracking import track

#: Distance at which an aim stands for a direction, m.
FAR = 1e6
#: Heliostats with fewer sightings are listed but do not enter the overall figures.
ENOUGH = 20


@dataclass(frozen=True)
class HeliostatFigures:
    """Figures of one heliostat.

    Attributes
    ----------
    name
        Name of the heliostat.
    count
        Number of sightings, training and held out together.
    beam, normal
        Errors of the held-out sightings, rad.
    mean
        Mean beam error of the held-out sightings, rad.
    coverage
        Share of the held-out sightings within their 90 % ellipse.
    axes
        Zeros of azimuth and elevation before the fit (of the first and second axis where there is
        no azimuth) and their scatter after it, Guo (43)-(47); None with fewer than two held-out
        sightings, for a single axis, or where a mistake puts an axis over the top.
    outliers, regimes, steps
        Numbers in the training part.
    """

    name: str
    count: int
    beam: ErrorSummary
    normal: ErrorSummary
    mean: float
    coverage: float
    axes: AxisAccuracy | None
    outliers: int
    regimes: int
    steps: int

    def document(self) -> dict[str, Any]:
        """Return the figures for JSON, in mrad."""
        found: dict[str, Any] = {
            "n": self.count,
            "n_held_out": self.beam.count,
            "median_beam_mrad": 1e3 * self.beam.median,
            "mean_beam_mrad": 1e3 * self.mean,
            "rms_beam_mrad": 1e3 * self.beam.rms,
            "p95_beam_mrad": 1e3 * self.beam.p95,
            "median_normal_mrad": 1e3 * self.normal.median,
            "rms_normal_mrad": 1e3 * self.normal.rms,
            "p95_normal_mrad": 1e3 * self.normal.p95,
            "coverage_90": self.coverage,
            "outliers": self.outliers,
            "regimes": self.regimes,
            "steps": self.steps,
        }
        if self.axes is not None:
            found["gamma_0_mrad"] = 1e3 * float(self.axes.gamma_0)
            found["sigma_gamma_mrad"] = 1e3 * float(self.axes.sigma_gamma)
            found["alpha_0_mrad"] = 1e3 * float(self.axes.alpha_0)
            found["sigma_alpha_mrad"] = 1e3 * float(self.axes.sigma_alpha)
        return found


@dataclass(frozen=True)
class Assessment:
    """Figures of a field.

    Attributes
    ----------
    heliostats
        Heliostats with sightings.
    median_of_medians, mean_of_means
        Beam errors over the heliostats with `ENOUGH` sightings, rad.
    coverage
        Share of all their held-out sightings within the 90 % ellipse.
    beam
        Errors of all their held-out sightings, rad.
    fewest
        Fewest sightings of a heliostat in the overall figures: `ENOUGH`, or 0 if no heliostat
        has that many.
    blunders
        Number of held-out sightings more than `BLUNDER` standard deviations away; they enter
        every figure.
    """

    heliostats: tuple[HeliostatFigures, ...]
    median_of_medians: float
    mean_of_means: float
    coverage: float
    beam: ErrorSummary
    fewest: int
    blunders: int

    def document(self) -> dict[str, Any]:
        """Return the figures for JSON, in mrad."""
        return {
            "heliostats": {h.name: h.document() for h in self.heliostats},
            "median_of_medians_mrad": 1e3 * self.median_of_medians,
            "mean_of_means_mrad": 1e3 * self.mean_of_means,
            "coverage_90": self.coverage,
            "median_beam_mrad": 1e3 * self.beam.median,
            "rms_beam_mrad": 1e3 * self.beam.rms,
            "p95_beam_mrad": 1e3 * self.beam.p95,
            "blunders_held_out": self.blunders,
            "enough": self.fewest,
        }


#: Distance beyond which a Gaussian puts fewer than one sighting in a million, standard deviations.
BLUNDER = 5.3


def assess(names: tuple[str, ...], learned: Learned) -> Assessment:
    """Return the errors of the sightings that were not used in learning.

    Parameters
    ----------
    names
        Names of the N heliostats.
    learned
        Learnt from a part of its sightings.
    """
    rows = np.flatnonzero(~learned.used)
    seen = learned.sightings.take(rows)
    found = predict(learned, seen)
    counts = np.bincount(learned.sightings.heliostat, minlength=len(names))
    figures = [
        _one(names[i], int(i), int(counts[i]), learned, found, np.flatnonzero(seen.heliostat == i))
        for i in np.flatnonzero(counts)
    ]
    tested = [h for h in figures if h.beam.count]
    fewest = ENOUGH if any(h.count >= ENOUGH for h in tested) else 0
    enough = [h for h in tested if h.count >= fewest]
    inside = np.isin(seen.heliostat, [names.index(h.name) for h in enough])
    far = np.sum(
        found.plane * np.linalg.solve(found.covariance, found.plane[:, :, None])[..., 0], axis=-1
    )
    return Assessment(
        tuple(figures),
        float(np.median([h.beam.median for h in enough])) if enough else np.nan,
        float(np.mean([h.mean for h in enough])) if enough else np.nan,
        float(found.inside[inside].mean()) if inside.any() else np.nan,
        summarise(found.errors.beam[inside]),
        fewest,
        int((far[inside] > BLUNDER**2).sum()),
    )


def _one(
    name: str,
    i: int,
    count: int,
    learned: Learned,
    found: Prediction,
    rows: npt.NDArray[np.intp],
) -> HeliostatFigures:
    mine = learned.sightings.heliostat == i
    beam = found.errors.beam[rows]
    return HeliostatFigures(
        name=name,
        count=count,
        beam=summarise(beam),
        normal=summarise(found.errors.normal[rows]),
        mean=float(beam.mean()) if len(rows) else np.nan,
        coverage=float(found.inside[rows].mean()) if len(rows) else np.nan,
        axes=_axes(learned, np.flatnonzero(~learned.used)[rows]) if len(rows) > 1 else None,
        outliers=int(learned.outlier[mine].sum()),
        regimes=len(np.unique(learned.regime[mine & (learned.regime >= 0)])),
        steps=len(learned.members[i].data.steps),
    )


def _axes(learned: Learned, rows: npt.NDArray[np.intp]) -> AxisAccuracy | None:
    """Return the zeros before the fit and the scatter after it, of sightings ``rows``.

    Guo's γ', α' are the drives' angles: those of the nominal drives for the zeros, (44) and
    (46), so that a zero is found as such and not what the fit leaves of it; those of the
    learnt drives for the scatter, (45) and (47). His γ, α, (43), are the angles at which the
    learnt mechanism sends the source to the destination that was seen.
    """
    seen = learned.sightings.take(rows)
    learnt = learned.mechanism_at(seen.heliostat, seen.time)
    vertex = learnt.pose(seen.counts).vertex
    source, way = ray_directions(seen, vertex)
    aim = np.where(seen.destination_at_infinity[:, None], vertex + FAR * way, seen.destination)
    solved = track(learnt, source, aim, current=seen.counts)
    good = solved.chosen(solved.reachable)
    driven = [learnt.joints[j] for j in learnt.driven]
    if good.sum() < 2 or len(driven) != 2:
        return None
    gamma = driven.index("azimuth") if "azimuth" in driven else 0
    alpha = 1 - gamma
    computed = solved.chosen(solved.angles)[good]
    found = []
    for mechanism in (learned.mechanism[seen.heliostat], learnt):
        angles = mechanism.drives.angles(seen.counts)[good]
        try:
            found.append(
                axis_accuracy(
                    angles[:, alpha], angles[:, gamma], computed[:, alpha], computed[:, gamma]
                )
            )
        except InputError:
            # A mistaken sighting may lie over the top; its axes say nothing.
            return None
    before, after = found
    return replace(after, gamma_0=before.gamma_0, alpha_0=before.alpha_0)
