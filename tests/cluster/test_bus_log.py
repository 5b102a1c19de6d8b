"""Frames of the bus on demand: decoded, bounded, and without a cost to what keeps the field up."""

import asyncio
import struct

import pytest

from heliotrope.cluster import _bus_log
from heliotrope.lcu import states, wire
from heliotrope.links.messages import BUS_ENTRY, Answer, Ask
from heliotrope.plant.operations.bus_frames import decoded
from support.clusters import Field, run


async def _recorded(field: Field, identity: str, limit: float = 10.0) -> Answer:
    await field.plant.send(Ask(identity, "frames"))
    await field.until(lambda: any(a.identity == identity for a in field.plant.all(Answer)), limit)
    (answer,) = (a for a in field.plant.all(Answer) if a.identity == identity)
    return answer


def test_five_seconds_of_the_bus_are_recorded_and_decoded() -> None:
    async def main(field: Field) -> None:
        before = field.clock.utc().timestamp()
        frames = decoded(await _recorded(field, "f-1"))
        polls = [f for f in frames if (f.way, f.kind, f.whom) == ("sent", "QUERY_STATUS", "A2")]
        answers = [f for f in frames if (f.way, f.kind, f.whom) == ("received", "STATUS", "A2")]
        suns = [f for f in frames if (f.kind, f.whom) == ("SUN", "all")]
        assert len(polls) == len(answers) == 5
        assert 4 <= len(suns) <= 6
        assert [f.sequence for f in polls] == [f.sequence for f in answers]
        assert all(a.at > p.at for p, a in zip(polls, answers, strict=True))
        assert before <= frames[0].at <= frames[-1].at <= before + 7.0
        assert all(f"state={states.STATES.index('TRACKING')} " in f.text for f in answers)
        # The field goes on as if nobody looked, and nothing more is kept.
        assert field.states() == ["TRACKING", "TRACKING"]
        await asyncio.sleep(10.0)
        assert len(field.plant.all(Answer)) == 1

    run(main, "TRACKING")


def test_one_record_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    async def main(field: Field) -> None:
        await field.plant.send(Ask("f-1", "frames"))
        second = await _recorded(field, "f-2")
        assert second.data["error"].startswith("another user is recording it")
        await field.until(lambda: len(field.plant.all(Answer)) == 2)
        assert decoded(field.plant.all(Answer)[1])

    run(main, "TRACKING")


@pytest.mark.parametrize(("name", "most"), [("MOST", 12), ("LARGEST", 300)])
def test_a_record_ends_when_it_is_full(
    monkeypatch: pytest.MonkeyPatch, name: str, most: int
) -> None:
    monkeypatch.setattr(_bus_log, name, most)

    async def main(field: Field) -> None:
        began = field.clock.monotonic()
        answer = await _recorded(field, "f-1")
        assert field.clock.monotonic() - began < 4.0
        assert "are full" in answer.data["over"]
        frames = decoded(answer)
        assert 0 < len(frames) <= 12
        assert len(answer.block) <= 300 if name == "LARGEST" else len(frames) == most

    run(main, "TRACKING")


def test_damaged_bytes_are_shown_as_they_are() -> None:
    good = wire.encode(wire.Frame(0, 7, 3, 0x02, wire.pack("STEPS", 1, -2, 3, 4)))
    bad = bytes([good[0], good[1] ^ 0x40, *good[2:]])
    data = {"utc_s": 100.0, "names": {"7": "A7"}}
    both = good + bad
    block = struct.pack(BUS_ENTRY, 1.5, 1, len(both)) + both
    first, second = decoded(Answer("f", data, block))
    assert (first.at, first.whom, first.kind) == (101.5, "A7", "STEPS")
    assert first.text == "primary=1 secondary=-2 primary_goal=3 secondary_goal=4"
    assert (second.kind, second.whom, second.text) == ("damaged", "", bad[:-1].hex())
    with pytest.raises(ValueError, match="cut off"):
        decoded(Answer("f", data, block[:-1]))
