"""The way back to stow at a low sun, on a board's core and in the vectorised field."""

from types import SimpleNamespace

import numpy as np
import pytest

from heliotrope.geometry import normalize
from heliotrope.lcu import states
from heliotrope.lcu.lease import UNIT
from heliotrope.lcu.motion import DEFOCUS
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.outfit import CAUSES, MACHINE, RECEIVER, STOW, Outfit, outfits
from heliotrope.twin.field.field import Field
from heliotrope.twin.invariants.invariants import CROSSING, OFF

#: A sun 8° high, opposite to the tower, and a mirror that has turned away there (run 930349).
SUN = normalize(np.array([-0.901, 0.412, 0.139]), "sun")
OUTFITS = [outfits(1, 3, [place])[0] for place in ((-80.0, 36.0), (-90.0, 41.0), (-100.0, 46.0))]
#: Step counts of a mirror that has turned away from standby.
AWAY = (340_316, 97_146)
STEP = 0.05


class Core:
    """The motion of a local controller under a sun that stands still."""

    def __init__(self, outfit: Outfit) -> None:
        board = Board(outfit)
        board.power_on(0.0)
        assert board.node is not None
        self.motion = motion = board.node.controller.motion
        motion.declare(*AWAY, True)
        motion.kind, motion.ready = DEFOCUS, True
        vector = tuple(np.round(SUN * UNIT) / UNIT)
        motion.sun = SimpleNamespace(fresh=lambda: True, vector=lambda ahead: vector)  # type: ignore[assignment]
        motion.stow()

    @property
    def counts(self) -> list[int]:
        return [self.motion.place(0), self.motion.place(1)]

    def tick(self) -> None:
        if self.motion.tick(50) == "UNREACHABLE":
            self.motion.stow_directly()
        assert self.motion.stepper is not None
        self.motion.stepper.advance(50, [], 0)


def miss(outfit: Outfit, counts: list[int]) -> float:
    """Distance of the beam from the middle of the receiver, m."""
    pose = outfit.mechanism.pose(counts)
    beam = 2.0 * (pose.normal @ SUN) * pose.normal - SUN
    return float(np.linalg.norm(np.cross(RECEIVER - pose.vertex, beam)))


@pytest.mark.parametrize("outfit", OUTFITS)
def test_the_way_back_crosses_no_receiver_slowly_in_the_keyhole(outfit: Outfit) -> None:
    core, longest, on = Core(outfit), 0.0, 0.0
    for _ in range(2500):
        core.tick()
        on = on + STEP if miss(outfit, core.counts) <= OFF else 0.0
        longest = max(longest, on)
    assert core.counts == list(STOW)
    assert longest <= CROSSING


def test_the_vectorised_field_comes_back_by_the_same_steps() -> None:
    outfit = OUTFITS[0]
    core = Core(outfit)
    causes = {name: np.array([outfit.causes[name]]) for name in CAUSES}
    field = Field(outfit.with_causes({})[None].with_parameters(causes), MACHINE)
    for name in ("count", "goal", "leg"):
        field.axes[name] = AWAY
    field.state[:], field.kind[:], field._ready[:] = states.DEFOCUSED, DEFOCUS, True
    east, north, up = (round(part * UNIT) for part in SUN)
    for second in range(125):
        field.take_sun((second, east, north, up, 0, 0, 0))
        if second == 0:
            field.order("STOW")
        for _ in range(20):
            core.tick()
            field.advance(50)
            assert field.axes["count"][0].tolist() == core.counts
    assert field.state[0] == states.STOWED
