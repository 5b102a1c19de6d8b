"""What a search of the bus makes of the bytes that come."""

import asyncio
from itertools import pairwise

import pytest

from heliotrope.cluster._discovery import Discovery, HereAnswer, heard
from heliotrope.cluster._nodes import Nodes
from heliotrope.cluster.config import ClusterConfig, Member
from heliotrope.lcu import messages, wire
from support.clusters import SITE

ONE, TWO = HereAnswer(5001, 3, 7), HereAnswer(5002, 3, 8)


def answer(here: HereAnswer, sequence: int = 9, name: str = "HERE") -> bytes:
    """The frame of an answer to a question of a sequence."""
    body = wire.pack(name, here.serial, here.firmware, here.address)
    to, number = wire.CLUSTER_ADDRESS, messages.NUMBER_OF[name]
    return wire.encode(wire.Frame(to, here.address, sequence, number, body))


def test_answers_that_came_apart_are_all_read() -> None:
    assert heard(b"", 9) == ([], False)
    assert heard(answer(ONE), 9) == ([ONE], False)
    assert heard(answer(ONE) + answer(TWO), 9) == ([ONE, TWO], False)


@pytest.mark.parametrize("place", range(1, 12))
def test_an_answer_with_a_damaged_byte_is_other_bytes(place: int) -> None:
    bytes_ = bytearray(answer(ONE))
    bytes_[place] ^= 0x40
    found, others = heard(bytes(bytes_) + answer(TWO), 9)
    assert (found, others) == ([TWO], True)


def test_an_answer_that_is_cut_off_or_to_another_question_is_other_bytes() -> None:
    assert heard(answer(ONE)[:-4], 9) == ([], True)
    assert heard(answer(ONE)[:-1], 9) == ([ONE], False)
    assert heard(answer(ONE, sequence=8), 9) == ([], True)
    assert heard(answer(TWO) + answer(ONE, sequence=8), 9) == ([TWO], True)


@pytest.mark.parametrize("known", [(), (0,), (1,), (5001,), (5001, 5002), (0, 2**32 - 1)])
def test_every_serial_number_is_asked_for_once_whichever_are_known(known: tuple[int, ...]) -> None:
    asked: list[tuple[int, int]] = []

    class Quiet:
        """A bus on which nobody answers."""

        async def gather(self, name: str, low: int, high: int, *, span: float) -> tuple[bytes, int]:
            assert (name, span > 0.0) == ("DISCOVER", True)
            asked.append((low, high))
            return b"", 9

    members = [Member(f"A{n}", n, serial) for n, serial in enumerate(known, 1)]
    nodes = Nodes(ClusterConfig("C1", SITE, tuple(members or [Member("A1", 1)])))

    async def main() -> None:
        search = Discovery(nodes, Quiet())  # type: ignore[arg-type]
        while not search.done:
            await search.step()

    asyncio.run(main())
    spans = sorted(set(asked))
    assert (spans[0][0], spans[-1][1]) == (0, 2**32 - 1)
    assert all(low == high + 1 for (_, high), (low, _) in pairwise(spans))
    assert len(asked) == 2 * len(spans)
