"""The share of bad frames on a bus, which the safety table acts on."""

from typing import Any

import pytest

from heliotrope.cluster._exchange import Exchange
from heliotrope.links.clock import VirtualClock, run_virtual


class Bus:
    """A bus of which only the port is used."""

    connected = True


def test_the_share_of_bad_frames_is_that_of_the_last_ten_seconds_with_questions() -> None:
    async def main(clock: VirtualClock) -> None:
        bus: Any = Bus()
        exchange = Exchange(bus, clock, 0.05, 0.1)

        def second(asked: int, bad: int, answered: int) -> float:
            exchange._asked, exchange._bad, exchange._answered = asked, bad, answered
            return exchange.second()

        assert exchange.second() == 0.0, "nothing has been asked"
        assert second(0, 0, 0) == 0.0
        assert second(4, 1, 3) == pytest.approx(1 / 4)
        assert second(4, 3, 1) == pytest.approx(4 / 8)
        assert second(0, 0, 0) == pytest.approx(4 / 8), "a second without questions says nothing"
        for _ in range(9):
            found = second(4, 0, 4)
        assert found == pytest.approx(3 / 40), "the first second is forgotten, the next is not"
        assert second(4, 0, 4) == 0.0
        for _ in range(10):
            found = second(4, 0, 0)
        assert found == 1.0, "nobody answers"
        assert second(4, 0, 1) < 1.0
        bus.connected = False
        assert second(4, 0, 4) == 1.0
        bus.connected = True
        assert second(0, 0, 0) == 0.0, "what was before the port was lost is forgotten"

    run_virtual(main)
