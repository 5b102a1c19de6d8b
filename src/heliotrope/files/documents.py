"""Read TOML files in our own formats, checked against pydantic models, with plain errors."""

import tomllib
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from heliotrope.errors import FormatError
from heliotrope.files.kinds import instead
from heliotrope.files.limits import TOML_SIZE, check_toml
from heliotrope.files.text import read_text

D = TypeVar("D", bound=BaseModel)


def read_toml(path: str | Path, what: str) -> dict[str, Any]:
    """Return the content of a TOML file; ``what`` is the kind of file that errors name.

    Raises
    ------
    FormatError
        If the file cannot be read, is not TOML, or exceeds the limits of `heliotrope.files.limits`.
    """
    text = read_text(path, what, TOML_SIZE)
    check_toml(path, text)
    try:
        return tomllib.loads(text)
    except ValueError as error:
        # An integer of thousands of digits does not raise a TOMLDecodeError.
        other = instead(text[:4096].encode(), what, "TOML")
        raise FormatError(path, other or f"not valid TOML: {str(error)[:200]}") from None


def read_document(
    path: str | Path, kind: str, model: type[D], tables: Iterable[type[BaseModel]]
) -> D:
    """Return the document in a file that states ``format = "heliotrope-KIND"``.

    Parameters
    ----------
    path
        The file.
    kind
        Kind of document: "plant", "cluster", …
    model
        Model of the whole file.
    tables
        Models whose keys are suggested for an unknown key.

    Raises
    ------
    FormatError
        If anything in the file cannot be used; the text names the file, place, value and limit.
    """
    raw = read_toml(path, f"a {kind} file")
    if raw.get("format") != f"heliotrope-{kind}":
        raise FormatError(
            path,
            (f"format is {raw['format']!r}" if "format" in raw else "format is missing")
            + f'; a {kind} file begins with format = "heliotrope-{kind}" and version = 1',
        )
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        missing, table = _missing(errors)
        first = errors[0]
        where = ".".join(str(part) for part in (table if missing else first["loc"]))
        raise FormatError(path, missing or _explained(first, tables), where) from None


def _missing(errors: Sequence[Any]) -> tuple[str, tuple[Any, ...]]:
    """Return one line about all keys missing in the table of the first error, and that table.

    The line is empty if the first error is of a different kind.
    """
    if errors[0]["type"] != "missing":
        return "", ()
    table = errors[0]["loc"][:-1]
    lacks = [e for e in errors if e["type"] == "missing" and e["loc"][:-1] == table]
    keys = ", ".join(repr(str(error["loc"][-1])) for error in lacks)
    text = f"{keys} are missing; add them" if len(lacks) > 1 else f"{keys} is missing; add it"
    return text, table if len(lacks) > 1 else errors[0]["loc"]


def _explained(error: Any, tables: Iterable[type[BaseModel]]) -> str:
    """Return one line from pydantic's description of an error."""
    key = str(error["loc"][-1]) if error["loc"] else ""
    if error["type"] == "extra_forbidden":
        known = sorted({name for table in tables for name in table.model_fields})
        close = get_close_matches(key, known, n=1)
        return f"{key!r} is not known" + (f"; did you mean {close[0]!r}?" if close else "")
    message = error["msg"][0].lower() + error["msg"][1:]
    return f"{error.get('input')!r:.80}: {message}"
