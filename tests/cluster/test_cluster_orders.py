"""Commands, parameters and questions on their way through a cluster to real local controllers."""

import asyncio
import dataclasses
import struct
from binascii import crc32
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from heliotrope.cluster._goals import Goals
from heliotrope.cluster._reports import Reports
from heliotrope.cluster.memory import Kept
from heliotrope.lcu import messages, states, wire
from heliotrope.lcu.controller import SWITCH
from heliotrope.lcu.journal import CODES_OF
from heliotrope.links.link import SendOutcome
from heliotrope.links.messages import (
    Answer,
    Ask,
    ClusterStatus,
    Command,
    Parameters,
    Progress,
    Stage,
    decode,
)
from heliotrope.safety import Alarm, alarms
from heliotrope.twin.boards.bus import TwinBus
from support.clusters import AIM, TOKEN, Board, Field, SlotBus, config_of, run
from support.lcu_machines import heliostat, items_of_heliostat

ALL_STAGES = [Stage.ACCEPTED, Stage.SENT, Stage.ACKNOWLEDGED, Stage.DONE]


class Interrupted(TwinBus):
    """A bus that loses the answers to the next frames of some messages."""

    def lose(self, name: str, count: int) -> None:
        self.number, self.left = messages.NUMBER_OF[name], count
        self.lost: list[bytes] = []

    def carry(self, frame: bytes) -> bytes:
        answer = super().carry(frame)
        if getattr(self, "left", 0) and wire.Reader().feed(frame)[0].number == self.number:
            self.left -= 1
            self.lost.append(frame)
            return b""
        return answer


def interrupted(clock: object, boards: list[Board]) -> Interrupted:
    return Interrupted(clock, [*boards])  # type: ignore[arg-type]


async def final(field: Field, identity: str, name: str = "A1", limit: float = 15.0) -> Stage:
    """Wait for the last stage of a command."""
    ends = (Stage.DONE, Stage.REFUSED, Stage.FAILED)
    await field.until(
        lambda: (
            field.plant.stages(identity, name)[-1:]
            and field.plant.stages(identity, name)[-1] in ends
        ),
        limit,
    )
    return field.plant.stages(identity, name)[-1]


@pytest.mark.parametrize(
    ("command", "text"),
    [
        (
            Command("c", "TRACK", token=TOKEN + 1),
            "no command authority, because the token is out of date",
        ),
        (Command("c", "TRACK"), "no command authority"),
        (Command("c", "FLY", token=TOKEN), "'FLY' is not a command for local controllers"),
        (Command("c", "SESSION", token=TOKEN), "'SESSION' is not a command for local controllers"),
        (Command("c", "TRACK", heliostats=("A1", "B7"), token=TOKEN), "has no heliostat 'B7'"),
        (Command("c", "AIM", (1.0, 2.0), token=TOKEN), "AIM: 4 values, 5 needed"),
        (Command("c", "JOG", (0.0, 1.5), token=TOKEN), "JOG, value 4: 1.5 is not a whole number"),
        (Command("c", "LOCK_AIM", (300.0,), token=TOKEN), "300 is not within 0 to 255"),
        (
            Command("c", "TRACK", token=TOKEN, lifetime=-1.0),
            "the lifetime must be above 0 and at most 3600 s, not -1 s",
        ),
    ],
)
def test_a_command_that_cannot_be_is_refused(command: Command, text: str) -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        await field.plant.send(command)
        await field.until(lambda: any(getattr(m, "identity", "") == "c" for m in field.plant.heard))
        assert text in field.plant.text("c")
        assert field.states() == ["STOWED", "STOWED"]

    run(main)


def test_a_command_with_an_unknown_name_reaches_those_that_are_there() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        await field.order("mixed", "TRACK", heliostats=("B7", "A2"))
        await field.until(lambda: field.states() == ["IDLE", "TRACKING"], 3.0)
        assert field.plant.stages("mixed", "B7") == [Stage.REFUSED]
        assert "cluster C1 has no heliostat 'B7'" in field.plant.text("mixed", "B7")
        await field.until(lambda: Stage.DONE in field.plant.stages("mixed", "A2"), 3.0)

    run(main, "IDLE")


def test_without_a_lease_nobody_may_command() -> None:
    async def main(field: Field) -> None:
        field.plant.token = 0
        await asyncio.sleep(2.0)
        await field.order("c", "LOCK")
        await asyncio.sleep(0.5)
        assert "nobody has the command authority" in field.plant.text("c")

    run(main)


def test_a_state_that_forbids_it_is_said_in_words() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        await field.order("c", "TRACK", heliostats=("A1",))
        assert await final(field, "c") is Stage.REFUSED
        assert field.plant.text("c") == "TRACK: not in this state (STOWED)"

    run(main)


