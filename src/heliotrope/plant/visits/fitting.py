"""Fits of the plant's sightings of its heliostats, and their acceptance.

One heliostat is fitted after a visit, a large number after a flight. Both fits use all available
information on a heliostat: its photographs, and its flight records with the errors that they share
with other heliostats.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.fit.common import CommonFit, fit_common
from heliotrope.calibration.fit.estimator import FieldFit, FitOutcome
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.learn import drift
from heliotrope.calibration.learn.drift import DAY, Hyperparameters
from heliotrope.calibration.learn.own_model import OwnModel
from heliotrope.calibration.record import (
    CalibrationOutcome,
    HeliostatCalibration,
    Identities,
    Provenance,
    root_mean_square,
)
from heliotrope.calibration.sightings import Sightings
from heliotrope.geometry import FloatArray, angle_between
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant.field.beliefs import Beliefs
from heliotrope.plant.field.flights import Flights
from heliotrope.plant.visits.settings import CycleSettings

#: Largest error of the last day's photographs that a fit with drift may leave, in sigma of a
#: photograph: two axes, and the motion of the mirror within hours.
EXPLAINED = 2.0
#: A new fit may leave larger errors than the present one by this fraction of a sigma, added in
#: quadrature.
ROOM = 0.25
#: Outcomes of fits whose sightings contradict each other or the installation.
WRONG = frozenset(
    {
        CalibrationOutcome.FIT_FAILED,
        CalibrationOutcome.IMPLAUSIBLE,
        CalibrationOutcome.POOR_FIT,
    }
)


@dataclass(frozen=True)
class JudgedFit:
    """A fit of one heliostat, compared with the present belief.

    Attributes
    ----------
    model
        Name of the model.
    fitted
        Fit of batch shape (1,).
    nominal
        The mechanism from which the fit starts, batch shape (1,).
    sightings
        The sightings, photographs first; the estimated shared errors of the flights are removed.
    before, after
        Beam errors under the present and the fitted mechanism, weighted by the sightings, rad RMS.
        A fit that follows the drift need not explain the past, so only the last day's photographs
        are used.
    outcome, problem
        Verdict on the fit, and why it is rejected (empty if it is not rejected).
    name
        Name of the heliostat.
    flown
        Store numbers of its flight records, which are the last of ``sightings``.
    revealed
        What the fit reveals about the shared errors of the flights; None without flight records.
    """

    model: str
    fitted: FieldFit
    nominal: Mechanism
    sightings: Sightings
    before: float
    after: float
    outcome: CalibrationOutcome
    problem: str
    name: str
    flown: Identities
    revealed: tuple[FloatArray, FloatArray] | None = None

    @property
    def mechanism(self) -> Mechanism:
        """The fitted mechanism, batch shape (1,)."""
        return self.nominal.with_parameters(self.fitted.parameters)

    def record(
        self,
        beliefs: Beliefs,
        at: float,
        *,
        person: str,
        pushed: tuple[str, ...] = (),
        provenance: Provenance = Provenance.CAMERA,
        campaign: str = "",
    ) -> HeliostatCalibration:
        """Return the record of this fit for `Beliefs`, which already contain its photographs."""
        known, last = beliefs.known(self.name), beliefs.record(self.name)
        photographs = np.zeros(0, np.int64) if known is None else known.identities
        return HeliostatCalibration.from_fit(
            self.name,
            at,
            self.fitted,
            self.nominal,
            self.sightings,
            np.concatenate([photographs, self.flown]),
            model=self.model,
            provenance=provenance,
            person=person,
            campaign=campaign,
            pushed=pushed,
            version=1 if last is None else last.version + 1,
        )


@dataclass(frozen=True)
class Believed:
    """An immutable copy of what is believed about one heliostat when it is fitted.

    Attributes
    ----------
    name
        Name of the heliostat.
    nominal, present
        The mechanism of the design, and the mechanism believed now, batch shape (1,).
    hyper
        Hyperparameters of its group; None: they have not been learnt yet.
    flights
        Drone flights.
    """

    name: str
    nominal: Mechanism
    present: Mechanism
    hyper: Hyperparameters | None
    flights: Flights

    @classmethod
    def of(cls, beliefs: Beliefs, name: str) -> "Believed":
        """Return the present belief about a heliostat, with the flights that observed it."""
        flights = beliefs.flights if name in beliefs.flights else Flights()
        return cls(name, beliefs.nominal(name), beliefs.present(name), beliefs.hyper(name), flights)


def fit_heliostat(
    believed: Believed, settings: CycleSettings, model: OwnModel, photographed: Sightings
) -> JudgedFit:
    """Return the fit of one heliostat, by a model, to its photographs and its flight records.

    The fit follows all photographs and flight records through the drift up to the latest. It must
    explain the sightings of the last day, because apparent outliers may come from a mirror that
    moved an hour ago. If constant parameters explain these sightings better, the constants are
    proposed. Flight records share errors with other heliostats, which the joint fit of constants
    takes into account.
    """
    if believed.name in believed.flights:
        (constants,) = _fit_group(
            [believed], believed.flights, settings, model, believed.nominal, [photographed]
        )
        return _following(believed, settings, model, constants, photographed)
    still, moving = model.fitting(believed.nominal, photographed, believed.hyper)
    nothing = np.zeros(0, np.int64)
    return _better(believed, settings, model, photographed, nothing, still, moving)


def _following(
    believed: Believed,
    settings: CycleSettings,
    model: OwnModel,
    joint: JudgedFit,
    photographed: Sightings | None,
) -> JudgedFit:
    """Return the fit of a heliostat with flight records: following the drift, or constant."""
    sightings, flown = joint.sightings, believed.flights.flown(believed.name)
    photographs = sightings.take(np.zeros(0, np.intp)) if photographed is None else photographed
    moving = model.following(believed.nominal, photographs, joint.fitted, believed.hyper, flown)
    fit = _better(believed, settings, model, sightings, joint.flown, joint.fitted, moving)
    return replace(fit, revealed=joint.revealed)


def _better(
    believed: Believed,
    settings: CycleSettings,
    model: OwnModel,
    sightings: Sightings,
    flown: Identities,
    still: FieldFit,
    moving: FieldFit,
) -> JudgedFit:
    """Return the fit that follows the drift if it explains the last day, else the constant fit."""
    recent = sightings.take(np.flatnonzero(sightings.time >= sightings.time.max() - DAY))
    errors = [
        root_mean_square(
            beam_errors(believed.nominal.with_parameters(fitted.parameters), recent).beam
        )
        for fitted in (still, moving)
    ]
    if not errors[1] <= max(errors[0], EXPLAINED * settings.sigma):
        return _judged(believed, settings, model, still, sightings, flown)
    fit = _judged(believed, settings, model, moving, recent, flown)
    return replace(fit, sightings=sightings)


def _room(believed: Believed, settings: CycleSettings, flown: Identities) -> float:
    """Return the beam error due to motion within hours, which the fit cannot follow, rad RMS.

    For a photograph, its own sigma describes this motion well enough; a flight record is ten times
    as precise.
    """
    usual = ROOM * settings.sigma
    if not len(flown):
        return usual
    hyper = believed.hyper
    if hyper is None:
        motion = np.full(2, drift.START_RAD["hours"])
    else:
        hours = [process.group == "hours" for process in hyper.processes]
        motion = hyper.amplitude[np.array(hours, dtype=np.bool_)]
    # A beam rotates by twice the angle of the normal.
    return float(np.hypot(usual, 2.0 * np.linalg.norm(motion)))


def fit_flights(
    beliefs: Beliefs, flights: Flights, settings: CycleSettings, names: Sequence[str]
) -> dict[str, JudgedFit]:
    """Return the joint fits of many heliostats that share the errors of flights, by name.

    All heliostats are fitted with the model for few sightings; a calibration visit chooses a model
    for each heliostat. A heliostat whose fit is wrong must not contribute to the shared errors, so
    all other heliostats are fitted again without it.
    """
    fits_by_name: dict[str, JudgedFit] = {}
    groups: dict[int, list[str]] = {}
    for name in names:
        groups.setdefault(id(beliefs.design.find(name)[0]), []).append(name)
    # If there are several groups, each is fitted with the last result of the others.
    for _ in range(2 if len(groups) > 1 else 1):
        for members in groups.values():
            good = members
            for _ in range(2):
                fits = _fit_names(beliefs, flights, settings, good)
                fits_by_name.update(zip(good, fits, strict=True))
                unusable = {n for n, f in zip(good, fits, strict=True) if f.outcome in WRONG}
                for name, fit in zip(good, fits, strict=True):
                    size = len(flights.shared()[0])
                    nothing = np.zeros((size, size)), np.zeros(size)
                    flights.learn(name, *(nothing if name in unusable else fit.revealed or nothing))
                if not unusable or len(unusable) == len(good):
                    break
                good = [name for name in good if name not in unusable]
    return fits_by_name


def follow_flights(
    beliefs: Beliefs, flights: Flights, settings: CycleSettings, fits: Mapping[str, JudgedFit]
) -> dict[str, JudgedFit]:
    """Return the fits of `fit_flights`, continued through the drift, by name.

    Each fit replays all sightings of its heliostat.
    """
    followed = {}
    for name, joint in fits.items():
        known = beliefs.known(name)
        sightings = None if known is None else known.sightings
        model = first_model(settings, joint.nominal)
        believed = replace(Believed.of(beliefs, name), flights=flights)
        followed[name] = _following(believed, settings, model, joint, sightings)
    return followed


def first_model(settings: CycleSettings, mechanism: Mechanism) -> OwnModel:
    """Return the model of a heliostat with few sightings."""
    first = settings.first_model
    if isinstance(first, str):
        return OwnModel(first, parameter_table.model(first, mechanism.parameters))
    return OwnModel("+".join(first), tuple(first))


def _fit_names(
    beliefs: Beliefs, flights: Flights, settings: CycleSettings, names: Sequence[str]
) -> list[JudgedFit]:
    group = beliefs.design.find(names[0])[0]
    rows = np.array([group.index(name) for name in names], dtype=np.intp)
    sightings = [beliefs.known(name) for name in names]
    photographed = [None if known is None else known.sightings for known in sightings]
    model, believed = (
        first_model(settings, group.mechanism),
        [Believed.of(beliefs, n) for n in names],
    )
    return _fit_group(believed, flights, settings, model, group.mechanism[rows], photographed)


def _fit_group(
    believed: Sequence[Believed],
    flights: Flights,
    settings: CycleSettings,
    model: OwnModel,
    mechanism: Mechanism,
    photographed: Sequence[Sightings | None],
) -> list[JudgedFit]:
    sightings, common = flights.common([member.name for member in believed], photographed)
    common_fit = fit_common(model.start(mechanism), sightings, model.parameters, common)
    return [
        _of_one(member, settings, model, common_fit, i, flights.identities(member.name))
        for i, member in enumerate(believed)
    ]


def _of_one(
    believed: Believed,
    settings: CycleSettings,
    model: OwnModel,
    common_fit: CommonFit,
    i: int,
    flown: Identities,
) -> JudgedFit:
    whole, mine = common_fit.fitted, common_fit.sightings.heliostat == i
    row = slice(i, i + 1)
    fitted = replace(
        whole,
        values=whole.values[row],
        covariance=whole.covariance[row],
        prior=whole.prior[row],
        scale=whole.scale[row],
        lengths=whole.lengths[mine],
        count=whole.count[row],
        iterations=whole.iterations[row],
        outcome=whole.outcome[row],
        centre=whole.centre[row],
    )
    fitted = model.completed(fitted)
    judged = _judged(believed, settings, model, fitted, common_fit.sightings.of(i), flown)
    return replace(judged, revealed=(common_fit.information[i], common_fit.pull[i]))


def _judged(
    believed: Believed,
    settings: CycleSettings,
    model: OwnModel,
    fitted: FieldFit,
    sightings: Sightings,
    flown: Identities,
) -> JudgedFit:
    new = believed.nominal.with_parameters(fitted.parameters)
    before, after = (
        _weighted(beam_errors(m, sightings).beam, sightings) for m in (believed.present, new)
    )
    room = _room(believed, settings, flown)
    outcome, problem = _judge(settings, fitted, before, after, room)
    return JudgedFit(
        model.name,
        fitted,
        believed.nominal,
        sightings,
        before,
        after,
        outcome,
        problem,
        believed.name,
        flown,
    )


def _weighted(errors: FloatArray, sightings: Sightings) -> float:
    """Return the RMS of errors, weighted by sighting."""
    # Photographs all have the same sigma; a flight record may weigh a hundred times as much.
    weight = sightings.sigma**-2.0 / np.mean(sightings.sigma**-2.0)
    return root_mean_square(errors * np.sqrt(weight))


def _judge(
    settings: CycleSettings, fitted: FieldFit, before: float, after: float, room: float
) -> tuple[CalibrationOutcome, str]:
    """Return the outcome of a fit, and the reason if it is rejected."""
    ending = FitOutcome(int(fitted.outcome[0]))
    if ending is not FitOutcome.CONVERGED:
        return CalibrationOutcome.FIT_FAILED, ending.text
    # The worm ratio is found by a search, which has already tested its significance.
    fits = np.array([not name.endswith("_worm_ratio") for name in fitted.names])
    far = fits * np.abs(fitted.values[0]) / fitted.prior[0]
    if far.max() > settings.most:
        p = int(np.argmax(far))
        return CalibrationOutcome.IMPLAUSIBLE, (
            f"{fitted.names[p]} would be {far[p]:.1f} prior standard deviations from its "
            f"expected value, above the limit of {settings.most:g}; check the photographs and "
            "the installation"
        )
    if not after <= settings.left:
        return CalibrationOutcome.POOR_FIT, (
            f"the fit leaves {1e3 * after:.1f} mrad RMS, above the limit of "
            f"{1e3 * settings.left:g} mrad; check in the photographs that the beam is this "
            "heliostat's"
        )
    if not after <= settings.gain * np.hypot(before, room):
        return CalibrationOutcome.NO_BETTER, (
            f"the fit leaves {1e3 * after:.2f} mrad RMS, which is not below {settings.gain:g} "
            f"times the previous {1e3 * before:.2f} mrad"
        )
    return CalibrationOutcome.CALIBRATED, ""


def change_of(present: Mechanism, new: Mechanism, made: Sightings) -> float:
    """Return the largest beam change due to new parameters at the step counts of sightings, rad."""
    normals = [m[made.heliostat].pose(made.counts).normal for m in (present, new)]
    return 2.0 * float(angle_between(*normals).max())


def surprise_of(record: HeliostatCalibration, nominal: Mechanism, made: Sightings) -> float:
    """Return the largest distance of sightings from the prediction of a calibration, in sigma.

    Parameters
    ----------
    record
        The present calibration, whose covariance has grown since it was made.
    nominal
        The mechanism of the design, batch shape (1,).
    made
        New sightings, heliostat index 0.

    Returns
    -------
    float
        The largest distance, in its own standard deviations.
    """
    line = linearise(record.mechanism(nominal)[made.heliostat], made, record.names)
    spread = np.eye(2) + line.jacobian @ record.covariance_at(made.time) @ np.swapaxes(
        line.jacobian, -1, -2
    )
    square = np.einsum("mi,mij,mj->m", line.residual, np.linalg.inv(spread), line.residual)
    return float(np.sqrt(square.max()))
