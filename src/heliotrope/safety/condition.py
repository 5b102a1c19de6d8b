"""What a row of the safety table is made of."""

import math
from dataclasses import dataclass
from enum import Enum, IntEnum

from heliotrope.errors import InputError


class Act(IntEnum):
    """What is done, from weak to strong; the strongest wins."""

    ALARM = 0
    REFUSE_NEW = 1
    HOLD = 2
    DEFOCUS = 3
    STOW = 4

    @property
    def text(self) -> str:
        """What it means."""
        return _ACT_TEXTS[self]


_ACT_TEXTS = {
    Act.ALARM: "tell the operator; nothing moves or stops for it",
    Act.REFUSE_NEW: "no new motion is accepted but DEFOCUS, STOW and LOCK; what runs goes on",
    Act.HOLD: "motions stop where they are; as REFUSE_NEW besides",
    Act.DEFOCUS: "beams off the receiver now; pre-empts every motion but stowing",
    Act.STOW: "to the stow position; pre-empts everything",
}


class Scope(IntEnum):
    """What an action is done to."""

    HELIOSTAT = 0
    CLUSTER = 1
    FIELD = 2


class Severity(IntEnum):
    """How bad it is."""

    INFO = 0
    WARNING = 1
    ALARM = 2
    EMERGENCY = 3


class Role(IntEnum):
    """Who may acknowledge; a higher role may for a lower one."""

    OPERATOR = 0
    SUPERVISOR = 1


class Watcher(Enum):
    """The tier that evaluates a row."""

    PLANT = "plant"
    CLUSTER = "cluster"
    NODE = "local controller"


@dataclass(frozen=True)
class Condition:
    """A row of the table.

    Attributes
    ----------
    name
        Unique.
    watcher
        Who evaluates it.
    reading, unit, what
        Key of the reading, its unit (SI; "1" for a ratio, a share or yes/no), what it is.
    trips, releases
        The row trips at ``trips`` or beyond and may release at ``releases`` or on the safe
        side of it. ``trips`` above ``releases`` means that large values are bad.
    act, scope, severity
        What is done, to what, how bad.
    budget
        From the fault to the finished action, s.
    then_stow
        From the trip to STOW instead of ``act``, s; infinite if never.
    delay
        How long the value must be beyond ``trips``, s.
    clear_for
        How long fresh readings must be safe before release, s.
    stale_after
        Age from which a reading counts as its worst case, s; not used for ``ages``.
    ages
        The reading is an age or silence: it grows with time until the next reading.
    role
        Who must acknowledge; ``None`` if the row does not latch.
    release
        What brings it to an end, in words.
    """

    name: str
    watcher: Watcher
    reading: str
    unit: str
    what: str
    trips: float
    releases: float
    act: Act
    scope: Scope
    severity: Severity
    budget: float
    then_stow: float = math.inf
    delay: float = 0.0
    clear_for: float = 2.0
    stale_after: float = 5.0
    ages: bool = False
    role: Role | None = None
    release: str = ""

    def __post_init__(self) -> None:
        at = f"condition {self.name}"
        if not (math.isfinite(self.trips) and math.isfinite(self.releases)):
            raise InputError(
                f"{at}: trips {self.trips} and releases {self.releases} must be finite numbers"
            )
        if self.trips == self.releases:
            raise InputError(
                f"{at}: trips and releases are both {self.trips:g}; leave a hysteresis between them"
            )
        if self.ages and not 0.0 <= self.releases < self.trips:
            raise InputError(
                f"{at}: an age must trip above its release at 0 or more, not at {self.trips:g} s "
                f"with release {self.releases:g} s"
            )
        for name in ("delay", "clear_for", "stale_after", "budget"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(f"{at}: {name} {value} s must be 0 or more and finite")
        if not self.then_stow >= 0.0:
            raise InputError(f"{at}: then_stow {self.then_stow} s must be 0 or more")
        if self.detection > self.budget:
            raise InputError(
                f"{at}: it is noticed after {self.detection:g} s, later than its budget of "
                f"{self.budget:g} s; shorten delay or stale_after"
            )

    @property
    def above(self) -> bool:
        """Whether large values are bad."""
        return self.trips > self.releases

    @property
    def latched(self) -> bool:
        """Whether it stays until a person acknowledges it."""
        return self.role is not None

    @property
    def detection(self) -> float:
        """Longest time from the fault to the trip, s, the reading itself failing included."""
        return self.delay + (self.trips if self.ages else self.stale_after)

    @property
    def worst(self) -> float:
        """The value that stands for a reading that is missing."""
        return math.inf if self.above else -math.inf

    def beyond(self, value: float) -> bool:
        """Whether a value trips."""
        return value >= self.trips if self.above else value <= self.trips

    def safe(self, value: float) -> bool:
        """Whether a value may release."""
        return value <= self.releases if self.above else value >= self.releases
