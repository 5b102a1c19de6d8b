"""Run by ARTIST's own interpreter: make a scenario from PAINT's files, or give its mirror normals.

make PROPERTIES NAMES SCENARIO, or normals SCENARIO MOTORS.json OUT.json.
"""

# ruff: noqa: I001 - ARTIST is imported in its own order
import json
import pathlib
import sys

import h5py
import torch
from artist.raytracing import HeliostatRayTracer  # noqa: F401 - first: its imports go in a circle
from artist.io import paint_scenario_parser as paint
from artist.scenario import H5ScenarioGenerator, Scenario
from artist.util import constants
from artist.util.config import LightSourceConfig, LightSourceListConfig

CPU = torch.device("cpu")


def make(data: str, names: str, file: str) -> None:
    folder = pathlib.Path(data)
    plant, planar, cylinder = paint.extract_paint_tower_measurements(
        folder / "tower-measurements.json", device=CPU
    )
    sun = LightSourceConfig(
        light_source_key="sun",
        light_source_type=constants.sun_key,
        number_of_rays=4,
        distribution_type=constants.light_source_distribution_is_normal,
        mean=0.0,
        covariance=4.3681e-06,
    )
    mirrors, prototype = paint.extract_paint_heliostats_ideal_surface(
        paths=[(name, folder / "properties" / f"{name}.json") for name in names.split(",")],
        power_plant_position=plant.power_plant_position,
        number_of_nurbs_control_points=torch.tensor([6, 6]),
        device=CPU,
    )
    H5ScenarioGenerator(
        file_path=pathlib.Path(file),
        power_plant_config=plant,
        target_area_list_planar_config=planar,
        target_area_list_cylindrical_config=cylinder,
        light_source_list_config=LightSourceListConfig([sun]),
        prototype_config=prototype,
        heliostat_list_config=mirrors,
    ).generate_scenario()


def normals(scenario: str, motors: str, out: str) -> None:
    """For each heliostat, the normals at its motor positions (K, 2)."""
    with h5py.File(scenario) as file:
        loaded = Scenario.load_scenario_from_hdf5(scenario_file=file, device=CPU)
    wanted, found = json.loads(pathlib.Path(motors).read_text()), {}
    for group in loaded.heliostat_field.heliostat_groups:
        for i, name in enumerate(group.names):
            if name not in wanted:
                continue
            mask = torch.zeros(len(group.names), dtype=torch.int32)
            mask[i] = len(wanted[name])
            group.activate_heliostats(active_heliostats_mask=mask, device=CPU)
            turned = group.kinematics.motor_positions_to_orientations(
                torch.tensor(wanted[name], dtype=torch.float32), CPU
            )
            found[name] = turned[:, :3, 2].tolist()
    pathlib.Path(out).write_text(json.dumps(found))


{"make": make, "normals": normals}[sys.argv[1]](*sys.argv[2:])
