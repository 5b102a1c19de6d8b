"""Heliostats in the forms that calibration functions accept, and matching sightings by name.

The functions accept mechanisms, one heliostat of a plant, a group, or a whole plant of one kind. If
both heliostats and sightings have names, they are matched by name; otherwise by index.
"""

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from heliotrope.calibration.sightings import Sightings
from heliotrope.errors import InputError, UnknownNameError, kind_of
from heliotrope.field.heliostat import Heliostat
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.mechanism.chain import Mechanism
from heliotrope.sun import Site

#: One or more mechanisms, with or without names.
Field: TypeAlias = Mechanism | Heliostat | Heliostats | Plant


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The surroundings of learnt heliostats, which a forecast needs in addition.

    Attributes
    ----------
    site
        The plant's reference point; None if unknown.
    targets
        The plant's targets.
    """

    site: Site | None = None
    targets: tuple[Target, ...] = ()


NOWHERE = Surroundings()


@dataclass(frozen=True, eq=False)
class Members:
    """N heliostats.

    Attributes
    ----------
    mechanism
        (N,).
    names
        (N,); () if unknown.
    single
        Whether a single heliostat was passed without a batch axis.
    around
        Surroundings of the heliostats.
    """

    mechanism: Mechanism
    names: tuple[str, ...] = ()
    single: bool = False
    around: Surroundings = NOWHERE

    def rows_of(self, sightings: Sightings) -> Sightings:
        """Return the sightings with heliostat indices that refer to these heliostats.

        Raises
        ------
        InputError
            If a sighting refers to a heliostat that does not exist, or sightings with names are
            matched with a different number of heliostats without names.
        UnknownNameError
            If a sighting names a heliostat that does not exist.
        """
        count, drives = len(self.mechanism), len(self.mechanism.driven)
        if not isinstance(sightings, Sightings):
            raise InputError(
                f"sightings: {kind_of(sightings)} is not Sightings; create them with "
                "heliotrope.sightings"
            )
        if sightings.counts.shape[-1] != drives:
            raise InputError(
                f"sightings: counts of {sightings.counts.shape[-1]} drives; the mechanisms have "
                f"{drives}"
            )
        if sightings.names and self.names:
            return _matched(sightings, self.names)
        if sightings.names and len(sightings.names) != count:
            raise InputError(
                f"sightings: they name {len(sightings.names)} heliostats, the first "
                f"{sightings.names[0]}, but the {count} mechanisms have no names; pass the plant, "
                "its group or one of its heliostats"
            )
        if len(sightings) and int(sightings.heliostat.max()) >= count:
            raise InputError(
                f"sightings: a sighting has heliostat index {int(sightings.heliostat.max())}, but "
                f"there are {count} heliostats"
            )
        return sightings


def members(field: Field, state: Literal["nominal", "calibrated"] = "nominal") -> Members:
    """Return heliostats with their nominal or their calibrated mechanisms.

    Raises
    ------
    InputError
        If a plant has heliostats of several kinds, or mechanisms have several batch axes.
    """
    if isinstance(field, Mechanism):
        if len(field.shape) > 1:
            raise InputError(
                f"mechanism: shape {field.shape}; pass one mechanism, or N mechanisms of shape (N,)"
            )
        return Members(field if field.shape else field[None], single=not field.shape)
    if isinstance(field, Heliostat):
        group = field.heliostats
        chosen = group.mechanism if state == "nominal" else group.calibrated
        return Members(chosen, group.names, True, Surroundings(field.site, field.targets))
    if isinstance(field, Heliostats):
        return Members(field.mechanism if state == "nominal" else field.calibrated, field.names)
    if isinstance(field, Plant):
        chosen = field.nominal if state == "nominal" else field.calibrated
        return Members(chosen, field.names, around=Surroundings(field.site, field.targets))
    raise InputError(
        f"mechanism: {kind_of(field)} is not a Mechanism; pass nominal mechanisms, plant[name], a "
        "group of the plant, or the plant"
    )


def _matched(sightings: Sightings, names: tuple[str, ...]) -> Sightings:
    if sightings.names == names:
        return sightings
    place = {name: i for i, name in enumerate(names)}
    rows = np.array([place.get(name, -1) for name in sightings.names], dtype=np.intp)
    indices = rows[sightings.heliostat]
    if (indices < 0).any():
        stranger = sightings.names[int(sightings.heliostat[int(np.argmin(indices))])]
        raise UnknownNameError("heliostat (of a sighting)", stranger, names)
    return replace(sightings, heliostat=indices, names=names)
