"""Mirrors that their sightings do not describe, with the likely reason.

A mirror whose motor is connected the other way round, or whose rows belong to another mirror, fits
no parameters, or fits absurd ones. Each likely mistake is a hypothesis: the sightings are read as
if it had been made, and fitted as all others are. The hypothesis that explains them far better is
the reason. Such a mirror is not learnt, and teaches the field nothing.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.fit._fit_kernels import CAUCHY_WIDTH
from heliotrope.calibration.fit.estimator import FieldFit, FitOutcome, fit
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.learn.unusable import is_usable
from heliotrope.calibration.sightings import Sightings, join, ray_directions
from heliotrope.geometry import FloatArray, angle_between, bisector
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import SLOTS
from heliotrope.values import amount

#: Parameters are doubtful from this sum of squares on, in standard deviations of their priors.
DOUBTFUL = 25.0
#: Beam error beyond which a sighting that the others contradict shows something else, rad.
ELSEWHERE = 5e-3
#: No change in the life of a mirror explains a median error of the beam beyond this, rad.
HOPELESS = 50e-3
#: A mistake is found where it lowers the cost by more than this, and to less than this share.
GAIN, SHARE = 30.0, 0.5
#: The errors of the beam that it leaves are at most this many times those without it.
ALIKE = 1.5
#: Fewer sightings than this leave the priors in force: they give no reason for `DOUBTFUL` values.
WITNESSES = 3
#: A mirror stood still if its normal turned by less than this, rad, while the bisector of its rays
#: turned by more than that.
STILL, TURNED = 1e-3, 10e-3
#: Sightings of a mirror with which a hypothesis is tested, and other mirrors that are tried.
MOST, OTHERS = 40, 4
#: Sightings by which those others are chosen.
FEW = 5


@dataclass(frozen=True)
class Misfit:
    """A mirror that is not learnt.

    Attributes
    ----------
    row
        Row of the heliostat.
    outcome
        `FitOutcome.MISFIT`, or `FitOutcome.UNMOVED`.
    reason
        A clause for people.
    """

    row: int
    outcome: FitOutcome
    reason: str


def find_misfits(
    mechanism: Mechanism,
    sightings: Sightings,
    used: npt.NDArray[np.bool_] | None = None,
) -> tuple[Misfit, ...]:
    """Return the mirrors that their sightings do not describe.

    Parameters
    ----------
    mechanism
        Nominal, (N,).
    sightings
        M of these heliostats; names are used in the reasons.
    used
        Mask of the sightings to judge by, (M,).
    """
    chosen = sightings if used is None else sightings.take(used)
    names = parameter_table.model("full", mechanism.parameters)
    usable = is_usable(linearise(mechanism[chosen.heliostat], chosen, names))
    reachable = chosen.take(usable)
    unmoved = tuple(_unmoved(mechanism, reachable))
    moved = reachable.take(~np.isin(reachable.heliostat, [misfit.row for misfit in unmoved]))
    fitted = fit(mechanism, moved, names, adapt_scale=False)
    error = _median_errors(mechanism, moved, fitted)
    misfits = list(unmoved)
    # Counts beyond the reach of its drives are named as such, unless a mistake explains them.
    for row in np.setdiff1d(chosen.heliostat, reachable.heliostat):
        reason = _mistake(mechanism, chosen.take(chosen.heliostat == row), int(row), names)
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
        own = moved.take(moved.heliostat == row)
        reason = _mistake(mechanism, own, int(row), names)
        if reason is None:
            reason = _hopeless(mechanism, own, outcome, strain, float(error[row]))
        if reason is not None:
            misfits.append(Misfit(int(row), FitOutcome.MISFIT, reason))
    return tuple(sorted(misfits, key=lambda misfit: misfit.row))


def costs(fitted: FieldFit, mechanism: Mechanism) -> FloatArray:
    """Return the robust cost of each heliostat's sightings and parameters, far starts included."""
    square = (fitted.lengths * fitted.scale[fitted.rows] / CAUCHY_WIDTH) ** 2
    data = np.bincount(
        fitted.rows, CAUCHY_WIDTH**2 * np.log1p(np.nan_to_num(square)), len(mechanism)
    )
    cost = data + ((fitted.values / fitted.prior) ** 2).sum(axis=1)
    broken = ~np.isin(fitted.outcome, (FitOutcome.CONVERGED, FitOutcome.NOT_CONVERGED))
    return np.asarray(np.where(broken & (fitted.count > 0), np.inf, cost))


def _unmoved(mechanism: Mechanism, sightings: Sightings) -> Iterator[Misfit]:
    pose = mechanism[sightings.heliostat].pose(sightings.counts)
    bisectors = bisector(*ray_directions(sightings, pose.vertex))
    for row in np.unique(sightings.heliostat):
        mine = np.flatnonzero(sightings.heliostat == row)
        if _span(pose.normal[mine]) < STILL and _span(bisectors[mine]) > TURNED:
            yield Misfit(
                int(row),
                FitOutcome.UNMOVED,
                f"the mirror did not move: {amount(len(mine), 'sighting')} of different suns have "
                "the same counts; check its motors and the log of the counts",
            )


def _span(directions: FloatArray) -> float:
    """Return the largest angle from the first of some directions, rad."""
    return float(angle_between(directions, directions[:1]).max(initial=0.0))


def _median_errors(mechanism: Mechanism, sightings: Sightings, fitted: FieldFit) -> FloatArray:
    beam = beam_errors(mechanism.with_parameters(fitted.parameters), sightings).beam
    errors = np.zeros(len(mechanism))
    for row in np.flatnonzero(fitted.count):
        errors[row] = np.median(beam[sightings.heliostat == row])
    return errors


