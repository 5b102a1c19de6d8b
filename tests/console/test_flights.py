"""Flights of a drone given to a plant at work: by the API, the command line and the socket."""

import json
from collections.abc import Callable
from pathlib import Path

import httpx
import numpy as np
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.cli._at_plant import AtPlant
from support.live_console import LiveConsole

Ask = Callable[..., httpx.Response]


def test_a_flight_of_a_drone_is_taken_by_the_page_and_the_command_line(
    console: LiveConsole, ask: Ask, tokens: dict[str, str], tmp_path: Path
) -> None:
    field = ask("viewer", "GET", "field").json()
    name = field["names"][-1]
    mechanism = console.live.operations.plant.beliefs.nominal(name)
    counts = np.array([[1000.0 * k, 500.0 * k] for k in (1, 2, 3)])
    pose = mechanism[[0, 0, 0]].pose(counts)
    rows = [
        {
            "heliostat": name,
            "time": 1.7e9,
            "counts": c.tolist(),
            "place_m": p.tolist(),
            "sigma_rad": 1e-4,
            "turn_rad": 1e-4,
            "covariance_m2": np.zeros((3, 3)).tolist(),
            "shift": np.eye(3).tolist(),
        }
        for c, p in zip(counts, pose.vertex + 100.0 * pose.normal, strict=True)
    ]
    flight = {
        "format": "heliotrope-flight",
        "version": 1,
        "name": "by the page",
        "shared": ["position east, m", "position north, m", "position up, m"],
        "covariance": (1e-4 * np.eye(3)).tolist(),
        "rows": rows,
    }
    wrong = {**flight, "rows": [{**rows[0], "heliostat": "Z9"}]}
    answer = ask("engineer", "POST", "flights", wrong)
    assert (answer.status_code, "Z9" in answer.json()["detail"]) == (404, True)
    answer = ask("engineer", "POST", "flights", {**flight, "covariance": []})
    assert answer.status_code == 422
    assert "write 3 by 3 values" in answer.text
    # A flight is longer than orders are: 20 KiB for each heliostat are too much.
    many = {**flight, "rows": rows * (len(field["names"]) * 20_480 // len(json.dumps(rows)))}
    assert ask("engineer", "POST", "flights", many).status_code == 413
    some = {**flight, "name": "longer", "rows": rows * 60}
    assert len(json.dumps(some)) > 50_000
    assert ask("engineer", "POST", "flights", some).status_code == 200
    taken = ask("engineer", "POST", "flights", flight).json()
    assert (taken["heliostats"], taken["orientations"]) == (1, 3)
    assert [word for word, _, _ in taken["shared"]] == flight["shared"]
    again = ask("engineer", "POST", "flights", flight)
    assert again.status_code == 409
    assert "flight by the page: engineer imported it on" in again.json()["detail"]
    place, secret = tmp_path / "flight.json", tmp_path / "token"
    place.write_text(json.dumps(flight))
    secret.write_text(tokens["engineer"])
    at = ["ctl", "--url", console.address, "--token-file", str(secret)]
    found = CliRunner().invoke(app, [*at, "flight", str(place), "--name", "by hand"])
    assert found.exit_code == 0, found.output
    assert "flight by hand: 3 orientations of 1 heliostats" in found.output
    there = AtPlant(tokens["viewer"], console.folder).get("flights")
    assert {"by hand", "by the page"} <= {one["name"] for one in there}
    events = ask("viewer", "GET", "events?limit=200").json()
    assert any("flight by hand" in event["text"] for event in events)
    audit = (console.folder / "audit.jsonl").read_text()
    assert '"FLIGHT"' in audit
