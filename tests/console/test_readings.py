"""Readings of the safety table that a program gives by the API."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from typer.testing import CliRunner

from heliotrope.cli import app
from support.live_console import LiveConsole

Ask = Callable[..., httpx.Response]
GUST = "readings/wind_gust"


@pytest.fixture(scope="module")
def console(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """A plant whose wind a program reads, in real time."""
    folder = tmp_path_factory.mktemp("readings")
    made = LiveConsole(folder, 4, given=frozenset({"wind_gust"}))
    yield made
    made.close()


def now(console: LiveConsole) -> float:
    """Return the time at the plant, Unix s."""
    return console.call(lambda: console.live.clock.utc().timestamp())


def give(console: LiveConsole, ask: Ask, value: float) -> bool:
    """Give a reading; return whether it was taken, as it is not if the machine was busy."""
    answer = ask("engineer", "PUT", GUST, {"value": value, "at": now(console)})
    assert answer.status_code == 204 or "s old" in answer.json()["detail"]
    return answer.status_code == 204


def within(holds: Callable[[], object], seconds: float = 60.0) -> None:
    """Wait until something holds."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.2)


def test_a_reading_reaches_the_safety_table_and_who_gave_it_is_recorded(
    console: LiveConsole, ask: Ask
) -> None:
    table = console.live.plant.sentinel.table
    for value in (27.0, 3.0):
        within(lambda value=value: give(console, ask, value))
        assert console.call(lambda: table._put["wind_gust", ""].value) == value
    texts = [row["text"] for row in ask("viewer", "GET", "events").json()]
    assert texts.count("sends wind_gust; the first value is 27") == 1
    assert "sends wind_gust; the first value is 3" not in texts


@pytest.mark.parametrize(
    ("path", "value", "age", "status", "said"),
    [
        ("readings/rain", 1.0, 0.0, 404, 'there is no "api" reading of the links file'),
        ("readings/receiver_flux_nominal", 0.0, 0.0, 404, "known: wind_gust"),
        (GUST, 3.0, 60.0, 422, "wind_gust: the reading is 6"),
        (GUST, 3.0, -60.0, 422, "ahead of the plant's clock"),
    ],
)
def test_an_unknown_an_old_and_a_future_reading_are_refused(
    console: LiveConsole, ask: Ask, path: str, value: float, age: float, status: int, said: str
) -> None:
    answer = ask("engineer", "PUT", path, {"value": value, "at": now(console) - age})
    assert (answer.status_code, said in answer.json()["detail"]) == (status, True), answer.text


@pytest.mark.parametrize("value", ["NaN", "Infinity", "1e400", '"3"x', "null"])
def test_what_is_no_number_is_refused(
    console: LiveConsole, tokens: dict[str, str], value: str
) -> None:
    answer = httpx.put(
        f"{console.address}api/v1/{GUST}",
        content=f'{{"value": {value}, "at": {now(console)}}}',
        headers={
            "Authorization": f"Bearer {tokens['engineer']}",
            "Content-Type": "application/json",
        },
        trust_env=False,
    )
    assert answer.status_code == 422


def test_readings_come_in_order(console: LiveConsole, ask: Ask) -> None:
    def given_twice() -> bool:
        order = {"value": 3.0, "at": now(console)}
        if ask("engineer", "PUT", GUST, order).status_code != 204:
            return False  # the machine was busy: it came too late
        answer = ask("engineer", "PUT", GUST, order)
        assert answer.status_code == 422
        return "older than the last reading" in answer.json()["detail"]

    within(given_twice)


@pytest.mark.parametrize("role", ["viewer", "operator"])
def test_a_lower_role_is_refused(console: LiveConsole, ask: Ask, role: str) -> None:
    answer = ask(role, "PUT", GUST, {"value": 3.0, "at": now(console)})
    assert answer.status_code == 403


@pytest.mark.parametrize("socket", [False, True], ids=["console", "socket"])
def test_the_command_line_gives_a_reading(
    console: LiveConsole,
    tokens: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    socket: bool,
) -> None:
    secret = tmp_path / "token"
    secret.write_text(tokens["engineer"])
    there = ["--data", str(console.folder)] if socket else ["--url", console.address]
    at = ["ctl", *there, "--token-file", str(secret), "reading"]

    def given() -> bool:
        moment = now(console)
        with monkeypatch.context() as patch:
            patch.setattr("heliotrope.cli._ctl.time.time", lambda: moment)
            return CliRunner().invoke(app, [*at, "wind_gust", "3.5"]).exit_code == 0

    within(given)
    found = CliRunner().invoke(app, [*at, "rain", "1"])
    assert "known: wind_gust" in found.output + str(found.exception)
