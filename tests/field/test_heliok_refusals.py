"""HelioK files and plants that are refused, and the one line that says so."""

import re
from pathlib import Path

import pytest

from heliotrope.errors import FormatError
from heliotrope.field.formats import heliok
from support.heliok_files import SCENE, SITE, edited

WRONG = [
    ('unitLength="m" ', "", "line 3: <HelioK> has no unitLength; add the attribute"),
    ('unitLength="m"', 'unitLength="inch"', "unitLength 'inch' is not one of m, cm, mm, km"),
    ('unitAngle="deg"', 'unitAngle="gon"', "unitAngle 'gon' is not one of rad, mrad, deg"),
    ("<HelioK ", "<HelioQ ", "not well-formed XML"),
    ('translation="0, 0, 1.5"', "", "<Primary> has no translation; add the attribute"),
    ('translation="0, 0, 1.5"', 'translation=" "', "<Primary> has no translation"),
    ('"0, 0, 1.5"', '"0, 0"', "translation has 2 numbers; it needs 3"),
    ('"0, 0, 1.5"', '"0, 0, nan"', "<Primary> translation: 'nan' is not a finite number"),
    ('"0, 0, 1.5"', '"0, 0, 1e999"', "'1e999' is not a finite number"),
    ('"0, 0, 1.5"', '"0, 0, 1_5"', "'1_5' is not a finite number"),
    ('"0, 0, 1.5"', '"0, 0, 1.5 deg"', "unknown unit 'deg'; known: m, cm, mm, km"),
    ('normal="0, 1, 0"', 'normal="0, 1, 0 m"', "unknown unit 'm'; known: none"),
    ('rotationAxis="0, 0, -1"', 'rotationAxis="0, 0, 0"', "a vector of length 0 has no direction"),
    (
        'rotationAxis="0, 0, -1"',
        'rotationAxis="1, 0, 0"',
        "HeliostatKit AzEl: the two axes enclose 0 mrad",
    ),
    (
        'rotationAngles="-90, 90"',
        'rotationAngles="90, -90"',
        "<Primary> rotationAngles 90° to -90°: the lower stop",
    ),
    ('normal="0, 1, 0"', 'normal="0, 0, 0"', "<Tracking> normal: a vector of length 0"),
    ('normal="0, 1, 0"', 'normal="2, 0, 0"', "the normal is parallel to the secondary axis"),
    (
        '<Aiming point="0, 0, 20"/>',
        "<Tracking/>",
        "<HeliostatKit> AzEl has 2 elements <Tracking>; it needs exactly one",
    ),
    ('xWidth="2.4"', 'xWidth="-2.4"', "must both be above 0, not -2.4 m × 1.8 m"),
    (
        '<Facet rotation="90, 0, 180">',
        "<Facet>",
        "<Facet> rotation: the facet's normal is 90° from the",
    ),
    ('xWidth="2.4"', "", "<ApertureRectangular> has no x; add the attribute"),
    (
        '<ApertureRectangular xWidth="2.4"',
        '<ApertureDisk xWidth="2.4"',
        "has 0 elements <ApertureRectangular>",
    ),
    (
        '<HeliostatKit ref="AzEl"/>',
        '<HeliostatKit ref="AzIl"/>',
        "there is no HeliostatKit 'AzIl'; did you mean AzEl?",
    ),
    (
        '<HeliostatKit ref="AzEl"/>',
        "<HeliostatKit/>",
        "<HeliostatKit> has no ref; add the attribute",
    ),
    ('name="HeliostatB"', 'name="HeliostatA"', "heliostat HeliostatA: the name occurs twice"),
    ('name="HeliostatB"', "", "a heliostat node has no name; name it"),
    ('name="AzEl"', "", "<HeliostatKit> has no name; add the attribute"),
    (
        "</HeliostatKit>\n  </Factory>",
        '</HeliostatKit><HeliostatKit name="AzEl"/></Factory>',
        "HeliostatKit AzEl: the name occurs twice",
    ),
]


@pytest.mark.parametrize(("old", "new", "text"), WRONG)
def test_a_wrong_file_gets_one_line(tmp_path: Path, old: str, new: str, text: str) -> None:
    path = edited(tmp_path, old, new)
    with pytest.raises(FormatError) as error:
        heliok.to_plant(heliok.read(path), SITE)
    assert text in str(error.value)
    assert re.match(re.escape(str(path)) + r": (line \d+: )?\S", str(error.value))
    assert "\n" not in str(error.value)


