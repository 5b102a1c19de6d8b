"""Texts of errors, alarms and refusals: a kind that a name repeats stands once."""

import pytest

from heliotrope.errors import FormatError, once
from heliotrope.field.layouts import malan_plant
from heliotrope.field.volumes import around
from heliotrope.safety import alarms


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("receiver receiver: no light", "receiver: no light"),
        ("on target target-west", "on target-west"),
        ("cluster cluster 7 is silent", "cluster 7 is silent"),
        ("receiver west, target east", "receiver west, target east"),
        ("receivers receiver", "receivers receiver"),
    ],
)
def test_a_kind_that_a_name_repeats_stands_once(text: str, said: str) -> None:
    assert once(text) == said


def test_a_place_in_a_file_stands_once() -> None:
    error = FormatError("plant.toml", "aims: moves must be 1 or more", "aims")
    assert str(error) == "plant.toml: aims: moves must be 1 or more"
    assert error.problem == "moves must be 1 or more"
    assert str(FormatError("a.csv", "east: empty", "line 1")) == "a.csv: line 1: east: empty"


def test_alarms_and_volumes_name_no_receiver_receiver() -> None:
    (receiver,) = malan_plant(2).receivers
    assert receiver.name == "receiver"
    assert around(receiver, 1.0).name == "the receiver"
    raised = alarms.CAMERA.raised("target", problem="no frame for 5 s")
    assert raised.text.startswith("target: no frame for 5 s. ")
    assert alarms.CAMERA.ended("target").text == "target: frames arrive again"
