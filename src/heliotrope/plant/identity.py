"""Which board answers at an address: two exchanged addresses, or a board moved to another mirror.

Every local controller reports the checksum of the armature that it stores. The armature holds the
place of the mirror, so the checksum of another heliostat's armature shows the board of that other
heliostat: a command to H1 would move H2.
"""

import math
from collections.abc import Callable, Iterable
from zlib import crc32

import numpy as np

from heliotrope.mechanism.board_items import Wanted
from heliotrope.plant.field_state import FieldState
from heliotrope.safety import Alarm, alarms

#: Pauses between two gatherings of the wanted armatures: with new odd checksums, and without, s.
_SOON, _AGAIN = 1.0, 10.0


class Identities:
    """Comparison of the armatures that local controllers report with those of the whole field.

    Parameters
    ----------
    field, wanted
        Of the plant.
    tell
        Called with each alarm.

    Attributes
    ----------
    strange
        Heliostats that answer with the armature of another, by name, each with that other's name.
    """

    def __init__(self, field: FieldState, wanted: Wanted, tell: Callable[[Alarm], None]) -> None:
        self._field, self._wanted, self._tell = field, wanted, tell
        self.strange: dict[str, str] = {}
        #: Checksums that are not their heliostat's own, by its name.
        self._odd: dict[str, int] = {}
        self._seen = np.zeros(len(field), dtype=np.uint32)
        self._owners: dict[int, str] = {}
        self._built = -math.inf

    def want(self, name: str) -> None:
        """Judge a heliostat again, because the armature that it should store has changed."""
        self._seen[self._field.index[name]] = 0

    def look(self, cluster: str, now: float) -> None:
        """Judge the heliostats of a cluster whose armature has changed since the last look."""
        field = self._field
        rows = np.array([field.index[n] for n in field.members[cluster]], np.intp)
        stored = field.rows["armature_crc"][rows]
        new = np.flatnonzero(stored != self._seen[rows])
        for i in new:
            self._seen[rows[i]] = stored[i]
            self._odd[field.names[rows[i]]] = int(stored[i])
        if self._odd and now - self._built >= (_SOON if len(new) else _AGAIN):
            self._built = now
            armatures = {n: items.get("armature") for n, items in self._wanted.items.items()}
            self._owners = {crc32(a): n for n, a in armatures.items() if a is not None}
            self._judge()
        elif len(new):
            self._judge()

    def _judge(self) -> None:
        for name, crc in list(self._odd.items()):
            own = self._wanted.items.get(name, {}).get("armature")
            good = own is not None and crc32(own) == crc
            other = "" if good else self._owners.get(crc, "")
            if good:
                del self._odd[name]
            if other and self.strange.get(name) != other:
                self.strange[name] = other
                self._tell(alarms.IDENTITY.raised(name, other=other))
            elif not other and self.strange.pop(name, ""):
                self._tell(alarms.IDENTITY.ended(name))

    def barred(self, heliostats: Iterable[str]) -> dict[str, str]:
        """Return which heliostats may not be moved, and why."""
        return {
            name: f"its address answers with the parameters of {self.strange[name]}; correct the "
            "addresses first"
            for name in heliostats
            if name in self.strange
        }