def test_stages_go_on_to_the_state_that_is_asked_for() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        await field.order("track", "TRACK", heliostats=("A1",))
        assert await final(field, "track") is Stage.DONE
        await field.order("go", "GOTO", 100.0, 200.0, heliostats=("A2",))
        await asyncio.sleep(2.5)
        # It is under way.
        assert field.plant.stages("go", "A2") == ALL_STAGES[:3]
        await field.order("stop", "LOCK", heliostats=("A2",))
        assert await final(field, "go", "A2") is Stage.FAILED
        assert "LOCK came after it" in field.plant.text("go")
        assert await final(field, "stop", "A2") is Stage.DONE
        assert field.states() == ["TRACKING", "LOCKED"]

    run(main, "IDLE")


def test_a_lost_answer_is_asked_for_again_and_nothing_acts_twice() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        motion = field.boards[0].node.controller.motion
        await field.order("idle", "LOCK", heliostats=("A1",))
        await final(field, "idle")
        await field.order("free", "UNLOCK", heliostats=("A1",))
        assert await final(field, "free") is Stage.DONE
        before = motion.goal(0)
        field.bus.lose("JOG", 2)
        await field.order("jog", "JOG", 0.0, 500.0, heliostats=("A1",))
        # The third frame is the first: "duplicate" says that it was taken.
        assert await final(field, "jog") is Stage.DONE
        assert motion.goal(0) == before + 500
        assert len(set(field.bus.lost)) == 1
        assert field.cluster.nodes[0].counts.retries == 2
        # A fourth would be a new frame, which might act again: rather give up.
        field.bus.lose("JOG", 3)
        await field.order("more", "JOG", 0.0, 500.0, heliostats=("A1",))
        assert await final(field, "more") is Stage.FAILED
        assert "no reply to JOG; the controller may have accepted it" in field.plant.text("more")
        await asyncio.sleep(3.0)
        assert motion.goal(0) == before + 1000

    run(main, "IDLE", bus=interrupted)


def test_the_haste_of_an_emergency_ends_with_it() -> None:
    """While one waits nothing is repeated; afterwards a lost answer is asked for at once again."""

    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        await field.emergency("off", "DEFOCUS", "A2")
        assert await final(field, "off", "A2") is Stage.DONE
        field.bus.lose("JOG", 2)
        await field.order("jog", "JOG", 0.0, 500.0, heliostats=("A1",))
        await field.until(lambda: Stage.ACKNOWLEDGED in field.plant.stages("jog", "A1"), 0.9)
        assert len(field.bus.lost) == 2

    run(main, "IDLE", bus=interrupted)


def test_who_answers_everything_but_an_emergency_is_asked_for_it_once_a_second() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        field.bus.lose("DEFOCUS", 1000)
        await field.emergency("off", "DEFOCUS", "A2")
        await asyncio.sleep(4.0)
        before = len(field.bus.lost)
        assert before >= 5, "three times at once, and each second"
        await asyncio.sleep(10.0)
        assert 9 <= len(field.bus.lost) - before <= 11
        field.bus.left = 0
        await field.until(lambda: Stage.ACKNOWLEDGED in field.plant.stages("off", "A2"), 2.0)

    run(main, "TRACKING", bus=interrupted)


@pytest.mark.parametrize("lost", [0, 1, 2])
@pytest.mark.parametrize("steps", [500.0, -30.0, 3.0])
def test_a_jog_is_done_only_if_the_counts_go_elsewhere(lost: int, steps: float) -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        for name in ("A1", "A2"):
            for what in ("LOCK", "UNLOCK"):
                await field.order(name + what, what, heliostats=(name,))
                assert await final(field, name + what, name) is Stage.DONE
        taker, refuser = (board.node.controller for board in field.boards)
        goals = taker.motion.goal(1), refuser.motion.goal(1)
        refuser._may_move = lambda name, values: messages.BAD_VALUE
        for name, identity in (("A1", "taken"), ("A2", "refused")):
            field.bus.lose("JOG", lost)
            await field.order(identity, "JOG", 1.0, steps, heliostats=(name,))
            await final(field, identity, name)
        assert field.plant.stages("taken", "A1") == ALL_STAGES
        # Its first answer was lost, the others say "duplicate".
        end = Stage.FAILED if lost else Stage.REFUSED
        assert field.plant.stages("refused", "A2")[-1] is end
        text = "nothing shows that the command was accepted" if lost else "value out of range"
        assert text in field.plant.text("refused")
        assert (taker.motion.goal(1), refuser.motion.goal(1)) == (goals[0] + steps, goals[1])

    run(main, "IDLE", bus=interrupted)


def test_a_jog_of_no_axis_is_refused_or_not_shown() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        for lost, end in ((0, Stage.REFUSED), (1, Stage.FAILED)):
            field.bus.lose("JOG", lost)
            await field.order(f"{lost}", "JOG", 7.0, 10.0, heliostats=("A1",))
            assert await final(field, f"{lost}") is end

    run(main, "IDLE", bus=interrupted)


