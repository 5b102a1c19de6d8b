"""Whole boards: a bus with a cluster controller, flash, switches, supply and watchdog."""

import math
from collections.abc import Iterator
from typing import Any

import pytest

from heliotrope.lcu import controller, messages, names, states, wire
from heliotrope.lcu.journal import STATE, Journal
from heliotrope.lcu.sender import Sender
from support.board_chips import DRIVE, Partition, World, board_path
from support.lcu_machines import (
    ADDRESS,
    KEY,
    START_S,
    STOW,
    TOKEN,
    heliostat,
    items_of_heliostat,
    sha256,
)

BOARDS = ("rp2", "esp32", "stm32")


class Plant:
    """A board that runs its main loop, and who talks to it."""

    def __init__(
        self,
        board: str,
        *,
        configured: bool = True,
        local: object = None,
        settings: dict[str, object] | None = None,
    ) -> None:
        self.world = World()
        items = items_of_heliostat(heliostat()) if configured else {}
        with board_path(board, self.world) as load:
            self.settings: Any = load("settings")
            self.settings.KEY = KEY
            self.settings.LOCAL_SWITCH = local
            for key, value in (settings or {}).items():
                setattr(self.settings, key, value)
            self.world.pins[local] = 0
            self.pins = self.settings.PINS
            self.world.pins[self.pins["supply_good"]] = 1
            for pin in self.pins["switches"]:
                self.world.pins[pin] = 1
            load("nor"), load("rs485"), load("inputs"), load("steps"), load("tilt")
            made = load("board").Board(self.settings)
            if items:
                book = Journal(made.storage)
                book.load()
                book.store(items)
                book.zero(*STOW)
            self.loop: Any = load("loop").Loop(made)
        self.sender = Sender(0, START_S, sha256)
        self.uart = made.port.uart
        self.edition = 0
        self.said = 0.0

    @property
    def own(self) -> controller.Controller:
        return self.loop.node.controller  # type: ignore[no-any-return]

    @property
    def state(self) -> str:
        return states.STATES[self.own.state]

    def second(self) -> None:
        """Time, session and a sun in the south."""
        now = START_S + int(self.world.us / 1e6)
        ms = int(self.world.us / 1000) % 1000
        self.uart.incoming += self.sender.session(TOKEN)
        week = now // 604_800, now % 604_800 * 1000 + ms
        self.uart.incoming += self.sender.frame(0xFFFF, "TIME", *week, 1)
        sun = round(-(2**30) * 0.8), round(2**30 * 0.6)
        self.uart.incoming += self.sender.frame(0xFFFF, "SUN", now, 0, *sun, 0, 0, 0)

    def run(self, seconds: float) -> None:
        end = self.world.us + 1e6 * seconds
        while self.world.us < end:
            if self.world.us - self.said > 1e6:
                self.said = self.world.us
                self.second()
            self.world.advance(4000)
            self.loop.turn()

    def ask(self, name: str, *values: object, to: int = ADDRESS) -> list[tuple[str, Any]]:
        """Send, wait a little, and return the answers."""
        self.uart.sent = b""
        who = messages.who_of(messages.NUMBER_OF[name])
        head: tuple[object, ...] = ()
        if who in (messages.AUTHORITY, messages.KEY):
            head = TOKEN, START_S + int(self.world.us / 1e6) + 5
        if who == messages.KEY:
            self.edition += 1
            head = (*head, self.edition)
        key = KEY if who == messages.KEY else b""
        self.uart.incoming += self.sender.frame(to, name, *head, *values, key=key)
        self.run(0.05)
        return [(frame.name, frame.values()) for frame in wire.Reader().feed(self.uart.sent)]

    def order(self, name: str, *values: object) -> int:
        ((answer, told),) = self.ask(name, *values)
        assert answer == "ACK"
        return int(told[2])


@pytest.fixture(params=BOARDS)
def plant(request: pytest.FixtureRequest) -> Iterator[Plant]:
    Partition.device = None
    yield Plant(request.param)
    Partition.device = None


def pulses(plant: Plant) -> list[int]:
    one, one_way, two, two_way = plant.pins["steps"]
    found = [plant.world.pulses(one, one_way), plant.world.pulses(two, two_way)]
    return [sum(sign for _, sign in axis) for axis in found]


def test_a_motion_over_the_bus_comes_out_at_the_pins(plant: Plant) -> None:
    plant.run(1.5)
    assert plant.state == "STOWED"
    assert plant.order("IDLE") == messages.DONE
    assert plant.order("GOTO", STOW[0] - 900, STOW[1] - 700) == messages.DONE
    plant.run(3)
    ((name, told),) = plant.ask("QUERY_STEPS")
    assert name == "STEPS"
    assert told == (STOW[0] - 900, STOW[1] - 700) * 2
    assert pulses(plant) == [-900, -700]
    # The supply goes without a warning; the chip holds the counts at rest.
    kept = Journal(plant.loop.board.storage)
    kept.load()
    assert (kept.primary, kept.secondary) == (STOW[0] - 900, STOW[1] - 700)
    assert kept.doubt == 0


