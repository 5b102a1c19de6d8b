"""A cluster of a cluster file: its sources of time, its emergency line, and its run in a process.

`heliotrope cluster` runs one in a process of its own. Where the bus is at the plant's machine the
plant runs it (`LocalCluster`): the same program, with a link in memory in place of a network.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from heliotrope.cluster import timekeeping
from heliotrope.cluster.config_file import Installation, read_cluster
from heliotrope.cluster.controller import Cluster
from heliotrope.cluster.discipline import DisciplineSettings
from heliotrope.cluster.gps import GpsSettings, GpsTime
from heliotrope.cluster.memory import Kept
from heliotrope.cluster.serial_bus import SerialBus
from heliotrope.cluster.timekeeping import SystemTime, TimeKeeper
from heliotrope.errors import FormatError
from heliotrope.links.clock import Clock
from heliotrope.links.in_process import memory_pair
from heliotrope.links.link import Link


def time_of(installation: Installation, clock: Clock) -> TimeKeeper:
    """Return where a cluster has its time from.

    Raises
    ------
    InputError
        If the kernel is to be asked and cannot be.
    """
    time = installation.time
    if time.source == "system":
        if time.ntp:
            # Where the kernel cannot be asked, that is said at the start.
            timekeeping.kernel_synchronised()
        asked = timekeeping.kernel_synchronised if time.ntp else None
        return SystemTime(clock, time.error_s, synchronised=asked, drift_ppm=time.drift_ppm)
    discipline = DisciplineSettings(
        latency=time.latency_s,
        drift_ppm=time.drift_ppm,
        system_tolerance=time.system_tolerance_s or None,
    )
    return GpsTime(time.url, clock, GpsSettings(time.baud_rate, discipline=discipline))


def line_of(file: Path | None) -> Callable[[], bool] | None:
    """Return whether current flows in the emergency line of a GPIO file; None: there is no line.

    What cannot be read is an open line.
    """
    if file is None:
        return None

    def flows() -> bool:
        try:
            return file.read_bytes()[:1] == b"1"
        except OSError:
            return False

    return flows


class LocalCluster:
    """A cluster whose bus is at the plant's machine.

    Parameters
    ----------
    path
        Of its cluster file; what it says of the plant is not used.
    name, members
        As the plant knows them.
    clock
        Of the plant.

    Attributes
    ----------
    link
        The plant's end.
    parts
        Bus, time and both ends of the link, to be run.
    cluster
        To be run within them.

    Raises
    ------
    FormatError
        If the file is of another cluster, or its heliostats are not the plant's.
    """

    def __init__(self, path: Path, name: str, members: tuple[str, ...], clock: Clock) -> None:
        installation = read_cluster(path)
        config = installation.config
        found = {member.name for member in config.heliostats}
        if config.name != name:
            raise FormatError(path, f"it is of cluster {config.name}, not of {name}", "name")
        if found != set(members):
            odd = min(found ^ set(members))
            where = "the plant file" if odd in members else "this file"
            raise FormatError(path, f"{odd} is a heliostat of {name} in {where} only", "heliostats")
        near, far, _ = memory_pair(clock, names=("plant", name))
        bus = SerialBus(installation.bus_url, clock, installation.bus)
        time = time_of(installation, clock)
        self.link: Link = near
        self.cluster = Cluster(
            config,
            bus,
            far,
            clock,
            time,
            Kept(installation.state),
            line_of(installation.emergency_line),
        )
        self.parts: tuple[Any, ...] = (near, far, bus, time)
