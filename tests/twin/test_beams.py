"""What the observers of beams and of work expect of a mirror that turns to its point."""

import numpy as np
import pytest

from heliotrope.geometry import normalize
from heliotrope.lcu import states
from heliotrope.links.messages import Command
from heliotrope.mechanism.tracking import track
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.outfit import LIMITS, RECEIVER, outfits
from heliotrope.twin.invariants.beams import NAMED_WITHIN, SETTLE, BeamObserver
from heliotrope.twin.invariants.invariants import InvariantError, Observer
from heliotrope.twin.invariants.quiet import ON_POINT_WITHIN, QuietObserver

#: A low sun, nearly opposite to a tower in the south: the mirror looks near the zenith.
SUN = normalize(np.array([0.1, 0.98, 0.16]), "sun")
PLACE = (0.0, 100.0)


def standing(turned: float) -> Board:
    """Return a mirror that tracks and stands some steps of azimuth beside its aim."""
    board = Board(outfits(1, 3, [PLACE])[0])
    board.power_on(0.0)
    aimed = track(board.outfit.mechanism, SUN, RECEIVER).best_counts
    for axis, count in zip(board.axes, aimed + np.array([turned, 0.0]), strict=True):
        axis.turned = axis.emitted = round(count)
        axis.joint = float(axis.turned)
    assert board.node is not None
    board.node.controller.state = states.TRACKING
    return board


def last_look(turned: float, until: float) -> float:
    """Look at such a mirror; return when."""
    board = standing(turned)
    observer = BeamObserver(0.0, {"C1": [board]}, lambda now: SUN, (), held=False)
    for message in (Command("a", "AIM", RECEIVER), Command("t", "TRACK")):
        observer.sent(message, ("H01",), 0.0)
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
