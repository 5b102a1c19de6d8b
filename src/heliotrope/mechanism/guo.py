r"""Guo's closed-form solution for azimuth-elevation heliostats.

Six small angles and the mirror offset describe the heliostat; its two joint angles follow from the
sun position without iteration. In the ENU frame the normal at drive positions (γ, α) is

$$n = R_{tilt}(ψ_a, ψ_t)\,R_U(-(γ - γ_0))\,R_N(-τ_1)\,R_E(α - α_0)\,(\sin μ, \cos μ, 0)$$

where R_X is the right-handed rotation about X, and R_tilt tilts the azimuth axis by ψ_t towards the
azimuth ψ_a. `forward` evaluates this equation, `angles` inverts it, and `track` inverts it for the
normal that the sun and the target require.

Source: Guo, Sun, Wang and Zhang, "Properties of a general azimuth-elevation tracking angle formula
for a heliostat with a mirror-pivot offset and other angular errors", Solar Energy 96 (2013)
159-167; here "Guo". Its frame is left-handed (north, east, height), but the angles are the same in
our frame. Its actuator, (41)-(42), is `heliotrope.mechanism.drives.linear_guo`. The derivations,
and the proof that `regularise` uses every existing symmetry, are in `docs/explanation/guo.md`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.geometry import (
    FloatArray,
    angle_between,
    as_float,
    as_vectors,
    bisector,
    common_shape,
    direction,
    normalize,
    rotation,
    wrap_positive,
    wrap_signed,
)

#: A demanded normal counts as reached within this angle, rad; rounding leaves 1e-15.
REACHED = 1e-12

#: Least |cos μ cos τ₁|. Below this value, rounding alone moves α by 1e-7 rad.
LEAST_COSINE = 1e-9

#: Iterations from (5) to the exact offset: one suffices at field distances, six up to h = 0.99.
_NEWTON_STEPS = 6

#: Malan's names for the parameters that his model shares with ours.
MALAN_NAMES = {
    "eptN": "tilt_north",
    "eptE": "tilt_east",
    "gb": "azimuth_bias",
    "ab": "elevation_bias",
    "eNO": "non_orthogonality",
}

_HELIOTROPE_NAMES = (*MALAN_NAMES.values(), "canting", "pivot_offset")


@dataclass(frozen=True, init=False, eq=False)
class GuoParameters:
    """Guo's parameters of one heliostat or of a field; the shapes broadcast together.

    Attributes
    ----------
    tilt, tilt_azimuth
        ψ_t, angle of the azimuth axis from the vertical, and ψ_a, azimuth towards which
        it leans, rad.
    azimuth_zero, elevation_zero
        γ₀ and α₀, rad: measured minus true angle, (44) and (46), so that joint angle = drive
        position − zero. Our ``azimuth_bias`` and ``elevation_bias`` have the opposite sign.
    tau_1
        τ₁, angle by which the right-hand end of the elevation axis (looking the way the
        mirror faces) is raised out of square with the azimuth axis, rad.
    mu
        μ, angle of the mirror's normal towards that end, out of square with the axis, rad.
    offset
        H_z, distance of the mirror's surface in front of the pivot, m.

    Raises
    ------
    InputError
        If a number is not finite or the shapes do not broadcast.
    """

    tilt: FloatArray
    tilt_azimuth: FloatArray
    azimuth_zero: FloatArray
    elevation_zero: FloatArray
    tau_1: FloatArray
    mu: FloatArray
    offset: FloatArray

    def __init__(
        self,
        *,
        tilt: npt.ArrayLike = 0.0,
        tilt_azimuth: npt.ArrayLike = 0.0,
        azimuth_zero: npt.ArrayLike = 0.0,
        elevation_zero: npt.ArrayLike = 0.0,
        tau_1: npt.ArrayLike = 0.0,
        mu: npt.ArrayLike = 0.0,
        offset: npt.ArrayLike = 0.0,
    ) -> None:
        values = (tilt, tilt_azimuth, azimuth_zero, elevation_zero, tau_1, mu, offset)
        for field, value in zip(fields(self), values, strict=True):
            array = numbers(value, f"Guo's parameter {field.name}").copy()
            array.flags.writeable = False
            object.__setattr__(self, field.name, array)
        common_shape(**vars(self))


@dataclass(frozen=True, eq=False)
class MirrorNormal:
    """The normal that the sun and the target require.

    Attributes
    ----------
    normal
        Unit normals in ENU, shape (..., 3).
    theta, tau
        θ, half of the angle between sun and target at the pivot, and τ, by which the
        offset turns the normal from the sun to the target, rad, shape (...). The mirror
        sees the sun under the incidence angle θ + τ.
    """

    normal: FloatArray
    theta: FloatArray
    tau: FloatArray


@dataclass(frozen=True, eq=False)
class GuoTracking:
    """Drive positions for a required normal, on both branches.

    Attributes
    ----------
    alpha
        Elevation drive, rad, shape (..., 2). The joint angle ``alpha − elevation_zero``
        lies in [−π/2, π/2] on branch 0 and in [π/2, 3π/2], over the top, on branch 1.
    gamma
        Azimuth drive in [0, 2π), rad, shape (..., 2).
    normal
        The required unit normals in ENU, shape (..., 3).
    residual, reachable
        Angle between the required normal and the normal at the drive positions, rad, for the worse
        of the two branches (a tracking error); and whether this angle is at most `REACHED`; each of
        shape (...).
    """

    alpha: FloatArray
    gamma: FloatArray
    normal: FloatArray
    residual: FloatArray
    reachable: npt.NDArray[np.bool_]

    @property
    def status(self) -> npt.NDArray[np.str_]:
        """Return "ok" or "unreachable", in an array of shape (...)."""
        return np.where(self.reachable, "ok", "unreachable")


def mirror_normal(
    to_target: npt.ArrayLike,
    sun: npt.ArrayLike,
    offset: npt.ArrayLike = 0.0,
    *,
    exact: bool = False,
) -> MirrorNormal:
    """Return the normal with which a mirror in front of its pivot sends the sun to the target.

    Validity: |offset| below the distance. With h = offset / distance, the error of (5) is below
    h⁴/40 rad up to h = 1/2, that is, 4e-9 rad for 0.5 m at 25 m; the error of the exact form is
    1e-15 rad up to h = 0.99. There is no division by sin θ, so retroreflection (θ = 0) is an
    ordinary case. Source: Guo (5), and (26) divided by cos τ.

    Parameters
    ----------
    to_target
        Vectors from the pivot to the target in ENU, m, shape (..., 3).
    sun
        Vectors to the sun in ENU, of any length, shape (..., 3).
    offset
        H_z, m, shape (...).
    exact
        Whether to solve for τ exactly instead of with Guo's (5).

    Raises
    ------
    InputError
        If a vector is zero, sun and target are opposite, or the offset reaches the target.
    """
    target = as_vectors(to_target, "to_target")
    distance = as_float(np.linalg.norm(target, axis=-1))
    at_pivot = "the target is at the pivot (0 m); pass the vector from the pivot to the target"
    refuse(distance == 0.0, "to_target", lambda _: at_pivot)
    s, t = normalize(sun, "sun"), normalize(target, "to_target")
    height = numbers(offset, "offset")
    shape = common_shape(to_target=t[..., 0], sun=s[..., 0], offset=height)
    distance, height = np.broadcast_to(distance, shape), np.broadcast_to(height, shape)
    refuse(
        np.abs(height) >= distance,
        "offset",
        lambda i: f"{height[i]:g} m reaches the target, {distance[i]:g} m away; use metres",
    )
    b = bisector(s, t)
    cos_theta = 0.5 * np.linalg.norm(s + t, axis=-1)
    sin_theta = 0.5 * np.linalg.norm(t - s, axis=-1)
    q = _offset_slope(height / distance, sin_theta, cos_theta, exact=exact)
    # tan τ = q sin θ and t − s = 2 sin θ u, so cos τ b + sin τ u ∥ b + q (t − s) / 2.
    return MirrorNormal(
        normal=normalize(b + 0.5 * q[..., None] * (t - s)),
        theta=np.broadcast_to(np.arctan2(sin_theta, cos_theta), shape),
        tau=as_float(np.arctan(q * sin_theta)),
    )


def _offset_slope(
    h: FloatArray, sin_theta: FloatArray, cos_theta: FloatArray, *, exact: bool
) -> FloatArray:
    """Return q = tan τ / sin θ for h = offset / distance.

    The triangle of pivot, vertex and target yields sin 2τ = h sin(θ + τ). Divided by cos τ, this
    becomes 2 sin τ = h (sin θ + cos θ tan τ). Guo's (5) replaces tan τ with sin τ.
    """
    p = h / (2.0 - h * cos_theta)
    q = p / np.sqrt(1.0 - (p * sin_theta) ** 2)
    for _ in range(_NEWTON_STEPS if exact else 0):
        root = 1.0 + (q * sin_theta) ** 2
        error = 2.0 * q / np.sqrt(root) - h * (1.0 + q * cos_theta)
        q = q - error / (2.0 * root**-1.5 - h * cos_theta)
    return as_float(q)


def forward(alpha: npt.ArrayLike, gamma: npt.ArrayLike, parameters: GuoParameters) -> FloatArray:
    """Return the unit normals in ENU at drive positions, (..., 3), by Guo's (29), to 1e-15.

    Parameters
    ----------
    alpha, gamma
        Elevation and azimuth drive, rad, shape (...).
    parameters
        Parameters with shapes that broadcast against (...).

    Raises
    ------
    InputError
        If a number is not finite or the shapes do not broadcast.
    """
    p = parameters
    a, g = numbers(alpha, "alpha"), numbers(gamma, "gamma")
    common_shape(alpha=a, gamma=g, **vars(p))
    a, g = a - p.elevation_zero, g - p.azimuth_zero
    x = np.sin(p.mu) * np.cos(p.tau_1) - np.cos(p.mu) * np.sin(a) * np.sin(p.tau_1)
    y = np.cos(p.mu) * np.cos(a)
    z = np.sin(p.mu) * np.sin(p.tau_1) + np.cos(p.mu) * np.sin(a) * np.cos(p.tau_1)
    east, north = x * np.cos(g) + y * np.sin(g), y * np.cos(g) - x * np.sin(g)
    c = np.stack(np.broadcast_arrays(east, north, z), axis=-1)
    return as_float(np.einsum("...ij,...j->...i", _tilt_rotation(p.tilt, p.tilt_azimuth), c))


def angles(normal: npt.ArrayLike, parameters: GuoParameters) -> GuoTracking:
    """Return the drive positions at which the mirror has a given normal, on both branches.

    A normal in a dead cone, closer than |μ − τ₁| to the azimuth axis or than |μ + τ₁| to its foot,
    yields the nearest pose and its residual. If the normal is parallel to the azimuth axis, so that
    any azimuth would do, the azimuth joint is at 0.

    Accuracy: the residual is below 1e-14 rad everywhere, even at the keyhole, where computing α
    with arcsin would leave 1e-8 rad. Source: the part of Guo (1)-(28) that leads from the normal to
    the angles, with (19) in half angles and (22) computed with atan2.

    Parameters
    ----------
    normal
        Vectors in ENU of any length, shape (..., 3).
    parameters
        Parameters with shapes that broadcast against (...).

    Raises
    ------
    InputError
        If cos μ cos τ₁ = 0, a vector is zero or not finite, or shapes do not broadcast.
    """
    p = parameters
    n = normalize(normal, "normal")
    shape = common_shape(normal=n[..., 0], **vars(p))
    tau_1, mu = np.broadcast_to(p.tau_1, shape), np.broadcast_to(p.mu, shape)
    refuse(
        np.abs(np.cos(mu) * np.cos(tau_1)) < LEAST_COSINE,
        "Guo's parameters",
        lambda i: (
            f"cos μ cos τ₁ = 0 at mu {mu[i]:g} rad, tau_1 {tau_1[i]:g} rad: no elevation "
            "raises the normal; keep both away from ±π/2"
        ),
    )
    c = np.einsum("...ji,...j->...i", _tilt_rotation(p.tilt, p.tilt_azimuth), n)
    # The branches lie along a first axis here, so that the parameters broadcast.
    co_elevation = _co_elevation(c, tau_1, mu)
    beta = np.stack([co_elevation, -co_elevation])
    alpha = 0.5 * np.pi - beta + p.elevation_zero
    gamma = wrap_positive(_azimuth(c, beta, tau_1, mu) + p.azimuth_zero)
    residual = as_float(angle_between(n, forward(alpha, gamma, p)).max(axis=0))
    return GuoTracking(
        alpha=np.moveaxis(alpha, 0, -1),
        gamma=np.moveaxis(gamma, 0, -1),
        normal=np.broadcast_to(n, (*shape, 3)),
        residual=residual,
        reachable=residual <= REACHED,
    )


def _co_elevation(c: FloatArray, tau_1: FloatArray, mu: FloatArray) -> FloatArray:
    """Return β = π/2 − α in [0, π] for normals c in the tilted frame.

    sin α = (cos ζ − sin μ sin τ₁) / (cos μ cos τ₁), where ζ is the angle from the azimuth axis.
    Then tan²(β/2) = (1 − sin α) / (1 + sin α), with numerator and denominator written as products:
    cos(μ − τ₁) − cos ζ above and cos(μ + τ₁) + cos ζ below. If a product is negative, the normal
    lies in a dead cone; clamping the product yields the nearest pose.
    """
    zeta = np.arctan2(np.hypot(c[..., 0], c[..., 1]), c[..., 2])
    near, far = 0.5 * (mu - tau_1), 0.5 * (mu + tau_1)
    half = 0.5 * zeta
    sign = np.sign(np.cos(mu) * np.cos(tau_1))
    above = sign * np.sin(half - near) * np.sin(half + near)
    below = sign * np.cos(half - far) * np.cos(half + far)
    return as_float(2.0 * np.arctan2(np.sqrt(np.maximum(above, 0)), np.sqrt(np.maximum(below, 0))))


def _azimuth(c: FloatArray, beta: FloatArray, tau_1: FloatArray, mu: FloatArray) -> FloatArray:
    """Return the azimuth joint angle that rotates the normal (x, y) at azimuth 0 onto c."""
    x = np.sin(mu) * np.cos(tau_1) - np.cos(mu) * np.sin(tau_1) * np.cos(beta)
    y = np.cos(mu) * np.sin(beta)
    east = c[..., 0] * y - c[..., 1] * x
    north = c[..., 1] * y + c[..., 0] * x
    # atan2 of two zeros may be ±π, depending on their signs.
    free = (east == 0.0) & (north == 0.0)
    return as_float(np.where(free, 0.0, np.arctan2(east, north)))


def track(
    to_target: npt.ArrayLike, sun: npt.ArrayLike, parameters: GuoParameters, *, exact: bool = False
) -> GuoTracking:
    """Return the drive positions that reflect the sun to the target by Guo's formula.

    For validity, accuracy and source see `mirror_normal` and `angles`. Stops are ignored.

    Parameters
    ----------
    to_target, sun, exact
        As for `mirror_normal`.
    parameters
        Parameters with shapes that broadcast to (...). A field of N heliostats at T times takes
        ``to_target`` (N, 3), ``sun`` (T, 1, 3) and parameters (N,).

    Raises
    ------
    InputError
        As for `mirror_normal` and `angles`.
    """
    demanded = mirror_normal(to_target, sun, parameters.offset, exact=exact)
    return angles(demanded.normal, parameters)


def regularise(parameters: GuoParameters) -> GuoParameters:
    """Return the same mechanism with its parameters in their natural ranges.

    A fit may end at any of several equivalent parameter sets. The returned set has ψ_t in [0, π/2]
    (in (π/2, π] only if the azimuth axis points below the horizon, which no relation can raise),
    ψ_a in [0, 2π), γ₀ in [−π, π), τ₁ and α₀ in [−π/2, π/2]; ψ_a is 0 if there is no tilt. μ lies in
    [−π/2, π/2] as well unless cos τ₁ cos μ cos α₀ < 0. No relation changes the sign of this
    product, so one of the three angles must then lie outside its range; μ is chosen. The result of
    `forward` stays the same to 1e-14 for every drive position. Values already in their ranges are
    not changed, so a second call changes nothing.

    Source: Guo (31)-(37), (39) and (40). Guo's ranges are "for example" 0 to 360° for γ₀, ψ_t and
    ψ_a; our range for γ₀ is ±180°, so that a zero of −6 mrad is displayed as −6 mrad.
    """
    p = parameters
    tilt = _wrap(p.tilt)
    # Without this the second call would take π for −π and turn ψ_a.
    tilt = np.where(tilt == -np.pi, np.pi, tilt)
    turned = np.where(tilt < 0.0, p.tilt_azimuth + np.pi, p.tilt_azimuth)
    # (40), then (39); the end of the range absorbs what rounding adds.
    tau_1, tau_folded = _fold(_wrap(p.tau_1))
    elevation = _wrap(p.elevation_zero + np.pi * tau_folded)
    over = np.abs(elevation) > 0.5 * np.pi
    turned_over = np.clip(_wrap(elevation + np.pi), -0.5 * np.pi, 0.5 * np.pi)
    return replace(
        p,
        tilt=np.abs(tilt),
        tilt_azimuth=np.where(tilt == 0.0, 0.0, wrap_positive(turned)),
        azimuth_zero=_wrap(p.azimuth_zero + np.pi * tau_folded),
        elevation_zero=np.where(over, turned_over, elevation),
        tau_1=tau_1,
        mu=np.where(over, _wrap(np.pi - p.mu), _wrap(p.mu)),
    )


def _wrap(angle: npt.ArrayLike) -> FloatArray:
    """Return the angle in [−π, π), unchanged to the last bit if it already lies there."""
    a = as_float(angle)
    return as_float(np.where((a >= -np.pi) & (a < np.pi), a, wrap_signed(a)))


def _fold(angle: FloatArray) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Return π − angle (modulo 2π) where |angle| > π/2, and a mask of these places."""
    folded = np.abs(angle) > 0.5 * np.pi
    return as_float(np.where(folded, np.copysign(np.pi, angle) - angle, angle)), folded


