"""The joint visit: many mirrors on one target at once, each told apart by its own movements.

The heliostats go to their places together. Over a stack of photographs each beam moves by its code
(`imaging.coded`); a photograph is taken only when all have settled. All go home before the stack is
taken apart. Each proven beam is a sighting, which takes the way of an ordinary visit's: one fit,
its safeguards, verification. What is not proven is named, and nothing is learnt from it.

Heliostats that were never calibrated go together, each with a code of its own. Those that store
their first parameters come back together, and a second stack must prove each at the place that its
parameters predict; it is their second sighting.
"""

import asyncio
import contextlib
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from heliotrope.calibration.plan.on_target import LOOKS
from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.calibration.uncertainty import expected_error
from heliotrope.errors import HeliotropeError
from heliotrope.field.joint_visits import JointSettings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded import SeparatedBeam, Verdict
from heliotrope.lcu import states
from heliotrope.plant.attempts import Attempts, RetryLaw
from heliotrope.plant.authority import Person, RefusedError
from heliotrope.plant.controller import PlantController
from heliotrope.plant.visits.calibration_cycle import CalibrationCycle, CycleResult, refused
from heliotrope.plant.visits.first_layout import newcomers
from heliotrope.plant.visits.fitting import first_model
from heliotrope.plant.visits.gathering import Gathering, Waiting
from heliotrope.plant.visits.joint_layout import Layout, arranged, errors_on, verifying
from heliotrope.plant.visits.joint_visit import JointVisit, Returned
from heliotrope.plant.visits.neighbours import Standing
from heliotrope.plant.visits.photographs import Photographs, Shot, Tell
from heliotrope.plant.visits.stack_counts import CountsHeard, counts_at_rest
from heliotrope.plant.visits.stacks import (
    Exposed,
    StackCamera,
    TargetLight,
    light_on,
    noting,
    separated,
)
from heliotrope.plant.visits.verification import Confirming
from heliotrope.plant.visits.visit import Visit

#: Sightings that a first fit needs: all photographs of a stack agree, and a second one verifies it.
_FIRST = 1
#: Photographs that may wait to be read while the next is taken.
_UNREAD = 2
#: Verdicts on a new mirror whose beam may be beside the target: light that does not move at its
#: place may be another one's.
_NOT_FOUND = (Verdict.FAINT, Verdict.ELSEWHERE, Verdict.STUCK)
#: Joint visits that have not proven a heliostat; one whose beam may be beside the target comes
#: again, and aims at another place beside it.
JOINT = RetryLaw(
    "joint visit",
    LOOKS,
    0.0,
    "it goes to a target alone, with a search for its beam",
)
#: Verdicts that are no mirror's fault: a verification that ends so is made again, once.
_AGAIN = (Verdict.JOINED, Verdict.CLOUD)


@dataclass
class _Taken:
    """The photographs of a joint visit, and when the mirrors stood still for each.

    Attributes
    ----------
    pictures
        The last photographs, each with its number; those of one whole turn of the codes at the end.
        They are read while the beams move on.
    still
        From when to when all stood at the aims of a photograph, and its number.
    count
        Photographs in all.
    standing
        How the field stood in the middle of them.
    """

    pictures: deque[tuple[int, Exposed]]
    still: list[tuple[float, float, int]] = field(default_factory=list)
    count: int = 0
    standing: Standing | None = None

    @classmethod
    @contextlib.contextmanager
    def of(cls, layout: Layout) -> "Iterator[_Taken]":
        """Give a place for the photographs of a layout; those unread at the end are forgotten."""
        taken = cls(deque(maxlen=len(layout.moves)))
        try:
            yield taken
        finally:
            taken.forget()

    async def read(self) -> list[tuple[int, TargetLight]]:
        """Return the light in the last photographs, each with its number."""
        return [(number, await one.light) for number, one in self.pictures]

    def forget(self) -> None:
        """Forget the photographs, read or not."""
        for _, one in self.pictures:
            one.light.cancel()
        self.pictures.clear()


