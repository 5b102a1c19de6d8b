"""Backup signatures: Ed25519, with a private key that is never part of a backup.

The private key is a PEM file (PKCS 8) with mode 600; its public key is FILE.pub in the same folder,
and must be copied to the computer that restores.
"""

import base64
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from heliotrope.errors import FormatError, InputError

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import (
        Ed25519PrivateKey,
        Ed25519PublicKey,
    )

_OTHERS = 0o077
#: File suffix of the public key.
PUBLIC = ".pub"
#: Signed data begins with this, so that no other signature made with the key can be used instead.
_PURPOSE = b"heliotrope backup 1\n"


def make_key(path: Path) -> Path:
    """Create a key pair; return the file of the public key.

    Raises
    ------
    InputError
        If a file exists, or the files cannot be written.
    """
    ed25519 = _ed25519()
    from cryptography.hazmat.primitives import serialization as form

    public = path.with_name(path.name + PUBLIC)
    for file in (path, public):
        if file.exists():
            raise InputError(
                f"{file}: the file already exists, and keys are never overwritten; move it away"
            )
    key = ed25519.Ed25519PrivateKey.generate()
    private = key.private_bytes(form.Encoding.PEM, form.PrivateFormat.PKCS8, form.NoEncryption())
    known = key.public_key().public_bytes(form.Encoding.PEM, form.PublicFormat.SubjectPublicKeyInfo)
    for file, data, mode in ((path, private, 0o600), (public, known, 0o644)):
        try:
            handle = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
            with os.fdopen(handle, "wb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            raise InputError(f"{file}: cannot be written ({error.strerror})") from None
    return public


class SigningKey:
    """A private key.

    Parameters
    ----------
    path
        File of the key.

    Raises
    ------
    FormatError
        If the file cannot be read, other users may read it, or it is not such a key.
    """

    def __init__(self, path: Path) -> None:
        ed25519 = _ed25519()
        from cryptography.hazmat.primitives.serialization import load_pem_private_key

        data = _read(path)
        if path.stat().st_mode & _OTHERS:
            mode = path.stat().st_mode & 0o777
            raise FormatError(path, f"others may read it (mode {mode:o}); run chmod 600 on it")
        try:
            key = load_pem_private_key(data, None)
        except (ValueError, TypeError):
            key = None
        if not isinstance(key, ed25519.Ed25519PrivateKey):
            raise FormatError(path, "not a private key created by heliotrope store key")
        self._key: Ed25519PrivateKey = key

    def sign(self, data: bytes) -> bytes:
        """Return the signature of some data, as one line of text."""
        signature: bytes = self._key.sign(_PURPOSE + data)
        return base64.b64encode(signature) + b"\n"


class PublicKey:
    """A public key.

    Parameters
    ----------
    path
        File of the key.

    Raises
    ------
    FormatError
        If the file cannot be read, or is not such a key.
    """

    def __init__(self, path: Path) -> None:
        ed25519 = _ed25519()
        from cryptography.hazmat.primitives.serialization import load_pem_public_key

        self.path = path
        try:
            key = load_pem_public_key(_read(path))
        except ValueError:
            key = None
        if not isinstance(key, ed25519.Ed25519PublicKey):
            raise FormatError(
                path,
                f"not a public key of backups; specify the file {PUBLIC} created by heliotrope "
                "store key",
            )
        self._key: Ed25519PublicKey = key

    def signed(self, data: bytes, signature: bytes) -> bool:
        """Return whether a signature of some data was made with the private key."""
        from cryptography.exceptions import InvalidSignature

        try:
            self._key.verify(base64.b64decode(signature, validate=False), _PURPOSE + data)
        except (InvalidSignature, ValueError):
            return False
        return True


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from None


def _ed25519() -> Any:
    try:
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError:
        raise InputError(
            "cryptography is not installed; run pip install 'heliotrope[store]'"
        ) from None
    return ed25519
