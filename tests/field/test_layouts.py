"""Generated fields: nothing collides, everything is seen, files and the command."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from heliotrope.cli._field_layout import layout
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field import layouts
from heliotrope.field.camera import project
from heliotrope.field.formats.plant_file import check_plant, read_plant, write_plant
from heliotrope.field.layouts import (
    FREE,
    PACK,
    PATTERNS,
    TWO_SIDED,
    Ground,
    HeliostatSize,
    lay_out,
    malan_plant,
    nearest_gap,
    six_packs,
)
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray, angle_between, direction
from heliotrope.imaging.synthetic.rendering import render
from heliotrope.imaging.synthetic.scenes import Scene
from heliotrope.imaging.targets.finding import find_targets
from heliotrope.mechanism.tracking import track
from heliotrope.sun import Site

NORTH = Site(37.4, -6.0, 100.0)


@pytest.fixture(scope="module")
def whole() -> Plant:
    """Malan's plant in full."""
    return malan_plant()


def test_malans_plant_has_his_size(whole: Plant) -> None:
    group = whole.groups["azel"]
    assert len(whole) == 10_000
    np.testing.assert_allclose(group.width * group.height, 5.0)
    sizes = {c: group.cluster.count(c) for c in dict.fromkeys(group.cluster)}
    assert len(sizes) == 313
    assert max(sizes.values()) == 32
    assert [t.name for t in whole.targets] == ["left", "right"]
    assert [c.targets for c in whole.cameras] == [("left",), ("right",)]
    assert all(len(t.marks) == 8 for t in whole.targets)
    assert len(whole.receivers) == 1


def test_malans_plant_lies_south_and_all_see_receiver_and_targets(whole: Plant) -> None:
    # In the southern hemisphere the sun is in the north.
    place = whole.position
    assert (place[:, 1] < 0.0).all()
    tilts = []
    for surface in (*whole.targets, *whole.receivers):
        back = place - surface.center
        back /= np.linalg.norm(back, axis=1)[:, None]
        tilts.append(angle_between(back, np.broadcast_to(surface.normal, back.shape)))
    left, right, receiver = np.degrees(tilts)
    # Beams are believed up to 70° off a target's normal: each mirror has one that it can light.
    assert np.minimum(left, right).max() < 70.0
    assert receiver.max() < 70.0
    assert (np.maximum(left, right) < 70.0).mean() > 0.9


def test_clusters_are_neighbours(whole: Plant) -> None:
    clusters = np.array(whole.groups["azel"].cluster)
    for name in ("C001", "C100", "C312"):
        mine = whole.position[clusters == name]
        # 32 mirrors on a bus: no cable of hundreds of metres.
        assert np.ptp(mine, axis=0).max() < 110.0


@given(
    kind=st.sampled_from(sorted(PATTERNS)),
    count=st.integers(1, 2500),
    width=st.floats(0.8, 12.0),
    shape=st.floats(0.5, 1.5),
    clearance=st.floats(0.0, 1.0),
    tower=st.floats(20.0, 200.0),
    north=st.booleans(),
)
@settings(max_examples=40)
def test_no_two_mirrors_can_touch(
    kind: str, count: int, width: float, shape: float, clearance: float, tower: float, north: bool
) -> None:
    height = width * shape
    mirror = HeliostatSize(width, height, 0.5 * height + 1.0, clearance=clearance)
    site = NORTH if north else Site(-28.5, 21.2, 830.0)
    plant = lay_out(kind, count, mirror=mirror, tower_height=tower, site=site)
    assert len(plant) == count
    assert len(set(plant.names)) == count
    assert nearest_gap(plant.position, mirror) >= clearance - 1e-9
    away = np.linalg.norm(plant.position[:, :2], axis=1)
    assert away.min() >= 0.75 * tower - 1e-9
    if kind not in TWO_SIDED:
        assert ((plant.position[:, 1] > 0.0) == north).all()
    for camera in plant.cameras:
        assert camera.position is not None
        to = np.linalg.norm((plant.position - camera.position)[:, :2], axis=1)
        assert to.min() >= FREE + 0.5 * mirror.reach


def test_all_around_the_tower_the_ring_closes() -> None:
    mirror = HeliostatSize()
    ground = Ground(half_angle=np.pi)
    for make in (layouts.radial_staggered, six_packs):
        places = make(1500, mirror, ground)
        assert nearest_gap(places.position, mirror) >= mirror.clearance - 1e-9
        azimuth = np.sort(np.arctan2(places.position[:, 0], places.position[:, 1]))
        assert np.degrees(np.diff(azimuth).max()) < 5.0


