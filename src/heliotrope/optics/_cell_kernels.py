# mypy: disable-error-code="no-untyped-call, untyped-decorator"
# mypy: allow-untyped-defs
"""Compiled: the images of mirrors on cells of any shape, which may lie behind an aperture.

The cells lie at different distances from a mirror, so its images are computed at the depth of each
cell: along the central ray positions are linear in the depth, and covariances are quadratic. See
`_image_kernels` for the images.
"""

import math

import numpy as np
from numba import njit

from heliotrope.jit import INLINED, INNER, OPTIONS
from heliotrope.optics._image_kernels import (
    DEEP,
    IMAGE,
    _axis,
    _blur,
    _dot,
    _images,
    _of,
    _ray,
)

#: Depths at which the images are computed, relative to the middle of the cells, as fractions of the
#: distance.
NODES = (-0.1, 0.0, 0.1)


@njit(**INNER)
def _room(first, last, rows, parts):
    """Return the arrays that the images of one mirror after another need."""
    most = 1
    for i in rows[first:last]:
        most = max(most, parts[3][i + 1] - parts[3][i])
    work = (np.empty((2, 2)), np.empty((2, 2)), np.empty(2))
    images = np.empty((3, most, IMAGE + 2))
    return np.empty(3), np.empty((2, 3)), work, images, np.empty(12)


@njit(**INNER)
def _start(i, mirrors, sun, slopes, pointing, total, parts, surfaces, moments, middle, aperture,
           room):  # fmt: skip
    """Compute the images of mirror i at `NODES`.

    Return the distance to the middle of the cells, the blur (uu, uv, vv), the number of images and
    the area of the light; all 0 if the mirror is lit from behind.
    """
    ray, axes, work, images, gate = room
    row = mirrors[i]
    cosine = _ray(row, sun, ray, axes)
    if cosine <= 0.0:
        return 0.0, (0.0, 0.0, 0.0), 0, 0.0
    away = (middle[0] - row[0], middle[1] - row[1], middle[2] - row[2])
    t = _dot(ray, away)
    reach = t if t > 0.0 else 1.0
    blur = _blur(row, sun, cosine, axes, slopes[i], pointing[i], work[0])
    sigma = reach * math.sqrt(0.5 * (blur[0] + blur[2]) + total)
    count, leaving = 0, 0.0
    for n in range(3):
        count, leaving = _images(
            i, row, sun, ray, axes, cosine, reach, (1.0 + NODES[n]) * reach, sigma, parts, surfaces,
            moments, images[n], work,
        )  # fmt: skip
    if len(aperture):
        _gate(aperture, row, ray, axes, gate)
    return t, blur, count, leaving


