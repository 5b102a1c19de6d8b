"""How kernels are compiled.

``nogil`` lets blocks of rows run in threads, ``cache`` keeps the machine code beside the source,
and numpy's error model divides by zero without a branch. Kernels are plain functions without
annotations: their docstrings list their arguments, and the typed functions that call them check the
arguments.

Compilation takes most of the time of a first use. To the compiler, a writable array and a read-only
array are different types; hence `as_input`. Slice assignments, `np.median` and most of `np.linalg`
bring in thousands of lines each, wherever they are used, so kernels use loops instead. At a
terminal, one line reports when the first kernel is compiled. The compiler creates millions of
long-lived objects, and searching them repeatedly for garbage took a fifth of its time, so the
garbage collector is off during compilation.
"""

import gc
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
#: For functions that only kernels call. The wrapper for calls from Python, and a cached copy beside
#: the kernels that contain the function, would take a tenth of the compile time.
INNER: dict[str, Any] = {**OPTIONS, "cache": False, "no_cpython_wrapper": True}
#: For such functions in an innermost loop, where a call would cost more than the work itself.
INLINED: dict[str, Any] = {**INNER, "forceinline": True}


#: Turns a literal number in a call into an ordinary one. The compiler treats the 0 of ``f(0)`` as a
#: separate type and compiles one version of f for each literal. The loops of the fit keep their
#: literals, because this makes them 5 % faster.
plain = np.int64


def as_input(array: np.ndarray) -> np.ndarray:
    """Return a contiguous read-only array for a kernel, which is then compiled only once."""
    # Copy only if necessary; otherwise take a view, because the caller may write on to its array.
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view


def is_compiled(kernel: Any) -> bool:
    """Return whether the cached machine code of a kernel is newer than its source."""
    source = Path(kernel.py_func.__code__.co_filename)
    kept = Path(kernel.stats.cache_path).glob(f"*.{kernel.__name__}-*.nbi")
    return any(file.stat().st_mtime > source.stat().st_mtime for file in kept)


class Compilation(event.Listener):
    """Reports once, at a terminal, that kernels are compiled, and pauses garbage collection."""

    def __init__(self) -> None:
        self.told = False
        self.depth = 0
        self.collecting = False

    def on_start(self, event: Any) -> None:  # noqa: ARG002
        """Report the first kernel that is compiled, not one that is loaded from the cache."""
        # Compilations nest, and only one thread compiles at a time.
        if self.depth == 0:
            self.collecting = gc.isenabled()
            gc.disable()
        self.depth += 1
        if self.told:
            return
        self.told = True
        if sys.stderr is not None and sys.stderr.isatty():
            print(  # noqa: T201
                "heliotrope: compiling kernels, once after an installation; "
                "this takes up to half a minute",
                file=sys.stderr,
                flush=True,
            )

    def on_end(self, event: Any) -> None:  # noqa: ARG002
        """Resume garbage collection when the outermost kernel is compiled."""
        self.depth -= 1
        if self.depth == 0 and self.collecting:
            gc.enable()


#: The listener of this process.
COMPILATION = Compilation()
event.register("numba:compile", COMPILATION)  # type: ignore[no-untyped-call]
