"""The uncertainty of a photograph during which an axis may have taken up its backlash.

An axis that moves down with the sun swings below its goal every few seconds, so as to approach the
goal from below (`lcu.stepper`). The step counts, reported once per second or less often, miss most
swings, but the goal drops when each swing begins. If it dropped between the counts before and after
a photograph, the exposure fell into the swing with a known probability, and the beam may be off by
as much as the swing. If the axis was reported in the swing next to the exposure, that probability
is one. If the goal did not drop, the mirror was at its goal.
"""

import math

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.mechanism.machine import AxisLimits
from heliotrope.plant.visits.resolution import beam_slopes
from heliotrope.plant.visits.visit import Visit

#: Time average of the squared distance in a motion that speeds up and slows down evenly, as a
#: fraction of its squared length.
_MEAN_SQUARE = 23.0 / 60.0
#: Factor applied to the variance of the mixture. With one photograph in five within a swing, the
#: variance itself would leave the deepest point 3.5 standard deviations away; with this factor it
#: is 2.
_TAIL = 3.0


def swung(axis: AxisLimits, fall: float, span: float, heard: float = math.inf) -> float:
    """Return the variance of an axis's distance from its goal at an unknown instant, steps².

    Parameters
    ----------
    axis
        Limits of the axis.
    fall
        Steps by which its goal dropped between two reports at its goals; 0 or less: it did not
        drop.
    span
        Time between the reports, s.
    heard
        Time from the instant to the nearest report away from its goal, s.
    """
    if axis.backlash == 0 or not (fall > 0.0 and span > 0.0):
        return 0.0
    lead = 2.0 * axis.lead
    deep, times = lead + axis.backlash, max(1.0, round(fall / lead))
    lasts = _lasts(axis, deep) + _lasts(axis, axis.backlash)
    chance = 1.0 if heard <= lasts else min(1.0, _TAIL * times * lasts / span)
    return _MEAN_SQUARE * axis.backlash**2 * chance


def _lasts(axis: AxisLimits, steps: float) -> float:
    """Return the duration of a motion from rest to rest, s."""
    ramp = axis.rate**2 / axis.acceleration
    if steps <= ramp:
        return 2.0 * math.sqrt(steps / axis.acceleration)
    return axis.rate / axis.acceleration + steps / axis.rate


def spread_at(visit: Visit, instant: float, counts: FloatArray) -> FloatArray:
    """Return the covariance, due to swings, of a beam on the visit's target, m², (3, 3).

    Parameters
    ----------
    visit
        Visit with the reports before and after the instant.
    instant
        Instant of the photograph, monotonic s.
    counts
        Step counts at the instant, (2,).
    """
    plant, row, target = visit.plant, visit.row, visit.target
    machine, (falls, span) = plant.beams.machines.get(visit.heliostat), visit.fell(instant)
    covariance = np.zeros((3, 3))
    if machine is None:
        return covariance
    sun = plant.sun_vector(instant - plant.now())
    slopes = beam_slopes(plant, row, target, sun, counts)
    for axis, fall, slope in zip(machine.axes, falls, slopes, strict=True):
        square = swung(axis, float(fall), span, visit.heard_moving(instant))
        if square > 0.0:
            covariance += square * np.outer(slope, slope)
    return covariance if np.isfinite(covariance).all() else np.zeros((3, 3))
