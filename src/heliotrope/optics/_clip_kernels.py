# mypy: disable-error-code="no-untyped-call, untyped-decorator"
# mypy: allow-untyped-defs
"""Compiled: computes which part of each mirror sees the sun and the aim past other objects.

The objects are other mirrors and towers. A mirror is stored as SIZE numbers: its centre, its axes x
and y and its normal (3 each), half its width and height, its curvature 1 / 2f, and the radius of an
enclosing sphere. An occluder is a convex polygon. A ray that leaves the mirror at (x, y) has the
direction d + D (x, y), where D is the derivative of the reflected direction with respect to the
position on the curved mirror; D is 0 for shading. The corners of the occluder are projected along
these rays into the mirror plane, and the polygons are subtracted from the mirror's rectangle one by
one. The remainder is a list of convex pieces of any length.
"""

import math

import numpy as np
from numba import njit

from heliotrope.jit import INLINED, INNER, OPTIONS, plain

#: Numbers of a mirror's row; of a tower's (east, north, radius, bottom, top).
SIZE, TOWER = 16, 5
#: Maximum number of corners of a polygon: a tower's top, cut twice.
CORNERS = 32
#: Corners of a tower's top.
ROUND = 24
#: Pieces below this fraction of the mirror's area are dropped.
SPECK = 1e-13


@njit(**INNER)
def cells_of(mirrors, low, step, shape, heads, links, tops):
    """Sort mirrors into a ground grid; return linked lists per cell: heads, links, highest tops."""
    for k in range(len(heads)):
        heads[k] = -1
        tops[k] = -math.inf
    for j in range(len(mirrors)):
        k = int((mirrors[j, 1] - low[1]) / step) * shape[1] + int((mirrors[j, 0] - low[0]) / step)
        links[j], heads[k] = heads[k], j
        tops[k] = max(tops[k], mirrors[j, 2] + mirrors[j, 15])


@njit(**OPTIONS)
def gridded(mirrors, low, step, shape, heads, links, tops):
    """Wrapper of `cells_of` for Python callers."""
    cells_of(mirrors, low, step, shape, heads, links, tops)


@njit(**INNER)
def _near(i, j, mirrors, ray, reach, slack):
    """Whether mirror j may touch the rays from mirror i in a direction, up to a distance."""
    x, y = mirrors[j, 0] - mirrors[i, 0], mirrors[j, 1] - mirrors[i, 1]
    z = mirrors[j, 2] - mirrors[i, 2]
    along = x * ray[0] + y * ray[1] + z * ray[2]
    room = mirrors[i, 15] + mirrors[j, 15] + slack
    if along < -room or along > reach + room:
        return False
    return x * x + y * y + z * z - along * along <= room * room


