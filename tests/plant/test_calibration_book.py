"""The calibration of every heliostat, for people: predicted errors grow until the next visit."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import cast

import numpy as np
import numpy.typing as npt
import pytest

from heliotrope.calibration.learn import drift
from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.field.example import example_plant
from heliotrope.field.plant import Plant
from heliotrope.geometry import MRAD, FloatArray, as_float, direction
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.mechanism.tracking import track
from heliotrope.plant.controller import PlantController
from heliotrope.plant.field.beliefs import Beliefs
from heliotrope.plant.operations.calibration_book import CalibrationBook
from heliotrope.twin.boards.outfit import outfits
from heliotrope.twin.invariants.visits import across, slope_of
from heliotrope.twin.world.design import design_of
from heliotrope.twin.world.scene import scene_of

NAME = "P1A"


class Names:
    """The rows of a field."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.place = self.names.index
        self.heard = np.zeros((len(names), 2))

    def counts(self, rows: npt.NDArray[np.intp]) -> FloatArray:
        return self.heard[rows]

    def __len__(self) -> int:
        return len(self.names)


class Scene:
    """What the book asks of a plant; the sun stands still, so only age changes a prediction."""

    def __init__(self, design: Plant | None = None) -> None:
        self.design = design or example_plant()
        self.beliefs, self.clock = Beliefs(self.design), self
        self.field = Names(self.design.names)
        self.at = datetime(2026, 6, 21, 10, 0, tzinfo=UTC)
        self.sun = direction(np.radians(150.0), np.radians(50.0))

    def utc(self) -> datetime:
        return self.at

    def sun_vector(self) -> FloatArray:
        return self.sun

    def default_aims(self, names: list[str]) -> dict[str, FloatArray]:
        return dict.fromkeys(names, self.design.receivers[0].center)

    def calibrate(self, name: str) -> HeliostatCalibration:
        zeros = drift.zeros(self.beliefs.nominal(name))
        covariance, prior = np.diag(np.full(2, (0.2 * MRAD) ** 2)), np.full(2, 10 * MRAD)
        at = self.at.timestamp()
        record = HeliostatCalibration(name, at, zeros, np.zeros(2), covariance, prior)
        return self.beliefs.take(record)


def test_nothing_is_predicted_of_mirrors_that_were_never_calibrated() -> None:
    scene = Scene()
    book = CalibrationBook(cast("PlantController", scene), "malan8")
    book.refresh()
    assert np.isnan(book.error).all()
    assert np.isnan(book.error_on(scene.design.targets[0], np.arange(len(scene.field)))).all()


def test_the_predicted_error_grows_until_the_mirror_is_measured_again() -> None:
    scene = Scene()
    book, errors = CalibrationBook(cast("PlantController", scene), "malan8"), []
    row = scene.field.place(NAME)
    scene.calibrate(NAME)
    for _ in range(4):
        errors.append(float(book.error[row]))
        scene.at += timedelta(days=10)
        book.refresh()
    assert (np.diff(errors) > 0.05 * MRAD).all()
    # The zeros alone are believed: both have grown by the same variance.
    grown = np.sqrt(0.2**2 + 2.0 * (1.0 - np.exp(-0.1)) + 0.03) / 0.2
    assert errors[3] / errors[0] == pytest.approx(grown, rel=1e-6)
    scene.calibrate(NAME)
    assert book.error[row] == pytest.approx(errors[0], rel=1e-6)


def test_the_last_predictions_stay_over_the_night() -> None:
    scene = Scene()
    book = CalibrationBook(cast("PlantController", scene), "malan8")
    scene.calibrate(NAME)
    before = book.error.copy()
    scene.sun, scene.at = -scene.sun, scene.at + timedelta(hours=12)
    book.refresh()
    np.testing.assert_array_equal(book.error, before)


def test_the_error_before_a_calibration_is_that_under_the_sun_as_it_stands() -> None:
    """At night it is that under a sun overhead."""
    scene, up = Scene(), direction(0.0, np.radians(90.0))
    installed = []
    for sun in (direction(np.radians(100.0), np.radians(10.0)), up, -up):
        scene.sun = sun
        installed.append(CalibrationBook(cast("PlantController", scene), "malan8").installed())
    low, overhead, night = (each / MRAD for each in installed)
    assert night == pytest.approx(overhead)
    assert low == pytest.approx(14.3, abs=0.1)
    assert overhead == pytest.approx(16.9, abs=0.1)


def test_the_predicted_error_is_that_of_the_pose_that_the_mirror_takes() -> None:
    """Without stops a mirror reaches its aim in two poses, whose errors differ."""
    world = scene_of((), 1, 60.0, 3)
    fits = outfits(3, 1, world.places)
    names = [fit.name for fit in fits]
    scene = Scene(design_of(fits, {"C1": names}, world))
    nominal, aim = scene.beliefs.nominal(names[0])[0], scene.design.receivers[0].center
    poses = [track(nominal, scene.sun, aim, branch=branch).best_counts for branch in (0, 1)]
    model = parameter_table.model("malan8", scene.design.groups["all"].mechanism.parameters)
    zeros, at = np.zeros(len(model)), scene.at.timestamp()
    record = HeliostatCalibration(names[0], at, model, zeros, 1e-6 * np.eye(len(model)), zeros + 1)
    # One combination of parameters is left open, which moves the beam in the other pose only.
    slope = slope_of(record, nominal, poses[0], scene.sun, aim)
    free = np.linalg.svd(slope.T)[2][-1]
    covariance = 1e-6 * np.outer(free, free) + 1e-12 * np.eye(len(model))
    scene.beliefs.take(replace(record, covariance=covariance))
    found = []
    for pose in poses:
        scene.field.heard[0] = pose
        found.append(CalibrationBook(cast("PlantController", scene), "malan8").error[0])
    assert 0.0 < found[0] < 1e-5
    assert found[1] > 1e-4


def test_the_simulation_expects_the_error_that_the_plant_shows() -> None:
    """By differences of true beams: a mirror that stands elsewhere moves its beam, too."""
    world = scene_of((), 1, 60.0, 3)
    fits = outfits(3, 1, world.places)
    name = fits[0].name
    scene = Scene(design_of(fits, {"C1": [fit.name for fit in fits]}, world))
    nominal, aim = scene.beliefs.nominal(name)[0], scene.design.receivers[0].center
    counts = track(nominal, scene.sun, aim, branch=0).best_counts
    scene.field.heard[0] = counts
    model = ("position_east", "position_north", "position_up", "tilt_north", "tilt_east")
    zeros, at = np.zeros(len(model)), scene.at.timestamp()
    record = HeliostatCalibration(name, at, model, zeros, np.eye(len(model)), zeros + 1)
    sideways = across(aim - nominal.pose(counts).vertex)
    slope = slope_of(record, nominal, counts, scene.sun, aim) @ sideways.T
    # A photograph has shown where the beam goes, so what is not known of the place and of the tilt
    # hides each other.
    known = np.diag([0.05**-2] * 3 + [0.01**-2] * 2) + slope @ slope.T / 0.2e-3**2
    covariance = as_float(np.linalg.inv(known))
    scene.beliefs.take(replace(record, covariance=covariance))
    shown = CalibrationBook(cast("PlantController", scene), model).error[0]
    expected = 0.5 * np.sqrt(np.trace(slope.T @ covariance @ slope))
    assert shown == pytest.approx(expected, rel=1e-3)
    assert shown == pytest.approx(0.5 * np.sqrt(2.0) * 0.2e-3, rel=0.01)
