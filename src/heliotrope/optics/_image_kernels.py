# mypy: disable-error-code="no-untyped-call, untyped-decorator"
# mypy: allow-untyped-defs
"""Compiled: the images of mirrors on surfaces, as sums of elliptic Gaussians.

The parts of a mirror (facets, or equal divisions) each have a lit area, a centroid and a
covariance. At distance t along the mirror's central ray, the image of a part has its mean where the
ray from the centroid arrives, and the covariance A C Aᵀ, where A is the derivative of the ray's
position with respect to the position on the part. Parts whose images are close together are merged
by their moments. Each image is convolved with the Gaussians of the slope errors and of the
calibration uncertainty, and with a sum of Gaussians for the sun.

The power of a part is its lit area in the mirror's plane times the cosine of the mirror. The lit
edge of a curved mirror leans to the sun or from it, but its sagitta, and that of the neighbour
whose shadow ends there, offset this.

Surfaces are columns of cells of equal height. Along a column the exponent is a quadratic form of
the height, so each cell value costs two multiplications. The cell size counts as an additional
variance.
"""

import math

import numpy as np
from numba import njit

from heliotrope.jit import INLINED, INNER, OPTIONS, plain
from heliotrope.optics._clip_kernels import part_of

#: Numbers of an image: power, mean (2) and covariance (uu, uv, vv).
IMAGE = 6
#: Exponent beyond which a Gaussian is left out: 1e-7 of its peak.
DEEP = 16.0
#: Parts whose image positions differ by less than this fraction of the blur are merged.
CLOSE = 0.7
#: Exponent beyond which the sum of a Gaussian's values at cells is taken to be exact; the error is
#: 1e-4.
WIDE = 10.0
FLAT, ROUND = 0, 1
_FAST = {**OPTIONS, "fastmath": {"contract", "nsz", "arcp", "nnan"}}


@njit(**INLINED)
def _exp(x):
    """e^x for |x| ≤ 40 to 1e-7, without branches, so that loops can be vectorised."""
    y = x * (1.0 / 256.0)
    p = 1.0 + y * (1.0 + y * (1 / 2 + y * (1 / 6 + y * (1 / 24 + y * (1 / 120 + y * (1 / 720))))))
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    return p * p


@njit(**INNER)
def _ray(row, sun, ray, axes):
    """Compute the central ray, and the axes right and up across it, as seen from the mirror."""
    nx, ny, nz = row[9], row[10], row[11]
    c = 2.0 * (nx * sun[0] + ny * sun[1] + nz * sun[2])
    ray[0], ray[1], ray[2] = c * nx - sun[0], c * ny - sun[1], c * nz - sun[2]
    flat = math.sqrt(ray[0] ** 2 + ray[1] ** 2)
    if flat > 1e-9:
        axes[0, 0], axes[0, 1], axes[0, 2] = ray[1] / flat, -ray[0] / flat, 0.0
    else:
        axes[0, 0], axes[0, 1], axes[0, 2] = 1.0, 0.0, 0.0
    for k in range(3):
        m, n = (k + 1) % 3, (k + 2) % 3
        axes[1, k] = axes[0, m] * ray[n] - axes[0, n] * ray[m]
    return 0.5 * c


@njit(**INLINED)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(**INLINED)
def _row(a, table, k):
    """Return the scalar product with a row of a table.

    No view is created, because that would be slower.
    """
    return a[0] * table[k, 0] + a[1] * table[k, 1] + a[2] * table[k, 2]


@njit(**INLINED)
def _of(a, row, k):
    """Return the scalar product of a vector (or a row of two axes) with three numbers of a row."""
    return a[0] * row[k] + a[1] * row[k + 1] + a[2] * row[k + 2]


@njit(**INLINED)
def _axis(axes, e, row, k):
    """Return the scalar product of an axis with three numbers of a row."""
    return axes[e, 0] * row[k] + axes[e, 1] * row[k + 1] + axes[e, 2] * row[k + 2]


