"""How well spots are found and judged, on rendered frames with known truth.

1,200 frames of an 8 m target seen from 200 m over the whole range of conditions. Each is read in
three ways: with a frame taken just before without the beam, with a model of the empty target learnt
from a dozen earlier frames, and alone. For each of them: bias and scatter of the centroid, coverage
of its ellipses, and the frames accepted, by condition.

A frame is *clean* if it shows exactly one beam, with 99 % of its energy on the target, a
contrast of 0.25 or more, at most 5 % of its light clipped, marks and beam not smeared, and no
flare. A clean frame that is refused is a wrong reject. A frame that is accepted though its
centroid is off by more than 0.1 m (0.5 mrad at 200 m), or though it shows no beam, is a wrong
accept. Two beams so close that they look like one ("merged beams") cannot be told from a single
frame; they are counted separately.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from benchmarks._run import Result, Row
from heliotrope.errors import InputError
from heliotrope.field.camera import Camera
from heliotrope.geometry import FloatArray, direction
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.photograph import Photograph, PhotographSettings, read_photograph
from heliotrope.imaging.spots.background import EmptyTarget
from heliotrope.imaging.spots.quality import Expectation
from heliotrope.imaging.synthetic.rendering import (
    LensEffects,
    Paint,
    Rendered,
    Scene,
    Sensor,
    Shadow,
    Surroundings,
    Thrown,
    example_camera,
    example_target,
    exposed,
    render,
)
from heliotrope.optics.mirror_image import Beam, reflected_beam

TARGET = example_target(8.0)
#: A centroid farther off than this is wrong, m.
WRONG = 0.1
#: Brightness of the ambient light on white paint, W/m².
AMBIENT = 150.0
#: χ² of two dimensions at 68 % and 95 %.
ELLIPSES = (2.279, 5.991)
#: Cameras with targets, and beams to draw from.
WORLDS, BEAMS = 16, 160

Rng = np.random.Generator


@dataclass(frozen=True)
class World:
    """Camera and target that stay from frame to frame, and the reader's knowledge of them.

    Attributes
    ----------
    number
        Number of the world.
    paint_kind
        "even", "stained", "jointed" or "patched".
    camera
        The true camera.
    known
        The camera as given to the reader.
    paint, surroundings
        The true paint and surroundings.
    """

    number: int
    paint_kind: str
    camera: Camera
    known: Camera | None
    paint: Paint
    surroundings: Surroundings


@dataclass(frozen=True)
class Case:
    """A frame to be rendered and read.

    Attributes
    ----------
    condition
        Name of the condition.
    scene
        The scene to render.
    main
        Index of the beam to be measured; None if there is none.
    clean
        Whether the scene makes the frame clean.
    expected
        The beam that the reader expects.
    gamma
        Response of the camera as given to the reader.
    fault
        Reasons of which the reader should name one; empty if none.
    """

    condition: str
    scene: Scene
    main: int | None
    clean: bool = True
    expected: Expectation = field(default_factory=Expectation)
    gamma: float = 1.0
    fault: tuple[str, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """Result of reading a frame.

    Attributes
    ----------
    condition
        See `Case`.
    seed
        Seed of the frame: ``case(world, rng)`` with it draws the frame again.
    clean, accepted, named
        Whether the frame is clean, was accepted, and was refused for a right reason.
    error
        Error of the centroid, east and up, m; NaN without a centroid.
    mahalanobis
        Squared Mahalanobis distance of the error; NaN without a centroid.
    reasons
        Reasons named.
    faint
        Whether the contrast is below 0.25.
    """

    condition: str
    seed: tuple[int, int, int]
    clean: bool
    accepted: bool
    named: bool
    error: tuple[float, float]
    mahalanobis: float
    reasons: tuple[str, ...]
    faulty: bool = False

    @property
    def off(self) -> float:
        """Distance of the centroid from the truth, m; NaN without a centroid."""
        return float(np.hypot(*self.error))

    @property
    def wrong_accept(self) -> bool:
        """Whether the frame was accepted but should not have been."""
        return self.accepted and not self.off <= WRONG

    @property
    def wrong_reject(self) -> bool:
        """Whether the frame was refused although it is clean."""
        return self.clean and not self.accepted


# -- worlds ----------------------------------------------------------------------------


def world(number: int, seed: int, size: tuple[int, int] = (1600, 1200)) -> World:
    """Return a camera and an aged target."""
    rng = np.random.default_rng([seed, number])
    kind = ("even", "stained", "jointed", "patched")[number % 4]
    camera = example_camera(
        TARGET,
        200.0,
        size,
        side=rng.uniform(-0.35, 0.35),
        below=rng.uniform(0.05, 0.3),
        roll=rng.normal(0.0, 0.02),
        fill=rng.uniform(0.55, 0.8),
        distortion=rng.uniform(0.0, 0.01),
    )
    known = (camera, replace(camera, position=None, R_enu_camera=None), None)[number % 3]
    paint = Paint(
        wear=rng.uniform(0.003, 0.012),
        stains=0,
        panels=(1, 1),
        seam_width=rng.uniform(0.004, 0.012),
        seed=int(rng.integers(1_000_000)),
    )
    if kind == "stained":
        paint = replace(paint, stains=int(rng.integers(3, 9)), stain=rng.uniform(0.04, 0.15))
    if kind == "jointed":
        paint = replace(
            paint,
            panels=(int(rng.integers(2, 7)), int(rng.integers(2, 7))),
            seam=rng.uniform(0.3, 0.7),
            stains=3,
            stain=0.05,
        )
    if kind == "patched":
        paint = replace(paint, patch=rng.uniform(0.7, 0.84), stains=3, stain=0.05)
    around = Surroundings(sky=rng.uniform(80.0, 400.0), seed=int(rng.integers(1_000_000)))
    return World(number, kind, camera, known, paint, around)


def draw_beam(rng: Rng) -> Beam:
    """Return the beam of one of many heliostats 50 to 400 m away, centred on the target."""
    return stored_beam(int(rng.integers(BEAMS)))


@lru_cache(maxsize=BEAMS)
def stored_beam(number: int) -> Beam:
    """Return the beam of a heliostat by its number, centred on the target."""
    rng = np.random.default_rng([7, number])
    while True:
        distance, bearing = rng.uniform(50.0, 400.0), rng.uniform(-0.9, 0.9)
        mirror = (distance * np.sin(bearing), distance * np.cos(bearing), rng.uniform(1.0, 6.0))
        slant = float(np.linalg.norm(TARGET.center - mirror))
        sun = direction(rng.uniform(1.6, 4.7), rng.uniform(0.2, 1.1))
        width, height = rng.uniform(1.2, 3.6, 2)
        focal = slant * np.exp(rng.normal(0.0, 0.2)) if rng.random() < 0.7 else np.inf
        beam = reflected_beam(
            TARGET,
            mirror,
            sun,
            width,
            height,
            facets=tuple(rng.integers(1, 4, 2).tolist()),
            focal=focal,
            facet_focal=focal if rng.random() < 0.5 else np.inf,
            slope_error=rng.uniform(0.4e-3, 1.8e-3),
            sun_shape=("limb", "pillbox", f"buie:{rng.uniform(0.01, 0.05)}")[rng.integers(3)],
            step=0.04,
            elements=10,
        )
        beam = beam.shifted(-beam.centroid)
        if beam.on_target(TARGET)[0] > 0.995:
            return beam


def placed(rng: Rng, beam: Beam, share: tuple[float, float] = (0.99, 1.0)) -> Beam:
    """Return the beam moved so that a share of its energy within bounds falls on the target."""
    reach = 3.7 if share[1] == 1.0 else 5.0
    for _ in range(400):
        moved = beam.shifted(rng.uniform(-reach, reach, 2))
        if share[0] <= moved.on_target(TARGET)[0] <= share[1]:
            return moved
        reach = max(0.98 * reach, 0.02) if share[1] == 1.0 else reach
    return beam


def lit(beam: Beam, contrast: float, motion: tuple[float, float] = (0.0, 0.0)) -> Thrown:
    """Return the beam with its peak at a multiple of the ambient light."""
    return Thrown("target", beam, contrast * AMBIENT / beam.peak, motion)


def expectation(rng: Rng, thrown: Thrown, place: World, sensor: Sensor) -> Expectation:
    """Return a plant's prior knowledge of a beam: power and length to a tenth.

    The power is relative to the ambient light, or to exposure and gain.
    """
    width, length = np.sqrt(np.linalg.eigvalsh(thrown.beam.second_moments)) * np.exp(
        rng.normal(0.0, 0.1, 2)
    )
    watts = thrown.beam.power * thrown.strength * float(np.exp(rng.normal(0.0, 0.1)))
    told = Expectation(length=float(length), width=float(width), deviation=0.1)
    if rng.random() < 0.5:
        return replace(told, power=watts / AMBIENT)
    per_watt = place.paint.reflectance * sensor.sensitivity / sensor.electrons
    return replace(told, flux=watts * per_watt)


# -- conditions ------------------------------------------------------------------------


def plain(rng: Rng, place: World) -> Case:
    """One beam on a target under even light."""
    thrown = lit(placed(rng, draw_beam(rng)), float(np.exp(rng.uniform(np.log(0.25), np.log(3.0)))))
    sensor = Sensor(
        electrons=rng.uniform(5e3, 2e4),
        read_noise=rng.uniform(3.0, 12.0),
        offset=rng.uniform(0.0, 0.02),
        bits=int(rng.choice([8, 12])),
        colour=bool(rng.random() < 0.3),
    )
    lens = LensEffects(defocus=rng.uniform(0.6, 1.5), veil=rng.uniform(0.0, 0.04))
    scene = Scene(
        place.camera,
        (TARGET,),
        (thrown,),
        ambient=AMBIENT,
        gradient=tuple(rng.normal(0.0, 0.006, 2).tolist()),
        paint=place.paint,
        surroundings=place.surroundings,
        lens=lens,
        sensor=sensor,
    )
    scene = exposed(scene, rng.uniform(0.35, 0.8))
    told = expectation(rng, thrown, place, scene.sensor) if rng.random() < 0.6 else Expectation()
    return Case("plain: " + place.paint_kind, scene, 0, expected=told)


def faint(rng: Rng, place: World) -> Case:
    """A beam that is a quarter to a fifth as bright as the ambient light."""
    base = plain(rng, place)
    (thrown,) = base.scene.beams
    contrast = rng.uniform(0.2, 0.35)
    thrown = lit(thrown.beam, contrast)
    scene = exposed(replace(base.scene, beams=(thrown,)), rng.uniform(0.35, 0.8))
    told = expectation(rng, thrown, place, scene.sensor) if rng.random() < 0.6 else Expectation()
    return replace(base, condition="faint", scene=scene, expected=told, clean=contrast >= 0.25)


def gradient(rng: Rng, place: World) -> Case:
    """Light that falls off by up to half across the target."""
    base = plain(rng, place)
    slope = rng.uniform(0.02, 0.06)
    turn = rng.uniform(0.0, 2.0 * np.pi)
    scene = replace(base.scene, gradient=(slope * np.cos(turn), slope * np.sin(turn)))
    return replace(base, condition="gradient", scene=scene, expected=Expectation())


def shadow(rng: Rng, place: World) -> Case:
    """An edge of shadow across the target."""
    base = plain(rng, place)
    edge = Shadow(
        tuple(rng.uniform(-3.5, 3.5, 2).tolist()),
        rng.uniform(0.0, 2.0 * np.pi),
        softness=float(np.exp(rng.uniform(np.log(0.05), np.log(1.5)))),
        left=rng.uniform(0.3, 0.9),
    )
    scene = replace(base.scene, shadow=edge)
    return replace(base, condition="shadow", scene=scene, expected=Expectation())


def soft(rng: Rng, place: World) -> Case:
    """A frame out of focus, a little or beyond use."""
    base = plain(rng, place)
    per_metre = pixels_per_metre(place.camera)
    defocus = float(np.exp(rng.uniform(np.log(0.01), np.log(0.4)))) * per_metre
    scene = replace(base.scene, lens=replace(base.scene.lens, defocus=max(defocus, 0.6)))
    blurred = defocus / per_metre
    return replace(
        base,
        condition="out of focus",
        scene=scene,
        clean=blurred < 0.08,
        fault=("out of focus", "target not found") if blurred > 0.18 else (),
    )


def shaken(rng: Rng, place: World) -> Case:
    """A frame during which the camera moved."""
    base = plain(rng, place)
    per_metre = pixels_per_metre(place.camera)
    length = min(float(np.exp(rng.uniform(np.log(0.02), np.log(0.8)))) * per_metre, 99.0)
    turn = rng.uniform(0.0, 2.0 * np.pi)
    shake = (length * np.cos(turn), length * np.sin(turn))
    scene = replace(base.scene, lens=replace(base.scene.lens, shake=shake))
    moved = length / per_metre
    fault = ("moved", "out of focus", "target not found") if moved > 0.45 else ()
    return replace(base, condition="camera moved", scene=scene, clean=moved < 0.12, fault=fault)


def moving(rng: Rng, place: World) -> Case:
    """A frame during which the beam moved."""
    base = plain(rng, place)
    (thrown,) = base.scene.beams
    told = expectation(rng, thrown, place, base.scene.sensor)
    way = rng.uniform(0.0, 3.0)
    turn = rng.uniform(0.0, 2.0 * np.pi)
    thrown = replace(thrown, motion=(way * np.cos(turn), way * np.sin(turn)))
    moments = thrown.beam.swept(thrown.motion).second_moments
    longer = float(np.sqrt(np.linalg.eigvalsh(moments)[-1])) / told.length
    scene = replace(base.scene, beams=(thrown,))
    return replace(
        base,
        condition="beam moved",
        scene=scene,
        expected=told,
        clean=longer < 1.3,
        fault=("smeared", "cloud", "cut at the edge", "several spots") if longer > 1.7 else (),
    )


def flare(rng: Rng, place: World) -> Case:
    """Stray light over the whole frame."""
    base = plain(rng, place)
    veil = float(np.exp(rng.uniform(np.log(0.05), np.log(1.0)))) * 4.0
    scene = replace(base.scene, lens=replace(base.scene.lens, veil=min(veil, 1.0)))
    return replace(base, condition="flare", scene=scene, expected=Expectation(), clean=False)


def ghost(rng: Rng, place: World) -> Case:
    """A reflection in the lens."""
    base = plain(rng, place)
    size = np.array(place.camera.size)
    lens = replace(
        base.scene.lens,
        ghost=rng.uniform(0.05, 0.4),
        ghost_at=tuple(rng.uniform(0, 1, 2) * size),
        ghost_radius=rng.uniform(0.2, 2.0) * pixels_per_metre(place.camera),
    )
    return replace(base, condition="ghost", scene=replace(base.scene, lens=lens), clean=False)


def cloud(rng: Rng, place: World) -> Case:
    """A beam weakened by clouds; its expected power is known."""
    base = plain(rng, place)
    told = expectation(rng, base.scene.beams[0], place, base.scene.sensor)
    left = rng.uniform(0.05, 1.0)
    scene = exposed(replace(base.scene, cloud=left), rng.uniform(0.35, 0.8))
    contrast = left * base.scene.beams[0].strength * base.scene.beams[0].beam.peak / AMBIENT
    return replace(
        base,
        condition="cloud",
        scene=scene,
        expected=told,
        clean=left > 0.75 and contrast >= 0.25,
        fault=("cloud", "no spot") if left < 0.35 else (),
    )


def clipped(rng: Rng, place: World) -> Case:
    """An overexposed frame."""
    base = plain(rng, place)
    scene = exposed(base.scene, float(np.exp(rng.uniform(np.log(0.95), np.log(3.0)))))
    return replace(base, condition="clipped", scene=scene)


def two(rng: Rng, place: World) -> Case:
    """Two beams on the target, farther apart than their mean diameters at half their height."""
    base = plain(rng, place)
    while True:
        beam, second = placed(rng, draw_beam(rng)), placed(rng, draw_beam(rng))
        way = second.centroid - beam.centroid
        apart = float(np.linalg.norm(way))
        spread = [float(np.sqrt(way @ b.second_moments @ way)) / apart for b in (beam, second)]
        if apart > 1.18 * sum(spread):
            return _with_second(rng, place, replace(base, condition="two beams"), beam, second)


def merged(rng: Rng, place: World) -> Case:
    """Two beams on the target, closer than their mean diameters at half their height."""
    base = plain(rng, place)
    (thrown,) = base.scene.beams
    beam = thrown.beam
    for _ in range(50):
        second = placed(rng, draw_beam(rng))
        way = second.centroid - beam.centroid
        apart = float(np.linalg.norm(way))
        spread = [float(np.sqrt(way @ b.second_moments @ way)) / apart for b in (beam, second)]
        if apart <= 1.18 * sum(spread):
            break
    return _with_second(rng, place, replace(base, condition="merged beams"), beam, second)


def _with_second(rng: Rng, place: World, base: Case, beam: Beam, second: Beam) -> Case:
    share = float(np.exp(rng.uniform(np.log(0.15), np.log(1.0))))
    first = lit(beam, base.scene.beams[0].strength * base.scene.beams[0].beam.peak / AMBIENT)
    other = Thrown("target", second.of_power(share * beam.power), first.strength)
    scene = exposed(replace(base.scene, beams=(first, other)), rng.uniform(0.35, 0.8))
    return replace(
        base,
        scene=scene,
        expected=expectation(rng, first, place, scene.sensor),
        clean=False,
        fault=("several spots", "lopsided", "smeared"),
    )


def beside(rng: Rng, place: World) -> Case:
    """One beam on the target, another one beside it."""
    base = plain(rng, place)
    (thrown,) = base.scene.beams
    second = draw_beam(rng)
    while True:
        moved = second.shifted(rng.uniform(-8.0, 8.0, 2))
        if moved.on_target(TARGET)[0] < 0.03:
            break
    other = lit(moved, rng.uniform(0.3, 3.0))
    scene = exposed(replace(base.scene, beams=(thrown, other)), rng.uniform(0.35, 0.8))
    return replace(base, condition="beam beside", scene=scene, clean=False)


def cut(rng: Rng, place: World) -> Case:
    """A beam that misses the target in part."""
    base = plain(rng, place)
    beam = placed(rng, draw_beam(rng), (0.4, 0.99))
    thrown = lit(beam, rng.uniform(0.25, 3.0))
    scene = exposed(replace(base.scene, beams=(thrown,)), rng.uniform(0.35, 0.8))
    fault = ("cut at the edge", "no spot") if beam.on_target(TARGET)[0] < 0.8 else ()
    return replace(
        base, condition="cut", scene=scene, expected=Expectation(), clean=False, fault=fault
    )


def empty(rng: Rng, place: World) -> Case:
    """No beam; every third time with a shadow, every third time with strong gradients."""
    base = (plain, gradient, shadow)[rng.integers(3)](rng, place)
    scene = exposed(replace(base.scene, beams=()), rng.uniform(0.2, 0.8))
    return Case("no beam", scene, None, clean=False, fault=("no spot",))


def dark(rng: Rng, place: World) -> Case:
    """Almost no ambient light, with a beam or without."""
    base = plain(rng, place)
    (thrown,) = base.scene.beams
    with_beam = rng.random() < 0.6
    scene = replace(
        base.scene,
        beams=(replace(thrown, strength=5.0 * thrown.strength),) if with_beam else (),
        ambient=float(np.exp(rng.uniform(np.log(0.05), np.log(50.0)))),
    )
    scene = exposed(scene, rng.uniform(0.35, 0.8)) if with_beam else scene
    fault = () if with_beam else ("no spot", "target not found")
    return Case("dark", scene, 0 if with_beam else None, clean=False, fault=fault)


def on_marks(rng: Rng, place: World) -> Case:
    """A beam that lights marks."""
    base = plain(rng, place)
    thrown = base.scene.beams[0]
    best = thrown.beam
    for _ in range(30):
        moved = placed(rng, best)
        if np.abs(moved.centroid).max() > np.abs(best.centroid).max():
            best = moved
    thrown = lit(best, rng.uniform(0.25, 3.0))
    scene = exposed(replace(base.scene, beams=(thrown,)), rng.uniform(0.35, 0.8))
    return replace(base, condition="lit marks", scene=scene, expected=Expectation())


def curved(rng: Rng, place: World) -> Case:
    """A camera that encodes by sRGB, read with a gamma of 2.2."""
    base = plain(rng, place)
    sensor = replace(base.scene.sensor, srgb=True)
    return replace(base, condition="gamma", scene=replace(base.scene, sensor=sensor), gamma=2.2)


def noisy(rng: Rng, place: World) -> Case:
    """A frame of few electrons, with strong noise."""
    base = plain(rng, place)
    before = base.scene.sensor
    electrons = rng.uniform(300.0, 3000.0)
    sensor = replace(before, electrons=electrons, read_noise=rng.uniform(5.0, 20.0))
    scene = exposed(replace(base.scene, sensor=sensor), rng.uniform(0.35, 0.8))
    told = replace(base.expected, flux=base.expected.flux * before.electrons / electrons)
    return replace(base, condition="noise", scene=scene, expected=told)


CONDITIONS: dict[Callable[[Rng, World], Case], float] = {
    plain: 32, faint: 5, gradient: 4, shadow: 5, soft: 4, shaken: 4, moving: 4, flare: 4, ghost: 4,
    cloud: 5, clipped: 4, two: 4, merged: 2, beside: 4, cut: 5, empty: 6, dark: 3, on_marks: 4,
    curved: 4, noisy: 4,
}  # fmt: skip


def pixels_per_metre(camera: Camera) -> float:
    """Return the scale at the target, px/m."""
    assert camera.position is not None
    return float(camera.matrix[0, 0] / np.linalg.norm(TARGET.center - camera.position))


# -- reading ---------------------------------------------------------------------------


def case(place: World, seed: tuple[int, int, int]) -> Case:
    """Return the frame of a world for a seed."""
    rng = np.random.default_rng(seed)
    kinds = list(CONDITIONS)
    weights = np.array(list(CONDITIONS.values()))
    return kinds[rng.choice(len(kinds), p=weights / weights.sum())](rng, place)


def learn(place: World, seed: int, frames: int = 12) -> EmptyTarget | None:
    """Return the model of the empty target from a dozen earlier frames without a beam."""
    model = None
    for k in range(frames):
        rng = np.random.default_rng((seed, place.number, 10_000 + k))
        scene = (plain, gradient)[k % 2](rng, place).scene
        rendered = render(exposed(replace(scene, beams=()), rng.uniform(0.4, 0.8)), k)
        for face in read_photograph(rendered.frame, [TARGET], place.known).faces:
            model = (EmptyTarget.of(face.picture) if model is None else model).learn(face.picture)
    return model


def before(drawn: Case, seed: tuple[int, int, int]) -> Frame:
    """Return a frame taken some seconds before, without any beam.

    Since then the light has changed by a tenth, a little unevenly, and shadows have moved by some
    centimetres.
    """
    rng = np.random.default_rng((*seed, 1))
    scene = drawn.scene
    falls = np.array(scene.gradient) + rng.normal(0.0, 0.003, 2)
    shade = scene.shadow
    if shade is not None:
        moved = np.array(shade.point) + rng.normal(0.0, 0.02, 2)
        shade = replace(shade, point=tuple(moved.tolist()))
    light = scene.ambient * float(np.exp(rng.normal(0.0, 0.1)))
    scene = replace(scene, beams=(), ambient=light, gradient=tuple(falls.tolist()), shadow=shade)
    return render(scene, sum(seed) + 1_000_000).frame


def look(
    place: World,
    drawn: Case,
    rendered: Rendered,
    model: EmptyTarget | None = None,
    without: Frame | None = None,
) -> Photograph:
    """Return the reading of a frame."""
    settings = PhotographSettings(
        expectations={"target": drawn.expected},
        gamma=drawn.gamma,
        empty={} if model is None else {"target": model},
    )
    return read_photograph(
        rendered.frame, [TARGET], place.known, settings=settings, without=without
    )


def judge(
    drawn: Case, seed: tuple[int, int, int], rendered: Rendered, photograph: Photograph
) -> Outcome:
    """Return a reading compared with the truth."""
    reading = photograph.readings[0]
    nan = float("nan")
    error, square = np.full(2, nan), nan
    clean = drawn.clean
    if drawn.main is not None:
        truth = rendered.beams[drawn.main]
        clean = clean and truth.share_clipped <= 0.05 and truth.share_on_target >= 0.99
        if reading.spots and truth.share_on_target > 0.01:
            spot = reading.spots[0]
            error = spot.plane - truth.centroid
            square = float(error @ np.linalg.solve(spot.covariance, error))
    names = tuple(reason.name for reason in reading.reasons)
    return Outcome(
        drawn.condition,
        seed,
        clean,
        reading.good,
        any(n in drawn.fault for n in names),
        (float(error[0]), float(error[1])),
        square,
        names,
        bool(drawn.fault),
    )


def _read(task: tuple[int, int, int, tuple[int, int]]) -> list[tuple[Outcome, ...]]:
    """Return results for some frames of one world, for each of `WAYS`."""
    import cv2

    cv2.setNumThreads(1)
    number, seed, count, size = task
    place = world(number, seed, size)
    model = learn(place, seed)
    outcomes = []
    for k in range(count):
        key = (seed, number, k)
        drawn = case(place, key)
        rendered = render(drawn.scene, sum(key))
        ways = ((None, before(drawn, key)), (model, None), (None, None))
        outcomes.append(tuple(_outcome(place, drawn, key, rendered, *way) for way in ways))
    return outcomes


def _outcome(
    place: World,
    drawn: Case,
    key: tuple[int, int, int],
    rendered: Rendered,
    model: EmptyTarget | None,
    without: Frame | None,
) -> Outcome:
    try:
        photograph = look(place, drawn, rendered, model, without)
    except InputError:
        # Without the target in the frame without the beam, the frame counts as refused.
        clean = drawn.clean and rendered.beams[drawn.main or 0].share_clipped <= 0.05
        nan = (float("nan"), float("nan"))
        return Outcome(drawn.condition, key, clean, False, False, nan, float("nan"), ("no pair",))
    return judge(drawn, key, rendered, photograph)


WAYS = (
    "with a frame without the beam",
    "with a model of the empty target",
    "from each frame alone",
)


def measure(
    frames: int,
    seed: int,
    processes: int = 2,
    size: tuple[int, int] = (1600, 1200),
    worlds: int = WORLDS,
) -> list[list[Outcome]]:
    """Return the results for ``frames`` frames, for each of `WAYS`."""
    tasks = [(n, seed, -(-frames // worlds), size) for n in range(worlds)]
    if processes == 1:
        read = [each for task in tasks for each in _read(task)]
    else:
        with ProcessPoolExecutor(processes) as pool:
            read = [each for outcomes in pool.map(_read, tasks) for each in outcomes]
    return [list(way) for way in zip(*read, strict=True)]


def _row(way: str, name: str, outcomes: Sequence[Outcome]) -> Row:
    taken = [o for o in outcomes if o.accepted and np.isfinite(o.off)]
    errors: FloatArray = np.array([o.error for o in taken]).reshape(-1, 2)
    squares: Any = np.array([o.mahalanobis for o in taken])
    faulty = [o for o in outcomes if o.faulty]
    row: Row = {
        "background": way, "condition": name, "frames": len(outcomes),
        "clean": sum(o.clean for o in outcomes), "accepted": sum(o.accepted for o in outcomes),
        "east_mm": None, "up_mm": None, "rms_mm": None, "worst_mm": None, "in_68": None,
        "in_95": None, "wrong_accepts": sum(o.wrong_accept for o in outcomes),
        "wrong_rejects": sum(o.wrong_reject for o in outcomes),
        "faults": len(faulty), "faults_named": sum(o.named for o in faulty),
    }  # fmt: skip
    if taken:
        row |= dict(zip(("east_mm", "up_mm"), map(float, 1e3 * errors.mean(axis=0)), strict=True))
        row |= {
            "rms_mm": 1e3 * float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))),
            "worst_mm": 1e3 * float(np.max(np.hypot(*errors.T))),
            "in_68": float(np.mean(squares < ELLIPSES[0])),
            "in_95": float(np.mean(squares < ELLIPSES[1])),
        }
    return row


def run(quick: bool) -> Result:
    """Return the figures; merged beams, which no single frame can show, are not in the headline."""
    size = (800, 600) if quick else (1600, 1200)
    found = measure(4 if quick else 1200, 1, size=size, worlds=2 if quick else WORLDS)
    rows: list[Row] = []
    for way, outcomes in zip(WAYS, found, strict=True):
        rows += [
            _row(way, name, [o for o in outcomes if o.condition == name])
            for name in sorted({o.condition for o in outcomes})
        ]
        rows.append(_row(way, "all", outcomes))
        rows.append(_row(way, "clean", [o for o in outcomes if o.clean]))
    single = [o for o in found[0] if o.condition != "merged beams"]
    accepts, rejects = (sum(getattr(o, f"wrong_{k}") for o in single) for k in ("accept", "reject"))
    return Result(
        rows,
        f"{WAYS[0]}: wrong accepts {accepts} of {len(single)} frames, wrong rejects {rejects} of "
        f"{sum(o.clean for o in single)} clean ones",
    )
