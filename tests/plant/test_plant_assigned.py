"""Assigned aims and standby points: kept before they are sent, known after a restart."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from heliotrope.errors import FormatError, InputError
from heliotrope.field.example import example_plant
from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import Progress, Stage
from heliotrope.plant.field.aims import BeamCheck
from heliotrope.plant.field.assigned import (
    AssignedError,
    AssignedFile,
    Points,
    grouped,
    points_of,
    rest_on,
)
from heliotrope.plant.orders.audit import read
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.plant.orders.kept_audit import KeptPoints
from heliotrope.plant.refusals import COUNTS_DOUBTFUL
from heliotrope.plant.settings import PlantSettings
from heliotrope.store.backup import backup, restore
from heliotrope.store.keeper import Keeper
from support.plant_bench import OPERATOR, Bench, SlowDisk, running

ENGINEER = Person("Egon", Role.ENGINEER)
AIM, OTHER, STANDBY = (0.1, 0.2, 16.5), (0.0, 0.0, 16.0), (4.0, 0.0, 14.0)


def give(points: Points, kind: str, *places: tuple[float, float, float]) -> None:
    """Store and assign points of the first heliostats, as a command does."""
    rows, wanted = np.arange(len(places)), np.array(places)
    points.storing(kind, rows, wanted)[0]()
    points.assign(kind, rows, wanted)


def places(points: Points, kind: str) -> list[list[float]]:
    """Where the first heliostat's local controller may send its beam."""
    return [point[0].tolist() for _, point in points.possible(kind, np.arange(1))]


async def idle(bench: Bench, *names: str) -> None:
    """Let heliostats be at standby."""
    for name in names:
        bench.cluster_of(name).set(states.IDLE, name)
    await bench.wait(2.0)


def test_what_was_assigned_is_known_after_a_restart(tmp_path: Path) -> None:
    store = AssignedFile(tmp_path / "assigned.json")

    async def before(clock: VirtualClock) -> None:
        async with running(Bench(clock, tmp_path, assigned=store)) as bench:
            token = await bench.commanded()
            bench.plant.aim(OPERATOR, token, {"P1A": AIM, "P2B": (0.0, 0.0, 16.0)})
            bench.plant.aim(OPERATOR, token, {"P2B": AIM})
            ticket = bench.plant.standby(OPERATOR, token, {"P1A": STANDBY})
            assert await ticket.end(20.0)

    async def after(clock: VirtualClock) -> None:
        plant = Bench(clock, tmp_path, seed=2, assigned=store).plant
        row, other = plant.field.place("P1A"), plant.field.place("P2B")
        assert plant.aims[[row, other]].tolist() == [list(AIM), list(AIM)]
        assert plant.standbys[row].tolist() == list(STANDBY)
        assert np.isfinite(plant.aims).all(axis=-1).sum() == 2
        assert np.isfinite(plant.standbys).all(axis=-1).sum() == 1

    run_virtual(before)
    run_virtual(after)


def test_what_cannot_be_kept_is_not_sent(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        store = AssignedFile(tmp_path / "nowhere" / "assigned.json")
        async with running(Bench(clock, tmp_path, assigned=store)) as bench:
            token = await bench.commanded()
            ticket = bench.plant.aim(OPERATOR, token, {"P1A": AIM})
            assert not await ticket.end(5.0)
            assert "not sent, because it cannot be stored: assigned points" in ticket.text
            assert "No such file or directory; check the disk" in ticket.text
            assert np.isnan(bench.plant.aims).all()
            assert not bench.cluster_of("P1A").commands("AIM")

    run_virtual(main)
    (record,) = [r for r in read(tmp_path / "audit.jsonl")[0] if r.what == "AIM"]
    assert "1 refused" in record.result


def test_the_old_file_stays_until_the_new_one_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = AssignedFile(tmp_path / "assigned.json")
    assert store.read() == {}
    old = {"AIM": {"A": (1.0, 2.0, 3.0)}, "STANDBY": {}}
    store.keep(old)

    def full(self: Path, target: Path) -> Path:
        assert self.read_bytes()
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", full)
        with pytest.raises(
            AssignedError, match=r"assigned\.json: No space left on device; check the disk"
        ):
            store.keep({"AIM": {"A": (9.0, 9.0, 9.0)}, "STANDBY": {}})
    assert store.read() == old
    store.keep({"AIM": {}, "STANDBY": {}})
    assert store.read() == {"AIM": {}, "STANDBY": {}}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "no assigned points; delete it, then assign"),
        ('{"version": 7}', "the file is not an assigned-points file of version 1; delete it"),
        (
            '{"version": 1, "AIM": 3}',
            "AIM: the points are not listed by heliostat name; delete the file",
        ),
        (
            '{"version": 1, "AIM": {"A": [1.0, NaN, 0.0]}}',
            r"AIM of A: \[1.0, nan, 0.0\] is not a point",
        ),
        (
            '{"version": 1, "AIM": {"A": [1.0]}}',
            (
                r"AIM of A: \[1.0\] is not a point in ENU "
                r"coordinates \(m\)"
            ),
        ),
    ],
)
def test_another_file_is_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "assigned.json"
    path.write_text(text)
    with pytest.raises(FormatError, match=says):
        AssignedFile(path).read()


