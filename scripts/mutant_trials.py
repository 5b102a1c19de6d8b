"""How mutants are tried: children of one process that has collected the tests and imported all.

`Bench` is a plugin of pytest. Instead of running the tests that were collected it forks a child
for each trial, plants the mutant in the child's memory by exchanging the code of one function, and
runs the tests, or the simulation, that reach it. A mutant outside functions, or in one that runs
at import, gets a tree of sources and an interpreter of its own. `Reach` says which tests and runs
reach which lines; it is measured once (`measured`) with the package coverage.
"""

import ast
import contextlib
import gc
import hashlib
import importlib.util
import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import mutant_operators as operators
import pytest
from mutant_operators import ROOT, SOURCE, Mutant

#: Runs of the simulation: name, seed, worlds, mean time between two faults, length, s.
RUNS: tuple[tuple[str, int, tuple[str, ...], float, float], ...] = (
    ("tour 2", 2, ("tour",), 12.0, 300.0),
    ("held 41", 41, ("held",), 12.0, 180.0),
    ("calm 11", 11, ("calm",), 60.0, 180.0),
    ("calm held 42", 42, ("calm", "held"), 30.0, 180.0),
    ("swarm 21", 21, ("swarm",), 12.0, 180.0),
    ("site 61", 61, ("site",), 12.0, 180.0),
)
HELIOSTATS = 3
#: Tests of one mutant together, at most, s; those left over are not run.
MOST_TESTS = 120.0
#: Time of the processor after which a test or a run hangs: this and so much more than it takes
#: unchanged; of a run; wall time for those that wait for ever, on a machine that does more. s.
SPARE, FACTOR, RUN_LIMIT, WALL = 5.0, 1.5, 30.0, 300.0
#: Takes the line of a mutant that was tried.
Keep = Callable[[dict[str, Any]], None]
OPTIONS = ("-q", "-s", "-m", "not slow", "-p", "no:cacheprovider", "-p", "no:terminalreporter")


def folders() -> list[str]:
    """Return the folders of the unit tests."""
    return [str(ROOT / "tests" / package) for package in operators.PACKAGES]


def limit(seconds: float) -> None:
    """End this process by a signal once it has computed for this long."""
    signal.setitimer(signal.ITIMER_PROF, seconds)


def simulate(name: str) -> bool:
    """Run the simulation; True if it found something."""
    from heliotrope.twin.world.simulation import RunPlan, run

    limit(RUN_LIMIT)
    seed, worlds, pause, seconds = next(each[1:] for each in RUNS if each[0] == name)
    return not run(RunPlan(seed, seconds, HELIOSTATS, pause, worlds=worlds)).good


# -- what reaches a line -----------------------------------------------------------------------


def stamp() -> str:
    """Return a checksum of the sources and the tests."""
    found = hashlib.sha256()
    for folder in (SOURCE, ROOT / "tests"):
        for path in sorted(folder.rglob("*.py")):
            found.update(path.read_bytes())
    return found.hexdigest()


