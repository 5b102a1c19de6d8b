"""What the observers of beams and of work expect of a mirror that turns to its point."""

from dataclasses import replace

import numpy as np
import pytest

from heliotrope.geometry import normalize
from heliotrope.lcu import states
from heliotrope.links.messages import NODE, ClusterStatus, Command
from heliotrope.mechanism.tracking import track
from heliotrope.safety import alarms
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.outfit import LIMITS, RECEIVER, outfits
from heliotrope.twin.invariants.beams import (
    LOST_TOGETHER,
    NAMED_WITHIN,
    OFF_WITHIN,
    SETTLE,
    BeamObserver,
)
from heliotrope.twin.invariants.invariants import (
    DEFOCUS_WITHIN,
    STOW_WITHIN,
    InvariantError,
    Observer,
)
from heliotrope.twin.invariants.quiet import ON_POINT_WITHIN, QuietObserver

#: A low sun, nearly opposite to a tower in the south: the mirror looks near the zenith.
SUN = normalize(np.array([0.1, 0.98, 0.16]), "sun")
PLACE = (0.0, 100.0)
NAMES = ("H01", "H02", "H03")


def standing(turned: float, name: str = "H01") -> Board:
    """Return a mirror that tracks and stands some steps of azimuth beside its aim."""
    board = Board(replace(outfits(1, 3, [PLACE])[0], name=name))
    board.power_on(0.0)
    aimed = track(board.outfit.mechanism, SUN, RECEIVER).best_counts
    for axis, count in zip(board.axes, aimed + np.array([turned, 0.0]), strict=True):
        axis.turned = axis.emitted = round(count)
        axis.joint = float(axis.turned)
    assert board.node is not None
    board.node.controller.state = states.TRACKING
    return board


def last_look(turned: float, until: float, unsurveyed: tuple[str, ...] = ()) -> float:
    """Look at such a mirror; return when."""
    board = standing(turned)
    observer = BeamObserver(0.0, {"C1": [board]}, lambda now: SUN, (), None, unsurveyed)
    for message in (Command("a", "AIM", RECEIVER), Command("t", "TRACK")):
        observer.on_command(message, ("H01",), 0.0)
    observer.resumed(("H01",), "TRACK", 0.0)
    now = 0.0
    while now < until:
        now += 0.5
        observer.look(None, {"C1"}, now)
    return now


@pytest.mark.parametrize("turned", [6_000.0, -60_000.0, 290_000.0])
def test_a_beam_is_astray_once_its_drives_could_have_brought_it(turned: float) -> None:
    needs = abs(turned) / LIMITS[0]
    last_look(turned, SETTLE + NAMED_WITHIN + needs)
    with pytest.raises(InvariantError, match=r"H01: TRACKING, its beam .* and no alarm names it"):
        last_look(turned, SETTLE + NAMED_WITHIN + needs + 2.0)


def test_a_beam_of_which_the_plant_file_is_wrong_is_astray_once_that_does_not_explain_it() -> None:
    until = SETTLE + NAMED_WITHIN + 60_000.0 / LIMITS[0] + 2.0
    assert (
        2.0 < standing(6_000.0).miss(SUN, RECEIVER) < 8.0 < standing(60_000.0).miss(SUN, RECEIVER)
    )
    last_look(6_000.0, until, ("H01",))
    for turned, unsurveyed in ((6_000.0, ()), (60_000.0, ("H01",))):
        with pytest.raises(InvariantError, match=r"H01: TRACKING, its beam .* and no alarm"):
            last_look(turned, until, unsurveyed)


