"""A heliostat's visit to a target: travel there, the observed stay, and the return.

A visit releases everything that it has taken on every exit: the place on the target
(`BroughtHome`), the lock for writing parameters (`Visit.locked`), the aim and the receiver
(`joint_visit.Returned`). If the visit cannot release something, the plant does so later; see
`plant.orders.giving_back`.
"""

import asyncio
import math
from abc import ABC, abstractmethod
from bisect import bisect_right
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from contextlib import asynccontextmanager, suppress
from typing import Self

import numpy as np

from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.links.clock import sleep_until
from heliotrope.mechanism.drives import Drive
from heliotrope.plant import refusals
from heliotrope.plant.controller import PlantController
from heliotrope.plant.motion.proofs import BeamError
from heliotrope.plant.orders.authority import Mandate, RefusedError
from heliotrope.plant.orders.tickets import Ticket

#: Function that issues an order to some heliostats.
Order = Callable[[tuple[str, ...]], Ticket]

#: A heliostat has arrived when both axes are this close (rad) to their goals in two consecutive
#: reports.
ARRIVED = 3e-4
#: Longest silence of a heliostat after a command is done, and longest time for which a temporary
#: reason may delay an order, s.
SILENT = 10.0
#: Interval between checks of the field, s.
_LOOK = 0.25


async def carried_out(
    plant: PlantController,
    order: Order,
    heliostats: Iterable[str],
    limit: float,
    look: Callable[[], Awaitable[None]],
) -> dict[str, str]:
    """Issue an order to heliostats and wait until it is done; return which fail, and why.

    An order that is refused for a reason that clears within seconds (`refusals.SOON`) does not end
    a visit: it is repeated until nothing has changed for `SILENT` s.

    Parameters
    ----------
    plant, heliostats
        The plant, and the names.
    order
        Function that issues the order to some of the heliostats.
    limit
        Time within which the order must be done once it is accepted, s.
    look
        Function that waits a little between two attempts.

    Raises
    ------
    RefusedError
        If the plant refuses every motion, or ``look`` raises it.
    """
    failed: dict[str, str] = {}
    left, until = tuple(heliostats), plant.now() + SILENT
    while left:
        try:
            ticket = order(left)
        except BeamError as error:
            refused = {name: error.refusals[name] for name in left if name in error.refusals}
            if not refused:
                raise
            others = tuple(name for name in left if name not in refused)
        else:
            await ticket.end(limit)
            late = dict.fromkeys(ticket.waiting(left), f"not done within {limit:g} s")
            refused, others = late | ticket.refusals, ()
            until = until if len(refused) == len(left) else plant.now() + SILENT
        waits = plant.now() < until
        soon = {name for name, why in refused.items() if waits and why in refusals.SOON}
        failed |= {name: why for name, why in refused.items() if name not in soon}
        left = tuple(name for name in left if name in soon or name in others)
        if soon:
            await look()
    return failed


class BroughtHome(ABC):
    """A visit that uses fine steps within its ``async with``, then brings its heliostats home."""

    plant: PlantController

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the participants."""

    @abstractmethod
    async def home(self) -> None:
        """Bring the heliostats home, or off the target; raise RefusedError if the plant refuses."""

    async def __aenter__(self) -> Self:
        """Begin the visit."""
        self._fine = self.plant.stepping.fine(self.names)
        self._fine.__enter__()
        return self

    async def __aexit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Bring the heliostats home.

        A cancelled visit ends as cancelled even if the plant refuses the motion.
        """
        try:
            await self.home()
        except RefusedError:
            if kind is None or not issubclass(kind, asyncio.CancelledError):
                raise
        finally:
            self._fine.__exit__(None, None, None)


