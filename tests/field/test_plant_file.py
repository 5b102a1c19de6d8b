"""The plant file: what is written is read again, digit for digit."""

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from heliotrope.errors import FormatError, InputError
from heliotrope.field.coded_visits import JointSettings, ReceiverSettings
from heliotrope.field.example import example_plant
from heliotrope.field.formats import paint, plant_file
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.layouts import malan_plant
from heliotrope.field.plant import Plant
from heliotrope.field.stellenbosch import prototype
from heliotrope.field.target import Receiver, Target
from heliotrope.field.volumes import Box, Cylinder, Prism, Sphere
from heliotrope.geometry import direction
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.machine import AxisLimits, Machine
from heliotrope.mechanism.tracking import track
from heliotrope.plant.field.aims import BeamCheck
from heliotrope.sun import Site
from support.data import juelich
from support.machines import every_kind, imperfect

ROOT = Path(__file__).parents[2]


def _same(a: Plant, b: Plant) -> None:
    assert (a.name, a.site) == (b.name, b.site)
    assert list(a.groups) == list(b.groups)
    for name, mine in a.groups.items():
        other = b.groups[name]
        assert mine.names == other.names
        assert mine.cluster == other.cluster
        assert (mine.width == other.width).all()
        m, n = mine.mechanism, other.mechanism
        assert (m.kind, m.joints, m.driven) == (n.kind, n.joints, n.driven)
        for key in ("position", "orientation", "axes", "origins", "angles", "vertex", "normal"):
            assert (getattr(m, key) == getattr(n, key)).all(), key
        assert (m.drives.table == n.drives.table).all()
        assert set(mine.parameters) == set(other.parameters)
        for key, values in mine.parameters.items():
            assert (values == other.parameters[key]).all()
        if mine.facets is None:
            assert other.facets is None
        else:
            assert other.facets is not None
            assert (mine.facets.center == other.facets.center).all()
            assert (mine.facets.half_width == other.facets.half_width).all()
    for t, u in zip(a.targets, b.targets, strict=True):
        assert t.name == u.name
        assert (t.corners == u.corners).all()
        assert (t.center == u.center).all()
        assert {k: v.tolist() for k, v in t.markers.items()} == {
            k: v.tolist() for k, v in u.markers.items()
        }
    for r, s in zip(a.receivers, b.receivers, strict=True):
        assert (r.name, r.kind, r.width, r.radius) == (s.name, s.kind, s.width, s.radius)
        assert (r.normal == s.normal).all()


@pytest.mark.parametrize("table", ["csv", "parquet"])
def test_every_kind_survives(table: str, tmp_path: Path) -> None:
    groups = {}
    for kind, one in every_kind().items():
        field = imperfect(_spread(one, 3), seed=1)
        field = replace(field, position=field.position + [0.0, 10.0 * len(groups), 0.0])
        rng = np.random.default_rng(2)
        groups[kind] = Heliostats(
            tuple(f"{kind}-{i}" for i in range(3)),
            field,
            np.full(3, 1.7),
            np.full(3, 1.1),
            parameters={"tilt_north": rng.normal(0, 1e-3, 3)}
            if "tilt_north" in field.parameters
            else {},
        )
    plant = Plant("mixed", Site(37.1, -2.3, 500.0), groups)
    plant_file.write_plant(plant, tmp_path / "plant.toml", table)  # type: ignore[arg-type]
    _same(plant, plant_file.read_plant(tmp_path / "plant.toml"))
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"plant.{table}", "plant.toml"] or table


