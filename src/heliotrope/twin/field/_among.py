"""Fast membership tests for small integer codes, using a lookup table."""

from functools import lru_cache

import numpy as np
import numpy.typing as npt

Bools = npt.NDArray[np.bool_]


@lru_cache(maxsize=64)
def _table(members: tuple[int, ...]) -> Bools:
    """Return a table that says for each code whether it is a member.

    The last entry represents -1, no power.
    """
    table = np.zeros(16, dtype=np.bool_)
    table[list(members)] = True
    return table


def among(codes: npt.NDArray[np.int8], *members: int) -> Bools:
    """Return which codes (-1 to 14) are among the members (0 to 14), in the shape of the codes.

    The result equals that of ``np.isin``, which takes twenty times as long for a single heliostat.
    """
    return np.asarray(_table(members)[codes])
