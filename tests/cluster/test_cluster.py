"""A cluster in virtual time, with real local controllers on its bus: what keeps the field safe."""

import asyncio
import dataclasses
import math
from datetime import UTC, datetime

import pytest

from heliotrope.cluster import _nodes
from heliotrope.cluster._reports import Reports
from heliotrope.cluster._watch import Watch
from heliotrope.cluster.memory import Kept
from heliotrope.lcu import messages, states, wire
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.link import LinkError, running
from heliotrope.links.messages import (
    NEVER,
    Acknowledge,
    Answer,
    Ask,
    ClusterStatus,
    Lease,
    Stage,
    encode,
)
from heliotrope.safety import Alarm, Severity
from heliotrope.twin.boards.bus import BusFaults, TwinBus
from heliotrope.twin.boards.clocks import SimulatedTime
from support.clusters import AIM, TOKEN, Board, Field, boards_in, config_of, run

ALL_STAGES = [Stage.ACCEPTED, Stage.SENT, Stage.ACKNOWLEDGED, Stage.DONE]


def test_from_power_on_to_tracking() -> None:
    async def main(field: Field) -> None:
        await field.to_tracking()
        await asyncio.sleep(30.0)
        for name in ("A1", "A2"):
            for identity in ("aim", "approach", "track"):
                assert field.plant.stages(identity, name) == ALL_STAGES
        status = field.plant.status()
        rows = status.nodes()
        assert [states.STATES[state] for state in rows["state"]] == ["TRACKING", "TRACKING"]
        for row, board in zip(rows, field.boards, strict=True):
            # The sun makes some ten steps a second here.
            assert abs(int(row["primary"]) - board.timer.made[0]) < 40
            assert abs(int(row["secondary"]) - board.timer.made[1]) < 40
            assert row["heard_ms"] < 100
            assert row["armature_crc"] == board.node.controller.config.armature_crc
            assert row["asked"] == row["answered"]
        assert (status.count, status.acts, status.time_quality) == (2, (), "system")
        assert not field.plant.all(Alarm)

    # The clean end defocuses.
    assert set(run(main).states()) == {"DEFOCUSED"}


def test_at_a_start_nothing_moves_by_itself() -> None:
    async def main(field: Field) -> None:
        before = [list(board.timer.made) for board in field.boards]
        await asyncio.sleep(60.0)
        assert [board.timer.made for board in field.boards] == before
        assert field.states() == ["STOWED", "STOWED"]
        # The status comes once a second, the names with every tenth: the first may be lost.
        statuses = field.plant.all(ClusterStatus)
        assert 58 <= len(statuses) <= 63
        named = [number for number, status in enumerate(statuses) if status.names]
        assert named == list(range(0, len(statuses), 10))
        assert all(statuses[number].names == ("A1", "A2") for number in named)

    run(main)


def test_a_lost_plant_ends_the_sun_and_defocuses_and_polling_goes_on() -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(4.0)
        assert field.states() == ["TRACKING", "TRACKING"]
        field.line.cut()
        took = await field.until(lambda: field.states() == ["DEFOCUSED", "DEFOCUSED"])
        assert took < 5.1  # 3 s of lease, and what is left of a second before and after
        asked = field.cluster.nodes[0].counts.answered
        await asyncio.sleep(5.0)
        assert field.cluster.nodes[0].counts.answered >= asked + 8
        assert not field.boards[0].node.controller.sun.fresh()
        # The safety table goes on to stow.
        await field.until(lambda: set(field.states()) <= {"STOWING", "STOWED"}, 35.0)
        field.line.heal()
        await field.until(lambda: field.plant.alarms("plant_link_lost")[-1:] != [], 5.0)
        assert field.plant.alarms("plant_link_lost")[0].active
        await field.until(lambda: not field.plant.alarms("plant_link_lost")[-1].active, 10.0)
        # That the plant is back moves nothing.
        assert set(field.states()) <= {"STOWING", "STOWED"}

    run(main, "TRACKING")


