"""What was learnt returns to the tables of OpenCSP and SolarPILOT, as far as these go."""

from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

import heliotrope as ht
from heliotrope.calibration.learn.learned import Learned
from heliotrope.errors import InputError
from heliotrope.field.formats import opencsp, solarpilot
from heliotrope.field.plant import Plant
from heliotrope.sun import Site, daylight, vector

FILES = Path(__file__).parents[1] / "files"
SITE = Site(36.0, -106.5, 1700.0, name="field")
TRUE = {"position_east": 0.05, "position_up": -0.03, "tilt_north": 3e-3, "azimuth_bias": 2e-3}


def learnt(plant: Plant, name: str) -> Learned:
    """Learn one heliostat from sightings of its true beam on a target."""
    nominal = plant[name].nominal
    times = daylight("2026-06-21", SITE, every=timedelta(minutes=30), min_elevation=0.3)
    aims = np.array([(0.0, 0.0, z) for z in (20.0, 60.0, 100.0)])
    sun = np.repeat(vector(times, SITE), 3, axis=0)
    aim = np.tile(aims, (len(times), 1))
    truth = nominal.with_parameters(TRUE)
    counts = np.stack([ht.track(truth, s, a).best_counts for s, a in zip(sun, aim, strict=True)])
    seen = ht.sightings([0], counts, sun, aim, sigma=1e-4)
    return ht.learn(plant[name], seen, tuple(TRUE), processes=())


def test_opencsp_gets_the_position_and_the_rest_is_named(tmp_path: Path) -> None:
    source, out = FILES / "opencsp-field.csv", tmp_path / "new.csv"
    before = opencsp.read_field(source)
    plant, name = opencsp.to_plant(before, SITE), before.names[0]
    learned = learnt(plant, name)
    lost = ht.write_opencsp(out, source, plant, learned)
    after = opencsp.read_field(out)
    value = dict(zip(learned.names, learned.parameters_at([0], float("nan"))[0][0], strict=True))
    moved = [
        value[f"position_{axis}"] if axis != "north" else 0.0 for axis in ("east", "north", "up")
    ]
    assert moved[0] == pytest.approx(0.05, abs=0.02)
    np.testing.assert_allclose(after.location[0] - before.location[0], moved, atol=1e-12)
    np.testing.assert_array_equal(after.location[1:], before.location[1:])
    assert (after.names, after.extra) == (before.names, before.extra)
    assert [each.split()[0] for each in lost[name]] == ["tilt_north", "azimuth_bias"]
    other = tmp_path / "other.csv"
    lines = source.read_text().splitlines(keepends=True)
    other.write_text("".join([lines[0], *lines[2:]]))
    with pytest.raises(InputError, match=f"heliostat {name}: .*no heliostat with that name"):
        ht.write_opencsp(tmp_path / "none.csv", other, plant, learned)
    assert not (tmp_path / "none.csv").exists()
    with pytest.raises(InputError, match=f"heliostat {name}: .*two_jacks; use write_plant"):
        ht.write_paint(tmp_path / "paint", plant, learned)
    assert not (tmp_path / "paint").exists()


def test_solarpilot_gets_the_position_and_keeps_its_rows(tmp_path: Path) -> None:
    source, out = FILES / "solarpilot-export.csv", tmp_path / "new.csv"
    before = solarpilot.read_layout(source)
    shape = solarpilot.Template(12.2, 12.0, 6.5, 0.2)
    plant = solarpilot.to_plant(before, SITE, dict.fromkeys(range(5), shape))
    name = plant.names[0]
    lost = ht.write_solarpilot(out, source, plant, learnt(plant, name))
    after, row = solarpilot.read_layout(out), int(name[1:]) - 1
    assert after.location[row, 0] - before.location[row, 0] == pytest.approx(0.05, abs=0.02)
    others = np.arange(len(before)) != row
    np.testing.assert_array_equal(after.location[others], before.location[others])
    for part in ("template", "enabled", "in_layout", "focus", "cant", "aim"):
        np.testing.assert_array_equal(getattr(after, part), getattr(before, part))
    assert [each.split()[0] for each in lost[name]] == ["tilt_north", "azimuth_bias"]
