"""The flux on the receiver from its camera: the port `plant.ports.Sensors` for `FLUX_READING`.

Once per second the newest frame from the receiver camera is compared with a reference
(`imaging.receiver_light`). A reading counts from the earliest moment at which its frame may have
been exposed. A frame that may hide light, repeats the previous frame, or is old yields no reading;
the last reading then becomes stale, and the proof of an emergency assumes that there is light.
"""

import asyncio
import math
import re
from collections.abc import Callable
from datetime import datetime
from functools import partial

import numpy as np

from heliotrope.errors import HeliotropeError, InputError
from heliotrope.field.camera import Camera, project
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Frame, Pixels
from heliotrope.imaging.receiver_light import ReceiverLight, ReceiverReference, receiver_light
from heliotrope.links.clock import Clock
from heliotrope.optics import surface_of
from heliotrope.plant.io.cameras import dated
from heliotrope.plant.io.sensors import Readings
from heliotrope.plant.ports import Cameras
from heliotrope.safety import FLUX_READING
from heliotrope.safety.proof import FLUX_AGE, FLUX_LIMIT

#: Interval between two readings, s.
EVERY = 1.0
#: A frame may be this far ahead of the plant's clock, s.
AHEAD = 0.5


def check_reference(design: Plant, reference: ReceiverReference) -> None:
    """Check that a reference fits a plant.

    Raises
    ------
    InputError
        If the receiver or the camera does not exist, there are several receivers, the frames have
        another size, or receiver visits use another camera.
    """
    sight = reference.sight
    who = f"{FLUX_READING}: a reference of receiver {sight.receiver}, camera {sight.camera}"
    names = [receiver.name for receiver in design.receivers]
    if names != [sight.receiver]:
        have = ", ".join(names) or "none"
        raise InputError(
            f"{who}; the plant's receivers: {have}; a camera can supply this reading only if the "
            f"plant has exactly one receiver"
        )
    camera = next((each for each in design.cameras if each.name == sight.camera), None)
    if camera is None:
        have = ", ".join(each.name for each in design.cameras) or "none"
        raise InputError(f"{who}; the plant's cameras: {have}; add it to the plant file")
    if camera.size != sight.size:
        raise InputError(
            f"{who} of {sight.size[0]} × {sight.size[1]} px, but the plant file says "
            f"{camera.size[0]} × {camera.size[1]} px; record the reference again"
        )
    visits = design.receiver_visits
    if visits is not None and visits.receiver == sight.receiver and visits.camera != sight.camera:
        raise InputError(
            f"{who}, but receiver visits use camera {visits.camera}; record the reference with "
            f"that camera"
        )


def flux_by(
    cameras: Cameras, clock: Clock, reference: ReceiverReference, receiver: Receiver
) -> "ReceiverFlux":
    """Return the flux sensor of a receiver, which uses the plant camera that observes it.

    Its readings include a map if the receiver is planar and the camera's pose is known.

    Raises
    ------
    UnknownNameError
        If no camera observes the receiver.
    """
    eye = cameras.eye(receiver.name)
    newest = partial(cameras.frame, receiver.name)
    return ReceiverFlux(eye, newest, clock, reference, cell_places(receiver, eye))


def cell_places(receiver: Receiver, eye: Camera) -> FloatArray | None:
    """Return the pixels of a receiver's cells, (H, W, 2); None if the camera cannot map them."""
    if receiver.kind != "planar" or eye.position is None:
        return None
    cells = surface_of(receiver).cells
    return project(eye, cells.center.reshape(*cells.shape, 3))


class ReceiverFlux:
    """The flux on the receiver, measured by its camera.

    Parameters
    ----------
    eye
        The camera.
    newest
        Function that returns the camera's newest frame, or raises a `HeliotropeError` if there is
        none.
    clock
        Clock of the plant.
    reference
        Reference of this camera.
    places
        Pixels of the receiver's cells, (H, W, 2); None: only the total is measured.

    Attributes
    ----------
    names
        Name of the only reading.
    """

    def __init__(
        self,
        eye: Camera,
        newest: Callable[[], Frame],
        clock: Clock,
        reference: ReceiverReference,
        places: FloatArray | None = None,
    ) -> None:
        self.names = frozenset({FLUX_READING})
        self._eye, self._newest, self._clock = eye, newest, clock
        self._reference, self._places = reference, places
        self._read_at = -math.inf
        self._seen: tuple[datetime, Pixels] | None = None
        self._kind = ""

    async def news(self) -> Readings:
        """Return a reading each second, or the reason why there is none."""
        now = self._clock.monotonic()
        if now - self._read_at < EVERY:
            return Readings()
        self._read_at = now
        found = Readings()
        try:
            problem = await self._read(found)
        except HeliotropeError as error:
            problem = str(error)
        except Exception as error:  # noqa: BLE001 - of OpenCV; other sensors are read beside it
            problem = f"camera {self._eye.name}: {type(error).__name__}: {error}"
        if problem is None:
            return found
        # The numbers in the text change each second; the alarm is raised once.
        kind = re.sub(r"[\d.]+", "", problem)
        if kind != self._kind:
            found.problems[FLUX_READING] = problem
            self._kind = kind
        return found

    async def _read(self, found: Readings) -> str | None:
        """Take a reading; return why there is none.

        Returns an empty text if there is a reading, and None if the frame is not new.
        """
        frame, who = self._newest(), f"camera {self._eye.name}"
        made = dated(frame, self._eye)
        age = (self._clock.utc() - made).total_seconds()
        if age > FLUX_AGE:
            return f"{who}: its newest frame is {age:.0f} s old, the limit is {FLUX_AGE:g} s"
        if age < -AHEAD:
            return (
                f"{who}: its newest frame is {-age:.1f} s ahead of the plant's clock; set the "
                "camera's clock"
            )
        if self._seen is not None and made == self._seen[0]:
            return None
        light = await asyncio.to_thread(self._measure, frame)
        self._seen = made, frame.pixels
        if light is None:
            return (
                f"{who}: successive frames are identical in every pixel, so the camera has frozen"
            )
        # To show that there is light, the camera need not see all of it.
        if light.doubt and not light.share >= FLUX_LIMIT:
            return f"{who}: {light.doubt}"
        found.values[FLUX_READING] = light.share
        whole = np.array(light.share) if light.cells is None else light.cells
        found.seen[FLUX_READING] = None if light.doubt else whole
        found.made[FLUX_READING] = self._clock.monotonic() - max(
            0.0, (self._clock.utc() - made).total_seconds()
        )
        return ""

    def _measure(self, frame: Frame) -> ReceiverLight | None:
        """Return the flux in a frame; None if the frame repeats the last one."""
        if self._seen is not None:
            rows, columns = self._reference.sight.box
            before, after = self._seen[1][rows, columns], frame.pixels[rows, columns]
            # Sensor noise differs from frame to frame.
            if before.shape == after.shape and np.array_equal(before, after):
                return None
        return receiver_light(frame, self._reference, self._places)
