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
        States of `lcu.states`, uint8, (N,); `STALE_STATE` where a state is unknown.
    fault, flags
        Codes from `lcu.names`, uint8 and uint32, (N,).
    age
        Age of the heliostat's reported values, s, float32, (N,); infinite if it never reported.
    counts
        Step counts of the two axes, int32, (N, 2).
    error
        Predicted standard deviation of the normal, two-dimensional, rad, float32, (N,); NaN before
        the first calibration.
    measured
        Tracking error in the photographs of the last visit, rad, float32, (N,); NaN before the
        first visit.
    calibrated_at
        Time of the last calibration, POSIX s, (N,); NaN before the first calibration.
    sightings
        Number of known sightings, int32, (N,).
    cluster
        Index in `FieldState.clusters`, int16, (N,).
    on
        Index of each aim in `Viewer.aim_names`, uint8, (N,); 0: none.
    held
        Whether each heliostat is out of service, bool, (N,).
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
    """The sun at one time: unit vector, (3,); azimuth and elevation, rad."""

    at: datetime
    direction: FloatArray
    azimuth: float
    elevation: float


@dataclass(frozen=True)
class ParameterView:
    """One parameter of a mechanism, SI or rad, with its standard deviation and nominal value."""

    value: float
    sigma: float
    unit: str
    nominal: float = 0.0


@dataclass(frozen=True)
class DriveView:
    """One drive: present count and target count, steps; present and target joint angle, rad."""

    count: int
    goal: int
    angle: float
    goal_angle: float


@dataclass(frozen=True)
class SightingView:
    """One sighting: time (POSIX s), target, beam error under the calibration of that time, rad."""

    at: float
    target: str
    error: float


