"""The calibration cycle: photographs of one mirror's beam to a better mirror.

A heliostat is sent to a calibration target, photographed there, and brought back to its standby
point. The sighting joins those that are known of it; all of them together are fitted, and what
is better than before is pushed to the local controller and read back. Nothing is pushed that has
not earned it: too few sightings, a fit that did not settle, values far from what an installation
can be, or a fit that misses by more than before leave the heliostat as it was.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from typing import Protocol

import numpy as np
import numpy.typing as npt

from heliotrope import sun
from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.fit.estimator import FieldFit, FitOutcome, fit
from heliotrope.calibration.sightings import Sightings, camera_target, join
from heliotrope.errors import InputError
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.mechanism.board_items import CALIBRATION_ITEMS, differing, items_of
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant.authority import Person, RefusedError
from heliotrope.plant.controller import PlantController
from heliotrope.plant.visits.visit import Visit


@dataclass(frozen=True)
class Shot:
    """What a photograph of a target shows of one beam.

    Attributes
    ----------
    point
        Centroid, ENU, m, (3,).
    at
        Middle of the exposure, s of the plant's monotonic clock.
    covariance
        Of the point, m²: a variance or (3, 3).
    reasons
        Why it may not be believed; () if it may.
    """

    point: FloatArray
    at: float
    covariance: npt.ArrayLike = 0.0
    reasons: tuple[str, ...] = ()


class Camera(Protocol):
    """Takes photographs of targets and reads them."""

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """Return what is seen now of a heliostat's beam."""
        ...


@dataclass(frozen=True)
class CycleSettings:
    """Of a calibration cycle.

    Attributes
    ----------
    shots, interval
        Photographs of one visit, and the time between them, s.
    arrival
        For getting to the target, s.
    model
        Parameters that are fitted; see `calibration.estimator.fit`.
    least
        Sightings that a fit needs, all visits together.
    sigma
        Standard deviation of a beam beside that of its centroid, rad.
    most
        Deviation of a parameter, in standard deviations of its prior, that is believed.
    gain
        Largest share of the error before, RMS over all sightings, that may be left.
    left
        Beam error that a believable fit may leave, rad RMS: a robust fit settles on nonsense too.
    """

    shots: int = 3
    interval: float = 20.0
    arrival: float = 300.0
    model: str | tuple[str, ...] = "malan8"
    least: int = 3
    sigma: float = 5e-4
    most: float = 6.0
    gain: float = 1.0
    left: float = 3e-3

    def __post_init__(self) -> None:
        if self.shots < 1 or self.least < 1 or not self.interval >= 0.0:
            raise InputError(
                f"calibration cycle: {self.shots} shots {self.interval} s apart, at least "
                f"{self.least} sightings; give 1 or more, 0 s or more, 1 or more"
            )


@dataclass(frozen=True)
class CycleResult:
    """What a cycle brought.

    Attributes
    ----------
    heliostat
        Whose.
    sightings
        All that are known of it now, those of this visit last.
    rejected
        Why photographs were not used.
    before, after
        RMS error of the beam over the sightings, rad: as it was, and fitted; NaN without fit.
    values
        Deviations from the nominal mechanism that hold now, by name of the parameter.
    pushed
        Items that were written and read back.
    text
        One line; begins with "calibrated" if the heliostat has new parameters.
    """

    heliostat: str
    sightings: Sightings | None
    rejected: tuple[str, ...]
    before: float
    after: float
    values: Mapping[str, float]
    pushed: tuple[str, ...]
    text: str


