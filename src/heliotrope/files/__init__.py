"""Safe reading and writing of files, with errors that name the file and the place in it.

- `limits`: size, depth, count and expansion limits for all readers.
- `kinds`: recognises files that belong to another program or another command.
- `text`: reads whole text and binary files, and writes files completely or not at all.
- `json`, `xml`: documents whose values know their position in the file.
- `documents`: TOML files of our own formats, checked against pydantic models. Its names must be
  imported from there, because pydantic is slow to load.
- `disk`: disk work, executed outside an event loop.
- `archives`: ZIP members and NumPy arrays, whose size is checked before they are expanded.
- `cells`: the only table reader (CSV in common spreadsheet variants, Parquet), cell by cell.
- `times`: times in ISO 8601.

Begin with `read_text` and `write_text`.
"""

from heliotrope.files.cells import (
    Cells,
    Rows,
    alike,
    find_heliostats,
    read_cells,
    read_parquet,
    read_rows,
    rows_of,
    rows_under,
)
from heliotrope.files.json import (
    JsonNode,
    read_json,
)
from heliotrope.files.limits import SIZE_LIMIT, check_file
from heliotrope.files.text import (
    read_bytes,
    read_text,
    write_file,
    write_text,
)
from heliotrope.files.times import format_time, moment, parse_time
from heliotrope.files.xml import Document, XmlElement, read_xml

__all__ = [
    "SIZE_LIMIT",
    "Cells",
    "Document",
    "JsonNode",
    "Rows",
    "XmlElement",
    "alike",
    "check_file",
    "find_heliostats",
    "format_time",
    "moment",
    "parse_time",
    "read_bytes",
    "read_cells",
    "read_json",
    "read_parquet",
    "read_rows",
    "read_text",
    "read_xml",
    "rows_of",
    "rows_under",
    "write_file",
    "write_text",
]
