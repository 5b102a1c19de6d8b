"""Analyse errors in sequence at Jülich: time since a visit, additions, and what mirrors share.

``python scripts/in_sequence.py DATA`` prints the tables of "In sequence" in
docs/explanation/what-is-left.md. Everything is learnt from the earliest 70 % of each heliostat;
the log evidence is that of this part. Takes two minutes of one core.
"""

import sys
from pathlib import Path

import numpy as np
from what_is_left import JACKS, load

from heliotrope.calibration.evaluation import split
from heliotrope.calibration.learn import Learned, Prediction, assess, learn, predict_by_stream
from heliotrope.calibration.learn.drift import Process, default_processes
from heliotrope.geometry import FloatArray

AZIMUTH, ELEVATION = "azimuth_initial_angle", "elevation_initial_angle"
#: Limits of the time since the previous sighting, hours, and their names.
GAPS = (0.0, 0.25, 1.0, 6.0, 48.0, 168.0, 720.0, np.inf)
NAMED = ("a quarter of an hour", "an hour", "6 hours", "2 days", "a week", "a month", "longer")
#: Larger errors are mistakes, not scatter, rad.
SCATTER = 4e-3


def gaps(learned: Learned) -> FloatArray:
    """Return the hours since the previous sighting of the same heliostat, of those held out."""
    seen = learned.sightings
    found = []
    for row in np.flatnonzero(~learned.used):
        before = seen.time[(seen.heliostat == seen.heliostat[row]) & (seen.time < seen.time[row])]
        found.append((seen.time[row] - before.max()) / 3600.0 if len(before) else np.inf)
    return np.array(found)


def by_gap(learned: Learned, found: Prediction) -> None:
    """Print the errors by the time since the previous sighting."""
    hours, beam = gaps(learned), found.errors.beam
    print("| within | sightings | median | sideways RMS | upward RMS | in the ellipse |")
    print("|---|---|---|---|---|---|")
    for name, low, high in zip(NAMED, GAPS[:-1], GAPS[1:], strict=True):
        mine = (hours >= low) & (hours < high)
        usual = mine & (beam < SCATTER)
        side, up = 1e3 * np.sqrt(np.mean(found.plane[usual] ** 2, axis=0))
        middle, inside = 1e3 * np.median(beam[mine]), 100 * found.inside[mine].mean()
        print(f"| {name} | {mine.sum()} | {middle:.2f} | {side:.2f} | {up:.2f} | {inside:.0f} % |")


def shared(learned: Learned, found: Prediction) -> None:
    """Print what errors of different heliostats have in common, mrad²."""
    held = np.flatnonzero(~learned.used)
    hours, who = learned.sightings.time[held] / 3600.0, learned.sightings.heliostat[held]
    plane, usual = 1e3 * found.plane, found.errors.beam < SCATTER
    both = usual[:, None] & usual & (who[:, None] < who)
    print(f"variance {plane[usual].var(axis=0).round(2)} mrad²")
    for low, high in ((0, 0.09), (0.09, 0.25), (0.25, 1), (1, 3), (3, 8), (23, 25)):
        apart = np.abs(hours[:, None] - hours)
        one, other = np.nonzero(both & (apart >= low) & (apart < high))
        product = plane[one] * plane[other]
        error = product.std(axis=0) / np.sqrt(len(one))
        print(f"{low} to {high} h: {len(one)} pairs, {product.mean(axis=0)} ± {error} mrad²")
    explained, pairs = np.zeros(2), 0
    rest = np.zeros_like(plane)
    for k in np.flatnonzero(usual):
        near = usual & (who != who[k]) & (hours < hours[k]) & (hours > hours[k] - 1.0)
        if near.any():
            rest[k], pairs = plane[near].mean(axis=0), pairs + 1
    used = usual & rest.any(axis=1)
    slope = (rest[used] * plane[used]).sum(axis=0) / (rest[used] ** 2).sum(axis=0)
    left = ((plane[used] - slope * rest[used]) ** 2).sum(axis=0)
    explained = 1.0 - left / (plane[used] ** 2).sum(axis=0)
    print(f"the mean of others within an hour explains {100 * explained} % of {pairs} sightings")


def main() -> None:
    """Print all tables."""
    group, seen = load(Path(sys.argv[1]))
    used = split(seen, "sequential")
    usual = default_processes(group.mechanism)
    still = tuple(p for p in usual if p.group == "slow")
    trials: dict[str, tuple[Process, ...]] = {
        "default": usual,
        "the zeros, not the normal, wander within hours": (
            *still, Process(AZIMUTH, "hours"), Process(ELEVATION, "hours"),
        ),
        "the azimuth zero wanders within hours, too": (*usual, Process(AZIMUTH, "hours")),
        "the azimuth zero wanders over weeks, too": (*usual, Process(AZIMUTH, "weeks")),
        "canting about the secondary axis over weeks, too": (
            *usual, Process("canting_secondary", "weeks"),
        ),
        "canting about the secondary axis over months, too": (
            *usual, Process("canting_secondary", "slow"),
        ),
        "play of the azimuth jack (its stroke) instead": (
            *(p for p in usual if p.parameter != "canting_secondary"),
            Process("azimuth_stroke_offset", "hours"),
        ),
        "tilt to north within hours, too": (*usual, Process("tilt_north", "hours")),
        "the axes' angle within hours, too": (*usual, Process("non_orthogonality", "hours")),
    }  # fmt: skip
    lines = []
    for name, processes in trials.items():
        learned = learn(group.mechanism, seen, JACKS, used=used, processes=processes)
        found = predict_by_stream(learned)
        if name == "default":
            by_gap(learned, found)
            shared(learned, found)
        a = assess(group.names, learned, found)
        evidence = sum(m.log_evidence() for m in learned.members)
        figures = f"{1e3 * a.median_of_medians:.2f} ({100 * a.coverage:.0f} %)"
        lines.append(f"| {name} | {evidence:.0f} | {figures} |")
    print("| processes | log evidence | in sequence |\n|---|---|---|")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
