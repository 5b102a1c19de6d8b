r"""Search residuals for a periodic error of unknown ratio, or for a harmonic of a known ratio.

An eccentric worm or gear adds A cos(r x − δ) to its joint angle, where x is the ideal angle of the
drive (the stroke of a jack) and r the unknown ratio (Malan, thesis, (6.1), knew the ratio: 30). For
each trial r a cosine and a sine are added to the model, linearised about a robust fit. The
constants may vary within their priors, because the residuals are whitened by the noise and the
priors together. Consider one heliostat whose constants leave ν degrees of freedom, with normal
noise of unknown size. The probability that the remaining fraction of the sum of squares is as small
as q by chance is

$$ P(q) = q^{(ν-2)/2} $$

(Baluev 2008, MNRAS 385, 1279, (6) and table 1, with the constants of a heliostat in place of his
polynomial). −ln P is exponentially distributed, so its sum over N heliostats follows a gamma
distribution of shape N. The chance probability of the highest peak is at most the number of trials
times that of one trial (Bonferroni). Residuals of real heliostats are not white, so the height of a
peak is measured relative to the surrounding spectrum.

Once a wave is found, its ratio and σ come from fits that include the wave. The first fit counted
the wave as noise, and an assumed noise that is too large makes the constants stiff and biases the
ratio. If the fit moved a constant further than its prior, the constant may vary here by the same
amount.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar
from scipy.special import gammaincc, gammaincinv

from heliotrope.calibration.fit.estimator import fit
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.sightings import Sightings
from heliotrope.geometry import TAU, FloatArray, as_float
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import SLOTS, Drive
from heliotrope.mechanism.kernels import slots as slot

#: A peak with a larger false-alarm probability than this is rejected.
LEVEL = 1e-3
#: A second peak this close in −ln P leaves the ratio ambiguous: it is still one hundredth as
#: probable as the first.
RIVAL = float(np.log(100.0))
#: Minimum number of degrees of freedom that the constants must leave.
FREEDOM = 10
#: The constants may vary within this many times their priors.
WIDER = 3.0
#: Minimum number of worm turns within the range of a drive; slower waves look like constants.
FEWEST_TURNS = 1.5
#: The peak is compared with the spectrum within this many peak widths of it, after the peak has
#: been removed.
AROUND = 5.0
#: Number of trial ratios within the width of a peak.
OVERSAMPLING = 6
#: Photographs taken within this time, s, are one visit, because their errors are alike.
VISIT = 300.0
#: Harmonics of a known ratio. An off-centre bore causes an error with one period per turn of the
#: worm, an oval worm two periods (Malan, thesis, 6.4), and a worm with three lobes three.
HARMONICS = np.array([1.0, 2.0, 3.0])
#: Number of fits that include the wave of a ratio that was found, each starting from the previous
#: ratio.
REFINEMENTS = 3
#: Residuals of the robust fit longer than this, in units of its scale, do not count.
OUTLIER = 5.0


@dataclass(frozen=True)
class PeriodicError:
    """A periodic error of one drive, with the same ratio on N heliostats.

    Attributes
    ----------
    joint
        Name of the joint that the drive moves.
    ratio
        Periods per joint revolution (rotary), or radians per metre of stroke (jack).
    sigma
        Standard deviation of the ratio; 0 for a harmonic of a known ratio.
    amplitude, phase
        A and δ of each heliostat, rad, (N,); NaN for heliostats with too few sightings.
    false_alarm
        Upper bound on the probability that chance produces such a high peak anywhere in the search.
    clear
        Whether no other ratio explains the sightings nearly as well.
    known
        Ratio in the plant file of which ``ratio`` is a harmonic; 0 if unknown.
    """

    joint: str
    ratio: float
    sigma: float
    amplitude: FloatArray
    phase: FloatArray
    false_alarm: float
    clear: bool
    known: float = 0.0

    @property
    def found(self) -> bool:
        """Whether the error is significant and its ratio unambiguous."""
        return self.clear and self.false_alarm < LEVEL

    @property
    def _ratio(self) -> str:
        if not self.known:
            return f"{self.ratio:.2f} ± {self.sigma:.2f}"
        return f"{self.ratio:g}, {self.ratio / self.known:.0f} times the known {self.known:g}"

    def document(self) -> dict[str, Any]:
        """Return the error as a JSON object."""
        return {
            "joint": self.joint,
            "ratio": self.ratio,
            "ratio_sigma": self.sigma,
            "known_ratio": self.known or None,
            "amplitude_mrad": [float(1e3 * a) if np.isfinite(a) else None for a in self.amplitude],
            "phase_deg": [float(np.degrees(p)) if np.isfinite(p) else None for p in self.phase],
            "false_alarm": self.false_alarm,
            "found": self.found,
        }

    def __str__(self) -> str:
        """Return one line for display."""
        size = 1e3 * float(np.nanmedian(self.amplitude))
        count = int(np.isfinite(self.amplitude).sum())
        phase = f", phase {np.degrees(self.phase[0]):.0f}°" if len(self.phase) == 1 else ""
        return (
            f"Periodic error on {self.joint}: ratio {self._ratio}, amplitude {size:.2f} mrad"
            f"{phase}, from {count} heliostat{'s' if count != 1 else ''}, false-alarm probability "
            f"{max(self.false_alarm, 1e-99):.0e}"
        )


@dataclass(frozen=True)
class _Member:
    """One heliostat: V visits, whitened residuals, and the effect of the constants.

    Attributes
    ----------
    row
        Index of the heliostat.
    x, lever
        Argument of the wave, (V, D), and derivative of the residual with respect to the joint
        angle, (V, 2, D).
    whiten
        Matrix that whitens the noise and removes the contribution of the constants, (2 V, 2 V).
    rest
        Whitened residuals, (2 V,).
    freedom
        Number of degrees of freedom that the constants leave.
    """

    row: int
    x: FloatArray
    lever: FloatArray
    whiten: FloatArray
    rest: FloatArray
    freedom: int

    def waves(self, drive: int, ratios: FloatArray) -> FloatArray:
        """Return the whitened cosine and sine, (T, 2 V, 2), of trial ratios (T,)."""
        u = ratios[:, None] * self.x[:, drive]
        both = np.stack([np.cos(u), np.sin(u)], axis=-1)
        raw = (both[:, :, None, :] * self.lever[:, :, drive, None]).reshape(len(u), -1, 2)
        return np.asarray(self.whiten @ raw)

    def solved(self, drive: int, ratios: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the cosine and sine coefficients (T, 2) and −ln P (T,) of trial ratios (T,)."""
        waves = self.waves(drive, ratios)
        normal = np.swapaxes(waves, 1, 2) @ waves
        right = np.swapaxes(waves, 1, 2) @ self.rest
        # If the constants can imitate a wave, almost nothing is left of it, and it gains nothing.
        size = np.trace(normal, axis1=1, axis2=2)
        normal = normal + (1e-9 * size + 1e-30)[:, None, None] * np.eye(2)
        coefficients = np.linalg.solve(normal, right[..., None])[..., 0]
        share = np.sum(coefficients * right, axis=-1) / float(self.rest @ self.rest)
        share = np.clip(share, 0.0, 1.0 - 1e-12)
        return coefficients, -0.5 * (self.freedom - 2) * np.log1p(-share)


