"""Plant, clusters and local controllers together: power-on to tracking to calibration to stow."""

from pathlib import Path

import pytest

from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Stage
from heliotrope.mechanism.board_items import checksums, items_of
from heliotrope.plant.orders.audit import read
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.visits import CalibrationCycle, CycleSettings
from heliotrope.safety import Act
from support.whole_plant import ENGINEER, MACHINE, WholePlant


@pytest.mark.parametrize(
    "seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3, 4))]
)
def test_from_power_on_to_tracking_to_calibration_to_stow(tmp_path: Path, seed: int) -> None:
    made: list[WholePlant] = []

    async def main(clock: VirtualClock) -> None:
        whole = WholePlant(clock, tmp_path, seed=seed)
        made.append(whole)
        async with whole.alive():
            await scene(whole)

    async def scene(whole: WholePlant) -> None:
        plant, token = whole.plant, whole.token
        assert whole.all_are("STOWED")
        assert plant.wanted.missing == {}
        # To tracking.
        assert await plant.aim(ENGINEER, token, plant.default_aims()).end(20.0)
        approach = plant.command(ENGINEER, token, "APPROACH")
        assert await approach.reached(Stage.ACKNOWLEDGED, 10.0)
        assert await approach.end(400.0), approach.text
        assert whole.all_are("IDLE")
        assert whole.flux() == 0.0
        assert await plant.command(ENGINEER, token, "TRACK").end(30.0)
        await whole.wait(20.0)
        assert whole.all_are("TRACKING")
        assert whole.flux() == 1.0
        before = {name: whole.miss(name) for name in whole.boards}
        # To calibration: the one that misses most.
        worst = max(before, key=before.__getitem__)
        cycle = CalibrationCycle(plant, whole, CycleSettings(interval=5.0))
        result = await cycle.run(ENGINEER, token, worst, "white")
        assert result.text.startswith("calibrated: beam error"), result.text
        assert result.new == 4  # the one that has confirmed them is learnt from, too
        assert result.record is not None
        assert result.after < 0.3e-3 < 2e-3 < result.before
        assert set(result.record.pushed) >= {"armature", "biases"}
        new = items_of(plant.beliefs.present(worst)[0], MACHINE)
        stored = await plant.stored(worst)
        assert {n: stored[n] for n in new} == checksums(new)
        await whole.wait(20.0)
        assert whole.all_are("TRACKING")
        assert whole.miss(worst) < 0.1 * before[worst]
        for name in whole.boards:
            assert name == worst or abs(whole.miss(name) - before[name]) < 0.1
        # To stow.
        order = plant.raise_emergency("anybody")
        await whole.until(lambda: order.report(plant.now()).complete, 30.0)
        assert whole.flux() == 0.0
        assert order.report(plant.now()).late == ()
        await whole.until(lambda: whole.all_are("STOWED"), 300.0)
        assert plant.sentinel.order is not order
        last = plant.sentinel.order
        assert last is not None
        assert last.act is Act.STOW
        await whole.until(lambda: last.report(plant.now()).complete, 10.0)

    run_virtual(main, seed)
    records, torn = read(made[0].audit.path)
    assert torn == 0
    assert all(record.result for record in records)
    assert [r.what for r in records][:4] == ["AUTHORITY", "AIM", "APPROACH", "TRACK"]
    assert {"PARAMETERS", "DEFOCUS", "STOW"} <= {r.what for r in records}


def test_real_boards_that_a_visit_has_locked_prove_their_stow_and_are_unlocked_there(
    tmp_path: Path,
) -> None:
    async def main(clock: VirtualClock) -> None:
        whole = WholePlant(clock, tmp_path, clusters=1)
        async with whole.alive():
            plant, token, names = whole.plant, whole.token, tuple(whole.boards)
            approach = plant.command(ENGINEER, token, "APPROACH")
            assert await approach.end(400.0), approach.text
            with plant.authority.mandate(ENGINEER, token, names, "white") as mandate:
                lock = plant.command(ENGINEER, mandate.token, "LOCK", names)
                assert await lock.end(10.0), lock.text
                order = plant.raise_emergency("anybody", Act.STOW)
                with pytest.raises(RefusedError):
                    plant.command(ENGINEER, mandate.token, "UNLOCK", names)
            await whole.wait(1.0)
            assert not order.report(plant.now()).complete, "they are still on the way"
            await whole.until(lambda: order.report(plant.now()).complete, 300.0)
            assert whole.all_are("LOCKED"), "nothing is unlocked in an emergency"
            assert order.ticket.good, order.ticket.text
            (call,) = plant.sentinel.calls
            plant.withdraw_emergency(ENGINEER, call.who)
            await whole.wait(5.0)
            plant.acknowledge(ENGINEER, "operator_emergency")
            await whole.until(lambda: whole.all_are("STOWED"), 30.0)
            await whole.until(lambda: not plant.locks.names, 10.0)

    run_virtual(main)
