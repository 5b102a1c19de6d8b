"""HelioK XML: word for word, both ways, against published angles and reference cases."""

import re
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from heliotrope.errors import FormatError, InputError
from heliotrope.field.formats import heliok
from heliotrope.field.formats._frames import euler_angles, euler_matrix, mirror_frame
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target
from heliotrope.geometry import angle_between, normalize, reflect, rotation
from heliotrope.mechanism import kinds
from heliotrope.mechanism.drives import direct, linear_paint, rotary
from heliotrope.mechanism.tracking import track
from heliotrope.sun import Site
from reference import cases

SCENE = Path(__file__).parent / "files" / "heliok-scene.xml"
SITE = Site(34.707, 33.261, 10.0, name="Pentakomo")


def scene() -> heliok.Document:
    return heliok.read(SCENE)


def plant() -> Plant:
    return heliok.to_plant(scene(), SITE)


def edited(tmp_path: Path, old: str, new: str) -> Path:
    """Return the scene's file with the first occurrence of a text replaced."""
    text = SCENE.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "scene.xml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return path


# -- word for word ---------------------------------------------------------------------


def test_reading_writing_and_reading_again_keeps_everything(tmp_path: Path) -> None:
    first = scene()
    heliok.write(first, tmp_path / "copy.xml")
    again = heliok.read(tmp_path / "copy.xml")
    assert again == first
    heliok.write(again, tmp_path / "second.xml")
    assert (tmp_path / "second.xml").read_bytes() == (tmp_path / "copy.xml").read_bytes()


@pytest.mark.parametrize(
    "kept",
    [
        'origin="written for the tests"',
        'maker="kept although nobody reads it"',
        '<Canting method="an element we do not know">free text</Canting>',
        "<!-- the azimuth turns clockwise -->",
        "<!-- Two azimuth-elevation heliostats",
        '<?end of="scene"?>',
        'roughness="1.000 mrad"',
        "<SunShapeBuieRational/>",
    ],
)
def test_what_nobody_reads_is_kept(tmp_path: Path, kept: str) -> None:
    heliok.write(scene(), tmp_path / "copy.xml")
    assert kept in (tmp_path / "copy.xml").read_text(encoding="utf-8")


def test_lines_take_no_part_in_comparisons() -> None:
    assert heliok.Element("a", line=1) == heliok.Element("a", line=2)


xml_text = st.text(
    st.characters(
        codec="utf-8", exclude_categories=("C",), exclude_characters="\u0085\u2028\u2029"
    ),
    max_size=12,
)
xml_name = st.from_regex(r"\A[A-Za-z_][A-Za-z0-9_]{0,8}\Z")


@st.composite
def elements(draw: st.DrawFn, depth: int = 3) -> heliok.Element:
    attributes = draw(st.dictionaries(xml_name, xml_text, max_size=3))
    children: list[Any] = []
    if depth:
        kinds_of_child = st.one_of(
            elements(depth=depth - 1),
            st.builds(heliok.Remark, xml_text.filter(lambda t: "-" not in t)),
        )
        children = draw(st.lists(kinds_of_child, max_size=3))
    return heliok.Element(draw(xml_name), tuple(attributes.items()), tuple(children))


@settings(max_examples=40, deadline=None)
@given(elements())
def test_any_tree_survives(tmp_path_factory: pytest.TempPathFactory, tree: heliok.Element) -> None:
    units = (("unitLength", "mm"), ("unitAngle", "mrad"))
    document = heliok.Document(heliok.Element("HelioK", units, (tree,)))
    path = tmp_path_factory.mktemp("xml") / "tree.xml"
    heliok.write(document, path)
    assert heliok.read(path) == document


# -- meaning ---------------------------------------------------------------------------


def test_published_angles_are_met() -> None:
    """HelioK's example prints these for the same heliostats, receiver and sun."""
    heliostats = plant().groups["heliostats"]
    result = track(heliostats.mechanism.armature, heliok.sun(scene()), heliostats.aim)
    published = np.array(
        [[[-36.8761, 40.6415], [143.0545, 139.4126]], [[-12.3089, 32.1292], [167.6690, 147.9013]]]
    )
    # HelioK stops at 0.1 mm of accuracy at 60 m and prints four digits, in single precision.
    np.testing.assert_allclose(np.degrees(result.angles), published, atol=3e-4)
    assert result.reachable.all()


