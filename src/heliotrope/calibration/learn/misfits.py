"""Find heliostats that do not fit their sightings, with the likely reason.

If a motor is connected in reverse, or sightings are assigned to the wrong heliostat, no parameters
fit the sightings, or only absurd ones. Each likely mistake is a hypothesis: the sightings are
reinterpreted as if the mistake had been made, and fitted in the usual way. A hypothesis that
explains the sightings far better is reported as the reason. A heliostat with such a reason is not
learnt, and does not influence the field. Mirrored or rotated photographs are a camera mistake,
which is tested over all heliostats together.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.fit._fit_kernels import CAUCHY_WIDTH
from heliotrope.calibration.fit.estimator import FieldFit, FitOutcome, fit
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.learn.unusable import is_usable
from heliotrope.calibration.sightings import Sightings, join, ray_directions
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, angle_between, bisector
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import SLOTS, Drive
from heliotrope.mechanism.tracking import track
from heliotrope.values import amount

#: Parameters are doubtful if the sum of their squares, in units of their prior standard deviations,
#: exceeds this.
DOUBTFUL = 25.0
#: If the other sightings contradict a sighting by more than this beam error, rad, it shows a
#: different beam.
ELSEWHERE = 5e-3
#: A median beam error above this, rad, cannot be explained by any change that a heliostat undergoes
#: in its life.
HOPELESS = 50e-3
#: A mistake is reported if its hypothesis lowers the cost by more than the first number, and to
#: less than the second number times the original cost.
GAIN, SHARE = 30.0, 0.5
#: The beam errors under the hypothesis may be at most this many times the errors without it.
ALIKE = 1.5
#: With fewer sightings than this, the values follow the priors and cannot become `DOUBTFUL`.
WITNESSES = 3
#: A heliostat stood still if its normal turned by less than the first angle, rad, while the
#: bisector of its rays turned by more than the second.
STILL, TURNED = 1e-3, 10e-3
#: Maximum number of sightings with which a hypothesis is tested, and number of other heliostats
#: that are tried.
MOST, OTHERS = 40, 4
#: Number of sightings used to choose the other heliostats.
FEW = 5
#: Counts are scaled if the drives require a factor that differs from 1 by more than this; the fit
#: then refines the factor with this prior standard deviation.
SCALED, LOOSE = 0.02, 0.05
#: Sightings are inconsistent if half of them are further than this many sigmas from the position
#: that the other sightings predict. If the distance also exceeds this angle, rad, no fit is valid.
#: The worst of 18 real heliostats has 1.6 sigmas and 1.0 mrad.
SCATTERED, APART = 4.0, 2e-3
#: Number of heliostats, those with the most sightings, that are used to judge the photographs.
MIRRORS = 10
#: Possible mistakes in photographs: text, and the signs of right and up on the target.
PHOTOGRAPHS = (
    ("mirrored left to right", (-1.0, 1.0)),
    ("mirrored top to bottom", (1.0, -1.0)),
    ("turned by half a turn", (-1.0, -1.0)),
)


@dataclass(frozen=True)
class Misfit:
    """A heliostat that is not learnt.

    Attributes
    ----------
    row
        Index of the heliostat.
    outcome
        `FitOutcome.MISFIT`, or `FitOutcome.UNMOVED`.
    reason
        The reason in one clause, for display.
    """

    row: int
    outcome: FitOutcome
    reason: str


def find_misfits(
    mechanism: Mechanism,
    sightings: Sightings,
    used: npt.NDArray[np.bool_] | None = None,
    targets: Sequence[Target] = (),
) -> tuple[Misfit, ...]:
    """Return the heliostats that do not fit their sightings.

    Parameters
    ----------
    mechanism
        Nominal mechanisms, (N,).
    sightings
        M sightings of these heliostats; their names appear in the reasons.
    used
        Mask of the sightings to use, (M,).
    targets
        Targets of the plant; without them the check for mirrored photographs is skipped.
    """
    judged = sightings if used is None else sightings.take(used)
    names = parameter_table.model("full", mechanism.parameters)
    usable = is_usable(linearise(mechanism[judged.heliostat], judged, names))
    within_reach = judged.take(usable)
    misfits = list(_unmoved(mechanism, within_reach))
    misfits += _of_photographs(mechanism, _without(within_reach, misfits), names, targets)
    moved = _without(within_reach, misfits)
    fitted = fit(mechanism, moved, names, adapt_scale=False)
    error = _median_errors(mechanism, moved, fitted)
    # Counts beyond the reach of the drives are reported as such, unless a mistake explains them.
    for row in np.setdiff1d(judged.heliostat, within_reach.heliostat):
        reason = _mistake(mechanism, judged.take(judged.heliostat == row), int(row), names)
        if reason is not None:
            misfits.append(Misfit(int(row), FitOutcome.MISFIT, reason))
    for row in np.flatnonzero(fitted.count):
        outcome = FitOutcome(int(fitted.outcome[row]))
        strain = float(((fitted.values[row] / fitted.prior[row]) ** 2).sum())
        if (
            outcome in (FitOutcome.CONVERGED, FitOutcome.NOT_CONVERGED)
            and strain < DOUBTFUL
            and error[row] < ELSEWHERE
        ):
            continue
        mine = moved.take(moved.heliostat == row)
        reason = _mistake(mechanism, mine, int(row), names)
        if reason is None:
            reason = _hopeless(mechanism, mine, outcome, strain, float(error[row]))
        if reason is not None:
            misfits.append(Misfit(int(row), FitOutcome.MISFIT, reason))
    return tuple(sorted(misfits, key=lambda misfit: misfit.row))


def scattered(row: int, white: FloatArray, sigma: FloatArray) -> Misfit | None:
    """Return the misfit of a heliostat if its sightings are inconsistent; None if they agree.

    Parameters
    ----------
    row
        Index of the heliostat.
    white
        Distance of each sighting from the position that the other sightings predict, in units of
        its sigma, (n,).
    sigma
        Standard deviations of the sightings, rad of beam, (n,).
    """
    if np.median(white) < SCATTERED or np.median(white * sigma) < APART:
        return None
    return Misfit(
        row,
        FitOutcome.MISFIT,
        f"half of its {amount(len(white), 'beam')} are more than "
        f"{1e3 * np.median(white * sigma):.1f} mrad, {np.median(white):.0f} times their sigma, "
        "from where its other sightings predict them: no parameters explain them; check counts, "
        "gear ratio and the log",
    )


def costs(fitted: FieldFit, mechanism: Mechanism) -> FloatArray:
    """Return the robust cost of each heliostat's sightings and parameters, including far starts."""
    square = (fitted.lengths * fitted.scale[fitted.rows] / CAUCHY_WIDTH) ** 2
    data = np.bincount(
        fitted.rows, CAUCHY_WIDTH**2 * np.log1p(np.nan_to_num(square)), len(mechanism)
    )
    cost = data + ((fitted.values / fitted.prior) ** 2).sum(axis=1)
    broken = ~np.isin(fitted.outcome, (FitOutcome.CONVERGED, FitOutcome.NOT_CONVERGED))
    return np.asarray(np.where(broken & (fitted.count > 0), np.inf, cost))