@njit(**INNER)
def _turn(row, sun, cosine, axes, into):
    """Compute how a tilt of the normal (2) displaces the ray (2), at distance 1."""
    for j in range(2):
        k = 3 + 3 * j
        along = _of(sun, row, k)
        for e in range(2):
            into[e, j] = 2.0 * (along * _axis(axes, e, row, 9) + cosine * _axis(axes, e, row, k))


@njit(**INNER)
def _blur(row, sun, cosine, axes, slope, pointing, turn):
    """Covariance (uu, uv, vv) of the beam direction due to slope and calibration errors, rad²."""
    _turn(row, sun, cosine, axes, turn)
    s = slope * slope
    uu = s * (turn[0, 0] ** 2 + turn[0, 1] ** 2) + pointing[0, 0]
    uv = s * (turn[0, 0] * turn[1, 0] + turn[0, 1] * turn[1, 1]) + pointing[0, 1]
    vv = s * (turn[1, 0] ** 2 + turn[1, 1] ** 2) + pointing[1, 1]
    return uu, uv, vv


@njit(**INNER)
def _spread(turn, axes, row, t, curve, into):
    """Compute A, the derivative of the ray's position with respect to that on the part, (2, 2).

    The ray's position is taken at distance t.
    """
    for j in range(2):
        for e in range(2):
            into[e, j] = _axis(axes, e, row, 3 + 3 * j) - t * curve * turn[e, j]


@njit(**INNER)
def _place(row, sun, ray, axes, t, x, y, tilt_x, tilt_y, into):
    """Compute where the ray from (x, y) with a tilted normal meets the plane at t."""
    nx = row[9] + tilt_x * row[3] + tilt_y * row[6]
    ny = row[10] + tilt_x * row[4] + tilt_y * row[7]
    nz = row[11] + tilt_x * row[5] + tilt_y * row[8]
    length = nx * nx + ny * ny + nz * nz
    c = 2.0 * (nx * sun[0] + ny * sun[1] + nz * sun[2]) / length
    rx, ry, rz = c * nx - sun[0], c * ny - sun[1], c * nz - sun[2]
    px, py, pz = x * row[3] + y * row[6], x * row[4] + y * row[7], x * row[5] + y * row[8]
    along = rx * ray[0] + ry * ray[1] + rz * ray[2]
    way = (t - (px * ray[0] + py * ray[1] + pz * ray[2])) / along
    qx, qy, qz = px + way * rx, py + way * ry, pz + way * rz
    for e in range(2):
        into[e] = qx * axes[e, 0] + qy * axes[e, 1] + qz * axes[e, 2]


