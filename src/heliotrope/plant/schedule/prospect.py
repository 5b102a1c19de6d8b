"""Predicts the field errors for the rest of a day, from the schedule's knowledge.

The prediction is a plan as from `calibration.plan.plan_commission`, with the schedule's own visit
times, photograph accuracy, minimum gain and goal.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.plan import (
    CommissionPlan,
    CommissionTerms,
    Fleet,
    plan_commission,
)
from heliotrope.calibration.plan.commission import SHARES
from heliotrope.calibration.plan.joint_terms import JointTerms
from heliotrope.calibration.plan.percentiles import error_percentiles
from heliotrope.calibration.plan.receiver_terms import ReceiverTerms
from heliotrope.calibration.plan.scaled_field import ScaledField
from heliotrope.errors import InputError
from heliotrope.field.coded_visits import JointSettings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, as_float
from heliotrope.plant.operations.solar_day import end_of_day
from heliotrope.plant.schedule.settings import Settings
from heliotrope.store.records import FieldPoint, Outlook
from heliotrope.sun import Site

#: Least and longest interval of the predicted curve, s.
_SHORT, _LONG = 120.0, 600.0
#: A visit takes at most this many times as long as the schedule expects, or the inverse.
_MOST_PACE = 4.0
#: Joint visits, and receiver visits, from which their true times count.
_KNOWN = 3


@dataclass(frozen=True)
class JointVisitTime:
    """A joint visit that has ended.

    Attributes
    ----------
    mirrors
        How many were sent.
    worst
        Largest beam error that was expected of them on the target, rad RMS (2-D).
    seconds
        Its time.
    """

    mirrors: int
    worst: float
    seconds: float


@dataclass(frozen=True)
class ReceiverVisitTime:
    """A receiver visit that has ended.

    Attributes
    ----------
    mirrors, lit
        How many took part, and how many shone on the receiver.
    seconds
        Its time.
    """

    mirrors: int
    lit: int
    seconds: float


def terms_of(
    settings: Settings,
    joint: JointSettings | None,
    pace: float = np.nan,
    joint_visits: Sequence[JointVisitTime] = (),
    receiver: ReceiverTerms | None = None,
    receiver_visits: Sequence[ReceiverVisitTime] = (),
) -> CommissionTerms:
    """Return the terms of a plan whose visits are those of a schedule.

    Parameters
    ----------
    settings
        Of the schedule.
    joint
        Of the joint visits; None: there are none.
    pace
        Time of a visit alone that gives parameters, as a share of the expected time; NaN: unknown.
    joint_visits
        Joint visits: once there are some, their times take the place of the expected ones.
    receiver
        Of the receiver visits; None: there are none.
    receiver_visits
        Receiver visits: their times count as those of joint visits do.
    """
    share = _share(pace)
    # Without a search, a beam that misses costs a whole visit.
    look = settings.visit if settings.look is None else settings.look
    return CommissionTerms(
        goal=settings.goal,
        settle=share * settings.settle,
        shots=settings.shots,
        interval=share * settings.interval,
        look=share * look,
        sigma=settings.sigma,
        worth=settings.worth,
        limits=settings.limits,
        joint=None if joint is None else _joint_terms(settings, joint, joint_visits),
        receiver=None if receiver is None else _receiver_terms(receiver, receiver_visits),
    )


def _joint_terms(
    settings: Settings, joint: JointSettings, made: Sequence[JointVisitTime]
) -> JointTerms:
    """Return the joint visits; after some of them, with their true times."""
    terms = JointTerms.of(joint, settings.sigma)
    if len(made) < _KNOWN:
        return terms
    expected = sum(terms.span(one.mirrors, own=one.worst > terms.known) for one in made)
    share = _share(sum(one.seconds for one in made) / expected)
    return replace(terms, step=share * terms.step, beside=share * terms.beside)


def _receiver_terms(terms: ReceiverTerms, made: Sequence[ReceiverVisitTime]) -> ReceiverTerms:
    """Return the receiver visits; after some of them, with their true times."""
    if len(made) < _KNOWN:
        return terms
    expected = sum(terms.span(one.mirrors, one.lit) for one in made)
    return replace(terms, pace=_share(sum(one.seconds for one in made) / expected))


def _share(pace: float) -> float:
    return float(np.clip(pace, 1.0 / _MOST_PACE, _MOST_PACE)) if np.isfinite(pace) else 1.0


@dataclass(frozen=True)
class FieldProspect:
    """The knowledge of a field at one moment; nothing in it changes, so any process may use it.

    Attributes
    ----------
    at
        POSIX s.
    site, targets
        Place and air, and the targets that may be used.
    fleets
        Heliostats with the *covariance* of their parameters in place of the information, which is
        computed beside the plant.
    size
        Larger side of the mirrors, m, (N,), in the order of the fleets as what follows.
    measured, held
        Heliostats that are calibrated, and those that cannot be measured on this day, (N,).
    terms
        Of the visits.
    """

    at: float
    site: Site
    targets: tuple[Target, ...]
    fleets: tuple[Fleet, ...]
    size: FloatArray
    measured: npt.NDArray[np.bool_]
    held: npt.NDArray[np.bool_]
    terms: CommissionTerms

    def now(self) -> FieldPoint:
        """Return the errors of the field."""
        field = ScaledField(self._informed(), self.terms.limits)
        found = error_percentiles(field.form, field.covariance, SHARES)
        return FieldPoint(self.at, *(0.5 * found).tolist())

    def outlook(self) -> Outlook | None:
        """Return the prediction, None if the sun is too low for the rest of the day."""
        try:
            plan = plan_commission(
                self._informed(),
                self.site,
                self.targets,
                self.at,
                end_of_day(self.at, self.site),
                size=self.size,
                measured=self.measured,
                held=self.held,
                terms=replace(self.terms, every=self._interval()),
            )
        except InputError:
            return None
        # Pages show errors of the normal, half of those of the beam.
        curve = zip(plan.time.tolist(), (0.5 * plan.percentiles).tolist(), strict=True)
        points = tuple(FieldPoint(at, *shares) for at, shares in curve)
        able, goal = int((~self.held).sum()), 0.5 * self.terms.goal
        return Outlook(self.at, able, goal, plan.reached, points, _told(plan))

    def _interval(self) -> float:
        """Return the time in which all are visited: a plan visits each once in an interval."""
        joint, count = self.terms.joint, len(self.held)
        each = self.terms.alone
        if joint is not None:
            each = joint.span(joint.most, own=False) / joint.most
        all_once = count * each / len(self.targets)
        return float(np.clip(all_once, _SHORT, _LONG))

    def _informed(self) -> list[Fleet]:
        return [replace(f, information=as_float(np.linalg.inv(f.information))) for f in self.fleets]


def _told(plan: CommissionPlan) -> str:
    """Return the outcome in one sentence."""
    goal, high = 0.5e3 * plan.terms.goal, 0.5e3 * plan.percentiles[-1, 1]
    if plan.reached is not None:
        when = datetime.fromtimestamp(plan.reached, UTC)
        return f"90 % of the heliostats are within {goal:.2f} mrad by {when:%H:%M} UTC"
    return (
        f"90 % of the heliostats are within {high:.2f} mrad at the end of the day, not within "
        f"{goal:.2f} mrad; limited by {plan.limit}"
    )
