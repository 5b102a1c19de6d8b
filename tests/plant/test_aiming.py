"""Aims under a flux limit in a plant at work: the true flux holds the limit."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace

import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.field.aim_settings import AimSettings
from heliotrope.field.flux_limit import FluxLimit
from heliotrope.field.layouts import lay_out
from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.optics import FieldOptics
from heliotrope.optics.receiver_flux import FieldFlux
from heliotrope.optics.surfaces import surface_of
from heliotrope.plant.operations import aiming
from heliotrope.plant.operations.automatic import AutomaticSettings
from support.live import LiveOptions, LivePlant, play

COUNT = 12
LIGHT = FieldOptics()


def played(
    work: Callable[[LivePlant], Awaitable[None]], limit: float | None, **changes: object
) -> None:
    """Run a small field in virtual time, with a flux limit or the middle of the receiver."""
    design = lay_out("radial", COUNT)
    (name,) = design.groups
    half = COUNT // 2
    group = replace(design.groups[name], cluster=("C1",) * half + ("C2",) * half)
    aims = AimSettings()
    if limit is not None:
        settings: dict[str, object] = {"probability": 0.95, "moves": 60.0, "every": 15.0}
        aims = AimSettings("limit", FluxLimit(limit, 0.05), **(settings | changes))  # type: ignore[arg-type]
    work_settings = AutomaticSettings(wanted=True, calibrate=False, rate=5.0)
    options = LiveOptions(rendered=False, threads=0, work=work_settings)

    async def later(made: LivePlant) -> None:
        await asyncio.sleep(4.0)
        await work(made)

    play(later, replace(design, groups={name: group}, aims=aims), options)


def true_flux(made: LivePlant) -> FloatArray:
    """Return the flux of the true mirrors, W/m²: where the motors are, by the true mechanism."""
    scene = made.operations._flux.scene(made.plant.now())
    on = made.plant.field.among((states.TRACKING,), made.plant.now())
    normal, center = made.field.stand()
    mirrors = replace(
        scene.mirrors, normal=normal, center=center, pointing=0.0 * scene.mirrors.pointing
    )
    surface = surface_of(made.design.receivers[0])
    given = replace(scene, mirrors=mirrors, surfaces=(surface,), dni=1000.0, dark=~on)
    return FieldFlux(given).maps[0]


async def greatest(made: LivePlant, seconds: float, every: float = 3.0) -> float:
    """Return the greatest true flux in a time, W/m²."""
    most = 0.0
    for _ in range(int(seconds / every)):
        await asyncio.sleep(every)
        most = max(most, float(true_flux(made).max()))
    return most


def test_probe() -> None:
    async def scene(made: LivePlant) -> None:
        print(made.design.receivers[0], made.operations.automatic.installed)
        for _ in range(8):
            print(made.plant.now(), await greatest(made, 60.0, 20.0), made.operations.aims())

    played(scene, None)
    played(scene, 12e3)
