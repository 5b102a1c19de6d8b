"""Make docs/explanation/safety.md from the safety table."""

import math

from heliotrope import safety
from heliotrope.safety import Act, Condition, Watcher

PAGE = "docs/explanation/safety.md"

_INTRO = """\
# Safety

One table (`heliotrope.safety`) says what trips, what is then done, and when it ends. The plant,
the clusters and the local controllers each evaluate the rows assigned to them. The evaluation is
a pure function of readings, state and monotonic time. `python -m scripts.pages` writes this page
from the table. The handbook says what each alarm means and what
the operator should do.

The numbers are defaults. Before a plant runs with them, replace the wind limits by those of the
heliostat's maker and the receiver limits by those of the receiver's maker, in the tables
[`[safety.CONDITION]` of the plant file](../reference/plant-format.md#limits-of-the-site).
`heliotrope field safety PLANT` shows what is in force.

## Rules for every row

- A reading that is missing, not a number, or from the future does not count. The last good reading
  counts until it is older than *stale after*; from then on the worst case counts. A row on an age
  or on silence keeps counting without new readings.
- A row trips when its value has been at the limit or beyond it for the *delay*. It releases when
  fresh readings have been on the safe side of the release limit for the time given. Between the two
  limits it stays as it is. If readings stop arriving, nothing is released.
- A row that *latches* stays until its cause has gone and a person with the given role, or a
  higher one, acknowledges it. An acknowledgement before that is refused.
- The strongest action wins, in the order of the list below. DEFOCUS and STOW pre-empt every motion.
  Releasing a row does not move any heliostat: returning to the receiver needs a fresh command under
  the command authority.
- The *budget* runs from the fault to the finished action and includes the detection.
"""

_AFTER = f"""
## The proof of an emergency

An order to DEFOCUS or STOW the field lists every heliostat (`Proof`). Each of them must acknowledge
within {safety.ORDER_BUDGET:g} s and be done within {safety.DEFOCUS_BUDGET:g} s (DEFOCUS) or
{safety.STOW_BUDGET:g} s (STOW); a heliostat that is not is named. Reports from other heliostats
and from before the order prove nothing. A fresh reading must show the flux on the receiver below
10 % of nominal; otherwise `flux_after_emergency` trips.

## Joining the receiver

A token bucket (`JoinLimiter`) bounds how many heliostats join: in any span of T seconds at most
burst + rate · T.

## What the table does not do

It is software on ordinary computers and has no safety integrity level. The protection of the
receiver and the emergency line must not depend on it. The limits have not been tried on a plant.
"""


def _trip(row: Condition) -> str:
    if row.unit == "yes/no":
        return row.what if row.above else f"no {row.what}"
    return f"{row.what} {'≥' if row.above else '≤'} {_value(row, row.trips)}"


def _value(row: Condition, value: float) -> str:
    return f"{value:g} rad" if row.unit == "rad" else row.shown(value)


def _action(row: Condition) -> str:
    then = "" if math.isinf(row.then_stow) else f", STOW after {row.then_stow:g} s"
    return f"{row.ordered(row.act)} {row.scope.name.lower()}{then}"


def _release(row: Condition) -> str:
    limit = f"{'≤' if row.above else '≥'} {_value(row, row.releases)} "
    return f"{row.release} ({'' if row.unit == 'yes/no' else limit}for {row.clear_for:g} s)"


def _line(row: Condition) -> str:
    cells = [
        f"`{row.name}`",
        _trip(row),
        f"{row.delay:g} s",
        "grows" if row.ages else f"{row.stale_after:g} s",
        _action(row),
        row.severity,
        "no" if row.role is None else row.role.title,
        _release(row),
        f"{row.budget:g} s",
    ]
    return f"| {' | '.join(cells)} |"


def pages() -> dict[str, str]:
    """Return the page's text, by path."""
    lines = [_INTRO, "| action | meaning |", "|---|---|"]
    lines += [f"| {act.name} | {act.text} |" for act in Act]
    head = (
        "condition",
        "trips at",
        "delay",
        "stale after",
        "action",
        "severity",
        "latches for",
        "releases when",
        "budget",
    )
    for tier in Watcher:
        lines += ["", f"## Watched by the {tier.value}", ""]
        lines += [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
        lines += [_line(row) for row in safety.watched_by(safety.CONDITIONS, tier)]
    return {PAGE: "\n".join(lines) + "\n" + _AFTER}
