"""`import heliotrope`: light, complete, and the same objects as in the packages."""

import pkgutil
import subprocess
import sys
from importlib import import_module

import numpy as np
import pytest

import heliotrope as ht


def test_importing_loads_nothing_heavy() -> None:
    code = "import sys, heliotrope as ht; dir(ht); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert not loaded & {"numpy", "numba", "scipy", "pandas", "pvlib", "pydantic"}
    assert not [name for name in loaded if name.startswith("heliotrope.")]


def test_every_public_name_is_there() -> None:
    assert dir(ht) == ht.__all__ == sorted(ht.__all__)
    for name in ht.__all__:
        assert getattr(ht, name) is getattr(ht, name)
    assert ht.track is import_module("heliotrope.mechanism.tracking").track
    assert ht.evaluate is import_module("heliotrope.calibration").evaluate


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'trakc'"):
        ht.trakc  # noqa: B018


@pytest.mark.parametrize(
    "package",
    [
        "calibration",
        "calibration.fit",
        "calibration.learn",
        "calibration.plan",
        "calibration.report",
        "field",
        "files",
        "mechanism",
        "aims",
        "optics",
        "plot",
        "sun",
    ],
)
def test_faces_list_what_they_show(package: str) -> None:
    face = import_module(f"heliotrope.{package}")
    modules = {info.name for info in pkgutil.iter_modules(face.__path__)}
    for name in face.__all__:
        assert getattr(face, name) is not None
        # A function of a module's name would hide the module.
        assert name not in modules
    assert len(set(face.__all__)) == len(face.__all__)


def test_a_notebook_from_plant_to_calibrated_error() -> None:
    """Measure a rough heliostat on its target, calibrate it, and predict fresh measurements."""
    plant = ht.example_plant()
    nominal = plant.groups["azel"].mechanism
    actual = ht.roughly_installed(nominal, seed=3)
    aim = plant.targets[0].center
    hours = np.arange("2026-09-02T07", "2026-09-02T14", 10, dtype="datetime64[m]")
    times = hours.astype("datetime64[s]").astype(float)
    suns = ht.sun.vector(times, plant.site)
    tracked = ht.track(actual[0], suns, aim)
    counts = tracked.best_counts
    seen = ht.sightings(np.zeros(len(times), int), counts, suns, aim, time=times, sigma=1e-4)
    training = ht.split(seen, "chronological", 0.7)
    fitted = ht.fit(nominal[:1], seen.take(training), "guo6")
    fresh = seen.take(~training)
    before = ht.beam_errors(nominal[:1], fresh).beam
    after = ht.beam_errors(nominal[:1].with_parameters(fitted.parameters), fresh).beam
    assert np.median(before) > 5e-3
    assert np.median(after) < 0.05 * np.median(before)
    learned = ht.learn(nominal[:1], seen, "guo6", used=training)
    assert np.median(ht.predict(learned, fresh).errors.beam) < 0.05 * np.median(before)
