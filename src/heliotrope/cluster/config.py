"""Configuration of a cluster controller: site, heliostats and limits, read by `config_file`."""

import math
from dataclasses import dataclass, field

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.lcu import wire
from heliotrope.links.common_settings import CommonSettings
from heliotrope.safety import CONDITIONS, Limits, Watcher, limited, watched_by
from heliotrope.sun import Site

#: Maximum number of unit loads on RS485.
MOST_MEMBERS = 32


@dataclass(frozen=True)
class Member:
    """One heliostat of a cluster.

    Parameters
    ----------
    name
        Name as known to the plant.
    address
        Bus address, 1 to 65534.
    serial
        Serial number of its local controller, for discovery and address assignment; None if
        unknown.
    key
        Key of its local controller, needed to store items; with b"", nothing can be stored.

    Raises
    ------
    InputError
        If a name is empty, or a number is out of range.
    """

    name: str
    address: int
    serial: int | None = None
    key: bytes = b""

    def __post_init__(self) -> None:
        if not self.name:
            raise InputError(f"heliostat at address {self.address}: the name is empty; enter one")
        for what, value, low, high in (
            ("address", self.address, 1, wire.BROADCAST - 1),
            ("serial number", self.serial, 0, 0xFFFFFFFF),
        ):
            if value is not None and not low <= value <= high:
                raise InputError(
                    f"heliostat {self.name}: {what} {value} is not within {low} to {high}"
                )


@dataclass(frozen=True)
class ClusterConfig:
    """Configuration of a cluster.

    Parameters
    ----------
    name
        Name as known to the plant.
    site
        Location and atmosphere, for the sun vector.
    heliostats
        1 to 32 heliostats. They are polled in the order of their addresses, and reported in the
        order given here.
    answer
        Timeout from the end of a query to the complete reply, in s.
    stored_answer
        Timeout if flash is written before the reply, in s.
    steps_every
        Interval at which the step counts of each heliostat are requested, in s.
    silence
        Time without a reply after which a heliostat is reported, in s.
    longest_autonomy
        Maximum autonomy that the plant may grant, in s. Set it above 0 only if a hard-wired
        emergency line reaches this cluster.
    limits
        Limits of the safety table that this plant sets for the rows that clusters evaluate.
    phase
        Delay of each second relative to the GPS second, in s, 0 to below 1. If one process runs
        many clusters, see `spread_phase`.

    Raises
    ------
    InputError
        If a value is invalid for a cluster.
    """

    name: str
    site: Site
    heliostats: tuple[Member, ...]
    answer: float = 0.05
    stored_answer: float = 0.6
    steps_every: int = CommonSettings.steps_every
    silence: float = CommonSettings.silence
    longest_autonomy: float = 0.0
    phase: float = 0.0
    limits: Limits = field(default_factory=dict)

    def __post_init__(self) -> None:
        at = f"cluster {self.name!r}"
        limited(watched_by(CONDITIONS, Watcher.CLUSTER), self.limits)
        if not self.name:
            raise InputError(f"{at}: the name is empty; enter one")
        if not 1 <= len(self.heliostats) <= MOST_MEMBERS:
            raise InputError(
                f"{at}: {len(self.heliostats)} heliostats; one bus supports 1 to {MOST_MEMBERS}"
            )
        for what in ("name", "address", "serial"):
            values = [getattr(member, what) for member in self.heliostats]
            for value in values:
                if value is not None and values.count(value) > 1:
                    raise InputError(
                        f"{at}: two heliostats have the {what} {value}; assign each its own"
                    )
        for what, number, low, high in (
            ("answer", self.answer, 0.001, 1.0),
            ("stored_answer", self.stored_answer, self.answer, 2.0),
            ("silence", self.silence, 2.0, 3600.0),
            ("longest_autonomy", self.longest_autonomy, 0.0, 86400.0),
            ("phase", self.phase, 0.0, math.nextafter(1.0, 0.0)),
        ):
            if not low <= number <= high:
                raise InputError(f"{at}: {what} {number} s is not within {low:g} to {high:g} s")
        if not 1 <= self.steps_every <= 60:
            raise InputError(f"{at}: steps_every {self.steps_every} s is not within 1 to 60 s")

    @property
    def common(self) -> CommonSettings:
        """The settings that all clusters should share."""
        return CommonSettings(self.steps_every, self.silence, self.site.delta_t, self.limits)

    def member(self, name: str) -> Member:
        """Return a heliostat by its name.

        Raises
        ------
        UnknownNameError
            If this cluster has no heliostat with that name.
        """
        for member in self.heliostats:
            if member.name == name:
                return member
        raise UnknownNameError("heliostat", name, [member.name for member in self.heliostats])


def spread_phase(index: int, count: int) -> float:
    """Return the phase of one of many clusters in a process, so that the work is spread.

    Parameters
    ----------
    index
        Index of the cluster, 0 to ``count`` - 1.
    count
        Number of clusters.

    Returns
    -------
    float
        Phase in s, 0 to below 1; consecutive clusters are as far apart as possible.

    Raises
    ------
    InputError
        If the index is out of range.
    """
    if not 0 <= index < count:
        raise InputError(f"phase: cluster {index} of {count}; use an index from 0 to {count - 1}")
    return index / count
