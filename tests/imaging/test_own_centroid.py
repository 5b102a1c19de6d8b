"""An own centroid: what it is given, and what becomes of its answer."""

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from heliotrope.errors import InputError, TimeError
from heliotrope.field.target import Target
from heliotrope.imaging.campaign import sighting_of
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.photograph import (
    Photograph,
    PhotographSettings,
    TargetReading,
    read_crop,
    read_photograph,
)
from heliotrope.imaging.spots.background import from_frame
from heliotrope.imaging.spots.centroid import BeamPicture, with_centroid
from heliotrope.imaging.spots.placed import place
from heliotrope.imaging.spots.spot import find_spots
from heliotrope.imaging.synthetic.rendering import (
    Scene,
    example_camera,
    example_target,
    exposed,
    render,
)
from heliotrope.imaging.targets.rectify import Rectified
from heliotrope.imaging.targets.view import faces
from heliotrope.optics.mirror_image import gaussian_beam
from heliotrope.sun import Site, vector

TARGET = example_target(8.0)
CAMERA = example_camera(TARGET, 200.0, (800, 600))
PLACE = (0.9, -0.6)
TIME = datetime(2026, 9, 2, 10, 0, tzinfo=UTC)
SITE = Site(-33.93, 18.87, 120.0)
COUNTS = (-251959, 746419)
#: Covariance of an own centroid, m².
OWN = np.array([[9e-4, 2e-4], [2e-4, 4e-4]])


def moments(beam: BeamPicture) -> tuple[np.ndarray, np.ndarray]:
    """First moments of the light."""
    light = np.where(beam.mask, beam.light, 0.0)
    arms = np.stack([beam.right, beam.up])
    middle = (light * arms).sum(axis=(1, 2)) / light.sum()
    lever = np.where(beam.mask, arms - middle[:, None, None], 0.0) / light.sum()
    return middle, beam.noise**2 * np.einsum("iyx,jyx->ij", lever, lever)


@lru_cache(maxsize=1)
def frame() -> Frame:
    beam = gaussian_beam(PLACE, 0.7, 0.5, angle=0.4)
    scene = exposed(Scene(CAMERA, (TARGET,), (("target", beam, 700.0),)))
    return replace(render(scene, 3).frame, time=TIME, time_deviation=0.5)


@lru_cache(maxsize=4)
def read(own: Callable[[BeamPicture], Any] | None = None) -> Photograph:
    return read_photograph(frame(), [TARGET], CAMERA, settings=PhotographSettings(centroid=own))


def crop(own: Callable[[BeamPicture], Any]) -> TargetReading:
    """Return the reading of a picture of the target alone, with a round beam at (1.0, 0.5)."""
    y, x = np.mgrid[127:-1:-1, 0:128] * (8.0 / 128) - 4.0 + 4.0 / 128
    light = 60.0 + 150.0 * np.exp(-((x - 1.0) ** 2 + (y - 0.5) ** 2) / (2 * 0.6**2))
    pixels = np.round(light + np.random.default_rng(1).normal(0.0, 0.5, light.shape))
    given = PhotographSettings(centroid=own)
    return read_crop(Frame(pixels.astype(np.uint8)), TARGET, given).readings[0]


def fixed(beam: BeamPicture) -> tuple[tuple[float, float], np.ndarray]:
    return (1.25, 0.75), OWN


def test_first_moments_find_the_beam() -> None:
    own, program = read(moments).readings[0], read().readings[0]
    assert own.good, own.reasons
    assert np.linalg.norm(own.spots[0].plane - PLACE) < 0.02
    # The same light and nearly the same way: the program adds what lies below the beam's foot.
    assert np.linalg.norm(own.spots[0].plane - program.spots[0].plane) < 0.01
    assert 0.0 < own.spots[0].deviation < 1.5 * program.spots[0].deviation


def test_place_and_covariance_are_those_of_the_answer() -> None:
    own, program = read(fixed).readings[0].spots[0], read().readings[0].spots[0]
    view = read().views[0]
    at = np.array([1.25, 0.75])
    np.testing.assert_allclose(own.plane, at, atol=1e-9)
    np.testing.assert_allclose(own.point, TARGET.point(at), atol=1e-9)
    np.testing.assert_allclose(own.covariance, OWN + view.covariance_at(at), rtol=1e-9)
    np.testing.assert_allclose(
        own.covariance_enu, TARGET.axes.T @ own.covariance @ TARGET.axes, atol=1e-15
    )
    np.testing.assert_allclose(own.pixel, view.to_pixels(at), atol=1e-6)
    # The shape, from which the beam's quality is judged, is the program's.
    assert own.spot.power == program.spot.power
    assert own.flux == pytest.approx(program.flux, nan_ok=True)


def test_an_unsure_centroid_is_a_reason_against_the_spot() -> None:
    reading = crop(lambda beam: ((1.0, 0.5), np.eye(2)))
    assert [r.name for r in reading.reasons] == ["uncertain"]


