"""Parts that run for the time of a block are closed together."""

import asyncio

from heliotrope.links.link import running


class _Part:
    """A part that ends when all have been asked to."""

    def __init__(self, asked: asyncio.Barrier) -> None:
        self._asked, self._closing = asked, asyncio.Event()

    async def run(self) -> None:
        await self._closing.wait()

    async def close(self) -> None:
        await self._asked.wait()
        self._closing.set()


def test_none_waits_for_the_end_of_another() -> None:
    async def main() -> None:
        asked = asyncio.Barrier(3)
        async with asyncio.timeout(10.0), running(*(_Part(asked) for _ in range(3))):
            pass

    asyncio.run(main())
