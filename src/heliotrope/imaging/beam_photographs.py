"""Photographs of one mirror's beam, as the learning of its surface needs them.

A folder has pictures that show exactly one target each, beside PAINT's calibration properties:
``ID-calibration-properties.json`` with ``ID.png``, ``ID_cropped.png``, ``ID-cropped.png`` or
``ID-flux.png``. The mirror's normal follows from the sun and the beam's centroid; without a sun in
the file, the normal follows from the drive counts, and the sun from the normal and the centroid.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from heliotrope.errors import FormatError, InputError
from heliotrope.field.formats.frames import orientation
from heliotrope.field.formats.paint import CalibrationProperties, read_calibration_properties
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, bisector, direction, normalize, reflect
from heliotrope.imaging.files import read_image
from heliotrope.optics.learnt_surface import BeamPhotograph
from heliotrope.optics.mirror_image import Beam

_ENDS = (".png", "_cropped.png", "-cropped.png", "-flux.png")
_PROPERTIES = "-calibration-properties.json"
#: Share of the pixels, the darkest ones, from which the background is found first.
_DARK = 0.7
#: The background's pixels lie within this many standard deviations, and a beam above the second.
_WITHIN, _ABOVE = 2.5, 2.0
#: Smoothing before the beam is outlined, and margin about the outline, px.
_SMOOTH, _MARGIN = 2.0, 6
#: Share of the light at the picture's border above which a beam counts as cut off.
_CUT = 0.004
_ROUNDS = 8
#: Size of a beam in a picture of several, px.
_SHOWN = 240


@dataclass(frozen=True)
class BeamFolder:
    """The photographs of a folder.

    Attributes
    ----------
    names, photographs
        Usable photographs and the names of their files.
    left_out
        A line for each of the others.
    """

    names: tuple[str, ...]
    photographs: tuple[BeamPhotograph, ...]
    left_out: tuple[str, ...]


def read_beams(plant: Plant, folder: str | Path, heliostat: str) -> BeamFolder:
    """Return the photographs of a heliostat's beam in a folder; see the module.

    Raises
    ------
    FormatError
        If the folder contains no photograph with its properties, or a file cannot be read.
    UnknownNameError
        If the plant has no heliostat or target of a name.
    """
    place = Path(folder)
    group, row = plant.find(heliostat)
    files = sorted(place.glob(f"*{_PROPERTIES}")) if place.is_dir() else []
    names, result, left_out = [], [], []
    for file in files:
        start = file.name.removesuffix(_PROPERTIES)
        picture = next((p for end in _ENDS if (p := place / f"{start}{end}").is_file()), None)
        if picture is None:
            left_out.append(f"{file.name}: there is no picture {start}.png beside it")
            continue
        properties = read_calibration_properties(file)
        target = plant.target(properties.target)
        try:
            beam = beam_of_crop(read_image(picture).grey, target)
        except InputError as error:
            left_out.append(f"{picture.name}: {error}")
            continue
        names.append(picture.name)
        mechanism = group.take(np.array([row])).calibrated
        R, vertex = orientation(mechanism, np.array([properties.motors]))
        result.append(_posed(target, beam, properties, R[0], vertex[0]))
    if not files:
        raise FormatError(
            place,
            f"there is no ID{_PROPERTIES}; put pictures of the target and their properties there",
        )
    return BeamFolder(tuple(names), tuple(result), tuple(left_out))


def _posed(
    target: Target, beam: Beam, properties: CalibrationProperties, R: FloatArray, vertex: FloatArray
) -> BeamPhotograph:
    ray = normalize(target.point(beam.centroid) - vertex)
    if np.isfinite(properties.sun_elevation_deg):
        # In the files, 0 is south and east is positive.
        azimuth = np.pi - np.radians(properties.sun_azimuth_deg)
        sun = direction(azimuth, np.radians(properties.sun_elevation_deg))
        normal = bisector(sun, ray)
        right = normalize(R[:, 0] - (R[:, 0] @ normal) * normal)
        R = np.stack([right, np.cross(normal, right), normal], axis=-1)
    else:
        sun = reflect(ray, R[:, 2])
    return BeamPhotograph(target, beam, vertex, R, sun)


def beam_of_crop(picture: FloatArray, target: Target) -> Beam:
    """Return the light of the beam in a picture that shows exactly one target.

    The background is a quadratic surface through the pixels beside the beam; the beam is the
    brightest connected region above it.

    Parameters
    ----------
    picture
        Top row first, proportional to light, (H, W).
    target
        The target.

    Raises
    ------
    InputError
        If there is no beam, or it is cut off by the picture's border.
    """
    from scipy.ndimage import binary_dilation, gaussian_filter, label, map_coordinates
    from scipy.ndimage import sum as sums_of

    values = np.asarray(picture, dtype=np.float64)
    y, x = np.indices(values.shape) / max(values.shape)
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1).reshape(-1, 6)
    flat, level = values.ravel(), gaussian_filter(values, _SMOOTH)
    chosen = (level <= np.quantile(level, _DARK)).ravel()
    for _ in range(_ROUNDS):
        rest = flat - terms @ np.linalg.lstsq(terms[chosen], flat[chosen], rcond=None)[0]
        spread = 1.4826 * float(np.median(np.abs(rest[chosen]))) + 1e-9
        chosen = np.abs(rest) <= _WITHIN * spread
    light = rest.reshape(values.shape)
    regions, count = label(gaussian_filter(light, _SMOOTH) > _ABOVE * spread)
    if not count:
        raise InputError("no beam brighter than the target")
    strongest = 1 + int(np.argmax(sums_of(light, regions, range(1, count + 1))))
    own = binary_dilation(regions == strongest, iterations=_MARGIN)
    light = np.where(own, np.maximum(light, 0.0), 0.0)
    border = light[:2].sum() + light[-2:].sum() + light[:, :2].sum() + light[:, -2:].sum()
    if border > _CUT * light.sum():
        raise InputError("the beam reaches the border of the target")
    step = min(target.width / values.shape[1], target.height / values.shape[0])
    rows, columns = (int(side / step) for side in (target.height, target.width))
    across = (np.arange(columns) + 0.5) * step / target.width * values.shape[1] - 0.5
    down = (np.arange(rows) + 0.5) * step / target.height * values.shape[0] - 0.5
    square = map_coordinates(light, np.meshgrid(down, across, indexing="ij"), order=1)
    middle = target.plane_coordinates(target.corners.mean(axis=0))
    return Beam.from_image(square, step, middle)


def draw_beams(path: str | Path, pairs: Sequence[tuple[Beam, Beam]], most: int = 12) -> None:
    """Write a picture of measured beams (above) and predicted ones (below), side by side."""
    from heliotrope.imaging.files import write_image
    from heliotrope.imaging.frame import Frame

    columns = []
    for measured, predicted in pairs[:most]:
        y, x = np.indices(measured.flux.shape)
        places = measured.origin + measured.step * np.stack([x, y], axis=-1)
        both = [measured.flux, predicted.at(places)]
        top = max(image.max() for image in both)
        image = np.vstack([image[::-1] for image in both]) / top
        size = _SHOWN / max(measured.flux.shape)
        tall, wide = (max(1, round(n * size)) for n in measured.flux.shape)
        rows = np.arange(2 * tall) * image.shape[0] // (2 * tall)
        across = np.arange(wide) * image.shape[1] // wide
        shown = np.zeros((2 * _SHOWN, _SHOWN), dtype=np.uint8)
        small = np.clip(255.0 * image[np.ix_(rows, across)], 0.0, 255.0).astype(np.uint8)
        shown[:tall, :wide], shown[_SHOWN : _SHOWN + tall, :wide] = small[:tall], small[tall:]
        columns.append(shown)
    write_image(Frame(np.hstack(columns)), path)
