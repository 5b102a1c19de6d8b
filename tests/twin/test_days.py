"""Working days in simulation: what breaks on them is found, and each observer can fail."""

import os
import subprocess
import sys
from math import degrees, inf
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.lcu import states
from heliotrope.links.messages import Command, Stage
from heliotrope.plant.operations.automatic import AUTOMATIC
from heliotrope.plant.operations.views import Running
from heliotrope.plant.orders.audit import Record
from heliotrope.plant.orders.authority import Person
from heliotrope.safety import Act, Alarm, Severity
from heliotrope.sun import vector
from heliotrope.twin.invariants.alarms import AlarmObserver
from heliotrope.twin.invariants.invariants import (
    L2,
    L3,
    TITLES,
    InvariantError,
    Violation,
    named,
)
from heliotrope.twin.invariants.plant_observer import PlantObserver
from heliotrope.twin.invariants.progress import LOCKED_WITHIN, TRACKS_WITHIN, ProgressObserver
from heliotrope.twin.invariants.results import BARREN, RETRIES, SEARCHES, ResultObserver
from heliotrope.twin.invariants.tickets import OVER_WITHIN, TicketObserver
from heliotrope.twin.records import RecordsDisk
from heliotrope.twin.world.acts import Acts
from heliotrope.twin.world.operator import ENGINEER
from heliotrope.twin.world.scene import TARGETS, scene_of
from heliotrope.twin.world.simulation import SETTINGS, RunPlan, run
from heliotrope.twin.world.worlds import ALONE_SHARE, DAY, DAYS, LIMIT, covered_by, length_of, mixed

#: High enough for every day, above no limit.
ZENITH = np.array([0.0, 0.0, 1.0])


def day(seed: int, seconds: float = DAY) -> RunPlan:
    """Return the plan of a day."""
    return RunPlan(seed, seconds, worlds=(DAYS,))


@pytest.mark.parametrize("seed", range(6))
def test_a_day_has_a_morning_an_evening_and_an_hour_of_neither(seed: int) -> None:
    scene = scene_of((DAYS,), seed, DAY, 6)
    times = scene.start.timestamp() + np.arange(0.0, DAY + 1.0, 5.0)
    above = np.degrees(np.arcsin(vector(times, scene.site)[:, 2])) - degrees(scene.lowest)
    assert above.max() > 1.2  # the field is raised again only a degree above the limit
    assert (above[-20:] < 0.0).all()
    assert (above > 0.0).sum() * 5.0 > 0.6 * DAY


def test_a_day_is_some_of_any_and_has_its_own_length() -> None:
    drawn = [mixed(seed) for seed in range(400)]
    days = [worlds for worlds in drawn if DAYS in worlds]
    assert all(worlds == (DAYS,) for worlds in days)
    assert 0.5 * ALONE_SHARE < len(days) / 400 < 1.5 * ALONE_SHARE
    limits = [worlds for worlds in drawn if LIMIT in worlds]
    assert all(worlds == (LIMIT,) for worlds in limits)
    assert 0.4 * ALONE_SHARE < len(limits) / 400 < 1.5 * ALONE_SHARE
    assert length_of((DAYS,), None) == DAY
    assert length_of((DAYS,), 0.5) == 1800.0
    assert length_of(("visits",), None) == 360.0


def test_on_some_days_a_mirror_is_covered() -> None:
    names = tuple(f"H{i}" for i in range(6))
    days = [covered_by(names, (DAYS,), seed) for seed in range(200)]
    assert 0.15 < sum(map(bool, days)) / 200 < 0.35
    assert {len(some) for some in days} == {0, 1}
    assert not any(covered_by(names, ("parties",), seed) for seed in range(200))


def test_people_call_invariants_of_liveness_by_their_names() -> None:
    assert [named(number) for number in TITLES] == [
        *map(str, range(1, 20)), "L1", "L2", "L3", "L4"
    ]  # fmt: skip
    assert str(Violation(L2, 3.0, "H1", "so")).startswith("invariant L2 (each ticket")


