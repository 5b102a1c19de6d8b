"""Aims of a scene under a flux limit, found by repeated choice and correction.

The optimiser adds images that were computed once, at a few places, and are shifted by whole rows.
The engine then computes the flux at the aims that were chosen, and its quantile under pointing
errors. The difference is subtracted from the limit and the choice is repeated, until the quantile
of the engine's own flux respects the limit.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from heliotrope.aims.candidates import Candidates, candidates, middles, surface_in
from heliotrope.aims.errors import Risk, SharedErrors, assess, gains
from heliotrope.aims.gradient import ascend
from heliotrope.aims.optimiser import GAP, SWEEPS, Choice, Step, optimise
from heliotrope.aims.strategies import Strategy, choose
from heliotrope.errors import InputError
from heliotrope.field.flux_limit import FluxLimit
from heliotrope.geometry import FloatArray, as_float
from heliotrope.optics.receiver_flux import FieldFlux
from heliotrope.optics.scene import Scene
from heliotrope.optics.shading import IntArray

#: Maximum number of choices; the limit is approached from this share below it.
ROUNDS, BELOW = 16, 5e-4
#: Rounds in which cells may regain room; afterwards no mirror moves unnecessarily.
FREE = 5
#: From then on the remaining excess times this factor is subtracted from the limit.
BEYOND = 1.5
#: Number of steps in which the limits that would hold are found.
RAISES = 8
#: Minimum share of the limit left to the next choice after errors; excess that counts as zero.
LEAST, HOLDS = 0.02, 1e-3
#: Sweeps of every choice after the first, and the gap with which a choice from a start ends.
AGAIN, LATER_GAP = 2, 2e-3
#: Rounds in which the charge for own errors is adjusted, if their standard deviation is above this
#: share of the limit anywhere.
CHARGING, CHARGED = 3, 0.03
#: A cell binds if its quantile is within this share of the limit.
BINDS = 0.01
#: Ratio of two levels of a wanted map between which no further one is tried.
CLOSE = 1.01


@dataclass(frozen=True, eq=False)
class Demand:
    """Requirements that the aims of a scene must meet.

    Attributes
    ----------
    limit
        Flux limit.
    probability
        Probability that the limit holds in all cells at once.
    shared
        Errors that mirrors share; each mirror's own error is its ``pointing``.
    groups
        Cluster of each mirror, 0 to G − 1, (H,); None: one cluster.
    pole
        Unit vector along the Earth's axis, northwards, (3,).
    keep
        Whether no mirror may be defocused.
    wanted
        Wanted flux, a map or a number (uniform); only the ratios between cells matter. None: the
        most power, however it is distributed.
    give
        Fraction of the power that may be sacrificed for the wanted map, 0 to 0.5.
    """

    limit: FluxLimit
    probability: float = 0.99
    shared: SharedErrors = field(default_factory=SharedErrors)
    groups: IntArray | None = None
    pole: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    keep: bool = False
    wanted: FluxLimit | None = None
    give: float = 0.01

    def __post_init__(self) -> None:
        if not 0.0 <= self.give <= 0.5:
            raise InputError(
                f"aims: {100 * self.give:g} % of the power cannot be given up for a desired flux "
                "map; use 0 to 50 %"
            )
        if not 0.5 <= self.probability <= 0.9999:
            raise InputError(
                f"aims: a probability of {self.probability:g} must be from 0.5 to 0.9999"
            )


@dataclass(frozen=True, eq=False)
class SceneAims:
    """Aims of the H mirrors of a scene.

    Attributes
    ----------
    engine
        Flux at these aims; defocused mirrors are dark.
    field, choice
        The candidates, and the choice of a candidate for each mirror.
    aims
        Aims, ENU m, (H, 3); the aims of defocused mirrors are at half height.
    defocused
        (H,).
    dark
        Mirrors that the scene had dark; they have no images, (H,).
    limit
        Allowable flux in each cell minus the margin, W/m², (rows, columns).
    risk
        Uncertainty of the flux.
    light
        Arguments of `FieldFlux` other than the scene.
    """

    engine: FieldFlux
    field: Candidates
    choice: Choice
    aims: FloatArray
    defocused: npt.NDArray[np.bool_]
    dark: npt.NDArray[np.bool_]
    limit: FloatArray
    risk: Risk
    light: dict[str, Any]

    @property
    def quantile(self) -> FloatArray:
        """Flux that no cell exceeds, with the chosen probability, W/m², (rows, columns)."""
        return as_float(self.engine.maps[0] + self.risk.above)

    @property
    def excess(self) -> float:
        """Largest ratio of the quantile to the limit, minus 1; at most 0 if the limit holds."""
        return float((self.quantile / self.limit).max()) - 1.0

    @property
    def gap(self) -> float:
        """Upper bound on the power that other candidates could add, as a fraction; NaN if unknown.

        The fraction refers to the lower of two powers: the images', to which the bound belongs, and
        the engine's, which includes shading and blocking at these aims.
        """
        power = min(self.choice.power, self.engine.powers[0])
        return self.choice.bound / power - 1.0 if power > 0.0 else np.inf

    @cached_property
    def gain(self) -> FloatArray:
        """Power that a perfect calibration of each mirror would add, W, (H,)."""
        return gains(self.engine, self.risk, self.choice.prices.T)

    @property
    def binding(self) -> npt.NDArray[np.bool_]:
        """Cells that the limit binds, (rows, columns)."""
        return np.asarray(self.quantile > (1.0 - BINDS) * self.limit)


def aim_scene(
    scene: Scene,
    demand: Demand,
    *,
    strategy: Strategy = "optimal",
    room: FloatArray | None = None,
    start: SceneAims | None = None,
    progress: Step | None = None,
    **light: Any,
) -> SceneAims:
    """Return the aims of maximum power under a flux limit, or the aims of another strategy.

    Parameters
    ----------
    scene
        Has one receiver; its aims are ignored.
    demand
        The limit, and the probability with which the limit must hold.
    strategy
        One of `heliotrope.aims.STRATEGIES`. Only "optimal" keeps the limit; "gradient" may exceed
        it, and the others ignore it.
    room
        What other beams leave of the limit, W/m², (rows, columns); None: all of it.
    start
        Aims of the same mirrors and receiver at another sun, irradiance or limit, or with other
        mirrors in ``dark``: their images are used again, which takes a fraction of the time. If a
        mirror is no longer dark, all images are computed again.
    progress
        Called with the amount of work done and the total.
    **light
        Arguments of `FieldFlux`.

    Raises
    ------
    InputError
        If there is not exactly one receiver, no mirror reaches the receiver, the limit allows not
        even one beam with its errors, or no aims respect the limit with every mirror kept.
    """
    rows, columns = surface_in(scene).shape
    limit = demand.limit.on(rows, columns) if room is None else room
    if start is None or not _usable(start, scene):
        start = None
        base = FieldFlux(_posed(scene, middles(scene), None), **light)
        base.check_met()
        field = candidates(base)
    else:
        base = FieldFlux(_posed(scene, start.aims, start.defocused), **light)
        field = _relit(start, base, scene)
    if strategy == "gradient":
        return _ascended(base.scene, field, demand, limit, progress, light)
    if strategy != "optimal":
        chosen = choose(field, base.scene, strategy)
        power = float(field.power[np.arange(len(chosen)), chosen].sum())
        choice = Choice(chosen, np.zeros((columns, rows)), field.flux(chosen), power, np.nan)
        return _evaluated(scene, field, choice, demand, limit, light)
    best = _closest(scene, field, demand, limit, start, progress, light)
    best = _held(scene, best, demand, light)
    return best if demand.wanted is None else _shaped(scene, best, demand, light)


def _shaped(scene: Scene, best: SceneAims, demand: Demand, light: dict[str, Any]) -> SceneAims:
    """Return aims whose flux is under the lowest possible multiple of the wanted map.

    The multiple is the lowest that keeps the power, apart from the fraction that may be sacrificed.
    The less room there is above the wanted map, the more cells are filled up to the map.
    """
    assert demand.wanted is not None
    wanted = demand.wanted.on(*best.limit.shape)
    power = (1.0 - demand.give) * best.engine.powers[0]
    low = power / float(wanted.sum() * best.field.images.area)
    high = float((best.quantile / wanted).max())
    held = best
    while high > CLOSE * low:
        level = float(np.sqrt(low * high))
        cap = as_float(np.minimum(best.limit, level * wanted))
        trial = _closest(scene, best.field, demand, cap, held, None, light)
        if trial.excess <= HOLDS and trial.engine.powers[0] >= power:
            held, high = trial, level
        else:
            low = level
    # The bound on the power is that of the limit.
    choice = replace(held.choice, bound=best.choice.bound)
    return replace(held, choice=choice, limit=best.limit)


def deviation(flux: FloatArray, wanted: FloatArray) -> float:
    """Return the RMS difference between a flux and a wanted map, divided by the mean.

    The wanted map is scaled to the same mean.
    """
    return float(np.sqrt(np.mean((flux / flux.mean() - wanted / wanted.mean()) ** 2)))


def _held(scene: Scene, best: SceneAims, demand: Demand, light: dict[str, Any]) -> SceneAims:
    """Return the aims that `_closest` found, which must respect the limit.

    If every mirror is off, only the beam with the lowest peak shines.

    Raises
    ------
    InputError
        If no aims respect the limit.
    """
    if best.excess > HOLDS:
        advice = "let heliostats be defocused" if demand.keep else "ask for a lower probability"
        what = "no aims were found that respect the flux limit"

        def again(raised: FloatArray) -> SceneAims:
            return _closest(scene, best.field, demand, raised, None, None, light)

        _refuse(scene, best, demand, again, what, f", or {advice}")
    if (best.choice.choice < 0).all():
        return _one_beam(scene, best.field, demand, best.limit, light)
    return best


def _closest(
    scene: Scene,
    field: Candidates,
    demand: Demand,
    limit: FloatArray,
    start: SceneAims | None,
    progress: Step | None,
    light: dict[str, Any],
) -> SceneAims:
    """Return the aims of maximum power under a limit, or the aims that exceed it least."""
    aimed_at = (1.0 - BELOW) * limit
    # Difference between the engine's flux quantile and the sum of the images.
    more = np.zeros_like(limit)
    gap = GAP if start is None else LATER_GAP
    choice = None if start is None else start.choice
    if start is not None:
        # Relative to the light, which may have changed.
        light_now = field.flux(start.choice.choice).sum() / max(start.choice.flux.sum(), 1e-300)
        more = light_now * (start.quantile - start.choice.flux.T)
    best: SceneAims | None = None
    step, before, sweeps = 1.0, 0.0, SWEEPS if start is None else AGAIN
    for k in range(ROUNDS):
        cap = aimed_at - more
        if choice is not None:
            # The loads contain a part of that difference.
            cap += (field.load(choice.choice) - field.flux(choice.choice)).T
        choice = optimise(
            field, np.ascontiguousarray(np.maximum(cap, LEAST * limit).T), choice,
            keep=demand.keep, sweeps=sweeps if k < FREE else 0, gap=gap,
            progress=_part(progress, k),
        )  # fmt: skip
        trial = _evaluated(scene, field, choice, demand, limit, light)
        if best is None or _rank(trial) > _rank(best):
            best = trial
        charging = start is None and k < CHARGING and (trial.risk.own > CHARGED * limit).any()
        # Early rounds may leave room, taken for errors of a choice that stood higher.
        if not charging and (
            -BINDS < best.excess <= 0.0 or (k + 1 >= FREE and trial.excess <= 0.0)
        ):
            break
        new = trial.quantile - choice.flux.T
        if k < FREE:
            # A choice that is too low after one that was too high, or the reverse, is overshoot.
            step *= 0.5 if before * trial.excess < 0.0 else 1.0
            more, before = more + step * (new - more), trial.excess
        else:
            # No cell regains room, so that the rounds come to an end.
            more = more + BEYOND * np.maximum(new - more, 0.0)
        sweeps = SWEEPS if charging else AGAIN
        field = _charged(trial) if charging else field
    assert best is not None
    return best


def _charged(trial: SceneAims) -> Candidates:
    r"""Return the candidates with the loads that count at these aims.

    To first order, a beam that adds $v$ to the variance $σ_c^2$ adds $k v / 2σ_c$ to the allowance.
    The rate of all cells is the one with which the charges of these aims are right in the mean of
    the cells, weighted by their price.
    """
    field, risk, scene = trial.field, trial.risk, trial.engine.scene
    chosen, price = trial.choice.choice, trial.choice.prices.T
    found = (field.charged(scene, 1.0).load(chosen) - field.flux(chosen)).T
    adds = 0.5 * risk.factor * risk.own**2 / np.maximum(risk.sigma, 1e-300)
    if not (price * found).any():
        return field
    return field.charged(scene, float((price * adds).sum() / (price * found).sum()))


def _rank(trial: SceneAims) -> tuple[bool, float]:
    """Return the sort key of aims: the power if they respect the limit, otherwise the excess."""
    holds = trial.excess <= 0.0
    return holds, trial.engine.powers[0] if holds else -trial.excess


def _part(progress: Step | None, done: int) -> Step | None:
    if progress is None:
        return None
    return lambda k, n: progress(min(n * done + k, n * ROUNDS - 1), n * ROUNDS)


def _posed(scene: Scene, aims: FloatArray, off: npt.NDArray[np.bool_] | None) -> Scene:
    """Return the scene with new aims, and with additional mirrors dark."""
    dark = scene.dark
    if off is not None:
        dark = off if dark is None else dark | off
    return replace(scene, mirrors=scene.mirrors.toward(scene.sun, aims), dark=dark)


def _dark(scene: Scene) -> npt.NDArray[np.bool_]:
    return np.zeros(len(scene.mirrors), dtype=np.bool_) if scene.dark is None else scene.dark


def _usable(start: SceneAims, scene: Scene) -> bool:
    """Return whether a start has images of all mirrors that are not dark.

    Raises
    ------
    InputError
        If it belongs to other mirrors or to another receiver.
    """
    if len(scene.mirrors) != len(start.aims):
        raise InputError(
            f"aims: the start has {len(start.aims)} mirrors, but the scene has "
            f"{len(scene.mirrors)}; omit the start"
        )
    was, now = surface_in(start.engine.scene), surface_in(scene)
    if was.shape != now.shape or not np.allclose(was.center, now.center):
        raise InputError(
            f"aims: the start is for receiver {was.name} with {was.shape[0]} × {was.shape[1]} "
            f"cells, not for {now.name} with {now.shape[0]} × {now.shape[1]}; omit the start"
        )
    return not (start.dark & ~_dark(scene)).any()


def _relit(start: SceneAims, base: FieldFlux, scene: Scene) -> Candidates:
    """Return earlier candidates rescaled to the present light."""
    before, now = start.engine.leaving, base.leaving
    # A mirror that is defocused now or was then has no light of its own to compare; use the
    # field's.
    usual = now.sum() / max(float(before[now > 0.0].sum()), 1e-300)
    ratio = np.where(before > 0.0, now / np.where(before > 0.0, before, 1.0), usual)
    if scene.dark is not None:
        ratio = np.where(scene.dark, 0.0, ratio)
    return start.field.relit(as_float(start.field.weight * ratio))


def _evaluated(
    scene: Scene,
    field: Candidates,
    choice: Choice,
    demand: Demand,
    limit: FloatArray,
    light: dict[str, Any],
) -> SceneAims:
    """Return the engine's evaluation of a choice."""
    rows = np.arange(len(choice.choice))
    off = choice.choice < 0
    aims = np.where(off[:, None], middles(scene), field.aims[rows, np.maximum(choice.choice, 0)])
    engine = FieldFlux(_posed(scene, aims, off), **light)
    risk = risk_of(engine, demand, limit)
    return SceneAims(engine, field, choice, aims, off, _dark(scene), limit, risk, light)


