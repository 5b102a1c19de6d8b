"""Certificates: their ends are watched, and renewed ones are taken while programs run."""

import asyncio
import shutil
import ssl
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from heliotrope.errors import FormatError
from heliotrope.links.clock import SystemClock, VirtualClock
from heliotrope.links.papers import Papers, end_of
from heliotrope.links.tls import RenewedTls, client_tls, server_tls
from heliotrope.plant.io.links_file import read_links
from heliotrope.safety import Alarm
from support.papers import certificate


class Days(VirtualClock):
    """A clock set some days from now."""

    def __init__(self, days: float) -> None:
        self.days = days

    def utc(self) -> datetime:
        return datetime.now(UTC) + timedelta(days=self.days)


def test_an_alarm_comes_each_day_of_the_last_thirty(tmp_path: Path) -> None:
    pem, _ = certificate(tmp_path, 40.5)
    clock = Days(0.0)
    papers = Papers(clock)
    papers.watch_end(pem)
    assert papers.look() == []
    clock.days = 10.0
    assert papers.look() == []
    clock.days = 11.0
    (alarm,) = papers.look()
    assert (alarm.condition, alarm.subject, alarm.severity.name) == (
        "certificate",
        pem.name,
        "WARNING",
    )
    assert "UTC, in 29 days" in alarm.text
    assert papers.look() == []
    clock.days = 12.0
    over, again = papers.look()
    assert (over.active, again.active) == (False, True)
    assert "in 28 days" in again.text
    clock.days = 41.0
    _, ended = papers.look()
    assert ended.severity.name == "ALARM"
    assert "expired on" in ended.text
    # Renewed in its place.
    fresh, _ = certificate(tmp_path, 300.0)
    shutil.copy(fresh, pem)
    (over,) = papers.look()
    assert not over.active
    assert papers.lines()[0].endswith("in 258 days")


def test_what_was_renewed_is_named_once(tmp_path: Path) -> None:
    file, papers = tmp_path / "keys", Papers(Days(0.0))
    papers.renew("key file", [file], lambda: None)
    file.write_text("old")
    papers.look()
    assert papers.renewed() == []  # it is read at the start
    file.write_text("a new one")
    papers.look()
    assert papers.renewed() == ["key file"]
    papers.look()
    assert papers.renewed() == []


def test_alarms_come_while_a_block_runs_and_an_error_of_it_goes_on_as_it_came(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("heliotrope.links.papers.LOOKED", 0.01)
    papers, heard = Papers(Days(0.0)), asyncio.Queue[Alarm]()
    papers.watch_end(tmp_path / "x.pem")

    async def main() -> None:
        renewed = asyncio.Queue[str]()
        papers.renew("key file", [tmp_path / "keys"], lambda: None)
        async with papers.watched(heard.put_nowait, renewed.put_nowait):
            async with asyncio.timeout(60.0):
                assert (await heard.get()).active
                certificate(tmp_path, 100.0)[0].rename(tmp_path / "x.pem")
                assert not (await heard.get()).active
                (tmp_path / "keys").touch()
                assert await renewed.get() == "key file"
            raise KeyError("of the block")

    with pytest.raises(KeyError, match="of the block"):
        asyncio.run(main())


def test_a_file_without_a_certificate_is_an_alarm(tmp_path: Path) -> None:
    (tmp_path / "x.pem").write_text("nothing")
    papers = Papers(Days(0.0))
    papers.watch_end(tmp_path / "x.pem")
    (alarm,) = papers.look()
    assert "the expiry date of certificate" in alarm.text
    assert "holds no PEM certificate" in alarm.text
    papers.watch_end(tmp_path / "none.pem")
    (alarm,) = papers.look()
    assert "none.pem is unknown" in alarm.text
    assert "cannot be read (No such file or directory)" in alarm.text
    with pytest.raises(FormatError, match="cannot be read"):
        end_of(tmp_path / "none.pem")


def test_the_cluster_port_takes_a_renewed_certificate(tmp_path: Path) -> None:
    first, second = certificate(tmp_path, 100.0), certificate(tmp_path, 200.0)
    for path, name in zip(first, ("own.pem", "own.key"), strict=True):
        shutil.copy(path, tmp_path / name)
    keys = tmp_path / "links.keys"
    keys.touch(0o600)
    keys.write_text(f'[clusters]\nK1 = "{"2a" * 32}"\n')
    (tmp_path / "links.toml").write_text(
        'format = "heliotrope-links"\nversion = 1\nkeys = "links.keys"\n[tcp]\n'
        'listen = "127.0.0.1:0"\ncertificate = "own.pem"\nkey = "own.key"\n[clusters]\nK1 = "tcp"\n'
    )
    made = read_links(tmp_path / "links.toml").build({"K1": ("A",)}, SystemClock())
    assert made.papers.look() == []
    server = made.server
    assert server is not None

    async def shown(trusted: Path) -> bool:
        """Whether a client that trusts a certificate alone is let in."""
        try:
            async with asyncio.timeout(60.0):
                _, out = await asyncio.open_connection(
                    "127.0.0.1", server.port, ssl=client_tls(trusted)
                )
        except ssl.SSLError:
            return False
        out.close()
        return True

    async def main() -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(server.run())
            await server.listening()
            assert await shown(first[0])
            # Half of it: a certificate without its key changes nothing.
            shutil.copy(second[0], tmp_path / "own.pem")
            (alarm,) = made.papers.look()
            assert "certificate of the cluster port" in alarm.text
            assert "belong together" in alarm.text
            assert await shown(first[0])
            shutil.copy(second[1], tmp_path / "own.key")
            (over,) = made.papers.look()
            assert not over.active
            assert await shown(second[0])
            assert not await shown(first[0])
            await server.close()

    asyncio.run(main())


def test_a_context_that_cannot_be_renewed_stays(tmp_path: Path) -> None:
    pem, key = certificate(tmp_path, 100.0)
    tls = RenewedTls(lambda: server_tls(pem, key))
    before = tls()
    tls.renew()
    assert tls() is not before
    before = tls()
    key.unlink()
    with pytest.raises(Exception, match="belong together"):
        tls.renew()
    assert tls() is before
