"""Lines of the log: one for each record, bounded, in which no text of others can begin a line.

A record may hold what a client has sent, in its message or in the error that it reports. Control
characters, also those that only some programs take for line breaks or that reverse the order of
letters, are written as escapes; the lines of a traceback begin with a mark.
"""

import logging
import re

#: Longest line, and most lines of a traceback that are kept, the last ones.
LONGEST, MOST_LINES = 500, 40
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\\\\]")
_MARK = "  | "


class LogLines(logging.Formatter):
    """Writes records as such lines."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the lines of a record."""
        lines = [_line(record.getMessage())]
        if record.exc_info:
            trace = self.formatException(record.exc_info).split("\n")
            lines += [_MARK + _line(line) for line in trace[-MOST_LINES:]]
        return "\n".join(lines)


def install() -> None:
    """Write warnings and errors of this process to standard error in such lines."""
    root = logging.getLogger()
    if not root.handlers:
        handler = logging.StreamHandler()
        handler.setFormatter(LogLines())
        root.addHandler(handler)


def _line(text: str) -> str:
    shown = _CONTROL.sub(lambda found: ascii(found[0])[1:-1], text[: LONGEST + 1])
    return shown if len(shown) <= LONGEST else shown[: LONGEST - 1] + "…"