def test_points_are_checked_and_grouped() -> None:
    with pytest.raises(InputError, match="AIM: no points; specify one for each heliostat"):
        points_of("AIM", {})
    with pytest.raises(InputError, match="STANDBY: a point is 1e\\+09 m away, the limit is"):
        points_of("STANDBY", {"A": (0.0, 1e9, 0.0)})
    points = points_of("AIM", {"A": AIM, "B": STANDBY, "C": AIM})
    assert grouped("ABC", points) == {AIM: ["A", "C"], STANDBY: ["B"]}


def test_standby_points_where_an_eye_sees_more_than_one_sun_are_refused(tmp_path: Path) -> None:
    balcony, away = (4.0, -6.0, 12.0), (-6.0, 0.0, 15.0)

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path, eyes=(balcony, (500.0, 0.0, 0.0)))
        async with running(bench):
            plant, token = bench.plant, await bench.commanded()
            names = plant.field.names
            with pytest.raises(RefusedError) as refused:
                plant.standby(OPERATOR, token, dict.fromkeys(names, balcony))
            text = str(refused.value)
            assert text.startswith("STANDBY P1A (and 17 more): at rest its beam shines on the po")
            assert "suns (limit 1); choose another standby point" in text
            assert np.isnan(plant.standbys).all()
            # One flat mirror is no more than a look at the sun; what rests there already counts.
            resting: list[str] = []

            def one_after_the_other() -> None:
                for name in names:
                    plant.standby(OPERATOR, token, {name: balcony})
                    resting.append(name)

            with pytest.raises(RefusedError, match=r"STANDBY P\w\w: at rest its beam shines"):
                one_after_the_other()
            # Each gives almost a sun where it shines alone.
            assert len(resting) == 1
            # Who does not shine there may rest where he likes; aims end at what stops them.
            plant.standby(OPERATOR, token, {names[-1]: away})
            plant.aim(OPERATOR, token, dict.fromkeys(names, balcony))

    run_virtual(main)
    with pytest.raises(InputError, match=r"eyes\[0, 2\]: nan is not a finite number"):
        BeamCheck(example_plant(), ("P1A",), (), ((0.0, 0.0, float("nan")),))


def test_no_mirror_tracks_whose_last_aim_was_not_taken(tmp_path: Path) -> None:
    """Simulated run 2300117: it would go to the aim before, and the plant would not know it."""

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path)
        async with running(bench):
            plant, token = bench.plant, await bench.commanded()
            first, second = plant.field.names[:2]
            bench.cluster_of(first).set(states.IDLE, first, second)
            await bench.wait(2.0)
            assert await plant.aim(OPERATOR, token, {first: AIM, second: AIM}).end(5.0)
            cluster = bench.cluster_of(first)
            cluster.stubborn.add(first)
            assert not await plant.aim(OPERATOR, token, {first: STANDBY, second: STANDBY}).end(5.0)
            cluster.stubborn.clear()
            ticket = plant.command(OPERATOR, token, "TRACK", (first, second))
            assert not await ticket.end(5.0)
            assert ticket.stage(second) is Stage.DONE
            assert ticket.refusals[first].startswith("its latest aim was not accepted (")
            assert all(first not in message.heliostats for message in cluster.commands("TRACK"))
            with pytest.raises(
                RefusedError, match=rf"SEARCH {first}: its latest aim was not accepted"
            ):
                plant.command(OPERATOR, token, "SEARCH", (first,), (1e-3, 5e-3))
            assert await plant.aim(OPERATOR, token, {first: AIM}).end(5.0)
            assert await plant.command(OPERATOR, token, "TRACK", (first,)).end(5.0)

    run_virtual(main)


