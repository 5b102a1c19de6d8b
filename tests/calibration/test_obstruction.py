"""Sightings corrected for shading and blocking by neighbours."""

import numpy as np
import pytest

from heliotrope import sun as solar
from heliotrope.calibration.obstruction import Unobstructed, unobstructed
from heliotrope.calibration.sightings import Sightings, camera_target
from heliotrope.field.layouts import malan_plant
from heliotrope.geometry import bisector, normalize
from heliotrope.optics import Mirrors, reflected_beam

PLANT = malan_plant(60)
(FIELD,) = PLANT.groups.values()
LEFT = PLANT.target("left")
AIM = PLANT.receivers[0].center
#: Hours of 2026-09-02 and of 2026-12-21.
TIMES = 1788336000.0 + 3600.0 * np.array([7.0, 9.0, 12.0])
ROWS = np.arange(0, 60, 5)


def beams(time: float, *, alone: bool) -> Sightings:
    """Centroids of real beams on the target, of mirrors with neighbours or without."""
    sun, points = solar.vector(time, PLANT.site), []
    aims = normalize(AIM - FIELD.position)
    normals = bisector(np.broadcast_to(sun, aims.shape), aims)
    for i in ROWS:
        others = np.flatnonzero(np.arange(60) != i)
        size = FIELD.width[others], FIELD.height[others]
        beside = Mirrors.of(FIELD.position[others], normals[others], size, AIM)
        beam = reflected_beam(
            LEFT,
            FIELD.position[i],
            sun,
            float(FIELD.width[i]),
            float(FIELD.height[i]),
            neighbours=None if alone else beside,
            step=0.05,
            elements=16,
        )
        points.append(LEFT.point(beam.centroid))
    counts = np.zeros((len(ROWS), 2))
    suns = np.broadcast_to(sun, (len(ROWS), 3))
    return camera_target(ROWS, counts, suns, np.array(points), time=time)


def corrected(seen: Sightings) -> Unobstructed:
    return unobstructed(FIELD, PLANT.targets, seen, AIM)


@pytest.mark.parametrize("time", TIMES.tolist())
def test_what_neighbours_have_moved_is_moved_back(time: float) -> None:
    seen, true = beams(time, alone=False), beams(time, alone=True)
    found = corrected(seen)
    usable = found.hidden < 0.35
    before = np.linalg.norm(seen.destination - true.destination, axis=1)[usable]
    after = np.linalg.norm(found.sightings.destination - true.destination, axis=1)[usable]
    assert before.max() > 5e-3
    assert after.max() < 4e-3 + 0.2 * before.max()
    # The uncertainty that is added covers what is left.
    extra = found.sightings.destination_covariance - seen.destination_covariance
    sigma = np.sqrt(np.trace(extra, axis1=1, axis2=2))[usable]
    assert (after <= 4e-3 + 3.0 * sigma).all()
    # Everything else stays.
    np.testing.assert_array_equal(found.sightings.source, seen.source)
    np.testing.assert_array_equal(found.sightings.sigma, seen.sigma)


def test_lonely_mirrors_and_other_sightings_stay_as_they_are() -> None:
    seen = beams(TIMES[1], alone=True)
    alone = unobstructed(malan_plant(1).groups["azel"], PLANT.targets, seen.of(0), AIM)
    assert not alone.hidden.any()
    assert str(alone).endswith("no neighbour in the plant file hides any of the mirrors")
    # Beside every target there is nothing to correct.
    away = camera_target(ROWS, seen.counts, seen.source, seen.destination + [0.0, 30.0, 0.0])
    found = corrected(away)
    np.testing.assert_array_equal(found.sightings.destination, away.destination)
    assert not found.hidden.any()


def test_the_line_tells_how_many_and_how_far() -> None:
    found = corrected(beams(TIMES[0], alone=False))
    told = found.summary()
    assert 0 < told["corrected"] <= told["sightings"] == len(ROWS)
    assert 0.0 < told["median_shift_mm"] <= told["largest_shift_mm"]
    assert f"{told['corrected']} of {len(ROWS)} centroids corrected by" in str(found)
