"""Fixtures that fail a test which leaves a task behind, or an exception that nobody looked at."""

import asyncio
import asyncio.runners
import gc
from collections.abc import Iterator
from typing import Any

import pytest


@pytest.fixture(autouse=True, scope="session")
def quick_collections() -> None:
    """Leave what was imported out of the collections after each test."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def no_leaked_tasks(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Fail a test whose event loop ends with tasks still running, or reports an exception.

    `asyncio.run` and `Runner` cancel what is left in silence; the fixture looks first. Tasks
    that are cancelled already get the turns of the loop that they need to end.
    """
    leaked: list[str] = []
    reported: list[str] = []
    ran: list[bool] = []
    cancel = asyncio.runners._cancel_all_tasks
    run_until_complete = asyncio.base_events.BaseEventLoop.run_until_complete

    def look(loop: asyncio.AbstractEventLoop) -> None:
        for _ in range(5):
            loop.run_until_complete(asyncio.sleep(0))
        leaked.extend(repr(task) for task in asyncio.all_tasks(loop))
        cancel(loop)

    def report(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        reported.append(f"{context.get('message')}: {context.get('exception')!r}")

    def run(loop: asyncio.BaseEventLoop, future: Any) -> Any:
        ran.append(True)
        loop.set_exception_handler(report)
        return run_until_complete(loop, future)

    monkeypatch.setattr(asyncio.runners, "_cancel_all_tasks", look)
    monkeypatch.setattr(asyncio.base_events.BaseEventLoop, "run_until_complete", run)
    yield
    if ran:  # no loop, no future
        gc.collect()  # futures report an exception that nobody took when they are collected
    assert not leaked, f"tasks left behind: {leaked}"
    assert not reported, f"reported to the event loop: {reported}"
