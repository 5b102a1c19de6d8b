"""Run by ARTIST's own interpreter: make a scenario from PAINT's files, or give its mirror normals.

make PROPERTIES NAMES SCENARIO, or normals SCENARIO MOTORS.json OUT.json.
"""

import json
import sys
from pathlib import Path

import h5py
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from _artist_worker import CPU, Scenario, write_scenario


def make(data: str, names: str, file: str) -> None:
    write_scenario(Path(data), names.split(","), Path(file))


def normals(scenario: str, motors: str, out: str) -> None:
    """For each heliostat, the normals at its motor positions (K, 2)."""
    with h5py.File(scenario) as file:
        loaded = Scenario.load_scenario_from_hdf5(scenario_file=file, device=CPU)
    wanted, found = json.loads(Path(motors).read_text()), {}
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
    Path(out).write_text(json.dumps(found))


{"make": make, "normals": normals}[sys.argv[1]](*sys.argv[2:])
