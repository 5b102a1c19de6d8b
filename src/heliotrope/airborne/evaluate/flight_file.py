"""A campaign as a file for the plant: orientations, with the errors that they share.

The error in a mirror's position relative to the drone has several parts. One part is common to all
mirrors of a bundle adjustment (the remainder of the RTK offset, and half of an error in the lamp
offset). Another grows with the distance from the middle of the photographs (focal length), a third
is common to all poses of a mirror (survey), and only the rest belongs to a single pose
(kinematics). A fit that treats all parts as independent between poses puts too much trust in a
large number of mirrors; see `heliotrope.calibration.fit.common`.
"""

from dataclasses import dataclass

import numpy as np

from heliotrope.airborne.evaluate.bundle import Adjusted
from heliotrope.airborne.evaluate.flight import CampaignResult, FlightResult
from heliotrope.airborne.evaluate.orientation import Orientation
from heliotrope.airborne.evaluate.sightings import mean_sigma
from heliotrope.calibration.flights import FlightDocument, FlightRow, flight_name
from heliotrope.geometry import FloatArray

#: Relative error of a calibrated focal length: half a pixel in 5,000.
LENS = 1e-4


@dataclass(frozen=True)
class _Group:
    """The flights of one bundle adjustment; focal-length errors shift mirrors radially.

    Attributes
    ----------
    adjusted
        The adjustment.
    place
        Index of the group's first shared error.
    middle
        Mean position of the group's mirrors, ENU, m, (3,).
    """

    adjusted: Adjusted
    place: int
    middle: FloatArray


def flight_document(
    result: CampaignResult, *, name: str = "", lens: float = LENS
) -> FlightDocument | None:
    """Return the document of a campaign; None if no mirror has an orientation.

    Parameters
    ----------
    result
        The campaign.
    name
        Name, unique in the plant that will import the file. If empty, the name consists of the time
        of the first photograph and the plant name.
    lens
        Relative standard deviation of the focal length.
    """
    groups: dict[int, _Group] = {}
    shared: list[str] = []
    blocks: list[FloatArray] = []
    for flight in result.flights:
        adjusted = flight.evaluation.adjusted
        if id(adjusted) in groups or not flight.measured.found.found:
            continue
        groups[id(adjusted)] = _Group(adjusted, len(shared), adjusted.state.stand.vertex.mean(0))
        word = f" {len(groups)}" if len(groups) > 1 else ""
        shared += [f"position{word} {axis}, m" for axis in ("east", "north", "up")]
        budget = flight.measured.budget
        lamp = 0.0 if budget is None else 0.5 * budget.lamp
        blocks.append(adjusted.common_covariance + lamp**2 * np.eye(3))
    if not groups:
        return None
    covariance = np.zeros((len(shared) + 1, len(shared) + 1))
    for k, block in enumerate(blocks):
        covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = block
    covariance[-1, -1] = lens**2
    shared.append("focal length, share")
    rows = [
        row
        for flight in result.flights
        if flight.measured.found.found
        for row in _rows(flight, groups[id(flight.evaluation.adjusted)], len(shared))
    ]
    times = [row.time for row in rows]
    return FlightDocument(
        format="heliotrope-flight",
        version=1,
        name=name or flight_name((result.plant.name,), min(times)),
        shared=shared,
        covariance=covariance.tolist(),
        rows=rows,
    )


def _rows(flight: FlightResult, group: _Group, count: int) -> list[FlightRow]:
    times = [p.time.timestamp() for p in flight.evaluation.photos if p.time is not None]
    at = float(np.mean(times)) if times else 0.0
    return [_row(flight, o, group, count, at) for o in flight.measured.found.found]


def _row(flight: FlightResult, o: Orientation, group: _Group, count: int, at: float) -> FlightRow:
    budget = flight.measured.budget
    own, survey = (
        _beside(flight.evaluation.place_covariance[o.heliostat], group.adjusted.common_covariance),
        1.0,
    )
    if budget is not None:
        survey = budget.position**2 / max(budget.position**2 + budget.kinematics**2, 1e-12)
    across = np.eye(3) - np.outer(o.normal, o.normal)
    turned = survey * float(np.trace(across @ own)) / 2.0 / o.distance**2
    scatter = mean_sigma(o)
    away = across @ (o.vertex - group.middle)
    shift = np.zeros((3, count))
    shift[:, group.place : group.place + 3] = np.eye(3)
    # A mirror that appears farther out is farther from the camera axis, so the drone is farther
    # back.
    shift[:, -1] = -away
    return FlightRow(
        heliostat=flight.measured.found.names[o.heliostat],
        time=at,
        counts=[float(c) for c in flight.data.counts[o.heliostat]],
        place_m=(o.vertex + o.distance * o.normal).tolist(),
        sigma_rad=scatter,
        turn_rad=float(np.hypot(scatter, np.sqrt(turned))),
        covariance_m2=((1.0 - survey) * own).tolist(),
        shift=shift.tolist(),
    )


def _beside(whole: FloatArray, common: FloatArray) -> FloatArray:
    """Return a covariance, (3, 3), less its common part, without negative variances."""
    values, vectors = np.linalg.eigh(whole - common)
    remainder = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(0.5 * (remainder + remainder.T))
