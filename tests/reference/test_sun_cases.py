"""The sun against stored SPA and ERFA positions, and against ERFA itself."""

import json
from pathlib import Path
from typing import Any

import erfa
import numpy as np
import pytest

from heliotrope import sun
from heliotrope.geometry import MRAD, FloatArray, angle_between, as_float, direction
from reference import cases

# The stored SPA positions were computed with this TT − UT1.
DELTA_T = 69.2


def site(case: dict[str, Any]) -> sun.Site:
    return sun.Site(case["lat"], case["lon"], case["height_m"], name=case["site"], delta_t=DELTA_T)


@pytest.mark.parametrize("case", cases.params("sun"))
def test_case(case: dict[str, Any]) -> None:
    position = sun.position(case["utc"], site(case))

    spa_azimuth, spa_elevation = np.radians(
        [case["spa_azimuth_deg"], case["spa_elevation_unrefracted_deg"]]
    )
    assert position.azimuth == pytest.approx(spa_azimuth, abs=1e-7)
    assert position.true_elevation == pytest.approx(spa_elevation, abs=1e-7)

    erfa_vector = direction(
        np.radians(case["azimuth_deg"]), np.radians(case["elevation_unrefracted_deg"])
    )
    assert angle_between(position.true_vector, erfa_vector) < 0.005 * MRAD


def erfa_sun(unix: FloatArray, place: sun.Site) -> FloatArray:
    """Return the topocentric, unrefracted sun of IAU 2006/2000A, ENU, shape (n, 3).

    UT1 = UTC, no polar motion, light time and annual and diurnal aberration included.
    """
    days = np.floor(unix / 86400.0)
    ut = 2440587.5 + days, unix / 86400.0 - days
    tt = ut[0], ut[1] + DELTA_T / 86400.0
    heliocentric, earth = erfa.epv00(*tt)
    light_days = np.linalg.norm(heliocentric["p"], axis=-1) * erfa.AULT / 86400.0
    then_heliocentric, then_earth = erfa.epv00(tt[0], tt[1] - light_days)

    longitude, latitude = np.radians([place.longitude_deg, place.latitude_deg])
    # Observer in the inertial frame, in au and au a day: the Earth's spin included.
    observer = erfa.pvtob(longitude, latitude, place.height, 0.0, 0.0, 0.0, erfa.era00(*ut))
    to_intermediate = erfa.c2i06a(*tt)
    to_inertial = np.swapaxes(to_intermediate, -1, -2)
    place_p = np.einsum("nij,nj->ni", to_inertial, observer["p"]) / erfa.DAU
    place_v = np.einsum("nij,nj->ni", to_inertial, observer["v"]) / erfa.DAU * 86400.0

    seen = then_earth["p"] - then_heliocentric["p"] - (earth["p"] + place_p)
    distance = np.linalg.norm(seen, axis=-1)
    velocity = (earth["v"] + place_v) * erfa.AULT / 86400.0
    slowness = np.sqrt(1.0 - np.sum(velocity**2, axis=-1))
    proper = erfa.ab(seen / distance[:, None], velocity, distance, slowness)

    terrestrial = np.einsum(
        "nij,njk,nk->ni", erfa.rz(erfa.era00(*ut), np.eye(3)), to_intermediate, proper
    )
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    R_enu_itrs = np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
    return as_float(terrestrial @ R_enu_itrs.T)


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg"), [(50.9, 6.4), (-33.9, 18.9), (23.0, -115.0), (0.0, 179.0)]
)
def test_erfa_at_any_hour(latitude_deg: float, longitude_deg: float) -> None:
    rng = np.random.default_rng(4)
    start, stop = (np.datetime64(year, "s").astype(float) for year in ("2020", "2035"))
    unix = rng.uniform(start, stop, 500)
    place = sun.Site(latitude_deg, longitude_deg, 1200.0, delta_t=DELTA_T)
    error = angle_between(sun.vector(unix, place, apparent=False), erfa_sun(unix, place))
    assert error.max() < 0.005 * MRAD


def test_a_missing_folder_of_cases_fails(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HELIOTROPE_CASES", str(tmp_path / "nowhere"))
    with pytest.raises(pytest.fail.Exception, match="nowhere, which is not a folder"):
        cases.load("sun")


def test_cases_of_several_folders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("HELIOTROPE_CASES", raising=False)
    own = cases.load("sun")
    for name in ("more", "empty"):
        (tmp_path / name).mkdir()
    extra = {"name": "only here", "answer": 42}
    text = json.dumps({"cases": [own[0][1], extra]})
    (tmp_path / "more" / "sun_cases.json").write_text(text, encoding="utf-8")
    monkeypatch.setenv("HELIOTROPE_CASES", f"{tmp_path}/more:{tmp_path}/empty")

    assert cases.load("sun") == [*own, (f"more/{own[0][0]}", own[0][1]), ("only here", extra)]
