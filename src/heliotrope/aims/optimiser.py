r"""Aims that maximise power under a flux limit, by Lagrangian decomposition.

With $x_{ia}$ = 1 if mirror i takes candidate a, which has the power $p_{ia}$ and puts the load
$f_{iac}$ on cell c (flux, and perhaps an allowance for errors):

$$\max \sum p_{ia} x_{ia}, \qquad \sum f_{iac} x_{ia} \le L_c, \qquad \sum_a x_{ia} \le 1.$$

Prices $λ_c \ge 0$ of the cells decouple the mirrors, and for any prices

$$D(λ) = \sum_c λ_c L_c + \sum_i \max(0, \max_a (p_{ia} - \sum_c λ_c f_{iac}))$$

is at least the optimum. The prices come from an augmented Lagrangian: mirror after mirror takes its
best candidate at prices $\max(0, λ_c + ρ_c (F_c - L_c))$, and after each sweep these become the
multipliers (Hestenes and Powell, 1969). The prices are first found with one mirror in ten. Finally,
remaining excess over the limit is removed mirror by mirror, and remaining room below the limit is
filled. An earlier choice needs no sweep if its prices are still good, as when the sun has moved by
a minute.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from heliotrope.aims import _choice_kernels as kernels
from heliotrope.aims.candidates import Candidates, spans_of
from heliotrope.geometry import FloatArray, as_float
from heliotrope.optics.shading import IntArray

#: Greatest change of a cell's price, divided by its area, for a flux of twice the limit, and for a
#: median beam that joins.
STEEP, STEP = 10.0, 0.05
#: The prices are first found with one mirror in SAMPLE, but at least FEW, with this many sweeps.
SAMPLE, FEW, COARSE = 10, 400, 20
#: Maximum number of sweeps over all mirrors, and the gap at which they end.
SWEEPS, GAP = 8, 1e-3
#: Sweeps between two checks of the gap.
BETWEEN = 2
#: Excess over the cap, and multiple of the gap, up to which an earlier choice is tried as it is.
NEAR, LIKELY = 0.01, 2.0
#: Successive penalties for excess over the limit, divided by the area of a cell.
FINES = (3.0, 30.0, 300.0, 1e4, 1e6, 1e9)

Step = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Choice:
    """The candidate that each mirror takes.

    Attributes
    ----------
    choice
        Candidate of each mirror, (H,); −1: none.
    prices
        Multipliers of the cells, W per W/m², (columns, rows).
    flux
        W/m², (columns, rows), the sum of the candidates' images.
    power
        W.
    bound
        Upper bound on the power of any choice of candidates under this limit, W.
    """

    choice: IntArray
    prices: FloatArray
    flux: FloatArray
    power: float
    bound: float

    @property
    def gap(self) -> float:
        """Upper bound on the power that a better choice could add, as a fraction of the power."""
        return self.bound / self.power - 1.0 if self.power > 0.0 else np.inf


def bound(
    field: Candidates, cap: FloatArray, prices: FloatArray, idle: float = 0.0
) -> tuple[float, IntArray]:
    """Return the dual D(λ), W, and each mirror's best candidate at these prices, (H,)."""
    net = field.power - field.worth(prices)
    best = net.argmax(axis=1)
    value = net[np.arange(len(net)), best]
    used = value > idle
    total = float((prices * cap).sum() + np.where(used, value, max(idle, 0.0)).sum())
    return total, np.where(used, best, -1)


