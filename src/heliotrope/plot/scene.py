"""Draw a mechanism in three dimensions, with a time slider."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_vectors, normalize
from heliotrope.mechanism.animation import COLOURS, Moving, moving
from heliotrope.mechanism.chain import Mechanism

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

#: Length of the rays that are drawn, in mirror widths.
_RAY = 2.0


def mechanism_3d(
    mechanism: Mechanism,
    angles: npt.ArrayLike,
    *,
    width: float,
    height: float,
    labels: Sequence[str] = (),
    sun: npt.ArrayLike | None = None,
    aim: npt.ArrayLike | None = None,
    title: str = "armature and mirror",
    figure: "Figure | None" = None,
) -> "Figure":
    """Return a plotly figure of a heliostat's links, axes and mirror, with a time slider.

    Parameters
    ----------
    mechanism
        One heliostat with two drives.
    angles
        Joint angles, rad, (T, 2), such as ``tracked.chosen(tracked.angles)``.
    width, height
        Size of the mirror, m.
    labels
        Names of the T times on the slider; default: their indices.
    sun, aim
        Sun vectors, (T, 3), and the aim point, ENU m, (3,), whose rays are drawn.
    title
        Title of the figure.
    figure
        Figure to draw on; by default a new figure.

    Raises
    ------
    InputError
        If there is not exactly one mechanism with two drives, shapes do not fit, or plotly is not
        installed.
    """
    try:
        import plotly.graph_objects as go
    except ImportError:
        raise InputError(
            "mechanism_3d: plotly is not installed; run pip install 'heliotrope[notebook]'"
        ) from None

    scene = moving(mechanism, angles, width, height)
    count = len(scene.normal)
    names = list(labels) or [str(k) for k in range(count)]
    light = None if sun is None else np.broadcast_to(as_vectors(sun, "sun"), (count, 3))
    goal = None if aim is None else as_vectors(aim, "aim")
    if len(names) != count:
        raise InputError(f"labels: {len(names)} for {count} poses; specify one per pose")
    reach = _RAY * float(np.ptp(scene.mirror[0], axis=0).max())
    frames = [
        go.Frame(data=_traces(go, scene, k, light, goal, reach), name=name)
        for k, name in enumerate(names)
    ]
    shown = go.Figure() if figure is None else figure
    shown.add_traces(frames[0].data)
    first = len(shown.data) - len(frames[0].data)
    for frame in frames:
        frame.traces = list(range(first, len(shown.data)))
    shown.frames = frames
    shown.update_layout(title=title, **_layout(scene, names, reach))
    return shown


def _layout(scene: Moving, names: Sequence[str], reach: float) -> dict[str, Any]:
    """Return the layout: axes to scale, the slider and the buttons."""
    steps = [
        {"label": name, "method": "animate", "args": [[name], {"mode": "immediate"}]}
        for name in names
    ]
    play = {
        "type": "buttons",
        "buttons": [
            {"label": "Play", "method": "animate", "args": [None, {"frame": {"duration": 120}}]},
            {"label": "Stop", "method": "animate", "args": [[None], {"mode": "immediate"}]},
        ],
    }
    points = np.concatenate([scene.bones.reshape(-1, 3), scene.mirror.reshape(-1, 3)])
    low, high = points.min(axis=0) - 0.3 * reach, points.max(axis=0) + 0.3 * reach
    axes = {
        f"{letter}axis": {"title": title, "range": [low[i], high[i]]}
        for i, (letter, title) in enumerate(
            zip("xyz", ("east, m", "north, m", "up, m"), strict=True)
        )
    }
    return {
        "scene": {"aspectmode": "data", **axes},
        "sliders": [{"steps": steps, "currentvalue": {"prefix": "time "}}],
        "updatemenus": [play],
    }


def _traces(
    go: Any,
    scene: Moving,
    k: int,
    light: FloatArray | None,
    aim: FloatArray | None,
    reach: float,
) -> list[Any]:
    """Return the links, axes, mirror, normal and rays at one moment."""

    def line(points: FloatArray, colour: str, name: str, dash: str = "solid") -> Any:
        style = {"color": colour, "width": 6 if dash == "solid" else 3, "dash": dash}
        x, y, z = np.asarray(points).T
        return go.Scatter3d(x=x, y=y, z=z, mode="lines", name=name, line=style)

    def colour(name: str) -> str:
        return "rgb({:.0f},{:.0f},{:.0f})".format(*(255.0 * v for v in COLOURS[name]))

    bones, vertex = scene.bones[k], scene.bones[k, 3]
    x, y, z = scene.mirror[k].T
    normal = np.stack([vertex, vertex + 0.5 * reach * scene.normal[k]])
    traces = [
        line(bones[:2], colour("foundation"), "foundation"),
        line(bones[1:3], colour("primary"), "primary bone"),
        line(bones[2:], colour("secondary"), "secondary bone"),
        line(scene.axes[k, 0], colour("primary"), "primary axis", "dash"),
        line(scene.axes[k, 1], colour("secondary"), "secondary axis", "dash"),
        go.Mesh3d(
            x=x, y=y, z=z, i=[0, 0], j=[1, 2], k=[2, 3], color=colour("mirror"), opacity=0.7,
            name="mirror", showlegend=True,
        ),
        line(normal, colour("normal"), "normal"),
    ]  # fmt: skip
    if light is not None:
        traces.append(line(np.stack([vertex + reach * light[k], vertex]), "orange", "sun", "dot"))
    if aim is not None:
        end = vertex + reach * normalize(aim - vertex)
        traces.append(line(np.stack([vertex, end]), "gold", "beam", "dot"))
    return traces
