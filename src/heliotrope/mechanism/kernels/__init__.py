"""Compiled kernels for mechanisms and tracking; kernels of other packages may call them.

Kernels are plain functions without annotations, compiled by numba with the options of
`heliotrope.jit`: `OPTIONS` for functions called from Python, `INLINED` for functions called in an
inner loop. Their docstrings list their arguments; the typed functions that call them check the
arguments. A kernel takes arrays with one batch axis and writes rows ``start`` to ``stop`` of its
outputs, so that `heliotrope.parallel.run_blocks` can spread the rows over threads. Inside the
kernels, vectors are tuples of floats, which stay in registers.

Kernels in other packages may call these functions directly; numba compiles them into the caller.

- `slots`: positions in the arrays (drives, armatures, what a parameter moves).
- `vectors`: three-vectors as tuples.
- `drives`: motor counts to a joint angle, its derivatives, and the inverse.
- `chain`: forward kinematics of the joint chain, and the screw Jacobian.
- `track`, `block`, `warm`: joint angles for a source and an aim; many rows with stops and branches;
  first steps of many rows in vector registers.

The machine code is cached beside the source; `python -m heliotrope.warm` compiles all kernels once.
"""

from heliotrope.mechanism.kernels import block, chain, drives, slots, track, vectors, warm

__all__ = ["block", "chain", "drives", "slots", "track", "vectors", "warm"]
