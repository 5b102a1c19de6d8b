"""The components of a row of the safety table."""

import math
from dataclasses import dataclass
from enum import Enum, IntEnum, StrEnum

from heliotrope.errors import InputError

#: A time of at least this value represents an unknown time, s.
UNKNOWN_TIME = 1e8


class Act(IntEnum):
    """The safety actions in ascending order; the strongest takes precedence."""

    ALARM = 0
    REFUSE_NEW = 1
    HOLD = 2
    DEFOCUS = 3
    STOW = 4

    @property
    def text(self) -> str:
        """The action in words."""
        return _ACT_TEXTS[self]


_ACT_TEXTS = {
    Act.ALARM: "the operator is alerted; no motion starts or stops",
    Act.REFUSE_NEW: "new motions are refused, except DEFOCUS, STOW and LOCK; running motions "
    "continue",
    Act.HOLD: "heliostats stop where they are, and new motions are refused as by REFUSE_NEW",
    Act.DEFOCUS: "beams leave the receiver now; pre-empts every motion except stowing",
    Act.STOW: "heliostats go to the stow position; pre-empts everything",
}


class Scope(IntEnum):
    """The part of the plant to which an action applies."""

    HELIOSTAT = 0
    CLUSTER = 1
    FIELD = 2


class Severity(StrEnum):
    """Severity of an alarm or event; messages, the store and the page use the same word."""

    INFO = "info"
    WARNING = "warning"
    ALARM = "alarm"
    EMERGENCY = "emergency"

    @property
    def rank(self) -> int:
        """Rank of the severity, from 0 for the least severe."""
        return tuple(Severity).index(self)

    @classmethod
    def read(cls, word: str) -> "Severity":
        """Return the severity that another program specified.

        Upper case is accepted. An unknown word counts as `ALARM`, so that no alarm is lost because
        of its severity.
        """
        return next((severity for severity in cls if severity == word.lower()), cls.ALARM)


class AcknowledgeRole(IntEnum):
    """Role required to acknowledge an alarm; higher roles may acknowledge too.

    On the console, the engineer acts as supervisor and is displayed with that title.
    """

    OPERATOR = 0
    SUPERVISOR = 1

    @property
    def title(self) -> str:
        """The role as the control room calls it."""
        return "operator" if self is AcknowledgeRole.OPERATOR else "engineer"


class Watcher(Enum):
    """The control tier that evaluates a row, or raises an alarm."""

    PLANT = "plant"
    CLUSTER = "cluster"
    NODE = "local controller"


@dataclass(frozen=True)
class Reading:
    """A value in the unit of its row, and the monotonic time of the measurement, s."""

    value: float
    at: float