@njit(**INNER)
def _along(i, mirrors, ray, reach, slack, grid, near, count):
    """Append the mirrors near the rays from mirror i in a direction; return list and length."""
    low, step, shape, heads, links, tops, top = grid
    x0, y0, z0 = mirrors[i, 0] - low[0], mirrors[i, 1] - low[1], mirrors[i, 2] - mirrors[i, 15]
    wide = mirrors[i, 15] + 0.5 * step + slack
    length = reach
    if ray[2] > 0.0:
        length = min(reach, max(0.0, (top - z0) / ray[2]))
    # Columns are taken along the axis in which the ray goes faster.
    major = 0 if abs(ray[0]) >= abs(ray[1]) else 1
    a0, b0 = (x0, y0) if major == 0 else (y0, x0)
    da, db = ray[major], ray[1 - major]
    na, nb = shape[1 - major], shape[major]
    ends = (a0, a0 + length * da)
    first = max(0, math.floor((min(ends) - wide) / step))
    last = min(na - 1, math.floor((max(ends) + wide) / step))
    slope = db / da if abs(da) > 1e-12 else 0.0
    thick = wide * math.sqrt(1.0 + slope * slope) * 1.0001
    for a in range(first, last + 1):
        left = min(max(a * step - a0, min(0.0, length * da)), max(0.0, length * da))
        right = min(max((a + 1) * step - a0, min(0.0, length * da)), max(0.0, length * da))
        enter, leave = b0 + slope * left, b0 + slope * right
        start = max(0, math.floor((min(enter, leave) - thick) / step))
        stop = min(nb - 1, math.floor((max(enter, leave) + thick) / step))
        lowest = z0
        if abs(da) > 1e-12:
            lowest = min(z0 + ray[2] * (left - wide) / da, z0 + ray[2] * (right + wide) / da)
            lowest = min(lowest, z0 + ray[2] * (left + wide) / da)
            lowest = min(lowest, z0 + ray[2] * (right - wide) / da)
        for b in range(start, stop + 1):
            k = b * shape[1] + a if major == 0 else a * shape[1] + b
            if tops[k] < lowest:
                continue
            j = heads[k]
            while j >= 0:
                if j != i and _near(i, j, mirrors, ray, reach, slack):
                    if count == len(near):
                        grown = np.empty(2 * count, dtype=np.int64)
                        for m in range(count):
                            grown[m] = near[m]
                        near = grown
                    near[count] = j
                    count += 1
                j = links[j]
    return near, count


@njit(**OPTIONS)
def candidates(rows, mirrors, sun, rays, reaches, slack, grid, spans):
    """List the mirrors that may shade or block each of ``rows``, and where each part begins.

    ``spans`` (R + 1, 2) receives the start indices of the shading mirrors and of the blocking
    mirrors; its last row receives the end of the list.
    """
    near, count = np.empty(8 * len(rows) + 64, dtype=np.int64), plain(0)
    # Shadows are no longer than the field.
    far = 1.5 * grid[1] * (grid[2][0] + grid[2][1])
    for r in range(len(rows)):
        i = rows[r]
        spans[r, 0] = count
        near, count = _along(i, mirrors, sun, far, slack, grid, near, count)
        spans[r, 1] = count
        near, count = _along(i, mirrors, rays[i], reaches[i], slack, grid, near, count)
    spans[len(rows), 0] = count
    spans[len(rows), 1] = count
    return near[:count]


@njit(**INLINED)
def _cut(corners, m, into, axis_x, axis_y, axis_z, offset):
    """Clip a polygon in space to axis · p ≤ offset; return the new number of corners."""
    count = 0
    for k in range(m):
        k2 = k + 1 if k + 1 < m else 0
        before = (corners[k, 0] * axis_x + corners[k, 1] * axis_y + corners[k, 2] * axis_z) - offset
        after = (
            corners[k2, 0] * axis_x + corners[k2, 1] * axis_y + corners[k2, 2] * axis_z
        ) - offset
        if before <= 0.0:
            for c in range(3):
                into[count, c] = corners[k, c]
            count += 1
        if (before < 0.0 < after) or (after < 0.0 < before):
            t = before / (before - after)
            for c in range(3):
                into[count, c] = corners[k, c] + t * (corners[k2, c] - corners[k, c])
            count += 1
    return count


