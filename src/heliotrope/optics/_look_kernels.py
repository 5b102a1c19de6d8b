# mypy: disable-error-code="no-untyped-call, untyped-decorator"
# mypy: allow-untyped-defs
"""Compiled: each mirror's image at several aims, and how beam displacements change it.

The Gaussians are those of `_image_kernels`; here they are not summed over the field. An image is a
rectangle of cells, kept column after column, so that moving an image by a row only moves a pointer.
"""

import math

import numpy as np
from numba import njit

from heliotrope.jit import INNER, OPTIONS
from heliotrope.optics._image_kernels import (
    _FAST,
    IMAGE,
    _blur,
    _columns,
    _distance,
    _gauss,
    _images,
    _ray,
)


@njit(**INNER)
def _seen_from(facing, count):
    """Return the visible column after which the rest follow without a gap."""
    for k in range(1, count):
        if int(facing[0, k]) != int(facing[0, k - 1]) + 1:
            return k
    return 0


@njit(**_FAST)
def _bounds(local, count, start, begin, end, least, tops, box):
    """Find the rectangle of cells above ``least``: first column, columns, first row, rows."""
    for k in range(count):
        tops[k] = 0.0
    for r in range(begin, end + 1):
        line = local[r]
        for k in range(count):
            tops[k] = max(tops[k], line[k])
    peak = 0.0
    for k in range(count):
        peak = max(peak, tops[k])
    west, right = count, -1
    for m in range(count):
        if tops[(start + m) % count] > peak * least:
            west, right = min(west, m), m
    bottom, top = _edge(local, count, begin, end, peak * least), end
    while top > bottom and _highest(local[top], count) <= peak * least:
        top -= 1
    box[0], box[1], box[2], box[3] = west, right - west + 1, bottom, top - bottom + 1
    return peak > 0.0


@njit(**_FAST)
def _highest(line, count):
    top = 0.0
    for k in range(count):
        top = max(top, line[k])
    return top


@njit(**_FAST)
def _edge(local, count, begin, end, low):
    while begin < end and _highest(local[begin], count) <= low:
        begin += 1
    return begin


@njit(**_FAST)
def _keep(local, visible, first, box, values, used):
    """Copy the cells of a rectangle column by column, then clear all cells."""
    columns, rows = box[1], box[3]
    for r in range(rows):
        line = local[box[2] + r]
        at, k = used + r, first
        for _ in range(columns):
            values[at] = line[k]
            at += rows
            k += 1
            if k == visible:
                k = 0
    for r in range(len(local)):
        line = local[r]
        for k in range(visible):
            line[k] = 0.0


@njit(**OPTIONS)
def look(first, last, looks, mirrors, sun, light, slopes, pointing, sums, parts, surfaces, moments,
         shape, columns, grid, least, reach, values, boxes, begins):  # fmt: skip
    """Compute the cells of images ``first`` to ``last``, W/m², with ``looks`` images per mirror.

    ``mirrors`` has one row for each image. ``reach`` (H,): number of rows below and above the
    surface that are included; ``grid`` contains the largest of these numbers. ``boxes`` (J, 4)
    receives the first column, columns, first row and rows of each image. ``begins`` (J,) is where
    the cells of each image begin in ``values``; the caller sets the first entry. Cells below
    ``least`` of an image's peak are left out at its edges.
    """
    weights, variances = sums
    low, step, number, _ = grid
    wide = len(columns[0])
    facing, local = np.empty((8, wide)), np.zeros((number, wide))
    room = (
        np.empty(wide), np.empty(wide), np.empty(wide), np.empty(wide), np.empty(wide),
        np.empty(wide),
    )  # fmt: skip
    ray, axes = np.empty(3), np.empty((2, 3))
    turn, work = np.empty((2, 2)), (np.empty((2, 2)), np.empty((2, 2)), np.empty(2))
    most, total, used, tall = 1, 0.0, begins[first], max(reach)
    for j in range(first, last):
        i = j // looks
        most = max(most, parts[3][i + 1] - parts[3][i])
    images, box = np.empty((most, IMAGE + 2)), np.empty(4, dtype=np.int64)
    for k in range(len(weights)):
        total += weights[k] * variances[k]
    for j in range(first, last):
        i, row = j // looks, mirrors[j]
        boxes[j, 0] = boxes[j, 1] = boxes[j, 2] = boxes[j, 3] = 0
        begins[j] = used
        cosine = _ray(row, sun, ray, axes)
        t = _distance(row, ray, shape)
        if light[i] <= 0.0 or cosine <= 0.0 or t <= 0.0:
            continue
        uu, uv, vv = _blur(row, sun, cosine, axes, slopes[i], pointing[i], turn)
        sigma = t * math.sqrt(0.5 * (uu + vv) + total)
        count, _ = _images(
            i, row, sun, ray, axes, cosine, t, t, sigma, parts, surfaces, moments, images, work
        )
        visible = _columns(row, ray, axes, t, shape, columns, facing)
        if not visible:
            continue
        begin, end = number, -1
        for m in range(count):
            image = images[m]
            for g in range(len(weights)):
                more = variances[g]
                a, b = _gauss(
                    weights[g] * image[0] * light[i], image[1], image[2],
                    image[3] + t * t * (uu + more), image[4] + t * t * uv,
                    image[5] + t * t * (vv + more),
                    facing, visible, low, step, number, local, room,
                )  # fmt: skip
                begin, end = min(begin, a), max(end, b)
        start = _seen_from(facing, visible)
        begin, end = max(begin, tall - reach[i]), min(end, number - 1 - tall + reach[i])
        if _bounds(local, visible, start, begin, end, least, room[0], box):
            boxes[j, 0] = int(facing[0, (start + box[0]) % visible])
            boxes[j, 1], boxes[j, 2], boxes[j, 3] = box[1], box[2], box[3]
        else:
            box[1] = box[3] = 0
        _keep(local, visible, (start + box[0]) % visible, box, values, used)
        used += box[1] * box[3]