def test_rings_stagger() -> None:
    mirror, ground = HeliostatSize(), Ground()
    places = layouts.radial_staggered(400, mirror, ground)
    rings = np.array([name.split("-")[0] for name in places.names])
    azimuth = np.degrees(np.arctan2(places.position[:, 0], -places.position[:, 1]))
    first, second, third = (azimuth[rings == f"R{k:03d}"] for k in (1, 2, 3))
    between = second[np.abs(second) < np.abs(first).max()]
    np.testing.assert_allclose(between, 0.5 * (first[:-1] + first[1:]), atol=1e-9)
    np.testing.assert_allclose(third, first, atol=1e-9)


def test_a_pack_is_a_triangle_of_six() -> None:
    mirror = HeliostatSize()
    places = six_packs(600, mirror, Ground())
    packs = places.position.reshape(-1, PACK, 3)
    apart = np.linalg.norm(packs[:, :, None] - packs[:, None, :], axis=-1)
    # Corners, middles of the sides: distances 1, √3 and 2 in units of the least.
    found = np.unique(np.round(apart / mirror.reach, 9))
    np.testing.assert_allclose(found, [0.0, 1.0, np.sqrt(3.0), 2.0], atol=1e-8)
    assert places.names[0] == "P0001A"
    assert places.names[-1] == "P0100F"


@pytest.mark.parametrize("kind", TWO_SIDED)
def test_two_fields_have_a_target_each(kind: str) -> None:
    plant = lay_out(kind, 1001)
    north = plant.position[:, 1] > 0.0
    assert north.sum() == 501
    assert plant.receivers[0].kind == "external_cylinder"
    for half in (north, ~north):
        facing = [((plant.position[half] - t.center) @ t.normal > 0.0).all() for t in plant.targets]
        assert sorted(facing) == [False, True]


@pytest.mark.parametrize("clearance", [0.0, 0.19])
def test_malans_twin_field_covers_his_ground(clearance: float) -> None:
    # 3.2.1: 10,000 heliostats of 5 m², a packing ratio of 0.5, 100,000 m² without tower and roads.
    mirror = HeliostatSize(clearance=clearance)
    place = lay_out("twin-field", 10_000, mirror=mirror).position
    fields = []
    for half in (place[place[:, 1] > 0.0], place[place[:, 1] < 0.0]):
        rows = np.unique(np.round(half[:, 1], 6))
        step = float(np.diff(rows).mean())
        apart = 2.0 * step / np.sqrt(3.0)
        wide, deep = np.ptp(half[:, 0]) + apart, len(rows) * step
        fields.append(wide * deep)
        assert wide == pytest.approx(2.0 * deep, rel=0.05)
    assert fields[0] == pytest.approx(fields[1], rel=1e-9)
    # The places of a camera and of the last, unfilled row are part of the ground.
    assert sum(fields) == pytest.approx(100_000.0, rel=0.02)


def test_a_wide_clearance_thins_the_twin_field() -> None:
    mirror = HeliostatSize(clearance=0.6)
    places = layouts.twin_field(2000, mirror, Ground())
    assert nearest_gap(places.position, mirror) == pytest.approx(0.6)


def test_every_mirror_can_serve_the_day() -> None:
    plant = malan_plant(1200)
    rows = np.arange(0, 1200, 13)
    mechanism = plant.groups["azel"].mechanism[rows]
    for azimuth, elevation in ((60, 12), (30, 40), (0, 85), (-30, 40), (-60, 12), (180, 80)):
        sun = direction(np.radians(azimuth), np.radians(elevation))
        for surface in (*plant.targets, *plant.receivers):
            found = track(mechanism, sun, surface.center)
            assert found.reachable.all()


def test_cameras_see_their_targets_whole(whole: Plant) -> None:
    for camera, target in zip(whole.cameras, whole.targets, strict=True):
        pixels: FloatArray = project(camera, target.corners)
        assert (pixels > 0.0).all()
        assert (pixels < np.array(camera.size)).all()
        height = np.ptp(pixels[:, 1])
        assert 0.6 * camera.size[1] < height < 0.85 * camera.size[1]


def test_the_marks_are_found_in_a_photograph(whole: Plant) -> None:
    target, camera = whole.targets[1], whole.cameras[1]
    half = np.diag([0.5, 0.5, 1.0]) @ camera.matrix
    camera = replace(camera, size=(800, 600), matrix=half)
    picture = render(Scene(camera, (target,)), 1)
    (found,) = find_targets(picture.frame, (target,), camera)
    assert found.found


