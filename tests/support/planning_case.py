"""The plant and the day that tests of planning share."""

from datetime import UTC, datetime

import numpy as np

from heliotrope.field.example import example_plant
from heliotrope.field.target import Target
from heliotrope.mechanism.parameters import MODELS

START = datetime(2026, 9, 2, tzinfo=UTC).timestamp()
DAY = 86400.0
NAMES = MODELS["malan8"]
PLANT = example_plant()
FIELD = PLANT.groups["azel"].mechanism
AIM = PLANT.receivers[0].center


def _second_target() -> Target:
    """Beside the first, turned to the south-east."""
    first = PLANT.targets[0]
    turn = np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    center = first.center + np.array([0.0, 0.0, -4.0])
    corners = (first.corners - first.center) @ turn.T + center
    return Target("lower", corners, center)


TARGETS = (*PLANT.targets, _second_target())
