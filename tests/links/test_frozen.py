"""Simulated programs that are frozen, go on, or are ended while they are frozen."""

import asyncio
from collections import Counter

import pytest

from heliotrope.links.clock import VirtualLoop, context_of


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_frozen_program_does_nothing_until_it_is_thawed_and_the_others_go_on(seed: int) -> None:
    loop = VirtualLoop(seed)
    done = Counter[str]()

    async def program(name: str) -> None:
        while True:
            await asyncio.sleep(1.0)
            done[name] += 1

    async def main() -> None:
        tasks = [loop.create_task(program(n), context=context_of(n)) for n in ("one", "two")]
        await asyncio.sleep(5.5)
        assert done == {"one": 5, "two": 5}
        loop.freeze("one")
        await asyncio.sleep(5.0)
        assert done == {"one": 5, "two": 10}
        loop.thaw("one")
        await asyncio.sleep(0.1)
        assert done["one"] == 6, "what was due comes at once"
        await asyncio.sleep(2.0)
        assert done["one"] == 8
        loop.freeze("one")
        await asyncio.sleep(3.0)
        tasks[0].cancel()
        loop.kill("one")
        await asyncio.sleep(3.0)
        assert done["one"] == 8
        assert tasks[0].cancelled()
        tasks[1].cancel()

    try:
        loop.run_until_complete(main())
    finally:
        loop.close()
