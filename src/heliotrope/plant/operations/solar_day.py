"""Days of local mean solar time, to which the predictions of field errors belong."""

from heliotrope.sun import Site

_DAY = 86_400.0


def day_of(at: float, site: Site) -> int:
    """Return the day number, in local mean solar time, counted from 1970."""
    return int((at + _ahead(site)) // _DAY)


def end_of_day(at: float, site: Site) -> float:
    """Return the next midnight of local mean solar time, POSIX s."""
    return (day_of(at, site) + 1) * _DAY - _ahead(site)


def _ahead(site: Site) -> float:
    """Return local mean solar time minus UTC, s."""
    return site.longitude_deg / 360.0 * _DAY
