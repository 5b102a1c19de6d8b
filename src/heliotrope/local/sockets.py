"""Unix sockets in a folder that only the plant's own user can enter."""

import contextlib
import errno
import os
import pwd
import socket
import stat
import struct
import time
from collections.abc import Iterator
from pathlib import Path

from heliotrope.errors import InputError

#: The sockets of a plant: one for all calls, and one for EMERGENCY, DEFOCUS and STOW alone.
ORDINARY, EMERGENCY = "plant.sock", "emergency.sock"
_FOLDER = "interface"
#: Number of connections that may wait to be accepted.
_BACKLOG = 16
#: Pause before another attempt to connect, s.
_AGAIN = 0.01
#: Longest path that fits in a socket address, bytes.
_LONGEST = 100
_CREDENTIALS = struct.Struct("3i")


def socket_folder(data: Path) -> Path:
    """Return the socket folder within a plant's data folder."""
    return data / _FOLDER


def name_here(user: int) -> str:
    """Return the name under which a user of this computer is recorded, or else a number."""
    try:
        return f"{pwd.getpwuid(user).pw_name} on this machine"
    except KeyError:
        return f"user {user} on this machine"


def make_folder(folder: Path) -> None:
    """Create a folder for sockets that only this user can enter.

    Raises
    ------
    InputError
        If the folder cannot be created, or belongs to another user.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        known = folder.lstat()
        if not stat.S_ISDIR(known.st_mode) or known.st_uid != os.getuid():
            raise InputError(f"{folder}: not a folder owned by this user; remove it")
        folder.chmod(0o700)
    except OSError as error:
        raise InputError(
            f"{folder}: {error.strerror}; set --data to a folder owned by this user"
        ) from None


@contextlib.contextmanager
def _short(path: Path) -> Iterator[str]:
    """Yield an address for a socket, even if the path is too long for a socket address."""
    if len(os.fsencode(path)) <= _LONGEST:
        yield str(path)
        return
    folder = os.open(path.parent, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)


def listen(path: Path) -> socket.socket:
    """Return a listening socket that only this user can connect to.

    Raises
    ------
    InputError
        If it is not possible to listen at the path.
    """
    made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        path.unlink(missing_ok=True)
        with _short(path) as address:
            made.bind(address)
        path.chmod(0o600)
        made.listen(_BACKLOG)
        made.setblocking(False)
    except OSError as error:
        made.close()
        raise InputError(f"{path}: cannot listen on this socket: {error.strerror}") from None
    return made


def connect(path: Path, timeout: float) -> socket.socket:
    """Return a connected socket, blocking for at most ``timeout`` s.

    Raises
    ------
    OSError
        If nobody listens there, or another user does, who would then receive our key or token.
    """
    made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    made.settimeout(timeout)
    try:
        until = time.monotonic() + timeout
        with _short(path) as address:
            while True:
                try:
                    made.connect(address)
                    break
                except BlockingIOError:  # other connections wait to be accepted: try again
                    if time.monotonic() > until:
                        raise
                    time.sleep(_AGAIN)
        if os.getuid() and user_of(made) is None:
            raise PermissionError(errno.EACCES, "another user is listening on it")
    except BaseException:
        made.close()
        raise
    return made


def user_of(peer: socket.socket) -> int | None:
    """Return the user of the process at the other end; None unless it is this user or root.

    The kernel guarantees this information (SO_PEERCRED).
    """
    try:
        data = peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    except OSError:
        return None
    user = int(_CREDENTIALS.unpack(data)[1])
    return user if user in (os.getuid(), 0) else None
