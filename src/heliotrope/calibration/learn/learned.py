"""The learnt model of a field and its predictions: parameters at any time, beams, forecasts."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from heliotrope import sun as solar
from heliotrope.calibration.evaluation import BeamErrors, beam_errors
from heliotrope.calibration.fit.estimator import (
    FieldFit,
    FitOutcome,
    parameter_rows,
)
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.learn.drift import DAY, Hyperparameters, Posterior
from heliotrope.calibration.learn.forecast import Forecast
from heliotrope.calibration.learn.misfits import Misfit
from heliotrope.calibration.learn.regimes import regime_at
from heliotrope.calibration.learn.unusable import is_usable
from heliotrope.calibration.named import NOWHERE, Members, Surroundings
from heliotrope.calibration.sightings import Sightings
from heliotrope.calibration.sightings import sightings as make_sightings
from heliotrope.errors import InputError, UnknownNameError, require
from heliotrope.field.target import Receiver, Target, point_of
from heliotrope.frames import ACROSS, Framed, Labelled, Variable
from heliotrope.frames import times as as_times
from heliotrope.geometry import FloatArray, as_float
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.parameters import unit_of
from heliotrope.mechanism.tracking import track
from heliotrope.optics.beam import CHI_SQUARE_90
from heliotrope.sun import Site, Times, unix_seconds
from heliotrope.values import Card, Value, amount, dots, span

#: Default standard deviation of a sighting for a heliostat without sightings, rad of beam.
USUAL_SIGMA = 5e-4


@dataclass(frozen=True, eq=False, repr=False)
class Prediction(Value, Framed):
    """Predicted and measured positions of M beams.

    Attributes
    ----------
    errors
        Angle between the predicted and the measured beam, rad, (M,).
    plane
        Predicted minus measured, rad of beam to the right of and above the destination, (M, 2).
    covariance
        Predicted covariance of ``plane``, due to parameters, drift and noise, rad², (M, 2, 2).
    inside
        Whether the error lies within the 90 % ellipse, (M,).
    beam
        Matrices that convert a whitened residual into ``plane``, (M, 2, 2).
    values
        The parameter deviations at the time of each sighting, (M, P).
    usable
        Whether the mechanism can predict the beam, (M,); otherwise ``inside`` is false and
        ``covariance`` is NaN. See `heliotrope.calibration.learn.unusable`.
    """

    errors: BeamErrors
    plane: FloatArray
    covariance: FloatArray
    inside: npt.NDArray[np.bool_]
    beam: FloatArray
    values: FloatArray
    usable: npt.NDArray[np.bool_]

    def _labelled(self) -> Labelled:
        row = ("sighting",)
        return Labelled(
            row,
            {
                "sighting": np.arange(len(self.plane)),
                "across": ACROSS,
                "across_2": ACROSS,
            },
            {
                "beam": Variable(row, self.errors.beam, "rad"),
                "plane": Variable((*row, "across"), self.plane, "rad"),
                "covariance": Variable((*row, "across", "across_2"), self.covariance, "rad2"),
                "inside": Variable(row, self.inside),
                "usable": Variable(row, self.usable),
            },
        )

    def _card(self) -> Card:
        good = self.usable
        if not good.any():
            return Card(f"{len(good)} beams, no usable beam")
        line = f"{len(good)} beams, {(~good).sum()} unusable; errors "
        line += (
            f"{span(self.errors.beam[good], 1e3, 'mrad')}, {100 * self.inside[good].mean():.0f} "
        )
        return Card(f"{line}% within their 90 % ellipses")


@dataclass(frozen=True, eq=False, repr=False)
class Learned(Value, Framed):
    """Result of learning N heliostats from M sightings.

    Attributes
    ----------
    mechanism
        Nominal mechanisms, (N,).
    sightings
        All M sightings.
    model
        Names of the constant parameters.
    used
        Mask of the sightings to learn from, (M,).
    static
        The robust fit of step 2.
    hyper
        Hyperparameters of the field.
    members
        Posterior of each heliostat.
    regime
        Regime of each sighting; −1 if not used, (M,).
    outlier
        Mask of the outliers among the sightings used, (M,).
    unusable
        Mask of the sightings that no parameters near the fit can produce, (M,). These sightings are
        not used.
    rows
        For each heliostat, the indices of its sightings, including outliers, in the order in which
        its entry in ``members`` holds them.
    heliostats
        Names, (N,); () if unknown.
    around
        Site of the heliostats, if known.
    misfits
        Heliostats that do not fit their sightings, with the reason; these are not learnt.
    """

    mechanism: Mechanism
    sightings: Sightings
    model: tuple[str, ...]
    used: npt.NDArray[np.bool_]
    static: FieldFit
    hyper: Hyperparameters
    members: tuple[Posterior, ...]
    regime: npt.NDArray[np.int64]
    outlier: npt.NDArray[np.bool_]
    unusable: npt.NDArray[np.bool_]
    rows: tuple[npt.NDArray[np.intp], ...]
    heliostats: tuple[str, ...] = ()
    around: Surroundings = NOWHERE
    misfits: tuple[Misfit, ...] = ()

    def row(self, heliostat: int | str) -> int:
        """Return the index of a heliostat, given by name or by index.

        Raises
        ------
        UnknownNameError
            If there is no such heliostat.
        """
        if isinstance(heliostat, str):
            if heliostat not in self.heliostats:
                raise UnknownNameError("heliostat (learnt)", heliostat, self.heliostats)
            return self.heliostats.index(heliostat)
        if not 0 <= heliostat < len(self.members):
            raise InputError(
                f"heliostat {heliostat}: there are {len(self.members)} heliostats, counted from 0; "
                "pass an index or a name"
            )
        return heliostat

    def __getitem__(self, heliostat: int | str) -> "Learned":
        """Return one heliostat of the field, given by name or index."""
        i = self.row(heliostat)
        mine = np.flatnonzero(self.sightings.heliostat == i)
        place = np.full(len(self.sightings), -1)
        place[mine] = np.arange(len(mine))
        return replace(
            self,
            mechanism=self.mechanism[np.array([i])],
            sightings=self.sightings.of(i),
            used=self.used[mine],
            static=self.static.only(i),
            members=self.members[i : i + 1],
            regime=self.regime[mine],
            outlier=self.outlier[mine],
            unusable=self.unusable[mine],
            rows=(place[self.rows[i]],),
            heliostats=self.heliostats[i : i + 1],
            misfits=tuple(replace(m, row=0) for m in self.misfits if m.row == i),
        )

    def doubted(self) -> "Learned":
        """Return the result for a doubtful clock, in which no heliostat counts as learnt."""
        outcome = self.static.outcome.copy()
        outcome[np.isin(outcome, (FitOutcome.CONVERGED, FitOutcome.NOT_CONVERGED))] = (
            FitOutcome.CLOCK
        )
        return replace(self, static=replace(self.static, outcome=outcome))

    def _card(self) -> Card:
        model, all_names = len(self.model), len(self.names)
        count = amount(int(self.used.sum()), "sighting")
        parts = [
            f"{amount(len(self.members), 'heliostat')} from {count}",
            amount(int(self.outlier.sum()), "outlier"),
            f"{self.unusable.sum()} unusable",
            amount(model, "constant parameter"),
            f"{amount(all_names - model, 'parameter')} that may only drift",
        ]
        static = self.static
        rows = parameter_rows(static.names, np.abs(static.values), static.sigma)
        places = self.mechanism.position
        picture = dots(places[:, 0], places[:, 1], "map")
        header = ("parameter", "median size", "median σ of the fit")
        return Card(", ".join(parts), header, rows, picture)

    def forecast(
        self,
        heliostat: int | str,
        times: Times,
        target: str | Target | Receiver | npt.ArrayLike,
        *,
        site: Site | None = None,
        steered: Mechanism | None = None,
        sigma: float | None = None,
    ) -> Forecast:
        """Return the expected position of a heliostat's beam, with its uncertainty.

        Parameters
        ----------
        heliostat
            Name or index.
        times
            T times; see `heliotrope.sun.Times`. A pandas index is accepted.
        target
            Name of a target of the plant that was learnt, a target or receiver, or a point, m,
            (3,).
        site
            Site; required if the field was learnt from mechanisms alone.
        steered
            The mechanism that the controller assumes for the heliostat, batch shape (). Default:
            the learnt mechanism at the time of the heliostat's last used sighting. Pass the nominal
            mechanism to forecast the error before calibration.
        sigma
            Standard deviation of a sighting's ray, rad of beam; default: the median over this
            heliostat's sightings.

        Raises
        ------
        InputError
            If the site is unknown.
        UnknownNameError
            If there is no such heliostat or target.
        """
        return _forecast(self, heliostat, times, target, site, steered, sigma)

    def _labelled(self) -> Labelled:
        row, count = ("heliostat",), len(self.members)
        known = self.sightings.time[self.used & np.isfinite(self.sightings.time)]
        last = float(known.max()) if len(known) else np.nan
        values, spread = self.parameters_at(np.arange(count), last)
        units = tuple(map(unit_of, self.names))
        return Labelled(
            row,
            {
                "heliostat": self.heliostats or np.arange(count),
                "parameter": self.names,
                "parameter_2": self.names,
            },
            {
                "value": Variable((*row, "parameter"), values, units),
                "sigma": Variable(
                    (*row, "parameter"), np.sqrt(np.diagonal(spread, axis1=-2, axis2=-1)), units
                ),
                "covariance": Variable((*row, "parameter", "parameter_2"), spread),
                "noise": Variable(row, np.array([m.hyper.noise for m in self.members])),
                "sightings": Variable(row, np.array([len(m.data) for m in self.members])),
            },
            frozenset({"covariance"}),
            {"time": str(as_times(last))},
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the P parameters, including those that only drift."""
        return self.hyper.names

    def regimes(self, heliostat: int, when: FloatArray) -> npt.NDArray[np.int64]:
        """Return the regime of a heliostat at Unix times ``when`` (m,)."""
        rows = self.rows[heliostat]
        return regime_at(self.sightings.time[rows], self.regime[rows], when)

    def parameters_at(self, heliostat: npt.ArrayLike, time: Times) -> tuple[FloatArray, FloatArray]:
        """Return deviations (M, P) at Unix times (M,), and their covariance (M, P, P).

        Parameters
        ----------
        heliostat
            Indices of the heliostats, (M,).
        time
            See `heliotrope.sun.Times`, () or (M,); NaN if unknown.

        Raises
        ------
        InputError
            If an index is out of range.
        TimeError
            If a value is not a time, or has no time zone.
        """
        rows = np.asarray(heliostat, dtype=np.intp)
        invalid = (rows < 0) | (rows >= len(self.members))
        if invalid.any():
            raise InputError(
                f"heliostat: row {rows[invalid].flat[0]} was not learnt; rows run from 0 to "
                f"{len(self.members) - 1}"
            )
        when = np.broadcast_to(unix_seconds(time, unknown=True), rows.shape)
        size = len(self.names)
        values, spread = np.empty((len(rows), size)), np.empty((len(rows), size, size))
        with threadpool_limits(1, "blas"):
            order = np.argsort(rows, kind="stable")
            heliostats, first = np.unique(rows[order], return_index=True)
            for i, part in zip(heliostats, np.split(order, first)[1:], strict=True):
                # Computed in parts, because memory grows with sightings × times × parameters.
                for some in np.array_split(part, 1 + len(part) // 500):
                    label = self.regimes(int(i), when[some])
                    values[some], spread[some] = self.members[i].at(when[some] / DAY, label)
        return values, spread

    def mechanism_at(self, heliostat: npt.ArrayLike, time: Times) -> Mechanism:
        """Return the expected mechanisms of the heliostats ``heliostat`` (M,) at ``time`` (M,)."""
        values, _ = self.parameters_at(heliostat, time)
        return moved_by(self.mechanism, heliostat, self.names, values)


def predict(learned: Learned, sightings: Sightings) -> Prediction:
    """Return the predicted beams of sightings, compared with the measured beams.

    Parameters
    ----------
    learned
        Learnt field of N heliostats.
    sightings
        M sightings of these heliostats, at any time.
    """
    require("learned", learned, Learned, "the result of learn or calibrate")
    sightings = Members(learned.mechanism, learned.heliostats).rows_of(sightings)
    values, spread = learned.parameters_at(sightings.heliostat, sightings.time)
    return predict_with(learned, sightings, values, spread)


def predict_with(
    learned: Learned, sightings: Sightings, values: FloatArray, spread: FloatArray
) -> Prediction:
    """Predict the beams of sightings (M,) with given parameters.

    Parameters
    ----------
    learned
        Learnt field of N heliostats; only its nominal mechanisms and noise are used.
    sightings
        M sightings of these heliostats.
    values, spread
        Deviations at each sighting, (M, P), and their covariance, (M, P, P).
    """
    rows = sightings.heliostat
    moved = moved_by(learned.mechanism, rows, learned.names, values)
    alone = sightings.renumbered(np.arange(len(rows)))
    errors = beam_errors(moved, alone)
    line = linearise(moved, sightings, learned.names)
    noise = np.array([m.hyper.noise**2 * m.hyper.heavy for m in learned.members])[rows]
    usable = is_usable(line)
    jacobian = np.where(usable[:, None, None], line.jacobian, 0.0)
    white = jacobian @ spread @ np.swapaxes(jacobian, -1, -2)
    white += noise[:, None, None] * np.eye(2)
    covariance = line.beam @ white @ np.swapaxes(line.beam, -1, -2)
    covariance[~usable] = np.nan
    inside = squared_distance(errors.offset, covariance) <= CHI_SQUARE_90
    return Prediction(errors, errors.offset, covariance, inside, line.beam, values, usable)


def squared_distance(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return squared lengths (M,) of errors (M, 2) in units of their covariances (M, 2, 2).

    The inverse is in closed form, so that a covariance of NaN yields NaN rather than an error.
    """
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    x, y = error[:, 0], error[:, 1]
    return np.asarray((c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b))


def moved_by(
    mechanism: Mechanism, heliostat: npt.ArrayLike, names: tuple[str, ...], values: FloatArray
) -> Mechanism:
    """Return the mechanisms of heliostats ``heliostat`` (M,) with deviations ``values`` (M, P)."""
    nominal = mechanism[np.asarray(heliostat, dtype=np.intp)]
    return nominal.with_parameters({n: values[:, p] for p, n in enumerate(names)})


def left_out_errors(learned: Learned) -> FloatArray:
    """Return the error of each beam, predicted from the heliostat's other sightings, (M, 2).

    The error is predicted minus measured, to the right of and above the destination, in rad.
    Outliers and unused sightings are predicted from all sightings that were used.
    """
    known = predict(learned, learned.sightings)
    errors = known.plane.copy()
    for i, member in enumerate(learned.members):
        part = learned.rows[i][~learned.outlier[learned.rows[i]]]
        if len(part):
            errors[part] = -np.einsum("mab,mb->ma", known.beam[part], member.left_out()[1])
    return errors


def _forecast(
    learned: Learned,
    heliostat: int | str,
    times: Times,
    target: str | Target | Receiver | npt.ArrayLike,
    site: Site | None,
    steered: Mechanism | None,
    sigma: float | None,
) -> Forecast:
    row = learned.row(heliostat)
    place = site or learned.around.site
    if place is None:
        raise InputError(
            "forecast: the model was learnt from mechanisms alone, without a site; pass "
            "site=Site(latitude, longitude, height), or learn from plant[name] or the plant"
        )
    when = np.atleast_1d(unix_seconds(times))
    if when.ndim != 1:
        raise InputError(f"times: shape {when.shape}; pass a one-dimensional array of times (T,)")
    light, aim = solar.vector(when, place), point_of(target, learned.around.targets)
    mine = learned.sightings.heliostat == row
    if steered is None:
        dated = learned.sightings.time[mine & learned.used]
        last = float(np.nanmax(dated)) if np.isfinite(dated).any() else np.nan
        steered = learned.mechanism_at([row], last)[0]
    tracking = track(steered, light, aim)
    good = np.asarray(tracking.reachable & (light[:, 2] > 0.0))
    if sigma is None:
        sigma = float(np.median(learned.sightings.sigma[mine])) if mine.any() else USUAL_SIGMA
    made = make_sightings(
        np.full(int(good.sum()), row),
        tracking.best_counts[good].reshape(-1, tracking.counts.shape[-1]),
        light[good],
        aim,
        time=when[good],
        sigma=sigma,
    )
    expected = predict(learned, made)
    good[good] = expected.usable
    known = expected.usable

    def spread(values: FloatArray) -> FloatArray:
        whole = np.full((len(when), *values.shape[1:]), np.nan)
        whole[good] = values[known]
        return as_float(whole)

    name = learned.heliostats[row] if learned.heliostats else str(row)
    return Forecast(
        name,
        when,
        light,
        aim,
        spread(made.counts),
        spread(expected.plane),
        spread(expected.covariance),
        good,
    )
