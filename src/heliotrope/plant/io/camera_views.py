"""The latest photographs of a plant's targets, for display."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.camera import Camera
from heliotrope.field.target import Target
from heliotrope.imaging.annotate import annotate
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.photograph import Photograph, PhotographSettings, read_photograph
from heliotrope.imaging.targets.finding import FoundTarget, find_targets
from heliotrope.imaging.targets.rectify import LEAST_RIM, rectify, rim_of
from heliotrope.imaging.targets.view import FaceView
from heliotrope.plant.operations.views import CameraView
from heliotrope.plant.visits.photographs import Shot
from heliotrope.plant.visits.target_light import TargetLight

#: JPEG quality (0 to 100) and gamma of the displayed pictures.
_JPEG, _GAMMA = 80, 0.45
#: Caption under a photograph of a joint visit.
SEVERAL = "joint visit: several beams, distinguished by their movements over many photographs"


class Views:
    """The last photograph of each target."""

    def __init__(self) -> None:
        self._views: dict[str, CameraView] = {}

    def view(self, target: str) -> CameraView:
        """Return the last photograph of a target."""
        return self._views.get(target, CameraView(target, 0, 0.0, b""))

    def show(self, name: str, at: float, jpeg: bytes, line: str) -> None:
        """Store a picture that has no reading, with its time (POSIX s) and a line of text."""
        self._views[name] = CameraView(name, self.view(name).version + 1, at, jpeg, (line,))

    def keep(self, name: str, at: float, seen: Photograph, jpeg: bytes) -> None:
        """Store the reading of a target, with its time (POSIX s) and its picture."""
        reading = seen.reading(name)
        lines = [f"{reason.name}: {reason.text}" for reason in reading.reasons]
        centroid = None
        if reading.spots:
            x, y = reading.spots[0].plane
            centroid = float(x), float(y)
            spots = "1 spot" if len(reading.spots) == 1 else f"{len(reading.spots)} spots"
            lines.insert(0, f"{spots}, {x:+.3f} m right, {y:+.3f} m up")
        version = self.view(name).version + 1
        self._views[name] = CameraView(name, version, at, jpeg, tuple(lines), centroid)


def light_of(
    frame: Frame,
    target: Target,
    targets: Sequence[Target],
    camera: Camera,
    settings: PhotographSettings,
    view: FaceView | None,
    at: float,
) -> TargetLight:
    """Return the light on a target in a frame taken at ``at``, monotonic s.

    The target is searched for among the camera's targets, unless its view is given.

    Raises
    ------
    InputError
        If the target is not found.
    """
    linear = frame.linear(settings.gamma)
    found: Sequence[FoundTarget] = ()
    if view is None:
        found = find_targets(linear, targets, camera, (), settings.pictures)
        own = next(one for one in found if one.target.name == target.name)
        if own.view is None:
            raise InputError(f"target {target.name}: {own.reason}; check the camera")
        view = own.view
        found = [one for one in found if one.view is view]
    rim = max(LEAST_RIM, rim_of(found))
    picture = rectify(linear, view, rim=rim)
    return TargetLight.of(picture, target, frame.exposure * frame.gain, at)


def beam_of(
    frame: Frame,
    targets: Sequence[Target],
    camera: Camera,
    settings: PhotographSettings,
    without: Frame | None = None,
) -> tuple[Photograph, bytes]:
    """Return a frame's evaluation (see `read_photograph`) and its picture for display."""
    seen = read_photograph(frame, targets, camera, settings=settings, without=without)
    return seen, picture_of(seen)


def shot_of(seen: Photograph, target: str, at: float) -> Shot:
    """Return the beam on a target in a photograph taken at ``at``, monotonic s."""
    reading = seen.reading(target)
    reasons = tuple(f"{reason.name}: {reason.text}" for reason in reading.reasons)
    if not reading.spots:
        return Shot(np.full(3, np.nan), at, 0.0, reasons)
    spot = reading.spots[0]
    return Shot(spot.point, at, spot.covariance_enu, reasons)


def picture_of(seen: Photograph) -> bytes:
    """Return a photograph with targets and spots drawn in, as a JPEG."""
    import cv2

    _, data = cv2.imencode(".jpg", annotate(_brightened(seen)), [cv2.IMWRITE_JPEG_QUALITY, _JPEG])
    return data.tobytes()


def _brightened(seen: Photograph) -> Photograph:
    """Return a brightened photograph.

    Without brightening, the target would look black beside a beam.
    """
    frame = seen.frame
    top = 255.0 if frame.pixels.dtype == np.uint8 else 65535.0
    table = np.round(255.0 * np.linspace(0.0, 1.0, int(top) + 1) ** _GAMMA).astype(np.uint8)
    pixels: npt.NDArray[np.uint8] = table[frame.pixels]
    return replace(seen, frame=replace(frame, pixels=pixels))
