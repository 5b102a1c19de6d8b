"""Compiling the kernels: once for each, and not in silence."""

import ast
import gc
import io
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numba import njit, types
from numba.core import event
from numba.core.errors import TypingError

import heliotrope as ht
from heliotrope import warm
from heliotrope.calibration.fit import _fit_kernels, estimator
from heliotrope.calibration.learn import _drift_kernels, _regime_kernels
from heliotrope.calibration.learn.learning import learn
from heliotrope.calibration.median import median
from heliotrope.field.layouts import malan_plant
from heliotrope.geometry import normalize
from heliotrope.jit import COMPILATION, PROGRAM, Compilation, as_input, is_compiled
from heliotrope.mechanism import kinds
from heliotrope.mechanism.kernels import track as track_kernels
from heliotrope.mechanism.kernels import warm as kernels_of_warm
from heliotrope.mechanism.kernels.block import track_block
from heliotrope.mechanism.kernels.chain import jacobian_block, pose_block
from heliotrope.optics import _look_kernels
from heliotrope.optics.plant_flux import FieldOptics
from heliotrope.plant.operations.predicted_flux import predicted

SUN, AIM = (0.0, -0.6, 0.8), (0.0, 0.0, 30.0)


class Terminal(io.StringIO):
    def __init__(self, *, terminal: bool) -> None:
        super().__init__()
        self.terminal = terminal

    def isatty(self) -> bool:
        return self.terminal


@pytest.fixture
def listening(monkeypatch: pytest.MonkeyPatch) -> Iterator[Compilation]:
    """A listener beside that of this process, which is kept quiet."""
    monkeypatch.setattr(COMPILATION, "told", True)
    listener = Compilation()
    event.register("numba:compile", listener)
    yield listener
    event.unregister("numba:compile", listener)


