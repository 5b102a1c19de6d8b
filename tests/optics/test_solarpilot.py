"""904 heliostats, each with the efficiencies that SolarPILOT computed at one sun (NREL/HALOS)."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks import _halos

from heliotrope.optics.attenuation import air_loss
from heliotrope.optics.scene import Scene
from heliotrope.optics.shading import Shading
from support.data import fields


def published() -> _halos.Published:
    known = _halos.read(fields())
    assert known is not None
    return known


def flat(scene: Scene) -> Scene:
    return replace(scene, mirrors=scene.mirrors.with_numbers(focal=np.inf))


def test_cosine_and_air_are_solarpilot_s() -> None:
    known = published()
    scene = known.scene()
    assert np.abs(scene.incidence - known.shares["cosine"]).max() < 1e-4
    loss = air_loss(scene.mirrors.slant)
    assert np.abs(1.0 - loss - known.shares["air"]).max() < 1e-4


def test_its_blocking_is_found_by_its_rule_and_differs_from_the_exact_union() -> None:
    known = published()
    scene, theirs = flat(known.scene()), known.shares["blocking"]
    exact = Shading(scene).lit
    # Under a sun at 78° nothing is shaded.
    assert exact.shading.min() == 1.0
    difference = exact.blocking - theirs
    assert np.sqrt(np.mean(difference**2)) < 3.8e-3
    assert np.abs(difference).max() < 0.0235
    ruled = _halos.summed_blocking(scene)
    # 46 rows are blocked by heliostats that the file lacks; in 54 it leaves out a blocker that
    # the file has. In the others the two are alike.
    both = (ruled < 1.0) & (theirs < 1.0)
    assert both.sum() == 61
    assert np.abs(ruled - theirs)[both].max() < 3e-4
    neither = (ruled == 1.0) & (theirs == 1.0)
    assert (exact.blocking[neither] > 0.999).all()


def test_where_the_two_differ_rays_decide_for_the_exact_union() -> None:
    pytest.importorskip("embreex", reason="the extra `rays` is not installed")
    known = published()
    scene, theirs = known.scene(), known.shares["blocking"]
    ours = Shading(scene).lit.blocking
    chosen = _halos.decided(theirs, ours, scene)
    assert chosen.sum() > 100
    # The twelve that differ most, 25,000 rays each.
    most = np.argsort(np.where(chosen, -np.abs(ours - theirs), 0.0))[:12]
    traced = _halos.traced_blocking(scene, np.isin(np.arange(len(ours)), most), 3e5)
    truth = traced.blocking[most]
    noise = np.sqrt(truth * (1.0 - truth) / traced.count[most])
    assert noise.max() < 2e-3
    assert (np.abs(ours[most] - truth) < 4.0 * noise).all()
    assert (np.abs(theirs[most] - truth) > 4.0 * noise).all()