@njit(**INNER)
def _carry(i, mirrors, ray, bend, reach, corners, m, spare, polygon):
    """Project a polygon, ENU relative to mirror i, into the plane of this mirror.

    A polygon that hides nothing gets 0 corners.

    ``bend`` is D in the mirror's axes, (3, 2).
    """
    row = mirrors[i]
    for k in range(m):
        x, y, z = corners[k, 0], corners[k, 1], corners[k, 2]
        corners[k, 0] = x * row[3] + y * row[4] + z * row[5]
        corners[k, 1] = x * row[6] + y * row[7] + z * row[8]
        corners[k, 2] = x * row[9] + y * row[10] + z * row[11]
    dx = ray[0] * row[3] + ray[1] * row[4] + ray[2] * row[5]
    dy = ray[0] * row[6] + ray[1] * row[7] + ray[2] * row[8]
    dz = ray[0] * row[9] + ray[1] * row[10] + ray[2] * row[11]
    if dz <= 1e-9:
        return 0
    # Only what is in front of the mirror and before the aim hides anything.
    m = _cut(corners, m, spare, 0.0, 0.0, -1.0, 0.0)
    if m < 3:
        return 0
    if reach < np.inf:
        m = _cut(spare, m, corners, dx, dy, dz, reach)
    else:
        for k in range(m):
            for c in range(3):
                corners[k, c] = spare[k, c]
    if bend[0, 0] < 0.0 and m >= 3:
        # Nothing is projected through the point where the rays meet.
        m = _cut(corners, m, spare, 0.0, 0.0, 1.0, -0.999 * dz / bend[0, 0])
        for k in range(m):
            for c in range(3):
                corners[k, c] = spare[k, c]
    if m < 3:
        return 0
    x0, x1, y0, y1, area = math.inf, -math.inf, math.inf, -math.inf, 0.0
    for k in range(m):
        px, py, pz = corners[k, 0], corners[k, 1], corners[k, 2]
        t = pz / dz
        x, y = px - t * dx, py - t * dy
        if bend[0, 0] != 0.0 or bend[1, 1] != 0.0:
            for _ in range(3):
                a, b = 1.0 + t * bend[0, 0], t * bend[0, 1]
                c, d = t * bend[1, 0], 1.0 + t * bend[1, 1]
                u, v, det = px - t * dx, py - t * dy, a * d - b * c
                x, y = (d * u - b * v) / det, (a * v - c * u) / det
                t = pz / (dz + bend[2, 0] * x + bend[2, 1] * y)
        polygon[k, 0], polygon[k, 1] = x, y
        x0, x1, y0, y1 = min(x0, x), max(x1, x), min(y0, y), max(y1, y)
    if x1 <= -row[12] or x0 >= row[12] or y1 <= -row[13] or y0 >= row[13]:
        return 0
    for k in range(m):
        k2 = k + 1 if k + 1 < m else 0
        area += polygon[k, 0] * polygon[k2, 1] - polygon[k2, 0] * polygon[k, 1]
    if abs(area) < SPECK * row[12] * row[13]:
        return 0
    if area < 0.0:
        for k in range(m // 2):
            for c in range(2):
                kept = polygon[k, c]
                polygon[k, c], polygon[m - 1 - k, c] = polygon[m - 1 - k, c], kept
    return m


@njit(**INLINED)
def _mirror_corners(i, j, mirrors, corners):
    a, b = mirrors[j, 12], mirrors[j, 13]
    for k in range(4):
        s = a if k in (1, 2) else -a
        t = b if k in (2, 3) else -b
        for c in range(3):
            corners[k, c] = (
                mirrors[j, c] - mirrors[i, c] + s * mirrors[j, 3 + c] + t * mirrors[j, 6 + c]
            )
    return plain(4)


@njit(**INNER)
def _tower_corners(i, tower, mirrors, ray, part, corners):
    """Compute the corners of a tower's outline across the ray (part 0) or of its top (part 1)."""
    x, y = tower[0] - mirrors[i, 0], tower[1] - mirrors[i, 1]
    bottom, top = tower[3] - mirrors[i, 2], tower[4] - mirrors[i, 2]
    if part == 1:
        turn = 2.0 * math.pi / ROUND
        # A polygon of the circle's area.
        radius = tower[2] * math.sqrt(turn / math.sin(turn))
        for k in range(ROUND):
            corners[k, 0] = x + radius * math.cos(k * turn)
            corners[k, 1] = y + radius * math.sin(k * turn)
            corners[k, 2] = top
        return ROUND
    flat = math.sqrt(ray[0] ** 2 + ray[1] ** 2)
    if flat < 1e-9:
        return 0
    ax, ay = -ray[1] / flat * tower[2], ray[0] / flat * tower[2]
    for k in range(4):
        s = 1.0 if k in (1, 2) else -1.0
        corners[k, 0], corners[k, 1] = x + s * ax, y + s * ay
        corners[k, 2] = top if k >= 2 else bottom
    return 4


@njit(**INLINED)
def _beside_tower(i, tower, mirrors, ray, reach):
    """Whether a tower lies entirely beside the rays of mirror i."""
    x, y = tower[0] - mirrors[i, 0], tower[1] - mirrors[i, 1]
    flat = math.sqrt(ray[0] ** 2 + ray[1] ** 2)
    room = mirrors[i, 15] + tower[2]
    if flat < 1e-9:
        return x * x + y * y > room * room
    along = (x * ray[0] + y * ray[1]) / flat
    return (
        along < -room
        or abs(x * ray[1] - y * ray[0]) / flat > room
        or mirrors[i, 2] + (along - room) / flat * ray[2] - mirrors[i, 15] > tower[4]
        or along - room > reach * flat
    )


@njit(**INNER)
def bend_of(row, sun, bend):
    """Compute D of a curved mirror, in its axes: r = 2 (n·s) n − s, dn = −(x, y) / 2f."""
    sx = sun[0] * row[3] + sun[1] * row[4] + sun[2] * row[5]
    sy = sun[0] * row[6] + sun[1] * row[7] + sun[2] * row[8]
    sz = sun[0] * row[9] + sun[1] * row[10] + sun[2] * row[11]
    curve = row[14]
    bend[0, 0] = bend[1, 1] = -2.0 * sz * curve
    bend[0, 1] = bend[1, 0] = 0.0
    bend[2, 0], bend[2, 1] = -2.0 * sx * curve, -2.0 * sy * curve


@njit(**INNER)
def outlines(i, near, mirrors, towers, ray, bend, reach, work):
    """Collect the polygons that hide a part of mirror i; return them, their corners, their number.

    ``near`` lists the mirrors. ``work`` holds two lists of corners.
    """
    corners, spare = work
    room = len(near) + 2 * len(towers)
    polygons, sizes = np.empty((room, CORNERS, 2)), np.empty(room, dtype=np.int64)
    count = 0
    for j in near:
        m = _mirror_corners(i, j, mirrors, corners)
        m = _carry(i, mirrors, ray, bend, reach, corners, m, spare, polygons[count])
        if m:
            sizes[count] = m
            count += 1
    # A tower may be close to the aim, beyond one of the two foci of an oblique mirror; its rays are
    # then assumed to meet in one point.
    pencil = np.zeros((3, 2))
    if bend[0, 0] != 0.0:
        pencil[0, 0] = pencil[1, 1] = -2.0 * mirrors[i, 14]
    for k in range(len(towers)):
        if _beside_tower(i, towers[k], mirrors, ray, reach):
            continue
        for part in range(2):
            m = _tower_corners(i, towers[k], mirrors, ray, part, corners)
            m = _carry(i, mirrors, ray, pencil, reach, corners, m, spare, polygons[count])
            if m:
                sizes[count] = m
                count += 1
    return polygons, sizes, count


@njit(**INNER)
def _split(points, m, ax, ay, bx, by, inside, outside):
    """Clip a convex polygon along the line from a to b; the left side is inside."""
    nx, ny = ay - by, bx - ax
    p = q = 0
    before = (points[0, 0] - ax) * nx + (points[0, 1] - ay) * ny
    for k in range(m):
        k2 = k + 1 if k + 1 < m else 0
        after = (points[k2, 0] - ax) * nx + (points[k2, 1] - ay) * ny
        x, y = points[k, 0], points[k, 1]
        if before >= 0.0:
            inside[p, 0], inside[p, 1] = x, y
            p += 1
        if before <= 0.0:
            outside[q, 0], outside[q, 1] = x, y
            q += 1
        if before * after < 0.0:
            t = before / (before - after)
            x, y = x + t * (points[k2, 0] - x), y + t * (points[k2, 1] - y)
            inside[p, 0], inside[p, 1] = x, y
            outside[q, 0], outside[q, 1] = x, y
            p += 1
            q += 1
        before = after
    return p, q


@njit(**INLINED)
def _area(points, m):
    total = 0.0
    for k in range(m):
        k2 = k + 1 if k + 1 < m else 0
        total += points[k, 0] * points[k2, 1] - points[k2, 0] * points[k, 1]
    return 0.5 * total


@njit(**INLINED)
def _apart(points, m, polygon, n):
    """Whether the bounding boxes of two polygons do not overlap."""
    for c in range(2):
        low, high = points[0, c], points[0, c]
        for k in range(1, m):
            low, high = min(low, points[k, c]), max(high, points[k, c])
        under, over = True, True
        for k in range(n):
            under = under and polygon[k, c] <= low
            over = over and polygon[k, c] >= high
        if under or over:
            return True
    return False


@njit(**INNER)
def _subtract(points, begins, pieces, polygon, n, speck, into, starts, one, two):
    """Subtract a convex polygon from convex pieces; return the number of pieces that remain."""
    total = 0
    for k in range(pieces):
        m = begins[k + 1] - begins[k]
        piece = points[begins[k] : begins[k + 1]]
        first, before = starts[total], total
        rest, other = one, two
        for c in range(m):
            rest[c, 0], rest[c, 1] = piece[c, 0], piece[c, 1]
        left = m
        if _apart(piece, m, polygon, n):
            left = 0
        else:
            for e in range(n):
                f = e + 1 if e + 1 < n else 0
                at = starts[total]
                left, cut = _split(
                    rest, left, polygon[e, 0], polygon[e, 1], polygon[f, 0], polygon[f, 1],
                    other, into[at:],
                )  # fmt: skip
                if cut >= 3 and _area(into[at:], cut) > speck:
                    starts[total + 1] = at + cut
                    total += 1
                rest, other = other, rest
                if left < 3 or _area(rest, left) <= speck:
                    left = 0
                    break
        if left == 0:
            # Nothing in common: the piece stays as it was.
            for c in range(m):
                into[first + c, 0], into[first + c, 1] = piece[c, 0], piece[c, 1]
            starts[before + 1] = first + m
            total = before + 1
    return total


@njit(**INNER)
def left_of(x0, x1, y0, y1, polygons, sizes, count, state):
    """Subtract polygons from a rectangle; return the state.

    The first two arrays of the state list the pieces.

    ``state`` contains the corners and start indices of the pieces, their number, and output buffers
    of the same form.
    """
    points, begins, pieces, into, starts, one, two = state
    points[0, 0], points[0, 1], points[1, 0], points[1, 1] = x0, y0, x1, y0
    points[2, 0], points[2, 1], points[3, 0], points[3, 1] = x1, y1, x0, y1
    begins[0], begins[1], pieces = 0, 4, plain(1)
    starts[0] = 0
    speck = SPECK * (x1 - x0) * (y1 - y0)
    for k in range(count):
        n = sizes[k]
        # A cut adds at most four corners, and one piece.
        need = begins[pieces] + pieces * (4 * n + 4) + CORNERS
        if need > len(into):
            into, one, two = (
                np.empty((2 * need, 2)), np.empty((2 * need, 2)), np.empty((2 * need, 2)),
            )  # fmt: skip
        if pieces * (n + 1) + 2 > len(starts):
            starts = np.empty(2 * pieces * (n + 1) + 2, dtype=np.int64)
        starts[0] = 0
        pieces = _subtract(points, begins, pieces, polygons[k], n, speck, into, starts, one, two)
        points, into = into, points
        begins, starts = starts, begins
        if pieces == 0:
            break
    return points, begins, pieces, into, starts, one, two


@njit(**INNER)
def new_state():
    """Create the buffers for `left_of`, which grow as needed."""
    return (
        np.empty((256, 2)), np.empty(64, dtype=np.int64), plain(0),
        np.empty((256, 2)), np.empty(64, dtype=np.int64), np.empty((256, 2)), np.empty((256, 2)),
    )  # fmt: skip


@njit(**INNER)
def moments_of(points, begins, pieces, into):
    """Compute area, centroid (2) and covariance (xx, xy, yy) of the union of the pieces."""
    area = mx = my = xx = xy = yy = 0.0
    for k in range(pieces):
        first, last = begins[k], begins[k + 1]
        for c in range(first, last):
            d = c + 1 if c + 1 < last else first
            x, y, u, v = points[c, 0], points[c, 1], points[d, 0], points[d, 1]
            cross = x * v - u * y
            area += cross
            mx += (x + u) * cross
            my += (y + v) * cross
            xx += (x * x + x * u + u * u) * cross
            yy += (y * y + y * v + v * v) * cross
            xy += (x * (2.0 * y + v) + u * (y + 2.0 * v)) * cross
    if area <= 0.0:
        for c in range(6):
            into[c] = 0.0
        return
    cx, cy = mx / (3.0 * area), my / (3.0 * area)
    into[0], into[1], into[2] = 0.5 * area, cx, cy
    into[3] = xx / (6.0 * area) - cx * cx
    into[4] = xy / (12.0 * area) - cx * cy
    into[5] = yy / (6.0 * area) - cy * cy


@njit(**INLINED)
def whole(x, y, a, b, into):
    """Compute the moments of a rectangle with half sides a and b."""
    into[0], into[1], into[2] = 4.0 * a * b, x, y
    into[3], into[4], into[5] = a * a / 3.0, 0.0, b * b / 3.0


@njit(**INNER)
def part_of(i, f, table, kind, split, row):
    """Return the middle and the half sides of part f of mirror i: a facet or an equal division."""
    if len(table):
        cell = table[kind[i], f]
        return cell[0], cell[1], cell[2], cell[3]
    nx, ny = split[i, 0], split[i, 1]
    a, b = row[12] / nx, row[13] / ny
    return (2 * (f % nx) + 1) * a - row[12], (2 * (f // nx) + 1) * b - row[13], a, b


@njit(**OPTIONS)
def clip(first, last, rows, mirrors, towers, sun, rays, reaches, near, spans, parts, out):
    """Clip mirrors ``rows[first:last]``; see `Lit` for what is written.

    ``spans`` (H, 3): for each mirror, where the shading candidates and the blocking candidates
    begin in the list ``near``, and where they end. ``parts``: facets (K, F, 4), kind (H,),
    divisions (H, 2) and the start index of each mirror's parts (H + 1,). ``out``: shares (H, 3) and
    moments of the parts (P, 6).
    """
    table, kind, split, begin = parts
    shares, moments = out
    state, work = new_state(), (np.empty((CORNERS, 3)), np.empty((CORNERS, 3)))
    straight, bend, whole_one = np.zeros((3, 2)), np.zeros((3, 2)), np.empty(6)
    for r in range(first, last):
        i = rows[r]
        row = mirrors[i]
        a, b = row[12], row[13]
        area = 4.0 * a * b
        bend_of(row, sun, bend)
        dark, sizes, n = outlines(
            i, near[spans[i, 0] : spans[i, 1]], mirrors, towers, sun, straight, np.inf, work
        )
        blocks, lengths, m = outlines(
            i, near[spans[i, 1] : spans[i, 2]], mirrors, towers, rays[i], bend,
            reaches[i], work,
        )  # fmt: skip
        both, corners = np.empty((n + m, CORNERS, 2)), np.empty(n + m, dtype=np.int64)
        for k in range(n + m):
            size = sizes[k] if k < n else lengths[k - n]
            corners[k] = size
            for c in range(size):
                for e in range(2):
                    both[k, c, e] = dark[k, c, e] if k < n else blocks[k - n, c, e]
        shares[i, 0] = shares[i, 1] = shares[i, 2] = 1.0
        whole(0.0, 0.0, a, b, whole_one)
        if n:
            state = left_of(-a, a, -b, b, dark, sizes, n, state)
            moments_of(state[0], state[1], state[2], whole_one)
            shares[i, 0] = whole_one[0] / area
        if m:
            state = left_of(-a, a, -b, b, blocks, lengths, m, state)
            moments_of(state[0], state[1], state[2], whole_one)
            shares[i, 1] = whole_one[0] / area
        if n and m:
            state = left_of(-a, a, -b, b, both, corners, n + m, state)
            moments_of(state[0], state[1], state[2], whole_one)
        shares[i, 2] = whole_one[0] / area
        count = begin[i + 1] - begin[i]
        if count == 1 and not len(table):
            for c in range(6):
                moments[begin[i], c] = whole_one[c]
            continue
        for f in range(count):
            x, y, p, q = part_of(i, f, table, kind, split, row)
            into = moments[begin[i] + f]
            if n + m and p * q > 0.0:
                state = left_of(x - p, x + p, y - q, y + q, both, corners, n + m, state)
                moments_of(state[0], state[1], state[2], into)
            else:
                whole(x, y, p, q, into)


@njit(**OPTIONS)
def pieces_of(i, mirrors, towers, sun, rays, reaches, near, spans):
    """Return the convex pieces of the lit part of one mirror, as corners and start indices."""
    work, straight, bend = (
        (np.empty((CORNERS, 3)), np.empty((CORNERS, 3))), np.zeros((3, 2)), np.zeros((3, 2)),
    )  # fmt: skip
    row = mirrors[i]
    bend_of(row, sun, bend)
    dark, sizes, n = outlines(
        i, near[spans[i, 0] : spans[i, 1]], mirrors, towers, sun, straight, np.inf, work
    )
    blocks, lengths, m = outlines(
        i, near[spans[i, 1] : spans[i, 2]], mirrors, towers, rays[i], bend, reaches[i], work
    )
    both, corners = np.empty((n + m, CORNERS, 2)), np.empty(n + m, dtype=np.int64)
    for k in range(n + m):
        corners[k] = sizes[k] if k < n else lengths[k - n]
        both[k] = dark[k] if k < n else blocks[k - n]
    state = left_of(-row[12], row[12], -row[13], row[13], both, corners, n + m, new_state())
    return state[0][: state[1][state[2]]].copy(), state[1][: state[2] + 1].copy()


@njit(**OPTIONS)
def touched(spans, near, moved, into):
    """Mark the mirrors that moved, or that have a moved mirror among their candidates."""
    for i in range(len(spans)):
        into[i] = moved[i]
        for k in range(spans[i, 0], spans[i, 2]):
            if moved[near[k]]:
                into[i] = True
                break


@njit(**OPTIONS)
def hiding(i, mirrors, sun, rays, reaches, near, spans, into):
    """Mark the mirrors whose outline, along the sunlight or the beam, overlaps mirror i."""
    corners, spare, polygon = np.empty((CORNERS, 3)), np.empty((CORNERS, 3)), np.empty((CORNERS, 2))
    straight, bend = np.zeros((3, 2)), np.zeros((3, 2))
    bend_of(mirrors[i], sun, bend)
    for k in range(spans[i, 0], spans[i, 2]):
        j, shades = near[k], k < spans[i, 1]
        m = _mirror_corners(i, j, mirrors, corners)
        if shades:
            m = _carry(i, mirrors, sun, straight, np.inf, corners, m, spare, polygon)
        else:
            m = _carry(i, mirrors, rays[i], bend, reaches[i], corners, m, spare, polygon)
        if m:
            into[j] = True
