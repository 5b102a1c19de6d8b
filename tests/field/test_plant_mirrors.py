"""The surfaces of mirrors, receivers of any shape and towers in a plant file."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import heliotrope as ht
from heliotrope.errors import FormatError, HeliotropeError
from heliotrope.field.formats import plant_edit, plant_file
from heliotrope.field.formats.meshes import read_mesh, write_mesh
from heliotrope.field.formats.slopes import write_slopes
from heliotrope.field.mesh import cavity_wall
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver
from heliotrope.geometry import MRAD, bisector, direction, normalize, reflect
from heliotrope.optics import Cavity, Mesh, Mirrors, scene_of, surface_of
from heliotrope.optics.plant_scene import shaped

TEXT = """format = "heliotrope-plant"
version = 1
heliostats = "p.csv"
[plant]
name = "p"
[site]
latitude_deg = 37
longitude_deg = -2
[[receivers]]
name = "receiver"
center_m = [0, 0, 30]
normal = [0, 1, 0]
width_m = 4
height_m = 4
[groups.a]
kind = "azimuth_elevation"
mirror_width_m = 4
mirror_height_m = 3
"""
TABLE = "name,group,east_m,north_m,up_m{}\nA1,a,0,60,0{}\nA2,a,12,80,0{}\n"
NOON = direction(np.pi, np.radians(50.0))


def written(
    folder: Path, more: str = "", columns: tuple[str, str, str] = ("", "", ""), *, text: str = TEXT
) -> Path:
    path = folder / "p.toml"
    path.write_text(text + more)
    (folder / "p.csv").write_text(TABLE.format(*columns))
    return path


def read(folder: Path, more: str = "", columns: tuple[str, str, str] = ("", "", "")) -> Plant:
    return plant_file.read_plant(written(folder, more, columns))


def again(plant: Plant, folder: Path) -> Plant:
    plant_file.write_plant(plant, folder / "again.toml")
    return plant_file.read_plant(folder / "again.toml")


def test_a_mirror_of_one_facet_is_one_line(tmp_path: Path) -> None:
    line = "mirror = {focal_m = 75, slope_error_mrad = 1.5, reflectivity = 0.93}\n"
    plant = read(tmp_path, line)
    mirrors = scene_of(plant, NOON).mirrors
    assert mirrors.facets is None
    np.testing.assert_array_equal(mirrors.focal, 75.0)
    np.testing.assert_allclose(mirrors.slope, 1.5 * MRAD, rtol=1e-12)
    np.testing.assert_array_equal(mirrors.reflectivity, 0.93)
    # An option comes before the file, and the file before what is usual.
    asked = scene_of(plant, NOON, focus="slant", slope=2 * MRAD, reflectivity=0.8).mirrors
    np.testing.assert_allclose(asked.focal, asked.slant)
    np.testing.assert_array_equal(asked.slope, 2 * MRAD)
    np.testing.assert_array_equal(asked.reflectivity, 0.8)
    usual = scene_of(read(tmp_path), NOON).mirrors
    np.testing.assert_allclose(usual.focal, usual.slant)
    np.testing.assert_array_equal(usual.slope, 1 * MRAD)
    np.testing.assert_array_equal(usual.reflectivity, 0.9)


def test_numbers_of_each_heliostat(tmp_path: Path) -> None:
    more = "[groups.a.mirror]\nfacets = [2, 2]\ngap_m = 0.1\ncanting_focal_m = 70\n"
    plant = read(
        tmp_path, more, (",mirror.canting_focal_m,mirror.slope_error_mrad", ",60,1", ",1e9,2")
    )
    facets = plant.groups["a"].facets
    assert facets is not None
    np.testing.assert_allclose(facets.half_size[0], [[0.975, 0.725]] * 4)
    np.testing.assert_allclose(facets.center[0, :, 0], [-1.025, 1.025] * 2)
    np.testing.assert_allclose(facets.tilt[0], -facets.center[0, :, :2] / 120.0, atol=1e-15)
    np.testing.assert_allclose(facets.tilt[1], 0.0, atol=1e-8)
    np.testing.assert_allclose(scene_of(plant, NOON).mirrors.slope, [1 * MRAD, 2 * MRAD])


@pytest.mark.parametrize(
    ("keys", "sun"),
    [
        ('canting = "none"', None),
        ('canting = "slant"', None),
        ("canting_focal_m = 55", None),
        ("canting_sun = [0, -0.6, 0.8]", np.array([0.0, -0.6, 0.8])),
        ('canting_time = "2026-03-20T12:00Z"', None),
    ],
)
def test_every_canting_reads_back(keys: str, sun: np.ndarray | None, tmp_path: Path) -> None:
    plant = read(tmp_path, f"[groups.a.mirror]\nfacets = [3, 2]\n{keys}\n")
    other = again(plant, tmp_path)
    one, two = plant.groups["a"].facets, other.groups["a"].facets
    assert one is not None
    assert two is not None
    assert two.grid is not None
    np.testing.assert_allclose(two.tilt, one.tilt, rtol=0, atol=1e-12)
    if sun is None:
        return
    # At the sun of the canting each facet sends the middle of the sun to the aim.
    mirrors = scene_of(plant, sun).mirrors
    assert mirrors.facets is not None
    center, tilt = mirrors.facets.center[0], mirrors.facets.tilt[0]
    axes = np.stack([mirrors.right[0], mirrors.up[0], mirrors.normal[0]])
    place = mirrors.center[0] + center @ axes[:2]
    normal = normalize(np.column_stack([tilt, np.ones(len(tilt))]) @ axes)
    ray = reflect(np.broadcast_to(sun, normal.shape), normal)
    np.testing.assert_allclose(ray, normalize(mirrors.aim[0] - place), rtol=0, atol=1e-6)
    whole = bisector(sun, normalize(mirrors.aim[0] - mirrors.center[0]))
    assert np.abs(normal - whole).max() > 5 * MRAD


def test_single_facets_with_numbers_of_their_own(tmp_path: Path) -> None:
    more = """[groups.a.mirror]
