"""A simulated dome flight: photographs of coded targets with ground truth."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from heliotrope.airborne.coded_targets import CodedTarget
from heliotrope.airborne.evaluate.reflections import join
from heliotrope.airborne.photo import LedCamera, Photo, write_camera
from heliotrope.airborne.plan.dome import Dome
from heliotrope.airborne.simulate.rendering import Conditions, FlightScene, render, write_photo
from heliotrope.airborne.simulate.simulation import Errors, miscalibrated
from heliotrope.airborne.standing import MirrorPoses
from heliotrope.geometry import rotation

#: Standard deviations of target placement: position, m, and tilt, rad.
_LAID, _TILT = 0.2, 0.02
_START = datetime(2026, 6, 21, 10, 0, tzinfo=UTC)


@dataclass(frozen=True)
class DomeFlight:
    """A simulated dome flight: true and recorded photographs, and the true targets."""

    camera: LedCamera
    known_camera: LedCamera
    taken: tuple[Photo, ...]
    recorded: tuple[Photo, ...]
    targets: tuple[CodedTarget, ...]


def fly_dome(
    dome: Dome, camera: LedCamera, errors: Errors | None = None, seed: int = 0
) -> DomeFlight:
    """Return a dome flight with errors of RTK, gimbal, lens file and hovering.

    The targets are decimetres off their planned positions and slightly tilted.
    """
    applied = errors or Errors()
    rng = np.random.default_rng(seed)
    targets = []
    for target in dome.targets:
        middle = target.corners.mean(axis=0)
        tilt = rotation(axis := rng.normal(0.0, _TILT, 3), float(np.linalg.norm(axis)))
        spin = rotation([0.0, 0.0, 1.0], rng.uniform(-np.pi, np.pi))
        corners = (target.corners - middle) @ (tilt @ spin).T
        targets.append(
            CodedTarget(target.number, middle + rng.normal(0.0, _LAID, 3) * [1, 1, 0.2] + corners)
        )
    taken, recorded = [], []
    for k, (place, attitude) in enumerate(zip(dome.position, dome.rotation, strict=True)):
        hovered = place + rng.normal(0.0, 1.0, 3) * applied.hover
        true = hovered - np.asarray(applied.rtk_offset) + rng.normal(0.0, 1.0, 3) * applied.rtk
        lean = applied.gimbal * rng.normal(0.0, 1.0, 3)
        turned = rotation(lean, float(np.linalg.norm(lean))) @ attitude
        name, time = f"DJI_{k + 1:04d}.JPG", _START + timedelta(seconds=5 * k)
        taken.append(Photo(name, time, true, turned))
        recorded.append(Photo(name, time, hovered, attitude, np.maximum(applied.rtk, 1e-4)))
    return DomeFlight(
        camera, miscalibrated(camera, applied.lens), tuple(taken), tuple(recorded), tuple(targets)
    )


def render_dome(
    flight: DomeFlight,
    folder: Path,
    origin: tuple[float, float, float],
    *,
    conditions: Conditions | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write the photographs of a dome flight with its camera; see `render_flight`."""
    light = conditions or Conditions()
    folder.mkdir(parents=True, exist_ok=True)
    nothing = MirrorPoses((), np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 4, 3)))
    ground = float(np.median([t.corners[:, 2].mean() for t in flight.targets]))
    scene = FlightScene(nothing, (), ground, light, flight.targets)
    write_camera(folder / "camera.toml", flight.known_camera)
    middle = np.mean([t.corners.mean(axis=0) for t in flight.targets], axis=0)
    for k, (taken, recorded) in enumerate(zip(flight.taken, flight.recorded, strict=True)):
        away = float(np.linalg.norm(taken.position - middle))
        moved = light.speed * light.exposure * flight.camera.focal / away
        scene = replace(scene, conditions=replace(light, motion=(-moved, 0.0)))
        picture = render(scene, flight.camera, taken, join([]), seed + k)
        write_photo(folder / recorded.name, picture, recorded, origin, light.quality)
        if progress is not None:
            progress(k + 1, len(flight.taken))
