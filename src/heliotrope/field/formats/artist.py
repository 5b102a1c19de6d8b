"""ARTIST scenarios (HDF5, version 2.0): writes calibrated mechanisms into a scenario.

ARTIST creates a scenario from PAINT's files and sets all joint tilts to 0. This module writes the
calibrated mechanisms of the heliostats into the scenario: position, translations, all four tilts
and the actuators. Surfaces, targets and sun remain unchanged.
"""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FormatError, InputError
from heliotrope.field.formats.paint import kinematics_properties, without_place, written
from heliotrope.field.heliostats import Heliostats
from heliotrope.files import check_file, write_file
from heliotrope.geometry import enu_to_geodetic, geodetic_to_enu

if TYPE_CHECKING:
    import h5py

_WHAT = "an ARTIST scenario"
#: ARTIST's names of the deviations, by PAINT's names; PAINT's ``joint_tilt_e_2`` tilts the second
#: joint.
_DEVIATIONS = {
    f"{ours}_{axis}{number}": f"{theirs}_{axis}"
    for ours, number, theirs, axes in (
        ("joint_translation", "_1", "first_joint_translation", "enu"),
        ("joint_translation", "_2", "second_joint_translation", "enu"),
        ("concentrator_translation", "", "concentrator_translation", "enu"),
        ("joint_tilt", "_1", "first_joint_tilt", "nu"),
        ("joint_tilt", "_2", "second_joint_tilt", "en"),
    )
    for axis in axes
}
_PARAMETERS = ("increment", "initial_stroke_length", "offset", "pivot_radius", "initial_angle")


def write_scenario(
    path: str | Path,
    scenario: str | Path,
    heliostats: Mapping[str, Heliostats],
    origin: tuple[float, float, float],
) -> dict[str, tuple[str, ...]]:
    """Write a copy of a scenario with the calibrated mechanisms of some heliostats.

    Parameters
    ----------
    path
        Path of the new scenario, which is written completely or not at all.
    scenario
        Scenario created by ARTIST's generator; not changed, unless it is ``path``.
    heliostats
        The group of each heliostat, by heliostat name; the groups are of kind ``two_jacks``.
    origin
        WGS84 latitude and longitude (degrees) and height (m) of the plant's ENU axes.

    Returns
    -------
    The parameters that the format cannot represent, by heliostat, each with its value and unit.

    Raises
    ------
    FormatError
        If the scenario cannot be read, or has a different layout.
    InputError
        If a heliostat is not in the scenario, or is of a different kind.
    """
    import h5py

    file = check_file(scenario, _WHAT, binary=True)
    held, lost = io.BytesIO(file.read_bytes()), dict[str, tuple[str, ...]]()
    try:
        with h5py.File(held, "r+") as root:
            known, tower = root["heliostats"], root["power_plant/position"][()]
            for name, group in heliostats.items():
                if name not in known:
                    raise InputError(
                        f"heliostat {name}: {file} has {len(known)} heliostats, but none with "
                        "that name; create the scenario with this heliostat"
                    )
                mechanism = written(group, name)
                foot = enu_to_geodetic(mechanism.position, origin)
                latitude, longitude, height = (float(v) for v in tower)
                local = geodetic_to_enu(*foot, (latitude, longitude, height))
                _write(known[name], "position", np.append(local, 1.0))
                _mechanism(root, known[name], kinematics_properties(mechanism))
                lost[name] = without_place(mechanism)
    except (OSError, RuntimeError, KeyError) as error:
        raise FormatError(file, f"{str(error)[:80]}; expected {_WHAT}") from None
    write_file(path, lambda stream: stream.write(held.getvalue()))
    return lost


def _mechanism(root: "h5py.File", own: "h5py.Group", properties: dict[str, Any]) -> None:
    for part in ("kinematics", "actuator"):
        if part not in own:  # the heliostat used the prototype's
            root.copy(f"prototypes/{part}", own, part)
    for ours, theirs in _DEVIATIONS.items():
        _write(own, f"kinematics/deviations/{theirs}", properties[ours])
    for k, actuator in enumerate(properties["actuators"]):
        axis = own[f"actuator/actuator_{k}"]
        for name in _PARAMETERS:
            _write(axis, f"parameters/{name}", actuator[name])
        _write(axis, "clockwise_axis_movement", bool(actuator["clockwise_axis_movement"]))
        limits = [actuator["min_increment"], actuator["max_increment"]]
        if np.isfinite(limits).all():
            _write(axis, "min_max_motor_positions", np.round(limits).astype(np.int64))
        del axis["type"]
        axis["type"] = "linear"


def _write(place: "h5py.Group", name: str, value: npt.ArrayLike) -> None:
    """Replace a value, in single precision as in ARTIST."""
    array = np.asarray(value)
    if name in place:
        del place[name]
    place[name] = array.astype(np.float32) if array.dtype.kind == "f" else array
