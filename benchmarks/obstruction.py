"""Centroids that neighbours move: predicted by the geometry, and read in rendered photographs.

Mirrors with four canted and curved facets stand in rows before a tower. One throws its beam on the
target, the others look at the receiver above it. Each beam is rendered twice, with neighbours
and without, and both photographs are read as a plant reads them.
"""

from dataclasses import dataclass

import numpy as np

from benchmarks._run import Result, Row
from heliotrope.field.target import Target
from heliotrope.geometry import bisector, direction, normalize
from heliotrope.imaging.photograph import read_photograph
from heliotrope.imaging.synthetic.rendering import (
    Scene,
    Thrown,
    example_camera,
    example_target,
    exposed,
    render,
)
from heliotrope.optics import Beam, Mirrors, centroid_shift, equal_facets, reflected_beam

#: Size of the mirrors and distances of their feet across and along the rows, m.
WIDTH, HEIGHT, ACROSS, ALONG = 3.2, 2.6, 4.5, 5.5
#: Height of the target's middle and of the receiver's, m.
TARGET, RECEIVER = 30.0, 60.0
#: Largest hidden share of a mirror that the schedule sends to a target.
MOST = 0.35
#: Sun's elevations, °; bearings and distances of the mirrors, ° and m.
SUNS = (16.0, 22.0, 30.0, 40.0, 55.0)
BEARINGS, DISTANCES = (0.0, 25.0, 50.0), (70.0, 120.0, 180.0)


@dataclass(frozen=True)
class Case:
    """One mirror under one sun, with its neighbours."""

    target: Target
    center: np.ndarray
    sun: np.ndarray
    neighbours: Mirrors

    def beam(self, *, alone: bool) -> Beam:
        """Return the beam without or with its neighbours."""
        beside = None if alone else self.neighbours
        return reflected_beam(
            self.target,
            self.center,
            self.sun,
            WIDTH,
            HEIGHT,
            neighbours=beside,
            step=0.04,
            elements=32,
        )


def cases() -> list[Case]:
    """Return mirrors under suns, whether anything hides them or not."""
    target = example_target(center=(0.0, 0.0, TARGET))
    receiver = np.array([0.0, 0.0, RECEIVER])
    lattice = [(i, j) for i in (-2, -1, 0, 1, 2) for j in (-2, -1, 0, 1, 2) if (i, j) != (0, 0)]
    found = []
    for k, elevation in enumerate(SUNS):
        for bearing in BEARINGS:
            for away in DISTANCES:
                sun = direction(np.radians(120.0 + 30.0 * k), np.radians(elevation))
                out = direction(np.radians(bearing), 0.0)
                side = np.array([out[1], -out[0], 0.0])
                center = away * out + [0.0, 0.0, 2.0]
                # Rows are offset by half a place.
                feet = np.array(
                    [
                        center + ALONG * j * out + ACROSS * (i + 0.5 * (j % 2)) * side
                        for i, j in lattice
                    ]
                )
                normal = bisector(np.broadcast_to(sun, feet.shape), normalize(receiver - feet))
                beside = Mirrors.of(feet, normal, (WIDTH, HEIGHT), receiver)
                found.append(Case(target, center, sun, beside))
    return found


def read(case: Case, *, alone: bool, seed: int) -> np.ndarray:
    """Return the centroid in a rendered photograph, right and up on the target, m, (2,)."""
    camera = example_camera(case.target, size=(1280, 960))
    plain = Scene(camera, (case.target,))
    empty = render(exposed(plain, 0.5), seed, name="empty").frame
    beam = case.beam(alone=alone)
    lit = exposed(Scene(camera, (case.target,), beams=(Thrown("target", beam),)), 0.7)
    frame = render(lit, seed + 1, name="beam").frame
    seen = read_photograph(frame, (case.target,), camera, without=empty)
    return np.asarray(seen.reading("target").spots[0].plane)


def compare(case: Case, seed: int = 0) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Return the hidden share, and the shift: predicted, of the flux, and read, m, (2,) each."""
    slant = float(np.linalg.norm(case.target.center - case.center))
    normal = bisector(case.sun, (case.target.center - case.center) / slant)
    facets = equal_facets(WIDTH, HEIGHT, (2, 2), slant)
    said = centroid_shift(
        case.target, case.center, case.sun, normal, facets, case.neighbours, facet_focal=slant
    )
    flux = case.beam(alone=False).centroid - case.beam(alone=True).centroid
    seen = read(case, alone=False, seed=seed) - read(case, alone=True, seed=seed)
    return said.hidden, said.shift, flux, seen


def hidden(case: Case) -> float:
    """Return the hidden share of a mirror."""
    normal = bisector(case.sun, normalize(case.target.center - case.center))
    facets = equal_facets(WIDTH, HEIGHT, (2, 2), np.inf)
    return centroid_shift(
        case.target, case.center, case.sun, normal, facets, case.neighbours
    ).hidden


def run(quick: bool) -> Result:
    """Measure; see the module's docstring."""
    chosen = [(case, share) for case in cases() if 0.02 < (share := hidden(case)) <= MOST]
    chosen = chosen[::6] if quick else chosen
    rows: list[Row] = []
    for number, (case, share) in enumerate(chosen):
        _, said, flux, seen = compare(case, 2 * number)
        slant = float(np.linalg.norm(case.target.center - case.center))
        mrad = 1e3 / slant
        rows.append(
            {
                "distance_m": slant,
                "hidden": share,
                "predicted_right_mrad": float(said[0] * mrad),
                "predicted_up_mrad": float(said[1] * mrad),
                "read_right_mrad": float(seen[0] * mrad),
                "read_up_mrad": float(seen[1] * mrad),
                "left_mrad": float(np.linalg.norm(seen - said) * mrad),
                "left_of_flux_mrad": float(np.linalg.norm(flux - said) * mrad),
            }
        )
    moved = [float(np.hypot(r["read_right_mrad"], r["read_up_mrad"])) for r in rows]
    left = [float(r["left_mrad"]) for r in rows]
    figures = {
        "cases": len(rows),
        "median_read_mrad": float(np.median(moved)),
        "largest_read_mrad": max(moved),
        "median_left_mrad": float(np.median(left)),
        "largest_left_mrad": max(left),
    }
    headline = (
        f"neighbours move centroids by {np.median(moved):.2f} mrad in the median of "
        f"{len(rows)} photographs; {np.median(left):.3f} mrad are left after the correction"
    )
    return Result(rows, headline, figures, within_budget=float(np.median(left)) < 0.05)
