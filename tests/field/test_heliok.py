"""HelioK XML against published angles and reference cases."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from heliotrope.field.formats import heliok
from heliotrope.field.formats.frames import euler_matrix, mirror_frame
from heliotrope.field.plant import Plant
from heliotrope.geometry import angle_between, normalize, rotation
from heliotrope.mechanism.tracking import track
from reference import cases
from support.heliok_files import SCENE, SITE, edited, scene


def xyz_angles(matrix: Any) -> Any:
    return Rotation.from_matrix(matrix).as_euler("xyz")


def plant() -> Plant:
    return heliok.to_plant(scene(), SITE)


def test_comments_and_unknown_elements_change_nothing(tmp_path: Path) -> None:
    path = edited(tmp_path, "<Scene>", "<!-- note --><Scene><?tool x?><Note a='1'>text</Note>")
    again = heliok.to_plant(heliok.read(path), SITE)
    np.testing.assert_array_equal(again.position, plant().position)
    assert heliok.XmlElement("a", line=1) == heliok.XmlElement("a", line=2)


def test_published_angles_are_met() -> None:
    """HelioK's example prints these for the same heliostats, receiver and sun."""
    heliostats = plant().groups["heliostats"]
    result = track(heliostats.mechanism.armature, heliok.sun(scene()), heliostats.aim)
    published = np.array(
        [[[-36.8761, 40.6415], [143.0545, 139.4126]], [[-12.3089, 32.1292], [167.6690, 147.9013]]]
    )
    # HelioK stops at 0.1 mm of accuracy at 60 m and prints four digits, in single precision.
    np.testing.assert_allclose(np.degrees(result.angles), published, atol=3e-4)
    assert result.served.all()


def test_stops_leave_the_branch_that_heliok_selects() -> None:
    heliostats = plant().groups["heliostats"]
    result = track(heliostats.mechanism, heliok.sun(scene()), heliostats.aim)
    np.testing.assert_array_equal(result.served, [[True, False], [True, False]])
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
        <Facet rotation="{text(xyz_angles(mirror_frame(inputs["n0"])))}"><ShapeKit>
          <ApertureRectangular xWidth="1" yWidth="1"/></ShapeKit></Facet>
        <Angles primary="0" secondary="0"/>
        <Tracking point="{text(inputs["r0"])}" normal="{text(inputs["n0"])}"/>
        <Aiming point="{text(inputs["aim_ENZ"])}"/></HeliostatKit></Factory>
        <Scene><Node name="H" translation="{text(inputs["position"])}"
          rotation="{text(xyz_angles(turn))}"><HeliostatKit ref="m"/></Node></Scene></HelioK>""",
        encoding="utf-8",
    )
    heliostats = heliok.to_plant(heliok.read(path), SITE).groups["heliostats"]
    sun = np.array(inputs["sun_vector_ENZ"])
    result = track(heliostats.mechanism, sun, heliostats.aim)
    for branch in case["branches"]:
        k = branch["branch"]
        assert result.served[0, k] == (branch["status"] == "ok")
        if branch["status"] == "ok":
            wanted = [branch["alpha_rad"], branch["beta_rad"]]
            turns = (result.angles[0, k] - wanted) / (2 * np.pi)
            assert np.abs(turns - turns.round()).max() * 2 * np.pi < 1e-10
    np.testing.assert_array_equal(heliostats.aim, [inputs["aim_ENZ"]])


# -- from a plant ----------------------------------------------------------------------


# -- frames ----------------------------------------------------------------------------


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
