"""The coded visit: several heliostats on one surface at once, identified by their movements.

During a series of photographs, each beam moves according to its code (`imaging.coded`); a
photograph is taken only when all beams have settled. Each identified beam is a sighting, which is
processed like a sighting of an ordinary visit, with one fit, the same safeguards, and verification.
Beams that are not identified are reported, and nothing is learnt from them.

A visit to a target is a *joint visit*, a visit of heliostats that track a receiver is a *receiver
visit*. They differ in how beams arrive and leave, in their light, and in the use of new parameters.
"""

import asyncio
import contextlib
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.errors import HeliotropeError
from heliotrope.field.coded_visits import CodedSettings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded import DARK, Verdict
from heliotrope.imaging.targets.view import FaceView
from heliotrope.lcu import states
from heliotrope.plant.controller import PlantController
from heliotrope.plant.orders.authority import Person, RefusedError
from heliotrope.plant.visits.calibration_cycle import (
    CalibrationCycle,
    CycleResult,
    Leaving,
    refused,
)
from heliotrope.plant.visits.coded_layout import Layout
from heliotrope.plant.visits.coded_visit import CodedVisit, Returned
from heliotrope.plant.visits.counts_at_rest import CountsHeard, counts_at_rest
from heliotrope.plant.visits.neighbours import Standing
from heliotrope.plant.visits.photographs import Photographs, Shot, Tell
from heliotrope.plant.visits.target_light import (
    Exposed,
    LightCamera,
    TargetLight,
    noting,
    separated,
)
from heliotrope.plant.visits.verification import Confirming

#: Function that moves beams to points on the surface, ENU, m, by heliostat.
Move = Callable[[Mapping[str, FloatArray]], Awaitable[None]]

#: Time within which each heliostat of a visit reports its step counts, s; they are requested every
#: second.
_COUNTED = 1.2
#: Number of photographs that may wait for evaluation while the next is taken.
_UNREAD = 2
#: After each photograph, the light that counts as usual changes by this fraction of its difference
#: from the light in the photograph.
_FOLLOW = 0.2


@dataclass
class Light:
    """What is known about the light on a surface before the photographs of a visit are taken.

    Attributes
    ----------
    view
        Position of the surface's face in the camera's frames; None: unknown.
    empty
        The light without beams; None: the surface is never without beams.
    usual, steady
        Mean brightness of photographs, and its largest relative change; None: unlimited.
    other
        Brightness of the last photograph, if it was unusual.
    lasting
        Whether the last two photographs agreed on a different brightness that is not due to a
        cloud. In that case beams have arrived or left, and this brightness becomes the usual
        brightness.
    """

    view: FaceView | None = None
    empty: TargetLight | None = None
    usual: float | None = None
    steady: float = 0.0
    other: float | None = None
    lasting: bool = False

    async def shown(self, picture: Exposed) -> bool:
        """Return whether a photograph has the usual brightness, which is slowly updated."""
        if self.usual is None:
            return True
        level = (await picture.light).brightness
        as_usual, self.lasting = self._near(level, self.usual), False
        if as_usual:
            self.usual, self.other = self.usual + _FOLLOW * (level - self.usual), None
        elif self.other is not None and level > DARK * self.usual and self._near(level, self.other):
            self.usual, self.other, self.lasting = level, None, True
        else:
            self.other = level
        return as_usual

    def _near(self, level: float, before: float) -> bool:
        return abs(level - before) <= self.steady * before


