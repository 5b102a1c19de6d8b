"""The model used to fit each heliostat of a running plant."""

from heliotrope.calibration.learn.own_model import OwnModel, choose_own_model
from heliotrope.calibration.sightings import Sightings
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant.visits.settings import SIMPLE, CycleSettings
from heliotrope.plant.workers import Worker

#: The model is chosen again when the number of sightings has grown by this factor.
MORE = 1.25


class ModelOfEach:
    """Models by heliostat, each kept until many more sightings are available for a new choice.

    Parameters
    ----------
    settings
        Settings, whose ``model`` applies to all heliostats unless it is "auto".
    worker
        Function that compares the candidates.
    """

    def __init__(self, settings: CycleSettings, worker: Worker) -> None:
        self._model, self._worker = settings.model, worker
        self._kept: dict[str, tuple[int, OwnModel]] = {}

    async def of(self, heliostat: str, nominal: Mechanism, sightings: Sightings) -> OwnModel:
        """Return the model for all sightings of a heliostat; ``nominal`` has batch shape (1,)."""
        if self._model != "auto":
            return _given(self._model, nominal)
        count, model = self._kept.get(heliostat, (0, None))
        if model is None or len(sightings) >= MORE * count:
            model = await self._worker(choose_own_model, nominal, sightings, SIMPLE)
            self._kept[heliostat] = len(sightings), model
        return model


def _given(model: str | tuple[str, ...], nominal: Mechanism) -> OwnModel:
    if isinstance(model, str):
        return OwnModel(model, parameter_table.model(model, nominal.parameters))
    return OwnModel("+".join(model), model)
