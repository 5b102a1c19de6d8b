"""Aims of a plant under a flux limit: computed outside the event loop, sent a few at a time.

At regular intervals `heliotrope.aims.rounds` finds the aims with the highest power, and a sequence
of moves to them that never exceeds the limit. Heliostats receive their aims through the commands
that an operator would use, with the same checks. A heliostat at standby joins the receiver only at
the aim assigned here, and a heliostat without an aim stays at standby. Beams that an operator has
aimed, or that automatic control may not move, stay where they are, and their flux counts towards
the limit. If no new aims can be computed, the last good ones stay in force at first. Later the
field goes to the safe spread: fewer heliostats, at the aims of the plant file.

With a ramp limit, the flux that the beams would bring in full sun may exceed the flux of the last
minute only by the rise allowed in one round (`aims.heating`). Heliostats therefore leave the
receiver while a cloud covers the sun. When the sun is back, they return as fast as the ramp allows:
the first round follows at once, further rounds follow shortly while heliostats wait for the ramp,
and only heliostats that stand ready at standby take part in it. Before the sun is so low that
automatic control stows the field, they leave along the same ramp. If the measured flux is above the
limit, the limit of the cells concerned is lowered by the ratio of the measured to the predicted
flux, so that the same moves relieve them. Where errors under the limit cost power, heliostats are
calibrated first whose errors cost most.
"""

import asyncio
import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar, TypeVarTuple

import numpy as np
import numpy.typing as npt

from heliotrope.aims import Demand, SharedErrors
from heliotrope.aims.candidates import surface_in
from heliotrope.aims.heating import Heating
from heliotrope.aims.rounds import Answer, Heat, Move, Round, heat, next_round
from heliotrope.errors import HeliotropeError, InputError
from heliotrope.field.flux_limit import FluxLimit
from heliotrope.geometry import FloatArray, as_float
from heliotrope.lcu import states
from heliotrope.links.clock import sleep_until
from heliotrope.optics.scene import Scene
from heliotrope.optics.surfaces import surface_of
from heliotrope.plant.controller import PlantController
from heliotrope.plant.emergency import DNI_READING
from heliotrope.plant.field.assigned import differ
from heliotrope.plant.field.state import OUT_OF_ORDER
from heliotrope.plant.operations.automatic import AutomaticControl
from heliotrope.plant.operations.flux_check import Beyond, FluxCheck
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.workers import Worker
from heliotrope.safety import alarms
from heliotrope.store.records import Records, StoreError
from heliotrope.sun import clear_sky, vector

#: Time for which a beam without reports may still be where it was last reported, s.
HOLD = 120.0
#: Largest error of a single heliostat that is taken into account, rad of the beam per axis. With a
#: larger error the flux is no longer linear in the error: the beam is elsewhere but just as sharp,
#: and the greatest flux is that of beams that hit their aims. The blur of a larger error would hide
#: this.
BLUR = 5e-4
#: Longest wait for a move to end, and wait after it until the beams are at rest, s.
MOVED, SETTLED = 60.0, 4.0
#: Time for which a heliostat keeps its old aim if its beam may not go to its new one, s.
BLOCKED = 300.0
#: In full sun the irradiance is at most this multiple of that under a usual clear sky.
BRIGHT = 1.15
#: The sun shines above this fraction of the irradiance under a usual clear sky.
SUNNY = 0.5
#: Step of the search for the time at which the field stows, and how far ahead it looks at most, s.
STEP, DAY = 10.0, 86_400.0
#: Time between two rounds while heliostats wait for the ramp, s.
SOON = 3.0
#: Time for which a limit stays lowered after a measured flux was above it, s.
WARY = 600.0
#: The safe spread follows when the age of the last good aims exceeds this multiple of the deadline.
SAFE = 5.0

Mask = npt.NDArray[np.bool_]
T = TypeVar("T")
Given = TypeVarTuple("Given")