def test_where_the_answer_was_lost_the_state_decides() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        field.bus.lose("TRACK", 4)
        await field.order("track", "TRACK", heliostats=("A1",))
        assert await final(field, "track") is Stage.DONE
        assert len(set(field.bus.lost)) == 2
        # An aim is set again, until the answer to one has come.
        field.bus.lose("AIM", 4)
        await field.order("aim", "AIM", 0.0, 0.0, 52.0, heliostats=("A1",))
        assert await final(field, "aim") is Stage.DONE
        assert field.boards[0].node.controller.motion.aim == (0.0, 0.0, 52.0)

    run(main, "IDLE", bus=interrupted)


@pytest.mark.parametrize("lost", [1, 2, 3, 4, 5, 6])
def test_a_search_is_done_only_if_it_was_begun(lost: int) -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        field.bus.lose("SEARCH", lost)
        await field.order("search", "SEARCH", 2e-3, 3e-2, heliostats=("A1",))
        assert await final(field, "search") is Stage.DONE
        assert field.boards[0].state == "SEARCHING"
        # The other refuses it, and stays in IDLE, which is where a search ends.
        field.boards[1].node.controller._may_go = lambda up: messages.REFUSED_STATE
        field.bus.lose("SEARCH", lost)
        await field.order("other", "SEARCH", 2e-3, 3e-2, heliostats=("A2",))
        assert await final(field, "other", "A2") is Stage.FAILED
        assert field.boards[1].state == "IDLE"
        assert field.plant.text("other") == (
            "SEARCH: its reply was lost, and nothing shows that the command was accepted; the "
            "state is IDLE"
        )

    run(main, "IDLE", bus=interrupted)


def test_a_diagnosis_whose_answers_were_lost_is_done_if_it_was_seen() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        field.bus.lose("DIAGNOSE", 4)
        await field.order("d", "DIAGNOSE", heliostats=("A1",))
        assert await final(field, "d", limit=200.0) is Stage.DONE

    run(main, "IDLE", bus=interrupted)


def test_a_command_that_nobody_answers_expires() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        field.boards[0].on = False
        begin = field.clock.monotonic()
        await field.order("aim", "AIM", *AIM, heliostats=("A1",), lifetime=4.0)
        assert await final(field, "aim") is Stage.FAILED
        assert 4.0 <= field.clock.monotonic() - begin < 5.5
        assert "no reply to AIM before the command expired" in field.plant.text("aim")
        field.boards[0].on = True
        await asyncio.sleep(3.0)
        assert field.boards[0].node.controller.motion.aim is None

    run(main)


def test_the_authority_that_changes_voids_what_waits() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        field.boards[0].on = False
        await field.order("aim", "AIM", *AIM, heliostats=("A1",), lifetime=9.0)
        await asyncio.sleep(1.5)
        field.plant.token = 77
        assert await final(field, "aim") is Stage.FAILED
        assert "command authority has changed" in field.plant.text("aim")

    run(main)


def test_nodes_out_of_step_get_a_new_epoch() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        node = field.boards[0].node
        epoch = node.controller.gate.replay.epoch
        # As if it had heard frames of another sender that numbers far ahead.
        node.controller.gate.replay.count += 30000
        await field.order("aim", "AIM", *AIM, heliostats=("A1",))
        assert await final(field, "aim") is Stage.DONE
        assert node.controller.gate.replay.epoch > epoch

    run(main)


def test_one_node_out_of_step_gets_a_new_epoch_though_the_others_are_in_step() -> None:
    """Simulated run 960397: what others took hid that one node took a stranger's frame for new."""

    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        replay = field.boards[0].node.controller.gate.replay
        epoch = replay.epoch
        replay.count += 30000
        await field.order("aim", "AIM", *AIM, heliostats=("A1",))
        for number in range(9):
            await field.order(f"other-{number}", "AIM", *AIM, heliostats=("A2",))
            await asyncio.sleep(0.5)
        assert replay.epoch > epoch
        assert await final(field, "aim") is Stage.DONE
        # It is no help for a node that answers so always, and is not tried each time.
        epoch = replay.epoch
        for number in range(6):
            replay.count += 30000
            await field.order(f"aim-{number}", "AIM", *AIM, heliostats=("A1",))
            await field.order(f"more-{number}", "AIM", *AIM, heliostats=("A2",))
            await asyncio.sleep(1.0)
        assert replay.epoch == epoch

    run(main)


# -- parameters ------------------------------------------------------------------------


def new_items() -> dict[str, bytes]:
    items = items_of_heliostat(heliostat())
    numbers = list(struct.unpack(CODES_OF["armature"], items["armature"]))
    numbers[15] += 1e-4
    changed = {name: items[name] for name in ("limits_primary", "drive_secondary", "standby")}
    return changed | {
        "armature": struct.pack(CODES_OF["armature"], *numbers),
        "biases": struct.pack("<ff", 0.001, -0.002),
        "location": struct.pack("<ddd", 40.5, 80.0, 0.25),
    }