@dataclass
class Reach:
    """Which tests and which runs of the simulation reach a line.

    Attributes
    ----------
    seconds
        Time of each test.
    lines
        Names of the tests and runs for each file below `SOURCE` and line; "" is the import.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    lines: dict[str, dict[int, set[str]]] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> "Reach | None":
        """Read what `keep` wrote; None if it is not there or the sources have changed since."""
        told = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        if told.get("sources") != stamp():
            return None
        names = told["names"]
        lines = {
            file: {int(line): {names[i] for i in some} for line, some in found.items()}
            for file, found in told["lines"].items()
        }
        return cls(told["seconds"], lines)

    def keep(self, path: Path) -> None:
        """Write to a file."""
        names = sorted(
            {name for found in self.lines.values() for s in found.values() for name in s}
        )
        number = {name: i for i, name in enumerate(names)}
        lines = {
            file: {line: sorted(number[name] for name in some) for line, some in found.items()}
            for file, found in self.lines.items()
        }
        told = {"sources": stamp(), "seconds": self.seconds, "names": names, "lines": lines}
        path.write_text(json.dumps(told), encoding="utf-8")

    def at(self, places: Sequence[tuple[str, int]]) -> set[str]:
        """Return what reaches one of some lines."""
        found: set[str] = set()
        for file, line in places:
            found |= self.lines.get(file, {}).get(line, set())
        return found

    def naming(self, word: str) -> list[tuple[str, int]]:
        """Return the lines of all files that name something."""
        pattern = re.compile(rf"\b{re.escape(word)}\b")
        return [
            (file, number)
            for file in self.lines
            if (SOURCE / file).exists()
            for number, text in enumerate((SOURCE / file).read_text("utf-8").splitlines(), 1)
            if pattern.search(text)
        ]


def reaching(mutant: Mutant, reach: Reach) -> tuple[set[str], bool]:
    """Return the names of what reaches a mutant, and whether the import does.

    A mutant outside functions is reached by what executes a line that uses its name: the name of
    the constant, the attribute or the argument.
    """
    tree = ast.parse((SOURCE / mutant.file).read_text(encoding="utf-8"))
    node = next(n for place, n in enumerate(operators.walk(tree)) if place == mutant.place)
    chain = _above(tree, node)
    inside = next((a for a in reversed(chain[:-1]) if _is_body(a, chain)), None)
    if inside is not None:
        shown = node.test if isinstance(node, ast.If) else node
        last = getattr(shown, "end_lineno", mutant.line) or mutant.line
        found = reach.at([(mutant.file, n) for n in range(mutant.line, last + 1)])
        if not found:
            statement = next(a for a in reversed(chain) if isinstance(a, ast.stmt))
            found = reach.at([(mutant.file, statement.lineno)])
        return found - {""}, "" in found
    words = _words(chain)
    places = [place for word in words for place in reach.naming(word)]
    found = reach.at(places) - {""}
    if not found:
        found = {n for some in reach.lines.get(mutant.file, {}).values() for n in some} - {""}
    return found, True


def _above(tree: ast.AST, node: ast.AST) -> list[ast.AST]:
    """Return the nodes from the tree's root to one node."""
    if tree is node:
        return [tree]
    for child in ast.iter_child_nodes(tree):
        found = _above(child, node)
        if found:
            return [tree, *found]
    return []


def _is_body(node: ast.AST, chain: Sequence[ast.AST]) -> bool:
    if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        return False
    return any(each in chain for each in node.body)


