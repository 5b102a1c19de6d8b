"""An emergency outlives the plant's program: the next one begins in it."""

import contextlib
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path

import pytest

from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Emergency
from heliotrope.plant.emergency import UNPROVEN, Call, Standing, read_standing
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.settings import PlantSettings
from heliotrope.safety import Act
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import StoreError
from support.plant_bench import ENGINEER, OPERATOR, Bench, running

FLUX = PlantSettings(sensors=frozenset({"receiver_flux"}))
Play = Callable[[Bench], Awaitable[None]]


class Record:
    """A store in memory, which may fail."""

    def __init__(self, document: str = "") -> None:
        self.document, self.fails, self.kept = document, False, 0

    def emergency(self) -> str:
        if self.fails:
            raise StoreError("store: the disk fails")
        return self.document

    def keep_emergency(self, document: str) -> None:
        if self.fails:
            raise StoreError("store: the disk fails")
        self.document, self.kept = document, self.kept + 1


def programs(
    folder: Path,
    *scenes: Play,
    record: object,
    settings: PlantSettings = FLUX,
    deaf: tuple[str, ...] = (),
    polled_ms: int = 0,
) -> None:
    """Run one program of a plant after the other; the field is tracking when each begins."""
    for number, scene in enumerate(scenes):
        place = folder / str(number)
        place.mkdir()

        async def main(clock: VirtualClock, place: Path = place, scene: Play = scene) -> None:
            bench = Bench(clock, place, record=record, settings=settings)
            for cluster in bench.clusters.values():
                cluster.set(states.TRACKING)
                cluster.polled_ms = polled_ms
                cluster.deaf.update(deaf)
            async with running(bench):
                await scene(bench)

        run_virtual(main, 0)


def test_a_plant_begins_in_the_emergency_that_held_when_its_program_ended(tmp_path: Path) -> None:
    async def before(bench: Bench) -> None:
        bench.cluster_of("P3B").deaf.add("P3B")
        bench.plant.raise_emergency("Olga", reason="a person on the tower")
        await bench.wait(5.0)

    async def after(bench: Bench) -> None:
        plant = bench.plant
        assert plant.sentinel.on
        assert plant.sentinel.order is not None
        assert plant.sentinel.order.who == "Olga"
        assert plant.sentinel.order.reason == (
            "a person on the tower; it was active when the plant's program ended, not proven for "
            "P3B"
        )
        assert bench.count(states.DEFOCUSED) == 18
        assert {m.name for m in bench.clusters["pod-1"].of(Emergency)} == {"DEFOCUS"}
        assert "operator_emergency" in {alarm.condition for alarm in plant.alarms}
        token = plant.take_authority(OPERATOR).token
        with pytest.raises(RefusedError, match="an emergency is active"):
            plant.command(OPERATOR, token, "TRACK", ("P2A",))
        # Nobody has withdrawn it, so the row cannot be acknowledged.
        with pytest.raises(RefusedError, match="the cause is not gone"):
            plant.acknowledge(OPERATOR, "operator_emergency")
        plant.withdraw_emergency(OPERATOR)
        await bench.wait(3.0)
        plant.acknowledge(OPERATOR, "operator_emergency")
        # So does the row about the heliostat that did not answer the first program.
        plant.acknowledge(OPERATOR, "nodes_unacknowledged")
        await bench.wait(1.0)
        assert not plant.sentinel.on

    async def last(bench: Bench) -> None:
        assert not bench.plant.sentinel.on
        assert bench.count(states.TRACKING) == 18

    keeper = Keeper(tmp_path / "records.sqlite", inline=True)
    with contextlib.closing(keeper):
        programs(tmp_path, before, after, last, record=keeper, settings=PlantSettings())
        assert keeper.emergency() == ""


