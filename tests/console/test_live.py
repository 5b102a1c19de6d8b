"""The live stream, the command line on the API, and what the API does with anything at all."""

import asyncio
import json
import math
import re
import shlex
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from heliotrope.cli._ctl import app
from heliotrope.console import Client, LiveMessage, RemoteError, read_message
from heliotrope.console._secrets import verify_password
from heliotrope.console.stream import MARK, ROW, changed, message
from heliotrope.local import AwayError
from heliotrope.plant.interface import plain
from heliotrope.plant.orders.authority import Person, Role
from support.live_console import PASSWORD, LiveConsole

Ask = Callable[..., httpx.Response]


def _watch(
    console: LiveConsole, token: str, enough: Callable[[np.ndarray[Any, Any], LiveMessage], bool]
) -> list[LiveMessage]:
    """Follow the stream until the field that it tells is as wanted."""

    async def follow() -> list[LiveMessage]:
        seen: list[LiveMessage] = []
        field = np.zeros(len(console.live.names), ROW)
        client = Client(token, console.address)
        try:
            async with asyncio.timeout(40.0):
                async for one in client.live():
                    seen.append(one)
                    field[one.rows["row"]] = one.rows
                    if enough(field, one):
                        return seen
        finally:
            client.close()
        return seen

    return asyncio.run(follow())


def test_the_whole_first_then_what_changed(console: LiveConsole, tokens: dict[str, str]) -> None:
    frames: list[Any] = []

    def same(field: np.ndarray[Any, Any], one: LiveMessage) -> bool:
        frames.append((field.copy(), one))
        return len(frames) >= 4

    seen = _watch(console, tokens["viewer"], same)
    assert seen[0].header["whole"]
    assert len(seen[0].rows) == len(console.live.names)
    assert not any(one.header["whole"] for one in seen[1:])
    assert [one.header["tick"] for one in seen] == list(
        range(seen[0].header["tick"], seen[0].header["tick"] + len(seen))
    )
    told = np.bincount(frames[-1][0]["state"], minlength=256)
    counts = seen[-1].header["states"]
    # The rows are of a frame that may be a second of the plant older than the header.
    assert sum(counts.values()) == told.sum()


def test_the_stream_needs_a_token(console: LiveConsole) -> None:
    with pytest.raises(RemoteError, match="sign in"):
        _watch(console, "not a token", lambda _, __: True)


@given(
    before=st.lists(st.floats(width=32), min_size=1, max_size=8), flips=st.sets(st.integers(0, 7))
)
def test_only_what_changed_is_told(before: list[float], flips: set[int]) -> None:
    rows = np.zeros(len(before), ROW)
    rows["row"], rows["error"] = np.arange(len(rows)), before
    after = rows.copy()
    for i in flips:
        if i < len(rows):
            after["state"][i] ^= 1
    told = changed(rows, after)
    assert set(told["row"].tolist()) == {i for i in flips if i < len(rows)}
    read = read_message(message({"tick": 1}, told))
    assert read.header == {"tick": 1}
    assert read.rows.tobytes() == told.tobytes()


@pytest.mark.parametrize(
    "data", [b"", b"HLS0....", MARK + struct.pack("<I", 99), MARK + struct.pack("<I", 2) + b"{}x"]
)
def test_what_is_no_message(data: bytes) -> None:
    with pytest.raises(RemoteError, match="live stream"):
        read_message(data)


def test_what_is_not_known_is_null() -> None:
    found = plain({"a": math.nan, "b": (1, np.float32(math.inf)), "c": np.array([1.5, math.nan])})
    assert found == {"a": None, "b": [1, None], "c": [1.5, None]}


@pytest.fixture
def ctl(
    console: LiveConsole, tokens: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Any]:
    """Run the command line as somebody."""

    def run(role: str, *words: str, typed: str = "") -> Any:
        monkeypatch.setenv("HELIOTROPE_URL", console.address)
        monkeypatch.setenv("HELIOTROPE_TOKEN", tokens.get(role, role))
        return CliRunner().invoke(app, list(words), input=typed)

    return run


