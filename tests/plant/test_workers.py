"""Computations of the plant: where they are made, what reaches it, and what ends them."""

import asyncio
import os
import pickle
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from heliotrope.calibration.learn import own_model
from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.layouts import malan_plant
from heliotrope.field.plant import Plant
from heliotrope.plant.schedule.scheduler import Scheduler
from heliotrope.plant.visits import fitting, target_light
from heliotrope.plant.workers import WorkerProcesses, at_once
from heliotrope.processes import end, pool
from support.joint_scene import Scene, joint
from support.visit_scene import CYCLE


@pytest.fixture
def worker() -> Iterator[WorkerProcesses]:
    made = WorkerProcesses(1)
    yield made
    made.close()


def missing(name: str) -> None:
    """Look for a name that is not there."""
    raise UnknownNameError("heliostat", name, ("A1",))


def refused(text: str) -> None:
    """Refuse something."""
    raise InputError(text)


def killed() -> None:
    """End this process as a machine without memory does."""
    os.kill(os.getpid(), signal.SIGKILL)


def test_processes_compute_and_begin_again_when_one_has_died(worker: WorkerProcesses) -> None:
    async def main() -> None:
        first = await worker(os.getpid)
        assert first != os.getpid()
        with pytest.raises(InputError, match="no sun") as found:
            await worker(refused, "no sun")
        assert type(found.value) is InputError
        # Its arguments are not its text, so it cannot be sent as it is.
        with pytest.raises(InputError, match="heliostat") as found:
            await worker(missing, "A2")
        assert str(found.value) == str(UnknownNameError("heliostat", "A2", ("A1",)))
        with pytest.raises(InputError, match="computing process has ended; the next"):
            await worker(killed)
        again = await worker(os.getpid)
        assert again not in (first, os.getpid())
        assert await at_once(os.getpid) == os.getpid()

    asyncio.run(main())


def test_processes_end_at_once_whatever_they_compute() -> None:
    worker = WorkerProcesses(1)

    async def main() -> int:
        number = await worker(os.getpid)
        long = asyncio.ensure_future(worker(time.sleep, 600.0))
        await asyncio.sleep(0.1)
        worker.close()
        with pytest.raises((InputError, asyncio.CancelledError)):
            await long
        return number

    number = asyncio.run(main())
    until = time.monotonic() + 20.0
    while Path(f"/proc/{number}").exists() and time.monotonic() < until:
        time.sleep(0.02)
    assert not Path(f"/proc/{number}").exists()


class Elsewhere:
    """A process that computes, and the names of what it has computed."""

    def __init__(self) -> None:
        self._pool = pool(1)
        self.names: set[str] = set()

    async def __call__(self, work: Callable[..., Any], *given: Any) -> Any:
        # Virtual time stands still meanwhile.
        pid, found = self._pool.submit(_where, work, given).result()
        assert pid != os.getpid()
        self.names.add(getattr(work, "func", work).__name__)
        return found

    def close(self) -> None:
        end(self._pool)


def _where(work: Callable[..., Any], given: tuple[Any, ...]) -> tuple[int, Any]:
    return os.getpid(), work(*given)


def _in_the_loop(*_: Any, **__: Any) -> Any:
    raise AssertionError("this takes seconds, and was computed in the process that renews leases")


def test_a_joint_visit_is_evaluated_in_another_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """The gap of the loop is bounded: what takes long is not in its process at all."""
    for place, name in (
        (target_light, "separate"),
        (own_model, "fit"),
        (own_model, "fitting_present"),
        (fitting, "fit_common"),
    ):
        monkeypatch.setattr(place, name, _in_the_loop)
    elsewhere = Elsewhere()

    async def scene(here: Scene) -> None:
        results = await here.run()
        assert {r.outcome for r in results.values()} == {CalibrationOutcome.CALIBRATED}, results

    try:
        joint(scene, cycle=replace(CYCLE, model="auto"), worker=elsewhere)
    finally:
        elsewhere.close()
    assert {"separated", "counts_at_rest", "choose_own_model", "fit_heliostat"} <= elsewhere.names


def test_what_a_prediction_takes_reaches_another_process() -> None:
    design: Plant = malan_plant(6)
    now = datetime(2026, 6, 21, 8, tzinfo=UTC)
    prospect = Scheduler(design, now=now).prospect(now, np.ones(6, np.bool_), ["left"])
    assert prospect is not None
    again = pickle.loads(pickle.dumps(prospect))
    assert again.now() == prospect.now()
