"""Keys of the links between plant and clusters: key files, and key changes during operation.

Each cluster shares one key with its plant. During a change from an old key to a new one, an end has
both keys. It accepts either key, and uses the new key as soon as the other end has shown that it
also has that key (`envelope.Conversation`). It therefore does not matter which end gets the new key
first; no message is lost, and no connection ends.

Keys are stored in a separate file that only its owner may read: ``plant`` and ``password``, and a
table of keys, as hexadecimal text. If there are two keys, they form a list, the new key first.
"""

import fcntl
import hashlib
import os
import secrets
import string
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path

import tomli_w

from heliotrope.errors import FormatError, InputError
from heliotrope.files.documents import read_toml

_SHORTEST_KEY, _LONGEST_KEY = 16, 64
_SIZE = 32
#: Maximum number of keys of a link: the new key and the previous one.
_MOST = 2
_OTHERS = 0o077
#: Tables of keys in a plant's file, and in a cluster's file.
CLUSTERS, HELIOSTATS = "clusters", "heliostats"
_MISSING = {
    HELIOSTATS: "the cluster has no such heliostat",
    CLUSTERS: "the plant has no such cluster",
}
_LONGEST_NAME = 64

#: Keys of one link, newest first.
LinkKeys = tuple[bytes, ...]


class KeyRing:
    """The keys of one link, which may be replaced while the link runs.

    Attributes
    ----------
    keys
        Keys, newest first. The tuple is replaced as a whole, so any thread may read it.
    """

    def __init__(self, *keys: bytes) -> None:
        self.keys: LinkKeys = keys

    @property
    def newest(self) -> bytes:
        """The newest key; empty if there is no key."""
        return self.keys[0] if self.keys else b""


def ring_of(name: str, key: bytes | KeyRing) -> KeyRing:
    """Return the keys of a cluster's link as a ring.

    Raises
    ------
    InputError
        If a key has less than 16 bytes, or a name is empty or longer than 64 bytes.
    """
    ring = key if isinstance(key, KeyRing) else KeyRing(key)
    for secret in ring.keys or (b"",):
        if len(secret) < _SHORTEST_KEY:
            raise InputError(
                f"cluster {name}: a key of {len(secret)} bytes; use at least {_SHORTEST_KEY} "
                "random bytes"
            )
    if not 0 < len(name.encode()) <= _LONGEST_NAME:
        raise InputError(f"cluster {name!r}: a name has 1 to {_LONGEST_NAME} bytes")
    return ring


@dataclass
class BrokerPassword:
    """The broker's password, which may change; the next connection uses the new password."""

    word: str = field(repr=False)


