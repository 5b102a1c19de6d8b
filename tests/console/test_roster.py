"""The roster of valid sessions and tokens: one reading for all who ask, never too old."""

import asyncio
import hashlib
from collections.abc import Awaitable, Callable

import pytest

from heliotrope.console.roster import LONG_TRUSTED, TRUSTED, Key, Roster
from heliotrope.errors import HeliotropeError


class Store:
    """Says who is valid; counts how often it is asked. ``held``: it does not answer."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.valid = {"good": "ada"}
        self.readings: list[list[str]] = []
        self.problem: HeliotropeError | None = None
        self.held = False

    async def read(self, used: list[str]) -> dict[Key, str]:
        self.readings.append(used)
        found = {("token", digest(word)): name for word, name in self.valid.items()}
        while self.held:
            await asyncio.sleep(0.01)
        if self.problem is not None:
            raise self.problem
        return found


def digest(word: str) -> str:
    return hashlib.sha256(word.encode()).hexdigest()


def run(work: Callable[[Store, Roster[str]], Awaitable[None]]) -> None:
    async def main() -> None:
        store = Store()
        roster = Roster(store.read, lambda: store.now)
        async with asyncio.timeout(30.0), asyncio.TaskGroup() as group:
            reading = group.create_task(roster.run())
            await work(store, roster)
            reading.cancel()

    asyncio.run(main())


def test_a_known_one_costs_no_reading() -> None:
    async def work(store: Store, roster: Roster[str]) -> None:
        assert await roster.find("token", "good") == "ada"
        assert await roster.find("session", "good") is None  # a token is no session
        count = len(store.readings)
        for _ in range(50):
            assert await roster.find("token", "good") == "ada"
        assert len(store.readings) == count

    run(work)


def test_strangers_share_a_reading_and_a_new_token_is_found() -> None:
    async def work(store: Store, roster: Roster[str]) -> None:
        assert await roster.find("token", "good") == "ada"
        store.valid["new"] = "grace"
        count = len(store.readings)
        asked = [roster.find("token", f"guess {k}") for k in range(500)]
        found = await asyncio.gather(*asked, roster.find("token", "new"))
        assert set(found[:-1]) == {None}
        assert found[-1] == "grace"
        assert len(store.readings) <= count + 2

    run(work)


def test_it_is_no_older_than_allowed_and_never_older_than_a_change() -> None:
    async def work(store: Store, roster: Roster[str]) -> None:
        assert await roster.find("token", "good") == "ada"
        del store.valid["good"]
        assert await roster.find("token", "good") == "ada"
        store.now += TRUSTED + 0.1
        assert await roster.find("token", "good") is None
        # A reading that began before a change says nothing of it.
        store.valid["good"], store.held = "ada", True
        asked = asyncio.gather(roster.find("token", "good"))
        while len(store.readings) < 3:
            await asyncio.sleep(0.01)
        del store.valid["good"]
        store.now += 0.1
        roster.forget()
        store.held = False
        await asked
        assert await roster.find("token", "good") is None

    run(work)


def test_those_who_were_known_go_on_without_the_store() -> None:
    async def work(store: Store, roster: Roster[str]) -> None:
        assert await roster.find("token", "good") == "ada"
        store.problem = HeliotropeError("the server is gone")
        store.now += TRUSTED + 0.1
        assert await roster.find("token", "good") == "ada"
        with pytest.raises(HeliotropeError, match="the server is gone"):
            await roster.find("token", "new")
        # The same for a store that is silent, without a wait of its own for each request.
        store.held = True
        assert await roster.find("token", "good") == "ada"
        store.now += 2.0
        async with asyncio.timeout(0.9):
            for _ in range(20):
                assert await roster.find("token", "good") == "ada"
        # Whoever may have lost their access here is not among them.
        roster.forget()
        store.held = False
        with pytest.raises(HeliotropeError, match="the server is gone"):
            await roster.find("token", "good")

    run(work)


def test_after_an_hour_without_the_store_nobody_is_known() -> None:
    async def work(store: Store, roster: Roster[str]) -> None:
        assert await roster.find("token", "good") == "ada"
        store.problem = HeliotropeError("the server is gone")
        store.now += LONG_TRUSTED + 1.0
        with pytest.raises(HeliotropeError, match=r"cannot say who this is \(the server is gone\)"):
            await roster.find("token", "good")

    run(work)


def test_an_emergency_needs_no_store() -> None:
    async def work(store: Store, roster: Roster[str]) -> None:
        assert await roster.find("token", "good") == "ada"
        store.problem = HeliotropeError("the disk is gone")
        store.now += TRUSTED + 0.1
        roster.forget()
        assert await roster.find_for_emergency("token", "good") == "ada"
        with pytest.raises(HeliotropeError, match=r"cannot say who this is \(the disk is gone\)"):
            await roster.find_for_emergency("token", "unknown")
        store.held = True
        assert await roster.find_for_emergency("token", "good") == "ada"
        store.held = False
        store.now += LONG_TRUSTED
        with pytest.raises(HeliotropeError, match="cannot say"):
            await roster.find_for_emergency("token", "good")

    run(work)


def test_the_use_of_tokens_is_passed_on() -> None:
    async def work(store: Store, roster: Roster[str]) -> None:
        assert await roster.find("token", "good") == "ada"
        store.problem = HeliotropeError("busy")
        with pytest.raises(HeliotropeError):
            await roster.find("token", "other")
        store.problem = None
        await roster.find("token", "other")
        await roster.find("token", "other")
        assert store.readings[-2:] == [[digest("good")], []]

    run(work)