@njit(**OPTIONS)
def spread(first, last, rows, mirrors, sun, light, slopes, pointing, sums, parts, surfaces, moments,
           shape, columns, grid, scatter, modes, worth, own, shared, value, slope):  # fmt: skip
    """Add the effect of beam errors of mirrors ``rows[first:last]`` on each cell.

    ``scatter`` (H, 3): Cholesky factor (uu, uv, vv) of the covariance of each beam's own error,
    rad. ``modes`` (H, M, 2): displacement of each beam by M shared errors, rad. ``own`` (rows,
    columns) gets variances, (W/m²)²; ``shared`` (M, rows, columns) receives changes of flux, W/m²;
    ``value`` (H,) receives, for each mirror, the sum over cells of its own variance times ``worth``
    (rows, columns). ``slope`` (H, 2) receives the derivative of each mirror's power, with each cell
    weighted by its ``worth``, with respect to its beam's displacement, W/rad.
    """
    weights, variances = sums
    low, step, number, area = grid
    wide = len(columns[0])
    facing, local = np.empty((8, wide)), np.zeros((number, wide))
    room = (
        np.empty(wide), np.empty(wide), np.empty(wide), np.empty(wide), np.empty(wide),
        np.empty(wide),
    )  # fmt: skip
    ray, axes = np.empty(3), np.empty((2, 3))
    turn, work = np.empty((2, 2)), (np.empty((2, 2)), np.empty((2, 2)), np.empty(2))
    most, box, total = 1, step * step / 12.0, np.sum(weights * variances)
    gradient = np.zeros((2, number, wide))
    for i in rows[first:last]:
        most = max(most, parts[3][i + 1] - parts[3][i])
    images = np.empty((most, IMAGE + 2))
    for i in rows[first:last]:
        row = mirrors[i]
        cosine = _ray(row, sun, ray, axes)
        t = _distance(row, ray, shape)
        if light[i] <= 0.0 or cosine <= 0.0 or t <= 0.0:
            continue
        uu, uv, vv = _blur(row, sun, cosine, axes, slopes[i], pointing[i], turn)
        sigma = t * math.sqrt(0.5 * (uu + vv) + total)
        count, _ = _images(
            i, row, sun, ray, axes, cosine, t, t, sigma, parts, surfaces, moments, images, work
        )
        visible = _columns(row, ray, axes, t, shape, columns, facing)
        if not visible:
            continue
        first_row, last_row = number, -1
        for n in range(count * len(weights)):
            image, g = images[n // len(weights)], n % len(weights)
            su = image[3] + t * t * (uu + variances[g])
            sv, suv = image[5] + t * t * (vv + variances[g]), image[4] + t * t * uv
            begin, end = _gauss(
                weights[g] * image[0] * light[i], image[1], image[2], su, suv, sv,
                facing, visible, low, step, number, local, room,
            )  # fmt: skip
            first_row, last_row = min(first_row, begin), max(last_row, end)
            for r in range(begin, end + 1):
                z = low + r * step
                for k in range(visible):
                    du, dv, wu, wv = facing[3, k], facing[4, k], facing[5, k], facing[6, k]
                    a = su + box * du * du + wu * wu
                    b = suv + box * du * dv + wu * wv
                    c = sv + box * dv * dv + wv * wv
                    scale = t * local[r, k] / (a * c - b * b)
                    pu, pv = facing[1, k] - image[1] + z * du, facing[2, k] - image[2] + z * dv
                    gradient[0, r, k] += scale * (c * pu - b * pv)
                    gradient[1, r, k] += scale * (a * pv - b * pu)
                    local[r, k] = 0.0
        _take(
            gradient, first_row, last_row, facing, visible, scatter[i], modes[i], worth, own,
            shared, i, value, slope[i],
        )  # fmt: skip
        slope[i, 0] *= area
        slope[i, 1] *= area


@njit(**_FAST)
def _take(gradient, begin, end, facing, visible, scatter, modes, worth, own, shared, i, value,
          slope):  # fmt: skip
    """Add the squares and the sums of a mirror's derivatives, and clear the derivatives."""
    for r in range(begin, end + 1):
        for k in range(visible):
            gu, gv, column = gradient[0, r, k], gradient[1, r, k], int(facing[0, k])
            gradient[0, r, k] = gradient[1, r, k] = 0.0
            slope[0] += gu * worth[r, column]
            slope[1] += gv * worth[r, column]
            one, two = scatter[0] * gu + scatter[1] * gv, scatter[2] * gv
            square = one * one + two * two
            own[r, column] += square
            value[i] += square * worth[r, column]
            for m in range(len(modes)):
                shared[m, r, column] += modes[m, 0] * gu + modes[m, 1] * gv
