"""Opens a plant from a file or folder in any supported format."""

from collections.abc import Mapping
from pathlib import Path

from heliotrope.errors import FormatError, InputError, require
from heliotrope.field.formats import heliok, opencsp, solarpilot
from heliotrope.field.plant import Plant
from heliotrope.sun import Site

#: SolarPILOT's own default for the size of a mirror, m.
DEFAULT_MIRROR = 12.2
_TABLES = (".csv", ".txt", ".tsv")


class NoSiteError(FormatError):
    """A file without a site, for which the caller specified none either.

    Parameters
    ----------
    path
        The file.
    problem
        What is missing.
    advice
        How the caller specifies the site.
    """

    def __init__(
        self,
        path: object,
        problem: str,
        advice: str = "specify the site (site=Site(latitude, longitude, height))",
    ) -> None:
        super().__init__(path, f"{problem}, so the sun cannot be computed; {advice}")
        self.missing = problem


def open_plant(
    path: str | Path,
    *,
    site: Site | None = None,
    centroids: str | Path | None = None,
    templates: Mapping[int, solarpilot.Template] | None = None,
) -> Plant:
    """Return the plant from a file or folder, whatever its format.

    Plant files (TOML), folders in PAINT's format, HelioK scenes (XML), SolarPILOT layouts and
    OpenCSP fields (the last two as .csv, .txt or .tsv) are recognised by their names and first
    lines.

    Parameters
    ----------
    path
        The file or folder.
    site
        Reference point of the plant, for formats that do not contain one: SolarPILOT, OpenCSP, and
        HelioK without ``<Location>``. HelioK contains no height; without ``site`` it is 0 m.
    centroids
        OpenCSP's table of facet centroids; without it the facets are placed edge to edge.
    templates
        Dimensions of SolarPILOT's heliostats by template number. A layout does not contain them; by
        default mirrors are 12.2 m × 12.2 m, SolarPILOT's default, and the plant's ``notes`` say so.

    Raises
    ------
    FormatError
        If the file does not exist or cannot be used; the message names file, place, value and
        limit. `NoSiteError` if the file needs a site.
    InputError
        If ``site`` is not a `Site`.
    """
    require("path", path, (str, Path), "the path of a file or folder")
    place = Path(path)
    if not str(path).strip():
        raise InputError("path is empty; pass the path of a file or folder")
    if site is not None:
        require("site", site, Site, "Site(latitude_deg, longitude_deg, height)")
    try:
        return _read(place, site, centroids, templates)
    except FormatError:
        raise
    except InputError as error:
        raise FormatError(place, str(error)) from error


def _read(
    place: Path,
    site: Site | None,
    centroids: str | Path | None,
    templates: Mapping[int, solarpilot.Template] | None,
) -> Plant:
    if place.is_dir():
        # These readers load libraries that other formats do not need.
        from heliotrope.field.formats import paint

        _refuse_unused(place, site=site, centroids=centroids, templates=templates)
        return paint.read_plant(place)
    if not place.exists():
        raise FormatError(place, "no such file; pass a plant file or a folder")
    suffix = place.suffix.lower()
    if suffix == ".xml":
        _refuse_unused(place, centroids=centroids, templates=templates)
        return _of_heliok(place, site)
    if suffix in _TABLES:
        if opencsp.is_field(place):
            _refuse_unused(place, templates=templates)
            table = opencsp.read_field(place)
            known = None if centroids is None else opencsp.read_centroids(centroids)
            return opencsp.to_plant(table, _needed(place, site), known)
        _refuse_unused(place, centroids=centroids)
        return _of_solarpilot(place, _needed(place, site), templates)
    from heliotrope.field.formats import plant_file

    plant = plant_file.read_plant(place)
    _refuse_unused(place, site=site, centroids=centroids, templates=templates)
    return plant


def _of_heliok(place: Path, site: Site | None) -> Plant:
    document = heliok.read(place)
    if site is None and not heliok.has_location(document):
        raise NoSiteError(place, "no <Location> in <World>")
    return heliok.to_plant(document, site or heliok.site(document, 0.0))


def _of_solarpilot(
    place: Path, site: Site, templates: Mapping[int, solarpilot.Template] | None
) -> Plant:
    layout = solarpilot.read_layout(place, site)
    if templates is not None:
        return solarpilot.to_plant(layout, site, templates)
    mirror = solarpilot.Template(DEFAULT_MIRROR, DEFAULT_MIRROR)
    plant = solarpilot.to_plant(layout, site, dict.fromkeys(layout.template.tolist(), mirror))
    size = (
        f"the layout specifies none, so SolarPILOT's default is used: {DEFAULT_MIRROR} m × "
        f"{DEFAULT_MIRROR} m, with the pivot in the mirror; pass templates to change it"
    )
    return plant.with_notes({"size of the mirrors": size})


def _refuse_unused(place: Path, **arguments: object) -> None:
    """Refuse an argument that does not apply to the format of a file."""
    for name, value in arguments.items():
        if value is not None:
            raise FormatError(
                place,
                (f"{name} is specified, but files of this format contain their own; omit it"),
            )


def _needed(place: Path, site: Site | None) -> Site:
    if site is None:
        raise NoSiteError(place, "a table of positions contains no site")
    return site