def _words(chain: Sequence[ast.AST]) -> list[str]:
    """Return the names that a mutant outside functions is used by."""
    for node in reversed(chain):
        match node:
            case ast.AnnAssign(target=ast.Name(id=name)):
                return [name]
            case ast.Assign(targets=targets):
                return [n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                return [name]
    return []


# -- planting ----------------------------------------------------------------------------------


def _live() -> dict[tuple[str, int, str], list[FunctionType]]:
    """Return all functions of the packages by file, line and name."""
    found: dict[tuple[str, int, str], list[FunctionType]] = defaultdict(list)
    start = str(SOURCE) + os.sep
    for each in gc.get_objects():
        if isinstance(each, FunctionType) and each.__code__.co_filename.startswith(start):
            code = each.__code__
            key = (code.co_filename, code.co_firstlineno, code.co_qualname)
            found[key].append(each)
    return found


def _bare(code: CodeType) -> tuple[Any, ...]:
    consts = tuple(
        (type(c).__name__, repr(c)) for c in code.co_consts if not isinstance(c, CodeType)
    )
    return (code.co_code, consts, code.co_names, code.co_varnames, code.co_freevars, code.co_flags)


def _parts(code: CodeType) -> list[CodeType]:
    return [c for c in code.co_consts if isinstance(c, CodeType)]


def _same(one: CodeType, two: CodeType) -> bool:
    first, second = _parts(one), _parts(two)
    return (
        _bare(one) == _bare(two)
        and len(first) == len(second)
        and all(_same(a, b) for a, b in zip(first, second, strict=True))
    )


def compiled(mutant: Mutant) -> tuple[CodeType, CodeType]:
    """Return the code of a file without and with a mutant."""
    path = SOURCE / mutant.file
    source = path.read_text(encoding="utf-8")
    plain = compile(ast.parse(source), str(path), "exec", dont_inherit=True)
    return plain, compile(operators.planted(mutant, source), str(path), "exec", dont_inherit=True)


def changes(plain: CodeType, new: CodeType) -> Iterator[tuple[CodeType, CodeType] | None]:
    """Yield the functions that differ; None for a difference outside functions."""
    if _bare(plain) != _bare(new) or len(_parts(plain)) != len(_parts(new)):
        yield None
        return
    for one, two in zip(_parts(plain), _parts(new), strict=True):
        if _same(one, two):
            continue
        is_function = bool(one.co_flags & 0x0002) and not one.co_name.startswith("<")  # NEWLOCALS
        if is_function:
            yield one, two
        else:
            yield from changes(one, two)


# -- trials ------------------------------------------------------------------------------------


@dataclass
class Trial:
    """One child: the unit tests of a mutant, its runs of the simulation, or a test unchanged."""

    kind: str
    mutant: Mutant
    names: list[str]
    spare: float
    begin: float = field(default_factory=time.monotonic)
    folder: str = field(default_factory=lambda: tempfile.mkdtemp(prefix="mutant-"))
    then: "Trial | None" = None

    @property
    def found(self) -> str:
        """The test or run that failed last, "" if none did."""
        path = Path(self.folder) / "found"
        return path.read_text(encoding="utf-8") if path.exists() else ""

    def begins(self, name: str) -> None:
        """Note what runs now."""
        (Path(self.folder) / "found").write_text(name, encoding="utf-8")


class _Failures:
    def __init__(self) -> None:
        self.any = False

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.any = self.any or report.failed


class Bench:
    """Plugin of pytest that tries mutants instead of running tests.

    Parameters
    ----------
    todo
        Kinds of trials, "unit" or "simulation", and mutants.
    reach
        What reaches them; None: the tests that name a module, and all runs.
    processes
        Children at once.
    end
        Begin no trial after this, s of the monotonic clock.
    keep
        Takes the line of each trial.
    """

    def __init__(
        self,
        todo: Sequence[tuple[str, Mutant]],
        reach: Reach | None,
        processes: int,
        end: float,
        keep: Keep,
    ) -> None:
        self._todo = list(todo)
        self._reach, self._processes, self._end, self._keep = reach, processes, end, keep
        self._seconds = {} if reach is None else reach.seconds
        self._failures = _Failures()
        self._running: dict[int, Trial] = {}
        self._ready: list[Trial] = []
        self._flaky: set[str] = set()
        self._kills: Counter[str] = Counter({each[0]: 0 for each in RUNS})
        self._tries: Counter[str] = Counter()
        self._items: dict[str, pytest.Item] = {}
        self._functions: dict[tuple[str, int, str], list[FunctionType]] = {}
        self._config: pytest.Config | None = None

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Try all mutants."""
        __import__("heliotrope.twin.world.soak")
        self._config = session.config
        session.config.pluginmanager.register(self._failures)
        self._items = {item.nodeid: item for item in session.items}
        self._functions = _live()
        gc.collect()
        gc.freeze()
        signal.signal(signal.SIGTERM, self._stop)
        while self._fill() or self._running:
            self._reap()
        return True

    def _stop(self, *_: object) -> None:
        for pid in self._running:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)
        os._exit(1)

    # -- the parent ------------------------------------------------------------------------

    def _fill(self) -> bool:
        while len(self._running) < self._processes:
            if self._ready:
                self._fork(self._ready.pop(0))
            elif self._todo and time.monotonic() < self._end:
                self._begin(*self._todo.pop(0))
            else:
                return False
        return True

    def _begin(self, kind: str, mutant: Mutant) -> None:
        """Plan a trial; what reaches nothing is told at once."""
        plain, new = compiled(mutant)
        if _same(plain, new):
            return
        if self._reach is None:
            found, at_import = self._near(mutant) | set(self._kills), True
        else:
            found, at_import = reaching(mutant, self._reach)
        where = "outside" if at_import or not self._patches(plain, new) else "inside"
        if kind == "unit":
            # What the import makes of it, a table or a constant, others use: all tests of the
            # package may find it.
            wide = at_import and self._reach is not None
            own = self._own(mutant) if wide else set()
            names, spare = self._shortest(mutant, (found | own) & set(self._items))
        else:
            names = sorted(found & set(self._kills), key=self._chance, reverse=True)
            spare = 10.0 * len(names)
        trial = Trial(f"{kind} {where}", mutant, names, spare)
        if names:
            self._ready.append(trial)
        else:
            self._tell(trial, kind, "")

    def _chance(self, run: str) -> float:
        return (self._kills[run] + 1.0) / (self._tries[run] + 2.0)

    def _own(self, mutant: Mutant) -> set[str]:
        """Return the tests of a mutant's package."""
        start = f"tests/{Path(mutant.file).parts[0]}/"
        return {name for name in self._items if name.startswith(start)}

    def _near(self, mutant: Mutant) -> set[str]:
        """Return the tests of a mutant's package whose file names its module."""
        word = Path(mutant.file).stem.strip("_")
        files = {name.split("::")[0] for name in self._own(mutant)}
        near = {file for file in files if word in (ROOT / file).read_text(encoding="utf-8")}
        return {name for name in self._own(mutant) if name.split("::")[0] in near}

    def _shortest(self, mutant: Mutant, tests: set[str]) -> tuple[list[str], float]:
        """Return tests, the shortest first, and the time that they take.

        Of a test with parameters one comes first, and the others after all tests had their turn:
        they mostly find the same.
        """
        seconds = self._seconds
        own = f"tests/{Path(mutant.file).parts[0]}/"
        order = sorted(
            tests - self._flaky, key=lambda n: seconds.get(n, 1.0) * (1 + (own not in n))
        )
        turns = Counter[str]()
        turn = {}
        for name in order:
            turn[name] = min(2, turns[name.split("[")[0]])
            turns[name.split("[")[0]] += 1
        order.sort(key=lambda name: turn[name])
        chosen: list[str] = []
        total = 0.0
        for name in order:
            total += seconds.get(name, 1.0)
            if total > MOST_TESTS and chosen:
                break
            chosen.append(name)
        return chosen, total

    def _patches(self, plain: CodeType, new: CodeType) -> list[tuple[list[FunctionType], CodeType]]:
        """Return the functions to change and their new code; none if it cannot be done so."""
        found = []
        for each in changes(plain, new):
            if each is None:
                return []
            one, two = each
            live = self._functions.get((one.co_filename, one.co_firstlineno, one.co_qualname))
            if not live or one.co_freevars != two.co_freevars:
                return []
            found.append((live, two))
        return found

    def _fork(self, trial: Trial) -> None:
        trial.begin = time.monotonic()
        child = os.fork()
        if child == 0:
            try:
                self._work(trial)
            except BaseException:  # noqa: BLE001 - whatever it is, the child ends here
                os._exit(1)
            os._exit(0)
        self._running[child] = trial

    def _reap(self) -> None:
        child, status = os.waitpid(-1, os.WNOHANG)
        if child:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)  # what a test left running
            self._judge(self._running.pop(child), good=status == 0)
            return
        for pid, trial in self._running.items():
            if time.monotonic() > trial.begin + WALL + 10.0 * trial.spare:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(pid, signal.SIGKILL)
        time.sleep(0.02)

    def _judge(self, trial: Trial, *, good: bool) -> None:
        kind, found = trial.kind.split()[0], trial.found
        shutil.rmtree(trial.folder, ignore_errors=True)
        if kind == "unit" and not good:
            # The same test on the unchanged code: does it fail by itself, on this machine, now?
            self._ready.insert(0, Trial("control inside", trial.mutant, [found], 60.0, then=trial))
        elif kind == "control" and not good:
            self._flaky.update(trial.names)
            first = trial.then
            assert first is not None
            left = [name for name in first.names if name not in self._flaky]
            again = Trial(first.kind, first.mutant, left, first.spare)
            if left:
                self._ready.insert(0, again)
            else:
                self._tell(again, "unit", "")
        elif kind == "control":
            self._tell(trial, "unit", trial.names[0])
        else:
            if kind == "simulation":
                self._tries.update(trial.names[: trial.names.index(found) + 1] if found else [])
                self._kills.update([] if good else [found])
            self._tell(trial, kind, "" if good else found)

    def _tell(self, trial: Trial, kind: str, by: str) -> None:
        first = trial.then or trial
        self._keep({
            "mutant": trial.mutant.key, "package": Path(trial.mutant.file).parts[0], "trial": kind,
            "reached": len(first.names), "by": by,
            "seconds": round(time.monotonic() - trial.begin, 1),
        })  # fmt: skip

    # -- the children ----------------------------------------------------------------------

    def _work(self, trial: Trial) -> None:
        os.setsid()
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        quiet = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(quiet, stream)
        os.environ["PYTEST_DEBUG_TEMPROOT"] = os.environ["TMPDIR"] = trial.folder
        tempfile.tempdir = trial.folder
        kind, where = trial.kind.split()
        if where == "outside":
            self._apart(trial)
        if kind != "control":
            for functions, code in self._patches(*compiled(trial.mutant)):
                for function in functions:
                    function.__code__ = code
        if kind == "simulation":
            for name in trial.names:
                trial.begins(name)
                if simulate(name):
                    os._exit(1)
        else:
            self._tests(trial)

    def _tests(self, trial: Trial) -> None:
        assert self._config is not None
        items = [self._items[name] for name in trial.names]
        for item, after in zip(items, [*items[1:], None], strict=True):
            trial.begins(item.nodeid)
            limit(SPARE + FACTOR * self._seconds.get(item.nodeid, 20.0))
            self._config.hook.pytest_runtest_protocol(item=item, nextitem=after)
            if self._failures.any:
                os._exit(1)

    def _apart(self, trial: Trial) -> None:
        """Go on as an interpreter of its own, with a tree of sources in which the mutant is."""
        sources = Path(trial.folder) / "sources"
        operators.make_tree(trial.mutant, sources)
        paths = [str(sources), str(ROOT / "tests"), str(Path(__file__).parent)]
        env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
        told = json.dumps([trial.kind, trial.names, trial.folder, trial.spare])
        os.chdir(ROOT)
        os.execve(sys.executable, [sys.executable, __file__, told], env)  # noqa: S606 - this program


