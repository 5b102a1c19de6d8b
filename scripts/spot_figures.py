"""Print the accuracy of spots on real photographs of Jülich, and write contact sheets.

python scripts/spot_figures.py DATA [OUT]

DATA holds images/target-camera, images/aa39-cropped, images/hybrid and
tower-measurements.json. OUT (default out/spots) gets annotated pictures and contact sheets.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.formats.paint import Tower, read_calibration_properties, read_tower
from heliotrope.field.target import Target
from heliotrope.geometry import geodetic_to_enu
from heliotrope.imaging.annotate import annotate
from heliotrope.imaging.files import read_image, write_image
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.photograph import Photograph, read_crop, read_photograph

Floats = npt.NDArray[np.float64]

#: The crops are in older coordinates: metres east, north and up to be added.
OLDER = np.array([1.626, 0.054, 0.0])
#: Peaks of the simulated beams, as multiples of the mean background.
CONTRASTS = (0.25, 0.5, 1.0, 2.0)
#: χ² of two dimensions at 68 % and 95 %.
ELLIPSES = (2.279, 5.991)


@dataclass(frozen=True)
class Hybrid:
    """A composed picture.

    Attributes
    ----------
    frame
        Grey, 8 bit.
    truth
        The beam's centroid, pixels (column, row), (2,).
    """

    frame: Frame
    truth: Floats


def compose(
    empty: npt.ArrayLike,
    beam: npt.ArrayLike,
    shift: tuple[int, int],
    contrast: float,
    peak: float,
    name: str = "",
) -> Hybrid:
    """Return a photograph of an empty target with a simulated beam on it: real paint, exact truth.

    The picture is empty + contrast · beam · (mean of empty / maximum of beam), scaled to
    a peak.

    Parameters
    ----------
    empty
        Photograph of the empty target, grey, (H, W).
    beam
        Flux of the beam, any unit, (H, W).
    shift
        Shift of the beam to the right and down, px; light that leaves the picture is lost, but
        still counts in the truth.
    contrast
        Ratio of the beam's peak to the mean background.
    peak
        Brightest pixel, as a share of full scale.
    name
        Name of the frame.

    Raises
    ------
    InputError
        If the shapes differ, or the beam has no light.
    """
    paint, light = np.asarray(empty, dtype=np.float64), np.asarray(beam, dtype=np.float64)
    if paint.ndim != 2 or paint.shape != light.shape:
        raise InputError(
            f"empty {paint.shape} and beam {light.shape} must be two pictures of one size"
        )
    if not light.max() > 0.0:
        raise InputError("the beam has no light")
    rows, columns = light.shape
    right, down = shift
    moved = np.zeros_like(light)
    rows_to = slice(max(down, 0), rows + min(down, 0))
    rows_from = slice(max(-down, 0), rows + min(-down, 0))
    columns_to = slice(max(right, 0), columns + min(right, 0))
    columns_from = slice(max(-right, 0), columns + min(-right, 0))
    moved[rows_to, columns_to] = light[rows_from, columns_from]
    picture = paint + contrast * moved * (paint.mean() / light.max())
    picture = picture * (peak * 255.0 / picture.max())
    total = light.sum()
    truth = np.array(
        [light.sum(axis=0) @ np.arange(columns), light.sum(axis=1) @ np.arange(rows)]
    ) / total + np.array([right, down], dtype=np.float64)
    pixels = np.clip(np.round(picture), 0.0, 255.0).astype(np.uint8)
    return Hybrid(Frame(pixels, name), truth)


@dataclass(frozen=True)
class Compared:
    """A picture and its references.

    Attributes
    ----------
    name
        Name of the picture.
    photograph
        The photograph as read.
    target
        Target that the beam was sent to.
    apart
        Distances from the published centroids by extractor, m.
    references
        Distance between the two published centroids, m.
    """

    name: str
    photograph: Photograph
    target: str
    apart: dict[str, float]
    references: float


def references(path: Path, tower: Tower, shift: Floats) -> tuple[Target, dict[str, Floats]]:
    """Return the target of a picture and its published centroids in the target's plane, m."""
    found = read_calibration_properties(path)
    target = next(t for t in tower.targets if t.name == found.target)
    centroids = {
        name: target.plane_coordinates(geodetic_to_enu(*place, tower.origin) + shift)
        for name, place in found.focal_spots.items()
    }
    return target, centroids


