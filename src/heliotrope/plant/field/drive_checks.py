"""Checks whether drives move their mirrors: today's measured evidence, and the stalled drives.

Step counts are the steps that a board has sent to its motors. With ice, a loose coupling or an
unpowered driver the mirror stays where it is while the counts continue. A motion diagnosis with a
tilt sensor on the mirror reveals this, and so does a photograph of the beam on a target. A
heliostat whose drives stall is named in an alarm and joins no receiver. Its reports do not count as
confirmation that an emergency order has been carried out.
"""

from collections.abc import Callable, Iterable, Mapping
from datetime import date

from heliotrope.lcu import diagnosis
from heliotrope.lcu.names import FAULTS
from heliotrope.links.clock import Clock, sleep_until
from heliotrope.links.messages import Answer, ClusterStatus, Stage
from heliotrope.plant.field.clusters import Clusters
from heliotrope.plant.field.part import Part
from heliotrope.plant.field.state import FieldState
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.safety import Alarm, alarms
from heliotrope.sun import Site, solar_day

#: Evidence that a mirror follows its drives.
TILT_SENSOR, PHOTOGRAPH = "tilt sensor", "photograph"
_MOVED = diagnosis.MOVED_PRIMARY | diagnosis.MOVED_SECONDARY
#: Diagnosis bit, and number of the latched board fault, for each drive that stalls.
_STALLS = (
    (diagnosis.STUCK_PRIMARY, FAULTS.index("primary drive stuck"), "primary"),
    (diagnosis.STUCK_SECONDARY, FAULTS.index("secondary drive stuck"), "secondary"),
)
#: Interval at which arriving results are checked, s.
_POLL = 0.5


class DriveChecks(Part):
    """Collects evidence about the drives beyond their step counts.

    Parameters
    ----------
    field, clusters
        State of the field, and the clusters, which are queried for diagnosis results.
    sensed
        Heliostats with a tilt sensor on the mirror.
    site, clock
        Site and clock of the plant, which define the day.
    tell
        Called with each alarm.

    Attributes
    ----------
    stalled
        Heliostats whose drives stall, and how that was detected.
    """

    def __init__(
        self,
        field: FieldState,
        clusters: Clusters,
        sensed: Iterable[str],
        site: Site,
        clock: Clock,
        tell: Callable[[Alarm], None],
    ) -> None:
        self._field, self._clusters, self._sensed = field, clusters, frozenset(sensed)
        self._site, self._clock, self._tell = site, clock, tell
        self.stalled: dict[str, str] = {}
        #: Day on which mirrors were last seen to follow their drives, and the evidence.
        self._shown: dict[str, tuple[date, str]] = {}
        #: Day of the last completed diagnosis, whatever its result.
        self._diagnosed: dict[str, date] = {}
        #: Heliostats whose boards report a stalled drive; heliostats whose tilt sensors do not
        #: respond.
        self._faulty: set[str] = set()
        self._silent: set[str] = set()

    async def checked(self, heliostats: Iterable[str], timeout: float) -> None:
        """Wait, for at most ``timeout`` s, until none of the heliostats is due any longer."""
        until = self._clock.monotonic() + timeout
        while self.due.intersection(heliostats) and self._clock.monotonic() < until:
            await sleep_until(self._clock, self._clock.monotonic() + _POLL)

    def on_status(self, cluster: str, status: ClusterStatus, now: float) -> None:
        """Note the faults that the boards of a cluster report."""
        del status, now
        faults = self._field.rows["fault"]
        for name in self._field.members[cluster]:
            fault = int(faults[self._field.index[name]])
            drives = [drive for _, number, drive in _STALLS if number == fault]
            if not drives:
                self._faulty.discard(name)
            elif name not in self._faulty:
                self._faulty.add(name)
                self._stalls(name, drives)

    def on_stage(
        self, ticket: Ticket, heliostats: tuple[str, ...], stage: Stage, now: float
    ) -> None:
        """Query the results of completed diagnoses."""
        del now
        if stage is not Stage.DONE or ticket.name != "DIAGNOSE":
            return
        for name in heliostats:
            take = self._taker(name)
            self._clusters.ask(self._clusters.home(name), "diagnosis", take, name)

    def _taker(self, name: str) -> Callable[[Answer], None]:
        def take(answer: Answer) -> None:
            result = answer.data.get("result")
            self._diagnosed[name] = self._today()
            if not isinstance(result, int) or result & diagnosis.NO_SENSOR:
                self._without_sensor(name)
                return
            if name in self._silent:
                self._silent.remove(name)
                self._tell(alarms.TILT_SENSOR_SILENT.ended(name))
            stalls = [drive for bit, _, drive in _STALLS if result & bit]
            if stalls:
                self._stalls(name, stalls)
            elif result & _MOVED:
                self.observed(name, TILT_SENSOR)

        return take

    def _without_sensor(self, name: str) -> None:
        if name in self._sensed and name not in self._silent:
            self._silent.add(name)
            self._tell(alarms.TILT_SENSOR_SILENT.raised(name))

    def _stalls(self, name: str, drives: Iterable[str]) -> None:
        text = " and ".join(f"its {drive} drive" for drive in drives)
        self._diagnosed[name] = self._today()
        self._shown.pop(name, None)
        if name not in self.stalled:
            self.stalled[name] = f"{text} made steps, but its mirror did not follow"
            self._tell(alarms.DRIVE_STALLED.raised(name, drives=text))

    def observed(self, heliostat: str, by: str) -> None:
        """Record that a sensor has seen the mirror follow its drives."""
        self._shown[heliostat] = self._today(), by
        self._follows(heliostat)

    def confirm(self, heliostat: str) -> None:
        """Accept a confirmation that the mirror follows its drives; a diagnosis becomes due."""
        self._diagnosed.pop(heliostat, None)
        self._follows(heliostat)

    def _follows(self, heliostat: str) -> None:
        if self.stalled.pop(heliostat, None) is not None:
            self._tell(alarms.DRIVE_STALLED.ended(heliostat))

    @property
    def shown(self) -> Mapping[str, str]:
        """Today's evidence that mirrors follow their drives, by heliostat."""
        today = self._today()
        return {name: by for name, (day, by) in self._shown.items() if day == today}

    @property
    def due(self) -> frozenset[str]:
        """Heliostats with a tilt sensor whose motion has not been diagnosed today."""
        today = self._today()
        return self._sensed.difference(n for n, day in self._diagnosed.items() if day == today)

    def _today(self) -> date:
        return solar_day(self._clock.utc(), self._site)
