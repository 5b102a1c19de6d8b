"""Draw charts on matplotlib axes."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, UnknownNameError, kind_of
from heliotrope.field.day import TrackedDay
from heliotrope.geometry import FloatArray, as_numbers
from heliotrope.mechanism.parameters import shown_in
from heliotrope.mechanism.path import TrackedPath
from heliotrope.mechanism.tracking import Tracking
from heliotrope.optics.beam import CHI_SQUARE_90
from heliotrope.sun import Times, unix_seconds

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Okabe and Ito's colours, which colour-blind readers can distinguish.
COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#999999")
#: Maximum number of names written beside the dots of a map.
_NAMED = 60


class Group(NamedTuple):
    """Points that are drawn in the same style.

    Attributes
    ----------
    mask
        Mask of the points, (M,).
    colour, label
        Style of the points, and their name in the legend.
    odd
        Whether the points are drawn as crosses and excluded from the axis limits, as for outliers.
    """

    mask: npt.NDArray[np.bool_]
    colour: str
    label: str
    odd: bool = False


def _axes(ax: "Axes | None") -> "Axes":
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots(layout="constrained")[1]


def _groups(groups: Sequence[Group], count: int) -> Sequence[Group]:
    for group in groups:
        if np.shape(group.mask) != (count,):
            raise InputError(
                f"groups: the mask of {group.label!r} has shape {np.shape(group.mask)}; expected "
                f"({count},), one entry per point"
            )
    return groups or [Group(np.ones(count, np.bool_), COLOURS[0], "")]


def _points(values: npt.ArrayLike, name: str) -> FloatArray:
    points = np.asarray(values, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise InputError(
            f"{name}: got the shape {points.shape}; expected M pairs of right and up, (M, 2)"
        )
    return points


def _dates(times: Times) -> np.ndarray:
    seconds = np.ravel(unix_seconds(times, unknown=True))
    known = np.where(np.isfinite(seconds), seconds, 0.0)
    dates = (known * 1e6).astype("datetime64[us]")
    dates[~np.isfinite(seconds)] = np.datetime64("NaT")
    return dates


def _date_axis(ax: "Axes") -> None:
    """Write short dates, with the day only once instead of on every tick."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    locator = AutoDateLocator(minticks=3, maxticks=8)  # type: ignore[no-untyped-call]
    ax.xaxis.set_major_locator(locator)
    formatter = ConciseDateFormatter(locator)  # type: ignore[no-untyped-call]
    ax.xaxis.set_major_formatter(formatter)


def day(
    times: Times | TrackedDay,
    tracked: Tracking | TrackedPath | None = None,
    *,
    joints: Sequence[str] = ("first drive", "second drive"),
    ax: "Axes | None" = None,
) -> "Axes":
    """Draw the joint angles of one heliostat over time, and where it does not reach its aim.

    Parameters
    ----------
    times
        A day of one heliostat, as `heliotrope.track_day` returns it; or T times, as for
        `heliotrope.sun.vector`.
    tracked
        If times are passed: the tracking solutions at these times, batch shape (T,), of which the
        best branch is drawn; or a path.
    joints
        Names of the drives.
    ax
        Axes to draw on; by default new axes.

    Raises
    ------
    InputError
        If the number of solutions differs from the number of times, solutions are missing, or both
        a day and solutions are passed.
    """
    if isinstance(times, TrackedDay):
        if tracked is not None:
            raise InputError("tracked: the day has its own path; pass the day alone")
        tracked, times = times.path, times.time
    if not isinstance(tracked, Tracking | TrackedPath):
        raise InputError(
            f"tracked: {kind_of(tracked)} is not a Tracking; pass a day from track_day alone, or "
            "times and the result of track"
        )
    dates = _dates(times)
    angles = np.degrees(tracked.angles if isinstance(tracked, TrackedPath) else tracked.best_angles)
    if angles.shape[:-1] != dates.shape:
        raise InputError(
            f"tracked: shape {angles.shape[:-1]} for {len(dates)} times; track one heliostat, "
            f"({len(dates)},)"
        )
    reached = tracked.reachable
    ax = _axes(ax)
    for d, name in enumerate(joints[: angles.shape[-1]]):
        shown = np.where(reached, angles[:, d], np.nan)
        ax.plot(dates, shown, ".-", color=COLOURS[d], ms=3, lw=1.0, label=name)
    if not reached.all():
        where = np.repeat(dates[~reached], angles.shape[-1])
        ax.plot(where, angles[~reached].ravel(), "x", color=COLOURS[-1], ms=4, label="not reached")
    _date_axis(ax)
    ax.set_xlabel("UTC")
    ax.set_ylabel("joint angle, °")
    ax.grid(alpha=0.3)
    ax.legend(frameon=False)
    return ax


