"""Photographs read: three backgrounds, every reason of quality, and what is kept apart."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from heliotrope.errors import FormatError, InputError
from heliotrope.imaging.memory import Memory
from heliotrope.imaging.photograph import Photograph, PhotographSettings, read_photograph
from heliotrope.imaging.spots.background import EmptyTarget
from heliotrope.imaging.spots.quality import REASONS, Expectation
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
from heliotrope.optics.mirror_image import gaussian_beam

TARGET = example_target(8.0)
CAMERA = example_camera(TARGET, 200.0, (1000, 750))
#: Stains and joints that a background has to tell from light.
PAINT = Paint(stains=4, stain=0.05, panels=(4, 4), seam=0.5, seam_width=0.01, seed=4)
PLACE = (0.9, -0.6)


def beam(
    place: tuple[float, float] = PLACE,
    length: float = 0.7,
    width: float = 0.5,
    strength: float = 200.0,
    motion: tuple[float, float] = (0.0, 0.0),
) -> Thrown:
    return Thrown("target", gaussian_beam(place, length, width, angle=0.4), strength, motion)


def scene(*beams: Thrown, level: float = 0.6, **changes: object) -> Scene:
    known: dict[str, object] = {"paint": PAINT, "lens": LensEffects(defocus=0.8), **changes}
    return exposed(Scene(CAMERA, (TARGET,), beams, **known), level)  # type: ignore[arg-type]


def read(rendered: Rendered, **changes: object) -> Photograph:
    without = changes.pop("without", None)
    settings = PhotographSettings(**changes)  # type: ignore[arg-type]
    frame = None if without is None else without.frame  # type: ignore[attr-defined]
    return read_photograph(rendered.frame, [TARGET], CAMERA, settings=settings, without=frame)


def off(photograph: Photograph, truth: np.ndarray | tuple[float, float] = PLACE) -> float:
    spot = photograph.readings[0].spots[0]
    return float(np.linalg.norm(spot.plane - np.asarray(truth)))


@lru_cache(maxsize=1)
def learnt() -> Memory:
    memory = Memory()
    for k in range(5):
        # Light changes from frame to frame, and one of them shows a beam.
        beams = (beam((-2.0, 2.0)),) if k == 2 else ()
        light = scene(*beams, ambient=100.0 + 40.0 * k, gradient=(0.01 * (k - 2), 0.005))
        memory.learn(read(render(light, k), empty=memory.models).faces)
    return memory


# -- backgrounds -----------------------------------------------------------------------


def test_a_frame_without_the_beam_is_the_best_background() -> None:
    dim = beam(strength=60.0)  # three tenths of the ambient light
    shade = Shadow((0.5, 0.0), 0.7, softness=0.3, left=0.6)
    rendered = render(scene(dim, shadow=shade), 1)
    # Light has changed by a tenth since.
    empty = render(scene(ambient=165.0, gradient=(0.004, 0.0), shadow=shade), 2)
    found = read(rendered, without=empty)
    assert found.readings[0].good, found.readings[0].reasons
    assert found.faces[0].background.method == "difference"
    assert off(found) < 0.02
    alone = read(rendered)
    # The shadow's edge goes through the beam: one frame alone cannot know, or knows it badly.
    assert not alone.readings[0].good or off(alone) > off(found)


def test_a_learnt_target_is_used_once_it_is_known() -> None:
    rendered = render(scene(beam(strength=80.0)), 9)
    first = Memory()
    first.learn(read(rendered).faces)
    assert read(rendered, empty=first.models).faces[0].background.method == "frame"
    memory = learnt()
    found = read(rendered, empty=memory.models)
    assert found.faces[0].background.method == "model"
    assert found.readings[0].good, found.readings[0].reasons
    assert off(found) < 0.02 < 0.05


def test_a_model_knows_the_stains() -> None:
    (model,) = learnt().models.values()
    rendered = render(scene(), 21)
    face = read(rendered, empty=learnt().models).faces[0]
    even = read(rendered).faces[0]
    paint = face.picture.paint
    known, unknown = (
        float(np.std((f.picture.values - f.background.values)[paint])) for f in (face, even)
    )
    assert known < 0.6 * unknown
    assert float(np.median(model.weight)) > 4.0


def test_beams_leave_no_trace_in_a_model() -> None:
    (model,) = learnt().models.values()
    memory = Memory([model])
    for k in range(6):
        memory.learn(read(render(scene(beam((0.5 * k - 1.0, 0.0))), 30 + k)).faces)
    (after,) = memory.models.values()
    surface = read(render(scene(), 40)).faces[0].picture.paint
    assert float(np.abs(after.reflectance - model.reflectance)[surface].mean()) < 0.006


def test_memory_is_kept_and_comes_back(tmp_path: Path) -> None:
    learnt().save(tmp_path / "empty")
    again = Memory.load(tmp_path / "empty")
    (name,) = again.models
    np.testing.assert_array_equal(again.models[name].reflectance, learnt().models[name].reflectance)
    assert again.models[name].targets == ("target",)
    assert len(Memory.load(tmp_path / "nothing")) == 0


def test_memory_that_is_none_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="not a folder; specify a folder"):
        Memory.load(tmp_path / "file")
    (tmp_path / "target.npz").write_bytes(b"PK nothing")
    with pytest.raises(
        FormatError, match="not a readable archive; expected a model of an empty target"
    ):
        Memory.load(tmp_path)
    with pytest.raises(InputError, match="specify a writable folder"):
        learnt().save(tmp_path / "file" / "below")


def test_models_of_other_targets_are_not_used() -> None:
    (model,) = learnt().models.values()
    other = replace(model, targets=("another",))
    rendered = render(scene(beam()), 3)
    assert read(rendered, empty={"a": other}).faces[0].background.method == "frame"
    smaller = EmptyTarget(model.reflectance[1:], model.weight[1:], targets=model.targets)
    assert read(rendered, empty={"a": smaller}).faces[0].background.method == "frame"
    with pytest.raises(InputError, match="has no model; learn one"):
        read(rendered, background="model")
    with pytest.raises(InputError, match="needs a frame without the beam"):
        read(rendered, background="difference")


# -- spots -----------------------------------------------------------------------------


def test_shape_peak_and_power() -> None:
    rendered = render(scene(beam()), 5)
    spot = read(rendered, without=render(scene(), 6)).readings[0].spots[0].spot
    # Less what the tails have below the background's remains.
    assert spot.axes[:2] == pytest.approx((0.7, 0.5), rel=0.06)
    assert spot.axes[2] == pytest.approx(0.4, abs=0.1)
    # 200 W on 150 W/m² of ambient light.
    assert spot.power == pytest.approx(200.0 / 150.0, rel=0.06)
    assert spot.contrast == pytest.approx(200.0 / 150.0 / (2.0 * np.pi * 0.7 * 0.5), rel=0.08)
    assert spot.clipped == rendered.beams[0].share_clipped == 0.0


def test_two_beams_far_apart_are_two_spots() -> None:
    found = read(render(scene(beam((-2.0, 1.5)), beam((2.0, -1.5), strength=120.0)), 6))
    (reading,) = found.readings
    places = np.array([spot.plane for spot in reading.spots])
    assert len(places) == 2
    np.testing.assert_allclose(places, [(-2.0, 1.5), (2.0, -1.5)], atol=0.05)
    nearer = read(
        render(scene(beam((-2.0, 1.5)), beam((2.0, -1.5), strength=120.0)), 6),
        expectations={"target": Expectation(place=np.array([2.2, -1.0]))},
    )
    np.testing.assert_allclose(nearer.readings[0].spots[0].plane, (2.0, -1.5), atol=0.05)


def test_exposure_is_taken_out_of_the_flux() -> None:
    shown = scene(beam())
    fluxes = []
    for factor in (1.0, 0.5):
        sensor = replace(shown.sensor, exposure=shown.sensor.exposure * factor)
        found = read(render(replace(shown, sensor=sensor), 8))
        fluxes.append(found.readings[0].spots[0].flux)
    assert fluxes[1] == pytest.approx(fluxes[0], rel=0.03)


@pytest.mark.parametrize("strength", [60.0, 200.0, 800.0])
def test_covariance_is_honest(strength: float) -> None:
    """Of ten frames the errors over their covariance are chi-squared with two degrees."""
    squares = []
    for k in range(10):
        rng = np.random.default_rng([5, k])
        place = tuple(rng.uniform(-2.0, 2.0, 2).tolist())
        paint = replace(PAINT, seed=k)
        photograph = read(render(scene(beam(place, strength=strength), paint=paint), 50 + k))
        spot = photograph.readings[0].spots[0]
        error = spot.plane - place
        squares.append(float(error @ np.linalg.solve(spot.covariance, error)))
    # The mean of ten such is 2 ± 0.63; too small would say that the ellipses are too large.
    assert 0.3 < np.mean(squares) < 4.5


# -- quality ---------------------------------------------------------------------------

KNOWN = Expectation(power=float("nan"), length=0.7, width=0.5, deviation=0.1)


@lru_cache(maxsize=4)
def _bright(share: float) -> Expectation:
    """What a plant expects that knows the beam's power when the sky is clear."""
    spot = read(render(scene(beam()), 5)).readings[0].spots[0].spot
    return replace(KNOWN, power=spot.power / share)


