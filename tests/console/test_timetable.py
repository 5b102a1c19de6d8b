"""The timetable by the API, the command line, the socket and the page."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.cli._at_plant import AtPlant
from support.live_console import LiveConsole

Ask = Callable[..., httpx.Response]


def test_an_entry_is_added_shown_and_removed(
    console: LiveConsole, ask: Ask, tokens: dict[str, str], tmp_path: Path
) -> None:
    names, target = console.live.names, console.live.design.targets[0].name
    secret = tmp_path / "token"
    secret.write_text(tokens["operator"])
    where = ["ctl", "--url", console.address, "--token-file", str(secret), "timetable"]

    def ctl(*words: str) -> Any:
        return CliRunner().invoke(app, [*where, *words])

    assert ask("viewer", "GET", "timetable").json() == []
    made = ctl("noon", names[0], names[1], "--target", target, "--at", "12:00Z", "--every", "2h")
    assert made.exit_code == 0, made.output
    (row,) = ask("viewer", "GET", "timetable").json()
    assert (row["heliostats"], row["target"]) == ([names[0], names[1]], target)
    assert (row["at"], row["every_s"], row["last"]) == (["12:00Z"], 7200.0, None)
    assert AtPlant(tokens["viewer"], console.folder).get("timetable") == [row]
    # The same name replaces the entry, another one joins it.
    assert ctl("noon", names[2], "--at", "12:30Z").exit_code == 0
    assert ctl("hourly", names[3], "--every", "60min").exit_code == 0
    rows = ask("viewer", "GET", "timetable").json()
    assert [(r["name"], r["heliostats"], r["at"]) for r in rows] == [
        ("noon", [names[2]], ["12:30Z"]),
        ("hourly", [names[3]], []),
    ]
    shown = ctl()
    assert "12:30Z" in shown.output
    assert "every 3600 s" in shown.output
    assert ctl("noon", "--remove").exit_code == 0
    assert [r["name"] for r in ask("viewer", "GET", "timetable").json()] == ["hourly"]
    assert ctl("--plant-file").exit_code == 0
    assert ask("viewer", "GET", "timetable").json() == []


def test_what_cannot_be_is_one_line(
    console: LiveConsole, ask: Ask, tokens: dict[str, str], tmp_path: Path
) -> None:
    name = console.live.names[0]
    entry = {"name": "e", "heliostats": [name], "at": ["12:00Z"]}
    for wrong, status, text in (
        ({"at": ["12:00"]}, 422, "has no time zone; write 12:00Z"),
        ({"heliostats": ["nobody"]}, 404, "nobody"),
        ({"every_s": 1.0}, 422, "60"),
    ):
        answer = ask("operator", "PUT", "timetable", {"entries": [{**entry, **wrong}]})
        assert (answer.status_code, text in answer.text) == (status, True), answer.text
    assert ask("viewer", "PUT", "timetable", {"entries": [entry]}).status_code == 403
    secret = tmp_path / "token"
    secret.write_text(tokens["operator"])
    where = ["ctl", "--url", console.address, "--token-file", str(secret), "timetable"]
    for words, text in (
        (["noon"], "use NAME HELIOSTAT"),
        (["noon", "--remove"], "there is no timetable entry 'noon'"),
        (["noon", name, "--every", "2 weeks"], "write it as 30s, 5min or 1h"),
        (["noon", name, "--plant-file"], "--plant-file cannot be combined"),
    ):
        found = CliRunner().invoke(app, [*where, *words])
        assert found.exit_code != 0
        assert text in str(found.exception)