def test_after_a_restart_the_plant_knows_which_points_were_not_taken(tmp_path: Path) -> None:
    """Simulated run 2401709: it named a sound mirror, which was where it had been sent before."""
    store, names = AssignedFile(tmp_path / "assigned.json"), ("P1A", "P1B", "P2B")
    more = [(4.0 + i, 0.0, 14.0) for i in range(6)]

    async def before(clock: VirtualClock) -> None:
        async with running(Bench(clock, tmp_path, assigned=store)) as bench:
            plant, token = bench.plant, await bench.commanded()
            for give in (plant.aim, plant.standby):
                assert await give(OPERATOR, token, dict.fromkeys(names, AIM)).end(5.0)
                for name in names[:2]:
                    bench.cluster_of(name).stubborn.add(name)
                for point in more:
                    assert not await give(OPERATOR, token, dict.fromkeys(names, point)).end(5.0)
                bench.cluster_of("P1B").stubborn.discard("P1B")
                assert await give(OPERATOR, token, {"P1B": AIM}).end(5.0)
                bench.cluster_of("P1A").stubborn.clear()
            await bench.wait(3.0)

    async def after(clock: VirtualClock) -> None:
        folder = tmp_path / "again"
        folder.mkdir()
        async with running(Bench(clock, folder, seed=2, assigned=store)) as bench:
            plant, token = bench.plant, await bench.commanded()
            points = plant._proofs.points
            rows = [plant.field.place(name) for name in names]
            for kind, assigned in (("AIM", plant.aims), ("STANDBY", plant.standbys)):
                assert assigned[rows].tolist() == [list(p) for p in (more[-1], AIM, more[-1])]
                # The last ones, and that which it took.
                earlier = [*more[-2:-5:-1], AIM]
                assert points.earlier[kind][:, rows[0]].tolist() == [list(p) for p in earlier]
                assert np.isnan(points.earlier[kind][:, rows[1:]]).all()
            for name in names:
                bench.cluster_of(name).set(states.IDLE, name)
            await bench.wait(2.0)
            ticket = plant.command(OPERATOR, token, "TRACK", names)
            assert not await ticket.end(5.0)
            assert ticket.refusals.keys() == {"P1A"}
            text = "its latest aim was not accepted (the plant's program ended before it was ackn"
            assert ticket.refusals["P1A"].startswith(text)
            assert await plant.aim(OPERATOR, token, {"P1A": AIM}).end(5.0)
            assert await plant.command(OPERATOR, token, "TRACK", ("P1A",)).end(5.0)
            assert np.isnan(points.earlier["AIM"]).all()

    run_virtual(before)
    run_virtual(after)


def test_after_a_restore_no_mirror_goes_to_a_standby_point_that_it_may_not_have(
    tmp_path: Path,
) -> None:
    """A point of the backup led to proofs of paths that the mirrors did not take."""
    old, names = (9.0, 0.0, 14.0), ("P1A", "P1B")
    keeper = Keeper(tmp_path / "data")

    async def before(clock: VirtualClock) -> None:
        async with running(Bench(clock, tmp_path, assigned=KeptPoints(keeper))) as bench:
            plant, token = bench.plant, await bench.commanded()
            for give in (plant.aim, plant.standby):
                assert await give(OPERATOR, token, dict.fromkeys(names, old)).end(5.0)
            await bench.wait(3.0)
            backup(keeper.database, tmp_path / "backup", clock.utc())
            assert await plant.standby(OPERATOR, token, dict.fromkeys(names, AIM)).end(5.0)
            await bench.wait(3.0)

    async def after(clock: VirtualClock) -> None:
        folder = tmp_path / "again"
        folder.mkdir()
        async with running(Bench(clock, folder, seed=2, assigned=KeptPoints(again))) as bench:
            plant, token = bench.plant, await bench.commanded()
            await bench.wait(2.0)
            for name in ("APPROACH", "IDLE"):
                with pytest.raises(RefusedError, match="its standby point was not accepted"):
                    plant.command(OPERATOR, token, name, names)
            rows = [plant.field.place(name) for name in names]
            assert plant.standby_unknown[rows].all()
            assert await plant.standby(OPERATOR, token, {"P1A": old}).end(5.0)
            ticket = plant.command(OPERATOR, token, "APPROACH", names)
            await bench.wait(3.0)
            assert ticket.refusals.keys() == {"P1B"}
            assert plant.standby_unknown[rows].tolist() == [False, True]

    run_virtual(before)
    keeper.close()
    restore(tmp_path / "backup", tmp_path / "restored", datetime.now(UTC))
    again = Keeper(tmp_path / "restored")
    run_virtual(after)
    again.close()