def to_heliotrope(parameters: GuoParameters) -> dict[str, FloatArray]:
    """Return the parameters with which our azimuth-elevation chain is the same mechanism.

    The conversion is exact to 1e-15. Both descriptions of the tilt place the axis identically but
    differ by a rotation about it, tilt_north · tilt_east / 2 to second order, which is added to
    ``azimuth_bias``.

    Returns
    -------
    ``tilt_north``, ``tilt_east``, ``azimuth_bias``, ``elevation_bias``,
    ``non_orthogonality``, ``canting`` (rad) and ``pivot_offset`` (m), shape (...).
    """
    p = parameters
    east = np.sin(p.tilt) * np.sin(p.tilt_azimuth)
    north = np.sin(p.tilt) * np.cos(p.tilt_azimuth)
    tilt_north = as_float(np.arctan2(north, np.cos(p.tilt)))
    tilt_east = as_float(np.arctan2(east, np.hypot(north, np.cos(p.tilt))))
    twist = _twist(p.tilt, p.tilt_azimuth, tilt_north, tilt_east)
    return {
        "tilt_north": tilt_north,
        "tilt_east": tilt_east,
        "azimuth_bias": as_float(-p.azimuth_zero - twist),
        "elevation_bias": -p.elevation_zero,
        "non_orthogonality": -p.tau_1,
        "canting": p.mu,
        "pivot_offset": p.offset,
    }