class Keys:
    """A key file.

    Parameters
    ----------
    path
        Path of the file; None if there is no file and there are no keys.
    table
        Name of the table: `HELIOSTATS` in a cluster file, `CLUSTERS` in a plant file.

    Attributes
    ----------
    plant, password
        Keys of the plant, and password of the broker; () and empty if absent.
    members
        Keys of the table, by name.

    Raises
    ------
    FormatError
        If other users may read the file, or a value is not a key.
    """

    def __init__(self, path: Path | None, table: str) -> None:
        self._path, self._table = path, table
        self.plant: LinkKeys = ()
        self.password = ""
        self.members: dict[str, LinkKeys] = {}
        if path is None:
            return
        # An empty file has no keys; members without a key are rejected later.
        empty = path.is_file() and path.stat().st_size == 0
        raw = {} if empty else read_toml(path, "a key file")
        refuse_others(path)
        for key in raw:
            if key not in ("plant", "password", table):
                raise FormatError(path, f"{key!r} is not known; use plant, password, {table}")
        if "plant" in raw:
            self.plant = self._keys("plant", raw["plant"], _MOST)
        password, keys = raw.get("password", ""), raw.get(table, {})
        if not isinstance(password, str) or not isinstance(keys, dict):
            raise FormatError(path, f"password must be text, and {table} a table of keys")
        self.password = password
        most = _MOST if table == CLUSTERS else 1
        self.members = {name: self._keys(name, value, most) for name, value in keys.items()}

    def _keys(self, name: str, value: object, most: int) -> LinkKeys:
        values = value if isinstance(value, list) else [value]
        if not 1 <= len(values) <= most:
            raise FormatError(self._path, f"found {len(values)} keys; specify 1 to {most}", name)
        keys = tuple(self._key(name, entry) for entry in values)
        if len(set(keys)) < len(keys):
            raise FormatError(self._path, "a key occurs twice; list each key once", name)
        return keys

    def _key(self, name: str, value: object) -> bytes:
        text = value if isinstance(value, str) else ""
        good = set(text) <= set(string.hexdigits) and len(text) % 2 == 0
        if not (good and _SHORTEST_KEY <= len(text) // 2 <= _LONGEST_KEY):
            # The value is not shown, because it would end up in a log.
            raise FormatError(
                self._path,
                f"a key of {len(text)} characters; use {_SHORTEST_KEY} to {_LONGEST_KEY} bytes in "
                "hexadecimal, as created by heliotrope keys new",
                name,
            )
        return bytes.fromhex(text)

    def check(self, names: list[str]) -> None:
        """Reject keys of members that do not exist."""
        for name in self.members:
            if name not in names:
                close = get_close_matches(name, names, n=1)
                hint = f"; did you mean {close[0]!r}?" if close else "; remove it"
                raise FormatError(
                    self._path, f"{_MISSING[self._table]}{hint}", f"{self._table}.{name}"
                )


def refuse_others(path: Path) -> None:
    """Refuse a file that others may read.

    Raises
    ------
    FormatError
        If other users may read the file.
    """
    if path.stat().st_mode & _OTHERS:
        mode = path.stat().st_mode & 0o777
        raise FormatError(path, f"others may read it (mode {mode:o}); run chmod 600 on it")


def fingerprint(key: bytes) -> str:
    """Return a short identifier of a key that reveals nothing about it."""
    return hashlib.sha256(b"heliotrope key " + key).hexdigest()[:8]


# -- changing key files ------------------------------------------------------------------


class KeyFile:
    """A key file that can be changed.

    Every change is written completely, with mode 600, or not at all.

    Parameters
    ----------
    path
        The file; a missing or empty file has no keys.

    Raises
    ------
    FormatError
        See `Keys`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._read_as = content_of(path)
        self._held: Keys | None = None
        filled = path.exists() and path.stat().st_size > 0
        self._table = HELIOSTATS if filled and HELIOSTATS in read_toml(path, "a key file") else ""
        if filled or path.exists():
            self._held = Keys(path, self._table or CLUSTERS)

    @property
    def links(self) -> dict[str, LinkKeys]:
        """The link keys by name: per cluster, or ``plant`` in a cluster's own file."""
        if self._held is None:
            return {}
        own = {"plant": self._held.plant} if self._held.plant else {}
        return own if self._table else {**own, **self._held.members}

    def new(self, clusters: Sequence[str]) -> dict[str, bytes]:
        """Create a key for each cluster that has none; return the new keys.

        Raises
        ------
        InputError
            If a cluster already has a key, or the file is a cluster's own file.
        """
        self._check_plant(clusters)
        for name in clusters:
            if name in self.links:
                raise InputError(
                    f"{self.path}: cluster {name} already has a key; to replace it while plant and "
                    "cluster run, run heliotrope keys rotate"
                )
        made = {name: secrets.token_bytes(_SIZE) for name in clusters}
        self._write({name: (key,) for name, key in made.items()})
        return made

    def rotate(self, clusters: Sequence[str]) -> dict[str, bytes]:
        """Create a new key for each cluster and keep the present keys; return the new keys.

        Raises
        ------
        InputError
            If a cluster has no key, or already has two keys.
        """
        self._check_plant(clusters)
        made = {name: secrets.token_bytes(_SIZE) for name in clusters}
        self._write({name: self._beside(name, key) for name, key in made.items()})
        return made

    def take(self, key: bytes) -> None:
        """Add a new plant key to a cluster's file and keep the present key.

        Raises
        ------
        InputError
            If the file already contains that key or two other keys, or is a plant's file.
        """
        if any(name != "plant" for name in self.links):
            raise InputError(
                f"{self.path}: this is a plant's key file; take works only on a cluster's key file"
            )
        if key in self.links.get("plant", ()):
            raise InputError(f"{self.path}: it already has the key {fingerprint(key)}")
        self._write({"plant": self._beside("plant", key) if self.links else (key,)})

    def end(self, names: Sequence[str]) -> list[str]:
        """Remove the old keys of some names, and return the names.

        () means all names that have an old key.

        Raises
        ------
        InputError
            If a name has no old key.
        """
        links = self.links
        chosen = list(names) or [name for name, keys in links.items() if len(keys) > 1]
        for name in chosen or [""]:
            if len(links.get(name, ())) < _MOST:
                who = f"{name} has" if name else "nobody has"
                raise InputError(
                    f"{self.path}: {who} an old key that a new one replaces; there is nothing "
                    "to end"
                )
        self._write({name: links[name][:1] for name in chosen})
        return chosen

    def _beside(self, name: str, key: bytes) -> LinkKeys:
        known = self.links.get(name, ())
        if not known:
            raise InputError(f"{self.path}: {name} has no key; run heliotrope keys new")
        if len(known) == _MOST:
            raise InputError(
                f"{self.path}: {name} already has two keys; run heliotrope keys end when its other "
                "end uses the new one"
            )
        return (key, *known)

    def _check_plant(self, clusters: Iterable[str]) -> None:
        if self._table:
            raise InputError(
                f"{self.path}: this is a cluster's key file; create keys in the plant's key file, "
                "and import them here with heliotrope keys take"
            )
        for name in clusters:
            ring_of(name, bytes(_SIZE))

    def _write(self, changes: Mapping[str, LinkKeys]) -> None:
        held = self._held
        members = {} if held is None else dict(held.members)
        plant: LinkKeys = () if held is None else held.plant
        for name, keys in changes.items():
            if name == "plant":
                plant = keys
            else:
                members[name] = keys
        document: dict[str, object] = {}
        if plant:
            document["plant"] = _texts(plant)
        if held is not None and held.password:
            document["password"] = held.password
        if members:
            named = {name: _texts(keys) for name, keys in members.items()}
            document[self._table or CLUSTERS] = named
        self._read_as = replace_private(self.path, self._read_as, tomli_w.dumps(document))
        self._held = Keys(self.path, self._table or CLUSTERS)


def _texts(keys: LinkKeys) -> str | list[str]:
    return keys[0].hex() if len(keys) == 1 else [key.hex() for key in keys]


def carried_files(folder: Path, clusters: Sequence[str]) -> list[Path]:
    """Return the paths of the files in which new keys are carried to clusters.

    Raises
    ------
    InputError
        If there is no such folder, a cluster is named twice, its name cannot be a file name, or a
        file already exists, because keys are never overwritten.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    if len(set(clusters)) < len(clusters):
        raise InputError("keys: a cluster is named twice; name each once")
    files = []
    for name in clusters:
        if name != Path(name).name or name.startswith("."):
            raise InputError(f"cluster {name!r}: no file can have that name")
        files.append(folder / f"{name}.key.toml")
        if files[-1].exists():
            raise InputError(
                f"{files[-1]}: the file already exists, and keys are never overwritten; move it "
                "away"
            )
    return files


def carry(folder: Path, keys: Mapping[str, bytes]) -> list[Path]:
    """Write each cluster's new key into a file that is carried to the cluster.

    Return the files.
    """
    files = carried_files(folder, list(keys))
    for path, key in zip(files, keys.values(), strict=True):
        write_private(path, tomli_w.dumps({"plant": key.hex()}), new=True)
    return files


def content_of(path: Path) -> bytes:
    """Return the content of a key file; empty if the file is missing."""
    try:
        return path.read_bytes()
    except OSError:
        return b""


def replace_private(path: Path, before: bytes, text: str) -> bytes:
    """Replace a key file's content unless the file has changed; return the new content.

    If the file changed after it was read, it is not replaced: two simultaneous commands could
    otherwise drop a key that one of them has created, and that a cluster may already have adopted.

    Raises
    ------
    InputError
        If another command has changed the file, or the file cannot be written.
    """
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        if content_of(path) != before:
            raise InputError(
                f"{path}: another command has changed the file in the meantime; run your command "
                "again"
            )
        write_private(path, text)
    finally:
        os.close(folder)
    return text.encode()


def write_private(path: Path, text: str, *, new: bool = False) -> None:
    """Write a file that only its owner may read, completely or not at all.

    An existing file is replaced and keeps its owner; with ``new``, the file must not exist.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        handle = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(handle, "wb") as stream:
            os.fchmod(stream.fileno(), 0o600)
            if path.exists() and not new:
                status = path.stat()
                if (status.st_uid, status.st_gid) != (os.geteuid(), os.getegid()):
                    os.fchown(stream.fileno(), status.st_uid, status.st_gid)
            stream.write(text.encode())
            stream.flush()
            os.fsync(stream.fileno())
        if new:
            os.link(beside, path)  # fails if the file exists by now
        else:
            beside.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    finally:
        beside.unlink(missing_ok=True)
