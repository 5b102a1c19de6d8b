"""Settings of a plant: its times and limits, and which heliostat hangs on which cluster."""

import math
from collections import deque
from dataclasses import dataclass, field

from heliotrope.errors import InputError
from heliotrope.field.plant import Plant
from heliotrope.plant.field_state import STALE


@dataclass(frozen=True)
class PlantSettings:
    """Times and limits of a plant.

    Attributes
    ----------
    lease, autonomy
        What the clusters are promised: that they hear the plant within ``lease`` s; and how
        long they go on without it after that, s (see `safety.conditions`).
    period, beat
        Between leases; between looks at the safety table and the queues, s.
    join_rate, join_burst
        Mirrors that may join the receiver in a second, and at once after a rest.
    join_wait
        How long a mirror may wait to join, s.
    join_life
        Life of a command to join once its turn has come, s. What is held up on the way for longer
        must not arrive together with those whose turn came later.
    lifetime, patience
        Of a command until it is acknowledged, then until it is done, s.
    stale
        Age from which a value is not shown as live, s.
    authority
        How long the command authority lasts without being kept up, s.
    sensors
        Readings of the safety table that are fed by `PlantController.put`.
    repeat
        Between repetitions of an emergency order to those that have not acknowledged, s.
    """

    lease: float = 3.0
    autonomy: float = 0.0
    period: float = 1.0
    beat: float = 0.25
    join_rate: float = 10.0
    join_burst: int = 10
    join_wait: float = 1800.0
    join_life: float = 3.0
    lifetime: float = 10.0
    patience: float = 600.0
    stale: float = STALE
    authority: float = 15.0
    sensors: frozenset[str] = frozenset()
    repeat: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 < 2.0 * self.period <= self.lease < math.inf:
            raise InputError(
                f"plant: a lease of {self.lease} s renewed every {self.period} s; it must last at "
                "least two periods, so that one message may be lost"
            )
        if not 0.0 < self.beat <= 1.0 or not 0.0 < self.repeat < math.inf:
            raise InputError(
                f"plant: a beat of {self.beat} s and a repetition of {self.repeat} s; give above "
                "0 to 1 s, and above 0"
            )


@dataclass
class Counters:
    """Counts since the start: messages that were none, statuses, leases sent."""

    refused: int = 0
    statuses: int = 0
    leases: int = 0
    problems: deque[str] = field(default_factory=lambda: deque(maxlen=100))


def clusters_of(design: Plant) -> dict[str, tuple[str, ...]]:
    """Return the heliostats of each cluster, as the design says.

    Raises
    ------
    InputError
        A heliostat that hangs on no cluster.
    """
    found: dict[str, list[str]] = {}
    for group in design.groups.values():
        for i, name in enumerate(group.names):
            cluster = group.cluster[i] if group.cluster else ""
            if not cluster:
                raise InputError(
                    f"heliostat {name}: it hangs on no cluster; name one in the plant file"
                )
            found.setdefault(cluster, []).append(name)
    return {cluster: tuple(names) for cluster, names in found.items()}
