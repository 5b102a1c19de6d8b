"""The plant file of a running plant: who may store what, what is used at once, what waits."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.formats.plant_edit import versions
from heliotrope.field.formats.plant_file import read_plant
from heliotrope.links.clock import VirtualClock
from heliotrope.plant.operations import plant_file as module
from heliotrope.plant.operations.marking import Marking
from heliotrope.plant.operations.plant_file import PlantFile
from heliotrope.plant.orders.authority import Grant, Person, RefusedError, Role
from heliotrope.plant.workers import at_once
from support.small_plant import TABLE, TOML

OPERATOR = Person("operator", Role.OPERATOR)
ENGINEER, SECOND = Person("engineer", Role.ENGINEER), Person("edda", Role.ENGINEER)
CAMERA = TOML.replace("[320.0, 240.0]", "[330.0, 240.0]").replace(
    'targets = ["target"]',
    "position_m = [0.0, -30.0, 2.0]\nrotation = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]\n"
    'targets = ["target"]',
)
MARK = TOML.replace("at_m = [-1.0, 0.0, 13.0]", "at_m = [-1.1, 0.0, 13.0]")
TARGET = TOML.replace("width_m = 3", "width_m = 4")


@dataclass
class Eyes:
    """The camera of the target, and the views that it was given."""

    camera: Any
    taken: list[tuple[Any, Any]] = field(default_factory=list)

    def eye(self, target: str) -> Any:
        if target != "target":
            raise UnknownNameError("target with a camera", target, ["target"])
        return self.camera

    def take_view(self, camera: Any, target: Any, pictures: Any) -> None:
        del pictures
        self.camera = camera
        self.taken.append((camera, target))


class Scene:
    """A controller with an audit, a logbook, a store and a camera."""

    def __init__(self, folder: Path, approval: bool = False) -> None:
        (folder / "field.csv").write_text(TABLE)
        self.file = folder / "plant.toml"
        self.file.write_text(TOML + "[approval]\nparameters = true\n" * approval)
        self.text = self.file.read_text()
        design = read_plant(self.file)
        self.audit: list[tuple[str, str]] = []
        self.told: list[str] = []
        self.visits: dict[str, str] = {}
        self.document, self.seconds = "", 0.0
        self.eyes = Eyes(replace(design.cameras[0], source="http://twin/eye.png"))
        self.plant = SimpleNamespace(
            design=design,
            clock=VirtualClock(lambda: self.seconds),
            note=lambda who, what, text: self.audit.append((who.name, text)),
            authority=SimpleNamespace(grant=None),
        )
        self.begin()

    def begin(self) -> None:
        """Start the plant's program, again."""
        log = SimpleNamespace(event=lambda kind, who, text: self.told.append(text))
        self.marking = Marking(self.eyes, self.plant, log)  # type: ignore[arg-type]
        self.here = PlantFile(
            self.file,
            self.plant,
            log,
            self.marking,
            lambda: self.visits,
            at_once,
            self,  # type: ignore[arg-type]
        )
        self.here.recall()

    def waiting_changes(self, kind: str) -> str:
        assert kind == "plant file"
        return self.document

    def keep_waiting_changes(self, kind: str, document: str) -> None:
        self.document = document

    def command(self, person: Person) -> None:
        self.plant.authority.grant = Grant(person, 1, 0.0, 0.0)

    def store(self, text: str, person: Person = ENGINEER, reason: str = "survey") -> Any:
        async def go() -> Any:
            view = await self.here.view(ENGINEER)
            return await self.here.store(person, text, view.version, reason)

        return asyncio.run(go())

    def view(self) -> Any:
        return asyncio.run(self.here.view(ENGINEER))


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path)


