"""Emergency orders that arrive by two ways, given once each."""

import asyncio
import time
from collections import OrderedDict
from typing import Any

from heliotrope.console.remote import RemotePlant
from heliotrope.plant.authority import Person
from heliotrope.plant.interface import orders

#: Orders that are remembered, and for how long, s.
_MOST, _SAME = 100, 30.0


class EmergencyOrders:
    """Gives each order once, however often it arrives."""

    def __init__(self) -> None:
        self._given: OrderedDict[tuple[str, str], tuple[float, asyncio.Future[Any]]] = OrderedDict()

    async def give(self, plant: RemotePlant, person: Person, call: orders.EmergencyCall) -> Any:
        """Order DEFOCUS or STOW of the whole field; return the order's view.

        An order with the word of one of the last seconds is that one, and not given again.
        """
        key, now = (person.name, call.call), time.monotonic()
        given = self._given.get(key) if call.call else None
        if given is not None and now - given[0] < _SAME:
            try:
                return await asyncio.shield(given[1])
            except asyncio.CancelledError:
                if not given[1].cancelled():
                    raise
                # The other way has failed, so this one tries.
        first: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        if call.call:
            self._given[key] = (now, first)
            if len(self._given) > _MOST:
                self._given.popitem(last=False)
        try:
            view = await plant.ask("order_emergency", person, **call.model_dump())
        except BaseException:
            self._given.pop(key, None)
            first.cancel()
            raise
        first.set_result(view)
        return view
