"""Links through a real Mosquitto on this machine: also frozen, killed and restarted."""

import asyncio
import contextlib
import re
import shutil
import socket
import subprocess
import threading
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import aiomqtt
import pytest
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from heliotrope.errors import InputError
from heliotrope.links import envelope
from heliotrope.links.clock import SystemClock, sleep_until
from heliotrope.links.envelope import OVERHEAD
from heliotrope.links.link import Link, LinkSettings, SendOutcome, running
from heliotrope.links.mqtt import Broker, mqtt_link
from heliotrope.links.tls import client_tls
from support.absence import absent
from support.broker import MOSQUITTO, Mosquitto, mosquitto_for

KEY, OTHER_KEY = bytes(range(32)), bytes(32)
PREFIX = "heliotrope/test"
PATIENCE = 60.0
#: Beats that are quick against the broker's keepalive of 60 s, and slow for a busy machine.
QUICK = LinkSettings(period=0.1, deadline=1.0, open_limit=1.0, first_pause=0.05, longest_pause=0.2)
CALM = LinkSettings(period=0.1, deadline=10.0, open_limit=5.0)
CLOCK = SystemClock()


@pytest.fixture
def mosquitto(tmp_path: Path) -> Iterator[Mosquitto]:
    yield from mosquitto_for(tmp_path)


def real(main: Callable[[], Awaitable[None]]) -> None:
    async def limited() -> None:
        async with asyncio.timeout(2.0 * PATIENCE):
            await main()

    asyncio.run(limited())


