"""The chain of joints: poses, positive senses, and the screw Jacobian."""

import numpy as np
import pytest

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.geometry import azimuth_elevation, direction, rotation
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.parameters import MODELS, model
from support.machines import every_kind, imperfect, random_counts

KINDS = list(every_kind())


def _central(mechanism: Mechanism, counts: np.ndarray, name: str, step: float):  # type: ignore[no-untyped-def]
    ahead = mechanism.with_parameters({name: step}).pose(counts)
    back = mechanism.with_parameters({name: -step}).pose(counts)
    return (
        (ahead.normal - back.normal) / (2 * step),
        (ahead.vertex - back.vertex) / (2 * step),
    )


def _richardson(mechanism: Mechanism, counts: np.ndarray, name: str):  # type: ignore[no-untyped-def]
    """Central differences of two steps, combined to fourth order."""
    step = 2e-4 if not name.endswith(("stroke_offset", "offset", "radius")) else 2e-5
    wide, narrow = (_central(mechanism, counts, name, h) for h in (2 * step, step))
    return [(4 * n - w) / 3 for w, n in zip(wide, narrow, strict=True)]


@pytest.mark.parametrize("kind", KINDS)
def test_jacobian_is_the_derivative(kind: str) -> None:
    mechanism = imperfect(every_kind()[kind], seed=3)
    counts = random_counts(mechanism, 200, seed=5)
    # The keyhole: a mirror that looks along the primary axis.
    counts[0] = 0.0 if kind != "two_jacks" else 30000.0
    if kind == "two_jacks":
        counts[1:3] = [0.0, 0.0], [68745.0, 75308.0]  # the stops of AA39
    # The ratio of a worm is searched and never fitted: its derivative counts as 0.
    names = tuple(name for name in mechanism.parameters if not name.endswith("_worm_ratio"))
    jacobian = mechanism.jacobian(counts, names)
    for p, name in enumerate(names):
        normal, vertex = _richardson(mechanism, counts, name)
        for found, wanted in ((jacobian.normal, normal), (jacobian.vertex, vertex)):
            size = max(1.0, float(np.abs(wanted).max()))
            assert np.abs(found[:, p] - wanted).max() < 1e-7 * size, name
    assert np.abs(np.sum(jacobian.normal * jacobian.pose.normal[:, None], axis=-1)).max() < 1e-12


@pytest.mark.parametrize("kind", KINDS)
def test_jacobian_by_counts(kind: str) -> None:
    mechanism = imperfect(every_kind()[kind], seed=4)
    counts = random_counts(mechanism, 100, seed=6)
    jacobian = mechanism.jacobian(counts, ())
    for d in range(len(mechanism.driven)):
        step = np.zeros(len(mechanism.driven))
        # 0.1 mm of stroke, or 12 µrad of a joint behind a worm.
        step[d] = 15.0
        for which in ("normal", "vertex"):
            wide, narrow = (
                (
                    getattr(mechanism.pose(counts + h), which)
                    - getattr(mechanism.pose(counts - h), which)
                )
                / (2 * h.max())
                for h in (2 * step, step)
            )
            wanted = (4 * narrow - wide) / 3
            found = getattr(jacobian, f"{which}_counts")[:, d]
            assert np.abs(found - wanted).max() < 1e-6 * np.abs(wanted).max()


@pytest.mark.parametrize("kind", KINDS)
def test_armature_is_the_chain(kind: str) -> None:
    mechanism = imperfect(every_kind()[kind], seed=7)
    counts = random_counts(mechanism, 100, seed=8)
    pose = mechanism.pose(counts)
    angles = np.zeros((len(counts), 2))
    for d in range(len(mechanism.driven)):
        angles[:, d] = mechanism.drives[d].angles(counts[:, d])
    normal, vertex = mechanism.armature.pose(angles)
    np.testing.assert_allclose(normal, pose.normal, rtol=0, atol=1e-13)
    np.testing.assert_allclose(vertex, pose.vertex, rtol=0, atol=1e-11)
    assert mechanism.armature.table.shape == (18,)


def test_azimuth_elevation_without_errors() -> None:
    mechanism = kinds.azimuth_elevation((3.0, 4.0, 0.0), pivot_height=1.5, pivot_offset=0.2)
    angles = np.random.default_rng(1).uniform((0, 0), (6.28, 1.57), (50, 2))
    pose = mechanism.pose(angles)
    azimuth, elevation = azimuth_elevation(pose.normal)
    np.testing.assert_allclose(np.stack([azimuth, elevation], -1), angles, rtol=0, atol=1e-13)
    np.testing.assert_allclose(pose.vertex, [3.0, 4.0, 1.5] + 0.2 * pose.normal, atol=1e-14)


