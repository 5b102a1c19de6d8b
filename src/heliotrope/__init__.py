"""Heliotrope runs the heliostat field of a solar power tower.

It computes where every mirror must point, learns each mirror's imperfections
from measurements, and corrects them. Importing this package is light: the
heavy libraries are loaded by the modules that use them.
"""

__version__ = "0.1.0"
