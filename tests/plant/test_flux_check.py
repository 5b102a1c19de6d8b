"""The flux on the receiver by its camera or a sensor, against the predicted one."""

import asyncio
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from heliotrope.field.target import Receiver
from heliotrope.geometry import FloatArray
from heliotrope.imaging.receiver_light import receiver_light
from heliotrope.optics import FieldOptics, Mirrors, Plate, Scene, surface_of
from heliotrope.plant.emergency import DNI_READING
from heliotrope.plant.io.receiver_flux import cell_places
from heliotrope.plant.operations.flux_check import CLEAR, HOLD, RAISE, FluxCheck, distance
from heliotrope.plant.operations.predicted_flux import predicted
from heliotrope.plant.operations.views import PredictedView
from heliotrope.safety import FLUX_READING, Alarm, alarms
from support.receiver_scene import CAMERA, RECEIVER, SUN, frame, mirrors, reference

#: Nominal power of the twenty mirrors, W; see the test of the camera's map.
SIZE = RECEIVER.width * RECEIVER.height


def view_of(on: int, aside: tuple[float, float] = (0.0, 0.0)) -> PredictedView:
    """The prediction for mirrors of the scene that the photographs show."""
    field = mirrors(20, np.array(aside))
    place, normal = (np.array([getattr(m, part) for m in field]) for part in ("vertex", "normal"))
    made = Mirrors.of(
        place, normal, (1.83, 1.22), RECEIVER.center, slope=3e-3, reflectivity=0.9,
        pointing=np.broadcast_to(2e-6 * np.eye(2), (20, 2, 2)),
    )  # fmt: skip
    plate = surface_of(RECEIVER)
    assert isinstance(plate, Plate)
    (view,) = predicted(
        Scene(SUN, 900.0, made, (plate,), dark=np.arange(20) >= on), FieldOptics(air="none")
    )
    return view


NOMINAL = view_of(20)


class Desk:
    """A check of a plant with one receiver; time and prediction are the test's."""

    def __init__(self, view: PredictedView, **receiver: Any) -> None:
        self.at, self.readings, self.told = 0.0, {DNI_READING: 900.0}, list[Alarm]()
        made = replace(RECEIVER, **{"nominal_power": NOMINAL.power, **receiver})
        table = SimpleNamespace(shown=lambda _: self.readings)
        plant = SimpleNamespace(
            design=SimpleNamespace(receivers=(made,)),
            now=lambda: self.at,
            sentinel=SimpleNamespace(table=table),
        )
        self.view, log = view, SimpleNamespace(take_alarm=self.told.append, stands=self.stands)
        flux = SimpleNamespace(everywhere=self.everywhere)
        self.check = FluxCheck(plant, flux, log)  # type: ignore[arg-type]

    async def everywhere(self) -> dict[str, PredictedView]:
        return {RECEIVER.name: self.view}

    def stands(self, kind: alarms.AlarmKind) -> bool:
        return bool(self.told) and self.told[-1].active and self.told[-1].condition == kind.name

    def minutes(self, count: float, seen: FloatArray | None = None, *, camera: bool = True) -> None:
        """Compare every ten seconds."""
        for _ in range(round(6 * count)):
            self.at += 10.0
            if camera:
                self.check.see(seen)
            asyncio.run(self.check.look())


def seen(on: int, aside: tuple[float, float] = (0.0, 0.0)) -> FloatArray:
    """The map that the camera sees."""
    light = receiver_light(frame(on, aside=aside), KNOWN, PLACES)
    assert light.cells is not None
    assert not light.doubt
    return light.cells


KNOWN, PLACES = reference(), cell_places(RECEIVER, CAMERA)


