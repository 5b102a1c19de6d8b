"""The controller of one heliostat, on a bench with a journal, motors, a cluster and a sun."""

import copy
import math
import struct
from binascii import crc32
from itertools import pairwise

import numpy as np
import pytest

from heliotrope.lcu import controller, messages, names, ticks, wire
from heliotrope.lcu.messages import (
    BAD_VALUE,
    BUSY,
    DONE,
    DUPLICATE,
    EXPIRED,
    REFUSED_AUTHORITY,
    REFUSED_KEY,
    REFUSED_STATE,
    REFUSED_SWITCH,
)
from heliotrope.lcu.motion import DEFOCUS, HOLD, MOVE
from heliotrope.lcu.sender import Sender
from support.lcu_machines import (
    ADDRESS,
    AIM,
    KEY,
    STANDBY,
    STOW,
    TOKEN,
    Bench,
    Flash,
    heliostat,
    items_of_heliostat,
    standing_by,
    tracking,
)

#: A beam this far from the aim (m) is off the receiver.
OFF = 5.0


def flags(bench: Bench) -> set[str]:
    bits = bench.controller.flags()
    return {name for i, name in enumerate(names.FLAGS) if bits >> i & 1}


# The way of the beam.


def test_the_beam_comes_along_the_ground_and_up_and_then_stays_on_the_aim() -> None:
    bench = Bench()
    bench.run(1.5)
    assert bench.state == "STOWED"
    assert bench.order("AIM", *AIM) == DONE
    assert bench.order("APPROACH") == DONE
    nearest, places = math.inf, []
    while bench.state == "APPROACHING":
        bench.run(0.05)
        nearest = min(nearest, bench.miss(AIM))
        places.append(tuple(bench.made))
    assert nearest > OFF
    # Azimuth first: elevation stays until it stands.
    azimuths = [place[0] for place in places if place[1] == STOW[1]]
    first_moved = next(place for place in places if place[1] != STOW[1])
    assert azimuths[0] != azimuths[-1]
    assert abs(azimuths[-1] - first_moved[0]) <= 1
    bench.run(3)
    assert bench.miss(STANDBY) < 0.01
    assert bench.order("TRACK") == DONE
    bench.run(15)
    assert {"READY", "SUN_FRESH", "CONFIGURED", "CLOCK_SET"} <= flags(bench)


def test_tracking_is_accurate_to_the_lead_of_the_backlash() -> None:
    bench = tracking()
    for _ in range(120):
        bench.run(1)
        # Five steps of 3.3 µrad on each axis, doubled by the mirror, at 103 m.
        assert bench.miss(AIM) < 2 * 103 * 6 * 3.3e-6
    calm = tracking()
    for axis in calm.controller.motion.stepper.axes:  # type: ignore[union-attr]
        axis.backlash = 0
    calm.run(5)
    for _ in range(60):
        calm.run(1)
        assert calm.miss(AIM) < 2 * 103 * 1.5 * 3.3e-6


def test_stow_leads_back_the_same_way() -> None:
    bench = tracking()
    assert bench.order("STOW") == DONE
    assert bench.state == "STOWING"
    nearest = 0.0
    for _ in range(400):
        bench.run(0.5, until="STOWED")
        miss = bench.miss(AIM)
        assert miss > 0.9 * nearest or miss > OFF  # away from the aim, and not back to it
        nearest = max(nearest, min(miss, OFF))
        if bench.state == "STOWED":
            break
        if bench.made[0] == STOW[0] and bench.controller.motion.kind == controller.STOW:
            assert bench.made[1] == STOW[1]  # azimuth last
    assert bench.state == "STOWED"
    assert tuple(bench.made) == STOW
    assert bench.journal.rest


def test_stow_leads_by_the_standby_point_from_an_aim_beside_it() -> None:
    bench = standing_by()
    assert bench.order("AIM", STANDBY[0] + 5.0, *STANDBY[1:]) == DONE
    assert bench.order("TRACK") == DONE
    bench.run(10)
    assert bench.miss(STANDBY) > 4.0
    assert bench.order("STOW") == DONE
    nearest = math.inf
    while bench.state == "STOWING":
        bench.tick()
        nearest = min(nearest, bench.miss(STANDBY))
    assert nearest < 0.1


def test_a_sun_that_cannot_be_served_leaves_the_receiver() -> None:
    bench = tracking()
    bench.controller.motion.aim = tuple(bench.machine.position - [0.0, 0.0, 50.0])  # type: ignore[assignment]
    bench.controller.motion.renew()
    bench.run(5)
    assert bench.state == "DEFOCUSED"
    assert "UNREACHABLE" in flags(bench)


# The lease.


@pytest.mark.parametrize("framed", [True, False])
def test_a_lease_that_ends_while_the_board_stands_still_has_ended_for_the_next_order(
    framed: bool,
) -> None:
    bench = tracking()
    bench.now, bench.true_ms = ticks.add(bench.now, 7000), bench.true_ms + 7000
    if framed:
        assert bench.order("TRACK") == REFUSED_STATE
    else:
        number = messages.NUMBER_OF["TRACK"]
        bench.do(bench.controller.on_message(number, 1, (TOKEN, 0), b"", DONE, bench.now, True))
    assert bench.state == "DEFOCUSED"


def test_without_sun_it_defocuses_and_stows_by_itself() -> None:
    for loss in ("sun", "everything"):
        bench = tracking()
        bench.sends_sun, bench.sends_time = False, loss == "sun"
        last = bench.last_sun_ms
        bench.run(10, until="DEFOCUSED")
        assert bench.true_ms - last <= 6050
        while bench.miss(AIM) < OFF:
            bench.run(0.5)
        assert bench.true_ms - last < 30_000
        bench.run(300, until="STOWED")
        assert bench.true_ms - last < 300_000
        assert tuple(bench.made) == STOW


def test_orders_to_turn_away_do_not_put_off_the_stow_without_sun() -> None:
    bench = tracking()
    bench.sends_sun = False
    for _ in range(8):
        bench.run(5, until="STOWING")
        bench.send("DEFOCUS", to=0xFFFF)
    assert bench.state == "STOWING"


def test_nothing_but_the_sun_renews_the_lease() -> None:
    bench = tracking()
    bench.sends_sun = False
    while bench.state == "TRACKING":
        bench.second()
        bench.order("TRACK")
        bench.order("AIM", *AIM)
        bench.send("QUERY_STATUS")
        bench.tick()
        assert bench.true_ms - bench.last_sun_ms <= 6050
    assert bench.order("TRACK") == REFUSED_STATE


def test_an_old_or_repeated_sun_gives_nothing() -> None:
    bench = tracking()
    bench.sends_sun = False
    bench.run(4)
    taken = bench.last_sun_ms
    second = bench.gps_ms() // 1000
    for age in (4, 7, 60, -10, -3):
        bench.send("SUN", *bench.sun_values(second - age), to=0xFFFF)  # repeated, old, future
    bench.send("SUN", second, 0, 0, 0, 0, 0, 0)  # no sun
    bench.send("SUN", second, 0, 2**30, -(2**29), 0, 0, 0)
    bench.send("SUN", second, 0, int(0.9 * 2**30), -int(0.4359 * 2**30), 0, 0, 0)  # night
    assert bench.controller.sun.bad == 8
    bench.run(5, until="DEFOCUSED")
    assert bench.true_ms - taken <= 6050


@pytest.mark.parametrize(
    "wrong",
    ["clock fast by 10 min", "clock slow by 10 min", "longitude", "mirrored", "half a degree"],
)
def test_a_sun_that_cannot_follow_from_the_last_one_gives_nothing(wrong: str) -> None:
    bench = tracking()
    last = bench.true_ms
    right = bench.sun

    def sun(second: float) -> np.ndarray:
        if wrong.startswith("clock"):
            return right(second + (600 if "fast" in wrong else -600))
        east, north, up = right(second)
        turn = math.radians({"longitude": 2.5, "half a degree": 0.5}.get(wrong, 0.0))
        if wrong == "mirrored":
            return np.array([-east, north, up])
        sine, cosine = math.sin(turn), math.cos(turn)
        return np.array([cosine * east - sine * north, sine * east + cosine * north, up])

    bench.sun = sun  # type: ignore[method-assign]
    bench.run(7, until="DEFOCUSED")
    assert bench.state == "DEFOCUSED"
    assert bench.true_ms - last <= 6050
    assert bench.controller.sun.leaps >= 4
    # After the lapse it is taken, as after a start, but STATUS shows it, and nothing tracks again.
    bench.run(3)
    assert {"SUN_FRESH", "SUN_JUMPED"} <= flags(bench)
    assert bench.state == "DEFOCUSED"


def test_suns_that_follow_are_taken_however_late_or_rare() -> None:
    bench = tracking()
    bench.sends_sun = False
    for _ in range(5):
        bench.run(5)
        second = bench.gps_ms() // 1000
        bench.send("SUN", *bench.sun_values(second - 4))  # after 4 s in transit
        assert "SUN_FRESH" in flags(bench)
        bench.send("SUN", *bench.sun_values(second))
        bench.last_sun_ms = bench.true_ms
        assert bench.state == "TRACKING"
    # A night, and a restart in it: the sun has gone round.
    for restart in (False, True):
        if restart:
            bench.start(bench.flash)
        for _ in range(14):
            bench.tick(3_600_000)
        bench.sends_sun = True
        bench.run(3)
        bench.sends_sun = False
        assert "SUN_FRESH" in flags(bench)
    assert "SUN_JUMPED" not in flags(bench)
    assert bench.controller.sun.leaps == 0


