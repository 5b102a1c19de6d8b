"""HelioK XML: heliostats with arbitrary axes, nested nodes and facets (Grigoriev et al. 2021).

`read` returns the file as a tree of elements with unchanged attributes. The functions below
interpret the tree::

    HelioK   version, unitLength, unitAngle
      World    Location (name, longitude, latitude); Sun (azimuth, elevation, irradiance)
      Factory  Material; HeliostatKit (name): Primary, Secondary (translation,
               rotationAxis, rotationAngles = stops), Facet (translation, rotation;
               ShapeKit), Angles, Tracking (point, normal), Aiming (point)
               without Secondary: a single-axis tracker
      Scene    Node (name, translation, rotation), nested; in it ShapeKit or HeliostatKit ref

The frame is ENU; the sun's azimuth is clockwise from north. For global aiming ``Aiming`` is a point
in ENU; for local aiming the same element contains a point in the heliostat frame, and the file does
not state which of the two applies. A rotation is specified by three Euler angles about the fixed
axes x, then y, then z: R = Rz·Ry·Rx. A mirror or any other surface lies in the x-y plane of its own
frame, with its normal along z.

A number may be followed by a space and its own unit ("1.000 mrad"). HelioK itself reads ``Angles``
without a unit as radians, drops their last digit, and ignores ``unitLength``; in this module the
units of the root element apply to all numbers.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from heliotrope.errors import FormatError, InputError, UnknownNameError
from heliotrope.field.formats._heliok_values import Values
from heliotrope.field.formats.frames import euler_matrix, mirror_frame
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target
from heliotrope.files import Document, XmlElement, read_xml
from heliotrope.geometry import FloatArray, angle_between, as_float, direction, normalize
from heliotrope.mechanism.armature import check_axes
from heliotrope.mechanism.drives import Drive, direct
from heliotrope.mechanism.kinds import single_axis, two_axis
from heliotrope.sun import Site

__all__ = [
    "Document",
    "DrivenAxis",
    "Model",
    "PlacedModel",
    "PlacedSurface",
    "Surface",
    "XmlElement",
    "has_location",
    "heliostats",
    "models",
    "read",
    "site",
    "sun",
    "surfaces",
    "to_plant",
]

_LEANS = ("east", "north", "up")
#: Angle between normal and secondary axis below which the axis does not rotate the normal, rad.
ALONG_LIMIT = 1e-6
#: Angle between a facet and the mirror's normal above which it is a mistake, not canting, rad.
FACET_LIMIT_DEG = 60.0


@dataclass(frozen=True, eq=False)
class DrivenAxis:
    """A driven axis of a heliostat.

    Attributes
    ----------
    origin
        Point on the axis in the parent frame, m, (3,).
    direction
        Unit vector in the parent frame, (3,).
    stops
        Minimum and maximum angle, rad, (2,).
    """

    origin: FloatArray
    direction: FloatArray
    stops: FloatArray


@dataclass(frozen=True, eq=False)
class Surface:
    """A rectangular mirror or other surface.

    Attributes
    ----------
    center
        Centre of the rectangle in the parent frame, m, (3,).
    axes
        Columns x (width), y (height) and z (normal) in the parent frame, (3, 3).
    width, height
        m.
    """

    center: FloatArray
    axes: FloatArray
    width: float
    height: float


@dataclass(frozen=True, eq=False)
class Model:
    """A heliostat model of the factory, to which nodes of the scene refer.

    Attributes
    ----------
    name
        Unique name.
    primary, secondary
        The driven axes; ``secondary`` is None for a single-axis tracker.
    facets
        Facets in the frame beyond the last axis.
    angles
        Angle of each axis at the start, rad, (2,) or (1,).
    point, normal
        Vertex (m) and unit normal that tracking uses, beyond the last axis, (3,).
    aim
        Aim point in metres, ENU (global aiming) or in the heliostat frame at zero angles (local
        aiming), (3,); None if the file does not specify one.
    """

    name: str
    primary: DrivenAxis
    secondary: DrivenAxis | None
    facets: tuple[Surface, ...]
    angles: FloatArray
    point: FloatArray
    normal: FloatArray
    aim: FloatArray | None

    @property
    def axes(self) -> tuple[DrivenAxis, ...]:
        """The driven axes from the ground to the mirror, one or two."""
        return (self.primary,) if self.secondary is None else (self.primary, self.secondary)


@dataclass(frozen=True, eq=False)
class PlacedModel:
    """A heliostat of the scene.

    Attributes
    ----------
    name
        Name of the heliostat's node.
    model
        Model of the heliostat.
    position
        ENU metres, (3,).
    orientation
        Rotation from the heliostat frame to ENU, (3, 3).
    """

    name: str
    model: Model
    position: FloatArray
    orientation: FloatArray


@dataclass(frozen=True, eq=False)
class PlacedSurface:
    """A surface of the scene that does not belong to a heliostat.

    Attributes
    ----------
    path
        Names of the nodes that contain it, from the outermost to its own.
    surface
        The surface, in ENU, m.
    """

    path: tuple[str, ...]
    surface: Surface


def read(path: str | Path) -> Document:
    """Read a HelioK file.

    Raises
    ------
    FormatError
        If the file cannot be read, is not well-formed, defines entities, is not a HelioK file or
        specifies no units.
    """
    document = read_xml(path, "a HelioK file")
    Values(document)
    return document


def models(document: Document) -> dict[str, Model]:
    """Return the heliostat models of the factory by name.

    Raises
    ------
    FormatError
        If a name occurs twice, or an element or a number is missing or wrong.
    """
    values = Values(document)
    by_name: dict[str, Model] = {}
    for factory in document.root.elements("Factory"):
        for element in factory.elements("HeliostatKit"):
            name = values.text(element, "name")
            if name in by_name:
                raise values.error(element, f"HeliostatKit {name}: the name occurs twice")
            by_name[name] = _model(values, element, name)
    return by_name


def _model(values: Values, element: XmlElement, name: str) -> Model:
    tracking = values.child(element, "Tracking")
    angles = values.child(element, "Angles")
    aiming = list(element.elements("Aiming"))
    normal = values.ratios(tracking, "normal", 3)
    if not normal.any():
        raise values.error(tracking, "<Tracking> normal: a vector of length 0 has no direction")
    primary = _axis(values, values.child(element, "Primary"))
    parts, last, secondary = ["primary"], primary, None
    if any(True for _ in element.elements("Secondary")):
        secondary = last = _axis(values, values.child(element, "Secondary"))
        parts.append("secondary")
        try:
            check_axes(primary.direction, secondary.direction)
        except InputError as error:
            raise values.error(element, f"HeliostatKit {name}: {error}") from None
    normal = normalize(normal)
    if np.linalg.norm(np.cross(normal, last.direction)) < ALONG_LIMIT:
        raise values.error(
            tracking,
            f"HeliostatKit {name}: the normal is parallel to the {parts[-1]} axis, so rotation "
            "about this axis would not change it",
        )
    return Model(
        name=name,
        primary=primary,
        secondary=secondary,
        facets=tuple(_facet(values, facet, normal) for facet in element.elements("Facet")),
        angles=np.concatenate([values.angles(angles, part, 1) for part in parts]),
        point=values.lengths(tracking, "point", 3),
        normal=normal,
        aim=values.lengths(aiming[0], "point", 3) if aiming else None,
    )


def _axis(values: Values, element: XmlElement) -> DrivenAxis:
    along = values.ratios(element, "rotationAxis", 3)
    if not along.any():
        raise values.error(
            element, f"<{element.tag}> rotationAxis: a vector of length 0 has no direction"
        )
    stops = values.angles(element, "rotationAngles", 2)
    if stops[0] >= stops[1]:
        raise values.error(
            element,
            f"<{element.tag}> rotationAngles {np.degrees(stops[0]):g}° to "
            f"{np.degrees(stops[1]):g}°: the lower stop must come first; swap them",
        )
    return DrivenAxis(values.lengths(element, "translation", 3), normalize(along), stops)


def _facet(values: Values, element: XmlElement, normal: FloatArray) -> Surface:
    center, axes = _place(values, element)
    away = np.degrees(angle_between(axes[:, 2], normal))
    if away > FACET_LIMIT_DEG:
        raise values.error(
            element,
            f"<Facet> rotation: the facet's normal is {away:.0f}° from the <Tracking> normal, "
            f"above the limit of {FACET_LIMIT_DEG:g}°; correct the rotation",
        )
    return _surface(values, values.child(element, "ShapeKit"), center, axes)


def _surface(values: Values, kit: XmlElement, origin: FloatArray, axes: FloatArray) -> Surface:
    aperture = values.child(kit, "ApertureRectangular")
    if aperture.get("xWidth") is not None:
        width = float(values.lengths(aperture, "xWidth", 1)[0])
        height = float(values.lengths(aperture, "yWidth", 1)[0])
        middle = np.zeros(3)
    else:
        x, y = values.lengths(aperture, "x", 2), values.lengths(aperture, "y", 2)
        width, height = float(x[1] - x[0]), float(y[1] - y[0])
        middle = np.array([x.mean(), y.mean(), 0.0])
    if width <= 0.0 or height <= 0.0:
        raise values.error(
            aperture,
            f"<ApertureRectangular>: width and height must both be above 0, not {width:g} m × "
            f"{height:g} m",
        )
    return Surface(origin + axes @ middle, axes, width, height)


def _place(values: Values, element: XmlElement) -> tuple[FloatArray, FloatArray]:
    """Return the translation and the rotation of a node or facet; both may be missing."""
    moved, turned = np.zeros(3), np.eye(3)
    if element.get("translation") is not None:
        moved = values.lengths(element, "translation", 3)
    if element.get("rotation") is not None:
        turned = euler_matrix(values.angles(element, "rotation", 3))
    return moved, turned


@dataclass(frozen=True, eq=False)
class _Kit:
    """A HeliostatKit or ShapeKit of the scene with the combined transformation of its nodes."""

    element: XmlElement
    path: tuple[str, ...]
    position: FloatArray = field(default_factory=lambda: np.zeros(3))
    axes: FloatArray = field(default_factory=lambda: np.eye(3))


def _kits(values: Values, node: XmlElement, place: _Kit) -> Iterator[_Kit]:
    for child in node.elements():
        if child.tag == "Node":
            moved, turned = _place(values, child)
            yield from _kits(
                values,
                child,
                _Kit(
                    child,
                    (*place.path, child.get("name") or ""),
                    place.position + place.axes @ moved,
                    place.axes @ turned,
                ),
            )
        elif child.tag in {"HeliostatKit", "ShapeKit"}:
            yield _Kit(child, place.path, place.position, place.axes)


def _scene(document: Document, values: Values, tag: str) -> Iterator[_Kit]:
    for scene in document.root.elements("Scene"):
        for kit in _kits(values, scene, _Kit(scene, ())):
            if kit.element.tag == tag:
                yield kit


def heliostats(document: Document) -> list[PlacedModel]:
    """Return the heliostats of the scene, in the order of the file.

    Raises
    ------
    FormatError
        As for `models`, or if a node has no name, a name occurs twice or a model is unknown.
    """
    values, known = Values(document), models(document)
    by_name: dict[str, PlacedModel] = {}
    for kit in _scene(document, values, "HeliostatKit"):
        name = kit.path[-1] if kit.path else ""
        if not name:
            raise values.error(kit.element, "a heliostat node has no name; name it")
        if name in by_name:
            raise values.error(
                kit.element, f"heliostat {name}: the name occurs twice; each name must be unique"
            )
        ref = values.text(kit.element, "ref")
        if ref not in known:
            raise values.error(kit.element, str(UnknownNameError("HeliostatKit", ref, known)))
        by_name[name] = PlacedModel(name, known[ref], kit.position, kit.axes)
    return list(by_name.values())


def surfaces(document: Document) -> list[PlacedSurface]:
    """Return the surfaces of the scene (receivers, targets), in the order of the file.

    Raises
    ------
    FormatError
        If an aperture is not rectangular or a number is missing or wrong.
    """
    values = Values(document)
    return [
        PlacedSurface(kit.path, _surface(values, kit.element, kit.position, kit.axes))
        for kit in _scene(document, values, "ShapeKit")
    ]


def has_location(document: Document) -> bool:
    """Return whether the document specifies a location on Earth, as `site` needs."""
    return any(True for w in document.root.elements("World") for _ in w.elements("Location"))


def site(document: Document, height: float) -> Site:
    """Return the site in ``Location``, at ``height`` m, which the file does not contain.

    Raises
    ------
    FormatError
        If there is no location.
    """
    values = Values(document)
    location = values.child(values.child(document.root, "World"), "Location")
    longitude, latitude = (values.angles(location, n, 1)[0] for n in ("longitude", "latitude"))
    return Site(
        float(np.degrees(latitude)),
        float(np.degrees(longitude)),
        height,
        name=location.get("name") or "",
    )


def sun(document: Document) -> FloatArray:
    """Return the unit vector to the document's sun, ENU, (3,).

    Raises
    ------
    FormatError
        If there is no sun.
    """
    values = Values(document)
    element = values.child(values.child(document.root, "World"), "Sun")
    azimuth, elevation = (values.angles(element, n, 1)[0] for n in ("azimuth", "elevation"))
    return direction(azimuth, elevation)


def to_plant(document: Document, site: Site) -> Plant:
    """Return the plant that a document describes.

    Heliostats become mechanisms of kind "two_axis", or "single_axis" if they have no secondary
    axis, with angles as counts. Heliostats of the same kind with parallel primary axes and the same
    number of facets share a group. Surfaces below a node named "Targets" become targets, all others
    receivers. Materials, curved shapes, the sun and starting angles are not part of a plant and
    stay in the document.

    Parameters
    ----------
    document
        From `read`.
    site
        Reference point of the plant; see `site`.

    Raises
    ------
    FormatError
        As for `heliostats` and `surfaces`, or if a mirror has no facet, axes are parallel or a name
        occurs twice.
    """
    path = document.path or "HelioK document"
    members: dict[tuple[int, int, int], list[PlacedModel]] = {}
    for placed in heliostats(document):
        model = placed.model
        if not model.facets:
            raise FormatError(
                path,
                f"HeliostatKit {model.name}: no <Facet>, so the mirror has no size; add a <Facet>",
            )
        upright = int(np.argmax(np.abs(model.primary.direction)))
        key = (upright, len(model.facets), len(model.axes))
        members.setdefault(key, []).append(placed)
    numbered = len(members) > 1
    groups = {
        f"heliostats-{k}" if numbered else "heliostats": _group(same, upright)
        for k, ((upright, *_), same) in enumerate(members.items(), start=1)
    }
    targets: list[Target] = []
    receivers: list[Receiver] = []
    for placed_surface, name in _named(surfaces(document)):
        if "Targets" in placed_surface.path[:-1]:
            targets.append(_target(placed_surface.surface, name))
        else:
            receivers.append(_receiver(placed_surface.surface, name))
    return Plant(site.name, site, groups, tuple(targets), tuple(receivers))


def _named(placed: list[PlacedSurface]) -> Iterator[tuple[PlacedSurface, str]]:
    """Name each surface uniquely, because a node may contain several surfaces or have no name."""
    taken: set[str] = set()
    for surface in placed:
        base = name = (surface.path[-1] if surface.path else "") or "surface"
        count = 1
        while name in taken:
            count += 1
            name = f"{base}-{count}"
        taken.add(name)
        yield surface, name


def _corners(surface: Surface) -> FloatArray:
    """Return the upper left, upper right, lower right and lower left corners, m, (4, 3)."""
    across = 0.5 * surface.width * surface.axes[:, 0]
    up = 0.5 * surface.height * surface.axes[:, 1]
    corners = np.array([up - across, up + across, across - up, -across - up])
    return as_float(surface.center + corners)


def _target(surface: Surface, name: str) -> Target:
    return Target(name, _corners(surface), surface.center)


def _receiver(surface: Surface, name: str) -> Receiver:
    return Receiver(
        name,
        "planar",
        surface.center,
        surface.axes[:, 2],
        surface.width,
        surface.height,
        _corners(surface),
    )


def _group(placed: list[PlacedModel], upright: int) -> Heliostats:
    """Return the group of heliostats whose primary axes lie nearest to axis ``upright``.

    The axis belongs to the heliostat frame.
    """
    models_ = [heliostat.model for heliostat in placed]
    normal, point = np.array([m.normal for m in models_]), np.array([m.point for m in models_])
    first, second = (name for k, name in enumerate(_LEANS) if k != upright)
    position = np.array([heliostat.position for heliostat in placed])
    orientation = np.array([heliostat.orientation for heliostat in placed])
    axes = list(zip(*(m.axes for m in models_), strict=True))
    along = [np.array([axis.direction for axis in joint]) for joint in axes]
    origin = [np.array([axis.origin for axis in joint]) for joint in axes]
    drives = [_drive(joint) for joint in axes]
    if len(axes) == 1:
        mechanism = single_axis(
            position,
            along[0],
            normal,
            leans=(first, second),
            origin=origin[0],
            vertex=point,
            orientation=orientation,
            drives=(drives[0],),
        )
    else:
        mechanism = two_axis(
            position,
            along[0],
            along[1],
            normal,
            leans=(first, second),
            origin_1=origin[0],
            origin_2=origin[1],
            vertex=point,
            orientation=orientation,
            drives=(drives[0], drives[1]),
        )
    facets = _facets(models_, mirror_frame(normal), point)
    corners = facets.center[:, :, None] + np.stack(
        [a * facets.half_width + b * facets.half_height for a in (-1, 1) for b in (-1, 1)], axis=2
    )
    size = np.ptp(corners.reshape(len(placed), -1, 3), axis=1)
    aims = [np.full(3, np.nan) if m.aim is None else m.aim for m in models_]
    return Heliostats(
        names=tuple(heliostat.name for heliostat in placed),
        mechanism=mechanism,
        width=size[:, 0],
        height=size[:, 1],
        facets=facets,
        aim=None if np.isnan(aims).all() else np.array(aims),
    )


def _drive(axes: tuple[DrivenAxis, ...]) -> Drive:
    """Return drives whose counts are radians: one drive per axis, with the stops of the axis."""
    stops = np.array([axis.stops for axis in axes])
    drives = Drive(np.tile(direct().table, (len(axes), 1)))
    return drives.replace(min_angle=stops[:, 0], max_angle=stops[:, 1])


def _facets(models_: list[Model], frame: FloatArray, point: FloatArray) -> Facets:
    def turned(vectors: FloatArray) -> FloatArray:
        return as_float(np.einsum("nji,nfj->nfi", frame, vectors))

    center = np.array([[f.center for f in m.facets] for m in models_]) - point[:, None]
    axes = np.array([[f.axes for f in m.facets] for m in models_])
    half = 0.5 * np.array([[(f.width, f.height) for f in m.facets] for m in models_])
    return Facets(
        turned(center),
        turned(half[..., :1] * axes[..., 0]),
        turned(half[..., 1:] * axes[..., 1]),
    )
