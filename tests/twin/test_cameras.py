"""Cameras of the twin: true centroids with noise, and photographs drawn and read."""

import asyncio
import multiprocessing
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from heliotrope.errors import FetchError, InputError, UnknownNameError
from heliotrope.geometry import FloatArray, bisector, normalize
from heliotrope.imaging.synthetic.rendering import Thrown, example_camera, example_target
from heliotrope.imaging.synthetic.scenes import Scene
from heliotrope.links.clock import SystemClock, VirtualClock, run_virtual
from heliotrope.optics.mirror_image import gaussian_beam
from heliotrope.plant.visits import CalibrationCycle, CycleSettings, Shot
from heliotrope.twin.boards.outfit import RECEIVER
from heliotrope.twin.cameras import ExactCamera, FieldSnapshot, RenderedCamera
from heliotrope.twin.drawing import Drawer, Exposure, Optics
from heliotrope.twin.true_mirrors import TrueMirror, mirrors_of
from support.live import in_thread
from support.whole_plant import ENGINEER, WholePlant

MRAD = 1e-3
TARGET = example_target(6.0, name="white")
SCENE = Scene(example_camera(TARGET, 120.0, (1000, 750)), (TARGET,))
SUN = normalize(np.array([0.2, 0.4, 0.9]))
START = datetime(2026, 6, 21, 10, tzinfo=UTC)


def mirror(name: str, right: float = 0.0, up: float = 0.0, east: float = 5.0) -> TrueMirror:
    """One whose ray meets the target so far right of and above its middle."""
    vertex = np.array([east, 90.0, 2.0])
    point = TARGET.point(np.array([right, up]))
    return TrueMirror(name, vertex, bisector(SUN, normalize(point - vertex)))


def sight(clock: VirtualClock, *mirrors: TrueMirror) -> FieldSnapshot:
    def seen() -> Sequence[TrueMirror]:
        return mirrors

    def sun() -> FloatArray:
        return SUN

    return FieldSnapshot(clock, seen, sun)


def plane(shot: Shot) -> FloatArray:
    return TARGET.plane_coordinates(shot.point)


def test_exact_centroids_have_the_noise_that_they_tell() -> None:
    covariance = np.array([[4e-4, 1e-4], [1e-4, 1e-4]])

    async def main(clock: VirtualClock) -> list[Shot]:
        camera = ExactCamera(sight(clock, mirror("A", 0.7, -0.4)), covariance, seed=3)
        begin = clock.monotonic()
        shots = [await camera.photograph(TARGET, "A") for _ in range(3000)]
        assert shots[1].at == pytest.approx(begin + 2.0)
        # A mirror that is not among those near the target.
        far = await camera.photograph(TARGET, "B")
        assert far.reasons[0] == "no beam on the target"
        assert np.isnan(far.point).all()
        return shots

    shots = run_virtual(main)
    off = np.array([plane(shot) for shot in shots]) - [0.7, -0.4]
    # Five standard deviations of the mean, and of a variance's estimate.
    assert np.abs(off.mean(axis=0)).max() < 5.0 * 0.02 / np.sqrt(3000)
    assert np.abs(np.cov(off.T) - covariance).max() < 5.0 * 4e-4 * np.sqrt(2.0 / 3000)
    told = TARGET.axes @ np.asarray(shots[0].covariance) @ TARGET.axes.T
    assert np.allclose(told, covariance)
    assert all(shot.reasons == () for shot in shots)


def test_an_exact_camera_tells_what_is_wrong() -> None:
    async def main(clock: VirtualClock) -> None:
        away, here, other = mirror("A", 9.0), mirror("B"), mirror("C", 1.0)
        camera = ExactCamera(sight(clock, away, here, other), 0.0)
        assert (await camera.photograph(TARGET, "A")).reasons == (
            "no beam on the target",
            "several beams: B, C too",
        )
        assert (await camera.photograph(TARGET, "B")).reasons == ("several beams: C too",)
        turned = replace(here, normal=-here.normal)
        alone = ExactCamera(sight(clock, turned), 0.0)
        assert (await alone.photograph(TARGET, "B")).reasons == ("no beam on the target",)
        for bad, text in (
            (np.eye(3), r"shape \(3, 3\)"),
            (-1.0, "positive semidefinite"),
            (np.nan, "pass a"),
        ):
            with pytest.raises(InputError, match=text):
                ExactCamera(sight(clock), bad)

    run_virtual(main)


def test_a_rendered_camera_finds_the_beam_within_what_it_tells() -> None:
    async def main(clock: VirtualClock) -> None:
        there: list[TrueMirror] = []
        camera = RenderedCamera(
            FieldSnapshot(clock, lambda: tuple(there), lambda: SUN), [SCENE], seed=2
        )
        await camera.look(TARGET.name)
        for place in [(0.6, -0.5), (-0.9, 0.4)]:
            there[:] = [mirror("A", *place)]
            shot = await camera.photograph(TARGET, "A")
            assert shot.reasons == ()
            (beam,) = camera.beams(TARGET)
            off = plane(shot) - beam.beam.centroid
            covariance = TARGET.axes @ np.asarray(shot.covariance) @ TARGET.axes.T
            assert np.linalg.norm(off) < 0.02
            assert off @ np.linalg.solve(covariance, off) < 16.0
            # The energy's centre is where the ray of the mirror's middle goes.
            assert np.abs(beam.beam.centroid - place).max() < 0.01

    run_virtual(main)


