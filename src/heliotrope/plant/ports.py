"""Everything that a plant needs from outside, as protocols.

A real plant and a simulated one are built by the same `plant.assembly.PlantAssembly`; they differ
only in the `Ports` that are passed in: links to clusters, cameras, sensors, a clock, and storage
for records.
"""

from collections.abc import Callable, Coroutine, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from heliotrope.field.camera import Camera
from heliotrope.field.target import Target
from heliotrope.files.disk import Disk
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.targets.view import FaceView
from heliotrope.links.clock import Clock
from heliotrope.links.link import Link
from heliotrope.plant.field.assigned import Assigned
from heliotrope.plant.field.witnesses import Witness
from heliotrope.plant.io.sensors import Sensors
from heliotrope.plant.operations.learning import Learner
from heliotrope.plant.operations.pictures import Pictures
from heliotrope.plant.operations.views import CameraView
from heliotrope.plant.orders.audit import Audit
from heliotrope.plant.visits.photographs import Shot
from heliotrope.plant.visits.target_light import Exposed
from heliotrope.plant.workers import Worker, at_once
from heliotrope.safety import Alarm
from heliotrope.store.records import Records


class Cameras(Protocol):
    """The cameras of a plant's targets."""

    def start(self, on_alarm: Callable[[Alarm], None]) -> None:
        """Begin to take frames; ``on_alarm`` is called when a camera falls silent or recovers."""
        ...

    def close(self) -> None:
        """End all cameras."""
        ...

    def sees(self, target: str) -> bool:
        """Return whether a camera observes the target."""
        ...

    def awake(self, target: str) -> bool:
        """Return whether the target's camera delivers frames, as far as is known."""
        ...

    async def look(self, target: str) -> object:
        """Photograph the target, before a beam arrives there.

        Raises
        ------
        HeliotropeError
            If there is no usable photograph; the text is for the operator.
        """
        ...

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """Return a heliostat's beam on the target in a new photograph."""
        ...

    async def expose(self, target: Target, view: FaceView | None = None) -> Exposed:
        """Photograph the target for a joint visit; see `LightCamera`.

        Raises
        ------
        FetchError, InputError
            If there is no photograph or, if the evaluation is awaited, no usable photograph.
        """
        ...

    def view(self, target: str) -> CameraView:
        """Return the last photograph of the target, for display."""
        ...

    def eye(self, target: str) -> Camera:
        """Return the camera of the target as it is now known.

        Raises
        ------
        UnknownNameError
            If no camera observes the target.
        """
        ...

    def frame(self, target: str) -> Frame:
        """Return the newest frame that shows the target.

        Raises
        ------
        FetchError, InputError
            If there is no frame.
        """
        ...

    def take_view(self, camera: Camera, target: Target, pictures: Mapping[str, FloatArray]) -> None:
        """Set the camera, target marks and reference pictures for evaluating later photographs."""
        ...


@dataclass(frozen=True)
class Ports:
    """The connections of a plant.

    Attributes
    ----------
    links
        Plant's end of the link to each cluster.
    clock
        Clock of the plant.
    audit
        Records of commands, written before the commands are sent.
    cameras
        Cameras of the targets; None: nothing is calibrated.
    sensors
        Sensors; None: no reading comes from outside.
    witnesses
        Independent witnesses of the sun, beside photographs.
    disk
        Does the disk work of the audit and the assigned points, and is closed with the plant. None:
        the work is done in the event loop, as virtual time requires.
    pictures
        Stores photographs of calibrations, and is closed with the plant. None: photographs are not
        stored.
    marks
        Plant file that stores the target views that operators mark; None: these views are lost when
        the program ends.
    file
        The plant file, which engineers may replace; None: the plant has no file of its own.
    records
        Store of sightings, events and locks; None: these are lost when the program ends.
    assigned
        Store of assigned aims and standby points; None: these points are lost when the program
        ends.
    beside
        Creates the tasks that begin before the plant and run beside it: links, clusters on this
        computer, a simulated field.
    ready
        Waits until operations may begin; by then the plant controls a simulated field.
    truth
        Returns the true tracking error of each heliostat, rad, (N,), in the order of the plant's
        field; None where it is unknown, as in every real plant.
    learner
        Learns heliostat groups at night; None: nothing is learnt, as in virtual time.
    worker
        Runs long computations outside the plant's event loop; in virtual time, inside it.
    facts
        Returns further rows of the summary, by name.
    """

    links: Mapping[str, Link]
    clock: Clock
    audit: Audit
    cameras: Cameras | None = None
    sensors: Sensors | None = None
    witnesses: Sequence[Witness] = field(default=(), kw_only=True)
    disk: Disk | None = field(default=None, kw_only=True)
    pictures: Pictures | None = field(default=None, kw_only=True)
    marks: Path | None = field(default=None, kw_only=True)
    file: Path | None = field(default=None, kw_only=True)
    records: Records | None = field(default=None, kw_only=True)
    assigned: Assigned | None = field(default=None, kw_only=True)
    beside: Callable[[], AbstractAsyncContextManager[object]] = field(
        default=nullcontext, kw_only=True
    )
    ready: Callable[[], Coroutine[Any, Any, None]] | None = field(default=None, kw_only=True)
    truth: Callable[[], FloatArray] | None = field(default=None, kw_only=True)
    learner: Learner | None = field(default=None, kw_only=True)
    worker: Worker = field(default=at_once, kw_only=True)
    facts: Callable[[], Mapping[str, Any]] = field(default=dict, kw_only=True)
