"""Generated fields: heliostat positions, and whole plants around them.

There are four patterns: radial staggered (rings whose heliostats face the gaps of the ring in
front); rows in two fields north and south of the tower; and, from Malan's thesis, his twin field
(figure 3.2) and his triangles of six on arcs (figure 5.5). A mirror may face in any direction about
its pivot, so two heliostats must be further apart than a mirror diagonal plus a clearance; every
generator keeps this distance, and `nearest_gap` checks it.

Malan's thesis states the size of his plant: 5 MWe, 10,000 heliostats of 5 m² on 100,000 m² of
ground, and one cluster controller per 32 heliostats. Site, tower, receiver, targets and gears are
our own.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field import layout_tower as tower
from heliotrope.field.camera import Camera
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target
from heliotrope.geometry import FloatArray, direction, reflect
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import Drive, rotary
from heliotrope.mechanism.kernels import slots as slot
from heliotrope.mechanism.machine import AxisLimits, Machine, spread_machines
from heliotrope.sun import Site

#: Maximum number of heliostats per cluster controller.
CLUSTER = 32
#: Number of heliostats in a triangle.
PACK = 6
#: Fraction of the ground that the mirrors of Malan's twin field cover.
PACKING = 0.5
#: Maximum number of heliostats in a layout.
MOST = 1_000_000
#: Radius around masts and cameras that is kept free of mirrors, m.
FREE = 6.0
#: Steps per revolution of a joint; speed of its motor, steps/s.
_STEPS, _RATE = 400_000, 8000.0
#: Final approach from below, steps; angles by which both axes turn away at a defocus, rad;
#: elevation at stow, and the lowest at which a mirror is turned away there, rad.
_BACKLASH, _DEFOCUS, _STOW = 40, (0.1, 0.05), float(np.radians(88.0))
_LOWEST_STOW, _STOW_STEP = float(np.radians(45.0)), float(np.radians(1.0))
#: Largest declination of the sun, and its lowest refracted elevation, rad; width of a beam
#: including the errors of a mirror, rad; and clearance around anything that it must not light, m.
_TROPIC, _SUNRISE = float(np.radians(23.45)), float(np.radians(-0.6))
_SPREAD, _ROOM = float(np.radians(1.5)), 0.5
#: Distance of the standby point from the receiver, in widths of the receiver, and its minimum, m.
_ASIDE, _LEAST_ASIDE = 3.0, 8.0
_SITE = Site(-28.5, 21.2, 830.0, name="Northern Cape")


@dataclass(frozen=True)
class HeliostatSize:
    """One heliostat's size.

    Attributes
    ----------
    width, height
        Size of the mirror, m.
    pivot_height, pivot_offset
        Height of the axes above ground, and distance of the mirror in front of the axes, m.
    clearance
        Gap between two mirrors in any pose, m.
    """

    width: float = 2.5
    height: float = 2.0
    pivot_height: float = 1.7
    pivot_offset: float = 0.1
    clearance: float = 0.3

    def __post_init__(self) -> None:
        for name in ("width", "height", "pivot_height"):
            value = getattr(self, name)
            if not 0.0 < value < 50.0:
                raise InputError(f"mirror: {name} must be above 0 and below 50 m, not {value} m")
        for name in ("pivot_offset", "clearance"):
            value = getattr(self, name)
            if not 0.0 <= value < 10.0:
                raise InputError(f"mirror: {name} must be 0 or more and below 10 m, not {value} m")
        if self.pivot_height < 0.5 * self.height:
            raise InputError(
                f"mirror: the pivot is {self.pivot_height} m above ground and the mirror "
                f"{self.height} m high, so it would touch the ground when upright; raise the pivot "
                "to half the height"
            )

    @property
    def reach(self) -> float:
        """Smallest distance between two pivots, m: a diagonal, both offsets, and the clearance."""
        swing = np.hypot(np.hypot(self.width, self.height) / 2.0, self.pivot_offset)
        return float(2.0 * swing + self.clearance)


@dataclass(frozen=True)
class Ground:
    """The ground that mirrors may occupy.

    Attributes
    ----------
    tower_height
        Height of the receiver's centre above the pivots, m.
    nearest
        Distance from the tower to the nearest mirror, m.
    bearing, half_angle
        Azimuth from the tower to the middle of the field, and its extent to either side, rad;
        π is all around.
    free
        Circles without mirrors, (east, north, radius) each, m.
    """

    tower_height: float = 80.0
    nearest: float = 60.0
    bearing: float = np.pi
    half_angle: float = float(np.radians(70.0))
    free: tuple[tuple[float, float, float], ...] = ()

    def __post_init__(self) -> None:
        for name in ("tower_height", "nearest"):
            value = getattr(self, name)
            if not 0.0 < value < 1000.0:
                raise InputError(f"layout: {name} must be above 0 and below 1000 m, not {value} m")
        if not 0.05 <= self.half_angle <= np.pi + 1e-9:
            raise InputError(
                "layout: half angle must be between 3° and 180°, not "
                f"{np.degrees(self.half_angle):.0f}°"
            )

    def elevation(self, radius: float) -> float:
        """Elevation of the receiver as seen from a given distance, rad."""
        return float(np.arctan2(self.tower_height, radius))

    def bearings(self, radius: float, pitch: float, shift: float = 0.0) -> FloatArray:
        """Return the azimuths of positions ``pitch`` m apart on an arc.

        The middle of the arc is free to shift.
        """
        # The chord is shorter than the arc.
        step = 2.0 * np.arcsin(min(1.0, 0.5 * pitch / radius))
        if self.half_angle >= np.pi - 1e-9:
            count = int(2.0 * np.pi / step)
            step = 2.0 * np.pi / max(1, count)
            return np.asarray(self.bearing + (np.arange(count) + shift) * step)
        half = int(self.half_angle / step)
        around = np.arange(-half - 1, half + 2) + shift
        return np.asarray(self.bearing + around[np.abs(around) * step <= self.half_angle] * step)

    def clear(self, places: FloatArray) -> np.ndarray:
        """Return a mask of the positions (N, 2) that are outside all free circles, (N,)."""
        kept = np.ones(len(places), dtype=np.bool_)
        for east, north, radius in self.free:
            kept &= np.hypot(places[:, 0] - east, places[:, 1] - north) > radius
        return kept


@dataclass(frozen=True)
class Places:
    """Positions of heliostats.

    Attributes
    ----------
    names
        Unique names, (N).
    position
        Feet, ENU m, (N, 3).
    """

    names: tuple[str, ...]
    position: FloatArray

    def __len__(self) -> int:
        return len(self.names)


def radial_staggered(count: int, mirror: HeliostatSize, ground: Ground) -> Places:
    """Return heliostats on rings around the tower, each behind a gap in the ring in front.

    A zone begins as densely as mirrors can turn: ``reach`` apart along the ring and √3/2 of that
    between rings (Collado & Guallar 2012, Renewable Energy 46). Azimuths are constant within a
    zone, so that its heliostats spread out with the radius. Where there is room for two heliostats
    in place of one, a new zone begins. Rings are at least h / (2 sin θ) apart, where θ is the
    receiver's elevation, so that a heliostat sees over the heliostat two rings in front.

    Names: ring and number, "R012-034".
    """
    _check_count(count)
    parts: list[FloatArray] = []
    names: list[str] = []
    radius, ring, pitch = ground.nearest, 0, mirror.reach
    zone = radius
    shift = 0.0
    while len(names) < count:
        if radius >= 2.0 * zone:
            # The first ring of the next zone is as far out as if the zone stood alone.
            zone, shift = radius, 0.0
        around = ground.bearings(zone, pitch, shift)
        flat = radius * np.stack([np.sin(around), np.cos(around)], axis=-1)
        flat = _central(flat[ground.clear(flat)], count - len(names))
        ring += 1
        names += [f"R{ring:03d}-{k:03d}" for k in range(1, len(flat) + 1)]
        parts.append(flat)
        shift = 0.5 - shift
        radius += _ring_step(radius, zone, mirror, ground)
    return _places(names, parts)


def _ring_step(radius: float, zone: float, mirror: HeliostatSize, ground: Ground) -> float:
    """Return the distance from one ring to the next, m."""
    dense = 0.5 * np.sqrt(3.0) * mirror.reach
    # A ring that begins a zone has other azimuths, so no stagger can be relied on.
    sightline = 0.5 * mirror.height / np.sin(ground.elevation(radius))
    step = float(max(dense, sightline))
    return float(max(step, mirror.reach)) if radius + step >= 2.0 * zone else step


def rows(count: int, mirror: HeliostatSize, ground: Ground) -> Places:
    """Return heliostats in straight east-west rows, in two fields north and south of the tower.

    Each field is twice as wide as it is deep. Rows are ``reach`` apart near the tower and h / sin θ
    further out, where θ is the receiver's elevation, so that a heliostat sees over the row in
    front; every other row is shifted by half a pitch. The bearing and angle of the ground are not
    used.

    Names: field, row and number, "N012-034".
    """
    return _two_fields(
        count,
        ground,
        1.1 * mirror.reach,
        lambda north: max(mirror.reach, mirror.height / np.sin(ground.elevation(north))),
    )


def twin_field(count: int, mirror: HeliostatSize, ground: Ground) -> Places:
    """Return Malan's twin field: two equal fields of uniform density on both sides of the tower.

    Mirrors cover the fraction ``PACKING`` of a field's ground, Malan's 0.5 (3.2.1), or less where
    the clearance requires it: 0.47 with the default mirror, 0.5 up to a clearance of 0.19 m. Every
    other row is shifted by half a pitch, so that neighbours form equal triangles. A field is twice
    as wide as it is deep. This proportion, the stagger and the names (as in `rows`) are ours.
    """
    even = np.sqrt(2.0 / np.sqrt(3.0) * mirror.width * mirror.height / PACKING)
    pitch = max(mirror.reach, float(even))
    return _two_fields(count, ground, pitch, lambda _: 0.5 * np.sqrt(3.0) * pitch)


def _two_fields(count: int, ground: Ground, pitch: float, step: Callable[[float], float]) -> Places:
    """Return staggered rows north and south of the tower.

    Parameters
    ----------
    count
        Number of heliostats in both fields.
    ground
        Nearest distance to the tower, and the masts.
    pitch
        Distance between neighbours in a row, m.
    step
        Function that returns the distance to the next row from a row's distance to the tower, m.
    """
    _check_count(count)
    parts: list[FloatArray] = []
    names: list[str] = []
    for field, needed in {"N": (count + 1) // 2, "S": count // 2}.items():
        sign = 1.0 if field == "N" else -1.0
        across = _row_length(needed, ground.nearest, pitch, step)
        north, row, made = ground.nearest, 0, 0
        while made < needed:
            shift = 0.5 if row % 2 else 0.0
            half = max(0, int(across / 2.0))
            east = (np.arange(-half, half + 1) + shift) * pitch
            flat = np.stack([east, np.full(len(east), sign * north)], axis=-1)
            flat = flat[ground.clear(flat)]
            flat = _central(flat, needed - made)
            row += 1
            names += [f"{field}{row:03d}-{k:03d}" for k in range(1, len(flat) + 1)]
            parts.append(flat)
            made += len(flat)
            north += step(north)
    return _places(names, parts)


def _row_length(count: int, nearest: float, pitch: float, step: Callable[[float], float]) -> float:
    """Return the number of places per row for a field of ``count`` mirrors.

    The field is then about twice as wide as it is deep.
    """
    north, rows_made = nearest, 0
    while rows_made * 2.0 * (north - nearest) / pitch < count:
        north += step(north)
        rows_made += 1
    return 2.0 * (north - nearest) / pitch


def six_packs(count: int, mirror: HeliostatSize, ground: Ground) -> Places:
    """Return Malan's triangles of six mirrors on arcs around the tower.

    A triangle has a mirror at each corner and at the middle of each side. On an arc, triangles that
    point to the tower alternate with triangles that point away from it, with a footpath between
    neighbours. Arcs are separated by a road as wide as the reach of a mirror, or by h / sin θ if
    that is wider (θ is the receiver's elevation), so that mirrors see over the triangles in front.

    Names: triangle and position in it, "P0001A" to "P0001F".
    """
    _check_count(count)
    step = mirror.reach
    depth = 0.5 * np.sqrt(3.0) * step
    parts: list[FloatArray] = []
    made, radius = 0, ground.nearest
    while made * PACK < count:
        # On a curved arc, the inner corners are closest together.
        around = ground.bearings(radius, 2.0 * step + 0.5)
        middle = radius + depth
        packs = _triangles(around, middle, step)
        packs = packs[ground.clear(packs.reshape(-1, 2)).reshape(-1, PACK).all(axis=1)]
        remaining = -(-count // PACK) - made
        packs = _central(packs, remaining)
        parts.append(packs.reshape(-1, 2))
        made += len(packs)
        road = max(step, mirror.height / np.sin(ground.elevation(radius)))
        # The outer corners of a triangle lie further out than its side.
        radius = float(np.hypot(radius + 2.0 * depth, step)) + road
    names = [f"P{pack:04d}{'ABCDEF'[k]}" for pack in range(1, made + 1) for k in range(PACK)]
    return _places(names[:count], [np.concatenate(parts)[:count]])


def _triangles(around: FloatArray, radius: float, step: float) -> FloatArray:
    """Return triangles at azimuths (n,) on an arc, (n, 6, 2); odd-numbered ones are reversed."""
    depth = 0.5 * np.sqrt(3.0) * step
    # Coordinates to the right of the bearing and outwards, from the middle of the triangle's
    # height.
    own = np.array(
        [
            [0.0, -depth],
            [-0.5 * step, 0.0],
            [0.5 * step, 0.0],
            [-step, depth],
            [0.0, depth],
            [step, depth],
        ]
    )
    turned = own * [1.0, -1.0]
    shape = np.where((np.arange(len(around)) % 2 == 0)[:, None, None], own, turned)
    outward = np.stack([np.sin(around), np.cos(around)], axis=-1)[:, None, :]
    right = np.stack([np.cos(around), -np.sin(around)], axis=-1)[:, None, :]
    return np.asarray(shape[..., :1] * right + (radius + shape[..., 1:]) * outward)


def _central(along: FloatArray, room: int) -> FloatArray:
    """Return the middle part of a ring, row or arc, as far as there is room."""
    first = max(0, (len(along) - room) // 2)
    return along[first : first + room]


def _check_count(count: int) -> None:
    if not 1 <= count <= MOST:
        raise InputError(
            f"layout: the number of heliostats must be between 1 and {MOST}, not {count}"
        )


def _places(names: Sequence[str], parts: Sequence[FloatArray]) -> Places:
    flat = np.concatenate(list(parts))
    return Places(tuple(names), np.concatenate([flat, np.zeros((len(flat), 1))], axis=1))


def nearest_gap(position: FloatArray, mirror: HeliostatSize) -> float:
    """Return the smallest gap between two mirrors in any pose, m; if negative, they can touch.

    Parameters
    ----------
    position
        Pivots or feet, (N, 3); the gap is infinite for fewer than two.
    mirror
        Common size of the heliostats; its clearance counts as part of the gap.
    """
    from scipy.spatial import cKDTree

    if len(position) < 2:
        return float("inf")
    apart, _ = cKDTree(position).query(position, k=2)
    return float(np.asarray(apart)[:, 1].min() - (mirror.reach - mirror.clearance))


PATTERNS: dict[str, Callable[[int, HeliostatSize, Ground], Places]] = {
    "radial": radial_staggered,
    "rows": rows,
    "six-packs": six_packs,
    "twin-field": twin_field,
}
#: Patterns with a field on either side of the tower.
TWO_SIDED = ("rows", "twin-field")


def clusters(count: int, size: int = CLUSTER) -> tuple[str, ...]:
    """Return the cluster of each heliostat, from "C001" on, in the order of positions."""
    return tuple(f"C{1 + i // size:03d}" for i in range(count))


def stepped(position: FloatArray, mirror: HeliostatSize) -> Mechanism:
    """Return azimuth-elevation mechanisms on stepper motors at positions (N, 3).

    A joint makes 400,000 steps per revolution (15.7 µrad each), at 8000 steps/s or 7.2 °/s. The
    stops are at ±200° of azimuth, where 0 is north, and at -3.6° and 93.6° of elevation.
    """
    gear = {"microsteps": 4, "speed": _RATE}
    ratio = _STEPS / 800
    azimuth = rotary(200, ratio, min_angle=-np.radians(200.0), max_angle=np.radians(200.0), **gear)
    elevation = rotary(200, ratio, min_angle=np.radians(-3.6), max_angle=np.radians(93.6), **gear)
    return kinds.azimuth_elevation(
        position,
        pivot_height=mirror.pivot_height,
        pivot_offset=mirror.pivot_offset,
        drives=(azimuth, elevation),
    )


def stepped_machine(mechanism: Mechanism, receiver: Receiver) -> Machine:
    """Return limits and rest positions of identical azimuth-elevation mechanisms.

    The limits are the drives' stops, the rate is the drives' speed, and the acceleration reaches
    this rate in half a second. At stow the azimuth is midway between its stops and the mirror faces
    up; `unlit_machines` turns the heliostats whose beams would pass the receiver or a target. The
    standby point is beside the receiver, at the height of its centre.

    Parameters
    ----------
    mechanism
        Nominal mechanisms, (N,); their drives have a speed and stops.
    receiver
        Receiver at which the beams aim in operation.
    """
    drives = Drive(np.reshape(mechanism.drives.table, (-1, 2, slot.DRIVE_SLOTS))[0])
    ends = [drives.counts(drives.table[:, end]) for end in (slot.MIN_ANGLE, slot.MAX_ANGLE)]
    ranges = np.sort(np.round(np.stack(ends, axis=-1)), axis=-1).astype(np.int64)
    axes = []
    for (low, high), speed in zip(ranges.tolist(), drives.table[:, slot.SPEED], strict=True):
        axes.append(AxisLimits(low, high, int(speed), 2 * int(speed), _BACKLASH))
    up = round(float(drives.counts(np.array([0.0, _STOW]))[1]))
    level = np.array([-receiver.normal[1], receiver.normal[0], 0.0])
    level = level / max(float(np.linalg.norm(level)), 1e-9)
    aside = max(_ASIDE * receiver.width, _LEAST_ASIDE) * level
    east, north, height = (receiver.center + aside).tolist()
    stow = (int(ranges[0].mean()), up)
    standby = (east, north, height)
    return Machine((axes[0], axes[1]), stow, _DEFOCUS, standby)


def unlit_machines(
    machines: Sequence[Machine],
    mechanism: Mechanism,
    things: Sequence[tuple[FloatArray, float]],
    latitude: float,
) -> tuple[Machine, ...]:
    """Return the machines with stow positions from which no beam lights anything all year.

    A mirror that faces up keeps its stow position, unless some sun position would send its beam to
    one of the ``things``. The mirror is then turned away from them, and tilted just far enough that
    the sun would have to be below the horizon to light them. If even 45° is not enough, the whole
    group accepts such light (`Machine.stow_lights`).

    Parameters
    ----------
    machines, mechanism
        Machines and mechanisms of N azimuth-elevation heliostats whose azimuth is clockwise from
        north.
    things
        Centre, ENU, m, (3,), and radius, m, of each receiver and target.
    latitude
        Latitude, rad, north positive.
    """
    drives, armature = Drive(mechanism.drives.table), mechanism.armature
    stow = np.array([machine.stow for machine in machines])
    center = np.mean([place for place, _ in things], axis=0)
    away = armature.origin_1 - center
    turned = np.stack([np.arctan2(away[:, 0], away[:, 1]), np.full(len(stow), _STOW)], axis=-1)
    lighting = _lights(armature.pose(drives.angles(stow.astype(np.float64))), things, latitude)
    while lighting.any() and turned[:, 1].min() >= _LOWEST_STOW:
        turned[lighting, 1] -= _STOW_STEP
        stow[lighting] = np.round(drives.counts(turned))[lighting]
        lighting &= _lights(armature.pose(turned), things, latitude)
    return tuple(
        replace(machine, stow=(int(a), int(b)), stow_lights=bool(lighting.any()))
        for machine, (a, b) in zip(machines, stow.tolist(), strict=True)
    )


def _lights(
    pose: tuple[FloatArray, FloatArray],
    things: Sequence[tuple[FloatArray, float]],
    latitude: float,
) -> npt.NDArray[np.bool_]:
    """Return whether, at any sun position of the year, beams at rest hit ``things``, (N,).

    All sun positions at which a beam comes within the radius of a thing lie in a cone; the sun may
    be in this cone if it reaches above the horizon and between the tropics.
    """
    normal, vertex = pose
    pole = np.array([0.0, np.cos(latitude), np.sin(latitude)])
    reached = np.zeros(len(normal), dtype=np.bool_)
    for center, radius in things:
        path = center - vertex
        distance = np.linalg.norm(path, axis=-1)
        cone = np.arcsin(np.minimum((radius + _ROOM) / distance, 1.0)) + _SPREAD
        sun = reflect(path / distance[:, None], normal)
        up = np.arcsin(np.clip(sun[:, 2], -1.0, 1.0)) + cone > _SUNRISE
        reached |= up & (np.abs(np.arcsin(np.clip(sun @ pole, -1.0, 1.0))) - cone < _TROPIC)
    return reached


def malan_plant(heliostats: int = 10_000) -> Plant:
    """Return a plant of the size of Malan's: 5 MWe, 10,000 heliostats of 5 m², 313 clusters.

    It has triangles of six mirrors south of the tower, a cavity 80 m above the pivots, and two
    calibration targets of 12 m on masts 45 m east and west of the tower, clear of the path that
    beams take up the tower, each with a camera. Site, tower, receiver, targets and gears are ours.

    Parameters
    ----------
    heliostats
        Number of heliostats; with fewer heliostats, the plant is smaller but of the same kind,
        around the same tower.
    """
    return lay_out("six-packs", heliostats, tower_height=80.0, name="5 MWe")


def lay_out(
    kind: str,
    heliostats: int,
    *,
    mirror: HeliostatSize | None = None,
    tower_height: float | None = None,
    site: Site = _SITE,
    name: str = "",
) -> Plant:
    """Return a whole plant: heliostats, tower, two targets with cameras.

    The field lies on the poleward side of the tower (south in the southern hemisphere); fields of
    the kinds in `TWO_SIDED` lie on both sides.

    Parameters
    ----------
    kind
        One of `PATTERNS`.
    heliostats
        Number of heliostats, 1 to `MOST`.
    mirror
        Size of the heliostats; default: 5 m².
    tower_height
        Height of the receiver above the pivots, m, 20 to 500; default in proportion to the
        field: 80 m for 10,000 heliostats of 5 m², at least 30 m and at most 250 m.
    site
        Site; default: in the Northern Cape.
    name
        Name of the plant; default: the kind.

    Raises
    ------
    InputError
        If a number is out of range, or two mirrors could touch.
    UnknownNameError
        If there is no such kind.
    """
    if kind not in PATTERNS:
        raise UnknownNameError("layout", kind, PATTERNS)
    _check_count(heliostats)
    size = mirror or HeliostatSize()
    tall = _tower_height(heliostats, size) if tower_height is None else tower_height
    if not 20.0 <= tall <= 500.0:
        raise InputError(f"layout: tower height must be between 20 and 500 m, not {tall} m")
    facing = np.pi if site.latitude_deg < 0.0 else 0.0
    targets, cameras, receiver = _middle(tall, size.pivot_height, facing, kind in TWO_SIDED)
    masts = [t.center for t in targets] + [c.position for c in cameras if c.position is not None]
    radius = FREE + 0.5 * size.reach
    free = tuple((float(place[0]), float(place[1]), radius) for place in masts)
    ground = Ground(tall, 0.75 * tall, bearing=facing, free=free)
    places = PATTERNS[kind](heliostats, size, ground)
    gap = nearest_gap(places.position, size)
    if gap < -1e-9:
        raise InputError(
            f"layout {kind}: two mirrors would overlap by {-gap:.2f} m; raise the clearance"
        )
    count = len(places)
    mechanism = stepped(places.position, size)
    machines = spread_machines(stepped_machine(mechanism, receiver), places.names)
    surfaces: tuple[Receiver | Target, ...] = (receiver, *targets)
    things = [(s.center, 0.5 * float(np.hypot(s.width, s.height) + size.reach)) for s in surfaces]
    return Plant(
        name or kind,
        site,
        {
            "azel": Heliostats(
                places.names,
                mechanism,
                np.full(count, size.width),
                np.full(count, size.height),
                cluster=clusters(count),
                machines=unlit_machines(machines, mechanism, things, np.radians(site.latitude_deg)),
            )
        },
        targets,
        (receiver,),
        cameras=cameras,
    )


def _tower_height(heliostats: int, mirror: HeliostatSize) -> float:
    """Return the height of the tower in proportion to the field, m."""
    area = heliostats * mirror.width * mirror.height
    return float(np.clip(80.0 * np.sqrt(area / 50_000.0), 30.0, 250.0))


def _middle(
    height: float, pivot: float, facing: float, both: bool
) -> tuple[tuple[Target, ...], tuple[Camera, ...], Receiver]:
    """Return targets, cameras and the receiver, sized in proportion to the tower's height."""
    share = height / 80.0
    aside, up, away = 45.0 * share, 36.0 * share, 150.0 * share
    right = direction(facing - 0.5 * np.pi, 0.0)
    base = np.array([0.0, 0.0, pivot])
    # As seen by an observer who faces the tower. Each of two fields has its own target.
    sides = {"left": (-1.0, facing), "right": (1.0, facing + np.pi if both else facing)}
    targets, cameras = [], []
    for name, (side, front) in sides.items():
        center = side * aside * right + np.array([0.0, 0.0, up])
        target = tower.square_target(name, center, 12.0 * share, front)
        targets.append(target)
        cameras.append(tower.watching_camera(target, f"camera-{name}", away, 6.0, 20.0 * share))
    top = base + np.array([0.0, 0.0, height])
    receiver = (
        tower.cylinder("receiver", top, 7.0 * share, 8.0 * share)
        if both
        else tower.aperture("receiver", top, 7.0 * share, facing, np.radians(20.0))
    )
    return tuple(targets), tuple(cameras), receiver
