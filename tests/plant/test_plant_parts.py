"""Parts of the plant by themselves: audit, items, tickets, joining, aims, table of the field."""

import functools
import itertools
import json
import struct
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from zlib import crc32

import numpy as np
import pytest

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.errors import FormatError, InputError, UnknownNameError
from heliotrope.field.example import example_plant
from heliotrope.field.target import Receiver
from heliotrope.lcu import drives, messages, states
from heliotrope.lcu.config import Config
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.messages import NODE, ClusterStatus, ProtocolError, Stage
from heliotrope.mechanism.board_items import (
    Wanted,
    checksums,
    differing,
    drive_numbers,
    items_of,
    packed,
)
from heliotrope.mechanism.machine import AxisLimits, Machine
from heliotrope.plant.attempts import Attempts
from heliotrope.plant.field.aims import BeamCheck, spread
from heliotrope.plant.field.ledger import LOCKING, STOWING, TO_REST, Ledger
from heliotrope.plant.field.state import FieldState
from heliotrope.plant.io.links_file import PlantLinks
from heliotrope.plant.motion.proofs import BeamError
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.plant.operations.operations import Operations
from heliotrope.plant.operations.views import CalibrationEntry
from heliotrope.plant.orders.audit import STOPPED, AuditError, JsonLines, Record, read
from heliotrope.plant.orders.authority import (
    Authority,
    Mandate,
    Person,
    RefusedError,
    Role,
    TakenOutError,
)
from heliotrope.plant.orders.joining import JoiningJob, JoinQueue
from heliotrope.plant.orders.movements import Movements
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.plant.schedule.choice import Assignment
from heliotrope.plant.schedule.plant_schedule import STEPS, PlantSchedule
from heliotrope.plant.schedule.scheduler import VISITS
from heliotrope.plant.settings import clusters_of
from support.lcu_machines import STANDBY, STOW, heliostat, items_of_heliostat
from support.machines import every_kind, imperfect, jacks

AT = datetime(2026, 6, 21, 10, tzinfo=UTC)


def record(identity: str) -> Record:
    return Record(identity, "Olga", "operator", "TRACK", AT.isoformat(), (1.0,), ("Ü 1",), "note")


# -- audit -----------------------------------------------------------------------------


