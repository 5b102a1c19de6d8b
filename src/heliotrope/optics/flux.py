"""A map of the flux on a receiver, with its power and the intercept."""

from dataclasses import dataclass

from heliotrope.frames import Framed, Labelled, Variable
from heliotrope.geometry import FloatArray
from heliotrope.values import Card, Value, amount, span


@dataclass(frozen=True, eq=False, repr=False)
class FluxView(Value, Framed):
    """The flux on a receiver.

    Attributes
    ----------
    receiver
        Name.
    right, up
        Centres of the cells, m from the centre of the aperture as seen from the field, (W,), (H,).
    flux
        W/m², (H, W), lowest row first.
    power
        Power into the aperture, W.
    intercept
        Fraction of the reflected light that enters the aperture; NaN without beams.
    heliostats
        Number of beams counted.
    """

    receiver: str
    right: FloatArray
    up: FloatArray
    flux: FloatArray
    power: float
    intercept: float
    heliostats: int

    def _card(self) -> Card:
        line = f"{amount(self.heliostats, 'beam')} on {self.receiver}, {1e-3 * self.power:.4g} kW, "
        line += f"intercept {100 * self.intercept:.3g} %, "
        return Card(f"{line}{span(self.flux, 1e-3, 'kW/m²')} in {self.flux.shape} cells")

    def _labelled(self) -> Labelled:
        rows = ("up", "right")
        variables = {
            "flux": Variable(rows, self.flux, "W/m²"),
            "power": Variable((), self.power, "W"),
            "intercept": Variable((), self.intercept),
            "heliostats": Variable((), self.heliostats),
        }
        notes = {"receiver": self.receiver, "cells": "centres, m from the centre of the aperture"}
        return Labelled(rows, {"up": self.up, "right": self.right}, variables, notes=notes)
