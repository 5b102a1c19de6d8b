"""Local aiming and single axes against Grigoriev's equations, written out here once more."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.field.formats import heliok
from heliotrope.geometry import (
    angle_between,
    azimuth_elevation,
    direction,
    normalize,
    reflect,
    rotation,
    wrap_signed,
)
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import Drive, direct
from heliotrope.mechanism.tracking import TrackingStatus, trace, track
from support.heliok_files import SITE, edited

#: Drives without stops, whose counts are radians.
FREE = Drive(np.stack([direct().table] * 2))
_LIMIT = 1e-10  # rad


def his_angles(a: Any, b: Any, v0: Any, v: Any) -> Iterator[tuple[float, float]]:
    """(6)-(8): primary and secondary angles in 0 to 2π that turn v0 to v, both branches."""
    k = np.cross(a, b)
    m_a = (a @ v - (a @ b) * (b @ v0)) / (1 - (a @ b) ** 2)
    m_b = (b @ v0 - (a @ b) * (a @ v)) / (1 - (a @ b) ** 2)
    m_k = np.sqrt((1 - m_a**2 - m_b**2 - 2 * m_a * m_b * (a @ b)) / (k @ k))
    for sign in (-1, 1):
        m = m_a * a + m_b * b + sign * m_k * k
        alpha = np.arctan2(a @ np.cross(m, v), m @ v - (a @ m) * (a @ v))
        beta = np.arctan2(b @ np.cross(v0, m), v0 @ m - (b @ v0) * (b @ m))
        yield tuple(q - 2 * np.pi * np.floor(q / (2 * np.pi)) for q in (alpha, beta))


def his_local(one: dict[str, Any], sun: Any, aim: Any) -> Iterator[tuple[float, float]]:
    """The section "Local aiming": sun to the heliostat's frame, aim and vertex in that frame."""
    s = one["turned"].T @ sun
    target = normalize(aim - (one["t1"] + one["t2"] + one["r0"]))
    return his_angles(one["a"], one["b"], reflect(target, one["n"]), s)


def machine(rng: np.random.Generator) -> dict[str, Any]:
    """A heliostat in any place with any axes."""
    found = {name: normalize(rng.normal(size=3)) for name in ("a", "b", "n", "w")}
    found |= {name: rng.normal(0, 0.3, 3) for name in ("t1", "t2", "r0")}
    found["turned"] = rotation(found.pop("w"), rng.uniform(0, 3))
    found["place"] = rng.uniform(-80, 80, 3)
    return found


def built(one: dict[str, Any]) -> Mechanism:
    return kinds.two_axis(
        one["place"],
        one["a"],
        one["b"],
        one["n"],
        origin_1=one["t1"],
        origin_2=one["t2"],
        vertex=one["r0"],
        orientation=one["turned"],
    )


def test_local_aiming_is_his() -> None:
    rng = np.random.default_rng(8)
    solved = 0
    for _ in range(100):
        one = machine(rng)
        vertex = one["t1"] + one["t2"] + one["r0"]
        aim = vertex + 2.0 * normalize(one["n"] + 0.3 * rng.normal(size=3))
        sun = direction(rng.uniform(0, 6), rng.uniform(0.1, 1.4))
        found = track(built(one), sun, aim, local=True)
        if (found.status == TrackingStatus.UNREACHABLE).all():
            continue
        solved += 1
        for branch, wanted in enumerate(his_local(one, sun, aim)):
            assert found.status[branch] == TrackingStatus.OK
            assert np.abs(wrap_signed(found.angles[branch] - wanted)).max() < _LIMIT
    assert solved > 50


@pytest.mark.parametrize("name", ["HeliostatA", "HeliostatB"])
def test_the_aim_of_a_file_is_in_the_heliostats_frame(tmp_path: Path, name: str) -> None:
    """An aim 5 m before the vertex, along the normal: the mirror looks at the sun."""
    path = edited(tmp_path, '<Aiming point="0, 0, 20"/>', '<Aiming point="0, 5.1, 1.5"/>')
    document = heliok.read(path)
    one = heliok.to_plant(document, SITE)[name]
    assert one.aim is not None
    found = track(one, heliok.sun(document), one.aim, local=True, drives=FREE)
    for branch in (0, 1):
        shown = np.degrees(azimuth_elevation(found.normal[branch]))
        np.testing.assert_allclose(shown, [120.0, 45.0], rtol=0, atol=1e-8)
    placed = next(one for one in heliok.heliostats(document) if one.name == name)
    model = placed.model
    assert model.secondary is not None
    his = {
        "turned": placed.orientation,
        "t1": model.primary.origin,
        "t2": model.secondary.origin,
        "r0": model.point,
        "n": model.normal,
        "a": model.primary.direction,
        "b": model.secondary.direction,
    }
    for branch, wanted in enumerate(his_local(his, heliok.sun(document), model.aim)):
        assert np.abs(wrap_signed(found.angles[branch] - wanted)).max() < _LIMIT