def test_records_come_back_and_open_ones_are_ended_at_the_next_start(tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    audit = JsonLines(path, AT)
    audit.begin(record("1"))
    audit.finish("1", "done", "later")
    audit.begin(record("2"))
    audit.confirm()
    with pytest.raises(InputError, match="record 1 already exists"):
        audit.begin(record("1"))
    with pytest.raises(InputError, match="no record 1 is waiting"):
        audit.finish("1", "done", "later")
    audit.close()
    again = JsonLines(path, AT)
    with pytest.raises(InputError, match="record 2 already exists"):
        again.begin(record("2"))
    again.close()
    found, torn = read(path)
    assert torn == 0
    assert [(r.identity, r.result) for r in found] == [("1", "done"), ("2", STOPPED)]
    assert found[0].heliostats == ("Ü 1",)
    assert (found[0].values, found[0].note, found[0].finished) == ((1.0,), "note", "later")


def test_a_file_cut_at_any_byte_loses_at_most_its_last_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What is asked here is what stands in the file, not whether the disk has it.
    monkeypatch.setattr("os.fsync", lambda _: None)
    path = tmp_path / "a.jsonl"
    audit = JsonLines(path, AT)
    for i in range(3):
        audit.begin(record(str(i)))
        audit.finish(str(i), "done", "later")
    audit.close()
    whole = path.read_bytes()
    for cut in range(len(whole)):
        path.write_bytes(whole[:cut])
        begun = sum(
            '"accepted"' in line
            for line in whole[:cut].decode(errors="ignore").split("\n")
            if line.endswith("}")
        )
        audit = JsonLines(path, AT)
        audit.begin(record("new"))
        audit.finish("new", "done", "later")
        audit.close()
        found, torn = read(path)
        assert len(found) == begun + 1
        assert all(r.result in ("done", STOPPED) for r in found)
        assert torn <= 1
        assert path.read_bytes().startswith(whole[:cut])


def test_only_one_plant_writes(tmp_path: Path) -> None:
    audit = JsonLines(tmp_path / "a.jsonl", AT)
    with pytest.raises(AuditError, match="another process is writing to it"):
        JsonLines(tmp_path / "a.jsonl", AT)
    audit.close()
    with pytest.raises(AuditError, match=r"Is a directory; specify a writable file"):
        JsonLines(tmp_path, AT)


def test_a_disk_that_fails_is_an_error_and_the_line_is_not_glued_to_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    audit = JsonLines(tmp_path / "a.jsonl", AT)

    def fail(_: int) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", fail)
        with pytest.raises(AuditError, match="Input/output error; check the disk"):
            audit.begin(record("1"))
        with pytest.raises(AuditError, match="Input/output error"):
            audit.confirm()
    # The write had come through although the syncing failed; the second one says the same.
    audit.begin(record("1"))
    audit.finish("1", "done", "later")
    audit.close()
    assert [(r.identity, r.result) for r in read(audit.path)[0]] == [("1", "done")]


def test_a_full_disk_is_no_confirmation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("heliotrope.plant.orders.audit.LEAST_FREE", 1 << 62)
    audit = JsonLines(tmp_path / "a.jsonl", AT)
    with pytest.raises(AuditError, match="bytes are left on its disk"):
        audit.confirm()
    audit.close()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"who": "Egon"}, "'accepted' of record 1 contradicts"),
        ({"event": "result", "result": "failed", "finished": "x"}, "of record 1 contradicts"),
        ({"event": "result", "identity": "9", "result": "x", "finished": "x"}, "of record 9"),
        ({"identity": "5", "colour": "blue"}, "line 3: no record: .*colour"),
    ],
)
def test_records_that_contradict_each_other_are_refused(
    tmp_path: Path, change: dict[str, str], said: str
) -> None:
    path = tmp_path / "a.jsonl"
    audit = JsonLines(path, AT)
    audit.begin(record("1"))
    audit.finish("1", "done", "later")
    audit.close()
    fields = {**json.loads(path.read_text(encoding="utf-8").splitlines()[0]), **change}
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(fields) + "\n")
    with pytest.raises(FormatError, match=said):
        JsonLines(path, AT)


# -- items of the journal --------------------------------------------------------------


def test_items_are_those_that_local_controllers_are_tested_with() -> None:
    limits = (8000, 16_000, 40)
    axes = (AxisLimits(-100_000, 1_950_000, *limits), AxisLimits(-20_000, 500_000, *limits))
    made = items_of(heliostat(), Machine(axes, STOW, (0.1, 0.05), STANDBY))
    known = items_of_heliostat(heliostat())
    assert {name: made[name] for name in known if name != "address"} == {
        name: data for name, data in known.items() if name != "address"
    }
    assert Config().load(made)


@pytest.mark.parametrize("name", ["azimuth_elevation", "two_jacks", "tilt_roll"])
def test_a_controller_computes_the_angles_of_the_mechanism(name: str) -> None:
    machine = imperfect(every_kind()[name], seed=4)
    machine.drives.table[..., 13] = 0.3  # phase of the sag
    counts = np.array([[1000.0, 2000.0], [30_000.0, 45_000.0], [60_000.0, 20_000.0]])
    wanted = machine.drives.angles(counts)
    for i in (0, 1):
        own = drives.Drive(*drive_numbers(machine.drives[i]))
        found = [own.angle(float(c)) for c in counts[:, i]]
        np.testing.assert_allclose(found, wanted[:, i], atol=1e-12)


