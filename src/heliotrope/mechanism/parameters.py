"""The parameters of a mechanism: one table with one entry per parameter, and the models.

Outside the compiled kernels a parameter is never addressed by an index. Its table entry gives the
unit, the physical cause with its positive sense, the names in the literature, and the standard
deviation that remains after installation and survey (the prior).
"""

from dataclasses import dataclass, replace
from functools import cache

from heliotrope.errors import UnknownNameError
from heliotrope.mechanism.kernels import slots as slot


@dataclass(frozen=True)
class Parameter:
    """An entry of the parameter table.

    Attributes
    ----------
    name
        Name of the parameter, for example ``tilt_north``.
    unit
        "rad", "m" or "1" (relative).
    cause
        Physical cause in the mechanism.
    positive
        Meaning of a positive value.
    prior
        Standard deviation before any measurement, in ``unit``.
    aliases
        Names in the literature.
    code
        Code for the kernels: (kind, joint or drive, component).
    """

    name: str
    unit: str
    cause: str
    positive: str
    prior: float
    aliases: tuple[str, ...] = ()
    code: tuple[int, int, int] = (0, 0, 0)


#: Entries that every mechanism has; their codes do not depend on the joints.
_PLACE = (
    Parameter(
        "position_east",
        "m",
        "survey error",
        "heliostat is further east",
        0.05,
        ("Malan ΔE",),
        (slot.MOVES_POSITION, 0, 0),
    ),
    Parameter(
        "position_north",
        "m",
        "survey error",
        "heliostat is further north",
        0.05,
        ("Malan ΔN",),
        (slot.MOVES_POSITION, 0, 1),
    ),
    Parameter(
        "position_up",
        "m",
        "survey error",
        "heliostat is higher",
        0.05,
        ("Malan ΔZ",),
        (slot.MOVES_POSITION, 0, 2),
    ),
    Parameter(
        "pivot_offset",
        "m",
        "distance of the mirror's surface from the pivot",
        "surface is further in front of the pivot",
        0.02,
        ("Guo H_z",),
        (slot.MOVES_ALONG_NORMAL, 0, 0),
    ),
)

#: Entries by the name of a fixed joint.
_JOINTS = {
    row.name: row
    for row in (
        Parameter(
            "tilt_north",
            "rad",
            "pedestal not upright",
            "primary axis leans towards north",
            0.010,
            ("Malan ε_ptN", "Guo ψ_t, ψ_a in polar form"),
        ),
        Parameter(
            "tilt_east",
            "rad",
            "pedestal not upright",
            "primary axis leans towards east",
            0.010,
            ("Malan ε_ptE", "Guo ψ_t, ψ_a in polar form"),
        ),
        Parameter(
            "tilt_up",
            "rad",
            "primary bearing not level",
            "primary axis leans up",
            0.010,
            ("PAINT −first_joint_tilt_n",),
        ),
        Parameter(
            "non_orthogonality",
            "rad",
            "secondary axis not perpendicular to primary",
            "secondary axis leans towards the positive primary axis",
            0.005,
            ("Malan ε_NO", "Guo −τ₁", "PAINT second_joint_tilt_n"),
        ),
        Parameter(
            "canting",
            "rad",
            "normal not perpendicular to the secondary axis",
            "normal leans towards the positive secondary axis",
            0.005,
            ("Guo μ", "boresight (Khalsa)"),
        ),
        Parameter(
            "canting_secondary",
            "rad",
            "normal turned about the secondary axis",
            "right-handed about that axis",
            0.005,
        ),
    )
}

