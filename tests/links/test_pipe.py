"""A TCP connection whose frames nobody takes yet."""

import asyncio
from typing import Any

from heliotrope.links.tcp import _WAITING, _Pipe


class Transport(asyncio.Transport):
    """Counts how often reading is paused and resumed."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[str] = []

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        pass

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        return default

    def pause_reading(self) -> None:
        self.told.append("pause")

    def resume_reading(self) -> None:
        self.told.append("resume")


def test_a_connection_reads_no_more_while_frames_wait_and_goes_on_when_they_are_taken() -> None:
    async def main() -> None:
        pipe, transport = _Pipe(1000), Transport()
        pipe.connection_made(transport)
        frames = [bytes([number]) * 100 for number in range(_WAITING + 5)]
        for frame in frames[:_WAITING]:
            pipe.data_received(len(frame).to_bytes(4, "big") + frame)
        assert transport.told == []
        # What had been read by then still comes, and pauses once.
        for frame in frames[_WAITING:]:
            pipe.data_received(len(frame).to_bytes(4, "big") + frame)
        assert transport.told == ["pause"]
        assert [await pipe.read() for _ in frames] == frames
        assert transport.told == ["pause", "resume"]

    asyncio.run(main())
