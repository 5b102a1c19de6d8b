"""Predicts the field errors for the rest of a day, from the schedule's knowledge.

The prediction is a plan like a plan from `calibration.plan.plan_commission`, but with the
schedule's own visit times, photograph accuracy, minimum gain and goal.
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

#: Shortest and longest interval of the predicted curve, s.
_SHORT, _LONG = 120.0, 600.0
#: A visit is assumed to take at most this many times as long as expected, and at least the inverse
#: of it.
_MOST_PACE = 4.0
#: Number of joint or receiver visits from which their actual times are used.
_KNOWN = 3


@dataclass(frozen=True)
class JointVisitTime:
    """A joint visit that has ended.

    Attributes
    ----------
    mirrors
        Number of heliostats sent.
    worst
        Largest expected beam error among them on the target, rad RMS (2-D).
    seconds
        Duration of the visit.
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
        Number of heliostats that took part, and number whose beams were on the receiver.
    seconds
        Duration of the visit.
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
    """Return the terms of a plan with the visits of a schedule.

    Parameters
    ----------
    settings
        Settings of the schedule.
    joint
        Terms of the joint visits; None: there are none.
    pace
        Time per single visit that yields parameters, as a fraction of the expected time; NaN:
        unknown.
    joint_visits
        Completed joint visits; once there are enough, their times replace the expected times.
    receiver
        Terms of the receiver visits; None: there are none.
    receiver_visits
        Completed receiver visits; their times are used in the same way.
    """
    share = _share(pace)
    # Without a search, a beam that misses the target costs a whole visit.
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
    """Return the terms of joint visits, with actual times once there have been enough visits."""
    terms = JointTerms.of(joint, settings.sigma)
    if len(made) < _KNOWN:
        return terms
    expected = sum(terms.span(one.mirrors, own=one.worst > terms.known) for one in made)
    share = _share(sum(one.seconds for one in made) / expected)
    return replace(terms, step=share * terms.step, beside=share * terms.beside)


def _receiver_terms(terms: ReceiverTerms, made: Sequence[ReceiverVisitTime]) -> ReceiverTerms:
    """Return the terms of receiver visits, with actual times once there have been enough visits."""
    if len(made) < _KNOWN:
        return terms
    expected = sum(terms.span(one.mirrors, one.lit) for one in made)
    return replace(terms, pace=_share(sum(one.seconds for one in made) / expected))


def _share(pace: float) -> float:
    return float(np.clip(pace, 1.0 / _MOST_PACE, _MOST_PACE)) if np.isfinite(pace) else 1.0


@dataclass(frozen=True)
class FieldProspect:
    """The knowledge about a field at one moment; it is immutable, so any process may use it.

    Attributes
    ----------
    at
        POSIX s.
    site, targets
        Location and atmosphere, and the targets that may be used.
    fleets
        Heliostats with the *covariance* of their parameters in place of the information, which is
        computed beside the plant.
    size
        Longer side of the mirrors, m, (N,); this and the next two arrays are in the order of the
        fleets.
    measured, held
        Masks of the calibrated heliostats, and of the heliostats that cannot be measured on this
        day, (N,).
    terms
        Terms of the visits.
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
        """Return the present errors of the field."""
        field = ScaledField(self._informed(), self.terms.limits)
        found = error_percentiles(field.form, field.covariance, SHARES)
        return FieldPoint(self.at, *(0.5 * found).tolist())

    def outlook(self) -> Outlook | None:
        """Return the prediction; None if the sun is too low for the rest of the day."""
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
        # The pages show errors of the normal, which are half of the beam errors.
        curve = zip(plan.time.tolist(), (0.5 * plan.percentiles).tolist(), strict=True)
        points = tuple(FieldPoint(at, *shares) for at, shares in curve)
        able, goal = int((~self.held).sum()), 0.5 * self.terms.goal
        return Outlook(self.at, able, goal, plan.reached, points, _told(plan))

    def _interval(self) -> float:
        """Return the interval of the plan: the time in which all heliostats are visited once."""
        joint, count = self.terms.joint, len(self.held)
        each = self.terms.alone
        if joint is not None:
            each = joint.span(joint.most, own=False) / joint.most
        all_once = count * each / len(self.targets)
        return float(np.clip(all_once, _SHORT, _LONG))

    def _informed(self) -> list[Fleet]:
        return [replace(f, information=as_float(np.linalg.inv(f.information))) for f in self.fleets]


def _told(plan: CommissionPlan) -> str:
    """Describe the outcome in one sentence."""
    goal, high = 0.5e3 * plan.terms.goal, 0.5e3 * plan.percentiles[-1, 1]
    if plan.reached is not None:
        when = datetime.fromtimestamp(plan.reached, UTC)
        return f"90 % of the heliostats are within {goal:.2f} mrad by {when:%H:%M} UTC"
    return (
        f"90 % of the heliostats are within {high:.2f} mrad at the end of the day, short of the "
        f"goal of {goal:.2f} mrad; limited by {plan.limit}"
    )
