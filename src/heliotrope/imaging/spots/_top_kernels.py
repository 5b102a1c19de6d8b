# mypy: disable-error-code="no-untyped-call, untyped-decorator"
# mypy: allow-untyped-defs
"""Compiled kernels: assign each pixel to the local maximum from which it descends."""

import numpy as np
from numba import njit

from heliotrope.jit import INNER, OPTIONS


@njit(**INNER)
def _root(parent, number):
    """Follow merges and return the number of the top into which a top was finally merged."""
    while parent[number] != number:
        parent[number] = parent[parent[number]]
        number = parent[number]
    return number


@njit(**OPTIONS)
def number_tops(values, inside, foot, seed, dip, least, owner):
    """Label the local maxima (tops) of a picture in ``owner`` (H, W), and return their number.

    Pixels are processed in order of decreasing brightness. A pixel without labelled neighbours
    starts a new top. Where two tops meet, the lower top is merged into the higher one. The tops
    stay separate if the lower one is at least as high as ``seed`` and the brightness has dropped
    from it by the fraction ``dip`` and by ``least``. Other pixels join the top of their brightest
    neighbour.

    Parameters
    ----------
    values
        Brightness, (H, W).
    inside
        Mask of the pixels to label, (H, W).
    foot
        Fainter pixels belong to no top.
    seed, dip, least
        See above.
    owner
        Numbers of the tops from 1, highest first, and 0 for no top, (H, W), int32.
    """
    rows, columns = values.shape
    flat = values.ravel()
    bright = np.flatnonzero(inside.ravel() & (flat > foot))
    order = bright[np.argsort(-flat[bright])]
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
    kept = 0
    for number in range(1, count + 1):
        if parent[number] == number and peak[number] >= seed:
            kept += 1
            names[number] = kept
    out = owner.ravel()
    for place in order:
        out[place] = names[_root(parent, label[place])]
    return kept
