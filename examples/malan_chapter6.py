"""Repeat chapter 6 of Malan's thesis with a simulated mirror: ``malan_chapter6.py [FOLDER]``.

His heliostat of 6.3 (30.8 m south and 19.2 m east of the tower) has the errors of his table 6.1.
It is measured every half hour on 2 September 2012 (without 14:00 to 16:00, as his was),
calibrated with his eight parameters, and tracks open loop on 6, 7 and 8 September, measured every
minute as in his figure 6.5: figures 6.4 to 6.6. What is left is periodic in the elevation, 12° or
one turn of a worm of 30:1; it is searched, fitted to 6 September as he did with (6.1), and removed
on 7 and 8 September: figures 6.7 and 6.8.

He does not print the amplitude of his worm, nor the noise of his centroids. Ours: 1.35 mrad,
of which his constants leave 0.77 mrad RMS of the normal (his: 0.97), and 5 mm.
"""

import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from heliotrope import sun
from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.fit.estimator import fit
from heliotrope.calibration.learn.periodic import search_periodic_errors, with_ratios
from heliotrope.calibration.sightings import Sightings, camera_target
from heliotrope.geometry import FloatArray, reflect
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import direct
from heliotrope.mechanism.tracking import track
from heliotrope.sun import Site

MRAD = 1e-3
SITE = Site(-33.93, 18.87, 120.0, name="Stellenbosch")
TARGET = np.array([0.0, 0.0, 13.0])
#: Table 6.1.
TABLE_6_1 = {
    "position_up": 0.11, "position_east": 1.02, "position_north": -0.53,
    "tilt_north": -13.27 * MRAD, "tilt_east": -4.56 * MRAD, "non_orthogonality": -1.92 * MRAD,
    "azimuth_bias": -3.79 * MRAD, "elevation_bias": 1.12 * MRAD,
}  # fmt: skip
#: Standard deviations of his installation: rad and m.
PRIORS = {
    "tilt_north": 15e-3, "tilt_east": 15e-3, "azimuth_bias": 10e-3, "elevation_bias": 5e-3,
    "non_orthogonality": 5e-3, "position_east": 1.0, "position_north": 1.0, "position_up": 0.3,
}  # fmt: skip
#: (6.1) with a phase of ours.
WORM = {
    "elevation_worm_ratio": 30.0,
    "elevation_worm_cos": 1.03 * MRAD,
    "elevation_worm_sin": 0.87 * MRAD,
}
CENTROID = 5e-3
MALAN8 = tuple(PRIORS)


def nominal() -> Mechanism:
    """Return the heliostat as it was surveyed, (1,)."""
    drives = (direct(), direct(min_angle=-0.2, max_angle=1.8))
    return kinds.azimuth_elevation([[19.2, -30.8, 0.0]], pivot_height=1.2, drives=drives)


def times(
    day: int, every: timedelta, without: tuple[float, float] = (25.0, 25.0)
) -> list[datetime]:
    """Return the times of a day in September 2012, 07:30 to 17:30 local (UTC + 2 h)."""
    first = datetime(2012, 9, day, 5, 30, tzinfo=UTC)
    all_ = [first + k * every for k in range(int(timedelta(hours=10) / every) + 1)]
    low, high = without
    return [t for t in all_ if not low < t.hour + 2 + t.minute / 60 < high]


def measured(real: Mechanism, believed: Mechanism, when: list[datetime], seed: int) -> Sightings:
    """Return the centroids on the target (its plane faces south) of a mirror that tracks it."""
    light = sun.vector(when, SITE)
    row = np.zeros(len(when), dtype=np.intp)
    wanted = track(believed[row], light, TARGET)
    counts = wanted.best_counts
    pose = real[row].pose(counts)
    ray = reflect(light, pose.normal)
    spot = pose.vertex - ray * (pose.vertex[:, 1] / ray[:, 1])[:, None]
    spot[:, [0, 2]] += np.random.default_rng(seed).normal(0.0, CENTROID, (len(when), 2))
    time = np.array([t.timestamp() for t in when])
    spread = CENTROID**2 * np.diag([1.0, 1e-6, 1.0])
    return camera_target(
        row, counts, light, spot, time=time, sigma=1e-4, centroid_covariance=spread
    )


def off(machine: Mechanism, seen: Sightings) -> FloatArray:
    """Return the beam's distance from where ``machine`` predicts it, rad right and up, (M, 2)."""
    return beam_errors(machine, seen).offset


def rms(offsets: FloatArray) -> float:
    """Return the RMS distance, rad of beam."""
    return float(np.sqrt(np.mean(np.sum(offsets**2, axis=-1))))


