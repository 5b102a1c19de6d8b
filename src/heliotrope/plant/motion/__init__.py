"""Motion: paths of mirrors past keep-out volumes, their proofs, and the watch over beams.

`BeamWatch` proves a path before it is ordered and watches where beams are afterwards.
"""
