"""Motion: paths of mirrors past keep-out volumes, their proofs, and the watch over beams.

`PathProofs` proves a path before it is ordered, and `BeamWatch` watches where beams are afterwards.
"""
