"""Make docs/reference/alarms.md from the alarms and refusals in the code."""

import re

from heliotrope.plant import refusals
from heliotrope.safety import CONDITIONS, Condition, Watcher, alarms

PAGE = "docs/reference/alarms.md"

_INTRO = """\
# Alarms and refusals

This page lists every alarm that the code can raise, and every reason for which the plant refuses a
command. `python -m scripts.pages` generates it from the code. The limits are the defaults of the
[safety table](../explanation/safety.md). The [handbook](../how-to/handbook.md#alarms) describes the
alarms more briefly, for operators.

An alarm's text says what is wrong and where, what happens by itself, and what to do. Words in
braces are replaced by actual values when the alarm is raised. The column *Time* of the console
shows since when the alarm has been active.

Severities, from the least serious: **info**, **warning**, **alarm**, **emergency**.
"""

_REFUSALS = """
## Refusals

A refused command is not sent, and nothing moves. The plant never refuses DEFOCUS, STOW or
EMERGENCY, whoever gives the order. A cluster, however, refuses heliostat names that are not in its
file, and a heliostat cannot obey if it has no power, if its drives are stalled, or if they are
switched off at the mirror. Over HTTP, a refusal has the status 409.

| refusal | when | text | what to do |
|---|---|---|---|
"""


def _fields(text: str) -> str:
    """Return a template with its fields in italics, without their formats."""
    return re.sub(r"\{(\w+)[^}]*\}", r"{\1}", text).replace("|", "\\|")


def _row(row: Condition) -> str:
    text = _fields(row.wrong) + row.limit
    cells = (f"`{row.name}`", row.severity, text, row.consequence, row.remedy)
    return f"| {' | '.join(cells)} |"


def _kind(kind: alarms.AlarmKind) -> str:
    severity = kind.severity + (f" or {kind.worse}" if kind.worse else "")
    text = f"{kind.meaning} *{_fields(kind.text)}*"
    cells = (f"`{kind.name}`", severity, text, kind.consequence, kind.remedy)
    return f"| {' | '.join(cells)} |"


def pages() -> dict[str, str]:
    """Return the page's text, by path."""
    lines = [_INTRO]
    for tier in Watcher:
        lines += [f"## Raised by the {tier.value}", ""]
        lines += ["| alarm | severity | what is wrong | what happens by itself | what to do |"]
        lines += ["|---|---|---|---|---|"]
        lines += [_row(row) for row in CONDITIONS if row.watcher is tier]
        lines += [_kind(kind) for kind in alarms.KINDS.values() if kind.watcher is tier]
        lines += [""]
    cells = [
        (kind.name, kind.meaning, f"*{_fields(kind.text)}*", kind.remedy) for kind in refusals.KINDS
    ]
    lines[-1] = _REFUSALS.rstrip("\n")
    lines += [f"| {' | '.join(row)} |" for row in cells]
    return {PAGE: "\n".join(lines) + "\n"}
