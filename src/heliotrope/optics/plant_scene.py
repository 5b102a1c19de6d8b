"""The scene of a plant: its mirrors in their poses, with the surfaces that its file specifies.

A caller's arguments take precedence over the plant file, and the plant file over the defaults: a
mirror focused at its slant range, with slope errors of 1 mrad.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.mirror_surface import MirrorSurface
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target
from heliotrope.field.tower import Tower
from heliotrope.geometry import FloatArray, as_float, as_vectors
from heliotrope.mechanism.tracking import track
from heliotrope.optics.scene import FacetTable, Mirrors, Scene
from heliotrope.optics.surfaces import Surface, surface_of

#: Slope error of mirrors about which nothing is known, rad.
USUAL_SLOPE = 1e-3
#: Reflectivity of mirrors about which nothing is known.
USUAL_REFLECTIVITY = 0.9
#: A facet with a slope map is divided into at most this many parts each way.
_PARTS = 8
#: Focal length of the mirrors: of the plant file, their distance to the aim, or a length, m.
Focus = Literal["plant", "slant"] | float


def no_receiver(plant: Plant, doing: str) -> InputError:
    """Return the error for a plant without a receiver, such as one read from a layout."""
    name = f"plant {plant.name}" if plant.name else "the field"
    return InputError(f"{doing}: {name} has no receiver; write a plant file that contains one")


def scene_of(
    plant: Plant,
    sun: npt.ArrayLike,
    aim: npt.ArrayLike | None = None,
    *,
    receivers: Sequence[str | Receiver | Target | Surface] = (),
    dni: float = 900.0,
    focus: Focus = "plant",
    towers: Sequence[Tower] = (),
    cells: tuple[int, int] | None = None,
    slope: npt.ArrayLike | None = None,
    reflectivity: npt.ArrayLike | None = None,
    **mirrors: npt.ArrayLike,
) -> Scene:
    """Return the scene of a plant whose calibrated heliostats track the sun.

    Parameters
    ----------
    plant
        The plant, with its calibrated mechanisms. Heliostats that cannot reach their aim shade and
        block, but send no light.
    sun
        Unit vector, (3,).
    aim
        Aim points, ENU m, (3,) or (N, 3); None: each heliostat's own aim, or else the middle of the
        first receiver.
    receivers
        Names of receivers of the plant, or surfaces; empty: all receivers of the plant.
    dni
        W/m².
    focus, slope, reflectivity
        As for `shaped`.
    towers
        Obstacles in addition to the plant's towers.
    cells
        Rows and columns on each receiver; None: as `surface_of` chooses.
    **mirrors
        Further arguments of `Mirrors.of`: ``clean`` and ``pointing``.

    Raises
    ------
    InputError
        If the plant has no receiver, or shapes do not fit.
    UnknownNameError
        If there is no receiver with one of the names.
    """
    light = as_vectors(sun, "sun")
    if light.shape != (3,):
        raise InputError(f"scene: the sun has the shape {light.shape}; pass one sun vector, (3,)")
    chosen = tuple(receivers) or plant.receivers
    if not chosen:
        raise no_receiver(plant, "scene")
    surfaces = tuple(_surface(plant, item, cells) for item in chosen)
    ends = _aims(plant, surfaces[0].center, aim)
    tracking = track(plant, light, ends)
    vertex, normal = tracking.chosen(tracking.vertex), tracking.chosen(tracking.normal)
    size = [np.concatenate([getattr(g, s) for g in plant.groups.values()]) for s in _SIZES]
    built = Mirrors.of(vertex, normal, (size[0], size[1]), ends, **mirrors)
    built = shaped(built, plant, focus=focus, slope=slope, reflectivity=reflectivity)
    dark = ~np.asarray(tracking.reachable)
    plant.check_towers(towers)
    return Scene(light, dni, built, surfaces, (*plant.towers, *towers), dark)


_SIZES = ("width", "height")


def _surface(
    plant: Plant, item: str | Receiver | Target | Surface, cells: tuple[int, int] | None
) -> Surface:
    if isinstance(item, str):
        item = plant.receiver(item)
    return surface_of(item, cells) if isinstance(item, Receiver | Target) else item


def _aims(plant: Plant, middle: FloatArray, aim: npt.ArrayLike | None) -> FloatArray:
    count = len(plant)
    if aim is not None:
        ends = as_vectors(aim, "aim")
        if ends.shape not in ((3,), (1, 3), (count, 3)):
            raise InputError(
                f"mirrors: aim has the shape {ends.shape}; expected (3,) or ({count}, 3)"
            )
        return np.ascontiguousarray(np.broadcast_to(ends, (count, 3)))
    own = [np.full((len(g), 3), np.nan) if g.aim is None else g.aim for g in plant.groups.values()]
    ends = np.concatenate(own)
    return np.where(np.isfinite(ends).all(axis=-1, keepdims=True), ends, middle)


def shaped(
    mirrors: Mirrors,
    plant: Plant,
    rows: npt.NDArray[np.intp] | None = None,
    *,
    focus: Focus = "plant",
    slope: npt.ArrayLike | None = None,
    reflectivity: npt.ArrayLike | None = None,
) -> Mirrors:
    """Return mirrors with the curvature, slope errors, facets and slope maps of a plant.

    Parameters
    ----------
    mirrors
        Some of the plant's heliostats in their poses, (H,).
    plant
        The plant.
    rows
        Heliostat of each mirror, by its index in ``plant.names``, (H,); None: all heliostats in
        order.
    focus
        "plant": as the plant file specifies, or else "slant"; "slant": each mirror's distance to
        its aim; a focal length, m; infinity: flat. Facets keep their tilts, and each facet gets
        this focal length.
    slope, reflectivity
        Slope error, rad, and reflectivity of the mirrors, () or (H,); None: the value in the plant
        file, or else `USUAL_SLOPE` (0 with a slope map) and `USUAL_REFLECTIVITY`.

    Raises
    ------
    InputError
        If a number is out of range, or a facet lies outside its mirror.
    """
    index = np.arange(len(plant)) if rows is None else rows
    groups = list(plant.groups.values())
    columns = zip(*(_numbers(group) for group in groups), strict=True)
    focal, rough, clear = (np.concatenate(column)[index] for column in columns)
    if focus != "plant":
        focal = np.full(len(mirrors), np.nan if isinstance(focus, str) else focus)
    focal = np.where(np.isnan(focal), mirrors.slant, focal)
    made = mirrors.with_numbers(
        focal=focal,
        slope=rough if slope is None else slope,
        reflectivity=clear if reflectivity is None else reflectivity,
    )
    if all(g.facets is None and not _mapped(g).any() for g in groups):
        return made
    for group in groups:
        group.check_facets()
    lengths = np.ones(len(plant))
    lengths[index] = focal
    table = _table(groups, lengths, own_focal=focus == "plant", own_slope=slope is None)
    # The mirror's own focal length is used only for casting the shadows of its neighbours.
    return replace(made, focal=_whole_focal(table)[index]).with_facets(table, np.asarray(index))


def _mapped(group: Heliostats) -> npt.NDArray[np.bool_]:
    """Return a mask of the mirrors of a group that have a slope map, (N,)."""
    maps = () if group.surface is None else group.surface.maps
    return np.array([slopes is not None for slopes in maps] or [False] * len(group), dtype=np.bool_)


def _numbers(group: Heliostats) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the focal length (NaN: unknown), slope error and reflectivity of each mirror, (N,)."""
    surface = group.surface or MirrorSurface()
    focal, slope = np.full(len(group), np.nan), np.where(_mapped(group), 0.0, USUAL_SLOPE)
    if surface.focal is not None and surface.focal.ndim == 1:
        focal = surface.focal
    if surface.slope is not None:
        # What a facet has beyond the best one is added to it.
        slope = surface.slope if surface.slope.ndim == 1 else surface.slope.min(axis=1)
    clear = surface.reflectivity
    return focal, slope, np.full(len(group), USUAL_REFLECTIVITY) if clear is None else clear