@njit(**INNER)
def _images(
    i, row, sun, ray, axes, cosine, t, depth, sigma, parts, surfaces, moments, images, work
):  # fmt: skip
    """Compute the merged images of mirror i's parts; return their number and the light's area.

    The images are those at distance ``depth``; parts are merged if they are close at distance t.
    """
    table, kind, split, begin = parts
    turn, spread, place = work
    _turn(row, sun, cosine, axes, turn)
    curve = row[14]
    _spread(turn, axes, row, depth, curve, spread)
    count, total = 0, 0.0
    close = 1.0 / (CLOSE * sigma)
    for f in range(begin[i + 1] - begin[i]):
        lit = moments[begin[i] + f]
        if lit[0] <= 0.0:
            continue
        x, y, _, _ = part_of(i, f, table, kind, split, row)
        tilt_x, tilt_y, rough = 0.0, 0.0, 0.0
        if len(table):
            surface = surfaces[kind[i], f]
            tilt_x, tilt_y, curve = surface[0], surface[1], surface[2]
            rough = surface[3] * depth * depth
            _spread(turn, axes, row, depth, curve, spread)
        else:
            x, y = 0.0, 0.0
        tilt_x -= curve * (lit[1] - x)
        tilt_y -= curve * (lit[2] - y)
        _place(row, sun, ray, axes, t, lit[1], lit[2], tilt_x, tilt_y, place)
        power = lit[0] * cosine
        a, b, p, q = spread[0, 0], spread[0, 1], spread[1, 0], spread[1, 1]
        uu = a * a * lit[3] + 2.0 * a * b * lit[4] + b * b * lit[5]
        vv = p * p * lit[3] + 2.0 * p * q * lit[4] + q * q * lit[5]
        uv = a * p * lit[3] + (a * q + b * p) * lit[4] + b * q * lit[5]
        uu += rough * (turn[0, 0] ** 2 + turn[0, 1] ** 2)
        uv += rough * (turn[0, 0] * turn[1, 0] + turn[0, 1] * turn[1, 1])
        vv += rough * (turn[1, 0] ** 2 + turn[1, 1] ** 2)
        key_u, key_v = math.floor(place[0] * close + 0.5), math.floor(place[1] * close + 0.5)
        if depth != t:
            _place(row, sun, ray, axes, depth, lit[1], lit[2], tilt_x, tilt_y, place)
        u, v = place[0], place[1]
        total += power
        k = 0
        while k < count and not (images[k, 6] == key_u and images[k, 7] == key_v):
            k += 1
        if k == count:
            for e in range(IMAGE):
                images[k, e] = 0.0
            images[k, 6], images[k, 7] = key_u, key_v
            count += 1
        # Sums of moments; divided below.
        images[k, 0] += power
        images[k, 1] += power * u
        images[k, 2] += power * v
        images[k, 3] += power * (uu + u * u)
        images[k, 4] += power * (uv + u * v)
        images[k, 5] += power * (vv + v * v)
    for k in range(count):
        power = images[k, 0]
        if power > 0.0:
            u, v = images[k, 1] / power, images[k, 2] / power
            images[k, 1], images[k, 2] = u, v
            images[k, 3] = images[k, 3] / power - u * u
            images[k, 4] = images[k, 4] / power - u * v
            images[k, 5] = images[k, 5] / power - v * v
    return count, total


@njit(**INNER)
def _distance(row, ray, shape):
    """Distance along the ray to the surface, or to the closest approach; 0 if there is neither."""
    kind, middle, axis, normal, radius = shape
    x, y, z = middle[0] - row[0], middle[1] - row[1], middle[2] - row[2]
    if kind == FLAT:
        front = ray[0] * normal[0] + ray[1] * normal[1] + ray[2] * normal[2]
        # Along the plate, or from behind.
        if front > -1e-3:
            return 0.0
        return max(0.0, (x * normal[0] + y * normal[1] + z * normal[2]) / front)
    up = _dot(ray, axis)
    away = x * axis[0] + y * axis[1] + z * axis[2]
    rx, ry, rz = ray[0] - up * axis[0], ray[1] - up * axis[1], ray[2] - up * axis[2]
    x, y, z = x - away * axis[0], y - away * axis[1], z - away * axis[2]
    flat = rx * rx + ry * ry + rz * rz
    if flat < 1e-6:
        return 0.0
    t = (x * rx + y * ry + z * rz) / flat
    beside = x * x + y * y + z * z - t * t * flat
    return max(0.0, t - math.sqrt(max(radius * radius - beside, 0.0) / flat))


@njit(**INLINED)
def _width(axes, e, wides, k):
    return axes[e, 0] * wides[k, 0] + axes[e, 1] * wides[k, 1] + axes[e, 2] * wides[k, 2]


