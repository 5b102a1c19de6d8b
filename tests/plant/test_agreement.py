"""A wrong clock, site, sun or parameter shows, although every tier below the plant is content."""

from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest

from heliotrope.field.example import example_plant
from heliotrope.field.layouts import lay_out
from heliotrope.field.plant import Plant
from heliotrope.lcu import states
from heliotrope.lcu.names import FLAGS
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Emergency
from heliotrope.mechanism.board_items import items_of
from heliotrope.mechanism.tracking import track
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.safety import Act
from heliotrope.sun import fast_vector
from support.plant_bench import OPERATOR, Bench, running

DESIGN = example_plant()
AIM = (2.0, 0.0, 15.0)
NAME = "P5A"


def play(folder: Path, scene: Callable[[Bench], Awaitable[None]], design: Plant = DESIGN) -> Bench:
    """Run a scene in virtual time."""
    made: list[Bench] = []

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, folder, design=design)
        made.append(bench)
        async with running(bench):
            await scene(bench)

    run_virtual(main)
    return made[0]


def alarmed(bench: Bench, condition: str) -> set[str]:
    """The subjects of an alarm that has not ended."""
    last = {a.subject: a.active for a in bench.plant.alarms if a.condition == condition}
    return {name for name, active in last.items() if active}


async def tracking(bench: Bench) -> int:
    """Bring a heliostat to its aim; return the token."""
    token = await bench.commanded()
    assert await bench.plant.aim(OPERATOR, token, {NAME: AIM}).end(5.0)
    bench.cluster_of(NAME).set(states.IDLE, NAME)
    await bench.wait(2.0)
    assert await bench.plant.command(OPERATOR, token, "TRACK", (NAME,)).end(30.0)
    return token


def steps_at(bench: Bench, late: float, east: float = 0.0) -> list[int]:
    """The step counts of a heliostat whose sun is late, or that of a place further east."""
    plant = bench.plant
    site = replace(DESIGN.site, longitude_deg=DESIGN.site.longitude_deg + east)
    sun = fast_vector(bench.clock.utc().timestamp() - late, site)
    group, row = DESIGN.find(NAME)
    found = track(group.mechanism[row], sun, plant.aims[plant.field.place(NAME)])
    return [round(float(x)) for x in found.best_counts]


async def go(bench: Bench, seconds: int, late: float, east: float = 0.0) -> None:
    """Let the heliostat follow a wrong sun for some seconds."""
    cluster = bench.cluster_of(NAME)
    row = cluster.names.index(NAME)
    for _ in range(seconds):
        for axis, value in zip(("primary", "secondary"), steps_at(bench, late, east), strict=True):
            cluster.rows[axis][row] = cluster.rows[f"{axis}_goal"][row] = value
        bench.plant.authority.keep(OPERATOR, bench.plant.authority.token)
        await bench.wait(1.0)


