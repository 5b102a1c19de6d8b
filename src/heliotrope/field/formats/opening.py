"""Opens a plant, whatever file or folder it comes in."""

from pathlib import Path

from heliotrope.errors import FormatError
from heliotrope.field.plant import Plant
from heliotrope.sun import Site


def open_plant(path: str | Path) -> Plant:
    """Return the plant of a TOML file, a HelioK XML file or a folder in PAINT's form.

    Raises
    ------
    FormatError
        If it does not exist or cannot be used; the text names file, place, value and limit.
    """
    # The readers load libraries that an opener of one format does not need.
    from heliotrope.field.formats import heliok, paint, plant_file

    place = Path(path)
    if place.is_dir():
        return paint.read_plant(place)
    if not place.exists():
        raise FormatError(place, "there is no such file; give a plant file or a folder")
    if place.suffix.lower() == ".xml":
        return heliok.to_plant(heliok.read(place), Site(0.0, 0.0, 0.0))
    return plant_file.read_plant(place)
