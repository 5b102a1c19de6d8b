"""Teaching a camera its targets: from rough points to marks, pictures and a pose."""

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from heliotrope.errors import FormatError, InputError, UnknownNameError
from heliotrope.field.camera import Camera, look_at, project, rays
from heliotrope.field.example import example_plant
from heliotrope.field.formats.plant_file import read_plant, write_plant
from heliotrope.field.marks import Mark
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.targets.click_page import ask, click_points
from heliotrope.imaging.targets.marks import polygons
from heliotrope.imaging.targets.sights import sights
from heliotrope.imaging.targets.teaching import (
    Taught,
    Wish,
    fit_marks,
    known_points,
    read_pictures,
    see_marks,
    teach,
    write_taught,
)
from support.absence import absent

SIZE = (640, 480)
TURNS = {"upper_left": 0.0, "upper_right": -0.5, "lower_right": 1.0, "lower_left": 0.5}


def corner_marks() -> tuple[Mark, ...]:
    places = {
        "upper_left": (-1, 1),
        "upper_right": (1, 1),
        "lower_right": (1, -1),
        "lower_left": (-1, -1),
    }
    return tuple(
        Mark(
            name, "corner", np.array([1.3 * x, 0.0, 13.0 + 1.3 * y]), 0.4, 0.09, TURNS[name] * np.pi
        )
        for name, (x, y) in places.items()
    )


MARKS = (
    *corner_marks(),
    Mark("middle", "tee", np.array([0.0, 0.0, 14.3]), 0.4, 0.09),
    Mark("dot", "disc", np.array([0.1, 0.0, 11.9]), 0.3),
)
#: Of the same points, nothing but their names and places.
BARE = replace(
    example_plant(),
    targets=(
        replace(example_plant().targets[0], markers={mark.name: mark.point for mark in MARKS}),
    ),
)
CAMERA = Camera(
    "south",
    SIZE,
    np.array([[2600.0, 0.0, 322.0], [0.0, 2600.0, 236.0], [0.0, 0.0, 1.0]]),
    np.array([-0.08, 0.0, 0.0, 0.0, 0.0]),
    np.array([9.0, -22.0, 3.0]),
    look_at((9.0, -22.0, 3.0), (0.0, 0.0, 13.0)),
    ("target",),
    "south/*.png",
)
TRUE = {mark.name: project(CAMERA, mark.point) for mark in MARKS}


def photograph(
    marks: Sequence[Mark] = MARKS,
    camera: Camera = CAMERA,
    seed: int = 0,
    leaves: Sequence[tuple[float, float]] = (),
) -> Frame:
    """The target as the camera sees it, each pixel from three times three rays.

    ``leaves`` are places, metres right of and above the centre, of figures that are no marks.
    """
    fine, half = 250, 2.0
    n = int(2 * half * fine)
    face = np.full((n, n), 90, np.uint8)
    target = example_plant().targets[0]

    def fill(shape: FloatArray, light: int) -> None:
        spots = (np.stack([shape[:, 0] + half, half - shape[:, 1]], axis=-1) * fine - 0.5) * 16
        cv2.fillPoly(face, [np.round(spots).astype(np.int32)], light, lineType=cv2.LINE_AA, shift=4)

    fill(target.plane_coordinates(target.corners), 205)
    for mark in marks:
        for shape in polygons(mark):
            fill(shape + target.plane_coordinates(mark.point), 45)
    for k, place in enumerate(leaves):
        rng = np.random.default_rng(100 + k)
        for _ in range(7):
            spread = rng.normal(0.0, 0.03, (6, 2)) + rng.normal(0.0, 0.05, 2) + place
            fill(spread, int(rng.integers(40, 150)))
    x, y = np.meshgrid(*map(np.arange, SIZE))
    lines = rays(camera, np.stack([x, y], axis=-1))
    plane = target.plane_coordinates(target.intersect(camera.position, lines))
    spots = ((plane * [1.0, -1.0] + half) * fine - 0.5).astype(np.float32)
    maps = cv2.resize(spots, (3 * SIZE[0], 3 * SIZE[1]), interpolation=cv2.INTER_LINEAR)
    light = cv2.remap(face, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderValue=90)
    seen = cv2.GaussianBlur(
        cv2.resize(light, SIZE, interpolation=cv2.INTER_AREA).astype(float), (0, 0), 0.6
    )
    noise = np.random.default_rng(seed).normal(0.0, 1.5, seen.shape)
    return Frame(np.clip(np.round(seen + noise), 0, 255).astype(np.uint8), "south.png")


@pytest.fixture(scope="module")
def frame() -> Frame:
    return photograph()