def test_stops_leave_the_branch_that_heliok_selects() -> None:
    heliostats = plant().groups["heliostats"]
    result = track(heliostats.mechanism, heliok.sun(scene()), heliostats.aim)
    np.testing.assert_array_equal(result.reachable, [[True, False], [True, False]])
    np.testing.assert_array_equal(result.best, [0, 0])


def test_nested_nodes_add_up() -> None:
    group = plant().groups["heliostats"]
    assert group.names == ("HeliostatA", "HeliostatB")
    np.testing.assert_allclose(group.position, [[30, 50, 0], [-30, 50, 0]], atol=1e-12)
    # The mirrors look at the tower at zero angles, so B's is A's mirror image.
    normals = group.mechanism.pose(np.zeros((2, 2))).normal
    np.testing.assert_allclose(normals[0] * [-1, 1, 1], normals[1], atol=1e-12)
    towards = normalize(-group.position)
    assert angle_between(normals, towards).max() < np.radians(0.001)


def test_rotations_of_nested_nodes_multiply(tmp_path: Path) -> None:
    turned = edited(
        tmp_path, 'name="Field" translation="0, 50, 0"',
        'name="Field" translation="0, 50, 0" rotation="0, 0, 90"',
    )  # fmt: skip
    group = heliok.to_plant(heliok.read(turned), SITE).groups["heliostats"]
    np.testing.assert_allclose(group.position, [[0, 80, 0], [0, 20, 0]], atol=1e-12)


def test_surfaces_become_receivers_and_targets(tmp_path: Path) -> None:
    receiver = plant().receiver("Receiver")
    np.testing.assert_allclose(receiver.center, [0, 0, 20], atol=1e-12)
    np.testing.assert_allclose(receiver.normal, [0, 1, 0], atol=1e-12)
    assert (receiver.width, receiver.height) == (2.0, 3.0)
    assert receiver.corners is not None
    # Seen from the north the upper left corner is in the east.
    np.testing.assert_allclose(receiver.corners[0], [1, 0, 21.5], atol=1e-12)
    below = edited(tmp_path, '<Node name="Receiver" ', '<Node name="Targets"><Node name="White" ')
    text = below.read_text(encoding="utf-8").replace(
        '</Node>\n    <Node name="Field"', '</Node></Node>\n    <Node name="Field"'
    )
    below.write_text(text, encoding="utf-8")
    target = heliok.to_plant(heliok.read(below), SITE).target("White")
    np.testing.assert_allclose(target.normal, [0, 1, 0], atol=1e-12)
    assert (target.width, target.height) == pytest.approx((2.0, 3.0))


def test_several_surfaces_of_a_node_get_names_of_their_own(tmp_path: Path) -> None:
    kit = "<ShapeKit><ShapeFlat/><ApertureRectangular x='-1, 3' y='0, 2'/></ShapeKit>"
    path = edited(
        tmp_path,
        'rotation="90, 0, 180">\n      <ShapeKit>',
        f'rotation="90, 0, 180">{kit}\n<ShapeKit>',
    )
    made = heliok.to_plant(heliok.read(path), SITE)
    assert [r.name for r in made.receivers] == ["Receiver", "Receiver-2"]
    # x points west and y up: the aperture's middle is 1 m west and 1 m above the node.
    np.testing.assert_allclose(made.receivers[0].center, [-1, 0, 21], atol=1e-12)
    assert (made.receivers[0].width, made.receivers[0].height) == (4.0, 2.0)


def test_facets_lie_in_the_mirrors_frame() -> None:
    facets = plant().groups["heliostats"].facets
    assert facets is not None
    np.testing.assert_allclose(facets.center, np.zeros((2, 1, 3)), atol=1e-12)
    np.testing.assert_allclose(facets.half_width, [[[1.2, 0, 0]]] * 2, atol=1e-12)
    np.testing.assert_allclose(facets.half_height, [[[0, 0.9, 0]]] * 2, atol=1e-12)


