"""A cluster's process whose key is replaced by commands while its plant leads it, over TCP."""

import asyncio
import contextlib
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from heliotrope.cli import main
from heliotrope.links.clock import SystemClock
from heliotrope.links.connection import CarriedLink
from heliotrope.links.keys import Keys
from heliotrope.links.link import running
from heliotrope.links.messages import ClusterStatus
from heliotrope.plant.io.links_file import read_links
from heliotrope.safety import Alarm
from support.cluster_process import KEY, Line, Plant, ended, start, until, written
from support.clusters import Board


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    made = Line(tmp_path / "bus", [Board(1), Board(2)])
    yield made
    made.end()


def links_file(folder: Path) -> Path:
    (folder / "links.keys").touch(0o600)
    (folder / "links.keys").write_text(f'[clusters]\nC1 = "{KEY.hex()}"\n')
    path = folder / "links.toml"
    path.write_text(
        'format = "heliotrope-links"\nversion = 1\nkeys = "links.keys"\n'
        '[tcp]\nlisten = "127.0.0.1:0"\n[clusters]\nC1 = "tcp"\n'
    )
    return path


def keys(monkeypatch: pytest.MonkeyPatch, *words: object) -> None:
    """Run a command; it must end well."""
    monkeypatch.setattr("sys.argv", ["heliotrope", "keys", *map(str, words)])
    with pytest.raises(SystemExit) as found:
        main()
    assert found.value.code == 0


def test_a_key_is_replaced_while_the_cluster_works(
    line: Line, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    del line

    async def main() -> None:
        clock, alarms = SystemClock(), list[Alarm]()
        found = read_links(links_file(tmp_path))
        made = found.build({"C1": ("A1", "A2")}, clock)
        assert made.server is not None
        link = made.links["C1"]
        assert isinstance(link, CarriedLink)
        async with running(*made.parts), made.papers.watched(alarms.append):
            await made.server.listening()
            process = await asyncio.to_thread(start, written(tmp_path, made.server.port))
            started.append(process)
            plant = Plant(link, clock)
            async with asyncio.TaskGroup() as group:
                tasks = [group.create_task(plant.listen()), group.create_task(plant.lease())]
                await until(plant.calm)
                plant.heard.clear()
                counts = link.statistics
                before = counts.opened, counts.dropped, counts.expired
                file, own = tmp_path / "links.keys", tmp_path / "keys.toml"
                await asyncio.to_thread(keys, monkeypatch, "rotate", file, "C1", "--to", tmp_path)
                keys(monkeypatch, "take", own, tmp_path / "C1.key.toml")
                await until(lambda: len(found.keys["C1"].keys) == 2 and not link.behind)
                keys(monkeypatch, "end", own)
                keys(monkeypatch, "end", file)
                new = Keys(file, "clusters").members["C1"]
                assert new == Keys(own, "heliostats").plant != (KEY,)
                heard = len(plant.heard)
                await until(lambda: len(plant.heard) > heard + 3)
                # Nothing was lost, and the connection is the first one.
                assert (counts.opened, counts.dropped, counts.expired) == before
                process.send_signal(signal.SIGTERM)
                await asyncio.to_thread(ended, process)
                for task in tasks:
                    task.cancel()
        statuses = [each for each in plant.heard if isinstance(each, ClusterStatus)]
        assert len(statuses) >= 4
        # No lease was late: it lasts 3 s, and comes every half second.
        assert min(each.lease_left for each in statuses) > 0.0
        assert not any(each.acts for each in statuses)
        assert not alarms

    started: list[subprocess.Popen[str]] = []
    try:
        asyncio.run(main())
    finally:
        for process in started:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            process.communicate()
