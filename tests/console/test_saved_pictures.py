"""The pictures of a calibration as files, by `ctl`."""

import io
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from PIL import Image
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.orders.authority import Person, Role
from support.live_console import LiveConsole


@pytest.fixture(scope="module")
def console(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """A small field at sixteen times the speed of real time."""
    made = LiveConsole(
        tmp_path_factory.mktemp("pictures"), 6, speed=16.0, work=AutomaticSettings(wanted=True)
    )
    yield made
    made.close()


@pytest.mark.parametrize("data", [False, True])
def test_first_and_last_photograph_of_a_calibration(
    console: LiveConsole, tokens: dict[str, str], tmp_path: Path, data: bool
) -> None:
    operations, name = console.live.operations, console.live.names[2]
    if not data:
        console.call(lambda: operations.calibrate(Person("operator", Role.OPERATOR), name))
    console.until(lambda: operations.viewer.heliostat(name).results)
    (tmp_path / "token").write_text(tokens["viewer"])
    where = ["--data", str(console.folder)] if data else ["--url", console.address]
    run = ["ctl", *where, "--token-file", str(tmp_path / "token"), "photographs"]
    found = CliRunner().invoke(app, [*run, name, "--save", str(tmp_path / "new" / "folder")])
    assert found.exit_code == 0, (found.output, found.exception)
    files = sorted((tmp_path / "new" / "folder").iterdir())
    assert [file.name.rpartition("-")[2] for file in files] == ["first.jpg", "last.jpg"]
    assert all(str(file) in found.output for file in files)
    headers = {"Authorization": f"Bearer {tokens['viewer']}"}
    with httpx.Client(base_url=f"{console.address}api/v1/", headers=headers) as client:
        kept = client.get("photographs", params={"heliostat": name}).json()
        shown = [client.get(f"photographs/{one['identity']}").content for one in kept]
    for file in files:
        assert file.read_bytes() in shown
        assert Image.open(io.BytesIO(file.read_bytes())).format == "JPEG"
    none = CliRunner().invoke(app, [*run, "--save", str(tmp_path)])
    assert "--save needs the heliostat" in str(none.exception)
    unwritable = CliRunner().invoke(app, [*run, name, "--save", str(tmp_path / "token")])
    assert "File exists" in str(unwritable.exception)


def test_what_was_never_calibrated_has_no_pictures(
    console: LiveConsole, tokens: dict[str, str], tmp_path: Path
) -> None:
    results = {
        name: console.call(lambda name=name: console.live.operations.viewer.heliostat(name).results)
        for name in console.live.names
    }
    name = next((name for name, known in results.items() if not known), "")
    if not name:
        pytest.skip("all of them have been calibrated meanwhile")
    (tmp_path / "token").write_text(tokens["viewer"])
    run = ["ctl", "--url", console.address, "--token-file", str(tmp_path / "token"), "photographs"]
    found = CliRunner().invoke(app, [*run, name, "--save", str(tmp_path / "out")])
    assert "has no result of a calibration yet" in str(found.exception)