def search_periodic_errors(
    mechanism: Mechanism, sightings: Sightings, *, used: npt.ArrayLike | None = None
) -> tuple[PeriodicError, ...]:
    """Return the best periodic error of each drive whose ratio is unknown, most significant first.

    Each error is returned with its probability of arising by chance; use an error only if its
    `PeriodicError.found` is true. The search covers waves with at least `FEWEST_TURNS` periods
    within the range of the drive, and at most as many periods as there are calibration visits. With
    more periods than visits, a wave could not be distinguished from a slower wave. For a drive
    whose ratio is known only the `HARMONICS` are tried, and an error is returned only if one of the
    harmonics is found. The result is empty if there are too few sightings.

    Parameters
    ----------
    mechanism
        Nominal mechanisms, (N,), all of one kind.
    sightings
        M sightings of these heliostats.
    used
        Mask of the sightings to learn from, (M,).
    """
    keep = np.ones(len(sightings), np.bool_) if used is None else np.asarray(used, np.bool_)
    s = sightings.take(np.flatnonzero(keep))
    drives, errors = _known_ratios(mechanism), list[PeriodicError]()
    while drives and (best := _strongest(mechanism, s, drives, tuple(errors))) is not None:
        drive, error = best
        errors.append(error)
        del drives[drive]
        if not error.found:
            break
    return tuple(e for e in errors if not e.known or (e.found and e.ratio != e.known))


