"""Verification of new parameters: one photograph of the beam at the position that they predict.

A fit explains whatever the photographs show, stray light as well as the beam. The heliostat
therefore returns to the target with its new parameters, to a position away from all earlier
photographs, and its beam must be where these parameters predict. The photograph tests a fit that
has not used it; once it has confirmed the fit, it becomes a sighting like any other.
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.fit.estimator import FieldFit
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.sightings import Sightings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant.visits.photographs import (
    CORNERS,
    Photographs,
    Shot,
    TargetCamera,
    Tell,
    measured,
    photographed,
    room_of,
    seen,
)
from heliotrope.plant.visits.settings import Centring, CycleSettings
from heliotrope.plant.visits.visit import Visit


class Confirming(Protocol):
    """A method of confirming new parameters that a local controller stores."""

    async def __call__(
        self, visit: Visit, fitted: FieldFit, nominal: Mechanism, used: list[Shot], tell: Tell
    ) -> str | None:
        """Return the reason why the parameters are not confirmed; see `Verification.problem`."""
        ...


@dataclass(frozen=True)
class Prediction:
    """The distance of a beam from the position that a fit predicts.

    Attributes
    ----------
    miss
        Distance as a beam angle, rad.
    reach
        Standard deviation of the distance in the direction of the miss, rad.
    deviations
        Distance in standard deviations (Mahalanobis).
    slant
        Distance of the target from the mirror, m.
    """

    miss: float
    reach: float
    deviations: float
    slant: float

    @classmethod
    def of(cls, mechanism: Mechanism, fitted: FieldFit, made: Sightings) -> "Prediction":
        """Return the distance of one sighting from the prediction of a fit.

        Parameters
        ----------
        mechanism
            Mechanism with the fitted parameters, batch shape (1,).
        fitted
            The fit, of batch shape (1,).
        made
            One sighting that the fit did not use, heliostat index 0.
        """
        line = linearise(mechanism, made, tuple(fitted.names))
        slope = line.jacobian[0]
        # The whitened residual has unit noise of its own, in addition to that of the parameters.
        spread = np.eye(2) + slope @ fitted.covariance[0] @ slope.T
        residual = line.residual[0]
        deviations = float(np.sqrt(residual @ np.linalg.solve(spread, residual)))
        miss = float(beam_errors(mechanism, made).beam[0])
        vertex = mechanism.pose(made.counts).vertex[0]
        slant = float(np.linalg.norm(made.destination[0] - vertex))
        return cls(miss, miss / max(deviations, 1e-9), deviations, slant)


class Verification:
    """The photograph that confirms new parameters.

    Parameters
    ----------
    camera
        Camera of the targets.
    settings, centring
        See their classes.
    sighting
        Function that creates a sighting from a shot and the step counts at its exposure.
    """

    def __init__(
        self,
        camera: TargetCamera,
        settings: CycleSettings,
        centring: Centring,
        sighting: Callable[[Shot, FloatArray], Sightings],
    ) -> None:
        self._camera, self._settings, self._centring = camera, settings, centring
        self._sighting = sighting
        self._alone: dict[str, asyncio.Lock] = {}
        self._confirmed: dict[str, Photographs] = {}

    def confirmed(self, heliostat: str) -> Photographs | None:
        """Return the photograph that confirmed a heliostat's last fit, only once; else None."""
        return self._confirmed.pop(heliostat, None)

    def judge(
        self, nominal: Mechanism, fitted: FieldFit, shot: Shot, counts: FloatArray
    ) -> str | None:
        """Return the reason why a shot, with its step counts, does not confirm a fit."""
        return self._judge(nominal, fitted, self._sighting(shot, counts))

    async def problem(
        self, visit: Visit, fitted: FieldFit, nominal: Mechanism, used: list[Shot], tell: Tell
    ) -> str | None:
        """Return the reason why the new parameters are not confirmed; None if they are.

        The heliostat already stores the new parameters. It is at standby before and after.

        Parameters
        ----------
        visit
            Visit of the heliostat.
        fitted, nominal
            The fit of batch shape (1,), and the mechanism from which it starts.
        used
            The photographs that the fit used in this visit.
        tell
            Called with the name of each step.

        Raises
        ------
        RefusedError
            If a command is refused, or the heliostat does not carry it out.
        """
        # If several heliostats are verified after a joint visit, one goes to the target at a time.
        async with self._alone.setdefault(visit.target.name, asyncio.Lock()):
            return await self._photographed(visit, fitted, nominal, used, tell)

    async def _photographed(
        self, visit: Visit, fitted: FieldFit, nominal: Mechanism, used: list[Shot], tell: Tell
    ) -> str | None:
        self._confirmed.pop(visit.heliostat, None)
        point = apart(visit.target, [shot.point for shot in used], room_of(visit, self._centring))
        if why := visit.plant.misled(visit.heliostat, point):
            return (
                "with the new parameters the path to the verification photograph is not free: "
                f"{why}"
            )
        async with visit:
            tell("verification")
            await visit.go(self._settings.arrival, point)
            for _ in range(self._settings.shots):
                shot = await photographed(self._camera, visit)
                if not shot.reasons and seen(visit.target, shot) is not None:
                    made = await measured(visit, shot)
                    if problem := self.judge(nominal, fitted, *made):
                        return problem
                    self._confirmed[visit.heliostat] = Photographs([made])
                    return None
                why = "; ".join(shot.reasons) or "no light on the target"
        return f"with the new parameters no photograph could be used: {why}"

    def _judge(self, nominal: Mechanism, fitted: FieldFit, made: Sightings) -> str | None:
        mechanism = nominal.with_parameters(fitted.parameters)
        found, most = Prediction.of(mechanism, fitted, made), self._settings.agreement
        if found.deviations <= most and found.miss <= self._settings.left:
            return None
        allowed = min(most * found.reach, self._settings.left)
        return (
            f"with the new parameters the beam is {found.slant * found.miss:.2f} m from its "
            f"predicted position, and only {found.slant * allowed:.2f} m are allowed; check in "
            "the photographs that the beam is this heliostat's"
        )


def apart(target: Target, points: list[FloatArray], room: float) -> FloatArray:
    """Return the aim on a target that is farthest from points already photographed, (3,).

    At this aim, stray light that does not move cannot be where the beam is predicted.

    Parameters
    ----------
    target
        The target.
    points
        Positions of the photographs, ENU, m, each (3,).
    room
        How far the beam may be moved off the middle, right and up, m.
    """
    places = room * np.array([(0.0, 0.0), *CORNERS])
    before = target.plane_coordinates(np.reshape(points, (-1, 3)))
    away: npt.NDArray[np.float64] = np.linalg.norm(places[:, None] - before, axis=-1).min(axis=-1)
    return np.asarray(target.point(places[int(np.argmax(away))]))
