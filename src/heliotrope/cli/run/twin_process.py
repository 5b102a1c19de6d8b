"""The simulated field that `heliotrope run` starts if no links are specified."""

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from heliotrope.cli.twin import READY
from heliotrope.errors import InputError

if TYPE_CHECKING:
    from heliotrope.field.plant import Plant
    from heliotrope.store.keeper import Keeper

#: Time allowed for the process to end, s.
_ENDING = 1.0
_MAIN = "from heliotrope.cli import main; main()"


@dataclass(frozen=True)
class TwinField:
    """A simulated field that starts, then waits for the items that its local controllers store.

    Attributes
    ----------
    folder
        Folder of the field's plant file and links file.
    process
        The process of the simulated field.
    seed, measured
        See `twin_process`.
    """

    folder: Path
    process: subprocess.Popen[str]
    seed: int
    measured: int

    def wait(self) -> None:
        """Wait until the field's files are written and its clock can be read.

        Raises
        ------
        InputError
            If the field does not start.
        """
        assert self.process.stdout is not None
        if self.process.stdout.readline().strip() != READY:
            raise InputError("run: the simulated field did not start; see the line above")

    async def begin(self, keeper: "Keeper", design: "Plant", start: datetime) -> None:
        """Let the field store the plant's calibrations; a new store gets yesterday's calibrations.

        Raises
        ------
        StoreError
            If the store cannot be read or written.
        """
        from heliotrope.twin.live.live import WorldOptions, true_mechanisms
        from heliotrope.twin.program.boards import BOARDS, write_boards
        from heliotrope.twin.yesterday import begin_second_day

        if self.measured:
            truth = true_mechanisms(design, WorldOptions(self.seed))
            await begin_second_day(
                keeper, design, truth, start, count=self.measured, seed=self.seed
            )
        known = keeper.latest_calibrations(design.names).values()
        write_boards(self.folder / BOARDS, list(known))


@contextlib.contextmanager
def twin_process(options: Sequence[str], seed: int, measured: int) -> Iterator["TwinField"]:
    """Run a simulated field during a block; yield it while it is starting.

    Parameters
    ----------
    options
        Options of ``heliotrope twin``, without folder, addresses and seed.
    seed
        Seed of the true installation errors.
    measured
        Number of heliostats measured yesterday, if the store has no calibration.
    """
    home = Path(tempfile.mkdtemp(prefix="heliotrope-twin-"))
    folder = home / "field"
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    command = [sys.executable, "-c", _MAIN, "twin", *options, "--folder", str(folder)]
    command += ["--seed", str(seed), "--plant", f"127.0.0.1:{port}", "--child"]
    # The plant reports compilation for the field too (`jit.PROGRAM`, whose import takes a second).
    os.environ.setdefault("HELIOTROPE_PROGRAM", str(os.getpid()))
    # In a session of its own, because Ctrl-C in the terminal is meant for the plant.
    process = subprocess.Popen(  # noqa: S603
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        yield TwinField(folder, process, seed, measured)
    finally:
        # The process ends when its standard input ends.
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_ENDING)
        process.kill()
        process.wait()
        process.stdout.close()
        shutil.rmtree(home, ignore_errors=True)