FAULTS: dict[str, tuple[Callable[[], Scene], Expectation]] = {
    "no spot": (scene, Expectation()),
    "several spots": (lambda: scene(beam((-2.0, 1.5)), beam((2.0, -1.5))), Expectation()),
    "cut at the edge": (lambda: scene(beam((3.9, 0.0))), Expectation()),
    "saturated": (lambda: scene(beam(strength=900.0), level=3.0), Expectation()),
    "uncertain": (lambda: scene(beam(strength=900.0), level=3.0), Expectation()),
    "flare": (
        lambda: scene(
            beam(strength=100.0), level=0.3, lens=LensEffects(defocus=0.8, veil=1.0),
            surroundings=Surroundings(sky=1400.0),
        ),
        Expectation(),
    ),
    "moved": (
        lambda: scene(beam(), lens=LensEffects(defocus=0.8, shake=(16.0, 4.0))),
        Expectation(),
    ),
    "smeared": (lambda: scene(beam(motion=(3.2, 1.0))), KNOWN),
    "lopsided": (lambda: scene(beam(), beam((2.1, -1.2), 0.4, 0.3, 30.0)), Expectation()),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_what_is_wrong_is_named(name: str) -> None:
    make, expected = FAULTS[name]
    (reading,) = read(render(make(), 11), expectations={"target": expected}).readings
    assert not reading.good
    if not reading.found.found:
        pytest.fail(f"the target was not found: {reading.found.reason}")
    assert name in {reason.name for reason in reading.reasons}, reading.reasons
    for reason in reading.reasons:
        assert reason.name in REASONS
        assert np.isfinite(reason.value) or reason.name == "no spot"


def test_out_of_focus_is_no_stray_light() -> None:
    camera = example_camera(TARGET, 200.0, (1600, 1200))
    for defocus, names in ((3.0, set()), (15.0, {"out of focus"})):
        shown = replace(scene(beam()), camera=camera, lens=LensEffects(defocus=defocus))
        photograph = read_photograph(render(shown, 11).frame, [TARGET], camera)
        (reading,) = photograph.readings
        assert {reason.name for reason in reading.reasons} == names


@pytest.mark.parametrize("seed", range(6))
def test_light_that_the_empty_frame_did_not_have_passes_for_nothing_else(seed: int) -> None:
    """A reflection in the lens, and a shadow that came meanwhile: right, or refused."""
    rng = np.random.default_rng([9, seed])
    at = tuple(rng.uniform((350.0, 250.0), (650.0, 500.0)).tolist())
    stray = LensEffects(defocus=0.8, ghost=rng.uniform(0.3, 1.0), ghost_at=at, ghost_radius=60.0)
    shade = Shadow(tuple(rng.uniform(-2.0, 2.0, 2).tolist()), rng.uniform(0.0, 6.0), left=0.5)
    late = scene(beam((-1.5, -1.5)), lens=stray, shadow=shade)
    told = {"target": _bright(1.0)}
    found = read(render(late, 13), without=render(scene(), 14), expectations=told)
    assert not found.readings[0].good or off(found, (-1.5, -1.5)) < 0.05


def test_clouds_and_second_beams_are_told_by_power() -> None:
    rendered = render(scene(beam()), 5)
    for share, name in ((0.3, "cloud"), (2.0, "several spots"), (1.1, None)):
        (reading,) = read(rendered, expectations={"target": _bright(share)}).readings
        assert {reason.name for reason in reading.reasons} == ({name} if name else set())


def test_a_target_that_is_not_there_says_why() -> None:
    hidden = replace(scene(beam()), lens=LensEffects(defocus=45.0))
    (reading,) = read(render(hidden, 12)).readings
    assert [reason.name for reason in reading.reasons] == ["target not found"]
    assert reading.found.reason
    assert not reading.spots


def test_nothing_but_a_good_frame_is_good() -> None:
    (reading,) = read(render(scene(beam()), 13), expectations={"target": KNOWN}).readings
    assert reading.good, reading.reasons
    assert off(read(render(scene(beam()), 13))) < 0.03


def test_an_empty_frame_of_something_else_is_refused() -> None:
    blank = render(replace(scene(), lens=LensEffects(defocus=45.0)), 14)
    with pytest.raises(InputError, match="use an empty frame from the same camera"):
        read(render(scene(beam()), 13), without=blank)


def test_sixteen_bits_and_colour_say_the_same() -> None:
    plain = read(render(scene(beam()), 15))
    fine = read(render(scene(beam(), sensor=Sensor(bits=12, colour=True)), 15))
    assert off(plain) < 0.03
    assert off(fine) < 0.03
