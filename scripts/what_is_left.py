"""Analyse the residuals of the model at Jülich: tables and pictures for the documentation.

``python scripts/what_is_left.py DATA [FOLDER]`` with the folder of the data and, by default,
docs/images for the pictures. Prints the tables of docs/explanation/what-is-left.md.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from heliotrope.calibration import evaluation
from heliotrope.calibration.fit.estimator import fit
from heliotrope.calibration.learn import drift
from heliotrope.calibration.learn.assessment import ENOUGH, assess
from heliotrope.calibration.learn.drift import DAY, Process
from heliotrope.calibration.learn.learned import Learned, left_out_errors
from heliotrope.calibration.learn.learning import learn
from heliotrope.calibration.sightings import Sightings, of_measurements
from heliotrope.field.formats import measurements, paint
from heliotrope.field.heliostats import Heliostats
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.parameters import MODELS

JACKS = MODELS["jacks"]
PUBLIC = tuple(p for p in JACKS if p != "canting")
SPLITS: tuple[evaluation.Split, ...] = ("random", "chronological", "neighbour")


def load(folder: Path) -> tuple[Heliostats, Sightings]:
    """Return heliostats and sightings with UTIS centroids."""
    ((_, group),) = paint.read_plant(folder).groups.items()
    seen, _ = of_measurements(measurements.read_measurements(folder), group)
    return group, seen


def robust(group: Heliostats, seen: Sightings, train: FloatArray, model: tuple[str, ...]) -> float:
    """Return the median of the held-out medians of a plain robust fit, mrad."""
    found = fit(group.mechanism, seen, model, keep=train)
    beam = evaluation.beam_errors(group.mechanism.with_parameters(found.parameters), seen).beam
    counts = np.bincount(seen.heliostat, minlength=len(group))
    return 1e3 * float(
        np.median(
            [
                np.median(beam[(seen.heliostat == i) & ~train])
                for i in np.flatnonzero(counts >= ENOUGH)
            ]
        )
    )


def ladder(group: Heliostats, seen: Sightings) -> list[tuple[str, list[str]]]:
    """Return the held-out figures after each addition to the model, by split."""
    still = drift.default_processes(group.mechanism)
    hours = tuple(p for p in still if p.group == "hours")
    zeros = drift.zeros(group.mechanism)
    known = group.mechanism.parameters

    def learnt(model: tuple[str, ...] = JACKS, **options: object) -> Callable[..., list[str]]:
        def run(train: FloatArray) -> tuple[float, float]:
            a = assess(group.names, learn(group.mechanism, seen, model, used=train, **options))  # type: ignore[arg-type]
            return 1e3 * a.median_of_medians, a.coverage

        return run  # type: ignore[return-value]

    def plain(model: tuple[str, ...]) -> Callable[..., tuple[float, float]]:
        return lambda train: (robust(group, seen, train, model), np.nan)

    slow = [
        ("slow tilts too", ("tilt_north", "tilt_up")),
        ("slow strokes too", ("elevation_stroke_offset", "azimuth_stroke_offset")),
        ("slow canting too", ("canting",)),
    ]
    trials: list[tuple[str, Callable[..., object]]] = [
        ("two jacks and tilts, robust fit", plain(PUBLIC)),
        ("with the mirror's canting", plain(JACKS)),
        ("population, regimes, outliers", learnt(processes=())),
        ("the normal quivers within hours", learnt(processes=hours)),
        ("the zeros creep, and step (default)", learnt()),
        ("the zeros wander over weeks too",
         learnt(processes=still + tuple(Process(z, "weeks") for z in zeros))),
        *((name, learnt(processes=still + tuple(Process(p, "slow") for p in which)))
          for name, which in slow),
        ("gravity (sag)", learnt((*JACKS, "sag"))),
        ("pivot radii", learnt((*JACKS, "azimuth_pivot_radius", "elevation_pivot_radius"))),
        ("survey", learnt((*JACKS, "position_east", "position_north", "position_up"))),
        ("everything", learnt(tuple(n for n in known if "worm" not in n))),
    ]  # fmt: skip
    rows = []
    for name, run in trials:
        cells = []
        for kind in SPLITS:
            median, coverage = run(evaluation.split(seen, kind, 0.7, 0))  # type: ignore[misc]
            shown = f" ({100 * coverage:.0f} %)" if np.isfinite(coverage) else ""
            cells.append(f"{median:.2f}{shown}")
        rows.append((name, cells))
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
    return rows


def explained(found: Learned, group: Heliostats) -> None:
    """Print the share of the residuals that each possible cause explains, by heliostat."""
    seen = found.sightings
    rest = 1e3 * left_out_errors(found)
    day = seen.time / DAY
    hour = 24.0 * (day % 1.0)
    season = 2.0 * np.pi * day / 365.25
    target = (seen.destination[:, 0] < -10).astype(float) + 2.0 * (seen.destination[:, 2] < 39.5)
    causes: dict[str, Callable[[FloatArray], FloatArray]] = {
        "hour of the day": lambda r: np.c_[hour[r], hour[r] ** 2],
        "season (temperature)": lambda r: np.c_[np.cos(season[r]), np.sin(season[r])],
        "target": lambda r: np.c_[target[r] == 1, target[r] >= 2],
        "place on the target": lambda r: seen.destination[r][:, [0, 2]],
        "azimuth moved since the last": lambda r: np.sign(
            np.diff(seen.counts[r, 1], prepend=seen.counts[r[0], 1])
        )[:, None],
        "elevation moved since the last": lambda r: np.sign(
            np.diff(seen.counts[r, 0], prepend=seen.counts[r[0], 0])
        )[:, None],
    }
    rng = np.random.default_rng(0)
    for name, columns in causes.items():
        gains = []
        for i in range(len(group)):
            r = found.rows[i][~found.outlier[found.rows[i]]]
            r = r[np.isfinite(seen.time[r])]
            r = r[np.argsort(seen.time[r])]
            if len(r) < 50:
                continue
            gains.append(
                _gain(columns(r), rest[r])
                - np.mean([_gain(rng.permutation(columns(r)), rest[r]) for _ in range(20)])
            )
        print(f"| {name} | {100 * np.median(gains):.1f} % | {100 * np.max(gains):.1f} % |")
    _spindle(found, rest)


def _gain(columns: FloatArray, rest: FloatArray) -> float:
    """Return the share of the variance that a regression explains."""
    x = np.c_[np.ones(len(columns)), columns.astype(float)]
    fitted = x @ np.linalg.lstsq(x, rest, rcond=None)[0]
    return float(1.0 - ((rest - fitted) ** 2).sum() / ((rest - rest.mean(axis=0)) ** 2).sum())


def _spindle(found: Learned, rest: FloatArray) -> None:
    """Search each jack for a periodic error over its stroke, with periods of 0.5 to 20 mm."""
    seen = found.sightings
    periods = np.geomspace(0.5e-3, 20e-3, 400)
    for axis, name in ((0, "elevation"), (1, "azimuth")):
        power = np.zeros(len(periods))
        total = 0
        for i, rows in enumerate(found.rows):
            r = rows[~found.outlier[rows]]
            if len(r) < 50:
                continue
            total += 1
            stroke = seen.counts[r, axis] * found.mechanism[i].drives.table[axis, 2]
            for k, period in enumerate(periods):
                phase = 2.0 * np.pi * stroke / period
                power[k] += _gain(np.c_[np.cos(phase), np.sin(phase)], rest[r])
        best = int(np.argmax(power))
        print(
            f"| periodic error of the {name} spindle | best period {1e3 * periods[best]:.2f} mm: "
            f"{100 * power[best] / total:.1f} %, mean over all periods "
            f"{100 * power.mean() / total:.1f} % |"
        )


def in_time(found: Learned, still: Learned, folder: Path) -> None:
    """Draw the correlation of two errors of one heliostat, by the time between them."""
    seen = found.sightings
    edges = np.array([0.0, 0.25, 0.5, 1.0, 2.0, 6.0, 24.0, 96.0, 24 * 14.0, 24 * 60.0, 24 * 400.0])
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    ax = figure.subplots()
    for label, source, colour in (
        ("constant parameters", still, "#999999"),
        ("with all that wanders", found, "#0072b2"),
    ):
        rest = 1e3 * left_out_errors(source)
        lags, squares = [], []
        for rows in source.rows:
            r = rows[~found.outlier[rows] & ~source.outlier[rows]]
            a, b = np.triu_indices(len(r), 1)
            lags.append(np.abs(seen.time[r[a]] - seen.time[r[b]]) / 3600.0)
            squares.append(((rest[r[a]] - rest[r[b]]) ** 2).sum(axis=1) / 2.0)
        lag, square = np.concatenate(lags), np.concatenate(squares)
        place = np.digitize(lag, edges)
        middle = [np.sqrt(np.median(square[place == k])) for k in range(1, len(edges))]
        ax.plot(np.arange(len(middle)), middle, "o-", color=colour, label=label)
        print(label, " ".join(f"{m:.2f}" for m in middle))
    names = ["15 min", "30 min", "1 h", "2 h", "6 h", "1 d", "4 d", "2 w", "2 mon", "1 y"]
    ax.set_xticks(np.arange(len(names)), names)
    ax.set_xlabel("time between two measurements of one heliostat, up to")
    ax.set_ylabel("difference a measurement, mrad of beam (median)")
    ax.set_ylim(bottom=0)
    ax.grid(alpha=0.3)
    ax.legend(frameon=False)
    figure.savefig(folder / "likeness.png", dpi=110)


def history(found: Learned, group: Heliostats, folder: Path) -> None:
    """Draw the estimated drift of the zeros of some heliostats."""
    figure = Figure(figsize=(9.0, 7.5), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True)
    names = found.names
    for ax, heliostat in zip(axes, ("BE36", "BF57", "BH35", "BF41"), strict=True):
        i = group.index(heliostat)
        rows = found.rows[i]
        seen = found.sightings.time[rows]
        times = np.linspace(np.nanmin(seen), np.nanmax(seen), 600)
        values, spread = found.parameters_at(np.full(600, i), times)
        dates = (times * 1e6).astype("datetime64[us]")
        for name, colour in (
            ("elevation_initial_angle", "#0072b2"),
            ("azimuth_initial_angle", "#d55e00"),
        ):
            p = names.index(name)
            middle = 1e3 * (values[:, p] - np.median(values[:, p]))
            sigma = 1e3 * np.sqrt(spread[:, p, p] - spread[:, p, p].min())
            ax.plot(dates, middle, color=colour, lw=1, label=name)
            ax.fill_between(dates, middle - sigma, middle + sigma, color=colour, alpha=0.2, lw=0)
        for day in found.members[i].data.steps:
            ax.axvline(np.datetime64(int(day * DAY), "s").astype("datetime64[us]"), ls=":", c="k")
        ax.plot(
            (seen * 1e6).astype("datetime64[us]"), np.full(len(seen), ax.get_ylim()[0]), "|k", ms=6
        )
        ax.set_ylabel(f"{heliostat}, mrad")
        ax.grid(alpha=0.3)
    axes[0].legend(frameon=False, ncols=2)
    figure.savefig(folder / "zeros.png", dpi=110)


def main(data: Path, folder: Path) -> None:
    """Print all tables and draw all pictures."""
    group, seen = load(data)
    found = learn(group.mechanism, seen, "jacks")
    still = learn(group.mechanism, seen, "jacks", processes=())
    in_time(found, still, folder)
    history(found, group, folder)
    print("| cause | explains, median | most |")
    print("constant parameters:")
    explained(still, group)
    print("with all that wanders:")
    explained(found, group)
    ladder(group, seen)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2] if len(sys.argv) > 2 else "docs/images"))
