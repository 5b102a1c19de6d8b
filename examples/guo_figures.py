"""Redraw figures 1 to 5 of Guo et al. (2013) with their numbers: ``python guo_figures.py``.

The paper's figures are sketches without scales. Here each is drawn for the heliostat model of its
section 5 (ψ_t = 1.854°, ψ_a = 236.06°, τ₁ = 5°, μ = −0.92°), and what the sketch says is printed as
numbers. The place, the sun, the offset and the screw are ours: the paper gives none.
"""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from heliotrope.geometry import FloatArray, angle_between, direction, reflect
from heliotrope.mechanism import linear_guo
from heliotrope.mechanism.axis_accuracy import axis_accuracy
from heliotrope.mechanism.guo import GuoParameters, forward, mirror_normal, track
from heliotrope.mechanism.guo_names import from_his_names

#: The parameters of section 5; the offset is ours.
MODEL = from_his_names({"psi_t": 1.854, "psi_a": 236.06, "tau_1": 5.0, "mu": -0.92, "H_z": 0.3})
#: The zeros of section 5, °.
ZEROS = {"gamma_0": -237.43, "alpha_0": 22.832}
TARGET = np.array([4.0, 9.0, 3.0])
SUN = direction(np.radians(140.0), np.radians(50.0))
#: a, b (m), slope β₀ (rad) and length x₀ (m) of the screw of figure 3: ours.
SCREW = (0.5, 1.2, np.radians(20.0), 1.0)


def axes_of(gamma: float, alpha: float, p: GuoParameters) -> tuple[FloatArray, FloatArray]:
    """Return the directions of the azimuth axis and of the elevation axis, ENU."""
    square = replace(p, tau_1=0.0, mu=0.0, azimuth_zero=0.0, elevation_zero=0.0)
    # With μ = 90° the "normal" lies along the elevation axis.
    along = replace(p, mu=0.5 * np.pi, azimuth_zero=0.0, elevation_zero=0.0)
    return forward(0.5 * np.pi, 0.0, square), forward(alpha, gamma, along)


def figure_1(ax: Any) -> dict[str, float]:
    """The geometry: pivot, mirror-centre normal, sun and target, both axes."""
    found = track(TARGET, SUN, MODEL, exact=True)
    gamma, alpha, n = float(found.gamma[0]), float(found.alpha[0]), found.normal
    azimuth_axis, elevation_axis = axes_of(gamma, alpha, MODEL)
    height = float(MODEL.offset)
    to_target = TARGET - height * n
    arrows = {
        "azimuth axis": (azimuth_axis, "#555555"),
        "elevation axis": (elevation_axis, "#0072b2"),
        "normal n": (n, "#d55e00"),
        "sun s": (SUN, "#e69f00"),
        "target t": (TARGET / np.linalg.norm(TARGET), "#009e73"),
    }
    for label, (way, colour) in arrows.items():
        ax.plot(*np.array([np.zeros(3), way]).T, color=colour, label=label)
    ax.scatter(*(height * n), color="#d55e00", s=12)
    ax.legend(fontsize=6, loc="upper left")
    demanded = mirror_normal(TARGET, SUN, MODEL.offset, exact=True)
    ray = reflect(SUN, n)
    return {
        "gamma_deg": np.degrees(gamma),
        "alpha_deg": np.degrees(alpha),
        "theta_deg": float(np.degrees(demanded.theta)),
        "tau_deg": float(np.degrees(demanded.tau)),
        "beam past target (µm)": 1e6 * float(np.linalg.norm(np.cross(ray, to_target))),
        "tau_1 (deg)": float(np.degrees(MODEL.tau_1)),
        "mu (deg)": float(np.degrees(MODEL.mu)),
        "between the axes (deg)": float(np.degrees(angle_between(azimuth_axis, elevation_axis))),
        "normal from the elevation axis (deg)": float(np.degrees(angle_between(n, elevation_axis))),
    }


def figure_2(ax: Any) -> dict[str, float]:
    """The zero of an axis: readings against true angles, and what (44)-(47) make of them."""
    rng = np.random.default_rng(2013)
    p = replace(
        MODEL,
        azimuth_zero=np.radians(ZEROS["gamma_0"]),
        elevation_zero=np.radians(ZEROS["alpha_0"]),
    )
    # Nine positions, as in his test; the laser's scatter is his: 0.014° and 0.011°.
    suns = direction(np.radians(np.linspace(110.0, 230.0, 9)), np.radians(45.0 + np.zeros(9)))
    true, shown = track(TARGET, suns, MODEL), track(TARGET, suns, p)
    gamma = shown.gamma[:, 0] + rng.normal(0.0, np.radians(0.014), 9)
    alpha = shown.alpha[:, 0] + rng.normal(0.0, np.radians(0.011), 9)
    found = axis_accuracy(alpha, gamma, true.alpha[:, 0], true.gamma[:, 0])
    for angle, colour, label in ((0.0, "#0072b2", "reference zero"), (122.57, "#d55e00", "true")):
        ax.plot([0, np.sin(np.radians(angle))], [0, np.cos(np.radians(angle))], color=colour,
                label=label)  # fmt: skip
    ax.set_aspect("equal")
    ax.legend(fontsize=6)
    return {
        "gamma_0 as printed (deg)": ZEROS["gamma_0"],
        "gamma_0 as printed, plus a turn (deg)": ZEROS["gamma_0"] + 360.0,
        "gamma_0_deg": float(np.degrees(found.gamma_0)) - 360.0,
        "sigma_gamma_deg": float(np.degrees(found.sigma_gamma)),
        "alpha_0_deg": float(np.degrees(found.alpha_0)),
        "sigma_alpha_deg": float(np.degrees(found.sigma_alpha)),
    }