def test_the_line_is_named(tmp_path: Path) -> None:
    path = edited(tmp_path, 'name="HeliostatB"', 'name="HeliostatA"')
    wrong = [i for i, line in enumerate(path.read_text().splitlines(), 1) if 'ref="AzEl"' in line]
    with pytest.raises(FormatError, match=f"line {wrong[1]}: heliostat HeliostatA"):
        heliok.heliostats(heliok.read(path))


def test_the_world_is_needed_once(tmp_path: Path) -> None:
    path = edited(tmp_path, "</World>", "</World><World/>")
    with pytest.raises(FormatError, match="has 2 elements <World>; it needs exactly one"):
        heliok.sun(heliok.read(path))
    with pytest.raises(FormatError, match="has 0 elements <Location>; it needs exactly one"):
        heliok.site(heliok.read(edited(tmp_path, "<Location", "<Place")), 0.0)


def test_a_mirror_needs_a_facet(tmp_path: Path) -> None:
    text = SCENE.read_text(encoding="utf-8")
    path = tmp_path / "bare.xml"
    path.write_text(re.sub(r"<Facet.*</Facet>", "", text, flags=re.DOTALL), encoding="utf-8")
    with pytest.raises(
        FormatError, match="HeliostatKit AzEl: no <Facet>, so the mirror has no size"
    ):
        heliok.to_plant(heliok.read(path), SITE)


@pytest.mark.parametrize("share", [0.03, 0.3, 0.6, 0.97])
def test_a_truncated_file_is_refused(tmp_path: Path, share: float) -> None:
    whole = SCENE.read_bytes()
    path = tmp_path / "cut.xml"
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(FormatError, match=r"cut\.xml: line \d+: not well-formed XML"):
        heliok.read(path)


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.xml"
    with pytest.raises(FormatError, match="no such file; specify the path of a HelioK file"):
        heliok.read(path)
    with pytest.raises(FormatError, match="this is a folder"):
        heliok.read(tmp_path)
    path.write_bytes(b"")
    with pytest.raises(FormatError, match="the file is empty; expected a HelioK file"):
        heliok.read(path)
    path.write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0")
    with pytest.raises(FormatError, match="this is a photograph, not a HelioK file"):
        heliok.read(path)
    path.write_bytes(b"\x7fELF\0\0\0")
    with pytest.raises(FormatError, match="the file is binary; expected a HelioK file"):
        heliok.read(path)
    path.write_text("<svg/>", encoding="utf-8")
    with pytest.raises(FormatError, match="the root element is <svg>; expected <HelioK>"):
        heliok.read(path)
    (tmp_path / "loop.xml").symlink_to(tmp_path / "loop.xml")
    with pytest.raises(FormatError, match="cannot be read"):
        heliok.read(tmp_path / "loop.xml")


def test_a_huge_file_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "huge.xml"
    with path.open("wb") as stream:
        stream.write(b"<HelioK>")
        stream.truncate(200 * 2**20)
    with pytest.raises(FormatError, match="200 MiB exceed the limit of 64 MiB"):
        heliok.read(path)


BOMB = "".join(
    f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    "content",
    [
        f'<!DOCTYPE HelioK [<!ENTITY a "ha">{BOMB}]><HelioK>&i;</HelioK>',
        f'<!DOCTYPE HelioK [<!ENTITY a "ha">{BOMB}]><HelioK unitLength="&i;"/>',
        '<!DOCTYPE HelioK [<!ENTITY a SYSTEM "file:///etc/hostname">]><HelioK>&a;</HelioK>',
        '<!DOCTYPE HelioK SYSTEM "http://127.0.0.1:9/x.dtd"><HelioK/>',
    ],
)
def test_entities_are_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "bomb.xml"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(FormatError, match=r"document type|not well-formed"):
        heliok.read(path)


def test_nesting_without_end_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "deep.xml"
    path.write_text("<a>" * 100_000, encoding="utf-8")
    with pytest.raises(FormatError, match="nested too deeply: more than 64 levels"):
        heliok.read(path)
