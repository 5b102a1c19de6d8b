"""The receiver visit: mirrors in production, measured where they shine.

A few dozen mirrors that track the receiver move their beams by a milliradian, each by a code of its
own (`imaging.coded`), while all others shine on. A camera sees the receiver; what follows a code is
the beam of its mirror. The movements are orders of the plant like any other, each proven before it
is sent; the plant takes the beams back to their aims whatever becomes of the visit (`movements`).
Each proven beam is a sighting. A mirror leaves the receiver only for new parameters that are worth
it, a few mirrors at a time, and only where no photograph must confirm them: that is left to a visit
to a target, and so is every mirror of which something is wrong.
"""

import asyncio
import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.errors import HeliotropeError, InputError
from heliotrope.field.receiver_visits import ReceiverSettings
from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded import (
    ExpectedBeam,
    SeparatedBeam,
    Separation,
    Stack,
    Verdict,
    separate,
)
from heliotrope.imaging.targets.view import posed_view
from heliotrope.lcu import states
from heliotrope.plant.authority import Person, RefusedError
from heliotrope.plant.controller import PlantController
from heliotrope.plant.visits.calibration_cycle import (
    CalibrationCycle,
    CycleResult,
    Production,
    refused,
)
from heliotrope.plant.visits.joint_visit import JointVisit, Returned
from heliotrope.plant.visits.neighbours import Standing
from heliotrope.plant.visits.photographs import Photographs, Shot, Tell
from heliotrope.plant.visits.receiver_layout import ReceiverLayout, arranged_on, production
from heliotrope.plant.visits.stack_counts import CountsHeard, counts_at_rest
from heliotrope.plant.visits.stacks import StackCamera, TargetLight, light_on, noting
from heliotrope.plant.visits.visit import Visit

#: Longest time of a movement, and of the way back to the aims, s.
_ORDER, _BACK = 20.0, 60.0
#: Photographs that show whether the sun is steady, and the time between them, s.
_LOOKS, _BETWEEN = 3, 2.0
#: Least share of the receiver that a photograph shows below full scale.
_SEEN = 0.5
#: A beam is joined whose power differs from that of the others, for its mirror's size, by this
#: share, and by this many of their standard deviations.
_OTHER, _SIGMAS = 0.4, 4.0
#: Share of the way from the usual light to that of a new photograph.
_FOLLOW = 0.2


@dataclass
class _Taken:
    """The photographs, and from when to when all stood still for which of them."""

    pictures: list[TargetLight] = field(default_factory=list)
    still: list[tuple[float, float, int]] = field(default_factory=list)
    standing: Standing | None = None

    @property
    def middle(self) -> float:
        """Middle of the exposures, monotonic s."""
        return float(np.mean([picture.at for picture in self.pictures]))