def test_a_sun_that_was_under_way_gives_so_much_less() -> None:
    bench = tracking()
    bench.sends_sun = False
    bench.run(4)
    bench.send("SUN", *bench.sun_values(bench.gps_ms() // 1000 - 3))
    bench.last_sun_ms = bench.true_ms - 3000
    assert 2900 <= bench.controller.sun.age_ms() <= 4000
    bench.run(5, until="DEFOCUSED")
    assert bench.state == "DEFOCUSED"


@pytest.mark.parametrize("jump", [-3600_000, -2000, -100, 100, 2500, 3600_000, 1 << 29, -(1 << 29)])
def test_a_jump_of_ticks_never_extends_the_lease(jump: int) -> None:
    bench = tracking()
    bench.sends_sun = bench.sends_time = False
    last = bench.last_sun_ms
    bench.run(2)
    bench.now = ticks.add(bench.now, jump)
    bench.do(bench.controller.on_tick(bench.now))
    bench.run(6, until="DEFOCUSED")
    assert bench.state == "DEFOCUSED"
    assert bench.true_ms - last <= 6050


@pytest.mark.parametrize("error_ms", [-3600_000, -5000, 5000, 3600_000, 604_800_000])
def test_a_jump_of_gps_time_never_extends_the_lease(error_ms: int) -> None:
    bench = tracking()
    last = bench.last_sun_ms
    bench.clock_error_ms = error_ms
    bench.sends_sun = False
    bench.run(7, until="DEFOCUSED")
    assert bench.true_ms - last <= 6050
    assert "CLOCK_JUMPED" in flags(bench)
    # A cluster whose clock was set is believed again after the lapse.
    bench.sends_sun = True
    bench.run(3)
    assert "SUN_FRESH" in flags(bench)
    assert bench.state == "DEFOCUSED"


def test_ticks_may_wrap_while_tracking() -> None:
    bench = Bench(tick=ticks.PERIOD - 60_000)
    bench.to_tracking()
    assert bench.now < 200_000
    assert bench.miss(AIM) < 0.01


# Commands.


def test_defocus_turns_the_beam_away_and_refocus_brings_it_back() -> None:
    bench = tracking()
    assert bench.order("DEFOCUS") == DONE
    begin = bench.true_ms
    while bench.miss(AIM) < OFF:
        bench.run(0.5)
    assert bench.true_ms - begin < 10_000
    bench.run(20)
    for _ in range(3):
        bench.send("DEFOCUS", to=0xFFFF)  # broadcast three times: it does not add up
    before = list(bench.made)
    bench.run(5)
    assert np.abs(np.subtract(bench.made, before)).max() < 300
    assert bench.order("REFOCUS") == DONE
    bench.run(20)
    assert bench.state == "TRACKING"
    assert bench.miss(AIM) < 0.01


@pytest.mark.parametrize("name", ["DEFOCUS", "STOW"])
def test_an_approach_that_is_called_off_before_its_first_step_does_not_begin(name: str) -> None:
    """Simulated run 980557: told DEFOCUS so early, a mirror went on to standby all the same."""
    bench = Bench()
    bench.run(1.5)
    assert bench.order("APPROACH") == DONE
    assert bench.order(name) == DONE
    for _ in range(160):
        bench.run(0.5, until="STOWED")
        assert tuple(bench.made) == STOW
    assert bench.state == "STOWED"
    assert bench.order("IDLE") == DONE
    assert bench.order("TRACK") == REFUSED_STATE


@pytest.mark.parametrize("before", ["IDLE", "TRACKING"])
def test_a_defocus_turns_by_angles_of_its_own_and_not_by_those_of_the_last(before: str) -> None:
    """From standby it goes down the way, and from the aim after that by the angles again."""
    bench = tracking() if before == "TRACKING" else standing_by()
    assert bench.state == before
    assert bench.order("DEFOCUS") == DONE
    bench.run(10)
    for _ in range(2):
        assert bench.order("REFOCUS") == DONE
        bench.run(30)
        assert bench.order("TRACK") == DONE
        bench.run(20)
        assert bench.miss(AIM) < 0.01
        begin = bench.machine.drives.angles(np.array(bench.made))
        assert bench.order("DEFOCUS") == DONE
        bench.run(20)
        assert bench.miss(AIM) > OFF
        turned = bench.machine.drives.angles(np.array(bench.made)) - begin
        assert np.abs(turned) == pytest.approx([0.1, 0.05], abs=4e-3)


def test_a_defocus_without_a_standby_point_turns_by_its_angles_after_one_from_standby() -> None:
    """The one before turned by none, down the way; this one has no standby point to turn from."""
    bench = standing_by()
    assert bench.order("DEFOCUS") == DONE
    bench.run(10)
    assert bench.order("REFOCUS") == DONE
    bench.run(30)
    begin = bench.machine.drives.angles(np.array(bench.made))
    bench.controller.motion.config.standby = None
    assert bench.order("DEFOCUS") == DONE
    bench.run(20)
    turned = bench.machine.drives.angles(np.array(bench.made)) - begin
    assert turned == pytest.approx([0.1, 0.05], abs=4e-3)
    assert bench.miss(AIM) > OFF


def usual_turn(bench: Bench) -> tuple[np.ndarray, tuple[float, float, float]]:
    """Angles to which the usual turn, by 0.1 and 0.05 rad, leads, and a point of the beam there."""
    turned = bench.machine.drives.angles(np.array(bench.made)) + [0.1, 0.05]
    normal, vertex = bench.machine.armature.pose(turned)
    sun = bench.sun(bench.gps_ms() / 1000)
    east, north, up = vertex + 100.0 * (2.0 * (normal @ sun) * normal - sun)
    return turned, (float(east), float(north), float(up))


@pytest.mark.parametrize("kind", ["DEFOCUS", "the plant is gone"])
def test_from_standby_a_defocus_turns_away_from_the_aim_and_not_onto_it(kind: str) -> None:
    bench = standing_by()
    _, aim = usual_turn(bench)
    assert bench.order("AIM", *aim) == DONE
    assert bench.miss(aim) > OFF
    if kind == "DEFOCUS":
        assert bench.order("DEFOCUS") == DONE
    else:
        bench.sends_sun = bench.sends_time = False
    nearest = math.inf
    for _ in range(40):
        bench.run(0.5)
        nearest = min(nearest, bench.miss(aim))
    assert bench.state == "DEFOCUSED"
    assert nearest > OFF
    assert "UNREACHABLE" not in flags(bench)


@pytest.mark.parametrize("moment", ["at standby", "locked at standby", "on the way up"])
@pytest.mark.parametrize("cause", ["DEFOCUS", "the cluster is gone"])
def test_whatever_its_aim_a_mirror_goes_back_down_the_way(moment: str, cause: str) -> None:
    """Simulated run 980292: an aim on a target lay where turning off it led onto the receiver."""
    bench = standing_by() if "at standby" in moment else brought_to("STOWED")
    if "locked" in moment:
        assert bench.order("LOCK") == DONE
    if moment == "on the way up":
        assert bench.order("APPROACH") == DONE
        while bench.controller.motion._place < len(bench.controller.motion.way()) - 1:
            bench.run(0.1)
    drives, begin = bench.machine.drives, np.array(bench.made)
    # An aim off which the usual angles turn up, away from the way.
    normal, vertex = bench.machine.armature.pose(drives.angles(begin) - [0.05, 0.025])
    sun = bench.sun(bench.gps_ms() / 1000)
    bench.controller.motion.aim = tuple(vertex + 100.0 * (2.0 * (normal @ sun) * normal - sun))
    if cause == "DEFOCUS":
        assert bench.order("DEFOCUS") == DONE
    bench.sends_sun = bench.sends_time = cause == "DEFOCUS"
    while bench.controller.motion.kind != DEFOCUS:
        begin = np.array(bench.made)
        bench.run(0.1)
    bench.run(20)
    assert bench.state == ("LOCKED" if "locked" in moment else "DEFOCUSED")
    foot = np.array([*STANDBY[:2], bench.machine.position[2]])
    line = [foot + part * (np.array(STANDBY) - foot) for part in np.linspace(0.0, 1.0, 101)]
    beside = [bench.miss(point) for point in line]
    assert min(beside) < 0.5
    assert np.argmin(beside) < 90
    turned = np.abs(drives.angles(np.array(bench.made)) - drives.angles(begin))
    assert (turned > [0.095, 0.045]).any()
    if moment != "at standby":
        return
    # It stows from there along the way, and does not come up again.
    bench.sends_sun = bench.sends_time = True
    bench.run(3)
    off = bench.miss(STANDBY)
    assert bench.order("STOW") == DONE
    for _ in range(10):
        bench.run(0.5)
        assert bench.miss(STANDBY) > off - 0.5


@pytest.mark.parametrize("locked", [False, True])
@pytest.mark.parametrize("cause", ["DEFOCUS", "the cluster is gone"])
def test_a_mirror_that_is_held_beside_its_aim_does_not_turn_onto_it(
    cause: str, locked: bool
) -> None:
    bench = standing_by()
    assert bench.order("JOG", 0, 400) == DONE
    bench.run(5)
    if locked:
        assert bench.order("LOCK") == DONE
    turned, aim = usual_turn(bench)
    assert bench.order("AIM", *aim) == DONE
    if cause == "DEFOCUS":
        assert bench.order("DEFOCUS") == DONE
    else:
        bench.sends_sun = bench.sends_time = False
    nearest = math.inf
    for _ in range(40):
        bench.run(0.5)
        nearest = min(nearest, bench.miss(aim))
    begin = bench.machine.drives.angles(np.array(bench.made))
    assert begin == pytest.approx(turned - [0.2, 0.1], abs=2e-3)
    assert nearest > OFF


def test_from_an_aim_a_defocus_turns_away_from_standby() -> None:
    """Simulated runs 910267 and 51065: from a target, the usual sense led onto the receiver."""
    bench = standing_by()
    drives = bench.machine.drives
    there = drives.angles(np.array(bench.made))
    # Aims from which the usual turn, by 0.1 and 0.05 rad, would lead to standby, and past it.
    sun = bench.sun(bench.gps_ms() / 1000)
    for turn, expected in (((-0.1, -0.05), (-0.1, -0.05)), ((0.02, -0.02), (0.1, -0.05))):
        one = copy.deepcopy(bench)
        normal, vertex = bench.machine.armature.pose(there + turn)
        east, north, up = vertex + 100.0 * (2.0 * (normal @ sun) * normal - sun)
        assert one.order("AIM", float(east), float(north), float(up)) == DONE
        assert one.order("TRACK") == DONE
        one.run(20)
        begin = drives.angles(np.array(one.made))
        assert one.order("DEFOCUS") == DONE
        one.run(20)
        assert one.state == "DEFOCUSED"
        assert drives.angles(np.array(one.made)) - begin == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("near", [0, 1])
def test_between_stops_too_near_for_a_defocus_it_goes_to_the_farther_one(near: int) -> None:
    """0.1 rad fit neither way between stops 0.03 and 0.06 rad off."""
    bench = tracking()
    motion = bench.node.controller.motion
    drive = motion.config.drives[0]
    assert drive is not None
    here = drive.angle(motion.place(0))
    stops = [here - 0.03, here + 0.06] if near == 0 else [here - 0.06, here + 0.03]
    motion._stops[0][:] = stops
    motion.defocus()
    assert drive.angle(motion.goal(0)) == pytest.approx(stops[1 - near], abs=1e-4)


def test_a_defocused_mirror_goes_with_the_sun() -> None:
    bench = tracking()
    bench.order("DEFOCUS")
    bench.run(20)
    normal, _ = bench.pose()
    first = 2.0 * (normal @ bench.sun(bench.gps_ms() / 1000)) * normal
    first = first - bench.sun(bench.gps_ms() / 1000)
    bench.run(300)
    assert bench.state == "DEFOCUSED"
    normal, _ = bench.pose()
    sun = bench.sun(bench.gps_ms() / 1000)
    # The sun has gone 22 mrad, the beam stands still.
    assert np.linalg.norm(2.0 * (normal @ sun) * normal - sun - first) < 5e-3


def test_a_defocused_mirror_that_can_no_longer_go_with_the_sun_stows() -> None:
    bench = tracking()
    bench.order("DEFOCUS")
    bench.run(5)
    bench.controller.motion._target = tuple(bench.machine.position - [0.0, 0.0, 50.0])
    bench.controller.motion.renew()
    bench.run(40, until="STOWING")
    assert bench.state == "STOWING"


STATES_TO_TRY = (
    "UNCONFIGURED",
    "STOWED",
    "STOWING",
    "APPROACHING",
    "IDLE",
    "TRACKING",
    "DEFOCUSED",
    "LOCKED",
    "SEARCHING",
    "FAULT",
)


def brought_to(state: str) -> Bench:
    """A bench in a state."""
    if state == "UNCONFIGURED":
        return empty()
    if state in ("STOWED", "APPROACHING"):
        bench = Bench()
        bench.run(1.5)
        if state == "APPROACHING":
            assert bench.order("APPROACH") == DONE
            bench.run(70)
    elif state == "IDLE":
        bench = standing_by()
    else:
        bench = tracking()
        if state == "SEARCHING":
            assert bench.order("SEARCH", 2e-3, 0.02) == DONE
        elif state == "FAULT":
            bench.do(bench.controller.on_fault(controller.SUPPLY, bench.now, False))
            bench.run(0.5)
        elif state != "TRACKING":
            order = {"STOWING": "STOW", "DEFOCUSED": "DEFOCUS", "LOCKED": "LOCK"}[state]
            assert bench.order(order) == DONE
            bench.run(3)
    assert bench.state == state
    return bench


@pytest.mark.parametrize("state", STATES_TO_TRY)
@pytest.mark.parametrize("name", ["DEFOCUS", "STOW"])
def test_defocus_and_stow_work_in_every_state_from_anyone(state: str, name: str) -> None:
    bench = brought_to(state)
    stranger = Sender(99, 1)
    bench.answers.clear()
    bench.deliver(stranger.frame(ADDRESS, name))
    assert bench.answers == [(0x0D, (1, messages.NUMBER_OF[name], DONE))]
    bench.sends_sun = False
    bench.run(30)
    assert bench.miss(AIM) > OFF
    if name == "STOW" and state != "UNCONFIGURED":
        bench.run(260)
        assert tuple(bench.made) == STOW
        latched = state in ("LOCKED", "FAULT")
        assert bench.state == (state if latched else "STOWED")


def test_a_stow_replaces_a_defocus_and_is_not_undone_by_one() -> None:
    bench = tracking()
    bench.order("DEFOCUS")
    bench.run(1)
    bench.order("STOW")
    bench.run(2)
    for _ in range(3):
        bench.send("DEFOCUS")
    bench.run(300, until="STOWED")
    assert bench.state == "STOWED"


def test_commands_need_the_authority_and_to_be_fresh() -> None:
    """Invariants 4 and 5: whatever is refused moves nothing."""
    bench = standing_by()
    before = bench.state, bench.controller.motion.kind
    assert bench.order("TRACK", token=TOKEN + 1) == REFUSED_AUTHORITY
    assert bench.order("TRACK", life_s=-1) == EXPIRED
    assert bench.order("TRACK", life_s=9000) == EXPIRED
    stranger = Sender(99, 1)
    life = bench.gps_ms() // 1000 + 5
    bench.deliver(stranger.frame(ADDRESS, "TRACK", TOKEN, life))
    assert bench.answers[-1][1][-1] == REFUSED_AUTHORITY
    data = bench.sender.frame(ADDRESS, "JOG", TOKEN, life, 0, 100)
    bench.deliver(data)
    assert bench.answers[-1][1][-1] == DONE
    goal = bench.controller.motion.goal(0)
    bench.deliver(data)
    assert bench.answers[-1][1][-1] == DUPLICATE
    assert bench.controller.motion.goal(0) == goal
    broken = bytearray(bench.sender.frame(ADDRESS, "TRACK", TOKEN, life))
    broken[7] ^= 4
    bench.deliver(bytes(broken))
    assert (bench.state, before[0]) == ("IDLE", "IDLE")


def test_tracking_needs_the_safe_way_first() -> None:
    bench = Bench()
    bench.run(1.5)
    bench.order("AIM", *AIM)
    for name in ("TRACK", "REFOCUS"):
        assert bench.order(name) == REFUSED_STATE
    assert bench.order("IDLE") == DONE
    assert bench.state == "IDLE"
    assert bench.order("TRACK") == REFUSED_STATE
    assert bench.order("SEARCH", 1e-3, 0.01) == REFUSED_STATE
    assert bench.state == "IDLE"
    halfway = brought_to("APPROACHING")
    halfway.order("AIM", *AIM)
    assert halfway.order("TRACK") == REFUSED_STATE
    halfway.order("DEFOCUS")
    assert halfway.order("REFOCUS") == REFUSED_STATE
    halfway.run(120, until="STOWED")  # a beam that does not go with the sun is not left there
    assert halfway.state == "STOWED"


@pytest.mark.parametrize("way", ["by STOW", "by STOW, broken off", "by silence", "by a fault"])
def test_stow_ends_what_the_safe_way_has_earned(way: str) -> None:
    """Invariant 3: after a return to stow, or part of it, TRACK needs the safe way again."""
    bench = tracking()
    if way == "by silence":
        bench.sends_sun = bench.sends_time = False
        bench.run(300, until="STOWED")
        bench.sends_sun = bench.sends_time = True
    elif way == "by a fault":
        bench.node.on_fault(controller.TEMPERATURE, bench.now, False)
        bench.node.fault_gone(controller.TEMPERATURE)
        bench.run(200)
        assert bench.order("CLEAR_FAULT") == DONE
    else:
        assert bench.order("STOW") == DONE
        bench.run(300 if way == "by STOW" else 2, until="STOWED")
    if "broken" in way:
        bench.node.on_fault(controller.LIMIT_SWITCH, bench.now, True)
        bench.node.fault_gone(controller.LIMIT_SWITCH)
        bench.run(2)
        assert bench.order("CLEAR_FAULT") == DONE
    bench.run(3)
    assert bench.state == ("IDLE" if "broken" in way else "STOWED")
    assert "READY" not in flags(bench)
    assert bench.order("IDLE") == DONE
    for name in ("TRACK", "REFOCUS"):
        assert bench.order(name) == REFUSED_STATE
    assert bench.order("SEARCH", 1e-3, 0.01) == REFUSED_STATE
    assert bench.state == "IDLE"
    assert bench.controller.motion.kind == HOLD


@pytest.mark.parametrize("name", ["TRACK", "SEARCH", "REFOCUS"])
def test_nothing_goes_onto_the_receiver_without_a_fresh_sun(name: str) -> None:
    bench = standing_by()
    assert bench.order("JOG", 0, 100) == DONE
    bench.sends_sun = False
    bench.run(8)  # dusk: the cluster is heard, so a jogged mirror stays
    assert bench.state == "IDLE"
    assert "READY" in flags(bench)
    assert "SUN_FRESH" not in flags(bench)
    values = (2e-3, 0.02) if name == "SEARCH" else ()
    assert bench.order(name, *values) == REFUSED_STATE
    assert (bench.state, bench.controller.motion.kind) == ("IDLE", MOVE)


def test_the_approach_passes_the_ground_beside_the_tower_and_its_foot_in_this_order() -> None:
    bench = brought_to("STOWED")
    assert bench.order("AIM", *AIM) == DONE
    east, north, up = bench.machine.position
    half = np.array([STANDBY[0] - east, STANDBY[1] - north]) / 2
    sine, cosine = 0.5, math.sqrt(0.75)
    aside = east + cosine * half[0] - sine * half[1], north + sine * half[0] + cosine * half[1], up
    assert bench.order("APPROACH") == DONE
    passed: dict[str, list[float]] = {}
    while bench.state == "APPROACHING":
        bench.run(0.05)
        for place, point in (
            ("beside", aside), ("foot", (*STANDBY[:2], up)), ("standby", STANDBY)
        ):  # fmt: skip
            passed.setdefault(place, []).append(bench.miss(point))
    nearest = {place: int(np.argmin(misses)) for place, misses in passed.items()}
    assert max(min(misses) for misses in passed.values()) < 1.0
    assert nearest["beside"] < nearest["foot"] < nearest["standby"]
    seen = [np.subtract(point, (east, north, up)) for point in bench.controller.motion.way()]
    for one, other in pairwise(point / np.linalg.norm(point) for point in seen):
        assert math.acos(min(1.0, one @ other)) < 0.16
    # From the foot on it rises below the standby point, never beside it.
    rise = passed["standby"][nearest["foot"] :]
    assert all(after <= before + 0.5 for before, after in pairwise(rise))


def test_approach_needs_sun_and_a_way() -> None:
    bench = Bench()
    bench.sends_sun = False
    bench.run(2)
    assert bench.order("APPROACH") == REFUSED_STATE
    bench.sends_sun = True
    bench.run(2)
    assert bench.order("STANDBY", 40.0, 80.0, -50.0) == DONE
    assert bench.order("APPROACH") == BAD_VALUE
    assert bench.order("STANDBY", *STANDBY) == DONE
    assert bench.order("APPROACH") == DONE


def test_a_lock_holds_until_it_is_released() -> None:
    bench = tracking()
    assert bench.order("LOCK") == DONE
    bench.run(2)
    held = list(bench.made)
    for name in ("TRACK", "APPROACH", "IDLE", "REFOCUS"):
        assert bench.order(name) == REFUSED_STATE
    assert bench.order("JOG", 0, 5) == REFUSED_STATE
    bench.sends_sun = False
    bench.run(400)  # dusk: the cluster is heard, and no timer moves the mirror
    assert bench.made == held
    bench.start(bench.flash)
    assert bench.state == "LOCKED"  # nor a reset
    bench.sends_sun = True
    bench.run(12)
    assert bench.made == held
    assert bench.order("DEFOCUS") == DONE
    bench.run(12)
    assert bench.state == "LOCKED"
    assert bench.made != held
    assert bench.order("UNLOCK") == DONE
    assert bench.state == "IDLE"
    assert bench.order("UNLOCK") == REFUSED_STATE


def held_by(how: str) -> Bench:
    """A bench whose mirror holds its beam near the receiver, or seeks it."""
    if how == "jogged":
        bench = standing_by()
        assert bench.order("JOG", 0, 20_000) == DONE
        bench.run(0.5)
    elif how.startswith("without its "):
        bench = tracking()
        bench.run(1)
        items = items_of_heliostat(bench.machine)
        del items[how.removeprefix("without its ")]
        journal = controller_journal(bench.flash)
        bench.flash.data[: 2 * bench.flash.block_size] = b"\xff" * (2 * bench.flash.block_size)
        journal.load()
        journal.store(items)
        bench.start(bench.flash)
    else:
        bench = tracking()
        if how == "searching":
            assert bench.order("SEARCH", 2e-3, 0.02) == DONE
        elif how == "at fault":
            bench.node.on_fault(controller.LIMIT_SWITCH, bench.now, True)
            bench.node.fault_gone(controller.LIMIT_SWITCH)
        else:
            assert bench.order("LOCK") == DONE
        bench.run(2)
        if how == "locked over a reset":
            bench.start(bench.flash)
    assert bench.state == {
        "jogged": "IDLE", "searching": "SEARCHING", "at fault": "FAULT",
        "without its armature": "UNCONFIGURED", "without its stow": "UNCONFIGURED",
    }.get(how, "LOCKED")  # fmt: skip
    return bench


@pytest.mark.parametrize(
    "how",
    ["locked", "locked over a reset", "jogged", "searching", "at fault", "without its armature"],
)
def test_no_state_outlives_its_cluster(how: str) -> None:
    """Invariants 2 and 13: off the receiver in 30 s, at stow in 5 minutes; a latch stays."""
    bench = held_by(how)
    state = bench.state
    bench.sends_sun = bench.sends_time = False
    begin = bench.true_ms
    while bench.miss(AIM) < OFF:
        bench.run(0.5)
        assert bench.true_ms - begin < 30_000
    while tuple(bench.made) != STOW or not bench.controller.motion.still():
        bench.run(1)
        assert bench.true_ms - begin < 300_000
    bench.run(1)
    assert bench.state == ("STOWED" if how in ("jogged", "searching") else state)


def test_a_stow_without_a_stow_position_does_not_end_a_turn_away() -> None:
    """The beam would stay where it is, and the mirror has nowhere else to go."""
    bench = held_by("without its stow")
    bench.run(0.3)
    assert bench.miss(AIM) < OFF
    assert bench.order("STOW") == DONE
    bench.run(30)
    assert bench.miss(AIM) > OFF
    assert bench.state == "UNCONFIGURED"


def test_a_mirror_that_is_locked_at_stow_stands_still_without_a_cluster() -> None:
    bench = Bench()
    bench.run(1.5)
    assert bench.order("LOCK") == DONE
    bench.sends_sun = bench.sends_time = False
    steps: list[tuple[int, ...]] = []
    bench.motors.play = lambda *values: steps.append(values)  # type: ignore[method-assign]
    bench.run(400)
    assert steps == []
    assert bench.state == "LOCKED"


@pytest.mark.parametrize("change", ["SET_STOW", "ZERO"])
@pytest.mark.parametrize("reset", [False, True])
@pytest.mark.parametrize("cause", ["STOW", "DEFOCUS", "silence"])
def test_a_mirror_that_is_locked_at_stow_stays_there_whatever_is_written(
    change: str, reset: bool, cause: str
) -> None:
    """Somebody is at work there: only UNLOCK lets it go where stow is by now."""
    bench = Bench()
    bench.run(1.5)
    assert bench.order("LOCK") == DONE
    assert bench.order(change, STOW[0] + 2000, STOW[1] - 2400) == DONE
    if reset:
        bench.run(1)
        bench.start(bench.flash)
        bench.run(1)
    held = list(bench.made)
    if cause == "silence":
        bench.sends_sun = bench.sends_time = False
    else:
        assert bench.order(cause) == DONE
    bench.run(60)
    assert bench.made == held
    assert bench.state == "LOCKED"
    assert "AT_STOW" not in flags(bench)  # nothing is called stow that is not
    bench.sends_sun = bench.sends_time = True
    bench.run(2)
    assert bench.order("UNLOCK") == DONE
    assert bench.state == "IDLE"
    assert bench.order("STOW") == DONE
    bench.run(60, until="STOWED")
    stow = bench.controller.config.stow
    assert tuple(bench.made) == stow


@pytest.mark.parametrize("name", ["DEFOCUS", "STOW"])
@pytest.mark.parametrize("after_s", [0.05, 0.5])
def test_a_lock_does_not_end_what_takes_the_beam_off(name: str, after_s: float) -> None:
    """LOCK during an emergency held a beam on the receiver for 10 s to 14 s."""
    bench, free = tracking(), tracking()
    for each in (bench, free):
        assert each.order(name) == DONE
        each.run(after_s)
    assert bench.miss(AIM) < OFF
    assert bench.order("LOCK") == DONE
    assert bench.state == "LOCKED"
    assert bench.order("UNLOCK") == BUSY  # it would stop as well
    while free.miss(AIM) < OFF:
        free.run(0.1)
        bench.run(0.1)
    bench.run(0.2)
    assert bench.miss(AIM) > 0.9 * OFF
    bench.run(200)
    assert bench.state == "LOCKED"
    assert "AT_STOW" in flags(bench)
    assert bench.order("UNLOCK") == DONE
    assert bench.state == "STOWED"


def test_a_lock_on_the_way_back_to_stow_does_not_leave_the_way() -> None:
    bench, free = tracking(), tracking()
    for each in (bench, free):
        assert each.order("STOW") == DONE
        each.run(2)
    assert bench.order("LOCK") == DONE
    while free.state == "STOWING":
        free.run(0.5)
        bench.run(0.5)
        assert np.abs(np.subtract(bench.made, free.made)).max() < 50
    assert tuple(bench.made) == STOW


@pytest.mark.parametrize("lost", ["the sun", "the way", "DEFOCUS"])
def test_a_locked_mirror_that_loses_the_way_back_goes_straight_to_stow(lost: str) -> None:
    bench = tracking()
    assert bench.order("STOW") == DONE
    bench.run(2)
    assert bench.order("LOCK") == DONE
    if lost == "the sun":
        bench.sends_sun = False
    elif lost == "DEFOCUS":
        assert bench.order("DEFOCUS") == DONE
    else:
        motion = bench.controller.motion
        motion._path = [(0.0, 0.0, -1e5)] * len(motion._path)
    bench.run(200)
    assert tuple(bench.made) == STOW
    assert bench.state == "LOCKED"


def test_a_lock_stops_a_mirror_that_has_turned_away() -> None:
    bench = tracking()
    assert bench.order("DEFOCUS") == DONE
    bench.run(20)
    assert bench.order("LOCK") == DONE
    bench.run(2)
    held = list(bench.made)
    bench.run(100)
    assert bench.made == held


def test_drives_that_are_switched_off_at_the_mirror_make_no_step() -> None:
    bench = tracking()
    bench.node.on_fault(controller.SWITCH, bench.now, True)
    bench.check()
    held = list(bench.made)
    assert bench.state == "LOCKED"
    assert "LOCAL_SWITCH" in flags(bench)
    assert bench.controller.fault == controller.NO_FAULT
    orders = ("TRACK", "REFOCUS", "APPROACH", "IDLE", "UNLOCK", "CLEAR_FAULT", "DIAGNOSE")
    for name in (*orders, "DEFOCUS", "STOW"):
        assert bench.order(name) == REFUSED_SWITCH
    assert bench.order("GOTO", STOW[0], STOW[1]) == REFUSED_SWITCH
    assert bench.order("AIM", *AIM) == DONE
    assert bench.order("LOCK") == DONE
    bench.run(30)
    bench.sends_sun = bench.sends_time = False
    bench.run(400)
    assert bench.made == held
    assert bench.state == "LOCKED"
    # Whoever switches them on again has the time of a silence to step back.
    bench.node.fault_gone(controller.SWITCH)
    bench.run(5)
    assert bench.made == held
    assert "LOCAL_SWITCH" not in flags(bench)
    bench.run(10)
    assert bench.miss(AIM) > OFF, "without a cluster it leaves"
    bench.run(300)
    assert tuple(bench.made) == STOW
    assert bench.state == "LOCKED"
    bench.sends_sun = bench.sends_time = True
    bench.run(2)
    assert bench.order("UNLOCK") == DONE
    assert bench.state == "STOWED"


def test_drives_that_are_switched_off_at_stow_obey_by_standing_there() -> None:
    bench = Bench()
    bench.run(1.5)
    bench.node.on_fault(controller.SWITCH, bench.now, True)
    for name in ("DEFOCUS", "STOW"):
        assert bench.order(name) == DONE
    assert bench.order("APPROACH") == REFUSED_SWITCH
    bench.run(60)
    assert tuple(bench.made) == STOW
    assert {"AT_STOW", "LOCAL_SWITCH"} <= flags(bench)
    assert "FAULT_PRESENT" not in flags(bench)


def test_drives_that_are_switched_off_in_motion_keep_the_counts() -> None:
    bench = standing_by()
    assert bench.order("GOTO", STOW[0], STOW[1]) == DONE
    bench.run(1.0)
    bench.motors.undone = (3, -2)
    bench.node.on_fault(controller.SWITCH, bench.now, True)
    bench.check()  # the counts are those of the motors
    held = list(bench.made)
    bench.run(20)
    assert bench.made == held


def test_a_board_that_starts_with_its_drives_switched_off_stands_still() -> None:
    for known in (True, False):
        bench = tracking()
        bench.start(bench.flash)
        if not known:
            bench.controller.motion.declare(*bench.made, False)
        bench.node.on_fault(controller.SWITCH, bench.now, True)
        held = list(bench.made)
        bench.run(30)
        assert bench.made == held
        assert bench.state == "LOCKED"
        bench.node.fault_gone(controller.SWITCH)
        assert bench.order("DEFOCUS") == DONE
        bench.run(10)
        assert bench.made != held, "it turns away as soon as it can"


def test_while_the_cause_of_a_fault_is_present_silence_moves_nothing_at_once() -> None:
    # The supply falls, and with it the cluster: steps would spoil the record of the counts.
    for locked in (False, True):
        bench = tracking()
        if locked:
            assert bench.order("LOCK") == DONE
            bench.run(2)
        bench.sends_sun = bench.sends_time = False
        bench.run(5)
        bench.node.on_supply_failing(bench.now)
        held = list(bench.made)
        bench.run(20)
        assert bench.made == held
        bench.run(280)  # it was a dip
        assert tuple(bench.made) == STOW


def test_a_fault_stays_until_it_is_cleared() -> None:
    bench = tracking()
    bench.do(bench.controller.on_fault(controller.TEMPERATURE, bench.now, False))
    assert bench.state == "FAULT"
    bench.run(20)
    assert bench.miss(AIM) > OFF
    assert bench.order("CLEAR_FAULT") == REFUSED_STATE
    assert bench.order("TRACK") == REFUSED_STATE
    bench.run(400)  # not following the sun, so it stows by itself, the fault staying
    assert tuple(bench.made) == STOW
    assert bench.state == "FAULT"
    bench.start(bench.flash)
    assert bench.state == "FAULT"
    assert bench.controller.fault == controller.LATCHED
    bench.run(2)
    assert bench.order("CLEAR_FAULT") == DONE
    assert bench.state == "STOWED"
    assert bench.controller.fault == controller.NO_FAULT


def test_an_emergency_stop_takes_steps_back() -> None:
    bench = tracking()
    bench.order("STOW")
    bench.run(6)
    assert not bench.controller.motion.still()
    bench.motors.undone = 37, -11
    bench.node.on_fault(controller.LIMIT_SWITCH, bench.now, True)
    bench.check()
    assert bench.motors.stops == 1
    assert bench.state == "FAULT"
    held = list(bench.made)
    bench.run(10)
    assert bench.made == held
    bench.controller.fault_gone(controller.LIMIT_SWITCH)
    assert bench.order("CLEAR_FAULT") == DONE
    assert bench.order("STOW") == DONE
    bench.run(300, until="STOWED")
    assert tuple(bench.made) == STOW


def test_moves_by_hand() -> None:
    bench = standing_by()
    bench.run(5)
    start = list(bench.made)
    assert bench.order("JOG", 1, -500) == DONE
    bench.run(3)
    assert bench.made[1] == bench.controller.motion.goal(1)
    assert abs(bench.made[1] - start[1] + 500) < 40
    assert bench.order("GOTO", 1_000_000, 200_000) == DONE
    bench.run(20)
    assert bench.made == [1_000_000, 200_000]
    for values in ((2, 5), (0, 2_000_000), (1, -(2**31))):
        assert bench.order("JOG", *values) == BAD_VALUE
    assert bench.order("GOTO", 1_000_000, 600_000) == BAD_VALUE
    bench.run(2)
    assert bench.made == [1_000_000, 200_000]
    bench.sends_sun = bench.sends_time = False
    bench.run(25, until="DEFOCUSED")  # left alone it does not stay
    assert bench.state == "DEFOCUSED"


def test_the_aim_moves_and_can_be_locked() -> None:
    bench = tracking()
    other = (3.0, 0.0, 52.0)
    assert bench.order("LOCK_AIM", 1) == DONE
    assert bench.order("AIM", *other) == REFUSED_STATE
    assert bench.order("LOCK_AIM", 0) == DONE
    for bad in ((1e6, 0.0, 0.0), (40.0, 80.0, -60.0)):
        assert bench.order("AIM", *bad) == BAD_VALUE
    assert bench.order("LOCK_AIM", 2) == bench.order("ROUGH", 7) == BAD_VALUE
    assert bench.controller.motion.aim == AIM
    assert bench.order("AIM", *other) == DONE
    bench.run(10)
    assert bench.miss(other) < 0.01
    bench.run(1)
    assert struct.unpack("<fff", bench.journal.aim or b"") == other
    assert bench.order("ROUGH", 1) == DONE
    misses = []
    for _ in range(30):
        bench.run(1)
        misses.append(bench.miss(other))
    # Up to sixteen steps of 3.3 µrad, doubled, at 103 m.
    assert 4e-3 < max(misses) < 20e-3
    assert bench.order("ROUGH", 0) == DONE


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_none_do_nothing(bad: float) -> None:
    bench = tracking()
    payload = struct.pack("<IIfff", TOKEN, bench.gps_ms() // 1000 + 5, bad, 0.0, 1.0)
    frame = wire.Frame(ADDRESS, 0, (bench.sender.count + 1) & 0xFFFF, 0x40, payload)
    bench.deliver(wire.encode(frame))
    assert bench.answers[-1][1][-1] == BAD_VALUE
    # And past the gate, too.
    values = (TOKEN, 0, bad, 0.0, 1.0)
    bench.do(bench.controller.on_message(0x40, 9, values, payload, DONE, bench.now, True))
    assert bench.answers[-1][1][-1] == BAD_VALUE
    assert bench.controller.motion.aim == AIM


def test_a_search_goes_round_the_aim_and_ends() -> None:
    bench = tracking()
    assert bench.order("SEARCH", math.pi, -1.0) == BAD_VALUE
    assert bench.order("SEARCH", 5e-3, 0.02) == DONE
    misses = []
    while bench.state == "SEARCHING":
        assert bench.order("AIM", 1.0, 1.0, 50.0) in (BUSY, REFUSED_STATE)
        bench.run(1, until="IDLE")
        misses.append(bench.miss(AIM))
    slant = float(np.linalg.norm(np.subtract(AIM, bench.machine.position)))
    assert max(misses) == pytest.approx(0.02 * slant, rel=0.3)
    assert len(misses) > 60
    assert bench.state == "IDLE"
    bench.run(10)
    assert bench.miss(STANDBY) < 0.02


# Movement.


def watch(bench: Bench, stuck: tuple[float, float] = (1.0, 1.0)) -> None:
    """Let time pass while the accelerometer sees the axes move by so much of what they should."""
    home = list(bench.made)
    while bench.controller.motion.kind == 9:
        true = [h + f * (m - h) for h, f, m in zip(home, stuck, bench.made, strict=True)]
        angles = bench.machine.drives.angles(np.array(true))
        # The mirror's frame: gravity's direction along its normal and its secondary axis.
        normal, _ = bench.machine.armature.pose(angles)
        bench.tilt = float(np.arcsin(normal[2])), 0.0
        bench.tick()


def test_idle_stops_a_motion_of_a_mirror_that_has_not_reached_standby() -> None:
    bench = Bench()
    bench.run(1.5)
    assert bench.order("IDLE") == DONE
    assert bench.order("GOTO", STOW[0] - 100_000, STOW[1] - 100_000) == DONE
    bench.run(3)
    assert bench.order("IDLE") == DONE
    bench.run(2)
    held = list(bench.made)
    assert held != list(STOW)
    assert bench.controller.motion.still()
    bench.run(20)
    assert bench.made == held
    assert bench.state == "IDLE"


def test_a_diagnosis_sees_the_elevation_move() -> None:
    bench = standing_by()
    bench.run(3)
    assert bench.order("DIAGNOSE") == DONE
    assert bench.order("JOG", 0, 5) == BUSY
    watch(bench)
    result, moved_1, moved_2, tilt, _ = bench.controller.motion.diagnosis
    assert result == 2  # the azimuth turns about the plumb line: no accelerometer sees it
    assert moved_1 > 5000
    assert moved_2 > 5000
    assert tilt == pytest.approx(0.02, rel=0.05)
    bench.answers.clear()
    bench.send("QUERY_DIAGNOSIS")
    ((number, values),) = bench.answers
    assert (number, values[:3]) == (0x08, bench.controller.motion.diagnosis[:3])
    assert values[3:] == pytest.approx(bench.controller.motion.diagnosis[3:])
    assert bench.state == "IDLE"


def test_a_diagnosis_finds_a_stuck_drive() -> None:
    bench = standing_by()
    bench.run(3)
    assert bench.order("DIAGNOSE") == DONE
    watch(bench, stuck=(1.0, 0.1))
    assert bench.state == "FAULT"
    assert bench.controller.fault == controller.STUCK_SECONDARY


def test_a_diagnosis_without_a_sensor_says_so() -> None:
    bench = standing_by()
    bench.run(3)
    bench.order("DIAGNOSE")
    bench.run(10)
    assert bench.controller.motion.diagnosis == (16, 0, 0, 0.0, 0.0)
    assert bench.state == "IDLE"


# What is stored.


def empty() -> Bench:
    """A bench whose journal is empty but for the address."""
    full = items_of_heliostat(heliostat())
    flash = Flash()
    journal = controller_journal(flash)
    journal.store({"address": full["address"]})
    return Bench(flash)


def controller_journal(flash: Flash):  # type: ignore[no-untyped-def]
    from heliotrope.lcu.journal import Journal

    journal = Journal(flash)
    journal.load()
    return journal


def settings(bench: Bench) -> list[tuple[str, tuple[object, ...]]]:
    """The messages that make a controller complete."""
    items = items_of_heliostat(bench.machine)
    codes = {row[0]: row[1] for row in wire_items()}
    values = {name: struct.unpack("<" + codes[name], data) for name, data in items.items()}
    return [
        ("SET_ARMATURE", values["armature"]),
        ("SET_BIAS", values["biases"]),
        ("SET_DRIVES", (0, *values["drive_primary"])),
        ("SET_DRIVES", (1, *values["drive_secondary"])),
        ("SET_LIMITS", (0, *values["limits_primary"])),
        ("SET_LIMITS", (1, *values["limits_secondary"])),
        ("SET_DEFOCUS", values["defocus"]),
        ("SET_POSITION", values["location"]),
        ("ZERO", STOW),
        ("SET_STOW", STOW),
    ]


def wire_items():  # type: ignore[no-untyped-def]
    from heliotrope.lcu.journal import ITEMS

    return ITEMS


def test_a_new_controller_is_told_everything_and_then_works() -> None:
    bench = empty()
    bench.run(2)
    assert bench.state == "UNCONFIGURED"
    assert bench.order("APPROACH") == bench.order("IDLE") == REFUSED_STATE
    for name, values in settings(bench):
        assert bench.state == "UNCONFIGURED"
        assert bench.order(name, *values) == DONE
    assert bench.state == "LOCKED"  # somebody stands beside it
    assert bench.order("UNLOCK") == DONE
    assert bench.state == "STOWED"
    assert bench.order("STANDBY", *STANDBY) == DONE
    bench.to_tracking()
    assert bench.miss(AIM) < 0.01
    again = controller_journal(bench.flash)
    assert again.numbers("standby") == STANDBY
    assert again.checksum("armature") == bench.controller.config.armature_crc


def test_a_controller_that_lost_its_settings_is_told_them_again_and_its_fault_cleared() -> None:
    flash = Flash()
    flash.data[: 2 * flash.block_size] = bytes(2 * flash.block_size)
    bench = Bench(flash)
    bench.run(2)
    assert bench.controller.fault == controller.JOURNAL
    bench.edition += 1
    head = TOKEN, bench.gps_ms() // 1000 + 5, bench.edition
    bench.send("SET_ADDRESS", *head, 4711, ADDRESS, to=wire.BROADCAST)
    for name, values in settings(bench):
        assert bench.order(name, *values) == DONE
    assert bench.order("UNLOCK") == DONE
    assert bench.state == "FAULT"
    assert bench.order("CLEAR_FAULT") == DONE
    assert bench.state == "STOWED"
    assert bench.controller.fault == controller.NO_FAULT


def test_settings_change_in_safe_states_alone() -> None:
    bench = tracking()
    for name, values in settings(bench):
        before = dict(bench.journal.items)
        assert bench.order(name, *values) == REFUSED_STATE
        assert bench.journal.items == before
    bench.order("IDLE")
    bench.run(5)
    for name, values in settings(bench):
        # At standby the mirror goes with the sun: nothing that moves it may change.
        harmless = name in ("SET_DEFOCUS", "SET_POSITION")
        assert bench.order(name, *values) == (DONE if harmless else REFUSED_STATE)
    bench.order("DEFOCUS")
    bench.run(20)
    assert bench.order("SET_ARMATURE", *settings(bench)[0][1]) == REFUSED_STATE


@pytest.mark.parametrize("state", ["LOCKED", "FAULT"])
def test_settings_of_the_pose_and_the_machine_change_at_rest_alone(state: str) -> None:
    bench = tracking()
    if state == "LOCKED":
        bench.order("STOW")
        bench.run(6)
        assert bench.order("LOCK") == DONE  # it goes on to stow
    else:
        bench.do(bench.controller.on_fault(controller.SUPPLY, bench.now, False))
        bench.run(1)  # it turns away, and then goes with the sun
    for name, values in settings(bench):
        harmless = name in ("SET_DEFOCUS", "SET_POSITION")
        assert bench.order(name, *values) == (DONE if harmless else REFUSED_STATE)
    bench.run(25)
    assert bench.order("SET_BIAS", 0.01, 0.02) == REFUSED_STATE
    bench.run(300)  # to stow
    held = list(bench.made)
    for name, values in settings(bench):
        if name != "ZERO":
            assert bench.order(name, *values) == DONE
    assert bench.order("SET_BIAS", 0.01, 0.02) == DONE
    bench.run(20)
    assert bench.made == held  # taken, and nothing moves by it
    assert bench.state == state


def test_new_angles_of_the_defocus_do_not_move_a_defocused_mirror() -> None:
    bench = tracking()
    bench.order("DEFOCUS")
    bench.run(20)
    before = list(bench.made)
    assert bench.order("SET_DEFOCUS", 0.3, 0.3) == DONE
    bench.run(5)
    assert bench.state == "DEFOCUSED"
    assert np.abs(np.subtract(bench.made, before)).max() < 300  # it goes with the sun


def test_a_better_armature_makes_a_better_beam() -> None:
    bench = standing_by()
    table = bench.machine.armature.table.copy()
    rough = table.copy()
    rough[15:18] = rough[15:18] + [0.0, 0.0, 3e-3]
    rough[15:18] /= np.linalg.norm(rough[15:18])
    for numbers, least, most in ((rough, 0.3, 1.0), (table, 0.0, 0.01)):
        assert bench.order("LOCK") == DONE
        bench.run(2)
        assert bench.order("SET_ARMATURE", *numbers) == DONE
        assert bench.order("UNLOCK") == bench.order("IDLE") == DONE
        bench.run(5)
        assert least <= bench.miss(STANDBY) < most
    assert bench.controller.status()[7] == crc32(struct.pack("<18d", *table))


def test_a_message_that_stores_needs_key_and_edition() -> None:
    bench = standing_by()
    table = tuple(bench.machine.armature.table)
    life = bench.gps_ms() // 1000 + 5
    data = bench.sender.frame(ADDRESS, "SET_ARMATURE", TOKEN, life, 1, *table, key=b"x" * 32)
    bench.deliver(data)
    assert bench.answers[-1][1][-1] == REFUSED_KEY
    bench.order("LOCK")
    bench.run(2)
    assert bench.order("SET_ARMATURE", *table) == DONE
    data = bench.sender.frame(ADDRESS, "SET_ARMATURE", TOKEN, life, bench.edition, *table, key=KEY)
    bench.deliver(data)
    assert bench.answers[-1][1][-1] == DUPLICATE


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("SET_ARMATURE", (0.0,) * 18),
        ("SET_ARMATURE", (*(0.0, 0.0, 1.0) * 5, 1.0, 0.0, 0.0)),
        ("SET_BIAS", (9.0, 0.0)),
        ("SET_DEFOCUS", (0.0, 0.001)),
        ("SET_DEFOCUS", (3.0, 0.0)),
        ("SET_POSITION", (1e7, 0.0, 0.0)),
        ("SET_DRIVES", (0, 0, *(0.0,) * 10)),
        ("SET_DRIVES", (2, 0, *(1e-6,) * 10)),
        ("SET_DRIVES", (0, 9, *(1e-6,) * 10)),
        ("SET_LIMITS", (0, 5, 5, 1, 1, 0)),
        ("SET_LIMITS", (0, 0, 2**20, 10_001, 10, 0)),
        ("SET_LIMITS", (1, 0, 100, 10, 10, 0)),
        ("SET_LIMITS", (0, -(2**31), 2**31 - 1, 10, 10, 0)),
        ("SET_STOW", (0, 2**30)),
        ("ZERO", (2**31 - 1, 0)),
        ("ZERO", (0, 2**30)),
        ("SET_ADDRESS", (4711, 0)),
        ("SET_ADDRESS", (5, 3)),
    ],
)
def test_settings_out_of_range_change_nothing(name: str, values: tuple[object, ...]) -> None:
    bench = brought_to("LOCKED")
    before, config = dict(bench.journal.items), bench.controller.config
    kept = config.pointing, list(config.drives), list(config.axes), config.stow, config.defocus
    assert bench.order(name, *values) == BAD_VALUE
    assert bench.journal.items == before
    assert kept == (
        config.pointing,
        list(config.drives),
        list(config.axes),
        config.stow,
        config.defocus,
    )


def test_zero_declares_the_counts_and_asks_for_the_safe_way_again() -> None:
    bench = standing_by()
    assert bench.order("LOCK") == DONE
    bench.run(2)
    assert bench.order("ZERO", 123, -45) == DONE
    assert bench.made == [123, -45]
    assert (bench.journal.primary, bench.journal.secondary) == (123, -45)
    assert bench.order("UNLOCK") == DONE
    assert bench.order("TRACK") == REFUSED_STATE


# Resets.


@pytest.mark.parametrize("instant_ms", [50, 300, 2000, 30_000, 90_000])
def test_after_a_reset_it_defocuses_stows_and_does_not_track(instant_ms: int) -> None:
    bench = tracking()
    if instant_ms > 2000:
        bench.order("STOW")
    bench.run(instant_ms / 1000)
    bench.start(bench.flash)
    assert np.abs(bench.slip).max() <= bench.journal.stride
    assert ("COUNTS_DOUBTFUL" in flags(bench)) or bench.slip == [0, 0]
    # One that was on its straight way to stow goes on.
    assert bench.state == ("STOWING" if instant_ms == 90_000 else "DEFOCUSED")
    assert bench.controller.motion.aim == AIM
    begin = bench.true_ms
    while bench.miss(AIM) < OFF:
        bench.run(0.5)
    assert bench.true_ms - begin < 30_000
    bench.run(2)
    assert bench.order("TRACK") == bench.order("REFOCUS") == REFUSED_STATE
    bench.run(300, until="STOWED")  # although the sun goes on
    assert bench.true_ms - begin < 300_000


@pytest.mark.parametrize("lost", ["the way", "the sun"])
def test_a_mirror_that_turns_away_stands_still_for_no_idle(lost: str) -> None:
    """Simulated run 3301911: an order from before a reset stopped the beam in a volume."""
    bench = tracking()
    if lost == "the way":
        bench.start(bench.flash)
        bench.run(1.5)  # the sun is fresh again
    else:
        bench.sends_sun = False
        bench.run(7, until="DEFOCUSED")
    assert bench.state == "DEFOCUSED"
    assert bench.order("IDLE") == REFUSED_STATE
    assert not bench.controller.motion.still()
    bench.run(10)
    assert bench.state == "DEFOCUSED"
    assert bench.miss(AIM) > OFF


def test_a_defocused_mirror_that_knows_the_way_goes_to_standby() -> None:
    bench = tracking()
    assert bench.order("DEFOCUS") == DONE
    bench.run(1)
    assert bench.order("IDLE") == DONE
    bench.run(20)
    assert bench.state == "IDLE"
    assert bench.miss(STANDBY) < OFF


def forgets(bench: Bench) -> None:
    """Make the counts unreadable, and reset the board."""
    bench.run(1)
    where = bench.pose()
    bench.flash.data[2 * bench.flash.block_size :] = b"\xff" * (4 * bench.flash.block_size)
    bench.start(bench.flash)
    assert bench.pose()[0] == pytest.approx(where[0])


#: Steps of the defocus angles, 0.1 and 0.05 rad, of perfect drives: 0.1 % off.
AWAY = [30558, 15279]


def test_unknown_counts_are_a_fault_and_the_beam_goes_all_the_same() -> None:
    bench = tracking()
    forgets(bench)
    start, begin = list(bench.made), bench.true_ms
    assert bench.state == "FAULT"
    assert {"COUNTS_UNKNOWN", "COUNTS_DOUBTFUL"} <= flags(bench)
    while bench.miss(AIM) < OFF:
        bench.run(0.5)
    assert bench.true_ms - begin < 30_000
    bench.run(20)
    assert np.abs(np.subtract(bench.made, start)) == pytest.approx(AWAY, rel=2e-3)
    held = list(bench.made)
    for name in ("DEFOCUS", "STOW", "DEFOCUS"):  # it does not add up, nor over a reset
        assert bench.order(name) == DONE
        bench.run(12)
        assert bench.made == held
        bench.start(bench.flash)
        bench.run(2)
        held = list(bench.made)
        assert bench.state == "FAULT"
        assert "COUNTS_UNKNOWN" in flags(bench)
        if name == "DEFOCUS":
            bench.order("LOCK")
            bench.run(1)
            break
    assert bench.order("CLEAR_FAULT") == REFUSED_STATE
    assert bench.order("ZERO", *STOW) == DONE
    assert "COUNTS_UNKNOWN" not in flags(bench)
    assert bench.order("UNLOCK") == DONE
    assert bench.order("CLEAR_FAULT") == DONE
    assert bench.state == "STOWED"


@pytest.mark.parametrize("name", ["DEFOCUS", "STOW"])
def test_an_order_turns_a_mirror_with_unknown_counts_away_once(name: str) -> None:
    bench = tracking()
    forgets(bench)
    bench.run(30)
    bench.start(bench.flash)  # it has turned away before: a reset alone moves nothing
    bench.run(2)
    start = list(bench.made)
    bench.run(20)
    assert bench.made == start
    for _ in range(3):
        assert bench.order(name) == DONE
        bench.run(15)
    assert np.abs(np.subtract(bench.made, start)) == pytest.approx(AWAY, rel=2e-3)
    assert bench.state == "FAULT"


def test_silence_turns_a_mirror_with_unknown_counts_away() -> None:
    bench = tracking()
    assert bench.order("LOCK") == DONE
    bench.run(2)
    bench.journal.doubts = 7  # too many cuts without a warning
    forgets_at = list(bench.made)
    bench.journal.at_rest(bench.made[0] + 1, bench.made[1])
    bench.start(bench.flash)
    assert bench.state == "LOCKED"
    assert "COUNTS_UNKNOWN" in flags(bench)
    bench.sends_sun = bench.sends_time = False
    bench.run(25)
    assert bench.miss(AIM) > OFF
    assert np.abs(np.subtract(bench.made, forgets_at)) == pytest.approx(AWAY, rel=2e-3)


def test_a_blind_turn_that_a_limit_switch_ends_goes_the_other_way_when_ordered() -> None:
    bench = tracking()
    forgets(bench)
    start = list(bench.made)
    bench.run(3)
    bench.node.on_fault(controller.LIMIT_SWITCH, bench.now, True)
    turned = np.subtract(bench.made, start)
    assert np.abs(turned).max() > 1000
    bench.run(1)
    stopped = list(bench.made)
    for _ in range(3):
        assert bench.order("DEFOCUS") == DONE
        bench.run(20)
    back = np.subtract(bench.made, stopped)
    assert np.abs(back) == pytest.approx(np.multiply(AWAY, 2), rel=2e-3)
    assert (np.sign(back) == -np.sign(turned)).all()
    # At the end of a turn, a stop of another cause does not send it back to the receiver.
    again = tracking()
    forgets(again)
    again.run(30)
    again.node.on_fault(controller.TEMPERATURE, again.now, True)
    held = list(again.made)
    again.order("DEFOCUS")
    again.run(20)
    assert again.made == held


def test_a_mirror_at_stow_with_unknown_counts_stays_until_it_is_ordered() -> None:
    bench = Bench()
    bench.run(2)
    bench.journal.doubts = 7
    bench.journal.at_rest(STOW[0] + 1, STOW[1])
    bench.start(bench.flash)
    assert bench.state == "FAULT"
    start = list(bench.made)
    bench.run(60)
    assert bench.made == start
    assert bench.order("DEFOCUS") == DONE
    bench.run(20)
    assert np.abs(np.subtract(bench.made, start)) == pytest.approx(AWAY, rel=2e-3)


@pytest.mark.parametrize("warned", [True, False])
@pytest.mark.parametrize("state", ["TRACKING", "DEFOCUSED", "LOCKED", "FAULT"])
@pytest.mark.parametrize("lives_s", [0.4, 3.0, 9.0, 25.0])
def test_cuts_again_and_again_turn_a_mirror_away_once(
    warned: bool, state: str, lives_s: float
) -> None:
    """25 cuts turned the beam by 25 defocuses, 13 m to 84 m, through volumes that nobody proved."""
    bench, once = tracking(), tracking()
    for each in (bench, once):
        if state == "LOCKED":
            assert each.order("LOCK") == DONE
        elif state == "DEFOCUSED":
            assert each.order("DEFOCUS") == DONE
            each.run(0.3)
        elif state == "FAULT":
            each.node.on_fault(controller.TEMPERATURE, each.now, False)
            each.node.fault_gone(controller.TEMPERATURE)
        each.sends_sun = each.sends_time = False
    begin = list(once.made)
    once.run(22)
    turned = np.abs(np.subtract(once.made, begin))
    assert turned.min() > 5000
    for _ in range(12):
        bench.run(lives_s)
        if warned:
            bench.node.on_supply_failing(bench.now)
        bench.start(bench.flash)
        assert bench.controller.motion.known or not warned
    # What a mirror that follows the sun for the rest of its lease does is not asked here.
    gone = np.abs(np.subtract(bench.made, begin))
    assert (gone < turned + 600).all(), (gone, turned)
    if lives_s > 8.0 and state != "TRACKING":
        assert (gone > turned - 600).all()


def test_a_turn_that_a_cut_has_interrupted_goes_on_to_the_same_place() -> None:
    """The sense of a turn depends on the aim: another one could lead back onto the receiver."""
    bench, whole = tracking(), tracking()
    for each in (bench, whole):
        assert each.order("DEFOCUS") == DONE
    goals = [axis.goal for axis in bench.controller.motion.stepper.axes]  # type: ignore[union-attr]
    bench.run(0.8)
    for _ in range(4):
        bench.start(bench.flash)
        assert bench.controller.motion.aim == AIM
        axes = bench.controller.motion.stepper.axes  # type: ignore[union-attr]
        assert [axis.goal for axis in axes] == goals
        bench.run(0.3)
    bench.run(15)
    assert bench.made == goals


def test_another_motion_ends_what_a_defocus_has_earned() -> None:
    """DEFOCUS, TRACK, DEFOCUS: each turns anew, and so does a reset after that."""
    bench = tracking()
    for _ in range(2):
        assert bench.order("DEFOCUS") == DONE
        bench.run(15)
        assert bench.miss(AIM) > OFF
        assert bench.order("TRACK") == DONE
        bench.run(15)
        assert bench.miss(AIM) < 0.1
    bench.start(bench.flash)
    bench.run(15)
    assert bench.miss(AIM) > OFF
    held = tracking()
    assert held.order("DEFOCUS") == DONE
    held.run(15)
    assert held.order("LOCK") == DONE
    held.run(600)  # its beam goes on with the sun, perhaps back to the receiver
    before = list(held.made)
    assert held.order("DEFOCUS") == DONE
    held.run(15)
    assert np.abs(np.subtract(held.made, before)).max() > 5000


def test_a_board_that_is_cut_on_its_way_to_stow_goes_on_to_it() -> None:
    bench = tracking()
    bench.sends_sun = False
    bench.run(60, until="STOWING")
    far = list(bench.made)
    for _ in range(60):
        bench.run(2)
        gap = np.abs(np.subtract(bench.made, STOW))
        assert (gap <= np.abs(np.subtract(far, STOW)) + 1).all()
        far = list(bench.made)
        if tuple(far) == STOW:
            break
        assert bench.node.on_supply_failing(bench.now)
        bench.start(bench.flash)
        assert bench.state == "FAULT"
    assert tuple(far) == STOW


@pytest.mark.parametrize("state", ["STOWED", "LOCKED", "UNCONFIGURED"])
def test_the_counts_of_another_mirror_are_unknown(state: str) -> None:
    """A spare board said STOWED at a mirror whose beam stood on the receiver."""
    bench = Bench()
    bench.run(1.5)
    if state == "LOCKED":
        assert bench.order("LOCK") == DONE
    elif state == "UNCONFIGURED":
        items = items_of_heliostat(bench.machine)
        del items["armature"]
        journal = controller_journal(bench.flash)
        bench.flash.data[: 2 * bench.flash.block_size] = b"\xff" * (2 * bench.flash.block_size)
        journal.load()
        journal.store(items)
        bench.start(bench.flash)
        bench.run(1.5)
    numbers = np.array(settings(bench)[0][1])
    if state != "UNCONFIGURED":
        # A calibration moves an armature by centimetres, and is no other mirror.
        numbers[3:6] += [0.1, -0.2, 0.1]
        assert bench.order("SET_ARMATURE", *numbers) == DONE
        assert "COUNTS_UNKNOWN" not in flags(bench)
    numbers[[3, 4]] += [0.6, 2.0]
    assert bench.order("SET_ARMATURE", *numbers) == DONE
    for _ in range(2):
        assert "COUNTS_UNKNOWN" in flags(bench)
        assert "AT_STOW" not in flags(bench)
        assert bench.state in ("FAULT", "LOCKED")
        bench.start(bench.flash)
        bench.run(1.5)
    assert bench.order("CLEAR_FAULT") == REFUSED_STATE
    if bench.state == "FAULT":
        assert bench.order("LOCK") == DONE
    bench.run(20)
    assert bench.order("ZERO", *STOW) == DONE
    assert bench.order("UNLOCK") == DONE
    assert bench.order("CLEAR_FAULT") == DONE
    assert bench.state == "STOWED"


def test_a_controller_that_boots_again_and_again_stays_in_fault() -> None:
    bench = tracking()
    for _ in range(6):
        bench.start(bench.flash)
    assert bench.state == "FAULT"
    assert bench.controller.fault == controller.BOOTS


# Questions.


def test_questions_are_answered() -> None:
    bench = tracking()
    for name in ("QUERY_STEPS", "QUERY_STATUS", "QUERY_POSITION", "QUERY_DIAGNOSIS"):
        bench.answers.clear()
        bench.send(name)
        ((number, values),) = bench.answers
        assert messages.name_of(number) == name.replace("QUERY_", "").replace("STEPS", "STEPS")
        if name == "QUERY_STEPS":
            assert values[:2] == tuple(bench.made)
        elif name == "QUERY_STATUS":
            assert values[0] == bench.controller.state
            assert values[3] == pytest.approx(bench.true_ms / 1000, abs=1.5)
            assert values[4] <= 1050  # type: ignore[operator]
        elif name == "QUERY_DIAGNOSIS":
            assert not any(values), "there was none"
    bench.answers.clear()
    bench.send("DISCOVER", 5000, 6000, to=0xFFFF)
    assert bench.answers == []
    bench.send("DISCOVER", 4000, 5000, to=0xFFFF)
    bench.run(1)
    assert bench.answers == [(0x0C, (4711, 0, ADDRESS))]
    out = bench.controller.on_message(0x09, 1, (5,), b"", DONE, bench.now, True)
    assert (controller.RECALL, 5) in out
    out = bench.controller.on_message(0x09, 1, (2,), b"", DONE, bench.now, True)
    assert not any(action[0] == controller.RECALL for action in out)  # never the key's number
    bench.send("DEFOCUS", to=0xFFFF)
    assert len(bench.answers) == 1  # a broadcast is not acknowledged


def test_the_watchdog_is_fed_by_whole_ticks() -> None:
    bench = tracking()
    bench.tick()
    assert bench.fed
    bench.controller.motion.tick = None  # type: ignore[assignment, method-assign]
    bench.fed = False
    with pytest.raises(TypeError):
        bench.tick()
    assert not bench.fed


@pytest.mark.parametrize("broken", ["the lapses", "the lease"])
@pytest.mark.parametrize("state", ["TRACKING", "SEARCHING", "APPROACHING", "IDLE", "STOWING"])
def test_the_watchdog_resets_a_board_that_follows_a_sun_it_no_longer_hears(
    state: str, broken: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = brought_to(state)
    own = bench.controller
    monkeypatch.setattr(bench, "check", lambda: None)
    if broken == "the lapses":
        monkeypatch.setattr(own, "_lapses", lambda *values: None)
    else:
        monkeypatch.setattr(own.sun, "look", lambda *values: True)
        monkeypatch.setattr(own.sun, "fresh", lambda: True)
    bench.sends_sun = False
    bench.run(5)
    assert bench.fed
    kind = own.motion.kind
    bench.run(3)
    assert (bench.state, own.motion.kind) == (state, kind)
    assert not bench.fed
    bench.start(bench.flash)  # a board's watchdog waits 2 s
    assert bench.state == ("DEFOCUSED" if tuple(bench.made) != STOW else "STOWED")


@pytest.mark.parametrize("state", STATES_TO_TRY)
def test_a_board_that_left_in_time_is_not_reset(state: str) -> None:
    bench = brought_to(state)
    bench.sends_sun = bench.sends_time = False
    for _ in range(60):
        bench.run(1)
        assert bench.fed
