"""Malan's prototype, by the figures of his thesis."""

from collections import Counter
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from heliotrope.field.layouts import HeliostatSize, nearest_gap
from heliotrope.field.stellenbosch import MICROSTEPS, STEPS, WORM, prototype
from heliotrope.geometry import angle_between, normalize
from heliotrope.mechanism import track
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.kernels import slots as slot
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.schedule.settings import Settings
from heliotrope.sun import vector

MRAD = 1e-3
PLANT = prototype()
GROUP = PLANT.groups["azel"]


def test_three_structures_of_six_with_mirrors_of_a_square_foot() -> None:
    assert Counter(GROUP.cluster) == {f"structure-{k}": 6 for k in (1, 2, 3)}
    assert set(GROUP.width) == set(GROUP.height) == {0.3}
    size = HeliostatSize(0.3, 0.3, pivot_height=1.2, pivot_offset=0.05)
    assert nearest_gap(GROUP.position, size) > 0.0


def test_targets_are_four_square_metres_forty_metres_away() -> None:
    (target,), (receiver,) = PLANT.targets, PLANT.receivers
    assert target.width * target.height == pytest.approx(4.0)
    assert target.center[2] == 13.0
    pivots = GROUP.position + [0.0, 0.0, 1.2]
    slant = np.linalg.norm(receiver.center - pivots.mean(axis=0))
    assert slant == pytest.approx(40.0, abs=1.0)
    assert receiver.center[2] + 0.5 * receiver.height <= 18.0
    place = GROUP.position[GROUP.names.index("S3B")]
    np.testing.assert_allclose(place, [19.2, -30.8, 0.0], atol=1e-9)


def test_no_sun_of_the_year_dazzles_the_camera() -> None:
    (camera,), (target,) = PLANT.cameras, PLANT.targets
    assert camera.position is not None
    begin = datetime(2026, 1, 1, tzinfo=UTC).timestamp()
    suns = vector(begin + np.arange(0.0, 365.0 * 86_400.0, 1200.0), PLANT.site)
    high = suns[suns[:, 2] > np.sin(AutomaticSettings().lowest)]
    line = np.broadcast_to(normalize(target.center - camera.position), high.shape)
    assert angle_between(line, high).min() > 1.5 * Settings().glare
    # It stands clear of the beams, which come from the heliostats straight ahead of the target.
    apart = np.linalg.norm(GROUP.position - camera.position, axis=-1)
    assert apart.min() > 10.0


def test_a_turn_has_48_000_steps_and_a_full_step_is_a_milliradian() -> None:
    assert STEPS * MICROSTEPS * WORM == 48_000
    table = GROUP.mechanism.drives.table[0]
    counts = Drive(table).counts(np.full(2, 2.0 * np.pi))
    np.testing.assert_allclose(np.abs(counts - Drive(table).counts(np.zeros(2))), 48_000.0)
    step = 2.0 * np.pi / 48_000
    assert step == pytest.approx(0.13 * MRAD, abs=0.005 * MRAD)
    np.testing.assert_allclose(table[:, slot.WORM_RATIO], 30.0)


def test_full_steps_cost_him_three_quarters_of_a_milliradian() -> None:
    # 6.2: full steps in normal operation; the beam's error over a day of his table 6.1.
    mechanism = GROUP.mechanism[[GROUP.names.index("S3B")]]
    errors = []
    for minutes in range(0, 600, 10):
        when = datetime(2012, 9, 2, 5, 40, tzinfo=UTC) + timedelta(minutes=minutes)
        found = track(mechanism, vector(when, PLANT.site), PLANT.targets[0].center)
        counts = found.best_counts
        ideal = mechanism.pose(counts).normal
        for full in (1, MICROSTEPS):
            normal = mechanism.pose(np.round(counts / full) * full).normal
            errors.append(2.0 * np.linalg.norm(normal - ideal))
    fine, rough = np.sqrt(np.mean(np.square(errors).reshape(-1, 2), axis=0))
    assert fine == pytest.approx(0.10 * MRAD, abs=0.02 * MRAD)
    assert rough == pytest.approx(0.8 * MRAD, abs=0.1 * MRAD)
