"""A researcher's first tasks: each is one script with one import and at most 12 lines."""

from pathlib import Path
from typing import Any

import numpy as np

import heliotrope as ht
from support.data import juelich

FILES = Path(__file__).parent / "files"


def run(script: str, **given: Any) -> dict[str, Any]:
    """Run a script as a notebook would, and return its names."""
    lines = script.strip().splitlines()
    assert len(lines) <= 12
    assert [line for line in lines if "import" in line] == ["import heliotrope as ht"]
    assert max(map(len, lines)) <= 100
    names: dict[str, Any] = dict(given)
    exec(compile(script, "trial", "exec"), names)  # the script is above
    return names


def test_three_formats_and_the_pictures_of_a_day(tmp_path: Path) -> None:
    found = run(
        """
import heliotrope as ht
site = ht.Site(34.7, 33.3, 10.0)
for name in ("heliok-scene.xml", "solarpilot-export.csv", "opencsp-field.csv"):
    plant = ht.open(files / name, site=site)
    day = ht.track_day(plant[plant.names[0]], "2026-06-21", (0.0, 0.0, 60.0))
    days[name] = day.to_frame()[["angle_1", "angle_2"]]
    axes = ht.plot.day(day.time, day.path)
    axes.figure.savefig(out / f"{name}.png")
""",
        files=FILES,
        out=tmp_path,
        days={},
    )
    from matplotlib import pyplot as plt

    plt.close("all")
    assert len(found["days"]) == 3
    for name, frame in found["days"].items():
        assert len(frame) > 80
        assert np.isfinite(frame.to_numpy()).all()
        assert (tmp_path / f"{name}.png").stat().st_size > 5000


def test_an_own_machine_200_times_with_its_uncertainty() -> None:
    found = run("""
import heliotrope as ht
places = [(6.0 * i - 57.0, 40.0 + 6.0 * j, 0.0) for i in range(20) for j in range(10)]
jack = ht.linear_grigoriev(0.5, 0.6, 0.75, 5e-6, angle_zero=-1.4, min_angle=-0.9, max_angle=0.9)
drives = (jack, ht.rotary(200, 2400, microsteps=16, min_angle=-1.4, max_angle=1.4))
nominal = ht.kinds.pitch_roll(places, 0.0, pivot_height=1.5, drives=drives)
truth, site, aim = ht.roughly_installed(nominal), ht.Site(37.0, -2.4, 500.0), (0.0, 0.0, 40.0)
times = ht.sun.daylight("2026-03-20", site, min_elevation=0.3)[::40]
suns = ht.sun.vector(times, site)[:, None]
found = ht.track(truth, suns, aim)
seen = ht.sightings(range(200), found.best_counts, suns, aim, time=times, sigma=3e-4)
fitted = ht.fit(nominal, seen.take(found.reachable.ravel()), "malan8+canting")
after = ht.beam_errors(nominal.with_calibration(fitted), seen.take(found.reachable.ravel()))
""")
    truth, fitted = found["truth"], found["fitted"]
    assert fitted.values.shape == (200, 9)
    seen = fitted.count > 0
    assert seen.sum() > 150
    assert np.median(found["after"].beam) < 1e-4
    # The error of each parameter is as large as its uncertainty says, or smaller: the installation
    # is about half as rough as the priors, and the counts have no noise.
    real = np.stack([truth.deviations[name] for name in fitted.names], axis=-1)
    share = ((fitted.values - real) / fitted.sigma)[seen]
    assert 0.1 < np.sqrt(np.mean(share**2)) < 1.0
    assert ((fitted.sigma > 0.0) & (fitted.sigma <= 1.001 * fitted.prior)).all()


def test_from_juelich_to_a_forecast_and_a_comparison() -> None:
    found = run(
        """
import heliotrope as ht
plant = ht.open(folder)
seen = ht.read_field_sightings(plant, folder).seen["BF57"]
learned = ht.learn(plant["BF57"], seen, "jacks")
times = ht.sun.daylight("2023-06-21", plant.site, min_elevation=0.2)[::30]
forecast = learned.forecast("BF57", times, plant.targets[0])
long, short, angle = forecast.ellipse
frame = forecast.to_frame()
models = {"jacks": learned.model, "zeros": learned.model[4:6]}
scores = ht.compare(plant["BF57"], seen, models)
""",
        folder=juelich(),
    )
    forecast, frame = found["forecast"], found["frame"]
    assert (frame.index == found["times"]).all()
    good = forecast.reachable
    assert good.sum() > 10
    assert (found["long"][good] >= found["short"][good]).all()
    assert 2e-4 < np.median(found["long"][good]) < 1e-2
    scores = {one.name: one.log_predictive for one in found["scores"]}
    assert scores["jacks"] > scores["zeros"]


def test_an_own_centroid_becomes_a_sighting() -> None:
    plant = ht.example_plant()
    target, sigma, true = plant.targets[0], 0.25, np.array([0.31, -0.12])
    right, up = np.meshgrid(np.linspace(-1.5, 1.5, 121), np.linspace(-1.5, 1.5, 121))
    rng = np.random.default_rng(8)
    background = 20.0 + 2.0 * right
    shape = np.exp(-0.5 * ((right - true[0]) ** 2 + (up - true[1]) ** 2) / sigma**2)
    found = run(
        """
import heliotrope as ht
plant = ht.example_plant()
light = (picture - background).clip(0.0) * mask
middle = [float((light * axis).sum() / light.sum()) for axis in (right, up)]
place = plant.target("target").point(middle)
time = "2026-09-02T10:00Z"
sun = ht.sun.vector(time, plant.site)
counts = ht.track(plant["P6A"], sun, place).best_counts
seen = ht.sightings("P6A", counts, sun, place, time=time, destination_covariance=4e-6)
error = ht.beam_errors(plant["P6A"], seen)
""",
        picture=background + 100.0 * shape + rng.normal(0.0, 0.5, shape.shape),
        background=background,
        mask=shape > 0.02,
        right=right,
        up=up,
    )
    np.testing.assert_allclose(target.plane_coordinates(found["place"]), true, atol=5e-3)
    assert found["seen"].names == ("P6A",)
    assert found["error"].beam[0] < 1e-8