def test_single_axis_trackers_are_a_kind_of_a_plant_file(tmp_path: Path) -> None:
    text = """format = "heliotrope-plant"
version = 1
heliostats = "p.csv"
[plant]
name = "troughs"
[site]
latitude_deg = 37
longitude_deg = -2
[groups.t]
kind = "single_axis"
axis = [0, 1, 0]
mirror_width_m = 2
mirror_height_m = 8
pivot_height_m = 0.5
vertex_m = [0, 0, 0.2]
[groups.t.drives.rotation]
kind = "direct"
min_angle_deg = -95
max_angle_deg = 95
"""
    path = tmp_path / "p.toml"
    path.write_text(text)
    (tmp_path / "p.csv").write_text("name,group,east_m,north_m,up_m\nA,t,8,0,0\n")
    found = plant_file.read_plant(path)["A"]
    wanted = kinds.single_axis((8, 0, 0), (0, 1, 0), pivot_height=0.5, vertex=(0, 0, 0.2))
    sun, aim = direction(2.0, 0.7), (0.0, 0.0, 10.0)
    one, other = track(found, sun, aim), track(wanted, sun, aim)
    assert one.reachable
    np.testing.assert_allclose(one.best_angles, other.best_angles, rtol=0, atol=1e-12)
    path.write_text(text.replace("axis = [0, 1, 0]\n", ""))
    with pytest.raises(FormatError, match="axis is missing; kind single_axis needs it"):
        plant_file.read_plant(path)
    gear = "kind = 'rotary'\nzero_deg = 0\n"
    path.write_text(text.replace('kind = "direct"\n', gear))
    message = "t.drives.rotation.rotary: 'steps_per_turn', 'gear_ratio' are missing; add them"
    with pytest.raises(FormatError, match=message):
        plant_file.read_plant(path)
    machine = "[groups.t.machine]\nstow_deg = [0, 0]\n[groups.t.machine.axes.rotation]\n"
    path.write_text(f"{text}{machine}acceleration_steps_per_s2 = 100\nbacklash_steps = 0\n")
    with pytest.raises(FormatError, match="local controllers drive two joints"):
        plant_file.read_plant(path)


def _spread(one: Mechanism, count: int) -> Mechanism:
    return one[None][np.zeros(count, dtype=np.intp)]


@given(
    st.lists(
        st.tuples(*[st.floats(-900, 900)] * 3),
        min_size=1,
        max_size=5,
        unique_by=lambda place: tuple(np.round(np.array(place) / 0.01)),
    ),
    st.floats(-89, 89),
    st.floats(-0.2, 0.2),
    st.floats(-0.05, 0.05),
)
def test_any_field_survives(tmp_path_factory, places, latitude, tilt, offset) -> None:  # type: ignore[no-untyped-def]
    folder = tmp_path_factory.mktemp("plant")
    mechanism = kinds.azimuth_elevation(np.array(places), pivot_offset=offset)
    mechanism = mechanism.with_parameters({"tilt_east": tilt / 7})
    names = tuple(f"H{i}" for i in range(len(places)))
    heliostats = Heliostats(
        names,
        mechanism,
        np.full(len(names), 2.0),
        np.full(len(names), 1.0),
        parameters={"canting": np.full(len(names), tilt / 3)},
    )
    plant = Plant("any", Site(latitude, 10.0, 12.5), {"g": heliostats})
    plant_file.write_plant(plant, folder / "p.toml")
    _same(plant, plant_file.read_plant(folder / "p.toml"))


def test_examples_and_juelich_survive(tmp_path: Path) -> None:
    for plant in (example_plant(), prototype(), paint.read_plant(juelich())):
        plant_file.write_plant(plant, tmp_path / "plant.toml")
        _same(plant, plant_file.read_plant(tmp_path / "plant.toml"))
        assert not [
            f for f in plant_file.check_plant(tmp_path / "plant.toml") if f.severity == "error"
        ]


KEEP_OUT = """
[[keep_out]]
name = "control room"
kind = "box"
center_m = [20, -60, 3]
size_m = [12, 8, 6]
azimuth_deg = 30

[[keep_out]]
name = "mast"
kind = "cylinder"
start_m = [0, 0, 0]
end_m = [0, 0, 60]
radius_m = 1.5

[[keep_out]]
name = "walkway"
kind = "prism"
corners_m = [[-5, -20], [5, -20], [5, -18], [-5, -18]]
bottom_m = 4
top_m = 8

[[keep_out]]
name = "drone"
kind = "sphere"
center_m = [50, 0, 80]
radius_m = 10

[eyes_m]
gate = [0, 120, 1.7]
"""