def clicked(
    names: Sequence[str], off: float = 5.0, seed: int = 1
) -> dict[str, tuple[float, float]]:
    rng = np.random.default_rng(seed)
    return {name: tuple(TRUE[name] + rng.uniform(-off, off, 2)) for name in names}


ALL = [mark.name for mark in MARKS]
DRAWN = {
    **{name: Wish("corner", 0.4, 0.09) for name in TURNS},
    "middle": Wish("tee", 0.4, 0.09),
    "dot": Wish("disc", 0.3),
}


def misses(taught: Taught) -> FloatArray:
    return np.array([np.linalg.norm(p.pixel - TRUE[p.name]) for p in taught.points])


# -- marks of known kinds --------------------------------------------------------------


def test_drawn_marks_are_found_about_rough_points(frame: Frame) -> None:
    taught = teach(BARE, "target", frame, clicked(ALL), wishes=DRAWN)
    assert all(p.refined and not p.note for p in taught.points)
    assert np.sqrt(np.mean(misses(taught) ** 2)) < 0.3
    found = taught.plant.target("target").marks
    assert [mark.name for mark in found] == ALL
    for mark, true in zip(found, MARKS, strict=True):
        assert (mark.kind, mark.size, mark.stroke) == (true.kind, true.size, true.stroke)
        assert mark.point == pytest.approx(true.point)
        # How the drawing is turned was nowhere said: the picture shows it.
        assert np.exp(1j * mark.turn) == pytest.approx(np.exp(1j * true.turn), abs=1e-9)
    assert not taught.pictures


def test_points_go_where_the_truth_is_as_well_as_they_say(frame: Frame) -> None:
    taught = teach(BARE, "target", frame, clicked(ALL), wishes=DRAWN)
    claimed = np.array([np.sqrt(0.5 * np.trace(p.covariance)) for p in taught.points])
    assert 0.05 < claimed.max() < 0.5
    assert (misses(taught) < 3.5 * claimed).all()
    # A disc is as round about its centre as a corner is not: it shows what perspective leaves.
    assert misses(taught)[ALL.index("dot")] < 0.1


def test_the_camera_comes_with_it(frame: Frame) -> None:
    taught = teach(BARE, "target", frame, clicked(ALL), wishes=DRAWN, camera="south")
    camera = taught.plant.camera("south")
    assert camera.targets == ("target",)
    assert camera.size == SIZE
    # The focal length is only as good as a target's perspective tells it.
    relative = abs(np.log(camera.matrix[0, 0] / 2600.0))
    assert relative < 4.0 * taught.fit.sigma("log_focal")
    for target in (BARE.targets[0],):
        for point in target.corners:
            miss = np.linalg.norm(project(camera, point) - project(CAMERA, point))
            assert miss < 1.0


def test_a_camera_that_is_known_keeps_its_lens(frame: Frame) -> None:
    known = replace(CAMERA, position=None, R_enu_camera=None, targets=(), deviation=0.3)
    plant = replace(BARE, cameras=(known,))
    taught = teach(plant, "target", frame, clicked(ALL), wishes=DRAWN, camera="south")
    camera = taught.plant.camera("south")
    assert (camera.matrix == known.matrix).all()
    assert (camera.source, camera.deviation, camera.targets) == ("south/*.png", 0.3, ())
    assert len(taught.plant.cameras) == 1
    assert camera.position is not None
    error = np.abs(camera.position - CAMERA.position)
    sigma = [taught.fit.sigma(name) for name in ("east", "north", "up")]
    assert (error < 4.0 * np.array(sigma)).all()
    anew = teach(plant, "target", frame, clicked(ALL), wishes=DRAWN, camera="south", anew=True)
    assert (anew.plant.camera("south").matrix != known.matrix).any()
    assert anew.plant.camera("south").source == "south/*.png"


def test_a_second_target_joins_the_first(frame: Frame) -> None:
    second = replace(BARE.targets[0], name="second")
    seeing = replace(CAMERA, targets=("second",))
    plant = replace(BARE, targets=(*BARE.targets, second), cameras=(seeing,))
    taught = teach(plant, "target", frame, clicked(ALL), wishes=DRAWN, camera="south")
    assert taught.plant.camera("south").targets == ("second", "target")
    assert taught.plant.target("second") is second


def test_marks_that_the_target_has_need_no_word(frame: Frame) -> None:
    plant = replace(BARE, targets=(replace(BARE.targets[0], marks=MARKS, markers={}),))
    taught = teach(plant, "target", frame, clicked(ALL[1:]))
    assert all(p.refined for p in taught.points)
    assert np.sqrt(np.mean(misses(taught) ** 2)) < 0.3
    # The one that nobody pointed at stays as it is, in its place.
    assert [m.name for m in taught.plant.target("target").marks] == ALL
    assert taught.plant.target("target").marks[0] is MARKS[0]


