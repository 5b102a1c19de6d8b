"""The model that each heliostat of a running plant is fitted with."""

import asyncio
from collections.abc import Generator
from typing import TypeVar, cast

from heliotrope.calibration.learn.own_model import OwnModel, choosing
from heliotrope.calibration.sightings import Sightings
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant.visits.settings import SIMPLE, CycleSettings

Result = TypeVar("Result")

#: The model is chosen again when there are this many times as many sightings.
MORE = 1.25


class ModelOfEach:
    """Models by heliostat, kept until there are many more sightings to choose from.

    Parameters
    ----------
    settings
        Its ``model`` is for all heliostats, unless it is "auto".
    """

    def __init__(self, settings: CycleSettings) -> None:
        self._model = settings.model
        self._kept: dict[str, tuple[int, OwnModel]] = {}

    async def of(self, heliostat: str, nominal: Mechanism, sightings: Sightings) -> OwnModel:
        """Return the model for all sightings of a heliostat (nominal of batch shape (1,))."""
        if self._model != "auto":
            return _given(self._model, nominal)
        count, model = self._kept.get(heliostat, (0, None))
        if model is None or len(sightings) >= MORE * count:
            model = await stepwise(choosing(nominal, sightings, SIMPLE))
            self._kept[heliostat] = len(sightings), model
        return model


async def stepwise(steps: Generator[None, None, Result]) -> Result:
    """Return the result of work in steps, and let the plant work between them."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return cast("Result", end.value)
        await asyncio.sleep(0.0)


def _given(model: str | tuple[str, ...], nominal: Mechanism) -> OwnModel:
    if isinstance(model, str):
        return OwnModel(model, parameter_table.model(model, nominal.parameters))
    return OwnModel("+".join(model), model)
