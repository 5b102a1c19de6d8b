"""SolarPILOT's flux of the same field, where NREL-PySAM runs.

PySAM gets an environment of its own; `_solarpilot_worker` runs there. benchmarks/README.md explains
the setup.
"""

import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from benchmarks._run import why_missing

#: Environment: the interpreter with NREL-PySAM.
PYTHON = "HELIOTROPE_PYSAM_PYTHON"
WORKER = Path(__file__).with_name("_solarpilot_worker.py")


def why_skipped() -> str | None:
    """Return why SolarPILOT is missing from the contenders, None if it is among them."""
    return why_missing(PYTHON, ("PySAM.Solarpilot",))


def flux(job: dict[str, Any]) -> dict[str, Any]:
    """Return SolarPILOT's seconds and efficiencies of a field; see `_solarpilot_worker`."""
    with tempfile.TemporaryDirectory() as folder:
        given, out = Path(folder) / "job.json", Path(folder) / "out.json"
        given.write_text(json.dumps(job), encoding="utf-8")
        subprocess.run([os.environ[PYTHON], str(WORKER), str(given), str(out)], check=True)
        found: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
    return found
