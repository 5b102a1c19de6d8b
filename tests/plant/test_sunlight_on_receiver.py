"""The light that a receiver gets, of which a visit on it may take a part."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from heliotrope.plant.visits.receiver_layout import sunlight_on


def test_production_is_the_area_that_the_sun_sees_of_the_mirrors_that_track_it() -> None:
    """By the angle between sun and ray, halved; mirrors that track something else do not count."""
    turns = np.radians([0.0, 60.0, 90.0, 30.0, 40.0])
    ways = np.stack([np.sin(turns), np.zeros(5), np.cos(turns)], axis=1)
    origin = np.arange(15.0).reshape(5, 3)
    on = np.array([True, True, True, False, True])
    plant: Any = SimpleNamespace(
        field=SimpleNamespace(among=lambda states, now: on),
        now=lambda: 0.0,
        aims=origin + 80.0 * ways,
        beams=SimpleNamespace(
            armature=SimpleNamespace(origin_1=origin),
            mirrors=SimpleNamespace(width=np.full(5, 2.0), height=np.full(5, 1.5)),
        ),
        sun_vector=lambda: np.array([0.0, 0.0, 1.0]),
    )
    face: Any = SimpleNamespace(holds=lambda aims: np.array([True, True, True, True, False]))
    assert sunlight_on(plant, face) == pytest.approx(3.0 * np.cos(0.5 * turns[:3]).sum())
    face.holds = lambda aims: np.zeros(5, dtype=bool)
    assert sunlight_on(plant, face) == 0.0
