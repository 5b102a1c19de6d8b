"""Views of a running plant: the field as a table, a single heliostat, an emergency."""

from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.field.target import Receiver, Target
from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.mechanism.drives import Drive
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.automatic import AutomaticControl
from heliotrope.plant.operations.views import (
    STALE_STATE,
    DriveView,
    EmergencyView,
    FieldFrame,
    HeliostatView,
    ParameterView,
)
from heliotrope.safety import FluxProof
from heliotrope.store.records import Kind

#: Time for which a frame is reused, s of plant time.
_EVERY = 1.0
#: An aim within this many half diagonals of the centre of a surface counts as on the surface.
_NEAR = 1.0
#: Value that stands for the supply voltage of a board that has not reported it yet, mV.
_UNTOLD = 0
#: Number of names shown of the heliostats that have not carried out an emergency order.
_SOME = 20


class Viewer:
    """The views of a plant under automatic control.

    Parameters
    ----------
    plant, automatic
        The controller, and automatic control with its book of calibrations.

    Attributes
    ----------
    positions, sizes
        Positions of the heliostats, ENU, m, (N, 3); width and height of their mirrors, m, (N, 2).
    aim_names
        Places where a beam can be: "" for nowhere, receivers, targets, "elsewhere".
    """

    def __init__(self, plant: PlantController, automatic: AutomaticControl) -> None:
        self._plant, self._automatic = plant, automatic
        design, names = plant.design, plant.field.names
        place = {name: i for i, name in enumerate(design.names)}
        rows = np.array([place[name] for name in names], dtype=np.intp)
        groups = design.groups.values()
        self.positions: FloatArray = _fixed(np.asarray(design.position)[rows])
        sizes = [np.concatenate([getattr(g, what) for g in groups]) for what in ("width", "height")]
        self.sizes: FloatArray = _fixed(np.stack(sizes, axis=-1)[rows])
        surfaces: tuple[Receiver | Target, ...] = (*design.receivers, *design.targets)
        self.aim_names = ("", *(surface.name for surface in surfaces), "elsewhere")
        self._centers = [surface.center for surface in surfaces]
        self._reach = [_NEAR * 0.5 * np.hypot(s.width, s.height) for s in surfaces]
        self._frame: FieldFrame | None = None
        self._made_at = -np.inf
        self._number = 0

    def frame(self) -> FieldFrame:
        """Return the present frame."""
        now = self._plant.now()
        if self._frame is None or now - self._made_at >= _EVERY:
            self._frame, self._made_at = self._make(now), now
        return self._frame

    def _make(self, now: float) -> FieldFrame:
        plant, book = self._plant, self._automatic.book
        field = plant.field
        live, rows = field.live(now), field.rows
        self._number += 1
        truth = self._automatic.truth.all()
        counts = np.stack([rows["primary"], rows["secondary"]], axis=-1)
        return FieldFrame(
            self._number,
            plant.clock.utc().timestamp(),
            _fixed(np.where(live, rows["state"], STALE_STATE).astype(np.uint8)),
            _fixed(np.where(live, rows["fault"], 0).astype(np.uint8)),
            _fixed(np.where(live, rows["flags"], 0).astype(np.uint32)),
            _fixed(field.age(now).astype(np.float32)),
            _fixed(counts.astype(np.int32)),
            _fixed(book.error.astype(np.float32)),
            _fixed(book.measured.astype(np.float32)),
            _fixed(book.calibrated_at.copy()),
            _fixed(book.sightings.copy()),
            _fixed(field.cluster.astype(np.int16)),
            _fixed(self._on(now)),
            _fixed(self._automatic.service.rows()),
            None if truth is None else _fixed(truth.astype(np.float32)),
        )

    def _on(self, now: float) -> npt.NDArray[np.uint8]:
        """Return the index of each beam's aim in `aim_names`, (N,)."""
        aims, found = self._plant.aims, np.zeros(len(self._plant.field), dtype=np.uint8)
        on = self._plant.field.among(states.ON_AIM, now) & np.isfinite(aims).all(axis=-1)
        found[on] = len(self.aim_names) - 1
        for k, (center, reach) in enumerate(zip(self._centers, self._reach, strict=True), 1):
            found[on & (np.linalg.norm(aims - center, axis=-1) <= reach)] = k
        return found

    def heliostat(self, name: str) -> HeliostatView:
        """Return one heliostat in detail.

        Raises
        ------
        UnknownNameError
            If there is no such heliostat.
        """
        plant, automatic = self._plant, self._automatic
        row = plant.field.place(name)
        shown = plant.field.of(name, plant.now())
        node = plant.field.rows[row]
        told = shown.live and int(node["supply_mv"]) != _UNTOLD
        truth = automatic.truth.all()
        hold = plant.lockouts.text(Kind.HELIOSTAT, name)
        width, height = self.sizes[row]
        return HeliostatView(
            name,
            shown.cluster,
            row,
            self.positions[row],
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
            self._drives(row) if shown.live else (),
            plant.aims[row].copy(),
            plant.standbys[row].copy(),
            str(self.aim_names[int(self.frame().on[row])]),
            self._parameters(name),
            plant.beliefs.record(name),
            float(automatic.book.error[row]),
            float("nan") if truth is None else float(truth[row]),
            automatic.book.history(name),
            automatic.book.results_of(name),
            next((p for p in automatic.plan(50) if p.heliostat == name), None),
            hold,
            plant.locked_for(name) if shown.live and node["state"] == states.LOCKED else "",
        )

    def _drives(self, row: int) -> tuple[DriveView, ...]:
        node = self._plant.field.rows[row]
        drives = Drive(self._plant.beams.drives.table[row])
        counts = np.array([node["primary"], node["secondary"]], dtype=np.float64)
        goals = np.array([node["primary_goal"], node["secondary_goal"]], dtype=np.float64)
        here, there = drives.angles(counts), drives.angles(goals)
        return tuple(
            DriveView(int(c), int(g), float(a), float(b))
            for c, g, a, b in zip(counts, goals, here, there, strict=True)
        )

    def _parameters(self, name: str) -> dict[str, ParameterView]:
        """Return the parameters of a mechanism; parameters never calibrated have their prior σ."""
        group, row = self._plant.design.find(name)
        record = self._plant.beliefs.record(name)
        if record is None:
            values, sigmas = {key: float(v[row]) for key, v in group.parameters.items()}, {}
        else:
            values = record.parameters
            sigma = record.sigma_at(self._plant.clock.utc().timestamp())
            sigmas = dict(zip(record.names, sigma.tolist(), strict=True))
        found = {}
        for key in dict.fromkeys((*self._automatic.book.model_of(name), *values)):
            known = group.mechanism.parameter(key)
            found[key] = ParameterView(
                float(values.get(key, 0.0)), float(sigmas.get(key, known.prior)), known.unit
            )
        return found

    def emergency(self, most: int = _SOME) -> EmergencyView:
        """Return the last emergency order, and whether it has been carried out.

        ``most``: number of heliostats that each of its lists may name.
        """
        plant, order = self._plant, self._plant.sentinel.order
        if order is None:
            return EmergencyView(False, "", "", "", 0.0, 0, 0, 0, (), "no emergency so far")
        if not plant.sentinel.on:
            over = f"over: {order.act.name} of the field, ordered by {order.who}"
            ago = plant.now() - order.at
            return EmergencyView(
                False, order.act.name, order.who, order.reason, ago, 0, 0, 0, (), over
            )
        report = order.report(plant.now(), plant.drive_checks.shown)
        # List the orders in force, not the one that began the emergency, which may have been
        # withdrawn.
        causes = plant.sentinel.causes() or {order.who: order.reason}
        count = len(order.ticket.heliostats)
        return EmergencyView(
            True,
            order.act.name,
            ", ".join(causes),
            "; ".join(causes.values()),
            plant.now() - order.at,
            count,
            count - len(report.unacknowledged),
            count - len(report.not_done),
            report.not_done[:most],
            report.text,
            plant.sentinel.calls,
            report.flux is FluxProof.BELOW,
            report.followed,
            report.believed[:most],
            len(report.believed),
            report.evidence,
        )


def _fixed(array: Any) -> Any:
    """Return a read-only array."""
    made = np.asarray(array)
    made.setflags(write=False)
    return made