@pytest.mark.parametrize("late", [-600.0, 5.0, 3600.0])
def test_a_cluster_with_a_wrong_clock_is_named_and_defocused(late: float, tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        cluster = bench.cluster_of(NAME)
        assert not alarmed(bench, "cluster_time_differs")
        cluster.late = late
        took = await bench.until(lambda: bool(cluster.of(Emergency)), 10.0)
        assert took < 7.0
        assert alarmed(bench, "cluster_time_differs") == {cluster.name}
        token = await bench.commanded()
        with pytest.raises(RefusedError, match=r"differs from the plant's by"):
            bench.plant.command(OPERATOR, token, "APPROACH", (NAME,))
        cluster.late = 0.2
        await bench.wait(15.0)
        assert not alarmed(bench, "cluster_time_differs")

    bench = play(tmp_path, scene)
    sent = [(c.name, m.name) for c in bench.clusters.values() for m in c.of(Emergency)]
    assert set(sent) == {(bench.cluster_of(NAME).name, "DEFOCUS")}


@pytest.mark.parametrize(
    ("site", "wrong"),
    [
        (DESIGN.site, False),
        (replace(DESIGN.site, longitude_deg=DESIGN.site.longitude_deg + 1e-3), False),
        (replace(DESIGN.site, longitude_deg=DESIGN.site.longitude_deg + 2.5), True),
        (replace(DESIGN.site, latitude_deg=-DESIGN.site.latitude_deg), True),
        (None, True),
    ],
)
def test_a_cluster_with_a_wrong_site_is_named_and_defocused(
    site: object, wrong: bool, tmp_path: Path
) -> None:
    async def scene(bench: Bench) -> None:
        cluster = bench.cluster_of(NAME)
        cluster.site = (1.0, 2.0) if site is None else site.numbers  # type: ignore[attr-defined]
        await bench.wait(8.0)
        assert alarmed(bench, "cluster_site_differs") == ({cluster.name} if wrong else set())
        assert bool(cluster.of(Emergency)) == wrong

    play(tmp_path, scene)


@pytest.mark.parametrize(("late", "east"), [(600.0, 0.0), (-90.0, 0.0), (0.0, 2.5)])
def test_a_heliostat_that_follows_a_wrong_sun_is_named_and_defocused(
    late: float, east: float, tmp_path: Path
) -> None:
    async def scene(bench: Bench) -> None:
        plant, cluster = bench.plant, bench.cluster_of(NAME)
        token = await tracking(bench)
        await go(bench, 6, 0.0)
        assert not alarmed(bench, "pointing_disagrees")
        await go(bench, 8, late, east)
        assert alarmed(bench, "pointing_disagrees") == {NAME}
        assert [m.heliostats for m in cluster.of(Emergency)] == [(NAME,)]
        # It may not join again before somebody has looked.
        await bench.wait(5.0)
        cluster.set(states.IDLE, NAME)
        for axis in ("primary", "secondary"):
            cluster.rows[axis][cluster.names.index(NAME)] -= 200_000
            cluster.rows[f"{axis}_goal"][cluster.names.index(NAME)] -= 200_000
        # Where its beam was on the receiver unsent (2.5° of longitude), that alarm ends after 5 s.
        for _ in range(2):
            plant.authority.keep(OPERATOR, token)
            await bench.wait(5.0)
        with pytest.raises(RefusedError, match=r"TRACK P5A: pointing_disagrees .*acknowledge"):
            plant.command(OPERATOR, token, "TRACK", (NAME,))
        assert plant.command(OPERATOR, token, "TRACK", (NAME, "P5B")).blocked.keys() == {NAME}
        plant.acknowledge(OPERATOR, "pointing_disagrees", NAME)
        assert plant.command(OPERATOR, token, "TRACK", (NAME,))

    play(tmp_path, scene)


@pytest.mark.parametrize("late", [0.0, 600.0])
def test_counts_that_come_seldom_are_compared_with_the_sun_of_their_time(
    late: float, tmp_path: Path
) -> None:
    """A cluster may ask for them once a minute, in which the sun moves by 4 mrad."""

    async def scene(bench: Bench) -> None:
        await tracking(bench)
        bench.cluster_of(NAME).polled_ms = 60_000
        await go(bench, 75, 60.0 + late)
        assert alarmed(bench, "pointing_disagrees") == ({NAME} if late else set())

    play(tmp_path, scene)


def test_a_heliostat_on_its_way_is_left_in_peace_and_one_that_stands_is_not(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        cluster = bench.cluster_of(NAME)
        row = cluster.names.index(NAME)
        await tracking(bench)

        async def approach(first: int, last: int) -> None:
            for k in range(first, last):
                goal = steps_at(bench, 0.0)
                for axis, value in zip(("primary", "secondary"), goal, strict=True):
                    cluster.rows[f"{axis}_goal"][row] = value
                    cluster.rows[axis][row] = value - 200_000 + 10_000 * k
                await bench.wait(1.0)

        await approach(0, 12)
        assert not alarmed(bench, "pointing_disagrees")
        for _ in range(10):
            await approach(12, 13)
        assert alarmed(bench, "pointing_disagrees") == {NAME}

    play(tmp_path, scene)


@pytest.mark.parametrize("seconds", [5, 0])
def test_a_new_aim_that_waits_for_its_turn_is_no_disagreement(seconds: int, tmp_path: Path) -> None:
    """Nor is one that comes before the plant has seen the beam at the aim before it."""

    async def scene(bench: Bench) -> None:
        await tracking(bench)
        await go(bench, seconds, 0.0)
        still = steps_at(bench, 0.0)
        cluster = bench.cluster_of(NAME)
        row = cluster.names.index(NAME)
        bench.plant.aims[bench.plant.field.place(NAME)] = (-2.0, 0.0, 15.0)
        for axis, value in zip(("primary", "secondary"), still, strict=True):
            cluster.rows[axis][row] = cluster.rows[f"{axis}_goal"][row] = value
        await bench.wait(8.0)
        assert not alarmed(bench, "pointing_disagrees")

    play(tmp_path, scene)


def test_a_new_calibration_counts_once_the_local_controller_has_it(tmp_path: Path) -> None:
    bench = Bench(VirtualClock(), tmp_path)
    plant, row = bench.plant, bench.plant.field.place(NAME)
    other, agreement = DESIGN["P5B"].calibrated, plant._agreement
    before = agreement._armature[row].copy()
    agreement.believe(row, other.armature.table, other.drives.table)
    agreement._check(1.0)
    assert np.array_equal(agreement._armature[row], before)
    plant.field.rows["armature_crc"][row] = crc32(items_of(other)["armature"])
    agreement._check(2.0)
    assert np.array_equal(agreement._armature[row], other.armature.table)
    assert np.array_equal(agreement._drives[row], other.drives.table)
    # Of drives alone no checksum comes with the status: they count once nothing wanted is missing.
    own = other.drives.table + 0.01
    plant.wanted.missing[NAME] = ("drives",)
    agreement.believe(row, other.armature.table, own)
    agreement._check(3.0)
    assert np.array_equal(agreement._drives[row], other.drives.table)
    del plant.wanted.missing[NAME]
    agreement._check(4.0)
    assert np.array_equal(agreement._drives[row], own)


def test_one_that_disagrees_is_defocused_alone(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        agreement = bench.plant._agreement
        agreement._named_errors, agreement._at = {NAME: 0.1}, np.inf
        await bench.wait(7.0)
        assert alarmed(bench, "pointing_disagrees") == {NAME}
        assert not bench.plant.sentinel.on

    bench = play(tmp_path, scene)
    sent = [(m.name, m.heliostats) for c in bench.clusters.values() for m in c.of(Emergency)]
    assert sent == [("DEFOCUS", (NAME,))]


def test_many_that_disagree_defocus_the_field(tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        plant = bench.plant
        plant._agreement._named_errors = dict.fromkeys(plant.field.names, 0.1)
        plant._agreement._at = np.inf
        await bench.wait(5.0)
        assert alarmed(bench, "pointing_disagrees_many") == {""}
        assert plant.sentinel.on
        assert plant.sentinel.order is not None
        assert plant.sentinel.order.act is Act.DEFOCUS

    play(tmp_path, scene, lay_out("radial", 120))


def standing_at(bench: Bench, point: tuple[float, float, float], late: float) -> None:
    """Put the step counts and goals of a heliostat where a late sun sends its beam to a point."""
    sun = fast_vector(bench.clock.utc().timestamp() - late, DESIGN.site)
    group, row = DESIGN.find(NAME)
    counts = track(group.mechanism[row], sun, np.array(point)).best_counts
    cluster = bench.cluster_of(NAME)
    for axis, value in zip(("primary", "secondary"), counts, strict=True):
        for name in (axis, f"{axis}_goal"):
            cluster.rows[name][cluster.names.index(NAME)] = round(float(value))


async def follow(
    bench: Bench, seconds: int, point: tuple[float, float, float], late: float
) -> set[str]:
    """Let the beam follow a point by a late sun for some seconds; return who is named."""
    for _ in range(seconds):
        standing_at(bench, point, late)
        bench.plant.authority.keep(OPERATOR, bench.plant.authority.token)
        await bench.wait(1.0)
    return alarmed(bench, "pointing_disagrees")


REST = (8.0, 2.0, 15.0)


async def resting(bench: Bench, late: float, ready: bool = True) -> int:
    """Bring a heliostat up to standby by a late sun; return the token."""
    token = await bench.commanded()
    assert await bench.plant.standby(OPERATOR, token, {NAME: REST}).end(5.0)
    cluster = bench.cluster_of(NAME)
    cluster.rows["flags"] = (1 << FLAGS.index("READY")) if ready else 0
    cluster.set(states.APPROACHING, NAME)
    await follow(bench, 6, REST, late)
    cluster.set(states.IDLE, NAME)
    return token


@pytest.mark.parametrize("late", [0.0, 600.0])
def test_a_beam_at_standby_by_a_wrong_sun_is_named_and_defocused(
    late: float, tmp_path: Path
) -> None:
    async def scene(bench: Bench) -> None:
        plant, cluster = bench.plant, bench.cluster_of(NAME)
        token = await resting(bench, late)
        named = await follow(bench, 10, REST, late)
        assert named == ({NAME} if late else set())
        assert [m.heliostats for m in cluster.of(Emergency)] == ([(NAME,)] if late else [])
        if not late:
            return
        # Turned away, it does not come back, by nobody's command, before somebody has looked.
        assert cluster.rows["state"][cluster.names.index(NAME)] == states.DEFOCUSED
        await follow(bench, 8, REST, late)
        with pytest.raises(RefusedError, match=r"IDLE P5A: pointing_disagrees .*acknowledge"):
            plant.command(OPERATOR, token, "IDLE", (NAME,))
        plant.acknowledge(OPERATOR, "pointing_disagrees", NAME)
        assert plant.command(OPERATOR, token, "IDLE", (NAME,))

    play(tmp_path, scene)


ELSEWHERE = {"JOG": (0, 20_000), "GOTO": (0, 0), "DIAGNOSE": (), "LOCK": (), "UNLOCK": ()}


@pytest.mark.parametrize("name", ELSEWHERE)
def test_a_heliostat_that_a_person_left_elsewhere_is_left_in_peace(
    name: str, tmp_path: Path
) -> None:
    """Until IDLE has sent it to its standby point again."""

    async def scene(bench: Bench) -> None:
        plant = bench.plant
        token = await resting(bench, 0.0)
        assert not await follow(bench, 6, REST, 0.0)
        plant._orders.command(
            plant._orders.accept((OPERATOR.name, "operator", name), (), (NAME,)),
            name,
            tuple(float(x) for x in ELSEWHERE[name]),
            (NAME,),
            token,
        )
        await follow(bench, 1, REST, 0.0)
        bench.cluster_of(NAME).set(states.IDLE, NAME)
        assert not await follow(bench, 10, REST, 600.0)
        assert await plant.command(OPERATOR, token, "IDLE", (NAME,)).end(5.0)
        assert await follow(bench, 10, REST, 600.0) == {NAME}

    play(tmp_path, scene)


def test_a_heliostat_that_never_came_to_standby_by_the_way_from_stow_holds_still(
    tmp_path: Path,
) -> None:
    async def scene(bench: Bench) -> None:
        await resting(bench, 600.0, ready=False)
        assert not await follow(bench, 10, REST, 600.0)

    play(tmp_path, scene)


def test_a_new_standby_point_that_the_beam_does_not_go_to_is_no_disagreement(
    tmp_path: Path,
) -> None:
    """It may be on its way, or refused: the beam rests where it was sent before."""

    async def scene(bench: Bench) -> None:
        other = (-8.0, 2.0, 15.0)
        await resting(bench, 0.0)
        assert not await follow(bench, 6, REST, 0.0)
        bench.plant.standbys[bench.plant.field.place(NAME)] = other
        assert not await follow(bench, 8, REST, 0.0)
        assert not await follow(bench, 4, other, 0.0)
        assert await follow(bench, 10, REST, 0.0) == {NAME}

    play(tmp_path, scene)


def test_of_several_new_standby_points_the_beam_may_be_at_each(tmp_path: Path) -> None:
    """Simulated run 2300030: the second one came before anybody had looked at the first."""

    async def scene(bench: Bench) -> None:
        first, second = (-8.0, 2.0, 15.0), (3.0, -9.0, 15.0)
        await resting(bench, 0.0)
        assert not await follow(bench, 6, REST, 0.0)
        for point in (first, second):
            bench.plant.standbys[bench.plant.field.place(NAME)] = point
            assert not await follow(bench, 3, REST, 0.0)
        assert not await follow(bench, 8, first, 0.0)
        assert not await follow(bench, 4, second, 0.0)
        assert await follow(bench, 10, first, 0.0) == {NAME}

    play(tmp_path, scene)


@pytest.mark.parametrize(("radius", "wrong"), [(8e-3, False), (2e-3, True)])
def test_a_search_keeps_to_its_radius(radius: float, wrong: bool, tmp_path: Path) -> None:
    async def scene(bench: Bench) -> None:
        token = await tracking(bench)
        await go(bench, 4, 0.0)
        plant = bench.plant
        assert await plant.command(OPERATOR, token, "SEARCH", (NAME,), (1e-3, radius)).end(5.0)
        vertex = plant.beams.position[plant.field.place(NAME)]
        aside = np.cross(np.array(AIM) - vertex, (0.0, 0.0, 1.0))
        aside *= 7e-3 * np.linalg.norm(np.array(AIM) - vertex) / np.linalg.norm(aside)
        x, y, z = (float(value) for value in np.array(AIM) + aside)
        assert await follow(bench, 10, (x, y, z), 0.0) == ({NAME} if wrong else set())

    play(tmp_path, scene)
