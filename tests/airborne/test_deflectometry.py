"""Deflectometry in PAINT's form (HDF5) as slope maps."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from heliotrope.airborne.mirror import tiled
from heliotrope.airborne.slopes import smooth_slopes
from heliotrope.errors import FormatError
from heliotrope.field.formats.deflectometry import find_deflectometry, read_deflectometry
from heliotrope.geometry import MRAD
from support.deflectometry_files import write_deflectometry

SHAPE = tiled(2, 2, 1.6, 1.25, gap=0.02, focal=150.0)


def test_the_slopes_of_a_surface_come_back(tmp_path: Path) -> None:
    slope = smooth_slopes(SHAPE, np.random.default_rng(1), 0.8 * MRAD)
    # Facet 3 is canted off too: that is a part of its slopes.
    slope[3] += [2.0 * MRAD, -1.0 * MRAD]
    real = SHAPE.with_slopes(slope)
    found = read_deflectometry(
        write_deflectometry(tmp_path / "A.h5", real), SHAPE.facets, SHAPE.focal
    )
    again = SHAPE.with_slopes(found)
    assert found.shape == (4, 31, 31, 2)
    rng = np.random.default_rng(2)
    for k in range(4):
        uv = rng.uniform(-0.9, 0.9, (300, 2)) * SHAPE.half_size[k]
        facet = np.full(300, k)
        error = again.slope_at(facet, uv) - real.slope_at(facet, uv)
        assert np.sqrt(np.mean(error**2)) < 0.08 * MRAD
        assert np.abs(error.mean(axis=0)).max() < 0.01 * MRAD


def test_a_canted_facet_is_measured_in_the_axes_of_the_mirror(tmp_path: Path) -> None:
    turned = SHAPE.canted([[0.0, 0.0], [1.0 * MRAD, 0.0], [0.0, 2.0 * MRAD], [0.0, 0.0]])
    found = read_deflectometry(
        write_deflectometry(tmp_path / "A.h5", turned), SHAPE.facets, SHAPE.focal
    )
    # A turn about the axis to the right lifts the upper edge; one about the upward axis lowers
    # the right one.
    wanted = np.array([[0.0, 0.0], [0.0, 1.0], [-2.0, 0.0], [0.0, 0.0]]) * MRAD
    np.testing.assert_allclose(found.mean(axis=(1, 2)), wanted, atol=0.02 * MRAD)


def _bent(root: h5py.File) -> None:
    root["facet2/surface_normals"][...] *= -1.0


def _elsewhere(root: h5py.File) -> None:
    root["facet2/surface_points"][...] += 3.0


def _short(root: h5py.File) -> None:
    del root["facet1/surface_normals"]
    root["facet1/surface_normals"] = np.zeros((3, 3))


def _linked(root: h5py.File) -> None:
    del root["facet1/surface_points"]
    root["facet1/surface_points"] = h5py.ExternalLink("other.h5", "/facet1/surface_points")


def _flat(root: h5py.File) -> None:
    del root["facet3/surface_points"]
    root["facet3/surface_points"] = np.zeros(9)


def _less(root: h5py.File) -> None:
    del root["facet4"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_bent, "facet2: a normal points backwards"),
        (_elsewhere, "facet2: 0 of 4000 points lie on facet 1"),
        (_short, "facet1: 4000 points and 3 normals"),
        (_linked, "facet1 has no dataset surface_points"),
        (_flat, "facet3/surface_points: float64 of shape"),
        (_less, "the map has 3 facets, but the mirror has 4"),
    ],
)
def test_a_wrong_file_is_refused(
    tmp_path: Path, change: Callable[[h5py.File], None], said: str
) -> None:
    path = write_deflectometry(tmp_path / "A.h5", SHAPE, change=change)
    with pytest.raises(FormatError, match=said):
        read_deflectometry(path, SHAPE.facets, SHAPE.focal)


def test_a_file_that_is_no_hdf5_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "A.h5"
    path.write_bytes(b"\x89HDF\r\n\x1a\nnothing more")
    with pytest.raises(FormatError, match="not a readable HDF5 file"):
        read_deflectometry(path, SHAPE.facets, SHAPE.focal)


def test_the_newest_filled_file_of_a_heliostat_is_found(tmp_path: Path) -> None:
    assert find_deflectometry(tmp_path, "AA39") is None
    place = tmp_path / "AA39/Deflectometry"
    place.mkdir(parents=True)
    for name in (
        "AA39-2023-09-18Z08-49-09Z",
        "AA39-filled-2021-09-18Z08-49-09Z",
        "AA39-filled-2022-09-18Z08-49-09Z",
    ):
        (place / f"{name}-deflectometry.h5").touch()
    found = find_deflectometry(tmp_path, "AA39")
    assert found is not None
    assert found.name == "AA39-filled-2022-09-18Z08-49-09Z-deflectometry.h5"
    assert find_deflectometry(place, "AA39") == found
    assert find_deflectometry(place, "AA3") is None
    (tmp_path / "AA39.h5").touch()
    assert find_deflectometry(tmp_path, "AA39") == tmp_path / "AA39.h5"
