"""A researcher's first tasks: each is one script with one import and at most 12 lines."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

import heliotrope as ht
from heliotrope.imaging import write_image
from heliotrope.imaging.synthetic import Scene, example_camera, example_target, exposed, render
from heliotrope.optics.mirror_image import gaussian_beam
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
    axes = ht.plot.day(day)
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
seen = ht.read_field_sightings(plant, folder).sightings["BF57"]
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


def test_an_own_centroid_becomes_a_sighting(tmp_path: Path) -> None:
    target = example_target()
    thrown = (("target", gaussian_beam((0.62, -0.31), 0.8, 0.5, angle=0.6), 800.0),)
    scene = exposed(Scene(example_camera(target, size=(800, 600)), (target,), thrown))
    time = datetime(2026, 9, 2, 10, 0, tzinfo=UTC)
    write_image(render(scene, seed=3, time=time).frame, tmp_path / "17.png")
    ht.write_plant(replace(ht.example_plant(), targets=(target,)), tmp_path / "plant.toml")
    found = run(
        """
import heliotrope as ht
def centroid(beam):
    light = (beam.picture - beam.background).clip(0.0) * beam.mask
    place = [(light * axis).sum() / light.sum() for axis in (beam.right, beam.up)]
    arms = [beam.mask * (axis - m) for axis, m in zip((beam.right, beam.up), place)]
    return place, [[(beam.noise / light.sum()) ** 2 * (a * b).sum() for a in arms] for b in arms]
plant = ht.open(folder / "plant.toml")
own = ht.imaging.PhotographSettings(centroid=centroid)
photograph = ht.imaging.read_photograph(ht.imaging.read_image(picture), plant.targets, settings=own)
seen = ht.imaging.sighting_of(photograph, "P6A", (-251959, 746419), plant.site)
error = ht.beam_errors(plant["P6A"], seen)
""",
        folder=tmp_path,
        picture=tmp_path / "17.png",
    )
    seen = found["seen"]
    assert seen.names == ("P6A",)
    assert seen.time[0] == time.timestamp()
    place = target.plane_coordinates(seen.destination[0])
    np.testing.assert_allclose(place, (0.62, -0.31), atol=0.02)
    assert np.isfinite(found["error"].beam).all()