@dataclass(frozen=True)
class HeliostatView:
    """One heliostat in detail.

    Attributes
    ----------
    name, cluster, row
        Names, and the index in all arrays.
    position
        ENU, m, (3,).
    width, height
        Size of the mirror, m.
    live, age, state, fault, flags
        As in `field_state.HeliostatState`.
    supply, temperature, boots
        Supply voltage, V; temperature, °C; number of restarts. NaN, NaN, 0 if not live.
    drives
        Its two drives; () if not live.
    aim, standby
        ENU, m, (3,); NaN if not assigned.
    on
        Receiver or target at which the heliostat aims; empty if there is none.
    parameters
        Parameters of its mechanism, by name.
    calibration
        The calibration in force; None before the first.
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
        Why it is out of service, who took it out, and when it is expected back; empty if it is not.
    locked
        Why it is LOCKED, by which visit, since when and until when; empty if it is not.
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
        Name of the cluster.
    alive
        Whether the age of its status is below the limit.
    age
        Age of its status, s; infinite if none was received.
    connected
        Whether its link is up.
    heliostats, live
        Number of its heliostats, and number of heliostats that reported within the limit.
    cycle
        Duration of the last poll of its bus, s; NaN if unknown.
    answered
        Fraction of polls answered by its heliostats since it started; NaN if unknown.
    refused
        Number of unreadable messages from the cluster.
    time_quality, time_error
        Quality of its clock, and the error bound, s.
    settings
        Checksum of the settings that all clusters should share; empty if unknown.
    lease_left
        Remaining lease at its last status, s; NaN if unknown.
    acts
        Actions that its safety table demands.
    problem
        Problem with its link; empty if there is none.
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
    """The latest state of an alarm condition for a subject.

    Attributes
    ----------
    at
        When it was raised, POSIX s.
    acknowledged_by
        Person who has acknowledged the alarm; empty if nobody has.
    count
        Number of times it was raised.
    """

    at: float = field(kw_only=True)
    acknowledged_by: str = ""
    count: int = 1


@dataclass(frozen=True, eq=False, repr=False)
class PredictedView(FluxView):
    """The predicted flux on a receiver, and its uncertainty.

    The standard deviations cover only the errors of the heliostats' calibrations (see
    `heliotrope.aims.errors`), and not the uncertainty of irradiance, reflectivity and soiling.

    Attributes
    ----------
    sigma
        Standard deviation in each cell, W/m², (H, W); NaN while many beams are uncalibrated.
    power_sigma
        Standard deviation of the power, W.
    peak, peak_sigma
        Flux in the hottest cell and its standard deviation, W/m².
    measured
        Flux in the cells now measured by a camera, W/m², (H, W), or mean flux measured by another
        sensor, (); None: nothing is measured.
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
        Time, POSIX s; "command", "calibration", "authority" or "plant"; person; the event in one
        line.
    number
        Number of the event, since the start of the plant.
    heliostats
        Number of heliostats concerned if the text does not name all of them; otherwise 0.
    """

    at: float
    kind: str
    who: str
    text: str
    number: int = 0
    heliostats: int = 0


@dataclass(frozen=True)
class PacketRow:
    """One message on a link: time (POSIX s), cluster, "to" or "from" it, kind, bytes, text."""

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
        The heliostat at the other end, or "all"; empty if the frame is damaged.
    kind, sequence
        Name of the message, or "damaged"; its sequence number.
    size
        Bytes on the bus.
    signed
        Whether it is signed with the bus key.
    text
        The fields of the frame; its bytes in hexadecimal if it cannot be decoded.
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
    """What an operator can do at once about a heliostat that does not track."""

    NONE = ""
    AUTOMATIC = "automatic"
    UNLOCK = "unlock"
    CLEAR_FAULT = "clear_fault"
    RETURN_LOCK = "return_lock"
    RESUME = "resume"
    WITHDRAW = "withdraw"


@dataclass(frozen=True)
class LastOrder:
    """The last command to a heliostat: time (POSIX s), who gave it, name, and result."""

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
        What the heliostat does and why, in one sentence.
    follows, remedy
        What happens next by itself, and what an operator can do.
    button
        Command for this remedy.
    order
        The last command to the heliostat since the start; None: no command yet.
    alarms
        Active alarms about the heliostat.
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
    """A calibration visit in progress.

    The fields are the heliostat, the target, the present stage, the start (POSIX s), and the other
    heliostats of a joint visit.
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
        """Return the visit without some heliostats; None if no heliostat remains."""
        left = tuple(name for name in self.heliostats if name not in heliostats)
        return replace(self, heliostat=left[0], others=left[1:]) if left else None