def _hopeless(
    mechanism: Mechanism, sightings: Sightings, outcome: FitOutcome, strain: float, error: float
) -> str | None:
    """Return the reason to reject a fit that no mistake explains; None if it may hold."""
    still = [
        mechanism.joints[joint]
        for d, joint in enumerate(mechanism.driven)
        if len(sightings) > 1 and np.ptp(sightings.counts[:, d]) == 0.0
    ]
    broken = outcome not in (FitOutcome.CONVERGED, FitOutcome.NOT_CONVERGED)
    if broken or error > HOPELESS:
        if still:
            return f"the counts of {' and '.join(still)} did not change; check motor and log"
        rest = "" if broken else f", the best leave {1e3 * error:.0f} mrad of beam"
        return (
            f"no plausible parameters explain its {amount(len(sightings), 'sighting')}{rest}; "
            "check the counts, the heliostat's name and its entry in the plant file"
        )
    if len(sightings) < WITNESSES and strain > DOUBTFUL:
        return (
            f"{amount(len(sightings), 'sighting')} would need parameters {np.sqrt(strain):.0f} "
            f"standard deviations from the nominal ones; make at least {WITNESSES}"
        )
    return None


def _mistake(
    mechanism: Mechanism, sightings: Sightings, row: int, names: tuple[str, ...]
) -> str | None:
    """Return the mistake that explains the sightings of a mirror, None if there is none."""
    part = sightings.take(
        np.linspace(0, len(sightings) - 1, min(MOST, len(sightings))).round().astype(np.intp)
    )
    trials = list(_hypotheses(mechanism, part, row))
    rows = np.array([trial[1] for trial in trials])
    machines = mechanism[rows]
    parts = [trial[2].renumbered(np.full(len(part), k)) for k, trial in enumerate(trials)]
    joined = join(parts)
    fitted = fit(machines, joined, names, adapt_scale=False)
    error, cost = _median_errors(machines, joined, fitted), costs(fitted, machines)
    # The first trial is the unchanged sightings. A mistake explains them no worse: a zero
    # that is far off strains the priors too, but leaves smaller errors than another mirror does.
    least = 2.0 * float(np.median(part.sigma))
    enough = np.clip(np.nan_to_num(ALIKE * error[0], nan=np.inf), least, ELSEWHERE)
    cost = np.where(error <= enough, cost, np.inf)
    unchanged, best = costs(fitted, machines)[0], int(np.argmin(cost))
    if best == 0 or not (cost[best] < unchanged - GAIN and cost[best] < SHARE * unchanged):
        return None
    return (
        f"{trials[best][0]}; read like that, its {amount(len(sightings), 'sighting')} fit to "
        f"{1e3 * error[best]:.2f} mrad of beam"
    )


def _hypotheses(
    mechanism: Mechanism, part: Sightings, row: int
) -> Iterator[tuple[str, int, Sightings]]:
    """Yield likely mistakes: text, row of the mechanism, and the sightings without the mistake."""
    yield "", row, part
    joints = [mechanism.joints[joint] for joint in mechanism.driven]
    back = [_reversed(mechanism, part, row, d) for d in range(len(joints))]
    for d, joint in enumerate(joints):
        counts = part.counts.copy()
        counts[:, d] = back[d]
        yield (
            f"the motor of {joint} seems reversed: its counts run the other way",
            row,
            replace(part, counts=counts),
        )
    if len(joints) == 2:
        yield (
            f"the motors of {' and '.join(joints)} both seem reversed",
            row,
            replace(part, counts=np.stack(back, axis=-1)),
        )
        turned = part.counts[:, ::-1].copy()
        yield (
            f"its axes seem exchanged: the counts of {joints[0]} are those of {joints[1]}",
            row,
            replace(part, counts=turned),
        )
        for d, joint in enumerate(joints):
            other = turned.copy()
            other[:, d] = _reversed(mechanism, replace(part, counts=turned), row, d)
            yield (
                f"its axes seem exchanged, and {joint} reversed",
                row,
                replace(part, counts=other),
            )
    for text, sign in (
        ("the azimuth of the sun seems to have the wrong sign", [-1.0, 1.0, 1.0]),
        ("the azimuth of the sun seems to count from south", [-1.0, -1.0, 1.0]),
    ):
        far = part.source_at_infinity[:, None]
        yield text, row, replace(part, source=np.where(far, part.source * sign, part.source))
    for neighbour in _likely(mechanism, part, row):
        name = part.names[neighbour] if part.names else f"row {neighbour}"
        yield f"its rows seem to be those of {name}", neighbour, part


def _reversed(mechanism: Mechanism, part: Sightings, row: int, drive: int) -> FloatArray:
    """Return the counts of a drive that counts the other way: about 0, or its range if a jack."""
    table = mechanism.drives.table[row, drive]
    ends = table[[SLOTS["min_count"], SLOTS["max_count"]]]
    about = ends.sum() if np.isfinite(ends).all() else 0.0
    return np.asarray(about - part.counts[:, drive])


def _likely(mechanism: Mechanism, part: Sightings, row: int) -> list[int]:
    """Return the other mirrors that would come nearest to these sightings."""
    some = part.take(np.unique(np.linspace(0, len(part) - 1, FEW).round().astype(np.intp)))
    count = len(some)
    every = np.repeat(np.arange(len(mechanism)), count)
    repeated = some.take(np.tile(np.arange(count), len(mechanism)))
    pose = mechanism[every].pose(repeated.counts)
    miss = angle_between(pose.normal, bisector(*ray_directions(repeated, pose.vertex)))
    middle = np.median(miss.reshape(-1, count), axis=1)
    middle[row] = np.inf
    return [int(k) for k in np.argsort(middle)[:OTHERS] if np.isfinite(middle[k])]