@njit(**INNER)
def _on_cells(cells, hidden, row, t, blur, count, sums, total, aperture, steep, room, out):
    """Compute the flux on each cell per power across the light, 1/m², and its derivatives.

    The derivatives are those with respect to a displacement of the beam, 1/m² rad; they are
    computed only if ``steep`` is true. ``out`` (3, C) gets all three.
    """
    ray, axes, _, images, gate = room
    weights, variances = sums
    wide, greatest = (blur[0] + total, blur[1], blur[2] + total), np.max(variances)
    for k in range(len(cells)):
        out[0, k] = out[1, k] = out[2, k] = 0.0
        cell = cells[k]
        x, y, z = cell[0] - row[0], cell[1] - row[1], cell[2] - row[2]
        depth = x * ray[0] + y * ray[1] + z * ray[2]
        facing = -(x * cell[3] + y * cell[4] + z * cell[5])
        if hidden[k] or facing <= 0.0 or depth <= 0.0:
            continue
        u = x * axes[0, 0] + y * axes[0, 1] + z * axes[0, 2]
        v = x * axes[1, 0] + y * axes[1, 1] + z * axes[1, 2]
        square = depth * depth
        # A variance is at most the sum of the variances along two axes.
        widest = cell[7] + cell[11] + cell[15] + square * (blur[0] + blur[2] + 2.0 * greatest)
        scale = facing / math.sqrt(x * x + y * y + z * z) / (2.0 * math.pi)
        for m in range(count):
            image = _at(images, m, depth / t - 1.0)
            pu, pv = u - image[0], v - image[1]
            if pu * pu + pv * pv > 2.0 * DEEP * (image[2] + image[4] + widest):
                continue
            own = (_form(cell, axes, 0, 0), _form(cell, axes, 0, 1), _form(cell, axes, 1, 1))
            b, density, slope_u, slope_v = image[3] + own[1] + square * blur[1], 0.0, 0.0, 0.0
            for g in range(len(weights)):
                a = image[2] + own[0] + square * (blur[0] + variances[g])
                c = image[4] + own[2] + square * (blur[2] + variances[g])
                inverse = 1.0 / (a * c - b * b)
                form = (pu * pu * c - 2.0 * pu * pv * b + pv * pv * a) * inverse
                if form < 2.0 * DEEP:
                    part = weights[g] * math.exp(-0.5 * form) * math.sqrt(inverse)
                    density += part
                    if steep:
                        slope_u += part * depth * (c * pu - b * pv) * inverse
                        slope_v += part * depth * (a * pv - b * pu) * inverse
            passed = scale * images[1, m, 0]
            if len(aperture) and density != 0.0:
                depths = (_before(gate, x, y, z), depth)
                passed *= _passes(images, m, gate, t, depths, (pu, pv), image, own, wide)
            out[0, k] += passed * density
            out[1, k] += passed * slope_u
            out[2, k] += passed * slope_v


@njit(**OPTIONS)
def cast_cells(first, last, rows, mirrors, sun, light, slopes, pointing, sums, parts, surfaces,
               moments, middle, cells, hidden, group, aperture, sign, flux, out):  # fmt: skip
    """Add the images of mirrors ``rows[first:last]`` to the flux of cells of any shape.

    ``cells`` (C, 16): centre, normal, area and second moments (9) of each cell. ``hidden`` (D, C):
    cells that other cells hide as seen from each of D directions; ``group`` (H,) is the direction
    of each mirror. ``aperture``: centre, right and up (3 each) and half sizes of a rectangle that
    the light must pass; empty if there is none. ``flux`` (C,) in W/m²; ``out`` (H, 2) is as in
    `cast`.
    """
    total, room = np.sum(sums[0] * sums[1]), _room(first, last, rows, parts)
    densities = np.empty((3, len(cells)))
    for i in rows[first:last]:
        out[i, 0] = out[i, 1] = 0.0
        if light[i] <= 0.0:
            continue
        t, blur, count, leaving = _start(
            i, mirrors, sun, slopes, pointing, total, parts, surfaces, moments, middle, aperture,
            room,
        )  # fmt: skip
        out[i, 0] = light[i] * leaving
        if t <= 0.0:
            continue
        _on_cells(
            cells, hidden[group[i]], mirrors[i], t, blur, count, sums, total, aperture, False, room,
            densities,
        )  # fmt: skip
        caught = 0.0
        for k in range(len(cells)):
            flux[k] += sign * light[i] * densities[0, k]
            caught += light[i] * densities[0, k] * cells[k, 6]
        out[i, 1] = caught


