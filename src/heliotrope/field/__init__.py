"""Many heliostats, the tower with its targets and receiver, and the cameras that look at them.

`Plant` holds everything: the site, `Heliostats` in groups of one kind of mechanism, `Target`s,
`Receiver`s, `Camera`s and keep-out volumes. `formats` reads and writes plants; `layouts` makes new
ones; `prototype` is an example of 18 heliostats.
"""

from heliotrope.field.camera import (
    Camera,
)
from heliotrope.field.example import (
    board_prototype,
    prototype,
    roughly_installed,
)
from heliotrope.field.heliostats import (
    Facets,
    Heliostats,
)
from heliotrope.field.marks import (
    Mark,
)
from heliotrope.field.plant import (
    Plant,
)
from heliotrope.field.target import (
    Receiver,
    Target,
)
from heliotrope.field.volumes import (
    Box,
    Cylinder,
    Prism,
    Sphere,
    Volume,
    outline,
)

__all__ = [
    "Box",
    "Camera",
    "Cylinder",
    "Facets",
    "Heliostats",
    "Mark",
    "Plant",
    "Prism",
    "Receiver",
    "Sphere",
    "Target",
    "Volume",
    "board_prototype",
    "outline",
    "prototype",
    "roughly_installed",
]