def test_site_needs_the_height_that_the_file_lacks() -> None:
    site = heliok.site(scene(), 42.0)
    assert site.origin == pytest.approx((34.707, 33.261, 42.0), abs=1e-12)
    assert site.name == "Pentakomo"


def test_models_hold_starting_angles_and_stops() -> None:
    model = heliok.models(scene())["AzEl"]
    np.testing.assert_array_equal(model.angles, [0.0, 0.0])
    np.testing.assert_allclose(model.primary.stops, [-np.pi / 2, np.pi / 2])
    np.testing.assert_allclose(model.secondary.origin, [0, 0.1, 0])


def scaled(text: str, length: float, angle: float) -> str:
    """Return the scene's text with all numbers in other units."""

    def times(factor: float, unit: str = "") -> Any:
        def change(match: re.Match[str]) -> str:
            if unit and unit in match[2]:
                return match[0]
            numbers = [float(n) * factor for n in match[2].split(",")]
            return f'{match[1]}="{", ".join(map(repr, numbers))}"'

        return change

    text = re.sub(r'(translation|point|focus|[xy]Width)="([^"]*)"', times(length), text)
    return re.sub(
        r'(rotation|rotationAngles|longitude|latitude|azimuth|elevation)="([^"]*)"',
        times(angle), text,
    )  # fmt: skip


@pytest.mark.parametrize(("length", "per_metre"), [("mm", 1e3), ("cm", 1e2), ("km", 1e-3)])
@pytest.mark.parametrize(
    ("angle", "per_degree"), [("rad", np.pi / 180), ("mrad", 1e3 * np.pi / 180)]
)
def test_units_are_honoured(
    tmp_path: Path, length: str, per_metre: float, angle: str, per_degree: float
) -> None:
    text = scaled(SCENE.read_text(encoding="utf-8"), per_metre, per_degree)
    text = text.replace('unitLength="m"', f'unitLength="{length}"')
    path = tmp_path / "units.xml"
    path.write_text(text.replace('unitAngle="deg"', f'unitAngle="{angle}"'), encoding="utf-8")
    other = heliok.to_plant(heliok.read(path), SITE)
    np.testing.assert_allclose(other.armature.table, plant().armature.table, atol=1e-12)
    np.testing.assert_allclose(other.drives.table, plant().drives.table, atol=1e-12)
    assert other.groups["heliostats"].height == pytest.approx(1.8)
    np.testing.assert_allclose(heliok.sun(heliok.read(path)), heliok.sun(scene()), atol=1e-12)


def test_a_number_may_carry_its_own_unit(tmp_path: Path) -> None:
    path = edited(tmp_path, 'translation="0, 0, 1.5"', 'translation="0, 0, 1500 mm"')
    model = heliok.models(heliok.read(path))["AzEl"]
    np.testing.assert_array_equal(model.primary.origin, [0, 0, 1.5])


#: Those of heliostats with two axes that are aimed at a point of the field.
FIELD_CASES = [
    pytest.param(case, id=name)
    for name, case in cases.load("heliok")
    if {"axis2_unit", "aim_ENZ"} <= case["inputs"].keys()
]