def test_what_is_not_there_becomes_a_picture(frame: Frame) -> None:
    wishes = {**DRAWN, "dot": Wish("corner", 0.4), "middle": Wish("square", 0.5)}
    taught = teach(BARE, "target", frame, clicked(ALL, 2.0), wishes=wishes)
    points = {p.name: p for p in taught.points}
    for name, kind in (("dot", "corner"), ("middle", "square")):
        point = points[name]
        assert re.match(rf"no {kind} of 0\.[45] m was recognised", point.note)
        assert not point.refined
        assert point.mark is not None
        assert point.mark.kind == "picture"


# -- pictures --------------------------------------------------------------------------

LEAVES = [(-1.2, 1.1), (1.2, 1.2), (1.1, -1.2), (-1.1, -1.1), (0.2, 0.1)]
BLOTS = {f"blot_{k}": np.array([x, 0.0, 13.0 + y]) for k, (x, y) in enumerate(LEAVES)}
PLAIN = replace(BARE, targets=(replace(BARE.targets[0], markers=BLOTS),))


@pytest.fixture(scope="module")
def blotted() -> Frame:
    return photograph((), leaves=LEAVES)


def at(points: dict[str, FloatArray], off: float = 0.0) -> dict[str, tuple[float, float]]:
    rng = np.random.default_rng(3)
    return {n: tuple(project(CAMERA, p) + rng.normal(0.0, 1.0, 2) * off) for n, p in points.items()}