def risk_of(engine: FieldFlux, demand: Demand, limit: FloatArray) -> Risk:
    """Return the uncertainty of the flux under a limit (rows, columns)."""
    scene, mirrors = engine.scene, engine.scene.mirrors
    if not (engine.leaving.any() and (mirrors.pointing.any() or demand.shared.any)):
        none = np.zeros_like(limit)
        return Risk(none, none, 0.0, none)
    groups = np.zeros(len(mirrors), dtype=np.int64) if demand.groups is None else demand.groups
    modes = demand.shared.modes(mirrors, scene.sun, demand.pole)
    return assess(engine, modes, groups, demand.probability, limit)


def _ascended(
    scene: Scene,
    field: Candidates,
    demand: Demand,
    limit: FloatArray,
    progress: Step | None,
    light: dict[str, Any],
) -> SceneAims:
    """Return the aims of gradient ascent, which begins with the strategy "spread"."""
    rows, shifts = np.arange(len(field.weight)), field.shifts
    up = shifts[rows, choose(field, scene, "spread") % shifts.shape[1]]
    surface = surface_in(scene)
    start = np.stack([np.zeros(len(up)), up * surface.height / surface.shape[0]], axis=-1)

    def cap_of(engine: FieldFlux) -> FloatArray:
        above = risk_of(engine, demand, limit).above
        return as_float(np.maximum(limit - above, LEAST * limit))

    aims, prices = ascend(scene, cap_of, start, progress, **light)
    # A choice that starts from these aims starts from the closest candidates.
    chosen = np.linalg.norm(field.aims - aims[:, None], axis=-1).argmin(axis=1)
    power = float(field.power[rows, chosen].sum())
    choice = Choice(chosen, np.ascontiguousarray(prices.T), field.flux(chosen), power, np.nan)
    engine = FieldFlux(_posed(scene, aims, None), **light)
    off, risk = np.zeros(len(rows), dtype=np.bool_), risk_of(engine, demand, limit)
    return SceneAims(engine, field, choice, aims, off, _dark(scene), limit, risk, light)


