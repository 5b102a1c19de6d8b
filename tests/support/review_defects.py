"""Defects of locks, persons' orders, files and boards: for `twin_defects`.

Each takes out a mechanism of the third safety review: docs/explanation/hazards.md names them.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from heliotrope.cluster._emergencies import Emergencies
from heliotrope.cluster._work import Work
from heliotrope.lcu import motion, states
from heliotrope.links.messages import Stage
from heliotrope.mechanism import machine
from heliotrope.plant.emergency import Standing, sentinel
from heliotrope.plant.field.identity import Identities
from heliotrope.plant.field.lockouts import Lockouts
from heliotrope.plant.field.witnesses import Witnesses
from heliotrope.plant.motion.proofs import PathProofs
from heliotrope.plant.motion.stray_beams import StrayBeams
from heliotrope.plant.orders import guards
from heliotrope.plant.refusals import OUT_OF_SERVICE
from heliotrope.store import backup
from heliotrope.twin.invariants.invariants import WORDS
from heliotrope.twin.world.faults import Fault

Plant = Callable[[pytest.MonkeyPatch], None]


def one_lock(patch: pytest.MonkeyPatch) -> None:
    """A person's lock replaces those of others."""

    def replaced(self: Any, locks: Any) -> None:
        for lock in locks:
            self._locks[lock.kind, lock.name] = {lock.who: lock}

    patch.setattr(Lockouts, "put", replaced)


def written_under_a_lock(patch: pytest.MonkeyPatch) -> None:
    """Parameters, of any stow position, and counts are written to a heliostat out of service."""
    unlocked = frozenset({"PARAMETERS", "ZERO"})
    rows = [
        replace(each, commands=each.commands - unlocked) if each.refusal is OUT_OF_SERVICE else each
        for each in guards.GUARDS
    ]
    patch.setattr(guards, "GUARDS", tuple(rows))
    patch.setattr(PathProofs, "resting", lambda self, heliostat, items: None)


def unlisted_unseen(patch: pytest.MonkeyPatch) -> None:
    """A heliostat that its cluster's file does not name raises no alarm."""
    patch.setattr(Identities, "_compare_rows", lambda self, cluster: None)


def begins_silently(patch: pytest.MonkeyPatch) -> None:
    """A cluster's program begins without a DEFOCUS of whatever is on its bus."""
    init = Emergencies.__init__

    def silent(self: Any, *given: Any) -> None:
        init(self, *given)
        self._orders, self.pressing = [], False

    patch.setattr(Emergencies, "__init__", silent)


def one_unknown_name_spoils_all(patch: pytest.MonkeyPatch) -> None:
    """A cluster refuses an order for all if it does not know one of the names."""
    take = Work._take_named

    def strict(self: Any, message: Any) -> None:
        unknown = self._nodes.chosen(message.heliostats)[1]
        if not unknown:
            take(self, message)
        for name in message.heliostats if unknown else ():
            self._reports.add(message.identity, Stage.REFUSED, name, "there is an unknown name")

    patch.setattr(Work, "_take_named", strict)


def emergency_forgotten(patch: pytest.MonkeyPatch) -> None:
    """A new program knows nothing of the emergency that held."""
    patch.setattr(sentinel, "_recall", lambda record: Standing())


def any_stow_position(patch: pytest.MonkeyPatch) -> None:
    """Stow positions are written unproven, and the proof believes a mirror that is at stow."""
    on_receiver = StrayBeams.on_receiver

    def off_stow(self: Any, rows: Any) -> Any:
        found = on_receiver(self, rows)
        return found & ~np.isin(self._field.rows["state"][rows], states.STOWED)

    patch.setattr(PathProofs, "resting", lambda self, heliostat, items: None)
    patch.setattr(StrayBeams, "on_receiver", off_stow)


def counts_of_another_mirror(patch: pytest.MonkeyPatch) -> None:
    """A board knows its step counts, whichever mirror its new armature belongs to."""
    patch.setattr(motion, "ELSEWHERE", 1e9)


