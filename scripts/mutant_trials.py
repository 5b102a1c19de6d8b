"""How mutants are tried: children of one process that has collected the tests and imported all.

`Bench` is a plugin of pytest. Instead of running the tests that were collected it forks a child
for each trial, plants the mutant in the child's memory by exchanging the code of one function, and
runs the tests, or the simulation, that feel it. A mutant outside functions, or in one that runs
at import, gets a tree of sources and an interpreter of its own. A pass with probes for the whole
sample, in a child too, tells first which tests and runs feel each mutant (`mutant_probes.py`).
"""

import ast
import contextlib
import gc
import hashlib
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
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import mutant_operators as operators
import mutant_probes as probes
import pytest
from mutant_operators import ROOT, SOURCE, Mutant

#: Runs of the simulation: name, seed, worlds, mean time between two faults, length, s.
RUNS: tuple[tuple[str, int, tuple[str, ...], float, float], ...] = (
    ("tour 2", 2, ("tour",), 12.0, 300.0),
    ("usual 41", 41, (), 12.0, 180.0),
    ("calm 11", 11, ("calm",), 60.0, 180.0),
    ("calm 42", 42, ("calm",), 30.0, 180.0),
    ("swarm 21", 21, ("swarm",), 12.0, 180.0),
    ("site 61", 61, ("site",), 12.0, 180.0),
    ("visits 71", 71, ("visits",), 60.0, 180.0),
    ("lights 72", 72, ("lights",), 60.0, 180.0),
    ("day 73", 73, ("day", "visits"), 60.0, 180.0),
    ("calibrations 74", 74, ("calm", "calibrations", "parameters"), 30.0, 180.0),
    ("sensors 75", 75, ("calm", "sensors", "disk"), 30.0, 180.0),
    ("place 76", 76, ("calm", "place"), 30.0, 180.0),
    ("parties 80", 80, ("calm", "parties"), 120.0, 300.0),
    ("parties 104", 104, ("parties",), 12.0, 360.0),
)
HELIOSTATS = 3
#: Tests of one mutant together, at most, s; those left over are not run. What an interpreter of
#: its own may take before the first, s.
MOST_TESTS, START = 10.0, 10.0
#: Tests in other folders than the packages' own that feel what those leave: records that are kept,
#: corners, zeros and predictions asked for over the console, and whole plants of the twin. Tests
#: with browsers or programs of their own feel nothing here.
BESIDE = (
    "console/test_admission.py", "console/test_connections.py", "console/test_marking.py",
    "console/test_outlook_page.py", "console/test_parameters.py", "console/test_zero.py",
    "optics/test_standing.py", "store/test_kept_alarms.py", "store/test_kept_audit.py",
    "twin/test_live.py", "twin/test_parts.py", "test_pages.py",
)  # fmt: skip
#: The tests that read every constant and every default.
READER = "tests/test_pages.py"
#: Tests that run the code in another interpreter, where no mutant is.
ELSEWHERE = ("--ignore-glob=*micropython*",)
#: Time of the processor after which a test or a run hangs: this and so much more than it takes
#: unchanged; of a run; wall time for those that wait for ever, on a machine that does more. s.
SPARE, FACTOR, RUN_LIMIT, WALL = 5.0, 1.5, 30.0, 300.0
#: What finds a mutant with which the sources cannot be imported, so that no test or run begins.
IMPORT = "import"
#: Takes the line of a mutant that was tried.
Keep = Callable[[dict[str, Any]], None]
OPTIONS = ("-q", "-s", "-m", "not slow", "-p", "no:cacheprovider", "-p", "no:terminalreporter")


def folders() -> list[str]:
    """Return the folders and files of the unit tests."""
    return [str(ROOT / "tests" / each) for each in (*operators.PACKAGES, *BESIDE)]


def _file(test: str) -> str:
    return test.partition("::")[0]


def limit(seconds: float) -> None:
    """End this process by a signal once it has computed for this long."""
    signal.setitimer(signal.ITIMER_PROF, seconds)


