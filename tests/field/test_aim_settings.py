"""Aims in the plant file: a spread unless asked for, written and read, limited."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from heliotrope.errors import FormatError, InputError
from heliotrope.field.aim_settings import AimSettings
from heliotrope.field.flux_limit import FluxLimit
from heliotrope.field.formats.plant_file import check_plant, read_plant, write_plant
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


def test_a_map_in_kw_is_a_warning_of_the_check(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    for flux, number in ((np.array([[600.0, 550.0]]), 1), (np.array([[6e5, 550.0]]), 0)):
        settings = AimSettings("limit", FluxLimit(flux), "limit.csv")
        write_plant(replace(lay_out("radial", 6), aims=settings), path)
        findings = check_plant(path)
        texts = [f.text for f in findings if "kW/m²" in f.text]
        assert len(texts) == number
        begin = "aims: plant.limit.csv: no cell's limit is above 600 W/m²"
        assert all(text.startswith(begin) for text in texts)
        assert {f.severity for f in findings} <= {"warning"}


def test_a_table_is_read_with_its_panels_and_kept_as_a_map(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    write_plant(replace(lay_out("radial", 6), aims=NUMBER), path)
    (tmp_path / "afd.csv").write_text(
        "temperature_c,velocity_m_s,flux_w_m2\n290,1,8e5\n565,1,4e5\n290,3,1.2e6\n565,3,6e5\n"
    )
    (tmp_path / "panels.csv").write_text(
        "path,begin,end,flow,inlet_c,outlet_c,velocity_m_s\n"
        "west,0,0.5,up,290,565,2\neast,0.5,1,down,290,565,3\n"
    )
    keys = 'limit_table = "afd.csv"\nlimit_panels = "panels.csv"'
    path.write_text(path.read_text().replace("limit_kw_m2 = 600.0", keys))
    read = read_plant(path)
    assert read.aims.limit is not None
    got = read.aims.limit.on(10, 4)
    assert got[-1, 0] == pytest.approx(0.9 * 5e5)
    assert got[0, 3] == pytest.approx(0.9 * 6e5)
    write_plant(read, tmp_path / "again.toml")
    again = read_plant(tmp_path / "again.toml").aims.limit
    assert again is not None
    np.testing.assert_allclose(again.on(10, 4), got)


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        ("limit_kw_m2 = 600.0", "", "needs limit_kw_m2, limit_map or limit_table"),
        ("limit_kw_m2 = 600.0", "limit_kw_m2 = -3.0", "limit_kw_m2"),
        ("limit_kw_m2 = 600.0", 'limit_map = "none.csv"', "none.csv"),
        (
            "limit_kw_m2 = 600.0",
            'limit_kw_m2 = 1.0\nlimit_map = "a.csv"',
            "cannot be used together; keep one",
        ),
        ("limit_kw_m2 = 600.0", 'limit_table = "a.csv"', "limit_panels must be used together"),
        (
            "limit_kw_m2 = 600.0",
            'limit_map = "b"\nlimit_table = "a.csv"',
            "cannot be used together; keep one",
        ),
        ('strategy = "limit"', 'strategy = "spread"', 'needs strategy = "limit"'),
        ('strategy = "limit"', 'strategy = "best"', "aims.strategy"),
        ("margin = 0.1", "margin = 0.7", "the margin must be between 0 and 0.5, not 0.7"),
        ("probability = 0.95", "probability = 0.3", "probability must be between 0.5"),
        ("moves_per_minute = 12.0", "moves_per_minute = 0", "moves_per_minute must be between 1"),
        (
            "deadline_s = 120.0",
            "deadline_s = 20.0",
            "deadline_s must be between 60 and 3600 s, not 20 s",
        ),
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
    assert "aims: aims" not in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_limit_needs_one_receiver() -> None:
    with pytest.raises(InputError, match="needs one receiver, and the plant has 0"):
        replace(lay_out("radial", 6), receivers=(), aims=NUMBER)
    plant = lay_out("radial", 6)
    (first,) = plant.receivers
    both = (first, replace(first, name="second", center=first.center + [0.0, 0.0, 20.0]))
    with pytest.raises(
        InputError, match=r"the plant has 2; .* one receiver at a time with heliotrope aim"
    ):
        replace(plant, receivers=both, aims=NUMBER)
