"""A place and a time with the sun high, for tests that need both."""

from datetime import UTC, datetime, timedelta

from heliotrope.links.clock import SystemClock
from heliotrope.sun import Site

SITE = Site(37.4, -6.0, 100.0, name="simulation")
START = datetime(2026, 6, 21, 9, tzinfo=UTC)


class DayClock(SystemClock):
    """The machine's monotonic time, with a calendar in which the sun is up, at any hour."""

    def __init__(self, start: datetime = START) -> None:
        super().__init__()
        self._start, self._begun = start, self.monotonic()

    def utc(self) -> datetime:
        """Return the time of the calendar."""
        return self._start + timedelta(seconds=self.monotonic() - self._begun)