def test_what_no_controller_takes_is_refused() -> None:
    kinds = every_kind()
    with pytest.raises(InputError, match="with 1 drives; pass one heliostat with two"):
        items_of(kinds["single_axis"])
    with pytest.raises(InputError, match=r"drives have the shape \(2,\)"):
        drive_numbers(kinds["two_jacks"].drives)
    assert drive_numbers(jacks()[0])[0] == drives.JACK_FALLING
    with pytest.raises(UnknownNameError, match="item of the journal 'arm'"):
        packed("arm", (1.0,))
    with pytest.raises(InputError, match=r"biases: .* cannot be stored"):
        packed("biases", (1.0,))
    with pytest.raises(InputError, match="a local controller refuses"):
        packed("biases", (8.0, 0.0))


def test_what_differs_is_found() -> None:
    items = {"biases": struct.pack("<ff", 0.1, 0.2), "stow": struct.pack("<ii", 1, 2)}
    assert checksums(items)["biases"] == crc32(items["biases"])
    assert differing(items, {}) == ("biases", "stow")
    assert differing(items, {**checksums(items), "edition": 7}) == ()
    wanted = Wanted()
    wanted.set("A", items)
    assert wanted.compare("A", {"stow": crc32(items["stow"])}) == ("biases",)
    assert wanted.missing == {"A": ("biases",)}
    assert wanted.compare("A", checksums(items)) == ()
    assert wanted.missing == {}
    assert wanted.compare("B", {}) == ()
    with pytest.raises(InputError, match="A: no items"):
        wanted.set("A", {})
    with pytest.raises(InputError, match="A: item 'stow' of 3 bytes"):
        wanted.set("A", {"stow": b"123"})


# -- authority, tickets, joining -------------------------------------------------------


def test_a_token_is_never_zero_nor_the_last_one() -> None:
    clock = VirtualClock()
    drawn = iter([b"\0\0\0\0", b"\1\0\0\0", b"\1\0\0\0", b"\0\0\0\0", b"\2\0\0\0"])
    authority = Authority(clock, 10.0, lambda _: next(drawn))
    olga, egon = Person("Olga", Role.OPERATOR), Person("Egon", Role.ENGINEER)
    assert authority.take(olga).token == 1
    clock.advance(9.0)
    assert authority.take(olga).token == 1
    clock.advance(9.9)
    assert authority.token == 1
    clock.advance(0.1)
    assert (authority.token, authority.grant) == (0, None)
    assert authority.silent_for == pytest.approx(10.0)
    assert authority.take(egon).token == 2
    authority.release(egon, 2)
    assert authority.token == 0
    with pytest.raises(RefusedError, match="nobody has it"):
        authority.keep(egon, 2)
    with pytest.raises(InputError, match=r"lifetime must be above 0 .* not 0\.0 s"):
        Authority(clock, 0.0)
    with pytest.raises(InputError, match="the name is empty"):
        Person(" ", Role.VIEWER)


def test_stages_never_go_back_and_nothing_follows_the_end() -> None:
    clock = VirtualClock()
    ticket = Ticket("1", "TRACK", ("A", "B", "C"), clock, patience=60.0)
    ticket.expect(("A", "B", "C"), clock.monotonic() + 10.0)
    ticket.advance(("A", "B", "stranger"), Stage.ACKNOWLEDGED)
    ticket.advance(("A",), Stage.SENT)
    ticket.advance(("B",), Stage.REFUSED, "no")
    ticket.advance(("B",), Stage.DONE)
    assert [ticket.stage(n) for n in "ABC"] == [Stage.ACKNOWLEDGED, Stage.REFUSED, None]
    clock.advance(10.0)
    ticket.expire(clock.monotonic())
    assert ticket.refusals == {"B": "no", "C": "no reply before the command expired"}
    # What is told again gives it no more time.
    ticket.advance(("A",), Stage.ACKNOWLEDGED)
    clock.advance(49.0)
    ticket.expire(clock.monotonic())
    assert not ticket.finished
    clock.advance(1.0)
    ticket.expire(clock.monotonic())
    assert ticket.refusals["A"] == "acknowledged, but not completed within 60 s"
    assert ticket.text.startswith("TRACK: 1 refused, 2 failed (")
    assert "1 refused" in repr(ticket)