class ReceiverCycle:
    """Calibration of heliostats that are in production.

    Parameters
    ----------
    plant
        Running.
    camera
        Gives the light on the receiver.
    cycle
        Learns from sightings as from those of its own visits.
    settings
        See `ReceiverSettings`.

    Attributes
    ----------
    settings
        As given.
    face
        The face of the receiver.
    """

    def __init__(
        self,
        plant: PlantController,
        camera: StackCamera,
        cycle: CalibrationCycle,
        settings: ReceiverSettings,
    ) -> None:
        self._plant, self._camera, self._cycle, self.settings = plant, camera, cycle, settings
        self.face = plant.design.receiver(settings.receiver).face
        self._view = posed_view(plant.design.camera(settings.camera), self.face)

    async def run(
        self, person: Person, token: int, heliostats: Sequence[str], tell: Tell = lambda _: None
    ) -> tuple[CycleResult, ...]:
        """Calibrate heliostats that track the receiver; those that take no part stay as they are.

        It works under a mandate of its own: whoever takes the command authority meanwhile, it goes
        on. However it ends, the plant takes the beams back to their aims.

        Parameters
        ----------
        person, token
            An engineer, with the token of the command authority.
        heliostats
            Names.
        tell
            Called with the name of each step.

        Returns
        -------
            One for each heliostat, in the order given.

        Raises
        ------
        RefusedError
            If the plant refuses every motion, the sun is not steady, or nobody is left.
        FetchError, InputError
            No usable photograph comes.
        UnknownNameError
            If there is no such heliostat.
        """
        plant = self._plant
        names = tuple(dict.fromkeys(heliostats))
        made, wrong = arranged_on(plant, self.face, names, self.settings)
        moving = made.layout.names
        with plant.authority.mandate(person, token, moving, self.face.name) as mandate:
            results = {name: refused(mandate, name, text) for name, text in wrong.items()}
            if moving:
                joint = JointVisit(plant, mandate, moving, self.face)
                with plant.stepping.fine(moving), plant.movements.ending(moving):
                    taken = await self._photograph(joint, made, await self._steady(tell), tell)
                tell("back to the aims")
                await self._settled(joint, plant.now() + _BACK, moving)
                results |= {n: refused(mandate, n, text) for n, text in joint.lost.items()}
                results |= await self._learn(joint, made, taken, tell)
        return tuple(results[name] for name in names)

    # -- photographs -----------------------------------------------------------------------

    async def _steady(self, tell: Tell) -> float:
        """Return the brightness of the receiver; refuse if it changes."""
        tell("is the sun steady?")
        seen = []
        for _ in range(_LOOKS):
            seen.append(_brightness(await light_on(self._camera, self.face, self._view)))
            await asyncio.sleep(_BETWEEN)
        change = (max(seen) - min(seen)) / max(*seen, 1e-300)
        if not change <= self.settings.steady:
            raise RefusedError(
                f"receiver visit: the light on {self.face.name} changed by {100.0 * change:.0f} % "
                f"in {_LOOKS * _BETWEEN:g} s, the limit is {100.0 * self.settings.steady:g} %; it "
                "begins when the sun is steady"
            )
        return float(np.median(seen))

    async def _photograph(
        self, joint: JointVisit, made: ReceiverLayout, usual: float, tell: Tell
    ) -> _Taken:
        """Take the stack; a photograph in another light than the usual is taken again."""
        taken, needed, plant = _Taken(), len(made.layout.moves), self._plant
        coarse = plant.stepping.coarse(joint.names, plant.now())
        joint.drop(dict.fromkeys(coarse, "it does not take fine steps"))
        for _ in range(int(self.settings.again * needed)):
            number = len(taken.pictures)
            if number == needed:
                break
            tell(f"photograph {number + 1} of {needed}, {len(joint.names)} beams")
            await joint.move(made.layout.points(number), _ORDER)
            begin = plant.now()
            await self._settled(joint, begin + self.settings.settle)
            picture = await noting(joint.look, self._light())
            joint.drop(joint.missing(states.TRACKING))
            plant.movements.end(tuple(joint.lost))
            if not joint.names:
                why = next(iter(joint.lost.values()), "")
                raise RefusedError(f"receiver visit: nobody is left; {why}")
            level = _brightness(picture)
            if abs(level - usual) <= self.settings.steady * usual:
                usual += _FOLLOW * (level - usual)
                taken.still.append((begin + 0.5 * self.settings.settle, picture.at, number))
                taken.pictures.append(picture)
                if number == needed // 2:
                    taken.standing = Standing.of(plant.field)
        return taken

    async def _settled(
        self, joint: JointVisit, until: float, moving: Sequence[str] | None = None
    ) -> None:
        """Look until a time; with ``moving``, until none of these is beside its aim."""
        while self._plant.now() < until:
            if moving is not None and not self._plant.movements.names & set(moving):
                break
            await joint.look()

    async def _light(self) -> TargetLight:
        """Photograph the receiver: the mean of several frames."""
        frames = [
            await light_on(self._camera, self.face, self._view)
            for _ in range(self.settings.exposures)
        ]
        seen = np.logical_and.reduce([frame.seen for frame in frames])
        if seen.mean() < _SEEN:
            raise InputError(
                f"camera {self.settings.camera}: {100.0 * seen.mean():.0f} % of {self.face.name} "
                "are seen below full scale; shorten its exposure"
            )
        values = np.mean([frame.values / frame.exposure for frame in frames], axis=0)
        at = float(np.mean([frame.at for frame in frames]))
        return replace(frames[0], values=values, seen=seen, exposure=1.0, at=at)

    # -- learning --------------------------------------------------------------------------

    async def _learn(
        self, joint: JointVisit, made: ReceiverLayout, taken: _Taken, tell: Tell
    ) -> dict[str, CycleResult]:
        """Take the stack apart, and learn from each proven beam."""
        layout = made.layout
        if len(taken.pictures) < len(layout.moves):
            return {name: _not_proven(name, Verdict.CLOUD) for name in joint.names}
        chosen = [layout.names.index(name) for name in joint.names]
        tell("taking the beams apart")
        beams = [layout.beams[i] for i in chosen]
        moves = layout.moves[:, chosen]
        separation = await self._cycle.worker(_separated, taken.pictures, moves, beams)
        found = judged(separation.beams, made.powers[chosen])
        results: dict[str, CycleResult] = {}
        proven: dict[str, Photographs] = {}
        for i, beam in zip(chosen, found, strict=True):
            seen = await self._sighting(joint, made, taken, i, beam)
            if isinstance(seen, CycleResult):
                results[beam.heliostat] = seen
            else:
                proven[beam.heliostat] = seen
        tell(f"learning from {len(proven)} proven beams")
        lit = self._plant.field.among((states.TRACKING,), self._plant.now())
        away = asyncio.Semaphore(max(1, int(self.settings.power * lit.sum())))

        async def one(name: str) -> None:
            results[name] = await self._learnt(joint, name, proven[name], away)

        async with asyncio.TaskGroup() as group:
            for name in proven:
                group.create_task(one(name))
        return results

    async def _sighting(
        self, joint: JointVisit, made: ReceiverLayout, taken: _Taken, i: int, beam: SeparatedBeam
    ) -> Photographs | CycleResult:
        """Return what a beam shows of its mirror, or why it shows nothing."""
        name, layout = beam.heliostat, made.layout
        if beam.verdict is not Verdict.PROVEN:
            return _not_proven(name, beam.verdict, beam.other)
        still = [
            (begin, end, layout.aims[i] + layout.moves[number, i] @ self.face.axes)
            for begin, end, number in taken.still
        ]
        heard = CountsHeard.of(joint.visits[name], layout.aims[i], still, taken.middle)
        counts = (await self._cycle.worker(counts_at_rest, [heard]))[name]
        if isinstance(counts, str):
            return CycleResult(name, CalibrationOutcome.NOT_PROVEN, f"unchanged: {counts}")
        axes = self.face.axes
        covariance = beam.covariance + taken.pictures[0].covariance_at(beam.centroid)
        shot = Shot(self.face.point(beam.centroid), taken.middle, axes.T @ covariance @ axes)
        shot = await self._cycle.alone(self.face, name, shot, taken.standing)
        return Photographs([(shot, counts)])

    async def _learnt(
        self, joint: JointVisit, name: str, taken: Photographs, away: asyncio.Semaphore
    ) -> CycleResult:
        """Learn from a proven beam; a mirror that leaves the receiver returns to its aim."""
        visit = joint.visits[name]

        async with contextlib.AsyncExitStack() as stack:

            async def leave(visit: Visit) -> None:
                await stack.enter_async_context(away)
                back = Returned(self._plant, joint.mandate, (name,), self.face)
                await stack.enter_async_context(back)
                await visit.command("IDLE")

            seen = Production(self.face.name, self.settings.worth, leave)
            try:
                return await self._cycle.learn(visit, taken, production=seen)
            except RefusedError as error:
                return refused(joint.mandate, name, str(error))
            except HeliotropeError as error:
                text = f"{type(error).__name__}: {error}"
                return CycleResult(name, CalibrationOutcome.ERROR, text)

    def production(self) -> float:
        """Return the light that is sent to the receiver now, in square metres of sunlight."""
        return production(self._plant, self.face)


