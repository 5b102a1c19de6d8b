"""Settings of coded visits: several heliostats measured at once, identified by their movements.

These settings belong to a plant, because they depend on its targets, receiver, heliostats and
drives. Each number is defined once, in this module, with its unit in the plant file, its limits and
its meaning.
"""

import math
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

from heliotrope.errors import InputError


@dataclass(frozen=True)
class Setting:
    """A number of the plant file.

    Attributes
    ----------
    text
        Its meaning, for display.
    low, high
        Limits of the number, in its unit.
    unit
        Unit in the plant file: "mrad", "s" or "suns"; "" for a count or a fraction.
    above
        Whether the number must be above ``low``, not equal to it.
    """

    text: str
    low: float
    high: float = math.inf
    unit: str = ""
    above: bool = False

    @property
    def scale(self) -> float:
        """The unit in terms of the program's own units, radians and seconds."""
        return 1e-3 if self.unit == "mrad" else 1.0

    def key(self, name: str) -> str:
        """Return the key of the setting in the plant file."""
        return f"{name}_{self.unit}" if self.unit else name

    def check(self, kind: str, name: str, value: float) -> None:
        """Raise InputError if a value is not within the limits."""
        given = value / self.scale
        if not self.low <= given <= self.high or (self.above and given == self.low):
            if self.high == math.inf:
                limits = f"above {self.low:g}" if self.above else f"{self.low:g} or more"
            elif self.above:
                limits = f"above {self.low:g} and at most {self.high:g}"
            else:
                limits = f"between {self.low:g} and {self.high:g}"
            raise InputError(
                f"{kind}: {self.key(name)} ({self.text}) must be {limits}, not {given:g}"
            )


def _number(default: float, *given: Any, **named: Any) -> Any:
    """Return a dataclass field whose default is in the unit of the plant file; see `Setting`."""
    setting = Setting(*given, **named)
    value = default * setting.scale if setting.unit else default
    return field(default=value, metadata={"setting": setting})


@dataclass(frozen=True, kw_only=True)
class CodedSettings:
    """Settings of all coded visits, to targets and to a receiver.

    Angles are in radians and times in seconds; `settings` describes each number.
    """

    #: Name of the visits, for display.
    kind: ClassVar[str]

    most: int
    least: int
    known: float = _number(
        4.0,
        "largest expected beam error of a participating heliostat, RMS",
        0,
        unit="mrad",
        above=True,
    )
    visit: float = _number(
        0.5,
        "part of this error that changes at random from visit to visit, per axis",
        0,
        unit="mrad",
    )
    movement: float
    settle: float = _number(
        1.0,
        "time from the arrival of the last heliostat to the photograph",
        0,
        60,
        "s",
    )
    again: float

    def __post_init__(self) -> None:
        for name, setting in self.settings().items():
            setting.check(self.kind, name, getattr(self, name))
        if not self.least <= self.most:
            raise InputError(
                f"{self.kind}: least {self.least} is above most {self.most}; least must be the "
                "smaller number"
            )

    @classmethod
    def settings(cls) -> dict[str, Setting]:
        """Return the metadata of each number, by attribute name."""
        found = {one.name: one.metadata.get("setting") for one in fields(cls)}
        return {name: setting for name, setting in found.items() if setting is not None}

    @property
    def most_movement(self) -> float:
        """Largest movement that a beam may make, rad."""
        setting = self.settings()["movement"]
        return setting.high * setting.scale


@dataclass(frozen=True, kw_only=True)
class JointSettings(CodedSettings):
    """Settings of joint visits: several heliostats on one target at once; see `CodedSettings`."""

    kind: ClassVar[str] = "joint visits"

    most: int = _number(49, "maximum number of heliostats on one target at once", 2, 127)
    least: int = _number(4, "minimum number of heliostats for a visit by automatic control", 2, 127)
    movement: float = _number(
        0.5,
        "coded movement of a beam, in both directions along each axis",
        0,
        5,
        "mrad",
        above=True,
    )
    again: float = _number(
        2.5, "maximum number of photographs, as a multiple of the number that a visit needs", 1
    )
    brightest: float = _number(10.0, "maximum irradiance on a target", 0, unit="suns", above=True)
    first: int = _number(
        15,
        "maximum number of heliostats without a calibration at once; 0: measure each separately",
        0,
        127,
    )
    first_movement: float = _number(
        2.0, "coded movement of their beams, to the right and to the left", 0, 5, "mrad", above=True
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 < self.first < self.least:
            raise InputError(
                f"{self.kind}: the number of heliostats without a calibration must be 0, or "
                f"{self.least} to 127, not {self.first}"
            )


@dataclass(frozen=True, kw_only=True)
class ReceiverSettings(CodedSettings):
    """Settings of receiver visits: heliostats measured as they track it; see `CodedSettings`.

    Attributes
    ----------
    camera
        Name of the camera that sees the whole receiver; the position of the camera must be known.
    receiver
        Name of the receiver, which must be planar.
    """

    kind: ClassVar[str] = "receiver visits"

    camera: str = field(kw_only=False)
    receiver: str = field(kw_only=False)
    most: int = _number(50, "maximum number of heliostats at once", 1, 127)
    least: int = _number(8, "minimum number of heliostats for a visit by automatic control", 1, 127)
    known: float = _number(
        4.0,
        "largest expected beam error of a participating heliostat, RMS",
        0,
        20,
        "mrad",
        above=True,
    )
    movement: float = _number(
        1.0,
        "coded movement of a beam, in both directions along each axis",
        0,
        2,
        "mrad",
        above=True,
    )
    again: float = _number(
        1.5, "maximum number of photographs, as a multiple of the number that a visit needs", 1, 10
    )
    exposures: int = _number(1, "frames that are averaged for a photograph", 1, 100)
    power: float = _number(
        0.005, "largest fraction of the power that the movements may cost", 0, 0.01, above=True
    )
    steady: float = _number(
        0.05, "largest relative change of the light between photographs", 0, 0.5, above=True
    )
    worth: float = _number(
        0.3,
        "smallest correction of a beam for which its heliostat leaves the receiver",
        0,
        unit="mrad",
    )
    every: float = _number(7200.0, "shortest time between two visits of a heliostat", 0, unit="s")