@dataclass(frozen=True)
class CalibrationEntry:
    """The result of one calibration visit.

    Attributes
    ----------
    at
        POSIX s.
    heliostat, target
        Names.
    outcome
        Whether the heliostat has a new calibration, or why it has none.
    before, after
        Beam error over all sightings of the heliostat, under the earlier calibration and after the
        fit, rad RMS; NaN without a fit.
    measured
        Beam error of this visit's photographs under the earlier calibration, rad RMS; NaN if there
        are no photographs.
    predicted
        Predicted standard deviation of the normal after the visit, rad; NaN if never calibrated.
    truth_before, truth_after
        True tracking error, known to a twin only, rad; NaN for a real plant.
    sightings, new
        Number of known sightings of the heliostat, and how many of them are from this visit.
    text
        The outcome in words.
    version
        Version of the new calibration; 0 if there is none.
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
        The same for the true error, known to a twin only; NaN for a real plant.
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
        Number of calibrated heliostats, number of remaining heliostats, and number of visits
        without a new calibration.
    running
        Visits in progress.
    results
        Results of the last visits, newest first.
    quality
        Quality over time, oldest first.
    asked
        Heliostats whose calibration operators have requested.
    field
        Errors of all heliostats over time, oldest first.
    outlooks
        Predictions of these errors for this day: the first of the day, and the latest.
    choice
        Why automatic control chose the last visit, or why it starts none; "" before the first
        visit.
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
    """A stored photograph.

    Attributes
    ----------
    identity
        Number of the photograph.
    heliostat, target
        Names; heliostat empty if a user requested the photograph.
    at
        Mid-exposure time, POSIX s, which is also the time of its sighting.
    used
        Whether its beam could be used.
    reading
        The findings of the software, line by line.
    outcome, text
        The outcome of its visit, as a code and in words.
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
    """A drone flight that the plant has imported.

    Attributes
    ----------
    name, at, person
        Name, when it was imported (POSIX s), and who supplied it.
    orientations, heliostats
        Number of measured orientations and of heliostats.
    in_use, at_stow, at_target, unchanged
        Number of heliostats whose parameters in use include the flight; number that receive new
        parameters when next at stow; number whose large change waits for a photograph on a target;
        number whose fit was rejected or was no better.
    shared
        The errors shared by all records of the flight: name, value and standard deviation.
    problems
        Why fits were rejected: one line per heliostat, at most ten.
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
    """The hyperparameters in force for a heliostat group.

    Attributes
    ----------
    group
        Name of the group in the plant file.
    version
        1, 2, ...; 0 while the defaults are in force.
    at, person
        When they were learnt (POSIX s; NaN for the defaults), and who requested it.
    heliostats, sightings
        Number of heliostats and sightings from which they were learnt.
    gain
        Increase in the log probability density of a photograph predicted from the earlier
        photographs.
    drift
        Drift, steps and noise in force, in words.
    said
        How the last attempt ended, or that one is in progress.
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
        Unique name.
    heliostats, target
        Names; target "": any free target.
    at
        Times of day with their zone, as "08:30Z".
    every_s
        Interval, s, from midnight UTC; None: there is no interval.
    next, last
        When the entry is due next, and when it was due last, POSIX s; NaN before the first time.
    text
        Outcome of the last time.
    rule
        "" for times; "first" or "never": whether automatic control chooses these heliostats first
        or never.
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
        The picture with the findings drawn in; b"" before the first photograph.
    reading
        The software's findings, line by line.
    centroid
        Beam centroid, as offsets right of and above the target's centre, m; None if no beam was
        seen.
    """

    target: str
    version: int
    at: float
    jpeg: bytes
    reading: tuple[str, ...] = ()
    centroid: tuple[float, float] | None = None


@dataclass(frozen=True)
class EmergencyView:
    """The last order to the whole field, and whether it has been carried out.

    Attributes
    ----------
    on
        Whether it is active.
    act, who, reason
        DEFOCUS or STOW; the users whose orders are in force, and the safety table if it requires
        the order; and the reason, or how the emergency ends once every order is withdrawn. After
        the emergency: who gave the order, and why; empty if there was no order.
    seconds
        Time since the order, s.
    heliostats, acknowledged, done
        Number of heliostats ordered, number that acknowledged the order, and number that have
        verifiably carried it out.
    not_done
        Names of the first heliostats that have not verifiably carried it out.
    text
        The state of the order, in words.
    calls
        The orders of users that have not been withdrawn, one per user.
    measured
        Whether a sensor has shown since the order that the flux on the receiver is below its limit.
    followed
        Of the heliostats counted as done, the number whose mirrors demonstrably followed their
        drives earlier today, by type of evidence.
    believed, believed_count
        Names of the first heliostats counted as done only by their reports, and the number of all
        such heliostats.
    basis
        What is measured and how many are believed, in words.
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
        Name of the plant.
    at
        Plant time, UTC.
    heliostats, clusters
        Number of heliostats and of clusters.
    states
        Number of heliostats in each state; silent heliostats under "stale".
    clusters_alive
        Number of clusters that report.
    holder, role
        User with the command authority; empty if nobody has it.
    waiting
        Number of heliostats waiting to join the receiver.
    alarms
        Number of alarms active or unacknowledged.
    emergency
        Whether an emergency is active.
    resume
        Why automatic control waits for an operator's Resume; empty if it does not wait.
    pace
        Seconds of plant time per second over the last half minute: 1 for a real plant.
    readings
        Newest sensor readings, by name, in the units of the safety table (`dni`: W/m²); NaN if
        missing or too old.
    extra
        Additional rows, such as the speed of a twin.
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