@dataclass(frozen=True)
class _Parts:
    """Facets of some mirrors: centre, tilt, half size, curvature 1 / 2f and slope variance."""

    center: FloatArray
    tilt: FloatArray
    half: FloatArray
    curve: FloatArray
    variance: FloatArray

    def padded(self, most: int) -> "_Parts":
        """Return the table padded with empty facets to a given number per mirror."""
        room = most - self.center.shape[1]
        sides = [((0, 0), (0, room), (0, 0))[: value.ndim] for value in vars(self).values()]
        return _Parts(*map(np.pad, vars(self).values(), sides))


def _table(
    groups: Sequence[Heliostats], focal: FloatArray, *, own_focal: bool, own_slope: bool
) -> FacetTable:
    """Return the facets of all mirrors.

    ``focal`` (N,) applies to mirrors whose own focal lengths are not used.
    """
    parts, start = [], 0
    for group in groups:
        lengths = focal[start : start + len(group)]
        start += len(group)
        whole = _facets(group, lengths, own_focal=own_focal, own_slope=own_slope)
        if not _mapped(group).any():
            parts.append(whole)
            continue
        assert group.surface is not None
        for i, slopes in enumerate(group.surface.maps):
            part = _Parts(*(value[i : i + 1] for value in vars(whole).values()))
            parts.append(part if slopes is None else _divided(part, slopes))
    most = max(part.center.shape[1] for part in parts)
    rows = zip(*(vars(part.padded(most)).values() for part in parts), strict=True)
    center, tilt, half, curve, variance = (np.concatenate(column) for column in rows)
    with np.errstate(divide="ignore"):
        return FacetTable(center, tilt, half, 0.5 / curve, np.sqrt(variance))