#: Entries of a drive: (suffix, slot, entry). The name is "<joint>_<suffix>".
_ANY_DRIVE = (
    (
        "bias",
        slot.BIAS,
        Parameter(
            "",
            "rad",
            "encoder zero",
            "actual = ideal + bias",
            0.010,
            ("Malan γ_bias, α_bias", "Guo −γ₀, −α₀"),
        ),
    ),
    (
        "scale",
        slot.SCALE,
        Parameter(
            "",
            "1",
            "gear ratio error",
            "moves further than ideal",
            1e-3,
            ("Baheti & Scott", "linear error (Khalsa)"),
        ),
    ),
    (
        "worm_cos",
        slot.WORM_COS,
        Parameter(
            "",
            "rad",
            "once-per-turn gear error, cosine part",
            "adds cos(ratio · angle)",
            0.002,
            ("Malan (6.1)",),
        ),
    ),
    (
        "worm_sin",
        slot.WORM_SIN,
        Parameter(
            "",
            "rad",
            "once-per-turn gear error, sine part",
            "adds sin(ratio · angle)",
            0.002,
            ("Malan (6.1)",),
        ),
    ),
    (
        "worm_ratio",
        slot.WORM_RATIO,
        # Searched in the residuals, never fitted: its derivative counts as 0.
        Parameter(
            "",
            "1",
            "turns of the worm per turn (jack: rad per m of stroke), found by search, not fitted",
            "worm turns faster than stated in the plant file",
            0.5,
            ("Malan (6.1)",),
        ),
    ),
)

_LINEAR_DRIVE = (
    (
        "stroke_offset",
        slot.STROKE,
        Parameter(
            "",
            "m",
            "length of the jack at 0 counts",
            "longer",
            0.005,
            ("PAINT initial_stroke_length",),
        ),
    ),
    (
        "initial_angle",
        slot.ZERO,
        Parameter("", "rad", "angle at 0 counts", "larger", 0.020, ("PAINT initial_angle",)),
    ),
    (
        "offset",
        slot.OFFSET,
        Parameter("", "m", "joint to the fixed end", "longer", 0.003, ("PAINT offset",)),
    ),
    (
        "pivot_radius",
        slot.RADIUS,
        Parameter("", "m", "joint to the moving end", "longer", 0.003, ("PAINT pivot_radius",)),
    ),
)

_SAG = Parameter(
    "sag",
    "rad",
    "gravity bends the structure, ∝ cos(elevation)",
    "adds to the angle of the elevation joint",
    0.002,
    ("Stone & Kiefer",),
)


def table(
    joints: tuple[str, ...], driven: tuple[int, ...], linear: tuple[bool, ...]
) -> dict[str, Parameter]:
    """Return the parameter table of a kind of mechanism, by name.

    Parameters
    ----------
    joints
        Names of the joints from ground to mirror.
    driven
        Indices of the driven joints.
    linear
        For each driven joint, whether its drive is a jack.
    """
    return dict(_table(joints, driven, linear))


@cache
def _table(
    joints: tuple[str, ...], driven: tuple[int, ...], linear: tuple[bool, ...]
) -> dict[str, Parameter]:
    """Return the result of `table` from a cache, because every moved mechanism needs it again."""
    rows = list(_PLACE)
    for index, name in enumerate(joints):
        if name in _JOINTS:
            rows.append(replace(_JOINTS[name], code=(slot.MOVES_JOINT, index, 0)))
    for d, index in enumerate(driven):
        kinds = _ANY_DRIVE + (_LINEAR_DRIVE if linear[d] else ())
        for suffix, place, row in kinds:
            name = f"{joints[index]}_{suffix}"
            rows.append(
                replace(
                    row,
                    name=name,
                    cause=f"{joints[index]}: {row.cause}",
                    code=(slot.MOVES_DRIVE, d, place),
                )
            )
        if joints[index] == "elevation":
            rows.append(replace(_SAG, code=(slot.MOVES_DRIVE, d, slot.SAG)))
    return {row.name: row for row in rows}


_POSITION = ("position_east", "position_north", "position_up")
_AZEL = ("tilt_north", "tilt_east", "azimuth_bias", "elevation_bias", "non_orthogonality")
_JACKS = (
    "tilt_north", "tilt_up", "non_orthogonality", "canting",
    "elevation_initial_angle", "azimuth_initial_angle",
    "elevation_stroke_offset", "azimuth_stroke_offset",
    "elevation_offset", "azimuth_offset",
)  # fmt: skip

#: Named subsets of parameters to estimate. ``full`` is every parameter except the worm terms,
#: because the worm ratio must be known.
MODELS: dict[str, tuple[str, ...]] = {
    "malan8": _POSITION + _AZEL,
    "guo6": (*_AZEL, "canting"),
    "khalsa8": (*_AZEL, "canting", "azimuth_scale", "elevation_scale"),
    "jacks": _JACKS,
}


