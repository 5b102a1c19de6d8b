"""Compare a rendered flight with its ground truth: photographs used, reflections, errors.

`fly_rendered` writes the photographs of a flight and evaluates them like real photographs. Only the
files, the plant and the lens are passed from the first step to the second.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from heliotrope.airborne.evaluate.flight import PRIORS, CampaignResult, evaluate_flight
from heliotrope.airborne.evaluate.orientation import rotation_between
from heliotrope.airborne.evaluate.reflections import Reflections
from heliotrope.airborne.photo import LedCamera
from heliotrope.airborne.simulate.rendering import Conditions, render_flight
from heliotrope.airborne.simulate.simulation import Errors, Flight, fly, hover_grid, look_counts
from heliotrope.airborne.visibility import MARGIN, Labels, draw_labels
from heliotrope.field.camera import look_at
from heliotrope.field.example import azimuth_elevation
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray, as_float, direction
from heliotrope.sun import Site

#: A found reflection matches a true reflection if it is this close to it on the same mirror, m.
_SAME = 0.25
#: Two reflections closer than this in the photograph are one spot, px.
_MERGED = 5.0
#: What is beside a reflection: another reflection, another mirror (within the margin plus the error
#: of the outline), the ground (within the margin), or none of these.
KINDS = ("beside another reflection", "at another mirror", "at the mirror's edge", "clear")
#: 90 % of a bivariate normal distribution lie within this squared distance in standard deviations.
_ELLIPSE = 4.605170185988091


@dataclass(frozen=True)
class Compared:
    """A rendered flight compared with its ground truth.

    Attributes
    ----------
    photographs, used
        Number of photographs rendered, and evaluated.
    shown, found, right
        Number of true reflections on visible parts of mirrors; number of these found; and number of
        these found on the correct mirror.
    missed
        Number of reflections shown but not found, by kind of surroundings (`KINDS`).
    count
        Number of reflections on each of K measured mirrors, (K,).
    error, sigma
        True error and σ_tot of each mirror, rotX and rotY, rad, (K, 2).
    """

    photographs: int
    used: int
    shown: int
    found: int
    right: int
    missed: dict[str, int]
    count: FloatArray
    error: FloatArray
    sigma: FloatArray

    @property
    def identified(self) -> float:
        """Fraction of the found reflections that are on the correct mirror."""
        return self.right / max(self.found, 1)

    @property
    def within(self) -> float:
        """Fraction of the errors within the 90 % ellipse of σ_tot."""
        return float(np.mean(np.sum((self.error / self.sigma) ** 2, axis=-1) < _ELLIPSE))


def fly_rendered(
    flight: Flight,
    plant: Plant,
    folder: Path,
    *,
    conditions: Conditions | None = None,
    seed: int = 0,
    fewest: int = 1,
) -> Compared:
    """Render a flight into a folder, evaluate it, and compare the result with the ground truth.

    Parameters
    ----------
    flight
        A simulated flight.
    plant
        The field that contains the heliostats of the flight.
    folder
        Folder for the photographs.
    conditions, seed
        See `heliotrope.airborne.simulate.rendering.render_flight`.
    fewest
        Minimum number of reflections for a mirror to be compared.

    Raises
    ------
    InputError
        If no photograph can be used.
    """
    site = plant.site
    origin = (site.latitude_deg, site.longitude_deg, site.height)
    exact = render_flight(flight, folder, origin, conditions=conditions, seed=seed)
    result = evaluate_flight(folder, plant, priors=PRIORS)
    return compare(flight, exact, result, fewest)


def compare(
    flight: Flight, exact: Reflections, result: CampaignResult, fewest: int = 1
) -> Compared:
    """Compare the single flight in a result with its ground truth."""
    evaluation = result.flights[0].evaluation
    names = {photo.name: k for k, photo in enumerate(flight.taken)}
    number = np.array([names[p.name] for p in evaluation.photos])
    rows = np.array([flight.truth.names.index(n) for n in evaluation.stand.names])
    mine = evaluation.reflections
    key = number[mine.photo] * len(rows) + rows[mine.heliostat]
    true = exact.photo * len(rows) + exact.heliostat
    right, explained = 0, set[int]()
    for place, k in zip(mine.xy, key.tolist(), strict=True):
        candidates = np.flatnonzero(true == k)
        apart = np.linalg.norm(exact.xy[candidates] - place, axis=-1)
        if apart.min(initial=np.inf) < _SAME:
            right += 1
            explained.add(int(candidates[np.argmin(apart)]))
    shown = visible_reflections(flight, exact)
    lost = [kind for i, kind in shown.items() if i not in explained]
    kept = [o for o in result.flights[0].measured.found.found if o.count >= fewest]
    return Compared(
        len(flight.taken),
        len(evaluation.photos),
        len(shown),
        len(mine),
        right,
        {kind: lost.count(kind) for kind in KINDS},
        as_float([o.count for o in kept]),
        as_float(
            [
                rotation_between(o.rotation, flight.truth.rotation[rows[o.heliostat]])[:2]
                for o in kept
            ]
        ).reshape(-1, 2),
        as_float([o.sigma_total for o in kept]).reshape(-1, 2),
    )


def visible_reflections(flight: Flight, exact: Reflections) -> dict[int, str]:
    """Return the reflections in the frame that no nearer mirror hides.

    Each reflection is labelled with its surroundings, the first of `KINDS` that applies.
    """
    stand, camera = flight.truth, flight.camera
    kinds: dict[int, str] = {}
    for k, photo in enumerate(flight.taken):
        away = np.linalg.norm(stand.vertex - photo.position, axis=-1)
        labels = draw_labels(photo.pixels(camera, stand.corners), away, camera.size)
        pixels: dict[int, FloatArray] = {}
        for i in np.flatnonzero(exact.photo == k).tolist():
            row = int(exact.heliostat[i])
            point = flight.shapes[row].point_at(exact.facet[i : i + 1], exact.xy[i : i + 1])[0]
            pixel = photo.pixels(camera, stand.vertex[row] + stand.rotation[row] @ point)
            if np.isfinite(pixel).all():
                x, y = np.round(pixel).astype(int).tolist()
                inside = 0 <= x < camera.size[0] and 0 <= y < camera.size[1]
                if inside and labels[y, x] == row + 1:
                    pixels[i] = pixel
        kinds |= {i: _kind(i, pixels, labels) for i in pixels}
    return kinds


def _kind(i: int, pixels: dict[int, FloatArray], labels: Labels) -> str:
    """Return the kind of the surroundings of reflection ``i`` in a photograph."""
    merged, mirror, edge, clear = KINDS
    if any(np.linalg.norm(pixels[i] - pixel) < _MERGED for k, pixel in pixels.items() if k != i):
        return merged
    x, y = np.round(pixels[i]).astype(int).tolist()
    low_x, low_y = max(x - 3, 0), max(y - 3, 0)
    around = labels[low_y : y + 4, low_x : x + 4]
    rows, columns = np.indices(around.shape)
    apart = np.hypot(columns + low_x - pixels[i][0], rows + low_y - pixels[i][1])
    other = around != labels[y, x]
    if (other & (around > 0) & (apart < MARGIN + 1)).any():
        return mirror
    return edge if (other & (apart < MARGIN)).any() else clear


def paper_field(rows: int = 6, columns: int = 8) -> Heliostats:
    """Return mirrors like HelioPoint's: four facets, 3.2 m by 2.5 m in total.

    The mirrors stand 4.6 m apart in staggered rows at intervals of 6 m; the paper does not state
    the distances.
    """
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    east = 4.6 * (grid[:, 0] + 0.5 * (grid[:, 1] % 2) - 0.5 * columns)
    place = np.stack([east, 100.0 + 6.0 * grid[:, 1], np.full(len(grid), 2.0)], axis=-1)
    n = len(place)
    center, right, up = np.zeros((3, n, 4, 3))
    center[..., 0] = np.array([-0.8, 0.8, -0.8, 0.8])
    center[..., 1] = np.array([-0.625, -0.625, 0.625, 0.625])
    right[..., 0], up[..., 1] = 0.79, 0.615
    names = tuple(f"J{i // columns + 1}{chr(65 + i % columns)}" for i in range(n))
    facets = Facets(center, right, up)
    return Heliostats(names, azimuth_elevation(place), np.full(n, 3.2), np.full(n, 2.5), facets)


def paper_flight(
    camera: LedCamera,
    site: Site,
    errors: Errors | None = None,
    *,
    columns: int = 7,
    rows: int = 6,
    seed: int = 0,
    mirrors: Heliostats | None = None,
) -> tuple[Flight, Plant]:
    """Return a flight in HelioPoint's geometry, and the field.

    The mirrors face a drone 150 m away at 13.5° elevation and 214° azimuth, which are the means of
    the paper's tables 4 and 5. The pattern covers a mirror and a pointing error of 5 mrad.
    """
    field = mirrors or paper_field()
    middle = field.position.mean(axis=0)
    drone = middle + 150.0 * direction(np.radians(214.0), np.radians(13.5))
    width, height = 3.2 + 1.5, 2.5 + 1.5
    pattern = hover_grid(drone, middle, columns, rows, 1.0)
    step = np.array([width / columns, height / rows])
    across = (pattern - drone) @ (axes := look_at(drone, middle))
    places = drone + (across[:, :2] * step) @ axes[:, :2].T
    counts = look_counts(field, drone)
    flown = fly(field, camera, counts, places, middle, errors=errors, seed=seed)
    return flown, Plant("paper", site, {"azel": field})