def test_a_moved_target_takes_effect_at_the_restart(scene: Scene) -> None:
    done = scene.store(TARGET)
    assert done.text == "plant file stored, takes effect when the plant restarts: targets target"
    assert scene.file.read_text() == TARGET
    assert not scene.eyes.taken
    (one,) = scene.view().differs
    assert (one.table, one.name, one.keys) == ("targets", "target", ("width_m",))
    (version,) = versions(scene.file)
    assert done.version == version.name
    assert "engineer: targets target (survey)" in version.note
    assert asyncio.run(scene.here.stored(ENGINEER, version.name)) == TOML
    assert scene.audit == [
        ("engineer", "engineer: targets target; takes effect when the plant restarts (survey)")
    ]
    assert scene.told == [f"{done.text} (survey)"]
    scene.begin()
    assert not scene.view().differs


@pytest.mark.parametrize("text", [CAMERA, MARK], ids=["camera", "mark"])
def test_views_and_marks_are_used_at_once(scene: Scene, text: str) -> None:
    with pytest.raises(RefusedError, match="take command first"):
        scene.store(text)
    scene.command(SECOND)
    with pytest.raises(RefusedError, match="edda has it"):
        scene.store(text)
    scene.command(ENGINEER)
    scene.visits = {"target": "A1"}
    with pytest.raises(InputError, match="heliostat A1 is on target target"):
        scene.store(text)
    assert scene.file.read_text() == TOML
    assert (scene.audit, scene.told, scene.eyes.taken) == ([], [], [])
    scene.visits = {}
    done = scene.store(text)
    assert "takes effect immediately" in done.text
    assert not scene.view().differs
    new = read_plant(scene.file)
    ((camera, target),) = scene.eyes.taken
    assert camera.source == "http://twin/eye.png"  # frames come from where they came
    assert np.allclose(camera.matrix, new.cameras[0].matrix)
    assert np.allclose(target.marks[0].point, new.targets[0].marks[0].point)
    # What is used is compared from now on: the old view again is a change, used at once.
    if text == MARK:
        scene.store(TOML)
        assert np.allclose(scene.eyes.taken[-1][1].marks[0].point, [-1.0, 0.0, 13.0])


@pytest.mark.parametrize(
    "text",
    [
        MARK.replace("width_m = 3", "width_m = 4"),
        CAMERA.replace("[640, 480]", "[800, 600]"),
        CAMERA.replace('"eye"', '"east"'),
        TOML.replace("[320.0, 240.0]", "[330.0, 240.0]"),  # not located: it finds its own view
    ],
    ids=["with the target", "with the size", "another camera", "no position"],
)
def test_a_mixture_is_never_used(scene: Scene, text: str) -> None:
    scene.command(ENGINEER)
    assert not asyncio.run(scene.here.check(ENGINEER, text)).at_once
    assert "when the plant restarts" in scene.store(text).text
    assert not scene.eyes.taken
    # Nor is a view that comes on top of what waits for the restart.
    after = text.replace("at_m = [-1.0", "at_m = [-1.2").replace("at_m = [-1.1", "at_m = [-1.2")
    assert "when the plant restarts" in scene.store(after).text
    assert not scene.eyes.taken


def test_only_a_good_text_of_an_engineer_with_a_reason_is_stored(scene: Scene) -> None:
    with pytest.raises(RefusedError, match="needs engineer"):
        scene.store(TARGET, OPERATOR)
    with pytest.raises(RefusedError, match="a reason is needed"):
        scene.store(TARGET, reason=" ")
    with pytest.raises(InputError, match=r"line 19: .*-3: .*nothing was stored"):
        scene.store(TOML.replace("width_m = 3", "width_m = -3"))
    with pytest.raises(InputError, match="the same as the current file"):
        scene.store(TOML)
    with pytest.raises(InputError, match="has changed since you opened it"):
        asyncio.run(scene.here.store(ENGINEER, TARGET, "0" * 12, "survey"))
    for call in (scene.here.view(OPERATOR), scene.here.check(OPERATOR, TOML)):
        with pytest.raises(RefusedError, match="needs engineer"):
            asyncio.run(call)
    for name in ("../..", "2020"):
        with pytest.raises(UnknownNameError, match="stored version"):
            asyncio.run(scene.here.stored(ENGINEER, name))
    assert scene.file.read_text() == TOML
    assert (versions(scene.file), scene.audit) == ([], [])


