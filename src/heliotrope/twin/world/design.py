"""The plant file of a run, and the items that its boards should store."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from heliotrope.field.aim_settings import AimSettings
from heliotrope.field.coded_visits import JointSettings, ReceiverSettings
from heliotrope.field.flux_limit import FluxLimit
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.layout_tower import watching_camera
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver
from heliotrope.field.volumes import Sphere
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.board_items import Wanted, items_of
from heliotrope.optics.plant_scene import scene_of
from heliotrope.optics.receiver_flux import FieldFlux
from heliotrope.twin.boards.outfit import RECEIVER, Outfit, mechanisms
from heliotrope.twin.world.scene import Scene

#: Width and height of all mirrors, m.
MIRROR = 2.0
#: Settings of joint visits and receiver visits for a small field and a run of some minutes.
JOINT = JointSettings(least=3, first=8)
#: Aims under a flux limit for a small field: the limit over the peak of all beams in the middle,
#: and rounds in which one beam at a time moves.
LIMIT_OF_PEAK = 0.6
AIMS = AimSettings(probability=0.95, moves=4.0, together=1, every=15.0)
#: Rise of the flux that a ramp allows in one round, over the highest peak of a single beam.
RISE_OF_BEAM = 1.2
_EYE = "below"
RECEIVER_VISITS = ReceiverSettings(_EYE, "receiver", least=2, known=0.01, power=0.01, every=60.0)


def design_of(
    fits: Sequence[Outfit],
    homes: Mapping[str, Sequence[str]],
    scene: Scene,
    *,
    together: bool = False,
) -> Plant:
    """Return a plant whose heliostats are calibrated to their true parameters.

    Parameters
    ----------
    fits
        The heliostats.
    homes
        Names of the heliostats of each cluster.
    scene
        Site, targets and keep-out volumes.
    together
        Whether several heliostats are measured at once, on targets and on the receiver.
    """
    home = {name: cluster for cluster, names in homes.items() for name in names}
    names = tuple(fit.name for fit in fits)
    size = np.full(len(fits), MIRROR)
    group = Heliostats(
        names,
        mechanisms(fits),
        size,
        size,
        cluster=tuple(home[name] for name in names),
        machines=tuple(fit.machine for fit in fits),
    )
    receiver = Receiver(
        "receiver", "planar", np.array(RECEIVER), np.array([0.0, 1.0, 0.0]), 6.0, 6.0
    )
    balls = tuple(Sphere(f"house {i}", *ball) for i, ball in enumerate(scene.keep_outs, 1))
    groups = {"all": group}
    eye = watching_camera(receiver.face, _EYE, 60.0, 5.0, 0.0)
    return Plant(
        "simulation",
        scene.site,
        groups,
        targets=scene.targets,
        receivers=(receiver,),
        keep_outs=balls,
        cameras=(replace(eye, targets=()),) if together else (),
        joint_visits=JOINT if together else None,
        receiver_visits=RECEIVER_VISITS if together else None,
    )


def limited(design: Plant, sun: FloatArray, *, ramp: bool) -> Plant:
    """Return a plant with a flux limit, which all its beams in the receiver's middle would exceed.

    With a ramp, one beam at a time may come to a cell.

    Parameters
    ----------
    design
        The plant, with one receiver.
    sun
        Direction to the sun, (3,).
    """
    scene = scene_of(design, sun, design.receivers[0].center, dni=AIMS.dni)
    limit = FluxLimit(LIMIT_OF_PEAK * float(FieldFlux(scene).maps[0].max()), 0.05)
    rate = 0.0
    if ramp:
        others = ~np.eye(len(design), dtype=np.bool_)
        highest = max(FieldFlux(replace(scene, dark=dark)).maps[0].max() for dark in others)
        rate = RISE_OF_BEAM * float(highest) / AIMS.every
    return replace(design, aims=replace(AIMS, strategy="limit", limit=limit, ramp=rate))


def wanted_of(fits: Sequence[Outfit]) -> Wanted:
    """Return the items that the boards of heliostats should store."""
    required = Wanted()
    for fit in fits:
        required.set(fit.name, items_of(fit.mechanism, fit.machine))
    return Wanted(required.items)
