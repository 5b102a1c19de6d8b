"""Random events, thousands of them: the invariants hold after each."""

import random

import pytest

from heliotrope.lcu import controller, messages, motion, names, states, ticks
from heliotrope.lcu.sender import Sender
from support.lcu_machines import (
    ADDRESS,
    AIM,
    STANDBY,
    STOW,
    TOKEN,
    Bench,
    heliostat,
    standing_by,
    tracking,
)

COMMANDS = [
    ("TRACK", lambda r: ()), ("REFOCUS", lambda r: ()), ("APPROACH", lambda r: ()),
    ("IDLE", lambda r: ()), ("LOCK", lambda r: ()), ("UNLOCK", lambda r: ()),
    ("CLEAR_FAULT", lambda r: ()), ("DIAGNOSE", lambda r: ()),
    ("SEARCH", lambda r: (r.choice([1e-3, 5e-3, 0.0]), r.choice([0.01, 0.05, 1e9]))),
    ("AIM", lambda r: r.choice([AIM, (1.0, 2.0, 45.0), (9e9, 0.0, 0.0), (40.0, 80.0, -50.0)])),
    ("STANDBY", lambda r: r.choice([STANDBY, (-10.0, 1.0, 44.0), (0.0, 3e7, 0.0)])),
    ("JOG", lambda r: (r.randint(0, 2), r.choice([5, -3000, 10**6, -(2**31)]))),
    ("GOTO", lambda r: (r.randint(-(10**6), 2 * 10**6), r.randint(-(10**5), 6 * 10**5))),
    ("ROUGH", lambda r: (r.randint(0, 2),)), ("LOCK_AIM", lambda r: (r.choice([0, 0, 1, 3]),)),
]  # fmt: skip
SETTINGS = [
    ("SET_ARMATURE", lambda r: r.choice([TABLE, TABLE, (0.0,) * 18, (1e30,) * 18])),
    ("SET_BIAS", lambda r: r.choice([BIASES, (9.0, 0.0)])),
    ("SET_DEFOCUS", lambda r: r.choice([(0.1, 0.05), (0.0, 0.0), (-0.2, 0.0)])),
    ("SET_LIMITS", lambda r: (r.randint(0, 2), *r.choice([(0, 1, 1, 1, 0), (9, 1, 1, 1, 0)]))),
    ("SET_STOW", lambda r: r.choice([STOW, (2**30, 0)])),
]  # fmt: skip
#: What leads on from a state: tried often, so that all states are seen.
ONWARDS = {
    "LOCKED": "UNLOCK",
    "FAULT": "CLEAR_FAULT",
    "STOWED": "APPROACH",
    "IDLE": "TRACK",
    "DEFOCUSED": "REFOCUS",
    "TRACKING": "SEARCH",
    "SEARCHING": "IDLE",
}
TABLE = tuple(heliostat().armature.table)
BIASES = tuple(float(d.table[7]) for d in (heliostat().drives[0], heliostat().drives[1]))


