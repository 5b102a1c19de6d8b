"""The plant's part of the safety table: it turns readings into required actions and alarms."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from types import MappingProxyType

import numpy as np

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.geometry import FloatArray
from heliotrope.plant.field.agreement import Agreement
from heliotrope.plant.field.state import FieldState
from heliotrope.plant.motion.watch import BeamWatch
from heliotrope.plant.orders.authority import Authority
from heliotrope.plant.orders.queue import PlantOrders
from heliotrope.safety import (
    FLUX_READING,
    AcknowledgeRole,
    Act,
    Action,
    Alarm,
    Condition,
    Proof,
    Reading,
    Scope,
    Watcher,
    acknowledge,
    evaluate,
    narrowed,
    proof_readings,
    recalled,
    start,
    watched_by,
)

#: Readings that the plant produces itself; all others must come from sensors.
OWN_READINGS = frozenset(
    {
        "emergency_order",
        "nodes_unacknowledged",
        "unproven",
        "flux_after_emergency",
        "authority_silence",
        "cluster_silence",
        "sun_elevation",
        "audit_silence",
        "node_fault_share",
        "cluster_time_off",
        "cluster_sun_off",
        "pointing_error",
        "pointing_errors",
    }
)
#: Row for operators' emergency orders.
ORDERED = "operator_emergency"
#: Row of the night, when the field rests at stow without an emergency.
NIGHT = "sun_below_horizon"
#: Rows that follow from an emergency; on their own they do not keep one active.
CONSEQUENCES = frozenset({"nodes_unacknowledged", "flux_after_emergency"})
#: Readings that the plant derives from a sensor reading, and the sensor reading.
DERIVED = {"flux_after_emergency": FLUX_READING}
#: Direct normal irradiance, W/m², for the schedule and for operators.
DNI_READING = "dni"
#: Sensor readings that no row uses.
_IN_NO_ROW = frozenset({DNI_READING, *DERIVED.values()})
#: Age above which a reading is no longer displayed, s.
_SHOWN = 60.0
#: Interval between two computations of the sun's elevation, s.
SUN_PERIOD = 5.0


class PlantReadings:
    """The readings that the plant produces itself.

    Parameters
    ----------
    field, authority, orders, watch, agreement
        Parts of the plant.
    sun
        Function that returns the unit vector to the sun now, (3,).

    Attributes
    ----------
    names
        Names of the readings.
    """

    def __init__(
        self,
        field: FieldState,
        authority: Authority,
        orders: PlantOrders,
        watch: BeamWatch,
        agreement: Agreement,
        sun: Callable[[], FloatArray],
    ) -> None:
        self._field, self._authority, self._orders = field, authority, orders
        self._watch, self._agreement, self._sun = watch, agreement, sun
        self._sun_at = -math.inf
        self._elevation = -0.5 * np.pi
        self.names = OWN_READINGS | watch.watched

    def take(
        self, proof: Proof | None, unproven: Mapping[str, float], *, called: bool, now: float
    ) -> dict[tuple[str, str], Reading]:
        """Return the present readings.

        Parameters
        ----------
        proof
            Proof of the emergency order in force; None if there is none.
        unproven
            For each heliostat that an emergency left unconfirmed, the time since which it has been
            confirmed, monotonic s; infinite if it has not been confirmed.
        called
            Whether a person has ordered an emergency that is not withdrawn.
        now
            Monotonic s.
        """
        if now - self._sun_at >= SUN_PERIOD:
            self._sun_at = now
            self._elevation = math.asin(float(self._sun()[2]))
        readings = {
            **proof_readings(proof, now),
            ("emergency_order", ""): Reading(float(called), now),
            ("authority_silence", ""): Reading(self._authority.silent_for, now),
            ("audit_silence", ""): Reading(now - self._orders.confirmed_at, now),
            ("sun_elevation", ""): Reading(self._elevation, now),
            ("node_fault_share", ""): Reading(self._field.failed_share(now), now),
            ("unproven", ""): Reading(0.0, now),
            **{("unproven", n): Reading(float(at > now), now) for n, at in unproven.items()},
            **self._watch.readings(now),
            **self._agreement.readings(now),
        }
        for name, at in self._field.status_at.items():
            if math.isfinite(at):
                readings["cluster_silence", name] = Reading(0.0, at)
        return readings


class TableWatch:
    """Evaluates the safety-table rows for which the plant is responsible.

    Parameters
    ----------
    rows
        The table of `safety.conditions`, with the plant's adjustments.
    readings
        Readings that the plant produces itself.
    clusters
        Names of the clusters.
    sensors
        Names of the readings that come from sensors, through `put`.
    now
        Monotonic s.

    Attributes
    ----------
    rows
        Names of the rows that are evaluated.
    unwatched
        Names of the rows without a reading, which are not evaluated; the operator must be informed.
    actions
        Actions of the last evaluation, the strongest first.

    Raises
    ------
    InputError
        If a sensor's reading is used in no row of the plant.
    """

    def __init__(
        self,
        rows: Iterable[Condition],
        readings: PlantReadings,
        clusters: Sequence[str],
        sensors: Iterable[str],
        now: float,
        tell: Callable[[Alarm], None],
    ) -> None:
        self.tell = tell
        table = watched_by(rows, Watcher.PLANT)
        self._sensors = frozenset(sensors)
        known = {row.reading for row in table} - OWN_READINGS | _IN_NO_ROW
        for name in sorted(self._sensors - known):
            raise InputError(
                f"sensor {name}: no row of the plant's safety table reads this sensor; known "
                f"sensors: {', '.join(sorted(known))}"
            )
        self._fed = {n for n in readings.names if DERIVED.get(n) in self._sensors | {None}}
        able = tuple(row for row in table if row.reading in self._sensors | self._fed)
        self.unwatched = tuple(row.name for row in table if row not in able)
        self.actions: list[Action] = []
        self.rows = frozenset(row.name for row in able)
        self._single = tuple(row for row in able if row.scope is Scope.HELIOSTAT)
        subjects = {row.name: clusters for row in able if row.scope is Scope.CLUSTER}
        self._state = start(able, now, subjects)
        self._own = readings
        self._put: dict[tuple[str, str], Reading] = {}
        self._newest: dict[str, Reading] = {}
        self._raised: dict[tuple[str, str], Alarm] = {}

    @property
    def flux_measured(self) -> bool:
        """Whether a sensor supplies the flux on the receiver, for the proof of an emergency."""
        return FLUX_READING in self._sensors

    def put(self, name: str, value: float, at: float, subject: str = "") -> None:
        """Accept a sensor reading, measured at ``at`` (monotonic s).

        Raises
        ------
        UnknownNameError
            If the sensor does not exist.
        """
        if name not in self._sensors:
            raise UnknownNameError("sensor of the plant", name, self._sensors)
        if not subject:
            self._newest[name] = Reading(value, at)
        if name not in _IN_NO_ROW:
            self._put[name, subject] = Reading(value, at)

    def shown(self, now: float) -> dict[str, float]:
        """Return the newest sensor readings, by name, in the units of the rows.

        A value is NaN if there is no reading, or if it is too old.
        """
        return {
            name: reading.value
            if (reading := self._newest.get(name)) and now - reading.at <= _SHOWN
            else math.nan
            for name in sorted(self._sensors)
        }

    def evaluate(
        self,
        proof: Proof | None,
        unproven: Mapping[str, float] = MappingProxyType({}),
        *,
        called: bool,
        now: float,
    ) -> list[Alarm]:
        """Evaluate all rows; return the alarms raised and cleared since the last evaluation.

        For ``proof``, ``unproven`` and ``called`` see `PlantReadings.take`.
        """
        own = self._own.take(proof, unproven, called=called, now=now)
        readings = self._put | {
            key: own_reading for key, own_reading in own.items() if key[0] in self._fed
        }
        for row in self._single:
            subjects = [name for reading, name in readings if reading == row.reading and name]
            self._state = narrowed(self._state, row.name, subjects)
        self._state, self.actions = evaluate(readings, self._state, now)
        raised: dict[tuple[str, str], Alarm] = {}
        news = []
        for action in self.actions:
            key = (action.condition, action.subject)
            alarm = Alarm(*key, action.severity, action.line)
            if key not in self._raised or action.new:
                news.append(alarm)
            raised[key] = alarm
        for key, old in self._raised.items():
            if key not in raised:
                news.append(Alarm(*key, old.severity, f"{' '.join(key).strip()}: over", False))
        self._raised = raised
        return news

    def recall(self, rows: Iterable[tuple[str, str]]) -> None:
        """Restore the rows that were tripped before a restart, each with its subject."""
        self._state = recalled(self._state, rows)

    def standing(self) -> tuple[tuple[str, str], ...]:
        """Return the rows that persist across a restart, each with its subject.

        These rows keep the beams of the whole field off, or wait for acknowledgement.
        """
        latched = {row.name for row in self._state.table if row.latched}
        off = {
            (a.condition, a.subject)
            for a in self.actions
            if a.scope is Scope.FIELD and a.act >= Act.DEFOCUS
        }
        return tuple(key for key in self._state.tripped() if key[0] in latched or key in off)

    def acknowledge(
        self, condition: str, who: str, role: AcknowledgeRole, subject: str
    ) -> str | None:
        """Acknowledge a row; return why this is refused, or None if it is accepted."""
        self._state, refusal = acknowledge(self._state, condition, who, role, subject)
        if not refusal:
            key = (condition, subject)
            self.actions = [a for a in self.actions if (a.condition, a.subject) != key]
        return refusal

    def demanded(self, cluster: str = "") -> Act | None:
        """Return the strongest action required of the field, or of one cluster if it is named."""
        return max((a.act for a in self._demands(cluster)), default=None)

    def _demands(self, cluster: str = "") -> Iterator[Action]:
        """Yield the actions for the field, or for one cluster, except actions for the night."""
        scope = Scope.CLUSTER if cluster else Scope.FIELD
        return (
            a
            for a in self.actions
            if a.scope is scope and a.subject == cluster and a.condition != NIGHT
        )

    def night(self) -> str | None:
        """Return the reason why the field rests at stow although nothing is wrong; None by day."""
        return next((a.text for a in self.actions if a.condition == NIGHT), None)

    def off(self) -> dict[str, tuple[Act, str]]:
        """Return the heliostats that must leave, by name, each with the action and the reason."""
        return {
            a.subject: (a.act, a.text)
            for a in reversed(self.actions)
            if a.scope is Scope.HELIOSTAT and a.act >= Act.DEFOCUS and a.subject and not a.waits
        }

    def blocked(self, condition: str = "") -> dict[str, str]:
        """Return the heliostats that one row, or any row, keeps from their aims, and why."""
        return {
            a.subject: a.text
            for a in self.actions
            if a.scope is Scope.HELIOSTAT and a.act >= Act.DEFOCUS and a.subject
            if condition in ("", a.condition)
        }

    def caused(self, but: str = "") -> bool:
        """Return whether a row requires a field-wide emergency.

        Rows that are consequences of the emergency do not count, nor does the row named ``but``.
        """
        return any(
            a.act >= Act.DEFOCUS and a.condition not in (*CONSEQUENCES, but)
            for a in self._demands()
        )

    def reasons(self, least: Act, cluster: str = "", but: str = "") -> str:
        """Return, in words, which rows require at least a given action of the field or a cluster.

        ``but`` is the name of a row that is left out.
        """
        demands = chain(self._demands(), self._demands(cluster) if cluster else ())
        return "; ".join([a.text for a in demands if a.act >= least and a.condition != but][:3])

    def withdrawn(self) -> str:
        """Return how an emergency ends whose orders have all been withdrawn.

        Returns an empty text if there is no such emergency.

        This concerns emergencies that operators ordered.
        """
        row = next((row for row in self._state.table if row.name == ORDERED), None)
        if row is None or row.role is None or all(a.condition != ORDERED for a in self._demands()):
            return ""
        return (
            f"all orders are withdrawn; the emergency ends when an {row.role.title} acknowledges "
            f"{ORDERED}, which is possible {row.clear_for:g} s after the last withdrawal"
        )
