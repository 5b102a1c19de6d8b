"""The example scripts run and their pictures are pictures."""

import importlib.util
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import numpy as np
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
    malan = _load("malan_figures")
    written = malan.main(tmp_path)
    assert [p.name for p in written] == [f"figure-4-{n}.png" for n in (6, 7, 8, 9)]
    assert all(imread(path)[..., :3].std() > 0.02 for path in written)
    for number, pairs in {"4.6": ("AB", "CD"), "4.7": ("AB", "CD"), "4.8": ("AB",)}.items():
        found = malan.paths(number)
        for place in malan.PLACES:
            for one, other in pairs:
                # Errors of opposite sign give opposite paths, to first order.
                a, b = found[place, one], found[place, other]
                np.testing.assert_allclose(a.right, -b.right, rtol=0, atol=0.01)
                np.testing.assert_allclose(a.up, -b.up, rtol=0, atol=0.01)
                assert 0.5 < a.rms < 2.0
    # In the south a lean to the north lowers the image, and one to the east moves it right.
    tilt = malan.paths("4.6")
    assert (tilt["south", "A"].up < -1.0).all()
    assert (tilt["south", "D"].right > 0.4).all()
    # A normal raised by 1 mrad raises the beam by 2 cos(incidence) mrad at noon.
    bias = malan.paths("4.7")["south", "A"]
    assert bias.up.max() == pytest.approx(2.0, abs=0.05)
    # One set of errors moves the image differently in every season, by centimetres at 40 m.
    seasons = [p.rms for p in malan.paths("4.9").values()]
    assert len(seasons) == 3
    assert min(abs(a - b) for a, b in pairwise(seasons)) > 0.5


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


def test_malan_chapter_6(tmp_path: Path) -> None:
    """His mirror of table 6.1: below 1 mrad on three later days, and his worm of 30:1 found."""
    found = _load("malan_chapter6").main(tmp_path)
    assert found["before"] > 20.0
    for day in ("6", "7", "8"):
        # His 1.94 mrad of the beam on 6 September are 0.97 mrad of the normal.
        assert 0.5 < 0.5 * found[f"constants {day}"] < 1.0
    for day in ("7", "8"):
        assert found[f"worm {day}"] < 0.3
    assert found["ratio"] == pytest.approx(30.0, abs=1.5)
    assert found["amplitude"] == pytest.approx(1.35, abs=0.2)
    assert found["false alarm"] < 1e-6
    assert imread(tmp_path / "malan-chapter-6.png")[..., :3].std() > 0.02


def test_malan_search() -> None:
    """Both pitches find every beam within their reach; the wider one finds far ones sooner."""
    found = _load("malan_search").results(beams=(0.33, 0.8), drawn=400)
    assert all(one.share > 0.995 for both in found.values() for one in both.values())
    for beam in (0.33, 0.8):
        far = found[beam, 1.9]
        assert far["ours"].looks < 0.8 * far["Malan"].looks


def test_malan_radio() -> None:
    """Times on the air as published, the channel's own loss, and what the study concludes."""
    radio = _load("malan_radio")
    ieee, lora = radio.RADIOS
    # The longest frame of 802.15.4 is 133 bytes, 127 without what precedes them: 4.256 ms.
    assert ieee.airtime(127 - radio.MAC_BYTES) == pytest.approx(4.256e-3)
    # Twelve bytes at a spreading factor of 9: 144.384 ms (Semtech's formula; lora-modulation).
    assert radio.lora_airtime(12, 9) == pytest.approx(144.384e-3)
    # A tag of 8 bytes on what the cluster says, none on answers (decision 0027).
    assert [radio.size_of(name) for name in ("SUN", "QUERY_STATUS", "STATUS")] == [44, 22, 37]
    rng = np.random.default_rng(3)
    channel = radio.Channel(20_000, rng)
    lost = [1.0 - channel.heard(0.1).mean() for _ in range(50)]
    wanted = radio.BURSTS * radio.LOSS_IN_BURST + (1.0 - radio.BURSTS) * radio.LOSS
    assert np.mean(lost) == pytest.approx(wanted, rel=0.05)
    # A burst outlasts 0.1 s: who lost one frame loses the next far more often than others.
    first = channel.heard(0.1)
    assert (~channel.heard(0.1))[~first].mean() > 10.0 * wanted
    found = radio.study(trials=8)
    for name in (ieee.name, lora.name):
        assert found[f"{name}, 3 calls, unheard"] > 10.0
        assert found[f"{name}, 1 sender, unheard"] == found[f"{name}, 2 senders, unheard"] == 0.0
        assert found[f"{name}, 2 senders, last, s"] < found[f"{name}, 1 sender, last, s"]
        assert found[f"{name}, slots, s"] < found[f"{name}, polling, s"]
    assert found[f"{ieee.name}, 1 sender, 99.99 %, s"] < 1.5
    assert found[f"{ieee.name}, polling, s"] < 3.0 < 60.0 < found[f"{lora.name}, polling, s"]


def test_malan_noise_as_he_normalises_it() -> None:
    """Figure 4.11: no error without noise, more with more, several times more between seasons."""
    normalised = _load("malan_noise").normalised
    clean, some, more = (normalised(level) for level in (0.0, 0.2, 0.8))
    for season in ("summer", "winter"):
        assert clean[season].mean() < 1e-3 < some[season].mean() < more[season].mean()
        assert 0.0 < some[season].std() < some[season].mean()
    # His figure: about four times worse. Ours: more without priors, less with them.
    assert some["winter"].mean() > 4.0 * some["summer"].mean()
    held = normalised(0.2, wide=1.0)
    assert 1.0 < held["winter"].mean() / held["summer"].mean() < 4.0


def test_malan_noise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = imread(_load("malan_noise").main(tmp_path))
    assert picture[..., :3].std() > 0.02
    assert "21 December" in capsys.readouterr().out


def test_malan_sizing(capsys: pytest.CaptureFixture[str]) -> None:
    """Malan §3.2 and §3.5, as printed."""
    found = _load("malan_sizing").main()
    assert found["lower"] == pytest.approx(5_534, abs=0.5)
    assert found["upper"] == pytest.approx(15_314, abs=0.5)
    assert found["ratio"] == pytest.approx(10_098, abs=0.5)
    assert found["area"] == 50_000
    assert found["heliostats"] == 10_000
    assert found["field"] == 100_000
    assert found["interval"] == pytest.approx(13.75, abs=0.005)
    assert found["whole_seconds"] == 13
    assert found["bits"] == pytest.approx(1.3e6)
    assert found["clusters"] == 313
    assert found["sector"] == 1_536
    assert "control interval" in capsys.readouterr().out
