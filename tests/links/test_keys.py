"""Keys of links: made by a command, and replaced while the links run."""

import asyncio
import contextlib
import os
import stat
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from heliotrope.cli import main
from heliotrope.cluster.config_file import read_cluster
from heliotrope.errors import FormatError, InputError
from heliotrope.links.clock import SystemClock
from heliotrope.links.connection import CarriedLink
from heliotrope.links.keys import CLUSTERS, HELIOSTATS, KeyFile, KeyRing, Keys, fingerprint
from heliotrope.links.link import LinkSettings, SendOutcome, running
from heliotrope.links.mqtt import Broker, _MqttCarrier, mqtt_link
from heliotrope.links.papers import Papers
from heliotrope.links.tcp import TcpServer, tcp_link
from heliotrope.plant.io.links_file import read_links
from support.broker import Mosquitto, mosquitto_for

OLD, NEW = b"o" * 32, b"n" * 32
PATIENCE = 60.0
QUICK = LinkSettings(period=0.05, deadline=5.0, first_pause=0.02, longest_pause=0.1)
CLOCK = SystemClock()


def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: str) -> str:
    """Return what a command prints; it must end well."""
    monkeypatch.setattr("sys.argv", ["heliotrope", *words])
    with pytest.raises(SystemExit) as found:
        main()
    said = capsys.readouterr()
    assert found.value.code == 0, said.err
    return said.out


def private(path: Path, text: str = "") -> Path:
    path.touch(0o600)
    path.write_text(text)
    return path


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


