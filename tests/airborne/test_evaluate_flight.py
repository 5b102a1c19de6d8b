"""The evaluation of a flight by its one public function: the steps of a photograph, the result."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from heliotrope.airborne.evaluate.flight import CampaignResult, evaluate_flight
from heliotrope.airborne.evaluate.flight_file import flight_document
from heliotrope.airborne.evaluate.report import write_result
from heliotrope.airborne.evaluate.sightings import mean_sigma
from heliotrope.airborne.simulate.rendering import render_flight
from heliotrope.airborne.simulate.simulation import Errors
from heliotrope.calibration.flights import Flight, FlightDocument, read_flight, write_flight
from heliotrope.errors import FormatError
from support.drone_case import ORIGIN, camera, field, flight, plant

PACKAGE = "heliotrope.airborne.evaluate."
MIRRORS = field(2, 4)
FLOWN = {
    "format": "heliotrope-flight",
    "version": 1,
    "name": "one",
    "shared": ["east, m"],
    "covariance": [[1e-4]],
    "rows": [
        {
            "heliostat": "A1",
            "time": 1.7e9,
            "counts": [1.0, 2.0],
            "place_m": [0.0, 100.0, 20.0],
            "sigma_rad": 1e-4,
            "turn_rad": 1e-4,
            "covariance_m2": [[0.0, 0.0, 0.0]] * 3,
            "shift": [[1.0], [0.0], [0.0]],
        }
    ],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("flight")
    flown = flight(Errors(), 2, 2, heliostats=MIRRORS, lens=camera(640, 480))
    render_flight(flown, place, ORIGIN, seed=1)
    return place


def steps(folder: Path) -> tuple[CampaignResult, list[str]]:
    """Return the result and the functions of the package in the order of their first call."""
    met: list[str] = []

    def look(frame, event, _):
        module = frame.f_globals.get("__name__", "")
        if event == "call" and module.startswith(PACKAGE):
            name = f"{module.removeprefix(PACKAGE)}.{frame.f_code.co_qualname}"
            if name not in met:
                met.append(name)

    sys.setprofile(look)
    try:
        result = evaluate_flight(folder, plant(MIRRORS))
        result.sightings()
    finally:
        sys.setprofile(None)
    return result, met


def test_a_photograph_goes_forward_by_the_steps_that_the_function_lists(folder: Path) -> None:
    result, met = steps(folder)
    listed = re.findall(r"``((?!report)\w+\.\w+)``", evaluate_flight.__doc__ or "")
    assert len(listed) == 14
    places = [met.index(name) for name in listed]
    # Each stay is met, and for the first time only when the one before it was.
    assert places == sorted(places)
    assert result.flights[0].measured.found.found


def test_the_result_tells_what_its_files_hold(folder: Path, tmp_path: Path) -> None:
    told: list[tuple[str, int, int]] = []
    result = evaluate_flight(
        folder, plant(MIRRORS), progress=lambda *step: told.append(step), keep=tmp_path / "kept"
    )
    assert told == [("reading", k, 4) for k in range(5)]
    write_result(result, tmp_path, page=False)
    written = {p.name for p in tmp_path.glob("*.csv")}
    assert written == {"orientations.csv", "reflections.csv", "sightings.csv"}
    seen = result.sightings()
    assert seen is not None
    rows = result.orientation_rows()
    assert len(seen) == len(rows) == len(result.document()["orientations"]) > 4
    names = [r["heliostat"] for r in rows]
    assert [MIRRORS.names[h] for h in seen.heliostat] == names
    assert set(names) | set(result.left_out()) == set(MIRRORS.names)
    assert np.isfinite(result.campaign.offset_sigma).all()


def test_the_file_for_a_plant_splits_what_mirrors_share_from_what_is_their_own(
    folder: Path, tmp_path: Path
) -> None:
    result = evaluate_flight(folder, plant(MIRRORS))
    write_result(result, tmp_path, page=False)
    document = read_flight(tmp_path / "flight.json")
    assert document == flight_document(result)
    flight = Flight.of(document)
    rows = result.orientation_rows()
    assert [flight.heliostats[h] for h in flight.sightings.heliostat] == [
        row["heliostat"] for row in rows
    ]
    found = result.flights[0].measured.found.found
    common = result.flights[0].evaluation.adjusted.common_covariance
    places = result.flights[0].evaluation.place_covariance
    # All mirrors share a part of each one's uncertain place, and no mirror less than that.
    assert 0.0 < np.trace(common) < min(np.trace(place) for place in places)
    for k, o in enumerate(found):
        # Together the parts are the σ_tot of the tables, as far as each one's sides are alike.
        middle = flight.sightings.source[k] - o.distance * o.normal
        np.testing.assert_allclose(middle, o.vertex, atol=1e-6)
        across = np.eye(3) - np.outer(o.normal, o.normal)
        shift = flight.shift[k]
        shared = across @ shift @ flight.covariance @ shift.T @ across / o.distance**2
        own = across @ flight.sightings.destination_covariance[k] @ across / 4.0 / o.distance**2
        turn = flight.turn_sigma[flight.sightings.heliostat[k]] ** 2
        total = 0.5 * np.trace(shared + own) + turn
        assert np.sqrt(total) == pytest.approx(mean_sigma(o, systematic=True), rel=0.05)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": "heliotrope-plant"}, "format: Input should be 'heliotrope-flight'"),
        ({"rows": []}, "rows: List should have at least 1 item"),
        ({"covariance": [[1.0, 0.0]]}, "write 1 by 1 values"),
        ({"covariance": [[-1.0]]}, "not symmetric and positive definite"),
    ],
)
def test_a_file_that_is_no_flight_is_refused_with_the_place(
    tmp_path: Path, change: dict[str, object], said: str
) -> None:
    flown = FlightDocument.model_validate(FLOWN)
    place = tmp_path / "flight.json"
    write_flight(place, flown)
    assert read_flight(place) == flown
    place.write_text(json.dumps({**FLOWN, **change}))
    with pytest.raises(FormatError, match=re.escape(said)):
        read_flight(place)
