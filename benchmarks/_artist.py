"""ARTIST's kinematic reconstruction on its own PAINT data, where both are available.

ARTIST (github.com/ARTIST-Association/ARTIST) reads PAINT measurements and a scenario of its own,
not the benchmark's synthetic field, so only the time for a heliostat can be compared.
benchmarks/README.md explains the setup. The calls are those of ARTIST's tutorial on kinematic
reconstruction; they have not been run here.
"""

import importlib.util
import os
import time
from pathlib import Path

#: Environment: the scenario (.h5), the folder of PAINT data, heliostats, epochs.
SCENARIO, DATA = "HELIOTROPE_ARTIST_SCENARIO", "HELIOTROPE_ARTIST_DATA"
HELIOSTATS, EPOCHS = "HELIOTROPE_ARTIST_HELIOSTATS", "HELIOTROPE_ARTIST_EPOCHS"
SIGHTINGS = 30


def why_skipped() -> str | None:
    """Return why ARTIST is missing from the contenders, None if it is among them."""
    try:
        found = importlib.util.find_spec("artist.core.kinematics_reconstructor")
    except ImportError:
        found = None
    if found is None:
        # The package index has an unrelated package called artist.
        return "the package artist of ARTIST-Association cannot be imported"
    missing = [name for name in (SCENARIO, DATA, HELIOSTATS) if not os.environ.get(name)]
    return f"not set: {', '.join(missing)}" if missing else None


def seconds_per_heliostat() -> float:
    """Reconstruct the heliostats named in the environment; loading is not counted."""
    import h5py
    import torch
    from artist.core.kinematics_reconstructor import KinematicsReconstructor
    from artist.core.loss_functions import FocalSpotLoss
    from artist.data_parser import paint_scenario_parser
    from artist.data_parser.paint_calibration_parser import PaintCalibrationDataParser
    from artist.scenario.scenario import Scenario
    from artist.util import config_dictionary as key
    from artist.util.environment_setup import setup_distributed_environment

    device, path = torch.device("cpu"), Path(os.environ[SCENARIO])
    names = os.environ[HELIOSTATS].split(",")
    mapping = paint_scenario_parser.build_heliostat_data_mapping(
        base_path=os.environ[DATA],
        heliostat_names=names,
        number_of_measurements=SIGHTINGS,
        image_variant="flux",
        randomize=False,
    )
    optimiser = {
        key.initial_learning_rate: 5e-4, key.tolerance: 0.0, key.batch_size: 50,
        key.max_epoch: int(os.environ.get(EPOCHS, "100")), key.log_step: 0,
        key.early_stopping_delta: 1e-4, key.early_stopping_patience: 10,
        key.early_stopping_window: 20,
    }  # fmt: skip
    schedule = {
        key.scheduler_type: key.reduce_on_plateau, key.gamma: 0.9, key.min: 1e-6, key.max: 1e-3,
        key.step_size_up: 500, key.reduce_factor: 1e-4, key.patience: 50, key.threshold: 1e-3,
        key.cooldown: 10,
    }  # fmt: skip
    groups = Scenario.get_number_of_heliostat_groups_from_hdf5(scenario_path=path)
    with setup_distributed_environment(number_of_heliostat_groups=groups, device=device) as setup:
        with h5py.File(path, "r") as file:
            scenario = Scenario.load_scenario_from_hdf5(scenario_file=file, device=device)
        reconstructor = KinematicsReconstructor(
            ddp_setup=setup,
            scenario=scenario,
            data={
                key.data_parser: PaintCalibrationDataParser(sample_limit=SIGHTINGS),
                key.heliostat_data_mapping: mapping,
            },
            optimization_configuration={key.optimization: optimiser, key.scheduler: schedule},
            reconstruction_method=key.kinematics_reconstruction_raytracing,
        )
        start = time.perf_counter()
        reconstructor.reconstruct_kinematics(
            loss_definition=FocalSpotLoss(scenario=scenario), device=device
        )
        return (time.perf_counter() - start) / len(names)