@pytest.mark.parametrize("table", ["csv", "parquet"])
def test_a_layout_is_written_and_read(table: Any, tmp_path: Path) -> None:
    plant = malan_plant(900)
    write_plant(plant, tmp_path / "plant.toml", table)
    again = read_plant(tmp_path / "plant.toml")
    assert again.names == plant.names
    assert again.groups["azel"].cluster == plant.groups["azel"].cluster
    np.testing.assert_array_equal(again.position, plant.position)
    np.testing.assert_array_equal(again.armature.table, plant.armature.table)
    np.testing.assert_array_equal(again.drives.table, plant.drives.table)
    assert check_plant(tmp_path / "plant.toml") == []
    # The table holds what differs and nothing else: below 80 bytes a heliostat.
    assert (tmp_path / f"plant.{table}").stat().st_size < 80 * 900 + 10_000


# --- refusals -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "count", "more", "text"),
    [
        ("six-packs", 0, {}, "heliostats must be between 1 and 1000000, not 0"),
        ("rows", 10, {"tower_height": 5.0}, "tower height must be between 20 and 500 m, not 5.0 m"),
        ("radial", 10, {"tower_height": float("nan")}, "500 m, not nan m"),
    ],
)
def test_what_cannot_be_laid_out(kind: str, count: int, more: dict[str, float], text: str) -> None:
    with pytest.raises(InputError, match=text):
        lay_out(kind, count, **more)  # type: ignore[arg-type]


def test_an_unknown_pattern_names_the_known() -> None:
    with pytest.raises(UnknownNameError, match="did you mean six-packs"):
        lay_out("sixpacks", 10)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"width": 0.0}, "mirror: width must be above 0"),
        ({"height": float("inf")}, "mirror: height must be above 0"),
        ({"clearance": -0.1}, "mirror: clearance must be 0 or more"),
        ({"pivot_height": 0.9}, "so it would touch the ground when upright"),
    ],
)
def test_mirrors_that_cannot_be(values: dict[str, float], text: str) -> None:
    with pytest.raises(InputError, match=text):
        HeliostatSize(**values)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"nearest": -1.0}, "nearest must be .* not -1.0 m"),
        ({"half_angle": 0.0}, "half angle must be between 3°"),
    ],
)
def test_grounds_that_cannot_be(values: dict[str, float], text: str) -> None:
    with pytest.raises(InputError, match=text):
        Ground(**values)


# --- the command ----------------------------------------------------------------------

APP = typer.Typer()
APP.command()(layout)


def _call(*arguments: str) -> Any:
    return CliRunner().invoke(APP, list(arguments))


def test_the_command_writes_a_plant_and_its_picture(tmp_path: Path) -> None:
    plant, picture = tmp_path / "p.toml", tmp_path / "p.png"
    done = _call(
        "radial",
        "--out",
        str(plant),
        "--heliostats",
        "300",
        "--picture",
        str(picture),
        "--latitude",
        "37.4",
        "--longitude",
        "-6",
        "--name",
        "Sevilla",
    )
    assert done.exit_code == 0, done.output
    assert "300 heliostats of 5 m² in 10 clusters, receiver at 32 m" in done.output
    read = read_plant(plant)
    assert read.name == "Sevilla"
    assert read.site.latitude_deg == 37.4
    assert (read.position[:, 1] > 0.0).all()
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["p.csv", "p.png", "p.toml"]


def test_the_command_tells_json(tmp_path: Path) -> None:
    import json

    done = _call(
        "rows",
        "--out",
        str(tmp_path / "p.toml"),
        "--heliostats",
        "64",
        "--json",
        "--width",
        "3",
        "--height",
        "2",
        "--table",
        "parquet",
    )
    told = json.loads(done.output)
    assert told["heliostats"] == 64
    assert told["clusters"] == 2
    assert told["mirror_area_m2"] == 384.0
    assert told["nearest_gap_m"] >= 0.3 - 1e-9


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("rings",), "there is no layout 'rings'"),
        (("rows", "--table", "xls"), "table 'xls': use csv or parquet"),
        (("rows", "--picture", "p.bmp"), "the file name must end in .png, .svg or .pdf"),
    ],
)
def test_the_command_refuses_and_leaves_nothing(
    arguments: tuple[str, ...], text: str, tmp_path: Path
) -> None:
    done = _call(*arguments, "--out", str(tmp_path / "p.toml"))
    assert isinstance(done.exception, InputError)
    assert text in str(done.exception)
    assert list(tmp_path.iterdir()) == []
