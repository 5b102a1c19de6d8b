"""PAINT's official splits of Jülich's real measurements: Heliotrope beside ARTIST, same sightings.

Both learn from the training part of the same heliostats, those with 20 measurements or more, and
are tested on the same test part. Needs the data (HELIOTROPE_DATA); ARTIST joins where
HELIOTROPE_ARTIST_PYTHON names its interpreter. Heliotrope learns with population, drift, steps and
outliers, from nominal parameters that may be wrong; ARTIST fits four tilts by least squares.
"""

import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _artist
from benchmarks._run import Result, Row
from heliotrope.calibration.evaluation import partition
from heliotrope.calibration.learn import learn, predict
from heliotrope.calibration.paint_splits import KINDS
from heliotrope.calibration.sightings import Sightings, of_measurements
from heliotrope.field.formats import measurements, paint
from heliotrope.mechanism.parameters import MODELS

ENOUGH = 20
COLUMNS = (
    "split", "contender", "heliostats", "tested", "median_of_medians_mrad",
    "mean_of_medians_mrad", "processor_s_per_heliostat", "error_ratio", "time_ratio",
)  # fmt: skip
#: Heliostats of a quick run.
FEW = 3


def _data() -> Path | None:
    named = os.environ.get("HELIOTROPE_DATA")
    return Path(named) if named else None


def _row(split: str, contender: str, errors: list[np.ndarray], seconds: float) -> Row:
    each = [np.median(e) for e in errors]
    return {
        "split": split,
        "contender": contender,
        "heliostats": len(errors),
        "tested": sum(map(len, errors)),
        "median_of_medians_mrad": 1e3 * float(np.median(each)),
        "mean_of_medians_mrad": 1e3 * float(np.mean(each)),
        "processor_s_per_heliostat": seconds / len(errors),
    }


def with_ratios(rows: list[Row]) -> list[Row]:
    """Return the rows with error and time as multiples of Heliotrope's in the same split."""
    measured = {"error_ratio": "median_of_medians_mrad", "time_ratio": "processor_s_per_heliostat"}
    ours = {row["split"]: row for row in rows if row["contender"] == "Heliotrope"}
    return [
        row | {r: row[of] / ours[row["split"]][of] for r, of in measured.items()}  # type: ignore[operator]
        for row in rows
    ]


def _ours(group: Any, seen: Sightings, training: Any, tested: Any, rows: Any) -> Any:
    start = time.process_time()
    part = seen.take(np.flatnonzero(training | tested))
    learned = learn(group.mechanism, part, MODELS["jacks"], used=training[training | tested])
    beam = predict(learned, seen.take(np.flatnonzero(tested))).errors.beam
    who = seen.heliostat[tested]
    return [beam[who == i] for i in rows], time.process_time() - start


def run(quick: bool) -> Result:
    """Return errors and times on each split, or why there are none."""
    data = _data()
    if data is None:
        nothing: Row = dict.fromkeys(COLUMNS)
        return Result([nothing | {"split": "none"}], "skipped: HELIOTROPE_DATA is not set")
    ((_, group),) = paint.read_plant(data).groups.items()
    found = measurements.read_measurements(data)
    seen, _ = of_measurements(found, group)
    known = set(group.names)
    ids = [i for n, i in zip(found.heliostat, found.ids, strict=True) if n in known]
    rows = np.flatnonzero(np.bincount(seen.heliostat, minlength=len(group)) >= ENOUGH)
    rows = rows[:FEW] if quick else rows
    kept = np.flatnonzero(np.isin(seen.heliostat, rows))
    seen, ids = seen.take(kept), [ids[k] for k in kept]
    skipped = _artist.why_skipped()
    table: list[Row] = []
    for kind in KINDS[:1] if quick else KINDS:
        training, tested = partition(seen, kind)  # type: ignore[arg-type]
        errors, seconds = _ours(group, seen, training, tested, rows)
        table.append(_row(kind, "Heliotrope", errors, seconds))
        if skipped:
            continue
        jobs, asked = [], []
        for i in rows:
            mine = np.flatnonzero(training & (seen.heliostat == i))
            names = [ids[k] for k in mine]
            jobs.append(_artist.job(data, kind, group.names[i], names, seen.take(mine)))
            asked.append(seen.take(np.flatnonzero(tested & (seen.heliostat == i))).of(i))
        theirs = _artist.reconstruct(data, jobs)
        errors = [
            _artist.beam_errors(group.mechanism[i : i + 1], part, result["tilts"])
            for i, part, result in zip(rows, asked, theirs, strict=True)
        ]
        table.append(_row(kind, "ARTIST", errors, sum(r["processor_s"] for r in theirs)))
    first = table[0]
    return Result(
        with_ratios(table),
        f"{first['split']} split: {first['median_of_medians_mrad']:.2f} mrad, median of the "
        f"medians of {first['heliostats']} heliostats",
        {"artist": f"skipped: {skipped}" if skipped else "same sightings"},
    )
