"""Reads files in a process whose memory is bounded, and says how each reading ended.

Run as a program with the limit of memory in bytes; the readings come on standard input as JSON, a
list of ``[name, module, function, arguments]``. A reading ends as the command line would end it.
"""

import contextlib
import io
import json
import resource
import sys
import traceback
from importlib import import_module
from pathlib import Path
from typing import Any

from heliotrope.errors import HeliotropeError

#: Seconds of processor time for all readings.
SECONDS = 120


def _ended(module: str, function: str, arguments: list[Any]) -> tuple[int, str]:
    """Return the exit code and the text of one reading."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            if module == "heliotrope.cli":
                sys.argv = ["heliotrope", *arguments]
                import_module(module).main()
            else:
                getattr(import_module(module), function)(*arguments)
        except SystemExit as leaving:
            return int(leaving.code or 0), err.getvalue() + out.getvalue()
        except HeliotropeError as error:
            return 2, str(error)
        except Exception:  # noqa: BLE001  # the test shows it
            return 1, traceback.format_exc()
    return 0, out.getvalue()


def _most() -> int:
    """Return the greatest memory of this program in bytes.

    ``ru_maxrss`` counts the process that started it too.
    """
    (line,) = (
        line
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        if line.startswith("VmHWM:")
    )
    return int(line.split()[1]) * 1024


def main() -> None:
    """Print the code and text of each reading by its name, as JSON, and the greatest memory."""
    limit = int(sys.argv[1])
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
    for name, *reading in json.load(sys.stdin):
        code, text = _ended(*reading)
        print(json.dumps({"name": name, "code": code, "text": text, "most": _most()}), flush=True)


if __name__ == "__main__":
    main()