def residuals(
    x: npt.ArrayLike,
    beam: npt.ArrayLike,
    *,
    label: str = "",
    groups: Sequence[Group] = (),
    ax: "Axes | None" = None,
) -> "Axes":
    """Draw beam errors to the right (dots) and upwards (triangles) against any quantity.

    Parameters
    ----------
    x
        Numbers or dates, (M,): sun elevations, counts, times.
    beam
        Beam errors right and up, rad, (M, 2): ``BeamErrors.offset``, ``Prediction.plane``.
    label
        Meaning of ``x``, with its unit.
    groups
        Points that are drawn in the same style; by default all points.
    ax
        Axes to draw on; by default new axes.

    Raises
    ------
    InputError
        If shapes do not fit.
    """
    errors, place = 1e3 * _points(beam, "beam"), np.asarray(x)
    if place.shape != (len(errors),):
        raise InputError(
            f"x: shape {place.shape} for {len(errors)} errors; expected ({len(errors)},)"
        )
    ax = _axes(ax)
    good = np.zeros(len(errors), dtype=np.bool_)
    for mask, colour, _, odd in _groups(groups, len(errors)):
        good |= mask & (not odd)
        ax.plot(place[mask], errors[mask, 0], ".", color=colour, ms=4)
        ax.plot(place[mask], errors[mask, 1], "^", color=colour, ms=3, mfc="none", mew=0.7)
    good &= np.isfinite(errors).all(axis=1)
    if good.any():
        # The limits exclude outliers, so that these do not compress the other points.
        limit = max(0.5, 1.3 * float(np.percentile(np.abs(errors[good]), 99)))
        ax.set_ylim(-limit, limit)
    if place.dtype.kind == "M":
        _date_axis(ax)
    ax.set_xlabel(label)
    ax.set_ylabel("• right, ▵ up: mrad of beam")
    ax.grid(alpha=0.3)
    return ax


def ellipses(
    plane: npt.ArrayLike,
    covariance: npt.ArrayLike | None = None,
    *,
    unit: str = "m",
    groups: Sequence[Group] = (),
    title: str = "",
    ax: "Axes | None" = None,
) -> "Axes":
    """Draw points on a target relative to its aim, with their 90 % ellipses.

    Parameters
    ----------
    plane
        Positions to the right of and above the aim, (M, 2).
    covariance
        Covariance of each point, (M, 2, 2) or (2, 2), in the square of the unit; by default no
        ellipses.
    unit
        Unit of the axes.
    groups
        Points that are drawn in the same style; by default all points.
    title
        Title of the axes.
    ax
        Axes to draw on; by default new axes.

    Raises
    ------
    InputError
        If shapes do not fit.
    """
    points = _points(plane, "plane")
    ax = _axes(ax)
    groups = _groups(groups, len(points))
    for mask, colour, label, odd in groups:
        if mask.any():
            marker = "x" if odd else "."
            ax.plot(points[mask, 0], points[mask, 1], marker, color=colour, label=label)
    if covariance is not None:
        _draw_ellipses(ax, points, covariance)
    ax.axhline(0, color="k", lw=0.5)
    ax.axvline(0, color="k", lw=0.5)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_title(title, fontsize=10)
    ax.set_xlabel(f"right, {unit}")
    ax.set_ylabel(f"up, {unit}")
    ax.grid(alpha=0.3)
    if len(groups) > 1:
        ax.legend(frameon=False, fontsize=8)
    return ax


