"""Many mirrors measured at once by coded movements, on a target and on a receiver in production.

Beams are those of canted facets by cone optics, photographs are rendered from a camera's view and
rectified as photographs are. On the receiver a thousand other mirrors shine meanwhile, each
wandering by itself; their light is known to nobody.
"""

import time
from dataclasses import dataclass, replace

import numpy as np

from benchmarks._run import Result, Row
from heliotrope.field.target import Target
from heliotrope.imaging.coded import ExpectedBeam, Stack, coded_movements, separate
from heliotrope.imaging.photograph import read_photograph
from heliotrope.imaging.synthetic.rendering import (
    Scene,
    Sensor,
    Thrown,
    example_camera,
    example_target,
    exposed,
    render,
)
from heliotrope.imaging.targets.rectify import rectify
from heliotrope.imaging.targets.view import FaceView
from heliotrope.optics.beam import CHI_SQUARE_90
from heliotrope.optics.mirror_image import Beam, reflected_beam

#: Direction to the sun: south, 45° high.
SUN = np.array([0.0, -1.0, 1.0]) / np.sqrt(2.0)
#: Known error of the beams before the stack, and movement either way, rad.
KNOWN, MOVE = 0.5e-3, {"target": 0.3e-3, "receiver": 1.0e-3}
#: The other mirrors of a receiver, their groups (of one shape of beam), their errors and what each
#: wanders between photographs, rad.
OTHERS, GROUPS, ERRORS, WANDER = 1000, 60, 1e-3, 0.05e-3
#: Light of the sun between photographs, relative standard deviation.
FLICKER = 0.005
#: Assumed time of one movement with its photograph, and of the ways to and from a surface, s.
EACH_S, WAYS_S = 2.0, 180.0
#: Goal on the receiver, rad and share of the production.
GOAL_MRAD, LOST = 0.5, 0.01
STEP = 0.05


@dataclass(frozen=True)
class _Mirrors:
    """Mirrors with their beams as expected, and where these truly are."""

    beams: list[Beam]
    slant: np.ndarray
    expected: np.ndarray
    true: np.ndarray


def _mirrors(target: Target, count: int, spread: float, rng: np.random.Generator) -> _Mirrors:
    across = int(np.ceil(np.sqrt(count)))
    line = np.linspace(-spread, spread, across)
    expected = np.array([(a, b) for b in line for a in line])[:count]
    away, turn = rng.uniform(80.0, 200.0, count), rng.uniform(-0.6, 0.6, count)
    places = np.stack([away * np.sin(turn), away * np.cos(turn), np.full(count, 2.0)], axis=-1)
    slant = np.linalg.norm(places - target.center, axis=-1)
    beams = [
        reflected_beam(target, place, SUN, 3.0, 2.0, step=STEP, elements=8) for place in places
    ]
    true = expected + KNOWN * slant[:, None] * rng.standard_normal((count, 2))
    beams = [b.shifted(at - b.centroid) for b, at in zip(beams, true, strict=True)]
    return _Mirrors(beams, slant, expected, true)


def _grid(side: float) -> tuple[np.ndarray, np.ndarray]:
    line = np.arange(-0.75 * side, 0.75 * side, STEP)
    return np.stack(np.meshgrid(line, line), axis=-1), np.array([line[0], line[0]])


