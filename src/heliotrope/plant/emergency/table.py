"""The plant's part of the safety table: readings in, demands and alarms out."""

from collections.abc import Iterable, Mapping, Sequence

from heliotrope.errors import InputError
from heliotrope.safety import (
    Act,
    Action,
    Alarm,
    Condition,
    Reading,
    Role,
    Scope,
    Watcher,
    acknowledge,
    evaluate,
    narrowed,
    start,
    watched_by,
)

#: Readings that the plant makes itself; all others must be fed by somebody.
OWN_READINGS = frozenset(
    {
        "emergency_order",
        "nodes_unacknowledged",
        "flux_after_emergency",
        "authority_silence",
        "cluster_silence",
        "sun_elevation",
        "audit_silence",
        "node_fault_share",
    }
)
#: Rows that follow from an emergency, and alone keep none going.
CONSEQUENCES = frozenset({"nodes_unacknowledged", "flux_after_emergency"})


class PlantWatch:
    """Evaluates the rows of the table that the plant watches.

    Parameters
    ----------
    table
        All rows, as `safety.conditions` gives them and the plant adjusted them.
    clusters
        Names.
    sensors
        Readings that are fed from outside by `put`.
    now
        Monotonic s.
    looks
        Whether beams are looked at, because there are volumes that they must keep out of.

    Attributes
    ----------
    rows
        Names of the rows that are evaluated.
    unwatched
        Rows whose readings nobody gives: they are not evaluated, and whoever runs the plant must
        know it.
    actions
        Of the last evaluation, the strongest first.

    Raises
    ------
    InputError
        A sensor whose reading is in no row of the plant.
    """

    def __init__(
        self,
        table: Iterable[Condition],
        clusters: Sequence[str],
        sensors: Iterable[str],
        now: float,
        *,
        looks: bool = False,
    ) -> None:
        rows = watched_by(table, Watcher.PLANT)
        fed = frozenset(sensors)
        known = {row.reading for row in rows} - OWN_READINGS
        for name in sorted(fed - known):
            raise InputError(
                f"sensor {name}: no row of the safety table that the plant watches needs it from "
                f"outside; known: {', '.join(sorted(known))}"
            )
        self.sensors = fed
        own = OWN_READINGS | ({"keep_out_predicted"} if looks else set())
        able = tuple(row for row in rows if row.reading in fed | own)
        self.unwatched = tuple(row.name for row in rows if row not in able)
        self.actions: list[Action] = []
        self.rows = frozenset(row.name for row in able)
        self._single = tuple(row for row in able if row.scope is Scope.HELIOSTAT)
        subjects = {row.name: clusters for row in able if row.scope is Scope.CLUSTER}
        self._state = start(able, now, subjects)
        self._readings: dict[tuple[str, str], Reading] = {}
        self._told: dict[tuple[str, str], Alarm] = {}

    def put(self, name: str, value: float, at: float, subject: str = "") -> None:
        """Take a reading, taken at ``at`` (monotonic s)."""
        self._readings[name, subject] = Reading(value, at)

    def evaluate(self, own: Mapping[tuple[str, str], Reading], now: float) -> list[Alarm]:
        """Look at all rows; return what is to be told since the last time."""
        readings = {**self._readings, **own}
        for row in self._single:
            whom = [subject for reading, subject in readings if reading == row.reading and subject]
            self._state = narrowed(self._state, row.name, whom)
        self._state, self.actions = evaluate(readings, self._state, now)
        found: dict[tuple[str, str], Alarm] = {}
        news = []
        for action in self.actions:
            key = (action.condition, action.subject)
            alarm = Alarm(*key, action.severity, action.line)
            if key not in self._told or action.new:
                news.append(alarm)
            found[key] = alarm
        for key, old in self._told.items():
            if key not in found:
                news.append(Alarm(*key, old.severity, f"{' '.join(key).strip()}: over", False))
        self._told = found
        return news

    def acknowledge(self, condition: str, who: str, role: Role, subject: str) -> str:
        """Acknowledge a row; return why not, "" if it was."""
        self._state, refusal = acknowledge(self._state, condition, who, role, subject)
        if not refusal:
            key = (condition, subject)
            self.actions = [a for a in self.actions if (a.condition, a.subject) != key]
        return refusal

    def demanded(self, cluster: str = "") -> Act | None:
        """Return the strongest act for the field, or for one cluster beside that."""
        scope = Scope.CLUSTER if cluster else Scope.FIELD
        acts = (a.act for a in self.actions if a.scope is scope and a.subject == cluster)
        return max(acts, default=None)

    def held(self) -> dict[str, str]:
        """Return heliostats that are to be held from now on, and why."""
        return {
            a.subject: a.text
            for a in self.actions
            if a.scope is Scope.HELIOSTAT and a.act is Act.HOLD and a.new and a.subject
        }

    def caused(self) -> bool:
        """Whether anything but the consequences of an emergency demands one for the field."""
        return any(
            a.scope is Scope.FIELD and a.act >= Act.DEFOCUS and a.condition not in CONSEQUENCES
            for a in self.actions
        )

    def reasons(self, least: Act, cluster: str = "") -> str:
        """Return what demands at least an act for the field or a cluster, in words; "" if none."""
        texts = [
            a.text
            for a in self.actions
            if a.act >= least
            and (a.scope is Scope.FIELD or (a.scope is Scope.CLUSTER and a.subject == cluster))
        ]
        return "; ".join(texts[:3])
