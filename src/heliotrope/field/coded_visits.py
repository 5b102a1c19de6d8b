"""Settings of coded visits: several heliostats measured at once, told apart by their movements.

They belong to a plant: its targets and its receiver, its mirrors, its drives.
"""

from dataclasses import dataclass, field
from typing import ClassVar

from heliotrope.errors import InputError

#: Largest share of the power that the movements of a receiver visit may cost.
MOST_POWER = 0.01


@dataclass(frozen=True, kw_only=True)
class CodedSettings:
    """Settings of all coded visits, to targets and to a receiver.

    Attributes
    ----------
    most, least
        Heliostats at once; and how many a visit needs that automatic control begins.
    known
        Largest expected beam error of a heliostat that takes part, rad RMS (2-D).
    visit
        Part of it that is drawn anew at each visit, rad per axis.
    movement
        Coded movement of a beam, either way along each axis, rad; a heliostat whose drives move its
        beam in steps of more than half of it moves by two steps.
    settle
        Time from the moment that all have taken their aims until the photograph, s.
    again
        Photographs that are taken at most, as a multiple of those that a visit needs.
    kind
        Name of the visits, for people.
    fewest
        Least number of heliostats.
    most_movement
        Largest movement, rad.
    """

    kind: ClassVar[str]
    fewest: ClassVar[int]
    most_movement: ClassVar[float]

    most: int
    least: int
    known: float = 4e-3
    visit: float = 5e-4
    movement: float
    settle: float = 1.0
    again: float

    def _check(self) -> None:
        """Refuse numbers that cannot be."""
        if not self.fewest <= self.least <= self.most <= 127:
            raise InputError(
                f"{self.kind}: {self.least} to {self.most} heliostats; give {self.fewest} to 127, "
                "the smaller number first"
            )
        if not 0.0 < self.movement <= self.most_movement or not 0.0 <= self.settle <= 60.0:
            raise InputError(
                f"{self.kind}: movements of {1e3 * self.movement:g} mrad that settle in "
                f"{self.settle:g} s; give above 0 to {1e3 * self.most_movement:g} mrad, and 0 to "
                "60 s"
            )
        if not (self.known > 0.0 and self.visit >= 0.0 and self.again >= 1.0):
            raise InputError(
                f"{self.kind}: beams known to {1e3 * self.known:g} mrad, {1e3 * self.visit:g} mrad "
                f"of it drawn anew, {self.again:g} times the photographs; give above 0, 0 or more, "
                "and 1 or more"
            )


@dataclass(frozen=True, kw_only=True)
class JointSettings(CodedSettings):
    """Settings of joint visits: several heliostats on one target at once.

    Attributes
    ----------
    brightest
        Most light on a target, in suns.
    first
        Heliostats without a calibration on one target at once; 0: each goes alone.
    first_movement
        Coded movement of their beams, either way to the right, rad.
    """

    kind: ClassVar[str] = "joint visits"
    fewest: ClassVar[int] = 2
    most_movement: ClassVar[float] = 5e-3

    most: int = 49
    least: int = 4
    movement: float = 5e-4
    again: float = 2.5
    brightest: float = 10.0
    first: int = 63
    first_movement: float = 2e-3

    def __post_init__(self) -> None:
        self._check()
        if not (self.first == 0 or self.least <= self.first <= 127):
            raise InputError(
                f"{self.kind}: {self.first} heliostats without a calibration; give 0, or "
                f"{self.least} to 127"
            )
        if not 0.0 < self.first_movement <= self.most_movement:
            raise InputError(
                f"{self.kind}: first movements of {1e3 * self.first_movement:g} mrad; give above "
                f"0 to {1e3 * self.most_movement:g} mrad"
            )
        if not self.brightest > 0.0:
            raise InputError(f"{self.kind}: up to {self.brightest:g} suns; give above 0")


@dataclass(frozen=True, kw_only=True)
class ReceiverSettings(CodedSettings):
    """Settings of receiver visits: heliostats that shine on a receiver, measured there.

    Attributes
    ----------
    camera
        Name of the camera that sees the whole receiver; its position is known.
    receiver
        Name of the receiver, which is planar.
    exposures
        Frames of the camera that are averaged for a photograph.
    power
        Largest share of the power on the receiver that the movements may cost.
    steady
        Largest change of the light on the receiver between photographs, as a share of it.
    worth
        Least change of a beam, rad RMS, for which its heliostat leaves the receiver for new
        parameters.
    every
        Least time between two visits of a heliostat that automatic control begins, s.
    """

    kind: ClassVar[str] = "receiver visits"
    fewest: ClassVar[int] = 1
    most_movement: ClassVar[float] = 2e-3

    camera: str = field(kw_only=False)
    receiver: str = field(kw_only=False)
    most: int = 50
    least: int = 8
    movement: float = 1e-3
    again: float = 1.5
    exposures: int = 1
    power: float = 0.005
    steady: float = 0.05
    worth: float = 3e-4
    every: float = 7200.0

    def __post_init__(self) -> None:
        self._check()
        if not 0.0 < self.power <= MOST_POWER:
            raise InputError(
                f"{self.kind}: movements that cost {100.0 * self.power:g} % of the power; give "
                f"above 0 to {100.0 * MOST_POWER:g} %"
            )
        if not (self.known <= 0.02 and self.again <= 10.0):
            raise InputError(
                f"{self.kind}: beams known to {1e3 * self.known:g} mrad, {self.again:g} times the "
                "photographs; give up to 20 mrad, and up to 10"
            )
        if not (self.worth >= 0.0 and self.every >= 0.0):
            raise InputError(
                f"{self.kind}: new parameters from {1e3 * self.worth:g} mrad, a heliostat every "
                f"{self.every:g} s; give 0 or more twice"
            )
        if not (1 <= self.exposures <= 100 and 0.0 < self.steady <= 0.5):
            raise InputError(
                f"{self.kind}: {self.exposures} frames for a photograph, light that changes by "
                f"{100.0 * self.steady:g} %; give 1 to 100, and above 0 to 50 %"
            )
