"""A night without moon: of the mirrors nothing is seen but the lamp on them."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from heliotrope.airborne.evaluate.bundle import Priors
from heliotrope.airborne.evaluate.campaign import evaluate_campaign
from heliotrope.airborne.evaluate.evaluation import evaluate
from heliotrope.airborne.evaluate.folder import FlightData
from heliotrope.airborne.evaluate.identification import expected_feet
from heliotrope.airborne.evaluate.orientation import measure_field, rotation_between
from heliotrope.airborne.evaluate.reading import PhotoReading, look
from heliotrope.airborne.evaluate.reflections import Reflections
from heliotrope.airborne.mirror import ideal, measured_normal
from heliotrope.airborne.simulate import rendering
from heliotrope.airborne.simulate.simulation import Errors, Flight, exact_reflections
from heliotrope.airborne.standing import MirrorPoses, standing
from heliotrope.errors import InputError
from support.drone_case import camera, flight

MRAD = 1e-3
PRIORS = Priors(offset=0.005, position=0.005)


@dataclass(frozen=True)
class Night:
    flown: Flight
    exact: Reflections
    stand: MirrorPoses
    seen: tuple[PhotoReading, ...]

    def shape(self, row: int):
        return ideal(self.flown.heliostats, row)


@pytest.fixture(scope="module")
def night() -> Night:
    flown = flight(Errors(), columns=3, rows=3, step=0.6, lens=camera(640, 480))
    exact = exact_reflections(flown)
    scene = rendering.FlightScene(flown.truth, flown.shapes, 0.0, rendering.dark())
    stand = standing(flown.heliostats, flown.counts)
    seen = []
    for k, (taken, told) in enumerate(zip(flown.taken, flown.recorded, strict=True)):
        lamp = exact.take(np.flatnonzero(exact.photo == k))
        picture = rendering.render(scene, flown.camera, taken, lamp, 5 + k)
        assert np.median(picture) < 5
        seen.append(look(picture, told, flown.camera, stand))
    return Night(flown, exact, stand, tuple(seen))


def test_lights_are_told_by_where_they_are_expected(night: Night) -> None:
    good = [k for k, s in enumerate(night.seen) if not s.problem]
    assert len(good) >= 7
    right = there = 0
    for k in good:
        seen = night.seen[k]
        assert not np.isfinite(seen.corners).any()
        true = night.exact.take(np.flatnonzero(night.exact.photo == k)).heliostat
        there += len(true)
        # As many lights on each mirror as there are.
        found, real = (np.bincount(rows, minlength=20) for rows in (seen.spot_mirror, true))
        right += int(np.minimum(found, real).sum())
        assert np.maximum(found - real, 0).sum() <= 0.005 * len(true)
    assert right > 0.93 * there


def test_orientations_at_night_are_as_good_as_they_say(night: Night) -> None:
    flown = night.flown
    found = evaluate(
        flown.recorded, night.seen, flown.camera, night.stand, night.shape, priors=PRIORS
    )
    measured = measure_field(
        found.reflections,
        night.stand.names,
        flown.shapes.__getitem__,
        night.stand.rotation,
        found.stand.vertex,
        places=found.place_covariance,
    )
    good = [o for o in measured.found if o.count >= 3]
    rows = [o.heliostat for o in good]
    off = np.array(
        [rotation_between(flown.truth.rotation[o.heliostat], o.rotation)[:2] for o in good]
    )
    told = np.array([o.sigma_total for o in good])
    asked = np.array(
        [rotation_between(flown.truth.rotation[r], night.stand.rotation[r])[:2] for r in rows]
    )
    assert len(good) >= 15
    # The commands were off by 2 to 3 mrad; what is left is what all share.
    assert np.sqrt(np.mean(asked**2)) > 1.8 * MRAD
    assert np.sqrt(np.mean(off**2)) < 0.8 * MRAD
    assert np.sqrt(np.mean((off - off.mean(axis=0)) ** 2)) < 0.35 * MRAD
    assert 0.4 * MRAD < np.sqrt(np.mean(told**2)) < 1.0 * MRAD
    assert np.mean(np.abs(off) < 1.645 * told) > 0.85


def test_feet_are_where_flat_mirrors_show_the_lamp(night: Night) -> None:
    photo, lens, stand = night.flown.recorded[4], night.flown.camera, night.stand
    feet, rows = expected_feet(photo, lens, stand)
    assert len(rows) > 10
    many = np.ones((len(rows), 1))
    normal = measured_normal(feet, photo.position * many, photo.led_position(lens) * many)
    # The lamp is taken for half way between it and the camera: micrometres at this distance.
    np.testing.assert_allclose(normal, stand.rotation[rows, :, 2], atol=1e-5)


def test_a_dark_flight_stands_beside_the_others(night: Night) -> None:
    flown = night.flown
    heliostats = np.arange(20)
    shapes = tuple(night.shape(row) for row in range(20))
    field = (flown.camera, night.stand, heliostats, flown.counts, shapes)
    dark = FlightData("dark", flown.recorded, *field, seen=night.seen)
    broken = tuple(PhotoReading(s.name, "nothing: at all") for s in night.seen)
    found = evaluate_campaign([dark, replace(dark, name="none", seen=broken)], PRIORS)
    assert found.flights[0] is not None
    assert found.flights[1] is None
    assert found.problems[1][-1] == "none of its 9 photographs can be used"
    np.testing.assert_allclose(np.sqrt(np.diag(found.offset_covariance)), 0.005)


def test_too_few_lights_say_so(night: Night) -> None:
    few = [
        replace(s, spot_mirror=s.spot_mirror[:1], spot=s.spot[:1], spot_sigma=s.spot_sigma[:1])
        for s in night.seen[:1]
    ]
    with pytest.raises(InputError, match="1 mirrors show the lamp; 4 are needed"):
        evaluate(night.flown.recorded[:1], few, night.flown.camera, night.stand, night.shape)
    black = np.zeros((480, 640, 3), np.uint8)
    one = look(black, night.flown.recorded[0], night.flown.camera, night.stand)
    assert one.problem == "nothing: the photograph is dark and shows only 0 lights; 4 are needed"
