"""ZERO: the position of one heliostat's axes, as a person declares it."""

from collections.abc import Sequence

from heliotrope.plant import refusals
from heliotrope.plant.authority import Person
from heliotrope.plant.controller import PlantController
from heliotrope.plant.tickets import Ticket


def zero(
    plant: PlantController,
    person: Person,
    token: int,
    heliostats: Sequence[str],
    values: Sequence[float],
) -> Ticket:
    """Declare the step counts of the two axes of one heliostat that is locked or has a fault.

    Nothing moves; its controller stores the counts. It needs an engineer, and the heliostat's key
    in its cluster.

    Parameters
    ----------
    plant
        The controller.
    person, token
        The person commanding, and the token of the command authority.
    heliostats
        The name of one.
    values
        Counts of the primary and the secondary axis, steps.

    Raises
    ------
    RefusedError
        If it is not accepted; nothing is sent then.
    InputError
        Values that do not fit.
    UnknownNameError
        If there is no such heliostat.
    """
    if len(heliostats) != 1:
        raise refusals.ONE_HELIOSTAT.error(what="ZERO", count=len(heliostats) or "all")
    return plant.zero(person, token, heliostats[0], values)