def rests_in_doubt(ends_at: float, named_again_at: float, until: float) -> None:
    """Look at a mirror in doubt about its counts, beside its standby point, over a new program."""
    board = standing(0.0)
    assert board.node is not None
    board.node.controller.state = states.APPROACHING
    observer = BeamObserver(0.0, {"C1": [board]}, lambda now: SUN, ())
    observer.on_command(Command("s", "STANDBY", (60.0, 0.0, 40.0)), ("H01",), 0.0)
    observer.on_command(Command("a", "APPROACH"), ("H01",), 0.0)
    for axis in board.axes:
        axis.turned, axis.joint = axis.turned - 60_000, axis.joint - 60_000.0
    for half in range(round(2.0 * until)):
        now = 0.5 * half
        if now == 1.0:
            board.node.controller.state = states.IDLE
        if now in (5.0, named_again_at):
            observer.on_alarm(alarms.COUNTS_DOUBTFUL.raised("H01"), now)
        if now == ends_at:
            observer.on_end(now)
        observer.look(None, {"C1"}, now)


def test_a_doubt_must_be_named_anew_by_a_new_program() -> None:
    """Simulated run 2700083: the program ended with the doubt, and 30 s were over at once."""
    rests_in_doubt(80.0, 83.0, 200.0)
    with pytest.raises(InvariantError, match=r"H01: IDLE, its beam .* m from where it was sent"):
        rests_in_doubt(80.0, 1e3, 200.0)


def last_quiet_look(turned: float, until: float) -> None:
    """Look at such a mirror in a quiet stretch, from when its beam must be on its point."""
    board = standing(turned)
    clusters = {"C1": Observer([board], 0.0, lambda now: SUN)}
    observer = QuietObserver(0.0, clusters, lambda now: SUN, reaches=True)
    (mirror,) = observer._mirrors.values()
    mirror.state, mirror.aim = states.TRACKING, RECEIVER
    now = ON_POINT_WITHIN + 1.0
    while now < ON_POINT_WITHIN + 1.0 + until:
        observer._on_point(mirror, SUN, now)
        now += 0.5


@pytest.mark.parametrize("turned", [6_000.0, -60_000.0, 290_000.0])
def test_work_is_late_once_its_drives_could_have_done_it(turned: float) -> None:
    """Simulated runs 960059 and 960330: a turn of more than half a circle across the keyhole."""
    needs = abs(turned) / LIMITS[0]
    last_quiet_look(0.0, 100.0)
    last_quiet_look(turned, needs)
    with pytest.raises(InvariantError, match=r"H01: TRACKING in a quiet stretch: its beam is .* m"):
        last_quiet_look(turned, needs + 2.0)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize(
    "state", [states.LOCKED, states.UNCONFIGURED, states.FAULT, states.IDLE, states.STOWED]
)
def test_a_beam_that_nobody_sent_leaves_the_receiver_in_every_state(
    state: int, *, known: bool
) -> None:
    board = standing(0.0)
    assert board.node is not None
    controller = board.node.controller
    controller.state, controller.motion.known = state, known
    observer = BeamObserver(0.0, {"C1": [board]}, lambda now: SUN, ())
    for now in np.arange(0.0, OFF_WITHIN + 1.0):
        observer.look(None, {"C1"}, float(now))
    with pytest.raises(InvariantError, match=f"{states.STATES[state]}, its beam on the receiver"):
        observer.look(None, {"C1"}, OFF_WITHIN + 1.0)


def test_a_mirror_without_step_counts_leaves_too_when_it_is_cut_off() -> None:
    def cut_off(known: bool, turned: float, until: float) -> None:
        board = standing(turned)
        assert board.node is not None
        board.node.controller.state, board.node.controller.motion.known = states.FAULT, known
        if not known:
            board.slip[0] = 60_000  # what it counts tells nothing of its pose
        observer = Observer([board], 0.0, lambda now: SUN)
        for now in np.arange(0.0, until, 0.5):
            observer._due(observer.accounts[0], SUN, float(now), leased=True)

    for known in (True, False):
        cut_off(known, 0.0, DEFOCUS_WITHIN)
        cut_off(known, 60_000.0, DEFOCUS_WITHIN + 10.0)
        with pytest.raises(InvariantError, match=r"FAULT .* s after it was cut off, its beam"):
            cut_off(known, 0.0, DEFOCUS_WITHIN + 10.0)
    # Nobody can find stow without step counts.
    cut_off(False, 60_000.0, STOW_WITHIN + 10.0)
    with pytest.raises(InvariantError, match="stow is"):
        cut_off(True, 60_000.0, STOW_WITHIN + 10.0)


