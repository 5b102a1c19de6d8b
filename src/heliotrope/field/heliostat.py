"""One heliostat of a plant, as returned by ``plant[name]``."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

from heliotrope.field.heliostats import Heliostats
from heliotrope.field.target import Target
from heliotrope.frames import Framed, Labelled
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.chain import Calibrated, Mechanism
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.machine import Machine
from heliotrope.sun import Site
from heliotrope.values import Card, Value


@dataclass(frozen=True, eq=False, repr=False)
class Heliostat(Value, Framed):
    """One heliostat, as returned by ``plant["P6A"]``; `track` treats it as a plant of one.

    Attributes
    ----------
    heliostats
        The heliostat as a group of one.
    group
        Name of its group in the plant.
    site
        Reference point of the plant: the origin of ENU.
    targets
        The plant's targets.
    """

    heliostats: Heliostats
    group: str
    site: Site
    targets: tuple[Target, ...] = ()

    def _card(self) -> Card:
        east, north, up = self.position
        line = f"{self.name}, {self.nominal.kind}, at {east:.1f}, {north:.1f}, {up:.1f} m"
        rows = [("mirror", f"{self.width:.2f} × {self.height:.2f} m"), ("cluster", self.cluster)]
        for name, value in self.calibrated.deviations.items():
            rows.append((name, f"{float(value):.4g} {self.nominal.parameter(name).unit}"))
        return Card(line, ("part", "value"), rows)

    def _labelled(self) -> Labelled:
        return self.heliostats.labelled()

    @property
    def name(self) -> str:
        """The name of the heliostat."""
        return self.heliostats.names[0]

    @property
    def nominal(self) -> Mechanism:
        """The mechanism as designed, batch shape ()."""
        return self.heliostats.mechanism[0]

    @cached_property
    def calibrated(self) -> Mechanism:
        """The mechanism with its calibrated deviations, batch shape ()."""
        return self.heliostats.calibrated[0]

    @property
    def deviations(self) -> Mapping[str, FloatArray]:
        """Deviations of the calibrated mechanism, by name, rad, m or 1, each ()."""
        return self.calibrated.deviations

    def with_calibration(self, calibration: Calibrated) -> "Heliostat":
        """Return the heliostat with its own deviations replaced by those of a calibration.

        From a calibration of many heliostats, the entry with this heliostat's name is taken.

        Raises
        ------
        InputError
            If the argument is not a calibration, or covers several heliostats without names.
        UnknownNameError
            If the calibration does not include this heliostat, or the mechanism lacks one of its
            parameters.
        """
        return replace(self, heliostats=self.heliostats.with_calibration(calibration))

    @property
    def armature(self) -> Armature:
        """Armature of the calibrated mechanism, batch shape ()."""
        return self.calibrated.armature

    @property
    def drives(self) -> Drive:
        """Drives of the calibrated mechanism, batch shape (D,)."""
        return self.calibrated.drives

    @property
    def attachment(self) -> FloatArray:
        """Attachment of the calibrated mechanism, (4, 4); see `Mechanism.attachment`."""
        return self.calibrated.attachment

    @property
    def position(self) -> FloatArray:
        """Nominal position, ENU metres, (3,)."""
        return self.nominal.position

    @property
    def width(self) -> float:
        """Width of the mirror, m."""
        return float(self.heliostats.width[0])

    @property
    def height(self) -> float:
        """Height of the mirror, m."""
        return float(self.heliostats.height[0])

    @property
    def aim(self) -> FloatArray | None:
        """Aim point in operation, ENU metres, (3,); None if the plant does not specify one."""
        return self.heliostats.own_aim(0)

    @property
    def cluster(self) -> str:
        """Name of its cluster; empty if it has none."""
        return self.heliostats.cluster[0] if self.heliostats.cluster else ""

    @property
    def machine(self) -> Machine | None:
        """Motor limits and rest positions; None if the plant file does not specify them."""
        return self.heliostats.machines[0] if self.heliostats.machines else None
