"""Motion: heliostat paths around keep-out volumes, their proofs, and the monitoring of beams.

`PathProofs` proves that a path is clear before it is ordered, and `BeamWatch` then monitors where
the beams are.
"""