class Fuzz:
    """Random events on a bench, and what must not happen at any of them."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.bench = self.random.choice([Bench, standing_by, tracking])()
        self.talked = 0
        self.recorded: list[bytes] = []
        self.seen: set[str] = set()

    def moved_by(self) -> tuple[object, ...]:
        """All that a refused message must leave alone."""
        self.bench.tick(0)
        own = self.bench.controller
        way = own.motion
        return (
            own.state,
            way.kind,
            way.aim,
            way.ready,
            way.goal(0),
            way.goal(1),
            own.fault,
            own.config.standby,
            own.config.stow,
            own.sun.age_ms(),
            dict(self.bench.journal.items),
        )

    def event(self) -> None:
        """One event."""
        choice = self.random.choices(
            [
                self.wait,
                self.command,
                self.refused,
                self.safe,
                self.setting,
                self.jump,
                self.fault,
                self.noise,
                self.reset,
                self.links,
            ],
            [30, 30, 12, 4, 5, 2, 1, 5, 1, 3],
        )[0]
        before = self.bench.state
        choice()
        self.bench.check()
        self.seen.add(self.bench.state)
        if self.bench.state == "TRACKING" and before != "TRACKING":
            # Invariant 3: by a command that was accepted just now, and from where it may.
            assert choice == self.command
            assert before in ("IDLE", "DEFOCUSED", "SEARCHING")

    def wait(self) -> None:
        bench = self.bench
        for _ in range(self.random.choice([1, 3, 20, 60, 400])):
            if bench.true_ms - self.talked > 1000:
                self.talked = bench.true_ms
                bench.second()
            before = bench.state
            bench.tick(self.random.choice([50, 50, 50, 7, 120, 1500]))
            assert bench.state != "TRACKING" or before == "TRACKING"

    def command(self) -> None:
        bench = self.bench
        name, values = self.random.choice(COMMANDS)
        if self.random.random() < 0.7:
            bench.second()
            name = ONWARDS.get(bench.state, name)
            values = dict(COMMANDS)[name]
        before = self.moved_by()
        result = bench.order(name, *values(self.random))
        if result != messages.DONE:
            self.same(before)
        self.recorded.append(bench.sender.frame(ADDRESS, name, TOKEN, 0, *values(self.random)))

    def same(self, before: tuple[object, ...]) -> None:
        """Nothing moved, but for what time alone has done: a lease may have ended."""
        after = self.moved_by()
        if after[0] != before[0]:
            itself = [
                new
                for state, event, new, _ in names.transitions()
                if state == before[0] and names.EVENTS[event][0] == names.INTERNAL
            ]
            assert after[0] in itself
        elif self.bench.controller.motion.kind in (motion.APPROACH, motion.RETURN):
            assert after[:4] + after[6:] == before[:4] + before[6:]  # goals go along the path
        else:
            assert after == before

    def refused(self) -> None:
        """Invariants 4 and 5: stranger, wrong token, expired, replayed, reordered, no key."""
        bench, rand = self.bench, self.random
        bench.second()
        bench.tick(1)
        name, values = rand.choice(COMMANDS)
        numbers = values(rand)
        life = bench.gps_ms() // 1000 + 5
        way = rand.randrange(6)
        before = self.moved_by()
        if way == 0:
            data = Sender(99, 2**31).frame(ADDRESS, name, TOKEN, life, *numbers)
        elif way == 1:
            data = bench.sender.frame(ADDRESS, name, TOKEN ^ rand.randint(1, 99), life, *numbers)
        elif way == 2:
            data = bench.sender.frame(
                ADDRESS, name, TOKEN, life - rand.choice([7, 99, 10**6]), *numbers
            )
        elif way == 3 and self.recorded:
            data = rand.choice(self.recorded)
        elif way == 4:
            data = bench.sender.frame(ADDRESS + 1, name, TOKEN, life, *numbers)
        else:
            data = bench.sender.frame(
                ADDRESS, "SET_ARMATURE", TOKEN, life, bench.edition + 1, *TABLE, key=b"y" * 32
            )
        bench.deliver(data)
        self.same(before)

    def safe(self) -> None:
        """Invariant 4: taken from anyone, in any state; afterwards no beam stays."""
        name = self.random.choice(["DEFOCUS", "STOW"])
        self.bench.answers.clear()
        self.bench.deliver(Sender(self.random.randint(1, 99), 0).frame(ADDRESS, name))
        assert self.bench.answers[-1][1][-1] == messages.DONE
        assert self.bench.state not in ("TRACKING", "SEARCHING", "APPROACHING", "IDLE")
        if name == "STOW" and self.bench.state not in ("UNCONFIGURED", "LOCKED", "FAULT"):
            assert self.bench.state in ("STOWING", "STOWED")

    def setting(self) -> None:
        bench = self.bench
        name, values = self.random.choice(SETTINGS)
        bench.second()
        before, was = self.moved_by(), bench.state
        if bench.order(name, *values(self.random)) != messages.DONE:
            self.same(before)
        else:
            assert was in ("UNCONFIGURED", "STOWED", "LOCKED", "FAULT", "IDLE", "DEFOCUSED")
            assert bench.controller.config.complete()

    def jump(self) -> None:
        """Invariant 9: ticks or the cluster's clock jump."""
        bench = self.bench
        if self.random.random() < 0.5:
            size = self.random.choice([-(2**29), 2**29 - 1, -5000, -10, 700, 10**6, 2**30])
            bench.now = ticks.add(bench.now, size)
            bench.tick(0)
        else:
            bench.clock_error_ms += self.random.choice([-(10**7), -4000, 4000, 10**7])

    def fault(self) -> None:
        bench, own = self.bench, self.bench.controller
        number = self.random.choice([controller.SUPPLY, controller.LIMIT_SWITCH])
        halt = self.random.random() < 0.5
        if halt:
            axes = own.motion.stepper.axes  # type: ignore[union-attr]
            # No step beyond the limits is undone: it was never made.
            one, two = [a.direction * self.random.randint(0, 9) if a.speed else 0 for a in axes]
            bench.motors.undone = one, two
        bench.node.on_fault(number, bench.now, halt)
        bench.check()
        assert own.fault != controller.NO_FAULT
        if self.random.random() < 0.8:
            own.fault_gone(number)

    def noise(self) -> None:
        """Invariant 6: bytes of any kind, and numbers of any kind past the gate."""
        bench = self.bench
        before = self.moved_by()
        bench.deliver(bytes(self.random.randrange(256) for _ in range(60)) + b"\0")
        number = self.random.choice([0, 0x7F, 0x02, 0x0D, 255])
        bench.do(bench.controller.on_message(number, 1, (1, 2, 3), b"", 0, bench.now, True))
        self.same(before)

    def reset(self) -> None:
        """Invariant 7: a reset at any instant."""
        bench = self.bench
        locked, at_fault = bench.state == "LOCKED", bench.controller.fault
        bench.start(bench.flash)
        assert max(map(abs, bench.slip)) <= bench.journal.stride * 8
        assert bench.state in ("STOWED", "STOWING", "DEFOCUSED", "LOCKED", "FAULT")
        assert not locked or bench.state == "LOCKED"
        if at_fault and not locked:
            assert bench.state == "FAULT"

    def links(self) -> None:
        """Parts of the cluster fall silent or come back."""
        self.bench.sends_sun = self.random.random() < 0.8
        self.bench.sends_time = self.random.random() < 0.8


