"""Real photographs of the Jülich tower, and simulated beams on real paint."""

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.field.formats.paint import read_tower
from heliotrope.imaging.annotate import LONGEST, annotate
from heliotrope.imaging.files import read_image
from heliotrope.imaging.photograph import Photograph, read_photograph
from support.data import juelich

SCRIPTS = Path(__file__).parents[2] / "scripts"
#: Frames of the solar tower, which show both of its targets, and of the multi-focus tower.
BOTH = ("137608-raw", "213508-raw", "215701-raw", "216331-raw", "99927-raw", "stj_image")
ONE = ("203718-raw", "mft_image")
#: How many other spots each frame shows.
OTHERS = {
    "137608-raw.png": 1,
    "203718-raw.png": 0,
    "213508-raw.png": 1,
    "215701-raw.png": 1,
    "216331-raw.png": 3,
    "99927-raw.png": 2,
}


def _script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("spot_figures", SCRIPTS / "spot_figures.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def figures() -> ModuleType:
    """The script that prints the figures."""
    pytest.importorskip("cv2")
    return _script()


def _read(name: str) -> Photograph:
    data = juelich()
    tower = read_tower(data / "tower-measurements.json")
    return read_photograph(
        read_image(data / "images" / "target-camera" / f"{name}.png"), tower.targets
    )


@pytest.mark.parametrize("name", BOTH)
def test_both_targets_of_the_solar_tower_are_found(name: str) -> None:
    photograph = _read(name)
    upper, lower = (photograph.reading(f"solar_tower_juelich_{n}") for n in ("upper", "lower"))
    assert upper.found.found
    assert lower.found.found
    assert not photograph.reading("multi_focus_tower").found.found
    assert photograph.reading("multi_focus_tower").found.reason
    # All eight marks lie within 5 mm of where they were surveyed: 0.7 px.
    view = upper.found.view
    assert view is not None
    assert sum(m.used for m in (*upper.found.marks, *lower.found.marks)) == 10
    assert view.residual < 1.2
    place = view.face.plane(upper.found.target.center)
    assert np.sqrt(np.linalg.eigvalsh(view.covariance_at(place))[-1]) < 0.01


@pytest.mark.parametrize("name", ONE)
def test_the_multi_focus_tower_is_found(name: str) -> None:
    photograph = _read(name)
    assert photograph.reading("multi_focus_tower").found.found
    assert not photograph.reading("solar_tower_juelich_upper").found.found


@pytest.mark.parametrize(
    ("name", "target"),
    [
        ("stj_image", "solar_tower_juelich_upper"),
        ("stj_image", "solar_tower_juelich_lower"),
        ("mft_image", "multi_focus_tower"),
    ],
)
def test_frames_without_references_give_a_spot(name: str, target: str) -> None:
    reading = _read(name).reading(target)
    assert reading.good, reading.reasons
    assert reading.spots[0].deviation < 0.06


def test_raw_frames_agree_with_the_published_centroids(figures: ModuleType) -> None:
    seen = 0
    for found in figures.raw(juelich()):
        reading = found.photograph.reading(found.target)
        others = [
            s
            for r in found.photograph.readings
            for k, s in enumerate(r.spots)
            if (r is not reading or k > 0) and s.spot.power > 0.1
        ]
        assert len(others) + len(found.photograph.beside) >= OTHERS[found.name], found.name
        if not reading.good:
            # Three faint beams, a shadow's edge and a beam on a mark: refused, with a reason.
            assert found.name == "216331-raw.png", reading.reasons
            assert [r.name for r in reading.reasons] == ["uncertain"]
            continue
        seen += 1
        assert min(found.apart.values()) < 0.15, found.name
        if found.references < 0.2:
            assert max(found.apart.values()) < 0.25, found.name
    assert seen == 5


def test_crops_agree_with_the_published_centroids(figures: ModuleType) -> None:
    found = list(figures.crops(juelich()))
    assert len(found) == 90
    utis = np.array([f.apart.get("UTIS", np.nan) for f in found])
    helios = np.array([f.apart.get("HeliOS", np.nan) for f in found])
    assert np.nanmedian(utis) <= 0.05
    # The two extractors are 0.08 m apart: nobody is near both.
    assert np.nanmedian(helios) <= 0.10
    good = np.array([f.photograph.reading(f.target).good for f in found])
    assert good.mean() > 0.75
    # What is accepted is near one of the two; the picture with two beams is refused.
    nearest = np.fmin(utis, helios)
    assert np.max(nearest[good]) < 0.35
    assert np.percentile(nearest[good], 95) < 0.12


def test_simulated_beams_on_real_paint(figures: ModuleType) -> None:
    data = juelich()
    target = figures.hybrid_target(data)
    errors, squares = [], []
    for _, hybrid in figures.compositions(data, 100):
        error, square, _ = figures.hybrid_error(hybrid, target)
        errors.append(error)
        squares.append(square)
    assert len(errors) == 400
    assert np.isfinite(errors).all()
    assert np.median(errors) <= 1.0
    assert np.percentile(errors, 90) <= 3.0
    assert abs(np.mean(np.array(squares) < 2.279) - 0.68) <= 0.06


@pytest.mark.parametrize("name", ["99927-raw", "203718-raw"])
def test_annotated_pictures_show_what_was_seen(name: str) -> None:
    photograph = _read(name)
    drawn = annotate(photograph)
    height, width = photograph.frame.pixels.shape[:2]
    factor = LONGEST / max(height, width)
    plain = cv2.resize(
        photograph.frame.pixels,
        (round(width * factor), round(height * factor)),
        interpolation=cv2.INTER_AREA,
    )
    changed = np.abs(drawn[: plain.shape[0]].astype(int) - plain.astype(int)).max(axis=-1) > 20
    assert drawn.shape[0] > plain.shape[0], "nothing is said under the picture"
    for reading in photograph.readings:
        for mark in reading.found.marks:
            column, row = (mark.pixel * factor).astype(int)
            assert changed[row - 6 : row + 7, column - 6 : column + 7].any(), mark.mark.name
        for spot in reading.spots:
            column, row = (spot.pixel * factor).astype(int)
            assert changed[row - 6 : row + 7, column - 6 : column + 7].any()


def _blank(value: float, shape: tuple[int, int] = (40, 40)) -> Any:
    return np.full(shape, value)


def test_composition_has_the_truth_and_the_contrast_it_says(figures: ModuleType) -> None:
    y, x = np.mgrid[:40, :40]
    beam = np.exp(-((x - 18.0) ** 2 + (y - 21.0) ** 2) / 18.0)
    made = figures.compose(_blank(100.0), beam, (4, -3), contrast=0.5, peak=0.9)
    assert made.truth == pytest.approx([22.0, 18.0], abs=1e-3)
    pixels = made.frame.pixels.astype(float)
    assert pixels.max() == pytest.approx(0.9 * 255.0, abs=0.5)
    assert pixels.max() / pixels[0, 0] == pytest.approx(1.5, abs=0.01)
    light = pixels - pixels[0, 0]
    seen = [(light * g).sum() / light.sum() for g in (x, y)]
    assert seen == pytest.approx([22.0, 18.0], abs=0.05)


@pytest.mark.parametrize(
    ("empty", "beam", "text"),
    [
        (_blank(1.0), _blank(1.0, (40, 30)), r"empty \(40, 40\) and beam \(40, 30\) must be two"),
        (_blank(1.0), _blank(0.0), "the beam has no light"),
    ],
)
def test_composition_refuses(figures: ModuleType, empty: Any, beam: Any, text: str) -> None:
    with pytest.raises(InputError, match=text):
        figures.compose(empty, beam, (0, 0), 1.0, 0.9)