def from_heliotrope(values: Mapping[str, npt.ArrayLike]) -> GuoParameters:
    """Return Guo's parameters of our azimuth-elevation chain.

    This is the inverse of `to_heliotrope`, up to the relations of `regularise`; the returned tilt
    lies in [0, π]. The conversion is exact to 1e-15.

    Parameters
    ----------
    values
        Values for any of the names that `to_heliotrope` returns; missing values are 0.

    Raises
    ------
    InputError
        If Guo's model has no such name, a number is not finite or shapes do not broadcast.
    """
    for name in values:
        if name not in _HELIOTROPE_NAMES:
            raise UnknownNameError("parameter of Guo's model", name, _HELIOTROPE_NAMES)
    v = {name: numbers(values.get(name, 0.0), name) for name in _HELIOTROPE_NAMES}
    common_shape(**v)
    tilt_north, tilt_east = v["tilt_north"], v["tilt_east"]
    east = np.sin(tilt_east)
    north = np.cos(tilt_east) * np.sin(tilt_north)
    tilt = as_float(np.arctan2(np.hypot(east, north), np.cos(tilt_east) * np.cos(tilt_north)))
    tilt_azimuth = wrap_positive(np.arctan2(east, north))
    return GuoParameters(
        tilt=tilt,
        tilt_azimuth=tilt_azimuth,
        azimuth_zero=-v["azimuth_bias"] - _twist(tilt, tilt_azimuth, tilt_north, tilt_east),
        elevation_zero=-v["elevation_bias"],
        tau_1=-v["non_orthogonality"],
        mu=v["canting"],
        offset=v["pivot_offset"],
    )