def _place(scene: Scene, cell: tuple[int, ...]) -> str:
    east, north, up = surface_in(scene).cells.center.reshape(*surface_in(scene).shape, 3)[cell]
    return f"row {cell[0]}, column {cell[1]} ({east:.1f}, {north:.1f}, {up:.1f} m)"


def _refuse(
    scene: Scene,
    trial: SceneAims,
    demand: Demand,
    again: Callable[[FloatArray], SceneAims],
    what: str,
    advice: str,
) -> NoReturn:
    """Raise InputError: where the limit is exceeded most, by how much, and what would hold.

    ``again`` returns the aims under a higher limit. All cells' limits are raised until these aims
    respect them, as their allowance for errors depends on the room of all cells.
    """
    over = trial.quantile / trial.limit
    cell = tuple(int(n) for n in np.unravel_index(over.argmax(), over.shape))
    limit = demand.limit.on(*over.shape)
    others = limit - trial.limit
    flux, given = trial.quantile[cell] + others[cell], limit[cell] / (1.0 - demand.limit.margin)
    enough, higher = given, trial
    for _ in range(RAISES):
        if higher.excess <= HOLDS:
            break
        enough = _upward(given * float(((higher.quantile + others) / limit).max()))
        higher = again(as_float(enough / given * limit - others))
    hint = f"; {demand.limit.unit_hint}" if demand.limit.unit_hint else ""
    rest = " and elsewhere by the same factor" if np.ndim(demand.limit.flux) else ""
    raise InputError(
        f"receiver {surface_in(scene).name}: {what}; {_place(scene, cell)} gets "
        f"{1e-3 * flux:.4g} kW/m², of which {1e-3 * trial.risk.above[cell]:.4g} "
        f"are due to errors, {_percent(flux / limit[cell] - 1.0)} above its "
        f"{1e-3 * limit[cell]:.4g}; raise the limit there to {1e-3 * enough:.4g} kW/m²"
        f"{rest}{advice}{hint}"
    )