def test_traffic_other_than_a_lease_renews_nothing() -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(3.0)
        field.plant.leases = False
        for _ in range(6):
            await asyncio.sleep(0.5)
            await field.order("more", "AIM", 0.0, 0.0, 51.0)
        await field.until(lambda: field.states() == ["DEFOCUSED", "DEFOCUSED"], 3.0)

    run(main, "TRACKING")


def test_it_goes_on_alone_within_its_autonomy() -> None:
    async def main(field: Field) -> None:
        field.plant.autonomy = 60.0
        await asyncio.sleep(3.0)
        (alarm,) = field.plant.alarms("autonomy_limited")
        assert "the plant grants 60 s of autonomy; cluster C1 is configured for 20 s" in alarm.text
        field.plant.leases = False
        await asyncio.sleep(20.0)
        assert field.states() == ["TRACKING", "TRACKING"]
        await field.order("late", "AIM", 0.0, 0.0, 51.0)
        await field.until(lambda: field.states() == ["DEFOCUSED", "DEFOCUSED"], 5.0)

    run(main, "TRACKING", longest_autonomy=20.0)


@pytest.mark.parametrize(
    ("lease", "text"),
    [
        (Lease(TOKEN, lifetime=60.0), "the lease must last 1 to 3 s, not 60 s"),
        (Lease(TOKEN, lifetime=0.5), "the lease must last 1 to 3 s, not 0.5 s"),
        (Lease(-1), "token -1 and autonomy 0 s: out of range"),
        (Lease(TOKEN, autonomy=-1.0), "autonomy -1 s: out of range"),
    ],
)
def test_a_lease_out_of_range_is_refused(lease: Lease, text: str) -> None:
    async def main(field: Field) -> None:
        field.plant.leases = False
        await asyncio.sleep(5.0)
        await field.plant.send(lease)
        await field.until(lambda: bool(field.plant.alarms("lease_refused")))
        assert text in field.plant.alarms("lease_refused")[0].text
        assert field.plant.status().lease_left < 0.0

    run(main)


def test_a_clock_that_jumps_defocuses_until_somebody_acknowledges() -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(3.0)
        field.clock.jump(5.0)
        await field.until(lambda: field.states() == ["DEFOCUSED", "DEFOCUSED"], 3.0)
        second = field.boards[0].node.controller.clock.second
        await asyncio.sleep(5.0)
        # The jumped time is not passed on while it settles.
        assert field.boards[0].node.controller.clock.second == second + 5
        await field.order("soon", "TRACK")
        await field.until(
            lambda: bool(
                field.plant.stages("soon", "A1")
                or "soon"
                in [each.identity for each in field.plant.heard if hasattr(each, "identity")]
            )
        )
        assert "clock_jump" in field.plant.text("soon")
        await field.plant.send(Acknowledge("early", "clock_jump", "Ada", "operator"))
        await asyncio.sleep(1.5)
        assert "the cause is not gone" in field.plant.text("early")
        await asyncio.sleep(25.0)
        await field.plant.send(Acknowledge("wrong", "clock_jump", "Ada", "visitor"))
        await field.plant.send(Acknowledge("ack", "clock_jump", "Ada", "operator"))
        await asyncio.sleep(1.5)
        assert "role 'visitor' is not known; specify operator or supervisor" in field.plant.text(
            "wrong"
        )
        assert field.plant.status().acts == ()
        await field.until(field.sun_is_fresh, 5.0)

    run(main, "TRACKING")


def test_a_jump_before_the_first_second_is_seen_though_the_keeper_hides_it() -> None:
    """Simulated run 910519: the time was only compared from one second to the next."""
    clock = VirtualClock(lambda: 100.0, datetime(2026, 6, 21, 12, tzinfo=UTC))
    before = SimulatedTime(clock).time()
    watch = Watch("C", 0.0, Reports(), 100.0, before, {})
    keeper = SimulatedTime(clock)
    keeper.detects = False
    keeper.jump(-3600.0)
    watch.second(keeper.time(), 0.0, 100.7)
    assert watch.verdict.dark


