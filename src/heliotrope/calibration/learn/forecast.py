"""Forecast: where a learnt heliostat will send its beam, and with what uncertainty."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.frames import ACROSS, ENU, Framed, Labelled, Variable
from heliotrope.frames import times as as_times
from heliotrope.geometry import FloatArray
from heliotrope.optics.beam import ExpectedError
from heliotrope.values import Card, Value, span


@dataclass(frozen=True, eq=False, repr=False)
class Forecast(Value, Framed):
    """Expected beams of one heliostat at T times.

    Attributes
    ----------
    heliostat
        Name or index.
    time
        Unix seconds (UTC), (T,).
    sun
        Unit vectors to the apparent sun, ENU, (T, 3).
    aim
        ENU metres, (3,).
    counts
        Commanded drive counts, (T, D).
    error
        Expected beam error to the right of and above the aim as seen from the mirror, rad, (T, 2).
    covariance
        Covariance of the error as a sighting would measure it: parameters, drift and noise, rad²,
        (T, 2, 2).
    reachable
        Whether the sun is up and the aim within reach, (T,). Where it is false, all other values
        are NaN.
    """

    heliostat: str
    time: FloatArray
    sun: FloatArray
    aim: FloatArray
    counts: FloatArray
    error: FloatArray
    covariance: FloatArray
    reachable: npt.NDArray[np.bool_]

    @property
    def beam(self) -> FloatArray:
        """Magnitude of the expected error, rad, (T,)."""
        return np.asarray(np.linalg.norm(self.error, axis=-1))

    @property
    def rms(self) -> FloatArray:
        """Two-dimensional root mean square of the error, including its uncertainty, rad, (T,)."""
        spread = np.trace(self.covariance, axis1=-2, axis2=-1)
        return np.asarray(np.sqrt(self.beam**2 + spread))

    @property
    def ellipse(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The 90 % ellipse about the expected error; see `ExpectedError.ellipse`."""
        return ExpectedError(self.covariance, self.reachable).ellipse

    def _card(self) -> Card:
        many = f"{len(self.time)} times, {int(self.reachable.sum())} within reach"
        long, short, _ = self.ellipse
        rows = [
            ("expected error", span(self.beam, 1e3, "mrad")),
            ("RMS with uncertainty", span(self.rms, 1e3, "mrad")),
            ("90 % ellipse, longer", span(long, 1e3, "mrad")),
            ("90 % ellipse, shorter", span(short, 1e3, "mrad")),
        ]
        return Card(f"{self.heliostat}, {many}", ("beam", "range"), rows)

    def _labelled(self) -> Labelled:
        row, (long, short, angle) = ("time",), self.ellipse
        return Labelled(
            row,
            {
                "time": as_times(self.time),
                "across": ACROSS,
                "across_2": ACROSS,
                "axis": ENU,
                "drive": np.arange(1, self.counts.shape[-1] + 1),
            },
            {
                "error": Variable((*row, "across"), self.error, "rad"),
                "rms": Variable(row, self.rms, "rad"),
                "ellipse_long": Variable(row, long, "rad"),
                "ellipse_short": Variable(row, short, "rad"),
                "ellipse_angle": Variable(row, angle, "rad"),
                "covariance": Variable((*row, "across", "across_2"), self.covariance, "rad2"),
                "count": Variable((*row, "drive"), self.counts),
                "sun": Variable((*row, "axis"), self.sun),
                "reachable": Variable(row, self.reachable),
            },
            notes={"heliostat": self.heliostat},
        )