def test_places_count_from_the_centre_of_the_beams_own_target() -> None:
    """Two targets in one plane, one of them a little turned: each has its own right and up."""
    shift = np.array([-9.0, 0.0, 1.0])
    turn = 0.004
    right = np.array([-np.cos(turn), 0.0, np.sin(turn)])
    up = np.array([np.sin(turn), 0.0, np.cos(turn)])
    middle = TARGET.center + shift
    ends = [(-4.0, 4.0), (4.0, 4.0), (4.0, -4.0), (-4.0, -4.0)]
    other = Target("other", np.stack([middle + x * right + y * up for x, y in ends]), middle)
    (face,) = faces((replace(TARGET, marks=()), other))
    low, high = face.span
    step = 1.0 / 16.0
    columns, rows = np.ceil((high - low) / step).astype(int)
    first = np.array([low[0] + 0.5 * step, high[1] - 0.5 * step])
    x = first[0] + step * np.arange(columns)
    y = first[1] - step * np.arange(rows)
    points = face.point(np.stack(np.meshgrid(x, y), axis=-1))
    at = other.plane_coordinates(points)
    light = 0.2 + 0.5 * np.exp(-((at - [1.5, -1.0]) ** 2).sum(axis=-1) / (2 * 0.6**2))
    noise = np.random.default_rng(2).normal(0.0, 0.002, light.shape)
    everywhere = np.ones(light.shape, dtype=np.bool_)
    nothing = np.zeros(light.shape, dtype=np.float32)
    picture = Rectified(
        face, (light + noise).astype(np.float32), step, first, everywhere, ~everywhere, nothing
    )
    background = from_frame(picture)
    (spot,) = find_spots(picture, background)
    placed = place(picture, spot)
    assert placed.target is other
    moved = with_centroid(placed, other, picture, background, moments)
    assert np.linalg.norm(moved.plane - [1.5, -1.0]) < 0.02
    np.testing.assert_allclose(other.plane_coordinates(moved.point), moved.plane, atol=1e-9)


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (None, "a NoneType for target target; return a position"),
        ((1.0, 2.0, 3.0), "a tuple for target target; return a position"),
        (("here", OWN), "not an array of numbers"),
        (((1.0, np.nan), OWN), "2 finite numbers"),
        (((1.0, 2.0, 3.0), OWN), r"position \[1.0, 2.0, 3.0\] on target target"),
        (((140.0, 90.0), OWN), r"position \[140.0, 90.0\] m is not on target target, 8 × 8 m"),
        (((1.0, 0.5), 1e-4), "symmetric and positive"),
        (((1.0, 0.5), np.zeros((2, 2))), "symmetric and positive"),
        (((1.0, 0.5), -OWN), "symmetric and positive"),
        (((1.0, 0.5), [[1e-4, 1e-5], [0.0, 1e-4]]), "symmetric and positive"),
    ],
)
def test_a_wrong_answer_is_refused(answer: object, text: str) -> None:
    with pytest.raises(InputError, match=text):
        crop(lambda beam: answer)


def test_a_photograph_becomes_a_sighting() -> None:
    seen = sighting_of(read(fixed), "P6A", COUNTS, SITE)
    spot = read(fixed).readings[0].spots[0]
    assert seen.names == ("P6A",)
    assert seen.time[0] == TIME.timestamp()
    np.testing.assert_array_equal(seen.counts, [COUNTS])
    np.testing.assert_allclose(seen.source[0], vector(TIME, SITE), atol=1e-15)
    np.testing.assert_allclose(seen.destination[0], spot.point, atol=1e-12)
    np.testing.assert_allclose(seen.destination_covariance[0], spot.covariance_enu, atol=1e-15)
    # Half a second of the sun's way.
    assert seen.source_covariance[0, 0, 0] == pytest.approx((0.5 * 7.292e-5) ** 2, rel=1e-3)


def test_a_time_or_a_sun_of_ones_own_replaces_that_of_the_frame() -> None:
    timeless = replace(read(), frame=replace(frame(), time=None))
    with pytest.raises(InputError, match="its time is unknown; pass time="):
        sighting_of(timeless, "P6A", COUNTS, SITE)
    later = sighting_of(timeless, "P6A", COUNTS, SITE, time="2026-09-02T12:00Z")
    assert later.time[0] == TIME.timestamp() + 7200.0
    np.testing.assert_allclose(later.source[0], vector("2026-09-02T12:00Z", SITE), atol=1e-15)
    assert not later.source_covariance.any()
    given = sighting_of(timeless, "P6A", COUNTS, SITE, sun=(0.0, 0.6, 0.8))
    assert np.isnan(given.time[0])
    np.testing.assert_allclose(given.source[0], (0.0, 0.6, 0.8), atol=1e-15)
    with pytest.raises(TimeError):
        sighting_of(timeless, "P6A", COUNTS, SITE, time="2026-09-02T12:00")


def test_a_spot_that_cannot_be_trusted_gives_no_sighting() -> None:
    unsure = read_photograph(
        frame(),
        [TARGET],
        CAMERA,
        settings=PhotographSettings(centroid=lambda beam: (PLACE, np.eye(2))),
    )
    with pytest.raises(InputError, match=r"uncertain: .*; a sighting needs a reliable spot"):
        sighting_of(unsure, "P6A", COUNTS, SITE)
