"""The broadcasts at the start of each second: SESSION, TIME and SUN.

SESSION is sent first, because a local controller that has just started accepts nothing before it; a
local controller with a bus key is sent its own SESSION (`_bus_keys`). SUN is sent only while the
plant's lease (and the autonomy that it grants) is valid, the time is reliable, and no row of the
safety table requires DEFOCUS or STOW. Without SUN each local controller defocuses by itself.
"""

from heliotrope.cluster._bus_keys import BusKeys
from heliotrope.cluster._epoch import Epoch
from heliotrope.cluster._exchange import Exchange
from heliotrope.cluster._watch import Watch
from heliotrope.cluster.config import ClusterConfig
from heliotrope.cluster.timekeeping import Time
from heliotrope.links.clock import WEEK, Clock
from heliotrope.sun import broadcast_values

#: Codes of a time's quality on the wire.
_QUALITIES = ("none", "gps", "holdover", "system")


class Broadcast:
    """Sends session, time and sun vector, and records the time sent to the local controllers."""

    def __init__(
        self,
        config: ClusterConfig,
        exchange: Exchange,
        watch: Watch,
        epoch: Epoch,
        keys: BusKeys,
        clock: Clock,
    ) -> None:
        self._config, self._exchange, self._watch = config, exchange, watch
        self._epoch, self._keys, self._clock = epoch, keys, clock
        self._offset: float | None = None  # GPS minus monotonic time, as last broadcast

    def bus_time(self) -> float | None:
        """Return the GPS time of the local controllers, s; None if no time has been sent."""
        return None if self._offset is None else self._clock.monotonic() + self._offset

    async def second(self, present: Time) -> None:
        """Send the broadcasts of one second; ``present`` is the current time."""
        now, exchange = self._clock.monotonic(), self._exchange
        sound = present.usable and not present.jumped
        if sound:
            self._epoch.time_known(present)
        await exchange.broadcast_session(self._watch.token)
        await self._keys.meet(self._watch.token)
        if not sound:
            return
        gps = present.gps_s + self._clock.monotonic() - now
        week, seconds = divmod(gps, WEEK)
        quality = _QUALITIES.index(present.quality)
        if await exchange.broadcast("TIME", int(week), int(1000.0 * seconds), quality):
            self._offset = present.gps_s - now
        # Checked now because the program may have been suspended since this second began.
        if not self._watch.verdict.dark and not self._watch.alone(self._clock.monotonic()):
            second = round(present.gps_s - self._config.phase)
            utc_s = present.utc_s - (present.gps_s - second)
            values = broadcast_values(second, utc_s, self._config.site)
            if values is not None:
                await exchange.broadcast("SUN", *values)
