"""Evaluate a drone flight, from its folder of photographs to sightings."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from heliotrope.airborne.evaluate.budget import Budget
from heliotrope.airborne.evaluate.bundle import Priors
from heliotrope.airborne.evaluate.campaign import Campaign, evaluate_campaign
from heliotrope.airborne.evaluate.evaluation import FlightEvaluation
from heliotrope.airborne.evaluate.folder import FlightData, open_flights
from heliotrope.airborne.evaluate.matching import Matches, read_matches, turn_by_hand
from heliotrope.airborne.evaluate.orientation import Mean, measure_field
from heliotrope.airborne.evaluate.reading import read_many
from heliotrope.airborne.evaluate.sightings import to_sightings
from heliotrope.airborne.evaluate.tables import MeasuredFlight
from heliotrope.calibration.plausibility import judge_in
from heliotrope.calibration.sightings import Sightings, join
from heliotrope.field.plant import Plant

if TYPE_CHECKING:
    from distributed import Client

#: Function called with the name of the step, the number of items done, and the total number.
Progress = Callable[[str, int, int], None]

#: Survey (10 mm) and kinematics (30 mm) as HelioPoint assumes them; the 30 mm for the RTK base is
#: our assumption.
PRIORS = Priors(offset=0.030, position=0.010, kinematics=0.030)


@dataclass(frozen=True)
class FlightResult:
    """One flight with its result.

    Attributes
    ----------
    data
        Photographs, and mirrors as commanded.
    evaluation
        Exterior orientations, and reflections.
    measured
        Orientations of the mirrors, and the data used to measure them.
    """

    data: FlightData
    evaluation: FlightEvaluation
    measured: MeasuredFlight

    def label(self, name: str) -> str:
        """Return the campaign-wide name for a name within this flight."""
        return f"{self.data.name}/{name}" if self.data.name else name

    def sightings(self) -> Sightings | None:
        """Return one sighting per orientation, with heliostats as plant indices."""
        if not self.measured.found.found:
            return None
        times = [p.time.timestamp() for p in self.evaluation.photos if p.time is not None]
        made = to_sightings(
            self.measured.found,
            self.data.counts,
            time=float(np.mean(times)) if times else 0.0,
            per="orientation",
        )
        return replace(made, heliostat=self.data.heliostat[made.heliostat])


@dataclass(frozen=True)
class CampaignResult:
    """The flights of a folder with their results.

    Attributes
    ----------
    plant
        The field.
    data
        All flights that could be opened.
    campaign
        Common RTK offset, and the outcome of each flight.
    flights
        The flights with a result.
    not_used
        A message for each flight and photograph that was not used.
    warnings
        A message for each missing slope map, and one if the RTK offset is implausible.
    """

    plant: Plant
    data: tuple[FlightData, ...]
    campaign: Campaign
    flights: tuple[FlightResult, ...]
    not_used: tuple[str, ...]
    warnings: tuple[str, ...]

    def sightings(self) -> Sightings | None:
        """Return the plausible sightings of all flights; None if there are none."""
        sightings, reasons = self._judged
        if sightings is None or len(reasons) == len(sightings):
            return None
        return sightings.take(~np.isin(np.arange(len(sightings)), list(reasons)))

    @property
    def impossible(self) -> tuple[str, ...]:
        """Messages, one for each sighting that is physically impossible."""
        sightings, reasons = self._judged
        if sightings is None:
            return ()
        names = [self.plant.names[row] for row in sightings.heliostat]
        return tuple(f"{names[k]}: {text}" for k, text in sorted(reasons.items()))

    @cached_property
    def _judged(self) -> tuple[Sightings | None, Mapping[int, str]]:
        parts = [s for s in (f.sightings() for f in self.flights) if s is not None]
        if not parts:
            return None, {}
        sightings = join(parts)
        return sightings, judge_in(self.plant, sightings).reasons

    def orientation_rows(self) -> list[dict[str, Any]]:
        """Return one record per orientation, with its systematic error split by cause."""
        return [row for f in self.flights for row in f.measured.rows(f.data.name)]

    def orientation_warnings(self) -> list[tuple[str, str]]:
        """Return pairs of a heliostat name and a warning about its orientation."""
        return [
            (f.label(f.measured.found.names[o.heliostat]), warning)
            for f in self.flights
            for o in f.measured.found.found
            for warning in o.warnings
        ]

    def left_out(self) -> dict[str, str]:
        """Return the heliostats that could not be measured, with the reasons."""
        return {
            f.label(name): reason
            for f in self.flights
            for name, reason in f.measured.found.left_out.items()
        }

    def document(self) -> dict[str, Any]:
        """Return the result as a JSON object."""
        warnings: dict[str, list[str]] = {}
        for name, warning in self.orientation_warnings():
            warnings.setdefault(name, []).append(warning)
        return {
            "photographs": [f.label(p.name) for f in self.flights for p in f.evaluation.photos],
            "not_used": [*self.not_used, *self.impossible],
            "reflections": sum(len(f.evaluation.reflections) for f in self.flights),
            "rtk_offset_m": self.campaign.offset.tolist(),
            "rtk_offset_sigma_m": self.campaign.offset_sigma.tolist(),
            "orientations": self.orientation_rows(),
            "warnings": warnings,
            "left_out": self.left_out(),
        }


def evaluate_flight(
    folder: str | Path,
    plant: Plant,
    *,
    camera: Path | None = None,
    commands: Path | None = None,
    cluster: str = "",
    point: str = "",
    slopes: Path | None = None,
    focal: float = np.inf,
    priors: Priors = PRIORS,
    axis: Mean = "area",
    matches: Path | None = None,
    keep: Path | None = None,
    processes: int = 1,
    client: "Client | None" = None,
    progress: Progress | None = None,
) -> CampaignResult:
    """Return the mirror orientations from a flight's folder of photographs.

    A folder of such folders is a campaign, whose flights are evaluated together. The steps, in
    order:

    1. ``folder.open_flights``: photographs, camera and commands become a ``FlightData``.
    2. ``reading.read_many``: each photograph is converted to a ``PhotoReading``.
       ``reading.read_photo``, ``detection.find_patches``, ``identification.identify``,
       ``detection.find_outlines``, ``detection.find_spots``.
    3. ``campaign.evaluate_campaign``: flights that share heliostats are evaluated together.
    4. ``evaluation.evaluate``: one adjustment, and its ``FlightEvaluation``.
    5. ``bundle.adjust``: all corners together yield the exterior orientations and the RTK offset.
    6. ``rays.spot_reflections``: spots become ``Reflections`` on mirrors.
    7. ``orientation.measure_field``: reflections become ``Orientations`` with their accuracy.
       ``orientation.measure``.
    8. ``sightings.to_sightings``: orientations become ``Sightings`` for the calibration, when
       `CampaignResult.sightings` is called.

    `heliotrope.airborne.evaluate.report.write_result` writes the result to files.

    Parameters
    ----------
    folder, camera, commands, cluster, point, slopes, focal
        See `heliotrope.airborne.evaluate.folder.open_flights`.
    plant
        The field.
    priors
        Prior standard deviations.
    axis
        How the optical axis of a mirror is defined: the kind of mean in
        `heliotrope.airborne.evaluate.orientation.measure`.
    matches
        Table of mirrors that a user has identified in photographs
        (`heliotrope.airborne.evaluate.matching.read_matches`).
    keep, processes, client
        See `heliotrope.airborne.evaluate.reading.read_many`.
    progress
        Called with the name of the step, and the numbers of photographs (done, total).

    Raises
    ------
    InputError
        If no flight can be used or none yields a reflection.
    """
    opened, unusable, warnings = open_flights(
        Path(folder),
        plant,
        camera=camera,
        commands=commands,
        cluster=cluster,
        point=point,
        slopes=slopes,
        focal=focal,
    )
    if matches is not None:
        named, left_out = read_matches(matches, plant.names)
        opened = [_turned(flight, named) for flight in opened]
        warnings += [*left_out, *_missing_photographs(named, opened)]
    flights = [read_flight(f, keep, processes, client, progress) for f in opened]
    campaign = evaluate_campaign(flights, priors)
    # The mirror positions from the adjustment already include the error of the RTK base.
    budget = Budget(priors.position, priors.kinematics, 0.0)
    results = [
        _measure(flight, evaluation, budget, axis)
        for flight, evaluation in zip(flights, campaign.flights, strict=True)
        if evaluation is not None
    ]
    lines = [(f.name, line) for f in flights for line in f.problems]
    for flight, problems in zip(flights, campaign.problems, strict=True):
        lines += [(flight.name, line) for line in problems]
    not_used = (*unusable, *(f"{name}: {line}" if name else line for name, line in lines))
    all_warnings = (*warnings, *campaign.warnings(priors.offset))
    return CampaignResult(plant, tuple(flights), campaign, tuple(results), not_used, all_warnings)


def _turned(flight: FlightData, named: Matches) -> FlightData:
    """Return a flight with the attitudes that follow from mirror positions identified by a user."""
    photos, problems = turn_by_hand(flight.photos, flight.camera, flight.stand, named, flight.name)
    return replace(flight, photos=photos, problems=(*flight.problems, *problems))


def _missing_photographs(named: Matches, flights: Sequence[FlightData]) -> list[str]:
    """Return a message for each photograph that the table names but that does not exist."""
    present = {name for f in flights for p in f.photos for name in (p.name, f"{f.name}/{p.name}")}
    missing = dict.fromkeys(name for name in named.photo if name not in present)
    return [
        f"{named.path.name}: there is no photograph {name!r}; its rows are ignored"
        for name in missing
    ]


def read_flight(
    flight: FlightData,
    keep: Path | None = None,
    processes: int = 1,
    client: "Client | None" = None,
    progress: Progress | None = None,
) -> FlightData:
    """Return a flight with the readings of its photographs; see `evaluate_flight`."""
    what = f"reading {flight.name}".strip()
    readings = read_many(
        flight.photos,
        flight.camera,
        flight.stand,
        processes=processes,
        client=client,
        keep=keep,
        progress=None if progress is None else lambda done, of: progress(what, done, of),
    )
    return replace(flight, seen=readings)


def _measure(
    flight: FlightData, evaluation: FlightEvaluation, budget: Budget, axis: Mean
) -> FlightResult:
    """Measure the mirrors of one flight at the positions found in the photographs."""
    orientations = measure_field(
        evaluation.reflections,
        flight.stand.names,
        flight.shape,
        flight.stand.rotation,
        evaluation.stand.vertex,
        budget=budget,
        places=evaluation.place_covariance,
        mean=axis,
    )
    measured = MeasuredFlight(
        flight.name,
        orientations,
        flight.shape,
        evaluation.stand.vertex,
        budget,
        evaluation.place_covariance,
    )
    return FlightResult(flight, evaluation, measured)