def test_a_plant_that_begins_in_an_emergency_names_the_orders_that_stand(tmp_path: Path) -> None:
    async def before(bench: Bench) -> None:
        bench.plant.raise_emergency("Otto", reason="smoke at the tower")
        bench.plant.raise_emergency("Olga", reason="a person at the receiver")
        await bench.wait(35.0)
        bench.plant.withdraw_emergency(ENGINEER, "Otto")
        await bench.wait(1.0)

    async def after(bench: Bench) -> None:
        plant, order = bench.plant, bench.plant.sentinel.order
        assert order is not None
        text = "a person at the receiver; it was active when the plant's program ended"
        assert (order.act, order.who, order.reason) == (Act.STOW, "Olga", text)
        token = plant.take_authority(OPERATOR).token
        with pytest.raises(RefusedError, match=r"\(STOW; Olga: a person at the receiver\)"):
            plant.command(OPERATOR, token, "TRACK", ("P2A",))

    programs(tmp_path, before, after, record=Record(), settings=PlantSettings())


def test_a_row_that_waits_for_an_acknowledgement_outlives_the_program(tmp_path: Path) -> None:
    record = Record()

    async def feed(bench: Bench, flux: float, seconds: int) -> None:
        for _ in range(seconds):
            bench.plant.put("receiver_flux", flux)
            await bench.wait(1.0)

    async def before(bench: Bench) -> None:
        await feed(bench, 1.3, 4)
        assert bench.plant.sentinel.on

    async def after(bench: Bench) -> None:
        plant = bench.plant
        assert plant.sentinel.on
        (alarm,) = [a for a in plant.alarms if a.condition == "receiver_flux_high"]
        assert "tripped when the plant's program ended" in alarm.text
        assert "has not been read since" in alarm.text
        await feed(bench, 0.2, 15)
        assert plant.sentinel.on
        plant.acknowledge(OPERATOR, "receiver_flux_high")
        await feed(bench, 0.2, 2)
        assert not plant.sentinel.on

    programs(tmp_path, before, after, record=record)
    assert record.document == ""


def test_a_withdrawn_order_stays_withdrawn_and_its_row_waits(tmp_path: Path) -> None:
    record = Record()

    async def before(bench: Bench) -> None:
        bench.plant.raise_emergency("Olga", Act.STOW, "smoke")
        await bench.wait(2.0)
        bench.plant.withdraw_emergency(OPERATOR)

    async def after(bench: Bench) -> None:
        assert bench.plant.sentinel.order is not None
        assert bench.plant.sentinel.order.act is Act.STOW
        assert bench.plant.sentinel.on
        bench.plant.acknowledge(OPERATOR, "operator_emergency")
        await bench.wait(1.0)
        assert not bench.plant.sentinel.on

    programs(tmp_path, before, after, record=record)


def test_the_store_is_written_when_something_changes_and_again_after_it_failed(
    tmp_path: Path,
) -> None:
    record = Record()

    async def scene(bench: Bench) -> None:
        assert record.kept == 0
        record.fails = True
        bench.plant.raise_emergency("Olga")
        await bench.wait(2.0)
        assert record.document == ""
        record.fails = False
        await bench.wait(2.0)
        standing = read_standing(record.document)
        assert (standing.act, standing.who) == ("DEFOCUS", "Olga")
        assert [(call.who, call.reason) for call in standing.calls] == [
            ("Olga", "emergency order of Olga")
        ]
        assert standing.unproven == ()
        kept = record.kept
        await bench.wait(5.0)
        assert record.kept == kept

    programs(tmp_path, scene, record=record)


@pytest.mark.parametrize(
    "document", ["nonsense", "[]", '{"act": "HOLD"}', "fails", '{"rows": [["x"]]}']
)
def test_a_record_that_cannot_be_read_begins_an_emergency(document: str, tmp_path: Path) -> None:
    record = Record(document)
    record.fails = document == "fails"

    async def scene(bench: Bench) -> None:
        assert bench.plant.sentinel.on
        assert bench.plant.sentinel.order is not None
        assert (
            "the record of the last emergency cannot be read" in bench.plant.sentinel.order.reason
        )
        record.fails = False

    programs(tmp_path, scene, record=record)


