r"""User-defined drive error terms, fitted together with the mechanism parameters.

A term adds k · f(φ) to the angle of one joint: f is a function of the angles φ that the nominal
drives produce at the counts, and k is its coefficient, one per heliostat. For example, k ·
sin(azimuth) is one term; the drive errors in a look-up table are one term per table entry.

The kernels do not model these terms. Instead, each recorded count is replaced by the count that a
mechanism without terms would need for the same angle, and a Gauss-Newton step over all unknowns
updates the coefficients. The derivative with respect to a coefficient is f times the derivative
with respect to the drive's bias, which the chain provides.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.fit._fit_kernels import CAUCHY_WIDTH, HUBER_WIDTH
from heliotrope.calibration.fit.estimator import FieldFit, Loss, fit
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.named import Field, Members, members
from heliotrope.calibration.sightings import Sightings
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.frames import Framed, Labelled, Variable
from heliotrope.geometry import FloatArray, as_float, as_numbers
from heliotrope.mechanism.chain import Mechanism
from heliotrope.values import Card, Value, amount

#: Maximum number of rounds of fit and step; terms of a few milliradians need three or four.
_ROUNDS = 20
#: The iteration ends when no coefficient changes by more than this fraction of its prior sigma.
_SETTLED = 1e-4
#: Rounds of the inversion; each round reduces an error of slope s by the factor s.
_INVERSION = 30


@dataclass(frozen=True)
class DriveTerm:
    """A drive error that is a coefficient times a given function of the joint angles.

    Attributes
    ----------
    name
        Name of the coefficient.
    joint
        Driven joint; the term is added to its angle.
    shape
        Function of the angles of the D driven joints, rad, (..., D), that returns the error for a
        coefficient of 1, (...).
    prior
        Standard deviation of the coefficient before any measurement, in rad if the function is
        dimensionless.
    """

    name: str
    joint: str
    shape: Callable[[FloatArray], npt.ArrayLike]
    prior: float


def table_terms(joint: str, drive: int, knots: npt.ArrayLike, prior: float) -> list[DriveTerm]:
    """Return the terms of a look-up table: errors at knots, with linear interpolation in between.

    Beyond the end knots the error is constant.

    Parameters
    ----------
    joint, drive
        Driven joint, and its index among the driven joints, from 0.
    knots
        Joint angles of the knots, rad, ascending, (K,).
    prior
        Standard deviation of the error at a knot, rad.

    Raises
    ------
    InputError
        If there are fewer than two knots, or they are not ascending.
    """
    at = as_numbers(knots, "knots")
    if at.ndim != 1 or len(at) < 2 or not (np.diff(at) > 0.0).all():
        raise InputError(f"knots of {joint}: shape {at.shape}; pass at least 2 ascending angles")

    def hat(k: int) -> Callable[[FloatArray], FloatArray]:
        heights = np.eye(len(at))[k]
        return lambda angles: np.interp(angles[..., drive], at, heights)

    return [DriveTerm(f"{joint}_table_{k + 1}", joint, hat(k), prior) for k in range(len(at))]


@dataclass(frozen=True, eq=False, repr=False)
class TermFit(Value, Framed):
    """Parameters of N heliostats, with K term coefficients each.

    Attributes
    ----------
    fitted
        The parameters; their covariance accounts for the terms.
    terms
        The K terms.
    values
        Their coefficients, (N, K).
    covariance
        Covariance of the coefficients, (N, K, K).
    mechanism
        The nominal mechanisms with the fitted parameters but without the terms, (N,).
    original
        The heliostats before the fit; the terms are functions of their nominal drive angles.
    """

    fitted: FieldFit
    terms: tuple[DriveTerm, ...]
    values: FloatArray
    covariance: FloatArray
    mechanism: Mechanism
    original: Members

    @property
    def sigma(self) -> FloatArray:
        """Return the standard deviations of the coefficients, (N, K)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))

    def _card(self) -> Card:
        count, names = len(self.values), [term.name for term in self.terms]
        middle, sigma = np.median(np.abs(self.values), axis=0), np.median(self.sigma, axis=0)
        values = self.values[0] if count == 1 else middle
        rows = [
            (name, f"{1e3 * value:.3g} mrad", f"{1e3 * around:.2g} mrad")
            for name, value, around in zip(names, values, sigma, strict=True)
        ]
        header = ("term", "value", "σ") if count == 1 else ("term", "median size", "median σ")
        line = f"{amount(len(names), 'term')} of {amount(count, 'heliostat')}: {', '.join(names)}"
        return Card(line, header, rows)

    def _labelled(self) -> Labelled:
        row, names = ("heliostat",), [term.name for term in self.terms]
        return Labelled(
            row,
            {
                "heliostat": self.original.names or np.arange(len(self.values)),
                "term": names,
                "term_2": names,
            },
            {
                "value": Variable((*row, "term"), self.values, "rad"),
                "sigma": Variable((*row, "term"), self.sigma, "rad"),
                "prior": Variable(("term",), [term.prior for term in self.terms], "rad"),
                "covariance": Variable((*row, "term", "term_2"), self.covariance, "rad²"),
            },
            frozenset({"covariance"}),
            {"terms": "rad over the unit of the term's function, if that has one"},
        )

    def without_terms(self, sightings: Sightings) -> Sightings:
        """Return sightings with the counts at which ``mechanism`` alone reaches the same poses."""
        sightings = self.original.rows_of(sightings)
        row = sightings.heliostat
        shapes = _shapes(self.terms, self.original.mechanism[row], sightings.counts)
        moved = _moved(self.mechanism[row], sightings.counts, shapes, self.terms, self.values[row])
        return replace(sightings, counts=moved)

    def to_send(self, heliostat: npt.ArrayLike, counts: npt.ArrayLike) -> FloatArray:
        """Return the counts, (M, D), with which the mechanism, including its terms, reaches a pose.

        Parameters
        ----------
        heliostat
            Indices of the heliostats, () or (M,).
        counts
            Counts at which ``mechanism`` has the pose, (D,) or (M, D), as returned by `track`.
        """
        goal = np.atleast_2d(as_float(counts))
        row = np.broadcast_to(np.asarray(heliostat, dtype=np.intp), goal.shape[:-1])
        mechanism, nominal, values = (
            self.mechanism[row],
            self.original.mechanism[row],
            self.values[row],
        )
        sent = goal.copy()
        for _ in range(_INVERSION):
            shapes = _shapes(self.terms, nominal, sent)
            sent = sent + goal - _moved(mechanism, sent, shapes, self.terms, values)
        return sent