def _compared(
    name: str, photograph: Photograph, target: Target, published: dict[str, Floats]
) -> Compared:
    spots = photograph.reading(target.name).spots
    apart = {
        key: float(np.linalg.norm(spots[0].plane - place)) if spots else float("nan")
        for key, place in published.items()
    }
    both = list(published.values())
    distance = float(np.linalg.norm(both[0] - both[1])) if len(both) == 2 else float("nan")
    return Compared(name, photograph, target.name, apart, distance)


def raw(data: Path) -> Iterator[Compared]:
    """Yield the raw frames that have references."""
    tower = read_tower(data / "tower-measurements.json")
    for path in sorted((data / "images" / "target-camera").glob("*-raw.png")):
        beside = path.with_name(path.name.replace("-raw.png", "-calibration-properties.json"))
        target, published = references(beside, tower, np.zeros(3))
        photograph = read_photograph(read_image(path), tower.targets)
        yield _compared(path.name, photograph, target, published)


def crops(data: Path) -> Iterator[Compared]:
    """Yield the crops of heliostat AA39."""
    tower = read_tower(data / "tower-measurements.json")
    for path in sorted((data / "images" / "aa39-cropped").glob("*_cropped.png")):
        beside = path.with_name(path.name.replace("_cropped.png", "-calibration-properties.json"))
        target, published = references(beside, tower, OLDER)
        yield _compared(path.name, read_crop(read_image(path), target), target, published)


def compositions(data: Path, each: int, seed: int = 0) -> Iterator[tuple[float, Hybrid]]:
    """Yield seeded compositions of empty targets and beams, ``each`` for every contrast."""
    folder = data / "images" / "hybrid"
    empty = [read_image(p).grey for p in sorted((folder / "emptyTargetImages").glob("*.png"))]
    beams = [read_image(p).grey for p in sorted((folder / "fluxImages").glob("*.png"))]
    for k, contrast in enumerate(CONTRASTS):
        rng = np.random.default_rng([seed, k])
        for number in range(each):
            right, down = (int(v) for v in rng.integers(-40, 41, 2))
            paint = empty[rng.integers(len(empty))]
            light = beams[rng.integers(len(beams))]
            peak = float(rng.uniform(0.8, 1.0))
            name = f"{contrast}-{number}"
            yield contrast, compose(paint, light, (right, down), contrast, peak, name)


def hybrid_target(data: Path) -> Target:
    """Return the target of the hybrid pictures: the lower one, its marks at the corners."""
    tower = read_tower(data / "tower-measurements.json")
    return next(t for t in tower.targets if t.name == "solar_tower_juelich_lower")


def hybrid_error(hybrid: Hybrid, target: Target) -> tuple[float, float, Photograph]:
    """Return the error, px, its squared Mahalanobis distance, and the photograph read."""
    photograph = read_crop(hybrid.frame, target)
    spots = photograph.readings[0].spots
    if not spots:
        return float("nan"), float("nan"), photograph
    picture = photograph.faces[0].picture
    # The picture is square but the target is not: stretch the rows back.
    stretch = hybrid.frame.size[1] / picture.shape[0]
    column, row = picture.pixels(spots[0].spot.centroid)
    miss = np.array([column, (row + 0.5) * stretch - 0.5]) - hybrid.truth
    to_pixels = np.diag([1.0, -stretch]) / picture.step
    covariance = to_pixels @ spots[0].covariance @ to_pixels.T
    return float(np.linalg.norm(miss)), float(miss @ np.linalg.solve(covariance, miss)), photograph