def _without(sightings: Sightings, misfits: Sequence[Misfit]) -> Sightings:
    return sightings.take(~np.isin(sightings.heliostat, [misfit.row for misfit in misfits]))


def _is_better(cost: float, unchanged: float) -> bool:
    """Return whether reinterpreted sightings fit far better than the original sightings."""
    return cost < unchanged - GAIN and cost < SHARE * unchanged


def _of_photographs(
    mechanism: Mechanism, sightings: Sightings, names: tuple[str, ...], targets: Sequence[Target]
) -> Iterator[Misfit]:
    """Yield every heliostat with a beam on a target, if its photographs are mirrored or rotated."""
    on = [
        target.holds(sightings.destination) & ~sightings.destination_at_infinity
        for target in targets
    ]
    shown = sightings.take(np.any(on, axis=0)) if targets else sightings.take([])
    counts = np.bincount(shown.heliostat, minlength=len(mechanism))
    chosen = np.argsort(-counts, kind="stable")[:MIRRORS]
    chosen = chosen[counts[chosen] >= FEW]
    if not len(chosen):
        return
    parts = [_some(shown.take(shown.heliostat == row), MOST) for row in chosen]
    part = join([mine.renumbered(np.full(len(mine), k)) for k, mine in enumerate(parts)])
    machines = mechanism[chosen]

    def read(sign: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
        other = replace(part, destination=_reflected(part.destination, targets, sign))
        fitted = fit(machines, other, names, adapt_scale=False)
        return costs(fitted, machines), _median_errors(machines, other, fitted)

    unchanged, error = read((1.0, 1.0))
    # A heliostat that fits in no orientation says nothing about photographs of other heliostats.
    good = np.isfinite(unchanged)
    trials = {text: read(sign) for text, sign in PHOTOGRAPHS}
    best = min(trials, key=lambda text: float(trials[text][0][good].sum()))
    cost, errors = trials[best]
    most = 2 * int((cost < unchanged)[good].sum()) > len(unchanged)
    if not (most and _is_better(float(cost[good].sum()), float(unchanged[good].sum()))):
        return
    if np.median(errors) > ELSEWHERE:
        return
    text = (
        f"the photographs of the targets seem {best}: read that way, the sightings of "
        f"{amount(len(chosen), 'heliostat')} fit with a beam error of "
        f"{1e3 * np.median(errors):.2f} mrad instead of {1e3 * np.median(error):.2f}; correct "
        "the camera or the program that stores its frames"
    )
    for row in np.flatnonzero(counts):
        yield Misfit(int(row), FitOutcome.MISFIT, text)


def _reflected(
    points: FloatArray, targets: Sequence[Target], sign: tuple[float, float]
) -> FloatArray:
    """Return points mirrored about the middle of their target, in one direction or both."""
    moved, unassigned = points.copy(), np.ones(len(points), np.bool_)
    for target in targets:
        on = unassigned & target.holds(points)
        unassigned &= ~on
        moved[on] += (target.plane_coordinates(points[on]) * (np.array(sign) - 1.0)) @ target.axes
    return moved


def _some(sightings: Sightings, most: int) -> Sightings:
    """Return at most ``most`` sightings, spread evenly over all sightings."""
    places = np.linspace(0, len(sightings) - 1, min(most, len(sightings))).round().astype(np.intp)
    return sightings.take(np.unique(places))


def _unmoved(mechanism: Mechanism, sightings: Sightings) -> Iterator[Misfit]:
    pose = mechanism[sightings.heliostat].pose(sightings.counts)
    bisectors = bisector(*ray_directions(sightings, pose.vertex))
    for row in np.unique(sightings.heliostat):
        mine = np.flatnonzero(sightings.heliostat == row)
        if _span(pose.normal[mine]) < STILL and _span(bisectors[mine]) > TURNED:
            yield Misfit(
                int(row),
                FitOutcome.UNMOVED,
                f"the mirror did not move: {amount(len(mine), 'sighting')} under different sun "
                "positions have the same counts; check its motors and the log of the counts",
            )


def _span(directions: FloatArray) -> float:
    """Return the largest angle between the first direction and any other direction, rad."""
    return float(angle_between(directions, directions[:1]).max(initial=0.0))


def _median_errors(mechanism: Mechanism, sightings: Sightings, fitted: FieldFit) -> FloatArray:
    beam = beam_errors(mechanism.with_parameters(fitted.parameters), sightings).beam
    errors = np.zeros(len(mechanism))
    for row in np.flatnonzero(fitted.count):
        errors[row] = np.median(beam[sightings.heliostat == row])
    return errors


def _hopeless(
    mechanism: Mechanism, mine: Sightings, outcome: FitOutcome, strain: float, error: float
) -> str | None:
    """Return the reason why a fit cannot be valid, even if no sighting is wrong.

    Returns None if the fit can be valid.
    """
    still = [
        mechanism.joints[joint]
        for d, joint in enumerate(mechanism.driven)
        if len(mine) > 1 and np.ptp(mine.counts[:, d]) == 0.0
    ]
    broken = outcome not in (FitOutcome.CONVERGED, FitOutcome.NOT_CONVERGED)
    if broken or error > HOPELESS:
        if still:
            return (
                f"the counts of {' and '.join(still)} did not change; check the motor and the log"
            )
        remainder = "" if broken else f", the best leave a beam error of {1e3 * error:.0f} mrad"
        return (
            f"no plausible parameters explain its {amount(len(mine), 'sighting')}{remainder}; "
            "check the counts, the heliostat's name and its entry in the plant file"
        )
    if len(mine) < WITNESSES and strain > DOUBTFUL:
        return (
            f"{amount(len(mine), 'sighting')} would need parameters {np.sqrt(strain):.0f} "
            f"standard deviations from their nominal values; take at least {WITNESSES}"
        )
    return None


def _mistake(mechanism: Mechanism, mine: Sightings, row: int, names: tuple[str, ...]) -> str | None:
    """Return the mistake that explains the sightings of a heliostat; None if there is none."""
    part = _some(mine, MOST)
    trials = [*_hypotheses(mechanism, part, row), *_scaled(mechanism, part, row)]
    machines = mechanism[np.array([trial.row for trial in trials])]
    parts = [trial.sightings.renumbered(np.full(len(part), k)) for k, trial in enumerate(trials)]
    sightings = join(parts)
    priors = {
        name: np.where([name in t.factors for t in trials], LOOSE, mechanism.parameter(name).prior)
        for name in {name for trial in trials for name in trial.factors}
    }
    fitted = fit(machines, sightings, names, priors=priors, adapt_scale=False)
    error, trial_costs = _median_errors(machines, sightings, fitted), costs(fitted, machines)
    # The first trial uses the original sightings. A true mistake explains them no worse than the
    # original fit does: a drive zero that is far off also strains the priors, but leaves smaller
    # errors than a swapped heliostat does.
    least = 2.0 * float(np.median(part.sigma))
    enough = np.clip(np.nan_to_num(ALIKE * error[0], nan=np.inf), least, ELSEWHERE)
    trial_costs = np.where(error <= enough, trial_costs, np.inf)
    unchanged, best = costs(fitted, machines)[0], int(np.argmin(trial_costs))
    if best == 0 or not _is_better(trial_costs[best], unchanged):
        return None
    ratios = [
        1.0 / (factor * (1.0 + fitted.parameters[name][best]))
        for name, factor in trials[best].factors.items()
    ]
    text = trials[best].text.format(" and ".join(dict.fromkeys(f"{r:.2f}" for r in ratios)))
    return (
        f"{text}; read that way, its {amount(len(mine), 'sighting')} fit with a beam error of "
        f"{1e3 * error[best]:.2f} mrad"
    )


@dataclass(frozen=True)
class _Trial:
    """A likely mistake.

    Attributes
    ----------
    text
        A clause for display.
    row
        Index of the mechanism.
    sightings
        The sightings with the mistake undone.
    factors
        Factors of the counts, keyed by the parameters that refine them. These parameters have a
        wide prior. ``text`` has a placeholder for the factors.
    """

    text: str
    row: int
    sightings: Sightings
    factors: Mapping[str, float] = field(default_factory=dict)


def _scaled(mechanism: Mechanism, part: Sightings, row: int) -> Iterator[_Trial]:
    """Yield trials with the counts scaled as the nominal drives need to match the rays."""
    if len(mechanism.driven) != 2 or len(part) < FEW:
        return
    mirror = mechanism[row]
    source, destination = ray_directions(part, mirror.pose(part.counts).vertex)
    far = part.destination_at_infinity[:, None]
    vertex = mirror.pose(part.counts).vertex
    aim = np.where(far, vertex + 1e6 * destination, part.destination)
    solved = track(mirror.armature, source, aim)
    joints = [mechanism.joints[joint] for joint in mechanism.driven]
    for branch in (0, 1):
        factors = [
            _factor(
                Drive(mechanism.drives.table[row, d]),
                part.counts[:, d],
                solved.angles[:, branch, d],
            )
            for d in range(2)
        ]
        for drives in ((0, 1), (0,), (1,)):
            if not all(abs(factors[d] - 1.0) > SCALED for d in drives):
                continue
            counts = part.counts.copy()
            counts[:, drives] *= [factors[d] for d in drives]
            yield _Trial(
                f"the counts of {' and '.join(joints[d] for d in drives)} seem scaled: they are "
                "about {} times the true ones; check gear ratio and counts per turn",
                row,
                replace(part, counts=counts),
                {f"{joints[d]}_scale": factors[d] for d in drives},
            )


def _factor(drive: Drive, counts: FloatArray, angles: FloatArray) -> float:
    """Return the factor that makes the counts match the angles; 1 if no factor does."""
    order = np.argsort(counts, kind="stable")
    expected, recorded = drive.counts(np.unwrap(angles[order])), counts[order]
    half = len(order) // 2
    steps = recorded[half:] - recorded[: len(recorded) - half]
    able = steps > 0.0
    slopes = (expected[half:] - expected[: len(recorded) - half])[able] / steps[able]
    slopes = slopes[np.isfinite(slopes) & (slopes > 0.0)]
    return float(np.median(slopes)) if len(slopes) else 1.0


def _hypotheses(mechanism: Mechanism, part: Sightings, row: int) -> Iterator[_Trial]:
    """Yield the original sightings, and the sightings with each likely mistake undone."""
    yield _Trial("", row, part)
    joints = [mechanism.joints[joint] for joint in mechanism.driven]
    back = [_reversed(mechanism, part, row, d) for d in range(len(joints))]
    for d, joint in enumerate(joints):
        counts = part.counts.copy()
        counts[:, d] = back[d]
        yield _Trial(
            f"the motor of {joint} seems reversed: its counts run the other way",
            row,
            replace(part, counts=counts),
        )
    if len(joints) == 2:
        yield _Trial(
            f"the motors of {' and '.join(joints)} both seem reversed",
            row,
            replace(part, counts=np.stack(back, axis=-1)),
        )
        turned = part.counts[:, ::-1].copy()
        yield _Trial(
            f"its axes seem swapped: the counts of {joints[0]} are those of {joints[1]}",
            row,
            replace(part, counts=turned),
        )
        for d, joint in enumerate(joints):
            other = turned.copy()
            other[:, d] = _reversed(mechanism, replace(part, counts=turned), row, d)
            yield _Trial(
                f"its axes seem swapped, and {joint} reversed",
                row,
                replace(part, counts=other),
            )
    for text, sign in (
        ("the azimuth of the sun seems to have the wrong sign", [-1.0, 1.0, 1.0]),
        ("the azimuth of the sun seems to be counted from south", [-1.0, -1.0, 1.0]),
    ):
        far = part.source_at_infinity[:, None]
        source = np.where(far, part.source * sign, part.source)
        yield _Trial(text, row, replace(part, source=source))
    for neighbour in _likely(mechanism, part, row):
        name = part.names[neighbour] if part.names else f"row {neighbour}"
        yield _Trial(f"its rows seem to be those of {name}", neighbour, part)


def _reversed(mechanism: Mechanism, part: Sightings, row: int, drive: int) -> FloatArray:
    """Return the counts of a reversed drive: negated, or mirrored within the range of a jack."""
    table = mechanism.drives.table[row, drive]
    ends = table[[SLOTS["min_count"], SLOTS["max_count"]]]
    about = ends.sum() if np.isfinite(ends).all() else 0.0
    return np.asarray(about - part.counts[:, drive])


def _likely(mechanism: Mechanism, part: Sightings, row: int) -> list[int]:
    """Return the indices of the other heliostats that would fit these sightings best."""
    some = _some(part, FEW)
    count = len(some)
    every = np.repeat(np.arange(len(mechanism)), count)
    sightings = some.take(np.tile(np.arange(count), len(mechanism)))
    pose = mechanism[every].pose(sightings.counts)
    miss = angle_between(pose.normal, bisector(*ray_directions(sightings, pose.vertex)))
    middle = np.median(miss.reshape(-1, count), axis=1)
    middle[row] = np.inf
    return [int(k) for k in np.argsort(middle)[:OTHERS] if np.isfinite(middle[k])]