def test_a_jump_behind_a_short_loss_of_time_is_seen() -> None:
    """Simulated run 30064: the time was only compared with that of the second before."""
    clock = VirtualClock(lambda: 100.0, datetime(2026, 6, 21, 12, tzinfo=UTC))
    keeper = SimulatedTime(clock)
    keeper.detects = False
    good = keeper.time()
    watch = Watch("C", 0.0, Reports(), 100.0, good, {})
    lost = dataclasses.replace(good, quality="none", error=math.inf)
    assert not any("clock_jump" in act for act in watch.second(lost, 0.0, 100.7).acts)
    keeper.jump(-3600.0)
    assert any("clock_jump" in act for act in watch.second(keeper.time(), 0.0, 101.7).acts)


def test_a_cluster_goes_by_the_limits_of_the_site() -> None:
    clock = VirtualClock(lambda: 100.0, datetime(2026, 6, 21, 12, tzinfo=UTC))
    time = SimulatedTime(clock, error=0.4).time()
    tight = {"holdover_exhausted": {"trips_s": 0.3, "releases_s": 0.2}}
    for limits in ({}, tight):
        watch = Watch("C", 0.0, Reports(), 100.0, time, limits)
        acts = watch.second(time, 0.0, 100.7).acts
        assert ("DEFOCUS holdover_exhausted" in acts) == (limits is tight)


def test_a_time_without_a_source_sends_no_sun() -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(3.0)
        good = field.time.time
        field.time.time = lambda: dataclasses.replace(good(), quality="none", error=float("inf"))
        await field.until(lambda: field.states() == ["DEFOCUSED", "DEFOCUSED"], 3.0)
        assert any("holdover_exhausted" in act for act in field.plant.status().acts)
        field.time.time = good
        await field.until(lambda: field.plant.status().acts == (), 20.0)
        await field.order("again", "TRACK")
        await field.until(lambda: field.states() == ["TRACKING", "TRACKING"], 5.0)

    run(main, "TRACKING")


def test_an_open_emergency_line_defocuses() -> None:
    closed = [True]

    async def main(field: Field) -> None:
        await asyncio.sleep(3.0)
        closed[0] = False
        await field.until(lambda: field.states() == ["DEFOCUSED", "DEFOCUSED"], 2.5)
        assert field.plant.alarms("emergency_line")[0].severity is Severity.EMERGENCY

    run(main, "TRACKING", line=lambda: closed[0])


def test_no_sun_is_sent_while_the_safety_table_says_dark() -> None:
    closed = [True]
    sent: list[tuple[float, str]] = []

    class Heard(TwinBus):
        def carry(self, frame: bytes) -> bytes:
            (read,) = wire.Reader().feed(frame)
            sent.append((self._clock.monotonic(), messages.name_of(read.number)))
            return super().carry(frame)

    async def main(field: Field) -> None:
        await asyncio.sleep(3.0)
        assert "SUN" in {name for _, name in sent}
        closed[0] = False
        opened = field.clock.monotonic()
        await asyncio.sleep(10.0)
        # The time is sound and the plant's lease lasts: only the table forbids it.
        after = [name for at, name in sent if at > opened + 1.1]
        assert "TIME" in after
        assert "SUN" not in after

    run(
        main,
        "TRACKING",
        line=lambda: closed[0],
        bus=lambda clock, boards: Heard(clock, [*boards]),
    )


def test_an_emergency_reaches_all_at_once_and_names_who_does_not_answer() -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(3.3)
        field.boards[1].on = False
        begin = field.clock.monotonic()
        await field.emergency("stop", "DEFOCUS")
        await field.until(lambda: field.states()[0] == "DEFOCUSED", 0.3)
        await field.until(lambda: Stage.ACKNOWLEDGED in field.plant.stages("stop", "A1"), 0.6)
        assert field.clock.monotonic() - begin < 1.0
        await field.until(lambda: bool(field.plant.alarms("order_unacknowledged")), 3.0)
        (alarm,) = field.plant.alarms("order_unacknowledged")
        assert (alarm.subject, alarm.severity) == ("A2", Severity.EMERGENCY)
        assert "A2 has not acknowledged DEFOCUS" in alarm.text
        # It comes back with its motors where they were, and is told at once.
        await asyncio.sleep(10.0)
        field.boards[1].on = True
        field.boards[1].node.controller.sun.end()
        await field.until(lambda: Stage.DONE in field.plant.stages("stop", "A2"), 12.0)
        await field.until(lambda: not field.plant.alarms("order_unacknowledged")[-1].active)
        assert Stage.DONE in field.plant.stages("stop", "A1")

    run(main, "TRACKING")