def test_one_reason_of_many_heliostats_stands_once() -> None:
    names = [f"P{k:04d}" for k in range(64)]
    ticket = Ticket("1", "TRACK", names, VirtualClock(), 60.0)
    ticket.advance(names[:57], Stage.REFUSED, "it has sent nothing")
    ticket.advance(names[57:59], Stage.REFUSED, "it is out of service")
    for name, text in zip(names[59:62], ("a", "b", "c"), strict=True):
        ticket.advance((name,), Stage.FAILED, text)
    ticket.advance(names[62:], Stage.DONE)
    assert ticket.text == (
        "TRACK: 2 done, 59 refused, 3 failed (57 heliostats: it has sent nothing; P0057, P0058: "
        "it is out of service; P0059: a; 2 more refused for other reasons)"
    )


def test_a_refusal_without_a_reason_is_told_all_the_same() -> None:
    ticket = Ticket("1", "TRACK", ("A", "B", "C"), VirtualClock(), 60.0)
    ticket.advance(("A",), Stage.REFUSED)
    ticket.advance(("B",), Stage.FAILED)
    ticket.advance(("C",), Stage.DONE)
    assert ticket.refusals == {"A": "refused", "B": "failed"}


def test_a_record_is_waited_for_no_longer_than_it_takes() -> None:
    async def main(clock: VirtualClock) -> None:
        good, failed, late = (Ticket(each, "TRACK", ("A",), clock, 60.0) for each in "123")
        good.record()
        failed.advance(("A",), Stage.FAILED)
        begin = clock.monotonic()
        assert await good.written(10.0)
        assert not await failed.written(10.0)
        assert clock.monotonic() == begin
        assert not await late.written(10.0)
        assert clock.monotonic() == pytest.approx(begin + 10.0)

    run_virtual(main)


def test_who_waits_too_long_to_join_is_given_up() -> None:
    clock = VirtualClock()
    queue = JoinQueue(1.0, 1, 60.0)

    def lost(token: int, heliostats: Iterable[str]) -> frozenset[str]:
        return frozenset() if token == 7 else frozenset(heliostats)

    ticket = Ticket("1", "TRACK", ("A", "B", "C"), clock, 60.0)
    queue.put(JoiningJob(ticket, "TRACK", (), 7, deque(("A", "B", "C")), until=2.0))
    assert queue.admit(0.0, lost) == []
    ((job, part),) = queue.admit(1.0, lost)
    assert (job.ticket, part) == (ticket, ("A",))
    assert queue.admit(2.0, lost) == []
    assert "waited too long" in ticket.refusals["B"]
    assert len(queue) == 0


# -- aims and the table ----------------------------------------------------------------


def test_aim_points_are_given_out_evenly_and_neighbours_differ() -> None:
    rng = np.random.default_rng(1)
    bearing, tower = rng.uniform(-1.0, 1.0, 1000), np.array([2000.0, -1000.0, 0.0])
    places = 500.0 * np.stack([np.sin(bearing), np.cos(bearing), 0.0 * bearing], axis=-1) + tower
    points = np.array([[-2.0, 0.0, 100.0], [0.0, 0.0, 100.0], [2.0, 0.0, 100.0]]) + tower
    given = spread(places, points)
    which = np.argmin(np.linalg.norm(given[:, None] - points, axis=-1), axis=-1)
    assert sorted(np.bincount(which)) == [333, 333, 334]
    # Every thirtieth part of the field, as a cloud covers it, keeps the mixture.
    for part in np.array_split(which[np.argsort(bearing)], 30):
        assert np.ptp(np.bincount(part, minlength=3)) <= 1
    with pytest.raises(InputError, match="aim points: got 0; specify"):
        spread(places, np.empty((0, 3)))
    with pytest.raises(InputError, match="aim points"):
        spread(places, (np.nan, 0.0, 0.0))


