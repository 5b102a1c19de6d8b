"""Independent witnesses of the sun, which reveal a wrong time or site in plant and clusters.

If plant and clusters share a wrong time or site, all their sun vectors agree, and every heliostat
tracks without any fault indication, but misses its aim. Before the first heliostat of a day joins a
receiver, a witness must therefore have seen the sun where the plant computes it: a satellite
receiver (its time and its position), a sun sensor, or photographs of beams on targets. Until then
beams may go to targets. While a witness contradicts the plant, no heliostat leaves stow, because
the paths were checked only for the computed sun direction.
"""

import asyncio
import math
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

import numpy as np

from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.calibration.sightings import Sightings, ray_directions
from heliotrope.geometry import FloatArray, angle_between, direction, reflect
from heliotrope.links.clock import Clock
from heliotrope.links.gpsd import Gpsd
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant import refusals
from heliotrope.plant.field.part import Part
from heliotrope.safety import Alarm, alarms
from heliotrope.sun import Site, fast_vector

#: A witness contradicts the plant if its sun vector differs from the plant's by more than this,
#: rad, plus the error of the witness: 14 s of time, or the limit at which a cluster's site differs.
AGREES = 1e-3
#: Errors of the witnesses, rad: of a sun sensor, and of a beam whose heliostat was calibrated (the
#: limit of `pointing_disagrees`).
SENSOR_ERROR, BEAM_ERROR = 5e-3, 3e-3
#: Solar elevation above which the plant reports that no witness has seen the sun today, rad.
_UP = math.radians(5.0)
#: Name of calibration visits as a witness.
PHOTOGRAPHS = "photographs"
#: Maximum length of a sun sensor's file, bytes.
_LONGEST = 64


class Witness(Protocol):
    """A source of the sun's direction, independent of the plant's clock and file."""

    @property
    def name(self) -> str:
        """Name for display."""
        ...

    async def sun(self, site: Site) -> tuple[FloatArray, float] | None:
        """Return the unit vector to the sun now, ENU, (3,), and its error, rad; None if unknown.

        Parameters
        ----------
        site
            Site of the plant, for its atmosphere; a witness that knows its own position uses that
            position.
        """
        ...


class SatelliteWitness:
    """A satellite receiver at the plant, whose time and position determine a sun vector.

    Parameters
    ----------
    gpsd
        Client of the receiver; the owner runs it.
    clock
        Clock of the plant.
    """

    name = "satellite receiver"

    def __init__(self, gpsd: Gpsd, clock: Clock) -> None:
        self._gpsd, self._clock = gpsd, clock

    async def sun(self, site: Site) -> tuple[FloatArray, float] | None:
        """Return the sun vector at the receiver's time and position; None without a fresh fix."""
        ahead, receiver = self._gpsd.ahead, self._gpsd.receiver
        place = receiver.latitude_deg, receiver.longitude_deg
        if ahead is None or not np.isfinite(place).all():
            return None
        place_of_receiver = Site(*place, site.height, site.pressure, site.temperature_c)
        return fast_vector(self._clock.utc().timestamp() - ahead, place_of_receiver), 0.0


class SunSensorFile:
    """A sun sensor, read from a file that another program replaces with each reading.

    The file holds the azimuth from north through east and the elevation of the apparent sun,
    degrees.

    Parameters
    ----------
    path
        The file.
    """

    name = "sun sensor"

    def __init__(self, path: Path) -> None:
        self._path, self._written = path, 0

    async def sun(self, site: Site) -> tuple[FloatArray, float] | None:
        """Return the sun vector from the file; None if it was not replaced since the last call."""
        del site  # the sensor observes the sun itself
        return await asyncio.to_thread(self._read)

    def _read(self) -> tuple[FloatArray, float] | None:
        try:
            written = self._path.stat().st_mtime_ns
            if self._written in (0, written):
                self._written = written  # a file present at start-up may be old
                return None
            self._written = written
            with self._path.open("rb") as file:
                azimuth, elevation = (math.radians(float(x)) for x in file.read(_LONGEST).split())
        except (OSError, ValueError):
            return None
        if not (math.isfinite(azimuth) and 0.0 < elevation <= 0.5 * math.pi):
            return None
        return direction(azimuth, elevation), SENSOR_ERROR