def _facets(group: Heliostats, focal: FloatArray, *, own_focal: bool, own_slope: bool) -> _Parts:
    facets, surface = group.facets, group.surface or MirrorSurface()
    if facets is None:
        half = 0.5 * np.stack([group.width, group.height], axis=-1)[:, None]
        center = tilt = np.zeros_like(half)
    else:
        center, tilt, half = facets.center[..., :2], facets.tilt, facets.half_size
    shape = center.shape[:2]
    curve = 0.5 / np.broadcast_to(focal[:, None], shape)
    if own_focal and surface.focal is not None and surface.focal.ndim == 2:
        curve = 0.5 / surface.focal
    variance = np.zeros(shape)
    if own_slope and surface.slope is not None and surface.slope.ndim == 2:
        variance = surface.slope**2 - surface.slope.min(axis=1, keepdims=True) ** 2
    return _Parts(center, tilt, half, as_float(curve), as_float(variance))


def _divided(mirror: _Parts, slopes: FloatArray) -> _Parts:
    """Return one mirror's facets, divided into parts by a slope map (F, H, W, 2).

    Each part has the mean slope of the map cells on it, and the curvature that fits these cells
    best; the residual is its slope error.
    """
    facets, height, width, _ = slopes.shape
    rows, columns = (np.arange(min(n, _PARTS)) * n // min(n, _PARTS) for n in (height, width))
    half = mirror.half[0]
    v = half[:, 1:] * ((np.arange(height) + 0.5) / height * 2.0 - 1.0)
    u = half[:, :1] * ((np.arange(width) + 0.5) / width * 2.0 - 1.0)
    uv = np.stack(np.broadcast_arrays(u[:, None, :], v[:, :, None]), axis=-1)

    def mean(values: FloatArray) -> FloatArray:
        sums = np.add.reduceat(np.add.reduceat(values, rows, axis=1), columns, axis=2)
        return as_float(sums / (tall[:, None, None] * wide[:, None]))

    tall, wide = (np.diff([*starts, n]) for starts, n in ((rows, height), (columns, width)))
    place, lean = mean(uv), mean(slopes)
    apart = (mean(uv**2) - place**2).sum(axis=-1)
    mixed = (mean(uv * slopes) - place * lean).sum(axis=-1)
    bend = np.divide(mixed, apart, out=np.zeros_like(mixed), where=apart > 0.0)
    rest = 0.5 * ((mean(slopes**2) - lean**2).sum(axis=-1) - bend**2 * apart)
    size = np.stack(np.broadcast_arrays(wide / width, (tall / height)[:, None]), axis=-1)
    curve = mirror.curve[0][:, None, None]
    own = mirror.tilt[0][:, None, None] - curve[..., None] * place - lean
    parts = (
        mirror.center[0][:, None, None] + place,
        own,
        half[:, None, None] * size,
        curve + bend,
        mirror.variance[0][:, None, None] + np.maximum(rest, 0.0),
    )
    count = facets * len(rows) * len(columns)
    return _Parts(*(value.reshape(1, count, *value.shape[3:]) for value in parts))


def _whole_focal(table: FacetTable) -> FloatArray:
    """Return the focal length that best fits each whole mirror's normals, m, (K,)."""
    area = table.half.prod(axis=-1)
    own = (table.half**2).sum(axis=-1) / 3.0
    lean = -(table.tilt * table.center).sum(axis=-1) + 0.5 / table.focal * own
    spread = (table.center**2).sum(axis=-1) + own
    curve = (area * lean).sum(axis=1) / (area * spread).sum(axis=1)
    return as_float(np.divide(0.5, curve, out=np.full_like(curve, np.inf), where=curve != 0.0))
