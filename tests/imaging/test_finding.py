"""Targets in raw frames: found where they are, in any light and from any side, or not at all."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from heliotrope.field.camera import Camera, project
from heliotrope.field.formats.paint import read_tower
from heliotrope.field.marks import Mark
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, rotation
from heliotrope.imaging.files import read_image
from heliotrope.imaging.frame import Frame, Image
from heliotrope.imaging.synthetic.rendering import (
    LensEffects,
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
from heliotrope.imaging.targets.finding import (
    FoundTarget,
    find_targets,
    symmetries,
    without_orientation,
)
from heliotrope.imaging.targets.view import FaceView
from heliotrope.optics.mirror_image import gaussian_beam
from support.data import juelich

#: Small frames: the strokes of an L are 4.5 px broad.
SIZE = (480, 360)
TARGET = example_target()
CAMERA = example_camera(TARGET, size=SIZE, fill=0.84)
Turn = Callable[[np.ndarray], np.ndarray]
#: Centres this far off, m, are wrong.
WRONG = 0.05


def scene(target: Target = TARGET, camera: Camera = CAMERA, **changes: object) -> Scene:
    return exposed(Scene(camera, (target,), **changes), 0.7)  # type: ignore[arg-type]


@cache
def plain() -> Rendered:
    return render(scene(), 1)


def only(
    frame: Frame, target: Target = TARGET, camera: Camera | None = None, *previous: FaceView
) -> FoundTarget:
    return find_targets(frame, (target,), camera, previous)[0]


def view_of(found: FoundTarget) -> FaceView:
    assert found.found, found.reason
    assert found.view is not None
    assert found.reason == ""
    return found.view


def misses(found: FoundTarget, rendered: Rendered) -> FloatArray:
    """Pixels between marks that were used and the truth, (K, 2)."""
    truth = {m.name: m.pixel for m in rendered.marks if m.target == found.target.name}
    return np.array([m.pixel - truth[m.mark.name] for m in found.marks if m.used])


def off(found: FoundTarget, camera: Camera, part: float = 1.0) -> float:
    """The greatest error over a part of the target about its centre, m."""
    view, half = view_of(found), 0.5 * part * found.target.width
    grid = np.stack(np.meshgrid(*[np.linspace(-half, half, 7)] * 2), axis=-1).reshape(-1, 2)
    points = found.target.point(grid)
    error = view.to_plane(project(camera, points)) - view.face.plane(points)
    return float(np.linalg.norm(error, axis=-1).max())


def with_marks(kind: str, count: int, size: float, code: str = "4X4_50:{}") -> Target:
    half = 3.4
    places = [
        (-half, half),
        (half, half),
        (half, -half),
        (-half, -half),
        (0, half),
        (half, 0),
        (0, -half),
        (-half, 0),
    ]
    marks = tuple(
        Mark(
            f"m{k}",
            kind,
            TARGET.point(np.array(places[k], dtype=float)),
            size,
            0.2 * size if kind == "corner" else 0.0,
            -0.5 * np.pi * k if kind == "corner" else 0.0,
            code.format(k) if kind == "tag" else "",
        )
        for k in range(count)
    )
    return replace(TARGET, marks=marks)


# -- marks of every kind ---------------------------------------------------------------


@pytest.mark.parametrize(
    "target",
    [
        pytest.param(TARGET, id="corners and tees"),
        pytest.param(with_marks("square", 4, 0.5), id="squares"),
        pytest.param(with_marks("disc", 8, 0.5), id="discs"),
        pytest.param(with_marks("tag", 4, 0.9), id="tags"),
        pytest.param(with_marks("tag", 4, 1.2, "APRILTAG_36h11:{}"), id="AprilTags"),
    ],
)
def test_marks_of_every_kind_are_found(target: Target) -> None:
    """With a bent lens of which nothing is known, at 200 m."""
    rendered = render(scene(target), 2)
    found = only(rendered.frame, target)
    error = misses(found, rendered)
    assert len(error) == len(target.marks)
    assert np.abs(error.mean(axis=0)).max() < 0.05
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert off(found, CAMERA) < (5e-3 if len(target.marks) > 4 else 0.02)
    assert off(found, CAMERA, 0.05) < 5e-3
    assert all(m.reason == "" for m in found.marks)


def test_large_frames_are_mapped_to_millimetres() -> None:
    grey = plain().frame.pixels
    large = Frame(cv2.resize(grey, None, fx=4.0, fy=4.0, interpolation=cv2.INTER_CUBIC))
    small = [m.pixel for m in only(plain().frame).marks]
    found = only(large)
    view_of(found)
    for mark, pixel in zip(found.marks, small, strict=True):
        np.testing.assert_allclose((mark.pixel + 0.5) / 4.0 - 0.5, pixel, rtol=0, atol=0.06)


# -- light -----------------------------------------------------------------------------

LIGHTS: dict[str, dict[str, object]] = {
    "shade over marks": {"shadow": Shadow((-3.5, 3.5), 2.2, left=0.3)},
    "shade along marks": {"shadow": Shadow((0.0, 3.6), 1.5, softness=0.02, left=0.35)},
    "a beam on a mark": {"beams": (Thrown("target", gaussian_beam((-3.3, 3.3), 0.8, power=4e3)),)},
    "a clipped beam": {
        "beams": (Thrown("target", gaussian_beam((-3.3, 3.3), 0.8, power=4e3), 3.0),),
        "sensor": Sensor(exposure=8e-4),
    },
    "flare": {
        "lens": LensEffects(veil=0.35, ghost=0.5, ghost_at=(130.0, 100.0), ghost_radius=40.0)
    },
    "out of focus": {"lens": LensEffects(defocus=2.0)},
    "shaken": {"lens": LensEffects(shake=(5.0, -2.0))},
    "dusk": {"sensor": Sensor(exposure=1e-4, gain=8.0, read_noise=20.0)},
    "dark": {"sensor": Sensor(exposure=1.5e-4)},
    "twelve bits": {"sensor": Sensor(exposure=1e-4, bits=12)},
    "colour": {"sensor": Sensor(exposure=2e-3, colour=True, srgb=True)},
}


@pytest.mark.parametrize("light", list(LIGHTS))
def test_light_and_focus_move_nothing(light: str) -> None:
    lit = Scene(CAMERA, (TARGET,), **LIGHTS[light])  # type: ignore[arg-type]
    rendered = render(lit if "sensor" in LIGHTS[light] else exposed(lit, 0.8), 3)
    found = only(rendered.frame)
    error = misses(found, rendered)
    assert len(error) >= 7
    assert np.sqrt(np.mean(error**2)) < 0.2
    assert off(found, CAMERA, 0.05) < 5e-3
    assert off(found, CAMERA) < 0.012


def test_flare_and_blur_are_measured_at_the_marks() -> None:
    clear = only(plain().frame)
    veiled, soft = (
        only(render(scene(lens=lens), 3).frame)
        for lens in (LensEffects(veil=0.5), LensEffects(defocus=2.5))
    )

    def contrast(found: FoundTarget) -> float:
        return float(np.median([m.contrast for m in found.marks]))

    def blur(found: FoundTarget) -> float:
        return float(np.median([m.blur for m in found.marks]))

    assert contrast(clear) < 0.2 < contrast(veiled) < 0.6
    assert blur(soft) > 1.6 * blur(clear)


# -- covered and beyond ----------------------------------------------------------------


def covered(names: tuple[str, ...], rendered: Rendered | None = None) -> Frame:
    """A frame with something grey hung over some marks."""
    shown = rendered or plain()
    pixels = shown.frame.pixels.copy()
    for mark in shown.marks:
        if mark.name in names:
            x, y = np.round(mark.pixel).astype(int)
            pixels[max(y - 30, 0) : y + 30, max(x - 30, 0) : x + 30] = 140
    return Frame(pixels)


@pytest.mark.parametrize("names", [("top",), ("upper_left", "lower_right"), ("left", "bottom")])
def test_covered_marks_are_named_and_not_used(names: tuple[str, ...]) -> None:
    found = only(covered(names))
    assert off(found, CAMERA, 0.05) < 5e-3
    for mark in found.marks:
        assert mark.used == (mark.mark.name not in names)
        if not mark.used:
            assert "covered or absent" in mark.reason or "size or shape" in mark.reason
            # Where it should be is told nevertheless.
            truth = next(m.pixel for m in plain().marks if m.name == mark.mark.name)
            np.testing.assert_allclose(mark.pixel, truth, rtol=0, atol=0.5)


def test_three_of_four_corners_are_enough_where_they_are_certain() -> None:
    target = with_marks("corner", 4, 0.6)
    rendered = render(scene(target), 2)
    frame = covered(("m2",), rendered)
    whole = view_of(only(rendered.frame, target))
    # An earlier view tells the perspective, a lens how large it may be.
    lens = replace(CAMERA, position=None, R_enu_camera=None)
    for found in (only(frame, target, None, whole), only(frame, target, lens)):
        assert sum(m.used for m in found.marks) == 3
        assert off(found, CAMERA, 0.05) < 0.03


def test_marks_beyond_the_frame_are_missed_in_words() -> None:
    matrix = CAMERA.matrix.copy()
    matrix[0, 2] += 170.0
    camera = replace(CAMERA, matrix=matrix)
    found = only(render(scene(camera=camera), 1).frame)
    beyond = {m.mark.name for m in found.marks if not m.used}
    assert beyond == {"upper_right", "right", "lower_right"}
    assert all("outside the frame" in m.reason for m in found.marks if not m.used)
    assert off(found, camera, 0.05) < 0.02
    matrix[0, 2] += 110.0
    lost = only(render(scene(camera=replace(CAMERA, matrix=matrix)), 1).frame)
    assert not lost.found
    # Three on one line tell no plane.
    assert lost.reason.startswith("its 8 marks were not found in the right arrangement; 3 shapes")


def test_what_was_seen_of_a_covered_target_is_said() -> None:
    names = tuple(m.name for m in TARGET.marks)
    view = view_of(only(plain().frame))
    lost = only(covered(names[:6]), TARGET, None, view)
    assert not lost.found
    assert lost.reason == "only 2 of its 8 marks were seen: bottom, left; 3 are needed"
    assert lost.view is None
    searched = only(covered(names[:6]))
    assert not searched.found
    assert "of its 8 marks were seen" in searched.reason or "right arrangement" in searched.reason
    nothing = only(Frame(np.full((360, 480), 120, dtype=np.uint8)))
    assert nothing.reason == "none of its 8 marks was seen: outside the frame, or covered"


def test_targets_without_enough_marks_are_not_searched() -> None:
    found = only(plain().frame, replace(TARGET, marks=TARGET.marks[:2]))
    assert found.reason == (
        "it has 2 known marks; three or more are needed (heliotrope camera teach)"
    )
    tags = with_marks("tag", 2, 0.9)
    seen = only(render(scene(tags), 2).frame, tags)
    assert seen.reason == "all marks seen lie on one side of it: m0, m1"


# -- geometry --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "pose",
    [
        {"roll": 0.7},
        {"roll": -0.5},
        {"side": 1.047, "below": 0.1},
        {"side": -0.8, "below": 0.6, "roll": 0.4},
    ],
    ids=["rolled 40°", "rolled back 29°", "60° to the side", "below and rolled"],
)
def test_any_side_and_roll(pose: dict[str, float]) -> None:
    camera = example_camera(TARGET, size=SIZE, fill=0.62, **pose)  # type: ignore[arg-type]
    rendered = render(scene(camera=camera), 1)
    found = only(rendered.frame)
    error = misses(found, rendered)
    assert len(error) == 8
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert off(found, camera) < 0.012


def test_upside_down_is_told_by_marks_or_by_the_pose() -> None:
    """A target that is like itself when turned is thought upright; else a mark tells."""
    marks = (replace(TARGET.marks[0], kind="disc", stroke=0.0), *TARGET.marks[1:])
    other = replace(TARGET, marks=marks)
    camera = example_camera(TARGET, size=SIZE, fill=0.7, roll=np.pi - 0.2)
    rendered = render(scene(other, camera), 1)
    assert len(misses(only(rendered.frame, other), rendered)) == 8
    assert off(only(rendered.frame, other), camera) < 5e-3
    rendered = render(scene(TARGET, camera), 1)
    assert off(only(rendered.frame, TARGET, camera), camera) < 5e-3
    upright = view_of(only(rendered.frame))
    assert float(upright.scale(np.zeros(2))[1, 1]) < 0.0


@pytest.mark.parametrize("kind", ["symmetric", "one disc", "tags"])
@pytest.mark.parametrize(
    ("turn", "name"),
    [
        (lambda p: p[::-1, ::-1], "turned by 180°"),
        (lambda p: p[:, ::-1], "mirrored left to right"),
        (lambda p: p[::-1], "mirrored top to bottom"),
        (lambda p: np.rot90(p, -1), "turned by 90° clockwise"),
        (np.rot90, "turned by 90° counterclockwise"),
        (lambda p: p.T, "mirrored about its falling diagonal"),
        (lambda p: p[::-1, ::-1].T, "mirrored about its rising diagonal"),
    ],
)
def test_a_turned_frame_contradicts_the_pose(turn: Turn, name: str, kind: str) -> None:
    aside = np.asarray(CAMERA.R_enu_camera) @ rotation([0.0, 1.0, 0.0], 0.004)
    camera = replace(CAMERA, R_enu_camera=aside)
    marks = (replace(TARGET.marks[0], kind="disc", stroke=0.0), *TARGET.marks[1:])
    odd = {"symmetric": TARGET, "one disc": replace(TARGET, marks=marks)}
    target = odd.get(kind) or with_marks("tag", 4, 0.9)
    frame = render(scene(target, camera), 1).frame
    assert off(only(frame, target, camera), camera) < 5e-3
    found = only(Frame(np.ascontiguousarray(turn(frame.pixels))), target, camera)
    assert not found.found
    # Mirrored tags, and other marks that are unlike each other, are not found in the first place.
    if kind == "symmetric" or "turned" in name:
        assert f"the frame is {name} against the pose of camera" in found.reason


def test_symmetries_of_marks() -> None:
    plane = TARGET.plane_coordinates(np.array([m.point for m in TARGET.marks]))
    assert [share for _, share in symmetries(TARGET.marks, plane)] == [1.0, 1.0, 1.0]
    marks = (replace(TARGET.marks[0], kind="disc", stroke=0.0), *TARGET.marks[1:])
    assert [share for _, share in symmetries(marks, plane)] == [0.75, 0.75, 0.75]
    assert len(symmetries(TARGET.marks, plane * [1.0, 1.4])) == 1
    assert without_orientation([TARGET]) == (TARGET.name,)
    # A turned mark spoils each turn and each reflection, a disc at one corner too.
    other = replace(TARGET.marks[0], turn=TARGET.marks[0].turn + 0.5 * np.pi)
    for first in (other, marks[0]):
        assert without_orientation([replace(TARGET, marks=(first, *TARGET.marks[1:]))]) == ()
    tags = with_marks("tag", 4, 0.5)
    assert symmetries(tags.marks, tags.plane_coordinates([m.point for m in tags.marks])) == []
    assert without_orientation([tags]) == ()


@pytest.mark.parametrize("half", [False, True])
def test_tees_that_are_mirrored_alike(half: bool) -> None:
    """Four tees in two rows: stems down in both look alike mirrored; inwards, also turned."""
    lower = np.pi if half else 0.0
    across, up = TARGET.axes
    marks = tuple(
        Mark(f"m{k}", "tee", TARGET.center + x * across + y * up, 0.6, 0.1, turn)
        for k, (x, y, turn) in enumerate(
            [(-2.0, 2.0, 0.0), (2.0, 2.0, 0.0), (-2.0, -1.0, lower), (2.0, -1.0, lower)]
        )
    )
    target = replace(TARGET, marks=marks)
    plane = target.plane_coordinates(np.array([m.point for m in marks]))
    assert (1.0 in [share for _, share in symmetries(marks, plane)]) is half
    assert without_orientation([target]) == (target.name,)


# -- what is known beforehand ----------------------------------------------------------


def test_a_camera_or_an_earlier_view_need_no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    frame, view = plain().frame, view_of(only(plain().frame))
    shifted = Frame(np.roll(frame.pixels, (9, -7), axis=(0, 1)))
    monkeypatch.setattr("heliotrope.imaging.targets.detection.lighten", None)
    assert off(only(frame, TARGET, CAMERA), CAMERA) < 3e-3
    np.testing.assert_allclose(
        [m.pixel for m in only(shifted, TARGET, None, view).marks],
        [m.pixel + [-7, 9] for m in only(frame, TARGET, CAMERA).marks],
        rtol=0,
        atol=0.05,
    )


def test_a_camera_that_moved_is_found_again() -> None:
    turned = np.asarray(CAMERA.R_enu_camera) @ rotation([0.0, 1.0, 0.0], -0.02)
    moved = replace(CAMERA, R_enu_camera=turned)
    old = view_of(only(render(scene(camera=moved), 1).frame))
    assert np.linalg.norm(old.to_pixels(np.zeros(2)) - project(CAMERA, TARGET.center)) > 50.0
    assert off(only(plain().frame, TARGET, moved), CAMERA) < 3e-3
    assert off(only(plain().frame, TARGET, None, old), CAMERA, 0.05) < 5e-3


def test_cameras_and_views_of_other_frames_are_not_believed() -> None:
    wrong = replace(CAMERA, size=(1600, 1200), distortion=np.array([0.5, 0.0, 0.0, 0.0, 0.0]))
    found = view_of(only(plain().frame, TARGET, wrong))
    assert abs(found.lens.distortion[0]) < 0.1
    other = view_of(only(plain().frame))
    half = Frame(cv2.resize(plain().frame.pixels, None, fx=1.25, fy=1.25))
    assert view_of(only(half, TARGET, None, other)).lens.size == half.size


# -- not what it seems -----------------------------------------------------------------


def clutter(seed: int) -> Image:
    """Noise, clouds, boxes, girders, or Ls, Ts, squares and discs wherever they fall."""
    rng = np.random.default_rng(seed)
    height, width = 300, 400
    blobs = cv2.GaussianBlur(rng.standard_normal((height, width)), (0, 0), rng.uniform(4.0, 30.0))
    image = 130.0 + blobs / blobs.std() * rng.uniform(2.0, 20.0)
    kind = seed % 5
    if kind == 1:
        image = rng.normal(60.0, 30.0, (height, width))
    for _ in range(60 if kind in (2, 3) else 0):
        sides = np.exp(rng.uniform(np.log(4.0), np.log(60.0), 2))
        turn = float(np.degrees(rng.normal(0.0, 0.1)))
        box = cv2.boxPoints((rng.uniform(0, [width, height]).tolist(), sides.tolist(), turn))
        cv2.fillPoly(image, [np.round(box).astype(np.int32)], float(rng.uniform(5, 250)))
    for k in range(10 if kind == 3 else 0):
        cv2.line(image, (40 * k, 0), (40 * k + 9, height), 40.0, 3)
        cv2.line(image, (0, 31 * k), (width, 31 * k), 50.0, 4)
    for _ in range(40 if kind == 4 else 0):
        mark = Mark(
            "x",
            str(rng.choice(["corner", "tee", "square", "disc"])),
            np.zeros(3),
            float(rng.uniform(14, 34)),
            4.0,
            float(rng.choice(4) * 0.5 * np.pi + rng.normal(0, 0.1)),
        )
        shapes = _shapes(mark, rng.uniform(20.0, [width - 20.0, height - 20.0]))
        cv2.fillPoly(image, shapes, float(rng.uniform(5, 70)))
    image = cv2.GaussianBlur(image, (0, 0), 0.8) + rng.normal(0.0, 3.0, image.shape)
    return np.asarray(np.clip(image, 0.0, 255.0), dtype=np.uint8)


def _shapes(mark: Mark, place: FloatArray) -> list[Image]:
    from heliotrope.imaging.targets.marks import polygons

    return [np.round(place + shape * [1, -1]).astype(np.int32) for shape in polygons(mark)]


def test_clutter_is_no_target() -> None:
    kinds = (
        TARGET, with_marks("square", 4, 0.5), with_marks("corner", 4, 0.6),
        with_marks("disc", 5, 0.5), with_marks("tag", 4, 0.8),
    )  # fmt: skip
    for seed in range(16):
        found = only(Frame(clutter(seed)), kinds[(seed // 5) % len(kinds)])
        assert not found.found, f"seed {seed}: {found.marks}"
        assert len(found.reason) > 20


@pytest.mark.parametrize(("shape", "size"), [((1.0, 1.0), 0.45), ((1.0, 0.8), 0.6)])
def test_other_targets_are_not_taken_for_it(shape: tuple[float, float], size: float) -> None:
    """Corners alone fit any four corners: their own size and shape must fit as well."""
    wanted = with_marks("corner", 4, 0.6)
    marks = tuple(
        replace(
            m,
            point=TARGET.point(TARGET.plane_coordinates(m.point) * shape),
            size=size,
            stroke=0.2 * size,
        )
        for m in wanted.marks
    )
    other = replace(wanted, marks=marks)
    frame = render(scene(other), 1).frame
    assert only(frame, other).found
    lost = only(frame, wanted)
    assert not lost.found
    assert lost.reason


def test_like_targets_are_told_by_the_camera_alone() -> None:
    other = example_target(center=(-60.0, 0.0, 40.0), name="other")
    frame = plain().frame
    unsure = find_targets(frame, (TARGET, other))
    assert [f.reason for f in unsure] == [
        f"the frame may show {name} there; specify which targets the camera sees"
        for name in ("other", "target")
    ]
    first, second = find_targets(frame, (TARGET, other), CAMERA)
    assert off(first, CAMERA) < 3e-3
    assert not second.found


def test_neighbours_are_told_apart_or_neither_is_believed() -> None:
    other = example_target(center=(-8.6, 0.0, 40.0), name="other")
    near = find_targets(plain().frame, (TARGET, other))
    # The frame shows enough of where the neighbour's marks would be, if it were it.
    for found in near:
        if found.found:
            assert off(found, CAMERA, 0.05) < WRONG
        else:
            assert "outside the frame" in found.reason or "may be" in found.reason


def test_views_are_as_certain_as_they_say() -> None:
    """Marks are a few millimetres off their survey; the light changes; no view is wrong."""
    rng, errors, count = np.random.default_rng(12), [], 0
    for seed in range(7):
        lit = scene(
            shadow=Shadow((*rng.uniform(-4, 4, 2),), rng.uniform(0, 6.3), left=0.4),
            beams=(Thrown("target", gaussian_beam(rng.uniform(-4, 4, 2), 0.8, power=3e3)),)
            if seed % 2
            else (),
            lens=LensEffects(veil=rng.uniform(0.0, 0.3)),
        )
        frame = render(lit, seed).frame
        for _ in range(2):
            marks = tuple(
                replace(m, point=m.point + rng.normal(0.0, 0.005, 2) @ TARGET.axes)
                for m in TARGET.marks
            )
            found = only(frame, replace(TARGET, marks=marks))
            if not found.found:
                continue
            count += 1
            view, plane = view_of(found), found.target.plane_coordinates(TARGET.center)
            miss = view.to_plane(project(CAMERA, TARGET.center)) - plane
            assert np.linalg.norm(miss) < WRONG
            errors.append(miss @ np.linalg.solve(view.covariance_at(plane), miss))
    assert count >= 12
    # Two for two coordinates.
    assert 0.8 < np.mean(errors) < 3.5


def test_clutter_around_a_target_does_no_harm() -> None:
    busy = Surroundings(clutter=60, seed=3, reflectance=0.5, texture=0.2)
    rendered = render(scene(surroundings=busy), 1)
    assert len(misses(only(rendered.frame), rendered)) == 8


# -- taught pictures -------------------------------------------------------------------


def taught(camera: Camera, frame: Frame) -> tuple[Target, dict[str, FloatArray]]:
    """Four pictures of what is seen at places of the target, upright in its plane."""
    size, count = 1.2, 61
    offset = (np.arange(count) - count // 2) * (size / count)
    right, up = np.meshgrid(offset, -offset)
    marks, pictures = [], {}
    for k, place in enumerate(((-3.4, 3.4), (3.4, 3.4), (3.4, -3.4), (-3.4, -3.4), (0.0, 3.4))):
        grid = TARGET.point(np.array(place) + np.stack([right, up], axis=-1))
        maps = project(camera, grid).astype(np.float32)
        picture = cv2.remap(frame.pixels, maps[..., 0], maps[..., 1], cv2.INTER_CUBIC)
        pictures[f"{k}.png"] = picture.astype(np.float64)
        point = TARGET.point(np.array(place))
        marks.append(Mark(f"p{k}", "picture", point, size, code=f"{k}.png"))
    return replace(TARGET, marks=tuple(marks)), pictures


def test_taught_pictures_are_found_about_a_pose_or_anywhere() -> None:
    target, pictures = taught(CAMERA, plain().frame)
    other = render(scene(shadow=Shadow((1.0, 0.0), 0.3, left=0.5)), 9).frame
    known = find_targets(other, (target,), CAMERA, (), pictures)[0]
    assert sum(m.used for m in known.marks) == 5
    assert off(known, CAMERA) < 0.01
    searched = find_targets(other, (target,), None, (), pictures)[0]
    assert off(searched, CAMERA, 0.05) < 0.01
    lost = find_targets(Frame(clutter(2)), (target,), None, (), pictures)[0]
    assert not lost.found
    without = find_targets(other, (target,), CAMERA)[0]
    assert not without.found
    assert without.marks[0].reason == "its picture 0.png is missing"


# -- photographs -----------------------------------------------------------------------


def _photographs() -> list[tuple[Path, str]]:
    folder = juelich() / "images" / "target-camera"
    shown = []
    for path in sorted(folder.glob("*.png")):
        properties = path.with_name(path.name.replace("-raw.png", "-calibration-properties.json"))
        if properties != path and properties.is_file():
            name = json.loads(properties.read_text(encoding="utf-8"))["target_name"]
        else:
            name = {"stj": "solar_tower_juelich_upper", "mft": "multi_focus_tower"}[path.name[:3]]
        shown.append((path, str(name)))
    assert len(shown) >= 6
    return shown


def test_real_targets_are_found_in_photographs() -> None:
    """Beams and shade over the marks; nothing known of the camera."""
    # One that is not there, with marks like theirs, as the half of their face might be.
    other = example_target(center=(60.0, 0.0, 40.0), name="other")
    targets = (*read_tower(juelich() / "tower-measurements.json").targets, other)
    views: dict[str, FaceView] = {}
    for path, name in _photographs():
        frame = read_image(path)
        results = {f.target.name: f for f in find_targets(frame, targets)}
        tower = name == "multi_focus_tower"
        for target in targets:
            found = results[target.name]
            if target is other or (target.name == "multi_focus_tower") != tower:
                assert not found.found
                assert "marks" in found.reason
                continue
            view = view_of(found)
            assert all(m.used for m in found.marks), f"{path.name}: {found.marks}"
            # The survey's half centimetre is about a pixel here.
            per_metre = np.sqrt(abs(np.linalg.det(view.scale(np.zeros(2)))))
            assert view.residual < 0.01 * per_metre
            center = view.face.plane(target.center)
            assert np.sqrt(np.trace(view.covariance_at(center))) < 0.02
            views[name] = view
        again = {f.target.name: f for f in find_targets(frame, targets, None, [views[name]])}
        for mark, before in zip(again[name].marks, results[name].marks, strict=True):
            # Three millimetres; the marks' own sizes are known to a centimetre.
            apart = np.linalg.norm(mark.pixel - before.pixel)
            assert apart < 3e-3 * abs(np.linalg.det(views[name].scale(np.zeros(2)))) ** 0.5
