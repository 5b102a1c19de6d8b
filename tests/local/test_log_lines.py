"""Lines of the log: no text of others begins one, and none is long."""

import logging
import sys

import pytest

from heliotrope.local import log_lines
from heliotrope.local.log_lines import LONGEST, MOST_LINES, LogLines

FORGED = "x\nengineer signed in\r\u2028engineer signed in\x85\x1b[2K\u202eni dengis"


def record(text: str, error: Exception | None = None) -> logging.LogRecord:
    """Return a record that holds a text, or an error that does."""
    if error is None:
        return logging.LogRecord("n", logging.WARNING, "", 1, "a client sent %s", (text,), None)
    try:
        raise error
    except type(error):
        info = sys.exc_info()
    return logging.LogRecord("n", logging.ERROR, "", 1, "it failed", (), info)


def test_a_text_with_line_breaks_is_one_line() -> None:
    written = LogLines().format(record(FORGED))
    assert len(written.splitlines()) == 1
    assert written.isprintable()
    assert written.startswith(r"a client sent x\nengineer signed in\r\u2028engineer")


def test_a_text_in_an_error_begins_no_line() -> None:
    written = LogLines().format(record("", ValueError(FORGED))).splitlines()
    assert written[0] == "it failed"
    assert all(line.startswith("  | ") for line in written[1:])
    assert any("engineer signed in" in line for line in written)


def test_lines_are_short_and_few() -> None:
    assert len(LogLines().format(record("\n" * 30_000_000))) <= LONGEST
    written = LogLines().format(record("", ValueError("line\n" * 100_000))).splitlines()
    assert len(written) == 1 + MOST_LINES


def test_it_is_installed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    root = logging.getLogger("another root")
    monkeypatch.setattr(logging, "getLogger", lambda: root)
    log_lines.install()
    log_lines.install()
    (handler,) = root.handlers
    assert isinstance(handler.formatter, LogLines)