@njit(**OPTIONS)
def spread_cells(first, last, rows, mirrors, sun, light, slopes, pointing, sums, parts, surfaces,
                 moments, middle, cells, hidden, group, aperture, scatter, modes, worth, own,
                 shared, value, slope):  # fmt: skip
    """Add the effect of beam errors of mirrors ``rows[first:last]`` on each cell.

    ``own`` (C,), ``shared`` (M, C), ``worth`` (C,), and everything else as in `cast_cells` and in
    `_look_kernels.spread`.
    """
    total, room = np.sum(sums[0] * sums[1]), _room(first, last, rows, parts)
    densities = np.empty((3, len(cells)))
    for i in rows[first:last]:
        if light[i] <= 0.0:
            continue
        t, blur, count, _ = _start(
            i, mirrors, sun, slopes, pointing, total, parts, surfaces, moments, middle, aperture,
            room,
        )  # fmt: skip
        if t <= 0.0:
            continue
        _on_cells(
            cells, hidden[group[i]], mirrors[i], t, blur, count, sums, total, aperture, True, room,
            densities,
        )  # fmt: skip
        for k in range(len(cells)):
            u, v = light[i] * densities[1, k], light[i] * densities[2, k]
            du, dv = scatter[i, 0] * u + scatter[i, 1] * v, scatter[i, 2] * v
            own[k] += du * du + dv * dv
            value[i] += (du * du + dv * dv) * worth[k]
            slope[i, 0] += u * cells[k, 6] * worth[k]
            slope[i, 1] += v * cells[k, 6] * worth[k]
            for m in range(modes.shape[1]):
                shared[m, k] += modes[i, m, 0] * u + modes[i, m, 1] * v


@njit(**INLINED)
def _at(images, m, beyond):
    """Return the mean (2) and the covariance (3) of image m at a depth, from those at `NODES`.

    Positions are linear in the depth and covariances quadratic, so three depths determine both.
    """
    x = beyond / NODES[2]
    low, middle, high = 0.5 * x * (x - 1.0), 1.0 - x * x, 0.5 * x * (x + 1.0)
    return (
        low * images[0, m, 1] + middle * images[1, m, 1] + high * images[2, m, 1],
        low * images[0, m, 2] + middle * images[1, m, 2] + high * images[2, m, 2],
        low * images[0, m, 3] + middle * images[1, m, 3] + high * images[2, m, 3],
        low * images[0, m, 4] + middle * images[1, m, 4] + high * images[2, m, 4],
        low * images[0, m, 5] + middle * images[1, m, 5] + high * images[2, m, 5],
    )


@njit(**INLINED)
def _form(cell, axes, one, other):
    """Return the second moment of a cell along two axes across the ray, m²."""
    value = 0.0
    for p in range(3):
        value += axes[one, p] * _axis(axes, other, cell, 7 + 3 * p)
    return value


@njit(**INNER)
def _gate(aperture, row, ray, axes, gate):
    """Prepare an aperture as seen from a mirror.

    ``gate`` gets the aperture's normal (3), its distance along the normal, and for its right and
    its up the position of the central ray, the change of the position with that across the ray (2),
    and half the size.
    """
    for k in range(3):
        m, n = (k + 1) % 3, (k + 2) % 3
        gate[k] = aperture[3 + m] * aperture[6 + n] - aperture[3 + n] * aperture[6 + m]
    gate[3] = 0.0
    for k in range(3):
        gate[3] += gate[k] * (aperture[k] - row[k])
    along = _of(ray, gate, 0)
    for e in range(2):
        lean = _of(ray, aperture, 3 + 3 * e) / along if along != 0.0 else 0.0
        at = 4 + 4 * e
        gate[at] = gate[at + 1] = gate[at + 2] = 0.0
        for k in range(3):
            side = aperture[3 + 3 * e + k] - lean * gate[k]
            gate[at] += side * (row[k] - aperture[k])
            gate[at + 1] += side * axes[0, k]
            gate[at + 2] += side * axes[1, k]
        gate[at + 3] = aperture[9 + e]


@njit(**INLINED)
def _before(gate, x, y, z):
    """Return where the line from a mirror to a point meets the aperture, as a fraction of it."""
    along = x * gate[0] + y * gate[1] + z * gate[2]
    return gate[3] / along if along != 0.0 else 0.0