def with_ratios(mechanism: Mechanism, errors: tuple[PeriodicError, ...]) -> Mechanism:
    """Return the mechanism with the ratios of those errors that are significant."""
    for error in errors:
        if error.found:
            shift = {f"{error.joint}_worm_ratio": error.ratio - error.known}
            mechanism = mechanism.with_parameters(shift)
    return mechanism


def _joint(mechanism: Mechanism, drive: int) -> str:
    return mechanism.joints[mechanism.driven[drive]]


def _known_ratios(mechanism: Mechanism) -> dict[int, float]:
    """Return the ratio of each drive that may have a periodic error; 0 if the ratio is unknown.

    Drives whose heliostats have different ratios are skipped, because an error has a single ratio.
    """
    table = mechanism.drives.table[..., SLOTS["worm_ratio"]].reshape(-1, len(mechanism.driven))
    return {
        k: float(table[0, k])
        for k in range(table.shape[1])
        if np.ptp(table[:, k]) == 0.0 and f"{_joint(mechanism, k)}_worm_cos" in mechanism.parameters
    }


def arguments(drives: Drive, counts: FloatArray) -> FloatArray:
    """Return x for each drive: the ideal angle, rad, or the stroke of a jack, m."""
    t = drives.table
    moved = t[..., slot.RATE] * counts
    return np.asarray(np.where(t[..., slot.KIND] == slot.LINEAR, moved, t[..., slot.ZERO] + moved))


def _members(
    mechanism: Mechanism, s: Sightings, worms: tuple[str, ...] = (), out: int = 0
) -> list[_Member]:
    """Return the heliostats with enough visits after a robust fit of all constants and known worms.

    The last ``out`` entries of ``worms`` are also fitted, so that they do not count as noise, but
    they are not projected out as the constants are.
    """
    names = (*parameter_table.model("full", mechanism.parameters), *worms)
    fitted = fit(mechanism, s, names)
    s = s.take(np.flatnonzero(np.isfinite(fitted.lengths) & (fitted.lengths < OUTLIER)))
    biases = tuple(f"{_joint(mechanism, k)}_bias" for k in range(len(mechanism.driven)))
    moved = mechanism.with_parameters(fitted.parameters)
    line = linearise(moved[s.heliostat], s, names + biases)
    x = arguments(Drive(mechanism.drives.table[s.heliostat]), s.counts)
    floating = len(names) - out
    members = []
    for row in range(len(mechanism)):
        mine = np.flatnonzero(s.heliostat == row)
        if 2 * len(mine) < floating + FREEDOM:
            continue
        mean = _visit_means(s.time[mine], x[mine])
        slope = np.einsum("vm,map->vap", mean, line.jacobian[mine])
        at = fitted.values[row] - fitted.centre[row]
        # Installation errors beyond the priors would bias a ratio, but would hardly hide it.
        far = np.maximum(fitted.prior[row], np.abs(at) if out else 0.0)
        residual = mean @ line.residual[mine] - slope[..., : len(names)] @ at
        member = _Member(
            row,
            mean @ x[mine],
            slope[..., len(names) :],
            *_whitened(
                residual.ravel(),
                slope[..., :floating].reshape(-1, floating),
                WIDER * far[:floating] / max(float(fitted.scale[row]), 1e-9),
            ),
        )
        if member.freedom >= FREEDOM and float(member.rest @ member.rest) > 0.0:
            members.append(member)
    return members


