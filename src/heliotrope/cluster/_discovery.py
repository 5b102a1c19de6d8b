"""Discovery of local controllers by serial number; ranges are halved when replies collide.

All controllers with a serial number in a range reply in randomly chosen slots. If two reply at
once, the bytes are damaged, and each half of the range is polled separately. A range is finished
after two consecutive clean polls without a new reply.
"""

from dataclasses import dataclass
from typing import Any

from heliotrope.cluster._exchange import Exchange
from heliotrope.cluster._nodes import Nodes
from heliotrope.lcu import messages, wire
from heliotrope.lcu.node import HERE_SLOT_MS, HERE_SLOTS

#: Duration of all slots and the last reply, s.
SPAN = 1e-3 * HERE_SLOTS * HERE_SLOT_MS + 0.06
_LARGEST = 0xFFFFFFFF
_HERE = messages.NUMBER_OF["HERE"]
_CLEAN = 2
#: If replies for a single serial number are still garbled after this many queries, they are taken
#: for noise.
_GARBLED = 4


@dataclass(frozen=True)
class HereAnswer:
    """The reply of a local controller to a discovery query."""

    serial: int
    firmware: int
    address: int


@dataclass
class _Range:
    low: int
    high: int
    clean: int = 0
    garbled: int = 0


def heard(data: bytes, sequence: int) -> tuple[list[HereAnswer], bool]:
    """Return the replies to a query, and whether any other bytes were received."""
    reader = wire.Reader()
    # A zero byte terminates a frame that was cut off.
    frames = reader.feed(data + b"\0")
    answers = []
    for frame in frames:
        values = frame.values()
        if frame.number == _HERE and frame.sequence == sequence and values is not None:
            answers.append(HereAnswer(*values))
    damaged = reader.crc + reader.cobs + reader.length + reader.version > 0
    return answers, damaged or len(answers) < len(frames)


class Discovery:
    """One search of the bus, which proceeds query by query.

    Parameters
    ----------
    nodes
        The configured local controllers; the search begins with their serial numbers.
    exchange
        The bus.

    Attributes
    ----------
    questions
        Number of queries so far.
    """

    def __init__(self, nodes: Nodes, exchange: Exchange) -> None:
        self._nodes, self._exchange = nodes, exchange
        self._answers: dict[int, HereAnswer] = {}
        self._garbled: list[int] = []
        serials = [node.member.serial for node in nodes if node.member.serial is not None]
        low, high = min(serials, default=0), max(serials, default=_LARGEST)
        ranges = [_Range(low, high), _Range(0, low - 1), _Range(high + 1, _LARGEST)]
        self._ranges = [span for span in reversed(ranges) if span.low <= span.high]
        self.questions = 0

    @property
    def done(self) -> bool:
        """Whether the whole range of serial numbers has been polled."""
        return not self._ranges

    async def step(self) -> None:
        """Send one query."""
        now = self._ranges[-1]
        data, sequence = await self._exchange.gather("DISCOVER", now.low, now.high, span=SPAN)
        if data is None:
            return  # something urgent interrupted it
        self.questions += 1
        answers, garbled = heard(data, sequence)
        fresh = [answer for answer in answers if self._answers.get(answer.serial) != answer]
        self._answers.update((answer.serial, answer) for answer in answers)
        if not garbled:
            now.clean = 0 if fresh else now.clean + 1
            if now.clean >= _CLEAN:
                self._ranges.pop()
        elif now.low < now.high:
            middle = (now.low + now.high) // 2
            self._ranges[-1:] = [_Range(middle + 1, now.high), _Range(now.low, middle)]
        else:
            now.garbled += 1
            if now.garbled >= _GARBLED:
                self._garbled.append(now.low)
                self._ranges.pop()

    def result(self) -> dict[str, Any]:
        """Return the controllers found, each with its name, if any, and its expected address.

        ``missing`` names configured heliostats that did not reply; ``garbled`` lists serial numbers
        whose replies were always damaged (two controllers share the number).
        """
        named = {node.member.serial: node for node in self._nodes}
        listed = [
            {
                "serial": answer.serial,
                "firmware": answer.firmware,
                "address": answer.address,
                "name": named[answer.serial].name if answer.serial in named else "",
                "expected": named[answer.serial].address if answer.serial in named else 0,
            }
            for answer in sorted(self._answers.values(), key=lambda answer: answer.serial)
        ]
        missing = [
            node.name
            for node in self._nodes
            if node.member.serial is not None and node.member.serial not in self._answers
        ]
        return {
            "found": listed,
            "missing": missing,
            "garbled": self._garbled,
            "questions": self.questions,
        }
