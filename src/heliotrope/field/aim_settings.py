"""How a plant chooses the aims of its heliostats on the receiver."""

from dataclasses import dataclass
from typing import Literal

from heliotrope.errors import InputError
from heliotrope.field.flux_limit import FluxLimit

#: Strategies for choosing aims.
AIM_STRATEGIES = ("spread", "limit")


@dataclass(frozen=True, eq=False)
class AimSettings:
    """How a plant chooses aims.

    Attributes
    ----------
    strategy
        "spread": the aims of the plant file, or the receiver's middle; "limit": the aims of maximum
        power that keep the flux under a limit.
    limit
        Allowable flux, with its margin; None for the strategy "spread".
    map
        Name of the file from which the limit was read; "": the limit is a number.
    probability
        Probability that the limit holds in all cells at once, 0.5 to 0.9999.
    drift, clock, cluster
        Errors that heliostats share, as standard deviations: rad, s, rad; see
        `heliotrope.aims.SharedErrors`.
    dni
        Direct normal irradiance, W/m², at which the limit must hold, even if less is measured,
        because a cloud may move away at any moment.
    ramp
        Greatest rise of the flux in a cell, W/m² per s, while the receiver is heated after standby
        or a cloud; 0: no ramp.
    moves
        Maximum number of tracking heliostats per minute that get a new aim.
    together
        Maximum number of heliostats that move at the same time.
    every
        Time between two computations, s.
    deadline
        Time within which aims must be computed, s; when the last good aims are five times as old,
        the field goes to the safe spread.

    Raises
    ------
    InputError
        If a number is out of range, or a limit is missing or superfluous.
    """

    strategy: Literal["spread", "limit"] = "spread"
    limit: FluxLimit | None = None
    map: str = ""
    probability: float = 0.99
    drift: float = 0.0
    clock: float = 0.0
    cluster: float = 0.0
    dni: float = 1000.0
    ramp: float = 0.0
    moves: float = 60.0
    together: int = 5
    every: float = 30.0
    deadline: float = 120.0

    def __post_init__(self) -> None:
        if self.strategy not in AIM_STRATEGIES:
            raise InputError(
                f"aims: unknown strategy {self.strategy!r}; use one of {', '.join(AIM_STRATEGIES)}"
            )
        if self.strategy == "limit" and self.limit is None:
            raise InputError('aims: strategy "limit" needs limit_kw_m2, limit_map or limit_table')
        if self.strategy == "spread" and self.limit is not None:
            raise InputError('aims: a flux limit needs strategy = "limit"; add it, or remove it')
        ranges = {
            "probability": (self.probability, 0.5, 0.9999, ""),
            "drift_mrad": (1e3 * self.drift, 0.0, 50.0, " mrad"),
            "clock_s": (self.clock, 0.0, 600.0, " s"),
            "cluster_mrad": (1e3 * self.cluster, 0.0, 50.0, " mrad"),
            "dni_w_m2": (self.dni, 1.0, 1500.0, " W/m²"),
            "ramp_kw_m2_min": (0.06 * self.ramp, 0.0, 64000.0, " kW/m² per minute"),
            "moves_per_minute": (self.moves, 1.0, 6000.0, ""),
            "together": (self.together, 1, 1000, ""),
            "every_s": (self.every, 5.0, 600.0, " s"),
            "deadline_s": (self.deadline, 2.0 * self.every, 3600.0, " s"),
        }
        for key, (value, low, high, unit) in ranges.items():
            if not low <= value <= high:
                raise InputError(
                    f"aims: {key} must be between {low:g} and {high:g}{unit}, not {value:g}{unit}"
                )
