"""The thin client: what it says when a console does not answer, and the authority it leaves."""

import socket
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.console.client import Client
from heliotrope.console.stream import RemoteError
from support.live_console import LiveConsole


def test_a_console_that_does_not_answer_is_told_apart_from_an_order_not_given() -> None:
    with socket.create_server(("127.0.0.1", 0)) as busy:
        url = f"http://127.0.0.1:{busy.getsockname()[1]}/"
        with Client(url=url, timeout=0.2) as client:
            with pytest.raises(RemoteError, match=r"no answer within 0\.2 s; it is too busy"):
                client.get("plant")
            with pytest.raises(RemoteError, match=r"no answer within 0\.2 s; the order may still"):
                client.ask("POST", "stow", {"heliostats": []})
    with (
        Client(url=url, timeout=0.2) as client,
        pytest.raises(RemoteError, match="check that it is running there"),
    ):
        client.get("plant")


def test_ctl_keeps_the_authority_that_its_person_holds_in_a_page(
    console: LiveConsole,
    tokens: dict[str, str],
    ask: Callable[..., httpx.Response],
    tmp_path: Path,
) -> None:
    token = tmp_path / "token"
    token.write_text(tokens["operator"])
    words = ["ctl", "--url", console.address, "--token-file", str(token), "command", "LOCK"]
    name = console.live.names[0]
    assert ask("operator", "POST", "authority").json()["mine"]
    try:
        found = CliRunner().invoke(app, [*words, name, "--wait", "0"])
        assert found.exit_code == 0, found.output
        assert ask("operator", "GET", "authority").json()["mine"]
    finally:
        ask("operator", "DELETE", "authority")
    found = CliRunner().invoke(app, [*words, name, "--wait", "0"])
    assert found.exit_code == 0, found.output
    assert not ask("operator", "GET", "authority").json()["mine"]
