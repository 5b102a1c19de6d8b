"""Aims of a plant's heliostats under a flux limit, and other strategies for comparison."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.aims.errors import SharedErrors
from heliotrope.aims.optimiser import Step
from heliotrope.aims.ramp import ramp_up
from heliotrope.aims.scene_aims import Demand, SceneAims, aim_scene, deviation
from heliotrope.aims.strategies import STRATEGIES, Strategy
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.flux_limit import FluxLimit
from heliotrope.field.plant import Plant
from heliotrope.frames import ENU, Framed, Labelled, Variable
from heliotrope.geometry import FloatArray, as_float
from heliotrope.optics.plant_flux import FieldOptics, PlantFlux, one_sun, result_of
from heliotrope.optics.plant_scene import no_receiver
from heliotrope.sun import Times
from heliotrope.values import Card, Value, amount


@dataclass(frozen=True, eq=False, repr=False)
class AimPlan(Value, Framed):
    """Aims of N heliostats, and the resulting flux.

    Attributes
    ----------
    strategy
        One of `STRATEGIES`.
    light
        Flux and efficiencies at these aims, which are in its ``aim``. Defocused heliostats send no
        light.
    defocused
        Heliostats that are defocused, (N,).
    out_of_reach
        Heliostats that cannot reach the receiver, (N,).
    elsewhere
        Heliostats that belong to another receiver, (N,).
    lost_mirrors
        Heliostats that are lost: out of service, or in a cluster that is, (N,).
    unlimited
        Power with every heliostat aimed at the middle of the receiver, W.
    scene
        All computed results, for use as a ``start``.
    """

    strategy: Strategy
    light: PlantFlux
    defocused: npt.NDArray[np.bool_]
    out_of_reach: npt.NDArray[np.bool_]
    elsewhere: npt.NDArray[np.bool_]
    lost_mirrors: npt.NDArray[np.bool_]
    unlimited: float
    scene: SceneAims

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the heliostats."""
        return self.light.names

    @property
    def aim(self) -> FloatArray:
        """Aims, ENU m, (N, 3); NaN for heliostats that are not to light this receiver."""
        off = self.defocused | self._unable | self.unlit
        return np.where(off[:, None], np.nan, self.light.aim)

    @property
    def _unable(self) -> npt.NDArray[np.bool_]:
        return np.asarray(self.out_of_reach | self.elsewhere | self.lost_mirrors)

    @property
    def unlit(self) -> npt.NDArray[np.bool_]:
        """Heliostats that send no light to any cell of the receiver, wherever they aim, (N,)."""
        dark = self.scene.field.power.max(axis=1) <= 0.0
        return np.asarray(dark & ~self._unable)

    @property
    def states(self) -> list[str]:
        """What each heliostat does, N words: "aim", or why it does not."""
        reasons = {
            "defocus": self.defocused,
            "lost": self.lost_mirrors,
            "other receiver": self.elsewhere,
            "reaches no cell": self.unlit,
            "out of reach": self.out_of_reach,
        }
        return [
            next((r for r, mask in reasons.items() if mask[k]), "aim")
            for k in range(len(self.names))
        ]

    @property
    def power(self) -> float:
        """Expected power, W."""
        return self.light.power

    @property
    def lost(self) -> float:
        """Power lost to the limit or to the strategy, W."""
        return self.unlimited - self.power

    @property
    def gap(self) -> float:
        """Upper bound on the power that better aims could add, as a fraction; NaN if unknown."""
        return self.scene.gap

    @property
    def excess(self) -> float:
        """Largest ratio of the flux quantile to the limit, minus 1; not above 0 if it holds."""
        return self.scene.excess

    @property
    def quantile(self) -> FloatArray:
        """Flux that no cell exceeds, with the chosen probability, W/m², (rows, columns)."""
        return self.scene.quantile

    @property
    def limit(self) -> FloatArray:
        """Allowable flux in each cell minus the margin, W/m², (rows, columns)."""
        return self.scene.limit

    @property
    def binding(self) -> npt.NDArray[np.bool_]:
        """Cells whose flux quantile is within 1 % of the limit or above it, (rows, columns)."""
        return self.scene.binding

    @property
    def price(self) -> FloatArray:
        """Power that a higher limit of each cell would add, W per W/m², (rows, columns).

        It holds for small changes; zero if the strategy ignores the limit.
        """
        return as_float(self.scene.choice.prices.T)

    @property
    def cells(self) -> FloatArray:
        """Centres of the cells, ENU m, (rows, columns, 3)."""
        (surface,) = self.light.surfaces
        return surface.cells.center.reshape(*self.limit.shape, 3)

    @property
    def gain(self) -> FloatArray:
        """Power that a perfect calibration of each heliostat would add, W, (N,)."""
        return self.scene.gain

    def deviation(self, wanted: "FluxLimit | npt.ArrayLike") -> float:
        """Return the RMS difference between the flux and a wanted map, divided by the mean.

        The wanted map is scaled to the same mean.
        """
        flux = self.light.flux
        return deviation(flux, FluxLimit.of(wanted).on(*flux.shape))

    def ramp_up(self, rate: float, step: float = 60.0) -> FloatArray:
        """Return when each heliostat joins along a ramp, s; see `heliotrope.aims.ramp_up`."""
        return ramp_up(self.scene, rate, step)

    def _card(self) -> Card:
        line = f"{self.strategy} aims of {amount(len(self.names), 'heliostat')} of "
        line += f"{self.light.plant}, {1e-3 * self.power:.5g} kW, "
        line += f"peak {1e-3 * self.light.peak:.4g} kW/m², "
        if np.isfinite(self.gap):
            line += f"within {100 * self.gap:.2g} % of the best, "
        return Card(f"{line}{int(self.defocused.sum())} defocused")

    def _labelled(self) -> Labelled:
        row, cells = ("heliostat",), ("up", "right")
        variables = {
            "aim": Variable((*row, "axis"), self.aim, "m"),
            "defocused": Variable(row, self.defocused),
            "power": Variable(row, self.light.heliostat_power, "W"),
            "gain": Variable(row, self.gain, "W"),
            "flux": Variable(cells, self.light.flux, "W/m²"),
            "quantile": Variable(cells, self.quantile, "W/m²"),
            "limit": Variable(cells, self.limit, "W/m²"),
            "binding": Variable(cells, self.binding),
            "price": Variable(cells, self.price, "m²"),
        }
        labels: dict[str, npt.ArrayLike] = {
            "heliostat": self.names, "axis": ENU, "up": self.light.up, "right": self.light.right,
        }  # fmt: skip
        maps = frozenset({"flux", "quantile", "limit", "binding", "price"})
        notes = {"plant": self.light.plant, "strategy": self.strategy}
        return Labelled(row, labels, variables, maps, notes=notes)


