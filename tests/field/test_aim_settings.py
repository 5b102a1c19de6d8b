"""Aims in the plant file: a spread unless asked for, written and read, limited."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from heliotrope.errors import FormatError, InputError
from heliotrope.field.aim_settings import AimSettings
from heliotrope.field.flux_limit import FluxLimit
from heliotrope.field.formats.plant_file import read_plant, write_plant
from heliotrope.field.layouts import lay_out

NUMBER = AimSettings("limit", FluxLimit(6e5, 0.1), probability=0.95, drift=2e-4, moves=12.0)


def test_a_plant_spreads_its_aims_unless_asked(tmp_path: Path) -> None:
    write_plant(lay_out("radial", 6), tmp_path / "plant.toml")
    assert "[aims]" not in (tmp_path / "plant.toml").read_text()
    assert read_plant(tmp_path / "plant.toml").aims.strategy == "spread"


def test_a_number_is_read_as_written(tmp_path: Path) -> None:
    write_plant(replace(lay_out("radial", 6), aims=NUMBER), tmp_path / "plant.toml")
    read = read_plant(tmp_path / "plant.toml").aims
    assert read.limit is not None
    assert float(read.limit.flux) == pytest.approx(6e5)
    assert (read.limit.margin, read.probability) == (0.1, 0.95)
    assert (read.drift, read.moves) == (pytest.approx(2e-4), 12.0)


def test_a_map_stands_beside_the_plant_file(tmp_path: Path) -> None:
    flux = np.array([[1e5, 2e5], [3e5, 4e5]])
    settings = AimSettings("limit", FluxLimit(flux), "limit.csv")
    write_plant(replace(lay_out("radial", 6), aims=settings), tmp_path / "plant.toml")
    assert (tmp_path / "plant.limit.csv").read_text().splitlines()[0] == "300000.0,400000.0"
    read = read_plant(tmp_path / "plant.toml").aims
    assert read.limit is not None
    np.testing.assert_array_equal(read.limit.flux, flux)


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        ("limit_kw_m2 = 600.0", "", "needs limit_kw_m2 or limit_map"),
        ("limit_kw_m2 = 600.0", "limit_kw_m2 = -3.0", "limit_kw_m2"),
        ("limit_kw_m2 = 600.0", 'limit_map = "none.csv"', "none.csv"),
        ("limit_kw_m2 = 600.0", 'limit_kw_m2 = 1.0\nlimit_map = "a.csv"', "keep one"),
        ('strategy = "limit"', 'strategy = "spread"', 'needs strategy = "limit"'),
        ('strategy = "limit"', 'strategy = "best"', "aims.strategy"),
        ("margin = 0.1", "margin = 0.7", "a margin of 0.7"),
        ("probability = 0.95", "probability = 0.3", "probability 0.3 must be from 0.5"),
        ("moves_per_minute = 12.0", "moves_per_minute = 0", "moves_per_minute 0 must be from 1"),
        ("deadline_s = 120.0", "deadline_s = 20.0", "deadline_s 20 s must be from 60 to 3600 s"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    before: str, after: str, text: str, tmp_path: Path
) -> None:
    path = tmp_path / "plant.toml"
    write_plant(replace(lay_out("radial", 6), aims=NUMBER), path)
    document = path.read_text()
    assert before in document
    path.write_text(document.replace(before, after))
    with pytest.raises(FormatError, match="aims") as refusal:
        read_plant(path)
    assert text in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_limit_needs_one_receiver() -> None:
    with pytest.raises(InputError, match="needs one receiver, and the plant has 0"):
        replace(lay_out("radial", 6), receivers=(), aims=NUMBER)
