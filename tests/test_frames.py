"""Frames and datasets: labels, units, and back from Parquet and NetCDF."""

from datetime import timedelta
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray

import heliotrope as ht
from heliotrope.calibration import predict
from heliotrope.calibration.fit import DriveTerm, fit_terms
from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.errors import InputError
from heliotrope.frames import Framed
from heliotrope.mechanism.kernels import slots

PLANT = ht.example_plant()
NOMINAL = PLANT["P6A"].nominal
TRUTH = ht.roughly_installed(NOMINAL, seed=2)
TIMES = pd.date_range("2026-09-02T06:00Z", "2026-09-03T14:00Z", freq="20min")
SUNS = ht.sun.vector(TIMES, PLANT.site)
UP = SUNS[:, 2] > 0.1
AIM = PLANT.targets[0].center
SIGMA = 2e-4


def measured() -> ht.Sightings:
    """Sightings of P6A with noise, on two days."""
    counts = ht.track(TRUTH, SUNS[UP], AIM).best_counts
    rng = np.random.default_rng(4)
    slant = float(np.linalg.norm(AIM - NOMINAL.position))
    seen = AIM + rng.normal(0.0, SIGMA * slant, (len(counts), 3)) * [1.0, 0.0, 1.0]
    return ht.sightings("P6A", counts, SUNS[UP], seen, time=TIMES[UP], sigma=SIGMA)


@pytest.fixture(scope="module")
def learned() -> ht.Learned:
    return ht.learn(PLANT["P6A"], measured(), "guo6")


def test_a_forecast_is_where_the_beam_goes(learned: ht.Learned) -> None:
    later = pd.date_range("2026-09-05T07:00Z", "2026-09-05T13:00Z", freq="30min")
    light = ht.sun.vector(later, PLANT.site)

    def truth(counts: np.ndarray) -> np.ndarray:
        made = ht.sightings("P6A", counts, light, AIM, time=later)
        return ht.beam_errors(TRUTH, made).offset

    # Steered by the nominal mechanism the beam misses by many mrad, as forecast.
    before = learned.forecast("P6A", later, "target", steered=NOMINAL)
    np.testing.assert_allclose(before.error, truth(before.counts), atol=1e-3)
    assert np.median(before.beam) > 5e-3
    # As learnt it hits, and the forecast says how surely.
    after = learned.forecast("P6A", later, "target")
    miss = truth(after.counts) - after.error
    square = np.einsum("ta,tab,tb->t", miss, np.linalg.inv(after.covariance), miss)
    assert (square < 4.605).mean() >= 0.9
    assert (after.rms > SIGMA).all()
    long, short, _ = after.ellipse
    assert (long >= short).all()
    assert 2.0 * SIGMA < np.median(long) < 2e-3


def test_a_forecast_at_night_is_nan(learned: ht.Learned) -> None:
    found = learned.forecast(0, ["2026-09-05T00:00Z", "2026-09-05T10:00Z"], AIM)
    assert found.reachable.tolist() == [False, True]
    assert np.isnan(found.rms[0])
    assert np.isnan(found.ellipse[0][0])
    assert "1 within reach" in repr(found)


def test_a_forecast_needs_a_place() -> None:
    alone = ht.learn(NOMINAL, measured(), "tilts+biases")
    with pytest.raises(InputError, match="site=Site"):
        alone.forecast("P6A", TIMES, AIM)
    assert len(alone.forecast("P6A", TIMES[:3], AIM, site=PLANT.site).time) == 3


def test_times_in_are_times_out(learned: ht.Learned, tmp_path: Path) -> None:
    found = learned["P6A"].forecast("P6A", TIMES, "target")
    frame = found.to_frame()
    assert (frame.index == TIMES).all()
    assert frame.attrs["units"]["error_right"] == "rad"
    np.testing.assert_array_equal(frame["error_up"], found.error[:, 1])
    frame.to_parquet(tmp_path / "forecast.parquet")
    back = pd.read_parquet(tmp_path / "forecast.parquet")
    np.testing.assert_array_equal(back["rms"], found.rms)
    assert back.attrs["units"] == frame.attrs["units"]


def back_from_files(name: str, record: Framed, folder: Path) -> None:
    """A frame and a dataset have units, and come back from Parquet and NetCDF."""
    frame, data = record.to_frame(), record.to_xarray()
    assert len(frame), name
    assert set(frame.attrs["units"]) == set(frame.columns)
    data.to_netcdf(folder / f"{name}.nc", engine="scipy")
    with xarray.open_dataset(folder / f"{name}.nc", engine="scipy") as back:
        for variable in data:
            np.testing.assert_array_equal(
                np.asarray(back[variable]).astype(data[variable].dtype), data[variable]
            )
    frame.to_parquet(folder / f"{name}.parquet")