def try_all(
    todo: Sequence[tuple[str, Mutant]],
    reach: Reach | None,
    processes: int,
    end: float,
    keep: Keep,
) -> None:
    """Try mutants; see `Bench`."""
    bench = Bench(todo, reach, processes, end, keep)
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    pytest.main([*OPTIONS, *folders()], plugins=[bench])


class _Noting:
    def __init__(self, trial: Trial) -> None:
        self._trial = trial

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        place = {name: i for i, name in enumerate(self._trial.names)}
        items[:] = sorted((i for i in items if i.nodeid in place), key=lambda i: place[i.nodeid])

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> None:
        self._trial.begins(item.nodeid)
        limit(SPARE + FACTOR * self._trial.spare)


def _alone(kind: str, names: list[str], folder: str, spare: float) -> int:
    """Run the trial of an interpreter of its own; 0 if nothing was found."""
    trial = Trial(kind, Mutant("", 0, 0, ""), names, spare, folder=folder)
    if kind.startswith("simulation"):
        for name in names:
            trial.begins(name)
            if simulate(name):
                return 1
        return 0
    files = sorted({name.split("::")[0] for name in names})
    return int(pytest.main([*OPTIONS, "-x", *files], plugins=[_Noting(trial)]))


# -- measuring what reaches --------------------------------------------------------------------


