"""Assess how well a field was learnt, from the errors of the held-out sightings."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.evaluation import ErrorSummary, summarise
from heliotrope.calibration.learn.learned import (
    Learned,
    Prediction,
    moved_by,
    predict,
    squared_distance,
)
from heliotrope.calibration.learn.learning import FEWEST
from heliotrope.calibration.learn.misfits import ELSEWHERE, SCATTERED
from heliotrope.calibration.sightings import Sightings, ray_directions
from heliotrope.errors import InputError
from heliotrope.frames import Framed, Labelled, Variable
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.axis_accuracy import AxisAccuracy, axis_accuracy
from heliotrope.mechanism.tracking import track

#: Distance of an aim point that represents a direction, m.
FAR = 1e6
#: Heliostats with fewer sightings are listed but do not enter the overall figures.
ENOUGH = 20
#: A heliostat is named if at least this share of its sightings is unexplained; beyond the second
#: share, nothing agrees.
SHARE, NOTHING = 0.15, 0.6
#: Maximum number of heliostats named per reason. A value is named if it is more than this many
#: prior standard deviations from nominal.
NAMED, STRAINED = 8, 10.0


@dataclass(frozen=True)
class HeliostatFigures:
    """Results for one heliostat.

    Attributes
    ----------
    name
        Name of the heliostat.
    count
        Number of sightings, training and held-out together.
    beam, normal
        Errors of the held-out sightings, rad.
    mean
        Mean beam error of the held-out sightings, rad.
    coverage
        Fraction of the held-out sightings within their 90 % ellipse.
    axes
        Offsets of azimuth and elevation before the fit (of the first and second axis if there is no
        azimuth) and their scatter after the fit, Guo (43)-(47); None with fewer than two held-out
        sightings, for a single axis, or where a faulty sighting puts an axis over the top.
    outliers, regimes, steps
        Counts in the training part.
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
        """Return the results in mrad, as a JSON object."""
        figures: dict[str, Any] = {
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
            figures["gamma_0_mrad"] = 1e3 * float(self.axes.gamma_0)
            figures["sigma_gamma_mrad"] = 1e3 * float(self.axes.sigma_gamma)
            figures["alpha_0_mrad"] = 1e3 * float(self.axes.alpha_0)
            figures["sigma_alpha_mrad"] = 1e3 * float(self.axes.sigma_alpha)
        return figures


@dataclass(frozen=True)
class Assessment(Framed):
    """Results for a field.

    Attributes
    ----------
    heliostats
        Results for the heliostats with sightings.
    median_of_medians, mean_of_means
        Beam errors over the heliostats with at least `ENOUGH` sightings, rad.
    coverage
        Fraction of all their held-out sightings within the 90 % ellipse.
    beam
        Errors of all their held-out sightings, rad.
    fewest
        Minimum number of sightings for a heliostat to enter the overall results: `ENOUGH`, or 0 if
        no heliostat has that many.
    blunders
        Number of held-out sightings more than `BLUNDER` standard deviations away; they enter every
        result except ``mean_explained``.
    unexplained
        Indices of the held-out sightings that no mechanism explains, that is, more than `BLUNDER`
        standard deviations and more than `ELSEWHERE` away.
    mean_explained
        ``mean_of_means`` without these sightings, rad.
    unusable
        Indices of sightings beyond the reach of the drives; they enter no result.
    """

    heliostats: tuple[HeliostatFigures, ...]
    median_of_medians: float
    mean_of_means: float
    coverage: float
    beam: ErrorSummary
    fewest: int
    blunders: int
    unexplained: npt.NDArray[np.intp]
    mean_explained: float
    unusable: npt.NDArray[np.intp]

    def _labelled(self) -> Labelled:
        row = ("heliostat",)
        documents = [h.document() for h in self.heliostats]
        units = {"mrad": "mrad"}
        names = [
            n
            for n in (documents[0] if documents else {})
            if all(n in document for document in documents)
        ]
        return Labelled(
            row,
            {"heliostat": [h.name for h in self.heliostats]},
            {
                n: Variable(
                    row, np.array([document[n] for document in documents]), units.get(n[-4:], "")
                )
                for n in names
            },
        )

    def document(self) -> dict[str, Any]:
        """Return the results in mrad, as a JSON object."""
        return {
            "heliostats": {h.name: h.document() for h in self.heliostats},
            "median_of_medians_mrad": 1e3 * self.median_of_medians,
            "mean_of_means_mrad": 1e3 * self.mean_of_means,
            "coverage_90": self.coverage,
            "median_beam_mrad": 1e3 * self.beam.median,
            "rms_beam_mrad": 1e3 * self.beam.rms,
            "p95_beam_mrad": 1e3 * self.beam.p95,
            "blunders_held_out": self.blunders,
            "unexplained_held_out": len(self.unexplained),
            "mean_of_means_explained_mrad": 1e3 * self.mean_explained,
            "unusable": len(self.unusable),
            "enough": self.fewest,
        }


#: Fewer than one Gaussian sighting in a million lies beyond this many standard deviations.
BLUNDER = 5.3


def assess(
    names: tuple[str, ...],
    learned: Learned,
    prediction: Prediction | None = None,
    tested: npt.NDArray[np.bool_] | None = None,
) -> Assessment:
    """Return the errors of sightings that were not used in learning.

    Parameters
    ----------
    names
        Names of the N heliostats.
    learned
        Field learnt from a part of its sightings.
    prediction
        Prediction of the tested sightings, in their order, if already computed.
    tested
        Mask of the sightings to test on, (M,); by default all that were not used in learning.
    """
    rows = np.flatnonzero(~learned.used if tested is None else tested)
    sightings = learned.sightings.take(rows)
    if prediction is None:
        prediction = predict(learned, sightings)
    fits = ~np.isin(sightings.heliostat, [misfit.row for misfit in learned.misfits])
    beyond = rows[fits & ~prediction.usable]
    prediction = replace(prediction, usable=prediction.usable & fits)
    counts = np.bincount(learned.sightings.heliostat, minlength=len(names))
    figures = [
        _figures_of(
            names[i],
            int(i),
            int(counts[i]),
            learned,
            prediction,
            np.flatnonzero((sightings.heliostat == i) & prediction.usable),
            sightings,
        )
        for i in np.flatnonzero(counts)
    ]
    judged = [h for h in figures if h.beam.count]
    fewest = ENOUGH if any(h.count >= ENOUGH for h in judged) else 0
    enough = [h for h in judged if h.count >= fewest]
    inside = prediction.usable & np.isin(sightings.heliostat, [names.index(h.name) for h in enough])
    far = squared_distance(prediction.plane, prediction.covariance) > BLUNDER**2
    unexplained = inside & far & (prediction.errors.beam > ELSEWHERE)
    means = [
        prediction.errors.beam[(sightings.heliostat == names.index(h.name)) & inside & ~unexplained]
        for h in enough
    ]
    means = [m for m in means if len(m)]
    unusable = learned.unusable.copy()
    unusable[beyond] = True
    return Assessment(
        tuple(figures),
        float(np.median([h.beam.median for h in enough])) if enough else np.nan,
        float(np.mean([h.mean for h in enough])) if enough else np.nan,
        float(prediction.inside[inside].mean()) if inside.any() else np.nan,
        summarise(prediction.errors.beam[inside]),
        fewest,
        int(far[inside].sum()),
        rows[unexplained],
        float(np.mean([m.mean() for m in means])) if means else np.nan,
        np.flatnonzero(unusable),
    )


def _figures_of(
    name: str,
    i: int,
    count: int,
    learned: Learned,
    prediction: Prediction,
    rows: npt.NDArray[np.intp],
    sightings: Sightings,
) -> HeliostatFigures:
    mine = learned.sightings.heliostat == i
    beam = prediction.errors.beam[rows]
    return HeliostatFigures(
        name=name,
        count=count,
        beam=summarise(beam),
        normal=summarise(prediction.errors.normal[rows]),
        mean=float(beam.mean()) if len(rows) else np.nan,
        coverage=float(prediction.inside[rows].mean()) if len(rows) else np.nan,
        axes=_axes(learned, prediction.values[rows], sightings.take(rows))
        if len(rows) > 1
        else None,
        outliers=int(learned.outlier[mine].sum()),
        regimes=len(np.unique(learned.regime[mine & (learned.regime >= 0)])),
        steps=len(learned.members[i].data.steps),
    )


def _axes(learned: Learned, values: FloatArray, sightings: Sightings) -> AxisAccuracy | None:
    """Return the zeros before the fit and the scatter after it, from held-out sightings.

    Guo's γ', α' are drive angles. For the zeros, (44) and (46), they are the angles of the nominal
    drives, so that the zero itself is found and not what is left of it after the fit. For the
    scatter, (45) and (47), they are the angles of the learnt drives. His γ, α, (43), are the angles
    at which the learnt mechanism reflects the source to the observed destination.
    """
    learned_mirrors = moved_by(learned.mechanism, sightings.heliostat, learned.names, values)
    vertex = learned_mirrors.pose(sightings.counts).vertex
    source, destination = ray_directions(sightings, vertex)
    aim = np.where(
        sightings.destination_at_infinity[:, None],
        vertex + FAR * destination,
        sightings.destination,
    )
    solved = track(learned_mirrors, source, aim, current=sightings.counts)
    good = solved.reachable
    driven = [learned_mirrors.joints[j] for j in learned_mirrors.driven]
    if good.sum() < 2 or len(driven) != 2:
        return None
    gamma = driven.index("azimuth") if "azimuth" in driven else 0
    alpha = 1 - gamma
    computed = solved.best_angles[good]
    accuracies = []
    for mechanism in (learned.mechanism[sightings.heliostat], learned_mirrors):
        angles = mechanism.drives.angles(sightings.counts)[good]
        try:
            accuracies.append(
                axis_accuracy(
                    angles[:, alpha], angles[:, gamma], computed[:, alpha], computed[:, gamma]
                )
            )
        except InputError:
            # A faulty sighting may lie over the top; its axis angles are meaningless.
            return None
    before, after = accuracies
    return replace(after, gamma_0=before.gamma_0, alpha_0=before.alpha_0)


def unexplained_mirrors(names: tuple[str, ...], learned: Learned) -> tuple[str, ...]:
    """Return a message for each heliostat that was not learnt or that no parameters explain.

    Parameters
    ----------
    names
        Names of the N heliostats.
    learned
        The learnt field; its unused sightings are not considered.
    """
    reasons: dict[str, list[str]] = {}
    for misfit in learned.misfits:
        reasons.setdefault(misfit.reason, []).append(names[misfit.row])
    lines = [f"{_listed(mirrors)}: {reason}" for reason, mirrors in reasons.items()]
    misfits = {misfit.row for misfit in learned.misfits}
    odd = np.flatnonzero(learned.outlier)
    where = predict(learned, learned.sightings.take(odd)).errors.beam
    elsewhere = np.zeros(len(learned.sightings), dtype=np.bool_)
    elsewhere[odd[where > ELSEWHERE]] = True
    for i, (name, member) in enumerate(zip(names, learned.members, strict=True)):
        if i in misfits:
            continue
        mine = learned.used & (learned.sightings.heliostat == i)
        kept = learned.rows[i][~learned.outlier[learned.rows[i]]]
        white = np.linalg.norm(member.left_out()[1], axis=1)
        far = int((white * learned.sightings.sigma[kept] > ELSEWHERE).sum())
        beyond, count = int((learned.unusable & mine).sum()), int(mine.sum())
        unexplained = far + int((elsewhere & mine).sum())
        if count >= FEWEST and beyond + unexplained >= max(2, SHARE * count):
            lines.append(f"{name}: {_reason(beyond, unexplained, count)}")
        if len(white) >= FEWEST and np.median(white) > SCATTERED:
            lines.append(f"{name}: {_scatter(white, learned.sightings.sigma[kept])}")
        strain = np.abs(learned.static.values[i] / learned.static.prior[i])
        if count and strain.max(initial=0.0) > STRAINED:
            p = int(np.argmax(strain))
            lines.append(
                f"{name}: {learned.model[p]} is {strain[p]:.0f} standard deviations of its prior "
                "from the nominal value; check the heliostat's entry in the plant file"
            )
    return tuple(lines)


def _listed(names: list[str]) -> str:
    """Return the first few names, and how many more there are."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def _scatter(white: FloatArray, sigma: FloatArray) -> str:
    beam = 1e3 * float(np.median(white * sigma))
    return (
        f"half of its beams are more than {beam:.2f} mrad, {np.median(white):.0f} times their "
        "sigma, from where its other sightings predict them; specify the true sigma, or check "
        "model and counts"
    )


def _reason(beyond: int, unexplained: int, count: int) -> str:
    if beyond > unexplained:
        return (
            f"{beyond} of {count} sightings have counts outside the range of its drives. Probably "
            "the counts were recorded wrongly, or the properties of its drives are wrong."
        )
    if unexplained > NOTHING * count:
        return (
            f"{unexplained} of {count} beams were more than {1e3 * ELSEWHERE:.0f} mrad from "
            "where its other sightings predict them; no set of parameters explains all of them. "
            "Probably the counts were recorded wrongly."
        )
    return (
        f"{unexplained} of {count} beams were more than {1e3 * ELSEWHERE:.0f} mrad from where "
        "its other sightings, which agree, predict them. Probably these photographs show "
        "another mirror's beam."
    )