def test_pictures_show_what_is_about_their_point(blotted: Frame) -> None:
    taught = teach(PLAIN, "target", blotted, at(BLOTS), camera="south", prefix="plant-target")
    for point in taught.points:
        mark = point.mark
        assert mark is not None
        assert (mark.kind, mark.turn) == ("picture", 0.0)
        assert mark.size == pytest.approx(0.36)  # 12 % of 3 m
        assert re.fullmatch(rf"plant-target-{mark.name}-[0-9a-f]{{8}}\.png", mark.code)
        picture = taught.pictures[mark.code].astype(float)
        assert picture.shape[0] == picture.shape[1]
        assert picture.shape[0] % 2 == 1
        # Upright in the plane, as seen: the same cut out of the picture by the true camera.
        n = len(picture)
        offset = (np.arange(n) - n // 2) * mark.size / n
        place = example_plant().targets[0].plane_coordinates(mark.point)
        right, up = np.meshgrid(offset, -offset)
        spots = project(CAMERA, PLAIN.targets[0].point(place + np.stack([right, up], axis=-1)))
        maps = spots.astype(np.float32)
        true = cv2.remap(np.asarray(blotted.pixels), maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)
        assert np.corrcoef(picture.ravel(), true.astype(float).ravel())[0, 1] > 0.99


def test_taught_pictures_are_found_in_another_frame(blotted: Frame, tmp_path: Path) -> None:
    taught = teach(PLAIN, "target", blotted, at(BLOTS, 0.3), camera="south", sigma=0.3)
    write_taught(taught, tmp_path / "plant.toml")
    plant = read_plant(tmp_path / "plant.toml")
    # The wind has moved the camera a little, and the light is another.
    moved = replace(CAMERA, R_enu_camera=look_at(CAMERA.position, (0.03, 0.0, 13.02)))
    later = photograph((), moved, seed=9, leaves=LEAVES)
    later = replace(later, pixels=(later.pixels * 0.7 + 10).astype(np.uint8))
    seen = see_marks(plant, tmp_path, [later], plant.camera("south"))
    assert seen.targets == ("target",)
    assert len(seen.points[0]) == len(LEAVES)
    off = seen.pixels[0] - project(moved, seen.points[0])
    assert np.abs(off).max() < 1.5  # the hand's own 0.3 px are in it
    fit = fit_marks(SIZE, seen, plant.camera("south"), "south", anew=False)
    assert np.sqrt(np.mean(fit.residuals**2)) < 0.5


def test_an_edge_or_nothing_is_no_mark(frame: Frame) -> None:
    edge = np.array([-1.5, 0.0, 12.4])  # on the left border
    blank = np.array([0.7, 0.0, 12.6])
    markers = {**BARE.targets[0].markers, "edge": edge, "blank": blank}
    plant = replace(BARE, targets=(replace(BARE.targets[0], markers=markers),))
    given = {**clicked(list(TURNS)), **at({"edge": edge, "blank": blank})}
    wishes = {name: DRAWN[name] for name in TURNS}
    taught = teach(plant, "target", frame, given, wishes=wishes)
    for point in taught.points[4:]:
        assert point.mark is None
        assert "only an edge, or nothing" in point.note
        assert "the point is used only to locate the camera" in point.note
    assert [m.name for m in taught.plant.target("target").marks] == list(TURNS)
    assert taught.fit.residuals.shape == (6, 2)


def test_pictures_that_cannot_be_cut(blotted: Frame) -> None:
    small = teach(PLAIN, "target", blotted, at(BLOTS), wish=Wish("picture", 0.05))
    assert all("below 12 px" in p.note for p in small.points)
    large = teach(PLAIN, "target", blotted, at(BLOTS), wish=Wish("picture", 3.0))
    assert all("leaves the frame" in p.note for p in large.points[:4])
    assert not small.pictures


def test_twelve_bits_in_sixteen_teach_the_same(blotted: Frame) -> None:
    deep = Frame(np.asarray(blotted.pixels, dtype=np.uint16) * 16, "deep.png")
    one = teach(PLAIN, "target", blotted, at(BLOTS))
    two = teach(PLAIN, "target", deep, at(BLOTS))
    pairs = zip(one.pictures.values(), two.pictures.values(), strict=True)
    for a, b in pairs:
        assert b.dtype == np.uint8
        assert np.corrcoef(a.ravel().astype(float), b.ravel().astype(float))[0, 1] > 0.999


# -- files -----------------------------------------------------------------------------


def same(a: Plant, b: Plant) -> None:
    assert a.names == b.names
    assert (a.position == b.position).all()
    assert (a.armature.table == b.armature.table).all()
    assert (a.drives.table == b.drives.table).all()
    assert a.site == b.site
    assert [t.name for t in a.targets] == [t.name for t in b.targets]
    for t, u in zip(a.targets, b.targets, strict=True):
        assert (t.corners == u.corners).all()
        assert {k: v.tolist() for k, v in t.markers.items()} == {
            k: np.asarray(v).tolist() for k, v in u.markers.items()
        }
        assert len(t.marks) == len(u.marks)
        for m, n in zip(t.marks, u.marks, strict=True):
            assert (m.name, m.kind, m.size, m.stroke, m.code) == (
                n.name,
                n.kind,
                n.size,
                n.stroke,
                n.code,
            )
            assert m.turn == pytest.approx(n.turn, abs=1e-15)
            assert (m.point == n.point).all()
    assert len(a.cameras) == len(b.cameras)
    for c, d in zip(a.cameras, b.cameras, strict=True):
        assert (c.name, c.size, c.targets, c.source) == (d.name, d.size, d.targets, d.source)
        assert c.deviation == d.deviation
        for one, two in (
            (c.matrix, d.matrix),
            (c.distortion, d.distortion),
            (c.position, d.position),
            (c.R_enu_camera, d.R_enu_camera),
        ):
            assert np.array_equal(np.asarray(one), np.asarray(two))


@pytest.mark.parametrize("table", ["csv", "parquet"])
def test_what_is_written_is_read_again(
    frame: Frame, blotted: Frame, tmp_path: Path, table: Any
) -> None:
    place = tmp_path / "plant.toml"
    write_plant(BARE, place, table)
    taught = teach(
        read_plant(place),
        "target",
        frame,
        clicked(ALL),
        wishes={name: DRAWN[name] for name in TURNS},
    )
    write_taught(taught, place)
    again = read_plant(place)
    same(taught.plant, again)
    assert sorted(p.suffix for p in tmp_path.iterdir()) == sorted(
        [".toml", f".{table}"] + [".png"] * len(taught.pictures)
    )
    pictures = read_pictures(tmp_path, again.targets)
    assert pictures.keys() == taught.pictures.keys()
    for code, picture in taught.pictures.items():
        assert (pictures[code] == picture).all()


def test_a_plant_written_elsewhere_takes_its_pictures_along(blotted: Frame, tmp_path: Path) -> None:
    taught = teach(PLAIN, "target", blotted, at(BLOTS))
    write_taught(taught, tmp_path / "plant.toml")
    (tmp_path / "new").mkdir()
    again = teach(taught.plant, "target", blotted, dict(list(at(BLOTS).items())[:4]))
    write_taught(again, tmp_path / "new" / "plant.toml", tmp_path)
    plant = read_plant(tmp_path / "new" / "plant.toml")
    assert len(read_pictures(tmp_path / "new", plant.targets)) == 5


def test_another_file_is_not_written_over(frame: Frame, tmp_path: Path) -> None:
    place = tmp_path / "notes.toml"
    place.write_text("not = [toml")
    taught = teach(BARE, "target", frame, clicked(ALL), wishes=DRAWN)
    with pytest.raises(FormatError, match="not a plant file; choose another output file"):
        write_taught(taught, place)
    assert place.read_text() == "not = [toml"


def test_pictures_that_are_missing_or_no_pictures(blotted: Frame, tmp_path: Path) -> None:
    taught = teach(PLAIN, "target", blotted, at(BLOTS))
    write_taught(taught, tmp_path / "plant.toml")
    code = next(iter(taught.pictures))
    file = tmp_path / code
    cv2.imwrite(str(file), np.zeros((40, 30), np.uint8))
    with pytest.raises(FormatError, match="30 × 40 px; a mark's picture is square"):
        read_pictures(tmp_path, taught.plant.targets)
    file.unlink()
    with pytest.raises(FormatError, match=r"the picture of mark blot_0 is missing; copy it"):
        read_pictures(tmp_path, taught.plant.targets)


# -- names, and input that cannot be used ----------------------------------------------


def test_points_have_one_name_each() -> None:
    target = Target(
        "t",
        example_plant().targets[0].corners,
        example_plant().targets[0].center,
        markers={"upper_left": np.array([-1.4, 0.0, 14.4]), "rivet": np.array([0.0, 0.0, 13.5])},
        marks=(Mark("rivet", "disc", np.array([0.0, 0.0, 13.4]), 0.1),),
    )
    points = known_points(target)
    assert list(points) == ["rivet", "upper_left", "upper_right", "lower_right", "lower_left"]
    assert points["rivet"].tolist() == [0.0, 0.0, 13.4]
    assert points["upper_left"].tolist() == [-1.4, 0.0, 14.4]
    # A corner that stands under another name already is not asked for twice.
    named = replace(target, markers={"nw": target.corners[0]}, marks=())
    assert list(known_points(named)) == ["nw", "upper_right", "lower_right", "lower_left"]


def changed(change: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
    given: dict[str, Any] = {name: tuple(TRUE[name]) for name in ALL}
    change(given)
    return given


def exchange(given: dict[str, Any], a: str, b: str) -> None:
    given[a], given[b] = given[b], given[a]


def mirror(given: dict[str, Any]) -> None:
    for name, (x, y) in given.items():
        given[name] = (640.0 - x, y)


FOUR = list(TURNS)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (
            changed(lambda g: g.update(upper_leff=(10.0, 10.0))),
            r"there is no point of target target 'upper_leff'; did you mean upper_left",
        ),
        ({n: tuple(TRUE[n]) for n in FOUR[:3]}, r"3 points given; four or more.*it has up"),
        (
            changed(lambda g: g.update(dot=(640.0, 10.0))),
            r"point dot: 640.0, 10.0 is not in the picture of 640 × 480 px",
        ),
        (changed(lambda g: g.update(dot=(float("nan"), 10.0))), r"point dot: nan, 10.0 is not in"),
        (changed(lambda g: g.update(dot=g["middle"])), r"points middle and dot are in the same"),
        (changed(mirror), r"are mirrored in the picture; check whether left and right are swapped"),
        (
            changed(lambda g: exchange(g, "upper_left", "upper_right")),
            r"are not arranged as on the target; check for swapped names",
        ),
        (changed(lambda g: exchange(g, "dot", "middle")), r"check for swapped names"),
    ],
)
def test_points_that_cannot_be(frame: Frame, given: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=text):
        teach(BARE, "target", frame, given)


