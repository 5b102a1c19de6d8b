"""The record of the active emergency that the store preserves across a restart of the plant."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Protocol

from heliotrope.safety import Act

#: Reason of the emergency with which a plant starts if it cannot read its record.
_UNREADABLE = "the record of the last emergency cannot be read"


class EmergencyRecord(Protocol):
    """A store for one document about the active emergency."""

    def emergency(self) -> str:
        """Return the document; an empty document if none is stored."""
        ...

    def keep_emergency(self, document: str) -> None:
        """Replace the document; an empty document means that no emergency is active.

        Raises
        ------
        StoreError
            If it cannot be stored.
        """
        ...


@dataclass(frozen=True)
class Call:
    """One person's emergency order, which stays active until that person withdraws it.

    Attributes
    ----------
    who, reason
        The person or program that gave the order, and why.
    act
        "DEFOCUS" or "STOW".
    at
        When the order was given, POSIX s.
    """

    who: str
    reason: str
    act: str
    at: float

    @property
    def text(self) -> str:
        """The order in one line: person, action, time, reason."""
        since = f"{datetime.fromtimestamp(self.at, UTC):%H:%M} UTC"
        return f"{self.who} ({self.act}, {since}: {self.reason})"


@dataclass(frozen=True)
class Standing:
    """The record of an emergency for the next program of the plant.

    Attributes
    ----------
    act
        Name of the field-wide order, "DEFOCUS" or "STOW"; empty if no emergency is active.
    who, reason
        The person or part of the plant that gave the order, and why.
    calls
        The orders that have not been withdrawn, one per person.
    rows
        Rows of the safety table that keep beams off or wait for acknowledgement, each with its
        cluster or heliostat ("" for the field).
    unproven
        Heliostats not confirmed to have carried out the order.
    left_by
        Name of the order that left ``unproven`` heliostats, if no emergency is active.
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
        """The document for the store; an empty document if there is nothing to store."""
        return "" if self == Standing() else json.dumps(asdict(self))

    @property
    def giver(self) -> str:
        """The persons whose orders are active, or else whoever gave the field-wide order."""
        return ", ".join(call.who for call in self.calls) or self.who

    @property
    def continued(self) -> str:
        """The reason, in words, to record for the order that continues this emergency."""
        reason = "; ".join(call.reason for call in self.calls) or self.reason
        text = f"{reason}; it was active when the plant's program ended"
        if not self.unproven:
            return text
        more = f" and {len(self.unproven) - 8} more" if len(self.unproven) > 8 else ""
        return f"{text}, not proven for {', '.join(self.unproven[:8])}{more}"


def read_standing(document: str) -> Standing:
    """Return the contents of a document.

    If it is unreadable, a DEFOCUS ordered by a user is returned, because that is the safe choice.
    """
    if not document:
        return Standing()
    try:
        fields = json.loads(document)
        rows = tuple((str(row), str(subject)) for row, subject in fields["rows"])
        unproven = _names(fields["unproven"])
        act, who, reason = (str(fields[key]) for key in ("act", "who", "reason"))
        # A record of an older version does not name the order: assume STOW, which is harder to
        # confirm.
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