def figure_3(ax: Any) -> dict[str, float]:
    """The screw of the elevation axis, (41) and (42)."""
    a, b, slope, at_zero = SCREW
    screw = linear_guo(a, b, slope, at_zero, 1.0)
    alpha = np.radians(np.linspace(0.0, 90.0, 91))
    x = screw.counts(alpha)
    ax.plot(np.degrees(alpha), 1e3 * x, color="#0072b2")
    ax.set_xlabel("α, °")
    ax.set_ylabel("x, mm")
    at = float(np.radians(40.0))
    place = float(screw.counts(at))
    printed = np.sqrt(a * a + b * b + 2.0 * a * b * np.cos(at + slope)) - at_zero
    back = np.arccos(((place + at_zero) ** 2 - (a * a + b * b)) / (2.0 * a * b)) - slope
    return {
        "a (m)": a,
        "b (m)": b,
        "beta_0 (deg)": float(np.degrees(slope)),
        "x of alpha = 40 deg (m)": place,
        "x by (41) (m)": float(printed),
        "alpha by (42) (deg)": float(np.degrees(back)),
        "x at alpha = 0 (m)": float(x[0]),
    }


def figure_4(ax: Any) -> dict[str, float]:
    """(39): α and μ against α + 180° and 180° − μ."""
    gamma, alpha = 0.7, 0.5
    over = replace(MODEL, mu=np.pi - MODEL.mu)
    half = replace(MODEL, mu=-MODEL.mu)
    n = forward(alpha, gamma, MODEL)
    n_1, n_2 = forward(alpha + np.pi, gamma, half), forward(alpha + np.pi, gamma, over)
    _, elevation_axis = axes_of(gamma, alpha, MODEL)
    _draw(ax, {"n": n, "n₁": n_1, "n₂": n_2, "elevation axis": elevation_axis})
    return {
        "n to n2 (rad)": float(angle_between(n, n_2)),
        "n + n1, which are opposite (rad)": float(np.linalg.norm(n + n_1)),
    }


def figure_5(ax: Any) -> dict[str, float]:
    """(40): γ, τ₁ and α against γ + 180°, 180° − τ₁ and α + 180°."""
    gamma, alpha = 0.7, 0.5
    other = replace(MODEL, tau_1=np.pi - MODEL.tau_1)
    n = forward(alpha, gamma, MODEL)
    n_3 = forward(alpha, gamma + np.pi, MODEL)
    n_4 = forward(alpha, gamma + np.pi, other)
    back = forward(alpha + np.pi, gamma + np.pi, other)
    _, e = axes_of(gamma, alpha, MODEL)
    _draw(ax, {"n": n, "n₃": n_3, "n₄": n_4, "elevation axis": e})
    # n₄ and n lie in a plane with the elevation axis, symmetric about it.
    return {
        "n to the equivalent set (rad)": float(angle_between(n, back)),
        "n and n4 mirrored at the elevation axis (rad)": float(
            angle_between(2.0 * (n @ e) * e - n, n_4)
        ),
    }


def _draw(ax: Any, ways: dict[str, FloatArray]) -> None:
    colours = ("#d55e00", "#0072b2", "#009e73", "#555555")
    for (label, way), colour in zip(ways.items(), colours, strict=True):
        ax.plot(*np.array([np.zeros(3), way]).T, color=colour, label=label)
    ax.legend(fontsize=6, loc="upper left")


def main(folder: Path) -> dict[str, dict[str, float]]:
    """Draw the five figures into one picture and return their numbers by figure."""
    figure = Figure(figsize=(11.0, 7.0), layout="constrained")
    solid = {1: figure_1, 4: figure_4, 5: figure_5}
    flat = {2: figure_2, 3: figure_3}
    found = {}
    for k in range(1, 6):
        kind = {"projection": "3d"} if k in solid else {}
        ax = figure.add_subplot(2, 3, k, **kind)
        ax.set_title(f"figure {k}", fontsize=9)
        found[f"figure {k}"] = (solid | flat)[k](ax)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "guo-figures.png"
    figure.savefig(path, dpi=110)
    for name, numbers in found.items():
        print(name)
        for what, value in numbers.items():
            print(f"  {what:45} {value:12.6g}")
    print(path)
    return found


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out"))
