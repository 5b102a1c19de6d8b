"""Codes: small, linearly independent movements of many heliostats."""

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray

#: Minimum and maximum number of photographs in a stack.
_FEWEST, _MOST = 8, 1024
#: Beams with the same code are at least this many standard deviations apart, so that a matched
#: filter at the position of one beam responds to the other with less than 1 % of its height.
APART = 4.5


def photographs_for(mirrors: int, along: int | None = None) -> int:
    """Return the fewest photographs that give ``mirrors`` heliostats orthogonal codes.

    Each heliostat takes two rows of a Hadamard matrix, one per axis, or one row if all move along
    the same axis; the row of ones stays unused.
    """
    if mirrors < 1:
        raise InputError(f"codes: the number of mirrors must be 1 or more, not {mirrors}")
    rows = 2 * mirrors if along is None else mirrors
    return max(_FEWEST, 1 << rows.bit_length())


def coded_movements(
    mirrors: int, photographs: int | None = None, along: int | None = None
) -> FloatArray:
    """Return the heliostats' movements, -1 or 1, (photographs, heliostats, 2).

    The columns are rows of Sylvester's Hadamard matrix without the row of ones, and are therefore
    zero-mean and mutually orthogonal. If a beam moves along both axes at once, its light also
    changes with the product of its two codes, which is itself a row of the matrix. The rows are
    chosen so that this product is the same unused row for all heliostats. The photographs are
    shuffled, always in the same order.

    Parameters
    ----------
    mirrors
        Number of heliostats.
    photographs
        Number of photographs, a power of two; None for the result of `photographs_for`.
    along
        The single axis of all movements, 0 or 1; None for both axes.

    Raises
    ------
    InputError
        If there are too few photographs for orthogonal codes, or their number is not a power of
        two.
    """
    from scipy.linalg import hadamard

    least = photographs_for(mirrors, along)
    count = least if photographs is None else photographs
    if count < least or count > _MOST or count & (count - 1):
        raise InputError(
            f"codes: {count} photographs for {mirrors} mirrors; use a power of two from {least} "
            f"to {_MOST}"
        )
    # Neighbouring photographs differ in all codes, so that a cloud during a few of them, or a slow
    # drift, resembles none of the codes.
    order = np.random.default_rng(count).permutation(count)
    rows = hadamard(count).astype(np.float64)[:, order]
    first = 1 + np.arange(mirrors)
    if along is not None:
        moves = np.zeros((count, mirrors, 2))
        moves[..., along] = rows[first].T
        return moves
    # For every j, the product of rows j and j + count/2 is the same row, count/2.
    return np.ascontiguousarray(
        np.stack([rows[first], rows[first + count // 2]], axis=-1).transpose(1, 0, 2)
    )


def shared_codes(
    places: npt.ArrayLike, moments: npt.ArrayLike, groups: int, apart: float = APART
) -> npt.NDArray[np.intp] | None:
    """Return the code of each beam, (M,); beams that share a code are far apart.

    Parameters
    ----------
    places
        Expected positions, m, (M, 2).
    moments
        Second moments of the beams including the covariances of their positions, m², (M, 2, 2).
    groups
        Number of codes.
    apart
        Minimum distance between two beams with the same code, in standard deviations of a beam.

    Returns
    -------
        Index of the code of each beam; None if no code is available for one of the beams.
    """
    at, spread = np.asarray(places, dtype=np.float64), np.asarray(moments, dtype=np.float64)
    away = distances(at, spread)
    codes = np.full(len(at), -1, dtype=np.intp)
    for i in range(len(at)):
        near = set(codes[:i][away[i, :i] < apart].tolist())
        free = [code for code in range(groups) if code not in near]
        if not free:
            return None
        # Choose the least-used code, so that light and noise are spread over all codes.
        codes[i] = min(free, key=lambda code: int((codes[:i] == code).sum()))
    return codes


def distances(places: FloatArray, moments: FloatArray) -> FloatArray:
    """Return distances (M, M) between places, in standard deviations of the wider beam."""
    between = places[:, None] - places
    own = np.einsum("ijk,ikl,ijl->ij", between, np.linalg.inv(moments), between)
    return np.asarray(np.sqrt(np.minimum(own, own.T)))