async def until(holds: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not holds():
            await asyncio.sleep(0.01)


async def connected(*links: Link) -> None:
    await until(lambda: all(link.connected for link in links))


def pair(
    port: int, settings: LinkSettings = QUICK, cluster: str = "north", key: bytes = KEY
) -> tuple[Link, Link]:
    broker = Broker("127.0.0.1", port)
    return (
        mqtt_link(broker, PREFIX, cluster, key, CLOCK, settings, plant=True),
        mqtt_link(broker, PREFIX, cluster, key, CLOCK, settings, plant=False),
    )


def test_a_link_without_a_key_is_refused() -> None:
    with pytest.raises(InputError, match="cluster north: a key of 0 bytes; use at least 16"):
        mqtt_link(Broker("127.0.0.1"), PREFIX, "north", b"", CLOCK, plant=True)


def test_messages_pass_both_ways_and_clusters_do_not_hear_each_other(mosquitto: Mosquitto) -> None:
    async def main() -> None:
        north, south = pair(mosquitto.port), pair(mosquitto.port, cluster="south", key=OTHER_KEY)
        async with running(*north, *south):
            await connected(*north, *south)
            for number in range(50):
                data = bytes([number]) * 1000
                expires = CLOCK.monotonic() + PATIENCE
                assert await north[0].send(data, expires=expires) is SendOutcome.SENT
                assert await north[1].receive() == data
                assert await north[1].send(data) is SendOutcome.SENT
                assert await north[0].receive() == data
            assert south[1].statistics.received == south[0].statistics.received == 0
            assert north[1].statistics.refused == south[1].statistics.refused == 0
            where = f"via 127.0.0.1:{mosquitto.port}"
            assert (north[0].name, north[1].name) == (f"cluster north {where}", f"plant {where}")

    real(main)


def test_without_the_key_the_broker_lets_in_but_nobody_listens(mosquitto: Mosquitto) -> None:
    async def main() -> None:
        plant, cluster = pair(mosquitto.port)[0], pair(mosquitto.port, key=OTHER_KEY)[1]
        async with running(plant, cluster):
            await until(lambda: plant.statistics.refused > 3 and cluster.statistics.refused > 3)
            assert not plant.connected
            assert not cluster.connected

    real(main)


def test_retained_messages_are_refused_and_counted(mosquitto: Mosquitto) -> None:
    async def main() -> None:
        down = f"{PREFIX}/north/down"
        plant, cluster = pair(mosquitto.port, CALM)
        async with aiomqtt.Client("127.0.0.1", mosquitto.port) as stranger:
            await stranger.publish(down, b"kept from before", qos=1, retain=True)
            async with running(plant, cluster):
                await connected(plant, cluster)
                await until(lambda: cluster.statistics.retained == 1)
                await stranger.publish(down, b"to be kept", qos=1, retain=True)
                await until(lambda: cluster.statistics.retained == 2)
                refused = cluster.statistics.refused
                await stranger.publish(down, b"not of this house", qos=1)
                await until(lambda: cluster.statistics.refused == refused + 1)
                await plant.send(b"ours")
                assert await cluster.receive() == b"ours"
                assert cluster.statistics.received == 1

    real(main)


def _whole(_: int) -> Properties:
    return Properties(PacketTypes.CONNECT)


@pytest.mark.parametrize("obeys", [True, False], ids=["broker-withholds", "broker-passes-on"])
def test_huge_messages_of_a_stranger_cost_nothing(
    mosquitto: Mosquitto,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    obeys: bool,
) -> None:
    """The broker keeps them to itself; from one that does not, they are refused by their length."""
    sizes: list[int] = []
    digest = envelope.hmac.digest

    def noted(key: bytes, data: bytes, name: str) -> bytes:
        sizes.append(len(data))
        return digest(key, data, name)

    monkeypatch.setattr("heliotrope.links.envelope.hmac.digest", noted)
    if not obeys:
        monkeypatch.setattr("heliotrope.links.mqtt._asked_of_broker", _whole)

    async def main() -> None:
        plant, cluster = pair(mosquitto.port, CALM)
        async with (
            aiomqtt.Client("127.0.0.1", mosquitto.port) as stranger,
            running(plant, cluster),
        ):
            await connected(plant, cluster)
            refused = cluster.statistics.refused
            for size in (CALM.largest + OVERHEAD + 1000, 10_000_000):
                await stranger.publish(f"{PREFIX}/north/down", bytes(size), qos=1)
            largest = bytes(CALM.largest)
            await plant.send(largest)
            assert await cluster.receive() == largest
            assert cluster.statistics.refused - refused == (0 if obeys else 2)
        assert CALM.largest < max(sizes) <= CALM.largest + OVERHEAD

    real(main)
    assert not caplog.records


def test_what_goes_out_is_not_retained_expires_and_is_confirmed(mosquitto: Mosquitto) -> None:
    async def main() -> None:
        plant, cluster = pair(mosquitto.port, CALM)
        seen: list[aiomqtt.Message] = []
        stranger = aiomqtt.Client("127.0.0.1", mosquitto.port, protocol=aiomqtt.ProtocolVersion.V5)
        async with stranger, running(plant, cluster):
            await connected(plant, cluster)
            await stranger.subscribe(f"{PREFIX}/north/down", qos=2)
            await plant.send(b"move", expires=CLOCK.monotonic() + 6.5)
            while not any(b"move" in message.payload for message in seen):
                seen.append(await anext(aiter(stranger.messages)))
        assert seen[-1].qos == 1
        assert not seen[-1].retain
        assert seen[-1].properties is not None
        assert 5 <= vars(seen[-1].properties)["MessageExpiryInterval"] <= 7
        assert all(message.qos == 0 for message in seen[:-1])  # heartbeats

    real(main)


def test_nothing_is_kept_for_a_cluster_that_is_away(mosquitto: Mosquitto) -> None:
    async def main() -> None:
        plant, before = pair(mosquitto.port, CALM)
        async with running(plant):
            async with running(before):
                await connected(plant, before)
            # The plant does not know yet that nobody is there; the broker takes the message.
            sent = await plant.send(b"order", expires=CLOCK.monotonic() + PATIENCE)
            assert sent is SendOutcome.SENT
            after = pair(mosquitto.port, CALM)[1]
            async with running(after):
                await connected(plant, after)
                async with asyncio.TaskGroup() as group:
                    arrived = group.create_task(after.receive())
                    # The plant may still be in its conversation with the one before.
                    while not arrived.done():
                        await plant.send(b"new order")
                        await asyncio.wait([arrived], timeout=0.1)
                assert arrived.result() == b"new order"

    real(main)


def test_the_status_informs_and_the_last_will_too(mosquitto: Mosquitto) -> None:
    class Cut(threading.Thread):
        """A relay that dies: the broker sees a connection end without a goodbye."""

        def __init__(self) -> None:
            super().__init__()
            self.listener = socket.create_server(("127.0.0.1", 0))
            self.port = self.listener.getsockname()[1]
            self.ends: list[socket.socket] = []

        def run(self) -> None:
            near, _ = self.listener.accept()
            far = socket.create_connection(("127.0.0.1", mosquitto.port))
            self.ends = [near, far]
            back = threading.Thread(target=self.pump, args=(far, near))
            back.start()
            self.pump(near, far)
            back.join()
            for end in (near, far, self.listener):
                end.close()

        def pump(self, source: socket.socket, sink: socket.socket) -> None:
            try:
                while data := source.recv(4096):
                    sink.sendall(data)
            except OSError:
                pass

        def die(self) -> None:
            for end in self.ends:
                # The relay's own thread may have closed it meanwhile.
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)

    async def main() -> None:
        said: list[bytes] = []

        async def next_is(status: bytes) -> None:
            while not said or said[-1] != status:
                said.append((await anext(aiter(watcher.messages))).payload)

        relay = Cut()
        relay.start()
        cluster = pair(relay.port, CALM)[1]
        async with aiomqtt.Client("127.0.0.1", mosquitto.port) as watcher:
            await watcher.subscribe(f"{PREFIX}/north/status", qos=1)
            async with running(cluster):
                await next_is(b"online")
                relay.die()
                await next_is(b"offline")
            relay.join()
            plant, cluster = pair(mosquitto.port, CALM)
            async with running(plant, cluster):
                await next_is(b"online")
                # A lie about it changes nothing.
                await connected(plant, cluster)
                await watcher.publish(f"{PREFIX}/north/status", b"offline", retain=True)
                await next_is(b"offline")
                await plant.send(b"heard")
                assert await cluster.receive() == b"heard"

    real(main)


