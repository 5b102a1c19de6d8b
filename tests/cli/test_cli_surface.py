"""``heliotrope surface``: photographs in a folder, a slope map, and one line for what is wrong."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import heliotrope as ht
from heliotrope.cli import main
from heliotrope.field.formats.slopes import read_slopes
from heliotrope.field.layouts import malan_plant
from heliotrope.geometry import azimuth_elevation, direction
from heliotrope.imaging.files import write_image
from heliotrope.mechanism import track
from heliotrope.optics import equal_facets, reflected_beam

PLANT = malan_plant(2)
(GROUP,) = PLANT.groups.values()
TARGET = PLANT.targets[0]
NAME = GROUP.names[0]
#: Bearings from the mirror's own, and elevations, of the suns, °.
SUNS = ((-40.0, 35.0), (10.0, 60.0), (50.0, 40.0))


def photograph(folder: Path, number: int, *, known: bool) -> None:
    """Write the beam of a mirror that is focused at 60 m, on grey paint, and its properties."""
    beside, elevation = SUNS[number]
    own, _ = azimuth_elevation(GROUP.position[0] - TARGET.center)
    sun = direction(own + np.radians(beside), np.radians(elevation))
    tracked = track(GROUP.mechanism.with_parameters({}), sun, TARGET.center)
    counts = tracked.best_counts[0]
    pose = GROUP.mechanism.pose(tracked.best_counts)
    size = float(GROUP.width[0]), float(GROUP.height[0])
    beam = reflected_beam(
        TARGET, pose.vertex[0], sun, *size, normal=pose.normal[0], step=0.05,
        facets=equal_facets(*size, (1, 1), np.inf), facet_focal=60.0,
    )  # fmt: skip
    corners = TARGET.plane_coordinates(TARGET.corners)
    low, high = corners.min(axis=0), corners.max(axis=0)
    x, y = (a + (np.arange(90) + 0.5) / 90 * (b - a) for a, b in zip(low, high, strict=True))
    light = beam.at(np.stack(np.meshgrid(x, y[::-1]), axis=-1))
    noise = np.random.default_rng(number).normal(0.0, 1.0, light.shape)
    values = 40.0 + 180.0 * light / light.max() + noise
    write_image(np.round(values).astype(np.uint8), folder / f"{number}.png")
    azimuth, height = azimuth_elevation(sun)
    properties: dict[str, Any] = {
        "motor_position": {"axis_1_motor_position": counts[0], "axis_2_motor_position": counts[1]},
        "target_name": TARGET.name,
        "focal_spot": {},
    }
    if known:
        properties["sun_azimuth"] = 180.0 - float(np.degrees(azimuth))
        properties["sun_elevation"] = float(np.degrees(height))
    (folder / f"{number}-calibration-properties.json").write_text(json.dumps(properties))


@pytest.fixture
def surface(tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run the command on a plant in its folder."""
    monkeypatch.chdir(tmp_path)
    ht.write_plant(PLANT, "plant.toml")
    (tmp_path / "seen").mkdir()

    def run(*words: str) -> tuple[int, str, str]:
        line = ["heliotrope", "surface", "plant.toml", "seen", "--heliostat", NAME, *words]
        monkeypatch.setattr(sys, "argv", line)
        with pytest.raises(SystemExit) as leaving:
            main()
        said = capsys.readouterr()
        return int(leaving.value.code or 0), said.out, said.err

    return run


def test_a_focused_mirror_is_found_and_predicted(surface: Any, tmp_path: Path) -> None:
    for number in range(len(SUNS)):
        # The second has no sun, which follows from the drives.
        photograph(tmp_path / "seen", number, known=number != 1)
    (tmp_path / "seen" / "9-calibration-properties.json").write_text("{}")
    code, out, err = surface("--learn=2", "--json", "--out=A.npz", "--pictures=A.png")
    assert code == 0, err
    got = json.loads(out)
    assert len(got["learnt_from"]) == 2
    assert got["median_accuracy"] > 0.93
    assert got["left_out"] == ["9-calibration-properties.json: there is no picture 9.png beside it"]
    slopes = read_slopes("A.npz", 1)
    # Across the mirror the slope of a focused one rises by its width / 2f.
    rise = (slopes[0, :, -1, 0] - slopes[0, :, 0, 0]).mean()
    assert rise == pytest.approx(float(GROUP.width[0]) / 120.0, rel=0.25)
    assert (tmp_path / "A.png").stat().st_size > 0


def test_what_cannot_be_learnt_from_is_refused(surface: Any, tmp_path: Path) -> None:
    code, _, err = surface()
    assert code == 2
    assert "seen: there is no ID-calibration-properties.json" in err
    photograph(tmp_path / "seen", 0, known=True)
    write_image(np.full((90, 90), 40, dtype=np.uint8), tmp_path / "seen" / "0.png")
    code, _, err = surface()
    assert code == 2
    assert "no photograph of the mirror's beam" in err
    assert len(err.strip().splitlines()) == 1