def test_rows_of_heliostats_that_the_plant_no_longer_has_are_forgotten(tmp_path: Path) -> None:
    rows = (("pointing_disagrees", "GONE"), ("pointing_disagrees", "P1A"), ("no_such_row", ""))
    record = Record(Standing(rows=rows).document)

    async def scene(bench: Bench) -> None:
        await bench.wait(1.0)
        assert "P1A" in {alarm.subject for alarm in bench.plant.alarms}
        assert "GONE" not in {alarm.subject for alarm in bench.plant.alarms}
        bench.plant.acknowledge(ENGINEER, "pointing_disagrees", "P1A")

    programs(tmp_path, scene, record=record)


@pytest.mark.parametrize("left_by", ["DEFOCUS", "STOW"])
def test_what_an_earlier_program_left_unproven_is_proven_by_reports(
    left_by: str, tmp_path: Path
) -> None:
    record = Record(
        Standing(
            rows=((UNPROVEN, "P1A"), (UNPROVEN, "P1B")), unproven=("P1A", "P1B"), left_by=left_by
        ).document
    )

    async def scene(bench: Bench) -> None:
        plant, cluster = bench.plant, bench.cluster_of("P1A")
        await bench.wait(15.0)
        assert read_standing(record.document).left_by == left_by
        # P1A carries out the order that it did not prove, P1B the weaker one of the two.
        cluster.set(states.STOWED, "P1A")
        cluster.set(states.DEFOCUSED, "P1B")
        await bench.wait(40.0)
        left = {a.subject for a in plant.alarms if a.condition == UNPROVEN and a.active}
        over = {a.subject for a in plant.alarms if a.condition == UNPROVEN and not a.active}
        assert left == {"P1A", "P1B"}
        assert over == ({"P1A", "P1B"} if left_by == "DEFOCUS" else {"P1A"})
        assert plant.sentinel.order is None
        expected = () if left_by == "DEFOCUS" else ("P1B",)
        assert read_standing(record.document).unproven == expected

    programs(tmp_path, scene, record=record, settings=PlantSettings(), deaf=("P1A", "P1B"))


def test_reports_from_before_the_program_began_prove_nothing(tmp_path: Path) -> None:
    record = Record(
        Standing(rows=((UNPROVEN, "P1A"),), unproven=("P1A",), left_by="DEFOCUS").document
    )

    async def scene(bench: Bench) -> None:
        cluster = bench.cluster_of("P1A")
        cluster.set(states.STOWED, "P1A")
        await bench.wait(40.0)
        assert read_standing(record.document).unproven == ("P1A",)
        cluster.polled_ms = 0
        await bench.wait(40.0)
        assert record.document == ""

    programs(
        tmp_path, scene, record=record, settings=PlantSettings(), deaf=("P1A",), polled_ms=60_000
    )


CALLS = (Call("Olga", "smoke", "STOW", 12.0), Call("Vera", "a person on the tower", "DEFOCUS", 9.5))


def test_a_standing_emergency_reads_as_it_was_kept() -> None:
    standing = Standing("STOW", "Olga", "smoke", CALLS, (("a", ""), ("b", "P1A")), ("P1A", "P2A"))
    assert read_standing(standing.document) == standing
    assert read_standing("") == Standing()
    left = Standing(unproven=("P1A",), left_by="DEFOCUS")
    assert read_standing(left.document) == left
    # Records of an edition that did not keep which order: the one that is harder to prove.
    older = left.document.replace(', "left_by": "DEFOCUS"', "")
    assert read_standing(older) == replace(left, left_by="STOW")
    many = Standing("STOW", "Olga", "smoke", unproven=tuple(f"H{i}" for i in range(10)))
    assert many.continued.endswith("not proven for H0, H1, H2, H3, H4, H5, H6, H7 and 2 more")
