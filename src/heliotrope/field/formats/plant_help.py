"""Help for people who edit a plant file: the keys of each table, from the schema of the file."""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from heliotrope.field.formats.plant_file import json_schema

#: Deepest table.
_DEEPEST = 5


@dataclass(frozen=True)
class HelpKey:
    """A key of a table: what its value is, whether it must be there, and what it means."""

    key: str
    kind: str
    needed: bool
    text: str


@dataclass(frozen=True)
class HelpTable:
    """A table: its dotted name, with ``*`` for a name that the plant chooses, and its keys."""

    table: str
    keys: tuple[HelpKey, ...]


@functools.lru_cache(maxsize=1)
def plant_help() -> tuple[HelpTable, ...]:
    """Return the keys of all tables of a plant file."""
    schema = json_schema()
    known = schema.get("$defs", {})
    return tuple(HelpTable(name, keys) for name, keys in _tables("", schema, known))


def _tables(
    name: str, schema: Mapping[str, Any], known: Mapping[str, Any]
) -> Iterator[tuple[str, tuple[HelpKey, ...]]]:
    """Yield the keys of a table and of all tables in it."""
    if name.count(".") >= _DEEPEST:
        return
    keys: dict[str, HelpKey] = {}
    inner: list[tuple[str, Mapping[str, Any]]] = []
    for kind in _kinds(schema, known):
        for key, value in kind.get("properties", {}).items():
            needed = key in kind.get("required", ())
            words, before = _kind(value, known), keys.get(key)
            if before is not None and before.kind != words:
                words = f"{before.kind} | {words}"
            keys[key] = HelpKey(key, words, needed, _text(value))
            inner.append((f"{name}.{key}".lstrip("."), value))
        if isinstance(more := kind.get("additionalProperties"), Mapping):
            inner.append((f"{name}.*", more))
    if keys:
        yield name, tuple(keys.values())
    for table, value in inner:
        yield from _tables(table, value, known)


def _kinds(schema: Mapping[str, Any], known: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yield the objects that a value, or each value of an array, may be."""
    if "$ref" in schema:
        yield from _kinds(known[schema["$ref"].rpartition("/")[2]], known)
    elif schema.get("type") == "array" and isinstance(schema.get("items"), Mapping):
        yield from _kinds(schema["items"], known)
    elif schema.get("type") == "object":
        yield schema
    for choice in (*schema.get("anyOf", ()), *schema.get("oneOf", ())):
        yield from _kinds(choice, known)


def _kind(schema: Mapping[str, Any], known: Mapping[str, Any]) -> str:
    """Return what a value is, in words."""
    if "$ref" in schema:
        return _kind(known[schema["$ref"].rpartition("/")[2]], known)
    choices = [*schema.get("anyOf", ()), *schema.get("oneOf", ())]
    if choices:
        words = [_kind(choice, known) for choice in choices if choice.get("type") != "null"]
        return " or ".join(dict.fromkeys(words))
    if "enum" in schema:
        return " | ".join(map(str, schema["enum"]))
    if "const" in schema:
        return str(schema["const"])
    if schema.get("type") == "array":
        count, of = schema.get("minItems"), _kind(schema.get("items", {}), known)
        fixed = count is not None and count == schema.get("maxItems")
        return f"{count} × {of}" if fixed else f"list of {of}"
    return f"{schema.get('type', 'value')}{_limits(schema)}"


def _limits(schema: Mapping[str, Any]) -> str:
    signs = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    said = [f"{sign} {_number(schema[key])}" for key, sign in signs.items() if key in schema]
    return f" {', '.join(said)}" if said else ""


def _number(value: float) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:g}"


def _text(schema: Mapping[str, Any]) -> str:
    text, default = str(schema.get("description", "")), schema.get("default")
    if default in (None, "", [], {}):
        return text
    return f"{text} Default: {default}.".strip()
