"""Reproduce figure 3.5 of Malan's thesis and trace rays against it: ``python malan_intercept.py``.

His intercept, (3.2)-(3.3), is the overlap of two even disks; ours is a Gaussian beam in a circular
aperture. Both are drawn over the tracking error of the normal, θ_s = 9.3 mrad and a slope error of
1.5 mrad, beside a ray trace: a focused mirror of 5 m², an even solar disk, a slope error that is
normally distributed with 1.5 mrad in each direction, and a normal that is turned by the tracking
error. The aperture is the one that (3.2) prints, and for comparison the radius that its words say.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from heliotrope.geometry import FloatArray, normalize, reflect
from heliotrope.optics import beam_sigma, intercept_circle, intercept_disks

SUN_ANGLE, SLOPE = 9.3e-3, 1.5e-3
#: Radius of the aperture over the slant range: as (3.2) prints it, and as its words say.
PRINTED = 2.0 * (SUN_ANGLE / 2.0 + SLOPE)
IMAGE = SUN_ANGLE / 2.0 + 2.0 * SLOPE
SLANT, SIDE = 100.0, np.sqrt(5.0)
RAYS = 200_000


def trace(tracking: float, seed: int = 35) -> FloatArray:
    """Return where rays of a mirror off by ``tracking`` meet the aperture's plane, m, (RAYS, 2).

    The mirror looks up from the origin at a target ``SLANT`` above it, sun behind the target: the
    incidence is head-on. Its normals are those of a paraboloid of that focus.
    """
    rng = np.random.default_rng(seed)
    at = np.zeros((RAYS, 3))
    at[:, :2] = rng.uniform(-0.5 * SIDE, 0.5 * SIDE, (RAYS, 2))
    lean = -at[:, :2] / (2.0 * SLANT) + rng.normal(0.0, SLOPE, (RAYS, 2))
    lean[:, 0] += tracking
    normal = normalize(np.column_stack([lean, np.ones(RAYS)]))
    radius = np.tan(SUN_ANGLE / 2.0) * np.sqrt(rng.uniform(size=RAYS))
    around = rng.uniform(0.0, 2.0 * np.pi, RAYS)
    sun = normalize(
        np.column_stack([radius * np.cos(around), radius * np.sin(around), np.ones(RAYS)])
    )
    ray = reflect(sun, normal)
    return at[:, :2] + ray[:, :2] * (SLANT / ray[:, 2])[:, None]


def shares(tracking: float) -> dict[str, float]:
    """Return the intercept ratios at one tracking error, rad."""
    hits = np.linalg.norm(trace(tracking), axis=-1) / SLANT
    sigma = beam_sigma(1.0, slope=SLOPE)
    return {
        "disks, (3.3)": float(intercept_disks(tracking, slope=SLOPE, sun_angle=SUN_ANGLE)),
        "Gaussian": float(intercept_circle(PRINTED, sigma, right=2.0 * tracking)),
        "ray trace": float((hits <= PRINTED).mean()),
        "Gaussian, image": float(intercept_circle(IMAGE, sigma, right=2.0 * tracking)),
        "ray trace, image": float((hits <= IMAGE).mean()),
    }


def main(folder: Path) -> dict[float, dict[str, float]]:
    """Draw the figure, print the numbers and return them by tracking error, mrad."""
    errors = np.arange(0.0, 5.01, 0.25)
    found = {float(e): shares(1e-3 * e) for e in errors}
    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    ax = figure.subplots()
    styles = ("-", "-", ".", "--", "x")
    colours = ("#d55e00", "#0072b2", "#0072b2", "#009e73", "#009e73")
    for name, style, colour in zip(found[0.0], styles, colours, strict=True):
        ax.plot(errors, [100 * f[name] for f in found.values()], style, color=colour, label=name)
    ax.set_xlabel("tracking error of the normal, mrad")
    ax.set_ylabel("intercept, %")
    ax.set_ylim(0, 101)
    ax.grid(alpha=0.3)
    ax.legend(frameon=False, fontsize=8)
    ax.set_title("Figure 3.5, and what a ray trace says of it", fontsize=10)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "figure-3-5.png"
    figure.savefig(path, dpi=110)
    print(
        f"aperture as printed {1e3 * PRINTED:.2f} mrad, image {1e3 * IMAGE:.2f} mrad; shares in %"
    )
    print("mrad  " + "  ".join(found[0.0]))
    for error in (0.0, 0.5, 0.75, 1.0, 2.0, 3.0, 5.0):
        row = (f"{100 * v:{len(n)}.1f}" for n, v in found[error].items())
        print(f"{error:4.2f}  " + "  ".join(row))
    apart = max(
        abs(f[f"Gaussian{which}"] - f[f"ray trace{which}"])
        for f in found.values()
        for which in ("", ", image")
    )
    print(f"Gaussian and ray trace differ by at most {100 * apart:.1f} points")
    print(path)
    return found


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out"))