def with_text(folder: Path, text: str) -> Path:
    """The prototype's file with more at its end."""
    path = folder / "plant.toml"
    plant_file.write_plant(example_plant(), path)
    lines = path.read_text(encoding="utf-8").splitlines()
    kept = [line for line in lines if not line.startswith(("keep_out =", "[eyes_m]"))]
    path.write_text("\n".join(kept) + text, encoding="utf-8")
    return path


def test_the_parameter_of_an_own_joint_is_refused(tmp_path: Path) -> None:
    """Written, it would make a file that cannot be read."""
    plant = example_plant()
    (name,) = plant.groups
    group = plant.groups[name]
    mast = kinds.with_joint(group.mechanism, "mast_north", (-1.0, 0.0, 0.0), prior=0.01)
    still = replace(plant, groups={name: replace(group, mechanism=mast)})
    plant_file.write_plant(still, tmp_path / "plant.toml")
    again = plant_file.read_plant(tmp_path / "plant.toml").groups[name].mechanism
    assert again.joints[0] == "mast_north"
    leaning = replace(
        still, groups={name: still.groups[name].with_parameters({"mast_north": 0.01})}
    )
    with pytest.raises(InputError, match="parameter mast_north belongs to a user-defined joint"):
        plant_file.write_plant(leaning, tmp_path / "leaning.toml")
    assert not (tmp_path / "leaning.toml").exists()


def test_keep_out_volumes_and_eyes_are_read_and_survive(tmp_path: Path) -> None:
    plant = plant_file.read_plant(with_text(tmp_path, KEEP_OUT))
    room, mast, walkway, drone = plant.keep_outs
    assert isinstance(room, Box)
    assert room.azimuth == np.radians(30)
    assert isinstance(mast, Cylinder)
    assert isinstance(walkway, Prism)
    assert (walkway.bottom, walkway.top) == (4.0, 8.0)
    assert isinstance(drone, Sphere)
    assert plant.eyes["gate"].tolist() == [0.0, 120.0, 1.7]
    plant_file.write_plant(plant, tmp_path / "again.toml")
    again = plant_file.read_plant(tmp_path / "again.toml")
    assert str(again.keep_outs) == str(plant.keep_outs)
    assert str(again.eyes) == str(plant.eyes)
    # The plant's controller takes them from there.
    check = BeamCheck(again, again.names)
    assert check.volumes == again.keep_outs
    assert check.eyes.tolist() == [[0.0, 120.0, 1.7]]


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        ('kind = "sphere"', 'kind = "ball"', "keep_out.3: "),
        ("radius_m = 10", "radius_m = 0", "keep_out.3.sphere.radius_m: 0: input should be greater"),
        ("radius_m = 1.5", "radius = 1.5", "keep_out.1.cylinder.radius"),
        (
            "end_m = [0, 0, 60]",
            "end_m = [0, 0, 0]",
            "keep_out[1]: volume mast: its two ends coincide",
        ),
        (
            "top_m = 8",
            "top_m = 2",
            "keep_out[2]: volume walkway: top (2 m) must be above bottom (4 m)",
        ),
        ('name = "mast"', 'name = "walkway"', "keep-out volume walkway: the name occurs twice"),
        ("gate = [0, 120, 1.7]", "gate = [0, 120]", "eyes_m.gate: "),
    ],
)
def test_what_is_no_volume_is_one_clear_line(
    before: str, after: str, text: str, tmp_path: Path
) -> None:
    assert before in KEEP_OUT
    path = with_text(tmp_path, KEEP_OUT.replace(before, after))
    with pytest.raises(FormatError) as caught:
        plant_file.read_plant(path)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_by_hand_is_as_built(tmp_path: Path) -> None:
    (tmp_path / "plant.toml").write_text(
        """
format = "heliotrope-plant"
version = 1
heliostats = "field.csv"
plant = {name = "hand"}
site = {latitude_deg = 37.1, longitude_deg = -2.3, height_m = 500}
[groups.jacks]
kind = "two_jacks"
mirror_width_m = 3.2
mirror_height_m = 2.5
concentrator_translation_m = [0, 0.175, 0]
[groups.jacks.drives.elevation]
kind = "linear"
increment_per_m = 154166.6667
offset_m = 0.335
pivot_radius_m = 0.338
initial_angle_deg = -87.8
clockwise = 0
[groups.jacks.drives.azimuth]
kind = "linear"
increment_per_m = 154166.6667
initial_stroke_length_m = 0.0775
offset_m = 0.34
pivot_radius_m = 0.319
initial_angle_rad = 0.94
max_count = 75000
""",
        encoding="utf-8",
    )
    (tmp_path / "field.csv").write_text(
        "name,group,east_m,north_m,up_m,drives.elevation.initial_stroke_length_m\n"
        "A,jacks,1,2,3,0.0774\nB,jacks,4,5,6,0.0785\n",
        encoding="utf-8",
    )
    plant = plant_file.read_plant(tmp_path / "plant.toml")
    from heliotrope.mechanism.drives import SLOTS, linear_paint

    table = plant.groups["jacks"].mechanism.drives.table
    assert table[:, 0, SLOTS["stroke_offset"]].tolist() == [0.0774, 0.0785]
    wanted = linear_paint(154166.6667, 0.0785, 0.335, 0.338, np.radians(-87.8), clockwise=0)
    assert (table[1, 0] == wanted.table).all()
    assert table[0, 1, SLOTS["max_count"]] == 75000


