"""A small field of firmware-true boards, with what a live plant asks of a field.

Each heliostat is a `twin.board.Board`: the real local controller on simulated hardware, with
journal, MACs and editions. Boards stand on a `twin.bus.TwinBus` at its baud rate.
"""

import struct

import numpy as np

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, bisector, normalize
from heliotrope.lcu import states
from heliotrope.links.clock import Clock
from heliotrope.mechanism.board_items import Machine, items_of
from heliotrope.mechanism.chain import Mechanism
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.bus import TwinBus
from heliotrope.twin.boards.outfit import STOW, Outfit
from heliotrope.twin.cameras import Mirror
from heliotrope.twin.live._field import key_of, near

#: More boards than this are too much for one process.
MOST = 64


class BoardField:
    """Boards of N heliostats.

    Parameters
    ----------
    clock
        Of the loop.
    names
        Of the heliostats.
    truth, believed
        Mechanisms as they stand, and as the boards are told, (N,).
    machine
        What no calibration changes, the same for all; stow is the boards' own.
    seed
        Of flash and motors.

    Attributes
    ----------
    boards
        In the order of the names; they are switched on.

    Raises
    ------
    InputError
        Too many, or a stow position that a new board does not stand at.
    """

    def __init__(
        self,
        clock: Clock,
        names: tuple[str, ...],
        truth: Mechanism,
        believed: Mechanism,
        machine: Machine,
        seed: int = 0,
    ) -> None:
        if len(names) > MOST:
            raise InputError(f"boards: {len(names)} heliostats; one process bears {MOST}")
        if machine.stow != STOW:
            raise InputError(f"boards: stow at {machine.stow}; a new board stands at {STOW}")
        self._clock = clock
        self.boards: list[Board] = []
        for i, name in enumerate(names):
            items = {**items_of(believed[i], machine), "address": struct.pack("<H", 0)}
            outfit = Outfit(name, 0, 1 + i, key_of(name), truth[i], {}, items)
            self.boards.append(Board(outfit, seed=seed + i))

    def __len__(self) -> int:
        return len(self.boards)

    def bus(self, rows: range) -> TwinBus:
        """Return the bus of a cluster of some rows; its boards are switched on."""
        made = []
        for place, row in enumerate(rows):
            old = self.boards[row].outfit
            items = {**old.items, "address": struct.pack("<H", place + 1)}
            outfit = Outfit(
                old.name, place + 1, old.serial, old.key, old.mechanism, old.causes, items
            )
            self.boards[row] = board = Board(outfit, seed=row)
            board.power_on(self._clock.monotonic())
            made.append(board)
        return TwinBus(self._clock, [*made])

    def advance(self, milliseconds: int) -> None:
        """Let the boards look as often as they must; their time is the clock's."""
        del milliseconds
        now = self._clock.monotonic()
        for board in self.boards:
            if board.due(now) <= now:
                board.step(now)

    def _stand(self) -> tuple[FloatArray, FloatArray]:
        pairs = [board.mirror() for board in self.boards]
        return np.stack([n for _, n in pairs]), np.stack([v for v, _ in pairs])

    def errors(self, sun: FloatArray, aims: FloatArray) -> FloatArray:
        """Return by how much normals are off their aims (N, 3), rad, (N,); NaN if none tracks."""
        normal, vertex = self._stand()
        wanted = bisector(sun, normalize(aims - vertex))
        off = np.arcsin(np.clip(np.linalg.norm(np.cross(normal, wanted), axis=-1), 0.0, 1.0))
        tracks = np.array([board.state == states.TRACKING for board in self.boards])
        # What is on its way, or on a target, tells nothing of the aim that is asked for.
        return np.where(tracks & (off < 0.05), off, np.nan)

    def mirrors_near(
        self,
        sun: FloatArray,
        middle: FloatArray,
        normal: FloatArray,
        reach: float,
        names: tuple[str, ...],
        sizes: FloatArray,
    ) -> list[Mirror]:
        """Return the mirrors whose rays meet a plane within a distance of its middle, m."""
        return near(self._stand(), sun, middle, normal, reach, names, sizes)
