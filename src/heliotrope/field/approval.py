"""Which changes by a person need the approval of a second one."""

from dataclasses import dataclass

from heliotrope.errors import InputError

#: Shortest and longest wait for an approval, s.
_SHORTEST, _LONGEST = 60.0, 604_800.0


@dataclass(frozen=True)
class ApprovalSettings:
    """Second approvals of a plant.

    Attributes
    ----------
    parameters
        Whether a change of a heliostat's error parameters by a person, or their roll-back, needs
        the approval of a second engineer.
    within
        Time after which a change that nobody has approved ends by itself, s.

    Raises
    ------
    InputError
        A time that is not from 60 s to 7 days.
    """

    parameters: bool = False
    within: float = 28_800.0

    def __post_init__(self) -> None:
        if not _SHORTEST <= self.within <= _LONGEST:
            raise InputError(
                f"approval: within_s {self.within:g}; give {_SHORTEST:g} to {_LONGEST:g} (7 days)"
            )

    @property
    def document(self) -> dict[str, bool | float]:
        """Its table in the plant file: what differs from the default."""
        default = ApprovalSettings()
        table: dict[str, bool | float] = {}
        if self.parameters:
            table["parameters"] = True
        if self.within != default.within:
            table["within_s"] = self.within
        return table

    @property
    def numbers(self) -> dict[str, float]:
        """Its settings as numbers, by key, to compare one run with the next."""
        return {
            "approval.parameters": float(self.parameters),
            "approval.within_s": self.within,
        }
