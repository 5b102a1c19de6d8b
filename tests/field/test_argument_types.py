"""Arguments of other types end in one line that says what to give."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import heliotrope as ht
from heliotrope.errors import InputError

PLANT = ht.example_plant()
ONE = PLANT["P1A"]
UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: ht.open(5), "path is an int, 5; pass the path of a file or folder"),
        (lambda: ht.open(None), "path is a NoneType, None"),
        (lambda: ht.open(""), "path is empty"),
        (lambda: ht.calibrate("base.csv"), "field is a str, 'base.csv'; pass the result of"),
        (lambda: ht.calibrate(PLANT), "field is a heliotrope Plant"),
        (lambda: ht.predict(PLANT, None), "learned is a heliotrope Plant"),
        (lambda: ht.read_field_sightings("plant.toml", "plant.toml"), "plant is a str"),
        (lambda: ht.read_field_sightings(PLANT, None), "place is a NoneType"),
        (lambda: ht.read_field_sightings(PLANT, "p", now="today"), "now is a str, 'today'"),
        (
            lambda: ht.read_field_sightings(PLANT, "p", now=float("nan")),
            "now must be in Unix seconds, not nan",
        ),
        (
            lambda: ht.read_field_sightings(PLANT, "p", centroid="x"),
            "centroid must be 'utis' or 'helios', not 'x'",
        ),
        (lambda: ht.track(ONE, UP, UP, local="no"), "local is a str, 'no'; pass True or False"),
        (lambda: ht.track(ONE, UP, UP, newton=None), "newton is a NoneType"),
    ],
)
def test_another_type_is_one_line(call: Callable[[], Any], says: str) -> None:
    with pytest.raises(InputError) as caught:
        call()
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