def _whitened(
    residual: FloatArray, constants: FloatArray, prior: FloatArray
) -> tuple[FloatArray, FloatArray, int]:
    """Return the whitening matrix, the whitened residuals, and the number of degrees of freedom.

    The residuals are those at the centre of the priors.
    """
    moved = constants * prior
    spread = np.eye(len(residual)) + moved @ moved.T
    whiten = np.linalg.inv(np.linalg.cholesky(spread))
    return whiten, whiten @ residual, len(residual) - constants.shape[1]


def visit_means(mechanism: Mechanism, s: Sightings) -> FloatArray:
    """Return the matrix (V, M) that averages M sightings of heliostat 0 over visits."""
    return _visit_means(s.time, arguments(Drive(mechanism.drives.table[s.heliostat]), s.counts))


def _visit_means(time: FloatArray, x: FloatArray) -> FloatArray:
    """Return the matrix (V, m) that averages m sightings over V visits.

    The sightings of a visit are close in time and in angle.
    """
    if not len(time):
        return np.zeros((0, 0))
    order = np.argsort(time, kind="stable")
    # The fastest trial wave has one period per visit; angles within an eighth of a period count as
    # one position.
    near = np.ptp(x, axis=0) / (8.0 * len(x))
    visit = np.empty(len(time), np.intp)
    first, number = int(order[0]), -1
    for k in order:
        if number < 0 or not (
            time[k] - time[first] < VISIT and (np.abs(x[k] - x[first]) <= near).all()
        ):
            first, number = int(k), number + 1
        visit[k] = number
    weights = np.zeros((number + 1, len(time)))
    weights[visit, np.arange(len(time))] = 1.0
    return as_float(weights / weights.sum(axis=1, keepdims=True))


def _without(member: _Member, drive: int, ratio: float) -> _Member:
    """Project a found wave out of the residuals, in the same way as the constants."""
    basis, _ = np.linalg.qr(member.waves(drive, np.array([ratio]))[0])
    out = np.eye(len(basis)) - basis @ basis.T
    return replace(
        member, whiten=out @ member.whiten, rest=out @ member.rest, freedom=member.freedom - 2
    )


def _grid(members: list[_Member], drive: int) -> tuple[FloatArray, float]:
    """Return trial ratios (T,) for a drive of unknown ratio, and the width of a peak."""
    span = float(max(np.ptp(m.x[:, drive]) for m in members))
    visits = float(np.median([len(m.x) for m in members]))
    if span <= 0.0 or visits < FEWEST_TURNS:
        return np.empty(0), 1.0
    width = TAU / span
    step = width / OVERSAMPLING
    return np.arange(FEWEST_TURNS * width, visits * width, step), width


def _power(members: list[_Member], drive: int, ratios: FloatArray) -> FloatArray:
    """Return −ln P of trial ratios, summed over the heliostats, (T,)."""
    return as_float(np.sum([m.solved(drive, ratios)[1] for m in members], axis=0))


def _peak(
    members: list[_Member], drive: int, near: float, step: float
) -> tuple[float, float, float]:
    """Return the ratio of the highest −ln P within a step of ``near``, its height, and its σ."""

    def lost(ratio: float) -> float:
        return -float(_power(members, drive, np.array([ratio]))[0])

    bounds = (near - step, near + step)
    solution = minimize_scalar(lost, bounds=bounds, method="bounded")
    ratio, height = float(solution.x), -float(solution.fun)
    # −ln P is a log likelihood ratio up to terms of order 1/ν, so its curvature yields the
    # variance.
    far = 0.25 * step
    curvature = (lost(ratio + far) + 2.0 * height + lost(ratio - far)) / far**2
    return ratio, height, float(1.0 / np.sqrt(max(curvature, 1e-12)))