@njit(**INNER)
def _columns(row, ray, axes, t, shape, columns, seen):
    """Find the visible columns: index, position (2), step along each (2), width (2), weight."""
    kind, middle, axis, normal, radius = shape
    bases, wides, means, edges, angles = columns
    ups = (_row(axis, axes, 0), _row(axis, axes, 1))
    count = 0
    level, facing = 0.0, 0.0
    other = -_row(ray, edges, 0)
    for k in range(len(bases)):
        one, other = other, -_row(ray, edges, k + 1)
        if one <= 0.0 and other <= 0.0:
            continue
        weight, narrow = -_row(ray, means, k), 1.0
        x, y, z = bases[k, 0], bases[k, 1], bases[k, 2]
        if kind == ROUND and (one < 0.0 or other < 0.0):
            # Only the part of the column that the light reaches.
            if level == 0.0:
                side = np.cross(normal, axis)
                a, b = -_dot(ray, normal), -_dot(ray, side)
                level, facing = math.sqrt(a * a + b * b), math.atan2(b, a)
            start = angles[k] - facing
            start -= 2.0 * math.pi * math.floor(start / (2.0 * math.pi) + 0.5)
            step = angles[k + 1] - angles[k]
            first = max(start, -0.5 * math.pi)
            last = min(start + step, 0.5 * math.pi)
            if last <= first:
                continue
            weight = level * (math.sin(last) - math.sin(first)) / step
            narrow = (last - first) / step
            at = facing + 0.5 * (first + last)
            c, s = radius * math.cos(at), radius * math.sin(at)
            side = np.cross(normal, axis)
            x = middle[0] + c * normal[0] + s * side[0]
            y = middle[1] + c * normal[1] + s * side[1]
            z = middle[2] + c * normal[2] + s * side[2]
        x, y, z = x - row[0], y - row[1], z - row[2]
        depth = x * ray[0] + y * ray[1] + z * ray[2]
        if depth <= 0.0 or weight <= 0.0:
            continue
        scale = t / depth
        seen[0, count] = k
        for e in range(2):
            seen[1 + e, count] = scale * (x * axes[e, 0] + y * axes[e, 1] + z * axes[e, 2])
            seen[3 + e, count] = scale * ups[e]
            seen[5 + e, count] = narrow * scale * _width(axes, e, wides, k)
        seen[7, count] = weight * scale * scale
        count += 1
    return count


@njit(**_FAST)
def _march(z, step, count, rows, local, room):
    """Add the prepared Gaussians from a height z to both ends of the rows that they reach.

    From row to row, the exponential of a square needs two multiplications: one by the ratio of
    successive values, and one that updates this ratio.
    """
    value, ratio, shrink, up, down, _ = room
    (begin, start, end), most = rows, 0.0
    for k in range(count):
        alpha, beta, gamma = shrink[k], ratio[k], value[k]
        at = -0.5 * (alpha * z * z + 2.0 * beta * z + gamma)
        by = -0.5 * step * (alpha * (2.0 * z + step) + 2.0 * beta)
        far = down[k] >= 2.0 * DEEP
        up[k] = 0.0 if far else up[k]
        value[k] = -1.0 if far else at
        ratio[k] = -1.0 if far else by
        shrink[k] = -1.0 if far else -alpha * step * step
        most = max(most, -value[k], abs(ratio[k]))
    if most < 40.0:
        for k in range(count):
            value[k] = up[k] * _exp(value[k])
            ratio[k] = _exp(ratio[k])
            shrink[k] = _exp(shrink[k])
    else:
        for k in range(count):
            value[k] = up[k] * math.exp(max(value[k], -700.0))
            ratio[k] = math.exp(min(max(ratio[k], -700.0), 700.0))
            shrink[k] = math.exp(max(shrink[k], -700.0))
    for k in range(count):
        # The ratio downwards: the product of both is the ratio of ratios.
        down[k] = shrink[k] / ratio[k]
        up[k] = value[k]
    for i in range(start, end + 1):
        line = local[i]
        for k in range(count):
            line[k] += value[k]
            value[k] *= ratio[k]
            ratio[k] *= shrink[k]
    for i in range(start - 1, begin - 1, -1):
        line = local[i]
        for k in range(count):
            up[k] *= down[k]
            down[k] *= shrink[k]
            line[k] += up[k]


