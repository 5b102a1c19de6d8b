"""The pictures of `heliotrope.plot`: they draw what they are given, on the axes they are given."""

from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from functools import cache

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection, QuadMesh
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

import heliotrope as ht
from heliotrope import plot
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.mesh import cavity_wall
from heliotrope.field.target import Receiver
from heliotrope.optics.beam import CHI_SQUARE_90

AIM = (0.0, 0.0, 13.0)
TIMES = 1788336000.0 + 1800.0 * np.arange(12)


@pytest.fixture
def ax() -> Axes:
    return Figure().subplots()


@pytest.fixture
def pyplot() -> Iterator[object]:
    """Pyplot without a display, and without figures before and after."""
    import matplotlib.pyplot as plt

    with mpl.rc_context({"backend": "agg"}):
        plt.close("all")
        yield plt
        plt.close("all")


@cache
def plant() -> ht.Plant:
    return ht.example_plant()


@cache
def tracked() -> ht.Tracking:
    mechanism = plant().groups["azel"].mechanism[0]
    return ht.track(mechanism, ht.sun.vector(TIMES, plant().site), AIM)


def labels(ax: Axes) -> list[str]:
    legend = ax.get_legend()
    return [] if legend is None else [text.get_text() for text in legend.get_texts()]


def test_a_day_shows_the_angles_of_both_drives(ax: Axes) -> None:
    assert plot.day(TIMES, tracked(), joints=("azimuth", "elevation"), ax=ax) is ax
    assert labels(ax) == ["azimuth", "elevation"]
    shown = ax.lines[1].get_ydata()
    np.testing.assert_allclose(shown, np.degrees(tracked().chosen(tracked().angles)[:, 1]))


def test_a_day_marks_what_is_not_reached(ax: Axes) -> None:
    mechanism = plant().groups["azel"].mechanism[0]
    behind = np.tile((0.0, 0.0, -500.0), (12, 1))
    behind[:6] = AIM
    found = ht.track(mechanism, ht.sun.vector(TIMES, plant().site), behind)
    missed = ~found.reachable
    assert 0 < missed.sum() < 12
    plot.day(TIMES, found, ax=ax)
    assert labels(ax)[-1] == "not reached"
    assert np.isnan(ax.lines[0].get_ydata()).sum() == missed.sum()


def test_a_day_of_a_heliostat_is_drawn_from_the_day_alone(ax: Axes) -> None:
    day = ht.track_day(plant()["P6A"], "2026-09-02", every=timedelta(hours=1))
    assert plot.day(day, joints=("azimuth", "elevation"), ax=ax) is ax
    assert labels(ax) == ["azimuth", "elevation"]
    for drive, line in enumerate(ax.lines):
        np.testing.assert_allclose(line.get_ydata(), np.degrees(day.path.angles[:, drive]))
    np.testing.assert_array_equal(
        ax.lines[0].get_xdata(), day.time.tz_localize(None).to_numpy("datetime64[us]")
    )
    with pytest.raises(InputError, match="the day has its own path; pass the day alone"):
        plot.day(day, day.path, ax=ax)
    field = ht.track_day(plant(), "2026-09-02", every=timedelta(hours=6))
    with pytest.raises(InputError, match="track one heliostat"):
        plot.day(field, ax=ax)


def test_residuals_are_in_mrad_and_outliers_do_not_set_the_limits(ax: Axes) -> None:
    beam = np.full((20, 2), 1e-3)
    beam[3] = 0.5
    odd = np.arange(20) == 3
    groups = [plot.Group(~odd, "C0", "good"), plot.Group(odd, "C1", "outlier", odd=True)]
    plot.residuals(np.arange(20), beam, label="counts", groups=groups, ax=ax)
    np.testing.assert_allclose(ax.lines[0].get_ydata(), 1.0)
    assert ax.get_ylim() == pytest.approx((-1.3, 1.3))
    assert ax.get_xlabel() == "counts"


def test_ellipses_hold_ninety_per_cent(ax: Axes) -> None:
    turn = np.radians(30.0)
    axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    matrix = axes @ np.diag([0.04, 0.01]) @ axes.T
    points = np.random.default_rng(2).multivariate_normal((0.0, 0.0), matrix, 4000)
    plot.ellipses(points[:1], matrix, ax=ax)
    (ellipse,) = [p for p in ax.patches if isinstance(p, Ellipse)]
    assert ellipse.width == pytest.approx(2.0 * 0.2 * np.sqrt(CHI_SQUARE_90))
    assert ellipse.height == pytest.approx(2.0 * 0.1 * np.sqrt(CHI_SQUARE_90))
    assert ellipse.angle % 180.0 == pytest.approx(30.0)
    ellipse.set_center((0.0, 0.0))
    # In data coordinates, without the transform of the axes.
    inside = ellipse.get_patch_transform().inverted().transform(points)
    assert np.mean(np.hypot(*inside.T) < 1.0) == pytest.approx(0.9, abs=0.015)