def _strongest(
    mechanism: Mechanism, s: Sightings, drives: dict[int, float], taken: tuple[PeriodicError, ...]
) -> tuple[int, PeriodicError] | None:
    """Return the drive with the highest peak, and its error; project out the waves in ``taken``."""
    members = _members(with_ratios(mechanism, taken), s, _worms(taken))
    spectra: dict[int, tuple[FloatArray, FloatArray, float]] = {}
    grids = {k: _grid(members, k) for k in drives} if members else {}
    for drive, (grid, width) in grids.items():
        known, ratios = drives[drive], grid
        if known and len(grid):
            turns = np.abs(known) * HARMONICS
            ratios = known * HARMONICS[(turns >= grid[0]) & (turns <= grid[-1])]
        if len(ratios):
            spectra[drive] = ratios, _power(members, drive, ratios), width
    if not spectra:
        return None
    drive = max(spectra, key=lambda k: float(spectra[k][1].max()))
    ratios, power, width = spectra[drive]
    known, step = drives[drive], width / OVERSAMPLING
    ratio, height = float(ratios[np.argmax(power)]), float(power.max())
    sigma, slow, near = 0.0, False, 0.0
    if not known:
        ratio, height, sigma = _peak(members, drive, ratio, step)
        # Power that rises towards the slowest trial belongs to slower waves, so it is no peak.
        slow, near = ratio <= ratios[0] + 0.5 * step, width
    others = [
        spectrum[1][np.abs(spectrum[0] - ratio) > near] if k == drive else spectrum[1]
        for k, spectrum in spectra.items()
    ]
    rival = max((float(o.max()) for o in others if len(o)), default=0.0)
    trials = sum(len(spectrum[0]) for spectrum in spectra.values())
    colour = _colour(members, drive, abs(ratio), grids[drive][0], width)
    error = PeriodicError(
        joint=_joint(mechanism, drive),
        ratio=ratio,
        sigma=sigma * float(np.sqrt(colour)),
        amplitude=np.full(len(mechanism), np.nan),
        phase=np.full(len(mechanism), np.nan),
        false_alarm=min(1.0, trials * float(gammaincc(len(members), height / colour))),
        clear=height - rival > RIVAL and not slow,
        known=known,
    )
    for _ in range(REFINEMENTS if error.found else 0):
        # The fit that found the wave counted it as noise. An assumed noise that is too large makes
        # the constants stiff, which biases the ratio.
        errors = (*taken, error)
        members = _members(with_ratios(mechanism, errors), s, _worms(errors), out=2)
        if not known:
            ratio, _, sigma = _peak(members, drive, error.ratio, step)
            error = replace(error, ratio=ratio, sigma=sigma * float(np.sqrt(colour)))
    for m in members:
        # The residual is model minus measurement, so the error has the opposite sign.
        cosine, sine = -m.solved(drive, np.array([error.ratio]))[0][0]
        error.amplitude[m.row], error.phase[m.row] = (
            np.hypot(cosine, sine),
            np.arctan2(sine, cosine),
        )
    return drive, error


def _worms(errors: tuple[PeriodicError, ...]) -> tuple[str, ...]:
    """Return the parameters of the significant waves."""
    return tuple(f"{e.joint}_worm_{part}" for e in errors if e.found for part in ("cos", "sin"))


def _colour(
    members: list[_Member], drive: int, ratio: float, ratios: FloatArray, width: float
) -> float:
    """Return the ratio of the spectrum around a peak, without the peak, to white noise; at least 1.

    The residuals of a real heliostat are not white noise but have a broad hump of slow waves. At
    Jülich the hump is twice as high as white noise, up to about ten turns.
    """
    rest = [_without(m, drive, ratio) for m in members if m.freedom > FREEDOM]
    if not rest:
        return 1.0
    near = ratios[np.abs(ratios - ratio) < AROUND * width]
    power = _power(rest, drive, near)
    return max(1.0, float(np.median(power)) / float(gammaincinv(len(rest), 0.5)))
