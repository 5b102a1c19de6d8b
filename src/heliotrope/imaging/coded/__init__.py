"""Many beams on one target at once, told apart by their own small coded movements.

- `codes`: the movements, orthogonal and mean-free.
- `stack`: photographs of one surface and the light in each.
- `beams`: beams as they are expected and found, each with a verdict.
- `separation`: from a stack and its codes to each mirror's beam.
"""

from heliotrope.imaging.coded.beams import ExpectedBeam, SeparatedBeam, Verdict
from heliotrope.imaging.coded.codes import coded_movements, photographs_for, shared_codes
from heliotrope.imaging.coded.separation import Separation, separate
from heliotrope.imaging.coded.stack import DARK, Stack

__all__ = [
    "DARK",
    "ExpectedBeam",
    "SeparatedBeam",
    "Separation",
    "Stack",
    "Verdict",
    "coded_movements",
    "photographs_for",
    "separate",
    "shared_codes",
]
