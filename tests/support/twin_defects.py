"""Defects to plant in the code that the simulation runs: one or more for each invariant."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import pytest

from heliotrope.cluster import _nodes, _reports, _runs, _watch
from heliotrope.lcu import (
    controller,
    journal,
    lease,
    messages,
    motion,
    node,
    states,
    stepper,
    ticks,
    wire,
)
from heliotrope.links.messages import Stage
from heliotrope.mechanism.board_items import items_of
from heliotrope.plant.field import aims
from heliotrope.safety import evaluation
from heliotrope.twin.boards import outfit
from heliotrope.twin.world.crew import CrewAct
from heliotrope.twin.world.faults import Fault
from heliotrope.twin.world.simulation import RunPlan
from support import (
    aim_defects,
    day_defects,
    plant_defects,
    quiet_defects,
    report_defects,
    review_defects,
    work_defects,
)

#: The plant stands still for a minute when mirrors track.
STILL = (Fault("plant_silent", 110.0, 60.0, 0, 0.5),)

Plant = Callable[[pytest.MonkeyPatch], None]


@dataclass(frozen=True)
class Defect:
    """A defect, the invariants by which it may be found, and where to look for it.

    ``first`` is the seed that is tried first, since it found it, and the only one that the normal
    tests try. ``slow``: it takes longer, and the normal tests have another one for its invariant.
    """

    numbers: tuple[int, ...]
    name: str
    plant: Plant
    only: tuple[str, ...] = ()
    pause: float = 12.0
    seconds: float = 240.0
    faults: tuple[Fault, ...] | None = None
    first: int = 0
    slow: bool = False
    worlds: tuple[str, ...] = ()
    acts: tuple[CrewAct, ...] | None = None

    def plan(self, seed: int) -> RunPlan:
        """Where it is looked for."""
        given = self.seconds, 3, self.pause, self.only, self.faults, self.worlds, self.acts
        return RunPlan(seed, *given)


def _lease_by_any_frame(patch: pytest.MonkeyPatch) -> None:
    message = controller.Controller._message

    def renewing(self: Any, *values: Any) -> None:
        message(self, *values)
        if self.sun._left.left > 0:
            self.sun._left.start(values[5], self.sun.span_ms)

    patch.setattr(controller.Controller, "_message", renewing)


def _defocus_holds(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(motion.Motion, "defocus", motion.Motion.hold)


def _plant_forgotten(patch: pytest.MonkeyPatch) -> None:
    """No lease, and no row of the safety table that tells of its end."""
    patch.setattr(_watch.Watch, "alone", lambda self, now: False)
    patch.setattr(_watch.Watch, "_table", lambda self: ())


def _tracks_by_itself(patch: pytest.MonkeyPatch) -> None:
    line = "APPROACHING ARRIVED IDLE standby"
    assert line in states.TABLE
    patch.setattr(states, "TABLE", states.TABLE.replace(line, "APPROACHING ARRIVED TRACKING track"))


def _defocus_from_cluster_only(patch: pytest.MonkeyPatch) -> None:
    on_frame = controller.Controller.on_frame

    def choosy(self: Any, frame: Any, now_ms: int) -> Any:
        if frame.sender != 0 and messages.who_of(frame.number) == messages.ANYONE:
            self.out.clear()
            return self.out
        return on_frame(self, frame, now_ms)

    patch.setattr(controller.Controller, "on_frame", choosy)


def _authority_unchecked(patch: pytest.MonkeyPatch) -> None:
    judge = wire.Gate.judge

    def trusting(self: Any, frame: Any, tick: int, now_s: int | None) -> int:
        found = judge(self, frame, tick, now_s)
        values = frame.values()
        if found == messages.REFUSED_AUTHORITY and frame.sender == 0 and values is not None:
            return messages.EXPIRED if wire.expired(values[1], now_s) else messages.DONE
        return found

    patch.setattr(wire.Gate, "judge", trusting)


def _duplicates_accepted(patch: pytest.MonkeyPatch) -> None:
    def fresh(self: Any, sequence: int, tick: int) -> bool:
        self.count += (sequence - self.count) & 0xFFFF
        return bool(self.look(tick))

    patch.setattr(wire.Replay, "fresh", fresh)


def _damage_accepted(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(wire, "crc32", lambda data: 0)
    for question in (_nodes.STATUS, _nodes.STEPS):
        # Questions are kept as bytes, checksum and all, for every cluster of the process.
        patch.setattr(question, "_frames", {})


def _journal_in_place(patch: pytest.MonkeyPatch) -> None:
    store = journal.Journal.store

    def over_the_old(self: Any, changes: dict[str, bytes]) -> None:
        if any(self.items.get(name) != data for name, data in changes.items()):
            self._slot = 1 - self._slot
        store(self, changes)

    patch.setattr(journal.Journal, "store", over_the_old)


def _counts_late(patch: pytest.MonkeyPatch) -> None:
    """Step counts are kept at rest only: nothing is written before the steps."""
    patch.setattr(journal.Journal, "before_steps", lambda self, *counts: None)


def _idle_after_boot(patch: pytest.MonkeyPatch) -> None:
    line = "UNCONFIGURED BOOT_AWAY DEFOCUSED defocus"
    assert line in states.TABLE
    patch.setattr(states, "TABLE", states.TABLE.replace(line, "UNCONFIGURED BOOT_AWAY IDLE hold"))


def _counts_slip(patch: pytest.MonkeyPatch) -> None:
    slot = stepper.Axis.slot

    def slipping(self: Any, held: bool) -> int:
        steps = slot(self, held)
        if steps > 100:
            self.count -= self.direction
        return steps

    patch.setattr(stepper.Axis, "slot", slipping)


def _jump_extends_lease(patch: pytest.MonkeyPatch) -> None:
    def signed(self: Any, now: int) -> int:
        step = ticks.diff(now, self._seen)
        self._seen = now
        self.left = max(0, self.left - step)
        return int(self.left)

    patch.setattr(ticks.Deadline, "look", signed)
    patch.setattr(lease.SunLease, "end", lambda self: None)


def _approach_swapped(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(motion, "PRIMARY_FIRST", stepper.SECONDARY_FIRST)
    patch.setattr(motion, "SECONDARY_FIRST", stepper.PRIMARY_FIRST)


def _beams_not_proven(patch: pytest.MonkeyPatch) -> None:
    """What enters a volume is seen, and told to nobody."""
    patch.setattr(aims.BeamCheck, "_tell", lambda *_: None)


def _acceptance_lost(patch: pytest.MonkeyPatch) -> None:
    add = _reports.Reports.add

    def losing(self: Any, identity: str, stage: Stage, *rest: str, **more: str) -> None:
        if stage is not Stage.ACCEPTED:
            add(self, identity, stage, *rest, **more)

    patch.setattr(_reports.Reports, "add", losing)


def _always_new(patch: pytest.MonkeyPatch) -> None:
    pack_into = _nodes.ClusterNode.pack_into

    def fresh(self: Any, block: bytearray, now: float) -> None:
        told = self.status_at
        if told > -math.inf:
            self.status_at = now
        pack_into(self, block, now)
        self.status_at = told

    patch.setattr(_nodes.ClusterNode, "pack_into", fresh)


def _young_by_any_answer(patch: pytest.MonkeyPatch) -> None:
    """A row is as old as the last answer of any kind, be it an ACK."""
    pack_into = _nodes.ClusterNode.pack_into

    def of_any(self: Any, block: bytearray, now: float) -> None:
        told, self.status_at = self.status_at, self.heard_at
        pack_into(self, block, now)
        self.status_at = told

    patch.setattr(_nodes.ClusterNode, "pack_into", of_any)


def _questions_alike(patch: pytest.MonkeyPatch) -> None:
    """All questions go out under one sequence: a late answer passes for the one to a later one."""
    patch.setattr(_nodes, "SEQUENCES", 1)


def _sun_turned(patch: pytest.MonkeyPatch) -> None:
    """Every local controller points by a sun that is ten minutes further west."""
    vector = lease.SunLease.vector

    def turned(self: Any, ahead_ms: int) -> tuple[float, float, float]:
        east, north, up = vector(self, ahead_ms)
        return east - 0.04 * north, north + 0.04 * east, up

    patch.setattr(lease.SunLease, "vector", turned)


def _armature_exchanged(patch: pytest.MonkeyPatch) -> None:
    """The items of a board are those of another mirror: one that leans by 30 mrad."""
    patch.setattr(
        outfit, "items_of", lambda mechanism, machine: items_of(_leaning(mechanism), machine)
    )


def _leaning(mechanism: Any) -> Any:
    return mechanism.with_parameters(dict.fromkeys(outfit.CAUSES, 0.03))


def _stays_after_boot(patch: pytest.MonkeyPatch) -> None:
    line = "UNCONFIGURED BOOT_AWAY DEFOCUSED defocus"
    assert line in states.TABLE
    table = states.TABLE.replace(line, "UNCONFIGURED BOOT_AWAY DEFOCUSED hold")
    assert "DEFOCUSED SILENT STOWING" in table
    table = table.replace("DEFOCUSED SILENT STOWING", "DEFOCUSED SILENCE STOWING")
    patch.setattr(states, "TABLE", table)


def _stays_without_counts(patch: pytest.MonkeyPatch) -> None:
    """Every reset after the first loses the step counts, and without them no mirror turns away."""
    defocus, doubt = motion.Motion.defocus, journal.Journal.doubt.fget
    assert doubt is not None

    def by_counts(self: Any) -> None:
        (defocus if self.known else motion.Motion.hold)(self)

    patch.setattr(motion.Motion, "defocus", by_counts)
    lost = property(lambda self: -1 if self.boots > 0 else doubt(self))
    patch.setattr(journal.Journal, "doubt", lost)


def _lease_too_long(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(lease.SunLease, "fresh", lambda self: True)
    patch.setattr(lease.SunLease, "look", lambda self, now, elapsed: True)


def _search_without_sun(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(states, "NEED_SUN", (states.APPROACHING, states.TRACKING))


def _ready_after_stow(patch: pytest.MonkeyPatch) -> None:
    """That standby was reached by the safe way is not forgotten at stow."""

    def remembering(does: Callable[[Any], None]) -> Callable[[Any], None]:
        def sticky(self: Any) -> None:
            ready = self.ready
            does(self)
            self.ready = self.ready or ready

        return sticky

    for name in ("stow", "stow_directly", "approach"):
        patch.setattr(motion.Motion, name, remembering(getattr(motion.Motion, name)))


def _straight_to_standby(patch: pytest.MonkeyPatch) -> None:
    """No way along the ground: from stow straight to the standby point."""

    def straight(self: Any) -> list[tuple[float, float, float]]:
        return [self.config.standby] if self.config.standby is not None else []

    patch.setattr(motion.Motion, "way", straight)


def _sun_in_the_dark(patch: pytest.MonkeyPatch) -> None:
    """SUN goes out although the cluster's safety table says dark."""
    patch.setattr(_watch.Verdict, "dark", property(lambda self: False))