class _Contexts:
    def __init__(self, measure: Any) -> None:
        self._measure = measure
        self.seconds: dict[str, float] = {}

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        self._measure.switch_context(item.nodeid)
        begin = time.monotonic()
        yield
        self.seconds[item.nodeid] = round(time.monotonic() - begin, 3)


def measured(kept: Path) -> Reach | None:
    """Run all unit tests and runs of the simulation once, and return what reaches which line.

    None if the package coverage is not installed.
    """
    if importlib.util.find_spec("coverage") is None:
        return None
    import coverage  # type: ignore[import-not-found,unused-ignore]

    data = str(kept.with_suffix(".coverage"))
    measure = coverage.Coverage(data_file=data, source=[str(SOURCE)], config_file=False)
    measure.start()
    contexts = _Contexts(measure)
    pytest.main([*OPTIONS, *folders()], plugins=[contexts])
    for name, *_ in RUNS:
        measure.switch_context(name)
        if simulate(name):
            raise SystemExit(f"the simulation finds something in unchanged code: {name}")
    measure.stop()
    measure.save()
    reach = reach_of(data, contexts.seconds)
    reach.keep(kept)
    return reach


def reach_of(data: str, seconds: dict[str, float]) -> Reach:
    """Return what a file of coverage holds."""
    import coverage  # type: ignore[import-not-found,unused-ignore]

    found = coverage.CoverageData(data)
    found.read()
    lines: dict[str, dict[int, set[str]]] = {}
    for path in found.measured_files():
        file = str(Path(path).relative_to(SOURCE))
        lines[file] = {n: {*map(_name, some)} for n, some in found.contexts_by_lineno(path).items()}
    return Reach(seconds, lines)


def _name(context: str) -> str:
    return (
        context.rsplit("|", 1)[0] if context.endswith(("|run", "|setup", "|teardown")) else context
    )


if __name__ == "__main__":
    sys.exit(_alone(*json.loads(sys.argv[1])))