def test_ctl_looks(ctl: Callable[..., Any], console: LiveConsole) -> None:
    shown = ctl("viewer", "status")
    assert shown.exit_code == 0, shown.output
    assert "2 of 2 clusters reporting" in shown.stdout
    shown = ctl("viewer", "show", console.live.names[0])
    assert shown.exit_code == 0
    assert '"cluster": "C' in shown.stdout


def test_ctl_commands(ctl: Callable[..., Any], console: LiveConsole) -> None:
    name = console.live.names[7]
    stowed = ctl("operator", "stow", name, "--wait", "60")
    assert stowed.exit_code == 0, stowed.output
    assert console.until(lambda: console.live.operations.viewer.heliostat(name).state == "STOWED")
    given = ctl("operator", "command", "lock", name)
    assert given.exit_code == 0, given.output
    assert given.stdout == "LOCK: 1 done\n"
    assert console.call(lambda: console.live.operations.viewer.heliostat(name).state) == "LOCKED"
    why = ctl("viewer", "why", name)
    assert why.exit_code == 0, why.output
    assert f"{name} is LOCKED" in why.stdout
    assert "last order: LOCK by operator" in why.stdout
    assert ctl("operator", "command", "unlock", name).exit_code == 0


def test_ctl_prints_the_predicted_flux_with_its_uncertainty(
    ctl: Callable[..., Any], console: LiveConsole
) -> None:
    receiver = console.live.operations.receivers[0]
    shown = ctl("viewer", "flux")
    assert shown.exit_code == 0, shown.output
    assert re.search(rf"^{receiver}: \d+ heliostats$", shown.stdout, re.M)
    assert re.search(r"^power \d+ ± \d+ kW$", shown.stdout, re.M)
    answer = json.loads(ctl("viewer", "flux", receiver, "--json").stdout)
    # Beams of heliostats that were never calibrated leave the peak without one.
    assert re.search(r"^peak \d+( ± \d+)? kW/m²$", shown.stdout, re.M)
    assert answer["power_sigma"] >= 0.0
    assert np.shape(answer["sigma"]) == np.shape(answer["flux"])
    wrong = ctl("viewer", "flux", "another")
    assert f"no receiver 'another'; known: {receiver}" in str(wrong.exception)


def test_ctl_says_what_a_proof_has_measured_and_what_it_believes(
    ctl: Callable[..., Any], console: LiveConsole
) -> None:
    try:
        given = ctl("operator", "emergency")
        assert given.exit_code == 0, given.output
        assert console.until(lambda: console.live.operations.viewer.emergency().measured)
        shown = ctl("viewer", "status").stdout
        (line,) = [line for line in shown.splitlines() if line.startswith("EMERGENCY (DEFOCUS): ")]
        assert "measured: the flux is below its limit" in line
        assert " by reports alone: " in line
    finally:
        ctl("operator", "emergency", "--withdraw")
        console.calm()


def test_ctl_says_for_whom_automatic_control_waits(
    ctl: Callable[..., Any], console: LiveConsole
) -> None:
    here, resumed = console.live.operations, "automatic control resumed"
    console.release()
    token = console.call(lambda: here.take_authority(Person("vera", Role.OPERATOR)).token)
    try:
        held = ctl("operator", "resume")
    finally:
        console.call(lambda: here.release_authority(Person("vera", Role.OPERATOR), token))
    assert held.stdout == (
        f"{resumed}; it continues as soon as vera releases command authority\n"
    ), held.output
    assert ctl("operator", "resume").stdout == f"{resumed}\n"


@pytest.mark.parametrize(
    ("role", "words", "text"),
    [
        ("viewer", ("stow", "--all"), "needs operator"),
        ("wrong", ("status",), "sign in"),
        ("operator", ("stow",), "use --all"),
        ("operator", ("aim", "receiver", "nobody"), "nobody"),
        ("operator", ("show", "nobody"), "nobody"),
    ],
)
def test_ctl_refusals(
    ctl: Callable[..., Any], role: str, words: tuple[str, ...], text: str
) -> None:
    refused = ctl(role, *words)
    assert text in str(refused.exception)


