"""Settings of receiver visits: heliostats in production, measured where they shine."""

from dataclasses import dataclass

from heliotrope.errors import InputError

#: Largest share of the power that the movements may cost.
MOST_POWER = 0.01
#: Largest coded movement of a beam, either way, rad.
MOST_MOVEMENT = 2e-3


@dataclass(frozen=True)
class ReceiverSettings:
    """Settings of receiver visits: mirrors that track the receiver, told apart by their movements.

    Attributes
    ----------
    camera
        Name of the camera that sees the whole receiver; its position is known.
    receiver
        Name of the receiver, which is planar.
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
    exposures
        Frames of the camera that are averaged for a photograph.
    power
        Largest share of the power on the receiver that the movements may cost.
    steady
        Largest change of the light on the receiver between photographs, as a share of it.
    again
        Photographs that are taken at most, as a multiple of those that a visit needs.
    worth
        Least change of a beam, rad RMS, for which its heliostat leaves the receiver for new
        parameters.
    every
        Least time between two visits of a heliostat that automatic control begins, s.
    """

    camera: str
    receiver: str
    most: int = 50
    least: int = 8
    known: float = 4e-3
    visit: float = 5e-4
    movement: float = 1e-3
    settle: float = 1.0
    exposures: int = 1
    power: float = 0.005
    steady: float = 0.05
    again: float = 1.5
    worth: float = 3e-4
    every: float = 7200.0

    def __post_init__(self) -> None:
        who = "receiver visits"
        if not 1 <= self.least <= self.most <= 127:
            raise InputError(
                f"{who}: {self.least} to {self.most} heliostats; give 1 to 127, the smaller number "
                "first"
            )
        if not 0.0 < self.movement <= MOST_MOVEMENT or not 0.0 <= self.settle <= 60.0:
            raise InputError(
                f"{who}: movements of {1e3 * self.movement:g} mrad that settle in {self.settle:g} "
                f"s; give above 0 to {1e3 * MOST_MOVEMENT:g} mrad, and 0 to 60 s"
            )
        if not 0.0 < self.power <= MOST_POWER:
            raise InputError(
                f"{who}: movements that cost {100.0 * self.power:g} % of the power; give above 0 "
                f"to {100.0 * MOST_POWER:g} %"
            )
        if not (0.0 < self.known <= 0.02 and self.visit >= 0.0 and self.worth >= 0.0):
            raise InputError(
                f"{who}: beams known to {1e3 * self.known:g} mrad, {1e3 * self.visit:g} mrad of it "
                f"drawn anew, new parameters from {1e3 * self.worth:g} mrad; give above 0 to 20 "
                "mrad, and 0 or more twice"
            )
        if not (1 <= self.exposures <= 100 and 0.0 < self.steady <= 0.5):
            raise InputError(
                f"{who}: {self.exposures} frames for a photograph, light that changes by "
                f"{100.0 * self.steady:g} %; give 1 to 100, and above 0 to 50 %"
            )
        if not (1.0 <= self.again <= 10.0 and self.every >= 0.0):
            raise InputError(
                f"{who}: {self.again:g} times the photographs, a heliostat every {self.every:g} s; "
                "give 1 to 10, and 0 s or more"
            )