# -- each observer can fail --------------------------------------------------------------------


def board(state: int, miss: float = 0.0) -> Any:
    """Return a board in a state, with its beam so far from wherever one asks, m."""
    return SimpleNamespace(
        state=state, outfit=SimpleNamespace(name="H1"), miss=lambda *_, **__: miss
    )


def plant(**more: Any) -> Any:
    """Return the operations of a plant at which nothing is under way."""
    sentinel = SimpleNamespace(order=None, on=False)
    order = SimpleNamespace(sentinel=sentinel, beliefs=SimpleNamespace())
    order.beliefs.record = lambda name: None
    order.__dict__.update(more.pop("plant", {}))
    automatic = SimpleNamespace(
        waits="",
        service=SimpleNamespace(out=()),
        view=lambda: SimpleNamespace(running=(), results=()),
    )
    automatic.__dict__.update(more)
    return SimpleNamespace(
        plant=order, logbook=SimpleNamespace(alarms=lambda: ()), automatic=automatic
    )


def progress(state: int, seconds: float, *, miss: float = 0.0, begins: Any = None) -> Any:
    """Observe a mirror that automatic control has, for a while."""
    observer = ProgressObserver(0.0, [board(state, miss)], (), together=True, across=False)
    observer.given(("H1",))
    if begins is not None:
        begins(observer)
    for now in np.arange(0.0, seconds, 0.5):
        observer.look(plant(), {"H1"}, ZENITH, float(now), governs=True)
    return observer


def test_no_mirror_stays_locked_without_an_owner() -> None:
    progress(states.LOCKED, LOCKED_WITHIN)
    with pytest.raises(InvariantError, match=r"invariant L1 .* has been LOCKED for 60 s"):
        progress(states.LOCKED, LOCKED_WITHIN + 2.0)
    # A person has locked it, and unlocks it; another one has it out of service.
    progress(
        states.LOCKED, LOCKED_WITHIN + 9.0, begins=lambda seen: seen.commanded("LOCK", ("H1",))
    )

    def unlocks(observer: ProgressObserver) -> None:
        observer.commanded("LOCK", ("H1",))
        observer.commanded("UNLOCK", ("H1",))

    with pytest.raises(InvariantError, match="invariant L1"):
        progress(states.LOCKED, LOCKED_WITHIN + 2.0, begins=unlocks)


def test_a_mirror_that_automatic_control_has_tracks_again() -> None:
    progress(states.TRACKING, TRACKS_WITHIN + 9.0)
    for state, miss in ((states.IDLE, 0.0), (states.TRACKING, 9.0), (states.DEFOCUSED, 0.0)):
        with pytest.raises(InvariantError, match=r"invariant L3 .* has not tracked the receiver"):
            progress(state, TRACKS_WITHIN + 2.0, miss=miss)
    # Only the person who has locked a mirror gives it back, and a lock ends only as one.

    def locks(observer: ProgressObserver) -> None:
        observer.commanded("LOCK", ("H1",))

    progress(states.LOCKED, TRACKS_WITHIN + 9.0, begins=locks)
    with pytest.raises(InvariantError, match="invariant L3"):
        progress(states.IDLE, TRACKS_WITHIN + 2.0, begins=locks)


def watched(stage: str, *, rough: int = 0, gone: bool = False, touched: bool = False) -> None:
    """Observe a visit of a mirror that is on its target, after a person has taken command."""
    target, one = TARGETS[0], board(states.TRACKING)
    one.node = SimpleNamespace(controller=SimpleNamespace(motion=SimpleNamespace(rough=rough)))
    run = Running("H1", target.name, stage, 0.0)
    seen = SimpleNamespace(running=(run,), results=())
    operations = plant(view=lambda: seen)
    observer = ProgressObserver(0.0, [one], (target,), together=True, across=False)
    observer.given(("H1",))
    observer.took(operations, 0.0)
    observer.look(operations, {"H1"}, ZENITH, 0.5, governs=True)
    if gone:
        entry = SimpleNamespace(
            heliostat="H1", target=target.name, outcome=CalibrationOutcome.REFUSED,
            at=1.0, new=0, good=False,
        )  # fmt: skip
        seen.running, seen.results = (), (entry,)
    if touched:
        observer.taken(("H1",))
    observer.look(operations, {"H1"}, ZENITH, 1.0, governs=True)