def plan_aims(
    plant: Plant,
    time: Times | None = None,
    receiver: str = "",
    *,
    limit: "FluxLimit | npt.ArrayLike",
    sun: npt.ArrayLike | None = None,
    strategy: Strategy = "optimal",
    probability: float = 0.99,
    shared: SharedErrors | None = None,
    keep: bool = False,
    wanted: "FluxLimit | npt.ArrayLike | None" = None,
    give: float = 0.01,
    without: Iterable[str] = (),
    start: AimPlan | None = None,
    progress: Step | None = None,
    light: FieldOptics | None = None,
    **changes: Any,
) -> AimPlan:
    """Return the aims with the most expected power that keep the flux under a limit.

    Parameters
    ----------
    plant
        The plant, with its calibrated mechanisms.
    time, sun
        Exactly one of the two, as for `heliotrope.optics.field_flux`.
    receiver
        Name; "": the plant's first. If the plant has several receivers, a heliostat belongs to the
        one to which its aim in the plant file is closest, or to the first without such an aim.
    limit
        W/m²: a number, a map, or a `FluxLimit`.
    strategy
        "optimal"; or for comparison "middle", "spread" or "image-size", which ignore the limit, or
        "gradient", which may exceed it.
    probability
        Probability that the limit holds in all cells at once, 0.5 to 0.9999.
    shared
        Errors that mirrors share; None: there are none. Each mirror's own error is ``error`` of the
        light.
    keep
        Whether no heliostat may be defocused.
    wanted
        Wanted flux: a map, or a number for a uniform flux; only the ratios between cells matter.
        None: the most power, however it is distributed.
    give
        Fraction of the power that may be sacrificed for the wanted map, 0 to 0.5.
    without
        Lost heliostats and clusters, one name or several; they send no light.
    start
        A plan of the same plant and receiver for another sun position, irradiance or limit, or with
        other heliostats lost, from which the search begins.
    progress
        Called with the amount of work done and the total.
    light, **changes
        As for `heliotrope.optics.field_flux`.

    Raises
    ------
    InputError
        As for `field_flux`, or if no aims respect the limit.
    UnknownNameError
        If there is no receiver, option, strategy, heliostat or cluster of that name.
    """
    if strategy not in STRATEGIES:
        raise UnknownNameError("strategy", strategy, STRATEGIES)
    optics = (light or FieldOptics()).changed(changes)
    if not plant.receivers:
        raise no_receiver(plant, "aims")
    chosen = receiver or plant.receivers[0].name
    middle = plant.receiver(chosen).center
    scene = optics.scene(plant, one_sun(plant, time, sun), middle, (chosen,))
    lost = _named(plant, without)
    others = _elsewhere(plant, chosen) & ~lost
    beyond = np.zeros_like(others) if scene.dark is None else scene.dark
    off = beyond | others | lost
    if off.all():
        belong = f", and {others.sum()} belong to other receivers" if others.any() else ""
        belong += f", and {lost.sum()} are lost" if lost.any() else ""
        raise InputError(
            f"aims: none of the {len(plant)} heliostats can reach receiver {chosen}{belong}; "
            "choose another receiver or sun position"
        )
    scene = replace(scene, dark=off)
    latitude = np.radians(plant.site.latitude_deg)
    demand = Demand(
        FluxLimit.of(limit),
        probability,
        shared or SharedErrors(),
        np.unique(plant.cluster, return_inverse=True)[1],
        np.array([0.0, np.cos(latitude), np.sin(latitude)]),
        keep,
        None if wanted is None else FluxLimit.of(wanted),
        give,
    )
    aimed = aim_scene(
        scene, demand, strategy=strategy, start=None if start is None else start.scene,
        progress=progress, sun=optics.shape, air=optics.air, gaussians=optics.gaussians,
    )  # fmt: skip
    result = result_of(plant, aimed.engine.scene, aimed.engine)
    lit = aimed.field.power.max(axis=1) > 0.0
    defocused, unlimited = aimed.defocused & ~off & lit, aimed.field.middle_power
    beyond = beyond & ~others & ~lost
    return AimPlan(strategy, result, defocused, beyond, others, lost, unlimited, aimed)