def to_malan(parameters: GuoParameters) -> dict[str, FloatArray]:
    """Return Malan's ``eptN``, ``eptE``, ``gb``, ``ab`` and ``eNO``, rad, each (...).

    The conversion is exact: once the misprints of (4.7)-(4.17) are resolved, Malan's order of
    rotations is the same as ours.

    Raises
    ------
    InputError
        If μ or the offset is not 0, because Malan's model has neither.
    """
    ours = to_heliotrope(parameters)
    for name, unit in (("canting", "rad"), ("pivot_offset", "m")):
        largest = np.abs(ours[name]).max(initial=0.0)
        if largest > 0.0:
            text = "but Malan's model has none; set it to 0 or keep Guo's parameters"
            raise InputError(f"{name}: up to {largest:g} {unit}, {text}")
    return {malan: ours[name] for malan, name in MALAN_NAMES.items()}


def from_malan(values: Mapping[str, npt.ArrayLike]) -> GuoParameters:
    """Return Guo's parameters from any of Malan's parameters (rad); missing values are 0.

    Raises
    ------
    InputError
        If Malan's model has no such name, a number is not finite or shapes do not broadcast.
    """
    for name in values:
        if name not in MALAN_NAMES:
            raise UnknownNameError("parameter of Malan's model", name, MALAN_NAMES)
    return from_heliotrope({MALAN_NAMES[name]: value for name, value in values.items()})