def test_four_points_with_two_exchanged(frame: Frame) -> None:
    given = {name: tuple(TRUE[name]) for name in FOUR}
    exchange(given, "upper_left", "lower_left")
    with pytest.raises(InputError, match="as on the target; check for swapped names"):
        teach(BARE, "target", frame, given)


def test_points_on_a_line(frame: Frame) -> None:
    line = {f"p{k}": np.array([0.5 * k - 1.0, 0.0, 13.0 + 0.2 * k]) for k in range(4)}
    plant = replace(BARE, targets=(replace(BARE.targets[0], markers=line),))
    with pytest.raises(InputError, match="p0, p1, p2, p3 lie on one line; use points that span"):
        teach(plant, "target", frame, at(line))


def test_other_refusals(frame: Frame) -> None:
    given = clicked(ALL)
    with pytest.raises(UnknownNameError, match="there is no target 'targte'; did you mean target"):
        teach(BARE, "targte", frame, given)
    with pytest.raises(InputError, match=r"sigma must be above 0, not 0.0 px"):
        teach(BARE, "target", frame, given, sigma=0.0)
    with pytest.raises(UnknownNameError, match="among those given: 'upper_lef'; did you mean"):
        teach(BARE, "target", frame, given, wishes={"upper_lef": Wish("picture")})
    other = replace(BARE, cameras=(replace(CAMERA, size=(1280, 960)),))
    with pytest.raises(
        InputError, match="camera south: its frames have 1280 × 960 px, the picture"
    ):
        teach(other, "target", frame, given, camera="south")
    with pytest.raises(InputError, match="no target of this camera has marks; teach them"):
        see_marks(BARE, ".", [frame], None)
    hidden = replace(BARE, targets=(replace(BARE.targets[0], marks=MARKS),))
    blank = Frame(np.full((480, 640), 128, np.uint8), "blank.png")
    with pytest.raises(InputError, match=r"no target was found: blank.png: target target: \w+"):
        see_marks(hidden, ".", [blank], None)


