"""A real Mosquitto of a test's own on this machine."""

import getpass
import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from support.absence import absent

PATIENCE = 90.0
MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin")


_CONFIG = "listener 8883\nallow_anonymous true\nset_tcp_nodelay true\npersistence false"


class Mosquitto:
    """A broker with its own configuration, on a port of this machine alone."""

    def __init__(self, folder: Path, config: str = _CONFIG) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.log = folder / "mosquitto.log"
        self._config = folder / "mosquitto.conf"
        self._config.write_text(
            f"{config.replace('listener 8883', f'listener {self.port} 127.0.0.1')}\n"
            f"user {getpass.getuser()}\nlog_type all\nlog_dest file {self.log}\n"
        )
        self.start()

    def start(self) -> None:
        assert MOSQUITTO is not None
        self._process = subprocess.Popen(
            [MOSQUITTO, "-c", self._config], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        deadline = time.monotonic() + PATIENCE
        while True:
            try:
                socket.create_connection(("127.0.0.1", self.port)).close()
            except ConnectionRefusedError:
                assert self._process.poll() is None, "mosquitto ended at once"
                assert time.monotonic() < deadline, "mosquitto does not listen"
                time.sleep(0.01)
            else:
                return

    def freeze(self) -> None:
        os.kill(self._process.pid, signal.SIGSTOP)

    def thaw(self) -> None:
        os.kill(self._process.pid, signal.SIGCONT)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()


def mosquitto_for(folder: Path, config: str = _CONFIG) -> Iterator[Mosquitto]:
    """Give a test its broker; skip it where there is none, but not where everything is tested."""
    if MOSQUITTO is None:
        absent("mosquitto is not installed: links through a broker are not tested")
    broker = Mosquitto(folder, config)
    yield broker
    broker.kill()