@pytest.mark.parametrize("case", FIELD_CASES)
def test_reference_cases_pass_through_a_file(tmp_path: Path, case: dict[str, Any]) -> None:
    inputs = case["inputs"]
    turn = np.array(inputs["R_heliostat_rowmajor"]).reshape(3, 3)

    def text(values: Any) -> str:
        return ", ".join(map(repr, np.asarray(values, dtype=float).tolist()))

    path = tmp_path / "case.xml"
    path.write_text(
        f"""<HelioK unitLength="m" unitAngle="rad"><Factory><HeliostatKit name="m">
        <Primary translation="{text(inputs["t1"])}" rotationAxis="{text(inputs["axis1_unit"])}"
          rotationAngles="-3.15, 3.15"/>
        <Secondary translation="{text(inputs["t2"])}" rotationAxis="{text(inputs["axis2_unit"])}"
          rotationAngles="-3.15, 3.15"/>
        <Facet rotation="{text(euler_angles(mirror_frame(inputs["n0"])))}"><ShapeKit>
          <ApertureRectangular xWidth="1" yWidth="1"/></ShapeKit></Facet>
        <Angles primary="0" secondary="0"/>
        <Tracking point="{text(inputs["r0"])}" normal="{text(inputs["n0"])}"/>
        <Aiming point="{text(inputs["aim_ENZ"])}"/></HeliostatKit></Factory>
        <Scene><Node name="H" translation="{text(inputs["position"])}"
          rotation="{text(euler_angles(turn))}"><HeliostatKit ref="m"/></Node></Scene></HelioK>""",
        encoding="utf-8",
    )
    heliostats = heliok.to_plant(heliok.read(path), SITE).groups["heliostats"]
    sun = np.array(inputs["sun_vector_ENZ"])
    result = track(heliostats.mechanism, sun, heliostats.aim)
    for branch in case["branches"]:
        k = branch["branch"]
        assert result.reachable[0, k] == (branch["status"] == "ok")
        if branch["status"] == "ok":
            wanted = [branch["alpha_rad"], branch["beta_rad"]]
            turns = (result.angles[0, k] - wanted) / (2 * np.pi)
            assert np.abs(turns - turns.round()).max() * 2 * np.pi < 1e-10
    np.testing.assert_array_equal(heliostats.aim, [inputs["aim_ENZ"]])


# -- from a plant ----------------------------------------------------------------------


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
    errors = {"tilt_north": 0.004, "non_orthogonality": -0.003, "canting": 0.002,
              "position_up": 0.05, "azimuth_bias": 0.01}  # fmt: skip
    groups = {
        "a": Heliostats(("a1", "a2", "a3"), azel, np.full(3, 2.0), np.full(3, 1.5),
                        parameters={n: np.full(3, v) for n, v in errors.items()}),
        "j": Heliostats(("j1",), jacks, np.array([3.3]), np.array([2.5]), facets,
                        aim=np.array([[1.0, 2.0, 30.0]])),
        "p": Heliostats(("p1", "p2"), polar, np.full(2, 1.0), np.full(2, 1.0),
                        aim=np.array([[0.0, 0.0, 30.0], [np.nan] * 3])),
    }  # fmt: skip
    tower = np.array([[2.0, 0, 45], [-2, 0.1, 45], [-2, 0.1, 40], [2, 0, 40]])
    receiver = Receiver("oven", "planar", (0, 1, 50), (0.1, 1, -0.3), 4.0, 5.0)
    target = Target("white", tower, tower.mean(axis=0))
    return Plant("mixed", SITE, groups, (target,), (receiver,))


@pytest.mark.parametrize(("unit", "tolerance"), [("rad", 1e-13), ("deg", 1e-13), ("mrad", 1e-13)])
def test_a_plant_survives(tmp_path: Path, unit: str, tolerance: float) -> None:
    before = mixed_plant()
    heliok.write(heliok.from_plant(before, unit_angle=unit), tmp_path / "plant.xml")
    after = heliok.to_plant(heliok.read(tmp_path / "plant.xml"), SITE)
    assert sorted(after.names) == sorted(before.names)
    angles = np.random.default_rng(3).uniform(-1, 1, (20, 2))
    for name in before.names:
        (old, i), (new, k) = before.find(name), after.find(name)
        poses = [g.calibrated.armature.table[row] for g, row in ((old, i), (new, k))]
        normal_old, vertex_old = type(old.calibrated.armature)(poses[0]).pose(angles)
        normal_new, vertex_new = type(old.calibrated.armature)(poses[1]).pose(angles)
        np.testing.assert_allclose(normal_new, normal_old, atol=tolerance)
        np.testing.assert_allclose(vertex_new, vertex_old, atol=1e-11)
        assert (new.width[k], new.height[k]) == pytest.approx(
            (old.width[i], old.height[i]), rel=1e-3
        )
        if old.facets is not None:
            assert new.facets is not None
            for part in ("center", "half_width", "half_height"):
                np.testing.assert_allclose(
                    getattr(new.facets, part)[k], getattr(old.facets, part)[i], atol=1e-13
                )
    np.testing.assert_allclose(
        after.target("white").corners, before.target("white").corners, atol=1e-2
    )
    np.testing.assert_allclose(
        after.target("white").normal, before.target("white").normal, atol=1e-12
    )
    np.testing.assert_allclose(
        after.receiver("oven").normal, before.receiver("oven").normal, atol=1e-12
    )


