"""Make docs/explanation/safety.md from the safety table."""

import math

from heliotrope import safety
from heliotrope.safety import Act, Condition, Watcher

PAGE = "docs/explanation/safety.md"

_INTRO = """\
# Safety

One table (`heliotrope.safety`) contains one row for each safety condition. The row says when the
condition trips, what is then done, and when it is released. The plant, the clusters and the local
controllers each evaluate the rows assigned to them. The evaluation is a pure function of readings,
state and monotonic time. `python -m scripts.pages` writes this page from the table. The handbook
says what each alarm means and what the operator should do.

The numbers are defaults. Before a plant runs with them, replace the wind limits by those of the
heliostat's maker and the receiver limits by those of the receiver's maker, in the tables
[`[safety.CONDITION]` of the plant file](../reference/plant-format.md#limits-of-the-site).
`heliotrope field safety PLANT` shows what is in force.

## Rules for every row

- A reading that is missing, not a number, or from the future is ignored. The last good reading is
  used until it is older than *stale after*; from then on the worst case is assumed. In rows about
  an age or a silence (*grows*), the time continues to increase without new readings.
- A row trips when its value has been at the limit or beyond it for the *delay*. It is released when
  fresh readings have been on the safe side of the release limit for the time given. Between the two
  limits it does not change. If readings stop arriving, nothing is released.
- A row that *latches* remains tripped until its cause has gone and a person with the given role, or
  a higher one, acknowledges it. An acknowledgement before the cause has gone is refused.
- If several rows have tripped, the strongest action applies; the list below goes from the weakest
  to the strongest. DEFOCUS and STOW pre-empt every motion. The release of a row does not move any
  heliostat: returning to the receiver needs a fresh command under the command authority.
- The *budget* is the time from the fault to the finished action, including the detection.
"""

_AFTER = f"""
## The proof of an emergency

An order to DEFOCUS or STOW the field starts a list of all heliostats (`Proof`). Each heliostat must
acknowledge the order within {safety.ORDER_BUDGET:g} s and have carried it out within
{safety.DEFOCUS_BUDGET:g} s (DEFOCUS) or {safety.STOW_BUDGET:g} s (STOW); a heliostat that fails to
do so is named. Reports from other heliostats, or from before the order, prove nothing. A fresh
reading must show that the flux on the receiver is below 10 % of nominal; otherwise
`flux_after_emergency` trips.

## Joining the receiver

A token bucket (`JoinLimiter`) limits how many heliostats join the receiver: at most
burst + rate · T in any span of T seconds.

## What the table does not do

The table is evaluated by software on ordinary computers, which has no safety integrity level. The
receiver's own protection and the emergency line must not depend on it. The limits have not been
tried on a real plant.
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
