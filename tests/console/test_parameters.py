"""Error parameters by API and `ctl`, and what `ctl --data` asks the plant itself."""

import json
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.cli._at_plant import AtPlant
from heliotrope.errors import HeliotropeError
from support.live_console import LiveConsole

Ask = Callable[..., httpx.Response]
Ctl = Callable[..., str]


@pytest.fixture
def ctl(console: LiveConsole, tokens: dict[str, str], tmp_path: Path) -> Ctl:
    """Run `heliotrope ctl` as an engineer."""
    secret = tmp_path / "token"
    secret.write_text(tokens["engineer"])

    def run(*words: str, data: bool = False) -> str:
        where = ["--data", str(console.folder)] if data else ["--url", console.address]
        found = CliRunner().invoke(app, ["ctl", *where, "--token-file", str(secret), *words])
        assert found.exit_code == 0, (found.output, found.exception)
        return found.output

    return run


@pytest.mark.parametrize("data", [False, True])
def test_an_engineer_sets_a_parameter_at_stow(console: LiveConsole, ctl: Ctl, data: bool) -> None:
    name = console.live.names[40 + data]
    assert ctl("stow", name, data=data)
    console.until(lambda: console.live.operations.viewer.heliostat(name).state == "STOWED")
    reason = ("--reason", "levelled with an inclinometer")
    ctl("parameters", name, "tilt_east_mrad=0.5", *reason, data=data)
    console.until(lambda: console.live.operations.viewer.heliostat(name).calibration is not None)
    shown = ctl("parameters", name, data=data)
    assert "version 1" in shown
    (line,) = (line for line in shown.splitlines() if line.startswith(" tilt_east "))
    assert line.split()[2] == "0.500"
    record = console.live.plant.beliefs.record(name)
    assert record is not None
    assert (record.person, record.note) == ("engineer", "levelled with an inclinometer")


def test_what_is_not_set(console: LiveConsole, ask: Ask, tokens: dict[str, str]) -> None:
    name = console.live.names[45]
    order = {"heliostat": name, "values": {"tilt_east": 0.001}, "reason": "levelled"}
    assert ask("operator", "POST", "parameters", order).status_code == 403
    ask("engineer", "DELETE", "authority")
    early = ask("engineer", "POST", "parameters", order)
    assert (early.status_code, "take command first" in early.json()["detail"]) == (409, True)
    assert ask("engineer", "POST", "parameters", {**order, "reason": ""}).status_code == 422
    assert ask("viewer", "GET", "heliostats/Z9/parameters").status_code == 404
    assert console.live.plant.beliefs.record(name) is None
    with pytest.raises(HeliotropeError, match="needs engineer"):
        AtPlant(tokens["operator"], console.folder).ask("POST", "parameters", order)


def test_the_plant_itself_photographs_calibrates_and_lists(
    console: LiveConsole, ask: Ask, ctl: Ctl, tokens: dict[str, str]
) -> None:
    name = console.live.names[46]
    with pytest.raises(HeliotropeError, match="no target with a camera 'nowhere'"):
        AtPlant(tokens["engineer"], console.folder).ask("POST", "targets/nowhere/photograph")
    assert f"CALIBRATE: 1 waiting ({name}" in ctl("calibrate", name, "--wait", "0", data=True)
    listed = json.loads(ctl("photographs", "--limit", "5", "--json", data=True))
    assert listed == ask("viewer", "GET", "photographs?limit=5").json()
    with pytest.raises(HeliotropeError, match="known only to the console"):
        AtPlant("", console.folder).get("accounts")
