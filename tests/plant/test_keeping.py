"""What is learnt and predicted while the store fails."""

from typing import Any

import pytest

from heliotrope.field.layouts import malan_plant
from heliotrope.plant.beliefs import Beliefs
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.store.records import StoreError


class Full:
    """Records on a disk that is full."""

    problem = ""

    def __getattr__(self, name: str) -> Any:
        def record(*_: object) -> None:
            raise StoreError(f"{name}: the disk is full")

        return record


@pytest.mark.parametrize("what", ["learning", "outlook"])
def test_a_failure_to_keep_is_named_and_stops_nothing(what: str) -> None:
    keeping = Keeping((), Beliefs(malan_plant(1)), Full())  # type: ignore[arg-type]
    assert keeping.problem == ""
    getattr(keeping, f"keep_{what}")(None)
    assert keeping.problem == f"record_{what}: the disk is full"
