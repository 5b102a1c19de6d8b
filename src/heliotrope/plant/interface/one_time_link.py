"""The one-time link: signs a local user in to a simulated plant without a password."""

import hashlib
import hmac
import secrets
import threading
import time
from collections.abc import Callable

#: Time for which a link is valid, s.
VALID = 600.0
#: Number of random bytes in a link.
_RANDOM = 32


class OneTimeLink:
    """The secret of a link, valid once and for `VALID` s; only its hash is kept, in memory.

    Any thread may call any method.

    Parameters
    ----------
    now
        Function that returns monotonic time, s.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now, self._turn = now, threading.Lock()
        self._made: tuple[bytes, str, float] | None = None

    def make(self, name: str) -> str:
        """Return the secret of a new link for an account; earlier links become invalid."""
        secret = secrets.token_urlsafe(_RANDOM)
        with self._turn:
            self._made = _hash(secret), name, self._now() + VALID
        return secret

    def use(self, secret: str) -> str | None:
        """Return the account that a secret signs in, and end the link; None if it is invalid."""
        with self._turn:
            if self._made is None:
                return None
            kept, name, until = self._made
            if not hmac.compare_digest(kept, _hash(secret)):
                return None
            self._made = None
            return name if self._now() < until else None


def _hash(secret: str) -> bytes:
    return hashlib.sha256(secret.encode(errors="replace")).digest()
