# mypy: disable-error-code="no-untyped-call, untyped-decorator"
# mypy: allow-untyped-defs
"""Compiled: prices images, and lets each mirror in turn take its most valuable aim.

Candidate a of mirror i is image ``a // S`` of the mirror, moved up by ``shifts[i, a % S]`` rows;
−1 is none: the mirror is defocused. Maps are (columns, rows), so that a column lies in a row.
"""

import numpy as np
from numba import njit

from heliotrope.jit import INNER, OPTIONS

_SUMS = {**OPTIONS, "fastmath": {"reassoc", "contract", "nsz", "nnan"}}
_INNER_SUMS = {**INNER, "fastmath": {"reassoc", "contract", "nsz", "nnan"}}


@njit(**_INNER_SUMS)
def _dot(values, at, line, start, count):
    a, b = values[at : at + count], line[start : start + count]
    total = np.float32(0.0)
    for r in range(count):
        total += a[r] * b[r]
    return total


@njit(**_INNER_SUMS)
def _worth(i, images, shifts, price, spans, out):
    """Compute the sums of price times flux for all candidates of mirror i."""
    values, begin, box, looks, weight = images
    count, wide = shifts.shape[1], len(price)
    for k in range(looks):
        j = i * looks + k
        first, columns, bottom, rows = box[j, 0], box[j, 1], box[j, 2], box[j, 3]
        for s in range(count):
            out[k * count + s] = 0.0
        at, c = begin[j], first
        for _ in range(columns):
            if spans[c, 1] > spans[c, 0]:
                line = price[c]
                for s in range(count):
                    row = bottom + shifts[i, s]
                    low, high = max(row, spans[c, 0]), min(row + rows, spans[c, 1])
                    if high > low:
                        out[k * count + s] += _dot(values, at + low - row, line, low, high - low)
            at += rows
            c += 1
            if c == wide:
                c = 0
        for s in range(count):
            out[k * count + s] *= weight[i]


@njit(**_SUMS)
def worths(first, last, images, shifts, price, spans, out):
    """Sum price times flux over all cells, for each candidate of the mirrors first to last − 1.

    ``price`` (columns, rows) in 32 bits; ``spans`` (columns, 2): rows where it is not zero; ``out``
    (H, A).
    """
    for i in range(first, last):
        _worth(i, images, shifts, price, spans, out[i])


@njit(**_INNER_SUMS)
def _rectangle(i, a, images, shifts, number):
    """Return the first column, columns, first row, end row, position and height of the cells.

    The cells are those of one candidate's image.
    """
    _, begin, box, looks, _ = images
    count = shifts.shape[1]
    j = i * looks + a // count
    row = box[j, 2] + shifts[i, a % count]
    low, high = max(row, 0), min(row + box[j, 3], number)
    return box[j, 0], box[j, 1], low, high, begin[j] + low - row, box[j, 3]


@njit(**_INNER_SUMS)
def _add(i, a, sign, images, shifts, flux):
    """Add a candidate's image to the flux."""
    values, weight = images[0], images[4]
    wide, number = flux.shape
    c, columns, low, high, at, rows = _rectangle(i, a, images, shifts, number)
    scale = sign * weight[i]
    for _ in range(columns):
        line = flux[c]
        for r in range(low, high):
            line[r] += scale * values[at + r - low]
        at += rows
        c += 1
        if c == wide:
            c = 0


@njit(**_SUMS)
def charge(values, begin, box, looks, weight, rate, across, up, loads):
    """Add ``rate`` times the variance of each image to ``loads``.

    ``across`` and ``up`` (H,): displacement of the mirror's beam by its own error, over the size of
    two cells.
    """
    for j in range(len(begin)):
        i, columns, rows = j // looks, box[j, 1], box[j, 3]
        for c in range(columns):
            left = begin[j] + max(c - 1, 0) * rows
            right = begin[j] + min(c + 1, columns - 1) * rows
            at = begin[j] + c * rows
            for r in range(rows):
                low, high = max(r - 1, 0), min(r + 1, rows - 1)
                a = across[i] * (values[right + r] - values[left + r])
                b = up[i] * (values[at + high] - values[at + low])
                loads[at + r] += rate * weight[i] * (a * a + b * b)


@njit(**_SUMS)
def peaks(images, out):
    """Compute the greatest load of each mirror, (H,)."""
    values, begin, box, looks, weight = images
    for j in range(len(begin)):
        i = j // looks
        for k in range(begin[j], begin[j] + box[j, 1] * box[j, 3]):
            out[i] = max(out[i], weight[i] * values[k])


@njit(**_SUMS)
def sum_of(mirrors, choice, images, shifts, flux):
    """Add the chosen images of some mirrors to the flux (columns, rows)."""
    for i in mirrors:
        if choice[i] >= 0:
            _add(i, choice[i], 1.0, images, shifts, flux)


