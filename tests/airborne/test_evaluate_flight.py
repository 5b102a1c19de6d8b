"""The evaluation of a flight by its one public function: the steps of a photograph, the result."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from heliotrope.airborne.evaluate.flight import CampaignResult, evaluate_flight
from heliotrope.airborne.evaluate.report import write_result
from heliotrope.airborne.simulate.rendering import render_flight
from heliotrope.airborne.simulate.simulation import Errors
from support.drone_case import ORIGIN, camera, field, flight, plant

PACKAGE = "heliotrope.airborne.evaluate."
MIRRORS = field(2, 4)


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