@pytest.mark.parametrize(
    ("kind", "size", "stroke", "text"),
    [
        ("star", 0.1, None, r"kind 'star' cannot be taught; known: corner, tee, square, disc, pic"),
        ("tag", 0.1, None, "kind 'tag' cannot be taught"),
        ("corner", None, None, r"a corner needs its size in metres \(--size\)"),
        ("disc", 0.0, None, r"size must be above 0, not 0.0 m"),
        (None, float("nan"), None, r"size must be above 0, not nan m"),
        ("corner", 0.4, -0.1, r"stroke must be above 0, not -0.1 m"),
    ],
)
def test_wishes_that_cannot_be(kind: Any, size: Any, stroke: Any, text: str) -> None:
    with pytest.raises(InputError, match=text):
        Wish(kind, size, stroke)


# -- marks that are known --------------------------------------------------------------


def test_marks_in_two_frames_calibrate_the_camera(frame: Frame) -> None:
    plant = replace(BARE, targets=(replace(BARE.targets[0], marks=MARKS),))
    dark = Frame(np.full((480, 640), 128, np.uint8), "night.png")
    seen = see_marks(plant, ".", [frame, dark, photograph(seed=5)], None)
    assert [len(p) for p in seen.points] == [6, 6]
    assert len(seen.reasons) == 1
    assert seen.reasons[0].startswith("night.png: target target: ")
    fit = fit_marks(SIZE, seen, None, "south", anew=False)
    assert abs(np.log(fit.camera.matrix[0, 0] / 2600.0)) < 4.0 * fit.sigma("log_focal")
    placed = fit_marks(SIZE, seen, CAMERA, "south", anew=False)
    assert np.linalg.norm(placed.camera.position - CAMERA.position) < 0.3
    assert len(placed.names) == 6


def test_sights_of_a_camera() -> None:
    target = replace(BARE.targets[0], marks=MARKS)
    far = replace(
        target,
        name="far",
        corners=target.corners + [500.0, 0.0, 0.0],
        center=target.center + [500.0, 0.0, 0.0],
    )
    back = Target("back", target.corners[[1, 0, 3, 2]], target.center)
    seeing = replace(CAMERA, targets=())
    found = sights(seeing, [target, far, back])
    assert [s.target for s in found] == ["target"]
    sight = found[0]
    away = np.array([9.0, -22.0, -10.0])
    assert sight.distance == pytest.approx(np.linalg.norm(away))
    assert sight.obliquity == pytest.approx(np.arccos(22.0 / np.linalg.norm(away)))
    # A pixel covers (distance/focal)² across the line of sight, more along an oblique face.
    square = (sight.distance / 2600.0) ** 2 / np.cos(sight.obliquity)
    assert sight.metres_per_pixel == pytest.approx(np.sqrt(square), rel=2e-3)
    assert (sight.share, sight.marks) == (1.0, 6)
    assert sights(replace(CAMERA, targets=("far",)), [target]) == []
    assert sights(replace(CAMERA, position=None, R_enu_camera=None), [target]) == []
    aside = replace(seeing, R_enu_camera=look_at(CAMERA.position, (2.6, 0.0, 13.0)))
    assert 0.3 < sights(aside, [target])[0].share < 0.9


# -- the page --------------------------------------------------------------------------


@dataclass
class Asked:
    """A page that waits, in a thread."""

    address: str
    thread: threading.Thread
    result: list[Any]

    def answer(self) -> Any:
        self.thread.join(10.0)
        assert not self.thread.is_alive()
        return self.result[0]


@pytest.fixture
def asked(frame: Frame) -> Iterator[Asked]:
    told, result = threading.Event(), []
    address: list[str] = []

    def announce(text: str) -> None:
        address.append(text)
        told.set()

    def run() -> None:
        try:
            given = {"dot": (3.0, 4.0)}
            result.append(click_points(BARE.targets[0], frame, given, "a.png", announce))
        except InputError as error:
            result.append(str(error))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    assert told.wait(10.0)
    made = Asked(address[0], thread, result)
    yield made
    if thread.is_alive():
        httpx.post(made.address + "cancel")
        thread.join(10.0)