def _two_plants_obeyed(patch: pytest.MonkeyPatch) -> None:
    """A cluster takes the lease of every plant with its key."""
    patch.setattr(_runs.PlantRuns, "admits", lambda self, run, now: True)


def _brown_out_as_queued(patch: pytest.MonkeyPatch) -> None:
    """The last record counts the steps that were queued and are not made any more."""
    failing = node.Node.on_supply_failing

    def careless(self: Any, now_ms: int) -> bool:
        self.timer.stop()  # what it takes back is forgotten
        return bool(failing(self, now_ms))

    patch.setattr(node.Node, "on_supply_failing", careless)


def _silence_unseen(patch: pytest.MonkeyPatch) -> None:
    """The last reading of a sensor counts for ever."""
    advance = evaluation._advance

    def patient(row: Any, track: Any, reading: Any, now: float) -> Any:
        fed = reading is not None and not row.ages
        return advance(row, track, replace(reading, at=now) if fed else reading, now)

    patch.setattr(evaluation, "_advance", patient)


def kinds_of(some: tuple[str, ...] | tuple[Fault, ...]) -> tuple[str, ...]:
    """Return the kinds among kinds or faults."""
    return tuple(each for each in some if isinstance(each, str))


def faults_of(some: tuple[str, ...] | tuple[Fault, ...]) -> tuple[Fault, ...] | None:
    """Return the faults among kinds or faults, None if they are drawn."""
    return tuple(each for each in some if isinstance(each, Fault)) or None


