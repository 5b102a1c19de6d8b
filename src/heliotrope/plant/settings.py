"""Settings of a plant: times and limits, and the heliostats of each cluster."""

import math
from collections import deque
from dataclasses import dataclass, field

from heliotrope.errors import InputError
from heliotrope.field.plant import Plant
from heliotrope.links.common_settings import CommonSettings
from heliotrope.plant.field.state import STALE

#: Number of heliostats that may join the receiver per second without a flux ramp.
JOIN_RATE = 10.0


@dataclass(frozen=True)
class PlantSettings:
    """Times and limits of a plant.

    Attributes
    ----------
    lease, autonomy
        A cluster must receive from the plant within ``lease`` s, and may continue without the plant
        for ``autonomy`` s after that (see `safety.conditions`).
    period, beat
        Interval between leases; interval between evaluations of the safety table and the queues, s.
    join_rate, join_burst
        Number of heliostats that may join the receiver per second, and number that may join at once
        after a pause; None: see `joins`.
    join_wait
        Maximum time that a heliostat may wait to join, s.
    join_life
        Lifetime of a join command once its turn has come, s; a delayed command must not arrive
        together with commands whose turn came later.
    lifetime, patience
        Timeouts: until a command is acknowledged, and from then until it is done, s.
    stale
        Age above which a value is stale, s.
    authority
        Lifetime of the command authority without renewal, s.
    sensors
        Safety-table readings that come from sensors, through `PlantController.put`.
    given
        Safety-table readings that programs supply through the HTTP API; see
        `operations.given_readings`.
    repeat
        Interval between repetitions of an emergency order to heliostats that have not acknowledged
        it, s.
    largest_change
        Maximum change of a heliostat's beam by new parameters that nobody has confirmed, rad.
    stow_rate
        Number of heliostats per second that start an ordinary STOW of more than this number, so
        that their drives do not start together; 0: all start at once. With the default, 10,000
        heliostats take 50 s, and 2 % of the field start per second. An operator's LOCK removes a
        waiting heliostat from its order. Emergencies and the safety table never wait.
    witnesses
        Witnesses of the sun, one of which must agree before the first heliostat of a day joins a
        receiver. Empty: the plant reports once a day that there is no witness; None: this is
        accepted without a report. See `witnesses`.
    firmware
        Firmware version that every board should have; None: versions are not compared.
    common
        Settings that every cluster should have; None: the clusters are compared with each other.
    """

    lease: float = 3.0
    autonomy: float = 0.0
    period: float = 1.0
    beat: float = 0.25
    join_rate: float | None = None
    join_burst: int | None = None
    join_wait: float = 1800.0
    join_life: float = 3.0
    lifetime: float = 10.0
    patience: float = 600.0
    stale: float = STALE
    authority: float = 15.0
    sensors: frozenset[str] = frozenset()
    given: frozenset[str] = frozenset()
    repeat: float = 1.0
    largest_change: float = 5e-3
    stow_rate: float = 200.0
    witnesses: frozenset[str] | None = None
    firmware: int | None = None
    common: CommonSettings | None = None

    def __post_init__(self) -> None:
        if not 0.0 < 2.0 * self.period <= self.lease < math.inf:
            raise InputError(
                f"plant: a lease of {self.lease} s renewed every {self.period} s; it must last at "
                "least two periods, so that one message may be lost"
            )
        if not (self.stow_rate == 0.0 or 1.0 <= self.stow_rate < math.inf):
            raise InputError(
                "plant: the stow rate must be 1 heliostat a second or more, or 0 for all at once, "
                f"not {self.stow_rate:g}"
            )
        if not 0.0 < self.beat <= 1.0 or not 0.0 < self.repeat < math.inf:
            raise InputError(
                f"plant: a cycle of {self.beat} s and a repetition of {self.repeat} s; the ranges "
                "are above 0 to 1 s, and above 0"
            )

    def joins(self, design: Plant) -> tuple[float, int]:
        """Return how many heliostats may join the receiver per second, and at once after a pause.

        Unless the settings say otherwise, `JOIN_RATE` per second, whatever the size of the field,
        because each adds flux. Under a flux ramp, which bounds that flux itself, the number is that
        of the drives which may start together: ``stow_rate``. After a pause, those of one second
        may join at once.
        """
        rate = self.join_rate
        if rate is None:
            together = self.stow_rate or float(len(design))
            rate = together if design.aims.ramp > 0.0 else JOIN_RATE
        return rate, max(1, round(rate)) if self.join_burst is None else self.join_burst


@dataclass
class Counters:
    """Counts of refused messages, statuses and sent leases since start-up; the last problems."""

    refused: int = 0
    statuses: int = 0
    leases: int = 0
    problems: deque[str] = field(default_factory=lambda: deque(maxlen=100))


def clusters_of(design: Plant) -> dict[str, tuple[str, ...]]:
    """Return the heliostats of each cluster in a design.

    Raises
    ------
    InputError
        If a heliostat has no cluster.
    """
    found: dict[str, list[str]] = {}
    for name, cluster in zip(design.names, design.cluster, strict=True):
        if not cluster:
            raise InputError(f"heliostat {name} belongs to no cluster; name one in the plant file")
        found.setdefault(cluster, []).append(name)
    return {cluster: tuple(names) for cluster, names in found.items()}