@pytest.mark.parametrize(("mrad", "good"), [(2.9, True), (3.1, False)])
def test_a_beam_moves_by_3_mrad_about_its_aim_at_most(mrad: float, good: bool) -> None:
    design, aim = example_plant(), np.array([0.0, -12.0, 8.0])
    face = Receiver("furnace", "planar", aim, np.array([0.0, -1.0, 0.0]), 1.0, 1.0)
    armature, rows = BeamCheck(design, design.names).armature, np.array([3])
    slant = np.linalg.norm(aim - armature.origin_1[rows[0]])
    beside = aim + np.array([1e-3 * mrad * slant, 0.0, 0.0])
    movements, tracks = Movements((face,), armature), np.array([True])
    text = r"^AIM A: 3\.1 mrad from its aim; a movement is limited to 3 mrad$"
    with nullcontext() if good else pytest.raises(BeamError, match=text):
        movements.check(("A",), rows, aim[None], beside[None], tracks)


def test_a_moved_beam_goes_back_when_its_time_or_its_authority_is_over() -> None:
    design, aim = example_plant(), np.array([0.0, -12.0, 8.0])
    movements = Movements((), BeamCheck(design, design.names).armature)
    movements.take(("A",), aim[None], 1, 100.0)

    def kept(*_: object) -> frozenset[str]:
        return frozenset()

    assert not movements.due(189.0, 1, kept)
    assert movements.due(190.0, 1, kept).keys() == {"A"}
    np.testing.assert_array_equal(
        movements.due(101.0, 2, lambda _, names: frozenset(names))["A"], aim
    )
    assert not movements.due(190.0, 0, kept), "without a command authority no cluster would obey"


def test_a_field_that_does_not_hold_together_is_refused() -> None:
    with pytest.raises(InputError, match="heliostat A is in two clusters"):
        FieldState({"K": ("A",), "L": ("A",)})
    with pytest.raises(InputError, match="no cluster has a heliostat"):
        FieldState({"K": ()})
    assert set(clusters_of(example_plant())) == {f"pod-{i}" for i in range(1, 7)}


def test_rows_are_put_by_their_names_and_strangers_left_out() -> None:
    field = FieldState({"K": ("A", "B"), "L": ("C",)})
    rows = np.zeros(3, NODE)
    rows["state"] = (states.IDLE, states.TRACKING, states.FAULT)

    def status(count: int, names: tuple[str, ...] = ()) -> ClusterStatus:
        return ClusterStatus(
            "K", count, 0.0, "gps", 0.0, 3.0, 0.1, names=names, block=rows[:count].tobytes()
        )

    assert "status arrived before its list of names" in field.take("K", status(3), 10.0)[0]
    problems = field.take("K", status(3, ("B", "A", "C")), 10.0)
    assert problems == [
        (
            "cluster K: it reports heliostat C, which belongs to another cluster; "
            "correct its configuration"
        )
    ]
    assert field.of("A", 10.0).state == "TRACKING"
    assert field.of("B", 10.0).state == "IDLE"
    gone = field.of("C", 10.0)
    assert (gone.live, gone.state, gone.fault, gone.flags) == (False, "", "", ())
    assert (gone.counts, gone.goals) == ((0, 0), (0, 0))
    # A row of exactly the limit is live, one by one as in the whole field.
    last = 10.0 + field.limit
    for now in (last, np.nextafter(last, np.inf)):
        assert field.live(now)[0] == field.of("A", now).live == (now == last)
    assert field.take("K", status(2), 11.0) == ["cluster K: its status has 2 records for 3 names"]
    with pytest.raises(ProtocolError, match="are not rows of"):
        field.take("K", ClusterStatus("K", 1, 0.0, "gps", 0.0, 3.0, 0.1, block=b"x"), 11.0)
    # Who falls into FAULT or silent counts as failed for ten minutes.
    assert field.failed_share(11.0) == 0.0
    rows["state"][0] = states.FAULT
    rows["heard_ms"][1] = 4000
    field.take("K", status(3, ("B", "A", "C")), 12.0)
    assert field.failed_share(12.0) == pytest.approx(2.0 / 3.0)
    assert field.failed_share(611.0) == pytest.approx(2.0 / 3.0)
    assert field.failed_share(613.0) == 0.0
    rows["heard_ms"][1] = 0
    for unknown in (len(states.STATES), 77):
        rows["state"][0] = unknown
        field.take("K", status(3, ("B", "A", "C")), 13.0)
        assert field.of("B", 13.0).state == "FAULT"