class Witnesses(Part):
    """Today's observations by a plant's witnesses.

    Parameters
    ----------
    names
        Witnesses; one of them must agree before the first heliostat of a day joins a receiver.
        Empty: no witness is required, and the plant says so once a day; None: no witness is
        required, and the plant does not report this.
    site
        Site of the plant.
    utc
        Function that returns the plant's time, POSIX s.
    tell
        Called with each alarm.
    """

    def __init__(
        self,
        names: frozenset[str] | None,
        site: Site,
        utc: Callable[[], float],
        tell: Callable[[Alarm], None],
    ) -> None:
        self._names, self._site, self._utc, self._tell = names, site, utc, tell
        #: Day on which a witness last agreed, and day on which the plant reported that none did.
        self._agreed_on = self._told_on = -1
        #: Witnesses that contradict, and their statements.
        self._contradicting: dict[str, str] = {}
        #: Sun offsets from today's contradicting photographs, (3,), by heliostat.
        self._offsets: dict[str, FloatArray] = {}
        #: Heliostats whose photographs have agreed since one contradicted.
        self._agreeing: set[str] = set()

    def _day(self, utc: float) -> int:
        """Return the day number at the site; days change at midnight, mean solar time."""
        return math.floor(utc / 86_400.0 + self._site.longitude_deg / 360.0)

    @property
    def contradiction(self) -> str | None:
        """Why no heliostat may leave stow; None unless a witness contradicts the computed sun."""
        return self.refusal if self._contradicting else None

    @property
    def refusal(self) -> str | None:
        """Why no heliostat may join a receiver; None if heliostats may join."""
        if self._contradicting:
            problem = "; ".join(self._contradicting.values())
        elif self._names and self._agreed_on != self._day(self._utc()):
            problem = (
                f"none of its witnesses ({', '.join(sorted(self._names))}) has confirmed "
                f"the "
                f"sun position today"
            )
        else:
            return None
        return refusals.UNWITNESSED.text.format(problem=problem)

    def take(self, name: str, observed: FloatArray, error: float) -> None:
        """Accept the sun vector (3,) that a witness observes now, with its error, rad."""
        off = float(angle_between(observed, fast_vector(self._utc(), self._site)))
        if off <= AGREES + error:
            self._agrees(name)
        else:
            self._contradicts(name, observed - fast_vector(self._utc(), self._site))

    def photographed(
        self, record: HeliostatCalibration | None, mechanism: Mechanism, sightings: Sightings
    ) -> str | None:
        """Compare photographs of a heliostat's beam on a target, before they are used in a fit.

        The beam reveals the sun direction if the heliostat was calibrated before today; today's
        calibration may rest on a wrong sun direction. If a single heliostat misses by more than its
        error, the heliostat itself may have moved; if two heliostats indicate the same wrong sun
        direction, they have not moved. Returns the reason not to use the photographs, if the sun
        direction that they assume may be wrong.

        Parameters
        ----------
        record, mechanism
            The believed calibration (None before the first), and its mechanism, batch shape (1,).
        sightings
            Sightings of the photographs.
        """
        if self._names is None or record is None or not self.testifies(record):
            return None
        pose = mechanism.pose(sightings.counts)
        source, path = ray_directions(sightings, pose.vertex)
        offset = np.mean(reflect(path, pose.normal) - source, axis=0)
        if float(np.linalg.norm(offset)) <= BEAM_ERROR:
            self._agreeing.add(record.heliostat)
            # One heliostat cannot refute a contradiction by two.
            if PHOTOGRAPHS in self._contradicting and len(self._agreeing) < 2:
                return self.refusal
            self._offsets.clear()
            self._agrees(PHOTOGRAPHS)
            return None
        self._agreeing.clear()
        others = [other for name, other in self._offsets.items() if name != record.heliostat]
        self._offsets[record.heliostat] = offset
        if any(np.linalg.norm(offset - other) <= BEAM_ERROR for other in others):
            self._contradicts(PHOTOGRAPHS, offset)
        return self.refusal

    def testifies(self, record: HeliostatCalibration | None) -> bool:
        """Return whether photographs of a heliostat reveal the sun direction."""
        return record is not None and self._day(record.at) < self._day(self._utc())

    @property
    def awaits_photographs(self) -> bool:
        """Whether photographs count as a witness and the sun is not confirmed today.

        It is not confirmed if no witness has agreed today, or if one contradicts the plant.
        """
        return PHOTOGRAPHS in (self._names or ()) and bool(self.refusal)

    def on_second(self, now: float) -> None:
        """Report once a day that no witness has seen the sun, if that is the case."""
        del now
        utc_s = self._utc()
        day = self._day(utc_s)
        if self._names is None or day in (self._agreed_on, self._told_on):
            return
        if fast_vector(utc_s, self._site)[2] < math.sin(_UP):
            return
        self._told_on = day
        listed = ", ".join(sorted(self._names))
        problem = f"none of {listed} has confirmed it" if listed else "this plant has none"
        kind = alarms.UNWITNESSED
        self._tell(kind.ended())
        self._tell(kind.raised(problem=problem, worse=bool(listed)))

    def _agrees(self, name: str) -> None:
        if self._contradicting.pop(name, None) is not None:
            self._tell(alarms.SUN_CONTRADICTED.ended(name))
        if self._names is not None and name in self._names:
            self._agreed_on = self._day(self._utc())
            if self._told_on == self._agreed_on:
                self._told_on = -1
                self._tell(alarms.UNWITNESSED.ended())

    def _contradicts(self, name: str, offset: FloatArray) -> None:
        utc = self._utc()
        rate = fast_vector(utc + 30.0, self._site) - fast_vector(utc - 30.0, self._site)
        late = 60.0 * float(offset @ rate) / float(rate @ rate)
        text = (
            f"{name} sees the sun {1e3 * float(np.linalg.norm(offset)):.1f} mrad from where the "
            f"plant computes it, which corresponds to a clock that is {abs(late):.0f} s "
            f"{'slow' if late > 0.0 else 'fast'}"
        )
        known = name in self._contradicting
        self._contradicting[name] = text
        if not known:
            at = f"{datetime.fromtimestamp(utc, UTC):%H:%M:%S}"
            self._tell(alarms.SUN_CONTRADICTED.raised(name, problem=text, at=at))