def test_a_frozen_broker_is_noticed_by_the_heartbeat_and_what_it_held_comes_no_more(
    mosquitto: Mosquitto,
) -> None:
    async def main() -> None:
        plant, cluster = pair(mosquitto.port)
        async with running(plant, cluster):
            await connected(plant, cluster)
            mosquitto.freeze()
            frozen = CLOCK.monotonic()
            # Nobody knows yet: the message goes into the frozen broker's socket.
            sent = await plant.send(b"old order", expires=frozen + 0.5)
            assert sent in (SendOutcome.EXPIRED, SendOutcome.DISCONNECTED)
            await until(lambda: not plant.connected and not cluster.connected)
            # Long before the broker's keepalive of 60 s, for which this test would not wait.
            assert plant.silent_for >= QUICK.deadline
            await until(lambda: "heartbeat" in cluster.problem or "refuses" in cluster.problem)
            late = await plant.send(b"later", expires=CLOCK.monotonic() + 60.0)
            assert late is SendOutcome.DISCONNECTED
            await until(lambda: plant.statistics.failures >= 1)  # it does not get in meanwhile
            mosquitto.thaw()
            await connected(plant, cluster)
            assert await plant.send(b"new order") is SendOutcome.SENT
            assert await cluster.receive() == b"new order"
            assert cluster.statistics.received == 1

    real(main)


def test_what_a_broker_held_for_a_moment_is_late_by_our_own_reckoning(mosquitto: Mosquitto) -> None:
    async def main() -> None:
        plant, cluster = pair(mosquitto.port, CALM)
        async with running(plant, cluster):
            await connected(plant, cluster)
            mosquitto.freeze()
            # MQTT's expiry has whole seconds, and does not run in a frozen broker.
            expires = CLOCK.monotonic() + 0.3
            assert await plant.send(b"old", expires=expires) is SendOutcome.EXPIRED
            await sleep_until(CLOCK, expires)
            mosquitto.thaw()
            await plant.send(b"new")
            assert await cluster.receive() == b"new"
            assert cluster.statistics.late == 1
            assert cluster.statistics.reconnects == 0

    real(main)


