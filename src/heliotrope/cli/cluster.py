"""``heliotrope cluster``: the controller of a real cluster."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    import asyncio

    from heliotrope.cluster.config_file import Installation
    from heliotrope.cluster.controller import Cluster
    from heliotrope.links.clock import Clock
    from heliotrope.links.link import Link
    from heliotrope.links.papers import Papers
    from heliotrope.links.tls import TlsSource
    from heliotrope.safety import Alarm


def cluster(
    config: Annotated[Path, typer.Argument(help="Cluster file (TOML).")],
    check: Annotated[bool, typer.Option("--check", help="Only check the file.")] = False,
    every: Annotated[
        float, typer.Option(min=1, max=86_400, help="Interval between log lines, s.")
    ] = 10.0,
) -> None:
    """Run a cluster of heliostats until SIGTERM or Ctrl-C; the cluster then defocuses them."""
    from heliotrope.errors import InputError
    from heliotrope.values import amount

    try:
        from heliotrope.cluster.config_file import read_cluster
        from heliotrope.links.clock import SystemClock
        from heliotrope.links.papers import Papers
    except ImportError as error:
        raise InputError(
            f"cluster: {error.name} is not installed; run pip install 'heliotrope[control]'"
        ) from None
    installation = read_cluster(config)
    if check:
        count = amount(len(installation.config.heliostats), "heliostat")
        print(f"{config}: cluster {installation.config.name} of {count}")
        clock = SystemClock()
        papers = Papers(clock)
        _link(installation, clock, papers)
        for line in papers.lines():
            print(line)
        return
    import asyncio

    asyncio.run(_run(installation, every))


async def _run(installation: "Installation", every: float) -> None:
    """Run the cluster until SIGTERM or SIGINT."""
    import asyncio
    import signal

    from heliotrope.cluster.controller import Cluster
    from heliotrope.cluster.memory import Kept
    from heliotrope.cluster.program import line_of, time_of
    from heliotrope.cluster.serial_bus import SerialBus
    from heliotrope.files.disk import DiskThread
    from heliotrope.links.clock import SystemClock
    from heliotrope.links.link import running
    from heliotrope.links.papers import Papers

    clock = SystemClock()
    bus = SerialBus(installation.bus_url, clock, installation.bus)
    papers = Papers(clock)
    link, time = _link(installation, clock, papers), time_of(installation, clock)
    if installation.key_file is not None:
        papers.renew("key file", [installation.key_file], installation.take_keys)
    if installation.bus_key_file is not None:
        papers.renew("key of the bus", [installation.bus_key_file], installation.take_bus_keys)
    kept = Kept(installation.state, disk=DiskThread())
    cluster = Cluster(
        installation.config,
        bus,
        link,
        clock,
        time,
        kept,
        line_of(installation.emergency_line),
        installation.bus_keys,
    )
    ending = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, ending.set)

    def tell(alarm: "Alarm") -> None:
        print(f"{installation.config.name}: {alarm.text}", flush=True)
        cluster.take_alarm(alarm)

    def note(name: str) -> None:
        print(f"{installation.config.name}: {name} renewed", flush=True)

    async with running(bus, link, time), running(cluster), papers.watched(tell, note):
        await _log(cluster, ending, every)
    kept.close()
    print(f"{installation.config.name}: stopped, DEFOCUS sent", flush=True)


async def _log(cluster: "Cluster", ending: "asyncio.Event", every: float) -> None:
    import asyncio

    while not ending.is_set():
        try:
            async with asyncio.timeout(every):
                await ending.wait()
        except TimeoutError:
            print(cluster.line(), flush=True)


def _link(installation: "Installation", clock: "Clock", papers: "Papers") -> "Link":
    from heliotrope.links.papers import authority_of

    name, keys = installation.config.name, installation.plant_keys
    authority = installation.plant.authority
    tls: TlsSource = None if authority is None else authority_of(papers, Path(authority))
    if installation.scheme == "tcp":
        from heliotrope.links.tcp import tcp_link

        return tcp_link(installation.host, installation.port, name, keys, clock, tls=tls)
    from heliotrope.links.mqtt import Broker, mqtt_link

    if installation.scheme == "mqtts" and tls is None:
        import ssl

        tls = ssl.create_default_context()
    broker = Broker(
        installation.host,
        installation.port,
        installation.plant.username,
        installation.password,
        tls,
    )
    return mqtt_link(broker, installation.prefix, name, keys, clock, plant=False)