def turned_away_together(patch: pytest.MonkeyPatch) -> None:
    """All mirrors of a group turn away by the same angles."""
    together = lambda defocus, names, spread: np.tile(defocus, (len(names), 1))  # noqa: E731
    patch.setattr(machine, "spread_defocus", together)


def all_withdrawn(patch: pytest.MonkeyPatch) -> None:
    """One person's withdrawal ends the orders of all."""
    withdraw = sentinel.Sentinel.withdraw

    def careless(self: sentinel.Sentinel, who: str, by: str) -> str:
        for call in self.calls:
            self._callers.withdraw(call.who, call.who, 0.0)
        return withdraw(self, who, by)

    patch.setattr(sentinel.Sentinel, "withdraw", careless)


def backup_unknown(patch: pytest.MonkeyPatch) -> None:
    """A restored store does not know that it is one."""
    patch.setattr(backup, "_lock", lambda copy, now: None)


def contradicted_and_joined(patch: pytest.MonkeyPatch) -> None:
    """Heliostats join the receiver by a sun that a witness contradicts."""
    patch.setattr(Witnesses, "refusal", None)


#: A mirror after the other is missing in its cluster's file for a while, when mirrors are up.
EDITED = tuple(
    Fault("cluster_file", at, 45.0, i, 0.1) for at, i in ((90.0, 0), (140.0, 1), (190.0, 2))
)
#: The plant file has a stow position with the beam on the receiver, for one mirror after another.
STOW_FILE = tuple(Fault("plant_file", 15.0 + 45.0 * i, 2.0, i, 0.9) for i in range(3))
#: Hardly anything fails.
CALM = (Fault("line_cut", 5.0, 2.0, 0, 0.1),)
#: Boards of mirrors that this plant does not know are put in, when mirrors are up.
SPARE = tuple(Fault("board_exchanged", 140.0 + i, 120.0, i, 0.1) for i in range(3))
#: Invariants that may find it, name, defect, the faults or the kinds to draw from, worlds, and
#: whether it is slow; and the seed that found it.
ROWS: tuple[
    tuple[
        tuple[int, ...], str, Plant, tuple[str, ...] | tuple[Fault, ...], tuple[str, ...],
        bool, int,
    ],
    ...,
] = (
    ((WORDS,), "a lock replaces another person's", one_lock,
     ("plant_crash",), ("repairs",), False, 0),
    ((WORDS,), "parameters are written under a lock", written_under_a_lock,
     CALM, ("repairs",), False, 2),
    ((16,), "a mirror in no file raises no alarm", unlisted_unseen,
     ("cluster_file",), ("repairs",), False, 0),
    ((2,), "a cluster begins without a DEFOCUS", begins_silently,
     EDITED, ("repairs", "calm"), False, 1),
    ((2, 4, 13, WORDS), "one unknown name spoils an order", one_unknown_name_spoils_all,
     EDITED, ("repairs",), False, 7),
    ((WORDS,), "an emergency ends with the program", emergency_forgotten,
     ("plant_crash",), ("repairs",), False, 0),
    ((2, 13, 15), "a wrong stow position is proven", any_stow_position,
     STOW_FILE, ("repairs",), False, 3),
    ((15,), "another mirror's board keeps its counts", counts_of_another_mirror,
     SPARE, ("repairs", "calm"), False, 0),
    ((13,), "all turn away by the same angles", turned_away_together,
     ("line_cut",), ("repairs",), False, 5),
    ((WORDS,), "one person withdraws all orders", all_withdrawn,
     CALM, ("repairs",), False, 2),
    ((WORDS,), "a restored store does not know it", backup_unknown,
     ("plant_restored",), ("repairs",), False, 1),
    ((12,), "mirrors join by a contradicted sun", contradicted_and_joined,
     ("line_drop",), ("common", "calm"), False, 0),
)  # fmt: skip
