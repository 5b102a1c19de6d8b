"""What was learnt of the groups, by the API, the command line and the socket."""

from collections.abc import Callable
from pathlib import Path

import httpx
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.cli._at_plant import AtPlant
from support.live_console import LiveConsole

Ask = Callable[..., httpx.Response]


def test_what_is_in_force_is_shown_and_an_order_without_a_learner_is_refused(
    console: LiveConsole, ask: Ask, tokens: dict[str, str], tmp_path: Path
) -> None:
    groups = list(console.live.operations.plant.design.groups)
    rows = ask("viewer", "GET", "learning").json()
    assert [(row["group"], row["version"], row["at"]) for row in rows] == [
        (group, 0, None) for group in groups
    ]
    assert "zeros wander by 1 and 1 mrad over 300 days" in rows[0]["drift"]
    assert "the default values are in force" in rows[0]["said"]
    assert AtPlant(tokens["viewer"], console.folder).get("learning") == rows
    answer = ask("engineer", "POST", "learning", {"group": "nobody"})
    assert (answer.status_code, "nobody" in answer.json()["detail"]) == (404, True)
    secret = tmp_path / "token"
    secret.write_text(tokens["engineer"])
    at = ["ctl", "--url", console.address, "--token-file", str(secret)]
    found = CliRunner().invoke(app, [*at, "learn", "--group", groups[0]])
    assert found.exit_code != 0
    assert "this plant was started without a learner" in found.output + str(found.exception)
