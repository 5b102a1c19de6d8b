"""Calibration results as files: a complete JSON file, a Parquet table, a plant file.

For each heliostat the JSON file contains the parameters with their covariance at one moment,
regimes, steps and outliers; it also contains the hyperparameters of the field. The Parquet table
has one record per heliostat. The plant file is that of the input plant, with the calibrated
parameters added.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope import __version__
from heliotrope.calibration.fit.estimator import FitOutcome
from heliotrope.calibration.learn.drift import DAY, TEACHERS, posterior
from heliotrope.calibration.learn.learned import Learned
from heliotrope.calibration.learn.learning import FEWEST
from heliotrope.errors import InputError
from heliotrope.field.plant import Plant
from heliotrope.files import json as _json
from heliotrope.files.text import write_file, write_text
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.parameters import shown_in
from heliotrope.values import amount

KIND = "heliotrope calibration"
VERSION = 1
_AXES = ("east", "north", "up")


@dataclass(frozen=True)
class FieldParameters:
    """Parameters of N heliostats at one moment.

    Attributes
    ----------
    model
        Names of the constant parameters.
    names
        Names of the P parameters, including those that only drift.
    heliostats
        Names, (N,).
    time
        Time of that moment, Unix seconds; NaN if unknown.
    values, covariance
        Deviations, (N, P), and their covariance, (N, P, P); the units are rad, m or 1.
    noise
        Noise of a sighting, in units of its stated sigma, (N,).
    used
        Number of sightings used, (N,).
    learnt
        Whether the parameters come from the heliostat's own sightings, (N,). All other heliostats
        receive only the part that is common to the field.
    shared
        Whether enough heliostats support the common part of a parameter, (P,). If not, its value is
        0 for a heliostat that was not learnt.
    """

    model: tuple[str, ...]
    names: tuple[str, ...]
    heliostats: tuple[str, ...]
    time: float
    values: FloatArray
    covariance: FloatArray
    noise: FloatArray
    used: npt.NDArray[np.int64]
    learnt: npt.NDArray[np.bool_]
    shared: npt.NDArray[np.bool_]

    def only(self, rows: npt.NDArray[np.bool_]) -> "FieldParameters":
        """Return the parameters of the heliostats selected by a mask, (N,)."""
        return replace(
            self,
            heliostats=tuple(n for n, kept in zip(self.heliostats, rows, strict=True) if kept),
            **{name: getattr(self, name)[rows] for name in _BY_HELIOSTAT},
        )

    def applied_to(self, plant: Plant) -> tuple[Plant, tuple[str, ...]]:
        """Return the plant with these parameters, and notes on the heliostats that were not learnt.

        Heliostats that were not learnt keep their own parameters. A heliostat that has no
        parameters receives the part that is common to the field, if enough heliostats support it.
        """
        own = np.zeros(len(self.heliostats), np.bool_)
        for i, name in enumerate(self.heliostats):
            group, row = plant.find(name)
            own[i] = any(values[row] != 0.0 for values in group.parameters.values())
        filled = ~self.learnt & ~own & (self.used == 0) & self.shared.any()
        rest = ~(self.learnt | filled)
        lines = []
        if filled.any():
            i = int(np.flatnonzero(filled)[0])
            scaled = []
            for p in np.flatnonzero(self.shared):
                scale, unit = shown_in(self.names[p])
                scaled.append(f"{self.names[p]} {scale * self.values[i, p]:+.2g} {unit}".strip())
            lines.append(
                f"{amount(int(filled.sum()), 'heliostat')} without sightings of their own: they "
                f"get the part shared by the {int(self.learnt.sum())} measured heliostats: "
                f"{', '.join(scaled)}"
            )
        if rest.any():
            lines.append(f"{amount(int(rest.sum()), 'heliostat')} not learnt: parameters unchanged")
        kept = self.learnt | filled
        return plant.with_calibration(self.only(kept)) if kept.any() else plant, tuple(lines)

    @property
    def parameters(self) -> dict[str, FloatArray]:
        """Values by name, each (N,), in the form that `Mechanism.with_calibration` accepts."""
        return {name: self.values[:, p] for p, name in enumerate(self.names)}

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the values, (N, P)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1)))


#: The arrays that have one row per heliostat.
_BY_HELIOSTAT = ("values", "covariance", "noise", "used", "learnt")
#: A parameter has a common part if that part is this many standard deviations from 0.
SUPPORTED = 3.0


def at_moment(
    names: tuple[str, ...], learned: Learned, time: float | None = None
) -> FieldParameters:
    """Return the parameters at Unix ``time``; default: the time of the last used sighting."""
    known = learned.sightings.time[learned.used & np.isfinite(learned.sightings.time)]
    when = float(known.max()) if time is None and len(known) else np.nan
    if time is not None:
        when = time
    rows = np.arange(len(names))
    values, spread = learned.parameters_at(rows, np.full(len(names), when))
    own = np.isin(learned.static.outcome, (FitOutcome.CONVERGED, FitOutcome.NOT_CONVERGED))
    used = np.array([len(m.data) for m in learned.members])
    hyper, teachers = learned.hyper, int((used >= FEWEST).sum())
    shared = np.abs(hyper.mean) > SUPPORTED * hyper.spread / np.sqrt(max(teachers, 1))
    shared &= teachers >= TEACHERS
    values[~own] = np.where(shared & (used[~own, None] == 0), hyper.mean, 0.0)
    for i in np.flatnonzero(~own):
        data = learned.members[i].data
        unknown = posterior(hyper, data.take(np.zeros(len(data), np.bool_)))
        spread[i] = unknown.at(np.array([when / DAY]), np.zeros(1, np.int64))[1][0]
    return FieldParameters(
        learned.model,
        learned.names,
        names,
        when,
        values,
        spread,
        np.array([m.hyper.noise for m in learned.members]),
        used,
        own,
        shared,
    )


def write_json(
    path: Path,
    names: tuple[str, ...],
    learned: Learned,
    results: FieldParameters,
    ids: tuple[str, ...],
) -> None:
    """Write everything as JSON.

    Parameters
    ----------
    path
        The file.
    names
        Names of the N heliostats.
    learned
        The learnt field.
    results
        Parameters of the field at one moment.
    ids
        Names of the M sightings, for the list of outliers.
    """
    h = learned.hyper
    document = {
        "kind": KIND,
        "version": VERSION,
        "program": f"heliotrope {__version__}",
        "time": _moment(results.time),
        "model": list(learned.model),
        "parameters": list(learned.names),
        "units": [learned.mechanism.parameter(n).unit for n in learned.names],
        "field": {
            "mean": h.mean.tolist(),
            "spread": h.spread.tolist(),
            "processes": [
                {
                    "parameter": p.parameter,
                    "group": p.group,
                    "amplitude": float(a),
                    "days": float(h.tau[g]),
                }
                for p, a, g in zip(h.processes, h.amplitude, h.group, strict=True)
            ],
            "noise": h.noise,
            "heavy_tails": h.heavy,
            "steps_per_day": h.rate,
        },
        "heliostats": {name: _heliostat(i, learned, results, ids) for i, name in enumerate(names)},
    }
    write_text(path, json.dumps(document, ensure_ascii=False, indent=1) + "\n")


def _heliostat(
    i: int, learned: Learned, results: FieldParameters, ids: tuple[str, ...]
) -> dict[str, Any]:
    rows = learned.rows[i]
    member = learned.members[i]
    label = learned.regime[rows]
    time = learned.sightings.time
    regimes = [
        {
            "first": _moment(float(np.nanmin(time[rows[label == k]]))),
            "last": _moment(float(np.nanmax(time[rows[label == k]]))),
            "sightings": int((label == k).sum()),
        }
        for k in np.unique(label)
        if k > 0
    ]
    return {
        "values": results.values[i].tolist(),
        "covariance": results.covariance[i].tolist(),
        "sightings": int(results.used[i]),
        "learnt": bool(results.learnt[i]),
        "outcome": FitOutcome(int(learned.static.outcome[i])).name.lower(),
        "noise": float(results.noise[i]),
        "regimes": regimes,
        "steps": [_moment(float(day) * DAY) for day in member.data.steps],
        "outliers": [ids[k] for k in rows[learned.outlier[rows]]],
    }


def _moment(seconds: float) -> str | None:
    if not np.isfinite(seconds):
        return None
    return datetime.fromtimestamp(seconds, UTC).isoformat()


def read_json(path: str | Path) -> FieldParameters:
    """Return the parameters of the learnt heliostats from a file written by `write_json`.

    Raises
    ------
    FormatError
        If the file was not written by `write_json`; the message says what is wrong and where.
    """
    root = _json.read_json(path, "a calibration")
    if not root.has("kind") or root["kind"].text() != KIND:
        raise root.fail(
            f"not a calibration: kind must be {KIND!r}; use a file written by heliotrope calibrate"
        )
    root["version"].number(VERSION, VERSION)
    names = tuple(node.text() for node in root["parameters"].elements())
    members = [
        (name, node)
        for name, node in root["heliostats"].items()
        if not node.has("learnt") or node["learnt"].value is True
    ]
    size = len(names)
    values, spread = np.empty((len(members), size)), np.empty((len(members), size, size))
    for i, (_, node) in enumerate(members):
        values[i] = _numbers(node["values"], size)
        rows = node["covariance"].elements()
        if len(rows) != size:
            raise node["covariance"].fail(f"{len(rows)} rows for {size} parameters")
        spread[i] = [_numbers(row, size) for row in rows]
    return FieldParameters(
        tuple(node.text() for node in root["model"].elements()),
        names,
        tuple(name for name, _ in members),
        _seconds(root["time"]),
        values,
        spread,
        np.array([node["noise"].number(0.0) for _, node in members]),
        np.array([node["sightings"].number(0.0) for _, node in members], dtype=np.int64),
        np.ones(len(members), np.bool_),
        np.zeros(size, np.bool_),
    )


def _numbers(node: _json.JsonNode, size: int) -> list[float]:
    numbers = [part.number() for part in node.elements()]
    if len(numbers) != size:
        raise node.fail(f"{len(numbers)} numbers for {size} parameters")
    return numbers


def _seconds(node: _json.JsonNode) -> float:
    if node.value is None:
        return float("nan")
    try:
        return datetime.fromisoformat(node.text()).timestamp()
    except ValueError:
        raise node.fail(f"{node.value!r} is not an ISO 8601 time") from None


def write_parquet(path: Path, mechanism_units: dict[str, str], results: FieldParameters) -> None:
    """Write one record per heliostat: parameters and standard deviations with their units."""
    import pandas as pd

    columns: dict[str, Any] = {"name": results.heliostats, "sightings": results.used}
    sigma = results.sigma
    for p, name in enumerate(results.names):
        unit = mechanism_units[name]
        suffix = "" if unit == "1" else f"_{unit}"
        columns[f"{name}{suffix}"] = results.values[:, p]
        columns[f"{name}_sigma{suffix}"] = sigma[:, p]
    columns["noise"] = results.noise
    frame = pd.DataFrame(columns)
    write_file(path, lambda part: frame.to_parquet(part, index=False))


def write_paint(
    folder: str | Path, plant: Plant, learned: Learned, time: float | None = None
) -> dict[str, tuple[str, ...]]:
    """Write the learnt parameters as heliostat properties in PAINT's format.

    ARTIST reads these files but sets the joint tilts to 0; `write_artist` writes ARTIST's own
    format.

    Parameters
    ----------
    folder
        Folder for ``properties/NAME.json`` of each learnt heliostat, and for ``left-out.txt`` with
        the parameters that the format cannot hold.
    plant
        The plant that the field was learnt from.
    learned
        Learnt field whose heliostats have names.
    time
        Unix seconds; default: the time of the last sighting used.

    Returns
    -------
    For each heliostat, the parameters that the format cannot hold, with their values.

    Raises
    ------
    InputError
        If no learnt heliostat has a name, or a mechanism is not of kind ``two_jacks``.
    """
    from heliotrope.field.formats import paint

    calibrated = _calibrated(plant, learned, time, "write_paint")
    groups = {name: calibrated.find(name)[0] for name in learned.heliostats}
    for name, group in groups.items():
        paint.written(group, name)
    place = Path(folder)
    try:
        (place / "properties").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{place}: cannot be created ({error.strerror}); choose another folder"
        ) from None
    omitted: dict[str, tuple[str, ...]] = {}
    for name, group in groups.items():
        file = place / "properties" / f"{name}.json"
        omitted[name] = paint.write_heliostat(group, name, plant.site.origin, file)
    lines = [f"{name}: {', '.join(lost)}" for name, lost in omitted.items() if lost]
    write_text(place / "left-out.txt", "".join(f"{line}\n" for line in lines))
    return omitted


def write_artist(
    path: str | Path,
    scenario: str | Path,
    plant: Plant,
    learned: Learned,
    time: float | None = None,
) -> dict[str, tuple[str, ...]]:
    """Write a copy of an ARTIST scenario with the learnt parameters of its heliostats.

    Parameters
    ----------
    path, scenario
        HDF5 files: the new scenario, and the scenario created by ARTIST's generator.
    plant
        The plant that the field was learnt from.
    learned
        Learnt field whose heliostats have names, all of which are in the scenario.
    time
        Unix seconds; default: the time of the last sighting used.

    Returns
    -------
    For each heliostat, the parameters that the format cannot hold, with their values.

    Raises
    ------
    FormatError
        If the scenario cannot be read, or has a different layout.
    InputError
        If no learnt heliostat has a name, a mechanism is not of kind ``two_jacks``, or a heliostat
        is not in the scenario.
    """
    from heliotrope.field.formats import artist

    calibrated = _calibrated(plant, learned, time, "write_artist")
    groups = {name: calibrated.find(name)[0] for name in learned.heliostats}
    return artist.write_scenario(path, scenario, groups, plant.site.origin)


def write_opencsp(
    path: str | Path, table: str | Path, plant: Plant, learned: Learned, time: float | None = None
) -> dict[str, tuple[str, ...]]:
    """Write a copy of an OpenCSP heliostat table with the learnt positions.

    Parameters
    ----------
    path, table
        The new table, and the table from which the plant was read.
    plant
        The plant that the field was learnt from.
    learned
        Learnt field whose heliostats have names, all of which are in the table.
    time
        Unix seconds; default: the time of the last sighting used.

    Returns
    -------
    For each heliostat, the parameters that the table cannot hold: all except the position.

    Raises
    ------
    FormatError
        If the table cannot be read.
    InputError
        If no learnt heliostat has a name, or a heliostat is not in the table.
    """
    from heliotrope.field.formats import opencsp

    old = opencsp.read_field(table)
    calibrated = _calibrated(plant, learned, time, "write_opencsp")
    moved, lost = _moved(calibrated, learned.heliostats, old.names, old.location, table)
    opencsp.write_field(path, replace(old, location=moved))
    return lost


def write_solarpilot(
    path: str | Path, layout: str | Path, plant: Plant, learned: Learned, time: float | None = None
) -> dict[str, tuple[str, ...]]:
    """Write a copy of a SolarPILOT layout with the learnt positions.

    SolarPILOT has no names, so the order of the lines is kept. The arguments are those of
    `write_opencsp`.

    Returns
    -------
    For each heliostat, the parameters that the layout cannot hold: all except the position.

    Raises
    ------
    FormatError
        If the layout cannot be read.
    InputError
        If no learnt heliostat has a name, or a heliostat is not in the layout.
    """
    from heliotrope.field.formats import solarpilot

    old = solarpilot.read_layout(layout, plant.site)
    calibrated = _calibrated(plant, learned, time, "write_solarpilot")
    moved, lost = _moved(calibrated, learned.heliostats, old.names, old.location, layout)
    solarpilot.write_layout(path, replace(old, location=moved))
    return lost


def _moved(
    plant: Plant,
    heliostats: Sequence[str],
    names: Sequence[str],
    location: FloatArray,
    source: str | Path,
) -> tuple[FloatArray, dict[str, tuple[str, ...]]]:
    """Return the learnt locations (N, 3), and the parameters that are lost, by heliostat."""
    rows, moved = {name: i for i, name in enumerate(names)}, location.copy()
    lost: dict[str, tuple[str, ...]] = {}
    for name in heliostats:
        if name not in rows:
            raise InputError(
                f"heliostat {name}: {source} has no heliostat with that name; pass the file from "
                "which the plant was read"
            )
        group, i = plant.find(name)
        values = {key: float(column[i]) for key, column in group.parameters.items()}
        moved[rows[name]] += [values.pop(f"position_{axis}", 0.0) for axis in _AXES]
        mechanism = group.mechanism
        lost[name] = tuple(
            f"{key} {value:.4g} {mechanism.parameter(key).unit}"
            for key, value in values.items()
            if value
        )
    return moved, lost


def _calibrated(plant: Plant, learned: Learned, time: float | None, what: str) -> Plant:
    """Return the plant with the learnt parameters; ``what`` names the format in errors."""
    if not learned.heliostats:
        raise InputError(
            f"{what}: learnt without heliostat names; learn from the plant, or plant[name]"
        )
    return at_moment(learned.heliostats, learned, time).applied_to(plant)[0]
