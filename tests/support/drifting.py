"""Photographs of mirrors whose zeros wander otherwise than a learner assumes by default."""

from datetime import UTC, datetime

import numpy as np

from heliotrope.calibration.learn import drift
from heliotrope.calibration.sightings import Sightings, sightings
from heliotrope.field.plant import Plant
from heliotrope.geometry import MRAD, FloatArray, reflect
from heliotrope.mechanism.tracking import track
from heliotrope.sun import vector

DAY = 86400.0
BEGIN = datetime(2026, 6, 1, tzinfo=UTC).timestamp()
#: The wandering of the zeros: three times as far as by default, fifteen times as fast.
SIZE, TAU, NOISE = 3 * MRAD, 20.0, 2e-4


def wandering(times: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Zeros at times in order (M,), rad, (M, 2)."""
    found, now = np.empty((len(times), 2)), rng.normal(0.0, SIZE, 2)
    for k, days in enumerate(np.diff(times, prepend=times[0]) / DAY):
        keep = np.exp(-days / TAU)
        now = keep * now + rng.normal(0.0, SIZE * np.sqrt(1.0 - keep**2), 2)
        found[k] = now
    return found


def history(plant: Plant, name: str, days: int, seed: int) -> Sightings:
    """Photographs of a mirror: a visit of three each day, at any hour."""
    rng = np.random.default_rng([seed, plant.names.index(name)])
    group, row = plant.find(name)
    hours = np.arange(days)[:, None] + rng.uniform(7.0, 15.0, days)[:, None] / 24.0
    times = (BEGIN + DAY * hours + 20.0 * np.arange(3)).ravel()
    zeros, many = wandering(times, rng), group.mechanism[np.full(len(times), row)]
    suns, aim = vector(times, plant.site), plant.targets[0].center
    counts = track(many, suns, aim).best_counts
    errors = dict(zip(drift.zeros(many), zeros.T, strict=True))
    for tilt in ("tilt_east", "tilt_north"):
        errors[tilt] = np.full(len(times), rng.normal(0.0, 2 * MRAD))
    pose = many.with_parameters(errors).pose(counts)
    away = np.linalg.norm(aim - pose.vertex, axis=1)[:, None]
    light = reflect(suns, pose.normal) + NOISE * rng.standard_normal((len(times), 3))
    seen, mine = pose.vertex + away * light, np.zeros(len(times), np.intp)
    return sightings(mine, counts, suns, seen, time=times, sigma=5e-4)