def _draw_ellipses(ax: "Axes", points: FloatArray, covariance: npt.ArrayLike) -> None:
    from matplotlib.patches import Ellipse

    array = np.asarray(covariance, dtype=np.float64)
    if array.shape not in ((2, 2), (len(points), 2, 2)):
        raise InputError(
            f"covariance: shape {array.shape}; expected (2, 2), or ({len(points)}, 2, 2), one per "
            "point"
        )
    matrices = np.broadcast_to(array, (len(points), 2, 2))
    known = np.isfinite(matrices).all(axis=(1, 2)) & np.isfinite(points).all(axis=1)
    for point, matrix in zip(points[known], matrices[known], strict=True):
        size, turn = np.linalg.eigh(matrix)
        # Eigenvalues are in ascending order, so the second column is the long axis.
        short, long = 2.0 * np.sqrt(CHI_SQUARE_90 * np.maximum(size, 0.0))
        angle = float(np.degrees(np.arctan2(turn[1, 1], turn[0, 1])))
        ax.add_patch(
            Ellipse(
                (point[0], point[1]),
                long,
                short,
                angle=angle,
                fill=False,
                color=COLOURS[4],
                lw=0.8,
                alpha=0.7,
            )
        )
    # Patches by themselves do not widen the limits.
    ax.autoscale_view()


def field_map(
    position: npt.ArrayLike,
    values: npt.ArrayLike,
    *,
    label: str = "",
    names: Sequence[str] = (),
    targets: npt.ArrayLike = (),
    whole: bool = False,
    ax: "Axes | None" = None,
) -> "Axes":
    """Draw a map of heliostats coloured by a value; heliostats with NaN are grey.

    Parameters
    ----------
    position
        ENU metres, (N, 3) or (N, 2).
    values
        One value per heliostat, (N,), in the unit stated in the label; the colour scale ends at the
        95th percentile.
    label
        Meaning of the values, with their unit.
    names
        Labels beside the dots of at most 60 heliostats.
    targets
        Centres of targets, (K, 3), drawn as triangles.
    whole
        Whether the colour scale runs from the lowest to the highest value, instead of from 0 to the
        95th percentile.
    ax
        Axes to draw on; by default new axes.

    Raises
    ------
    InputError
        If there are not as many values as positions.
    """
    places = as_numbers(position, "position")
    shown = np.asarray(values, dtype=np.float64)
    if places.ndim != 2 or places.shape[1] not in (2, 3) or shown.shape != (len(places),):
        raise InputError(
            f"values: shape {shown.shape} for positions of shape {places.shape}; expected (N,) for "
            "(N, 3)"
        )
    ax = _axes(ax)
    known = np.isfinite(shown)
    ax.plot(places[~known, 0], places[~known, 1], ".", color="#cccccc", ms=4, label="unknown")
    if known.any():
        size = 45.0 if known.sum() < 200 else 8.0
        top = max(float(np.percentile(shown[known], 95)), 1e-6)
        low = min(0.0, float(shown[known].min()))
        if whole:
            low, top = float(shown[known].min()), float(shown[known].max())
        dots = ax.scatter(
            places[known, 0], places[known, 1], c=shown[known], s=size, cmap="cividis",
            vmin=low, vmax=top,
        )  # fmt: skip
        scale = ax.figure.colorbar(dots, ax=ax, label=label, extend="neither" if whole else "max")
        scale.formatter.set_useOffset(False)  # type: ignore[attr-defined]
    if len(names) == len(places) and known.sum() <= _NAMED:
        for i in np.flatnonzero(known):
            where = (float(places[i, 0]), float(places[i, 1]))
            ax.annotate(names[int(i)], where, xytext=(3, 3), textcoords="offset points", fontsize=6)
    for target in np.asarray(targets, dtype=np.float64).reshape(-1, 3):
        ax.plot(target[0], target[1], "k^", ms=7)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("east, m")
    ax.set_ylabel("north, m")
    ax.grid(alpha=0.3)
    return ax