def test_positive_senses_of_azimuth_elevation() -> None:
    mechanism = kinds.azimuth_elevation((0.0, 0.0, 0.0))
    up = [0.0, np.pi / 2]
    for name, towards in (("tilt_north", [0, 1, 0]), ("tilt_east", [1, 0, 0])):
        lean = mechanism.with_parameters({name: 0.1}).pose(up).normal
        wanted = np.sin(0.1) * np.array(towards) + [0, 0, np.cos(0.1)]
        np.testing.assert_allclose(lean, wanted, rtol=0, atol=1e-14)
    more = mechanism.with_parameters({"azimuth_bias": 0.1, "elevation_bias": 0.2})
    np.testing.assert_allclose(more.pose([0.3, 0.4]).normal, direction(0.4, 0.6), atol=1e-14)
    # The secondary axis leans towards the positive primary axis, which points down.
    skew = mechanism.with_parameters({"non_orthogonality": 0.1})
    assert skew.armature.axis_2[2] == pytest.approx(-np.sin(0.1))
    canted = mechanism.with_parameters({"canting": 0.1}).armature
    assert np.dot(canted.normal, canted.axis_2) == pytest.approx(np.sin(0.1))
    assert mechanism.with_parameters({"sag": 0.1}).pose([0.0, 0.0]).normal[2] > 0.099


def test_zero_poses_and_axes() -> None:
    roll = kinds.tilt_roll((0, 0, 0))
    np.testing.assert_allclose(roll.armature.normal, [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(roll.armature.axis_2, [0, 1, 0], atol=1e-15)
    aligned = kinds.target_aligned((10.0, 20.0, 0.0), (0.0, 0.0, 30.0), pivot_height=1.0)
    way = np.array([-10.0, -20.0, 29.0])
    np.testing.assert_allclose(aligned.armature.axis_1, way / np.linalg.norm(way), atol=1e-15)
    pitch = kinds.pitch_roll((0, 0, 0), np.pi / 2)
    assert pitch.pose([0.1, 0.0]).normal[0] == pytest.approx(-np.sin(0.1))
    jack = every_kind()["two_jacks"]
    np.testing.assert_allclose(jack.armature.normal, [0, -1, 0], atol=1e-15)


@pytest.mark.parametrize("latitude", [0.6, -0.6])
def test_polar_follows_the_hour_angle(latitude: float) -> None:
    mechanism = kinds.polar((0.0, 0.0, 0.0), latitude)
    for hour, declination in ((0.0, 0.2), (0.7, -0.3), (-1.2, 0.4)):
        sun = np.array(
            [
                -np.cos(declination) * np.sin(hour),
                np.cos(latitude) * np.sin(declination)
                - np.sin(latitude) * np.cos(declination) * np.cos(hour),
                np.sin(latitude) * np.sin(declination)
                + np.cos(latitude) * np.cos(declination) * np.cos(hour),
            ]
        )
        np.testing.assert_allclose(mechanism.pose([hour, declination]).normal, sun, atol=1e-14)


def test_arrays_and_single_ones_agree() -> None:
    positions = np.random.default_rng(0).normal(size=(5, 3)) * 50
    field = imperfect(kinds.azimuth_elevation(positions, pivot_offset=0.3), seed=1)
    counts = np.random.default_rng(1).uniform(0, 1, (7, 1, 2))
    every = field.pose(counts)
    assert every.normal.shape == (7, 5, 3)
    for i in range(5):
        one = field[i].pose(counts[:, 0])
        assert (one.normal == every.normal[:, i]).all()
        assert (one.vertex == every.vertex[:, i]).all()
    assert len(field) == 5
    assert field[1:3].shape == (2,)


def test_orientation_turns_everything() -> None:
    turn = rotation([1.0, 2.0, 3.0], 0.7)
    plain = kinds.azimuth_elevation((0, 0, 0), pivot_height=1.0, pivot_offset=0.2)
    turned = kinds.azimuth_elevation(
        (5.0, 6.0, 7.0), pivot_height=1.0, pivot_offset=0.2, orientation=turn
    )
    a, b = plain.pose([0.3, 0.4]), turned.pose([0.3, 0.4])
    np.testing.assert_allclose(b.normal, turn @ a.normal, atol=1e-15)
    np.testing.assert_allclose(b.vertex, [5.0, 6.0, 7.0] + turn @ a.vertex, atol=1e-14)


ORIGIN = (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: kinds.two_axis(ORIGIN, (0, 0, 1), (0, 0, 2), (0, 1, 0)), "parallel"),
        (lambda: kinds.two_axis(ORIGIN, (0, 0, 0), (1, 0, 0), (0, 1, 0)), "axis_1: .*length 0"),
        (
            lambda: kinds.two_axis(ORIGIN, (0, 0, 1), (1, 0, 0), (1, 0, 0)),
            "parallel to the secondary",
        ),
        (lambda: kinds.two_axis((np.nan, 0, 0), (0, 0, 1), (1, 0, 0), (0, 1, 0)), "not a finite"),
        (lambda: kinds.two_axis((0, 0), (0, 0, 1), (1, 0, 0), (0, 1, 0)), "must have 3 numbers"),
        (lambda: kinds.azimuth_elevation(ORIGIN, orientation=2 * np.eye(3)), "not a rotation"),
        (lambda: kinds.azimuth_elevation(ORIGIN, orientation=np.eye(2)), "finite rotation"),
        (lambda: kinds.tilt_roll(ORIGIN, (0, 0, 1)), "must not be vertical"),
        (lambda: kinds.single_axis(ORIGIN, (1, 0, 0), (1, 0, 0)), "parallel to the axis"),
        (lambda: kinds.azimuth_elevation(ORIGIN).pose([1.0]), "hold the 2 drives"),
        (lambda: kinds.azimuth_elevation(ORIGIN).pose([1.0, np.inf]), "not finite"),
        (lambda: kinds.azimuth_elevation(np.zeros((2, 3))).pose(np.zeros((3, 2))), "does not fit"),
        (lambda: kinds.azimuth_elevation(ORIGIN)[0], "cannot be indexed"),
        (
            lambda: kinds.azimuth_elevation(ORIGIN).with_parameters({"sag": np.nan}),
            "nan is not a number",
        ),
    ],
)
def test_guards(make, text: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InputError, match=text):
        make()