def test_a_visit_goes_on_whoever_takes_command() -> None:
    watched("on the way")
    watched("on the way", gone=True, touched=True)
    with pytest.raises(InvariantError, match=r"invariant 16 .* of H1, whose heliostats nobody"):
        watched("on the way", gone=True)


def test_a_mirror_that_is_photographed_steps_finely() -> None:
    watched("photograph 1 of 8")
    watched("on the way", rough=1)
    with pytest.raises(InvariantError, match=r"invariant 16 .* but is in rough stepping mode"):
        watched("photograph 1 of 8", rough=1)


def test_a_persons_emergency_and_what_is_out_of_service_outlive_a_restart() -> None:
    def restarted(new: Any, *, called: bool, out: bool) -> None:
        observer = ProgressObserver(0.0, [board(states.STOWED)], (), together=True, across=False)
        observer.emergency(on=called)
        if out:
            observer.held(("H1",), 0.0, out=True)
        observer.on_end(1.0)
        observer.look(new, set(), ZENITH, 1.0, governs=False)

    out = SimpleNamespace(out=(SimpleNamespace(name="H1"),))
    restarted(plant(), called=False, out=False)
    restarted(plant(waits="an emergency held"), called=True, out=False)
    restarted(plant(service=out), called=False, out=True)
    with pytest.raises(InvariantError, match=r"invariant L4 .* the new program continues"):
        restarted(plant(), called=True, out=False)
    with pytest.raises(InvariantError, match=r"invariant L4 .* returned to service: H1"):
        restarted(plant(), called=False, out=True)


def test_an_emergency_that_a_person_has_acknowledged_need_not_outlive_a_restart() -> None:
    """Simulated day 52: the plant's program ended four seconds after the end of the emergency."""

    def tidied(*acknowledged: str) -> list[bool]:
        """Return what the observers hear while the plant holds an emergency on."""
        heard: list[bool] = []
        acts: Any = Acts.__new__(Acts)
        acts._operator = SimpleNamespace(clear=lambda _: set(acknowledged))
        acts._watch = SimpleNamespace(emergency=lambda *, on: heard.append(on))
        acts.tidies(SimpleNamespace(plant=SimpleNamespace(sentinel=SimpleNamespace(on=True))))
        return heard

    assert tidied("clock_jump") == []
    assert tidied("operator_emergency") == [False]


def commanded(
    what: str = "TRACK",
    *,
    name: str = "H1",
    by: Person = AUTOMATIC,
    after: float = 5.0,
    gone: bool = False,
) -> None:
    """Observe a command to a heliostat some time after a person has commanded H1, but not H2."""
    disk = RecordsDisk()
    observer = PlantObserver(0.0, disk, SETTINGS, [])
    observer.granted(ENGINEER, 8, 0.0, seized=False)
    taken: Any = SimpleNamespace(identity="x-1", heliostats=("H1", "H2"), refusals={"H2": "no"})
    disk.records["x-1"] = Record("x-1", ENGINEER.name, "engineer", "IDLE", "")
    observer.on_accepted(ENGINEER, 8, taken, "IDLE", 1.0)
    now = 1.0 + after
    if gone:
        observer.released(ENGINEER, now)
    disk.records["x-2"] = Record("x-2", by.name, "engineer", what, "")
    observer.posted(("H1", "H2"), Command("x-2.1", what, (), (name,), 8, 5.0), now)


def test_a_visit_moves_no_heliostat_that_a_person_has_taken() -> None:
    commanded(name="H2")
    commanded(by=ENGINEER)
    commanded("ROUGH")
    commanded(after=0.3)  # it was on its way
    commanded(gone=True)
    with pytest.raises(InvariantError, match=r"invariant 4 .* sends H1 TRACK; engineer took it"):
        commanded()
    with pytest.raises(InvariantError, match=r"invariant 4 .* sends H1 LOCK"):
        commanded("LOCK")


