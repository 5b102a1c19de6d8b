"""The simulated field that `heliotrope run` starts where no links are given."""

import contextlib
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from heliotrope.cli.twin import READY
from heliotrope.errors import InputError

#: Time that it gets to end, s.
_ENDING = 1.0
_MAIN = "from heliotrope.cli import main; main()"


@contextlib.contextmanager
def twin_process(options: Sequence[str]) -> Iterator[Path]:
    """Run a simulated field beside a block; yield the folder of its plant file and links file.

    Parameters
    ----------
    options
        Of ``heliotrope twin``, without folder and addresses.

    Raises
    ------
    InputError
        If it does not begin.
    """
    home = Path(tempfile.mkdtemp(prefix="heliotrope-twin-"))
    folder = home / "field"
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    command = [sys.executable, "-c", _MAIN, "twin", *options, "--folder", str(folder)]
    command += ["--plant", f"127.0.0.1:{port}", "--child"]
    # In a session of its own: Ctrl-C in the terminal is the plant's.
    process = subprocess.Popen(  # noqa: S603
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        assert process.stdout is not None
        if process.stdout.readline().strip() != READY:
            raise InputError("run: the simulated field has not begun; see the line before")
        yield folder
    finally:
        # It ends when its standard input ends.
        assert process.stdin is not None
        process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_ENDING)
        process.kill()
        process.wait()
        shutil.rmtree(home, ignore_errors=True)