#: Parts that every kind of two-axis mechanism has, whatever its joints are called.
_ROLES = ("position", "tilts", "biases", "scales", "non_orthogonality", "canting")
#: The models that consist of roles, for kinds whose joints have other names.
_BY_ROLE: dict[str, tuple[str, ...]] = {
    "malan8": ("position", "tilts", "biases", "non_orthogonality"),
    "guo6": ("tilts", "biases", "non_orthogonality", "canting"),
    "khalsa8": ("tilts", "biases", "non_orthogonality", "canting", "scales"),
}


def model(name: str, known: dict[str, Parameter]) -> tuple[str, ...]:
    """Return the parameter names of model ``name`` for a mechanism with table ``known``.

    Parameters
    ----------
    name
        A model, a role ("position", "tilts", "biases", "scales", "non_orthogonality", "canting"), a
        parameter, or several of them joined by "+", such as "malan8+canting". A model defined for
        azimuth and elevation selects the parameters with the same role in other kinds.
    known
        Parameter table of the mechanism.

    Raises
    ------
    UnknownNameError
        If there is no such model, or the mechanism lacks one of its parameters.
    """
    names: dict[str, None] = {}
    for part in name.split("+"):
        names |= dict.fromkeys(_part(part.strip(), known))
    return tuple(names)


def _part(name: str, known: dict[str, Parameter]) -> tuple[str, ...]:
    if name == "full":
        return tuple(n for n in known if "_worm_" not in n and not n.endswith("pivot_radius"))
    if name in MODELS:
        missing = [parameter for parameter in MODELS[name] if parameter not in known]
        if not missing:
            return MODELS[name]
        if name not in _BY_ROLE:
            raise UnknownNameError(
                f"parameter (of model {name!r}) in this kind of mechanism:", missing[0], known
            )
        # A mechanism with one axis has no second axis that could lean.
        roles = [role for role in _BY_ROLE[name] if len(_drives(known)) > 1 or role not in _SECOND]
        return tuple(n for role in roles for n in _role(role, known))
    if name in _ROLES:
        return _role(name, known)
    if name in known:
        return (name,)
    raise UnknownNameError("model", name, [*MODELS, "full", *_ROLES])


#: Roles that need two axes.
_SECOND = ("non_orthogonality", "canting")


def _drives(known: dict[str, Parameter]) -> set[int]:
    return {p.code[1] for p in known.values() if p.code[0] == slot.MOVES_DRIVE}


def _role(role: str, known: dict[str, Parameter]) -> tuple[str, ...]:
    """Return the parameters with a role, in the order of the table."""
    if role in known:
        return (role,)
    begins = {"position": "position_", "tilts": "tilt_"}
    ends = {"biases": "_bias", "scales": "_scale"}
    if role in begins:
        # A drive that is called tilt has parameters of its own, such as tilt_bias.
        kind = slot.MOVES_POSITION if role == "position" else slot.MOVES_JOINT
        names = [n for n, p in known.items() if n.startswith(begins[role]) and p.code[0] == kind]
    else:
        end = ends.get(role, role)
        names = [n for n, p in known.items() if n.endswith(end) and p.code[0] == slot.MOVES_DRIVE]
    if not names:
        raise UnknownNameError("parameters of this role in this kind of mechanism:", role, known)
    return tuple(names)


def unit_of(name: str) -> str:
    """Return the unit of a parameter; empty if it has none."""
    rows = (*_PLACE, *_JOINTS.values(), _SAG)
    units = {row.name: row.unit for row in rows}
    units |= {suffix: row.unit for suffix, _, row in (*_ANY_DRIVE, *_LINEAR_DRIVE)}
    match = units.get(name) or next(
        (unit for end, unit in units.items() if name.endswith(f"_{end}")), "1"
    )
    return "" if match == "1" else match


def shown_in(name: str) -> tuple[float, str]:
    """Return the factor and the unit with which a parameter is displayed: mrad, mm or none."""
    return {"rad": (1e3, "mrad"), "m": (1e3, "mm")}.get(unit_of(name), (1.0, ""))
