"""The queue for checks of passwords: bounded, with places for those who are known."""

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from heliotrope.console._attempts import Pair
from heliotrope.console.hashing import (
    KNOWN,
    OF_ADDRESS,
    OF_NAME,
    STRANGERS,
    CrowdError,
    GoneError,
    Hashing,
)

HOME = "192.0.2.1"


class Scene:
    """One check at a time, which lasts until `finish`; keeps the order of those that begin."""

    def __init__(self) -> None:
        self.hashing = Hashing(at_work=1)
        self.begun: list[Pair] = []
        self.gone = set[Pair]()
        self._finish = asyncio.Event()

    async def check(self, pair: Pair, *, known: bool = False) -> None:
        async def gone() -> bool:
            return pair in self.gone

        async with self.hashing.turn(pair, gone, known=known):
            self.begun.append(pair)
            await self._finish.wait()

    def finish(self) -> None:
        """Let every check end as soon as it has begun."""
        self._finish.set()


def run(work: Callable[[Scene, asyncio.TaskGroup], Awaitable[None]]) -> None:
    async def main() -> None:
        async with asyncio.timeout(20.0), asyncio.TaskGroup() as group:
            await work(Scene(), group)

    asyncio.run(main())


async def settled() -> None:
    """Let every task go as far as it can."""
    for _ in range(20):
        await asyncio.sleep(0.0)


def stranger(number: int) -> Pair:
    return f"name {number}", f"198.51.100.{number}"


def test_a_flood_is_refused_and_a_known_one_comes_first() -> None:
    async def work(scene: Scene, group: asyncio.TaskGroup) -> None:
        for number in range(STRANGERS + 1):
            group.create_task(scene.check(stranger(number)))
        await settled()
        assert scene.begun == [stranger(0)]
        with pytest.raises(CrowdError, match="too many people"):
            await scene.check(stranger(99))
        group.create_task(scene.check(("olga", HOME), known=True))
        await settled()
        scene.finish()
        await settled()
        assert scene.begun[1] == ("olga", HOME)
        assert len(scene.begun) == STRANGERS + 2

    run(work)


def test_nobody_fills_the_queue_alone() -> None:
    """Neither one address of strangers, nor one name that is known at many addresses."""

    async def work(scene: Scene, group: asyncio.TaskGroup) -> None:
        group.create_task(scene.check(stranger(0)))
        for number in range(OF_ADDRESS):
            group.create_task(scene.check((f"name {number}", HOME)))
        for number in range(OF_NAME):
            group.create_task(scene.check(("mallory", f"192.0.2.{number}"), known=True))
        await settled()
        with pytest.raises(CrowdError):
            await scene.check(("another", HOME))
        with pytest.raises(CrowdError):
            await scene.check(("mallory", "192.0.2.99"), known=True)
        for number in range(KNOWN - OF_NAME):
            group.create_task(scene.check((f"person {number}", HOME), known=True))
        await settled()
        with pytest.raises(CrowdError):
            await scene.check(("one more", HOME), known=True)
        scene.finish()

    run(work)


def test_whoever_has_left_makes_room_and_costs_no_check() -> None:
    async def work(scene: Scene, group: asyncio.TaskGroup) -> None:
        async def leaving(number: int) -> None:
            with pytest.raises(GoneError, match="has left"):
                await scene.check(stranger(number))

        group.create_task(scene.check(stranger(0)))
        await settled()
        for number in range(1, STRANGERS + 1):
            group.create_task(leaving(number))
        await settled()
        scene.gone = {stranger(number) for number in range(1, STRANGERS + 1)}
        group.create_task(scene.check(stranger(50)))
        await settled()
        scene.gone.add(stranger(51))
        group.create_task(leaving(51))
        await settled()
        scene.finish()
        await settled()
        assert scene.begun == [stranger(0), stranger(50)]

    run(work)


def test_a_cancelled_one_gives_its_turn_back() -> None:
    async def work(scene: Scene, group: asyncio.TaskGroup) -> None:
        first = group.create_task(scene.check(stranger(0)))
        second = group.create_task(scene.check(stranger(1)))
        group.create_task(scene.check(stranger(2)))
        await settled()
        second.cancel()
        first.cancel()
        await settled()
        assert scene.begun == [stranger(0), stranger(2)]
        scene.finish()
        await settled()
        await scene.check(stranger(3))

    run(work)