@dataclass
class _Taken:
    """The photographs of a visit, and when the heliostats were at rest for each.

    Attributes
    ----------
    needed
        Number of photographs in a full cycle of the codes.
    pictures
        Photographs of the present cycle, each with its number; they are evaluated while the beams
        move on.
    still
        Start and end of the time in which all beams were at the aims of a photograph, and the
        number of the photograph.
    count, first
        Total number of photographs, and the number of the photograph with which the present cycle
        began.
    standing
        Poses of the field in the middle of the cycle.
    """

    needed: int
    pictures: list[tuple[int, Exposed]] = field(default_factory=list)
    still: list[tuple[float, float, int]] = field(default_factory=list)
    count: int = 0
    first: int = 0
    standing: Standing | None = None

    @classmethod
    @contextlib.contextmanager
    def of(cls, layout: Layout) -> "Iterator[_Taken]":
        """Yield a store for the photographs of a layout; finally drop unevaluated photographs."""
        taken = cls(len(layout.moves))
        try:
            yield taken
        finally:
            taken.forget()

    @property
    def number(self) -> int:
        """Number of the next photograph."""
        return (self.first + len(self.pictures)) % self.needed

    async def read(self) -> list[tuple[int, TargetLight]]:
        """Return the light in the photographs, each with its number."""
        return [(number, await one.light) for number, one in self.pictures]

    def forget(self) -> None:
        """Drop all photographs, evaluated or not; a full cycle begins with the next photograph."""
        self.first = self.number
        for _, one in self.pictures:
            one.light.cancel()
        self.pictures.clear()