def test_parameters_are_written_item_by_item_and_read_back() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        items = new_items()
        await field.order("lock", "LOCK", heliostats=("A1",))
        await final(field, "lock")
        field.bus.lose("SET_ARMATURE", 2)
        await field.plant.send(Parameters.of("p", "A1", items, TOKEN))
        assert await final(field, "p") is Stage.DONE
        assert field.plant.stages("p", "A1") == ALL_STAGES
        journal = field.boards[0].node.journal
        assert {name: journal.items[name] for name in items} == items
        await field.plant.send(Ask("sums", "checksums"))
        await field.plant.send(Ask("all", "stored", "A1"))
        await field.until(lambda: len(field.plant.all(Answer)) == 2, 3.0)
        sums, all_ = field.plant.all(Answer)
        assert sums.data["A1"] == crc32(items["armature"]) != sums.data["A2"]
        place = sum(all_.data["sizes"][: all_.data["names"].index("biases")])
        assert all_.block[place : place + 8] == items["biases"]

    run(main, bus=interrupted)


@pytest.mark.parametrize(("lost", "answered"), [(2, True), (8, True), (9, False)])
def test_what_is_stored_is_asked_for_in_three_seconds(lost: int, answered: bool) -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        field.bus.lose("QUERY_STORED", lost)
        begin = field.clock.monotonic()
        await field.plant.send(Ask("all", "stored", "A1"))
        await field.until(lambda: bool(field.plant.all(Answer)), 6.0)
        (answer,) = field.plant.all(Answer)
        if answered:
            held = field.boards[0].node.journal.items
            assert {"armature", "location", "edition"} <= set(answer.data["names"])
            sizes = dict(zip(answer.data["names"], answer.data["sizes"], strict=True))
            assert sizes["armature"] == len(held["armature"])
            assert len(answer.block) == sum(answer.data["sizes"])
        else:
            assert answer.data == {"error": "A1 does not answer"}
            assert field.clock.monotonic() - begin > 1.0

    run(main, bus=interrupted)


def test_editions_rise_over_restarts_and_above_what_the_node_holds() -> None:
    kept = Kept(None)
    boards = [Board(1), Board(2)]

    async def main(field: Field) -> None:
        field.boards[0].node.controller.gate.edition = 500
        field.boards[0].node.journal.store({"edition": struct.pack("<I", 500)})
        await field.until(field.sun_is_fresh)
        await field.order("lock", "LOCK", heliostats=("A1",))
        await final(field, "lock")
        items = {"biases": struct.pack("<ff", 0.003, 0.0)}
        await field.plant.send(Parameters.of("p", "A1", items, TOKEN))
        assert await final(field, "p") is Stage.DONE
        assert field.boards[0].node.controller.gate.edition == 501

    run(main, boards=boards, kept=kept)
    assert kept.next_edition() == 502


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda items: items | {"colour": b"red"}, "item 'colour' cannot be set"),
        (lambda items: items | {"edition": bytes(4)}, "item 'edition' cannot be set"),
        (lambda items: items | {"stow": b"\0"}, "item stow: 1 bytes, 8 needed"),
        (lambda items: {}, "no items"),
        (
            lambda items: {"biases": struct.pack("<ff", float("nan"), 0.0)},
            "item biases: a number that is not finite",
        ),
    ],
)
def test_parameters_that_cannot_be_are_refused(
    change: Callable[[dict[str, bytes]], dict[str, bytes]], text: str
) -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        await field.plant.send(Parameters.of("p", "A1", change({}), TOKEN))
        await asyncio.sleep(1.5)
        assert text in field.plant.text("p")

    run(main)


def test_parameters_are_refused_where_state_or_key_forbid_them() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        items = {"limits_primary": new_items()["limits_primary"]}
        await field.plant.send(Parameters.of("p", "A1", items, TOKEN))
        await field.plant.send(Parameters.of("q", "A2", items, TOKEN))
        assert await final(field, "p") is Stage.REFUSED
        assert field.plant.text("p") == "SET_LIMITS: not in this state (STOWED)"
        assert "A2: no key is configured" in field.plant.text("q")
        await field.order("zero", "ZERO", 0.0, 0.0, heliostats=("A2",))
        await asyncio.sleep(1.0)
        assert "A2: no key is configured" in field.plant.text("zero")

    config = config_of(2)
    first, second = config.heliostats
    keyless = type(second)(second.name, second.address, second.serial)
    run(main, heliostats=(first, keyless))


# -- questions -------------------------------------------------------------------------


def test_statistics_tell_of_each_node() -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(5.0)
        await field.plant.send(Ask("s", "statistics"))
        await field.plant.send(Ask("w", "weather"))
        await field.plant.send(Ask("n", "stored", "A9"))
        await field.until(lambda: len(field.plant.all(Answer)) == 3, 3.0)
        answers = {answer.identity: answer.data for answer in field.plant.all(Answer)}
        counts = answers["s"]["A1"]
        assert counts["asked"] == counts["answered"] > 8
        assert 0.005 < counts["round_trip"] < 0.02
        assert "query 'weather' is not known" in answers["w"]["error"]
        assert "has no heliostat 'A9'" in answers["n"]["error"]

    run(main)


