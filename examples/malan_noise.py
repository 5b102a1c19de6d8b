"""Repeat Malan's noise study (figure 4.11): the effect of a centroid's noise on the beam.

``python malan_noise.py [FOLDER]``. His geometry: Stellenbosch, a heliostat 30.8 m south and
19.2 m east of the tower with its pivot 1.2 m up, a target 13 m up; a measurement every half
hour from 07:30 to 17:30 (UTC+2) on 2 September 2012. The calibrated mirror is then tested on
the same day, four days later (within the season) and on 21 December (another season).

Beside it his own figure, as he describes it (4.4): the machine of his table 6.1, uniform noise
normalised by (4.28), 100 simulations at the summer solstice, and the normalised error of the fitted
model at both solstices, with bands of one standard deviation.
"""

import sys
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from heliotrope import sun
from heliotrope.calibration.fit.estimator import FieldFit, fit
from heliotrope.calibration.sightings import Sightings, sightings
from heliotrope.calibration.uncertainty import expected_error
from heliotrope.geometry import FloatArray, angle_between, reflect
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import direct
from heliotrope.mechanism.tracking import track
from heliotrope.sun import Site

SITE = Site(-33.93, 18.87, 120.0, name="Stellenbosch")
POSITION = (19.2, -30.8, 0.0)
TARGET = np.array([0.0, 0.0, 13.0])
#: Standard deviations of his installation: rad and m.
PRIORS = {
    "tilt_north": 15e-3, "tilt_east": 15e-3, "azimuth_bias": 10e-3, "elevation_bias": 5e-3,
    "non_orthogonality": 5e-3, "position_east": 1.0, "position_north": 1.0, "position_up": 0.3,
}  # fmt: skip
DAYS = {
    "the same day": datetime(2012, 9, 2, tzinfo=UTC),
    "four days later": datetime(2012, 9, 6, tzinfo=UTC),
    "21 December": datetime(2012, 12, 21, tzinfo=UTC),
}
MODEL = tuple(PRIORS)
#: Table 6.1, and the days of his second validation (in the south, summer is in December).
TABLE_6_1 = {
    "position_up": 0.11, "position_east": 1.02, "position_north": -0.53, "tilt_north": -13.27e-3,
    "tilt_east": -4.56e-3, "non_orthogonality": -1.92e-3, "azimuth_bias": -3.79e-3,
    "elevation_bias": 1.12e-3,
}  # fmt: skip
SOLSTICES = {
    "summer": datetime(2012, 12, 21, tzinfo=UTC),
    "winter": datetime(2012, 6, 21, tzinfo=UTC),
}
#: His optimisation has no priors. Without any, a fit of eight parameters to metres of noise runs
#: away; ten times those of the installation leave it free.
FREE = 10.0


def suns(day: datetime, every: timedelta = timedelta(minutes=30)) -> FloatArray:
    """Return the sun's vectors from 07:30 to 17:30 local time, (M, 3)."""
    first = day + timedelta(hours=5.5)
    times = [first + k * every for k in range(int(timedelta(hours=10) / every) + 1)]
    return sun.vector(times, SITE)


def nominal(mirrors: int, worm_ratio: float = 0.0) -> Mechanism:
    """Return ``mirrors`` copies of the nominal heliostat."""
    drives = (direct(), direct(min_angle=-0.2, max_angle=1.8, worm_ratio=worm_ratio))
    places = np.tile(POSITION, (mirrors, 1))
    return kinds.azimuth_elevation(places, pivot_height=1.2, drives=drives)


def measure(drawn: Mechanism, truth: Mechanism, noise: float, seed: int) -> Sightings:
    """Return the half-hourly centroids of the day, with ``noise`` (m) on the target.

    The beam is jogged onto the target before a photograph, within some 10 cm of its centre.
    """
    rng = np.random.default_rng(seed)
    rows, counts, sources, spots = [], [], [], []
    across = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for s in suns(DAYS["the same day"]):
        wanted = track(truth, s, TARGET)
        sent = wanted.best_counts + rng.normal(0.0, 1e-3, (len(drawn), 2))
        pose = truth.pose(sent)
        ray = reflect(s, pose.normal)
        # The target faces south: the plane north = 0.
        spot = pose.vertex - ray * (pose.vertex[:, 1] / ray[:, 1])[:, None]
        rows.append(np.arange(len(drawn)))
        counts.append(sent)
        sources.append(np.tile(s, (len(drawn), 1)))
        spots.append(spot + rng.normal(0.0, noise, (len(drawn), 2)) @ across)
    seen = np.concatenate(spots)
    # A centroid is known on the target's plane: along its normal it is exact.
    spread = noise**2 * np.diag([1.0, 1e-6, 1.0])
    return sightings(
        np.concatenate(rows),
        np.concatenate(counts),
        np.concatenate(sources),
        seen,
        sigma=1e-6,
        destination_covariance=spread,
    )


