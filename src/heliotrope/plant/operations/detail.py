"""One heliostat and one emergency of a plant at work, in detail."""

from typing import TYPE_CHECKING

import numpy as np

from heliotrope.mechanism.drives import Drive
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.field import FrameMaker
from heliotrope.plant.operations.views import (
    DriveView,
    EmergencyView,
    HeliostatView,
    ParameterView,
)

if TYPE_CHECKING:
    from heliotrope.plant.operations.work import Automat

#: Supply and temperature of a board that has not told them.
_UNTOLD = 0
#: So many names of those that have not carried out an emergency are told.
_SOME = 20


def detail(plant: PlantController, work: "Automat", frames: FrameMaker, name: str) -> HeliostatView:
    """Return one heliostat.

    Raises
    ------
    UnknownNameError
        If there is none of that name.
    """
    row = plant.field.place(name)
    shown = plant.field.of(name, plant.now())
    node = plant.field.rows[row]
    told = shown.live and int(node["supply_mv"]) != _UNTOLD
    truth = work.truth_errors()
    hold = work.holds.get(name)
    width, height = frames.sizes[row]
    return HeliostatView(
        name,
        shown.cluster,
        row,
        frames.positions[row],
        float(width),
        float(height),
        shown.live,
        shown.age,
        shown.state,
        shown.fault,
        shown.flags,
        1e-3 * float(node["supply_mv"]) if told else float("nan"),
        float(node["temperature_degc"]) if told else float("nan"),
        int(node["boots"]) if shown.live else 0,
        _drives(plant, row) if shown.live else (),
        plant.aims[row].copy(),
        plant.standbys[row].copy(),
        frames.on_name(row),
        _parameters(plant, work, name),
        float(work.book.error[row]),
        float("nan") if truth is None else float(truth[row]),
        work.book.history(name),
        work.book.results_of(name),
        next((p for p in work.plan(50) if p.heliostat == name), None),
        "" if hold is None else f"{hold.reason} ({hold.who})",
    )


def _drives(plant: PlantController, row: int) -> tuple[DriveView, ...]:
    node = plant.field.rows[row]
    drives = Drive(plant.beams.drives.table[row])
    counts = np.array([node["primary"], node["secondary"]], dtype=np.float64)
    goals = np.array([node["primary_goal"], node["secondary_goal"]], dtype=np.float64)
    here, there = drives.angles(counts), drives.angles(goals)
    return tuple(
        DriveView(int(c), int(g), float(a), float(b))
        for c, g, a, b in zip(counts, goals, here, there, strict=True)
    )


def _parameters(plant: PlantController, work: "Automat", name: str) -> dict[str, ParameterView]:
    """Return what is believed of a mechanism; unknown ones by their priors."""
    group, row = plant.design.find(name)
    mechanism = group.mechanism
    values, sigmas = work.book.parameters(name)
    if not values:
        values = {key: float(v[row]) for key, v in group.parameters.items()}
    names = dict.fromkeys((*work.model, *values))
    found = {}
    for key in names:
        known = mechanism.parameter(key)
        found[key] = ParameterView(
            float(values.get(key, 0.0)), float(sigmas.get(key, known.prior)), known.unit
        )
    return found


def emergency_view(plant: PlantController) -> EmergencyView:
    """Return the last emergency order with its proof."""
    order = plant.emergency
    if order is None:
        return EmergencyView(False, "", "", "", 0.0, 0, 0, 0, (), "no emergency so far")
    report, count = order.report(plant.now()), len(order.ticket.heliostats)
    return EmergencyView(
        plant.emergency_on,
        order.act.name,
        order.who,
        order.reason,
        plant.now() - order.at,
        count,
        count - len(report.unacknowledged),
        count - len(report.not_done),
        report.not_done[:_SOME],
        report.text,
    )