def test_the_page_asks_for_what_is_not_given(asked: Asked, frame: Frame) -> None:
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{20,}/", asked.address)
    reply = httpx.get(asked.address)
    assert reply.status_code == 200
    data = json.loads(re.search(r'type="application/json"[^>]*>(.*?)</script>', reply.text)[1])
    assert data["size"] == [640, 480]
    # The target's own corners have names that marks have already.
    assert [p["name"] for p in data["points"]] == ALL[:-1]
    assert data["points"][0]["place"] == pytest.approx([0.2 / 3.0, 0.2 / 3.0])
    assert data["given"] == [{"name": "dot", "at": [3.0, 4.0]}]
    policy = reply.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    nonce = re.search(r"script-src 'nonce-([\w-]+)'", policy)[1]
    assert reply.text.count(f'nonce="{nonce}"') == 3
    assert not re.search(r"https?://", reply.text)
    shown = cv2.imdecode(
        np.frombuffer(httpx.get(asked.address + "picture.png").content, np.uint8),
        cv2.IMREAD_UNCHANGED,
    )
    assert shown.shape == (480, 640)
    assert np.corrcoef(shown.ravel()[::7], np.asarray(frame.pixels).ravel()[::7])[0, 1] > 0.999


def test_an_answer_ends_the_page(asked: Asked) -> None:
    points = {"upper_left": [100.25, 50.5], "middle": [0, -0.5]}
    reply = httpx.post(asked.address + "points", json={"points": points})
    assert (reply.status_code, reply.text) == (200, "thank you\n")
    assert asked.answer() == {"upper_left": (100.25, 50.5), "middle": (0.0, -0.5)}
    with pytest.raises(httpx.ConnectError):
        httpx.get(asked.address)


def test_cancelling_ends_it_too(asked: Asked) -> None:
    assert httpx.post(asked.address + "cancel").status_code == 200
    assert asked.answer() == "a.png: target target: cancelled in the browser; nothing was written"


@pytest.mark.parametrize(
    ("body", "text"),
    [
        (b"{", "the reply is not JSON"),
        (b"[]", 'the reply has no "points"'),
        (b'{"points": []}', 'the reply has no "points"'),
        (b'{"points": {"nose": [1, 2]}}', "point 'nose' was not requested"),
        (b'{"points": {"dot": [1, 2]}}', "point 'dot' was not requested"),
        (b'{"points": {"middle": [1]}}', "point middle: enter two numbers"),
        (b'{"points": {"middle": [1, "2"]}}', "point middle: enter two numbers"),
        (b'{"points": {"middle": [true, 2]}}', "point middle: enter two numbers"),
        (b'{"points": {"middle": [NaN, 2]}}', "point middle: nan, 2.0 is not in the picture"),
        (b'{"points": {"middle": [640, 2]}}', "point middle: 640.0, 2.0 is not in the picture"),
        (b'{"points": {"middle": [1e999, 2]}}', "point middle: inf, 2.0 is not in the picture"),
    ],
)
def test_answers_that_cannot_be_used(asked: Asked, body: bytes, text: str) -> None:
    reply = httpx.post(asked.address + "points", content=body)
    assert reply.status_code == 400
    assert reply.text.startswith(text)
    assert asked.thread.is_alive()


def test_nobody_else_gets_in(asked: Asked) -> None:
    root = asked.address.rsplit("/", 2)[0]
    for method, place in (
        ("GET", "/"),
        ("GET", "/wrong/"),
        ("POST", "/wrong/points"),
        ("GET", ""),
        ("POST", "/wrong/cancel"),
        ("GET", "/é/picture.png"),
    ):
        assert httpx.request(method, root + place).status_code == 404
    # A name that was made to lead here says itself in Host.
    elsewhere = {"Host": "plant.example:80"}
    assert httpx.get(asked.address, headers=elsewhere).status_code == 404
    assert httpx.post(asked.address + "cancel", headers=elsewhere).status_code == 404
    assert httpx.get(asked.address + "other").status_code == 404
    assert httpx.post(asked.address + "other").status_code == 404
    for length in (str(2**30), "-1", "many"):
        port = int(asked.address.split(":")[2].split("/")[0])
        with socket.create_connection(("127.0.0.1", port), timeout=10.0) as line:
            token = asked.address.rsplit("/", 2)[1]
            text = f"POST /{token}/points HTTP/1.0\r\nHost: 127.0.0.1:{port}\r\n"
            line.sendall(f"{text}Content-Length: {length}\r\n\r\n".encode())
            with line.makefile("rb") as stream:
                reply = stream.read().decode()
        assert " 400 " in reply.splitlines()[0]
        assert f"the reply's length '{length}' is not a number up to" in reply
    assert asked.thread.is_alive()


def test_names_cannot_leave_the_pages_data() -> None:
    name = '</script><script>alert("1")</script>'
    page: list[str] = []

    def announce(address: str) -> None:
        page.append(httpx.get(address).text)
        httpx.post(address + "points", json={"points": {name: [1, 1]}})

    small = np.zeros((20, 20), np.uint8)
    assert ask(small, {name: (0.0, 0.0)}, {}, "x", announce) == {name: (1.0, 1.0)}
    assert "alert" in page[0]
    assert "<script>alert" not in page[0]


