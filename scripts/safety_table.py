"""Make docs/explanation/safety.md from the safety table."""

import math

from heliotrope import safety
from heliotrope.safety import Act, Condition, Watcher

PAGE = "docs/explanation/safety.md"

_INTRO = """\
# Safety

The safety table (`heliotrope.safety`) has one row for each safety condition. The row says when the
condition trips, what is then done, and when it is released. The plant, the clusters and the local
controllers each evaluate the rows assigned to them. The evaluation is a pure function of readings,
state and monotonic time. `python -m scripts.pages` writes this page from the table. [The
handbook](../how-to/handbook.md) says what each alarm means and what the operator should do.

The numbers below are defaults. Before you run a real plant, replace the wind limits by those of
the heliostat's manufacturer, and the receiver limits by those of the receiver's manufacturer. Do
this in the tables [`[safety.CONDITION]` of the plant
file](../reference/plant-format.md#limits-of-the-site). `heliotrope field safety PLANT` shows the
values that are in force.

## Rules for every row

- A reading that is missing, not a number, or from the future is ignored. The last good reading is
  used until it is older than *stale after*; from then on the worst case is assumed. Some rows
  measure the time since something was last received. While nothing arrives, their value continues
  to grow; in the column *stale after* these rows are marked *grows*.
- A row trips when its value has been at the limit or beyond it for the *delay*. It is released when
  fresh readings have been on the safe side of the release limit for the time given in *releases
  when*. Between the two limits the row stays as it is. If readings stop arriving, nothing is
  released.
- A row that *latches* remains tripped until its cause has gone and a person with the given role, or
  a higher one, acknowledges it. An acknowledgement before the cause has gone is refused.
- If several rows have tripped, the strongest of their actions applies; the list below goes from
  the weakest to the strongest. DEFOCUS and STOW interrupt every motion. The release of a row does
  not move any heliostat: to return to the receiver, heliostats need a new command from the holder
  of the command authority.
- The *budget* is the time allowed from the fault to the finished action, including the time to
  detect the fault.
"""

_AFTER = f"""
## The proof of an emergency

When the whole field is ordered to DEFOCUS or STOW, the plant keeps a list of all heliostats
(`Proof`). Each heliostat must acknowledge the order within {safety.ORDER_BUDGET:g} s and have
carried it out within {safety.DEFOCUS_BUDGET:g} s (DEFOCUS) or {safety.STOW_BUDGET:g} s (STOW); a
heliostat that fails to do so is named. Reports from other heliostats, or from before the order,
prove nothing. A fresh reading must show that the flux on the receiver is below 10 % of nominal;
otherwise `flux_after_emergency` trips.

## Joining the receiver

A token bucket (`JoinLimiter`) limits how many heliostats join the receiver: at most
burst + rate · T in any span of T seconds.

## What the table does not do

The table is evaluated by software that has no safety integrity level (SIL), on ordinary computers.
The receiver's own protection and the emergency line must not depend on it. The limits have not been
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
