"""HelioK XML: heliostats with arbitrary axes, nested nodes, facets (Grigoriev et al. 2021).

A file is kept as a :class:`~heliotrope.field.formats._tree.Document`, word for word, so
that reading, writing and reading again gives the same numbers and the same structure,
with every attribute and comment, known or not. The functions below read its meaning::

    HelioK   version, unitLength, unitAngle
      World    Location (name, longitude, latitude); Sun (azimuth, elevation, irradiance)
      Factory  Material; HeliostatKit name: Primary, Secondary (translation, rotationAxis,
               rotationAngles = stops), Facet (translation, rotation; ShapeKit), Angles,
               Tracking (point, normal), Aiming (point)
      Scene    Node (name, translation, rotation), nested; in it ShapeKit or HeliostatKit ref

The frame is ENU; the azimuth of the sun is clockwise from north. A rotation is three
Euler angles applied about x, then y, then z, each about the fixed axis: R = Rz·Ry·Rx. A
facet's own frame has the mirror in x and y and its normal along z.

A number may carry its own unit behind a space ("1.000 mrad"). HelioK reads ``Angles``
without one as radians, drops the last digit of it and ignores ``unitLength``; here the
units of the root hold for all, and what is written names the unit of ``Angles``.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from heliotrope.errors import FormatError, UnknownNameError
from heliotrope.field.formats._heliok_build import from_plant
from heliotrope.field.formats._tree import Document, Element, read_document, write_document
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target
from heliotrope.geometry import FloatArray, direction, mirror_frame, rotation
from heliotrope.mechanism.drives import direct
from heliotrope.mechanism.kinds import EAST, NORTH, UP, two_axis
from heliotrope.sun import Site

__all__ = [
    "Axis", "Document", "Model", "Placed", "Surface", "from_plant", "heliostats", "models",
    "read", "site", "sun", "surfaces", "to_plant", "write",
]  # fmt: skip
