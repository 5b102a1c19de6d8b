"""The flux up to which a receiver may be heated, cell by cell, along an allowed ramp."""

import math

import numpy as np

from heliotrope.geometry import FloatArray, as_float

#: A cell may return to a flux at once if it had that flux within this time, s.
WARM = 60.0


class Heating:
    r"""Follows the flux of a receiver's cells, and says how far they may be heated now.

    The allowed flux rises at the rate of the ramp, whether or not the heliostats have followed yet,
    but never further above the flux that the cell has had than the rise of one window. A late
    heliostat therefore does not delay those after it, and no backlog of allowed flux builds up
    while few can come. With the greatest flux W of the last minute, the rate r and the window T,

    $$R(t) = \min(R(t') + r (t - t'), W(t) + r T)$$

    where t' is the time of the last call. At first, and after a cloud, R is r T above W.

    Parameters
    ----------
    rate
        Greatest rise of the flux in a cell, W/m² per s.
    window
        Time whose rise may come at once, s.
    """

    def __init__(self, rate: float, window: float) -> None:
        self._rate, self._window = rate, window
        self._had: list[tuple[float, FloatArray]] = []
        self._line: tuple[float, FloatArray] | None = None

    @property
    def known(self) -> bool:
        """Whether any flux of the cells has been noted."""
        return bool(self._had)

    def note(self, at: float, flux: FloatArray) -> None:
        """Note the flux of the cells at a time, s, W/m², in the irradiance of that time."""
        self._had = [(then, had) for then, had in self._had if at - then <= WARM]
        self._had.append((at, flux))

    def allowed(
        self, now: float, shape: tuple[int, int], remaining: float = math.inf
    ) -> FloatArray:
        """Return the flux up to which the cells may be heated now, W/m², (rows, columns).

        ``remaining``: time until the field is stowed, s; the flux falls to 0 until then, along the
        same ramp.
        """
        had = [flux for at, flux in self._had if now - at <= WARM]
        warm = as_float(np.max(had, axis=0)) if had else np.zeros(shape)
        line = warm + self._rate * self._window
        if self._line is not None:
            then, before = self._line
            line = np.maximum(np.minimum(before + self._rate * (now - then), line), warm)
        self._line = now, as_float(line)
        return as_float(np.minimum(line, self._rate * max(remaining, 0.0)))