def test_ctl_at_the_plant_itself(ctl: Callable[..., Any], console: LiveConsole) -> None:
    """With the plant's folder and a token; nobody is asked at the console's address."""
    name = console.live.names[9]
    where = ("--url", "http://127.0.0.1:1/", "--data", str(console.folder))
    assert "2 of 2 clusters reporting" in ctl("viewer", *where, "status").stdout
    for what in ("alarms", "events", "packets", "holds", "retries", "schedule", "emergency", name):
        shown = ctl("viewer", *where, "show", what)
        assert shown.exit_code == 0, shown.output
    stowed = ctl("operator", *where, "stow", name, "--wait", "60")
    assert stowed.exit_code == 0, stowed.output
    given = ctl("operator", *where, "command", "lock", name)
    assert given.stdout == "LOCK: 1 done\n"
    assert ctl("operator", *where, "command", "unlock", name).exit_code == 0
    aimed = ctl("operator", *where, "aim", "0,-3,200", name)
    assert "AIM: 1" in aimed.stdout, aimed.output
    points = console.folder / "points.csv"
    points.write_text(f"heliostat,east_m,north_m,up_m\n{name},3,-9,14\n")
    rests = ctl("operator", *where, "standby", str(points))
    assert "STANDBY: 1" in rests.stdout, rests.output
    out = ctl("operator", *where, "out-of-service", name, "--reason", "washing")
    assert out.exit_code == 0, out.output
    assert f"OUT_OF_SERVICE: 1 done ({name}: parked in stow and locked out; " in out.stdout
    assert console.call(lambda: console.live.operations.viewer.heliostat(name).hold)
    left = ctl("operator", *where, "automatic", name)
    assert left.exit_code == 1
    assert left.stdout.startswith(f"AUTOMATIC: 1 refused ({name}: out of service: washing (")
    assert ctl("operator", *where, "give-back", name).stdout == "lock removed; no lock is left\n"
    follows = ctl("operator", *where, "automatic", name)
    assert follows.exit_code == 0, follows.output
    assert f"AUTOMATIC: 1 done ({name}: it is under automatic control" in follows.stdout
    asked = ctl("operator", *where, "calibrate", name, "--wait", "0")
    assert asked.exit_code == 0, asked.output or str(asked.exception)
    assert asked.stdout.startswith(f"CALIBRATE: 1 waiting ({name}: it is waiting: "), asked.stdout
    called = ctl("viewer", *where, "emergency", "--reason", "smoke")
    assert "emergency in force" in called.stdout
    assert "smoke" in called.stdout
    mine = ctl("operator", *where, "emergency", "--withdraw")
    assert mine.exit_code != 0, mine.output
    withdrawn = ctl("engineer", *where, "emergency", "--withdraw", "--owner", "viewer")
    assert withdrawn.exit_code == 0, withdrawn.output
    left = (
        "all orders are withdrawn; the emergency ends when an operator acknowledges "
        "operator_emergency, which is possible 2 s"
    )
    assert left in withdrawn.stdout
    assert left in ctl("viewer", *where, "status").stdout
    again = ctl("engineer", *where, "emergency", "--withdraw")
    assert again.exit_code != 0, again.output
    assert f"engineer has no active emergency order; {left}" in str(again.exception)
    here = console.live.operations
    console.until(lambda: any(a.waits for a in here.plant.sentinel.table.actions))
    done = ctl("operator", *where, "acknowledge", "operator_emergency")
    assert (done.exit_code, done.stdout) == (0, "acknowledged operator_emergency\n"), done.output
    console.calm()
    for words, text in (
        (("show", "accounts"), "omit --data"),
        (("resume",), "needs operator"),
        (("show", "nobody"), "nobody"),
    ):
        assert text in str(ctl("viewer", *where, *words).exception)
    assert "not valid" in str(ctl("wrong", *where, "status").exception)


