"""A day as a path: continuous branches, named slews, over the top only where asked or needed."""

import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, angle_between
from heliotrope.mechanism import Mechanism, kinds, rotary, track, track_path
from support.machines import every_kind, jacks

AIM = (0.0, 0.0, 40.0)
LATITUDES = np.radians([-66.0, -34.0, -10.0, 0.0, 23.4, 51.0, 66.0])
DECLINATIONS = np.radians([-23.43, 0.0, 23.43])
KINDS = [kind for kind in every_kind() if kind != "single_axis"]


def days(steps: int = 80) -> FloatArray:
    """Suns from 5° after rise to 5° before set, for latitudes and declinations, (T, days, 3)."""
    found = []
    for latitude in LATITUDES:
        for declination in DECLINATIONS:
            low = np.sin(np.radians(5.0)) - np.sin(latitude) * np.sin(declination)
            half = np.arccos(np.clip(low / (np.cos(latitude) * np.cos(declination)), -1.0, 1.0))
            if half > 0.2:
                found.append(suns(latitude, declination, np.linspace(-half, half, steps)))
    return np.stack(found, axis=1)


def suns(latitude: float, declination: float, hour: FloatArray) -> FloatArray:
    """Unit vectors to the sun at hour angles, ENU, (T, 3)."""
    sin, cos = np.sin, np.cos
    east = -cos(declination) * sin(hour)
    north = cos(latitude) * sin(declination) - sin(latitude) * cos(declination) * cos(hour)
    up = sin(latitude) * sin(declination) + cos(latitude) * cos(declination) * cos(hour)
    return np.stack([east, north, up], axis=-1)