def simulate(name: str) -> bool:
    """Run the simulation; True if it found something."""
    from heliotrope.twin.world.simulation import RunPlan, run

    limit(RUN_LIMIT)
    seed, worlds, pause, seconds = next(each[1:] for each in RUNS if each[0] == name)
    good = run(RunPlan(seed, seconds, HELIOSTATS, pause, worlds=worlds)).good
    limit(0.0)
    return not good


# -- what feels a mutant ----------------------------------------------------------------------


def stamps() -> dict[str, str]:
    """Return a checksum of each file of tests, and as "" one of all that they share."""
    shared, found = hashlib.sha256(), {}
    for folder in (SOURCE, ROOT / "tests"):
        for path in sorted(folder.rglob("*.py")):
            if path.name.startswith("test_"):
                name = path.relative_to(ROOT).as_posix()
                found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
            else:
                shared.update(path.read_bytes())
    return {"": shared.hexdigest(), **found}


@dataclass
class Reach:
    """Which tests and which runs of the simulation can notice a mutant.

    Attributes
    ----------
    seconds
        Time of the processor of each test and run.
    executed, felt
        Names of the tests and runs that execute the mutant of a key, and that feel it.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    executed: dict[str, set[str]] = field(default_factory=dict)
    felt: dict[str, set[str]] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> "Reach":
        """Read what `keep` wrote, but for the tests of files that have changed since.

        It is empty if it is not there, or if the sources or what tests share have changed.
        """
        told = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        before, now = told.get("files", {}), stamps()
        if before.get("") != now[""]:
            return cls()
        seconds = {
            name: each
            for name, each in told["seconds"].items()
            if "::" not in name or before.get(_file(name)) == now.get(_file(name))
        }
        executed, felt = (
            {key: seconds.keys() & names for key, names in told[which].items()}
            for which in ("executed", "felt")
        )
        return cls(seconds, executed, felt)

    def keep(self, path: Path) -> None:
        """Write to a file."""
        executed, felt = (
            {key: sorted(names) for key, names in some.items()}
            for some in (self.executed, self.felt)
        )
        told = {"files": stamps(), "seconds": self.seconds, "executed": executed, "felt": felt}
        path.write_text(json.dumps(told), encoding="utf-8")

    def begin(self, mutants: Sequence[Mutant]) -> None:
        """Prepare to note what feels some mutants; forget everything where one of them is new."""
        if any(each.key not in self.felt for each in mutants):
            self.seconds = {}
        for by in (self.executed, self.felt):
            kept = {each.key: by.get(each.key, set()) & self.seconds.keys() for each in mutants}
            by.clear()
            by.update(kept)
        probes.taken()

    def note(self, mutants: Sequence[Mutant], name: str, seconds: float) -> None:
        """Note what a test or run has executed and felt."""
        self.seconds[name] = round(seconds, 3)
        for numbers, by in zip(probes.taken(), (self.executed, self.felt), strict=True):
            for number in numbers:
                by[mutants[number].key].add(name)


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
    executed: int = 0
    computed: float = 0.0

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
    sample
        All mutants of the sample.
    todo
        Kinds of trials, "unit" or "simulation", and mutants.
    kept
        File of what feels the sample; measured first where it is not known.
    processes
        Children at once.
    end
        Begin no trial after this, s of the monotonic clock.
    keep
        Takes the line of each trial.
    """

    def __init__(
        self,
        sample: Sequence[Mutant],
        todo: Sequence[tuple[str, Mutant]],
        kept: Path,
        processes: int,
        end: float,
        keep: Keep,
    ) -> None:
        self._sample, self._todo = sample, list(todo)
        self._kept, self._processes, self._end, self._keep = kept, processes, end, keep
        self._reach = Reach.read(kept)
        self._at_import = probes.called_outside_functions()
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
        known = self._reach.seconds.keys() >= self._items.keys() | self._kills.keys()
        if not known or any(each.key not in self._reach.felt for each in self._sample):
            self._measure(self._sample)
        while self._fill() or self._running:
            self._reap()
        return True

    def _stop(self, *_: object) -> None:
        for pid in self._running:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)
        os._exit(1)

    # -- the pass with probes --------------------------------------------------------------

    def _measure(self, mutants: Sequence[Mutant]) -> None:
        """Run the tests and runs of which nothing is known once with probes, in a child."""
        child = os.fork()
        if child == 0:
            try:
                self._probe(mutants)
            except BaseException as error:  # noqa: BLE001 - whatever it is, the child ends here
                print(f"the pass with probes failed: {error!r}", file=sys.stderr, flush=True)
                os._exit(1)
            os._exit(0)
        self._running[child] = Trial("probes inside", mutants[0], [], 0.0)
        status = os.waitpid(child, 0)[1]
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # what a test left running
        shutil.rmtree(self._running.pop(child).folder, ignore_errors=True)
        if status != 0:
            raise SystemExit("the pass with probes failed")
        self._reach = Reach.read(self._kept)

    def _probe(self, mutants: Sequence[Mutant]) -> None:
        os.setsid()
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        probes.install()
        for file, tree in probes.probed(mutants).items():
            path = SOURCE / file
            plain = compile(path.read_text(encoding="utf-8"), str(path), "exec", dont_inherit=True)
            new = compile(tree, str(path), "exec", dont_inherit=True)
            for found in filter(None, map(self._patch, changes(plain, new))):
                for function in found[0]:
                    function.__code__ = found[1]
        assert self._config is not None
        self._reach.begin(mutants)
        for name in [each for each in self._kills if each not in self._reach.seconds]:
            begin = time.process_time()
            if simulate(name):
                raise SystemExit(f"the simulation finds something in unchanged code: {name}")
            self._reach.note(mutants, name, time.process_time() - begin)
        items = [each for name, each in self._items.items() if name not in self._reach.seconds]
        for item, after in zip(items, [*items[1:], None], strict=True):
            begin = time.process_time()
            self._config.hook.pytest_runtest_protocol(item=item, nextitem=after)
            self._reach.note(mutants, item.nodeid, time.process_time() - begin)
            if self._failures.any:
                print(f"fails unchanged, with probes: {item.nodeid}", file=sys.stderr, flush=True)
                self._failures.any = False
        self._reach.keep(self._kept)

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
        """Plan a trial; what nothing feels is told at once."""
        plain, new = compiled(mutant)
        if _same(plain, new):
            return
        chain = probes.chain_to(
            ast.parse((SOURCE / mutant.file).read_text(encoding="utf-8")), mutant.place
        )
        function = probes.function_of(chain)
        felt, executed = self._reach.felt[mutant.key], self._reach.executed[mutant.key]
        words = [] if function else probes.words(chain)
        naming = set() if function else self._naming([each for each in words if each.isupper()])
        felt, executed = felt | naming, executed | naming
        if not function and not words:
            felt = executed = self._own(mutant) | set(self._kills)
        inside = function and function not in self._at_import and self._patches(plain, new)
        if kind == "unit":
            names, spare = self._shortest(mutant, felt & set(self._items), naming)
        else:
            names = sorted(felt & set(self._kills), key=self._worth, reverse=True)
            spare = 10.0 * len(names)
        trial = Trial(f"{kind} {'inside' if inside else 'outside'}", mutant, names, spare)
        trial.executed = len(executed & set(self._kills if kind == "simulation" else self._items))
        if names:
            self._ready.append(trial)
        else:
            self._tell(trial, kind, "")

    def _worth(self, run: str) -> float:
        """Return how much a run finds for its time."""
        chance = (self._kills[run] + 1.0) / (self._tries[run] + 2.0)
        return chance / max(0.1, self._reach.seconds.get(run, 1.0))

    def _own(self, mutant: Mutant) -> set[str]:
        """Return the tests of a mutant's package."""
        starts = f"tests/{Path(mutant.file).parts[0]}/", READER
        return {name for name in self._items if name.startswith(starts)}

    def _naming(self, words: Sequence[str]) -> set[str]:
        """Return the tests of files that name a constant: they may read it without a function."""
        good = {READER}
        if words:
            wanted = re.compile(rf"\b({'|'.join(map(re.escape, words))})\b")
            files = {_file(name) for name in self._items}
            good |= {f for f in files if wanted.search((ROOT / f).read_text(encoding="utf-8"))}
        return {name for name in self._items if _file(name) in good}

    def _shortest(
        self, mutant: Mutant, tests: set[str], first: Collection[str] = ()
    ) -> tuple[list[str], float]:
        """Return tests, the shortest first, and the time that they take.

        Those of a file with the module's name, and those given as first, come before all others.
        Of another test with parameters one comes first, and the others after all tests had their
        turn: they mostly find the same.
        """
        seconds = self._reach.seconds
        own = f"tests/{Path(mutant.file).parts[0]}/"
        noun = Path(mutant.file).stem.strip("_")

        def near(name: str) -> bool:
            return noun in _file(name) or name in first

        def worth(name: str) -> float:
            far = 1.0 if own in name else 2.0
            return seconds.get(name, 1.0) * (0.1 if near(name) else far)

        order = sorted(tests - self._flaky, key=worth)
        turns = Counter[str]()
        turn = {}
        for name in order:
            turn[name] = 0 if near(name) else min(2, turns[name.split("[")[0]])
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
        found = [self._patch(each) for each in changes(plain, new)]
        return [] if None in found else [each for each in found if each is not None]

    def _patch(
        self, change: tuple[CodeType, CodeType] | None
    ) -> tuple[list[FunctionType], CodeType] | None:
        if change is None:
            return None
        one, two = change
        live = self._functions.get((one.co_filename, one.co_firstlineno, one.co_qualname))
        return (live, two) if live and one.co_freevars == two.co_freevars else None

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
        child, status, used = os.wait4(-1, os.WNOHANG)
        if child:
            self._running[child].computed += used.ru_utime + used.ru_stime
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
        if not (good or found):
            self._tell(trial, kind, IMPORT)
        elif kind == "unit" and not good:
            # The same test on the unchanged code: does it fail by itself, on this machine, now?
            self._ready.insert(0, Trial("control inside", trial.mutant, [found], 60.0, then=trial))
        elif kind == "control" and not good:
            self._flaky.update(trial.names)
            first = trial.then
            assert first is not None
            left = [name for name in first.names if name not in self._flaky]
            again = Trial(first.kind, first.mutant, left, first.spare, executed=first.executed)
            again.computed = first.computed + trial.computed
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
            "executed": first.executed, "felt": len(first.names), "by": by,
            "seconds": round(trial.computed + (first.computed if trial.then else 0.0), 1),
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
        begin = time.process_time()
        for item, after in zip(items, [*items[1:], None], strict=True):
            if time.process_time() - begin > MOST_TESTS:
                return
            trial.begins(item.nodeid)
            limit(SPARE + FACTOR * self._reach.seconds.get(item.nodeid, 20.0))
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
    sample: Sequence[Mutant],
    todo: Sequence[tuple[str, Mutant]],
    kept: Path,
    processes: int,
    end: float,
    keep: Keep,
) -> None:
    """Try mutants; see `Bench`."""
    bench = Bench(sample, todo, kept, processes, end, keep)
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    # Tests that compute as they are imported would start threads, which a fork does not have.
    os.environ["HELIOTROPE_THREADS"] = "1"
    pytest.main([*OPTIONS, *ELSEWHERE, *folders()], plugins=[bench])


class _Noting:
    def __init__(self, trial: Trial) -> None:
        self._trial = trial

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        place = {name: i for i, name in enumerate(self._trial.names)}
        items[:] = sorted((i for i in items if i.nodeid in place), key=lambda i: place[i.nodeid])

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> bool | None:
        if time.process_time() > START + MOST_TESTS:
            return True  # done with: it is left out, and the session ends as if nothing was found
        self._trial.begins(item.nodeid)
        limit(SPARE + FACTOR * self._trial.spare)
        return None


def _alone(kind: str, names: list[str], folder: str, spare: float) -> int:
    """Run the trial of an interpreter of its own; 0 if nothing was found."""
    trial = Trial(kind, Mutant("", 0, 0, ""), names, spare, folder=folder)
    if kind.startswith("simulation"):
        for name in names:
            trial.begins(name)
            if simulate(name):
                return 1
        return 0
    files = sorted(set(map(_file, names)))
    return int(pytest.main([*OPTIONS, "-x", *files], plugins=[_Noting(trial)]))


if __name__ == "__main__":
    sys.exit(_alone(*json.loads(sys.argv[1])))