@pytest.mark.parametrize("way", ["console", "plant"])
def test_frames_of_the_bus_are_recorded_for_an_engineer(
    ctl: Callable[..., Any], console: LiveConsole, way: str
) -> None:
    cluster, name = next(iter(console.live.operations.plant.field.clusters)), console.live.names[0]
    where = () if way == "console" else ("--data", str(console.folder))
    shown = ctl("engineer", *where, "frames", cluster, "--heliostat", name)
    assert shown.exit_code == 0, shown.output
    assert {"QUERY_STATUS", "STATUS", "SUN"} <= set(shown.stdout.split())
    assert name in shown.stdout
    assert console.live.names[1] not in shown.stdout
    rows = console.call(lambda: console.live.operations.logbook.events(5))
    assert any("frames of its bus" in row.text and row.text.startswith(cluster) for row in rows)
    assert "engineer" in str(ctl("operator", *where, "frames", cluster).exception)
    assert "nobody" in str(ctl("engineer", *where, "frames", "nobody").exception)


def _lines() -> list[str]:
    pages = (
        Path(__file__).parents[2] / "docs" / "how-to" / name for name in ("api.md", "console.md")
    )
    return [
        line
        for page in pages
        for block in re.findall(r"```sh\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
        for line in block.splitlines()
        if line.startswith("heliotrope ctl ")
    ]


@pytest.mark.parametrize("line", _lines())
def test_commands_of_the_pages_are_understood(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With no plant there, each ends where it would ask one."""
    monkeypatch.setenv("HELIOTROPE_URL", "http://127.0.0.1:1/")
    monkeypatch.setenv("HELIOTROPE_TOKEN", "none")
    ended = CliRunner().invoke(app, shlex.split(line)[2:], input="word\nlong enough\nlong enough\n")
    assert isinstance(ended.exception, RemoteError | AwayError), ended.output
    assert getattr(ended.exception, "status", 0) == 0


def test_the_pages_have_commands() -> None:
    assert len(_lines()) > 8


def test_ctl_makes_a_token(ctl: Callable[..., Any], console: LiveConsole) -> None:
    made = ctl("", "token", "cron", "--name", "operator", typed=f"{PASSWORD}\n")
    assert made.exit_code == 0, made.output
    secret = made.stdout.splitlines()[-1].split()[-1]
    assert PASSWORD not in made.output
    assert ctl(secret, "status").exit_code == 0


def test_ctl_lets_a_person_in_and_keeps_them_out(
    ctl: Callable[..., Any], console: LiveConsole
) -> None:
    new = "a long enough one"
    made = ctl("", "account", "desk-7", "--role", "operator", typed=f"{PASSWORD}\n{new}\n{new}\n")
    assert made.exit_code == 0, made.output
    assert new not in made.output
    assert console.keeper.people.account("desk-7").role == "operator"
    told = ctl("", "account", "desk-7", "--reset", typed=f"{PASSWORD}\n")
    assert told.exit_code == 0, told.output
    word = told.stdout.splitlines()[-1].split()[-1]
    assert verify_password(console.keeper.people.account("desk-7").password_hash, word)
    both = ctl("", "account", "desk-7", "--reset", "--disable", typed=f"{PASSWORD}\n")
    assert "not both" in str(both.exception)
    out = ctl("", "account", "desk-7", "--disable", typed=f"{PASSWORD}\n")
    assert out.exit_code == 0, out.output
    assert console.keeper.people.account("desk-7").disabled


@pytest.mark.parametrize("cases", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_anything_at_all(console: LiveConsole, tokens: dict[str, str], cases: int) -> None:
    """What the description allows is answered as it says; nothing makes the server fail."""
    headers = {"Authorization": f"Bearer {tokens['viewer']}"}
    schema = schemathesis.openapi.from_url(f"{console.address}api/v1/openapi.json", headers=headers)
    few = settings(
        max_examples=cases, deadline=None, database=None, suppress_health_check=list(HealthCheck)
    )

    for found in schema.get_all_operations():
        operation = found.ok()
        # These end what all tests share; they have tests of their own.
        if operation.path.endswith(("/session", "/emergency")):
            continue

        @few
        @given(case=operation.as_strategy())
        def check(case: Any) -> None:
            answer = case.call(headers=headers)
            case.validate_response(
                answer,
                checks=[
                    schemathesis.checks.not_a_server_error,
                    schemathesis.specs.openapi.checks.status_code_conformance,
                    schemathesis.specs.openapi.checks.response_schema_conformance,
                ],
            )

        check()