def _pictures(mirrors: _Mirrors, moves: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return the sum of the beams in each photograph, W/m², (K, H, W)."""
    total = np.zeros((len(moves), *places.shape[:2]))
    for i, beam in enumerate(mirrors.beams):
        each, which = np.unique(moves[:, i], axis=0, return_inverse=True)
        drawn = np.stack([beam.shifted(move).at(places) for move in each])
        total += drawn[which.reshape(-1)]
    return total


def _production(
    target: Target, places: np.ndarray, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Return the light of the other mirrors in each photograph, W/m², (K, H, W)."""
    groups = _mirrors(target, GROUPS, 1.0, rng)
    total = np.zeros((count, *places.shape[:2]))
    size = OTHERS // GROUPS
    for beam, slant in zip(groups.beams, groups.slant, strict=True):
        offsets = ERRORS * slant * rng.standard_normal((size, 2))
        light = np.sum([beam.shifted(offset).at(places) for offset in offsets], axis=0)
        up, right = np.gradient(light, STEP)
        # Each mirror wanders by itself; their sum by the mean.
        wander = WANDER / np.sqrt(size) * slant * rng.standard_normal((count, 2))
        total += light - wander[:, 0, None, None] * right - wander[:, 1, None, None] * up
    return np.maximum(total, 0.0)


def _photographs(
    target: Target, light: np.ndarray, first: np.ndarray, sensor: Sensor, empty: bool, size: int
) -> tuple[Stack, FaceView]:
    """Return rendered and rectified photographs of beams, exposed alike, and their view."""
    rng = np.random.default_rng(9)
    camera = example_camera(target, size=(4 * size // 3, size))
    plain = Scene(camera, (target,), sensor=sensor)
    seen = read_photograph(render(exposed(plain), 1).frame, (target,), camera)
    view = seen.views[0]
    brightest = Beam(light.max(axis=0), STEP, first)
    scene = exposed(replace(plain, beams=(Thrown(target.name, brightest),)), 0.75)
    values = []
    for k, picture in enumerate(light):
        flicker = float(np.clip(1.0 + FLICKER * rng.standard_normal() - 0.02, 0.0, 1.0))
        shown = replace(
            scene, beams=(Thrown(target.name, Beam(picture, STEP, first)),), cloud=flicker
        )
        picked = rectify(render(shown, 100 + k).frame, view)
        values.append(picked.values[::2, ::2])
    dark = rectify(render(replace(scene, beams=()), 7).frame, view, rim=3)
    stack = Stack(
        np.array(values, dtype=np.float64),
        2.0 * dark.step,
        dark.first,
        dark.paint[::2, ::2],
        None,
        dark.values[::2, ::2].astype(np.float64) if empty else None,
    )
    return stack, view


def _case(surface: str, count: int, size: int) -> Row:
    rng = np.random.default_rng(count)
    on_receiver = surface == "receiver"
    target = example_target(6.0 if on_receiver else 8.0, name=surface)
    mirrors = _mirrors(target, count, 1.0 if on_receiver else 2.2, rng)
    codes = coded_movements(count)
    moves = MOVE[surface] * mirrors.slant[None, :, None] * codes
    places, first = _grid(target.width)
    light = _pictures(mirrors, moves, places)
    lost = 0.0
    sensor = Sensor(bits=12)
    if on_receiver:
        others = _production(target, places, len(moves), rng)
        inside = (np.abs(places) < 0.5 * target.width).all(axis=-1)
        still = sum(beam.at(places)[inside].sum() for beam in mirrors.beams)
        before = still + others[:, inside].sum(axis=1).mean()
        lost = float((still - light[:, inside].sum(axis=1).mean()) / before)
        light = light + others
        # Twenty frames of a video are averaged.
        sensor = Sensor(bits=12, electrons=2e5, sensitivity=1.2e5, read_noise=27.0)
    stack, view = _photographs(target, light, first, sensor, not on_receiver, size)
    known = KNOWN * mirrors.slant
    expected = [
        ExpectedBeam(f"H{i}", at, sigma**2 * np.eye(2), beam.second_moments)
        for i, (at, sigma, beam) in enumerate(
            zip(mirrors.expected, known, mirrors.beams, strict=True)
        )
    ]
    start = time.process_time()
    found = separate(stack, moves, expected)
    spent = time.process_time() - start
    away = np.array([b.centroid for b in found.beams]) - mirrors.true
    # The view is known with an error, as in every photograph.
    covariance = np.array([b.covariance + view.covariance_at(b.centroid) for b in found.beams])
    proven = np.array([b in found.proven for b in found.beams])
    distance = np.einsum("ni,ni->n", away, np.linalg.solve(covariance, away[..., None])[..., 0])
    error = 1e3 * np.linalg.norm(away, axis=-1) / mirrors.slant
    return {
        "surface": surface,
        "mirrors": count,
        "photographs": len(moves),
        "proven": int(proven.sum()),
        "rms_mrad": float(np.sqrt(np.mean(error[proven] ** 2))),
        "worst_mrad": float(error[proven].max()),
        "within_90": float((distance[proven] < CHI_SQUARE_90).mean()),
        "power_lost_share": lost,
        "separation_cpu_s": spent,
        "mirrors_an_hour": 3600.0 * count / (EACH_S * len(moves) + WAYS_S),
    }


def run(quick: bool) -> Result:
    """Measure the error of mirrors that are measured at once."""
    cases = [("target", 7)]
    if not quick:
        cases = [(surface, count) for surface in ("target", "receiver") for count in (25, 50)]
    rows = [_case(surface, count, 480 if quick else 600) for surface, count in cases]
    last = rows[-1]
    return Result(
        rows,
        f"{last['mirrors']} mirrors at once on the {last['surface']}: {last['rms_mrad']:.2f} mrad "
        f"RMS at {100.0 * float(last['power_lost_share'] or 0.0):.2g} % of the power",
        {"seconds_a_photograph_assumed": EACH_S, "seconds_of_ways_assumed": WAYS_S},
        bool(
            float(last["rms_mrad"] or 0.0) <= GOAL_MRAD
            and float(last["power_lost_share"] or 0.0) <= LOST
        ),
    )