def test_unknown_parameter_suggests() -> None:
    with pytest.raises(UnknownNameError, match=r"did you mean.*tilt_north"):
        kinds.azimuth_elevation(ORIGIN).with_parameters({"tilt_nord": 0.1})


def test_models_by_role_fit_every_kind() -> None:
    for name, mechanism in every_kind().items():
        known = mechanism.parameters
        if len(mechanism.driven) < 2:
            continue
        found = model("malan8+canting", known)
        assert len(found) == 9, name
        assert set(found) <= set(known)
        assert [n for n in found if n.startswith("position_")] == [
            "position_east", "position_north", "position_up",
        ]  # fmt: skip
        assert sum(n.endswith("_bias") for n in found) == 2
        assert model("khalsa8", known)[-2:] == tuple(n for n in known if n.endswith("_scale"))
    azel = every_kind()["azimuth_elevation"].parameters
    assert model("tilts+biases", azel) == (
        "tilt_north", "tilt_east", "azimuth_bias", "elevation_bias",
    )  # fmt: skip
    assert model("malan8", azel) == MODELS["malan8"]
    assert model("canting+sag", azel) == ("canting", "sag")
    with pytest.raises(UnknownNameError, match="model 'malan9'"):
        model("malan9", azel)
    with pytest.raises(UnknownNameError, match="'jacks'"):
        model("jacks", azel)


def test_a_drive_called_tilt_is_no_tilt_of_the_pedestal() -> None:
    known = every_kind()["tilt_roll"].parameters
    assert "tilt_bias" in known
    assert "tilt_bias" not in model("tilts", known)


@pytest.mark.parametrize("name", [n for n, m in every_kind().items() if len(m.driven) == 2])
def test_an_armature_with_its_drives_is_the_same_machine(name: str) -> None:
    mechanism = imperfect(every_kind()[name])
    made = kinds.of_armature(mechanism.armature, mechanism.drives, mechanism.position)
    counts = random_counts(mechanism, 20)
    one, other = mechanism.pose(counts), made.pose(counts)
    np.testing.assert_allclose(other.normal, one.normal, atol=1e-12)
    np.testing.assert_allclose(other.vertex, one.vertex, atol=1e-9)
    np.testing.assert_allclose(made.armature.table, mechanism.armature.table, atol=1e-12)


# -- own joints ---------------------------------------------------------------------------


