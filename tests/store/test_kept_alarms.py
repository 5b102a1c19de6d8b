"""Alarms of a plant and its clusters, through their links, in a real store."""

import asyncio
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from heliotrope.field.layouts import lay_out
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.views import AlarmRow
from heliotrope.safety import Alarm, Severity
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import Records, StoreError
from heliotrope.twin.field.field import Field
from support.live import LiveOptions, LivePlant

OPTIONS = LiveOptions(rendered=False, threads=0, work=AutomaticSettings())


def test_alarms_of_clusters_are_stored_from_their_beginning_to_their_end(tmp_path: Path) -> None:
    keeper = Keeper(tmp_path, inline=True)

    async def main(clock: VirtualClock) -> None:
        plant = LivePlant(lay_out("radial", 3), clock, OPTIONS, records=keeper)
        assert isinstance(plant.field, Field)
        async with plant.running():
            await asyncio.sleep(3.0)
            plant.field.cut(np.array([0]))
            plant.field.fail(np.array([1]), 3)
            await asyncio.sleep(20.0)
            plant.field.restore(np.array([0]))
            await asyncio.sleep(10.0)
            shown = {(row.condition, row.subject): row for row in plant.operations.logbook.alarms()}
            await plant.end()
        assert "records" not in {condition for condition, _ in shown}
        kept = {(entry.condition, entry.subject): entry for entry in keeper.alarms()}
        assert set(kept) == set(shown)
        silent = kept["node_silent", plant.names[0]]
        assert (silent.severity, silent.cleared is not None) == (Severity.WARNING, True)
        fault = kept["node_fault", plant.names[1]]
        assert (fault.severity, fault.cleared) == (Severity.ALARM, None)
        assert fault.text == shown["node_fault", plant.names[1]].text

    run_virtual(main)
    assert not keeper.refused
    keeper.close()


@pytest.mark.parametrize("word", ["WARNING", "grave"])
def test_no_severity_loses_an_alarm(tmp_path: Path, word: str) -> None:
    keeper = Keeper(tmp_path, inline=True)
    book = Logbook(VirtualClock(), keeper)
    book.take_alarm(replace(Alarm("fire", "C1", Severity.ALARM, "it burns"), severity=word))  # type: ignore[arg-type]
    (kept,) = keeper.alarms()
    assert kept.severity is (Severity.WARNING if word == "WARNING" else Severity.ALARM)
    assert [row.condition for row in book.alarms()] == ["fire"]
    keeper.close()


def _found(book: Logbook) -> dict[str, AlarmRow]:
    return {row.condition: row for row in book.alarms()}


class _Refusing:
    """A store that can be made to refuse records, and to fail."""

    def __init__(self, keeper: Keeper) -> None:
        self._keeper, self.error = keeper, None

    def __getattr__(self, name: str) -> object:
        return getattr(self._keeper, name)

    @property
    def problem(self) -> str:
        return str(self.error) if isinstance(self.error, StoreError) else self._keeper.problem

    def record_event(self, *values: object) -> None:
        if self.error is not None:
            raise self.error


def test_a_refused_record_hides_no_failure_of_the_store(tmp_path: Path) -> None:
    from heliotrope.errors import InputError

    keeper = Keeper(tmp_path, inline=True)
    store = _Refusing(keeper)
    clock = VirtualClock()
    book = Logbook(clock, store)  # type: ignore[arg-type]
    store.error = InputError("this event is none")
    book.event("plant", "", "odd")
    book.check_records("")
    assert "this event is none" in _found(book)["record_refused"].text
    assert "records" not in _found(book)
    store.error = None
    clock.advance(5.0)
    book.check_records("")
    ended = _found(book)["record_refused"]
    assert not ended.active
    assert "this event is none" in ended.text
    assert book.open_alarms == 1, "somebody must have seen it"
    book.acknowledge("Olga", "record_refused", "")
    for times in (1, 2):
        clock.advance(5.0)
        store.error = StoreError("the disk is full")
        book.event("plant", "", "something")
        book.check_records("")
        row = _found(book)["records"]
        assert (row.active, row.count, row.acknowledged_by) == (True, times, "")
        assert "the disk is full" in row.text
        book.acknowledge("Olga", "records", "")
        store.error = None
        book.check_records("")
        assert not _found(book)["records"].active
    # The beginnings and ends are in the store, too.
    kept = [(entry.condition, entry.cleared is not None) for entry in keeper.alarms()]
    assert kept == [("records", True), ("records", True), ("record_refused", True)]
    keeper.close()


def test_a_record_refused_by_the_database_is_an_alarm(tmp_path: Path) -> None:
    keeper = Keeper(tmp_path, inline=True)
    book = Logbook(VirtualClock(), keeper)

    def refuse(_: object) -> None:
        raise ValueError("no such heliostat")

    work: list[Callable[[], None]] = [
        lambda: keeper.writer.put(refuse),
        lambda: book.event("plant", "", "something else"),
    ]
    for each in work:
        each()
        book.check_records("")
    assert "no such heliostat" in _found(book)["record_refused"].text
    keeper.close()


def test_a_queue_that_is_full_is_a_problem_of_the_store(tmp_path: Path) -> None:
    keeper: Records = Keeper(tmp_path, limit=0)
    book = Logbook(VirtualClock(), keeper)
    book.event("plant", "", "something")
    assert "no more are accepted" in _found(book)["records"].text
    book.check_records("")
    assert _found(book)["records"].active, "no room yet"
    assert isinstance(keeper, Keeper)
    keeper.close()
