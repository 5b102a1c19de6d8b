"""What is learnt and predicted while the store fails."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from heliotrope.calibration.sightings import sightings
from heliotrope.field.layouts import malan_plant
from heliotrope.plant.field.beliefs import Beliefs
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import StoreError


class Full:
    """Records on a disk that is full."""

    problem = ""

    def __getattr__(self, name: str) -> Any:
        def record(*_: object, **__: object) -> None:
            raise StoreError(f"{name}: the disk is full")

        return record


def test_a_failure_to_keep_is_named_and_stops_nothing() -> None:
    keeping = Keeping((), Beliefs(malan_plant(1)), Full())  # type: ignore[arg-type]
    assert keeping.problem == ""
    keeping.record(None)  # type: ignore[arg-type]
    assert keeping.problem == "record: the disk is full"


def test_sightings_that_cannot_be_kept_are_told_and_kept_with_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    design = malan_plant(1)
    (name,) = design.names
    beliefs, keeper = Beliefs(design), Keeper(tmp_path / "store.sqlite", inline=True)
    keeping = Keeping(design.names, beliefs, keeper)
    keeping.recall()
    sun, target = np.array([[0.0, -0.6, 0.8]]), design.targets[0].center[None]
    first, second = (
        sightings(np.zeros(1, np.intp), np.zeros((1, 2)), sun, target, time=at)
        for at in (1.8e9, 1.8e9 + 60.0)
    )
    with monkeypatch.context() as full:
        full.setattr(keeper, "record_sightings", Full().record_sightings)
        assert beliefs.note(name, "left", first).identities.tolist() == [0]
        assert keeping.problem == "record_sightings: the disk is full"
    assert (beliefs.note(name, "left", second).identities > 0).all()
    assert keeper.sightings().sightings.time.tolist() == [1.8e9, 1.8e9 + 60.0]
    keeper.close()