@dataclass(frozen=True)
class Study:
    """RMS beam errors over many mirrors, rad, by day."""

    actual: dict[str, float]
    predicted: dict[str, float]
    found: FieldFit
    truth: dict[str, FloatArray]


def study(
    noise: float,
    mirrors: int = 200,
    seed: int = 0,
    worm: float = 0.0,
    model: tuple[str, ...] = MODEL,
) -> Study:
    """Calibrate many mirrors drawn from the priors, and command them on the three days.

    Parameters
    ----------
    noise
        Standard deviation of a centroid in each direction on the target, m.
    mirrors
        Number of mirrors.
    seed
        Seed of mirrors and noise.
    worm
        Amplitude of a once-per-turn error of the elevation's worm (40 : 1), rad.
    model
        Parameters to estimate.
    """
    rng = np.random.default_rng(seed)
    drawn = nominal(mirrors, worm_ratio=40.0 if worm else 0.0)
    truth = {name: rng.normal(0.0, size, mirrors) for name, size in PRIORS.items()}
    if worm:
        phase = rng.uniform(0.0, 2.0 * np.pi, mirrors)
        truth["elevation_worm_cos"] = worm * np.cos(phase)
        truth["elevation_worm_sin"] = worm * np.sin(phase)
    real = drawn.with_parameters(truth)
    seen = measure(drawn, real, noise, seed + 1)
    found = fit(drawn, seen, model, priors=PRIORS, loss="square", adapt_scale=False)
    learnt = drawn.with_parameters(found.parameters)
    actual, predicted = {}, {}
    for label, day in DAYS.items():
        sky = suns(day, timedelta(minutes=20))
        wanted = track(learnt, sky[:, None, :], TARGET)
        pose = real.pose(wanted.best_counts)
        way = TARGET - pose.vertex
        way = way / np.linalg.norm(way, axis=-1, keepdims=True)
        error = angle_between(reflect(sky[:, None, :], pose.normal), way)
        actual[label] = float(np.sqrt(np.mean(error**2)))
        squares = [
            np.mean(
                expected_error(learnt[k], found.names, found.covariance[k], sky, TARGET).rms ** 2
            )
            for k in range(0, mirrors, 10)
        ]
        predicted[label] = float(np.sqrt(np.mean(squares)))
    return Study(actual, predicted, found, truth)


