"""Conversion between Guo's parameters, in his names and units, and a mechanism's parameters.

Guo's six angles are ψ_a, ψ_t, γ₀, τ₁, α₀ and μ, in degrees; his H_z is in metres.
"""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.geometry import FloatArray, angle_between, as_float
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import SLOTS
from heliotrope.mechanism.guo import GuoParameters, forward, from_heliotrope, regularise

#: His name in a file or on the command line: (his symbol, our attribute, unit).
NAMES = {
    "psi_a": ("ψ_a", "tilt_azimuth", "°"),
    "psi_t": ("ψ_t", "tilt", "°"),
    "gamma_0": ("γ₀", "azimuth_zero", "°"),
    "tau_1": ("τ₁", "tau_1", "°"),
    "alpha_0": ("α₀", "elevation_zero", "°"),
    "mu": ("μ", "mu", "°"),
    "H_z": ("H_z", "offset", "m"),
}

#: Fixed joints of an azimuth-elevation chain that Guo's formula knows.
_JOINTS = ("tilt_north", "tilt_east", "non_orthogonality", "canting")

#: What rounding may leave between the formula and the chain, rad, and between pivots, m.
_ONE_NORMAL, _ONE_POINT = 1e-9, 1e-6


def in_his_names(parameters: GuoParameters) -> dict[str, FloatArray]:
    """Return the parameters by `NAMES`, in degrees and m, within the ranges of `regularise`."""
    p = regularise(parameters)
    return {
        name: getattr(p, ours) if unit == "m" else as_float(np.degrees(getattr(p, ours)))
        for name, (_, ours, unit) in NAMES.items()
    }


def from_his_names(values: Mapping[str, npt.ArrayLike]) -> GuoParameters:
    """Return Guo's parameters from values for any of `NAMES`, in degrees and metres.

    Raises
    ------
    InputError
        If Guo's model has no such name, or a value is not finite.
    """
    parameters = {}
    for name, value in values.items():
        if name not in NAMES:
            raise UnknownNameError("parameter of Guo's", name, NAMES)
        _, ours, unit = NAMES[name]
        parameters[ours] = as_float(value) if unit == "m" else as_float(np.radians(value))
    return GuoParameters(**parameters)


def of_mechanism(mechanism: Mechanism, *, zeros: bool = False) -> tuple[GuoParameters, FloatArray]:
    """Return Guo's parameters of azimuth-elevation mechanisms, and the mechanisms' pivots.

    Parameters
    ----------
    mechanism
        Mechanisms, batch shape (...).
    zeros
        Whether γ₀ and α₀ are the zeros of the drives, for drives without any error except their
        bias. Otherwise they are 0: Guo's γ and α are then the joint angles, which the drives
        convert into counts with all their imperfections.

    Returns
    -------
    Parameters of shape (...), and the pivots in ENU metres, (..., 3).

    Raises
    ------
    InputError
        If the mechanism is of another kind, or has features outside the formula: axes that do not
        meet, a vertex beside the normal through that point, or a rotated foundation.
    """
    if mechanism.kind != "azimuth_elevation":
        raise InputError(
            f"Guo's formula is for azimuth-elevation mechanisms, and this one is {mechanism.kind}; "
            "track it by its armature"
        )
    offset = as_float(np.sum(mechanism.vertex * mechanism.normal, axis=-1))
    values = {name: mechanism.angles[..., mechanism.joints.index(name)] for name in _JOINTS}
    parameters = from_heliotrope({**values, "pivot_offset": offset})
    # Any three poses, within the stops or not.
    gamma, alpha = np.array([[0.0, 1.5, -2.0], [0.0, 0.7, 1.2]])
    joints = np.stack([gamma, alpha], axis=-1).reshape(3, *(1,) * len(mechanism.shape), 2)
    counts = mechanism.drives.counts(np.broadcast_to(joints, (3, *mechanism.shape, 2)))
    pose, reached = mechanism.pose(counts), mechanism.drives.angles(counts)
    normal = forward(reached[..., 1], reached[..., 0], parameters)
    turned = float(angle_between(normal, pose.normal).max())
    pivots = pose.vertex - offset[..., None] * pose.normal
    wander = float(np.linalg.norm(pivots - pivots[0], axis=-1).max())
    if turned > _ONE_NORMAL or wander > _ONE_POINT:
        raise InputError(
            f"Guo's formula does not describe this mechanism: its normals differ by "
            f"{1e3 * turned:.3g} mrad and the point about which the mirror turns wanders by "
            f"{1e3 * wander:.3g} mm; track it by its armature"
        )
    if zeros:
        bias = mechanism.drives.table[..., SLOTS["bias"]]
        parameters = from_heliotrope(
            {
                **values,
                "pivot_offset": offset,
                "azimuth_bias": bias[..., 0],
                "elevation_bias": bias[..., 1],
            }
        )
    return parameters, as_float(pivots[0])
