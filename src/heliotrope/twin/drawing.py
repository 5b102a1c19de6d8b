"""Photographs of a simulated field, rendered in a separate process.

A photograph of a hundred beams takes a second of CPU time. If it were rendered in the process of
the plant and its field, it would compete with their event loop.
"""

import multiprocessing
import signal
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess

import numpy as np

from heliotrope.errors import FetchError, HeliotropeError, InputError
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.synthetic.rendering import render
from heliotrope.imaging.synthetic.scenes import Scene, Thrown, exposed
from heliotrope.optics import Beam, reflected_beam
from heliotrope.twin.true_mirrors import NEAR, TrueMirror, within

#: Least unshaded share of a mirror for which a beam is drawn.
LEAST = 0.05
#: Step of the beams' grids, m; a beam is more than ten steps wide.
_STEP = 0.04
#: Brightest reading after exposure, as a share of full scale.
PEAK = 0.7


@dataclass(frozen=True)
class Optics:
    """Quality of the mirrors and strength of the light.

    Attributes
    ----------
    slope_error
        Standard deviation of the mirrors' normals per axis, rad.
    dni
        Direct normal irradiance, W/m².
    reflectivity
        Reflected fraction, 0 to 1.
    facets
        Numbers of facet columns and rows; facets are canted for the slant range.
    """

    slope_error: float = 1e-3
    dni: float = 850.0
    reflectivity: float = 0.9
    facets: tuple[int, int] = (2, 2)


@dataclass(frozen=True)
class Exposure:
    """The complete contents of a photograph.

    Attributes
    ----------
    scene
        The targets in the frame, without beams.
    mirrors, sun
        True mirrors whose light may be in the frame, and the unit vector to the sun, (3,).
    optics
        Mirrors and light.
    seed
        Seed of the sensor's noise.
    title, time
        Name and time of the frame.
    """

    scene: Scene
    mirrors: tuple[TrueMirror, ...]
    sun: FloatArray
    optics: Optics
    seed: int
    title: str
    time: datetime

    def draw(self) -> Frame:
        """Return the frame; the brightest point of paint or beam sets the exposure."""
        light = []
        for target in self.scene.targets:
            beams = [spot.beam for spot in thrown(target, self.mirrors, self.sun, self.optics)]
            if beams:
                light.append(Thrown(target.name, Beam.together(beams)))
        scene = exposed(replace(self.scene, beams=tuple(light)), PEAK)
        return render(scene, self.seed, name=self.title, time=self.time).frame


class Drawer:
    """A process that renders photographs; several threads may use it.

    The process starts with the first photograph or with `start`, and restarts after a photograph
    during which it died.

    Parameters
    ----------
    load
        Function that the process calls first, such as `twin.warm.drawing`; if None, the first
        photograph takes longer.
    """

    def __init__(self, load: Callable[[], None] | None = None) -> None:
        self._load = load
        self._mine = threading.Lock()
        self._process: SpawnProcess | None = None
        self._line: Connection | None = None

    def start(self) -> None:
        """Start the process, which needs several seconds until it can render."""
        with self._mine:
            self._begun()

    def draw(self, exposure: Exposure) -> Frame:
        """Return the rendered frame of an exposure.

        Raises
        ------
        FetchError
            If the process has died.
        InputError
            If rendering raises it.
        """
        with self._mine:
            line = self._begun()
            try:
                line.send(exposure)
                answer = line.recv()
            except (EOFError, OSError) as error:
                self._end()
                raise FetchError(
                    f"{exposure.title}: the process that draws photographs has ended; the next "
                    "photograph starts a new one"
                ) from error
        if isinstance(answer, str):
            raise InputError(answer)
        assert isinstance(answer, Frame)
        return answer

    def close(self) -> None:
        """End the process at once; calls that wait for a photograph raise an error."""
        if (process := self._process) is not None:
            process.kill()
        with self._mine:
            self._end()

    def _begun(self) -> Connection:
        if self._line is None:
            context = multiprocessing.get_context("spawn")
            self._line, far = context.Pipe()
            self._process = context.Process(target=_drawing, args=(far, self._load), daemon=True)
            self._process.start()
            # Now only the process holds its end, so that each side notices when the other dies.
            far.close()
        return self._line

    def _end(self) -> None:
        line, process = self._line, self._process
        self._line = self._process = None
        if line is None or process is None:
            return
        line.close()
        process.kill()
        process.join()


def _drawing(line: Connection, load: Callable[[], None] | None) -> None:
    """Render the exposures that arrive over a pipe until it is closed."""
    # Ctrl-C in the plant's terminal is meant for the plant.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if load is not None:
        load()
    while True:
        try:
            exposure: Exposure = line.recv()
        except (EOFError, OSError):
            return
        answer: Frame | str
        try:
            answer = exposure.draw()
        except HeliotropeError as error:
            answer = str(error)
        line.send(answer)


def thrown(
    target: Target, mirrors: Sequence[TrueMirror], sun: FloatArray, optics: Optics
) -> tuple[Thrown, ...]:
    """Return the beams that mirrors send onto a target or close beside it."""
    beams = []
    for mirror in mirrors:
        if not within(target, mirror.on(target, sun), NEAR):
            continue
        if mirror.lit_centroid(target, sun)[1] < LEAST:
            continue
        # Facets are canted at the distance of the target, wherever the mirror looks.
        slant = float(np.linalg.norm(target.center - mirror.vertex))
        beam = reflected_beam(
            target,
            mirror.vertex,
            sun,
            mirror.width,
            mirror.height,
            normal=mirror.normal,
            facets=optics.facets,
            focal=slant,
            slope_error=optics.slope_error,
            reflectivity=optics.reflectivity,
            dni=optics.dni,
            neighbours=mirror.neighbours,
            step=_STEP,
        )
        beams.append(Thrown(target.name, beam))
    return tuple(beams)
