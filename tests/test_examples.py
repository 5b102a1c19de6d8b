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
    assert [p.name for p in paths] == [
        f"figure-{n}.png" for n in ("3-5", "4-6", "4-7", "4-8", "4-9")
    ]
    for path in paths:
        picture = imread(path)
        assert picture.shape[0] > 300
        assert picture[..., :3].std() > 0.02


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