def fit_terms(
    mechanism: Field,
    sightings: Sightings,
    model: str | tuple[str, ...],
    terms: Sequence[DriveTerm],
    *,
    priors: Mapping[str, npt.ArrayLike] | None = None,
    loss: Loss = "cauchy",
    adapt_scale: bool = True,
) -> TermFit:
    """Return the maximum a posteriori parameters, and the coefficients of drive error terms.

    Parameters
    ----------
    mechanism, sightings
        Heliostats, and M sightings of these heliostats.
    model, priors, loss, adapt_scale
        As for `heliotrope.calibration.fit.estimator.fit`.
    terms
        K terms. An effect that a parameter also explains, such as a constant next to a bias, is
        divided between the two according to the priors.

    Raises
    ------
    InputError
        If there are no terms, two terms have the same name, a prior is not above 0, or a function
        returns anything but one finite number per sighting.
    UnknownNameError
        If a joint is not driven; for other cases see `heliotrope.calibration.fit.estimator.fit`.
    """
    field = members(mechanism)
    nominal, recorded = field.mechanism, field.rows_of(sightings)
    _check(nominal, terms)
    row, values = recorded.heliostat, np.zeros((len(nominal), len(terms)))
    shapes = _shapes(terms, nominal[row], recorded.counts)
    prior = np.array([term.prior for term in terms])
    moved = nominal
    for _ in range(_ROUNDS):
        counts = _moved(moved[row], recorded.counts, shapes, terms, values[row])
        corrected = replace(recorded, counts=counts, names=())
        fitted = fit(nominal, corrected, model, priors=priors, loss=loss, adapt_scale=adapt_scale)
        moved = nominal.with_parameters(fitted.parameters)
        step, covariance = _step(moved, corrected, fitted, terms, shapes, values, loss)
        values = values + step
        if (np.abs(step) < _SETTLED * prior).all():
            break
    p = len(fitted.names)
    return TermFit(
        replace(fitted, covariance=covariance[:, :p, :p]),
        tuple(terms),
        values,
        covariance[:, p:, p:],
        moved,
        field,
    )


