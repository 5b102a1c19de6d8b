"""Choose the model of one heliostat from its own sightings, in a fraction of a second.

`models` compares candidates over a field, including drift and population, which takes minutes and
suits a report. A running plant calibrates one heliostat at a time and cannot wait that long. Here
each candidate is one robust fit. Its score is the log probability density of each calibration visit
given the others, under its priors and white noise (Rasmussen & Williams 2006, (5.10)-(5.12), for
blocks of two). As in `models`, the simplest candidate within one standard error of the best is
chosen.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from heliotrope.calibration.fit.estimator import FieldFit, fit
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.learn import models, periodic
from heliotrope.calibration.learn.drift import Hyperparameters
from heliotrope.calibration.learn.present import Flown, fitting_present
from heliotrope.calibration.sightings import Sightings
from heliotrope.geometry import FloatArray
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.mechanism.chain import Mechanism

#: Minimum number of visits for a comparison.
FEWEST = 8
#: Number of latest visits that are compared. Older visits cost time and describe an older state of
#: the mechanism.
MOST = 60
#: Number of latest sightings used to fit constants and choose models, so that the work does not
#: grow with the age of the plant.
RECENT = 1000
#: Trial values of the noise of a visit, in units of the scale of the fit.
NOISES = np.geomspace(0.2, 2.0, 9)


def latest(sightings: Sightings) -> Sightings:
    """Return the latest `RECENT` sightings; sightings of unknown time are dropped first."""
    if len(sightings) <= RECENT:
        return sightings
    order = np.argsort(np.nan_to_num(sightings.time, nan=-np.inf), kind="stable")
    return sightings.take(np.sort(order[-RECENT:]))


@dataclass(frozen=True)
class OwnModel:
    """The model of one heliostat.

    Attributes
    ----------
    name, parameters
        Name of the model, and names of the parameters to fit.
    errors
        Periodic errors that belong to the model; their ratios were found by a search.
    """

    name: str
    parameters: tuple[str, ...]
    errors: tuple[periodic.PeriodicError, ...] = ()

    def fitting(
        self, nominal: Mechanism, sightings: Sightings, group: Hyperparameters | None = None
    ) -> tuple[FieldFit, FieldFit]:
        """Return a fit of constants, and a fit that follows the drift learnt from its ``group``.

        The constants are fitted to the `latest` sightings, and `present` describes the second fit.
        The values are deviations from ``nominal``, (1,), and include the ratios, so that they fully
        define the mechanism.
        """
        some = latest(sightings)
        constants = self.completed(fit(self.start(nominal), some, self.parameters))
        return constants, self.following(nominal, sightings, constants, group)

    def following(
        self,
        nominal: Mechanism,
        sightings: Sightings,
        constants: FieldFit,
        group: Hyperparameters | None,
        flown: Sequence[Flown] = (),
    ) -> FieldFit:
        """Return a fit that follows the drift, starting from a fit of constants; see `present`."""
        fitted = fitting_present(
            self.start(nominal), sightings, self._searched(constants), group, flown
        )
        return self.completed(fitted)

    def _searched(self, fitted: FieldFit) -> FieldFit:
        """Return a fit without the ratios; the reverse of `completed`."""
        count = len(self.parameters)
        return replace(
            fitted,
            names=fitted.names[:count],
            values=fitted.values[:, :count],
            centre=fitted.centre[:, :count],
            prior=fitted.prior[:, :count],
            covariance=fitted.covariance[:, :count, :count],
        )

    def start(self, nominal: Mechanism) -> Mechanism:
        """Return the mechanism at which the fit of the parameters starts."""
        return periodic.with_ratios(nominal, self.errors)

    def completed(self, fitted: FieldFit) -> FieldFit:
        """Return a fit that began at `start`, with the ratios added to its values."""
        if not self.errors:
            return fitted
        count, ratios = len(fitted.names), np.array([e.ratio - e.known for e in self.errors])
        sigmas = np.array([e.sigma for e in self.errors])
        # A harmonic is as exact as the known ratio.
        priors = np.where(sigmas > 0.0, sigmas, np.abs(ratios))
        covariance = np.zeros((1, count + len(ratios), count + len(ratios)))
        covariance[:, :count, :count] = fitted.covariance
        covariance[:, count:, count:] = np.diag(sigmas**2)

        def more(values: FloatArray, added: FloatArray) -> FloatArray:
            return np.concatenate([values, added[None]], axis=1)

        return replace(
            fitted,
            names=fitted.names + tuple(f"{e.joint}_worm_ratio" for e in self.errors),
            values=more(fitted.values, ratios),
            centre=more(fitted.centre, ratios),
            prior=more(fitted.prior, priors),
            covariance=covariance,
        )


def choose_own_model(nominal: Mechanism, sightings: Sightings, simple: str) -> OwnModel:
    """Return the simplest model that explains the sightings of one heliostat.

    The candidates are those of `models.candidate_models`, including periodic errors whose ratio is
    searched for, each combined with the parameters of the simple model. If there are fewer than
    `FEWEST` visits, the simple model is returned.

    Parameters
    ----------
    nominal
        Nominal mechanism, batch shape (1,).
    sightings
        M sightings of this heliostat, at index 0.
    simple
        Name of the simple model, which needs only a few sightings.
    """
    base, sightings = parameter_table.model(simple, nominal.parameters), latest(sightings)
    mean = periodic.visit_means(nominal, sightings)
    if len(mean) < FEWEST:
        return OwnModel(simple, base)
    recent = np.flatnonzero(mean[-MOST:].any(axis=0))
    sightings = sightings.take(recent)
    visits = min(len(mean), MOST)
    errors = tuple(e for e in periodic.search_periodic_errors(nominal, sightings) if e.found)
    mechanism = periodic.with_ratios(nominal, errors)
    trials = {simple: base}
    for name, names in models.candidate_models(mechanism).items():
        more = base + tuple(n for n in names if n not in base)
        if more not in trials.values() and 2 * visits >= len(more) + periodic.FREEDOM:
            trials[name] = more
    widest = fit(mechanism, sightings, max(trials.values(), key=len))
    sightings = sightings.take(np.flatnonzero(widest.lengths < periodic.OUTLIER))
    mean = periodic.visit_means(nominal, sightings)
    scores = {name: _left_out(mechanism, sightings, names, mean) for name, names in trials.items()}
    best = models.choose_model(_scored(trials, scores))
    used = tuple(e for e in errors if f"{e.joint}_worm_cos" in best.parameters)
    return OwnModel(best.name, best.parameters, used)


def _scored(
    trials: Mapping[str, tuple[str, ...]], scores: Mapping[str, FloatArray]
) -> tuple[models.ScoredModel, ...]:
    best = max(scores, key=lambda name: float(scores[name].mean()))
    scored = []
    for name, names in trials.items():
        gap = scores[best] - scores[name]
        error = float(gap.std() / np.sqrt(len(gap)))
        mean = float(scores[name].mean())
        scored.append(models.ScoredModel(name, names, mean, float(gap.mean()), error, float("nan")))
    return tuple(scored)


def _left_out(
    mechanism: Mechanism, s: Sightings, names: tuple[str, ...], mean: FloatArray
) -> FloatArray:
    """Return the log density of each visit, given the other visits, (V,), at the best noise."""
    fitted = fit(mechanism, s, names)
    moved = mechanism.with_parameters(fitted.parameters)
    line = linearise(moved[s.heliostat], s, names)
    slope = np.einsum("vm,map->vap", mean, line.jacobian).reshape(2 * len(mean), -1)
    residual = (mean @ line.residual).ravel() - slope @ (fitted.values[0] - fitted.centre[0])
    spread = slope * fitted.prior[0]
    values, vectors = np.linalg.eigh(spread @ spread.T)
    turned = vectors.T @ residual
    blocks = vectors.reshape(len(mean), 2, -1)
    best = np.full(len(mean), -np.inf)
    for noise in NOISES * max(float(fitted.scale[0]), 1e-9):
        weight = 1.0 / (np.maximum(values, 0.0) + noise**2)
        inverse = (blocks * weight) @ np.swapaxes(blocks, 1, 2)
        alpha = blocks @ (weight * turned)
        square = np.einsum("va,vab,vb->v", alpha, np.linalg.inv(inverse), alpha)
        log = -0.5 * square + 0.5 * np.linalg.slogdet(inverse)[1] - np.log(2.0 * np.pi)
        log = np.maximum(log, models.WORST)
        if log.mean() > best.mean():
            best = log
    return best
