"""What a search of the bus makes of the bytes that come."""

import pytest

from heliotrope.cluster._discovery import Here, heard
from heliotrope.lcu import messages, wire

ONE, TWO = Here(5001, 3, 7), Here(5002, 3, 8)


def answer(here: Here, sequence: int = 9, name: str = "HERE") -> bytes:
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
