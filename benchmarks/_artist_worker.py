"""ARTIST's kinematic reconstruction of one heliostat after another, for `_artist`.

Runs in ARTIST's own interpreter: ``python _artist_worker.py DATA JOBS.json OUT.json``. JOBS is a
list of {"job", "heliostat", "epochs", "rate", "sightings": [{"motors", "sun", "spot", "target"}]}
with the sun as a unit vector (east, north, up) and the spot as (latitude, longitude, altitude);
OUT the same with "seconds" and "tilts" (rotations about north, up, east, north, as ARTIST counts
them).
Written against artist-csp 2.0.0 and torch 2.13.
"""

import json
import sys
import tempfile
import time
from pathlib import Path

import h5py
import torch
from artist.raytracing import HeliostatRayTracer  # noqa: F401  (first: the imports go in a circle)

from artist.geometry import coordinates  # isort: skip
from artist.io import CalibrationDataParser, paint_scenario_parser
from artist.optim import KinematicsReconstructor
from artist.optim.loss import AngleLoss
from artist.scenario import H5ScenarioGenerator, Scenario
from artist.util import constants as c
from artist.util.config import LightSourceConfig, LightSourceListConfig
from artist.util.env import DdpSetup

CPU = torch.device("cpu")


class Table(CalibrationDataParser):
    """Sightings that are known already, without photographs."""

    def __init__(self, name, sightings):
        super().__init__()
        self.name, self.sightings = name, sightings

    def parse_data_for_reconstruction(self, heliostat_group, scenario, **_):
        """Return no photographs, spots, rays, counts of the motors and targets."""
        seen = self.sightings
        counts = [len(seen) if name == self.name else 0 for name in heliostat_group.names]
        spots = torch.tensor([s["spot"] for s in seen], dtype=torch.float64)
        place = scenario.power_plant_position
        enu = coordinates.convert_wgs84_coordinates_to_local_enu(spots, place, device=CPU)
        rays = [[-x for x in s["sun"]] + [0.0] for s in seen]
        index = scenario.solar_tower.target_name_to_index
        return (
            torch.zeros(len(seen), 2, 2),
            coordinates.convert_3d_points_to_4d_format(enu, device=CPU),
            torch.tensor(rays, dtype=torch.float32),
            torch.tensor([s["motors"] for s in seen], dtype=torch.float32),
            torch.tensor(counts, dtype=torch.int32),
            torch.tensor([index[s["target"]] for s in seen]),
        )


def write_scenario(data, names, file):
    """Write a scenario with heliostats of ideal surfaces, from a folder in PAINT's form."""
    tower = data / "tower-measurements.json"
    plant, planar, round_ = paint_scenario_parser.extract_paint_tower_measurements(
        tower, device=CPU
    )
    sun = LightSourceConfig(
        light_source_key="sun",
        light_source_type=c.sun_key,
        number_of_rays=4,
        distribution_type=c.light_source_distribution_is_normal,
        mean=0.0,
        covariance=4.3681e-06,
    )
    mirrors, prototype = paint_scenario_parser.extract_paint_heliostats_ideal_surface(
        paths=[(name, data / "properties" / f"{name}.json") for name in names],
        power_plant_position=plant.power_plant_position,
        number_of_nurbs_control_points=torch.tensor([6, 6]),
        device=CPU,
    )
    H5ScenarioGenerator(
        file_path=file,
        power_plant_config=plant,
        target_area_list_planar_config=planar,
        target_area_list_cylindrical_config=round_,
        light_source_list_config=LightSourceListConfig([sun]),
        prototype_config=prototype,
        heliostat_list_config=mirrors,
    ).generate_scenario()


def scenario_of(data, name, folder):
    """Return a scenario with one heliostat of ideal surface."""
    file = Path(folder) / f"{name}.h5"
    write_scenario(data, [name], file)
    with h5py.File(file) as f:
        return Scenario.load_scenario_from_hdf5(scenario_file=f, device=CPU)


def reconstruct(data, job, folder):
    """Return the tilts of one heliostat and the seconds of the reconstruction alone."""
    scenario = scenario_of(data, job["heliostat"], folder)
    optimiser = {
        c.initial_learning_rate_rotation_deviation: job["rate"],
        c.initial_learning_rate_initial_angles: 1e-3,
        c.initial_learning_rate_initial_stroke_length: 1e-2,
        c.tolerance: 0.0,
        c.max_epoch: job["epochs"],
        c.batch_size: 50,
        c.log_step: 0,
        c.early_stopping_delta: 1e-8,
        c.early_stopping_patience: 100_000,
        c.early_stopping_window: 100_000,
    }
    schedule = {
        c.scheduler_type: c.reduce_on_plateau,
        c.gamma: 0.99,
        c.lr_min: 1e-6,
        c.reduce_factor: 0.5,
        c.patience: 50,
        c.threshold: 1e-3,
        c.cooldown: 10,
    }
    setup = DdpSetup(
        device=CPU,
        is_distributed=False,
        is_nested=False,
        rank=0,
        world_size=1,
        process_subgroup=None,
        groups_to_ranks_mapping={0: [0]},
        heliostat_group_rank=0,
        heliostat_group_world_size=1,
        ranks_to_groups_mapping={0: [0]},
    )
    worker = KinematicsReconstructor(
        ddp_setup=setup,
        scenario=scenario,
        data={
            c.data_parser: Table(job["heliostat"], job["sightings"]),
            c.heliostat_data_mapping: [],
        },
        optimization_configuration={c.optimization: optimiser, c.scheduler: schedule},
        reconstruction_method=c.kinematics_reconstruction_alignment,
    )
    torch.manual_seed(7)
    start, work = time.perf_counter(), time.process_time()
    worker.reconstruct_kinematics(loss_definition=AngleLoss(), device=CPU)
    wall, cpu = time.perf_counter() - start, time.process_time() - work
    group = scenario.heliostat_field.heliostat_groups[0]
    tilts = group.kinematics.rotation_deviation_parameters[group.names.index(job["heliostat"])]
    return {"seconds": wall, "processor_s": cpu, "tilts": tilts.tolist()}


def main():
    """Work through the jobs; write after each, so that an interrupted run is of use."""
    data, jobs, out = Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text()), sys.argv[3]
    torch.set_num_threads(1)
    # The validation of each epoch by ray tracing needs photographs.
    KinematicsReconstructor._validate = lambda *_, **__: {}
    done = []
    with tempfile.TemporaryDirectory() as folder:
        for job in jobs:
            found = reconstruct(data, job, folder)
            done.append({k: v for k, v in job.items() if k != "sightings"} | found)
            Path(out).write_text(json.dumps(done, indent=1))


if __name__ == "__main__":
    main()
