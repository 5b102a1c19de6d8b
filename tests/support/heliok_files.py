"""A HelioK file and a plant that several tests use."""

from pathlib import Path

import numpy as np

from heliotrope.field.formats import heliok
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target
from heliotrope.geometry import rotation
from heliotrope.mechanism import kinds
from heliotrope.mechanism.drives import linear_paint, rotary
from heliotrope.sun import Site

SCENE = Path(__file__).parents[1] / "files" / "heliok-scene.xml"
SITE = Site(34.707, 33.261, 10.0, name="Pentakomo")


def scene() -> heliok.Document:
    return heliok.read(SCENE)


def edited(tmp_path: Path, old: str, new: str) -> Path:
    """Return the scene's file with the first occurrence of a text replaced."""
    text = SCENE.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "scene.xml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return path


def mixed_plant() -> Plant:
    """Return heliostats of three kinds with errors, facets, drives, a receiver and a target."""
    rng = np.random.default_rng(7)
    place = rng.uniform(-100, 100, (3, 3)) * [1, 1, 0.01]
    stepper = rotary(200, 5000, microsteps=16, min_angle=-0.1, max_angle=1.6)
    azel = kinds.azimuth_elevation(
        place, pivot_height=[1.2, 1.3, 1.4], pivot_offset=0.2, drives=(rotary(200, 9000), stepper)
    )
    jack = linear_paint(154166.67, 0.0758, 0.335, 0.338, 0.0242, min_count=0, max_count=68000)
    jacks = kinds.two_jacks(place[:1] + 200, (jack, jack), concentrator_translation=(0, 0.175, 0))
    polar = kinds.polar(place[:2] - 200, np.radians(34.0), pivot_offset=0.1)
    across = np.zeros((1, 4, 3))
    across[..., 0] = 0.8
    up = np.zeros((1, 4, 3))
    up[..., 1] = 0.6
    corners = np.array([[a, b, 0.01] for a in (-0.85, 0.85) for b in (-0.65, 0.65)])[None]
    tip = rotation((0.3, 0.7, 0.0), 0.01)
    facets = Facets(corners, across @ tip.T, up @ tip.T)
    errors = {
        "tilt_north": 0.004,
        "non_orthogonality": -0.003,
        "canting": 0.002,
        "position_up": 0.05,
        "azimuth_bias": 0.01,
    }
    groups = {
        "a": Heliostats(
            ("a1", "a2", "a3"),
            azel,
            np.full(3, 2.0),
            np.full(3, 1.5),
            parameters={n: np.full(3, v) for n, v in errors.items()},
        ),
        "j": Heliostats(
            ("j1",),
            jacks,
            np.array([3.3]),
            np.array([2.5]),
            facets,
            aim=np.array([[1.0, 2.0, 30.0]]),
        ),
        "p": Heliostats(
            ("p1", "p2"),
            polar,
            np.full(2, 1.0),
            np.full(2, 1.0),
            aim=np.array([[0.0, 0.0, 30.0], [np.nan] * 3]),
        ),
    }
    tower = np.array([[2.0, 0, 45], [-2, 0.1, 45], [-2, 0.1, 40], [2, 0, 40]])
    receiver = Receiver("oven", "planar", (0, 1, 50), (0.1, 1, -0.3), 4.0, 5.0)
    target = Target("white", tower, tower.mean(axis=0))
    return Plant("mixed", SITE, groups, (target,), (receiver,))
