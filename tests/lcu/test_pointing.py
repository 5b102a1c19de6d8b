"""Pointing on a local controller: the angles of the mechanism's tracking, in both precisions."""

import math
from types import ModuleType

import numpy as np
import pytest

from heliotrope.geometry import angle_between, direction
from heliotrope.lcu import pointing
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.tracking import TrackingStatus, track
from support.lcu_machines import f32, single
from support.machines import every_kind, imperfect

KINDS = ("azimuth_elevation", "tilt_roll", "target_aligned", "two_jacks")
FREE = [[-math.inf, math.inf], [-math.inf, math.inf]]
HOME = [0.0, 0.0]


def single_pointing() -> ModuleType:
    return single("pointing")


def field(rows: int, seed: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Armatures (18,) of imperfect mechanisms over a field about a tower, with suns and aims."""
    rng = np.random.default_rng(seed)
    machines = [imperfect(every_kind()[kind], seed + i) for i in range(12) for kind in KINDS]
    cases = []
    for i in range(rows):
        table = machines[i % len(machines)].armature.table.copy()
        place = rng.uniform(30.0, 900.0) * np.array([*direction(rng.uniform(0, 6.28), 0.0)[:2], 0])
        for part in (3, 9, 12):
            table[part : part + 3] += place - [25.0, -60.0, 0.3]
        sun = direction(rng.uniform(0, 2 * np.pi), rng.uniform(0.05, 1.57))
        cases.append((table, sun, np.array([0.0, 0.0, rng.uniform(10, 120)])))
    return cases


def test_double_precision_agrees_with_the_mechanism() -> None:
    cases = field(3000, 1)
    tables, suns, aims = (np.array(column) for column in zip(*cases, strict=True))
    known = track(Armature(tables), suns, aims, tolerance=1e-10)
    reached = 0
    for i, (table, sun, aim) in enumerate(cases):
        machine = pointing.Pointing(tuple(map(float, table)))
        machine.solve(tuple(sun), tuple(aim), FREE, HOME)
        for b, pose in enumerate(machine.found):
            assert pose.status == known.status[i, b], i
            reached += pose.status == TrackingStatus.OK
            if pose.status == TrackingStatus.OK:
                np.testing.assert_allclose(pose.angles, known.angles[i, b], rtol=0, atol=1e-9)
                assert pose.residual < 1e-9
            else:
                assert pose.residual == pytest.approx(known.residual[i, b], abs=1e-7)
    assert reached > 5500


def test_single_precision_is_within_a_microradian() -> None:
    module = single_pointing()
    apart, sideways = [], []
    for table, sun, aim in field(800, 2):
        exact, board = pointing.Pointing(tuple(map(float, table))), module.Pointing(f32(table))
        assert board.eps == np.finfo(np.float32).eps
        wanted = exact.solve(tuple(sun), tuple(aim), FREE, HOME)
        board.solve(f32(sun), f32(aim), FREE, HOME)
        pose = board.found[(wanted.branch + 1) // 2]
        if wanted.status != pointing.OK:
            continue
        assert pose.status == pointing.OK
        assert isinstance(pose.angles[0], np.float32)
        body = Armature(table)
        axis = angle_between(body.pose(wanted.angles)[0], table[:3])
        apart.append(angle_between(body.pose(wanted.angles)[0], body.pose(pose.angles)[0]))
        sideways.append(abs(pose.angles[0] - wanted.angles[0]) * math.sin(axis))
    assert len(apart) > 750
    assert max(apart) < 1e-6
    assert max(sideways) < 1e-6


def test_the_keyhole_in_single_precision() -> None:
    """Closer to the primary axis than 1° the normal still has its digits."""
    module = single_pointing()
    body = imperfect(every_kind()["azimuth_elevation"], 3, size=1e-3).armature.table
    exact, board = pointing.Pointing(tuple(map(float, body))), module.Pointing(f32(body))
    for i in range(40):
        normal = direction(0.7 * i % (2.0 * math.pi), math.pi / 2 - 0.004 - 0.0005 * i)
        sun = direction(0.3 * i, 1.0)
        aim = body[12:15] + 300.0 * (2.0 * (normal @ sun) * normal - sun)
        wanted = exact.solve(tuple(sun), tuple(aim), FREE, HOME)
        board.solve(f32(sun), f32(aim), FREE, HOME)
        pose = board.found[(wanted.branch + 1) // 2]
        assert wanted.status == pose.status == pointing.OK
        off = angle_between(
            Armature(body).pose(wanted.angles)[0], Armature(body).pose(pose.angles)[0]
        )
        assert off < 1e-6


def test_the_dead_cone_gives_the_nearest_pose_and_says_so() -> None:
    canted = every_kind()["azimuth_elevation"].with_parameters({"canting": 0.02})
    table = canted.armature.table
    sun = direction(0.3, math.radians(89.5))
    aim = table[12:15] + 100.0 * sun
    known = track(canted.armature, sun, aim)
    for machine in (
        pointing.Pointing(tuple(map(float, table))),
        single_pointing().Pointing(f32(table)),
    ):
        pose = machine.solve(f32(sun), f32(aim), FREE, HOME)
        assert pose.status == pointing.UNREACHABLE
        assert pose.residual == pytest.approx(float(known.residual.min()), abs=3e-6)
        assert pose.residual > 0.009


@pytest.mark.parametrize("canting", [0.1, 0.198, 0.202, 0.3])
def test_the_dead_cone_of_axes_that_are_not_square_gives_the_nearest_pose(canting: float) -> None:
    armature = (
        every_kind()["azimuth_elevation"]
        .with_parameters({"canting": canting, "non_orthogonality": 0.2})
        .armature
    )
    own = pointing.Pointing(tuple(map(float, armature.table)))
    sun = armature.table[:3] + 2e-4 * np.cross(armature.table[:3], (1.0, 0.0, 0.0))
    sun /= np.linalg.norm(sun)
    aim = armature.vertex + 200.0 * sun
    known = track(armature, sun, aim)
    pose = own.solve(tuple(sun), tuple(aim), FREE, HOME)
    assert pose.status == pointing.UNREACHABLE
    assert pose.residual == pytest.approx(float(known.residual.min()), abs=1e-6)
    assert pose.residual == pytest.approx(abs(canting - 0.2), abs=1e-3)


def test_stops_choose_the_branch_and_give_the_nearest_pose() -> None:
    machine = imperfect(every_kind()["azimuth_elevation"], 4)
    rng = np.random.default_rng(5)
    own = pointing.Pointing(tuple(map(float, machine.armature.table)))
    seen = set()
    for _ in range(300):
        sun, aim = direction(rng.uniform(0, 6.28), rng.uniform(0.1, 1.5)), (0.0, 0.0, 40.0)
        low = rng.uniform(-3.0, 1.0)
        stops = [[low, low + rng.uniform(0.5, 4.0)], [0.0, 1.5]]
        near = [float(rng.uniform(*pair)) for pair in stops]
        limited = machine.drives.replace(
            rate=1.0,
            zero=0.0,
            bias=0.0,
            scale=0.0,
            worm_cos=0.0,
            worm_sin=0.0,
            sag=0.0,
            min_angle=[stops[0][0], 0.0],
            max_angle=[stops[0][1], 1.5],
        )
        known = track(machine.armature, sun, aim, drives=limited, current=near)
        pose = own.solve(tuple(sun), aim, stops, near)
        best = int(known.best)
        seen.add(int(known.status[best]))
        assert pose.status == known.status[best]
        assert pose.residual == pytest.approx(known.residual[best], abs=1e-9)
        if known.status[best] == TrackingStatus.OK:
            np.testing.assert_allclose(pose.angles, known.angles[best], rtol=0, atol=2e-9)
        for angle, (lower, upper) in zip(pose.angles, stops, strict=True):
            assert lower <= angle <= upper
    assert seen == {TrackingStatus.OK, TrackingStatus.STOPPED}


def test_a_mirror_that_stands_near_one_of_two_poses_goes_to_that_one() -> None:
    seen = 0
    for table, sun, aim in field(60, 8):
        own = pointing.Pointing(tuple(map(float, table)))
        own.solve(tuple(sun), tuple(aim), FREE, HOME)
        poses = [list(pose.angles) for pose in own.found if pose.status == pointing.OK]
        if len(poses) < 2 or np.max(np.abs(np.subtract(*poses))) < 0.5:
            continue
        for angles in (*poses, *reversed(poses)):
            near = [angles[0] - 0.1, angles[1] + 0.1]
            found = own.solve(tuple(sun), tuple(aim), FREE, near)
            np.testing.assert_allclose(found.angles, angles, rtol=0, atol=1e-9)
        seen += 1
    assert seen > 30


def test_the_near_field_is_left_to_newton() -> None:
    machine = imperfect(every_kind()["two_axis"], 6, size=0.02)
    own = pointing.Pointing(tuple(map(float, machine.armature.table)))
    rng = np.random.default_rng(7)
    met = known_to_meet = 0
    for _ in range(400):
        sun = direction(rng.uniform(0, 6.28), rng.uniform(0.1, 1.5))
        aim = machine.armature.vertex + rng.uniform(-2.5, 2.5, 3)
        known = track(machine.armature, sun, aim)
        own.solve(tuple(sun), tuple(aim), FREE, HOME)
        for b, pose in enumerate(own.found):
            known_to_meet += known.status[b] == TrackingStatus.OK
            if known.status[b] == TrackingStatus.OK and pose.status == pointing.OK:
                normal, vertex = machine.armature.pose(pose.angles)
                ray = 2.0 * (normal @ sun) * normal - sun
                assert np.linalg.norm(np.cross(aim - vertex, ray)) < 1e-8
                met += 1
            assert (pose.residual < 1e-8) == (pose.status == pointing.OK)
    assert known_to_meet > 700
    assert met > 0.99 * known_to_meet


def test_with_the_normal_along_the_primary_axis_its_angle_is_zero() -> None:
    """Any angle would do there, but it must be an angle: sine and cosine are of length one."""
    numbers = (0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0, *[0.0] * 9, 1.0, 0.0)
    for module in (pointing, single_pointing()):
        own = module.Pointing(numbers if module is pointing else f32(numbers))
        own.solve(f32((0.0, 0.0, 1.0)), f32((0.0, 0.0, 80.0)), FREE, HOME)
        for pose in own.found:
            assert pose.status == pointing.OK
            assert pose.angles == [0.0, pytest.approx(math.pi / 2)]
            assert pose.residual < 1e-6


def test_no_mirror_serves_opposite_directions() -> None:
    table = every_kind()["azimuth_elevation"].armature.table
    own = pointing.Pointing(tuple(map(float, table)))
    # The vertex at zero angles, where the solution starts, and beyond it away from the sun.
    sun = (0.0, 0.0, 1.0)
    aim = tuple(table[12:15] - [0.0, 0.0, 50.0])
    assert own.solve(sun, aim, FREE, HOME).status == pointing.DEGENERATE


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({0: math.nan}, "finite"),
        ({0: 0.5, 2: 0.5}, "unit vectors"),
        ({6: 0.0, 7: 0.0, 8: -1.0}, "parallel"),
        ({15: 1.0, 16: 0.0, 17: 0.0}, "parallel"),
    ],
)
def test_armatures_that_cannot_point_are_refused(change: dict[int, float], text: str) -> None:
    numbers = [0.0, 0, -1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0]
    for place, value in change.items():
        numbers[place] = value
    with pytest.raises(ValueError, match=text):
        pointing.Pointing(tuple(numbers))
