"""A refused request hears why, also while its body is still on the way."""

import select
import socket
from urllib.parse import urlsplit

import pytest

from support.live_console import LiveConsole

#: Role, path, announced length and status of requests that are refused for what their head says.
REFUSED = [
    ("", "/api/v1/stow", 9_000, 401),
    ("viewer", "/api/v1/stow", 2_000, 403),
    ("engineer", "/api/v1/nowhere", 9_000, 404),
    ("engineer", "/api/v1/flights", 2_000_000, 413),
]


def send(address: str, head: list[str], parts: list[bytes]) -> bytes:
    """Send a request in parts, each when the server has had time to answer; return its answer."""
    where = urlsplit(address)
    with socket.create_connection((where.hostname, where.port), timeout=60.0) as line:
        host = f"Host: {where.hostname}:{where.port}"
        line.sendall("\r\n".join([head[0], host, "Connection: close", *head[1:], "", ""]).encode())
        for part in parts:
            select.select([line], [], [], 0.3)
            line.sendall(part)
        return b"".join(iter(lambda: line.recv(1 << 16), b""))


def status(answer: bytes) -> int:
    return int(answer.split()[1])


@pytest.mark.parametrize(("role", "path", "length", "expected"), REFUSED)
def test_who_still_sends_hears_the_refusal(
    console: LiveConsole, tokens: dict[str, str], role: str, path: str, length: int, expected: int
) -> None:
    head = [f"POST {path} HTTP/1.1", f"Content-Length: {length}"]
    head += [f"Authorization: Bearer {tokens[role]}"] if role else []
    part = b" " * (length // 2)
    assert status(send(console.address, head, [part, part])) == expected


def test_the_way_for_emergencies_hears_its_callers_out(
    console: LiveConsole, tokens: dict[str, str]
) -> None:
    address = f"http://127.0.0.1:{console.server.app.state.console.emergency_port}"
    head = ["POST /api/v1/emergency HTTP/1.1", "Content-Length: 4000"]
    head += [f"Authorization: Bearer {tokens['viewer']}"]
    assert status(send(address, head, [b" " * 2000] * 2)) == 413


def test_a_body_without_a_length_is_refused_at_its_end(console: LiveConsole) -> None:
    head = ["POST /api/v1/session HTTP/1.1", "Transfer-Encoding: chunked"]
    answer = send(console.address, head, [b"2\r\n{}\r\n", b"0\r\n\r\n"])
    assert status(answer) == 411


def test_who_waits_for_leave_to_send_is_answered_at_once(
    console: LiveConsole, tokens: dict[str, str]
) -> None:
    head = ["POST /api/v1/flights HTTP/1.1", "Content-Length: 2000000", "Expect: 100-continue"]
    head += [f"Authorization: Bearer {tokens['engineer']}"]
    assert status(send(console.address, head, [])) == 413