MACHINE = """
[groups.azel.machine]
stow_deg = [90, 88]
defocus_mrad = [100, 50]
defocus_spread = 0
standby_m = [12, 0, 40]
leaves_stow_first = "elevation"
way_m = [[20, -25, 0], [12, 0, 5]]
[groups.azel.machine.axes.azimuth]
rate_steps_per_s = 8000
acceleration_steps_per_s2 = 16000
backlash_steps = 40
min_steps = -222222
max_steps = 222222
[groups.azel.machine.axes.elevation]
acceleration_steps_per_s2 = 9000
backlash_steps = 0
max_deg = 93.6
"""
GEAR = """
kind = "rotary"
steps_per_turn = 200
microsteps = 4
gear_ratio = 500
speed_counts_per_s = 5000
min_angle_deg = -3.6
"""


def with_machine(folder: Path, text: str = MACHINE, column: str = "", values: str = "") -> Path:
    """A plant of two heliostats whose local controllers are to store what ``text`` says."""
    more = [f",{word}" if word else "" for word in (column, *(values.split() or ["", ""]))]
    rows = ("name,group,east_m,north_m,up_m", "A1,azel,0,-30,0", "A2,azel,10,-30,0")
    table = "".join(f"{row}{end}\n" for row, end in zip(rows, more, strict=True))
    (folder / "field.csv").write_text(table)
    path = folder / "plant.toml"
    path.write_text(
        f"""
format = "heliotrope-plant"
version = 1
heliostats = "field.csv"
plant = {{name = "machines"}}
site = {{latitude_deg = -33.9, longitude_deg = 18.9}}
[groups.azel]
kind = "azimuth_elevation"
mirror_width_m = 2
mirror_height_m = 1
[groups.azel.drives.azimuth]{GEAR}[groups.azel.drives.elevation]{GEAR}{text}""",
        encoding="utf-8",
    )
    return path


def test_machine_of_a_group(tmp_path: Path) -> None:
    plant = plant_file.read_plant(with_machine(tmp_path))
    # 400,000 steps to a turn; the elevation has its rate and its lower stop from the drive.
    machine = Machine(
        (AxisLimits(-222222, 222222, 8000, 16000, 40), AxisLimits(-4000, 104000, 5000, 9000, 0)),
        (100_000, 97_778),
        (0.1, 0.05),
        (12.0, 0.0, 40.0),
        1,
        ((20.0, -25.0, 0.0), (12.0, 0.0, 5.0)),
    )
    assert plant.groups["azel"].machines == (machine, machine)
    assert plant.machine("A2") == machine
    plant_file.write_plant(plant, tmp_path / "again.toml")
    assert plant_file.read_plant(tmp_path / "again.toml").machine("A1") == machine


def test_a_defocus_that_takes_too_long_is_refused(tmp_path: Path) -> None:
    slow = MACHINE.replace("rate_steps_per_s = 8000", "rate_steps_per_s = 600")
    assert slow != MACHINE
    plant_file.read_plant(with_machine(tmp_path, slow))
    with pytest.raises(
        FormatError,
        match=r"of heliostat A\d needs \d\d s to turn away by \d+\.\d°, but has only 20 s",
    ):
        plant_file.read_plant(
            with_machine(tmp_path, slow.replace("defocus_spread = 0", "defocus_spread = 4"))
        )