def test_a_right_map_raises_nothing_and_a_wrong_one_does() -> None:
    """Frames are rendered by the twin's own light, not by the engine."""
    desk = Desk(view_of(20))
    desk.minutes(5, seen(20))
    assert desk.told == []
    wrong = seen(20, (2.0, 0.0))
    desk.minutes(HOLD / 60.0, wrong)
    assert desk.told == [], "not before it has lasted"
    desk.minutes(0.5, wrong)
    (alarm,) = desk.told
    assert (alarm.condition, alarm.active) == ("flux_disagrees", True)
    assert "kW are measured" in alarm.text
    assert "standard deviations off" in alarm.text
    desk.minutes(5, wrong)
    assert len(desk.told) == 1, "raised once"
    desk.minutes(HOLD / 60.0, seen(20))
    assert len(desk.told) == 1, "not over at once"
    desk.minutes(0.5, seen(20))
    assert not desk.told[-1].active
    assert "agrees" in desk.told[-1].text


def test_a_passing_difference_raises_nothing() -> None:
    desk, right, wrong = Desk(view_of(20)), seen(20), seen(20, (2.0, 0.0))
    for _ in range(5):
        desk.minutes(1.5, wrong)
        desk.minutes(0.5, right)
    assert desk.told == []


def test_between_the_two_limits_nothing_changes() -> None:
    view = view_of(20)
    area, mean = SIZE, NOMINAL.power / SIZE

    def at(far: float) -> FloatArray:
        """A map at a distance, by secant."""
        low, high = 1.0, 4.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            near = distance(view, middle * view.flux, mean, area) < far
            low, high = (middle, high) if near else (low, middle)
        return low * view.flux / mean

    desk, middle = Desk(view), at(0.5 * (RAISE + CLEAR))
    desk.minutes(5, middle)
    assert desk.told == []
    desk.minutes(3, at(1.05 * RAISE))
    desk.minutes(5, middle)
    assert [alarm.active for alarm in desk.told] == [True]
    desk.minutes(3, at(0.95 * CLEAR))
    assert [alarm.active for alarm in desk.told] == [True, False]


@pytest.mark.parametrize(("share", "raised"), [(1.0, False), (1.25, False), (0.3, True)])
def test_a_sensor_gives_the_whole(share: float, raised: bool) -> None:
    desk = Desk(view_of(20))
    desk.readings[FLUX_READING] = share
    desk.minutes(5, camera=False)
    assert bool(desk.told) is raised


def test_what_cannot_be_compared_raises_nothing() -> None:
    dark = np.zeros(NOMINAL.flux.shape)
    for desk, map_ in (
        (Desk(view_of(20), nominal_power=0.0), dark),
        (Desk(view_of(20)), None),
        (Desk(view_of(20)), np.full(dark.shape, math.nan)),
    ):
        # Beside a camera that sees a part of the light, its lower bound is no measurement.
        desk.readings[FLUX_READING] = 0.2
        desk.minutes(5, map_)
        assert desk.told == []
    clouded = Desk(view_of(20))
    clouded.readings = {DNI_READING: math.nan}
    clouded.minutes(5, dark)
    assert clouded.told == []
    clouded.readings = {DNI_READING: 900.0}
    clouded.minutes(5, dark)
    assert clouded.told


def test_an_old_map_counts_no_more() -> None:
    desk = Desk(view_of(20))
    desk.check.see(np.ones(NOMINAL.flux.shape))
    assert desk.check.measured("receiver") is not None
    assert desk.check.measured("another") is None
    desk.at = 6.0
    assert desk.check.measured("receiver") is None


def test_only_a_camera_with_a_pose_maps_a_flat_receiver() -> None:
    lost = replace(CAMERA, position=None, R_enu_camera=None)
    round_ = Receiver("r", "external_cylinder", RECEIVER.center, np.eye(3)[1], 4.0, 6.0)
    assert cell_places(RECEIVER, lost) is None
    assert cell_places(round_, CAMERA) is None


def test_while_cells_have_no_uncertainty_the_whole_flux_is_compared() -> None:
    mean, area = NOMINAL.power / SIZE, SIZE
    unknown = replace(NOMINAL, sigma=np.full(NOMINAL.flux.shape, np.nan))
    map_ = 0.5 * NOMINAL.flux
    whole = distance(unknown, map_, mean, area)
    assert whole == pytest.approx(distance(unknown, np.asarray(map_.mean()), mean, area))
    assert whole > RAISE
    map_[0, 0] = np.nan
    assert math.isnan(distance(unknown, map_, mean, area))
