"""Motion of the two axes: the goals between the poses that are computed."""

from itertools import pairwise

import numpy as np
import pytest

from heliotrope.geometry import angle_between
from heliotrope.lcu.journal import Journal
from heliotrope.lcu.messages import DONE
from heliotrope.lcu.motion import PIECE, RENEW_MS
from support.lcu_machines import Bench, Flash, items_of_heliostat, standing_by, tracking

#: A step of either axis, rad.
STEP = 3.3e-6


def worst_goal(bench: Bench, seconds: float) -> float:
    """The largest error of the normal that the goals stand for, rad, while an aim is followed."""
    motion, worst = bench.controller.motion, 0.0
    assert motion.aim is not None
    body, drives = bench.machine.armature, bench.machine.drives
    for _ in range(round(20 * seconds)):
        bench.run(0.05)
        exact = motion.pose(motion.aim, 0)
        assert exact is not None
        goals = drives.angles(np.array([motion.goal(0), motion.goal(1)], dtype=float))
        worst = max(worst, float(angle_between(body.pose(goals)[0], body.pose(exact.angles)[0])))
    return worst


def beside_the_keyhole(bench: Bench) -> tuple[float, float, float]:
    """An aim for which the normal stands 3 mrad beside the primary axis."""
    pointing = bench.controller.config.pointing
    assert pointing is not None
    axis = np.array(pointing.axis_1)
    east = np.cross(axis, (0.0, 1.0, 0.0))
    east /= np.linalg.norm(east)
    turn = 3.2
    normal = axis + 0.003 * (np.cos(turn) * east + np.sin(turn) * np.cross(axis, east))
    normal /= np.linalg.norm(normal)
    sun = bench.sun(bench.gps_ms() / 1000)
    x, y, z = pointing.origin + 100.0 * (2.0 * (normal @ sun) * normal - sun)
    return x, y, z


def test_between_poses_the_goals_are_those_of_the_sun() -> None:
    bench = tracking()
    # Goals are renewed five times a second, and the normal goes with half the sun.
    assert worst_goal(bench, 12.0) < 2 * STEP + 0.2 * 0.5 * 7.3e-5


def test_beside_the_keyhole_the_goals_do_not_take_a_short_cut() -> None:
    """The azimuth turns by 14° in four seconds; a straight line in the angles is 27 µrad off."""
    bench = tracking()
    motion = bench.controller.motion
    motion.aim = beside_the_keyhole(bench)
    motion.track()
    assert worst_goal(bench, 4.0) < 2 * STEP + 0.2 * 0.5 * 7.3e-5


def test_a_way_from_below_the_mirror_to_above_it_is_cut_finely_enough() -> None:
    bench = standing_by()
    config = bench.controller.config
    assert config.pointing is not None
    assert config.standby is not None
    foot = (*config.standby[:2], -60.0)
    config.path[:] = [foot]
    points = bench.controller.motion.way()
    assert (points[0], points[-1]) == (foot, config.standby)
    seen = np.array(points) - config.pointing.origin
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    assert np.mean([angle_between(one, other) for one, other in pairwise(seen)]) <= PIECE


def test_goals_are_renewed_at_their_interval_and_not_at_every_tick() -> None:
    bench = tracking()
    stepper, times = bench.controller.motion.stepper, []
    assert stepper is not None
    follow = stepper.follow
    stepper.follow = lambda *goals: (times.append(bench.true_ms), follow(*goals))[1]  # type: ignore[method-assign]
    bench.run(10)
    assert set(np.diff(times)) == {RENEW_MS}


def lacking(*names: str, known: bool) -> Bench:
    """A bench whose heliostat stood where it had tracked when its board lost settings."""
    before = tracking()
    flash, items = Flash(), items_of_heliostat(before.machine)
    for name in names:
        del items[name]
    journal = Journal(flash)
    journal.load()
    journal.store(items)
    if known:
        journal.zero(*before.made)
    return Bench(flash)


@pytest.mark.parametrize("name", ["stow", "armature"])
def test_a_board_that_lacks_settings_turns_away_as_far_as_those_allow(name: str) -> None:
    bench = lacking(name, known=True)
    begin = list(bench.made)
    bench.run(20)
    assert bench.state == "UNCONFIGURED"
    assert np.abs(np.subtract(bench.made, begin)) == pytest.approx([30558, 15279], rel=2e-3)


def test_a_board_that_lacks_settings_and_its_counts_does_not_move_by_itself() -> None:
    bench = lacking("stow", known=False)
    begin = list(bench.made)
    bench.run(20)
    assert bench.made == begin


def test_stow_stops_a_motion_by_hand_before_its_end() -> None:
    bench = standing_by()
    first, second = bench.made
    assert bench.order("GOTO", first + 200_000, second) == DONE
    bench.run(3)
    at = furthest = bench.made[0]
    assert bench.order("STOW") == DONE
    for _ in range(100):
        bench.run(0.1)
        furthest = max(furthest, bench.made[0])
    assert furthest - at <= 8000**2 / (2 * 16_000) + 0.3 * 8000, "half a second, and the lead"
    bench.run(240, until="STOWED")
    assert bench.state == "STOWED"


def test_a_defocus_down_the_path_ends_at_the_last_point_within_the_stops() -> None:
    """It ended at the stop: the pose of the point beyond had overwritten the one before."""
    bench = standing_by()
    motion = bench.controller.motion
    motion.config.defocus = (0.5, 0.5)
    last, beyond = motion.way()[-3:-1][::-1]
    found = motion.pose(beyond, 0)
    assert found is not None
    outer = found.angles[1]
    found = motion.pose(last, 0)
    assert found is not None
    goals, inner = bench.machine.drives.counts(np.array(found.angles)), found.angles[1]
    end = 0.5 * (inner + outer)
    motion._stops[1][0 if outer < inner else 1] = end
    motion.defocus()
    assert np.abs(np.array([motion.goal(0), motion.goal(1)]) - goals).max() <= 1.0
