"""Detects which board responds at an address: swapped addresses, and boards moved elsewhere.

Every local controller reports the checksum of the armature that it stores. The armature contains
the position of the mirror, so no two armatures are equal. If a board at the address of H1 reports
the checksum of H2's armature, it is the board of H2, and a command to H1 would move H2. A checksum
that the plant has never seen does not reveal whose board it is.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from zlib import crc32

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.links.messages import ClusterStatus
from heliotrope.plant import refusals
from heliotrope.plant.field.part import Part
from heliotrope.plant.field.state import FieldState
from heliotrope.safety import Act, Alarm, alarms

#: Why the reports of a board do not count if it stores an armature unknown to the plant.
_UNKNOWN = "its local controller stores parameters that are unknown to this plant"


class Identities(Part):
    """Comparison of the armatures that local controllers report with those of the whole field.

    Parameters
    ----------
    field
        State of the field.
    armatures
        Armatures that the plant believes at start-up, (N, 18).
    expected
        Items that heliostats should store, by heliostat and item.
    connections
        Function that returns how often the link to a cluster has been opened.
    tell
        Called with each alarm.
    give_up
        Called with the reason and the names of heliostats newly found mismatched.

    Attributes
    ----------
    mismatched
        Why the board at a heliostat's address is not the heliostat's own board, by name.
    """

    def __init__(
        self,
        field: FieldState,
        armatures: FloatArray,
        expected: Mapping[str, Mapping[str, bytes]],
        connections: Callable[[str], int],
        tell: Callable[[Alarm], None],
        give_up: Callable[[str, frozenset[str]], None],
    ) -> None:
        self._field, self._connections, self._tell = field, connections, tell
        self._give_up = give_up
        self._expected = expected
        self.mismatched: dict[str, str] = {}
        #: Rows of the heliostats that have ever had an armature, by its checksum.
        self._owners: defaultdict[int, set[int]] = defaultdict(set)
        #: Last reported checksums, 0 before; whether they belong to the heliostat itself.
        self._stored = np.zeros(len(field), dtype=np.uint32)
        self._own = np.zeros(len(field), dtype=np.bool_)
        #: Heliostats for which an alarm reports that their cluster sends no row.
        self._unlisted: set[str] = set()
        #: Rows whose checksum belongs to another heliostat.
        self._foreign: set[int] = set()
        self._rows = {
            name: np.array([field.index[n] for n in held], dtype=np.intp)
            for name, held in field.members.items()
        }
        #: Connection in which each cluster last sent a status.
        self._judged: dict[str, int] = {}
        for row, armature in enumerate(armatures):
            self._owners[crc32(armature.tobytes())].add(row)
        for name, items in expected.items():
            if "armature" in items:
                self._owners[crc32(items["armature"])].add(field.index[name])

    def learn(self, row: int, armature: FloatArray) -> None:
        """Add an armature (18,) that a heliostat may store."""
        crc = crc32(np.ascontiguousarray(armature).tobytes())
        if row in self._owners[crc]:
            return
        self._owners[crc].add(row)
        self._judge(np.flatnonzero(self._stored == crc).tolist())

    def on_status(self, cluster: str, status: ClusterStatus, now: float) -> None:
        """Evaluate the heliostats of a cluster from its status."""
        del status, now
        self._judged[cluster] = self._connections(cluster)
        self._compare_rows(cluster)
        rows = self._rows[cluster]
        stored = self._field.rows["armature_crc"][rows]
        changed = stored != self._stored[rows]
        self._stored[rows] = stored
        self._judge(rows[changed].tolist())

    def _compare_rows(self, cluster: str) -> None:
        """Raise or end the alarm about heliostats for which their cluster reports no row."""
        unlisted = self._field.unlisted.intersection(self._field.members[cluster])
        known = self._unlisted.intersection(self._field.members[cluster])
        for name in sorted(unlisted - known):
            self._tell(alarms.UNLISTED.raised(name, cluster=cluster))
        for name in sorted(known - unlisted):
            self._tell(alarms.UNLISTED.ended(name, cluster=cluster))
        self._unlisted = (self._unlisted - known) | unlisted

    def _judge(self, changed: list[int]) -> None:
        """Evaluate the heliostats whose checksum, or its owners, have changed.

        For each pair of heliostats with swapped boards, both are named.
        """
        for row in changed:
            self._own[row] = row in self._of(row)
            alien = not self._own[row] and bool(self._of(row))
            (self._foreign.add if alien else self._foreign.discard)(row)
        if not changed or not (self._foreign or self.mismatched):
            return
        names, reasons = self._field.names, dict[str, str]()
        pairs = [(row, other) for row in sorted(self._foreign) for other in sorted(self._of(row))]
        for row, other in pairs:
            text = refusals.OTHER_PARAMETERS.text.format(other=names[other])
            reasons.setdefault(names[row], text)
        for row, other in pairs:
            if not self._own[other]:
                text = f"its parameters are stored at the address of {names[row]}"
                reasons.setdefault(names[other], text)
        new = tuple(name for name, text in reasons.items() if self.mismatched.get(name) != text)
        for name in new:
            self._tell(alarms.IDENTITY.raised(name, problem=reasons[name]))
        for name in [known for known in self.mismatched if known not in reasons]:
            self._tell(alarms.IDENTITY.ended(name))
        self.mismatched = reasons
        if new:
            self._give_up(reasons[new[0]], frozenset(new))

    def _of(self, row: int) -> set[int]:
        """Return the indices of the heliostats that ever had the armature that a board reports."""
        return self._owners.get(int(self._stored[row]), set())

    def untrusted(self, heliostat: str) -> str | None:
        """Return why a heliostat's reports do not reveal where its beam is; None if they do.

        The heliostat is mismatched, or its board stores an armature unknown to the plant, so its
        step counts belong to the heliostat where the board was before.
        """
        row = self._field.index[heliostat]
        unknown = self._stored[row] != 0 and not self._own[row] and heliostat in self._expected
        return self.mismatched.get(heliostat) or (_UNKNOWN if unknown else None)

    def blocked(self, heliostat: str) -> str | None:
        """Return why a heliostat may be neither moved nor written to; None if it may be."""
        field, row = self._field, self._field.place(heliostat)
        cluster = field.clusters[field.cluster[row]]
        if heliostat in self.mismatched:
            return self.mismatched[heliostat]
        if heliostat in field.unlisted:
            return refusals.UNLISTED.text.format(cluster=cluster)
        judged = self._judged.get(cluster, -1) == self._connections(cluster)
        return None if judged and math.isfinite(field.heard[row]) else refusals.NOT_HEARD.text

    def off(self, now: float) -> dict[str, tuple[Act, str]]:
        """Return the mismatched heliostats to be ordered off, with the action and the reason."""
        if not self.mismatched:
            return {}
        field = self._field
        # DEFOCUSED is not included, because a defocus is relative to goals that may belong to the
        # other heliostat.
        going = field.among(states.TO_STOW, now) | (field.rows["flags"] & meanings.AT_STOW != 0)
        needed = field.live(now) & ~going
        return {
            name: (Act.STOW, f"{name}: {text}")
            for name, text in self.mismatched.items()
            if needed[field.index[name]]
        }
