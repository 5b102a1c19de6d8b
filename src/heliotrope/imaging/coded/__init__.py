"""Several beams on one target at once, identified by small coded movements.

- `codes`: orthogonal, zero-mean movements.
- `stack`: photographs of one surface and the light in each photograph.
- `beams`: expected beams, and found beams, each with a verdict.
- `separation`: from a stack and its codes to the beam of each heliostat.
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