def test_an_emergency_is_given_up_for_the_plant_but_asked_further() -> None:
    async def main(field: Field) -> None:
        field.boards[1].on = False
        await field.emergency("stop", "STOW")
        await field.until(lambda: Stage.FAILED in field.plant.stages("stop", "A2"), 35.0)
        assert "STOW not acknowledged within 30 s; it is repeated" in field.plant.text("stop")
        field.boards[1].boot(field.clock.monotonic())
        await field.until(lambda: not field.plant.alarms("order_unacknowledged")[-1].active, 10.0)

    run(main)


def test_an_emergency_goes_before_orders_and_needs_no_token() -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(3.0)
        field.plant.leases = False
        for k in range(40):
            await field.order(f"aim{k}", "AIM", 0.0, 0.0, 50.0 + k)
        await field.emergency("one", "STOW", "A2")
        await field.until(lambda: field.states() == ["TRACKING", "STOWING"], 0.2)
        await field.emergency("wrong", "TRACK")
        await field.emergency("nobody", "STOW", "A9")
        await field.until(lambda: Stage.ACKNOWLEDGED in field.plant.stages("one", "A2"), 1.0)
        await asyncio.sleep(1.0)
        assert "'TRACK' is not an emergency" in field.plant.text("wrong")
        assert "cluster C1 has no heliostat 'A9'" in field.plant.text("nobody")
        assert "STOW came before it" in field.plant.text("aim39", "A2")

    run(main, "TRACKING")


@pytest.mark.parametrize("name", ["DEFOCUS", "STOW"])
def test_an_emergency_with_an_unknown_name_reaches_those_that_are_there(name: str) -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(3.0)
        await field.emergency("mixed", name, "A9", "A2")
        away = "DEFOCUSED" if name == "DEFOCUS" else "STOWING"
        await field.until(lambda: field.states() == ["TRACKING", away], 0.2)
        await field.until(lambda: Stage.ACKNOWLEDGED in field.plant.stages("mixed", "A2"), 1.0)
        assert field.plant.stages("mixed", "A9") == [Stage.REFUSED]
        assert "cluster C1 has no heliostat 'A9'" in field.plant.text("mixed", "A9")

    run(main, "TRACKING")


def test_what_was_made_without_a_line_names_its_rows() -> None:
    """After a restart with another file of as many mirrors, rows counted as other mirrors'."""

    async def scene(field: Field) -> None:
        field.line.cut(first_to_second=True, second_to_first=True)
        await field.until(lambda: not field.link.connected, 30.0)
        await asyncio.sleep(3.0)
        before = len(field.plant.all(ClusterStatus))
        field.line.cut(first_to_second=False, second_to_first=False)
        await field.until(lambda: len(field.plant.all(ClusterStatus)) > before, 30.0)
        assert field.plant.all(ClusterStatus)[before].names == ("A1", "A2")

    run(scene)


def test_a_cluster_begins_with_a_defocus_of_whatever_is_up() -> None:
    """A mirror that was missing in an older file tracked on for 391 s, and nobody saw it."""
    boards, start = boards_in("TRACKING")

    async def main(clock: VirtualClock) -> None:
        one = config_of(2).heliostats[:1]
        field = Field(clock, boards=boards, heliostats=one)
        async with field.alive():
            await field.until(lambda: field.states() == ["DEFOCUSED", "DEFOCUSED"], 2.0)
            assert field.plant.status().names == ("A1",)
            assert not field.plant.all(Alarm)  # nobody must answer for it

    run_virtual(main, start=start)


def test_the_defocus_of_a_start_waits_for_the_bus() -> None:
    boards, start = boards_in("TRACKING")

    async def main(clock: VirtualClock) -> None:
        field = Field(clock, boards=boards)
        field.bus.plugged = False
        async with field.alive():
            await asyncio.sleep(1.0)
            assert field.states() == ["TRACKING", "TRACKING"]
            field.bus.plugged = True
            await field.until(lambda: field.states() == ["DEFOCUSED", "DEFOCUSED"], 2.0)

    run_virtual(main, start=start)