def test_a_plant_aims_as_its_heliostats_do() -> None:
    one = machine(np.random.default_rng(3))
    field = built(one)[None]
    aim = one["t1"] + one["t2"] + one["r0"] + one["n"] + (0.1, 0.2, 0.0)
    suns = direction(np.linspace(1.0, 4.0, 5), 0.7)
    many = track(field, suns[:, None], aim, local=True)
    for k, sun in enumerate(suns):
        single = track(built(one), sun, aim, local=True)
        np.testing.assert_array_equal(many.angles[k, 0], single.angles)


def test_the_machine_carries_an_aim_that_is_fixed_to_it() -> None:
    """With a leaning pedestal and an error of the axes the point still lies in the beam."""
    made = kinds.azimuth_elevation((10.0, 40.0, 1.0), pivot_height=1.5, pivot_offset=0.2)
    aim = np.array([0.3, 2.2, 1.6])
    sun = direction(2.5, 0.8)
    leaning = made.with_parameters(
        {"tilt_north": 0.02, "tilt_east": -0.03, "non_orthogonality": 0.02, "position_up": 0.1}
    )
    counts = track(leaning, sun, aim, local=True).best_counts
    # A machine whose mirror stands at the aim moves as the aim does.
    at_aim = replace(made, vertex=aim - (0.0, 0.0, 1.5)).with_parameters(leaning.deviations)
    pose = leaning.pose(counts)
    way = at_aim.pose(counts).vertex - pose.vertex
    assert angle_between(normalize(way), reflect(sun, pose.normal)) < 1e-9


def test_an_aim_behind_the_mirror_is_called_so() -> None:
    made = kinds.azimuth_elevation((0.0, 0.0, 0.0), pivot_height=1.0)
    sun = direction(2.0, 0.6)
    for aim in ((0.0, -2.0, 1.0), (1.0, -0.1, 2.0), (1.0, 0.0, 1.0)):
        found = track(made, sun, aim, local=True)
        assert (found.status == TrackingStatus.BEHIND).all()
        assert np.isnan(found.angles).all()
    assert "behind the mirror" in TrackingStatus.BEHIND.text
    in_vertex = track(made, sun, (0.0, 0.0, 1.0), local=True)
    assert (in_vertex.status == TrackingStatus.DEGENERATE).all()


# -- single axes ------------------------------------------------------------------------------


TROUGH = Path(__file__).parents[2] / "examples" / "trough.xml"


def his_single(one: heliok.PlacedModel, sun: Any, aim: Any, *, local: bool) -> float:
    """(9): the turn of the projected v0 to the projected v; ``aim`` in the heliostat's frame."""
    model = one.model
    a = model.primary.direction
    flat = np.eye(3) - np.outer(a, a)
    s, n = (normalize(flat @ v) for v in (one.orientation.T @ sun, model.normal))
    r = model.primary.origin + model.point
    alpha = 0.0
    if local:
        v0, v = reflect(normalize(flat @ (aim - r)), n), s
        return float(np.arctan2(a @ np.cross(v0, v), v0 @ v))
    for _ in range(60):
        target = normalize(flat @ (aim - r))
        v = normalize(s + target)
        alpha = float(np.arctan2(a @ np.cross(n, v), n @ v))
        r = model.primary.origin + rotation(a, alpha) @ model.point
    return alpha


def test_single_axis_trackers_are_read_and_tracked() -> None:
    document = heliok.read(TROUGH)
    (placed,) = heliok.heliostats(document)
    assert placed.model.secondary is None
    assert placed.model.aim is not None
    one = heliok.to_plant(document, SITE)["L1"]
    assert (one.nominal.kind, len(one.nominal.driven)) == ("single_axis", 1)
    sun = heliok.sun(document)
    local = track(one, sun, placed.model.aim, local=True)
    wanted = his_single(placed, sun, placed.model.aim, local=True)
    assert local.reachable
    assert local.best_angles[0] == pytest.approx(wanted, abs=_LIMIT)
    aim = np.array([2.0, 30.0, 12.0])
    inside = placed.orientation.T @ (aim - placed.position)
    found = track(one, sun, aim, tolerance=1e-13)
    assert found.reachable
    assert found.best_angles[0] == pytest.approx(
        his_single(placed, sun, inside, local=False), abs=_LIMIT
    )
    steps = trace(one, sun, aim)
    assert {step.branch for step in steps} == {0}
    assert steps[-1].miss < 1e-9
    assert steps[-1].angles[0] == pytest.approx(found.best_angles[0], abs=1e-9)


def test_a_single_axis_with_its_aim_behind_it() -> None:
    made = kinds.single_axis((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), pivot_height=1.0)
    found = track(made, direction(2.0, 0.6), (0.4, 3.0, 0.5), local=True)
    assert (found.status == TrackingStatus.BEHIND).all()
    along = track(made, direction(2.0, 0.6), (0.0, 3.0, 1.0), local=True)
    assert (along.status == TrackingStatus.DEGENERATE).all()


def test_a_normal_along_the_only_axis_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "trough.xml"
    text = TROUGH.read_text(encoding="utf-8")
    path.write_text(text.replace('normal="0.1, -0.1, 1"', 'normal="1, 0.2, 0.1"'))
    with pytest.raises(InputError, match="is parallel to the primary axis"):
        heliok.to_plant(heliok.read(path), SITE)