class _Kept:
    """Records of which sightings may be lost."""

    problem = ""

    def record(self, fact: object) -> None:
        del fact


@pytest.mark.parametrize(
    ("identities", "lost"), [([4, 0], "the disk is full"), ([4, 5], ""), (None, "")]
)
def test_a_visit_that_is_kept_says_so_only_if_its_sightings_are_kept_too(
    identities: list[int] | None, lost: str
) -> None:
    seen = None if identities is None else SimpleNamespace(identities=np.array(identities))
    beliefs = SimpleNamespace(known=lambda name: seen)
    keeping = Keeping(("A",), beliefs, _Kept())  # type: ignore[arg-type]
    keeping.lost = "the disk is full"
    nan = float("nan")
    outcome = CalibrationOutcome.CALIBRATED
    entry = CalibrationEntry(0.0, "A", "T", outcome, *[nan] * 6, 2, 2, "calibrated", 1)
    keeping.keep(entry, 0.0, 1e-3)
    assert keeping.lost == lost


class _Endless:
    """A scheduler that always finds another visit, and counts those that it was asked for."""

    def __init__(self, names: int) -> None:
        self.asked, self.plans, self._names = 0, 0, names
        self.running: dict[str, object] = {}
        self.attempts = Attempts(VISITS)

    def weigh(self, worth: object) -> None:
        """All are worth the same to it."""

    def upcoming(self, *_: object) -> Iterator[Assignment]:
        self.plans += 1
        for i in itertools.count():
            self.asked += 1
            at = 1e9 + i
            yield Assignment(
                f"H{i % self._names}", "T", at, at + 1.0, 2e-3, 1e-3, 1e-3, 1.0, False, ""
            )

    def learn(self, *_: object) -> None:
        pass

    def drift(self, *_: object) -> None:
        pass


def test_a_plan_is_made_when_it_is_as_long_as_it_is_shown() -> None:
    found = _Endless(50)
    plant = SimpleNamespace(
        now=lambda: 100.0,
        clock=VirtualClock(lambda: 0.0, AT),
        beliefs=SimpleNamespace(subscribe=lambda learn: None, subscribe_drift=lambda learn: None),
        worth=np.ones(50),
    )
    schedule = PlantSchedule(plant, found)  # type: ignore[arg-type]
    schedule._states = lambda ready: None  # type: ignore[assignment,method-assign]
    ready = np.ones(50, dtype=np.bool_)
    for _ in range(4):
        schedule.plan(ready, 2 * STEPS)
    # Two calls made it, and for `REPLAN` it is only shown.
    assert (found.asked, found.plans) == (2 * STEPS, 1)


def test_standby_points_given_by_a_person_are_an_event() -> None:
    told = []
    given = Ticket("t", "STANDBY", ["A", "B"], VirtualClock(lambda: 0.0, AT), 60.0)
    operations = SimpleNamespace(
        plant=SimpleNamespace(standby=lambda *_: given),
        logbook=SimpleNamespace(event=lambda *event, heliostats: told.append((*event, heliostats))),
    )
    for name in ("_told", "_tell"):
        setattr(operations, name, functools.partial(getattr(Operations, name), operations))
    olga = Person("Olga", Role.OPERATOR)
    assert Operations.standby(operations, olga, 1, {}) is given  # type: ignore[arg-type]
    assert told == [("command", "Olga", "STANDBY A, B", given.heliostats)]