def _check(mechanism: Mechanism, terms: Sequence[DriveTerm]) -> None:
    driven = [mechanism.joints[d] for d in mechanism.driven]
    names = [term.name for term in terms]
    if not names:
        raise InputError("terms: the list is empty; pass at least 1 term, or use fit")
    for term in terms:
        if names.count(term.name) > 1:
            raise InputError(f"term {term.name}: the name occurs twice; name each term differently")
        if term.joint not in driven:
            raise UnknownNameError(f"driven joint (of term {term.name})", term.joint, driven)
        if not 0.0 < term.prior < np.inf:
            raise InputError(f"term {term.name}: prior must be a number above 0, not {term.prior}")


def _places(mechanism: Mechanism, terms: Sequence[DriveTerm]) -> list[int]:
    """Return the index of the drive that each term belongs to."""
    driven = [mechanism.joints[d] for d in mechanism.driven]
    return [driven.index(term.joint) for term in terms]


def _shapes(terms: Sequence[DriveTerm], nominal: Mechanism, counts: FloatArray) -> FloatArray:
    """Return the error that each term produces with a coefficient of 1, (M, K)."""
    angles = nominal.drives.angles(counts)
    columns = []
    for term in terms:
        try:
            column = as_float(term.shape(angles))
        except (TypeError, ValueError):
            column = np.empty(0)
        if column.shape != (len(counts),) or not np.isfinite(column).all():
            raise InputError(
                f"term {term.name}: its function returned shape {column.shape} for angles "
                f"{angles.shape}; return one finite number for each row"
            )
        columns.append(column)
    return np.stack(columns, axis=-1)


def _moved(
    mechanism: Mechanism,
    counts: FloatArray,
    shapes: FloatArray,
    terms: Sequence[DriveTerm],
    values: FloatArray,
) -> FloatArray:
    """Return the counts, (M, D), that produce the same poses without the terms."""
    angles = mechanism.drives.angles(counts)
    for k, drive in enumerate(_places(mechanism, terms)):
        angles[:, drive] += values[:, k] * shapes[:, k]
    return mechanism.drives.counts(angles)


def _step(
    mechanism: Mechanism,
    sightings: Sightings,
    fitted: FieldFit,
    terms: Sequence[DriveTerm],
    shapes: FloatArray,
    values: FloatArray,
    loss: Loss,
) -> tuple[FloatArray, FloatArray]:
    """Return the Gauss-Newton step of the coefficients, and the covariance of all unknowns."""
    count, row, p = len(mechanism), sightings.heliostat, len(fitted.names)
    biases = tuple(f"{term.joint}_bias" for term in terms)
    lines = linearise(mechanism[row], sightings, (*fitted.names, *biases))
    slopes = lines.jacobian.copy()
    slopes[..., p:] *= shapes[:, None, :]
    weight = fitted.scale[row] ** -2.0
    if loss == "cauchy":
        weight = weight / (1.0 + (fitted.lengths / CAUCHY_WIDTH) ** 2)
    elif loss == "huber":
        weight = weight * np.minimum(1.0, HUBER_WIDTH / np.maximum(fitted.lengths, HUBER_WIDTH))
    own = np.broadcast_to([term.prior for term in terms], (count, len(terms)))
    prior = np.concatenate([fitted.prior, own], axis=1) ** -2.0
    off = np.concatenate([fitted.values - fitted.centre, values], axis=1)
    hessian, gradient = prior[:, :, None] * np.eye(prior.shape[1]), prior * off
    np.add.at(hessian, row, np.einsum("m,map,maq->mpq", weight, slopes, slopes))
    np.add.at(gradient, row, np.einsum("m,map,ma->mp", weight, slopes, lines.residual))
    covariance = as_float(np.linalg.inv(hessian))
    return as_float(-np.einsum("npq,nq->np", covariance, gradient)[:, p:]), covariance