def optimise(
    field: Candidates,
    cap: FloatArray,
    start: Choice | None = None,
    *,
    keep: bool = False,
    sweeps: int = SWEEPS,
    gap: float = GAP,
    progress: Step | None = None,
) -> Choice:
    """Return the choice with the most power whose load does not exceed the cap in any cell.

    Parameters
    ----------
    field
        Candidates of H mirrors.
    cap
        W/m², above 0, (columns, rows).
    start
        An earlier choice, whose prices and candidates are the starting point.
    keep
        Whether every mirror must send its light to the receiver; the load may then exceed the cap.
    sweeps
        Maximum number of sweeps over all mirrors; if 0, the start is only brought under the cap.
    gap
        Gap at which the sweeps end.
    progress
        Called with the number of sweeps done and their total number.
    """
    rng, everyone = np.random.default_rng(0), np.arange(len(field.weight))
    idle = -1e300 if keep else 0.0
    # Without prices, the bound is the power without a limit.
    reached, least = None, float(np.maximum(field.power.max(axis=1), idle).sum())
    if start is None:
        prices, choice = np.zeros_like(cap), np.full(len(everyone), -1)
        few = np.sort(rng.permutation(everyone)[: max(FEW, len(everyone) // SAMPLE)])
        best = field.power.max(axis=1)
        small = cap * (best[few].sum() / best.sum())
        for _ in range(COARSE):
            prices = _sweep(field, small, prices, choice, rng.permutation(few), idle)
        choice = bound(field, cap, prices, idle)[1]
    else:
        prices, choice = start.prices.copy(), start.choice.copy()
        least = min(least, bound(field, cap, prices, idle)[0])
        if not sweeps or _near(field, cap, choice, least, gap):
            reached = _settled(field, cap, prices, choice, least, idle)
    for k in range(sweeps):
        if reached is not None and least - reached.power <= gap * reached.power:
            break
        prices = _sweep(field, cap, prices, choice, rng.permutation(everyone), idle)
        if progress is not None:
            progress(k + 1, sweeps)
        if (k + 1) % BETWEEN and k + 1 < sweeps:
            continue
        least = min(least, bound(field, cap, prices, idle)[0])
        now = _settled(field, cap, prices, choice, least, idle)
        if reached is None or now.power > reached.power:
            reached = now
    assert reached is not None
    return replace(reached, bound=least)


def _near(field: Candidates, cap: FloatArray, choice: IntArray, least: float, gap: float) -> bool:
    """Return whether an earlier choice may need no sweep."""
    load = field.load(choice)
    power = field.power[np.arange(len(choice)), np.maximum(choice, 0)][choice >= 0].sum()
    return bool((load <= (1.0 + NEAR) * cap).all() and least <= (1.0 + LIKELY * gap) * power)


def _sweep(
    field: Candidates,
    cap: FloatArray,
    prices: FloatArray,
    choice: IntArray,
    order: IntArray,
    idle: float,
) -> FloatArray:
    """Let mirrors choose in the given order, and return the new prices."""
    load = field.load(choice, order)
    change = min(STEEP, STEP * float(np.median(cap)) / max(field.peak, 1e-300))
    steep = change * field.images.area / cap
    base = prices - steep * cap
    now = np.maximum(base + steep * load, 0.0)
    kernels.sweep(
        order, field.table, field.shifts, field.power, idle, base, steep, choice, load,
        now.astype(np.float32), spans_of(now),
    )  # fmt: skip
    return as_float(np.maximum(prices + steep * (load - cap), 0.0))


def _settled(
    field: Candidates,
    cap: FloatArray,
    prices: FloatArray,
    choice: IntArray,
    least: float,
    idle: float,
) -> Choice:
    """Return a choice that respects the cap."""
    mine, over = choice.copy(), field.load(choice) - cap
    # The mirrors that yield least for their price leave first.
    rows = np.arange(len(mine))
    paid = np.where(mine >= 0, field.power[rows, np.maximum(mine, 0)], 0.0)
    order = np.argsort(paid, kind="stable")
    for k, fine in enumerate(FINES):
        kernels.settle(
            order, field.table, field.shifts, field.power, idle, mine, over,
            fine * field.images.area, k == 0,
        )  # fmt: skip
        if not (over > 1e-9 * cap).any():
            break
    flux = field.flux(mine)
    power = field.power[rows, np.maximum(mine, 0)][mine >= 0].sum()
    return Choice(mine, prices, flux, float(power), least)