def test_all_on_the_bus_are_found_although_answers_collide() -> None:
    boards = [Board(n) for n in range(1, 8)]
    boards[3] = Board(4, address=6)  # two on one address
    boards[6] = Board(7, configured=False)

    async def main(field: Field) -> None:
        await field.plant.send(Ask("d", "discover"))
        await field.until(lambda: bool(field.plant.all(Answer)), 200.0)
        (answer,) = field.plant.all(Answer)
        data = answer.data
        expected = {board.serial: board.node.controller.config.address for board in boards}
        assert {each["serial"]: each["address"] for each in data["found"]} == expected
        assert data["garbled"] == []
        assert data["missing"] == []
        wrong = [each["name"] for each in data["found"] if each["address"] != each["expected"]]
        assert wrong == ["A4", "A7"]
        # The sun is sent all the while.
        assert field.sun_is_fresh()
        # Each gets its address by its serial number.
        await field.order("a", "SET_ADDRESS", heliostats=("A4", "A7"), lifetime=20.0)
        assert await final(field, "a", "A4", 20.0) is Stage.DONE
        assert await final(field, "a", "A7", 20.0) is Stage.DONE
        assert [board.node.controller.config.address for board in boards] == list(range(1, 8))
        await field.until(lambda: field.plant.status().nodes()["heard_ms"].max() < 500, 10.0)

    run(main, boards=boards, bus=lambda clock, boards: SlotBus(clock, [*boards]))


def test_an_emergency_does_not_wait_for_a_search_of_the_bus() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        await field.plant.send(Ask("d", "discover"))
        await asyncio.sleep(1.5)
        await asyncio.sleep(0.1)
        begin = field.clock.monotonic()
        await field.emergency("stop", "DEFOCUS")
        await field.until(lambda: field.states() == ["DEFOCUSED", "DEFOCUSED"], 0.3)
        await field.until(lambda: Stage.ACKNOWLEDGED in field.plant.stages("stop", "A2"), 1.0)
        assert field.clock.monotonic() - begin < 0.5

    run(main, "IDLE", bus=lambda clock, boards: SlotBus(clock, [*boards]))


def test_an_emergency_does_not_wait_for_flash() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        field.bus.lose("SET_BIAS", 9)
        items = {"biases": struct.pack("<ff", 0.003, 0.0)}
        await field.plant.send(Parameters.of("p", "A1", items, TOKEN))
        await field.until(lambda: field.bus.lost != [])
        begin = field.clock.monotonic()
        await asyncio.sleep(0.05)
        await field.emergency("stop", "DEFOCUS")
        await field.until(lambda: field.states() == ["DEFOCUSED", "DEFOCUSED"], 0.2)
        assert field.clock.monotonic() - begin < 0.3
        await asyncio.sleep(1.0)
        assert "DEFOCUS came before it" in field.plant.text("p")

    run(main, "IDLE", bus=interrupted)


def test_an_edition_that_cannot_be_kept_fails_the_order_and_nothing_else(tmp_path: Path) -> None:
    kept = Kept(tmp_path / "state.json")

    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        (tmp_path / "state.json").unlink()
        tmp_path.rmdir()
        # Another cluster has used far more editions than this one has reserved.
        field.boards[0].node.controller.gate.edition = 500
        field.boards[0].node.journal.store({"edition": struct.pack("<I", 500)})
        items = {"biases": struct.pack("<ff", 0.003, 0.0)}
        message = Parameters.of("p", "A1", items, TOKEN)
        await field.plant.send(dataclasses.replace(message, lifetime=3.0))
        assert await final(field, "p") is Stage.FAILED
        assert "the edition cannot be stored: No such file or directory" in field.plant.text("p")
        await field.order("lock", "LOCK", heliostats=("A1",))
        assert await final(field, "lock") is Stage.DONE
        tmp_path.mkdir()

    run(main, kept=kept)


def test_no_more_orders_are_taken_than_the_bus_can_carry() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        for board in field.boards:
            board.on = False
        command = Command("c", "ROUGH", (1,), token=TOKEN, lifetime=20.0)
        for _ in range(1030):
            field.cluster._work.take(command)
        await asyncio.sleep(1.5)
        assert "2048 orders are waiting, the limit is 2048" in field.plant.text("c")

    run(main)


def test_a_sun_that_jumped_is_an_alarm_for_a_minute() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        assert not field.plant.alarms("sun_jumped")
        sun = field.boards[0].node.controller.sun
        for told in (1, 2):
            sun.leaps += 1
            await field.until(lambda n=told: len(field.plant.alarms("sun_jumped")) == 2 * n - 1)
            alarm = field.plant.alarms("sun_jumped")[-1]
            assert alarm.subject == "A1"
            assert alarm.active
            await asyncio.sleep(50.0)
            assert field.plant.alarms("sun_jumped")[-1] == alarm
            await asyncio.sleep(15.0)
            assert not field.plant.alarms("sun_jumped")[-1].active
            # The local controller shows it on, until it is restarted.
            sun.leaps += 1
            await asyncio.sleep(5.0)
            assert len(field.plant.alarms("sun_jumped")) == 2 * told
            sun.leaps = 0
            await asyncio.sleep(2.0)

    run(main)