def test_supply_and_temperature_are_told(plant: Plant) -> None:
    plant.world.pins["mv"] = 24_600
    plant.run(1.5)
    ((_, told),) = plant.ask("QUERY_STATUS")
    assert told[5] == pytest.approx(24_600, abs=20)
    assert told[6] == 27
    plant.world.pins["mv"] = 12_000
    plant.run(1.5)
    assert plant.own.fault == controller.SUPPLY
    assert plant.order("CLEAR_FAULT") == messages.REFUSED_STATE
    plant.world.pins["mv"] = 24_000
    plant.run(1.5)
    assert plant.order("CLEAR_FAULT") == messages.DONE


def test_the_supply_falls_amid_a_motion_and_the_counts_are_kept(plant: Plant) -> None:
    plant.run(1.5)
    plant.order("IDLE")
    plant.order("GOTO", STOW[0] - 9000, STOW[1])
    plant.run(1.0)
    plant.world.pins[plant.pins["supply_good"]] = 0
    plant.loop.turn()
    kept = Journal(plant.loop.board.storage)
    kept.load()
    plant.world.advance(100_000)  # what the timer had in hand
    assert -9000 < pulses(plant)[0] < -1000
    assert kept.primary - STOW[0] == pulses(plant)[0]
    assert kept.doubt == 0
    assert plant.own.fault == controller.SUPPLY
    # It was a dip only.
    plant.world.pins[plant.pins["supply_good"]] = 1
    plant.run(0.2)
    assert plant.order("CLEAR_FAULT") == messages.DONE
    assert plant.order("GOTO", STOW[0] - 9000, STOW[1]) == messages.DONE
    plant.run(4)
    assert pulses(plant)[0] == -9000


@pytest.mark.parametrize("number", [0, 1])
def test_a_limit_switch_stops_the_axes(plant: Plant, number: int) -> None:
    plant.run(1.5)
    plant.order("IDLE")
    plant.order("GOTO", STOW[0] - 9000, STOW[1])
    plant.run(1.0)
    plant.world.pins[plant.pins["limits"][number]] = 1
    plant.run(0.2)
    held = pulses(plant)
    plant.run(1)
    assert pulses(plant) == held
    assert plant.own.fault == controller.LIMIT_SWITCH
    assert plant.own.motion.place(0) - STOW[0] == held[0]
    assert plant.order("CLEAR_FAULT") == messages.REFUSED_STATE
    plant.world.pins[plant.pins["limits"][number]] = 0
    plant.run(0.1)
    assert plant.order("CLEAR_FAULT") == messages.DONE


@pytest.mark.parametrize(("board", "pin"), [("rp2", 12), ("esp32", 15), ("stm32", "C4")])
def test_the_switch_at_the_mirror_locks_it(board: str, pin: object) -> None:
    Partition.device = None
    plant = Plant(board, local=pin)
    plant.run(1.5)
    plant.order("IDLE")
    plant.order("GOTO", STOW[0] - 9000, STOW[1])
    plant.run(1.0)
    plant.world.pins[pin] = 1
    plant.run(0.2)
    held = pulses(plant)
    plant.run(1)
    assert pulses(plant) == held
    assert plant.state == "LOCKED"
    assert plant.own.motion.place(0) - STOW[0] == held[0]
    ((_, told),) = plant.ask("QUERY_STATUS")
    assert told[1] >> names.FLAGS.index("LOCAL_SWITCH") & 1
    assert plant.order("UNLOCK") == messages.REFUSED_SWITCH
    assert plant.order("STOW") == messages.REFUSED_SWITCH
    plant.world.pins[pin] = 0
    plant.run(1)
    assert pulses(plant) == held
    assert plant.order("STOW") == messages.DONE
    Partition.device = None


@pytest.mark.parametrize("board", BOARDS)
def test_switches_give_the_address_until_the_wire_does(board: str) -> None:
    Partition.device = None
    plant = Plant(board, configured=False)
    for place in (0, 3):
        plant.world.pins[plant.pins["switches"][place]] = 0
    assert plant.loop.board.switches() == 9
    plant.own.config.address = plant.loop.board.switches()
    plant.run(1.5)
    ((name, told),) = plant.ask("QUERY_STATUS", to=9)
    assert (name, told[0]) == ("STATUS", states.UNCONFIGURED)
    ((name, told),) = plant.ask("SET_ADDRESS", plant.loop.board.serial, 31, to=9)
    assert (name, told[2]) == ("ACK", messages.DONE)
    assert plant.ask("QUERY_STATUS", to=9) == []
    assert plant.ask("QUERY_STATUS", to=31)


