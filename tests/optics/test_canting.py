"""Canting: facets send the sun where they are told."""

import numpy as np
import pytest

import heliotrope as ht
from heliotrope.errors import InputError
from heliotrope.geometry import direction, normalize, reflect
from heliotrope.optics.canting import canted
from heliotrope.optics.plant_scene import scene_of

PLANT = ht.example_plant()
NOON, LATE = (direction(np.radians(a), np.radians(e)) for a, e in ((5.0, 55.0), (300.0, 20.0)))


def misses(canting: object, sun: np.ndarray) -> np.ndarray:
    """How far the middle ray of each facet passes the aim, m, (H, F)."""
    mirrors = scene_of(PLANT, sun).mirrors
    got = canted(mirrors, (3, 2), canting, plant=PLANT)  # type: ignore[arg-type]
    assert got.facets is not None
    right, up, n = (a[:, None] for a in (got.right, got.up, got.normal))
    x, y = got.facets.center[..., :1], got.facets.center[..., 1:]
    place = got.center[:, None] + x * right + y * up
    a, b = got.facets.tilt[..., :1], got.facets.tilt[..., 1:]
    ray = reflect(np.broadcast_to(sun, place.shape), normalize(n + a * right + b * up))
    return np.linalg.norm(np.cross(got.aim[:, None] - place, ray), axis=-1)


def test_off_axis_all_facets_meet_the_aim_at_their_moment() -> None:
    assert misses(LATE, LATE).max() < 1e-9
    assert misses(LATE, NOON).max() > 0.05


def test_on_axis_facets_meet_at_normal_incidence_only() -> None:
    # The sun behind the target, as seen from the first mirror: it reflects straight back.
    mirrors = scene_of(PLANT, NOON).mirrors
    behind = normalize(mirrors.aim[0] - mirrors.center[0])
    assert misses("slant", behind)[0].max() < 2e-3
    assert misses("slant", LATE).max() > 0.05
    flat = misses(np.inf, behind)[0]
    assert flat.max() == pytest.approx(np.hypot(1.83 / 3, 1.22 / 4), rel=0.02)


def test_the_engine_and_rays_agree_on_canted_facets() -> None:
    pytest.importorskip("embreex")
    more = {"sun": LATE, "facets": (3, 2), "canting": NOON, "slope": 1.5e-3}
    engine, traced = ht.flux(PLANT, **more), ht.flux(PLANT, rays=2e5, **more)  # type: ignore[arg-type]
    assert engine.power == pytest.approx(traced.power, rel=2e-3)
    noise = np.sqrt(np.mean(traced.errors[0] ** 2)) / traced.peak
    apart = np.sqrt(np.mean((engine.flux - traced.flux) ** 2)) / traced.peak
    assert apart < noise + 0.01
    # Off axis at noon is worse in the evening than off axis in the evening.
    assert engine.peak < 0.97 * ht.flux(PLANT, **(more | {"canting": LATE})).peak  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("facets", "canting", "line"),
    [
        ((0, 3), "slant", "1 to 50 facets in each direction, not 0 × 3"),
        ((3, 2), -5.0, "focal length must be above 0, not -5.0 m"),
        ((3, 2), -NOON, "pass one sun vector above the horizon"),
    ],
)
def test_bad_canting_is_refused(facets: tuple[int, int], canting: object, line: str) -> None:
    mirrors = scene_of(PLANT, NOON).mirrors
    with pytest.raises(InputError, match=line):
        canted(mirrors, facets, canting, plant=PLANT)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="off-axis canting needs the plant"):
        canted(mirrors, (3, 2), NOON)