slope_error_mrad = 1
[[groups.a.mirror.facet]]
center_m = [-1, 0]
size_m = [1.9, 3]
tilt_mrad = [7, 0]
focal_m = 80
[[groups.a.mirror.facet]]
center_m = [1, 0]
size_m = [1.9, 3]
tilt_mrad = [-7, 1]
focal_m = 90
slope_error_mrad = 2
"""
    plant = read(tmp_path, more, (",mirror.facet.1.tilt_mrad.0", ",-7", ",-6"))
    for one in (plant, again(plant, tmp_path)):
        mirrors = scene_of(one, NOON).mirrors
        assert mirrors.facets is not None
        assert mirrors.facets.slope is not None
        table = mirrors.facets
        np.testing.assert_allclose(
            table.tilt[1], [[7 * MRAD, 0], [-6 * MRAD, MRAD]], rtol=0, atol=1e-12
        )
        np.testing.assert_allclose(table.focal, [[80.0, 90.0]] * 2)
        np.testing.assert_allclose(mirrors.slope, MRAD)
        np.testing.assert_allclose(table.slope[0], [0.0, np.sqrt(3.0) * MRAD], atol=1e-12)
    # What is asked for is the same of all facets.
    asked = scene_of(plant, NOON, slope=2 * MRAD, focus=np.inf).mirrors
    assert asked.facets is not None
    assert asked.facets.slope is not None
    assert not asked.facets.slope.any()
    assert np.isinf(asked.facets.focal).all()


def _maps(folder: Path, shape: tuple[int, ...] = (1, 24, 32, 2)) -> np.ndarray:
    (folder / "maps").mkdir(exist_ok=True)
    rough = np.random.default_rng(3).normal(0.0, 1.0, shape)
    slope = gaussian_filter(rough, (0.0, 2.0, 2.0, 0.0))
    slope *= 0.4 * MRAD / slope.std()
    slope += [0.8 * MRAD, -0.3 * MRAD]
    write_slopes(folder / "maps" / "A1.npz", slope)
    return slope


def test_a_slope_map_becomes_small_facets(tmp_path: Path) -> None:
    slope = _maps(tmp_path)
    plant = read(tmp_path, 'mirror = {focal_m = 70, slope_maps = "maps"}\n')
    for one in (plant, again(plant, tmp_path)):
        mirrors = scene_of(one, NOON).mirrors
        facets = mirrors.facets
        assert facets is not None
        assert facets.slope is not None
        area = 4.0 * facets.half.prod(axis=-1)
        np.testing.assert_allclose(area.sum(axis=1), 12.0)
        assert (facets.half[1, 1:] == 0.0).all()
        # The mean lean is that of the map: a positive slope leans the normal back.
        lean = (area[0, :, None] * facets.tilt[0]).sum(axis=0) / 12.0
        np.testing.assert_allclose(lean, -slope.mean(axis=(0, 1, 2)), rtol=0, atol=1e-9)
        # Tilt, curvature and slope error of the parts together have all of its variance.
        bend = 0.5 / facets.focal[0] - 0.5 / 70.0
        inside = bend**2 * (facets.half[0] ** 2).sum(axis=-1) / 6.0
        beside = facets.tilt[0] + facets.center[0] / 140.0 - lean
        total = 0.5 * (beside**2).sum(axis=-1) + inside + facets.slope[0] ** 2
        found = (area[0] * total).sum() / 12.0
        assert found == pytest.approx(slope.var(axis=(0, 1, 2)).mean(), rel=0.05)
        # What the map does not hold is nothing; the other mirror has the usual error.
        np.testing.assert_allclose(mirrors.slope, [0.0, MRAD])
    # A tilt of 0.8 mrad moves the beam by twice that.
    flat = read(tmp_path, "mirror = {focal_m = 70, slope_error_mrad = 0.4}\n")
    views = [ht.flux(p, sun=NOON, error=0.0, cells=(80, 80)).maps[0] for p in (plant, flat)]
    right = [view.flux.sum(axis=0) @ view.right / view.flux.sum() for view in views]
    assert right[0] - right[1] == pytest.approx(2 * 0.8 * MRAD * 68.0 / 2.0, rel=0.25)


ONE = "[[groups.a.mirror.facet]]\ncenter_m = [1, 0]\nsize_m = [2, 3]"
BAD_MIRRORS = [
    ("facets = [0, 2]", "", "mirror.facets"),
    ("facets = [2, 2]\ngap_m = 5", "", "gaps of 5 m between 2 × 2 facets leave no room"),
    ("facets = [2, 2]\ncanting_focal_m = 0", "", "canting_focal_m"),
    ('facets = [2, 2]\ncanting = "off_axis"', "", "canting off_axis needs a time or sun vector"),
    ('facets = [2, 2]\ncanting = "focal"', "", "canting focal needs a focal length"),
    ('facets = [2, 2]\ncanting_time = "2026-03-20"', "", "2026-03-20"),
    ('facets = [2, 2]\ncanting_time = "2026-03-20T23:00Z"', "", "the sun is below the horizon"),
    (
        'facets = [2, 2]\ncanting_time = "2026-03-20T12:00Z"\ncanting_sun = [0, 0, 1]',
        "",
        "keep one",
    ),
    ('canting = "slant"', "", "canting and gap_m apply only to equal facets; add facets"),
    ("slope_error_mrad = -1", "", "slope_error_mrad"),
    ("slope_error_mrad = 1", "mirror.slope_error_mrad", "heliostat A2: slope error must"),
    ("focal_m = 0", "", "focal_m"),
    ("focal_m = 1", "mirror.focal", "column mirror.focal is not a mirror property"),
    ("reflectivity = 1.1", "", "reflectivity"),
    (
        "slope_error_mrad = 1\nslope_error_rad = 1",
        "",
        "slope_error_mrad and slope_error_rad are both set; keep",
    ),
    ('slope_maps = "none"', "", "none: no such folder"),
    ("facet_focal_m = [1, 2]", "", "focal length of shape (2, 2) for 2 mirrors of 1 facets"),
    (
        "[[groups.a.mirror.facet]]\ncenter_m = [1.5, 0]\nsize_m = [2, 3]",
        "",
        "heliostat A1: facet 0 reaches 2.500 m to a side and 1.500 m up or down from the middle,",
    ),
    (
        f"facets = [2, 2]\n{ONE}",
        "",
        "facets are specified as mirror.facets and mirror.facet; keep one",
    ),
    (
        f"{ONE}\nfocal_m = 50\n{ONE}",
        "",
        "focal_m is missing, but other facets have it",
    ),
]


@pytest.mark.parametrize(("keys", "column", "text"), BAD_MIRRORS)
def test_a_mirror_that_cannot_be_is_one_line(
    keys: str, column: str, text: str, tmp_path: Path
) -> None:
    columns = (f",{column}", ",1", ",500") if column else ("", "", "")
    path = written(tmp_path, f"[groups.a.mirror]\n{keys}\n", columns)
    with pytest.raises(HeliotropeError) as caught:
        plant_file.read_plant(path)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)
    # The check of the file says the same.
    assert any(text in finding.text for finding in plant_file.check_plant(path))


def test_a_slope_map_that_does_not_fit_is_one_line(tmp_path: Path) -> None:
    _maps(tmp_path, (3, 4, 4, 2))
    more = '[groups.a.mirror]\nfacets = [2, 2]\nslope_maps = "maps"\n'
    with pytest.raises(FormatError, match=r"A1\.npz: the map has 3 facets, but the mirror has 4"):
        read(tmp_path, more)
    (tmp_path / "maps" / "A1.npz").unlink()
    with pytest.raises(FormatError, match="no slope map for any heliostat of the group"):
        read(tmp_path, more)


def test_columns_of_mirrors_need_the_table(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"columns mirror\.… need this table; add it"):
        read(tmp_path, "", (",mirror.focal_m", ",70", ",80"))


CAVITY = 'kind = "cavity"\nradius_m = 3\nopening_angle_rad = 2.5\ninner_height_m = 4.5\n'


def _received(keys: str) -> str:
    return TEXT.replace('name = "receiver"\n', f'name = "receiver"\n{keys}')


def test_a_cavity_has_a_wall_behind_its_aperture(tmp_path: Path) -> None:
    path = written(tmp_path, text=_received(CAVITY))
    plant = plant_file.read_plant(path)
    for one in (plant, again(plant, tmp_path)):
        surface = surface_of(one.receiver("receiver"))
        assert isinstance(surface, Cavity)
        cells = surface.cells
        # The aperture looks north, the wall lies south of it and looks to its axis.
        away = cells.center - [0.0, 0.0, 30.0]
        assert (away[:, 1] < 0.0).all()
        assert (np.sum(away[:, :2] * cells.normal[:, :2], axis=1) < -2.9).all()
        assert cells.area.sum() == pytest.approx(2.5 * 3.0 * 4.5, rel=1e-3)
    found = ht.flux(plant, sun=NOON)
    assert found.power > 10e3
    assert found.flux.shape == (1, 2 * 18 * 36)
    rays = ht.flux(plant, sun=NOON, rays=1e5)
    assert found.power == pytest.approx(rays.power, rel=0.02)


def test_a_mesh_comes_from_a_file(tmp_path: Path) -> None:
    (tmp_path / "box.obj").write_text(
        "# two panels\nv -2 -2 0\nv 2 -2 0\nv 2 2 0\nv -2 2 0\nvn 0 0 1\nf 1/1/1 2 3 -1\n"
    )
    text = _received('kind = "mesh"\nmesh = "box.obj"\n').replace("width_m = 4\nheight_m = 4\n", "")
    plant = plant_file.read_plant(written(tmp_path, text=text))
    receiver = plant.receiver("receiver")
    assert (receiver.width, receiver.height) == (4.0, 4.0)
    plain = plant_file.read_plant(written(tmp_path)).receiver("receiver")
    for one in (plant, again(plant, tmp_path)):
        surface = surface_of(one.receiver("receiver"))
        assert isinstance(surface, Mesh)
        np.testing.assert_allclose(surface.cells.normal, [plain.normal] * 2, atol=1e-12)
        assert np.abs(surface.vertices - plain.center).max() == 2.0
    # Moved in the file, it moves with its centre; the trial finds the file that it names.
    path = written(tmp_path, text=text)
    plant_edit.edit(path, "receiver", {"center_m": "0,0,35"})
    moved = surface_of(plant_file.read_plant(path).receiver("receiver"))
    np.testing.assert_allclose(moved.center, [0.0, 0.0, 35.0], atol=1e-9)


def test_meshes_of_both_formats_are_the_same(tmp_path: Path) -> None:
    wall = cavity_wall(3.0, 2.0, 4.0, (2, 3))
    write_mesh(tmp_path / "a.obj", wall)
    again = read_mesh(tmp_path / "a.obj")
    np.testing.assert_array_equal(again.vertices, wall.vertices)
    np.testing.assert_array_equal(again.faces, wall.faces)
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    rows = np.zeros(len(wall.faces), kind)
    rows["corners"] = wall.vertices[wall.faces]
    data = b"\0" * 80 + len(rows).to_bytes(4, "little") + rows.tobytes()
    (tmp_path / "a.stl").write_bytes(data)
    stl = read_mesh(tmp_path / "a.stl")
    np.testing.assert_allclose(stl.center, wall.center, atol=1e-6)
    np.testing.assert_allclose(stl.normal, wall.normal, atol=1e-6)
    (tmp_path / "a.stl").write_bytes(data[:-10])
    with pytest.raises(FormatError, match=r"a\.stl: 674 bytes for 12 triangles"):
        read_mesh(tmp_path / "a.stl")


SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("v 0 0 0\n", "the mesh has no faces"),
        ("v 0 0\n", "line 1: 'v 0 0': expected three coordinates in m"),
        (f"{SQUARE}f 1 2\n", "line 5: 'f 1 2': expected three vertex numbers or more"),
        (f"{SQUARE}f 1 2 9\n", "a face uses vertex 8, but there are only 4"),
        (f"{SQUARE}f 1 1 2\n", "triangle 0 has no area; remove it"),
    ],
)
def test_a_mesh_that_cannot_be_is_one_line(content: str, text: str, tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text(content)
    path = written(tmp_path, text=_received('kind = "mesh"\nmesh = "m.obj"\n'))
    with pytest.raises(FormatError) as caught:
        plant_file.read_plant(path)
    assert text in str(caught.value)
    assert "m.obj" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ('kind = "mesh"\n', "receiver receiver: kind mesh needs mesh, a file"),
        ('kind = "cavity"\n', "kind cavity needs mesh, a file, or radius_m and height_m"),
        (
            'kind = "cavity"\nradius_m = 3\nmesh = "m.obj"\n',
            "mesh cannot be combined with radius_m or opening_angle",
        ),
        ('mesh = "m.obj"\n', "kind planar takes no mesh; remove it"),
        (
            "inner_height_m = 3\n",
            "inner_height_m applies only to a cavity's cylindrical wall; remove it",
        ),
        ('kind = "cavity"\nradius_m = 3\nopening_angle_rad = 4\n', "opening angle 4 rad"),
        ('kind = "cavity"\nmesh = "front.obj"\n', "reaches 1.000 m in front of the aperture"),
        ('kind = "cavity"\nmesh = "away.obj"\n', "no triangle of its inner surface faces the"),
        ('kind = "mesh"\nmesh = "m.txt"\n', "the name ends in '.txt'; meshes are .obj or .stl"),
        ('kind = "mesh"\nmesh = "none.obj"\n', "no such file"),
    ],
)
def test_a_receiver_that_cannot_be_is_one_line(keys: str, text: str, tmp_path: Path) -> None:
    for name, z, order in (("m", -1, "1 2 3"), ("front", 1, "1 2 3"), ("away", -1, "1 3 2")):
        vertices = f"v 0 0 {z}\nv 1 0 {z}\nv 1 1 {z}\n"
        (tmp_path / f"{name}.obj").write_text(f"{vertices}f {order}\n")
    (tmp_path / "m.txt").write_text("v\n")
    with pytest.raises(FormatError) as caught:
        plant_file.read_plant(written(tmp_path, text=_received(keys)))
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_width_is_needed_of_all_but_a_mesh(tmp_path: Path) -> None:
    text = TEXT.replace("width_m = 4\nheight_m = 4\n", "", 1)
    with pytest.raises(FormatError, match="kind planar needs width_m and height_m"):
        plant_file.read_plant(written(tmp_path, text=text))


def test_a_flux_limit_needs_rows_and_columns(tmp_path: Path) -> None:
    aims = '[aims]\nstrategy = "limit"\nlimit_kw_m2 = 500\n'
    path = written(tmp_path, aims, text=_received(CAVITY))
    with pytest.raises(FormatError, match="receiver, and receiver is a cavity; remove"):
        plant_file.read_plant(path)


def test_mirrors_in_another_order_have_their_own_surfaces(tmp_path: Path) -> None:
    """As those of a running plant, whose field has another order than its file."""
    _maps(tmp_path)
    plant = read(tmp_path, 'mirror = {slope_maps = "maps"}\n', (",mirror.focal_m", ",70", ",80"))
    mirrors = scene_of(plant, NOON).mirrors
    order = np.array([1, 0])
    arrays = (mirrors.center, mirrors.normal, (4.0, 3.0), mirrors.aim)
    other = Mirrors.of(arrays[0][order], arrays[1][order], arrays[2], arrays[3][order])
    found = shaped(other, plant, order)
    for name in ("focal", "slope", "area", "reflectivity"):
        np.testing.assert_allclose(getattr(found, name), getattr(mirrors, name)[order])
    assert found.facets is not None
    assert mirrors.facets is not None
    focal = [m.facets.focal[m.kind] for m in (found, mirrors) if m.facets is not None]
    np.testing.assert_allclose(focal[0], focal[1][order])


def test_a_tower_shades(tmp_path: Path) -> None:
    tower = "[[towers]]\neast_m = 0\nnorth_m = 52\nradius_m = 1.5\ntop_m = 25\n"
    plant = read(tmp_path, tower)
    for one in (plant, again(plant, tmp_path)):
        found = ht.flux(one, sun=NOON).efficiencies
        assert found.shading[0] < 0.9
        assert found.shading[1] > 0.99
    inside = tower.replace("52", "59.5")
    with pytest.raises(FormatError, match=r"A1 is 0\.50 m from the axis of a tower of radius"):
        read(tmp_path, inside)


def test_a_receiver_that_no_mirror_sees_is_one_line(tmp_path: Path) -> None:
    text = TEXT.replace("normal = [0, 1, 0]", "normal = [0, -1, 0]")
    plant = plant_file.read_plant(written(tmp_path, text=text))
    with pytest.raises(HeliotropeError, match="receiver receiver: no mirror sends light to it"):
        ht.flux(plant, sun=NOON)


def _wrong(keys: dict[str, object]) -> Callable[[], Receiver]:
    plain = {"name": "r", "kind": "planar", "center": (0.0, 0.0, 9.0), "normal": (0.0, 1.0, 0.0)}
    return lambda: Receiver(**{**plain, "width": 1.0, "height": 1.0, **keys})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"kind": "mesh"}, "receiver r: kind mesh needs a mesh"),
        ({"mesh": cavity_wall(1.0, 1.0, 1.0)}, "receiver r: kind planar takes no mesh"),
    ],
)
def test_a_receiver_in_python_that_cannot_be(keys: dict[str, object], text: str) -> None:
    with pytest.raises(HeliotropeError, match=text):
        _wrong(keys)()
