"""New parameters that wait to be verified together.

The fits of a joint first visit end one after the other. Each heliostat that stores new parameters
waits here until all the others do, or have ended otherwise; then one stack verifies them all.
"""

import asyncio
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from heliotrope.calibration.fit.estimator import FieldFit
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant.visits.photographs import Shot, Tell
from heliotrope.plant.visits.visit import Visit


@dataclass(frozen=True)
class Waiting:
    """A heliostat whose local controller stores a fit that is not verified.

    Attributes
    ----------
    visit
        Its visit.
    fitted, nominal
        The fit of batch shape (1,), and the mechanism that it starts from.
    """

    visit: Visit
    fitted: FieldFit
    nominal: Mechanism

    @property
    def mechanism(self) -> Mechanism:
        """With the fitted parameters, batch shape (1,)."""
        return self.nominal.with_parameters(self.fitted.parameters)


class Gathering:
    """Heliostats of one visit on their way to a joint verification.

    Parameters
    ----------
    heliostats
        Names of all that may come.
    """

    def __init__(self, heliostats: Iterable[str]) -> None:
        self._coming = set(heliostats)
        self._waiting: dict[str, Waiting] = {}
        self._problems: dict[str, asyncio.Future[str]] = {}
        self._complete = asyncio.Event()
        self._look()

    async def problem(
        self, visit: Visit, fitted: FieldFit, nominal: Mechanism, used: list[Shot], tell: Tell
    ) -> str:
        """Wait for the verification; see `Verification.problem`."""
        del used, tell
        name = visit.heliostat
        self._waiting[name] = Waiting(visit, fitted, nominal)
        self._problems[name] = asyncio.get_running_loop().create_future()
        self.leave(name)
        return await self._problems[name]

    def leave(self, heliostat: str) -> None:
        """Note that a heliostat does not come any more, or has come."""
        self._coming.discard(heliostat)
        self._look()

    def _look(self) -> None:
        if not self._coming:
            self._complete.set()

    async def all(self) -> Mapping[str, Waiting]:
        """Return those that wait, once no more can come."""
        await self._complete.wait()
        return self._waiting

    def settle(self, problems: Mapping[str, str]) -> None:
        """Tell heliostats why their parameters are not confirmed, "" if they are."""
        for name, problem in problems.items():
            if not self._problems[name].done():
                self._problems[name].set_result(problem)

    def fail(self, error: Exception) -> None:
        """Let a verification that cannot be made fail for all that still wait."""
        for waiting in self._problems.values():
            if not waiting.done():
                waiting.set_exception(error)
