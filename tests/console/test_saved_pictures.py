"""The pictures of a calibration as files, by `ctl`."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.cli import app
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.operations.views import CalibrationEntry, CameraView
from heliotrope.plant.visits.photographs import Shot
from support.live_console import LiveConsole

NAN, AT = float("nan"), 1_790_000_000.0
Photographs = Callable[..., Result]


def visit(console: LiveConsole, heliostat: str, at: float, photographs: int) -> None:
    """Keep a calibration with photographs a second apart; each is its own number as bytes."""
    operations = console.live.operations
    pictures, good = operations.pictures, CalibrationOutcome.CALIBRATED
    assert pictures is not None
    pictures.begin(heliostat)
    for k in range(photographs):
        view = CameraView("left", k + 1, at + k, f"{at + k:.0f}".encode(), ("read",))
        pictures.take(heliostat, view, Shot(np.zeros(3), at + k, 0.0, ()))
    end = at + photographs
    entry = CalibrationEntry(
        end, heliostat, "left", good, 1.0, 0.1, 1.0, 0.1, NAN, NAN, 4, 4, "calibrated: well", 1
    )
    pictures.conclude(entry)
    operations.automatic.book.results.append(entry)


@pytest.fixture(scope="module")
def console(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """A field with two calibrations of one heliostat, one of another, and one without pictures."""
    folder, work = tmp_path_factory.mktemp("pictures"), AutomaticSettings(wanted=False)
    made = LiveConsole(folder, 6, work=work, pictures=folder / "photographs")
    first, second, third, _ = made.live.names[:4]
    for name, at, count in ((first, AT, 3), (first, AT + 60.0, 4), (second, AT, 1), (third, AT, 0)):
        made.call(lambda name=name, at=at, count=count: visit(made, name, at, count))
    yield made
    made.close()


@pytest.fixture(params=[False, True], ids=["console", "plant"])
def photographs(
    request: pytest.FixtureRequest, console: LiveConsole, tokens: dict[str, str], tmp_path: Path
) -> Photographs:
    """Run `ctl photographs` by the console, or at the plant itself."""
    (tmp_path / "token").write_text(tokens["viewer"])
    where = ["--data", str(console.folder)] if request.param else ["--url", console.address]
    run = ["ctl", *where, "--token-file", str(tmp_path / "token"), "photographs"]
    return lambda *words: CliRunner().invoke(app, [*run, *map(str, words)])


def test_first_and_last_photograph_of_the_last_calibration(
    console: LiveConsole, photographs: Photographs, tmp_path: Path
) -> None:
    first, second = console.live.names[:2]
    found = photographs(first, "--save", tmp_path / "new" / "folder")
    assert found.exit_code == 0, (found.output, found.exception)
    files = sorted((tmp_path / "new" / "folder").iterdir())
    assert [file.name for file in files] == [
        f"{first}-20260921T141420Z-first.jpg",
        f"{first}-20260921T141423Z-last.jpg",
    ]
    assert [float(file.read_bytes()) for file in files] == [AT + 60.0, AT + 63.0]
    assert all(str(file) in found.output for file in files)
    found = photographs(second, "--save", tmp_path / "one")
    assert found.exit_code == 0, (found.output, found.exception)
    assert [float(file.read_bytes()) for file in (tmp_path / "one").iterdir()] == [AT]


def test_what_cannot_be_saved_is_said(
    console: LiveConsole, photographs: Photographs, tmp_path: Path
) -> None:
    first, _, third, fourth = console.live.names[:4]
    for words, text in (
        (("--save", tmp_path), "--save needs the name of a heliostat"),
        ((first, "--save", tmp_path / "token"), "File exists"),
        (
            (third, "--save", tmp_path / "no"),
            "no photograph from its last calibration is available",
        ),
        ((fourth, "--save", tmp_path / "no"), "no calibration result yet"),
    ):
        found = photographs(*words)
        assert text in str(found.exception), words
    assert not (tmp_path / "no").exists()
