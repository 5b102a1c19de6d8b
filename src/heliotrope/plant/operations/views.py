"""What `Operations` shows of a plant at work: plain values, made anew, never changed."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray

#: State of a row that is older than its limit: nothing else in it counts.
STALE_STATE = 255


@dataclass(frozen=True)
class FieldFrame:
    """The whole field at one moment; the arrays are read-only and in the order of the names.

    Attributes
    ----------
    number
        Rises with each frame.
    at
        POSIX s.
    state
        Of `lcu.states`, `STALE_STATE` where it is not known, uint8, (N,).
    fault, flags
        Of `lcu.names`, uint8 and uint32, (N,).
    age
        Of all values of the row, s, float32, (N,); infinite if never heard.
    counts
        Steps of the two axes, int32, (N, 2).
    error
        Predicted standard deviation of the normal, two-dimensional, rad, float32, (N,); NaN where
        a heliostat was never calibrated.
    measured
        Tracking error at the last photograph that counted, rad, float32, (N,); NaN before.
    calibrated_at
        POSIX s, (N,); NaN before.
    sightings
        How many are known, int32, (N,).
    cluster
        Place in `Operations.clusters`, int16, (N,).
    on
        Place in `Operations.aim_names` of what each was told to aim at, uint8, (N,); 0: nothing.
    held
        Whether an operator keeps it out of calibration, bool, (N,).
    truth_error
        Tracking error that a twin knows, rad, float32, (N,); None for a real plant.
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
    """The sun: unit vector (3,), azimuth and elevation in rad, and the time of it."""

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
    """One sighting: POSIX s, target, beam error (rad) as it was when it was taken."""

    at: float
    target: str
    error: float


@dataclass(frozen=True)
class Planned:
    """One measurement to come.

    Attributes
    ----------
    heliostat, target
        Who, and where.
    at
        Expected beginning, POSIX s.
    gain
        Expected fall of the predicted error, rad; NaN if it is not judged.
    reason
        In words.
    """

    heliostat: str
    target: str
    at: float
    gain: float
    reason: str = ""


@dataclass(frozen=True)
class HeliostatView:
    """One heliostat in detail.

    Attributes
    ----------
    name, cluster, row
        Whose, and its place in all arrays.
    position
        ENU, m, (3,).
    width, height
        Of the mirror, m.
    live, age, state, fault, flags
        As in `field_state.HeliostatState`.
    supply, temperature, boots
        V, °C, and restarts; NaN, NaN, 0 if not live.
    drives
        The two; () if not live.
    aim, standby
        ENU, m, (3,); NaN if none was given.
    on
        Name of what it aims at, "" for nothing.
    parameters
        By name.
    error
        Predicted, rad; NaN if never calibrated.
    truth_error
        rad; NaN if nobody knows.
    history
        Its sightings, oldest first.
    results
        What its calibrations said, oldest first.
    planned
        The next measurement, if it is planned.
    hold
        Why an operator keeps it out of calibration, "" if nobody does.
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
    error: float
    truth_error: float
    history: tuple[SightingView, ...]
    results: tuple["CalibrationEntry", ...]
    planned: Planned | None
    hold: str


@dataclass(frozen=True)
class ClusterRow:
    """Health of one cluster.

    Attributes
    ----------
    name
        Whose.
    alive
        Whether its status is younger than the limit.
    age
        Of its status, s; infinite if none came.
    connected
        Whether its link is up.
    heliostats, live
        How many it has, and how many were heard within the limit.
    cycle
        Last poll of its bus, s; NaN if unknown.
    answered
        Share of its questions that its heliostats answered since it began; NaN if unknown.
    refused
        Messages that it sent and that were none.
    time_quality, time_error
        Of its clock; s.
    lease_left
        What is left of the plant's lease at its last status, s; NaN if unknown.
    acts
        What its safety table holds.
    problem
        Of its link, "" if there is none.
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
    lease_left: float
    acts: tuple[str, ...]
    problem: str


@dataclass(frozen=True)
class AlarmRow:
    """One alarm: the last word on a condition of a subject.

    Attributes
    ----------
    at
        When it came, POSIX s.
    condition, subject, severity, text
        As in `protocol.Alarm`.
    active
        Whether it holds still.
    acknowledged_by
        Who has acknowledged it, "" if nobody has.
    count
        How often it came.
    """

    at: float
    condition: str
    subject: str
    severity: str
    text: str
    active: bool
    acknowledged_by: str = ""
    count: int = 1


