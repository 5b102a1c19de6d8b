"""PAINT: the real plant stands where the README of the data says; a heliostat survives writing."""

import json
from pathlib import Path

import numpy as np
import pytest

from heliotrope.field.formats import measurements, paint
from heliotrope.geometry import MRAD, geodetic_to_enu
from support.data import juelich


def test_targets_stand_where_they_were_surveyed() -> None:
    """Marker corners of the data's own description, ENU, to the centimetre it gives."""
    tower = paint.read_tower(juelich() / "tower-measurements.json")
    # Upper left (east), lower right (west) of each: E, U.
    wanted = {
        "solar_tower_juelich_upper": (4.32, 46.70, -4.30, 39.48),
        "solar_tower_juelich_lower": (4.33, 39.49, -4.29, 32.27),
        "multi_focus_tower": (-14.88, 55.17, -20.29, 48.78),
    }
    for target in tower.targets:
        east, top, west, bottom = wanted[target.name]
        np.testing.assert_allclose(target.corners[0, [0, 2]], [east, top], rtol=0, atol=0.03)
        np.testing.assert_allclose(target.corners[2, [0, 2]], [west, bottom], rtol=0, atol=0.04)
        yaw = np.arctan2(target.normal[0], target.normal[1])
        assert 2.7 * MRAD < yaw < 5.6 * MRAD
    assert tower.receivers[0].kind == "convex_cylinder"


def test_measurements_are_named_when_left_out() -> None:
    found = measurements.read_measurements(juelich())
    assert len(found) + len(found.left_out) == 1872
    assert all(": there is no UTIS centroid" in line for line in found.left_out)
    np.testing.assert_allclose(np.linalg.norm(found.sun, axis=1), 1.0, atol=1e-12)
    helios = measurements.read_measurements(juelich(), centroid="helios")
    assert len(helios) > len(found)
    # The published extractors differ by a tenth of a metre in the median.
    both = {i: k for k, i in enumerate(helios.ids)}
    rows = [(k, both[i]) for k, i in enumerate(found.ids) if i in both]
    a, b = np.array(rows).T
    apart = np.linalg.norm(found.centroid[a] - helios.centroid[b], axis=1)
    assert 0.05 < np.median(apart) < 0.15


def test_tower_is_read_as_published() -> None:
    tower = paint.read_tower(juelich() / "tower-measurements.json")
    published = json.loads((juelich() / "tower-measurements.json").read_text(encoding="utf-8"))
    assert tower.origin == tuple(published["power_plant_properties"]["coordinates"])
    names = ("upper_left", "upper_right", "lower_right", "lower_left")
    for target in tower.targets:
        places = published[target.name]["coordinates"]
        corners = [geodetic_to_enu(*places[name], tower.origin) for name in names]
        np.testing.assert_allclose(target.corners, corners, rtol=0, atol=2e-8)
        assert set(target.markers) == set(places) - {"center"}
    receiver = tower.receivers[0]
    given = published[receiver.name]
    assert receiver.opening_angle == pytest.approx(np.radians(given["opening_angle"]), abs=1e-15)
    center = geodetic_to_enu(*given["coordinates"]["center"], tower.origin)
    np.testing.assert_allclose(receiver.center, center, rtol=0, atol=2e-8)


def test_heliostat_survives_with_its_calibration(tmp_path: Path) -> None:
    plant = paint.read_plant(juelich())
    group = plant.groups["jacks"]
    changes = {
        "tilt_up": 1e-3, "tilt_north": -2e-3, "non_orthogonality": 3e-3, "elevation_bias": 4e-3,
        "azimuth_initial_angle": -5e-3, "elevation_stroke_offset": 1e-4, "azimuth_offset": 2e-4,
        "position_north": 0.03,
    }  # fmt: skip
    calibrated = group.with_parameters(changes)
    origin = plant.site.origin
    assert not paint.write_heliostat(calibrated, "AA39", origin, tmp_path / "AA39.json")
    again = paint.to_heliostats([paint.read_heliostat(tmp_path / "AA39.json")], origin)
    counts = np.random.default_rng(0).uniform(1000, 65000, (20, 2))
    wanted = calibrated.calibrated[group.index("AA39")].pose(counts)
    found = again.mechanism[0].pose(counts)
    np.testing.assert_allclose(found.normal, wanted.normal, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.vertex, wanted.vertex, rtol=0, atol=1e-7)
    assert (again.facets is None) == (group.facets is None)


def test_what_has_no_place_is_named(tmp_path: Path) -> None:
    plant = paint.read_plant(juelich())
    file, origin = tmp_path / "AA39.json", plant.site.origin
    lost = {"canting": 1e-3, "azimuth_scale": 2e-3}
    calibrated = plant.groups["jacks"].with_parameters({**lost, "azimuth_bias": 4e-3})
    named = paint.write_heliostat(calibrated, "AA39", origin, file)
    assert named == ("canting 0.001 rad", "azimuth_scale 0.002 1")
    # All else is there, the zero of the second jack in its initial angle.
    again = paint.to_heliostats([paint.read_heliostat(file)], origin)
    rest = plant.groups["jacks"].with_parameters({"azimuth_bias": 4e-3})
    counts = np.random.default_rng(0).uniform(1000, 65000, (20, 2))
    wanted = rest.calibrated[rest.index("AA39")].pose(counts)
    found = again.mechanism[0].pose(counts)
    np.testing.assert_allclose(found.normal, wanted.normal, rtol=0, atol=1e-12)


def test_both_styles_of_calibration_properties() -> None:
    folder = juelich() / "images"
    old = paint.read_calibration_properties(
        folder / "aa39-cropped" / "100733-calibration-properties.json"
    )
    new = paint.read_calibration_properties(
        next((folder / "target-camera").glob("*-calibration-properties.json"))
    )
    assert old.motors == (24282.0, 43957.0)
    assert np.isnan(old.sun_elevation_deg)
    assert new.sun_elevation_deg > 0
    assert set(old.focal_spots) == set(new.focal_spots) == {"HeliOS", "UTIS"}


def test_a_folder_as_the_fetcher_leaves_it(tmp_path: Path) -> None:
    """ID/Properties, ID/Calibration and the tower's file, instead of tables."""
    source = juelich()
    for part in ("AA39/Properties", "AA39/Calibration"):
        (tmp_path / part).mkdir(parents=True)
    text = (source / "properties" / "AA39.json").read_text()
    (tmp_path / "AA39/Properties/AA39-heliostat-properties.json").write_text(text)
    tower = (source / "tower-measurements.json").read_text()
    (tmp_path / "WRI1030197-tower-measurements.json").write_text(tower)
    plant = paint.read_plant(tmp_path)
    assert plant.names == ("AA39",)
    spot = [50.91339, 6.38782, 130.0]
    (tmp_path / "AA39/Calibration/7-calibration-properties.json").write_text(
        json.dumps(
            {
                "motor_position": {"axis_1_motor_position": 1, "axis_2_motor_position": 2},
                "target_name": "solar_tower_juelich_upper",
                "focal_spot": {"UTIS": spot},
                "sun_elevation": 30.0,
                "sun_azimuth": -20.0,
            }
        )
    )
    found = measurements.read_measurements(tmp_path)
    assert (found.heliostat, found.ids) == (("AA39",), ("7",))
    # 20° west of south.
    assert found.sun[0, 0] < 0 < -found.sun[0, 1]
    np.testing.assert_allclose(found.centroid[0], geodetic_to_enu(*spot, plant.site.origin))
