"""A real PostgreSQL server of a test's own: killed, frozen and full as well."""

import contextlib
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

from support.absence import absent


def _programs() -> Path | None:
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda p: p.parts[-3])
    if found:
        return found[-1].parent
    there = shutil.which("initdb")
    return Path(there).parent if there else None


class PostgresServer:
    """A server in a folder, reached through a Unix socket there; its superuser is ``plant``.

    Parameters
    ----------
    programs
        Folder of the server's programs.
    folder
        An empty folder.
    options
        Further options of the server.
    """

    def __init__(self, programs: Path, folder: Path, options: str = "") -> None:
        self._programs, self.folder, self._options = programs, folder, options
        # The server refuses to run as root.
        self._as_other: dict[str, str] = {}
        if os.geteuid() == 0:
            known = {entry.pw_name for entry in pwd.getpwall()}
            user = "postgres" if "postgres" in known else "nobody"
            self._as_other = {"user": user}
            shutil.chown(folder, user)
        self._data = folder / "data"
        words = ["-A", "trust", "-U", "plant", "-E", "UTF8", "--locale=C", "--no-sync"]
        self._run("initdb", "-D", str(self._data), *words, "--no-instructions")

    def url(self, user: str = "plant", database: str = "postgres") -> str:
        """Return the URL of a database."""
        return f"postgresql://{user}@/{database}?host={quote(str(self.folder), safe='')}"

    def start(self) -> None:
        """Start, or start again."""
        options = f"-c listen_addresses='' -c unix_socket_directories='{self.folder}'"
        options += f" -c fsync=off {self._options}"
        log = str(self.folder / "log")
        self._run("pg_ctl", "-D", str(self._data), "-w", "-l", log, "-o", options, "start")

    def kill(self) -> None:
        """End at once, without a word to clients and without a checkpoint."""
        self._run("pg_ctl", "-D", str(self._data), "-w", "-m", "immediate", "stop")

    @contextlib.contextmanager
    def frozen(self) -> Iterator[None]:
        """Stop all processes of the server during a block: it is there, and does not answer."""
        stopped = self._processes()
        for number in stopped:
            os.kill(number, signal.SIGSTOP)
        try:
            yield
        finally:
            for number in stopped:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(number, signal.SIGCONT)

    def _processes(self) -> list[int]:
        """Return the processes of the server, the one that starts the others first."""
        first = int((self._data / "postmaster.pid").read_text("ascii").split()[0])
        children = Path(f"/proc/{first}/task/{first}/children").read_text("ascii").split()
        return [first, *map(int, children)]

    def _run(self, *command: str) -> None:
        done = subprocess.run(
            [str(self._programs / command[0]), *command[1:]],
            cwd=self.folder,
            capture_output=True,
            text=True,
            check=False,
            **self._as_other,
        )
        assert done.returncode == 0, done.stdout + done.stderr


@contextlib.contextmanager
def postgres_server(options: str = "") -> Iterator[PostgresServer]:
    """Run a server during a block; skip the test where PostgreSQL is absent."""
    programs = _programs()
    if programs is None:
        absent("PostgreSQL is not installed: no initdb in /usr/lib/postgresql or on the path")
    folder = Path(tempfile.mkdtemp(prefix="pg"))
    try:
        server = PostgresServer(programs, folder, options)
        server.start()
        try:
            yield server
        finally:
            server.kill()
    finally:
        shutil.rmtree(folder)