def test_a_state_of_other_firmware_is_named_and_not_believed() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        field.boards[0].node.controller.state = 200
        await field.until(lambda: bool(field.plant.alarms("node_unintelligible")))
        (alarm,) = field.plant.alarms("node_unintelligible")
        assert "A1: state 200 is not known" in alarm.text
        assert field.cluster.nodes[0].state == 1
        field.boards[0].node.controller.state = 1
        await field.until(lambda: not field.plant.alarms("node_unintelligible")[-1].active)

    run(main)


def test_what_was_at_work_when_an_emergency_came_is_not_sent_again() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        field.bus.lose("TRACK", 2)
        await field.order("track", "TRACK", heliostats=("A1",))
        await field.until(lambda: field.bus.lost != [])
        await field.emergency("stop", "DEFOCUS")
        await asyncio.sleep(8.0)
        assert field.states() == ["DEFOCUSED", "DEFOCUSED"]
        assert field.plant.stages("track", "A1")[-1] is Stage.FAILED
        assert "DEFOCUS came before it" in field.plant.text("track")

    run(main, "IDLE", bus=interrupted)


def test_an_emergency_that_was_given_up_is_given_to_who_answers() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        field.bus.lose("DEFOCUS", 100_000)
        await field.emergency("stop", "DEFOCUS")
        await field.until(lambda: Stage.FAILED in field.plant.stages("stop", "A1"), 60.0)
        asked = len(field.bus.lost)
        await asyncio.sleep(10.0)
        assert len(field.bus.lost) > asked, "those that answer polls are asked on"
        field.bus.lose("DEFOCUS", 0)
        await asyncio.sleep(10.0)
        assert not field.plant.alarms("order_unacknowledged")[-1].active

    run(main, "TRACKING", bus=interrupted)


def test_many_emergencies_on_a_silent_bus_keep_nobody_from_the_sun() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        for board in field.boards[1:]:
            board.on = False
        await asyncio.sleep(4.0)
        dead = [f"A{n}" for n in range(2, 9)]
        for number in range(30):
            await field.emergency(f"stop {number}", "DEFOCUS" if number % 2 else "STOW", *dead)
        for _ in range(200):
            await asyncio.sleep(0.05)
            ages.append(field.boards[0].node.controller.sun.age_ms())
        assert all(field.plant.stages(f"stop {n}", "A8") != [] for n in range(30))

    ages: list[int] = []
    run(main, count=8)
    assert max(ages) < 4000


@pytest.mark.parametrize("whom", [("A2",), ("A1",), ("A3", "A1")])
def test_an_emergency_is_not_kept_waiting_by_older_ones_of_silent_heliostats(
    whom: tuple[str, ...],
) -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        for board in field.boards[1:]:
            board.on = False
        await asyncio.sleep(4.0)
        for number in range(25):
            await field.emergency(f"old {number}", "DEFOCUS", *(f"A{n}" for n in (2, 3, 4)))
        await asyncio.sleep(5.5)
        for number in range(4):
            # The instant within a second differs: asking goes on for a part of it.
            await asyncio.sleep(1.15)
            begin = field.clock.monotonic()
            await field.emergency(f"new {number}", "STOW", *whom)
            identity = f"new {number}"
            await field.until(lambda i=identity: Stage.SENT in field.plant.stages(i, whom[0]), 3.0)
            waits.append(field.clock.monotonic() - begin)

    waits: list[float] = []
    run(main, count=4)
    # One question may be on its way, its answer is waited for; the plant is told in the next.
    assert max(waits) < 0.4


def test_an_emergency_of_one_heliostat_is_told_in_all_its_stages() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        await field.emergency("stop", "DEFOCUS", "A1")
        assert await final(field, "stop") is Stage.DONE
        assert field.plant.stages("stop", "A1") == ALL_STAGES

    run(main, "IDLE")


@pytest.mark.parametrize("name", ["DEFOCUS", "STOW"])
def test_nothing_is_done_where_the_step_counts_are_unknown(name: str) -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        field.boards[0].node.controller.motion.known = False
        await field.emergency("stop", name)
        assert await final(field, "stop", limit=310.0) is Stage.FAILED
        assert field.plant.stages("stop", "A1")[-2] is Stage.ACKNOWLEDGED
        text = f"{name}: its step counts are unknown, so nothing shows where its beam is"
        assert text in field.plant.text("stop")

    run(main, "IDLE")


@pytest.mark.parametrize("name", ["DEFOCUS", "STOW"])
def test_nothing_is_done_where_the_drives_are_switched_off(name: str) -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        board = field.boards[0]
        board.node.on_fault(SWITCH, board._tick(field.clock.monotonic()), True)
        await field.emergency("stop", name)
        assert await final(field, "stop", limit=310.0) is Stage.FAILED
        text = f"{name}: its drives are switched off at the mirror, away from stow"
        assert text in field.plant.text("stop")

    run(main, "IDLE")


