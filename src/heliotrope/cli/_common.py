"""Functions shared by the commands: conversion of arguments to values, and display of values."""

import json
import math
import re
from collections.abc import Sequence
from datetime import date, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from heliotrope.errors import InputError, TimeError, shown

if TYPE_CHECKING:
    import pandas as pd

    from heliotrope.field.plant import Plant
    from heliotrope.sun import Site


def parse_time(text: str) -> datetime:
    """Return a time with time zone from ISO 8601 text; "now" means the present time."""
    from datetime import UTC

    if text == "now":
        return datetime.now(UTC)
    from heliotrope.files.times import moment

    try:
        time = moment(text)
    except ValueError:
        raise TimeError(
            f"time {text!r} is not ISO 8601; write it as 2026-06-21T12:00:00Z or "
            "2026-06-21T14:00:00+02:00"
        ) from None
    if time.tzinfo is None:
        raise TimeError(
            f"time {text!r} has no time zone; append Z for UTC, or an offset such as +02:00"
        )
    return time


def day_of(time: datetime, site: "Site") -> date:
    """Return the day of a time.

    For a time in UTC it is the site's own day, otherwise the day in the time's zone.
    """
    from heliotrope.sun import solar_day

    return time.date() if time.utcoffset() else solar_day(time, site)


def sunlit(time: datetime, site: "Site", every: str, least: float = 1.0) -> "pd.DatetimeIndex":
    """Return the times of a day with sunlight, at an interval such as "10min".

    The interval must be at least ``least`` s.

    Raises
    ------
    InputError
        If the sun does not rise on that day, or the interval is invalid or too short.
    """
    from heliotrope.sun import daylight

    day = day_of(time, site)
    times = daylight(day, site, every=parse_duration(every, least))
    if not len(times):
        raise InputError(
            f"{site.label}: the sun is below the horizon at every step of {every} on {day}; "
            "choose another day or a shorter interval"
        )
    return times


def parse_duration(text: str, least: float = 1e-3) -> timedelta:
    """Return a duration from a text such as "30s", "5min" or "1h".

    The duration must be from ``least`` s to 1000 h.
    """
    refusal = f"duration {shown(text)}: write it as 30s, 5min or 1h, from {least:g} s to 1000 h"
    match = re.fullmatch(r"\s*(\d[\d.]*)\s*(s|min|m|h)\s*", text, re.ASCII)
    if match is None:
        raise InputError(refusal)
    (number,) = parse_numbers(match[1], refusal)
    length = number * {"s": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}[match[2]]
    if not least <= length <= 3.6e6:
        raise InputError(refusal)
    return timedelta(seconds=length)


def parse_numbers(
    text: str, refusal: str, *, count: int | None = 1, least: float = -1e6, most: float = 1e6
) -> tuple[float, ...]:
    """Return the numbers in a text "A,B,C".

    Raises
    ------
    InputError
        With the line ``refusal``, unless there are ``count`` numbers (None for one or more) between
        ``least`` and ``most``.
    """
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    # NaN is not within any limits.
    if len(values) not in ({count} if count else range(1, 1000)) or not all(
        least <= value <= most for value in values
    ):
        raise InputError(refusal)
    return values


def parse_point(text: str, what: str) -> tuple[float, float, float]:
    """Return three numbers within ± 1e6 from a text "E,N,U"."""
    refusal = f"{what} {shown(text)}: write three numbers in metres as east,north,up"
    east, north, up = parse_numbers(text, refusal, count=3)
    return east, north, up


def parse_sun(text: str) -> tuple[float, float, float]:
    """Return a sun vector from a text "E,N,U"; its length has no meaning, but is not 0."""
    refusal = f"--sun {shown(text)}: write the sun vector as east,north,up, such as 0,-0.6,0.8"
    east, north, up = parse_numbers(text, refusal, count=3)
    if east == north == up == 0.0:
        raise InputError(refusal)
    return east, north, up


def open_plant(path: Path) -> "Plant":
    """Return the plant in a file or folder with a site; for commands without ``--site``."""
    return _opened(path, None, "use a file that contains its site, such as a plant file (TOML)")


def open_field(path: Path, site: str | None) -> "Plant":
    """Return the plant in a file or folder, with the text of ``--site`` if it contains no site."""
    place = None if site is None else parse_site(site)
    return _opened(path, place, "specify --site LATITUDE,LONGITUDE,HEIGHT")


def _opened(path: Path, site: "Site | None", advice: str) -> "Plant":
    from heliotrope.field.formats.opening import NoSiteError, open_plant

    try:
        return open_plant(path, site=site)
    except NoSiteError as error:
        raise NoSiteError(path, error.missing, advice) from None


def parse_site(text: str) -> "Site":
    """Return a site from a text "LATITUDE,LONGITUDE,HEIGHT", in degrees and m."""
    from heliotrope.sun import Site

    refusal = (
        f"site {shown(text)}: write latitude and longitude in degrees and height in m, such as "
        "50.913,6.388,87"
    )
    latitude, longitude, height = parse_numbers(text, refusal, count=3)
    return Site(latitude, longitude, height)


def print_json(value: Any) -> None:
    """Print a JSON document in which NaN and infinity become null."""
    print(json.dumps(plain(value), ensure_ascii=False, indent=1))


def plain(value: Any) -> Any:
    """Return a value that JSON can represent; NaN and infinity become None."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    # Arrays and numbers of NumPy, which need not be imported for this check.
    if type(value).__module__ == "numpy":
        return plain(value.tolist())
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]], title: str = "") -> None:
    """Print a table with the first column aligned left and the other columns right."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, title=title or None, title_justify="left", pad_edge=False)
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if i == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    console = Console()
    if not console.is_terminal:
        # A file or a pipe has no width, and numbers must not be truncated.
        console = Console(width=1000)
    console.print(table)