def test_a_refused_link_is_told_with_its_count() -> None:
    papers: Any = None
    assert PlantLinks(papers).facts() == {}
    server: Any = SimpleNamespace(refused=0, last_refusal="")
    links = PlantLinks(papers, server=server)
    assert links.facts() == {}
    server.refused, server.last_refusal = 3, "no certificate"
    assert links.facts() == {"refused link": "no certificate (3 so far)"}


def test_a_heliostat_that_was_ordered_off_while_it_was_out_and_heard_is_not_lost() -> None:
    """Those that were silent, or off already, may have left by themselves."""
    field = FieldState({"K": tuple("ABCDEF")})
    field.rows["state"] = states.TRACKING
    field.heard[:] = 10.0
    ledger, seen = Ledger(field), np.full(6, 10.0)
    assert not ledger.off(seen, 10.0).any(), "nobody has ordered anything"
    ledger.sent("DEFOCUS", ("A", "B"), 10.5)
    ledger.sent("LOCK", ("C",), 10.5)
    ledger.acknowledged("DEFOCUS", 10.5, ("A",), 10.6)
    field.heard[0] = 12.0
    # B did not acknowledge before it fell silent: its cluster may have turned it away.
    assert ledger.off(seen, 13.5).tolist() == [True] + 5 * [False]
    field.heard[:] = 20.0
    ledger.acknowledged("DEFOCUS", 10.5, ("B",), 20.0)
    field.rows["state"][3] = states.DEFOCUSED
    ledger.sent("STOW", ("D",), 20.0)
    assert ledger.off(seen, 20.0).tolist() == [True] + 5 * [False], "D had left before"
    # Sent out again: what was seen out after that is lost if it leaves.
    ledger.sent("REFOCUS", ("A",), 21.0)
    assert not ledger.off(np.full(6, 22.0), 22.0).any()
    # C refuses IDLE, because it goes to stow by itself; then its visit turns it away.
    ledger.refused("IDLE", ("C",), 21.5)
    ledger.sent("DEFOCUS", ("C",), 21.6)
    # E refuses APPROACH because it tracks: it is where it seems.
    ledger.refused("APPROACH", ("E",), 21.5)
    ledger.sent("STOW", ("E", "F"), 22.0)
    ledger.follows_loss(("F",))
    assert ledger.off(np.full(6, 22.5), 22.5).tolist() == 4 * [False] + [True, False]


def test_the_ledger_says_which_report_and_which_order_came_later() -> None:
    field = FieldState({"K": ("A", "B", "C")})
    field.rows["state"] = states.TRACKING, states.IDLE, states.IDLE
    field.heard[:] = 10.0
    ledger = Ledger(field)
    assert ledger.reported().all(), "nothing has been ordered"
    # A report of the second after the order may be from before it; a late acknowledgement too.
    ledger.sent("DEFOCUS", ("A", "B"), 9.5)
    assert ledger.reported(messages.SAFE).tolist() == [False, False, True]
    field.heard[:] = 10.5
    ledger.acknowledged("DEFOCUS", 9.5, ("B",), 12.0)
    assert ledger.reported(messages.SAFE).tolist() == [True, False, True]
    assert ledger.reported(messages.JOINING).all()
    field.heard[:] = 20.0
    # A new aim moves only a heliostat that tracks; a new standby point only one that stands there.
    ledger.sent("AIM", field.names, 20.0)
    assert ledger.reported().tolist() == [False, True, True]
    ledger.sent("STANDBY", field.names[1:2], 20.0)
    assert ledger.reported().tolist() == [False, False, True]
    # Two orders of one instant keep their order; a repetition is no new order.
    ledger.sent("LOCK", field.names[:2], 30.0)
    ledger.sent("STOW", field.names[1:], 30.0)
    assert ledger.later(messages.SAFE, LOCKING).tolist() == [False, True, True]
    ledger.sent("LOCK", ("B",), 40.0)
    ledger.sent("STOW", ("B",), 41.0, again=True)
    assert ledger.later(messages.SAFE, LOCKING).tolist() == [False, False, True]
    assert ledger.sent_since(STOWING, 30.0).tolist() == [False, True, True]
    assert not ledger.sent_since(STOWING, 31.0).any()
    field.heard[:] = 41.5
    assert not ledger.reported(STOWING)[1], "the board may take the repetition only now"
    # An acknowledgement of an order that was accepted before the other one says nothing.
    for accepted, obeyed in ((39.0, False), (40.5, True)):
        ledger.acknowledged("IDLE", accepted, ("B",), 42.0)
        assert bool(ledger.obeyed_since(TO_REST, 42.0, after=LOCKING)[1]) is obeyed
    assert not ledger.obeyed_since(TO_REST, 42.5, after=LOCKING).any()