def _named(plant: Plant, names: Iterable[str]) -> npt.NDArray[np.bool_]:
    """Return a mask of the heliostats that are named, or whose cluster is, (N,)."""
    mask, clusters = np.zeros(len(plant), dtype=np.bool_), np.array(plant.cluster)
    heliostats = np.array(plant.names)
    for name in (names,) if isinstance(names, str) else names:
        here = (heliostats == name) | ((clusters == name) & (clusters != ""))
        if not here.any():
            known = (*np.unique(clusters[clusters != ""]).tolist(), *plant.names)
            raise UnknownNameError("heliostat or cluster", name, known)
        mask |= here
    return mask


def _elsewhere(plant: Plant, receiver: str) -> npt.NDArray[np.bool_]:
    """Return a mask of the heliostats that belong to another receiver than the given one, (N,)."""
    centers = np.array([each.center for each in plant.receivers])
    own = [
        g.aim if g.aim is not None else np.full((len(g), 3), np.nan) for g in plant.groups.values()
    ]
    away = np.linalg.norm(np.concatenate(own)[:, None] - centers, axis=-1)
    nearest = np.nan_to_num(away).argmin(axis=1)
    return np.asarray(nearest != [each.name for each in plant.receivers].index(receiver))


def compare_aims(plans: Mapping[Any, AimPlan]) -> list[dict[str, Any]]:
    """Return one table row for each plan: power, peak, quantile over limit, defocused, gap."""
    return [
        {
            "strategy": name,
            "power_w": plan.power,
            "lost_w": plan.lost,
            "peak_w_m2": plan.light.peak,
            "excess": plan.excess,
            "defocused": int(plan.defocused.sum()),
            "gap": plan.gap,
        }
        for name, plan in plans.items()
    ]
