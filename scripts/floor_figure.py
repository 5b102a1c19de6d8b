"""Draw what `python -m benchmarks floor --json` gave: errors at Jülich beside their floor.

``python scripts/floor_figure.py RESULT [FOLDER]`` with the file of the result and, by default,
docs/images for the picture.
"""

import json
import sys
from pathlib import Path

from matplotlib.figure import Figure

GOALS = {"random": 0.35, "sequential": 0.45, "chronological": 1.0}


def main() -> None:
    """Draw the picture."""
    result = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    folder = Path(sys.argv[2] if len(sys.argv) > 2 else "docs/images")
    rows = result["rows"]
    picture = Figure(figsize=(7.2, 3.4), layout="constrained")
    axes = picture.subplots()
    at = range(len(rows))
    oracle = [row["oracle_mrad"] for row in rows]
    low = [row["oracle_mrad"] - row["oracle_low_mrad"] for row in rows]
    high = [row["oracle_high_mrad"] - row["oracle_mrad"] for row in rows]
    again = [row["learner_on_drawn_mrad"] for row in rows]
    real = [row["measured_mrad"] for row in rows]
    axes.bar(at, oracle, 0.55, yerr=[low, high], color="#bbccdd", capsize=4, label="oracle, 90 %")
    axes.plot(at, again, "s", color="#e69f00", label="learner, drawn measurements")
    axes.plot(at, real, "o", color="#0072b2", label="learner, real measurements")
    goals = [(k, GOALS[row["split"]]) for k, row in enumerate(rows) if row["split"] in GOALS]
    axes.hlines([g for _, g in goals], [k - 0.35 for k, _ in goals], [k + 0.35 for k, _ in goals],
                color="#d55e00", linestyles="dashed", label="goal")  # fmt: skip
    names = ["neighbourhoods" if row["split"] == "neighbour" else row["split"] for row in rows]
    axes.set_xticks(list(at), names)
    axes.set_ylabel("median of medians, mrad of beam")
    axes.set_ylim(0.0)
    axes.legend(frameon=False, fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    picture.savefig(folder / "floor-juelich.png", dpi=120)


if __name__ == "__main__":
    main()