def explained(machine: Mechanism, angles: FloatArray, normal: FloatArray) -> np.ndarray:
    """Whether the primary joint turned by no more than the way of the normal demands, (T − 1, …).

    Two points at angles ζ₁, ζ₂ from an axis and an angle α apart about it have the chord
    c² = 4 sin²((ζ₁ − ζ₂)/2) + 4 sin ζ₁ sin ζ₂ sin²(α/2). A tenth more is for axes that are only
    nearly at right angles.
    """
    primary = machine.armature.table[:3]
    sine = np.linalg.norm(np.cross(normal, primary), axis=-1)
    turn = np.diff(angles[..., 0], axis=0)
    chord = 2.0 * np.sqrt(sine[1:] * sine[:-1]) * np.abs(np.sin(0.5 * turn))
    way = np.linalg.norm(np.diff(normal, axis=0), axis=-1)
    return (np.abs(turn) <= np.pi) & (chord <= 1.1 * way + 1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_only_the_sun_moves_a_mirror_whatever_latitude_and_kind(kind: str) -> None:
    machine, light = every_kind()[kind], days()
    path = track_path(machine, light, AIM)
    named = np.zeros((len(light) - 1, light.shape[1]), dtype=bool)
    for slew in path.slews:
        named[slew.step - 1, slew.row] = True
    if kind != "two_axis":
        # Its axes are not at right angles; at the dead cone about the first one it turns fast.
        assert (explained(machine, path.angles, path.normal) | named).all()
    still = angle_between(path.normal[1:], path.normal[:-1])
    assert ((still <= 2.0 * angle_between(light[1:], light[:-1]) + 1e-6) | named).all()
    same = np.diff(path.branch, axis=0) == 0
    assert (same | named).all()
    good = path.reachable & (kind != "two_jacks")
    back = machine.drives.angles(path.counts)
    np.testing.assert_allclose(back[good], path.angles[good], rtol=0.0, atol=1e-6)
    if kind not in ("two_axis", "two_jacks"):
        # Without stops one branch serves the whole day.
        assert path.reachable.all()
        assert not path.slews
        assert not path.over_the_top.any()
    served = track(machine, light, AIM).reachable
    assert (path.reachable == served).all()


def machine(azimuth: tuple[float, float], elevation: tuple[float, float]) -> Mechanism:
    """A heliostat north of its tower, whose normal looks south, with stops in degrees."""
    drives = tuple(
        rotary(200, 2400, microsteps=16, min_angle=np.radians(low), max_angle=np.radians(high))
        for low, high in (azimuth, elevation)
    )
    return kinds.azimuth_elevation((0.0, 80.0, 0.0), pivot_height=1.0, drives=drives)


SUMMER = suns(np.radians(51.0), np.radians(23.4), np.radians(np.arange(-100.0, 101.0, 2.5)))


def test_a_day_across_south_stays_in_one_turn_where_the_stops_allow_it() -> None:
    azel = machine((-200.0, 300.0), (-5.0, 95.0))
    alone = track(azel, SUMMER, AIM).best_angles[:, 0]
    path = track_path(azel, SUMMER, AIM)
    # The case is real: pose by pose the azimuth jumps by a turn.
    assert np.abs(np.diff(alone)).max() > np.pi
    assert not path.slews
    assert np.abs(np.diff(path.angles[:, 0])).max() < 0.2
    np.testing.assert_allclose(
        path.normal, track(azel, SUMMER, AIM).chosen(track(azel, SUMMER, AIM).normal), atol=1e-12
    )


def test_a_turn_that_the_stops_demand_is_named_and_single() -> None:
    path = track_path(machine((-200.0, 200.0), (-5.0, 95.0)), SUMMER, AIM)
    assert path.reachable.all()
    (slew,) = path.slews
    assert "joint 1 turns back by a whole turn" in slew.reason
    assert abs(slew.turn[0]) > np.pi
    assert not path.over_the_top.any()


def test_over_the_top_where_it_is_asked_for() -> None:
    azel = machine((-200.0, 200.0), (-5.0, 170.0))
    assert len(track_path(azel, SUMMER, AIM).slews) == 1
    asked = track_path(azel, SUMMER, AIM, over_the_top=True)
    assert not asked.slews
    assert asked.over_the_top.all()
    assert (asked.angles[:, 1] > np.pi / 2).all()


def test_over_the_top_where_it_is_needed() -> None:
    azel = machine((-100.0, 170.0), (-5.0, 150.0))
    path = track_path(azel, SUMMER, AIM)
    assert path.reachable.all()
    assert 0 < path.over_the_top.sum() < len(SUMMER)
    assert {slew.reason for slew in path.slews} <= {"over the top", "back from over the top"}
    assert len(path.slews) in (1, 2)


def test_the_pose_before_decides_between_equal_turns() -> None:
    azel = machine((-900.0, 900.0), (-5.0, 95.0))
    for turn in (-2.0 * np.pi, 2.0 * np.pi):
        here = azel.drives.counts((turn, 0.5))
        path = track_path(azel, SUMMER, AIM, current=here)
        assert not path.slews
        assert abs(path.angles[0, 0] - turn) <= np.pi


def test_a_jack_at_its_end_is_named_when_it_follows_again() -> None:
    first, second = jacks()
    short = (first.replace(min_count=0.0, max_count=30000.0), second)
    one = kinds.two_jacks(
        (25.0, -60.0, 0.3), short,
        joint_translation_1=(0.01, 0.02, 1.5),
        joint_translation_2=(0.03, 0.01, 0.02),
        concentrator_translation=(0.0, 0.175, 0.0),
    )  # fmt: skip
    path = track_path(one, SUMMER, AIM)
    assert not path.reachable.all()
    counts = path.counts[..., 0]
    assert counts.min() >= -1e-6
    assert counts.max() <= 30000.0 + 1e-6


def test_a_path_needs_times() -> None:
    with pytest.raises(InputError, match=r"sun: shape \(3,\)"):
        track_path(machine((-200.0, 200.0), (-5.0, 95.0)), SUMMER[0], AIM)


def test_a_joint_without_stops_goes_on_through_south() -> None:
    free = (rotary(200, 2400), rotary(200, 2400))
    azel = kinds.azimuth_elevation((0.0, 80.0, 0.0), pivot_height=1.0, drives=free)
    path = track_path(azel, SUMMER, AIM, over_the_top=True)
    assert not path.slews
    assert (path.angles[:, 1] < np.pi / 2).all()
    assert path.angles[:, 0].min() < np.pi < path.angles[:, 0].max()