def test_a_plant_from_a_file_goes_back_without_a_changed_bit(tmp_path: Path) -> None:
    document = heliok.from_plant(plant())
    heliok.write(document, tmp_path / "once.xml")
    again = heliok.to_plant(heliok.read(tmp_path / "once.xml"), SITE)
    old, new = plant().groups["heliostats"], again.groups["heliostats"]
    np.testing.assert_array_equal(new.mechanism.axes, old.mechanism.axes)
    np.testing.assert_array_equal(new.mechanism.origins, old.mechanism.origins)
    np.testing.assert_array_equal(new.mechanism.drives.table, old.mechanism.drives.table)
    np.testing.assert_array_equal(new.position, old.position)
    np.testing.assert_array_equal(new.aim, old.aim)
    assert len(heliok.models(document)) == 1


def test_stops_come_from_angles_and_counts(tmp_path: Path) -> None:
    heliok.write(heliok.from_plant(mixed_plant()), tmp_path / "plant.xml")
    placed = {h.name: h.model for h in heliok.heliostats(heliok.read(tmp_path / "plant.xml"))}
    np.testing.assert_allclose(placed["a1"].primary.stops, [-np.pi, np.pi])
    np.testing.assert_array_equal(placed["a1"].secondary.stops, [-0.1, 1.6])
    jack = mixed_plant().groups["j"].mechanism.drives
    ends = jack.angles([[0.0, 0.0]])[0], jack.angles([[68000.0, 68000.0]])[0]
    np.testing.assert_allclose(
        placed["j1"].primary.stops, sorted([ends[0][0], ends[1][0]]), rtol=1e-14
    )


def test_a_stop_at_one_end_leaves_a_turn() -> None:
    one = kinds.azimuth_elevation(
        [[0.0, 50, 0]], drives=(direct(min_angle=-1.0), direct(max_angle=1.5))
    )
    group = Heliostats(("h",), one, np.ones(1), np.ones(1), aim=np.array([[0.0, 0, 20]]))
    model = next(iter(heliok.models(heliok.from_plant(Plant("p", SITE, {"g": group}))).values()))
    np.testing.assert_allclose(model.primary.stops, [-1.0, -1.0 + 2 * np.pi])
    np.testing.assert_allclose(model.secondary.stops, [1.5 - 2 * np.pi, 1.5])


def test_missing_aims_go_to_the_receiver_first() -> None:
    placed = {h.name: h.model for h in heliok.heliostats(heliok.from_plant(mixed_plant()))}
    for name, aim in (("p2", (0, 1, 50)), ("p1", (0, 0, 30)), ("a1", (0, 1, 50))):
        np.testing.assert_array_equal(placed[name].aim, aim)


def test_tracking_is_the_same_before_and_after(tmp_path: Path) -> None:
    before = mixed_plant()
    heliok.write(heliok.from_plant(before), tmp_path / "plant.xml")
    after = heliok.to_plant(heliok.read(tmp_path / "plant.xml"), SITE)
    group, row = after.find("a2")
    sun, aim = normalize([0.3, -0.5, 0.7]), np.array([0.0, 1.0, 50.0])
    result = track(group.mechanism[row], sun, aim)
    best = int(result.best)
    assert result.reachable[best]
    beam = reflect(sun, result.normal[best])
    assert angle_between(beam, normalize(aim - result.vertex[best])) < 1e-10


# -- frames ----------------------------------------------------------------------------