def test_nothing_leaves_while_the_driver_is_off(plant: Plant) -> None:
    plant.run(1.5)
    port = plant.loop.board.port
    assert plant.ask("QUERY_STATUS")
    drive = DRIVE[next(b for b in BOARDS if DRIVE[b] == plant.uart.drive)]
    assert plant.world.pins[drive] == 0  # released again, so that others can talk
    begin = plant.world.us
    port.write(bytes(250))
    assert plant.world.us - begin > 250 * 86  # not before the last bit has left
    assert plant.world.pins[drive] == 0


def test_the_watchdog_is_fed_and_bites_a_loop_that_hangs(plant: Plant) -> None:
    plant.run(5)
    plant.world.advance(2_100_000)
    with pytest.raises(AssertionError, match="the watchdog bit"):
        plant.run(0.1)


def test_a_partition_serves_the_esp32_as_well() -> None:
    Partition.device = Partition()
    try:
        plant = Plant("esp32")
        plant.run(1.5)
        assert type(plant.loop.board.storage).__name__ == "Blocks"
        assert plant.order("LOCK") == messages.DONE
        kept = Journal(plant.loop.board.storage)
        kept.load()
        assert kept.state & STATE == states.LOCKED
    finally:
        Partition.device = None


@pytest.mark.parametrize("board", BOARDS)
def test_a_chip_that_does_not_answer_is_named(board: str) -> None:
    Partition.device = None
    world = World()
    with board_path(board, world) as load:
        import machine  # type: ignore[import-not-found]

        machine.SPI.dead = True
        settings: Any = load("settings")
        load("nor"), load("rs485"), load("inputs"), load("steps"), load("tilt")
        with pytest.raises(OSError, match="no flash chip answers"):
            load("board").Board(settings)


def test_flash_writes_over_the_borders_of_pages() -> None:
    world = World()
    with board_path("rp2", world) as load:
        nor: Any = load("nor")
        import machine  # type: ignore[import-not-found]

        chip = nor.SpiNor(machine.SPI(0), machine.Pin(17, value=1))
    data = bytes(range(1, 256)) * 3
    chip.write(4096 + 100, data)
    assert chip.read(4096 + 100, len(data)) == data
    assert chip.read(4096, 100) == b"\xff" * 100
    chip.erase(1)
    assert chip.read(4096, 4096) == b"\xff" * 4096
    chip.spi.busy_until = world.us + 10**5
    chip.write(0, b"x")  # it waits
    assert chip.read(0, 1) == b"x"
    chip.spi.busy_until = world.us + 10**8
    with pytest.raises(OSError, match="stays busy"):
        chip.write(0, b"x")


def test_drivers_are_enabled_for_motions_and_off_at_rest() -> None:
    for name in BOARDS:
        Partition.device = None
        plant = Plant(name, settings={"ENABLE": "enable"})
        plant.run(1.5)
        assert plant.world.pins["enable"] == 0  # low is on
        plant.order("LOCK")
        assert plant.order("SET_STEPPING", 4, 4, 1) == messages.DONE
        plant.run(1.0)
        assert plant.world.pins["enable"] == 1
        plant.order("UNLOCK")
        plant.order("IDLE")
        plant.order("GOTO", STOW[0] - 900, STOW[1] - 700)
        plant.run(3)
        assert plant.world.pins["enable"] == 1
        assert pulses(plant) == [-900, -700]
        for axis in (0, 1):
            rises = plant.world.rises[plant.pins["steps"][2 * axis]]
            assert {levels["enable"] for _, levels in rises} == {0}
    Partition.device = None


@pytest.mark.parametrize("name", BOARDS)
def test_a_diagnosis_over_the_bus_reads_the_chip(name: str) -> None:
    Partition.device = None
    plant = Plant(name, settings={"TILT": ("data", "clock")})
    plant.run(1.5)
    chip = plant.loop.board.accelerometer.i2c
    stuck = False

    def follow() -> None:
        # The elevation turns the mirror about x, by the motor's steps of 3.3 µrad.
        turned = 0.0 if stuck else -2.0 * math.pi / 1_920_000 * pulses(plant)[1]
        chip.gravity = (0.0, math.sin(0.1 + turned), math.cos(0.1 + turned))

    assert plant.order("IDLE") == messages.DONE
    for stuck, fault in ((False, controller.NO_FAULT), (True, controller.STUCK_SECONDARY)):
        if plant.own.fault:
            assert plant.order("CLEAR_FAULT") == messages.DONE
        assert plant.order("DIAGNOSE") == messages.DONE
        for _ in range(80):
            follow()
            plant.run(0.25)
        ((answer, told),) = plant.ask("QUERY_DIAGNOSIS")
        assert answer == "DIAGNOSIS"
        assert plant.own.fault == fault, told
        assert bool(told[0] & 2) is not stuck
        assert told[2] != 0
        assert math.hypot(*told[3:]) == pytest.approx(0.0 if stuck else 0.02, abs=1e-3)
    Partition.device = None


def test_a_board_without_one_says_so() -> None:
    Partition.device = None
    plant = Plant("rp2")
    assert plant.loop.board.tilt() is None
