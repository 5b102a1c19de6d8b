"""Convert ISO 8601 texts to times, and back."""

import math
import re
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from fractions import Fraction

from heliotrope.errors import InputError, shown

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_TIME = re.compile(
    r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d(?::\d\d(?:[.,](\d+))?)?) ?(Z|[+-]\d\d(?::?\d\d)?)?", re.ASCII
)
_SECOND_60 = re.compile(r"(.*[T ]\d\d:?\d\d:?)60(.*)", re.ASCII | re.DOTALL)


def moment(text: str) -> datetime:
    """Return the time in an ISO 8601 text, without a time zone if the text has none.

    A leap second (23:59:60 UTC on the last day of a month) is treated as the following second, as
    in Unix time.

    Raises
    ------
    ValueError
        If the text is not a time.
    """
    match = _SECOND_60.fullmatch(text.strip())
    if match is None:
        return datetime.fromisoformat(text.strip())
    time = datetime.fromisoformat(f"{match[1]}59{match[2]}") + timedelta(seconds=1)
    after = time if time.tzinfo is None else time.astimezone(UTC)
    if (after.day, after.hour, after.minute, after.second) != (1, 0, 0, 0):
        raise ValueError("second 60 exists only at 23:59 UTC on the last day of a month")
    return time


def parse_time(text: str) -> float:
    """Return the Unix seconds of an ISO 8601 text, as the double nearest to all its digits.

    Raises
    ------
    InputError
        If the text is not a time, or has no time zone.
    """
    match = _TIME.fullmatch(text.strip())
    if match is None:
        raise InputError(
            f"{shown(text)} is not an ISO 8601 time; write it like 2026-06-21T12:00:00Z"
        )
    day, clock, digits, zone = match.groups()
    if zone is None:
        raise InputError(
            f"{text.strip()} has no time zone; append Z if it is UTC, or an offset such as +02:00"
        )
    try:
        whole = (moment(f"{day}T{clock[:8]}{zone}") - _EPOCH) // timedelta(seconds=1)
        return float(whole + (Fraction(int(digits), 10 ** len(digits)) if digits else 0))
    except (ValueError, OverflowError) as error:
        raise InputError(f"{shown(text)} is not a valid time ({error}); correct it") from None


def format_time(seconds: float) -> str:
    """Return Unix seconds as ISO 8601 in UTC, with enough digits to restore the same double.

    Raises
    ------
    InputError
        If the seconds are infinite or outside the years 1 to 9999.
    """
    if math.isnan(seconds):
        return ""
    try:
        whole = math.floor(seconds)
        stamp = (_EPOCH + timedelta(seconds=whole)).replace(tzinfo=None).isoformat()
    except OverflowError:
        raise InputError(f"time {seconds} s since 1970 lies outside the years 1 to 9999") from None
    # repr is the shortest text that yields the same double; its decimals are kept exactly.
    decimals = f"{Decimal(repr(float(seconds))):f}".partition(".")[2].rstrip("0")
    if decimals and seconds < 0.0:
        # Before the epoch the time of day still counts upwards.
        decimals = f"{10 ** len(decimals) - int(decimals):0{len(decimals)}d}"
    return f"{stamp}.{decimals}Z" if decimals else f"{stamp}Z"
