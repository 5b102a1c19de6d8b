"""Many heliostats, the tower with its targets and receiver, and the cameras that observe them.

`Plant` holds everything: the site, `Heliostats` in groups with one kind of mechanism each,
`Target`s, `Receiver`s, `Camera`s and keep-out volumes. `formats` reads and writes plants, and
`layouts` generates new ones; `example_plant` has 18 heliostats, and `prototype` is Malan's plant.
"""

from heliotrope.field.approval import (
    ApprovalSettings,
)
from heliotrope.field.camera import (
    Camera,
)
from heliotrope.field.coded_visits import (
    JointSettings,
    ReceiverSettings,
)
from heliotrope.field.day import (
    TrackedDay,
    track_day,
)
from heliotrope.field.example import (
    example_plant,
    roughly_installed,
)
from heliotrope.field.heliostat import (
    Heliostat,
)
from heliotrope.field.heliostats import (
    Facets,
    Heliostats,
)
from heliotrope.field.marks import (
    Mark,
)
from heliotrope.field.mirror_surface import (
    Canting,
    FacetGrid,
    MirrorSurface,
)
from heliotrope.field.plant import (
    Plant,
)
from heliotrope.field.stellenbosch import (
    prototype,
)
from heliotrope.field.target import (
    Receiver,
    Target,
)
from heliotrope.field.timetable import (
    TimetableEntry,
)
from heliotrope.field.tower import (
    Tower,
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
    "ApprovalSettings",
    "Box",
    "Camera",
    "Canting",
    "Cylinder",
    "FacetGrid",
    "Facets",
    "Heliostat",
    "Heliostats",
    "JointSettings",
    "Mark",
    "MirrorSurface",
    "Plant",
    "Prism",
    "Receiver",
    "ReceiverSettings",
    "Sphere",
    "Target",
    "TimetableEntry",
    "Tower",
    "TrackedDay",
    "Volume",
    "example_plant",
    "outline",
    "prototype",
    "roughly_installed",
    "track_day",
]