@pytest.mark.parametrize(("key", "most"), [("", 2.0), ("defocus_spread = 2.5", 3.5)])
def test_mirrors_turn_away_by_angles_of_their_own(key: str, most: float, tmp_path: Path) -> None:
    text = MACHINE.replace("defocus_spread = 0", f"{key}\nstow_lights = true")
    plant = plant_file.read_plant(with_machine(tmp_path, text))
    one, two = (plant.machine(name) for name in ("A1", "A2"))
    assert one.defocus != two.defocus
    assert one.stow_lights
    for machine in (one, two):
        assert 0.1 <= machine.defocus[0] <= most * 0.1
        assert 0.05 <= machine.defocus[1] <= most * 0.05
    # What is written holds each mirror's angles, and reads as it was.
    plant_file.write_plant(plant, tmp_path / "again.toml")
    again = plant_file.read_plant(tmp_path / "again.toml")
    assert (again.machine("A1"), again.machine("A2")) == (one, two)


def test_machine_of_each_heliostat(tmp_path: Path) -> None:
    path = with_machine(tmp_path, column="machine.axes.azimuth.max_steps", values="200000 210000")
    plant = plant_file.read_plant(path)
    assert [plant.machine(name).axes[0].high for name in ("A1", "A2")] == [200_000, 210_000]
    plant_file.write_plant(plant, tmp_path / "again.toml")
    again = plant_file.read_plant(tmp_path / "again.toml")
    assert again.groups["azel"].machines == plant.groups["azel"].machines
    assert again.groups["azel"].take([1]).machines == (plant.machine("A2"),)


def test_group_without_a_machine_reads_and_is_refused_where_one_is_needed(tmp_path: Path) -> None:
    plant = plant_file.read_plant(with_machine(tmp_path, ""))
    assert plant.groups["azel"].machines == ()
    with pytest.raises(InputError, match=r"group azel: .* no table \[groups.azel.machine\]; add"):
        plant.machine("A1")
    with pytest.raises(FormatError, match=r"columns machine\.… need this table; add it"):
        plant_file.read_plant(with_machine(tmp_path, "", "machine.stow_steps.0", "1 2"))


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        ("stow_deg = [90, 88]", "", "set either stow_steps or stow_deg"),
        ("stow_deg = [90, 88]", "stow_deg = [90, 100]", "stow at 111111 steps of the secondary"),
        ("defocus_mrad", "defocus_rad", "defocus by 5.73e+03°; one axis must turn by 1.15°"),
        ("defocus_mrad = [100, 50]", "", "set one of defocus_deg, defocus_mrad, defocus_rad"),
        ("rate_steps_per_s = 8000", "rate_steps_per_s = 20000", "controller emits at most 10000"),
        ("backlash_steps = 40", "", "groups.azel.machine.axes.azimuth.backlash_steps"),
        ("max_deg = 93.6", "", "max_deg is missing; its drive does not define it"),
        (
            "max_steps = 222222",
            "max_steps = 222222\nmax_deg = 1",
            "in steps and in degrees; keep one",
        ),
        ("max_steps = 222222", "max_steps = -222222", "the low end (-222222 steps) must be below"),
        (
            "axes.elevation]",
            "axes.roll]",
            "azimuth, roll; specify those of azimuth and elev",
        ),
        ('"elevation"', '"roll"', "'roll' is not a driven joint"),
        ("standby_m = [12, 0, 40]", "standby_m = [12, 0]", "groups.azel.machine.standby_m"),
    ],
)
def test_machine_that_cannot_be_is_one_line(
    before: str, after: str, text: str, tmp_path: Path
) -> None:
    assert before in MACHINE
    path = with_machine(tmp_path, MACHINE.replace(before, after, 1))
    with pytest.raises(FormatError) as caught:
        plant_file.read_plant(path)
    assert text in str(caught.value)
    assert "groups.azel" in str(caught.value)
    assert "\n" not in str(caught.value)


