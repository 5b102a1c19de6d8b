"""Compile the numeric kernels once, so that programs start at full speed.

After an installation, ``python -m heliotrope.warm`` takes some twenty seconds on two cores; later
runs take about a second. The compiled code is stored in the package's ``__pycache__``. The compiler
uses one thread, so the kernels are divided between two processes. Commands that need most kernels
begin with `compiling`.
"""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from heliotrope.parallel import threads

if TYPE_CHECKING:
    from heliotrope.calibration.learn.drift import Hyperparameters, Linear
    from heliotrope.calibration.sightings import Sightings
    from heliotrope.mechanism.chain import Mechanism

#: Argument with which a second process is started to compile the other half.
OTHER_HALF = "other-half"


def main() -> None:
    """Run the kernels of tracking and learning once, in two processes if there are two cores."""
    if OTHER_HALF in sys.argv[1:]:
        fitting()
        return
    with compiling():
        following()
        guarding()
    for part in (searching, breaking, tracking, fitting, hiding, lighting, cutting):
        part()


@contextmanager
def compiling() -> Iterator[None]:
    """Compile the kernels of a calibration in two processes, unless they are already compiled.

    Tracking is compiled when the block begins, and fitting when it ends. With one core, or where
    machine code cannot be stored, kernels are compiled when they are needed. Both halves take
    equally long if tracking comes last, because the other process has by then compiled and cached
    the joint chain, which both halves need.
    """
    from heliotrope.calibration.fit import estimator

    if threads() == 1 or estimator.is_compiled():
        yield
        return
    command = [sys.executable, "-m", "heliotrope.warm", OTHER_HALF]
    # An error in the other process also occurs in this process, where it is reported.
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL):  # noqa: S603
        searching()
        breaking()
        tracking()
        yield


def controlling() -> None:
    """Compile or load the kernels of a plant's loop in advance, so that the loop is not delayed."""
    for part in (tracking, following, guarding, hiding):
        part()


def computing() -> None:
    """Load the kernels that processes beside a plant's loop use."""
    from heliotrope.imaging import coded, photograph  # noqa: F401 - only loaded

    tracking()
    fitting()


def tracking() -> None:
    """Track one heliostat, which compiles the tracking kernels."""
    from heliotrope.mechanism.tracking import track

    mechanism, seen = _case()
    counts = track(mechanism, seen.source[:1], seen.destination[:1]).best_counts
    mechanism.pose(counts)


def fitting() -> None:
    """Place a heliostat and fit its model, which compiles the kernels for these."""
    from heliotrope.calibration.fit.estimator import fit

    mechanism, seen = _case()
    mechanism.pose(seen.counts)
    mechanism.armature  # noqa: B018
    mechanism.jacobian(seen.counts, ("tilt_north", "position_up"))
    fit(mechanism, seen, "malan8")


def searching() -> None:
    """Search for the hyperparameters of a heliostat."""
    from heliotrope.calibration.learn import drift

    drift.refine(*_drifting(), iterations=1)


def breaking() -> None:
    """Search for steps and regimes in a heliostat's history."""
    from heliotrope.calibration.learn import drift
    from heliotrope.calibration.learn.regimes import find_regimes

    hyper, data = _drifting()
    drift.find_steps(hyper, data)
    find_regimes(data.time, data.value, data.jacobian[:, :, :2])


def following() -> None:
    """Update a model with one sighting, and compute the drive resolution and the derivatives."""
    from heliotrope.calibration.learn import stream

    mechanism, seen = _case()
    mechanism.drives.radians_per_count(seen.counts)
    mechanism.jacobian(seen.counts, ("tilt_north",))
    hyper, data = _drifting()
    stream.update(stream.begin(hyper), data.jacobian[0], data.value[0], 0.0)


def guarding() -> None:
    """Check that a beam stays clear of one volume and that it enters another."""
    import numpy as np

    from heliotrope.field.volumes import Box
    from heliotrope.optics.beam import MirrorOptics
    from heliotrope.optics.keep_out import sweep

    mechanism, _ = _case()
    path = np.array([[0.0, 0.7], [0.3, 0.9]])
    volumes = [
        Box("around", (0.0, 50.0, 0.0), (9.0, 9.0, 9.0)),
        Box("far", (900.0, 0.0, 0.0), (1.0,) * 3),
    ]
    sweep(mechanism.armature, path, (0.0, -0.6, 0.8), MirrorOptics.of([2.0], [2.0]), volumes)


def hiding() -> None:
    """Find the mirrors that hide a part of another mirror."""
    import numpy as np

    from heliotrope.optics import Mirrors, Scene, Shading

    center, normal = (
        np.array([[0.0, 50.0, 0.0], [0.0, 56.0, 0.0]]),
        np.array([[0.0, -0.6, 0.8]] * 2),
    )
    mirrors = Mirrors.of(center, normal, (np.full(2, 3.0),) * 2, np.array([0.0, 0.0, 30.0]))
    Shading(Scene(np.array([0.0, -0.6, 0.8]), 0.0, mirrors, ())).hiding(0)


def lighting() -> None:
    """Cast the light of three heliostats on a receiver, with its uncertainty."""
    from heliotrope.field.layouts import malan_plant
    from heliotrope.geometry import normalize
    from heliotrope.optics.plant_flux import FieldOptics

    light = FieldOptics()
    scene = light.scene(malan_plant(3), normalize((0.0, 0.6, 0.8)), None, ())
    light.engine(scene).power_slope()


def cutting() -> None:
    """Cast the light of three heliostats on a mesh with its uncertainty, and clip one mirror."""
    from dataclasses import replace

    import numpy as np

    from heliotrope.field.layouts import malan_plant
    from heliotrope.geometry import normalize
    from heliotrope.optics.plant_flux import FieldOptics
    from heliotrope.optics.shading import Shading
    from heliotrope.optics.surfaces import Mesh

    plant, light = malan_plant(3), FieldOptics()
    scene = light.scene(plant, normalize((0.0, 0.6, 0.8)), None, ())
    mesh = Mesh("mesh", plant.targets[0].corners, np.array([[0, 1, 2], [0, 2, 3]]))
    light.engine(replace(scene, surfaces=(mesh,))).power_slope()
    Shading(scene).pieces(0)


def _case() -> "tuple[Mechanism, Sightings]":
    """Return a mechanism and a sighting of it."""
    import numpy as np

    from heliotrope.calibration.sightings import sightings
    from heliotrope.mechanism import kinds

    mechanism = kinds.azimuth_elevation(np.array([[0.0, 50.0, 0.0]]), pivot_offset=0.2)
    counts = np.array([[0.0, 1e5]])
    return mechanism, sightings([0], counts, (0.0, -0.6, 0.8), (0.0, 0.0, 30.0), time=0.0)


def _drifting() -> "tuple[Hyperparameters, Linear]":
    """Return sightings of a heliostat on eight days, linear in its parameters."""
    import numpy as np

    from heliotrope.calibration.learn import drift

    hyper = drift.start(_case()[0], ("tilt_north",))
    count, size = 8, len(hyper.names)
    numbers = np.random.default_rng(0)
    data = drift.Linear(
        jacobian=numbers.normal(size=(count, 2, size)),
        value=numbers.normal(size=(count, 2)),
        time=np.arange(float(count)),
        regime=np.zeros(count, dtype=np.int64),
        centre=np.zeros(size),
        own=np.zeros(size, dtype=np.bool_),
        steps=np.empty(0),
        suspect=np.zeros(count, dtype=np.bool_),
    )
    return hyper, data


if __name__ == "__main__":
    main()
