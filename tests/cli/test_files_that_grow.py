"""Files made to exhaust memory or time: each gets one line and exit code 2, memory bounded."""

import io
import json
import os
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
from tests.cli.test_bad_input import TOML
from tests.support import bounded_reading

from heliotrope.files import limits, read_json, read_rows, read_text

#: Limits of the process that reads, bytes: of its addresses, and of what it ever holds.
ADDRESSES, HELD = 3 * 2**30, 1.5 * 2**30
Maker: TypeAlias = Callable[[Path], object]
_MAIN = ("heliotrope.cli", "main")


def _text(before: str, again: str = "", count: int = 0, after: str = "") -> Maker:
    """Return a maker of a text that holds ``again`` many times; nothing of it is kept here."""
    return lambda path: path.write_text(before + again * count + after, encoding="utf-8")


def _numbered(before: str, again: str, count: int, after: str, between: str = "") -> Maker:
    return lambda path: path.write_text(
        before + between.join(again.format(i) for i in range(count)) + after, encoding="utf-8"
    )


def _npz(path: Path, shape: tuple[int, ...], content: int) -> None:
    """Write a member "slope" of ``content`` zero bytes that claims a shape."""
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("slope.npy", "w", force_zip64=True) as stream,
    ):
        head = io.BytesIO()
        about = {"descr": "<f8", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(head, about)
        stream.write(head.getvalue())
        for _ in range(content // 2**20):
            stream.write(bytes(2**20))


def _kmz(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("wpmz/template.kml", "<kml/>")
        with archive.open("wpmz/waylines.wpml", "w") as stream:
            for _ in range(200):
                stream.write(b"<a/>" * 2**18)


def _lying_kmz(path: Path) -> None:
    """Write an archive whose entry states a thousandth of what its member expands to."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("wpmz/template.kml", "<kml/>")
        archive.writestr("wpmz/waylines.wpml", b"<a/>" * 2**26)
    stated, true = struct.pack("<L", 2**18), struct.pack("<L", 2**28)
    path.write_bytes(path.read_bytes().replace(true, stated))


def _contents(path: Path) -> None:
    """Write an archive that is a table of contents only."""
    with zipfile.ZipFile(path, "w") as archive:
        for i in range(20_000):
            archive.writestr(f"{i}", b"")


def _jpeg(path: Path) -> None:
    start = struct.pack(">2sBBHBHHB", b"\xff\xd8", 0xFF, 0xC0, 17, 8, 65_500, 65_500, 3)
    path.write_bytes(start + b"\1\x22\0\2\x11\1\3\x11\1" + b"\xff\xda\0\2" + b"\xff\xd9")


def _parquet(path: Path) -> None:
    """Write one text of 1 MiB that stands in a million rows."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    count = 1_000_000
    column = pa.DictionaryArray.from_arrays(pa.array(np.zeros(count, np.int32)), ["x" * 2**20])
    pq.write_table(pa.table({"heliostat": column, "name": column}), path)


def _many_cells(path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    zeros = pa.array(np.zeros(5_100_000))
    pq.write_table(pa.table({f"c{i}": zeros for i in range(10)}), path)


#: name, file, how it is made, module and function that read it, further arguments, the line.
GROWN: list[tuple[str, str, Maker, tuple[str, str], list[Any], str]] = [
    ("flat XML of 26 MB", "a.xml", _text("<HelioK>", "<a/>", 6_500_000, "</HelioK>"),
     ("heliotrope.field.formats.heliok", "read"), [],
     "6,500,002 tags exceed the limit of 6,000,000; divide it"),
    ("XML with 900,000 attributes", "a.xml",
     _numbered("<HelioK", ' a{}=""', 900_000, "/>"), _MAIN, [],
     "a tag or a text exceeds the limit of 1,024 KiB; expected a HelioK file"),
    ("nested XML", "a.xml", _text("", "<a>", 30_000), _MAIN, [],
     "line 1: nested too deeply: more than 64 levels; flatten the structure"),
    ("a dotted TOML key of 40 KB", "a.toml", _text(".".join("a" * 20_000) + " = 1\n"), _MAIN, [],
     "line 1: 20,000 parts of a dotted key exceed the limit of 16; use tables of their own"),
    ("dotted quoted TOML keys", "a.toml",
     _text("# a\n" + ".".join(["'a'", '"b"'] * 5_000) + " = 1\n"), _MAIN, [],
     "line 2: 10,000 parts of a dotted key exceed the limit of 16"),
    ("a dotted TOML table", "a.toml", _text('x = """b""""\n[' + ".".join("a" * 20_000) + "]\n"),
     _MAIN, [], "line 2: 20,000 parts of a dotted key"),
    ("nested TOML", "a.toml", _text("a = " + "[" * 20_000 + "]" * 20_000), _MAIN, [],
     "line 1: nested too deeply: more than 64 levels; flatten the structure"),
    ("nested TOML behind strings", "a.toml",
     _text("a = '''[''' # [\nb = ['\"', " + "{a = " * 5_000 + "1" + "}" * 5_000 + "]"), _MAIN, [],
     "line 2: nested too deeply"),
    ("TOML of 4 MB", "a.toml", _numbered("", "[a{}]\n", 400_000, ""), _MAIN, [],
     "3.71 MiB exceed the limit of 2 MiB; this is not a plant file"),
    ("a TOML number of 5,000 digits", "a.toml", _text("a = " + "1" * 5_000), _MAIN, [],
     "not valid TOML: Exceeds the limit (4300 digits)"),
    ("flat JSON of 15 MB", "a.json", _text("[", "[],", 5_000_000, "[]]"),
     ("heliotrope.calibration.report", "read_json"), [],
     "10,000,002 values exceed the limit of 2,000,000; divide the file"),
    ("nested JSON", "a.json", _text("", '["[",', 500_000),
     ("heliotrope.calibration.report", "read_json"), [],
     "line 1: nested too deeply: more than 64 levels"),
    ("a JSON number of 5,000 digits", "a.json", _text("1" * 5_000),
     ("heliotrope.calibration.report", "read_json"), [], "Exceeds the limit (4300 digits)"),
    ("a layout of 4 million rows", "a.csv", _text("name,a\n", "1,\n", 4_000_000),
     ("heliotrope.field.formats.solarpilot", "read_layout"), [],
     "4,000,000 rows exceed the limit of 1,000,000; divide the table"),
    ("a table of 100,000 columns", "a.csv",
     _numbered("", "c{}", 100_000, "\n", ","),
     ("heliotrope.calibration.sighting_table", "read_sightings"), [["A1"]],
     "line 1: 100,000 columns exceed the limit of 1,000"),
    ("short rows under a long header", "a.csv",
     _numbered("", "c{}", 1_000, "\n" + "1\n" * 20_000, ","),
     ("heliotrope.airborne.standing", "read_commands"), [["A1"]],
     "cells exceed the limit of 10,000,000; divide the table"),
    ("cells without end", "a.csv", _text("name,east_m\n", ",", 15_000_000),
     ("heliotrope.field.formats.opencsp", "read_field"), [],
     "15,000,003 cells exceed the limit of 10,000,000; divide the table"),
    ("a text of 1 MiB in a million rows", "a.parquet", _parquet,
     ("heliotrope.calibration.sighting_table", "read_sightings"), [["A1"]], "column"),
    ("Parquet with 51 million cells", "a.parquet", _many_cells,
     ("heliotrope.calibration.sighting_table", "read_sightings"), [["A1"]],
     "51,000,000 cells exceed the limit of 50,000,000; divide it"),
    ("arrays that expand to 320 MiB", "a.npz",
     lambda path: _npz(path, (1, 4_000, 5_000, 2), 320 * 2**20),
     ("heliotrope.field.formats.slopes", "read_slopes"), [1],
     "expand to 320 MiB, above the limit of 256 MiB; expected a slope map: an .npz"),
    ("an array that claims 800 GB", "a.npz", lambda path: _npz(path, (1, 10**5, 10**6, 1), 2**20),
     ("heliotrope.field.formats.slopes", "read_slopes"), [1],
     "slope.npy: not an array written by NumPy (1048576 bytes for shape"),
    ("a KMZ that expands to 200 MiB", "a.kmz", _kmz,
     ("tests.support.waypoint_files", "read_wpml"), [],
     "expand to 200 MiB, above the limit of 4 MiB"),
    ("a flight of two million empty rows", "flight.json",
     _text('{"format": "heliotrope-flight", "version": 1, "rows": [', "{},", 2_000_000, "{}]}"),
     ("heliotrope.calibration.flights", "read_flight"), [],
     "name: Field required"),
    ("a flight of 9 MB", "flight.json", _text('{"rows": [', "{},", 3_000_000, "{}]}"),
     ("heliotrope.calibration.flights", "read_flight"), [], "MiB exceed the limit of 8 MiB"),
    ("a nested flight", "flight.json", _text('{"rows": ', "[", 500_000),
     ("heliotrope.calibration.flights", "read_flight"), [], "recursion limit exceeded"),
    ("a KMZ that lies about its size", "a.kmz", _lying_kmz,
     ("tests.support.waypoint_files", "read_wpml"), [], "not a readable archive (Bad CRC-32"),
    ("an archive of 20,000 members", "a.npz", _contents,
     ("heliotrope.field.formats.slopes", "read_slopes"), [1],
     "its table of contents exceeds the limit of 128 KiB"),
    ("a photograph of 4 Gpx", "a.jpg", _jpeg,
     ("heliotrope.airborne.evaluate.detection", "decode"), [],
     "4,290,250,000 pixels exceed the limit of 160,000,000"),
    ("a pipe that nobody writes", "a.toml", os.mkfifo, _MAIN, [],
     "this is a device or a pipe; specify a file"),
    ("a device without an end", "a.npz", lambda path: path.symlink_to("/dev/zero"),
     ("heliotrope.field.formats.slopes", "read_slopes"), [1], "this is a device or a pipe"),
]  # fmt: skip


@pytest.fixture(scope="module")
def endings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """How each reading ended, in one process with bounded memory."""
    place = tmp_path_factory.mktemp("grown")
    readings = []
    for number, (name, file, make, (module, function), more, _) in enumerate(GROWN):
        path = place / str(number) / file
        path.parent.mkdir()
        make(path)
        own = (
            ["track", str(path), "--heliostat", "A1"] if module == _MAIN[0] else [str(path), *more]
        )
        readings.append([name, module, function, own])
    answer = subprocess.run(
        [sys.executable, bounded_reading.__file__, str(ADDRESSES)],
        input=json.dumps(readings), capture_output=True, text=True, check=False, timeout=600,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    found = [json.loads(line) for line in answer.stdout.splitlines()]
    return {one["name"]: one for one in found}


@pytest.mark.parametrize(("name", "says"), [(r[0], r[5]) for r in GROWN], ids=[r[0] for r in GROWN])
def test_a_file_that_grows_is_refused(
    name: str, says: str, endings: dict[str, dict[str, Any]]
) -> None:
    assert name in endings, "the process that reads was ended"
    ending = endings[name]
    assert says in ending["text"], ending["text"]
    assert ending["code"] == 2
    assert len(ending["text"].strip().splitlines()) == 1
    assert ending["most"] < HELD


def test_a_plants_table_is_bounded(tmp_path: Path) -> None:
    from heliotrope.errors import FormatError
    from heliotrope.field.formats.plant_file import read_plant

    (tmp_path / "plant.toml").write_text(TOML)
    (tmp_path / "field.csv").write_text("name,group,east_m\n" + "1\n" * (limits.ROWS + 1))
    with pytest.raises(FormatError, match="1,000,001 rows exceed the limit of 1,000,000"):
        read_plant(tmp_path / "plant.toml")


def test_files_at_the_limits_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("[" * limits.DEPTH + '"[[{"' + "]" * limits.DEPTH)
    assert read_json(path, "a document").elements()[0].elements()
    table = tmp_path / "a.csv"
    table.write_text(",".join(f"c{i}" for i in range(limits.COLUMNS)) + "\n")
    assert len(read_rows(table, "a table").columns) == limits.COLUMNS
    from heliotrope.files.documents import read_toml

    document = tmp_path / "a.toml"
    document.write_text(
        ".".join("a" * limits.DOTTED_PARTS) + ' = "' + "b." * 40 + '" # ' + "c." * 40 + "\n"
        "d = " + "[" * limits.DEPTH + "1.5" + "]" * limits.DEPTH
    )
    assert read_toml(document, "a document").keys() == {"a", "d"}


def test_lines_end_as_python_reads_them(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes("\ufeffä\r\nb\rc\n".encode())
    assert read_text(path, "a text") == "ä\nb\nc\n"
