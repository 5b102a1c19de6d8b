"""The compiled code of mechanisms and tracking, for every package that compiles its own.

Kernels are plain functions without annotations, compiled by numba with the options of
`heliotrope.jit`: `OPTIONS` for what is called from Python, `INLINED` for what is called in an inner
loop. Their docstrings say what they take; the typed functions that call them check it. A kernel
gets arrays with one batch axis and writes rows ``start`` to ``stop`` of its outputs, so that
`heliotrope.parallel.run_blocks` can spread rows over threads. Vectors inside are tuples of floats,
which live in registers.

A kernel of another package may call these functions directly; numba compiles them into it.

- `slots`: places in the arrays (drives, armatures, what a parameter moves).
- `vectors`: three-vectors as tuples.
- `drives`: counts to joint angle, its derivatives, and back.
- `chain`: the chain of joints forward, and the screw Jacobian.
- `track`, `block`, `warm`: joint angles for a source and an aim; many rows with stops and branches;
  first steps of many rows in vector registers.

Machine code is cached beside the source; `python -m heliotrope.warm` compiles all of it once.
"""

from heliotrope.mechanism.kernels import block, chain, drives, slots, track, vectors, warm

__all__ = ["block", "chain", "drives", "slots", "track", "vectors", "warm"]
