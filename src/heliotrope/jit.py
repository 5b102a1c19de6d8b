"""How kernels are compiled.

``nogil`` lets blocks of rows run on threads, ``cache`` keeps the machine code beside the
source, and numpy's error model divides by zero without a branch. Kernels are plain
functions without annotations: what they take is said in their texts and checked by the
typed functions that call them.
"""

from typing import Any

OPTIONS: dict[str, Any] = {"nogil": True, "cache": True, "error_model": "numpy"}
#: For what is called in an innermost loop: a call through a pointer costs more than its work.
INLINED: dict[str, Any] = {**OPTIONS, "forceinline": True}