def test_a_defocus_is_done_when_the_beam_has_left_and_not_when_it_is_acknowledged() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        board = field.boards[0]
        motion = board.node.controller.motion
        await field.emergency("stop", "DEFOCUS", "A1")
        await field.until(lambda: Stage.ACKNOWLEDGED in field.plant.stages("stop", "A1"), 2.0)
        assert not motion.still()
        assert Stage.DONE not in field.plant.stages("stop", "A1")
        assert await final(field, "stop", limit=40.0) is Stage.DONE
        assert all(abs(motion.goal(i) - motion.place(i)) <= 20 for i in (0, 1))

    run(main, "IDLE")


def test_a_defocus_that_leaves_the_axes_where_they_are_is_never_done() -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        node = next(iter(field.cluster.nodes))
        field.boards[0].on = False
        reports = Reports()
        goals = Goals(reports)
        now = field.clock.monotonic()
        goals.begin("stop", "DEFOCUS", node, now)
        # DEFOCUSED as it says, its goals far from where it stands.
        node.status = (states.DEFOCUSED, *node.status[1:])
        for k in range(1, 31):
            node.steps, node.steps_at = (0, 0, 50_000, 0), now + k
            goals.heard(node, now + k)
            goals.second(field.cluster.nodes, now + k)
        assert goals.waits(node)
        goals.second(field.cluster.nodes, now + 31.0)
        stages = [m.stage for m in reports.take() if isinstance(m, Progress)]
        assert stages == [Stage.FAILED]

    run(main, "IDLE")


def test_a_stow_is_reported_as_done_although_the_next_order_asks_for_it_again() -> None:
    """A mirror on its way to stow goes on, whether STOW comes once more or DEFOCUS comes."""

    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        orders = ("all", "STOW"), ("again", "STOW", "A1"), ("off", "DEFOCUS", "A1")
        for identity, *order in orders:
            await field.emergency(identity, *order)
            whole = [*ALL_STAGES[:3]]
            await field.until(lambda i=identity, w=whole: field.plant.stages(i, "A1")[:3] == w)
            assert "STOWING" in field.states()
        for identity in ("all", "again"):
            assert await final(field, identity, limit=200.0) is Stage.DONE
            assert field.plant.stages(identity, "A1") == ALL_STAGES
        assert field.states()[0] == "STOWED"

    run(main, "IDLE")


def test_heliostats_that_do_not_obey_leave_the_bus_to_the_others() -> None:
    """Twelve that are silent are asked again each second, for a third of it at most."""

    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        emergencies = field.cluster._work._emergencies
        serve, spent = emergencies.serve, list[float]()

        async def timed() -> None:
            begin = field.clock.monotonic()
            await serve()
            spent.append(field.clock.monotonic() - begin)

        emergencies.serve = timed  # type: ignore[method-assign]
        for board in field.boards[1:]:
            board.on = False
        await field.emergency("off", "STOW")
        await asyncio.sleep(15.0)
        # The first rounds are as long as the order's budget; then one more answer fits in.
        assert 0.25 < max(spent[4:]) < 0.3 + 2 * field.config.answer
        assert field.plant.status().cycle_s < 1.0

    run(main, count=13)


class Standing(TwinBus):
    """A bus whose cluster's program stands still for 4 s before it reads an answer of a name."""

    before = ""

    async def transact(self, *arguments: Any, **settings: Any) -> bytes:
        answer = await super().transact(*arguments, **settings)
        if answer and wire.Reader().feed(answer)[0].name == self.before:
            self.before = ""
            await asyncio.sleep(4.0)
        return answer


@pytest.mark.parametrize("name", ["STATUS", "STEPS"])
def test_an_answer_that_was_read_late_is_as_old_as_its_question(name: str) -> None:
    """Simulated run 950188: frozen for 45 s after a question, the cluster told a state as new."""

    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        (node,), what, ages = field.cluster.nodes, name.lower(), list[float]()
        take = getattr(node, f"take_{what}")

        def taken(*values: Any) -> None:
            take(*values)
            ages.append(field.clock.monotonic() - getattr(node, f"{what}_at"))

        setattr(node, f"take_{what}", taken)
        field.bus.before = name
        await field.until(lambda: not field.bus.before)
        await asyncio.sleep(6.0)
        assert 4.0 < max(ages) < 4.2
        assert ages[-1] < 0.2

    run(main, count=1, bus=lambda clock, boards: Standing(clock, [*boards]))