@given(st.tuples(*[st.floats(-np.pi, np.pi)] * 3))
@settings(max_examples=200, deadline=None)
def test_euler_angles_come_back(angles: tuple[float, float, float]) -> None:
    turned = euler_matrix(angles)
    np.testing.assert_allclose(euler_matrix(euler_angles(turned)), turned, atol=1e-12)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_euler_angles_come_back_at_the_gimbal(pitch: float) -> None:
    turned = euler_matrix((0.3, pitch, 1.1))
    np.testing.assert_allclose(euler_matrix(euler_angles(turned)), turned, atol=1e-12)


def test_euler_matrices_are_products_of_turns() -> None:
    angles = np.random.default_rng(5).uniform(-3, 3, (4, 2, 3))
    about = [rotation(axis, angles[..., k]) for k, axis in enumerate(np.eye(3))]
    np.testing.assert_allclose(euler_matrix(angles), about[2] @ about[1] @ about[0], atol=1e-14)


def test_euler_angles_are_applied_about_x_first() -> None:
    """HelioK's rotation (90, 0, 180)° takes (x, y, z) to (−x, z, y)."""
    turned = euler_matrix(np.radians([90, 0, 180]))
    np.testing.assert_allclose(turned @ [1, 2, 3], [-1, 3, 2], atol=1e-12)


@pytest.mark.parametrize(
    ("normal", "right", "up"),
    [
        ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
        ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
        ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
        ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ],
)
def test_mirror_frame(normal: Any, right: Any, up: Any) -> None:
    np.testing.assert_allclose(mirror_frame(normal), np.transpose([right, up, normal]), atol=1e-15)


# -- the reference page ----------------------------------------------------------------


def test_the_reference_page_shows_what_comes_out(capsys: pytest.CaptureFixture[str]) -> None:
    page = Path(__file__).parents[1] / "docs" / "reference" / "formats.md"
    shown = re.findall(
        r"```python\n(.*?)```\n\n```text\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL
    )
    assert len(shown) == 3
    names: dict[str, Any] = {}
    for code, output in shown:
        exec(code, names)
        assert capsys.readouterr().out == output


# -- refusals --------------------------------------------------------------------------

WRONG = [
    ('unitLength="m" ', "", "line 3: <HelioK> has no unitLength; give one"),
    ('unitLength="m"', 'unitLength="inch"', "unitLength 'inch' is not one of m, cm, mm, km"),
    ('unitAngle="deg"', 'unitAngle="gon"', "unitAngle 'gon' is not one of rad, mrad, deg"),
    ("<HelioK ", "<HelioQ ", "not well-formed XML"),
    ('translation="0, 0, 1.5"', "", "<Primary> has no translation; give one"),
    ('translation="0, 0, 1.5"', 'translation=" "', "<Primary> has no translation"),
    ('"0, 0, 1.5"', '"0, 0"', "translation has 2 numbers; it needs 3"),
    ('"0, 0, 1.5"', '"0, 0, nan"', "<Primary> translation: 'nan' is not a finite number"),
    ('"0, 0, 1.5"', '"0, 0, 1e999"', "'1e999' is not a finite number"),
    ('"0, 0, 1.5"', '"0, 0, 1_5"', "'1_5' is not a finite number"),
    ('"0, 0, 1.5"', '"0, 0, 1.5 deg"', "unit 'deg' is not known here; known: m, cm, mm, km"),
    ('normal="0, 1, 0"', 'normal="0, 1, 0 m"', "unit 'm' is not known here; known: none"),
    ('rotationAxis="0, 0, -1"', 'rotationAxis="0, 0, 0"', "a vector of length 0 has no direction"),
    (
        'rotationAxis="0, 0, -1"',
        'rotationAxis="1, 0, 0"',
        "HeliostatKit AzEl: the two axes enclose 0 mrad",
    ),
    (
        'rotationAngles="-90, 90"',
        'rotationAngles="90, -90"',
        "<Primary> rotationAngles 90° to -90°: the lower stop",
    ),
    ('normal="0, 1, 0"', 'normal="0, 0, 0"', "<Tracking> normal: a vector of length 0"),
    ('normal="0, 1, 0"', 'normal="2, 0, 0"', "the normal lies along the secondary axis"),
    (
        '<Aiming point="0, 0, 20"/>',
        "<Tracking/>",
        "<HeliostatKit> AzEl has 2 elements <Tracking>; it needs one",
    ),
    ('xWidth="2.4"', 'xWidth="-2.4"', "<ApertureRectangular> -2.4 m × 1.8 m: both must be above 0"),
    (
        '<Facet rotation="90, 0, 180">',
        "<Facet>",
        "<Facet> rotation: its normal stands 90° from that",
    ),
    ('xWidth="2.4"', "", "<ApertureRectangular> has no x; give one"),
    (
        '<ApertureRectangular xWidth="2.4"',
        '<ApertureDisk xWidth="2.4"',
        "has 0 elements <ApertureRectangular>",
    ),
    (
        '<HeliostatKit ref="AzEl"/>',
        '<HeliostatKit ref="AzIl"/>',
        "there is no HeliostatKit 'AzIl'; did you mean AzEl?",
    ),
    ('<HeliostatKit ref="AzEl"/>', "<HeliostatKit/>", "<HeliostatKit> has no ref; give one"),
    ('name="HeliostatB"', 'name="HeliostatA"', "heliostat HeliostatA: the name occurs twice"),
    ('name="HeliostatB"', "", "a heliostat whose node has no name; give it one"),
    ('name="AzEl"', "", "<HeliostatKit> has no name; give one"),
    (
        "</HeliostatKit>\n  </Factory>",
        '</HeliostatKit><HeliostatKit name="AzEl"/></Factory>',
        "HeliostatKit AzEl: the name occurs twice",
    ),
]