@dataclass(frozen=True)
class AimsView:
    """How the plant's aims are chosen, and how far the flux is from its limit.

    Attributes
    ----------
    strategy
        "spread" or "limit"; the remaining attributes apply to "limit" only.
    source
        Where the present aims come from: "optimiser", "last good aims", "safe spread"; "" before
        the first aims.
    idle
        Why nothing is moved; empty if heliostats may be moved.
    at
        Age of the figures of the flux, s; infinite before the first.
    limit, peak
        Allowable flux less the margin, and predicted flux including its errors, W/m², in the cell
        that is closest to its limit.
    reserve
        Fraction of the limit that remains unused in that cell; negative if the limit is exceeded.
    binding
        Number of cells in which the limit is binding.
    power, planned
        Power with the present aims and with the best aims, W; the best aims are not computed while
        nothing is moved.
    gap
        Upper bound on the fraction of power that better aims could still add.
    aimed, resting
        Number of heliostats that are on the receiver or have an aim there; number of wanted
        heliostats at standby without an aim.
    waiting
        Number of heliostats at standby that only the ramp keeps from joining.
    left
        Number of heliostats that still have to move.
    by_hand
        Heliostats whose beams an operator has aimed, so that they stay where they are.
    unlit
        Heliostats that send no light to any cell of the receiver, wherever they aim.
    moved, moved_ago
        Heliostats in the last move, and time since that move, s.
    problem
        Why there are no new aims; empty if there are new aims.
    """

    strategy: str
    source: str = ""
    idle: str = ""
    at: float = math.inf
    limit: float = math.nan
    peak: float = math.nan
    reserve: float = math.nan
    binding: int = 0
    power: float = math.nan
    planned: float = math.nan
    gap: float = math.nan
    aimed: int = 0
    resting: int = 0
    waiting: int = 0
    left: int = 0
    by_hand: tuple[str, ...] = ()
    unlit: tuple[str, ...] = ()
    moved: tuple[str, ...] = ()
    moved_ago: float = math.inf
    problem: str = ""