class Browser:
    """Chromium, spoken to over its pipe: file descriptors 3 and 4, a zero after each message."""

    def __init__(self, path: str, folder: Path) -> None:
        there, self._write = os.pipe()
        self._read, back = os.pipe()
        # The child has its ends as 3 and 4, whatever their numbers are here.
        launch = (
            "import os, sys; a, b = (os.dup(int(n)) for n in sys.argv[1:3]); "
            "a, b = (os.dup2(n, k + 20) for k, n in enumerate((a, b))); "
            "os.dup2(a, 3); os.dup2(b, 4); os.execv(sys.argv[3], sys.argv[3:])"
        )
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-c",
                launch,
                str(there),
                str(back),
                path,
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                "--disable-background-networking",
                "--disable-component-update",
                "--no-first-run",
                f"--user-data-dir={folder}",
                "--window-size=1200,800",
                "--remote-debugging-pipe",
                "about:blank",
            ],
            pass_fds=(there, back),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(there)
        os.close(back)
        self._rest, self._number, self._session = b"", 0, ""
        pages = self.call("Target.getTargets")["targetInfos"]
        page = next(p["targetId"] for p in pages if p["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]

    def call(self, method: str, **parameters: Any) -> Any:
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self._rest:
                piece = os.read(self._read, 1 << 16)
                assert piece, "the browser has gone"
                self._rest += piece
            text, _, self._rest = self._rest.partition(b"\0")
            reply = json.loads(text)
            if reply.get("id") == self._number:
                assert "error" not in reply, reply
                return reply["result"]

    def value(self, expression: str) -> Any:
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def until(self, expression: str) -> None:
        for _ in range(3000):
            if self.value(expression):
                return
            threading.Event().wait(0.02)
        raise AssertionError(expression)

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def click(self, x: float, y: float) -> None:
        self.mouse("mouseMoved", x, y)
        self.mouse("mousePressed", x, y, button="left", clickCount=1)
        self.mouse("mouseReleased", x, y, button="left", clickCount=1)

    def press(self, selector: str) -> None:
        box = f"document.querySelector('{selector}').getBoundingClientRect()"
        middle = self.value(f"(b => [b.x + b.width / 2, b.y + b.height / 2])({box})")
        self.click(*middle)

    def key(self, key: str) -> None:
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key)

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(10.0)
        os.close(self._write)
        os.close(self._read)


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        absent("there is no Chromium to click with")
    made = Browser(path, tmp_path / "browser")
    yield made
    made.close()


def test_clicks_in_a_real_browser(asked: Asked, browser: Browser) -> None:
    browser.call("Page.navigate", url=asked.address)
    browser.until("document.readyState === 'complete' && image.complete && view.scale !== 1")

    def place(name: str) -> tuple[float, float]:
        x, y = TRUE[name]
        scale, ox, oy = browser.value("[view.scale, view.x, view.y]")
        # Chromium hands the page whole pixels of the screen.
        return round((x + 0.5) * scale + ox), round((y + 0.5) * scale + oy)

    asks = "document.getElementById('ask').textContent"
    assert browser.value(asks) == "Click on upper_left1 of 5"
    browser.click(*place("upper_left"))
    browser.press("#skip")  # upper_right
    browser.click(*place("lower_right"))
    browser.click(30.0, 30.0)  # beyond the picture, or wrong
    if browser.value("found.has('lower_left')"):
        browser.press("#undo")
    assert browser.value("document.getElementById('done').disabled")
    # Closer: the wheel keeps what is under it where it is.
    x, y = place("lower_left")
    before = browser.value(f"toPixel({x}, {y})")
    browser.mouse("mouseWheel", x, y, deltaX=0, deltaY=-600)
    browser.until("view.scale > 1.7")
    assert browser.value(f"toPixel({x}, {y})") == pytest.approx(before, abs=1e-6)
    browser.click(*place("lower_left"))
    browser.mouse("mouseWheel", x, y, deltaX=0, deltaY=600)
    browser.until("view.scale < 1.5")
    browser.click(*place("middle"))
    browser.key("ArrowRight")
    nudged = browser.value("found.get('middle')")
    assert browser.value(asks).startswith("That was all")
    browser.press("#done")
    answer = asked.answer()
    browser.until("document.querySelector('aside').textContent.startsWith('Thank you')")
    assert list(answer) == ["upper_left", "lower_right", "lower_left", "middle"]
    assert answer["middle"] == tuple(nudged)
    for name, pixel in answer.items():
        assert np.abs(np.subtract(pixel, TRUE[name])).max() < 1.0