@njit(**INLINED)
def _passes(images, m, gate, t, depths, place, f, own, blur):
    """Return the fraction of the light of image m on a cell that passes the aperture.

    A ray's positions in the aperture and on the cell are normally distributed, and correlated. The
    covariance of positions at depths a and b is the form of which q, the covariance at one depth,
    is the square: 2 q((a + b) / 2) - (q(a) + q(b)) / 2. ``place`` is the cell relative to the
    middle of the image at its depth, ``f``.
    """
    share, far = depths
    if share <= 0.0 or share >= 1.0:
        return 0.0
    near, (pu, pv) = share * far, place
    h = _at(images, m, 0.5 * (near + far) / t - 1.0)
    n = _at(images, m, near / t - 1.0)
    # The covariance of both positions, and that on the cell, whose own extent counts.
    suu = 2.0 * h[2] - 0.5 * (f[2] + n[2]) + near * far * blur[0]
    suv = 2.0 * h[3] - 0.5 * (f[3] + n[3]) + near * far * blur[1]
    svv = 2.0 * h[4] - 0.5 * (f[4] + n[4]) + near * far * blur[2]
    a = f[2] + own[0] + far * far * blur[0]
    b = f[3] + own[1] + far * far * blur[1]
    c = f[4] + own[2] + far * far * blur[2]
    det = a * c - b * b
    passed = 1.0
    for e in range(2):
        at = 4 + 4 * e
        wu, wv = gate[at + 1], gate[at + 2]
        ju, jv = wu * suu + wv * suv, wu * suv + wv * svv
        ku, kv = (ju * c - jv * b) / det, (jv * a - ju * b) / det
        middle = gate[at] + wu * n[0] + wv * n[1] + ku * pu + kv * pv
        var = wu * wu * n[2] + 2.0 * wu * wv * n[3] + wv * wv * n[4] - ku * ju - kv * jv
        var += near * near * (wu * wu * blur[0] + 2.0 * wu * wv * blur[1] + wv * wv * blur[2])
        # An edge further away than 5 standard deviations cuts nothing or everything.
        least, half = gate[at + 3] - abs(middle), gate[at + 3]
        if least * least > 25.0 * var:
            passed *= 1.0 if least > 0.0 else 0.0
            continue
        root = math.sqrt(2.0 * max(var, 1e-12))
        passed *= 0.5 * (math.erf((half - middle) / root) + math.erf((half + middle) / root))
    return passed


@njit(**OPTIONS)
def hide(first, last, directions, cells, corners, hidden):
    """Mark the cells that other triangles (C, 3, 3) hide from light along some directions."""
    for d in range(first, last):
        direction = directions[d]
        for k in range(len(cells)):
            hidden[d, k] = False
            if _of(direction, cells[k], 3) >= 0.0:
                hidden[d, k] = True
                continue
            for j in range(len(corners)):
                if j != k and _meets(cells[k], direction, corners[j]):
                    hidden[d, k] = True
                    break


@njit(**INNER)
def _meets(cell, direction, triangle):
    """Whether the ray from a cell, against the light, meets a triangle (Möller and Trumbore)."""
    a, b = triangle[1] - triangle[0], triangle[2] - triangle[0]
    x, y, z = -direction[0], -direction[1], -direction[2]
    px, py, pz = y * b[2] - z * b[1], z * b[0] - x * b[2], x * b[1] - y * b[0]
    det = a[0] * px + a[1] * py + a[2] * pz
    if abs(det) < 1e-14:
        return False
    tx, ty, tz = cell[0] - triangle[0, 0], cell[1] - triangle[0, 1], cell[2] - triangle[0, 2]
    u = (tx * px + ty * py + tz * pz) / det
    if u < 0.0 or u > 1.0:
        return False
    qx, qy, qz = ty * a[2] - tz * a[1], tz * a[0] - tx * a[2], tx * a[1] - ty * a[0]
    v = (x * qx + y * qy + z * qz) / det
    if v < 0.0 or u + v > 1.0:
        return False
    return (b[0] * qx + b[1] * qy + b[2] * qz) / det > 1e-9
