"""The stepper of `lcu.stepper` for many heliostats at once, with the same integer arithmetic."""

from numba import njit

from heliotrope.jit import INNER, OPTIONS

SCALE = 1024
BOTH, PRIMARY_FIRST, SECONDARY_FIRST = 0, 1, 2


@njit(**INNER)
def _root(square):
    if square < 2:
        return square
    guess, size = 1, square
    while size:
        size >>= 2
        guess <<= 1
    while True:
        better = (guess + square // guess) >> 1
        if better >= guess:
            return guess
        guess = better


@njit(**INNER)
def _stopping(speed, change):
    m = speed // change
    return (m + 1) * speed - change * m * (m + 1) // 2


@njit(**INNER)
def _fastest(distance, change):
    m = (_root(8 * distance // change + 1) - 1) >> 1
    while change * m * (m + 1) // 2 > distance:
        m -= 1
    while change * (m + 1) * (m + 2) // 2 <= distance:
        m += 1
    return (distance + change * m * (m + 1) // 2) // (m + 1)


@njit(**INNER)
def _still(axes, i, k):
    a = axes[i, k]
    return a["speed"] == 0 and a["count"] == a["leg"] and a["leg"] == a["goal"]


@njit(**INNER)
def _stand(axes, i, k):
    axes[i, k]["goal"] = axes[i, k]["count"]
    axes[i, k]["leg"] = axes[i, k]["count"]
    axes[i, k]["braking"] = False


@njit(**INNER)
def _aim(axes, i, k, goal):
    a = axes[i, k]
    cut = min(max(goal, a["low"]), a["high"])
    axes[i, k]["goal"] = cut
    axes[i, k]["leg"] = cut
    axes[i, k]["braking"] = False
    axes[i, k]["led"] = False
    far = 0
    if a["direction"] > 0 and a["speed"] > a["change"]:
        far = _stopping(a["speed"] - a["change"], a["change"]) // SCALE + 1
    if cut < a["count"] + far:
        axes[i, k]["leg"] = max(a["low"], cut - a["backlash"])


@njit(**INNER)
def _slot(axes, i, k, held):
    a = axes[i, k]
    if a["speed"] == 0:
        axes[i, k]["phase"] = 0
        if axes[i, k]["count"] == axes[i, k]["leg"]:
            axes[i, k]["leg"] = axes[i, k]["goal"]
        if held or axes[i, k]["count"] == axes[i, k]["leg"]:
            return
        axes[i, k]["direction"] = 1 if axes[i, k]["leg"] > axes[i, k]["count"] else -1
    b = axes[i, k]
    slower = max(0, b["speed"] - b["change"])
    distance = b["direction"] * (b["leg"] - b["count"]) * SCALE - b["phase"]
    speed = slower
    if not (held or b["braking"] or distance < _stopping(slower, b["change"])):
        faster = min(b["speed"] + b["change"], b["top"], _fastest(distance, b["change"]))
        speed = max(slower, faster)
    moved = b["phase"] + speed
    axes[i, k]["speed"] = speed
    axes[i, k]["phase"] = moved % SCALE
    axes[i, k]["count"] += b["direction"] * (moved // SCALE)
    if axes[i, k]["braking"] and speed == 0:
        _stand(axes, i, k)


@njit(**OPTIONS)
def go_rows(axes, order, rows, goals, how):
    """Set step counts (M, 2) as goals, as `Stepper.go` does.

    Where ``how`` (M,) is -1, follow them as `Stepper.follow` does.
    """
    for j in range(len(rows)):
        i = rows[j]
        order[i] = BOTH if how[j] < 0 else how[j]
        for k in range(2):
            if how[j] >= 0:
                _aim(axes, i, k, goals[j, k])
                continue
            a = axes[i, k]
            lead = -(-a["backlash"] // 8)
            error = goals[j, k] - a["goal"]
            if error >= max(1, lead + 1 if a["led"] else 0):
                _aim(axes, i, k, goals[j, k])
            elif error <= -max(1, lead):
                _aim(axes, i, k, goals[j, k] - lead)
                axes[i, k]["led"] = True


@njit(**OPTIONS)
def brake_rows(axes, rows):
    """Slow down to a stop and drop the goals, as `Axis.brake` does."""
    for i in rows:
        for k in range(2):
            axes[i, k]["braking"] = True
            if axes[i, k]["speed"] == 0:
                _stand(axes, i, k)


@njit(**OPTIONS)
def still_rows(axes, queued, out):
    """Determine whether each heliostat is at rest, as `Stepper.still` does."""
    for i in range(len(axes)):
        out[i] = queued[i] <= 0 and _still(axes, i, 0) and _still(axes, i, 1)


@njit(**INNER)
def _carry(drives, i, k, steps):
    """Turn a motor by its emitted steps, and carry the joint along with the pushing gear flank."""
    turned, joint, play, lost, missed = drives
    if steps == 0:
        return
    if lost[i, k]:
        lost[i, k] = False
        missed[i, k] += 1
        steps -= 1 if steps > 0 else -1
    turned[i, k] += steps
    joint[i, k] = min(max(joint[i, k], turned[i, k]), turned[i, k] + play[i, k])


@njit(**OPTIONS)
def advance_rows(axes, order, queued, drives, elapsed_ms, slot_ms, ahead_ms):
    """Emit the steps that fit into the elapsed time, as `Stepper.advance` does.

    ``drives`` contains arrays of shape (N, 2): positions of motors, positions of joints, backlash,
    whether the next step is lost, and the number of steps lost so far.
    """
    for i in range(len(axes)):
        queued[i] -= elapsed_ms
        if queued[i] < 0:
            for k in range(2):
                axes[i, k]["speed"] = 0
                axes[i, k]["phase"] = 0
                if axes[i, k]["braking"]:
                    _stand(axes, i, k)
            queued[i] = 0
        while queued[i] < ahead_ms:
            if _still(axes, i, 0) and _still(axes, i, 1):
                break
            for k in range(2):
                waits = order[i] == (SECONDARY_FIRST if k == 0 else PRIMARY_FIRST)
                before = axes[i, k]["count"]
                _slot(axes, i, k, waits and not _still(axes, i, 1 - k))
                _carry(drives, i, k, axes[i, k]["count"] - before)
            queued[i] += slot_ms