def test_a_heliostat_that_tells_no_step_counts_is_reported_with_its_beam() -> None:
    """Its state is answered, so it is not silent; but its beam may be anywhere."""

    async def main(field: Field) -> None:
        await asyncio.sleep(3.0)
        real, lost = field.bus.carry, [True]

        def carry(frame: bytes) -> bytes:
            read = wire.Reader().feed(frame)[0]
            steps = read.number == messages.NUMBER_OF["QUERY_STEPS"] and read.to == 1
            return b"" if steps and lost[0] else real(frame)

        field.bus.carry = carry
        await field.until(lambda: bool(field.plant.alarms("node_silent")), 15.0)
        (alarm,) = field.plant.alarms("node_silent")
        assert alarm.severity is Severity.ALARM
        assert alarm.text.startswith(
            "A1: no reply for 10 s; it is TRACKING and does not report its step counts; "
            "the position of its beam is unknown. "
        )
        lost[0] = False
        await field.until(lambda: not field.plant.alarms("node_silent")[-1].active, 8.0)

    run(main, "TRACKING")


def test_a_heliostat_that_falls_silent_is_reported_with_its_beam() -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(3.0)
        field.boards[0].on = False
        await field.until(lambda: bool(field.plant.alarms("node_silent")), 13.0)
        (alarm,) = field.plant.alarms("node_silent")
        assert alarm.severity is Severity.ALARM
        assert alarm.text.startswith(
            "A1: no reply for 10 s; its last state was TRACKING; "
            "the position of its beam is unknown. "
        )
        rows = field.plant.status().nodes()
        assert rows["heard_ms"][0] > 9000
        assert rows["heard_ms"][1] < 200
        field.boards[0].boot(field.clock.monotonic())
        await field.until(lambda: not field.plant.alarms("node_silent")[-1].active, 8.0)

    run(main, "TRACKING")


class Selective(TwinBus):
    """A bus that loses the answers to some questions, or puts one of before in their place."""

    lost = False
    kept: bytes = b""

    def carry(self, frame: bytes) -> bytes:
        answer = super().carry(frame)
        if wire.Reader().feed(frame)[0].name != "QUERY_STATUS":
            return answer
        if self.kept:
            return self.kept
        return b"" if self.lost else answer


def selective(clock: object, boards: list[Board]) -> Selective:
    return Selective(clock, [*boards])  # type: ignore[arg-type]


def test_an_acknowledgement_makes_no_old_state_young() -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(3.0)
        field.bus.lost = True
        for k in range(8):
            await field.order(f"aim{k}", "AIM", *AIM)
            await asyncio.sleep(1.0)
            assert Stage.ACKNOWLEDGED in field.plant.stages(f"aim{k}", "A1")
        row = field.plant.status().nodes()[0]
        assert 6900 < row["heard_ms"] < 9500
        assert row["state"] == states.TRACKING
        await field.plant.send(Ask("s", "statistics"))
        await field.until(lambda: bool(field.plant.all(Answer)))
        assert field.plant.all(Answer)[0].data["A1"]["heard_s"] < 1.5

    run(main, "TRACKING", bus=selective)


def test_who_has_only_acknowledged_is_not_told_to_be_in_any_state() -> None:
    def dumb(clock: object, boards: list[Board]) -> Selective:
        bus = selective(clock, boards)
        bus.lost = True
        return bus

    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        await field.emergency("stow", "STOW")
        await field.until(lambda: Stage.ACKNOWLEDGED in field.plant.stages("stow", "A1"))
        await asyncio.sleep(2.0)
        rows = field.plant.status().nodes()
        assert (rows["answered"] > 0).all()
        assert (rows["heard_ms"] == NEVER).all()
        assert "C1: not heard 2; silent 0" in field.cluster.line()
        await field.plant.send(Ask("sums", "checksums"))
        await field.until(lambda: bool(field.plant.all(Answer)))
        assert field.plant.all(Answer)[0].data == {}
        await field.until(lambda: len(field.plant.alarms("node_silent")) == 2, 15.0)
        alarm = field.plant.alarms("node_silent")[0]
        assert alarm.severity is Severity.WARNING
        assert alarm.text.startswith("A1: no reply for 10 s; it has never reported its state. ")

    run(main, bus=dumb)


