"""The bus key, in a separate file that its cluster reads (`lcu.signing`).

``keys`` is a list of keys in hexadecimal text. It contains one key or, during a key change, the new
key and the previous key. It is empty if frames are no longer to be signed; the cluster then removes
the key from its local controllers.
"""

import secrets
from pathlib import Path

import tomli_w

from heliotrope.errors import FormatError, InputError
from heliotrope.files.documents import read_toml
from heliotrope.lcu.signing import KEY_SIZE, NO_KEY
from heliotrope.links.keys import LinkKeys, content_of, refuse_others, replace_private

_MOST = 2


def read_bus_keys(path: Path) -> LinkKeys:
    """Return the keys of a bus, newest first.

    Raises
    ------
    FormatError
        If others may read the file, or its content is invalid.
    """
    raw = read_toml(path, "a file of a bus's key")
    refuse_others(path)
    values = raw.get("keys")
    if set(raw) != {"keys"} or not isinstance(values, list) or len(values) > _MOST:
        raise FormatError(path, f"the file must contain only keys, a list of at most {_MOST}")
    keys = tuple(_key(path, value) for value in values)
    if len(set(keys)) < len(keys):
        raise FormatError(path, "a key occurs twice; list each key once", "keys")
    return keys


def _key(path: Path, value: object) -> bytes:
    try:
        key = bytes.fromhex(value) if isinstance(value, str) else b""
    except ValueError:
        key = b""
    if len(key) != KEY_SIZE or key == NO_KEY:
        # The value is not shown, because it would end up in a log.
        raise FormatError(
            path,
            f"not a key; a key has {KEY_SIZE} bytes in hexadecimal, as created by heliotrope keys "
            "bus new",
            "keys",
        )
    return key


class BusKeyFile:
    """The bus key file, which can be changed; each change is written completely or not at all.

    Parameters
    ----------
    path
        The file; it may be missing.

    Attributes
    ----------
    keys
        Keys, newest first.

    Raises
    ------
    FormatError
        See `read_bus_keys`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._read_as = content_of(path)
        self.keys: LinkKeys = read_bus_keys(path) if path.exists() else ()

    def new(self) -> None:
        """Create the first key.

        Raises
        ------
        InputError
            If there already is a key.
        """
        if self.keys:
            raise InputError(
                f"{self.path}: it already has a key; to replace it while the cluster runs, run "
                "heliotrope keys bus rotate"
            )
        self._write(secrets.token_bytes(KEY_SIZE))

    def rotate(self) -> None:
        """Create a new key and keep the present key beside it.

        Raises
        ------
        InputError
            If there is no key, or there are two.
        """
        if not self.keys:
            raise InputError(f"{self.path}: it has no key; run heliotrope keys bus new")
        if len(self.keys) == _MOST:
            raise InputError(
                f"{self.path}: it already has two keys; run heliotrope keys bus end when all local "
                "controllers have the new one"
            )
        self._write(secrets.token_bytes(KEY_SIZE), *self.keys)

    def end(self) -> None:
        """Remove the old key.

        Raises
        ------
        InputError
            If there is no old key.
        """
        if len(self.keys) < _MOST:
            raise InputError(
                f"{self.path}: it has no old key that a new one replaces; there is nothing to end"
            )
        self._write(self.keys[0])

    def off(self) -> None:
        """Remove all keys; the cluster then also removes them from its local controllers."""
        self._write()

    def _write(self, *keys: bytes) -> None:
        text = tomli_w.dumps({"keys": [key.hex() for key in keys]})
        self._read_as = replace_private(self.path, self._read_as, text)
        self.keys = keys
