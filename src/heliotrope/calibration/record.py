"""The record of one heliostat's calibration, which each calibration creates once.

The learner creates a `HeliostatCalibration` from a fit. All users (automatic control, schedule,
beam checks, local controllers, store, pages) hold a reference to the same record, and none of them
repeats the fit or the inversion. `CalibrationOutcome` is the outcome of an attempt, whether or not
it produced a record.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Self

import numpy as np
import numpy.typing as npt

from heliotrope import __version__
from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.fit.estimator import FieldFit, FitOutcome, parameter_rows
from heliotrope.calibration.growth import Growth, default_growth
from heliotrope.calibration.learn.drift import DAY
from heliotrope.calibration.sightings import Sightings
from heliotrope.errors import InputError
from heliotrope.frames import ACROSS, Framed, Labelled, Variable, times
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.parameters import unit_of
from heliotrope.values import Card, Value, amount

Identities = npt.NDArray[np.int64]


class Provenance(StrEnum):
    """Source of the sightings behind a calibration."""

    CAMERA = "camera"
    DRONE = "drone"
    TABLE = "table"
    #: An operator has set the values, without sightings.
    PERSON = "person"


class CalibrationOutcome(StrEnum):
    """Outcome of an attempt to calibrate one heliostat."""

    CALIBRATED = "calibrated"
    NO_BEAM = "no_beam"
    NO_PHOTOGRAPH = "no_photograph"
    TOO_FEW_SIGHTINGS = "too_few_sightings"
    FIT_FAILED = "fit_failed"
    IMPLAUSIBLE = "implausible"
    POOR_FIT = "poor_fit"
    NO_BETTER = "no_better"
    #: A photograph did not confirm the new parameters, so the old parameters have been restored.
    NOT_VERIFIED = "not_verified"
    #: In a joint visit, no beam was identified as this heliostat's.
    NOT_PROVEN = "not_proven"
    REFUSED = "refused"
    #: An order from elsewhere, such as an operator's command or an emergency, took the heliostat
    #: out of the calibration visit.
    TAKEN_OUT = "taken_out"
    ERROR = "error"
    #: The parameters are unchanged, for a reason that was not recorded.
    UNCHANGED = "unchanged"

    @property
    def calibrated(self) -> bool:
        """Whether the heliostat has new parameters."""
        return self is CalibrationOutcome.CALIBRATED


def _no_identities() -> Identities:
    return np.zeros(0, np.int64)


def _no_residuals() -> FloatArray:
    return np.zeros((0, 2))


@dataclass(frozen=True, eq=False, repr=False)
class HeliostatCalibration(Value, Framed):
    """The calibration of one heliostat: P parameters from M sightings. Arrays are read-only.

    Attributes
    ----------
    heliostat
        Name.
    at
        Time of the fit, POSIX s.
    names, values
        Parameters, and their deviations from the nominal mechanism, rad, m or 1, (P,).
    covariance
        Covariance of the values at the time of the fit, with the noise scaled to the residuals,
        (P, P).
    prior
        Standard deviations of the priors behind the covariance, (P,).
    before, after
        Beam error over the sightings with the nominal and with the calibrated mechanism, rad RMS;
        NaN if unknown.
    scale
        Estimated noise, in units of the sightings' sigma.
    outcome
        How the fit ended.
    sightings, left_out
        Store identifiers of the sightings used, (M,), and of the sightings left out of the fit; 0
        for a sighting that is not in a store.
    residual_before, residual_after
        Beam error of each sighting used, to the right of and above the destination as seen from
        the mirror, with the nominal and with the calibrated mechanism, rad, (M, 2).
    model
        Name of the model.
    provenance
        Source of the sightings.
    person, campaign, note
        Who calibrated the heliostat, in which campaign, and remarks.
    pushed
        Items written to the local controller and read back.
    code
        Version of the program.
    version
        Version number, counted from 1 for each heliostat; 0 before a number is assigned.
    growth
        How the covariance grows after the fit. The fit sets the default growth for the kind of
        mechanism; the plant then replaces it with the growth learnt for the heliostat's group. The
        growth is not stored with the record.

    Raises
    ------
    InputError
        If shapes do not match, or parameters are not finite.
    """

    heliostat: str
    at: float
    names: tuple[str, ...]
    values: FloatArray
    covariance: FloatArray
    prior: FloatArray
    before: float = float("nan")
    after: float = float("nan")
    scale: float = float("nan")
    outcome: FitOutcome = FitOutcome.CONVERGED
    sightings: Identities = field(default_factory=_no_identities)
    left_out: Identities = field(default_factory=_no_identities)
    residual_before: FloatArray = field(default_factory=_no_residuals)
    residual_after: FloatArray = field(default_factory=_no_residuals)
    model: str = ""
    provenance: Provenance = Provenance.CAMERA
    person: str = ""
    campaign: str = ""
    note: str = ""
    pushed: tuple[str, ...] = ()
    code: str = __version__
    version: int = 0
    growth: Growth = field(default_factory=Growth)

    def __post_init__(self) -> None:
        count, used = len(self.names), np.shape(self.sightings)[0]
        shapes = {
            "values": (count,),
            "covariance": (count, count),
            "prior": (count,),
            "sightings": (used,),
            "left_out": (np.size(self.left_out),),
            "residual_before": (used, 2),
            "residual_after": (used, 2),
        }
        for name, shape in shapes.items():
            array = np.array(getattr(self, name))
            if array.shape != shape:
                raise InputError(
                    f"calibration of {self.heliostat}: {name} of shape {array.shape}; {count} "
                    f"parameters and {used} sightings need {shape}"
                )
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        for name in ("values", "covariance", "prior"):
            if not np.isfinite(getattr(self, name)).all():
                raise InputError(
                    f"calibration of {self.heliostat}: {name} is not finite; do not store a "
                    "failed fit"
                )

    def _labelled(self) -> Labelled:
        row, units = ("heliostat",), tuple(map(unit_of, self.names))
        both, by_sighting = ("parameter", "parameter_2"), ("sighting", "across")
        variables = {
            "at": Variable(row, times([self.at])),
            "value": Variable(("parameter",), self.values, units),
            "sigma": Variable(("parameter",), np.sqrt(np.diagonal(self.covariance)), units),
            "prior": Variable(("parameter",), self.prior, units),
            "covariance": Variable(both, self.covariance),
            "before": Variable(row, [self.before], "rad"),
            "after": Variable(row, [self.after], "rad"),
            "scale": Variable(row, [self.scale]),
            "outcome": Variable(row, [int(self.outcome)]),
            "version": Variable(row, [self.version]),
            "residual_before": Variable(by_sighting, self.residual_before, "rad"),
            "residual_after": Variable(by_sighting, self.residual_after, "rad"),
        }
        labels: dict[str, npt.ArrayLike] = {
            "heliostat": (self.heliostat,),
            "parameter": self.names,
            "parameter_2": self.names,
            "sighting": self.sightings,
            "across": ACROSS,
        }
        large = frozenset({"covariance", "residual_before", "residual_after"})
        return Labelled(row, labels, variables, large, {"model": self.model})

    @classmethod
    def from_fit(
        cls,
        heliostat: str,
        at: float,
        fitted: FieldFit,
        nominal: Mechanism,
        sightings: Sightings,
        identities: npt.ArrayLike,
        *,
        model: str,
        used: npt.ArrayLike | None = None,
        provenance: Provenance = Provenance.CAMERA,
        person: str = "",
        campaign: str = "",
        note: str = "",
        pushed: tuple[str, ...] = (),
        version: int = 0,
    ) -> Self:
        """Return the record of one heliostat's fit.

        Parameters
        ----------
        heliostat, at
            Name, and time of the fit, POSIX s.
        fitted
            A fit of batch shape (1,).
        nominal
            The mechanism from which the values deviate, batch shape (1,).
        sightings, identities
            The sightings passed to the fit, with heliostat index 0, and their store identifiers,
            (M,).
        used
            Mask of the sightings that the fit used, (M,); default: all.
        model, provenance, person, campaign, note, pushed, version
            See the attributes.

        Raises
        ------
        InputError
            If numbers and sightings differ in count, or the fit failed.
        """
        numbers = np.asarray(identities, np.int64).reshape(-1)
        if len(numbers) != len(sightings):
            raise InputError(
                f"calibration of {heliostat}: {len(numbers)} numbers for {len(sightings)} "
                "sightings; number the sightings first"
            )
        mask = np.ones(len(sightings), np.bool_) if used is None else np.asarray(used, np.bool_)
        taken = sightings.take(np.flatnonzero(mask))
        first = beam_errors(nominal, taken)
        last = beam_errors(nominal.with_parameters(fitted.parameters), taken)
        return cls(
            heliostat,
            at,
            tuple(fitted.names),
            fitted.values[0],
            fitted.covariance[0],
            fitted.prior[0],
            root_mean_square(first.beam),
            root_mean_square(last.beam),
            float(fitted.scale[0]),
            FitOutcome(int(fitted.outcome[0])),
            numbers[mask],
            numbers[~mask],
            first.offset,
            last.offset,
            model,
            provenance,
            person,
            campaign,
            note,
            pushed,
            version=version,
            growth=default_growth(nominal),
        )

    def _card(self) -> Card:
        line = f"{self.heliostat}, version {self.version}, {self.model or 'model unknown'}, "
        line += f"{amount(len(self.sightings), 'sighting')}, beam {1e3 * self.before:.3g} mrad RMS "
        line += f"before and {1e3 * self.after:.3g} after"
        rows = parameter_rows(self.names, self.values, self.sigma)
        return Card(line, ("parameter", "value", "σ"), rows)

    @property
    def parameters(self) -> dict[str, float]:
        """Values by name."""
        return {name: float(v) for name, v in zip(self.names, self.values, strict=True)}

    @property
    def heliostats(self) -> tuple[str, ...]:
        """The name, in the form that functions such as `Mechanism.with_calibration` accept."""
        return (self.heliostat,)

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the values at the time of the fit, (P,)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))

    def sigma_at(self, time: float) -> FloatArray:
        """Return the standard deviations of the values at a POSIX time, (P,)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance_at(time))))

    def covariance_at(self, time: npt.ArrayLike) -> FloatArray:
        """Return the covariance of the values at POSIX times (...), (..., P, P).

        The covariance grows with the time since the fit, because the group's parameters drift. For
        many records of one group, see `covariances_at`.
        """
        days = (np.asarray(time, dtype=np.float64) - self.at) / DAY
        return self.growth.grown(self.covariance, self.names, days)

    def growing(self, growth: Growth) -> Self:
        """Return the same calibration with a different growth of its covariance after the fit."""
        other = copy(self)
        object.__setattr__(other, "growth", growth)
        return other

    def mechanism(self, nominal: Mechanism) -> Mechanism:
        """Return the calibrated mechanism, in the batch shape of the nominal mechanism."""
        return nominal.with_parameters(self.parameters)


def covariances_at(records: Sequence[HeliostatCalibration], time: float) -> FloatArray:
    """Return the covariances of K records at a POSIX time, (K, P, P).

    The records must have the same parameters and the same growth, as in a group.
    """
    first, days = records[0], np.array([(time - record.at) / DAY for record in records])
    whole = np.stack([record.covariance for record in records])
    return first.growth.grown(whole, first.names, days)


def root_mean_square(values: FloatArray) -> float:
    """Return the root mean square; NaN if there are no values."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