def test_a_map_is_grey_where_nothing_is_known(ax: Axes) -> None:
    values = np.arange(18.0)
    values[4] = np.nan
    names = plant().names
    plot.field_map(plant().position, values, label="mrad", names=names, targets=[AIM], ax=ax)
    (dots,) = [c for c in ax.collections if isinstance(c, PathCollection)]
    assert len(dots.get_offsets()) == 17
    assert len(ax.lines[0].get_xdata()) == 1
    assert {t.get_text() for t in ax.texts} == set(names) - {names[4]}


def test_a_year_has_the_grid_of_its_axes(ax: Axes) -> None:
    hour, declination = np.radians(np.linspace(-90, 90, 7)), np.radians(np.linspace(-23, 23, 5))
    rms = np.full((5, 7), 1e-3)
    plot.year_map(hour, declination, rms, ax=ax)
    (mesh,) = [c for c in ax.collections if isinstance(c, QuadMesh)]
    np.testing.assert_allclose(mesh.get_array(), 1.0)


def test_a_drift_shows_one_unit_with_its_band(ax: Axes) -> None:
    names = ("tilt_north", "position_up", "elevation_bias")
    values = np.tile([1e-3, 0.02, -2e-3], (12, 1))
    spread = np.tile(np.diag([1e-4, 1e-3, 1e-4]) ** 2, (12, 1, 1))
    plot.drift(TIMES, values, spread, names, ax=ax)
    assert labels(ax) == ["tilt_north", "elevation_bias"]
    assert ax.get_ylabel() == "deviation, mrad"
    np.testing.assert_allclose(ax.lines[1].get_ydata(), -2.0)
    assert len(ax.collections) == 2
    with pytest.raises(InputError, match="mrad and mm; choose parameters with the same unit"):
        plot.drift(TIMES, values, spread, names, shown=names, ax=ax)
    with pytest.raises(UnknownNameError, match="no parameter 'tilt_nort'"):
        plot.drift(TIMES, values, spread, names, shown=["tilt_nort"], ax=ax)


@cache
def light() -> ht.optics.PlantFlux:
    return ht.flux(ht.example_plant(), sun=(0.1, 0.6, 0.8))


def test_a_receiver_is_drawn_in_kilowatts(ax: Axes) -> None:
    view = light().maps[0]
    plot.receiver_map(view, ax=ax)
    (mesh,) = [c for c in ax.collections if isinstance(c, QuadMesh)]
    np.testing.assert_allclose(
        np.asarray(mesh.get_array()).reshape(view.flux.shape), 1e-3 * view.flux
    )
    assert f"peak {1e-3 * view.flux.max():.4g} kW/m²" in ax.get_title()


def test_a_field_is_coloured_by_any_efficiency(ax: Axes) -> None:
    plot.efficiency_map(light(), "cosine", ax=ax)
    (dots,) = [c for c in ax.collections if isinstance(c, PathCollection)]
    np.testing.assert_allclose(dots.get_array(), 100.0 * light().efficiencies.cosine)
    shares = light().efficiencies.cosine
    assert dots.get_clim() == pytest.approx((100 * shares.min(), 100 * shares.max()))


def test_field_and_receiver_are_drawn_in_space(pyplot: object) -> None:
    ax = plot.flux_3d(light())
    assert len(ax.collections) == 2  # the heliostats and the cells of the receiver
    figure = plot.flux_figure(light(), "lit")
    assert len(figure.axes) == 5  # three pictures and two scales


def test_each_strategy_is_drawn_beside_its_limit_and_excess_is_red(pyplot: object) -> None:
    plant, sun = ht.example_plant(), (0.1, 0.6, 0.8)
    pipe = replace(plant.receivers[0], kind="external_cylinder")
    plans = [
        ht.aim(replace(plant, receivers=(pipe,)), sun=sun, limit=8e4, strategy=name)
        for name in ("middle", "optimal")
    ]
    figure = plot.aim_figure(*plans)
    axes = [each for each in figure.axes if each.get_title()]
    assert len(axes) == 4
    titles = [each.get_title() for each in axes]
    assert titles[0].startswith("middle, receiver: ")
    assert titles[1] == f"middle, hottest cell {100 * plans[0].excess:.2f} % above its limit"
    assert titles[3] == f"optimal, hottest cell {-100 * plans[1].excess:.2f} % below its limit"
    assert {each.get_xlabel() for each in axes} == {"clockwise as seen from above, m"}
    for each, plan in zip(axes[1::2], plans, strict=True):
        (mesh,) = [c for c in each.collections if isinstance(c, QuadMesh)]
        red = (mesh.to_rgba(mesh.get_array()) == (1.0, 0.0, 0.0, 1.0)).all(axis=-1)
        assert red.sum() == (plan.quantile > 1.001 * plan.limit).sum()
    assert plans[0].excess > 0.01
    assert plans[1].excess <= 0.0


