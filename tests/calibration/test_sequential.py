"""Each sighting from those before it; sightings and mirrors that nothing explains."""

import dataclasses

import numpy as np
import pytest
from tests.support.machines import jacks

from heliotrope.calibration.evaluation import split
from heliotrope.calibration.learn.assessment import assess, unexplained_mirrors
from heliotrope.calibration.learn.learned import predict
from heliotrope.calibration.learn.learning import learn
from heliotrope.calibration.learn.sequential import predict_by_stream, predict_in_turn
from heliotrope.calibration.sightings import Sightings, sightings
from heliotrope.geometry import direction, reflect
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import track

AIM = np.array([0.0, -3.0, 43.0])
MODEL = (
    "tilt_north", "tilt_up", "canting", "elevation_initial_angle", "azimuth_initial_angle",
    "elevation_stroke_offset", "azimuth_stroke_offset",
)  # fmt: skip
START, DAY = 1.7e9, 86400.0


@pytest.fixture(scope="module")
def field() -> tuple[Mechanism, Sightings]:
    """Three mirrors with jacks, sixteen sightings each over two months."""
    rng = np.random.default_rng(3)
    place = np.c_[[-20.0, 0.0, 25.0], [60.0, 80.0, 70.0], np.zeros(3)]
    nominal = kinds.two_jacks(place, drives=jacks())
    truth = nominal.with_parameters({n: rng.normal(0, 3e-3, 3) for n in MODEL})
    parts = []
    for k in range(16):
        sun = direction(np.pi + rng.uniform(-0.8, 0.8), rng.uniform(0.4, 0.9))
        counts = track(nominal, sun, AIM).chosen(track(nominal, sun, AIM).counts)
        pose = truth.pose(counts)
        ray, way = reflect(sun, pose.normal), AIM - pose.vertex
        spot = pose.vertex + ray * np.linalg.norm(way, axis=1, keepdims=True)
        spot += rng.normal(0.0, 0.02, spot.shape)
        parts.append(
            (np.arange(3), counts, np.tile(sun, (3, 1)), spot, np.full(3, START + 4 * k * DAY))
        )
    rows, counts, source, spot, time = (np.concatenate(p) for p in zip(*parts, strict=True))
    return nominal, sightings(rows, counts, source, spot, time=time, sigma=2.5e-4)


def _moved(seen: Sightings, rows: np.ndarray) -> Sightings:
    spots = seen.destination.copy()
    spots[rows] += [0.4, 0.0, 0.3]
    return dataclasses.replace(seen, destination=spots)


def test_a_sighting_is_predicted_from_those_before_it(field: tuple[Mechanism, Sightings]) -> None:
    nominal, seen = field
    used = split(seen, "sequential", 0.8)
    assert (used == split(seen, "chronological", 0.8)).all()
    learned = learn(nominal, seen, MODEL, used=used)
    found = predict_in_turn(learned)
    held = np.flatnonzero(~used)
    place = int(np.flatnonzero(seen.heliostat[held] == 1)[1])
    row = held[place]
    before = (seen.heliostat == 1) & (seen.time < seen.time[row])
    direct = predict(
        learn(nominal, seen, MODEL, used=before, hyper=learned.hyper), seen.take([row])
    )
    np.testing.assert_allclose(found.plane[place], direct.plane[0], atol=1e-9)
    np.testing.assert_allclose(found.covariance[place], direct.covariance[0], atol=1e-12)
    # A later sighting and one of the same moment change nothing; the one before it does.
    later = np.flatnonzero((seen.heliostat == 1) & (seen.time > seen.time[row]))
    again = predict_in_turn(dataclasses.replace(learned, sightings=_moved(seen, later)))
    np.testing.assert_array_equal(again.plane[place], found.plane[place])
    earlier = (
        held[place - 1 : place]
        if seen.heliostat[held[place - 1]] == 1
        else np.array([np.flatnonzero(before)[-1]])
    )
    again = predict_in_turn(dataclasses.replace(learned, sightings=_moved(seen, earlier)))
    assert np.linalg.norm(again.plane[place] - found.plane[place]) > 1e-5
    figures = assess(("A", "B", "C"), learned, found)
    assert figures.beam.count == len(held)
    assert 1e3 * figures.median_of_medians < 1.0


def test_the_stream_predicts_as_if_all_were_learnt_afresh(
    field: tuple[Mechanism, Sightings],
) -> None:
    """With jacks that are not linear, and without any event; a late sighting is linearised once."""
    nominal, seen = field
    learned = learn(nominal, seen, MODEL, used=split(seen, "sequential", 0.7), own=False)
    one, other = predict_by_stream(learned), predict_in_turn(learned)
    sigma = np.sqrt(np.einsum("maa->ma", other.covariance))
    assert np.abs((one.plane - other.plane) / sigma).max() < 0.5
    ratio = np.einsum("maa->m", one.covariance) / np.einsum("maa->m", other.covariance)
    assert 0.6 < ratio.min() < ratio.max() < 1.6
    assert 1e3 * np.median(one.errors.beam) < 1.0
    # What comes later is not known yet.
    later = np.flatnonzero(~learned.used)[-1:]
    again = predict_by_stream(dataclasses.replace(learned, sightings=_moved(seen, later)))
    np.testing.assert_array_equal(again.values, one.values)


def _beyond(seen: Sightings, rows: np.ndarray) -> Sightings:
    counts = seen.counts.copy()
    counts[rows] = [-2e5, 7e4]
    return dataclasses.replace(seen, counts=counts)


def test_counts_beyond_a_jack_spoil_nothing_else(field: tuple[Mechanism, Sightings]) -> None:
    nominal, seen = field
    used = split(seen, "chronological", 0.75)
    bad = np.array([4, 47])
    assert list(used[bad]) == [True, False]
    found = learn(nominal, _beyond(seen, bad), MODEL, used=used)
    assert set(np.flatnonzero(found.unusable)) == {4}
    without = used.copy()
    without[4] = False
    same = learn(nominal, seen, MODEL, used=without)
    for a, b in zip(found.members, same.members, strict=True):
        np.testing.assert_array_equal(a.alpha, b.alpha)
    figures = assess(("A", "B", "C"), found)
    assert list(figures.unusable) == [4, 47]
    assert figures.beam.count == (~used).sum() - 1
    assert np.isfinite(figures.mean_of_means)
    assert unexplained_mirrors(("A", "B", "C"), found) == ()


def test_a_mirror_of_wrong_counts_leaves_the_others_alone(
    field: tuple[Mechanism, Sightings],
) -> None:
    nominal, seen = field
    found = learn(nominal, _beyond(seen, np.flatnonzero(seen.heliostat == 2)), MODEL)
    assert found.unusable.sum() == 16
    assert np.isfinite(found.hyper.vector).all()
    (line,) = unexplained_mirrors(("A", "B", "C"), found)
    assert line.startswith("C: 16 of 16 sightings have counts outside the range of its drives.")


def test_photographs_of_another_mirror_are_named(field: tuple[Mechanism, Sightings]) -> None:
    nominal, seen = field
    spots = seen.destination.copy()
    spots[np.flatnonzero(seen.heliostat == 1)[[3, 7, 12]]] += [
        [4.0, 0.0, 1.0],
        [-3.0, 0.0, 2.0],
        [1.0, 0.0, -5.0],
    ]
    found = learn(nominal, dataclasses.replace(seen, destination=spots), MODEL)
    (line,) = unexplained_mirrors(("A", "B", "C"), found)
    assert line.startswith("B: 3 of 16 beams were more than 5 mrad from where its other")
    assert "another mirror's beam" in line
