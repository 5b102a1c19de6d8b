"""The plant's audit and assigned points in the store."""

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from sqlalchemy import event

from heliotrope.errors import InputError
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Stage
from heliotrope.plant.field.assigned import AssignedError, Points
from heliotrope.plant.orders.audit import STOPPED, AuditError, Record
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.orders.kept_audit import KeptAudit, KeptPoints
from heliotrope.store import audit as kept
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import AuditEntry, StoreError
from support.plant_bench import OPERATOR, Bench, running

START = datetime(2026, 6, 21, 8, tzinfo=UTC)
RECORD = Record("p-1", "anna", "operator", "AIM", START.isoformat(), (1.5, 2.0), ("A", "B"), "why")


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def audit(keeper: Keeper, clock: VirtualClock) -> KeptAudit:
    return KeptAudit(keeper, clock, START)


def entries(keeper: Keeper) -> list[AuditEntry]:
    with keeper.database.reading() as connection:
        return kept.entries(connection)


def break_writing(keeper: Keeper, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the database refuse to be written, as after a fault of its disk."""

    def refuse() -> None:
        raise StoreError("the disk is gone")

    keeper.writer._drop_connection()
    monkeypatch.setattr(keeper.database, "connect", refuse)


class TestAudit:
    def test_a_record_has_its_beginning_and_its_end(self, keeper: Keeper, audit: KeptAudit) -> None:
        audit.begin(RECORD)
        (begun,) = entries(keeper)
        assert vars(begun) == vars(RECORD)
        audit.finish("p-1", "AIM: 2 done", "2026-06-21T08:01:00+00:00")
        (ended,) = entries(keeper)
        assert (ended.result, ended.finished) == ("AIM: 2 done", "2026-06-21T08:01:00+00:00")
        audit.begin(replace(RECORD, identity="p-2"))
        assert [e.identity for e in entries(keeper)] == ["p-2", "p-1"]

    def test_what_was_open_is_ended_at_the_next_start(
        self, place: str | Path, opened: Callable[..., Keeper], clock: VirtualClock
    ) -> None:
        first = opened(place)
        before = KeptAudit(first, clock, START)
        assert before.ended == 0
        before.begin(RECORD)
        before.begin(replace(RECORD, identity="p-2"))
        before.finish("p-2", "done", START.isoformat())
        before.close()
        first.close()
        second = opened(place)
        later = START.replace(hour=9)
        assert KeptAudit(second, clock, later).ended == 1
        done, stopped = entries(second)
        assert (done.result, stopped.result) == ("done", STOPPED)
        assert stopped.finished == later.isoformat()

    def test_twice_is_once(self, keeper: Keeper, audit: KeptAudit) -> None:
        # What was written although its syncing was reported to fail is owed again.
        for _ in range(2):
            audit.begin(RECORD)
        for _ in range(2):
            audit.finish("p-1", "done", START.isoformat())
        assert [e.result for e in entries(keeper)] == ["done"]

    def test_records_that_contradict_each_other(self, keeper: Keeper, audit: KeptAudit) -> None:
        audit.begin(RECORD)
        with pytest.raises(InputError, match="record p-1 already exists; each identity"):
            audit.begin(replace(RECORD, who="ben"))
        audit.finish("p-1", "done", START.isoformat())
        with pytest.raises(InputError, match="no record p-1 is waiting for a result"):
            audit.finish("p-1", "failed", START.isoformat())
        with pytest.raises(InputError, match="no record p-9 is waiting for a result"):
            audit.finish("p-9", "done", START.isoformat())
        assert [(e.who, e.result) for e in entries(keeper)] == [("anna", "done")]

    def test_a_record_that_cannot_be_written_is_not_begun(
        self, keeper: Keeper, audit: KeptAudit, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        break_writing(keeper, monkeypatch)
        with pytest.raises(AuditError, match="the disk is gone"):
            audit.begin(RECORD)
        with pytest.raises(AuditError, match="the disk is gone"):
            audit.confirm()
        monkeypatch.undo()
        audit.begin(RECORD)
        audit.confirm()
        assert [e.identity for e in entries(keeper)] == ["p-1"]

    def test_confirming_really_writes(
        self, keeper: Keeper, audit: KeptAudit, clock: VirtualClock
    ) -> None:
        written = []

        @event.listens_for(keeper.database._writer, "before_cursor_execute")
        def note(*given: object) -> None:
            written.append(given[2])

        for _ in range(3):
            audit.confirm()
            keeper.writer.confirmed().result(10.0)
            clock.advance(0.4)
        assert sum("about" in str(s) and "INSERT" in str(s) for s in written) == 1
        clock.advance(1.0)
        audit.confirm()
        keeper.writer.confirmed().result(10.0)
        assert sum("about" in str(s) and "INSERT" in str(s) for s in written) == 2

    def test_a_store_that_is_silent_is_not_relied_on(
        self, keeper: Keeper, audit: KeptAudit, clock: VirtualClock
    ) -> None:
        import threading

        begun, gate = threading.Event(), threading.Event()
        keeper.writer.put(lambda _: begun.set() or gate.wait(10.0))
        assert begun.wait(10.0)
        audit.confirm()
        clock.advance(4.9)
        audit.confirm()
        clock.advance(0.2)
        with pytest.raises(AuditError, match="has written nothing for 5 s"):
            audit.confirm()
        gate.set()
        keeper.writer.confirmed().result(10.0)
        audit.confirm()

    def test_a_disk_without_room(
        self, keeper: Keeper, audit: KeptAudit, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        if keeper.database.file is None:
            audit.confirm()  # the server's disk is not ours to look at
            return
        monkeypatch.setattr("heliotrope.plant.orders.kept_audit.LEAST_FREE", 1 << 62)
        with pytest.raises(AuditError, match=r"bytes are left on its disk.*free some space"):
            audit.confirm()


class TestPoints:
    def test_are_kept_over_a_restart(
        self, place: str | Path, opened: Callable[..., Keeper]
    ) -> None:
        first = opened(place)
        points = KeptPoints(first)
        assert points.read() == {}
        points.keep({"AIM": {"A": (0.1, 0.2, 1 / 3), "B": (4.0, 5.0, 6.0)}, "STANDBY": {}})
        points.keep({"AIM": {"A": (7.0, 0.2, 1 / 3)}, "STANDBY": {"C": (1.0, 2.0, 3.0)}})
        first.close()
        assert KeptPoints(opened(place)).read() == {
            "AIM": {"A": (7.0, 0.2, 1 / 3)},
            "STANDBY": {"C": (1.0, 2.0, 3.0)},
        }

    def test_only_what_changes_is_written(self, keeper: Keeper) -> None:
        points = KeptPoints(keeper)
        aims = {f"H{i}": (float(i), 0.0, 0.0) for i in range(500)}
        points.keep({"AIM": aims})
        rows = []

        @event.listens_for(keeper.database._writer, "before_cursor_execute")
        def note(*given: object) -> None:
            rows.append(given[3])

        points.keep({"AIM": {**aims, "H7": (1.0, 1.0, 1.0)}})
        assert sum("H7" in str(r) for r in rows) == 1
        assert not any("H8" in str(r) for r in rows)

    def test_that_cannot_be_kept_are_not_assigned(
        self, keeper: Keeper, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        import numpy as np

        points = Points(["A", "B"], KeptPoints(keeper))

        def assign(rows: list[int], places: list[list[float]]) -> None:
            given = "AIM", np.array(rows), np.array(places)
            points.storing(*given)[0]()
            points.assign(*given)

        assign([0], [[1.0, 2.0, 3.0]])
        break_writing(keeper, monkeypatch)
        with pytest.raises(AssignedError, match=r"assigned points.*the disk is gone"):
            assign([0, 1], [[1.0] * 3] * 2)
        np.testing.assert_array_equal(points.aims[0], [1.0, 2.0, 3.0])
        monkeypatch.undo()
        assign([1], [[1.0] * 3])
        again = Points(["A", "B"], KeptPoints(keeper))
        np.testing.assert_array_equal(again.aims, [[1.0, 2.0, 3.0], [1.0, 1.0, 1.0]])

    def test_the_store_tells_why(self, keeper: Keeper, monkeypatch: pytest.MonkeyPatch) -> None:
        points = KeptPoints(keeper)
        break_writing(keeper, monkeypatch)
        with pytest.raises(AssignedError, match="the disk is gone"):
            points.keep({"AIM": {"A": (1.0, 2.0, 3.0)}})


def test_a_plant_at_work(
    place: str | Path,
    opened: Callable[..., Keeper],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Commands, a disk that fails, and a restart, with the controller of the plant."""
    keeper = opened(place, inline=True)

    async def before(clock: VirtualClock) -> None:
        monkeypatch.setattr(
            "support.plant_bench.JsonLines", lambda _, started: KeptAudit(keeper, clock, started)
        )
        async with running(Bench(clock, tmp_path, assigned=KeptPoints(keeper))) as bench:
            token = await bench.commanded()
            ticket = bench.plant.aim(OPERATOR, token, {"P1A": (0.1, 0.2, 16.5)})
            assert await ticket.end(20.0)
            with monkeypatch.context() as patch:
                break_writing(keeper, patch)
                with pytest.raises(RefusedError, match="the disk is gone"):
                    bench.plant.aim(OPERATOR, token, {"P1A": (9.0, 9.0, 9.0)})
                # What makes safe never waits for a disk; its record follows.
                stow = bench.plant.stow("a passer-by")
                assert await stow.reached(Stage.ACKNOWLEDGED, 5.0)
            await bench.wait(3.0)

    run_virtual(before)
    found = [(e.what, e.who, e.result.split(":")[0]) for e in reversed(entries(keeper))]
    assert found.count(("AIM", OPERATOR.name, "AIM")) == 1
    assert [f[0] for f in found].count("STOW") == 1
    assert all(result for *_, result in found)
    keeper.close()
    again = opened(place, inline=True)
    assert KeptPoints(again).read()["AIM"] == {"P1A": (0.1, 0.2, 16.5)}
