"""Read JSON files, with errors that name the file and the place in it."""

import json
import math
from pathlib import Path
from typing import Any

from heliotrope.errors import FormatError
from heliotrope.files.kinds import instead
from heliotrope.files.limits import check_json
from heliotrope.files.text import read_text


class JsonNode:
    """A value in a JSON document that knows its position.

    Parameters
    ----------
    path
        The file.
    value
        The value.
    where
        Path of keys that leads to the value, "" at the root.
    """

    def __init__(self, path: Path, value: Any, where: str = "") -> None:
        self.path, self.value, self.where = path, value, where

    def fail(self, problem: str) -> FormatError:
        """Return an error that refers to this place."""
        return FormatError(self.path, problem, self.where)

    def has(self, key: str) -> bool:
        """Return whether this is an object with the given key."""
        return isinstance(self.value, dict) and key in self.value

    def __getitem__(self, key: str) -> "JsonNode":
        """Return the value of a key; if it is missing, the error lists the existing keys."""
        if not isinstance(self.value, dict):
            raise self.fail(f"expected an object with {key!r}, found {self.value!r:.60}")
        if key not in self.value:
            present = ", ".join(list(self.value)[:8]) or "nothing"
            raise self.fail(f"{key!r} is missing; there is {present}")
        return JsonNode(self.path, self.value[key], f"{self.where}.{key}" if self.where else key)

    def any_of(self, *keys: str) -> "JsonNode":
        """Return the value of the first key that exists, because formats have renamed keys."""
        for key in keys:
            if self.has(key):
                return self[key]
        return self[keys[0]]

    def items(self) -> list["tuple[str, JsonNode]"]:
        """Return the members of an object."""
        if not isinstance(self.value, dict):
            raise self.fail(f"expected an object, found {self.value!r:.60}")
        return [(key, self[key]) for key in self.value]

    def elements(self) -> list["JsonNode"]:
        """Return the elements of a list."""
        if not isinstance(self.value, list):
            raise self.fail(f"expected a list, found {self.value!r:.60}")
        return [JsonNode(self.path, v, f"{self.where}[{i}]") for i, v in enumerate(self.value)]

    def number(self, low: float = -math.inf, high: float = math.inf) -> float:
        """Return a finite number between limits."""
        value = self.value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.fail(f"expected a number, found {value!r:.60}")
        if not math.isfinite(value) or not low <= value <= high:
            raise self.fail(f"{value} is outside {low:g} to {high:g}")
        return float(value)

    def text(self) -> str:
        """Return a string."""
        if not isinstance(self.value, str):
            raise self.fail(f"expected text, found {self.value!r:.60}")
        return self.value

    def vector(self) -> tuple[float, float, float]:
        """Return three finite numbers."""
        parts = self.elements()
        if len(parts) != 3:
            raise self.fail(f"expected 3 numbers, found {len(parts)}")
        return parts[0].number(), parts[1].number(), parts[2].number()

    def geodetic(self) -> tuple[float, float, float]:
        """Return latitude and longitude in degrees and height in m."""
        parts = self.elements()
        if len(parts) != 3:
            raise self.fail(f"expected latitude, longitude and height, found {len(parts)} values")
        return (
            parts[0].number(-90.0, 90.0),
            parts[1].number(-180.0, 180.0),
            parts[2].number(-500.0, 9000.0),
        )


def read_json(path: str | Path, what: str) -> JsonNode:
    """Return the root of a JSON file.

    Raises
    ------
    FormatError
        If the file is not a readable text file of a plausible size, is not JSON, or exceeds the
        limits of `heliotrope.files.limits`.
    """
    text = read_text(path, what)
    check_json(path, text)
    try:
        return JsonNode(Path(path), json.loads(text))
    except json.JSONDecodeError as error:
        cut = f"not valid JSON ({error.msg}); the file may be cut off"
        other = instead(text[:4096].encode(), what, "JSON")
        raise FormatError(path, other or cut, "" if other else f"line {error.lineno}") from None
    except ValueError as error:
        # Raised for an integer of thousands of digits.
        raise FormatError(path, f"invalid JSON ({str(error)[:80]})") from None
