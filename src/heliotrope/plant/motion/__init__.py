"""Motion: heliostat paths around keep-out volumes, their proofs, and the monitoring of beams.

`PathProofs` proves a path before it is ordered, and `BeamWatch` monitors afterwards where the beams
are.
"""
