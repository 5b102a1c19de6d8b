"""The views that `Operations` returns of a running plant: plain, immutable values."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from enum import StrEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.record import CalibrationOutcome, HeliostatCalibration
from heliotrope.geometry import FloatArray
from heliotrope.optics import FluxView
from heliotrope.plant.emergency import Call
from heliotrope.safety import Alarm
from heliotrope.store.records import FieldPoint, Outlook, PlannedVisit

#: State shown for a row older than its limit, whose other values do not count.
STALE_STATE = 255


@dataclass(frozen=True)
class FieldFrame:
    """The whole field at one moment; the arrays are read-only and in the order of the names.

    Attributes
    ----------
    number
        Increases with each frame.
    at
        POSIX s.
    state
        States of `lcu.states`, `STALE_STATE` where unknown, uint8, (N,).
    fault, flags
        Codes of `lcu.names`, uint8 and uint32, (N,).
    age
        Age of all values of the row, s, float32, (N,); infinite if never heard.
    counts
        Step counts of the two axes, int32, (N, 2).
    error
        Predicted standard deviation of the normal, two-dimensional, rad, float32, (N,); NaN before
        the first calibration.
    measured
        Tracking error in the photographs of the last visit, rad, float32, (N,); NaN before.
    calibrated_at
        Time of the last calibration, POSIX s, (N,); NaN before.
    sightings
        Number of known sightings, int32, (N,).
    cluster
        Place in `FieldState.clusters`, int16, (N,).
    on
        Place in `Viewer.aim_names` of the aim of each, uint8, (N,); 0: none.
    held
        Whether it is out of service, bool, (N,).
    truth_error
        True tracking error, known to a twin only, rad, float32, (N,); None for a real plant.
    """

    number: int
    at: float
    state: npt.NDArray[np.uint8]
    fault: npt.NDArray[np.uint8]
    flags: npt.NDArray[np.uint32]
    age: npt.NDArray[np.float32]
    counts: npt.NDArray[np.int32]
    error: npt.NDArray[np.float32]
    measured: npt.NDArray[np.float32]
    calibrated_at: FloatArray
    sightings: npt.NDArray[np.int32]
    cluster: npt.NDArray[np.int16]
    on: npt.NDArray[np.uint8]
    held: npt.NDArray[np.bool_]
    truth_error: npt.NDArray[np.float32] | None


@dataclass(frozen=True)
class SunView:
    """The sun at a time: unit vector (3,), azimuth and elevation, rad."""

    at: datetime
    direction: FloatArray
    azimuth: float
    elevation: float


@dataclass(frozen=True)
class ParameterView:
    """One parameter of a mechanism, SI and rad, with its standard deviation and nominal value."""

    value: float
    sigma: float
    unit: str
    nominal: float = 0.0


@dataclass(frozen=True)
class DriveView:
    """One drive: count and goal in steps, the angle of its joint and of its goal in rad."""

    count: int
    goal: int
    angle: float
    goal_angle: float


@dataclass(frozen=True)
class SightingView:
    """One sighting: POSIX s, target, beam error under the calibration of that time, rad."""

    at: float
    target: str
    error: float


@dataclass(frozen=True)
class HeliostatView:
    """One heliostat in detail.

    Attributes
    ----------
    name, cluster, row
        Names, and the row in all arrays.
    position
        ENU, m, (3,).
    width, height
        Size of the mirror, m.
    live, age, state, fault, flags
        As in `field_state.HeliostatState`.
    supply, temperature, boots
        V, °C, and restarts; NaN, NaN, 0 if not live.
    drives
        Its two drives; () if not live.
    aim, standby
        ENU, m, (3,); NaN if not assigned.
    on
        Receiver or target that it aims at, "" for none.
    parameters
        Of its mechanism, by name.
    calibration
        The calibration believed now; None before the first.
    error
        Predicted tracking error, rad; NaN if never calibrated.
    truth_error
        True tracking error, known to a twin only, rad; NaN for a real plant.
    history
        Its sightings since the start, oldest first.
    results
        Results of its visits, oldest first.
    planned
        Its next visit, if one is planned.
    hold
        Why it is out of service, who took it out, and when it is expected back; "" if it is not.
    locked
        Why it is LOCKED, by which visit, since when and until when; "" if it is not.
    """

    name: str
    cluster: str
    row: int
    position: FloatArray
    width: float
    height: float
    live: bool
    age: float
    state: str
    fault: str
    flags: tuple[str, ...]
    supply: float
    temperature: float
    boots: int
    drives: tuple[DriveView, ...]
    aim: FloatArray
    standby: FloatArray
    on: str
    parameters: Mapping[str, ParameterView]
    calibration: HeliostatCalibration | None
    error: float
    truth_error: float
    history: tuple[SightingView, ...]
    results: tuple["CalibrationEntry", ...]
    planned: PlannedVisit | None
    hold: str
    locked: str


@dataclass(frozen=True)
class ClusterRow:
    """Health of one cluster.

    Attributes
    ----------
    name
        Of the cluster.
    alive
        Whether its status is younger than the limit.
    age
        Age of its status, s; infinite if none came.
    connected
        Whether its link is up.
    heliostats, live
        Its heliostats, and those heard within the limit.
    cycle
        Duration of the last poll of its bus, s; NaN if unknown.
    answered
        Share of its polls that its heliostats have answered since it began; NaN if unknown.
    refused
        Messages from it that could not be read.
    time_quality, time_error
        Quality of its clock, and the error bound, s.
    settings
        Checksum of the settings that all clusters should share; "" if unknown.
    lease_left
        Remaining lease at its last status, s; NaN if unknown.
    acts
        Acts that its safety table demands.
    problem
        Problem of its link, "" if none.
    """

    name: str
    alive: bool
    age: float
    connected: bool
    heliostats: int
    live: int
    cycle: float
    answered: float
    refused: int
    time_quality: str
    time_error: float
    settings: str
    lease_left: float
    acts: tuple[str, ...]
    problem: str


@dataclass(frozen=True)
class AlarmRow(Alarm):
    """The latest state of a condition of a subject.

    Attributes
    ----------
    at
        When it was raised, POSIX s.
    acknowledged_by
        Person who has acknowledged it, "" if nobody has.
    count
        Number of times it was raised.
    """

    at: float = field(kw_only=True)
    acknowledged_by: str = ""
    count: int = 1


@dataclass(frozen=True, eq=False, repr=False)
class PredictedView(FluxView):
    """The flux that is expected on a receiver, and its uncertainty.

    Standard deviations are those by the errors of the heliostats' calibrations: see
    `heliotrope.aims.errors`. Irradiance, reflectivity and soiling come on top.

    Attributes
    ----------
    sigma
        Standard deviation in each cell, W/m², (H, W); NaN on a mesh and in a cavity.
    power_sigma
        Standard deviation of the power, W.
    peak, peak_sigma
        Flux in the hottest cell and its standard deviation, W/m².
    measured
        What a camera measures now in the cells, W/m², (H, W), or another sensor as the mean, ();
        None: nothing is measured.
    """

    sigma: FloatArray
    power_sigma: float
    peak: float
    peak_sigma: float
    measured: FloatArray | None = None


@dataclass(frozen=True)
class EventRow:
    """One event.

    Attributes
    ----------
    at, kind, who, text
        POSIX s; command, calibration, authority or plant; person; one line.
    number
        Of the event, since the start of the plant.
    heliostats
        How many heliostats it is about, where the text does not name them all; else 0.
    """

    at: float
    kind: str
    who: str
    text: str
    number: int = 0
    heliostats: int = 0


@dataclass(frozen=True)
class PacketRow:
    """One message on a link: POSIX s, cluster, "to" or "from" it, kind, bytes, and its text."""

    at: float
    cluster: str
    way: str
    kind: str
    size: int
    text: str


@dataclass(frozen=True)
class BusFrame:
    """One frame of a cluster's bus.

    Attributes
    ----------
    at
        Time by the cluster's clock, POSIX s.
    way
        "sent" or "received" by the cluster.
    whom
        The heliostat at the other end, or "all"; "" if the frame is damaged.
    kind, sequence
        Name of the message, or "damaged"; its number.
    size
        Bytes on the bus.
    signed
        Whether it is signed with the key of the bus.
    text
        Its fields; the bytes as hexadecimal digits if they cannot be read.
    """

    at: float
    way: str
    whom: str
    kind: str
    sequence: int
    size: int
    signed: bool
    text: str


class Button(StrEnum):
    """What a person can do at once about a heliostat that does not track."""

    NONE = ""
    AUTOMATIC = "automatic"
    UNLOCK = "unlock"
    CLEAR_FAULT = "clear_fault"
    RETURN_LOCK = "return_lock"
    RESUME = "resume"
    WITHDRAW = "withdraw"


@dataclass(frozen=True)
class LastOrder:
    """The last command to a heliostat: POSIX s, person or part of the plant, name, and result."""

    at: float
    who: str
    what: str
    text: str


@dataclass(frozen=True)
class Explanation:
    """Why one heliostat tracks, or does not.

    Attributes
    ----------
    heliostat, tracks
        Its name, and whether its beam is on a receiver.
    text
        What it does and why: one sentence.
    follows, remedy
        What happens next by itself, and what a person can do.
    button
        The command that does this.
    order
        The last command to it since the start; None: there was none.
    alarms
        What is reported about it now.
    """

    heliostat: str
    tracks: bool
    text: str
    follows: str
    remedy: str
    button: Button
    order: LastOrder | None
    alarms: tuple[AlarmRow, ...]


@dataclass(frozen=True)
class Running:
    """A visit under way.

    Heliostat, target, what is being done, its beginning (POSIX s), and in a joint visit the other
    heliostats.
    """

    heliostat: str
    target: str
    stage: str
    since: float
    others: tuple[str, ...] = ()

    @property
    def heliostats(self) -> tuple[str, ...]:
        """All heliostats of the visit."""
        return (self.heliostat, *self.others)

    def without(self, heliostats: Collection[str]) -> "Running | None":
        """Return the visit without some heliostats, None if it has no others."""
        left = tuple(name for name in self.heliostats if name not in heliostats)
        return replace(self, heliostat=left[0], others=left[1:]) if left else None


@dataclass(frozen=True)
class CalibrationEntry:
    """The result of one visit.

    Attributes
    ----------
    at
        POSIX s.
    heliostat, target
        Names.
    outcome
        Whether the heliostat has a new calibration, or why not.
    before, after
        Beam error over all sightings of the heliostat, under the earlier calibration and after the
        fit, rad RMS; NaN without a fit.
    measured
        Beam error of this visit's photographs under the earlier calibration, rad RMS; NaN without.
    predicted
        Predicted standard deviation of the normal after it, rad; NaN if never calibrated.
    truth_before, truth_after
        True tracking error, known to a twin only, rad; NaN for a real plant.
    sightings, new
        Sightings known of the heliostat, and how many of them this visit brought.
    text
        The outcome for people.
    version
        Version of the new calibration; 0 without.
    """

    at: float
    heliostat: str
    target: str
    outcome: CalibrationOutcome
    before: float
    after: float
    measured: float
    predicted: float
    truth_before: float
    truth_after: float
    sightings: int
    new: int
    text: str
    version: int = 0

    @property
    def good(self) -> bool:
        """Whether the heliostat has a new calibration."""
        return self.outcome.calibrated


@dataclass(frozen=True)
class QualityPoint:
    """Quality of the calibrated heliostats at one moment.

    Attributes
    ----------
    at
        POSIX s.
    calibrated
        Number of calibrated heliostats.
    median, percentile_90
        Median and 90th percentile of their predicted tracking error, rad.
    truth_median, truth_percentile_90
        The same of the true error, known to a twin only; NaN for a real plant.
    """

    at: float
    calibrated: int
    median: float
    percentile_90: float
    truth_median: float
    truth_percentile_90: float


@dataclass(frozen=True)
class CalibrationView:
    """Progress of calibration.

    Attributes
    ----------
    on
        Whether calibration is running; if not, ``reason`` says why.
    done, waiting, failed
        Calibrated heliostats, the others, and visits without a new calibration.
    running
        Visits under way.
    results
        Results of the last visits, newest first.
    quality
        Quality over time, oldest first.
    asked
        Heliostats that persons want calibrated next.
    field
        Errors of all heliostats over time, oldest first.
    outlooks
        Predictions of these for this day: the first of the day, and the last.
    choice
        Why automatic control chose the last visit, or why it begins none; "" before its first.
    """

    on: bool
    reason: str
    done: int
    waiting: int
    failed: int
    running: tuple[Running, ...]
    results: tuple[CalibrationEntry, ...]
    quality: tuple[QualityPoint, ...]
    asked: tuple[str, ...] = ()
    field: tuple[FieldPoint, ...] = ()
    outlooks: tuple[Outlook, ...] = ()
    choice: str = ""


@dataclass(frozen=True)
class PictureRow:
    """A kept photograph.

    Attributes
    ----------
    identity
        Its number.
    heliostat, target
        Names; no heliostat where a person asked for it.
    at
        Middle of the exposure, POSIX s: that of its sighting.
    used
        Whether its beam could be used.
    reading
        The findings of the software, line by line.
    outcome, text
        The result of its visit, and the same for people.
    """

    identity: int
    heliostat: str
    target: str
    at: float
    used: bool
    reading: tuple[str, ...]
    outcome: str
    text: str


@dataclass(frozen=True)
class FlightView:
    """A flight of a drone that the plant has taken.

    Attributes
    ----------
    name, at, person
        Name, when it was taken (POSIX s), and who gave it.
    orientations, heliostats
        Number of its orientations, and of its heliostats.
    in_use, at_stow, at_target, unchanged
        Heliostats whose parameters count it, those that get new ones when they next stand at stow,
        those whose large change waits for a photograph on a target, and those whose fit was
        rejected or became no better.
    shared
        The errors that its rows share: name, value and standard deviation.
    problems
        Why fits were rejected: a line for each heliostat, the first ten.
    """

    name: str
    at: float
    person: str
    orientations: int
    heliostats: int
    in_use: int
    at_stow: int
    at_target: int
    unchanged: int
    shared: tuple[tuple[str, float, float], ...]
    problems: tuple[str, ...]


@dataclass(frozen=True)
class LearningView:
    """The hyperparameters of a group of mirrors that are in force.

    Attributes
    ----------
    group
        Name of the group in the plant file.
    version
        1, 2, ...; 0 while the defaults are in force.
    at, person
        When it was learnt (POSIX s, NaN by default), and who ordered it.
    heliostats, sightings
        Numbers of each that it was learnt from.
    gain
        Rise of a photograph's log probability density, foretold from those before it.
    drift
        Drift, steps and noise in force, in words.
    said
        How the last attempt ended, or that one is under way.
    """

    group: str
    version: int
    at: float
    person: str
    heliostats: int
    sightings: int
    gain: float
    drift: str
    said: str


@dataclass(frozen=True)
class TimetableRow:
    """An entry of the timetable: calibrations at times of day or at intervals.

    Attributes
    ----------
    name
        Unique.
    heliostats, target
        Names; target "": any that is free.
    at
        Times of day with their zone, as "08:30Z".
    every_s
        Interval, s, from midnight UTC; None: there is none.
    next, last
        When it is due, and when it was, POSIX s; NaN before the first time.
    text
        What came of the last time.
    rule
        "" for times; "first" or "never": what automatic control chooses of them.
    """

    name: str
    heliostats: tuple[str, ...]
    target: str
    at: tuple[str, ...]
    every_s: float | None
    next: float
    last: float
    text: str
    rule: str = ""


@dataclass(frozen=True)
class CameraView:
    """The last photograph of a target.

    Attributes
    ----------
    target
        Name.
    version
        Increases with each photograph; 0 before the first.
    at
        POSIX s.
    jpeg
        The picture with what was read in it drawn in; b"" before the first.
    reading
        The software's reading of it, line by line.
    centroid
        Of the beam, right of and above the target's centre, m; None if not seen.
    """

    target: str
    version: int
    at: float
    jpeg: bytes
    reading: tuple[str, ...] = ()
    centroid: tuple[float, float] | None = None


@dataclass(frozen=True)
class EmergencyView:
    """The last order to the whole field, with its proof.

    Attributes
    ----------
    on
        Whether it is active.
    act, who, reason
        DEFOCUS or STOW; the persons whose orders stand, and the safety table; and why, or how it
        ends once every order is withdrawn. When it is over: who gave it, and why. "" if there was
        no order.
    seconds
        Time since the order, s.
    heliostats, acknowledged, done
        Heliostats ordered, those that acknowledged it, and those proven to have carried it out.
    not_done
        Names of the first heliostats not proven to have carried it out.
    text
        The same for people.
    calls
        The orders of persons that have not been withdrawn, one for each person.
    measured
        Whether a sensor shows since the order that the flux on the receiver is below its limit.
    followed
        Number of the heliostats done whose mirrors were seen to follow their drives earlier today,
        by what showed it.
    believed, believed_count
        Names of the first heliostats done by their reports alone, and the number of all of them.
    basis
        What is measured and what is believed, for people.
    """

    on: bool
    act: str
    who: str
    reason: str
    seconds: float
    heliostats: int
    acknowledged: int
    done: int
    not_done: tuple[str, ...]
    text: str
    calls: tuple[Call, ...] = ()
    measured: bool = False
    followed: Mapping[str, int] = field(default_factory=dict)
    believed: tuple[str, ...] = ()
    believed_count: int = 0
    basis: str = ""


@dataclass(frozen=True)
class Summary:
    """The state of the plant, for the head of a page.

    Attributes
    ----------
    name
        Of the plant.
    at
        Time of the plant, UTC.
    heliostats, clusters
        Number of each.
    states
        Number of heliostats in each state; those not heard under "stale".
    clusters_alive
        Number of clusters heard.
    holder, role
        Person with the command authority; "" if nobody has it.
    waiting
        Heliostats waiting to join the receiver.
    alarms
        Number of alarms active or unacknowledged.
    emergency
        Whether an emergency is active.
    resume
        Why automatic control waits for a person's Resume, "" if it does not.
    pace
        Seconds of the plant's time per second over the last half minute: 1 for a real plant.
    readings
        Newest readings of sensors, by name, in the units of the safety table (`dni`: W/m²); NaN
        where there is none, or an old one.
    extra
        More rows, such as the speed of a twin.
    """

    name: str
    at: datetime
    heliostats: int
    clusters: int
    states: Mapping[str, int]
    clusters_alive: int
    holder: str
    role: str
    waiting: int
    alarms: int
    emergency: bool
    resume: str
    pace: float
    readings: Mapping[str, float]
    extra: Mapping[str, Any]
