"""A HelioK file that several tests use."""

from pathlib import Path

from heliotrope.field.formats import heliok
from heliotrope.sun import Site

SCENE = Path(__file__).parents[1] / "files" / "heliok-scene.xml"
SITE = Site(34.707, 33.261, 10.0, name="Pentakomo")


def scene() -> heliok.Document:
    return heliok.read(SCENE)


def edited(tmp_path: Path, old: str, new: str) -> Path:
    """Return the scene's file with the first occurrence of a text replaced."""
    text = SCENE.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "scene.xml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return path
