"""Write docs/explanation/safety.md from the safety table."""

import math
from pathlib import Path

from heliotrope.safety import evaluation as safety
from heliotrope.safety.evaluation import Act, Condition, Watcher

PAGE = Path(__file__).parents[1] / "docs" / "explanation" / "safety.md"

_INTRO = """\
# Safety

What trips, what is then done, and when it ends is one table (`heliotrope.safety.evaluation`). The
plant, the clusters and the local controllers evaluate the rows that name them; the evaluation is
a pure function of readings, state and monotonic time. This page is made from the table by
`scripts/safety_table.py`.

The numbers are defaults. Those of the wind must be replaced by the heliostat maker's, those of
the receiver by its maker's, before a plant is run with them.

## Rules for every row

- A reading that is missing, not a number or from the future does not count. The last good one
  does until it is older than *missing for*; from then on the worst case counts. A silence or age
  grows by itself.
- A row trips when its value has been at its limit or beyond for its delay. It releases when fresh
  readings have been on the safe side of the second limit for the time named; between the limits
  it stays as it is. A stream of readings that stands still releases nothing.
- A row that *latches* stays until its cause has gone and a person of that role or above
  acknowledges it. An acknowledgement before that is refused.
- The strongest action wins, in the order of the list below. DEFOCUS and STOW pre-empt every
  motion. A row that is released moves no mirror: going back to the receiver needs a fresh command
  of the command authority.
- *Budget* is from the fault to the finished action, the detection included.
"""

_AFTER = f"""
## The proof of an emergency

From an order to DEFOCUS or STOW on, every node is on a list (`Proof`): it has acknowledged within
{safety.ORDER_BUDGET:g} s and is done within {safety.DEFOCUS_BUDGET:g} s (DEFOCUS) or
{safety.STOW_BUDGET:g} s (STOW), or it is named. Reports of strangers and from before the order
prove nothing. The flux on the receiver must be below 10 % of the nominal by a fresh reading; else
`flux_after_emergency` trips.

## Joining the receiver

A token bucket (`JoinLimiter`) bounds how many mirrors join: in any span of T seconds at most
burst + rate · T.

## What the table does not do

It is software on ordinary computers and has no safety integrity level. Receiver protection and the
emergency line must not depend on it. The thresholds have not been tried on a plant.
"""


def _limit(row: Condition) -> str:
    sign, unit = ("≥" if row.above else "≤"), ("" if row.unit == "1" else f" {row.unit}")
    return f"{row.what} {sign} {row.trips:g}{unit}"


def _action(row: Condition) -> str:
    then = "" if math.isinf(row.then_stow) else f", after {row.then_stow:g} s STOW"
    return f"{row.act.name} {row.scope.name.lower()}{then}"


def _line(row: Condition) -> str:
    sign, unit = ("≤" if row.above else "≥"), ("" if row.unit == "1" else f" {row.unit}")
    cells = [
        f"`{row.name}`",
        _limit(row),
        f"{row.delay:g} s",
        "grows" if row.ages else f"{row.stale_after:g} s",
        _action(row),
        row.severity.name.lower(),
        "no" if row.role is None else f"{row.role.name.lower()}",
        f"{row.release} ({sign} {row.releases:g}{unit} for {row.clear_for:g} s)",
        f"{row.budget:g} s",
    ]
    return f"| {' | '.join(cells)} |"


def page() -> str:
    """Return the page's text."""
    lines = [_INTRO, "| action | meaning |", "|---|---|"]
    lines += [f"| {act.name} | {act.text} |" for act in Act]
    head = (
        "condition",
        "trips at",
        "delay",
        "missing for",
        "action",
        "severity",
        "latches for",
        "release",
        "budget",
    )
    for tier in Watcher:
        lines += ["", f"## Watched by the {tier.value}", ""]
        lines += [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
        lines += [_line(row) for row in safety.watched_by(safety.CONDITIONS, tier)]
    return "\n".join(lines) + "\n" + _AFTER


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