class JointCycle:
    """Calibration of several heliostats on one target at once.

    Parameters
    ----------
    plant
        Running.
    camera
        Camera of its targets.
    cycle
        Learns from sightings as from those of its own visits.
    settings
        See `JointSettings`.

    Attributes
    ----------
    settings
        See `JointSettings`.
    attempts
        Joint visits that have not proven a heliostat; those given up go alone.
    """

    def __init__(
        self,
        plant: PlantController,
        camera: StackCamera,
        cycle: CalibrationCycle,
        settings: JointSettings | None = None,
    ) -> None:
        self._plant, self._camera, self._cycle = plant, camera, cycle
        self.settings = settings or JointSettings()
        self.attempts = Attempts(JOINT)

    def searching(self, heliostat: str) -> bool:
        """Return whether a beam that was not found is looked for again in a joint first visit."""
        return 0 < self.attempts.counts.get(heliostat, 0) < LOOKS

    def note(self, result: CycleResult) -> None:
        """Note the result of a visit, joint or alone: whether the heliostat may come together.

        Where the beams of all new mirrors are beside the target, it is as dark as under a cloud:
        they are looked for at the next place, but no cloud ends the search.
        """
        name, now, text = result.heliostat, self._plant.now(), result.text
        new = self._plant.beliefs.record(name) is None
        if result.new:
            self.attempts.done(name)
        elif new and (
            result.verdict in _NOT_FOUND
            or (result.verdict is Verdict.CLOUD and self.attempts.counts.get(name, 0) < LOOKS - 1)
        ):
            self.attempts.failed(name, text, now)
        elif (
            result.verdict not in (None, Verdict.CLOUD)
            or result.outcome is CalibrationOutcome.NOT_VERIFIED
        ):
            self.attempts.give_up(name, text, now)

    async def run(
        self,
        person: Person,
        token: int,
        heliostats: Sequence[str],
        target: str,
        tell: Tell = lambda _: None,
    ) -> tuple[CycleResult, ...]:
        """Calibrate heliostats together, and bring each back to where it was.

        It works under a mandate of its own: whoever takes the command authority meanwhile, it goes
        on. A heliostat that a person commands leaves the visit.

        Parameters
        ----------
        person, token
            An engineer, with the token of the command authority.
        heliostats, target
            Names.
        tell
            Called with the name of each step.

        Returns
        -------
            One for each heliostat, in the order given.

        Raises
        ------
        RefusedError
            If the plant refuses every motion, or too few heliostats are left.
        FetchError, InputError
            No usable photograph comes.
        UnknownNameError
            If there is no such heliostat or target.
        """
        plant = self._plant
        place, names = plant.design.target(target), tuple(dict.fromkeys(heliostats))
        with plant.authority.mandate(person, token, names, target) as mandate:
            first = self.first(names, place)
            layout, wrong = self._arranged(place, names)
            results = {name: refused(mandate, name, text) for name, text in wrong.items()}
            mandate.give_up(wrong)
            if layout.names:
                async with Returned(plant, mandate, layout.names, place):
                    joint = JointVisit(plant, mandate, layout.names, place)
                    tell("the empty target")
                    empty = await light_on(self._camera, place)
                    proven, lost = await self._stack(joint, layout, empty, tell)
                    results |= lost
                    learn = self._learn_first if first else self._learn
                    results |= await learn(joint, proven, empty, tell)
        return tuple(results[name] for name in names)

    def first(self, heliostats: Sequence[str], target: Target) -> bool:
        """Return whether a visit is one of own codes: some are new, or not known well enough."""
        errors = errors_on(self._plant, target, heliostats, self.settings).values()
        return bool(self.settings.first) and not all(e <= self.settings.known for e in errors)

    def having_place(self, heliostats: Sequence[str], target: str) -> tuple[str, ...]:
        """Return those of some heliostats that have a place in a visit now."""
        return self._arranged(self._plant.design.target(target), tuple(heliostats))[0].names

    def _arranged(self, target: Target, names: tuple[str, ...]) -> tuple[Layout, dict[str, str]]:
        if not self.first(names, target):
            return arranged(self._plant, target, names, self.settings)
        nominal, cycle = self._plant.beliefs.nominal, self._cycle.settings
        model = {name: first_model(cycle, nominal(name)).parameters for name in names}
        return newcomers(self._plant, target, names, self.settings, model, self.attempts.counts)

    # -- photographs -----------------------------------------------------------------------

    async def _stack(
        self, joint: JointVisit, layout: Layout, empty: TargetLight, tell: Tell
    ) -> tuple[dict[str, Photographs], dict[str, CycleResult]]:
        """Bring heliostats to their places, take a stack, bring them home, and take it apart.

        Returns
        -------
            The sighting of each proven beam, and the results of the others, by heliostat.
        """
        with _Taken.of(layout) as taken:
            async with joint:
                tell(f"{len(joint.names)} on the way")
                await joint.go(layout.start(), self._cycle.settings.arrival)
                await self._photograph(joint, layout, empty, taken, tell)
                tell(f"{len(joint.names)} on the way back")
            lost = {name: refused(joint.mandate, name, text) for name, text in joint.lost.items()}
            proven, others = await self._separated(joint, layout, empty, taken, tell)
        return proven, lost | others

    async def _photograph(
        self, joint: JointVisit, layout: Layout, empty: TargetLight, taken: _Taken, tell: Tell
    ) -> None:
        """Take the stack. When a heliostat drops out, a whole turn of the codes begins anew."""
        needed = len(layout.moves)
        while len(taken.pictures) < needed:
            if await joint.leave():
                taken.forget()
            if not joint.visits:
                why = next(iter(joint.lost.values()), "")
                raise RefusedError(f"joint visit to {layout.target.name}: nobody is left; {why}")
            if taken.count >= self.settings.again * needed:
                raise RefusedError(
                    f"joint visit to {layout.target.name}: {taken.count} photographs were taken, "
                    f"and heliostats dropped out before {needed} of them in a row were"
                )
            number = taken.count % needed
            tell(f"photograph {len(taken.pictures) + 1} of {needed}, {len(joint.names)} beams")
            await joint.aim(layout.points(number))
            begin = self._plant.now()
            await self._settled(joint, begin + self.settings.settle)
            picture = await self._exposed(joint, layout, empty, taken)
            joint.drop(joint.missing(states.TRACKING))
            taken.count += 1
            if len(taken.pictures) == needed // 2:
                taken.standing = Standing.of(self._plant.field)
            taken.still.append((begin + 0.5 * self.settings.settle, picture.at, number))
            taken.pictures.append((number, picture))
            if joint.astray:
                taken.forget()

    async def _settled(self, joint: JointVisit, until: float) -> None:
        while self._plant.now() < until:
            await joint.look()

    async def _exposed(
        self, joint: JointVisit, layout: Layout, empty: TargetLight, taken: _Taken
    ) -> Exposed:
        """Photograph the target, and go on noting step counts meanwhile.

        Few photographs wait to be read, so that one which cannot be read ends the visit soon.
        """

        async def exposed() -> Exposed:
            if len(taken.pictures) >= _UNREAD:
                await asyncio.shield(taken.pictures[-_UNREAD][1].light)
            return await self._camera.expose(layout.target, empty.view)

        return await noting(joint.look, exposed())

    async def _separated(
        self, joint: JointVisit, layout: Layout, empty: TargetLight, taken: _Taken, tell: Tell
    ) -> tuple[dict[str, Photographs], dict[str, CycleResult]]:
        """Take a stack apart into sightings of proven beams, and results of the others."""
        chosen = [layout.names.index(name) for name in joint.names]
        pictures = await taken.read()
        moves = layout.moves[[number for number, _ in pictures]][:, chosen]
        beams = [layout.beams[i] for i in chosen]
        tell("taking the beams apart")
        lights = [one for _, one in pictures]
        found = await self._cycle.worker(separated, lights, empty, moves, beams)
        heard = []
        for i, beam in zip(chosen, found.beams, strict=True):
            if beam.verdict is Verdict.PROVEN:
                still = [
                    (begin, end, layout.aims[i] + layout.moves[number, i] @ layout.target.axes)
                    for begin, end, number in taken.still
                ]
                visit = joint.visits[beam.heliostat]
                heard.append(CountsHeard.of(visit, layout.aims[i], still, _middle(pictures)))
        at_rest = await self._cycle.worker(counts_at_rest, heard)
        results: dict[str, CycleResult] = {}
        proven: dict[str, Photographs] = {}
        for beam in found.beams:
            name = beam.heliostat
            if beam.verdict is not Verdict.PROVEN:
                results[name] = _not_proven(name, beam)
                continue
            counts = at_rest[name]
            if isinstance(counts, str):
                text = f"unchanged: {counts}"
                results[name] = CycleResult(name, CalibrationOutcome.NOT_PROVEN, text)
                continue
            covariance = beam.covariance + empty.covariance_at(beam.centroid)
            axes = layout.target.axes
            point = np.asarray(layout.target.point(beam.centroid))
            shot = Shot(point, _middle(pictures), axes.T @ covariance @ axes)
            shot = await self._cycle.alone(layout.target, name, shot, taken.standing)
            proven[name] = Photographs([(shot, counts)])
        return proven, results

    # -- learning --------------------------------------------------------------------------

    async def _learn(
        self, joint: JointVisit, proven: Mapping[str, Photographs], empty: TargetLight, tell: Tell
    ) -> dict[str, CycleResult]:
        """Learn from each proven beam as from a visit of its own."""
        del empty
        results: dict[str, CycleResult] = {}
        tell(f"learning from {len(proven)} proven beams")

        async def one(name: str) -> None:
            results[name] = await self._learnt(joint.visits[name], proven[name])

        async with asyncio.TaskGroup() as group:
            for name in proven:
                group.create_task(one(name))
        return results

    async def _learn_first(
        self, joint: JointVisit, proven: Mapping[str, Photographs], empty: TargetLight, tell: Tell
    ) -> dict[str, CycleResult]:
        """Learn first calibrations, which are verified together, and then from that, too."""
        results: dict[str, CycleResult] = {}
        seen: dict[str, Photographs] = {}
        gathering = Gathering(proven)
        tell(f"learning from {len(proven)} proven beams")

        async def one(name: str) -> None:
            visit = joint.visits[name]
            try:
                results[name] = await self._learnt(
                    visit, proven[name], confirming=gathering.problem, least=_FIRST
                )
            finally:
                gathering.leave(name)
            if name in seen and results[name].outcome.calibrated:
                again = await self._learnt(visit, seen[name], least=_FIRST)
                results[name] = results[name].then(again)

        async with asyncio.TaskGroup() as group:
            for name in proven:
                group.create_task(one(name))
            waiting = await gathering.all()
            try:
                if waiting:
                    await self._confirm(joint, gathering, waiting, empty, seen, tell)
            except HeliotropeError as error:
                gathering.fail(error)
        return results

    async def _confirm(
        self,
        joint: JointVisit,
        gathering: Gathering,
        waiting: Mapping[str, Waiting],
        empty: TargetLight,
        seen: dict[str, Photographs],
        tell: Tell,
    ) -> None:
        """Verify new parameters together; the sightings of the confirmed go to ``seen``.

        Those that would make the target too bright have further stacks. Those that other light hid
        come once more, each with a code of its own. Each stack settles its own, whatever becomes
        of the next.
        """
        waits, own = tuple(waiting), False
        while waits:
            hidden: list[str] = []
            while waits:
                problems, again, waits = await self._verified(
                    joint, waiting, waits, empty, seen, tell, own=own
                )
                hidden += () if own else again
                left = {name: why for name, why in problems.items() if name not in hidden}
                gathering.settle(left)
            waits, own = tuple(hidden), True

    async def _verified(
        self,
        joint: JointVisit,
        waiting: Mapping[str, Waiting],
        names: Sequence[str],
        empty: TargetLight,
        seen: dict[str, Photographs],
        tell: Tell,
        *,
        own: bool,
    ) -> tuple[dict[str, str], list[str], tuple[str, ...]]:
        """Take one stack of a verification.

        Returns
        -------
            Why each is not confirmed, "" if it is; those that may come once more; and those that
            wait for another stack.
        """
        plant, target = self._plant, joint.target
        sun = plant.sun_vector()
        errors = {name: _error(waiting[name], sun, target) for name in names}
        layout, problems, waits = verifying(plant, target, errors, self.settings, own=own)
        if not layout.names:
            return problems, [], waits
        again = JointVisit(plant, joint.mandate, layout.names, target)
        again.drop(
            {
                name: f"the new parameters have no free way to their photograph: {why}"
                for name, point in layout.start().items()
                if (why := plant.misled(name, point))
            }
        )
        proven, others = await self._stack(
            again, layout, empty, lambda stage: tell(f"verification: {stage}")
        )
        for name, result in others.items():
            text = result.text.removeprefix("unchanged: ")
            problems[name] = f"with the new parameters its beam was not proven: {text}"
        for name, photographs in proven.items():
            one, ((shot, counts),) = waiting[name], photographs.used
            problem = self._cycle.verification.judge(one.nominal, one.fitted, shot, counts)
            problems[name] = problem
            if not problem:
                seen[name] = photographs
        hidden = [name for name, one in others.items() if one.verdict in _AGAIN]
        return problems, hidden, waits

    async def _learnt(
        self,
        visit: Visit,
        taken: Photographs,
        *,
        confirming: Confirming | None = None,
        least: int | None = None,
    ) -> CycleResult:
        name = visit.heliostat
        try:
            return await self._cycle.learn(visit, taken, confirming=confirming, least=least)
        except RefusedError as error:
            return refused(visit.mandate, name, str(error))
        except HeliotropeError as error:
            text = f"{type(error).__name__}: {error}"
            return CycleResult(name, CalibrationOutcome.ERROR, text)


def _middle(pictures: Sequence[tuple[int, TargetLight]]) -> float:
    """Return the middle of the exposures, monotonic s."""
    return float(np.mean([picture.at for _, picture in pictures]))


def _error(waiting: Waiting, sun: FloatArray, target: Target) -> float:
    """Return the expected beam error of new parameters on a target, rad RMS (2-D)."""
    fitted, visit = waiting.fitted, waiting.visit
    found = expected_error(
        waiting.mechanism,
        tuple(fitted.names),
        fitted.covariance[0],
        sun,
        target.center,
        current=visit.plant.field.counts(np.array([visit.row])),
    )
    return float(found.rms[0])


def _not_proven(name: str, beam: SeparatedBeam) -> CycleResult:
    other = f" ({beam.other})" if beam.other else ""
    text = f"unchanged: {beam.verdict.value}{other}"
    return CycleResult(name, CalibrationOutcome.NOT_PROVEN, text, verdict=beam.verdict)
