"""How kernels are compiled.

``nogil`` lets blocks of rows run on threads, ``cache`` keeps the machine code beside the
source, and numpy's error model divides by zero without a branch. Kernels are plain
functions without annotations: their docstrings say what they take, and the typed functions
that call them check it.
"""

from typing import Any

OPTIONS: dict[str, Any] = {"nogil": True, "cache": True, "error_model": "numpy"}
#: For functions called in an innermost loop, where a call would cost more than the work.
INLINED: dict[str, Any] = {**OPTIONS, "forceinline": True}
