"""The plant file of a run, and what its boards should store."""

from collections.abc import Mapping, Sequence

import numpy as np

from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver
from heliotrope.field.volumes import Sphere
from heliotrope.mechanism.board_items import Wanted, items_of
from heliotrope.twin.boards.outfit import MACHINE, RECEIVER, Outfit, mechanisms
from heliotrope.twin.world.scene import Scene


def design_of(fits: Sequence[Outfit], homes: Mapping[str, Sequence[str]], scene: Scene) -> Plant:
    """Return a plant of some heliostats, calibrated to the truth.

    Parameters
    ----------
    fits
        Heliostats.
    homes
        Names of the heliostats of each cluster.
    scene
        Site, targets and keep-out volumes.
    """
    home = {name: cluster for cluster, names in homes.items() for name in names}
    names = tuple(each.name for each in fits)
    size = np.full(len(fits), 2.0)
    group = Heliostats(
        names,
        mechanisms(fits),
        size,
        size,
        cluster=tuple(home[name] for name in names),
        machines=(MACHINE,) * len(fits),
    )
    receiver = Receiver(
        "receiver", "planar", np.array(RECEIVER), np.array([0.0, 1.0, 0.0]), 6.0, 6.0
    )
    balls = tuple(Sphere(f"house {i}", *ball) for i, ball in enumerate(scene.keep_outs, 1))
    groups = {"all": group}
    return Plant(
        "simulation",
        scene.site,
        groups,
        targets=scene.targets,
        receivers=(receiver,),
        keep_outs=balls,
    )


def wanted_of(fits: Sequence[Outfit]) -> Wanted:
    """Return what the boards of heliostats should store."""
    wanted = Wanted()
    for fit in fits:
        wanted.set(fit.name, items_of(fit.mechanism, MACHINE))
    return Wanted(wanted.items)
