"""Log lines of bounded length, one per record, in which foreign text cannot start a new line.

A record may contain text that a client has sent, either in its message or in the reported error.
Control characters, including those that only some programs treat as line breaks and those that
reverse the text direction, are escaped; the lines of a traceback begin with a marker.
"""

import logging
import re

#: Length of the longest line, and number of last traceback lines that are kept.
LONGEST, MOST_LINES = 500, 40
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\\\\]")
_MARK = "  | "


class LogLines(logging.Formatter):
    """Formats records as safe log lines."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the lines of a record."""
        lines = [_line(record.getMessage())]
        if record.exc_info:
            trace = self.formatException(record.exc_info).split("\n")
            lines += [_MARK + _line(line) for line in trace[-MOST_LINES:]]
        return "\n".join(lines)


def install() -> None:
    """Write warnings and errors of this process to standard error as safe log lines."""
    root = logging.getLogger()
    if not root.handlers:
        handler = logging.StreamHandler()
        handler.setFormatter(LogLines())
        root.addHandler(handler)


def _line(text: str) -> str:
    shown = _CONTROL.sub(lambda found: ascii(found[0])[1:-1], text[: LONGEST + 1])
    return shown if len(shown) <= LONGEST else shown[: LONGEST - 1] + "…"
