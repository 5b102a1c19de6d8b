"""The target search: a lost mirror moves its beam in a spiral until a camera sees it.

A mirror whose installation is unknown misses the target. Its local controller turns the beam in
a spiral about the aim (SEARCH); the camera's frames are compared with what was there before. At
the first light that appears the spiral ends, and what the axes stood at is the first sighting.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.motion import (
    DEFAULT,
    Motion,
    MotionDetector,
    MotionSettings,
    MotionState,
)
from heliotrope.lcu import states
from heliotrope.links.clock import sleep_until
from heliotrope.plant.authority import Person, RefusedError
from heliotrope.plant.controller import PlantController
from heliotrope.plant.visits.visit import Visit

#: Frames that the detector looks at before the beam may come.
WARM_UP = 5


class FrameCamera(Protocol):
    """Gives frames of a target."""

    async def frame(self) -> Frame:
        """Return what is seen now."""
        ...


@dataclass(frozen=True)
class Search:
    """What a search is to cover.

    Attributes
    ----------
    pitch, radius
        Distance between neighbouring points and turns, and largest offset, rad of the beam.
    period
        Between frames, s; the spiral rests 2 s on each point.
    limit
        For the whole spiral, s.
    settings
        What counts as motion.
    """

    pitch: float
    radius: float
    period: float = 1.0
    limit: float = 3600.0
    settings: MotionSettings = DEFAULT


@dataclass(frozen=True)
class Found:
    """How a search ended.

    Attributes
    ----------
    seen
        Whether light appeared.
    motion
        What was seen, in pixels of the frame.
    counts
        Of the axes when it was seen, (2,); NaN if nothing was.
    at
        Then, monotonic s.
    frames
        How many were looked at while it searched.
    text
        One line.
    """

    seen: bool
    motion: Motion
    counts: FloatArray
    at: float
    frames: int
    text: str


async def search(
    plant: PlantController,
    person: Person,
    token: int,
    heliostat: str,
    target: str,
    camera: FrameCamera,
    wanted: Search,
    *,
    mask: npt.ArrayLike | None = None,
) -> Found:
    """Search for a heliostat's beam on a target; it ends at standby.

    Parameters
    ----------
    plant
        Running.
    person, token
        With the token of the authority, which they keep up meanwhile.
    heliostat, target
        Names. The heliostat is at standby or tracks.
    camera
        Sees the target.
    wanted
        What to cover.
    mask
        Where light counts, (H, W).

    Raises
    ------
    RefusedError
        If a command is refused, or the heliostat is in another state.
    UnknownNameError
        If there is no such heliostat or target.
    """
    visit = Visit(plant, person, token, heliostat, plant.design.target(target))
    state = visit.state
    if state not in (states.IDLE, states.TRACKING):
        raise RefusedError(
            f"{heliostat} is {states.STATES[state]}; bring it to standby (APPROACH) first"
        )
    if state == states.TRACKING:
        # What the target shows without this beam is learnt first.
        await visit.command("IDLE")
    detector = MotionDetector(mask, wanted.settings, warm_up=WARM_UP)
    for _ in range(WARM_UP + 1):
        detector.update(await camera.frame())
        await sleep_until(plant.clock, plant.now() + wanted.period)
    visit.away = True
    async with visit:
        await visit.aim(visit.target.center)
        await visit.command("SEARCH", (wanted.pitch, wanted.radius))
        return await _watch(visit, camera, detector, wanted)


async def _watch(
    visit: Visit, camera: FrameCamera, detector: MotionDetector, wanted: Search
) -> Found:
    plant, motion, frames = visit.plant, Motion(), 0
    until = plant.now() + wanted.limit
    nothing = np.full(2, np.nan)
    while visit.state == states.SEARCHING and plant.now() < until:
        due = plant.now() + wanted.period
        at = plant.now()
        verdict, motion = detector.update(await camera.frame())
        frames += 1
        came = verdict is MotionState.MOVING and any(r.appeared for r in motion.regions)
        if came:
            counts = await visit.counts_at(at)
            text = f"{visit.heliostat}: light on {visit.target.name} after {frames} frames"
            return Found(True, motion, counts, at, frames, text)
        while plant.now() < due:
            await visit.look()
    why = "the spiral is at its end" if plant.now() < until else f"{wanted.limit:g} s are over"
    text = f"{visit.heliostat}: nothing seen on {visit.target.name} in {frames} frames; {why}"
    return Found(False, motion, nothing, plant.now(), frames, text)