def test_a_status_that_waited_in_a_frozen_program_is_not_sent() -> None:
    """Simulated run 960174: a status left 43 s after it was made, with the ages of then."""

    async def main(field: Field) -> None:
        send, ages, waits = field.link.send, list[float](), [5.0]
        reports = field.cluster._reports
        tell = reports.status

        async def slow(
            data: bytes, *, expires: float | None = None, hold: bool = False
        ) -> SendOutcome:
            message = decode(data)
            if isinstance(message, Alarm) and waits:
                await asyncio.sleep(waits.pop())
            outcome = await send(data, expires=expires, hold=hold)
            if isinstance(message, ClusterStatus) and outcome is SendOutcome.SENT:
                ages.append(field.clock.utc().timestamp() - message.utc_s)
            return outcome

        def after_an_alarm(status: ClusterStatus) -> None:
            reports.alarm(alarms.LEASE_REFUSED.raised("A1", problem="a test"))
            tell(status)

        field.link.send = slow  # type: ignore[method-assign]
        reports.status = after_an_alarm  # type: ignore[method-assign]
        await asyncio.sleep(10.0)
        assert not waits
        assert len(ages) >= 3
        assert max(ages) < 2.0

    run(main)


def test_alarms_are_repeated_and_listed_since_each_may_be_lost() -> None:
    """Simulated run 960094: a plant that stood still never learnt why its cluster sent no sun."""

    async def main(field: Field) -> None:
        send = field.link.send
        alarm = alarms.LEASE_REFUSED.raised("A1", problem="a test")

        async def losing(
            data: bytes, *, expires: float | None = None, hold: bool = False
        ) -> SendOutcome:
            if isinstance(decode(data), Alarm):
                return SendOutcome.SENT
            return await send(data, expires=expires, hold=hold)

        field.link.send = losing  # type: ignore[method-assign]
        await field.until(lambda: bool(field.plant.all(ClusterStatus)))
        field.cluster.take_alarm(alarm)
        await asyncio.sleep(2.0)
        field.link.send = send  # type: ignore[method-assign]
        await field.until(lambda: alarm in field.plant.all(Alarm))
        await field.until(lambda: f"{alarm.condition} A1" in field.plant.status().alarms)
        field.cluster.take_alarm(dataclasses.replace(alarm, active=False))
        heard = len(field.plant.all(ClusterStatus))
        await asyncio.sleep(12.0)
        listing = [s for s in field.plant.all(ClusterStatus)[heard:] if s.alarms_listed]
        assert listing
        assert not any(status.alarms for status in listing)

    run(main)


def test_a_status_with_names_lists_the_commands_that_have_not_ended() -> None:
    reports = Reports()
    status = ClusterStatus("C", 0, 0.0, "gps", 0.0, 3.0, 0.1)

    def listed(*names: str) -> ClusterStatus:
        reports.status(dataclasses.replace(status, names=names))
        last = reports.take()[-1]
        assert isinstance(last, ClusterStatus)
        return last

    for identity, stage, name in (
        ("one", Stage.ACCEPTED, "A"),
        ("two", Stage.ACKNOWLEDGED, "A"),
        ("two", Stage.ACKNOWLEDGED, "B"),
        ("two", Stage.SENT, "B"),
        ("two", Stage.DONE, "A"),
        ("", Stage.ACKNOWLEDGED, "A"),
    ):
        reports.add(identity, stage, name)
    assert not listed().commands_listed
    assert (listed("A", "B").commands, listed("A", "B").commands_listed) == (("two",), True)
    reports.add("two", Stage.FAILED, "B", "a test")
    assert (listed("A", "B").commands, listed("A", "B").commands_listed) == ((), True)


def test_a_status_is_not_delivered_later_than_the_next_one_is_due() -> None:
    async def main(field: Field) -> None:
        send, left = field.link.send, list[float]()

        async def spy(
            data: bytes, *, expires: float | None = None, hold: bool = False
        ) -> SendOutcome:
            if isinstance(decode(data), ClusterStatus):
                assert expires is not None
                left.append(expires - field.clock.monotonic())
            return await send(data, expires=expires, hold=hold)

        field.link.send = spy  # type: ignore[method-assign]
        await asyncio.sleep(3.5)
        assert len(left) >= 3
        assert max(left) <= 1.0

    run(main)


@pytest.mark.parametrize("name", ["AIM", "STANDBY"])
def test_a_point_that_is_tried_again_does_not_come_after_a_newer_one(name: str) -> None:
    async def main(field: Field) -> None:
        await field.until(field.sun_is_fresh)
        field.bus.lose(name, 3)
        await field.order("old", name, 0.0, 0.0, 52.0, heliostats=("A1", "A2"))
        await field.order("new", name, 0.0, 0.0, 51.0, heliostats=("A1",))
        assert await final(field, "new") is Stage.DONE
        assert await final(field, "old", "A2") is Stage.DONE
        assert await final(field, "old") is Stage.FAILED
        await asyncio.sleep(3.0)
        first, second = (board.node.controller for board in field.boards[:2])
        points = [first.motion.aim, second.motion.aim]
        if name == "STANDBY":
            points = [first.config.standby, second.config.standby]
        assert points == [(0.0, 0.0, 51.0), (0.0, 0.0, 52.0)]

    run(main, "IDLE", bus=interrupted)