def test_a_killed_broker_is_found_again(mosquitto: Mosquitto) -> None:
    async def main() -> None:
        plant, cluster = pair(mosquitto.port)
        async with running(plant, cluster):
            await connected(plant, cluster)
            mosquitto.kill()
            await until(lambda: plant.statistics.failures >= 1 and cluster.statistics.failures >= 1)
            assert "refuses the connection" in plant.problem
            assert await plant.send(b"nobody") is SendOutcome.DISCONNECTED
            await asyncio.to_thread(mosquitto.start)
            await connected(plant, cluster)
            assert min(plant.statistics.reconnects, cluster.statistics.reconnects) >= 1
            assert await plant.send(b"again") is SendOutcome.SENT
            assert await cluster.receive() == b"again"

    real(main)


def test_a_link_can_be_closed_while_the_broker_is_frozen(mosquitto: Mosquitto) -> None:
    async def main() -> None:
        plant, cluster = pair(mosquitto.port)
        async with running(plant, cluster):
            await connected(plant, cluster)
            mosquitto.freeze()
        newcomer = pair(mosquitto.port)[0]
        async with running(newcomer):  # closed while it waits for the broker's answer
            await asyncio.sleep(0.2)

    real(main)


def test_a_cancellation_in_the_instant_of_the_answer_is_not_forgotten(
    mosquitto: Mosquitto,
) -> None:
    async def main() -> None:
        plant = pair(mosquitto.port, CALM)[0]
        carrier = plant._carrier  # type: ignore[attr-defined]
        await carrier.open()
        mosquitto.freeze()
        writing = asyncio.create_task(carrier.write(b"order", None))
        waiting = carrier._client._pending_publishes
        await until(lambda: len(waiting) == 1)
        await asyncio.sleep(0)
        for answered in waiting.values():
            answered.set()
        writing.cancel()
        await asyncio.wait([writing])
        assert writing.cancelled()
        await carrier.close()

    real(main)


def test_a_carrier_that_is_cancelled_while_it_takes_its_leave_leaves_nothing_behind(
    mosquitto: Mosquitto,
) -> None:
    async def main() -> None:
        carrier = pair(mosquitto.port, CALM)[1]._carrier  # type: ignore[attr-defined]
        await carrier.open()
        client = carrier._client
        mosquitto.freeze()
        closing = asyncio.create_task(carrier.close())
        await asyncio.sleep(0.05)
        closing.cancel()
        await asyncio.wait([closing])
        assert closing.cancelled()
        assert client._client.socket() is None
        assert client._misc_task.done()

    real(main)


def test_small_messages_go_out_at_once(mosquitto: Mosquitto) -> None:
    async def main() -> None:
        plant, cluster = pair(mosquitto.port)
        async with running(plant, cluster):
            await connected(plant, cluster)
            link = plant._carrier._client._client.socket()  # type: ignore[attr-defined]
            assert link.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)

    real(main)


@pytest.mark.parametrize(
    ("prefix", "cluster", "text"),
    [
        ("", "north", "MQTT prefix ''"),
        ("plant/#", "north", "stand for any topic"),
        ("/plant", "north", "begin or end with a slash"),
        ("plant", "+", "MQTT cluster"),
        ("plant", "north/east", "a name of one level"),
    ],
)
def test_names_that_make_no_topic_are_refused(prefix: str, cluster: str, text: str) -> None:
    with pytest.raises(InputError, match=text):
        mqtt_link(Broker("127.0.0.1"), prefix, cluster, KEY, CLOCK, plant=True)


# -- the page about Mosquitto ----------------------------------------------------------


def page_block(kind: str) -> str:
    page = Path(__file__).parents[2] / "docs" / "how-to" / "mqtt.md"
    found = re.search(rf"^```{kind}\n(.*?)^```", page.read_text("utf-8"), re.DOTALL | re.MULTILINE)
    assert found is not None, kind
    return found[1]


