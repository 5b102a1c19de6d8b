"""Recognise files by name and first bytes, and name the command that reads them."""

import re
from pathlib import Path

#: Files that no command reads: suffixes, first bytes, kind, and what to do.
_FOREIGN: tuple[tuple[str, bytes, str, str], ...] = (
    (
        "",
        rb"version https://git-lfs",
        "a Git LFS pointer instead of the file",
        "fetch the file with `git lfs pull`",
    ),
    (
        ".stinput",
        rb"# SOLTRACE VERSION",
        "a SolTrace project",
        "save its positions as a table id,x,y,z, which `heliotrope track TABLE.csv` reads",
    ),
    (
        ".tnh .tnhpp",
        rb"#Inventor V",
        "a scene of Tonatiuh",
        "save its positions as a table id,x,y,z, which `heliotrope track TABLE.csv` reads",
    ),
    (
        ".xlsx .xlsm .ods .xls",
        rb"PK\x03\x04.{0,4000}?(?:\[Content_Types\]|mimetypeapplication/vnd)|\xd0\xcf\x11\xe0",
        "a workbook",
        "save the sheet as CSV",
    ),
    ("", rb"\s*<(?:!doctype html|html)", "a web page", "download the file itself"),
    (".pdf", rb"%PDF-", "a PDF", "save its numbers as CSV"),
    (".mat", rb"MATLAB \d", "a MATLAB file", "save its numbers as CSV"),
)
#: Files that a different command reads: first bytes, form, kind, and the command.
_OWN: tuple[tuple[bytes, str, str, str], ...] = (
    (
        rb"\s*(?:<\?xml.{0,300}?>\s*)?(?:<!--.{0,2000}?-->\s*)*<HelioK\b",
        "XML",
        "a HelioK scene",
        "`heliotrope track FILE.xml` reads it",
    ),
    (rb"\s*<[?!\w]", "XML", "XML", "`heliotrope track FILE.xml` reads HelioK scenes"),
    (
        rb"\s*(?:\{\s*(?:\"|\})|\[\s*[\[{\"])",
        "JSON",
        "JSON",
        "PAINT's files are read as a folder: `heliotrope track FOLDER`",
    ),
    (
        rb"PAR1",
        "Parquet",
        "a Parquet table",
        'a plant file names its table: heliostats = "field.parquet"',
    ),
    (
        rb"\x89HDF",
        "HDF5",
        "an HDF5 file",
        "for an ARTIST scenario, specify the PAINT folder from which it was made",
    ),
    (
        rb"\x89PNG|\xff\xd8\xff|II\*\x00|MM\x00\*",
        "photograph",
        "a photograph",
        "`heliotrope image FILE --plant PLANT` reads it",
    ),
    (
        rb"(?:[^\n]*\n){0,50}?\s*format *= *\"heliotrope-plant\"",
        "TOML",
        "a plant file",
        "`heliotrope field check FILE.toml` reads it",
    ),
    (
        rb"(?:\s*#[^\n]*\n)*\s*(?=[^\n=]*(?:[,;\t|][^\n=,;\t|]*){2})[^\n=\[\]{}]+(?:\n|$)",
        "table",
        "a table",
        "`heliotrope track TABLE.csv` reads a layout, and a plant file names its own table",
    ),
)


def foreign(path: Path, start: bytes) -> str:
    """Return the kind and the remedy for a file that no reader accepts; "" for other files.

    Parameters
    ----------
    path
        The file.
    start
        The first 4 kB of the file.
    """
    bare = start.removeprefix(b"\xef\xbb\xbf")
    for suffixes, mark, kind, advice in _FOREIGN:
        named = path.suffix and path.suffix.casefold() in suffixes.split()
        if named or re.match(mark, bare, re.DOTALL | re.IGNORECASE):
            return f"this is {kind}; {advice}"
    return ""


def instead(start: bytes, what: str, own: str = "") -> str:
    """Return the kind of a file that is not ``what``, and the command for it; empty if unknown.

    Parameters
    ----------
    start
        The first bytes of the file.
    what
        Kind of file expected, as an error names it.
    own
        The form of ``what``: "JSON", "XML", "TOML" or "table".
    """
    bare = start.removeprefix(b"\xef\xbb\xbf")
    for mark, form, kind, advice in _OWN:
        if re.match(mark, bare, re.DOTALL):
            return "" if form == own else f"this is {kind}, not {what}; {advice}"
    return ""
