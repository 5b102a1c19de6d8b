"""Safety-table readings supplied by programs, for sensors that the plant does not read itself.

A reading ages from the time of its measurement, like a reading from a file. Only readings that the
links file declares as supplied by programs are accepted, so that an account alone cannot replace a
sensor that the plant reads.
"""

import math

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.orders.authority import Person

#: Age from which a reading is refused: by then it is stale in most rows of the safety table, s.
OLDEST = 5.0
#: A reading may be this far ahead of the plant's clock, as two clocks never agree fully, s.
AHEAD = 0.5
#: If a user has sent no reading for this long, the next one is logged, s.
_SILENT = 10.0


class GivenReadings:
    """Accepts readings from programs.

    Parameters
    ----------
    plant
        The controller; its settings name the readings.
    logbook
        Records who supplies which reading.
    """

    def __init__(self, plant: PlantController, logbook: Logbook) -> None:
        self._plant, self._logbook = plant, logbook
        #: Times of the newest reading: of measurement, Unix s by its program, and of receipt,
        #: monotonic s.
        self._last: dict[str, tuple[float, float]] = {}
        #: When each user last supplied each reading, monotonic s.
        self._given: dict[tuple[str, str], float] = {}

    def take(self, person: Person, name: str, value: float, at: float) -> None:
        """Accept a reading.

        Parameters
        ----------
        person
            User whose program supplies the reading.
        name
            Reading of the safety table.
        value
            Value, in the unit of the table row.
        at
            Time of the measurement, POSIX s.

        Raises
        ------
        UnknownNameError
            If programs do not supply this reading at this plant.
        InputError
            If the reading is not finite, too old, from the future, or not newer than the last one.
        """
        names = self._plant.settings.given
        if name not in names:
            raise UnknownNameError('"api" reading of the links file', name, sorted(names))
        if not (math.isfinite(value) and math.isfinite(at)):
            raise InputError(f"{name}: {value} at {at} is not a reading; send finite numbers")
        age, now = self._plant.clock.utc().timestamp() - at, self._plant.now()
        if age > OLDEST:
            raise InputError(
                f"{name}: the reading is {age:.1f} s old, the limit is {OLDEST:g} s; send each "
                "reading immediately, and compare the clocks of both computers"
            )
        if age < -AHEAD:
            raise InputError(
                f"{name}: the reading is {-age:.1f} s ahead of the plant's clock, the limit is "
                f"{AHEAD:g} s; compare the clocks of both computers"
            )
        last, taken = self._last.get(name, (-math.inf, -math.inf))
        # A repeated reading is later refused for its age. A clock that was set back must not block
        # readings for long.
        if at <= last and now - taken <= OLDEST + AHEAD:
            raise InputError(
                f"{name}: the reading is {last - at:.1f} s older than the last reading; send each "
                f"reading once, in order"
            )
        self._plant.put(name, value, made=min(now - age, now))
        self._last[name] = at, now
        if now - self._given.get((person.name, name), -math.inf) >= _SILENT:
            self._logbook.event(
                "command", person.name, f"sends {name}; the first value is {value:g}"
            )
        self._given[person.name, name] = now
