"""How kernels are compiled.

``nogil`` lets blocks of rows run in threads, ``cache`` stores the machine code beside the source,
and NumPy's error model divides by zero without a branch. Kernels are plain functions without
annotations: their docstrings list their arguments, and the typed functions that call them check the
arguments.

Compilation takes most of the time of a first use. The compiler treats writable and read-only arrays
as different types, which is why `as_input` exists. Slice assignments, `np.median` and most of
`np.linalg` each add thousands of lines to be compiled wherever they are used, so kernels use loops
instead. At a terminal, one line reports when the first kernel is compiled. The garbage collector is
off during compilation, because the compiler creates millions of long-lived objects, and searching
them repeatedly for garbage took a fifth of its time.
"""

import gc
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numba.core import event

OPTIONS: dict[str, Any] = {
    "nogil": True,
    "cache": True,
    "error_model": "numpy",
    "no_cfunc_wrapper": True,
}
#: Options for functions that only kernels call. Without these options, a wrapper for calls from
#: Python and a cached copy of the function would take a tenth of the compile time.
INNER: dict[str, Any] = {**OPTIONS, "cache": False, "no_cpython_wrapper": True}
#: Options for such functions in an innermost loop, where a call would cost more than the work
#: itself.
INLINED: dict[str, Any] = {**INNER, "forceinline": True}


#: Environment variable with the process that reports compilation also for its child processes,
#: which inherit the variable.
PROGRAM = "HELIOTROPE_PROGRAM"

#: Function that turns a literal number in a call into an ordinary number. The compiler treats the 0
#: of ``f(0)`` as a separate type and compiles one version of f for each literal. The loops of the
#: fit keep their literals, because this makes them 5 % faster.
plain = np.int64


def as_input(array: np.ndarray) -> np.ndarray:
    """Return a contiguous read-only array for a kernel, which is then compiled only once."""
    # Copy only if necessary. Otherwise use a view, because the caller may still write to its array.
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view


def is_compiled(kernel: Any) -> bool:
    """Return whether the cached machine code of a kernel is newer than its source."""
    source = Path(kernel.py_func.__code__.co_filename)
    kept = Path(kernel.stats.cache_path).glob(f"*.{kernel.__name__}-*.nbi")
    return any(file.stat().st_mtime > source.stat().st_mtime for file in kept)


class Compilation(event.Listener):
    """Listener that reports compilation once, at a terminal, and pauses garbage collection."""

    def __init__(self) -> None:
        self.told = False
        self.depth = 0
        self.collecting = False

    def on_start(self, event: Any) -> None:  # noqa: ARG002
        """Report the first kernel that is compiled rather than loaded from the cache."""
        # Compilations nest, and only one thread compiles at a time.
        if self.depth == 0:
            self.collecting = gc.isenabled()
            gc.disable()
        self.depth += 1
        if self.told:
            return
        self.told = True
        mine = str(os.getpid())
        inherited = os.environ.setdefault(PROGRAM, mine) != mine
        if not inherited and sys.stderr is not None and sys.stderr.isatty():
            print(  # noqa: T201
                "heliotrope: compiling kernels, once after an installation; "
                "this takes up to half a minute",
                file=sys.stderr,
                flush=True,
            )

    def on_end(self, event: Any) -> None:  # noqa: ARG002
        """Resume garbage collection after the outermost kernel has been compiled."""
        self.depth -= 1
        if self.depth == 0 and self.collecting:
            gc.enable()


#: The listener of this process.
COMPILATION = Compilation()
event.register("numba:compile", COMPILATION)  # type: ignore[no-untyped-call]
