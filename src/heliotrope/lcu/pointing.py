"""Pointing: joint angles at which an armature sends sunlight to an aim point.

The law is the same as in ``heliotrope.mechanism.tracking``, written for a board with 32-bit floats:
R(a, θ₁) R(b, θ₂) n₀ = v is met where z = R(b, θ₂) n₀ has z·a = v·a and z·b = n₀·b (second
Paden-Kahan subproblem; two such z, hence two branches). The vertex moves with the angles, and v
moves with the vertex. This is solved by fixed-point iteration, or by damped Gauss-Newton where that
iteration is slow.

To preserve single precision, all points are taken relative to the primary axis's origin, lengths
across an axis are computed from the perpendicular component and never as 1 − cosine², and angles
are computed with atan2.
"""

import math

from .vectors import about, across, add, cross, dot, finite, minus, norm, times, turn_between, unit

#: How a solution ended, as in ``heliotrope.mechanism.tracking.TrackingStatus``.
OK, UNREACHABLE, STOPPED, NOT_CONVERGED, DEGENERATE = range(5)

#: Largest distance by which the beam misses its aim, m, as far as precision allows.
TOLERANCE = 2e-10
#: Newton replaces the fixed-point iteration if a step reduces the error by less than this factor.
SLOW = 0.3
STEPS, NEWTON_STEPS, TRIALS = 20, 60, 20
#: A pose is degenerate if source and aim are closer to opposite than this (rad), or if the aim is
#: nearer to the vertex than this (m).
DEGENERATE_LIMIT = 1e-6
#: A pose on the branch of the last pose that moves less than this (rad) is accepted at once.
CLOSE = 0.05
#: An angle that is beyond a stop by less than this (rad) counts as within the stops.
STOP_SLACK = 1e-6


def epsilon(number: float) -> float:
    """Return the rounding error of numbers of the same type as ``number`` (1.0)."""
    step = number
    while number + 0.5 * step != number:
        step = 0.5 * step
    return step


def into_stops(theta: float, low: float, high: float, near: float) -> tuple[float, bool]:
    """Return theta + 2πk within the stops and nearest to ``near``, and True.

    If no such angle lies within the stops, the nearer stop and False are returned.
    """
    turn = 2.0 * math.pi
    theta += turn * math.floor((near - theta) / turn + 0.5)
    if theta < low - STOP_SLACK:
        theta += turn * math.ceil((low - STOP_SLACK - theta) / turn)
    elif theta > high + STOP_SLACK:
        theta -= turn * math.ceil((theta - high - STOP_SLACK) / turn)
    if low - STOP_SLACK <= theta <= high + STOP_SLACK:
        return min(max(theta, low), high), True
    above = theta - turn * math.floor((theta - high) / turn)
    if above - high < low - (above - turn):
        return high, False
    return low, False


class Pose:
    """A solution of one branch.

    ``status``; ``angles`` of the joints, rad; ``residual``, angle of the normal from its
    target direction, rad; ``branch`` −1 or 1.
    """

    def __init__(self, branch: int) -> None:
        self.branch = branch
        self.status = DEGENERATE
        self.angles = [0.0, 0.0]
        self.residual = 0.0