def ticket(stage: Stage | None, *, finished: bool, name: str = "STOW") -> Any:
    """Return a ticket of one heliostat."""
    return SimpleNamespace(
        name=name, heliostats=("H1",), refusals={}, text=f"{name}: 1 waiting",
        finished=finished, stage=lambda _: stage,
    )  # fmt: skip


def ticked(one: Any, at: float, *, was: bool = True, stowed: bool = False) -> None:
    """Observe a ticket some time after it was accepted."""
    account: Any = SimpleNamespace(
        state=states.FAULT, was_in=lambda wanted, since: was, stands_at_stow=lambda: stowed
    )
    observer = TicketObserver(0.0, {"H1": account})
    observer.on_accepted(ENGINEER, 1, one, "TRACK", 1.0)
    observer.look(1.0 + at, runs=True)


def test_a_ticket_ends_and_is_done_only_where_the_mirror_is() -> None:
    ticked(ticket(Stage.ACKNOWLEDGED, finished=False), OVER_WITHIN)
    ticked(ticket(Stage.DONE, finished=True), 5.0)
    ticked(ticket(None, finished=False, name="PARAMETERS"), OVER_WITHIN + 9.0)
    with pytest.raises(InvariantError, match=r"invariant L2 .* STOW: 1 waiting after 301 s"):
        ticked(ticket(Stage.ACKNOWLEDGED, finished=False), OVER_WITHIN + 1.0)
    ticked(ticket(Stage.DONE, finished=True), 5.0, was=False, stowed=True)
    with pytest.raises(
        InvariantError, match=r"invariant L2 .* STOW of H1 is done, but it is FAULT"
    ):
        ticked(ticket(Stage.DONE, finished=True), 5.0, was=False)
    with pytest.raises(
        InvariantError, match=r"invariant L2 .* DEFOCUS of H1 is done, but it is FAULT"
    ):
        ticked(ticket(Stage.DONE, finished=True, name="DEFOCUS"), 5.0, was=False, stowed=True)


def alarmed(
    kind: str,
    *,
    rest: float,
    began: float = 0.0,
    calls: int = 0,
    over: int = 0,
    ends: bool = False,
) -> None:
    """Observe an alarm at 200 s, after a fault that ended at some time.

    Before that persons have called some emergencies, of which some are over. It stays, or ends at
    once.
    """
    observer = AlarmObserver(0.0, {"C1": [board(states.STOWED)]}, (DAYS,))
    if began:
        observer.on_end(0.0)
    for _ in range(calls):
        observer.on_call("Ann", Act.STOW, 0.0)
    for _ in range(over):
        observer.on_alarm(
            Alarm("operator_emergency", "", Severity.ALARM, "it is over", active=False), 1.0
        )
    for now in np.arange(began, 200.0, 0.5):
        observer.on_heard("C1", float(now))
        observer.look({"H1": rest}, {"C1"}, float(now), runs=True, writes=True)
    observer.on_alarm(Alarm(kind, "", Severity.ALARM, "three heliostats left the receiver"), 200.0)
    if ends:
        observer.on_alarm(Alarm(kind, "", Severity.ALARM, "it is over", active=False), 200.0)
    observer.on_heard("C1", 200.0)
    observer.look({"H1": rest}, {"C1"}, 200.0, runs=True, writes=True)


def test_the_plants_own_act_is_no_cause_of_an_alarm() -> None:
    for kind, rest in (("resume_needed", 150.0), ("flux_after_emergency", 120.0)):
        alarmed(kind, rest=rest)
        for early in (-inf, 100.0):
            own = r"invariant L2 .* cause is the plant's own act"
            with pytest.raises(InvariantError, match=own):
                alarmed(kind, rest=early)


