"""The example scripts run and their pictures are pictures."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
from matplotlib.image import imread

EXAMPLES = Path(__file__).parents[1] / "examples"


def _load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_malan_figures(tmp_path: Path) -> None:
    paths = _load("malan_figures").main(tmp_path)
    assert [p.name for p in paths] == [f"figure-{n}.png" for n in ("4-6", "4-7", "4-8", "4-9")]
    for path in paths:
        picture = imread(path)
        assert picture.shape[0] > 300
        assert picture[..., :3].std() > 0.02


def test_guo_figures(tmp_path: Path) -> None:
    found = _load("guo_figures").main(tmp_path)
    # Figure 1: τ₁ = 5° and μ = −0.92° are what lies between the axes and the normal.
    first = found["figure 1"]
    assert first["between the axes (deg)"] == pytest.approx(85.0, abs=1e-9)
    assert first["normal from the elevation axis (deg)"] == pytest.approx(90.92, abs=1e-9)
    assert first["beam past target (µm)"] < 1e-3
    # Figure 2: his published zeros, from nine readings that scatter as his.
    second = found["figure 2"]
    assert second["gamma_0_deg"] == pytest.approx(-237.43, abs=4 * 0.014 / 3)
    assert second["alpha_0_deg"] == pytest.approx(22.832, abs=4 * 0.011 / 3)
    assert 0.004 < second["sigma_gamma_deg"] < 0.03
    assert 0.003 < second["sigma_alpha_deg"] < 0.024
    third = found["figure 3"]
    assert third["x of alpha = 40 deg (m)"] == pytest.approx(third["x by (41) (m)"], abs=1e-12)
    assert third["alpha by (42) (deg)"] == pytest.approx(40.0, abs=1e-9)
    for name in ("figure 4", "figure 5"):
        assert max(found[name].values()) < 1e-14
    assert imread(tmp_path / "guo-figures.png")[..., :3].std() > 0.02


def test_malan_intercept() -> None:
    shares = _load("malan_intercept").shares
    for error in (0.0, 1e-3, 3e-3):
        found = shares(error)
        for name in ("", ", image"):
            # The Gaussian is not exact: its tails are not those of a disk and a Gaussian.
            assert found[f"Gaussian{name}"] == pytest.approx(found[f"ray trace{name}"], abs=0.01)
        if error:
            assert found["ray trace"] - found["disks, (3.3)"] > 0.09


def test_malan_noise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = imread(_load("malan_noise").main(tmp_path))
    assert picture[..., :3].std() > 0.02
    assert "21 December" in capsys.readouterr().out


def test_malan_sizing(capsys: pytest.CaptureFixture[str]) -> None:
    found = _load("malan_sizing").main()
    # The thesis: 5 MWe from about 10,000 heliostats of 5 m².
    assert found["heliostats"] == pytest.approx(10_000, rel=0.05)
    assert found["normal_rate"] == pytest.approx(36.46e-6, rel=1e-3)
    assert "sidereal day" in capsys.readouterr().out
