"""Standby points spread beside the receiver, and a year of glare."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from heliotrope.cli.field import noon_suns
from heliotrope.errors import FormatError, InputError
from heliotrope.field.layouts import lay_out, malan_plant
from heliotrope.field.plant import Plant
from heliotrope.field.points import read_points, write_points
from heliotrope.geometry import FloatArray
from heliotrope.optics.beam import NOMINAL_DNI, SUN_RADIUS, concentration, crossing
from heliotrope.optics.glare import Hazard, glare_of_one
from heliotrope.optics.standing import hours_of_the_year
from heliotrope.plant.motion.standby import LONGEST_RETURN, StandbyField

PLANT = malan_plant(150)
LIMIT = 60.0


@cache
def field() -> StandbyField:
    return StandbyField(PLANT, noon_suns(PLANT.site.latitude_deg))


@cache
def spread() -> FloatArray:
    return field().spread(LIMIT)


def test_spread_points_keep_the_limit_and_the_return() -> None:
    today, rest = field().rest(field().today), field().rest(spread())
    assert all(light.suns > 5.0 * LIMIT for light in today.light)
    assert all(0.5 * LIMIT < light.suns <= light.bound <= LIMIT for light in rest.light)
    assert (rest.returns <= LONGEST_RETURN * today.returns).all()
    assert sum(rest.blocked) <= sum(today.blocked)
    random = np.random.default_rng(4)
    for sun in field().suns:
        poses = field().check.poses(np.arange(len(PLANT)), spread(), sun)
        beams = field().check.together(poses.best_angles, sun)
        near = np.linalg.norm(spread() - beams.origin, axis=-1)
        along = near[:, None] + random.normal(0.0, 15.0, (len(PLANT), 60))
        points = beams.point(np.maximum(along, 1.0)).reshape(-1, 3)
        assert crossing(beams, points, dni=1.0).irradiance.max() <= LIMIT


def test_the_limit_that_a_spread_keeps_bounds_its_light() -> None:
    """The search for the strongest light ends earlier, at a bound that is farther away."""
    plant, limit = lay_out("radial", 100), 153.0
    field = StandbyField(plant, noon_suns(plant.site.latitude_deg))
    points = field.spread(limit)
    assert max(light.bound for light in field.rest(points).light) > limit
    assert all(light.suns < light.bound <= limit for light in field.rest(points, limit).light)


def test_no_beam_at_a_spread_point_passes_a_receiver_or_a_target() -> None:
    origin = field().check.armature.origin_1
    ray = spread() - origin
    ray /= np.linalg.norm(ray, axis=-1)[:, None]
    for surface in (*PLANT.receivers, *PLANT.targets):
        to = surface.center - origin
        off = np.linalg.norm(np.cross(ray, to), axis=-1)
        assert off.min() > 0.5 * min(surface.width, surface.height)


def test_a_limit_that_no_spread_keeps_is_refused_with_one_that_holds() -> None:
    with pytest.raises(
        InputError, match=r"no spread stays below 4 suns: .* suns at \(.*\) m"
    ) as refused:
        field().spread(4.0)
    found = re.search(r"a limit of (\d+) suns can be met", str(refused.value))
    assert found is not None
    holds = float(found[1])
    assert 4.0 < holds < LIMIT
    points = field().spread(holds)
    assert all(light.bound <= holds for light in field().rest(points).light)


def test_spread_points_at_an_eye_are_refused() -> None:
    eye = spread()[0] + 0.2 * (field().check.armature.origin_1[0] - spread()[0])
    seen = replace(PLANT, eyes={"balcony": eye})
    with pytest.raises(InputError, match=r"shines on the point .*limit 1.*, or another limit"):
        StandbyField(seen, field().suns).spread(LIMIT)


@pytest.mark.parametrize("change", [{"receivers": ()}, {"groups": {}}])
def test_a_plant_without_receiver_or_heliostats_is_refused(change: dict[str, object]) -> None:
    bare: Plant = replace(PLANT, **change)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="need one receiver and at least one heliostat"):
        StandbyField(bare, field().suns)


def test_a_heliostat_without_a_standby_point_is_refused() -> None:
    group = PLANT.groups["azel"]
    machines = (replace(group.machines[0], standby=None), *group.machines[1:])
    bare = replace(PLANT, groups={"azel": replace(group, machines=machines)})
    with pytest.raises(InputError, match=f"heliostat {group.names[0]} has no standby point"):
        StandbyField(bare, field().suns)


def test_a_year_of_glare_of_one_mirror_is_that_by_hand() -> None:
    one = malan_plant(1)
    suns, hours = hours_of_the_year(float(np.radians(one.site.latitude_deg)))
    assert hours.sum() == pytest.approx(365.25 * 12.0, rel=0.01)
    field = StandbyField(one, suns)
    origin, standby = field.check.armature.origin_1[0], field.today[0]
    ray = (standby - origin) / np.linalg.norm(standby - origin)
    near = np.linalg.norm(standby - origin)
    eyes = np.stack([standby, origin + 5.0 * near * ray, origin - 10.0 * ray])
    years = field.glare(field.today, eyes, hours)
    focus = float(np.linalg.norm(field.center - origin))
    for eye, year in zip(eyes[:2], years, strict=False):
        away = np.linalg.norm(eye - origin)
        seen = float(concentration(away, 5.0, focus))
        by_hand = glare_of_one(NOMINAL_DNI * seen, 2.0 * SUN_RADIUS * np.sqrt(seen))
        assert year.suns == pytest.approx(seen, rel=0.03)  # the vertex moves about the pivot
        assert year.hazard == by_hand.hazard
        assert year.hours[int(by_hand.hazard)] == pytest.approx(hours.sum(), rel=0.02)
    assert years[0].hazard == Hazard.DAMAGE > years[1].hazard
    assert years[2].suns == 0.0
    assert years[2].hours[0] == pytest.approx(hours.sum())


def test_points_are_read_as_they_were_written(tmp_path: Path) -> None:
    file = tmp_path / "points.csv"
    write_points(file, PLANT.names, spread())
    found = read_points(file, PLANT.names)
    assert tuple(found) == PLANT.names
    np.testing.assert_allclose(np.stack(list(found.values())), spread(), atol=6e-4)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("heliostat,east_m,north_m\nA,1,2\n", "up_m"),
        ("heliostat,east_m,north_m,up_m\nA,1,2,x\n", "line 2, column up_m: heliostat A"),
        ("heliostat,east_m,north_m,up_m\nB,1,2,3\n", "B"),
        ("heliostat,east_m,north_m,up_m\nA,1,2,3\nA,1,2,3\n", "names a heliostat twice"),
        ("heliostat,east_m,north_m,up_m\n", "has no rows"),
    ],
)
def test_unusable_tables_of_points_are_refused(text: str, error: str, tmp_path: Path) -> None:
    file = tmp_path / "points.csv"
    file.write_text(text)
    with pytest.raises((FormatError, InputError), match=error):
        read_points(file, ("A",))