def test_an_emergency_has_a_person_who_has_called_it() -> None:
    alarmed("operator_emergency", rest=-inf, calls=1)
    alarmed("operator_emergency", rest=-inf, calls=1, ends=True)  # simulated day 7
    alarmed("operator_emergency", rest=-inf, began=198.0)  # a new program goes on with it
    for calls, over in ((0, 0), (1, 1)):
        with pytest.raises(InvariantError, match=r"invariant L2 .* nobody has ordered one"):
            alarmed("operator_emergency", rest=-inf, calls=calls, over=over)


def visited(
    count: int, *, asks: int = 0, outcome: str = "not_proven", names: int = 1, every: float = 10.0
) -> None:
    """Observe visits, each of which brings nothing; nearer than 5 s they are one visit."""
    observer = ResultObserver.__new__(ResultObserver)
    accounts: dict[str, Any] = {}
    observer.__dict__.update(
        checks=dict.fromkeys(TITLES, 0), start=0.0, _zero=0.0, _accounts=accounts,
        _boards={f"H{i}": None for i in range(names)}, _dark=frozenset(), _barren=[],
        _together=True,
    )  # fmt: skip
    observer.__dict__["_noted"] = lambda *_: None
    for i in range(names):
        accounts[f"H{i}"] = SimpleNamespace(
            kept=0,
            last=0,
            version=0,
            result_version=0,
            before=None,
            vain=0,
            searched=0,
            pictures=[],
        )
    beliefs = SimpleNamespace(record=lambda _: None, known=lambda _: None, present=lambda _: None)
    operations: Any = SimpleNamespace(plant=SimpleNamespace(beliefs=beliefs))
    for k in range(count):
        if asks and k % asks == 0:
            observer.asked(("H0",))
        entry: Any = SimpleNamespace(
            heliostat=f"H{k % names}", at=every * k, target="left", new=0, sightings=0, good=False,
            outcome=CalibrationOutcome[outcome.upper()], version=0, text="no light follows",
        )  # fmt: skip
        observer._concluded(operations, entry, every * k)


def test_visits_that_bring_nothing_end(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InvariantError, match=rf"invariant 16 .* {BARREN} results in a row"):
        visited(BARREN, names=3)
    visited(3 * BARREN, names=3, every=1.0)  # one visit of all
    visited(3 * BARREN, names=3, outcome="refused")
    monkeypatch.setattr("heliotrope.twin.invariants.results.BARREN", 10**6)
    visited(RETRIES)
    visited(3 * RETRIES, asks=RETRIES)
    with pytest.raises(InvariantError, match=rf"invariant L2 .* {RETRIES + 1} visits in a row"):
        visited(RETRIES + 1)
    visited(SEARCHES, outcome="no_beam")
    visited(3 * SEARCHES, outcome="no_beam", asks=SEARCHES)
    with pytest.raises(
        InvariantError, match=rf"invariant L2 .* without success {SEARCHES + 1} times"
    ):
        visited(SEARCHES + 1, outcome="no_beam")


# -- whole days --------------------------------------------------------------------------------


def test_days_are_lived_through() -> None:
    outcome = run(day(2))
    assert outcome.good, outcome.text
    assert outcome.seconds == DAY
    assert min(outcome.checks[number] for number in (16, L2, L3)) > 30
    assert outcome.states[states.LOCKED] > 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4, 6, 7, 12])
def test_more_days_are_lived_through(seed: int) -> None:
    """6: a lock of a person who has left. 12: all refuse APPROACH, two of them on a target."""
    outcome = run(day(seed))
    assert outcome.good, outcome.text


@pytest.mark.slow
def test_a_day_is_the_same_in_every_process() -> None:
    """The order of a set of texts differs from process to process."""
    text = (
        "from heliotrope.twin.world.simulation import RunPlan, run\n"
        "found = run(RunPlan(8, 300.0, worlds=('days',)))\n"
        "print(found.seconds, sorted(found.checks.items()), found.text)"
    )
    seen = {
        subprocess.run(
            [sys.executable, "-c", text],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            check=True,
            text=True,
        ).stdout
        for seed in ("0", "1", "2")
    }
    assert len(seen) == 1
