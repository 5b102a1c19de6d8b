"""A record of the functions that a run passes through, in order."""

import sys
from collections.abc import Iterable, Sequence
from types import CodeType, FrameType


class Recorder:
    """Records the calls of some functions in the threads that start it.

    Parameters
    ----------
    wanted
        Functions as ``module.qualified.name`` without the leading ``heliotrope.``.

    Attributes
    ----------
    calls
        Names of the functions called, in order.
    """

    def __init__(self, wanted: Iterable[str]) -> None:
        self._wanted = frozenset(wanted)
        self._names: dict[CodeType, str] = {}
        self.calls: list[str] = []

    def _name(self, frame: FrameType) -> str:
        """Return the name of the function if it is wanted, else ""."""
        code = frame.f_code
        if code not in self._names:
            module = str(frame.f_globals.get("__name__", ""))
            name = f"{module}.{code.co_qualname}".removeprefix("heliotrope.")
            self._names[code] = name if name in self._wanted else ""
        return self._names[code]

    def _called(self, frame: FrameType, event: str, _: object) -> None:
        if event == "call" and (name := self._name(frame)):
            self.calls.append(name)

    def start(self) -> None:
        """Begin to record this thread."""
        sys.setprofile(self._called)

    @staticmethod
    def stop() -> None:
        """End recording this thread."""
        sys.setprofile(None)


def unreached(stays: Sequence[str], calls: Iterable[str]) -> list[str]:
    """Return the stays that ``calls`` did not reach, each after the one before it."""
    left = list(stays)
    for name in calls:
        if left and name == left[0]:
            left.pop(0)
    return left