def _offsets(machine: Mechanism, sky: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return counts (M, 1, 2) of the nominal mirror, and the image's offsets, m, (M, N, 2)."""
    wanted = track(nominal(1), sky[:, None, :], TARGET)
    counts = wanted.best_counts
    pose = machine.pose(counts)
    ray = reflect(sky[:, None, :], pose.normal)
    spot = pose.vertex - ray * (pose.vertex[..., 1] / ray[..., 1])[..., None]
    return counts, (spot - TARGET)[..., [0, 2]]


def normalised(
    level: float, simulations: int = 100, seed: int = 0, wide: float = FREE
) -> dict[str, FloatArray]:
    """Return the normalised RMS errors of his second validation by solstice, (simulations,).

    Parameters
    ----------
    level
        His n, 0 to 1: the noise is n times the RMS of the offsets times uniform numbers in ±1.
    simulations, seed
        Number of fresh sets of noise, and the seed.
    wide
        Factor of the priors.
    """
    rng = np.random.default_rng(seed)
    real = nominal(1).with_parameters(TABLE_6_1)
    sky = {name: suns(day) for name, day in SOLSTICES.items()}
    sky = {name: light[light[:, 2] > 0.1] for name, light in sky.items()}
    counts, true = _offsets(real, sky["summer"])
    rows = (len(true), simulations)
    size = np.sqrt(np.mean(np.sum(true**2, axis=-1)))
    spots = np.zeros((*rows, 3)) + TARGET
    spots[..., [0, 2]] += true + level * size * rng.uniform(-1.0, 1.0, (*rows, 2))
    seen = sightings(
        np.tile(np.arange(simulations), rows[0]),
        np.broadcast_to(counts, (*rows, 2)).reshape(-1, 2),
        np.repeat(sky["summer"], simulations, axis=0),
        spots.reshape(-1, 3),
        sigma=1e-6,
        destination_covariance=max(level * size, 1e-3) ** 2 / 3.0 * np.diag([1.0, 1e-6, 1.0]),
    )
    priors = {name: wide * sigma for name, sigma in PRIORS.items()}
    start = nominal(simulations)
    found = fit(start, seen, MODEL, priors=priors, loss="square", adapt_scale=False)
    learnt = start.with_parameters(found.parameters)
    errors = {}
    for name, light in sky.items():
        ideal, fitted = _offsets(real, light)[1], _offsets(learnt, light)[1]
        left = np.mean(np.sum((ideal - fitted) ** 2, axis=-1), axis=0)
        errors[name] = np.sqrt(left / np.mean(np.sum(ideal**2, axis=-1)))
    return errors


def draw_his(folder: Path) -> Path:
    """Draw figure 4.11 as he describes it; return the picture's path."""
    levels = np.linspace(0.0, 1.0, 6)
    studies = [normalised(float(level)) for level in levels]
    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    ax = figure.subplots()
    for name, colour in (("summer", "#0072b2"), ("winter", "#d55e00")):
        middle = np.array([s[name].mean() for s in studies])
        band = np.array([s[name].std() for s in studies])
        ax.plot(levels, middle, "o-", color=colour, label=f"{name} solstice")
        ax.fill_between(levels, middle - band, middle + band, color=colour, alpha=0.2, lw=0)
        said = (f"{m:.3f} ± {b:.3f}" for m, b in zip(middle, band, strict=True))
        print(f"{name}: {', '.join(said)}")
    held = [normalised(float(level), wide=1.0) for level in levels]
    for priors, made in (("without priors", studies), ("with those of the installation", held)):
        worse = [s["winter"].mean() / s["summer"].mean() for s in made[1:]]
        print(f"winter over summer, {priors}: {min(worse):.1f} to {max(worse):.1f} times")
    ax.set(xlabel="normalised noise, (4.28)", ylabel="normalised RMS error", ylim=(0.0, None))
    ax.grid(alpha=0.3)
    ax.legend(frameon=False)
    path = folder / "malan-figure-4-11.png"
    figure.savefig(path, dpi=120)
    return path


def main(folder: Path) -> Path:
    """Draw the normalised error against the noise; return the picture's path."""
    noises = np.array([0.002, 0.005, 0.01, 0.02, 0.05])
    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    ax = figure.subplots()
    slant = np.linalg.norm(TARGET - np.array([*POSITION[:2], 1.2]))
    studies = [study(noise, mirrors=60) for noise in noises]
    for label, colour, marker in zip(
        DAYS, ("#0072b2", "#009e73", "#d55e00"), ("o", "s", "D"), strict=True
    ):
        actual = np.array([s.actual[label] for s in studies]) * slant / noises
        predicted = np.array([s.predicted[label] for s in studies]) * slant / noises
        ax.plot(1e3 * noises, actual, marker, color=colour, label=f"{label}, actual")
        ax.plot(1e3 * noises, predicted, "-", color=colour, lw=1, label=f"{label}, predicted")
        for noise, s in zip(noises, studies, strict=True):
            print(
                f"{1e3 * noise:5.0f} mm  {label:16} actual {1e3 * s.actual[label]:6.3f} mrad, "
                f"predicted {1e3 * s.predicted[label]:6.3f} mrad"
            )
    ax.set_xscale("log")
    ax.set_xticks(1e3 * noises, [f"{1e3 * n:.0f}" for n in noises])
    ax.set_xticks([], minor=True)
    ax.set_ylim(bottom=0)
    ax.set_xlabel("noise of a centroid, mm")
    ax.set_ylabel("RMS of the beam on the target / noise")
    ax.grid(alpha=0.3, which="both")
    ax.legend(frameon=False, ncols=3, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "figure-4-11.png"
    figure.savefig(path, dpi=120)
    print(draw_his(folder))
    return path


if __name__ == "__main__":
    print(main(Path(sys.argv[1] if len(sys.argv) > 1 else "out")))