@cache
def in_a_cavity() -> ht.optics.PlantFlux:
    plant = ht.example_plant()
    old = plant.receivers[0]
    wall = cavity_wall(3.0, 2.6, 4.0, (10, 20))
    cave = Receiver("cave", "cavity", old.center, old.normal, 4.0, 4.0, mesh=wall)
    return ht.flux(replace(plant, receivers=(cave, old)), sun=(0.1, 0.6, 0.8))


def test_a_cavity_is_drawn_from_its_front_and_each_receiver_has_its_map(pyplot: object) -> None:
    found = in_a_cavity()
    ax = plot.receiver_map(found.maps[0], surface=found.surfaces[0])
    (cells,) = ax.collections
    # The wall is hollow towards the front: all of it is seen, as wide as its opening.
    assert len(cells.get_paths()) == found.maps[0].flux.size == 400
    assert np.max(np.asarray(cells.get_array())) == pytest.approx(1e-3 * found.maps[0].flux.max())
    bounds = cells.get_datalim(ax.transData)
    assert (bounds.width, bounds.height) == pytest.approx((6.0 * np.sin(1.3), 4.0), rel=1e-6)
    figure = plot.flux_figure(found)
    titles = [ax.get_title().partition(":")[0] for ax in figure.axes]
    assert {"cave", found.maps[1].receiver} <= set(titles)


def test_without_axes_new_ones_are_made(pyplot: object) -> None:
    first = plot.residuals(np.arange(3), np.zeros((3, 2)))
    second = plot.ellipses(np.zeros((3, 2)))
    assert first.figure is not second.figure


def test_a_mechanism_has_a_slider_of_time() -> None:
    go = pytest.importorskip("plotly.graph_objects")
    mechanism = plant().groups["azel"].mechanism[0]
    angles = tracked().chosen(tracked().angles)
    suns = ht.sun.vector(TIMES, plant().site)
    names = [f"{k}:00" for k in range(12)]
    size = {"width": 1.83, "height": 1.22}
    found = plot.mechanism_3d(mechanism, angles, labels=names, sun=suns, aim=AIM, **size)
    assert [frame.name for frame in found.frames] == names
    assert {"mirror", "sun", "beam"} <= {trace.name for trace in found.data}
    mine = go.Figure(go.Scatter3d(x=[0], y=[0], z=[0], name="mast"))
    same = plot.mechanism_3d(mechanism, angles, figure=mine, **size)
    assert same is mine
    assert same.data[0].name == "mast"
    # The frames move the traces of the mechanism and leave the mast alone.
    assert 0 not in same.frames[0].traces
    assert len(same.frames[0].traces) == len(same.frames[0].data) == len(same.data) - 1


@pytest.mark.parametrize(
    ("draw", "text"),
    [
        (lambda ax: plot.day(TIMES[:3], tracked(), ax=ax), r"tracked: shape \(12,\) for 3 times"),
        (lambda ax: plot.day(TIMES, np.zeros(3), ax=ax), "tracked: a numpy ndarray"),
        (lambda ax: plot.day(TIMES, ax=ax), "pass a day from track_day alone"),
        (lambda ax: plot.residuals([1.0], np.zeros((2, 2)), ax=ax), r"x: shape \(1,\) for 2"),
        (lambda ax: plot.residuals([1.0], [1.0], ax=ax), r"beam: got the shape \(1,\); expected"),
        (lambda ax: plot.ellipses(np.zeros((3, 2)), np.eye(3), ax=ax), r"covariance: shape \(3"),
        (
            lambda ax: plot.ellipses(
                np.zeros((3, 2)), groups=[plot.Group(np.ones(2, bool), "C0", "all")], ax=ax
            ),
            r"groups: the mask of 'all' has shape \(2,\)",
        ),
        (lambda ax: plot.efficiency_map(light(), "glare", ax=ax), "efficiency 'glare'"),
        (lambda ax: plot.flux_3d(light(), "glare", ax=ax), "efficiency 'glare'"),
        (
            lambda ax: plot.receiver_map(replace(light().maps[0], flux=np.zeros((1, 9))), ax=ax),
            "only a map with 2 or more rows and columns",
        ),
        (
            lambda ax: plot.aim_figure(
                ht.aim(ht.example_plant(), sun=(0.1, 0.6, 0.8), limit=8e4, cells=(6, 1))
            ),
            "only a map with 2 or more rows and columns",
        ),
        (lambda ax: plot.field_map(np.zeros((3, 3)), [1.0], ax=ax), r"values: shape \(1,\)"),
        (lambda ax: plot.year_map([0.0], [0.0], [1.0], ax=ax), r"rms: shape \(1,\)"),
        (lambda ax: plot.drift(TIMES, [1.0], [1.0], ["sag"], ax=ax), r"values \(1,\) and cov"),
        (
            lambda ax: plot.mechanism_3d(
                plant().groups["azel"].mechanism[0], np.zeros((2, 2)), width=1, height=1, labels="a"
            ),
            "labels: 1 for 2 poses",
        ),
    ],
)  # fmt: skip
def test_guards(draw, text: str, ax: Axes) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InputError, match=text):
        draw(ax)
