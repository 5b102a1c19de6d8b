"""Calibrations saved by a plant, which a simulated field's local controllers store."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.field.plant import Plant
from heliotrope.twin.yesterday import StoredParameters, by_model

#: Name of the file in the folder of a simulated field.
BOARDS = "boards.npz"


def write_boards(path: Path, records: Sequence[HeliostatCalibration]) -> None:
    """Write the parameters of calibrations for the local controllers of a simulated field."""
    arrays = {}
    for i, stored in enumerate(by_model(records)):
        arrays[f"heliostats_{i}"] = np.array(stored.heliostats)
        arrays[f"names_{i}"] = np.array(list(stored.parameters))
        arrays[f"values_{i}"] = np.stack(list(stored.parameters.values()))
    new = path.with_suffix(".new.npz")
    np.savez(new, **arrays)  # type: ignore[arg-type]
    new.replace(path)


def read_boards(path: Path, design: Plant) -> Plant:
    """Return the plant with the heliostat parameters read from a file."""
    with np.load(path) as arrays:
        for i in range(len(arrays.files) // 3):
            names = arrays[f"names_{i}"].tolist()
            values = dict(zip(names, arrays[f"values_{i}"], strict=True))
            heliostats = tuple(arrays[f"heliostats_{i}"].tolist())
            design = design.with_calibration(StoredParameters(heliostats, values))
    return design
