"""ZERO and LOCK POSITION: an operator declares the axis positions of one heliostat.

ZERO takes step counts. LOCK POSITION (Malan, table D.1, 0xD4) takes the aim at which the operator
sees the beam; the counts are then set to the values that the calibrated heliostat would have now
with its beam at that aim.
"""

import functools
from collections.abc import Sequence

import numpy as np

from heliotrope.geometry import angle_between
from heliotrope.lcu import states
from heliotrope.mechanism import track
from heliotrope.mechanism.tracking import TrackingStatus
from heliotrope.plant import refusals
from heliotrope.plant.controller import PlantController
from heliotrope.plant.orders.authority import Person
from heliotrope.plant.orders.tickets import Ticket

#: Largest rotation of the mirror's normal that LOCK POSITION may declare, rad. A beam that is off
#: by more than twice this angle belongs to another heliostat, or the heliostat has another aim.
MOST_TURN = 0.1


def zero(
    plant: PlantController,
    person: Person,
    token: int,
    heliostats: Sequence[str],
    values: Sequence[float],
) -> Ticket:
    """Declare the step counts of both axes of one heliostat that is locked or has a fault.

    Nothing moves; the local controller stores the counts. This requires an engineer, and the
    heliostat's key stored in its cluster.

    Parameters
    ----------
    plant
        The controller.
    person, token
        The person commanding, and the token of the command authority.
    heliostats
        The name of one heliostat.
    values
        Counts of the primary and the secondary axis, steps.

    Raises
    ------
    RefusedError
        If the order is not accepted, in which case nothing is sent.
    InputError
        If the values are not two valid counts.
    UnknownNameError
        If there is no such heliostat.
    """
    if len(heliostats) != 1:
        raise refusals.ONE_HELIOSTAT.error(what="ZERO", count=len(heliostats) or "all")
    return plant.commands.zero(person, token, heliostats[0], values)


def lock_position(
    plant: PlantController, person: Person, token: int, heliostats: Sequence[str]
) -> tuple[Ticket, str]:
    """Declare that the beam of one locked heliostat is at its aim now, and set its counts.

    Nothing moves. First move the beam to its aim by JOG and lock the heliostat.

    Parameters
    ----------
    plant
        The controller.
    person, token
        The person commanding, and the token of the command authority.
    heliostats
        The name of one heliostat.

    Returns
    -------
        The ticket, and the change in words.

    Raises
    ------
    RefusedError
        If the order is not accepted, in which case nothing is sent.
    UnknownNameError
        If there is no such heliostat.
    """
    what = "LOCK POSITION"
    if len(heliostats) != 1:
        raise refusals.ONE_HELIOSTAT.error(what=what, count=len(heliostats) or "all")
    (name,) = heliostats
    row = plant.field.place(name)
    refused = functools.partial(refusals.NO_POSITION.error, heliostat=name)
    if not plant.field.among((states.LOCKED,), plant.now())[row]:
        raise refused(why="it is not locked, or has sent no recent report")
    aim, sun = plant.aims[row], plant.sun_vector()
    if not np.isfinite(aim).all():
        raise refused(why="it has no aim point")
    if sun[2] <= 0.0:
        raise refused(why="the sun is below the horizon")
    here = plant.field.rows[row]
    counts = np.array([float(here["primary"]), float(here["secondary"])])
    mechanism = plant.beliefs.present(name)[0]
    found = track(mechanism, sun, aim, current=counts)
    if TrackingStatus(int(found.chosen(found.status))) is not TrackingStatus.OK:
        raise refused(why="its axes cannot turn the beam to its aim now")
    wanted = np.round(found.best_counts)
    turn = float(angle_between(mechanism.pose(counts).normal, mechanism.pose(wanted).normal))
    if turn > MOST_TURN:
        raise refused(
            why=f"its step counts would change by {1e3 * turn:.0f} mrad of mirror rotation, the "
            f"limit is {1e3 * MOST_TURN:.0f} mrad; check that the beam and the aim are this "
            f"heliostat's",
        )
    ticket = plant.commands.zero(person, token, name, wanted.tolist())
    places = ", ".join(f"{x:.2f}" for x in aim)
    return ticket, (
        f"{what} {name} at ({places}) m: counts {counts[0]:.0f}, {counts[1]:.0f} become "
        f"{wanted[0]:.0f}, {wanted[1]:.0f}, {1e3 * turn:.2f} mrad of the mirror"
    )
