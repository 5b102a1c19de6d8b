"""An exception that nobody awaits ends a simulated run as a problem."""

import pytest

from heliotrope.twin.world.simulation import RunPlan, run
from support.report_defects import unseen


def test_an_exception_in_a_callback_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = RunPlan(0, 10.0, 1, faults=())
    assert run(plan).good
    unseen(monkeypatch)
    assert "ValueError" in run(plan).problem
