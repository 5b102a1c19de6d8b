"""What the air takes: published models at published points, and SolarPILOT's 904 values."""

import csv

import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.optics import AIR_MODELS, air_loss
from support.data import fields


def test_the_air_of_solarpilot_is_clear() -> None:
    with (fields() / "halos" / "radial-daggett-50.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 904
    places, aims = (
        np.array([[float(row[f"{what}-{axis}"]) for axis in "xyz"] for row in rows])
        for what in ("Pos", "Aim")
    )
    theirs = np.array([float(row["Attenuation"]) for row in rows])
    ours = 1.0 - air_loss(np.linalg.norm(aims - places, axis=-1))
    assert np.abs(ours - theirs).max() < 1e-4  # their values have four digits


# Transmissions as TonatiuhPP's AirVittitoeBiggs, AirMirval and TransmissivityBallestrin state
# them at d = 0, and their sums of coefficients at d = 1 km.
@pytest.mark.parametrize(
    ("model", "near", "at_1_km"),
    [
        ("hazy", 0.98707, 0.98707 - 0.2748 + 0.03394),
        ("mirval", 0.99321, 0.99321 - 0.1176 + 0.0197),
        ("ballestrin-clear", 0.9970456, 0.9970456 - 0.1522128 + 0.018598 - 0.0015182),
        ("ballestrin-hazy", 0.9922059, 0.9922059 - 0.5549083 + 0.147887 - 0.0153718),
    ],
)
def test_models_are_those_that_are_published(model: str, near: float, at_1_km: float) -> None:
    assert 1.0 - air_loss([0.0, 1000.0], model) == pytest.approx([near, at_1_km], abs=6e-6)


def test_beyond_a_kilometre_mirval_is_exponential() -> None:
    assert 1.0 - air_loss(2000.0, "mirval") == pytest.approx(np.exp(-0.2212))


def test_at_its_visibility_a_contrast_falls_to_2_per_cent() -> None:
    assert 1.0 - air_loss(23_000.0, 23.0) == pytest.approx(0.02)
    assert air_loss(800.0, "23") == air_loss(800.0, 23)


@pytest.mark.parametrize("model", [*AIR_MODELS, 5.0])
def test_a_longer_path_never_loses_less(model: str | float) -> None:
    loss = air_loss(np.linspace(0.0, 60_000.0, 6001), model)
    # Mirval's two pieces do not quite meet; the second is the greater.
    assert (np.diff(loss) >= 0.0).all()
    assert loss.min() >= 0.0
    assert loss.max() <= 1.0
    assert np.isnan(air_loss(np.nan, model)) or model == "none"


@pytest.mark.parametrize("model", ["fog", "", "0.01", -3.0, "nan"])
def test_an_unknown_model_is_refused_in_one_line(model: str | float) -> None:
    with pytest.raises(InputError, match=r"known: none, clear.*0\.1 to 500 km"):
        air_loss(100.0, model)