@dataclass(frozen=True)
class EventRow:
    """One event: POSIX s, kind (command, calibration, authority, plant), who, and a line."""

    at: float
    kind: str
    who: str
    text: str


@dataclass(frozen=True)
class PacketRow:
    """One message at a link: POSIX s, cluster, "to" or "from" it, kind, bytes, and its sense."""

    at: float
    cluster: str
    way: str
    kind: str
    size: int
    text: str


@dataclass(frozen=True)
class Running:
    """A measurement that goes on: who, where, stage in words, since when (POSIX s)."""

    heliostat: str
    target: str
    stage: str
    since: float


@dataclass(frozen=True)
class CalibrationEntry:
    """The end of one measurement.

    Attributes
    ----------
    at
        POSIX s.
    heliostat, target
        Who, where.
    good
        Whether the heliostat has new parameters.
    before, after
        Beam error over its sightings, rad RMS; NaN without a fit.
    predicted
        Standard deviation of the normal after it, rad; NaN without a fit.
    truth_before, truth_after
        Tracking error that a twin knows, rad; NaN for a real plant.
    sightings
        How many are known of it.
    text
        In words.
    """

    at: float
    heliostat: str
    target: str
    good: bool
    before: float
    after: float
    predicted: float
    truth_before: float
    truth_after: float
    sightings: int
    text: str


@dataclass(frozen=True)
class QualityPoint:
    """Quality of the calibrated heliostats at one moment.

    Attributes
    ----------
    at
        POSIX s.
    calibrated
        How many.
    median, ninety
        Of their predicted error, rad, the median and what nine of ten are below.
    truth_median, truth_ninety
        The same of what a twin knows; NaN for a real plant.
    """

    at: float
    calibrated: int
    median: float
    ninety: float
    truth_median: float
    truth_ninety: float


@dataclass(frozen=True)
class CalibrationView:
    """How far calibration has come.

    Attributes
    ----------
    on
        Whether it works; if not, ``reason`` says why.
    done, waiting, failed
        Heliostats with parameters from sightings, those without, measurements without success.
    running
        What goes on now.
    results
        The last ones, newest first.
    quality
        Over time, oldest first.
    """

    on: bool
    reason: str
    done: int
    waiting: int
    failed: int
    running: tuple[Running, ...]
    results: tuple[CalibrationEntry, ...]
    quality: tuple[QualityPoint, ...]


@dataclass(frozen=True)
class CameraView:
    """The last photograph of a target.

    Attributes
    ----------
    target
        Name.
    version
        Rises with each photograph; 0 before the first.
    at
        POSIX s.
    jpeg
        With what the software saw in it drawn in; b"" before the first.
    reading
        In words, line by line.
    centroid
        Right of and above the target's centre, m, or None.
    """

    target: str
    version: int
    at: float
    jpeg: bytes
    reading: tuple[str, ...] = ()
    centroid: tuple[float, float] | None = None


@dataclass(frozen=True)
class Hold:
    """A heliostat that an operator keeps out of calibration: who did it, why, since (POSIX s)."""

    heliostat: str
    who: str
    reason: str
    since: float


@dataclass(frozen=True)
class EmergencyView:
    """The last order to the whole field, with its proof.

    Attributes
    ----------
    on
        Whether it holds.
    act, who, reason
        DEFOCUS or STOW; "" for all if there was none.
    seconds
        Since the order, s.
    heliostats, acknowledged, done
        How many it went to, and how far they are.
    not_done
        Names of the first of those that have not carried it out.
    text
        In words.
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


@dataclass(frozen=True)
class Summary:
    """The plant in one look, for the head of a page.

    Attributes
    ----------
    name
        Of the plant.
    at
        Its time, UTC.
    heliostats, clusters
        How many.
    states
        How many heliostats are in each state, those not heard under "stale".
    clusters_alive
        How many clusters are heard.
    holder, role
        Who has the command authority; "" if nobody has.
    waiting
        Mirrors that wait to join the receiver.
    alarms
        How many are active or not acknowledged.
    emergency
        Whether one holds.
    lag
        How far the plant's time is behind, s: 0 unless the machine is too slow for its speed.
    extra
        Of the twin: its speed and the like.
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
    lag: float
    extra: Mapping[str, Any]
