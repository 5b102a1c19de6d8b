"""Assess the beam of each heliostat in a stack."""

from collections.abc import Sequence

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded._fitting import Fit
from heliotrope.imaging.coded._still import StillLight
from heliotrope.imaging.coded._tops import Top
from heliotrope.imaging.coded.beams import ExpectedBeam, SeparatedBeam, Verdict

#: A second peak that follows the same code counts if it reaches this fraction of the first peak.
_SECOND = 0.45
#: Squared distance within which 99.9 % of a two-dimensional Gaussian lie.
_GATE = 2.0 * float(np.log(1000.0))
#: A gain is wrong if it differs from 1 by more than this, and by more than this many σ.
_GAIN, _GAIN_SIGMAS = 0.3, 3.0
#: A mirror that does not move has at least this fraction of the usual power at its expected
#: position.
_STANDS = 0.4
#: A peak with less than this fraction of the usual power is the remainder of another beam with the
#: same code.
_WEAK = 0.25
#: Relative error of powers due to the beam shape.
_SHAPE = 0.05


def lost(beam: ExpectedBeam, verdict: Verdict, power: float = 0.0) -> SeparatedBeam:
    """Return the record of a beam that was not found."""
    unknown = np.full((2, 2), np.nan)
    gain = 0.0 if verdict is Verdict.STUCK else float("nan")
    return SeparatedBeam(
        beam.heliostat, verdict, np.full(2, np.nan), unknown, unknown, power, gain, float("nan")
    )


def judged(
    expected: Sequence[ExpectedBeam],
    tops: Sequence[Top],
    fits: Sequence[Fit | None],
    still: StillLight | None,
) -> tuple[SeparatedBeam, ...]:
    """Return each mirror's beam with its verdict.

    Parameters
    ----------
    expected, tops, fits
        Expected beams, peaks and fits of M mirrors.
    still
        Static light; None if other light hides it.
    """
    usual = float(np.percentile([fit.power for fit in fits if fit is not None] or [0.0], 75.0))
    strong = [None if fit is None or fit.power < _WEAK * usual else fit for fit in fits]
    return tuple(_judged(i, expected, tops, strong, still) for i in range(len(expected)))


def _judged(
    index: int,
    expected: Sequence[ExpectedBeam],
    tops: Sequence[Top],
    fits: Sequence[Fit | None],
    still: StillLight | None,
) -> SeparatedBeam:
    beam, fit = expected[index], fits[index]
    if fit is None:
        stands = still is not None and _stands(beam, float(still.powers[index]), still)
        return lost(beam, Verdict.STUCK if stands else Verdict.FAINT)
    gain, sigma = _gain(index, fit, beam, still)
    verdict, other = Verdict.PROVEN, ""
    if not _within(fit, beam):
        verdict = Verdict.ELSEWHERE
        for j, (candidate, own) in enumerate(zip(expected, fits, strict=True)):
            missing = own is None or not _within(own, candidate)
            if j != index and missing and _within(fit, candidate):
                verdict, other = Verdict.EXCHANGED, candidate.heliostat
                break
    elif tops[index].second > _SECOND or _disagrees(gain, sigma):
        verdict = Verdict.JOINED
    return SeparatedBeam(
        beam.heliostat,
        verdict,
        fit.place,
        fit.covariance,
        fit.moments,
        fit.power,
        gain,
        sigma,
        other,
    )


def _disagrees(gain: float, sigma: float) -> bool:
    """Return whether a beam has static light at its position, or more moving light than power."""
    return bool(abs(gain - 1.0) > max(_GAIN, _GAIN_SIGMAS * sigma))


def _stands(beam: ExpectedBeam, power: float, still: StillLight) -> bool:
    """Return whether there is static light where a heliostat's beam is expected."""
    if power > _STANDS * still.usual:
        return True
    away = [_distance(place - beam.place, beam.covariance) for place in still.uncoded]
    return bool(min(away, default=np.inf) < _GATE)


def _gain(
    index: int, fit: Fit, beam: ExpectedBeam, still: StillLight | None
) -> tuple[float, float]:
    """Return the ratio of moving light to all light at a position, and its standard deviation."""
    if still is None:
        light, share = beam.power, beam.power_sigma
    else:
        light = float(still.powers[index])
        share = float(still.sigmas[index]) / max(light, 1e-300)
    if not light > 0.0:
        # The gain is unknown without a picture of the empty surface; with one, nothing moves there.
        return (np.nan, np.nan) if still is None else (np.inf, 0.0)
    gain = fit.power / light
    return gain, gain * float(np.sqrt(share**2 + (fit.power_sigma / fit.power) ** 2 + _SHAPE**2))


def _within(fit: Fit, beam: ExpectedBeam) -> bool:
    away = _distance(fit.place - beam.place, fit.covariance + beam.covariance)
    return fit.shown and away < _GATE


def _distance(away: FloatArray, covariance: FloatArray) -> float:
    return float(away @ np.linalg.solve(covariance, away))