def test_a_mandate_outlives_its_holder_and_ends_heliostat_by_heliostat() -> None:
    clock = VirtualClock()
    authority = Authority(clock, 15.0)
    egon, vera = Person("Egon", Role.ENGINEER), Person("Vera", Role.OPERATOR)
    token = authority.take(egon).token
    with (
        pytest.raises(RefusedError, match="visit: Vera is operator"),
        authority.mandate(vera, token, ("A",), "left"),
    ):
        pass
    with authority.mandate(egon, token, ("A", "B"), "left") as mandate:
        assert authority.present(mandate.token) == token
        clock.advance(15.0)
        assert authority.grant is None
        own = authority.token
        assert own not in (0, token), "the clusters obey the plant itself"
        assert authority.present(mandate.token) == own
        assert authority.silent_for == 0.0
        taken = authority.take(vera).token
        assert authority.present(mandate.token) == taken
        authority.check(egon, mandate.token, "PARAMETERS")
        with pytest.raises(RefusedError, match="Vera has it"):
            authority.check(egon, token, "TRACK")
        with pytest.raises(RefusedError, match="Vera has it"):
            authority.check(vera, mandate.token, "TRACK")
        authority.prevail(("B", "C"), "Vera ordered IDLE")
        assert mandate.refused("AB") == {"B": "it dropped out of the visit: Vera ordered IDLE"}
        assert authority.lost(mandate.token, "AB") == authority.left(mandate.token, "AB") == {"B"}
        authority.release(vera, taken)
        last = authority.token
        assert last not in (0, own, taken)
        assert authority.take(egon).token == last, "his visit alone goes on: nothing changes"
        authority.release(egon, last)
        assert authority.token not in (0, last)
        authority.end_mandates(egon, "automatic control has been stopped")
        assert authority.present(mandate.token) == 0
        assert authority.lost(mandate.token, "A") == {"A"}
        assert not authority.left(mandate.token, "A"), "the visit takes its beam off"
        with pytest.raises(RefusedError, match="TRACK: automatic control has been stopped"):
            authority.check(egon, mandate.token, "TRACK")
    assert authority.token == 0
    assert authority.left(mandate.token, "A") == {"A"}


@pytest.mark.parametrize(
    ("end", "wanted"),
    [
        (lambda a, m: a.prevail("AB", "Vera ordered STOW"), TakenOutError),
        (lambda a, m: a.prevail("A", "Vera ordered STOW"), RefusedError),
        (lambda a, m: a.prevail("AB", "the safety table ordered STOW", fault=True), RefusedError),
        (lambda a, m: m.give_up("AB"), RefusedError),
    ],
)
def test_a_visit_that_orders_of_others_have_ended_says_so(
    end: Callable[[Authority, Mandate], None], wanted: type[RefusedError]
) -> None:
    egon = Person("Egon", Role.ENGINEER)
    authority = Authority(VirtualClock())
    token = authority.take(egon).token

    def visit() -> None:
        with authority.mandate(egon, token, "AB", "target") as mandate:
            end(authority, mandate)
            raise RefusedError("IDLE: not accepted")

    with pytest.raises(RefusedError, match="IDLE: not accepted") as raised:
        visit()
    assert type(raised.value) is wanted