JOINT = """
[joint_visits]
most = 25
known_mrad = 3
settle_s = 1.5
brightest_suns = 6
"""


def test_joint_visits_are_read_and_survive(tmp_path: Path) -> None:
    plant = plant_file.read_plant(with_machine(tmp_path, MACHINE + JOINT))
    settings = JointSettings(most=25, known=0.003, settle=1.5, brightest=6.0)
    assert plant.joint_visits == settings
    plant_file.write_plant(plant, tmp_path / "again.toml")
    assert plant_file.read_plant(tmp_path / "again.toml").joint_visits == settings
    for one in fields(JointSettings):
        # An odd value, which thousandths would round.
        value = getattr(JointSettings(), one.name)
        odd = JointSettings(**{one.name: value + (1 if isinstance(value, int) else value / 7)})
        plant_file.write_plant(replace(plant, joint_visits=odd), tmp_path / "odd.toml")
        assert plant_file.read_plant(tmp_path / "odd.toml").joint_visits == odd
    plant_file.write_plant(replace(plant, joint_visits=None), tmp_path / "alone.toml")
    assert plant_file.read_plant(tmp_path / "alone.toml").joint_visits is None
    (tmp_path / "new").mkdir()
    assert plant_file.read_plant(with_machine(tmp_path / "new")).joint_visits == JointSettings()


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        (
            "most = 25",
            "most = 200",
            "joint_visits: joint visits: most (maximum number of heliostats on one",
        ),
        ("most = 25", "most = 2.5", "joint_visits.most: "),
        ("known_mrad = 3", "known_mrad = 0", "known_mrad (largest"),
        ("known_mrad = 3", "known = 3", "joint_visits.known: "),
        ("most = 25", "known_rad = 0.003", "known is set twice, the second time as known_rad"),
    ],
)
def test_joint_visits_that_cannot_be_are_one_line(
    before: str, after: str, text: str, tmp_path: Path
) -> None:
    assert before in JOINT
    path = with_machine(tmp_path, MACHINE + JOINT.replace(before, after))
    with pytest.raises(FormatError) as caught:
        plant_file.read_plant(path)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


SAFETY = """
[safety.wind_gust_stow]
trips_m_s = 18
releases_m_s = 14.5

[safety.pointing_disagrees]
trips_mrad = 2.5
"""


def test_limits_of_the_site_are_read_checked_and_survive(tmp_path: Path) -> None:
    path = with_machine(tmp_path, MACHINE + SAFETY)
    plant = plant_file.read_plant(path)
    given = {
        "wind_gust_stow": {"trips_m_s": 18.0, "releases_m_s": 14.5},
        "pointing_disagrees": {"trips_mrad": 2.5},
    }
    assert plant.safety == given
    assert not [f for f in plant_file.check_plant(path) if f.severity == "error"]
    plant_file.write_plant(plant, tmp_path / "again.toml")
    assert plant_file.read_plant(tmp_path / "again.toml").safety == given
    with pytest.raises(InputError, match=r"trips_m_s must be between 5 and 30, not 45"):
        replace(plant, safety={"wind_gust_stow": {"trips_m_s": 45.0}})


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        ("trips_m_s = 18", "trips_m_s = 45", "safety: wind_gust_stow.trips_m_s must be between 5"),
        ("trips_m_s = 18", "trips = 18", "wind_gust_stow.trips is not known; did you mean trips_m"),
        ("trips_m_s = 18", "trips_m_s = 14", "must be below the trip at 14 m/s; set trips"),
        ("trips_m_s = 18", 'trips_m_s = "a"', "safety.wind_gust_stow.trips_m_s: 'a': input should"),
        (
            "wind_gust_stow",
            "wind_gust",
            "safety: wind_gust: no such condition is in this table; did ",
        ),
        (
            "wind_gust_stow",
            "cluster_silent",
            "cluster_silent: its limits cannot be set in a plant file, because",
        ),
    ],
)
def test_limits_of_the_site_that_cannot_be_are_one_line(
    before: str, after: str, text: str, tmp_path: Path
) -> None:
    path = with_machine(tmp_path, MACHINE + SAFETY.replace(before, after))
    with pytest.raises(FormatError) as caught:
        plant_file.read_plant(path)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)
    assert [f.text for f in plant_file.check_plant(path)] == [str(caught.value)]


