"""Mirrors that hide parts of each other: from the air they are told apart all the same."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from heliotrope.airborne.evaluate import projection, reading
from heliotrope.airborne.evaluate.detection import Overlap, find_spots
from heliotrope.airborne.evaluate.identification import rotation_angle
from heliotrope.airborne.photo import LedCamera, Photo, read_photos, rotation_of_gimbal
from heliotrope.airborne.simulate.rendered import (
    KINDS,
    Compared,
    fly_rendered,
    paper_field,
    paper_flight,
)
from heliotrope.airborne.simulate.simulation import Flight
from heliotrope.airborne.standing import MirrorPoses, standing
from heliotrope.airborne.visibility import draw_labels, seen_from
from heliotrope.sun import Site

MRAD = 1e-3
SITE = Site(50.9, 6.4, 80.0, name="test")


def lens(width: int = 900, height: int = 500) -> LedCamera:
    """Return the middle of a photograph of 4000 by 3000 pixels."""
    matrix = np.array([[3000.0, 0, width / 2], [0, 3000.0, height / 2], [0, 0, 1.0]])
    return LedCamera((width, height), matrix, np.array([-0.08, 0.06, 3e-4, -2e-4, -0.01]))


def walls(places: list[tuple[float, float]]) -> MirrorPoses:
    """Return upright mirrors, 2 m by 2 m, that face south."""
    n = len(places)
    turn = np.stack([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    outline = [[-1.0, 1, 0], [1.0, 1, 0], [1.0, -1, 0], [-1.0, -1, 0]]
    return MirrorPoses(
        tuple(map(str, range(n))),
        np.array([(x, y, 0.0) for x, y in places]),
        np.repeat(turn[None], n, 0),
        np.repeat([outline], n, 0),
    )


def test_nearer_mirrors_are_drawn_over_those_behind() -> None:
    square = np.array([[0.0, 0], [20, 0], [20, 20], [0, 20]])
    outlines = np.stack([square + 4.0, square + [14.0, 4.0]])
    labels = draw_labels(outlines, np.array([10.0, 20.0]), (40, 30))
    assert labels[10, 20] == 1
    assert labels[10, 30] == 2
    assert labels[2, 10] == 0
    assert draw_labels(outlines, np.array([20.0, 10.0]), (40, 30))[10, 20] == 2


def test_share_that_a_mirror_hides_is_that_of_the_geometry() -> None:
    # The hidden one stands 1 m to the side and a little behind: half of it is seen.
    seen = seen_from(walls([(0.0, 0.0), (1.0, 0.1), (9.0, 0.0)]), [0.0, -2000.0, 0.0], 1e5)
    np.testing.assert_allclose(seen.hidden, [0.0, 0.5, 0.0], atol=0.03)
    # 100 px wide, and 2 px of each edge are left out.
    np.testing.assert_allclose(seen.share[[0, 2]], 0.96**2, atol=0.03)
    assert seen.side[2] == pytest.approx(100.0, abs=1.0)
    assert seen.overlapping
    assert not seen_from(walls([(0.0, 0.0), (9.0, 0.0)]), [0.0, -2000.0, 0.0], 1e5).overlapping
    assert seen_from(walls([(0.0, 0.0)]), [0.0, 2000.0, 0.0], 1e5).share.tolist() == [0.0]


@dataclass(frozen=True)
class Case:
    flown: Flight
    folder: Path
    compared: Compared

    def photos(self) -> tuple[Photo, ...]:
        found, problems = read_photos(
            self.folder, (SITE.latitude_deg, SITE.longitude_deg, SITE.height)
        )
        assert problems == ()
        return found


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """Return four photographs of a slice of a field in the paper's geometry, evaluated."""
    flown, plant = paper_flight(lens(), SITE, mirrors=paper_field(rows=4, columns=4))
    middle = [16, 17, 24, 25]
    flown = replace(
        flown,
        taken=tuple(flown.taken[k] for k in middle),
        recorded=tuple(flown.recorded[k] for k in middle),
    )
    folder = tmp_path_factory.mktemp("paper")
    return Case(flown, folder, fly_rendered(flown, plant, folder))


def test_photographs_in_the_papers_geometry_are_used(case: Case) -> None:
    found = case.compared
    assert found.used == found.photographs == 4
    assert found.shown > 30
    assert found.found > 0.8 * found.shown
    assert found.identified > 0.98
    # Reflections that are not found are those beside another one, or near an edge.
    assert tuple(found.missed) == KINDS
    assert 0 < sum(found.missed.values()) < 0.2 * found.shown
    assert found.missed["clear"] <= 0.02 * found.shown


def test_gimbal_is_corrected(case: Case) -> None:
    stand = standing(case.flown.heliostats, case.flown.counts)
    for photo, taken in zip(case.photos(), case.flown.taken, strict=True):
        seen = reading.read_photo(photo, case.flown.camera, stand)
        assert rotation_angle(photo.rotation, taken.rotation) > 2.0 * MRAD
        # About the line of sight a small field tells less.
        assert np.linalg.norm((seen.rotation - taken.rotation)[:, 2]) < 0.2 * MRAD
        assert rotation_angle(seen.rotation, taken.rotation) < 2.0 * MRAD


def test_another_field_is_not_believed(case: Case) -> None:
    rng = np.random.default_rng(3)
    stand = standing(case.flown.heliostats, case.flown.counts)
    moved = replace(stand, vertex=stand.vertex + rng.uniform(-5.0, 5.0, (16, 3)) * [1, 1, 0])
    assert reading.read_photo(case.photos()[0], case.flown.camera, moved).problem


