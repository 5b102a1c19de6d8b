"""Scenes for synthetic frames: target, beams, light, paint, lens and sensor."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.camera import Camera, look_at
from heliotrope.field.marks import Mark
from heliotrope.field.target import Target
from heliotrope.geometry import as_float, rotation
from heliotrope.optics.mirror_image import Beam


@dataclass(frozen=True)
class Paint:
    """The paint of a target and its ageing.

    Attributes
    ----------
    reflectance, mark
        Reflectances of the white paint and of the marks.
    panels
        Columns and rows of metal sheets.
    seam, seam_width
        Reflectance of the gaps between sheets, and their width, m.
    wear
        Relative standard deviation of the reflectance over decimetres.
    stains, stain
        Number of stains, and largest relative loss of reflectance in a stain.
    patch
        Reflectance of a repaired patch; 0 for no patch.
    seed
        Seed for the positions of stains, wear and patch.
    """

    reflectance: float = 0.85
    mark: float = 0.08
    panels: tuple[int, int] = (4, 4)
    seam: float = 0.55
    seam_width: float = 0.008
    wear: float = 0.01
    stains: int = 5
    stain: float = 0.12
    patch: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("reflectance", "mark", "seam", "patch", "stain"):
            _share(f"paint: {name}", getattr(self, name))
        if min(self.panels) < 1 or self.stains < 0 or not self.seam_width >= 0.0:
            raise InputError("paint: panels must be 1 or more, stains and seam_width 0 or more")
        if not 0.0 <= self.wear <= 0.3:
            raise InputError(f"paint: wear must be between 0 and 0.3, not {self.wear}")


@dataclass(frozen=True)
class Surroundings:
    """The surroundings of a target: a wall in its plane, and sky.

    Attributes
    ----------
    wall
        Extent of the wall beyond the target to the left, right, up and down, m.
    reflectance
        Reflectance of the wall, on which light that misses the target falls.
    sky
        Brightness of the sky, W/m² on white.
    texture
        Relative standard deviation of wall and sky over metres.
    clutter
        Number of light and dark boxes on the wall.
    seed
        Seed for the positions of the boxes.
    """

    wall: tuple[float, float, float, float] = (1.5, 1.5, 3.0, 30.0)
    reflectance: float = 0.3
    sky: float = 250.0
    texture: float = 0.06
    clutter: int = 12
    seed: int = 0

    def __post_init__(self) -> None:
        _share("surroundings: reflectance", self.reflectance)
        wall = as_float(self.wall)
        if wall.shape != (4,) or not (np.isfinite(wall) & (wall >= 0.0)).all():
            raise InputError(f"surroundings: wall {self.wall} m needs 4 numbers, 0 or more")
        if not (np.isfinite(self.sky) and self.sky >= 0.0) or self.clutter < 0:
            raise InputError("surroundings: sky (W/m²) and clutter must be 0 or more")
        if not 0.0 <= self.texture <= 0.3:
            raise InputError(f"surroundings: texture must be between 0 and 0.3, not {self.texture}")


@dataclass(frozen=True)
class Shadow:
    """The edge of a shadow in the ambient light.

    Attributes
    ----------
    point
        A point on the edge, metres right of and above the target's centre, (2,).
    angle
        Direction into the shadow, counterclockwise from the right as seen from the front, rad.
    softness
        Width of the edge, m.
    left
        Fraction of the light that remains in the shadow.
    """

    point: tuple[float, float] = (0.0, 0.0)
    angle: float = 0.0
    softness: float = 0.05
    left: float = 0.4

    def __post_init__(self) -> None:
        _share("shadow: left", self.left)
        if not (np.isfinite([*self.point, self.angle]).all() and self.softness >= 0.0):
            raise InputError("shadow: point and angle must be finite, softness (m) 0 or more")


@dataclass(frozen=True)
class LensEffects:
    """Blur and stray light of a frame.

    Attributes
    ----------
    defocus
        Standard deviation of a Gaussian, or radius of a disk, px.
    disc
        Whether the blur is a disk, which is combined with a Gaussian of 0.5 px.
    shake
        Movement of the camera during the exposure, to the right and down, px; the ground truth
        refers to the middle of the exposure.
    veil
        Stray light everywhere, as a fraction of the frame's mean light.
    ghost, ghost_at, ghost_radius
        A reflection in the lens: its peak as a fraction of full scale, its position and its
        standard deviation, px.
    """

    defocus: float = 0.6
    disc: bool = False
    shake: tuple[float, float] = (0.0, 0.0)
    veil: float = 0.02
    ghost: float = 0.0
    ghost_at: tuple[float, float] = (0.0, 0.0)
    ghost_radius: float = 40.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.defocus <= 50.0 or not np.hypot(*self.shake) <= 100.0:
            raise InputError(
                f"lens: defocus must be 0 to 50 px and shake at most 100 px, not {self.defocus} px "
                f"and {self.shake} px"
            )
        _share("lens: veil", self.veil)
        if not (self.ghost >= 0.0 and self.ghost_radius > 0.0 and np.isfinite(self.ghost_at).all()):
            raise InputError("lens: ghost must be 0 or more, its radius (px) above 0")

    @property
    def base(self) -> float:
        """Standard deviation, px, of the blur that is applied to the paint itself."""
        if self.disc and self.defocus > 0.0:
            return 0.5
        return min(self.defocus, 0.6)

    @property
    def rest(self) -> "LensEffects":
        """The remaining blur, which is applied to the frame."""
        if self.disc:
            return self
        return replace(self, defocus=float(np.sqrt(self.defocus**2 - self.base**2)))


@dataclass(frozen=True)
class Sensor:
    """The conversion of light to pixel values.

    Attributes
    ----------
    electrons
        Number of electrons at full scale and gain 1.
    sensitivity
        Electrons per second per W/m² on white paint. With 6000 and 1 ms, full scale is reached at
        1667 W/m².
    exposure
        s.
    gain
        Relative gain; full scale is reached at ``electrons`` / ``gain`` electrons.
    read_noise
        Standard deviation of the read noise, electrons.
    offset
        Pixel value in darkness, as a fraction of full scale.
    bits
        Bits per value: 8, or 12 spread over 16 so that 4095 becomes 65535.
    srgb
        Whether to encode by the sRGB curve instead of linearly.
    colour
        Whether to produce blue, green and red, with different tints of beams and ambient light,
        instead of grey.
    """

    electrons: float = 10_000.0
    sensitivity: float = 6000.0
    exposure: float = 1e-3
    gain: float = 1.0
    read_noise: float = 6.0
    offset: float = 0.01
    bits: int = 8
    srgb: bool = False
    colour: bool = False

    def __post_init__(self) -> None:
        for name in ("electrons", "sensitivity", "exposure", "gain"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"sensor: {name} must be above 0 and finite, not {value}")
        if not (np.isfinite(self.read_noise) and self.read_noise >= 0.0):
            raise InputError(f"sensor: read_noise must be 0 or more, not {self.read_noise} e-")
        if not 0.0 <= self.offset < 1.0:
            raise InputError(f"sensor: offset must be 0 or more and below 1, not {self.offset}")
        if self.bits not in (8, 12):
            raise InputError(f"sensor: bits must be 8 or 12, not {self.bits}")

    @property
    def scale(self) -> float:
        """Fraction of full scale per W/m² on white."""
        return self.sensitivity * self.exposure * self.gain / self.electrons


@dataclass(frozen=True)
class Thrown:
    """A beam on a target.

    Attributes
    ----------
    target
        Name of the target.
    beam
        Flux in the target plane, at the middle of the exposure.
    strength
        Factor on the flux.
    motion
        Movement during the exposure, metres right and up.
    """

    target: str
    beam: Beam
    strength: float = 1.0
    motion: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.strength) and self.strength >= 0.0):
            raise InputError(
                f"beam on {self.target}: strength must be 0 or more, not {self.strength}"
            )


@dataclass(frozen=True)
class Scene:
    """Everything that a synthetic frame shows.

    Attributes
    ----------
    camera
        The camera with its position and rotation.
    targets
        Targets with their marks, except pictures, which cannot be drawn.
    beams
        Beams as `Thrown`, or as tuples of its arguments.
    ambient
        Irradiance of the targets without beams, W/m².
    gradient
        Relative increase of the ambient irradiance to the right and upwards, 1/m, about each
        target's centre.
    shadow
        Shadow on each target's plane.
    cloud
        Factor on all beams; 1 under a clear sky.
    paint, surroundings, lens, sensor
        See the classes of these names.
    """

    camera: Camera
    targets: tuple[Target, ...]
    beams: tuple[Thrown, ...] = ()
    ambient: float = 150.0
    gradient: tuple[float, float] = (0.0, 0.0)
    shadow: Shadow | None = None
    cloud: float = 1.0
    paint: Paint = field(default_factory=Paint)
    surroundings: Surroundings = field(default_factory=Surroundings)
    lens: LensEffects = field(default_factory=LensEffects)
    sensor: Sensor = field(default_factory=Sensor)

    def __post_init__(self) -> None:
        if not self.targets:
            raise InputError("scene: no target; pass at least one")
        names = [target.name for target in self.targets]
        if len(set(names)) < len(names):
            raise InputError(f"scene: targets {', '.join(names)}: a name occurs twice")
        beams: tuple[Any, ...] = self.beams
        thrown = tuple(b if isinstance(b, Thrown) else Thrown(*b) for b in beams)
        for beam in thrown:
            if beam.target not in names:
                raise UnknownNameError("target", beam.target, names)
        object.__setattr__(self, "beams", thrown)
        if not (np.isfinite(self.ambient) and self.ambient >= 0.0):
            raise InputError(f"scene: ambient must be 0 or more, not {self.ambient} W/m²")
        _share("scene: cloud", self.cloud)
        if not np.isfinite(self.gradient).all():
            raise InputError(f"scene: gradient must be finite, not {self.gradient} 1/m")


def exposed(scene: Scene, peak: float = 0.8) -> Scene:
    """Return the scene with the exposure set so that the brightest beam reads ``peak``.

    Parameters
    ----------
    scene
        Scene with beams; if it has none, the exposure is set so that the paint reads ``peak``.
    peak
        Pixel value of the target paint at the peak of the strongest beam, as a fraction of full
        scale.
    """
    sensor = scene.sensor
    if not peak > sensor.offset:
        raise InputError(
            f"scene: peak ({peak}) must be above the sensor's offset ({sensor.offset})"
        )
    flux = max((b.beam.peak * b.strength * scene.cloud for b in scene.beams), default=0.0)
    light = scene.paint.reflectance * (scene.ambient + flux)
    if not light > 0.0:
        raise InputError("scene: neither ambient light nor beams; nothing to expose for")
    exposure = sensor.exposure * (peak - sensor.offset) / (light * sensor.scale)
    return replace(scene, sensor=replace(sensor, exposure=exposure))


def example_target(
    side: float = 8.0, center: tuple[float, float, float] = (0.0, 0.0, 40.0), name: str = "target"
) -> Target:
    """Return a square target that faces north, with eight marks just inside its border.

    Corner marks are at the four corners, with T-shaped marks half-way between them. For a target
    side of 8 m the marks measure 0.6 m and have strokes of 0.12 m; otherwise their size is in
    proportion.
    """
    middle, half = as_float(center), 0.5 * side
    # Looking south at the target, west is on the right.
    right, up = np.array([-1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    inset = half - 0.0375 * side
    size, stroke = 0.075 * side, 0.015 * side
    quarter = 0.5 * np.pi
    places = {
        "upper_left": ("corner", -1, 1, 0), "upper_right": ("corner", 1, 1, -1),
        "lower_right": ("corner", 1, -1, 2), "lower_left": ("corner", -1, -1, 1),
        "top": ("tee", 0, 1, 0), "right": ("tee", 1, 0, -1),
        "bottom": ("tee", 0, -1, 2), "left": ("tee", -1, 0, 1),
    }  # fmt: skip
    marks = tuple(
        Mark(mark, kind, middle + inset * (x * right + y * up), size, stroke, turns * quarter)
        for mark, (kind, x, y, turns) in places.items()
    )
    ends = [(-half, half), (half, half), (half, -half), (-half, -half)]
    corners = np.stack([middle + x * right + y * up for x, y in ends])
    return Target(name, corners, middle, marks=marks)


def example_camera(
    target: Target,
    distance: float = 200.0,
    size: tuple[int, int] = (1600, 1200),
    *,
    side: float = 0.21,
    below: float = 0.19,
    roll: float = 0.006,
    fill: float = 0.7,
    distortion: float = 0.004,
    name: str = "camera",
) -> Camera:
    """Return a camera that sees a target from below and from one side, with distortion.

    Parameters
    ----------
    target
        Target in view; its centre is slightly off the middle of the frame.
    distance
        Distance from the target's centre, m.
    size
        Width and height of a frame, pixels.
    side, below
        Angles off the target normal, to the right as seen from the front of the target and
        downwards, rad.
    roll
        Rotation about the line of sight, rad.
    fill
        Fraction of the frame's shorter side that the target occupies.
    distortion
        Inward shift of the frame corners, as a fraction of their distance from the middle.
    name
        Name of the camera.
    """
    if not (distance > 0.0 and fill > 0.0):
        raise InputError(f"camera: distance and fill must be above 0, not {distance} m and {fill}")
    width, height = size
    right, up = target.axes
    towards = np.cos(below) * (np.cos(side) * target.normal + np.sin(side) * right)
    position = target.center + distance * (towards - np.sin(below) * up)
    extent = max(target.width, target.height)
    focal = fill * min(size) * distance / extent
    aim = target.center + 0.02 * extent * (right - up)
    R = look_at(position, aim) @ rotation([0.0, 0.0, 1.0], -roll)
    corner = float(np.hypot(0.5 * width, 0.5 * height)) / focal
    lens = [
        -1.2 * distortion / corner**2, 0.2 * distortion / corner**4,
        0.03 * distortion / corner, -0.02 * distortion / corner, 0.0,
    ]  # fmt: skip
    middle = 0.5 * (np.array(size) - 1.0) + [0.004 * width, -0.003 * height]
    matrix = np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
    return Camera(name, size, matrix, np.array(lens), position, R, targets=(target.name,))


def _share(what: str, value: float) -> None:
    if not 0.0 <= value <= 1.0:
        raise InputError(f"{what} must be between 0 and 1, not {value}")