def _tilt_rotation(tilt: FloatArray, tilt_azimuth: FloatArray) -> FloatArray:
    """Return the rotation by ψ_t that tilts the vertical towards the azimuth ψ_a."""
    # About U × d for the horizontal direction d at azimuth ψ_a.
    return rotation(direction(tilt_azimuth - 0.5 * np.pi, 0.0), tilt)


def _twist(
    tilt: FloatArray, tilt_azimuth: FloatArray, tilt_north: FloatArray, tilt_east: FloatArray
) -> FloatArray:
    """Return the angle w in R_guo = R_ours R_U(w), where both rotations tilt the vertical alike."""
    guo = _tilt_rotation(tilt, tilt_azimuth)
    ours = rotation([-1.0, 0.0, 0.0], tilt_north) @ rotation([0.0, 1.0, 0.0], tilt_east)
    turn = np.swapaxes(ours, -1, -2) @ guo
    return as_float(np.arctan2(turn[..., 1, 0], turn[..., 0, 0]))


def numbers(value: npt.ArrayLike, name: str) -> FloatArray:
    """Return ``value`` as an array of finite numbers; an error message contains its name."""
    try:
        array = as_float(value)
    except (TypeError, ValueError):
        raise InputError(f"{name}: {value!r} is not an array of numbers") from None
    refuse(~np.isfinite(array), name, lambda i: f"{array[i]} is not finite; pass a number")
    return array


def refuse(
    invalid: npt.NDArray[np.bool_], what: str, problem: Callable[[tuple[int, ...]], str]
) -> None:
    """Raise an error that names the first place where ``invalid`` is True."""
    if np.any(invalid):
        i = tuple(int(k) for k in np.argwhere(invalid)[0])
        raise InputError(f"{what}{list(i) if i else ''}: {problem(i)}")