def test_a_file_that_cannot_be_written_changes_nothing(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, "store_text", full)
    scene.command(ENGINEER)
    with pytest.raises(InputError, match=r"cannot be written \(No space left.*nothing was changed"):
        scene.store(MARK)
    assert scene.file.read_text() == TOML
    assert (scene.eyes.taken, scene.told) == ([], [])
    monkeypatch.undo()
    assert "takes effect immediately" in scene.store(MARK).text


def test_a_caller_who_leaves_does_not_leave_half_of_it(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene.command(ENGINEER)
    store: Callable[..., str] = module.store_text

    async def go() -> None:
        loop, writing = asyncio.get_running_loop(), asyncio.Event()

        def slow(*given: Any, **more: Any) -> str:
            loop.call_soon_threadsafe(writing.set)
            kept = store(*given, **more)
            asyncio.run_coroutine_threadsafe(asyncio.sleep(0.05), loop).result(10.0)
            return kept

        monkeypatch.setattr(module, "store_text", slow)
        version = (await scene.here.view(ENGINEER)).version
        task = asyncio.ensure_future(scene.here.store(ENGINEER, MARK, version, "survey"))
        await writing.wait()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(go())
    assert scene.file.read_text() == MARK
    assert len(scene.eyes.taken) == 1
    assert "takes effect immediately" in scene.told[-1]


def test_where_the_file_asks_for_it_a_second_engineer_approves(tmp_path: Path) -> None:
    scene = Scene(tmp_path, approval=True)
    text = scene.text.replace("width_m = 3", "width_m = 4")
    # Not even the table that asks for the approval can be removed alone.
    assert scene.store(TARGET).version == ""
    waits = scene.view().waiting
    assert "-parameters = true" in waits.difference
    scene.here.withdraw(ENGINEER, waits.number)
    assert scene.view().waiting is None
    scene.store(text)
    assert scene.file.read_text() == scene.text
    with pytest.raises(RefusedError, match=r"change \d+ of engineer is waiting"):
        scene.store(TARGET, SECOND)
    scene.begin()  # it outlives a restart
    number = scene.view().waiting.number
    with pytest.raises(RefusedError, match="another engineer must decide"):
        asyncio.run(scene.here.approve(ENGINEER, number))
    with pytest.raises(RefusedError, match="can only refuse it"):
        scene.here.withdraw(SECOND, number)
    with pytest.raises(RefusedError, match="needs engineer"):
        scene.here.refuse(OPERATOR, number, "no")
    with pytest.raises(UnknownNameError):
        asyncio.run(scene.here.approve(SECOND, number + 1))
    done = asyncio.run(scene.here.approve(SECOND, number))
    assert "when the plant restarts" in done.text
    assert scene.file.read_text() == text
    assert "engineer, approved by edda: targets target (survey)" in versions(scene.file)[0].note
    assert (scene.view().waiting, scene.document) == (None, "")


def test_a_waiting_text_is_refused_or_lapses_and_never_overwrites(tmp_path: Path) -> None:
    scene = Scene(tmp_path, approval=True)
    text = scene.text.replace("width_m = 3", "width_m = 4")
    scene.store(text)
    scene.here.refuse(SECOND, scene.view().waiting.number, "look again")
    assert "refused by edda: look again" in scene.told[-1]
    scene.store(text)
    # Somebody edits the file on the plant's computer meanwhile.
    scene.file.write_text(scene.text + "# surveyed\n")
    with pytest.raises(InputError, match="has changed since"):
        asyncio.run(scene.here.approve(SECOND, scene.view().waiting.number))
    scene.seconds += 28_801.0
    scene.here.step()
    assert scene.view().waiting is None
    assert "nobody approved it by" in scene.told[-1]
    assert scene.file.read_text() == scene.text + "# surveyed\n"


def test_a_plant_without_a_file_says_so(scene: Scene) -> None:
    here = PlantFile(
        None,
        scene.plant,
        SimpleNamespace(),
        None,
        dict,
        at_once,
        None,  # type: ignore[arg-type]
    )
    here.recall()
    with pytest.raises(InputError, match=r"start it with heliotrope run PLANT\.toml"):
        asyncio.run(here.view(ENGINEER))