@pytest.mark.parametrize("terminal", [True, False])
def test_a_terminal_is_told_once(
    terminal: bool, listening: Compilation, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = Terminal(terminal=terminal)
    monkeypatch.setattr("sys.stderr", told)
    monkeypatch.delenv(PROGRAM, raising=False)
    assert njit(lambda x: x + 1)(1) == 2
    assert njit(lambda x: x + 2)(1) == 3
    assert listening.told
    lines = told.getvalue().splitlines()
    assert len(lines) == terminal
    assert all("compiling kernels, once after an installation" in line for line in lines)


def test_a_child_process_leaves_the_report_to_its_parent(
    listening: Compilation, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = Terminal(terminal=True)
    monkeypatch.setattr("sys.stderr", told)
    monkeypatch.setenv(PROGRAM, str(os.getppid()))
    assert njit(lambda x: x + 1)(1) == 2
    assert listening.told
    assert told.getvalue() == ""


@pytest.mark.parametrize("collecting", [True, False])
def test_garbage_lies_while_a_kernel_is_compiled(
    collecting: bool, listening: Compilation, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool] = []
    end = Compilation.on_end

    def ending(self: Compilation, what: object) -> None:
        if self is COMPILATION:
            asked.append(gc.isenabled())
        end(self, what)

    monkeypatch.setattr(Compilation, "on_end", ending)
    inner = njit(lambda x: x + 1)
    kernel = njit(lambda x: inner(x) + inner(1.0 * x))
    before = gc.isenabled()
    try:
        (gc.enable if collecting else gc.disable)()
        assert kernel(1) == 4.0
        assert gc.isenabled() == collecting
        with pytest.raises(TypingError):
            njit(lambda x: x.nothing)(1)
        assert gc.isenabled() == collecting
    finally:
        (gc.enable if before else gc.disable)()
    assert len(asked) >= 4
    assert not any(asked)
    assert listening.depth == COMPILATION.depth == 0


def test_numbers_in_calls_make_no_versions_of_a_function() -> None:
    # Inner functions are not kept on the disk: these are compiled here even where kernels are kept.
    table, rows = types.Array(types.float64, 2, "C"), types.Array(types.int64, 2, "C")
    number, whole = types.float64, types.int64
    three, turn = types.UniTuple(number, 3), types.UniTuple(number, 4)
    kernels_of_warm.warm_start.compile((table, table, table, rows, whole, whole, number, table))
    track_kernels._newton.compile((types.UniTuple(number, 18), three, three, turn, number))
    for inner in (kernels_of_warm._put, track_kernels._difference_column):
        assert len(inner.signatures) == 1, inner.signatures


def test_arrays_that_may_be_written_or_not_are_one_type() -> None:
    """Each kernel has one specialisation, however the arrays come."""
    place = np.array([[0.0, 50.0, 0.0], [0.0, 60.0, 0.0]])
    for mechanism in (kinds.azimuth_elevation(place), kinds.azimuth_elevation(place)[:, ...]):
        for sun in (np.array(SUN), np.broadcast_to(SUN, (2, 3)), as_input(np.tile(SUN, (2, 1)))):
            found = ht.track(mechanism, sun, AIM)
            counts = found.chosen(found.counts)
            for given in (counts, as_input(counts), counts[0], np.asfortranarray(counts)):
                mechanism.pose(given)
                mechanism.jacobian(given, ("tilt_north",))
    for kernel in (track_block, pose_block, jacobian_block):
        assert len(kernel.signatures) == 1, kernel.__name__


def test_an_input_is_a_view_that_its_owner_may_still_write() -> None:
    mine = np.zeros((2, 3))
    seen = as_input(mine)
    assert np.shares_memory(mine, seen)
    mine[0, 0] = 1.0
    assert seen[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        seen[0, 0] = 2.0
    assert as_input(np.zeros((3, 2)).T).flags.c_contiguous


def test_kernels_avoid_what_is_slow_to_compile() -> None:
    """Chain poses with slices assigned took four times as long to compile as with loops."""
    slow = {"median", "percentile", "solve", "det", "slogdet", "eye", "diag_indices"}
    seen = 0
    for path in Path(ht.__file__).parent.rglob("*.py"):
        for kernel in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(kernel, ast.FunctionDef):
                continue
            if not any("njit(" in ast.unparse(d) for d in kernel.decorator_list):
                continue
            seen += 1
            for node in ast.walk(kernel):
                if isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Store):
                    parts = [part for part in ast.walk(node.slice) if isinstance(part, ast.Slice)]
                    assert not parts, f"{path.name} {kernel.name}: {ast.unparse(node)} = …"
                if isinstance(node, ast.Attribute) and ast.unparse(node).startswith("np."):
                    assert node.attr not in slow, f"{path.name} {kernel.name}: {ast.unparse(node)}"
    assert seen > 100


def test_machine_code_is_kept_while_its_source_is_older(tmp_path: Path) -> None:
    source = tmp_path / "kernel.py"
    source.write_text("def twice(x):\n    return 2.0 * x\n", encoding="utf-8")
    space: dict[str, object] = {}
    exec(compile(source.read_text(encoding="utf-8"), str(source), "exec"), space)
    kernel = njit(cache=True)(space["twice"])
    os.utime(source, (1e9, 1e9))
    assert not is_compiled(kernel)
    assert kernel(2.0) == 4.0
    assert is_compiled(kernel)
    os.utime(source, (4e9, 4e9))
    assert not is_compiled(kernel)


@pytest.mark.parametrize(("cores", "compiled"), [(1, False), (2, True), (2, False)])
def test_two_processes_share_the_compiling(
    cores: int, compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []

    class Second:
        def __init__(self, command: list[str], **_: object) -> None:
            done.append(command[-1])

        def __enter__(self) -> None:
            pass

        def __exit__(self, *_: object) -> None:
            done.append("waited")

    monkeypatch.setenv("HELIOTROPE_THREADS", str(cores))
    monkeypatch.setattr(estimator, "is_compiled", lambda: compiled)
    monkeypatch.setattr(subprocess, "Popen", Second)
    for part in ("searching", "breaking", "tracking", "fitting"):
        monkeypatch.setattr(warm, part, lambda part=part: done.append(part))
    with warm.compiling():
        done.append("work")
    if cores == 2 and not compiled:
        assert done == [warm.OTHER_HALF, "searching", "breaking", "tracking", "work", "waited"]
    else:
        assert done == ["work"]


def test_warming_leaves_nothing_for_learning_to_compile() -> None:
    kernels = (
        track_block, pose_block, jacobian_block, _fit_kernels.fit_block,
        _drift_kernels.pooled_block, _drift_kernels.gram, _drift_kernels.step_sums,
        _regime_kernels.partition,
    )  # fmt: skip
    for part in (warm.tracking, warm.searching, warm.fitting, warm.breaking):
        part()
    before = [set(kernel.signatures) for kernel in kernels]
    assert all(before)
    mechanism = kinds.azimuth_elevation(np.array([[0.0, 50.0, 0.0], [9.0, 50.0, 0.0]]))
    angles = np.linspace(-1.0, 1.0, 16)
    suns = np.c_[np.sin(angles), np.zeros(16), np.cos(angles)]
    rows = np.arange(16) % 2
    counts = ht.track(mechanism[rows], suns, AIM).best_counts
    seen = ht.sightings(rows, counts, suns, AIM, time=1.7e9 + 86400.0 * np.arange(16))
    learn(mechanism, seen, ("tilt_north", "azimuth_bias"))
    assert [set(kernel.signatures) for kernel in kernels] == before


def test_warming_leaves_nothing_for_the_live_flux_to_compile() -> None:
    kernels = (_look_kernels.look, _look_kernels.spread, _look_kernels._take)
    warm.lighting()
    before = [set(kernel.signatures) for kernel in kernels]
    light, sun = FieldOptics(), normalize((0.0, 0.6, 0.8))
    predicted(light.scene(malan_plant(8), sun, None, ()), light)
    assert [set(kernel.signatures) for kernel in kernels] == before


def test_median_is_that_of_numpy() -> None:
    compiled = njit(median.py_func)
    rng = np.random.default_rng(0)
    cases = [rng.normal(size=n) for n in (1, 2, 3, 4, 7, 8, 101, 500)]
    cases += [np.repeat([3.0, 1.0, 2.0], 4), np.arange(9.0)[::-1].copy(), np.array([1.0, np.inf])]
    for values in cases:
        assert compiled(values.copy()) == np.median(values)
    assert np.isnan(compiled(np.array([1.0, np.nan, 2.0])))
    assert np.isnan(compiled(np.empty(0)))
