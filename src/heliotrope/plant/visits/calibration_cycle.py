"""The calibration cycle: from photographs of one heliostat's beam to better parameters.

A heliostat goes to a calibration target, is photographed there, and returns. Its new sightings are
added to those already known; all of them together are fitted once, and the drift is followed
through them to the present (`calibration.learn.present`). A fit that is better than the present
calibration is sent to the local controller, read back, and adopted as the heliostat's calibration.
Nothing is sent after too few sightings, a fit that did not converge, values far outside the range
of a plausible installation, or a fit with a larger error than before; the heliostat then keeps its
present calibration. A first calibration, a large change, and a calibration from photographs that
the present calibration did not predict are confirmed by one more photograph before they are
adopted; if this photograph contradicts them, the old parameters are sent back. The confirming
photograph is included in the learning afterwards.
"""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from datetime import timedelta

import numpy as np

from heliotrope import sun
from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.plausibility import judge
from heliotrope.calibration.record import (
    CalibrationOutcome,
    HeliostatCalibration,
    root_mean_square,
)
from heliotrope.calibration.sightings import Sightings, camera_target, join
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded import Verdict
from heliotrope.mechanism.board_items import differing, items_of
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant.controller import PlantController
from heliotrope.plant.field.drive_checks import PHOTOGRAPH
from heliotrope.plant.orders.authority import Mandate, Person, RefusedError
from heliotrope.plant.visits.coded_visit import Returned
from heliotrope.plant.visits.fitting import (
    Believed,
    JudgedFit,
    change_of,
    fit_heliostat,
    surprise_of,
)
from heliotrope.plant.visits.model_of_each import ModelOfEach
from heliotrope.plant.visits.neighbours import Standing, Unhidden, UnhiddenCamera
from heliotrope.plant.visits.photographs import (
    Centred,
    Photographing,
    Photographs,
    Plain,
    Shot,
    TargetCamera,
    Tell,
)
from heliotrope.plant.visits.settings import Centring, CycleSettings
from heliotrope.plant.visits.verification import Confirming, Verification
from heliotrope.plant.visits.visit import Visit
from heliotrope.plant.workers import Worker, at_once

#: Doubtful step counts are confirmed by photographs that miss by no more than this, rad RMS, the
#: limit at which `pointing_disagrees` trips.
PLACED = 3e-3


@dataclass(frozen=True)
class CycleResult:
    """The result of a cycle.

    Attributes
    ----------
    heliostat
        Name.
    outcome
        Whether the heliostat has a new calibration, or why not.
    text
        The outcome in words, for display, in one line.
    rejected
        Why photographs were not used, in words.
    known, new
        Number of sightings now known for the heliostat, and how many of them this visit added.
    measured
        Beam error in this visit's photographs under the previous calibration, rad RMS; NaN if there
        was no previous calibration or no photograph.
    before, after
        Beam error over all sightings under the previous calibration and after the fit, rad RMS; NaN
        without a fit.
    record
        The new calibration; None if nothing changed.
    verdict
        What a joint visit reveals about the heliostat; None for a single visit.
    """

    heliostat: str
    outcome: CalibrationOutcome
    text: str
    rejected: tuple[str, ...] = ()
    known: int = 0
    new: int = 0
    measured: float = float("nan")
    before: float = float("nan")
    after: float = float("nan")
    record: HeliostatCalibration | None = None
    verdict: Verdict | None = None

    def then(self, again: "CycleResult") -> "CycleResult":
        """Return this result combined with ``again``, the result of the verification."""
        new, known = self.new + again.new, max(self.known, again.known)
        if again.record is None:
            return replace(self, known=known, new=new)
        return replace(
            again,
            text=_calibrated(self.before, again.after, again.known),
            rejected=self.rejected,
            new=new,
            measured=self.measured,
            before=self.before,
        )


