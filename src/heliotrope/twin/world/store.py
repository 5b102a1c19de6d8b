"""The plant's store in the environment "repairs": a real store, backed up and restored."""

import contextlib
import tempfile
from collections.abc import Callable
from pathlib import Path

from heliotrope.links.clock import Clock
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.plant.operations.service import Service
from heliotrope.plant.orders.kept_audit import KeptPoints
from heliotrope.safety import Alarm
from heliotrope.store import backup
from heliotrope.store.keeper import Keeper
from heliotrope.twin.invariants.persons import PersonsObserver, Words

#: Time between two backups; the older of the last two is restored, s.
EVERY = 40.0


class PlantStore:
    """A store that outlives the plant program and may be replaced by one of its backups.

    Parameters
    ----------
    clock
        Clock of the plant.
    persons
        Observer that knows what operators had ordered and locked at the time of each backup.
    exits
        Removes the store at the end of the run.

    Attributes
    ----------
    keeper, points
        The store, and the assigned points that it contains.
    """

    def __init__(self, clock: Clock, persons: PersonsObserver, exits: contextlib.ExitStack) -> None:
        self._clock, self._persons = clock, persons
        self._folder = Path(exits.enter_context(tempfile.TemporaryDirectory()))
        self._count, self._made_at = 1, clock.monotonic()
        self._backups: list[tuple[Path, Words]] = []
        self.keeper = Keeper(self._folder / "1.sqlite", inline=True)
        exits.callback(self._close)
        self.points = KeptPoints(self.keeper)

    def _close(self) -> None:
        self.keeper.close()

    def service(self, plant: PlantController, tell: Callable[[Alarm], None]) -> Service:
        """Return the operators' locks for the heliostats of a new program."""
        keeping = Keeping(plant.field.names, plant.beliefs, self.keeper)
        return Service(plant, keeping, tell)

    def look(self) -> None:
        """Make a backup if one is due."""
        now = self._clock.monotonic()
        if now - self._made_at < EVERY:
            return
        self._made_at = now
        folder = self._folder / f"backup {len(list(self._folder.glob('backup *')))}"
        backup.backup(self.keeper.database, folder, self._clock.utc())
        self._backups = [*self._backups, (folder, self._persons.words())][-2:]

    def restore(self) -> None:
        """Replace the store with the older of the last two backups, if there is one."""
        if not self._backups:
            return
        folder, words = self._backups[0]
        self.keeper.close()
        self._count += 1
        place = self._folder / f"{self._count}.sqlite"
        backup.restore(folder, place, self._clock.utc())
        self.keeper = Keeper(place, inline=True)
        self.points = KeptPoints(self.keeper)
        self._persons.restored(words, self._clock.monotonic())