def test_an_answer_that_comes_many_seconds_late_is_not_believed() -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(3.0)
        node = field.cluster.nodes[0]
        frame = _nodes.STATUS.frame(node.address, node.next_sequence())
        field.bus.kept = field.boards[0].hear(frame, field.clock.monotonic())
        assert field.bus.kept
        late = node.counts.late
        await asyncio.sleep(60.0)
        # Whatever the number of rounds since, it is the answer to another question.
        assert node.counts.late >= late + 10
        assert field.plant.status().nodes()["heard_ms"][0] > 58_000

    run(main, "TRACKING", bus=selective)


def test_damaged_answers_are_counted_and_never_believed() -> None:
    async def main(field: Field) -> None:
        field.bus.faults = BusFaults(corruption=0.2, burst=0.1, duplication=0.1, late=0.1)
        await asyncio.sleep(60.0)
        for node in field.cluster.nodes:
            counts = node.counts
            assert counts.corrupt > 0
            assert counts.late + counts.silent > 0
            missed = counts.corrupt + counts.late + counts.silent
            assert counts.asked == counts.answered + missed
            assert node.state == states.STOWED
        assert any("bus_errors" in act for act in field.plant.status().acts)
        field.bus.faults = BusFaults()
        await field.until(lambda: field.plant.status().acts == (), 60.0)

    run(main)


def test_a_bus_that_is_gone_is_an_alarm_and_comes_back() -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(3.0)
        field.bus.plugged = False
        # No sun reaches them: each defocuses by itself.
        await field.until(lambda: field.states() == ["DEFOCUSED", "DEFOCUSED"], 8.0)
        await field.until(lambda: bool(field.plant.alarms("bus_failed")), 5.0)
        assert field.cluster.nodes[0].missed == 0
        await asyncio.sleep(3.0)
        field.bus.plugged = True
        await field.until(lambda: field.plant.status().acts == (), 45.0)
        assert field.plant.status().nodes()["heard_ms"].max() < 200
        await asyncio.sleep(1.0)
        assert not field.plant.alarms("bus_failed")[-1].active

    run(main, "TRACKING")


def test_who_misses_the_call_is_told_again() -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(3.0)
        # The second hears nothing of the cluster for a moment, but keeps its lease.
        field.line.cut()
        deaf = field.boards[1]
        await asyncio.sleep(2.0)
        deaf.on = False
        await asyncio.sleep(2.5)
        deaf.on = True
        await field.until(lambda: field.states() == ["DEFOCUSED", "DEFOCUSED"], 3.0)

    run(main, "TRACKING")


def test_who_brings_its_beam_out_in_the_dark_is_told_again() -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(3.0)
        field.line.cut()
        await field.until(lambda: field.states() == ["DEFOCUSED", "DEFOCUSED"], 6.0)
        await asyncio.sleep(2.0)
        own = field.boards[1].node.controller
        own.state = states.IDLE
        own.motion.hold()
        await field.until(lambda: field.states() == ["DEFOCUSED", "DEFOCUSED"], 3.0)

    run(main, "TRACKING")


def test_after_a_restart_frames_of_before_are_void(tmp_path: pytest.TempPathFactory) -> None:
    path = tmp_path / "C1.state.json"  # type: ignore[operator]
    boards = [Board(1), Board(2)]
    old: list[bytes] = []

    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        sender = field.cluster._exchange.sender
        expires = int(field.cluster._broadcast.bus_time() or 0) + 25
        await asyncio.sleep(0.0)
        token = field.cluster._exchange.token(TOKEN)
        sender.count += 500  # a frame that is new by its number in the next epoch too
        old.append(sender.frame(1, "AIM", token, expires, 1.0, 2.0, 3.0))

    run(main, boards=boards, kept=Kept(path))
    first = Kept(path).epoch

    async def again(field: Field) -> None:
        assert Kept(path).epoch > first
        await field.until(field.sun_is_fresh)
        board = field.boards[0]
        motion = board.node.controller.motion
        before = motion.aim
        answer = board.hear(old[0], field.clock.monotonic())
        assert answer
        assert motion.aim == before
        await field.order("aim", "AIM", 0.0, 0.0, 50.0)
        await field.until(lambda: field.plant.stages("aim", "A1") == ALL_STAGES, 3.0)

    run(again, boards=boards, kept=Kept(path))


