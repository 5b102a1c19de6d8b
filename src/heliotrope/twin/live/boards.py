"""A small field of boards that run the real firmware.

Each heliostat is a `twin.boards.board.Board`: the real local controller on simulated hardware, with
journal, MACs and editions. The boards are connected to a `TwinBus` with its baud rate.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, bisector, normalize
from heliotrope.lcu import states
from heliotrope.links.clock import Clock
from heliotrope.mechanism.board_items import items_of
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.machine import Machine
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.bus import TwinBus
from heliotrope.twin.boards.outfit import Outfit, own_items, sha256

#: Most boards that one process can run.
MOST = 64
#: Heliostats with larger errors are still moving, or are on a target, rad.
_ON_ITS_WAY = 0.05


def key_of(name: str) -> bytes:
    """Return the key of a simulated heliostat."""
    return sha256(b"live " + name.encode())


class BoardField:
    """The boards of N heliostats.

    Parameters
    ----------
    clock
        Clock of the event loop.
    names
        Names of the heliostats.
    truth, believed
        True mechanisms, and the mechanisms that the boards store, (N,).
    machines
        Limits and rest positions of each heliostat's drives.
    seed
        Seed of the flash and the motors.

    Attributes
    ----------
    boards
        One board per name, in the same order; `bus` switches them on.

    Raises
    ------
    InputError
        If there are too many heliostats.
    """

    def __init__(
        self,
        clock: Clock,
        names: tuple[str, ...],
        truth: Mechanism,
        believed: Mechanism,
        machines: Sequence[Machine],
        seed: int = 0,
    ) -> None:
        if len(names) > MOST:
            raise InputError(f"boards: {len(names)} heliostats; one process runs {MOST} at most")
        self._clock = clock
        self.boards: list[Board] = []
        for i, name in enumerate(names):
            items = items_of(believed[i], machines[i])
            outfit = Outfit(name, 0, 1 + i, key_of(name), truth[i], {}, items)
            self.boards.append(Board(outfit, seed=seed + i))

    def __len__(self) -> int:
        return len(self.boards)

    def bus(self, rows: range) -> TwinBus:
        """Return the bus of a cluster with some of the heliostats, and switch on their boards."""
        made = []
        for place, row in enumerate(rows):
            old = self.boards[row].outfit
            items = {**old.items, **own_items(place + 1)}
            self.boards[row] = board = Board(replace(old, address=place + 1, items=items), seed=row)
            board.power_on(self._clock.monotonic())
            made.append(board)
        return TwinBus(self._clock, [*made])

    def advance(self, milliseconds: int) -> None:
        """Run each board when it is due, following the clock."""
        del milliseconds
        now = self._clock.monotonic()
        for board in self.boards:
            if board.due(now) <= now:
                board.step(now)

    def stand(self) -> tuple[FloatArray, FloatArray]:
        """Return the true normals and vertices, each (N, 3)."""
        pairs = [board.mirror() for board in self.boards]
        return np.stack([n for _, n in pairs]), np.stack([v for v, _ in pairs])

    def errors(self, sun: FloatArray, aims: FloatArray) -> FloatArray:
        """Return the error of each normal at its aim, rad, (N,); NaN for a heliostat not tracking.

        ``aims`` has shape (N, 3), m.
        """
        normal, vertex = self.stand()
        required = bisector(sun, normalize(aims - vertex))
        off = np.arcsin(np.clip(np.linalg.norm(np.cross(normal, required), axis=-1), 0.0, 1.0))
        tracks = np.array([board.state == states.TRACKING for board in self.boards])
        return np.where(tracks & (off < _ON_ITS_WAY), off, np.nan)
