"""A cluster in virtual time, with real local controllers on its bus."""

import asyncio

from clusters import Field
from heliotrope.control.clock import VirtualClock, run_virtual
from heliotrope.control.protocol import Alarm, Stage
from heliotrope.lcu import states


def test_from_power_on_to_tracking() -> None:
    async def main(clock: VirtualClock) -> None:
        async with Field(clock).alive() as field:
            await field.to_tracking()
            await asyncio.sleep(30.0)
            for name in ("A1", "A2"):
                for identity in ("aim", "approach", "track"):
                    assert field.plant.stages(identity, name) == [
                        Stage.ACCEPTED, Stage.SENT, Stage.ACKNOWLEDGED, Stage.DONE,
                    ]  # fmt: skip
            status = field.plant.status()
            rows = status.nodes()
            assert [states.STATES[state] for state in rows["state"]] == ["TRACKING", "TRACKING"]
            for row, board in zip(rows, field.boards, strict=True):
                # The sun makes some ten steps a second here.
                assert abs(int(row["primary"]) - board.timer.made[0]) < 40
                assert abs(int(row["secondary"]) - board.timer.made[1]) < 40
                assert row["heard_ms"] < 100
                assert row["armature_crc"] == board.node.controller.config.armature_crc
                assert row["asked"] == row["answered"]
            assert (status.count, status.acts, status.time_quality) == (2, (), "system")
            assert not field.plant.all(Alarm)
        # The clean end defocuses.
        assert set(field.states()) == {"DEFOCUSED"}

    run_virtual(main)