class Scene:
    """Mirrors on the receiver, and reports of them to the plant."""

    def __init__(self, losses: int | None) -> None:
        self.boards = [standing(0.0, name) for name in NAMES]
        self.observer = BeamObserver(0.0, {"C1": self.boards}, lambda now: SUN, (), losses)
        self.now = 0.0
        for message in (Command("a", "AIM", RECEIVER), Command("t", "TRACK")):
            self.observer.on_command(message, NAMES, 0.0)
        self.observer.resumed(NAMES, "TRACK", 0.0)
        self.observer.given(NAMES, 0.0)
        self.passes(20.0)

    def passes(self, seconds: float) -> None:
        """Let time pass, with two looks and a report in each second."""
        block = np.zeros(len(NAMES), NODE).tobytes()
        status = ClusterStatus("C1", len(NAMES), 0.0, "", 0.0, 3.0, 0.1, block=block)
        until = self.now + seconds
        while self.now < until:
            self.now += 0.5
            self.observer.look(None, {"C1"}, self.now)
            if self.now % 1.0 == 0.0:
                self.observer.on_status(status, NAMES, self.now)

    def enter(self, state: int, *which: int) -> None:
        """Let mirrors enter a state, TRACKING by a command."""
        if state == states.TRACKING:
            self.observer.on_command(Command("t", "TRACK"), [NAMES[i] for i in which], self.now)
        for i in which:
            node = self.boards[i].node
            assert node is not None
            node.controller.state = state
        self.passes(1.0)


def test_after_a_loss_of_more_than_may_be_lost_no_mirror_returns_without_a_person() -> None:
    scene = Scene(losses=1)
    scene.enter(states.DEFOCUSED, 0)
    scene.passes(LOST_TOGETHER - 3.0)
    scene.enter(states.DEFOCUSED, 1)
    scene.passes(7.0)
    assert scene.observer.losses == 1
    with pytest.raises(InvariantError, match=r"H01: TRACKING .* after the loss of the field"):
        scene.enter(states.TRACKING, 0)
    scene.enter(states.DEFOCUSED, 0)
    scene.observer.released(scene.now)
    scene.enter(states.TRACKING, 0)


def test_what_may_be_lost_may_return() -> None:
    for losses, lost in ((1, (0,)), (2, (0, 1))):
        scene = Scene(losses)
        scene.enter(states.DEFOCUSED, *lost)
        scene.passes(10.0)
        assert scene.observer.losses == 0
        scene.enter(states.TRACKING, *lost)


@pytest.mark.parametrize("excuse", ["ordered", "taken", "resumed meanwhile", "locked", "apart"])
def test_automatic_control_need_not_wait(excuse: str) -> None:
    scene = Scene(losses=1)
    if excuse == "ordered":
        scene.observer.on_emergency("DEFOCUS", NAMES, scene.now)
    elif excuse == "taken":
        scene.observer.taken(NAMES)
    scene.enter(states.LOCKED if excuse == "locked" else states.DEFOCUSED, 0)
    if excuse == "apart":
        scene.passes(LOST_TOGETHER + 2.0)
        scene.enter(states.TRACKING, 0)
    scene.enter(states.LOCKED if excuse == "locked" else states.DEFOCUSED, 1)
    if excuse == "resumed meanwhile":
        scene.observer.released(scene.now)
    scene.passes(8.0)
    assert scene.observer.losses == 0
    scene.enter(states.TRACKING, 0, 1)


def test_where_only_persons_command_a_lost_mirror_stays_away_until_one_does() -> None:
    scene = Scene(losses=None)
    scene.enter(states.DEFOCUSED, 0)
    scene.passes(5.0)
    with pytest.raises(InvariantError, match=r"H01: TRACKING .* after the loss of this mirror"):
        scene.enter(states.TRACKING, 0)
    scene.enter(states.DEFOCUSED, 0)
    scene.observer.resumed(NAMES[:1], "REFOCUS", scene.now)
    scene.enter(states.TRACKING, 0)
