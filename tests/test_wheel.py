"""A wheel of this tree, installed into an empty environment, runs a notebook there."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NOTEBOOK = ROOT / "examples" / "notebooks" / "own_centroid.ipynb"
#: Folders and endings of what is made beside the source.
BUILT = {"__pycache__", ".pyc"}
#: Executes a notebook with the environment's own kernel, in an empty folder.
EXECUTE = """
import sys
import nbclient, nbformat
import heliotrope
assert "site-packages" in heliotrope.__file__, heliotrope.__file__
notebook = nbformat.read(sys.argv[1], as_version=4)
nbclient.NotebookClient(notebook, timeout=600, startup_timeout=600).execute()
shown = [out for cell in notebook.cells if cell.cell_type == "code" for out in cell.outputs]
print(sum("image/png" in out.get("data", {}) for out in shown), "pictures")
"""


def _uv(*words: str, folder: Path) -> None:
    """Run uv; without a registry the test is skipped, but never in CI."""
    clean = {key: value for key, value in os.environ.items() if key != "VIRTUAL_ENV"}
    done = subprocess.run(
        [sys.executable, "-m", "uv", *words],
        cwd=folder,
        env=clean,
        capture_output=True,
        text=True,
        check=False,
        timeout=1200,
    )
    absent = "fetch" in done.stderr or "No module named uv" in done.stderr
    if done.returncode and absent and "CI" not in os.environ:
        pytest.skip(f"no uv, or no registry for it: {done.stderr.strip()[-200:]}")
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel of this tree."""
    folder = tmp_path_factory.mktemp("wheel")
    _uv("build", "--quiet", "--wheel", "--out-dir", str(folder), str(ROOT), folder=folder)
    (made,) = folder.glob("heliotrope-*.whl")
    return made


def test_a_wheel_holds_all_that_its_modules_read(wheel: Path) -> None:
    held = zipfile.ZipFile(wheel).namelist()
    source = ROOT / "src"
    kept = [path for path in (source / "heliotrope").rglob("*") if path.is_file()]
    kept = [path for path in kept if not BUILT.intersection((path.parent.name, path.suffix))]
    assert len(kept) > 300
    assert not {path.relative_to(source).as_posix() for path in kept}.difference(held)
    assert not [name for name in held if name.startswith("tests/") or name.endswith(".nbi")]


# A missing dependency is also found by tests/cli/test_plain_installation.py, within seconds.
@pytest.mark.slow
def test_a_wheel_runs_a_notebook_in_an_empty_environment(wheel: Path, tmp_path: Path) -> None:
    _uv("venv", "--quiet", "--python", sys.executable, "environment", folder=tmp_path)
    python = tmp_path / "environment" / "bin" / "python"
    constraints = str(ROOT / "constraints.txt")
    install = ("pip", "install", "--quiet", "--python", str(python), "--constraint", constraints)
    _uv(*install, f"{wheel}[notebook]", folder=tmp_path)
    empty = tmp_path / "empty"
    empty.mkdir()
    done = subprocess.run(
        [python, "-c", EXECUTE, str(NOTEBOOK)],
        cwd=empty,
        env={"PATH": f"{python.parent}:/usr/bin:/bin", "HOME": str(empty)},
        capture_output=True,
        text=True,
        check=False,
        timeout=1200,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert int(done.stdout.split()[0]) >= 1
    assert not list(empty.glob("*.toml"))
