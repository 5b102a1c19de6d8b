"""Draw the pictures of docs/tutorial/airborne.md and docs/explanation/airborne.md.

``python scripts/airborne_figures.py [FOLDER]`` runs the tutorial up to the evaluation in a
temporary folder and writes the plan's map, a photograph and one heliostat to FOLDER (default
docs/images), and for the explanation a mirror of four facets under HelioPoint's conditions.
"""

import contextlib
import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from heliotrope.airborne.evaluate.orientation import measure
from heliotrope.airborne.evaluate.pictures import heliostat_drawing
from heliotrope.airborne.simulate.trial import TrialConditions, four_facets, trial_mirror

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "tutorial" / "airborne.md"
BLOCK = re.compile(r"```(?P<kind>python|console)\n(?P<body>.*?)^```", re.DOTALL | re.MULTILINE)
#: Heading on the page after the last picture.
LAST = "## All points"
#: Photograph, its rows that show mirrors, and its enlargement.
SHOWN, ROWS, SCALE = "photographs/C1-8/DJI_0013.JPG", slice(110, 450), 1.5


def run(text: str) -> dict[str, Any]:
    """Run the blocks of a page in this folder; return the names that its Python defines."""
    names: dict[str, Any] = {"__name__": "__page__"}
    for block in BLOCK.finditer(text):
        if block["kind"] == "python":
            with contextlib.redirect_stdout(None):
                exec(compile(block["body"], str(PAGE), "exec"), names)  # noqa: S102  # the page's own lines
            continue
        for line in re.findall(r"^\$ (.*)", block["body"], flags=re.MULTILINE):
            words = shlex.split(line)
            call = [sys.executable, "-c", "from heliotrope.cli import main; main()", *words[1:]]
            subprocess.run(call, check=True, stdout=subprocess.DEVNULL)  # noqa: S603  # as there
    return names


def main() -> None:
    """Write the pictures."""
    out = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "docs" / "images").resolve()
    text = PAGE.read_text(encoding="utf-8").partition(LAST)[0]
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        names = run(text)
        (out / "airborne-plan.png").write_bytes(Path("flight/map.png").read_bytes())
        seen = cv2.imread(SHOWN)[ROWS]
        seen = cv2.resize(seen, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(out / "airborne-photograph.jpg"), seen, [cv2.IMWRITE_JPEG_QUALITY, 88])
        one = names["one"]
        name, shape = names["plant"].names[one.heliostat], names["shape"](one.heliostat)
        drawn = heliostat_drawing(name, one, shape)
        (out / "airborne-heliostat.svg").write_text(drawn + "\n", encoding="utf-8")
        os.chdir(ROOT)
    (out / "airborne-facets.svg").write_text(four() + "\n", encoding="utf-8")


def four() -> str:
    """Return the picture of four facets, the last of which is canted off by 1.5 mrad."""
    mirror = four_facets()
    turns = np.zeros((4, 2))
    turns[3, 1] = 1.5e-3
    flown = trial_mirror(mirror.canted(turns), TrialConditions(columns=11, rows=9), 3)
    found = measure(flown.reflections, mirror, flown.expected_rotation, flown.expected_vertex)
    return heliostat_drawing("Four facets", found, mirror)


if __name__ == "__main__":
    main()
