"""HelioK XML: word for word, both ways, against published angles and reference cases."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from heliotrope.field.formats import heliok
from heliotrope.field.formats.frames import euler_angles, euler_matrix, mirror_frame
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.geometry import angle_between, normalize, reflect, rotation
from heliotrope.mechanism import kinds
from heliotrope.mechanism.drives import direct
from heliotrope.mechanism.tracking import track
from reference import cases
from support.heliok_files import SCENE, SITE, edited, mixed_plant, scene


def plant() -> Plant:
    return heliok.to_plant(scene(), SITE)


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


def test_text_between_elements_is_kept(tmp_path: Path) -> None:
    inner = heliok.Element(
        "Note", children=("one", heliok.Element("b"), "two", heliok.Remark("c"), "3")
    )
    units = (("unitLength", "m"), ("unitAngle", "rad"))
    document = heliok.Document(heliok.Element("HelioK", units, (inner,)))
    heliok.write(document, tmp_path / "note.xml")
    assert heliok.read(tmp_path / "note.xml") == document


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
        tmp_path,
        'name="Field" translation="0, 50, 0"',
        'name="Field" translation="0, 50, 0" rotation="0, 0, 90"',
    )
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
        times(angle),
        text,
    )


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