def test_a_node_that_starts_anew_is_taken_in() -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(3.0)
        boots = field.plant.status().nodes()["boots"][0]
        field.boards[0].on = False
        await asyncio.sleep(2.0)
        field.boards[0].boot(field.clock.monotonic())
        await field.until(field.sun_is_fresh, 3.0)
        await field.until(lambda: field.plant.status().nodes()["boots"][0] == boots + 1, 10.0)
        assert field.states() == ["DEFOCUSED", "TRACKING"]

    run(main, "TRACKING")


def test_a_cluster_runs_once() -> None:
    async def main(field: Field) -> None:
        with pytest.raises(LinkError, match="cluster C1: it is already running"):
            await field.cluster.run()

    run(main)


def test_the_bus_may_be_closed_first() -> None:
    boards, start = boards_in("IDLE")

    async def main(clock: VirtualClock) -> None:
        field = Field(clock, boards=boards)
        async with running(field.cluster, field.link):
            async with running(field.bus):
                await asyncio.sleep(2.2)
            await asyncio.sleep(2.0)

    run_virtual(main, start=start)


def test_what_no_plant_says_is_an_alarm() -> None:
    async def main(field: Field) -> None:
        await field.plant.link.send(b"nonsense")
        await field.until(lambda: bool(field.plant.alarms("plant_unintelligible")))
        await asyncio.sleep(0.5)
        await field.plant.link.send(encode(ClusterStatus("C9", 0, 0.0, "gps", 0.0, 0.0, 0.0)))
        await asyncio.sleep(2.0)
        first, second = field.plant.alarms("plant_unintelligible")
        assert "message of 8 bytes does not begin with JSON" in first.text
        assert "the plant sent a status message, which only clusters may send" in second.text
        assert field.states() == ["STOWED", "STOWED"]

    run(main)


def test_an_emergency_that_finds_no_bus_is_carried_out_when_it_is_back() -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(3.0)
        field.bus.plugged = False
        await field.emergency("stop", "STOW")
        await asyncio.sleep(2.5)
        assert field.states() == ["TRACKING", "TRACKING"]
        named = {alarm.subject for alarm in field.plant.alarms("order_unacknowledged")}
        assert named == {"A1", "A2"}
        field.bus.plugged = True
        await field.until(lambda: field.states() == ["STOWING", "STOWING"], 1.2)
        await field.until(lambda: Stage.ACKNOWLEDGED in field.plant.stages("stop", "A2"), 1.2)

    run(main, "TRACKING")


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_no_order_of_callbacks_and_no_damage_keeps_a_mirror_on_the_receiver(seed: int) -> None:
    async def main(field: Field) -> None:
        field.bus.faults = BusFaults(loss=0.15, corruption=0.1, late=0.1, duplication=0.05)
        await asyncio.sleep(3.0)
        await field.emergency("stop", "DEFOCUS")
        await field.until(lambda: field.states() == ["DEFOCUSED", "DEFOCUSED"], 1.0)
        for name in ("A1", "A2"):
            await field.until(
                lambda name=name: field.plant.stages("stop", name)[-1:] == [Stage.DONE], 25.0
            )

    run(main, "TRACKING", seed=seed)


def test_without_a_known_time_a_second_lasts_a_second() -> None:
    async def main(field: Field) -> None:
        known = field.time.time()
        unknown = dataclasses.replace(known, quality="none")
        assert field.cluster._next_due(5.0, unknown) == 6.0
        phase = field.cluster.config.phase
        for ahead, due in ((-0.01, 6.01), (0.01, 5.99)):
            present = dataclasses.replace(known, gps_s=known.gps_s // 1.0 + phase + ahead)
            assert present.usable
            assert field.cluster._next_due(5.0, present) == pytest.approx(due, abs=1e-6)

    run(main)