class Aiming:
    """Chooses the aims of a plant under its flux limit.

    Parameters
    ----------
    plant, log
        The controller, and the logbook for alarms and events.
    automatic
        Issues the commands while it has the command authority.
    check
        Compares the measured flux with the prediction.
    worker
        Runs the computation.
    records
        Store that keeps, across restarts, which beams operators have aimed; None: no store.
    """

    def __init__(
        self,
        plant: PlantController,
        log: Logbook,
        automatic: AutomaticControl,
        check: FluxCheck,
        worker: Worker,
        records: Records | None = None,
    ) -> None:
        self._records = records
        self._plant, self._log, self._automatic = plant, log, automatic
        self._check, self._worker, self._settings = check, worker, plant.design.aims
        count = len(plant.field)
        self._by_person: Mask = np.zeros(count, dtype=np.bool_)
        self._blocked_until = np.full(count, -math.inf)
        self._answer: Answer | None = None
        self._heat: Heat | None = None
        self._heat_at = -math.inf
        self._good_at = self._round_at = plant.now()
        self._moved: tuple[str, ...] = ()
        self._moved_at = -math.inf
        self._source = self._problem = ""
        self._above = False
        rate, every = self._settings.ramp, self._settings.every
        self._heating = Heating(rate, every) if rate > 0.0 else None
        #: When a measured flux was above the limit, and by how much.
        self._beyond: list[tuple[float, Beyond]] = []

    # -- people ----------------------------------------------------------------------------

    def by_person(self, heliostats: Sequence[str], *, aimed: bool) -> None:
        """Note that an operator has aimed heliostats (() for all), or has returned them."""
        rows = [self._plant.field.place(name) for name in heliostats or self._plant.field.names]
        if (self._by_person[rows] == aimed).all():
            return
        self._by_person[rows] = aimed
        if self._records is not None:
            names = np.array(self._plant.field.names)[self._by_person]
            try:
                self._records.keep_aimed_by_people(tuple(names.tolist()))
            except StoreError as error:
                self._log.take_alarm(alarms.RECORDS.raised(problem=error))

    def recall(self) -> None:
        """Do not move the beams that operators had aimed when the previous program ended."""
        if self._records is None:
            return
        try:
            names = self._records.aimed_by_people()
        except StoreError as error:
            self._log.take_alarm(alarms.RECORDS.raised(problem=error))
            return
        self._by_person |= np.isin(self._plant.field.names, names)

    def by_hand(self, heliostat: str) -> bool:
        """Return whether a beam stays where an operator has aimed it, under a flux limit."""
        row = self._plant.field.place(heliostat)
        return self._settings.limit is not None and bool(self._by_person[row])

    def points(self, heliostats: Sequence[str]) -> Mapping[str, FloatArray]:
        """Return the aims on the first receiver, ENU, m, (3,), by name.

        Raises
        ------
        InputError
            If a heliostat has no aim under the flux limit.
        UnknownNameError
            If there is no such heliostat.
        """
        if self._settings.limit is None:
            return self._plant.default_aims(heliostats)
        aims, place = self._automatic.aims, self._plant.field.place
        without = [name for name in heliostats if place(name) >= 0 and name not in aims]
        if without:
            more = f" (and {len(without) - 1:,} more)" if len(without) > 1 else ""
            raise InputError(
                f"aim {without[0]}{more}: no aim under the flux limit; give it to automatic "
                "control, leave it at standby, or state the point on the receiver"
            )
        return {name: aims[name] for name in heliostats}

    def view(self) -> AimsView:
        """Return how aims are chosen now."""
        settings, now, field = self._settings, self._plant.now(), self._plant.field
        if settings.limit is None:
            return AimsView(settings.strategy)
        aims, names, on = self._automatic.aims, np.array(field.names), self._on(now)
        aimed = on | np.array([name in aims for name in field.names])
        resting = self._automatic.movable() & ~aimed & field.among((states.IDLE,), now)
        made = AimsView(
            settings.strategy, self._source, self._automatic.idle,
            limit=(1.0 - settings.limit.margin) * float(np.min(settings.limit.flux)),
            aimed=int(aimed.sum()), resting=int(resting.sum()), problem=self._problem,
            by_hand=tuple(names[on & self._by_person].tolist()),
            moved=self._moved, moved_ago=now - self._moved_at,
        )  # fmt: skip
        heat, answer = self._heat, self._answer
        if heat is None:
            return made
        peak, limit = heat.fullest
        made = replace(
            made, at=now - self._heat_at, limit=limit, peak=peak, reserve=-heat.excess,
            binding=heat.binding, power=heat.power,
        )  # fmt: skip
        if answer is None or answer is not heat:
            return made
        return replace(
            made, planned=answer.planned, gap=answer.gap, left=answer.left, waiting=answer.waiting,
            unlit=tuple(names[answer.unlit].tolist()),
        )  # fmt: skip

    # -- running ---------------------------------------------------------------------------

    async def run(self) -> None:
        """Choose aims until cancelled; without a flux limit there is nothing to do."""
        if self._settings.limit is None:
            return
        while True:
            begun = self._plant.now()
            await self._step(begun)
            await self._pause(begun)

    async def _pause(self, begun: float) -> None:
        """Wait until the next round is due.

        It follows soon once heliostats may be moved again, or if some wait for the ramp in the sun.
        """
        due, idle = begun + self._settings.every, self._automatic.idle
        while (now := self._plant.now()) < due:
            soon = idle and not self._automatic.idle
            if not soon and self._waits_for_ramp and now >= begun + SOON:
                soon = self._measured_dni(now) > SUNNY * self._clear_sky()
            if soon:
                return
            await sleep_until(self._plant.clock, min(now + 1.0, due))

    @property
    def _waits_for_ramp(self) -> bool:
        answer = self._answer
        return answer is not None and answer is self._heat and answer.waiting > 0

    async def _step(self, now: float) -> None:
        """Compute and send aims; after a failure the last good aims stay in force."""
        self._keep(now)
        if self._automatic.idle:
            await self._stand_still(now)
            return
        present = self._round(now)
        if not present.free.any():
            await self._stand_still(now)
            return
        try:
            answer = await self._computed(next_round, present)
        except HeliotropeError as error:
            await self._failed(str(error))
            await self._watch(now)
            return
        self._round_at = now
        # A program that starts while beams are on the receiver must first see how hot it is.
        blind = self._heating is not None and not self._heating.known and present.shining.any()
        hot = self._measure(answer, now, present.scene.dni)
        if not answer.problem:
            self._accept(answer, now)
        self._warn(answer, now)
        if hot:
            await self._step(self._plant.now())
        elif not blind:
            await self._go(answer.moves)
        if answer.problem:
            await self._failed(answer.problem)

    async def _computed(self, work: Callable[[*Given], T], *given: *Given) -> T:
        """Return a result of the worker.

        Raises
        ------
        HeliotropeError
            After any failure, because the plant goes on whatever fails here.
        """
        try:
            # `asyncio.wait_for` of Python 3.11 may ignore that the program ends.
            async with asyncio.timeout(self._settings.deadline):
                return await self._worker(work, *given)
        except TimeoutError as error:
            raise HeliotropeError(f"no answer within {self._settings.deadline:g} s") from error
        except HeliotropeError:
            raise
        except Exception as error:
            raise HeliotropeError(f"{type(error).__name__}: {error}") from error

    async def _stand_still(self, now: float) -> None:
        """Only watch the flux in a round in which nothing may be moved, so that no aims are late.

        With a ramp, beams that have left lose their aims. The field would otherwise return to them
        at once, for example after an emergency or a night.
        """
        self._good_at = now
        if self._heating is not None:
            aims, on, visiting = self._automatic.aims, self._on(now), self._automatic.visiting
            for row, name in enumerate(self._plant.field.names):
                if not on[row] and name not in visiting:
                    aims.pop(name, None)
        await self._watch(now)

    async def _watch(self, now: float) -> None:
        """Compare the flux with the limit where no aims are chosen, as while an operator commands.

        If this fails, the last figures stay, with their age.
        """
        assert self._settings.limit is not None
        scene, on = self._scene(now), self._on(now)
        demand = self._demand(self._allowed(self._settings.limit, scene))
        aims = np.where(on[:, None], self._plant.aims, np.nan)
        with contextlib.suppress(HeliotropeError):
            present = await self._computed(heat, scene, demand, aims)
            self._measure(present, now, scene.dni)
            self._warn(present, now)

    def _measure(self, present: Heat, now: float, dni: float) -> bool:
        """Record the flux on the receiver, and by how much the measured flux exceeds the limit.

        The predicted flux is for an irradiance ``dni``, W/m². Return whether the flux has only now
        been measured above the limit, so that the moves of this round no longer suffice.
        """
        assert self._settings.limit is not None
        self._beyond = [(at, beyond) for at, beyond in self._beyond if now - at <= WARY]
        measured = self._measured_dni(now)
        if not math.isfinite(measured):
            return False
        flux = as_float(present.flux * (max(measured, 0.0) / dni))
        if self._heating is not None:
            self._heating.note(now, flux)
        beyond = self._check.beyond(self._settings.limit, flux)
        if beyond is None:
            return False
        self._beyond.append((now, beyond))
        return len(self._beyond) == 1

    def _accept(self, answer: Answer, now: float) -> None:
        """Accept new aims, which end the alarm about late aims.

        Errors under the limit cost power: the heliostats whose errors cost most are calibrated
        first.
        """
        mean = float(answer.worth.mean())
        self._plant.worth = 1.0 + (answer.worth / mean if mean > 0.0 else 0.0 * answer.worth)
        self._answer, self._source, self._good_at = answer, "optimiser", now
        if self._problem:
            self._problem = ""
            self._log.take_alarm(alarms.AIMS.ended())

    def _warn(self, present: Heat, now: float) -> None:
        """Raise or clear the alarm about the limit."""
        self._heat, self._heat_at = present, now
        name, kind = self._plant.design.receivers[0].name, alarms.FLUX_ABOVE_LIMIT
        fresh = [beyond for at, beyond in self._beyond if at >= now]
        excess, source = (fresh[0].excess, "measured") if fresh else (present.excess, "predicted")
        above = bool(fresh) or excess > 0.01
        if above:
            self._log.take_alarm(kind.raised(name, source=source, excess=100.0 * excess))
        elif self._above:
            self._log.take_alarm(kind.ended(name))
        self._above = above

    def _ramp(self, now: float, scene: Scene) -> FloatArray | None:
        """Return the flux that the ramp limit allows now, at the scene's irradiance."""
        if self._heating is None:
            return None
        measured = self._measured_dni(now)
        bright = max(BRIGHT * self._clear_sky(), 1.0, np.nan_to_num(measured))
        scale = scene.dni / min(scene.dni, bright)
        allowed = self._heating.allowed(now, surface_in(scene).shape, self._before_night())
        return as_float(scale * allowed)

    def _before_night(self) -> float:
        """Return the time until the sun is so low that the field stows, s; inf: not soon.

        Soon is as long as the ramp takes from the limit to zero.
        """
        assert self._settings.limit is not None
        lowest = math.sin(self._automatic.lowest)
        longest = float(np.max(self._settings.limit.flux)) / self._settings.ramp
        longest += 2.0 * self._settings.every  # a round takes effect in the next
        ahead = np.arange(0.0, min(longest, DAY) + STEP, STEP)
        utc, site = self._plant.clock.utc().timestamp(), self._plant.design.site
        low = vector(utc + ahead, site)[:, 2] < lowest
        if low[0] or not low.any():
            return math.inf
        return max(float(ahead[low.argmax()]) - 2.0 * self._settings.every, 0.0)

    def _clear_sky(self) -> float:
        """Return the irradiance under a usual clear sky, W/m²."""
        elevation = math.asin(float(np.clip(self._plant.sun_vector()[2], -1.0, 1.0)))
        return clear_sky(elevation, self._plant.design.site.height)

    def _measured_dni(self, now: float) -> float:
        """Return the measured irradiance, W/m²; NaN without a recent measurement."""
        return self._plant.sentinel.table.shown(now).get(DNI_READING, math.nan)

    async def _failed(self, problem: str) -> None:
        """Keep the last good aims; once these are too old, go to the safe spread.

        An operator who has taken the command authority while they were computed keeps the field.
        """
        self._log.take_alarm(alarms.AIMS.raised(problem=problem))
        self._problem = problem
        late = self._plant.now() - self._good_at
        if late < SAFE * self._settings.deadline:
            self._source = "" if self._answer is None else "last good aims"
        elif self._source != "safe spread" and not self._automatic.idle:
            self._source = "safe spread"
            nowhere = np.full((len(self._plant.field), 3), np.nan)
            await self._to_safe(nowhere if self._answer is None else self._answer.safe)

    async def _to_safe(self, safe: FloatArray) -> None:
        """Go to the safe spread; beams at other aims leave first, so that beams never overlap.

        Beams without an aim there (NaN) stay at standby.
        """
        on = self._on(self._plant.now()) & self._movers(self._plant.now())
        apart = ~(np.linalg.norm(self._plant.aims - safe, axis=1) < 0.05)
        rows = np.flatnonzero(on & apart)
        self._automatic.aims.clear()
        await self._rest(rows)
        names = self._plant.field.names
        some = np.flatnonzero(np.isfinite(safe).all(axis=1))
        self._automatic.aims.update({names[row]: safe[row] for row in some})

    # -- the field -------------------------------------------------------------------------

    def _on(self, now: float) -> Mask:
        """Return a mask of the heliostats whose beams may be on the receiver, (N,)."""
        field, receiver = self._plant.field, self._plant.design.receivers[0]
        reach = 0.5 * math.hypot(
            max(receiver.width, 2.0 * (receiver.radius or 0.0)), receiver.height
        )
        near = np.linalg.norm(self._plant.aims - receiver.center, axis=1) <= 1.2 * reach
        tracks = np.isin(field.rows["state"], states.ON_AIM) & (field.age(now) <= HOLD)
        return np.asarray(tracks & near)

    def _movers(self, now: float) -> Mask:
        """Return a mask of the heliostats that may be assigned other aims now, (N,)."""
        field = self._plant.field
        free = (
            self._automatic.movable()
            & field.live(now)
            & ~field.among((states.LOCKED, *OUT_OF_ORDER), now)
        )
        free &= ~self._by_person & (self._blocked_until < now)
        free &= self._on(now) | self._automatic.joinable()
        free[[field.place(name) for name in self._automatic.visiting]] = False
        return np.asarray(free)

    def _allotted(self) -> FloatArray:
        """Return the assigned aims of the heliostats, (N, 3); NaN: none."""
        none, aims = np.full(3, np.nan), self._automatic.aims
        return np.array([aims.get(name, none) for name in self._plant.field.names])

    def _keep(self, now: float) -> None:
        """Assign beams on the receiver their present aims, to which they return after a visit.

        They have other aims if the program found them there, or if an operator aimed them.
        """
        names, aims = self._plant.field.names, self._plant.aims
        on = self._on(now) & self._movers(now) & differ(aims, self._allotted())
        self._automatic.aims.update({names[row]: aims[row].copy() for row in np.flatnonzero(on)})

    def _round(self, now: float) -> Round:
        """Return the input of a round."""
        plant, settings = self._plant, self._settings
        assert settings.limit is not None
        on, free, aims = self._on(now), self._movers(now), self._allotted()
        if self._heating is not None:
            # A heliostat that cannot come now would keep others from using the ramp.
            free &= on | plant.field.among((states.IDLE,), now)
        visiting = np.isin(plant.field.names, sorted(self._automatic.visiting))
        # A heliostat that waits for its turn joins at the aim that it was assigned.
        waits = free & ~on & plant.field.among((states.IDLE,), now) & (plant.waiting > 0)
        comes = visiting | waits | (~on & self._automatic.movable() & (self._blocked_until >= now))
        fixed = np.where((on & ~free)[:, None], plant.aims, np.nan)
        fixed = np.where(comes[:, None] & np.isfinite(aims), aims, fixed)
        free &= ~comes
        spread = np.stack([*plant.default_aims().values()])
        most = max(1, round(settings.moves / 60.0 * min(now - self._round_at, 60.0)))
        scene = self._scene(now)
        return Round(
            scene,
            self._demand(self._allowed(settings.limit, scene)),
            now,
            np.where(free[:, None] | ~np.isfinite(fixed), aims, np.nan),
            free,
            on & free,
            fixed,
            spread,
            most,
            settings.together,
            self._ramp(now, scene),
        )

    def _allowed(self, limit: FluxLimit, scene: Scene) -> FluxLimit:
        """Return the limit, lowered where a measured flux was above the limit."""
        if not self._beyond:
            return limit
        factor = np.max([beyond.factor for _, beyond in self._beyond], axis=0)
        return FluxLimit(limit.on(*surface_in(scene).shape) / factor)

    def _scene(self, now: float) -> Scene:
        """Return the field with its receiver, at the irradiance for which the limit must hold."""
        scene, receiver = self._check.flux.scene(now), self._plant.design.receivers[0]
        pointing = scene.mirrors.pointing
        size = np.sqrt(0.5 * np.trace(pointing, axis1=1, axis2=2))
        less = np.minimum(1.0, BLUR / np.maximum(size, 1e-9)) ** 2
        mirrors = replace(scene.mirrors, pointing=pointing * less[:, None, None])
        dni = max(scene.dni, self._settings.dni)
        return replace(scene, surfaces=(surface_of(receiver),), mirrors=mirrors, dni=dni)

    def _demand(self, limit: FluxLimit) -> Demand:
        """Return the limit, and the probability with which the limit must hold."""
        plant, settings = self._plant, self._settings
        clusters = np.unique(plant.field.cluster, return_inverse=True)[1]
        latitude = math.radians(plant.design.site.latitude_deg)
        shared = SharedErrors(settings.drift, settings.clock, settings.cluster)
        pole = np.array([0.0, math.cos(latitude), math.sin(latitude)])
        return Demand(limit, settings.probability, shared, clusters, pole)

    # -- moves -----------------------------------------------------------------------------

    async def _go(self, moves: tuple[Move, ...]) -> None:
        """Make the moves one after the other.

        Wait for the next round after a failed move, and where a beam may no longer be moved, as in
        a visit that has begun since.
        """
        until = self._plant.now() + 2.0 * self._settings.every
        names, aims = self._plant.field.names, self._automatic.aims
        for move in moves:
            now = self._plant.now()
            on, free = (mask[move.rows] for mask in (self._on(now), self._movers(now)))
            if now > until or self._automatic.idle or (on & ~free).any():
                return
            rests = np.asarray(~np.isfinite(move.aims).all(axis=1))
            for row in move.rows[rests]:
                aims.pop(names[row], None)
            await self._rest(move.rows[rests & on])
            pairs = zip(move.rows, move.aims, on, rests, strict=True)
            goes = [(names[row], aim, shines) for row, aim, shines, rest in pairs if not rest]
            aims.update({name: aim for name, aim, shines in goes if not shines})
            if not await self._move({name: aim for name, aim, shines in goes if shines}):
                return

    async def _move(self, points: dict[str, FloatArray]) -> bool:
        """Move tracking beams; return whether all of them moved."""
        if not points:
            return True
        place = self._plant.field.place
        try:
            ticket = self._automatic.move(points)
        except HeliotropeError as error:
            refused = getattr(error, "refusals", dict.fromkeys(points, str(error)))
            self._block(refused)
            return False
        await ticket.end(MOVED)
        await sleep_until(self._plant.clock, self._plant.now() + SETTLED)
        refused = {**ticket.refusals, **ticket.blocked}
        self._block(refused)
        moved = tuple(name for name in points if name not in refused)
        self._automatic.aims.update({name: self._plant.aims[place(name)].copy() for name in moved})
        self._note(moved)
        return not refused

    async def _rest(self, rows: npt.NDArray[np.intp]) -> None:
        """Take beams off the receiver.

        They go to standby, or turn away where that is refused, as after many failures: a limit must
        hold then too.
        """
        names = tuple(self._plant.field.names[row] for row in rows)
        if not names:
            return
        try:
            tickets = [self._automatic.rest(names)]
            refused = tuple(tickets[0].blocked)
        except RefusedError:
            tickets, refused = [], names
        if refused:
            tickets.append(self._automatic.turn_away(refused))
        for ticket in tickets:
            await ticket.end(MOVED)
        self._note(names)

    def _block(self, refused: dict[str, str]) -> None:
        for name in refused:
            self._blocked_until[self._plant.field.place(name)] = self._plant.now() + BLOCKED

    def _note(self, names: tuple[str, ...]) -> None:
        if names:
            self._moved, self._moved_at = tuple(sorted(names)), self._plant.now()
