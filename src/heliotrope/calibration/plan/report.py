"""Plans as tables, JSON documents and plots."""

import csv
import io
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from heliotrope.calibration.plan.campaign import CalibrationCampaign
from heliotrope.calibration.plan.fleets import Fleet
from heliotrope.calibration.plan.planning import CandidateSightings, SightingPlan
from heliotrope.errors import InputError
from heliotrope.files.html import as_written
from heliotrope.files.text import write_file, write_text
from heliotrope.geometry import FloatArray, azimuth_elevation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Okabe and Ito's colours, which colour-blind readers can distinguish.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
_PICTURES = (".png", ".svg", ".pdf")


def plan_rows(heliostat: str, plan: SightingPlan) -> list[dict[str, Any]]:
    """Return one record for each sighting, in order of time."""
    c = plan.chosen
    azimuth, elevation = np.degrees(azimuth_elevation(c.sun))
    normal_azimuth, normal_elevation = np.degrees(azimuth_elevation(c.normal))
    return [
        {
            "heliostat": heliostat,
            "time": iso(c.time[k]),
            "target": c.targets[c.target[k]],
            "sun_azimuth_deg": float(azimuth[k]),
            "sun_elevation_deg": float(elevation[k]),
            "normal_azimuth_deg": float(normal_azimuth[k]),
            "normal_elevation_deg": float(normal_elevation[k]),
            "incidence_deg": float(np.degrees(c.incidence[k])),
            "obliquity_deg": float(np.degrees(c.obliquity[k])),
            **_counts(c.counts[k]),
            "rank": int(plan.rank[k]),
            "log_det_gain": float(plan.gain[k]),
            "expected_beam_rms_mrad": float(1e3 * plan.error[k]),
        }
        for k in range(len(plan))
    ]


def campaign_rows(
    campaign: CalibrationCampaign, heliostats: Sequence[str], targets: Sequence[str]
) -> list[dict[str, Any]]:
    """Return one record for each measurement, in order of time."""
    return [
        {
            "time": iso(campaign.time[k]),
            "target": targets[campaign.target[k]],
            "heliostat": heliostats[campaign.heliostat[k]],
            "leave": iso(campaign.leave[k]),
            "arrive": iso(campaign.arrive[k]),
            "done": iso(campaign.done[k]),
            "back": iso(campaign.back[k]),
            **_counts(campaign.counts[k]),
            "heliostat_expected_beam_rms_mrad": float(1e3 * campaign.heliostat_error[k]),
            "field_expected_beam_rms_mrad": float(1e3 * campaign.error[k]),
        }
        for k in range(len(campaign))
    ]


def plans_document(
    plans: Mapping[str, SightingPlan], fleets: Sequence[Fleet], targets: Sequence[str]
) -> dict[str, Any]:
    """Return the plans of some heliostats as a JSON object."""
    return {
        **_head(fleets, targets),
        "heliostats": {
            name: {
                "before_expected_beam_rms_mrad": 1e3 * plan.before,
                "log_det_gain": plan.log_det,
                "measurements": plan_rows(name, plan),
            }
            for name, plan in plans.items()
        },
    }


def campaign_document(
    campaign: CalibrationCampaign, fleets: Sequence[Fleet], targets: Sequence[str]
) -> dict[str, Any]:
    """Return a campaign as a JSON object."""
    labels = [name for fleet in fleets for name in fleet.labels]
    return {
        **_head(fleets, targets),
        "slots": campaign.slots,
        "before_expected_beam_rms_mrad": 1e3 * campaign.before,
        "after_expected_beam_rms_mrad": 1e3 * campaign.after,
        "measurements": campaign_rows(campaign, labels, targets),
    }


def _head(fleets: Sequence[Fleet], targets: Sequence[str]) -> dict[str, Any]:
    return {
        "targets": list(targets),
        "parameters": list(dict.fromkeys(p for fleet in fleets for p in fleet.names)),
        "sigma_mrad": 1e3 * fleets[0].sigma,
    }


def _counts(counts: FloatArray) -> dict[str, float]:
    return {f"count_{d + 1}": float(value) for d, value in enumerate(counts)}


def iso(seconds: float) -> str:
    """Return unix seconds as ISO 8601 in UTC, with milliseconds only if they are not 0."""
    time = datetime.fromtimestamp(round(float(seconds), 3), UTC)
    unit = "milliseconds" if time.microsecond else "seconds"
    return time.isoformat(timespec=unit).replace("+00:00", "Z")