def test_rows_without_an_end_are_ambiguous() -> None:
    camera, away = lens(), 150.0
    photo = Photo("a", None, np.array([0.0, -away, 0.0]), rotation_of_gimbal(0.0, 0.0, 0.0))
    row = [(2.5 * k, 0.0) for k in range(-12, 13)]
    stand = walls([*row, *((x + 0.6, 4.0) for x, _ in row)])
    labels = draw_labels(*projection.outlines(photo, camera, stand), camera.size)
    picture = np.repeat(np.where(labels > 0, 200, 90).astype(np.uint8)[..., None], 3, axis=2)
    assert projection.overlay(picture, camera, photo, stand).reason.startswith("ambiguous")
    # A gap in the rows tells where the camera looks.
    rest = stand.take([k for k in range(len(stand)) if k not in (10, 11, 35)])
    labels = draw_labels(*projection.outlines(photo, camera, rest), camera.size)
    picture = np.repeat(np.where(labels > 0, 200, 90).astype(np.uint8)[..., None], 3, axis=2)
    found = projection.overlay(picture, camera, photo, rest)
    assert found.reason == ""
    assert rotation_angle(found.rotation, photo.rotation) < 1.0 * MRAD


def light_of(
    corners: list[tuple[np.ndarray, float]], spots: list[tuple[float, float]]
) -> np.ndarray:
    """Return a picture of squares (corners, light) over dark ground, with spots of the lamp."""
    scale, size = 8, 110
    fine = np.full((size * scale, size * scale), 0.13)
    for outline, light in corners:
        places = np.round((outline + 0.5) * scale - 0.5).astype(np.int32)
        cv2.fillConvexPoly(fine, places, light)
    image = fine.reshape(size, scale, size, scale).mean(axis=(1, 3))
    y, x = np.mgrid[:size, :size]
    for a, b in spots:
        image += 0.9 * np.exp(-0.5 * ((x - a) ** 2 + (y - b) ** 2) / 0.3)
    image = cv2.GaussianBlur(image, (0, 0), 0.8)
    image += np.random.default_rng(5).normal(0.0, 0.004, image.shape)
    share = np.clip(image, 0.0, 1.0)
    curve = np.where(share <= 0.0031308, 12.92 * share, 1.055 * share ** (1 / 2.4) - 0.055)
    return np.repeat(np.round(255.0 * curve).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize("off", [0.0, 0.8, 1.6])
@pytest.mark.parametrize("beside", [0.5, 0.56, 0.7])
def test_light_of_a_mirror_beside_is_no_spot(off: float, beside: float) -> None:
    """A corner between dark ground and a mirror behind; survey and kinematics leave it ``off``."""
    square = np.array([[0.0, 0.0], [44.0, 0.0], [44.0, 40.0], [0.0, 40.0]])
    front, behind = square + [8.0, 12.0], square + [50.0, 47.0]
    known = front + [off, off]
    labels = draw_labels(np.stack([known, behind]), np.array([10.0, 20.0]), (110, 110))

    def found(spots: list[tuple[float, float]]) -> np.ndarray:
        picture = light_of([(behind, beside), (front, 0.5)], spots)
        seen, reasons = find_spots(picture, known[None], shown=Overlap(labels, np.array([1])))
        assert reasons == ("",)
        return seen.pixel

    assert len(found([])) == 0
    # The lamp is found all the same, 4 px from that corner too; near an edge its light is cut.
    for place, error in (((47.0, 46.5), 0.4), ((30.0, 30.0), 0.1), ((10.7, 30.0), 0.8)):
        np.testing.assert_allclose(found([place]), [place], atol=error)
    # A spot of the mirror behind, whose light is also seen over the edge of the known outline.
    assert len(found([(53.7 + off, 50.5 + off)])) == 0


@pytest.mark.parametrize("apart", [4.5, 6.0, 8.0])
def test_two_spots_close_to_each_other_are_both_found(apart: float) -> None:
    """The light of one is no bright surrounding of the other, and does not draw its centre."""
    front = np.array([[20.0, 20.0], [90.0, 20.0], [90.0, 90.0], [20.0, 90.0]])
    labels = draw_labels(front[None], np.array([10.0]), (110, 110))
    places = [(50.0, 55.0), (50.0 + 0.8 * apart, 55.0 + 0.6 * apart)]
    picture = light_of([(front, 0.5)], places)
    seen, _ = find_spots(picture, front[None], shown=Overlap(labels, np.array([1])))
    assert len(seen) == 2
    np.testing.assert_allclose(seen.pixel[np.argsort(seen.pixel[:, 0])], places, atol=0.25)


@pytest.mark.parametrize("other", [0.45, 0.55])
def test_gaps_between_facets_are_no_spots(other: float) -> None:
    """Where gaps cross, the corners of facets are brighter than their surroundings."""
    front = np.array([[20.0, 20.0], [90.0, 20.0], [90.0, 90.0], [20.0, 90.0]])
    labels = draw_labels(front[None], np.array([10.0]), (110, 110))
    quarter = np.array([[0.0, 0.0], [34.6, 0.0], [34.6, 34.6], [0.0, 34.6]])
    facets = [
        (quarter + [20.0 + 35.4 * a, 20.0 + 35.4 * b], 0.5 if a == b else other)
        for a in (0, 1)
        for b in (0, 1)
    ]
    picture = light_of(facets, [])
    seen, _ = find_spots(picture, front[None], shown=Overlap(labels, np.array([1])))
    assert len(seen) == 0