def experiment() -> tuple[dict[str, float], dict[str, tuple[Sightings, FloatArray, FloatArray]]]:
    """Return the figures of merit, mrad of the beam, and the curves.

    A curve is (sightings, error under the constants, error with the worm), rad of beam, by day.
    """
    start = nominal()
    real = start.with_parameters({**TABLE_6_1, **WORM})
    first = measured(real, start, times(2, timedelta(minutes=30), (14.0, 16.0)), 1)
    # His fminsearch has neither priors nor noise; the worm is noise to these eight parameters.
    found = fit(start, first, MALAN8, priors=PRIORS, loss="square")
    constants = start.with_parameters(found.parameters)
    curves = {"2": (first, off(start, first), off(constants, first))}
    later = {
        str(day): measured(real, constants, times(day, timedelta(minutes=1)), day)
        for day in (6, 7, 8)
    }
    # The search needs no more than every fifth minute, and takes a fifth of the time for it.
    sixth = later["6"].take(np.arange(0, len(later["6"]), 5))
    errors = search_periodic_errors(start, sixth)
    geared = with_ratios(start, errors)
    names = tuple(f"{e.joint}_worm_{part}" for e in errors if e.found for part in ("cos", "sin"))
    again = fit(geared, sixth, MALAN8 + names, priors=PRIORS)
    worm = geared.with_parameters(again.parameters)
    curves |= {day: (seen, off(constants, seen), off(worm, seen)) for day, seen in later.items()}
    figures = {"before": rms(curves["2"][1]), "fitted": rms(curves["2"][2])}
    for day in later:
        figures |= {f"constants {day}": rms(curves[day][1]), f"worm {day}": rms(curves[day][2])}
    figures = {name: value / MRAD for name, value in figures.items()}
    figures |= {"ratio": errors[0].ratio, "ratio sigma": errors[0].sigma}
    figures |= {"amplitude": float(errors[0].amplitude[0]) / MRAD}
    figures |= {"false alarm": errors[0].false_alarm}
    return figures, curves


def draw(folder: Path, curves: dict[str, tuple[Sightings, FloatArray, FloatArray]]) -> Path:
    """Draw figures 6.4 to 6.8; return the picture's path."""
    figure = Figure(figsize=(10.0, 7.0), layout="constrained")
    day, target, repeat, worm = figure.subplots(2, 2).ravel()
    hours = {d: (c[0].time % 86400.0) / 3600.0 + 2.0 for d, c in curves.items()}
    colours = {"2": "#0072b2", "6": "#d55e00", "7": "#009e73", "8": "#cc79a7"}
    for column, style in ((0, "-"), (1, "--")):
        side = ("X", "Y")[column]
        _, before, after = curves["2"]
        day.plot(hours["2"], before[:, column] / MRAD, "o" + style, ms=3, color="#0072b2",
                 label=f"2 September, {side}")  # fmt: skip
        day.plot(hours["2"], after[:, column] / MRAD, style, color="#cc79a7",
                 label=f"residual of the fit, {side}")  # fmt: skip
        day.plot(hours["6"], curves["6"][1][:, column] / MRAD, style, color="#d55e00",
                 label=f"6 September, {side}")  # fmt: skip
    day.set(title="figure 6.4", xlabel="local time, h", ylabel="beam error, mrad")
    target.plot(*(curves["6"][1].T / MRAD), ".", ms=3, color="#d55e00")
    target.set(title="figure 6.5: 6 September on the target", xlabel="X, mrad", ylabel="Y, mrad")
    target.set_aspect("equal", "datalim")
    for d in ("6", "7", "8"):
        repeat.plot(hours[d], curves[d][1][:, 1] / MRAD, color=colours[d], label=f"{d} September")
    repeat.set(title="figure 6.6: three days, Y", xlabel="local time, h", ylabel="mrad")
    seen, constants, left = curves["6"]
    elevation = np.degrees(nominal().drives[1].angles(seen.counts[:, 1]))
    worm.plot(elevation, constants[:, 1] / MRAD, ".", ms=4, color="#d55e00", label="residual")
    worm.plot(elevation, (constants - left)[:, 1] / MRAD, "-", color="#0072b2", label="worm, (6.1)")
    worm.set(title="figures 6.7 and 6.8: against the elevation", xlabel="elevation, °",
             ylabel="Y, mrad")  # fmt: skip
    for ax in (day, repeat, worm):
        ax.legend(frameon=False, fontsize=7)
    for ax in (day, target, repeat, worm):
        ax.grid(alpha=0.3)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "malan-chapter-6.png"
    figure.savefig(path, dpi=110)
    return path


def main(folder: Path) -> dict[str, float]:
    """Print the figures beside his, draw the curves, and return the figures."""
    figures, curves = experiment()
    print(f"planted: table 6.1, worm of {np.hypot(1.03, 0.87):.2f} mrad, centroids to 5 mm")
    print("beam error, mrad RMS                           ours   his")
    print(f"2 September, as installed                    {figures['before']:6.2f}")
    print(f"2 September, after the fit                   {figures['fitted']:6.2f}")
    for day, his in (("6", "1.94"), ("7", ""), ("8", "")):
        left = figures[f"constants {day}"]
        print(f"{day} September, constants (normal: half)       {left:6.2f}   {his}")
    for day in ("7", "8"):
        print(f"{day} September, with the worm of 6 September   {figures[f'worm {day}']:6.2f}")
    print(
        f"worm of the elevation: ratio {figures['ratio']:.2f} ± {figures['ratio sigma']:.2f} (his "
        f"30), {figures['amplitude']:.2f} mrad, chance {figures['false alarm']:.0e}"
    )
    print(draw(folder, curves))
    return figures


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out"))
