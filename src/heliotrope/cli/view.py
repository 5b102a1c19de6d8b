"""``heliotrope view``: a heliostat's mechanism in three dimensions, moving through a day."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from heliotrope.cli._common import open_plant, parse_duration, parse_time
from heliotrope.cli.track import (
    AimOption,
    FieldArgument,
    HeliostatOption,
    TargetOption,
    aim_of,
)
from heliotrope.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from heliotrope.mechanism.animation import Moving

#: Simulated time that passes in a second of the animation, s.
_PACE = 3600.0
#: Length of the rays that are drawn, in widths of the mirror.
_RAY = 2.0


def view(
    field: FieldArgument,
    out: Annotated[Path, typer.Argument(help="File to write: .html, or .glb for Blender.")],
    heliostat: HeliostatOption,
    aim: AimOption = None,
    target: TargetOption = None,
    time: Annotated[str, typer.Option(help="A moment of the day, ISO 8601 with a zone.")] = "now",
    every: Annotated[str, typer.Option(help="Time between two poses: 5min, 30s.")] = "10min",
) -> None:
    """Write a day of a heliostat as an animated 3D view."""
    import numpy as np

    from heliotrope import sun as solar
    from heliotrope.files.text import write_file
    from heliotrope.mechanism import animation, tracking

    kind = out.suffix.lower()
    if kind not in (".html", ".glb"):
        raise InputError(f"view: {out.name}; give a file that ends in .html or .glb")
    plant = open_plant(field)
    one = plant[heliostat]
    mechanism, width, height = one.calibrated, one.width, one.height
    goal = np.array(aim_of(plant, heliostat, aim, target))
    times = solar.daylight(parse_time(time).date(), plant.site, every=parse_duration(every))
    light = np.asarray(solar.vector(times, plant.site))
    found = tracking.track(mechanism, light, goal)
    good = found.reachable
    if not good.any():
        raise InputError(f"heliostat {heliostat}: the beam reaches the aim at no time of this day")
    angles = np.unwrap(found.best_angles[good], axis=0)
    chosen = [at for at, one in zip(times, good, strict=True) if one]
    seconds = np.array([(at - chosen[0]).total_seconds() for at in chosen]) / _PACE
    if kind == ".glb":
        data = animation.glb(mechanism, angles, seconds, width, height)
    else:
        scene = animation.moving(mechanism, angles, width, height)
        labels = [at.strftime("%H:%M UTC") for at in chosen]
        data = _page(heliostat, scene, light[good], goal, labels).encode()
    write_file(out, lambda stream: stream.write(data))
    span = f"{chosen[0]:%Y-%m-%d %H:%M} to {chosen[-1]:%H:%M} UTC"
    print(f"{out.name}: {heliostat}, {len(chosen)} of {len(good)} poses reach the aim, {span}")


def _page(
    name: str, scene: "Moving", light: "np.ndarray", aim: "np.ndarray", labels: list[str]
) -> str:
    """Return a self-contained page with a slider of time."""
    import numpy as np

    try:
        import plotly.graph_objects as go
    except ImportError:
        raise InputError(
            "view: plotly is not installed; say pip install 'heliotrope[notebook]', or write a .glb"
        ) from None

    reach = _RAY * float(np.ptp(scene.mirror[0], axis=0).max())
    frames = [
        go.Frame(data=_traces(go, scene, k, light[k], aim, reach), name=label)
        for k, label in enumerate(labels)
    ]
    steps = [
        {"label": label, "method": "animate", "args": [[label], {"mode": "immediate"}]}
        for label in labels
    ]
    play = {
        "type": "buttons",
        "buttons": [
            {"label": "Play", "method": "animate", "args": [None, {"frame": {"duration": 120}}]},
            {"label": "Stop", "method": "animate", "args": [[None], {"mode": "immediate"}]},
        ],
    }
    figure = go.Figure(data=frames[0].data, frames=frames)
    points = np.concatenate([scene.bones.reshape(-1, 3), scene.mirror.reshape(-1, 3)])
    low, high = points.min(axis=0) - 0.3 * reach, points.max(axis=0) + 0.3 * reach
    names = ("east, m", "north, m", "up, m")
    axes = {
        f"{letter}axis": {"title": title, "range": [low[i], high[i]]}
        for i, (letter, title) in enumerate(zip("xyz", names, strict=True))
    }
    figure.update_layout(
        title=f"{name}: armature and mirror through a day",
        scene={"aspectmode": "data", **axes},
        sliders=[{"steps": steps, "currentvalue": {"prefix": "time "}}],
        updatemenus=[play],
    )
    return str(figure.to_html(include_plotlyjs=True, full_html=True))


def _traces(
    go: Any, scene: "Moving", k: int, light: "np.ndarray", aim: "np.ndarray", reach: float
) -> list[Any]:
    """Return bones, axes, mirror, normal and rays of one moment."""
    import numpy as np

    from heliotrope.geometry import normalize
    from heliotrope.mechanism.animation import COLOURS

    def line(points: "np.ndarray", colour: str, name: str, dash: str = "solid") -> Any:
        style = {"color": colour, "width": 6 if dash == "solid" else 3, "dash": dash}
        x, y, z = np.asarray(points).T
        return go.Scatter3d(x=x, y=y, z=z, mode="lines", name=name, line=style)

    def colour(name: str) -> str:
        return "rgb({:.0f},{:.0f},{:.0f})".format(*(255.0 * v for v in COLOURS[name]))

    bones, vertex = scene.bones[k], scene.bones[k, 3]
    x, y, z = scene.mirror[k].T
    beam = normalize(aim - vertex)
    return [
        line(bones[:2], colour("foundation"), "foundation"),
        line(bones[1:3], colour("primary"), "primary bone"),
        line(bones[2:], colour("secondary"), "secondary bone"),
        line(scene.axes[k, 0], colour("primary"), "primary axis", "dash"),
        line(scene.axes[k, 1], colour("secondary"), "secondary axis", "dash"),
        go.Mesh3d(
            x=x, y=y, z=z, i=[0, 0], j=[1, 2], k=[2, 3], color=colour("mirror"), opacity=0.7,
            name="mirror", showlegend=True,
        ),
        line(
            np.stack([vertex, vertex + 0.5 * reach * scene.normal[k]]), colour("normal"), "normal"
        ),
        line(np.stack([vertex + reach * light, vertex]), "orange", "sun", "dot"),
        line(np.stack([vertex, vertex + reach * beam]), "gold", "beam", "dot"),
    ]  # fmt: skip
