"""Flights: every pattern is flown once, mirrors are at rest, batteries and keep-outs are kept."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from heliotrope.airborne.plan import flight
from heliotrope.airborne.plan.airspace import Airspace, KeepOut, tower
from heliotrope.airborne.plan.calibration_points import PointSelection
from heliotrope.airborne.plan.clusters import clusters
from heliotrope.airborne.plan.flight import APART, REST, Craft, camera_target, grouped, timeline
from heliotrope.airborne.plan.flight_map import flight_map
from heliotrope.airborne.plan.flight_plan import (
    FlightPlan,
    PlanSettings,
    _check_patterns,
    plan_flight,
)
from heliotrope.airborne.plan.hover import mirrors
from heliotrope.errors import InputError
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.mechanism import kinds
from heliotrope.sun import Site
from support.flight_case import staggered

CRAFT = Craft(count=2, endurance=900.0)


@pytest.fixture(scope="module")
def plant() -> Plant:
    return staggered(400)


@pytest.fixture(scope="module")
def flown(plant: Plant) -> FlightPlan:
    wanted = PlanSettings(
        size=60.0, selection=PointSelection(points=9), craft=CRAFT, airspace=Airspace(tower(plant))
    )
    return plan_flight(plant, wanted)


def test_every_hover_point_is_photographed_once(flown: FlightPlan) -> None:
    seen = {(k, i): 0 for k, s in enumerate(flown.stations) for i in range(len(s.pattern))}
    for sortie in flown.sorties:
        for visit in sortie.visits:
            for i in range(visit.first, visit.last):
                seen[visit.station, i] += 1
    assert set(seen.values()) == {1}
    assert flown.photos == len(seen)
    assert len(flown.stations) == 9 * len(flown.clusters)


def test_batteries_last(flown: FlightPlan) -> None:
    for sortie in flown.sorties:
        assert 0.0 < sortie.end - sortie.start <= CRAFT.endurance
    for drone in range(2):
        mine = [s for s in flown.sorties if s.drone == drone]
        assert [s.number for s in mine] == list(range(len(mine)))
        for before, after in pairwise(mine):
            assert after.start >= before.end + CRAFT.change - 1e-9
            # No battery is changed while it could still have flown on for long.
            assert before.end - before.start > 0.6 * CRAFT.endurance


def test_mirrors_are_at_rest(flown: FlightPlan) -> None:
    visits = sorted((v.begin, v.end, v.station) for s in flown.sorties for v in s.visits)
    last: dict[int, tuple[float, int]] = {}
    for begin, end, row in visits:
        station = flown.stations[row]
        if station.cluster in last:
            left, point = last[station.cluster]
            assert station.point in (point, point + 1)
            if station.point == point + 1:
                assert begin >= left + station.travel + REST - 1e-6
        last[station.cluster] = (end, station.point)
    assert {point for _, point in last.values()} == {8}


def test_mirror_travel_from_the_drives(flown: FlightPlan) -> None:
    """20,000 counts a second, and the slowest mirror counts."""
    station = flown.stations[4]
    counts = flown.points[station.cluster].facing.counts
    slowest = np.abs(counts[4] - counts[3]).max() / 2.0e4
    assert station.travel == pytest.approx(slowest, rel=1e-9)


def test_drones_keep_away_from_all(flown: FlightPlan) -> None:
    air = flown.settings.airspace
    for drone in range(2):
        line = timeline(flown.sorties, flown.stations, CRAFT, drone)
        assert (np.diff(line.time) >= 0.0).all()
        assert air.free_legs(line.place[:-1], line.place[1:]).all()
        length = np.linalg.norm(np.diff(line.place, axis=0), axis=-1)
        assert (length <= CRAFT.speed * np.diff(line.time) + 1e-6).all()
    assert flown.separation >= APART - 1.0
    assert flight.separation(flown.sorties, flown.stations, CRAFT) == flown.separation


def test_groups_hide_the_mirrors(flown: FlightPlan) -> None:
    """With slow mirrors it is faster to fly other clusters meanwhile than to wait."""
    slow = [replace(s, travel=200.0 if s.point else 0.0) for s in flown.stations]
    air, home = flown.settings.airspace, flown.homes[:1]
    order = list(range(len(flown.clusters)))
    one = Craft(endurance=1500.0)
    best = flight.fly(slow, order, air, home, one, flown.labels)
    place = {c: [r for r, s in enumerate(slow) if s.cluster == c] for c in order}
    routes = flight._Routes(air, slow, flown.labels, {}, {})
    alone = flight._sorties_of(0, grouped(order, place, 1), slow, home[0], one, routes)
    waits = [sum(v.wait for s in sorties for v in s.visits) for sorties in (alone, best)]
    assert waits[1] < 0.3 * waits[0]
    assert best[-1].end < 0.9 * alone[-1].end


def test_grouped_order() -> None:
    place = {0: [0, 1], 1: [2, 3], 2: [4, 5], 3: [6, 7]}
    assert grouped([0, 1, 2, 3], place, 2) == [0, 2, 3, 1, 4, 6, 7, 5]
    assert grouped([0, 1, 2, 3], place, 1) == [0, 1, 2, 3, 4, 5, 6, 7]


def test_time_of_a_leg() -> None:
    craft = Craft(speed=8.0, acceleration=2.0)
    # 4 s to speed up on 16 m and as much to slow down.
    assert craft.time(32.0) == pytest.approx(8.0)
    assert craft.time(32.0 + 80.0) == pytest.approx(18.0)
    assert craft.time(0.5) == pytest.approx(1.0)


def test_a_narrow_lens_asks_for_small_clusters(flown: FlightPlan) -> None:
    """The farthest heliostat is half the field of view from the middle."""
    radius = 150.0 * np.tan(0.5 * np.radians(24.0))
    narrow = clusters(flown.plant.position, size=60.0, max_radius=radius)
    wanted = replace(flown.settings, view=float(np.radians(24.0)), craft=Craft())
    found = plan_flight(flown.plant, wanted).clusters
    assert found.radius.max() <= radius < flown.clusters.radius.max()
    assert len(found) == len(narrow)


def test_summary(flown: FlightPlan) -> None:
    figures = flown.summary()
    assert figures["heliostats"] == 400
    assert figures["orientations"] == 400 * 9
    assert figures["fewest_points_of_a_heliostat"] == 9
    assert figures["photographs"] == flown.photos
    assert figures["hours"] == pytest.approx(max(s.end for s in flown.sorties) / 3600.0)
    assert figures["camera_target"]["hours"] == pytest.approx(400 * 9 * 2.0 / 60.0)
    # One drone sees a cluster at a time: hours beside days.
    assert figures["hours"] < figures["camera_target"]["hours"] / 10.0


def test_map_shows_the_plan(flown: FlightPlan) -> None:
    figure = flight_map(flown)
    left, right = figure.axes[:2]
    dots = left.collections[0].get_offsets()
    np.testing.assert_allclose(np.asarray(dots), flown.plant.position[:, :2])
    assert {t.get_text() for t in left.texts} == set(flown.labels)
    assert right.name == "polar"


def test_camera_target_on_a_polar_day_and_night() -> None:
    equator = camera_target(Site(0.0, 0.0, 0.0), 6000, minutes=2.0, clear=1.0)
    assert equator.hours == pytest.approx(200.0)
    # 12.1 h above the horizon, of which 40 minutes at each end are lower than 10°.
    assert 10.4 < equator.sunny < 11.0
    assert equator.days == pytest.approx(200.0 / equator.sunny)
    half = camera_target(Site(0.0, 0.0, 0.0), 6000, minutes=2.0, targets=2, clear=0.5)
    assert half.days == pytest.approx(equator.days)
    with pytest.raises(InputError, match="minutes must be above 0, not 0"):
        camera_target(Site(0.0, 0.0, 0.0), 10, minutes=0.0)
    with pytest.raises(InputError, match="the sun never reaches an elevation of 60°"):
        camera_target(Site(85.0, 0.0, 0.0), 10, min_elevation=float(np.radians(60.0)))


def test_refusals(plant: Plant) -> None:
    def made(**changes: object) -> FlightPlan:
        wanted = PlanSettings(selection=PointSelection(points=9), airspace=Airspace(tower(plant)))
        return plan_flight(plant, replace(wanted, **changes))  # type: ignore[arg-type]

    with pytest.raises(InputError, match="leave no time for a photograph within 30 s"):
        made(craft=Craft(endurance=30.0))
    with pytest.raises(InputError, match=r"home at 0.0 m east, 0.0 m north: it is in a keep-out"):
        made(home=np.zeros(3))
    with pytest.raises(InputError, match="model malan8 has 8 unknowns"):
        made(selection=PointSelection(points=8))
    with pytest.raises(InputError, match="spread must be above 0° and at most 45°, not 60°"):
        made(spread=float(np.radians(60.0)))
    with pytest.raises(InputError, match="view must be above 0°"):
        made(view=0.0)
    with pytest.raises(InputError, match="the hours a day must be above 0"):
        made(hours_a_day=0.0)
    with pytest.raises(InputError, match="no heliostats"):
        plan_flight(plant.with_groups({}), PlanSettings())


def test_no_way_out(flown: FlightPlan) -> None:
    """A wall higher than is allowed stands all around the home point."""
    home = flown.homes[:1]
    ring = [(-30.0, -30.0), (30.0, -30.0), (30.0, 30.0), (-30.0, 30.0)]
    walls = [
        KeepOut(f"wall {k}", home[0, :2] + np.array([a, b, (a[0] * 1.1, a[1] * 1.1)]))
        for k, (a, b) in enumerate(zip(ring, ring[1:] + ring[:1], strict=True))
    ]
    air = Airspace(tuple(walls))
    with pytest.raises(InputError, match="calibration point 1: no free route there"):
        flight.fly(flown.stations, range(len(flown.clusters)), air, home, Craft(), flown.labels)


def test_a_drone_that_is_always_in_the_way(flown: FlightPlan) -> None:
    sortie = flown.sorties[0]
    line = timeline([sortie], flown.stations, CRAFT, sortie.drone)
    middle = line.place[len(line.place) // 2]
    other = flight.Timeline(np.array([0.0]), middle[None])
    with pytest.raises(InputError, match="drone 1 comes within 15 m of another"):
        flight._delay(sortie, flown.stations, CRAFT, [other])
    # One that leaves after a while is waited for.
    gone = flight.Timeline(
        np.array([0.0, sortie.end + 95.0, sortie.end + 96.0]),
        np.stack([middle, middle, middle + 1e4]),
    )
    late = flight._delay(sortie, flown.stations, CRAFT, [gone])
    assert 0.0 < late <= sortie.end + 110.0


def test_patterns_outside_the_limits(flown: FlightPlan) -> None:
    with pytest.raises(InputError, match=r"C1, calibration point 1: its pattern of \d+ by \d+"):
        _check_patterns(list(flown.stations), flown.labels, Airspace(max_height=20.0))


def test_single_axis_trackers_are_refused(plant: Plant) -> None:
    group = plant.groups["azel"]
    trough = Heliostats(
        ("T1",),
        kinds.single_axis(np.zeros((1, 3)), [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]),
        np.ones(1),
        np.ones(1),
    )
    both = plant.with_groups({"azel": group, "trough": trough})
    with pytest.raises(InputError, match="group trough: its mechanism has 1 drive"):
        mirrors(both)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"count": 0}, "drones must be between 1 and 50, not 0"),
        ({"speed": 20.0}, "speed must be above 0 and at most 15 m/s, not 20"),
        ({"endurance": 0.0}, "endurance must be above 0, not 0"),
        ({"change": -1.0}, "battery change must be 0 or more, not -1 s"),
    ],
)
def test_craft_refuses(change: dict[str, float], text: str) -> None:
    with pytest.raises(InputError, match=text):
        Craft(**change)  # type: ignore[arg-type]


@pytest.mark.slow
def test_ten_thousand_heliostats() -> None:
    """20 points each: hours of flight, beside years with camera and target."""
    large = staggered(10_000)
    wanted = PlanSettings(airspace=Airspace(tower(large)), craft=Craft(count=2))
    figures = plan_flight(large, wanted).summary()
    assert figures["orientations"] == 200_000
    assert 40 <= figures["clusters"] <= 60
    assert figures["hours"] < 100.0
    assert figures["camera_target"]["months"] > 24.0
    assert figures["separation_m"] >= APART - 1.0
