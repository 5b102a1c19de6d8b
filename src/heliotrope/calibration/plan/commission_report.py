"""A commissioning plan as tables, a JSON document, a plot and a page."""

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from heliotrope.calibration.plan.commission import CommissionPlan, mirrors_of
from heliotrope.calibration.plan.report import iso
from heliotrope.files.html import STYLE, picture, render
from heliotrope.files.text import write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HOUR = 3600.0


def hour_rows(plan: CommissionPlan, targets: Sequence[str]) -> list[dict[str, Any]]:
    """Return one record per hour and place, with the error predicted at the end of the hour."""
    rows, places = [], _places(plan, targets)
    order = sorted(plan.visits, key=lambda visit: (visit.begin // _HOUR, visit.target))
    for (hour, target), group in groupby(order, key=lambda v: (v.begin // _HOUR, v.target)):
        visits = list(group)
        first = mirrors_of(v for v in visits if v.first)
        after = np.concatenate([v.after for v in visits])
        middle, high = at(plan, (hour + 1.0) * _HOUR)
        rows.append(
            {
                "hour": iso(hour * _HOUR),
                "target": places[target],
                "visits": len(visits),
                "mirrors": mirrors_of(visits),
                "first": first,
                "expected_beam_rms_mrad": 1e3 * float(np.sqrt(np.mean(after**2))),
                "field_median_mrad": 1e3 * middle,
                "field_90_mrad": 1e3 * high,
            }
        )
    return rows


def _places(plan: CommissionPlan, targets: Sequence[str]) -> list[str]:
    """Return the names of the targets, and of the receiver if there are visits to it."""
    receiver = plan.terms.receiver
    return [*targets] if receiver is None else [*targets, receiver.face.name]


def at(plan: CommissionPlan, time: float) -> tuple[float, float]:
    """Return the predicted 50th and 90th percentiles of the beam error at a POSIX time, s, rad.

    The field is not measured at night, so the prediction is constant between two days.
    """
    middle, high = (np.interp(time, plan.time, plan.percentiles[:, q]) for q in (0, 1))
    return float(middle), float(high)


def visit_rows(
    plan: CommissionPlan, heliostats: Sequence[str], targets: Sequence[str]
) -> list[dict[str, Any]]:
    """Return one record for each heliostat of each visit, in order of time."""
    places = _places(plan, targets)
    return [
        {
            "visit": number + 1,
            "begin": iso(visit.begin),
            "end": iso(visit.end),
            "target": places[visit.target],
            "heliostat": heliostats[i],
            "together": len(visit.heliostats),
            "first": visit.first,
            "expected_beam_rms_mrad": 1e3 * float(after),
        }
        for number, visit in enumerate(plan.visits)
        for i, after in zip(visit.heliostats.tolist(), visit.after, strict=True)
    ]


def curve_rows(plan: CommissionPlan) -> list[dict[str, Any]]:
    """Return the predicted curve, one record for each interval."""
    return [
        {"time": iso(t), "median_mrad": 1e3 * p[0], "p90_mrad": 1e3 * p[1], "rms_mrad": 1e3 * r}
        for t, p, r in zip(plan.time.tolist(), plan.percentiles.tolist(), plan.rms, strict=True)
    ]


def document(
    plan: CommissionPlan, heliostats: Sequence[str], targets: Sequence[str]
) -> dict[str, Any]:
    """Return the whole plan as a JSON object."""
    places = _places(plan, targets)
    return {
        "targets": list(targets),
        "receiver": None if plan.terms.receiver is None else places[-1],
        "goal_mrad": 1e3 * plan.terms.goal,
        "reached": None if plan.reached is None else iso(plan.reached),
        "limit": plan.limit,
        "floor_mrad": 1e3 * plan.terms.floor,
        "never_measured": plan.unseen,
        "days": [{"begin": iso(a), "end": iso(b)} for a, b in plan.days],
        "seconds": plan.seconds,
        "curve": curve_rows(plan),
        "hours": hour_rows(plan, targets),
        "visits": [
            {
                "begin": iso(v.begin),
                "end": iso(v.end),
                "target": places[v.target],
                "heliostats": [heliostats[i] for i in v.heliostats.tolist()],
                "joint": v.joint,
                "first": v.first,
            }
            for v in plan.visits
        ],
    }


def sentence(plan: CommissionPlan) -> str:
    """Return when the goal is reached, or what keeps the plan from it, in one line."""
    high, goal = 1e3 * plan.percentiles[-1, 1], 1e3 * plan.terms.goal
    if plan.reached is not None:
        day = sum(begin < plan.reached for begin, _ in plan.days)
        when = datetime.fromtimestamp(plan.reached, UTC)
        return (
            f"goal of {goal:.2f} mrad reached on day {day}, {when:%Y-%m-%d %H:%M} UTC; "
            f"targets used for {100.0 * plan.busy:.0f} % of their time until then"
        )
    head = f"goal of {goal:.2f} mrad not reached: {high:.2f} mrad at the end"
    if plan.unseen:
        head += f", {plan.unseen:,} heliostats never measured"
    return f"{head}; limited by {plan.limit}"


def curve_picture(plan: CommissionPlan) -> "Figure":
    """Return a picture of the visits, and of the predicted percentiles over the hours of sun."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for k, (colour, label) in enumerate((("#0072b2", "median"), ("#d55e00", "90th percentile"))):
        for n, part in enumerate(_days(plan)):
            days = (plan.time[part] - plan.time[0]) / 86400.0
            left.plot(days, 1e3 * plan.percentiles[part, k], color=colour, label="" if n else label)
    left.axhline(1e3 * plan.terms.goal, color="#000000", lw=0.8, ls=":", label="goal")
    left.set_yscale("log")
    left.set_xlabel("days")
    left.set_ylabel("predicted beam error of the field, mrad")
    left.legend(frameon=False, fontsize=8)
    begin = np.array([v.begin for v in plan.visits])
    count = np.array([len(v.heliostats) for v in plan.visits])
    first = np.array([v.first for v in plan.visits], dtype=np.bool_)
    if len(begin):
        hours = np.floor((begin - plan.time[0]) / _HOUR)
        for mask, colour, label in ((first, "#e69f00", "first"), (~first, "#009e73", "later")):
            every = np.unique(hours)
            mirrors = [float(count[mask & (hours == h)].sum()) for h in every]
            right.plot(every / 24.0, mirrors, ".", color=colour, label=f"{label} visits")
        right.legend(frameon=False, fontsize=8)
    right.set_xlabel("days")
    right.set_ylabel("mirrors measured in an hour")
    for ax in (left, right):
        ax.grid(alpha=0.3, which="both")
    return figure


def _days(plan: CommissionPlan) -> Iterator[np.ndarray]:
    """Yield the indices into the curve, day by day."""
    for begin, end in plan.days:
        rows = np.flatnonzero((plan.time >= begin) & (plan.time <= end))
        if rows.size:
            yield rows


def write_page(path: Path, plan: CommissionPlan, name: str, targets: Sequence[str]) -> None:
    """Write the report: the summary, the curve, and a record for each hour and target.

    Parameters
    ----------
    path
        HTML file; its folder exists.
    plan, name, targets
        The plan, the name of the plant, and the names of the targets.
    """
    page = render(
        "heliotrope.calibration.plan",
        "commission.html.j2",
        style=STYLE,
        plant=name,
        sentence=sentence(plan),
        rows=hour_rows(plan, targets),
        curve=picture(curve_picture(plan), "Predicted percentiles, and mirrors measured an hour"),
        terms=plan.terms,
    )
    write_text(path, page)