def sheet(pictures: list[tuple[str, Photograph]], path: Path, across: int = 6) -> None:
    """Write annotated pictures side by side, each with its text."""
    tiles = []
    for text, photograph in pictures:
        tile = cv2.resize(annotate(photograph)[: 3 * 256], (300, 300), interpolation=cv2.INTER_AREA)
        cv2.putText(tile, text, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (66, 228, 240), 1)
        tiles.append(tile)
    if not tiles:
        return
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % across)
    rows = [np.hstack(tiles[i : i + across]) for i in range(0, len(tiles), across)]
    write_image(Frame(np.ascontiguousarray(np.vstack(rows))), path)


def _show_raw(data: Path, out: Path) -> None:
    print("raw frames: distance from the published centroids, m")
    for found in raw(data):
        reading = found.photograph.reading(found.target)
        said = "good" if reading.good else "; ".join(r.text for r in reading.reasons)
        apart = ", ".join(f"{k} {v:.3f}" for k, v in found.apart.items())
        print(f"  {found.name}: {apart} (apart {found.references:.3f}); {said}")
        write_image(annotate(found.photograph), out / f"{Path(found.name).stem}-seen.png")


def _show_crops(data: Path, out: Path) -> dict[str, float]:
    found = list(crops(data))
    figures = {
        key: float(np.nanmedian([f.apart.get(key, np.nan) for f in found]))
        for key in ("UTIS", "HeliOS")
    }
    good = [f for f in found if f.photograph.reading(f.target).good]
    print(f"crops: {len(found)}, accepted {len(good)}; medians:", end="")
    print(*(f" {key} {value:.3f} m" for key, value in figures.items()), sep=",")
    failures = [
        (f"{f.name.split('_')[0]} {f.apart.get('UTIS', np.nan):.2f} m", f.photograph)
        for f in found
        if f not in good or max(f.apart.values()) > 0.15
    ]
    sheet(failures, out / "aa39-failures.png")
    print(f"  refused, or more than 0.15 m from one: {len(failures)}, in {out}/aa39-failures.png")
    return figures


def _show_hybrid(data: Path, out: Path, each: int) -> dict[str, object]:
    target = hybrid_target(data)
    errors: dict[float, list[tuple[float, float]]] = {c: [] for c in CONTRASTS}
    worst: list[tuple[float, str, Photograph]] = []
    for contrast, hybrid in compositions(data, each):
        error, square, photograph = hybrid_error(hybrid, target)
        errors[contrast].append((error, square))
        worst.append((-error, f"{contrast}: {error:.1f} px", photograph))
    worst.sort(key=lambda w: w[0])
    sheet([(text, photograph) for _, text, photograph in worst[:24]], out / "hybrid-worst.png")
    rows: dict[str, object] = {}
    everything = [pair for pairs in errors.values() for pair in pairs]
    for name, pairs in [*((str(c), p) for c, p in errors.items()), ("all", everything)]:
        size, square = np.array(pairs).T
        inside = [float(np.mean(square < limit)) for limit in ELLIPSES]
        rows[name] = {
            "count": len(pairs), "median_px": float(np.nanmedian(size)),
            "p90_px": float(np.nanpercentile(size, 90)), "none": int(np.isnan(size).sum()),
            "in_68": inside[0], "in_95": inside[1],
        }  # fmt: skip
        print(
            f"  contrast {name}: median {np.nanmedian(size):.2f} px, 90 % below "
            f"{np.nanpercentile(size, 90):.2f} px, {inside[0]:.0%} in the 68 % ellipse, "
            f"{inside[1]:.0%} in the 95 % one"
        )
    return rows


def main() -> None:
    """Print the figures and write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path, nargs="?", default=Path("out/spots"))
    parser.add_argument("--each", type=int, default=100, help="compositions for each contrast")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    _show_raw(given.data, given.out)
    figures: dict[str, object] = {"crops": _show_crops(given.data, given.out)}
    print("simulated beams on photographs of empty targets")
    figures["hybrid"] = _show_hybrid(given.data, given.out, given.each)
    (given.out / "figures.json").write_text(json.dumps(figures, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