@pytest.mark.parametrize(("old", "new", "text"), WRONG)
def test_a_wrong_file_gets_one_line(tmp_path: Path, old: str, new: str, text: str) -> None:
    path = edited(tmp_path, old, new)
    with pytest.raises(FormatError) as error:
        heliok.to_plant(heliok.read(path), SITE)
    assert text in str(error.value)
    assert re.match(re.escape(str(path)) + r": (line \d+: )?\S", str(error.value))
    assert "\n" not in str(error.value)


def test_the_line_is_named(tmp_path: Path) -> None:
    path = edited(tmp_path, 'name="HeliostatB"', 'name="HeliostatA"')
    wrong = [i for i, line in enumerate(path.read_text().splitlines(), 1) if 'ref="AzEl"' in line]
    with pytest.raises(FormatError, match=f"line {wrong[1]}: heliostat HeliostatA"):
        heliok.heliostats(heliok.read(path))


def test_the_world_is_needed_once(tmp_path: Path) -> None:
    path = edited(tmp_path, "</World>", "</World><World/>")
    with pytest.raises(FormatError, match="has 2 elements <World>; it needs one"):
        heliok.sun(heliok.read(path))
    with pytest.raises(FormatError, match="has 0 elements <Location>; it needs one"):
        heliok.site(heliok.read(edited(tmp_path, "<Location", "<Place")), 0.0)


def test_a_mirror_needs_a_facet(tmp_path: Path) -> None:
    text = SCENE.read_text(encoding="utf-8")
    path = tmp_path / "bare.xml"
    path.write_text(re.sub(r"<Facet.*</Facet>", "", text, flags=re.DOTALL), encoding="utf-8")
    with pytest.raises(
        FormatError, match="HeliostatKit AzEl: no <Facet>, so its mirror has no size"
    ):
        heliok.to_plant(heliok.read(path), SITE)