class CalibrationCycle:
    """Calibrates heliostats of a plant, one visit at a time.

    Parameters
    ----------
    plant
        Running.
    camera
        Sees its targets.
    settings
        See `CycleSettings`.

    Attributes
    ----------
    known
        Sightings by heliostat; may be filled with those of earlier campaigns (heliostat row 0).
    values
        Deviations that hold, by heliostat; at first those of the design.
    """

    def __init__(
        self, plant: PlantController, camera: Camera, settings: CycleSettings | None = None
    ) -> None:
        self._plant, self._camera = plant, camera
        self._settings = settings or CycleSettings()
        self.known: dict[str, Sightings] = {}
        self.values: dict[str, dict[str, float]] = {}

    def mechanism(self, heliostat: str) -> tuple[Mechanism, Mechanism]:
        """Return the nominal and the present mechanism, each of batch shape (1,)."""
        group, row = self._plant.design.find(heliostat)
        nominal = group.mechanism[np.array([row])]
        values = self.values.get(heliostat)
        if values is None:
            values = {name: float(v[row]) for name, v in group.parameters.items()}
        return nominal, nominal.with_parameters(values)

    async def run(self, person: Person, token: int, heliostat: str, target: str) -> CycleResult:
        """Calibrate one heliostat, and bring it back to where it was: standby, or its aim.

        The person keeps the command authority up meanwhile. If it is lost the beam is taken off
        the target, and nothing is changed.

        Parameters
        ----------
        person, token
            An engineer, with the token of the authority.
        heliostat, target
            Names.

        Raises
        ------
        RefusedError
            If a command is refused, or the heliostat does not do what it was told.
        UnknownNameError
            If there is no such heliostat or target.
        """
        plant = self._plant
        plant.authority.check(person, token, "PARAMETERS")
        visit = Visit(plant, person, token, heliostat, plant.design.target(target))
        tracked = visit.state == states.TRACKING
        aim = plant.aims[visit.row].copy()
        async with visit:
            await visit.go(self._settings.arrival)
            seen, rejected = await self._shoot(visit)
        result = await self._learn(visit, seen, tuple(rejected))
        if tracked and np.isfinite(aim).all():
            await visit.aim(aim)
            await visit.command("TRACK")
        return result

    async def _shoot(self, visit: Visit) -> tuple[list[Sightings], list[str]]:
        """Take the photographs of a visit; return sightings, and why others are none."""
        plant, settings = self._plant, self._settings
        found: list[Sightings] = []
        rejected: list[str] = []
        for k in range(settings.shots):
            due = plant.now() + settings.interval
            shot = await self._camera.photograph(visit.target, visit.heliostat)
            if visit.state != states.TRACKING:
                raise RefusedError(f"{visit.heliostat}: it left its aim while it was photographed")
            if shot.reasons:
                rejected.append(f"photograph {k + 1}: {'; '.join(shot.reasons)}")
            else:
                found.append(self._sighting(shot, await visit.counts_at(shot.at)))
            if k + 1 < settings.shots:
                while plant.now() < due:
                    await visit.look()
        return found, rejected

    def _sighting(self, shot: Shot, counts: FloatArray) -> Sightings:
        plant = self._plant
        utc = plant.clock.utc() - timedelta(seconds=plant.now() - shot.at)
        covariance = np.asarray(shot.covariance, dtype=np.float64)
        return camera_target(
            0,
            counts[None],
            sun.vector(utc, plant.design.site)[None],
            shot.point[None],
            time=utc.timestamp(),
            sigma=self._settings.sigma,
            centroid_covariance=covariance,
        )

    async def _learn(
        self, visit: Visit, seen: list[Sightings], rejected: tuple[str, ...]
    ) -> CycleResult:
        """Fit all sightings and push what is better."""
        name, settings = visit.heliostat, self._settings
        old = [self.known[name]] if name in self.known else []
        every = join(old + seen) if old or seen else None
        nominal, present = self.mechanism(name)
        values = self.values.get(name, {})

        def result(
            text: str, before: float = np.nan, after: float = np.nan, pushed: tuple[str, ...] = ()
        ) -> CycleResult:
            held = self.values.get(name, values)
            return CycleResult(name, every, rejected, before, after, held, pushed, text)

        if every is None:
            return result("unchanged: no photograph could be used")
        self.known[name] = every
        if len(every) < settings.least:
            return result(f"unchanged: {len(every)} sightings, {settings.least} are needed")
        fitted = fit(nominal, every, settings.model)
        new = nominal.with_parameters(fitted.parameters)
        before, after = _rms(present, every), _rms(new, every)
        problem = self._problem(fitted, before, after)
        if problem:
            if not old:
                # Nothing stands against what these say but that it is nonsense.
                del self.known[name]
                every = None
            return result(f"unchanged: {problem}", before, after)
        pushed = await self._push(visit, new[0])
        self.values[name] = {p: float(v[0]) for p, v in fitted.parameters.items()}
        row = visit.row
        self._plant.beams.replace(row, new[0].armature.table, new[0].drives.table)
        text = f"calibrated: beam error {1e3 * before:.2f} to {1e3 * after:.2f} mrad RMS"
        return result(f"{text} over {len(every)} sightings", before, after, pushed)

    def _problem(self, fitted: FieldFit, before: float, after: float) -> str:
        """Return why a fit is not to be used, "" if it is."""
        settings = self._settings
        outcome = FitOutcome(int(fitted.outcome[0]))
        if outcome is not FitOutcome.CONVERGED:
            return outcome.text
        far = np.abs(fitted.values[0]) / fitted.prior[0]
        if far.max() > settings.most:
            p = int(np.argmax(far))
            return (
                f"{fitted.names[p]} would be {far[p]:.1f} standard deviations of its prior, "
                f"above {settings.most:g}; look at the photographs and the installation"
            )
        if not after <= settings.left:
            return (
                f"the fit leaves {1e3 * after:.1f} mrad RMS, above {1e3 * settings.left:g} mrad; "
                "look at the photographs: is it this heliostat's beam?"
            )
        if not after <= settings.gain * before:
            return (
                f"the fit misses by {1e3 * after:.2f} mrad RMS, not below {settings.gain:g} times "
                f"the {1e3 * before:.2f} mrad before"
            )
        return ""

    async def _push(self, visit: Visit, mechanism: Mechanism) -> tuple[str, ...]:
        """Write what differs, and read it back."""
        plant, name = self._plant, visit.heliostat
        wanted = items_of(mechanism)
        missing = differing(wanted, await plant.stored(name))
        if not missing:
            return ()
        locked = not CALIBRATION_ITEMS.issuperset(missing)
        if locked:
            # Drives are only exchanged while nothing can move.
            await visit.command("LOCK")
        items = {item: wanted[item] for item in missing}
        await visit.obey(plant.parameters(visit.person, visit.token, name, items), 60.0)
        left = differing(wanted, await plant.stored(name))
        if left:
            raise RefusedError(
                f"{name}: {', '.join(left)} read back other than written; look at its flash"
            )
        if locked:
            await visit.command("UNLOCK")
            await visit.command("IDLE")
        return missing


def _rms(mechanism: Mechanism, seen: Sightings) -> float:
    """Return the beam's error, rad RMS in two dimensions."""
    return float(np.sqrt(np.mean(beam_errors(mechanism, seen).beam ** 2)))
