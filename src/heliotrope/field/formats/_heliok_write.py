"""Builds a HelioK document from a plant."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from heliotrope.errors import InputError
from heliotrope.field.formats._heliok_values import ANGLES
from heliotrope.field.formats.frames import euler_angles, mirror_frame
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target
from heliotrope.files.xml import Document, Element
from heliotrope.geometry import TAU, FloatArray, as_float, normalize
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.drives import SLOTS, Drive
from heliotrope.sun import Site

_VERSION = "2020.2"
#: Names and reflectivities of the two materials that surfaces refer to.
_MIRROR, _ABSORBER = ("mirror", "1.0"), ("absorber", "0.0")


def from_plant(plant: Plant, *, unit_angle: str = "rad") -> Document:
    """Return the HelioK document of a plant.

    Each heliostat is written as its calibrated armature (two axes, a point on each, a
    vertex and its normal) in a node of its own; those that differ in nothing but their
    place share a model. Numbers have as many digits, up to 17, as give the same double
    again. What the format has no place for is left out: drives (angles stand for counts;
    the stops are kept), names of groups and clusters, the site's height and air, markers.
    The mirrors' material is ideal, because a plant does not know their own.

    Parameters
    ----------
    plant
        Mechanisms of any kind with two driven axes. A heliostat without an aim is aimed
        at the first receiver, or else at the first target: the format demands an aim.
    unit_angle
        "rad" loses nothing; with "deg" the last bit may change; "mrad" HelioK itself
        does not know.

    Raises
    ------
    InputError
        If a mechanism has a single axis, a heliostat has nothing to be aimed at, stops
        leave no motion, a receiver is not flat, or the unit is not known.
    """
    if unit_angle not in ANGLES:
        raise InputError(f"unit_angle {unit_angle!r}: give one of {', '.join(ANGLES)}")
    kits: dict[Element, Element] = {}
    nodes = []
    centers = [r.center for r in plant.receivers] + [t.center for t in plant.targets]
    aim = centers[0] if centers else None
    for group, heliostats in plant.groups.items():
        for name, place, kit in _heliostats(group, heliostats, aim, unit_angle):
            model = f"model-{len(kits) + 1}"
            known = kits.setdefault(kit, replace(kit, attributes=(("name", model),)))
            ref = Element("HeliostatKit", (("ref", str(known.get("name"))),))
            nodes.append(Element("Node", (("name", name), *place), (ref,)))
    unit = ANGLES[unit_angle]
    materials = (_material(*material) for material in (_MIRROR, _ABSORBER))
    scene = (
        _branch("Receivers", (_receiver(receiver, unit) for receiver in plant.receivers)),
        _branch("Targets", (_target(target, unit) for target in plant.targets)),
        _branch("Heliostats", nodes),
    )
    units = (("version", _VERSION), ("unitLength", "m"), ("unitAngle", unit_angle))
    return Document(
        Element(
            "HelioK",
            units,
            (
                Element("World", children=(_location(plant.site, unit),)),
                Element("Factory", children=(*materials, *kits.values())),
                Element("Scene", children=scene),
            ),
        )
    )


def _text(values: FloatArray | float) -> str:
    """Return numbers in the shortest text that gives the same doubles again."""
    # Adding 0 turns −0 into 0.
    return ", ".join(repr(float(v) + 0.0) for v in np.atleast_1d(values))


def _location(site: Site, unit: float) -> Element:
    longitude, latitude = np.radians(site.longitude_deg), np.radians(site.latitude_deg)
    return Element(
        "Location",
        (
            ("name", site.name),
            ("longitude", _text(longitude / unit)),
            ("latitude", _text(latitude / unit)),
        ),
    )


def _material(name: str, reflectivity: str) -> Element:
    # HelioK reads the roughness only with a unit behind it.
    return Element(
        "Material", (("name", name), ("reflectivity", reflectivity), ("roughness", "0.0 mrad"))
    )


def _branch(name: str, nodes: Iterable[Element]) -> Element:
    return Element("Node", (("name", name),), tuple(nodes))


def _place(
    position: FloatArray, axes: FloatArray, unit: float
) -> tuple[tuple[str, str], tuple[str, str]]:
    return ("translation", _text(position)), ("rotation", _text(euler_angles(axes) / unit))


def _shape(width: float, height: float, material: str) -> Element:
    return Element(
        "ShapeKit",
        children=(
            Element("ShapeFlat"),
            Element("ApertureRectangular", (("xWidth", _text(width)), ("yWidth", _text(height)))),
            Element("Material", (("ref", material),)),
        ),
    )


def _target(target: Target, unit: float) -> Element:
    axes = np.stack([*target.axes, target.normal], axis=-1)
    shape = _shape(target.width, target.height, _ABSORBER[0])
    return Element("Node", (("name", target.name), *_place(target.center, axes, unit)), (shape,))


def _receiver(receiver: Receiver, unit: float) -> Element:
    if receiver.kind != "planar":
        raise InputError(
            f"receiver {receiver.name}: HelioK has no {receiver.kind}; leave it out of the plant "
            "first"
        )
    axes = mirror_frame(receiver.normal)
    if receiver.corners is not None:
        turned = Target(receiver.name, receiver.corners, receiver.center)
        axes = np.stack([*turned.axes, turned.normal], axis=-1)
    shape = _shape(receiver.width, receiver.height, _ABSORBER[0])
    return Element(
        "Node", (("name", receiver.name), *_place(receiver.center, axes, unit)), (shape,)
    )


def _heliostats(
    group: str, heliostats: Heliostats, default_aim: FloatArray | None, unit_angle: str
) -> Iterator[tuple[str, tuple[tuple[str, str], ...], Element]]:
    """Give name, place and unnamed HeliostatKit of each heliostat of a group."""
    mechanism, unit = heliostats.calibrated, ANGLES[unit_angle]
    if len(mechanism.driven) != 2:
        raise InputError(
            f"group {group}: a {mechanism.kind} mechanism has {len(mechanism.driven)} driven "
            "axis; HelioK needs two"
        )
    # In the heliostat's own frame, so that a place in the field costs no digits.
    own = replace(
        mechanism,
        position=np.zeros_like(mechanism.position),
        orientation=np.broadcast_to(np.eye(3), mechanism.orientation.shape),
    ).armature
    stops = _stops(heliostats.names, mechanism.drives)
    aims = _aims(heliostats, default_aim)
    facets = _facets(heliostats, own)
    for i, name in enumerate(heliostats.names):
        point = own.vertex[i] - own.origin_2[i]
        start = [f"{_text(a / unit)} {unit_angle}" for a in np.clip(0.0, *stops[i].T)]
        first = _axis("Primary", own.origin_1[i], own.axis_1[i], stops[i, 0] / unit)
        between = own.origin_2[i] - own.origin_1[i]
        second = _axis("Secondary", between, own.axis_2[i], stops[i, 1] / unit)
        kit = Element(
            "HeliostatKit",
            children=(
                first,
                second,
                *_facet_elements(facets, i, point, unit),
                Element("Angles", (("primary", start[0]), ("secondary", start[1]))),
                Element("Tracking", (("point", _text(point)), ("normal", _text(own.normal[i])))),
                Element("Aiming", (("point", _text(aims[i])),)),
            ),
        )
        yield name, _place(mechanism.position[i], mechanism.orientation[i], unit), kit


def _axis(tag: str, origin: FloatArray, along: FloatArray, stops: FloatArray) -> Element:
    return Element(
        tag,
        (
            ("translation", _text(origin)),
            ("rotationAxis", _text(along)),
            ("rotationAngles", _text(stops)),
        ),
    )


def _stops(names: tuple[str, ...], drives: Drive) -> FloatArray:
    """Return least and largest angles, rad, (N, 2, 2), of stops in angle and in counts."""
    t = drives.table
    counts = t[..., [SLOTS["min_count"], SLOTS["max_count"]]]
    finite = np.isfinite(counts)
    ends = Drive(t[..., None, :]).angles(np.where(finite, counts, 0.0))
    # Counts may run against the angle; an end that is free has no angle.
    rises = drives.radians_per_count(np.where(finite, counts, 0.0).mean(axis=-1))[..., None] > 0
    ends = np.where(finite, ends, np.where(rises, 1, -1) * [-np.inf, np.inf])
    low = np.maximum(ends.min(axis=-1), t[..., SLOTS["min_angle"]])
    high = np.minimum(ends.max(axis=-1), t[..., SLOTS["max_angle"]])
    # A free axis goes all the way round, in HelioK as half a turn to either side.
    free_low, free_high = np.isinf(low), np.isinf(high)
    least = as_float(np.where(free_low, np.where(free_high, -np.pi, high - TAU), low))
    most = as_float(np.where(free_high, np.where(free_low, np.pi, low + TAU), high))
    stuck = np.argwhere(least >= most)
    if len(stuck):
        i, axis = stuck[0].tolist()
        raise InputError(
            f"heliostat {names[i]}: the stops of its {('primary', 'secondary')[axis]} axis leave "
            f"no motion ({least[i, axis]:g} to {most[i, axis]:g} rad); HelioK needs an interval"
        )
    return np.stack([least, most], axis=-1)


def _aims(heliostats: Heliostats, default: FloatArray | None) -> FloatArray:
    aims = np.full((len(heliostats), 3), np.nan) if heliostats.aim is None else heliostats.aim
    missing = np.asarray(np.isnan(aims).any(axis=-1))
    if missing.any() and default is None:
        name = heliostats.names[int(np.flatnonzero(missing)[0])]
        raise InputError(
            f"heliostat {name}: HelioK needs an aim; give the heliostat one, or the plant a "
            "receiver or a target"
        )
    return np.where(missing[:, None], default if default is not None else np.zeros(3), aims)


def _facets(heliostats: Heliostats, own: Armature) -> Facets:
    """Return the facets in the frame beyond the secondary axis, from the vertex."""
    given = heliostats.facets
    if given is None:
        across, up = np.zeros((2, len(heliostats), 1, 3))
        across[..., 0, 0], up[..., 0, 1] = 0.5 * heliostats.width, 0.5 * heliostats.height
        given = Facets(np.zeros_like(across), across, up)
    frame = mirror_frame(own.normal)
    return Facets(
        *(
            np.einsum("nij,nfj->nfi", frame, vectors)
            for vectors in (given.center, given.half_width, given.half_height)
        )
    )


def _facet_elements(facets: Facets, i: int, point: FloatArray, unit: float) -> Iterator[Element]:
    for center, across, up in zip(
        facets.center[i], facets.half_width[i], facets.half_height[i], strict=True
    ):
        x = normalize(across, "facet")
        z = normalize(np.cross(across, up), "facet")
        axes = np.stack([x, np.cross(z, x), z], axis=-1)
        width, height = 2.0 * np.linalg.norm(across), 2.0 * np.linalg.norm(up)
        shape = _shape(float(width), float(height), _MIRROR[0])
        yield Element("Facet", _place(point + center, axes, unit), (shape,))
