"""Heliotrope runs the heliostat field of a solar power tower.

It computes where every heliostat must point, learns the imperfections of each heliostat from
measurements, and corrects them. In a notebook::

    import heliotrope as ht

    plant = ht.open("plant.toml")
    sun = ht.sun.vector("2026-09-02T10:00Z", plant.site)

A name is loaded when it is first used, so the import itself is fast. The names below are the usual
entry points; each package (`heliotrope.mechanism`, `heliotrope.optics`, …) contains more.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from heliotrope import aims as aims
    from heliotrope import geometry as geometry
    from heliotrope import imaging as imaging
    from heliotrope import optics as optics
    from heliotrope import plot as plot
    from heliotrope import sun as sun
    from heliotrope.aims import FluxLimit, SharedErrors
    from heliotrope.aims import plan_aims as aim
    from heliotrope.calibration import (
        Learned,
        Sightings,
        beam_errors,
        calibrate,
        camera_target,
        evaluate,
        join,
        predict,
        read_field_sightings,
        read_sightings,
        split,
        summarise,
        write_report,
        write_sightings,
    )
    from heliotrope.calibration.fit import fit
    from heliotrope.calibration.learn import Forecast as Forecast
    from heliotrope.calibration.learn import compare_models as compare
    from heliotrope.calibration.learn import learn
    from heliotrope.calibration.report import (
        write_artist,
        write_opencsp,
        write_paint,
        write_solarpilot,
    )
    from heliotrope.calibration.sightings import sightings
    from heliotrope.field import (
        Heliostat,
        Heliostats,
        Plant,
        Receiver,
        Target,
        example_plant,
        prototype,
        roughly_installed,
        track_day,
    )
    from heliotrope.field.formats import open_plant as open  # noqa: A004 - used as ht.open
    from heliotrope.field.formats.plant_file import read_plant, write_plant
    from heliotrope.mechanism import (
        Mechanism,
        Tracking,
        direct,
        linear_grigoriev,
        linear_guo,
        linear_paint,
        rotary,
        track,
        track_path,
    )
    from heliotrope.mechanism import kinds as kinds
    from heliotrope.optics import field_flux as flux
    from heliotrope.optics import flux_day, flux_year, image_offsets
    from heliotrope.sun import Site

__version__ = "0.2.0"

#: The module of each name.
_HOMES = {
    "FluxLimit": "heliotrope.aims",
    "Forecast": "heliotrope.calibration.learn",
    "Heliostat": "heliotrope.field",
    "Heliostats": "heliotrope.field",
    "Learned": "heliotrope.calibration",
    "Mechanism": "heliotrope.mechanism",
    "Plant": "heliotrope.field",
    "Receiver": "heliotrope.field",
    "SharedErrors": "heliotrope.aims",
    "Sightings": "heliotrope.calibration",
    "Site": "heliotrope.sun",
    "Target": "heliotrope.field",
    "Tracking": "heliotrope.mechanism",
    "aim": "heliotrope.aims",
    "beam_errors": "heliotrope.calibration",
    "calibrate": "heliotrope.calibration",
    "camera_target": "heliotrope.calibration",
    "compare": "heliotrope.calibration.learn",
    "direct": "heliotrope.mechanism",
    "evaluate": "heliotrope.calibration",
    "example_plant": "heliotrope.field",
    "fit": "heliotrope.calibration.fit",
    "flux": "heliotrope.optics",
    "flux_day": "heliotrope.optics",
    "flux_year": "heliotrope.optics",
    "image_offsets": "heliotrope.optics",
    "join": "heliotrope.calibration",
    "learn": "heliotrope.calibration.learn",
    "linear_grigoriev": "heliotrope.mechanism",
    "linear_guo": "heliotrope.mechanism",
    "linear_paint": "heliotrope.mechanism",
    "open": "heliotrope.field.formats",
    "predict": "heliotrope.calibration",
    "prototype": "heliotrope.field",
    "read_field_sightings": "heliotrope.calibration",
    "read_plant": "heliotrope.field.formats.plant_file",
    "read_sightings": "heliotrope.calibration",
    "rotary": "heliotrope.mechanism",
    "roughly_installed": "heliotrope.field",
    "sightings": "heliotrope.calibration.sightings",
    "split": "heliotrope.calibration",
    "summarise": "heliotrope.calibration",
    "track": "heliotrope.mechanism",
    "track_day": "heliotrope.field",
    "track_path": "heliotrope.mechanism",
    "write_artist": "heliotrope.calibration.report",
    "write_opencsp": "heliotrope.calibration.report",
    "write_paint": "heliotrope.calibration.report",
    "write_solarpilot": "heliotrope.calibration.report",
    "write_plant": "heliotrope.field.formats.plant_file",
    "write_report": "heliotrope.calibration",
    "write_sightings": "heliotrope.calibration",
}
#: Public names that differ from the names in their modules.
_SHORT = {
    "aim": "plan_aims",
    "compare": "compare_models",
    "flux": "field_flux",
    "open": "open_plant",
}
#: Public names that stand for a whole module.
_MODULES = {
    "aims": "heliotrope.aims",
    "geometry": "heliotrope.geometry",
    "imaging": "heliotrope.imaging",
    "kinds": "heliotrope.mechanism.kinds",
    "optics": "heliotrope.optics",
    "plot": "heliotrope.plot",
    "sun": "heliotrope.sun",
}

__all__ = [
    "FluxLimit",
    "Forecast",
    "Heliostat",
    "Heliostats",
    "Learned",
    "Mechanism",
    "Plant",
    "Receiver",
    "SharedErrors",
    "Sightings",
    "Site",
    "Target",
    "Tracking",
    "__version__",
    "aim",
    "aims",
    "beam_errors",
    "calibrate",
    "camera_target",
    "compare",
    "direct",
    "evaluate",
    "example_plant",
    "fit",
    "flux",
    "flux_day",
    "flux_year",
    "geometry",
    "image_offsets",
    "imaging",
    "join",
    "kinds",
    "learn",
    "linear_grigoriev",
    "linear_guo",
    "linear_paint",
    "open",
    "optics",
    "plot",
    "predict",
    "prototype",
    "read_field_sightings",
    "read_plant",
    "read_sightings",
    "rotary",
    "roughly_installed",
    "sightings",
    "split",
    "summarise",
    "sun",
    "track",
    "track_day",
    "track_path",
    "write_artist",
    "write_opencsp",
    "write_paint",
    "write_plant",
    "write_report",
    "write_sightings",
    "write_solarpilot",
]

# `__getattr__` is hidden from type checkers, because it would make them accept every misspelt name.
if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Load a public name when it is first used (PEP 562)."""
        if name in _MODULES:
            found = import_module(_MODULES[name])
        elif name in _HOMES:
            found = getattr(import_module(_HOMES[name]), _SHORT.get(name, name))
        else:
            raise AttributeError(f"module 'heliotrope' has no attribute {name!r}")
        globals()[name] = found
        return found


def __dir__() -> list[str]:
    """Return the public names, loaded or not."""
    return __all__
