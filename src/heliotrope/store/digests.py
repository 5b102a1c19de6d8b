"""Digests of hash chains and their heads; this module needs no database."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from heliotrope.errors import InputError

#: Digest before the first record.
GENESIS = "0" * 64
EVENT, AUDIT, ACCOUNT = CHAINS = "event", "audit", "account"


@dataclass(frozen=True)
class Head:
    """Number and digest of the last link of a chain; the chain is one of `CHAINS`."""

    chain: str
    number: int
    digest: str

    def __str__(self) -> str:
        return f"{self.chain}:{self.number}:{self.digest}"

    @classmethod
    def read(cls, text: str) -> "Head":
        """Return the head that a text represents.

        Raises
        ------
        InputError
            If the text is not a head.
        """
        chain, _, rest = text.partition(":")
        number, _, digest = rest.partition(":")
        if chain not in CHAINS or not number.isdigit() or len(digest) != len(GENESIS):
            raise InputError(
                f"{text!r} is not a head; specify one as `heliotrope store head` prints it"
            )
        return cls(chain, int(number), digest)


def digest_of(before: str, content: Sequence[Any]) -> str:
    """Return the digest of a record, from the previous digest and the record's content."""
    text = json.dumps(content, ensure_ascii=False, separators=(",", ":"), sort_keys=True)
    return hashlib.sha256(f"{before}\n{text}".encode(errors="surrogatepass")).hexdigest()
