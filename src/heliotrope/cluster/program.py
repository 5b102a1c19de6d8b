"""A cluster built from its cluster file: its time sources and emergency line, and its process.

`heliotrope cluster` runs a cluster in its own process. If the bus is attached to the plant's
computer, the plant runs the same program with an in-memory link instead of a network
(`LocalCluster`).
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from heliotrope.cluster import timekeeping
from heliotrope.cluster.config_file import Installation, read_cluster
from heliotrope.cluster.controller import Cluster
from heliotrope.cluster.memory import Kept
from heliotrope.cluster.serial_bus import SerialBus
from heliotrope.cluster.timekeeping import SystemTime, TimeKeeper
from heliotrope.errors import FormatError
from heliotrope.files.disk import DiskThread
from heliotrope.links.clock import Clock
from heliotrope.links.gpsd import Gpsd
from heliotrope.links.in_process import memory_pair
from heliotrope.links.link import Link


def time_of(installation: Installation, clock: Clock) -> TimeKeeper:
    """Return the time keeper of a cluster.

    Raises
    ------
    InputError
        If the kernel's bound is needed but not available.
    """
    gpsd = None if installation.gpsd is None else Gpsd(clock, *installation.gpsd)
    if installation.error is not None:
        return SystemTime(clock, installation.error, gpsd=gpsd)
    timekeeping.kernel_bound()  # a system that does not report the bound is refused at start-up
    return SystemTime(clock, bound=timekeeping.kernel_bound, gpsd=gpsd)


def line_of(file: Path | None) -> Callable[[], bool] | None:
    """Return a function that reads the emergency line; None if there is no line.

    The function reads a GPIO file and returns whether current flows. A file that cannot be read
    counts as an open line.
    """
    if file is None:
        return None

    def flows() -> bool:
        try:
            with file.open("rb") as stream:
                return stream.read(1) == b"1"
        except OSError:
            return False

    return flows


class LocalCluster:
    """A cluster whose bus is connected to the plant's computer.

    Parameters
    ----------
    path
        Path of the cluster file, whose table ``[plant]`` is not used.
    name, members
        Names of the cluster and of its heliostats in the plant.
    clock
        Clock of the plant.

    Attributes
    ----------
    link
        The plant's end of the link.
    parts
        Bus, time and both ends of the link; the owner runs them.
    cluster
        The cluster; the owner runs it within ``parts``.
    installation
        The installation as read from the cluster file.

    Raises
    ------
    FormatError
        If the file is for another cluster, or lists other heliostats than the plant does.
    """

    def __init__(self, path: Path, name: str, members: tuple[str, ...], clock: Clock) -> None:
        installation = self.installation = read_cluster(path)
        config = installation.config
        listed = {member.name for member in config.heliostats}
        if config.name != name:
            raise FormatError(path, f"it is for cluster {config.name}, not for {name}", "name")
        if listed != set(members):
            odd = min(listed ^ set(members))
            where = "the plant file" if odd in members else "this file"
            raise FormatError(
                path, f"{odd} is listed as a heliostat of {name} only in {where}", "heliostats"
            )
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
            Kept(installation.state, disk=DiskThread()),
            line_of(installation.emergency_line),
            installation.bus_keys,
        )
        self.parts: tuple[Any, ...] = (near, far, bus, time)