def year_map(
    hour: npt.ArrayLike,
    declination: npt.ArrayLike,
    rms: npt.ArrayLike,
    *,
    label: str = "expected beam error, mrad RMS",
    ax: "Axes | None" = None,
) -> "Axes":
    """Draw the expected beam error for every sun position in a year.

    Parameters
    ----------
    hour, declination
        Hour angles (H,) and declinations (D,) of the sun, rad, as in
        `heliotrope.calibration.YearMap`.
    rms
        Errors, rad, (D, H); NaN where there is no value.
    label
        Meaning of the colours.
    ax
        Axes to draw on; by default new axes.

    Raises
    ------
    InputError
        If shapes do not fit.
    """
    across, along = as_numbers(hour, "hour"), as_numbers(declination, "declination")
    shown = 1e3 * np.asarray(rms, dtype=np.float64)
    if shown.shape != (*along.shape, *across.shape):
        raise InputError(
            f"rms: shape {shown.shape}; {along.shape} declinations and {across.shape} hour angles "
            f"need {(*along.shape, *across.shape)}"
        )
    ax = _axes(ax)
    if np.isfinite(shown).any():
        mesh = ax.pcolormesh(
            np.degrees(across), np.degrees(along), shown, cmap="cividis",
            vmin=0.0, vmax=float(np.nanpercentile(shown, 98)), rasterized=True,
        )  # fmt: skip
        ax.figure.colorbar(mesh, ax=ax, label=label)
    ax.set_xlabel("hour angle, ° (afternoon positive)")
    ax.set_ylabel("declination, °")
    return ax


def drift(
    times: Times,
    values: npt.ArrayLike,
    covariance: npt.ArrayLike,
    names: Sequence[str],
    *,
    shown: Sequence[str] | None = None,
    ax: "Axes | None" = None,
) -> "Axes":
    """Draw parameters of one heliostat over time, with a band of one standard deviation.

    Parameters
    ----------
    times
        T times.
    values, covariance
        As returned by `heliotrope.Learned.parameters_at`, (T, P) and (T, P, P).
    names
        Names of the P parameters.
    shown
        Parameters to draw, all with the same unit; by default all parameters that have the unit of
        the first.
    ax
        Axes to draw on; by default new axes.

    Raises
    ------
    InputError
        If shapes do not fit, or units are mixed.
    UnknownNameError
        If a name in ``shown`` is not among the parameters.
    """
    dates = _dates(times)
    table, spread = as_numbers(values, "values"), as_numbers(covariance, "covariance")
    size = len(names)
    if table.shape != (len(dates), size) or spread.shape != (len(dates), size, size):
        raise InputError(
            f"values {table.shape} and covariance {spread.shape} for {len(dates)} times and {size} "
            f"names; expected ({len(dates)}, {size}) and ({len(dates)}, {size}, {size})"
        )
    selected = [n for n in names if shown_in(n) == shown_in(names[0])] if shown is None else shown
    for name in selected:
        if name not in names:
            raise UnknownNameError("parameter", name, names)
    units = list(dict.fromkeys(shown_in(name) for name in selected))
    if len(units) != 1:
        listed = " and ".join(unit or "no unit" for _, unit in units) or "none"
        raise InputError(f"shown: parameters in {listed}; choose parameters with the same unit")
    ((scale, unit),) = units
    ax = _axes(ax)
    for k, name in enumerate(selected):
        p = list(names).index(name)
        middle, wide = scale * table[:, p], scale * np.sqrt(spread[:, p, p])
        colour = COLOURS[k % len(COLOURS)]
        ax.plot(dates, middle, color=colour, label=name)
        ax.fill_between(dates, middle - wide, middle + wide, color=colour, alpha=0.2, lw=0.0)
    ax.set_ylabel(f"deviation, {unit}" if unit else "deviation")
    _date_axis(ax)
    ax.grid(alpha=0.3)
    ax.legend(frameon=False, fontsize=8)
    return ax
