"""A plan promises the reflections that the drone will see."""

import numpy as np
import pytest

from heliotrope.airborne.plan.hover import HoverMirrors, Sampling, face, mirrors, pattern
from heliotrope.airborne.plan.prospect import Prospect, prospect
from heliotrope.airborne.simulate.rendered import paper_field, visible_reflections
from heliotrope.airborne.simulate.simulation import Errors, exact_reflections, fly
from heliotrope.field.plant import Plant
from heliotrope.geometry import direction
from heliotrope.sun import Site
from support.drone_case import camera

FIELD = paper_field(rows=5, columns=6)
PLANT = Plant("paper", Site(50.9, 6.4, 80.0, name="test"), {"azel": FIELD})
ROWS = np.arange(len(FIELD))
MIDDLE = FIELD.position.mean(axis=0)


def look(elevation_deg: float, sampling: Sampling) -> tuple[HoverMirrors, np.ndarray, Prospect]:
    every = mirrors(PLANT)
    towards = direction(np.radians(214.0), np.radians(elevation_deg))
    point = MIDDLE + sampling.distance * towards
    facing = face(every.armature, every.drives, point[None, None])
    return every, point, prospect(every, ROWS, facing, point[None], sampling)


def test_reflections_promised_are_those_that_can_be_seen() -> None:
    lens = camera(3000, 2000)
    sampling = Sampling(pointing=1e-3, camera=lens.focal, samples=12.0)
    every, point, seen = look(13.5, sampling)
    facing = face(every.armature, every.drives, point[None, None])
    towards = (point - MIDDLE) / np.linalg.norm(point - MIDDLE)
    grid = pattern(
        facing.vertex[0], every.corners, every.slopes, every.facet_area, point, towards, sampling
    )
    still = Errors(gimbal=0.0, survey=0.0, slope=0.0, mechanism={})
    flown = fly(FIELD, lens, facing.counts[0], grid.camera, MIDDLE, errors=still)
    exact = exact_reflections(flown)
    visible = list(visible_reflections(flown, exact))
    count = np.bincount(exact.heliostat[visible], minlength=len(FIELD))
    hidden = seen.reflections[0] < 0.7 * seen.reflections[0].max()
    assert 3 < hidden.sum() < 27
    # Spots within 2 px of an edge are not promised.
    assert 0.7 < seen.reflections[0].sum() / count.sum() < 1.0
    assert np.corrcoef(seen.reflections[0], count)[0, 1] > 0.9


def test_higher_drones_see_more_and_far_ones_see_small_mirrors() -> None:
    low, high = (look(e, Sampling())[2] for e in (13.5, 50.0))
    assert np.median(high.reflections) > 1.2 * np.median(low.reflections)
    far = look(50.0, Sampling(distance=300.0))[2]
    assert np.median(far.side) == pytest.approx(0.5 * np.median(high.side), rel=0.02)
    assert np.median(high.side) == pytest.approx(20.0 * np.sqrt(3.2 * 2.5), rel=0.03)
