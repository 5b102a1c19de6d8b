"""Settings for changes that need the approval of a second engineer."""

from dataclasses import dataclass

from heliotrope.errors import InputError

#: Shortest and longest wait for an approval, s.
_SHORTEST, _LONGEST = 60.0, 604_800.0


@dataclass(frozen=True)
class ApprovalSettings:
    """Second-approval settings of a plant.

    Attributes
    ----------
    parameters
        Whether a manual change or roll-back of a heliostat's error parameters needs the approval of
        a second engineer.
    within
        Time after which an unapproved change lapses, s.

    Raises
    ------
    InputError
        If the time is not between 60 s and 7 days.
    """

    parameters: bool = False
    within: float = 28_800.0

    def __post_init__(self) -> None:
        if not _SHORTEST <= self.within <= _LONGEST:
            raise InputError(
                f"approval: within_s must be between {_SHORTEST:g} and {_LONGEST:g} (7 days), not "
                f"{self.within:g}"
            )

    @property
    def document(self) -> dict[str, bool | float]:
        """The table of these settings in the plant file, without default values."""
        default = ApprovalSettings()
        table: dict[str, bool | float] = {}
        if self.parameters:
            table["parameters"] = True
        if self.within != default.within:
            table["within_s"] = self.within
        return table

    @property
    def numbers(self) -> dict[str, float]:
        """The settings as numbers, by key, for comparing one run with the next."""
        return {
            "approval.parameters": float(self.parameters),
            "approval.within_s": self.within,
        }