DEFECTS = (
    Defect((1, 4, 5), "lease renewed by any frame", _lease_by_any_frame,
           ("cluster_crash", "replay", "stranger_safe", "forgery"), 1.5),
    Defect((1,), "lease that never ends", _lease_too_long, ("cluster_crash",), 20.0,
           first=1),
    Defect((2,), "defocus only holds", _defocus_holds, faults=STILL, seconds=180.0, first=2,
           worlds=("calm",)),
    Defect((2,), "cluster goes on without the plant", _plant_forgotten, ("plant_silent",), 20.0),
    Defect((3,), "tracking follows approach by itself", _tracks_by_itself, ("line_drop",), 60.0,
           first=1),
    Defect((4,), "DEFOCUS refused to strangers", _defocus_from_cluster_only,
           ("stranger_safe",), 5.0),
    Defect((4,), "authority unchecked", _authority_unchecked, ("forgery",), 1.0),
    Defect((5,), "duplicate accepted", _duplicates_accepted, ("replay",), 0.4),
    Defect((6,), "damaged frame accepted", _damage_accepted, ("bus_bad",), 5.0),
    Defect((7,), "journal written in place", _journal_in_place, ("flash_cut",), 3.0,
           first=1, slow=True),
    Defect((7,), "step counts kept at rest only", _counts_late, ("power_cut",), 8.0),
    Defect((7,), "idle after a boot", _idle_after_boot, ("power_cut",), 8.0),
    Defect((8,), "counts slip from what is emitted", _counts_slip, ("line_drop",), 60.0,
           first=1),
    Defect((9,), "a jump back extends the lease", _jump_extends_lease,
           ("tick_jump", "cluster_crash"), 3.0, first=4),
    Defect((10,), "approach with elevation first", _approach_swapped, ("line_drop",), 60.0),
    Defect((10,), "beams not proven", _beams_not_proven, ("line_drop",), 60.0, first=1),
    Defect((11,), "acceptance never reported", _acceptance_lost, ("line_drop",), 60.0),
    Defect((11,), "every value told as new", _always_new, ("bus_bad", "power_cut"), 10.0),
    Defect((11,), "an acknowledgement makes a row young", _young_by_any_answer, ("bus_bad",), 5.0),
    Defect((11,), "a late answer passes for another", _questions_alike, ("bus_bad",), 5.0,
           first=3, slow=True),
    Defect((12, 16), "a sun ten minutes ahead", _sun_turned, ("line_drop",), 60.0,
           worlds=("calm",)),
    Defect((12, 16), "the armature of another mirror", _armature_exchanged, ("line_drop",), 60.0,
           worlds=("calm",)),
    Defect((12, 16), "identity never checked", plant_defects.identity_unchecked,
           ("line_drop",), 60.0, slow=True, worlds=("addresses", "calm"), first=8),
    Defect((14,), "the field resumes by itself", plant_defects.resumes_by_itself, seconds=180.0,
           faults=tuple(Fault("line_cut", at, 9.0, 0, 0.5) for at in (80.0, 120.0, 150.0)),
           worlds=("calm",)),
    Defect((2,), "a mirror stays where it was after a boot", _stays_after_boot,
           # The plant sends off a beam that nobody sent, so it must not reach the boards.
           faults=tuple(Fault(kind, at, long, i, 0.5) for i in range(3) for kind, at, long in
                        (("power_cut", 150.0, 2.0), ("bus_unplugged", 151.0, 60.0))),
           seconds=220.0, first=2, worlds=("calm",)),
    Defect((13,), "a mirror without step counts stays where it was", _stays_without_counts,
           faults=tuple(Fault("power_cut", 150.0, 2.0, i, 0.5) for i in range(3)),
           seconds=220.0, slow=True, worlds=("calm",)),
    Defect((14,), "automatic control goes on after a loss", plant_defects.goes_on_after_a_loss,
           faults=(Fault("line_cut", 110.0, 12.0, 0, 0.5),), seconds=200.0, first=2,
           worlds=("visits",)),
    Defect((1,), "SEARCHING goes on without a sun", _search_without_sun,
           faults=tuple(Fault("cluster_crash", at, 12.0, i, 0.5)
                        for at in (70.0, 100.0, 130.0, 160.0, 190.0, 220.0) for i in range(3)),
           slow=True, worlds=("calm",)),
    Defect((10, 11), "TRACK accepted straight from stow", _ready_after_stow, pause=12.0, first=2),
    Defect((10,), "approach straight to the standby point", _straight_to_standby,
           ("line_drop",), 60.0, first=1),
    Defect((9,), "SUN sent although the table says dark", _sun_in_the_dark, ("time_jump",), 10.0),
    Defect((7,), "a brown-out record ignores steps undone", _brown_out_as_queued,
           ("brown_out",), 5.0),
    Defect((2,), "the last reading of a sensor counts for ever", _silence_unseen,
           ("sensor_silent",), 20.0, worlds=("calm", "sensors")),
    Defect((12, 16), "differing parameters hold no motion", plant_defects.differing_moves,
           ("line_drop",), 60.0, slow=True, worlds=("calm", "parameters")),
    Defect((4,), "a cluster obeys two plants", _two_plants_obeyed, ("plant_twice",), 20.0,
           worlds=("twice", "calm"), first=3),
    Defect((12,), "new parameters are not verified", plant_defects.unverified, faults=(),
           worlds=("lights",)),
    Defect((12,), "every sighting counts ten times", plant_defects.counted_often, faults=(),
           first=20, worlds=("visits",)),
    Defect((12,), "a calibration is surer than it is", plant_defects.surer_than_it_is, faults=(),
           first=5, slow=True, worlds=("visits",)),
    Defect((12, 16), "sightings with the sun of later", plant_defects.sun_of_later, faults=(),
           first=5, slow=True, worlds=("visits",)),
    Defect((12, 16), "any light on a target is the heliostat's", plant_defects.any_light, faults=(),
           first=2, slow=True, worlds=("visits",)),
    Defect((16,), "the evening's stow is skipped", plant_defects.evening_skipped, faults=(),
           first=2, slow=True, worlds=("day",)),
    *(Defect(numbers, name, defect, only, pause, first=first)
      for numbers, name, defect, only, pause, first in plant_defects.ROWS),
    *(Defect(numbers, name, defect, faults=faults, worlds=("visits",), slow=slow,
             first=first)
      for numbers, name, defect, faults, slow, first in work_defects.ROWS),
    *(Defect(numbers, name, defect, faults=faults, seconds=seconds, worlds=("days",), acts=acts,
             slow=slow, first=first)
      for numbers, name, defect, acts, faults, seconds, slow, first in day_defects.ROWS),
    *(Defect(numbers, name, defect, kinds_of(some), faults=faults_of(some), worlds=worlds,
             slow=slow, first=first)
      for numbers, name, defect, some, worlds, slow, first in review_defects.ROWS),
    *(Defect((16,), name, defect, faults=(), worlds=worlds, slow=slow, first=first)
      for name, defect, worlds, slow, first in quiet_defects.ROWS),
    *(Defect((16,), name, defect, seconds=180.0, worlds=worlds, slow=slow,
             faults=(Fault("line_cut", 40.0, 9.0, 0, 0.5),))
      for name, defect, worlds, slow in quiet_defects.REJOIN_ROWS),
    *(Defect(numbers, name, defect, only, pause, worlds=worlds, slow=slow)
      for numbers, name, defect, only, pause, worlds, slow in report_defects.ROWS),
    *(Defect((number,), name, defect, faults=faults, seconds=300.0, worlds=("limit",), first=first)
      for number, name, defect, faults, first in aim_defects.ROWS),
    *(Defect((11, 12), name, defect, faults=(), worlds=("tour",), slow=slow)
      for name, defect, slow in quiet_defects.TOUR_ROWS),
)  # fmt: skip
