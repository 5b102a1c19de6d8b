"""The main loop of a board: calls `lcu.node` in time."""

import time

from lcu.node import Node

from lcu import controller

#: Intervals of the node's ticks and of measurements, ms.
TICK, MEASURE = 10, 1000
#: Limits of the supply (mV) and of the board (°C); beyond them there is a fault.
LEAST_MV, MOST_MV, HOTTEST, COLDEST = 20000, 30000, 80, -35


class Loop:
    """One board.

    ``board`` has ``storage``, ``timer`` (with ``pump``), ``port``, ``serial``, ``firmware``,
    ``sha256``, ``key``, ``switches()`` (0: none), ``supply_mv()``, ``temperature_degc()``,
    ``supply_good()``, ``limit_hit()``, ``switched_off()``, ``tilt()``, ``feed()`` and
    ``drivers(on)``.
    """

    def __init__(self, board):
        self.board = board
        now = time.ticks_ms() & 0x3FFFFFFF
        self.node = Node(
            board.storage,
            board.timer,
            board.port.write,
            now,
            board.serial,
            board.firmware,
            board.sha256,
            board.key,
            board.tilt,
            board.feed,
            board.drivers,
        )
        config = self.node.controller.config
        if config.address == 0:
            # No address set over the wire yet: use the switches.
            config.address = board.switches()
        self.ticked = self.measured = now
        self.failing = self.limited = self.off = False
        self.hot = self.weak = False

    def turn(self):
        """Run one pass of the loop; to be called without a pause."""
        board, node = self.board, self.node
        now = time.ticks_ms() & 0x3FFFFFFF
        self.guard(now)
        board.timer.pump()
        data = board.port.read()
        if data:
            node.on_bytes(data, now)
        if time.ticks_diff(now, self.ticked) >= TICK:
            self.ticked = now
            node.on_tick(now)
            board.timer.pump()
        if time.ticks_diff(now, self.measured) >= MEASURE:
            self.measured = now
            self.measure(now)

    def guard(self, now):
        """Handle urgent inputs: the supply's fall, limit switches, the switch at the mirror."""
        good = self.board.supply_good()
        if not good and not self.failing:
            self.failing = True
            self.node.on_supply_failing(now)
        elif good and self.failing:
            self.failing = False
            self.node.fault_gone(controller.SUPPLY)
        hit = self.board.limit_hit()
        if hit and not self.limited:
            self.node.on_fault(controller.LIMIT_SWITCH, now, True)
        elif self.limited and not hit:
            self.node.fault_gone(controller.LIMIT_SWITCH)
        self.limited = hit
        off = self.board.switched_off()
        if off and not self.off:
            self.node.on_fault(controller.SWITCH, now, True)
        elif self.off and not off:
            self.node.fault_gone(controller.SWITCH)
        self.off = off

    def measure(self, now):
        """Measure supply and temperature, for STATUS; beyond their limits latch a fault."""
        supply, warmth = self.board.supply_mv(), self.board.temperature_degc()
        self.node.measured(supply, warmth)
        self.weak = self._judge(
            controller.SUPPLY, not LEAST_MV <= supply <= MOST_MV, self.weak, now
        )
        self.hot = self._judge(
            controller.TEMPERATURE, not COLDEST <= warmth <= HOTTEST, self.hot, now
        )

    def _judge(self, fault, bad, was, now):
        if bad and not was:
            self.node.on_fault(fault, now, False)
        elif was and not bad and not (fault == controller.SUPPLY and self.failing):
            self.node.fault_gone(fault)
        return bad

    def run(self):
        while True:
            self.turn()