def write_table(path: str | Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write records as CSV, completely or not at all, with their keys as the header.

    Raises
    ------
    InputError
        If the folder does not exist or cannot be written to.
    """
    text = io.StringIO(newline="")
    if rows:
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    write_text(path, text.getvalue())


def write_picture(path: str | Path, figure: "Figure") -> None:
    """Write a picture as PNG, SVG or PDF, as its suffix says, completely or not at all.

    Raises
    ------
    InputError
        If the suffix is not one of these, or the folder cannot be written to.
    """
    suffix = check_picture(path)

    def draw(stream: BinaryIO) -> None:
        as_written(figure)
        figure.savefig(stream, dpi=110, format=suffix.removeprefix("."))

    write_file(path, draw)


def check_picture(path: str | Path) -> str:
    """Return the suffix of a picture's name.

    Raises
    ------
    InputError
        If the suffix is not .png, .svg or .pdf.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _PICTURES:
        raise InputError(
            f"picture {path}: the name ends in {suffix!r}; use one of {', '.join(_PICTURES)}"
        )
    return suffix


def plan_picture(plans: Mapping[str, SightingPlan], possible: CandidateSightings) -> "Figure":
    """Return a picture of the sun's path with the chosen sightings, and of the expected error.

    Parameters
    ----------
    plans
        Plans, by heliostat name.
    possible
        Candidates; their sun positions are drawn as small dots.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    centre = _centre(possible.sun)
    _sun_paths(left, possible, centre)
    for n, (name, plan) in enumerate(plans.items()):
        colour = _COLOURS[n % len(_COLOURS)]
        azimuth, elevation = _place(plan.chosen.sun, centre)
        left.plot(azimuth, elevation, "o", ms=5, color=colour, label=name)
        if len(plans) == 1:
            _ranks(left, azimuth, elevation, plan)
        steps = np.arange(len(plan) + 1)
        right.plot(
            steps,
            1e3 * np.append(plan.before, plan.error),
            "o-",
            ms=4,
            color=colour,
            label=f"{name}, in order of time",
        )
        right.plot(
            steps,
            1e3 * np.append(plan.before, plan.best_first),
            ":",
            color=colour,
            label=f"{name}, best first",
        )
    left.set_xlabel("azimuth of the sun, ° clockwise from north")
    left.set_ylabel("elevation, °")
    right.set_xlabel("measurements made")
    right.set_ylabel("expected beam error over the year, mrad RMS")
    right.set_yscale("log")
    left.xaxis.set_major_formatter(lambda x, _: f"{x % 360.0:g}")
    _finish((left, right), legend=len(plans) <= len(_COLOURS))
    return figure


def _sun_paths(ax: "Axes", possible: CandidateSightings, centre: float) -> None:
    order = np.argsort(possible.time, kind="stable")
    time, sun = possible.time[order], possible.sun[order]
    # A gap longer than 30,000 s is a night.
    for n, run in enumerate(
        np.split(np.arange(len(time)), np.flatnonzero(np.diff(time) > 3e4) + 1)
    ):
        azimuth, elevation = _place(sun[run], centre)
        ax.plot(
            azimuth, elevation, ".-", ms=2, lw=0.5, color="#bbbbbb", label="" if n else "possible"
        )


def _ranks(ax: "Axes", azimuth: FloatArray, elevation: FloatArray, plan: SightingPlan) -> None:
    """Write ranks beside the points, with a single label for points that are close together."""
    remaining = list(range(len(plan)))
    while remaining:
        first = remaining[0]
        near = [
            k
            for k in remaining
            if np.hypot(azimuth[k] - azimuth[first], elevation[k] - elevation[first]) < 4.0
        ]
        text = ", ".join(str(r) for r in sorted(plan.rank[near]))
        ax.annotate(
            text,
            (azimuth[first], elevation[first]),
            xytext=(5, 5),
            textcoords="offset points",
            fontsize=8,
        )
        remaining = [k for k in remaining if k not in near]


def campaign_picture(
    campaign: CalibrationCampaign, position: FloatArray, targets: Sequence[str]
) -> "Figure":
    """Return a map of the expected errors after the campaign, and a plot of the error over time.

    Parameters
    ----------
    campaign
        The campaign.
    position
        Positions of the heliostats, ENU metres, (N, 3).
    targets
        Names.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    order = np.argsort(-campaign.expected, kind="stable")
    dots = left.scatter(
        position[order, 0],
        position[order, 1],
        c=1e3 * campaign.expected[order],
        s=8,
        cmap="viridis_r",
    )
    figure.colorbar(dots, ax=left, label="expected beam error after, mrad RMS")
    left.set_aspect("equal", adjustable="datalim")
    left.set_xlabel("east, m")
    left.set_ylabel("north, m")
    hours = (campaign.time - campaign.time[0]) / 3600.0 if len(campaign) else np.empty(0)
    right.plot(
        hours,
        1e3 * campaign.error,
        color=_COLOURS[0],
        label=f"{len(campaign):,} measurements on {', '.join(targets)}",
    )
    right.set_xlabel("hours since the first measurement")
    right.set_ylabel("expected beam error of the field, mrad RMS")
    if len(campaign) and campaign.before > 10.0 * campaign.error[-1]:
        right.set_yscale("log")
    _finish((left, right), legend=False)
    right.legend(frameon=False, fontsize=8)
    return figure


def _finish(axes: "Sequence[Axes]", legend: bool) -> None:
    for ax in axes:
        ax.grid(alpha=0.3, which="both")
        if legend:
            ax.legend(frameon=False, fontsize=8)


def _centre(suns: FloatArray) -> float:
    """Return the azimuth of the mean sun position, °."""
    return float(np.degrees(azimuth_elevation(suns.sum(axis=0))[0]))


def _place(suns: FloatArray, centre: float) -> tuple[FloatArray, FloatArray]:
    """Return azimuths within half a turn of ``centre``, and elevations, both in degrees."""
    azimuth, elevation = np.degrees(azimuth_elevation(suns))
    return np.asarray((azimuth - centre + 180.0) % 360.0 - 180.0 + centre), elevation
