"""The emergency that stands, as the store keeps it across a restart of the plant's program."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Protocol

from heliotrope.safety import Act

#: Reason of the emergency in which a plant begins that cannot read its record.
_UNREADABLE = "the record of the last emergency cannot be read"


class EmergencyRecord(Protocol):
    """A store of one document about the emergency that stands."""

    def emergency(self) -> str:
        """Return the document, empty without one."""
        ...

    def keep_emergency(self, document: str) -> None:
        """Replace the document; an empty one says that no emergency stands.

        Raises
        ------
        StoreError
            If it cannot be kept.
        """
        ...


@dataclass(frozen=True)
class Call:
    """One person's emergency order, which stands until that person withdraws it.

    Attributes
    ----------
    who, reason
        The person or program that gave it, and why.
    act
        "DEFOCUS" or "STOW".
    at
        POSIX s.
    """

    who: str
    reason: str
    act: str
    at: float

    @property
    def text(self) -> str:
        """One line: person, act, time, reason."""
        since = f"{datetime.fromtimestamp(self.at, UTC):%H:%M} UTC"
        return f"{self.who} ({self.act}, {since}: {self.reason})"


@dataclass(frozen=True)
class Standing:
    """The record of an emergency for the next program of the plant.

    Attributes
    ----------
    act
        Name of the order to the whole field, "DEFOCUS" or "STOW"; "" where no emergency holds.
    who, reason
        The person or part of the plant that gave it, and why.
    calls
        The orders of persons that have not been withdrawn, one for each person.
    rows
        Rows of the safety table that hold beams off or wait to be acknowledged, each with its
        cluster or heliostat, "" for the field.
    unproven
        Heliostats that the proof did not show to be done.
    left_by
        Name of the order of which ``unproven`` heliostats are left, where no emergency holds.
    """

    act: str = ""
    who: str = ""
    reason: str = ""
    calls: tuple[Call, ...] = ()
    rows: tuple[tuple[str, str], ...] = ()
    unproven: tuple[str, ...] = ()
    left_by: str = ""

    @property
    def document(self) -> str:
        """The document that the store keeps, empty if nothing stands."""
        return "" if self == Standing() else json.dumps(asdict(self))

    @property
    def giver(self) -> str:
        """The persons whose orders stand; where none does, whoever gave the order to the field."""
        return ", ".join(call.who for call in self.calls) or self.who

    @property
    def continued(self) -> str:
        """The reason, in words, of the order that continues this emergency."""
        reason = "; ".join(call.reason for call in self.calls) or self.reason
        text = f"{reason}; it held when the plant's program ended"
        if not self.unproven:
            return text
        more = f" and {len(self.unproven) - 8} more" if len(self.unproven) > 8 else ""
        return f"{text}, not proven for {', '.join(self.unproven[:8])}{more}"


def read_standing(document: str) -> Standing:
    """Return the contents of a document; a person's DEFOCUS, the safe side, if it is unreadable."""
    if not document:
        return Standing()
    try:
        fields = json.loads(document)
        rows = tuple((str(row), str(subject)) for row, subject in fields["rows"])
        unproven = _names(fields["unproven"])
        act, who, reason = (str(fields[key]) for key in ("act", "who", "reason"))
        # A record of an older edition does not say which order: STOW is harder to prove.
        left_by = str(fields.get("left_by", "STOW" if unproven and not act else ""))
        for name in filter(None, (act, left_by)):
            if Act[name] not in (Act.DEFOCUS, Act.STOW):
                raise ValueError(name)
        calls = tuple(
            Call(str(c["who"]), str(c["reason"]), str(c["act"]), float(c["at"]))
            for c in fields["calls"]
        )
        return Standing(act, who, reason, calls, rows, unproven, left_by)
    except (ValueError, KeyError, TypeError):
        call = Call("plant", _UNREADABLE, "DEFOCUS", 0.0)
        return Standing(call.act, call.who, call.reason, (call,))


def _names(names: Sequence[object]) -> tuple[str, ...]:
    return tuple(str(name) for name in names)