def test_the_store_knows_after_each_assignment_what_the_plant_knows(tmp_path: Path) -> None:
    store, row = AssignedFile(tmp_path / "assigned.json"), np.arange(1)
    points = Points(("A",), store)
    for east in range(1, 9):
        new = np.array([[float(east), 0.0, 9.0]])
        points.storing("AIM", row, new)[0]()
        points.assign("AIM", row, new)
        if east == 1:
            points.taken("AIM", row)
            settle = points.settling()
            assert settle is not None
            settle()
        again = Points(("A",), store)
        np.testing.assert_array_equal(again.aims, points.aims)
        np.testing.assert_array_equal(again.earlier["AIM"], points.earlier["AIM"])
    assert points.earlier["AIM"][:, 0, 0].tolist() == [7.0, 6.0, 5.0, 1.0]


def test_a_point_taken_late_is_taken_and_one_replaced_meanwhile_is_not(tmp_path: Path) -> None:
    store = AssignedFile(tmp_path / "assigned.json")
    points = Points(("A", "B"), store)
    both = np.arange(2)

    def give(east: float) -> None:
        new = np.tile((east, 0.0, 9.0), (2, 1))
        points.storing("AIM", both, new)[0]()
        points.assign("AIM", both, new)

    give(1.0)
    points.taken("AIM", both)
    give(2.0)
    points.taken("AIM", both[:1])
    settle = points.settling()
    assert settle is not None
    assert points.settling() is None
    points.storing("AIM", both[:1], np.array([[3.0, 0.0, 9.0]]))[0]()
    settle()
    # A's next point is in the store already: what comes before it stays known.
    assert store.read()["AIM-1"] == {"A": (2.0, 0.0, 9.0), "B": (1.0, 0.0, 9.0)}
    again = Points(("A", "B"), store)
    assert again.earlier["AIM"][:, 0, 0].tolist()[:2] == [2.0, 1.0]
    # One that is given again, and one that is taken back, are no other points.
    store_it, take_back = again.storing("AIM", both[1:], np.array([[7.0, 0.0, 9.0]]))
    store_it()
    assert store.read()["AIM-2"]["B"] == (1.0, 0.0, 9.0)
    take_back()
    again.storing("AIM", both[1:], np.array([[2.0, 0.0, 9.0]]))[0]()
    assert store.read()["AIM-1"]["B"] == (1.0, 0.0, 9.0)
    assert "B" not in store.read()["AIM-2"]


def test_a_first_point_that_was_not_taken_is_known_after_a_restart(tmp_path: Path) -> None:
    """Its local controller has an aim of its own, or none, whatever the plant's store knows."""
    store = AssignedFile(tmp_path / "assigned.json")

    async def before(clock: VirtualClock) -> None:
        async with running(Bench(clock, tmp_path, assigned=store)) as bench:
            token = await bench.commanded()
            for name in ("P1A", "P1B"):
                bench.cluster_of(name).stubborn.add(name)
            both = {"P1A": AIM, "P1B": AIM}
            assert not await bench.plant.aim(OPERATOR, token, both).end(5.0)
            bench.cluster_of("P1B").stubborn.discard("P1B")
            assert await bench.plant.aim(OPERATOR, token, {"P1B": AIM}).end(5.0)

    async def after(clock: VirtualClock) -> None:
        folder = tmp_path / "again"
        folder.mkdir()
        async with running(Bench(clock, folder, seed=2, assigned=store)) as bench:
            token = await bench.commanded()
            await idle(bench, "P1A", "P1B")
            ticket = bench.plant.command(OPERATOR, token, "TRACK", ("P1A", "P1B"))
            assert not await ticket.end(5.0)
            assert ticket.refusals.keys() == {"P1A"}

    run_virtual(before)
    assert "P1B" not in store.read()["AIM-1"], "what was taken is settled at the end"
    run_virtual(after)


