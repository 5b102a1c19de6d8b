"""A simulated field for demonstrations: measured on a target, then tracked for a day."""

from dataclasses import dataclass
from datetime import date, datetime, timedelta
from typing import TYPE_CHECKING

import numpy as np

from heliotrope import sun as solar
from heliotrope.calibration.sightings import Sightings, sightings
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, angle_between, reflect
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import track
from heliotrope.sun import Site

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def measure(
    nominal: Mechanism,
    truth: Mechanism,
    target: Target,
    site: Site,
    days: tuple[date, ...],
    noise: float = 5e-3,
    seed: int = 0,
) -> Sightings:
    """Return sightings of every heliostat every 70 minutes, as a target camera would measure them.

    Parameters
    ----------
    nominal, truth
        Mechanisms as assumed by the control system and as built, (N,).
    target, site
        Target of the beams; site and atmosphere.
    days
        Days of measurement.
    noise
        Standard deviation of a centroid in each direction, m.
    seed
        Seed of the noise.
    """
    rng = np.random.default_rng((seed, 1))
    parts = []
    for day in days:
        times = solar.daylight(day, site, every=timedelta(minutes=70), min_elevation=0.2)
        for time, sun in zip(times, solar.vector(times, site), strict=True):
            tracking = track(nominal, sun, target.center)
            counts = np.round(tracking.best_counts)
            pose = truth.pose(counts)
            spot = target.intersect(pose.vertex, reflect(sun, pose.normal))
            spot = spot + rng.normal(0.0, noise, (len(nominal), 2)) @ target.axes
            visible = np.flatnonzero(np.isfinite(spot).all(axis=-1))
            suns = np.tile(sun, (len(visible), 1))
            parts.append(
                (
                    visible,
                    counts[visible],
                    suns,
                    spot[visible],
                    np.full(len(visible), time.timestamp()),
                )
            )
    rows, counts, source, spots, seconds = (np.concatenate(p) for p in zip(*parts, strict=True))
    distance = np.linalg.norm(nominal.position[rows] - target.center, axis=-1)
    return sightings(rows, counts, source, spots, time=seconds, sigma=noise / distance)


@dataclass(frozen=True)
class TrackedDay:
    """Beam errors of N true mirrors at T times of a day, rad, (T, N).

    Attributes
    ----------
    times
        T times.
    before, after
        Errors when commanded by the nominal and by the calibrated mechanisms.
    """

    times: list[datetime]
    before: FloatArray
    after: FloatArray

    @property
    def rms(self) -> tuple[float, float]:
        """Return the RMS error before and after calibration, rad."""
        return float(np.sqrt(np.mean(self.before**2))), float(np.sqrt(np.mean(self.after**2)))


def track_day(
    group: Heliostats, truth: Mechanism, aim: FloatArray, site: Site, day: date
) -> TrackedDay:
    """Return the beam errors every 5 minutes over a day.

    Parameters
    ----------
    group
        Heliostats with their calibration.
    truth
        Mechanisms as built, (N,).
    aim, site, day
        Aim point, (3,); site; day in UTC.
    """
    times = solar.daylight(day, site, every=timedelta(minutes=5), min_elevation=0.1)
    suns = solar.vector(times, site)

    def beam(mechanism: Mechanism) -> FloatArray:
        tracking = track(mechanism, suns[:, None, :], aim)
        pose = truth.pose(np.round(tracking.best_counts))
        to_aim = aim - pose.vertex
        to_aim = to_aim / np.linalg.norm(to_aim, axis=-1, keepdims=True)
        return angle_between(reflect(suns[:, None, :], pose.normal), to_aim)

    return TrackedDay(list(times), beam(group.mechanism), beam(group.calibrated))


def day_picture(day: TrackedDay) -> "Figure":
    """Return a picture of the beam errors over the day."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    ax = figure.subplots()
    midnight = day.times[0].replace(hour=0, minute=0, second=0, microsecond=0)
    hours = np.array([(t - midnight).total_seconds() / 3600.0 for t in day.times])
    count = day.before.shape[1]
    for errors, colour, label in (
        (day.before, "#999999", "as installed"),
        (day.after, "#0072b2", "calibrated"),
    ):
        lines = ax.plot(hours, 1e3 * errors, color=colour, lw=0.8, alpha=0.7)
        lines[0].set_label(f"{label} ({count} heliostats)")
    ax.set_yscale("log")
    ax.set_xlabel(f"hour of {midnight.date()}, UTC")
    ax.set_ylabel("beam error of the true mirror, mrad")
    ax.grid(alpha=0.3, which="both")
    ax.legend(frameon=False)
    return figure
