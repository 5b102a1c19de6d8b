"""Motion: heliostat paths around keep-out volumes, checks of these paths, and beam monitoring.

`PathProofs` proves that a path is clear before it is ordered, and `BeamWatch` then monitors where
the beams are.
"""
