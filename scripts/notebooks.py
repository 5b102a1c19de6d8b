"""Run the notebooks of examples/, and store them with their pictures.

python scripts/notebooks.py [NAME ...]

Pictures are stored with a palette, so that each stays below 100 kB; scenes of plotly as their
data alone, which Jupyter draws. The data of juelich.ipynb are those of `heliotrope fetch`, or of
the folder that HELIOTROPE_DATA names.
"""

import argparse
import base64
import io
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient
from PIL import Image

EXAMPLES = Path(__file__).parents[1] / "examples"
#: Most bytes of a stored picture, and its colours.
PICTURE, COLOURS = 100_000, 64


def notebooks() -> list[Path]:
    """Return the files of all notebooks."""
    return [*sorted(EXAMPLES.glob("*.ipynb")), *sorted(EXAMPLES.glob("notebooks/*.ipynb"))]


def executed(path: Path, folder: Path) -> Any:
    """Return a notebook run from top to bottom in a folder, with its outputs."""
    notebook = nbformat.read(path, as_version=4)
    where = {"metadata": {"path": str(folder)}}
    NotebookClient(
        notebook, timeout=600, startup_timeout=600, record_timing=False, resources=where
    ).execute()
    return notebook


def small(picture: str) -> str:
    """Return a PNG in base64 with a palette."""
    image = Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGB")
    stream = io.BytesIO()
    image.quantize(COLOURS, dither=Image.Dither.NONE).save(stream, "PNG", optimize=True)
    return base64.b64encode(stream.getvalue()).decode()


def store(path: Path, notebook: Any) -> None:
    """Write a notebook with small outputs, and nothing that differs from run to run."""
    notebook.metadata.pop("widgets", None)
    notebook.metadata.get("language_info", {}).pop("version", None)
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "image/png" in data:
                data["image/png"] = small(data["image/png"])
            if any("plotly" in kind for kind in data):
                data.pop("text/html", None)
    nbformat.write(notebook, path)


def main() -> None:
    """Run and store the notebooks that the command line names, by default all."""
    parser = argparse.ArgumentParser(description="Run notebooks, and store them with pictures.")
    parser.add_argument("names", nargs="*", help="stems of their files, as first_hour")
    wanted = parser.parse_args().names
    for path in notebooks():
        if wanted and path.stem not in wanted:
            continue
        with tempfile.TemporaryDirectory() as folder:
            store(path, executed(path, EXAMPLES if path.parent == EXAMPLES else Path(folder)))
        print(f"{path.relative_to(EXAMPLES)}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