@pytest.mark.parametrize("share", [0.03, 0.3, 0.6, 0.97])
def test_a_truncated_file_is_refused(tmp_path: Path, share: float) -> None:
    whole = SCENE.read_bytes()
    path = tmp_path / "cut.xml"
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(FormatError, match=r"cut\.xml: line \d+: not well-formed XML"):
        heliok.read(path)


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.xml"
    with pytest.raises(FormatError, match="there is no such file; give the path of a HelioK file"):
        heliok.read(path)
    with pytest.raises(FormatError, match="this is a folder"):
        heliok.read(tmp_path)
    path.write_bytes(b"")
    with pytest.raises(FormatError, match="the file is empty; it should be a HelioK file"):
        heliok.read(path)
    path.write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0")
    with pytest.raises(FormatError, match="the file is binary"):
        heliok.read(path)
    path.write_text("<svg/>", encoding="utf-8")
    with pytest.raises(FormatError, match="the root element is <svg>; it should be <HelioK>"):
        heliok.read(path)
    (tmp_path / "loop.xml").symlink_to(tmp_path / "loop.xml")
    with pytest.raises(FormatError, match="cannot be read"):
        heliok.read(tmp_path / "loop.xml")


def test_a_huge_file_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "huge.xml"
    with path.open("wb") as stream:
        stream.write(b"<HelioK>")
        stream.truncate(200 * 2**20)
    start = time.perf_counter()
    with pytest.raises(FormatError, match="200 MiB are more than the limit of 64 MiB"):
        heliok.read(path)
    assert time.perf_counter() - start < 1.0


BOMB = "".join(
    f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    "content",
    [
        f'<!DOCTYPE HelioK [<!ENTITY a "ha">{BOMB}]><HelioK>&i;</HelioK>',
        f'<!DOCTYPE HelioK [<!ENTITY a "ha">{BOMB}]><HelioK unitLength="&i;"/>',
        '<!DOCTYPE HelioK [<!ENTITY a SYSTEM "file:///etc/hostname">]><HelioK>&a;</HelioK>',
        '<!DOCTYPE HelioK SYSTEM "http://127.0.0.1:9/x.dtd"><HelioK/>',
    ],
)
def test_entities_are_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "bomb.xml"
    path.write_text(content, encoding="utf-8")
    start = time.perf_counter()
    with pytest.raises(FormatError, match=r"document type|not well-formed"):
        heliok.read(path)
    assert time.perf_counter() - start < 2.0


def test_nesting_without_end_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "deep.xml"
    path.write_text("<a>" * 100_000, encoding="utf-8")
    with pytest.raises(FormatError, match="not well-formed XML"):
        heliok.read(path)


def test_plants_that_do_not_fit_are_refused() -> None:
    whole = mixed_plant()
    with pytest.raises(InputError, match="unit_angle 'grad': give one of rad, mrad, deg"):
        heliok.from_plant(whole, unit_angle="grad")
    trough = kinds.single_axis([[0.0, 0, 0]], (0, 1, 0))
    group = Heliostats(("t",), trough, np.ones(1), np.ones(1))
    with pytest.raises(InputError, match="group t: a single_axis mechanism has 1 driven axis"):
        heliok.from_plant(whole.with_groups({"t": group}))
    with pytest.raises(InputError, match="heliostat a1: HelioK needs an aim"):
        heliok.from_plant(replace(whole, targets=(), receivers=()))
    tube = Receiver("tube", "external_cylinder", (0, 0, 50), (0, 1, 0), 4.0, 5.0)
    with pytest.raises(InputError, match="receiver tube: HelioK has no external_cylinder"):
        heliok.from_plant(replace(whole, receivers=(tube,)))
    fixed = kinds.azimuth_elevation(
        [[0.0, 9, 0]], drives=(direct(min_angle=1.0, max_angle=1.0), direct())
    )
    group = Heliostats(("stiff",), fixed, np.ones(1), np.ones(1))
    with pytest.raises(InputError, match="heliostat stiff: the stops of its primary axis leave no"):
        heliok.from_plant(whole.with_groups({"g": group}))


def test_writing_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot be written \(No such file or directory\)"):
        heliok.write(scene(), tmp_path / "nowhere" / "x.xml")
    bad = heliok.Document(heliok.Element("HelioK", (("name", "bell\a"),)))
    with pytest.raises(InputError, match=r"x\.xml: .*remove the character"):
        heliok.write(bad, tmp_path / "x.xml")
    assert not list(tmp_path.iterdir())
