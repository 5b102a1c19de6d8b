"""Local controllers in a process of their own, each at its serial port, in real time.

``python -m support.boards_process COUNT SEED FIRST PORT…`` runs the boards FIRST, FIRST + 1, …
of a field (`prototype_field`), one at each port. A line on the standard input asks where the motors
stand: the answer is one line of JSON, ``{name: [state, primary, secondary]}``. The end of the
input ends the process, as a power cut ends a board: at any instant.
"""

import json
import os
import select
import sys
import termios
import time
import tty
from dataclasses import dataclass

import numpy as np

from heliotrope.lcu import states
from heliotrope.mechanism.board_items import items_of
from heliotrope.mechanism.chain import Mechanism
from heliotrope.twin.boards import outfit
from heliotrope.twin.boards.board import Board
from support.whole_plant import MACHINE, installed, nominal


@dataclass(frozen=True)
class PrototypeField:
    """Heliostats as they are believed to stand, and as they stand."""

    names: tuple[str, ...]
    perfect: Mechanism
    truth: Mechanism
    items: tuple[dict[str, bytes], ...]

    def outfit(self, index: int) -> outfit.Outfit:
        """One of them, for a board."""
        address = 11 + index
        items = {**self.items[index], "address": address.to_bytes(2, "little")}
        key = key_of(index)
        return outfit.Outfit(
            self.names[index], address, 5000 + index, key, self.truth[index], {}, items
        )


def key_of(index: int) -> bytes:
    return bytes([index + 1]) * 32


def prototype_field(count: int, seed: int) -> PrototypeField:
    """So many heliostats in an arc."""
    perfect = nominal(count)
    names = tuple(f"H{i + 1:02d}" for i in range(count))
    items = tuple(items_of(perfect[i], MACHINE) for i in range(count))
    return PrototypeField(names, perfect, installed(perfect, seed), items)


def _open(path: str) -> int:
    port = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(port, termios.TCSANOW)
    return port


def main() -> None:
    """Be the boards."""
    count, seed, first = (int(text) for text in sys.argv[1:4])
    field = prototype_field(count, seed)
    ports = {_open(path): first + i for i, path in enumerate(sys.argv[4:])}
    boards = {port: Board(field.outfit(i), seed=seed + i) for port, i in ports.items()}
    for board in boards.values():
        board.power_on(time.monotonic())
    print("ready", flush=True)
    while True:
        now = time.monotonic()
        due = min(board.due(now) for board in boards.values())
        ready = select.select([0, *boards], [], [], min(max(0.0, due - now), 0.05))[0]
        for port in ready:
            if port != 0:
                answer = boards[port].hear(os.read(port, 4096), time.monotonic())
                if answer:
                    os.write(port, answer)
            elif os.read(0, 100):
                print(json.dumps({b.outfit.name: _where(b) for b in boards.values()}), flush=True)
            else:
                return
        for port, board in boards.items():
            now = time.monotonic()
            if board.due(now) <= now:
                answer = board.step(now)
                if answer:
                    os.write(port, answer)


def _where(board: Board) -> list[object]:
    counts = [int(axis.joint) for axis in board.axes]
    return [states.STATES[board.state], *np.asarray(counts).tolist()]


if __name__ == "__main__":
    main()
