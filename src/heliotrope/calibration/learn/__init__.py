"""Learn a field: parameters, their drift over time, noise, steps, regimes and outliers.

Begin with `learn`; `predict` and `assess` compare the result with sightings; `beliefs_of` converts
the result into a belief for each heliostat, and `observe` updates a belief with one sighting after
another. `compare_models` and `choose_model` find the model of a field, `choose_own_model` finds the
model of one heliostat, and `search_periodic_errors` finds worm gears of unknown ratio. Learning on
several computers needs the optional package dask.distributed and must be imported from the module
`calibration.learn.on_dask`.
"""

from heliotrope.calibration.learn.assessment import Assessment, HeliostatFigures, assess
from heliotrope.calibration.learn.drift import Hyperparameters, Posterior, Process
from heliotrope.calibration.learn.forecast import Forecast
from heliotrope.calibration.learn.learned import Learned, Prediction, left_out_errors, predict
from heliotrope.calibration.learn.learning import learn
from heliotrope.calibration.learn.misfits import Misfit, find_misfits
from heliotrope.calibration.learn.models import (
    ScoredModel,
    candidate_models,
    choose_model,
    compare_models,
)
from heliotrope.calibration.learn.own_model import OwnModel, choose_own_model
from heliotrope.calibration.learn.periodic import PeriodicError, search_periodic_errors
from heliotrope.calibration.learn.sequential import (
    beliefs_of,
    predict_by_stream,
    predict_in_turn,
)
from heliotrope.calibration.learn.stream import Belief, Event, begin, observe, read_belief, update

__all__ = [
    "Assessment",
    "Belief",
    "Event",
    "Forecast",
    "HeliostatFigures",
    "Hyperparameters",
    "Learned",
    "Misfit",
    "OwnModel",
    "PeriodicError",
    "Posterior",
    "Prediction",
    "Process",
    "ScoredModel",
    "assess",
    "begin",
    "beliefs_of",
    "candidate_models",
    "choose_model",
    "choose_own_model",
    "compare_models",
    "find_misfits",
    "learn",
    "left_out_errors",
    "observe",
    "predict",
    "predict_by_stream",
    "predict_in_turn",
    "read_belief",
    "search_periodic_errors",
    "update",
]