class Pointing:
    """Tracking with one armature.

    Parameters
    ----------
    numbers
        18 numbers as in ``heliotrope.mechanism.armature``: primary axis, a point on it, secondary
        axis, a point on it, vertex and normal, at zero joint angles; ENU, m.

    Raises
    ------
    ValueError
        If a number is not finite, a direction is zero, the axes are parallel or the normal
        lies along the secondary axis.
    """

    def __init__(self, numbers: tuple[float, ...]) -> None:
        if len(numbers) != 18 or not finite(numbers):
            raise ValueError("armature: it needs 18 finite numbers")
        vectors = [(numbers[i], numbers[i + 1], numbers[i + 2]) for i in range(0, 18, 3)]
        for i in (0, 2, 5):
            if abs(norm(vectors[i]) - 1.0) > 1e-3:
                raise ValueError("armature: the axes and the normal must be unit vectors")
        self.origin = vectors[1]
        self.one = numbers[0] * 0.0 + 1.0
        self.eps = epsilon(self.one)
        self.axis_1, self.axis_2, self.normal = unit(vectors[0]), unit(vectors[2]), unit(vectors[5])
        self.elbow = minus(vectors[3], vectors[1])
        self.arm = minus(vectors[4], vectors[3])
        self.tolerance = max(TOLERANCE, 8.0 * self.eps * (norm(self.elbow) + norm(self.arm)))
        a, b, u = self.axis_1, self.axis_2, self.normal
        self.c = cross(a, b)
        self.b_flat = across(b, a)
        flat = across(u, b)
        if not (norm(self.c) > 1e-3 and norm(flat) > 1e-6):
            raise ValueError(
                "armature: the axes are parallel, or the normal is parallel to the secondary axis"
            )
        self.ab, self.ub = dot(a, b), dot(u, b)
        self.inverse = 1.0 / dot(self.c, self.c)
        scale = 1.0 / dot(flat, flat)
        e, f = times(scale, cross(b, u)), times(scale, flat)
        self.sines = (dot(e, a), dot(e, self.c))
        self.cosines = (dot(f, a), dot(f, self.c))
        self.found = (Pose(-1), Pose(1))
        self.last = self.found[0]

    def turned(
        self, turn: tuple[float, float, float, float], u: tuple[float, float, float]
    ) -> tuple[float, float, float]:
        """Return the mirror's vector ``u`` after a turn, (sin θ₁, cos θ₁, sin θ₂, cos θ₂)."""
        return about(self.axis_1, turn[0], turn[1], about(self.axis_2, turn[2], turn[3], u))

    def vertex(self, turn: tuple[float, float, float, float]) -> tuple[float, float, float]:
        """Return the vertex at a turn, relative to the primary origin, m."""
        arm = add(self.elbow, about(self.axis_2, turn[2], turn[3], self.arm))
        return about(self.axis_1, turn[0], turn[1], arm)

    def solve(
        self,
        sun: tuple[float, float, float],
        aim: tuple[float, float, float],
        stops: list[list[float]],
        near: list[float],
    ) -> Pose:
        """Return the pose that sends light from the sun to the aim.

        The pose is on the branch within the stops that needs the smaller motion. If neither branch
        reaches the aim, the nearest pose is returned, with status and residual set accordingly. The
        next call overwrites the pose.

        Parameters
        ----------
        sun
            Vector to the sun, ENU, of length near 1.
        aim
            Aim point, ENU, m.
        stops
            Limits [[low, high] of θ₁, [low, high] of θ₂], rad; may be infinite.
        near
            Present joint angles, rad.
        """
        last = self.last
        self.solve_branch(last, sun, aim, stops, near)
        if last.status == OK and _motion(last, near) < CLOSE:
            return last
        first, second = self.found
        other = second if last is first else first
        self.solve_branch(other, sun, aim, stops, near)
        if OK not in (first.status, second.status):
            for pose in self.found:
                if pose.status == STOPPED:
                    self._nearest_at_stops(pose, sun, aim, stops, near)
        self.last = self._better(first, second, near)
        return self.last

    def _better(self, first: Pose, second: Pose, near: list[float]) -> Pose:
        if first.status == OK and second.status == OK:
            return first if _motion(first, near) <= _motion(second, near) else second
        if OK in (first.status, second.status):
            return first if first.status == OK else second
        if first.status == DEGENERATE or second.residual < first.residual:
            return second
        return first

    def solve_branch(
        self,
        pose: Pose,
        sun: tuple[float, float, float],
        aim: tuple[float, float, float],
        stops: list[list[float]],
        near: list[float],
    ) -> None:
        """Solve one branch into ``pose``.

        A pose beyond the stops gets the status STOPPED, and no angles.
        """
        s, p = unit(sun), minus(aim, self.origin)
        turn = self._fixed_point(pose, s, p)
        if pose.status == DEGENERATE:
            pose.residual = math.pi
            return
        at_1, inside_1 = into_stops(math.atan2(turn[0], turn[1]), stops[0][0], stops[0][1], near[0])
        at_2, inside_2 = into_stops(math.atan2(turn[2], turn[3]), stops[1][0], stops[1][1], near[1])
        if inside_1 and inside_2:
            pose.angles[0], pose.angles[1] = at_1, at_2
            pose.residual = self._residual(s, p, turn)
            return
        pose.status, pose.residual = STOPPED, math.pi

    def _nearest_at_stops(
        self,
        pose: Pose,
        sun: tuple[float, float, float],
        aim: tuple[float, float, float],
        stops: list[list[float]],
        near: list[float],
    ) -> None:
        """Find the nearest pose on the border of the range between the stops."""
        s, p = unit(sun), minus(aim, self.origin)
        for axis in (0, 1):
            for held in stops[axis]:
                if math.isfinite(held):
                    self._along_stop(pose, s, p, axis, held, stops, near)

    def _wanted(
        self,
        s: tuple[float, float, float],
        p: tuple[float, float, float],
        m: tuple[float, float, float],
    ) -> tuple[tuple[float, float, float], tuple[float, float, float], float]:
        """Return the wanted normal, the direction from m to p, and the distance.

        The wanted normal is the bisector of s and that direction. The distance is 0 if there is no
        bisector.
        """
        path = minus(p, m)
        distance = norm(path)
        if not distance > DEGENERATE_LIMIT:
            return path, path, 0.0
        path = times(1.0 / distance, path)
        v = add(s, path)
        size = norm(v)
        if not size > DEGENERATE_LIMIT:
            return path, path, 0.0
        return times(1.0 / size, v), path, distance

    def _direction(
        self, v: tuple[float, float, float], sign: float
    ) -> tuple[bool, tuple[float, float, float, float]]:
        """Return whether a turn brings the normal to v, and that turn.

        In the dead cone, it is the turn that comes nearest.
        """
        va = dot(v, self.axis_1)
        v_flat = across(v, self.axis_1)
        height = (self.ub - va * self.ab) * math.sqrt(self.inverse)
        radius = norm(v_flat)
        # γ²|a × b|² = (|v across a| − h)(|v across a| + h): exact near the axis too.
        square = (radius - height) * (radius + height)
        reached = square >= -4.0 * self.eps * (radius + abs(height) + self.eps)
        goal = va
        if not reached:
            # The nearest direction on the edge has the largest |z·a| on the circle z·b = u·b.
            edge = math.sqrt(max(0.0, 1.0 - self.ub * self.ub) / self.inverse)
            goal = self.ab * self.ub
            goal += edge if va >= self.ab * self.ub else -edge
        along_a = (goal - self.ab * self.ub) * self.inverse
        along_b = (self.ub - self.ab * goal) * self.inverse
        away = sign * math.sqrt(max(0.0, square) * self.inverse)
        sine_2 = along_a * self.sines[0] + away * self.sines[1]
        cosine_2 = along_a * self.cosines[0] + away * self.cosines[1]
        z_flat = add(times(along_b, self.b_flat), times(away, self.c))
        sine_1 = dot(self.axis_1, cross(z_flat, v_flat))
        cosine_1 = dot(z_flat, v_flat)
        size_1 = math.sqrt(sine_1 * sine_1 + cosine_1 * cosine_1)
        size_2 = math.sqrt(sine_2 * sine_2 + cosine_2 * cosine_2)
        if not size_1 > self.eps * self.eps:
            return reached, (0.0, self.one, sine_2 / size_2, cosine_2 / size_2)
        return reached, (sine_1 / size_1, cosine_1 / size_1, sine_2 / size_2, cosine_2 / size_2)

    def _fixed_point(
        self, pose: Pose, s: tuple[float, float, float], p: tuple[float, float, float]
    ) -> tuple[float, float, float, float]:
        """Solve without stops; set the pose's status and return the turn."""
        turn = (0.0, self.one, 0.0, self.one)
        m = self.vertex(turn)
        before = math.inf
        for step in range(STEPS):
            v, path, distance = self._wanted(s, p, m)
            if distance == 0.0:
                pose.status = DEGENERATE
                return turn
            reached, turn = self._direction(v, pose.branch)
            new = self.vertex(turn)
            moved = minus(new, m)
            if reached:
                # The ray leaves parallel to the old path; motion along the path causes no miss.
                moved = across(moved, path)
            m = new
            size = norm(moved)
            if size <= self.tolerance:
                pose.status = OK if reached or self._strikes(s, p, turn) else UNREACHABLE
                return turn
            if step >= 1 and not size < SLOW * before:
                return self._newton(pose, s, p, turn)
            before = size
        return self._newton(pose, s, p, turn)

    def _gap(
        self,
        s: tuple[float, float, float],
        p: tuple[float, float, float],
        turn: tuple[float, float, float, float],
    ) -> tuple[tuple[float, float, float], tuple[float, float, float], float]:
        """Return normal − bisector, direction to the aim, and distance, at a turn."""
        v, path, distance = self._wanted(s, p, self.vertex(turn))
        return minus(self.turned(turn, self.normal), v), path, distance

    def _residual(
        self,
        s: tuple[float, float, float],
        p: tuple[float, float, float],
        turn: tuple[float, float, float, float],
    ) -> float:
        """Return the angle between the normal and the bisector at a turn, rad."""
        gap, _, distance = self._gap(s, p, turn)
        if distance == 0.0:
            return math.pi
        half = min(self.one, 0.5 * norm(gap))
        return 2.0 * math.atan2(half, math.sqrt((1.0 - half) * (1.0 + half)))

    def _strikes(
        self,
        s: tuple[float, float, float],
        p: tuple[float, float, float],
        turn: tuple[float, float, float, float],
    ) -> bool:
        """Return whether the beam at a turn hits the aim to within tolerance and rounding."""
        gap, _, distance = self._gap(s, p, turn)
        # A normal that is off by x deflects the beam by 2x.
        limit = self.tolerance + 16.0 * self.eps * distance
        return distance > 0.0 and 2.0 * distance * norm(gap) <= limit

    def _column(
        self,
        p: tuple[float, float, float],
        s: tuple[float, float, float],
        turn: tuple[float, float, float, float],
        axis: int,
    ) -> tuple[float, float, float]:
        """Return the derivative of normal − bisector with respect to a joint angle.

        This is the screw formula.
        """
        m, n = self.vertex(turn), self.turned(turn, self.normal)
        w, arm = self.axis_1, m
        if axis == 1:
            w = about(self.axis_1, turn[0], turn[1], self.axis_2)
            arm = minus(m, about(self.axis_1, turn[0], turn[1], self.elbow))
        v, path, distance = self._wanted(s, p, m)
        change = times(-1.0 / distance, across(cross(w, arm), path))
        # |s + t| = 2 v·t for unit vectors.
        return minus(cross(w, n), times(0.5 / dot(v, path), across(change, v)))

    def _newton(
        self,
        pose: Pose,
        s: tuple[float, float, float],
        p: tuple[float, float, float],
        turn: tuple[float, float, float, float],
    ) -> tuple[float, float, float, float]:
        """Minimise |normal − bisector|² from a turn, with Levenberg-damped Gauss-Newton."""
        damping = 16.0 * self.eps
        gap, _, distance = self._gap(s, p, turn)
        cost = dot(gap, gap) if distance > 0.0 else math.inf
        pose.status = NOT_CONVERGED
        for _ in range(NEWTON_STEPS):
            if not math.isfinite(cost):
                return turn
            if self._strikes(s, p, turn):
                pose.status = OK
                return turn
            first, second = self._column(p, s, turn, 0), self._column(p, s, turn, 1)
            h00, h01, h11 = dot(first, first), dot(first, second), dot(second, second)
            e0, e1 = dot(first, gap), dot(second, gap)
            before = cost
            for _ in range(TRIALS):
                lift = damping * (h00 + h11)
                d00, d11 = h00 + lift, h11 + lift
                determinant = d00 * d11 - h01 * h01
                if determinant > 0.0:
                    step_1 = (h01 * e1 - d11 * e0) / determinant
                    step_2 = (h01 * e0 - d00 * e1) / determinant
                    trial = _advanced(turn, step_1, step_2)
                    new, _, distance = self._gap(s, p, trial)
                    if distance > 0.0 and dot(new, new) < cost:
                        turn, gap, cost = trial, new, dot(new, new)
                        break
                damping = 10.0 * damping
            damping = max(0.1 * damping, self.eps)
            if not cost < before * (1.0 - 64.0 * self.eps):
                # A minimum with a remainder means that no pose near here sends the beam to p.
                pose.status = OK if self._strikes(s, p, turn) else UNREACHABLE
                return turn
        return turn

    def _along_stop(
        self,
        pose: Pose,
        s: tuple[float, float, float],
        p: tuple[float, float, float],
        axis: int,
        held: float,
        stops: list[list[float]],
        near: list[float],
    ) -> None:
        """Find the nearest pose with joint ``axis`` held at a stop; keep it if it is better."""
        other = 1 - axis
        low, high = stops[other]
        free = min(max(near[other], low), high)
        for _ in range(STEPS):
            angles = (held, free) if axis == 0 else (free, held)
            v, _, distance = self._wanted(s, p, self.vertex(turn_of(angles[0], angles[1])))
            if distance == 0.0:
                return
            if axis == 0:
                back = about(self.axis_1, -math.sin(held), math.cos(held), v)
                turned = turn_between(self.axis_2, self.normal, back)
            else:
                u = about(self.axis_2, math.sin(held), math.cos(held), self.normal)
                turned = turn_between(self.axis_1, u, v)
            before, free = free, into_stops(turned, low, high, near[other])[0]
            if abs(free - before) <= 4.0 * self.eps:
                break
        angles = (held, free) if axis == 0 else (free, held)
        residual = self._residual(s, p, turn_of(angles[0], angles[1]))
        if residual < pose.residual:
            pose.residual = residual
            pose.angles[0], pose.angles[1] = angles


def turn_of(one: float, two: float) -> tuple[float, float, float, float]:
    """Return the turn (sin θ₁, cos θ₁, sin θ₂, cos θ₂) of two joint angles."""
    return math.sin(one), math.cos(one), math.sin(two), math.cos(two)


def _advanced(
    turn: tuple[float, float, float, float], one: float, two: float
) -> tuple[float, float, float, float]:
    """Return the turn advanced by two small angles, without computing the large angles."""
    s1, c1, s2, c2 = turn_of(one, two)
    return (
        turn[0] * c1 + turn[1] * s1,
        turn[1] * c1 - turn[0] * s1,
        turn[2] * c2 + turn[3] * s2,
        turn[3] * c2 - turn[2] * s2,
    )


def _motion(pose: Pose, near: list[float]) -> float:
    return max(abs(pose.angles[0] - near[0]), abs(pose.angles[1] - near[1]))