@njit(**INNER)
def _comb(variance, place):
    """Return the sum of a Gaussian's values at integers, by Poisson's formula; 1 if it is wide.

    ``variance`` is the variance of the Gaussian. The position is that of the Gaussian relative to
    an integer, or of the integer relative to the Gaussian.
    """
    depth = 2.0 * math.pi * math.pi * variance
    if depth > WIDE:
        return 1.0
    q, x = math.exp(-depth), 2.0 * math.pi * place
    return 1.0 + 2.0 * q * math.cos(x) + 2.0 * q**4 * math.cos(2.0 * x)


@njit(**_FAST)
def _narrow(uu, uv, vv, visible, count, step):
    """Whether a Gaussian is narrow in comparison with a cell."""
    least = 0.5 * (uu + vv) - math.sqrt(0.25 * (uu - vv) ** 2 + uv * uv)
    most = 0.0
    for k in range(count):
        high = step * step * (visible[3, k] ** 2 + visible[4, k] ** 2)
        most = max(most, high, 12.0 * (visible[5, k] ** 2 + visible[6, k] ** 2))
    return 2.0 * math.pi * math.pi * least < WIDE * most


@njit(**INNER)
def _conserve(uu, uv, vv, u, v, visible, count, low, step, room):
    """Correct the amplitudes for the error of summing at cell centres.

    A Gaussian narrower than the cells, sampled at their centres, would lose or gain power.
    """
    _, _, shrink, up, _, peak = room
    box = step * step / 12.0
    for k in range(count):
        du, dv, wu, wv = visible[3, k], visible[4, k], visible[5, k], visible[6, k]
        a = uu + box * du * du + wu * wu
        b = uv + box * du * dv + wu * wv
        c = vv + box * dv * dv + wv * wv
        across = math.sqrt(12.0) * (wv * du - wu * dv)
        var = du * du * c - 2.0 * du * dv * b + dv * dv * a
        at = (visible[2, k] - v) * du - (visible[1, k] - u) * dv
        up[k] /= _comb(var / (across * across), at / across)
        up[k] /= _comb(1.0 / (shrink[k] * step * step), (peak[k] - low) / step)


@njit(**_FAST)
def _gauss(power, u, v, uu, uv, vv, seen, count, low, step, rows, local, room):
    """Add one Gaussian to the visible cells; return the first and the last row that it reaches."""
    value, ratio, shrink, up, down, peak = room
    box = step * step / 12.0
    power /= 2.0 * math.pi
    for k in range(count):
        du, dv, wu, wv = seen[3, k], seen[4, k], seen[5, k], seen[6, k]
        a = uu + box * du * du + wu * wu
        b = uv + box * du * dv + wu * wv
        c = vv + box * dv * dv + wv * wv
        inverse = 1.0 / (a * c - b * b)
        pu, pv = seen[1, k] - u, seen[2, k] - v
        alpha = (du * du * c - 2.0 * du * dv * b + dv * dv * a) * inverse
        beta = (du * pu * c - (du * pv + dv * pu) * b + dv * pv * a) * inverse
        gamma = (pu * pu * c - 2.0 * pu * pv * b + pv * pv * a) * inverse
        value[k], ratio[k], shrink[k] = gamma, beta, alpha
        up[k] = power * seen[7, k] * math.sqrt(inverse)
        peak[k] = -beta / alpha
        down[k] = gamma + beta * peak[k]
    if _narrow(uu, uv, vv, seen, count, step):
        _conserve(uu, uv, vv, u, v, seen, count, low, step, room)
    flattest, first, last = 1e300, 1e300, -1e300
    middle, nearest = 0.0, 2.0 * DEEP
    for k in range(count):
        if down[k] < 2.0 * DEEP:
            first, last = min(first, peak[k]), max(last, peak[k])
            flattest = min(flattest, shrink[k])
            if down[k] < nearest:
                nearest, middle = down[k], peak[k]
    if last < first:
        return rows, -1
    reach = math.sqrt((2.0 * DEEP - nearest) / flattest)
    begin = max(0, math.ceil((first - reach - low) / step))
    end = min(rows - 1, math.floor((last + reach - low) / step))
    if end < begin:
        return rows, -1
    start = min(end, max(begin, math.floor((middle - low) / step + 0.5)))
    _march(low + start * step, step, count, (begin, start, end), local, room)
    return begin, end


