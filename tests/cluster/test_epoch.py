"""When the numbering of frames begins anew, with a disk that answers later."""

from collections.abc import Callable
from typing import Any

from heliotrope.cluster._epoch import _OUT_OF_STEP, Epoch
from heliotrope.safety import alarms


class Parts:
    """A state file that stores when the test says so, and what was said to others."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, Callable[[int, Exception | None], None]]] = []
        self.epochs: list[int] = []
        self.said: list[Any] = []

    def start(self, at_least: int) -> int:
        return at_least or 1

    def begin(self, at_least: int, told: Callable[[int, Exception | None], None]) -> None:
        self.asked.append((at_least, told))

    def begin_epoch(self, epoch: int) -> None:
        self.epochs.append(epoch)

    def alarm(self, alarm: Any) -> None:
        self.said.append(alarm)

    def clear(self, alarm: Any) -> None:
        self.said.append(alarm)


class Present:
    usable, gps_s = False, 1_400_000_000.0


def made() -> tuple[Parts, Epoch]:
    parts, present = Parts(), Present()
    own: Any = parts
    return parts, Epoch(own, own, own, present)  # type: ignore[arg-type]


def out_of_step(epoch: Epoch, times: int = _OUT_OF_STEP) -> None:
    for k in range(times):
        epoch.duplicate(k)
    epoch.second()


def test_one_epoch_is_asked_for_at_a_time_and_used_once_it_is_stored() -> None:
    parts, epoch = made()
    assert parts.epochs == [1]
    out_of_step(epoch, _OUT_OF_STEP - 1)
    assert parts.asked == []
    out_of_step(epoch, 1)
    out_of_step(epoch)
    out_of_step(epoch)
    ((at_least, told),) = parts.asked
    assert (at_least, parts.epochs) == (0, [1])
    told(2, None)
    assert parts.epochs == [1], "only before the next SESSION"
    epoch.second()
    epoch.second()
    assert parts.epochs == [1, 2]


def test_an_epoch_that_cannot_be_stored_is_an_alarm_until_one_is() -> None:
    parts, epoch = made()
    error = OSError("disk full")
    out_of_step(epoch)
    parts.asked[0][1](0, error)
    assert parts.said == [alarms.STATE_UNWRITABLE.raised(problem=error)]
    epoch.second()
    assert parts.epochs == [1]
    out_of_step(epoch)
    assert len(parts.asked) == 2
    parts.asked[1][1](5, None)
    assert parts.said[1:] == [alarms.STATE_UNWRITABLE.ended()]
    epoch.second()
    assert parts.epochs == [1, 5]


def test_the_time_makes_one_epoch() -> None:
    parts, epoch = made()
    present: Any = Present()
    epoch.time_known(present)
    assert [at_least for at_least, _ in parts.asked] == [1_400_000_000]
    parts.asked[0][1](1_400_000_000, None)
    epoch.time_known(present)
    epoch.time_known(present)
    assert parts.epochs == [1, 1_400_000_000]
    assert len(parts.asked) == 1