def _search(seeds: range, events: int) -> set[str]:
    """Random events, then silence; the states that were seen."""
    seen: set[str] = set()
    for seed in seeds:
        fuzz = Fuzz(seed)
        for _ in range(events):
            fuzz.event()
        seen |= fuzz.seen
        # Whatever happened: left alone, it is off the receiver in 30 s and at stow in 5 minutes,
        # locked or not, unless it does not know where it is.
        bench = fuzz.bench
        bench.sends_sun = bench.sends_time = False
        state, begin = bench.state, bench.true_ms
        while bench.state in ("TRACKING", "SEARCHING", "APPROACHING"):
            bench.tick()
            assert bench.true_ms - begin < 6100
        bench.run(294)
        if bench.controller.motion.known:
            assert bench.controller.motion.at_stow(), (seed, state)
    return seen


@pytest.mark.parametrize("block", range(4))
def test_invariants_hold_whatever_happens(block: int) -> None:
    assert len(_search(range(3 * block, 3 * block + 3), 120)) >= 5


@pytest.mark.slow
@pytest.mark.parametrize("block", range(20))
def test_invariants_hold_for_long(block: int) -> None:
    _search(range(1000 + 20 * block, 1020 + 20 * block), 200)


def test_the_events_reach_every_state_but_one() -> None:
    """A search that never sees a state says nothing of it."""
    seen: set[str] = set()
    for seed in range(100, 107):
        fuzz = Fuzz(seed)
        for _ in range(80):
            fuzz.event()
        seen |= fuzz.seen
    assert seen == set(states.STATES) - {"UNCONFIGURED"}