def test_a_standby_point_of_the_plant_file_is_one_before(tmp_path: Path) -> None:
    store = AssignedFile(tmp_path / "assigned.json")
    for _ in range(2):
        points = Points(("A",), store)
        rest_on(points.standbys, STANDBY)
        if not store.read():
            give(points, "STANDBY", OTHER)
        assert places(points, "STANDBY") == [list(OTHER), list(STANDBY)]


def test_an_earlier_aim_that_is_taken_after_a_later_one_counts(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        async with running(Bench(clock, tmp_path)) as bench:
            plant, token, cluster = bench.plant, await bench.commanded(), bench.cluster_of("P1A")
            await idle(bench, "P1A")
            cluster.deaf.add("P1A")
            plant.aim(OPERATOR, token, {"P1A": OTHER})
            await bench.wait(0.5)
            cluster.deaf.clear()
            assert await plant.aim(OPERATOR, token, {"P1A": AIM}).end(5.0)
            late = cluster.commands("AIM")[0]
            # A name that comes twice is one heliostat.
            await cluster.send(Progress(late.identity, Stage.DONE, ("P1A", "P1A")))
            await bench.wait(1.0)
            with pytest.raises(RefusedError, match="TRACK P1A: its latest aim was not accepted"):
                plant.command(OPERATOR, token, "TRACK", ("P1A",))
            assert await plant.aim(OPERATOR, token, {"P1A": AIM}).end(5.0)
            assert await plant.command(OPERATOR, token, "TRACK", ("P1A",)).end(5.0)

    run_virtual(main)


def test_what_was_refused_is_not_taken_by_a_report_on_all(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        async with running(Bench(clock, tmp_path)) as bench:
            plant, token, cluster = bench.plant, await bench.commanded(), bench.cluster_of("P1A")
            await idle(bench, "P1A")
            cluster.stubborn.add("P1A")
            assert not await plant.aim(OPERATOR, token, {"P1A": OTHER}).end(5.0)
            cluster.stubborn.clear()
            await cluster.send(Progress(cluster.commands("AIM")[-1].identity, Stage.DONE))
            await bench.wait(1.0)
            with pytest.raises(RefusedError, match="TRACK P1A: its latest aim was not accepted"):
                plant.command(OPERATOR, token, "TRACK", ("P1A",))

    run_virtual(main)


def test_a_point_given_again_is_not_taken_back_with_the_first(tmp_path: Path) -> None:
    store = AssignedFile(tmp_path / "assigned.json")
    points, one = Points(("A",), store), np.arange(1)
    give(points, "AIM", AIM)
    points.taken("AIM", one)
    first, take_back = points.storing("AIM", one, np.array([OTHER]))
    first()
    give(points, "AIM", OTHER)
    take_back()
    assert store.read()["AIM"]["A"] == OTHER
    # Nor does an older settling forget what came before the same point given again.
    give(points, "AIM", AIM)
    points.taken("AIM", one)
    settle = points.settling()
    assert settle is not None
    give(points, "AIM", OTHER)
    give(points, "AIM", AIM)
    settle()
    assert list(OTHER) in places(Points(("A",), store), "AIM")


def test_who_waits_to_join_while_its_aim_is_refused_is_not_sent(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        settings = PlantSettings(join_rate=1.0, join_burst=1)
        async with running(Bench(clock, tmp_path, settings=settings)) as bench:
            plant, token = bench.plant, await bench.commanded()
            name, other = plant.field.names[:2]
            cluster = bench.cluster_of(name)
            await idle(bench, name, other)
            assert await plant.aim(OPERATOR, token, {name: AIM, other: AIM}).end(5.0)
            cluster.stubborn.add(name)
            plant.aim(OPERATOR, token, {name: OTHER})
            track = plant.command(OPERATOR, token, "TRACK", (other, name))
            await bench.wait(0.5)
            assert track.stage(name) is None, "it is waiting its turn"
            cluster.stubborn.clear()
            assert not await track.end(10.0)
            assert track.refusals[name].startswith("its latest aim was not accepted")
            assert track.stage(other) is Stage.DONE

    run_virtual(main)


@pytest.mark.parametrize("pause", [0.0, 0.4])
def test_a_beam_that_is_aimed_elsewhere_meanwhile_is_not_brought_back(
    pause: float, tmp_path: Path
) -> None:
    async def main(clock: VirtualClock) -> None:
        disk = SlowDisk(clock)
        async with running(Bench(clock, tmp_path, disk=disk)) as bench:
            plant, token, name = bench.plant, await bench.commanded(), "P1A"
            await idle(bench, name)
            base = np.array(plant.design.receivers[0].center)
            target = np.array(plant.design.targets[0].center)
            assert await plant.aim(OPERATOR, token, {name: base}).end(5.0)
            assert await plant.command(OPERATOR, token, "TRACK", (name,)).end(5.0)
            await bench.wait(2.0)
            assert await plant.commands.move(OPERATOR, token, {name: base + (0.01, 0.0, 0.0)}).end(
                5.0
            )
            await bench.wait(pause)
            disk.delay = 0.95
            plant.aim(OPERATOR, token, {name: target})
            plant.movements.end([name])
            await bench.wait(10.0)
            assert np.array_equal(bench.cluster_of(name).commands("AIM")[-1].values, target)
            assert np.array_equal(plant.aims[plant.field.place(name)], target)

    run_virtual(main)


def test_a_beam_that_did_not_leave_its_standby_point_counts_in_an_eye(tmp_path: Path) -> None:
    balcony, away = (4.0, -6.0, 12.0), (-6.0, 0.0, 15.0)

    async def main(clock: VirtualClock) -> None:
        async with running(Bench(clock, tmp_path, eyes=(balcony,))) as bench:
            plant, token = bench.plant, await bench.commanded()
            first, second = plant.field.names[:2]
            assert await plant.standby(OPERATOR, token, {first: balcony}).end(5.0)
            bench.cluster_of(first).stubborn.add(first)
            assert not await plant.standby(OPERATOR, token, {first: away}).end(5.0)
            with pytest.raises(RefusedError, match="at rest its beam shines on the point"):
                plant.standby(OPERATOR, token, {second: balcony})
            bench.cluster_of(first).stubborn.clear()
            assert await plant.standby(OPERATOR, token, {first: away}).end(5.0)
            plant.standby(OPERATOR, token, {second: balcony})

    run_virtual(main)


@pytest.mark.parametrize("giver", ["a person", "a visit"])
def test_an_aim_that_is_given_up_before_its_turn_was_never_assigned(
    giver: str, tmp_path: Path
) -> None:
    """Simulated day 50: the beam was shown on a target, while it was on the receiver."""
    store, settings = AssignedFile(tmp_path / "a.json"), PlantSettings(join_rate=0.2, join_burst=1)

    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path, settings=settings, assigned=store)
        async with running(bench):
            plant, token = bench.plant, await bench.commanded(ENGINEER)
            names = plant.field.names[:2]
            rows = [plant.field.place(name) for name in names]
            await idle(bench, *names)
            assert await plant.aim(ENGINEER, token, dict.fromkeys(names, AIM)).end(5.0)
            bench.cluster_of(names[0]).set(states.TRACKING, *names)
            await bench.wait(2.0)
            target = tuple(plant.design.targets[0].center.tolist())
            with plant.authority.mandate(ENGINEER, token, names, "target") as mandate:
                own = mandate.token if giver == "a visit" else token
                ticket = plant.aim(ENGINEER, own, dict.fromkeys(names, target))
                await bench.wait(1.0)
                assert ticket.stage(names[1]) is None, "it is waiting its turn"
                places = dict(zip(names, (target, AIM), strict=True))
                assert store.read()["AIM"] == places
                assert plant.aims[rows].tolist() == [list(target), list(AIM)]
            lent = names[:1] if giver == "a visit" else ()
            assert plant.movements.names == frozenset(lent)
            plant.release_authority(ENGINEER, token)
            await bench.wait(1.0)
            assert ticket.stage(names[1]) is Stage.REFUSED
            assert "changed while it was waiting" in ticket.refusals[names[1]]
            assert plant.aims[rows].tolist() == [list(target), list(AIM)]
            assert store.read()["AIM"] == places
            # It has the aim that it had, so it may track.
            token = await bench.commanded()
            assert await plant.command(OPERATOR, token, "TRACK", names[1:]).end(10.0)

    run_virtual(main)


def test_a_beam_that_waits_for_a_persons_aim_is_not_brought_back(tmp_path: Path) -> None:
    """A person takes it out of a visit; what the visit left must not undo the order."""
    settings = PlantSettings(join_rate=0.2, join_burst=1)

    async def main(clock: VirtualClock) -> None:
        async with running(Bench(clock, tmp_path, settings=settings)) as bench:
            plant, token = bench.plant, await bench.commanded(ENGINEER)
            name, other = plant.field.names[:2]
            await idle(bench, name, other)
            both = dict.fromkeys((name, other), AIM)
            assert await plant.aim(ENGINEER, token, both).end(5.0)
            bench.cluster_of(name).set(states.TRACKING, name, other)
            await bench.wait(2.0)
            target, base = plant.design.targets[0].center, plant.design.receivers[0].center
            with plant.authority.mandate(ENGINEER, token, (name,), "target") as mandate:
                assert await plant.aim(ENGINEER, mandate.token, {name: target}).end(5.0)
                assert plant.movements.names == {name}
                mine = plant.aim(ENGINEER, token, {other: base, name: base})
                for _ in range(12):
                    await bench.wait(1.0)
                    plant.authority.keep(ENGINEER, token)
            assert mine.good, mine.text
            sent = [m.values for m in bench.cluster_of(name).commands("AIM") if m.heliostats]
            assert sent[-1] == tuple(base)
            assert sent.count(AIM) <= 1, "only its first aim"
            assert plant.aims[plant.field.place(name)].tolist() == base.tolist()
            assert not plant.movements.names

    run_virtual(main)


@pytest.mark.parametrize("to_target", [True, False])
def test_doubt_that_arises_before_the_turn_is_judged_by_the_new_aim(
    tmp_path: Path, *, to_target: bool
) -> None:
    """A photograph on a target ends the doubt; on a receiver the beam may be anywhere."""
    settings = PlantSettings(join_burst=1)

    async def main(clock: VirtualClock) -> None:
        disk = SlowDisk(clock)
        bench = Bench(clock, tmp_path, settings=settings, disk=disk)
        async with running(bench):
            plant, token = bench.plant, await bench.commanded()
            name, target = plant.field.names[0], tuple(plant.design.targets[0].center)
            cluster = bench.cluster_of(name)
            before, after = (AIM, target) if to_target else (target, AIM)
            await idle(bench, name)
            assert await plant.aim(OPERATOR, token, {name: before}).end(5.0)
            cluster.set(states.TRACKING, name)
            await bench.wait(2.0)
            disk.delay = 0.9
            ticket = plant.aim(OPERATOR, token, {name: after})
            await bench.wait(1.3)  # its record is written, and its turn has come
            cluster.rows["flags"][cluster.names.index(name)] |= meanings.COUNTS_DOUBTFUL
            plant.doubtful.standing[plant.field.place(name)] = True
            await ticket.end(8.0)
            assert plant.doubtful.standing[plant.field.place(name)]
            assert ticket.good == to_target, ticket.text
            last = after if to_target else before
            assert plant.aims[plant.field.place(name)] == pytest.approx(last)
            if not to_target:
                assert ticket.refusals[name] == COUNTS_DOUBTFUL.text

    run_virtual(main)


def test_an_aim_whose_path_is_blocked_while_it_is_stored_is_not_assigned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, settings = AssignedFile(tmp_path / "a.json"), PlantSettings(join_burst=1)

    async def main(clock: VirtualClock) -> None:
        disk = SlowDisk(clock)
        bench = Bench(clock, tmp_path, settings=settings, assigned=store, disk=disk)
        async with running(bench):
            plant, token = bench.plant, await bench.commanded()
            name = plant.field.names[0]
            await idle(bench, name)
            assert await plant.aim(OPERATOR, token, {name: AIM}).end(5.0)
            bench.cluster_of(name).set(states.TRACKING, name)
            await bench.wait(2.0)
            disk.delay = 0.9
            ticket = plant.aim(OPERATOR, token, {name: plant.design.targets[0].center})
            await bench.wait(1.3)
            monkeypatch.setattr(
                plant.doubtful, "reasons", lambda names, _: ["in doubt"] * len(names)
            )
            assert not await ticket.end(5.0)
            assert ticket.refusals[name] == "in doubt"
            assert plant.aims[plant.field.place(name)].tolist() == list(AIM)
            disk.delay = 0.0
            await bench.wait(3.0)
            assert store.read()["AIM"] == {name: AIM}

    run_virtual(main)
