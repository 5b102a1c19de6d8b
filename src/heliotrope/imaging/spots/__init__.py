"""Beams on a target face: background, spots and their centroids, and whether to believe them."""