@njit(**_FAST)
def _gather(seen, count, begin, end, local, sign, flux, sums):
    """Add the visible cells to the flux, clear them, and return their sum."""
    for k in range(count):
        sums[k] = 0.0
    start = 0
    while start < count:
        # Columns that lie side by side; those of a cylinder may pass over its end.
        column, stop = int(seen[0, start]), start + 1
        while stop < count and int(seen[0, stop]) == column + stop - start:
            stop += 1
        for r in range(begin, end + 1):
            line, into = local[r, start:stop], flux[r, column : column + stop - start]
            part = sums[start:stop]
            for k in range(stop - start):
                into[k] += sign * line[k]
                part[k] += line[k]
                line[k] = 0.0
        start = stop
    total = 0.0
    for k in range(count):
        total += sums[k]
    return total


@njit(**OPTIONS)
def cast(first, last, rows, mirrors, sun, light, slopes, pointing, sums, parts, surfaces, moments,
         shape, columns, grid, sign, flux, out):  # fmt: skip
    """Add the images of mirrors ``rows[first:last]`` to the flux of a surface in columns.

    ``light`` (H,): power per area across the light, W/m². ``sums``: weights and variances of the
    sun's Gaussians, rad². ``grid``: lowest row, row step, number of rows, and cell area. ``flux``
    (rows, columns) in W/m²; ``out`` (H, 2) gets the power that leaves each mirror and the power on
    the surface.
    """
    weights, variances = sums
    low, step, number, area = grid
    wide = len(columns[0])
    seen, local = np.empty((8, wide)), np.zeros((number, wide))
    room = (
        np.empty(wide), np.empty(wide), np.empty(wide), np.empty(wide), np.empty(wide),
        np.empty(wide),
    )  # fmt: skip
    ray, axes = np.empty(3), np.empty((2, 3))
    turn, work = np.empty((2, 2)), (np.empty((2, 2)), np.empty((2, 2)), np.empty(2))
    most = 1
    for i in rows[first:last]:
        most = max(most, parts[3][i + 1] - parts[3][i])
    images = np.empty((most, IMAGE + 2))
    total = 0.0
    for k in range(len(weights)):
        total += weights[k] * variances[k]
    for i in rows[first:last]:
        out[i, 0] = out[i, 1] = 0.0
        if light[i] <= 0.0:
            continue
        row = mirrors[i]
        cosine = _ray(row, sun, ray, axes)
        if cosine <= 0.0:
            continue
        t = _distance(row, ray, shape)
        reach = t if t > 0.0 else 1.0
        uu, uv, vv = _blur(row, sun, cosine, axes, slopes[i], pointing[i], turn)
        sigma = reach * math.sqrt(0.5 * (uu + vv) + total)
        count, leaving = _images(
            i, row, sun, ray, axes, cosine, reach, reach, sigma, parts, surfaces, moments, images,
            work,
        )  # fmt: skip
        out[i, 0] = light[i] * leaving
        if t <= 0.0:
            continue
        visible = _columns(row, ray, axes, t, shape, columns, seen)
        if not visible:
            continue
        begin, end = number, plain(-1)
        for m in range(count):
            image = images[m]
            for g in range(len(weights)):
                more = variances[g]
                a, b = _gauss(
                    weights[g] * image[0] * light[i], image[1], image[2],
                    image[3] + t * t * (uu + more), image[4] + t * t * uv,
                    image[5] + t * t * (vv + more),
                    seen, visible, low, step, number, local, room,
                )  # fmt: skip
                begin, end = min(begin, a), max(end, b)
        out[i, 1] = area * _gather(seen, visible, begin, end, local, sign, flux, room[0])