def test_warnings_of_check(tmp_path: Path) -> None:
    near = kinds.azimuth_elevation(np.array([[0.0, -30, 0], [0.5, -30, 0], [0, 40, 0]]))
    heliostats = Heliostats(("A", "B", "C"), near, np.full(3, 2.0), np.full(3, 2.0))
    target = example_plant().targets
    plant_file.write_plant(
        Plant("w", Site(0.0, 0.0, 0.0), {"g": heliostats}, target), tmp_path / "p.toml"
    )
    texts = [f.text for f in plant_file.check_plant(tmp_path / "p.toml")]
    assert any("no receiver" in t for t in texts)
    assert any("1 pairs of mirrors can touch: the nearest, A and B" in t for t in texts)
    assert any("1 of 3 heliostats are behind its plane" in t for t in texts)


def receiver_document(folder: Path, more: str = "") -> Path:
    """A plant file with a located camera and settings of receiver visits."""
    plant = malan_plant(2)
    settings = ReceiverSettings("camera-left", "receiver", most=30)
    plant_file.write_plant(replace(plant, receiver_visits=settings), folder / "plant.toml")
    path = folder / "plant.toml"
    text = path.read_text(encoding="utf-8")
    assert text.count("most = 30") == 1
    path.write_text(text.replace("most = 30", f"most = 30\n{more}"), encoding="utf-8")
    return path


def test_receiver_visits_are_read_and_survive(tmp_path: Path) -> None:
    path = receiver_document(tmp_path, "worth_mrad = 0.2")
    plant = plant_file.read_plant(path)
    usual = ReceiverSettings("camera-left", "receiver")
    assert plant.receiver_visits == replace(usual, most=30, worth=2e-4)
    for one in fields(ReceiverSettings):
        value = getattr(usual, one.name)
        if not isinstance(value, str):
            changed = value + (1 if isinstance(value, int) else value / 7)
            odd = replace(usual, **{one.name: changed})
            plant_file.write_plant(replace(plant, receiver_visits=odd), tmp_path / "odd.toml")
            assert plant_file.read_plant(tmp_path / "odd.toml").receiver_visits == odd
    plant_file.write_plant(replace(plant, receiver_visits=None), tmp_path / "none.toml")
    assert plant_file.read_plant(tmp_path / "none.toml").receiver_visits is None


@pytest.mark.parametrize(
    ("more", "text"),
    [
        (
            "power = 0.02",
            "receiver_visits: receiver visits: power (largest fraction of the power",
        ),
        ("movement = 1", "receiver_visits.movement: "),
        ("worth_mrad = 1\nworth_rad = 0.001", "worth is set twice"),
    ],
)
def test_receiver_visits_that_cannot_be_are_one_line(more: str, text: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError) as caught:
        plant_file.read_plant(receiver_document(tmp_path, more))
    assert text in str(caught.value)


def test_schema_in_the_docs_is_current() -> None:
    stored = json.loads((ROOT / "docs/reference/plant.schema.json").read_text(encoding="utf-8"))
    assert stored == plant_file.json_schema()


