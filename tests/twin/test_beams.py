"""What the observer of beams expects of a mirror that turns to its point."""

import numpy as np
import pytest

from heliotrope.geometry import normalize
from heliotrope.lcu import states
from heliotrope.links.messages import Command
from heliotrope.mechanism.tracking import track
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.outfit import LIMITS, RECEIVER, outfits
from heliotrope.twin.invariants.beams import NAMED_WITHIN, SETTLE, BeamObserver
from heliotrope.twin.invariants.invariants import InvariantError

#: A low sun, nearly opposite to a tower in the south: the mirror looks near the zenith.
SUN = normalize(np.array([0.1, 0.98, 0.16]), "sun")
PLACE = (0.0, 100.0)


def last_look(turned: float, until: float) -> float:
    """Look at a mirror that tracks and stands some steps of azimuth beside its aim; return when."""
    board = Board(outfits(1, 3, [PLACE])[0])
    board.power_on(0.0)
    aimed = track(board.outfit.mechanism, SUN, RECEIVER).best_counts
    for axis, count in zip(board.axes, aimed + np.array([turned, 0.0]), strict=True):
        axis.turned = axis.emitted = round(count)
        axis.joint = float(axis.turned)
    assert board.node is not None
    board.node.controller.state = states.TRACKING
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
