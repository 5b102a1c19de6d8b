"""Heliotrope runs the heliostat field of a solar power tower.

It computes where every mirror must point, learns each mirror's imperfections from measurements,
and corrects them. In a notebook::

    import heliotrope as ht

    plant = ht.open_plant("plant.toml")
    sun = ht.sun.vector("2026-09-02T10:00Z", plant.site)

A name is loaded when it is first used, so the import itself is light. The names below are the
usual way in; each package (`heliotrope.mechanism`, `heliotrope.optics`, …) has more.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from heliotrope import geometry as geometry
    from heliotrope import optics as optics
    from heliotrope import sun as sun
    from heliotrope.calibration.evaluation import beam_errors, split, summarise
    from heliotrope.calibration.fit.estimator import fit
    from heliotrope.calibration.learn.learning import Learned, learn, predict
    from heliotrope.calibration.sighting_table import read_sightings, write_sightings
    from heliotrope.calibration.sightings import Sightings, camera_target, sightings
    from heliotrope.calibration.workflow import evaluate
    from heliotrope.field import Heliostats, Plant, Receiver, Target, prototype, roughly_installed
    from heliotrope.field.formats import open_plant
    from heliotrope.field.formats.plant_file import read_plant, write_plant
    from heliotrope.mechanism import Mechanism, Tracking, track
    from heliotrope.mechanism import kinds as kinds
    from heliotrope.optics import image_offsets, predict_flux
    from heliotrope.sun import Site

__version__ = "0.1.0"

#: Where each name is: a module, and a name in it if it differs.
_HOMES = {
    "Heliostats": "heliotrope.field",
    "Learned": "heliotrope.calibration.learn.learning",
    "Mechanism": "heliotrope.mechanism",
    "Plant": "heliotrope.field",
    "Receiver": "heliotrope.field",
    "Sightings": "heliotrope.calibration.sightings",
    "Site": "heliotrope.sun",
    "Target": "heliotrope.field",
    "Tracking": "heliotrope.mechanism",
    "beam_errors": "heliotrope.calibration.evaluation",
    "camera_target": "heliotrope.calibration.sightings",
    "evaluate": "heliotrope.calibration.workflow",
    "fit": "heliotrope.calibration.fit.estimator",
    "image_offsets": "heliotrope.optics",
    "learn": "heliotrope.calibration.learn.learning",
    "open_plant": "heliotrope.field.formats",
    "predict": "heliotrope.calibration.learn.learning",
    "predict_flux": "heliotrope.optics",
    "prototype": "heliotrope.field",
    "read_plant": "heliotrope.field.formats.plant_file",
    "read_sightings": "heliotrope.calibration.sighting_table",
    "roughly_installed": "heliotrope.field",
    "sightings": "heliotrope.calibration.sightings",
    "split": "heliotrope.calibration.evaluation",
    "summarise": "heliotrope.calibration.evaluation",
    "track": "heliotrope.mechanism",
    "write_plant": "heliotrope.field.formats.plant_file",
    "write_sightings": "heliotrope.calibration.sighting_table",
}
#: Modules that are used as such.
_MODULES = {
    "geometry": "heliotrope.geometry",
    "kinds": "heliotrope.mechanism.kinds",
    "optics": "heliotrope.optics",
    "sun": "heliotrope.sun",
}

__all__ = [
    "Heliostats",
    "Learned",
    "Mechanism",
    "Plant",
    "Receiver",
    "Sightings",
    "Site",
    "Target",
    "Tracking",
    "__version__",
    "beam_errors",
    "camera_target",
    "evaluate",
    "fit",
    "geometry",
    "image_offsets",
    "kinds",
    "learn",
    "open_plant",
    "optics",
    "predict",
    "predict_flux",
    "prototype",
    "read_plant",
    "read_sightings",
    "roughly_installed",
    "sightings",
    "split",
    "summarise",
    "sun",
    "track",
    "write_plant",
    "write_sightings",
]

# Hidden from type checkers, for which every misspelt name would otherwise be there.
if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Load a public name when it is first used (PEP 562)."""
        if name in _MODULES:
            found = import_module(_MODULES[name])
        elif name in _HOMES:
            module, _, own = _HOMES[name].partition(":")
            found = getattr(import_module(module), own or name)
        else:
            raise AttributeError(f"module 'heliotrope' has no attribute {name!r}")
        globals()[name] = found
        return found


def __dir__() -> list[str]:
    """Return the public names, loaded or not."""
    return __all__
