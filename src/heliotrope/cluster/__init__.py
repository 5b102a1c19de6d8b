"""The cluster controller: the program that controls one bus with up to 32 heliostats.

`Cluster` is the controller. It is built from a `ClusterConfig`, a bus, a link to the plant, a clock
and a `TimeKeeper`. `SystemTime` is the time of this computer with the kernel's bound on its error;
`Gpsd` reports the state of a satellite receiver. `Kept` stores the epoch and editions, which
survive a restart. `Turns` shares a bus between tasks.

Modules that need the extra ``control`` must be imported by name: ``config_file`` (`read_cluster`),
``serial_bus`` (`SerialBus`) and ``program`` (a cluster built from its file, `LocalCluster`).

Begin with ``config_file.read_cluster`` and ``controller``. The cluster code is independent of the
plant code.
"""

from heliotrope.cluster.config import MOST_MEMBERS, ClusterConfig, Member, spread_phase
from heliotrope.cluster.controller import Cluster
from heliotrope.cluster.memory import Kept
from heliotrope.cluster.timekeeping import Quality, SystemTime, Time, TimeKeeper, kernel_bound
from heliotrope.cluster.turns import Turns
from heliotrope.links.gpsd import Gpsd, SatelliteReceiver

__all__ = [
    "MOST_MEMBERS",
    "Cluster",
    "ClusterConfig",
    "Gpsd",
    "Kept",
    "Member",
    "Quality",
    "SatelliteReceiver",
    "SystemTime",
    "Time",
    "TimeKeeper",
    "Turns",
    "kernel_bound",
    "spread_phase",
]