def test_an_own_joint_about_a_driven_axis_is_the_bias_of_its_drive() -> None:
    mechanism = imperfect(every_kind()["azimuth_elevation"], seed=2)
    more = kinds.with_joint(
        mechanism, "creep", (2.0, 0.0, 0.0), after="elevation", prior=1e-3, origin=(0.3, 0.1, -0.2)
    )
    counts = random_counts(mechanism, 50, seed=3)
    still = more.pose(counts)
    np.testing.assert_allclose(still.normal, mechanism.pose(counts).normal, atol=1e-14)
    np.testing.assert_allclose(still.vertex, mechanism.pose(counts).vertex, atol=1e-12)
    # The elevation turns about east; on the axis itself the origin does not matter.
    level = kinds.with_joint(mechanism, "creep", (1.0, 0.0, 0.0), after="elevation", prior=1e-3)
    turned = level.with_parameters({"creep": 0.02}).pose(counts)
    biased = mechanism.with_parameters({"elevation_bias": 0.02}).pose(counts)
    np.testing.assert_allclose(turned.normal, biased.normal, atol=1e-13)
    np.testing.assert_allclose(turned.vertex, biased.vertex, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_an_own_joint_has_the_derivative_of_a_screw(kind: str) -> None:
    mechanism = imperfect(every_kind()[kind], seed=5)
    for after in (None, mechanism.joints[1], mechanism.joints[-1]):
        own = kinds.with_joint(
            mechanism, "bend", (0.3, 0.5, -0.8), after=after, prior=2e-3, origin=(0.2, -0.1, 0.4)
        ).with_parameters({"bend": 0.03})
        counts = random_counts(mechanism, 50, seed=6)
        names = ("bend", *(f"{own.joints[d]}_bias" for d in own.driven))
        jacobian = own.jacobian(counts, names)
        for p, name in enumerate(names):
            normal, vertex = _richardson(own, counts, name)
            np.testing.assert_allclose(jacobian.normal[:, p], normal, atol=1e-7)
            np.testing.assert_allclose(jacobian.vertex[:, p], vertex, atol=1e-7)
        angles = np.stack(
            [own.drives[d].angles(counts[:, d]) for d in range(len(own.driven))], axis=-1
        )
        if len(own.driven) == 2:
            np.testing.assert_allclose(
                own.armature.pose(angles)[0], own.pose(counts).normal, atol=1e-12
            )


def test_a_mast_that_leans_at_its_foot_takes_the_mirror_along() -> None:
    upright = kinds.azimuth_elevation((3.0, 4.0, 0.0), pivot_height=6.0)
    mast = kinds.with_joint(upright, "mast_north", (-1.0, 0.0, 0.0), prior=5e-3)
    pose = mast.with_parameters({"mast_north": 0.01}).pose([0.0, 0.5 * np.pi])
    np.testing.assert_allclose(pose.normal, [0.0, np.sin(0.01), np.cos(0.01)], atol=1e-14)
    wanted = [3.0, 4.0 + 6.0 * np.sin(0.01), 6.0 * np.cos(0.01)]
    np.testing.assert_allclose(pose.vertex, wanted, atol=1e-13)


def test_two_own_joints_of_many_mechanisms_keep_their_rows() -> None:
    places = [(0.0, 50.0, 0.0), (10.0, 50.0, 0.0)]
    many = kinds.azimuth_elevation(places, pivot_height=1.5)
    many = kinds.with_joint(many, "yoke", (0.0, 1.0, 0.0), after="azimuth", prior=2e-3)
    many = kinds.with_joint(
        many, "foot", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)], after="tilt_north", prior=1e-3
    )
    moved = many.with_parameters({"yoke": [0.01, 0.02], "foot": 0.005})
    assert moved.parameter("yoke").prior == 2e-3
    np.testing.assert_allclose(moved.angles[:, moved.joints.index("yoke")], [0.01, 0.02])
    np.testing.assert_allclose(moved.angles[:, moved.joints.index("foot")], 0.005)
    assert moved == moved[np.array([0, 1])]
    assert [moved.joints[d] for d in moved.driven] == ["azimuth", "elevation"]
    np.testing.assert_allclose(
        moved[1].pose([0.3, 0.4]).normal, moved.pose([0.3, 0.4]).normal[1], atol=1e-15
    )


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"after": "azimut"}, "did you mean azimuth"),
        ({"name": "canting"}, "own joint 'canting': choose a new name"),
        ({"name": "sag"}, "own joint 'sag': choose a new name"),
        ({"name": "two words"}, "choose a new name of letters"),
        ({"axis": (0.0, 0.0, 0.0)}, "axis of bend"),
        ({"prior": 0.0}, "prior of bend"),
        ({"prior": 2.0}, "give radians"),
        ({"axis": np.ones((3, 3))}, r"axis \(3, 3\)"),
    ],
)
def test_a_wrong_own_joint_is_refused(changes: dict[str, object], text: str) -> None:
    given: dict[str, object] = {"name": "bend", "axis": (1.0, 0.0, 0.0), "after": "azimuth"}
    given |= {"prior": 1e-3} | changes
    with pytest.raises(InputError, match=text):
        kinds.with_joint(every_kind()["azimuth_elevation"], **given)  # type: ignore[arg-type]