class CodedCycle(ABC):
    """Calibration of several heliostats of a plant at once: `JointCycle`, `ReceiverCycle`.

    Parameters
    ----------
    plant
        Running plant.
    camera
        Camera of the surfaces.
    cycle
        Cycle that learns from these sightings as it does from sightings of its own visits.

    Attributes
    ----------
    cycle
        As given.
    kind
        Name of a visit, for display.
    comes
        Whether heliostats come to the surface, and return to their aims at the end; otherwise they
        track the surface, and their beams move slightly.
    settings
        Settings of the plant file.
    """

    kind: ClassVar[str]
    comes: ClassVar[bool]
    settings: CodedSettings

    def __init__(
        self, plant: PlantController, camera: LightCamera, cycle: CalibrationCycle
    ) -> None:
        self._plant, self._camera, self.cycle = plant, camera, cycle

    # -- what differs between the surfaces -------------------------------------------------

    @abstractmethod
    def face(self, name: str) -> Target:
        """Return the face of a surface; raise UnknownNameError if there is no such surface."""

    @abstractmethod
    def _arranged(self, face: Target, names: tuple[str, ...]) -> Layout:
        """Return the layout of a visit."""

    @abstractmethod
    def _stay(
        self, visit: CodedVisit, layout: Layout, light: Light, tell: Tell
    ) -> AbstractAsyncContextManager[Move]:
        """Yield the function that moves beams, once they have arrived and the light is known.

        At the end the beams are removed.
        """

    @abstractmethod
    async def _exposed(self, face: Target, light: Light) -> Exposed:
        """Photograph the surface."""

    @abstractmethod
    async def _learn(
        self,
        visit: CodedVisit,
        layout: Layout,
        proven: Mapping[str, Photographs],
        light: Light,
        tell: Tell,
    ) -> dict[str, CycleResult]:
        """Learn from identified beams; return the results by heliostat."""

    # -- a visit ---------------------------------------------------------------------------

    async def run(
        self,
        person: Person,
        token: int,
        heliostats: Sequence[str],
        where: str,
        tell: Tell = lambda _: None,
    ) -> tuple[CycleResult, ...]:
        """Calibrate heliostats together, and return each to where it was.

        The visit works under its own mandate, and continues whoever takes the command authority in
        the meantime. A heliostat that an operator commands leaves the visit.

        Parameters
        ----------
        person, token
            An engineer, with the token of the command authority.
        heliostats, where
            Names, and the name of the surface.
        tell
            Called with the name of each step.

        Returns
        -------
            One result for each heliostat, in the given order.

        Raises
        ------
        RefusedError
            If the plant refuses every motion, too few heliostats are left, or the light changes.
        FetchError, InputError
            If there is no usable photograph.
        UnknownNameError
            If there is no such heliostat or surface.
        """
        plant, names = self._plant, tuple(dict.fromkeys(heliostats))
        face = self.face(where)
        layout = self._arranged(face, names)
        moving, light = layout.names, Light()
        with plant.authority.mandate(person, token, moving, face.name) as mandate:
            left_out = layout.left_out.items()
            results = {name: refused(mandate, name, text) for name, text in left_out}
            if moving:
                async with Returned(plant, mandate, moving if self.comes else (), face):
                    visit = CodedVisit(plant, mandate, moving, face)
                    proven, others = await self.photographed(visit, layout, light, tell)
                    results |= others
                    if proven:
                        tell(f"learning from {len(proven)} proven beams")
                        results |= await self._learn(visit, layout, proven, light, tell)
        return tuple(results[name] for name in names)

    # -- photographs -----------------------------------------------------------------------

    async def photographed(
        self, visit: CodedVisit, layout: Layout, light: Light, tell: Tell
    ) -> tuple[dict[str, Photographs], dict[str, CycleResult]]:
        """Bring beams to their places, photograph them, remove them, and identify them.

        Returns
        -------
            The sighting of each identified beam, and a result for each other heliostat, by
            heliostat.
        """
        with _Taken.of(layout) as taken:
            async with self._stay(visit, layout, light, tell) as move:
                await self._photograph(visit, layout, light, taken, move, tell)
            self._check(visit)
            lost = {name: refused(visit.mandate, name, text) for name, text in visit.lost.items()}
            if len(taken.pictures) < taken.needed:
                cloud = Verdict.CLOUD
                return {}, lost | {name: _not_proven(name, cloud) for name in visit.names}
            proven, others = await self._separated(visit, layout, light, taken, tell)
        return proven, lost | others

    async def _photograph(
        self,
        visit: CodedVisit,
        layout: Layout,
        light: Light,
        taken: _Taken,
        move: Move,
        tell: Tell,
    ) -> None:
        """Take the photographs; their maximum number allows for changes of the light.

        When a beam leaves or the light has changed for good, a full cycle of the codes begins
        again. A photograph in unusual light is repeated.
        """
        plant, settle, spoiled = self._plant, self.settings.settle, False
        while len(taken.pictures) < taken.needed:
            if not self.comes:
                plant.movements.end(tuple(visit.lost))
            elif await visit.leave():
                taken.forget()
            self._check(visit)
            if taken.count >= int(self.settings.again * taken.needed):
                if spoiled:
                    return
                raise RefusedError(
                    f"{self.kind} to {visit.target.name}: {taken.count} photographs were taken, "
                    f"and heliostats dropped out before {taken.needed} of them in a row were"
                )
            number, count = taken.number, len(taken.pictures)
            tell(f"photograph {count + 1} of {taken.needed}, {len(visit.names)} beams")
            await move(layout.points(number))
            begin = plant.now()
            while plant.now() < begin + settle:
                await visit.look()
            picture = await noting(visit.look, self._next(visit, light, taken))
            # Heliostats stay at rest until each has reported its step counts, however fast the
            # camera is.
            while plant.now() < begin + 0.5 * settle + _COUNTED:
                await visit.look()
            stood = plant.now()
            visit.drop(visit.missing(states.TRACKING))
            taken.count += 1
            if not await light.shown(picture):
                spoiled = True
                if light.lasting:
                    taken.forget()
                continue
            if count == taken.needed // 2:
                taken.standing = Standing.of(plant.field)
            taken.still.append((begin + 0.5 * settle, stood, number))
            taken.pictures.append((number, picture))
            if visit.astray:
                taken.forget()

    def _check(self, visit: CodedVisit) -> None:
        """Refuse to continue without any heliostat."""
        if not visit.visits:
            why = next(iter(visit.lost.values()), "")
            raise RefusedError(f"{self.kind} to {visit.target.name}: no heliostat is left; {why}")

    async def _next(self, visit: CodedVisit, light: Light, taken: _Taken) -> Exposed:
        """Take a photograph.

        Few photographs await evaluation, so an unusable photograph ends the visit soon.
        """
        if len(taken.pictures) >= _UNREAD:
            await asyncio.shield(taken.pictures[-_UNREAD][1].light)
        return await self._exposed(visit.target, light)

    async def _separated(
        self, visit: CodedVisit, layout: Layout, light: Light, taken: _Taken, tell: Tell
    ) -> tuple[dict[str, Photographs], dict[str, CycleResult]]:
        """Return the sightings of identified beams, and the results of all other heliostats."""
        chosen = [layout.names.index(name) for name in visit.names]
        pictures = await taken.read()
        moves = layout.moves[[number for number, _ in pictures]][:, chosen]
        tell("separating the beams")
        lights, worker = [one for _, one in pictures], self.cycle.worker
        middle, axes = float(np.mean([one.at for one in lights])), layout.target.axes
        beams = await worker(
            separated,
            lights,
            light.empty,
            moves,
            [layout.beams[i] for i in chosen],
            None if layout.powers is None else layout.powers[chosen],
        )
        heard = []
        for i, beam in zip(chosen, beams, strict=True):
            if beam.verdict is Verdict.PROVEN:
                still = [
                    (begin, end, layout.aims[i] + layout.moves[number, i] @ axes)
                    for begin, end, number in taken.still
                ]
                one = visit.visits[beam.heliostat]
                heard.append(CountsHeard.of(one, layout.aims[i], still, middle))
        at_rest = await worker(counts_at_rest, heard)
        results: dict[str, CycleResult] = {}
        proven: dict[str, Photographs] = {}
        for beam in beams:
            name, counts = beam.heliostat, at_rest.get(beam.heliostat)
            if counts is None:
                results[name] = _not_proven(name, beam.verdict, beam.other)
            elif isinstance(counts, str):
                text = f"unchanged: {counts}"
                results[name] = CycleResult(name, CalibrationOutcome.NOT_PROVEN, text)
            else:
                by_view = (light.empty or lights[0]).covariance_at(beam.centroid)
                covariance = axes.T @ (beam.covariance + by_view) @ axes
                shot = Shot(np.asarray(layout.target.point(beam.centroid)), middle, covariance)
                shot = await self.cycle.alone(layout.target, name, shot, taken.standing)
                proven[name] = Photographs([(shot, counts)])
        return proven, results

    # -- learning --------------------------------------------------------------------------

    async def _learnt(
        self,
        visit: CodedVisit,
        name: str,
        taken: Photographs,
        *,
        confirming: Confirming | None = None,
        least: int | None = None,
        leaving: Leaving | None = None,
    ) -> CycleResult:
        """Learn from an identified beam (`CalibrationCycle.learn`); an error becomes a result."""
        try:
            return await self.cycle.learn(
                visit.visits[name], taken, confirming=confirming, least=least, leaving=leaving
            )
        except RefusedError as error:
            return refused(visit.mandate, name, str(error))
        except HeliotropeError as error:
            text = f"{type(error).__name__}: {error}"
            return CycleResult(name, CalibrationOutcome.ERROR, text)


async def of_each(
    heliostats: Iterable[str],
    result: Callable[[str], Awaitable[CycleResult]],
    beside: Awaitable[None] | None = None,
) -> dict[str, CycleResult]:
    """Return the results of heliostats, by name; all are computed concurrently."""
    results: dict[str, CycleResult] = {}

    async def one(name: str) -> None:
        results[name] = await result(name)

    async with asyncio.TaskGroup() as group:
        for name in heliostats:
            group.create_task(one(name))
        if beside is not None:
            await beside
    return results


def _not_proven(name: str, verdict: Verdict, other: str = "") -> CycleResult:
    text = f"unchanged: {verdict.value}{other and f' ({other})'}"
    return CycleResult(name, CalibrationOutcome.NOT_PROVEN, text, verdict=verdict)