@pytest.fixture(scope="module")
def papers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make an authority, a broker's certificate, passwords and the page's access list."""
    missing = [tool for tool in ("openssl", "mosquitto_passwd") if shutil.which(tool) is None]
    if missing or MOSQUITTO is None:
        absent(f"{missing or 'mosquitto'} not installed: the page's settings are not tested")
    folder = tmp_path_factory.mktemp("papers")

    def run(*command: str) -> None:
        subprocess.run(command, cwd=folder, check=True, capture_output=True)

    key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    run(
        "openssl",
        "req",
        "-x509",
        *key,
        "-keyout",
        "ca.key",
        "-out",
        "ca.pem",
        "-days",
        "2",
        "-subj",
        "/CN=the plant's authority",
    )
    run(
        "openssl", "req", *key, "-keyout", "broker.key", "-out", "broker.csr", "-subj", "/CN=broker"
    )
    (folder / "names").write_text("subjectAltName=IP:127.0.0.1\n")
    run(
        "openssl",
        "x509",
        "-req",
        "-in",
        "broker.csr",
        "-CA",
        "ca.pem",
        "-CAkey",
        "ca.key",
        "-set_serial",
        "1",
        "-days",
        "2",
        "-extfile",
        "names",
        "-out",
        "broker.pem",
    )
    (folder / "passwords").touch()
    for user in ("plant", "north", "south"):
        run("mosquitto_passwd", "-b", "passwords", user, f"{user}'s own")
    (folder / "acl").write_text(page_block("acl").replace("heliotrope/upington", PREFIX))
    for path in folder.iterdir():  # Mosquitto warns of files that others can read
        path.chmod(0o600)
    return folder


@pytest.fixture
def page_broker(papers: Path, tmp_path: Path) -> Iterator[Mosquitto]:
    config = page_block("conf").replace("/etc/mosquitto/heliotrope", str(papers))
    broker = Mosquitto(tmp_path, config)
    yield broker
    broker.kill()


def test_the_settings_of_the_page_let_plant_and_clusters_talk(
    page_broker: Mosquitto, papers: Path
) -> None:
    def link(user: str, cluster: str, password: str = "") -> Link:
        broker = Broker(
            "127.0.0.1",
            page_broker.port,
            username=user,
            password=password or f"{user}'s own",
            tls=client_tls(papers / "ca.pem"),
        )
        return mqtt_link(broker, PREFIX, cluster, KEY, CLOCK, CALM, plant=user == "plant")

    async def main() -> None:
        ends = [link("plant", "north"), link("north", "north")]
        other = [link("plant", "south"), link("south", "south")]
        async with running(*ends, *other):
            await connected(*ends, *other)
            order = bytes(CALM.largest)
            assert await ends[0].send(order) is SendOutcome.SENT
            assert await ends[1].receive() == order
            await other[1].send(b"report")
            assert await other[0].receive() == b"report"
        refused = link("north", "north", "another's")
        async with running(refused):
            await until(lambda: refused.statistics.failures >= 1)
            assert "Not authorized" in refused.problem

    real(main)
    warnings = [line for line in page_broker.log.read_text().splitlines() if "Warning" in line]
    assert not warnings


def test_the_access_list_of_the_page_keeps_clusters_apart(
    page_broker: Mosquitto, papers: Path
) -> None:
    heard: list[str] = []

    def client(user: str) -> aiomqtt.Client:
        return aiomqtt.Client(
            "127.0.0.1",
            page_broker.port,
            username=user,
            password=f"{user}'s own",
            tls_context=client_tls(papers / "ca.pem"),
        )

    async def main() -> None:
        async with client("plant") as plant, client("north") as north, client("south") as south:
            await south.subscribe(f"{PREFIX}/#")
            await plant.subscribe(f"{PREFIX}/#")
            for user, sender in (("north", north), ("plant", plant)):
                for topic in ("north/up", "north/status", "north/down", "south/up", "south/down"):
                    await sender.publish(f"{PREFIX}/{topic}", f"{user} on {topic}", qos=1)
            await south.publish(f"{PREFIX}/south/up", b"last", qos=1)
            async for message in plant.messages:
                if message.payload == b"last":
                    break
                heard.append(f"plant hears {message.payload.decode()}")
            async for message in south.messages:
                heard.append(f"south hears {message.payload.decode()}")
                break
            await plant.publish(f"{PREFIX}/south/down", b"last", qos=1)
            async for message in south.messages:
                if message.payload == b"last":
                    break
                heard.append(f"south hears {message.payload.decode()}")

    real(main)
    assert heard == [
        "plant hears north on north/up",
        "plant hears north on north/status",
        "south hears plant on south/down",
    ]
    assert "Denied PUBLISH" in page_broker.log.read_text()
