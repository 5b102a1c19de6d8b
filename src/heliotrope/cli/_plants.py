"""The plant that a command works on: a plant file, the default plant, or the prototype."""

from pathlib import Path
from typing import TYPE_CHECKING

from heliotrope.cli._common import open_plant, parse_time

if TYPE_CHECKING:
    from datetime import datetime

    from heliotrope.field.plant import Plant


def one_plant(command: str, field: Path | None, heliostats: int | None, *, prototype: bool) -> None:
    """Refuse more than one plant at once."""
    from heliotrope.errors import InputError

    if prototype and (field is not None or heliostats is not None):
        raise InputError(
            f"{command}: --prototype already selects a plant; leave out the field and --heliostats"
        )
    if field is not None and heliostats is not None:
        raise InputError(
            f"{command}: --heliostats applies only to the default plant; leave it out when you "
            "specify a field"
        )


def design_of(field: Path | None, heliostats: int | None, *, prototype: bool) -> "Plant":
    """Return the plant in a file or folder, the prototype, or the default plant."""
    if field is not None:
        return open_plant(field)
    if prototype:
        from heliotrope.field.stellenbosch import prototype as malans

        return malans()
    from heliotrope.field.layouts import malan_plant

    return malan_plant(10_000 if heliostats is None else heliostats)


def start_of(command: str, text: str, design: "Plant") -> "datetime":
    """Return a simulated start time; for "morning" or a day, three hours before local noon.

    Raises
    ------
    TimeError
        If the time is invalid, or outside the range of local controllers, which count GPS seconds
        from 1980 in 32 bits.
    """
    from datetime import UTC, date, datetime, timedelta
    from datetime import time as hour

    from heliotrope.errors import TimeError
    from heliotrope.sun import solar_day

    try:
        today = solar_day(datetime.now(UTC), design.site)
        day = today if text == "morning" else date.fromisoformat(text)
    except ValueError:
        start, shift = parse_time(text), 0.0
    else:
        start, shift = datetime.combine(day, hour(12), UTC), design.site.longitude_deg / 15.0 + 3.0
    if not 1981 <= start.year < 2100:
        raise TimeError(f"{command}: --start {text}: the time must be in the years 1981 to 2099")
    return start.astimezone(UTC) - timedelta(hours=shift)