def test_every_record_has_a_frame_and_a_dataset(learned: ht.Learned, tmp_path: Path) -> None:
    seen = measured()
    day = ht.track_day(PLANT, "2026-09-02", every=timedelta(hours=2))
    records = {
        "day": day,
        "one": ht.track_day(PLANT["P6A"], "2026-09-02", every=timedelta(hours=2)),
        "tracking": ht.track(PLANT, SUNS[:4, None], AIM),
        "single": ht.track(PLANT["P6A"], SUNS[3], AIM),
        "sightings": seen,
        "learned": learned,
        "forecast": learned.forecast("P6A", TIMES[:5], "target"),
        "errors": ht.beam_errors(PLANT["P6A"], seen),
        "predicted": predict(learned, seen),
        "path": day.path,
        "fit": ht.fit(PLANT["P6A"], seen, "guo6"),
        "fits": learned.static,
        "heliostats": PLANT.groups["azel"].with_parameters({"canting": 1e-3}),
        "plant": PLANT,
        "heliostat": PLANT["P6A"],
        "mechanism": NOMINAL,
        "moved": TRUTH,
        "mechanisms": PLANT.nominal,
        "drive": NOMINAL.drives[0],
        "drives": PLANT.drives,
    }
    for name, record in records.items():
        back_from_files(name, record, tmp_path)
    one = records["moved"].to_frame()
    assert one["position_north"].item() == TRUTH.position[1]
    assert one["drive_rate_elevation"].item() == TRUTH.drives[1].table[slots.RATE]
    assert one["deviation_azimuth_bias"].item() == TRUTH.deviations["azimuth_bias"]
    assert one.attrs["units"]["deviation_azimuth_bias"] == "rad"
    assert len(records["mechanisms"].to_frame()) == len(PLANT)
    assert records["heliostat"].to_frame().index.tolist() == ["P6A"]
    frame = records["day"].to_frame()
    assert frame.index.names == ["time", "heliostat"]
    one = frame.xs("P6A", level="heliostat")
    np.testing.assert_array_equal(one["count_1"], day.path.counts[:, PLANT.names.index("P6A"), 0])
    # What only the time has is repeated for each heliostat.
    np.testing.assert_array_equal(one["sun_up"], day.sun[:, 2])
    assert day.to_xarray()["angle"].attrs["units"] == "rad"
    assert set(seen.to_frame()["heliostat"]) == {"P6A"}
    units = records["fit"].to_frame().attrs["units"]
    assert units["value_tilt_north"] == units["sigma_canting"] == "rad"
    assert learned.to_frame().attrs["units"]["value_tilt_north"] == "rad"
    assert set(learned.to_xarray()["value"].attrs["units"].split(", ")) == {"rad"}
    assert records["heliostats"].to_frame().loc["P6A", "deviation_canting"] == 1e-3
    place = PLANT.to_frame().loc["P6A", ["position_east", "position_north", "position_up"]]
    np.testing.assert_array_equal(place.to_numpy(float), PLANT["P6A"].nominal.position)
    value = learned.to_frame().loc["P6A", "value_tilt_north"]
    assert value == pytest.approx(learned.parameters_at([0], TIMES[UP][-1])[0][0, 0])


def test_the_frame_of_a_fit_is_short_unless_it_is_asked_in_full() -> None:
    fitted = ht.fit(PLANT["P6A"], measured(), "guo6")
    short, full = fitted.to_frame(), fitted.to_frame(full=True)
    values, sigmas = ([f"{kind}_{name}" for name in fitted.names] for kind in ("value", "sigma"))
    assert list(short) == [*values, *sigmas, "scale", "sightings", "outcome"]
    added = [f"{kind}_{name}" for kind in ("prior", "centre") for name in fitted.names]
    assert list(full) == [*values, *sigmas, *added, "scale", "sightings", "outcome"]
    np.testing.assert_array_equal(full[added[:6]].to_numpy()[0], fitted.prior)
    assert set(full.attrs["units"]) == set(full)
    pd.testing.assert_frame_equal(full[list(short)], short)
    # A dataset has everything.
    assert {"prior", "centre", "covariance"} < set(fitted.to_xarray())


