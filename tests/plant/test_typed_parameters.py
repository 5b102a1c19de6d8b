"""Error parameters that a person sets: proved, kept as a version, and brought back."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from heliotrope.calibration.record import HeliostatCalibration, Provenance
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.example import example_plant
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Ask, Parameters
from heliotrope.mechanism.board_items import Wanted, items_of
from heliotrope.plant.operations.typed_parameters import TypedParameters
from heliotrope.plant.orders.audit import read
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from support.plant_bench import ENGINEER, OPERATOR, Bench, running

NAME = "P1A"
VIEWER = Person("guest", Role.VIEWER)
Scene = Callable[[Bench, int, TypedParameters], Awaitable[None]]


class Kept:
    """A store that keeps all versions, and a logbook."""

    def __init__(self) -> None:
        self.versions: list[HeliostatCalibration] = []
        self.told: list[str] = []

    async def read(self, query: Callable[["Kept"], Any]) -> Any:
        return query(self)

    def calibration_history(self, heliostat: str) -> list[HeliostatCalibration]:
        return [one for one in self.versions if one.heliostat == heliostat]

    def event(self, kind: str, who: str, text: str) -> None:
        self.told.append(text)


@pytest.fixture(autouse=True)
def _no_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    async def at_once(work: Callable[..., Any], *given: Any) -> Any:
        return work(*given)

    monkeypatch.setattr(asyncio, "to_thread", at_once)  # virtual time has no threads


def play(folder: Path, scene: Scene, state: int = states.STOWED) -> tuple[Bench, Kept]:
    made: list[Bench] = []
    kept = Kept()

    async def main(clock: VirtualClock) -> None:
        items = items_of(example_plant()[NAME].calibrated)
        bench = Bench(clock, folder, wanted=Wanted({NAME: items}))
        made.append(bench)
        cluster = bench.cluster_of(NAME)
        cluster.stored[NAME].update(items)
        async with running(bench):
            token = await bench.commanded(ENGINEER)
            bench.plant.beliefs.subscribe(kept.versions.append)
            cluster.set(state, NAME)
            await bench.wait(3.0)
            await scene(bench, token, TypedParameters(bench.plant, kept, kept))

    run_virtual(main)
    return made[0], kept


def test_what_is_set_is_stored_believed_and_kept_with_its_reason(tmp_path: Path) -> None:
    async def scene(bench: Bench, token: int, typed: TypedParameters) -> None:
        ticket = typed.change(ENGINEER, token, NAME, {"tilt_east": 0.004}, "levelled on 3 March")
        assert await ticket.end(20.0), ticket.text
        wanted = items_of(example_plant()[NAME].calibrated.with_parameters({"tilt_east": 0.004}))
        assert bench.cluster_of(NAME).stored[NAME] == wanted
        record = bench.plant.beliefs.record(NAME)
        assert record is not None
        assert (record.version, record.person, record.note) == (
            1,
            ENGINEER.name,
            "levelled on 3 March",
        )
        assert record.provenance is Provenance.PERSON
        view = await typed.view(NAME, ENGINEER)
        assert (view.version, view.stored) == (1, "the same")
        (tilt,) = (one for one in view.parameters if one.name == "tilt_east")
        assert (tilt.file, tilt.value) == (0.0, 0.004)
        assert tilt.sigma == pytest.approx(tilt.prior)

    bench, kept = play(tmp_path, scene)
    notes = [record.note for record in read(bench.audit.path)[0] if record.what == "PARAMETERS"]
    assert notes[-1].endswith("; confirmed: levelled on 3 March")
    assert kept.told == [f"PARAMETERS {NAME}: tilt_east 0.004 (levelled on 3 March)"]


def test_a_viewer_asks_nothing_of_the_bus_and_an_operator_little(tmp_path: Path) -> None:
    async def scene(bench: Bench, token: int, typed: TypedParameters) -> None:
        del token
        cluster = bench.cluster_of(NAME)

        def questions() -> int:
            return len([ask for ask in cluster.of(Ask) if ask.what == "stored"])

        before = questions()
        for _ in range(100):
            assert (await typed.view(NAME, VIEWER)).stored == "the same"
        assert questions() == before
        for _ in range(100):
            stored = (await typed.view(NAME, OPERATOR)).stored
        assert questions() - before <= 20
        assert stored == "the same (at the last comparison; they can be queried again in 5 s)"
        await bench.wait(60.0)
        item = next(iter(items_of(example_plant()[NAME].calibrated)))
        cluster.stored[NAME][item] = bytes(len(cluster.stored[NAME][item]))
        assert (await typed.view(NAME, OPERATOR)).stored.startswith("others: ")
        assert "differ" in (await typed.view(NAME, VIEWER)).stored

    play(tmp_path, scene)


def test_an_earlier_version_is_listed_and_brought_back(tmp_path: Path) -> None:
    async def scene(bench: Bench, token: int, typed: TypedParameters) -> None:
        for value, why in ((0.004, "first"), (0.001, "second")):
            ticket = typed.change(ENGINEER, token, NAME, {"tilt_east": value}, why)
            assert await ticket.end(20.0), ticket.text
            bench.plant.authority.keep(ENGINEER, token)
        (earlier,) = (await typed.view(NAME, ENGINEER)).earlier
        assert (earlier.version, earlier.note, earlier.values["tilt_east"]) == (1, "first", 0.004)
        compared = await typed.compare(NAME, 1, 2)
        (tilt,) = (one for one in compared.parameters if one.name == "tilt_east")
        assert (tilt.first, tilt.second, compared.in_use) == (0.004, 0.001, 2)
        assert tilt.first_sigma == bench.plant.beliefs.nominal(NAME).parameter("tilt_east").prior
        # A mirror turned by 3 mrad turns its beam by up to twice that.
        aim = bench.plant.default_aims((NAME,))[NAME]
        path = np.linalg.norm(aim - bench.plant.beliefs.present(NAME).pose(np.zeros(2)).vertex)
        assert 0.5 * 3e-3 * path < compared.beam_rms <= compared.beam_most < 2.01 * 3e-3 * path
        assert (await typed.compare(NAME, 2, 2)).beam_most < 1e-6
        assert (await typed.compare(NAME, 0, 2)).first.note == "plant file"
        with pytest.raises(UnknownNameError, match="version of P1A '9'"):
            await typed.compare(NAME, 1, 9)
        ticket = await typed.restore(ENGINEER, token, NAME, 1, "the level was wrong")
        assert await ticket.end(20.0), ticket.text
        record = bench.plant.beliefs.record(NAME)
        assert record is not None
        assert (record.version, record.parameters) == (3, {"tilt_east": 0.004})
        assert record.note == "back to version 1: the level was wrong"
        with pytest.raises(UnknownNameError, match="version of P1A '9'"):
            await typed.restore(ENGINEER, token, NAME, 9, "why not")

    play(tmp_path, scene)


def test_a_surveyed_place_is_set_and_its_beam_is_proven_from_there(tmp_path: Path) -> None:
    """Malan 3.4.1: the location of a heliostat, as far as a survey may be wrong."""
    survey = {"position_east": 0.3, "position_north": -0.12}

    async def scene(bench: Bench, token: int, typed: TypedParameters) -> None:
        row = bench.plant.field.place(NAME)
        before = bench.plant.beams.armature.origin_1[row].copy()
        ticket = typed.change(ENGINEER, token, NAME, survey, "surveyed again")
        assert await ticket.end(20.0), ticket.text
        moved = bench.plant.beams.armature.origin_1[row] - before
        assert moved == pytest.approx([0.3, -0.12, 0.0], abs=1e-9)
        wanted = items_of(example_plant()[NAME].calibrated.with_parameters(survey))
        assert bench.cluster_of(NAME).stored[NAME] == wanted
        bench.plant.authority.keep(ENGINEER, token)
        with pytest.raises(InputError, match=r"position_east 0\.301 is more than 6 standard dev"):
            typed.change(ENGINEER, token, NAME, {"position_east": 0.301}, "moved")

    play(tmp_path, scene)


def test_values_that_were_measured_keep_their_uncertainty(tmp_path: Path) -> None:
    async def scene(bench: Bench, token: int, typed: TypedParameters) -> None:
        covariance = np.array([[4e-8, 1e-8], [1e-8, 9e-8]])
        record = HeliostatCalibration(
            NAME, 1.0, ("tilt_north", "tilt_east"), np.array([1e-3, 2e-3]), covariance, np.ones(2),
            version=7,
        )  # fmt: skip
        bench.plant.beliefs.take(record)
        bench.cluster_of(NAME).stored[NAME].update(bench.plant.wanted.items[NAME])
        await bench.plant.stored(NAME)
        bench.plant.authority.keep(ENGINEER, token)
        typed.change(ENGINEER, token, NAME, {"tilt_east": 3e-3}, "levelled")
        await bench.wait(5.0)
        found = bench.plant.beliefs.record(NAME)
        assert found is not None
        assert (found.version, found.parameters) == (8, {"tilt_north": 1e-3, "tilt_east": 3e-3})
        prior = bench.plant.beliefs.nominal(NAME).parameter("tilt_east").prior
        assert found.covariance == pytest.approx(np.diag([4e-8, prior**2]))

    play(tmp_path, scene)


@pytest.mark.parametrize("state", [states.TRACKING, states.IDLE])
def test_nothing_is_set_while_the_beam_is_out(tmp_path: Path, state: int) -> None:
    async def scene(bench: Bench, token: int, typed: TypedParameters) -> None:
        with pytest.raises(RefusedError, match="stow it first"):
            typed.change(ENGINEER, token, NAME, {"tilt_east": 0.004}, "levelled")
        assert bench.plant.beliefs.record(NAME) is None
        assert not bench.cluster_of(NAME).of(Parameters)

    _, kept = play(tmp_path, scene, state)
    assert kept.told == []


def test_who_may_and_what_is_credible(tmp_path: Path) -> None:
    async def scene(bench: Bench, token: int, typed: TypedParameters) -> None:
        for values, reason, error, text in (
            ({"tilt_east": 1.5}, "units", InputError, "more than 6 standard deviations"),
            ({"tilt_east": float("nan")}, "units", InputError, "more than 6 standard deviations"),
            ({"tilt_east": 0.004}, " ", InputError, "a reason"),
            ({"tilt_east": 0.0}, "again", InputError, "has these parameters, so"),
            ({"tilt_est": 0.004}, "typo", UnknownNameError, "did you mean tilt_east"),
        ):
            with pytest.raises(error, match=text):
                typed.change(ENGINEER, token, NAME, values, reason)
        with pytest.raises(RefusedError, match="engineer"):
            typed.change(OPERATOR, token, NAME, {"tilt_east": 0.004}, "levelled")
        assert not bench.cluster_of(NAME).of(Parameters)

    play(tmp_path, scene)
