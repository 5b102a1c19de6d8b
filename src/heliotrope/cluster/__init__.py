"""The cluster controller: the program that masters one bus with up to 32 heliostats.

`Cluster` is the controller, made of a `ClusterConfig`, a bus, a link to the plant, a clock and a
`TimeKeeper`. `SystemTime` is the time of this computer with the kernel's bound of its error;
`Gpsd` shows the state of a satellite receiver. `Kept` holds what outlasts a restart: epoch and
editions. `Turns` shares a bus between tasks.

Modules that need the extra ``control`` are imported by name: ``config_file`` (`read_cluster`),
``serial_bus`` (`SerialBus`) and ``program`` (a cluster made from its file, `LocalCluster`).

Begin with ``config_file.read_cluster`` and ``controller``. The cluster knows nothing of the plant.
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