def test_a_single_axis_has_the_models_by_role() -> None:
    from support.machines import every_kind

    machine = every_kind()["single_axis"]
    counts = np.linspace(-2e4, 2e4, 7)[:, None]
    pose = machine.pose(counts)
    aim = pose.vertex + 30.0 * pose.normal
    seen = ht.sightings(0, counts, pose.normal, aim, sigma=1e-4)
    fitted = ht.fit(machine, seen, "guo6")
    assert fitted.names == ("tilt_east", "tilt_up", "rotation_bias")
    assert np.abs(fitted.values).max() < 1e-6


def test_a_deviation_of_the_position_leaves_the_position_alone() -> None:
    moved = PLANT.groups["azel"].with_parameters({"position_north": 0.01})
    frame = moved.to_frame()
    np.testing.assert_array_equal(frame["position_north"], moved.position[:, 1])
    assert (frame["deviation_position_north"] == 0.01).all()
    assert frame.attrs["units"]["deviation_position_north"] == "m"


def single_records() -> dict[str, Framed]:
    """Records of one topic each: the sun, poses and derivatives, light, terms, a calibration."""
    sun = ht.sun.position(TIMES[UP][:4], PLANT.site)
    counts = ht.track(NOMINAL, sun.vector, AIM).best_counts
    seen, names = measured(), ("tilt_north", "position_up")
    fitted = ht.fit(PLANT["P6A"].heliostats, seen, "guo6")
    term = DriveTerm("eccentric", "azimuth", lambda angles: np.sin(angles[..., 0]), 5e-3)
    offsets = ht.image_offsets(NOMINAL, TRUTH, sun.vector, AIM)
    return {
        "sun": sun,
        "sun now": ht.sun.position(TIMES[UP][0], PLANT.site),
        "pose": NOMINAL.pose(counts),
        "pose of one": NOMINAL.pose(counts[0]),
        "jacobian": NOMINAL.jacobian(counts, names),
        "armature": NOMINAL.armature,
        "armatures": PLANT.nominal.armature,
        "flux": ht.flux(PLANT, TIMES[UP][3]).maps[0],
        "plant flux": ht.flux(PLANT, TIMES[UP][3]),
        "offsets": offsets,
        "terms": fit_terms(PLANT["P6A"], seen, "guo6", [term]),
        "calibration": HeliostatCalibration.from_fit(
            "P6A",
            TIMES[0].timestamp(),
            fitted,
            PLANT["P6A"].heliostats.mechanism,
            seen,
            np.arange(1, len(seen) + 1),
            model="guo6",
        ),
    }


def test_records_of_one_topic_have_frames_and_datasets(tmp_path: Path) -> None:
    records = single_records()
    for name, record in records.items():
        back_from_files(name, record, tmp_path)
    frames = {name: record.to_frame() for name, record in records.items()}
    np.testing.assert_array_equal(frames["sun"]["azimuth"], records["sun"].azimuth)
    assert (frames["sun"].index == TIMES[UP][:4]).all()
    np.testing.assert_array_equal(frames["pose"]["vertex_up"], records["pose"].vertex[:, 2])
    assert len(frames["sun now"]) == len(frames["pose of one"]) == len(frames["armature"]) == 1
    assert len(frames["armatures"]) == len(PLANT)
    assert frames["sun now"]["time"].iloc[0] == TIMES[UP][0].tz_localize(None)
    assert "time" not in ht.sun.position(2.5e10, PLANT.site).to_frame()  # beyond nanoseconds
    jacobian = frames["jacobian"]
    np.testing.assert_array_equal(
        jacobian["vertex_by_north_tilt_north"], records["jacobian"].vertex[:, 0, 1]
    )
    np.testing.assert_array_equal(
        jacobian["normal_by_count_up_2"], records["jacobian"].normal_counts[:, 1, 2]
    )
    units = jacobian.attrs["units"]
    assert units["vertex_by_north_tilt_north"] == "m/rad"
    assert units["normal_by_up_position_up"] == "1/m"
    assert units["vertex_by_up_position_up"] == ""
    flux = records["flux"]
    cell = frames["flux"].loc[(flux.up[2], flux.right[5])]
    assert cell["flux"] == flux.flux[2, 5]
    assert cell["power"] == flux.power
    np.testing.assert_array_equal(frames["offsets"]["slant"], records["offsets"].slant)
    assert frames["terms"].loc["P6A", "value_eccentric"] == records["terms"].values[0, 0]
    kept = frames["calibration"].loc["P6A"]
    assert (
        kept["value_tilt_north"]
        == records["calibration"].values[records["calibration"].names.index("tilt_north")]
    )
    assert kept["at"] == TIMES[0].tz_localize(None)