def _upward(flux: float) -> float:
    """Return a flux rounded up to the four digits that are printed."""
    step = 10.0 ** (np.floor(np.log10(flux)) - 3.0)
    return float(np.ceil(flux / step) * step)


def _percent(excess: float) -> str:
    return f"{100 * excess:.0f} %" if excess >= 0.1 else f"{100 * excess:.2g} %"


def _one_beam(
    scene: Scene, field: Candidates, demand: Demand, limit: FloatArray, light: dict[str, Any]
) -> SceneAims:
    """Return the aims with only the beam that has the lowest peak.

    Raises
    ------
    InputError
        If the limit does not allow even this beam.
    """
    images, heights = field.images, field.shifts.shape[1]
    ends = images.begin + images.box[:, 1] * images.box[:, 3]
    peaks = [images.values[a:b].max(initial=0.0) for a, b in zip(images.begin, ends, strict=True)]
    peak = np.repeat(np.reshape(peaks, (-1, images.looks)), heights, axis=1)
    peak = peak * field.weight[:, None]
    # A beam that mostly misses the receiver is no use.
    full = (field.power > 0.0) & (field.power >= 0.5 * field.power.max(axis=1, keepdims=True))
    row, aim = np.unravel_index(np.where(full, peak, np.inf).argmin(), peak.shape)
    chosen = np.full(len(peak), -1)
    chosen[row] = aim
    none = np.zeros(images.shape[::-1])
    power = float(field.power[row, aim])
    choice = Choice(chosen, none, field.flux(chosen), power, np.nan)

    def under(cap: FloatArray) -> SceneAims:
        return _evaluated(scene, field, choice, demand, cap, light)

    trial = under(limit)
    if trial.excess > HOLDS:
        what = "the flux limit does not allow even the beam with the lowest peak"
        _refuse(scene, trial, demand, under, what, "")
    return trial
