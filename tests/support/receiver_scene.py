"""A receiver in a camera's view, lit by known mirrors: frames with a known share of the flux."""

from dataclasses import replace
from functools import cache

import numpy as np

from heliotrope.field.camera import project
from heliotrope.field.target import Receiver
from heliotrope.geometry import FloatArray, normalize
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.receiver_light import ReceiverReference, ReceiverSight, take_reference
from heliotrope.imaging.synthetic.rendering import render
from heliotrope.imaging.synthetic.scenes import (
    Scene,
    Sensor,
    Surroundings,
    Thrown,
    example_camera,
)
from heliotrope.twin.drawing import Optics, thrown
from heliotrope.twin.sensors import light_share
from heliotrope.twin.true_mirrors import TrueMirror

SUN = normalize(np.array([0.2, -0.6, 0.75]), "sun")
RECEIVER = Receiver(
    "receiver", "planar", np.array([0.0, 0.0, 40.0]), np.array([0.0, 1.0, 0.0]), 6.0, 6.0
)
FACE = RECEIVER.face
CAMERA = replace(example_camera(FACE, 120.0, (320, 240), fill=0.45, name="eye"), targets=())
#: Mirrors of the field; all on the receiver are its nominal flux.
MIRRORS = 20
#: Fixed exposure: twenty beams in one place stay below full scale.
SENSOR = Sensor(exposure=3e-4, bits=12)


def mirrors(on: int, aside: FloatArray | None = None) -> list[TrueMirror]:
    """Mirrors north of the receiver: the first ``on`` shine on it, the others far above it.

    ``aside`` moves the aims of those that shine on it, m right and up, (2,).
    """
    found = []
    turn = 2.0 * np.pi * np.arange(MIRRORS) / MIRRORS
    for row in range(MIRRORS):
        place = np.array([8.0 * (row % 5 - 2), 60.0 + 6.0 * (row // 5), 1.5])
        # Neighbours in the order shine on opposite sides: the light is even at any number.
        angle, away = turn[(7 * row) % MIRRORS], (1.5, 0.7)[row % 2]
        spread = away * np.array([np.cos(angle), np.sin(angle)])
        aim = FACE.point(spread + (0.0 if aside is None else aside))
        if row >= on:
            aim = FACE.center + [0.0, 0.0, 60.0]
        normal = normalize(SUN + normalize(aim - place, "beam"), "normal")
        found.append(TrueMirror(f"M{row}", place, normal, 1.83, 1.22))
    return found


def true_share(field: list[TrueMirror]) -> float:
    """Share of the nominal flux, by the formula of the twin's own sensor."""
    normal, vertex = (np.array([getattr(m, part) for m in field]) for part in ("normal", "vertex"))
    return light_share(normal, vertex, SUN, FACE.center, 3.0)


@cache
def _beams(on: int, aside: tuple[float, float]) -> tuple[Thrown, ...]:
    return thrown(FACE, mirrors(on, np.array(aside)), SUN, Optics(slope_error=3e-3, facets=(1, 1)))


def frame(
    on: int = 0,
    *,
    ambient: float = 150.0,
    seed: int = 0,
    aside: tuple[float, float] = (0.0, 0.0),
    sensor: Sensor = SENSOR,
    **scene: object,
) -> Frame:
    """A photograph while ``on`` mirrors shine on the receiver, in daylight of ``ambient`` W/m²."""
    drawn = Scene(CAMERA, (FACE,), _beams(on, aside), ambient=ambient, sensor=sensor)
    drawn = replace(
        drawn, surroundings=Surroundings((6.0, 6.0, 6.0, 30.0), clutter=24, sky=1.6 * ambient)
    )
    return render(replace(drawn, **scene), seed, name=f"{on} mirrors").frame  # type: ignore[arg-type]


def capped(seed: int = 0, sensor: Sensor = SENSOR) -> Frame:
    """A photograph with the lens capped: the black level and the noise of the sensor alone."""
    chance = np.random.default_rng(seed)
    width, height = CAMERA.size
    noise = sensor.read_noise / sensor.electrons * chance.standard_normal((height, width))
    steps = 4095 if sensor.bits == 12 else 255
    level = np.clip(np.rint(steps * (sensor.offset + noise)), 0, steps)
    if sensor.bits == 12:
        return Frame(np.rint(level * 65535 / 4095).astype(np.uint16), "capped")
    return Frame(level.astype(np.uint8), "capped")


def sight(gamma: float = 1.0) -> ReceiverSight:
    return ReceiverSight("eye", "receiver", CAMERA.size, project(CAMERA, FACE.corners), gamma)


def reference(sensor: Sensor = SENSOR, gamma: float = 1.0, *lit: int) -> ReceiverReference:
    """A reference from four photographs, the beams of a few mirrors among them."""
    return take_reference(
        sight(gamma),
        capped(90, sensor),
        frame(seed=91, sensor=sensor),
        [(frame(on, seed=92 + on, sensor=sensor), true_share(mirrors(on))) for on in lit or (4, 8)],
    )