def refused(mandate: Mandate, heliostat: str, text: str) -> CycleResult:
    """Return the result for a heliostat that was refused, or removed from its visit."""
    taken = heliostat in mandate.blameless
    outcome = CalibrationOutcome.TAKEN_OUT if taken else CalibrationOutcome.REFUSED
    return CycleResult(heliostat, outcome, text)


@dataclass(frozen=True)
class Leaving:
    """How a heliostat leaves the receiver that it tracks, only to store new parameters.

    Attributes
    ----------
    worth
        Smallest change of its beam that justifies leaving, rad.
    leave
        Function that brings the heliostat to standby.
    """

    worth: float
    leave: Callable[[Visit], Awaitable[None]]


class CalibrationCycle:
    """Calibration of the heliostats of a plant, one visit at a time.

    Parameters
    ----------
    plant
        Running plant; its `beliefs` take the new calibrations.
    camera
        Camera of its targets.
    settings
        See `CycleSettings`.
    centring
        Search and centring of a beam that misses; None: photographs are taken without a search.
    unhidden
        Corrects centroids for shading and blocking by neighbours; None: centroids are used
        uncorrected.
    worker
        Computes fits.

    Attributes
    ----------
    settings
        See `CycleSettings`.
    worker
        As given.
    unhidden
        As given.
    verification
        Verifies new parameters with a photograph.
    """

    def __init__(
        self,
        plant: PlantController,
        camera: TargetCamera,
        settings: CycleSettings | None = None,
        centring: Centring | None = None,
        unhidden: Unhidden | None = None,
        worker: Worker = at_once,
    ) -> None:
        self.worker = worker
        self._plant, self.settings, self.unhidden = plant, settings or CycleSettings(), unhidden
        camera = camera if unhidden is None else UnhiddenCamera(camera, unhidden)
        self._camera, self._centring = camera, centring or Centring()
        self._photographing: Photographing = (
            Plain(camera, self.settings)
            if centring is None
            else Centred(camera, self.settings, centring)
        )
        self._models = ModelOfEach(self.settings, worker)
        self.verification = Verification(
            camera, self.settings, centring or Centring(), self._sighting
        )

    async def run(
        self, person: Person, token: int, heliostat: str, target: str, tell: Tell | None = None
    ) -> CycleResult:
        """Calibrate one heliostat, and return it to standby or to its aim, where it was before.

        The visit works under its own mandate, and continues whoever takes the command authority in
        the meantime. An operator's order to the heliostat ends the visit.

        Parameters
        ----------
        person, token
            An engineer, with the token of the command authority.
        heliostat, target
            Names.
        tell
            Called with the name of each step.

        Raises
        ------
        RefusedError
            If a command is refused, or the heliostat does not carry it out.
        UnknownNameError
            If there is no such heliostat or target.
        """
        plant = self._plant
        place = plant.design.target(target)
        with plant.authority.mandate(person, token, (heliostat,), target) as mandate:
            visit = Visit(plant, mandate, heliostat, place)
            async with Returned(plant, mandate, (heliostat,), place):
                async with visit:
                    await visit.go(self.settings.arrival)
                    taken = await self._photographing.take(visit, tell or _nobody)
                return await self.learn(visit, taken, tell)

    async def search(
        self, person: Person, token: int, heliostat: str, target: str, tell: Tell | None = None
    ) -> CycleResult:
        """Search for the beam of one heliostat on a target with the camera; learn nothing.

        The parameters are those of `run`.
        """
        plant, place = self._plant, self._plant.design.target(target)
        searching = Centred(self._camera, self.settings, self._centring)
        with plant.authority.mandate(person, token, (heliostat,), target) as mandate:
            visit = Visit(plant, mandate, heliostat, place)
            async with Returned(plant, mandate, (heliostat,), place), visit:
                await visit.go(self.settings.arrival)
                missed, why = await searching.search(visit, tell or _nobody)
        if missed is None:
            return CycleResult(heliostat, CalibrationOutcome.NO_BEAM, f"searched: {why}")
        slant = np.linalg.norm(plant.beams.armature.origin_1[visit.row] - visit.target.center)
        ways = f"{missed[0]:+.2f} m to the right and {missed[1]:+.2f} m up"
        angle = 1e3 * float(np.linalg.norm(missed) / slant)
        text = f"searched: the beam misses its aim by {ways}, {angle:.1f} mrad; nothing was changed"
        return CycleResult(heliostat, CalibrationOutcome.UNCHANGED, text)

    def _missed(self, heliostat: str, taken: Photographs) -> float:
        """Return the beam error of photographs under the present calibration, rad RMS."""
        seen = join([self._sighting(shot, counts) for shot, counts in taken.used])
        return root_mean_square(beam_errors(self._plant.beliefs.present(heliostat), seen).beam)

    def _witness(self, heliostat: str, taken: Photographs) -> str | None:
        """Check the sun direction by photographs; return why they must not be used, or None."""
        if not taken.used:
            return None
        beliefs = self._plant.beliefs
        seen = join([self._sighting(shot, counts) for shot, counts in taken.used])
        return self._plant.witnesses.photographed(
            beliefs.record(heliostat), beliefs.present(heliostat), seen
        )

    def _plausible(
        self, heliostat: str, taken: Photographs
    ) -> tuple[list[Sightings], tuple[str, ...]]:
        """Return the plausible sightings, and a line for each rejected photograph."""
        made = [self._sighting(shot, counts) for shot, counts in taken.used]
        nominal = self._plant.beliefs.nominal(heliostat)
        reasons = judge(join(made), mechanism=nominal).reasons if made else {}
        new = [seen for k, seen in enumerate(made) if k not in reasons]
        return new, (*taken.rejected, *(f"photograph: {text}" for text in reasons.values()))

    def _sighting(self, shot: Shot, counts: FloatArray) -> Sightings:
        plant = self._plant
        utc = plant.clock.utc() - timedelta(seconds=plant.now() - shot.at)
        return camera_target(
            0,
            counts[None],
            sun.vector(utc, plant.design.site)[None],
            shot.point[None],
            time=utc.timestamp(),
            sigma=self.settings.sigma,
            centroid_covariance=np.asarray(shot.covariance, dtype=np.float64),
        )

    async def alone(
        self, target: Target, heliostat: str, shot: Shot, standing: Standing | None
    ) -> Shot:
        """Return a shot, corrected for obstruction by neighbours; see `Unhidden.shot`."""
        if self.unhidden is None:
            return shot
        return await self.unhidden.shot(target, heliostat, shot, standing)

    async def learn(
        self,
        visit: Visit,
        taken: Photographs,
        tell: Tell | None = None,
        *,
        confirming: Confirming | None = None,
        least: int | None = None,
        leaving: Leaving | None = None,
    ) -> CycleResult:
        """Learn from the photographs of a heliostat that is at standby; see `run`.

        Parameters
        ----------
        visit, taken
            The heliostat's visit, and the photographs.
        tell
            Called with the name of each step.
        confirming
            Confirms new parameters; None: a photograph of this heliostat alone.
        least
            Minimum number of sightings for the fit; None: as in the settings.
        leaving
            How the heliostat leaves the receiver that it tracks, which it does only if its
            parameters change. A change that a photograph must confirm is left to a visit to a
            target. None: the heliostat is at standby.
        """
        fewest = self.settings.least if least is None else least
        confirm, say = confirming or self.verification.problem, tell or _nobody
        if why := self._witness(visit.heliostat, taken):
            return CycleResult(visit.heliostat, CalibrationOutcome.UNCHANGED, why)
        result = await self._learn(visit, taken, say, confirm, fewest, leaving)
        proof = self.verification.confirmed(visit.heliostat)
        if proof is not None and result.outcome.calibrated:
            say("learning from the verification")
            result = result.then(await self._again(visit, proof, say, fewest))
        if taken.used and self._missed(visit.heliostat, taken) <= PLACED:
            self._plant.doubtful.confirm(visit.heliostat, visit.boots)
            self._plant.drive_checks.observed(visit.heliostat, PHOTOGRAPH)
        return result

    async def _again(self, visit: Visit, proof: Photographs, tell: Tell, least: int) -> CycleResult:
        """Learn from a photograph that confirmed a fit; the adopted calibration stays unchanged."""
        confirm = self.verification.problem
        try:
            return await self._learn(visit, proof, tell, confirm, least, None)
        except RefusedError as error:
            return refused(visit.mandate, visit.heliostat, str(error))

    async def _learn(
        self,
        visit: Visit,
        taken: Photographs,
        tell: Tell,
        confirming: Confirming,
        least: int,
        leaving: Leaving | None,
    ) -> CycleResult:
        """Fit all sightings once; send, verify and adopt a better fit."""
        name, beliefs = visit.heliostat, self._plant.beliefs
        new, rejected = self._plausible(name, taken)
        known = beliefs.known(name)
        old = [] if known is None else [known.sightings]
        if not new:
            outcomes = CalibrationOutcome
            outcome = outcomes.NO_PHOTOGRAPH if taken.found else outcomes.NO_BEAM
            text = "unchanged: no photograph could be used"
            return CycleResult(name, outcome, text, rejected, 0 if known is None else len(known))
        new_sightings = join(new)
        every = join([*old, new_sightings])
        count = len(every) + beliefs.flights.count(name)
        measured = root_mean_square(beam_errors(beliefs.present(name), new_sightings).beam)
        if count < least:
            beliefs.note(name, visit.target.name, new_sightings)
            return CycleResult(
                name,
                CalibrationOutcome.TOO_FEW_SIGHTINGS,
                f"unchanged: {count} sightings, {least} are needed",
                rejected,
                count,
                len(new_sightings),
                measured,
            )
        model = await self._models.of(name, beliefs.nominal(name), every)
        fit = await self.worker(
            fit_heliostat, Believed.of(beliefs, name), self.settings, model, every
        )
        pushed: tuple[str, ...] = ()
        if not fit.problem and leaving is not None:
            fit = await self._after_leaving(visit, fit, new_sightings, leaving)
        if not fit.problem:
            with self._plant.unverified(name):
                fit, pushed = await self._try(visit, fit, new_sightings, taken, tell, confirming)
        alone = not old and fit.outcome is not CalibrationOutcome.UNCHANGED
        if fit.problem and (alone or fit.outcome is CalibrationOutcome.NOT_VERIFIED):
            # No earlier sighting supports them, or a later photograph contradicts them, so drop
            # them.
            text = f"unchanged: {fit.problem}"
            count = 0 if known is None else len(known)
            return CycleResult(
                name, fit.outcome, text, rejected, count, 0, np.nan, fit.before, fit.after
            )
        beliefs.note(name, visit.target.name, new_sightings)
        record = None if fit.problem else self._take(visit, fit, pushed)
        return CycleResult(
            name,
            fit.outcome,
            f"unchanged: {fit.problem}"
            if fit.problem
            else _calibrated(fit.before, fit.after, count),
            rejected,
            count,
            len(new_sightings),
            measured,
            fit.before,
            fit.after,
            record,
        )

    def _sure(self, fit: JudgedFit, new_sightings: Sightings) -> bool:
        """Return whether a fit needs no confirming photograph."""
        beliefs, settings = self._plant.beliefs, self.settings
        last, present = beliefs.record(fit.name), beliefs.present(fit.name)
        # Photographs that the calibration did not expect indicate a step of the mirror, or other
        # light.
        sure = (
            last is not None and surprise_of(last, fit.nominal, new_sightings) <= settings.agreement
        )
        return sure and change_of(present, fit.mechanism, fit.sightings) <= settings.large

    async def _after_leaving(
        self, visit: Visit, fit: JudgedFit, new_sightings: Sightings, leaving: Leaving
    ) -> JudgedFit:
        """Return the fit for which a heliostat has left a receiver, or why it has stayed."""
        if not self._sure(fit, new_sightings):
            text = "a photograph on a target must confirm the new parameters; calibrate it there"
            return replace(fit, outcome=CalibrationOutcome.NOT_VERIFIED, problem=text)
        present = self._plant.beliefs.present(fit.name)
        change = change_of(present, fit.mechanism, new_sightings)
        if change >= leaving.worth:
            await leaving.leave(visit)
            return fit
        text = (
            f"new parameters would move its beam by {1e3 * change:.2f} mrad; it stays on "
            f"{visit.target.name}"
        )
        return replace(fit, outcome=CalibrationOutcome.UNCHANGED, problem=text)

    async def _try(
        self,
        visit: Visit,
        fit: JudgedFit,
        new_sightings: Sightings,
        taken: Photographs,
        tell: Tell,
        confirming: Confirming,
    ) -> tuple[JudgedFit, tuple[str, ...]]:
        """Send a fit and verify it; return the fit, why it was withdrawn, and the items sent."""
        name, plant = visit.heliostat, self._plant
        present, new = plant.beliefs.present(name), fit.mechanism
        sure = self._sure(fit, new_sightings)
        try:
            pushed = await self._push(visit, new[0], f"fit of {len(fit.sightings)} sightings")
            if sure:
                return fit, pushed
            plant.want(name, new[0])
            shots = [shot for shot, _ in taken.used]
            problem = await confirming(visit, fit.fitted, fit.nominal, shots, tell)
            if not problem:
                return fit, pushed
            await self._push(visit, present[0], "the new ones were not verified")
        except BaseException:
            # The local controller receives the old parameters as soon as its state allows.
            plant.want(name, present[0])
            visit.taken_off()
            raise
        plant.want(name, present[0])
        said = f"{problem}; the old parameters are in use again"
        return replace(fit, outcome=CalibrationOutcome.NOT_VERIFIED, problem=said), ()

    def _take(self, visit: Visit, fit: JudgedFit, pushed: tuple[str, ...]) -> HeliostatCalibration:
        """Create the record of a stored fit, and make it the plant's belief."""
        record = fit.record(
            self._plant.beliefs,
            self._plant.clock.utc().timestamp(),
            person=visit.mandate.person.name,
            pushed=pushed,
        )
        if fit.revealed is not None:
            self._plant.beliefs.flights.learn(visit.heliostat, *fit.revealed)
        return self._plant.beliefs.take(record)

    async def _push(self, visit: Visit, mechanism: Mechanism, why: str) -> tuple[str, ...]:
        """Write the items that differ, and read them back; ``why`` is for the audit."""
        plant, name = self._plant, visit.heliostat
        new_items = items_of(mechanism)
        missing = differing(new_items, await plant.stored(name))
        if not missing:
            return ()
        async with visit.locked():
            items, mandate = {item: new_items[item] for item in missing}, visit.mandate
            person, token = mandate.person, mandate.token
            await visit.obey(
                "PARAMETERS",
                lambda _: plant.parameters(person, token, name, items, confirmed=why),
                60.0,
            )
            differences = differing(new_items, await plant.stored(name))
            if differences:
                raise RefusedError(
                    f"{name}: {', '.join(differences)} differ when read back; check its flash "
                    "memory"
                )
        return missing


def _calibrated(before: float, after: float, count: int) -> str:
    better = f"beam error {1e3 * before:.2f} to {1e3 * after:.2f} mrad RMS"
    return f"calibrated: {better} over {count} sightings"


def _nobody(stage: str) -> None:
    del stage