@dataclass(frozen=True)
class Condition:
    """A row of the table.

    Attributes
    ----------
    name
        Unique name.
    watcher
        Control tier that evaluates the row.
    reading, unit
        Key of the reading, and unit of the reading: "s", "m/s", "rad", "°C", "share" (1 is 100 %),
        "count" or "yes/no" (1 is yes).
    what, wrong
        The reading as a noun, and what is wrong when the row trips, with ``{value}`` for the
        reading.
    trips, releases
        The row trips at ``trips`` or beyond, and may release at ``releases`` or on its safe side.
        If ``trips`` is above ``releases``, high values are unsafe.
    act, scope, severity
        The action, the part of the plant to which it applies, and the severity.
    budget
        Maximum time from the fault to the completed action, s.
    then_stow
        Time from the trip until STOW replaces ``act``, s; infinite for never.
    or_stow
        Whether the plant may order STOW at once if DEFOCUS would not move the beam away.
    delay
        Time for which the value must be beyond ``trips``, s.
    clear_for
        Time for which fresh readings must be safe before the row releases, s.
    stale_after
        Age above which a reading is replaced by the worst case, s; not used if ``ages`` is true.
    ages
        Whether the reading is an age or the duration of a silence, which increases until the next
        reading.
    role
        Role required to acknowledge; None if the row does not latch.
    waiver
        Role that may release a non-latching row whose cause persists; None if nobody may.
    release
        Condition for the release of the row, in words.
    remedy
        What the operator should do, in one sentence.
    site
        Lowest and highest ``trips`` that a plant may set, in the unit of the reading; None if the
        plant file may not change any limit of the row. See `limits`.
    """

    name: str
    watcher: Watcher
    reading: str
    unit: str
    what: str
    wrong: str
    trips: float
    releases: float
    act: Act
    scope: Scope
    severity: Severity
    budget: float
    then_stow: float = math.inf
    or_stow: bool = False
    delay: float = 0.0
    clear_for: float = 2.0
    stale_after: float = 5.0
    ages: bool = False
    role: AcknowledgeRole | None = None
    waiver: AcknowledgeRole | None = None
    release: str = ""
    remedy: str = ""
    site: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        at = f"condition {self.name}"
        if not (math.isfinite(self.trips) and math.isfinite(self.releases)):
            raise InputError(
                f"{at}: trips and releases must be finite numbers, not {self.trips} and "
                f"{self.releases}"
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
                raise InputError(f"{at}: {name} must be 0 or more and finite, not {value} s")
        if not self.then_stow >= 0.0:
            raise InputError(f"{at}: then_stow must be 0 or more, not {self.then_stow} s")
        if self.detection > self.budget:
            raise InputError(
                f"{at}: the condition is noticed after {self.detection:g} s, later than its budget "
                f"of {self.budget:g} s; shorten delay or stale_after"
            )

    @property
    def above(self) -> bool:
        """Whether high values are unsafe."""
        return self.trips > self.releases

    @property
    def latched(self) -> bool:
        """Whether the row stays tripped until it is acknowledged."""
        return self.role is not None

    @property
    def detection(self) -> float:
        """Maximum time from the fault to the trip, s, even if the reading itself is lost."""
        return self.delay + (self.trips if self.ages else self.stale_after)

    @property
    def worst(self) -> float:
        """The value that replaces a missing reading."""
        return math.inf if self.above else -math.inf

    def beyond(self, value: float) -> bool:
        """Whether a value trips the row."""
        return value >= self.trips if self.above else value <= self.trips

    def safe(self, value: float) -> bool:
        """Whether a value may release the row."""
        return value <= self.releases if self.above else value >= self.releases

    def shown(self, value: float) -> str:
        """Return a value of the reading, formatted for display."""
        match self.unit:
            case "share":
                return f"{100.0 * value:.3g} %"
            case "rad":
                return f"{math.degrees(value):.3g}°"
            case "yes/no":
                return "yes" if value >= 0.5 else "no"
            case "count":
                return f"{value:.0f}"
            case "s" if value >= UNKNOWN_TIME:
                return "an unknown time"
            case _:
                return f"{value:.3g} {self.unit}"

    @property
    def limit(self) -> str:
        """The trip limit in words, as " (limit 3 s)"; "" for a yes/no or count row."""
        return "" if self.unit in ("yes/no", "count") else f" (limit {self.shown(self.trips)})"

    def ordered(self, act: Act) -> str:
        """Return the name under which the plant may order an action."""
        return "DEFOCUS or STOW" if self.or_stow and act is Act.DEFOCUS else act.name

    @property
    def consequence(self) -> str:
        """The automatic action, in one sentence."""
        target = {Scope.HELIOSTAT: "the heliostat", Scope.CLUSTER: "the cluster"}
        whole = target.get(self.scope, "the field")
        text = {
            Act.ALARM: f"Nothing moves or stops in {whole}",
            Act.REFUSE_NEW: f"New motions of {whole} are refused; running motions continue",
            Act.HOLD: f"HOLD: {whole} stops where it is",
            Act.DEFOCUS: f"{self.ordered(Act.DEFOCUS)} of {whole}",
            Act.STOW: f"STOW of {whole}",
        }[self.act]
        if math.isfinite(self.then_stow):
            text += f"; STOW after {self.then_stow:g} s"
        if self.role is not None:
            text += f"; holds until acknowledged ({self.role.title})"
        return f"{text}."