async def until(holds: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not holds():
            await asyncio.sleep(0.01)


# -- files -------------------------------------------------------------------------------


def test_new_keys_are_private_and_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "links.keys.toml"
    file = KeyFile(path)
    made = file.new(["K1", "K2"])
    assert mode(path) == 0o600
    assert Keys(path, CLUSTERS).members == {name: (key,) for name, key in made.items()}
    assert len(set(made.values())) == 2
    with pytest.raises(InputError, match="cluster K2 already has a key; to replace it while"):
        KeyFile(path).new(["K3", "K2"])
    assert set(Keys(path, CLUSTERS).members) == {"K1", "K2"}


def test_names_that_no_link_takes_get_no_key(tmp_path: Path) -> None:
    path = tmp_path / "links.keys.toml"
    for name in ("", 65 * "K", 33 * "é"):
        with pytest.raises(InputError, match="a name has 1 to 64 bytes"):
            KeyFile(path).new(["K1", name])
        assert not path.exists()
    assert set(KeyFile(path).new(["K", 64 * "K"])) == {"K", 64 * "K"}


def test_a_key_file_that_root_changes_keeps_its_owner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = private(tmp_path / "links.keys.toml")
    there, given = path.stat(), []
    monkeypatch.setattr(os, "geteuid", lambda: there.st_uid + 1)
    monkeypatch.setattr(os, "fchown", lambda _, *owner: given.append(owner))
    KeyFile(path).new(["K1"])
    assert given == [(there.st_uid, there.st_gid)]


def test_a_rotation_keeps_passwords_and_the_keys_of_others(tmp_path: Path) -> None:
    before = f'plant = "{NEW.hex()}"\npassword = "word"\n[heliostats]\nA1 = "{"2a" * 32}"\n'
    path = private(tmp_path / "C1.keys.toml", before)
    KeyFile(path).take(OLD)
    found = Keys(path, HELIOSTATS)
    assert (found.plant, found.password) == ((OLD, NEW), "word")
    assert found.members == {"A1": (b"*" * 32,)}
    assert KeyFile(path).end([]) == ["plant"]
    assert Keys(path, HELIOSTATS).plant == (OLD,)
    with pytest.raises(
        InputError, match="this is a cluster's key file; create keys in the plant's"
    ):
        KeyFile(path).new(["K1"])


def test_two_commands_at_once_lose_no_key(tmp_path: Path) -> None:
    """The second one would write the file without the key that the first has made."""
    file = tmp_path / "keys.toml"
    KeyFile(file).new(["C1", "C2"])
    one, two = KeyFile(file), KeyFile(file)
    one.rotate(["C1"])
    with pytest.raises(InputError, match="another command has changed the file in the meantime"):
        two.rotate(["C2"])
    assert [len(KeyFile(file).links[name]) for name in ("C1", "C2")] == [2, 1]
    one.end(["C1"])  # it knows what it has written itself
    two = KeyFile(file)
    two.rotate(["C2"])
    assert len(KeyFile(file).links["C2"]) == 2


def test_of_many_commands_at_once_each_is_done_or_refused(tmp_path: Path) -> None:
    file, names = tmp_path / "keys.toml", [f"C{i}" for i in range(8)]
    KeyFile(file).new(names)
    ready = [(name, KeyFile(file)) for name in names for _ in range(2)]
    begin = threading.Barrier(len(ready))
    done: list[str] = []

    def rotate(name: str, keys: KeyFile) -> None:
        begin.wait()
        with contextlib.suppress(InputError):
            keys.rotate([name])
            done.append(name)

    works = [threading.Thread(target=rotate, args=each) for each in ready]
    for work in works:
        work.start()
    for work in works:
        work.join()
    links = KeyFile(file).links
    assert done
    assert {name for name in names if len(links[name]) == 2} == set(done)


def test_a_third_key_is_refused_and_so_is_an_end_without_a_new_one(tmp_path: Path) -> None:
    path = private(tmp_path / "keys", f'[clusters]\nK1 = "{OLD.hex()}"\n')
    file = KeyFile(path)
    with pytest.raises(
        InputError, match="K1 has an old key that a new one replaces; there is nothing to end"
    ):
        file.end(["K1"])
    (new,) = file.rotate(["K1"]).values()
    with pytest.raises(InputError, match="K1 already has two keys; run heliotrope keys end"):
        file.rotate(["K1"])
    with pytest.raises(InputError, match="K2 has no key; run heliotrope keys new"):
        file.rotate(["K2"])
    assert file.end(["K1"]) == ["K1"]
    assert Keys(path, CLUSTERS).members == {"K1": (new,)}


@pytest.mark.parametrize(
    ("text", "refusal"),
    [
        (
            f'[clusters]\nK1 = ["{"aa" * 32}", "{"bb" * 32}", "{"cc" * 32}"]',
            "found 3 keys; specify 1 to 2",
        ),
        (f'[clusters]\nK1 = ["{"aa" * 32}", "{"aa" * 32}"]', "a key occurs twice"),
        ("[clusters]\nK1 = []", "found 0 keys; specify 1 to 2"),
    ],
)
def test_lists_of_keys_that_make_no_sense_are_refused(
    text: str, refusal: str, tmp_path: Path
) -> None:
    with pytest.raises(FormatError, match=refusal):
        Keys(private(tmp_path / "keys", text), CLUSTERS)


def test_keys_go_from_plant_to_cluster_by_commands(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    plant, cluster = tmp_path / "links.keys.toml", tmp_path / "C1.keys.toml"
    carried = tmp_path / "C1.key.toml"
    run(capsys, monkeypatch, "keys", "new", str(plant), "C1", "C2", "--to", str(tmp_path))
    assert mode(carried) == mode(plant) == 0o600
    # A carried key that was left there is not overwritten, and nothing else happens.
    monkeypatch.setattr("sys.argv", ["heliotrope", "keys", "rotate", str(plant), "C1", "--to",
                                     str(tmp_path)])  # fmt: skip
    with pytest.raises(SystemExit):
        main()
    assert (
        "C1.key.toml: the file already exists, and keys are never overwritten"
        in capsys.readouterr().err
    )
    assert len(Keys(plant, CLUSTERS).members["C1"]) == 1
    run(capsys, monkeypatch, "keys", "take", str(cluster), str(carried))
    carried.unlink()
    run(capsys, monkeypatch, "keys", "rotate", str(plant), "C1", "--to", str(tmp_path))
    run(capsys, monkeypatch, "keys", "take", str(cluster), str(carried))
    new, old = Keys(plant, CLUSTERS).members["C1"]
    assert Keys(cluster, HELIOSTATS).plant == (new, old)
    shown = run(capsys, monkeypatch, "keys", "list", str(plant))
    assert fingerprint(new) in shown
    assert len(fingerprint(new)) == 8
    assert fingerprint(new) not in new.hex()
    assert new.hex() not in shown
    run(capsys, monkeypatch, "keys", "end", str(plant))
    assert Keys(plant, CLUSTERS).members["C1"] == (new,)


# -- links -------------------------------------------------------------------------------


def plant_first(plant: KeyRing, cluster: KeyRing) -> Iterator[None]:
    """Change the keys step by step; after each, messages pass."""
    plant.keys = (NEW, OLD)
    yield
    cluster.keys = (NEW, OLD)
    yield
    plant.keys = (NEW,)
    yield
    cluster.keys = (NEW,)
    yield


def cluster_first(plant: KeyRing, cluster: KeyRing) -> Iterator[None]:
    """Do it the other way round."""
    yield from plant_first(cluster, plant)


async def rotated(
    plant: CarriedLink, cluster: CarriedLink, steps: Iterator[None]
) -> list[tuple[bool, bool]]:
    """Pass messages both ways all the time while keys change; none is lost, no link ends."""
    behind = []
    await until(lambda: plant.connected and cluster.connected)
    for number, _ in enumerate(steps):
        # Until both have sent heartbeats under the keys that they now have.
        for end in (plant, cluster):
            seen = end.statistics.last_received
            for _ in range(3):
                await until(lambda end=end, seen=seen: end.statistics.last_received != seen)
                seen = end.statistics.last_received
        for sender, receiver in ((plant, cluster), (cluster, plant)):
            for count in range(20):
                data = bytes([number, count])
                assert await sender.send(data) is SendOutcome.SENT
                async with asyncio.timeout(PATIENCE):
                    assert await receiver.receive() == data
        if number:
            await until(lambda: not plant.behind and not cluster.behind)
        behind.append((plant.behind, cluster.behind))
    for end in (plant, cluster):
        counts = end.statistics
        assert (counts.opened, counts.dropped, counts.expired, counts.late) == (1, 0, 0, 0)
        assert (counts.sent, counts.received) == (80, 80)
    return behind


@pytest.mark.parametrize("order", [plant_first, cluster_first])
def test_keys_are_replaced_over_tcp_without_loss(
    order: Callable[[KeyRing, KeyRing], Iterator[None]],
) -> None:
    async def main() -> None:
        rings = KeyRing(OLD), KeyRing(OLD)
        server = TcpServer("127.0.0.1", 0, {"K1": rings[0]}, CLOCK, QUICK)
        async with running(server):
            await server.listening()
            cluster = tcp_link("127.0.0.1", server.port, "K1", rings[1], CLOCK, QUICK)
            async with running(cluster):
                behind = await rotated(server.links["K1"], cluster, order(*rings))
                # Who has both keys alone sees that the other end is behind.
                assert any(behind[0])
                assert behind[2:] == [(False, False), (False, False)]
            thief = tcp_link("127.0.0.1", server.port, "K1", OLD, CLOCK, QUICK)
            async with running(thief):
                await until(lambda: "refuses cluster K1" in thief.problem)

    asyncio.run(main())


def test_an_intruder_with_an_old_key_loses_its_connection_with_the_key() -> None:
    async def main() -> None:
        ring = KeyRing(NEW, OLD)
        quick = LinkSettings(period=0.05, deadline=0.6, first_pause=0.02, longest_pause=0.1)
        server = TcpServer("127.0.0.1", 0, {"K1": ring}, CLOCK, quick)
        async with running(server):
            await server.listening()
            thief = tcp_link("127.0.0.1", server.port, "K1", OLD, CLOCK, quick)
            async with running(thief):
                await until(lambda: server.links["K1"].connected)
                ring.keys = (NEW,)
                await until(lambda: not server.links["K1"].connected)
                await until(lambda: "refuses cluster K1" in thief.problem)
                assert not server.links["K1"].connected

    asyncio.run(main())


def test_a_cluster_with_a_key_that_the_plant_has_not_yet_connects_with_the_old_one() -> None:
    async def main() -> None:
        server = TcpServer("127.0.0.1", 0, {"K1": OLD}, CLOCK, QUICK)
        async with running(server):
            await server.listening()
            ring = KeyRing(NEW, OLD)
            cluster = tcp_link("127.0.0.1", server.port, "K1", ring, CLOCK, QUICK)
            async with running(cluster):
                await until(lambda: server.links["K1"].connected and cluster.behind)

    asyncio.run(main())


@pytest.fixture
def mosquitto(tmp_path: Path) -> Iterator[Mosquitto]:
    yield from mosquitto_for(tmp_path)


@pytest.mark.parametrize("order", [plant_first, cluster_first])
def test_keys_are_replaced_over_mqtt_without_loss(
    order: Callable[[KeyRing, KeyRing], Iterator[None]], mosquitto: Mosquitto
) -> None:
    async def main() -> None:
        rings, broker = (KeyRing(OLD), KeyRing(OLD)), Broker("127.0.0.1", mosquitto.port)
        plant, cluster = (
            mqtt_link(broker, "test", "K1", ring, CLOCK, QUICK, plant=place == 0)
            for place, ring in enumerate(rings)
        )
        async with running(plant, cluster):
            behind = await rotated(plant, cluster, order(*rings))
            assert behind[2:] == [(False, False), (False, False)]

    asyncio.run(main())


# -- files that change -------------------------------------------------------------------


def links_file(folder: Path) -> Path:
    path = folder / "links.toml"
    path.write_text(
        'format = "heliotrope-links"\nversion = 1\nkeys = "links.keys"\n'
        '[tcp]\nlisten = "127.0.0.1:0"\n[clusters]\nK1 = "tcp"\nK2 = "tcp"\n'
    )
    return path


def test_a_plant_takes_changed_keys_and_keeps_them_where_the_file_is_bad(tmp_path: Path) -> None:
    keys = tmp_path / "links.keys"
    KeyFile(keys).new(["K1", "K2"])
    found = read_links(links_file(tmp_path))
    papers: Papers = found.build({"K1": ("A",), "K2": ("B",)}, CLOCK).papers
    assert papers.look() == []
    (new,) = KeyFile(keys).rotate(["K2"]).values()
    assert papers.look() == []
    assert found.keys["K2"].newest == new
    before = found.keys["K1"].keys
    good = keys.read_text()
    for bad, text in (("K1 =", "no key"), ("[clusters]\n", "clusters.K1: its key is missing, but")):
        keys.write_text(bad)
        (alarm,) = papers.look()
        assert alarm.active
        assert (alarm.condition, alarm.subject) == ("renewal", "key file")
        assert text in alarm.text or "not valid TOML" in alarm.text
        assert papers.look() == []
        assert found.keys["K1"].keys == before
        keys.write_text(good)
        (alarm,) = papers.look()
        assert not alarm.active
    keys.chmod(0o640)
    (alarm,) = papers.look()
    assert "others may read it (mode 640)" in alarm.text


def put_password(file: Path, word: str) -> None:
    command = ["mosquitto_passwd", "-b", "-c", str(file), "plant", word]
    subprocess.run(command, check=True, capture_output=True)


@pytest.fixture
def guarded(mosquitto: Mosquitto, tmp_path: Path) -> Iterator[Mosquitto]:
    """A broker that asks for a password, which stands in ``passwords``."""
    del mosquitto  # it skips the test where there is none
    passwords = tmp_path / "passwords"
    put_password(passwords, "first word")
    config = f"listener 8883\nallow_anonymous false\npassword_file {passwords}"
    yield from mosquitto_for(tmp_path, config)


def test_the_broker_s_password_is_taken_when_the_key_file_changes(
    guarded: Mosquitto, tmp_path: Path
) -> None:
    """The broker starts anew with another one: a link connects again once its file has it."""
    keys, file = tmp_path / "links.keys", tmp_path / "links.toml"
    KeyFile(keys).new(["K1"])
    good = keys.read_text()
    keys.write_text(f'password = "first word"\n{good}')
    file.write_text(
        'format = "heliotrope-links"\nversion = 1\nkeys = "links.keys"\n'
        f'[mqtt]\nurl = "mqtt://127.0.0.1:{guarded.port}/test"\nusername = "plant"\n'
        '[clusters]\nK1 = "mqtt"\n'
    )

    async def main() -> None:
        built = read_links(file).build({"K1": ("A",)}, CLOCK)
        assert built.papers.look() == []
        link = built.links["K1"]
        assert isinstance(link, CarriedLink)
        carrier = link._carrier
        assert isinstance(carrier, _MqttCarrier)
        async with running(link):
            await until(lambda: carrier._client is not None)
            guarded.kill()
            put_password(tmp_path / "passwords", "second word")
            refused = guarded.log.read_text().count("not authorised")
            guarded.start()
            await until(lambda: guarded.log.read_text().count("not authorised") > refused)
            assert carrier._client is None
            keys.write_text(f'password = "second word"\n{good}')
            assert built.papers.look() == []
            await until(lambda: carrier._client is not None)

    asyncio.run(main())


def test_a_cluster_takes_the_broker_s_password_with_its_keys(tmp_path: Path) -> None:
    example = Path(__file__).parents[2] / "examples" / "cluster" / "C1.toml"
    file = tmp_path / "C1.toml"
    text = example.read_text().replace("tcp://10.0.0.2:4840", "mqtt://127.0.0.1/test")
    file.write_text(text)
    keys = private(tmp_path / "C1.keys.toml", f'plant = "{OLD.hex()}"\npassword = "first word"\n')
    installation = read_cluster(file)
    word = installation.password
    assert (word.word, "first word" in repr(installation)) == ("first word", False)
    keys.write_text(f'plant = "{NEW.hex()}"\npassword = "second word"\n')
    installation.take_keys()
    assert (word.word, installation.plant_keys.keys) == ("second word", (NEW,))
