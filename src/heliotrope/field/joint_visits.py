"""Settings of joint visits, which belong to a plant: its targets, its mirrors, its drives."""

from dataclasses import dataclass

from heliotrope.errors import InputError

#: Largest coded movement of a beam, either way, rad.
MOST_MOVEMENT = 5e-3


@dataclass(frozen=True)
class JointSettings:
    """Settings of joint visits: several heliostats on one target, told apart by their movements.

    Attributes
    ----------
    most, least
        Heliostats on one target at once; and how many a visit needs that automatic control begins.
    known
        Largest expected beam error of a heliostat that takes part, rad RMS (2-D).
    visit
        Part of it that is drawn anew at each visit, rad per axis.
    movement
        Coded movement of a beam, either way along each axis, rad; a heliostat whose drives move its
        beam in steps of more than half of it moves by two steps.
    settle
        Time from the moment that all have taken their aims until the photograph, s.
    brightest
        Most light on a target, in suns.
    again
        Photographs that are taken at most, as a multiple of those that a visit needs.
    first
        Heliostats without a calibration on one target at once; 0: each goes alone.
    first_movement
        Coded movement of their beams, either way to the right, rad.
    """

    most: int = 49
    least: int = 4
    known: float = 4e-3
    visit: float = 5e-4
    movement: float = 5e-4
    settle: float = 1.0
    brightest: float = 10.0
    again: float = 2.5
    first: int = 63
    first_movement: float = 2e-3

    def __post_init__(self) -> None:
        if not 2 <= self.least <= self.most <= 127:
            raise InputError(
                f"joint visits: {self.least} to {self.most} heliostats; give 2 to 127, the smaller "
                "number first"
            )
        if not 0.0 < self.movement <= MOST_MOVEMENT or not 0.0 <= self.settle <= 60.0:
            raise InputError(
                f"joint visits: movements of {1e3 * self.movement:g} mrad that settle in "
                f"{self.settle:g} s; give above 0 to {1e3 * MOST_MOVEMENT:g} mrad, and 0 to 60 s"
            )
        if not (self.first == 0 or self.least <= self.first <= 127):
            raise InputError(
                f"joint visits: {self.first} heliostats without a calibration; give 0, or "
                f"{self.least} to 127"
            )
        if not 0.0 < self.first_movement <= MOST_MOVEMENT:
            raise InputError(
                f"joint visits: first movements of {1e3 * self.first_movement:g} mrad; give above "
                f"0 to {1e3 * MOST_MOVEMENT:g} mrad"
            )
        if not (self.brightest > 0.0 and self.known > 0.0 and self.again >= 1.0):
            raise InputError(
                f"joint visits: up to {self.brightest:g} suns, beams known to "
                f"{1e3 * self.known:g} mrad, {self.again:g} times the photographs; give above 0, "
                "above 0, and 1 or more"
            )