def test_nothing_half_written(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        plant_file.write_plant(example_plant(), tmp_path / "nowhere" / "plant.toml")
    plant_file.write_plant(example_plant(), tmp_path / "folder" / "plant.toml")
    assert sorted(p.name for p in (tmp_path / "folder").iterdir()) == ["plant.csv", "plant.toml"]


def test_example_plant() -> None:
    plant = example_plant()
    assert len(plant) == 18
    assert len(set(plant.groups["azel"].cluster)) == 6
    group, row = plant.find("P6A")
    np.testing.assert_array_equal(group.position[row], [19.2, -30.8, 0.0])
    assert plant.targets[0].normal == pytest.approx([0.0, -1.0, 0.0])


# --- the arrays themselves ----------------------------------------------------------------

ONE = kinds.azimuth_elevation(np.zeros((2, 3)))
CORNERS = example_plant().targets[0].corners


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Heliostats(("A",), ONE, np.ones(1), np.ones(1)), "1 names but mechanisms"),
        (lambda: Heliostats(("A", "A"), ONE, np.ones(2), np.ones(2)), "the name occurs twice"),
        (lambda: Heliostats(("A", ""), ONE, np.ones(2), np.ones(2)), "a name is empty"),
        (
            lambda: Heliostats(("A", "B"), ONE, np.zeros(2), np.ones(2)),
            "heliostat A: width must be above 0",
        ),
        (
            lambda: Heliostats(
                ("A", "B"),
                ONE,
                np.ones(2),
                np.ones(2),
                parameters={"canting": np.array([0, np.nan])},
            ),
            "B: parameter canting",
        ),
        (lambda: Target("t", CORNERS[:3], CORNERS[0]), "must have the shapes"),
        (lambda: Target("t", CORNERS * [1, 0, 0], CORNERS[0]), "span no area"),
        (lambda: Receiver("r", "flat", CORNERS[0], CORNERS[1], 1.0, 1.0), "kind 'flat'; known"),
        (
            lambda: Receiver("r", "planar", CORNERS[0], CORNERS[1], -1.0, 1.0),
            "width must be above 0 and finite",
        ),
        (lambda: example_plant()["P9Z"].calibrated, "there is no heliostat 'P9Z'"),
        (lambda: example_plant().target("tower"), "there is no target 'tower'"),
    ],
)
def test_guards(make, text: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InputError, match=text):
        make()


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"center": (-19.0, -20.0, 1.0)}, "receiver receiver: its centre is 0."),
        ({"center": (0.0, 0.0, -16.5)}, "its centre, -16.50 m up, is below every heliostat"),
        ({"normal": (0.0, 1.0, 0.0)}, "18 of 18 heliostats are behind its plane"),
        ({"center": (0.0, 0.0, 13.0)}, "target and receiver have the same centre"),
    ],
)
def test_check_names_a_receiver_that_cannot_be_meant(
    changed: dict[str, Any], says: str, tmp_path: Path
) -> None:
    plant = example_plant()
    (receiver,) = plant.receivers
    if says.startswith("receiver"):
        changed = {"center": plant.position[0] + (0.0, 0.0, 0.5)}
    plant_file.write_plant(
        replace(plant, receivers=(replace(receiver, **changed),)), tmp_path / "p.toml"
    )
    texts = [f.text for f in plant_file.check_plant(tmp_path / "p.toml")]
    assert [text for text in texts if says in text], texts


def test_check_names_a_target_that_stands_on_its_head(tmp_path: Path) -> None:
    plant = example_plant()
    (target,) = plant.targets
    turned = replace(target, corners=target.corners[[2, 3, 0, 1]])
    plant_file.write_plant(replace(plant, targets=(turned,)), tmp_path / "p.toml")
    texts = [f.text for f in plant_file.check_plant(tmp_path / "p.toml")]
    assert any("its upper corners lie below its lower ones" in text for text in texts), texts


def test_an_aim_point_beside_its_target_is_refused() -> None:
    (target,) = example_plant().targets
    with pytest.raises(InputError, match=r"its center lies 17\.00 m from the middle"):
        replace(target, center=target.center + (0.0, 0.0, 17.0))


def test_the_power_that_flux_readings_refer_to_is_kept(tmp_path: Path) -> None:
    plant = example_plant()
    (receiver, *more) = plant.receivers
    known = replace(plant, receivers=(replace(receiver, nominal_power=2.5e6), *more))
    plant_file.write_plant(known, tmp_path / "plant.toml")
    assert "nominal_power_mw = 2.5" in (tmp_path / "plant.toml").read_text(encoding="utf-8")
    assert plant_file.read_plant(tmp_path / "plant.toml").receivers[0].nominal_power == 2.5e6
    text = (tmp_path / "plant.toml").read_text(encoding="utf-8").replace("_mw = 2.5", "_mw = -1.0")
    (tmp_path / "plant.toml").write_text(text, encoding="utf-8")
    with pytest.raises(FormatError, match="nominal_power_mw"):
        plant_file.read_plant(tmp_path / "plant.toml")
