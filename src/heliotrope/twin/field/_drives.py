"""Motors and gears of a whole field: from emitted steps to joint positions.

The model equals `twin.boards.motors` for one axis, except within a tick: steps take effect when
they are emitted, which on a board happens up to a tenth of a second before its timer executes them.
"""

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray

Integers = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]


class Drives:
    """Motors and joints of N heliostats with two axes each.

    Parameters
    ----------
    counts
        Initial positions, steps, (N, 2).
    play
        Backlash of the gears, steps, a number or (N, 2); see `twin.boards.motors.Axis`.
    miss
        Probability that a moving axis loses a step in a tick.
    seed
        Seed of the lost steps.

    Attributes
    ----------
    turned, joint
        Positions of motors and joints, steps, (N, 2).
    missed
        Steps lost so far, (N, 2).

    Raises
    ------
    InputError
        If the backlash is below 0, or a probability is outside 0 to 1.
    """

    def __init__(
        self, counts: Integers, play: npt.ArrayLike = 0.0, miss: float = 0.0, seed: int = 0
    ) -> None:
        self._play = np.array(np.broadcast_to(np.asarray(play, dtype=np.float64), counts.shape))
        if not (self._play >= 0.0).all() or not 0.0 <= miss <= 1.0:
            raise InputError(
                "drives: play must be 0 or more and the probability of losing a step 0 to 1, not "
                f"{self._play.min()} steps and {miss}"
            )
        self._miss = miss
        self.turned: Integers = counts.copy()
        self.joint: FloatArray = counts.astype(np.float64)
        self.missed: Integers = np.zeros_like(counts)
        self._lost: Bools = np.zeros(counts.shape, dtype=np.bool_)
        self._chance = np.random.default_rng(seed)

    def next(self) -> tuple[Integers, FloatArray, FloatArray, Bools, Integers]:
        """Return the arrays that the kernel advances in the next tick.

        This also draws which axes lose a step.
        """
        if self._miss > 0.0:
            self._lost = self._chance.random(self.turned.shape) < self._miss
        return self.turned, self.joint, self._play, self._lost, self.missed
