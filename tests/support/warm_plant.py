"""A program that warms up, lets a plant work, and prints which kernels its loop compiled then.

A kernel that is loaded from the disk counts: after a new installation it would be compiled.
"""

import asyncio
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from numba.core.dispatcher import Dispatcher

from heliotrope import warm
from heliotrope.field.layouts import malan_plant
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.assembly import AssemblySettings, MachineTables, PlantAssembly
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.processes import end, pool
from heliotrope.twin import warm as warm_twin
from heliotrope.twin.live import World, WorldOptions

COUNT, WORKING, STOWING = 6, 240.0, 30.0
WORK = AutomaticSettings(wanted=True, foresee=60.0)


def compiled() -> dict[str, int]:
    """Return the number of specialisations of each kernel that is kept on the disk."""
    modules = [module for name, module in sys.modules.items() if name.startswith("heliotrope.")]
    kernels = {each for module in modules for each in vars(module).values() if kept(each)}
    return {f"{one.__module__}.{one.__name__}": len(one.signatures) for one in kernels}


def kept(value: object) -> bool:
    """Whether a value is a kernel that is kept on the disk, and was made or loaded."""
    if not isinstance(value, Dispatcher) or not value.signatures:
        return False
    return not value.targetoptions.get("no_cpython_wrapper")


async def work(clock: VirtualClock, worker: Callable[..., Any]) -> None:
    """Raise and calibrate a small plant; then take its beams away."""
    design = malan_plant(COUNT)
    world = World(design, clock, WorldOptions(rendered=False))
    settings = AssemblySettings(work=WORK, machines=MachineTables.HELD)
    live = PlantAssembly(design, replace(world.ports(), worker=worker), settings)
    async with live.running():
        await asyncio.sleep(WORKING)
        await live.operations.receiver_flux()
        assert live.operations.automatic.view().done
        live.operations.emergency(Person("engineer", Role.ENGINEER))
        await asyncio.sleep(STOWING)
        assert live.plant.sentinel.on
        await live.end()
    print("calibrated and in an emergency")


def main() -> None:
    """Compare the kernels before and after."""
    beside = pool(1)

    async def worker(function: Callable[..., Any], *given: Any) -> Any:
        # Virtual time stands still meanwhile.
        return beside.submit(function, *given).result()

    warm.controlling()
    warm_twin.moving()
    before = compiled()
    run_virtual(lambda clock: work(clock, worker))
    end(beside)
    new = {name for name, count in compiled().items() if count != before.get(name)}
    print("compiled:", ", ".join(sorted(new)) or "none")


if __name__ == "__main__":
    main()
