"""Messages between plant and cluster: round trip, damage, unknown things."""

import contextlib
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from heliotrope.links import messages as protocol
from heliotrope.links.messages import (
    NODE,
    Answer,
    Ask,
    ClusterStatus,
    Command,
    Emergency,
    Lease,
    Parameters,
    Progress,
    ProtocolError,
    Stage,
    decode,
    encode,
)
from heliotrope.safety import Alarm, Severity

ROWS = np.zeros(3, NODE)
ROWS["primary"] = (-5, 7, 2**31 - 1)
MESSAGES = [
    Lease(17, 3.0, 60.0, "20260621T101500-0a1b2c3d"),
    Command("c1", "AIM", (0.0, 1.5, 50.0), ("A1", "Ü 2"), 17, 5.0),
    Emergency("e1", "DEFOCUS"),
    Parameters.of("p1", "A1", {"biases": b"\x00\n12", "stow": b"", "armature": b"\xff"}, 17),
    Ask("q1", "stored", "A1"),
    ClusterStatus(
        "K1", 4, 1.4e9, "gps", 1e-3, 2.5, 0.2, ("DEFOCUS",), ("A1", "A2"), ROWS.tobytes()
    ),
    Progress("c1", Stage.ACKNOWLEDGED, ("A1",), "because"),
    Alarm("wind_gust", "", Severity.ALARM, "the wind is 25 m/s"),
    Answer("q1", {"A1": [1, {"x": None}]}, b"\n\n"),
]


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: m.kind)
def test_round_trip(message: protocol.Message) -> None:
    assert decode(encode(message)) == message


@pytest.mark.parametrize(
    ("word", "severity"),
    [
        ("warning", Severity.WARNING),
        ("EMERGENCY", Severity.EMERGENCY),
        ("Info", Severity.INFO),
        ("serious", Severity.ALARM),
    ],
)
def test_an_alarm_of_an_older_cluster_is_not_lost(word: str, severity: Severity) -> None:
    """Clusters said severities in upper case once; an unknown one counts as an alarm."""
    line = encode(Alarm("node_silent", "A1", Severity.INFO, "no answer"))
    assert b'"severity":"info"' in line
    found = decode(line.replace(b'"info"', f'"{word}"'.encode()))
    assert isinstance(found, Alarm)
    assert found.severity is severity


def test_rows_and_items_come_back() -> None:
    status = decode(encode(MESSAGES[5]))
    assert isinstance(status, ClusterStatus)
    assert status.nodes()["primary"].tolist() == [-5, 7, 2**31 - 1]
    items = decode(encode(MESSAGES[3]))
    assert isinstance(items, Parameters)
    assert items.items() == {"biases": b"\x00\n12", "stow": b"", "armature": b"\xff"}


def test_a_block_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ProtocolError, match="are not rows of"):
        decode(encode(MESSAGES[5])[:-1]).nodes()  # type: ignore[union-attr]
    with pytest.raises(ProtocolError, match="do not fit together"):
        decode(encode(MESSAGES[3]) + b"x").items()  # type: ignore[union-attr]


def _with(**changes: object) -> bytes:
    fields = {"kind": "lease", "version": 1, "token": 1, **changes}
    return json.dumps(fields).encode()


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "does not begin with JSON"),
        (b"\xff\xfe", "does not begin with JSON"),
        (b"[" * 100_000, "does not begin with JSON"),
        (b"[1]", "version None"),
        (_with(version=2), "version 2"),
        (_with(kind="dance"), "unknown kind 'dance'"),
        (_with(token="1"), "token is '1'"),
        (_with(token=True), "token is True"),
        (_with(lifetime=1e999), "does not begin with JSON"),
        (_with(token=None), "token is None"),
        (b'{"kind":"lease","version":1}', "missing"),
        (_with(lifetime=10**400), "lifetime is 1000"),
        (_with(kind="emergency", identity="e", name="STOW", heliostats="A1"), "heliostats is 'A1'"),
        (_with(kind="progress", identity="e", stage="nearly"), "stage is 'nearly'"),
    ],
)
def test_what_is_no_message_is_refused(data: bytes, said: str) -> None:
    with pytest.raises(ProtocolError, match=said):
        decode(data)


def test_fields_of_later_are_ignored() -> None:
    assert decode(_with(colour="blue")) == Lease(1)


@given(st.binary(max_size=200))
def test_random_bytes_are_refused_or_taken_but_never_fail(data: bytes) -> None:
    with contextlib.suppress(ProtocolError):
        decode(data)
