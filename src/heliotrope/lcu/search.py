"""Search: a spiral of beam offsets, followed until a camera sees the beam on the target."""

import math


class Spiral:
    """Points of an Archimedean spiral; neighbouring points are as far apart as its turns.

    Parameters
    ----------
    pitch
        Distance between neighbouring points and turns, rad of the beam.
    radius
        Largest offset, rad, at which the spiral ends.

    Raises
    ------
    ValueError
        If pitch and radius are not finite, not above 0, or need more than ``MOST`` points.
    """

    MOST = 4000

    def __init__(self, pitch: float, radius: float) -> None:
        if not (math.isfinite(pitch) and math.isfinite(radius) and pitch > 0.0 and radius > 0.0):
            raise ValueError("search: pitch and radius must be finite and above 0")
        if math.pi * radius * radius > self.MOST * pitch * pitch:
            raise ValueError("search: too many points; choose a wider pitch or a smaller radius")
        self.pitch, self.radius = pitch, radius
        self.turned = 0.0
        self.offset = [0.0, 0.0]
        self.over = False

    def advance(self) -> bool:
        """Advance to the next point, in ``offset`` (right, up), rad; return False at the end."""
        if self.over:
            return False
        per_radian = self.pitch / (2.0 * math.pi)
        # Arc length ds = per_radian √(1 + φ²) dφ, taken at the middle of the step.
        step = 2.0 * math.pi / math.sqrt(1.0 + self.turned * self.turned)
        for _ in range(3):
            middle = self.turned + 0.5 * step
            step = 2.0 * math.pi / math.sqrt(1.0 + middle * middle)
        self.turned += step
        distance = per_radian * self.turned
        if distance > self.radius:
            self.over = True
            return False
        self.offset[0] = distance * math.sin(self.turned)
        self.offset[1] = distance * math.cos(self.turned)
        return True


def displaced(
    aim: tuple[float, float, float],
    vertex: tuple[float, float, float],
    right: float,
    up: float,
) -> tuple[float, float, float]:
    """Return the aim moved right and up by angles (rad), as seen from the vertex."""
    east, north, high = aim[0] - vertex[0], aim[1] - vertex[1], aim[2] - vertex[2]
    flat = math.sqrt(east * east + north * north)
    slant = math.sqrt(flat * flat + high * high)
    if not flat > 1e-6 * slant:
        # Straight up: "up" is north.
        return aim[0] + slant * right, aim[1] + slant * up, aim[2]
    side = slant * right / flat
    lift = up / flat
    return (
        aim[0] + side * north - lift * high * east,
        aim[1] - side * east - lift * high * north,
        aim[2] + up * flat,
    )
