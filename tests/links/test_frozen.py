"""Simulated programs: frozen, going on, ended while frozen, and ended in the same order."""

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


def test_a_group_ends_its_tasks_in_the_same_order_wherever_they_lie_in_memory() -> None:
    """Day 31 of the simulation went another way after a restart when day 30 had run before it."""

    def ended(lying_about: int) -> list[int]:
        """Return the order in which tasks end, with this many objects beside them."""
        beside, found = [object() for _ in range(lying_about)], list[int]()
        loop = VirtualLoop(3)

        async def waits(number: int) -> None:
            try:
                await asyncio.sleep(100.0)
            finally:
                found.append(number)

        async def whole() -> None:
            async with asyncio.TaskGroup() as group:
                for number in range(12):
                    group.create_task(waits(number))

        async def main() -> None:
            task = asyncio.ensure_future(whole())
            await asyncio.sleep(1.0)
            task.cancel()
            await asyncio.wait([task])

        try:
            loop.run_until_complete(main())
        finally:
            loop.close()
        del beside
        return found

    first = ended(0)
    assert sorted(first) == list(range(12))
    assert [ended(beside) for beside in (50, 333, 1000, 12345)] == [first] * 4
