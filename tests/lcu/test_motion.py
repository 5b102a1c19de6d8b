"""Motion of the two axes: the goals between the poses that are computed."""

import numpy as np

from heliotrope.geometry import angle_between
from support.lcu_machines import Bench, tracking

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
