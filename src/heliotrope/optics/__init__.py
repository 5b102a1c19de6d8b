"""Light between the sun, the mirrors and the surfaces that they illuminate.

- `sun_shape` and `attenuation`: the sun's radiance profile, and atmospheric attenuation.
- `beam`: the sun's angular radius, the width of a beam and its irradiance along the axis. Every
  other module takes these from `beam`.
- `offsets`: where an imperfect heliostat sends its beam (Malan's error model as a forward model).
- `intercept`: the fraction of a round beam that a disk or a rectangle intercepts.
- `scene`, `surfaces`, `shading` and `receiver_flux`: the flux engine, from mirrors to the flux in
  cells; `rays` is an independent check by ray tracing, and `canting` tilts facets.
- `plant_flux` and `flux_files`: efficiencies and flux of a plant at a sun position, over a day or a
  year, and their files.
- `mirror_image`: the flux of one heliostat on a target, for photographs and their simulation, and
  the shift of its centroid by neighbours that shade and block it.
- `learnt_surface`: the slopes of a mirror, learnt from photographs of its beam.
- `coverage`: the fraction of a grid's cells that polygons cover (import it from this
  module, because the function has the same name).
- `keep_out`: beams that enter keep-out volumes; `glare`: the eye hazard, for information only.

Begin with `image_offsets` for a tracking error, `field_flux` for a plant.
"""

from heliotrope.optics.attenuation import AIR_MODELS, air_loss
from heliotrope.optics.beam import (
    CHI_SQUARE_90,
    NOMINAL_DNI,
    REACH,
    SUN_RADIUS,
    SUN_SIGMA,
    Beams,
    Crossing,
    ExpectedError,
    MirrorOptics,
    beam_sigma,
    beams,
    concentration,
    crossing,
    mean_concentration,
)
from heliotrope.optics.canting import canted
from heliotrope.optics.flux import FluxView
from heliotrope.optics.flux_files import (
    write_heliostats,
    write_map,
    write_netcdf,
    write_sam,
    write_solartherm,
)
from heliotrope.optics.glare import (
    DAYLIGHT,
    Eye,
    Glare,
    GlareMap,
    Hazard,
    glare_at,
    glare_map,
    glare_of_many,
    glare_of_one,
    safe_distance,
    safe_range,
)
from heliotrope.optics.intercept import intercept_circle, intercept_disks, intercept_rectangle
from heliotrope.optics.keep_out import (
    Entries,
    Sweep,
    Way,
    clearance,
    find_entries,
    ground_way,
    safe_way,
    sweep,
)
from heliotrope.optics.learnt_surface import (
    BeamPhotograph,
    LearntSurface,
    beam_accuracy,
    learn_surface,
)
from heliotrope.optics.mirror_image import (
    Beam,
    CentroidShift,
    centroid_shift,
    flat_top_beam,
    gaussian_beam,
    reflected_beam,
)
from heliotrope.optics.mirror_surface import equal_facets
from heliotrope.optics.offsets import ImageOffsets, image_offsets, target_offsets
from heliotrope.optics.plant_flux import (
    EFFICIENCIES,
    FieldOptics,
    FluxTable,
    PlantFlux,
    field_flux,
    flux_day,
    flux_views,
    flux_year,
)
from heliotrope.optics.plant_scene import scene_of
from heliotrope.optics.rays import RayTrace, trace
from heliotrope.optics.receiver_flux import Efficiencies, FieldFlux, Images
from heliotrope.optics.scene import FacetTable, Mirrors, Scene
from heliotrope.optics.shading import Lit, Shading, nearest
from heliotrope.optics.sun_shape import SUN_SHAPES, Gaussians, SunShape, sun_profile
from heliotrope.optics.surfaces import Cavity, Cells, Cylinder, Mesh, Plate, Surface, surface_of

__all__ = [
    "AIR_MODELS",
    "CHI_SQUARE_90",
    "DAYLIGHT",
    "EFFICIENCIES",
    "NOMINAL_DNI",
    "REACH",
    "SUN_RADIUS",
    "SUN_SHAPES",
    "SUN_SIGMA",
    "Beam",
    "BeamPhotograph",
    "Beams",
    "Cavity",
    "Cells",
    "CentroidShift",
    "Crossing",
    "Cylinder",
    "Efficiencies",
    "Entries",
    "ExpectedError",
    "Eye",
    "FacetTable",
    "FieldFlux",
    "FieldOptics",
    "FluxTable",
    "FluxView",
    "Gaussians",
    "Glare",
    "GlareMap",
    "Hazard",
    "ImageOffsets",
    "Images",
    "LearntSurface",
    "Lit",
    "Mesh",
    "MirrorOptics",
    "Mirrors",
    "PlantFlux",
    "Plate",
    "RayTrace",
    "Scene",
    "Shading",
    "SunShape",
    "Surface",
    "Sweep",
    "Way",
    "air_loss",
    "beam_accuracy",
    "beam_sigma",
    "beams",
    "canted",
    "centroid_shift",
    "clearance",
    "concentration",
    "crossing",
    "equal_facets",
    "field_flux",
    "find_entries",
    "flat_top_beam",
    "flux_day",
    "flux_views",
    "flux_year",
    "gaussian_beam",
    "glare_at",
    "glare_map",
    "glare_of_many",
    "glare_of_one",
    "ground_way",
    "image_offsets",
    "intercept_circle",
    "intercept_disks",
    "intercept_rectangle",
    "learn_surface",
    "mean_concentration",
    "nearest",
    "reflected_beam",
    "safe_distance",
    "safe_range",
    "safe_way",
    "scene_of",
    "sun_profile",
    "surface_of",
    "sweep",
    "target_offsets",
    "trace",
    "write_heliostats",
    "write_map",
    "write_netcdf",
    "write_sam",
    "write_solartherm",
]