@njit(**_INNER_SUMS)
def _add_priced(i, a, sign, images, shifts, flux, base, steep, price, spans):
    """Add a candidate's image to the flux, and update the prices of its cells."""
    values, weight = images[0], images[4]
    wide, number = flux.shape
    c, columns, low, high, at, rows = _rectangle(i, a, images, shifts, number)
    scale, count = sign * weight[i], high - low
    for _ in range(columns):
        light, line = values[at : at + count], flux[c, low:high]
        slope, toll, new = steep[c, low:high], base[c, low:high], price[c, low:high]
        for r in range(count):
            line[r] += scale * light[r]
            new[r] = max(toll[r] + slope[r] * line[r], 0.0)
        for r in range(low, min(spans[c, 0], high)):
            if price[c, r] > 0.0:
                spans[c, 0] = r
                break
        for r in range(high - 1, max(spans[c, 1], low) - 1, -1):
            if price[c, r] > 0.0:
                spans[c, 1] = r + 1
                break
        at += rows
        c += 1
        if c == wide:
            c = 0


@njit(**_SUMS)
def sweep(order, images, shifts, power, idle, base, steep, choice, flux, price, spans):
    """Let each mirror in turn take its most valuable candidate.

    The price of flux in a cell is ``max(0, base + steep flux)``, W per W/m², as in an augmented
    Lagrangian. ``power`` (H, A) in W; ``idle``: the value of sending no light, W. ``choice`` (H,),
    ``flux``, ``price`` and ``spans`` are kept up to date.
    """
    worth = np.empty(power.shape[1])
    for i in order:
        before = choice[i]
        if before >= 0:
            _add_priced(i, before, -1.0, images, shifts, flux, base, steep, price, spans)
        _worth(i, images, shifts, price, spans, worth)
        best, gain = -1, idle
        for a in range(len(worth)):
            value = power[i, a] - worth[a]
            if value > gain:
                best, gain = a, value
        choice[i] = best
        if best >= 0:
            _add_priced(i, best, 1.0, images, shifts, flux, base, steep, price, spans)


@njit(**_INNER_SUMS)
def _excess(i, a, images, shifts, over, most):
    """Return the excess over the cap that a candidate adds, summed over its cells.

    The sum stops at ``most``. It begins in the middle of the image, where the light is.
    """
    values, weight = images[0], images[4]
    wide, number = over.shape
    first, columns, low, high, at, rows = _rectangle(i, a, images, shifts, number)
    scale, count = weight[i], high - low
    total = 0.0
    for k in range(columns):
        column = (columns // 2 + k) % columns
        line = over[(first + column) % wide, low:high]
        begin = at + column * rows
        light = values[begin : begin + count]
        for r in range(count):
            total += max(0.0, line[r] + scale * light[r]) - max(0.0, line[r])
        if total > most:
            return total
    return total


@njit(**_INNER_SUMS)
def _free(i, a, images, shifts, over):
    """Return whether none of a candidate's cells is above the cap."""
    wide, number = over.shape
    first, columns, low, high, _, _ = _rectangle(i, a, images, shifts, number)
    for k in range(columns):
        column = (columns // 2 + k) % columns
        line = over[(first + column) % wide, low:high]
        for r in range(high - low):
            if line[r] > 0.0:
                return False
    return True


@njit(**_SUMS)
def settle(order, images, shifts, power, idle, choice, over, fine, fill):
    """Let each mirror in turn take the best candidate after penalties.

    ``over``: flux minus the cap, W/m², (columns, rows), kept up to date. ``fine``: penalty on the
    excess that a candidate adds, W per W/m². ``idle``: the value of sending no light, W. Without
    ``fill`` only mirrors that add to an excess change.
    """
    net = np.empty(power.shape[1])
    for i in order:
        before = choice[i]
        top = 0.0
        for a in range(len(net)):
            net[a] = power[i, a]
            top = max(top, net[a])
        if before >= 0:
            if (not fill or net[before] >= top) and _free(i, before, images, shifts, over):
                continue
            _add(i, before, -1.0, images, shifts, over)
        elif not fill:
            continue
        best, gain = -1, idle
        if before >= 0:
            # The others are given up as soon as they are worse than this one.
            more = _excess(i, before, images, shifts, over, np.inf)
            value = net[before] - fine * more
            if value > gain:
                best, gain = before, value
            net[before] = -1e300
        for a in range(len(net)):
            if net[a] <= gain:
                continue
            most = (net[a] - max(gain, -1e15)) / fine
            value = net[a] - fine * _excess(i, a, images, shifts, over, most)
            if value > gain:
                best, gain = a, value
        choice[i] = best
        if best >= 0:
            _add(i, best, 1.0, images, shifts, over)


@njit(**_SUMS)
def place(order, images, shifts, cells, choice, flux):
    """Let each mirror in turn aim where the flux is lowest.

    ``cells`` (H, A, 2): column and row of each candidate, −1 if the candidate is excluded.
    """
    for i in order:
        best, least = -1, 1e300
        for a in range(cells.shape[1]):
            if cells[i, a, 0] < 0:
                continue
            value = flux[cells[i, a, 0], cells[i, a, 1]]
            if value < least:
                best, least = a, value
        choice[i] = best
        _add(i, best, 1.0, images, shifts, flux)
