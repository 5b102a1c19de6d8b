"""Heliostats out of service: locked out for somebody at the mirror.

A heliostat that is out of service stays in stow. Nobody moves it, neither a person nor automatic
control nor a command to a group, until it is given back by name. EMERGENCY, DEFOCUS and STOW pass.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

#: Commands that move nothing, now or later: they may be given to a heliostat out of service. ZERO
#: and PARAMETERS are not among them: the next STOW would go where stow is by then.
STILL = frozenset({"LOCK", "LOCK_AIM", "ROUGH"})


@dataclass(frozen=True)
class Lockout:
    """A heliostat out of service.

    Attributes
    ----------
    heliostat
        Its name.
    who, reason
        Person who took it out, and why.
    since, until
        When, and the time at which it is expected back, POSIX s; NaN if none was given. It stays
        out of service after that time too.
    """

    heliostat: str
    who: str
    reason: str
    since: float
    until: float = math.nan

    @property
    def text(self) -> str:
        """One line: reason, person, since, expected back."""
        back = f", expected back {_time(self.until)}" if math.isfinite(self.until) else ""
        return f"{self.reason} ({self.who}, since {_time(self.since)}{back})"


def locked_out(
    out: Mapping[str, Lockout], command: str, heliostats: Iterable[str]
) -> dict[str, str]:
    """Return which heliostats a command must not move, and why."""
    if command in STILL or not out:
        return {}
    return {name: f"out of service: {out[name].text}" for name in heliostats if name in out}


def _time(at: float) -> str:
    return f"{datetime.fromtimestamp(at, UTC):%d %b %H:%M} UTC"