def judged(beams: Sequence[SeparatedBeam], powers: FloatArray) -> list[SeparatedBeam]:
    """Return beams (M,); those are joined whose power does not fit the size of their mirrors.

    How bright a mirror shows is not known before, but it is alike for all of them.

    Parameters
    ----------
    beams
        As they were separated.
    powers
        Expected, in any one unit, (M,).
    """
    proven = np.array([beam.verdict is Verdict.PROVEN for beam in beams], dtype=np.bool_)
    if not proven.any():
        return list(beams)
    ratio = np.array([beam.power for beam in beams]) / powers
    gains = ratio / np.median(ratio[proven])
    spread = 1.4826 * float(np.median(np.abs(gains[proven] - 1.0)))
    wrong = proven & (np.abs(gains - 1.0) > max(_OTHER, _SIGMAS * spread))
    return [
        replace(beam, gain=float(gain), verdict=Verdict.JOINED)
        if bad
        else replace(beam, gain=float(gain))
        for beam, gain, bad in zip(beams, gains, wrong, strict=True)
    ]


def _brightness(picture: TargetLight) -> float:
    """Return the mean brightness of the receiver."""
    return float(picture.values[picture.seen].mean()) / picture.exposure


def _separated(
    pictures: Sequence[TargetLight], moves: FloatArray, beams: Sequence[ExpectedBeam]
) -> Separation:
    """Return the beams in photographs of a receiver; see `separate`."""
    return separate(_stack_of(pictures), moves, beams)


def _stack_of(pictures: Sequence[TargetLight]) -> Stack:
    """Return photographs of a receiver, which is never empty, as a stack."""
    first = pictures[0]
    values = np.stack([picture.values for picture in pictures]).astype(np.float64)
    seen = np.logical_and.reduce([picture.seen for picture in pictures])
    return Stack(values, first.step, first.first, seen)


def _not_proven(name: str, verdict: Verdict, other: str = "") -> CycleResult:
    text = f"unchanged: {verdict.value}{other and f' ({other})'}"
    return CycleResult(name, CalibrationOutcome.NOT_PROVEN, text, verdict=verdict)
