# mypy: disable-error-code="no-untyped-call, untyped-decorator"
# mypy: allow-untyped-defs
"""Compiled: which of a picture's tops each of its pixels descends from."""

import numpy as np
from numba import njit

from heliotrope.jit import OPTIONS


@njit(**OPTIONS)
def _root(parent, number):
    """Return the top that a top has become part of."""
    while parent[number] != number:
        parent[number] = parent[parent[number]]
        number = parent[number]
    return number


@njit(**OPTIONS)
def number_tops(values, inside, foot, seed, dip, least, owner):
    """Number the tops of a picture in ``owner`` (H, W), and return how many there are.

    The water falls: pixels appear in the order of their brightness. One without a neighbour
    is a new top; where two tops meet, the lower one becomes part of the higher one unless
    brightness has fallen by the part ``dip`` of its height, and by ``least``, since then, and
    it is as high as ``seed``. Other pixels go where their brightest neighbour went.

    Parameters
    ----------
    values
        Brightness, (H, W).
    inside
        Which pixels count, (H, W).
    foot
        Fainter ones belong to no top.
    seed, dip, least
        See above.
    owner
        Numbers from 1, highest first; 0 for none. (H, W) of int32.
    """
    rows, columns = values.shape
    flat = values.ravel()
    lit = np.flatnonzero(inside.ravel() & (flat > foot))
    order = lit[np.argsort(-flat[lit])]
    label = np.zeros(rows * columns, dtype=np.int32)
    parent = np.zeros(len(order) + 1, dtype=np.int32)
    peak = np.zeros(len(order) + 1, dtype=np.float64)
    count = 0
    for k in range(len(order)):
        place = order[k]
        value = flat[place]
        row, column = place // columns, place % columns
        high, nearest, brightest = 0, 0, -1.0
        for i in range(max(row - 1, 0), min(row + 2, rows)):
            for j in range(max(column - 1, 0), min(column + 2, columns)):
                number = label[i * columns + j]
                if number == 0:
                    continue
                top = _root(parent, number)
                if high == 0 or peak[top] > peak[high]:
                    high = top
                if values[i, j] > brightest:
                    brightest, nearest = values[i, j], number
        if high == 0:
            count += 1
            parent[count], peak[count], label[place] = count, value, count
            continue
        for i in range(max(row - 1, 0), min(row + 2, rows)):
            for j in range(max(column - 1, 0), min(column + 2, columns)):
                number = label[i * columns + j]
                if number == 0:
                    continue
                top = _root(parent, number)
                fallen = peak[top] - value
                if top != high and (fallen < max(dip * peak[top], least) or peak[top] < seed):
                    parent[top] = high
        label[place] = nearest
    names = np.zeros(count + 1, dtype=np.int32)
    found = 0
    for number in range(1, count + 1):
        if parent[number] == number and peak[number] >= seed:
            found += 1
            names[number] = found
    out = owner.ravel()
    for place in order:
        out[place] = names[_root(parent, label[place])]
    return found