class Visit(BroughtHome):
    """One heliostat on its way to a target, or at the target.

    Parameters
    ----------
    plant, mandate
        The plant, and the mandate under which commands are issued.
    heliostat, target
        Name of the heliostat, and the target.

    Attributes
    ----------
    row
        Index of the heliostat in the field table.
    boots
        Boot count of its local controller when the visit began; conclusions from a photograph about
        its step counts are valid only for that boot.
    away
        Whether the heliostat has been sent to the target.
    """

    def __init__(
        self, plant: PlantController, mandate: Mandate, heliostat: str, target: Target
    ) -> None:
        self.plant, self.mandate = plant, mandate
        self.heliostat, self.target = heliostat, target
        self.row = plant.field.place(heliostat)
        self.boots = int(plant.field.rows["boots"][self.row])
        self._drives = Drive(plant.beams.drives.table[self.row])
        self.away = False
        self._times: list[float] = []
        self._counts: list[FloatArray] = []
        self._goals: list[FloatArray] = []
        self._there: list[bool] = []

    @property
    def names(self) -> tuple[str, ...]:
        """The name of the heliostat."""
        return (self.heliostat,)

    @property
    def state(self) -> int:
        """Present state of the heliostat.

        Raises
        ------
        RefusedError
            If the heliostat is not live.
        """
        if not self.plant.field.live(self.plant.now())[self.row]:
            shown = self.plant.field.of(self.heliostat, self.plant.now()).text
            raise RefusedError(f"{shown}; it cannot be commanded")
        return int(self.plant.field.rows["state"][self.row])

    async def obey(self, what: str, order: Order, limit: float) -> None:
        """Issue an order, and wait until it is done and a later report has arrived.

        Parameters
        ----------
        what, order
            The command, for display, and the function that issues it; see `carried_out`.
        limit
            s.

        Raises
        ------
        RefusedError
            If the order is refused, or not done within ``limit`` s, or no report follows; or if
            another order has removed the heliostat from the visit.
        """
        if failed := await carried_out(self.plant, order, self.names, limit, self.look):
            raise BeamError(what, failed)
        # The report in the table may be older than the end of the command.
        ended = self.plant.now()
        while self.plant.field.heard[self.row] <= ended:
            if self.plant.now() - ended > SILENT:
                raise RefusedError(f"{self.heliostat}: no report within {SILENT:g} s after {what}")
            await self.look()

    async def command(
        self, name: str, values: tuple[float, ...] = (), limit: float = 120.0
    ) -> None:
        """Send the heliostat a command and wait until it is done; see `obey`."""
        person, token, plant = self.mandate.person, self.mandate.token, self.plant
        await self.obey(name, lambda some: plant.command(person, token, name, some, values), limit)

    async def aim(self, point: FloatArray, limit: float = 120.0) -> None:
        """Send the heliostat an aim and wait until it has accepted the aim; see `obey`."""
        person, token, plant = self.mandate.person, self.mandate.token, self.plant
        await self.obey(
            "AIM", lambda some: plant.aim(person, token, dict.fromkeys(some, point)), limit
        )

    @asynccontextmanager
    async def locked(self) -> AsyncIterator[None]:
        """Lock the heliostat, which is at standby, during a block; bring it back to standby.

        Parameters are exchanged only while nothing can move.

        Raises
        ------
        RefusedError
            See `command`. If the heliostat cannot be unlocked now, the plant unlocks it later.
        """
        await self.command("LOCK")
        try:
            yield
        except BaseException:
            with suppress(RefusedError):
                await self._unlock()
            raise
        await self._unlock()

    async def _unlock(self) -> None:
        await self.command("UNLOCK")
        await self.command("IDLE")

    async def go(self, limit: float, point: FloatArray | None = None) -> None:
        """Send the heliostat to the target and wait until it has arrived.

        Parameters
        ----------
        limit
            Maximum time, s.
        point
            Aim on the target, ENU, m, (3,); None: its centre.

        Raises
        ------
        RefusedError
            If the heliostat is neither at standby nor tracking, a command is refused, or the
            heliostat does not arrive within ``limit`` s.
        """
        state = self.state
        if state not in states.AVAILABLE:
            raise RefusedError(
                f"{self.heliostat} is {states.STATES[state]}; bring it to standby (APPROACH) first"
            )
        self.away = True
        await self.aim(np.asarray(self.target.center) if point is None else point)
        if self.state != states.TRACKING:
            await self.command("TRACK")
        await self.arrived(limit)

    async def arrived(self, limit: float) -> None:
        """Wait until the heliostat stays where it was sent; see `go`."""
        until = self.plant.now() + limit
        since, seen = self.plant.now(), 0
        while seen < 2:
            if self.plant.now() >= until:
                raise RefusedError(
                    f"{self.heliostat}: not at its aim in fine steps within {limit:g} s"
                )
            await self.look()
            if self.state != states.TRACKING:
                raise RefusedError(
                    f"{self.heliostat} is {states.STATES[self.state]}, no longer TRACKING"
                )
            counted = float(self.plant.field.counted_at[self.row])
            if counted > since:
                since = counted
                seen = seen + 1 if self.there() else 0

    def there(self) -> bool:
        """Return whether the heliostat is at its goals, and follows them in fine steps."""
        coarse = self.plant.stepping.coarse(self.names, self.plant.now())
        return self.left() < ARRIVED and not coarse

    def left(self) -> float:
        """Return the distance of the axes from their goals, rad; the larger of the two."""
        node = self.plant.field.rows[self.row]
        here = np.array([node["primary"], node["secondary"]], dtype=np.float64)
        goal = np.array([node["primary_goal"], node["secondary_goal"]], dtype=np.float64)
        return float(np.abs((goal - here) * self._drives.radians_per_count(here)).max())

    async def look(self) -> None:
        """Wait briefly, and record the counts if they are new.

        Raises
        ------
        RefusedError
            If another order has removed the heliostat from the visit.
        """
        await sleep_until(self.plant.clock, self.plant.now() + _LOOK)
        if wrong := self.mandate.refused((self.heliostat,)):
            raise BeamError("visit", wrong)
        self.note()

    def note(self) -> None:
        """Record the last reported step counts if they are new."""
        # Counts may be polled less often than the state; their own age gives their time of
        # validity.
        counted = float(self.plant.field.counted_at[self.row])
        node = self.plant.field.rows[self.row]
        # The age of a report jitters with the delay of its message, so not every change is a new
        # reply.
        if np.isfinite(counted) and (not self._times or counted > self._times[-1] + _LOOK):
            self._times.append(counted)
            self._counts.append(np.array([node["primary"], node["secondary"]], dtype=np.float64))
            self._goals.append(np.array([node["primary_goal"], node["secondary_goal"]], np.float64))
            tracks = node["state"] == states.TRACKING
            self._there.append(bool(tracks) and self.left() < ARRIVED)

    async def counts_at(self, instant: float, limit: float = 10.0) -> FloatArray:
        """Return the step counts at an instant, interpolated between adjacent reports, (2,).

        Only reports with both axes at their goals are used. An axis that moves down with the sun
        swings below its goal from time to time, so as to approach from below; a report from such a
        moment is not valid for the next second.

        Raises
        ------
        RefusedError
            If the heliostat was not reported at its goals both before the instant and within
            ``limit`` s after it.
        """
        until = self.plant.now() + limit
        while not (sum(self._there) > 1 and self._heard_there()[-1] >= instant):
            if self.plant.now() >= until:
                raise RefusedError(
                    f"{self.heliostat}: no report of its position at its aim within {limit:g} s "
                    "of the photograph, so its position in the photograph is unknown"
                )
            await self.look()
        times = self._heard_there()
        counts = [row for row, there in zip(self._counts, self._there, strict=True) if there]
        after = min(max(bisect_right(times, instant), 1), len(times) - 1)
        if not times[0] <= instant:
            raise RefusedError(f"{self.heliostat}: the photograph is older than all known counts")
        share = (instant - times[after - 1]) / (times[after] - times[after - 1])
        return np.asarray(counts[after - 1] + share * (counts[after] - counts[after - 1]))

    def fell(self, instant: float) -> tuple[FloatArray, float]:
        """Return how far the goals dropped around an instant, steps, (2,), and over what time, s.

        The drop is measured between the reports before and after the instant, for which `counts_at`
        has waited.
        """
        times = self._heard_there()
        goals = [row for row, there in zip(self._goals, self._there, strict=True) if there]
        after = min(max(bisect_right(times, instant), 1), len(times) - 1)
        return goals[after - 1] - goals[after], times[after] - times[after - 1]

    def heard_moving(self, instant: float) -> float:
        """Return the time from an instant to the nearest report away from the goals, s.

        Returns infinity if there is no such report.
        """
        rows = zip(self._times, self._there, strict=True)
        return min((abs(at - instant) for at, there in rows if not there), default=math.inf)

    def _heard_there(self) -> list[float]:
        """Return the times of the reports in which both axes are at their goals."""
        return [at for at, there in zip(self._times, self._there, strict=True) if there]

    @property
    def counted(self) -> tuple[FloatArray, FloatArray]:
        """The recorded times, monotonic s, (R,), and the step counts at these times, (R, 2)."""
        return np.array(self._times), np.array(self._counts).reshape(-1, 2)

    def taken_off(self) -> None:
        """Move the beam off if an order has left it at an aim with unverified parameters."""
        state = int(self.plant.field.rows["state"][self.row])
        if state in states.ON_AIM:
            self.plant.defocus(f"visit of {self.mandate.person.name}", (self.heliostat,))

    async def home(self) -> None:
        """Bring the heliostat back to standby or, failing that, move its beam off the target.

        A heliostat that another order has removed from the visit is not moved.
        """
        if not self.away:
            return
        self.away = False
        try:
            if self.heliostat not in self.mandate.taken:
                await self.command("IDLE", limit=60.0)
        except (RefusedError, asyncio.CancelledError):
            if self.heliostat not in self.mandate.taken:
                self.mandate.give_up((self.heliostat,))
                self.plant.defocus(f"visit of {self.mandate.person.name}", (self.heliostat,))
            raise
