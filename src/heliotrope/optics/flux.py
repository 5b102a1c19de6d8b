r"""The expected flux of a field on a receiver: flux map, power and intercept.

A beam is a Gaussian about its aim; its width follows from the sun, the mirror and the mirror's
calibration (`beam_sigma`). In the plane perpendicular to the ray it is circular. On the aperture,
which the ray with components $d_r, d_u$ meets at an angle with cosine c, its variances are

$$σ_r^2 = σ^2 (1 + (d_r / c)^2), \qquad σ_u^2 = σ^2 (1 + (d_u / c)^2),$$

and the correlation between the two axes is neglected. The fraction in each cell is then a product,
and the map of a field of 10,000 beams is a single product of two matrices. The power of a beam is

$$P = A \, E \, ρ \, \sqrt{(1 + s·t)/2} \, (1 - l(d)),$$

with the loss l of `air_loss` in clear air. `predict_flux` lists what is neglected.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.target import Receiver
from heliotrope.frames import Framed, Labelled, Variable
from heliotrope.geometry import FloatArray, as_float, as_vectors, normalize
from heliotrope.optics.attenuation import air_loss
from heliotrope.optics.beam import beam_sigma
from heliotrope.optics.intercept import intercept_rectangle
from heliotrope.values import Card, Value, amount, span

#: Default number of cells, horizontally and vertically.
CELLS = (24, 24)
#: Width of the map over that of the aperture, so that it shows the spillage too.
MARGIN = 1.5


@dataclass(frozen=True, eq=False, repr=False)
class FluxView(Value, Framed):
    """The predicted flux on a receiver.

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
        notes = {"receiver": self.receiver, "cells": "centres, m from that of the aperture"}
        return Labelled(rows, {"up": self.up, "right": self.right}, variables, notes=notes)


def predict_flux(
    receiver: Receiver,
    vertices: npt.ArrayLike,
    aims: npt.ArrayLike,
    areas: npt.ArrayLike,
    error: npt.ArrayLike,
    *,
    sun: npt.ArrayLike,
    dni: float = 900.0,
    reflectivity: float = 0.9,
    slope: float = 1e-3,
    cells: tuple[int, int] = CELLS,
) -> FluxView:
    """Return the flux of N beams on a receiver; neglects shading, blocking, canting, curvature.

    Parameters
    ----------
    receiver
        The receiver; its aperture is treated as a flat rectangle of its width and height, whatever
        its kind.
    vertices, aims
        Mirror vertices and aim points, ENU, m, (N, 3).
    areas
        Mirror areas, m², (N,).
    error
        Two-dimensional standard deviation of the normals, rad, (N,).
    sun
        Unit vector, (3,).
    dni
        W/m².
    reflectivity
        0 to 1.
    slope
        Standard deviation of the mirror surface slope per axis, rad.
    cells
        Number of cells, horizontally and vertically.

    Raises
    ------
    InputError
        If shapes do not fit or a number is out of range.

    Notes
    -----
    The following effects are neglected:

    - **shading and blocking** by neighbours and by the tower: every mirror counts in full, so the
      power is too high;
    - **canting, focus and size** of the mirrors: each mirror is assumed to be focused on its aim
      without astigmatism, so the beams are too narrow where it is not;
    - **curved receivers**: the map is that of the aperture plane, not of the surface behind it, and
      beams that meet this plane from behind or within 3° of it do not count, so an external
      cylinder receives light from one side only;
    - the limb darkening of the sun, and reflection by the receiver.
    """
    places = as_vectors(np.reshape(as_float(vertices), (-1, 3)), "vertices")
    points = as_vectors(np.reshape(as_float(aims), (-1, 3)), "aims")
    area, sigma = as_float(areas).reshape(-1), as_float(error).reshape(-1)
    if not len(places) == len(points) == len(area) == len(sigma):
        raise InputError(
            f"flux: {len(places)} vertices, {len(points)} aims, {len(area)} areas and "
            f"{len(sigma)} errors; give the same number of each"
        )
    if not (np.isfinite(dni) and dni >= 0.0 and 0.0 <= reflectivity <= 1.0):
        raise InputError(
            f"flux: {dni} W/m² must be 0 or more and the reflectivity {reflectivity} from 0 to 1"
        )
    if min(cells) < 1:
        raise InputError(f"flux: cells {cells}; give at least 1 across and up")
    light = as_vectors(sun, "sun")
    right, up, normal = _axes(receiver)
    size = np.array([receiver.width, receiver.height], dtype=np.float64)
    edges = [
        0.5 * MARGIN * s * np.linspace(-1.0, 1.0, n + 1) for s, n in zip(size, cells, strict=True)
    ]
    middle = [0.5 * (e[1:] + e[:-1]) for e in edges]
    path = points - places
    slant = np.linalg.norm(path, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        ray = path / slant[:, None]
    cosine = -(ray @ normal)
    # Beams from behind, or nearly along the plane, do not enter the aperture.
    good = np.isfinite(cosine) & (cosine > 0.05) & (light[2] > 0.0)
    ray, slant, cosine = ray[good], slant[good], cosine[good]
    narrow = beam_sigma(np.maximum(slant, 1e-3), tracking=sigma[good] / np.sqrt(2.0), slope=slope)
    power = area[good] * dni * reflectivity * np.sqrt(np.maximum(0.0, 0.5 * (1.0 + ray @ light)))
    power = power * (1.0 - air_loss(slant))
    off = points[good] - receiver.center
    wide = [narrow * np.sqrt(1.0 + ((ray @ axis) / cosine) ** 2) for axis in (right, up)]
    at = [off @ axis for axis in (right, up)]
    shares = [
        np.diff(_below((edge - center[:, None]) / width[:, None]), axis=-1)
        for edge, center, width in zip(edges, at, wide, strict=True)
    ]
    inside = intercept_rectangle(
        receiver.width, receiver.height, wide[0], sigma_up=wide[1], right=at[0], up=at[1]
    )
    flux = (shares[1] * power[:, None]).T @ shares[0]
    cell = (edges[0][1] - edges[0][0]) * (edges[1][1] - edges[1][0])
    total, caught = float(power.sum()), float(power @ inside)
    return FluxView(
        receiver.name,
        middle[0],
        middle[1],
        flux / cell,
        caught,
        caught / total if total > 0.0 else float("nan"),
        len(power),
    )


def _axes(receiver: Receiver) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return right (as seen from the front), up, and the normal of the aperture."""
    normal = normalize(receiver.normal)
    level = np.cross(np.array([0.0, 0.0, 1.0]), normal)
    if np.linalg.norm(level) < 1e-6:
        # For an aperture that faces straight down or up, right is east.
        level = np.array([1.0, 0.0, 0.0])
    right = normalize(level)
    return right, np.asarray(np.cross(normal, right)), normal


def _below(z: FloatArray) -> FloatArray:
    """Return the share of a normal distribution below z, in single precision: plenty for a map."""
    from scipy import special

    return np.asarray(special.ndtr(z.astype(np.float32)), dtype=np.float64)