def test_photographs_that_may_not_be_believed() -> None:
    async def main(clock: VirtualClock) -> None:
        there: list[TrueMirror] = []
        camera = RenderedCamera(
            FieldSnapshot(clock, lambda: tuple(there), lambda: SUN), [SCENE], seed=1
        )
        await camera.look(TARGET.name)
        assert camera.taken == 1
        nothing = await camera.photograph(TARGET, "A")
        assert nothing.reasons[0].startswith("no spot: ")
        assert np.isnan(nothing.point).all()
        there[:] = [mirror("A", -1.6, 1.2), mirror("B", 1.6, -1.0, east=-9.0), mirror("C", 60.0)]
        assert len(camera.beams(TARGET)) == 2
        both = await camera.photograph(TARGET, "A")
        assert any(reason.startswith("several spots: ") for reason in both.reasons)
        there[:] = [mirror("A", 2.9)]
        cut = await camera.photograph(TARGET, "A")
        assert any(reason.startswith("cut at the edge: ") for reason in cut.reasons)
        with pytest.raises(InputError, match=r"target white: a beam is on it, .* take the empty"):
            await camera.look(TARGET.name)
        other = example_target(6.0, name="other")
        with pytest.raises(UnknownNameError, match="other"):
            await camera.photograph(other, "A")

    run_virtual(main)


def test_what_a_rendered_camera_refuses() -> None:
    async def main(clock: VirtualClock) -> None:
        beam = Thrown("white", gaussian_beam((0.0, 0.0), 0.5))
        with pytest.raises(InputError, match="white has 1 targets and 1 beams; use one target"):
            RenderedCamera(sight(clock), [replace(SCENE, beams=(beam,))])

    run_virtual(main)


def test_photographs_are_drawn_in_a_process_that_begins_again_when_it_dies() -> None:
    shown = Exposure(SCENE, (mirror("A", 0.5, -0.4),), SUN, Optics(), 3, "photo 1", START)
    drawer = Drawer()
    try:
        frame = drawer.draw(shown)
        assert np.array_equal(frame.pixels, shown.draw().pixels)
        assert (frame.name, frame.time) == ("photo 1", START)
        (process,) = multiprocessing.active_children()
        process.kill()
        process.join()
        with pytest.raises(FetchError, match="photo 1: the process that draws photographs has"):
            drawer.draw(shown)
        assert np.array_equal(drawer.draw(shown).pixels, frame.pixels)
        (again,) = multiprocessing.active_children()
        with pytest.raises(InputError, match="facet"):
            drawer.draw(replace(shown, optics=Optics(facets=(0, 1))))
    finally:
        drawer.close()
    assert not again.is_alive()


def test_a_joint_photograph_is_read_after_it_is_taken() -> None:
    """The beams may move on while it is drawn and read: it shows where they were."""

    async def main() -> None:
        clock = SystemClock()
        there = [mirror("A", 0.6, -0.5)]
        camera = RenderedCamera(
            FieldSnapshot(clock, lambda: tuple(there), lambda: SUN, latency=0.0),
            [SCENE],
            worker=in_thread,
        )
        camera.start(lambda alarm: None)
        try:
            exposed = await camera.expose(TARGET)
            assert not exposed.light.done()
            there[:] = [mirror("A", -0.9, 0.4)]
            light = await exposed.light
        finally:
            camera.close()
        assert light.at == exposed.at
        rows, columns = np.unravel_index(np.argmax(light.values), light.values.shape)
        x, y = light.first + light.step * np.array([columns, -rows])
        assert abs(x - 0.6) < 0.5
        assert abs(y + 0.5) < 0.5

    asyncio.run(main())


def test_a_calibration_cycle_with_rendered_photographs(tmp_path: Path) -> None:
    """The whole plant; the worst mirror, seen by pixels alone, comes below 0.5 mrad."""

    async def main(clock: VirtualClock) -> None:
        whole = WholePlant(clock, tmp_path, seed=1, target=TARGET)
        async with whole.alive():
            await scene(whole)

    async def scene(whole: WholePlant) -> None:
        plant, token = whole.plant, whole.token
        assert await plant.aim(ENGINEER, token, plant.default_aims()).end(20.0)
        assert await plant.command(ENGINEER, token, "APPROACH").end(400.0)
        camera = RenderedCamera(
            FieldSnapshot(whole.clock, mirrors_of(whole.boards), plant.sun_vector), [SCENE], seed=1
        )
        await camera.look(TARGET.name)
        assert await plant.command(ENGINEER, token, "TRACK").end(30.0)
        await whole.wait(20.0)

        def error(name: str) -> float:
            """Error of the mirror's normal: half the beam's, rad."""
            vertex, _ = whole.boards[name].beam(plant.sun_vector())
            away = float(np.linalg.norm(np.subtract(RECEIVER, vertex)))
            return 0.5 * whole.miss(name) / away

        worst = max(whole.boards, key=error)
        before = error(worst)
        cycle = CalibrationCycle(plant, camera, CycleSettings(interval=5.0))
        result = await cycle.run(ENGINEER, token, worst, "white")
        assert result.text.startswith("calibrated: beam error"), result.text
        assert result.rejected == ()
        assert camera.taken == 5  # the last one confirms the new parameters
        await whole.wait(20.0)
        assert whole.all_are("TRACKING")
        assert error(worst) < 0.5 * MRAD < 1.0 * MRAD < before

    run_virtual(main, 1)
